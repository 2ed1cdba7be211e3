//! Records and equations become one bank of distinct regressors I^η s, shared by all candidates of a search.
//!
//! What the sensor filter of an output still held when a run began: its answers to an impulse and to derivatives of one.
//!
//! They are written as powers of t below zero, −1, −2, …, among the initial terms of an equation. They move nothing, and are
//! added to the output that came through the sensor. Only where the whole equation is put through the filter afterwards, with
//! an output that was not measured through it, do they drive the equation like others: what drives then held them.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use crate::equation::{grains, tidy};
use crate::error::{check_finite, check_length, check_step, Error, Result};
use crate::fractional::kernels::{kernel, power_means, power_pulses};
use crate::parallel::{self, Stop};
use crate::series::{self, Buffers, Kernel};

/// Largest bank that is made for itself, and what a search takes in all where no other limit is given, in bytes.
pub const BANK_LIMIT: u64 = 2 << 30;

/// One run as pulse means: all signals over the same m pulses of length `step`.
#[derive(Debug, Clone)]
pub struct Record {
    step: f64,
    signals: Vec<Vec<f64>>,
    filter: Option<Vec<f64>>,
    clean: Option<Vec<Vec<f64>>>,
    /// Signals whose own sensor may still have held something when the run began; none where it is empty.
    held: Vec<bool>,
    /// Signals less the level at which they began, where there is one; of none where it is empty.
    moving: Vec<Option<Vec<f64>>>,
    /// Answers of the filter to an impulse and to derivatives of one, where they are known better than by pulses.
    answers: Vec<Vec<f64>>,
}

impl Record {
    /// Checks and takes over pulse means; all signals of equal, non-zero length and finite.
    ///
    /// `filter` is the series that the signals went through (a known sensor filter), to be applied to initial terms.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::NotFinite`] naming the signal by number, [`Error::OutOfRange`] for the step.
    pub fn new(step: f64, signals: Vec<Vec<f64>>, filter: Option<Vec<f64>>) -> Result<Self> {
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
        Ok(Self { step, signals, filter, clean: None, held: Vec::new(), moving: Vec::new(), answers: Vec::new() })
    }

    /// Gives every signal a substitute without most of its noise, for instrumental variables.
    ///
    /// # Errors
    /// As [`Record::new`]; [`Error::Length`] where there are not as many substitutes as signals.
    pub fn with_clean(mut self, clean: Vec<Vec<f64>>) -> Result<Self> {
        check_length("clean signals", self.signals.len(), clean.len())?;
        for (i, signal) in clean.iter().enumerate() {
            let name = format!("clean signal {i}");
            check_length(&name, self.m(), signal.len())?;
            check_finite(&name, signal)?;
        }
        self.clean = Some(clean);
        Ok(self)
    }

    /// The record of the substitutes, or this one where it has none.
    #[must_use]
    pub fn cleaned(&self) -> Self {
        let signals = self.clean.clone().unwrap_or_else(|| self.signals.clone());
        let (held, moving, answers) = (self.held.clone(), Vec::new(), self.answers.clone());
        Self { step: self.step, signals, filter: self.filter.clone(), clean: None, held, moving, answers }
    }

    /// The record of the substitutes for all signals but one.
    ///
    /// # Panics
    /// Where there is no such signal.
    #[must_use]
    pub fn cleaned_but(&self, signal: usize) -> Self {
        let mut cleaned = self.cleaned();
        cleaned.signals[signal].clone_from(&self.signals[signal]);
        cleaned
    }

    /// All signals, and with them the initial terms, behind a causal filter given as a series of m terms.
    ///
    /// # Errors
    /// [`Error::Length`], [`Error::NotFinite`] where the filter blows up.
    ///
    /// ```
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, vec![vec![1.0, 2.0, 3.0]], None)?;
    /// assert_eq!(record.through(&[0.0, 1.0, 0.0])?.signal(0), [0.0, 1.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn through(&self, filter: &[f64]) -> Result<Self> {
        let m = self.m();
        check_length("filter", m, filter.len())?;
        let filtered = |series: &Vec<f64>| series::multiply(filter, series, m);
        let known = self.filter.as_ref().map_or_else(|| filter.to_vec(), filtered);
        let mut through = Self::new(self.step, self.signals.iter().map(filtered).collect(), Some(known))?;
        through.held.clone_from(&self.held);
        through.moving = self.moving.iter().map(|moving| moving.as_ref().map(filtered)).collect();
        Ok(through)
    }

    /// The same of a run in motion: which signals came through a sensor that may still have held something of the time
    /// before, the level at which each signal began, and pulse means of the filter's answers to an impulse and to
    /// derivatives of one, as far as they are known.
    ///
    /// A derivative above its equation's order drives by what a signal is above its level: from a jump that only the
    /// record's beginning makes none is taken, and what the time before left is for the initial terms to say.
    ///
    /// # Errors
    /// [`Error::Length`] where there are not as many of both as signals, or answers of other lengths;
    /// [`Error::NotFinite`] for a level or an answer that is none.
    ///
    /// ```
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, vec![vec![1.0, 2.0, 3.0]], None)?.begun(vec![false], &[1.0], Vec::new())?;
    /// assert_eq!(record.moving(0), [0.0, 1.0, 2.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn begun(mut self, held: Vec<bool>, levels: &[f64], answers: Vec<Vec<f64>>) -> Result<Self> {
        check_length("signals whose sensor held something", self.len(), held.len())?;
        check_length("levels of signals", self.len(), levels.len())?;
        check_finite("level of a signal", levels)?;
        for answer in &answers {
            check_length("answer of the filter", self.m(), answer.len())?;
            check_finite("answer of the filter", answer)?;
        }
        let unit = if levels.iter().any(|v| *v != 0.0) { self.initial_term(0.0) } else { Vec::new() };
        let above = |(signal, &level): (&Vec<f64>, &f64)| {
            (level != 0.0).then(|| signal.iter().zip(&unit).map(|(v, one)| v - level * one).collect())
        };
        self.moving = self.signals.iter().zip(levels).map(above).collect();
        (self.held, self.answers) = (held, answers);
        Ok(self)
    }

    /// Pulse means of a signal above the level at which it began, see [`Record::begun`].
    ///
    /// # Panics
    /// Where there is no such signal.
    #[must_use]
    pub fn moving(&self, index: usize) -> &[f64] {
        self.moving.get(index).and_then(Option::as_ref).unwrap_or(&self.signals[index])
    }

    /// What a term drives by that is integrated by `eta`: below 0 by what moves.
    pub(crate) fn driver(&self, index: usize, eta: f64) -> &[f64] {
        if eta < 0.0 {
            self.moving(index)
        } else {
            self.signal(index)
        }
    }

    /// Whether a signal came through a sensor that may still have held something when the run began.
    #[must_use]
    pub fn is_held(&self, index: usize) -> bool {
        self.held.get(index).copied().unwrap_or(false)
    }

    /// Whether signals and initial terms went through a sensor filter.
    #[must_use]
    pub fn is_filtered(&self) -> bool {
        self.filter.is_some()
    }

    /// The series of that filter.
    pub(crate) fn filter(&self) -> Option<&[f64]> {
        self.filter.as_deref()
    }

    /// Number of pulses.
    #[must_use]
    pub fn m(&self) -> usize {
        self.signals[0].len()
    }

    /// Pulse width in seconds.
    #[must_use]
    pub fn step(&self) -> f64 {
        self.step
    }

    /// Number of signals.
    #[must_use]
    pub fn len(&self) -> usize {
        self.signals.len()
    }

    /// Never true: a record holds at least one signal.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.signals.is_empty()
    }

    /// Pulse means of a signal, [`Record::m`] of them.
    ///
    /// # Panics
    /// Where there is no such signal.
    #[must_use]
    pub fn signal(&self, index: usize) -> &[f64] {
        &self.signals[index]
    }

    /// I^η of a signal, as [`Record::m`] pulse means; η in (−1, 10], below 0 its derivative. O(m log m).
    ///
    /// # Panics
    /// Where there is no such signal.
    ///
    /// ```
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, vec![vec![1.0; 4]], None)?;
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

    /// Pulse means of the initial term t^exponent, t in seconds, through the sensor filter where there is one; of an
    /// impulse and its derivatives for −1, −2, ….
    ///
    /// ```
    /// # use ftlm::regressors::Record;
    /// let record = Record::new(0.5, vec![vec![1.0; 4]], None)?;
    /// assert!(record.initial_term(0.0).iter().all(|v| (v - 1.0).abs() < 1e-12));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    #[must_use]
    pub fn initial_term(&self, exponent: f64) -> Vec<f64> {
        self.answer(exponent).unwrap_or_else(|| self.behind_filter(power_means(exponent, self.m(), self.step)))
    }

    /// What is known of the filter's answer to an impulse or to a derivative of one.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn answer(&self, exponent: f64) -> Option<Vec<f64>> {
        if !is_impulse(exponent) {
            return None;
        }
        self.answers.get((-1.0 - exponent) as usize).cloned()
    }

    /// The same to drive a free run ([`power_pulses`]): where a filter makes something smooth of it.
    pub(crate) fn driving_term(&self, exponent: f64) -> Vec<f64> {
        match &self.filter {
            None => self.initial_term(exponent),
            Some(_) => {
                let pulses = || self.behind_filter(power_pulses(exponent, self.m(), self.step));
                self.answer(exponent).unwrap_or_else(pulses)
            }
        }
    }

    /// What drives a free run as t^e does before the filter that makes something smooth of it; none where the record's
    /// signals passed none, and of what is an answer of the filter.
    pub(crate) fn unfiltered_term(&self, exponent: f64) -> Option<Vec<f64>> {
        let passes = self.filter.is_some() && self.answer(exponent).is_none();
        passes.then(|| power_pulses(exponent, self.m(), self.step))
    }

    /// What the filter that the record's signals passed makes of a series.
    pub(crate) fn behind_filter(&self, powers: Vec<f64>) -> Vec<f64> {
        match &self.filter {
            None => powers,
            Some(filter) => series::multiply(filter, &powers, self.m()),
        }
    }
}

/// What a column of a bank is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Key {
    /// I^η of a signal; η in grains.
    Integral {
        /// Signal of the record.
        signal: usize,
        /// Integration order, see [`grains`].
        order: i64,
    },
    /// t^e; e in grains.
    Initial {
        /// Exponent, see [`grains`].
        exponent: i64,
    },
}

impl Key {
    /// The key of I^eta of a signal.
    #[must_use]
    pub fn integral(signal: usize, eta: f64) -> Self {
        Self::Integral { signal, order: grains(eta) }
    }

    /// The key of an initial term.
    #[must_use]
    pub fn initial(exponent: f64) -> Self {
        Self::Initial { exponent: grains(exponent) }
    }
}

/// Distinct regressors in order of first mention, the same order for every record of a search.
#[derive(Debug, Default, Clone)]
pub struct Index {
    keys: Vec<Key>,
    positions: HashMap<Key, usize>,
}

impl Index {
    /// Position of a key, added at the end if new.
    pub fn insert(&mut self, key: Key) -> usize {
        let keys = &mut self.keys;
        *self.positions.entry(key).or_insert_with(|| {
            keys.push(key);
            keys.len() - 1
        })
    }

    /// Position of a key.
    #[must_use]
    pub fn get(&self, key: Key) -> Option<usize> {
        self.positions.get(&key).copied()
    }

    /// Puts the keys in order of signal and order, so that neighbours on a lattice are neighbours here.
    pub fn sort(&mut self) {
        self.keys.sort_unstable();
        self.positions = self.keys.iter().enumerate().map(|(i, &key)| (key, i)).collect();
    }

    /// All keys in order.
    #[must_use]
    pub fn keys(&self) -> &[Key] {
        &self.keys
    }
}

/// The columns of an [`Index`] on one record.
pub struct Bank {
    m: usize,
    /// All of them, one behind another.
    columns: Vec<f64>,
    /// Kernels of the output's own regressors, one behind another, and by position which of them it is.
    kernels: Vec<f64>,
    own: Vec<Option<usize>>,
}

/// What one order makes: the columns of all signals, and the kernel where the output is among them.
struct Made<'a> {
    order: i64,
    columns: Vec<(usize, &'a mut [f64])>,
    kernel: Option<&'a mut [f64]>,
}

impl Made<'_> {
    /// One kernel and its spectrum for all signals.
    #[allow(clippy::cast_precision_loss)]
    fn write(self, record: &Record, spectra: &BTreeMap<usize, Kernel>, buffers: &mut Buffers) {
        let kernel = kernel(tidy(self.order as f64 / 1e9), record.m(), record.step());
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
        if let Some(own) = self.kernel {
            own.copy_from_slice(&kernel);
        }
    }
}

impl Bank {
    /// Computes every column; `output` is the signal whose kernels simulation needs.
    ///
    /// One transform a column, one more for each order and signal. O(columns · m log m), memory 8·m bytes a column (twice
    /// for the output's own); on the threads of the pool at hand.
    ///
    /// # Errors
    /// [`Error::BankTooLarge`] beyond [`BANK_LIMIT`], [`Error::Structure`] for a signal that the record does not hold.
    ///
    /// ```
    /// # use ftlm::regressors::{Bank, Index, Key, Record};
    /// let record = Record::new(0.5, vec![vec![1.0; 4], vec![2.0; 4]], None)?;
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
        let bytes = 8 * m as u128 * (index.keys.len() + Self::own(index, output)) as u128;
        if bytes > limit {
            return Err(Error::BankTooLarge { columns: index.keys.len(), m, bytes, limit });
        }
        Self::counted(index, record, output, &Stop::default())
    }

    /// How many regressors are integrals of this signal.
    pub(crate) fn own(index: &Index, output: usize) -> usize {
        index.keys.iter().filter(|k| matches!(k, Key::Integral { signal, .. } if *signal == output)).count()
    }

    /// As [`Bank::new`], for who has counted its memory.
    ///
    /// # Errors
    /// [`Error::Structure`] for a signal that the record does not hold, [`Error::Interrupted`].
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn counted(index: &Index, record: &Record, output: usize, stop: &Stop) -> Result<Self> {
        let m = record.m();
        let strange = |key: &&Key| matches!(key, Key::Integral { signal, .. } if *signal >= record.len());
        if let Some(Key::Integral { signal, .. }) = index.keys.iter().find(strange) {
            return Err(Error::Structure {
                what: format!("a regressor is of signal {signal}, but the record holds {}", record.len()),
                remedy: "give the record all signals of the equation".into(),
            });
        }
        let mut columns = vec![0.0; m * index.keys.len()];
        let mut kernels = vec![0.0; m * Self::own(index, output)];
        let mut own = Vec::with_capacity(index.keys.len());
        let mut orders: BTreeMap<i64, Made<'_>> = BTreeMap::new();
        let mut initial = Vec::new();
        let mut rest = kernels.chunks_exact_mut(m).enumerate();
        for (key, column) in index.keys.iter().zip(columns.chunks_exact_mut(m)) {
            let mut kernel = None;
            match *key {
                Key::Integral { signal, order } => {
                    let made = orders.entry(order).or_insert_with(|| Made { order, columns: vec![], kernel: None });
                    made.columns.push((signal, column));
                    if signal == output {
                        (kernel, made.kernel) = rest.next().unzip();
                    }
                }
                Key::Initial { exponent } => initial.push((exponent, column)),
            }
            own.push(kernel);
        }
        let integrated: BTreeSet<usize> =
            orders.values().filter(|made| made.order != 0).flat_map(|made| &made.columns).map(|(s, _)| *s).collect();
        let signals = integrated.into_iter().collect();
        let spectrum = |(): &mut (), signal: usize| (signal, Kernel::new(record.signal(signal)));
        let spectra: BTreeMap<usize, Kernel> = parallel::map(signals, || (), spectrum).into_iter().collect();
        parallel::map(orders.into_values().collect(), Buffers::default, |buffers, made| {
            if !stop.is_set() {
                made.write(record, &spectra, buffers);
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
        Ok(Self { m, columns, kernels, own })
    }

    /// All columns, one behind another.
    pub(crate) fn columns(&self) -> &[f64] {
        &self.columns
    }

    /// Column at a position: one value a pulse.
    ///
    /// # Panics
    /// Where there is no such column.
    #[must_use]
    pub fn column(&self, position: usize) -> &[f64] {
        &self.columns[position * self.m..(position + 1) * self.m]
    }

    /// Kernel of an own-output column, one value a pulse; empty for any other column.
    ///
    /// # Panics
    /// Where there is no such column.
    #[must_use]
    pub fn kernel(&self, position: usize) -> &[f64] {
        self.own[position].map_or(&[], |place| &self.kernels[place * self.m..(place + 1) * self.m])
    }

    /// Number of columns.
    #[must_use]
    pub fn len(&self) -> usize {
        self.own.len()
    }

    /// Whether there is no column.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.own.is_empty()
    }
}

/// Whether an exponent stands for an impulse or a derivative of one.
pub(crate) fn is_impulse(exponent: f64) -> bool {
    exponent <= -1.0 && exponent.fract() == 0.0
}

/// Initial terms that move something, and impulses, by equation.
#[allow(clippy::type_complexity)]
pub(crate) fn parted(powers: &[Vec<(f64, f64)>]) -> (Vec<Vec<(f64, f64)>>, Vec<Vec<(f64, f64)>>) {
    powers.iter().map(|own| own.iter().partition(|(e, _)| !is_impulse(*e))).unzip()
}

/// Adds impulses and their derivatives to pulse means of outputs.
pub(crate) fn add_impulses(outputs: &mut [Vec<f64>], impulses: &[Vec<(f64, f64)>], step: f64) {
    for (output, own) in outputs.iter_mut().zip(impulses) {
        for &(exponent, value) in own.iter().filter(|(_, value)| *value != 0.0) {
            let means = power_means(exponent, output.len(), step);
            output.iter_mut().zip(means).for_each(|(s, v)| *s += value * v);
        }
    }
}
