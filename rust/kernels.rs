//! Kernels of the fractional integral I^η and of its derivative with respect to η, Grünwald–Letnikov weights, and pulse
//! means of powers of t.

use std::cell::RefCell;
use std::sync::Arc;
use std::thread::LocalKey;

use crate::error::{Error, Result};
use crate::shared::Shared;

/// Highest order of an integral, and of an equation: five lightly damped modes in one. The kernels are exact to a few ε
/// up to here; what a division loses to rounding grows as (ωT)^α/Γ(α+1), so long records of many modes need fewer orders.
pub const MAX_ORDER: f64 = 10.0;

/// Lowest order of an input in an equation: a threefold integration.
pub const MIN_INPUT_ORDER: f64 = -3.0;

/// Below this pulse distance the even binomial sum converges slowly and gets [`TERMS_NEAR`] terms.
const NEAR: usize = 8;
/// Terms for distances 2 … 7: 4^−25 is below the rounding error at distance 2.
const TERMS_NEAR: usize = 25;
/// Terms from distance 8 on: 64^−8 is below the rounding error.
const TERMS_FAR: usize = 8;

/// Block-pulse kernel of I^η: first row of F^η, `h^η/Γ(η+2)·v_n`, n = 1 … m (paper (32)).
///
/// The printed `v_n` is a second difference of n^{η+1} and cancels catastrophically (relative error 2e−3 at
/// n = 2^20 for η = 0.15); here it is the even binomial sum, exact to a few ε for every n. η = 0 gives the
/// identity.
///
/// Cost O(m).
///
/// ```
/// // I^1 of a pulse: half of it within itself, all of it in every later one.
/// let kernel = ftlm::kernels::block_pulse_kernel(1.0, 3, 0.1);
/// assert!(kernel.iter().zip([0.05, 0.1, 0.1]).all(|(v, truth)| (v - truth).abs() < 1e-15));
/// ```
#[must_use]
pub fn block_pulse_kernel(eta: f64, m: usize, step: f64) -> Vec<f64> {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 2.0);
    let differences = SecondDifferences::new(eta);
    if m < SIEVED {
        return (1..=m).map(|n| scale * differences.value(n)).collect();
    }
    let (head, powers) = (differences.head(scale), whole_powers(eta + 1.0, m));
    let tail = powers.iter().enumerate().skip(HEAD);
    head.iter().map(|&(v, _)| v).chain(tail.map(|(c, &power)| scale * differences.far(c, power))).collect()
}

/// Derivative of [`block_pulse_kernel`] with respect to η.
///
/// Uses d/dη of `h^η/Γ(η+2)`, that is ln h − ψ(η+2), and the term-by-term derivative of the binomial sum.
#[must_use]
pub fn block_pulse_kernel_derivative(eta: f64, m: usize, step: f64) -> Vec<f64> {
    kernel_with_derivative(eta, m, step).1
}

/// [`block_pulse_kernel`] and its derivative with respect to η, for little more than the price of one.
#[must_use]
pub fn kernel_with_derivative(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 2.0);
    let slope = libm::log(step) - digamma(eta + 2.0);
    let differences = SecondDifferences::new(eta);
    if m >= SIEVED {
        let powers = whole_powers(eta + 1.0, m);
        let logarithms = whole_logarithms(m);
        let (mut kernel, mut slopes) = (Vec::with_capacity(m), Vec::with_capacity(m));
        for (v, dv) in differences.head(1.0) {
            kernel.push(scale * v);
            slopes.push(scale * (v * slope + dv));
        }
        for (c, (&power, &logarithm)) in powers.iter().zip(logarithms.iter()).enumerate().skip(HEAD) {
            let (v, dv) = differences.far_with_slope(c, power, logarithm);
            kernel.push(scale * v);
            slopes.push(scale * (v * slope + dv));
        }
        return (kernel, slopes);
    }
    (1..=m)
        .map(|n| {
            let (v, dv) = differences.value_and_slope(n);
            (scale * v, scale * (v * slope + dv))
        })
        .unzip()
}

/// `v_n = n^{η+1} − 2(n−1)^{η+1} + (n−2)^{η+1}` (v₁ = 1) and its derivative with respect to η, both to a few ε.
#[must_use]
pub fn second_difference(eta: f64, n: usize) -> (f64, f64) {
    SecondDifferences::new(eta).value_and_slope(n)
}

/// The even binomial coefficients C(η+1, 2k), k = 1 … K, and their derivatives with respect to η: all n share them.
pub(crate) struct SecondDifferences {
    eta: f64,
    coefficients: [f64; TERMS_NEAR],
    slopes: [f64; TERMS_NEAR],
}

impl SecondDifferences {
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn new(eta: f64) -> Self {
        let (mut coefficients, mut slopes) = ([0.0; TERMS_NEAR], [0.0; TERMS_NEAR]);
        let (mut c, mut dc) = (1.0, 0.0);
        for (k, (kept, slope)) in coefficients.iter_mut().zip(&mut slopes).enumerate() {
            for j in [2 * k, 2 * k + 1] {
                // η + 1 − j, but exactly η at j = 1: for small η the rounding of η + 1 would be the whole error.
                let factor = if j == 0 { eta + 1.0 } else { eta - (j as f64 - 1.0) };
                let divisor = (j + 1) as f64;
                dc = (dc * factor + c) / divisor;
                c = c * factor / divisor;
            }
            (*kept, *slope) = (c, dc);
        }
        Self { eta, coefficients, slopes }
    }

    /// Σ_k a_k x^k over the terms that count at this distance, smallest first.
    fn sum(coefficients: &[f64; TERMS_NEAR], centre: usize, shrink: f64) -> f64 {
        let terms = if centre < NEAR { TERMS_NEAR } else { TERMS_FAR };
        coefficients[..terms].iter().rev().fold(0.0, |sum, &c| (sum + c) * shrink)
    }

    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn value(&self, n: usize) -> f64 {
        match n {
            0 => 0.0,
            1 => 1.0,
            2 => 2.0 * libm::expm1(self.eta * std::f64::consts::LN_2),
            _ => {
                let centre = (n - 1) as f64;
                let sum = Self::sum(&self.coefficients, n - 1, 1.0 / (centre * centre));
                2.0 * libm::pow(centre, self.eta + 1.0) * sum
            }
        }
    }

    #[allow(clippy::cast_precision_loss)]
    fn value_and_slope(&self, n: usize) -> (f64, f64) {
        let value = self.value(n);
        match n {
            0 | 1 => (value, 0.0),
            2 => (value, 2.0 * libm::exp2(self.eta) * std::f64::consts::LN_2),
            _ => {
                let centre = (n - 1) as f64;
                let slope = Self::sum(&self.slopes, n - 1, 1.0 / (centre * centre));
                (value, value * libm::log(centre) + 2.0 * libm::pow(centre, self.eta + 1.0) * slope)
            }
        }
    }
}

/// From this many terms on, powers come from a sieve instead of one by one.
const SIEVED: usize = 256;
/// Terms before the sieve takes over: those whose sums are long.
const HEAD: usize = 64;

/// Terms of the even binomial sum that count at a distance of at least [`HEAD`]: c^{−2K} is below the rounding error.
const fn terms_at(centre: usize) -> usize {
    match centre {
        0..1024 => 5,
        1024..32768 => 3,
        _ => 2,
    }
}

impl SecondDifferences {
    /// The first [`HEAD`] terms and slopes, times `scale`.
    fn head(&self, scale: f64) -> Vec<(f64, f64)> {
        (1..=HEAD).map(|n| self.value_and_slope(n)).map(|(v, dv)| (scale * v, scale * dv)).collect()
    }

    /// `v_n` at n = centre + 1 > [`HEAD`] from centre^{η+1}.
    #[allow(clippy::cast_precision_loss)]
    fn far(&self, centre: usize, power: f64) -> f64 {
        let shrink = 1.0 / (centre as f64 * centre as f64);
        let sum = self.coefficients[..terms_at(centre)].iter().rev().fold(0.0, |sum, &c| (sum + c) * shrink);
        2.0 * power * sum
    }

    /// `v_n` and its derivative at n = centre + 1 > [`HEAD`] from centre^{η+1} and ln centre.
    #[allow(clippy::cast_precision_loss)]
    fn far_with_slope(&self, centre: usize, power: f64, logarithm: f64) -> (f64, f64) {
        let shrink = 1.0 / (centre as f64 * centre as f64);
        let terms = terms_at(centre);
        let (mut sum, mut slope) = (0.0, 0.0);
        for (&c, &dc) in self.coefficients[..terms].iter().zip(&self.slopes[..terms]).rev() {
            sum = (sum + c) * shrink;
            slope = (slope + dc) * shrink;
        }
        let value = 2.0 * power * sum;
        (value, value * logarithm + 2.0 * power * slope)
    }
}

/// `n^exponent` for n = 0 … m−1. Powers are multiplicative: only primes cost a power, everything else one product, so
/// the relative error grows by half an ε per prime factor, of which n < 2^20 has at most 19.
#[allow(clippy::cast_precision_loss)]
fn whole_powers(exponent: f64, m: usize) -> Vec<f64> {
    let divisors = least_divisors(m);
    let mut powers = vec![0.0; m];
    for n in 1..m {
        let divisor = divisors[n] as usize;
        powers[n] = if n == 1 {
            1.0
        } else if divisor == n {
            libm::pow(n as f64, exponent)
        } else {
            powers[divisor] * powers[n / divisor]
        };
    }
    powers
}

/// `(2k+1)^exponent` for k = 0 … m−1, as [`whole_powers`].
#[allow(clippy::cast_precision_loss)]
fn odd_powers(exponent: f64, m: usize) -> Vec<f64> {
    let divisors = least_divisors(2 * m);
    let mut powers = vec![1.0; m];
    for k in 1..m {
        let n = 2 * k + 1;
        let divisor = divisors[n] as usize;
        powers[k] =
            if divisor == n { libm::pow(n as f64, exponent) } else { powers[divisor / 2] * powers[n / divisor / 2] };
    }
    powers
}

/// A table that only ever grows: one for all threads, and one of a thread's own for when that is not to be had.
struct Table<T: 'static> {
    shared: &'static Shared<Values<T>>,
    own: &'static LocalKey<RefCell<Values<T>>>,
    make: fn(usize) -> Vec<T>,
}

type Values<T> = Option<Arc<Vec<T>>>;

impl<T> Table<T> {
    /// At least m values.
    fn of(&self, m: usize) -> Arc<Vec<T>> {
        let enough = |values: &Values<T>| values.as_ref().filter(|values| values.len() >= m).map(Arc::clone);
        let own = || self.own.with_borrow(enough);
        if let Some(values) = own().or_else(|| self.shared.with(|values| enough(values)).flatten()) {
            return values;
        }
        let made = Arc::new((self.make)(m.next_power_of_two()));
        // What is replaced is given back, so that its memory is not freed behind the lock.
        let kept = self.shared.with(|values| {
            let longer = values.as_ref().is_none_or(|values| values.len() < made.len());
            longer.then(|| values.replace(Arc::clone(&made)))
        });
        if kept.is_none() {
            self.own.set(Some(Arc::clone(&made)));
        }
        made
    }
}

/// Least prime divisor of each n < m (at least).
#[allow(clippy::cast_possible_truncation)]
fn least_divisors(m: usize) -> Arc<Vec<u32>> {
    static SHARED: Shared<Values<u32>> = Shared::new(None);
    thread_local!(static OWN: RefCell<Values<u32>> = const { RefCell::new(None) });
    let make = |len| {
        let mut divisors: Vec<u32> = (0..len as u32).collect();
        let mut prime = 2;
        while prime * prime < len {
            if divisors[prime] as usize == prime {
                for multiple in (prime * prime..len).step_by(prime) {
                    if divisors[multiple] as usize == multiple {
                        divisors[multiple] = prime as u32;
                    }
                }
            }
            prime += 1;
        }
        divisors
    };
    Table { shared: &SHARED, own: &OWN, make }.of(m)
}

/// ln n for n < m (at least); 0 at n = 0, which nobody reads. Longer than m: zip it with what is m long.
#[allow(clippy::cast_precision_loss)]
fn whole_logarithms(m: usize) -> Arc<Vec<f64>> {
    static SHARED: Shared<Values<f64>> = Shared::new(None);
    thread_local!(static OWN: RefCell<Values<f64>> = const { RefCell::new(None) });
    let make = |len| (0..len).map(|n: usize| libm::log(n.max(1) as f64)).collect();
    Table { shared: &SHARED, own: &OWN, make }.of(m)
}

/// ψ(x) for x > 0, NaN elsewhere: recurrence up to x ≥ 10, then the asymptotic series (DLMF 5.11.2).
#[must_use]
pub fn digamma(x: f64) -> f64 {
    // B_{2k}/(2k) for k = 1 … 7; the eighth term is below 1e−17 at x = 10.
    const SERIES: [f64; 7] =
        [1.0 / 12.0, -1.0 / 120.0, 1.0 / 252.0, -1.0 / 240.0, 1.0 / 132.0, -691.0 / 32760.0, 1.0 / 12.0];
    if x.is_nan() || x <= 0.0 {
        return f64::NAN;
    }
    let (mut x, mut shift) = (x, 0.0);
    while x < 10.0 {
        shift += 1.0 / x;
        x += 1.0;
    }
    let square = 1.0 / (x * x);
    let tail = SERIES.iter().rev().fold(0.0, |sum, &b| (sum + b) * square);
    libm::log(x) - 0.5 / x - tail - shift
}

/// Grünwald–Letnikov weights `(−1)^j C(α, j)`, j = 0 … m−1 (paper (2)); a negative α integrates.
///
/// ```
/// assert_eq!(ftlm::kernels::grunwald_letnikov_weights(1.0, 4), [1.0, -1.0, 0.0, 0.0]);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn grunwald_letnikov_weights(alpha: f64, m: usize) -> Vec<f64> {
    let mut weights = Vec::with_capacity(m);
    let mut weight = 1.0;
    for j in 0..m {
        if j > 0 {
            weight *= 1.0 - (alpha + 1.0) / j as f64;
        }
        weights.push(weight);
    }
    weights
}

/// Pulse means of `t^exponent`, k = 1 … m, exact to a few ε (exponent > −1); of δ and its derivatives, as differences over
/// the first pulses, for the exponents −1, −2, ….
///
/// ```
/// let means = ftlm::kernels::power_means(1.0, 3, 2.0);
/// assert!(means.iter().zip([1.0, 3.0, 5.0]).all(|(v, truth)| (v - truth).abs() < 1e-14));
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn power_means(exponent: f64, m: usize, step: f64) -> Vec<f64> {
    if exponent <= -1.0 && exponent.fract() == 0.0 {
        // Differences of the first pulses stand at their middle; half their span further back is one more difference.
        let order = -exponent - 1.0;
        let (first, next) = (grunwald_letnikov_weights(order, m), grunwald_letnikov_weights(order + 1.0, m));
        let scale = libm::pow(step, exponent);
        return first.iter().zip(&next).map(|(a, b)| scale * (a + 0.5 * (order + 1.0) * b)).collect();
    }
    let a = exponent + 1.0;
    let scale = libm::pow(step, exponent);
    let near = (1..=m.min(if m < SIEVED { m } else { HEAD })).map(|k| {
        let k = k as f64;
        // k^a − (k−1)^a without the cancellation.
        scale / a * if k == 1.0 { 1.0 } else { -libm::pow(k, a) * libm::expm1(a * libm::log1p(-1.0 / k)) }
    });
    let mut means: Vec<f64> = near.collect();
    if means.len() < m {
        // About the middle of a pulse, at d/2 for an odd d, it is (d/2)^e·Σ C(a, 2j+1)/a·d^−2j.
        let mut sums = [0.0; terms_at(0)];
        let mut c = 1.0;
        for (j, sum) in sums.iter_mut().enumerate() {
            *sum = c;
            let next = (2 * j + 1) as f64;
            c *= (a - next) * (a - next - 1.0) / ((next + 1.0) * (next + 2.0));
        }
        let half = scale * libm::exp2(-exponent);
        let odd = odd_powers(exponent, m);
        means.extend(odd.iter().enumerate().skip(HEAD).map(|(k, &power)| {
            let d = (2 * k + 1) as f64;
            let shrink = 1.0 / (d * d);
            half * power * sums[..terms_at(2 * k)].iter().rev().fold(0.0, |sum, &c| sum * shrink + c)
        }));
    }
    means
}

/// Refuses an order outside [0, [`MAX_ORDER`]].
///
/// # Errors
/// [`Error::OutOfRange`].
pub fn check_order(name: &str, order: f64) -> Result<()> {
    if (0.0..=MAX_ORDER).contains(&order) {
        Ok(())
    } else {
        Err(Error::OutOfRange {
            name: name.to_owned(),
            value: order,
            range: format!("[0, {MAX_ORDER}]"),
            remedy: "split a higher order into a whole and a fractional part".into(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_that_is_never_given_back_stops_no_table() {
        static SHARED: Shared<Values<usize>> = Shared::new(None);
        thread_local!(static OWN: RefCell<Values<usize>> = const { RefCell::new(None) });
        let table = Table { shared: &SHARED, own: &OWN, make: |len| (0..len).collect() };
        let (first, second) = SHARED.held(|| (table.of(5), table.of(8)));
        assert_eq!(*first, [0, 1, 2, 3, 4, 5, 6, 7]);
        assert!(Arc::ptr_eq(&first, &second), "made once");
        let longer = table.of(9);
        assert_eq!(longer.len(), 16);
        // Another thread takes what is shared, and a shorter one made meanwhile replaces nothing.
        std::thread::scope(|scope| {
            scope.spawn(|| assert!(Arc::ptr_eq(&table.of(16), &longer)));
        });
    }
}
