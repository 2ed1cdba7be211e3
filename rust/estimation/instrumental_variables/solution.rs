//! What the estimators by instrumental variables share: settings, solutions, sums of products, long-run covariances.

use crate::equation::{Equation, Structure};
use crate::error::{Error, Result};

/// Steps, at most: what has not stood still by then goes round.
const MOST_STEPS: usize = 1000;

/// How long to iterate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Most steps.
    pub iterations: usize,
    /// Change of every coefficient, relative to its size, at which the steps end.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { iterations: 30, tolerance: 1e-7 }
    }
}

impl Settings {
    /// Refuses settings with which no iteration ends.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for more than a thousand steps, and for a tolerance that is negative or no number.
    ///
    /// ```
    /// # use ftlm::estimation::instrumental_variables::Settings;
    /// assert!(Settings::default().check().is_ok());
    /// assert!(Settings { iterations: 1 << 20, ..Settings::default() }.check().is_err());
    /// ```
    pub fn check(&self) -> Result<()> {
        let refuse = |name: &str, value: f64, range: &str, remedy: &str| {
            Err(Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() })
        };
        if self.iterations > MOST_STEPS {
            #[allow(clippy::cast_precision_loss)]
            let steps = self.iterations as f64;
            let remedy = "what has not stood still by then goes round";
            return refuse("steps of instrumental variables", steps, &format!("[0, {MOST_STEPS}]"), remedy);
        }
        if !(self.tolerance >= 0.0 && self.tolerance.is_finite()) {
            let remedy = "give the relative change at which the steps end";
            return refuse("tolerance of instrumental variables", self.tolerance, "[0, ∞)", remedy);
        }
        Ok(())
    }
}

/// Coefficients of terms, then of the initial terms record by record.
pub type Solution = Vec<f64>;

/// (record, position) of the initial terms left out.
pub type Dropped = Vec<(usize, usize)>;

/// The equations that solutions make.
pub(super) fn equations(structures: &[Structure], solutions: &[Solution]) -> Vec<Equation> {
    let pairs = structures.iter().zip(solutions);
    pairs.map(|(s, x)| Equation { structure: s.clone(), coefficients: x[..s.terms.len()].to_vec() }).collect()
}

/// (exponent, coefficient) of the initial terms of record r that solutions hold, per equation.
pub(super) fn initial_terms(
    r: usize,
    structures: &[Structure],
    exponents: &[Vec<f64>],
    solutions: &[Solution],
) -> Vec<Vec<(f64, f64)>> {
    exponents
        .iter()
        .zip(structures)
        .zip(solutions)
        .map(|((exponents, s), x)| {
            let first = s.terms.len() + r * exponents.len();
            exponents.iter().copied().zip(x[first..].iter().copied()).collect()
        })
        .collect()
}

pub(super) fn unmoved(before: &[f64], after: &[f64], terms: usize, tolerance: f64) -> bool {
    let largest = after[..terms].iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    before[..terms].iter().zip(after).all(|(a, b)| (a - b).abs() <= tolerance * b.abs().max(1e-9 * largest))
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    // Four sums: one alone would wait for itself.
    let mut sums = [0.0; 4];
    let (left, right) = (a.chunks_exact(4), b.chunks_exact(4));
    let tail: f64 = left.remainder().iter().zip(right.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in left.zip(right) {
        for (sum, (x, y)) in sums.iter_mut().zip(x.iter().zip(y)) {
            *sum += x * y;
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + tail
}

/// The instruments of one record: columns, and the unknown that each belongs to.
pub(super) struct Instruments {
    pub(super) columns: Vec<Vec<f64>>,
    pub(super) places: Vec<usize>,
}

impl Instruments {
    fn of(&self, place: usize) -> Option<&Vec<f64>> {
        self.places.iter().position(|p| *p == place).map(|at| &self.columns[at])
    }
}

/// Less of an instrument than this outside the span of those before it is rounding.
const SPANNED: f64 = 1e-13;

/// Makes the instruments of all records orthonormal, a column over all records for each of k unknowns: the factor Q of a
/// QR factorisation, by Gram and Schmidt's process, done twice where it loses digits. They span what they did, so they
/// give the same estimate; their products with the regressors are as well conditioned as these, where those of the
/// instruments themselves are as badly as the square of that.
///
/// O(records · k² m), where k counts the unknowns that a record has.
///
/// # Errors
/// [`Error::Singular`] where one depends on those before it.
pub(super) fn orthonormal(records: &mut [Instruments], k: usize) -> Result<()> {
    let mut held = vec![0; k];
    records.iter().flat_map(|r| &r.places).for_each(|&place| held[place] += 1);
    let singular = |place| Error::Singular { index: place, count: k };
    // Unknowns of one record alone come first: those of different records are orthogonal as they are.
    for record in &mut *records {
        for at in (0..record.places.len()).filter(|&at| held[record.places[at]] == 1) {
            let mut column = [std::mem::take(&mut record.columns[at])];
            let spanned = twice(&mut column, |column| {
                for before in (0..at).filter(|&before| held[record.places[before]] == 1) {
                    remove(&mut column[0], &record.columns[before], None);
                }
            });
            if !spanned {
                return Err(singular(record.places[at]));
            }
            [record.columns[at]] = column;
        }
    }
    let shared: Vec<usize> = (0..k).filter(|&place| held[place] > 1).collect();
    for (n, &place) in shared.iter().enumerate() {
        // An unknown that not all records have is nothing in the others.
        let mut pieces: Vec<Vec<f64>> = records.iter().map(|r| r.of(place).cloned().unwrap_or_default()).collect();
        let spanned = twice(&mut pieces, |pieces| {
            for (piece, record) in pieces.iter_mut().zip(&*records).filter(|(piece, _)| !piece.is_empty()) {
                for (column, _) in record.columns.iter().zip(&record.places).filter(|(_, p)| held[**p] == 1) {
                    remove(piece, column, None);
                }
            }
            for &before in &shared[..n] {
                let pairs = records.iter().map(|r| r.of(before)).zip(&*pieces);
                let along =
                    pairs.map(|(q, piece)| q.filter(|_| !piece.is_empty()).map_or(0.0, |q| dot(q, piece))).sum();
                for (piece, record) in pieces.iter_mut().zip(&*records).filter(|(piece, _)| !piece.is_empty()) {
                    if let Some(q) = record.of(before) {
                        remove(piece, q, Some(along));
                    }
                }
            }
        });
        if !spanned {
            return Err(singular(place));
        }
        for (record, piece) in records.iter_mut().zip(pieces) {
            if let Some(at) = record.places.iter().position(|p| *p == place) {
                record.columns[at] = piece;
            }
        }
    }
    Ok(())
}

/// Takes so much of a direction out of a column, all of it where not told.
fn remove(column: &mut [f64], direction: &[f64], along: Option<f64>) {
    let along = along.unwrap_or_else(|| dot(direction, column));
    column.iter_mut().zip(direction).for_each(|(v, q)| *v -= along * q);
}

/// Takes out of a column what those before it span, once more where little was left, and scales what is left to unit size;
/// false where that is rounding.
fn twice(pieces: &mut [Vec<f64>], clear: impl Fn(&mut [Vec<f64>])) -> bool {
    let whole = size(pieces);
    let (mut before, mut left) = (whole, whole);
    for _ in 0..2 {
        clear(pieces);
        left = size(pieces);
        // What rounding left of the others weighs as much more as the column has shrunk.
        if left > 0.5 * before {
            break;
        }
        before = left;
    }
    let scale = 1.0 / left;
    pieces.iter_mut().flatten().for_each(|v| *v *= scale);
    left > SPANNED * whole && scale.is_finite() && left.is_finite()
}

fn size(pieces: &[Vec<f64>]) -> f64 {
    pieces.iter().map(|p| dot(p, p)).sum::<f64>().sqrt()
}

/// Adds the long-run covariance of the sums of scores to a k × k matrix, with Bartlett weights
/// (doi:10.2307/1913610): what the filter leaves behind is not white where other measured outputs enter the equation.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(super) fn long_run(scores: &[Vec<f64>], places: &[usize], meat: &mut [f64], k: usize) {
    let m = scores.first().map_or(0, Vec::len);
    let lags = ((4.0 * libm::cbrt(m as f64)) as usize).min(m.saturating_sub(1));
    for (left, &a) in scores.iter().zip(places) {
        for (right, &b) in scores.iter().zip(places) {
            meat[a * k + b] += dot(left, right);
            for lag in 1..=lags {
                let weight = 1.0 - lag as f64 / (lags + 1) as f64;
                let both = dot(&left[lag..], &right[..m - lag]) + dot(&left[..m - lag], &right[lag..]);
                meat[a * k + b] += weight * both;
            }
        }
    }
}
