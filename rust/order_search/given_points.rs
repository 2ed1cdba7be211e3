//! Output errors of given candidates, each with its own orders and coefficients.
//!
//! The genetic algorithm uses this module to score its population.

use std::collections::HashMap;

use rayon::prelude::*;

use crate::equation::{Structure, Term};
use crate::error::{check_finite, check_length, Error, Result};
use crate::fractional::kernels::block_pulse_kernel;
use crate::order_search::candidate::simulation::BlockSimulation;
use crate::order_search::control::Control;
use crate::order_search::options::Norm;
use crate::order_search::result::Verdict;
use crate::parallel::{pool, PerThread};
use crate::regressors::{Key, Record};

/// Maximum memory of the regressors cached between calls \[bytes\]. Successive populations of a converged genetic
/// algorithm use the same regressors.
const MAX_CACHE_BYTES: usize = 256 << 20;

/// Candidate of a search: order of the equation, and an order and a coefficient for each term.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Highest order α of the equation.
    pub order: f64,
    /// Orders ν of the terms.
    pub orders: Vec<f64>,
    /// Coefficients of the terms.
    pub coefficients: Vec<f64>,
}

/// Evaluator of one equation at arbitrary orders and coefficients, with zero initial conditions.
pub struct Points {
    records: Vec<Record>,
    output: usize,
    signals: Vec<usize>,
    inputs: Vec<bool>,
    norm: Norm,
    samples: usize,
    /// The cached columns, one per record: the kernel for a term of the output, the fractional integral of any other
    /// signal.
    cache: HashMap<Key, Vec<Vec<f64>>>,
}

impl Points {
    /// Build the evaluator of the equation of `output` with one term on each of `signals`. `inputs[s]` is true if
    /// signal s is an input.
    ///
    /// # Errors
    /// [`Error::Structure`] without a record or for a signal that the records lack. [`Error::Length`] for records with
    /// different numbers of signals.
    pub fn new(
        records: Vec<Record>,
        output: usize,
        signals: Vec<usize>,
        inputs: Vec<bool>,
        norm: Norm,
    ) -> Result<Self> {
        let Some(first) = records.first() else {
            return Err(Error::Structure { what: "no record is given".into(), remedy: "give at least one run".into() });
        };
        for &signal in std::iter::once(&output).chain(&signals) {
            if signal >= first.len() {
                return Err(Error::Structure {
                    what: format!(
                        "the equation contains signal {signal}, but the number of signals of the record is {}",
                        first.len()
                    ),
                    remedy: "give the record all signals of the equation".into(),
                });
            }
        }
        for record in &records {
            check_length("signals of a record", first.len(), record.len())?;
        }
        let samples = records.iter().map(Record::m).sum();
        Ok(Self { records, output, signals, inputs, norm, samples, cache: HashMap::new() })
    }

    /// Return the output error of every candidate over all records: Σ|e| for [`Norm::L1`], the root mean square error
    /// for [`Norm::L2`].
    ///
    /// The error is infinite for invalid orders, for a term order above the order of the equation, and for a simulation
    /// that diverges. It is also infinite if it exceeds `limit`, because the evaluation then stops early. The result is
    /// bitwise identical for any number of threads.
    ///
    /// # Errors
    /// [`Error::Length`] for a number of orders or coefficients that differs from the number of terms.
    /// [`Error::NotFinite`] for coefficients that are not finite. [`Error::Interrupted`] after a stop request. Also an
    /// error if the threads cannot be started.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// # use ftlm::order_search::control::Control;
    /// # use ftlm::order_search::options::Norm;
    /// # use ftlm::order_search::given_points::{Point, Points};
    /// # use ftlm::regressors::Record;
    /// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
    /// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
    /// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
    /// // D^α y = c D^ν u: y satisfies it with α = 0.8, ν = 0, c = 1. Orders ν above α are invalid.
    /// let mut points = Points::new(vec![record], 0, vec![1], vec![false, true], Norm::L1)?;
    /// let point = |order: f64, input_order: f64| Point { order, orders: vec![input_order], coefficients: vec![1.0] };
    /// let errors = points.scores(&[point(0.8, 0.0), point(0.8, 0.9)], f64::INFINITY, 1, &Control::default())?;
    /// assert!(errors[0] < 1e-9 && errors[1].is_infinite());
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn scores(&mut self, points: &[Point], limit: f64, threads: usize, control: &Control) -> Result<Vec<f64>> {
        let mut structures = Vec::with_capacity(points.len());
        for point in points {
            check_length("orders of a candidate", self.signals.len(), point.orders.len())?;
            check_length("coefficients of a candidate", self.signals.len(), point.coefficients.len())?;
            check_finite("coefficients of a candidate", &point.coefficients)?;
            let pairs = self.signals.iter().zip(&point.orders);
            let terms = pairs.map(|(&signal, &order)| Term { signal, order }).collect();
            let structure = Structure { output: self.output, order: point.order, terms };
            let is_input = |s: usize| self.inputs.get(s).copied().unwrap_or(false);
            let is_valid = structure.check(self.records[0].len(), is_input).is_ok();
            // The correction of slope discontinuities has no derivative at jumps. A candidate must be ranked by the
            // response with which it will be simulated.
            let smooth = structure.terms.iter().all(|term| term.order <= structure.order);
            structures.push((is_valid && smooth).then_some(structure));
        }
        let pool = pool(threads)?;
        self.fill_cache(&structures, &pool);
        // Raw scores are sums: Σ|e| or Σe².
        #[allow(clippy::cast_precision_loss)]
        let samples = self.samples as f64;
        let raw_limit = if self.norm == Norm::L1 { limit } else { limit * limit * samples };
        let simulations = PerThread::<BlockSimulation>::new(&pool);
        let evaluator = &*self;
        let raw: Vec<f64> = pool.install(|| {
            structures
                .par_iter()
                .zip(points)
                .map(|(structure, point)| {
                    let Some(structure) = structure else { return f64::INFINITY };
                    simulations.with(|simulation| {
                        let error = evaluator.error(structure, &point.coefficients, raw_limit, simulation, control);
                        error.unwrap_or(f64::INFINITY)
                    })
                })
                .collect()
        });
        control.check_stop()?;
        control.count(points.len() as u64, 0);
        Ok(raw.into_iter().map(|raw| self.norm.score(raw, self.samples)).collect())
    }

    /// Compute the regressors of these structures that are not in the cache.
    fn fill_cache(&mut self, structures: &[Option<Structure>], pool: &rayon::ThreadPool) {
        let bytes_per_column = self.samples * std::mem::size_of::<f64>();
        let mut requests: Vec<(Key, usize, f64)> = Vec::new();
        for structure in structures.iter().flatten() {
            for k in 0..structure.terms.len() {
                let (signal, eta) = (structure.terms[k].signal, structure.integration(k));
                requests.push((Key::integral(signal, eta), signal, eta));
            }
        }
        requests.sort_unstable_by_key(|a| a.0);
        requests.dedup_by(|a, b| a.0 == b.0);
        if (self.cache.len() + requests.len()) * bytes_per_column > MAX_CACHE_BYTES {
            self.cache.clear();
        }
        requests.retain(|(key, _, _)| !self.cache.contains_key(key));
        let (records, output) = (&self.records, self.output);
        let columns: Vec<Vec<Vec<f64>>> = pool.install(|| {
            requests
                .par_iter()
                .map(|&(_, signal, eta)| {
                    let column_of_record = |record: &Record| {
                        if signal == output {
                            block_pulse_kernel(eta, record.m(), record.step())
                        } else if eta == 0.0 {
                            record.signal(signal).to_vec()
                        } else {
                            record.integral(signal, eta)
                        }
                    };
                    records.iter().map(column_of_record).collect()
                })
                .collect()
        });
        self.cache.extend(requests.into_iter().map(|(key, _, _)| key).zip(columns));
    }

    /// Return the raw score (Σ|e| or Σe²) of a candidate over all records. `None` if it exceeds the limit or the
    /// simulation diverges.
    fn error(
        &self,
        structure: &Structure,
        coefficients: &[f64],
        limit: f64,
        simulation: &mut BlockSimulation,
        control: &Control,
    ) -> Option<f64> {
        let mut sum = 0.0;
        for (r, record) in self.records.iter().enumerate() {
            let columns: Vec<(bool, &[f64], f64)> = (0..structure.terms.len())
                .filter_map(|k| {
                    let signal = structure.terms[k].signal;
                    let cached_column = self.cache.get(&Key::integral(signal, structure.integration(k)))?;
                    Some((signal == self.output, &cached_column[r][..], coefficients[k]))
                })
                .collect();
            let terms_of = |is_output: bool| {
                columns.iter().filter(move |term| term.0 == is_output).map(|&(_, column, c)| (column, c))
            };
            let target = record.signal(self.output);
            match simulation.accumulate_error(target, terms_of(true), terms_of(false), self.norm, sum, limit, control) {
                // A NaN limit excludes all candidates.
                Verdict::Score(raw) if raw <= limit => sum = raw,
                _ => return None,
            }
        }
        Some(sum)
    }
}

/// Return the L1 output error Σ|e| of one candidate on one record by naive division. It is a reference for tests of
/// [`Points::scores`] and takes O(m²) operations for m samples. Infinite if the division fails.
///
/// # Panics
/// If the record lacks a signal.
#[cfg(feature = "oracles")]
#[must_use]
pub fn score_naive(record: &Record, output: usize, signals: &[usize], point: &Point) -> f64 {
    let m = record.m();
    let (mut divisor, mut numerator) = (vec![0.0; m], vec![0.0; m]);
    divisor[0] = 1.0;
    for ((&signal, order), c) in signals.iter().zip(&point.orders).zip(&point.coefficients) {
        let kernel = block_pulse_kernel(point.order - order, m, record.step());
        if signal == output {
            divisor.iter_mut().zip(&kernel).for_each(|(d, v)| *d -= c * v);
        } else {
            let integral = crate::series::multiply_naive(&kernel, record.signal(signal), m);
            numerator.iter_mut().zip(integral).for_each(|(n, v)| *n += c * v);
        }
    }
    crate::series::divide_naive(&numerator, &divisor)
        .map_or(f64::INFINITY, |response| record.signal(output).iter().zip(response).map(|(y, v)| (y - v).abs()).sum())
}
