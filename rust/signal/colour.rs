//! Colour of noise: an autoregression of what a model leaves, and the autocovariances that it tells.

use crate::fft::{plan, Bin, Workspace};
use crate::signal::statistics::autocovariances;

/// An autoregression has at most one coefficient for so many samples of the shortest run.
const SAMPLES_A_COEFFICIENT: usize = 10;
/// Least points of a circle of frequencies: on it a colour of 0.99 a sample has died away.
const LEAST_CIRCLE: usize = 4096;

/// The whitening filter 1, a₁, …, aₙ of series that share one colour, and the power that it leaves.
///
/// Yule-Walker's equations by Levinson and Durbin (doi:10.1093/biomet/47.3-4.233), covariances pooled over the series and
/// each about its own mean; the order, `most` at most, is that of the least Bayesian information criterion. What is no
/// number is not there.
///
/// ```
/// // Every other value the opposite: x_k = −0.9 x_{k−1} and what does not follow from it.
/// let mut x = vec![1.0];
/// (0..399_u32).for_each(|k| x.push(-0.9 * x[k as usize] + f64::from(k % 7) / 7.0 - 3.0 / 7.0));
/// let (filter, power) = ftlm::signal::colour::coloured(&[&x], 5);
/// assert!(filter.len() > 1 && power > 0.0);
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn coloured(series: &[&[f64]], most: usize) -> (Vec<f64>, f64) {
    let counts: Vec<usize> = series.iter().map(|x| x.iter().filter(|v| !v.is_nan()).count()).collect();
    let most = most.min(counts.iter().min().copied().unwrap_or(0) / SAMPLES_A_COEFFICIENT);
    let (mut covariance, pairs) = autocovariances(series, most);
    let (count, all) = (counts.iter().sum::<usize>() as f64, series.iter().map(|x| x.len()).sum::<usize>() as f64);
    for (lag, (value, &of)) in covariance.iter_mut().zip(&pairs).enumerate() {
        // A lag whose pairs are few counts for as little: all lags together remain those of one positive spectrum.
        let whole = series.iter().map(|x| x.len().saturating_sub(lag)).sum::<usize>() as f64;
        *value *= if of > 0.0 { (if whole > 0.0 { whole } else { 1.0 }) / all } else { 0.0 };
    }
    let (mut best, mut current) = (vec![1.0], vec![1.0]);
    let mut power = covariance[0];
    let mut left = power;
    if power.is_nan() || power <= 0.0 {
        return (best, 0.0);
    }
    let mut least = count * libm::log(power);
    for order in 1..=most {
        let reflection =
            -current.iter().zip(covariance[1..=order].iter().rev()).map(|(a, c)| a * c).sum::<f64>() / power;
        current.push(0.0);
        let turned: Vec<f64> = current.iter().rev().copied().collect();
        current.iter_mut().zip(turned).for_each(|(a, b)| *a += reflection * b);
        power *= 1.0 - reflection * reflection;
        if power.is_nan() || power <= 0.0 {
            break;
        }
        let criterion = count * libm::log(power) + order as f64 * libm::log(count);
        if criterion < least {
            (least, left) = (criterion, power);
            best.clone_from(&current);
        }
    }
    (best, left)
}

/// Autocovariances at lags 0 to `count` − 1 of noise that a filter makes white, of this power then.
#[must_use]
pub fn covariances(filter: &[f64], power: f64, count: usize) -> Vec<f64> {
    // Its spectrum, on a circle so fine that what wraps round has died away.
    let size = power_above(2 * count + 8 * filter.len()).max(LEAST_CIRCLE);
    let plan = plan(size);
    let mut time = filter.to_vec();
    time.resize(size, 0.0);
    let (mut spectrum, mut workspace) = (vec![Bin::new(0.0, 0.0); plan.bins()], Workspace::new());
    plan.forward(&mut time, &mut spectrum, &mut workspace);
    spectrum.iter_mut().for_each(|bin| *bin = Bin::new(power / bin.norm_sqr(), 0.0));
    plan.inverse(&mut spectrum, &mut time, &mut workspace);
    time.truncate(count);
    time
}

/// Rows times the matrix of a series' autocovariances, row by row: as a product on a circle that holds them. O(N log N) a
/// row.
#[must_use]
pub fn weighted(rows: &[&[f64]], covariances: &[f64]) -> Vec<Vec<f64>> {
    let count = covariances.len();
    let size = power_above(2 * count);
    let plan = plan(size);
    let mut time = vec![0.0; size];
    time[..count].copy_from_slice(covariances);
    for lag in 1..count {
        time[size - lag] = covariances[lag];
    }
    let (mut circle, mut workspace) = (vec![Bin::new(0.0, 0.0); plan.bins()], Workspace::new());
    plan.forward(&mut time, &mut circle, &mut workspace);
    let mut spectrum = circle.clone();
    rows.iter()
        .map(|row| {
            time[..count].copy_from_slice(row);
            time[count..].fill(0.0);
            plan.forward(&mut time, &mut spectrum, &mut workspace);
            // The spectrum of what is even is real.
            spectrum.iter_mut().zip(&circle).for_each(|(bin, of)| *bin *= of.re);
            plan.inverse(&mut spectrum, &mut time, &mut workspace);
            time[..count].to_vec()
        })
        .collect()
}

/// The least power of two above a number.
fn power_above(number: usize) -> usize {
    1 << (usize::BITS - number.leading_zeros())
}
