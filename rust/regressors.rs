//! Regressors of records: a bank of distinct columns I^η s (fractional integrals of signals), shared by all candidates.
//! Also initial terms and transients of sensor filters.
//!
//! Filter transients are represented by impulses and their derivatives, as initial terms with the exponents −1, −2, ….
//! They affect only the sensor, so they are added to the output of the equation. If the whole equation is filtered and
//! its output was not measured through the filter, they enter the equation as inputs instead.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use crate::equation::{grains, round_order};
use crate::error::{check_finite, check_length, check_step, Error, Result};
use crate::fractional::kernels::{kernel, power_means, power_pulses};
use crate::parallel::{self, Stop};
use crate::series::{self, Buffers, Kernel};
use crate::signal::block_pulse::{pulse_means, Intersample, PulseJump, PulseMeans};

/// Memory limit of a single bank, and default limit of a search \[bytes\].
pub const BANK_LIMIT: u64 = 2 << 30;

/// Run as pulse means (means over sampling intervals): all signals over the same m pulses of length `step` \[s\].
#[derive(Debug, Clone)]
pub struct Record {
    step: f64,
    /// Pulse means of each signal.
    signals: Vec<Vec<f64>>,
    /// Series of the sensor filter that the signals passed, if there is one.
    filter: Option<Vec<f64>>,
    /// Pulse means of a low-noise substitute of each signal, for instrumental variables.
    clean: Option<Vec<Vec<f64>>>,
    /// True for each signal whose sensor filter may have an initial transient. Empty if there is no transient.
    filter_transients: Vec<bool>,
    /// Signal minus its initial level, `None` if the level is zero. Empty if no levels were given.
    deviations: Vec<Option<Vec<f64>>>,
    /// Pulse means of the filter responses to an impulse and to its derivatives, if they are known more accurately than
    /// from the pulse grid.
    impulse_responses: Vec<Vec<f64>>,
    /// Jumps of each zero-order-hold signal within pulses, in the sequence of time. Empty if unknown.
    jumps: Vec<Vec<PulseJump>>,
}

impl Record {
    /// Build a record from pulse means. All signals must be finite and have the same nonzero length m.
    ///
    /// `filter` contains the m coefficients of the block-pulse series (discrete impulse response) of a known sensor
    /// filter that the signals passed. It is applied to initial terms.
    ///
    /// # Errors
    /// [`Error::Length`] for wrong lengths, [`Error::NotFinite`] with the index of the signal, [`Error::OutOfRange`]
    /// for the step.
    pub fn new(step: f64, signals: Vec<PulseMeans>, filter: Option<Vec<f64>>) -> Result<Self> {
        Self::from_rows(step, signals.into_iter().map(PulseMeans::into_vec).collect(), filter)
    }

    /// Build a record from the values of pulse means, as [`Record::new`] does.
    pub(crate) fn from_rows(step: f64, signals: Vec<Vec<f64>>, filter: Option<Vec<f64>>) -> Result<Self> {
        check_step(step)?;
        let m = signals.first().map_or(0, Vec::len);
        if m == 0 {
            return Err(Error::Length { name: "signal 0".into(), expected: 1, found: 0 });
        }
        for (i, signal) in signals.iter().enumerate() {
            let name = format!("signal {i}");
            check_length(&name, m, signal.len())?;
            check_finite(&name, signal)?;
        }
        if let Some(series) = &filter {
            check_length("filter", m, series.len())?;
            check_finite("filter", series)?;
        }
        Ok(Self {
            step,
            signals,
            filter,
            clean: None,
            filter_transients: Vec::new(),
            deviations: Vec::new(),
            impulse_responses: Vec::new(),
            jumps: Vec::new(),
        })
    }

    /// Build a record from the pulse means of sampled signals, one pulse per sampling interval. Each signal is given by
    /// its samples and its intersample behavior.
    ///
    /// # Errors
    /// An error for fewer than two samples or a sample that is not finite ([`pulse_means`]). An error for signals of
    /// unequal length or an invalid step ([`Record::new`]).
    ///
    /// ```
    /// # use ftlm::regressors::Record;
    /// # use ftlm::signal::block_pulse::Intersample;
    /// let (y, u) = ([0.0, 1.0, 3.0], [2.0, 4.0, 0.0]);
    /// let record = Record::from_samples(0.1, &[(&y, Intersample::Linear), (&u, Intersample::Hold)])?;
    /// assert_eq!((record.signal(0), record.signal(1)), (&[0.5, 2.0][..], &[2.0, 4.0][..]));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn from_samples(step: f64, signals: &[(&[f64], Intersample)]) -> Result<Self> {
        let means = |(samples, intersample): &(&[f64], Intersample)| {
            pulse_means(samples, samples.len().saturating_sub(1), *intersample)
        };
        Self::new(step, signals.iter().map(means).collect::<Result<_>>()?, None)
    }

    /// Return the record with the jumps of each signal within pulses. Dry friction needs them, because a body at rest
    /// may start to slide at a jump.
    ///
    /// # Errors
    /// [`Error::Length`] for a wrong number of signals. [`Error::Structure`] for a jump outside of the pulses, at the
    /// edge of a pulse, or not later than the previous jump of its signal. [`Error::NotFinite`] for values around a
    /// jump that are not finite.
    pub fn with_jumps(mut self, jumps: Vec<Vec<PulseJump>>) -> Result<Self> {
        check_length("jumps of signals", self.len(), jumps.len())?;
        for (signal, row) in jumps.iter().enumerate() {
            let mut last = (0, 0.0);
            for jump in row {
                let PulseJump { pulse, fraction, .. } = *jump;
                let invalid_jump = |what: String, remedy: &str| Err(Error::Structure { what, remedy: remedy.into() });
                if pulse >= self.m() {
                    let what = format!("signal {signal} jumps in pulse {pulse} of {}", self.m());
                    return invalid_jump(what, "count pulses from 0");
                }
                if !(fraction > 0.0 && fraction < 1.0) {
                    let what = format!("signal {signal} jumps after the fraction {fraction} of pulse {pulse}");
                    return invalid_jump(what, "give jumps within pulses, with fractions between 0 and 1");
                }
                if (pulse, fraction) <= last {
                    let what = format!("a jump of signal {signal} in pulse {pulse} is not after the one before it");
                    return invalid_jump(what, "sort the jumps by time");
                }
                check_finite("values around a jump", &[jump.before, jump.after])?;
                last = (pulse, fraction);
            }
        }
        self.jumps = jumps;
        Ok(self)
    }

    /// Return the jumps of a signal within pulses.
    #[must_use]
    pub fn jumps(&self, index: usize) -> &[PulseJump] {
        self.jumps.get(index).map_or(&[], Vec::as_slice)
    }

    /// Return the record with a low-noise substitute of every signal, for instrumental variables.
    ///
    /// # Errors
    /// [`Error::Length`] for a wrong number of substitutes or pulse means. [`Error::NotFinite`] for a value that is not
    /// finite.
    pub fn with_clean(mut self, clean: Vec<PulseMeans>) -> Result<Self> {
        let clean: Vec<_> = clean.into_iter().map(PulseMeans::into_vec).collect();
        check_length("clean signals", self.signals.len(), clean.len())?;
        for (i, signal) in clean.iter().enumerate() {
            let name = format!("clean signal {i}");
            check_length(&name, self.m(), signal.len())?;
            check_finite(&name, signal)?;
        }
        self.clean = Some(clean);
        Ok(self)
    }

    /// Return a record in which every signal is replaced by its low-noise substitute. Return a copy if there are none.
    #[must_use]
    pub fn clean_record(&self) -> Self {
        let signals = self.clean.clone().unwrap_or_else(|| self.signals.clone());
        let (transients, deviations, impulse_responses) =
            (self.filter_transients.clone(), Vec::new(), self.impulse_responses.clone());
        Self {
            step: self.step,
            signals,
            filter: self.filter.clone(),
            clean: None,
            filter_transients: transients,
            deviations,
            impulse_responses,
            jumps: self.jumps.clone(),
        }
    }

    /// Return a record in which every signal except this one is replaced by its low-noise substitute.
    ///
    /// # Panics
    /// If the signal does not exist.
    #[must_use]
    pub fn clean_record_except(&self, signal: usize) -> Self {
        let mut cleaned = self.clean_record();
        cleaned.signals[signal].clone_from(&self.signals[signal]);
        cleaned
    }

    /// Return the record with all signals and initial terms passed through a causal filter, given as a series of m
    /// terms.
    ///
    /// # Errors
    /// [`Error::Length`] for another number of terms, [`Error::NotFinite`] if a filtered signal overflows.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, PulseMeans::from_signals(vec![vec![1.0, 2.0, 3.0]]), None)?;
    /// assert_eq!(record.with_filter(&[0.0, 1.0, 0.0])?.signal(0), [0.0, 1.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn with_filter(&self, filter: &[f64]) -> Result<Self> {
        let m = self.m();
        check_length("filter", m, filter.len())?;
        let apply = |series: &Vec<f64>| series::multiply(filter, series, m);
        let derivative = self.filter.as_ref().map_or_else(|| filter.to_vec(), apply);
        let mut filtered_record =
            Self::from_rows(self.step, self.signals.iter().map(apply).collect(), Some(derivative))?;
        filtered_record.filter_transients.clone_from(&self.filter_transients);
        filtered_record.deviations = self.deviations.iter().map(|deviation| deviation.as_ref().map(apply)).collect();
        Ok(filtered_record)
    }

    /// Return the record with nonzero initial conditions.
    ///
    /// `transients` is true for each signal whose sensor filter may have an initial transient. `levels` are the initial
    /// levels of the signals. `impulse_responses` are pulse means of the known responses of the filter to an impulse
    /// and its derivatives.
    ///
    /// A term whose order exceeds the order of its equation differentiates the deviation of a signal from its initial
    /// level. The start of the record therefore does not act as a jump. Initial terms describe the effect of earlier
    /// inputs.
    ///
    /// # Errors
    /// [`Error::Length`] for a wrong number of flags or levels, or responses of wrong length. [`Error::NotFinite`] for
    /// a level or a response.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, PulseMeans::from_signals(vec![vec![1.0, 2.0, 3.0]]), None)?;
    /// let record = record.with_initial_state(vec![false], &[1.0], Vec::new())?;
    /// assert_eq!(record.deviation_signal(0), [0.0, 1.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn with_initial_state(
        mut self,
        transients: Vec<bool>,
        levels: &[f64],
        impulse_responses: Vec<Vec<f64>>,
    ) -> Result<Self> {
        check_length("flags of signals with a transient of the sensor filter", self.len(), transients.len())?;
        check_length("levels of signals", self.len(), levels.len())?;
        check_finite("level of a signal", levels)?;
        for response in &impulse_responses {
            check_length("response of the sensor filter", self.m(), response.len())?;
            check_finite("response of the sensor filter", response)?;
        }
        let unit = if levels.iter().any(|v| *v != 0.0) { self.initial_term(0.0) } else { Vec::new() };
        let deviation = |(signal, &level): (&Vec<f64>, &f64)| {
            (level != 0.0).then(|| signal.iter().zip(&unit).map(|(v, unit_value)| v - level * unit_value).collect())
        };
        self.deviations = self.signals.iter().zip(levels).map(deviation).collect();
        (self.filter_transients, self.impulse_responses) = (transients, impulse_responses);
        Ok(self)
    }

    /// Return the pulse means of a signal minus its initial level ([`Record::with_initial_state`]).
    ///
    /// # Panics
    /// If the signal does not exist.
    #[must_use]
    pub fn deviation_signal(&self, index: usize) -> &[f64] {
        self.deviations.get(index).and_then(Option::as_ref).unwrap_or(&self.signals[index])
    }

    /// Return the pulse means of the signal of a term with the order of integration `eta`. For `eta` below 0 they are
    /// deviations from the initial level.
    pub(crate) fn term_signal(&self, index: usize, eta: f64) -> &[f64] {
        if eta < 0.0 {
            self.deviation_signal(index)
        } else {
            self.signal(index)
        }
    }

    /// Return true if a signal passed a sensor filter that may have an initial transient.
    #[must_use]
    pub fn has_filter_transient(&self, index: usize) -> bool {
        self.filter_transients.get(index).copied().unwrap_or(false)
    }

    /// Return true if signals and initial terms passed a sensor filter.
    #[must_use]
    pub fn is_filtered(&self) -> bool {
        self.filter.is_some()
    }

    /// Return the series of the sensor filter, `None` without a filter.
    pub(crate) fn filter(&self) -> Option<&[f64]> {
        self.filter.as_deref()
    }

    /// Return the number m of pulses (sampling intervals).
    #[must_use]
    pub fn m(&self) -> usize {
        self.signals[0].len()
    }

    /// Return the pulse length \[s\].
    #[must_use]
    pub fn step(&self) -> f64 {
        self.step
    }

    /// Return the number of signals.
    #[must_use]
    pub fn len(&self) -> usize {
        self.signals.len()
    }

    /// Return false, because a record has at least one signal.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.signals.is_empty()
    }

    /// Return the [`Record::m`] pulse means of a signal.
    ///
    /// # Panics
    /// If the signal does not exist.
    #[must_use]
    pub fn signal(&self, index: usize) -> &[f64] {
        &self.signals[index]
    }

    /// Return the fractional integral I^η of a signal as [`Record::m`] pulse means, for η = `eta` in (−1, 10]. For η
    /// below 0 it is a derivative. O(m log m).
    ///
    /// # Panics
    /// If the signal does not exist.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, PulseMeans::from_signals(vec![vec![1.0; 4]]), None)?;
    /// let ramp = record.integral(0, 1.0);
    /// assert!(ramp.iter().zip([0.25, 0.75, 1.25, 1.75]).all(|(a, b)| (a - b).abs() < 1e-12));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn integral(&self, signal: usize, eta: f64) -> Vec<f64> {
        if eta == 0.0 {
            return self.signals[signal].clone();
        }
        series::multiply(&kernel(eta, self.m(), self.step), &self.signals[signal], self.m())
    }

    /// Return the pulse means of the initial term t^exponent, with t in seconds. They pass the sensor filter if there
    /// is one.
    ///
    /// The exponents −1, −2, … stand for an impulse and its derivatives.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, PulseMeans::from_signals(vec![vec![1.0; 4]]), None)?;
    /// assert!(record.initial_term(0.0).iter().all(|v| (v - 1.0).abs() < 1e-12));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn initial_term(&self, exponent: f64) -> Vec<f64> {
        self.impulse_response(exponent).unwrap_or_else(|| self.apply_filter(power_means(exponent, self.m(), self.step)))
    }

    /// Return the pulse means of the filter response to an impulse or its derivative, given by the exponent −1, −2, ….
    /// `None` if the response is not known or the exponent is another one.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn impulse_response(&self, exponent: f64) -> Option<Vec<f64>> {
        if !is_impulse(exponent) {
            return None;
        }
        self.impulse_responses.get((-1.0 - exponent) as usize).cloned()
    }

    /// Return the pulse means of an initial term t^exponent as an input of a simulation. With a sensor filter, they are
    /// corrected as in [`power_pulses`] and filtered.
    pub(crate) fn forcing_term(&self, exponent: f64) -> Vec<f64> {
        match &self.filter {
            None => self.initial_term(exponent),
            Some(_) => {
                let pulses = || self.apply_filter(power_pulses(exponent, self.m(), self.step));
                self.impulse_response(exponent).unwrap_or_else(pulses)
            }
        }
    }

    /// Return the pulse means of an initial term t^exponent as an input of a simulation, before the sensor filter.
    /// `None` for a record without filter, or if the filter response is known.
    pub(crate) fn unfiltered_term(&self, exponent: f64) -> Option<Vec<f64>> {
        let is_filtered_later = self.filter.is_some() && self.impulse_response(exponent).is_none();
        is_filtered_later.then(|| power_pulses(exponent, self.m(), self.step))
    }

    /// Apply the record's sensor filter to a series. Without a filter, return the series unchanged.
    pub(crate) fn apply_filter(&self, powers: Vec<f64>) -> Vec<f64> {
        match &self.filter {
            None => powers,
            Some(filter) => series::multiply(filter, &powers, self.m()),
        }
    }
}

/// Key of a column of a bank, which identifies a regressor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Key {
    /// Fractional integral I^η of a signal.
    Integral {
        /// Index of the signal in the record.
        signal: usize,
        /// Order of integration η as an integer multiple of the order resolution ([`grains`]).
        order: i64,
    },
    /// Initial term t^e.
    Initial {
        /// Exponent e as an integer multiple of the order resolution ([`grains`]).
        exponent: i64,
    },
}

impl Key {
    /// Return the key of the fractional integral I^eta of a signal.
    #[must_use]
    pub fn integral(signal: usize, eta: f64) -> Self {
        Self::Integral { signal, order: grains(eta) }
    }

    /// Return the key of the initial term t^exponent.
    #[must_use]
    pub fn initial(exponent: f64) -> Self {
        Self::Initial { exponent: grains(exponent) }
    }
}

/// Distinct regressors of a search, in the sequence of insertion or sorted ([`Index::sort`]). All records share this
/// index. The position of a regressor is its column in each bank.
#[derive(Debug, Default, Clone)]
pub struct Index {
    keys: Vec<Key>,
    positions: HashMap<Key, usize>,
}

impl Index {
    /// Return the position of a key. A new key is appended.
    pub fn insert(&mut self, key: Key) -> usize {
        let keys = &mut self.keys;
        *self.positions.entry(key).or_insert_with(|| {
            keys.push(key);
            keys.len() - 1
        })
    }

    /// Return the position of a key, `None` if it is absent.
    #[must_use]
    pub fn get(&self, key: Key) -> Option<usize> {
        self.positions.get(&key).copied()
    }

    /// Sort the keys by signal and order, so that neighbors on an order grid are adjacent.
    pub fn sort(&mut self) {
        self.keys.sort_unstable();
        self.positions = self.keys.iter().enumerate().map(|(i, &key)| (key, i)).collect();
    }

    /// Return all keys in the sequence of their positions.
    #[must_use]
    pub fn keys(&self) -> &[Key] {
        &self.keys
    }
}

/// Values of all regressors of an [`Index`] on one record, one column per regressor.
pub struct Bank {
    m: usize,
    /// Values of all columns, one column after another.
    columns: Vec<f64>,
    /// Kernels of the columns that are integrals of the output, one after another. The kernel of I^η is its power
    /// series in the one-step delay.
    kernels: Vec<f64>,
    /// Index of the kernel of each column, `None` if the column is not an integral of the output.
    kernel_indices: Vec<Option<usize>>,
}

/// Columns of all signals at one order of integration, to be computed. The kernel is included if the output is among
/// the signals.
struct OrderColumns<'a> {
    order: i64,
    columns: Vec<(usize, &'a mut [f64])>,
    kernel: Option<&'a mut [f64]>,
}

impl OrderColumns<'_> {
    /// Compute the columns of all signals, given by their spectra, from one kernel.
    #[allow(clippy::cast_precision_loss)]
    fn write(self, record: &Record, spectra: &BTreeMap<usize, Kernel>, buffers: &mut Buffers) {
        let kernel = kernel(round_order(self.order as f64 / 1e9), record.m(), record.step());
        if self.order == 0 {
            self.columns.into_iter().for_each(|(signal, column)| column.copy_from_slice(record.signal(signal)));
        } else {
            let spectrum = Kernel::new(&kernel);
            for (signal, column) in self.columns {
                if let Some(signal) = spectra.get(&signal) {
                    spectrum.times(signal, column, buffers);
                }
            }
        }
        if let Some(kernel_slot) = self.kernel {
            kernel_slot.copy_from_slice(&kernel);
        }
    }
}

impl Bank {
    /// Compute the columns of all regressors in `index`. For integrals of the signal `output`, the kernels are also
    /// stored, because a simulation needs them.
    ///
    /// O(columns · m log m) on the threads of the current pool, with one transform per column and one more for each
    /// order and each signal. The memory is 8·m bytes per column, and twice that for integrals of the output.
    ///
    /// # Errors
    /// [`Error::BankTooLarge`] for more memory than [`BANK_LIMIT`], [`Error::Structure`] for a signal that the record
    /// does not have.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// # use ftlm::regressors::{Bank, Index, Key, Record};
    /// let record = Record::new(0.5, PulseMeans::from_signals(vec![vec![1.0; 4], vec![2.0; 4]]), None)?;
    /// let mut index = Index::default();
    /// let input = index.insert(Key::integral(1, 0.0));
    /// let own = index.insert(Key::integral(0, 0.8));
    /// let bank = Bank::new(&index, &record, 0)?;
    /// assert_eq!(bank.column(input), [2.0; 4]);
    /// assert!(bank.kernel(input).is_empty() && bank.kernel(own).len() == 4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn new(index: &Index, record: &Record, output: usize) -> Result<Self> {
        let (m, limit) = (record.m(), u128::from(BANK_LIMIT));
        let bytes = 8 * m as u128 * (index.keys.len() + Self::output_integral_count(index, output)) as u128;
        if bytes > limit {
            return Err(Error::BankTooLarge { columns: index.keys.len(), m, bytes, limit });
        }
        Self::new_interruptible(index, record, output, &Stop::default())
    }

    /// Return the number of regressors that are integrals of the signal `output`.
    pub(crate) fn output_integral_count(index: &Index, output: usize) -> usize {
        index.keys.iter().filter(|k| matches!(k, Key::Integral { signal, .. } if *signal == output)).count()
    }

    /// Compute the columns as [`Bank::new`] does, but interruptible and without the memory limit, which the caller must
    /// check.
    ///
    /// # Errors
    /// [`Error::Structure`] for a signal that the record does not have, [`Error::Interrupted`] after a stop request.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn new_interruptible(index: &Index, record: &Record, output: usize, stop: &Stop) -> Result<Self> {
        let m = record.m();
        let is_out_of_range = |key: &&Key| matches!(key, Key::Integral { signal, .. } if *signal >= record.len());
        if let Some(Key::Integral { signal, .. }) = index.keys.iter().find(is_out_of_range) {
            return Err(Error::Structure {
                what: format!(
                    "a regressor refers to signal {signal}, but the number of signals of the record is {}",
                    record.len()
                ),
                remedy: "give the record all signals of the equation".into(),
            });
        }
        let mut columns = vec![0.0; m * index.keys.len()];
        let mut kernels = vec![0.0; m * Self::output_integral_count(index, output)];
        let mut kernel_indices = Vec::with_capacity(index.keys.len());
        let mut orders: BTreeMap<i64, OrderColumns<'_>> = BTreeMap::new();
        let mut initial = Vec::new();
        let mut kernel_slots = kernels.chunks_exact_mut(m).enumerate();
        for (key, column) in index.keys.iter().zip(columns.chunks_exact_mut(m)) {
            let mut kernel = None;
            match *key {
                Key::Integral { signal, order } => {
                    let group =
                        orders.entry(order).or_insert_with(|| OrderColumns { order, columns: vec![], kernel: None });
                    group.columns.push((signal, column));
                    if signal == output {
                        (kernel, group.kernel) = kernel_slots.next().unzip();
                    }
                }
                Key::Initial { exponent } => initial.push((exponent, column)),
            }
            kernel_indices.push(kernel);
        }
        let integrated: BTreeSet<usize> = orders
            .values()
            .filter(|group| group.order != 0)
            .flat_map(|group| &group.columns)
            .map(|(s, _)| *s)
            .collect();
        let signals = integrated.into_iter().collect();
        let spectrum = |(): &mut (), signal: usize| (signal, Kernel::new(record.signal(signal)));
        let spectra: BTreeMap<usize, Kernel> = parallel::map(signals, || (), spectrum).into_iter().collect();
        parallel::map(orders.into_values().collect(), Buffers::default, |buffers, group| {
            if !stop.is_set() {
                group.write(record, &spectra, buffers);
            }
        });
        stop.check()?;
        parallel::map(
            initial,
            || (),
            |(), (exponent, column)| {
                column.copy_from_slice(&record.initial_term(exponent as f64 / 1e9));
            },
        );
        Ok(Self { m, columns, kernels, kernel_indices })
    }

    /// Return the values of all columns, one column after another.
    pub(crate) fn columns(&self) -> &[f64] {
        &self.columns
    }

    /// Return the column at a position, one value per pulse.
    ///
    /// # Panics
    /// If the column does not exist.
    #[must_use]
    pub fn column(&self, position: usize) -> &[f64] {
        &self.columns[position * self.m..(position + 1) * self.m]
    }

    /// Return the kernel of a column that is an integral I^η of the output: the power series of I^η in the one-step
    /// delay, one value per pulse. Empty for any other column.
    ///
    /// # Panics
    /// If the column does not exist.
    #[must_use]
    pub fn kernel(&self, position: usize) -> &[f64] {
        self.kernel_indices[position].map_or(&[], |index| &self.kernels[index * self.m..(index + 1) * self.m])
    }

    /// Return the number of columns.
    #[must_use]
    pub fn len(&self) -> usize {
        self.kernel_indices.len()
    }

    /// Return true if there are no columns.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.kernel_indices.is_empty()
    }
}

/// Return true if an exponent stands for an impulse or its derivative: −1, −2, ….
pub(crate) fn is_impulse(exponent: f64) -> bool {
    exponent <= -1.0 && exponent.fract() == 0.0
}

/// Split initial terms, given as (exponent, coefficient) pairs by equation, into terms of the equations and impulses of
/// the sensors. Levels of the outputs, marked by the exponent ∞, are omitted; the
/// caller adds them to the samples.
#[allow(clippy::type_complexity)]
pub(crate) fn split_impulses(powers: &[Vec<(f64, f64)>]) -> (Vec<Vec<(f64, f64)>>, Vec<Vec<(f64, f64)>>) {
    let finite = |terms: &Vec<(f64, f64)>| terms.iter().copied().filter(|(e, _)| e.is_finite()).collect::<Vec<_>>();
    powers.iter().map(|terms| finite(terms).into_iter().partition(|(e, _)| !is_impulse(*e))).unzip()
}

/// Add impulses and their derivatives, given as (exponent, coefficient) pairs by output, to the pulse means of the
/// outputs. `step` is the pulse length \[s\].
pub(crate) fn add_impulses(outputs: &mut [Vec<f64>], impulses: &[Vec<(f64, f64)>], step: f64) {
    for (output, terms) in outputs.iter_mut().zip(impulses) {
        for &(exponent, value) in terms.iter().filter(|(_, value)| *value != 0.0) {
            let means = power_means(exponent, output.len(), step);
            output.iter_mut().zip(means).for_each(|(s, v)| *s += value * v);
        }
    }
}
