//! The end of a joint fit: against figures of an independent implementation in NumPy, other starts that take over, and stops.

use ftlm::equation::{AffineOrder, Initial};
use ftlm::error::Error;
use ftlm::estimation::joint_fit::covariance::long_run_covariance;
use ftlm::estimation::joint_fit::{
    best_alternative, correct_step, fit_reweighted, refine_step, Iterate, Loss, Objective, Optimum, Problem, Weights,
};
use ftlm::estimation::output_error::{Coordinate, FreeEquation, FreeModel, Monomial, ParameterPoint};
use ftlm::expression::{DerivedSignal, Expression, Instruction};
use ftlm::parallel::Stop;
use ftlm::recording::{Channel, Recording, Recordings, Role, Sampling};
use ftlm::signal::block_pulse::Intersample;
use ftlm::signal::statistics;
use serde_json::Value;

use crate::common::{check, list, number, numbers, reference, Random};

fn order(constant: f64, weights: &[f64]) -> AffineOrder {
    AffineOrder { constant, weights: weights.to_vec() }
}

fn problem(equation: FreeEquation, order_bounds: &[(f64, f64)], coefficients: usize, initial: Initial) -> Problem {
    let model = FreeModel {
        equations: vec![equation],
        order_bounds: order_bounds.to_vec(),
        coordinates: vec![Coordinate::Plain; coefficients],
        inputs: Vec::new(),
        coupled: true,
        priors: Vec::new(),
        initial,
    };
    Problem::new(vec!["y".into()], model, Vec::new()).unwrap()
}

fn single_coefficient(coefficient: usize) -> Monomial {
    Monomial { factor: 1.0, powers: vec![(coefficient, 1)] }
}

/// D^alpha y = d D^mu y + a y + b u, from rest; y is signal 0.
fn three_terms() -> Problem {
    let none = || order(0.0, &[0.0, 0.0]);
    let terms = vec![
        (0, order(0.0, &[0.0, 1.0]), single_coefficient(0)),
        (0, none(), single_coefficient(1)),
        (1, none(), single_coefficient(2)),
    ];
    let equation = FreeEquation { output: 0, order: order(0.0, &[1.0, 0.0]), terms };
    problem(equation, &[(0.05, 3.0), (0.0, 3.0)], 3, Initial::Rest)
}

fn sample_recordings(step: f64, outputs: &[Vec<f64>], inputs: &[Vec<f64>]) -> Recordings {
    let run = |(y, u): (&Vec<f64>, &Vec<f64>)| {
        let y = Channel::new("y", y.clone(), Role::Output);
        let u = Channel::new("u", u.clone(), Role::Input(Intersample::Hold));
        Recording::new("run", step, None, vec![y, u], vec![0]).unwrap()
    };
    Recordings::new(outputs.iter().zip(inputs).map(run).collect()).unwrap()
}

fn iterate_at(orders: &[f64], coefficients: &[f64]) -> Iterate {
    let point = ParameterPoint { orders: orders.to_vec(), coefficients: coefficients.to_vec(), inputs: Vec::new() };
    Iterate { point, states: Vec::new() }
}

fn sampling(every: usize, decimation: usize) -> Sampling {
    Sampling { pulses_per_sample: every, decimation, leading_intervals: None }
}

fn output_weights(weight: f64) -> Weights {
    Weights { outputs: vec![weight], robust_weights: None }
}

fn close(what: &str, found: &[f64], told: &[f64], tolerance: f64) {
    assert_eq!(found.len(), told.len(), "{what}");
    let size = told.iter().fold(1e-300_f64, |a, v| a.max(v.abs()));
    let far = found.iter().zip(told).map(|(a, b)| (a - b).abs() / size).fold(0.0, f64::max);
    check(what, far, tolerance);
}

fn table(value: &Value) -> Vec<Vec<f64>> {
    list(value).iter().map(numbers).collect()
}

/// Covariance Σ e² / (n − p) (J Jᵀ)⁻¹ of least squares with white noise, by Gauss–Jordan elimination.
#[allow(clippy::cast_precision_loss)]
fn classical_covariance(jacobian: &[Vec<f64>], residuals: &[Vec<f64>]) -> Vec<f64> {
    let p = jacobian.len();
    let known: Vec<f64> = residuals.iter().flatten().copied().filter(|e| !e.is_nan()).collect();
    let level = known.iter().map(|e| e * e).sum::<f64>() / (known.len() - p) as f64;
    let product = |i: usize, j: usize| jacobian[i].iter().zip(&jacobian[j]).map(|(a, b)| a * b).sum::<f64>();
    let row = |i: usize| (0..p).map(|j| product(i, j)).chain((0..p).map(|j| f64::from(i == j))).collect::<Vec<f64>>();
    let mut rows: Vec<Vec<f64>> = (0..p).map(row).collect();
    for k in 0..p {
        let pivot = rows[k][k];
        rows[k].iter_mut().for_each(|v| *v /= pivot);
        for i in (0..p).filter(|&i| i != k) {
            let (factor, above) = (rows[i][k], rows[k].clone());
            rows[i].iter_mut().zip(&above).for_each(|(v, a)| *v -= factor * a);
        }
    }
    rows.iter().flat_map(|row| row[p..].iter().map(|v| level * v)).collect()
}

/// Fits end at their tolerance: estimates by 2e-6 apart, covariances by 4e-5.
const END_TOLERANCE: f64 = 1e-5;
/// The reference has the color of residuals from the Yule–Walker equations, which is another estimate than Burg's.
const COLOR_TOLERANCE: f64 = 0.1;

#[test]
fn optimum_matches_another_implementation() {
    let told = reference("joint_fit");
    let (problem, stop, start) = (three_terms(), Stop::default(), numbers(&told["start"]));
    for case in list(&told["cases"]) {
        let name = case["name"].as_str().unwrap();
        let loss = if case["loss"] == "huber" { Loss::Huber } else { Loss::Squares };
        let (inputs, outputs) = (table(&case["inputs"]), table(&case["outputs"]));
        let source = sample_recordings(number(&told["step"]), &outputs, &inputs);
        let grid = Objective::new((&problem, &source, &stop), output_weights(100.0), sampling(1, 1), false).unwrap();
        let (best, grid) = fit_reweighted(&iterate_at(&start[..2], &start[2..]), grid, loss).unwrap();
        close(&format!("{name}: settled"), &best.values(), &numbers(&case["settled"]["values"]), END_TOLERANCE);
        close(&format!("{name}: weights"), &grid.weights.outputs, &numbers(&case["settled"]["weights"]), END_TOLERANCE);
        close(&format!("{name}: cost"), &[best.cost], &[number(&case["settled"]["cost"])], END_TOLERANCE);
        let rough = Optimum::without_refinement(best.clone(), grid.clone()).unwrap().into_statistics();
        assert_eq!((rough.pulses_per_sample, &rough.estimate), (1, &best.values()));
        let found = refine_step(best, grid, loss, &[]).unwrap().into_statistics();
        assert_eq!(found.pulses_per_sample as u64, case["refinement"].as_u64().unwrap());
        assert_eq!(found.step_converged, case["stands"].as_bool().unwrap());
        close(&format!("{name}: estimate"), &found.estimate, &numbers(&case["estimate"]), END_TOLERANCE);
        close(&format!("{name}: on its grid"), &found.result.values(), &numbers(&case["on_grid"]), END_TOLERANCE);
        // Residuals in the unit of the Jacobian, whose weights have converged to the noise within a tolerance.
        let unit = found.noise[0] * found.weights.outputs[0];
        let weighted = |run: &Vec<Vec<f64>>| run[0].iter().map(|e| e * unit).collect::<Vec<f64>>();
        let series: Vec<Vec<f64>> = found.residuals.iter().map(weighted).collect();
        let (expected, tolerance) = if name == "white" {
            assert!(series.iter().all(|run| statistics::is_white(run, statistics::WHITENESS_LAGS)));
            (classical_covariance(&found.result.jacobian, &series), 10.0 * END_TOLERANCE)
        } else {
            (table(&case["covariance"]).concat(), COLOR_TOLERANCE)
        };
        close(&format!("{name}: covariance"), &found.covariance, &expected, tolerance);
        close(&format!("{name}: noise"), &found.noise, &[number(&case["noise"])], END_TOLERANCE);
        let robust = found.robust.map(|r| vec![r.reduced_weight_count as u64, r.outliers as u64, r.samples as u64]);
        let counted = case["robust"].as_array().map(|of| of.iter().map(|v| v.as_u64().unwrap()).collect());
        assert_eq!(robust, counted);
        // The colour of what is left, and what sums of it scatter by.
        let rows: Vec<&[f64]> = series.iter().map(Vec::as_slice).collect();
        let (filter, power) = statistics::whitening_filter(&rows, 6);
        close(&format!("{name}: filter"), &filter, &numbers(&case["filter"]), END_TOLERANCE);
        close(&format!("{name}: power"), &[power], &[number(&case["power"])], END_TOLERANCE);
        close(
            &format!("{name}: covariances"),
            &statistics::filter_autocovariances(&filter, power, 8),
            &numbers(&case["covariances"]),
            END_TOLERANCE,
        );
        let inner =
            |signals: &[Vec<f64>]| -> Vec<f64> { signals.iter().flat_map(|s| s[1..s.len() - 1].to_vec()).collect() };
        let sums = long_run_covariance(&[inner(&inputs), inner(&outputs)], &series).unwrap();
        close(&format!("{name}: sums"), &sums, &table(&case["sums"]).concat(), END_TOLERANCE);
    }
}

#[test]
fn step_correction_of_a_long_record_agrees_with_finer_grids() {
    // Of the second record the grid is off by half of the noise.
    correction_agrees_with_finer_grids(0.015);
    correction_agrees_with_finer_grids(0.01);
}

fn correction_agrees_with_finer_grids(size: f64) {
    let (step, decay, rows) = (0.05, (-0.1_f64).exp(), 33_000);
    let mut random = Random::new(3);
    let u = random.steps(rows, 15);
    // The input is linear between its samples.
    let next_gain = 1.0 - (1.0 - decay) / 0.1;
    let current_gain = 1.0 - decay - next_gain;
    let mut state = 0.0;
    let y: Vec<f64> = (0..rows)
        .zip(random.signal(rows))
        .map(|(k, noise)| {
            let here = state;
            state = decay * state + current_gain * u[k] + next_gain * u[(k + 1).min(rows - 1)];
            here + size * noise
        })
        .collect();
    let none = || order(0.0, &[0.0]);
    let terms = vec![(0, none(), single_coefficient(0)), (1, none(), single_coefficient(1))];
    let equation = FreeEquation { output: 0, order: order(0.0, &[1.0]), terms };
    let problem = problem(equation, &[(0.05, 3.0)], 2, Initial::Rest);
    let (y, u) = (Channel::new("y", y, Role::Output), Channel::new("u", u, Role::Input(Intersample::Linear)));
    let run = Recording::new("run", step, None, vec![y, u], vec![0]).unwrap();
    let (source, stop) = (Recordings::new(vec![run]).unwrap(), Stop::default());
    let grid = Objective::new((&problem, &source, &stop), output_weights(1.0 / size), sampling(1, 1), false).unwrap();
    let (best, grid) = fit_reweighted(&iterate_at(&[1.1], &[-2.2, 2.2]), grid, Loss::Squares).unwrap();
    let corrected = correct_step(&best, &grid, Loss::Squares).unwrap().unwrap().into_statistics();
    let refined = refine_step(best.clone(), grid, Loss::Squares, &[]).unwrap().into_statistics();
    assert!(corrected.step_converged && corrected.pulses_per_sample == 1 && refined.pulses_per_sample > 1);
    assert_eq!(corrected.result.values(), best.values());
    let truths = [1.0, -2.0, 2.0];
    // On the grid itself a parameter is off by far more than its error.
    let off = |k: usize| (best.values()[k] - truths[k]).abs() / corrected.covariance[k * 4].sqrt();
    assert!(off(0).max(off(1)).max(off(2)) > 4.0, "{:?}", best.values());
    for (k, truth) in truths.into_iter().enumerate() {
        let error = corrected.covariance[k * 4].sqrt();
        let (found, expected) = (corrected.estimate[k], refined.estimate[k]);
        assert!((found - expected).abs() < 0.15 * error, "{found} and {expected} ± {error}");
        assert!((found - truth).abs() < 4.0 * error, "{found} ± {error}");
        assert!((error / refined.covariance[k * 4].sqrt() - 1.0).abs() < 0.02);
    }
    close("noise", &corrected.noise, &refined.noise, 3e-3);
}

#[test]
fn step_correction_of_nonlinear_terms_agrees_with_finer_grids() {
    // y′ = u − y², of which tanh is the step response.
    let (step, rows, size) = (0.2_f64, 40, 2e-3);
    let mut random = Random::new(5);
    let u = vec![1.0; rows];
    let y: Vec<f64> =
        (0..rows).zip(random.signal(rows)).map(|(k, noise)| (step * k as f64).tanh() + size * noise).collect();
    let none = || order(0.0, &[0.0]);
    let equation = FreeEquation {
        output: 0,
        order: order(0.0, &[1.0]),
        terms: vec![(2, none(), single_coefficient(0)), (1, none(), single_coefficient(1))],
    };
    let square = Expression::new(vec![Instruction::Channel(0), Instruction::Power(2.0)], 1).unwrap();
    let square = DerivedSignal::new(square, vec![(0, 0.0)]).unwrap();
    let problem = problem(equation, &[(0.5, 1.5)], 2, Initial::Rest).with_derived(vec![square]);
    let (source, stop) = (sample_recordings(step, &[y], &[u]), Stop::default());
    let grid = Objective::new((&problem, &source, &stop), output_weights(1.0 / size), sampling(1, 1), false).unwrap();
    let (best, grid) = fit_reweighted(&iterate_at(&[1.0], &[-1.0, 1.0]), grid, Loss::Squares).unwrap();
    let corrected = correct_step(&best, &grid, Loss::Squares).unwrap().unwrap().into_statistics();
    let refined = refine_step(best.clone(), grid, Loss::Squares, &[]).unwrap().into_statistics();
    assert!(corrected.step_converged);
    let truths = [1.0, -1.0, 1.0];
    let errors: Vec<f64> = (0..3).map(|k| corrected.covariance[k * 4].sqrt()).collect();
    // On the grid itself a parameter is off by far more than its error.
    let offsets: Vec<f64> = (0..3).map(|k| (best.values()[k] - truths[k]).abs() / errors[k]).collect();
    assert!(offsets.iter().any(|offset| *offset > 4.0), "{offsets:?}");
    for (k, truth) in truths.into_iter().enumerate() {
        let (found, expected, error) = (corrected.estimate[k], refined.estimate[k], errors[k]);
        assert!((found - expected).abs() < 0.2 * error, "{found} and {expected} ± {error}");
        assert!((found - truth).abs() < 4.0 * error, "{found} ± {error}");
    }
    close("noise", &corrected.noise, &refined.noise, 1e-2);
}

/// y′ = −2 y + 2 u with a little noise, in exact steps, and D y = −a y + b u, whatever the run starts from.
fn first_order() -> (Problem, Recordings) {
    let (step, decay) = (0.02, (-0.04_f64).exp());
    let mut random = Random::new(3);
    let (mut y, mut states, mut u) = (0.0, Vec::new(), Vec::new());
    for (k, noise) in random.signal(400).iter().enumerate() {
        let command = if (k / 50) % 2 == 0 { 1.0 } else { -1.0 };
        states.push(y + 0.01 * noise);
        u.push(command);
        y = decay * y + (1.0 - decay) * command;
    }
    let none = || order(0.0, &[]);
    let own = Monomial { factor: -1.0, powers: vec![(0, 1)] };
    let equation = FreeEquation {
        output: 0,
        order: order(1.0, &[]),
        terms: vec![(0, none(), own), (1, none(), single_coefficient(1))],
    };
    (problem(equation, &[], 2, Initial::Caputo), sample_recordings(step, &[states], &[u]))
}

#[test]
fn alternative_start_replaces_a_stalled_one_if_its_cost_is_lower() {
    let ((problem, source), stop) = (first_order(), Stop::default());
    let grid = Objective::new((&problem, &source, &stop), output_weights(100.0), sampling(1, 1), false).unwrap();
    let at = |a: f64, b: f64| iterate_at(&[], &[a, b]);
    let stuck = grid.evaluate(&at(1.0, 1.0)).unwrap().unwrap();
    let (best, there) = best_alternative(&stuck, &grid, &[at(3.0, 1.0)], Loss::Squares).unwrap().unwrap();
    close("coefficients", &best.values(), &[2.0, 2.0], 0.03);
    // Its weights are settled: those of what it leaves.
    check("level", (there.residual_root_mean_squares(&best)[0] - 1.0).abs(), 0.01);
    assert_ne!(there.weights, grid.weights);
    // Nobody else: the same one on the same grid. None of those that leave more than it.
    assert!(best_alternative(&stuck, &grid, &[], Loss::Squares).unwrap().is_none());
    let ahead = there.evaluate(&best.iterate).unwrap().unwrap();
    assert!(best_alternative(&ahead, &there, &[at(1.9, 1.9)], Loss::Squares)
        .unwrap()
        .is_none_or(|(a, _)| a.cost < ahead.cost * 1.0001));
}

#[test]
fn stability_constraint_excludes_unstable_steps() {
    let ((problem, source), stop) = (first_order(), Stop::default());
    let free = Objective::new((&problem, &source, &stop), output_weights(100.0), sampling(1, 1), false).unwrap();
    let steady = Objective::new((&problem, &source, &stop), output_weights(100.0), sampling(1, 1), true).unwrap();
    assert!(
        problem.is_unstable(&iterate_at(&[], &[-2.0, 1.0]).point)
            && !problem.is_unstable(&iterate_at(&[], &[2.0, 1.0]).point)
    );
    let stuck = steady.evaluate(&iterate_at(&[], &[1.0, 1.0])).unwrap().unwrap();
    let (best, _) = best_alternative(&stuck, &steady, &[iterate_at(&[], &[3.0, 1.0])], Loss::Squares).unwrap().unwrap();
    assert!(best.values()[0] > 0.0);
    // On a steady grid a descent from where it dies away stays there.
    let start = iterate_at(&[], &[0.01, 1e-9]);
    let found = steady.minimize(&start, 60).unwrap();
    assert!(!problem.is_unstable(&found.iterate.point));
    assert!(free.minimize(&start, 60).unwrap().cost <= found.cost * (1.0 + 1e-9));
}

#[test]
fn stop_request_and_invalid_arguments_are_reported() {
    let ((problem, source), stop) = (first_order(), Stop::default());
    let grid = Objective::new((&problem, &source, &stop), output_weights(100.0), sampling(1, 1), false).unwrap();
    let start = iterate_at(&[], &[1.0, 1.0]);
    let two = Weights { outputs: vec![1.0, 1.0], robust_weights: None };
    assert!(matches!(
        Objective::new((&problem, &source, &stop), two, sampling(1, 1), false).map(|_| ()),
        Err(Error::Length { .. })
    ));
    assert!(problem.point(&[1.0]).is_err());
    assert_eq!(source.intervals_and_durations(), [(0.02, 8.0)]);
    stop.set();
    assert!(matches!(fit_reweighted(&start, grid, Loss::Squares).map(|_| ()), Err(Error::Interrupted)));
}

#[test]
fn burg_finds_the_color_of_autoregressions_with_missing_samples() {
    // Noise of two poles at 0.9 exp(±0.5i), from a congruential generator; a tenth is missing in the second record.
    let (c1, c2) = (-2.0 * 0.9 * f64::cos(0.5), 0.81);
    let mut state = 7_u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    };
    let mut series = vec![0.0, 0.0];
    for k in 2..20_000 {
        series.push(uniform() - c1 * series[k - 1] - c2 * series[k - 2]);
    }
    let (filter, power) = statistics::burg_filter(&series, 2);
    close("coefficients", &filter, &[1.0, c1, c2], 0.02);
    close("innovations", &[power], &[1.0 / 12.0], 0.03);
    let missing: Vec<f64> =
        series.iter().enumerate().map(|(k, v)| if k % 1000 < 100 { f64::NAN } else { *v }).collect();
    let (filter, power) = statistics::burg_filter(&missing, 2);
    close("coefficients beside gaps", &filter, &[1.0, c1, c2], 0.03);
    close("innovations beside gaps", &[power], &[1.0 / 12.0], 0.1);
}
