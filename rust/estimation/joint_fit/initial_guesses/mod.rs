//! Initial guesses of joint fits: order grids on prefiltered records, delays, saturation limits, resonances.

mod order_grid;
mod prefilter;
mod resonances;

use std::f64::consts::PI;

pub use prefilter::power_frequency;

use self::order_grid::{between, lattice_attempts, lawful_attempts, natural_axes, start_axes, Coarse};
use self::prefilter::LowPasses;
use self::resonances::scanned_attempts;
use super::format::short;
use super::multistart::Starts;
use super::parameter_set::Free;
use super::problem::Runner;
use super::source::Recordings;
use crate::error::{check_length, Error, Result};
use crate::estimation::joint_fit::structure::Input;
use crate::estimation::output_error::InputLaw;
use crate::parallel::Stop;
use crate::regressors::Record;
use crate::signal::block_pulse::Intersample;
use crate::signal::statistics::median;

/// Maximum number of block pulses of the records for initial guesses.
const START_M: usize = 1024;
/// Cutoff frequencies of the prefilters relative to the bandwidth of the outputs; None for no prefilter.
const PREFILTERS: [Option<f64>; 5] = [Some(1.0), Some(2.0), Some(4.0), Some(8.0), None];
/// Minimum difference in some order between the candidates of one grid.
const APART: f64 = 0.35;
/// Difference below which two orders are equal.
const GRAIN: f64 = 1e-9;

/// Initial guesses from coarse order grids, by least squares on records of the runs.
pub struct Lattices<'a> {
    source: &'a dyn Recordings,
    threads: usize,
    memory: u64,
    stop: &'a Stop,
    low_passes: LowPasses,
}

impl<'a> Lattices<'a> {
    /// Order grids on the given runs, with the number of threads and bytes of memory per search.
    #[must_use]
    pub fn new(source: &'a dyn Recordings, threads: usize, memory: u64, stop: &'a Stop) -> Self {
        Self { source, threads, memory, stop, low_passes: LowPasses::default() }
    }

    /// Initial guesses of a problem on the runs, at several delays and limits if these are free.
    ///
    /// # Errors
    /// [`Error::Structure`] for a zero-order-hold input with an order above that of its equation, for friction, and for
    /// duplicate terms; [`Error::EmptyLattice`], [`Error::Interrupted`]; errors of the source and of a search.
    pub fn starts(&self, free: &Free) -> Result<Vec<Runner>> {
        let frequencies = self.frequencies(free)?;
        if free.structure.inputs.is_empty() {
            return self.at(free, &frequencies, &[]);
        }
        let fastest = frequencies.iter().flatten().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut attempts = Vec::new();
        for (point, words) in points(free, self.source, fastest)? {
            for mut attempt in self.at(free, &frequencies, &point)? {
                attempt.origin = format!("{}, {words}", attempt.origin);
                attempt.attempt.place.point.inputs.clone_from(&point);
                attempts.push(attempt);
            }
        }
        Ok(attempts)
    }

    /// Bandwidth \[rad/s\] of the output of each equation, by run.
    fn frequencies(&self, free: &Free) -> Result<Vec<Vec<f64>>> {
        let spans = self.source.spans();
        let of = |output: usize| {
            let samples = self.source.samples(output)?;
            check_length("runs", spans.len(), samples.len())?;
            Ok(samples.iter().zip(&spans).map(|(run, (step, _))| power_frequency(run, *step)).collect())
        };
        free.structure.equations.iter().map(|e| of(e.output)).collect()
    }

    /// Number of pulses of the records, limited by the shortest run.
    fn pulses(&self, free: &Free) -> Result<usize> {
        let output = free.structure.equations.first().map_or(0, |e| e.output);
        let shortest = self.source.samples(output)?.iter().map(Vec::len).min().unwrap_or(0);
        Ok(START_M.min(shortest.saturating_sub(1)))
    }

    /// Candidates from order grids on prefiltered records, at given values of the free input parameters.
    ///
    /// The prefilter commutes with the equation: all signals pass it, so the true coefficients are unchanged while
    /// noise above the bandwidth is removed.
    fn at(&self, free: &Free, frequencies: &[Vec<f64>], numbers: &[f64]) -> Result<Vec<Runner>> {
        self.check_held(free)?;
        let frequency = median(frequencies.concat());
        let natural = natural_axes(free);
        let mut lattices = vec![(start_axes(free), APART)];
        lattices.extend(natural.iter().map(|axes| (axes.clone(), 0.0)));
        let unfiltered = self.source.records(self.pulses(free)?, numbers)?;
        let unfiltered = self.prefiltered(&unfiltered, None)?;
        let fastest = PI / unfiltered.iter().map(Record::step).fold(f64::NEG_INFINITY, f64::max);
        let inputs: Vec<bool> = self.source.inputs().iter().map(Option::is_some).collect();
        let coarse = Coarse {
            records: &unfiltered,
            inputs: &inputs,
            initial: &free.structure.initial,
            threads: self.threads,
            memory: self.memory,
            stop: self.stop,
        };
        let mut attempts = Vec::new();
        for multiple in PREFILTERS {
            self.stop.check()?;
            let corner = multiple.map(|multiple| multiple * frequency);
            if corner.is_some_and(|corner| corner >= fastest) {
                // The cutoff is above the Nyquist frequency of the pulses.
                continue;
            }
            let records = self.prefiltered(&unfiltered, corner)?;
            let coarse = coarse.on(&records);
            let words = |corner| format!("prefilter {} rad/s", short(corner, 3));
            let origin = corner.map_or_else(|| "no prefilter".into(), words);
            let mut here: Vec<Runner> = Vec::new();
            for lattice in &lattices {
                let more = lattice_attempts(free, &coarse, lattice, &origin, &here)?;
                here.extend(more);
            }
            if let Some(axes) = natural.as_ref().filter(|_| multiple == PREFILTERS[0] || multiple.is_none()) {
                here.extend(lawful_attempts(free, &coarse, axes, &origin)?);
            }
            attempts.extend(here);
        }
        let scanned = scanned_attempts(free, &coarse, frequencies, &attempts)?;
        attempts.extend(scanned);
        Ok(attempts)
    }

    fn prefiltered(&self, records: &[Record], corner: Option<f64>) -> Result<Vec<Record>> {
        records.iter().map(|record| self.low_passes.through(record, corner)).collect()
    }

    /// Reject a zero-order-hold input with an order above that of its equation: jumps have no derivative.
    fn check_held(&self, free: &Free) -> Result<()> {
        let (inputs, signals) = (self.source.inputs(), &free.structure.signals);
        for item in free.structure.equations.iter().filter(|e| !e.order.is_free()) {
            let alpha = item.order.constant;
            let held = |signal: usize| inputs.get(signal).copied().flatten() == Some(Intersample::Hold);
            let above = item.terms.iter().filter(|t| !t.order.is_free() && t.order.constant > alpha + GRAIN);
            if let Some(term) = above.into_iter().find(|t| held(t.signal)) {
                let (order, signal) = (short(term.order.constant, 6), &signals[term.signal]);
                let (alpha, output) = (short(alpha, 6), &signals[item.output]);
                let what = format!(
                    "order {order} of {signal} is above alpha = {alpha} of {output}, and the runs hold {signal} between \
                     their samples: its jumps have no derivative"
                );
                let remedy = "lower the order, or say intersample='foh' if it moves in between".into();
                return Err(Error::Structure { what, remedy });
            }
        }
        Ok(())
    }
}

impl Starts for Lattices<'_> {
    fn of(&self, free: &Free) -> Result<Vec<Runner>> {
        self.starts(free)
    }
}

/// Largest distance of initial guesses of a delay, as phase at the bandwidth of the output. There are at most
/// [`MAX_DELAY_STARTS`] combinations over all inputs with free parameters.
const DELAY_PHASE: f64 = 1.0;
const DELAY_STARTS: f64 = 12.0;
/// Number of initial guesses of a saturation or dead zone, from [`MIN_LIMIT_RATIO`] of the largest input upwards.
const LIMIT_STARTS: usize = 4;
const LEAST_LIMIT: f64 = 0.1;

/// Initial guesses of free delays and limits, each with a description.
///
/// A fit with a delay too far off ends in a local optimum shifted by an oscillation. A limit above all samples has no
/// effect.
pub(super) fn points(free: &Free, source: &dyn Recordings, fastest: f64) -> Result<Vec<(Vec<f64>, String)>> {
    let inputs = &free.structure.inputs;
    let axes = inputs.iter().map(|item| axis(item, inputs.len(), source, fastest)).collect::<Result<Vec<_>>>()?;
    let mut points = vec![Vec::new()];
    for axis in axes {
        let along = |point: Vec<f64>| axis.iter().map(|v| [point.as_slice(), &[*v]].concat()).collect::<Vec<_>>();
        points = points.into_iter().flat_map(along).collect();
    }
    let words = |point: &[f64]| inputs.iter().zip(point).map(|(item, v)| at(item, *v)).collect::<Vec<_>>().join(", ");
    Ok(points.into_iter().map(|point| (words(&point), point)).map(|(words, point)| (point, words)).collect())
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn axis(item: &Input, count: usize, source: &dyn Recordings, fastest: f64) -> Result<Vec<f64>> {
    let (low, high) = item.free.bounds;
    let most = (libm::pow(DELAY_STARTS, 1.0 / count as f64) as usize).max(2);
    if item.free.law == InputLaw::Delay {
        let wanted = ((high - low) * fastest / DELAY_PHASE).ceil() as usize;
        return Ok(between(low, high, wanted.saturating_add(1).max(2).min(most)));
    }
    // `max` ignores NaN, so missing samples are skipped.
    let samples = source.samples(item.free.signal)?;
    let largest = samples.iter().flatten().fold(0.0, |largest: f64, v| largest.max(v.abs()));
    let (least, reached) = (low.max(LEAST_LIMIT * largest), high.min(largest));
    let mut values = between(least.min(reached), reached, LIMIT_STARTS.min(most) + 1);
    values.pop();
    Ok(values)
}

/// Description of an initial guess.
fn at(item: &Input, value: f64) -> String {
    match item.free.law {
        InputLaw::Delay => format!("delay {} ms", short(1e3 * value, 3)),
        InputLaw::Saturation | InputLaw::DeadZone => format!("{} {}", item.name, short(value, 3)),
    }
}
