//! A body that sticks: its march against a plain one, closed forms, derivatives against differences, refusals.

use ftlm::equation::{AffineOrder, Equation, Initial, Structure, Term};
use ftlm::error::Error;
use ftlm::estimate::output_error::{Coordinate, Experiment, FreeEquation, Monomial, Settings};
use ftlm::friction::law::{Moves, Phase};
use ftlm::friction::march::March;
use ftlm::friction::online::{Heads, Online};
use ftlm::friction::{fit, Body, FreeLaw, FrictionModel, Law, Start};
use ftlm::regressors::Record;

fn body(order: f64, friction: f64) -> Body {
    let terms = vec![Term { signal: 0, order: 1.0 }, Term { signal: 1, order: 0.0 }];
    let structure = Structure { output: 0, order, terms };
    Body::alone(Equation { structure, coefficients: vec![-1.0, 1.0] }, Law::coulomb(friction))
}

fn force(m: usize) -> Vec<f64> {
    (0..m).map(|k| 2.0 * (0.03 * k as f64).sin() + 0.3 * (0.11 * k as f64).cos()).collect()
}

#[test]
fn sums_over_the_past_are_the_plain_ones() {
    let (kernel, signal) = (force(1000), force(1500).split_off(500));
    let heads = Heads::new(&kernel);
    let mut online = Online::new(&heads);
    for (k, &x) in signal.iter().enumerate() {
        let plain: f64 = (0..k).map(|j| kernel[k - j] * signal[j]).sum();
        assert!((online.past() - plain).abs() < 1e-10, "{k}");
        online.push(x);
    }
    assert_eq!(online.into_signal(), signal);
}

#[test]
fn a_march_obeys_its_law() {
    let m = 3000;
    let response: Vec<f64> = (0..m).map(|n| 0.01 * (-0.002 * n as f64).exp()).collect();
    let linear: Vec<f64> = force(m);
    let strength = 3.0;
    let march = March::new(&linear, &Heads::new(&response), response[0], Law::coulomb(strength), 0.0);
    assert!(march.phases.contains(&Phase::Stick) && march.phases.contains(&Phase::Slip));
    for k in 0..m {
        let past: f64 = (0..=k).map(|j| response[k - j] * march.force[j]).sum();
        assert!((march.edges[k + 1] - (linear[k] - past)).abs() < 1e-9, "{k}");
        assert!(march.force[k].abs() <= strength * (1.0 + 1e-9));
        match march.phases[k] {
            Phase::Stick => assert_eq!(march.edges[k + 1], 0.0),
            Phase::Slip => assert!(march.force[k] * march.edges[k + 1] >= 0.0 && march.force[k].abs() == strength),
            Phase::Turn => assert!(march.edges[k] * march.edges[k + 1] < 0.0),
        }
    }
}

/// The march of a law that falls with speed, and its plain sum over the past.
#[test]
fn a_march_that_falls_with_speed_obeys_its_law() {
    let m = 2000;
    let response: Vec<f64> = (0..m).map(|n| 0.01 * (-0.002 * n as f64).exp()).collect();
    let linear = force(m);
    let law = Law { coulomb: 2.0, stribeck: 3.0, speed: 0.05 };
    let march = March::new(&linear, &Heads::new(&response), response[0], law, 0.0);
    for phase in [Phase::Slip, Phase::Stick, Phase::Turn] {
        assert!(march.phases.contains(&phase), "{phase:?}");
    }
    for k in 0..m {
        let past: f64 = (0..=k).map(|j| response[k - j] * march.force[j]).sum();
        let (v, end) = (march.edges[k], march.edges[k + 1]);
        assert!((end - (linear[k] - past)).abs() < 1e-9, "{k}");
        assert!(march.force[k].abs() <= law.breakaway() * (1.0 + 1e-9));
        if march.phases[k] == Phase::Slip {
            // The mean over a velocity that is linear in the pulse, by many points.
            let mean = (0..2000).map(|i| {
                let x: f64 = v + (end - v) * (f64::from(i) + 0.5) / 2000.0;
                law.coulomb + law.stribeck * (-(x / law.speed).powi(2)).exp()
            });
            let side = if v == 0.0 { end.signum() } else { v.signum() };
            assert!((march.force[k] - side * mean.sum::<f64>() / 2000.0).abs() < 1e-5, "{k}");
        }
    }
}

#[test]
fn slopes_of_a_pulse_are_those_of_differences() {
    let law = Law { coulomb: 0.4, stribeck: 0.7, speed: 0.3 };
    // (velocity, free end, first number of the response): slips near and far, from rest, both ways; stops; turns.
    let pulses = [
        (0.5, 0.52, 0.05),
        (0.2, 0.9, 0.3),
        (-0.4, -0.41, 0.02),
        (0.9, 0.5, 0.2),
        (0.0, 0.5, 0.2),
        (0.0, -0.3, 0.1),
        (0.01, 0.0, 0.1),
        (0.0, 0.05, 0.1),
        (0.02, -0.4, 0.2),
        (-0.05, 0.6, 0.3),
    ];
    let mut seen = Vec::new();
    for (v, p, g) in pulses {
        let at = law.pulse(v, p, g, 0.0);
        seen.push(at.phase);
        for moved in 0..6 {
            // A body at rest leaves it with its force, not with its velocity.
            if moved == 0 && v == 0.0 {
                continue;
            }
            let mut unit = [0.0; 6];
            unit[moved] = 1.0;
            let near = |by: f64| {
                let [dv, dp, dg, dc, ds, dw] = unit.map(|u| by * u);
                let there = Law { coulomb: law.coulomb + dc, stribeck: law.stribeck + ds, speed: law.speed + dw };
                there.pulse(v + dv, p + dp, g + dg, 0.0)
            };
            let (up, down) = (near(1e-6), near(-1e-6));
            assert_eq!((up.phase, down.phase), (at.phase, at.phase));
            let moves = Moves { start: unit[0], free: unit[1], first: unit[2], law: [unit[3], unit[4], unit[5]] };
            let (force, end) = law.slope(v, p, g, &at, &moves);
            assert!((force - (up.force - down.force) / 2e-6).abs() < 1e-6 * (1.0 + force.abs()), "{v} {p} {moved}");
            assert!((end - (up.end - down.end) / 2e-6).abs() < 1e-6 * (1.0 + end.abs()), "{v} {p} {moved}");
        }
    }
    for phase in [Phase::Slip, Phase::Stick, Phase::Turn] {
        assert!(seen.contains(&phase), "{phase:?}");
    }
}

#[test]
fn a_speed_that_is_none_is_refused() -> Result<(), Error> {
    let record = Record::new(0.01, vec![vec![0.0; 50], vec![1.0; 50]], None)?;
    for (stribeck, speed) in [(-0.1, 0.2), (0.1, 0.0), (0.1, -0.2)] {
        let mut wrong = body(1.8, 0.5);
        wrong.friction = Law { stribeck, speed, ..wrong.friction };
        assert!(matches!(wrong.run(&record, &[vec![]]), Err(Error::OutOfRange { .. })));
    }
    let mut lost = body(1.8, 0.5);
    lost.friction.speed = f64::NAN;
    assert!(matches!(lost.run(&record, &[vec![]]), Err(Error::NotFinite { .. })));
    Ok(())
}

#[test]
fn what_never_leaves_its_rest_is_where_it_was() -> Result<(), Error> {
    let record = Record::new(0.01, vec![vec![0.0; 400], force(400)], None)?;
    let motion = body(2.0, 2.5).run(&record, &[vec![(0.0, 0.7), (1.0, 0.7)]])?;
    assert!(motion.velocity.iter().all(|v| *v == 0.0));
    assert!(motion.outputs[0].iter().all(|y| (y - 0.7).abs() < 1e-15));
    Ok(())
}

#[test]
fn its_numbers_are_found_again() -> Result<(), Error> {
    let m = 600;
    let record = Record::new(0.02, vec![vec![0.0; m], force(m)], None)?;
    let truth = body(1.9, 0.8);
    let output = truth.run(&record, &[vec![]])?.outputs.swap_remove(0);
    let experiment = Experiment::new(record, 1, vec![ftlm::means::point_samples(&output)], vec![1.0])?;
    let order = |constant: f64, weight: f64| AffineOrder { constant, weights: vec![weight] };
    let free = |i: usize, factor: f64| Monomial { factor, powers: vec![(i, 1)] };
    let model = FrictionModel {
        equations: vec![FreeEquation {
            output: 0,
            order: order(0.0, 1.0),
            terms: vec![(0, order(1.0, 0.0), free(0, -1.0)), (1, order(0.0, 0.0), free(1, 1.0))],
        }],
        sticks: 0,
        friction: FreeLaw::coulomb(free(2, 1.0)),
        inputs: vec![],
        order_bounds: vec![(1.2, 2.0)],
        coordinates: vec![Coordinate::Plain; 3],
        initial: Initial::Rest,
        filtered: vec![],
    };
    let start = Start { orders: vec![2.0], coefficients: vec![0.7, 1.2, 0.5], inputs: vec![], states: vec![] };
    let found =
        fit(&model, std::slice::from_ref(&experiment), &start, Settings { evaluations: 200, tolerance: 1e-14 })?;
    assert!((found.orders[0] - 1.9).abs() < 1e-5, "{:?}", found.orders);
    for (value, truth) in found.coefficients.iter().zip([1.0, 1.0, 0.8]) {
        assert!((value - truth).abs() < 1e-4, "{:?}", found.coefficients);
    }
    let strange =
        FrictionModel { friction: FreeLaw::coulomb(Monomial { factor: -1.0, powers: vec![] }), ..model.clone() };
    assert!(matches!(strange.check(std::slice::from_ref(&experiment)), Err(Error::Structure { .. })));
    // Orders that make no equation: their states would fill memory.
    let mut endless = model.clone();
    endless.equations[0].terms[1].1.constant = 1e308;
    let falling = FrictionModel { order_bounds: vec![(1.2, -1.0)], ..model.clone() };
    for wrong in [&endless, &falling] {
        let found = fit(wrong, std::slice::from_ref(&experiment), &start, Settings::default());
        assert!(matches!(found, Err(Error::OutOfRange { .. } | Error::Structure { .. })), "{found:?}");
    }
    // Behind a filter that the model does not know.
    let mut series = vec![0.0; m];
    series[..2].copy_from_slice(&[0.5, 0.5]);
    let behind = experiment.with_filter(series, vec![true])?;
    assert!(matches!(model.check(std::slice::from_ref(&behind)), Err(Error::Structure { .. })));
    FrictionModel { filtered: vec![true], ..model.clone() }.check(&[behind])?;
    assert!(matches!(model.check(&[]), Err(Error::Length { .. })));
    Ok(())
}

#[test]
fn what_has_no_velocity_is_refused() -> Result<(), Error> {
    let record = Record::new(0.01, vec![vec![0.0; 50], vec![1.0; 50]], None)?;
    for wrong in [body(1.0, 0.5), body(2.3, 0.5), body(2.0, -0.5)] {
        assert!(matches!(wrong.run(&record, &[vec![]]), Err(Error::OutOfRange { .. })));
    }
    let mut fast = body(1.5, 0.5);
    fast.equations[0].structure.terms[1].order = 1.5;
    assert!(matches!(fast.run(&record, &[vec![]]), Err(Error::OutOfRange { .. })));
    let mut lost = body(1.5, 0.5);
    lost.equations[0].coefficients[0] = f64::NAN;
    assert!(lost.run(&record, &[vec![]]).is_err());
    // Pushed away from where it is held: nothing is left of the digits of a run without friction.
    let mut tipping = body(2.0, 5.0);
    tipping.equations[0].structure.terms[0].order = 0.0;
    tipping.equations[0].coefficients[0] = 400.0;
    let long = Record::new(0.05, vec![vec![0.0; 400], vec![1.0; 400]], None)?;
    assert!(matches!(tipping.run(&long, &[vec![]]), Err(Error::Diverged { .. })));
    Ok(())
}
