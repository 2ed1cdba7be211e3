//! Coefficients at given orders: least squares and multi-innovation least squares against dense oracles, and the small
//! solves beneath them.

use ftlm::equation::{Initial, Structure};
use ftlm::error::Error;
use ftlm::estimation::least_squares::{self, Regression};
use ftlm::estimation::multi_innovation::{closed_form, recursion, Innovation, Prior, RowBasis};
use ftlm::fractional::operational_matrices;
use ftlm::linalg::small::{self, packed_index};
use ftlm::parallel::pool;
use ftlm::regressors::{Bank, Index, Key, Record, BANK_LIMIT};
use ftlm::series;
use ftlm::signal::block_pulse::PulseMeans;
use ftlm::simd::{self, LANE_COUNT};
use ftlm::simulate;
use proptest::prelude::*;

use crate::common::{
    bits, cases, check, dense_solve, distance, equation, norm, record, relative_distance, structure, with_signal,
    Random,
};

/// A record whose signal 0 obeys the equation exactly, driven by two random inputs, with this much noise added.
fn simulate_record(
    model: &ftlm::equation::Equation,
    m: usize,
    step: f64,
    initial: &[(f64, f64)],
    noise: f64,
    seed: u64,
) -> Record {
    let mut random = Random::new(seed);
    let rest = record(step, vec![vec![0.0; m], random.steps(m, 17), random.steps(m, 5)]);
    let mut y = simulate::respond(std::slice::from_ref(model), &rest, &[initial.to_vec()]).unwrap().remove(0);
    y.iter_mut().for_each(|v| *v += noise * random.normal());
    with_signal(&rest, 0, y)
}

fn damped_equation() -> ftlm::equation::Equation {
    equation(0, 1.8, &[(0, 0.9, -3.0), (0, 0.0, -10.0), (1, 0.0, 4.0), (2, 0.3, 0.7)])
}

const FREE: [Option<f64>; 4] = [None; 4];

#[test]
fn coefficients_of_exact_data_are_recovered() {
    for (seed, m) in [(40, 300), (41, 1024), (42, 2500)] {
        let model = damped_equation();
        let record = simulate_record(&model, m, 0.01, &[], 0.0, seed);
        let found = least_squares::fit(&[record], &model.structure, &FREE, &Initial::Rest).unwrap();
        check("recovered coefficients", relative_distance(&found.coefficients, &model.coefficients), 1e-12);
        assert_eq!((found.initial, found.exponents, found.excluded_terms), (vec![vec![]], vec![], vec![]));
    }
}

#[test]
fn fixed_coefficients_stay_and_the_others_are_recovered() {
    let model = damped_equation();
    let record = simulate_record(&model, 600, 0.01, &[], 0.0, 43);
    for fixed in [
        [Some(-3.0), None, None, None],
        [None, Some(-10.0), Some(4.0), None],
        [Some(-3.0), Some(-10.0), Some(4.0), Some(0.7)],
    ] {
        let found =
            least_squares::fit(std::slice::from_ref(&record), &model.structure, &fixed, &Initial::Rest).unwrap();
        for (f, c) in fixed.iter().zip(&found.coefficients) {
            assert!(f.is_none_or(|f| f.to_bits() == c.to_bits()));
        }
        assert!(relative_distance(&found.coefficients, &model.coefficients) < 1e-10);
    }
    // A wrong one is believed and the others make up for it as well as they can.
    let wrong = [Some(-4.0), None, None, None];
    let found = least_squares::fit(&[record], &model.structure, &wrong, &Initial::Rest).unwrap();
    assert_eq!(found.coefficients[0], -4.0);
    assert!(relative_distance(&found.coefficients, &model.coefficients) > 1e-3);
}

#[test]
fn records_keep_their_own_length_step_and_initial_terms() {
    let model = damped_equation();
    let initial: [&[(f64, f64)]; 3] =
        [&[(0.0, 0.5), (0.9, 1.5), (1.0, -0.3)], &[], &[(0.0, -1.0), (0.9, -3.0), (1.0, 2.0)]];
    let records: Vec<Record> = [(400, 0.01), (256, 0.02), (777, 0.004)]
        .into_iter()
        .zip(initial)
        .zip(44..)
        .map(|(((m, step), initial), seed)| simulate_record(&model, m, step, initial, 0.0, seed))
        .collect();
    let powers = Initial::Powers(vec![0.0, 0.9, 1.0]);
    let found = least_squares::fit(&records, &model.structure, &FREE, &powers).unwrap();
    check("coefficients from three records", relative_distance(&found.coefficients, &model.coefficients), 1e-12);
    assert_eq!(found.exponents, [0.0, 0.9, 1.0]);
    for (found, true_terms) in found.initial.iter().zip(initial) {
        let values: Vec<f64> =
            if true_terms.is_empty() { vec![0.0; 3] } else { true_terms.iter().map(|t| t.1).collect() };
        check("initial terms", distance(found, &values), 1e-11);
    }
    // Without them the records contradict each other.
    let found = least_squares::fit(&records, &model.structure, &FREE, &Initial::Rest).unwrap();
    assert!(relative_distance(&found.coefficients, &model.coefficients) > 1e-2);
}

#[test]
fn a_record_through_a_sensor_filter_keeps_its_equation() {
    // Series commute: filtered signals obey the equation of the unfiltered ones, with filtered initial terms.
    let model = damped_equation();
    let initial = [(0.0, 0.5), (0.9, 1.5), (1.0, -0.3)];
    let m = 500;
    let plain = simulate_record(&model, m, 0.01, &initial, 0.0, 65);
    let filter: Vec<f64> = (0..m).map(|k| 0.2 * 0.8_f64.powi(i32::try_from(k).unwrap())).collect();
    let signals = (0..3).map(|s| series::multiply_naive(&filter, plain.signal(s), m)).collect();
    let filtered = Record::new(0.01, PulseMeans::from_signals(signals), Some(filter.clone())).unwrap();
    for (exponent, _) in initial {
        let oracle = series::multiply_naive(&filter, &plain.initial_term(exponent), m);
        assert!(relative_distance(&filtered.initial_term(exponent), &oracle) < 1e-13);
    }
    let powers = Initial::Powers(vec![0.0, 0.9, 1.0]);
    let found = least_squares::fit(&[filtered], &model.structure, &FREE, &powers).unwrap();
    check("coefficients through a filter", relative_distance(&found.coefficients, &model.coefficients), 1e-10);
    check("initial terms through a filter", distance(&found.initial[0], &initial.map(|t| t.1)), 1e-10);
}

#[test]
fn regression_matches_the_equation() {
    let model = damped_equation();
    let records = [simulate_record(&model, 100, 0.01, &[], 0.1, 47), simulate_record(&model, 60, 0.02, &[], 0.1, 48)];
    let fixed = [None, Some(-10.0), None, None];
    let regression = Regression::new(&records, &model.structure, &fixed, &Initial::Caputo).unwrap();
    // Caputo: 1, t and t^0.9 of the output, t^1.5 of the second input, for each record.
    let exponents = model.structure.initial_exponents(&Initial::Caputo);
    assert_eq!(exponents, [0.0, 0.9, 1.0, 1.5]);
    assert_eq!((regression.columns.len(), regression.free_count()), (3 + 2 * 4, 3));
    assert_eq!(regression.starts, [0, 100, 160]);
    for (r, range) in [(0, 0..100), (1, 100..160)] {
        let record = &records[r];
        for (column, (signal, eta)) in [(0, (0, 0.9)), (1, (1, 1.8)), (2, (2, 1.5))] {
            assert_eq!(bits(&regression.columns[column][range.clone()]), bits(&record.integral(signal, eta)));
        }
        for (e, &exponent) in exponents.iter().enumerate() {
            let column = &regression.columns[3 + 4 * r + e];
            assert_eq!(bits(&column[range.clone()]), bits(&record.initial_term(exponent)));
            assert_eq!(column.iter().filter(|v| **v != 0.0).count(), record.m());
        }
        let target: Vec<f64> =
            record.signal(0).iter().zip(record.integral(0, 1.8)).map(|(y, v)| y + 10.0 * v).collect();
        assert!(distance(&regression.target[range], &target) < 1e-14 * norm(&target));
    }
}

#[test]
fn dependent_terms_are_named_and_dependent_initial_terms_dropped() {
    let model = damped_equation();
    let base = simulate_record(&model, 300, 0.01, &[], 0.01, 49);
    // The second input is three times the first, and both enter at one order.
    let copied = with_signal(&base, 2, base.signal(1).iter().map(|v| 3.0 * v).collect());
    let doubled = structure(0, 1.8, &[(0, 0.9), (1, 0.0), (0, 0.0), (2, 0.0)]);
    let found = least_squares::fit(std::slice::from_ref(&copied), &doubled, &FREE, &Initial::Rest);
    assert_eq!(found, Err(Error::Singular { index: 3, count: 4 }));
    let message = found.unwrap_err().to_string();
    assert!(message.starts_with("regressor 3 of 4 is a linear combination of the others"), "{message}");
    // One of them fixed: nothing is dependent any more.
    let fixed = [None, Some(1.0), None, None];
    assert!(least_squares::fit(&[copied], &doubled, &fixed, &Initial::Rest).is_ok());
    // A signal that is zero.
    let silent = with_signal(&base, 2, vec![0.0; 300]);
    let found = least_squares::fit(&[silent], &model.structure, &FREE, &Initial::Rest);
    assert_eq!(found, Err(Error::Singular { index: 3, count: 4 }));
    // A constant input integrated once is t: the initial term t tells nothing new.
    let constant = with_signal(&base, 2, vec![2.0; 300]);
    let once = structure(0, 1.8, &[(0, 0.9), (2, 0.8)]);
    let powers = Initial::Powers(vec![0.0, 1.0, 1.5]);
    let found = least_squares::fit(&[constant.clone(), base.clone()], &once, &[None, None], &powers).unwrap();
    assert_eq!(found.excluded_terms, []);
    let found = least_squares::fit(std::slice::from_ref(&constant), &once, &[None, None], &powers).unwrap();
    assert_eq!(found.excluded_terms, [(0, 1)]);
    assert_eq!(found.initial[0][1], 0.0);
    assert!(found.initial[0][0] != 0.0 && found.initial[0][2] != 0.0);
    let both = [with_signal(&base, 2, vec![1.0; 300]), constant];
    let first = Initial::Powers(vec![1.0]);
    assert_eq!(least_squares::fit(&both, &once, &[None, None], &first).unwrap().excluded_terms, [(1, 0)]);
}

#[test]
fn unfittable_problems_are_rejected() {
    let model = damped_equation();
    let record = simulate_record(&model, 50, 0.01, &[], 0.0, 50);
    let refused = Error::Length { name: "fixed coefficients".into(), expected: 4, found: 3 };
    let fit = |records: &[Record], fixed: &[Option<f64>]| {
        least_squares::fit(records, &model.structure, fixed, &Initial::Rest)
    };
    assert_eq!(fit(std::slice::from_ref(&record), &[None; 3]), Err(refused));
    assert!(matches!(fit(&[], &FREE), Err(Error::Length { .. })));
    // Fewer rows than coefficients.
    let short = simulate_record(&model, 3, 0.01, &[], 0.0, 51);
    assert!(matches!(fit(&[short], &FREE), Err(Error::Singular { .. })));
    let innovation = Innovation { length: 1, prior: Prior::Absolute(1.0), row_basis: RowBasis::Haar };
    for bad in [
        Innovation { length: 0, ..innovation },
        Innovation { prior: Prior::Absolute(0.0), ..innovation },
        Innovation { prior: Prior::Absolute(f64::NAN), ..innovation },
        Innovation { prior: Prior::Absolute(f64::INFINITY), ..innovation },
    ] {
        let found = closed_form(std::slice::from_ref(&record), &model.structure, &FREE, &Initial::Rest, &bad);
        assert!(matches!(found, Err(Error::OutOfRange { .. })));
        assert!(recursion(std::slice::from_ref(&record), &model.structure, &FREE, &Initial::Rest, &bad).is_err());
    }
    let found = closed_form(&[record], &model.structure, &FREE, &Initial::Rest, &innovation);
    assert_eq!(found, Err(Error::NotPowerOfTwo { m: 50, below: 32, above: 64 }));
}

#[test]
fn least_squares_is_the_same_in_haar_coordinates() {
    let model = damped_equation();
    for seed in 52..56 {
        let record = simulate_record(&model, 1024, 0.01, &[], 0.02, seed);
        let time = least_squares::fit(std::slice::from_ref(&record), &model.structure, &FREE, &Initial::Rest).unwrap();
        let mut regression = Regression::new(&[record], &model.structure, &FREE, &Initial::Rest).unwrap();
        for series in regression.columns.iter_mut().chain([&mut regression.target]) {
            operational_matrices::haar_transform(series).unwrap();
        }
        let (coefficients, _) = least_squares::solve(&regression.columns, &regression.target, 4).unwrap();
        check("Haar against block pulses", relative_distance(&coefficients, &time.coefficients), 1e-11);
    }
}

/// The recursion (44) in its covariance form, by dense solves: K ← K − K Q (I + QᵀKQ)⁻¹ QᵀK, X ← X + K Q (m − QᵀX).
fn published_recursion(columns: &[Vec<f64>], target: &[f64], p: usize, prior: f64) -> Vec<f64> {
    let k = columns.len();
    let mut x = vec![0.0; k];
    let mut covariance = vec![0.0; k * k];
    (0..k).for_each(|i| covariance[i * k + i] = prior);
    for newest in 0..target.len() {
        let rows: Vec<usize> = (0..p.min(newest + 1)).map(|back| newest - back).collect();
        let n = rows.len();
        let q: Vec<Vec<f64>> = rows.iter().map(|&i| columns.iter().map(|c| c[i]).collect()).collect();
        let kq: Vec<Vec<f64>> =
            q.iter().map(|q| (0..k).map(|i| (0..k).map(|j| covariance[i * k + j] * q[j]).sum()).collect()).collect();
        let mut inner = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                inner[a * n + b] = f64::from(u8::from(a == b)) + (0..k).map(|i| q[a][i] * kq[b][i]).sum::<f64>();
            }
        }
        for j in 0..k {
            let column: Vec<f64> = kq.iter().map(|v| v[j]).collect();
            let solved = dense_solve(&inner, &column);
            for i in 0..k {
                covariance[i * k + j] -= (0..n).map(|a| kq[a][i] * solved[a]).sum::<f64>();
            }
        }
        let misses: Vec<f64> =
            rows.iter().zip(&q).map(|(&i, q)| target[i] - q.iter().zip(&x).map(|(a, b)| a * b).sum::<f64>()).collect();
        for i in 0..k {
            x[i] += q
                .iter()
                .zip(&misses)
                .map(|(q, e)| (0..k).map(|j| covariance[i * k + j] * q[j]).sum::<f64>() * e)
                .sum::<f64>();
        }
    }
    x
}

#[test]
fn the_recursion_is_the_published_one() {
    let model = damped_equation();
    let record = simulate_record(&model, 128, 0.02, &[], 0.02, 56);
    for rows in [RowBasis::Haar, RowBasis::Time] {
        for length in [1, 2, 5, 200] {
            let innovation = Innovation { length, prior: Prior::Absolute(10.0), row_basis: rows };
            let records = std::slice::from_ref(&record);
            let (found, _) = recursion(records, &model.structure, &FREE, &Initial::Rest, &innovation).unwrap();
            let mut regression = Regression::new(records, &model.structure, &FREE, &Initial::Rest).unwrap();
            if rows == RowBasis::Haar {
                for series in regression.columns.iter_mut().chain([&mut regression.target]) {
                    operational_matrices::haar_transform(series).unwrap();
                }
            }
            let oracle = published_recursion(&regression.columns, &regression.target, length, 10.0);
            check(
                &format!("recursion, p = {length}, {rows:?}"),
                relative_distance(&found.coefficients, &oracle),
                1e-10,
            );
        }
    }
}

#[test]
fn the_recursion_ends_at_the_closed_form() {
    let model = damped_equation();
    let one = [simulate_record(&model, 512, 0.01, &[], 0.02, 57)];
    let two = [simulate_record(&model, 256, 0.01, &[], 0.02, 58), simulate_record(&model, 128, 0.02, &[], 0.02, 59)];
    let fixed = [None, None, Some(4.0), None];
    let mut worst = 0.0_f64;
    for (records, fixed, initial) in [
        (&one[..], &FREE, Initial::Rest),
        (&two[..], &FREE, Initial::Powers(vec![0.0, 1.0])),
        (&two[..], &fixed, Initial::Rest),
    ] {
        for rows in [RowBasis::Haar, RowBasis::Time] {
            for length in [1, 3, 5, 7] {
                for prior_covariance in [1.0, 100.0] {
                    let innovation = Innovation { length, prior: Prior::Absolute(prior_covariance), row_basis: rows };
                    let closed = closed_form(records, &model.structure, fixed, &initial, &innovation).unwrap();
                    let (ended, trace) = recursion(records, &model.structure, fixed, &initial, &innovation).unwrap();
                    worst = worst.max(relative_distance(&ended.coefficients, &closed.coefficients));
                    for (a, b) in ended.initial.iter().zip(&closed.initial) {
                        worst = worst.max(distance(a, b));
                    }
                    assert_eq!(trace.len(), records.iter().map(Record::m).sum::<usize>());
                    assert_eq!(bits(&trace[trace.len() - 1]), bits(&ended.coefficients));
                    assert!(trace.iter().all(|row| row.len() == 4));
                }
            }
        }
    }
    check("recursion against closed form", worst, 1e-10);
}

#[test]
fn row_weight_equals_its_number_of_uses() {
    let innovation = |length| Innovation { length, prior: Prior::Absolute(1.0), row_basis: RowBasis::Time };
    let weights = |length, m| (0..m).map(|i| innovation(length).weight(i, m)).collect::<Vec<_>>();
    assert_eq!(weights(1, 4), [1, 1, 1, 1]);
    assert_eq!(weights(3, 6), [3, 3, 3, 3, 2, 1]);
    assert_eq!(weights(9, 4), [4, 3, 2, 1]);
    // The closed form against the normal equations written out with these weights.
    let model = damped_equation();
    let record = simulate_record(&model, 64, 0.03, &[], 0.05, 60);
    for rows in [RowBasis::Haar, RowBasis::Time] {
        for length in [1, 4, 64, 100] {
            let innovation = Innovation { length, prior: Prior::Absolute(50.0), row_basis: rows };
            let records = std::slice::from_ref(&record);
            let found = closed_form(records, &model.structure, &FREE, &Initial::Rest, &innovation).unwrap();
            let mut regression = Regression::new(records, &model.structure, &FREE, &Initial::Rest).unwrap();
            if rows == RowBasis::Haar {
                for series in regression.columns.iter_mut().chain([&mut regression.target]) {
                    operational_matrices::haar_transform(series).unwrap();
                }
            }
            let weighted =
                |a: &[f64], b: &[f64]| -> f64 { (0..64).map(|i| length.min(64 - i) as f64 * a[i] * b[i]).sum() };
            let c = &regression.columns;
            let mut normal: Vec<f64> = (0..16).map(|e| weighted(&c[e / 4], &c[e % 4])).collect();
            (0..4).for_each(|i| normal[i * 5] += 1.0 / 50.0);
            let rhs: Vec<f64> = c.iter().map(|c| weighted(c, &regression.target)).collect();
            let oracle = dense_solve(&normal, &rhs);
            check("closed form against normal equations", relative_distance(&found.coefficients, &oracle), 1e-12);
        }
    }
}

#[test]
fn estimate_without_prior_is_independent_of_innovation_length_and_coordinates() {
    let model = damped_equation();
    let record = simulate_record(&model, 512, 0.01, &[], 0.02, 61);
    let records = std::slice::from_ref(&record);
    let of = |length, prior_covariance, rows| {
        let innovation = Innovation { length, prior: Prior::Absolute(prior_covariance), row_basis: rows };
        closed_form(records, &model.structure, &FREE, &Initial::Rest, &innovation).unwrap().coefficients
    };
    // With p = 1 every row weighs the same, so coordinates cannot matter, prior or not.
    for prior in [1.0, 100.0] {
        check(
            "p = 1, Haar against time",
            relative_distance(&of(1, prior, RowBasis::Haar), &of(1, prior, RowBasis::Time)),
            1e-11,
        );
    }
    let batch = least_squares::fit(records, &model.structure, &FREE, &Initial::Rest).unwrap().coefficients;
    check("weak prior against least squares", relative_distance(&of(1, 1e14, RowBasis::Time), &batch), 1e-10);
    // p multiplies the data, all but the last rows, as K0 does: the prior pulls ever less.
    let pull = |p| relative_distance(&of(p, 1.0, RowBasis::Haar), &batch);
    assert!(pull(1) > pull(3) && pull(3) > pull(7));
}

#[test]
fn banks_hold_the_integrals() {
    let model = damped_equation();
    for filter in [false, true] {
        let base = simulate_record(&model, 200, 0.02, &[], 0.1, 62);
        let series: Vec<f64> = (0..200).map(|k| 0.5_f64.powi(k + 1)).collect();
        let signals = (0..3).map(|s| base.signal(s).to_vec()).collect();
        let record = Record::new(0.02, PulseMeans::from_signals(signals), filter.then_some(series)).unwrap();
        let mut index = Index::default();
        assert_eq!(index.insert(Key::integral(0, 0.9)), 0);
        assert_eq!(index.insert(Key::integral(1, 0.0)), 1);
        assert_eq!(index.insert(Key::integral(0, 0.9 + 1e-12)), 0);
        assert_eq!(index.insert(Key::initial(0.9)), 2);
        assert_eq!(index.insert(Key::integral(2, 1.35)), 3);
        assert_eq!(index.get(Key::integral(0, 0.9)), Some(0));
        assert_eq!(index.get(Key::integral(1, 0.9)), None);
        // An order that several signals share, a derivative, an order 0 of the output itself.
        let shared: Vec<usize> = (0..3).map(|signal| index.insert(Key::integral(signal, 0.55))).collect();
        assert_eq!(shared, [4, 5, 6]);
        let (steep, plain) = (index.insert(Key::integral(2, -0.3)), index.insert(Key::integral(0, 0.0)));
        assert_eq!(index.keys().len(), 9);
        let bank = Bank::new(&index, &record, 0).unwrap();
        assert_eq!((bank.len(), bank.is_empty()), (9, false));
        for (signal, &place) in shared.iter().enumerate() {
            assert!(relative_distance(bank.column(place), &record.integral(signal, 0.55)) < 1e-14);
        }
        assert!(relative_distance(bank.column(steep), &record.integral(2, -0.3)) < 1e-14);
        assert_eq!(bank.column(plain), record.signal(0));
        assert_eq!(bank.kernel(shared[0]), ftlm::fractional::kernels::block_pulse_kernel(0.55, 200, 0.02));
        assert_eq!((bank.kernel(plain)[0], bank.kernel(plain)[1]), (1.0, 0.0));
        assert!([5, 6, 7].iter().all(|&p| bank.kernel(p).is_empty()));
        for threads in [1, 3] {
            let same = pool(threads).unwrap().install(|| Bank::new(&index, &record, 0)).unwrap();
            for p in 0..bank.len() {
                assert_eq!((same.column(p), same.kernel(p)), (bank.column(p), bank.kernel(p)), "{threads} threads");
            }
        }
        assert!(relative_distance(bank.column(0), &record.integral(0, 0.9)) < 1e-14);
        assert_eq!(bank.column(1), record.signal(1));
        assert_eq!(bank.column(2), record.initial_term(0.9));
        assert!(relative_distance(bank.column(3), &record.integral(2, 1.35)) < 1e-14);
        assert_eq!(bank.kernel(0), ftlm::fractional::kernels::block_pulse_kernel(0.9, 200, 0.02));
        assert!([1, 2, 3].iter().all(|&p| bank.kernel(p).is_empty()));
    }
}

#[test]
fn bank_above_the_memory_limit_is_rejected_before_allocation() {
    let m = 1 << 20;
    let record = record(1.0, vec![vec![0.0; m]]);
    let mut index = Index::default();
    for k in 0..200 {
        index.insert(Key::integral(0, f64::from(k) * 0.01));
    }
    // Own columns count twice: for the column and for the kernel.
    let bytes = 8 * m as u128 * 400;
    let refused = Error::BankTooLarge { columns: 200, m, bytes, limit: u128::from(BANK_LIMIT) };
    assert_eq!(Bank::new(&index, &record, 0).err(), Some(refused));
}

#[test]
fn records_are_checked_once() {
    let bad = |step, signals, filter| Record::new(step, PulseMeans::from_signals(signals), filter).err().unwrap();
    assert!(matches!(bad(0.0, vec![vec![1.0]], None), Error::OutOfRange { .. }));
    assert!(matches!(bad(0.1, vec![], None), Error::Length { .. }));
    assert!(matches!(bad(0.1, vec![vec![]], None), Error::Length { .. }));
    let refused = Error::Length { name: "signal 1".into(), expected: 2, found: 1 };
    assert_eq!(bad(0.1, vec![vec![1.0, 2.0], vec![1.0]], None), refused);
    let refused = Error::NotFinite { name: "signal 1".into(), index: 0, count: 1 };
    assert_eq!(bad(0.1, vec![vec![1.0], vec![f64::NAN]], None), refused);
    assert!(matches!(bad(0.1, vec![vec![1.0]], Some(vec![1.0, 2.0])), Error::Length { .. }));
    let good = record(0.1, vec![vec![1.0, 2.0], vec![3.0, 4.0]]);
    assert_eq!((good.m(), good.len(), good.is_empty(), good.step()), (2, 2, false, 0.1));
}

/// Gram matrix and right-hand side of random columns.
fn gram(columns: &[Vec<f64>], target: &[f64]) -> (Vec<f64>, Vec<f64>) {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let gram = columns.iter().flat_map(|a| columns.iter().map(move |b| dot(a, b))).collect();
    (gram, columns.iter().map(|c| dot(c, target)).collect())
}

/// Solves one system through the lanes: scaled to a diagonal of ones, solved, scaled back.
fn solve_one(gram: &[f64], rhs: &[f64], needed: usize) -> (Vec<f64>, bool) {
    let k = rhs.len();
    let scale: Vec<f64> =
        (0..k).map(|i| if gram[i * k + i] > 0.0 { 1.0 / gram[i * k + i].sqrt() } else { 0.0 }).collect();
    let mut lower = vec![[0.0]; packed_index(k, 0)];
    for i in 0..k {
        for j in 0..=i {
            lower[packed_index(i, j)] =
                [if scale[i] * scale[j] == 0.0 { 0.0 } else { gram[i * k + j] * scale[i] * scale[j] }];
        }
    }
    let mut x: Vec<[f64; 1]> = rhs.iter().zip(&scale).map(|(b, s)| [b * s]).collect();
    let [singular] = small::solve_lanes(&mut lower, &mut x, needed);
    (x.iter().zip(&scale).map(|(x, s)| x[0] * s).collect(), singular)
}

#[test]
fn dependent_columns_of_a_gram_matrix() {
    let mut random = Random::new(63);
    let mut columns: Vec<Vec<f64>> = (0..3).map(|_| random.signal(40)).collect();
    let sum: Vec<f64> = columns[0].iter().zip(&columns[2]).map(|(a, b)| 2.0 * a - 3.0 * b).collect();
    columns.push(sum);
    columns.push(random.signal(40));
    let target = random.signal(40);
    let (g, b) = gram(&columns, &target);
    // Needed: flagged. Optional: dropped, and the rest is solved without it.
    assert!(solve_one(&g, &b, 4).1);
    let (mut x, singular) = solve_one(&g, &b, 3);
    assert!(!singular);
    assert_eq!(x[3], 0.0);
    columns.remove(3);
    let (g, b) = gram(&columns, &target);
    let oracle = small::positive_solve(&g, &b).unwrap();
    x.remove(3);
    assert!(relative_distance(&x, &oracle) < 1e-12);
    // NaN counts as dependent, and nothing at all is solved at once.
    assert!(solve_one(&[f64::NAN], &[1.0], 1).1);
    assert_eq!(solve_one(&[f64::NAN], &[1.0], 0), (vec![0.0], false));
    assert_eq!(solve_one(&[], &[], 0), (vec![], false));
}

struct Wide<'a>(&'a mut [[f64; LANE_COUNT]], &'a mut [[f64; LANE_COUNT]], usize);

impl simd::SimdKernel for Wide<'_> {
    type Output = [bool; LANE_COUNT];

    #[inline(always)]
    fn run(self) -> [bool; LANE_COUNT] {
        small::solve_lanes(self.0, self.1, self.2)
    }
}

struct Dot<'a>(&'a [f64], &'a [f64]);

impl simd::SimdKernel for Dot<'_> {
    type Output = f64;

    #[inline(always)]
    fn run(self) -> f64 {
        simd::dot(self.0, self.1)
    }
}

#[test]
fn simd_lanes_are_independent_of_each_other_and_of_the_instruction_set() {
    let mut random = Random::new(65);
    for k in 1..9 {
        let mut systems: Vec<(Vec<f64>, Vec<f64>)> = (0..LANE_COUNT)
            .map(|_| {
                let columns: Vec<Vec<f64>> = (0..k).map(|_| random.signal(30)).collect();
                gram(&columns, &random.signal(30))
            })
            .collect();
        // One lane that is singular from its first unknown on, and one that is no number.
        systems[2].0.fill(0.0);
        systems[5].0.fill(f64::NAN);
        let pack = |lanes: &[usize]| -> (Vec<[f64; LANE_COUNT]>, Vec<[f64; LANE_COUNT]>) {
            let lower = (0..k)
                .flat_map(|i| (0..=i).map(move |j| (i, j)))
                .map(|(i, j)| std::array::from_fn(|n| systems[lanes[n]].0[i * k + j]))
                .collect();
            (lower, (0..k).map(|i| std::array::from_fn(|n| systems[lanes[n]].1[i])).collect())
        };
        let straight: Vec<usize> = (0..LANE_COUNT).collect();
        let turned: Vec<usize> = (0..LANE_COUNT).rev().collect();
        let (mut a, mut x) = pack(&straight);
        let flags = small::solve_lanes(&mut a, &mut x, k.min(2));
        let (mut a, mut y) = pack(&straight);
        let widest = simd::dispatch_simd(Wide(&mut a, &mut y, k.min(2)));
        let (mut a, mut z) = pack(&turned);
        let backwards = small::solve_lanes(&mut a, &mut z, k.min(2));
        assert_eq!(flags, widest);
        assert!(flags[2] && flags[5] && !flags[0]);
        for n in 0..LANE_COUNT {
            assert_eq!(flags[n], backwards[LANE_COUNT - 1 - n]);
            for i in 0..k {
                assert_eq!(x[i][n].to_bits(), y[i][n].to_bits());
                assert_eq!(x[i][n].to_bits(), z[i][LANE_COUNT - 1 - n].to_bits());
            }
            let mut one: Vec<[f64; 1]> = (0..k).map(|i| [systems[n].1[i]]).collect();
            let mut lower: Vec<[f64; 1]> =
                (0..k).flat_map(|i| (0..=i).map(move |j| (i, j))).map(|(i, j)| [systems[n].0[i * k + j]]).collect();
            small::solve_lanes(&mut lower, &mut one, k.min(2));
            assert!((0..k).all(|i| one[i][0].to_bits() == x[i][n].to_bits()));
        }
    }
    let (a, b) = (random.signal(1003), random.signal(1003));
    assert_eq!(simd::dot(&a, &b).to_bits(), simd::dispatch_simd(Dot(&a, &b)).to_bits());
    check("dot product", (simd::dot(&a, &b) - a.iter().zip(&b).map(|(x, y)| x * y).sum::<f64>()).abs(), 1e-13);
}

#[test]
fn small_inverses() {
    let mut random = Random::new(64);
    for n in 1..6 {
        let a = random.signal(n * n);
        let inverse = small::inverse(&a, n).unwrap();
        for i in 0..n {
            for j in 0..n {
                let product: f64 = (0..n).map(|k| a[i * n + k] * inverse[k * n + j]).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-12 * norm(&a) * norm(&inverse));
            }
        }
    }
    assert_eq!(small::inverse(&[0.0], 1), Err(Error::LeadingZero { leading: 0.0 }));
    assert_eq!(small::inverse(&[1.0, 2.0, 2.0, 4.0], 2), Err(Error::LeadingZero { leading: 0.0 }));
    assert!(small::inverse(&[f64::NAN], 1).is_err());
    assert!(small::inverse(&[f64::NAN, 0.0, 0.0, 1.0], 2).is_err());
    assert_eq!(small::back_substitute(&[2.0, 1.0, 9.0, 0.0, 4.0, 9.0], 3, &[4.0, 8.0]), [1.0, 2.0]);
}

proptest! {
    #![proptest_config(cases(128))]

    #[test]
    fn gram_solves_match_the_oracle(k in 1usize..8, spread in 0.0..6.0_f64, seed in any::<u64>()) {
        let mut random = Random::new(seed);
        // Columns of very different size: the scaling is part of the solve.
        let columns: Vec<Vec<f64>> = (0..k)
            .map(|_| {
                let size = 10.0_f64.powf(random.uniform(-spread, spread));
                (0..60).map(|_| size * random.normal()).collect()
            })
            .collect();
        let target = random.signal(60);
        let (g, b) = gram(&columns, &target);
        let oracle = small::positive_solve(&g, &b).unwrap();
        let (b, singular) = solve_one(&g, &b, k);
        prop_assert!(!singular);
        for i in 0..k {
            // Each relative to what its own column's size makes of the target.
            prop_assert!((b[i] - oracle[i]).abs() <= 1e-10 * norm(&target) / norm(&columns[i]));
        }
        let (by_factor, excluded_columns) = least_squares::solve(&columns, &target, k).unwrap();
        prop_assert!(excluded_columns.is_empty());
        for i in 0..k {
            prop_assert!((by_factor[i] - b[i]).abs() <= 1e-10 * norm(&target) / norm(&columns[i]));
        }
    }

    #[test]
    fn scaling_a_signal_scales_its_coefficient(factor in 1e-6..1e6_f64, seed in 0u64..50) {
        let model = damped_equation();
        let base = simulate_record(&model, 200, 0.02, &[], 0.05, seed);
        let scaled = with_signal(&base, 1, base.signal(1).iter().map(|v| factor * v).collect());
        let of = |record: Record, s: &Structure| least_squares::fit(&[record], s, &FREE, &Initial::Rest).unwrap().coefficients;
        let (plain, mut other) = (of(base, &model.structure), of(scaled, &model.structure));
        other[2] *= factor;
        prop_assert!(relative_distance(&other, &plain) < 1e-9);
    }
}
