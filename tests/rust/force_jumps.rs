//! Inputs that jump within pulses, beside dry friction: closed forms, sensitivities against differences, refusals.

use ftlm::equation::{AffineOrder, Equation, Initial, Structure, Term};
use ftlm::error::Error;
use ftlm::estimation::output_error::{
    Coordinate, Experiment, FreeEquation, FreeInput, FreeModel, InputLaw, MinimizationSettings, Monomial,
};
use ftlm::friction::law::Phase;
use ftlm::friction::FrictionLaw;
use ftlm::nonlinear::{fit, FreeFrictionLaw, InitialGuess, NonlinearModel, NonlinearSystem};
use ftlm::parallel::Stop;
use ftlm::recording::{Channel, Recording, Role, Sampling};
use ftlm::regressors::Record;
use ftlm::signal::block_pulse::{Intersample, PulseJump, PulseMeans};

use crate::common::{relative_distance, Random};

/// A block, D²y = u + w − sgn(Dy), on which two inputs act.
fn block() -> NonlinearSystem {
    let terms = vec![Term { signal: 1, order: 0.0 }, Term { signal: 2, order: 0.0 }];
    let equation = Equation { structure: Structure { output: 0, order: 2.0, terms }, coefficients: vec![1.0, 1.0] };
    NonlinearSystem::with_friction(vec![equation], vec![(0, FrictionLaw::coulomb(1.0))], 3)
}

/// Record of held inputs that change their values at given times, in pulses.
fn record(step: f64, m: usize, inputs: &[&[(f64, f64)]]) -> Result<Record, Error> {
    let (mut means, mut jumps) = (vec![vec![0.0; m]], vec![Vec::new()]);
    for changes in inputs {
        let (mut row, mut own) = (vec![0.0; m], Vec::new());
        let mut before = 0.0;
        for &(place, after) in *changes {
            let (pulse, share) = (place as usize, place.fract());
            row[pulse] += (1.0 - share) * (after - before);
            row[pulse + 1..].iter_mut().for_each(|v| *v += after - before);
            if share > 0.0 {
                own.push(PulseJump { pulse, fraction: share, before, after });
            }
            before = after;
        }
        means.push(row);
        jumps.push(own);
    }
    Record::new(step, PulseMeans::from_signals(means), None)?.with_jumps(jumps)
}

#[test]
fn a_block_slides_from_the_jump_of_its_force_on() -> Result<(), Error> {
    let h = 0.1;
    // 0.9 is held by friction; from 3.4 pulses on 3 pulls, less 1 of friction; at 7.25 the pull ends.
    let drive = record(h, 12, &[&[(0.0, 0.9), (3.4, 3.0), (7.25, 0.0)], &[]])?;
    let motion = block().run(&drive, &[vec![]])?.bodies.swap_remove(0);
    assert_eq!(motion.phases[2], Phase::Stick);
    let speed = |pulses: f64| 2.0 * h * (pulses - 3.4).clamp(0.0, 3.85) - h * (pulses - 7.25).max(0.0);
    for (k, velocity) in motion.velocity.iter().enumerate() {
        assert!((velocity - speed(k as f64)).abs() < 1e-12, "{k} {velocity} {}", speed(k as f64));
    }
    assert!((motion.force[3] - (0.4 * 0.9 + 0.6)).abs() < 1e-12, "{:?}", motion.force);
    // Without the instant, the mean pull of the pulse, 2.16, sets the block in motion at its start.
    let unaware = Record::new(h, PulseMeans::from_signals((0..3).map(|s| drive.signal(s).to_vec()).collect()), None)?;
    let earlier = block().run(&unaware, &[vec![]])?.bodies.swap_remove(0).velocity[4];
    assert!((earlier - 1.16 * h).abs() < 1e-12 && (motion.velocity[4] - 1.2 * h).abs() < 1e-12);
    Ok(())
}

#[test]
fn two_inputs_that_jump_in_one_pulse_act_one_after_the_other() -> Result<(), Error> {
    // A pull between the jumps of both only, which the mean force of the pulse does not show.
    let drive = record(0.1, 6, &[&[(2.25, 4.0)], &[(2.75, -4.0)]])?;
    let motion = block().run(&drive, &[vec![]])?.bodies.swap_remove(0);
    assert!((motion.velocity[3] - 0.1 * (3.0 * 0.5 - 0.25)).abs() < 1e-12, "{:?}", motion.velocity);
    Ok(())
}

#[test]
fn a_recording_gives_its_jumps_within_pulses() -> Result<(), Error> {
    let y = Channel::new("y", vec![0.0; 5], Role::Output);
    let levels = vec![1.0, 1.0, 2.0, -1.0, -1.0];
    let u = Channel { delay: Some(0.13), ..Channel::new("u", levels, Role::Input(Intersample::Hold)) };
    let mut run = Recording::new("run", 0.1, None, vec![y, u], vec![0])?;
    assert!(run.pulses(4, false)?.jumps.is_empty());
    run.has_friction = true;
    let places = |m| -> Result<Vec<(f64, f64, f64)>, Error> {
        let jumps = run.pulses(m, false)?.jumps.swap_remove(1);
        Ok(jumps.iter().map(|jump| (jump.pulse as f64 + jump.fraction, jump.before, jump.after)).collect())
    };
    for (m, every) in [(4, 1.0), (8, 2.0)] {
        let found = places(m)?;
        for (jump, expected) in found.iter().zip([(1.3, 0.0, 1.0), (3.3, 1.0, 2.0)]) {
            assert!((jump.0 - every * expected.0).abs() < 1e-9, "{m} {found:?}");
            assert_eq!((jump.1, jump.2), (expected.1, expected.2));
        }
        assert_eq!(found.len(), 2);
    }
    // On 40 pulses every jump is at an edge; on 2 the pulses average over samples.
    assert!(places(40)?.is_empty() && run.pulses(2, false)?.jumps.is_empty());
    Ok(())
}

#[test]
fn jumps_outside_pulses_are_rejected() -> Result<(), Error> {
    let plain = Record::new(0.1, PulseMeans::from_signals(vec![vec![0.0; 4]; 2]), None)?;
    let jump = |pulse, share| PulseJump { pulse, fraction: share, before: 0.0, after: 1.0 };
    for wrong in [
        vec![jump(4, 0.5)],
        vec![jump(1, 0.0)],
        vec![jump(1, 1.0)],
        vec![jump(1, f64::NAN)],
        vec![jump(2, 0.5), jump(1, 0.7)],
        vec![PulseJump { after: f64::INFINITY, ..jump(1, 0.5) }],
    ] {
        assert!(matches!(
            plain.clone().with_jumps(vec![Vec::new(), wrong]),
            Err(Error::Structure { .. } | Error::NotFinite { .. })
        ));
    }
    assert!(plain.clone().with_jumps(vec![vec![jump(1, 0.5)]]).is_err());
    assert_eq!(plain.with_jumps(vec![vec![jump(1, 0.2), jump(1, 0.5)], Vec::new()])?.jumps(0).len(), 2);
    Ok(())
}

/// Bodies D²y_i = −0.8 Dy_i + 1.5 u_i + Σ 0.3 D²y_j − F(Dy_i) sgn(Dy_i), coupled by their accelerations. Input i is
/// delayed by a free time, or limited by a free saturation behind a known delay.
fn model(bodies: usize, stribeck: f64, law: InputLaw) -> NonlinearModel {
    let fixed = |constant: f64| AffineOrder { constant, weights: vec![] };
    let free = |i: usize, factor: f64| Monomial { factor, powers: vec![(i, 1)] };
    let known = |factor: f64| Monomial { factor, powers: vec![] };
    let equation = |i: usize| {
        let others = (0..bodies).filter(|j| *j != i).map(|j| (j, fixed(2.0), known(0.3)));
        let own = [(i, fixed(1.0), free(0, -1.0)), (bodies + i, fixed(0.0), free(1, 1.0))];
        FreeEquation { output: i, order: fixed(2.0), terms: own.into_iter().chain(others).collect() }
    };
    let bounds = if law == InputLaw::Delay { (0.0, 1.0) } else { (0.0, 9.0) };
    NonlinearModel {
        model: FreeModel {
            equations: (0..bodies).map(equation).collect(),
            order_bounds: vec![],
            coordinates: vec![Coordinate::Plain; 3],
            inputs: (0..bodies).map(|i| FreeInput { signal: bodies + i, law, bounds }).collect(),
            coupled: true,
            priors: Vec::new(),
            initial: Initial::Rest,
        },
        derived: vec![],
        frictions: (0..bodies)
            .map(|i| {
                let coulomb = free(2, 1.0);
                (i, FreeFrictionLaw { coulomb, stribeck: known(stribeck), speed: known(0.2) })
            })
            .collect(),
        filtered: vec![],
    }
}

#[test]
fn sensitivities_are_those_of_differences() -> Result<(), Error> {
    let settings = MinimizationSettings { evaluations: 1, ..MinimizationSettings::default() };
    let mut random = Random::new(11);
    for (bodies, stribeck, law) in [
        (1, 0.0, InputLaw::Delay),
        (1, 0.5, InputLaw::Delay),
        (2, 0.0, InputLaw::Delay),
        (2, 0.4, InputLaw::Delay),
        (1, 0.0, InputLaw::Saturation),
    ] {
        let rows = 161;
        let mut channels: Vec<Channel> =
            (0..bodies).map(|i| Channel::new(&format!("y{i}"), vec![0.0; rows], Role::Output)).collect();
        for i in 0..bodies {
            let levels: Vec<f64> = (0..rows / 10 + 1).map(|_| 2.5 * random.normal()).collect();
            let samples = (0..rows).map(|k| levels[k / 10]).collect();
            let u = Channel::new(&format!("u{i}"), samples, Role::Input(Intersample::Hold));
            let delay = (law != InputLaw::Delay).then_some(0.033);
            channels.push(Channel { delay, ..u });
        }
        let mut run = Recording::new("run", 0.05, None, channels, (0..bodies).collect())?;
        run.has_friction = true;
        let experiment: Experiment = run.experiment(Sampling::default())?;
        assert!(experiment.point_values[bodies].is_zero_order_hold);
        let start = InitialGuess {
            orders: vec![],
            coefficients: vec![0.8, 1.5, 0.9],
            inputs: if law == InputLaw::Delay { vec![0.07, 0.083][..bodies].to_vec() } else { vec![2.0] },
            states: vec![],
        };
        let at = |start: &InitialGuess| {
            fit(&model(bodies, stribeck, law), std::slice::from_ref(&experiment), start, settings, &Stop::default())
        };
        let here = at(&start)?;
        for parameter in 0..3 + start.inputs.len() {
            let moved = |by: f64| {
                let mut there = start.clone();
                match parameter.checked_sub(3) {
                    None => there.coefficients[parameter] += by,
                    Some(input) => there.inputs[input] += by,
                }
                at(&there)
            };
            let (up, down) = (moved(1e-6)?, moved(-1e-6)?);
            let slope: Vec<f64> = up.residuals.iter().zip(&down.residuals).map(|(u, d)| (u - d) / 2e-6).collect();
            let distance = relative_distance(&here.jacobian[parameter], &slope);
            assert!(distance < 1e-5, "{bodies} {stribeck} {law:?}: parameter {parameter} is off by {distance}");
        }
    }
    Ok(())
}
