//! Kernels of I^η and of ∂/∂η, the digamma function, Grünwald–Letnikov weights and means of powers, against mpmath.

use ftlm::fractional::kernels::{
    block_pulse_kernel, block_pulse_kernel_derivative, digamma, grunwald_letnikov_weights, power_means,
    power_means_slope, second_difference,
};
use ftlm::series;
use proptest::prelude::*;

use crate::common::{cases, check, counts, distance, list, number, numbers, reference, relative_error};

#[test]
fn second_difference_is_exact_at_every_reference() {
    let (mut worst, mut worst_slope) = (0.0_f64, 0.0_f64);
    for record in list(&reference("block_pulse_kernel")["records"]) {
        let eta = number(&record["eta"]);
        let found: Vec<(f64, f64)> = counts(&record["n"]).iter().map(|&n| second_difference(eta, n)).collect();
        let (v, dv): (Vec<f64>, Vec<f64>) = found.into_iter().unzip();
        worst = worst.max(relative_error(&v, &numbers(&record["v"])));
        worst_slope = worst_slope.max(relative_error(&dv, &numbers(&record["dv"])));
    }
    check("relative error of v_n", worst, 1e-14);
    check("relative error of dv_n/deta", worst_slope, 1e-14);
}

#[test]
fn whole_kernel_is_exact_at_every_reference() {
    let step = 0.004;
    let (mut worst, mut worst_slope) = (0.0_f64, 0.0_f64);
    for record in list(&reference("block_pulse_kernel")["records"]) {
        let eta = number(&record["eta"]);
        let n = counts(&record["n"]);
        let kernel = block_pulse_kernel(eta, 1 << 20, step);
        let slope = block_pulse_kernel_derivative(eta, 1 << 20, step);
        assert_eq!((kernel.len(), slope.len()), (1 << 20, 1 << 20));
        let scale = step.powf(eta) / number(&record["gamma"]);
        let inner = step.ln() - number(&record["digamma"]);
        for ((&n, v), dv) in n.iter().zip(numbers(&record["v"])).zip(numbers(&record["dv"])) {
            worst = worst.max((kernel[n - 1] / (scale * v) - 1.0).abs());
            // The two parts of the derivative have opposite signs and may cancel.
            let size = scale * (v * inner).abs().max(dv.abs());
            worst_slope = worst_slope.max((slope[n - 1] - scale * (v * inner + dv)).abs() / size);
        }
    }
    check("relative error of the kernel", worst, 1e-14);
    check("error of its derivative, relative to the larger part", worst_slope, 1e-14);
}

#[test]
fn kernels_of_whole_orders() {
    assert_eq!(block_pulse_kernel(0.0, 5, 0.1), [1.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(block_pulse_kernel(1.0, 4, 0.5), [0.25, 0.5, 0.5, 0.5]);
    let second: Vec<f64> = [1.0, 6.0, 12.0, 18.0].iter().map(|v| 0.25 * v / 6.0).collect();
    check("kernel of order 2", relative_error(&block_pulse_kernel(2.0, 4, 0.5), &second), 1e-15);
    assert!(block_pulse_kernel(0.7, 0, 1.0).is_empty());
    assert_eq!(second_difference(0.7, 0), (0.0, 0.0));
}

#[test]
fn digamma_matches_references() {
    let document = reference("digamma");
    let psi = numbers(&document["psi"]);
    let found: Vec<f64> = numbers(&document["x"]).into_iter().map(digamma).collect();
    check("absolute error of digamma", distance(&found, &psi), 1e-14);
}

#[test]
fn grunwald_letnikov_weights_match_references() {
    let mut worst = 0.0_f64;
    for record in list(&reference("grunwald_letnikov")["records"]) {
        let alpha = number(&record["alpha"]);
        let j = counts(&record["j"]);
        let weights = grunwald_letnikov_weights(alpha, j[j.len() - 1] + 1);
        let picked: Vec<f64> = j.iter().map(|&j| weights[j]).collect();
        worst = worst.max(relative_error(&picked, &numbers(&record["w"])));
    }
    check("relative error of the Grünwald-Letnikov weights", worst, 1e-13);
}

#[test]
fn power_means_do_not_depend_on_the_number_of_pulses() {
    // Short records take powers one by one, long ones from a sieve.
    let mut worst = 0.0_f64;
    for exponent in [-0.95, -0.4, 0.0, 0.3, 0.999, 1.0, 1.7, 2.0, 3.2, 6.5] {
        let (m, step) = (6000, 0.01);
        let found = power_means(exponent, m, step);
        assert_eq!(found.len(), m);
        let a = exponent + 1.0;
        for (k, v) in found.iter().enumerate().skip(1) {
            let k = (k + 1) as f64;
            let truth = -step.powf(exponent) / a * k.powf(a) * (a * (-1.0 / k).ln_1p()).exp_m1();
            worst = worst.max((v / truth - 1.0).abs());
        }
    }
    check("means of powers", worst, 2e-14);
}

#[test]
fn power_mean_slopes_match_differences() {
    let mut worst = 0.0_f64;
    for (m, step) in [(200, 0.3), (6000, 0.01)] {
        for exponent in [-0.95, -0.5, 0.0, 0.4, 1.0, 2.3, 6.5] {
            let found = power_means_slope(exponent, m, step);
            assert_eq!(found.len(), m);
            // Five points of a smooth function: what they leave out is of the fourth order.
            let at = |shift: f64| power_means(exponent + shift, m, step);
            let (h, middle) = (1e-3, at(0.0));
            let sides = [at(-2.0 * h), at(-h), at(h), at(2.0 * h)];
            for (k, v) in found.iter().enumerate() {
                let [a, b, c, d] = [sides[0][k], sides[1][k], sides[2][k], sides[3][k]];
                let truth = (a - 8.0 * b + 8.0 * c - d) / (12.0 * h);
                // Where t is about 1 the slope passes through 0.
                worst = worst.max((v - truth).abs() / (truth.abs() + middle[k]));
            }
        }
    }
    check("slopes of means of powers", worst, 1e-6);
}

#[test]
fn power_means_of_whole_exponents() {
    let step = 0.125;
    let m = 1 << 20;
    let k = |i: usize| (i + 1) as f64;
    let exact: [Vec<f64>; 4] = [
        vec![1.0; m],
        (0..m).map(|i| step * (k(i) - 0.5)).collect(),
        (0..m).map(|i| step * step * (k(i) * (k(i) - 1.0) + 1.0 / 3.0)).collect(),
        (0..m).map(|i| step.powi(3) * (k(i) - 0.5) * (k(i) * (k(i) - 1.0) + 0.5)).collect(),
    ];
    for (exponent, exact) in (0..4).zip(exact) {
        let found = power_means(f64::from(exponent), m, step);
        check(&format!("relative error of the means of t^{exponent}"), relative_error(&found, &exact), 1e-14);
    }
}

proptest! {
    #![proptest_config(cases(64))]

    #[test]
    fn kernel_sums_to_the_integral_of_one(eta in 0.001..10.0_f64, m in 1usize..3000, step in 1e-4..2.0_f64) {
        // The sum of v_1 ... v_n telescopes to n^(eta+1) - (n-1)^(eta+1), which is what the means of t^eta are.
        let mut sum = 0.0;
        let gamma = libm::tgamma(eta + 1.0);
        for (v, mean) in block_pulse_kernel(eta, m, step).iter().zip(power_means(eta, m, step)) {
            sum += v;
            prop_assert!((sum * gamma / mean - 1.0).abs() < 1e-12);
            prop_assert!(*v > 0.0);
        }
    }

    #[test]
    fn kernel_scales_with_time(eta in 0.0..10.0_f64, step in 1e-4..10.0_f64) {
        let unit = block_pulse_kernel(eta, 300, 1.0);
        let scaled: Vec<f64> = unit.iter().map(|v| v * step.powf(eta)).collect();
        prop_assert!(relative_error(&block_pulse_kernel(eta, 300, step), &scaled) < 1e-14);
    }

    #[test]
    fn kernel_derivative_is_a_slope(eta in 0.1..2.9_f64, step in 0.01..1.0_f64) {
        let d = 1e-5;
        let (low, high) = (block_pulse_kernel(eta - d, 400, step), block_pulse_kernel(eta + d, 400, step));
        let slope: Vec<f64> = high.iter().zip(&low).map(|(h, l)| (h - l) / (2.0 * d)).collect();
        let found = block_pulse_kernel_derivative(eta, 400, step);
        let scale = found.iter().chain(&low).fold(0.0, |a: f64, v| a.max(v.abs()));
        prop_assert!(distance(&found, &slope) < 1e-7 * scale);
    }

    #[test]
    fn digamma_recurs(x in 0.01..30.0_f64) {
        prop_assert!((digamma(x + 1.0) - digamma(x) - 1.0 / x).abs() <= 1e-14 * (1.0 / x).max(4.0));
    }

    #[test]
    fn grunwald_letnikov_orders_add(a in -2.0..2.0_f64, b in -2.0..2.0_f64) {
        // The weights are the coefficients of (1 - z)^a.
        let m = 400;
        let (left, right) = (grunwald_letnikov_weights(a, m), grunwald_letnikov_weights(b, m));
        let product = series::multiply_naive(&left, &right, m);
        let bound = series::multiply_naive(
            &left.iter().map(|v| v.abs()).collect::<Vec<_>>(),
            &right.iter().map(|v| v.abs()).collect::<Vec<_>>(),
            m,
        );
        for ((p, w), size) in product.iter().zip(grunwald_letnikov_weights(a + b, m)).zip(bound) {
            prop_assert!((p - w).abs() < 1e-12 * size);
        }
    }

    #[test]
    fn power_means_add_up_to_the_integral(exponent in -0.9..4.0_f64, m in 1usize..5000, step in 1e-3..2.0_f64) {
        let total = step * power_means(exponent, m, step).iter().sum::<f64>();
        let exact = (m as f64 * step).powf(exponent + 1.0) / (exponent + 1.0);
        prop_assert!((total / exact - 1.0).abs() < 1e-12);
    }
}
