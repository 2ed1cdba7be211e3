//! What a sum of squares must say of itself to be minimised.

use crate::error::Result;

/// A sum of squares to minimise.
pub trait Problem {
    /// What the residuals depend on.
    type Point: Clone;
    /// Residuals at a point, with whatever their derivatives there need.
    type Evaluation;

    /// Evaluates a point. [`crate::error::Error::Diverged`] and [`crate::error::Error::LeadingZero`] mean that a step went too far: it is shortened.
    ///
    /// # Errors
    /// Any other error ends the search.
    fn evaluate(&self, point: &Self::Point) -> Result<Self::Evaluation>;

    /// The residuals of an evaluation.
    fn residuals<'a>(&self, evaluation: &'a Self::Evaluation) -> &'a [f64];

    /// Derivatives of the residuals with respect to every parameter, one column each.
    ///
    /// # Errors
    /// As [`Problem::evaluate`]; [`crate::error::Error::Diverged`] counts as a step too far.
    fn jacobian(&self, point: &Self::Point, evaluation: &Self::Evaluation) -> Result<Vec<Vec<f64>>>;

    /// The point moved by steps in the parameters' coordinates, within its bounds, and the largest relative move.
    fn moved(&self, point: &Self::Point, steps: &[f64]) -> (Self::Point, f64);

    /// The point to which an evaluation belongs, where it solved for parameters in which the residuals are linear.
    fn settled(&self, _evaluation: &Self::Evaluation, point: Self::Point) -> Self::Point {
        point
    }

    /// Whether every evaluation solves for a parameter: its steps need no damping.
    fn projected(&self, _parameter: usize) -> bool {
        false
    }

    /// Derivative of a parameter with respect to the coordinate in which it is stepped.
    fn stretch(&self, _point: &Self::Point, _parameter: usize) -> f64 {
        1.0
    }

    /// Other parameters that move with a parameter's coordinate, and how much.
    fn carried(&self, _point: &Self::Point, _parameter: usize) -> Vec<(usize, f64)> {
        Vec::new()
    }

    /// How far a parameter may move down and up in its coordinate before it stands on a bound.
    fn room(&self, _point: &Self::Point, _parameter: usize) -> (f64, f64) {
        (f64::INFINITY, f64::INFINITY)
    }

    /// Whether the cost may have corners along a parameter: a minimum there has no slope.
    fn kinked(&self, _point: &Self::Point, _parameter: usize) -> bool {
        false
    }

    /// Norm of what the residuals are differences of, which bounds their rounding.
    fn size(&self, _evaluation: &Self::Evaluation) -> f64 {
        0.0
    }

    /// Whether a point may be trusted: from one that may, no step leads to one that may not.
    fn trusted(&self, _point: &Self::Point) -> bool {
        true
    }

    /// Whether a search may leap along valleys: not where many starts are to find an optimum each, which a leap may pass.
    fn leaps(&self) -> bool {
        true
    }
}
