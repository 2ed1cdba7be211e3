//! Arguments that would cause a panic, a hang or exhausted memory return an error at once.

use ftlm::equation::{round_order, AffineOrder, Equation, Filter, Initial, Structure, Term};
use ftlm::error::{check_dense, check_points, Error, MAX_POINTS};
use ftlm::estimation::instrumental_variables;
use ftlm::estimation::joint_fit::parameter_set::ParameterSet;
use ftlm::estimation::joint_fit::{structure as joint, Problem};
use ftlm::estimation::least_squares::{self, Regression};
use ftlm::estimation::multi_innovation::Prior;
use ftlm::estimation::output_error::{Coordinate, Experiment, FreeEquation, FreeModel, Monomial};
use ftlm::estimation::streaming::{Streaming, StreamingOptions};
use ftlm::fft;
use ftlm::fractional::exponential_sum::{integral_by_memory, Rates};
use ftlm::fractional::integral::{fractional_derivative, fractional_integral, Derivative, IntegralRule};
use ftlm::fractional::kernels::digamma;
use ftlm::fractional::operational_matrices;
use ftlm::linalg::small::{self, Recursion, SlidingGram};
use ftlm::rig::arm_model::{Arm, Parameters};
use ftlm::rig::virtual_arm::{Injection, Pace, Plant, Sensors};
use ftlm::series;
use ftlm::signal::block_pulse::{delay_samples, pulse_means, Intersample};
use ftlm::signal::metrics;
use ftlm::simulate::{self, OutputFilter};

use crate::common::{equation, record, structure};

/// Fails unless this is refused, and with more than a few words.
#[track_caller]
fn assert_rejected<T>(result: Result<T, Error>) {
    match result {
        Ok(_) => panic!("not refused"),
        Err(Error::Internal { what }) => panic!("a fault: {what}"),
        Err(error) => assert!(error.to_string().len() > 20, "{error}"),
    }
}

#[test]
fn lengths_above_memory_are_rejected() {
    for m in [MAX_POINTS + 1, 1 << 31, 1 << 60, usize::MAX] {
        assert_rejected(check_points("m", m));
        assert_rejected(check_dense(m));
        assert_rejected(pulse_means(&[0.0, 1.0], m, Intersample::Hold));
        assert_rejected(Filter { numerator: vec![(1.0, 0.0)], denominator: vec![(1.0, 1.0)] }.series(m, 0.1));
        assert_rejected(operational_matrices::haar_matrix(m));
        assert_rejected(operational_matrices::block_pulse_matrix(0.5, m, 0.1));
        assert_rejected(operational_matrices::operational_matrix(0.5, m, 0.1));
    }
    assert_rejected(check_dense(0));
    check_points("m", MAX_POINTS).unwrap();
}

#[test]
fn incomplete_equations_are_rejected() {
    let s = structure(0, 2.0, &[(0, 1.0), (1, 0.0)]);
    assert_rejected(Equation::new(s.clone(), vec![1.0]));
    assert_rejected(Equation::new(s.clone(), vec![1.0, f64::NAN]));
    let whole = Equation::new(s.clone(), vec![-1.0, 2.0]).unwrap();
    whole.check(2).unwrap();
    assert_rejected(whole.check(1));
    let run = record(0.1, vec![vec![0.5; 20], vec![1.0; 20]]);
    let short = Equation { structure: s.clone(), coefficients: vec![1.0] };
    let missing = equation(0, 2.0, &[(5, 0.0, 1.0)]);
    let nan = equation(0, 2.0, &[(1, 0.0, f64::NAN)]);
    for bad in [&short, &missing, &nan] {
        let bad = std::slice::from_ref(bad);
        assert_rejected(simulate::respond(bad, &run, &[]));
        assert_rejected(simulate::respond_damped(bad, &run, &[], 0.1));
        assert_rejected(simulate::inverse(bad, &run));
        assert_rejected(simulate::respond_with_initial(bad, &run, &Initial::Rest, None));
        assert_rejected(simulate::equation_error(&bad[0], &run, &Initial::Rest));
    }
    let good = std::slice::from_ref(&whole);
    assert_rejected(simulate::respond(good, &run, &[vec![(0.0, f64::NAN)]]));
    assert_rejected(simulate::respond(good, &run, &[vec![(-1.5, 1.0)]]));
    assert_rejected(simulate::respond(good, &run, &[vec![], vec![]]));
    assert_rejected(simulate::respond_with_initial(good, &run, &Initial::Powers(vec![-2.0]), None));
    let filter = |series, applies| Some(OutputFilter { series, applies });
    assert_rejected(simulate::respond_with_initial(good, &run, &Initial::Rest, filter(&[1.0], &[true])));
    assert_rejected(simulate::respond_with_initial(good, &run, &Initial::Rest, filter(&[1.0; 20], &[])));
    assert_rejected(simulate::explicit_euler(std::slice::from_ref(&short), &[vec![0.0; 5], vec![0.0; 5]], 0.1));
    let euler = [equation(0, 2.0, &[(1, 0.0, 1.0)])];
    assert_rejected(simulate::explicit_euler(&euler, &[vec![0.0; 5], vec![0.0; 4]], 0.1));
    assert_rejected(simulate::explicit_euler(&euler, &[vec![0.0; 5], vec![f64::NAN; 5]], 0.1));
    assert_rejected(simulate::explicit_euler(&euler, &[vec![0.0; 5], vec![0.0; 5]], 0.0));
}

#[test]
fn invalid_regressions_are_rejected() {
    let run = [record(0.1, vec![vec![0.5; 20], vec![1.0; 20]])];
    let there = structure(0, 1.0, &[(1, 0.0)]);
    assert_rejected(Regression::new(&run, &structure(0, 1.0, &[(7, 0.0)]), &[None], &Initial::Rest).map(|_| ()));
    assert_rejected(Regression::new(&run, &structure(9, 1.0, &[(1, 0.0)]), &[None], &Initial::Rest).map(|_| ()));
    assert_rejected(least_squares::fit(&run, &there, &[Some(f64::NAN)], &Initial::Rest));
    assert_rejected(least_squares::fit(&run, &there, &[None], &Initial::Powers(vec![f64::NAN])));
    assert_rejected(least_squares::fit(&[], &there, &[None], &Initial::Rest));
    assert_rejected(least_squares::solve(&[vec![1.0; 3]], &[1.0; 4], 1));
    assert_rejected(instrumental_variables::fit(
        &run,
        &[],
        &[],
        &Initial::Rest,
        instrumental_variables::InstrumentalSettings::default(),
    ));
    for wrong in [
        instrumental_variables::InstrumentalSettings {
            iterations: 1 << 62,
            ..instrumental_variables::InstrumentalSettings::default()
        },
        instrumental_variables::InstrumentalSettings {
            tolerance: f64::NAN,
            ..instrumental_variables::InstrumentalSettings::default()
        },
    ] {
        assert_rejected(instrumental_variables::fit(
            &run,
            &[structure(0, 1.0, &[(1, 0.0)])],
            &[vec![None]],
            &Initial::Rest,
            wrong,
        ));
    }
    assert_rejected(instrumental_variables::fit(
        &run,
        &[structure(0, 1.0, &[(7, 0.0)])],
        &[vec![None]],
        &Initial::Rest,
        instrumental_variables::InstrumentalSettings::default(),
    ));
}

#[test]
fn solution_of_another_size_is_rejected() {
    let run = [record(0.1, vec![(0..20).map(f64::from).collect(), vec![1.0; 20]])];
    let initial = Initial::Powers(vec![0.0]);
    let regression = Regression::new(&run, &structure(0, 1.0, &[(1, 0.0)]), &[None], &initial).unwrap();
    assert_rejected(regression.estimate(&[1.0], &[]));
    assert_rejected(regression.estimate(&[1.0; 3], &[]));
    assert_rejected(regression.estimate(&[1.0; 2], &[0]));
    assert_rejected(regression.estimate(&[1.0; 2], &[2]));
    assert_eq!(regression.estimate(&[1.0; 2], &[1]).unwrap().excluded_terms, [(0, 0)]);
}

/// D^order y = c D^own y, with one free order.
fn free_model(order: AffineOrder, own: AffineOrder, bounds: (f64, f64)) -> FreeModel {
    let coefficient = Monomial { factor: 1.0, powers: vec![(0, 1)] };
    FreeModel {
        equations: vec![FreeEquation { output: 0, order, terms: vec![(0, own, coefficient)] }],
        order_bounds: vec![bounds],
        coordinates: vec![Coordinate::Plain],
        inputs: Vec::new(),
        coupled: false,
        priors: Vec::new(),
        initial: Initial::Caputo,
    }
}

#[test]
fn free_orders_out_of_bounds_are_rejected() {
    let law = |constant, weights: &[f64]| AffineOrder { constant, weights: weights.to_vec() };
    let run = record(0.1, vec![vec![0.5; 20], vec![1.0; 20]]);
    let experiments = [Experiment::new(run, 1, vec![vec![0.0; 21]], vec![1.0]).unwrap()];
    let check = |model: &FreeModel| {
        let made = Problem::new(vec!["y".into()], model.clone(), Vec::new());
        assert_eq!(made.is_ok(), model.check(&experiments).is_ok());
        model.check(&experiments)
    };
    check(&free_model(law(0.0, &[1.0]), law(0.0, &[0.0]), (0.1, 2.0))).unwrap();
    // Weights of a highest order, like those of a term.
    for weights in [&[][..], &[1.0, 1.0]] {
        assert_rejected(check(&free_model(law(0.0, weights), law(0.0, &[0.0]), (0.1, 2.0))));
        assert_rejected(check(&free_model(law(1.0, &[0.0]), law(0.0, weights), (0.1, 2.0))));
    }
    // A table by whole order would need gigabytes.
    for bounds in [(0.1, 1e9), (1e9, 1e9), (-1e9, 1.0), (0.0, f64::INFINITY)] {
        assert_rejected(check(&free_model(law(0.0, &[1.0]), law(0.0, &[0.0]), bounds)));
    }
    for far in [law(1e9, &[0.0]), law(0.0, &[1e9]), law(f64::NAN, &[1.0])] {
        assert_rejected(check(&free_model(far, law(0.0, &[0.0]), (0.1, 2.0))));
    }
    assert_eq!(round_order(1e12).to_bits(), 1e12_f64.to_bits());
    assert_eq!(round_order(-1e300).to_bits(), (-1e300_f64).to_bits());
    assert!(round_order(f64::NAN).is_nan());
    assert_eq!(round_order(-1e-12).to_bits(), 0.0_f64.to_bits());
}

#[test]
fn joint_structure_with_missing_signals_is_rejected() {
    let made = |output, signal| {
        let order = joint::Order::number(0.0);
        let term =
            joint::ParametricTerm { signal, order, coefficient: joint::Coefficient::Free("a".into()), factor: 1.0 };
        let order = joint::Order::free("alpha");
        let equation = joint::ParametricEquation { output, order, terms: vec![term], friction: None };
        let signals = vec!["y".into(), "u".into()];
        ParameterSet::from_structure(joint::ParametricStructure::new(signals, vec![equation], Initial::Rest))
    };
    made(0, 1).unwrap();
    assert_rejected(made(2, 1));
    assert_rejected(made(0, 2));
    let mut bounded = made(0, 1).unwrap().structure;
    bounded.bounds.insert("alpha".into(), (1.0, 1e9));
    assert_rejected(ParameterSet::from_structure(bounded));
}

#[test]
fn overflowing_integrals_are_rejected() {
    let x = [1.0, -2.0, 3.0, 0.0, 1.0];
    for rule in [IntegralRule::BlockPulse, IntegralRule::Trapezoidal, IntegralRule::GrunwaldLetnikov] {
        for order in [1.5, 10.0] {
            assert_rejected(fractional_integral(&x, order, 1e300, rule));
        }
        fractional_integral(&x, 1.5, 1e100, rule).unwrap();
    }
    assert_rejected(fractional_derivative(&x, 2.5, 1e-300, Derivative::GrunwaldLetnikov, &[]));
    let error = fractional_integral(&x, 1.5, 1e300, IntegralRule::BlockPulse).unwrap_err().to_string();
    assert!(error.starts_with("step = 1e300 is outside "), "{error}");
}

#[test]
fn invalid_streams_are_rejected() {
    let s = structure(0, 1.0, &[(1, 0.0)]);
    let stream = |length, prior, s: &ftlm::equation::Structure, fixed: Option<f64>| {
        let options = StreamingOptions { length, prior: Prior::Absolute(prior), ..StreamingOptions::default() };
        Streaming::new(0.1, 50, &[false, true], &[(s.clone(), vec![fixed])], options)
    };
    assert_rejected(stream(0, 1.0, &s, None));
    assert_rejected(stream(1, 0.0, &s, None));
    assert_rejected(stream(1, f64::NAN, &s, None));
    assert_rejected(stream(1, 1.0, &structure(0, 1.0, &[(4, 0.0)]), None));
    assert_rejected(stream(1, 1.0, &s, Some(f64::INFINITY)));
    // Longer than the run is no innovation that memory must hold beforehand.
    stream(usize::MAX, 1.0, &s, None).unwrap();
}

#[test]
fn incomparable_experiments_are_rejected() {
    let run = record(0.1, vec![vec![0.5; 20], vec![1.0; 20]]);
    let experiment =
        |every, samples: Vec<f64>, weight| Experiment::new(run.clone(), every, vec![samples], vec![weight]);
    assert_rejected(experiment(0, vec![0.0; 21], 1.0));
    assert_rejected(experiment(3, vec![0.0; 21], 1.0));
    assert_rejected(experiment(1, vec![0.0; 20], 1.0));
    assert_rejected(experiment(1, vec![f64::NAN; 21], 1.0));
    assert_rejected(experiment(1, vec![0.0; 21], f64::NAN));
    assert_rejected(Experiment::new(run.clone(), 1, vec![vec![0.0; 21]], vec![]));
    let good = experiment(2, vec![0.0; 11], 1.0).unwrap();
    assert_rejected(good.clone().with_filter(vec![1.0], vec![true]));
    assert_rejected(good.clone().with_filter(vec![f64::NAN; 20], vec![true]));
    assert_rejected(good.with_filter(vec![1.0; 20], vec![]));
}

#[test]
fn nan_arguments_are_rejected() {
    assert_rejected(pulse_means(&[0.0, f64::NAN], 2, Intersample::Linear));
    assert_rejected(delay_samples(&[0.0, f64::NAN], 1.0, 0.0));
    assert_rejected(delay_samples(&[0.0, 1.0], 1.0, f64::NAN));
    assert_rejected(metrics::metrics(&[f64::NAN], &[0.0]));
    assert_rejected(metrics::correlation(&[vec![f64::NAN; 9]], &[vec![0.0; 9]], 2));
    assert_rejected(Filter { numerator: vec![(f64::NAN, 0.0)], denominator: vec![(1.0, 1.0)] }.series(9, 0.1));
    assert_rejected(Filter { numerator: vec![(1.0, 0.0)], denominator: vec![(1.0, 1.0)] }.series(9, f64::NAN));
    assert_rejected(Recursion::new(&[f64::NAN]));
    assert_rejected(small::inverse(&[1.0, 2.0], 2));
    assert_rejected(small::scaled_inverse(&[1.0, 2.0], 2));
    assert_rejected(Recursion::new(&[1.0]).unwrap().step(&SlidingGram::new(2, 1)));
    assert_rejected(SlidingGram::new(2, 1).push(&[1.0], 1.0));
    assert_rejected(series::divide_naive(&[1.0, 2.0], &[1.0]));
    assert_rejected(Rates::new(1e-300, 1e300, 1e-6));
    assert_rejected(integral_by_memory(&[0.0, f64::NAN], 0.5, 0.1, 1e-6));
    assert_rejected(integral_by_memory(&[0.0, 1.0], 2.0, 0.1, 1e-6));
    assert!([f64::NAN, -1e300, 0.0].iter().all(|&x| digamma(x).is_nan()));
}

/// One equation of the arm: its angle, then (signal, order, coefficient).
fn arm_equation(output: usize, terms: &[(usize, f64, f64)]) -> Equation {
    let all = terms.iter().map(|&(signal, order, _)| Term { signal, order }).collect();
    let structure = Structure { output, order: 2.0, terms: all };
    Equation::new(structure, terms.iter().map(|t| t.2).collect()).unwrap()
}

fn arm_equations() -> Vec<Equation> {
    let stage = |hub: usize, current: usize| {
        let link = hub + 1;
        let first = arm_equation(hub, &[(link, 0.1, 60.0), (hub, 0.95, -6.0), (link, 0.75, 1.5), (current, 0.0, 14.0)]);
        [first, arm_equation(link, &[(link, 0.1, -84.0), (hub, 2.1, -1.0), (link, 0.85, -2.1)])]
    };
    stage(0, 4).into_iter().chain(stage(2, 5)).collect()
}

fn arm(step: f64, substep: f64, horizon: f64) -> Result<Arm, Error> {
    Arm::new(&Parameters { equations: arm_equations(), coulomb: [0.05; 2] }, step, substep, horizon)
}

#[test]
fn arm_without_a_valid_step_is_rejected() {
    let made =
        |equations: Vec<Equation>, coulomb: [f64; 2]| Arm::new(&Parameters { equations, coulomb }, 0.002, 1e-4, 10.0);
    assert!(made(arm_equations(), [0.0; 2]).is_ok());
    for friction in [-0.1, f64::NAN, f64::INFINITY] {
        assert_rejected(made(arm_equations(), [0.0, friction]));
    }
    assert_rejected(made(arm_equations()[..3].to_vec(), [0.0; 2]));
    let changed = |row: usize, terms: &[(usize, f64, f64)]| {
        let mut equations = arm_equations();
        equations[row] = arm_equation(equations[row].structure.output, terms);
        equations
    };
    // A hub that its link moves as much as it moves its link.
    assert_rejected(made(changed(0, &[(1, 1.9, -1.0), (4, 0.0, 14.0)]), [0.0; 2]));
    assert_rejected(made(changed(0, &[(4, 0.1, 14.0)]), [0.0; 2]));
    assert_rejected(made(changed(0, &[(1, 3.0, 1.0), (4, 0.0, 14.0)]), [0.0; 2]));
    assert_rejected(made(changed(0, &[(6, 0.0, 1.0)]), [0.0; 2]));
    assert_rejected(made(changed(0, &[(1, 0.1, 60.0)]), [0.1, 0.0]));
    let mut swapped = arm_equations();
    swapped.swap(0, 1);
    assert_rejected(made(swapped, [0.0; 2]));
    let mut slow = arm_equations();
    slow[0].structure.order = 0.9;
    assert_rejected(made(slow, [0.0; 2]));
}

fn sensors() -> Sensors {
    Sensors {
        strain_scale: [0.0136, 0.0187],
        strain_bias: [0.12, -0.2],
        noise: [0.0; 4],
        sense_bias: [0.0; 2],
        sense_scale: 2.0,
        command_scale: 0.5,
        encoder_scale: [1.5e-5, 3e-5],
        range: 10.0,
        bits: 16,
        current_limit: [0.94, 1.2],
        offset: [0.0; 2],
        travel: [1.57, 1.57],
    }
}

#[test]
fn arm_simulation_without_an_end_is_rejected() {
    assert_rejected(arm(0.002, 1e-3, f64::NAN));
    assert_rejected(arm(0.002, 1e-3, f64::INFINITY));
    assert_rejected(arm(1.0, 1e-12, 5.0));
    assert_rejected(arm(f64::NAN, 1e-3, 5.0));
    let changes: [fn(&mut Sensors); 13] = [
        |s| s.range = f64::NAN,
        |s| s.range = -10.0,
        |s| s.range = 0.0,
        |s| s.strain_scale[1] = -1.0,
        |s| s.encoder_scale[0] = 0.0,
        |s| s.sense_scale = -2.0,
        |s| s.command_scale = f64::INFINITY,
        |s| s.current_limit[0] = f64::NAN,
        |s| s.noise[2] = -1e-3,
        |s| s.travel[0] = f64::NAN,
        |s| s.strain_bias[0] = f64::NAN,
        |s| s.sense_bias[1] = f64::INFINITY,
        |s| s.bits = 53,
    ];
    for change in changes {
        let mut bad = sensors();
        change(&mut bad);
        assert_rejected(Plant::new(arm(0.002, 1e-3, 5.0).unwrap(), bad));
    }
    let mut plant = Plant::new(arm(0.002, 1e-3, 5.0).unwrap(), sensors()).unwrap();
    assert_rejected(plant.inject(Injection::DeadEncoder { joint: 2, from: 0 }));
    assert_rejected(plant.inject(Injection::LimitSwitch { line: 4, from: 0 }));
    assert_rejected(plant.inject(Injection::Deflection { joint: 0, from: 0, angle: f64::NAN }));
    assert_rejected(plant.inject(Injection::Late { at: 0, seconds: f64::NAN }));
    for step in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e300] {
        assert_rejected(Pace::new(step));
    }
}

#[test]
#[should_panic(expected = "a transform of 10 points")]
fn a_transform_of_another_length_does_not_return_zeros() {
    let plan = fft::plan(10);
    plan.transform(&mut [0.0; 8], &mut vec![fft::Complex::default(); plan.bins()], &mut fft::Workspace::new());
}
