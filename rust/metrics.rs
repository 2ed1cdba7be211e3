//! How far a response is from a measurement: error (45), RMSE (46), NR (47), fit.

/// The four figures of one output over the M pulses of a record.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Metrics {
    /// Σ|y − ŷ| (paper (45)), in the unit of the output.
    pub error: f64,
    /// √(Σ(y − ŷ)²/M) (paper (46), with its sum).
    pub rmse: f64,
    /// RMSE / σ(y), σ over M (paper (47) as its tables use it).
    pub nr: f64,
    /// 100·(1 − ‖y − ŷ‖/‖y − ȳ‖) in percent.
    pub fit_percent: f64,
}

/// Compares a measurement with residuals e = y − ŷ of the same length. Not finite where the residuals are not.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn metrics(measured: &[f64], residuals: &[f64]) -> Metrics {
    let m = measured.len() as f64;
    let mean = measured.iter().sum::<f64>() / m;
    let deviation = measured.iter().map(|y| (y - mean) * (y - mean)).sum::<f64>();
    let error = residuals.iter().map(|e| e.abs()).sum::<f64>();
    // A diverged response squares to infinity before its own size does.
    let largest = residuals.iter().fold(0.0_f64, |a, e| a.max(e.abs()));
    let squares = if largest > 1e150 { f64::INFINITY } else { residuals.iter().map(|e| e * e).sum::<f64>() };
    let error = if error.is_nan() { f64::INFINITY } else { error };
    let squares = if squares.is_nan() { f64::INFINITY } else { squares };
    let nr = (squares / deviation).sqrt();
    Metrics { error, rmse: (squares / m).sqrt(), nr, fit_percent: 100.0 * (1.0 - nr) }
}
