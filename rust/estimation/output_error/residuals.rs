//! Simulation and residuals of a model on every experiment, with linear coefficients and initial terms eliminated.
//!
//! Linear coefficients and initial terms are solved for at every point (Golub & Pereyra, doi:10.1137/0710036). Only
//! autoregressive coefficients, orders and input parameters are therefore iterated. No sign has to be guessed, and
//! collinear inputs cause no valley of the cost.

use std::borrow::Cow;
use std::rc::Rc;

use super::evaluation::{solve_linear_steps, Evaluation, LinearSide, RANK_TOLERANCE};
use super::evaluation_cache::EvaluationCache;
use super::experiment::Experiment;
use super::feedthrough::{add_feedthrough_derivative, Feedthrough, JumpCorrection};
use super::kink_correction::KinkCorrection;
use super::parameterization::{Coordinate, FreeModel, ParameterPoint};
use super::system_inverse::{Operator, PulseMeans, SystemInverse};
use crate::equation::Structure;
use crate::error::{Error, Result};
use crate::estimation::least_squares;
use crate::fractional::kernels::MAX_ORDER_EXCESS;
use crate::linalg::orthogonal::extend_orthonormal;
use crate::regressors::Record;
use crate::series::{Buffers, RunningSumSystem, SumOfProducts};

/// Minimum difference between the order of an equation and the order of an autoregressive term.
///
/// With equal orders, the equation would not depend on the input.
pub(crate) const MIN_INTEGRATION_ORDER: f64 = 1e-3;

/// Response of an experiment to an initial term: index of the equation, weighted samples, pulse means.
///
/// The pulse means are empty for a term that affects only the sensor filter. They are also empty for a level of the
/// output, which belongs to no equation. The index of a level is None.
struct InitialTermResponse {
    equation: Option<usize>,
    samples: Vec<f64>,
    means: Rc<PulseMeans>,
}

/// Simulation of an experiment from zero initial conditions, before the initial terms are added.
struct RestSimulation {
    linearization: Linearization,
    residuals: Vec<f64>,
    initial_responses: Vec<InitialTermResponse>,
}

impl FreeModel {
    /// Return the residuals at a point, with the `linear` coefficients and the initial terms eliminated.
    pub(crate) fn evaluate(
        &self,
        experiments: &[Experiment],
        caches: &mut [EvaluationCache],
        point: &ParameterPoint,
        linear: &[usize],
    ) -> Result<Evaluation<Linearization>> {
        let structures = self.structures(&point.orders);
        let mut out = Evaluation::empty(point.clone());
        let mut responses = Vec::with_capacity(experiments.len());
        for (experiment, cache) in experiments.iter().zip(caches) {
            responses.push(self.simulate_at_rest(experiment, cache, &structures, point, linear, &mut out)?);
        }
        if !linear.is_empty() {
            let sides: Vec<LinearSide<'_>> = (responses.iter())
                .map(|RestSimulation { linearization, residuals, .. }| {
                    let effects = linearization.linear_effects.iter().map(|d| &d.samples[..]).collect();
                    (&residuals[..], &linearization.basis[..], effects)
                })
                .collect();
            let steps = solve_linear_steps(&sides)?;
            linear.iter().zip(&steps).for_each(|(&j, step)| out.point.coefficients[j] += step);
            for (simulation, experiment) in responses.iter_mut().zip(experiments) {
                let Linearization {
                    linear_effects: effects,
                    response,
                    feedthrough,
                    input_means: nonlinearity_outputs,
                    ..
                } = &mut simulation.linearization;
                for (column, step) in effects.iter_mut().zip(&steps) {
                    column.apply(*step, &mut simulation.residuals, response);
                }
                if feedthrough.is_some() {
                    *feedthrough = Feedthrough::new(self, experiment, &structures, &out.point, nonlinearity_outputs)?;
                }
            }
        }
        for simulation in responses {
            Self::add_initial_terms(simulation, structures.len(), &mut out)?;
        }
        Ok(out)
    }

    fn simulate_at_rest(
        &self,
        experiment: &Experiment,
        cache: &mut EvaluationCache,
        structures: &[Structure],
        point: &ParameterPoint,
        linear: &[usize],
        out: &mut Evaluation<Linearization>,
    ) -> Result<RestSimulation> {
        cache.stop.check()?;
        let record = &experiment.record;
        let nonlinearity_outputs = (self.inputs.iter().zip(&point.inputs))
            .map(|(&input, &value)| self.apply_input_law(record, input, value))
            .collect::<Result<Vec<_>>>()?;
        let operators = self.term_operators(experiment, cache, structures)?;
        out.exponents = (structures.iter().enumerate()).map(|(i, s)| self.exponents(experiment, i, s)).collect();
        let has_level = self.initial.has_level();
        let needs_terms = has_level || out.exponents.iter().any(|list| !list.is_empty()) || !linear.is_empty();
        let (response, inverse) = self.rest_response(experiment, cache, &operators, point, &nonlinearity_outputs)?;
        cache.stop.check()?;
        let mut residuals = experiment.measured_samples();
        out.measured_norm = out.measured_norm.hypot(residuals.iter().map(|v| v * v).sum::<f64>().sqrt());
        let mut simulated_samples = experiment.weighted_samples(&response);
        let jump_correction = JumpCorrection::new(self, experiment, &nonlinearity_outputs);
        jump_correction.correct(self, experiment, point, &mut simulated_samples)?;
        residuals.iter_mut().zip(simulated_samples).for_each(|(e, v)| *e -= v);
        let feedthrough = Feedthrough::new(self, experiment, structures, point, &nonlinearity_outputs)?;
        if let Some(feedthrough) = &feedthrough {
            residuals.iter_mut().zip(feedthrough.weighted_correction(experiment)).for_each(|(e, v)| *e -= v);
        }
        let kink_correction = KinkCorrection::new(self, experiment, structures, &mut cache.kinks);
        if let Some(kink_correction) = &kink_correction {
            let correction = kink_correction.weighted_correction(self, experiment, point, feedthrough.as_ref());
            residuals.iter_mut().zip(correction).for_each(|(e, v)| *e -= v);
        }
        if let Some(index) = residuals.iter().position(|e| !e.is_finite()) {
            return Err(Error::Diverged { what: "simulation".into(), index });
        }
        let mut initial_responses = Vec::new();
        let mut basis = Vec::new();
        if needs_terms {
            let terms: Vec<(usize, f64)> =
                out.exponents.iter().enumerate().flat_map(|(i, list)| list.iter().map(move |e| (i, *e))).collect();
            let affects_only_filter = |i: usize, e: f64| experiment.affects_only_filter(self.equations[i].output, e);
            let response_terms: Vec<(usize, f64)> =
                terms.iter().filter(|&&(i, e)| !affects_only_filter(i, e)).copied().collect();
            let mut responses =
                cache.initial_term_responses(&inverse, (structures.len(), record.m()), &response_terms)?.into_iter();
            for (i, exponent) in terms {
                let response = if affects_only_filter(i, exponent) { None } else { responses.next() };
                let (samples, means) = match response {
                    None => (cache.impulse_samples(experiment, i, exponent), Rc::default()),
                    Some(means) => {
                        let mut samples = experiment.weighted_samples(&truncate_means(&means, record.m()));
                        if experiment.nonuniform.is_some() {
                            let correction = KinkCorrection::initial_term_correction(experiment, i, exponent);
                            samples.iter_mut().zip(correction).for_each(|(v, c)| *v += c);
                        }
                        (samples, means)
                    }
                };
                extend_orthonormal(&mut basis, samples.clone(), RANK_TOLERANCE);
                initial_responses.push(InitialTermResponse { equation: Some(i), samples, means });
            }
        }
        for i in 0..if has_level { structures.len() } else { 0 } {
            let samples: Vec<f64> = (0..structures.len())
                .flat_map(|j| experiment.weights_of(j).map(move |w| if i == j { w } else { 0.0 }))
                .collect();
            extend_orthonormal(&mut basis, samples.clone(), RANK_TOLERANCE);
            initial_responses.push(InitialTermResponse { equation: None, samples, means: Rc::default() });
        }
        let mut linearization = Linearization {
            system: inverse,
            operators,
            response,
            basis,
            linear_effects: Vec::new(),
            input_means: nonlinearity_outputs,
            feedthrough,
            jump_correction,
            kink_correction,
        };
        linearization.linear_effects = self.linear_effects(experiment, cache, &linearization, point, linear)?;
        Ok(RestSimulation { linearization, residuals, initial_responses })
    }

    /// Return the integral operators of the terms, by equation.
    ///
    /// [`Error::NotSimulable`] if a term has a higher order than its equation permits.
    fn term_operators(
        &self,
        experiment: &Experiment,
        cache: &EvaluationCache,
        structures: &[Structure],
    ) -> Result<Vec<Vec<Rc<Operator>>>> {
        let mut operators = Vec::with_capacity(structures.len());
        for (i, structure) in structures.iter().enumerate() {
            let mut row = Vec::with_capacity(structure.terms.len());
            for (k, term) in structure.terms.iter().enumerate() {
                let eta = structure.order - term.order;
                let is_hold =
                    experiment.point_values.get(term.signal).is_some_and(|instant| instant.is_zero_order_hold);
                let min_eta = if term.signal == structure.output {
                    MIN_INTEGRATION_ORDER
                } else if is_hold {
                    // The derivative of a jump is infinite.
                    0.0
                } else {
                    MIN_INTEGRATION_ORDER - MAX_ORDER_EXCESS
                };
                if eta < min_eta {
                    // The optimizer shortens its step after this error.
                    return Err(Error::term_above_equation());
                }
                row.push(cache.operator((i, k), eta, self.depends_on_free_order(i, k)));
            }
            operators.push(row);
        }
        Ok(operators)
    }

    /// Return the pulse means of the simulation from zero initial conditions, and the inverse of the system matrix.
    fn rest_response(
        &self,
        experiment: &Experiment,
        cache: &mut EvaluationCache,
        operators: &[Vec<Rc<Operator>>],
        point: &ParameterPoint,
        nonlinearity_outputs: &[(Vec<f64>, Vec<f64>)],
    ) -> Result<(PulseMeans, Rc<SystemInverse>)> {
        let (record, n) = (&experiment.record, operators.len());
        let m = record.m();
        let coefficient = |i: usize, k: usize| self.equations[i].terms[k].2.at(&point.coefficients);
        let term_indices = || operators.iter().enumerate().flat_map(|(i, row)| (0..row.len()).map(move |k| (i, k)));
        let integer_orders: Option<Vec<usize>> =
            operators.iter().flatten().map(|operator| operator.integer_order()).collect();
        if let Some(orders) = integer_orders {
            let autoregressive_terms = term_indices().zip(&orders).filter_map(|((i, k), &order)| {
                let j = self.output_index(i, self.equations[i].terms[k].0)?;
                Some((i, j, order, coefficient(i, k)))
            });
            let max_order = orders.iter().copied().max().unwrap_or(0);
            let inverse = SystemInverse::from_running_sums(RunningSumSystem::new(
                n,
                max_order,
                record.step(),
                &autoregressive_terms.collect::<Vec<_>>(),
            )?);
            let mut response = vec![vec![0.0; m]; n];
            inverse.inverse()?.solve_each(
                (n, m),
                1,
                |_, right_hand_sides| {
                    for (i, k) in term_indices() {
                        let (signal, c) = (self.equations[i].terms[k].0, coefficient(i, k));
                        if self.output_index(i, signal).is_none() && c != 0.0 {
                            let eta = operators[i][k].eta();
                            let series =
                                || Cow::Borrowed(self.input_means(record, (signal, eta), nonlinearity_outputs));
                            right_hand_sides.add(i, c, (&operators[i][k], false), series, || {
                                cache.input_spectrum(self, experiment, (signal, eta), nonlinearity_outputs)
                            });
                        }
                    }
                    Ok(())
                },
                |_, means| {
                    means.into_iter().for_each(|means| response = means);
                    Ok(())
                },
            )?;
            return Ok((response, Rc::new(inverse)));
        }
        let mut rhs = vec![vec![0.0; m]; n];
        let mut sum = SumOfProducts::with_length(cache.total);
        let mut buffers = Buffers::default();
        let mut bits = Vec::new();
        for (i, row) in operators.iter().enumerate() {
            let mut has_input = false;
            for (k, operator) in row.iter().enumerate() {
                let (signal, c) = (self.equations[i].terms[k].0, coefficient(i, k));
                if self.output_index(i, signal).is_some() {
                    bits.extend([operator.eta().to_bits(), c.to_bits()]);
                } else if c != 0.0 {
                    has_input = true;
                    sum.add(
                        c,
                        &operator.spectrum(false),
                        &cache.input_spectrum(self, experiment, (signal, operator.eta()), nonlinearity_outputs),
                    );
                }
            }
            if has_input {
                sum.take(&mut rhs[i], &mut buffers);
            }
        }
        let inverse = cache.system_inverse(bits, || {
            let mut matrix = vec![vec![vec![0.0; cache.pulses()]; n]; n];
            for (i, row) in operators.iter().enumerate() {
                matrix[i][i][0] += 1.0;
                for (k, operator) in row.iter().enumerate() {
                    if let Some(j) = self.output_index(i, self.equations[i].terms[k].0) {
                        let c = coefficient(i, k);
                        matrix[i][j].iter_mut().zip(operator.kernel()).for_each(|(a, v)| *a -= c * v);
                    }
                }
            }
            SystemInverse::from_matrix(matrix)
        })?;
        let response = inverse.solve_by_division(&rhs)?;
        let response =
            response.ok_or_else(|| Error::Internal { what: "equations without a solution by division".into() })?;
        Ok((response, inverse))
    }

    /// Pulse means of the signal `signal` as a term of integration order `eta` uses them, after the input nonlinearity.
    pub(crate) fn input_means<'a>(
        &self,
        record: &'a Record,
        (signal, eta): (usize, f64),
        nonlinearity_outputs: &'a [(Vec<f64>, Vec<f64>)],
    ) -> &'a [f64] {
        self.law_of(signal).map_or_else(|| record.term_signal(signal, eta), |law| &nonlinearity_outputs[law].0)
    }

    /// Estimate the initial terms of an experiment by linear least squares, and append its residuals, initial terms and
    /// linearization to `out`.
    ///
    /// The estimates follow from a projection of the residuals on the responses to the initial terms.
    fn add_initial_terms(
        simulation: RestSimulation,
        equations: usize,
        out: &mut Evaluation<Linearization>,
    ) -> Result<()> {
        let RestSimulation { mut linearization, mut residuals, initial_responses } = simulation;
        let mut initial: Vec<Vec<f64>> = vec![Vec::new(); equations];
        if !initial_responses.is_empty() {
            let (equations_and_means, columns): (Vec<_>, Vec<_>) = initial_responses
                .into_iter()
                .map(|InitialTermResponse { equation, samples, means }| ((equation, means), samples))
                .unzip();
            let (values, _) = least_squares::solve(&columns, &residuals, 0)?;
            for (((i, means), column), x) in equations_and_means.iter().zip(&columns).zip(&values) {
                if let Some(i) = i {
                    initial[*i].push(*x);
                }
                residuals.iter_mut().zip(column).for_each(|(e, v)| *e -= x * v);
                for (total, contribution) in linearization.response.iter_mut().zip(means.iter()) {
                    total.iter_mut().zip(contribution).for_each(|(y, v)| *y += x * v);
                }
            }
        }
        out.residuals.extend(residuals);
        out.initial.push(initial);
        out.parts.push(linearization);
        Ok(())
    }

    /// Return true if the integration order of a term depends on a free order.
    fn depends_on_free_order(&self, equation_index: usize, term: usize) -> bool {
        let equation = &self.equations[equation_index];
        let order_weight = |weights: &[f64], k: usize| weights.get(k).copied().unwrap_or(0.0);
        (0..self.order_bounds.len())
            .any(|k| order_weight(&equation.order.weights, k) != order_weight(&equation.terms[term].1.weights, k))
    }
}

/// First `m` pulse means of every output.
fn truncate_means(means: &PulseMeans, m: usize) -> Cow<'_, [Vec<f64>]> {
    match means.iter().all(|row| row.len() == m) {
        true => Cow::Borrowed(means),
        false => means.iter().map(|row| row[..m.min(row.len())].to_vec()).collect::<Vec<_>>().into(),
    }
}

impl FreeModel {
    /// Indices of the coefficients that occur alone and only in terms of external inputs.
    pub(crate) fn linear_coefficients(&self) -> Vec<usize> {
        let occurs_in_input_terms_only = |j: usize| {
            let mut is_free = false;
            for (i, equation) in self.equations.iter().enumerate() {
                for (signal, _, monomial) in &equation.terms {
                    if monomial.powers.iter().any(|&(k, _)| k == j) {
                        if monomial.powers != [(j, 1)] || self.output_index(i, *signal).is_some() {
                            return false;
                        }
                        is_free = true;
                    }
                }
            }
            is_free
        };
        let is_scalable = |j: usize| matches!(self.coordinates[j], Coordinate::Plain | Coordinate::Logarithm);
        (0..self.coordinates.len()).filter(|&j| is_scalable(j) && occurs_in_input_terms_only(j)).collect()
    }

    /// Return the effect of each of the given input coefficients on an experiment.
    pub(crate) fn linear_effects(
        &self,
        experiment: &Experiment,
        cache: &mut EvaluationCache,
        linearization: &Linearization,
        point: &ParameterPoint,
        coefficients: &[usize],
    ) -> Result<Vec<ParameterEffect>> {
        if coefficients.is_empty() {
            return Ok(Vec::new());
        }
        let (record, n) = (&experiment.record, self.equations.len());
        let mut effects = Vec::with_capacity(coefficients.len());
        linearization.system.inverse()?.solve_each(
            (n, record.m()),
            coefficients.len(),
            |index, right_hand_sides| {
                cache.stop.check()?;
                for (i, equation) in self.equations.iter().enumerate() {
                    for (k, (signal, _, monomial)) in equation.terms.iter().enumerate() {
                        let weight = monomial.slope(&point.coefficients, coefficients[index]);
                        if weight != 0.0 {
                            let eta = linearization.operators[i][k].eta();
                            let series =
                                || Cow::Borrowed(self.input_means(record, (*signal, eta), &linearization.input_means));
                            right_hand_sides.add(i, weight, (&linearization.operators[i][k], false), series, || {
                                cache.input_spectrum(self, experiment, (*signal, eta), &linearization.input_means)
                            });
                        }
                    }
                }
                Ok(())
            },
            |index, means| {
                let parameter = point.orders.len() + coefficients[index];
                let means = means.unwrap_or_else(|| vec![vec![0.0; record.m()]; n]);
                let effect = linearization.parameter_effect(parameter, means, (self, experiment, point))?;
                if let Some(index) = effect.samples.iter().position(|v| !v.is_finite()) {
                    return Err(Error::Diverged { what: "simulation".into(), index });
                }
                effects.push(effect);
                Ok(())
            },
        )?;
        Ok(effects)
    }
}

/// Intermediate results of the simulation of one experiment, for its sensitivities.
pub(crate) struct Linearization {
    /// Inverse of the system matrix.
    pub(crate) system: Rc<SystemInverse>,
    /// Operators of the terms, by equation.
    pub(crate) operators: Vec<Vec<Rc<Operator>>>,
    /// Pulse means of the simulated outputs, including the initial terms.
    pub(crate) response: Vec<Vec<f64>>,
    /// Orthonormal basis of the weighted responses to the initial terms at the compared samples.
    pub(crate) basis: Vec<Vec<f64>>,
    /// Effects of the linear coefficients.
    pub(crate) linear_effects: Vec<ParameterEffect>,
    /// Pulse means of each input after its nonlinearity, and their derivative with respect to the input parameter.
    pub(crate) input_means: Vec<(Vec<f64>, Vec<f64>)>,
    /// Direct feedthrough; None if no term has it.
    pub(crate) feedthrough: Option<Feedthrough>,
    /// Correction for jumps of the inputs at the samples.
    pub(crate) jump_correction: JumpCorrection,
    /// Kink correction; None for uniform samples.
    pub(crate) kink_correction: Option<KinkCorrection>,
}

impl Linearization {
    /// Effect of a parameter on the weighted samples, from its effect on the pulse means.
    ///
    /// Parameters are numbered in the sequence orders, coefficients, input parameters.
    pub(crate) fn parameter_effect(
        &self,
        parameter: usize,
        means: Vec<Vec<f64>>,
        (model, experiment, point): (&FreeModel, &Experiment, &ParameterPoint),
    ) -> Result<ParameterEffect> {
        let mut samples = experiment.weighted_samples(&means);
        self.jump_correction.correct_slope(model, experiment, point, parameter, &mut samples)?;
        if let Some(feedthrough) = &self.feedthrough {
            add_feedthrough_derivative(model, experiment, feedthrough, point, parameter, &mut samples);
        }
        if let Some(kink_correction) = &self.kink_correction {
            kink_correction.add_slope(model, experiment, self.feedthrough.as_ref(), point, parameter, &mut samples);
        }
        Ok(ParameterEffect { samples, means })
    }
}

/// Effect of a change of a parameter by 1 on an experiment.
pub(crate) struct ParameterEffect {
    /// Change of the weighted samples.
    pub(crate) samples: Vec<f64>,
    /// Change of the pulse means of each output; empty after [`ParameterEffect::apply`].
    pub(crate) means: Vec<Vec<f64>>,
}

impl ParameterEffect {
    /// Apply the change `change` of the parameter to residuals and pulse means.
    pub(crate) fn apply(&mut self, change: f64, residuals: &mut [f64], response: &mut [Vec<f64>]) {
        if change != 0.0 {
            residuals.iter_mut().zip(&self.samples).for_each(|(e, v)| *e -= change * v);
            for (total, contribution) in response.iter_mut().zip(&self.means) {
                total.iter_mut().zip(contribution).for_each(|(y, v)| *y += change * v);
            }
        }
        self.means = Vec::new();
    }
}
