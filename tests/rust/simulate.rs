//! Free runs against dense oracles, the two errors of a model, explicit Euler, and the stability margin of the scheme.

use ftlm::equation::{Equation, Filter, Initial, Structure, Term};
use ftlm::error::Error;
use ftlm::estimation::least_squares;
use ftlm::fractional::kernels::block_pulse_kernel;
use ftlm::regressors::Record;
use ftlm::series;
use ftlm::signal::block_pulse::PulseMeans;
use ftlm::simulate::{
    equation_error, explicit_euler, nyquist_margin, respond, respond_and_units, respond_with_initial, trace_errors,
    unit_responses, OutputFilter,
};
use proptest::prelude::*;

use crate::common::{
    bits, cases, check, check_between, dense_solve, distance, equation, largest, norm, record, relative_distance,
    structure, toeplitz, with_signal, Random,
};

fn one(equation: &Equation) -> &[Equation] {
    std::slice::from_ref(equation)
}

/// Two coupled angles (0, 1), an input (2): a stage with round numbers.
fn stage() -> [Equation; 2] {
    [
        equation(0, 2.0, &[(1, 0.0, 60.0), (0, 0.95, -6.0), (1, 0.75, 1.5), (2, 0.0, 14.0)]),
        equation(1, 2.0, &[(1, 0.1, -85.0), (0, 1.05, 6.0), (1, 0.85, -2.0), (2, 0.0, -14.0)]),
    ]
}

fn driven_record(m: usize, step: f64, seed: u64) -> Record {
    let mut random = Random::new(seed);
    record(step, vec![vec![0.0; m], vec![0.0; m], random.steps(m, 23)])
}

/// The record with the outputs that the model gives.
fn close_loop(model: &[Equation], record: &Record, initial: &[Vec<(f64, f64)>]) -> Record {
    let mut closed = record.clone();
    for (equation, y) in model.iter().zip(respond(model, record, initial).unwrap()) {
        closed = with_signal(&closed, equation.structure.output, y);
    }
    closed
}

#[test]
fn one_equation_matches_the_dense_solution() {
    let mut random = Random::new(70);
    for m in [1, 5, 64, 150] {
        let record = record(0.03, vec![random.signal(m), random.signal(m), random.signal(m)]);
        let model = equation(0, 1.7, &[(0, 0.4, -2.0), (0, 0.0, -9.0), (1, 1.7, 0.3), (1, 0.2, 1.0), (2, -0.5, 4.0)]);
        let initial = vec![vec![(0.0, 0.3), (0.7, -1.0)]];
        let mut a = toeplitz(&block_pulse_kernel(1.7, m, 0.03)).iter().map(|v| 9.0 * v).collect::<Vec<_>>();
        a.iter_mut().zip(toeplitz(&block_pulse_kernel(1.3, m, 0.03))).for_each(|(a, v)| *a += 2.0 * v);
        (0..m).for_each(|i| a[i * m + i] += 1.0);
        let mut b: Vec<f64> = record.signal(1).iter().map(|v| 0.3 * v).collect();
        for (signal, eta, c) in [(1, 1.5, 1.0), (2, 2.2, 4.0)] {
            let kernel = block_pulse_kernel(eta, m, 0.03);
            let integral = series::multiply_naive(&kernel, record.signal(signal), m);
            b.iter_mut().zip(integral).for_each(|(b, v)| *b += c * v);
        }
        for &(e, c) in &initial[0] {
            b.iter_mut().zip(record.initial_term(e)).for_each(|(b, v)| *b += c * v);
        }
        let found = respond(one(&model), &record, &initial).unwrap();
        assert_eq!(found.len(), 1);
        check("free run against dense solution", relative_distance(&found[0], &dense_solve(&a, &b)), 1e-13);
    }
}

#[test]
fn coupled_equations_match_the_dense_solution() {
    let (m, step) = (120, 0.01);
    let record = driven_record(m, step, 71);
    let model = stage();
    let n = 2 * m;
    let (mut a, mut b) = (vec![0.0; n * n], vec![0.0; n]);
    for (i, equation) in model.iter().enumerate() {
        for (k, (term, c)) in equation.structure.terms.iter().zip(&equation.coefficients).enumerate() {
            let kernel = block_pulse_kernel(equation.structure.integration(k), m, step);
            if term.signal == 2 {
                let integral = series::multiply_naive(&kernel, record.signal(2), m);
                b[i * m..(i + 1) * m].iter_mut().zip(integral).for_each(|(b, v)| *b += c * v);
            } else {
                let matrix = toeplitz(&kernel);
                for r in 0..m {
                    for s in 0..m {
                        a[(i * m + r) * n + term.signal * m + s] -= c * matrix[r * m + s];
                    }
                }
            }
        }
    }
    (0..n).for_each(|i| a[i * n + i] += 1.0);
    let found = respond(&model, &record, &[]).unwrap().concat();
    check("coupled run against dense solution", relative_distance(&found, &dense_solve(&a, &b)), 1e-13);
}

#[test]
fn coupled_simulation_satisfies_each_equation() {
    // Fed back as measured coupling, the coupled outputs are each equation's own response, and its exact data.
    let model = stage();
    for m in [100, 1000, 2049] {
        let record = close_loop(&model, &driven_record(m, 0.005, 72), &[]);
        for (i, equation) in model.iter().enumerate() {
            let alone = respond(one(equation), &record, &[]).unwrap();
            check("alone against coupled", relative_distance(&alone[0], record.signal(i)), 1e-11);
            let error = equation_error(equation, &record, &Initial::Rest).unwrap();
            check("equation error of a free run", largest(&error) / largest(record.signal(i)), 1e-12);
        }
    }
    // The order in which equations are given does not matter, nor does what the record says of their outputs.
    let record = driven_record(500, 0.005, 73);
    let forward = respond(&model, &record, &[]).unwrap();
    let backward = respond(&[model[1].clone(), model[0].clone()], &close_loop(&model, &record, &[]), &[]).unwrap();
    assert!(distance(&forward[0], &backward[1]) <= 1e-12 && distance(&forward[1], &backward[0]) <= 1e-12);
}

#[test]
fn initial_terms_belong_to_their_equation() {
    let model = stage();
    let record = driven_record(400, 0.005, 74);
    let rest = respond(&model, &record, &[]).unwrap();
    assert_eq!(respond(&model, &record, &[vec![], vec![]]).unwrap(), rest);
    // Linear in each of them.
    let with = |first: f64, second: f64| respond(&model, &record, &[vec![(0.0, first)], vec![(1.0, second)]]).unwrap();
    let (a, b, both) = (with(1.0, 0.0), with(0.0, 1.0), with(2.0, -3.0));
    for i in 0..2 {
        let sum: Vec<f64> =
            (0..400).map(|k| rest[i][k] + 2.0 * (a[i][k] - rest[i][k]) - 3.0 * (b[i][k] - rest[i][k])).collect();
        assert!(relative_distance(&both[i], &sum) < 1e-11);
    }
}

#[test]
fn unsolvable_models_are_rejected() {
    let record = driven_record(50, 0.01, 75);
    let twice = [stage()[0].clone(), stage()[0].clone()];
    match respond(&twice, &record, &[]) {
        Err(error @ Error::Structure { .. }) => {
            assert!(error.to_string().starts_with("two equations have signal 0 as their output"));
        }
        other => panic!("{other:?}"),
    }
    let missing = equation(0, 2.0, &[(7, 0.0, 1.0)]);
    assert!(matches!(respond(one(&missing), &record, &[]), Err(Error::Structure { .. })));
    assert!(matches!(equation_error(&missing, &record, &Initial::Rest), Err(Error::Structure { .. })));
    assert!(matches!(trace_errors(&missing.structure, &record, &[]), Err(Error::Structure { .. })));
    let steep = equation(0, 2.0, &[(0, 2.0, 1.0)]);
    assert!(matches!(respond(one(&steep), &record, &[]), Err(Error::OutOfRange { .. })));
    // y0 = y1 + …, y1 = y0 + …: an algebraic loop of gain one.
    let algebraic = [equation(0, 1.0, &[(1, 1.0, 1.0)]), equation(1, 1.0, &[(0, 1.0, 1.0), (2, 0.0, 1.0)])];
    match respond(&algebraic, &record, &[]) {
        Err(error @ Error::Structure { .. }) => {
            assert!(error.to_string().starts_with("the leading matrix of the equations is singular"));
        }
        other => panic!("{other:?}"),
    }
    // Gain one half is solvable, and no equations at all is no fault.
    let half = [equation(0, 1.0, &[(1, 1.0, 0.5)]), equation(1, 1.0, &[(0, 1.0, 1.0), (2, 0.0, 1.0)])];
    let found = respond(&half, &record, &[]).unwrap();
    let doubled: Vec<f64> = record.integral(2, 1.0).iter().map(|v| 2.0 * v).collect();
    assert!(relative_distance(&found[1], &doubled) < 1e-13);
    assert_eq!(respond(&[], &record, &[]), Ok(vec![]));
}

#[test]
fn unstable_model_overflows_without_an_error() {
    let record = record(0.1, vec![vec![0.0; 2000], vec![1.0; 2000]]);
    let model = equation(0, 2.0, &[(0, 0.0, 400.0), (1, 0.0, 1.0)]);
    let found = respond(one(&model), &record, &[]).unwrap();
    assert!(found[0][0].is_finite() && !found[0][1999].is_finite());
    // There is then nothing to fit initial terms to, and they stay zero.
    let refit = respond_with_initial(one(&model), &record, &Initial::Caputo, None).unwrap();
    assert_eq!(refit.initial, [[0.0, 0.0]]);
    assert_eq!(trace_errors(&model.structure, &record, &[vec![400.0, 1.0]]).unwrap(), [f64::INFINITY]);
}

#[test]
fn refitted_initial_terms_leave_no_error() {
    // A stage that did not start at rest: initial terms of both equations, all powers of its Caputo derivatives.
    let model = stage();
    let initial = [vec![(0.0, 0.2), (1.0, -0.4), (1.05, 1.2)], vec![(0.0, -0.05), (0.95, 0.3), (1.9, 0.7)]];
    for m in [300, 1000] {
        let record = close_loop(&model, &driven_record(m, 0.01, 76), &initial);
        let found = respond_with_initial(&model, &record, &Initial::Caputo, None).unwrap();
        for (i, equation) in model.iter().enumerate() {
            check("refitted response", relative_distance(&found.outputs[i], record.signal(i)), 1e-10);
            assert_eq!(found.exponents[i], equation.structure.initial_exponents(&Initial::Caputo));
            assert_eq!(found.initial[i].len(), found.exponents[i].len());
        }
        // At rest the same record is far from explained.
        let rest = respond_with_initial(&model, &record, &Initial::Rest, None).unwrap();
        assert!(relative_distance(&rest.outputs[0], record.signal(0)) > 0.1);
        assert_eq!(rest.initial, [[0.0; 0], [0.0; 0]]);
        // One equation alone, with its own terms known to be few.
        let powers = Initial::Powers(vec![0.0, 1.0, 1.05]);
        let alone = respond_with_initial(one(&model[0]), &record, &powers, None).unwrap();
        check("terms of one equation", distance(&alone.initial[0], &[0.2, -0.4, 1.2]), 1e-10);
        let error = equation_error(&model[0], &record, &powers).unwrap();
        check("equation error with initial terms", largest(&error) / largest(record.signal(0)), 1e-11);
    }
}

#[test]
fn filtered_outputs_are_compared_through_the_filter() {
    let model = stage();
    let m = 800;
    let initial = [vec![(0.0, 0.2), (1.0, -0.4)], vec![(0.0, -0.05)]];
    let clean = close_loop(&model, &driven_record(m, 0.01, 77), &initial);
    let low_pass: Vec<f64> = (0..m).map(|k| 0.3 * 0.7_f64.powi(i32::try_from(k).unwrap())).collect();
    let filtered = with_signal(&clean, 1, series::multiply(&low_pass, clean.signal(1), m));
    let powers = Initial::Powers(vec![0.0, 1.0]);
    let applies = [false, true];
    let filter = Some(OutputFilter { series: &low_pass, applies: &applies });
    let found = respond_with_initial(&model, &filtered, &powers, filter).unwrap();
    for i in 0..2 {
        check("filtered response", relative_distance(&found.outputs[i], filtered.signal(i)), 1e-10);
    }
    assert!(distance(&found.initial[0], &[0.2, -0.4]) < 1e-8 && distance(&found.initial[1], &[-0.05, 0.0]) < 1e-8);
    // Unfiltered, the deflection differs from what was logged.
    let plain = respond_with_initial(&model, &filtered, &powers, None).unwrap();
    assert!(relative_distance(&plain.outputs[1], filtered.signal(1)) > 1e-3);
}

#[test]
fn the_equation_error_is_what_remains() {
    let mut random = Random::new(78);
    let record = record(0.02, vec![random.signal(300), random.signal(300), random.signal(300)]);
    let model = equation(0, 1.5, &[(0, 0.5, -1.0), (1, 1.5, 0.2), (2, 0.0, 3.0)]);
    let error = equation_error(&model, &record, &Initial::Rest).unwrap();
    let oracle: Vec<f64> = (0..300)
        .map(|k| {
            record.signal(0)[k] + record.integral(0, 1.0)[k]
                - 0.2 * record.signal(1)[k]
                - 3.0 * record.integral(2, 1.5)[k]
        })
        .collect();
    assert!(distance(&error, &oracle) < 1e-13);
    // Initial terms may only make it smaller, and leave it orthogonal to them.
    let with = equation_error(&model, &record, &Initial::Caputo).unwrap();
    assert!(norm(&with) < norm(&error));
    for exponent in model.structure.initial_exponents(&Initial::Caputo) {
        let column = record.initial_term(exponent);
        let product: f64 = with.iter().zip(&column).map(|(a, b)| a * b).sum();
        assert!(product.abs() < 1e-11 * norm(&with) * norm(&column));
    }
}

#[test]
fn euler_matches_analytic_cases() {
    let (h, rows) = (0.01, 400);
    let step = vec![1.0; rows];
    // D y = −3 y + 2 u: y_k = 2/3 (1 − (1 − 3h)^k).
    let lag = equation(0, 1.0, &[(0, 0.0, -3.0), (1, 0.0, 2.0)]);
    let found = explicit_euler(one(&lag), &[vec![9.9; rows], step.clone()], h).unwrap();
    let exact: Vec<f64> = (0..rows).map(|k| 2.0 / 3.0 * (1.0 - (1.0 - 3.0 * h).powi(k as i32))).collect();
    check("Euler's lag", distance(&found[0], &exact), 1e-13);
    // D³ y = u: y_k = h³ k(k−1)(k−2)/6.
    let triple = equation(0, 3.0, &[(1, 0.0, 1.0)]);
    let found = explicit_euler(one(&triple), &[vec![0.0; rows], step.clone()], h).unwrap();
    let exact: Vec<f64> = (0..rows).map(|k| k as f64).map(|k| h * h * h * k * (k - 1.0) * (k - 2.0) / 6.0).collect();
    check("Euler's triple integral", distance(&found[0], &exact), 1e-12);
    // A rotation, D x = −5 y + u, D y = 5 x, against the recursion written out; the second needs D^1 of the first too.
    let rotation =
        [equation(0, 1.0, &[(1, 0.0, -5.0), (2, 0.0, 1.0)]), equation(1, 2.0, &[(0, 0.0, 2.0), (1, 1.0, -0.5)])];
    let mut random = Random::new(79);
    let u = random.signal(rows);
    let found = explicit_euler(&rotation, &[vec![0.0; rows], vec![0.0; rows], u.clone()], h).unwrap();
    let (mut x, mut y, mut dy) = (0.0, 0.0, 0.0);
    for k in 0..rows {
        assert!((found[0][k] - x).abs() < 1e-13 && (found[1][k] - y).abs() < 1e-13);
        let (fx, fdy) = (-5.0 * y + u[k], 2.0 * x - 0.5 * dy);
        (x, y, dy) = (x + h * fx, y + h * dy, dy + h * fdy);
    }
    // First order in the step, and unstable where the step is too long.
    let fast = equation(0, 1.0, &[(0, 0.0, -300.0), (1, 0.0, 1.0)]);
    let found = explicit_euler(one(&fast), &[vec![0.0; 4000], vec![1.0; 4000]], h).unwrap();
    assert!(!found[0][3999].is_finite());
    assert_eq!(explicit_euler(one(&lag), &[vec![], vec![]], h), Ok(vec![vec![]]));
}

#[test]
fn euler_rejects_unsupported_orders() {
    let signals = vec![vec![0.0; 5]; 3];
    let good = equation(0, 2.0, &[(0, 1.0, 1.0)]);
    for (bad, position) in [
        (vec![equation(0, 1.8, &[])], 0),
        (vec![good.clone(), equation(1, 2.0, &[(1, 0.5, 1.0)])], 1),
        (vec![good.clone(), equation(1, 1.0, &[(2, 1.0, 1.0)])], 1),
        // An order of another output that its own equation makes its highest.
        (vec![good.clone(), equation(1, 2.0, &[(0, 2.0, 1.0)])], 1),
        // Positive and within the grain of zero: an equation, but not one with a state.
        (vec![equation(0, 1e-10, &[])], 0),
    ] {
        match explicit_euler(&bad, &signals, 0.1) {
            Err(error @ Error::Structure { .. }) => {
                let start = format!("equation {position} has orders that explicit Euler cannot step");
                assert!(error.to_string().starts_with(&start), "{error}");
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn traced_errors_are_those_of_separate_runs() {
    let model = equation(0, 1.8, &[(0, 0.9, -3.0), (0, 0.0, -10.0), (1, 0.0, 4.0), (2, 0.3, 0.7)]);
    let mut random = Random::new(80);
    let m = 700;
    let rest = record(0.01, vec![vec![0.0; m], random.steps(m, 31), random.steps(m, 7)]);
    let record = close_loop(one(&model), &rest, &[]);
    let noisy = with_signal(&record, 0, record.signal(0).iter().map(|y| y + 0.01 * random.normal()).collect());
    let rows: Vec<Vec<f64>> = (0..20)
        .map(|k| model.coefficients.iter().map(|c| if k == 0 { 0.0 } else { c * random.uniform(0.5, 1.5) }).collect())
        .collect();
    let found = trace_errors(&model.structure, &noisy, &rows).unwrap();
    for (row, found) in rows.iter().zip(found) {
        let equation = Equation { structure: model.structure.clone(), coefficients: row.clone() };
        let response = respond(one(&equation), &noisy, &[]).unwrap();
        let error: f64 = noisy.signal(0).iter().zip(&response[0]).map(|(y, v)| (y - v).abs()).sum();
        assert!((found / error - 1.0).abs() < 1e-12, "{found} against {error}");
    }
    // No coefficients at all: the measurement itself.
    let sum: f64 = noisy.signal(0).iter().map(|y| y.abs()).sum();
    assert_eq!(trace_errors(&model.structure, &noisy, &rows[..1]).unwrap(), [sum]);
    let short = trace_errors(&model.structure, &noisy, &[vec![1.0; 3]]);
    assert_eq!(short, Err(Error::Length { name: "coefficients".into(), expected: 4, found: 3 }));
}

#[test]
fn the_margin_of_a_second_order_equation_is_known() {
    for (c, h) in [(1.0, 0.1), (863.0, 0.002), (100.0, 0.3), (48.0, 0.5)] {
        check("margin of D²y = −cy", (nyquist_margin(&[(-c, 2.0)], h) - (1.0 - c * h * h / 12.0)).abs(), 1e-13);
    }
    // Integrated once, the alternating mode is damped by nothing and driven by nothing.
    assert!((nyquist_margin(&[(-1e6, 1.0)], 0.1) - 1.0).abs() < 1e-9);
    assert_eq!(nyquist_margin(&[], 0.1), 1.0);
}

#[test]
fn the_margin_is_the_divisor_at_the_nyquist_frequency() {
    // Abel's sum of the alternating kernel by repeated averaging of partial sums.
    for eta in [0.1, 0.5, 0.95, 1.0, 1.3, 1.8, 2.0, 2.6] {
        let mut sums: Vec<f64> = block_pulse_kernel(eta, 60, 1.0)
            .iter()
            .enumerate()
            .scan(0.0, |sum, (k, v)| {
                *sum += if k % 2 == 0 { *v } else { -v };
                Some(*sum)
            })
            .collect();
        while sums.len() > 1 {
            sums = sums.windows(2).map(|p| 0.5 * (p[0] + p[1])).collect();
        }
        check(
            &format!("kernel of order {eta} at z = -1"),
            (1.0 - nyquist_margin(&[(1.0, eta)], 1.0) - sums[0]).abs(),
            1e-9,
        );
    }
}

#[test]
fn scheme_is_unstable_without_positive_margin() {
    // D^α y = −c y + u: below the limit of c the alternating mode dies out, above it the response grows without bound.
    for alpha in [1.4, 1.8, 2.0] {
        let step = 0.01;
        let slope = 1.0 - nyquist_margin(&[(-1.0, alpha)], step);
        let limit = 1.0 / slope;
        assert!(slope > 0.0);
        let m = 4000;
        let mut impulse = vec![0.0; m];
        impulse[0] = 1.0;
        let record = record(step, vec![vec![0.0; m], impulse]);
        let size = |factor: f64| {
            let model = equation(0, alpha, &[(0, 0.0, -factor * limit), (1, 0.0, 1.0)]);
            let y = respond(one(&model), &record, &[]).unwrap().remove(0);
            largest(&y[m - 200..]) / largest(&y[..200])
        };
        assert!(nyquist_margin(&[(-0.98 * limit, alpha)], step) > 0.0);
        assert!(nyquist_margin(&[(-1.02 * limit, alpha)], step) < 0.0);
        // An undamped oscillation (α = 2) keeps its size below the limit; a damped one vanishes.
        check(&format!("growth below the limit, order {alpha}"), size(0.98), if alpha == 2.0 { 2.0 } else { 0.1 });
        assert!(size(1.02) > 1e10, "order {alpha}: {}", size(1.02));
    }
}

#[test]
fn the_margin_adds_up_over_terms() {
    let terms = [(-3.0, 1.8), (2.0, 0.4), (-0.5, 0.9)];
    let sum: f64 = terms.iter().map(|&t| 1.0 - nyquist_margin(&[t], 0.2)).sum();
    assert!((1.0 - nyquist_margin(&terms, 0.2) - sum).abs() < 1e-14);
}

proptest! {
    #![proptest_config(cases(32))]

    #[test]
    fn simulation_is_linear_in_inputs_and_causal(seed in any::<u64>(), c in -3.0..3.0_f64, late in 1usize..200) {
        let model = stage();
        let m = 300;
        let (first, second) = (driven_record(m, 0.01, seed), driven_record(m, 0.01, seed ^ 1));
        let mixed: Vec<f64> = first.signal(2).iter().zip(second.signal(2)).map(|(a, b)| c * a + b).collect();
        let of = |record: &Record| respond(&model, record, &[]).unwrap();
        let (a, b, both) = (of(&first), of(&second), of(&with_signal(&first, 2, mixed)));
        for i in 0..2 {
            let sum: Vec<f64> = a[i].iter().zip(&b[i]).map(|(a, b)| c * a + b).collect();
            prop_assert!(relative_distance(&both[i], &sum) < 1e-9);
        }
        let shifted: Vec<f64> =
            std::iter::repeat_n(0.0, late).chain(first.signal(2).iter().copied()).take(m).collect();
        let then = of(&with_signal(&first, 2, shifted));
        for i in 0..2 {
            prop_assert!(distance(&then[i][late..], &a[i][..m - late]) <= 1e-10 * largest(&a[i]));
        }
    }

    #[test]
    fn longer_record_begins_with_the_shorter_one(seed in any::<u64>(), m in 2usize..600) {
        let model = stage();
        let long = driven_record(600, 0.01, seed);
        let short = record(0.01, (0..3).map(|s| long.signal(s)[..m].to_vec()).collect());
        let (a, b) = (respond(&model, &long, &[]).unwrap(), respond(&model, &short, &[]).unwrap());
        for i in 0..2 {
            prop_assert!(distance(&a[i][..m], &b[i]) <= 1e-12 * largest(&a[i]));
        }
    }

    #[test]
    fn fit_response_matches_simulation(seed in any::<u64>()) {
        let truth = equation(0, 1.6, &[(0, 0.5, -4.0), (0, 0.0, -6.0), (2, 0.0, 5.0)]);
        let record = close_loop(one(&truth), &driven_record(256, 0.02, seed), &[]);
        let s = structure(0, 1.6, &[(0, 0.5), (0, 0.0), (2, 0.0)]);
        let fit = least_squares::fit(std::slice::from_ref(&record), &s, &[None; 3], &Initial::Rest).unwrap();
        let again = Equation { structure: s, coefficients: fit.coefficients };
        let response = respond(one(&again), &record, &[]).unwrap();
        prop_assert!(relative_distance(&response[0], record.signal(0)) < 1e-9);
        prop_assert_eq!(bits(&respond(one(&again), &record, &[]).unwrap()[0]), bits(&response[0]));
    }
}

#[test]
fn unit_responses_match_simulations_of_single_initial_terms() {
    let terms = |output: usize, other: usize| {
        vec![
            Term { signal: output, order: 0.0 },
            Term { signal: output, order: 0.9 },
            Term { signal: other, order: 0.3 },
            Term { signal: 2, order: 0.0 },
        ]
    };
    let equation = |output: usize, coefficients: [f64; 4]| Equation {
        structure: Structure { output, order: 1.8, terms: terms(output, 1 - output) },
        coefficients: coefficients.to_vec(),
    };
    let filter: Vec<f64> = (0..500).map(|k| 0.2 * 0.8_f64.powi(k)).collect();
    let units = [(0, 0.0), (0, 1.0), (1, 0.35), (1, 1.8)];
    // One that decays, and one that grows by 10^8 or so.
    for own in [-9.0, 25.0] {
        let model = [equation(0, [own, -1.0, 0.5, 1.0]), equation(1, [-16.0, -2.0, -0.5, 0.0])];
        for filter in [None, Some(filter.clone())] {
            let driven = Record::new(
                0.01,
                PulseMeans::from_signals(vec![vec![0.3; 500], vec![0.1; 500], vec![1.0; 500]]),
                filter.clone(),
            )
            .unwrap();
            let still = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 500]; 3]), filter).unwrap();
            let found = unit_responses(&model, &driven, &units).unwrap();
            let (rest, same) = respond_and_units(&model, &driven, &units).unwrap();
            assert_eq!(same, found);
            for (a, b) in rest.iter().zip(&respond(&model, &driven, &[]).unwrap()) {
                assert!(relative_distance(a, b) < 1e-12 && relative_distance(&a[..50], &b[..50]) < 1e-10, "{own}");
            }
            for (&(i, exponent), outputs) in units.iter().zip(&found) {
                let mut initial = vec![vec![], vec![]];
                initial[i].push((exponent, 1.0));
                let naive = respond(&model, &still, &initial).unwrap();
                for (a, b) in outputs.iter().zip(&naive) {
                    assert!(relative_distance(a, b) < 1e-11, "{own} {i} {exponent}");
                    // At the beginning, too.
                    assert!(relative_distance(&a[..50], &b[..50]) < 1e-9, "{own} {i} {exponent}");
                }
            }
        }
    }
    let still = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 50]; 3]), None).unwrap();
    let model = [equation(0, [-9.0, -1.0, 0.5, 1.0])];
    assert!(matches!(unit_responses(&model, &still, &[(1, 0.0)]), Err(Error::Structure { .. })));
    assert!(unit_responses(&model, &still, &[(0, f64::NAN)]).is_err());
}

#[test]
fn singular_powers_drive_filtered_equations_to_second_order() {
    // D^1.4 y = -2 y behind 1/(1 + s/2), driven by t^e: its double series of powers, integrated once more for a pulse mean.
    let (alpha, rate) = (1.4, 2.0);
    let plant = [equation(0, alpha, &[(0, 0.0, -2.0)])];
    let lag = Filter { numerator: vec![(1.0, 0.0)], denominator: vec![(1.0 / rate, 1.0), (1.0, 0.0)] };
    for exponent in [-0.9, -0.52, -0.2] {
        let integral = |t: f64| {
            let mut sum = 0.0;
            for n in 0..30 {
                for k in 0..40 {
                    let power = exponent + f64::from(k) + 2.0 + alpha * f64::from(n);
                    let size = (-2.0_f64).powi(n) * (-1.0_f64).powi(k) * rate.powi(k + 1);
                    sum += size * t.powf(power) / libm::tgamma(power + 1.0);
                }
            }
            sum * libm::tgamma(exponent + 1.0)
        };
        let missed = |m: usize| {
            let step = 1.0 / m as f64;
            let still =
                Record::new(step, PulseMeans::from_signals(vec![vec![0.0; m]]), Some(lag.series(m, step).unwrap()))
                    .unwrap();
            let found = unit_responses(&plant, &still, &[(0, exponent)]).unwrap();
            let truth = (integral(1.0) - integral(1.0 - step)) / step;
            assert!(truth.abs() > 0.01);
            (found[0][0][m - 1] - truth).abs()
        };
        let order = 0.5 * (missed(512) / missed(2048)).log2();
        check_between(&format!("order of the response to t^{exponent}"), order, 1.9, 2.4);
    }
}

#[test]
fn improper_term_differentiates_the_deviation_from_the_level() {
    let (m, step, level) = (200, 0.02, 0.7);
    let mut random = Random::new(11);
    let input: Vec<f64> = random.signal(m).iter().map(|v| level + 0.3 * v).collect();
    let above: Vec<f64> = input.iter().map(|v| v - level).collect();
    let run = |input: &[f64]| record(step, vec![vec![0.0; m], input.to_vec()]);
    let begun = run(&input).with_initial_state(vec![false; 2], &[0.0, level], Vec::new()).unwrap();
    for (order, expected) in [(1.3, &above), (0.9, &input), (0.2, &input)] {
        let model = equation(0, 0.9, &[(0, 0.0, -3.0), (1, order, 2.0)]);
        let (found, told) = (respond(one(&model), &begun, &[]), respond(one(&model), &run(expected), &[]));
        assert!(distance(&found.unwrap()[0], &told.unwrap()[0]) < 1e-12, "order {order}");
    }
    // Behind a filter the level is what the filter makes of it.
    let lag =
        Filter { numerator: vec![(4.0, 0.0)], denominator: vec![(1.0, 1.0), (4.0, 0.0)] }.series(m, step).unwrap();
    let through = begun.with_filter(&lag).unwrap();
    assert!(distance(through.deviation_signal(1), &series::multiply_naive(&lag, &above, m)) < 1e-12);
    let unit = record(step, vec![vec![1.0; m]]).with_filter(&lag).unwrap();
    let late =
        run(&input).with_filter(&lag).unwrap().with_initial_state(vec![false; 2], &[0.0, level], Vec::new()).unwrap();
    let expected: Vec<f64> = late.signal(1).iter().zip(unit.signal(0)).map(|(v, one)| v - level * one).collect();
    assert!(distance(late.deviation_signal(1), &expected) < 1e-12);
    assert_eq!(late.deviation_signal(0), late.signal(0));
    assert!(matches!(
        run(&input).with_initial_state(vec![false], &[0.0, level], Vec::new()),
        Err(Error::Length { .. })
    ));
    assert!(matches!(run(&input).with_initial_state(vec![false; 2], &[0.0], Vec::new()), Err(Error::Length { .. })));
    assert!(matches!(
        run(&input).with_initial_state(vec![false; 2], &[0.0, f64::NAN], Vec::new()),
        Err(Error::NotFinite { .. })
    ));
    assert!(matches!(
        run(&input).with_initial_state(vec![false; 2], &[0.0; 2], vec![vec![0.0; 3]]),
        Err(Error::Length { .. })
    ));
}

#[test]
fn sensor_transient_affects_its_output_alone() {
    let (m, step) = (120, 0.05);
    let lag = Filter { numerator: vec![(4.0, 0.0)], denominator: vec![(1.0, 2.0), (3.0, 1.0), (4.0, 0.0)] }
        .series(m, step)
        .unwrap();
    let run = record(step, vec![vec![0.0; m], vec![0.0; m]]).with_filter(&lag).unwrap();
    let model = equation(0, 1.4, &[(0, 0.6, -1.0), (0, 0.0, -5.0), (1, 0.0, 1.0)]);
    let answers: Vec<Vec<f64>> = (1..=2).map(|k| vec![f64::from(k); m]).collect();
    let held = run.clone().with_initial_state(vec![true, false], &[0.0; 2], answers.clone()).unwrap();
    let units = [(0, -1.0), (0, -2.0), (0, 0.4)];
    let (_, found) = respond_and_units(one(&model), &held, &units).unwrap();
    let (_, moved) = respond_and_units(one(&model), &run, &units).unwrap();
    assert_eq!(found[0][0], answers[0]);
    assert_eq!(found[1][0], answers[1]);
    // Of others, and of outputs that pass the filter later, it is a motion of the equation.
    assert!(distance(&found[2][0], &moved[2][0]) < 1e-12);
    assert!(distance(&moved[0][0], &run.initial_term(-1.0)) > 1e-3);
    let together = respond(one(&model), &held, &[vec![(-1.0, 0.5), (-2.0, -0.25), (0.4, 2.0)]]).unwrap();
    let sum: Vec<f64> = (0..m).map(|k| 0.5 * found[0][0][k] - 0.25 * found[1][0][k] + 2.0 * found[2][0][k]).collect();
    assert!(distance(&together[0], &sum) < 1e-10);
}
