//! Normal priors of the parameters of a least-squares problem.
//!
//! A prior N(mean, deviation²) of a parameter adds the residual (mean − value)/deviation. If the other residuals are in
//! standard deviations of the noise, the minimum is the maximum of the posterior density.

use super::damped_step::LeastSquaresProblem;
use super::levenberg_marquardt::{minimize, MinimizationSettings, Minimum};
use crate::error::Result;

/// Normal prior distribution of a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prior {
    /// Index of the parameter.
    pub parameter: usize,
    /// Mean.
    pub mean: f64,
    /// Standard deviation, positive.
    pub deviation: f64,
}

/// Least-squares problem with priors. Their residuals follow those of the problem itself.
struct ProblemWithPriors<'a, P: LeastSquaresProblem> {
    problem: &'a P,
    priors: &'a [Prior],
    /// Value of a parameter at a point.
    value: fn(&P::Point, usize) -> f64,
}

impl<P: LeastSquaresProblem> LeastSquaresProblem for ProblemWithPriors<'_, P> {
    type Point = P::Point;
    type Evaluation = (P::Evaluation, Vec<f64>);

    fn evaluate(&self, point: &P::Point) -> Result<Self::Evaluation> {
        let evaluation = self.problem.evaluate(point)?;
        let mut residuals = self.problem.residuals(&evaluation).to_vec();
        let residual = |prior: &Prior| (prior.mean - (self.value)(point, prior.parameter)) / prior.deviation;
        residuals.extend(self.priors.iter().map(residual));
        Ok((evaluation, residuals))
    }

    fn residuals<'e>(&self, evaluation: &'e Self::Evaluation) -> &'e [f64] {
        &evaluation.1
    }

    fn jacobian(&self, point: &P::Point, evaluation: &Self::Evaluation) -> Result<Vec<Vec<f64>>> {
        let mut jacobian = self.problem.jacobian(point, &evaluation.0)?;
        for (parameter, derivatives) in jacobian.iter_mut().enumerate() {
            let derivative = |p: &Prior| if p.parameter == parameter { -1.0 / p.deviation } else { 0.0 };
            derivatives.extend(self.priors.iter().map(derivative));
        }
        Ok(jacobian)
    }

    fn release(&self, evaluation: &mut Self::Evaluation) {
        self.problem.release(&mut evaluation.0);
    }

    fn apply_step(&self, point: &P::Point, steps: &[f64]) -> (P::Point, f64) {
        self.problem.apply_step(point, steps)
    }

    fn point_of_evaluation(&self, evaluation: &Self::Evaluation, point: P::Point) -> P::Point {
        self.problem.point_of_evaluation(&evaluation.0, point)
    }

    fn is_eliminated(&self, parameter: usize) -> bool {
        self.problem.is_eliminated(parameter)
    }

    fn coordinate_derivative(&self, point: &P::Point, parameter: usize) -> f64 {
        self.problem.coordinate_derivative(point, parameter)
    }

    fn coupled_derivatives(&self, point: &P::Point, parameter: usize) -> Vec<(usize, f64)> {
        self.problem.coupled_derivatives(point, parameter)
    }

    fn distance_to_bounds(&self, point: &P::Point, parameter: usize) -> (f64, f64) {
        self.problem.distance_to_bounds(point, parameter)
    }

    fn constraints(&self, point: &P::Point) -> Vec<(Vec<f64>, f64)> {
        self.problem.constraints(point)
    }

    fn has_kinks(&self, point: &P::Point, parameter: usize) -> bool {
        self.problem.has_kinks(point, parameter)
    }

    fn signal_norm(&self, evaluation: &Self::Evaluation) -> f64 {
        self.problem.signal_norm(&evaluation.0)
    }

    fn is_admissible(&self, point: &P::Point) -> bool {
        self.problem.is_admissible(point)
    }

    fn allows_extrapolation(&self) -> bool {
        self.problem.allows_extrapolation()
    }

    fn starts_near_optimum(&self) -> bool {
        self.problem.starts_near_optimum()
    }
}

/// Minimum of a problem, and its residuals followed by those of the priors.
type PosteriorMode<P> = (Minimum<<P as LeastSquaresProblem>::Point, <P as LeastSquaresProblem>::Evaluation>, Vec<f64>);

/// Minimize half the sum of squared residuals of a problem and its priors.
///
/// `value` returns the value of a parameter at a point. A parameter with a prior must not be eliminated (variable
/// projection). Return the minimum and its residuals, followed by those of the priors. The Jacobian includes the
/// derivatives of these residuals.
///
/// # Errors
/// See [`minimize`].
pub(crate) fn minimize_with_priors<P: LeastSquaresProblem>(
    problem: &P,
    priors: &[Prior],
    value: fn(&P::Point, usize) -> f64,
    start: P::Point,
    settings: MinimizationSettings,
) -> Result<PosteriorMode<P>> {
    if priors.is_empty() {
        let minimum = minimize(problem, start, settings)?;
        let residuals = problem.residuals(&minimum.evaluation).to_vec();
        return Ok((minimum, residuals));
    }
    let minimum = minimize(&ProblemWithPriors { problem, priors, value }, start, settings)?;
    let Minimum { point, evaluation: (evaluation, residuals), cost, jacobian, evaluations, status } = minimum;
    Ok((Minimum { point, evaluation, cost, jacobian, evaluations, status }, residuals))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::joint_fit::covariance::covariance_of_residuals;

    /// Residuals of two samples: 3 − x − y and 1 − x + y.
    struct Line;

    impl LeastSquaresProblem for Line {
        type Point = [f64; 2];
        type Evaluation = [f64; 2];

        fn evaluate(&self, [x, y]: &[f64; 2]) -> Result<[f64; 2]> {
            Ok([3.0 - x - y, 1.0 - x + y])
        }

        fn residuals<'e>(&self, evaluation: &'e [f64; 2]) -> &'e [f64] {
            evaluation
        }

        fn jacobian(&self, _: &[f64; 2], _: &[f64; 2]) -> Result<Vec<Vec<f64>>> {
            Ok(vec![vec![-1.0, -1.0], vec![-1.0, 1.0]])
        }

        fn apply_step(&self, point: &[f64; 2], steps: &[f64]) -> ([f64; 2], f64) {
            ([point[0] + steps[0], point[1] + steps[1]], steps[0].abs().max(steps[1].abs()))
        }
    }

    #[test]
    fn prior_is_equivalent_to_an_observation() -> Result<()> {
        // Without the prior, x = 2 and y = 1, both with variance 1/2. The prior x = 5 has the same variance.
        let priors = [Prior { parameter: 0, mean: 5.0, deviation: 0.5_f64.sqrt() }];
        let value = |point: &[f64; 2], parameter: usize| point[parameter];
        let settings = MinimizationSettings { evaluations: 100, tolerance: 1e-18 };
        let (minimum, residuals) = minimize_with_priors(&Line, &priors, value, [0.0, 0.0], settings)?;
        assert!((minimum.point[0] - 3.5).abs() < 1e-7 && (minimum.point[1] - 1.0).abs() < 1e-7, "{:?}", minimum.point);
        assert!((residuals[2] - 1.5 / 0.5_f64.sqrt()).abs() < 1e-7);
        assert!((minimum.cost - 0.5 * residuals.iter().map(|e| e * e).sum::<f64>()).abs() < 1e-12);
        let covariance = covariance_of_residuals(&minimum.jacobian, &[], 1.0, 1)?;
        let expected = [0.25, 0.0, 0.0, 0.5];
        assert!(covariance.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{covariance:?}");
        Ok(())
    }
}
