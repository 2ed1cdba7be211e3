//! Systems of integrals of whole order, solved by running sums instead of transforms: O(n² K) a term.
//!
//! In pulse means I^η of whole order is h^η/(η+1)!·A(z)/(1−z)^η with an Eulerian polynomial A of degree η. Written in
//! powers of 1−z it is a sum of running sums Q^l, Q = 1/(1−z), l = 0 … η, so that a system of such integrals is
//! y = G₀ + Q(G₁ + Q(G₂ + …)), each G_l linear in the unknowns and in what drives them: one state for each sum. The sums
//! stay as small as the motion is, which a difference equation in y alone does not.

use crate::error::{check_length, Error, Result};
use crate::small;

/// Highest order of an integral: beyond it transforms are as good.
pub const MAX_SUMS: usize = 6;

/// Weights of the running sums Q^0 … Q^η in I^η of pulse means.
///
/// By Frobenius' identity they are h^η/(η+1)!·(−1)^{η−l}·(l+1)!·S(η+1, l+1), S Stirling's numbers of the second kind.
///
/// ```
/// // I^1 of a pulse: half of it within itself, all of it in every later one.
/// assert_eq!(ftlm::series::running_sums(1, 0.1), [-0.05, 0.1]);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn running_sums(eta: usize, step: f64) -> Vec<f64> {
    // S(η+1, l+1), row by row.
    let mut stirling = vec![1.0];
    for row in 1..=eta {
        let mut next = vec![0.0; row + 1];
        for (l, value) in next.iter_mut().enumerate() {
            let same = stirling.get(l).map_or(0.0, |s| (l + 1) as f64 * s);
            *value = same + if l > 0 { stirling[l - 1] } else { 0.0 };
        }
        stirling = next;
    }
    let scale = (1..=eta).fold(1.0, |product, k| product * step / (k + 1) as f64);
    let mut factorial = 1.0;
    let mut weights = Vec::with_capacity(eta + 1);
    for (l, number) in stirling.iter().enumerate() {
        factorial *= (l + 1) as f64;
        let sign = if (eta - l) % 2 == 0 { 1.0 } else { -1.0 };
        weights.push(scale * sign * factorial * number);
    }
    weights
}

/// What drives one equation: `weight` times I^`order` of a series.
#[derive(Debug, Clone, Copy)]
pub struct Source<'a> {
    /// The equation.
    pub equation: usize,
    /// Whole order of the integral.
    pub order: usize,
    /// What it weighs.
    pub weight: f64,
    /// The series.
    pub series: &'a [f64],
}

/// y_i = Σ c·I^η y_j + what drives, solved for any number of right-hand sides.
#[derive(Debug, Clone)]
pub struct Recursion {
    n: usize,
    /// Number of running sums of each equation.
    sums: usize,
    step: f64,
    /// What each unknown adds to each sum of each equation: `[(i·(sums + 1) + l)·n + j]`.
    own: Vec<f64>,
    /// Inverse of the matrix of leading coefficients, row by row.
    inverse: Vec<f64>,
}

impl Recursion {
    /// n equations with terms (i, j, η, c): c·I^η y_j in equation i; `sums` is the highest η of them and of all sources.
    ///
    /// # Errors
    /// [`Error::LeadingZero`] where the matrix of leading coefficients is singular, [`Error::Structure`] for an order
    /// above `sums`, or above [`MAX_SUMS`].
    pub fn new(n: usize, sums: usize, step: f64, terms: &[(usize, usize, usize, f64)]) -> Result<Self> {
        let highest = terms.iter().map(|&(.., order, _)| order).max().unwrap_or(0);
        if highest > sums || sums > MAX_SUMS {
            let what = format!("integrals of order {highest} by {sums} running sums");
            return Err(Error::Structure { what, remedy: format!("give the highest order, {MAX_SUMS} at most") });
        }
        let mut own = vec![0.0; n * (sums + 1) * n];
        let mut leading: Vec<f64> = (0..n * n).map(|at| f64::from(u8::from(at / n == at % n))).collect();
        for &(i, j, order, c) in terms {
            for (l, weight) in running_sums(order, step).iter().enumerate() {
                own[(i * (sums + 1) + l) * n + j] += c * weight;
            }
            leading[i * n + j] -= c * crate::excess::first(whole(order), step);
        }
        Ok(Self { n, sums, step, own, inverse: small::inverse(&leading, n)? })
    }

    /// The n unknown series of m terms that sources drive.
    ///
    /// # Errors
    /// [`Error::Length`] for a source shorter than m.
    ///
    /// # Panics
    /// Where a source names an equation that is not there or an order above the sums.
    pub fn solve(&self, m: usize, sources: &[Source]) -> Result<Vec<Vec<f64>>> {
        let stride = self.sums + 1;
        // Term by term, then equation by equation, what drives each sum.
        let mut drive = vec![0.0; m * self.n * stride];
        for source in sources {
            if source.series.len() < m {
                check_length("series that drives", m, source.series.len())?;
            }
            let weights: Vec<f64> = running_sums(source.order, self.step).iter().map(|w| w * source.weight).collect();
            let rows = drive.chunks_exact_mut(self.n * stride);
            for (row, &value) in rows.zip(source.series) {
                let part = &mut row[source.equation * stride..][..weights.len()];
                part.iter_mut().zip(&weights).for_each(|(sum, w)| *sum += w * value);
            }
        }
        Ok(match (self.n, self.sums) {
            (1, 0) => vec![self.one::<1>(&drive)],
            (1, 1) => vec![self.one::<2>(&drive)],
            (1, 2) => vec![self.one::<3>(&drive)],
            (1, 3) => vec![self.one::<4>(&drive)],
            (1, 4) => vec![self.one::<5>(&drive)],
            _ => self.many(&drive),
        })
    }

    /// One unknown; L is one more than there are sums.
    fn one<const L: usize>(&self, drive: &[f64]) -> Vec<f64> {
        let (mut own, inverse) = ([0.0; L], self.inverse[0]);
        own.copy_from_slice(&self.own[..L]);
        let mut sums = [0.0; L];
        drive
            .chunks_exact(L)
            .map(|given| {
                let mut open = given[0];
                for l in 1..L {
                    open += given[l] + sums[l];
                }
                let y = inverse * open;
                let mut above = 0.0;
                for l in (1..L).rev() {
                    sums[l] += given[l] + own[l] * y + above;
                    above = sums[l];
                }
                y
            })
            .collect()
    }

    fn many(&self, drive: &[f64]) -> Vec<Vec<f64>> {
        let (n, stride) = (self.n, self.sums + 1);
        let terms = drive.len() / (n * stride).max(1);
        let mut out: Vec<Vec<f64>> = (0..n).map(|_| Vec::with_capacity(terms)).collect();
        let (mut sums, mut open, mut y) = (vec![0.0; n * stride], vec![0.0; n], vec![0.0; n]);
        for given in drive.chunks_exact(n * stride) {
            for (i, sum) in open.iter_mut().enumerate() {
                let at = i * stride;
                *sum = given[at] + (1..stride).map(|l| given[at + l] + sums[at + l]).sum::<f64>();
            }
            for (i, value) in y.iter_mut().enumerate() {
                *value = (0..n).map(|j| self.inverse[i * n + j] * open[j]).sum();
                out[i].push(*value);
            }
            for i in 0..n {
                let mut above = 0.0;
                for l in (1..stride).rev() {
                    let at = i * stride + l;
                    let of_unknowns: f64 = (0..n).map(|j| self.own[at * n + j] * y[j]).sum();
                    sums[at] += given[at] + of_unknowns + above;
                    above = sums[at];
                }
            }
        }
        out
    }
}

#[allow(clippy::cast_precision_loss)]
fn whole(order: usize) -> f64 {
    order as f64
}
