//! What Gauss–Newton leaves out of the curvature of a sum of squares: Σ e ∇²e, learnt from the steps that were taken.
//!
//! Where a model leaves out a part of a machine its residuals stay large, and along a valley their own curvature is as
//! large as that of the columns: Gauss–Newton then creeps. The secant updates of Dennis, Gay & Welsch (NL2SOL,
//! doi:10.1145/355958.355965) cost no evaluation, and are used only where they foretell the cost better.

/// A model must be better by this factor at the last step to be taken for the next one.
const BETTER: f64 = 1.5;
/// Predictions closer to the truth than this share of the fall are both right.
const RIGHT: f64 = 0.1;

/// The learnt matrix, in the coordinates of the steps, and whether it is used.
pub(crate) struct Curvature {
    count: usize,
    matrix: Vec<f64>,
    learnt: bool,
    pub(crate) used: bool,
}

impl Curvature {
    /// Nothing known of so many parameters.
    pub(crate) fn new(count: usize) -> Self {
        Self { count, matrix: vec![0.0; count * count], learnt: false, used: false }
    }

    /// Whether it is of so many parameters.
    pub(crate) fn is_for(&self, count: usize) -> bool {
        self.count == count
    }

    /// An element of the matrix.
    pub(crate) fn at(&self, i: usize, j: usize) -> f64 {
        self.matrix[i * self.count + j]
    }

    fn times(&self, step: &[f64]) -> Vec<f64> {
        self.matrix.chunks_exact(self.count.max(1)).map(|row| row.iter().zip(step).map(|(a, s)| a * s).sum()).collect()
    }

    /// Its share of the second-order change of twice the cost along a step.
    pub(crate) fn along(&self, step: &[f64]) -> f64 {
        self.times(step).iter().zip(step).map(|(a, s)| a * s).sum()
    }

    /// Compares what was foretold without the matrix, and with it, with the fall of the cost.
    pub(crate) fn judge(&mut self, without: f64, with: f64, fall: f64) {
        let (missed, missed_with) = ((without - fall).abs(), (with - fall).abs());
        if self.used {
            self.used = missed_with <= BETTER * missed;
        } else {
            self.used = self.learnt && missed > RIGHT * fall.abs() && BETTER * missed_with < missed;
        }
    }

    /// Learns from a step after which the gradient had changed by `change`, of which `columns` is what the columns say.
    pub(crate) fn learn(&mut self, step: &[f64], change: &[f64], columns: &[f64]) {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let wanted: Vec<f64> = change.iter().zip(columns).map(|(y, c)| y - c).collect();
        let scale = dot(change, step);
        let size = dot(step, step).sqrt() * dot(change, change).sqrt();
        if !(scale.is_finite() && scale.abs() > 1e-6 * size && size > 0.0) {
            return;
        }
        // What was learnt elsewhere counts no more than what is seen here.
        let before = self.along(step);
        let sizing = if before == 0.0 { 1.0 } else { (dot(step, &wanted) / before).abs().min(1.0) };
        self.matrix.iter_mut().for_each(|v| *v *= sizing);
        let missing: Vec<f64> = wanted.iter().zip(self.times(step)).map(|(w, s)| w - s).collect();
        let twice = dot(&missing, step) / (scale * scale);
        for i in 0..self.count {
            for j in 0..self.count {
                self.matrix[i * self.count + j] +=
                    (missing[i] * change[j] + change[i] * missing[j]) / scale - twice * change[i] * change[j];
            }
        }
        self.learnt = self.matrix.iter().all(|v| v.is_finite());
        if !self.learnt {
            *self = Self::new(self.count);
        }
    }
}
