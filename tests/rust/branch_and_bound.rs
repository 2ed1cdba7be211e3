//! Branch and bound: no bound of a box exceeds a score of its candidates, and boxes change no table.

use ftlm::equation::Equation;
use ftlm::estimation::multi_innovation::{Innovation, Prior, RowBasis};
use ftlm::order_search::batches::search;
use ftlm::order_search::branch_and_bound::{box_bounds, open_candidates, BoxBound};
use ftlm::order_search::control::Control;
use ftlm::order_search::dual_bound::lower_bounds;
use ftlm::order_search::grid::{OrderGrid, TermAxis};
use ftlm::order_search::options::{Criterion, Estimator, Norm, Options};
use ftlm::regressors::Record;
use ftlm::simulate::respond;

use crate::common::{equation, record, with_signal, Random};

fn grid(random: &mut Random, highest: f64, most: usize) -> Vec<f64> {
    let count = 2 + random.below(most - 1);
    let from = random.uniform(0.0, 0.3 * highest);
    let step = 10.0_f64.powf(random.uniform(-3.3, -1.0)).min((highest - from) / count as f64);
    // Orders as people space them, and sometimes not.
    let uneven = random.chance(0.2);
    let values = (0..count).map(|i| from + step * (i as f64 + if uneven { random.uniform(0.0, 0.9) } else { 0.0 }));
    values.collect()
}

/// Records and a lattice whose candidates are one slab for each order of the terms that do not vary.
fn problem(random: &mut Random) -> (Vec<Record>, OrderGrid) {
    let noise = 10.0_f64.powf(random.uniform(-5.0, -1.0));
    let truth = equation(0, 1.6, &[(0, 0.9, -2.0), (0, 0.0, -9.0), (1, 0.3, 1.5), (2, 0.0, 6.0)]);
    let step = random.uniform(0.01, 0.05);
    let records = (0..1 + random.below(2))
        .map(|_| {
            let m = 60 + random.below(140);
            let rest = record(step, vec![vec![0.0; m], random.steps(m, 40), random.steps(m, 25)]);
            let mut y = respond(std::slice::from_ref(&truth), &rest, &[]).unwrap().remove(0);
            y.iter_mut().for_each(|v| *v += noise * random.normal());
            with_signal(&rest, 0, y)
        })
        .collect();
    let alpha = random.uniform(0.8, 2.2);
    let axis = |signal: usize, values: Vec<f64>| TermAxis { signal, values, interchangeable: true };
    let own = grid(random, 0.9 * alpha, 24);
    let mut axes = vec![axis(0, own.clone())];
    if random.chance(0.6) {
        axes.push(axis(0, own));
    }
    axes.push(axis(1, grid(random, alpha, 24)));
    if random.chance(0.7) {
        axes.push(axis(2, vec![random.uniform(-0.3, 0.5)]));
    }
    (records, OrderGrid::new(0, &[alpha], &axes, |s| s == 2).unwrap())
}

#[test]
fn box_bounds_do_not_exceed_candidate_scores() {
    let mut random = Random::new(901);
    let (mut boxes, mut telling, mut large, mut best) = (0, 0, 0, 0.0_f64);
    let (mut asked, mut open) = (0, 0);
    let (mut held, mut near) = (0, 0);
    for _ in 0..80 {
        let (records, lattice) = problem(&mut random);
        let (criterion, norm) = match random.below(4) {
            0 => (Criterion::OutputError, Norm::L2),
            1 => (Criterion::EquationError, Norm::L2),
            _ => (Criterion::OutputError, Norm::L1),
        };
        let prior = [Prior::WEAK, Prior::Absolute(1e-3), Prior::Absolute(1.0), Prior::Absolute(1e6)][random.below(4)];
        let row_basis = RowBasis::Time;
        let estimator = match random.below(3) {
            0 => Estimator::LeastSquares,
            n => Estimator::MultiInnovation(Innovation { length: [1, 7][n - 1], prior, row_basis }),
        };
        let samples: usize = records.iter().map(Record::m).sum();
        // Brute force, which asks no bound.
        let bounded = Options { criterion, norm, estimator, ..Options::default() };
        let options = Options { top: 10_000, pruning: false, ..bounded.clone() };
        let fixed = vec![None; lattice.width()];
        let found = search(&records, &lattice, &fixed, &options, &Control::default()).unwrap();
        let mut scores = vec![f64::INFINITY; lattice.count() as usize];
        for row in &found.rows {
            // A root of a mean of squares becomes a sum again, up to rounding.
            let raw = match norm {
                Norm::L1 => row.score,
                Norm::L2 => row.score * row.score * samples as f64 * (1.0 + 1e-12),
            };
            scores[row.index as usize] = raw;
        }
        let mut ranked: Vec<f64> = scores.clone();
        ranked.sort_by(f64::total_cmp);
        for index in [0, lattice.count() / 2, lattice.count() - 1] {
            let limit = ranked[random.below(ranked.len().min(20))];
            let (from, to) = (random.below(scores.len()) as u64 / 2, lattice.count());
            let left = open_candidates(&records, &lattice, &bounded, index, from..to, limit).unwrap();
            let all = box_bounds(&records, &lattice, &bounded, index).unwrap();
            if let Some(slab) = all.iter().max_by_key(|b| b.rows * b.values) {
                let within = slab.first.max(from)..slab.first + slab.rows * slab.stride;
                assert!(left.iter().all(|i| within.contains(i)));
                let reach = within.clone().filter(|&i| scores[i as usize] <= limit * (1.0 - 1e-9));
                for i in reach {
                    assert_eq!(left.iter().filter(|&&j| i == j).count(), 1, "candidate {i} is within reach");
                }
                (asked, open) = (asked + within.count(), open + left.len());
            }
            // What is proved of a box is proved of each of its candidates by the same test vectors, which says more than
            // that it is below a score.
            let telling_boxes: Vec<&BoxBound> =
                all.iter().filter(|b| b.bound > 0.0 && b.rows * b.values >= 4).collect();
            for _ in 0..if criterion == Criterion::OutputError { telling_boxes.len().min(60) } else { 0 } {
                let BoxBound { first, rows, values, stride, bound } = *telling_boxes[random.below(telling_boxes.len())];
                let (row, value) = (random.below(rows as usize) as u64, random.below(values as usize) as u64);
                let index = first + row * stride + value;
                let Some(row) = found.rows.iter().find(|row| row.index == index) else { continue };
                let equation = Equation { structure: lattice.structure(index), coefficients: row.coefficients.clone() };
                let own =
                    |record: &Record| lower_bounds(record, &equation, norm).unwrap().into_iter().fold(0.0, f64::max);
                let alone: f64 = records.iter().map(own).sum();
                assert!(
                    bound <= alone * (1.0 + 1e-9),
                    "box of {rows} by {values} proves {bound:e} of {index}: {alone:e}"
                );
                (held, near) = (held + 1, near + usize::from(bound > 0.9 * alone));
            }
            for BoxBound { first, rows, values, stride, bound } in all {
                let all = (0..rows).flat_map(|i| (0..values).map(move |j| first + i * stride + j));
                let least = all.map(|i| scores[i as usize]).fold(f64::INFINITY, f64::min);
                assert!(bound <= least, "box of {rows} by {values} from {first}: bound {bound:e}, score {least:e}");
                boxes += 1;
                if least.is_finite() {
                    best = best.max(bound / least);
                    telling += usize::from(bound > 0.1 * least);
                    large += usize::from(bound > 0.1 * least && rows * values >= 16);
                }
            }
        }
    }
    println!(
        "{boxes} boxes, {telling} bounds within a factor of ten, {large} of 16 candidates or more, best {best:.3}"
    );
    println!("{open} of {asked} candidates left open");
    println!("{near} of {held} boxes prove nine tenths of what is proved of a candidate alone");
    assert!(held > 5_000 && near > 1_000);
    assert!(asked - open > 500);
    assert!(boxes > 100_000 && telling > 20_000 && large > 2_000);
}
