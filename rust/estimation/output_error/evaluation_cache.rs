//! Cache of kernels and spectra across the evaluations of one optimization.
//!
//! The kernel of a term is the power series of its fractional operator. A kernel and its spectrum are computed again
//! only if the order of the term changes. Runs with the same step and filter share the kernels and spectra.

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;

use super::experiment::Experiment;
use super::kink_correction::KinkCache;
use super::parameterization::FreeModel;
use super::system_inverse::{
    filtered_spectrum, InitialTerm, Operator, PulseMeans, SeriesFilter, SystemInverse, MAX_CACHED_PULSES,
    SPECTRUM_FACTORS,
};
use crate::error::Result;
use crate::parallel::Stop;
use crate::regressors::Record;
use crate::series::Kernel;

/// Maximum number of cached powers of time for long records.
const MAX_POWERS_LONG_RECORD: usize = 8;
/// Maximum number of cached powers of time for short records.
const MAX_POWERS_SHORT_RECORD: usize = 64;

/// Minimum ratio of the length of a run to that of the longest run with the same cache.
///
/// Shorter runs would need unnecessarily long transforms.
const MIN_LENGTH_RATIO: f64 = 0.7;

/// Cache that runs with the same step and filter share. Its series have the length of the longest run.
///
/// It contains kernels, powers of time, and the inverse A⁻¹ of the system matrix at the last point.
struct GridCache {
    /// Record of zeros with the length of the longest run.
    zero_record: Record,
    /// Sensor filter of all signals.
    filter: Option<Rc<SeriesFilter>>,
    /// Number of runs that share the cache.
    runs: usize,
    /// Most recently used operator of each term, by index of its equation and of the term.
    operators: HashMap<(usize, usize), Rc<Operator>>,
    /// Initial terms t^e, by the bits of the exponent e.
    powers: HashMap<u64, Rc<InitialTerm>>,
    /// Inverse of the last system matrix, with the bits of the autoregressive terms as key.
    system_inverse: Option<(Vec<u64>, Rc<SystemInverse>)>,
}

impl GridCache {
    /// Return true if an experiment can share the cache of a longer one.
    fn accepts(&self, experiment: &Experiment) -> bool {
        let record = &experiment.record;
        let filters_match = match (self.zero_record.filter(), record.filter()) {
            (None, None) => true,
            (Some(long_filter), Some(short_filter)) => long_filter.starts_with(short_filter),
            _ => false,
        };
        let longest_pulses = self.zero_record.m();
        filters_match
            && self.zero_record.step().to_bits() == record.step().to_bits()
            && record.m() <= longest_pulses
            && record.m() as f64 >= MIN_LENGTH_RATIO * longest_pulses as f64
    }
}

/// Cache of one experiment across evaluations.
pub(crate) struct EvaluationCache {
    /// Cancellation flag, checked within an evaluation.
    pub(crate) stop: Stop,
    grid_cache: Rc<RefCell<GridCache>>,
    /// Length to which series are padded for their spectra.
    pub(crate) total: usize,
    /// Spectra of inputs without a free parameter, by signal and by a flag that is true for a negative integration
    /// order.
    input_spectra: HashMap<(usize, bool), Rc<Kernel>>,
    /// The weighted samples of the responses of the sensor filters to impulses, by output and bits of the exponent.
    impulses: HashMap<(usize, u64), Vec<f64>>,
    /// Kinks of the outputs at nonuniform sample times.
    pub(crate) kinks: KinkCache,
}

impl EvaluationCache {
    /// Return one cache per experiment. Experiments with the same step and filter share a part of it.
    ///
    /// # Errors
    /// An error if a record of zeros cannot be built ([`Record::new`]).
    pub(crate) fn for_experiments(experiments: &[Experiment], stop: &Stop) -> Result<Vec<Self>> {
        let mut indices_by_length: Vec<usize> = (0..experiments.len()).collect();
        indices_by_length.sort_by_key(|&k| std::cmp::Reverse(experiments[k].record.m()));
        let mut grid_caches: Vec<Rc<RefCell<GridCache>>> = Vec::new();
        let mut indexed_caches: Vec<(usize, Rc<RefCell<GridCache>>)> = Vec::with_capacity(experiments.len());
        for k in indices_by_length {
            let grid_cache = match grid_caches.iter().find(|grid_cache| grid_cache.borrow().accepts(&experiments[k])) {
                Some(cached) => cached.clone(),
                None => {
                    let record = &experiments[k].record;
                    let zero_record = Record::from_rows(
                        record.step(),
                        vec![vec![0.0; record.m()]],
                        record.filter().map(<[f64]>::to_vec),
                    )?;
                    let filter = record.filter().map(|series| Rc::new(SeriesFilter::new(series)));
                    let (operators, powers) = (HashMap::new(), HashMap::new());
                    let grid_cache = Rc::new(RefCell::new(GridCache {
                        zero_record,
                        filter,
                        runs: 0,
                        operators,
                        powers,
                        system_inverse: None,
                    }));
                    grid_caches.push(grid_cache.clone());
                    grid_cache
                }
            };
            grid_cache.borrow_mut().runs += 1;
            indexed_caches.push((k, grid_cache));
        }
        indexed_caches.sort_by_key(|(k, _)| *k);
        let cache = |(_, grid_cache): (usize, Rc<RefCell<GridCache>>)| {
            let total = SPECTRUM_FACTORS * grid_cache.borrow().zero_record.m();
            Self {
                stop: stop.clone(),
                grid_cache,
                total,
                input_spectra: HashMap::new(),
                impulses: HashMap::new(),
                kinks: KinkCache::default(),
            }
        };
        Ok(indexed_caches.into_iter().map(cache).collect())
    }

    /// Return the responses of `n` outputs to initial terms t^e over at least `m` pulses.
    ///
    /// `terms` contains the pairs (index of the equation, e).
    ///
    /// # Errors
    /// [`crate::error::Error::Length`] for series that do not match the equations
    /// ([`SystemInverse::initial_term_responses`]).
    pub(crate) fn initial_term_responses(
        &self,
        inverse: &SystemInverse,
        (n, m): (usize, usize),
        terms: &[(usize, f64)],
    ) -> Result<Vec<Rc<PulseMeans>>> {
        let is_shared = self.is_shared();
        inverse.initial_term_responses((n, if is_shared { self.pulses() } else { m }), terms, is_shared, |exponent| {
            self.initial_term(exponent)
        })
    }

    /// Number of pulses of the longest run that shares the cache.
    pub(crate) fn pulses(&self) -> usize {
        self.grid_cache.borrow().zero_record.m()
    }

    /// Return true if several runs share the cache.
    fn is_shared(&self) -> bool {
        self.grid_cache.borrow().runs > 1
    }

    /// Return the operator of a term of integration order `eta`, from the cache if the order is unchanged.
    ///
    /// `term_index` contains the indices of equation and term. `is_free` is true for a free order.
    pub(crate) fn operator(&self, term_index: (usize, usize), eta: f64, is_free: bool) -> Rc<Operator> {
        let mut grid_cache = self.grid_cache.borrow_mut();
        if let Some(operator_from_cache) =
            grid_cache.operators.get(&term_index).filter(|o| o.eta().to_bits() == eta.to_bits())
        {
            return operator_from_cache.clone();
        }
        let (m, step) = (grid_cache.zero_record.m(), grid_cache.zero_record.step());
        // Terms of the same order share an operator.
        let same_order = grid_cache.operators.values().find(|o| o.matches_order(eta, is_free)).cloned();
        let new_operator = same_order.unwrap_or_else(|| Rc::new(Operator::new(eta, is_free, m, step)));
        grid_cache.operators.insert(term_index, new_operator.clone());
        new_operator
    }

    /// Return the inverse of the system matrix, computed by `compute` if it is not cached.
    ///
    /// The key `bits` contains the bit patterns of the numbers that define the autoregressive terms.
    ///
    /// # Errors
    /// The errors of `compute`.
    pub(crate) fn system_inverse(
        &self,
        bits: Vec<u64>,
        compute: impl FnOnce() -> Result<SystemInverse>,
    ) -> Result<Rc<SystemInverse>> {
        let cached = self
            .grid_cache
            .borrow()
            .system_inverse
            .as_ref()
            .filter(|(cached, _)| *cached == bits)
            .map(|(_, s)| s.clone());
        match cached {
            Some(inverse) => Ok(inverse),
            None => {
                // Free the memory of the old inverse before computing the new one.
                self.grid_cache.borrow_mut().system_inverse = None;
                let inverse = Rc::new(compute()?);
                if self.is_shared() {
                    self.grid_cache.borrow_mut().system_inverse = Some((bits, inverse.clone()));
                }
                Ok(inverse)
            }
        }
    }

    /// Return the spectrum of the signal of an input term with integration order `eta`. If the input has a free
    /// parameter, the signal is taken after its nonlinearity.
    ///
    /// The spectrum is padded for products of [`SPECTRUM_FACTORS`] series.
    pub(crate) fn input_spectrum(
        &mut self,
        model: &FreeModel,
        experiment: &Experiment,
        (signal, eta): (usize, f64),
        nonlinearity_outputs: &[(Vec<f64>, Vec<f64>)],
    ) -> Rc<Kernel> {
        if let Some(law) = model.law_of(signal) {
            return self.spectrum(&nonlinearity_outputs[law].0);
        }
        let series = experiment.record.term_signal(signal, eta);
        if experiment.record.m() > MAX_CACHED_PULSES {
            return self.spectrum(series);
        }
        let total = self.total;
        let spectrum = || Rc::new(Kernel::with_length(series, total));
        self.input_spectra.entry((signal, eta < 0.0)).or_insert_with(spectrum).clone()
    }

    /// Return the spectrum of a series, padded for products of [`SPECTRUM_FACTORS`] series.
    pub(crate) fn spectrum(&self, series: &[f64]) -> Rc<Kernel> {
        Rc::new(Kernel::with_length(series, self.total))
    }

    /// Return the initial term t^e with e = `exponent` over the length of the longest run.
    pub(crate) fn initial_term(&self, exponent: f64) -> Rc<InitialTerm> {
        let mut grid_cache = self.grid_cache.borrow_mut();
        // Exponents that change with free orders would fill the cache.
        if grid_cache.powers.len()
            > if grid_cache.zero_record.m() > MAX_CACHED_PULSES {
                MAX_POWERS_LONG_RECORD
            } else {
                MAX_POWERS_SHORT_RECORD
            }
        {
            grid_cache.powers.clear();
        }
        if let Some(term_from_cache) = grid_cache.powers.get(&exponent.to_bits()) {
            return term_from_cache.clone();
        }
        let term = Rc::new(InitialTerm::new(
            exponent,
            grid_cache.zero_record.m(),
            grid_cache.zero_record.step(),
            grid_cache.filter.clone(),
        ));
        grid_cache.powers.insert(exponent.to_bits(), term.clone());
        term
    }

    /// Apply the sensor filter to a series that is not a signal of the record; without a filter, return it unchanged.
    pub(crate) fn filter_series(&self, series: &[f64]) -> Vec<f64> {
        self.grid_cache.borrow().filter.as_ref().map_or_else(|| series.to_vec(), |filter| filter.apply(series))
    }

    /// Return the spectrum of the filtered series, padded for a product with one more series.
    pub(crate) fn filtered_spectrum(&self, series: &[f64]) -> Rc<Kernel> {
        Rc::new(filtered_spectrum(series, self.grid_cache.borrow().filter.as_deref(), self.total))
    }

    /// Return the weighted samples of the response of the sensor filter to an impulse or to its derivative.
    pub(crate) fn impulse_samples(&mut self, experiment: &Experiment, output: usize, exponent: f64) -> Vec<f64> {
        let samples = || {
            let mut means = vec![vec![0.0; experiment.record.m()]; experiment.samples.len()];
            means[output] = experiment.record.initial_term(exponent);
            experiment.weighted_samples(&means)
        };
        self.impulses.entry((output, exponent.to_bits())).or_insert_with(samples).clone()
    }
}
