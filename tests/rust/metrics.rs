//! The four figures of a response, and the errors that computations name.

use ftlm::error::{check_finite, check_length, check_step, Error, Kind};
use ftlm::signal::metrics::{correlation, covariances, covariances_naive, metrics};

#[test]
fn metrics_of_a_small_case() {
    let found = metrics(&[1.0, 3.0, 1.0, 3.0], &[0.5, -0.5, 0.5, -0.5]).unwrap();
    assert_eq!((found.error, found.rmse, found.nr, found.fit_percent), (2.0, 0.5, 0.5, 50.0));
    let perfect = metrics(&[1.0, 2.0], &[0.0, 0.0]).unwrap();
    assert_eq!((perfect.error, perfect.nr, perfect.fit_percent), (0.0, 0.0, 100.0));
    // The mean of the measurement, as a response, explains nothing: a fit of zero.
    assert_eq!(metrics(&[1.0, 3.0], &[-1.0, 1.0]).unwrap().fit_percent, 0.0);
}

#[test]
fn diverged_response_has_no_finite_metrics() {
    for bad in [f64::NAN, f64::INFINITY, 1e200] {
        let found = metrics(&[1.0, 2.0, 3.0], &[0.0, bad, 0.0]).unwrap();
        assert!(found.rmse.is_infinite() && found.nr.is_infinite(), "{bad}: {found:?}");
        assert_eq!(found.fit_percent, f64::NEG_INFINITY);
        assert_eq!(found.error.is_infinite(), !bad.is_finite());
    }
}

#[test]
fn checks_report_the_found_values() {
    assert_eq!(check_finite("u", &[1.0, 2.0]), Ok(()));
    let refused = Error::NotFinite { name: "u".into(), index: 1, count: 2 };
    assert_eq!(check_finite("u", &[1.0, f64::NAN, 2.0, f64::NEG_INFINITY]), Err(refused.clone()));
    assert_eq!(
        refused.to_string(),
        "u is not finite at index 1 (2 such values in all); remove or replace these samples"
    );
    assert_eq!(check_length("u", 3, 3), Ok(()));
    assert_eq!(check_length("u", 3, 4), Err(Error::Length { name: "u".into(), expected: 3, found: 4 }));
    assert_eq!(check_step(0.1), Ok(()));
    for step in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(matches!(check_step(step), Err(Error::OutOfRange { .. })));
    }
}

#[test]
fn every_error_has_its_kind() {
    let families = [
        (Error::NotFinite { name: "u".into(), index: 0, count: 1 }, Kind::Data),
        (Error::Length { name: "u".into(), expected: 1, found: 2 }, Kind::Data),
        (Error::Singular { index: 0, count: 1 }, Kind::Convergence),
        (Error::Diverged { what: "response".into(), index: 3 }, Kind::Convergence),
        (Error::Interrupted, Kind::Interrupted),
        (Error::Internal { what: "x".into() }, Kind::Internal),
        (Error::LeadingZero { leading: 0.0 }, Kind::Model),
        (Error::EmptyOrderGrid { reason: "x".into() }, Kind::Model),
        (Error::OrderGridTooLarge { count: 2, limit: 1 }, Kind::Model),
        (Error::NotPowerOfTwo { m: 3, below: 2, above: 4 }, Kind::Model),
        (Error::Structure { what: "x".into(), remedy: "y".into() }, Kind::Model),
    ];
    for (error, kind) in families {
        assert_eq!(error.kind(), kind, "{error}");
    }
}

/// White numbers, uniform over (−1/2, 1/2), by splitmix64.
fn white_noise(n: usize, seed: u64) -> Vec<f64> {
    let mut state = seed.wrapping_mul(0xD1B5_4A32_D192_ED03);
    (0..n)
        .map(|_| {
            state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            #[allow(clippy::cast_precision_loss)]
            let unit = ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64;
            unit - 0.5
        })
        .collect()
}

#[test]
fn covariances_by_spectra_match_the_definition() {
    for (n, lags) in [(1, 0), (2, 1), (7, 3), (100, 25), (1025, 64), (3000, 2999)] {
        let (x, y) = (white_noise(n, 1), white_noise(n, 2));
        let (fast, naive) = (covariances(&x, &y, lags), covariances_naive(&x, &y, lags));
        assert_eq!(fast.len(), 2 * lags + 1);
        for (a, b) in fast.iter().zip(&naive) {
            assert!((a - b).abs() <= 1e-13 * (n as f64), "{n} {lags}: {a} {b}");
        }
    }
    // The sign of a lag: x follows y by two samples.
    let y = white_noise(50, 3);
    let mut x = vec![0.0; 50];
    x[2..].copy_from_slice(&y[..48]);
    let found = covariances(&x, &y, 4);
    let largest = (0..9).max_by(|&a, &b| found[a].total_cmp(&found[b]));
    assert_eq!(largest, Some(4 + 2));
}

#[test]
fn metrics_without_samples_are_rejected() {
    assert_eq!(metrics(&[], &[]), Err(Error::Length { name: "measured".into(), expected: 1, found: 0 }));
    assert_eq!(metrics(&[1.0], &[]), Err(Error::Length { name: "residuals".into(), expected: 1, found: 0 }));
}

#[test]
fn correlations_of_independent_signals_have_the_stated_variance() {
    let filtered = |x: &[f64], pole: f64| {
        let mut last = 0.0;
        x.iter()
            .map(|v| {
                last = pole * last + v;
                last
            })
            .collect::<Vec<f64>>()
    };
    for (pole_x, pole_y) in [(0.0, 0.0), (0.0, 0.95), (0.9, 0.0), (0.9, 0.95)] {
        let (mut squares, mut stated) = (0.0, 0.0);
        let repeats = 400;
        for seed in 0..repeats {
            let x = filtered(&white_noise(1000, 2 * seed + 11), pole_x);
            let y = filtered(&white_noise(1000, 2 * seed + 12), pole_y);
            let found = correlation(&[x], &[y], 0).expect("lengths agree");
            squares += found.values[0] * found.values[0];
            stated += found.variance;
        }
        let ratio = squares / stated;
        assert!((0.8..1.25).contains(&ratio), "poles {pole_x} {pole_y}: {ratio}");
    }
}

#[test]
fn the_variance_never_falls_below_that_of_white_noise() {
    // Two swings in opposite phase of their correlations: the sum of Bartlett's products is negative.
    let wave = |omega: f64| (0..2000).map(|k| (omega * f64::from(k)).sin()).collect::<Vec<f64>>();
    for (a, b) in [(0.05, 0.08), (0.01, 0.03), (0.3, 0.31)] {
        let found = correlation(&[wave(a)], &[wave(b)], 25).expect("lengths agree");
        assert!(found.variance >= 1.0 / 2000.0, "{a} {b}: {}", found.variance);
    }
}

#[test]
fn correlations_are_pooled_over_runs_and_normalised() {
    let (a, b) = (white_noise(300, 5), white_noise(200, 6));
    let shifted: Vec<f64> = b.iter().map(|v| 10.0 + v).collect();
    let found = correlation(&[a.clone(), shifted.clone()], &[a.clone(), shifted], 3).expect("lengths agree");
    assert!((found.values[3] - 1.0).abs() < 1e-12);
    assert!(found.values[4].abs() < 0.2, "the mean of each run is its own");
    let still = correlation(&[vec![1.0; 9]], &[vec![2.0; 9]], 2).expect("lengths agree");
    assert!(still.values.iter().all(|v| *v == 0.0));
    assert!(matches!(correlation(std::slice::from_ref(&a), &[b], 3), Err(Error::Length { .. })));
    assert!(matches!(correlation(std::slice::from_ref(&a), &[a.clone(), a.clone()], 3), Err(Error::Length { .. })));
    assert!(matches!(correlation(&[vec![0.0; 3]], &[vec![0.0; 3]], 3), Err(Error::OutOfRange { .. })));
}
