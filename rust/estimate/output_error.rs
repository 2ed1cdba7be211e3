//! Joint output error: all equations of a model, all records, all orders continuous, by Levenberg–Marquardt.
//!
//! For white noise on the outputs this is maximum likelihood. The free run solves A y = b in series, by exact division.
//! Its sensitivity to a parameter is A⁻¹(∂b − ∂A y), a sum of products of three series: with the spectra of A⁻¹ at hand,
//! one inverse transform a parameter and output. Rejected steps cost no Jacobian. Initial terms are linear and projected
//! out (variable projection, Kaufman's form, doi:10.1007/BF01932995). Records are compared sample by sample: y_k with the mean of the pulses on either side of kh,
//! on a grid that may be finer than the samples.

use crate::dense;
use crate::equation::{AffineOrder, Initial, Structure, Term};
use crate::error::{check_length, Error, Result};
use crate::fractional::kernel_with_derivative;
use crate::means::delayed;
use crate::regressors::Record;
use crate::series::{self, Buffers, Kernel, Solver, SumOfProducts};
use crate::simulate::nyquist_margin;
use crate::small::back_substitute;

/// Own-output orders closer to α than this make the equation say that the output equals itself.
const LEAST_INTEGRATION: f64 = 1e-3;

/// An initial term whose response lies in the span of the others up to this share adds nothing to the projection.
const SPANNED: f64 = 1e-12;

/// In which coordinate a coefficient is estimated: scales decide whether the optimum is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Coordinate {
    /// As it is.
    Plain,
    /// ln|c|, the sign of the start kept.
    Logarithm,
    /// ln(c − 1), for a ratio that exceeds 1.
    ExcessLogarithm,
}

/// A signed product of powers of coefficients: factor·Π c_i^{n_i}.
#[derive(Debug, Clone, PartialEq)]
pub struct Monomial {
    /// Known factor.
    pub factor: f64,
    /// Free coefficients and their powers.
    pub powers: Vec<(usize, i32)>,
}

impl Monomial {
    fn at(&self, coefficients: &[f64]) -> f64 {
        self.powers.iter().fold(self.factor, |product, &(i, n)| product * coefficients[i].powi(n))
    }

    /// Derivative with respect to coefficient i.
    fn slope(&self, coefficients: &[f64], i: usize) -> f64 {
        let Some(&(_, n)) = self.powers.iter().find(|&&(j, _)| j == i) else { return 0.0 };
        let rest = self.powers.iter().filter(|&&(j, _)| j != i);
        let others = rest.fold(self.factor, |product, &(j, k)| product * coefficients[j].powi(k));
        others * f64::from(n) * coefficients[i].powi(n - 1)
    }
}

/// One equation whose orders and coefficients follow from shared free ones.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeEquation {
    /// Index of the output in the record.
    pub output: usize,
    /// α.
    pub order: AffineOrder,
    /// Signal, order and coefficient of each term.
    pub terms: Vec<(usize, AffineOrder, Monomial)>,
}

/// A free delay of an input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FreeDelay {
    /// Index of the input in the record; no equation's output.
    pub signal: usize,
    /// Least and largest delay \[s\].
    pub bounds: (f64, f64),
}

/// Values of all that is free.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Point {
    /// Free orders.
    pub orders: Vec<f64>,
    /// Free coefficients.
    pub coefficients: Vec<f64>,
    /// Free delays \[s\].
    pub delays: Vec<f64>,
}

/// What is estimated.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeModel {
    /// The equations.
    pub equations: Vec<FreeEquation>,
    /// Bounds of each free order.
    pub order_bounds: Vec<(f64, f64)>,
    /// Coordinate of each free coefficient.
    pub coordinates: Vec<Coordinate>,
    /// Free delays of inputs.
    pub delays: Vec<FreeDelay>,
    /// Whether the equations' outputs drive each other as simulated, or as measured.
    pub coupled: bool,
    /// Initial terms of each record.
    pub initial: Initial,
}

/// One run to compare with: pulse means on a grid of which every `every`-th edge is a sample.
#[derive(Debug, Clone)]
pub struct Experiment {
    /// Pulse means of all signals.
    pub record: Record,
    /// Pulses a sample interval.
    pub every: usize,
    /// Point samples of each equation's output, one more than there are intervals.
    pub samples: Vec<Vec<f64>>,
    /// Filter that simulated outputs pass before they are compared, where there is one.
    pub filter: Option<(Vec<f64>, Vec<bool>)>,
    /// 1/σ of each equation's output.
    pub weights: Vec<f64>,
}

impl Experiment {
    /// Samples that are compared: all that have a pulse on either side.
    fn compared(&self) -> usize {
        (self.record.m() / self.every).saturating_sub(1)
    }

    /// Weighted samples of pulse means, all outputs after one another.
    fn sampled(&self, response: &[Vec<f64>]) -> Vec<f64> {
        let mut samples = Vec::with_capacity(response.len() * self.compared());
        for (i, means) in response.iter().enumerate() {
            let filtered;
            let means = match &self.filter {
                Some((filter, applies)) if applies[i] => {
                    filtered = series::multiply(filter, means, means.len());
                    &filtered
                }
                _ => means,
            };
            let w = self.weights[i];
            samples.extend((1..=self.compared()).map(|k| {
                let edge = k * self.every;
                0.5 * w * (means[edge - 1] + means[edge])
            }));
        }
        samples
    }
}

/// Where the search for the optimum ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Neither the cost nor the parameters move any more.
    Converged,
    /// The last allowed iteration still moved.
    Exhausted,
    /// No step lowers the cost although the gradient is not zero.
    Stalled,
}

/// The optimum and what describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// Free orders, coefficients and delays.
    pub point: Point,
    /// Half the weighted sum of squared residuals.
    pub cost: f64,
    /// Weighted residuals (y − ŷ)/σ, records one after the other, outputs within.
    pub residuals: Vec<f64>,
    /// Their derivatives with respect to orders, coefficients (plain coordinates), then delays, initial terms projected
    /// out.
    pub jacobian: Vec<Vec<f64>>,
    /// Coefficients of the initial terms per record and equation.
    pub initial: Vec<Vec<Vec<f64>>>,
    /// Exponents of the initial terms per equation.
    pub exponents: Vec<Vec<f64>>,
    /// Evaluations of residuals.
    pub evaluations: usize,
    /// How it ended.
    pub status: Status,
}

/// Residuals at a point, and what their derivatives there are made of.
struct Evaluation {
    cost: f64,
    residuals: Vec<f64>,
    initial: Vec<Vec<Vec<f64>>>,
    exponents: Vec<Vec<f64>>,
    parts: Vec<Part>,
}

/// Coefficient of a term, kernel of its integral, and the kernel's derivative with respect to the order.
type Operator = (f64, Vec<f64>, Vec<f64>);

/// What one experiment leaves behind for its sensitivities.
struct Part {
    /// A of A y = b.
    matrix: Vec<Vec<Vec<f64>>>,
    /// Spectra of A⁻¹ where initial terms needed them already.
    inverse: Option<Vec<Vec<Kernel>>>,
    /// Of each term of each equation.
    operators: Vec<Vec<Operator>>,
    /// Simulated pulse means, initial terms included.
    response: Vec<Vec<f64>>,
    /// Orthonormal basis of the sampled responses to the initial terms.
    basis: Vec<Vec<f64>>,
    /// Pulse means of each freely delayed input after its delay, and their derivative with respect to it \[1/s\].
    shifted: Vec<(Vec<f64>, Vec<f64>)>,
}

/// Least response of the divisor at Nyquist's frequency, as a share of its leading coefficient, that a step may end at.
const RESOLVED: f64 = 0.02;

/// Terms of a product of three series of m terms: spectra of this length multiply without wrapping onto the first m.
const FACTORS: usize = 3;

impl FreeModel {
    /// Place of a signal's delay among the free ones, if it has one.
    fn delay_of(&self, signal: usize) -> Option<usize> {
        self.delays.iter().position(|d| d.signal == signal)
    }

    /// Pulse means of a signal after a delay \[s\], and their derivative with respect to it.
    ///
    /// Held inputs are shifted exactly; an input that is linear in between to second order in the step. The derivative
    /// is that towards longer delays where the delay is a whole number of steps.
    fn shifted(&self, record: &Record, signal: usize, delay: f64) -> Result<(Vec<f64>, Vec<f64>)> {
        let means = record.signal(signal);
        let before = if self.initial == Initial::Rest { 0.0 } else { means.first().copied().unwrap_or(0.0) };
        let steps = delay / record.step();
        let whole = steps.floor();
        let (near, far) = (delayed(means, whole, before)?, delayed(means, whole + 1.0, before)?);
        let slope = near.iter().zip(&far).map(|(near, far)| (far - near) / record.step()).collect();
        Ok((delayed(means, steps, before)?, slope))
    }

    fn structures(&self, orders: &[f64]) -> Vec<Structure> {
        self.equations
            .iter()
            .map(|e| Structure {
                output: e.output,
                order: raw(&e.order, orders),
                terms: e.terms.iter().map(|(s, o, _)| Term { signal: *s, order: raw(o, orders) }).collect(),
            })
            .collect()
    }

    /// The unknown that a signal of equation i is, if it is one.
    fn unknown(&self, i: usize, signal: usize) -> Option<usize> {
        if self.coupled {
            self.equations.iter().position(|e| e.output == signal)
        } else {
            (signal == self.equations[i].output).then_some(i)
        }
    }

    /// Whether every grid sees what the own terms of each equation do, as far as equations stand alone.
    ///
    /// At Nyquist's frequency the divisor is [`nyquist_margin`] beside its leading coefficient: negative, the scheme has
    /// a mode that grows from pulse to pulse; near 0, one that hardly decays. A fit would follow noise with it.
    fn resolved(&self, experiments: &[Experiment], point: &Point) -> bool {
        if self.coupled && self.equations.len() > 1 {
            return true;
        }
        let structures = self.structures(&point.orders);
        structures.iter().zip(&self.equations).all(|(structure, equation)| {
            let own: Vec<(f64, f64)> = structure
                .terms
                .iter()
                .zip(&equation.terms)
                .filter(|(term, _)| term.signal == structure.output)
                .map(|(term, (_, _, c))| (c.at(&point.coefficients), structure.order - term.order))
                .collect();
            experiments.iter().all(|experiment| {
                let h = experiment.record.step();
                let first = |&(c, eta): &(f64, f64)| c * libm::pow(h, eta) / libm::tgamma(eta + 2.0);
                let leading = 1.0 - own.iter().map(first).sum::<f64>();
                nyquist_margin(&own, h) / leading >= RESOLVED
            })
        })
    }

    /// Residuals at a point.
    fn evaluate(&self, experiments: &[Experiment], point: &Point) -> Result<Evaluation> {
        let structures = self.structures(&point.orders);
        let mut out = Evaluation {
            cost: 0.0,
            residuals: Vec::new(),
            initial: Vec::new(),
            exponents: structures.iter().map(|s| s.initial_exponents(&self.initial)).collect(),
            parts: Vec::with_capacity(experiments.len()),
        };
        for experiment in experiments {
            self.evaluate_one(experiment, &structures, point, &mut out)?;
        }
        out.cost = 0.5 * out.residuals.iter().map(|e| e * e).sum::<f64>();
        Ok(out)
    }

    fn evaluate_one(
        &self,
        experiment: &Experiment,
        structures: &[Structure],
        point: &Point,
        out: &mut Evaluation,
    ) -> Result<()> {
        let record = &experiment.record;
        let shifted = (self.delays.iter().zip(&point.delays))
            .map(|(d, &delay)| self.shifted(record, d.signal, delay))
            .collect::<Result<Vec<_>>>()?;
        let (m, n) = (record.m(), structures.len());
        let mut matrix = vec![vec![vec![0.0; m]; n]; n];
        let mut rhs = vec![vec![0.0; m]; n];
        let mut buffers = Buffers::default();
        let mut drivers: Vec<Option<Kernel>> = (0..record.len()).map(|_| None).collect();
        let mut operators = Vec::with_capacity(n);
        let mut sum = SumOfProducts::new(m);
        for (i, structure) in structures.iter().enumerate() {
            matrix[i][i][0] += 1.0;
            let mut row = Vec::with_capacity(structure.terms.len());
            for (k, term) in structure.terms.iter().enumerate() {
                let eta = structure.order - term.order;
                let least = if term.signal == structure.output { LEAST_INTEGRATION } else { 0.0 };
                if eta < least {
                    // Reported like a step too far, so that the search shortens it. An order a little below 0 is let
                    // pass: under an order law the truth may lie on that edge, and estimates scatter to both sides.
                    return Err(Error::Diverged { what: "order of a term above alpha; the free run".into(), index: 0 });
                }
                let c = self.equations[i].terms[k].2.at(&point.coefficients);
                let (kernel, slope) = kernel_with_derivative(eta, m, record.step());
                if let Some(j) = self.unknown(i, term.signal) {
                    matrix[i][j].iter_mut().zip(&kernel).for_each(|(a, v)| *a -= c * v);
                } else {
                    let driver = drivers[term.signal].get_or_insert_with(|| {
                        Kernel::new(self.delay_of(term.signal).map_or(record.signal(term.signal), |d| &shifted[d].0))
                    });
                    sum.add(c, &Kernel::new(&kernel), driver);
                }
                row.push((c, kernel, slope));
            }
            sum.take(&mut rhs[i], &mut buffers);
            operators.push(row);
        }
        let mut response = Solver::new(&matrix)?.solve(&rhs)?;
        let mut residuals: Vec<f64> = experiment
            .samples
            .iter()
            .zip(&experiment.weights)
            .flat_map(|(y, w)| y[1..=experiment.compared()].iter().map(move |v| v * w))
            .collect();
        residuals.iter_mut().zip(experiment.sampled(&response)).for_each(|(e, v)| *e -= v);
        if let Some(index) = residuals.iter().position(|e| !e.is_finite()) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }

        // Initial terms: the projection of the residuals on their responses.
        let mut initial: Vec<Vec<f64>> = vec![Vec::new(); n];
        let mut basis = Vec::new();
        let mut inverse = None;
        if out.exponents.iter().any(|list| !list.is_empty()) {
            let made = inverse_spectra(&matrix)?;
            let mut target = SumOfProducts::with_length(FACTORS * m);
            let mut terms = Vec::new();
            for (i, list) in out.exponents.iter().enumerate() {
                for &exponent in list {
                    let power = Kernel::with_length(&record.initial_term(exponent), FACTORS * m);
                    let means: Vec<Vec<f64>> = made
                        .iter()
                        .map(|row| {
                            let mut means = vec![0.0; m];
                            target.add(1.0, &row[i], &power);
                            target.take(&mut means, &mut buffers);
                            means
                        })
                        .collect();
                    terms.push((i, experiment.sampled(&means), means));
                }
            }
            inverse = Some(made);
            let columns: Vec<Vec<f64>> = terms.iter().map(|t| t.1.clone()).collect();
            let (values, _) = super::least_squares::solve(&columns, &residuals, 0)?;
            for ((i, column, means), x) in terms.iter().zip(&values) {
                initial[*i].push(*x);
                residuals.iter_mut().zip(column).for_each(|(e, v)| *e -= x * v);
                for (total, part) in response.iter_mut().zip(means) {
                    total.iter_mut().zip(part).for_each(|(y, v)| *y += x * v);
                }
            }
            for column in columns {
                dense::extend_orthonormal(&mut basis, column, SPANNED);
            }
        }
        out.residuals.extend(residuals);
        out.initial.push(initial);
        out.parts.push(Part { matrix, inverse, operators, response, basis, shifted });
        Ok(())
    }

    /// Derivatives of the residuals at an evaluated point with respect to orders, coefficients (plain coordinates),
    /// then delays, initial terms projected out.
    fn jacobian(&self, experiments: &[Experiment], point: &Point, at: &Evaluation) -> Result<Vec<Vec<f64>>> {
        let count = point.orders.len() + point.coefficients.len() + point.delays.len();
        let mut jacobian = vec![Vec::with_capacity(at.residuals.len()); count];
        for (index, (experiment, part)) in experiments.iter().zip(&at.parts).enumerate() {
            self.sensitivities(experiment, part, point, &at.initial[index], &mut jacobian)?;
        }
        if jacobian.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "sensitivity of the free run".into(), index: 0 });
        }
        Ok(jacobian)
    }

    /// One experiment's rows of the Jacobian: A⁻¹(∂b − ∂A y) as products of three spectra.
    fn sensitivities(
        &self,
        experiment: &Experiment,
        part: &Part,
        point: &Point,
        initial: &[Vec<f64>],
        jacobian: &mut [Vec<f64>],
    ) -> Result<()> {
        let record = &experiment.record;
        let (orders, coefficients) = (&point.orders, &point.coefficients);
        let numbers = orders.len() + coefficients.len();
        let (m, n) = (record.m(), self.equations.len());
        let total = FACTORS * m;
        let spectrum = |series: &[f64]| Kernel::with_length(series, total);
        let made;
        let inverse = match &part.inverse {
            Some(inverse) => inverse,
            None => {
                made = inverse_spectra(&part.matrix)?;
                &made
            }
        };
        let responses: Vec<Kernel> = part.response.iter().map(|means| spectrum(means)).collect();
        let mut drivers: Vec<Option<Kernel>> = (0..record.len()).map(|_| None).collect();
        let mut spectra: Vec<Vec<(Option<Kernel>, Option<Kernel>)>> =
            part.operators.iter().map(|row| row.iter().map(|_| (None, None)).collect()).collect();
        let mut rights: Vec<SumOfProducts> = (0..n).map(|_| SumOfProducts::with_length(total)).collect();
        let mut target = SumOfProducts::with_length(total);
        let mut buffers = Buffers::default();
        for (parameter, out) in jacobian.iter_mut().enumerate() {
            let mut moves = vec![false; n];
            for (i, equation) in self.equations.iter().enumerate() {
                rights[i].clear();
                for (k, (signal, order, monomial)) in equation.terms.iter().enumerate() {
                    let (c, kernel, slope) = &part.operators[i][k];
                    let (kept, kept_slope) = &mut spectra[i][k];
                    if parameter >= numbers {
                        // A delay moves only what it delays: kernel and coefficient stay, the driver is its slope.
                        let delay = parameter - numbers;
                        if self.delays[delay].signal == *signal && *c != 0.0 {
                            moves[i] = true;
                            let slope = spectrum(&part.shifted[delay].1);
                            rights[i].add(*c, kept.get_or_insert_with(|| spectrum(kernel)), &slope);
                        }
                        continue;
                    }
                    let (weight, operator) = if parameter < orders.len() {
                        let d_eta = equation.order.weights.get(parameter).unwrap_or(&0.0)
                            - order.weights.get(parameter).unwrap_or(&0.0);
                        (c * d_eta, (kept_slope, slope))
                    } else {
                        (monomial.slope(coefficients, parameter - orders.len()), (kept, kernel))
                    };
                    if weight == 0.0 {
                        continue;
                    }
                    moves[i] = true;
                    let operator = operator.0.get_or_insert_with(|| spectrum(operator.1));
                    let driver = match self.unknown(i, *signal) {
                        Some(j) => &responses[j],
                        None => drivers[*signal].get_or_insert_with(|| {
                            spectrum(self.delay_of(*signal).map_or(record.signal(*signal), |d| &part.shifted[d].0))
                        }),
                    };
                    rights[i].add(weight, operator, driver);
                }
                if parameter < orders.len() {
                    if let Some(moved) = initial_slope(self, i, parameter, orders, &initial[i], record)? {
                        moves[i] = true;
                        rights[i].add_series(&spectrum(&moved));
                    }
                }
            }
            if !moves.contains(&true) {
                out.extend(std::iter::repeat_n(0.0, n * experiment.compared()));
                continue;
            }
            let means: Vec<Vec<f64>> = inverse
                .iter()
                .map(|row| {
                    for (i, _) in moves.iter().enumerate().filter(|(_, &moves)| moves) {
                        target.add_product(&rights[i], &row[i]);
                    }
                    let mut means = vec![0.0; m];
                    target.take(&mut means, &mut buffers);
                    means
                })
                .collect();
            let mut column = experiment.sampled(&means);
            for direction in &part.basis {
                let along: f64 = direction.iter().zip(&column).map(|(q, v)| q * v).sum();
                column.iter_mut().zip(direction).for_each(|(v, q)| *v -= along * q);
            }
            // Residuals fall where the response rises.
            out.extend(column.iter().map(|v| -v));
        }
        Ok(())
    }
}

/// Spectra of the series of A⁻¹, ready for products of [`FACTORS`] series.
fn inverse_spectra(matrix: &[Vec<Vec<f64>>]) -> Result<Vec<Vec<Kernel>>> {
    let n = matrix.len();
    let m = matrix.first().and_then(|row| row.first()).map_or(0, Vec::len);
    let mut solver = Solver::new(matrix)?;
    let mut rows: Vec<Vec<Kernel>> = (0..n).map(|_| Vec::with_capacity(n)).collect();
    for j in 0..n {
        let mut unit = vec![vec![0.0; m]; n];
        if let Some(first) = unit[j].first_mut() {
            *first = 1.0;
        }
        for (row, series) in rows.iter_mut().zip(solver.solve(&unit)?) {
            row.push(Kernel::with_length(&series, FACTORS * m));
        }
    }
    Ok(rows)
}

/// An affine order without rounding to the grain: it moves continuously here.
fn raw(law: &AffineOrder, free: &[f64]) -> f64 {
    law.constant + law.weights.iter().zip(free).map(|(w, x)| w * x).sum::<f64>()
}

/// How the initial terms of equation i move with a free order, weighted by their coefficients; none if they do not.
fn initial_slope(
    model: &FreeModel,
    i: usize,
    parameter: usize,
    orders: &[f64],
    values: &[f64],
    record: &Record,
) -> Result<Option<Vec<f64>>> {
    // Exponents move linearly with orders, and powers of t smoothly with exponents: a central difference of the
    // powers has an error of 1e−10, far below what a Jacobian needs.
    const SHIFT: f64 = 1e-5;
    if values.is_empty() || model.initial != Initial::Caputo {
        return Ok(None);
    }
    let mut lists = Vec::with_capacity(2);
    for sign in [1.0, -1.0] {
        let mut moved = orders.to_vec();
        moved[parameter] += sign * SHIFT;
        lists.push(model.structures(&moved)[i].initial_exponents(&model.initial));
    }
    if lists.iter().any(|l| l.len() != values.len()) {
        // An exponent appears or merges here: the projection follows it in the next evaluation.
        return Ok(None);
    }
    let mut out = vec![0.0; record.m()];
    let mut moved = false;
    for ((&up, &down), &x) in lists[0].iter().zip(&lists[1]).zip(values) {
        if (up - down).abs() < 1e-9 || x == 0.0 {
            continue;
        }
        moved = true;
        let (above, below) = (record.initial_term(up), record.initial_term(down));
        check_length("initial term", above.len(), below.len())?;
        out.iter_mut().zip(above.iter().zip(&below)).for_each(|(v, (a, b))| *v += x * (a - b) / (2.0 * SHIFT));
    }
    Ok(moved.then_some(out))
}

/// Settings of [`fit`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Most evaluations.
    pub evaluations: usize,
    /// Relative change of the cost, and of the parameters, at which the search ends.
    pub tolerance: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { evaluations: 100, tolerance: 1e-10 }
    }
}

/// Weighted least squares on the output error from a start, by Levenberg–Marquardt with columns scaled by the Jacobian.
///
/// # Errors
/// A start whose free run is not finite ([`Error::Diverged`]), or that lies outside its bounds or coordinates.
pub fn fit(model: &FreeModel, experiments: &[Experiment], start: &Point, settings: Settings) -> Result<Fit> {
    check_length("orders", model.order_bounds.len(), start.orders.len())?;
    check_length("coefficients", model.coordinates.len(), start.coefficients.len())?;
    check_length("delays", model.delays.len(), start.delays.len())?;
    for experiment in experiments {
        check_length("outputs", model.equations.len(), experiment.samples.len())?;
        check_length("weights", model.equations.len(), experiment.weights.len())?;
        for samples in &experiment.samples {
            check_length("samples", experiment.record.m() / experiment.every + 1, samples.len())?;
        }
    }
    for (i, (&c, coordinate)) in start.coefficients.iter().zip(&model.coordinates).enumerate() {
        let fits = match coordinate {
            Coordinate::Plain => c.is_finite(),
            Coordinate::Logarithm => c != 0.0 && c.is_finite(),
            Coordinate::ExcessLogarithm => c > 1.0 && c.is_finite(),
        };
        if !fits {
            return Err(Error::OutOfRange {
                name: format!("start of coefficient {i}"),
                value: c,
                range: "its coordinate".into(),
                remedy: "start a logarithmic coefficient away from 0, a ratio above 1".into(),
            });
        }
    }
    let mut point = start.clone();
    point.orders.iter_mut().zip(&model.order_bounds).for_each(|(o, &(low, high))| *o = o.clamp(low, high));
    point.delays.iter_mut().zip(&model.delays).for_each(|(t, d)| *t = t.clamp(d.bounds.0, d.bounds.1));
    let mut current = model.evaluate(experiments, &point)?;
    let mut jacobian = model.jacobian(experiments, &point, &current)?;
    let mut evaluations = 1;
    let mut resolved = model.resolved(experiments, &point);
    let mut damping = 1e-3;
    let mut status = Status::Exhausted;
    'outer: while evaluations < settings.evaluations {
        let (r, scales) = scaled_factor(model, &jacobian, &current.residuals, &point);
        let k = scales.len();
        let stride = k + 1;
        loop {
            let step = damped_step(&r, k, stride, damping);
            let deltas: Vec<f64> =
                step.iter().zip(&scales).map(|(s, scale)| if *scale > 0.0 { s / scale } else { 0.0 }).collect();
            let (next, moved) = stepped(model, &point, &deltas);
            if moved <= settings.tolerance {
                status = Status::Converged;
                break 'outer;
            }
            evaluations += 1;
            // From where the grid sees all of the equation no step leads to where it does not.
            let sees = model.resolved(experiments, &next);
            match model.evaluate(experiments, &next) {
                Ok(found) if found.cost.is_finite() && found.cost < current.cost && (sees || !resolved) => {
                    let slopes = match model.jacobian(experiments, &next, &found) {
                        Ok(slopes) => slopes,
                        Err(Error::Diverged { .. }) => {
                            damping *= 10.0;
                            if damping > 1e12 {
                                status = Status::Stalled;
                                break 'outer;
                            }
                            continue;
                        }
                        Err(error) => return Err(error),
                    };
                    let gain = (current.cost - found.cost) / current.cost.max(f64::MIN_POSITIVE);
                    (point, current, jacobian, resolved) = (next, found, slopes, sees);
                    damping = (damping * 0.1).max(1e-12);
                    if gain <= settings.tolerance {
                        status = Status::Converged;
                        break 'outer;
                    }
                    break;
                }
                // A step that lowers nothing, or leaves the numbers, is shortened.
                Ok(_) | Err(Error::Diverged { .. } | Error::LeadingZero { .. }) => {
                    damping *= 10.0;
                    if damping > 1e12 {
                        status = Status::Stalled;
                        break 'outer;
                    }
                }
                Err(error) => return Err(error),
            }
            if evaluations >= settings.evaluations {
                break 'outer;
            }
        }
    }
    Ok(Fit {
        point,
        cost: current.cost,
        residuals: current.residuals,
        jacobian,
        initial: current.initial,
        exponents: current.exponents,
        evaluations,
        status,
    })
}

/// A point moved by steps in its coordinates, within bounds, and how far: orders as they are, coefficients as a share
/// of themselves, delays as a share of their interval.
fn stepped(model: &FreeModel, point: &Point, deltas: &[f64]) -> (Point, f64) {
    let mut next = point.clone();
    let mut moved: f64 = 0.0;
    let (orders, rest) = deltas.split_at(point.orders.len());
    let (coefficients, delays) = rest.split_at(point.coefficients.len());
    for ((order, &(low, high)), delta) in next.orders.iter_mut().zip(&model.order_bounds).zip(orders) {
        let before = *order;
        *order = (before + delta).clamp(low, high);
        moved = moved.max((*order - before).abs());
    }
    for ((value, &coordinate), &delta) in next.coefficients.iter_mut().zip(&model.coordinates).zip(coefficients) {
        let before = *value;
        *value = shifted(coordinate, before, delta);
        moved = moved.max((*value - before).abs() / before.abs().max(f64::MIN_POSITIVE));
    }
    for ((delay, FreeDelay { bounds: (low, high), .. }), delta) in next.delays.iter_mut().zip(&model.delays).zip(delays)
    {
        let before = *delay;
        *delay = (before + delta).clamp(*low, *high);
        moved = moved.max((*delay - before).abs() / (high - low).max(f64::MIN_POSITIVE));
    }
    (next, moved)
}

/// A coefficient moved by `delta` in its coordinate.
fn shifted(coordinate: Coordinate, value: f64, delta: f64) -> f64 {
    // A factor of e^5 in one step has left the region in which the linearisation means anything.
    let bounded = delta.clamp(-5.0, 5.0);
    match coordinate {
        Coordinate::Plain => value + delta,
        Coordinate::Logarithm => value * libm::exp(bounded),
        Coordinate::ExcessLogarithm => 1.0 + (value - 1.0) * libm::exp(bounded),
    }
}

/// Derivative of a coefficient with respect to its coordinate.
fn stretch(coordinate: Coordinate, value: f64) -> f64 {
    match coordinate {
        Coordinate::Plain => 1.0,
        Coordinate::Logarithm => value,
        Coordinate::ExcessLogarithm => value - 1.0,
    }
}

/// R of the QR factorisation of [J | e] with J in coordinates and unit columns, and the columns' norms.
fn scaled_factor(model: &FreeModel, jacobian: &[Vec<f64>], residuals: &[f64], point: &Point) -> (Vec<f64>, Vec<f64>) {
    let mut columns = Vec::with_capacity(jacobian.len() + 1);
    let mut scales = Vec::with_capacity(jacobian.len());
    for (i, column) in jacobian.iter().enumerate() {
        let factor = (i.checked_sub(point.orders.len()))
            .filter(|j| *j < point.coefficients.len())
            .map_or(1.0, |j| stretch(model.coordinates[j], point.coefficients[j]));
        let norm = column.iter().map(|v| (v * factor) * (v * factor)).sum::<f64>().sqrt();
        let scale = if norm > 0.0 { factor / norm } else { 0.0 };
        columns.push(column.iter().map(|v| v * scale).collect());
        scales.push(norm);
    }
    columns.push(residuals.to_vec());
    (dense::triangular_factor(&columns), scales)
}

/// Minimises ‖R s + e‖² + λ‖s‖² for the triangular factor of [J | e].
fn damped_step(r: &[f64], k: usize, stride: usize, damping: f64) -> Vec<f64> {
    let mut columns: Vec<Vec<f64>> = (0..k)
        .map(|j| {
            let mut column = vec![0.0; 2 * k];
            for i in 0..=j {
                column[i] = r[i * stride + j];
            }
            column[k + j] = damping.sqrt();
            column
        })
        .collect();
    let mut target = vec![0.0; 2 * k];
    for (i, value) in target.iter_mut().take(k).enumerate() {
        *value = -r[i * stride + k];
    }
    columns.push(target);
    let q = dense::triangular_factor(&columns);
    let rhs: Vec<f64> = (0..k).map(|i| q[i * (k + 1) + k]).collect();
    back_substitute(&q, k + 1, &rhs)
}
