//! Richardson table: limit of samples for zero step, from simulations on grids of block pulses with the steps h, h/2,
//! h/4, ….

/// Samples or pulse means, one row per output.
pub(super) type Rows = Vec<Vec<f64>>;

/// Powers of the step in the error of a sample. The block-pulse scheme has the power 2, and the extrapolation to a
/// sample time 3. The next term of both has the power 4. A slope discontinuity t^η adds intermediate powers, which the
/// columns of the table do not eliminate. No column increases such an error by more than a small factor.
const ERROR_POWERS: [i32; 3] = [2, 3, 4];
/// Minimum ratio of the measured reduction factor to 2^power. The reduction factor is the change at the previous
/// halving of the step divided by the change at the last halving. Above this ratio, the error of a column counts as
/// proportional to step^power.
const MIN_POWER_RATIO: f64 = 0.5;
/// Minimum reduction factor of the change per halving of the step, for an error of unknown power. It is slightly below
/// √2.
const MIN_REDUCTION_FACTOR: f64 = 1.4;
const MIN_EFFECTIVE_SAMPLES: f64 = 8.0;
/// Number of grids that are needed to estimate a reduction factor of the changes ([`MIN_POWER_RATIO`]) and to test it.
const RATIO_TEST_GRIDS: usize = 4;

/// Function of the rows on a finer and on a coarser grid. It returns the largest change of each output, relative to the
/// largest magnitude of the output.
pub(super) type Measure<'a> = &'a dyn Fn(&Rows, &Rows) -> Vec<f64>;

/// Return the largest absolute value; NaN if any value is NaN.
pub(super) fn peak(row: &[f64]) -> f64 {
    row.iter().fold(0.0, |largest: f64, v| if v.is_nan() || largest.is_nan() { f64::NAN } else { largest.max(v.abs()) })
}

/// Return the largest change of each row, relative to the largest absolute value of the new row.
pub(super) fn relative_change(new: &Rows, old: &Rows) -> Vec<f64> {
    let relative_peak = |(change, new): (Vec<f64>, &Vec<f64>)| match peak(&change) {
        0.0 => 0.0,
        largest => largest / peak(new),
    };
    combine(new, old, |n, o| n - o).into_iter().zip(new).map(relative_peak).collect()
}

pub(super) fn combine(first: &Rows, second: &Rows, operation: impl Fn(f64, f64) -> f64) -> Rows {
    first.iter().zip(second).map(|(a, b)| a.iter().zip(b).map(|(a, b)| operation(*a, *b)).collect()).collect()
}

pub(super) fn add_multiple(sum: &mut [f64], factor: f64, values: &[f64]) {
    sum.iter_mut().zip(values).for_each(|(sum, v)| *sum += factor * v);
}

/// Estimate of samples and initial terms in the limit of zero step.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LimitEstimate {
    /// Samples of each output in the limit.
    pub samples: Vec<Vec<f64>>,
    /// Change of each output that is expected if the step is halved again, relative to the largest magnitude of the
    /// output. It is infinite if fewer than three grids were added.
    pub change: Vec<f64>,
    /// Coefficients of the initial terms in the limit.
    pub terms: Vec<f64>,
}

impl LimitEstimate {
    fn largest_change(&self) -> f64 {
        largest_change(&self.change)
    }
}

/// Return the largest change; infinite if a change is NaN.
fn largest_change(change: &[f64]) -> f64 {
    change.iter().fold(0.0, |largest: f64, c| if c.is_nan() { f64::INFINITY } else { largest.max(*c) })
}

/// Row of the Richardson table for one grid. Each column holds samples and the coefficients of initial terms. The first
/// column is not extrapolated, and each further column eliminates one more power of the step. `changes` holds the
/// change of each column from the previous grid.
struct Grid {
    columns: Vec<(Rows, Vec<f64>)>,
    changes: Vec<Vec<f64>>,
}

/// Richardson table of the most recent grids, finest last.
#[derive(Default)]
pub(super) struct RichardsonTable {
    grids: Vec<Grid>,
}

impl RichardsonTable {
    /// Add the samples and initial terms on the next grid, whose step is half of the last one. Extrapolation starts
    /// anew after samples that are not finite.
    pub(super) fn add(&mut self, samples: Rows, terms: Vec<f64>, measure: Measure<'_>) {
        let is_finite = |rows: &Rows| rows.iter().flatten().all(|v| v.is_finite());
        let unknown_change = vec![f64::INFINITY; samples.len()];
        let previous_columns = self.grids.last().map_or(&[][..], |grid| &grid.columns);
        let can_extrapolate = previous_columns.first().is_some_and(|(rows, _)| is_finite(rows)) && is_finite(&samples);
        let mut columns = vec![(samples, terms)];
        for (power, (rows, terms)) in ERROR_POWERS.iter().zip(previous_columns).filter(|_| can_extrapolate) {
            let factor = 2.0_f64.powi(*power);
            let eliminate_power = |fine: f64, coarse: f64| (factor * fine - coarse) / (factor - 1.0);
            let (fine, fine_terms) = &columns[columns.len() - 1];
            let terms = fine_terms.iter().zip(terms).map(|(f, c)| eliminate_power(*f, *c)).collect();
            columns.push((combine(fine, rows, eliminate_power), terms));
        }
        // The change of the samples themselves is not used, because their extrapolation changes less.
        let changes = columns.iter().zip(previous_columns).enumerate().map(|(k, ((new, _), (old, _)))| match k {
            0 => unknown_change.clone(),
            _ => measure(new, old),
        });
        let changes = changes.collect();
        self.grids.push(Grid { columns, changes });
        if self.grids.len() > RATIO_TEST_GRIDS {
            self.grids.remove(0);
        }
    }

    /// Return the estimate with the smallest expected change if the step is halved again; None before the first
    /// simulation.
    ///
    /// `output_indices` holds the output index of each initial term. `measure` gives the change of each output between
    /// two estimates. An estimate is returned immediately if it is expected to change no output by more than
    /// `tolerance`.
    pub(super) fn estimate(
        &self,
        output_indices: &[usize],
        tolerance: f64,
        measure: Measure<'_>,
    ) -> Option<LimitEstimate> {
        let grid = self.grids.last()?;
        let (column, change) = self.best_column(grid);
        let (samples, terms) = grid.columns[column].clone();
        let mut best_estimate = LimitEstimate { samples, change, terms };
        if self.grids.len() < RATIO_TEST_GRIDS || best_estimate.change.iter().all(|c| *c <= tolerance) {
            return Some(best_estimate);
        }
        for column in 0..self.grids.iter().map(|grid| grid.columns.len()).min().unwrap_or(0) {
            if let Some(ratio_estimate) = self.estimate_by_ratio(column, output_indices, measure)
                && ratio_estimate.largest_change() < best_estimate.largest_change()
            {
                best_estimate = ratio_estimate;
            }
        }
        Some(best_estimate)
    }

    /// Extrapolate a column whose error has an unknown power of the step. None unless the last two halvings of the step
    /// both give a reduction factor.
    ///
    /// Slope discontinuities t^η add intermediate powers, and coinciding orders add logarithms, which the table does
    /// not eliminate.
    fn estimate_by_ratio(
        &self,
        column: usize,
        output_indices: &[usize],
        measure: Measure<'_>,
    ) -> Option<LimitEstimate> {
        let [(oldest, _), (older, _), (old, second), (new, third)] =
            [0, 1, 2, 3].map(|k| &self.grids[k].columns[column]);
        let (previous_ratios, ratios) =
            (remaining_change_ratios(oldest, older, old)?, remaining_change_ratios(older, old, new)?);
        let extrapolate = |new: &Rows, old: &Rows, ratios: &[f64]| -> Rows {
            let extrapolate_row =
                |((n, o), r): ((&Vec<f64>, &Vec<f64>), &f64)| n.iter().zip(o).map(|(n, o)| n + r * (n - o)).collect();
            new.iter().zip(old).zip(ratios).map(extrapolate_row).collect()
        };
        let samples = extrapolate(new, old, &ratios);
        let change = measure(&samples, &extrapolate(old, older, &previous_ratios));
        let terms = third.iter().zip(second).zip(output_indices).map(|((t, s), &o)| t + ratios[o] * (t - s)).collect();
        Some(LimitEstimate { samples, change, terms })
    }

    /// Return the column with the smallest expected change if the step is halved again, and this change of each output.
    fn best_column(&self, grid: &Grid) -> (usize, Vec<f64>) {
        let count = grid.columns.len();
        let mut best = (if count <= 2 { count - 1 } else { 1 }, vec![f64::INFINITY; grid.columns[0].0.len()]);
        let previous_changes = self.grids.len().checked_sub(2).map_or(&[][..], |k| &self.grids[k].changes);
        for (column, change) in grid.changes.iter().enumerate().skip(1) {
            let mut columns = vec![(column, change.clone())];
            if let (Some(previous_change), true) = (previous_changes.get(column), column + 1 < count) {
                let factor = 2.0_f64.powi(ERROR_POWERS[column]);
                // If the error of a column is proportional to its power of the step, the next column eliminates it.
                if change.iter().zip(previous_change).all(|(c, b)| c * (MIN_POWER_RATIO * factor) <= *b) {
                    columns.push((column + 1, change.iter().map(|c| c / (factor - 1.0)).collect()));
                }
            }
            for candidate in columns {
                if largest_change(&candidate.1) < largest_change(&best.1) {
                    best = candidate;
                }
            }
        }
        best
    }
}

/// Return, for each output, the ratio of the remaining change in the limit of zero step to the last change. The changes
/// are assumed to decrease by a constant factor per halving of the step.
///
/// This is Aitken's method with one factor for all samples of an output. None if only few samples of an output change,
/// or if the changes decrease too slowly.
fn remaining_change_ratios(older: &Rows, old: &Rows, new: &Rows) -> Option<Vec<f64>> {
    let (last_change, previous_change) = (combine(new, old, |n, o| n - o), combine(old, older, |n, o| n - o));
    let remaining_ratio = |(last_change, previous_change): (&Vec<f64>, &Vec<f64>)| {
        let change_peak = peak(last_change);
        let scaled_change: Vec<f64> =
            last_change.iter().map(|v| v / if change_peak > 0.0 { change_peak } else { 1.0 }).collect();
        let squares: f64 = scaled_change.iter().map(|u| u * u).sum();
        if squares == 0.0 {
            return Some(0.0);
        }
        let ratio =
            scaled_change.iter().zip(previous_change).map(|(u, b)| u * b).sum::<f64>() / (squares * change_peak);
        let fourth_powers: f64 = scaled_change.iter().map(|u| u.powi(4)).sum();
        let is_local = squares * squares < MIN_EFFECTIVE_SAMPLES * fourth_powers;
        (ratio >= MIN_REDUCTION_FACTOR && !is_local).then(|| 1.0 / (ratio - 1.0))
    };
    last_change.iter().zip(&previous_change).map(remaining_ratio).collect()
}

/// Extrapolate samples and initial terms, simulated with the steps h, h/2, h/4, …, to zero step.
///
/// `grids` holds (samples of each output, coefficients of the initial terms) for each step, and `output_indices` the
/// output index of each initial term. The estimate is a column of the Richardson table, or its extrapolation by
/// Aitken's method. The one with the smallest expected change if the step is halved again is returned. None without
/// grids.
///
/// ```
/// use ftlm::output_samples::richardson_limit;
/// let grid = |h: f64| vec![(0..20).map(|k| f64::from(k).sin() + h * h * f64::from(k).cos()).collect::<Vec<f64>>()];
/// let limit = richardson_limit([1.0, 0.5, 0.25].map(|h| (grid(h), Vec::new())), &[]).unwrap_or_default();
/// assert!((limit.samples[0][7] - 7.0_f64.sin()).abs() < 1e-14 && limit.change[0] < 1e-14);
/// ```
#[must_use]
pub fn richardson_limit(
    grids: impl IntoIterator<Item = (Vec<Vec<f64>>, Vec<f64>)>,
    output_indices: &[usize],
) -> Option<LimitEstimate> {
    let mut table = RichardsonTable::default();
    grids.into_iter().for_each(|(samples, terms)| table.add(samples, terms, &relative_change));
    table.estimate(output_indices, 0.0, &relative_change)
}
