//! Progress of a fit, which never decreases.

use crate::error::Result;

/// Number of parts into which the progress of a fit is divided.
pub const PROGRESS_PARTS: usize = 1000;

/// Progress callback with the number of finished parts and [`PROGRESS_PARTS`]. An error that it returns ends the fit.
pub type ProgressListener<'a> = dyn Fn(usize, usize) -> Result<()> + 'a;

/// Progress of a fit between 0 and 1, over phases of unknown length.
pub struct FitProgress<'a> {
    listener: &'a ProgressListener<'a>,
    share_done: f64,
    reported_parts: Option<usize>,
    phase_start: f64,
    last: f64,
}

impl<'a> FitProgress<'a> {
    /// Return the progress at the start of a fit, which is reported to the callback `listener`.
    #[must_use]
    pub fn new(listener: &'a ProgressListener<'a>) -> Self {
        Self { listener, share_done: 0.0, reported_parts: None, phase_start: 0.0, last: 0.0 }
    }

    /// Advance to `fraction` of the whole fit, and report it.
    ///
    /// # Errors
    /// The error of the callback.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn advance_to(&mut self, fraction: f64) -> Result<()> {
        self.share_done = self.share_done.max(fraction.min(1.0));
        let parts = (PROGRESS_PARTS as f64 * self.share_done).round_ties_even() as usize;
        if self.reported_parts.is_some_and(|reported| parts <= reported) {
            return Ok(());
        }
        self.reported_parts = Some(parts);
        (self.listener)(parts, PROGRESS_PARTS)
    }

    /// Advance within a phase that ends at the fraction `phase_end` of the whole fit.
    ///
    /// A phase consists of sweeps, in each of which `count` increases from 0 to `total`. Each sweep takes the fraction
    /// `sweep` of the rest of the phase.
    ///
    /// # Errors
    /// The error that the callback returns ([`FitProgress::advance_to`]).
    #[allow(clippy::cast_precision_loss)]
    pub fn advance_within(&mut self, phase_end: f64, sweep: f64, count: usize, total: usize) -> Result<()> {
        let sweep_fraction = count as f64 / total.max(1) as f64;
        if sweep_fraction < self.last {
            self.phase_start = self.share_done;
        }
        self.last = sweep_fraction;
        self.advance_to(self.phase_start + sweep * (phase_end - self.phase_start) * sweep_fraction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;

    #[test]
    fn progress_is_monotone_and_sweeps_share_the_rest() {
        let reports = RefCell::new(Vec::new());
        let listener = |count: usize, total: usize| {
            reports.borrow_mut().push((count, total));
            Ok(())
        };
        let mut progress = FitProgress::new(&listener);
        for (count, total) in [(0, 4), (2, 4), (4, 4), (0, 2), (1, 2), (1, 2)] {
            assert_eq!(progress.advance_within(0.5, 0.3, count, total), Ok(()));
        }
        assert_eq!((progress.advance_to(0.5), progress.advance_to(0.2)), (Ok(()), Ok(())));
        let parts: Vec<usize> = reports.borrow().iter().map(|(count, _)| *count).collect();
        assert_eq!(parts, [0, 75, 150, 202, 500]);
    }
}
