//! The rig's guard under a million random commands, and the arm's bounded memory.

use ftlm::fractional::exponential_sum::{decay, Rates};
use ftlm::rig::safety_guard::{Fault, Guard, GuardSettings};
use ftlm::rig::virtual_arm::Reading;

use crate::common::Random;

fn settings() -> GuardSettings {
    GuardSettings {
        step: 0.002,
        strain_scale: [0.013636, 0.018694],
        sense_scale: 2.0,
        command_scale: 0.5,
        encoder_scale: [1.53398e-5, 3.06796e-5],
        current_limit: [0.94, 1.2],
        slew: [50.0, 80.0],
        continuous: [0.658, 0.84],
        thermal_time: 1.0,
        deflection_limit: [0.0873, 0.1309],
        saturation: 9.99,
        moving_current: 0.25,
        standstill: 0.5,
        fastest: 20.0,
        late_limit: 0.05,
        missed_limit: 20,
        filter: None,
    }
}

#[test]
fn a_million_commands_stay_within_the_limits() {
    let s = settings();
    let mut guard = Guard::new(s.clone()).unwrap();
    let mut random = Random::new(7);
    let (mut before, mut heat) = ([0.0_f64; 2], [0.0_f64; 2]);
    let share = s.step / s.thermal_time;
    let mut largest = 0.0_f64;
    let mut held = [0.0; 2];
    for k in 0..1_000_000 {
        // Commands of any size, often held for a while so that the heat limit is reached.
        if k % 97 == 0 || random.chance(0.3) {
            held = std::array::from_fn(|_| random.uniform(-1.0, 1.0) * 10f64.powf(random.uniform(-2.0, 6.0)));
        }
        let volts = guard.command(held);
        for j in 0..2 {
            let current = -0.5 * volts[j];
            assert!(volts[j].is_finite() && current.abs() <= s.current_limit[j]);
            let relief = before[j] * current >= 0.0 && current.abs() < before[j].abs();
            assert!(relief || (current - before[j]).abs() <= s.slew[j] * s.step * (1.0 + 1e-12));
            heat[j] += share * (current * current - heat[j]);
            assert!(heat[j] <= s.continuous[j].powi(2) * (1.0 + 1e-12));
            before[j] = current;
            largest = largest.max(current.abs());
        }
    }
    assert!(largest > 1.1, "the commands never came near the limits");
}

#[test]
fn a_command_that_is_not_finite_latches_zero() {
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        let mut guard = Guard::new(settings()).unwrap();
        assert_ne!(guard.command([0.05, 0.05]), [0.0; 2]);
        assert_eq!(guard.command([0.05, bad]), [0.0; 2]);
        assert!(matches!(guard.fault(), Some(Fault::Command { joint: 2, .. })));
        assert_eq!(guard.command([0.05, 0.05]), [0.0; 2]);
    }
}

#[test]
fn first_fault_is_latched() {
    let mut guard = Guard::new(settings()).unwrap();
    let mut reading = Reading { switches: [1; 4], ..Reading::default() };
    guard.rest(&reading);
    assert!(guard.fault().is_none());
    reading.analog[0] = f64::NAN;
    guard.read(&reading, 0.0);
    reading.switches[2] = 0;
    guard.read(&reading, 0.0);
    assert!(matches!(guard.fault(), Some(Fault::Saturated { joint: 1, .. })));
}

#[test]
fn invalid_settings_are_rejected() {
    for change in [
        |s: &mut GuardSettings| s.step = 0.0,
        |s: &mut GuardSettings| s.slew[1] = f64::NAN,
        |s: &mut GuardSettings| {
            s.current_limit[0] = -1.0;
        },
    ] {
        let mut s = settings();
        change(&mut s);
        assert!(Guard::new(s).is_err());
    }
}

#[test]
fn exponentials_sum_to_the_kernel() {
    for (tolerance, allowed) in [(1e-6, 1e-6), (1e-10, 1e-10), (1e-14, 3e-14)] {
        let rates = Rates::new(1e-4, 600.0, tolerance).unwrap();
        assert!(rates.rates().len() < 150);
        for q in [0.01, 0.15, 0.5, 0.85, 0.99, 1.0] {
            let weights = rates.weights(q);
            for t in [1e-4, 3e-4, 2e-3, 0.1, 1.0, 37.0, 600.0] {
                let sum: f64 = weights.iter().zip(rates.rates()).map(|(w, s)| w * (-s * t).exp()).sum();
                let truth = f64::powf(t, q - 1.0) / libm::tgamma(q);
                assert!((sum - truth).abs() <= allowed * truth, "q {q}, t {t}: {sum} for {truth}");
            }
        }
    }
    assert!(Rates::new(0.0, 1.0, 1e-6).is_err());
    assert!(Rates::new(1.0, 1.0, 1e-6).is_err());
    assert!(Rates::new(1e-3, 1.0, 0.0).is_err());
}

#[test]
fn decay_is_smooth_across_its_series() {
    for x in [0.0, 1e-9, 1e-3, 0.0999, 0.1001, 1.0, 30.0] {
        let (keep, first, last) = decay(x);
        // ∫ e^{−x(1−u)}(1−u) du and ∫ e^{−x(1−u)} u du by Simpson's rule.
        let n = 20_000;
        let (mut a, mut b) = (0.0, 0.0);
        for i in 0..=n {
            let u = f64::from(i) / f64::from(n);
            let w = if i == 0 || i == n {
                1.0
            } else if i % 2 == 1 {
                4.0
            } else {
                2.0
            };
            let e = (-x * (1.0 - u)).exp() * w / (3.0 * f64::from(n));
            a += e * (1.0 - u);
            b += e * u;
        }
        assert!((keep - (-x).exp()).abs() < 1e-15);
        assert!((first - a).abs() < 1e-12 && (last - b).abs() < 1e-12, "x {x}");
    }
}
