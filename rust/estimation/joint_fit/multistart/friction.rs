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
pub fn run_friction_multistart(free: &ParameterSet, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    let structure = &free.structure;
    if !structure.has_friction() {
        return run_multistart(free, context);
    }
    check_motion(structure, context.source)?;
    let shortest = context.source.runs().iter().map(Recording::len).min().unwrap_or(1);
    let sampling = Sampling { decimation: ((shortest - 1) / COARSE_SAMPLES).max(1), ..Sampling::default() };
    let weights = Weights { outputs: context.weights.to_vec(), robust_weights: None };
    let grid = Objective::new((&free.problem, context.source, context.stop), weights, sampling, false)?;
    let starts = initial_guesses(free, context, &grid)?;
    let mut reached = optimize_on_coarse_grids(free, &grid, &starts, context.threads)?;
    let is_at_noise = reached.first().is_some_and(|c| c.cost_per_residual() <= NOISE_FLOOR_FACTOR * context.floor);
    if !is_at_noise && !has_stribeck_body(structure) {
        // The structure without friction is nested in this one, so its optima are initial guesses.
        let more = guesses_from_frictionless_optima(free, context, &grid)?;
        reached.extend(optimize_on_coarse_grids(free, &grid, &more, context.threads)?);
        reached = sort_by_cost(reached);
    }
    Ok(reached)
}

/// Return initial guesses from the optima of the structure without friction. The Coulomb friction of a guess is zero or
/// a fraction of the input force.
fn guesses_from_frictionless_optima(
    free: &ParameterSet,
    context: MultistartContext<'_>,
    grid: &Objective<'_>,
) -> Result<Vec<Candidate>> {
    let (linear, source) = without_friction(&free.structure, context.source)?;
    let own = MultistartContext { listener: None, ..context };
    let optima = none_if_invalid_model(run_on(&linear, &source, own))?.unwrap_or_default();
    let mut guesses = Vec::new();
    for optimum in optima.iter().take(MAX_FINAL_SURVIVORS) {
        let values = values_of(&linear, optimum);
        guesses.push(guess_at(free, &values, format!("{}, without friction", optimum.origin))?);
        guesses.extend(coulomb_force_guesses(free, grid, &values, &optimum.origin)?);
    }
    Ok(guesses)
}

/// Return the parameter set and the recordings without friction.
fn without_friction(structure: &ParametricStructure, source: &Recordings) -> Result<(ParameterSet, Recordings)> {
    let mut runs = source.runs().to_vec();
    runs.iter_mut().for_each(|run| run.has_friction = false);
    Ok((ParameterSet::from_structure(with_friction(structure, |_| None))?, Recordings::new(runs)?))
}

fn initial_guesses(
    free: &ParameterSet,
    context: MultistartContext<'_>,
    grid: &Objective<'_>,
) -> Result<Vec<Candidate>> {
    let structure = &free.structure;
    let bodies = bodies(structure).count();
    if has_stribeck_body(structure) {
        let less = ParameterSet::from_structure(with_friction(structure, |friction| Some(without_stribeck(friction))))?;
        let reached = run_friction_multistart(&less, context)?;
        let best = reached.iter().take(MAX_FINAL_SURVIVORS);
        let starts =
            best.map(|candidate| stribeck_guesses(free, grid, &less, candidate)).collect::<Result<Vec<_>>>()?;
        return Ok(starts.concat());
    }
    let mut starts = Vec::new();
    if 1 < bodies && bodies < structure.equations.len() {
        // Equations of attached bodies without friction are fitted separately. The equation of a body with friction is
        // not, because the measured motion of all attached bodies may explain it.
        for orders in order_sets(free) {
            let values = fit_frictionless_equations(structure, context, &orders)?;
            starts.extend(loaded_body_guesses(free, context, &values, false)?);
        }
        return Ok(starts);
    }
    // With measured signals as inputs, the equation of each body does not depend on the other equations.
    let (signed, source) = with_measured_sign(structure, context.source)?;
    let signed = ParameterSet::from_structure(signed)?;
    let reached = run_on(&signed, &source, context)?;
    for candidate in reached.iter().take(MAX_FINAL_SURVIVORS) {
        starts.extend(coulomb_guesses(free, grid, &signed, candidate)?);
    }
    if let Some(best) = reached.first().filter(|_| structure.equations.len() > 1) {
        starts.extend(loaded_body_guesses(free, context, &values_of(&signed, best), true)?);
    }
    Ok(starts)
}

/// Run the multistart of a problem without friction on other recordings.
fn run_on(free: &ParameterSet, source: &Recordings, context: MultistartContext<'_>) -> Result<Vec<Candidate>> {
    let starts = context.starts.for_recordings(source);
    run_multistart(free, MultistartContext { source, starts: starts.as_ref(), ..context })
}

/// Equations of the bodies with friction, with their friction parameters.
fn bodies(structure: &ParametricStructure) -> impl Iterator<Item = (&ParametricEquation, &FrictionParameters)> {
    structure.equations.iter().filter_map(|item| Some((item, item.friction.as_ref()?)))
}

/// Return [`Error::Recording`] if a body with friction moves in no run.
fn check_motion(structure: &ParametricStructure, source: &Recordings) -> Result<()> {
    for (item, _) in bodies(structure) {
        let is_at_rest = |samples: &&[f64]| {
            let finite = samples.iter().filter(|v| !v.is_nan());
            let (low, high) =
                finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
            high - low <= MIN_MOTION_NOISE_RATIO * white_noise_deviation(samples)
        };
        if source.samples(item.output)?.iter().all(is_at_rest) {
            let names: Vec<&str> = source.runs().iter().map(Recording::name).collect();
            let (output, names) = (&structure.signals[item.output], names.join(", "));
            let what = format!(
                "{output} never moves beyond its noise in {names}, and the friction of a body at rest has only a lower \
                 bound"
            );
            return Err(Error::Recording { what, remedy: "add a run in which the body slides".into() });
        }
    }
    Ok(())
}

/// Return the structure with the friction of each body replaced by the result of `other`; None removes it.
fn with_friction(
    structure: &ParametricStructure,
    other: impl Fn(&FrictionParameters) -> Option<FrictionParameters>,
) -> ParametricStructure {
    let of = |item: &ParametricEquation| ParametricEquation {
        friction: item.friction.as_ref().and_then(&other),
        ..item.clone()
    };
    ParametricStructure { equations: structure.equations.iter().map(of).collect(), ..structure.clone() }
}

fn has_stribeck_body(structure: &ParametricStructure) -> bool {
    bodies(structure).any(|(_, friction)| has_stribeck(friction))
}

fn has_stribeck(friction: &FrictionParameters) -> bool {
    friction.stribeck.1 != Coefficient::Known(0.0)
}

fn without_stribeck(friction: &FrictionParameters) -> FrictionParameters {
    let fixed = |value| (1.0, Coefficient::Known(value));
    FrictionParameters { stribeck: fixed(0.0), speed: fixed(1.0), ..friction.clone() }
}

/// Return the values of all parameters of a candidate, including the coefficients that a coefficient law determines.
pub(super) fn values_of(free: &ParameterSet, candidate: &Candidate) -> Values {
    let mut values: Values = free.names().cloned().zip(candidate.result.values()).collect();
    values.extend(free.coefficients_by_name(&candidate.result.iterate.point.coefficients));
    values
}

/// Return the initial guess with the given parameter values, by name.
///
/// A parameter without a given value is in the middle of its bounds, or 0 if these are infinite.
pub(super) fn guess_at(free: &ParameterSet, values: &Values, origin: String) -> Result<Candidate> {
    let of = |(name, (low, high)): (&String, (f64, f64))| {
        let middle = 0.5 * (low + high);
        values.get(name).copied().unwrap_or(if middle.is_finite() { middle } else { 0.0 })
    };
    let at: Vec<f64> = free.names().zip(free.problem.bounds()).map(of).collect();
    Ok(Candidate::at(Iterate { point: free.problem.point(&at)?, states: Vec::new() }, origin))
}

/// Return the structure and the recordings of the given equations alone, in which the other measured signals are
/// inputs.
fn with_measured_inputs(
    structure: &ParametricStructure,
    source: &Recordings,
    equations: Vec<ParametricEquation>,
) -> Result<(ParametricStructure, Recordings)> {
    let mut used: Vec<usize> = equations.iter().map(|item| item.output).collect();
    let outputs = used.len();
    let others = equations.iter().flat_map(|item| &item.terms).map(|term| term.signal);
    let mut others: Vec<usize> = others.filter(|signal| !used.contains(signal)).collect();
    others.sort_by(|&i, &j| structure.signals[i].cmp(&structure.signals[j]));
    others.dedup();
    used.extend(others);
    let place = |signal: usize| used.iter().position(|&of| of == signal).unwrap_or_default();
    let equation = |item: ParametricEquation| {
        let output = place(item.output);
        let mut terms: Vec<ParametricTerm> =
            item.terms.into_iter().map(|term| ParametricTerm { signal: place(term.signal), ..term }).collect();
        terms.sort_by_key(|term| (term.signal != output, term.signal));
        ParametricEquation { output, terms, ..item }
    };
    let equations: Vec<ParametricEquation> = equations.into_iter().map(equation).collect();
    let channel = |run: &Recording, signal: usize| -> Result<Channel> {
        let place = place(signal);
        let enters =
            |item: &ParametricEquation| item.output != place && item.terms.iter().any(|term| term.signal == place);
        Ok(Channel { enters_others: equations.iter().any(enters), ..run.channel(signal)?.clone() })
    };
    let is_filtered = source.runs().iter().any(|run| used.iter().any(|&signal| run.channels()[signal].is_filtered));
    let mut runs = Vec::new();
    for run in source.runs() {
        let channels = used.iter().map(|&signal| channel(run, signal)).collect::<Result<Vec<_>>>()?;
        let mut isolated = run.with_channels(channels, (0..outputs).collect())?;
        (isolated.is_coupled, isolated.has_friction) = (false, false);
        if !is_filtered {
            (isolated.filter, isolated.filter_states) = (None, 0);
        }
        let free = run.free_inputs.iter().filter(|(signal, _)| used.contains(signal));
        isolated.free_inputs = free.map(|&(signal, law)| (place(signal), law)).collect();
        runs.push(isolated);
    }
    let mut isolated = structure.clone();
    isolated.inputs.retain(|input| used.contains(&input.free.signal));
    isolated.inputs.iter_mut().for_each(|input| input.free.signal = place(input.free.signal));
    if let Initial::Filtered { base, .. } = isolated.initial.clone()
        && !is_filtered
    {
        isolated.initial = *base;
    }
    isolated.signals = used.iter().map(|&signal| structure.signals[signal].clone()).collect();
    Ok((ParametricStructure { equations, coupled: false, ..isolated }, Recordings::new(runs)?))
}

/// Replace the friction of each body by an input, the sign of its measured velocity.
///
/// Return the structure and the recordings.
fn with_measured_sign(
    structure: &ParametricStructure,
    source: &Recordings,
) -> Result<(ParametricStructure, Recordings)> {
    let (mut signed, first) = (structure.clone(), structure.signals.len());
    let moving: Vec<usize> = bodies(structure).map(|(item, _)| item.output).collect();
    let mut next = first;
    for item in &mut signed.equations {
        let Some(FrictionParameters { coulomb: (factor, coefficient), .. }) = item.friction.take() else { continue };
        signed.signals.push(format!("{SIGN_PREFIX}{}", signed.signals[item.output]));
        item.terms.push(ParametricTerm { signal: next, order: Order::number(0.0), coefficient, factor: -factor });
        next += 1;
    }
    let mut runs = Vec::new();
    for run in source.runs() {
        let mut channels = run.channels().to_vec();
        for (&output, name) in moving.iter().zip(&signed.signals[first..]) {
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
    let equations = signed.equations.clone();
    with_measured_inputs(&signed, &Recordings::new(runs)?, equations)
}

/// Return the sets of fixed orders at which the linear fits are made: integer orders and, if known, the typical orders.
///
/// The orders are not estimated in the linear fits, because the data determine them poorly. An overdamped body has a
/// different optimum at every order.
fn order_sets(free: &ParameterSet) -> Vec<Values> {
    let natural = |name: &String| free.structure.hints.natural.get(name).filter(|values| !values.is_empty());
    let (mut whole, mut other) = (Values::new(), Values::new());
    for ((name, usual), &(low, high)) in free.orders.iter().zip(free.integer_orders()).zip(free.bounds()) {
        let values = natural(name).map_or(&[][..], Vec::as_slice);
        let integer = values.iter().rfind(|v| **v == v.round()).copied().unwrap_or(usual);
        let within = |value: f64| value.max(low).min(high);
        whole.insert(name.clone(), within(integer));
        if let Some(value) = values.iter().rfind(|v| **v != integer) {
            other.insert(name.clone(), within(*value));
        }
    }
    if other.is_empty() {
        return vec![whole];
    }
    let mut mixed = whole.clone();
    mixed.extend(other);
    vec![whole, mixed]
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
    for (item, &weight) in structure.equations.iter().zip(context.weights) {
        if item.friction.is_some() {
            continue;
        }
        let (isolated, source) = with_measured_inputs(structure, context.source, vec![item.clone()])?;
        let isolated = ParametricStructure { laws: Vec::new(), ..isolated };
        let isolated = ParameterSet::from_structure(isolated.with_orders(orders)?)?;
        let reached = run_on(&isolated, &source, MultistartContext { weights: &[weight], listener: None, ..context })?;
        if let Some(best) = reached.first() {
            values.extend(isolated.coefficients_by_name(&best.result.iterate.point.coefficients));
        }
    }
    Ok(values)
}

/// Return initial guesses from fits of each body in isolation, to which the coupling forces of attached bodies are
/// added.
///
/// Each body is fitted in isolation first. Otherwise, the measured motion of the neighboring bodies could explain the
/// motion of the body without its input and friction. The coupling forces then follow from the equality of action and
/// reaction. If `together`, the attached inertia is the same fraction of the inertia of every body. Otherwise each body
/// has its own fraction.
fn loaded_body_guesses(
    free: &ParameterSet,
    context: MultistartContext<'_>,
    values: &Values,
    together: bool,
) -> Result<Vec<Candidate>> {
    let structure = &free.structure;
    let mut fitted = Vec::new();
    for (item, _) in bodies(structure) {
        let (orders, numbers) = fit_isolated_body(free, context, item, values)?;
        if !numbers.is_empty() {
            fitted.push((item, orders, numbers));
        }
    }
    if fitted.is_empty() {
        return Ok(Vec::new());
    }
    let combinations = u32::try_from(fitted.len()).ok().and_then(|n| LOAD_INERTIA_RATIOS.len().checked_pow(n));
    let together = together || combinations.is_none_or(|n| n > MAX_LOAD_COMBINATIONS);
    let mut shares: Vec<Vec<f64>> = LOAD_INERTIA_RATIOS.map(|share| vec![share; fitted.len()]).to_vec();
    if !together {
        shares = vec![Vec::new()];
        for _ in &fitted {
            let longer = |some: Vec<f64>| LOAD_INERTIA_RATIOS.map(|share| [some.as_slice(), &[share]].concat());
            shares = shares.into_iter().flat_map(longer).collect();
        }
    }
    let outputs: Vec<&str> = fitted.iter().map(|(item, ..)| structure.signals[item.output].as_str()).collect();
    let each = if fitted.len() > 1 { ", each" } else { "" };
    let guess = |shares: Vec<f64>| {
        // Forces on a body act on the others, too.
        let (mut candidate, mut at) = (values.clone(), values.clone());
        for ((item, orders, numbers), share) in fitted.iter().zip(&shares) {
            candidate.extend(reaction_coefficients(structure, item, values, *share));
            candidate.extend(numbers.iter().map(|(name, value)| (name.clone(), (1.0 + share) * value)));
            at.extend(orders.clone());
        }
        at.extend(free.coefficients.iter().cloned().zip(free.free_from(&candidate)));
        let named: Vec<String> = shares.iter().map(|share| format_general(*share, 6)).collect();
        let carried = if together { named[0].clone() } else { named.join(" and ") };
        let words = format!("{}{each} separately, with {carried} times its own inertia", outputs.join(" and "));
        guess_at(free, &at, words)
    };
    shares.into_iter().map(guess).collect()
}

/// Fit an isolated body with friction to its inputs.
///
/// Return orders and coefficients by name. The map of coefficients is empty if the fit has no solution.
fn fit_isolated_body(
    free: &ParameterSet,
    MultistartContext { source, stop, .. }: MultistartContext<'_>,
    item: &ParametricEquation,
    values: &Values,
) -> Result<(Values, Values)> {
    let structure = &free.structure;
    let is_output = |signal: usize| structure.equations.iter().any(|e| e.output == signal);
    let mut isolated = item.clone();
    isolated.terms.retain(|term| term.signal == item.output || !is_output(term.signal));
    // Orders that depend on several free orders are fixed: 1 for the motion of the body itself, 0 for inputs.
    for term in isolated.terms.iter_mut().filter(|term| term.order.is_free() && !term.order.is_single()) {
        term.order = Order::number(if term.signal == item.output { 1.0 } else { 0.0 });
    }
    let mut usual = Values::new();
    for term in isolated.input_terms() {
        usual.extend(term.order.names().map(|name| (name.clone(), 0.0)));
    }
    for term in isolated.autoregressive_terms() {
        usual.extend(term.order.names().map(|name| (name.clone(), 1.0)));
    }
    usual.extend(item.order.names().map(|name| (name.clone(), MAX_BODY_ORDER)));
    let others = || structure.equations.iter().filter(|e| e.output != item.output).flat_map(ParametricEquation::orders);
    for (name, value) in &mut usual {
        let shared = others().any(|order| order.names().any(|of| of == name));
        if shared && !item.order.names().any(|of| of == name) {
            *value = values.get(name).copied().unwrap_or(*value);
        }
        if let Some(place) = free.orders.iter().position(|of| of == name) {
            let (low, high) = free.bounds()[place];
            *value = value.max(low).min(high);
        }
    }
    isolated.order = isolated.order.substitute(&usual);
    isolated.terms.iter_mut().for_each(|term| term.order = term.order.substitute(&usual));
    let inputs = guess_at(free, values, String::new())?.result.iterate.point.inputs;
    let mut runs = source.runs().iter().map(|run| run.with_free_inputs(&inputs)).collect::<Result<Vec<_>>>()?;
    runs.iter_mut().for_each(|run| run.filter = None);
    let numbers = fit_sliding_body(&runs, &isolated, stop)?;
    Ok((usual, numbers))
}

fn value_at(values: &Values, name: &str) -> f64 {
    values.get(name).copied().unwrap_or(0.0)
}

/// Return the coefficients of the reaction forces of attached bodies on a body, scaled by the inertia ratio `share`.
fn reaction_coefficients(
    structure: &ParametricStructure,
    item: &ParametricEquation,
    values: &Values,
    share: f64,
) -> Values {
    let order = |term: &ParametricTerm| term.order.at(|name| value_at(values, name));
    let sorted = |of: &ParametricEquation, signal: usize| {
        let mut terms: Vec<ParametricTerm> = of.terms.iter().filter(|term| term.signal == signal).cloned().collect();
        terms.sort_by(|a, b| order(a).total_cmp(&order(b)));
        terms
    };
    let mut out = Values::new();
    for other in structure.equations.iter().filter(|e| e.output != item.output) {
        for (other_term, own_term) in sorted(other, other.output).iter().zip(sorted(item, other.output)) {
            if let Some(name) = own_term
                .coefficient
                .name()
                .filter(|_| (order(&own_term) - order(other_term)).abs() <= MAX_REACTION_ORDER_GAP)
            {
                out.insert(name.clone(), -share * value_of(other_term, values) / own_term.factor);
            }
        }
    }
    out
}

/// Coefficient of a term, multiplied by its factor.
fn value_of(term: &ParametricTerm, values: &Values) -> f64 {
    number((term.factor, &term.coefficient), values)
}

fn number((factor, coefficient): (f64, &Coefficient), values: &Values) -> f64 {
    factor
        * match coefficient {
            Coefficient::Known(value) => *value,
            Coefficient::Free(name) => value_at(values, name),
        }
}

/// Return initial guesses of Coulomb friction from the fit `candidate`, which uses the measured sign of the velocity.
///
/// Further guesses are fractions of the input force.
fn coulomb_guesses(
    free: &ParameterSet,
    grid: &Objective<'_>,
    signed: &ParameterSet,
    candidate: &Candidate,
) -> Result<Vec<Candidate>> {
    let (mut values, origin) = (values_of(signed, candidate), &candidate.origin);
    let coulomb = free_coulomb_coefficients(&free.structure);
    if coulomb.is_empty() {
        return Ok(vec![guess_at(free, &values, origin.clone())?]);
    }
    let mut out = Vec::new();
    let measured: Vec<f64> = coulomb.iter().map(|(.., name)| value_at(&values, name).max(0.0)).collect();
    if measured.iter().any(|value| *value > 0.0) {
        for ratio in MEASURED_SIGN_RATIOS {
            out.push(guess_with_friction(free, &values, &measured, ratio, &format!("{origin}, measured sign"))?);
        }
    }
    let (linear, source) = without_friction(&free.structure, grid.source())?;
    let coarse = Objective::new((&linear.problem, &source, grid.stop()), grid.weights.clone(), grid.sampling, false)?;
    let guess = guess_at(&linear, &values, String::new())?;
    let start = &guess.result.iterate;
    let optimum = match coarse.minimize_in(&linear.problem_at(start, false, &[]), start, FIRST_BUDGET_EVALUATIONS) {
        Err(Error::Interrupted) => return Err(Error::Interrupted),
        // Without any friction the simulation diverges.
        Err(_) => return Ok(out),
        Ok(optimum) => guess.with_result(optimum),
    };
    values.extend(values_of(&linear, &optimum));
    out.extend(coulomb_force_guesses(free, grid, &values, origin)?);
    Ok(out)
}

/// Free Coulomb coefficients, each with its equation and its factor.
fn free_coulomb_coefficients(structure: &ParametricStructure) -> Vec<(&ParametricEquation, f64, &String)> {
    bodies(structure)
        .filter_map(|(item, friction)| Some((item, friction.coulomb.0, friction.coulomb.1.name()?)))
        .collect()
}

/// Return the initial guess in which the Coulomb friction of each body is `ratio` times its force in `forces`.
fn guess_with_friction(
    free: &ParameterSet,
    values: &Values,
    forces: &[f64],
    ratio: f64,
    origin: &str,
) -> Result<Candidate> {
    let mut values = values.clone();
    for ((.., name), force) in free_coulomb_coefficients(&free.structure).into_iter().zip(forces) {
        values.insert(name.clone(), ratio * force);
    }
    guess_at(free, &values, format!("{origin}, friction times {}", format_general(ratio, 6)))
}

/// Return initial guesses of Coulomb friction: fractions of the largest input force on each body.
fn coulomb_force_guesses(
    free: &ParameterSet,
    grid: &Objective<'_>,
    values: &Values,
    origin: &str,
) -> Result<Vec<Candidate>> {
    let coulomb = free_coulomb_coefficients(&free.structure);
    let force = |(item, factor, _): &(&ParametricEquation, f64, _)| {
        Ok(largest_input_force(grid.source(), item, values)? / factor)
    };
    let forces = coulomb.iter().map(force).collect::<Result<Vec<f64>>>()?;
    if forces.iter().all(|force| *force <= 0.0) {
        return Ok(Vec::new());
    }
    COULOMB_FORCE_RATIOS
        .iter()
        .map(|&ratio| guess_with_friction(free, values, &forces, ratio, &format!("{origin}, input force")))
        .collect()
}

/// Return initial guesses of Stribeck friction, from a fit with Coulomb friction alone.
fn stribeck_guesses(
    free: &ParameterSet,
    grid: &Objective<'_>,
    less: &ParameterSet,
    candidate: &Candidate,
) -> Result<Vec<Candidate>> {
    let (values, origin) = (values_of(less, candidate), &candidate.origin);
    let (mut forces, mut speeds) = (Values::new(), Values::new());
    for (item, friction) in bodies(&free.structure).filter(|(_, friction)| has_stribeck(friction)) {
        if let (factor, Coefficient::Free(name)) = &friction.stribeck {
            let coulomb = number((friction.coulomb.0.abs(), &friction.coulomb.1), &values);
            let force = if coulomb == 0.0 { largest_input_force(grid.source(), item, &values)? } else { coulomb };
            forces.insert(name.clone(), force / factor);
        }
        if let (_, Coefficient::Free(name)) = &friction.speed {
            speeds.insert(name.clone(), rms_speed(grid, item.output)?);
        }
    }
    let some = |speed_values: &Values, ratios: [f64; 3]| {
        if speed_values.is_empty() {
            ratios[..1].to_vec()
        } else {
            ratios.to_vec()
        }
    };
    let mut out = Vec::new();
    for force_ratio in some(&forces, STRIBECK_COULOMB_RATIOS) {
        for speed_ratio in some(&speeds, STRIBECK_SPEED_RATIOS) {
            let mut guess = values.clone();
            guess.extend(forces.iter().map(|(name, force)| (name.clone(), force_ratio * force)));
            guess.extend(speeds.iter().map(|(name, speed)| (name.clone(), speed_ratio * speed)));
            let (force_ratio, speed_ratio) = (format_general(force_ratio, 6), format_general(speed_ratio, 6));
            let words = format!("{origin}, Stribeck {force_ratio} of Coulomb below {speed_ratio} of the speed");
            out.push(guess_at(free, &guess, words)?);
        }
    }
    Ok(out)
}

/// Root-mean-square speed of an output, in its unit per second.
///
/// Each speed is an average over one interval of the decimated samples.
#[allow(clippy::cast_precision_loss)]
fn rms_speed(grid: &Objective<'_>, output: usize) -> Result<f64> {
    let every = grid.sampling.decimation;
    let mut speeds = Vec::new();
    for (samples, (step, _)) in grid.source().samples(output)?.iter().zip(grid.source().intervals_and_durations()) {
        let finite: Vec<f64> = samples.iter().copied().filter(|v| !v.is_nan()).step_by(every).collect();
        speeds.extend(finite.windows(2).map(|w| (w[1] - w[0]) / (step * every as f64)));
    }
    Ok(root_mean_square(&speeds))
}

/// Largest root-mean-square force that one input exerts on a body, in the unit of D^α y for the output y and order α.
/// Only input terms of fixed order 0 count.
fn largest_input_force(source: &Recordings, item: &ParametricEquation, values: &Values) -> Result<f64> {
    let mut largest: f64 = 0.0;
    for term in item.input_terms().filter(|term| !term.order.is_free() && term.order.constant == 0.0) {
        let finite: Vec<f64> = source.samples(term.signal)?.concat().into_iter().filter(|v| !v.is_nan()).collect();
        largest = largest.max(value_of(term, values).abs() * root_mean_square(&finite));
    }
    Ok(largest)
}
