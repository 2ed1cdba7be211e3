//! Taylor expansion of a regressor I^η s in its order of integration η, with a bound of the remainder. I^η is the
//! fractional integral of order η, and s a signal.
//!
//! The kernel v_n = Δ²n^{η+1} of I^η at distance n is differentiated with respect to η, term by term. Columns may be
//! scaled, also by e^{−λ(η−η₀)}. If λ is the mean logarithmic slope of the column at η₀, the scaled column changes its
//! direction but hardly its norm. The remainder follows from a bound of the fourth derivative with respect to η. This
//! derivative is a mean of d²/dt² t^{η+1}(ln t − λ)⁴ over two pulses (sampling intervals), with the distance t. The
//! terms of the bound increase with η for t ≥ 1.

use crate::error::{Error, Result};
use crate::parallel::Stop;
use crate::regressors::Record;
use crate::series::{Buffers, Kernel};

/// Maximum number of terms of an equation with a certificate.
pub(super) const MAX_TERMS: usize = 6;
/// Highest derivative, with respect to the order of integration, in the Taylor expansion of a regressor.
pub(super) const EXPANSION_DEGREE: usize = 3;
/// Number of columns of the expansion: the value and its derivatives.
pub(super) const EXPANSION_COLUMNS: usize = EXPANSION_DEGREE + 1;

/// Number of terms of the binomial sum of the kernel: at distances below [`NEAR_DISTANCE_PULSES`], where it converges
/// slowly, and at larger distances. The omitted terms, 4^−26 and 64^−10, are below the rounding error.
const BINOMIAL_TERMS: [usize; 2] = [26, 10];
/// Distance \[sampling intervals\] from which the binomial sum converges fast.
const NEAR_DISTANCE_PULSES: usize = 8;

/// Factorials of 0 to 4.
const FACTORIAL_TABLE: [f64; 5] = [1.0, 1.0, 2.0, 6.0, 24.0];

/// Expansion of the regressor of one signal about one order of integration. Records are concatenated, and the value has
/// unit norm.
pub(super) struct RegressorExpansion {
    /// Value of the regressor and its derivatives with respect to the order η, at the order η₀ of the expansion. Before
    /// differentiation it is scaled by e^{−λ(η−η₀)}, with its mean logarithmic slope λ at η₀.
    pub(super) columns: [Vec<f64>; EXPANSION_COLUMNS],
    /// Upper bounds of the norms of the value and the derivatives.
    pub(super) sizes: [f64; EXPANSION_COLUMNS],
    /// Upper bound of the distance of the scaled regressor from its Taylor series, for orders within the half width.
    pub(super) remainder: f64,
}

/// Binomial sums of the kernel of I^η at distances n ≥ 2 \[sampling intervals\].
struct BinomialSums {
    /// Order of integration η.
    eta: f64,
    /// Sum Σ_k C(η+1, 2k) n^{−2k} over k ≥ 1, and its derivatives with respect to η, divided by factorials. There is
    /// one array per distance n.
    sums: Vec<[f64; EXPANSION_COLUMNS]>,
    /// Values n^{η+1} and ln n, by distance n.
    powers: Vec<(f64, f64)>,
}

impl BinomialSums {
    /// Compute the binomial sums for distances from 2 to `m` − 1.
    #[allow(clippy::cast_precision_loss)]
    fn new(eta: f64, m: usize) -> Self {
        // Derivatives of binomial coefficients, as truncated series in the increment of η.
        let mut coefficients = [[0.0; EXPANSION_COLUMNS]; BINOMIAL_TERMS[0]];
        let mut c = [0.0; EXPANSION_COLUMNS];
        c[0] = 1.0;
        for (k, coefficient) in coefficients.iter_mut().enumerate() {
            for j in [2 * k, 2 * k + 1] {
                let factor = if j == 0 { eta + 1.0 } else { eta - (j as f64 - 1.0) };
                let divisor = (j + 1) as f64;
                for i in (0..EXPANSION_COLUMNS).rev() {
                    c[i] = (c[i] * factor + if i > 0 { c[i - 1] } else { 0.0 }) / divisor;
                }
            }
            *coefficient = c;
        }
        let distances = 2..m.max(2);
        let sums = distances.clone().map(|n| {
            let shrink = 1.0 / (n * n) as f64;
            let terms = BINOMIAL_TERMS[usize::from(n >= NEAR_DISTANCE_PULSES)];
            let mut sum = [0.0; EXPANSION_COLUMNS];
            for c in coefficients[..terms].iter().rev() {
                for (sum, c) in sum.iter_mut().zip(c) {
                    *sum = (*sum + c) * shrink;
                }
            }
            sum
        });
        let powers = distances.clone().map(|n| (libm::pow(n as f64, eta + 1.0), libm::log(n as f64)));
        Self { eta, sums: sums.collect(), powers: powers.collect() }
    }

    /// Return the derivative (∂/∂η − μ)^j v_n of the kernel v of I^η, for n = 1 … m.
    fn derivative(&self, j: usize, mu: f64, m: usize) -> Vec<f64> {
        let power = |x: f64| x.powi(i32::try_from(j).unwrap_or(0));
        let double = libm::exp2(self.eta + 1.0);
        let second = match j {
            0 => 2.0 * libm::expm1(self.eta * std::f64::consts::LN_2),
            _ => double * power(std::f64::consts::LN_2 - mu) - 2.0 * power(-mu),
        };
        let smooth_part = self.sums.iter().zip(&self.powers).map(|(sums, (lead, logarithm))| {
            let (mut value, mut falling_factorial) = (0.0, 1.0);
            for i in 0..=j {
                value += falling_factorial / FACTORIAL_TABLE[i] * sums[j - i];
                falling_factorial *= logarithm - mu;
            }
            2.0 * FACTORIAL_TABLE[j] * lead * value
        });
        [power(-mu), second].into_iter().chain(smooth_part).take(m).collect()
    }
}

/// Return the sum over n = 1 … m of upper bounds of |(∂/∂η − μ)⁴ v_n| for all orders η up to `highest`. v is the kernel
/// of I^η.
#[allow(clippy::cast_precision_loss)]
fn fourth_derivative_bound(highest: f64, mu: f64, m: usize) -> f64 {
    let b = highest;
    let deviation = |t: f64| (libm::log(t) - mu).abs();
    let mut sum = mu.powi(4);
    if m > 1 {
        sum += libm::exp2(b + 1.0) * deviation(2.0).powi(4) + 2.0 * mu.powi(4);
    }
    let (mut before, mut current) = ((1.0, deviation(1.0)), (libm::pow(2.0, b - 1.0), deviation(2.0)));
    for n in 2..m {
        let t = (n + 1) as f64;
        let after = (libm::pow(t, b - 1.0), deviation(t));
        let (power, l) = (f64::max(before.0, after.0), f64::max(before.1, after.1));
        sum += power * l * l * (((b + 1.0) * b * l + (2.0 * b + 1.0) * 4.0) * l + 12.0);
        (before, current) = (current, after);
    }
    sum
}

/// Return the inner product of two vectors.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl RegressorExpansion {
    /// Expand the fractional integral of a signal about the order `eta`, for orders within `half` of it.
    ///
    /// # Errors
    /// [`Error::Structure`] if the norm of the integral is not a positive finite number. [`Error::Interrupted`] after a
    /// stop request.
    pub(super) fn new(records: &[Record], signal: usize, eta: f64, half: f64, stop: &Stop) -> Result<Self> {
        let mut columns: [Vec<f64>; EXPANSION_COLUMNS] = Default::default();
        let mut errors = [0.0; EXPANSION_COLUMNS];
        let mut expansions = Vec::with_capacity(records.len());
        // The unit of time is the sampling interval of the first record.
        let first = records.first().map_or(1.0, Record::step);
        for record in records {
            stop.check()?;
            let (m, pace) = (record.m(), record.step() / first);
            let (sums, spectrum) = (BinomialSums::new(eta, m), Kernel::new(record.signal(signal)));
            let (scale, slope) = (libm::pow(pace, eta), libm::log(pace));
            expansions.push((sums, spectrum, scale, slope));
        }
        let mut buffers = Buffers::default();
        for (j, column) in columns.iter_mut().enumerate().take(2) {
            for (record, (sums, spectrum, scale, slope)) in records.iter().zip(&expansions) {
                stop.check()?;
                column.extend(product(&sums.derivative(j, -slope, record.m()), spectrum, *scale, &mut buffers));
            }
        }
        let lambda = dot(&columns[0], &columns[1]) / dot(&columns[0], &columns[0]);
        let mut remainder_squares = 0.0;
        for (j, column) in columns.iter_mut().enumerate() {
            if j > 0 {
                column.clear();
            }
            let mut squares = 0.0;
            for (record, (sums, spectrum, scale, slope)) in records.iter().zip(&expansions) {
                stop.check()?;
                let (m, mu) = (record.m(), lambda - slope);
                let kernel = sums.derivative(j, mu, m);
                if j > 0 {
                    column.extend(product(&kernel, spectrum, *scale, &mut buffers));
                }
                let size = dot(record.signal(signal), record.signal(signal)).sqrt();
                // The summands of a derivative have either sign, depending on the logarithm of the distance.
                let rounding = rounding_unit(m) * scale * size * sums.moduli(j, mu);
                squares += rounding * rounding;
                if j == 0 {
                    let remainder =
                        libm::exp(mu.abs() * half) * fourth_derivative_bound(eta + half, mu, m) * scale * size;
                    remainder_squares += remainder * remainder;
                }
            }
            errors[j] = squares.sqrt();
        }
        let size = dot(&columns[0], &columns[0]).sqrt();
        if !(size > 0.0 && size < f64::MAX && lambda.is_finite()) {
            return Err(Error::Structure {
                what: format!("the integral of order {eta} of signal {signal} has the size {size}"),
                remedy:
                    "remove a signal that is zero throughout, and scale a signal whose squares overflow or underflow"
                        .into(),
            });
        }
        let inverse = 1.0 / size;
        columns.iter_mut().flatten().for_each(|v| *v *= inverse);
        let mut remainder = remainder_squares.sqrt() * half.powi(4) / FACTORIAL_TABLE[4];
        for j in 0..EXPANSION_COLUMNS {
            remainder += errors[j] * half.powi(i32::try_from(j).unwrap_or(0)) / FACTORIAL_TABLE[j];
        }
        let rounding_factor = 1.0 + rounding_unit(columns[0].len());
        let sizes = std::array::from_fn(|j| dot(&columns[j], &columns[j]).sqrt() * rounding_factor);
        Ok(Self { columns, sizes, remainder: remainder * inverse * rounding_factor })
    }
}

impl BinomialSums {
    /// Return the sum over n = 1 … m of the moduli of the summands of [`Self::derivative`].
    fn moduli(&self, j: usize, mu: f64) -> f64 {
        let power = |x: f64| x.abs().powi(i32::try_from(j).unwrap_or(0));
        let first_terms = power(mu) + libm::exp2(self.eta + 1.0) * power(std::f64::consts::LN_2 - mu) + 2.0 * power(mu);
        let other_terms = self.sums.iter().zip(&self.powers).map(|(sums, (lead, logarithm))| {
            let (mut value, mut falling_factorial) = (0.0, 1.0);
            for i in 0..=j {
                value += falling_factorial / FACTORIAL_TABLE[i] * sums[j - i].abs();
                falling_factorial *= (logarithm - mu).abs();
            }
            2.0 * FACTORIAL_TABLE[j] * lead * value
        });
        first_terms + other_terms.sum::<f64>()
    }
}

/// Return a relative rounding-error bound of a sum of `m` terms, with a safety factor.
#[allow(clippy::cast_precision_loss)]
pub(super) fn rounding_unit(m: usize) -> f64 {
    16.0 * f64::EPSILON * (m.max(64) as f64)
}

/// Return the truncated convolution of a kernel with the signal whose spectrum is given, multiplied by `scale`.
fn product(kernel: &[f64], spectrum: &Kernel, scale: f64, buffers: &mut Buffers) -> Vec<f64> {
    let mut out = vec![0.0; kernel.len()];
    Kernel::new(kernel).times(spectrum, &mut out, buffers);
    out.iter_mut().for_each(|v| *v *= scale);
    out
}

/// Return the Taylor sum Σ `half`^j/j!·`derivative(j)` for j = 1, 2, 3.
pub(super) fn taylor_sum(half: f64, derivative: impl Fn(usize) -> f64) -> f64 {
    let mut power = 1.0;
    let mut sum = 0.0;
    for (j, factorial) in FACTORIAL_TABLE.iter().enumerate().take(EXPANSION_COLUMNS).skip(1) {
        power *= half;
        sum += power / factorial * derivative(j);
    }
    sum
}
