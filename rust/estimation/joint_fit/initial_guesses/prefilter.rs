//! Low-passes before coarse lattices.

use std::sync::{Arc, Mutex, PoisonError};

use crate::equation::Filter;
use crate::error::Result;
use crate::regressors::Record;
use crate::series;

/// Series of prefilters that are kept: those of a few runs.
const KEPT_LOW_PASSES: usize = 32;

/// What a low-pass hangs on: the bits of its corner, the pulses, the bits of their width.
type Key = (u64, usize, u64);

/// The series of second-order low-passes: the same ones for every problem inside a race.
#[derive(Debug, Default)]
pub(super) struct LowPasses(Mutex<Vec<(Key, Arc<Vec<f64>>)>>);

impl LowPasses {
    /// All signals and the initial terms of a record through the low-pass of this corner \[rad/s\]; as it is without one.
    pub(super) fn through(&self, record: &Record, corner: Option<f64>) -> Result<Record> {
        let m = record.m();
        let low_pass = corner.map(|corner| self.series(corner, m, record.step())).transpose()?;
        let signals = (0..record.len()).map(|i| record.signal(i));
        let Some(low_pass) = low_pass else {
            // Equations are taken from what was measured, wherever it began.
            return Record::new(record.step(), signals.map(<[f64]>::to_vec).collect(), record.filter().map(Into::into));
        };
        let filter = record.filter().map_or_else(|| low_pass.to_vec(), |f| series::multiply(&low_pass, f, m));
        Record::new(record.step(), signals.map(|s| series::multiply(&low_pass, s, m)).collect(), Some(filter))
    }

    /// The series of a second-order low-pass of this corner \[rad/s\].
    fn series(&self, omega: f64, m: usize, step: f64) -> Result<Arc<Vec<f64>>> {
        let key = (omega.to_bits(), m, step.to_bits());
        {
            let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(at) = kept.iter().position(|(k, _)| *k == key) {
                let found = kept.remove(at);
                let series = found.1.clone();
                kept.push(found);
                return Ok(series);
            }
        }
        let square = omega * omega;
        let denominator = vec![(1.0, 2.0), (1.4 * omega, 1.0), (square, 0.0)];
        let made = Arc::new(Filter { numerator: vec![(square, 0.0)], denominator }.series(m, step)?);
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.push((key, made.clone()));
        if kept.len() > KEPT_LOW_PASSES {
            kept.remove(0);
        }
        Ok(made)
    }
}
