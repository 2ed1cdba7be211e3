//! Instrumental variables for one equation: the regression of one step, and the iteration to convergence.
//!
//! The equation is filtered by 1/D̂, where D̂ is the estimated operator on its own output. The equation error is then
//! close to the white noise of the output. The filtered regressors are correlated with noise-free instruments: the
//! inputs and the simulated output. Filter and instruments depend on the last estimate, so the step is iterated.

use super::prefilter::damped_inverse;
use super::solution::{
    add_long_run_covariance, dot, has_converged, orthonormalize_instruments, InstrumentalSettings, RecordInstruments,
    Solution,
};
use crate::equation::Structure;
use crate::error::Result;
use crate::fractional::kernels;
use crate::linalg::small::EquilibratedLu;
use crate::parallel::Stop;
use crate::regressors::Record;
use crate::series::{multiply, Buffers, Kernel, SumOfProducts};

/// Signals of one record for one equation, with spectra that are padded for products of two series of m pulses.
pub struct InstrumentSource<'a> {
    /// Per term of the output itself: the kernel of integration of order η, and its spectrum. None for other terms.
    pub output_terms: Vec<Option<(&'a [f64], &'a Kernel)>>,
    /// Per term: spectrum of its measured signal, integrated with order η.
    pub measured: Vec<&'a Kernel>,
    /// Per term: spectrum of its noise-free signal, integrated with order η.
    ///
    /// It is the same object as in `measured` if there is no substitute. For terms of the output itself it is unused.
    pub clean: Vec<&'a Kernel>,
    /// Spectra of the initial terms.
    pub initial: Vec<&'a Kernel>,
    /// Spectrum of the measured output.
    pub target: &'a Kernel,
    /// The measured output.
    pub output: &'a [f64],
}

/// Spectra of one record and equation that do not depend on the solution.
pub(super) struct EquationSpectra<'a> {
    record: &'a Record,
    output: usize,
    terms: Vec<TermSpectra>,
    initial: Vec<Kernel>,
    target: Kernel,
}

/// Spectra of one term: kernel of integration of order η, its spectrum, and that of the integrated measured signal.
struct TermSpectra {
    signal: usize,
    eta: f64,
    kernel: Vec<f64>,
    spectrum: Kernel,
    measured: Kernel,
}

impl TermSpectra {
    /// Spectrum of `signal`, integrated with the order η of this term.
    fn integral_spectrum(&self, signal: &[f64]) -> Kernel {
        if self.eta == 0.0 {
            Kernel::new(signal)
        } else {
            Kernel::new(&multiply(&self.kernel, signal, signal.len()))
        }
    }
}

impl<'a> EquationSpectra<'a> {
    pub(super) fn new(record: &'a Record, structure: &Structure, exponents: &[f64]) -> Self {
        let term = |k: usize| {
            let (signal, eta) = (structure.terms[k].signal, structure.integration(k));
            let kernel = kernels::kernel(eta, record.m(), record.step());
            let spectrum = Kernel::new(&kernel);
            let measured = Kernel::new(&record.integral(signal, eta));
            TermSpectra { signal, eta, kernel, spectrum, measured }
        };
        Self {
            record,
            output: structure.output,
            terms: (0..structure.terms.len()).map(term).collect(),
            initial: exponents.iter().map(|&e| Kernel::new(&record.initial_term(e))).collect(),
            target: Kernel::new(record.signal(structure.output)),
        }
    }

    /// Spectra of the terms, computed from the signals of `substitute`; one entry per term.
    ///
    /// An entry is None if its signal is the output of the equation, is not selected, or equals the measured signal.
    pub(super) fn substitute_spectra(
        &self,
        substitute: &Record,
        is_selected: impl Fn(usize) -> bool,
    ) -> Vec<Option<Kernel>> {
        let is_substituted =
            |s: usize| s != self.output && is_selected(s) && substitute.signal(s) != self.record.signal(s);
        self.terms
            .iter()
            .map(|t| is_substituted(t.signal).then(|| t.integral_spectrum(substitute.signal(t.signal))))
            .collect()
    }

    /// Return the data of one step. `clean` returns the substitute spectrum of a term; if it returns None, the measured
    /// spectrum is used.
    pub(super) fn source<'b>(&'b self, clean: impl Fn(usize) -> Option<&'b Kernel>) -> InstrumentSource<'b> {
        let is_output_term = |t: &TermSpectra| t.signal == self.output;
        let terms = || self.terms.iter();
        InstrumentSource {
            output_terms: terms().map(|t| is_output_term(t).then_some((&t.kernel[..], &t.spectrum))).collect(),
            measured: terms().map(|t| &t.measured).collect(),
            clean: terms().enumerate().map(|(k, t)| clean(k).unwrap_or(&t.measured)).collect(),
            initial: self.initial.iter().collect(),
            target: &self.target,
            output: self.record.signal(self.output),
        }
    }
}

/// Divisor D = 1 − Σ c I^η over the terms of the output itself, as a series; I^η is integration of order η.
pub(super) fn divisor(source: &InstrumentSource<'_>, coefficients: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; source.output.len()];
    for (kernel, c) in source.output_terms.iter().zip(coefficients) {
        if let Some((kernel, _)) = kernel {
            out.iter_mut().zip(*kernel).for_each(|(d, v)| *d -= c * v);
        }
    }
    out[0] += 1.0;
    out
}

/// Work buffers and stop request of the steps of one thread.
#[derive(Default)]
pub struct Scratch {
    buffers: Buffers,
    stop: Stop,
}

impl Scratch {
    /// Return work buffers for steps that end with [`Interrupted`](crate::error::Error::Interrupted) after a stop
    /// request.
    #[must_use]
    pub fn with_stop(stop: &Stop) -> Self {
        Self { buffers: Buffers::default(), stop: stop.clone() }
    }
}

/// Compute new coefficients of one equation by one step of instrumental variables.
///
/// `filters` are the prefilters 1/D̂ ([`damped_inverse`]) and `responses` the simulated outputs, one each per record.
/// `fixed` has one entry per term: the value of a fixed coefficient, None for a free one. `excluded_terms` lists
/// (record index, exponent index) of excluded initial terms. Return the solution and the row-major covariance matrix of
/// the free coefficients, which is empty if not requested.
///
/// # Errors
/// [`Singular`](crate::error::Error::Singular) if the instruments do not identify the coefficients,
/// [`Interrupted`](crate::error::Error::Interrupted) after a stop request.
#[allow(clippy::cast_precision_loss)]
pub fn step(
    sources: &[InstrumentSource<'_>],
    filters: &[Kernel],
    responses: &[Vec<f64>],
    fixed: &[Option<f64>],
    excluded_terms: &[(usize, usize)],
    with_covariance: bool,
    scratch: &mut Scratch,
) -> Result<(Solution, Vec<f64>)> {
    let free: Vec<usize> = (0..fixed.len()).filter(|&k| fixed[k].is_none()).collect();
    let width = sources.first().map_or(0, |s| s.initial.len());
    let pairs: Vec<(usize, usize)> = (0..sources.len())
        .flat_map(|r| (0..width).map(move |i| (r, i)))
        .filter(|position| !excluded_terms.contains(position))
        .collect();
    let k = free.len() + pairs.len();
    let (mut filtered, mut instruments) = (Vec::with_capacity(sources.len()), Vec::with_capacity(sources.len()));
    for (r, source) in sources.iter().enumerate() {
        let m = source.output.len();
        let filter = &filters[r];
        let mut target = product(filter, source.target, m, scratch)?;
        let mut phi: Vec<Vec<f64>> = Vec::with_capacity(k);
        for (j, value) in fixed.iter().enumerate() {
            let column = product(filter, source.measured[j], m, scratch)?;
            match value {
                Some(c) => target.iter_mut().zip(&column).for_each(|(t, v)| *t -= c * v),
                None => phi.push(column),
            }
        }
        let simulated = Kernel::new(&product(filter, &Kernel::new(&responses[r]), m, scratch)?);
        let mut psi: Vec<Vec<f64>> = Vec::with_capacity(k);
        for (position, &j) in free.iter().enumerate() {
            psi.push(match source.output_terms[j] {
                None if std::ptr::eq(source.clean[j], source.measured[j]) => phi[position].clone(),
                None => product(filter, source.clean[j], m, scratch)?,
                Some((_, spectrum)) => product(&simulated, spectrum, m, scratch)?,
            });
        }
        let mut unknown_indices: Vec<usize> = (0..free.len()).collect();
        for (position, &(_, i)) in pairs.iter().enumerate().filter(|&(_, &(record, _))| record == r) {
            let column = product(filter, source.initial[i], m, scratch)?;
            psi.push(column.clone());
            phi.push(column);
            unknown_indices.push(free.len() + position);
        }
        filtered.push(FilteredRegression { phi, target });
        instruments.push(RecordInstruments { columns: psi, unknown_indices });
    }
    orthonormalize_instruments(&mut instruments, k)?;
    let (mut cross, mut rhs) = (vec![0.0; k * k], vec![0.0; k]);
    for (FilteredRegression { phi, target }, RecordInstruments { columns, unknown_indices }) in
        filtered.iter().zip(&instruments)
    {
        for (instrument, &a) in columns.iter().zip(unknown_indices) {
            rhs[a] += dot(instrument, target);
            for (regressor, &b) in phi.iter().zip(unknown_indices) {
                cross[a * k + b] += dot(instrument, regressor);
            }
        }
    }
    let factorization = EquilibratedLu::new(&cross, k)?;
    let x = factorization.solve(&rhs);
    let mut solution: Solution = fixed.iter().map(|f| f.unwrap_or(0.0)).collect();
    for (&j, &value) in free.iter().zip(&x) {
        solution[j] = value;
    }
    solution.resize(fixed.len() + sources.len() * width, 0.0);
    for (&(r, i), &value) in pairs.iter().zip(&x[free.len()..]) {
        solution[fixed.len() + r * width + i] = value;
    }
    let mut covariance = Vec::new();
    if with_covariance {
        let mut score_covariance = vec![0.0; k * k];
        for (part, instruments) in filtered.iter().zip(&instruments) {
            add_long_run_covariance(
                &part.scores(instruments, &x),
                &instruments.unknown_indices,
                &mut score_covariance,
                k,
            );
        }
        let (n, inverse) = (free.len(), factorization.inverse());
        covariance = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..n {
                let mut total = 0.0;
                for i in 0..k {
                    for j in 0..k {
                        total += inverse[a * k + i] * score_covariance[i * k + j] * inverse[b * k + j];
                    }
                }
                covariance[a * n + b] = total;
            }
        }
    }
    Ok((solution, covariance))
}

/// The prefiltered regressors and target of one record.
struct FilteredRegression {
    phi: Vec<Vec<f64>>,
    target: Vec<f64>,
}

impl FilteredRegression {
    /// Return the samplewise product of each instrument with the residuals at the coefficients `x`, one row each.
    fn scores(&self, instruments: &RecordInstruments, x: &[f64]) -> Vec<Vec<f64>> {
        let mut residuals = self.target.clone();
        for (column, &index) in self.phi.iter().zip(&instruments.unknown_indices) {
            residuals.iter_mut().zip(column).for_each(|(e, v)| *e -= x[index] * v);
        }
        instruments.columns.iter().map(|p| p.iter().zip(&residuals).map(|(p, e)| p * e).collect()).collect()
    }
}

/// Return the first `m` coefficients of the product of two series, or an error after a stop request.
fn product(a: &Kernel, b: &Kernel, m: usize, scratch: &mut Scratch) -> Result<Vec<f64>> {
    scratch.stop.check()?;
    let mut out = vec![0.0; m];
    a.times(b, &mut out, &mut scratch.buffers);
    Ok(out)
}

/// Refine one equation from an initial guess until its coefficients converge.
///
/// The output is simulated from the noise-free signals of the sources. `start` contains the coefficients of the terms,
/// then those of the initial terms record by record. Return the last solution, the number of iterations, and true if
/// the iteration converged.
///
/// # Errors
/// [`Singular`](crate::error::Error::Singular) if the instruments do not identify the coefficients.
/// [`Interrupted`](crate::error::Error::Interrupted) after a stop request.
/// [`LeadingZero`](crate::error::Error::LeadingZero) if the leading coefficient of the divisor is zero.
pub fn refine(
    sources: &[InstrumentSource<'_>],
    fixed: &[Option<f64>],
    excluded_terms: &[(usize, usize)],
    start: &[f64],
    settings: InstrumentalSettings,
    scratch: &mut Scratch,
) -> Result<(Solution, usize, bool)> {
    let mut solution = start.to_vec();
    for iteration in 1..=settings.iterations {
        let mut filters = Vec::with_capacity(sources.len());
        let mut responses = Vec::with_capacity(sources.len());
        for (r, source) in sources.iter().enumerate() {
            let m = source.output.len();
            scratch.stop.check()?;
            let (filter, _) = damped_inverse(&divisor(source, &solution))?;
            let mut sum = SumOfProducts::new(m);
            let spectrum = Kernel::new(&filter);
            for (j, own_term) in source.output_terms.iter().enumerate() {
                if own_term.is_none() {
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
        let (next, _) = step(sources, &filters, &responses, fixed, excluded_terms, false, scratch)?;
        let converged = has_converged(&solution, &next, fixed.len(), settings.tolerance);
        solution = next;
        if converged {
            return Ok((solution, iteration, true));
        }
    }
    Ok((solution, settings.iterations, false))
}
