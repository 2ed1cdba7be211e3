//! Equations on a record as a series system A y = b: their free runs, damped where they grow, and the inverse of A.

use crate::equation::Equation;
use crate::error::{check_length, Error, Result};
use crate::fractional::kernels::kernel;
use crate::regressors::{is_impulse, Record};
use crate::series::{self, Buffers, Kernel, SumOfProducts};

/// The series system A y = b of some equations: their outputs are unknown, every other signal is read from the record.
///
/// Coefficients may be of any size here, as the steps of an estimator make them; what people give is checked before.
pub(crate) struct System<'a> {
    record: &'a Record,
    /// Whether the sensor of each output may still have held something.
    held: Vec<bool>,
    pub(crate) matrix: Vec<Vec<Vec<f64>>>,
    pub(crate) rhs: Vec<Vec<f64>>,
}

impl<'a> System<'a> {
    /// The system of equations with distinct outputs.
    ///
    /// # Errors
    /// Orders or signals that make no equation, as many coefficients as terms missing, two equations of one output.
    pub(crate) fn new(equations: &[Equation], record: &'a Record) -> Result<Self> {
        let m = record.m();
        let n = equations.len();
        let outputs: Vec<usize> = equations.iter().map(|e| e.structure.output).collect();
        for (i, output) in outputs.iter().enumerate() {
            if outputs[..i].contains(output) {
                return Err(Error::Structure {
                    what: format!("two equations have signal {output} as their output"),
                    remedy: "give one equation an output".into(),
                });
            }
        }
        let mut matrix = vec![vec![vec![0.0; m]; n]; n];
        let mut rhs = vec![vec![0.0; m]; n];
        // Terms often share an order: each kernel is made once.
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
                    let signal = record.driver(term.signal, eta);
                    // What stands still drives nothing.
                    if signal.iter().all(|v| *v == 0.0) {
                        continue;
                    }
                    if eta == 0.0 {
                        rhs[i].iter_mut().zip(signal).for_each(|(b, v)| *b += c * v);
                        continue;
                    }
                }
                let place = kernels.iter().position(|(known, _)| known.to_bits() == eta.to_bits());
                let place = place.unwrap_or_else(|| {
                    kernels.push((eta, kernel(eta, m, step)));
                    kernels.len() - 1
                });
                let kernel = &kernels[place].1;
                match unknown {
                    Some(j) => matrix[i][j].iter_mut().zip(kernel).for_each(|(a, v)| *a -= c * v),
                    None => {
                        // Of a single sample, only that: nothing is to be transformed then.
                        let signal = record.driver(term.signal, eta);
                        let last = signal.iter().rposition(|v| *v != 0.0).map_or(0, |k| k + 1);
                        let integral = series::multiply(kernel, if last <= FEW { &signal[..last] } else { signal }, m);
                        rhs[i].iter_mut().zip(integral).for_each(|(b, v)| *b += c * v);
                    }
                }
            }
        }
        let held = outputs.iter().map(|&o| record.is_held(o)).collect();
        Ok(Self { record, held, matrix, rhs })
    }

    /// The matrix read at ρz, ρ = e^{−decay}, which makes every model stable for a large enough decay [1/pulse].
    pub(crate) fn damped(mut self, decay: f64) -> Self {
        if decay > 0.0 {
            self.matrix.iter_mut().flatten().for_each(|series| *series = read_at(decay, series));
        }
        self
    }

    /// Free run with given initial terms: (exponent, coefficient) pairs per equation, empty at rest.
    pub(crate) fn respond(&self, initial: &[Vec<(f64, f64)>]) -> Result<Vec<Vec<f64>>> {
        let (rhs, beside) = self.driven(initial);
        let mut outputs = self.solve(&rhs)?;
        self.add_beside(&mut outputs, &beside);
        Ok(outputs)
    }

    /// The right-hand side with these initial terms, and those that are added to the outputs instead.
    #[allow(clippy::type_complexity)]
    fn driven(&self, initial: &[Vec<(f64, f64)>]) -> (Vec<Vec<f64>>, Vec<Vec<(f64, f64)>>) {
        let (beside, driving): (Vec<_>, Vec<_>) = (initial.iter().enumerate())
            .map(|(i, own)| own.iter().copied().partition(|&(exponent, _)| self.is_beside(i, exponent)))
            .unzip();
        let mut rhs = self.rhs.clone();
        for (b, terms) in rhs.iter_mut().zip(&driving) {
            for &(exponent, coefficient) in terms {
                b.iter_mut().zip(self.record.driving_term(exponent)).for_each(|(b, v)| *b += coefficient * v);
            }
        }
        (rhs, beside)
    }

    /// Free run where `bounded` takes it, else the first of damped copies that it takes ([`respond_damped`] at 4, 8, 16, …
    /// a record, to where nothing is left), and whether it is one. What damping leaves of the inverse of the matrix is its
    /// series read at ρz, as long as numbers hold it: it is made once, and a copy costs products.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn bounded(
        &self,
        initial: &[Vec<(f64, f64)>],
        bounded: impl Fn(&[Vec<f64>]) -> bool,
    ) -> Result<(Vec<Vec<f64>>, bool)> {
        let (rhs, beside) = self.driven(initial);
        let finish = |mut outputs: Vec<Vec<f64>>| {
            self.add_beside(&mut outputs, &beside);
            outputs
        };
        let outputs = finish(self.solve(&rhs)?);
        if bounded(&outputs) {
            return Ok((outputs, false));
        }
        let m = self.record.m();
        let inverse = self.inverse()?;
        let finite = inverse.iter().flatten().flatten().all(|v| v.is_finite());
        let spectra: Vec<Kernel> = rhs.iter().map(|b| Kernel::new(b)).collect();
        let (mut sum, mut buffers) = (SumOfProducts::new(m), Buffers::default());
        let mut gamma = 4.0;
        loop {
            let decay = gamma / m as f64;
            let outputs = if finite {
                let mut through = |row: &Vec<Vec<f64>>| {
                    for (series, driver) in row.iter().zip(&spectra) {
                        sum.add(1.0, &Kernel::new(&read_at(decay, series)), driver);
                    }
                    let mut out = vec![0.0; m];
                    sum.take(&mut out, &mut buffers);
                    out
                };
                finish(inverse.iter().map(&mut through).collect())
            } else {
                let matrix = self.matrix.iter().map(|row| row.iter().map(|series| read_at(decay, series)).collect());
                let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
                finish(series::solve(&matrix.collect::<Vec<Vec<Vec<f64>>>>(), &borrowed)?)
            };
            if bounded(&outputs) || gamma > 64.0 * m as f64 {
                return Ok((outputs, true));
            }
            gamma *= 2.0;
        }
    }

    /// Whether an initial term of an equation is an impulse that only the sensor of its output gets: of an output that
    /// passes the record's filter with all that drives it, the motion of both.
    fn is_beside(&self, equation: usize, exponent: f64) -> bool {
        is_impulse(exponent) && (!self.record.is_filtered() || self.held[equation])
    }

    /// Adds impulses that only sensors get to the outputs.
    fn add_beside(&self, outputs: &mut [Vec<f64>], beside: &[Vec<(f64, f64)>]) {
        for (output, own) in outputs.iter_mut().zip(beside) {
            for &(exponent, value) in own.iter().filter(|(_, value)| *value != 0.0) {
                output.iter_mut().zip(self.record.initial_term(exponent)).for_each(|(s, v)| *s += value * v);
            }
        }
    }

    /// Series of the inverse of the matrix, see [`crate::series::Solver::inverse`].
    pub(crate) fn inverse(&self) -> Result<Vec<Vec<Vec<f64>>>> {
        series::Solver::new(&self.matrix)?.inverse()
    }

    /// What a unit of each initial term, an equation and an exponent, does to every output while nothing else drives.
    pub(crate) fn units(&self, units: &[(usize, f64)]) -> Result<Vec<Vec<Vec<f64>>>> {
        let mut solver = series::Solver::new(&self.matrix)?;
        match self.factored(&mut solver, units)? {
            Some(mut by) => Ok(units.iter().map(|&unit| by.unit(unit)).collect()),
            None => self.one_by_one(&mut solver, units),
        }
    }

    /// The free run at rest, and [`System::units`].
    #[allow(clippy::type_complexity)]
    pub(crate) fn rest_and_units(&self, units: &[(usize, f64)]) -> Result<(Vec<Vec<f64>>, Vec<Vec<Vec<f64>>>)> {
        let mut solver = series::Solver::new(&self.matrix)?;
        match self.factored(&mut solver, units)? {
            Some(mut by) => Ok((by.rest(), units.iter().map(|&unit| by.unit(unit)).collect())),
            None => Ok((solver.solve(&self.rhs)?, self.one_by_one(&mut solver, units)?)),
        }
    }

    /// The inverse of the matrix for products with so many units; none where there are none, or where it grows by so much
    /// that products would lose the digits of its beginning.
    fn factored(&self, solver: &mut series::Solver<'_>, units: &[(usize, f64)]) -> Result<Option<Factored<'_, 'a>>> {
        if units.is_empty() {
            return Ok(None);
        }
        let inverse = solver.inverse()?;
        if inverse.iter().flatten().any(|series| grows(series)) {
            return Ok(None);
        }
        let kernels = inverse.iter().map(|row| row.iter().map(|s| Kernel::new(s)).collect()).collect();
        let behind = (0..inverse.len()).map(|_| None).collect();
        // Without a filter its spectra are all that is asked for.
        let inverse = if self.record.is_filtered() { inverse } else { Vec::new() };
        Ok(Some(Factored { system: self, inverse, kernels, behind, buffers: Buffers::default() }))
    }

    fn one_by_one(&self, solver: &mut series::Solver<'_>, units: &[(usize, f64)]) -> Result<Vec<Vec<Vec<f64>>>> {
        units
            .iter()
            .map(|&(i, exponent)| {
                let term = self.alone(i, exponent);
                if self.is_beside(i, exponent) {
                    Ok(term)
                } else {
                    solver.solve(&term)
                }
            })
            .collect()
    }

    /// The right-hand side of one initial term.
    fn alone(&self, i: usize, exponent: f64) -> Vec<Vec<f64>> {
        let mut rows = vec![vec![0.0; self.record.m()]; self.matrix.len()];
        rows[i] = self.record.driving_term(exponent);
        rows
    }

    /// What these right-hand sides make of the outputs.
    pub(crate) fn solve(&self, rhs: &[Vec<f64>]) -> Result<Vec<Vec<f64>>> {
        let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
        series::solve(&self.matrix, &borrowed)
    }
}

/// The inverse of a system's matrix, and of one that stands behind a filter together with it: one product a right-hand side.
struct Factored<'s, 'a> {
    system: &'s System<'a>,
    inverse: Vec<Vec<Vec<f64>>>,
    kernels: Vec<Vec<Kernel>>,
    /// By equation, what its error does to every output behind the record's filter, once that is asked for.
    behind: Vec<Option<Vec<Kernel>>>,
    buffers: Buffers,
}

impl Factored<'_, '_> {
    fn rest(&mut self) -> Vec<Vec<f64>> {
        let (rhs, m) = (&self.system.rhs, self.system.record.m());
        let mut outputs = vec![vec![0.0; m]; self.kernels.len()];
        let mut product = vec![0.0; m];
        for (output, row) in outputs.iter_mut().zip(&self.kernels) {
            for (kernel, driver) in row.iter().zip(rhs) {
                kernel.apply(driver, &mut product, &mut self.buffers);
                output.iter_mut().zip(&product).for_each(|(y, v)| *y += v);
            }
        }
        outputs
    }

    fn unit(&mut self, (i, exponent): (usize, f64)) -> Vec<Vec<f64>> {
        let (system, m) = (self.system, self.system.record.m());
        if system.is_beside(i, exponent) {
            return system.alone(i, exponent);
        }
        let buffers = &mut self.buffers;
        let mut through = |kernel: &Kernel, term: &[f64]| {
            let mut out = vec![0.0; m];
            kernel.apply(term, &mut out, buffers);
            out
        };
        let Some(term) = system.record.unfiltered_term(exponent) else {
            let term = system.record.driving_term(exponent);
            return self.kernels.iter().map(|row| through(&row[i], &term)).collect();
        };
        let inverse = &self.inverse;
        let behind = self.behind[i].get_or_insert_with(|| {
            inverse.iter().map(|row| Kernel::new(&system.record.behind_filter(row[i].clone()))).collect()
        });
        behind.iter().map(|kernel| through(kernel, &term)).collect()
    }
}

/// A series read at ρz, ρ = e^{−decay}.
#[allow(clippy::cast_precision_loss)]
fn read_at(decay: f64, series: &[f64]) -> Vec<f64> {
    series.iter().enumerate().map(|(k, a)| a * libm::exp(-decay * k as f64)).collect()
}

/// Pulses of a signal that ends in zeros which a product takes one by one.
const FEW: usize = 64;

/// Whether the second half of a series exceeds its first by so much that a transform would swamp the latter.
fn grows(series: &[f64]) -> bool {
    let largest = |part: &[f64]| part.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    let (first, second) = series.split_at(series.len() / 2);
    let (first, second) = (largest(first), largest(second));
    !(second <= GROWTH * first && first.is_finite())
}

/// By this factor: half of the digits of a transform's smallest values are lost to 1e−12 of its largest.
const GROWTH: f64 = 1e3;
