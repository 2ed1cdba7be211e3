//! Multistart for equations with nonlinear terms: linear fits with the measured values of the expressions.
//!
//! If a nonlinear expression is evaluated with measured values, it is one more input of a linear equation. The order
//! grids of these linear equations give initial guesses, which are ranked by simulations of the nonlinear equations.
//! Derivatives of measured signals are computed from raw and from smoothed samples. With friction, the guesses are
//! output-error fits of the linear equations. Without friction, such fits add guesses only if no other guess reaches
//! the noise level. If none does, fits without the nonlinear terms add guesses, too.

use super::coarse_grid::coarse_sampling;
use super::friction::{guess_at, run_friction_multistart, values_of};
use super::halving::{
    is_same_iterate, is_same_optimum, merge_duplicates, sort_by_cost, RungExecutor, FIRST_BUDGET_EVALUATIONS,
    MAX_FINAL_SURVIVORS, SECOND_BUDGET_EVALUATIONS, SUBMODEL_SURVIVORS,
};
use super::search::{none_if_invalid_model, run_multistart, MultistartContext, NOISE_FLOOR_FACTOR};
use crate::error::Result;
use crate::estimation::joint_fit::objective::{Objective, Weights, MAX_PULSES_PER_SAMPLE};
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::Candidate;
use crate::estimation::joint_fit::structure::{ParametricEquation, ParametricStructure};
use crate::expression::{DerivedSignal, Values};
use crate::fractional::kernels::grunwald_letnikov_weights;
use crate::nonlinear::unsupported_with;
use crate::recording::{Channel, Recording, Recordings, Role};
use crate::series;
use crate::signal::block_pulse::{delay_samples, Intersample};
use crate::signal::nonuniform::interpolate_gaps;

/// Half the width, in samples, of the smoothing window for measured signals whose derivatives enter expressions.
const SMOOTHING_HALF_WIDTH: usize = 15;

/// Maximum number of block pulses per sampling interval in the simulation of the initial guesses.
const MAX_START_PULSES_PER_SAMPLE: usize = 4;

/// Run the multistart of a problem with nonlinear terms and return the candidates, best first.
///
/// # Errors
/// An error if the runs cannot be sampled or the initial guesses cannot be computed. The error of the progress listener
/// if it returns one. [`crate::error::Error::Interrupted`] after a stop request.
pub fn run_nonlinear_multistart(
    parameter_set: &ParameterSet,
    context: MultistartContext<'_>,
) -> Result<Vec<Candidate>> {
    let structure = &parameter_set.structure;
    let linear = ParameterSet::from_structure(ParametricStructure { derived: Vec::new(), ..structure.clone() })?;
    let weights = Weights { outputs: context.weights.to_vec(), robust_weights: None };
    let sampling = coarse_sampling(parameter_set, context.source)?;
    let mut objective =
        Objective::new((&parameter_set.problem, context.source, context.stop), weights, sampling, false)?;
    let has_derivatives = structure.derived.iter().flat_map(|derived| &derived.channels).any(|channel| channel.1 > 0.0);
    let widths = if has_derivatives { vec![0, SMOOTHING_HALF_WIDTH] } else { vec![0] };
    let sources = widths.into_iter().map(|width| with_derived_signals(structure, context.source, width));
    let sources = sources.collect::<Result<Vec<_>>>()?;
    let mut starts = Vec::new();
    for source in &sources {
        let guess_source = context.guess_source.for_recordings(source);
        if structure.has_friction() {
            let submodel_context =
                MultistartContext { source, guess_source: guess_source.as_ref(), listener: None, ..context };
            let submodel_candidates =
                none_if_invalid_model(run_friction_multistart(&linear, submodel_context))?.unwrap_or_default();
            starts.extend(embed(parameter_set, &linear, &submodel_candidates)?);
            continue;
        }
        starts.extend(none_if_invalid_model(guess_source.initial_guesses(&linear))?.unwrap_or_default());
    }
    let executor = RungExecutor { start_count: starts.len(), threads: context.threads, listener: context.listener };
    let mut ranked = merge_duplicates(&executor.run(parameter_set, &objective, &starts, 0)?, is_same_iterate);
    while ranked.is_empty() && objective.sampling.pulses_per_sample < MAX_PULSES_PER_SAMPLE {
        objective = objective.finer()?;
        ranked = merge_duplicates(&executor.run(parameter_set, &objective, &starts, 0)?, is_same_iterate);
    }
    let executor = RungExecutor { listener: None, ..executor };
    let is_at_noise = |candidates: &[Candidate]| {
        candidates.first().is_some_and(|best_candidate| {
            best_candidate.cost_per_residual() <= NOISE_FLOOR_FACTOR * context.noise_floor
        })
    };
    let mut candidates = Vec::new();
    for selected in ranked.chunks(MAX_FINAL_SURVIVORS).take(SUBMODEL_SURVIVORS.div_ceil(MAX_FINAL_SURVIVORS)) {
        candidates.extend(executor.run(parameter_set, &objective, selected, FIRST_BUDGET_EVALUATIONS)?);
        candidates = sort_by_cost(candidates);
        if is_at_noise(&candidates) {
            break;
        }
    }
    // With fast responses, the residuals rank the guesses only if the pulses are short enough.
    while let Some(best_candidate) = candidates.first().filter(|_| !is_at_noise(&candidates))
        && objective.sampling.pulses_per_sample < MAX_START_PULSES_PER_SAMPLE
        && objective.is_refinement_significant(&best_candidate.result.iterate, &objective.finer()?)?
    {
        objective = objective.finer()?;
        candidates = executor.run(parameter_set, &objective, &candidates, FIRST_BUDGET_EVALUATIONS)?;
    }
    if !is_at_noise(&candidates) {
        let mut further_guesses = Vec::new();
        // With friction, these fits are the initial guesses already.
        let further_sources = if structure.has_friction() { &[][..] } else { &sources };
        for source in further_sources {
            let guess_source = context.guess_source.for_recordings(source);
            let submodel_context =
                MultistartContext { source, guess_source: guess_source.as_ref(), listener: None, ..context };
            let submodel_candidates =
                none_if_invalid_model(run_multistart(&linear, submodel_context))?.unwrap_or_default();
            further_guesses.extend(embed(parameter_set, &linear, &submodel_candidates)?);
        }
        if let Some(submodel) = without_nonlinear_terms(structure) {
            let submodel_context = MultistartContext { listener: None, ..context };
            let submodel_candidates =
                none_if_invalid_model(run_friction_multistart(&submodel, submodel_context))?.unwrap_or_default();
            further_guesses.extend(embed(parameter_set, &submodel, &submodel_candidates)?);
        }
        candidates.extend(executor.run(parameter_set, &objective, &further_guesses, FIRST_BUDGET_EVALUATIONS)?);
        candidates = sort_by_cost(candidates);
    }
    let selected = merge_duplicates(&candidates, is_same_optimum);
    let (survivors, remaining) = selected.split_at(MAX_FINAL_SURVIVORS.min(selected.len()));
    let mut results = executor.run(parameter_set, &objective, survivors, SECOND_BUDGET_EVALUATIONS)?;
    results.extend(remaining.iter().cloned());
    Ok(results)
}

/// Return the best candidates of a problem with fewer parameters as initial guesses of the full problem.
///
/// At most [`MAX_FINAL_SURVIVORS`] candidates are returned. Missing coefficients are 0.
fn embed(parameter_set: &ParameterSet, submodel: &ParameterSet, candidates: &[Candidate]) -> Result<Vec<Candidate>> {
    let full_guess = |candidate: &Candidate| {
        let mut values = values_of(submodel, candidate);
        for name in &parameter_set.coefficients {
            values.entry(name.clone()).or_insert(0.0);
        }
        guess_at(parameter_set, &values, format!("{}, from a linear fit", candidate.origin))
    };
    candidates.iter().take(MAX_FINAL_SURVIVORS).map(full_guess).collect()
}

/// Return the parameter set without the nonlinear terms; None if the remaining structure is invalid.
fn without_nonlinear_terms(structure: &ParametricStructure) -> Option<ParameterSet> {
    let recorded = structure.recorded_count();
    let equation_without_terms = |equation: &ParametricEquation| {
        let terms = equation.terms.iter().filter(|term| term.signal < recorded).cloned().collect();
        ParametricEquation { terms, ..equation.clone() }
    };
    let submodel = ParametricStructure {
        signals: structure.signals[..recorded].to_vec(),
        derived: Vec::new(),
        equations: structure.equations.iter().map(equation_without_terms).collect(),
        ..structure.clone()
    };
    let names = submodel.order_names();
    let bounds =
        submodel.bounds.iter().filter(|(name, _)| names.contains(name)).map(|(n, b)| (n.clone(), *b)).collect();
    ParameterSet::from_structure(ParametricStructure { bounds, ..submodel }).ok()
}

/// Return recordings that contain the derived signals as measured signals.
///
/// Samples are smoothed before they are differentiated. `half_width` is half the smoothing window in samples.
/// Recordings with nonuniform samples are an error.
fn with_derived_signals(structure: &ParametricStructure, source: &Recordings, half_width: usize) -> Result<Recordings> {
    let add_derived_channels = |run: &Recording| {
        if run.has_nonuniform_samples() {
            return Err(unsupported_with("samples at nonuniform times", "resample the runs"));
        }
        let mut channels = run.channels().to_vec();
        for (derived, name) in structure.derived.iter().zip(&structure.signals[structure.recorded_count()..]) {
            channels.push(derived_channel(run, derived, name, half_width)?);
        }
        let mut run_with_signals = run.with_channels(channels, run.outputs().to_vec())?;
        run_with_signals.free_inputs.clone_from(&run.free_inputs);
        Ok(run_with_signals)
    };
    Recordings::new(source.runs().map(add_derived_channels).collect::<Result<Vec<_>>>()?)
}

fn derived_channel(run: &Recording, derived: &DerivedSignal, name: &str, half_width: usize) -> Result<Channel> {
    let mut rows = Vec::new();
    let (mut is_zero_order_hold, mut is_filtered) = (true, false);
    for &(signal, order) in &derived.channels {
        let channel = run.channel(signal)?;
        is_zero_order_hold &= channel.is_zero_order_hold() && order == 0.0;
        is_filtered |= channel.is_filtered;
        let mut samples = interpolate_gaps(&run.acting_samples(signal)).into_owned();
        if channel.lag() != 0.0 {
            samples = delay_samples(&samples, channel.lag() / run.step(), run.value_before(&samples))?;
        }
        rows.push(if order > 0.0 { differentiate(samples, order, run, half_width) } else { samples });
    }
    let mut values = Values::default();
    let mut arguments = vec![0.0; rows.len()];
    let evaluate_at = |k: usize| {
        arguments.iter_mut().zip(&rows).for_each(|(v, row)| *v = row[k]);
        let value = derived.expression.evaluate(&arguments, &mut values);
        // Noise may move an argument out of the domain of a function.
        if value.is_finite() {
            value
        } else {
            0.0
        }
    };
    let samples = (0..run.len()).map(evaluate_at).collect();
    let role = if is_zero_order_hold { Role::Input(Intersample::Hold) } else { Role::Output };
    Ok(Channel { is_filtered, ..Channel::new(name, samples, role) })
}

/// Grünwald–Letnikov derivative of smoothed samples, in their unit per second^`order`.
///
/// It is the derivative of the deviation from the first sample, or from 0 if the run starts at rest.
fn differentiate(samples: Vec<f64>, order: f64, run: &Recording, half_width: usize) -> Vec<f64> {
    let reference = if run.is_at_rest { 0.0 } else { samples[0] };
    let deviations: Vec<f64> = smooth(&samples, half_width).iter().map(|v| v - reference).collect();
    let weights = grunwald_letnikov_weights(order, deviations.len());
    let scale = libm::pow(run.step(), -order);
    series::multiply(&weights, &deviations, deviations.len()).into_iter().map(|v| scale * v).collect()
}

/// Return samples smoothed by local cubic polynomials (Savitzky–Golay filter), with shorter windows near the ends.
#[allow(clippy::cast_precision_loss)]
fn smooth(samples: &[f64], half_width: usize) -> Vec<f64> {
    let smooth_at = |k: usize| {
        let n = half_width.min(k).min(samples.len() - 1 - k);
        if n < 2 {
            return samples[k];
        }
        let size = n as f64;
        let scale = 3.0 / ((2.0 * size + 3.0) * (2.0 * size + 1.0) * (2.0 * size - 1.0));
        let weight = |j: f64| scale * (3.0 * size * size + 3.0 * size - 1.0 - 5.0 * j * j);
        (samples[k - n..=k + n].iter().enumerate()).map(|(i, v)| weight(i as f64 - size) * v).sum()
    };
    (0..samples.len()).map(smooth_at).collect()
}

#[cfg(test)]
mod tests {
    use super::smooth;

    #[test]
    fn smoothing_keeps_cubics() {
        let cubic: Vec<f64> = (0..60).map(|k| (f64::from(k) - 20.0).powi(3)).collect();
        assert!(smooth(&cubic, 15).iter().zip(&cubic).all(|(a, b)| (a - b).abs() < 1e-8));
    }
}
