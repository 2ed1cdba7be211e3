//! Candidates given as points: against the naive division, early termination, threads, and invalid orders.

use ftlm::order_search::control::Control;
use ftlm::order_search::given_points::{score_naive, Point, Points};
use ftlm::order_search::options::Norm;

use crate::common::{bits, check, record, Random};

const SIGNALS: [usize; 4] = [1, 0, 1, 2];

fn points(random: &mut Random, count: usize) -> Vec<Point> {
    (0..count)
        .map(|_| {
            let order = random.uniform(0.6, 2.0);
            Point {
                order,
                orders: vec![random.uniform(0.0, order), random.uniform(0.0, order - 0.05), 0.3, 0.0],
                coefficients: (0..4).map(|_| random.uniform(-3.0, 3.0)).collect(),
            }
        })
        .collect()
}

fn setting(m: usize) -> (ftlm::regressors::Record, Vec<Point>) {
    let mut random = Random::new(11);
    let signals = vec![random.signal(m), random.signal(m), random.steps(m, 25)];
    (record(0.01, signals), points(&mut random, 60))
}

fn build_points(records: Vec<ftlm::regressors::Record>, norm: Norm) -> Points {
    Points::new(records, 0, SIGNALS.to_vec(), vec![false, false, true], norm).unwrap()
}

#[test]
fn scores_are_those_of_the_naive_division() {
    let (record, points) = setting(300);
    let naive: Vec<f64> = points.iter().map(|p| score_naive(&record, 0, &SIGNALS, p)).collect();
    let mut fast = build_points(vec![record.clone(), record.clone()], Norm::L1);
    for _ in 0..2 {
        // The second time all regressors are kept ones.
        let found = fast.scores(&points, f64::INFINITY, 2, &Control::default()).unwrap();
        // A free run that grows multiplies the rounding of either program; one that stays near the output does not.
        let size: f64 = record.signal(0).iter().map(|y| y.abs()).sum();
        let bounded = |n: f64| n < 100.0 * size;
        let worst = |kept: bool| {
            let pairs = found.iter().zip(&naive).filter(|(_, n)| bounded(**n) == kept);
            pairs.map(|(f, n)| (f / (2.0 * n) - 1.0).abs()).fold(0.0, f64::max)
        };
        check("points against naive, relative", worst(true), 1e-8);
        check("points that grow against naive, relative", worst(false), 1e-4);
        assert!(naive.iter().filter(|n| bounded(**n)).count() > 15);
    }
    let squares =
        build_points(vec![record.clone()], Norm::L2).scores(&points, f64::INFINITY, 1, &Control::default()).unwrap();
    for (rmse, sum) in squares.iter().zip(&naive) {
        assert!(*rmse >= sum / 300.0, "{rmse:e} {:e}", sum / 300.0);
    }
}

#[test]
fn a_limit_removes_only_what_exceeds_it_and_threads_change_no_bit() {
    let (record, points) = setting(500);
    let all =
        build_points(vec![record.clone()], Norm::L1).scores(&points, f64::INFINITY, 1, &Control::default()).unwrap();
    let mut sorted = all.clone();
    sorted.sort_by(f64::total_cmp);
    let limit = sorted[20];
    for threads in [1, 2, 3, 8] {
        let found =
            build_points(vec![record.clone()], Norm::L1).scores(&points, limit, threads, &Control::default()).unwrap();
        let wanted: Vec<f64> = all.iter().map(|&s| if s <= limit { s } else { f64::INFINITY }).collect();
        assert_eq!(bits(&found), bits(&wanted));
    }
}

#[test]
fn invalid_orders_have_infinite_error_and_nan_is_rejected() {
    let (record, points) = setting(100);
    let mut fast = build_points(vec![record], Norm::L1);
    let mut wrong = vec![points[0].clone(), points[0].clone()];
    wrong[0].orders[1] = wrong[0].order;
    wrong[1].orders[0] = wrong[1].order + 0.1;
    let found = fast.scores(&wrong, f64::INFINITY, 1, &Control::default()).unwrap();
    assert!(found.iter().all(|s| s.is_infinite()));
    wrong[0].coefficients[0] = f64::NAN;
    assert!(fast.scores(&wrong, f64::INFINITY, 1, &Control::default()).is_err());
    wrong[0].coefficients.pop();
    assert!(fast.scores(&wrong, f64::INFINITY, 1, &Control::default()).is_err());
    assert!(Points::new(Vec::new(), 0, vec![0], vec![false], Norm::L1).is_err());
    let control = Control::default();
    control.stop.set();
    assert!(fast.scores(&points, f64::INFINITY, 1, &control).is_err());
}
