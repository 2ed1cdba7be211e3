//! Refinement of the coefficients of a candidate by refined instrumental variables.
//!
//! The spectra of all regressors are computed once and used for all candidates.

use crate::error::{Error, Result};
use crate::estimation::instrumental_variables::{
    low_pass, power_frequency, refine, InstrumentSource, InstrumentalSettings, Scratch,
};
use crate::order_search::result::Failure;
use crate::parallel::{self, Stop};
use crate::regressors::{Bank, Index, Record};
use crate::series::Kernel;

/// Cutoff frequency of the low-pass filter, relative to the bandwidth of the output. Initial coefficients are estimated
/// from the filtered signals.
const START_BANDWIDTH_RATIO: f64 = 2.0;

/// Spectra of one record, used for the refinement of all candidates.
struct RecordSpectra {
    /// Spectrum of each column of the bank.
    columns: Vec<Kernel>,
    /// Spectrum of the kernel of each output column. `None` for other columns.
    kernels: Vec<Option<Kernel>>,
    /// Spectrum of the measured output.
    target: Kernel,
}

/// Refinement of coefficients by instrumental variables.
pub(crate) struct Refiner {
    spectra: Vec<RecordSpectra>,
    settings: InstrumentalSettings,
}

impl Refiner {
    /// Compute the spectra of the columns of `banks`, which are built from the noise-free signals of the records. The
    /// result is invalid after a stop request.
    pub(crate) fn new(
        records: &[Record],
        output: usize,
        banks: &[Bank],
        settings: InstrumentalSettings,
        stop: &Stop,
    ) -> Self {
        let spectra = records
            .iter()
            .zip(banks)
            .map(|(record, bank)| {
                let all = || (0..bank.len()).collect();
                let spectrum = |x: &[f64]| Kernel::new(if stop.is_set() { &[] } else { x });
                RecordSpectra {
                    columns: parallel::map(all(), || (), |(), p| spectrum(bank.column(p))),
                    kernels: parallel::map(
                        all(),
                        || (),
                        |(), p| Some(bank.kernel(p)).filter(|k| !k.is_empty()).map(spectrum),
                    ),
                    target: spectrum(record.signal(output)),
                }
            })
            .collect();
        Self { spectra, settings }
    }

    /// Refine the coefficients of the terms (`coefficients`) and of the initial terms of each record (`weights`) in
    /// place. If the refinement fails, return the reason as the error. The result is invalid after a stop request.
    pub(crate) fn refine(
        &self,
        (banks, targets): (&[Bank], &[Vec<f64>]),
        (positions, initial): (&[usize], &[usize]),
        fixed: &[Option<f64>],
        coefficients: &mut [f64],
        weights: &mut [f64],
        stop: &Stop,
    ) -> std::result::Result<(), Failure> {
        let sources: Vec<InstrumentSource<'_>> = self
            .spectra
            .iter()
            .zip(banks)
            .zip(targets)
            .map(|((spectra, bank), target)| InstrumentSource {
                output_terms: positions
                    .iter()
                    .map(|&p| spectra.kernels[p].as_ref().map(|k| (bank.kernel(p), k)))
                    .collect(),
                measured: positions.iter().map(|&p| &spectra.columns[p]).collect(),
                clean: positions.iter().map(|&p| &spectra.columns[p]).collect(),
                initial: initial.iter().map(|&p| &spectra.columns[p]).collect(),
                target: &spectra.target,
                output: target,
            })
            .collect();
        let start: Vec<f64> = coefficients.iter().chain(weights.iter()).copied().collect();
        // An initial term with coefficient 0 in the initial guess is a linear combination of others.
        let n = initial.len();
        let excluded_terms: Vec<(usize, usize)> =
            weights.iter().enumerate().filter(|(_, w)| **w == 0.0).map(|(i, _)| (i / n, i % n)).collect();
        match refine(&sources, fixed, &excluded_terms, &start, self.settings, &mut Scratch::with_stop(stop)) {
            Ok((solution, _, _)) if solution.iter().all(|x| x.is_finite()) => {
                let (terms, initial_coefficients) = solution.split_at(coefficients.len());
                coefficients.copy_from_slice(terms);
                weights.copy_from_slice(initial_coefficients);
                Ok(())
            }
            Ok(_) | Err(Error::Diverged { .. }) => Err(Failure::Diverged),
            Err(_) => Err(Failure::Singular),
        }
    }
}

/// Return the bank of regressors and the output from which initial coefficients are estimated. Both are computed from
/// noise-free, low-pass filtered signals.
///
/// # Errors
/// [`Error::Structure`] for a signal that the record lacks, [`Error::Interrupted`] after a stop request
/// ([`Bank::new_interruptible`]).
pub(crate) fn start_bank(record: &Record, output: usize, index: &Index, stop: &Stop) -> Result<(Bank, Vec<f64>)> {
    let cutoff = START_BANDWIDTH_RATIO * power_frequency(record.signal(output), record.step());
    let smooth = record.clean_record().with_filter(&low_pass(cutoff, record)?)?;
    let target = smooth.signal(output).to_vec();
    Ok((Bank::new_interruptible(index, &smooth, output, stop)?, target))
}
