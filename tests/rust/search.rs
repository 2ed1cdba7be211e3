//! Order searches over one equation: the lattice itself, early stopping against brute force, any number of threads, and
//! every candidate against a naive evaluation.

use std::sync::atomic::Ordering;

use ftlm::equation::{Equation, Initial, Structure};
use ftlm::error::{Error, Kind};
use ftlm::estimation::instrumental_variables::InstrumentalSettings;
use ftlm::estimation::least_squares::{self, Estimate};
use ftlm::estimation::multi_innovation::{closed_form, Innovation, Prior, RowBasis};
use ftlm::order_search::batches::search;
use ftlm::order_search::control::Control;
use ftlm::order_search::grid::{OrderGrid, TermAxis, MAX_CANDIDATES};
use ftlm::order_search::options::{Criterion, Estimator, Norm, Options};
use ftlm::order_search::result::{Counts, Failure, Outcome};
use ftlm::parallel::MAX_THREADS;
use ftlm::regressors::Record;
use ftlm::simulate::{equation_error, respond};
use proptest::prelude::*;

use crate::common::{bits, cases, check, equation, record, relative_distance, with_signal, Random};

/// start, start + step, … up to end, as people write them.
fn range(start: f64, end: f64, step: f64) -> Vec<f64> {
    (0..).map(|i| start + f64::from(i) * step).take_while(|v| *v <= end + 1e-9).collect()
}

fn axis(signal: usize, values: &[f64], interchangeable: bool) -> TermAxis {
    TermAxis { signal, values: values.to_vec(), interchangeable }
}

fn options() -> Options {
    Options {
        criterion: Criterion::OutputError,
        norm: Norm::L1,
        estimator: Estimator::LeastSquares,
        initial: Initial::Rest,
        top: 10,
        threads: 2,
        pruning: true,
        memory: 2 << 30,
    }
}

fn total(counts: &Counts) -> u64 {
    counts.table_rows + counts.beaten + counts.excluded_by_bound + counts.stopped + counts.singular + counts.diverged
}

// ---------------------------------------------------------------------------------------------------------- lattices

#[test]
fn the_first_lattice_of_the_paper_has_its_size() {
    // P1: one deflection equation, two free orders of its own, one of the hub angle, the current at order 0.
    let all = range(0.0, 2.0, 0.05);
    let axes = [axis(0, &all, true), axis(0, &all, true), axis(1, &all, false), axis(2, &[0.0], false)];
    let lattice = OrderGrid::new(0, &range(1.05, 2.0, 0.05), &axes, |s| s == 2).unwrap();
    assert_eq!(lattice.count(), 313_845);
    assert_eq!(lattice.output(), 0);
    // Written out: for each alpha the pairs of its own orders below it, times the hub's orders up to it.
    let sum: u64 = (21..=40u64).map(|below| below * (below - 1) / 2 * (below + 1)).sum();
    assert_eq!(sum, 313_845);
}

/// All structures of a lattice from its definition: nested loops, filtered.
fn enumerate_orders(output: usize, alphas: &[f64], axes: &[TermAxis], input: usize) -> Vec<Vec<i64>> {
    let key = |v: f64| ftlm::equation::grains(v);
    let mut found = std::collections::BTreeSet::new();
    for &alpha in alphas {
        let mut tuples: Vec<Vec<f64>> = vec![vec![]];
        for axis in axes {
            tuples = tuples.iter().flat_map(|t| axis.values.iter().map(|&v| [t.clone(), vec![v]].concat())).collect();
        }
        'tuples: for mut tuple in tuples {
            for (axis, &v) in axes.iter().zip(&tuple) {
                let lowest = if axis.signal == input { -3.0 } else { 0.0 };
                let fits = v >= lowest && if axis.signal == output { v < alpha - 1e-9 } else { v <= alpha + 1e-9 };
                if !fits {
                    continue 'tuples;
                }
            }
            for a in 0..axes.len() {
                for b in a + 1..axes.len() {
                    if axes[a].signal == axes[b].signal {
                        if key(tuple[a]) == key(tuple[b]) {
                            continue 'tuples;
                        }
                        // The larger order first stands for both.
                        if axes[a].interchangeable && axes[b].interchangeable && tuple[a] < tuple[b] {
                            tuple.swap(a, b);
                        }
                    }
                }
            }
            found.insert([vec![key(alpha)], tuple.iter().map(|&v| key(v)).collect()].concat());
        }
    }
    found.into_iter().collect()
}

#[test]
fn order_grids_contain_every_structure_once() {
    let own = range(0.0, 1.8, 0.3);
    for (alphas, axes) in [
        (vec![1.0, 1.5], vec![axis(0, &own, false)]),
        (range(0.9, 1.8, 0.3), vec![axis(0, &own, true), axis(0, &own, true), axis(1, &own, false)]),
        (range(0.9, 1.8, 0.3), vec![axis(0, &own, false), axis(0, &own, false), axis(2, &[-0.5, 0.0, 0.5], false)]),
        (vec![1.2, 1.8], vec![axis(1, &own, true), axis(0, &own, true), axis(1, &own, true), axis(1, &own, true)]),
        // Values out of range for the smaller alpha, in no particular order and given twice.
        (vec![1.8, 0.6, 0.6], vec![axis(0, &[1.5, 0.3, 0.9, 0.3, -0.3], false), axis(1, &[1.8, 0.0], false)]),
    ] {
        let lattice = OrderGrid::new(0, &alphas, &axes, |s| s == 2).unwrap();
        let keys: Vec<Vec<i64>> = (0..lattice.count())
            .map(|i| {
                let s = lattice.structure(i);
                assert_eq!(s.check(3, |s| s == 2), Ok(()));
                assert!(s.terms.iter().zip(&axes).all(|(t, a)| t.signal == a.signal));
                std::iter::once(s.order).chain(s.terms.iter().map(|t| t.order)).map(ftlm::equation::grains).collect()
            })
            .collect();
        let mut sorted = keys.clone();
        sorted.sort_unstable();
        assert_eq!(sorted, enumerate_orders(0, &alphas, &axes, 2));
        // Ascending in alpha: an index means the same candidate whatever happens later in the lattice.
        assert!(keys.windows(2).all(|p| p[0][0] <= p[1][0]));
    }
}

#[test]
fn terms_with_different_axes_swap_only_where_both_may() {
    // (0.3, 0.6) and (0.6, 0.3) are one candidate, (0.0, 0.6) has no twin.
    let axes = [axis(0, &[0.0, 0.3, 0.6], true), axis(0, &[0.3, 0.6], true)];
    let lattice = OrderGrid::new(0, &[1.0], &axes, |_| false).unwrap();
    assert_eq!(lattice.count(), 3);
    // A fixed coefficient ties a term to its place: not interchangeable.
    let axes = [axis(0, &[0.3, 0.6], false), axis(0, &[0.3, 0.6], true)];
    assert_eq!(OrderGrid::new(0, &[1.0], &axes, |_| false).unwrap().count(), 2);
}

#[test]
fn empty_and_oversized_order_grids_report_the_reason() {
    let reason = |alphas: &[f64], axes: &[TermAxis]| match OrderGrid::new(0, alphas, axes, |_| false) {
        Err(Error::EmptyOrderGrid { reason }) => reason,
        other => panic!("{other:?}"),
    };
    assert_eq!(reason(&[], &[axis(0, &[0.0], false)]), "no value of alpha");
    assert_eq!(reason(&[0.5], &[axis(0, &[0.5, 0.7], false)]), "no orders of signal 0 fit below alpha = 0.5");
    assert_eq!(reason(&[0.5], &[axis(1, &[], false)]), "no orders of signal 1 fit below alpha = 0.5");
    assert_eq!(
        reason(&[1.0], &[axis(0, &[0.5], true), axis(0, &[0.5], true)]),
        "no orders of signal 0 fit below alpha = 1"
    );
    for alpha in [0.0, -1.0, 10.05] {
        assert!(
            matches!(OrderGrid::new(0, &[1.0, alpha], &[], |_| false), Err(Error::OutOfRange { value, .. }) if value == alpha)
        );
    }
    // Too many, within one signal and as a product of signals: refused from the lengths alone, at once.
    let many = range(0.0, 3.0, 0.0005);
    for signals in [[1, 1, 1, 1], [1, 1, 2, 2], [1, 2, 3, 4]] {
        let axes: Vec<TermAxis> = signals.iter().map(|&s| axis(s, &many, true)).collect();
        let found = OrderGrid::new(0, &range(0.001, 3.0, 0.001), &axes, |_| false).map(|l| l.count());
        assert!(matches!(found, Err(Error::OrderGridTooLarge { count, limit: MAX_CANDIDATES }) if count > 1 << 50));
        assert_eq!(found.unwrap_err().kind(), Kind::Model);
    }
    // Past the limit only once it is counted.
    let some = range(0.0, 0.16, 0.001);
    let mut axes: Vec<TermAxis> = (0..3).map(|_| axis(1, &some, true)).collect();
    let alphas = range(1.0, 1.5, 0.01);
    assert_eq!(OrderGrid::new(0, &alphas, &axes, |_| false).unwrap().count(), 51 * (161 * 160 * 159 / 6));
    axes.push(axis(2, &range(0.0, 0.6, 0.002), false));
    let found = OrderGrid::new(0, &alphas, &axes, |_| false).map(|l| l.count());
    assert!(matches!(found, Err(Error::OrderGridTooLarge { count, .. }) if count < 2 * MAX_CANDIDATES));
    // An equation without terms is its alphas.
    assert_eq!(OrderGrid::new(0, &[1.0, 2.0], &[], |_| false).unwrap().count(), 2);
}

// ---------------------------------------------------------------------------------------------------------- problems

/// A small search: signal 0 is the output, 1 another output, 2 an input.
struct Problem {
    records: Vec<Record>,
    lattice: OrderGrid,
    fixed: Vec<Option<f64>>,
    options: Options,
}

impl Problem {
    fn run(&self, change: impl FnOnce(&mut Options)) -> Outcome {
        let mut options = self.options.clone();
        change(&mut options);
        let control = Control::default();
        let outcome = search(&self.records, &self.lattice, &self.fixed, &options, &control).unwrap();
        assert_eq!(outcome.counts.candidates, self.lattice.count());
        assert_eq!(total(&outcome.counts), outcome.counts.candidates);
        assert_eq!(outcome.counts.table_rows, outcome.rows.len() as u64);
        assert_eq!(control.finished_count.load(Ordering::Relaxed), self.lattice.count());
        assert_eq!(control.total.load(Ordering::Relaxed), self.lattice.count());
        outcome
    }
}

pub fn truth() -> Equation {
    equation(0, 1.6, &[(0, 0.9, -2.0), (0, 0.0, -9.0), (1, 0.3, 1.5), (2, 0.0, 6.0)])
}

/// A record that nearly obeys `truth`.
pub fn data(random: &mut Random, m: usize, step: f64, noise: f64) -> Record {
    let rest = record(step, vec![vec![0.0; m], random.steps(m, 40), random.steps(m, 25)]);
    let initial = if random.chance(0.5) { vec![(0.0, random.uniform(-0.5, 0.5))] } else { vec![] };
    let mut y = respond(&[truth()], &rest, &[initial]).unwrap().remove(0);
    y.iter_mut().for_each(|v| *v += noise * random.normal());
    with_signal(&rest, 0, y)
}

/// A problem with everything at random: structure, data, coefficients known, criterion, norm, estimator, initial terms.
fn random_problem(seed: u64) -> Problem {
    let mut random = Random::new(seed);
    let haar = random.chance(0.3);
    let records = (0..1 + random.below(2))
        .map(|_| {
            let m = if haar { 128 << random.below(2) } else { 90 + random.below(200) };
            let step = random.uniform(0.01, 0.03);
            data(&mut random, m, step, 0.02)
        })
        .collect();
    let grain = [0.1, 0.15, 0.2][random.below(3)];
    let mut axes = vec![axis(0, &range(0.0, 2.0, grain), true)];
    if random.chance(0.6) {
        axes.push(axis(0, &range(0.0, 1.4, 2.0 * grain), true));
    }
    axes.push(axis(1, &range(0.0, 2.0, 2.0 * grain), false));
    axes.push(axis(2, if random.chance(0.5) { &[0.0] } else { &[-0.3, 0.0, 0.3] }, false));
    let mut fixed: Vec<Option<f64>> = vec![None; axes.len()];
    if random.chance(0.3) {
        // A known coefficient cannot be swapped.
        axes[0].interchangeable = false;
        fixed[0] = Some(random.uniform(-12.0, 0.5));
    }
    if random.chance(0.3) {
        fixed[axes.len() - 1] = Some(6.0);
    }
    let lattice = OrderGrid::new(0, &range(1.0, 1.8, 2.0 * grain), &axes, |s| s == 2).unwrap();
    let options = Options {
        criterion: if random.chance(0.7) { Criterion::OutputError } else { Criterion::EquationError },
        norm: if random.chance(0.5) { Norm::L1 } else { Norm::L2 },
        estimator: if haar || random.chance(0.2) {
            let rows = if haar { RowBasis::Haar } else { RowBasis::Time };
            let prior = if random.below(2) == 0 {
                Prior::WEAK
            } else {
                Prior::Absolute(10.0_f64.powf(random.uniform(0.0, 6.0)))
            };
            Estimator::MultiInnovation(Innovation { length: 1 + random.below(9), prior, row_basis: rows })
        } else {
            Estimator::LeastSquares
        },
        initial: match random.below(3) {
            0 => Initial::Rest,
            1 => Initial::Caputo,
            _ => Initial::Powers(vec![0.0, 1.0]),
        },
        top: 1 + random.below(8),
        threads: 1,
        pruning: true,
        memory: 2 << 30,
    };
    Problem { records, lattice, fixed, options }
}

/// What a candidate comes to by the plain way: a QR fit on all records, then a run or the residuals of each.
fn naive(problem: &Problem, structure: &Structure) -> Result<(f64, Estimate), Failure> {
    let Problem { records, fixed, options, .. } = problem;
    let estimate = match &options.estimator {
        Estimator::LeastSquares => least_squares::fit(records, structure, fixed, &options.initial),
        Estimator::MultiInnovation(i) => closed_form(records, structure, fixed, &options.initial, i),
        Estimator::InstrumentalVariables(_) => panic!("instrumental variables have a test of their own"),
    };
    let estimate = estimate.map_err(|_| Failure::Singular)?;
    let equation = Equation { structure: structure.clone(), coefficients: estimate.coefficients.clone() };
    let (mut sum, mut samples) = (0.0, 0);
    for (record, initial) in records.iter().zip(&estimate.initial) {
        let terms: Vec<(f64, f64)> = estimate.exponents.iter().copied().zip(initial.iter().copied()).collect();
        let errors: Vec<f64> = match options.criterion {
            Criterion::OutputError => {
                let y = respond(std::slice::from_ref(&equation), record, &[terms]).unwrap().remove(0);
                record.signal(0).iter().zip(y).map(|(a, b)| a - b).collect()
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
    if !sum.is_finite() {
        return Err(Failure::Diverged);
    }
    let score = if options.norm == Norm::L1 { sum } else { (sum / samples as f64).sqrt() };
    Ok((score, estimate))
}

#[test]
fn stop_request_ends_the_setup_of_a_search() {
    // Candidates are counted once what they share has been made.
    let made = |told: bool| {
        let problem = random_problem(100);
        let control = Control::default();
        if told {
            control.stop.set();
        }
        let fixed = vec![None; problem.lattice.width()];
        let found = search(&problem.records, &problem.lattice, &fixed, &Options::default(), &control);
        assert_eq!(matches!(found, Err(Error::Interrupted)), told);
        control.total.load(Ordering::Relaxed)
    };
    assert!(made(false) > 0);
    assert_eq!(made(true), 0);
}

#[test]
fn early_stopping_and_threads_change_nothing() {
    let (mut bounded, mut stopped, mut candidates) = (0, 0, 0);
    for seed in 100..140 {
        let problem = random_problem(seed);
        let brute = problem.run(|o| o.pruning = false);
        assert_eq!(brute.counts.stopped, 0);
        let one = problem.run(|_| {});
        assert_eq!(one.rows.len(), brute.rows.len(), "seed {seed}");
        for (a, b) in one.rows.iter().zip(&brute.rows) {
            assert_eq!(a, b, "seed {seed}");
            // Equality would let 0 pass for −0.
            assert_eq!(a.score.to_bits(), b.score.to_bits());
            assert_eq!(bits(&a.coefficients), bits(&b.coefficients));
        }
        for threads in [2, 3, 8] {
            assert_eq!(problem.run(|o| o.threads = threads), one, "seed {seed}, {threads} threads");
        }
        assert_eq!(problem.run(|o| (o.threads, o.pruning) = (3, false)), brute);
        bounded += one.counts.excluded_by_bound;
        stopped += one.counts.stopped;
        candidates += one.counts.candidates;
    }
    println!("of {candidates} candidates {bounded} excluded by their bound, {stopped} left early");
    assert!(stopped + bounded > candidates / 5 && bounded > candidates / 10 && stopped > candidates / 50);
}

#[test]
fn blocks_of_one_term_rank_like_brute_force() {
    let (mut bounded, mut candidates) = (0, 0);
    for seed in 300..312 {
        let mut problem = random_problem(seed);
        let mut random = Random::new(seed);
        let grain = [0.05, 0.04, 1e-4][seed as usize % 3];
        let own = [axis(0, &range(0.0, 25.0 * grain, grain), true), axis(0, &range(0.0, 20.0 * grain, grain), true)];
        let others = [axis(1, &range(0.0, 40.0 * grain, grain), false), axis(2, &[-0.3, 0.0], false)];
        // What changes last is the only term of its signal, or the second of two of one, where some pairs are left out.
        let axes = if random.chance(0.5) { [&own[..], &others[..]] } else { [&others[1..], &own[..]] }.concat();
        problem.lattice = OrderGrid::new(0, &[1.0, 1.4, 1.75], &axes, |s| s == 2).unwrap();
        problem.fixed = vec![None; axes.len()];
        let options = &mut problem.options;
        (options.criterion, options.norm, options.initial) = (Criterion::EquationError, Norm::L2, Initial::Rest);
        let brute = problem.run(|o| o.pruning = false);
        let one = problem.run(|_| {});
        assert_eq!(one.rows, brute.rows, "seed {seed}");
        assert_eq!(one.counts.singular, brute.counts.singular, "seed {seed}");
        assert_eq!(one.failures, brute.failures, "seed {seed}");
        assert_eq!(problem.run(|o| o.threads = 3), one, "seed {seed}");
        bounded += one.counts.excluded_by_bound;
        candidates += one.counts.candidates;
    }
    println!("of {candidates} candidates {bounded} excluded");
    assert!(bounded > candidates / 2);
}

#[test]
fn every_candidate_matches_its_naive_evaluation() {
    let (mut worst, mut worst_coefficient, mut compared) = (0.0_f64, 0.0_f64, 0);
    for seed in 200..230 {
        let mut problem = random_problem(seed);
        // Coarser, so that regressors are well apart and the naive way has time for all.
        let axes = [
            axis(0, &[0.0, 0.5, 0.9], true),
            axis(0, &[0.0, 0.9], true),
            axis(1, &[0.0, 0.3, 1.0], false),
            axis(2, &[-0.3, 0.0], false),
        ];
        problem.lattice = OrderGrid::new(0, &[1.2, 1.6, 1.9], &axes, |s| s == 2).unwrap();
        problem.fixed = (0..4).map(|k| if k == 3 && seed % 3 == 0 { Some(6.0) } else { None }).collect();
        let found = problem.run(|o| (o.top, o.pruning) = (1000, false));
        let mut singular = 0;
        let mut diverged = 0;
        for index in 0..problem.lattice.count() {
            let structure = problem.lattice.structure(index);
            let row = found.rows.iter().find(|r| r.index == index);
            match naive(&problem, &structure) {
                Err(failure) => {
                    assert!(row.is_none());
                    assert!(found.failures.contains(&(index, failure)));
                    match failure {
                        Failure::Singular => singular += 1,
                        Failure::Diverged => diverged += 1,
                    }
                }
                Ok((score, estimate)) => {
                    let row = row.unwrap();
                    worst = worst.max((row.score / score - 1.0).abs());
                    worst_coefficient =
                        worst_coefficient.max(relative_distance(&row.coefficients, &estimate.coefficients));
                    assert_eq!(row.initial.len(), estimate.initial.len());
                    compared += 1;
                }
            }
        }
        assert_eq!((found.counts.singular, found.counts.diverged), (singular, diverged));
        // Best first.
        assert!(found.rows.windows(2).all(|p| (p[0].score, p[0].index) < (p[1].score, p[1].index)));
    }
    println!("{compared} candidates compared");
    // A Gram matrix squares the condition of its columns; QR does not.
    check("score against naive evaluation", worst, 1e-5);
    check("coefficients against naive evaluation", worst_coefficient, 1e-5);
}

#[test]
fn a_search_finds_the_truth_among_its_neighbours() {
    let mut random = Random::new(240);
    let rest = record(0.02, vec![vec![0.0; 600], random.steps(600, 40), random.steps(600, 25)]);
    let y = respond(&[truth()], &rest, &[]).unwrap().remove(0);
    let records = vec![with_signal(&rest, 0, y)];
    let axes = [
        axis(0, &range(0.0, 2.0, 0.1), true),
        axis(0, &range(0.0, 2.0, 0.1), true),
        axis(1, &range(0.0, 2.0, 0.1), false),
        axis(2, &[0.0], false),
    ];
    let lattice = OrderGrid::new(0, &range(1.1, 2.0, 0.1), &axes, |s| s == 2).unwrap();
    let problem = Problem { records, lattice, fixed: vec![None; 4], options: options() };
    let found = problem.run(|_| {});
    let best = problem.lattice.structure(found.rows[0].index);
    let orders: Vec<f64> = best.terms.iter().map(|t| t.order).collect();
    assert_eq!((best.order, orders), (1.6, vec![0.9, 0.0, 0.3, 0.0]));
    check("error at the truth", found.rows[0].score, 1e-6);
    assert!(relative_distance(&found.rows[0].coefficients, &truth().coefficients) < 1e-6);
    assert!(found.rows[1].score > 1e4 * found.rows[0].score);
    assert!(found.counts.excluded_by_bound + found.counts.stopped > found.counts.candidates * 9 / 10);
}

#[test]
fn ties_go_to_the_smaller_index() {
    // No coefficient is free and all are zero: every candidate scores the measurement itself.
    let mut random = Random::new(241);
    let records = vec![data(&mut random, 100, 0.02, 0.0)];
    let axes = [axis(0, &range(0.0, 1.0, 0.02), false), axis(1, &range(0.0, 1.0, 0.05), false)];
    let lattice = OrderGrid::new(0, &[1.5, 1.7], &axes, |_| false).unwrap();
    assert_eq!(lattice.count(), 2 * 51 * 21);
    let problem = Problem { records, lattice, fixed: vec![Some(0.0); 2], options: options() };
    for threads in [1, 2, 3, 8] {
        for early_stopping in [true, false] {
            let found = problem.run(|o| (o.threads, o.pruning, o.top) = (threads, early_stopping, 7));
            assert_eq!(found.rows.iter().map(|r| r.index).collect::<Vec<_>>(), (0..7).collect::<Vec<_>>());
            assert_eq!((found.counts.stopped, found.counts.beaten), (0, problem.lattice.count() - 7));
            assert!(found.rows.iter().all(|r| r.score.to_bits() == found.rows[0].score.to_bits()));
        }
    }
}

#[test]
fn singular_and_diverged_candidates_are_counted_and_listed() {
    let mut random = Random::new(242);
    let base = data(&mut random, 400, 0.05, 0.01);
    // Signal 1 is the output again: at equal orders the two cannot be told apart.
    let copied = with_signal(&base, 1, base.signal(0).to_vec());
    let values = range(0.0, 1.4, 0.2);
    let axes = [axis(0, &values, false), axis(1, &values, false), axis(2, &[0.0], false)];
    let lattice = OrderGrid::new(0, &[1.6], &axes, |s| s == 2).unwrap();
    let problem = Problem { records: vec![copied], lattice, fixed: vec![None; 3], options: options() };
    for threads in [1, 3] {
        let found = problem.run(|o| o.threads = threads);
        assert_eq!(found.counts.singular, values.len() as u64);
        let expected: Vec<(u64, Failure)> = (0..problem.lattice.count())
            .filter(|&i| {
                let s = problem.lattice.structure(i);
                s.terms[0].order == s.terms[1].order
            })
            .map(|i| (i, Failure::Singular))
            .collect();
        let singular: Vec<_> = found.failures.iter().copied().filter(|f| f.1 == Failure::Singular).collect();
        assert_eq!(singular, expected);
    }
    // A coefficient fixed where every run explodes; more failures than are listed one by one.
    let many = range(0.0, 0.6, 0.005);
    let axes = [axis(0, &many, false), axis(2, &[0.0], false)];
    let lattice = OrderGrid::new(0, &[1.6], &axes, |s| s == 2).unwrap();
    let long = vec![data(&mut random, 2000, 0.05, 0.01)];
    let problem = Problem { records: long, lattice, fixed: vec![Some(45.0), None], options: options() };
    for threads in [1, 2, 8] {
        let found = problem.run(|o| o.threads = threads);
        assert_eq!(found.counts.diverged, many.len() as u64);
        assert!(found.rows.is_empty());
        assert_eq!(found.failures, (0..100).map(|i| (i, Failure::Diverged)).collect::<Vec<_>>());
    }
    // The equation error of the same candidates is finite.
    assert_eq!(problem.run(|o| o.criterion = Criterion::EquationError).counts.diverged, 0);
}

#[test]
fn a_leading_zero_makes_a_candidate_singular() {
    // An own term whose coefficient is exactly the inverse of its kernel's first value.
    let mut random = Random::new(243);
    let record = data(&mut random, 50, 0.5, 0.0);
    let lattice = OrderGrid::new(0, &[1.0], &[axis(0, &[0.0], false)], |_| false).unwrap();
    // Order 1 at step 1/2: the kernel begins with 1/4.
    let problem = Problem { records: vec![record], lattice, fixed: vec![Some(4.0)], options: options() };
    let found = problem.run(|_| {});
    assert_eq!((found.counts.singular, found.failures), (1, vec![(0, Failure::Singular)]));
}

#[test]
fn settings_out_of_range_are_rejected() {
    let mut random = Random::new(244);
    let records = vec![data(&mut random, 100, 0.02, 0.0)];
    let lattice = OrderGrid::new(0, &[1.0], &[axis(0, &[0.0], false)], |_| false).unwrap();
    let run = |records: &[Record], fixed: &[Option<f64>], options: &Options| {
        search(records, &lattice, fixed, options, &Control::default()).unwrap_err()
    };
    assert!(matches!(run(&records, &[], &options()), Error::Length { .. }));
    assert!(matches!(run(&[], &[None], &options()), Error::Length { .. }));
    assert!(matches!(run(&records, &[None], &Options { top: 0, ..options() }), Error::OutOfRange { .. }));
    for threads in [0, MAX_THREADS + 1, 10_000] {
        assert!(matches!(run(&records, &[None], &Options { threads, ..options() }), Error::OutOfRange { .. }));
    }
    let innovation = Innovation { length: 3, prior: Prior::Absolute(1.0), row_basis: RowBasis::Haar };
    let haar = Options { estimator: Estimator::MultiInnovation(innovation), ..options() };
    assert_eq!(run(&records, &[None], &haar), Error::NotPowerOfTwo { m: 100, below: 64, above: 128 });
    let none = Innovation { length: 0, ..innovation };
    let none = Options { estimator: Estimator::MultiInnovation(none), ..options() };
    assert!(matches!(run(&records, &[None], &none), Error::OutOfRange { .. }));
    // A lattice whose regressors fit but whose products would not: refused before any of them is made.
    let many = OrderGrid::new(0, &[3.0], &[axis(1, &range(0.0, 3.0, 2e-4), false)], |_| false).unwrap();
    let found = search(&records, &many, &[None], &options(), &Control::default());
    let Err(Error::Memory { what, bytes, limit: 0x8000_0000 }) = found else { panic!("{found:?}") };
    assert!(what.starts_with("15001 regressors") && bytes > 8 * 15_001 * 15_001, "{what} {bytes}");
    let missing = OrderGrid::new(0, &[1.0], &[axis(5, &[0.0], false)], |_| false).unwrap();
    let found = search(&records, &missing, &[None], &options(), &Control::default());
    assert!(matches!(found, Err(Error::Structure { .. })));
}

#[test]
fn overflowing_kernels_are_reported_on_every_row() {
    let mut random = Random::new(62);
    // h^2 is beyond floating point.
    let record = record(1e200, vec![random.signal(64), random.signal(64)]);
    let terms = [axis(0, &[0.0, 0.5], false), axis(1, &[0.0], false)];
    let lattice = OrderGrid::new(0, &[1.8, 2.0], &terms, |s| s == 1).unwrap();
    let settings = InstrumentalSettings { iterations: 3, tolerance: 1e-4 };
    for estimator in [Estimator::LeastSquares, Estimator::InstrumentalVariables(settings)] {
        for early_stopping in [false, true] {
            let options = Options { estimator, pruning: early_stopping, ..options() };
            let records = std::slice::from_ref(&record);
            match search(records, &lattice, &[None; 2], &options, &Control::default()) {
                Ok(found) => {
                    assert_eq!(found.rows, []);
                    assert_eq!(found.counts.singular + found.counts.diverged, lattice.count());
                    assert_eq!(found.failures.len() as u64, lattice.count());
                }
                // Instrumental variables need a low-pass, which such a step leaves without a first term.
                Err(error) => assert!(matches!(error, Error::LeadingZero { .. }), "{error:?}"),
            }
        }
    }
}

#[test]
fn candidates_that_diverge_in_the_first_block_are_reported() {
    let mut random = Random::new(63);
    let record = record(0.1, vec![random.signal(64), random.signal(64)]);
    let terms = [axis(0, &[0.0], false), axis(1, &[0.0, 0.1, 0.2], false)];
    let lattice = OrderGrid::new(0, &[2.0], &terms, |s| s == 1).unwrap();
    // F starts with h^2/6: what is left of D's first term makes a run grow by 1e9 a pulse, and one block is all there is.
    let fixed = [Some(600.0 * (1.0 - 1e-9)), None];
    for early_stopping in [false, true] {
        let options = Options { pruning: early_stopping, ..options() };
        let found = search(std::slice::from_ref(&record), &lattice, &fixed, &options, &Control::default()).unwrap();
        assert_eq!((found.counts.diverged, found.rows.len()), (3, 0));
        assert!(found.failures.iter().all(|f| f.1 == Failure::Diverged));
    }
}

/// A search that takes far longer than a test may.
fn long_problem(last: f64) -> Problem {
    let mut random = Random::new(245);
    let all = range(0.0, 2.0, 0.05);
    let axes = [axis(0, &all, true), axis(0, &all, true), axis(1, &all, false), axis(2, &[0.0], false)];
    let lattice = OrderGrid::new(0, &range(1.05, last, 0.05), &axes, |s| s == 2).unwrap();
    let options = Options { pruning: false, ..options() };
    Problem { records: vec![data(&mut random, 2048, 0.005, 0.1)], lattice, fixed: vec![None; 4], options }
}

#[test]
fn search_ends_after_a_stop_request() {
    let problem = long_problem(2.0);
    let control = Control::default();
    control.stop.set();
    let found = search(&problem.records, &problem.lattice, &problem.fixed, &problem.options, &control);
    assert_eq!(found, Err(Error::Interrupted));
    assert_eq!(control.finished_count.load(Ordering::Relaxed), 0);
    // From another thread, once it is under way.
    let control = Control::default();
    std::thread::scope(|scope| {
        let run =
            scope.spawn(|| search(&problem.records, &problem.lattice, &problem.fixed, &problem.options, &control));
        while control.finished_count.load(Ordering::Relaxed) < 500 && !run.is_finished() {
            std::thread::yield_now();
        }
        control.stop.set();
        assert_eq!(run.join().unwrap(), Err(Error::Interrupted));
    });
    assert_eq!(control.total.load(Ordering::Relaxed), 313_845);
    assert!(control.finished_count.load(Ordering::Relaxed) < 313_845);
}

proptest! {
    #![proptest_config(cases(60))]

    #[test]
    fn the_bounded_search_is_brute_force(seed in 10_000u64..1_000_000, keep in 1usize..25, threads in 1usize..9) {
        let problem = random_problem(seed);
        let brute = problem.run(|o| (o.pruning, o.top, o.threads) = (false, keep, 1));
        let found = problem.run(|o| (o.top, o.threads) = (keep, threads));
        prop_assert_eq!(brute.counts.excluded_by_bound + brute.counts.stopped, 0);
        prop_assert_eq!(found.rows.len(), brute.rows.len());
        for (a, b) in found.rows.iter().zip(&brute.rows) {
            prop_assert_eq!(a.index, b.index);
            prop_assert_eq!(a.score.to_bits(), b.score.to_bits());
            prop_assert_eq!(bits(&a.coefficients), bits(&b.coefficients));
            prop_assert_eq!(&a.initial, &b.initial);
        }
        prop_assert_eq!(problem.run(|o| (o.top, o.threads) = (keep, 1)), found);
    }
}

proptest! {
    #![proptest_config(cases(24))]

    #[test]
    fn larger_top_contains_the_smaller_one(seed in 300u64..10_000, fewer in 1usize..10) {
        let problem = random_problem(seed);
        let few = problem.run(|o| o.top = fewer);
        let many = problem.run(|o| o.top = fewer + 15);
        prop_assert!(many.rows.len() >= few.rows.len());
        prop_assert_eq!(&many.rows[..few.rows.len()], &few.rows[..]);
    }

    #[test]
    fn larger_order_grid_has_no_higher_error(seed in 300u64..10_000) {
        let mut random = Random::new(seed);
        let records = vec![data(&mut random, 150, 0.02, 0.05)];
        let values = range(0.0, 2.0, 0.2);
        let make = |alphas: &[f64]| {
            let axes = [axis(0, &values, true), axis(0, &values, true), axis(1, &values, false), axis(2, &[0.0], false)];
            OrderGrid::new(0, alphas, &axes, |s| s == 2).unwrap()
        };
        let best = |lattice| {
            let problem = Problem { records: records.clone(), lattice, fixed: vec![None; 4], options: options() };
            problem.run(|_| {}).rows[0].score
        };
        // Another bank rounds its Gram matrix in another order.
        prop_assert!(best(make(&[1.2, 1.6, 2.0])) <= best(make(&[1.2, 1.6])) * (1.0 + 1e-6));
    }
}

#[test]
fn block_of_candidates_resumes_from_any_checkpoint() {
    use ftlm::order_search::batches::BatchEvaluator;
    use ftlm::order_search::control::Checkpoint;
    use ftlm::order_search::result::Part;
    use std::borrow::Cow;
    use std::sync::atomic::Ordering::Relaxed;

    let mut stopped = 0;
    for (seed, early_stopping) in [(1, false), (2, true)] {
        // Fewer than are proved closely: every stop screens the round again.
        let problem = long_problem(1.6);
        let lattice = &problem.lattice;
        let options = Options { pruning: early_stopping, top: 7, ..problem.options.clone() };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let run = |ready: &BatchEvaluator<'_>, from, control: &Control| {
            ready.evaluate_batches(0, 1, &[], from, &pool, control)
        };
        let control = Control::default();
        let fixed = vec![None; lattice.width()];
        let ready =
            BatchEvaluator::new(&problem.records, Cow::Borrowed(lattice), &fixed, &options, &pool, &control).unwrap();
        let whole = run(&ready, None, &control).unwrap();
        let mut random = Random::new(seed);
        {
            let mut rows = Vec::new();
            let mut from = None;
            let part: Part = loop {
                let control = Control::default();
                control.makes_checkpoints.store(true, Relaxed);
                let base = from.as_ref().map_or(0, |c: &Checkpoint| c.part.counts.processed_count());
                let end = base + 1 + random.below(6000) as u64;
                let finished = std::sync::atomic::AtomicBool::new(false);
                let (finished, watched) = (&finished, &control);
                let found = std::thread::scope(|scope| {
                    scope.spawn(move || {
                        while watched.finished_count.load(Relaxed) < end && !finished.load(Relaxed) {
                            std::thread::yield_now();
                        }
                        watched.stop.set();
                    });
                    let found = run(&ready, from.clone(), &control);
                    finished.store(true, Relaxed);
                    found
                });
                match found {
                    Ok(part) => break part,
                    Err(error) => assert_eq!(error, ftlm::error::Error::Interrupted),
                }
                stopped += 1;
                if let Some(mut checkpoint) = control.take_checkpoint() {
                    rows.append(&mut checkpoint.part.rows);
                    checkpoint.part.rows.clone_from(&rows);
                    if stopped == 1 {
                        // One of another visiting order is of no use: neither a candidate missed nor one met twice.
                        let mut other = checkpoint.clone();
                        other.position.order ^= 1;
                        let control = Control::default();
                        control.makes_checkpoints.store(true, Relaxed);
                        assert_eq!(run(&ready, Some(other), &control).unwrap(), whole);
                        assert_eq!(control.finished_count.load(Relaxed), whole.counts.processed_count());
                        assert!(control.take_checkpoint().is_some_and(|first| first.replaces_previous));
                    }
                    assert_eq!(checkpoint.replaces_previous, from.is_none());
                    from = Some(checkpoint);
                }
            };
            assert_eq!(part, whole);
        }
    }
    assert!(stopped > 0);
}
