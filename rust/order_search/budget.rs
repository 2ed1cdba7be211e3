//! What a search will hold at once, counted before any of it is made, and the one limit that it keeps to.
//!
//! Counted is what grows with records and lattice: columns, kernels, their products, spectra and test vectors of every
//! equation and record, rows of the layout of an order law; tables of boxes and vectors made for candidates take of what is
//! left, or there are none. Not counted are the records themselves, and what each thread needs for one candidate: some
//! vectors of the record's length.

use crate::error::{Error, Result};
use crate::fft::{fast_length, Bin};
use crate::order_search::options::{Criterion, Options};
use crate::regressors::{Bank, Index, Record};

const VALUE: u128 = size_of::<f64>() as u128;

/// What was asked for, summed up.
#[derive(Debug, Default)]
pub(crate) struct Budget {
    bytes: u128,
    columns: usize,
    layout: u128,
}

impl Budget {
    /// Rows of a layout, in bytes.
    pub(crate) fn add_layout(&mut self, bytes: u128) {
        self.layout += bytes;
        self.bytes += bytes;
    }

    /// What the candidates of one equation share; `vectors` test vectors at most.
    pub(crate) fn add(&mut self, records: &[Record], output: usize, index: &Index, options: &Options, vectors: usize) {
        let width = index.keys().len() as u128;
        let own = Bank::own(index, output) as u128;
        let refined = options.refines();
        let bounded = options.early_stopping && !options.scored_by_products() && vectors > 0;
        let mut largest = 0;
        for record in records {
            let m = record.m();
            let bank = VALUE * m as u128 * (width + own);
            largest = bank.max(largest);
            // The target beside it.
            self.bytes += bank + VALUE * m as u128;
            if refined {
                let spectrum = (size_of::<Bin>() * (fast_length(2 * m) / 2 + 1)) as u128;
                self.bytes += spectrum * (width + own + 1);
                // D e = w holds for integrals of the output as it was measured: another bank.
                if bounded && options.criterion == Criterion::OutputError {
                    self.bytes += bank;
                }
            }
            if bounded {
                // Real and imaginary part with every column and the target, once as they come and once as they are kept;
                // four numbers an own column; the vectors.
                let vectors = vectors as u128;
                self.bytes += VALUE * vectors * (4 * (width + 1) + 4 * own + 2 * m as u128);
            }
        }
        // Products of all columns and the target: of each record at rest apart, of all, as they are summed.
        let products = VALUE * (3 + records.len() as u128) * (width + 1).pow(2);
        // Of the banks behind which the first coefficients are estimated there is one at a time.
        self.bytes += products + if refined { largest } else { 0 };
        self.columns += index.keys().len();
    }

    /// Bytes that are left of a limit.
    pub(crate) fn left(&self, limit: u64) -> u64 {
        u128::from(limit).saturating_sub(self.bytes).try_into().unwrap_or(u64::MAX)
    }

    /// Refuses what does not fit.
    ///
    /// # Errors
    /// [`Error::Memory`].
    pub(crate) fn check(&self, limit: u64) -> Result<()> {
        let limit = u128::from(limit);
        if self.bytes <= limit {
            return Ok(());
        }
        let layout = if self.layout > 0 { " and the layout of the order law" } else { "" };
        let what = format!("{} regressors of all runs, their products and test vectors{layout}", self.columns);
        Err(Error::Memory { what, bytes: self.bytes, limit })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_of_a_limit_is_never_below_nothing() {
        let mut budget = Budget::default();
        assert_eq!(budget.left(u64::MAX), u64::MAX);
        budget.add_layout(1000);
        assert_eq!([999, 1000, 1500].map(|limit| budget.left(limit)), [0, 0, 500]);
        budget.add_layout(u128::from(u64::MAX));
        assert_eq!(budget.left(u64::MAX), 0);
    }
}
