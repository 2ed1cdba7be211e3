//! Nonlinear least squares by Levenberg–Marquardt, for any problem that can say its residuals and their derivatives.
//!
//! Columns are scaled by the Jacobian's norms, steps follow from a QR factor of [J | e] with the damping below it, and a
//! rejected step costs no Jacobian. A problem says itself how a point moves: in which coordinates, and within which bounds.

use crate::dense;
use crate::error::{check_length, Error, Result};
use crate::small::back_substitute;

/// Damping of the first step: near Gauss–Newton's, yet safe where a start is some tens of percent off.
const FIRST_DAMPING: f64 = 1e-3;
/// Least damping: below it the factor's rounding damps more.
const LEAST_DAMPING: f64 = 1e-12;
/// Damping beyond which a step is shorter than rounding.
const LARGEST_DAMPING: f64 = 1e12;
/// An accepted step lowers the damping by this factor, a rejected one raises it by as much.
const FACTOR: f64 = 10.0;

/// A sum of squares to minimise.
pub trait Problem {
    /// What the residuals depend on.
    type Point: Clone;
    /// Residuals at a point, with whatever their derivatives there need.
    type Evaluation;

    /// Evaluates a point. [`Error::Diverged`] and [`Error::LeadingZero`] mean that a step went too far: it is shortened.
    ///
    /// # Errors
    /// Any other error ends the search.
    fn evaluate(&self, point: &Self::Point) -> Result<Self::Evaluation>;

    /// The residuals of an evaluation.
    fn residuals<'a>(&self, evaluation: &'a Self::Evaluation) -> &'a [f64];

    /// Derivatives of the residuals with respect to every parameter, one column each.
    ///
    /// # Errors
    /// As [`Problem::evaluate`]; [`Error::Diverged`] counts as a step too far.
    fn jacobian(&self, point: &Self::Point, evaluation: &Self::Evaluation) -> Result<Vec<Vec<f64>>>;

    /// The point moved by steps in the parameters' coordinates, within its bounds, and the largest relative move.
    fn moved(&self, point: &Self::Point, steps: &[f64]) -> (Self::Point, f64);

    /// Derivative of a parameter with respect to the coordinate in which it is stepped.
    fn stretch(&self, _point: &Self::Point, _parameter: usize) -> f64 {
        1.0
    }

    /// Whether a point may be trusted: from one that may, no step leads to one that may not.
    fn trusted(&self, _point: &Self::Point) -> bool {
        true
    }
}

/// Where the search for the optimum ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Neither the cost nor the parameters move any more.
    Converged,
    /// The last allowed iteration still moved.
    Exhausted,
    /// No step lowers the cost although the gradient is not zero.
    Stalled,
}

/// How long to search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Most evaluations of the residuals.
    pub evaluations: usize,
    /// Relative change of the cost, and of the parameters, at which the search ends.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { evaluations: 100, tolerance: 1e-10 }
    }
}

/// A minimum, or where the search for it ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Minimum<P, E> {
    /// The best point.
    pub point: P,
    /// Its evaluation.
    pub evaluation: E,
    /// Half the sum of squared residuals.
    pub cost: f64,
    /// Derivatives of the residuals there, one column a parameter.
    pub jacobian: Vec<Vec<f64>>,
    /// Evaluations of residuals.
    pub evaluations: usize,
    /// How it ended.
    pub status: Status,
}

/// Half the sum of squares.
fn cost(residuals: &[f64]) -> f64 {
    0.5 * residuals.iter().map(|e| e * e).sum::<f64>()
}

/// R of the QR factorisation of [J | e] with J in coordinates and unit columns, and the columns' norms.
fn scaled_factor<P: Problem>(
    problem: &P,
    point: &P::Point,
    jacobian: &[Vec<f64>],
    residuals: &[f64],
) -> (Vec<f64>, Vec<f64>) {
    let mut columns = Vec::with_capacity(jacobian.len() + 1);
    let mut scales = Vec::with_capacity(jacobian.len());
    for (i, column) in jacobian.iter().enumerate() {
        let factor = problem.stretch(point, i);
        let norm = column.iter().map(|v| (v * factor) * (v * factor)).sum::<f64>().sqrt();
        let scale = if norm > 0.0 { factor / norm } else { 0.0 };
        columns.push(column.iter().map(|v| v * scale).collect());
        scales.push(norm);
    }
    columns.push(residuals.to_vec());
    (dense::triangular_factor(&columns), scales)
}

/// Minimises ‖R s + e‖² + λ‖s‖² for the triangular factor of [J | e].
fn damped_step(r: &[f64], k: usize, stride: usize, damping: f64) -> Vec<f64> {
    let mut columns: Vec<Vec<f64>> = (0..k)
        .map(|j| {
            let mut column = vec![0.0; 2 * k];
            for i in 0..=j {
                column[i] = r[i * stride + j];
            }
            column[k + j] = damping.sqrt();
            column
        })
        .collect();
    let mut target = vec![0.0; 2 * k];
    for (i, value) in target.iter_mut().take(k).enumerate() {
        *value = -r[i * stride + k];
    }
    columns.push(target);
    let q = dense::triangular_factor(&columns);
    let rhs: Vec<f64> = (0..k).map(|i| q[i * (k + 1) + k]).collect();
    back_substitute(&q, k + 1, &rhs)
}

/// Minimises half the sum of squared residuals from a start. An evaluation costs what the problem says, a step O(k² N)
/// for k parameters and N residuals.
///
/// # Errors
/// As the problem's own at the start; [`Error::Length`] for columns of the Jacobian that do not match the residuals.
///
/// ```
/// use ftlm::error::Result;
/// use ftlm::estimate::output_error::levenberg_marquardt::{minimise, Problem, Settings};
///
/// /// x² − 2.
/// struct Root;
///
/// impl Problem for Root {
///     type Point = f64;
///     type Evaluation = [f64; 1];
///     fn evaluate(&self, x: &f64) -> Result<[f64; 1]> {
///         Ok([x * x - 2.0])
///     }
///     fn residuals<'a>(&self, evaluation: &'a [f64; 1]) -> &'a [f64] {
///         evaluation
///     }
///     fn jacobian(&self, x: &f64, _: &[f64; 1]) -> Result<Vec<Vec<f64>>> {
///         Ok(vec![vec![2.0 * x]])
///     }
///     fn moved(&self, x: &f64, steps: &[f64]) -> (f64, f64) {
///         (x + steps[0], steps[0].abs())
///     }
/// }
///
/// # fn main() -> Result<()> {
/// let found = minimise(&Root, 1.0, Settings::default())?;
/// assert!((found.point - 2.0_f64.sqrt()).abs() < 1e-9);
/// # Ok(())
/// # }
/// ```
pub fn minimise<P: Problem>(
    problem: &P,
    start: P::Point,
    settings: Settings,
) -> Result<Minimum<P::Point, P::Evaluation>> {
    let slopes_at = |point: &P::Point, evaluation: &P::Evaluation| -> Result<Vec<Vec<f64>>> {
        let jacobian = problem.jacobian(point, evaluation)?;
        let rows = problem.residuals(evaluation).len();
        jacobian.iter().try_for_each(|column| check_length("column of the Jacobian", rows, column.len()))?;
        Ok(jacobian)
    };
    let mut point = start;
    let mut current = problem.evaluate(&point)?;
    let mut least = cost(problem.residuals(&current));
    let mut jacobian = slopes_at(&point, &current)?;
    let mut evaluations = 1;
    let mut trusted = problem.trusted(&point);
    let mut damping = FIRST_DAMPING;
    let mut status = Status::Exhausted;
    'outer: while evaluations < settings.evaluations {
        let (r, scales) = scaled_factor(problem, &point, &jacobian, problem.residuals(&current));
        let k = scales.len();
        loop {
            let step = damped_step(&r, k, k + 1, damping);
            let steps: Vec<f64> =
                step.iter().zip(&scales).map(|(s, scale)| if *scale > 0.0 { s / scale } else { 0.0 }).collect();
            let (next, moved) = problem.moved(&point, &steps);
            if moved <= settings.tolerance {
                status = Status::Converged;
                break 'outer;
            }
            evaluations += 1;
            let trusts = problem.trusted(&next);
            // A step that lowers nothing, or leaves the numbers, is shortened.
            let accepted = match problem.evaluate(&next) {
                Ok(found) => {
                    let reached = cost(problem.residuals(&found));
                    if reached.is_finite() && reached < least && (trusts || !trusted) {
                        match slopes_at(&next, &found) {
                            Ok(slopes) => Some((found, reached, slopes)),
                            Err(Error::Diverged { .. }) => {
                                damping *= FACTOR;
                                if damping > LARGEST_DAMPING {
                                    status = Status::Stalled;
                                    break 'outer;
                                }
                                // The residuals were sound, so this try does not count towards the end.
                                continue;
                            }
                            Err(error) => return Err(error),
                        }
                    } else {
                        None
                    }
                }
                Err(Error::Diverged { .. } | Error::LeadingZero { .. }) => None,
                Err(error) => return Err(error),
            };
            if let Some((found, reached, slopes)) = accepted {
                let gain = (least - reached) / least.max(f64::MIN_POSITIVE);
                (point, current, least, jacobian, trusted) = (next, found, reached, slopes, trusts);
                damping = (damping * (1.0 / FACTOR)).max(LEAST_DAMPING);
                if gain <= settings.tolerance {
                    status = Status::Converged;
                    break 'outer;
                }
                break;
            }
            damping *= FACTOR;
            if damping > LARGEST_DAMPING {
                status = Status::Stalled;
                break 'outer;
            }
            if evaluations >= settings.evaluations {
                break 'outer;
            }
        }
    }
    Ok(Minimum { point, evaluation: current, cost: least, jacobian, evaluations, status })
}
