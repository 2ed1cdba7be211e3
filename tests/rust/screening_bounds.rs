//! Screening bounds of candidates: none exceeds the score itself, and none changes a table.

use ftlm::equation::{Equation, Initial};
use ftlm::order_search::batches::search;
use ftlm::order_search::control::Control;
use ftlm::order_search::dual_bound::{excluded_by, excluded_by_linearized_vector, exclusion_flags, has_unstable_zeros};
use ftlm::order_search::grid::{OrderGrid, TermAxis};
use ftlm::order_search::options::{Norm, Options};
use ftlm::regressors::Record;
use ftlm::simulate::respond;

use crate::common::{equation, record, Random};

/// Σ|y − ŷ| or Σ(y − ŷ)² of a free run at rest; infinite where it leaves the range of floating point.
fn score(record: &Record, equation: &Equation, norm: Norm) -> f64 {
    let Ok(run) = respond(std::slice::from_ref(equation), record, &[]) else { return f64::INFINITY };
    let errors = run[0].iter().zip(record.signal(0)).map(|(v, y)| (y - v).abs());
    let sum: f64 = match norm {
        Norm::L1 => errors.sum(),
        Norm::L2 => errors.map(|e| e * e).sum(),
    };
    if sum.is_finite() {
        sum
    } else {
        f64::INFINITY
    }
}

/// An output that follows the inputs a little, or not at all, or goes its own way.
fn random_record(random: &mut Random, m: usize) -> Record {
    let (slow, fast) = (random.steps(m, 40), random.steps(m, 9));
    let (follows, noise, drift) = (random.uniform(-1.0, 1.0), random.uniform(0.0, 1.0), random.uniform(-1.0, 1.0));
    let own: Vec<f64> =
        (0..m).map(|k| follows * slow[k] + noise * random.normal() + drift * k as f64 / m as f64).collect();
    record(random.uniform(0.01, 0.1), vec![own, slow, fast])
}

/// y = 0.
fn equation_without_terms_is_rejected() -> Equation {
    equation(0, 1.0, &[(1, 0.0, 0.0)])
}

fn random_equation(random: &mut Random, own: usize, scale: f64) -> Equation {
    let alpha = random.uniform(0.5, 2.0);
    let mut terms: Vec<(usize, f64, f64)> = (0..own)
        .map(|_| {
            (0, random.uniform(0.0, 0.95 * alpha), scale * random.normal() * 10.0_f64.powf(random.uniform(-1.0, 1.0)))
        })
        .collect();
    terms.push((1, random.uniform(0.0, alpha), random.normal()));
    if random.chance(0.7) {
        terms.push((2, random.uniform(0.0, alpha), random.normal()));
    }
    equation(0, alpha, &terms)
}

#[test]
fn divisor_zeros_give_valid_bounds() {
    let mut random = Random::new(77);
    let (mut proved, mut large, mut stable) = (0, 0, 0);
    for case in 0..400 {
        let m = 60 + random.below(340);
        let record = random_record(&mut random, m);
        let own = 1 + random.below(3);
        let equation = random_equation(&mut random, own, 1.0);
        let norm = if case % 3 == 0 { Norm::L2 } else { Norm::L1 };
        let exact = score(&record, &equation, norm);
        if exact.is_finite() {
            assert!(
                !has_unstable_zeros(&record, &equation, norm, exact * (1.0 + 1e-9)).unwrap(),
                "case {case}: {exact:e}"
            );
        }
        let size = score(&record, &equation_without_terms_is_rejected(), norm);
        let beyond = exact > 1e4 * size;
        let told = has_unstable_zeros(&record, &equation, norm, size).unwrap();
        proved += usize::from(told && beyond);
        large += usize::from(beyond);
        stable += usize::from(exact <= size);
        assert!(!(told && exact <= size));
    }
    println!("{proved} of {large} that explode; {stable} that do not");
    assert!(proved > 40 && stable > 60, "{proved} of {large}, {stable}");
}

#[test]
fn nan_limit_and_huge_coefficients_exclude_no_candidate() {
    let mut random = Random::new(3);
    let record = random_record(&mut random, 300);
    for huge in [1e160, 1e300, f64::MAX, f64::NAN, f64::INFINITY] {
        let equation = |c: f64| equation(0, 1.5, &[(0, 0.5, c), (0, 0.0, -c), (1, 0.0, c)]);
        let _ = has_unstable_zeros(&record, &equation(huge), Norm::L1, 1.0).unwrap();
        assert!(!has_unstable_zeros(&record, &equation(huge), Norm::L1, f64::INFINITY).unwrap());
        assert!(!has_unstable_zeros(&record, &equation(2.0), Norm::L1, f64::NAN).unwrap());
        assert!(
            !excluded_by_linearized_vector(&record, &equation(1.0), &equation(huge), Norm::L1, f64::INFINITY).unwrap()
        );
        assert!(
            !excluded_by_linearized_vector(&record, &equation(huge), &equation(1.0), Norm::L1, f64::INFINITY).unwrap()
        );
        assert!(!excluded_by_linearized_vector(&record, &equation(1.0), &equation(1.1), Norm::L1, f64::NAN).unwrap());
    }
    let other = equation(0, 1.5, &[(0, 0.4, 1.0), (1, 0.0, 1.0)]);
    let one = equation(0, 1.5, &[(0, 0.5, 1.0), (1, 0.0, 1.0)]);
    let error = excluded_by_linearized_vector(&record, &one, &other, Norm::L1, 1.0).unwrap_err();
    assert!(error.to_string().contains("output terms"), "{error}");
}

#[test]
fn linearized_test_vectors_give_valid_bounds() {
    let mut random = Random::new(78);
    let (mut asked, mut close, mut closer, mut cut) = (0, 0, 0, 0);
    for case in 0..150 {
        let m = 60 + random.below(200);
        let record = random_record(&mut random, m);
        let norm = if case % 3 == 0 { Norm::L2 } else { Norm::L1 };
        let own = 1 + random.below(3);
        let made_for = random_equation(&mut random, own, -1.0);
        for _ in 0..6 {
            let size = 10.0_f64.powf(random.uniform(-5.0, 0.5));
            let mut other = made_for.clone();
            other.coefficients.iter_mut().for_each(|c| *c *= 1.0 + size * random.normal());
            let exact = score(&record, &other, norm);
            if !exact.is_finite() {
                continue;
            }
            let proves = |limit: f64| excluded_by_linearized_vector(&record, &made_for, &other, norm, limit).unwrap();
            assert!(!proves(exact * (1.0 + 1e-9)), "case {case}: {exact:e} at {size:e}");
            asked += 1;
            close += usize::from(size < 0.1 && proves(0.99 * exact));
            closer += usize::from(size < 1e-3 && proves(0.9999 * exact));
            // The vector covers the first samples only.
            cut += usize::from(size < 0.1 && proves(0.1 * exact));
        }
    }
    println!("{close} of {asked} within 1 %, {closer} within 0.01 %, {cut} by the first samples");
    assert!(asked > 600 && close > 150 && closer > 60 && cut > 150, "{close}, {closer}, {cut} of {asked}");
}

#[test]
fn test_vector_bounds_hold_for_the_next_candidate() {
    let mut random = Random::new(79);
    let (mut asked, mut told, mut close) = (0, 0, 0);
    for case in 0..60 {
        let m = 60 + random.below(200);
        let record = random_record(&mut random, m);
        let norm = if case % 3 == 0 { Norm::L2 } else { Norm::L1 };
        let own = 1 + random.below(3);
        let made_for = random_equation(&mut random, own, -1.0);
        let size = 10.0_f64.powf(random.uniform(-4.0, -0.5));
        // Two tuples of orders in turn, so that what is remembered of one outlives the other.
        let mut others = [made_for.clone(), made_for.clone()];
        others[1].structure.terms[0].order *= 0.97;
        let equations: Vec<Equation> = (0..24)
            .map(|i| {
                let mut other = others[usize::from(i % 5 == 4)].clone();
                other.coefficients.iter_mut().for_each(|c| *c *= 1.0 + size * random.normal());
                other
            })
            .collect();
        let exact: Vec<f64> = equations.iter().map(|equation| score(&record, equation, norm)).collect();
        for limit in exact.iter().filter(|exact| exact.is_finite()).step_by(8) {
            let limit = limit * (1.0 + 1e-9);
            let excluded = exclusion_flags(&record, &made_for, &equations, norm, limit).unwrap();
            for ((equation, &exact), &excluded) in equations.iter().zip(&exact).zip(&excluded) {
                assert!(!(excluded && exact <= limit), "case {case}: {exact:e} at {limit:e}");
                asked += 1;
                told += usize::from(excluded);
                close += usize::from(excluded && exact < 1.1 * limit);
                // What is remembered only saves work.
                assert!(excluded || !excluded_by(&record, &made_for, equation, norm, limit).unwrap(), "case {case}");
            }
        }
    }
    println!("{told} of {asked} excluded, {close} of them within 10 %");
    assert!(told > 500 && close > 100, "{told}, {close} of {asked}");
}

#[test]
fn certificates_keep_the_table_of_brute_force() {
    let mut random = Random::new(5);
    let record = random_record(&mut random, 96);
    let step = 0.05;
    let orders = |n: usize| (0..=n).map(|i| i as f64 * step).collect::<Vec<f64>>();
    let axis = |signal: usize, values: Vec<f64>| TermAxis { signal, values, interchangeable: true };
    let axes = [axis(0, orders(36)), axis(0, orders(36)), axis(1, orders(40)), axis(2, vec![0.0])];
    let alphas: Vec<f64> = (0..20).map(|i| 1.05 + i as f64 * step).collect();
    let lattice = OrderGrid::new(0, &alphas, &axes, |s| s != 0).unwrap();
    assert!(lattice.count() > 1 << 18, "{}", lattice.count());
    let of = |early_stopping: bool, threads: usize| {
        let options = Options { pruning: early_stopping, threads, initial: Initial::Rest, ..Options::default() };
        search(std::slice::from_ref(&record), &lattice, &[None; 4], &options, &Control::default()).unwrap()
    };
    let (whole, proved) = (of(false, 2), of(true, 2));
    assert_eq!(whole.rows, proved.rows);
    assert_eq!(proved, of(true, 3));
    let counts = proved.counts;
    println!("{counts:?}");
    assert_eq!(
        counts.table_rows
            + counts.beaten
            + counts.excluded_by_bound
            + counts.stopped
            + counts.singular
            + counts.diverged,
        lattice.count()
    );
    assert!(counts.excluded_by_bound > lattice.count() / 4);
}
