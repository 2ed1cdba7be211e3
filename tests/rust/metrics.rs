//! The four figures of a response, and the errors that computations name.

use ftlm::error::{check_finite, check_length, check_step, Error, Kind};
use ftlm::metrics::metrics;

#[test]
fn the_four_figures_of_a_small_case() {
    let found = metrics(&[1.0, 3.0, 1.0, 3.0], &[0.5, -0.5, 0.5, -0.5]);
    assert_eq!((found.error, found.rmse, found.nr, found.fit_percent), (2.0, 0.5, 0.5, 50.0));
    let perfect = metrics(&[1.0, 2.0], &[0.0, 0.0]);
    assert_eq!((perfect.error, perfect.nr, perfect.fit_percent), (0.0, 0.0, 100.0));
    // The mean of the measurement, as a response, explains nothing: a fit of zero.
    assert_eq!(metrics(&[1.0, 3.0], &[-1.0, 1.0]).fit_percent, 0.0);
}

#[test]
fn a_diverged_response_has_no_finite_figures() {
    for bad in [f64::NAN, f64::INFINITY, 1e200] {
        let found = metrics(&[1.0, 2.0, 3.0], &[0.0, bad, 0.0]);
        assert!(found.rmse.is_infinite() && found.nr.is_infinite(), "{bad}: {found:?}");
        assert_eq!(found.fit_percent, f64::NEG_INFINITY);
        assert_eq!(found.error.is_infinite(), !bad.is_finite());
    }
}

#[test]
fn checks_report_what_they_found() {
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
fn every_error_has_its_family() {
    let families = [
        (Error::NotFinite { name: "u".into(), index: 0, count: 1 }, Kind::Data),
        (Error::Length { name: "u".into(), expected: 1, found: 2 }, Kind::Data),
        (Error::Singular { index: 0, count: 1 }, Kind::Convergence),
        (Error::Diverged { what: "response".into(), index: 3 }, Kind::Convergence),
        (Error::Interrupted, Kind::Interrupted),
        (Error::Internal { what: "x".into() }, Kind::Internal),
        (Error::LeadingZero { leading: 0.0 }, Kind::Model),
        (Error::EmptyLattice { why: "x".into() }, Kind::Model),
        (Error::LatticeTooLarge { count: 2, limit: 1 }, Kind::Model),
        (Error::NotPowerOfTwo { m: 3, below: 2, above: 4 }, Kind::Model),
        (Error::Structure { what: "x".into(), remedy: "y".into() }, Kind::Model),
    ];
    for (error, kind) in families {
        assert_eq!(error.kind(), kind, "{error}");
    }
}
