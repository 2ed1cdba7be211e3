//! Joint refinement of coupled equations by instrumental variables (Jakeman and Young, Refined instrumental
//! variable methods of recursive time-series analysis, part II, Int. J. Control 29, 1979, 621-644).
//!
//! An equation filtered by its own 1/D̂ still contains the noise of the other measured outputs. Filtering by the
//! inverse of the matrix Â of all equations turns the equation errors into the output noise, which is white and
//! independent. The residuals are weighted by its variances. The same filter on simulated outputs makes each instrument
//! the sensitivity of the simulation to that coefficient. A fixed point of the iteration is therefore a stationary
//! point of the weighted output error.

use super::prefilter::is_unstable;
use super::solution::{
    add_long_run_covariance, dot, equations, has_converged, initial_terms, orthonormalize_instruments, Dropped,
    InstrumentalSettings, RecordInstruments, Solution,
};
use crate::equation::Structure;
use crate::error::Result;
use crate::linalg::small::EquilibratedLu;
use crate::regressors::Record;
use crate::series::{Buffers, Kernel};
use crate::series_system::System;

/// Maximum number of halvings of a step that increases the cost.
const MAX_STEP_HALVINGS: usize = 8;

/// Increase of the cost (−2 log-likelihood) up to which a step is accepted. The likelihood ratio then differs from 1 by
/// a millionth.
const COST_TOLERANCE: f64 = 1e-6;

/// Equations to refine: structures, fixed coefficients, exponents and exclusions of their initial terms.
pub struct CoupledProblem<'a> {
    /// Records as measured.
    pub records: &'a [Record],
    /// Records with noise-free substitutes for measured outputs without an equation.
    pub clean: &'a [Record],
    /// The equations.
    pub structures: &'a [Structure],
    /// Values of the fixed coefficients, per equation; None if free.
    pub fixed: &'a [Vec<Option<f64>>],
    /// Exponents of initial terms, per equation.
    pub exponents: &'a [Vec<f64>],
    /// (record, position) of excluded initial terms, per equation.
    pub dropped: &'a [Dropped],
}

/// Joint estimate of all equations.
#[derive(Debug, Clone, PartialEq)]
pub struct CoupledEstimate {
    /// Per equation: coefficients of its terms, then of its initial terms record by record.
    pub solutions: Vec<Solution>,
    /// Per equation: covariance of its free coefficients, row-major, robust to colored residuals.
    pub covariances: Vec<Vec<f64>>,
    /// Σ n ln(Σ ε²/n) over outputs: −2 log-likelihood with unknown noise variances.
    pub cost: f64,
    /// Number of iterations.
    pub iterations: usize,
    /// True if the last step changed no coefficient by more than the tolerance.
    pub converged: bool,
}

/// Free coefficient: (equation, term), or (equation, record, position) of an initial term.
#[derive(Debug, Clone, Copy, PartialEq)]
enum FreeCoefficient {
    Term(usize, usize),
    Initial(usize, usize, usize),
}

/// Coefficients of all equations, and their covariances if requested.
type StepResult = (Vec<Solution>, Vec<Vec<f64>>);

/// Simulation of every record with one set of coefficients, and its cost.
struct Iterate {
    /// Outputs of the simulation, by record and equation.
    responses: Vec<Vec<Vec<f64>>>,
    /// Weight 1/σ² of each output.
    weights: Vec<f64>,
    cost: f64,
}

impl CoupledProblem<'_> {
    /// Iterate from an initial guess until convergence; the cost never increases except by rounding.
    ///
    /// None if the simulation from the initial guess diverges, so that its inverse cannot be used as a filter.
    /// O(iterations · n · Σ (terms · m log m + n² m log² m)) for n equations.
    ///
    /// # Errors
    /// [`crate::error::Error::Singular`] if the instruments do not identify the coefficients of all equations together.
    pub fn refine(&self, start: &[Solution], settings: InstrumentalSettings) -> Result<Option<CoupledEstimate>> {
        let unknowns = self.free_coefficients();
        let mut solutions = start.to_vec();
        let Some(mut point) = self.evaluate(&solutions)? else { return Ok(None) };
        let (mut iterations, mut converged) = (0, false);
        while !converged && iterations < settings.iterations {
            let Some((next, _)) = self.step(&solutions, &point, &unknowns, false)? else { return Ok(None) };
            iterations += 1;
            converged = solutions
                .iter()
                .zip(&next)
                .zip(self.structures)
                .all(|((a, b), s)| has_converged(a, b, s.terms.len(), settings.tolerance));
            let mut share = 1.0;
            let mut is_accepted = false;
            for _ in 0..MAX_STEP_HALVINGS {
                let candidates: Vec<Solution> = solutions
                    .iter()
                    .zip(&next)
                    .map(|(a, b)| a.iter().zip(b).map(|(a, b)| a + share * (b - a)).collect())
                    .collect();
                match self.evaluate(&candidates)? {
                    Some(candidate) if candidate.cost <= point.cost + COST_TOLERANCE => {
                        (solutions, point, is_accepted) = (candidates, candidate, true);
                        break;
                    }
                    _ => share *= 0.5,
                }
            }
            if !is_accepted {
                // No shorter step lowers the cost.
                break;
            }
        }
        let Some((_, covariances)) = self.step(&solutions, &point, &unknowns, true)? else { return Ok(None) };
        Ok(Some(CoupledEstimate { solutions, covariances, cost: point.cost, iterations, converged }))
    }

    fn free_coefficients(&self) -> Vec<FreeCoefficient> {
        let mut out = Vec::new();
        for (i, fixed) in self.fixed.iter().enumerate() {
            out.extend((0..fixed.len()).filter(|&k| fixed[k].is_none()).map(|k| FreeCoefficient::Term(i, k)));
            for r in 0..self.records.len() {
                let indices = (0..self.exponents[i].len()).filter(|&e| !self.dropped[i].contains(&(r, e)));
                out.extend(indices.map(|e| FreeCoefficient::Initial(i, r, e)));
            }
        }
        out
    }

    /// Simulate all records and compute the cost; None if an output exceeds ten times the measured amplitude.
    #[allow(clippy::cast_precision_loss)]
    fn evaluate(&self, solutions: &[Solution]) -> Result<Option<Iterate>> {
        let equations = equations(self.structures, solutions);
        let mut responses = Vec::with_capacity(self.records.len());
        let mut sums = vec![0.0; equations.len()];
        let mut count = 0;
        for (r, record) in self.clean.iter().enumerate() {
            let initial = initial_terms(r, self.structures, self.exponents, solutions);
            let outputs = System::new(&equations, record)?.respond(&initial)?;
            for ((response, equation), sum) in outputs.iter().zip(&equations).zip(&mut sums) {
                let measured = self.records[r].signal(equation.structure.output);
                let size = measured.iter().fold(f64::MIN_POSITIVE, |a, v| a.max(v.abs()));
                if response.iter().any(|v| !v.is_finite() || v.abs() > 10.0 * size) {
                    return Ok(None);
                }
                *sum += measured.iter().zip(response).map(|(y, v)| (y - v) * (y - v)).sum::<f64>();
            }
            count += record.m();
            responses.push(outputs);
        }
        let n = count as f64;
        // With noise-free data the residuals are rounding errors, which are weighted like noise.
        let variances: Vec<f64> = sums.iter().map(|s| (s / n).max(f64::MIN_POSITIVE)).collect();
        let cost = variances.iter().map(|v| n * libm::log(*v)).sum();
        Ok(Some(Iterate { responses, weights: variances.iter().map(|v| 1.0 / v).collect(), cost }))
    }

    /// New coefficients of all equations, with covariances if requested; None if the inverse of the system matrix is
    /// unstable.
    fn step(
        &self,
        solutions: &[Solution],
        point: &Iterate,
        unknowns: &[FreeCoefficient],
        with_covariance: bool,
    ) -> Result<Option<StepResult>> {
        let (n, k) = (self.structures.len(), unknowns.len());
        let equations = equations(self.structures, solutions);
        let mut parts = Vec::with_capacity(self.records.len());
        let mut instruments = Vec::with_capacity(self.records.len());
        for (r, record) in self.records.iter().enumerate() {
            let m = record.m();
            let inverse = System::new(&equations, record)?.inverse()?;
            if inverse.iter().flatten().any(|series| is_unstable(series)) {
                return Ok(None);
            }
            let filters: Vec<Vec<Kernel>> =
                inverse.iter().map(|row| row.iter().map(|series| Kernel::new(series)).collect()).collect();
            let simulated = (0..record.len()).map(|s| match self.structures.iter().position(|e| e.output == s) {
                Some(i) => point.responses[r][i].clone(),
                None => self.clean[r].signal(s).to_vec(),
            });
            let simulated = Record::from_rows(record.step(), simulated.collect(), None)?;
            let mut buffers = Buffers::default();
            // Response of every output in sequence, in units of the noise standard deviation of the output.
            let mut through = |i: usize, signal: &[f64]| -> Vec<f64> {
                let spectrum = Kernel::new(signal);
                let mut out = vec![0.0; n * m];
                for (j, part) in out.chunks_exact_mut(m).enumerate() {
                    filters[j][i].times(&spectrum, part, &mut buffers);
                    let scale = point.weights[j].sqrt();
                    part.iter_mut().for_each(|v| *v *= scale);
                }
                out
            };
            let mut target = vec![0.0; n * m];
            let (mut phi, mut psi, mut places) = (Vec::new(), Vec::new(), Vec::new());
            for (i, structure) in self.structures.iter().enumerate() {
                let whole = through(i, record.signal(structure.output));
                target.iter_mut().zip(whole).for_each(|(t, v)| *t += v);
                for (term, value) in self.fixed[i].iter().enumerate() {
                    let (signal, eta) = (structure.terms[term].signal, structure.integration(term));
                    let column = through(i, &record.integral(signal, eta));
                    match value {
                        Some(c) => target.iter_mut().zip(&column).for_each(|(t, v)| *t -= c * v),
                        None => {
                            psi.push(through(i, &simulated.integral(signal, eta)));
                            phi.push(column);
                        }
                    }
                }
                for (e, &exponent) in self.exponents[i].iter().enumerate() {
                    if unknowns.contains(&FreeCoefficient::Initial(i, r, e)) {
                        let column = through(i, &record.initial_term(exponent));
                        psi.push(column.clone());
                        phi.push(column);
                    }
                }
                places.extend((0..k).filter(|&a| match unknowns[a] {
                    FreeCoefficient::Term(equation, _) => equation == i,
                    FreeCoefficient::Initial(equation, run, _) => equation == i && run == r,
                }));
            }
            parts.push((phi, target));
            instruments.push(RecordInstruments { columns: psi, unknown_indices: places });
        }
        orthonormalize_instruments(&mut instruments, k)?;
        let (mut cross, mut rhs) = (vec![0.0; k * k], vec![0.0; k]);
        for ((phi, target), RecordInstruments { columns, unknown_indices: places }) in parts.iter().zip(&instruments) {
            for (instrument, &a) in columns.iter().zip(places) {
                rhs[a] += dot(instrument, target);
                for (regressor, &b) in phi.iter().zip(places) {
                    cross[a * k + b] += dot(instrument, regressor);
                }
            }
        }
        let solved = EquilibratedLu::new(&cross, k)?;
        let x = solved.solve(&rhs);
        let mut next: Vec<Solution> = solutions.to_vec();
        for (&unknown, &value) in unknowns.iter().zip(&x) {
            match unknown {
                FreeCoefficient::Term(i, term) => next[i][term] = value,
                FreeCoefficient::Initial(i, r, e) => {
                    next[i][self.structures[i].terms.len() + r * self.exponents[i].len() + e] = value;
                }
            }
        }
        let mut covariances = Vec::new();
        if with_covariance {
            let (mut meat, inverse) = (vec![0.0; k * k], solved.inverse());
            for (((phi, target), run_instruments), record) in parts.iter().zip(&instruments).zip(self.records) {
                let RecordInstruments { columns: psi, unknown_indices: places } = run_instruments;
                let mut rest = target.clone();
                for (column, &place) in phi.iter().zip(places) {
                    rest.iter_mut().zip(column).for_each(|(e, v)| *e -= x[place] * v);
                }
                let m = record.m();
                let scores: Vec<Vec<f64>> = psi
                    .iter()
                    .map(|p| (0..m).map(|t| (0..n).map(|j| p[j * m + t] * rest[j * m + t]).sum()).collect())
                    .collect();
                add_long_run_covariance(&scores, places, &mut meat, k);
            }
            let half = |i: usize, j: usize| -> f64 { (0..k).map(|b| meat[i * k + b] * inverse[j * k + b]).sum() };
            for i in 0..n {
                let own: Vec<usize> = (0..k)
                    .filter(|&a| matches!(unknowns[a], FreeCoefficient::Term(equation, _) if equation == i))
                    .collect();
                let block = own.iter().flat_map(|&a| own.iter().map(move |&b| (a, b)));
                covariances.push(block.map(|(a, b)| (0..k).map(|c| inverse[a * k + c] * half(c, b)).sum()).collect());
            }
        }
        Ok(Some((next, covariances)))
    }
}
