//! Certificates over intervals of orders: no cell's bound exceeds what any of its orders leave, and no orders of a region
//! do better than what is proved.

use ftlm::equation::Equation;
use ftlm::regressors::Record;
use ftlm::search::certificate::{cell_bound, certify, Asked, Certificate, Range, Region};
use ftlm::search::control::Control;
use ftlm::simulate::respond;

use crate::common::{equation, record, with_signal, Random};

/// Σ of the squares that least squares leave, by orthogonal columns, twice made so.
fn left(records: &[Record], output: usize, terms: &[(usize, f64)]) -> f64 {
    let all = |of: &dyn Fn(&Record) -> Vec<f64>| records.iter().flat_map(of).collect::<Vec<f64>>();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    // The unit of time must be one for all records.
    let mut made: Vec<Vec<f64>> = Vec::new();
    let target = |r: &Record| r.signal(output).to_vec();
    let columns = terms.iter().map(|&(signal, eta)| all(&move |r: &Record| r.integral(signal, eta)));
    let mut rest = Vec::new();
    for mut column in columns.chain([all(&target)]) {
        for _ in 0..2 {
            for unit in &made {
                let share = dot(&column, unit);
                column.iter_mut().zip(unit).for_each(|(x, u)| *x -= share * u);
            }
        }
        let size = dot(&column, &column).sqrt();
        rest.clone_from(&column);
        made.push(column.into_iter().map(|x| x / size).collect());
    }
    dot(&rest, &rest)
}

fn truth() -> Equation {
    equation(0, 1.6, &[(0, 0.9, -2.0), (0, 0.0, -9.0), (1, 0.3, 1.5)])
}

fn problem(random: &mut Random, most: usize) -> Vec<Record> {
    let noise = 10.0_f64.powf(random.uniform(-6.0, -1.0));
    (0..1 + random.below(2))
        .map(|_| {
            let m = 40 + random.below(most);
            let step = random.uniform(0.01, 0.05);
            let rest = record(step, vec![vec![0.0; m], random.steps(m, 40), random.steps(m, 9)]);
            let mut y = respond(&[truth()], &rest, &[]).unwrap().remove(0);
            y.iter_mut().for_each(|v| *v += noise * random.normal());
            with_signal(&rest, 0, y)
        })
        .collect()
}

#[test]
fn no_bound_of_a_cell_exceeds_what_any_of_its_orders_leave() {
    let mut random = Random::new(1201);
    let (mut points, mut cells, mut telling, mut tight, mut most) = (0, 0, 0, 0, 0.0_f64);
    for _ in 0..40 {
        let records = problem(&mut random, 160);
        for _ in 0..60 {
            let count = 1 + random.below(4);
            let terms: Vec<(usize, f64, f64)> = (0..count)
                .map(|_| {
                    let half = 10.0_f64.powf(random.uniform(-4.0, -1.0));
                    let half = if random.chance(0.1) { 0.0 } else { half };
                    (random.below(3), half + random.uniform(0.0, 2.2), half)
                })
                .collect();
            let bound = cell_bound(&records, 0, &terms).unwrap();
            let mut least = f64::INFINITY;
            for point in 0..12 {
                let inside = |random: &mut Random, &(signal, middle, half): &(usize, f64, f64)| {
                    // Corners, the middle, anywhere.
                    let share = match point {
                        0..=3 => 2.0 * f64::from(u8::from(random.chance(0.5))) - 1.0,
                        4 => 0.0,
                        _ => random.uniform(-1.0, 1.0),
                    };
                    (signal, middle + share * half)
                };
                let at: Vec<(usize, f64)> = terms.iter().map(|term| inside(&mut random, term)).collect();
                let exact = left(&records, 0, &at);
                assert!(bound <= exact, "{terms:?} at {at:?}: {bound:e} above {exact:e}");
                least = least.min(exact);
                points += 1;
            }
            cells += 1;
            most = most.max(bound / least);
            telling += usize::from(bound > 0.5 * least);
            tight += usize::from(bound > 0.95 * least);
        }
    }
    println!("{points} orders in {cells} cells; {telling} bounds above half, {tight} above 95 % of the least, {most}");
    assert!(points > 25_000 && telling > 900 && tight > 400 && most > 0.9999, "{telling}, {tight}, {most}");
}

fn asked(within: f64) -> Asked {
    Asked { within, cells: 400_000, threads: 2, memory: 1 << 29 }
}

fn region() -> Region {
    let range = |signal, lowest, highest| Range { signal, lowest, highest };
    Region {
        output: 0,
        alpha: (1.2, 1.9),
        terms: vec![range(0, 0.5, 1.1), range(0, 0.0, 0.0), range(1, 0.0, 0.6)],
        apart: 0.1,
    }
}

#[test]
fn no_orders_of_a_region_do_better_than_is_proved() {
    let mut random = Random::new(1202);
    let (mut drawn, mut best_share) = (0, 0.0_f64);
    for case in 0..4 {
        let records = problem(&mut random, 60);
        let region = region();
        let within = [0.05, 0.2, 0.5, 0.02][case];
        let found = certify(&records, &region, &asked(within), &Control::default()).unwrap();
        let samples: usize = records.iter().map(Record::m).sum();
        let rmse = |alpha: f64, orders: &[f64]| {
            let terms: Vec<(usize, f64)> =
                region.terms.iter().zip(orders).map(|(t, order)| (t.signal, alpha - order)).collect();
            (left(&records, 0, &terms) / samples as f64).sqrt()
        };
        println!("{found:?}");
        let Certificate { at_least, best, order, ref orders, open, .. } = found;
        // What is said to be reached is.
        assert!((rmse(order, orders) / best - 1.0).abs() < 1e-6, "{} {best}", rmse(order, orders));
        assert!(at_least <= best);
        if open == 0 {
            assert!(at_least >= (1.0 - within) * best * (1.0 - 1e-8));
        }
        let at = |random: &mut Random, spread: f64| {
            let alpha = (order + spread * random.uniform(-1.0, 1.0)).clamp(1.2, 1.9);
            let mut around = |range: &Range, order: f64| {
                (order + spread * random.uniform(-1.0, 1.0)).clamp(range.lowest, range.highest)
            };
            let orders: Vec<f64> = region.terms.iter().zip(orders).map(|(range, &o)| around(range, o)).collect();
            (alpha, orders)
        };
        for n in 0..4000 {
            // All over the region, and close to the best.
            let (alpha, orders) = at(&mut random, [2.0, 0.3, 0.03, 0.003][n % 4]);
            if alpha - orders[0] >= 0.1 && alpha - orders[2] >= 0.0 {
                let score = rmse(alpha, &orders);
                assert!(at_least <= score, "{alpha} {orders:?}: {score:e} below {at_least:e}");
                best_share = best_share.max(at_least / score);
                drawn += 1;
            }
        }
    }
    println!("{drawn} orders, at most {best_share} of the error of one proved");
    assert!(drawn > 12_000 && best_share > 0.9, "{drawn} {best_share}");
}

#[test]
fn threads_change_no_bit_and_cells_that_are_not_allowed_are_said() {
    let mut random = Random::new(1203);
    let records = problem(&mut random, 40);
    let of = |threads: usize, cells: u64| {
        certify(&records, &region(), &Asked { threads, cells, ..asked(0.3) }, &Control::default())
    };
    let whole = of(1, 400_000).unwrap();
    assert_eq!(whole, of(3, 400_000).unwrap());
    let cut = of(2, whole.cells - 1).unwrap();
    assert!(cut.open > 0 && cut.cells < whole.cells && cut.at_least <= whole.at_least);
    let error = of(1, 3).unwrap_err().to_string();
    assert!(error.contains("cells of orders") && error.contains("allow more"), "{error}");
}

#[test]
fn what_is_no_region_is_refused() {
    let mut random = Random::new(1204);
    let records = problem(&mut random, 40);
    let of = |region: &Region, within: f64| {
        certify(&records, region, &asked(within), &Control::default()).unwrap_err().to_string()
    };
    for within in [0.0, 1.0, -0.1, f64::NAN, f64::INFINITY] {
        assert!(of(&region(), within).contains("within"));
    }
    for alpha in [(0.0, 1.0), (1.9, 1.2), (f64::NAN, 1.0), (1.0, f64::INFINITY)] {
        assert!(of(&Region { alpha, ..region() }, 0.1).contains("alpha"));
    }
    for apart in [0.0, -1.0, f64::NAN, 2.0] {
        assert!(of(&Region { apart, ..region() }, 0.1).contains("apart"));
    }
    let terms = |range: Range| Region { terms: vec![range], ..region() };
    assert!(of(&terms(Range { signal: 9, lowest: 0.0, highest: 1.0 }), 0.1).contains("signal 9"));
    assert!(of(&terms(Range { signal: 1, lowest: 1.0, highest: 0.0 }), 0.1).contains("interval of a term"));
    assert!(of(&terms(Range { signal: 1, lowest: f64::NAN, highest: 0.0 }), 0.1).contains("interval of a term"));
    assert!(of(&terms(Range { signal: 0, lowest: 1.85, highest: 2.0 }), 0.1).contains("no orders in these intervals"));
    assert!(of(&Region { terms: vec![], ..region() }, 0.1).contains("0 terms"));
    let error = certify(&[], &region(), &asked(0.1), &Control::default()).unwrap_err().to_string();
    assert!(error.contains("no record"), "{error}");
    let silent = record(0.1, vec![vec![1.0; 50], vec![0.0; 50]]);
    let region = terms(Range { signal: 1, lowest: 0.0, highest: 1.0 });
    let error = certify(&[silent], &region, &asked(0.1), &Control::default()).unwrap_err().to_string();
    assert!(error.contains("signal 1"), "{error}");
}
