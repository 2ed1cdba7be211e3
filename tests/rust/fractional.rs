//! Fractional integrals, derivatives and responses: their orders of convergence against closed forms.

use ftlm::error::Error;
use ftlm::fractional::integral::{fractional_derivative, fractional_integral, Derivative, IntegralRule};
use ftlm::fractional::kernels::power_means;
use ftlm::signal::block_pulse::point_samples;
use ftlm::simulate;
use proptest::prelude::*;
use serde_json::Value;

use crate::common::{
    cases, check, check_between, counts, distance, equation, list, norm, number, numbers, orders, record, reference,
    relative_distance, Random,
};

/// Duration of the sampled signals; every reference time from 0.1 on is a sample of a grid of a multiple of 100.
const DURATION: f64 = 10.0;

#[derive(Clone, Copy, PartialEq)]
enum Function {
    Power(f64),
    Decay,
    Sine,
}

impl Function {
    fn of(record: &Value) -> Self {
        match record["function"].as_str().unwrap() {
            "t^p" => Self::Power(number(&record["exponent"])),
            "exp(-t)" => Self::Decay,
            "sin(t)" => Self::Sine,
            other => panic!("{other}"),
        }
    }

    fn at(self, t: f64) -> f64 {
        match self {
            Self::Power(p) => t.powf(p),
            Self::Decay => (-t).exp(),
            Self::Sine => t.sin(),
        }
    }

    /// Value and derivatives at 0.
    fn start(self) -> Vec<f64> {
        match self {
            Self::Power(p) => {
                [0.0, 1.0, 2.0].iter().map(|&k| if p == k { [1.0, 1.0, 2.0][k as usize] } else { 0.0 }).collect()
            }
            Self::Decay => vec![1.0, -1.0, 1.0],
            Self::Sine => vec![0.0, 1.0, 0.0],
        }
    }

    fn samples(self, m: usize) -> Vec<f64> {
        (0..=m).map(|j| self.at(j as f64 * DURATION / m as f64)).collect()
    }

    fn means(self, m: usize) -> Vec<f64> {
        let h = DURATION / m as f64;
        match self {
            Self::Power(p) => power_means(p, m, h),
            // Exact integrals over a pulse, written without the difference of two nearly equal numbers.
            Self::Decay => (0..m).map(|k| -(-(k as f64) * h).exp() * (-h).exp_m1() / h).collect(),
            Self::Sine => (0..m).map(|k| ((k as f64 + 0.5) * h).sin() * (0.5 * h).sin() / (0.5 * h)).collect(),
        }
    }

    fn name(self) -> String {
        match self {
            Self::Power(p) => format!("t^{p}"),
            Self::Decay => "exp(-t)".into(),
            Self::Sine => "sin(t)".into(),
        }
    }
}

struct Exact {
    function: Function,
    order: f64,
    /// (time, value) at the reference times from 0.5 on.
    values: Vec<(f64, f64)>,
}

fn exact(definition: &str) -> Vec<Exact> {
    let document = reference("derivatives");
    let t = numbers(&document["t"]);
    list(&document["records"])
        .iter()
        .filter(|r| r["definition"] == definition)
        .map(|r| Exact {
            function: Function::of(r),
            order: number(&r["order"]),
            values: t.iter().copied().zip(numbers(&r["values"])).filter(|(t, _)| *t >= 0.5).collect(),
        })
        .collect()
}

/// Largest error at the reference times of samples over the whole duration, on grids that double from `m`.
fn errors(exact: &Exact, m: usize, grids: usize, compute: impl Fn(usize) -> Vec<f64>) -> Vec<f64> {
    (0..grids)
        .map(|g| {
            let m = m << g;
            let found = compute(m);
            exact.values.iter().fold(0.0, |worst, &(t, y)| {
                let index = (t * m as f64 / DURATION).round() as usize;
                f64::max(worst, (found[index] - y).abs())
            })
        })
        .collect()
}

#[test]
fn block_pulse_integrals_of_powers_are_exact_in_means_to_second_order() {
    // Means in, means out; the exact means of I^eta t^p are those of a power.
    for p in [0.0, 0.5, 1.0, 2.0, 3.0] {
        for eta in [0.3, 0.5, 0.8, 1.2, 1.8, 2.4] {
            let found: Vec<f64> = [250, 500, 1000, 2000]
                .into_iter()
                .map(|m| {
                    let h = DURATION / m as f64;
                    let scale = libm::tgamma(p + 1.0) / libm::tgamma(p + eta + 1.0);
                    let exact: Vec<f64> = power_means(p + eta, m, h).iter().map(|v| scale * v).collect();
                    let found = fractional_integral(&power_means(p, m, h), eta, h, IntegralRule::BlockPulse).unwrap();
                    // Past t = 1: the start-up of t^(p+eta) has its own order.
                    distance(&found[m / 10..], &exact[m / 10..]) / exact[m - 1]
                })
                .collect();
            if p == 0.0 {
                check(&format!("I^{eta} of 1, exact for means"), found[3], 1e-13);
            } else {
                let order = orders(&found)[2];
                // No upper limit: the leading error of I^0.5 t^0.5 vanishes.
                check_between(&format!("order of block-pulse I^{eta} t^{p}"), order, 1.9, 2.6);
                check(&format!("error of block-pulse I^{eta} t^{p} at 2000"), found[3], 6e-7);
            }
        }
    }
}

#[test]
fn block_pulse_integrals_converge_with_second_order() {
    for exact in exact("integral").iter().filter(|e| !matches!(e.function, Function::Power(_))) {
        let name = format!("block-pulse I^{} {}", exact.order, exact.function.name());
        let found = errors(exact, 500, 4, |m| {
            let h = DURATION / m as f64;
            let means = fractional_integral(&exact.function.means(m), exact.order, h, IntegralRule::BlockPulse);
            point_samples(&means.unwrap())
        });
        check_between(&format!("order of {name}"), orders(&found)[2], 1.95, 2.05);
        check(&format!("error of {name}"), found[3], 2.5e-6);
    }
}

#[test]
fn trapezoidal_integrals_converge_with_second_order() {
    for exact in exact("integral") {
        let name = format!("trapezoidal I^{} {}", exact.order, exact.function.name());
        let found = errors(&exact, 500, 4, |m| {
            let h = DURATION / m as f64;
            fractional_integral(&exact.function.samples(m), exact.order, h, IntegralRule::Trapezoidal).unwrap()
        });
        let size = exact.values.iter().fold(0.0, |a, v| f64::max(a, v.1.abs()));
        match exact.function {
            // The rule is exact for straight lines.
            Function::Power(0.0 | 1.0) => check(&format!("error of {name}"), found[3] / size, 1e-13),
            Function::Power(0.5) => {
                // The chord over the first step misses t^0.5 by h^1.5.
                check_between(&format!("order of {name}"), orders(&found)[2], 1.45, 1.55);
                check(&format!("error of {name}"), found[3] / size, 4e-6);
            }
            _ => {
                check_between(&format!("order of {name}"), orders(&found)[2], 1.95, 2.05);
                check(&format!("error of {name}"), found[3] / size, 1e-6);
            }
        }
    }
}

#[test]
fn grunwald_letnikov_integrals_converge_with_first_order() {
    for exact in exact("integral") {
        let name = format!("Grünwald-Letnikov I^{} {}", exact.order, exact.function.name());
        let found = errors(&exact, 500, 4, |m| {
            let h = DURATION / m as f64;
            fractional_integral(&exact.function.samples(m), exact.order, h, IntegralRule::GrunwaldLetnikov).unwrap()
        });
        let size = exact.values.iter().fold(0.0, |a, v| f64::max(a, v.1.abs()));
        check_between(&format!("order of {name}"), orders(&found)[2], 0.95, 1.05);
        check(&format!("error of {name}"), found[3] / size, 3e-3);
    }
}

#[test]
fn grunwald_letnikov_derivatives_converge_with_first_order() {
    for exact in exact("riemann-liouville") {
        // First order for signals that start at zero and can be differentiated that often.
        if exact.function.at(0.0) != 0.0 || matches!(exact.function, Function::Power(p) if p < exact.order) {
            continue;
        }
        let name = format!("Grünwald-Letnikov D^{} {}", exact.order, exact.function.name());
        let found = errors(&exact, 500, 4, |m| {
            let h = DURATION / m as f64;
            fractional_derivative(&exact.function.samples(m), exact.order, h, Derivative::GrunwaldLetnikov, &[])
                .unwrap()
        });
        let size = exact.values.iter().fold(0.0, |a, v| f64::max(a, v.1.abs()));
        check_between(&format!("order of {name}"), orders(&found)[2], 0.9, 1.55);
        check(&format!("error of {name}"), found[3] / size, 1e-2);
    }
}

#[test]
fn caputo_and_riemann_liouville_derivatives_converge() {
    for (definition, rule) in [("caputo", Derivative::Caputo), ("riemann-liouville", Derivative::RiemannLiouville)] {
        for (exact, known) in exact(definition).iter().flat_map(|e| [(e, false), (e, true)]) {
            let whole = exact.order.ceil();
            let start = if known { exact.function.start() } else { vec![] };
            let name = format!(
                "{definition} D^{} {}, {} start",
                exact.order,
                exact.function.name(),
                if known { "known" } else { "estimated" }
            );
            let found = errors(exact, 1000, 4, |m| {
                let h = DURATION / m as f64;
                fractional_derivative(&exact.function.samples(m), exact.order, h, rule, &start).unwrap()
            });
            let expected = match exact.function {
                // Straight lines after whole differentiation: only the rounding of the differences is left.
                Function::Power(p) if p.fract() == 0.0 && p <= whole => {
                    let rounding = f64::EPSILON * (8000.0 / DURATION).powf(exact.order) * DURATION.powf(p);
                    check(&format!("error of {name}, in rounding errors"), found[3] / rounding, 20.0);
                    continue;
                }
                // A start too steep for the differences of these orders.
                Function::Power(p) if whole > 1.0 && p.fract() != 0.0 && (p < whole || !known) => continue,
                // A start like t^p costs what lies beyond 1 + p.
                Function::Power(p) => f64::min(1.0 + p, 1.0 + whole - exact.order),
                _ => 1.0 + whole - exact.order,
            };
            // The errors of the differences (second order) and of the formula have signs of their own and nearly cancel
            // on some grids: the mean order over three doublings is judged, and more than expected is no fault.
            let mean = orders(&found).iter().sum::<f64>() / 3.0;
            check_between(&format!("order of {name}"), mean, expected - 0.25, 3.0);
            let size = exact.values.iter().fold(1.0, |a, v| f64::max(a, v.1.abs()));
            check(&format!("error of {name}"), found[3] / size, 2e-3);
        }
    }
}

#[test]
fn differences_at_the_ends_are_of_second_order() {
    // The first and the last samples of whole derivatives, where central differences do not reach.
    for alpha in [1.0, 2.0, 3.0] {
        let errors: Vec<f64> = [200, 400, 800]
            .into_iter()
            .map(|m| {
                let h = DURATION / m as f64;
                let found =
                    fractional_derivative(&Function::Decay.samples(m), alpha, h, Derivative::Caputo, &[]).unwrap();
                let sign = if alpha == 2.0 { 1.0 } else { -1.0 };
                (0..3).chain(m - 2..=m).map(|j| (found[j] - sign * (-(j as f64) * h).exp()).abs()).fold(0.0, f64::max)
            })
            .collect();
        check_between(&format!("order of D^{alpha} at the ends"), orders(&errors)[1], 1.8, 2.2);
    }
}

#[test]
fn three_term_step_response_converges_with_second_order() {
    let document = reference("step_responses");
    let (t, y) = (numbers(&document["three_term"]["t"]), numbers(&document["three_term"]["y"]));
    let terms: Vec<(f64, f64)> =
        list(&document["three_term"]["terms"]).iter().map(|t| (number(&t[0]), number(&t[1]))).collect();
    assert_eq!(terms, [(0.8, 2.2), (0.5, 0.9), (1.0, 0.0)]);
    let model = equation(0, 2.2, &[(0, 0.9, -0.625), (0, 0.0, -1.25), (1, 0.0, 1.25)]);
    let wanted = [1.0, 5.0, 10.0, 20.0];
    let found: Vec<Vec<f64>> = [640, 1280, 2560, 5120]
        .into_iter()
        .map(|m| {
            let record = record(20.0 / m as f64, vec![vec![0.0; m], vec![1.0; m]]);
            let means = simulate::respond(std::slice::from_ref(&model), &record, &[]).unwrap();
            let samples = point_samples(&means[0]);
            wanted
                .iter()
                .map(|&at| {
                    (samples[(at / 20.0 * m as f64).round() as usize] - y[t.iter().position(|&x| x == at).unwrap()])
                        .abs()
                })
                .collect()
        })
        .collect();
    for (i, at) in wanted.iter().enumerate() {
        let errors: Vec<f64> = found.iter().map(|e| e[i]).collect();
        check_between(&format!("order at y({at})"), orders(&errors)[2], 1.95, 2.05);
        check(&format!("error of y({at})"), errors[3], 3e-6);
    }
}

#[test]
fn relaxation_means_have_the_stated_errors() {
    let document = reference("step_responses");
    for (relaxation, stated) in
        list(&document["relaxation"]).iter().zip([[5.66e-6, 3.61e-7, 2.28e-8], [8.63e-5, 5.39e-6, 3.37e-7]])
    {
        let (alpha, duration) = (number(&relaxation["alpha"]), number(&relaxation["duration"]));
        let model = equation(0, alpha, &[(0, 0.0, -number(&relaxation["coefficient"])), (1, 0.0, 1.0)]);
        for (means, stated) in list(&relaxation["means"]).iter().zip(stated) {
            let m = counts(&serde_json::json!([means["m"]]))[0];
            let h = duration / m as f64;
            let record = record(h, vec![vec![0.0; m], vec![number(&relaxation["input"]); m]]);
            let found = simulate::respond(std::slice::from_ref(&model), &record, &[]).unwrap();
            let worst = counts(&means["k"])
                .iter()
                .zip(numbers(&means["mean"]))
                .filter(|&(&k, _)| (k as f64 - 0.5) * h > 1.0)
                .fold(0.0, |worst, (&k, mean)| f64::max(worst, (found[0][k - 1] - mean).abs()));
            check_between(
                &format!("error of D^{alpha} y + 2y = 2 at {m}, of the stated one"),
                worst / stated,
                0.5,
                1.1,
            );
        }
    }
}

#[test]
fn orders_zero_and_whole() {
    let x = Function::Sine.samples(200);
    let h = DURATION / 200.0;
    for rule in [IntegralRule::BlockPulse, IntegralRule::Trapezoidal, IntegralRule::GrunwaldLetnikov] {
        assert_eq!(fractional_integral(&x, 0.0, h, rule).unwrap(), x);
        assert_eq!(fractional_integral(&[], 0.7, h, rule).unwrap(), [0.0; 0]);
    }
    for rule in [Derivative::GrunwaldLetnikov, Derivative::RiemannLiouville, Derivative::Caputo] {
        assert_eq!(fractional_derivative(&x, 0.0, h, rule, &[]).unwrap(), x);
    }
    // Whole orders are the ordinary derivatives of second order, whatever the definition.
    for (alpha, sign) in [(1.0, 1.0), (2.0, -1.0), (3.0, -1.0)] {
        for rule in [Derivative::RiemannLiouville, Derivative::Caputo] {
            let errors: Vec<f64> = [200, 400]
                .into_iter()
                .map(|m| {
                    let found =
                        fractional_derivative(&Function::Sine.samples(m), alpha, DURATION / m as f64, rule, &[])
                            .unwrap();
                    (4..m - 4)
                        .map(|j| {
                            let t = j as f64 * DURATION / m as f64;
                            let exact = sign * if alpha == 2.0 { t.sin() } else { t.cos() };
                            (found[j] - exact).abs()
                        })
                        .fold(0.0, f64::max)
                })
                .collect();
            check_between(&format!("order of {rule:?} D^{alpha}"), orders(&errors)[0], 1.9, 2.1);
        }
    }
}

#[test]
fn riemann_liouville_derivative_is_infinite_at_the_start() {
    let x = Function::Decay.samples(100);
    let found = fractional_derivative(&x, 0.5, 0.1, Derivative::RiemannLiouville, &[]).unwrap();
    assert!(found[0].is_infinite() && found[1..].iter().all(|v| v.is_finite()));
    let found = fractional_derivative(&x, 0.5, 0.1, Derivative::Caputo, &[]).unwrap();
    assert!(found[0].abs() < 1e-15);
}

#[test]
fn invalid_arguments_are_rejected_with_their_values() {
    let x = [1.0, 2.0, 3.0, 4.0];
    let rule = IntegralRule::BlockPulse;
    for eta in [-0.1, 10.001, f64::NAN] {
        let message = fractional_integral(&x, eta, 0.1, rule).unwrap_err().to_string();
        assert!(message.contains(&eta.to_string()) && message.contains("[0, 10]"), "{message}");
        assert!(fractional_derivative(&x, eta, 0.1, Derivative::Caputo, &[]).is_err());
    }
    let message = fractional_derivative(&x, 3.001, 0.1, Derivative::Caputo, &[]).unwrap_err().to_string();
    assert!(message.contains("3.001") && message.contains("[0, 3]"), "{message}");
    for step in [0.0, -0.1, f64::NAN, f64::INFINITY] {
        assert!(matches!(fractional_integral(&x, 0.5, step, rule), Err(Error::OutOfRange { .. })));
        assert!(matches!(fractional_derivative(&x, 0.5, step, Derivative::Caputo, &[]), Err(Error::OutOfRange { .. })));
    }
    let bad = [1.0, f64::NAN, 2.0, f64::INFINITY];
    let refused = Error::NotFinite { name: "x".into(), index: 1, count: 2 };
    assert_eq!(fractional_integral(&bad, 0.5, 0.1, rule), Err(refused.clone()));
    assert_eq!(fractional_derivative(&bad, 0.5, 0.1, Derivative::GrunwaldLetnikov, &[]), Err(refused));
    assert!(fractional_derivative(&x, 0.5, 0.1, Derivative::Caputo, &[f64::NAN]).is_err());
    // Differences of the third derivative need five samples.
    let refused = Error::Length { name: "x".into(), expected: 5, found: 4 };
    assert_eq!(fractional_derivative(&x, 2.5, 0.1, Derivative::Caputo, &[]), Err(refused));
    assert!(fractional_derivative(&x, 1.5, 0.1, Derivative::Caputo, &[]).is_ok());
}

proptest! {
    #![proptest_config(cases(48))]

    #[test]
    fn grunwald_letnikov_inverts_itself(alpha in 0.0..3.0_f64, m in 1usize..500, seed in any::<u64>()) {
        let x = Random::new(seed).signal(m);
        let integral = fractional_integral(&x, alpha, 0.1, IntegralRule::GrunwaldLetnikov).unwrap();
        let back = fractional_derivative(&integral, alpha, 0.1, Derivative::GrunwaldLetnikov, &[]).unwrap();
        // Rounding of the integral, differentiated: its size times (2/h)^alpha.
        prop_assert!(distance(&back, &x) <= 1e-15 * norm(&integral).max(1.0) * 20.0_f64.powf(alpha) * (m as f64).sqrt());
    }

    #[test]
    fn rules_are_linear(eta in 0.05..3.0_f64, c in -2.0..2.0_f64, seed in any::<u64>()) {
        let mut random = Random::new(seed);
        let (x, y) = (random.signal(200), random.signal(200));
        let mixed: Vec<f64> = x.iter().zip(&y).map(|(x, y)| c * x + y).collect();
        for rule in [IntegralRule::BlockPulse, IntegralRule::Trapezoidal, IntegralRule::GrunwaldLetnikov] {
            let of = |s: &[f64]| fractional_integral(s, eta, 0.05, rule).unwrap();
            let sum: Vec<f64> = of(&x).iter().zip(of(&y)).map(|(x, y)| c * x + y).collect();
            prop_assert!(relative_distance(&of(&mixed), &sum) < 1e-12);
        }
    }
}
