//! Samples at nonuniform times from pulse means, with the corners that jumps of held signals leave.

use ftlm::error::Error;
use ftlm::fractional::kernels::block_pulse_kernel;
use ftlm::series;
use ftlm::signal::block_pulse::SampleInterpolation;
use proptest::prelude::*;

use crate::common::{cases, check, Random};

/// Mean of a cubic over [k, k + 1].
fn mean_of(c: &[f64; 4], k: usize) -> f64 {
    let integral = |x: f64| c.iter().enumerate().map(|(n, c)| c * x.powi(n as i32 + 1) / (n + 1) as f64).sum::<f64>();
    integral((k + 1) as f64) - integral(k as f64)
}

proptest! {
    #![proptest_config(cases(40))]

    #[test]
    fn cubic_is_interpolated_exactly(seed in 0u64..1_000_000, m in 4usize..30) {
        let mut random = Random::new(seed);
        let c = [random.normal(), random.normal(), 0.1 * random.normal(), 0.01 * random.normal()];
        let means: Vec<f64> = (0..m).map(|k| mean_of(&c, k)).collect();
        let places: Vec<f64> = (0..=20).map(|i| m as f64 * f64::from(i) / 20.0).collect();
        let read = SampleInterpolation::new(places.clone(), m).unwrap().interpolate(&means);
        for (place, value) in places.iter().zip(read) {
            let exact: f64 = c.iter().enumerate().map(|(n, c)| c * place.powi(n as i32)).sum();
            prop_assert!((value - exact).abs() < 1e-9 * (1.0 + exact.abs()), "{place}: {value} for {exact}");
        }
    }
}

/// I^η of jumps at places of their own, read near and far from them, beside the definition.
#[test]
fn kinks_match_the_definition() {
    let (m, step) = (60, 0.05);
    let (at, sizes) = ([0.0, 3.3, 9.0, 9.9], [1.0, -2.0, 0.5, 1.5]);
    let places: Vec<f64> = (0..150).map(|i| 0.1 * f64::from(i)).collect();
    let interpolation = SampleInterpolation::new(places.clone(), m).unwrap();
    let ramp = |x: f64, p: f64| (x - p).max(0.0);
    let held = |x: f64| at.iter().zip(&sizes).map(|(p, s)| s * ramp(x, *p)).sum::<f64>();
    let means: Vec<f64> = (0..m).map(|k| held((k + 1) as f64) - held(k as f64)).collect();
    for eta in [0.0, 0.3, 0.8, 1.0, 1.7] {
        let response = series::multiply(&block_pulse_kernel(eta, m, step), &means, m);
        let lacking = interpolation.kink_corrections(&interpolation.jumps(&at, &sizes), eta, step);
        let found: Vec<f64> = interpolation.interpolate(&response).iter().zip(&lacking).map(|(y, c)| y + c).collect();
        let scale = libm::pow(step, eta) / libm::tgamma(eta + 1.0);
        // A held signal is read after it has jumped.
        let one = |x: f64, p: f64| if x < p { 0.0 } else { libm::pow(x - p, eta) };
        let exact = |x: f64| at.iter().zip(&sizes).map(|(p, s)| s * scale * one(x, *p)).sum::<f64>();
        let worst = places.iter().zip(&found).map(|(p, y)| (y - exact(*p)).abs()).fold(0.0, f64::max);
        check(&format!("I^{eta} of jumps"), worst, 1e-12);
    }
}

#[test]
fn impossible_readings_are_rejected() {
    assert!(matches!(SampleInterpolation::new(vec![1.0], 3), Err(Error::Length { .. })));
    assert!(matches!(SampleInterpolation::new(vec![f64::NAN], 9), Err(Error::NotFinite { .. })));
    for place in [-0.1, 9.1] {
        assert!(matches!(SampleInterpolation::new(vec![place], 9), Err(Error::OutOfRange { .. })));
    }
    let none = SampleInterpolation::new(vec![], 9).unwrap();
    assert!(none.is_empty() && none.interpolate(&[0.0; 9]).is_empty());
    assert_eq!(SampleInterpolation::new(vec![0.0, 9.0], 9).unwrap().len(), 2);
}
