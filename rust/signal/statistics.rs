//! Numbers that tell of a series what it scatters by, how it hangs together, and whether it is white.

use crate::simd::{dot, widest, Kernel};

/// Median absolute deviation of a normal variable in units of its standard deviation.
pub const MAD: f64 = 0.674_489_750_196_081_7;
/// Residuals beyond so many deviations count by their size: 95 % of the precision of squares under normal noise.
pub const BEND: f64 = 1.345;
/// 99 % quantile of a normal variable: one in a hundred true models is refused.
const NORMAL_99: f64 = 2.326_347_874_040_840_8;
/// Lags that a test for whiteness looks at where nothing else is asked.
pub const LAGS: usize = 25;
/// Values that are summed one after another before sums are joined by pairs.
const TOGETHER: usize = 128;

/// Inner product of two rows of one length.
struct Inner<'a>(&'a [f64], &'a [f64]);

impl Kernel for Inner<'_> {
    type Output = f64;

    #[inline(always)]
    fn run(self) -> f64 {
        dot(self.0, self.1)
    }
}

/// Σ a·b in the widest vectors at hand; rows are of one length.
#[must_use]
pub fn inner(a: &[f64], b: &[f64]) -> f64 {
    widest(Inner(a, b))
}

/// Sum of values, halves of them by themselves: rounding grows with the logarithm of their number.
#[must_use]
pub fn sum(values: &[f64]) -> f64 {
    if values.len() < 8 {
        return values.iter().sum();
    }
    if values.len() > TOGETHER {
        let half = values.len() / 2 / 8 * 8;
        return sum(&values[..half]) + sum(&values[half..]);
    }
    let mut lanes = [0.0; 8];
    lanes.copy_from_slice(&values[..8]);
    let chunks = values[8..].chunks_exact(8);
    let rest = chunks.remainder();
    for chunk in chunks {
        lanes.iter_mut().zip(chunk).for_each(|(lane, value)| *lane += value);
    }
    let [a, b, c, d, e, f, g, h] = lanes;
    rest.iter().fold(((a + b) + (c + d)) + ((e + f) + (g + h)), |total, value| total + value)
}

/// Mean of values; not a number where there are none.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn mean(values: &[f64]) -> f64 {
    sum(values) / values.len() as f64
}

/// Root of the mean of squares; infinite beyond the numbers.
#[must_use]
pub fn root_mean_square(values: &[f64]) -> f64 {
    mean(&values.iter().map(|v| v * v).collect::<Vec<_>>()).sqrt()
}

/// Deviation of normal values from the median of their sizes, which a few that are far off do not move; 0 of none.
///
/// ```
/// let found = ftlm::signal::statistics::robust_deviation(&[1.0, -2.0, 3.0, -1000.0]);
/// assert!((found - 2.5 / ftlm::signal::statistics::MAD).abs() < 1e-12);
/// ```
#[must_use]
pub fn robust_deviation(values: &[f64]) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    median(values.iter().map(|v| v.abs()).collect()) / MAD
}

/// The middle one of values, or the mean of the two in the middle; not a number of none.
///
/// ```
/// assert_eq!(ftlm::signal::statistics::median(vec![3.0, 1.0, 8.0, 2.0]), 2.5);
/// ```
#[must_use]
pub fn median(mut values: Vec<f64>) -> f64 {
    let count = values.len();
    if count == 0 {
        return f64::NAN;
    }
    let (below, &mut upper, _) = values.select_nth_unstable_by(count / 2, f64::total_cmp);
    match count % 2 {
        0 => f64::midpoint(below.iter().copied().fold(f64::NEG_INFINITY, f64::max), upper),
        _ => upper,
    }
}

/// Autocovariances of series at lags from 0 to `most`, and how many pairs each is the mean of. What is no number is not
/// there; each series is taken about its own mean, and they are pooled. O(most · N).
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn autocovariances(series: &[&[f64]], most: usize) -> (Vec<f64>, Vec<f64>) {
    let (mut sums, mut pairs) = (vec![0.0; most + 1], vec![0.0; most + 1]);
    for values in series {
        let there: Vec<f64> = values.iter().copied().filter(|v| !v.is_nan()).collect();
        let centre = if there.is_empty() { 0.0 } else { mean(&there) };
        let x: Vec<f64> = values.iter().map(|v| if v.is_nan() { 0.0 } else { v - centre }).collect();
        let gaps = there.len() < values.len();
        let known: Vec<f64> = if gaps { values.iter().map(|v| f64::from(!v.is_nan())).collect() } else { Vec::new() };
        for lag in 0..(most + 1).min(x.len()) {
            sums[lag] += inner(&x[lag..], &x[..x.len() - lag]);
            pairs[lag] += if gaps { inner(&known[lag..], &known[..x.len() - lag]) } else { (x.len() - lag) as f64 };
        }
    }
    sums.iter_mut().zip(&pairs).for_each(|(sum, count)| *sum /= count.max(1.0));
    (sums, pairs)
}

/// Whether autocorrelations up to some lags could be those of white noise: Ljung and Box's test at 1 %. Where some values are
/// not there, each correlation has the variance of its own pairs.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn is_white(series: &[f64], lags: usize) -> bool {
    if series.len() <= lags + 1 {
        return true;
    }
    let (covariances, pairs) = autocovariances(&[series], lags);
    if pairs[0] <= (lags + 1) as f64 {
        return true;
    }
    let power = covariances[0] * pairs[0];
    let of = |lag: usize| covariances[lag] * pairs[lag] / if power > 0.0 { power } else { 1.0 };
    let summed: f64 = (1..=lags).map(|lag| of(lag) * of(lag) / pairs[lag].max(1.0)).sum();
    (pairs[0] + 2.0) * pairs[0] * summed <= chi_squared(lags as f64, NORMAL_99)
}

/// Value that chi-squared exceeds as often as a normal variable exceeds `quantile`, by Wilson and Hilferty: good to 0.3 %
/// from five degrees of freedom, to 1 % from one.
#[must_use]
pub fn chi_squared(degrees: f64, quantile: f64) -> f64 {
    let spread = 2.0 / (9.0 * degrees);
    degrees * libm::pow(1.0 - spread + quantile * spread.sqrt(), 3.0)
}
