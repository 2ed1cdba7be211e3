//! Dry friction: convolutions against plain sums, free runs against the law, contacts of several bodies, fits, refusals.

use ftlm::equation::{AffineOrder, Equation, Initial, Structure, Term};
use ftlm::error::Error;
use ftlm::estimation::output_error::FreeModel;
use ftlm::estimation::output_error::{Coordinate, Experiment, FreeEquation, MinimizationSettings, Monomial};
use ftlm::friction::contact::{is_p_matrix, FrictionProblem};
use ftlm::friction::law::{Phase, PulseDerivatives};
use ftlm::friction::FrictionLaw;
use ftlm::nonlinear::convolution::{ConvolutionKernel, OnlineConvolution};
use ftlm::nonlinear::{fit, FreeFrictionLaw, InitialGuess, NonlinearModel, NonlinearSystem};
use ftlm::parallel::Stop;
use ftlm::regressors::Record;
use ftlm::signal::block_pulse::PulseMeans;

use crate::common::Random;

fn body(order: f64, friction: f64) -> NonlinearSystem {
    let terms = vec![Term { signal: 0, order: 1.0 }, Term { signal: 1, order: 0.0 }];
    let structure = Structure { output: 0, order, terms };
    let equation = Equation { structure, coefficients: vec![-1.0, 1.0] };
    NonlinearSystem::with_friction(vec![equation], vec![(0, FrictionLaw::coulomb(friction))], 2)
}

fn force(m: usize) -> Vec<f64> {
    (0..m).map(|k| 2.0 * (0.03 * k as f64).sin() + 0.3 * (0.11 * k as f64).cos()).collect()
}

/// Assert that an online convolution is the plain sum.
fn assert_plain_sums(kernel: &ConvolutionKernel, signal: &[f64], tolerance: f64) {
    let mut online = OnlineConvolution::new(kernel);
    for (k, &x) in signal.iter().enumerate() {
        let plain: f64 = (0..k).map(|j| kernel.values()[k - j] * signal[j]).sum();
        assert!((online.past_contribution() - plain).abs() < tolerance, "{k}");
        online.push(x);
    }
}

#[test]
fn history_sums_match_plain_sums() {
    assert_plain_sums(&ConvolutionKernel::new(force(1000)), &force(1500).split_off(500), 1e-10);
    for order in [0.0, 1.0, 2.0, 3.0, 0.7] {
        let values = ftlm::fractional::kernels::kernel(order, 1000, 0.01);
        let size = values.iter().fold(0.0_f64, |most, v| most.max(v.abs()));
        assert_plain_sums(&ConvolutionKernel::of_integral(order, values), &force(1000), 1e-10 * size.max(1e-3));
    }
}

/// Assert that every pulse of a free run obeys the friction law, and its motion the equation D^1.8 y = −Dy + u − φ.
fn assert_law(law: FrictionLaw) -> Result<(), Error> {
    let (m, step) = (2000, 0.01);
    let input: Vec<f64> = force(m);
    let record = Record::new(step, PulseMeans::from_signals(vec![vec![0.0; m], input.clone()]), None)?;
    let mut system = body(1.8, 0.0);
    system.frictions[0].1 = law;
    let run = system.run(&record, &[vec![]])?;
    let motion = &run.bodies[0];
    for phase in [Phase::Slip, Phase::Stick, Phase::Turn] {
        assert!(motion.phases.contains(&phase), "{phase:?}");
    }
    let through = |order: f64, signal: &[f64], k: usize| -> f64 {
        let kernel = ftlm::fractional::kernels::kernel(order, m, step);
        (0..=k).map(|j| kernel[k - j] * signal[j]).sum()
    };
    for k in (0..m).step_by(37) {
        let sum = through(1.8, &input, k) - through(1.8, &motion.force, k) - through(0.8, &run.outputs[0], k);
        assert!((run.outputs[0][k] - sum).abs() < 1e-4, "{k} {} {sum}", run.outputs[0][k]);
    }
    for k in 0..m {
        let (v, end) = (motion.velocity[k], motion.velocity[k + 1]);
        assert!(motion.force[k].abs() <= law.breakaway() * (1.0 + 1e-9));
        match motion.phases[k] {
            Phase::Stick => assert_eq!(end, 0.0),
            Phase::Turn => assert!(v * end < 0.0),
            Phase::Slip => {
                // The mean over a velocity that is linear in the pulse, by many points.
                let mean = (0..2000).map(|i| {
                    let x: f64 = v + (end - v) * (f64::from(i) + 0.5) / 2000.0;
                    law.coulomb + law.stribeck * (-(x / law.speed).powi(2)).exp()
                });
                let side = if v == 0.0 { end.signum() } else { v.signum() };
                assert!((motion.force[k] - side * mean.sum::<f64>() / 2000.0).abs() < 1e-5, "{k}");
            }
        }
    }
    Ok(())
}

#[test]
fn every_pulse_obeys_its_law() -> Result<(), Error> {
    assert_law(FrictionLaw::coulomb(0.4))?;
    assert_law(FrictionLaw { coulomb: 0.2, stribeck: 0.3, speed: 0.05 })
}

#[test]
fn slopes_of_a_pulse_are_those_of_differences() {
    let law = FrictionLaw { coulomb: 0.4, stribeck: 0.7, speed: 0.3 };
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
                let there =
                    FrictionLaw { coulomb: law.coulomb + dc, stribeck: law.stribeck + ds, speed: law.speed + dw };
                there.pulse(v + dv, p + dp, g + dg, 0.0)
            };
            let (up, down) = (near(1e-6), near(-1e-6));
            assert_eq!((up.phase, down.phase), (at.phase, at.phase));
            let moves =
                PulseDerivatives { start: unit[0], free: unit[1], gain: unit[2], law: [unit[3], unit[4], unit[5]] };
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
fn invalid_speed_is_rejected() -> Result<(), Error> {
    let record = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 50], vec![1.0; 50]]), None)?;
    for (stribeck, speed) in [(-0.1, 0.2), (0.1, 0.0), (0.1, -0.2)] {
        let mut wrong = body(1.8, 0.5);
        wrong.frictions[0].1 = FrictionLaw { stribeck, speed, ..wrong.frictions[0].1 };
        assert!(matches!(wrong.run(&record, &[vec![]]), Err(Error::OutOfRange { .. })));
    }
    let mut lost = body(1.8, 0.5);
    lost.frictions[0].1.speed = f64::NAN;
    assert!(matches!(lost.run(&record, &[vec![]]), Err(Error::NotFinite { .. })));
    Ok(())
}

#[test]
fn body_that_never_slides_stays_in_place() -> Result<(), Error> {
    let record = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 400], force(400)]), None)?;
    let motion = body(2.0, 2.5).run(&record, &[vec![(0.0, 0.7), (1.0, 0.7)]])?;
    assert!(motion.bodies[0].velocity.iter().all(|v| *v == 0.0));
    assert!(motion.outputs[0].iter().all(|y| (y - 0.7).abs() < 1e-15));
    Ok(())
}

#[test]
fn parameters_are_recovered() -> Result<(), Error> {
    let m = 600;
    let record = Record::new(0.02, PulseMeans::from_signals(vec![vec![0.0; m], force(m)]), None)?;
    let truth = body(1.9, 0.8);
    let output = truth.run(&record, &[vec![]])?.outputs.swap_remove(0);
    let experiment = Experiment::new(record, 1, vec![ftlm::signal::block_pulse::point_samples(&output)], vec![1.0])?;
    let order = |constant: f64, weight: f64| AffineOrder { constant, weights: vec![weight] };
    let free = |i: usize, factor: f64| Monomial { factor, powers: vec![(i, 1)] };
    let linear = FreeModel {
        equations: vec![FreeEquation {
            output: 0,
            order: order(0.0, 1.0),
            terms: vec![(0, order(1.0, 0.0), free(0, -1.0)), (1, order(0.0, 0.0), free(1, 1.0))],
        }],
        inputs: vec![],
        order_bounds: vec![(1.2, 2.0)],
        coordinates: vec![Coordinate::Plain; 3],
        coupled: true,
        priors: Vec::new(),
        initial: Initial::Rest,
    };
    let frictions = vec![(0, FreeFrictionLaw::coulomb(free(2, 1.0)))];
    let model = NonlinearModel { model: linear, derived: vec![], frictions, filtered: vec![] };
    let start = InitialGuess { orders: vec![2.0], coefficients: vec![0.7, 1.2, 0.5], inputs: vec![], states: vec![] };
    let found = fit(
        &model,
        std::slice::from_ref(&experiment),
        &start,
        MinimizationSettings { evaluations: 200, tolerance: 1e-14 },
        &Stop::default(),
    )?;
    assert!((found.orders[0] - 1.9).abs() < 1e-5, "{:?}", found.orders);
    for (value, truth) in found.coefficients.iter().zip([1.0, 1.0, 0.8]) {
        assert!((value - truth).abs() < 1e-4, "{:?}", found.coefficients);
    }
    let strange = NonlinearModel {
        frictions: vec![(0, FreeFrictionLaw::coulomb(Monomial { factor: -1.0, powers: vec![] }))],
        ..model.clone()
    };
    assert!(matches!(strange.check(std::slice::from_ref(&experiment)), Err(Error::Structure { .. })));
    // Orders that make no equation: their states would fill memory.
    let mut endless = model.clone();
    endless.model.equations[0].terms[1].1.constant = 1e308;
    let mut falling = model.clone();
    falling.model.order_bounds = vec![(1.2, -1.0)];
    for wrong in [&endless, &falling] {
        let found =
            fit(wrong, std::slice::from_ref(&experiment), &start, MinimizationSettings::default(), &Stop::default());
        assert!(matches!(found, Err(Error::OutOfRange { .. } | Error::Structure { .. })), "{found:?}");
    }
    // Behind a filter that the model does not know.
    let mut series = vec![0.0; m];
    series[..2].copy_from_slice(&[0.5, 0.5]);
    let behind = experiment.with_filter(series, vec![true])?;
    assert!(matches!(model.check(std::slice::from_ref(&behind)), Err(Error::Structure { .. })));
    NonlinearModel { filtered: vec![true], ..model.clone() }.check(&[behind])?;
    assert!(matches!(model.check(&[]), Err(Error::Length { .. })));
    Ok(())
}

#[test]
fn friction_without_velocity_is_rejected() -> Result<(), Error> {
    let record = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 50], vec![1.0; 50]]), None)?;
    for wrong in [body(1.0, 0.5), body(2.3, 0.5), body(2.0, -0.5)] {
        assert!(matches!(wrong.run(&record, &[vec![]]), Err(Error::OutOfRange { .. })));
    }
    let mut fast = body(1.5, 0.5);
    fast.equations[0].structure.terms[1].order = 1.5;
    assert!(matches!(fast.run(&record, &[vec![]]), Err(Error::OutOfRange { .. })));
    let mut lost = body(1.5, 0.5);
    lost.equations[0].coefficients[0] = f64::NAN;
    assert!(lost.run(&record, &[vec![]]).is_err());
    // An unstable body rests for ever while friction holds it, although its motion without friction grows beyond all digits.
    let mut unstable = body(2.0, 5.0);
    unstable.equations[0].structure.terms[0].order = 0.0;
    unstable.equations[0].coefficients[0] = 400.0;
    let long = Record::new(0.05, PulseMeans::from_signals(vec![vec![0.0; 400], vec![1.0; 400]]), None)?;
    assert!(unstable.run(&long, &[vec![]])?.bodies[0].velocity.iter().all(|v| *v == 0.0));
    Ok(())
}

/// Of bodies at rest with Coulomb friction, every combination of sliding to either side and resting that is consistent.
fn consistent_forces(most: &[f64], p: &[f64], gains: &[f64]) -> Vec<Vec<f64>> {
    let n = most.len();
    let mut found = Vec::new();
    for code in 0..3_usize.pow(n as u32) {
        let kinds: Vec<usize> = (0..n).map(|a| code / 3_usize.pow(a as u32) % 3).collect();
        let resting: Vec<usize> = (0..n).filter(|&a| kinds[a] == 0).collect();
        let mut forces: Vec<f64> = (0..n).map(|a| [0.0, most[a], -most[a]][kinds[a]]).collect();
        // What holds the resting ones, by elimination.
        let mut rows: Vec<Vec<f64>> = (resting.iter())
            .map(|&a| {
                let known: f64 = (0..n).map(|b| gains[a * n + b] * forces[b]).sum();
                resting.iter().map(|&b| gains[a * n + b]).chain([p[a] - known]).collect()
            })
            .collect();
        for i in 0..rows.len() {
            let pivot = rows[i].clone();
            for (j, row) in rows.iter_mut().enumerate() {
                if j != i {
                    let share = row[i] / pivot[i];
                    row.iter_mut().zip(&pivot).for_each(|(x, y)| *x -= share * y);
                }
            }
        }
        for (i, &a) in resting.iter().enumerate() {
            forces[a] = rows[i][resting.len()] / rows[i][i];
        }
        let fits = (0..n).all(|a| {
            let end = p[a] - (0..n).map(|b| gains[a * n + b] * forces[b]).sum::<f64>();
            match kinds[a] {
                0 => forces[a].abs() <= most[a],
                1 => end > 0.0,
                _ => end < 0.0,
            }
        });
        if fits {
            found.push(forces);
        }
    }
    found
}

#[test]
fn exactly_one_combination_of_resting_bodies_is_consistent() {
    let mut random = Random::new(5);
    let (mut tried, mut kinds) = (0, std::collections::HashSet::new());
    while tried < 4000 {
        let n = 2 + tried % 2;
        // Half of them inverses of inertias, each equation divided by its own, half no symmetric matrices at all.
        let root: Vec<f64> = (0..n * n).map(|_| random.uniform(-1.0, 1.0)).collect();
        let scales: Vec<f64> = (0..n).map(|_| random.uniform(0.2, 2.0)).collect();
        let gains: Vec<f64> = (0..n * n)
            .map(|at| {
                let (i, j) = (at / n, at % n);
                let square: f64 = (0..n).map(|k| root[i * n + k] * root[j * n + k]).sum();
                match (tried % 4 < 2, i == j) {
                    (true, own) => (square + if own { 0.2 } else { 0.0 }) * scales[j],
                    (false, true) => scales[i],
                    (false, false) => 0.45 * scales[i] * root[at],
                }
            })
            .collect();
        if !is_p_matrix(&gains, n) {
            continue;
        }
        tried += 1;
        let most: Vec<f64> = (0..n).map(|_| random.uniform(0.1, 2.0)).collect();
        let p: Vec<f64> = (0..n).map(|_| random.uniform(-2.0, 2.0)).collect();
        let all = consistent_forces(&most, &p, &gains);
        assert_eq!(all.len(), 1, "{gains:?} {p:?}");
        let laws = most.iter().map(|f| FrictionLaw::coulomb(*f)).collect();
        let problem = FrictionProblem::new(laws, gains).expect("a P-matrix");
        let mut at = Vec::new();
        problem.solve(1.0, (&vec![0.0; n], &p), &vec![0.0; n], &vec![0.0; n], &mut at);
        for (body, force) in at.iter().zip(&all[0]) {
            assert!((body.1.force - force).abs() < 1e-12, "{at:?} {all:?}");
        }
        kinds.insert(at.iter().map(|body| body.1.phase as usize).collect::<Vec<_>>());
    }
    assert!(kinds.len() >= 8 + 4);
}

#[test]
fn contact_solution_is_independent_of_its_start() {
    let mut random = Random::new(6);
    let mut seen = std::collections::HashSet::new();
    for case in 0..3000 {
        // Bodies that move each other by less than themselves, as inertias have it.
        let gains: Vec<f64> = (0..4).map(|at| if at % 3 == 0 { random.uniform(0.05, 0.3) } else { 0.0 }).collect();
        let across = random.uniform(-0.9, 0.9) * (gains[0] * gains[3]).sqrt();
        let gains = vec![gains[0], across, across, gains[3]];
        let stribeck = if case % 2 == 0 { 0.0 } else { 0.3 };
        let laws: Vec<FrictionLaw> =
            (0..2).map(|_| FrictionLaw { coulomb: random.uniform(0.1, 2.0), stribeck, speed: 0.5 }).collect();
        let (v, p): (Vec<f64>, Vec<f64>) =
            (0..2).map(|_| (random.uniform(-0.4, 0.4), random.uniform(-0.7, 0.7))).unzip();
        let problem = FrictionProblem::new(laws.clone(), gains.clone()).expect("a P-matrix");
        let (mut at, mut other) = (Vec::new(), Vec::new());
        problem.solve(1.0, (&v, &p), &[0.0; 2], &[0.0; 2], &mut at);
        for begun in [[2.0, 2.0], [-2.0, 2.0], [0.3, -1.0]] {
            problem.solve(1.0, (&v, &p), &[0.0; 2], &begun, &mut other);
            assert!(at.iter().zip(&other).all(|(x, y)| (x.1.force - y.1.force).abs() < 1e-11), "{case}");
        }
        for a in 0..2 {
            // Each obeys its own law beside the other's force.
            let free = p[a] - across * at[1 - a].1.force;
            let alone = laws[a].pulse(v[a], free, gains[3 * a], 0.0);
            assert!((alone.force - at[a].1.force).abs() < 1e-12 && (alone.end - at[a].1.end).abs() < 1e-12, "{case}");
        }
        seen.insert((at[0].1.phase as usize, at[1].1.phase as usize));
    }
    assert_eq!(seen.len(), 9);
    assert!(matches!(
        FrictionProblem::new(vec![FrictionLaw::coulomb(1.0); 2], vec![0.1, 0.2, 0.2, 0.1]),
        Err(Error::NotSimulable { .. })
    ));
}
