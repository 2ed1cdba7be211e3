//! Instrumental variables of coupled equations: one step against dense algebra, fixed points, covariance.

use ftlm::equation::{Equation, Initial};
use ftlm::estimation::instrumental_variables::coupled::CoupledProblem;
use ftlm::estimation::instrumental_variables::{fit, project, InstrumentalSettings};
use ftlm::fractional::kernels::block_pulse_kernel;
use ftlm::regressors::Record;
use ftlm::signal::block_pulse::PulseMeans;
use ftlm::simulate;

use crate::common::{check, dense_solve, deviation, equation, record, relative_distance, with_signal, Random};

/// Two outputs that drive each other, one input.
fn coupled_equations() -> [Equation; 2] {
    [
        equation(0, 1.6, &[(0, 0.0, -20.0), (1, 0.2, 3.0), (2, 0.0, 10.0)]),
        equation(1, 2.0, &[(1, 1.0, -2.0), (1, 0.0, -90.0), (0, 0.5, 6.0)]),
    ]
}

/// Clean and noisy record; noise in shares of each output's deviation.
fn simulate_measurement(m: usize, noise: f64, initial: &[Vec<(f64, f64)>], seed: u64) -> (Record, Record) {
    let mut random = Random::new(seed);
    let rest = record(0.01, vec![vec![0.0; m], vec![0.0; m], random.steps(m, 60)]);
    let outputs = simulate::respond(&coupled_equations(), &rest, initial).unwrap();
    let (mut clean, mut noisy) = (rest.clone(), rest);
    for (i, output) in outputs.iter().enumerate() {
        let sigma = noise * deviation(output);
        clean = with_signal(&clean, i, output.clone());
        noisy = with_signal(&noisy, i, output.iter().map(|v| v + sigma * random.normal()).collect());
    }
    (clean, noisy)
}

fn project_record(noisy: &Record, at_rest: bool) -> Record {
    let substitutes =
        (0..3).map(|s| if s < 2 { project(noisy, s, &[2], at_rest).unwrap() } else { noisy.signal(s).to_vec() });
    noisy.clone().with_clean(substitutes.map(PulseMeans::new).collect()).unwrap()
}

/// One step from `start` by full matrices: the 2m equations E(x) = Y − Φx, filtered by the inverse of the 2m × 2m
/// matrix of the outputs, correlated with the same of the simulated signals, both in units of the noise.
fn dense_step(noisy: &Record, start: &[Equation; 2], fixed: &[Vec<Option<f64>>; 2]) -> Vec<f64> {
    let m = noisy.m();
    let toeplitz = |eta: f64, signal: &[f64]| -> Vec<f64> {
        let kernel = block_pulse_kernel(eta, m, noisy.step());
        (0..m).map(|t| (0..=t).map(|s| kernel[t - s] * signal[s]).sum()).collect()
    };
    let mut matrix = vec![0.0; 4 * m * m];
    for (i, e) in start.iter().enumerate() {
        for t in 0..m {
            matrix[(i * m + t) * 2 * m + i * m + t] += 1.0;
            for (k, term) in e.structure.terms.iter().enumerate().filter(|(_, term)| term.signal < 2) {
                let kernel = block_pulse_kernel(e.structure.integration(k), m, noisy.step());
                for s in 0..=t {
                    matrix[(i * m + t) * 2 * m + term.signal * m + s] -= e.coefficients[k] * kernel[t - s];
                }
            }
        }
    }
    let outputs = simulate::respond(start, noisy, &[vec![], vec![]]).unwrap();
    let filtered = |i: usize, signal: &[f64]| {
        let mut stacked = vec![0.0; 2 * m];
        stacked[i * m..(i + 1) * m].copy_from_slice(signal);
        let mut out = dense_solve(&matrix, &stacked);
        for (j, output) in outputs.iter().enumerate() {
            let miss: f64 = output.iter().zip(noisy.signal(j)).map(|(a, b)| (a - b) * (a - b)).sum();
            #[allow(clippy::cast_precision_loss)]
            let sigma = (miss / m as f64).sqrt();
            out[j * m..(j + 1) * m].iter_mut().for_each(|v| *v /= sigma);
        }
        out
    };
    let (mut phi, mut psi, mut target) = (Vec::new(), Vec::new(), vec![0.0; 2 * m]);
    for (i, e) in start.iter().enumerate() {
        target.iter_mut().zip(filtered(i, noisy.signal(i))).for_each(|(t, v)| *t += v);
        for (k, term) in e.structure.terms.iter().enumerate() {
            let eta = e.structure.integration(k);
            let column = filtered(i, &toeplitz(eta, noisy.signal(term.signal)));
            if let Some(c) = fixed[i][k] {
                target.iter_mut().zip(column).for_each(|(t, v)| *t -= c * v);
                continue;
            }
            let clean = if term.signal < 2 { &outputs[term.signal] } else { noisy.signal(term.signal) };
            psi.push(filtered(i, &toeplitz(eta, clean)));
            phi.push(column);
        }
    }
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let cross: Vec<f64> = psi.iter().flat_map(|z| phi.iter().map(move |x| dot(z, x))).collect();
    dense_solve(&cross, &psi.iter().map(|z| dot(z, &target)).collect::<Vec<_>>())
}

#[test]
fn one_step_of_both_equations_matches_full_matrices() {
    let (_, noisy) = simulate_measurement(120, 0.02, &[vec![], vec![]], 3);
    let mut start = coupled_equations();
    for (k, factor) in [1.05, 0.93, 0.96].into_iter().enumerate() {
        start[0].coefficients[k] *= factor;
        start[1].coefficients[k] /= factor;
    }
    // The damping of the second is known.
    let fixed = [vec![None; 3], vec![Some(start[1].coefficients[0]), None, None]];
    let oracle = dense_step(&noisy, &start, &fixed);
    let structures = [start[0].structure.clone(), start[1].structure.clone()];
    let none = [vec![], vec![]];
    let (one, exponents, excluded_terms) = (std::slice::from_ref(&noisy), [vec![], vec![]], none);
    let problem = CoupledProblem {
        records: one,
        clean: one,
        structures: &structures,
        fixed: &fixed,
        exponents: &exponents,
        excluded_terms: &excluded_terms,
    };
    let begin: Vec<Vec<f64>> = start.iter().map(|e| e.coefficients.clone()).collect();
    let found = problem.refine(&begin, InstrumentalSettings { iterations: 1, tolerance: 0.0 }).unwrap().unwrap();
    assert_eq!(found.solutions[1][0].to_bits(), begin[1][0].to_bits());
    let free: Vec<f64> = found.solutions[0].iter().chain(&found.solutions[1][1..]).copied().collect();
    check("a step of coupled instrumental variables", relative_distance(&free, &oracle), 1e-9);
    assert_eq!((found.covariances[0].len(), found.covariances[1].len()), (9, 4));
}

#[test]
fn exact_data_of_several_records_with_initial_terms_is_a_fixed_point() {
    let starts = [
        [vec![(0.0, 0.2), (1.0, -0.5)], vec![(0.0, -0.1), (1.0, 0.8)]],
        [vec![(0.0, -0.4), (1.0, 0.1)], vec![(0.0, 0.3), (1.0, -0.2)]],
    ];
    let records: Vec<Record> = [(500, 5), (420, 6)]
        .into_iter()
        .zip(&starts)
        .map(|((m, seed), initial)| project_record(&simulate_measurement(m, 0.0, initial, seed).1, false))
        .collect();
    let truth = coupled_equations();
    let structures = [truth[0].structure.clone(), truth[1].structure.clone()];
    let initial = Initial::Powers(vec![0.0, 1.0]);
    let found =
        fit(&records, &structures, &[vec![None; 3], vec![None; 3]], &initial, InstrumentalSettings::default()).unwrap();
    assert!(!found.damped);
    for (i, (estimate, model)) in found.estimates.iter().zip(&truth).enumerate() {
        let what = format!("coefficients of equation {i}");
        check(&what, relative_distance(&estimate.coefficients, &model.coefficients), 1e-8);
        for (found, start) in estimate.initial.iter().zip(&starts) {
            for (value, truth) in found.iter().zip(&start[i]) {
                check("initial term", (value - truth.1).abs(), 1e-7);
            }
        }
    }
}

#[test]
fn likelihood_is_stationary_at_convergence() {
    let (_, noisy) = simulate_measurement(900, 0.05, &[vec![], vec![]], 11);
    let noisy = project_record(&noisy, true);
    let truth = coupled_equations();
    let structures = [truth[0].structure.clone(), truth[1].structure.clone()];
    let settings = InstrumentalSettings { iterations: 40, tolerance: 1e-10 };
    let found =
        fit(std::slice::from_ref(&noisy), &structures, &[vec![None; 3], vec![None; 3]], &Initial::Rest, settings)
            .unwrap();
    assert!(found.converged);
    #[allow(clippy::cast_precision_loss)]
    let cost = |shift: Option<(usize, usize, f64)>| {
        let mut equations = truth.clone();
        for (equation, estimate) in equations.iter_mut().zip(&found.estimates) {
            equation.coefficients.clone_from(&estimate.coefficients);
        }
        if let Some((i, k, by)) = shift {
            equations[i].coefficients[k] += by;
        }
        let outputs = simulate::respond(&equations, &noisy, &[vec![], vec![]]).unwrap();
        let m = noisy.m() as f64;
        (0..2)
            .map(|j| {
                let miss: f64 = outputs[j].iter().zip(noisy.signal(j)).map(|(a, b)| (a - b) * (a - b)).sum();
                m * (miss / m).ln()
            })
            .sum::<f64>()
    };
    let least = cost(None);
    for i in 0..2 {
        for k in 0..3 {
            // By a tenth of a standard error either way: the cost rises by about 0.01 (other coefficients held: more),
            // and equally, however it is coupled.
            let by = 0.1 * found.estimates[i].covariance[4 * k].sqrt();
            let (up, down) = (cost(Some((i, k, by))) - least, cost(Some((i, k, -by))) - least);
            assert!(up > 0.005 && down > 0.005, "{i} {k}: {up} {down}");
            assert!((up - down).abs() < 0.05 * (up + down), "{i} {k}: {up} {down}");
        }
    }
}

#[test]
fn scores_have_the_stated_covariance() {
    let truth = coupled_equations();
    let structures = [truth[0].structure.clone(), truth[1].structure.clone()];
    let mut scores = vec![Vec::new(); 6];
    for seed in 0..30 {
        let (_, noisy) = simulate_measurement(900, 0.05, &[vec![], vec![]], 100 + seed);
        let noisy = project_record(&noisy, true);
        let found = fit(
            &[noisy],
            &structures,
            &[vec![None; 3], vec![None; 3]],
            &Initial::Rest,
            InstrumentalSettings::default(),
        );
        let found = found.unwrap();
        assert!(found.converged && !found.damped, "seed {seed}");
        for (i, (estimate, model)) in found.estimates.iter().zip(&truth).enumerate() {
            for k in 0..3 {
                let z = (estimate.coefficients[k] - model.coefficients[k]) / estimate.covariance[4 * k].sqrt();
                scores[3 * i + k].push(z);
            }
        }
    }
    for z in &scores {
        #[allow(clippy::cast_precision_loss)]
        let mean = z.iter().sum::<f64>() / z.len() as f64;
        let spread = deviation(z);
        // 30 scores: the mean of unbiased ones has a standard deviation of 0.18, their spread one of 0.13.
        assert!(mean.abs() < 0.75, "{z:?}");
        assert!((0.6..1.5).contains(&spread), "{spread}: {z:?}");
    }
}

#[test]
fn unstable_start_is_unchanged() {
    let (_, noisy) = simulate_measurement(400, 0.02, &[vec![], vec![]], 17);
    let truth = coupled_equations();
    let structures = [truth[0].structure.clone(), truth[1].structure.clone()];
    let (one, exponents, excluded_terms) = (std::slice::from_ref(&noisy), [vec![], vec![]], [vec![], vec![]]);
    let fixed = [vec![None; 3], vec![None; 3]];
    let problem = CoupledProblem {
        records: one,
        clean: one,
        structures: &structures,
        fixed: &fixed,
        exponents: &exponents,
        excluded_terms: &excluded_terms,
    };
    let begin = vec![vec![-20.0, 3.0, 10.0], vec![40.0, -90.0, 6.0]];
    assert_eq!(problem.refine(&begin, InstrumentalSettings::default()).unwrap(), None);
}
