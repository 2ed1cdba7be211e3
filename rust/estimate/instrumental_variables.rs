//! Refined instrumental variables at given orders (Young and Jakeman; fractional orders: Victor, Malti, Garnier and
//! Oustaloup, doi:10.1016/j.automatica.2012.12.006).
//!
//! Least squares on the equation error is biased because a measured output is its own noise. Here the equation is
//! filtered by 1/D̂, which leaves about the white noise of the output, and correlated with instruments that hold no
//! noise: the inputs and the *simulated* outputs. Both follow from the last estimate, so the step is repeated. All
//! equations given are simulated together, from the signals that none of them has as its output; where those are
//! measured outputs too, a clean substitute for them is asked for ([`project`] makes one). Several equations are then
//! refined together ([`multivariable`]).

use crate::dense;
use crate::equation::{Equation, Filter, Initial, Structure};
use crate::error::{check_length, Error, Result};
use crate::estimate::{least_squares, multivariable};
use crate::fft;
use crate::fractional::block_pulse_kernel;
use crate::regressors::Record;
use crate::series::{self, Buffers, Kernel, SumOfProducts};
use crate::simulate;
use crate::small;

/// A free run whose second half exceeds the first by this factor is unstable: its instruments would drown the rest.
const GROWTH: f64 = 2.0;
/// Resonators of [`project`] a decade and input, and their damping ratio: broad enough to leave no gap between them.
const RESONATORS: usize = 8;
const RESONATOR_DAMPING: f64 = 0.2;

/// A column of [`project`] of which less than this share is new is left out: it would add rounding, not span.
const SPANNED: f64 = 1e-9;

/// Low-passes behind which a start is made, in units of the output's own band; none: the plain record.
const PREFILTERS: [Option<f64>; 4] = [None, Some(1.0), Some(2.0), Some(4.0)];

/// A step that raises the output error by this factor is halved, at most so many times in a row.
const WORSE: f64 = 1.2;
const SHORTENED: usize = 4;

/// How long to iterate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Most steps.
    pub iterations: usize,
    /// Change of every coefficient, relative to its size, at which the steps end.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { iterations: 30, tolerance: 1e-7 }
    }
}

/// What the iteration came to, for one equation.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// One a term; fixed ones as given.
    pub coefficients: Vec<f64>,
    /// Coefficients of the initial terms, per record; 0 where dropped as combinations of others.
    pub initial: Vec<Vec<f64>>,
    /// Exponents of the initial terms.
    pub exponents: Vec<f64>,
    /// Covariance of the free coefficients at these orders, row-major, robust to coloured residuals.
    pub covariance: Vec<f64>,
}

/// Coefficients of all equations.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// One an equation.
    pub estimates: Vec<Estimate>,
    /// Steps made.
    pub iterations: usize,
    /// Whether the last step moved nothing any more; else these are the coefficients with the least output error met.
    pub converged: bool,
    /// Whether the free run of the result is unstable, so that its instruments had to be damped.
    pub damped: bool,
}

/// What a step reads of one record for one equation: spectra good for products of two series of m terms.
pub struct Source<'a> {
    /// Per term: kernel of I^η and its spectrum where the term is the output's own.
    pub own: Vec<Option<(&'a [f64], &'a Kernel)>>,
    /// Per term: I^η s as measured.
    pub measured: Vec<&'a Kernel>,
    /// Per term: I^η s without noise, the same object where it is no other; not read for own terms.
    pub clean: Vec<&'a Kernel>,
    /// Initial terms.
    pub initial: Vec<&'a Kernel>,
    /// The output's spectrum.
    pub target: &'a Kernel,
    /// The output.
    pub output: &'a [f64],
}

/// Coefficients of terms, then of the initial terms record by record.
pub type Solution = Vec<f64>;

/// 1/D mod z^m, or of D(ρz) with the largest ρ = e^{−γ/m}, γ = 0, 4, 8, …, that keeps it from growing.
///
/// # Errors
/// [`Error::LeadingZero`] where D starts with zero.
#[allow(clippy::cast_precision_loss)]
pub fn damped_inverse(divisor: &[f64]) -> Result<(Vec<f64>, bool)> {
    let m = divisor.len();
    let one = unit(m);
    let quotient = series::divide(&one, divisor)?;
    if !grows(&quotient) {
        return Ok((quotient, false));
    }
    let finite = quotient.iter().all(|q| q.is_finite());
    let mut gamma = 4.0;
    loop {
        let rho = libm::exp(-gamma / m as f64);
        // The quotient of a divisor read at ρz is the quotient read at ρz, as long as numbers hold it.
        let damped = if finite { read_at(rho, &quotient) } else { series::divide(&one, &read_at(rho, divisor))? };
        // At γ = 64 m nothing is left of D but its first term.
        if !grows(&damped) || gamma > 64.0 * m as f64 {
            return Ok((damped, true));
        }
        gamma *= 2.0;
    }
}

/// A series read at ρz.
fn read_at(rho: f64, series: &[f64]) -> Vec<f64> {
    let mut power = 1.0;
    series
        .iter()
        .map(|v| {
            let value = v * power;
            power *= rho;
            value
        })
        .collect()
}

pub(crate) fn grows(response: &[f64]) -> bool {
    let (first, second) = response.split_at(response.len() / 2);
    let peak =
        |part: &[f64]| part.iter().fold(0.0_f64, |a, v| if v.is_finite() { a.max(v.abs()) } else { f64::INFINITY });
    let later = peak(second);
    later.is_infinite() || later > GROWTH * peak(first)
}

/// D = 1 − Σ c F^η over the own terms.
fn divisor(source: &Source<'_>, coefficients: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; source.output.len()];
    for (kernel, c) in source.own.iter().zip(coefficients) {
        if let Some((kernel, _)) = kernel {
            out.iter_mut().zip(*kernel).for_each(|(d, v)| *d -= c * v);
        }
    }
    out[0] += 1.0;
    out
}

/// Memory of the steps of one thread.
#[derive(Default)]
pub struct Scratch {
    buffers: Buffers,
}

/// One step for one equation: new coefficients from filters 1/D̂ and simulated outputs, one of each a record.
///
/// `dropped` lists (record, position) of initial terms to leave out. Returns the solution and, if asked for, the
/// covariance of the free coefficients.
///
/// # Errors
/// [`Error::Singular`] where the instruments do not tell the regressors apart.
#[allow(clippy::cast_precision_loss)]
pub fn step(
    sources: &[Source<'_>],
    filters: &[Kernel],
    responses: &[Vec<f64>],
    fixed: &[Option<f64>],
    dropped: &[(usize, usize)],
    with_covariance: bool,
    scratch: &mut Scratch,
) -> Result<(Solution, Vec<f64>)> {
    let free: Vec<usize> = (0..fixed.len()).filter(|&k| fixed[k].is_none()).collect();
    let width = sources.first().map_or(0, |s| s.initial.len());
    let kept: Vec<(usize, usize)> = (0..sources.len())
        .flat_map(|r| (0..width).map(move |i| (r, i)))
        .filter(|place| !dropped.contains(place))
        .collect();
    let k = free.len() + kept.len();
    let (mut cross, mut rhs) = (vec![0.0; k * k], vec![0.0; k]);
    let mut filtered = Vec::with_capacity(sources.len());
    for (r, source) in sources.iter().enumerate() {
        let m = source.output.len();
        let filter = &filters[r];
        let mut target = product(filter, source.target, m, scratch);
        let mut phi: Vec<Vec<f64>> = Vec::with_capacity(k);
        for (j, value) in fixed.iter().enumerate() {
            let column = product(filter, source.measured[j], m, scratch);
            match value {
                Some(c) => target.iter_mut().zip(&column).for_each(|(t, v)| *t -= c * v),
                None => phi.push(column),
            }
        }
        let simulated = Kernel::new(&product(filter, &Kernel::new(&responses[r]), m, scratch));
        let mut psi: Vec<Vec<f64>> = Vec::with_capacity(k);
        for (place, &j) in free.iter().enumerate() {
            psi.push(match source.own[j] {
                None if std::ptr::eq(source.clean[j], source.measured[j]) => phi[place].clone(),
                None => product(filter, source.clean[j], m, scratch),
                Some((_, spectrum)) => product(&simulated, spectrum, m, scratch),
            });
        }
        let mut places: Vec<usize> = (0..free.len()).collect();
        for (place, &(_, i)) in kept.iter().enumerate().filter(|(_, &(record, _))| record == r) {
            let column = product(filter, source.initial[i], m, scratch);
            psi.push(column.clone());
            phi.push(column);
            places.push(free.len() + place);
        }
        for (instrument, &a) in psi.iter().zip(&places) {
            rhs[a] += dot(instrument, &target);
            for (regressor, &b) in phi.iter().zip(&places) {
                cross[a * k + b] += dot(instrument, regressor);
            }
        }
        if with_covariance {
            filtered.push(Filtered { phi, psi, places, target });
        }
    }
    let inverse = small::scaled_inverse(&cross, k)?;
    let x: Vec<f64> = (0..k).map(|a| dot(&inverse[a * k..(a + 1) * k], &rhs)).collect();
    let mut solution: Solution = fixed.iter().map(|f| f.unwrap_or(0.0)).collect();
    for (&j, &value) in free.iter().zip(&x) {
        solution[j] = value;
    }
    solution.resize(fixed.len() + sources.len() * width, 0.0);
    for (&(r, i), &value) in kept.iter().zip(&x[free.len()..]) {
        solution[fixed.len() + r * width + i] = value;
    }
    let mut covariance = Vec::new();
    if with_covariance {
        let mut meat = vec![0.0; k * k];
        for part in &filtered {
            long_run(&part.scores(&x), &part.places, &mut meat, k);
        }
        let n = free.len();
        covariance = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                let mut total = 0.0;
                for i in 0..k {
                    for j in 0..k {
                        total += inverse[a * k + i] * meat[i * k + j] * inverse[b * k + j];
                    }
                }
                covariance[a * n + b] = total;
            }
        }
    }
    Ok((solution, covariance))
}

/// Regressors, instruments and target of one record behind the filter, and the unknown of each column.
struct Filtered {
    phi: Vec<Vec<f64>>,
    psi: Vec<Vec<f64>>,
    places: Vec<usize>,
    target: Vec<f64>,
}

impl Filtered {
    /// ψ e at a solution, a row each instrument.
    fn scores(&self, x: &[f64]) -> Vec<Vec<f64>> {
        let mut rest = self.target.clone();
        for (column, &place) in self.phi.iter().zip(&self.places) {
            rest.iter_mut().zip(column).for_each(|(e, v)| *e -= x[place] * v);
        }
        self.psi.iter().map(|p| p.iter().zip(&rest).map(|(p, e)| p * e).collect()).collect()
    }
}

/// Adds the long-run covariance of the sums of scores to a k × k matrix, with Bartlett weights
/// (doi:10.2307/1913610): what the filter leaves behind is not white where other measured outputs enter the equation.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(crate) fn long_run(scores: &[Vec<f64>], places: &[usize], meat: &mut [f64], k: usize) {
    let m = scores.first().map_or(0, Vec::len);
    let lags = ((4.0 * libm::cbrt(m as f64)) as usize).min(m.saturating_sub(1));
    for (left, &a) in scores.iter().zip(places) {
        for (right, &b) in scores.iter().zip(places) {
            meat[a * k + b] += dot(left, right);
            for lag in 1..=lags {
                let weight = 1.0 - lag as f64 / (lags + 1) as f64;
                let both = dot(&left[lag..], &right[..m - lag]) + dot(&left[..m - lag], &right[lag..]);
                meat[a * k + b] += weight * both;
            }
        }
    }
}

/// First m terms of a product of two cached series.
fn product(a: &Kernel, b: &Kernel, m: usize, scratch: &mut Scratch) -> Vec<f64> {
    let mut out = vec![0.0; m];
    a.times(b, &mut out, &mut scratch.buffers);
    out
}

pub(crate) fn dot(a: &[f64], b: &[f64]) -> f64 {
    // Four sums: one alone would wait for itself.
    let mut sums = [0.0; 4];
    let (left, right) = (a.chunks_exact(4), b.chunks_exact(4));
    let tail: f64 = left.remainder().iter().zip(right.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in left.zip(right) {
        for (sum, (x, y)) in sums.iter_mut().zip(x.iter().zip(y)) {
            *sum += x * y;
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + tail
}

/// One equation refined from a start, its output simulated from the clean signals of its sources.
///
/// `start` holds the coefficients of the terms, then of the initial terms record by record. Returns the last solution,
/// the steps made and whether the last moved nothing.
///
/// # Errors
/// As [`step`] and [`damped_inverse`].
pub fn refine(
    sources: &[Source<'_>],
    fixed: &[Option<f64>],
    dropped: &[(usize, usize)],
    start: &[f64],
    settings: Settings,
    scratch: &mut Scratch,
) -> Result<(Solution, usize, bool)> {
    let mut solution = start.to_vec();
    for made in 1..=settings.iterations {
        let mut filters = Vec::with_capacity(sources.len());
        let mut responses = Vec::with_capacity(sources.len());
        for (r, source) in sources.iter().enumerate() {
            let m = source.output.len();
            let (filter, _) = damped_inverse(&divisor(source, &solution))?;
            let mut sum = SumOfProducts::new(m);
            let spectrum = Kernel::new(&filter);
            for (j, own) in source.own.iter().enumerate() {
                if own.is_none() {
                    sum.add(solution[j], source.clean[j], &spectrum);
                }
            }
            for (i, term) in source.initial.iter().enumerate() {
                sum.add(solution[fixed.len() + r * source.initial.len() + i], term, &spectrum);
            }
            let mut response = vec![0.0; m];
            sum.take(&mut response, &mut scratch.buffers);
            filters.push(spectrum);
            responses.push(response);
        }
        let (next, _) = step(sources, &filters, &responses, fixed, dropped, false, scratch)?;
        let still = unmoved(&solution, &next, fixed.len(), settings.tolerance);
        solution = next;
        if still {
            return Ok((solution, made, true));
        }
    }
    Ok((solution, settings.iterations, false))
}

pub(crate) fn unmoved(before: &[f64], after: &[f64], terms: usize, tolerance: f64) -> bool {
    let largest = after[..terms].iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    before[..terms].iter().zip(after).all(|(a, b)| (a - b).abs() <= tolerance * b.abs().max(1e-9 * largest))
}

/// Refined instrumental variables for one or several equations on one or several records.
///
/// The records' clean signals ([`Record::with_clean`]) stand for outputs that no equation simulates, and are the first
/// instruments for those that one does; a record without them stands for itself. The iteration
/// starts from two-stage least squares behind several low-passes; the end with the least output error is kept, and
/// where none stands still the iterate with the least. An unstable iterate is damped (its series read at ρz, ρ < 1),
/// which keeps instruments bounded and clean.
///
/// O(iterations · Σ (terms · m log m + n² m log² m)).
///
/// # Errors
/// As least squares; [`Error::Singular`] where instruments cannot tell the terms apart; [`Error::Length`].
pub fn fit(
    records: &[Record],
    structures: &[Structure],
    fixed: &[Vec<Option<f64>>],
    initial: &Initial,
    settings: Settings,
) -> Result<Fit> {
    check_length("fixed coefficients", structures.len(), fixed.len())?;
    let clean: Vec<Record> = records.iter().map(Record::cleaned).collect();
    let exponents: Vec<Vec<f64>> = structures.iter().map(|s| s.initial_exponents(initial)).collect();
    let problem = Problem { records, clean: &clean, structures, fixed, exponents: &exponents };
    let mut best: Option<Ended> = None;
    let mut failure = None;
    // Ends of all equations together, by cost; from one start the equations one by one may come out unstable, from
    // another not.
    let mut together: Option<multivariable::Ended> = None;
    for multiple in PREFILTERS {
        // A start that cannot be made, or whose instruments fail, leaves the others.
        match problem.start(initial, multiple).and_then(|(solutions, dropped)| {
            let ended = problem.iterate(solutions.clone(), &dropped, settings)?;
            Ok((solutions, dropped, ended))
        }) {
            Ok((start, dropped, ended)) => {
                if structures.len() > 1 {
                    for from in [&ended.solutions, &start] {
                        let Some(found) = problem.together(from, &dropped, settings)? else { continue };
                        if together.as_ref().is_none_or(|t| found.cost < t.cost) {
                            together = Some(found);
                        }
                        break;
                    }
                }
                if best.as_ref().is_none_or(|b| ended.error < b.error) {
                    best = Some(ended);
                }
            }
            Err(error) => failure = failure.or(Some(error)),
        }
    }
    let Some(mut ended) = best else {
        return Err(failure.unwrap_or_else(|| Error::Diverged { what: "free run of every start".into(), index: 0 }));
    };
    if let Some(found) = together {
        ended = Ended {
            error: ended.error,
            solutions: found.solutions,
            covariances: found.covariances,
            iterations: ended.iterations + found.iterations,
            converged: found.converged,
            damped: false,
        };
    }
    let estimates = ended
        .solutions
        .into_iter()
        .zip(structures)
        .zip(exponents)
        .zip(ended.covariances)
        .map(|(((solution, structure), exponents), covariance)| {
            let (coefficients, rest) = solution.split_at(structure.terms.len());
            let width = exponents.len();
            let initial = (0..records.len()).map(|r| rest[r * width..(r + 1) * width].to_vec()).collect();
            Estimate { coefficients: coefficients.to_vec(), initial, exponents, covariance }
        })
        .collect();
    Ok(Fit { estimates, iterations: ended.iterations, converged: ended.converged, damped: ended.damped })
}

/// (record, position) of the initial terms left out.
pub type Dropped = Vec<(usize, usize)>;

struct Problem<'a> {
    records: &'a [Record],
    clean: &'a [Record],
    structures: &'a [Structure],
    fixed: &'a [Vec<Option<f64>>],
    exponents: &'a [Vec<f64>],
}

/// Where one start ended.
struct Ended {
    error: f64,
    solutions: Vec<Solution>,
    covariances: Vec<Vec<f64>>,
    iterations: usize,
    converged: bool,
    damped: bool,
}

impl Problem<'_> {
    /// Two-stage least squares: one step with the clean signals as instruments, behind a low-pass at a multiple of each
    /// output's own band if one is given.
    fn start(&self, initial: &Initial, multiple: Option<f64>) -> Result<(Vec<Solution>, Vec<Dropped>)> {
        let mut scratch = Scratch::default();
        let mut solutions = Vec::with_capacity(self.structures.len());
        let mut dropped = Vec::with_capacity(self.structures.len());
        for (i, (structure, fixed)) in self.structures.iter().zip(self.fixed).enumerate() {
            let plain = least_squares::fit(self.records, structure, fixed, initial)?;
            let shelves = self.shelves(i, self.clean);
            let sources: Vec<Source<'_>> = shelves.iter().map(Shelf::source).collect();
            let filters = self
                .records
                .iter()
                .map(|r| {
                    let band = power_frequency(r.signal(structure.output), r.step());
                    let filter = multiple.map_or_else(|| Ok(unit(r.m())), |multiple| low_pass(multiple * band, r));
                    Ok(Kernel::new(&filter?))
                })
                .collect::<Result<Vec<_>>>()?;
            let own: Vec<Vec<f64>> = self.clean.iter().map(|r| r.signal(structure.output).to_vec()).collect();
            let (start, _) = step(&sources, &filters, &own, fixed, &plain.dropped, false, &mut scratch)?;
            solutions.push(start);
            dropped.push(plain.dropped);
        }
        Ok((solutions, dropped))
    }

    fn shelves(&self, i: usize, substitutes: &[Record]) -> Vec<Shelf<'_>> {
        self.records
            .iter()
            .zip(substitutes)
            .map(|(record, substitute)| Shelf::new(record, substitute, &self.structures[i], &self.exponents[i]))
            .collect()
    }

    fn iterate(&self, mut solutions: Vec<Solution>, dropped: &[Dropped], settings: Settings) -> Result<Ended> {
        let mut scratch = Scratch::default();
        let mut best = (f64::INFINITY, solutions.clone());
        let (mut iterations, mut converged, mut shortened) = (0, false, 0);
        loop {
            let (responses, damped) = coupled(self.clean, self.structures, self.exponents, &solutions)?;
            let error = output_error(self.records, self.structures, &responses);
            if error < best.0 {
                best = (error, solutions.clone());
                shortened = 0;
            }
            let last = converged || iterations == settings.iterations;
            if !last && shortened < SHORTENED && (error.is_nan() || error > WORSE * best.0) {
                // A step too far: half-way back to the best.
                for (x, y) in solutions.iter_mut().flatten().zip(best.1.iter().flatten()) {
                    *x = 0.5 * (*x + y);
                }
                shortened += 1;
                iterations += 1;
                continue;
            }
            if last && !converged && solutions != best.1 {
                // Once more, for the covariance of what is handed out.
                solutions.clone_from(&best.1);
                continue;
            }
            let (next, covariances) = self.step(&solutions, &responses, dropped, last, &mut scratch)?;
            if last {
                return Ok(Ended { error, solutions, covariances, iterations, converged, damped });
            }
            iterations += 1;
            converged = solutions
                .iter()
                .zip(&next)
                .zip(self.structures)
                .all(|((a, b), s)| unmoved(a, b, s.terms.len(), settings.tolerance));
            solutions = next;
        }
    }

    /// All equations together from a start ([`multivariable`]); None where that cannot be done.
    fn together(
        &self,
        start: &[Solution],
        dropped: &[Dropped],
        settings: Settings,
    ) -> Result<Option<multivariable::Ended>> {
        let problem = multivariable::Problem {
            records: self.records,
            clean: self.clean,
            structures: self.structures,
            fixed: self.fixed,
            exponents: self.exponents,
            dropped,
        };
        match problem.refine(start, settings) {
            Err(Error::Singular { .. }) => Ok(None),
            other => other,
        }
    }

    /// One step of every equation with the instruments of one coupled free run.
    fn step(
        &self,
        solutions: &[Solution],
        responses: &[Vec<Vec<f64>>],
        dropped: &[Dropped],
        with_covariance: bool,
        scratch: &mut Scratch,
    ) -> Result<(Vec<Solution>, Vec<Vec<f64>>)> {
        let simulated = self
            .clean
            .iter()
            .zip(responses)
            .map(|(record, outputs)| {
                let replaced = (0..record.len()).map(|s| match self.structures.iter().position(|e| e.output == s) {
                    Some(i) => outputs[i].clone(),
                    None => record.signal(s).to_vec(),
                });
                Record::new(record.step(), replaced.collect(), None)
            })
            .collect::<Result<Vec<_>>>()?;
        let mut out = (Vec::new(), Vec::new());
        for (i, fixed) in self.fixed.iter().enumerate() {
            let shelves = self.shelves(i, &simulated);
            let sources: Vec<Source<'_>> = shelves.iter().map(Shelf::source).collect();
            let filters = sources
                .iter()
                .map(|s| Ok(Kernel::new(&damped_inverse(&divisor(s, &solutions[i]))?.0)))
                .collect::<Result<Vec<_>>>()?;
            let own: Vec<Vec<f64>> = responses.iter().map(|outputs| outputs[i].clone()).collect();
            let (solution, covariance) = step(&sources, &filters, &own, fixed, &dropped[i], with_covariance, scratch)?;
            out.0.push(solution);
            out.1.push(covariance);
        }
        Ok(out)
    }
}

/// Frequency [rad/s] below which 90 % of a signal's power lies.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn power_frequency(signal: &[f64], step: f64) -> f64 {
    let m = signal.len();
    let mean = signal.iter().sum::<f64>() / m.max(1) as f64;
    let power = fft::power_spectrum(signal.iter().enumerate().map(|(k, v)| {
        // Hann's window: what an open end leaks would count as high frequency.
        let window = 0.5 - 0.5 * libm::cos(2.0 * std::f64::consts::PI * k as f64 / m as f64);
        window * (v - mean)
    }));
    let total: f64 = power.iter().sum();
    let mut sum = 0.0;
    let at = power.iter().position(|p| {
        sum += p;
        sum >= 0.9 * total
    });
    // Bins of the padded transform are 1/(its length) apart; the last bin is Nyquist's frequency.
    let bins = power.len().saturating_sub(1).max(1) as f64;
    std::f64::consts::PI / step * at.unwrap_or(0).max(1) as f64 / bins
}

/// A second-order low-pass as a series: behind it the equation between all signals stays the same.
///
/// # Errors
/// As [`Filter::series`].
pub fn low_pass(omega: f64, record: &Record) -> Result<Vec<f64>> {
    let numerator = vec![(omega * omega, 0.0)];
    let denominator = vec![(1.0, 2.0), (1.4 * omega, 1.0), (omega * omega, 0.0)];
    Filter { numerator, denominator }.series(record.m(), record.step())
}

/// The series 1.
fn unit(m: usize) -> Vec<f64> {
    let mut one = vec![0.0; m];
    if let Some(first) = one.first_mut() {
        *first = 1.0;
    }
    one
}

/// Σ ‖y − ŷ‖²/‖y‖² over records and equations.
fn output_error(records: &[Record], structures: &[Structure], responses: &[Vec<Vec<f64>>]) -> f64 {
    let mut total = 0.0;
    for (record, outputs) in records.iter().zip(responses) {
        for (structure, response) in structures.iter().zip(outputs) {
            let y = record.signal(structure.output);
            let missed: f64 = y.iter().zip(response).map(|(y, v)| (y - v) * (y - v)).sum();
            total += missed / dot(y, y).max(f64::MIN_POSITIVE);
        }
    }
    total
}

/// The equations that solutions make.
pub(crate) fn equations(structures: &[Structure], solutions: &[Solution]) -> Vec<Equation> {
    let pairs = structures.iter().zip(solutions);
    pairs.map(|(s, x)| Equation { structure: s.clone(), coefficients: x[..s.terms.len()].to_vec() }).collect()
}

/// (exponent, coefficient) of the initial terms of record r that solutions hold, per equation.
pub(crate) fn initial_terms(
    r: usize,
    structures: &[Structure],
    exponents: &[Vec<f64>],
    solutions: &[Solution],
) -> Vec<Vec<(f64, f64)>> {
    exponents
        .iter()
        .zip(structures)
        .zip(solutions)
        .map(|((exponents, s), x)| {
            let first = s.terms.len() + r * exponents.len();
            exponents.iter().copied().zip(x[first..].iter().copied()).collect()
        })
        .collect()
}

/// Free runs of all equations together on every record, damped where they grow.
#[allow(clippy::cast_precision_loss)]
fn coupled(
    clean: &[Record],
    structures: &[Structure],
    exponents: &[Vec<f64>],
    solutions: &[Solution],
) -> Result<(Vec<Vec<Vec<f64>>>, bool)> {
    let equations = equations(structures, solutions);
    let mut damped = false;
    let mut out = Vec::with_capacity(clean.len());
    for (r, record) in clean.iter().enumerate() {
        let initial = initial_terms(r, structures, exponents, solutions);
        let m = record.m() as f64;
        let mut gamma = 0.0;
        let outputs = loop {
            let outputs = simulate::respond_damped(&equations, record, &initial, gamma / m)?;
            // A run that grows with its input is no instability; one that passes all measured sizes is.
            let grown = outputs.iter().zip(structures).any(|(response, s)| {
                let measured = record.signal(s.output).iter().fold(0.0_f64, |a, v| a.max(v.abs()));
                response.iter().any(|v| !v.is_finite() || v.abs() > 10.0 * measured.max(f64::MIN_POSITIVE))
            });
            if !grown || gamma > 64.0 * m {
                break outputs;
            }
            damped = true;
            gamma = if gamma == 0.0 { 4.0 } else { 2.0 * gamma };
        };
        out.push(outputs);
    }
    Ok((out, damped))
}

/// Spectra that the sources of one record own.
struct Shelf<'a> {
    kernels: Vec<Option<(Vec<f64>, Kernel)>>,
    measured: Vec<Kernel>,
    clean: Vec<Kernel>,
    initial: Vec<Kernel>,
    target: Kernel,
    output: &'a [f64],
}

impl<'a> Shelf<'a> {
    fn new(record: &'a Record, clean: &Record, structure: &Structure, exponents: &[f64]) -> Self {
        let orders = (0..structure.terms.len()).map(|k| (structure.terms[k].signal, structure.integration(k)));
        let own = |s: usize| s == structure.output;
        Self {
            kernels: orders
                .clone()
                .map(|(s, eta)| {
                    own(s).then(|| {
                        let kernel = block_pulse_kernel(eta, record.m(), record.step());
                        let spectrum = Kernel::new(&kernel);
                        (kernel, spectrum)
                    })
                })
                .collect(),
            measured: orders.clone().map(|(s, eta)| Kernel::new(&record.integral(s, eta))).collect(),
            clean: orders.map(|(s, eta)| Kernel::new(&clean.integral(s, eta))).collect(),
            initial: exponents.iter().map(|&e| Kernel::new(&record.initial_term(e))).collect(),
            target: Kernel::new(record.signal(structure.output)),
            output: record.signal(structure.output),
        }
    }

    fn source(&self) -> Source<'_> {
        Source {
            own: self.kernels.iter().map(|k| k.as_ref().map(|(kernel, spectrum)| (&kernel[..], spectrum))).collect(),
            measured: self.measured.iter().collect(),
            clean: self.clean.iter().collect(),
            initial: self.initial.iter().collect(),
            target: &self.target,
            output: self.output,
        }
    }
}

/// A record with clean substitutes ([`project`]) for all signals that are no inputs; inputs stand for themselves.
///
/// # Errors
/// As [`project`].
pub fn with_projections(record: Record, inputs: &[bool], at_rest: bool) -> Result<Record> {
    let known: Vec<usize> = (0..record.len()).filter(|&s| inputs.get(s).copied().unwrap_or(false)).collect();
    let clean = (0..record.len())
        .map(|s| if known.contains(&s) { Ok(record.signal(s).to_vec()) } else { project(&record, s, &known, at_rest) })
        .collect::<Result<Vec<_>>>()?;
    record.with_clean(clean)
}

/// A measured signal without most of its noise: its least-squares projection on what the inputs excite.
///
/// The basis holds each input's first two integrals and, eight a decade, its response through resonators: k columns
/// leave k/m of the noise power, whatever the signal's dynamics. Deterministic powers of t (offset, ramp) are added
/// where the record does not start at rest.
///
/// # Errors
/// No input, a record of fewer than 8 pulses.
#[allow(clippy::cast_precision_loss)]
pub fn project(record: &Record, signal: usize, inputs: &[usize], at_rest: bool) -> Result<Vec<f64>> {
    let (m, h) = (record.m(), record.step());
    if m < 8 || inputs.is_empty() {
        return Err(Error::Structure {
            what: "instruments need an input and at least 8 pulses".into(),
            remedy: "use a longer record, or least squares".into(),
        });
    }
    let duration = m as f64 * h;
    let (low, high) = (std::f64::consts::PI / duration, std::f64::consts::PI / (4.0 * h));
    let decades = libm::log10(high / low);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let count = ((decades * RESONATORS as f64) as usize).clamp(2, (m / (8 * inputs.len())).max(2));
    let mut columns = Vec::new();
    if !at_rest {
        columns.extend([0.0, 1.0].map(|e| record.initial_term(e)));
    }
    for &input in inputs {
        let u = record.signal(input);
        let driver = Kernel::new(u);
        let mut buffers = Buffers::default();
        let mut through = |series: &[f64]| {
            let mut out = vec![0.0; m];
            driver.apply(series, &mut out, &mut buffers);
            out
        };
        columns.extend([1.0, 2.0].map(|eta| through(&block_pulse_kernel(eta, m, h))));
        for i in 0..count {
            let omega = low * libm::pow(10.0, decades * i as f64 / (count - 1) as f64);
            let denominator = vec![(1.0, 2.0), (2.0 * RESONATOR_DAMPING * omega, 1.0), (omega * omega, 0.0)];
            for numerator in [(omega * omega, 0.0), (omega, 1.0)] {
                let filter = Filter { numerator: vec![numerator], denominator: denominator.clone() };
                columns.push(through(&filter.series(m, h)?));
            }
        }
    }
    let target = record.signal(signal);
    let mut basis = Vec::with_capacity(columns.len());
    for column in columns {
        dense::extend_orthonormal(&mut basis, column, SPANNED);
    }
    let mut out = vec![0.0; m];
    for direction in &basis {
        let along = dot(direction, target);
        out.iter_mut().zip(direction).for_each(|(o, v)| *o += along * v);
    }
    Ok(out)
}
