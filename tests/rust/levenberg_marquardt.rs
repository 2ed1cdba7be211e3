//! Levenberg–Marquardt by itself: problems whose minimum is known in closed form, and one that no step can lower.

use ftlm::error::{Error, Result};
use ftlm::estimation::optimization::damped_step::LeastSquaresProblem;
use ftlm::estimation::optimization::levenberg_marquardt::{minimize, MinimizationSettings, Status};

use crate::common::{check, dense_solve, distance, Random};

/// Residuals and their derivatives by formula, every parameter stepped as it is.
struct Closed<R, J> {
    residuals: R,
    jacobian: J,
}

impl<R, J> LeastSquaresProblem for Closed<R, J>
where
    R: Fn(&[f64]) -> Result<Vec<f64>>,
    J: Fn(&[f64]) -> Vec<Vec<f64>>,
{
    type Point = Vec<f64>;
    type Evaluation = Vec<f64>;

    fn evaluate(&self, point: &Vec<f64>) -> Result<Vec<f64>> {
        (self.residuals)(point)
    }

    fn residuals<'a>(&self, evaluation: &'a Vec<f64>) -> &'a [f64] {
        evaluation
    }

    fn jacobian(&self, point: &Vec<f64>, _: &Vec<f64>) -> Result<Vec<Vec<f64>>> {
        Ok((self.jacobian)(point))
    }

    fn apply_step(&self, point: &Vec<f64>, steps: &[f64]) -> (Vec<f64>, f64) {
        let next = point.iter().zip(steps).map(|(x, d)| x + d).collect();
        (next, steps.iter().fold(0.0, |a, d| a.max(d.abs())))
    }
}

fn settings(evaluations: usize) -> MinimizationSettings {
    MinimizationSettings { evaluations, tolerance: 1e-14 }
}

#[test]
fn minimum_of_rosenbrocks_function_is_found() {
    let problem = Closed {
        residuals: |x: &[f64]| Ok(vec![1.0 - x[0], 10.0 * (x[1] - x[0] * x[0])]),
        jacobian: |x: &[f64]| vec![vec![-1.0, -20.0 * x[0]], vec![0.0, 10.0]],
    };
    let found = minimize(&problem, vec![-1.2, 1.0], settings(200)).unwrap();
    assert_eq!(found.status, Status::Converged);
    check("distance from (1, 1)", distance(&found.point, &[1.0, 1.0]), 1e-10);
    check("cost", found.cost, 1e-20);
}

#[test]
fn linear_problem_has_the_solution_of_its_normal_equations() {
    let mut random = Random::new(501);
    let (n, k) = (40, 4);
    let columns: Vec<Vec<f64>> = (0..k).map(|_| random.signal(n)).collect();
    let target = random.signal(n);
    let problem = Closed {
        residuals: |x: &[f64]| {
            Ok((0..n).map(|i| columns.iter().zip(x).map(|(c, x)| c[i] * x).sum::<f64>() - target[i]).collect())
        },
        jacobian: |_: &[f64]| columns.clone(),
    };
    let found = minimize(&problem, vec![0.0; k], settings(50)).unwrap();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let gram: Vec<f64> = columns.iter().flat_map(|a| columns.iter().map(|b| dot(a, b))).collect();
    let rhs: Vec<f64> = columns.iter().map(|a| dot(a, &target)).collect();
    assert_eq!(found.status, Status::Converged);
    // The gradient's cosine at which the search ends is the root of its tolerance.
    check("linear least squares", distance(&found.point, &dense_solve(&gram, &rhs)), 1e-7);
}

#[test]
fn wrong_derivatives_cause_a_stall() {
    // The derivative has the wrong sign: every step, however short, raises the cost.
    let problem =
        Closed { residuals: |x: &[f64]| Ok(vec![1.0 + x[0] * x[0] + x[0]]), jacobian: |_: &[f64]| vec![vec![-1.0]] };
    let found = minimize(&problem, vec![0.0], MinimizationSettings { evaluations: 1000, tolerance: 0.0 }).unwrap();
    assert_eq!(found.status, Status::Stalled);
    assert_eq!(found.point, [0.0]);
}

#[test]
fn steps_outside_the_domain_are_shortened() {
    // ln x − 3 from x = 1: the full step is past nothing, but from x = 0.01 Gauss–Newton's is.
    let problem = Closed {
        residuals: |x: &[f64]| {
            if x[0] > 25.0 || x[0] <= 0.0 {
                return Err(Error::Diverged { what: "logarithm".into(), index: 0 });
            }
            Ok(vec![x[0].ln() - 3.0])
        },
        jacobian: |x: &[f64]| vec![vec![1.0 / x[0]]],
    };
    let found = minimize(&problem, vec![24.9], settings(200)).unwrap();
    check("e^3", (found.point[0] - 3.0_f64.exp()).abs(), 1e-9);
}

#[test]
fn few_evaluations_and_bad_columns_are_reported() {
    let rosenbrock = Closed {
        residuals: |x: &[f64]| Ok(vec![1.0 - x[0], 10.0 * (x[1] - x[0] * x[0])]),
        jacobian: |x: &[f64]| vec![vec![-1.0, -20.0 * x[0]], vec![0.0, 10.0]],
    };
    let found = minimize(&rosenbrock, vec![-1.2, 1.0], settings(3)).unwrap();
    assert_eq!((found.status, found.evaluations), (Status::Exhausted, 3));
    let short = Closed { residuals: |_: &[f64]| Ok(vec![1.0, 2.0]), jacobian: |_: &[f64]| vec![vec![1.0]] };
    assert!(matches!(minimize(&short, vec![0.0], settings(3)), Err(Error::Length { .. })));
    let nowhere = Closed {
        residuals: |_: &[f64]| Err(Error::Diverged { what: "simulation".into(), index: 3 }),
        jacobian: |_: &[f64]| Vec::new(),
    };
    assert!(matches!(minimize(&nowhere, vec![0.0], settings(3)), Err(Error::Diverged { .. })));
}

/// Half of (x − 3)² + (x + 2y − 4)² with x within bounds, a value only up to a wall, and a size for its rounding.
struct Boxed {
    bounds: (f64, f64),
    wall: f64,
    corner: bool,
}

impl LeastSquaresProblem for Boxed {
    type Point = [f64; 2];
    type Evaluation = Vec<f64>;

    fn evaluate(&self, x: &[f64; 2]) -> Result<Vec<f64>> {
        if x[0] > self.wall {
            return Err(Error::Diverged { what: "simulation".into(), index: 0 });
        }
        // With a corner at 2 the way back is as steep as the way on.
        let turned = if self.corner && x[0] > 2.0 { 4.0 - x[0] } else { x[0] };
        Ok(vec![turned - 3.0, x[0] + 2.0 * x[1] - 4.0, 1.0])
    }

    fn residuals<'a>(&self, evaluation: &'a Vec<f64>) -> &'a [f64] {
        evaluation
    }

    fn jacobian(&self, x: &[f64; 2], _: &Vec<f64>) -> Result<Vec<Vec<f64>>> {
        let turned = if self.corner && x[0] > 2.0 { -1.0 } else { 1.0 };
        Ok(vec![vec![turned, 1.0, 0.0], vec![0.0, 2.0, 0.0]])
    }

    fn apply_step(&self, x: &[f64; 2], steps: &[f64]) -> ([f64; 2], f64) {
        let next = [(x[0] + steps[0]).clamp(self.bounds.0, self.bounds.1), x[1] + steps[1]];
        (next, (next[0] - x[0]).abs().max(steps[1].abs()))
    }

    fn distance_to_bounds(&self, x: &[f64; 2], parameter: usize) -> (f64, f64) {
        if parameter == 0 {
            (x[0] - self.bounds.0, self.bounds.1 - x[0])
        } else {
            (f64::INFINITY, f64::INFINITY)
        }
    }

    fn has_kinks(&self, _: &[f64; 2], parameter: usize) -> bool {
        self.corner && parameter == 0
    }
}

const OPEN: Boxed = Boxed { bounds: (-10.0, 10.0), wall: 20.0, corner: false };

#[test]
fn active_bound_does_not_prevent_convergence_of_other_parameters() {
    for (bounds, x) in [((-10.0, 10.0), 3.0), ((-10.0, 1.0), 1.0), ((4.0, 10.0), 4.0), ((0.5, 0.5), 0.5)] {
        let start = [0.0_f64.clamp(bounds.0, bounds.1), -7.0];
        let found =
            minimize(&Boxed { bounds, ..OPEN }, start, MinimizationSettings { evaluations: 60, tolerance: 1e-12 })
                .unwrap();
        assert_eq!((found.status, found.point[0]), (Status::Converged, if x == 3.0 { found.point[0] } else { x }));
        check("minimum within bounds", (found.point[0] - x).abs().max((found.point[1] - 0.5 * (4.0 - x)).abs()), 1e-5);
        assert!(found.evaluations < 20, "{}", found.evaluations);
    }
}

#[test]
fn start_on_a_bound_moves_inside_along_the_gradient() {
    let found = minimize(&Boxed { bounds: (-10.0, 5.0), ..OPEN }, [5.0, 0.0], MinimizationSettings::default()).unwrap();
    assert_eq!(found.status, Status::Converged);
    check("minimum inside", (found.point[0] - 3.0).abs(), 1e-4);
}

#[test]
fn point_at_the_domain_limit_has_not_converged() {
    let found =
        minimize(&Boxed { wall: 1.0, ..OPEN }, [0.0, 0.0], MinimizationSettings { evaluations: 500, tolerance: 1e-9 });
    let found = found.unwrap();
    assert_eq!(found.status, Status::DomainLimit);
    assert!(found.point[0] <= 1.0 && found.point[0] > 0.99, "{:?}", found.point);
}

#[test]
fn minimization_converges_at_a_kink_of_the_cost() {
    let corner = Boxed { corner: true, ..OPEN };
    let found = minimize(&corner, [0.0, 0.0], MinimizationSettings { evaluations: 500, tolerance: 1e-9 }).unwrap();
    assert_eq!(found.status, Status::Converged);
    check("corner", (found.point[0] - 2.0).abs().max((found.point[1] - 1.0).abs()), 1e-4);
}

#[test]
fn a_short_step_is_no_minimum() {
    // Slopes that lie, and a tolerance that every damped step falls below before the damping ends.
    let problem =
        Closed { residuals: |x: &[f64]| Ok(vec![1.0 + x[0] * x[0] + x[0]]), jacobian: |_: &[f64]| vec![vec![-1.0]] };
    let found = minimize(&problem, vec![0.0], MinimizationSettings { evaluations: 1000, tolerance: 1e-6 }).unwrap();
    assert_eq!(found.status, Status::Stalled);
}

/// The problem of Brown & Dennis: residuals of some hundred each at its minimum of 85822.2, where Gauss–Newton creeps
/// (Moré, Garbow & Hillstrom, doi:10.1145/355934.355936, problem 16).
#[test]
fn large_residuals_use_secant_curvature() {
    let time = |i: usize| (i + 1) as f64 / 5.0;
    let parts = move |x: &[f64], i: usize| {
        let t = time(i);
        (x[0] + t * x[1] - t.exp(), x[2] + t.sin() * x[3] - t.cos())
    };
    let problem = Closed {
        residuals: move |x: &[f64]| Ok((0..20).map(|i| parts(x, i)).map(|(a, b)| a * a + b * b).collect()),
        jacobian: move |x: &[f64]| {
            let column = |of: &dyn Fn(f64, f64, f64) -> f64| {
                (0..20)
                    .map(|i| {
                        let (a, b) = parts(x, i);
                        of(a, b, time(i))
                    })
                    .collect::<Vec<f64>>()
            };
            vec![
                column(&|a, _, _| 2.0 * a),
                column(&|a, _, t| 2.0 * a * t),
                column(&|_, b, _| 2.0 * b),
                column(&|_, b, t| 2.0 * b * t.sin()),
            ]
        },
    };
    let settings = MinimizationSettings { evaluations: 40, tolerance: 1e-12 };
    let found = minimize(&problem, vec![25.0, 5.0, -5.0, -1.0], settings).unwrap();
    assert_eq!(found.status, Status::Converged, "{} evaluations, {}", found.evaluations, found.cost);
    check("Brown & Dennis", (2.0 * found.cost / 85_822.201_626_356_3 - 1.0).abs(), 1e-8);
}

/// Along y = x² the way to x = 12 is long beside what a step may leave the bottom, as with numbers that data hardly tell
/// apart. Step by step, 2000 evaluations end at x = 9.6.
#[test]
fn extrapolation_steps_save_evaluations_in_a_curved_valley() {
    let problem = Closed {
        residuals: |x: &[f64]| Ok(vec![50.0 * (x[1] - x[0] * x[0]), 0.1 * (x[0] - 12.0), 3.0]),
        jacobian: |x: &[f64]| vec![vec![-100.0 * x[0], 0.1, 0.0], vec![50.0, 0.0, 0.0]],
    };
    let settings = MinimizationSettings { evaluations: 400, tolerance: 1e-12 };
    let found = minimize(&problem, vec![0.0, 0.0], settings).unwrap();
    assert_eq!(found.status, Status::Converged, "{} evaluations, {}", found.evaluations, found.cost);
    check("end of the valley", (found.point[0] - 12.0).abs(), 1e-2);
    check("cost", (found.cost / 4.5 - 1.0).abs(), 1e-8);
}

/// A leap that ends higher is taken back: residuals that grow beyond any bound wherever it may land.
#[test]
fn failed_extrapolation_step_is_rejected() {
    let tried = std::cell::RefCell::new(Vec::new());
    let problem = Closed {
        residuals: |x: &[f64]| {
            tried.borrow_mut().push(x[0]);
            let beyond = (x[0] - 3.0).max(0.0);
            Ok(vec![50.0 * (x[1] - x[0] * x[0]), 0.1 * (x[0] - 3.0) + 1e3 * beyond, 3.0])
        },
        jacobian: |x: &[f64]| {
            let slope = if x[0] > 3.0 { 1e3 + 0.1 } else { 0.1 };
            vec![vec![-100.0 * x[0], slope, 0.0], vec![50.0, 0.0, 0.0]]
        },
    };
    let found =
        minimize(&problem, vec![0.0, 0.0], MinimizationSettings { evaluations: 600, tolerance: 1e-12 }).unwrap();
    assert!(tried.borrow().iter().any(|x| *x > 3.0), "no leap went too far: the test says nothing");
    check("end of the valley", (found.point[0] - 3.0).abs(), 1e-2);
    check("cost", (found.cost / 4.5 - 1.0).abs(), 1e-6);
}
