//! Instrumental-variable estimation from several initial guesses: equation by equation, then all equations together.
//!
//! All given equations are simulated together. A signal is an input of this simulation if it is not the output of any
//! equation. If such a signal is measured with noise, it needs a noise-free substitute ([`project`](super::project)).

use super::coupled;
use super::prefilter::{damped_inverse, power_frequency, state_variable_filter};
use super::single::{divisor, step, EquationSpectra, InstrumentSource, Scratch};
use super::solution::{dot, equations, has_converged, initial_terms, ExcludedTerms, InstrumentalSettings, Solution};
use crate::equation::{Initial, Structure};
use crate::error::{check_length, Error, Result};
use crate::estimation::least_squares;
use crate::regressors::Record;
use crate::series::Kernel;
use crate::series_system::System;

/// Poles λ of the state-variable filters, relative to the bandwidth of the output; each yields one initial guess.
///
/// Without such a filter, the regressors are pure integrals, in which drift dominates if the record is long.
const FILTER_POLE_RATIOS: [f64; 5] = [0.1, 0.3, 1.0, 3.0, 10.0];

/// Ratio of the output error after a step to the smallest output error so far, above which the step is halved.
const MAX_ERROR_RATIO: f64 = 1.2;
/// Maximum number of consecutive step halvings.
const MAX_STEP_HALVINGS: usize = 4;

/// Relative difference of coefficients below which two solutions count as equal.
const SAME_SOLUTION_TOLERANCE: f64 = 1e-4;

/// Coefficient estimates of one equation.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct InstrumentalEstimate {
    /// Coefficients, one per term. A fixed coefficient has the given value.
    pub coefficients: Vec<f64>,
    /// Coefficients of the initial terms, one list per record; 0 for a term excluded as linearly dependent.
    pub initial: Vec<Vec<f64>>,
    /// Exponents of the initial terms (powers of time).
    pub exponents: Vec<f64>,
    /// Covariance matrix of the free coefficients at the given orders, row-major, robust to colored residuals.
    pub covariance: Vec<f64>,
}

/// Coefficient estimates of all equations.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct InstrumentalFit {
    /// Estimates, one per equation.
    pub estimates: Vec<InstrumentalEstimate>,
    /// Number of iterations.
    pub iterations: usize,
    /// True if the last step changed no coefficient by more than the tolerance; otherwise the estimates are the iterate
    /// with the least output error.
    pub converged: bool,
    /// True if the estimated model is unstable. Its simulation is then damped by a factor ρ < 1 per sample.
    pub damped: bool,
}

/// Fit one or several equations to one or several records by refined instrumental variables.
///
/// A record may contain noise-free signals ([`Record::with_clean`]). They replace the measured outputs that no equation
/// simulates. In the first step, they are also the instruments for the simulated outputs. A record without them uses
/// its measured signals. Each initial guess is a two-stage least-squares estimate with a different state-variable
/// filter. The result is the refined solution with the least output error. If no refinement converges, it is the
/// iterate with the least output error. The series of an unstable iterate are evaluated at ρz with ρ < 1, which keeps
/// the instruments bounded and free of noise.
///
/// The cost is O(iterations · Σ (terms · m log m + n² m log² m)) for n equations. The sum is over records of m pulses.
///
/// # Errors
/// [`Error::OutOfRange`] if a setting or an order is out of range. [`Error::Structure`] if a structure is invalid.
/// [`Error::Singular`] if the instruments do not identify the coefficients. [`Error::Length`] if there is no equation
/// or if `fixed` does not have one entry per equation. [`Error::Diverged`] if no initial guess can be simulated.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::{Equation, Initial, Structure, Term};
/// use ftlm::estimation::instrumental_variables as iv;
/// use ftlm::regressors::Record;
/// use ftlm::simulate;
/// use ftlm::parallel::Stop;
/// let terms = vec![Term { signal: 0, order: 0.5 }, Term { signal: 1, order: 0.0 }];
/// let plant = Equation::new(Structure { output: 0, order: 1.5, terms }, vec![-4.0, 2.0])?;
/// let input: Vec<f64> = (0..400).map(|k| if k % 100 < 50 { 1.0 } else { -1.0 }).collect();
/// let excitation = Record::new(0.02, PulseMeans::from_signals(vec![vec![0.0; 400], input.clone()]), None)?;
/// let output = simulate::respond(std::slice::from_ref(&plant), &excitation, &[])?.remove(0);
/// let measured = Record::new(0.02, PulseMeans::from_signals(vec![output, input]), None)?;
/// let run = iv::with_projections(measured, &[false, true], true, &Stop::default())?;
/// let structures = [plant.structure.clone()];
/// let found = iv::fit(&[run], &structures, &[vec![None, None]], &Initial::Rest, iv::InstrumentalSettings::default())?;
/// assert!(found.converged && (found.estimates[0].coefficients[1] - 2.0).abs() < 1e-6);
/// # Ok(())
/// # }
/// ```
pub fn fit(
    records: &[Record],
    structures: &[Structure],
    fixed: &[Vec<Option<f64>>],
    initial: &Initial,
    settings: InstrumentalSettings,
) -> Result<InstrumentalFit> {
    settings.check()?;
    check_length("fixed coefficients", structures.len(), fixed.len())?;
    if structures.is_empty() {
        return Err(Error::Length { name: "equations".into(), expected: 1, found: 0 });
    }
    let clean: Vec<Record> = records.iter().map(Record::clean_record).collect();
    let exponents: Vec<Vec<f64>> = structures.iter().map(|s| s.initial_exponents(initial)).collect();
    let problem = CoupledProblem::new(records, &clean, structures, (fixed, initial), &exponents)?;
    let mut refinements: Vec<(Vec<Solution>, RefinementResult)> = Vec::new();
    let mut failure = None;
    for ratio in FILTER_POLE_RATIOS {
        // An initial guess that fails does not affect the others.
        match problem.start(ratio).and_then(|start| Ok((start.clone(), problem.iterate(start, settings)?))) {
            Ok(result) => refinements.push(result),
            Err(error) => failure = failure.or(Some(error)),
        }
    }
    // Best refinement of all equations together. Whether the separate estimates are stable depends on the initial
    // guess.
    let mut joint_refinement: Option<coupled::CoupledEstimate> = None;
    let mut refined: Vec<&[Solution]> = Vec::new();
    for (start, refinement) in refinements.iter().filter(|_| structures.len() > 1) {
        // Most initial guesses end at the same estimates, which have one refinement.
        if refined
            .iter()
            .any(|previous| problem.has_converged_to(previous, &refinement.solutions, SAME_SOLUTION_TOLERANCE))
        {
            continue;
        }
        refined.push(&refinement.solutions);
        for guess in [&refinement.solutions, start] {
            let Some(candidate) = problem.refine_together(guess, settings)? else { continue };
            if joint_refinement.as_ref().is_none_or(|t| candidate.cost < t.cost) {
                joint_refinement = Some(candidate);
            }
            break;
        }
    }
    let best = refinements.into_iter().map(|(_, refinement)| refinement).min_by(|a, b| a.error.total_cmp(&b.error));
    let Some(mut refinement) = best else {
        return Err(
            failure.unwrap_or_else(|| Error::Diverged { what: "simulation of every initial guess".into(), index: 0 })
        );
    };
    if let Some(candidate) = joint_refinement {
        refinement = RefinementResult {
            error: refinement.error,
            solutions: candidate.solutions,
            covariances: candidate.covariances,
            iterations: refinement.iterations + candidate.iterations,
            converged: candidate.converged,
            damped: false,
        };
    }
    let estimates = refinement
        .solutions
        .into_iter()
        .zip(structures)
        .zip(exponents)
        .zip(refinement.covariances)
        .map(|(((solution, structure), exponents), covariance)| {
            let (coefficients, initial_coefficients) = solution.split_at(structure.terms.len());
            let width = exponents.len();
            let initial =
                (0..records.len()).map(|r| initial_coefficients[r * width..(r + 1) * width].to_vec()).collect();
            InstrumentalEstimate { coefficients: coefficients.to_vec(), initial, exponents, covariance }
        })
        .collect();
    Ok(InstrumentalFit {
        estimates,
        iterations: refinement.iterations,
        converged: refinement.converged,
        damped: refinement.damped,
    })
}

struct CoupledProblem<'a> {
    records: &'a [Record],
    clean: &'a [Record],
    structures: &'a [Structure],
    fixed: &'a [Vec<Option<f64>>],
    exponents: &'a [Vec<f64>],
    /// The excluded initial terms, per equation.
    excluded_terms: Vec<ExcludedTerms>,
    /// Spectra that do not change between iterations, indexed by equation and record.
    spectra: Vec<Vec<EquationSpectra<'a>>>,
    /// Spectra of terms with noise-free signals, indexed by equation, record and term; None if the measured signal is
    /// used.
    substitutes: Vec<Vec<Vec<Option<Kernel>>>>,
}

/// Result of the separate refinement of every equation from one initial guess.
struct RefinementResult {
    error: f64,
    solutions: Vec<Solution>,
    covariances: Vec<Vec<f64>>,
    iterations: usize,
    converged: bool,
    damped: bool,
}

impl<'a> CoupledProblem<'a> {
    fn new(
        records: &'a [Record],
        clean: &'a [Record],
        structures: &'a [Structure],
        (fixed, initial): (&'a [Vec<Option<f64>>], &Initial),
        exponents: &'a [Vec<f64>],
    ) -> Result<Self> {
        let excluded_terms = |(structure, fixed): (&Structure, &Vec<Option<f64>>)| {
            Ok(least_squares::fit(records, structure, fixed, initial)?.excluded_terms)
        };
        let excluded_terms =
            structures.iter().zip(fixed).map(excluded_terms).collect::<Result<Vec<ExcludedTerms>>>()?;
        let equation_spectra = |(structure, exponents): (&Structure, &Vec<f64>)| -> Vec<EquationSpectra<'a>> {
            records.iter().map(|record| EquationSpectra::new(record, structure, exponents)).collect()
        };
        let spectra: Vec<Vec<EquationSpectra<'a>>> = structures.iter().zip(exponents).map(equation_spectra).collect();
        let substitutes_of_equation = |spectra: &Vec<EquationSpectra<'a>>| -> Vec<Vec<Option<Kernel>>> {
            spectra.iter().zip(clean).map(|(spectra, clean)| spectra.substitute_spectra(clean, |_| true)).collect()
        };
        let substitutes = spectra.iter().map(substitutes_of_equation).collect();
        Ok(Self { records, clean, structures, fixed, exponents, excluded_terms, spectra, substitutes })
    }

    /// Return the two-stage least-squares estimate of every equation: one step with noise-free signals as instruments.
    ///
    /// The signals pass the state-variable filter s^α/(s + λ)^⌈α⌉. α is the order of the equation, and λ is `ratio`
    /// times the bandwidth of its output.
    fn start(&self, ratio: f64) -> Result<Vec<Solution>> {
        let mut scratch = Scratch::default();
        let mut solutions = Vec::with_capacity(self.structures.len());
        for (i, (structure, fixed)) in self.structures.iter().zip(self.fixed).enumerate() {
            let pairs = self.spectra[i].iter().zip(&self.substitutes[i]);
            let sources: Vec<InstrumentSource<'_>> =
                pairs.map(|(spectra, clean)| spectra.source(|k| clean[k].as_ref())).collect();
            let filter = |r: &Record| {
                state_variable_filter(ratio * power_frequency(r.signal(structure.output), r.step()), structure.order, r)
            };
            let filters = self.records.iter().map(|r| Ok(Kernel::new(&filter(r)?))).collect::<Result<Vec<Kernel>>>()?;
            let outputs: Vec<Vec<f64>> = self.clean.iter().map(|r| r.signal(structure.output).to_vec()).collect();
            solutions.push(step(&sources, &filters, &outputs, fixed, &self.excluded_terms[i], false, &mut scratch)?.0);
        }
        Ok(solutions)
    }

    fn iterate(&self, mut solutions: Vec<Solution>, settings: InstrumentalSettings) -> Result<RefinementResult> {
        let mut scratch = Scratch::default();
        let mut best = (f64::INFINITY, solutions.clone());
        let (mut iterations, mut converged, mut halvings) = (0, false, 0);
        loop {
            let (responses, damped) = simulate_coupled(self.clean, self.structures, self.exponents, &solutions)?;
            let error = output_error(self.records, self.structures, &responses);
            if error < best.0 {
                best = (error, solutions.clone());
                halvings = 0;
            }
            let last = converged || iterations == settings.iterations;
            if !last && halvings < MAX_STEP_HALVINGS && (error.is_nan() || error > MAX_ERROR_RATIO * best.0) {
                // The step is too long: move half-way back to the best iterate.
                for (x, y) in solutions.iter_mut().flatten().zip(best.1.iter().flatten()) {
                    *x = 0.5 * (*x + y);
                }
                halvings += 1;
                iterations += 1;
                continue;
            }
            if last && !converged && solutions != best.1 {
                // One more step computes the covariance at the returned solution.
                solutions.clone_from(&best.1);
                continue;
            }
            let (next, covariances) = self.step(&solutions, &responses, last, &mut scratch)?;
            if last {
                return Ok(RefinementResult { error, solutions, covariances, iterations, converged, damped });
            }
            iterations += 1;
            converged = self.has_converged_to(&solutions, &next, settings.tolerance);
            solutions = next;
        }
    }

    /// Return true if the term coefficients of two solutions agree within a relative tolerance.
    fn has_converged_to(&self, before: &[Solution], after: &[Solution], tolerance: f64) -> bool {
        let mut pairs = before.iter().zip(after).zip(self.structures);
        pairs.all(|((a, b), s)| has_converged(a, b, s.terms.len(), tolerance))
    }

    /// Refine all equations together, starting from the coefficients `start`.
    ///
    /// Return None if the simulation or its inverse is unstable, or if the instruments do not identify the
    /// coefficients.
    fn refine_together(
        &self,
        start: &[Solution],
        settings: InstrumentalSettings,
    ) -> Result<Option<coupled::CoupledEstimate>> {
        let problem = coupled::CoupledProblem {
            records: self.records,
            clean: self.clean,
            structures: self.structures,
            fixed: self.fixed,
            exponents: self.exponents,
            excluded_terms: &self.excluded_terms,
        };
        match problem.refine(start, settings) {
            Err(Error::Singular { .. }) => Ok(None),
            other => other,
        }
    }

    /// Compute one step of every equation, with instruments from one coupled simulation.
    ///
    /// Return the solutions and the covariance matrices, one each per equation.
    fn step(
        &self,
        solutions: &[Solution],
        responses: &[Vec<Vec<f64>>],
        with_covariance: bool,
        scratch: &mut Scratch,
    ) -> Result<(Vec<Solution>, Vec<Vec<f64>>)> {
        let simulated = self
            .clean
            .iter()
            .zip(responses)
            .map(|(record, outputs)| {
                let signals = (0..record.len()).map(|s| match self.structures.iter().position(|e| e.output == s) {
                    Some(i) => outputs[i].clone(),
                    None => record.signal(s).to_vec(),
                });
                Record::from_rows(record.step(), signals.collect(), None)
            })
            .collect::<Result<Vec<_>>>()?;
        let mut out = (Vec::new(), Vec::new());
        for (i, fixed) in self.fixed.iter().enumerate() {
            let is_simulated = |signal: usize| self.structures.iter().any(|e| e.output == signal);
            let pairs = self.spectra[i].iter().zip(&simulated);
            let kernels: Vec<Vec<Option<Kernel>>> =
                pairs.map(|(spectra, record)| spectra.substitute_spectra(record, is_simulated)).collect();
            let terms = &self.structures[i].terms;
            let sources: Vec<InstrumentSource<'_>> = (0..kernels.len())
                .map(|r| {
                    let substitute = |k: usize| {
                        if is_simulated(terms[k].signal) {
                            &kernels[r][k]
                        } else {
                            &self.substitutes[i][r][k]
                        }
                    };
                    self.spectra[i][r].source(|k| substitute(k).as_ref())
                })
                .collect();
            let filters = sources
                .iter()
                .map(|s| Ok(Kernel::new(&damped_inverse(&divisor(s, &solutions[i]))?.0)))
                .collect::<Result<Vec<_>>>()?;
            let simulated_outputs: Vec<Vec<f64>> = responses.iter().map(|outputs| outputs[i].clone()).collect();
            let (solution, covariance) =
                step(&sources, &filters, &simulated_outputs, fixed, &self.excluded_terms[i], with_covariance, scratch)?;
            out.0.push(solution);
            out.1.push(covariance);
        }
        Ok(out)
    }
}

/// Relative output error Σ ‖y − ŷ‖²/‖y‖² over records and equations, with measured output y and simulated output ŷ.
fn output_error(records: &[Record], structures: &[Structure], responses: &[Vec<Vec<f64>>]) -> f64 {
    let mut total = 0.0;
    for (record, outputs) in records.iter().zip(responses) {
        for (structure, response) in structures.iter().zip(outputs) {
            let y = record.signal(structure.output);
            let residual_square_sum: f64 = y.iter().zip(response).map(|(y, v)| (y - v) * (y - v)).sum();
            total += residual_square_sum / dot(y, y).max(f64::MIN_POSITIVE);
        }
    }
    total
}

/// Simulate all equations together on every record, with damping if they are unstable.
///
/// Return the outputs, indexed by record and equation, and true if the simulation of any record was damped.
fn simulate_coupled(
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
        // Growth with the input is no instability. A response above ten times the measured amplitude counts as
        // unstable.
        let is_bounded = |outputs: &[Vec<f64>]| {
            outputs.iter().zip(structures).all(|(response, s)| {
                let measured = record.signal(s.output).iter().fold(0.0_f64, |a, v| a.max(v.abs()));
                response.iter().all(|v| v.abs() <= 10.0 * measured.max(f64::MIN_POSITIVE))
            })
        };
        let (outputs, is_damped) = System::new(&equations, record)?.respond_stabilized(&initial, is_bounded)?;
        damped |= is_damped;
        out.push(outputs);
    }
    Ok((out, damped))
}
