//! Equations on a record as a system of series A y = b: forced response, inverse, and copies with exponential damping.

use crate::equation::Equation;
use crate::error::{check_length, Error, Result};
use crate::fractional::kernels::kernel;
use crate::regressors::{is_impulse, Record};
use crate::series::{self, Buffers, Kernel, SumOfProducts};

/// System of series A y = b for equations on one record. The outputs y of the equations are unknown, and all other
/// signals are taken from the record. A is a matrix of series, b contains the terms on known signals.
///
/// The size of coefficients is not checked, because iterates of an estimator may have any size.
pub(crate) struct System<'a> {
    record: &'a Record,
    /// True for each output whose sensor filter may have an initial transient.
    filter_transients: Vec<bool>,
    /// Matrix A of series, by equation, then by output.
    pub(crate) matrix: Vec<Vec<Vec<f64>>>,
    /// Right-hand side b for zero initial conditions, by equation.
    pub(crate) rhs: Vec<Vec<f64>>,
}

impl<'a> System<'a> {
    /// Build the system of equations with distinct outputs.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for invalid orders, [`Error::Structure`] for invalid signals or two equations with the
    /// same output. [`Error::Length`] for a wrong number of coefficients.
    pub(crate) fn new(equations: &[Equation], record: &'a Record) -> Result<Self> {
        let m = record.m();
        let n = equations.len();
        let outputs: Vec<usize> = equations.iter().map(|e| e.structure.output).collect();
        for (i, output) in outputs.iter().enumerate() {
            if outputs[..i].contains(output) {
                return Err(Error::Structure {
                    what: format!("two equations have signal {output} as their output"),
                    remedy: "give each output one equation".into(),
                });
            }
        }
        let mut matrix = vec![vec![vec![0.0; m]; n]; n];
        let mut rhs = vec![vec![0.0; m]; n];
        // Terms often share an order, so each kernel is computed once.
        let mut kernels: Vec<(f64, Vec<f64>)> = Vec::new();
        let step = record.step();
        for (i, equation) in equations.iter().enumerate() {
            let structure = &equation.structure;
            structure.check(record.len(), |_| true)?;
            check_length("coefficients", structure.terms.len(), equation.coefficients.len())?;
            matrix[i][i][0] += 1.0;
            for (k, (term, &c)) in structure.terms.iter().zip(&equation.coefficients).enumerate() {
                let eta = structure.integration(k);
                let unknown = outputs.iter().position(|&o| o == term.signal);
                if unknown.is_none() {
                    let signal = record.term_signal(term.signal, eta);
                    // A zero signal contributes nothing.
                    if signal.iter().all(|v| *v == 0.0) {
                        continue;
                    }
                    if eta == 0.0 {
                        rhs[i].iter_mut().zip(signal).for_each(|(b, v)| *b += c * v);
                        continue;
                    }
                }
                let index = kernels.iter().position(|(order, _)| order.to_bits() == eta.to_bits());
                let index = index.unwrap_or_else(|| {
                    kernels.push((eta, kernel(eta, m, step)));
                    kernels.len() - 1
                });
                let kernel = &kernels[index].1;
                match unknown {
                    Some(j) => matrix[i][j].iter_mut().zip(kernel).for_each(|(a, v)| *a -= c * v),
                    None => {
                        // Zeros at the end of a signal are omitted. An impulse, for example, then needs no transform.
                        let signal = record.term_signal(term.signal, eta);
                        let last = signal.iter().rposition(|v| *v != 0.0).map_or(0, |k| k + 1);
                        let integral = series::multiply(
                            kernel,
                            if last <= MAX_DIRECT_PULSES { &signal[..last] } else { signal },
                            m,
                        );
                        rhs[i].iter_mut().zip(integral).for_each(|(b, v)| *b += c * v);
                    }
                }
            }
        }
        let filter_transients = outputs.iter().map(|&o| record.has_filter_transient(o)).collect();
        Ok(Self { record, filter_transients, matrix, rhs })
    }

    /// Return the system with its matrix at ρz instead of the one-step delay z, with ρ = e^{−decay}. A large enough
    /// decay \[1/sampling interval\] makes every model stable.
    pub(crate) fn with_damping(mut self, decay: f64) -> Self {
        if decay > 0.0 {
            self.matrix.iter_mut().flatten().for_each(|series| *series = damp_series(decay, series));
        }
        self
    }

    /// Return the outputs, by equation, for the inputs of the record and these initial terms. `initial` lists the
    /// (exponent, coefficient) pairs of each equation, empty for zero initial conditions.
    pub(crate) fn respond(&self, initial: &[Vec<(f64, f64)>]) -> Result<Vec<Vec<f64>>> {
        let (rhs, output_impulses) = self.forced_right_side(initial);
        let mut outputs = self.solve(&rhs)?;
        self.add_output_impulses(&mut outputs, &output_impulses);
        Ok(outputs)
    }

    /// Return the right-hand side with these initial terms, as one series per equation. Also return those initial terms
    /// that are impulses and are added to the outputs instead. Initial terms are (exponent, coefficient) pairs by
    /// equation.
    #[allow(clippy::type_complexity)]
    fn forced_right_side(&self, initial: &[Vec<(f64, f64)>]) -> (Vec<Vec<f64>>, Vec<Vec<(f64, f64)>>) {
        let (output_impulses, input_terms): (Vec<_>, Vec<_>) = (initial.iter().enumerate())
            .map(|(i, terms)| terms.iter().copied().partition(|&(exponent, _)| self.is_output_impulse(i, exponent)))
            .unzip();
        let mut rhs = self.rhs.clone();
        for (b, terms) in rhs.iter_mut().zip(&input_terms) {
            for &(exponent, coefficient) in terms {
                b.iter_mut().zip(self.record.forcing_term(exponent)).for_each(|(b, v)| *b += coefficient * v);
            }
        }
        (rhs, output_impulses)
    }

    /// Return the outputs if `is_bounded` accepts them. Otherwise return the outputs of the first damped copy of the
    /// system whose outputs `is_bounded` accepts. The flag is true for a damped copy.
    ///
    /// The damped copies have decays of 4, 8, 16, … per record ([`crate::simulate::respond_damped`]). The last copy is
    /// returned if `is_bounded` accepts none. A decay replaces the one-step delay z by ρz with ρ = e^{−decay}. If the
    /// inverse of the matrix is finite, the inverse of a copy is the same series at ρz, so that no further division is
    /// needed.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn respond_stabilized(
        &self,
        initial: &[Vec<(f64, f64)>],
        is_bounded: impl Fn(&[Vec<f64>]) -> bool,
    ) -> Result<(Vec<Vec<f64>>, bool)> {
        let (rhs, output_impulses) = self.forced_right_side(initial);
        let add_impulses = |mut outputs: Vec<Vec<f64>>| {
            self.add_output_impulses(&mut outputs, &output_impulses);
            outputs
        };
        let outputs = add_impulses(self.solve(&rhs)?);
        if is_bounded(&outputs) {
            return Ok((outputs, false));
        }
        let m = self.record.m();
        let inverse = self.inverse()?;
        let is_finite = inverse.iter().flatten().flatten().all(|v| v.is_finite());
        let spectra: Vec<Kernel> = rhs.iter().map(|b| Kernel::new(b)).collect();
        let (mut sum, mut buffers) = (SumOfProducts::new(m), Buffers::default());
        let mut gamma = 4.0;
        loop {
            let decay = gamma / m as f64;
            let outputs = if is_finite {
                let mut response = |row: &Vec<Vec<f64>>| {
                    for (series, input) in row.iter().zip(&spectra) {
                        sum.add(1.0, &Kernel::new(&damp_series(decay, series)), input);
                    }
                    let mut out = vec![0.0; m];
                    sum.take(&mut out, &mut buffers);
                    out
                };
                add_impulses(inverse.iter().map(&mut response).collect())
            } else {
                let matrix =
                    self.matrix.iter().map(|row| row.iter().map(|series| damp_series(decay, series)).collect());
                let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
                add_impulses(series::solve(&matrix.collect::<Vec<Vec<Vec<f64>>>>(), &borrowed)?)
            };
            if is_bounded(&outputs) || gamma > 64.0 * m as f64 {
                return Ok((outputs, true));
            }
            gamma *= 2.0;
        }
    }

    /// Return true if an initial term is an impulse that acts on the sensor of the output only.
    ///
    /// If the output and its inputs all pass the record's filter, the impulse acts on the equation instead.
    fn is_output_impulse(&self, equation: usize, exponent: f64) -> bool {
        is_impulse(exponent) && (!self.record.is_filtered() || self.filter_transients[equation])
    }

    /// Add impulses, given as (exponent, coefficient) pairs by equation, to the outputs.
    fn add_output_impulses(&self, outputs: &mut [Vec<f64>], impulses: &[Vec<(f64, f64)>]) {
        for (output, terms) in outputs.iter_mut().zip(impulses) {
            for &(exponent, value) in terms.iter().filter(|(_, value)| *value != 0.0) {
                output.iter_mut().zip(self.record.initial_term(exponent)).for_each(|(s, v)| *s += value * v);
            }
        }
    }

    /// Return the series of the inverse of the matrix ([`crate::series::Solver::inverse`]).
    pub(crate) fn inverse(&self) -> Result<Vec<Vec<Vec<f64>>>> {
        series::Solver::new(&self.matrix)?.inverse()
    }

    /// Return the responses of all outputs to each initial term (equation, exponent) with coefficient 1. All other
    /// inputs are zero. Indexed by initial term, then by output.
    pub(crate) fn unit_responses(&self, units: &[(usize, f64)]) -> Result<Vec<Vec<Vec<f64>>>> {
        let mut solver = series::Solver::new(&self.matrix)?;
        match self.invert_for_units(&mut solver, units)? {
            Some(mut inverse_kernels) => Ok(units.iter().map(|&unit| inverse_kernels.unit_response(unit)).collect()),
            None => self.solve_each(&mut solver, units),
        }
    }

    /// Return the outputs with zero initial conditions, and [`System::unit_responses`].
    #[allow(clippy::type_complexity)]
    pub(crate) fn zero_initial_and_unit_responses(
        &self,
        units: &[(usize, f64)],
    ) -> Result<(Vec<Vec<f64>>, Vec<Vec<Vec<f64>>>)> {
        let mut solver = series::Solver::new(&self.matrix)?;
        match self.invert_for_units(&mut solver, units)? {
            Some(mut inverse_kernels) => Ok((
                inverse_kernels.zero_initial_response(),
                units.iter().map(|&unit| inverse_kernels.unit_response(unit)).collect(),
            )),
            None => Ok((solver.solve(&self.rhs)?, self.solve_each(&mut solver, units)?)),
        }
    }

    /// Return the spectra of the inverse of the matrix. The responses to the initial terms `units` are products with
    /// these spectra.
    ///
    /// `None` if `units` is empty. Also `None` if the inverse grows so much over the record that products would lose
    /// digits of its first terms.
    fn invert_for_units(
        &self,
        solver: &mut series::Solver<'_>,
        units: &[(usize, f64)],
    ) -> Result<Option<InverseKernels<'_, 'a>>> {
        if units.is_empty() {
            return Ok(None);
        }
        let inverse = solver.inverse()?;
        if inverse.iter().flatten().any(|series| exceeds_growth_limit(series)) {
            return Ok(None);
        }
        let kernels = inverse.iter().map(|row| row.iter().map(|s| Kernel::new(s)).collect()).collect();
        let filtered_kernels = (0..inverse.len()).map(|_| None).collect();
        // Without a filter only the spectra are needed.
        let inverse = if self.record.is_filtered() { inverse } else { Vec::new() };
        Ok(Some(InverseKernels { system: self, inverse, kernels, filtered_kernels, buffers: Buffers::default() }))
    }

    /// Return the responses of all outputs to each initial term (equation, exponent) by one solution per term.
    fn solve_each(&self, solver: &mut series::Solver<'_>, units: &[(usize, f64)]) -> Result<Vec<Vec<Vec<f64>>>> {
        units
            .iter()
            .map(|&(i, exponent)| {
                let term = self.initial_term_right_side(i, exponent);
                if self.is_output_impulse(i, exponent) {
                    Ok(term)
                } else {
                    solver.solve(&term)
                }
            })
            .collect()
    }

    /// Return the right-hand sides of all equations for one initial term with coefficient 1 in equation `i`.
    fn initial_term_right_side(&self, i: usize, exponent: f64) -> Vec<Vec<f64>> {
        let mut rows = vec![vec![0.0; self.record.m()]; self.matrix.len()];
        rows[i] = self.record.forcing_term(exponent);
        rows
    }

    /// Return the outputs for these right-hand sides, by equation.
    pub(crate) fn solve(&self, rhs: &[Vec<f64>]) -> Result<Vec<Vec<f64>>> {
        let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
        series::solve(&self.matrix, &borrowed)
    }
}

/// Inverse of the matrix of a series system, with and without the sensor filter of the record. The outputs for one
/// right-hand side take one product per output.
struct InverseKernels<'s, 'a> {
    system: &'s System<'a>,
    /// Series of the inverse matrix, by output, then by equation. Empty if the record has no filter.
    inverse: Vec<Vec<Vec<f64>>>,
    /// Spectra of the inverse matrix, by output, then by equation.
    kernels: Vec<Vec<Kernel>>,
    /// Spectra of the filtered inverse matrix, by equation, then by output. Computed when first needed.
    filtered_kernels: Vec<Option<Vec<Kernel>>>,
    buffers: Buffers,
}

impl InverseKernels<'_, '_> {
    /// Return the outputs for the inputs of the record with zero initial conditions.
    fn zero_initial_response(&mut self) -> Vec<Vec<f64>> {
        let (rhs, m) = (&self.system.rhs, self.system.record.m());
        let mut outputs = vec![vec![0.0; m]; self.kernels.len()];
        let mut product = vec![0.0; m];
        for (output, row) in outputs.iter_mut().zip(&self.kernels) {
            for (kernel, input) in row.iter().zip(rhs) {
                kernel.apply(input, &mut product, &mut self.buffers);
                output.iter_mut().zip(&product).for_each(|(y, v)| *y += v);
            }
        }
        outputs
    }

    /// Return the responses of all outputs to an initial term with coefficient 1 in equation `i`.
    fn unit_response(&mut self, (i, exponent): (usize, f64)) -> Vec<Vec<f64>> {
        let (system, m) = (self.system, self.system.record.m());
        if system.is_output_impulse(i, exponent) {
            return system.initial_term_right_side(i, exponent);
        }
        let buffers = &mut self.buffers;
        let mut response = |kernel: &Kernel, term: &[f64]| {
            let mut out = vec![0.0; m];
            kernel.apply(term, &mut out, buffers);
            out
        };
        let Some(term) = system.record.unfiltered_term(exponent) else {
            let term = system.record.forcing_term(exponent);
            return self.kernels.iter().map(|row| response(&row[i], &term)).collect();
        };
        let inverse = &self.inverse;
        let filtered_kernels = self.filtered_kernels[i].get_or_insert_with(|| {
            inverse.iter().map(|row| Kernel::new(&system.record.apply_filter(row[i].clone()))).collect()
        });
        filtered_kernels.iter().map(|kernel| response(kernel, &term)).collect()
    }
}

/// Return a power series at ρz instead of z with ρ = e^{−decay}. Its terms are multiplied by ρ^k, k = 0, 1, ….
#[allow(clippy::cast_precision_loss)]
fn damp_series(decay: f64, series: &[f64]) -> Vec<f64> {
    series.iter().enumerate().map(|(k, a)| a * libm::exp(-decay * k as f64)).collect()
}

/// Maximum number of samples, up to the last nonzero one, of a signal whose products are summed directly. Products of
/// longer signals use Fourier transforms.
const MAX_DIRECT_PULSES: usize = 64;

/// Return true if the second half of a series is so large that a transform loses digits of the first half.
fn exceeds_growth_limit(series: &[f64]) -> bool {
    let largest = |part: &[f64]| part.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    let (first, second) = series.split_at(series.len() / 2);
    let (first, second) = (largest(first), largest(second));
    !(second <= MAX_SERIES_GROWTH * first && first.is_finite())
}

/// Maximum ratio of the largest moduli in the second and the first half of a series. The rounding error of a transform
/// is 1e−12 of the largest value. At this ratio it affects half of the digits.
const MAX_SERIES_GROWTH: f64 = 1e3;
