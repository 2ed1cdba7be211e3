//! Multistart for equations with friction: linear fits with the measured sign of the velocity are the initial guesses.
//!
//! With the measured sign of the velocity, the equation is linear. While the body sticks, the measured sign is noise.
//! The resulting bias is acceptable for an initial guess. Further guesses combine a linear fit without friction with
//! several assumed friction forces. If no guess leads to the noise level, the structure without friction is optimized
//! in full, and its optima are additional initial guesses. Stribeck friction starts from the best fits with Coulomb
//! friction.

use std::collections::BTreeMap;

use super::halving::{sort_by_cost, FIRST_BUDGET_EVALUATIONS, MAX_FINAL_SURVIVORS};
use super::search::{
    none_if_invalid_model, optimize_on_coarse_grids, run_multistart, MultistartContext, NOISE_FLOOR_FACTOR,
};
use super::sliding_body::fit_sliding_body;
use crate::equation::Initial;
use crate::error::{Error, Result};
use crate::estimation::joint_fit::format::format_general;
use crate::estimation::joint_fit::objective::{Objective, Weights};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::{Candidate, Iterate};
use crate::estimation::joint_fit::structure::{
    Coefficient, FrictionParameters, Order, ParametricEquation, ParametricStructure, ParametricTerm,
};
use crate::recording::{Channel, Recording, Recordings, Role, Sampling};
use crate::signal::nonuniform::interpolate_gaps;
use crate::signal::statistics::{root_mean_square, white_noise_deviation};

/// Approximate number of samples of the shortest run in the coarse fits.
const COARSE_SAMPLES: usize = 1200;
/// Highest order in the equation of a body with friction.
const MAX_BODY_ORDER: f64 = 2.0;
/// Initial guesses of Coulomb friction, relative to the largest input force on the body.
const COULOMB_FORCE_RATIOS: [f64; 4] = [0.01, 0.05, 0.2, 0.5];
/// Initial guesses of Coulomb friction, relative to the estimate from a fit with the measured sign of the velocity.
const MEASURED_SIGN_RATIOS: [f64; 2] = [1.0, 0.3];
/// Initial guesses of Stribeck friction, relative to Coulomb friction.
const STRIBECK_COULOMB_RATIOS: [f64; 3] = [0.02, 0.2, 1.0];
/// Initial guesses of the Stribeck velocity, relative to the root-mean-square speed of the body.
const STRIBECK_SPEED_RATIOS: [f64; 3] = [0.05, 0.2, 0.6];
/// Initial guesses of the inertia that attached bodies add to a body, relative to the inertia of the body itself.
const LOAD_INERTIA_RATIOS: [f64; 4] = [0.1, 0.3, 1.0, 3.0];
/// Maximum number of combinations of inertia ratios over all bodies. If there are more, all bodies get the same ratio.
const MAX_LOAD_COMBINATIONS: usize = 64;
/// Maximum difference of the orders of two terms that count as action and reaction between coupled equations.
const MAX_REACTION_ORDER_GAP: f64 = 0.5;
/// Minimum peak-to-peak motion of a body, in standard deviations of its noise.
const MIN_MOTION_NOISE_RATIO: f64 = 10.0;
/// Prefix of the name of the signal that is the sign of a measured velocity.
const SIGN_PREFIX: &str = "coulomb_";

/// Values by name: orders, coefficients and input parameters.
pub(super) type Values = BTreeMap<String, f64>;

/// Run the multistart of a problem with friction and return the candidates, best first.
///
/// # Errors
/// [`Error::Recording`] if a body moves in no run. [`Error::Interrupted`] after a stop request. Also an error if the
/// runs cannot be sampled or the initial guesses cannot be computed. The error of the progress listener if it returns
/// one.
pub fn run_friction_multistart(parameter_set: &ParameterSet, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    let structure = &parameter_set.structure;
    if !structure.has_friction() {
        return run_multistart(parameter_set, context);
    }
    check_motion(structure, context.source)?;
    let shortest = context.source.runs().map(Recording::len).min().unwrap_or(1);
    let sampling = Sampling { decimation: ((shortest - 1) / COARSE_SAMPLES).max(1), ..Sampling::default() };
    let weights = Weights { outputs: context.weights.to_vec(), robust_weights: None };
    let objective = Objective::new((&parameter_set.problem, context.source, context.stop), weights, sampling, false)?;
    let starts = initial_guesses(parameter_set, context, &objective)?;
    let mut candidates = optimize_on_coarse_grids(parameter_set, &objective, &starts, context.threads)?;
    let is_at_noise =
        candidates.first().is_some_and(|c| c.cost_per_residual() <= NOISE_FLOOR_FACTOR * context.noise_floor);
    if !is_at_noise && !has_stribeck_body(structure) {
        // The structure without friction is nested in this one, so its optima are initial guesses.
        let frictionless_guesses = guesses_from_frictionless_optima(parameter_set, context, &objective)?;
        candidates.extend(optimize_on_coarse_grids(parameter_set, &objective, &frictionless_guesses, context.threads)?);
        candidates = sort_by_cost(candidates);
    }
    Ok(candidates)
}

/// Return initial guesses from the optima of the structure without friction. The Coulomb friction of a guess is zero or
/// a fraction of the input force.
fn guesses_from_frictionless_optima(
    parameter_set: &ParameterSet,
    context: MultistartContext<'_>,
    objective: &Objective<'_>,
) -> Result<Vec<Candidate>> {
    let (linear, source) = without_friction(&parameter_set.structure, context.source)?;
    let submodel_context = MultistartContext { listener: None, ..context };
    let optima = none_if_invalid_model(run_on(&linear, &source, submodel_context))?.unwrap_or_default();
    let mut guesses = Vec::new();
    for optimum in optima.iter().take(MAX_FINAL_SURVIVORS) {
        let values = values_of(&linear, optimum);
        guesses.push(guess_at(parameter_set, &values, format!("{}, without friction", optimum.origin))?);
        guesses.extend(coulomb_force_guesses(parameter_set, objective, &values, &optimum.origin)?);
    }
    Ok(guesses)
}

/// Return the parameter set and the recordings without friction.
fn without_friction(structure: &ParametricStructure, source: &Recordings) -> Result<(ParameterSet, Recordings)> {
    let mut runs = source.runs().cloned().collect::<Vec<_>>();
    runs.iter_mut().for_each(|run| run.has_friction = false);
    Ok((ParameterSet::from_structure(with_friction(structure, |_| None))?, Recordings::new(runs)?))
}

fn initial_guesses(
    parameter_set: &ParameterSet,
    context: MultistartContext<'_>,
    objective: &Objective<'_>,
) -> Result<Vec<Candidate>> {
    let structure = &parameter_set.structure;
    let bodies = bodies(structure).count();
    if has_stribeck_body(structure) {
        let coulomb_set =
            ParameterSet::from_structure(with_friction(structure, |friction| Some(without_stribeck(friction))))?;
        let coulomb_candidates = run_friction_multistart(&coulomb_set, context)?;
        let best_candidates = coulomb_candidates.iter().take(MAX_FINAL_SURVIVORS);
        let starts = best_candidates
            .map(|candidate| stribeck_guesses(parameter_set, objective, &coulomb_set, candidate))
            .collect::<Result<Vec<_>>>()?;
        return Ok(starts.concat());
    }
    let mut starts = Vec::new();
    if 1 < bodies && bodies < structure.equations.len() {
        // Equations of attached bodies without friction are fitted separately. The equation of a body with friction is
        // not, because the measured motion of all attached bodies may explain it.
        for orders in order_sets(parameter_set) {
            let values = fit_frictionless_equations(structure, context, &orders)?;
            starts.extend(loaded_body_guesses(parameter_set, context, &values, false)?);
        }
        return Ok(starts);
    }
    // With measured signals as inputs, the equation of each body does not depend on the other equations.
    let (signed_structure, source) = with_measured_sign(structure, context.source)?;
    let signed_set = ParameterSet::from_structure(signed_structure)?;
    let signed_candidates = run_on(&signed_set, &source, context)?;
    for candidate in signed_candidates.iter().take(MAX_FINAL_SURVIVORS) {
        starts.extend(coulomb_guesses(parameter_set, objective, &signed_set, candidate)?);
    }
    if let Some(best_candidate) = signed_candidates.first().filter(|_| structure.equations.len() > 1) {
        starts.extend(loaded_body_guesses(parameter_set, context, &values_of(&signed_set, best_candidate), true)?);
    }
    Ok(starts)
}

/// Run the multistart of a problem without friction on other recordings.
fn run_on(parameter_set: &ParameterSet, source: &Recordings, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    let guess_source = context.guess_source.for_recordings(source);
    run_multistart(parameter_set, MultistartContext { source, guess_source: guess_source.as_ref(), ..context })
}

/// Equations of the bodies with friction, with their friction parameters.
fn bodies(structure: &ParametricStructure) -> impl Iterator<Item = (&ParametricEquation, &FrictionParameters)> {
    structure.equations.iter().filter_map(|equation| Some((equation, equation.friction.as_ref()?)))
}

/// Return [`Error::Recording`] if a body with friction moves in no run.
fn check_motion(structure: &ParametricStructure, source: &Recordings) -> Result<()> {
    for (equation, _) in bodies(structure) {
        let is_at_rest = |samples: &&[f64]| {
            let finite = samples.iter().filter(|v| !v.is_nan());
            let (low, high) =
                finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
            high - low <= MIN_MOTION_NOISE_RATIO * white_noise_deviation(samples)
        };
        if source.samples(equation.output)?.iter().all(is_at_rest) {
            let names: Vec<&str> = source.runs().map(Recording::name).collect();
            let (output, names) = (&structure.signals[equation.output], names.join(", "));
            let what = format!(
                "{output} never moves beyond its noise in {names}, and the friction of a body at rest has only a lower \
                 bound"
            );
            return Err(Error::Recording { what, remedy: "add a run in which the body slides".into() });
        }
    }
    Ok(())
}

/// Return the structure with the friction of each body replaced by the result of `friction_of_body`; None removes it.
fn with_friction(
    structure: &ParametricStructure,
    friction_of_body: impl Fn(&FrictionParameters) -> Option<FrictionParameters>,
) -> ParametricStructure {
    let equation_with_friction = |equation: &ParametricEquation| ParametricEquation {
        friction: equation.friction.as_ref().and_then(&friction_of_body),
        ..equation.clone()
    };
    ParametricStructure {
        equations: structure.equations.iter().map(equation_with_friction).collect(),
        ..structure.clone()
    }
}

fn has_stribeck_body(structure: &ParametricStructure) -> bool {
    bodies(structure).any(|(_, friction)| has_stribeck(friction))
}

fn has_stribeck(friction: &FrictionParameters) -> bool {
    friction.stribeck.1 != Coefficient::Fixed(0.0)
}

fn without_stribeck(friction: &FrictionParameters) -> FrictionParameters {
    let fixed_coefficient = |value| (1.0, Coefficient::Fixed(value));
    FrictionParameters { stribeck: fixed_coefficient(0.0), speed: fixed_coefficient(1.0), ..friction.clone() }
}

/// Return the values of all parameters of a candidate, including the coefficients that a coefficient law determines.
pub(super) fn values_of(parameter_set: &ParameterSet, candidate: &Candidate) -> Values {
    let mut values: Values = parameter_set.names().cloned().zip(candidate.result.values()).collect();
    values.extend(parameter_set.coefficients_by_name(&candidate.result.iterate.point.coefficients));
    values
}

/// Return the initial guess with the given parameter values, by name.
///
/// A parameter without a given value is in the middle of its bounds, or 0 if these are infinite.
pub(super) fn guess_at(parameter_set: &ParameterSet, values: &Values, origin: String) -> Result<Candidate> {
    let value_or_middle = |(name, (low, high)): (&String, (f64, f64))| {
        let midpoint = 0.5 * (low + high);
        values.get(name).copied().unwrap_or(if midpoint.is_finite() { midpoint } else { 0.0 })
    };
    let point: Vec<f64> = parameter_set.names().zip(parameter_set.problem.bounds()).map(value_or_middle).collect();
    Ok(Candidate::at(Iterate { point: parameter_set.problem.point(&point)?, states: Vec::new() }, origin))
}

/// Return the structure and the recordings of the given equations alone, in which the other measured signals are
/// inputs.
fn with_measured_inputs(
    structure: &ParametricStructure,
    source: &Recordings,
    equations: Vec<ParametricEquation>,
) -> Result<(ParametricStructure, Recordings)> {
    let mut signals: Vec<usize> = equations.iter().map(|equation| equation.output).collect();
    let outputs = signals.len();
    let input_signals = equations.iter().flat_map(|equation| &equation.terms).map(|term| term.signal);
    let mut input_signals: Vec<usize> = input_signals.filter(|signal| !signals.contains(signal)).collect();
    input_signals.sort_by(|&i, &j| structure.signals[i].cmp(&structure.signals[j]));
    input_signals.dedup();
    signals.extend(input_signals);
    let new_index = |signal: usize| signals.iter().position(|&old_index| old_index == signal).unwrap_or_default();
    let renumber_equation = |equation: ParametricEquation| {
        let output = new_index(equation.output);
        let mut terms: Vec<ParametricTerm> =
            equation.terms.into_iter().map(|term| ParametricTerm { signal: new_index(term.signal), ..term }).collect();
        terms.sort_by_key(|term| (term.signal != output, term.signal));
        ParametricEquation { output, terms, ..equation }
    };
    let equations: Vec<ParametricEquation> = equations.into_iter().map(renumber_equation).collect();
    let channel = |run: &Recording, signal: usize| -> Result<Channel> {
        let new_index = new_index(signal);
        let is_input_of = |equation: &ParametricEquation| {
            equation.output != new_index && equation.terms.iter().any(|term| term.signal == new_index)
        };
        Ok(Channel { enters_others: equations.iter().any(is_input_of), ..run.channel(signal)?.clone() })
    };
    let is_filtered = source.runs().any(|run| signals.iter().any(|&signal| run.channels()[signal].is_filtered));
    let mut runs = Vec::new();
    for run in source.runs() {
        let channels = signals.iter().map(|&signal| channel(run, signal)).collect::<Result<Vec<_>>>()?;
        let mut isolated_run = run.with_channels(channels, (0..outputs).collect())?;
        (isolated_run.is_coupled, isolated_run.has_friction) = (false, false);
        if !is_filtered {
            (isolated_run.filter, isolated_run.filter_states) = (None, 0);
        }
        let free_inputs = run.free_inputs.iter().filter(|(signal, _)| signals.contains(signal));
        isolated_run.free_inputs = free_inputs.map(|&(signal, law)| (new_index(signal), law)).collect();
        runs.push(isolated_run);
    }
    let mut isolated_structure = structure.clone();
    isolated_structure.inputs.retain(|input| signals.contains(&input.parameter.signal));
    isolated_structure.inputs.iter_mut().for_each(|input| input.parameter.signal = new_index(input.parameter.signal));
    if let Initial::Filtered { base, .. } = isolated_structure.initial.clone()
        && !is_filtered
    {
        isolated_structure.initial = *base;
    }
    isolated_structure.signals = signals.iter().map(|&signal| structure.signals[signal].clone()).collect();
    Ok((ParametricStructure { equations, coupled: false, ..isolated_structure }, Recordings::new(runs)?))
}

/// Replace the friction of each body by an input, the sign of its measured velocity.
///
/// Return the structure and the recordings.
fn with_measured_sign(
    structure: &ParametricStructure,
    source: &Recordings,
) -> Result<(ParametricStructure, Recordings)> {
    let (mut signed_structure, first_sign) = (structure.clone(), structure.signals.len());
    let moving_outputs: Vec<usize> = bodies(structure).map(|(equation, _)| equation.output).collect();
    let mut next_sign = first_sign;
    for equation in &mut signed_structure.equations {
        let Some(FrictionParameters { coulomb: (factor, coefficient), .. }) = equation.friction.take() else {
            continue;
        };
        signed_structure.signals.push(format!("{SIGN_PREFIX}{}", signed_structure.signals[equation.output]));
        equation.terms.push(ParametricTerm {
            signal: next_sign,
            order: Order::number(0.0),
            coefficient,
            factor: -factor,
        });
        next_sign += 1;
    }
    let mut runs = Vec::new();
    for run in source.runs() {
        let mut channels = run.channels().to_vec();
        for (&output, name) in moving_outputs.iter().zip(&signed_structure.signals[first_sign..]) {
            let samples = interpolate_gaps(&channels[output].samples);
            let sign = |w: &[f64]| if w[1] == w[0] { 0.0 } else { (w[1] - w[0]).signum() };
            let mut signs: Vec<f64> = samples.windows(2).map(sign).collect();
            // The sign of the last interval is repeated, so that there are as many signs as samples.
            signs.extend(signs.last().copied());
            channels.push(Channel::new(name, signs, Role::Derived));
        }
        let outputs = run.outputs().to_vec();
        let mut run_with_signs = run.with_channels(channels, outputs)?;
        run_with_signs.free_inputs.clone_from(&run.free_inputs);
        runs.push(run_with_signs);
    }
    let equations = signed_structure.equations.clone();
    with_measured_inputs(&signed_structure, &Recordings::new(runs)?, equations)
}

/// Return the sets of fixed orders at which the linear fits are made: integer orders and, if known, the typical orders.
///
/// The orders are not estimated in the linear fits, because the data determine them poorly. An overdamped body has a
/// different optimum at every order.
fn order_sets(parameter_set: &ParameterSet) -> Vec<Values> {
    let typical_values =
        |name: &String| parameter_set.structure.hints.typical_orders.get(name).filter(|values| !values.is_empty());
    let (mut integer_values, mut noninteger_values) = (Values::new(), Values::new());
    for ((name, default_order), &(low, high)) in
        parameter_set.orders.iter().zip(parameter_set.integer_orders()).zip(parameter_set.bounds())
    {
        let values = typical_values(name).map_or(&[][..], Vec::as_slice);
        let integer = values.iter().rfind(|v| **v == v.round()).copied().unwrap_or(default_order);
        let limit_to_bounds = |value: f64| value.max(low).min(high);
        integer_values.insert(name.clone(), limit_to_bounds(integer));
        if let Some(value) = values.iter().rfind(|v| **v != integer) {
            noninteger_values.insert(name.clone(), limit_to_bounds(*value));
        }
    }
    if noninteger_values.is_empty() {
        return vec![integer_values];
    }
    let mut mixed_values = integer_values.clone();
    mixed_values.extend(noninteger_values);
    vec![integer_values, mixed_values]
}

/// Fit each equation without friction by itself, at the given orders.
///
/// Return orders and coefficients by name. The coefficients of the other equations are 0.
fn fit_frictionless_equations(
    structure: &ParametricStructure,
    context: MultistartContext<'_>,
    orders: &Values,
) -> Result<Values> {
    let mut values = orders.clone();
    values.extend(structure.coefficient_names().into_iter().map(|name| (name, 0.0)));
    for (equation, &weight) in structure.equations.iter().zip(context.weights) {
        if equation.friction.is_some() {
            continue;
        }
        let (isolated_structure, source) = with_measured_inputs(structure, context.source, vec![equation.clone()])?;
        let isolated_structure = ParametricStructure { laws: Vec::new(), ..isolated_structure };
        let isolated_set = ParameterSet::from_structure(isolated_structure.with_orders(orders)?)?;
        let candidates =
            run_on(&isolated_set, &source, MultistartContext { weights: &[weight], listener: None, ..context })?;
        if let Some(best_candidate) = candidates.first() {
            values.extend(isolated_set.coefficients_by_name(&best_candidate.result.iterate.point.coefficients));
        }
    }
    Ok(values)
}

/// Return initial guesses from fits of each body in isolation, to which the coupling forces of attached bodies are
/// added.
///
/// Each body is fitted in isolation first. Otherwise, the measured motion of the neighboring bodies could explain the
/// motion of the body without its input and friction. The coupling forces then follow from the equality of action and
/// reaction. If `has_common_ratio`, the attached inertia is the same fraction of the inertia of every body. Otherwise
/// each body has its own fraction.
fn loaded_body_guesses(
    parameter_set: &ParameterSet,
    context: MultistartContext<'_>,
    values: &Values,
    has_common_ratio: bool,
) -> Result<Vec<Candidate>> {
    let structure = &parameter_set.structure;
    let mut isolated_fits = Vec::new();
    for (equation, _) in bodies(structure) {
        let (orders, coefficients) = fit_isolated_body(parameter_set, context, equation, values)?;
        if !coefficients.is_empty() {
            isolated_fits.push((equation, orders, coefficients));
        }
    }
    if isolated_fits.is_empty() {
        return Ok(Vec::new());
    }
    let combinations = u32::try_from(isolated_fits.len()).ok().and_then(|n| LOAD_INERTIA_RATIOS.len().checked_pow(n));
    let has_common_ratio = has_common_ratio || combinations.is_none_or(|n| n > MAX_LOAD_COMBINATIONS);
    let mut inertia_ratios: Vec<Vec<f64>> =
        LOAD_INERTIA_RATIOS.map(|inertia_ratio| vec![inertia_ratio; isolated_fits.len()]).to_vec();
    if !has_common_ratio {
        inertia_ratios = vec![Vec::new()];
        for _ in &isolated_fits {
            let append_ratio = |ratios: Vec<f64>| {
                LOAD_INERTIA_RATIOS.map(|inertia_ratio| [ratios.as_slice(), &[inertia_ratio]].concat())
            };
            inertia_ratios = inertia_ratios.into_iter().flat_map(append_ratio).collect();
        }
    }
    let outputs: Vec<&str> =
        isolated_fits.iter().map(|(equation, ..)| structure.signals[equation.output].as_str()).collect();
    let each = if isolated_fits.len() > 1 { ", each" } else { "" };
    let guess = |inertia_ratios: Vec<f64>| {
        // Forces on a body act on the others, too.
        let (mut coefficient_values, mut point_values) = (values.clone(), values.clone());
        for ((equation, orders, coefficients), inertia_ratio) in isolated_fits.iter().zip(&inertia_ratios) {
            coefficient_values.extend(reaction_coefficients(structure, equation, values, *inertia_ratio));
            coefficient_values
                .extend(coefficients.iter().map(|(name, value)| (name.clone(), (1.0 + inertia_ratio) * value)));
            point_values.extend(orders.clone());
        }
        point_values.extend(
            parameter_set.coefficients.iter().cloned().zip(parameter_set.free_coefficients(&coefficient_values)),
        );
        let ratio_texts: Vec<String> =
            inertia_ratios.iter().map(|inertia_ratio| format_general(*inertia_ratio, 6)).collect();
        let inertia_text = if has_common_ratio { ratio_texts[0].clone() } else { ratio_texts.join(" and ") };
        let origin = format!("{}{each} separately, with {inertia_text} times its own inertia", outputs.join(" and "));
        guess_at(parameter_set, &point_values, origin)
    };
    inertia_ratios.into_iter().map(guess).collect()
}

/// Fit an isolated body with friction to its inputs.
///
/// Return orders and coefficients by name. The map of coefficients is empty if the fit has no solution.
fn fit_isolated_body(
    parameter_set: &ParameterSet,
    MultistartContext { source, stop, .. }: MultistartContext<'_>,
    equation: &ParametricEquation,
    values: &Values,
) -> Result<(Values, Values)> {
    let structure = &parameter_set.structure;
    let is_output = |signal: usize| structure.equations.iter().any(|e| e.output == signal);
    let mut isolated_equation = equation.clone();
    isolated_equation.terms.retain(|term| term.signal == equation.output || !is_output(term.signal));
    // Orders that depend on several free orders are fixed: 1 for the motion of the body itself, 0 for inputs.
    for term in isolated_equation.terms.iter_mut().filter(|term| term.order.is_free() && !term.order.is_single()) {
        term.order = Order::number(if term.signal == equation.output { 1.0 } else { 0.0 });
    }
    let mut fixed_orders = Values::new();
    for term in isolated_equation.input_terms() {
        fixed_orders.extend(term.order.names().map(|name| (name.clone(), 0.0)));
    }
    for term in isolated_equation.autoregressive_terms() {
        fixed_orders.extend(term.order.names().map(|name| (name.clone(), 1.0)));
    }
    fixed_orders.extend(equation.order.names().map(|name| (name.clone(), MAX_BODY_ORDER)));
    let other_orders =
        || structure.equations.iter().filter(|e| e.output != equation.output).flat_map(ParametricEquation::orders);
    for (name, value) in &mut fixed_orders {
        let is_shared = other_orders().any(|order| order.names().any(|other_name| other_name == name));
        if is_shared && !equation.order.names().any(|other_name| other_name == name) {
            *value = values.get(name).copied().unwrap_or(*value);
        }
        if let Some(index) = parameter_set.orders.iter().position(|other_name| other_name == name) {
            let (low, high) = parameter_set.bounds()[index];
            *value = value.max(low).min(high);
        }
    }
    isolated_equation.order = isolated_equation.order.substitute(&fixed_orders);
    isolated_equation.terms.iter_mut().for_each(|term| term.order = term.order.substitute(&fixed_orders));
    let inputs = guess_at(parameter_set, values, String::new())?.result.iterate.point.inputs;
    let mut runs = source.runs().map(|run| run.with_free_inputs(&inputs)).collect::<Result<Vec<_>>>()?;
    runs.iter_mut().for_each(|run| run.filter = None);
    let coefficients = fit_sliding_body(&runs, &isolated_equation, stop)?;
    Ok((fixed_orders, coefficients))
}

fn value_at(values: &Values, name: &str) -> f64 {
    values.get(name).copied().unwrap_or(0.0)
}

/// Return the coefficients of the reaction forces of attached bodies on a body, scaled by `inertia_ratio`.
fn reaction_coefficients(
    structure: &ParametricStructure,
    equation: &ParametricEquation,
    values: &Values,
    inertia_ratio: f64,
) -> Values {
    let order = |term: &ParametricTerm| term.order.at(|name| value_at(values, name));
    let sorted_terms = |equation_of_body: &ParametricEquation, signal: usize| {
        let mut terms: Vec<ParametricTerm> =
            equation_of_body.terms.iter().filter(|term| term.signal == signal).cloned().collect();
        terms.sort_by(|a, b| order(a).total_cmp(&order(b)));
        terms
    };
    let mut out = Values::new();
    for other in structure.equations.iter().filter(|e| e.output != equation.output) {
        for (other_term, own_term) in sorted_terms(other, other.output).iter().zip(sorted_terms(equation, other.output))
        {
            if let Some(name) = own_term
                .coefficient
                .name()
                .filter(|_| (order(&own_term) - order(other_term)).abs() <= MAX_REACTION_ORDER_GAP)
            {
                out.insert(name.clone(), -inertia_ratio * value_of(other_term, values) / own_term.factor);
            }
        }
    }
    out
}

/// Coefficient of a term, multiplied by its factor.
fn value_of(term: &ParametricTerm, values: &Values) -> f64 {
    coefficient_value((term.factor, &term.coefficient), values)
}

fn coefficient_value((factor, coefficient): (f64, &Coefficient), values: &Values) -> f64 {
    factor
        * match coefficient {
            Coefficient::Fixed(value) => *value,
            Coefficient::Free(name) => value_at(values, name),
        }
}

/// Return initial guesses of Coulomb friction from the fit `candidate`, which uses the measured sign of the velocity.
///
/// Further guesses are fractions of the input force.
fn coulomb_guesses(
    parameter_set: &ParameterSet,
    objective: &Objective<'_>,
    signed_set: &ParameterSet,
    candidate: &Candidate,
) -> Result<Vec<Candidate>> {
    let (mut values, origin) = (values_of(signed_set, candidate), &candidate.origin);
    let coulomb = free_coulomb_coefficients(&parameter_set.structure);
    if coulomb.is_empty() {
        return Ok(vec![guess_at(parameter_set, &values, origin.clone())?]);
    }
    let mut out = Vec::new();
    let measured_forces: Vec<f64> = coulomb.iter().map(|(.., name)| value_at(&values, name).max(0.0)).collect();
    if measured_forces.iter().any(|value| *value > 0.0) {
        for ratio in MEASURED_SIGN_RATIOS {
            out.push(guess_with_friction(
                parameter_set,
                &values,
                &measured_forces,
                ratio,
                &format!("{origin}, measured sign"),
            )?);
        }
    }
    let (linear, source) = without_friction(&parameter_set.structure, objective.source())?;
    let frictionless_objective = Objective::new(
        (&linear.problem, &source, objective.stop()),
        objective.weights.clone(),
        objective.sampling,
        false,
    )?;
    let guess = guess_at(&linear, &values, String::new())?;
    let start = &guess.result.iterate;
    let frictionless_optimum = match frictionless_objective.minimize_in(
        &linear.problem_at(start, false, &[]),
        start,
        FIRST_BUDGET_EVALUATIONS,
    ) {
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        // Without any friction the simulation diverges.
        Err(_) => return Ok(out),
        Ok(frictionless_optimum) => guess.with_result(frictionless_optimum),
    };
    values.extend(values_of(&linear, &frictionless_optimum));
    out.extend(coulomb_force_guesses(parameter_set, objective, &values, origin)?);
    Ok(out)
}

/// Free Coulomb coefficients, each with its equation and its factor.
fn free_coulomb_coefficients(structure: &ParametricStructure) -> Vec<(&ParametricEquation, f64, &String)> {
    bodies(structure)
        .filter_map(|(equation, friction)| Some((equation, friction.coulomb.0, friction.coulomb.1.name()?)))
        .collect()
}

/// Return the initial guess in which the Coulomb friction of each body is `ratio` times its force in `forces`.
fn guess_with_friction(
    parameter_set: &ParameterSet,
    values: &Values,
    forces: &[f64],
    ratio: f64,
    origin: &str,
) -> Result<Candidate> {
    let mut values = values.clone();
    for ((.., name), force) in free_coulomb_coefficients(&parameter_set.structure).into_iter().zip(forces) {
        values.insert(name.clone(), ratio * force);
    }
    guess_at(parameter_set, &values, format!("{origin}, friction times {}", format_general(ratio, 6)))
}

/// Return initial guesses of Coulomb friction: fractions of the largest input force on each body.
fn coulomb_force_guesses(
    parameter_set: &ParameterSet,
    objective: &Objective<'_>,
    values: &Values,
    origin: &str,
) -> Result<Vec<Candidate>> {
    let coulomb = free_coulomb_coefficients(&parameter_set.structure);
    let force = |(equation, factor, _): &(&ParametricEquation, f64, _)| {
        Ok(largest_input_force(objective.source(), equation, values)? / factor)
    };
    let forces = coulomb.iter().map(force).collect::<Result<Vec<f64>>>()?;
    if forces.iter().all(|force| *force <= 0.0) {
        return Ok(Vec::new());
    }
    COULOMB_FORCE_RATIOS
        .iter()
        .map(|&ratio| guess_with_friction(parameter_set, values, &forces, ratio, &format!("{origin}, input force")))
        .collect()
}

/// Return initial guesses of Stribeck friction, from a fit with Coulomb friction alone.
fn stribeck_guesses(
    parameter_set: &ParameterSet,
    objective: &Objective<'_>,
    coulomb_set: &ParameterSet,
    candidate: &Candidate,
) -> Result<Vec<Candidate>> {
    let (values, origin) = (values_of(coulomb_set, candidate), &candidate.origin);
    let (mut forces, mut speeds) = (Values::new(), Values::new());
    for (equation, friction) in bodies(&parameter_set.structure).filter(|(_, friction)| has_stribeck(friction)) {
        if let (factor, Coefficient::Free(name)) = &friction.stribeck {
            let coulomb = coefficient_value((friction.coulomb.0.abs(), &friction.coulomb.1), &values);
            let force =
                if coulomb == 0.0 { largest_input_force(objective.source(), equation, &values)? } else { coulomb };
            forces.insert(name.clone(), force / factor);
        }
        if let (_, Coefficient::Free(name)) = &friction.speed {
            speeds.insert(name.clone(), rms_speed(objective, equation.output)?);
        }
    }
    let ratios_or_first = |speed_values: &Values, ratios: [f64; 3]| {
        if speed_values.is_empty() {
            ratios[..1].to_vec()
        } else {
            ratios.to_vec()
        }
    };
    let mut out = Vec::new();
    for force_ratio in ratios_or_first(&forces, STRIBECK_COULOMB_RATIOS) {
        for speed_ratio in ratios_or_first(&speeds, STRIBECK_SPEED_RATIOS) {
            let mut guess = values.clone();
            guess.extend(forces.iter().map(|(name, force)| (name.clone(), force_ratio * force)));
            guess.extend(speeds.iter().map(|(name, speed)| (name.clone(), speed_ratio * speed)));
            let (force_ratio, speed_ratio) = (format_general(force_ratio, 6), format_general(speed_ratio, 6));
            let guess_origin = format!("{origin}, Stribeck {force_ratio} of Coulomb below {speed_ratio} of the speed");
            out.push(guess_at(parameter_set, &guess, guess_origin)?);
        }
    }
    Ok(out)
}

/// Root-mean-square speed of an output, in its unit per second.
///
/// Each speed is an average over one interval of the decimated samples.
#[allow(clippy::cast_precision_loss)]
fn rms_speed(objective: &Objective<'_>, output: usize) -> Result<f64> {
    let decimation = objective.sampling.decimation;
    let mut speeds = Vec::new();
    for (samples, (step, _)) in
        objective.source().samples(output)?.iter().zip(objective.source().intervals_and_durations())
    {
        let finite: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).step_by(decimation).collect();
        speeds.extend(finite.windows(2).map(|w| (w[1] - w[0]) / (step * decimation as f64)));
    }
    Ok(root_mean_square(&speeds))
}

/// Largest root-mean-square force that one input exerts on a body, in the unit of D^α y for the output y and order α.
/// Only input terms of fixed order 0 count.
fn largest_input_force(source: &Recordings, equation: &ParametricEquation, values: &Values) -> Result<f64> {
    let mut largest: f64 = 0.0;
    for term in equation.input_terms().filter(|term| !term.order.is_free() && term.order.constant == 0.0) {
        let finite: Vec<f64> = source.samples(term.signal)?.concat().into_iter().filter(|v| !v.is_nan()).collect();
        largest = largest.max(value_of(term, values).abs() * root_mean_square(&finite));
    }
    Ok(largest)
}
