//! Order searches over a stage under its order law: the grid of the law, and the joined tables against enumeration.

use std::collections::HashSet;
use std::sync::atomic::Ordering;

use ftlm::equation::{grains, AffineOrder, Equation, Initial};
use ftlm::error::Error;
use ftlm::estimation::least_squares;
use ftlm::estimation::multi_innovation::{Innovation, Prior, RowBasis};
use ftlm::order_search::control::Control;
use ftlm::order_search::grid::{LawEquation, OrderLawGrid, MAX_TUPLES};
use ftlm::order_search::options::{Criterion, Estimator, Norm, Options};
use ftlm::order_search::result::Failure;
use ftlm::order_search::stage_join::{search, CoupledSearch, Span, StageOutcome};
use ftlm::regressors::Record;
use ftlm::simulate::{equation_error, respond};

use crate::common::{bits, check, deviation, equation, record, relative_distance, with_signal, Random};

fn law(constant: f64, weights: [f64; 5]) -> AffineOrder {
    AffineOrder { constant, weights: weights.to_vec() }
}

/// The two-link arm's law over (α₁, α₂, γ₁, β₂, μ₂); signals: hub, deflection, current.
fn two_link() -> Vec<LawEquation> {
    let current = || (2, law(0.0, [0.0; 5]));
    vec![
        LawEquation {
            output: 0,
            order: law(0.0, [1.0, 0.0, 0.0, 0.0, 0.0]),
            terms: vec![
                (1, law(0.0, [1.0, -1.0, -1.0, 1.0, 1.0])),
                (0, law(0.0, [0.0, 0.0, 1.0, 0.0, 0.0])),
                (1, law(0.0, [1.0, -1.0, -1.0, 0.0, 2.0])),
                current(),
            ],
        },
        LawEquation {
            output: 1,
            order: law(0.0, [0.0, 1.0, 0.0, 0.0, 0.0]),
            terms: vec![
                (1, law(0.0, [0.0, 0.0, 0.0, 1.0, 0.0])),
                (0, law(0.0, [-1.0, 1.0, 2.0, 0.0, -1.0])),
                (1, law(0.0, [0.0, 0.0, 0.0, 0.0, 1.0])),
                current(),
            ],
        },
    ]
}

const INPUTS: [bool; 3] = [false, false, true];

fn axes() -> Vec<Vec<f64>> {
    vec![vec![1.9, 2.0], vec![1.9, 2.0], vec![0.9, 0.95, 1.0], vec![0.0, 0.1, 0.3], vec![0.8, 0.85, 0.95]]
}

/// More distinct orders of each equation than are evaluated before the first is left early.
fn fine_axes() -> Vec<Vec<f64>> {
    let range = |start: f64, count: i32| (0..count).map(|i| start + 0.05 * f64::from(i)).collect();
    vec![vec![1.9, 2.0], vec![1.9, 1.95, 2.0], range(0.8, 5), range(0.0, 6), range(0.75, 5)]
}

/// A gentle stage whose orders obey the law at (2, 2, 0.95, 0.1, 0.85), with noise.
fn data(m: usize, noise: f64, seed: u64) -> Record {
    let mut random = Random::new(seed);
    let model = [
        equation(0, 2.0, &[(1, 0.0, 60.0), (0, 0.95, -6.0), (1, 0.75, 1.5), (2, 0.0, 14.0)]),
        equation(1, 2.0, &[(1, 0.1, -85.0), (0, 1.05, 6.0), (1, 0.85, -2.0), (2, 0.0, -14.0)]),
    ];
    let mut record = record(0.02, vec![vec![0.0; m], vec![0.0; m], random.steps(m, 30)]);
    for (i, mut y) in respond(&model, &record, &[]).unwrap().into_iter().enumerate() {
        let size = noise * deviation(&y);
        y.iter_mut().for_each(|v| *v += size * random.normal());
        record = with_signal(&record, i, y);
    }
    record
}

fn options() -> Options {
    Options {
        criterion: Criterion::OutputError,
        norm: Norm::L1,
        estimator: Estimator::LeastSquares,
        initial: Initial::Rest,
        top: 12,
        threads: 2,
        pruning: true,
        memory: 2 << 30,
    }
}

fn free_coefficients() -> Vec<Vec<Option<f64>>> {
    vec![vec![None; 4]; 2]
}

fn scales(records: &[Record]) -> Vec<f64> {
    let m = records.iter().map(Record::m).sum::<usize>() as f64;
    (0..2).map(|i| m * deviation(records[0].signal(i))).collect()
}

fn run(records: &[Record], lattice: &OrderLawGrid, options: &Options) -> StageOutcome {
    let control = Control::default();
    let found = search(records, lattice, &free_coefficients(), &scales(records), options, &control).unwrap();
    let counts = found.counts;
    let sum = counts.table_rows
        + counts.beaten
        + counts.excluded_by_bound
        + counts.stopped
        + counts.singular
        + counts.diverged;
    assert_eq!(sum, counts.candidates);
    assert_eq!(counts.table_rows, found.rows.len() as u64);
    // One that was left early may have been followed further.
    assert!(found.distinct.iter().sum::<u64>() <= control.total.load(Ordering::Relaxed));
    assert_eq!(control.finished_count.load(Ordering::Relaxed), control.total.load(Ordering::Relaxed));
    found
}

#[test]
fn the_law_lattice_is_the_product_of_its_axes() {
    let lattice = OrderLawGrid::new(&axes(), &two_link(), &INPUTS).unwrap();
    assert_eq!(lattice.product(), 2 * 2 * 3 * 3 * 3);
    assert_eq!(lattice.free(0), [1.9, 1.9, 0.9, 0.0, 0.8]);
    assert_eq!(lattice.free(1), [1.9, 1.9, 0.9, 0.0, 0.85]);
    assert_eq!(lattice.free(107), [2.0, 2.0, 1.0, 0.3, 0.95]);
    assert_eq!(lattice.equations(), two_link());
    // Plant A's orders from its five free ones.
    let index = (0..108).find(|&i| lattice.free(i) == [2.0, 2.0, 0.95, 0.1, 0.85]).unwrap();
    let found = lattice.structures(index).unwrap();
    let orders: Vec<Vec<f64>> = found.iter().map(|s| s.terms.iter().map(|t| t.order).collect()).collect();
    assert_eq!(orders, [[0.0, 0.95, 0.75, 0.0], [0.1, 1.05, 0.85, 0.0]]);
    assert_eq!((found[0].order, found[1].order), (2.0, 2.0));
    // Axes in any order and with repetitions are the same lattice.
    let mut shuffled = axes();
    shuffled[2] = vec![1.0, 0.9, 0.95, 0.9];
    assert_eq!(OrderLawGrid::new(&shuffled, &two_link(), &INPUTS).unwrap().free(107), lattice.free(107));
}

#[test]
fn tuples_without_a_valid_equation_are_omitted() {
    let lattice = OrderLawGrid::new(&axes(), &two_link(), &INPUTS).unwrap();
    let accepted = (0..lattice.product()).filter(|&i| lattice.structures(i).is_some()).count();
    // By hand: beta1 = a1 - a2 - g1 + b2 + m2 may not be negative; all else is in range on these axes.
    let by_hand = (0..lattice.product())
        .filter(|&i| {
            let f = lattice.free(i);
            f[0] - f[1] - f[2] + f[3] + f[4] > -1e-9
        })
        .count();
    assert!(accepted > 0 && accepted < 108, "{accepted}");
    assert_eq!(accepted, by_hand);
    // Two orders of one signal that coincide: beta2 = mu2.
    let narrow = vec![vec![2.0], vec![2.0], vec![0.5], vec![0.8], vec![0.8]];
    let lattice = OrderLawGrid::new(&narrow, &two_link(), &INPUTS).unwrap();
    assert_eq!(lattice.structures(0), None);
    let found = search(&[data(50, 0.0, 1)], &lattice, &free_coefficients(), &[1.0; 2], &options(), &Control::default());
    assert!(matches!(found, Err(Error::EmptyOrderGrid { .. })));
}

#[test]
fn empty_and_oversized_law_grids_are_rejected() {
    let mut none = axes();
    none[3].clear();
    match OrderLawGrid::new(&none, &two_link(), &INPUTS) {
        Err(Error::EmptyOrderGrid { reason }) => assert_eq!(reason, "free order 3 has no value"),
        other => panic!("{other:?}"),
    }
    let fine: Vec<f64> = (0..100).map(|i| 0.01 * f64::from(i)).collect();
    let found = OrderLawGrid::new(&vec![fine; 5], &two_link(), &INPUTS);
    assert_eq!(found.err(), Some(Error::OrderGridTooLarge { count: 10_000_000_000, limit: MAX_TUPLES }));
}

/// Every tuple by the plain way: each equation fitted and run on its own.
fn enumerate_tuples(records: &[Record], lattice: &OrderLawGrid, options: &Options) -> Vec<(f64, u64)> {
    let scales = scales(records);
    let mut all = Vec::new();
    for index in 0..lattice.product() {
        let Some(structures) = lattice.structures(index) else { continue };
        let mut score = 0.0;
        for (structure, scale) in structures.into_iter().zip(&scales) {
            let output = structure.output;
            let fixed = vec![None; structure.terms.len()];
            let fit = least_squares::fit(records, &structure, &fixed, &options.initial).unwrap();
            let equation = Equation { structure, coefficients: fit.coefficients };
            let (mut sum, mut samples) = (0.0, 0);
            for (record, initial) in records.iter().zip(&fit.initial) {
                let terms: Vec<(f64, f64)> = fit.exponents.iter().copied().zip(initial.iter().copied()).collect();
                let errors: Vec<f64> = match options.criterion {
                    Criterion::OutputError => {
                        let y = respond(std::slice::from_ref(&equation), record, &[terms]).unwrap().remove(0);
                        record.signal(output).iter().zip(y).map(|(a, b)| a - b).collect()
                    }
                    Criterion::EquationError => {
                        let mut errors = equation_error(&equation, record, &Initial::Rest).unwrap();
                        for (exponent, c) in terms {
                            errors.iter_mut().zip(record.initial_term(exponent)).for_each(|(e, v)| *e -= c * v);
                        }
                        errors
                    }
                };
                sum += errors.iter().map(|e| if options.norm == Norm::L1 { e.abs() } else { e * e }).sum::<f64>();
                samples += errors.len();
            }
            score += if options.norm == Norm::L1 { sum } else { (sum / samples as f64).sqrt() } / scale;
        }
        all.push((score, index));
    }
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all
}

#[test]
fn the_joined_tables_are_the_enumeration() {
    let lattice = OrderLawGrid::new(&axes(), &two_link(), &INPUTS).unwrap();
    let one = vec![data(400, 0.01, 50)];
    let two = vec![data(300, 0.01, 51), data(200, 0.02, 52)];
    let mut worst = 0.0_f64;
    for (records, change) in [
        (&one, options()),
        (&one, Options { norm: Norm::L2, ..options() }),
        (&two, options()),
        (&one, Options { criterion: Criterion::EquationError, ..options() }),
        (&one, Options { initial: Initial::Powers(vec![0.0, 1.0]), ..options() }),
        (&two, Options { norm: Norm::L2, initial: Initial::Caputo, ..options() }),
    ] {
        let naive = enumerate_tuples(records, &lattice, &change);
        let found = run(records, &lattice, &change);
        assert_eq!(found.counts.candidates, naive.len() as u64);
        for (row, (score, _)) in found.rows.iter().zip(&naive) {
            // The row itself, and the one that enumeration has at this place: another only where they all but tie.
            let (own, _) = naive.iter().find(|(_, index)| *index == row.index).unwrap();
            worst = worst.max((row.score / own - 1.0).abs()).max((row.score / score - 1.0).abs());
            assert_eq!(row.free, lattice.free(row.index));
            assert_eq!(Some(&row.structures), lattice.structures(row.index).as_ref());
            let parts: f64 = row.rows.iter().zip(scales(records)).map(|(part, scale)| part.score / scale).sum();
            assert!((parts / row.score - 1.0).abs() < 1e-12);
        }
        assert!(found.rows.windows(2).all(|p| (p[0].score, p[0].index) < (p[1].score, p[1].index)));
    }
    // A Gram matrix squares the condition of its columns; the enumeration solves by QR.
    check("stage score against enumeration", worst, 1e-5);
}

/// Laws of some free orders, drawn: orders that depend on none, one or several of them.
fn random_laws(random: &mut Random, free: usize, outputs: &[usize]) -> Vec<LawEquation> {
    let mut order = |low: f64, high: f64, single: Option<usize>| {
        let mut weights = vec![0.0; free];
        let mut constant = (random.uniform(low, high) * 20.0).round() / 20.0;
        if let Some(axis) = single {
            (constant, weights[axis]) = (0.0, 1.0);
        } else {
            for weight in &mut weights {
                if random.chance(0.5) {
                    *weight = [-1.0, 0.5, 1.0, 2.0][random.below(4)];
                    constant -= *weight;
                }
            }
        }
        AffineOrder { constant, weights }
    };
    outputs
        .iter()
        .map(|&output| LawEquation {
            output,
            order: order(1.8, 2.4, None),
            terms: vec![
                (output, order(0.0, 1.5, Some(output % free))),
                (output, order(0.0, 1.5, None)),
                (2, order(0.0, 1.0, None)),
            ],
        })
        .collect()
}

#[test]
fn join_of_any_order_law_matches_enumeration() {
    let mut random = Random::new(80);
    let (mut tuples, mut shared, mut worst) = (0, 0, 0.0_f64);
    for round in 0..90 {
        let free = 1 + random.below(4);
        let axes: Vec<Vec<f64>> =
            (0..free).map(|_| (0..1 + random.below(4)).map(|_| 0.8 + 0.1 * random.below(5) as f64).collect()).collect();
        let outputs: &[usize] = if round % 3 == 0 { &[1] } else { &[0, 1] };
        let lattice = OrderLawGrid::new(&axes, &random_laws(&mut random, free, outputs), &INPUTS).unwrap();
        let records = [data(120, 0.02, 81 + round)];
        let fixed = vec![vec![None; 3]; outputs.len()];
        let scales = &scales(&records)[..outputs.len()];
        let options = Options { top: 1 + random.below(9), threads: 1 + random.below(3), ..options() };
        let of = |o: &Options| search(&records, &lattice, &fixed, scales, o, &Control::default());
        let valid = (0..lattice.product()).filter(|&i| lattice.structures(i).is_some()).count() as u64;
        if valid == 0 {
            assert!(matches!(of(&options), Err(Error::EmptyOrderGrid { .. })));
            continue;
        }
        let (found, brute) = (of(&options).unwrap(), of(&Options { pruning: false, ..options.clone() }).unwrap());
        assert_eq!(found.counts.candidates, valid);
        assert_eq!(found.rows, brute.rows);
        let naive = enumerate_tuples(&records, &lattice, &options);
        let finite = |row: &&(f64, u64)| row.0.is_finite();
        for (row, (score, _)) in found.rows.iter().zip(naive.iter().filter(finite)) {
            let (own, _) = naive.iter().find(|(_, index)| *index == row.index).unwrap();
            // What grows beyond all measure differs by its rounding.
            if row.score < 10.0 {
                worst = worst.max((row.score / own - 1.0).abs()).max((row.score / score - 1.0).abs());
            }
        }
        tuples += valid;
        shared += u64::from(found.distinct.iter().any(|&d| d < valid));
    }
    println!("{tuples} tuples, orders shared in {shared} laws");
    assert!(tuples > 300 && shared > 5);
    check("joined scores against enumeration", worst, 1e-5);
}

#[test]
fn distinct_orders_are_evaluated_once() {
    let lattice = OrderLawGrid::new(&axes(), &two_link(), &INPUTS).unwrap();
    let found = run(&[data(200, 0.01, 53)], &lattice, &options());
    let mut distinct = [HashSet::new(), HashSet::new()];
    for structures in (0..lattice.product()).filter_map(|i| lattice.structures(i)) {
        for (set, s) in distinct.iter_mut().zip(structures) {
            let orders: Vec<i64> = s.terms.iter().map(|t| grains(t.order)).collect();
            set.insert((grains(s.order), orders));
        }
    }
    assert_eq!(found.distinct, distinct.map(|set| set.len() as u64));
    assert!(found.distinct[1] < found.counts.candidates);
}

#[test]
fn early_stopping_and_threads_change_nothing() {
    let lattice = OrderLawGrid::new(&fine_axes(), &two_link(), &INPUTS).unwrap();
    let innovation = Innovation { length: 5, prior: Prior::Absolute(100.0), row_basis: RowBasis::Haar };
    let mut stopped = 0;
    for (seed, change) in [
        (60, options()),
        (61, Options { top: 1, ..options() }),
        (62, Options { norm: Norm::L2, top: 3, ..options() }),
        // More rows than tuples: nothing may be left early for good.
        (63, Options { top: 100_000, ..options() }),
        (64, Options { estimator: Estimator::MultiInnovation(innovation), ..options() }),
        (65, Options { criterion: Criterion::EquationError, top: 5, ..options() }),
        (66, Options { initial: Initial::Caputo, top: 4, ..options() }),
    ] {
        let records = [data(256, 0.02, seed)];
        let one = run(&records, &lattice, &Options { threads: 1, ..change.clone() });
        let brute = run(&records, &lattice, &Options { pruning: false, ..change.clone() });
        assert_eq!(brute.counts.stopped, 0);
        assert_eq!(one.rows, brute.rows, "seed {seed}");
        for (a, b) in one.rows.iter().zip(&brute.rows) {
            assert_eq!(a.score.to_bits(), b.score.to_bits());
            for (a, b) in a.rows.iter().zip(&b.rows) {
                assert_eq!(bits(&a.coefficients), bits(&b.coefficients));
            }
        }
        for threads in [2, 3, 8] {
            assert_eq!(run(&records, &lattice, &Options { threads, ..change.clone() }), one, "seed {seed}");
        }
        stopped += one.counts.stopped;
    }
    println!("{stopped} tuples left early");
    assert!(stopped > 500);
}

#[test]
fn candidates_can_be_simulated_in_any_blocks_and_order() {
    let records = [data(128, 0.02, 6)];
    let lattice = OrderLawGrid::new(&fine_axes(), &two_link(), &INPUTS).unwrap();
    let (options, control) = (options(), Control::default());
    let expected = run(&records, &lattice, &options);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    let make = || {
        let lattice = std::borrow::Cow::Borrowed(&lattice);
        CoupledSearch::new(&records, lattice, &free_coefficients(), &scales(&records), &options, &pool, &control)
            .unwrap()
    };
    let ((stage, mut course), (elsewhere, _)) = (make(), make());
    let (mut waves, mut followed) = (0, 0);
    while !course.pending_spans().is_empty() {
        assert!(stage.outcome(&course, &control).is_err());
        // Each candidate by itself, the last first, by turns in two places.
        let mut verdicts = Vec::new();
        for span in course.pending_spans().iter().rev() {
            for first in (span.first..span.last).rev() {
                let one = Span { first, last: first + 1, ..*span };
                let place = if verdicts.len() % 2 == 0 { &stage } else { &elsewhere };
                verdicts.extend(place.evaluate(&[one], &pool, &control).unwrap());
            }
        }
        verdicts.reverse();
        assert!(course.record_verdicts(&stage, &verdicts[1..], &pool, &control).is_err());
        followed += verdicts.len() as u64;
        course.record_verdicts(&stage, &verdicts, &pool, &control).unwrap();
        waves += 1;
    }
    assert!(waves > 3);
    assert_eq!(followed, course.total());
    assert_eq!(stage.outcome(&course, &control).unwrap(), expected);
    assert_eq!(course.best(), Some(expected.rows[0].score));
    for span in [(2, 0, 1, 1.0), (0, 0, 1 << 40, 1.0), (0, 3, 2, 1.0), (0, 0, 1, f64::NAN)] {
        let span = Span { equation: span.0, first: span.1, last: span.2, limit: span.3 };
        assert!(matches!(stage.evaluate(&[span], &pool, &control), Err(Error::Structure { .. })));
    }
}

#[test]
fn true_orders_are_found_under_their_law() {
    let lattice = OrderLawGrid::new(&axes(), &two_link(), &INPUTS).unwrap();
    let found = run(&[data(600, 0.0, 70)], &lattice, &options());
    assert_eq!(found.rows[0].free, [2.0, 2.0, 0.95, 0.1, 0.85]);
    assert!(found.rows[1].score > 1e3 * found.rows[0].score);
    assert!(relative_distance(&found.rows[0].rows[1].coefficients, &[-85.0, 6.0, -2.0, -14.0]) < 1e-5);
}

#[test]
fn equations_of_very_different_weight_are_joined() {
    // One equation weighs so little that its score is lost in the rounding of the sum.
    let lattice = OrderLawGrid::new(&fine_axes(), &two_link(), &INPUTS).unwrap();
    let records = [data(200, 1e-4, 71)];
    for scales in [[1e20, 1.0], [1.0, 1e20], [1e-20, 1.0]] {
        for keep in [1, 5] {
            let change = Options { top: keep, ..options() };
            let of = |o: &Options| {
                search(&records, &lattice, &free_coefficients(), &scales, o, &Control::default()).unwrap()
            };
            let brute = of(&Options { pruning: false, ..change.clone() });
            assert_eq!(of(&change).rows, brute.rows, "scales {scales:?}");
        }
    }
}

#[test]
fn singular_and_diverged_tuples_are_counted() {
    let lattice = OrderLawGrid::new(&axes(), &two_link(), &INPUTS).unwrap();
    let tuples = (0..lattice.product()).filter(|&i| lattice.structures(i).is_some()).count() as u64;
    let base = data(2000, 0.01, 72);
    // A current that never flows.
    let silent = with_signal(&base, 2, vec![0.0; 2000]);
    let found = search(&[silent], &lattice, &free_coefficients(), &[1.0; 2], &options(), &Control::default()).unwrap();
    assert_eq!((found.counts.singular, found.counts.candidates, found.rows.len()), (tuples, tuples, 0));
    let accepted: Vec<u64> = (0..lattice.product()).filter(|&i| lattice.structures(i).is_some()).collect();
    let listed: Vec<(u64, Failure)> = accepted.iter().map(|&i| (i, Failure::Singular)).collect();
    assert_eq!(found.failures, listed);
    // More than are listed one by one.
    let fine = OrderLawGrid::new(&fine_axes(), &two_link(), &INPUTS).unwrap();
    for threads in [1, 3] {
        let options = Options { threads, ..options() };
        let found = search(
            &[with_signal(&base, 2, vec![0.0; 2000])],
            &fine,
            &free_coefficients(),
            &[1.0; 2],
            &options,
            &Control::default(),
        );
        let first = (0..fine.product()).filter(|&i| fine.structures(i).is_some()).take(100);
        assert_eq!(found.unwrap().failures, first.map(|i| (i, Failure::Singular)).collect::<Vec<_>>());
    }
    // Known coefficients with which every run explodes.
    let mut fixed = free_coefficients();
    (fixed[1][0], fixed[1][2]) = (Some(2e3), Some(0.0));
    let found = search(&[base], &lattice, &fixed, &[1.0; 2], &options(), &Control::default()).unwrap();
    assert_eq!((found.counts.diverged, found.counts.candidates, found.rows.len()), (tuples, tuples, 0));
    assert!(found.failures.iter().all(|f| f.1 == Failure::Diverged));
    assert_eq!(found.failures.len() as u64, tuples);
}

#[test]
fn coupled_search_ends_after_a_stop_request_and_checks_its_arguments() {
    let lattice = OrderLawGrid::new(&axes(), &two_link(), &INPUTS).unwrap();
    let records = [data(100, 0.01, 73)];
    let control = Control::default();
    control.stop.set();
    let found = search(&records, &lattice, &free_coefficients(), &[1.0; 2], &options(), &control);
    assert_eq!(found, Err(Error::Interrupted));
    let run = |fixed: &[Vec<Option<f64>>], scales: &[f64], options: &Options| {
        search(&records, &lattice, fixed, scales, options, &Control::default()).unwrap_err()
    };
    assert!(matches!(run(&free_coefficients()[..1], &[1.0; 2], &options()), Error::Length { .. }));
    assert!(matches!(run(&[vec![None; 4], vec![None; 3]], &[1.0; 2], &options()), Error::Length { .. }));
    assert!(matches!(run(&free_coefficients(), &[1.0], &options()), Error::Length { .. }));
    assert!(matches!(
        run(&free_coefficients(), &[1.0; 2], &Options { threads: 0, ..options() }),
        Error::OutOfRange { .. }
    ));
    assert!(matches!(run(&free_coefficients(), &[1.0; 2], &Options { top: 0, ..options() }), Error::OutOfRange { .. }));
    let none = search(&[], &lattice, &free_coefficients(), &[1.0; 2], &options(), &Control::default());
    assert!(matches!(none, Err(Error::Length { .. })));
}
