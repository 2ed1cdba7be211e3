//! Haar coordinates and operational matrices: orthogonality, and the fast paths against the dense ones.

use ftlm::error::Error;
use ftlm::fractional::kernels::block_pulse_kernel;
use ftlm::fractional::operational_matrices;
use ftlm::linalg::dense;
use ftlm::parallel::{pool, Stop};
use ftlm::series;
use proptest::prelude::*;

use crate::common::{cases, check, distance, largest, norm, toeplitz, Random};

#[test]
fn the_haar_matrix_is_orthogonal() {
    for m in [1, 2, 4, 8, 64, 256, 512] {
        let phi = operational_matrices::haar_matrix(m).unwrap();
        let mut worst = 0.0_f64;
        for i in 0..m {
            for j in 0..=i {
                let product: f64 = (0..m).map(|k| phi[i * m + k] * phi[j * m + k]).sum();
                worst = worst.max((product - f64::from(u8::from(i == j))).abs());
            }
        }
        check(&format!("Haar matrix of {m} times its transpose"), worst, 1e-14);
    }
}

#[test]
fn haar_matrix_of_four_matches_the_paper() {
    let r = 0.5_f64.sqrt();
    let printed = [0.5, 0.5, 0.5, 0.5, 0.5, 0.5, -0.5, -0.5, r, -r, 0.0, 0.0, 0.0, 0.0, r, -r];
    assert!(distance(&operational_matrices::haar_matrix(4).unwrap(), &printed) < 1e-15);
    assert_eq!(operational_matrices::haar_matrix(1).unwrap(), [1.0]);
}

#[test]
fn the_fast_transform_is_the_matrix() {
    let mut random = Random::new(20);
    for m in [1, 2, 4, 16, 128, 1024] {
        let phi = operational_matrices::haar_matrix(m).unwrap();
        let f = random.signal(m);
        let mut fast = f.clone();
        operational_matrices::haar_transform(&mut fast).unwrap();
        assert!(distance(&fast, &dense::multiply(&phi, &f, m, m, 1)) < 1e-14 * norm(&f));
        let mut back = fast.clone();
        operational_matrices::haar_inverse(&mut back).unwrap();
        assert!(distance(&back, &dense::multiply(&fast, &phi, 1, m, m)) < 1e-14 * norm(&f));
        assert!(distance(&back, &f) < 1e-14 * norm(&f));
    }
}

#[test]
fn lengths_that_are_no_power_of_two_are_reported_with_neighbors() {
    for (m, below, above) in [(12, 8, 16), (2047, 1024, 2048), (2049, 2048, 4096), (3, 2, 4)] {
        let error = Error::NotPowerOfTwo { m, below, above };
        let mut x = vec![1.0; m];
        assert_eq!(operational_matrices::haar_transform(&mut x), Err(error.clone()));
        assert_eq!(operational_matrices::haar_inverse(&mut x), Err(error.clone()));
        assert!(x.iter().all(|&v| v == 1.0), "a refused signal is left as it was");
        assert_eq!(operational_matrices::haar_matrix(m), Err(error.clone()));
        assert_eq!(operational_matrices::operational_matrix(0.5, m, 0.1), Err(error.clone()));
        assert_eq!(operational_matrices::operational_matrix_dense(0.5, m, 0.1), Err(error));
    }
    let message = operational_matrices::check_power_of_two(12).unwrap_err().to_string();
    assert_eq!(
        message,
        "Haar coordinates need m to be a power of two, not 12; take m = 8 or 16, or block-pulse (time) coordinates"
    );
    // Nothing has no neighbours to be named.
    assert!(matches!(operational_matrices::check_power_of_two(0), Err(Error::Length { expected: 1, found: 0, .. })));
    assert!(operational_matrices::haar_transform(&mut []).is_err());
}

#[test]
fn the_matrix_of_block_pulses_is_the_kernel() {
    let mut random = Random::new(21);
    let (m, step) = (100, 0.05);
    for eta in [0.0, 0.4, 1.0, 1.7, 3.0] {
        let f = operational_matrices::block_pulse_matrix(eta, m, step).unwrap();
        let transposed = toeplitz(&block_pulse_kernel(eta, m, step));
        let mut worst = 0.0_f64;
        for i in 0..m {
            for j in 0..m {
                worst = worst.max((f[i * m + j] - transposed[j * m + i]).abs());
            }
        }
        assert_eq!(worst, 0.0);
        // Row vectors of coefficients from the left: the convolution with the kernel.
        let x = random.signal(m);
        let integral = series::multiply_naive(&block_pulse_kernel(eta, m, step), &x, m);
        assert!(distance(&dense::multiply(&x, &f, 1, m, m), &integral) < 1e-14 * norm(&integral).max(1.0));
    }
}

#[test]
fn the_fast_operational_matrix_is_the_dense_one() {
    let mut worst = 0.0_f64;
    for m in [1, 2, 4, 32, 64, 256, 512] {
        for eta in [0.0, 0.15, 0.5, 1.0, 1.85, 2.2, 3.0] {
            let fast = operational_matrices::operational_matrix(eta, m, 1.0 / m as f64).unwrap();
            let dense = operational_matrices::operational_matrix_dense(eta, m, 1.0 / m as f64).unwrap();
            worst = worst.max(distance(&fast, &dense) / largest(&dense));
        }
    }
    check("fast against dense operational matrix", worst, 1e-13);
}

#[test]
fn the_operational_matrix_integrates_haar_coefficients() {
    // P of order 1 over unit time as the literature prints it, for two wavelets.
    let printed = [0.5, -0.25, 0.25, 0.0];
    assert!(distance(&operational_matrices::operational_matrix(1.0, 2, 0.5).unwrap(), &printed) < 1e-15);
    let mut random = Random::new(22);
    let (m, step, eta) = (256, 0.02, 0.85);
    let f = random.signal(m);
    let mut coefficients = f.clone();
    operational_matrices::haar_transform(&mut coefficients).unwrap();
    let p = operational_matrices::operational_matrix(eta, m, step).unwrap();
    let by_matrix = dense::multiply(&coefficients, &p, 1, m, m);
    let mut by_series = series::multiply(&block_pulse_kernel(eta, m, step), &f, m);
    operational_matrices::haar_transform(&mut by_series).unwrap();
    check("P on coefficients against F on means", distance(&by_matrix, &by_series) / largest(&by_series), 1e-13);
}

#[test]
fn operational_matrices_reject_invalid_arguments() {
    for (eta, step) in [(-0.1, 0.1), (10.1, 0.1), (f64::NAN, 0.1), (0.5, 0.0), (0.5, -1.0), (0.5, f64::INFINITY)] {
        for made in [
            operational_matrices::block_pulse_matrix(eta, 8, step),
            operational_matrices::operational_matrix(eta, 8, step),
            operational_matrices::operational_matrix_dense(eta, 8, step),
        ] {
            assert!(matches!(made, Err(Error::OutOfRange { .. })), "eta {eta}, step {step}");
        }
    }
}

#[test]
fn dense_products_match_sums() {
    let mut random = Random::new(23);
    for (a, b, c) in [(1, 1, 1), (3, 5, 2), (40, 7, 30), (17, 64, 65)] {
        let (left, right) = (random.signal(a * b), random.signal(b * c));
        let product = dense::multiply(&left, &right, a, b, c);
        for i in 0..a {
            for j in 0..c {
                let sum: f64 = (0..b).map(|k| left[i * b + k] * right[k * c + j]).sum();
                assert!((product[i * c + j] - sum).abs() < 1e-14 * b as f64);
            }
        }
    }
}

#[test]
fn gram_matrices_and_triangular_factors() {
    let mut random = Random::new(24);
    for (k, m) in [(1, 5), (4, 100), (6, 6), (5, 3), (131, 20), (3, 40_000)] {
        let columns: Vec<Vec<f64>> = (0..k).map(|_| random.signal(m)).collect();
        let borrowed: Vec<&[f64]> = columns.iter().map(Vec::as_slice).collect();
        let (target, others) = columns.split_last().unwrap();
        let gram = dense::gram(&others.concat(), target, &Stop::default());
        let three = pool(3).unwrap();
        assert_eq!(three.install(|| dense::gram(&others.concat(), target, &Stop::default())), gram);
        let told = Stop::default();
        told.set();
        assert!(dense::gram(&others.concat(), target, &told).iter().all(|v| *v == 0.0));
        assert!(dense::inner_products(&borrowed, &borrowed, &told).iter().all(|v| *v == 0.0));
        let products = dense::inner_products(&borrowed, &borrowed[..2.min(k)], &Stop::default());
        assert_eq!(
            three.install(|| dense::inner_products(&borrowed, &borrowed[..2.min(k)], &Stop::default())),
            products
        );
        let r = dense::triangular_factor(&columns);
        for i in 0..k {
            for j in 0..k {
                let sum: f64 = columns[i].iter().zip(&columns[j]).map(|(x, y)| x * y).sum();
                assert!((gram[i * k + j] - sum).abs() < 1e-13 * m as f64);
                assert_eq!(gram[i * k + j].to_bits(), gram[j * k + i].to_bits());
                assert!(j > 1 || (products[i * 2.min(k) + j] - sum).abs() < 1e-13 * m as f64);
                // RᵀR is the Gram matrix whatever the signs in R.
                let square: f64 = (0..k).map(|l| r[l * k + i] * r[l * k + j]).sum();
                assert!((square - sum).abs() < 1e-13 * m as f64);
                assert!(i <= j || r[i * k + j] == 0.0);
            }
        }
    }
}

#[test]
fn singular_values_make_up_the_columns() {
    let mut random = Random::new(26);
    for (k, m) in [(1, 1), (3, 2), (4, 300), (9, 9), (13, 2300)] {
        let columns: Vec<Vec<f64>> = (0..k).map(|_| random.signal(m)).collect();
        let found = dense::singular_values(&columns).unwrap();
        let count = k.min(m);
        assert_eq!((found.left.len(), found.values.len(), found.right.len()), (count, count, count));
        assert!(found.values.windows(2).all(|pair| pair[0] >= pair[1]));
        for (j, column) in columns.iter().enumerate() {
            for (i, value) in column.iter().enumerate() {
                let sum: f64 = (0..count).map(|l| found.left[l][i] * found.values[l] * found.right[l][j]).sum();
                assert!((sum - value).abs() < 1e-13 * found.values[0]);
            }
        }
        let inner = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        for a in 0..count {
            for b in 0..count {
                let unit = f64::from(u8::from(a == b));
                assert!((inner(&found.left[a], &found.left[b]) - unit).abs() < 1e-13);
                assert!((inner(&found.right[a], &found.right[b]) - unit).abs() < 1e-13);
            }
        }
    }
}

#[test]
fn triangular_factors_of_any_size() {
    let mut random = Random::new(25);
    let columns: Vec<Vec<f64>> = (0..4).map(|_| random.signal(1500)).collect();
    let plain = dense::triangular_factor(&columns);
    // Where squares leave the numbers, norms are scaled.
    for size in [1e-170, 1e160] {
        let scaled: Vec<Vec<f64>> = columns.iter().map(|c| c.iter().map(|v| v * size).collect()).collect();
        for (r, truth) in dense::triangular_factor(&scaled).iter().zip(&plain) {
            assert!((r.abs() / size - truth.abs()).abs() < 1e-12 * plain[0].abs());
        }
    }
    // Columns of nothing, and one that stands there twice.
    let zero = vec![0.0; 1500];
    let r = dense::triangular_factor(&[zero.clone(), columns[0].clone(), columns[0].clone(), zero]);
    let size = plain[0].abs();
    assert_eq!((r[0], r[15]), (0.0, 0.0));
    assert!((r[5].hypot(r[1]) / size - 1.0).abs() < 1e-13 && r[10].abs() < 1e-12 * size);
}

proptest! {
    #![proptest_config(cases(64))]

    #[test]
    fn the_transform_keeps_products(level in 0u32..11, seed in any::<u64>()) {
        let m = 1usize << level;
        let mut random = Random::new(seed);
        let (mut f, mut g) = (random.signal(m), random.signal(m));
        let before: f64 = f.iter().zip(&g).map(|(a, b)| a * b).sum();
        let size = norm(&f) * norm(&g);
        operational_matrices::haar_transform(&mut f).unwrap();
        operational_matrices::haar_transform(&mut g).unwrap();
        let after: f64 = f.iter().zip(&g).map(|(a, b)| a * b).sum();
        prop_assert!((after - before).abs() <= 1e-14 * size);
    }
}
