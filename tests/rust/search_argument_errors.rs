//! Invalid arguments of searches return an error instead of a panic, a hang or a wrong table.

use std::borrow::Cow;

use ftlm::equation::{AffineOrder, Initial};
use ftlm::error::{Error, Result};
use ftlm::estimation::instrumental_variables::InstrumentalSettings;
use ftlm::order_search::batches::{batch_count, generation_ends, search, BatchEvaluator};
use ftlm::order_search::control::{BatchPosition, Checkpoint, Control};
use ftlm::order_search::grid::{LawEquation, OrderGrid, OrderLawGrid, TermAxis};
use ftlm::order_search::options::{Estimator, Options};
use ftlm::order_search::result::{Counts, Failure, Part, Row, Verdict};
use ftlm::order_search::stage_join::{self, CoupledSearch, Span};
use ftlm::parallel::{pool, MAX_THREADS};
use ftlm::regressors::{Bank, Index, Key, Record};
use ftlm::signal::block_pulse::PulseMeans;

use crate::common::Random;

fn axis(signal: usize, values: &[f64]) -> TermAxis {
    TermAxis { signal, values: values.to_vec(), interchangeable: true }
}

fn data() -> Record {
    let mut random = Random::new(5);
    Record::new(0.1, PulseMeans::from_signals(vec![random.signal(64), random.signal(64)]), None).unwrap()
}

fn small_grid() -> OrderGrid {
    OrderGrid::new(0, &[1.0, 1.5], &[axis(0, &[0.0, 0.5]), axis(1, &[0.0])], |s| s == 1).unwrap()
}

fn run(fixed: &[Option<f64>], options: &Options) -> Result<()> {
    search(&[data()], &small_grid(), fixed, options, &Control::default()).map(|_| ())
}

#[test]
fn order_grids_reject_nonfinite_orders() {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let found = OrderGrid::new(0, &[1.0, bad], &[axis(0, &[0.0])], |_| false);
        assert!(matches!(found, Err(Error::NotFinite { index: 1, .. })));
        let found = OrderGrid::new(0, &[1.0], &[axis(1, &[0.0]), axis(0, &[0.0, 0.5, bad])], |_| false);
        match found {
            Err(Error::NotFinite { name, index: 2, .. }) => assert_eq!(name, "orders of term 1"),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn order_grids_reject_too_many_terms() {
    let terms = |count: usize| vec![axis(0, &[0.0]); count];
    // 34 terms of one signal are looked at (and do not fit on one order), 35 are refused.
    assert!(matches!(OrderGrid::new(0, &[1.0], &terms(34), |_| false), Err(Error::EmptyOrderGrid { .. })));
    let found = OrderGrid::new(0, &[1.0], &terms(35), |_| false);
    assert!(matches!(found, Err(Error::Structure { what, .. }) if what == "signal 0 has 35 terms, more than 34"));
    // Products over many signals leave 128 bits.
    let values: Vec<f64> = (0..5).map(|i| 0.1 * f64::from(i)).collect();
    let many: Vec<TermAxis> =
        (0..100).map(|k| TermAxis { signal: 1 + k / 5, values: values.clone(), interchangeable: false }).collect();
    assert!(matches!(OrderGrid::new(0, &[1.0], &many, |_| false), Err(Error::OrderGridTooLarge { .. })));
}

#[test]
fn index_after_the_last_structure_gives_the_last() {
    let lattice = small_grid();
    assert_eq!(lattice.structure(u64::MAX), lattice.structure(lattice.count() - 1));
}

fn law(constant: f64, weights: &[f64]) -> AffineOrder {
    AffineOrder { constant, weights: weights.to_vec() }
}

fn single_law() -> LawEquation {
    LawEquation { output: 0, order: law(0.0, &[1.0]), terms: vec![(0, law(0.0, &[])), (1, law(0.0, &[]))] }
}

#[test]
fn law_grids_reject_invalid_laws() {
    let made = |axes: &[Vec<f64>], change: &dyn Fn(&mut LawEquation)| {
        let mut equation = single_law();
        change(&mut equation);
        OrderLawGrid::new(axes, &[equation], &[false, true])
    };
    let axes = [vec![1.0, 1.5]];
    assert!(made(&axes, &|_| {}).is_ok());
    assert!(matches!(made(&[vec![1.0, f64::NAN]], &|_| {}), Err(Error::NotFinite { index: 1, .. })));
    assert!(matches!(made(&axes, &|e| e.order.constant = f64::INFINITY), Err(Error::NotFinite { .. })));
    assert!(matches!(made(&axes, &|e| e.terms[0].1.weights = vec![f64::NAN]), Err(Error::NotFinite { .. })));
    assert!(matches!(made(&axes, &|e| e.terms[0].1.weights = vec![0.0, 1.0]), Err(Error::Structure { .. })));
    assert!(matches!(made(&axes, &|e| e.output = 2), Err(Error::Structure { .. })));
    assert!(matches!(made(&axes, &|e| e.terms[0].0 = 7), Err(Error::Structure { .. })));
    assert!(matches!(OrderLawGrid::new(&axes, &[], &[false]), Err(Error::Structure { .. })));
}

#[test]
fn searches_reject_settings_out_of_range() {
    let with = |options: Options| run(&[None; 2], &options);
    assert!(with(Options::default()).is_ok());
    assert!(matches!(with(Options { top: 0, ..Options::default() }), Err(Error::OutOfRange { .. })));
    for threads in [0, MAX_THREADS + 1, usize::MAX] {
        assert!(matches!(with(Options { threads, ..Options::default() }), Err(Error::OutOfRange { .. })));
        assert!(matches!(pool(threads), Err(Error::OutOfRange { .. })));
    }
    for (iterations, tolerance) in [(0, 1e-4), (3, f64::NAN), (3, -1.0), (3, f64::INFINITY)] {
        let estimator = Estimator::InstrumentalVariables(InstrumentalSettings { iterations, tolerance });
        assert!(matches!(with(Options { estimator, ..Options::default() }), Err(Error::OutOfRange { .. })));
    }
    let powers = |powers: &[f64]| Options { initial: Initial::Powers(powers.to_vec()), ..Options::default() };
    assert!(matches!(with(powers(&[0.0, -1.0])), Err(Error::OutOfRange { .. })));
    assert!(matches!(with(powers(&[f64::NAN])), Err(Error::NotFinite { .. })));
    assert!(matches!(run(&[None], &Options::default()), Err(Error::Length { .. })));
    assert!(matches!(run(&[None, Some(f64::NAN)], &Options::default()), Err(Error::NotFinite { .. })));
    // As many rows as there are, however many are asked for.
    let all = Options { top: usize::MAX, ..Options::default() };
    let found = search(&[data()], &small_grid(), &[None; 2], &all, &Control::default()).unwrap();
    assert_eq!(found.counts.table_rows + found.counts.singular + found.counts.diverged, small_grid().count());
    assert_eq!((batch_count(0, &all), generation_ends(0)), (0, vec![]));
}

#[test]
fn searches_reject_records_without_their_signals() {
    let lattice = OrderGrid::new(0, &[1.0], &[axis(2, &[0.0])], |_| false).unwrap();
    let found = search(&[data()], &lattice, &[None], &Options::default(), &Control::default());
    assert!(matches!(found, Err(Error::Structure { .. })));
    let mut stage = single_law();
    stage.terms[1].0 = 2;
    let lattice = OrderLawGrid::new(&[vec![1.0]], &[stage], &[false, false, true]).unwrap();
    let fixed = [vec![None; 2]];
    let found = stage_join::search(&[data()], &lattice, &fixed, &[1.0], &Options::default(), &Control::default());
    assert!(matches!(found, Err(Error::Structure { .. })));
    let mut index = Index::default();
    index.insert(Key::integral(2, 0.5));
    assert!(matches!(Bank::new(&index, &data(), 0).err(), Some(Error::Structure { .. })));
    let found = Record::new(0.1, PulseMeans::from_signals(vec![vec![1.0; 2]]), Some(vec![1.0, f64::NAN]));
    assert!(matches!(found, Err(Error::NotFinite { index: 1, .. })));
}

#[test]
fn batches_reject_state_of_another_search() {
    let (lattice, options, control, pool) = (small_grid(), Options::default(), Control::default(), pool(1).unwrap());
    let ready = BatchEvaluator::new(&[data()], Cow::Borrowed(&lattice), &[None; 2], &options, &pool, &control).unwrap();
    let refused = |first, last, seed: &[(u64, f64)], from| {
        let found = ready.evaluate_batches(first, last, seed, from, &pool, &control);
        assert!(matches!(found, Err(Error::Structure { .. })), "{found:?}");
    };
    let place = BatchPosition { batch: 0, evaluated_count: 0, end: 0, size: 0, limit: f64::INFINITY, order: 0 };
    assert_eq!(batch_count(lattice.count(), &options), 1);
    refused(0, 2, &[], None);
    refused(1, 0, &[], None);
    refused(u64::MAX, u64::MAX, &[], None);
    refused(0, 1, &[(lattice.count(), 1.0)], None);
    refused(0, 1, &[(0, f64::NAN)], None);
    refused(0, 1, &[(0, -1.0)], None);
    let at = |place| Some(Checkpoint { position: place, replaces_previous: false, part: Part::default() });
    for place in [
        BatchPosition { batch: 2, ..place },
        BatchPosition { evaluated_count: 1, ..place },
        BatchPosition { end: 1, ..place },
        BatchPosition { end: 1, size: 1, evaluated_count: 2, ..place },
        BatchPosition { end: 1, size: 1, limit: f64::NAN, ..place },
        BatchPosition { end: 1, size: 1, limit: -1.0, ..place },
    ] {
        refused(0, 1, &[], at(place));
    }
    let row = |index, score, width| Row { index, score, coefficients: vec![0.0; width], initial: vec![vec![]] };
    let with = |part| Some(Checkpoint { position: place, replaces_previous: false, part });
    for row in [row(lattice.count(), 1.0, 2), row(0, 1.0, 3), row(0, f64::NAN, 2)] {
        refused(0, 1, &[], with(Part { rows: vec![row], ..Part::default() }));
    }
    refused(0, 1, &[], with(Part { failures: vec![(lattice.count(), Failure::Singular)], ..Part::default() }));
    let counts = Counts { beaten: u64::MAX, ..Counts::default() };
    refused(0, 1, &[], with(Part { counts, ..Part::default() }));
    assert!(ready.evaluate_batches(0, 1, &[(0, 1.0)], at(place), &pool, &control).is_ok());
    // A place in a round of another visiting order is left for the start of its stretch.
    let whole = ready.evaluate_batches(0, 1, &[], None, &pool, &control).unwrap();
    for place in
        [BatchPosition { end: u64::MAX, size: u64::MAX, ..place }, BatchPosition { end: 1, size: 1, order: 1, ..place }]
    {
        assert_eq!(ready.evaluate_batches(0, 1, &[], at(place), &pool, &control).unwrap(), whole);
    }
}

#[test]
fn stages_reject_scales_ranges_and_verdicts_of_others() {
    let (options, control, pool) = (Options::default(), Control::default(), pool(1).unwrap());
    let lattice = |values: &[f64]| OrderLawGrid::new(&[values.to_vec()], &[single_law()], &[false, true]).unwrap();
    let made = |lattice: OrderLawGrid, scale: f64| {
        CoupledSearch::new(&[data()], Cow::Owned(lattice), &[vec![None; 2]], &[scale], &options, &pool, &control)
    };
    for scale in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(made(lattice(&[1.0]), scale).err(), Some(Error::OutOfRange { .. })));
    }
    let (stage, mut course) = made(lattice(&[1.0, 1.5]), 1.0).unwrap();
    let span = Span { equation: 0, first: 0, last: 2, limit: f64::INFINITY };
    for span in [
        Span { equation: 9, first: 0, last: 0, ..span },
        Span { first: 2, last: 1, ..span },
        Span { last: 3, ..span },
        Span { last: usize::MAX, ..span },
        Span { limit: f64::NAN, ..span },
    ] {
        assert!(matches!(stage.evaluate(&[span], &pool, &control), Err(Error::Structure { .. })), "{span:?}");
    }
    let verdicts = stage.evaluate(course.pending_spans(), &pool, &control).unwrap();
    let (other, _) = made(lattice(&[1.0, 1.2, 1.5]), 1.0).unwrap();
    assert!(matches!(course.record_verdicts(&other, &verdicts, &pool, &control), Err(Error::Structure { .. })));
    assert!(matches!(course.record_verdicts(&stage, &verdicts[1..], &pool, &control), Err(Error::Structure { .. })));
    let strange = [Verdict::Score(f64::NAN), Verdict::Score(1.0)];
    assert!(matches!(course.record_verdicts(&stage, &strange, &pool, &control), Err(Error::Structure { .. })));
    assert!(matches!(stage.outcome(&course, &control), Err(Error::Structure { .. })));
    course.record_verdicts(&stage, &verdicts, &pool, &control).unwrap();
    assert!(matches!(other.outcome(&course, &control), Err(Error::Structure { .. })));
    assert_eq!(stage.outcome(&course, &control).unwrap().counts.candidates, 2);
}
