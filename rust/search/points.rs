//! Errors of candidates given as points, each with orders and coefficients of its own: what a genetic algorithm asks for.

use std::collections::HashMap;
use std::sync::atomic::Ordering;
use std::sync::Mutex;

use rayon::prelude::*;

use crate::equation::{Structure, Term};
use crate::error::{check_finite, check_length, Error, Result};
use crate::kernels::block_pulse_kernel;
use crate::regressors::{Key, Record};
use crate::search::run::{pool, Control, Norm};
use crate::series::{Division, BLOCK};

/// Memory for regressors kept from one call to the next; a population that has settled asks for the same ones again.
const KEPT_BYTES: usize = 256 << 20;

/// One candidate: an order and a coefficient for each term.
#[derive(Debug, Clone, PartialEq)]
pub struct Point {
    /// Highest order.
    pub order: f64,
    /// Orders of the terms.
    pub orders: Vec<f64>,
    /// Their coefficients.
    pub coefficients: Vec<f64>,
}

/// One equation on some records, evaluated at any orders and coefficients, at rest.
pub struct Points {
    records: Vec<Record>,
    output: usize,
    signals: Vec<usize>,
    inputs: Vec<bool>,
    norm: Norm,
    samples: usize,
    /// Per record: the kernel of an own-output term, the integral of any other signal.
    kept: HashMap<Key, Vec<Vec<f64>>>,
}

impl Points {
    /// The equation of `output` with a term on each of `signals`; `inputs` says which signals of the records are inputs.
    ///
    /// # Errors
    /// No record, or a signal that they do not have.
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
                    what: format!("the equation names signal {signal}, but the record holds {}", first.len()),
                    remedy: "give the record all signals of the equation".into(),
                });
            }
        }
        for record in &records {
            check_length("signals of a record", first.len(), record.len())?;
        }
        let samples = records.iter().map(Record::m).sum();
        Ok(Self { records, output, signals, inputs, norm, samples, kept: HashMap::new() })
    }

    /// Error of every candidate's free run, summed over the records: Σ|e|, or RMSE.
    ///
    /// Infinite for orders that make no equation and for a free run that diverges. A candidate whose error exceeds
    /// `limit` is left as soon as that is sure and is infinite, too. The same bits for any number of threads.
    ///
    /// # Errors
    /// A candidate of another length, coefficients that are not finite, [`Error::Interrupted`].
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
            structures.push(structure.check(self.records[0].len(), is_input).is_ok().then_some(structure));
        }
        let pool = pool(threads)?;
        self.fetch(&structures, &pool);
        // Raw sums: Σ|e|, or Σe².
        #[allow(clippy::cast_precision_loss)]
        let samples = self.samples as f64;
        let raw_limit = if self.norm == Norm::L1 { limit } else { limit * limit * samples };
        let divisions: Vec<Mutex<Option<Division>>> = (0..threads).map(|_| Mutex::new(None)).collect();
        let this = &*self;
        let raw: Vec<f64> = pool.install(|| {
            structures
                .par_iter()
                .zip(points)
                .map(|(structure, point)| {
                    let Some(structure) = structure else { return f64::INFINITY };
                    let thread = rayon::current_thread_index().unwrap_or(0) % divisions.len();
                    let mut division = divisions[thread].lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                    let mut sum = 0.0;
                    for r in 0..this.records.len() {
                        sum = this.march(r, structure, &point.coefficients, (sum, raw_limit), &mut division, control);
                    }
                    sum
                })
                .collect()
        });
        if control.stop.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        control.done.fetch_add(points.len() as u64, Ordering::Relaxed);
        Ok(raw.into_iter().map(|s| if self.norm == Norm::L1 { s } else { (s / samples).sqrt() }).collect())
    }

    /// Computes the regressors that are not kept yet.
    fn fetch(&mut self, structures: &[Option<Structure>], pool: &rayon::ThreadPool) {
        let each = self.samples * std::mem::size_of::<f64>();
        let mut wanted: Vec<(Key, usize, f64)> = Vec::new();
        for structure in structures.iter().flatten() {
            for k in 0..structure.terms.len() {
                let (signal, eta) = (structure.terms[k].signal, structure.integration(k));
                wanted.push((Key::integral(signal, eta), signal, eta));
            }
        }
        wanted.sort_unstable_by_key(|a| a.0);
        wanted.dedup_by(|a, b| a.0 == b.0);
        if (self.kept.len() + wanted.len()) * each > KEPT_BYTES {
            self.kept.clear();
        }
        wanted.retain(|(key, _, _)| !self.kept.contains_key(key));
        let (records, output) = (&self.records, self.output);
        let made: Vec<Vec<Vec<f64>>> = pool.install(|| {
            wanted
                .par_iter()
                .map(|&(_, signal, eta)| {
                    let one = |record: &Record| {
                        if signal == output {
                            block_pulse_kernel(eta, record.m(), record.step())
                        } else if eta == 0.0 {
                            record.signal(signal).to_vec()
                        } else {
                            record.integral(signal, eta)
                        }
                    };
                    records.iter().map(one).collect()
                })
                .collect()
        });
        self.kept.extend(wanted.into_iter().map(|(key, _, _)| key).zip(made));
    }

    /// Adds a record's error to a sum, block by block, or gives infinity once it passes the limit.
    fn march(
        &self,
        r: usize,
        structure: &Structure,
        coefficients: &[f64],
        (mut sum, limit): (f64, f64),
        division: &mut Option<Division>,
        control: &Control,
    ) -> f64 {
        let target = self.records[r].signal(self.output);
        let m = target.len();
        let columns: Vec<(bool, &[f64], f64)> = (0..structure.terms.len())
            .filter_map(|k| {
                let signal = structure.terms[k].signal;
                let kept = self.kept.get(&Key::integral(signal, structure.integration(k)))?;
                Some((signal == self.output, &kept[r][..], coefficients[k]))
            })
            .collect();
        let division = match division {
            Some(d) if d.terms() == m => {
                d.reset();
                d
            }
            other => other.insert(Division::new(1, m)),
        };
        let mut divisor: Vec<f64> = Vec::with_capacity(m);
        let (mut inverse, mut block) = ([0.0], [0.0; BLOCK]);
        while division.solved() < m {
            let lo = division.solved();
            let hi = (lo + BLOCK).min(m);
            let from = divisor.len();
            let needed = division.reads().max(from);
            divisor.resize(needed, 0.0);
            let block = &mut block[..hi - lo];
            block.fill(0.0);
            for &(own, column, c) in &columns {
                if own {
                    divisor[from..].iter_mut().zip(&column[from..needed]).for_each(|(d, v)| *d -= c * v);
                } else {
                    block.iter_mut().zip(&column[lo..hi]).for_each(|(b, v)| *b += c * v);
                }
            }
            if from == 0 {
                divisor[0] += 1.0;
                if divisor[0] == 0.0 || !divisor[0].is_finite() {
                    return f64::INFINITY;
                }
                inverse[0] = 1.0 / divisor[0];
            }
            division.add(0, lo, block);
            division.solve_block(&inverse, |_, _, len| &divisor[..len]);
            let simulated = &division.quotient(0)[lo..hi];
            sum += match self.norm {
                Norm::L1 => target[lo..hi].iter().zip(simulated).map(|(y, v)| (y - v).abs()).sum::<f64>(),
                Norm::L2 => target[lo..hi].iter().zip(simulated).map(|(y, v)| (y - v) * (y - v)).sum::<f64>(),
            };
            // Negated so that a sum that is not a number has passed the limit.
            if !(sum <= limit && sum.is_finite()) || control.stop.load(Ordering::Relaxed) {
                return f64::INFINITY;
            }
            division.join(|_, _, len| &divisor[..len]);
        }
        sum
    }
}

/// Error (45) of one candidate on one record by the naive division: the oracle of [`Points::scores`].
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
