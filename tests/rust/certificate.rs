//! Certificates over intervals of orders: no cell's bound exceeds what any of its orders leave, and no orders of a region
//! do better than what is proved.

use ftlm::equation::Equation;
use ftlm::order_search::certificate::{cell_bounds, certify, Certificate, CertificateOptions, Range, Region};
use ftlm::order_search::control::Control;
use ftlm::regressors::Record;
use ftlm::simulate::respond;

use crate::common::{equation, record, with_signal, Random};

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Over all records, one after the other.
fn concatenate_records(records: &[Record], of: impl Fn(&Record) -> Vec<f64>) -> Vec<f64> {
    records.iter().flat_map(of).collect()
}

/// Σ of the squares that least squares leave, by orthogonal columns, twice made so; and the size of all terms, in that of
/// the output.
fn residual_squares(records: &[Record], output: usize, terms: &[(usize, f64)]) -> (f64, f64) {
    let target = concatenate_records(records, |r| r.signal(output).to_vec());
    let columns: Vec<Vec<f64>> =
        terms.iter().map(|&(s, eta)| concatenate_records(records, |r| r.integral(s, eta))).collect();
    let (mut made, mut shares, mut rest): (Vec<Vec<f64>>, Vec<Vec<f64>>, Vec<f64>) = Default::default();
    for column in columns.iter().chain([&target]) {
        rest.clone_from(column);
        let mut along = vec![0.0; made.len()];
        for _ in 0..2 {
            for (unit, along) in made.iter().zip(&mut along) {
                let share = dot(&rest, unit);
                rest.iter_mut().zip(unit).for_each(|(x, u)| *x -= share * u);
                *along += share;
            }
        }
        let size = dot(&rest, &rest).sqrt();
        made.push(rest.iter().map(|x| x / size).collect());
        along.push(size);
        shares.push(along);
    }
    // Back through the triangle.
    let k = terms.len();
    let mut c = shares[k][..k].to_vec();
    for i in (0..k).rev() {
        let sum: f64 = (i + 1..k).map(|j| shares[j][i] * c[j]).sum();
        c[i] = (c[i] - sum) / shares[i][i];
    }
    let size = columns.iter().zip(&c).map(|(x, c)| c.abs() * dot(x, x).sqrt()).sum::<f64>();
    (dot(&rest, &rest), size / dot(&target, &target).sqrt())
}

/// Σ of the squares that coefficients of at most this size leave, nearly the best of these: shrunk until they are.
fn bounded_residual_squares(records: &[Record], output: usize, terms: &[(usize, f64)], largest: f64) -> f64 {
    let target = concatenate_records(records, |r| r.signal(output).to_vec());
    let size = dot(&target, &target).sqrt();
    let columns: Vec<Vec<f64>> = terms
        .iter()
        .map(|&(s, eta)| {
            let column = concatenate_records(records, |r| r.integral(s, eta));
            let inverse = size / dot(&column, &column).sqrt();
            column.into_iter().map(|x| x * inverse).collect()
        })
        .collect();
    let k = terms.len();
    let mut ridge = 1e-13;
    loop {
        let mut matrix: Vec<Vec<f64>> = (0..k)
            .map(|i| {
                let mut row: Vec<f64> = (0..k).map(|j| dot(&columns[i], &columns[j]) / (size * size)).collect();
                row[i] += ridge;
                row.push(dot(&columns[i], &target) / (size * size));
                row
            })
            .collect();
        for i in 0..k {
            let row = matrix[i].clone();
            for (_, other) in matrix.iter_mut().enumerate().filter(|(l, _)| *l != i) {
                let factor = other[i] / row[i];
                other.iter_mut().zip(&row).for_each(|(x, y)| *x -= factor * y);
            }
        }
        let c: Vec<f64> = (0..k).map(|i| matrix[i][k] / matrix[i][i]).collect();
        if c.iter().map(|c| c.abs()).sum::<f64>() <= largest {
            let mut rest = target;
            for (c, x) in c.iter().zip(&columns) {
                rest.iter_mut().zip(x).for_each(|(r, x)| *r -= c * x);
            }
            return dot(&rest, &rest);
        }
        ridge *= 3.0;
    }
}

fn truth() -> Equation {
    equation(0, 1.6, &[(0, 0.9, -2.0), (0, 0.0, -9.0), (1, 0.3, 1.5)])
}

fn problem(random: &mut Random, most: usize) -> Vec<Record> {
    let noise = 10.0_f64.powf(random.uniform(-6.0, -1.0));
    (0..1 + random.below(2))
        .map(|_| {
            let m = 40 + random.below(most);
            let step = random.uniform(0.01, 0.05);
            let rest = record(step, vec![vec![0.0; m], random.steps(m, 40), random.steps(m, 9)]);
            let mut y = respond(&[truth()], &rest, &[]).unwrap().remove(0);
            y.iter_mut().for_each(|v| *v += noise * random.normal());
            with_signal(&rest, 0, y)
        })
        .collect()
}

#[test]
fn cell_bounds_do_not_exceed_residuals_of_their_orders() {
    let mut random = Random::new(1201);
    let (mut points, mut cells, mut telling, mut tight, mut most) = (0, 0, [0, 0], 0, [0.0_f64; 2]);
    for _ in 0..40 {
        let records = problem(&mut random, 160);
        for _ in 0..60 {
            let count = 1 + random.below(4);
            let terms: Vec<(usize, f64, f64)> = (0..count)
                .map(|_| {
                    let half = 10.0_f64.powf(random.uniform(-4.0, -1.0));
                    let half = if random.chance(0.1) { 0.0 } else { half };
                    (random.below(3), half + random.uniform(0.0, 2.2), half)
                })
                .collect();
            let middles: Vec<(usize, f64)> = terms.iter().map(|&(s, middle, _)| (s, middle)).collect();
            let largest = 10.0_f64.powf(random.uniform(0.3, 3.0));
            let goal = residual_squares(&records, 0, &middles).0 * random.uniform(0.1, 1.0);
            let (any, small) = cell_bounds(&records, 0, &terms, (largest, goal)).unwrap();
            let mut least = [f64::INFINITY; 2];
            for point in 0..12 {
                let inside = |random: &mut Random, &(signal, middle, half): &(usize, f64, f64)| {
                    // Corners, the middle, anywhere.
                    let share = match point {
                        0..=3 => 2.0 * f64::from(u8::from(random.chance(0.5))) - 1.0,
                        4 => 0.0,
                        _ => random.uniform(-1.0, 1.0),
                    };
                    (signal, middle + share * half)
                };
                let at: Vec<(usize, f64)> = terms.iter().map(|term| inside(&mut random, term)).collect();
                let (exact, limited) =
                    (residual_squares(&records, 0, &at).0, bounded_residual_squares(&records, 0, &at, largest));
                assert!(any <= exact, "{terms:?} at {at:?}: {any:e} above {exact:e}");
                assert!(small <= limited, "{terms:?} at {at:?} of {largest}: {small:e} above {limited:e}");
                least = [least[0].min(exact), least[1].min(limited)];
                points += 1;
            }
            cells += 1;
            for (n, bound) in [any, small].into_iter().enumerate() {
                most[n] = most[n].max(bound / least[n]);
                telling[n] += usize::from(bound > 0.5 * least[n]);
            }
            tight += usize::from(any > 0.95 * least[0]);
        }
    }
    println!("{points} orders in {cells} cells; {telling:?} bounds above half, {tight} above 95 %; at most {most:?}");
    assert!(points > 25_000 && telling[0] > 700 && tight > 300 && most[0] > 0.999, "{telling:?}, {tight}, {most:?}");
    assert!(telling[1] > 300 && most[1] > 0.8, "{telling:?}, {most:?}");
}

fn options_within(within: f64) -> CertificateOptions {
    CertificateOptions { tolerance: within, max_coefficient: 1e3, max_cells: 400_000, threads: 2, memory: 1 << 29 }
}

fn region() -> Region {
    let range = |signal, lowest, highest| Range { signal, lowest, highest };
    Region {
        output: 0,
        alpha: (1.2, 1.9),
        terms: vec![range(0, 0.5, 1.1), range(0, 0.0, 0.0), range(1, 0.0, 0.6)],
        min_separation: 0.1,
    }
}

#[test]
fn certificate_bounds_all_orders_of_a_region() {
    let mut random = Random::new(1202);
    let (mut drawn, mut best_share) = (0, 0.0_f64);
    for case in 0..4 {
        let records = problem(&mut random, 60);
        let region = region();
        let within = [0.05, 0.2, 0.5, 0.02][case];
        let found = certify(&records, &region, &options_within(within), &Control::default()).unwrap();
        let samples: usize = records.iter().map(Record::m).sum();
        let rmse = |alpha: f64, orders: &[f64]| {
            let terms: Vec<(usize, f64)> =
                region.terms.iter().zip(orders).map(|(t, order)| (t.signal, alpha - order)).collect();
            let (squares, size) = residual_squares(&records, 0, &terms);
            ((squares / samples as f64).sqrt(), size)
        };
        println!("{found:?}");
        let Certificate { lower_bound: at_least, best, order, ref orders, open_cells: open, .. } = found;
        // What is said to be reached is, as far as sums of squares of 1 tell a residual of 1e-5.
        assert!((rmse(order, orders).0 / best - 1.0).abs() < 1e-5, "{:?} {best}", rmse(order, orders));
        assert!(at_least <= best);
        if open == 0 {
            assert!(at_least >= (1.0 - within) * best * (1.0 - 1e-8));
        }
        let at = |random: &mut Random, spread: f64| {
            let alpha = (order + spread * random.uniform(-1.0, 1.0)).clamp(1.2, 1.9);
            let mut around = |range: &Range, order: f64| {
                (order + spread * random.uniform(-1.0, 1.0)).clamp(range.lowest, range.highest)
            };
            let orders: Vec<f64> = region.terms.iter().zip(orders).map(|(range, &o)| around(range, o)).collect();
            (alpha, orders)
        };
        for n in 0..4000 {
            // All over the region, and close to the best.
            let (alpha, orders) = at(&mut random, [2.0, 0.3, 0.03, 0.003][n % 4]);
            if alpha - orders[0] >= 0.1 && alpha - orders[2] >= 0.0 {
                let (score, size) = rmse(alpha, &orders);
                if size > 1e3 {
                    continue;
                }
                assert!(at_least <= score, "{alpha} {orders:?}: {score:e} below {at_least:e}");
                best_share = best_share.max(at_least / score);
                drawn += 1;
            }
        }
    }
    println!("{drawn} orders, at most {best_share} of the error of one proved");
    assert!(drawn > 12_000 && best_share > 0.9, "{drawn} {best_share}");
}

#[test]
fn threads_change_no_bit_and_cells_that_are_not_allowed_are_said() {
    let mut random = Random::new(1203);
    let records = problem(&mut random, 40);
    let of = |threads: usize, cells: u64| {
        certify(
            &records,
            &region(),
            &CertificateOptions { threads, max_cells: cells, ..options_within(0.3) },
            &Control::default(),
        )
    };
    let whole = of(1, 400_000).unwrap();
    assert_eq!(whole, of(3, 400_000).unwrap());
    let cut = of(2, whole.cells - 1).unwrap();
    assert!(cut.open_cells > 0 && cut.cells < whole.cells && cut.lower_bound <= whole.lower_bound);
    let error = of(1, 3).unwrap_err().to_string();
    assert!(error.contains("cells of orders") && error.contains("allow more"), "{error}");
}

#[test]
fn invalid_regions_are_rejected() {
    let mut random = Random::new(1204);
    let records = problem(&mut random, 40);
    let of = |region: &Region, within: f64| {
        certify(&records, region, &options_within(within), &Control::default()).unwrap_err().to_string()
    };
    for within in [0.0, 1.0, -0.1, f64::NAN, f64::INFINITY] {
        assert!(of(&region(), within).contains("tolerance"));
    }
    for alpha in [(0.0, 1.0), (1.9, 1.2), (f64::NAN, 1.0), (1.0, f64::INFINITY)] {
        assert!(of(&Region { alpha, ..region() }, 0.1).contains("alpha"));
    }
    for largest in [0.5, 1e10, f64::NAN, f64::INFINITY] {
        let error = certify(
            &records,
            &region(),
            &CertificateOptions { max_coefficient: largest, ..options_within(0.1) },
            &Control::default(),
        )
        .unwrap_err();
        assert!(error.to_string().contains("max_coefficient"), "{error}");
    }
    for min_separation in [0.0, -1.0, f64::NAN, 2.0] {
        assert!(of(&Region { min_separation, ..region() }, 0.1).contains("apart"));
    }
    let terms = |range: Range| Region { terms: vec![range], ..region() };
    assert!(of(&terms(Range { signal: 9, lowest: 0.0, highest: 1.0 }), 0.1).contains("signal 9"));
    assert!(of(&terms(Range { signal: 1, lowest: 1.0, highest: 0.0 }), 0.1).contains("interval of a term"));
    assert!(of(&terms(Range { signal: 1, lowest: f64::NAN, highest: 0.0 }), 0.1).contains("interval of a term"));
    assert!(of(&terms(Range { signal: 0, lowest: 1.85, highest: 2.0 }), 0.1).contains("no orders in these intervals"));
    assert!(of(&Region { terms: vec![], ..region() }, 0.1).contains("0 terms"));
    let error = certify(&[], &region(), &options_within(0.1), &Control::default()).unwrap_err().to_string();
    assert!(error.contains("no record"), "{error}");
    let silent = record(0.1, vec![vec![1.0; 50], vec![0.0; 50]]);
    let region = terms(Range { signal: 1, lowest: 0.0, highest: 1.0 });
    let error = certify(&[silent], &region, &options_within(0.1), &Control::default()).unwrap_err().to_string();
    assert!(error.contains("signal 1"), "{error}");
}
