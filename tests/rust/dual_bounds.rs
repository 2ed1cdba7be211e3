//! Lower bounds of the simulation error: never above the error, tight for their own equations.

use ftlm::equation::{Equation, Initial};
use ftlm::error::Error;
use ftlm::estimation::least_squares;
use ftlm::order_search::dual_bound::{excluded_by, is_infeasible, lower_bounds};
use ftlm::order_search::options::Norm;
use ftlm::regressors::Record;
use ftlm::simulate::respond;

use crate::common::{equation, record, with_signal, Random};
use crate::search::{data, truth};

/// A record and an equation for it. A third of the equations are unstable; half have fitted coefficients.
fn random_candidate(random: &mut Random) -> (Record, Equation) {
    let m = 30 + random.below(300);
    let step = 10.0_f64.powf(random.uniform(-3.0, 0.0));
    let record = data(random, m, step, 0.05);
    let alpha = random.uniform(0.3, 2.5);
    let mut terms: Vec<(usize, f64, f64)> = Vec::new();
    for _ in 0..1 + random.below(3) {
        terms.push((0, random.uniform(0.0, 0.95) * alpha, 0.0));
    }
    terms.push((1, random.uniform(0.0, 1.0) * alpha, 0.0));
    terms.push((2, random.uniform(-0.5, 1.0) * alpha, 0.0));
    let unstable = random.chance(1.0 / 3.0);
    for term in &mut terms {
        let size = 10.0_f64.powf(random.uniform(-1.0, 3.0));
        term.2 = if term.0 == 0 && !unstable { -size } else { size * if random.chance(0.5) { 1.0 } else { -1.0 } };
    }
    let mut made = equation(0, alpha, &terms);
    if random.chance(0.5) {
        let fixed = vec![None; terms.len()];
        if let Ok(fit) = least_squares::fit(std::slice::from_ref(&record), &made.structure, &fixed, &Initial::Rest) {
            made.coefficients = fit.coefficients;
        }
    }
    (record, made)
}

#[test]
fn bound_is_tight_for_errors_along_a_test_vector() {
    // A wrong gain under a square wave: a bound far below the error would exclude nothing.
    let mut random = Random::new(246);
    let current: Vec<f64> = (0..1024).map(|k| if k / 100 % 2 == 0 { 0.3 } else { -0.3 }).collect();
    let rest = record(0.01, vec![vec![0.0; 1024], random.steps(1024, 40), current]);
    let y = respond(&[truth()], &rest, &[]).unwrap().remove(0);
    let seen = with_signal(&rest, 0, y);
    let mut wrong = truth();
    wrong.coefficients[3] *= 1.5;
    for norm in [Norm::L1, Norm::L2] {
        let best = lower_bounds(&seen, &wrong, norm).unwrap().into_iter().fold(0.0, f64::max);
        let error = raw_error(&seen, &wrong, norm);
        println!("{norm:?}: bound {best:.4}, error {error:.4}");
        assert!(best > 0.2 * error && best <= error, "{norm:?}");
    }
}

fn raw_error(record: &Record, equation: &Equation, norm: Norm) -> f64 {
    let y = respond(std::slice::from_ref(equation), record, &[]).unwrap().remove(0);
    let errors = record.signal(0).iter().zip(y).map(|(a, b)| a - b);
    errors.map(|e| if norm == Norm::L1 { e.abs() } else { e * e }).sum()
}

#[test]
fn the_bound_never_exceeds_the_error() {
    let mut random = Random::new(247);
    let (mut unstable, mut closest, mut seen) = (0, [0.0_f64; 2], 0);
    for _ in 0..1500 {
        let (record, equation) = random_candidate(&mut random);
        for (i, norm) in [Norm::L1, Norm::L2].into_iter().enumerate() {
            let error = raw_error(&record, &equation, norm);
            unstable += usize::from(error > 1e3 * raw_error(&record, &zero_model(&equation), norm) || error.is_nan());
            let bounds = lower_bounds(&record, &equation, norm).unwrap();
            assert!(bounds.iter().all(|b| *b >= 0.0));
            for bound in bounds {
                // A simulation that overflows has no error to compare with.
                assert!(bound <= error || !error.is_finite(), "bound {bound:e}, error {error:e}, {equation:?}");
                if error.is_finite() {
                    closest[i] = closest[i].max(bound / error);
                    seen += usize::from(bound > 0.1 * error);
                }
            }
        }
    }
    println!("{unstable} unstable, closest {closest:?}, {seen} bounds within a factor of 10");
    assert!(unstable > 500 && seen > 1000);
}

#[test]
fn test_vector_bounds_hold_for_other_equations_and_are_tight_for_its_own() {
    let mut random = Random::new(252);
    let (mut excluded_by_other, mut own, mut finite) = (0, 0, 0);
    for _ in 0..1500 {
        let (record, equation) = random_candidate(&mut random);
        // Test vectors of an equation with the same orders and perturbed coefficients, or of an unrelated one.
        let mut source_equation = random_candidate(&mut random).1;
        let alike = random.chance(0.7);
        if alike {
            source_equation = equation.clone();
            source_equation.coefficients.iter_mut().for_each(|c| *c *= 1.0 + 0.1 * random.normal());
        }
        for norm in [Norm::L1, Norm::L2] {
            let error = raw_error(&record, &equation, norm);
            if !error.is_finite() {
                continue;
            }
            finite += 1;
            let by = |other: &Equation, limit: f64| excluded_by(&record, other, &equation, norm, limit).unwrap();
            assert!(!by(&source_equation, error) && !by(&equation, error), "{error:e} is that of {equation:?}");
            excluded_by_other += usize::from(alike && by(&source_equation, 0.5 * error));
            own += usize::from(by(&equation, 0.999 * error));
        }
    }
    println!(
        "of {finite} errors, {excluded_by_other} are excluded by the vector of a similar equation, {own} by their own"
    );
    assert!(excluded_by_other > 300 && own > 1000 && finite > 1500);
}

#[test]
fn no_score_below_the_threshold_is_excluded() {
    let mut random = Random::new(249);
    let (mut excluded, mut finite) = (0, 0);
    for _ in 0..1500 {
        let (record, equation) = random_candidate(&mut random);
        let (structure, coefficients) = (&equation.structure, &equation.coefficients);
        let fixed: Vec<Option<f64>> = coefficients.iter().map(|&c| random.chance(0.2).then_some(c)).collect();
        // From the tested coefficients, and from perturbed ones.
        let elsewhere: Vec<f64> = coefficients.iter().map(|c| c * random.uniform(-1.0, 2.0)).collect();
        for norm in [Norm::L1, Norm::L2] {
            let error = raw_error(&record, &equation, norm);
            if !error.is_finite() {
                continue;
            }
            finite += 1;
            for start in [coefficients, &elsewhere] {
                let is_excluded = |limit: f64| is_infeasible(&record, structure, &fixed, start, norm, limit).unwrap();
                assert!(!is_excluded(error), "{error:e} is reached by {equation:?}");
                assert!(!is_excluded(2.0 * error));
                excluded += usize::from(is_excluded(1e-3 * error));
            }
        }
    }
    println!("{excluded} exclusions of a thousandth of {finite} errors, from two starts each");
    assert!(excluded > 500);
}

/// The equation with nothing on its right-hand side: its error is the measurement.
fn zero_model(equation: &Equation) -> Equation {
    Equation { coefficients: vec![0.0; equation.coefficients.len()], ..equation.clone() }
}

#[test]
fn bounds_reject_invalid_equations() {
    let mut random = Random::new(248);
    let record = data(&mut random, 50, 0.02, 0.0);
    let mut short = truth();
    short.coefficients.pop();
    assert!(matches!(lower_bounds(&record, &short, Norm::L1), Err(Error::Length { .. })));
    let missing = equation(0, 1.0, &[(7, 0.0, 1.0)]);
    assert!(matches!(lower_bounds(&record, &missing, Norm::L1), Err(Error::Structure { .. })));
    for (source_equation, equation) in [(&short, &truth()), (&truth(), &short)] {
        assert!(matches!(excluded_by(&record, source_equation, equation, Norm::L1, 1.0), Err(Error::Length { .. })));
    }
    assert!(matches!(excluded_by(&record, &missing, &truth(), Norm::L1, 1.0), Err(Error::Structure { .. })));
}
