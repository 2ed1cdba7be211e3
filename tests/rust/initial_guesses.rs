//! Initial guesses of joint fits: frequencies against sums, grids against brute force, delays and limits, errors.

use std::f64::consts::PI;

use ftlm::equation::{self, Initial};
use ftlm::error::{Error, Result};
use ftlm::estimation::joint_fit::initial_guesses::{power_frequency, OrderGrids};
use ftlm::estimation::joint_fit::multistart::coarse_sampling;
use ftlm::estimation::joint_fit::parameter_set::ParameterSet;
use ftlm::estimation::joint_fit::structure::{
    Coefficient, Hints, Input, Order, ParametricEquation, ParametricStructure, ParametricTerm,
};
use ftlm::estimation::joint_fit::Candidate;
use ftlm::estimation::output_error::{FreeInput, InputLaw};
use ftlm::parallel::Stop;
use ftlm::recording::{Channel, Recording, Recordings, Role, Sampling};
use ftlm::regressors::{Record, BANK_LIMIT};
use ftlm::signal::block_pulse::{point_samples, Intersample, PulseMeans};
use ftlm::simulate::respond;
use ftlm::state_space;

use crate::common::{bits, check, deviation, Random};

const STEP: f64 = 0.02;
const ALPHA: f64 = 1.7;
const NU: f64 = 0.8;

/// Samples of D^1.7 y = −3 D^0.8 y − 20 y + 5 u with a little noise, and the held input.
fn plant() -> Recording {
    let mut random = Random::new(4);
    let input = random.steps(800, 15);
    let term = |signal, order| equation::Term { signal, order };
    let terms = vec![term(0, NU), term(0, 0.0), term(1, 0.0)];
    let known = equation::Structure { output: 0, order: ALPHA, terms };
    let truth = equation::Equation::new(known, vec![-3.0, -20.0, 5.0]).unwrap();
    let rest = Record::new(STEP, PulseMeans::from_signals(vec![vec![0.0; 800], input.clone()]), None).unwrap();
    let mut y = point_samples(&respond(&[truth], &rest, &[]).unwrap()[0]);
    let size = 0.01 * deviation(&y);
    y.iter_mut().for_each(|v| *v += size * random.normal());
    y.truncate(800);
    recording(STEP, y, input)
}

/// A run of an output and a held input.
fn recording(step: f64, y: Vec<f64>, mut u: Vec<f64>) -> Recording {
    u.truncate(y.len());
    let (y, u) = (Channel::new("y", y, Role::Output), Channel::new("u", u, Role::Input(Intersample::Hold)));
    Recording::new("run", step, None, vec![y, u], vec![0]).unwrap()
}

fn runs() -> Recordings {
    Recordings::new(vec![plant()]).unwrap()
}

fn term(signal: usize, order: Order, name: &str) -> ParametricTerm {
    ParametricTerm { signal, order, coefficient: Coefficient::Free(name.into()), factor: 1.0 }
}

/// D^alpha y = a D^nu y + b y + c D^beta u.
fn structure(alpha: Order, beta: f64) -> ParametricStructure {
    let terms =
        vec![term(0, Order::free("nu"), "a"), term(0, Order::number(0.0), "b"), term(1, Order::number(beta), "c")];
    ParametricStructure {
        signals: vec!["y".into(), "u".into()],
        derived: Vec::new(),
        equations: vec![ParametricEquation { output: 0, order: alpha, terms, friction: None }],
        bounds: [].into(),
        priors: [].into(),
        coupled: true,
        delayed: false,
        initial: Initial::Rest,
        history: false,
        inputs: Vec::new(),
        laws: Vec::new(),
        hints: Hints::default(),
    }
}

fn initial_guesses_of(structure: ParametricStructure, source: &Recordings, threads: usize) -> Result<Vec<Candidate>> {
    OrderGrids::new(source, threads, BANK_LIMIT, &Stop::default()).candidates(&ParameterSet::from_structure(structure)?)
}

#[test]
fn the_frequency_of_power_is_that_of_sums() {
    for count in [7_usize, 128, 301] {
        let x = Random::new(count as u64).signal(count);
        let centre = x.iter().sum::<f64>() / count as f64;
        let last = (count - 1) as f64;
        let y: Vec<f64> = (x.iter().enumerate())
            .map(|(k, v)| (v - centre) * (0.5 - 0.5 * (2.0 * PI * k as f64 / last).cos()))
            .collect();
        let power = |bin: usize| {
            let angle = |k: usize| 2.0 * PI * (bin * k) as f64 / count as f64;
            let (c, s) = y
                .iter()
                .enumerate()
                .fold((0.0, 0.0), |(c, s), (k, v)| (c + v * angle(k).cos(), s + v * angle(k).sin()));
            c * c + s * s
        };
        let all: Vec<f64> = (0..=count / 2).map(power).collect();
        let whole: f64 = all.iter().sum();
        let at = (0..all.len()).find(|&k| all[..=k].iter().sum::<f64>() >= 0.9 * whole).unwrap();
        let told = 2.0 * PI * at.max(1) as f64 / (count as f64 * 0.1);
        check("frequency", (power_frequency(&x, 0.1) / told - 1.0).abs(), 1e-14);
    }
    // What never moves is as slow as can be told; what was not read is bridged.
    assert_eq!(power_frequency(&[3.0; 10], 0.1), 2.0 * PI);
    let mut ramp: Vec<f64> = (0..50).map(f64::from).collect();
    let whole = power_frequency(&ramp, 0.1);
    ramp[20..25].fill(f64::NAN);
    assert_eq!(power_frequency(&ramp, 0.1), whole);
}

#[test]
fn initial_guesses_contain_the_truth_for_any_number_of_threads() {
    let source = runs();
    let one = initial_guesses_of(structure(Order::free("alpha"), 0.0), &source, 1).unwrap();
    let two = initial_guesses_of(structure(Order::free("alpha"), 0.0), &source, 2).unwrap();
    let values = |all: &[Candidate]| all.iter().flat_map(|r| bits(&r.result.values())).collect::<Vec<_>>();
    assert_eq!(values(&one), values(&two));
    assert!(one.iter().zip(&two).all(|(a, b)| a.origin == b.origin));
    let distance = |r: &Candidate| {
        let orders = &r.result.iterate.point.orders;
        (orders[0] - ALPHA).abs().max((orders[1] - NU).abs())
    };
    check("distance from the truth", one.iter().map(distance).fold(f64::INFINITY, f64::min), 0.15);
    assert!(one.iter().any(|r| r.origin == "no prefilter") && one.iter().any(|r| r.origin == "scan of resonances"));
    assert!(one[0].origin.starts_with("prefilter ") && one[0].origin.ends_with(" rad/s"));
}

#[test]
fn delays_and_limits_are_tried() {
    for (law, name, bounds, words) in [
        (InputLaw::Delay, "delay_u", (0.0, 0.3), ", delay 0 ms"),
        (InputLaw::Saturation, "sat_u", (0.01, 10.0), ", sat_u 0."),
    ] {
        let input = Input { name: name.into(), parameter: FreeInput { signal: 1, law, bounds } };
        let mut structure_with_input = structure(Order::number(1.7), 0.0);
        structure_with_input.inputs = vec![input.clone()];
        let run = plant();
        let mut channels = run.channels().to_vec();
        if law != InputLaw::Delay {
            channels[1].nonlinearities.push((law, None));
        }
        let mut run = Recording::new("run", STEP, None, channels, vec![0]).unwrap();
        run.free_inputs.push((1, law));
        let source = Recordings::new(vec![run]).unwrap();
        // What is free is left to the fit, but not where it starts.
        let at = |value: f64| source.records(100, &[value]).unwrap()[0].signal(1).to_vec();
        assert_ne!(bits(&at(bounds.0)), bits(&at(bounds.1)), "{name}");
        let all = initial_guesses_of(structure_with_input, &source, 1).unwrap();
        let mut tried: Vec<f64> = all.iter().map(|r| r.result.iterate.point.inputs[0]).collect();
        tried.dedup();
        assert!(all[0].origin.contains(words), "{}", all[0].origin);
        assert!(tried.len() >= 2 && tried.iter().all(|v| (bounds.0..=bounds.1).contains(v)), "{tried:?}");
        if law == InputLaw::Delay {
            assert_eq!((tried[0], *tried.last().unwrap()), bounds);
        }
    }
}

#[test]
fn structures_without_initial_guess_are_rejected() {
    let source = runs();
    let held = initial_guesses_of(structure(Order::number(1.7), 2.2), &source, 1).unwrap_err();
    assert!(held.to_string().starts_with("order 2.2 of u is above alpha = 1.7 of y"), "{held}");
    let mut narrow = structure(Order::number(1.0), 0.0);
    narrow.bounds.insert("nu".into(), (1.5, 1.9));
    let empty = initial_guesses_of(narrow, &source, 1).unwrap_err();
    assert!(empty.to_string().contains("no orders of signal 'y' fit below alpha = 1"), "{empty}");
    let stop = Stop::default();
    stop.set();
    let parameter_set = ParameterSet::from_structure(structure(Order::free("alpha"), 0.0)).unwrap();
    assert_eq!(OrderGrids::new(&source, 1, BANK_LIMIT, &stop).candidates(&parameter_set), Err(Error::Interrupted));
}

/// Samples of y″ + 2 y′ + 400 y = u, which swings with 20 rad/s, and an input that changes every 50 of 60 000 samples.
fn fast_oscillation() -> (Vec<f64>, Vec<f64>) {
    let (step, rows) = (0.01, 60_000);
    let mut random = Random::new(1);
    let u: Vec<f64> = random.signal(rows / 50).iter().flat_map(|v| std::iter::repeat_n(v.signum(), 50)).collect();
    let term = |signal, order| equation::Term { signal, order };
    let plant = equation::Structure { output: 0, order: 2.0, terms: vec![term(0, 1.0), term(0, 0.0), term(1, 0.0)] };
    let plant = equation::Equation::new(plant, vec![-2.0, -400.0, 1.0]).unwrap();
    let input = state_space::InputSignal {
        signal: 1,
        samples: u.clone(),
        intersample: Intersample::Hold,
        delay: 0.0,
        before: 0.0,
    };
    let y = state_space::respond(&[plant], &[input], &[], step, rows, &Stop::default()).unwrap().unwrap();
    (y, u)
}

#[test]
fn decimation_is_limited_by_the_bandwidth() {
    // Thinned to 1200 samples, it would be read every 0.5 s, a turn and a half; six samples in half a turn show it.
    let (y, u) = fast_oscillation();
    let parameter_set = ParameterSet::from_structure(structure(Order::free("alpha"), 0.0)).unwrap();
    let sampling = |y: &[f64]| {
        let runs = Recordings::new(vec![recording(0.01, y.to_vec(), u.clone())]).unwrap();
        coarse_sampling(&parameter_set, &runs).unwrap()
    };
    let (found, fastest) = (sampling(&y), power_frequency(&y, 0.01));
    let most = (PI / (6.0 * fastest * 0.01)).max(1.0);
    assert!((1.0..=most).contains(&(found.decimation as f64)), "{found:?}, at most {most}");
    assert_eq!(found.leading_intervals, Some(1200 * found.decimation));
    // What stands still at first does not stand for what moves later.
    let still: Vec<f64> = y.iter().enumerate().map(|(k, v)| if k < 30_000 { 0.0 } else { *v }).collect();
    assert_eq!((sampling(&still).decimation, sampling(&still).leading_intervals), (50, None));
}

#[test]
fn leading_samples_are_those_of_a_shorter_run() {
    let run = plant();
    let sampling = |leading_intervals| Sampling { pulses_per_sample: 2, decimation: 3, leading_intervals };
    let (part, all) = (run.experiment(sampling(Some(100))).unwrap(), run.experiment(sampling(None)).unwrap());
    assert_eq!(part.record.m(), 66);
    for signal in 0..2 {
        assert_eq!(bits(part.record.signal(signal)), bits(&all.record.signal(signal)[..66]));
    }
    assert_eq!(part.samples[0], all.samples[0][..34]);
    let short = run.experiment(sampling(Some(1))).unwrap_err();
    assert_eq!(short.to_string(), "window: 2 rows remain, 3 are needed; widen the limits");
    let faint = recording(STEP, vec![1e-150; 10], vec![1.0; 10]);
    let refused = faint.pulses(9, false).unwrap_err();
    assert!(refused.to_string().starts_with("signal 'y' of run 'run': no mean is larger than 1e-150, and squares"));
}
