//! Fit of equations of integer orders: initial guesses by refined instrumental variables (SRIVC) and from lower orders,
//! then variable projection over the poles.
//!
//! State-variable filters 1/(s + λ)^n yield first coefficients for several poles λ (Garnier & Young). Refined
//! instrumental variables improve the coefficients. The instrument is the exact simulation x, and the residual is y − x
//! with the measured output y. The step d of the coefficients of the denominator A solves Σ_t Ψ_i (y − x − Σ_j Φ_j d_j)
//! = 0 for each i. Here Ψ_i = s^i/A x is an instrument and Φ_j = s^j/A y a regressor. Other guesses add a pole or a
//! pair of poles to the optimum of a lower order. The best guesses are refined in the logarithms of p and q of the
//! second-order sections s² + p s + q. In these coordinates every point is stable. Poles above the Nyquist frequency
//! are excluded by bounds.

use std::borrow::Cow;
use std::f64::consts::PI;
use std::sync::Arc;

use super::prefilter::cumulative_power_frequency;
use crate::equation::AffineOrder;
use crate::error::{Error, Result};
use crate::estimation::joint_fit::format::format_general;
use crate::estimation::joint_fit::multistart::MAX_COARSE_SAMPLES;
use crate::estimation::joint_fit::objective::Objective;
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::{Candidate, Iterate};
use crate::estimation::optimization::damped_step;
use crate::estimation::optimization::levenberg_marquardt::{minimize, MinimizationSettings};
use crate::estimation::output_error::evaluation::{self, solve_linear_steps, LinearSide, RANK_TOLERANCE};
use crate::estimation::output_error::integer_orders::{
    source_input, Companion, ExactSimulation, IntegerOrders, SourceInput,
};
use crate::estimation::output_error::{Experiment, FreeEquation, FreeModel, InputLaw, Monomial, ParameterPoint};
use crate::linalg::orthogonal::{extend_orthonormal, project_out};
use crate::linalg::small::{polynomial_roots, EquilibratedLu};
use crate::parallel::Stop;
use crate::signal::block_pulse::Intersample;
use crate::signal::nonuniform::interpolate_gaps;
use crate::signal::statistics::{inner, mean, median};

/// Poles λ of the state-variable filters, relative to the frequency below which half of the output power lies.
const FILTER_RATIOS: [f64; 5] = [0.1, 0.3, 1.0, 3.0, 10.0];
/// Magnitudes of poles added to an optimum of lower order, relative to the median frequency of the output power.
const ADDED_POLE_RATIOS: [f64; 7] = [0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0];
/// Damping ratio of an added pair of poles.
const ADDED_PAIR_DAMPING: f64 = 0.05;
/// Maximum number of iterations of the refined instrumental variables.
const INSTRUMENT_STEPS: usize = 8;
/// Maximum number of halvings of a step that does not decrease the cost.
const MAX_HALVINGS: usize = 5;
/// Maximum number of initial guesses that are refined.
const CONTINUED_GUESSES: usize = 3;
/// Maximum number of evaluations of each refined guess.
const SECTION_EVALUATIONS: usize = 40;
/// Relative difference of two costs below which they are attributed to the same optimum.
const SAME_COST_TOLERANCE: f64 = 1e-3;
const COST_TOLERANCE: f64 = 1e-8;
/// Maximum of p/2 times the pulse width, for a section s² + p s + q.
///
/// The samples do not determine faster real poles, nor pole pairs above the Nyquist frequency.
const MAX_DECAY_STEP: f64 = 1.0;
/// Maximum of √q times the pulse width, for a section s² + p s + q.
const MAX_FREQUENCY_STEP: f64 = PI;
/// Minimum product of the magnitude of a pole and the duration of the longest run.
const MIN_POLE_DURATION: f64 = 1e-4;
/// Minimum damping ratio of an initial guess.
const MIN_DAMPING: f64 = 1e-4;
/// Minimum number of runs on which initial guesses are compared, if the data contain that many runs.
const MIN_RUNS: usize = 2;
/// Maximum number of delays for which initial guesses are refined.
const CONTINUED_DELAYS: usize = 3;

/// Exact simulation at one parameter point, with its residuals.
type Evaluation<'a> = evaluation::Evaluation<ExactSimulation<'a>>;
/// Real and imaginary part of a pole \[rad/s\].
type Pole = (f64, f64);

/// One equation of integer orders. The coefficients of its denominator are free parameters.
struct Equation<'a> {
    model: FreeModel,
    experiments: &'a [Experiment],
    /// Coefficient index and known factor of each derivative of the output that occurs in the equation, by ascending
    /// order of the derivative. The factor is −1 for a term such as −a y.
    ///
    /// Derivatives of a lower order than the first entry do not occur in the equation. Their number is `integrators`.
    autoregressive_terms: Vec<(usize, f64)>,
    integrators: usize,
    stop: &'a Stop,
    /// Frequency \[rad/s\] below which half of the output power lies; median over the runs.
    frequency: f64,
    /// Shortest pulse width \[s\].
    step: f64,
    /// Duration of the longest run \[s\].
    duration: f64,
}

/// Initial guess with its cost and a description of its origin.
struct Guess {
    cost: f64,
    point: ParameterPoint,
    origin: String,
}

/// Return the local optima of a problem of integer orders, best first; None for other problems.
///
/// Candidate k combines the k-th optimum of every equation. `delays` contains the initial guesses of the delays.
///
/// # Errors
/// An error if a run cannot be simulated. [`Error::Interrupted`] after a stop request.
pub fn integer_order_optima(
    parameter_set: &ParameterSet,
    objective: &Objective<'_>,
    delays: &[Vec<f64>],
) -> Result<Option<Vec<Candidate>>> {
    let model = &parameter_set.problem.model;
    let is_supported = parameter_set.products.is_empty()
        && parameter_set.problem.is_linear()
        && parameter_set.orders.is_empty()
        && (model.equations.len() == 1 || (!model.coupled && model.inputs.is_empty()))
        && model.inputs.iter().all(|input| input.law == InputLaw::Delay);
    let start = ParameterPoint {
        orders: Vec::new(),
        coefficients: vec![0.0; parameter_set.coefficients.len()],
        inputs: delays.first().cloned().unwrap_or_default(),
    };
    if !is_supported || IntegerOrders::new(model, objective.experiments(), &start).is_none() {
        return Ok(None);
    }
    let mut candidates: Vec<Candidate> = Vec::new();
    for i in 0..model.equations.len() {
        let representative = representative_runs(&model.equations[i], objective.experiments());
        let experiments: Vec<Experiment> = representative.into_iter().map(|e| single_output(e, i)).collect();
        let Some(equation) = Equation::new(model, i, &experiments, objective.stop()) else { return Ok(None) };
        let guesses = equation.optima(&start, delays)?;
        if guesses.is_empty() {
            return Ok(None);
        }
        // Optima of different equations are independent, so the k-th candidate has the k-th optimum of each equation.
        for (k, guess) in guesses.into_iter().enumerate() {
            if i == 0 {
                let iterate = Iterate { point: guess.point, states: Vec::new() };
                candidates.push(Candidate::at(iterate, guess.origin));
            } else if k < candidates.len() {
                let point = &mut candidates[k].result.iterate.point;
                for j in equation.coefficients() {
                    point.coefficients[j] = guess.point.coefficients[j];
                }
            }
        }
    }
    Ok(Some(candidates))
}

/// Return the runs with the most excitation, on which the guesses of an equation are compared.
///
/// Each input in turn adds the run in which it varies most. The selection ends when it contains at least two runs, as
/// many runs as inputs, and enough samples for a coarse fit. The fit to all runs starts from the initial guesses that
/// are found on the selected runs.
fn representative_runs<'a>(equation: &FreeEquation, experiments: &'a [Experiment]) -> Vec<&'a Experiment> {
    let mut inputs: Vec<usize> = equation.terms.iter().map(|(signal, ..)| *signal).collect();
    inputs.retain(|signal| *signal != equation.output);
    inputs.sort_unstable();
    inputs.dedup();
    let variation = |experiment: &Experiment, signal: usize| {
        let means = experiment.record.signal(signal);
        let center = mean(means);
        means.iter().map(|v| (v - center) * (v - center)).sum::<f64>()
    };
    let ranked: Vec<Vec<usize>> = inputs
        .iter()
        .map(|&signal| {
            let variations: Vec<f64> = experiments.iter().map(|e| variation(e, signal)).collect();
            let mut order: Vec<usize> = (0..experiments.len()).collect();
            order.sort_by(|&a, &b| variations[b].total_cmp(&variations[a]));
            order
        })
        .collect();
    let (mut selection, mut samples) = (Vec::new(), 0);
    for run in (0..experiments.len()).flat_map(|rank| ranked.iter().map(move |order| order[rank])) {
        if selection.len() >= MIN_RUNS.max(inputs.len()) && samples >= MAX_COARSE_SAMPLES {
            break;
        }
        if !selection.contains(&run) {
            selection.push(run);
            samples += experiments[run].compared_count();
        }
    }
    if selection.is_empty() {
        return experiments.iter().collect();
    }
    selection.sort_unstable();
    selection.into_iter().map(|run| &experiments[run]).collect()
}

/// Return the experiment with output `i` alone.
fn single_output(experiment: &Experiment, i: usize) -> Experiment {
    let mut single = experiment.clone();
    single.samples = Arc::new(vec![experiment.samples[i].clone()]);
    single.weights = vec![experiment.weights[i]];
    single.sample_weights = experiment.sample_weights.get(i).cloned().into_iter().collect();
    single
}

impl<'a> Equation<'a> {
    /// Return equation `i` of a model; None if its orders or coefficients are not of the required form.
    ///
    /// The orders must be integers. Each autoregressive coefficient must be a free parameter of its own, and input
    /// terms must be linear in free parameters. None is also returned if the median frequency of the output power is
    /// undefined.
    #[allow(clippy::cast_precision_loss)]
    fn new(model: &FreeModel, i: usize, experiments: &'a [Experiment], stop: &'a Stop) -> Option<Self> {
        let equation = &model.equations[i];
        let model = FreeModel { equations: vec![equation.clone()], coupled: false, ..model.clone() };
        let order = integer(&equation.order)?;
        let mut autoregressive_terms = vec![None; order];
        let single_parameter = |monomial: &Monomial| match monomial.powers[..] {
            [(j, 1)] if monomial.factor != 0.0 => Some(j),
            _ => None,
        };
        let linear = model.linear_coefficients();
        for (signal, nu, monomial) in &equation.terms {
            if *signal == equation.output {
                let (j, nu) = (single_parameter(monomial)?, integer(nu)?);
                if nu >= order
                    || autoregressive_terms[nu].replace((j, monomial.factor)).is_some()
                    || linear.contains(&j)
                {
                    return None;
                }
            } else if monomial.powers.iter().any(|(j, _)| !linear.contains(j)) {
                return None;
            }
        }
        let integrators = autoregressive_terms.iter().position(Option::is_some).unwrap_or(order);
        let autoregressive_terms: Vec<(usize, f64)> =
            autoregressive_terms[integrators..].iter().copied().collect::<Option<_>>()?;
        let frequency = median(
            experiments
                .iter()
                .map(|e| cumulative_power_frequency(&output_samples(e), e.record.step(), 0.5))
                .filter(|f| f.is_finite())
                .collect(),
        );
        let step = experiments.iter().map(|e| e.record.step()).fold(f64::INFINITY, f64::min);
        let duration = experiments.iter().map(|e| e.record.step() * e.record.m() as f64).fold(0.0, f64::max);
        (frequency > 0.0).then_some(Self {
            model,
            experiments,
            autoregressive_terms,
            integrators,
            stop,
            frequency,
            step,
            duration,
        })
    }

    fn order(&self) -> usize {
        self.integrators + self.autoregressive_terms.len()
    }

    /// Indices of the free coefficients of the equation: those of the denominator, then the linear ones.
    fn coefficients(&self) -> Vec<usize> {
        self.autoregressive_terms
            .iter()
            .map(|autoregressive_terms| autoregressive_terms.0)
            .chain(self.model.linear_coefficients())
            .collect()
    }

    /// Return the same equation at a lower order, without the input terms that exceed this order.
    #[allow(clippy::cast_precision_loss)]
    fn at_order(&self, order: usize) -> Self {
        let mut model = self.model.clone();
        let equation = &mut model.equations[0];
        let (output, full_order) = (equation.output, self.order());
        equation.terms.retain(|(signal, nu, _)| {
            let nu = integer(nu).unwrap_or(usize::MAX);
            nu < order || (nu == full_order && *signal != output && order == full_order)
        });
        if order < full_order {
            equation.order = AffineOrder { constant: order as f64, ..equation.order.clone() };
        }
        Self { model, autoregressive_terms: self.autoregressive_terms[..order - self.integrators].to_vec(), ..*self }
    }

    /// Return the optima of the equation at the most likely delays, best first.
    fn optima(&self, start: &ParameterPoint, delays: &[Vec<f64>]) -> Result<Vec<Guess>> {
        let delays = self.likely_delays(start, delays)?;
        let mut poles_by_delay: Vec<Vec<Vec<Pole>>> = vec![Vec::new(); delays.len()];
        let mut evaluations = Vec::new();
        for order in (self.integrators.max(1))..=self.order() {
            let is_full_order = order == self.order();
            let equation = self.at_order(order);
            let mut optima_of_order = Vec::new();
            for (delay, poles) in delays.iter().zip(&mut poles_by_delay) {
                let start_at_delay = ParameterPoint { inputs: delay.clone(), ..start.clone() };
                let mut guesses = equation.instrumental_variables(&start_at_delay)?;
                guesses.extend(equation.with_added_poles(&start_at_delay, poles)?);
                let optima = equation.refine(guesses)?;
                let best_poles = optima.first().map(|optimum| equation.poles(&optimum.point)).unwrap_or_default();
                poles.push(best_poles);
                optima_of_order.extend(optima);
            }
            if is_full_order {
                evaluations = optima_of_order;
            }
        }
        evaluations.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        Ok(evaluations)
    }

    /// Return the delays at which a model with two poles and the integrators has the least cost, best first.
    ///
    /// At most [`CONTINUED_DELAYS`] delays are returned. If `delays` contains no more than that, all of them are
    /// returned unsorted.
    fn likely_delays(&self, start: &ParameterPoint, delays: &[Vec<f64>]) -> Result<Vec<Vec<f64>>> {
        if delays.len() <= CONTINUED_DELAYS {
            return Ok(if delays.is_empty() { vec![Vec::new()] } else { delays.to_vec() });
        }
        let equation = self.at_order(self.order().min(self.integrators + 2));
        let mut costs = Vec::with_capacity(delays.len());
        for delay in delays {
            let point = ParameterPoint { inputs: delay.clone(), ..start.clone() };
            let mut least_cost = f64::INFINITY;
            for ratio in [1.0, 4.0] {
                if let Some(evaluation) = equation.filtered_least_squares(&point, ratio * self.frequency)? {
                    least_cost = least_cost.min(equation.evaluate(&evaluation)?.map_or(f64::INFINITY, |e| cost(&e)));
                }
            }
            costs.push(least_cost);
        }
        let mut order: Vec<usize> = (0..delays.len()).collect();
        order.sort_by(|&i, &j| costs[i].total_cmp(&costs[j]));
        Ok(order.into_iter().take(CONTINUED_DELAYS).map(|i| delays[i].clone()).collect())
    }

    /// Return guesses from state-variable filters and refined instrumental variables, at the delays of `start`.
    fn instrumental_variables(&self, start: &ParameterPoint) -> Result<Vec<Guess>> {
        let mut guesses = Vec::new();
        for ratio in FILTER_RATIOS {
            let cutoff = ratio * self.frequency;
            if cutoff * self.step > PI {
                continue;
            }
            let Some(point) = self.filtered_least_squares(start, cutoff)? else { continue };
            let origin = format!("instrumental variables, filter {} rad/s", format_general(cutoff, 3));
            if let Some(unstable) = self.evaluate(&point)?.filter(|_| !self.is_stable(&point)) {
                let origin = format!("{origin}, unstable");
                guesses.push(Guess { cost: cost(&unstable), point: unstable.point, origin });
            }
            if let Some(refined) = self.refine_instruments(&self.stabilize(&point))? {
                guesses.push(Guess { cost: cost(&refined), point: refined.point, origin });
            }
        }
        Ok(guesses)
    }

    /// Return guesses with one real pole or one pair of poles added to the optima of lower orders, `lower`.
    fn with_added_poles(&self, start: &ParameterPoint, lower: &[Vec<Pole>]) -> Result<Vec<Guess>> {
        let mut guesses = Vec::new();
        for added_count in 1..=2_usize {
            let Some(poles) = lower.len().checked_sub(added_count).map(|k| &lower[k]) else { continue };
            if poles.len() + added_count != self.autoregressive_terms.len() {
                continue;
            }
            for ratio in ADDED_POLE_RATIOS {
                let magnitude = ratio * self.frequency;
                let mut extended_poles = poles.clone();
                match added_count {
                    1 => extended_poles.push((-magnitude, 0.0)),
                    _ => {
                        let (decay, damped_ratio) =
                            (ADDED_PAIR_DAMPING * magnitude, (1.0 - ADDED_PAIR_DAMPING.powi(2)).sqrt());
                        extended_poles
                            .extend([(-decay, damped_ratio * magnitude), (-decay, -damped_ratio * magnitude)]);
                    }
                }
                let point = self.at_poles(start, &extended_poles);
                if let Some(evaluation) = self.evaluate(&point)? {
                    guesses.push(Guess {
                        cost: cost(&evaluation),
                        point: evaluation.point,
                        origin: "lower order".into(),
                    });
                }
            }
        }
        Ok(guesses)
    }

    /// Refine the best distinct guesses by variable projection over their second-order sections.
    ///
    /// Return them in ascending order of cost. Unstable guesses are returned without refinement.
    fn refine(&self, mut guesses: Vec<Guess>) -> Result<Vec<Guess>> {
        guesses.retain(|guess| guess.cost.is_finite());
        guesses.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        let (mut refined, mut costs) = (Vec::<Guess>::new(), Vec::<f64>::new());
        for guess in guesses {
            if refined.len() >= CONTINUED_GUESSES {
                break;
            }
            if costs.iter().any(|cost| (guess.cost / cost - 1.0).abs() < SAME_COST_TOLERANCE) {
                continue;
            }
            costs.push(guess.cost);
            if !self.is_stable(&guess.point) {
                refined.push(guess);
                continue;
            }
            let Some(exact) = IntegerOrders::new(&self.model, self.experiments, &guess.point) else { continue };
            let problem =
                SectionsProblem { equation: self, exact, linear: self.model.linear_coefficients(), base: &guess.point };
            let settings = MinimizationSettings { evaluations: SECTION_EVALUATIONS, tolerance: COST_TOLERANCE };
            let sections = self.sections(&self.poles(&guess.point));
            let start = [sections, guess.point.inputs.clone()].concat();
            match minimize(&problem, problem.clamp_to_bounds(start), settings) {
                Ok(optimum) => {
                    refined.push(Guess { cost: optimum.cost, point: optimum.evaluation.point, origin: guess.origin });
                }
                Err(Error::Interrupted) => return Err(Error::Interrupted),
                Err(_) => refined.push(guess),
            }
        }
        refined.sort_by(|a, b| a.cost.total_cmp(&b.cost));
        Ok(refined)
    }

    /// Simulate at a point with the optimal input coefficients. Return None if the simulation is not finite.
    fn evaluate(&self, point: &ParameterPoint) -> Result<Option<Evaluation<'a>>> {
        self.stop.check()?;
        let Some(exact) = IntegerOrders::new(&self.model, self.experiments, point) else { return Ok(None) };
        let linear = self.model.linear_coefficients();
        Ok(exact.evaluate(&self.model, self.experiments, point, &linear).ok().filter(|e| cost(e).is_finite()))
    }

    /// Coefficients of s^0, …, s^(n − 1) of the monic denominator of degree n.
    fn divisor(&self, point: &ParameterPoint) -> Vec<f64> {
        let autoregressive_terms = self.autoregressive_terms.iter().map(|&(j, factor)| -factor * point.coefficients[j]);
        std::iter::repeat_n(0.0, self.integrators).chain(autoregressive_terms).collect()
    }

    /// Poles without the integrators; empty if they are not found.
    fn poles(&self, point: &ParameterPoint) -> Vec<Pole> {
        let mut divisor = self.divisor(point)[self.integrators..].to_vec();
        divisor.push(1.0);
        polynomial_roots(&divisor).unwrap_or_default()
    }

    fn is_stable(&self, point: &ParameterPoint) -> bool {
        let poles = self.poles(point);
        poles.len() == self.autoregressive_terms.len() && poles.iter().all(|(re, _)| *re < 0.0)
    }

    fn at_poles(&self, point: &ParameterPoint, poles: &[Pole]) -> ParameterPoint {
        let mut point_at_poles = point.clone();
        for (&(j, factor), c) in self.autoregressive_terms.iter().zip(polynomial(poles)) {
            point_at_poles.coefficients[j] = -c / factor;
        }
        point_at_poles
    }

    /// Return the point with unstable poles reflected at the imaginary axis and fast poles moved below the Nyquist
    /// frequency.
    fn stabilize(&self, point: &ParameterPoint) -> ParameterPoint {
        let (max_magnitude, min_decay) = (MAX_FREQUENCY_STEP / self.step, MIN_POLE_DURATION / self.duration);
        let poles = self.poles(point);
        if poles.len() != self.autoregressive_terms.len() {
            return point.clone();
        }
        let limit_pole = |(re, im): Pole| {
            let magnitude = re.hypot(im);
            let scale = if magnitude > max_magnitude { max_magnitude / magnitude } else { 1.0 };
            let decay = (re.abs() * scale).max(MIN_DAMPING * magnitude * scale).max(min_decay);
            (-decay, im * scale)
        };
        self.at_poles(point, &poles.into_iter().map(limit_pole).collect::<Vec<_>>())
    }

    /// Return ln p and ln q of each section s² + p s + q, then the log magnitude of the remaining real pole, if any.
    fn sections(&self, poles: &[Pole]) -> Vec<f64> {
        let min_decay = MIN_POLE_DURATION / self.duration;
        let mut real: Vec<f64> =
            poles.iter().filter(|(_, im)| *im == 0.0).map(|(re, _)| (-re).max(min_decay)).collect();
        real.sort_by(f64::total_cmp);
        let mut out = Vec::with_capacity(poles.len());
        for (re, im) in poles.iter().filter(|(_, im)| *im > 0.0) {
            out.extend([(-2.0 * re).max(min_decay).ln(), (re * re + im * im).ln()]);
        }
        while real.len() >= 2 {
            let (slow, fast) = (real.remove(0), real.pop().unwrap_or(min_decay));
            out.extend([(slow + fast).ln(), (slow * fast).ln()]);
        }
        out.extend(real.iter().map(|w| w.ln()));
        out
    }

    /// Estimate the coefficients by least squares on samples that pass state-variable filters.
    ///
    /// The regression is [s^n/F] y = Σ a_i [s^i/F] y + Σ b_j [s^j/F] u for output y and inputs u. The filter is
    /// F = (s + λ)^n with λ = `cutoff` \[rad/s\]. Return None if a filtered signal is not finite or the coefficients
    /// are not determined.
    #[allow(clippy::type_complexity)]
    fn filtered_least_squares(&self, start: &ParameterPoint, cutoff: f64) -> Result<Option<ParameterPoint>> {
        self.stop.check()?;
        let n = self.order();
        let filter: Vec<f64> = polynomial(&vec![(-cutoff, 0.0); n]).iter().map(|c| -c).collect();
        let linear = self.model.linear_coefficients();
        let equation = &self.model.equations[0];
        let mut companions = Vec::new();
        let mut sides: Vec<(Vec<f64>, Vec<Vec<f64>>, Vec<Vec<f64>>)> = Vec::new();
        for experiment in self.experiments {
            let (count, step) = (experiment.compared_count(), experiment.record.step());
            let companion = Companion::of_width(&mut companions, &filter, step);
            let sampling = (experiment.pulses_per_sample, count);
            let respond = |input: Option<&SourceInput<'_>>| companion.respond(input, sampling);
            let apply_weights =
                |column: Vec<f64>| column.iter().zip(experiment.weights_of(0)).map(|(v, w)| v * w).collect();
            let Some(output) = respond(Some(&measured_input(experiment))) else { return Ok(None) };
            let mut target = companion.derivative(&output, n);
            let mut columns = vec![vec![0.0; count]; self.autoregressive_terms.len() + linear.len()];
            for (index, (column, (_, factor))) in columns.iter_mut().zip(&self.autoregressive_terms).enumerate() {
                let derivative = companion.derivative(&output, self.integrators + index);
                *column = derivative.iter().map(|v| factor * v).collect();
            }
            for (signal, nu, monomial) in equation.terms.iter().filter(|(signal, ..)| *signal != equation.output) {
                let input = source_input(&self.model, experiment, *signal, start)?;
                let (Some(response), Some(nu)) = (respond(Some(&input)), integer(nu)) else { return Ok(None) };
                let input_derivative = companion.derivative(&response, nu);
                match monomial.powers.first().and_then(|(j, _)| linear.iter().position(|l| l == j)) {
                    Some(column_index) => {
                        let column = &mut columns[self.autoregressive_terms.len() + column_index];
                        column.iter_mut().zip(&input_derivative).for_each(|(v, a)| *v += monomial.factor * a);
                    }
                    None => target.iter_mut().zip(&input_derivative).for_each(|(v, a)| *v -= monomial.factor * a),
                }
            }
            let mut basis = Vec::new();
            if !self.model.initial.is_at_rest() || self.model.initial.has_level() {
                let constant_input = |samples: Vec<f64>| SourceInput {
                    samples: Cow::Owned(samples),
                    intersample: Intersample::Hold,
                    delay: 0.0,
                    before: 0.0,
                };
                let (Some(impulse), Some(constant)) = (respond(None), respond(Some(&constant_input(vec![1.0])))) else {
                    return Ok(None);
                };
                for j in 0..n {
                    extend_orthonormal(&mut basis, apply_weights(companion.derivative(&impulse, j)), RANK_TOLERANCE);
                }
                if !self.model.initial.without_offset().eq(&self.model.initial) {
                    extend_orthonormal(&mut basis, apply_weights(companion.derivative(&constant, 0)), RANK_TOLERANCE);
                }
            }
            sides.push((apply_weights(target), basis, columns.into_iter().map(apply_weights).collect()));
        }
        let sides: Vec<LinearSide<'_>> = (sides.iter())
            .map(|(target, basis, columns)| (&target[..], &basis[..], columns.iter().map(Vec::as_slice).collect()))
            .collect();
        let Ok(solution) = solve_linear_steps(&sides) else { return Ok(None) };
        let mut point = start.clone();
        for (j, value) in self.coefficients().into_iter().zip(&solution) {
            point.coefficients[j] = *value;
        }
        Ok(Some(point))
    }

    /// Improve a point by refined instrumental variables. Return None if the simulation at `start` is not finite.
    fn refine_instruments(&self, start: &ParameterPoint) -> Result<Option<Evaluation<'a>>> {
        let Some(mut iterate) = self.evaluate(start)? else { return Ok(None) };
        for _ in 0..INSTRUMENT_STEPS {
            let Some(step) = self.instrument_step(&iterate)? else { break };
            let (mut step_fraction, mut accepted) = (1.0, None);
            for _ in 0..MAX_HALVINGS {
                let mut point = iterate.point.clone();
                for (&(j, _), increment) in self.autoregressive_terms.iter().zip(&step) {
                    point.coefficients[j] += step_fraction * increment;
                }
                accepted = self.evaluate(&self.stabilize(&point))?.filter(|trial| cost(trial) < cost(&iterate));
                if accepted.is_some() {
                    break;
                }
                step_fraction *= 0.5;
            }
            let Some(trial) = accepted else { break };
            let gain = 1.0 - cost(&trial) / cost(&iterate);
            iterate = trial;
            if gain < 1e-4 {
                break;
            }
        }
        Ok(Some(iterate))
    }

    /// Return the step of the autoregressive coefficients, with the simulation as instrument.
    ///
    /// None if the system of linear equations is singular.
    fn instrument_step(&self, evaluation: &Evaluation<'a>) -> Result<Option<Vec<f64>>> {
        let Some(exact) = IntegerOrders::new(&self.model, self.experiments, &evaluation.point) else { return Ok(None) };
        let linear = self.model.linear_coefficients();
        let Ok(jacobian) = exact.jacobian(&self.model, self.experiments, &linear, evaluation) else { return Ok(None) };
        let orders = evaluation.point.orders.len();
        let indices: Vec<usize> = self.coefficients().iter().map(|j| orders + j).collect();
        let autoregressive_terms: Vec<f64> = self.divisor(&evaluation.point).iter().map(|c| -c).collect();
        let mut regressors: Vec<Vec<f64>> = vec![Vec::new(); self.autoregressive_terms.len()];
        let mut companions = Vec::new();
        for (experiment, basis) in self.experiments.iter().zip(evaluation.parts.iter().map(ExactSimulation::basis)) {
            let companion = Companion::of_width(&mut companions, &autoregressive_terms, experiment.record.step());
            let sampling = (experiment.pulses_per_sample, experiment.compared_count());
            let Some(output) = companion.respond(Some(&measured_input(experiment)), sampling) else {
                return Ok(None);
            };
            for (index, (column, (_, factor))) in regressors.iter_mut().zip(&self.autoregressive_terms).enumerate() {
                let regressor_part = companion.derivative(&output, self.integrators + index);
                let mut regressor_part: Vec<f64> =
                    regressor_part.iter().zip(experiment.weights_of(0)).map(|(v, w)| factor * v * w).collect();
                project_out(basis, &mut regressor_part);
                column.extend(regressor_part);
            }
        }
        let k = indices.len();
        let (mut cross, mut right) = (vec![0.0; k * k], vec![0.0; k]);
        for (a, &instrument) in indices.iter().enumerate() {
            // The Jacobian is the derivative of the residuals, which are measured minus simulated samples.
            right[a] = -inner(&jacobian[instrument], &evaluation.residuals);
            for b in 0..k {
                cross[a * k + b] = match regressors.get(b) {
                    Some(regressor) => -inner(&jacobian[instrument], regressor),
                    None => inner(&jacobian[instrument], &jacobian[indices[b]]),
                };
            }
        }
        let Ok(factor) = EquilibratedLu::new(&cross, k) else { return Ok(None) };
        let step = factor.solve(&right);
        Ok(step.iter().all(|v| v.is_finite()).then(|| step[..self.autoregressive_terms.len()].to_vec()))
    }
}

/// Samples of the only output, with missing samples interpolated.
fn output_samples(experiment: &Experiment) -> Cow<'_, [f64]> {
    let samples = &experiment.samples[0];
    let Some(weights) = experiment.sample_weights.first().filter(|w| w.contains(&0.0)) else {
        return Cow::Borrowed(samples);
    };
    let value_or_missing = |(k, v): (usize, &f64)| {
        let is_present = k == 0 || weights.get(k - 1).is_none_or(|w| *w > 0.0);
        if is_present {
            *v
        } else {
            f64::NAN
        }
    };
    let with_missing: Vec<f64> = samples.iter().enumerate().map(value_or_missing).collect();
    Cow::Owned(interpolate_gaps(&with_missing).into_owned())
}

/// The measured output as input of a filter, linear between samples.
fn measured_input(experiment: &Experiment) -> SourceInput<'_> {
    SourceInput { samples: output_samples(experiment), intersample: Intersample::Linear, delay: 0.0, before: 0.0 }
}

/// Return an order as an integer; None if it is negative, not an integer, or depends on a free order.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn integer(order: &AffineOrder) -> Option<usize> {
    let nearest = order.constant.round();
    (order.weights.iter().all(|w| *w == 0.0) && nearest >= 0.0 && (order.constant - nearest).abs() < 1e-9)
        .then_some(nearest as usize)
}

/// Half the sum of squared residuals.
fn cost(evaluation: &Evaluation<'_>) -> f64 {
    0.5 * inner(&evaluation.residuals, &evaluation.residuals)
}

/// Coefficients of s^0, …, s^(n − 1) of the monic real polynomial with the n given zeros.
fn polynomial(zeros: &[Pole]) -> Vec<f64> {
    let mut product = vec![1.0];
    for &(re, im) in zeros {
        if im == 0.0 {
            product = multiply(&product, &[-re, 1.0]);
        } else if im > 0.0 {
            product = multiply(&product, &[re * re + im * im, -2.0 * re, 1.0]);
        }
    }
    product.pop();
    product
}

fn multiply(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut product = vec![0.0; a.len() + b.len() - 1];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            product[i + j] += x * y;
        }
    }
    product
}

/// Least-squares problem over the logarithms of the section coefficients, and over the delays.
struct SectionsProblem<'e, 'a> {
    equation: &'e Equation<'a>,
    exact: IntegerOrders,
    linear: Vec<usize>,
    base: &'e ParameterPoint,
}

impl SectionsProblem<'_, '_> {
    /// Return the sections as polynomials, and their derivatives with respect to the logarithms of the coefficients.
    ///
    /// Coefficients are in ascending order of the power.
    fn factors(&self, sections: &[f64]) -> Vec<(Vec<f64>, Vec<Vec<f64>>)> {
        let pair = |c: &[f64]| match c {
            [p, q] => (vec![q.exp(), p.exp(), 1.0], vec![vec![0.0, p.exp()], vec![q.exp()]]),
            _ => (vec![c[0].exp(), 1.0], vec![vec![c[0].exp()]]),
        };
        sections.chunks(2).map(pair).collect()
    }

    fn bounds(&self, k: usize) -> (f64, f64) {
        let equation = self.equation;
        let count = equation.autoregressive_terms.len();
        let (min_decay, decay, frequency) = (
            (MIN_POLE_DURATION / equation.duration).ln(),
            (MAX_DECAY_STEP / equation.step).ln(),
            (MAX_FREQUENCY_STEP / equation.step).ln(),
        );
        match k {
            k if k >= count => equation.model.inputs[k - count].bounds,
            k if k % 2 == 1 => (2.0 * min_decay, 2.0 * frequency),
            k if k + 1 == count => (min_decay, decay),
            _ => (min_decay, decay + 2.0_f64.ln()),
        }
    }

    fn clamp_to_bounds(&self, mut point: Vec<f64>) -> Vec<f64> {
        for (k, v) in point.iter_mut().enumerate() {
            let (low, high) = self.bounds(k);
            *v = v.max(low).min(high);
        }
        point
    }
}

impl<'a> damped_step::LeastSquaresProblem for SectionsProblem<'_, 'a> {
    type Point = Vec<f64>;
    type Evaluation = Evaluation<'a>;

    fn evaluate(&self, point: &Vec<f64>) -> Result<Evaluation<'a>> {
        let equation = self.equation;
        equation.stop.check()?;
        let count = equation.autoregressive_terms.len();
        let product = self.factors(&point[..count]).iter().fold(vec![1.0], |a, (section, _)| multiply(&a, section));
        let mut parameter_point = self.base.clone();
        parameter_point.inputs = point[count..].to_vec();
        for (&(j, factor), c) in equation.autoregressive_terms.iter().zip(&product) {
            parameter_point.coefficients[j] = -c / factor;
        }
        self.exact.evaluate(&equation.model, equation.experiments, &parameter_point, &self.linear)
    }

    fn residuals<'e>(&self, evaluation: &'e Evaluation<'a>) -> &'e [f64] {
        &evaluation.residuals
    }

    fn jacobian(&self, point: &Vec<f64>, evaluation: &Evaluation<'a>) -> Result<Vec<Vec<f64>>> {
        let equation = self.equation;
        let mut jacobian = self.exact.jacobian(&equation.model, equation.experiments, &self.linear, evaluation)?;
        let (orders, count) = (evaluation.point.orders.len(), equation.autoregressive_terms.len());
        let factors = self.factors(&point[..count]);
        // Variable projection in Kaufman's form: the columns of the input coefficients are projected out.
        let basis = {
            let mut basis = Vec::new();
            for &j in &self.linear {
                extend_orthonormal(&mut basis, jacobian[orders + j].clone(), RANK_TOLERANCE);
            }
            basis
        };
        let mut columns = Vec::with_capacity(point.len());
        for (k, (_, slopes)) in factors.iter().enumerate() {
            let remaining_factors = factors.iter().enumerate().filter(|(other, _)| *other != k);
            let remaining_product = remaining_factors.fold(vec![1.0], |a, (_, (section, _))| multiply(&a, section));
            for slope in slopes {
                let mut column = vec![0.0; evaluation.residuals.len()];
                for (&(j, factor), coefficient_slope) in
                    equation.autoregressive_terms.iter().zip(multiply(&remaining_product, slope))
                {
                    column
                        .iter_mut()
                        .zip(&jacobian[orders + j])
                        .for_each(|(v, d)| *v -= coefficient_slope / factor * d);
                }
                columns.push(column);
            }
        }
        columns.extend(jacobian.drain(orders + evaluation.point.coefficients.len()..));
        columns.iter_mut().for_each(|column| project_out(&basis, column));
        Ok(columns)
    }

    fn release(&self, evaluation: &mut Evaluation<'a>) {
        evaluation.parts.clear();
    }

    fn apply_step(&self, point: &Vec<f64>, steps: &[f64]) -> (Vec<f64>, f64) {
        let count = self.equation.autoregressive_terms.len();
        let limit_step =
            |(k, (v, step)): (usize, (&f64, &f64))| if k < count { v + step.clamp(-1.5, 1.5) } else { v + step };
        let bounded_point = self.clamp_to_bounds(point.iter().zip(steps).enumerate().map(limit_step).collect());
        let scale = |k: usize| if k < count { 1.0 } else { self.bounds(k).1.max(f64::MIN_POSITIVE) };
        let change =
            bounded_point.iter().zip(point).enumerate().map(|(k, (a, b))| (a - b).abs() / scale(k)).fold(0.0, f64::max);
        (bounded_point, change)
    }

    fn distance_to_bounds(&self, point: &Vec<f64>, k: usize) -> (f64, f64) {
        let (low, high) = self.bounds(k);
        (point[k] - low, high - point[k])
    }

    fn has_kinks(&self, _point: &Vec<f64>, k: usize) -> bool {
        k >= self.equation.autoregressive_terms.len()
    }
}
