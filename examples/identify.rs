//! Identification of a fractional-order plant from one noisy run. An order search finds the orders on a grid, and a
//! joint output-error fit refines orders and coefficients together. `cargo run --release --example identify` takes
//! seconds.

use ftlm::equation::{AffineOrder, Equation, Initial, Structure, Term};
use ftlm::error::Result;
use ftlm::estimation::output_error::{
    fit, Coordinate, Experiment, FreeEquation, FreeModel, MinimizationSettings, Monomial, ParameterPoint, Status,
};
use ftlm::order_search::batches::search;
use ftlm::order_search::control::Control;
use ftlm::order_search::grid::{OrderGrid, TermAxis};
use ftlm::order_search::options::{Criterion, Estimator, Norm, Options};
use ftlm::regressors::Record;
use ftlm::signal::block_pulse::{point_samples, PulseMeans};
use ftlm::simulate;

/// Number of pulses of the run.
const PULSES: usize = 500;
/// Width of a pulse \[s\].
const STEP: f64 = 0.02;

/// Index of the output among the signals of the run.
const OUTPUT: usize = 0;
/// Index of the input among the signals of the run.
const INPUT: usize = 1;

/// Return the plant D^1.85 y = −12 y − 1.5 D^0.65 y + 9 u.
fn plant() -> Result<Equation> {
    let terms = vec![
        Term { signal: OUTPUT, order: 0.0 },
        Term { signal: OUTPUT, order: 0.65 },
        Term { signal: INPUT, order: 0.0 },
    ];
    Equation::new(Structure { output: OUTPUT, order: 1.85, terms }, vec![-12.0, -1.5, 9.0])
}

/// Return pseudorandom numbers, uniform in [−1, 1). They are the same in every run.
fn noise(count: usize) -> Vec<f64> {
    let mut state = 1_u64;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        f64::from(u32::try_from(state >> 33).unwrap_or(0)) / f64::from(1_u32 << 30) - 1.0
    };
    (0..count).map(|_| next()).collect()
}

/// Return an order law that equals one free order. `place` is the index of this order among `count` free orders.
fn free(place: usize, count: usize) -> AffineOrder {
    AffineOrder { constant: 0.0, weights: (0..count).map(|i| f64::from(u8::from(i == place))).collect() }
}

fn main() -> Result<()> {
    // Run: simulated response to a square-wave current, with noise of one percent of the largest output.
    let input: Vec<f64> = (0..PULSES).map(|k| if k % 200 < 100 { 1.0 } else { -1.0 }).collect();
    let driven = Record::new(STEP, PulseMeans::from_signals(vec![vec![0.0; PULSES], input.clone()]), None)?;
    let clean = simulate::respond(&[plant()?], &driven, &[])?.remove(0);
    let size = clean.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    let measured: Vec<f64> = clean.iter().zip(noise(PULSES)).map(|(y, e)| y + 0.01 * size * e).collect();
    let record = Record::new(STEP, PulseMeans::from_signals(vec![measured.clone(), input]), None)?;

    // Exhaustive search over orders with an increment of 0.1: alpha from 1.5 to 2, the order of the damping from 0.1 to
    // 1.4.
    let tenths = |range: std::ops::RangeInclusive<u8>| range.map(|i| 0.1 * f64::from(i)).collect::<Vec<_>>();
    let axis = |signal, values| TermAxis { signal, values, interchangeable: false };
    let axes = [axis(OUTPUT, vec![0.0]), axis(OUTPUT, tenths(1..=14)), axis(INPUT, vec![0.0])];
    let lattice = OrderGrid::new(OUTPUT, &tenths(15..=20), &axes, |signal| signal == INPUT)?;
    let options = Options {
        criterion: Criterion::OutputError,
        norm: Norm::L2,
        estimator: Estimator::LeastSquares,
        initial: Initial::Rest,
        top: 3,
        threads: 2,
        pruning: true,
        ..Options::default()
    };
    let outcome = search(std::slice::from_ref(&record), &lattice, &[None; 3], &options, &Control::default())?;
    println!("{} candidates; the best:", outcome.counts.candidates);
    for row in &outcome.rows {
        let structure = lattice.structure(row.index);
        let orders = (structure.order, structure.terms[1].order);
        println!(
            "  orders {:.2} and {:.2}, coefficients {:.3?}, score {:.4}",
            orders.0, orders.1, row.coefficients, row.score
        );
    }

    // Joint fit of all orders and coefficients, which starts from the best row.
    let Some(best) = outcome.rows.first() else {
        println!("no candidate could be simulated");
        return Ok(());
    };
    let structure = lattice.structure(best.index);
    let alone = |i| Monomial { factor: 1.0, powers: vec![(i, 1)] };
    let zero = AffineOrder { constant: 0.0, weights: vec![0.0; 2] };
    let model = FreeModel {
        equations: vec![FreeEquation {
            output: OUTPUT,
            order: free(0, 2),
            terms: vec![(OUTPUT, zero.clone(), alone(0)), (OUTPUT, free(1, 2), alone(1)), (INPUT, zero, alone(2))],
        }],
        order_bounds: vec![(1.5, 2.0), (0.0, 1.4)],
        coordinates: vec![Coordinate::Plain; 3],
        inputs: Vec::new(),
        coupled: false,
        priors: Vec::new(),
        initial: Initial::Rest,
    };
    let samples = point_samples(&measured);
    let experiment = Experiment::new(record, 1, vec![samples], vec![100.0 / size])?;
    let start = ParameterPoint {
        orders: vec![structure.order, structure.terms[1].order],
        coefficients: best.coefficients.clone(),
        inputs: Vec::new(),
    };
    let found = fit(&model, &[experiment], &start, MinimizationSettings::default())?;
    println!("joint output error: orders {:.3?}, coefficients {:.3?}", found.point.orders, found.point.coefficients);
    println!("the truth:          orders [1.850, 0.650], coefficients [-12.000, -1.500, 9.000]");
    if found.status != Status::Converged {
        println!("the search for the optimum ended early: {:?}", found.status);
    }
    Ok(())
}
