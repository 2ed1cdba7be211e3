//! Joint output error: its Jacobian against differences, recovery of known models, statistics of its estimates.

use std::sync::Arc;

use ftlm::equation::{AffineOrder, Initial};
use ftlm::error::Error;
use ftlm::estimation::output_error::{
    fit, Coordinate, Experiment, FreeEquation, FreeInput, FreeModel, InputLaw, MinimizationSettings, Monomial,
    OutputErrorFit, ParameterPoint, PointValues, Status,
};
use ftlm::regressors::Record;
use ftlm::series;
use ftlm::signal::block_pulse::{delay_samples, point_samples};
use ftlm::simulate;

use crate::common::{
    check, check_between, dense_solve, deviation, equation, norm, record, relative_distance, with_signal, Random,
};

/// Free orders γ₁, β₂, μ₂ of the two-link law with both α at 2, then the coefficients a, b, d, g, r.
const ORDERS: [f64; 3] = [0.95, 0.1, 0.85];
const COEFFICIENTS: [f64; 5] = [60.0, -6.0, 1.5, 14.0, 1.4];

fn law(constant: f64, weights: [f64; 3]) -> AffineOrder {
    AffineOrder { constant, weights: weights.to_vec() }
}

fn monomial(factor: f64, coefficients: &[usize]) -> Monomial {
    Monomial { factor, powers: coefficients.iter().map(|&i| (i, 1)).collect() }
}

fn two_link(coupled: bool, initial: Initial) -> FreeModel {
    let (a, b, d, g, r) = (0, 1, 2, 3, 4);
    let hub = vec![
        (1, law(0.0, [-1.0, 1.0, 1.0]), monomial(1.0, &[a])),
        (0, law(0.0, [1.0, 0.0, 0.0]), monomial(1.0, &[b])),
        (1, law(0.0, [-1.0, 0.0, 2.0]), monomial(1.0, &[d])),
        (2, law(0.0, [0.0; 3]), monomial(1.0, &[g])),
    ];
    let deflection = vec![
        (1, law(0.0, [0.0, 1.0, 0.0]), monomial(-1.0, &[a, r])),
        (0, law(0.0, [2.0, 0.0, -1.0]), monomial(-1.0, &[b])),
        (1, law(0.0, [0.0, 0.0, 1.0]), monomial(-1.0, &[d, r])),
        (2, law(0.0, [0.0; 3]), monomial(-1.0, &[g])),
    ];
    let order = law(2.0, [0.0; 3]);
    FreeModel {
        equations: vec![
            FreeEquation { output: 0, order: order.clone(), terms: hub },
            FreeEquation { output: 1, order, terms: deflection },
        ],
        order_bounds: vec![(0.5, 1.2), (0.0, 0.6), (0.5, 1.2)],
        inputs: Vec::new(),
        coordinates: vec![
            Coordinate::Logarithm,
            Coordinate::Logarithm,
            Coordinate::Plain,
            Coordinate::Logarithm,
            Coordinate::ExcessLogarithm,
        ],
        coupled,
        priors: Vec::new(),
        initial,
    }
}

/// The same model with its numbers, as an equation of `simulate` has them.
fn truth() -> [ftlm::equation::Equation; 2] {
    let [a, b, d, g, r] = COEFFICIENTS;
    [
        equation(0, 2.0, &[(1, 0.0, a), (0, 0.95, b), (1, 0.75, d), (2, 0.0, g)]),
        equation(1, 2.0, &[(1, 0.1, -a * r), (0, 1.05, -b), (1, 0.85, -d * r), (2, 0.0, -g)]),
    ]
}

/// A run of the truth, `every` pulses a sample, with white noise of this fraction of each output's deviation.
fn run(intervals: usize, every: usize, initial: &[Vec<(f64, f64)>], noise: f64, seed: u64) -> Experiment {
    let mut random = Random::new(seed);
    let m = intervals * every;
    let step = 0.02 / every as f64;
    let mut record = record(step, vec![vec![0.0; m], vec![0.0; m], random.steps(m, 40 * every)]);
    let outputs = simulate::respond(&truth(), &record, initial).unwrap();
    let mut samples = Vec::new();
    let mut weights = Vec::new();
    for (i, means) in outputs.into_iter().enumerate() {
        let clean: Vec<f64> = point_samples(&means).into_iter().step_by(every).collect();
        let sigma = noise * deviation(&clean);
        weights.push(if noise > 0.0 { 1.0 / sigma } else { 1.0 / deviation(&clean) });
        samples.push(clean.iter().map(|y| y + sigma * random.normal()).collect());
        record = with_signal(&record, i, means);
    }
    Experiment::new(record, every, samples, weights).unwrap()
}

fn point(orders: &[f64], coefficients: &[f64]) -> ParameterPoint {
    ParameterPoint { orders: orders.to_vec(), coefficients: coefficients.to_vec(), inputs: Vec::new() }
}

/// Residuals, cost and Jacobian at given parameters, no step taken.
fn at(model: &FreeModel, experiments: &[Experiment], orders: &[f64], coefficients: &[f64]) -> OutputErrorFit {
    let settings = MinimizationSettings { evaluations: 1, ..MinimizationSettings::default() };
    let found = fit(model, experiments, &point(orders, coefficients), settings).unwrap();
    assert_eq!((found.evaluations, found.status), (1, Status::Exhausted));
    found
}

const START: ([f64; 3], [f64; 5]) = ([0.9, 0.2, 0.8], [45.0, -8.0, 1.0, 18.0, 1.7]);

/// The experiments on which the derivatives are checked: coupled or not, refined, filtered, at rest or not.
fn variants() -> Vec<(&'static str, FreeModel, Vec<Experiment>)> {
    let rest = || vec![run(150, 1, &[], 0.02, 400), run(90, 3, &[], 0.02, 401)];
    let moving = || vec![run(150, 2, &[vec![(0.0, 0.3)], vec![(0.0, -0.1), (1.0, 0.2)]], 0.02, 402)];
    let mut filtered = rest();
    for experiment in &mut filtered {
        let series = (0..experiment.record.m()).map(|k| 0.4 * 0.6_f64.powi(i32::try_from(k).unwrap())).collect();
        experiment.filter = Some((series, vec![false, true]));
    }
    vec![
        ("coupled", two_link(true, Initial::Rest), rest()),
        ("measured coupling", two_link(false, Initial::Rest), rest()),
        ("filtered", two_link(true, Initial::Rest), filtered),
        ("powers", two_link(true, Initial::Powers(vec![0.0, 1.0])), moving()),
        ("Caputo", two_link(true, Initial::Caputo), moving()),
        ("Caputo, measured coupling", two_link(false, Initial::Caputo), moving()),
    ]
}

#[test]
fn the_jacobian_is_the_slope_of_the_residuals() {
    for (name, model, experiments) in variants() {
        let (mut orders, coefficients) = START;
        if model.initial == Initial::Caputo {
            // γ₂ = 2γ₁ − μ₂ = 1 would put the exponent 2 − γ₂ on that of t, where terms merge and no slope exists.
            orders = [0.8, 0.2, 0.85];
        }
        let here = at(&model, &experiments, &orders, &coefficients);
        let rows: usize = experiments.iter().map(|e| 2 * (e.record.m() / e.pulses_per_sample - 1)).sum();
        assert_eq!((here.residuals.len(), here.jacobian.len()), (rows, 8));
        assert!((here.cost / (0.5 * here.residuals.iter().map(|e| e * e).sum::<f64>()) - 1.0).abs() < 1e-12);
        let projected = model.initial != Initial::Rest;
        let mut worst = 0.0_f64;
        for parameter in 0..8 {
            let shifted = |by: f64| {
                let (mut o, mut c) = (orders, coefficients);
                if parameter < 3 {
                    o[parameter] += by;
                } else {
                    c[parameter - 3] += by * coefficients[parameter - 3].abs();
                }
                at(&model, &experiments, &o, &c)
            };
            let d = 1e-4;
            let (up, down) = (shifted(d), shifted(-d));
            let unit = if parameter < 3 { 1.0 } else { coefficients[parameter - 3].abs() };
            let column: Vec<f64> = here.jacobian[parameter].iter().map(|v| v * unit).collect();
            if projected {
                // Where initial terms are projected out the residuals turn with the parameters too (which Kaufman's
                // form leaves out), but not their cost: its slope is exact.
                let slope = (up.cost - down.cost) / (2.0 * d);
                let exact: f64 = column.iter().zip(&here.residuals).map(|(j, e)| j * e).sum();
                worst = worst.max((slope - exact).abs() / (norm(&column) * norm(&here.residuals)));
            } else {
                let slope: Vec<f64> =
                    up.residuals.iter().zip(&down.residuals).map(|(u, l)| (u - l) / (2.0 * d)).collect();
                worst = worst.max(relative_distance(&slope, &column));
            }
        }
        check(&format!("Jacobian against differences, {name}"), worst, 1e-6);
    }
}

#[test]
fn known_models_are_recovered() {
    for (name, model, experiments) in [
        ("one run", two_link(true, Initial::Rest), vec![run(300, 1, &[], 0.0, 410)]),
        (
            "two runs, refined",
            two_link(true, Initial::Rest),
            vec![run(200, 2, &[], 0.0, 411), run(120, 3, &[], 0.0, 412)],
        ),
        ("measured coupling", two_link(false, Initial::Rest), vec![run(300, 1, &[], 0.0, 413)]),
        (
            "not from rest",
            two_link(true, Initial::Powers(vec![0.0, 1.0])),
            vec![run(300, 1, &[vec![(0.0, 0.3)], vec![(0.0, -0.1), (1.0, 0.2)]], 0.0, 414), run(200, 1, &[], 0.0, 415)],
        ),
    ] {
        let found = fit(&model, &experiments, &point(&START.0, &START.1), MinimizationSettings::default()).unwrap();
        assert_eq!(found.status, Status::Converged, "{name}");
        check(&format!("orders, {name}"), relative_distance(&found.point.orders, &ORDERS), 1e-9);
        check(&format!("coefficients, {name}"), relative_distance(&found.point.coefficients, &COEFFICIENTS), 1e-9);
        check(&format!("residuals, {name}"), norm(&found.residuals), 1e-9);
        println!("{name}: {} evaluations", found.evaluations);
        assert_eq!((found.initial.len(), found.exponents.len()), (experiments.len(), 2));
        if name == "not from rest" {
            assert!((found.initial[0][0][0] - 0.3).abs() < 1e-6 && (found.initial[0][1][1] - 0.2).abs() < 1e-6);
            assert!(found.initial[1].iter().flatten().all(|x| x.abs() < 1e-6));
        }
    }
}

#[test]
fn estimates_from_noise_are_as_near_as_their_deviations_say() {
    let model = two_link(true, Initial::Rest);
    let (mut sum, mut count) = (0.0, 0);
    for seed in 420..428 {
        let experiments = [run(400, 1, &[], 0.02, seed)];
        let found = fit(&model, &experiments, &point(&START.0, &START.1), MinimizationSettings::default()).unwrap();
        assert_eq!(found.status, Status::Converged);
        let rows = found.residuals.len() as f64;
        check_between("chi-squared per sample", 2.0 * found.cost / rows, 0.8, 1.2);
        // The optimum: residuals orthogonal to every derivative.
        for column in &found.jacobian {
            let product: f64 = column.iter().zip(&found.residuals).map(|(j, e)| j * e).sum();
            assert!(product.abs() < 1e-3 * norm(column) * norm(&found.residuals));
        }
        let normal: Vec<f64> = found
            .jacobian
            .iter()
            .flat_map(|a| found.jacobian.iter().map(move |b| a.iter().zip(b).map(|(x, y)| x * y).sum()))
            .collect();
        for (i, (value, exact)) in found
            .point
            .orders
            .iter()
            .chain(&found.point.coefficients)
            .zip(ORDERS.iter().chain(&COEFFICIENTS))
            .enumerate()
        {
            let mut unit = [0.0; 8];
            unit[i] = 1.0;
            let variance = dense_solve(&normal, &unit)[i];
            let z = (value - exact) / variance.sqrt();
            assert!(z.abs() < 4.0, "seed {seed}, parameter {i}: z = {z}");
            sum += z * z;
            count += 1;
        }
    }
    check_between("mean square of z", sum / f64::from(count), 0.6, 1.5);
}

#[test]
fn optimum_within_bounds_is_found() {
    let mut model = two_link(true, Initial::Rest);
    // The true 0.1 of β₂ is out of reach.
    model.order_bounds[1] = (0.2, 0.5);
    let experiments = [run(300, 1, &[], 0.01, 430)];
    let found =
        fit(&model, &experiments, &point(&[2.0, -1.0, 0.8], &START.1), MinimizationSettings::default()).unwrap();
    assert_eq!(found.point.orders[1], 0.2);
    assert!(found.point.orders.iter().zip(&model.order_bounds).all(|(o, b)| (b.0..=b.1).contains(o)));
    // An order without room is fixed.
    model.order_bounds = ORDERS.iter().map(|&o| (o, o)).collect();
    let found = fit(&model, &experiments, &point(&ORDERS, &START.1), MinimizationSettings::default()).unwrap();
    assert_eq!(found.point.orders, ORDERS);
    assert!(relative_distance(&found.point.coefficients, &COEFFICIENTS) < 0.05);
}

#[test]
fn problems_without_initial_guess_are_rejected() {
    let model = two_link(true, Initial::Rest);
    let experiments = [run(100, 2, &[], 0.01, 431)];
    let start = |orders: &[f64], coefficients: &[f64]| {
        fit(&model, &experiments, &point(orders, coefficients), MinimizationSettings::default()).map(|_| ())
    };
    assert!(matches!(start(&ORDERS[..2], &COEFFICIENTS), Err(Error::Length { .. })));
    assert!(matches!(start(&ORDERS, &COEFFICIENTS[..4]), Err(Error::Length { .. })));
    for (i, bad) in [(0, 0.0), (1, f64::NAN), (2, f64::INFINITY), (4, 1.0), (4, 0.5)] {
        let mut coefficients = COEFFICIENTS;
        coefficients[i] = bad;
        match start(&ORDERS, &coefficients) {
            Err(Error::OutOfRange { name, .. }) => assert_eq!(name, format!("initial guess of coefficient {i}")),
            other => panic!("{other:?}"),
        }
    }
    let mut short = experiments[0].clone();
    Arc::make_mut(&mut short.samples)[1].pop();
    assert!(matches!(
        fit(&model, &[short], &point(&ORDERS, &COEFFICIENTS), MinimizationSettings::default()),
        Err(Error::Length { .. })
    ));
    let mut few = experiments[0].clone();
    few.weights.pop();
    assert!(matches!(
        fit(&model, &[few], &point(&ORDERS, &COEFFICIENTS), MinimizationSettings::default()),
        Err(Error::Length { .. })
    ));
    // A start that explodes.
    let long = [run(3000, 1, &[], 0.01, 432)];
    let wild = [-4e4, -6.0, 1.5, 14.0, 1.4];
    assert!(matches!(
        fit(&model, &long, &point(&ORDERS, &wild), MinimizationSettings::default()),
        Err(Error::Diverged { .. })
    ));
}

#[test]
fn exhausted_evaluations_are_reported() {
    let model = two_link(true, Initial::Rest);
    let experiments = [run(200, 1, &[], 0.01, 433)];
    let mut last = f64::INFINITY;
    for evaluations in [1, 3, 6] {
        let settings = MinimizationSettings { evaluations, ..MinimizationSettings::default() };
        let found = fit(&model, &experiments, &point(&START.0, &START.1), settings).unwrap();
        assert_eq!((found.status, found.evaluations), (Status::Exhausted, evaluations));
        assert!(found.cost <= last);
        last = found.cost;
    }
}

#[test]
fn a_filter_on_the_outputs_is_part_of_the_model() {
    let low_pass = |m: usize| -> Vec<f64> { (0..m).map(|k| 0.3 * 0.7_f64.powi(i32::try_from(k).unwrap())).collect() };
    let mut experiment = run(300, 1, &[], 0.0, 434);
    let m = experiment.record.m();
    let logged: Record = {
        let filtered = series::multiply(&low_pass(m), experiment.record.signal(1), m);
        Arc::make_mut(&mut experiment.samples)[1] = point_samples(&filtered);
        with_signal(&experiment.record, 1, filtered)
    };
    experiment.record = logged.into();
    let model = two_link(true, Initial::Rest);
    let without =
        fit(&model, std::slice::from_ref(&experiment), &point(&START.0, &START.1), MinimizationSettings::default())
            .unwrap();
    experiment.filter = Some((low_pass(m), vec![false, true]));
    let with = fit(&model, &[experiment], &point(&START.0, &START.1), MinimizationSettings::default()).unwrap();
    check("coefficients through the filter", relative_distance(&with.point.coefficients, &COEFFICIENTS), 1e-9);
    assert!(without.cost > 1e6 * with.cost);
}

/// A run whose input acts `delay` seconds late; the record has it as it was given.
fn delayed_experiment(delay: f64, every: usize, noise: f64, seed: u64) -> Experiment {
    let mut experiment = run(220, every, &[], 0.0, seed);
    let given = experiment.record.clone();
    let arrived = delay_samples(given.signal(2), delay / given.step(), 0.0).unwrap();
    let outputs = simulate::respond(&truth(), &with_signal(&given, 2, arrived), &[]).unwrap();
    let mut random = Random::new(seed + 1);
    for (i, means) in outputs.into_iter().enumerate() {
        let clean: Vec<f64> = point_samples(&means).into_iter().step_by(every).collect();
        let sigma = noise * deviation(&clean);
        experiment.weights[i] = if noise > 0.0 { 1.0 / sigma } else { 1.0 / deviation(&clean) };
        Arc::make_mut(&mut experiment.samples)[i] = clean.iter().map(|y| y + sigma * random.normal()).collect();
        experiment.record = with_signal(&experiment.record, i, means).into();
    }
    experiment
}

fn with_delay(coupled: bool) -> FreeModel {
    FreeModel {
        inputs: vec![FreeInput { signal: 2, law: InputLaw::Delay, bounds: (0.0, 0.2) }],
        ..two_link(coupled, Initial::Rest)
    }
}

#[test]
fn derivative_by_delay_matches_the_residuals() {
    for coupled in [true, false] {
        let (model, experiments) = (with_delay(coupled), [delayed_experiment(0.057, 2, 0.02, 500)]);
        let settings = MinimizationSettings { evaluations: 1, ..MinimizationSettings::default() };
        let here = |delay: f64| {
            let start = ParameterPoint { inputs: vec![delay], ..point(&START.0, &START.1) };
            fit(&model, &experiments, &start, settings).unwrap()
        };
        // Inside a step residuals are linear in the delay, so the difference is exact; 0.057 s is 5.7 steps.
        let (at, up, down) = (here(0.057), here(0.0575), here(0.0565));
        let size = norm(&at.jacobian[8]);
        assert!(size > 0.0);
        let slope: Vec<f64> = up.residuals.iter().zip(&down.residuals).map(|(u, d)| (u - d) / 1e-3).collect();
        check("slope towards a delay", relative_distance(&at.jacobian[8], &slope), 1e-9);
    }
}

#[test]
fn delay_is_estimated_with_the_other_parameters() {
    for (coupled, every, delay) in [(true, 1, 0.05), (true, 2, 0.033), (false, 1, 0.11), (true, 1, 0.0), (true, 1, 0.2)]
    {
        let model = with_delay(coupled);
        let start = ParameterPoint { inputs: vec![0.08], ..point(&START.0, &START.1) };
        let found = fit(&model, &[delayed_experiment(delay, every, 0.0, 510)], &start, MinimizationSettings::default())
            .unwrap();
        let miss = (found.point.inputs[0] - delay).abs();
        assert!(miss < 1e-6, "delay {delay}: {} s", found.point.inputs[0]);
        check("orders beside a delay", relative_distance(&found.point.orders, &ORDERS), 1e-5);
        check("coefficients beside a delay", relative_distance(&found.point.coefficients, &COEFFICIENTS), 1e-5);
    }
}

#[test]
fn delay_estimate_agrees_with_its_standard_error() {
    let (model, delay) = (with_delay(true), 0.047);
    let start = ParameterPoint { inputs: vec![0.08], ..point(&START.0, &START.1) };
    let mut scores = Vec::new();
    for seed in 0..40 {
        let found =
            fit(&model, &[delayed_experiment(delay, 1, 0.02, 600 + 2 * seed)], &start, MinimizationSettings::default())
                .unwrap();
        let normal: Vec<f64> = (0..9)
            .flat_map(|i| (0..9).map(move |j| (i, j)))
            .map(|(i, j)| found.jacobian[i].iter().zip(&found.jacobian[j]).map(|(a, b)| a * b).sum())
            .collect();
        let last: Vec<f64> = (0..9).map(|i| f64::from(i == 8)).collect();
        scores.push((found.point.inputs[0] - delay) / dense_solve(&normal, &last)[8].sqrt());
    }
    let mean = scores.iter().sum::<f64>() / scores.len() as f64;
    // Of forty standard normal numbers: the mean scatters by 0.16, the deviation by 0.11.
    assert!(mean.abs() < 0.6, "mean {mean}");
    check_between("deviation of the scores", deviation(&scores), 0.6, 1.4);
}

/// Two equations that feed through: each output drives the other at once, and the input both.
fn feedthrough_model(coupled: bool, initial: Initial, inputs: Vec<FreeInput>) -> FreeModel {
    let fixed = |order: f64| AffineOrder { constant: order, weights: Vec::new() };
    let equation = |output: usize, other: usize, order: f64, first: usize| FreeEquation {
        output,
        order: fixed(order),
        terms: vec![
            (output, fixed(0.0), monomial(-1.0, &[first])),
            (other, fixed(order), monomial(1.0, &[first + 1])),
            (2, fixed(order), monomial(1.0, &[first + 2])),
            (2, fixed(0.0), monomial(2.0, &[first, first + 2])),
        ],
    };
    FreeModel {
        equations: vec![equation(0, 1, 1.2, 0), equation(1, 0, 0.7, 3)],
        order_bounds: Vec::new(),
        coordinates: vec![Coordinate::Plain; 6],
        inputs,
        coupled,
        priors: Vec::new(),
        initial,
    }
}

#[test]
fn feedthrough_derivative_matches_the_residuals() {
    let coefficients = [1.5, 0.4, 0.7, 0.9, -0.3, 0.5];
    let delayed = || vec![FreeInput { signal: 2, law: InputLaw::Delay, bounds: (0.0, 0.2) }];
    for (name, model) in [
        ("coupled", feedthrough_model(true, Initial::Rest, Vec::new())),
        ("measured coupling", feedthrough_model(false, Initial::Rest, Vec::new())),
        ("delayed", feedthrough_model(true, Initial::Rest, delayed())),
    ] {
        let mut experiment = run(80, 2, &[], 0.02, 700);
        let held = Random::new(701).signal(81);
        let instants = experiment
            .samples
            .iter()
            .cloned()
            .map(|values| PointValues { values: Some(values), is_zero_order_hold: false });
        experiment.point_values =
            instants.chain([PointValues { values: Some(held), is_zero_order_hold: true }]).collect::<Vec<_>>().into();
        let at = |c: &[f64], delay: f64| {
            let inputs = model.inputs.iter().map(|_| delay).collect();
            let start = ParameterPoint { orders: Vec::new(), coefficients: c.to_vec(), inputs };
            let settings = MinimizationSettings { evaluations: 1, ..MinimizationSettings::default() };
            fit(&model, std::slice::from_ref(&experiment), &start, settings).unwrap()
        };
        let here = at(&coefficients, 0.057);
        for (i, column) in here.jacobian.iter().enumerate() {
            let shifted = |by: f64| {
                let mut c = coefficients;
                if let Some(c) = c.get_mut(i) {
                    *c += by;
                }
                at(&c, if i == 6 { 0.057 + by } else { 0.057 })
            };
            let d = 1e-4;
            let (up, down) = (shifted(d), shifted(-d));
            let slope: Vec<f64> = up.residuals.iter().zip(&down.residuals).map(|(u, l)| (u - l) / (2.0 * d)).collect();
            assert!(norm(column) > 0.0);
            check(&format!("slope of what feeds through, {name}, {i}"), relative_distance(column, &slope), 1e-6);
        }
    }
}

#[test]
fn direct_feedthrough_acts_at_the_sample_time() {
    // y = 0.4 x + 0.7 u and x = -0.3 y + 0.5 u at once: with no other term the samples are those of the two by two.
    let mut model = feedthrough_model(true, Initial::Rest, Vec::new());
    model.equations.iter_mut().for_each(|e| {
        e.terms.remove(3);
        e.terms[0].2 = Monomial { factor: 0.0, powers: vec![(0, 1)] };
    });
    let input = Random::new(702).signal(41);
    let determinant = 1.0 + 0.4 * 0.3;
    let rows = [(0.7 + 0.4 * 0.5) / determinant, (0.5 - 0.3 * 0.7) / determinant];
    let samples: Vec<Vec<f64>> = rows.iter().map(|g| input.iter().map(|u| g * u).collect()).collect();
    let record = record(0.1, vec![vec![0.0; 40], vec![0.0; 40], input[..40].to_vec()]);
    let instants = vec![
        PointValues::default(),
        PointValues::default(),
        PointValues { values: Some(input), is_zero_order_hold: true },
    ];
    let experiment = Experiment::new(record, 1, samples, vec![1.0, 1.0]).unwrap().with_point_values(instants).unwrap();
    let found = at(&model, std::slice::from_ref(&experiment), &[], &[1.0, 0.4, 0.7, 1.0, -0.3, 0.5]);
    check("samples that feed through", norm(&found.residuals), 1e-12);
    let short = vec![
        PointValues::default(),
        PointValues::default(),
        PointValues { values: Some(vec![0.0]), is_zero_order_hold: true },
    ];
    assert!(matches!(experiment.clone().with_point_values(short), Err(Error::Length { .. })));
    assert!(matches!(experiment.with_point_values(vec![PointValues::default()]), Err(Error::Length { .. })));
}

#[test]
fn fit_at_the_limit_of_its_pulse_grid_reports_it() {
    // y' = -c y + c u of data in which y = u: they ask for a pole beyond what the grid sees.
    let input = Random::new(703).steps(200, 5);
    let record = record(0.1, vec![vec![0.0; 200], input.clone()]);
    let response = point_samples(&input);
    let experiment = Experiment::new(record, 1, vec![response], vec![1.0]).unwrap();
    let fixed = |order: f64| AffineOrder { constant: order, weights: Vec::new() };
    let model = FreeModel {
        equations: vec![FreeEquation {
            output: 0,
            order: fixed(1.0),
            terms: vec![(0, fixed(0.0), monomial(-1.0, &[0])), (1, fixed(0.0), monomial(1.0, &[0]))],
        }],
        order_bounds: Vec::new(),
        coordinates: vec![Coordinate::Logarithm],
        inputs: Vec::new(),
        coupled: false,
        priors: Vec::new(),
        initial: Initial::Rest,
    };
    let settings = MinimizationSettings { evaluations: 500, tolerance: 1e-7 };
    let found = fit(&model, &[experiment], &point(&[], &[2.0]), settings).unwrap();
    assert_eq!(found.status, Status::DomainLimit, "{:?}", found.point);
}

#[test]
fn zero_evaluations_give_residuals_without_derivatives() {
    let experiments = [run(100, 1, &[], 0.05, 431)];
    let model = two_link(true, Initial::Caputo);
    let there = at(&model, &experiments, &START.0, &START.1);
    let settings = MinimizationSettings { evaluations: 0, ..MinimizationSettings::default() };
    let found = fit(&model, &experiments, &point(&START.0, &START.1), settings).unwrap();
    assert_eq!((&found.residuals, found.cost, found.status), (&there.residuals, there.cost, there.status));
    assert!(found.jacobian.is_empty() && !there.jacobian.is_empty());
}

#[test]
fn fixed_coefficient_stays_and_the_others_are_optimal() {
    let experiments = [run(200, 1, &[], 0.05, 430)];
    let free = two_link(true, Initial::Rest);
    let whole = fit(&free, &experiments, &point(&START.0, &START.1), MinimizationSettings::default()).unwrap();
    let settings = MinimizationSettings { evaluations: 200, tolerance: 1e-12 };
    // A coefficient by its coordinate, an order by its bounds.
    let (mut coefficient, mut order) = (free.clone(), free.clone());
    coefficient.coordinates[3] = Coordinate::Fixed;
    let mut start = whole.point.clone();
    start.coefficients[3] *= 1.05;
    let there = fit(&coefficient, &experiments, &start, settings).unwrap();
    assert_eq!(there.point.coefficients[3].to_bits(), start.coefficients[3].to_bits());
    let mut beside = whole.point.clone();
    beside.orders[0] += 0.02;
    order.order_bounds[0] = (beside.orders[0], beside.orders[0]);
    let other = fit(&order, &experiments, &beside, settings).unwrap();
    assert_eq!(other.point.orders[0].to_bits(), beside.orders[0].to_bits());
    for (held, found) in [(6, there), (0, other)] {
        assert_eq!(found.status, Status::Converged);
        assert!(found.cost > whole.cost);
        for (i, column) in found.jacobian.iter().enumerate() {
            let along: f64 = column.iter().zip(&found.residuals).map(|(j, e)| j * e).sum();
            let cosine = along.abs() / (norm(column) * norm(&found.residuals));
            // The gradient is left along what is held, and nowhere else.
            assert_eq!(cosine > 1e-4, i == held, "{held} {i} {cosine}");
        }
    }
}

/// A model with its orders known to be these.
fn with_known_orders(model: &FreeModel, orders: &[f64]) -> FreeModel {
    let known = |law: &AffineOrder| {
        let free: f64 = law.weights.iter().zip(orders).map(|(w, x)| w * x).sum();
        AffineOrder { constant: law.constant + free, weights: Vec::new() }
    };
    let mut out = model.clone();
    for equation in &mut out.equations {
        equation.order = known(&equation.order);
        equation.terms.iter_mut().for_each(|(_, order, _)| *order = known(order));
    }
    out.order_bounds.clear();
    out
}

#[test]
fn fixed_integer_orders_match_free_orders_at_the_same_values() {
    // Known, they are solved by running sums; where they may move, by transforms.
    let whole = [1.0, 0.0, 1.0];
    let mut cases = variants();
    let (_, model, experiments) = &cases[0];
    let delay = FreeInput { signal: 2, law: InputLaw::Delay, bounds: (0.0, 0.1) };
    let delayed = ("delayed", FreeModel { inputs: vec![delay], ..model.clone() }, experiments.clone());
    cases.push(delayed);
    for (name, model, experiments) in cases {
        let known = with_known_orders(&model, &whole);
        let inputs = vec![0.03; model.inputs.len()];
        let settings = MinimizationSettings { evaluations: 1, ..MinimizationSettings::default() };
        let at = |model: &FreeModel, orders: &[f64]| {
            let start =
                ParameterPoint { orders: orders.to_vec(), coefficients: START.1.to_vec(), inputs: inputs.clone() };
            fit(model, &experiments, &start, settings).unwrap()
        };
        let (moving, still) = (at(&model, &whole), at(&known, &[]));
        let mut worst = relative_distance(&still.residuals, &moving.residuals);
        assert_eq!(moving.jacobian.len(), still.jacobian.len() + 3);
        for (a, b) in still.jacobian.iter().zip(&moving.jacobian[3..]) {
            worst = worst.max(relative_distance(a, b));
        }
        for (a, b) in still.initial.iter().flatten().zip(moving.initial.iter().flatten()) {
            worst = worst.max(if a.is_empty() { 0.0 } else { relative_distance(a, b) });
        }
        check(&format!("running sums against transforms, {name}"), worst, 1e-9);
        let (there, here) =
            (fit(&known, &experiments, &at(&known, &[]).point, MinimizationSettings::default()).unwrap(), still.cost);
        assert!(there.cost < here);
    }
}

/// D^1.5 y = c₀ y + c₁ u₁ + c₂ D^0.3 u₂ on two runs.
fn driven_problem() -> (FreeModel, Vec<Experiment>) {
    let fixed = |order: f64| AffineOrder { constant: order, weights: Vec::new() };
    let model = FreeModel {
        equations: vec![FreeEquation {
            output: 0,
            order: fixed(1.5),
            terms: vec![
                (0, fixed(0.0), monomial(1.0, &[0])),
                (1, fixed(0.0), monomial(1.0, &[1])),
                (2, fixed(0.3), monomial(-1.0, &[2])),
            ],
        }],
        order_bounds: Vec::new(),
        coordinates: vec![Coordinate::Logarithm; 3],
        inputs: Vec::new(),
        coupled: false,
        priors: Vec::new(),
        initial: Initial::Caputo,
    };
    let mut random = Random::new(811);
    let experiments = (0..2)
        .map(|_| {
            let inputs = [random.steps(240, 6), random.steps(240, 9)];
            let signals = record(0.05, vec![vec![0.0; 240], inputs[0].clone(), inputs[1].clone()]);
            let truth = equation(0, 1.5, &[(0, 0.0, -4.0), (1, 0.0, 3.0), (2, 0.3, -0.5)]);
            let clean = simulate::respond(&[truth], &signals, &[Vec::new()]).unwrap();
            let samples = point_samples(&clean[0]).iter().map(|v| v + 0.01 * random.normal()).collect();
            Experiment::new(signals, 1, vec![samples], vec![1.0]).unwrap()
        })
        .collect();
    (model, experiments)
}

#[test]
fn input_coefficients_match_dense_least_squares() {
    let (mut model, experiments) = driven_problem();
    let once = MinimizationSettings { evaluations: 1, ..MinimizationSettings::default() };
    let residuals = |b: f64, c: f64| fit(&model, &experiments, &point(&[], &[-3.0, b, c]), once).unwrap().residuals;
    // The residuals are linear in both: columns by differences, and the normal equations.
    let none = residuals(1e-300, 1e-300);
    let columns: Vec<Vec<f64>> = [residuals(1.0, 1e-300), residuals(1e-300, 1.0)]
        .iter()
        .map(|there| there.iter().zip(&none).map(|(a, b)| a - b).collect())
        .collect();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let gram: Vec<f64> = columns.iter().flat_map(|a| columns.iter().map(|b| dot(a, b))).collect();
    let rhs: Vec<f64> = columns.iter().map(|a| -dot(a, &none)).collect();
    let best = dense_solve(&gram, &rhs);
    model.coordinates[0] = Coordinate::Fixed;
    for start in [[1.0, 1.0], [-700.0, 2e5]] {
        let settings = MinimizationSettings { evaluations: 5, ..MinimizationSettings::default() };
        let found = fit(&model, &experiments, &point(&[], &[-3.0, start[0], start[1]]), settings).unwrap();
        assert_eq!(found.status, Status::Converged);
        check("linear coefficients", relative_distance(&found.point.coefficients[1..], &best), 1e-8);
    }
}

#[test]
fn optimum_is_independent_of_initial_input_coefficients() {
    let (model, experiments) = driven_problem();
    let settings = MinimizationSettings { evaluations: 15, tolerance: 1e-12 };
    let ends: Vec<OutputErrorFit> = [[3.0, 0.5], [-3.0, -0.5], [1e4, -1e-4]]
        .iter()
        .map(|start| fit(&model, &experiments, &point(&[], &[-1.5, start[0], start[1]]), settings).unwrap())
        .collect();
    for found in &ends {
        assert_eq!(found.status, Status::Converged, "{:?}", found.point);
        check("truth", relative_distance(&found.point.coefficients, &[-4.0, 3.0, 0.5]), 0.02);
        check("one optimum", relative_distance(&found.point.coefficients, &ends[0].point.coefficients), 1e-6);
    }
}

#[test]
fn unexcited_parameters_keep_their_values() {
    let (model, experiments) = driven_problem();
    let still = |e: &Experiment| {
        let signals = with_signal(&e.record, 2, vec![0.0; e.record.m()]);
        Experiment::new(signals, 1, e.samples.to_vec(), vec![1.0]).unwrap()
    };
    let experiments: Vec<Experiment> = experiments.iter().map(still).collect();
    let found = fit(&model, &experiments, &point(&[], &[-4.0, 3.0, 7.5]), MinimizationSettings::default()).unwrap();
    assert_eq!(found.point.coefficients[2], 7.5);
}

/// Residuals and their slopes of a fit and of the same point evaluated by itself are the same.
fn assert_fits_agree(name: &str, found: &OutputErrorFit, alone: &OutputErrorFit) {
    check(&format!("{name}: residuals"), relative_distance(&found.residuals, &alone.residuals), 1e-8);
    for (parameter, (one, other)) in found.jacobian.iter().zip(&alone.jacobian).enumerate() {
        check(&format!("{name}: slope {parameter}"), relative_distance(one, other), 1e-5);
    }
}

#[test]
fn runs_on_one_grid_share_kernels() {
    let still = [vec![(0.0, 0.3)], vec![(0.0, -0.1), (1.0, 0.2)]];
    // The first is alone on its grid, and so is the last, which is too short to share.
    let runs = [
        run(150, 2, &still, 0.02, 410),
        run(150, 1, &still, 0.02, 411),
        run(131, 1, &[], 0.02, 412),
        run(40, 1, &[], 0.02, 413),
    ];
    for (coupled, initial) in [(true, Initial::Caputo), (false, Initial::Caputo), (true, Initial::Rest)] {
        let model = two_link(coupled, initial);
        let (orders, coefficients) = ([0.8, 0.2, 0.85], START.1);
        let together = at(&model, &runs, &orders, &coefficients);
        let alone: Vec<OutputErrorFit> =
            runs.iter().map(|one| at(&model, std::slice::from_ref(one), &orders, &coefficients)).collect();
        let joined = |rows: &dyn Fn(&OutputErrorFit) -> Vec<f64>| alone.iter().flat_map(rows).collect::<Vec<f64>>();
        check("residuals", relative_distance(&together.residuals, &joined(&|fit| fit.residuals.clone())), 1e-10);
        for parameter in 0..8 {
            let rows = joined(&|fit| fit.jacobian[parameter].clone());
            check(&format!("slope {parameter}"), relative_distance(&together.jacobian[parameter], &rows), 1e-9);
        }
        assert_eq!(together.initial.len(), 4);
        for (one, other) in together.initial.iter().zip(&alone) {
            check("initial terms", relative_distance(&one.concat(), &other.initial[0].concat()), 1e-8);
        }
    }
}

#[test]
fn filter_of_all_outputs_can_be_applied_to_the_inputs() {
    let still = [vec![(0.0, 0.3)], vec![(0.0, -0.1), (1.0, 0.2)]];
    for (name, coupled, initial) in [
        ("coupled", true, Initial::Caputo),
        ("measured coupling", false, Initial::Caputo),
        ("with impulses", false, Initial::Filtered { base: Box::new(Initial::Powers(vec![0.0])), states: 1 }),
        ("from rest", true, Initial::Rest),
    ] {
        let runs: Vec<Experiment> = [(150, 420), (131, 421)]
            .into_iter()
            .map(|(intervals, seed)| {
                let run = run(intervals, 1, &still, 0.02, seed);
                let series = (0..run.record.m()).map(|k| 0.4 * 0.6_f64.powi(i32::try_from(k).unwrap())).collect();
                run.with_filter(series, vec![true, true]).unwrap()
            })
            .collect();
        let model = two_link(coupled, initial);
        let start = point(&[0.8, 0.2, 0.85], &START.1);
        // More than one evaluation lets it pass first, one by itself does not.
        let found =
            fit(&model, &runs, &start, MinimizationSettings { evaluations: 4, ..MinimizationSettings::default() })
                .unwrap();
        assert!(found.evaluations > 1);
        assert_fits_agree(name, &found, &at(&model, &runs, &found.point.orders, &found.point.coefficients));
    }
}
