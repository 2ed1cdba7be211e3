//! From samples to pulse means: exact integration under both inter-sample behaviours, delays, and back to samples.

use ftlm::error::Error;
use ftlm::signal::block_pulse::{delay_samples, point_samples, pulse_means, Intersample};
use proptest::prelude::*;

use crate::common::{cases, check, check_between, distance, orders, Random};

/// Means by adding, pulse by pulse, what every interval contributes. O(N m).
fn naive_means(samples: &[f64], m: usize, intersample: Intersample) -> Vec<f64> {
    let n = samples.len() - 1;
    // In units of the sampling step pulse k is [k n/m, (k+1) n/m).
    let width = n as f64 / m as f64;
    (0..m)
        .map(|k| {
            let (lo, hi) = (k as f64 * width, (k + 1) as f64 * width);
            let mut integral = 0.0;
            for j in 0..n {
                let (a, b) = (lo.max(j as f64), hi.min((j + 1) as f64));
                if b > a {
                    let value = match intersample {
                        Intersample::Hold => samples[j],
                        // A straight line has its mean in the middle.
                        Intersample::Linear => {
                            let x = 0.5 * (a + b) - j as f64;
                            samples[j] * (1.0 - x) + samples[j + 1] * x
                        }
                    };
                    integral += value * (b - a);
                }
            }
            integral / width
        })
        .collect()
}

const BOTH: [Intersample; 2] = [Intersample::Hold, Intersample::Linear];

#[test]
fn means_match_naive_integration() {
    let mut random = Random::new(30);
    let mut worst = 0.0_f64;
    for n in [2, 3, 5, 10, 64, 101] {
        let samples = random.signal(n);
        for m in [1, 2, 3, 7, 10, 50, 63, 64, 100, 101, 200, 997] {
            for intersample in BOTH {
                let found = pulse_means(&samples, m, intersample).unwrap().into_vec();
                assert_eq!(found.len(), m);
                worst = worst.max(distance(&found, &naive_means(&samples, m, intersample)));
            }
        }
    }
    check("means against naive integration", worst, 1e-12);
}

#[test]
fn pulse_means_on_the_sample_grid_are_samples_or_midpoints() {
    let mut random = Random::new(31);
    let samples = random.signal(500);
    assert_eq!(pulse_means(&samples, 499, Intersample::Hold).unwrap().values(), &samples[..499]);
    let midpoints: Vec<f64> = samples.windows(2).map(|p| 0.5 * (p[0] + p[1])).collect();
    assert!(distance(pulse_means(&samples, 499, Intersample::Linear).unwrap().values(), &midpoints) < 1e-15);
}

#[test]
fn refinement_preserves_the_signal() {
    let mut random = Random::new(32);
    let samples = random.signal(60);
    for times in [1, 2, 3, 8] {
        let fine = pulse_means(&samples, 59 * times, Intersample::Hold).unwrap().into_vec();
        let repeated: Vec<f64> = (0..59 * times).map(|k| samples[k / times]).collect();
        assert!(distance(&fine, &repeated) < 1e-14);
        let fine = pulse_means(&samples, 59 * times, Intersample::Linear).unwrap().into_vec();
        let at: Vec<f64> = (0..59 * times)
            .map(|k| {
                let x = ((k % times) as f64 + 0.5) / times as f64;
                samples[k / times] * (1.0 - x) + samples[k / times + 1] * x
            })
            .collect();
        assert!(distance(&fine, &at) < 1e-14);
    }
}

#[test]
fn too_few_samples_are_rejected() {
    for intersample in BOTH {
        for samples in [&[][..], &[1.0]] {
            let refused = Error::Length { name: "samples".into(), expected: 2, found: samples.len() };
            assert_eq!(pulse_means(samples, 4, intersample), Err(refused));
        }
        assert!(matches!(pulse_means(&[1.0, 2.0], 0, intersample), Err(Error::OutOfRange { .. })));
    }
}

#[test]
fn delays_move_samples() {
    let u = [1.0, 2.0, 4.0, 8.0];
    assert_eq!(delay_samples(&u, 0.0, 9.0).unwrap(), u);
    assert_eq!(delay_samples(&u, 1.0, 9.0).unwrap(), [9.0, 1.0, 2.0, 4.0]);
    assert_eq!(delay_samples(&u, 3.0, 0.0).unwrap(), [0.0, 0.0, 0.0, 1.0]);
    assert_eq!(delay_samples(&u, 1.25, 0.0).unwrap(), [0.0, 0.75, 1.75, 3.5]);
    assert_eq!(delay_samples(&u, 0.5, 1.0).unwrap(), [1.0, 1.5, 3.0, 6.0]);
    assert_eq!(delay_samples(&u, 1e300, -1.0).unwrap(), [-1.0; 4]);
    assert_eq!(delay_samples(&[], 2.0, 0.0).unwrap(), [0.0; 0]);
    // Logged after it acts: the last sample stays.
    assert_eq!(delay_samples(&u, -1.0, 9.0).unwrap(), [2.0, 4.0, 8.0, 8.0]);
    assert_eq!(delay_samples(&u, -0.5, 9.0).unwrap(), [1.5, 3.0, 6.0, 8.0]);
    assert_eq!(delay_samples(&u, -1e300, 9.0).unwrap(), [8.0; 4]);
    for delay in [f64::NAN, f64::INFINITY] {
        assert!(matches!(delay_samples(&u, delay, 0.0), Err(Error::NotFinite { .. })));
    }
}

#[test]
fn delayed_command_has_the_means_of_the_delayed_hold() {
    // The hold sampled a thousand times finer and shifted there, against the mix of two neighbours.
    let mut random = Random::new(33);
    let u = random.signal(40);
    let fine = 1000_usize;
    for delay in [0.25, 1.0, 2.5, 7.125] {
        let late = pulse_means(&delay_samples(&u, delay, 0.5).unwrap(), 39, Intersample::Hold).unwrap().into_vec();
        let shift = (delay * fine as f64) as usize;
        let oracle: Vec<f64> = (0..39)
            .map(|k| {
                (k * fine..(k + 1) * fine).map(|i| i.checked_sub(shift).map_or(0.5, |i| u[i / fine])).sum::<f64>()
                    / fine as f64
            })
            .collect();
        assert!(distance(&late, &oracle) < 1e-12, "delay {delay}");
    }
}

#[test]
fn point_samples_converge_with_second_order() {
    let errors: Vec<f64> = [100, 200, 400]
        .into_iter()
        .map(|m| {
            let h = 3.0 / m as f64;
            let means: Vec<f64> = (0..m).map(|k| ((k as f64 + 0.5) * h).cos() * (0.5 * h).sin() / (0.5 * h)).collect();
            let exact: Vec<f64> = (0..=m).map(|j| (j as f64 * h).cos()).collect();
            distance(&point_samples(&means), &exact)
        })
        .collect();
    check_between("order of point samples, ends included", orders(&errors)[1], 1.95, 2.05);
    // Straight lines come back exactly, ends included.
    assert_eq!(point_samples(&[0.5, 1.5, 2.5]), [0.0, 1.0, 2.0, 3.0]);
    assert_eq!(point_samples(&[4.0]), [4.0, 4.0]);
    assert_eq!(point_samples(&[]), [0.0]);
}

proptest! {
    #![proptest_config(cases(128))]

    #[test]
    fn integral_is_preserved(n in 2usize..200, m in 1usize..400, seed in any::<u64>()) {
        let samples = Random::new(seed).signal(n);
        let intervals = (n - 1) as f64;
        let hold: f64 = samples[..n - 1].iter().sum();
        let line: f64 = samples.windows(2).map(|p| 0.5 * (p[0] + p[1])).sum();
        for (intersample, exact) in [(Intersample::Hold, hold), (Intersample::Linear, line)] {
            let total = pulse_means(&samples, m, intersample).unwrap().values().iter().sum::<f64>() * intervals / m as f64;
            prop_assert!((total - exact).abs() < 1e-12 * intervals);
        }
    }

    #[test]
    fn means_of_means_are_means(n in 2usize..60, m in 1usize..40, times in 2usize..6, seed in any::<u64>()) {
        let samples = Random::new(seed).signal(n);
        for intersample in BOTH {
            let coarse = pulse_means(&samples, m, intersample).unwrap().into_vec();
            let fine = pulse_means(&samples, m * times, intersample).unwrap().into_vec();
            let joined: Vec<f64> = fine.chunks(times).map(|c| c.iter().sum::<f64>() / times as f64).collect();
            prop_assert!(distance(&joined, &coarse) < 1e-12);
        }
    }

    #[test]
    fn constants_and_bounds_are_kept(value in -5.0..5.0_f64, n in 2usize..60, m in 1usize..200, seed in any::<u64>()) {
        let samples = Random::new(seed).signal(n);
        for intersample in BOTH {
            let constant = pulse_means(&vec![value; n], m, intersample).unwrap().into_vec();
            prop_assert!(constant.iter().all(|v| (v - value).abs() < 1e-12 * value.abs().max(1.0)));
            prop_assert!(pulse_means(&samples, m, intersample).unwrap().values().iter().all(|v| v.abs() <= 1.0 + 1e-12));
        }
    }
}
