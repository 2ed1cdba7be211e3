//! Equations: which orders make one, its initial terms, order laws, sensor filters.

use ftlm::equation::{grains, round_order, AffineOrder, Equation, Filter, Initial, Structure};
use ftlm::error::Error;
use ftlm::simulate;
use proptest::prelude::*;

use crate::common::{cases, check, check_between, deviation, distance, equation, norm, orders, record, structure};

/// Signals 0 and 1 are outputs, 2 is an input.
fn check_structure(structure: &Structure) -> Result<(), Error> {
    structure.check(3, |s| s == 2)
}

#[test]
fn valid_orders_are_accepted() {
    for good in [
        structure(0, 2.0, &[(0, 1.9), (0, 0.0), (1, 2.0), (1, 0.0), (2, 0.0), (2, -3.0), (2, 2.0), (1, 2.9), (2, 2.9)]),
        structure(1, 3.0, &[(1, 2.99), (0, 3.0)]),
        structure(0, 0.05, &[]),
    ] {
        assert_eq!(check_structure(&good), Ok(()));
    }
}

#[test]
fn invalid_orders_are_reported() {
    let refused = |s: &Structure, name: &str, value: f64, range: &str| match check_structure(s) {
        Err(Error::OutOfRange { name: n, value: v, range: r, .. }) => {
            assert_eq!((n.as_str(), r.as_str()), (name, range));
            assert!(v == value || v.is_nan() && value.is_nan());
        }
        other => panic!("{other:?}"),
    };
    for alpha in [0.0, -1.0, 10.01, f64::NAN] {
        refused(&structure(0, alpha, &[]), "order alpha", alpha, "(0, 10]");
    }
    for order in [2.0, 2.5, -0.1, f64::NAN] {
        refused(&structure(0, 2.0, &[(2, 0.0), (0, order)]), "order of term 1", order, "[0, 2)");
    }
    for order in [3.0, 3.5, -0.1, f64::NAN] {
        refused(&structure(0, 2.0, &[(1, order)]), "order of term 0", order, "[0, 3)");
    }
    for order in [3.0, 3.5, -3.1, f64::NAN] {
        refused(&structure(0, 2.0, &[(2, order)]), "order of term 0", order, "[-3, 3)");
    }
    for missing in [structure(3, 2.0, &[]), structure(0, 2.0, &[(3, 0.0)])] {
        match check_structure(&missing) {
            Err(error @ Error::Structure { .. }) => {
                assert!(error.to_string().starts_with("the equation contains signal 3, but the record has 3 signals"));
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn orders_are_rounded_to_the_order_resolution() {
    assert_eq!(round_order(0.1 + 0.2).to_bits(), 0.3_f64.to_bits());
    assert_eq!(grains(1.95), 1_950_000_000);
    assert_eq!(grains(-0.05), -50_000_000);
    let s = structure(0, 1.95, &[(0, 1.9), (1, 1.95)]);
    assert_eq!(s.integration(0).to_bits(), 0.05_f64.to_bits());
    assert_eq!(s.integration(1), 0.0);
    // Equal within the grain is equal: an other-signal term may have alpha's order.
    assert_eq!(check_structure(&structure(0, 1.95, &[(1, 1.95 + 1e-12)])), Ok(()));
    assert!(check_structure(&structure(0, 1.95, &[(0, 1.95 - 1e-12)])).is_err());
}

#[test]
fn initial_exponents_are_those_of_caputo() {
    let of = |s: &Structure| s.initial_exponents(&Initial::Caputo);
    // D^1.8 y + 2 D^0.9 y + y = 0: 1, t, and t^0.9 from the middle term.
    assert_eq!(of(&structure(0, 1.8, &[(0, 0.9), (0, 0.0)])), [0.0, 0.9, 1.0]);
    // Whole orders: no more than the polynomial.
    assert_eq!(of(&structure(0, 2.0, &[(0, 1.0), (0, 0.0), (1, 0.0)])), [0.0, 1.0]);
    // Terms of other signals and inputs count too; an integrated input leaves nothing.
    assert_eq!(of(&structure(0, 1.2, &[(1, 1.1), (2, 0.3), (2, -0.4)])), [0.0, 0.1, 0.9, 1.0, 1.1]);
    assert_eq!(of(&structure(0, 0.5, &[(1, 0.5)])), [0.0]);
    assert_eq!(of(&structure(0, 3.0, &[(0, 2.5)])), [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]);
    let s = structure(0, 1.8, &[(0, 0.9)]);
    assert_eq!(s.initial_exponents(&Initial::Rest), [0.0; 0]);
    assert_eq!(s.initial_exponents(&Initial::Powers(vec![1.0, 0.0, 1.0 + 1e-12])), [0.0, 1.0]);
}

/// D^1.8 y + 2 D^0.9 y + y = 0 from y(0) = 1, y'(0) = 0, on m pulses of [0, 10].
fn relaxation_from_one(m: usize) -> (Equation, ftlm::regressors::Record) {
    let model = equation(0, 1.8, &[(0, 0.9, -2.0), (0, 0.0, -1.0)]);
    let rest = record(10.0 / m as f64, vec![vec![0.0; m]]);
    // Caputo: y = y(0) − 2 I^0.9 (y − y(0)) − I^1.8 y, and I^0.9 1 = t^0.9/Γ(1.9).
    let initial = vec![vec![(0.0, 1.0), (0.9, 2.0 / libm::tgamma(1.9))]];
    let y = simulate::respond(std::slice::from_ref(&model), &rest, &initial).unwrap();
    (model, record(10.0 / m as f64, y))
}

#[test]
fn offset_adds_one_power_of_time_for_every_kind_of_initial_terms() {
    let plant = structure(0, 0.8, &[(0, 0.3), (2, 0.0)]);
    for (base, before) in
        [(Initial::Rest, vec![]), (Initial::Caputo, vec![0.0, 0.5]), (Initial::Powers(vec![0.0, 0.8]), vec![0.0, 0.8])]
    {
        assert_eq!(plant.initial_exponents(&base.clone().with_offset(0).unwrap()), before);
        for (offset, more) in [(1, vec![0.8]), (2, vec![0.8, 1.8])] {
            let mut expected = [before.clone(), more].concat();
            expected.sort_by(f64::total_cmp);
            expected.dedup();
            let initial = base.clone().with_offset(offset).unwrap();
            assert_eq!(plant.initial_exponents(&initial), expected);
            assert_eq!((initial.base(), initial.is_at_rest()), (&base, base == Initial::Rest));
        }
    }
    // A level is added to the output, so the equation has no term for it.
    assert_eq!(plant.initial_exponents(&Initial::Caputo.with_offset(3).unwrap()), [0.0, 0.5]);
    assert!(matches!(Initial::Rest.with_offset(4), Err(Error::OutOfRange { .. })));
    assert!(Initial::Powers(vec![-1.0]).with_offset(1).unwrap().check().is_err());
}

#[test]
fn nonzero_initial_state_needs_the_fractional_initial_term() {
    for m in [500, 2048] {
        let (model, record) = relaxation_from_one(m);
        let size = deviation(record.signal(0)) * (m as f64).sqrt();
        let nr = |powers: &[f64]| {
            let initial = Initial::Powers(powers.to_vec());
            let response =
                simulate::respond_with_initial(std::slice::from_ref(&model), &record, &initial, None).unwrap();
            let misses: Vec<f64> = response.outputs[0].iter().zip(record.signal(0)).map(|(a, b)| a - b).collect();
            let equation = simulate::equation_error(&model, &record, &initial).unwrap();
            (norm(&misses) / size, norm(&equation) / size)
        };
        let (output, equation) = nr(&[0.0, 1.0]);
        check_between("NR with {1, t}", output, 0.15, 0.2);
        check_between("NR of the equation with {1, t}", equation, 0.5, 0.7);
        let (output, equation) = nr(&[0.0, 1.0, 0.9]);
        check("NR with {1, t, t^0.9}", output, 1e-12);
        check("NR of the equation with {1, t, t^0.9}", equation, 1e-12);
        let caputo =
            simulate::respond_with_initial(std::slice::from_ref(&model), &record, &Initial::Caputo, None).unwrap();
        assert_eq!(caputo.exponents, [[0.0, 0.9, 1.0]]);
        assert!(distance(&caputo.initial[0], &[1.0, 2.0 / libm::tgamma(1.9), 0.0]) < 1e-9);
    }
}

#[test]
fn order_laws_are_affine() {
    // gamma_2 = 2 gamma_1 - alpha_1 + alpha_2 - mu_2 of the two-link arm.
    let law = AffineOrder { constant: 0.0, weights: vec![-1.0, 1.0, 2.0, 0.0, -1.0] };
    assert_eq!(law.at(&[2.0, 2.0, 0.95, 0.1, 0.85]).to_bits(), 1.05_f64.to_bits());
    assert_eq!(AffineOrder { constant: 1.5, weights: vec![] }.at(&[7.0]), 1.5);
    assert_eq!(AffineOrder { constant: 0.1, weights: vec![1.0] }.at(&[0.2]).to_bits(), 0.3_f64.to_bits());
}

/// The 2 Hz low-pass of the real-time model: 157.9137/(s² + 22.6195 s + 157.9137).
fn low_pass() -> Filter {
    Filter { numerator: vec![(157.9137, 0.0)], denominator: vec![(1.0, 2.0), (22.6195, 1.0), (157.9137, 0.0)] }
}

#[test]
fn the_low_pass_has_its_exact_step_response() {
    let (omega2, half) = (157.9137_f64, 22.6195_f64 / 2.0);
    let damped = (omega2 - half * half).sqrt();
    // Integral of 1 − e^{−at}(cos bt + (a/b) sin bt) from 0 to t.
    let integral = |t: f64| {
        let (a, b) = (half, damped);
        let e = (-a * t).exp();
        let cosine = (a + e * (b * (b * t).sin() - a * (b * t).cos())) / omega2;
        let sine = (b - e * (a * (b * t).sin() + b * (b * t).cos())) / omega2;
        t - cosine - a / b * sine
    };
    let errors: Vec<f64> = [250, 500, 1000, 2000]
        .into_iter()
        .map(|m| {
            let h = 1.0 / m as f64;
            let series = low_pass().series(m, h).unwrap();
            // The response to a step is the sum of the series.
            let response: Vec<f64> = series
                .iter()
                .scan(0.0, |sum, v| {
                    *sum += v;
                    Some(*sum)
                })
                .collect();
            let exact: Vec<f64> = (0..m).map(|k| (integral((k + 1) as f64 * h) - integral(k as f64 * h)) / h).collect();
            distance(&response, &exact)
        })
        .collect();
    check_between("order of the low-pass step", orders(&errors)[2], 1.95, 2.05);
    check("error of the low-pass step at 2000 pulses", errors[3], 1e-5);
}

#[test]
fn improper_filters_are_rejected() {
    let mut filter = low_pass();
    filter.numerator.push((1.0, 2.5));
    assert!(matches!(filter.series(10, 0.1), Err(Error::OutOfRange { value, .. }) if value == 2.5));
    let steep = Filter { numerator: vec![(1.0, 0.0)], denominator: vec![(1.0, 10.5)] };
    assert!(matches!(steep.series(10, 0.1), Err(Error::OutOfRange { .. })));
    let negative = Filter { numerator: vec![(1.0, -0.5)], denominator: vec![(1.0, 1.0)] };
    assert!(matches!(negative.series(10, 0.1), Err(Error::OutOfRange { .. })));
    let nothing = Filter { numerator: vec![(1.0, 0.0)], denominator: vec![] };
    assert!(nothing.series(10, 0.1).is_err());
    // A gain is a filter.
    let gain = Filter { numerator: vec![(3.0, 0.0)], denominator: vec![(2.0, 0.0)] };
    assert_eq!(gain.series(3, 0.1).unwrap(), [1.5, 0.0, 0.0]);
}

proptest! {
    #![proptest_config(cases(256))]

    #[test]
    fn rounding_of_orders_is_idempotent_and_close(order in -6.0..6.0_f64) {
        let tidied = round_order(order);
        prop_assert!((tidied - order).abs() <= 0.51e-9);
        prop_assert_eq!(round_order(tidied).to_bits(), tidied.to_bits());
        prop_assert_eq!(grains(tidied), grains(order));
    }

    #[test]
    fn initial_exponents_ascend_and_stay_below_alpha(
        alpha in 0.05..3.0_f64,
        orders in prop::collection::vec((0usize..3, 0.0..1.0_f64), 0..5),
    ) {
        let terms: Vec<(usize, f64)> = orders.iter().map(|&(s, x)| (s, round_order(x * (alpha - 0.01)))).collect();
        let exponents = structure(0, alpha, &terms).initial_exponents(&Initial::Caputo);
        prop_assert_eq!(exponents[0], 0.0);
        prop_assert!(exponents.windows(2).all(|p| p[0] < p[1]));
        // t^(alpha - nu + i) with i < nu.
        prop_assert!(exponents.iter().all(|&e| e < alpha + 1e-9));
    }
}
