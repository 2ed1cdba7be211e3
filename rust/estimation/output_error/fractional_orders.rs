//! Exact output samples of equations of any orders, and their derivatives.
//!
//! The equation is y = Σ c s^−η u/D, with D = 1 − Σ c s^−η. The first sum is over the terms of the inputs u, the second
//! over the terms of the output y. Each term has a coefficient c and an integration order η. A zero-order-hold input is
//! a sum of steps. The starred transform of the samples of y is therefore that of c s^−η/(D s) times the transform of
//! the jumps of the input. An initial term c t^e adds c Γ(e + 1) s^−(e + 1)/D. Derivatives with respect to orders and
//! coefficients are functions of s as well. A sample at a jump is the mean of both sides; [`Feedthrough`] corrects it.

use std::collections::HashMap;
use std::ops::Range;
use std::rc::Rc;

use super::evaluation::{append, Evaluation, RANK_TOLERANCE};
use super::experiment::Experiment;
use super::feedthrough::{add_feedthrough_derivative, Feedthrough, FEEDTHROUGH_ORDER_TOLERANCE};
use super::jacobian::initial_exponent_slopes;
use super::parameterization::{FreeModel, Monomial, ParameterPoint};
use super::residuals::MIN_INTEGRATION_ORDER;
use crate::equation::AffineOrder;
use crate::error::{Error, Result};
use crate::fft::Bin;
use crate::fractional::kernels::digamma;
use crate::fractional::starred_transform::{LaplacePoint, StarredTransform};
use crate::linalg::orthogonal::{extend_orthonormal, project_out};

/// Minimum number of pulses for exact samples. For shorter experiments, block pulses are faster.
pub(crate) const MIN_EXACT_PULSES: usize = 1 << 12;

/// Maximum memory of the transforms that are computed together \[bytes\].
///
/// Transforms that are computed together share the powers of s. On long records, they would take most of the memory.
const MAX_BATCH_BYTES: usize = 1 << 25;

/// Equations of any orders with zero-order-hold inputs, on experiments with uniform samples.
pub(crate) struct FractionalOrders {
    runs: Vec<Run>,
}

/// Transforms of one experiment.
struct Run {
    transform: Rc<StarredTransform>,
    /// Transforms of the jumps of the inputs, by signal.
    jumps: HashMap<usize, Vec<Bin>>,
}

/// Effects of the eliminated coefficients and of the initial terms on the weighted samples of an experiment.
pub(crate) struct SampledSimulation {
    /// Orthonormal basis of the weighted responses to the initial terms.
    pub(crate) basis: Vec<Vec<f64>>,
    /// Change of the weighted samples per unit of each linear coefficient.
    pub(crate) effects: Vec<Vec<f64>>,
}

/// Difference of an integration order from an integer, or of two fractional parts, below which they count as equal.
const WHOLE_ORDER_TOLERANCE: f64 = 1e-14;

/// Distinct integration orders η. Each is n + φ, with an integer n and a fractional part φ in [0, 1).
///
/// The orders of an equation often differ by integers. Therefore s^−φ is computed once per distinct φ, and multiplied by
/// s^−n.
#[derive(Default)]
struct IntegrationOrders {
    etas: Vec<f64>,
    /// Integer part of each order, and the index of its fractional part; None if the fractional part is 0.
    parts: Vec<(u32, Option<usize>)>,
    fractions: Vec<f64>,
}

impl IntegrationOrders {
    /// Return the index of an order, which is added if it is new.
    fn index(&mut self, eta: f64) -> usize {
        if let Some(index) = self.etas.iter().position(|e| e.to_bits() == eta.to_bits()) {
            return index;
        }
        let is_close = |a: f64, b: f64| (a - b).abs() < WHOLE_ORDER_TOLERANCE;
        let (whole, fraction) =
            if is_close(eta, eta.round()) { (eta.round(), 0.0) } else { (eta.floor(), eta.fract()) };
        let existing = self.fractions.iter().position(|&f| is_close(f, fraction));
        let fraction_index = (fraction > 0.0).then(|| {
            existing.unwrap_or_else(|| {
                self.fractions.push(fraction);
                self.fractions.len() - 1
            })
        });
        self.etas.push(eta);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        self.parts.push((whole as u32, fraction_index));
        self.etas.len() - 1
    }

    /// Write s^−η of each order to `powers`.
    fn powers(&self, point: LaplacePoint, powers: &mut Vec<Bin>) {
        powers.clear();
        // The powers of the fractional parts come first and are removed at the end.
        powers.extend(self.fractions.iter().map(|&fraction| point.integration(fraction)));
        let reciprocal = point.s.inv();
        for &(whole, fraction) in &self.parts {
            let mut power = fraction.map_or(Bin::from(1.0), |fraction_index| powers[fraction_index]);
            (0..whole).for_each(|_| power *= reciprocal);
            powers.push(power);
        }
        powers.drain(..self.fractions.len());
    }
}

/// Terms of an equation at a parameter point.
struct Terms {
    /// Distinct integration orders η of the terms.
    orders: IntegrationOrders,
    /// Index of the integration order of each term in `orders`.
    eta_indices: Vec<usize>,
    coefficients: Vec<f64>,
    /// Input signal of each term; None for a term of the output itself.
    inputs: Vec<Option<usize>>,
}

/// Derivatives of the coefficient and of the integration order of each term with respect to one parameter.
type Slopes = Vec<(f64, f64)>;

/// Sum Σ (w − v ln s) s^−η over integration orders η, with weights w and v.
struct PowerSum {
    /// Index of the integration order and w, without zeros.
    terms: Vec<(usize, f64)>,
    /// Index of the integration order and v, without zeros.
    logarithmic: Vec<(usize, f64)>,
}

impl PowerSum {
    /// Return the sum at a point. `powers` contains s^−η of each integration order.
    fn value_at(&self, logarithm: Bin, powers: &[Bin]) -> Bin {
        let sum = |terms: &[(usize, f64)]| {
            terms.iter().fold(Bin::default(), |sum, &(index, weight)| sum + powers[index] * weight)
        };
        let power_sum = sum(&self.terms);
        if self.logarithmic.is_empty() {
            power_sum
        } else {
            power_sum - logarithm * sum(&self.logarithmic)
        }
    }

    fn is_zero(&self) -> bool {
        self.terms.is_empty() && self.logarithmic.is_empty()
    }
}

impl Terms {
    fn new(model: &FreeModel, i: usize, point: &ParameterPoint) -> Result<Self> {
        let structure = &model.structures(&point.orders)[i];
        let mut terms = Self {
            orders: IntegrationOrders::default(),
            eta_indices: Vec::new(),
            coefficients: Vec::new(),
            inputs: Vec::new(),
        };
        for (k, term) in structure.terms.iter().enumerate() {
            let eta = structure.order - term.order;
            let is_autoregressive = model.output_index(i, term.signal).is_some();
            if eta < if is_autoregressive { MIN_INTEGRATION_ORDER } else { 0.0 } {
                // The optimizer shortens its step after this error.
                return Err(Error::term_above_equation());
            }
            let index = terms.orders.index(eta);
            terms.eta_indices.push(index);
            terms.coefficients.push(model.equations[i].terms[k].2.at(&point.coefficients));
            terms.inputs.push((!is_autoregressive).then_some(term.signal));
        }
        Ok(terms)
    }

    /// Distinct input signals in ascending order.
    fn signals(&self) -> Vec<usize> {
        let mut signal_indices: Vec<usize> = self.inputs.iter().flatten().copied().collect();
        signal_indices.sort_unstable();
        signal_indices.dedup();
        signal_indices
    }

    /// Return Σ (w − v ln s) s^−η over the terms of `input`, or of the output itself if `input` is None.
    ///
    /// `weights` returns the pair (w, v) of a term.
    fn sum(&self, input: Option<usize>, weights: impl Fn(usize) -> (f64, f64)) -> PowerSum {
        let terms_of_input = || (0..self.eta_indices.len()).filter(|&k| self.inputs[k] == input);
        let nonzero = |weight_of_term: &dyn Fn(usize) -> f64| {
            terms_of_input()
                .map(|k| (self.eta_indices[k], weight_of_term(k)))
                .filter(|(_, weight)| *weight != 0.0)
                .collect()
        };
        PowerSum { terms: nonzero(&|k| weights(k).0), logarithmic: nonzero(&|k| weights(k).1) }
    }

    /// Return Σ c s^−η over the terms of `input`, or of the output itself if `input` is None.
    fn sum_of_coefficients(&self, input: Option<usize>) -> PowerSum {
        self.sum(input, |k| (self.coefficients[k], 0.0))
    }

    /// Return half of the jump of the step response at t = 0. `weights` returns the weight of a term of the input.
    fn initial_jump(&self, input: usize, weights: impl Fn(usize) -> f64) -> f64 {
        let has_feedthrough = |k: &usize| {
            self.inputs[*k] == Some(input) && self.orders.etas[self.eta_indices[*k]] < FEEDTHROUGH_ORDER_TOLERANCE
        };
        0.5 * (0..self.eta_indices.len()).filter(has_feedthrough).map(weights).sum::<f64>()
    }
}

/// Initial terms c t^e of one equation, which have the Laplace transforms c Γ(e + 1) s^−(e + 1).
struct InitialTerms {
    /// e + 1, c Γ(e + 1) and the digamma function ψ(e + 1) of each term, which do not depend on s.
    terms: Vec<(f64, f64, f64)>,
}

impl InitialTerms {
    fn new(exponents: &[f64], values: &[f64]) -> Self {
        let term_constants = |(e, c): (&f64, &f64)| (e + 1.0, c * libm::tgamma(e + 1.0), digamma(e + 1.0));
        Self { terms: exponents.iter().zip(values).map(term_constants).collect() }
    }

    /// Write the Laplace transform of each term to `out`, and return the sum of the transforms.
    fn transforms(&self, point: LaplacePoint, out: &mut Vec<Bin>) -> Bin {
        out.clear();
        out.extend(self.terms.iter().map(|&(power, weight, _)| point.integration(power) * weight));
        out.iter().sum()
    }

    /// Return the derivative of the sum of the transforms. `slopes` contains the derivatives of the exponents.
    fn slope(&self, logarithm: Bin, transforms: &[Bin], slopes: &[f64]) -> Bin {
        let parts = self.terms.iter().zip(transforms).zip(slopes).filter(|(_, slope)| **slope != 0.0);
        parts.map(|((term, transform), slope)| transform * (Bin::from(term.2) - logarithm) * slope).sum()
    }
}

impl FractionalOrders {
    /// Return true if a model has exact samples on every experiment.
    ///
    /// This requires stable equations without coupling, and zero-order-hold inputs without free parameters. The records
    /// must be long, with uniform samples and without a sensor filter.
    pub(crate) fn accepts(model: &FreeModel, experiments: &[Experiment], point: &ParameterPoint) -> bool {
        let is_suitable = |experiment: &Experiment| {
            experiment.record.m() >= MIN_EXACT_PULSES
                && experiment.nonuniform.is_none()
                && experiment.filter.is_none()
                && !experiment.record.is_filtered()
                && model.equations.iter().enumerate().all(|(i, equation)| {
                    equation.terms.iter().all(|(signal, _, _)| {
                        model.output_index(i, *signal).map_or_else(
                            || experiment.point_values.get(*signal).is_some_and(|values| values.is_zero_order_hold),
                            |j| j == i,
                        )
                    })
                })
        };
        (!model.coupled || model.equations.len() == 1)
            && model.inputs.is_empty()
            && experiments.iter().all(is_suitable)
            && !model.is_unstable(point)
    }

    /// Return the transforms of the experiments; None if the model has no exact samples on them.
    pub(crate) fn new(model: &FreeModel, experiments: &[Experiment], point: &ParameterPoint) -> Option<Self> {
        if !Self::accepts(model, experiments, point) {
            return None;
        }
        let mut transforms: HashMap<(usize, u64), Rc<StarredTransform>> = HashMap::new();
        let run = |experiment: &Experiment| {
            let record = &experiment.record;
            let (m, step) = (record.m(), record.step());
            let make_transform = || Rc::new(StarredTransform::new(m, step));
            let transform = transforms.entry((m, step.to_bits())).or_insert_with(make_transform).clone();
            let terms = model.equations.iter().enumerate().flat_map(|(i, e)| e.terms.iter().map(move |t| (i, t.0)));
            let inputs = terms.filter(|&(i, signal)| model.output_index(i, signal).is_none());
            let spectrum = |signal: usize| {
                let means = record.signal(signal);
                let jumps = means.iter().zip(std::iter::once(&0.0).chain(means)).map(|(mean, before)| mean - before);
                transform.transform(jumps)
            };
            let mut jumps = HashMap::new();
            inputs.for_each(|(_, signal)| {
                jumps.entry(signal).or_insert_with(|| spectrum(signal));
            });
            Run { transform: transform.clone(), jumps }
        };
        Some(Self { runs: experiments.iter().map(run).collect() })
    }

    /// Return the residuals at a point, with the `linear` coefficients and the initial terms eliminated.
    ///
    /// [`Error::Diverged`] if the model is unstable or its simulation is not finite.
    pub(crate) fn evaluate(
        &self,
        model: &FreeModel,
        experiments: &[Experiment],
        point: &ParameterPoint,
        linear: &[usize],
    ) -> Result<Evaluation<SampledSimulation>> {
        if model.is_unstable(point) {
            // The damping e^{−σt} of the transform does not bound the response of an unstable model.
            return Err(Error::Diverged { what: "simulation".into(), index: 0 });
        }
        let structures = model.structures(&point.orders);
        let mut out = Evaluation::empty(point.clone());
        let (mut residuals, mut columns) = (Vec::new(), Vec::new());
        for (run, experiment) in self.runs.iter().zip(experiments) {
            out.exponents = structures.iter().enumerate().map(|(i, s)| model.exponents(experiment, i, s)).collect();
            let mut remainders = experiment.measured_samples();
            out.measured_norm = out.measured_norm.hypot(remainders.iter().map(|v| v * v).sum::<f64>().sqrt());
            let feedthrough = Feedthrough::new(model, experiment, &structures, point, &[])?;
            let mut simulation = SampledSimulation { basis: Vec::new(), effects: Vec::new() };
            let mut initial = Vec::new();
            let sample_count = remainders.len();
            simulation.effects.resize(linear.len(), vec![0.0; sample_count]);
            for i in 0..structures.len() {
                let terms = Terms::new(model, i, point)?;
                let mut weight_sets = vec![terms.coefficients.clone()];
                weight_sets.extend(linear.iter().map(|&j| {
                    let slope = |k: usize| model.equations[i].terms[k].2.slope(&point.coefficients, j);
                    (0..terms.eta_indices.len()).map(slope).collect()
                }));
                let (basis, effects) = (&mut simulation.basis, &mut simulation.effects);
                run.responses(experiment, &terms, &weight_sets, &out.exponents[i], |column, samples| {
                    match (column, column.checked_sub(1 + linear.len())) {
                        (0, _) => add_weighted(experiment, i, -1.0, &samples, &mut remainders),
                        (column, None) => add_weighted(experiment, i, 1.0, &samples, &mut effects[column - 1]),
                        (_, Some(_)) => {
                            let mut unit_response = vec![0.0; sample_count];
                            add_weighted(experiment, i, 1.0, &samples, &mut unit_response);
                            extend_orthonormal(basis, unit_response.clone(), RANK_TOLERANCE);
                            initial.push((Some(i), unit_response));
                        }
                    }
                });
            }
            if let Some(feedthrough) = &feedthrough {
                remainders.iter_mut().zip(feedthrough.weighted_correction(experiment)).for_each(|(e, v)| *e -= v);
                for (&j, effect) in linear.iter().zip(&mut simulation.effects) {
                    add_feedthrough_derivative(model, experiment, feedthrough, point, point.orders.len() + j, effect);
                }
            }
            if let Some(index) = remainders.iter().position(|e| !e.is_finite()) {
                return Err(Error::Diverged { what: "simulation".into(), index });
            }
            for i in 0..if model.initial.has_level() { structures.len() } else { 0 } {
                let mut column = vec![0.0; sample_count];
                add_weighted(experiment, i, 1.0, &vec![1.0; experiment.compared_count()], &mut column);
                extend_orthonormal(&mut simulation.basis, column.clone(), RANK_TOLERANCE);
                initial.push((None, column));
            }
            residuals.push(remainders);
            columns.push(initial);
            out.parts.push(simulation);
        }
        out.eliminate(linear, structures.len(), residuals, columns, |part| (&part.basis[..], &part.effects[..]))?;
        Ok(out)
    }

    /// Derivatives of the residuals, one row per parameter, with the initial terms projected out.
    pub(crate) fn jacobian(
        &self,
        model: &FreeModel,
        experiments: &[Experiment],
        linear: &[usize],
        evaluation: &Evaluation<SampledSimulation>,
    ) -> Result<Vec<Vec<f64>>> {
        let point = &evaluation.point;
        let orders = point.orders.len();
        let count = orders + point.coefficients.len();
        let structures = model.structures(&point.orders);
        let parameters: Vec<usize> =
            (0..count).filter(|p| !p.checked_sub(orders).is_some_and(|j| linear.contains(&j))).collect();
        let mut jacobian = vec![Vec::new(); count];
        for (index, (run, experiment)) in self.runs.iter().zip(experiments).enumerate() {
            let mut columns = vec![vec![0.0; structures.len() * experiment.compared_count()]; count];
            for (&j, effect) in linear.iter().zip(&evaluation.parts[index].effects) {
                columns[orders + j].clone_from(effect);
            }
            for (i, structure) in structures.iter().enumerate() {
                let terms = Terms::new(model, i, point)?;
                let exponents = model.exponents(experiment, i, structure);
                let initial = InitialTerms::new(&exponents, &evaluation.initial[index][i]);
                let requests: Vec<(Slopes, Vec<f64>)> = parameters
                    .iter()
                    .map(|&p| {
                        let initial_slopes = if p < orders {
                            initial_exponent_slopes(model, (i, p), &point.orders, initial.terms.len(), experiment)
                        } else {
                            None
                        };
                        (term_slopes(model, i, point, p), initial_slopes.unwrap_or_default())
                    })
                    .collect();
                run.sensitivities(experiment, &terms, &initial, &requests, |request, samples| {
                    add_weighted(experiment, i, 1.0, &samples, &mut columns[parameters[request]]);
                });
            }
            if let Some(feedthrough) = Feedthrough::new(model, experiment, &structures, point, &[])? {
                for &parameter in &parameters {
                    add_feedthrough_derivative(
                        model,
                        experiment,
                        &feedthrough,
                        point,
                        parameter,
                        &mut columns[parameter],
                    );
                }
            }
            for (mut column, out) in columns.into_iter().zip(&mut jacobian) {
                project_out(&evaluation.parts[index].basis, &mut column);
                if column.iter().any(|v| !v.is_finite()) {
                    return Err(Error::Diverged { what: "sensitivity of the simulation".into(), index: 0 });
                }
                // Residuals are measured minus simulated samples.
                column.iter_mut().for_each(|v| *v = -*v);
                append(out, column);
            }
        }
        Ok(jacobian)
    }
}

/// Add `sign` times the weighted `samples` of equation `i` to `sum`, the weighted samples of all equations.
fn add_weighted(experiment: &Experiment, i: usize, sign: f64, samples: &[f64], sum: &mut [f64]) {
    let count = experiment.compared_count();
    let equation_samples = sum[i * count..(i + 1) * count].iter_mut();
    equation_samples.zip(experiment.weights_of(i).zip(samples)).for_each(|(v, (w, y))| *v += sign * w * y);
}

/// Return the derivatives of the coefficient and the integration order of each term of equation `i`.
///
/// They are derivatives with respect to `parameter`.
fn term_slopes(model: &FreeModel, i: usize, point: &ParameterPoint, parameter: usize) -> Slopes {
    let equation = &model.equations[i];
    let order_weight = |law: &AffineOrder| law.weights.get(parameter).copied().unwrap_or(0.0);
    let slope = |(_, order, monomial): &(usize, AffineOrder, Monomial)| match parameter.checked_sub(point.orders.len())
    {
        Some(j) => (monomial.slope(&point.coefficients, j), 0.0),
        None => (0.0, order_weight(&equation.order) - order_weight(order)),
    };
    equation.terms.iter().map(slope).collect()
}

impl Run {
    /// Call `emit` with the responses of one equation at the compared samples.
    ///
    /// Column i is the response from zero initial conditions for the list of coefficients `weight_sets[i]`, unless it is
    /// zero. The responses to the initial terms t^e with e in `exponents` are the next columns.
    fn responses(
        &self,
        experiment: &Experiment,
        terms: &Terms,
        weight_sets: &[Vec<f64>],
        exponents: &[f64],
        emit: impl FnMut(usize, Vec<f64>),
    ) {
        let (mut functions, mut sums, mut initial_jumps) = (Vec::new(), Vec::new(), Vec::new());
        for (set_index, weights) in weight_sets.iter().enumerate() {
            for input in terms.signals() {
                let sum = terms.sum(Some(input), |k| (weights[k], 0.0));
                if !sum.is_zero() {
                    functions.push((set_index, Some(input)));
                    sums.push(sum);
                    initial_jumps.push(terms.initial_jump(input, |k| weights[k]));
                }
            }
        }
        functions.extend((0..exponents.len()).map(|k| (weight_sets.len() + k, None)));
        initial_jumps.resize(functions.len(), 0.0);
        let denominator_terms = terms.sum_of_coefficients(None);
        let mut powers = Vec::new();
        let units: Vec<f64> = exponents.iter().map(|e| libm::tgamma(e + 1.0)).collect();
        let transforms = |point: LaplacePoint, range: Range<usize>, values: &mut [Bin]| {
            terms.orders.powers(point, &mut powers);
            let response = (Bin::from(1.0) - denominator_terms.value_at(point.logarithm, &powers)).inv();
            let hold_response = response / point.s;
            for (value, index) in values.iter_mut().zip(range) {
                *value = match index.checked_sub(sums.len()) {
                    None => sums[index].value_at(point.logarithm, &powers) * hold_response,
                    Some(k) => response * point.integration(exponents[k] + 1.0) * units[k],
                };
            }
        };
        self.columns(experiment, &functions, &initial_jumps, transforms, emit);
    }

    /// Call `emit` with the derivatives of the compared samples of an equation, one column per request.
    ///
    /// A request contains the derivatives of the terms and of the initial exponents with respect to one parameter. A
    /// column of zeros is omitted.
    fn sensitivities(
        &self,
        experiment: &Experiment,
        terms: &Terms,
        initial: &InitialTerms,
        requests: &[(Slopes, Vec<f64>)],
        emit: impl FnMut(usize, Vec<f64>),
    ) {
        let derivative = |request: usize, input: Option<usize>| {
            let slopes: &Slopes = &requests[request].0;
            terms.sum(input, |k| (slopes[k].0, terms.coefficients[k] * slopes[k].1))
        };
        let signals = terms.signals();
        let denominators: Vec<PowerSum> = (0..requests.len()).map(|request| derivative(request, None)).collect();
        // The index of a request, the index of an input in `signals`, and the derivative of the numerator for it.
        let mut functions: Vec<(usize, Option<usize>, PowerSum)> = Vec::new();
        for (request, (_, initial_slopes)) in requests.iter().enumerate() {
            for (index, &signal) in signals.iter().enumerate() {
                let numerator = derivative(request, Some(signal));
                if !(denominators[request].is_zero() && numerator.is_zero()) {
                    functions.push((request, Some(index), numerator));
                }
            }
            let has_effect = !denominators[request].is_zero() || initial_slopes.iter().any(|v| *v != 0.0);
            if !initial.terms.is_empty() && has_effect {
                functions.push((request, None, PowerSum { terms: Vec::new(), logarithmic: Vec::new() }));
            }
        }
        let start = |(request, index, _): &(usize, Option<usize>, PowerSum)| {
            index.map_or(0.0, |index| terms.initial_jump(signals[index], |k| requests[*request].0[k].0))
        };
        let initial_jumps: Vec<f64> = functions.iter().map(start).collect();
        let denominator_terms = terms.sum_of_coefficients(None);
        let numerators: Vec<PowerSum> = signals.iter().map(|&signal| terms.sum_of_coefficients(Some(signal))).collect();
        let (mut powers, mut transforms) = (Vec::new(), Vec::new());
        let (mut input_responses, mut denominator_changes) =
            (vec![Bin::default(); numerators.len()], vec![Bin::default(); requests.len()]);
        let values_at = |point: LaplacePoint, range: Range<usize>, values: &mut [Bin]| {
            let logarithm = point.logarithm;
            terms.orders.powers(point, &mut powers);
            let response = (Bin::from(1.0) - denominator_terms.value_at(logarithm, &powers)).inv();
            let hold_response = response / point.s;
            let initial_response = initial.transforms(point, &mut transforms) * response;
            for (value, sum) in input_responses.iter_mut().zip(&numerators) {
                *value = sum.value_at(logarithm, &powers) * hold_response;
            }
            for (value, sum) in denominator_changes.iter_mut().zip(&denominators) {
                *value = sum.value_at(logarithm, &powers) * response;
            }
            for (value, (request, index, numerator)) in values.iter_mut().zip(&functions[range]) {
                *value = match index {
                    Some(index) => {
                        input_responses[*index] * denominator_changes[*request]
                            + numerator.value_at(logarithm, &powers) * hold_response
                    }
                    None => {
                        let initial_slope = initial.slope(logarithm, &transforms, &requests[*request].1);
                        initial_response * denominator_changes[*request] + initial_slope * response
                    }
                };
            }
        };
        let columns: Vec<(usize, Option<usize>)> =
            functions.iter().map(|(request, index, _)| (*request, index.map(|index| signals[index]))).collect();
        self.columns(experiment, &columns, &initial_jumps, values_at, emit);
    }

    /// Call `emit` with columns of compared samples.
    ///
    /// A column is the inverse transform of the sum of the adjacent `functions` with the same index. A function with an
    /// input is multiplied by the transform of the jumps of that input. A function without an input is the response to
    /// initial terms. `values_at(s, range, out)` writes the Laplace transforms of the functions `range` at s to `out`,
    /// and `starts` contains their values at t = 0.
    fn columns(
        &self,
        experiment: &Experiment,
        functions: &[(usize, Option<usize>)],
        starts: &[f64],
        mut values_at: impl FnMut(LaplacePoint, Range<usize>, &mut [Bin]),
        mut emit: impl FnMut(usize, Vec<f64>),
    ) {
        let batch_size = (MAX_BATCH_BYTES / (self.transform.bins() * size_of::<Bin>())).max(1);
        let mut last_sum: Option<(usize, Vec<Bin>)> = None;
        for first in (0..functions.len()).step_by(batch_size) {
            let range = first..functions.len().min(first + batch_size);
            let spectra =
                self.transform.spectra(&starts[range.clone()], |point, values| values_at(point, range.clone(), values));
            for (&(column, input), mut spectrum) in functions[range].iter().zip(spectra) {
                if let Some(jumps) = input.and_then(|input| self.jumps.get(&input)) {
                    spectrum.iter_mut().zip(jumps).for_each(|(v, jump)| *v *= jump);
                }
                match &mut last_sum {
                    Some((last, sum)) if *last == column => {
                        sum.iter_mut().zip(spectrum).for_each(|(sum, v)| *sum += v);
                    }
                    _ => {
                        if let Some((last, sum)) = last_sum.replace((column, spectrum)) {
                            emit(last, self.compared_samples(experiment, sum));
                        }
                    }
                }
            }
        }
        if let Some((last, sum)) = last_sum {
            emit(last, self.compared_samples(experiment, sum));
        }
    }

    /// Return the compared samples of the function whose transform is `spectrum`.
    fn compared_samples(&self, experiment: &Experiment, spectrum: Vec<Bin>) -> Vec<f64> {
        let pulses_per_sample = experiment.pulses_per_sample;
        let samples = self.transform.samples(spectrum);
        samples
            .into_iter()
            .skip(pulses_per_sample)
            .step_by(pulses_per_sample)
            .take(experiment.compared_count())
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::evaluation_cache::EvaluationCache;
    use super::super::integer_orders::IntegerOrders;
    use super::super::parameterization::{Coordinate, FreeEquation};
    use super::*;
    use crate::equation::Initial;
    use crate::parallel::Stop;
    use crate::recording::{Channel, Recording, Role, Sampling};
    use crate::signal::block_pulse::Intersample;

    const STEP: f64 = 0.02;

    /// Model D^α y = a1 D^ν y + a0 y + b1 D^ν u + b0 u + c D^α v with free α between `bounds`, and ν = `order`.
    fn model(bounds: (f64, f64), order: f64, initial: Initial) -> FreeModel {
        let fixed_order = |constant: f64| AffineOrder { constant, weights: vec![0.0] };
        let highest = || AffineOrder { constant: 0.0, weights: vec![1.0] };
        let orders = [
            (0, fixed_order(order)),
            (0, fixed_order(0.0)),
            (1, fixed_order(order)),
            (1, fixed_order(0.0)),
            (2, highest()),
        ];
        let single_coefficient = |k: usize| Monomial { factor: 1.0, powers: vec![(k, 1)] };
        let terms =
            orders.into_iter().enumerate().map(|(k, (signal, order))| (signal, order, single_coefficient(k))).collect();
        FreeModel {
            equations: vec![FreeEquation { output: 0, order: highest(), terms }],
            order_bounds: vec![bounds],
            coordinates: vec![Coordinate::Plain; 5],
            inputs: Vec::new(),
            coupled: false,
            priors: Vec::new(),
            initial,
        }
    }

    #[allow(clippy::cast_precision_loss)]
    fn experiment(pulses_per_sample: usize) -> Result<Experiment> {
        let rows = MIN_EXACT_PULSES + 2;
        let hold_samples = |interval: usize, seed: usize| -> Vec<f64> {
            (0..rows).map(|k| ((k / interval * 7919 + seed) % 11) as f64 / 5.0 - 1.0).collect()
        };
        let y = (0..rows).map(|k| (0.1 * k as f64).cos()).collect();
        let input = |name: &str, samples| Channel::new(name, samples, Role::Input(Intersample::Hold));
        let channels =
            vec![Channel::new("y", y, Role::Output), input("u", hold_samples(9, 1)), input("v", hold_samples(23, 5))];
        let run = Recording::new("run", STEP, None, channels, vec![0])?;
        run.experiment(Sampling { pulses_per_sample, ..Sampling::default() })?.with_weights(&[2.0], None)
    }

    fn point(order: f64) -> ParameterPoint {
        ParameterPoint { orders: vec![order], coefficients: vec![-0.8, -9.0, 0.5, 7.0, 0.3], inputs: Vec::new() }
    }

    /// Return the value, or an error if it is None.
    fn require<T>(value: Option<T>) -> Result<T> {
        value.ok_or_else(|| Error::Diverged { what: "experiments without exact samples".into(), index: 0 })
    }

    /// Return the largest difference, divided by the largest magnitude in `exact`.
    fn distance(actual: &[f64], exact: &[f64]) -> f64 {
        assert_eq!(actual.len(), exact.len());
        let peak = exact.iter().fold(0.0, |peak: f64, v| peak.max(v.abs()));
        actual.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max) / peak
    }

    #[test]
    fn orders_that_differ_by_whole_numbers_share_one_power() {
        let mut orders = IntegrationOrders::default();
        let etas = [1.7, 0.7, 3.7, 0.3, 2.0, 0.0, 1.0 - 1e-9, 0.7];
        let indices: Vec<usize> = etas.iter().map(|&eta| orders.index(eta)).collect();
        assert_eq!(indices, [0, 1, 2, 3, 4, 5, 6, 1]);
        assert_eq!(orders.fractions.len(), 3);
        let laplace_point = LaplacePoint::new(Bin::new(0.3, 40.0));
        let mut powers = Vec::new();
        orders.powers(laplace_point, &mut powers);
        assert_eq!(powers.len(), 7);
        for (power, eta) in powers.iter().zip(etas) {
            let expected = laplace_point.integration(eta);
            assert!((power - expected).norm() < 1e-13 * expected.norm(), "{eta}: {power} and {expected}");
        }
    }

    #[test]
    fn integer_orders_match_the_state_space_samples_and_derivatives() -> Result<()> {
        let (experiments, point) = ([experiment(1)?], point(2.0));
        for initial in [Initial::Rest, Initial::Caputo] {
            let model = model((2.0, 2.0), 1.0, initial);
            let orders = require(FractionalOrders::new(&model, &experiments, &point))?;
            let states = require(IntegerOrders::new(&model, &experiments, &point))?;
            let samples = orders.evaluate(&model, &experiments, &point, &[2, 3])?;
            let state_samples = states.evaluate(&model, &experiments, &point, &[2, 3])?;
            assert!(distance(&samples.residuals, &state_samples.residuals) < 1e-8);
            assert!(distance(&samples.point.coefficients, &state_samples.point.coefficients) < 1e-8);
            let slopes = orders.jacobian(&model, &experiments, &[2, 3], &samples)?;
            let exact = states.jacobian(&model, &experiments, &[2, 3], &state_samples)?;
            // The states have no derivative with respect to the order, which is fixed for them.
            slopes.iter().zip(&exact).skip(1).for_each(|(a, b)| assert!(distance(a, b) < 1e-7));
        }
        Ok(())
    }

    #[test]
    fn derivatives_match_differences() -> Result<()> {
        let (experiments, point, model) = ([experiment(1)?], point(1.7), model((1.0, 3.0), 0.6, Initial::Rest));
        let orders = require(FractionalOrders::new(&model, &experiments, &point))?;
        let evaluation = orders.evaluate(&model, &experiments, &point, &[])?;
        let slopes = orders.jacobian(&model, &experiments, &[], &evaluation)?;
        for (parameter, slope) in slopes.iter().enumerate() {
            let shifted_residuals = |shift: f64| -> Result<Vec<f64>> {
                let mut point = point.clone();
                match parameter.checked_sub(1) {
                    None => point.orders[0] += shift,
                    Some(j) => point.coefficients[j] += shift,
                }
                Ok(orders.evaluate(&model, &experiments, &point, &[])?.residuals)
            };
            let differences: Vec<f64> =
                shifted_residuals(1e-4)?.iter().zip(shifted_residuals(-1e-4)?).map(|(a, b)| (a - b) / 2e-4).collect();
            assert!(distance(slope, &differences) < 1e-5, "parameter {parameter}");
        }
        Ok(())
    }

    #[test]
    fn block_pulses_converge_to_the_exact_samples() -> Result<()> {
        let (point, model) = (point(1.7), model((1.0, 3.0), 0.6, Initial::Caputo));
        let (experiments, fine_experiments) = ([experiment(1)?], [experiment(8)?]);
        let orders = require(FractionalOrders::new(&model, &experiments, &point))?;
        let evaluation = orders.evaluate(&model, &experiments, &point, &[2, 3])?;
        let mut caches = EvaluationCache::for_experiments(&fine_experiments, &Stop::default())?;
        let pulse_evaluation = model.evaluate(&fine_experiments, &mut caches, &point, &[2, 3])?;
        assert!(distance(&evaluation.residuals, &pulse_evaluation.residuals) < 1e-4);
        assert!(distance(&evaluation.point.coefficients, &pulse_evaluation.point.coefficients) < 1e-4);
        assert!(distance(&evaluation.initial[0][0], &pulse_evaluation.initial[0][0]) < 1e-2);
        let slopes = orders.jacobian(&model, &experiments, &[2, 3], &evaluation)?;
        let pulses = model.jacobian(&fine_experiments, &mut caches, &[2, 3], &pulse_evaluation)?;
        slopes.iter().zip(&pulses).for_each(|(a, b)| assert!(distance(a, b) < 1e-3));
        Ok(())
    }
}
