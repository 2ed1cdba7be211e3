//! Truncated power series: products and quotients against the naive oracles, coupled systems against dense blocks,
//! and the algebra they must obey.

use ftlm::error::Error;
use ftlm::fft;
use ftlm::fractional::kernels::{block_pulse_kernel, power_means};
use ftlm::series::{
    self, Buffers, Division, Kernel, RunningSumSystem, Solver, Source, SumOfProducts, BLOCK_TERMS, MAX_SUMS,
};
use proptest::prelude::*;

use crate::common::{
    bits, cases, check, check_between, dense_solve, distance, largest, norm, orders, relative_error, toeplitz, Random,
};

/// Lengths on both sides of the block, of its doublings and of the switch to transforms, and every small one.
fn lengths() -> impl Iterator<Item = usize> {
    (1..=200)
        .chain([255, 256, 257, 511, 512, 513, 640, 1000, 1023, 1024, 1025, 1536, 2047, 2048, 2049, 3000, 4096, 4097])
}

/// max|a − b| against the largest |b| so far, block by block: a growing quotient is judged where it is, not by its end.
fn block_distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let (mut worst, mut size) = (0.0_f64, f64::MIN_POSITIVE);
    for (a, b) in a.chunks(BLOCK_TERMS).zip(b.chunks(BLOCK_TERMS)) {
        size = size.max(largest(b));
        worst = worst.max(distance(a, b) / size);
    }
    worst
}

/// The divisor 1 − Σ c F^η of an equation.
fn divisor(terms: &[(f64, f64)], m: usize, step: f64) -> Vec<f64> {
    let mut d = vec![0.0; m];
    d[0] = 1.0;
    for &(c, eta) in terms {
        d.iter_mut().zip(block_pulse_kernel(eta, m, step)).for_each(|(d, v)| *d -= c * v);
    }
    d
}

#[test]
fn product_is_the_naive_product() {
    let mut random = Random::new(1);
    let mut worst = 0.0_f64;
    for m in lengths() {
        let (a, b) = (random.signal(m), random.signal(m));
        let error = distance(&series::multiply(&a, &b, m), &series::multiply_naive(&a, &b, m));
        worst = worst.max(error / (norm(&a) * norm(&b)));
    }
    check("error of products of equal length", worst, 2e-15);
}

#[test]
fn product_of_unequal_lengths() {
    let mut random = Random::new(2);
    for (a, b, m) in [
        (0, 5, 4),
        (5, 0, 4),
        (1, 300, 300),
        (300, 1, 200),
        (70, 900, 900),
        (900, 70, 500),
        (65, 66, 5000),
        (300, 200, 400),
        (100, 100, 0),
        (1000, 3000, 2048),
        (3000, 1000, 4096),
    ] {
        let (x, y) = (random.signal(a), random.signal(b));
        let (fast, naive) = (series::multiply(&x, &y, m), series::multiply_naive(&x, &y, m));
        assert_eq!(fast.len(), m);
        assert!(distance(&fast, &naive) <= 2e-15 * (norm(&x) * norm(&y)).max(1.0), "{a} times {b} to {m}");
    }
}

#[test]
fn products_of_whole_numbers_are_exact() {
    // Below the switch to transforms nothing is rounded.
    assert_eq!(series::multiply(&[1.0, 2.0, 3.0], &[4.0, 5.0, 6.0], 3), [4.0, 13.0, 28.0]);
    assert_eq!(series::multiply(&[1.0, 2.0, 3.0], &[4.0, 5.0, 6.0], 6), [4.0, 13.0, 28.0, 27.0, 18.0, 0.0]);
}

#[test]
fn quotient_is_the_naive_quotient() {
    let mut random = Random::new(3);
    let mut worst = 0.0_f64;
    for m in lengths() {
        let n = random.signal(m);
        // Stable: a damped oscillation and a relaxation.
        for terms in [vec![(-4.0, 1.8), (-0.5, 0.9)], vec![(-2.0, 0.5)]] {
            let d = divisor(&terms, m, 0.01);
            worst = worst.max(block_distance(&series::divide(&n, &d).unwrap(), &series::divide_naive(&n, &d).unwrap()));
        }
        // A leading coefficient other than one, and a random decaying tail.
        let mut d: Vec<f64> = (0..m).map(|k| random.uniform(-1.0, 1.0) * 0.5 / (1.0 + k as f64).powi(2)).collect();
        d[0] = -3.0;
        worst = worst.max(block_distance(&series::divide(&n, &d).unwrap(), &series::divide_naive(&n, &d).unwrap()));
    }
    check("error of quotients by stable divisors", worst, 1e-13);
}

#[test]
fn quotient_by_unstable_divisors_is_the_naive_quotient() {
    let mut random = Random::new(4);
    let mut worst = 0.0_f64;
    for m in [63, 64, 65, 128, 129, 500, 1000, 2047, 2048, 2049, 4097] {
        let n = random.signal(m);
        // Growth by 1e30 to 1e300 over the longest record, slow and fast, oscillating and not.
        for terms in
            [vec![(100.0, 2.0)], vec![(-900.0, 2.4), (1.0, 0.3)], vec![(60.0, 1.8), (-3.0, 0.4)], vec![(7.0, 0.6)]]
        {
            let d = divisor(&terms, m, 0.004);
            let (fast, naive) = (series::divide(&n, &d).unwrap(), series::divide_naive(&n, &d).unwrap());
            assert!(naive.iter().all(|v| v.is_finite()));
            worst = worst.max(block_distance(&fast, &naive));
        }
        for growth in [1.001, 1.02, -1.1, -1.17] {
            let mut d: Vec<f64> = (0..m).map(|k| 1e-3 * random.uniform(-1.0, 1.0) / (1.0 + k as f64)).collect();
            d[0] = 1.0;
            if m > 1 {
                d[1] = -growth;
            }
            let (fast, naive) = (series::divide(&n, &d).unwrap(), series::divide_naive(&n, &d).unwrap());
            worst = worst.max(block_distance(&fast, &naive));
        }
    }
    check("error of quotients by unstable divisors", worst, 5e-12);
}

#[test]
fn overflowing_quotients_are_exact_before_overflow() {
    let m = 2048;
    let d = divisor(&[(1e5, 2.0)], m, 0.004);
    let n = power_means(0.0, m, 0.004);
    let (fast, naive) = (series::divide(&n, &d).unwrap(), series::divide_naive(&n, &d).unwrap());
    let end = naive.iter().position(|v| !v.is_finite()).unwrap() / BLOCK_TERMS * BLOCK_TERMS;
    assert!(end > 3 * BLOCK_TERMS && !fast[m - 1].is_finite());
    check("error before the overflow", block_distance(&fast[..end], &naive[..end]), 5e-12);
}

#[test]
fn divisor_times_quotient_is_the_numerator() {
    let mut random = Random::new(5);
    let mut worst = 0.0_f64;
    for m in lengths() {
        let n = random.signal(m);
        for terms in [vec![(-4.0, 1.8), (-0.5, 0.9)], vec![(30.0, 2.0)], vec![(3.0, 0.7)]] {
            let d = divisor(&terms, m, 0.01);
            let q = series::divide(&n, &d).unwrap();
            let back = series::multiply_naive(&d, &q, m);
            worst = worst.max(distance(&back, &n) / (norm(&d) * norm(&q)));
        }
    }
    check("residual of division", worst, 1e-14);
}

#[test]
fn divisor_with_leading_zero_is_rejected() {
    for d in [[0.0, 1.0, 2.0], [f64::NAN, 1.0, 2.0], [f64::INFINITY, 1.0, 2.0]] {
        for divided in [series::divide(&[1.0, 2.0, 3.0], &d), series::divide_naive(&[1.0, 2.0, 3.0], &d)] {
            match divided {
                Err(Error::LeadingZero { leading }) => assert_eq!(leading.to_bits(), d[0].to_bits()),
                other => panic!("{other:?}"),
            }
        }
    }
    let message = series::divide(&[1.0], &[0.0]).unwrap_err().to_string();
    assert!(message.contains("leading coefficient of a divisor series is 0e0"), "{message}");
}

#[test]
fn empty_division_is_empty() {
    assert_eq!(series::divide(&[], &[1.0]), Ok(vec![]));
    assert!(matches!(series::divide(&[], &[]), Err(Error::LeadingZero { .. })));
    assert!(matches!(series::divide_naive(&[], &[]), Err(Error::LeadingZero { .. })));
    let none: [Vec<Vec<f64>>; 0] = [];
    assert_eq!(series::solve(&none, &[]), Ok(vec![]));
}

#[test]
fn mismatched_lengths_are_rejected() {
    let one = vec![1.0, 0.5, 0.25];
    let length = |e| matches!(e, Err(Error::Length { .. }));
    assert!(length(series::divide(&[1.0; 4], &one).map(|_| ())));
    assert!(length(series::solve(&[vec![one.clone()], vec![one.clone()]], &[&one]).map(|_| ())));
    assert!(length(series::solve(&[vec![one.clone(), one.clone()]], &[&one]).map(|_| ())));
    let square = vec![vec![one.clone(), one.clone()], vec![one.clone(), vec![1.0]]];
    assert!(length(series::solve(&square, &[&one, &one]).map(|_| ())));
    let square = vec![vec![one.clone(), vec![0.0; 3]], vec![vec![0.0; 3], one.clone()]];
    assert!(length(series::solve(&square, &[&one, &one[..2]]).map(|_| ())));
    // A divisor longer than the numerator is read as far as it matters.
    assert_eq!(series::divide(&[2.0, 4.0], &[2.0, 0.0, 9.0]), Ok(vec![1.0, 2.0]));
}

#[test]
fn coupled_systems_match_dense_blocks() {
    let mut random = Random::new(6);
    let mut worst = 0.0_f64;
    for n in 1..=4 {
        for m in [1, 2, 3, 7, 63, 64, 65, 100, 129, 200] {
            let matrix: Vec<Vec<Vec<f64>>> = (0..n)
                .map(|i| {
                    (0..n)
                        .map(|j| {
                            let mut s: Vec<f64> =
                                (0..m).map(|k| random.uniform(-1.0, 1.0) / (1.0 + k as f64).powi(2)).collect();
                            s[0] = if i == j { 2.0 } else { random.uniform(-0.5, 0.5) };
                            s
                        })
                        .collect()
                })
                .collect();
            let rhs: Vec<Vec<f64>> = (0..n).map(|_| random.signal(m)).collect();
            let mut dense = vec![0.0; n * m * n * m];
            for i in 0..n {
                for j in 0..n {
                    let block = toeplitz(&matrix[i][j]);
                    for r in 0..m {
                        dense[(i * m + r) * n * m + j * m..][..m].copy_from_slice(&block[r * m..(r + 1) * m]);
                    }
                }
            }
            let oracle = dense_solve(&dense, &rhs.concat());
            let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
            let found = series::solve(&matrix, &borrowed).unwrap().concat();
            worst = worst.max(distance(&found, &oracle) / largest(&oracle));
        }
    }
    check("error of coupled systems against dense blocks", worst, 1e-12);
}

#[test]
fn long_coupled_systems_satisfy_their_equations() {
    // Too long for dense blocks: two angles coupled as in a stage, the residual taken by naive products.
    let mut random = Random::new(7);
    for m in [1000, 2049, 4097] {
        let h = 0.002;
        let kernel = |c: f64, eta: f64| -> Vec<f64> { block_pulse_kernel(eta, m, h).iter().map(|v| c * v).collect() };
        let matrix = vec![
            vec![divisor(&[(-60.0, 1.05)], m, h), kernel(-600.0, 2.0)],
            vec![kernel(-60.0, 0.95), divisor(&[(-800.0, 1.9), (-9.0, 1.15)], m, h)],
        ];
        let rhs = [random.steps(m, 100), random.signal(m)];
        let y = series::solve(&matrix, &[&rhs[0], &rhs[1]]).unwrap();
        for i in 0..2 {
            let (a, b) =
                (series::multiply_naive(&matrix[i][0], &y[0], m), series::multiply_naive(&matrix[i][1], &y[1], m));
            let sum: Vec<f64> = a.iter().zip(&b).map(|(a, b)| a + b).collect();
            let size = norm(&matrix[i][0]) * norm(&y[0]) + norm(&matrix[i][1]) * norm(&y[1]);
            check("residual of a coupled system", distance(&sum, &rhs[i]) / size, 1e-14);
        }
    }
}

#[test]
fn uncoupled_systems_are_divisions() {
    let mut random = Random::new(8);
    for m in [5, 64, 300, 2049] {
        let d = [divisor(&[(-3.0, 1.5)], m, 0.02), divisor(&[(2.0, 0.7)], m, 0.02)];
        let rhs = [random.signal(m), random.signal(m)];
        let zero = vec![0.0; m];
        let one = series::solve(&[vec![&d[0]]], &[&rhs[0]]).unwrap();
        assert_eq!(bits(&one[0]), bits(&series::divide(&rhs[0], &d[0]).unwrap()));
        let both = series::solve(&[vec![&d[0], &zero], vec![&zero, &d[1]]], &[&rhs[0], &rhs[1]]).unwrap();
        for i in 0..2 {
            let alone = series::divide(&rhs[i], &d[i]).unwrap();
            assert!(block_distance(&both[i], &alone) < 1e-13);
        }
    }
}

#[test]
fn solver_agrees_with_a_new_solution() {
    let mut random = Random::new(12);
    for m in [1, 64, 65, 300, 2049] {
        let matrix = vec![
            vec![divisor(&[(-3.0, 1.5)], m, 0.02), block_pulse_kernel(0.8, m, 0.02)],
            vec![block_pulse_kernel(1.1, m, 0.02), divisor(&[(-2.0, 0.7)], m, 0.02)],
        ];
        let mut solver = Solver::new(&matrix).unwrap();
        for _ in 0..3 {
            let rhs = vec![random.signal(m), random.signal(m)];
            let (found, anew) = (solver.solve(&rhs).unwrap(), series::solve(&matrix, &[&rhs[0], &rhs[1]]).unwrap());
            for (a, b) in found.iter().zip(&anew) {
                assert_eq!(bits(a), bits(b));
            }
        }
        assert!(matches!(solver.solve(&[vec![0.0; m]]), Err(Error::Length { .. })));
        assert!(matches!(solver.solve(&[vec![0.0; m], vec![0.0; m + 1]]), Err(Error::Length { .. })));
    }
    let refused = |matrix: &[Vec<Vec<f64>>]| Solver::new(matrix).err().unwrap();
    assert_eq!(refused(&[vec![vec![0.0, 1.0]]]), Error::LeadingZero { leading: 0.0 });
    assert_eq!(refused(&[vec![vec![]]]), Error::LeadingZero { leading: 0.0 });
    assert!(matches!(refused(&[vec![vec![1.0], vec![1.0]]]), Error::Length { .. }));
    assert!(matches!(refused(&[vec![vec![1.0], vec![1.0]], vec![vec![1.0], vec![]]]), Error::Length { .. }));
}

#[test]
fn sum_of_products_matches_separate_products() {
    let mut random = Random::new(13);
    let mut buffers = Buffers::default();
    // Long and short in turn: the buffers are shared.
    for m in [1, 700, 64, 2048] {
        let mut sum = SumOfProducts::new(m);
        for terms in [3, 1, 0] {
            let (mut oracle, mut size) = (vec![0.0; m], 0.0);
            for _ in 0..terms {
                let (a, b, weight) = (random.signal(m), random.signal(m), random.uniform(-3.0, 3.0));
                sum.add(weight, &Kernel::new(&a), &Kernel::new(&b));
                oracle.iter_mut().zip(series::multiply_naive(&a, &b, m)).for_each(|(o, v)| *o += weight * v);
                size += weight.abs() * norm(&a) * norm(&b);
            }
            // Taken, it is empty for the next sum.
            let mut found = vec![f64::NAN; m];
            sum.take(&mut found, &mut buffers);
            assert!(distance(&found, &oracle) <= 2e-15 * size);
        }
    }
}

#[test]
fn a_singular_leading_matrix_is_refused() {
    let s = |c: f64| vec![c, 1.0, -1.0];
    let b = s(1.0);
    let found = series::solve(&[vec![s(1.0), s(2.0)], vec![s(2.0), s(4.0)]], &[&b, &b]);
    assert_eq!(found, Err(Error::LeadingZero { leading: 0.0 }));
    // Zeros on the diagonal alone are no obstacle: the unknowns change places.
    let found = series::solve(&[vec![s(0.0), s(1.0)], vec![s(1.0), s(0.0)]], &[&b, &b]).unwrap();
    assert_eq!(found[0][0], 1.0);
}

#[test]
fn kernel_can_be_applied_repeatedly() {
    let mut random = Random::new(9);
    let mut buffers = Buffers::default();
    let kernels: Vec<(Vec<f64>, Kernel)> = [700, 64, 2048, 1]
        .into_iter()
        .map(|m| {
            let series = random.signal(m);
            let kernel = Kernel::new(&series);
            (series, kernel)
        })
        .collect();
    for _ in 0..3 {
        for (series, kernel) in &kernels {
            for length in [series.len(), series.len().div_ceil(2), 1] {
                let signal = random.signal(length);
                let mut shared = vec![f64::NAN; length];
                kernel.apply(&signal, &mut shared, &mut buffers);
                let mut alone = vec![f64::NAN; length];
                kernel.apply(&signal, &mut alone, &mut Buffers::default());
                assert_eq!(bits(&shared), bits(&alone));
                let oracle = series::multiply_naive(series, &signal, length);
                assert!(distance(&shared, &oracle) <= 2e-15 * norm(series) * norm(&signal));
            }
        }
    }
}

#[test]
fn blockwise_division_gives_the_quotient() {
    let mut random = Random::new(10);
    for m in [1, 64, 100, 1000, 2049] {
        let mut division = Division::new(1, m);
        // The second pass reuses the memory of the first.
        for pass in 0..2 {
            division.reset();
            let (n, d) = (random.signal(m), divisor(&[(-5.0, 1.7), (1.0, 0.6)], m, 0.01));
            let whole = series::divide(&n, &d).unwrap();
            assert_eq!((division.terms(), division.solved_terms()), (m, 0));
            let inverse = [1.0 / d[0]];
            if pass == 0 {
                division.add(0, 0, &n);
            }
            while division.solved_terms() < m {
                let (start, reads) = (division.solved_terms(), division.required_terms());
                let end = (start + BLOCK_TERMS).min(m);
                let series = |_: usize, _: usize, len: usize| {
                    assert!(len <= reads, "{len} terms read, {reads} announced");
                    &d[..len]
                };
                if pass == 0 {
                    division.advance(&inverse, series);
                } else {
                    // The numerator as late as it is needed, each block read before its effect on the rest is known.
                    division.add(0, start, &n[start..end]);
                    division.solve_block(&inverse, series);
                    assert!(distance(division.quotient(0), &whole[..end]) <= 1e-13 * largest(&whole[..end]));
                    division.subtract_contributions(series);
                }
                assert_eq!(division.solved_terms(), end);
            }
            if pass == 0 {
                assert_eq!(bits(division.quotient(0)), bits(&whole));
            }
        }
        assert_eq!(division.into_quotients()[0].len(), m);
    }
}

#[test]
fn integrals_compose_with_second_order() {
    // I^a I^b f against I^(a+b) f, f = t exp(-t): the product of two pulse approximations is not the approximation of
    // the product, and their distance shrinks as the error of either does.
    for (a, b) in [(0.5, 0.5), (0.3, 0.9), (1.2, 0.8), (0.15, 1.85)] {
        let errors: Vec<f64> = [256, 512, 1024, 2048]
            .into_iter()
            .map(|m| {
                let h = 4.0 / m as f64;
                let antiderivative = |t: f64| -(1.0 + t) * (-t).exp();
                let f: Vec<f64> =
                    (0..m).map(|k| (antiderivative((k + 1) as f64 * h) - antiderivative(k as f64 * h)) / h).collect();
                let inner = series::multiply(&block_pulse_kernel(b, m, h), &f, m);
                let twice = series::multiply(&block_pulse_kernel(a, m, h), &inner, m);
                let once = series::multiply(&block_pulse_kernel(a + b, m, h), &f, m);
                distance(&twice, &once)
            })
            .collect();
        let found = orders(&errors);
        check_between(&format!("order of I^{a} I^{b} - I^{}", a + b), found[2], 1.9, 2.1);
        check("distance at 2048", errors[3], 5e-7);
    }
}

#[test]
fn transform_lengths_are_fast_and_even() {
    for n in 0..3000 {
        let len = fft::fast_length(n);
        assert!(len >= n.max(2) && len.is_multiple_of(2) && len <= 2 * n.max(2));
        let mut rest = len;
        for p in [2, 3, 5] {
            while rest.is_multiple_of(p) {
                rest /= p;
            }
        }
        assert_eq!(rest, 1);
    }
    assert_eq!(fft::fast_length(4096), 4096);
    let plan = fft::plan(10);
    assert_eq!((plan.len(), plan.bins(), plan.is_empty()), (10, 6, false));
}

#[test]
fn transforms_return_the_signal() {
    let mut random = Random::new(11);
    let mut workspace = fft::Workspace::new();
    for len in [2, 6, 30, 128, 5000] {
        let plan = fft::plan(len);
        let signal = random.signal(len);
        let mut time = signal.clone();
        let mut spectrum = vec![fft::Bin::new(0.0, 0.0); plan.bins()];
        plan.transform(&mut time, &mut spectrum, &mut workspace);
        assert!((spectrum[0].re - signal.iter().sum::<f64>()).abs() < 1e-13 * norm(&signal) * (len as f64).sqrt());
        plan.inverse(&mut spectrum, &mut time, &mut workspace);
        assert!(distance(&time, &signal) < 1e-15 * norm(&signal));
    }
}

fn signal(lengths: std::ops::Range<usize>) -> impl Strategy<Value = Vec<f64>> {
    prop::collection::vec(-1.0..1.0_f64, lengths)
}

proptest! {
    #![proptest_config(cases(48))]

    #[test]
    fn products_commute_and_associate(a in signal(1..400), b in signal(1..400), c in signal(1..400), m in 1usize..600) {
        let size = norm(&a) * norm(&b);
        prop_assert!(distance(&series::multiply(&a, &b, m), &series::multiply(&b, &a, m)) <= 2e-15 * size);
        let left = series::multiply(&series::multiply(&a, &b, m), &c, m);
        let right = series::multiply(&a, &series::multiply(&b, &c, m), m);
        let size = a.iter().map(|v| v.abs()).sum::<f64>() * norm(&b) * norm(&c);
        prop_assert!(distance(&left, &right) <= 1e-14 * size);
    }

    #[test]
    fn operators_are_linear(f in signal(300..301), g in signal(300..301), x in -3.0..3.0_f64, eta in 0.0..3.0_f64) {
        let kernel = block_pulse_kernel(eta, 300, 0.01);
        let mixed: Vec<f64> = f.iter().zip(&g).map(|(f, g)| x * f + g).collect();
        let (a, b) = (series::multiply(&kernel, &f, 300), series::multiply(&kernel, &g, 300));
        let sum: Vec<f64> = a.iter().zip(&b).map(|(a, b)| x * a + b).collect();
        prop_assert!(distance(&series::multiply(&kernel, &mixed, 300), &sum) <= 1e-14 * norm(&kernel) * norm(&mixed).max(1.0));
        let d = divisor(&[(-8.0, eta.max(0.1)), (0.5, 0.4)], 300, 0.01);
        let (a, b) = (series::divide(&f, &d).unwrap(), series::divide(&g, &d).unwrap());
        let sum: Vec<f64> = a.iter().zip(&b).map(|(a, b)| x * a + b).collect();
        prop_assert!(distance(&series::divide(&mixed, &d).unwrap(), &sum) <= 1e-12 * largest(&sum).max(1.0));
    }

    #[test]
    fn delayed_input_gives_a_delayed_output(f in signal(500..501), late in 0usize..500, eta in 0.05..3.0_f64, c in -50.0..5.0_f64) {
        let m = f.len();
        let shifted: Vec<f64> = std::iter::repeat_n(0.0, late).chain(f.iter().copied()).take(m).collect();
        let kernel = block_pulse_kernel(eta, m, 0.01);
        let (now, then) = (series::multiply(&kernel, &f, m), series::multiply(&kernel, &shifted, m));
        prop_assert!(distance(&then[late..], &now[..m - late]) <= 1e-14 * norm(&kernel) * norm(&f));
        // Not even rounding may arrive before the input, up to the size of what is to come.
        prop_assert!(largest(&then[..late]) <= 2e-15 * norm(&kernel) * norm(&f));
        let d = divisor(&[(c, eta)], m, 0.01);
        let (now, then) = (series::divide(&f, &d).unwrap(), series::divide(&shifted, &d).unwrap());
        prop_assert!(distance(&then[late..], &now[..m - late]) <= 1e-12 * largest(&now));
        prop_assert!(then[..late].iter().all(|&v| v == 0.0));
    }

    #[test]
    fn the_unit_of_time_does_not_matter(f in signal(400..401), step in 1e-3..10.0_f64, eta in 0.1..3.0_f64, c in -5.0..0.5_f64) {
        let m = f.len();
        let unit = divisor(&[(c, eta)], m, 1.0);
        let scaled = divisor(&[(c / step.powf(eta), eta)], m, step);
        let (a, b) = (series::divide(&f, &unit).unwrap(), series::divide(&f, &scaled).unwrap());
        prop_assert!(block_distance(&a, &b) <= 1e-10);
    }
}

/// Equation, unknown, whole order of the integral, coefficient.
type Integral = (usize, usize, usize, f64);

/// The same system by kernels and division.
fn solve_by_division(n: usize, m: usize, step: f64, terms: &[Integral], sources: &[Source]) -> Vec<Vec<f64>> {
    let mut matrix = vec![vec![vec![0.0; m]; n]; n];
    (0..n).for_each(|i| matrix[i][i][0] = 1.0);
    for &(i, j, order, c) in terms {
        let kernel = block_pulse_kernel(order as f64, m, step);
        matrix[i][j].iter_mut().zip(kernel).for_each(|(a, v)| *a -= c * v);
    }
    let mut rhs = vec![vec![0.0; m]; n];
    for source in sources {
        let driven = series::multiply_naive(&block_pulse_kernel(source.order as f64, m, step), source.series, m);
        rhs[source.equation].iter_mut().zip(driven).for_each(|(b, v)| *b += source.weight * v);
    }
    series::solve(&matrix, &rhs.iter().map(Vec::as_slice).collect::<Vec<_>>()).unwrap()
}

#[test]
fn integrals_of_whole_order_by_running_sums() {
    let (m, step) = (700, 0.004);
    let mut pulse = vec![0.0; m];
    pulse[0] = 1.0;
    let mut worst = 0.0_f64;
    for order in 0..=MAX_SUMS {
        let source = Source { equation: 0, order, weight: 1.0, series: &pulse };
        let found = RunningSumSystem::new(1, order, step, &[]).unwrap().solve(m, &[vec![source]]).unwrap();
        worst = worst.max(relative_error(&found[0][0], &block_pulse_kernel(order as f64, m, step)));
    }
    check("kernels by running sums", worst, 1e-11);
}

#[test]
fn systems_of_whole_order_by_running_sums_are_those_by_division() {
    let mut random = Random::new(11);
    let (m, step) = (1500, 0.01);
    let signals: Vec<Vec<f64>> = (0..3).map(|_| random.signal(m)).collect();
    let source = |equation, order, weight, k: usize| Source { equation, order, weight, series: &signals[k] };
    let cases: Vec<(usize, usize, Vec<Integral>, Vec<Source>)> = vec![
        (1, 0, vec![], vec![source(0, 0, 2.0, 0)]),
        (1, 1, vec![(0, 0, 1, -3.0)], vec![source(0, 1, 2.0, 0), source(0, 0, 0.5, 1)]),
        (1, 2, vec![(0, 0, 1, -0.4), (0, 0, 2, -90.0)], vec![source(0, 2, 5.0, 0), source(0, 0, -1.0, 1)]),
        // It grows.
        (1, 2, vec![(0, 0, 1, 0.3), (0, 0, 2, 9.0)], vec![source(0, 1, 5.0, 2)]),
        // A source integrated more often than the output.
        (1, 3, vec![(0, 0, 1, -2.0)], vec![source(0, 3, 1.0, 0)]),
        (
            1,
            4,
            vec![(0, 0, 1, -2.0), (0, 0, 2, -80.0), (0, 0, 3, -60.0), (0, 0, 4, -700.0)],
            vec![source(0, 4, 9.0, 1)],
        ),
        (1, 5, vec![(0, 0, 2, -50.0), (0, 0, 1, -4.0)], vec![source(0, 5, 1.0, 1)]),
        (
            3,
            2,
            vec![(0, 0, 2, -40.0), (0, 1, 0, 0.3), (1, 1, 1, -2.0), (1, 0, 2, 5.0), (2, 1, 1, 3.0), (2, 2, 1, -1.0)],
            vec![source(0, 2, 1.0, 0), source(1, 0, 1.0, 1), source(2, 1, -2.0, 2)],
        ),
    ];
    let mut worst = 0.0_f64;
    for (n, sums, terms, sources) in cases {
        // More lists than go side by side, one of them empty.
        let twice = sources.iter().map(|s| Source { weight: 2.0 * s.weight, ..*s }).collect();
        let lists = [sources.clone(), Vec::new(), twice, sources.clone(), sources.clone(), sources.clone()];
        let found = RunningSumSystem::new(n, sums, step, &terms).unwrap().solve(m, &lists).unwrap();
        assert_eq!(found.len(), lists.len());
        assert!(found[1].iter().flatten().all(|v| *v == 0.0) && found[5] == found[0]);
        assert!(found[2].iter().flatten().zip(found[0].iter().flatten()).all(|(a, b)| *a == 2.0 * b));
        for (a, b) in found[0].iter().zip(solve_by_division(n, m, step, &terms, &sources)) {
            worst = worst.max(block_distance(a, &b));
        }
    }
    check("running sums against division", worst, 1e-10);
}

#[test]
fn invalid_running_sums_are_rejected() {
    assert!(matches!(RunningSumSystem::new(1, 1, 0.1, &[(0, 0, 2, 1.0)]), Err(Error::Structure { .. })));
    assert!(matches!(RunningSumSystem::new(1, MAX_SUMS + 1, 0.1, &[]), Err(Error::Structure { .. })));
    // 1 − c·h/2 = 0.
    assert!(matches!(RunningSumSystem::new(1, 1, 0.5, &[(0, 0, 1, 4.0)]), Err(Error::LeadingZero { .. })));
    let short = Source { equation: 0, order: 0, weight: 1.0, series: &[1.0] };
    assert!(matches!(
        RunningSumSystem::new(1, 0, 0.5, &[]).unwrap().solve(2, &[vec![short]]),
        Err(Error::Length { .. })
    ));
}
