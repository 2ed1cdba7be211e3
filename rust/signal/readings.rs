//! What a signal is at times of its own, from its pulse means: readings whose clock jitters, rows that were lost.
//!
//! Four pulse means around a reading tell its value to fourth order where the signal is smooth: the slope of the quartic
//! through the integral at their edges. It is not smooth where a held input jumps: I^η of a jump of size Δ at p is
//! Δ (t − p)^η/Γ(η + 1), a corner that no polynomial follows, and the pulses see the jump spread over the pulse in which
//! it stands. Both are known exactly, so a reading near a jump gets what its four means lack of that corner.

use crate::error::{check_finite, Error, Result};

/// Pulse means that a reading is made of.
const STENCIL: usize = 4;
/// Pulses after a jump within which a reading is mended: beyond them what the spreading leaves falls with the square of
/// the step, like every other error of the scheme.
const REACH: f64 = 16.0;

/// A jump of a held signal near a reading, in pulses.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Near {
    /// How long before the reading; negative: after it.
    before: f64,
    /// First pulse of the reading's stencil, counted from that of the jump.
    first: isize,
    /// Share of its pulse that had passed at the jump.
    share: f64,
    size: f64,
}

/// Times of readings on a grid of pulses, and what each is made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Readings {
    first: Vec<usize>,
    weights: Vec<[f64; STENCIL]>,
    places: Vec<f64>,
}

/// Jumps of one held signal near each reading.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Jumps {
    starts: Vec<usize>,
    near: Vec<Near>,
}

impl Readings {
    /// Readings at these places, in pulses from the first pulse's start, among m pulses.
    ///
    /// # Errors
    /// Fewer than four pulses, a place that is not among them.
    ///
    /// ```
    /// # fn main() -> ftlm::error::Result<()> {
    /// // Means of t³ over pulses of 1 s.
    /// let means: Vec<f64> = (0..6).map(|k| 0.25 * (f64::from(k + 1).powi(4) - f64::from(k).powi(4))).collect();
    /// let readings = ftlm::signal::readings::Readings::new(vec![0.3, 2.5, 5.9], 6)?;
    /// let read = readings.read(&means);
    /// assert!(read.iter().zip([0.3_f64, 2.5, 5.9]).all(|(y, t)| (y - t.powi(3)).abs() < 1e-9));
    /// # Ok(())
    /// # }
    /// ```
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn new(places: Vec<f64>, m: usize) -> Result<Self> {
        if m < STENCIL {
            return Err(Error::Length { name: "pulses around a reading".into(), expected: STENCIL, found: m });
        }
        check_finite("times of readings", &places)?;
        if let Some(&value) = places.iter().find(|&&p| !(0.0..=m as f64).contains(&p)) {
            let remedy = "leave out what was read before or after the inputs are known".into();
            return Err(Error::OutOfRange {
                name: "time of a reading".into(),
                value,
                range: format!("[0, {m}]"),
                remedy,
            });
        }
        let half = STENCIL / 2;
        let first: Vec<usize> =
            places.iter().map(|p| ((p + 0.5) as usize).saturating_sub(half).min(m - STENCIL)).collect();
        let weights = places.iter().zip(&first).map(|(p, &f)| stencil(p - f as f64)).collect();
        Ok(Self { first, weights, places })
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.first.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.first.is_empty()
    }

    /// Values of a signal at the readings from its pulse means, where it is smooth.
    #[must_use]
    pub fn read(&self, means: &[f64]) -> Vec<f64> {
        let value = |(&first, weights): (&usize, &[f64; STENCIL])| -> f64 {
            weights.iter().zip(&means[first..]).map(|(w, v)| w * v).sum()
        };
        self.first.iter().zip(&self.weights).map(value).collect()
    }

    /// The jumps of a held signal that matter to each reading, from their places in pulses (ascending) and sizes.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, clippy::cast_precision_loss)]
    pub fn jumps(&self, at: &[f64], sizes: &[f64]) -> Jumps {
        let mut out = Jumps { starts: vec![0], near: Vec::new() };
        for (&place, &first) in self.places.iter().zip(&self.first) {
            let from = at.partition_point(|&p| p < place - REACH);
            let to = at.partition_point(|&p| p < (first + STENCIL) as f64);
            for (&p, &size) in
                at[from..to.max(from)].iter().zip(sizes.iter().skip(from)).filter(|(_, size)| **size != 0.0)
            {
                let pulse = p.floor();
                out.near.push(Near {
                    before: place - p,
                    first: first as isize - pulse as isize,
                    share: p - pulse,
                    size,
                });
            }
            out.starts.push(out.near.len());
        }
        out
    }

    /// What the readings of I^η of a held signal lack: its corners at the jumps less what its pulse means show of them.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn corners(&self, jumps: &Jumps, eta: f64, step: f64) -> Vec<f64> {
        let scale = libm::pow(step, eta);
        let (corner, mean) = (scale / libm::tgamma(eta + 1.0), scale / libm::tgamma(eta + 2.0));
        // Mean of the corner over the n-th pulse after a jump at a pulse's start.
        let longest = jumps.near.iter().map(|near| near.first).max().unwrap_or(0).max(0) + STENCIL as isize;
        let powers: Vec<f64> = (0..=longest + 1).map(|n| libm::pow(n as f64, eta + 1.0)).collect();
        let of_pulse = |n: isize| usize::try_from(n).map_or(0.0, |n| mean * (powers[n + 1] - powers[n]));
        let lacking = |near: &Near, weights: &[f64; STENCIL]| {
            let there = match near.before {
                before if before < 0.0 => 0.0,
                before if eta == 0.0 && before == 0.0 => corner,
                before => corner * libm::pow(before, eta),
            };
            let shown: f64 = (near.first..)
                .zip(weights)
                .map(|(n, w)| w * ((1.0 - near.share) * of_pulse(n) + near.share * of_pulse(n - 1)))
                .sum();
            near.size * (there - shown)
        };
        let spans = jumps.starts.iter().zip(jumps.starts.iter().skip(1)).zip(&self.weights);
        spans.map(|((&from, &to), weights)| jumps.near[from..to].iter().map(|n| lacking(n, weights)).sum()).collect()
    }
}

/// Weights of four pulse means for the value at x pulses from the first one's start: slopes of Lagrange's polynomials
/// through the integral at the five edges.
#[allow(clippy::cast_precision_loss)]
fn stencil(x: f64) -> [f64; STENCIL] {
    let slope = |m: usize| -> f64 {
        let others: Vec<f64> = (0..=STENCIL).filter(|&j| j != m).map(|j| j as f64).collect();
        let below: f64 = others.iter().map(|j| m as f64 - j).product();
        let skipping =
            |i: usize| others.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, v)| x - v).product::<f64>();
        (0..others.len()).map(skipping).sum::<f64>() / below
    };
    let mut weights = [0.0; STENCIL];
    let mut sum = 0.0;
    for k in (0..STENCIL).rev() {
        sum += slope(k + 1);
        weights[k] = sum;
    }
    weights
}
