//! Initial guesses from a scan over the resonance frequency.
//!
//! With feedback between signals or autocorrelated residuals, equation-error least squares does not identify the
//! autoregressive terms. Here the autoregressive terms are fixed at points of a grid of frequencies and damping ratios.
//! The output error is then linear in all other coefficients and in the initial terms. These follow by linear least
//! squares.

use std::collections::BTreeMap;

use super::order_grid::{
    check_linear, fixed_coefficients, merge_tables, named_coefficients, new_candidate, GridRow, GridSearch,
};
use crate::equation::{Initial, Structure as Bare, Term as BareTerm};
use crate::error::Result;
use crate::estimation::joint_fit::parameter_set::ParameterSet;
use crate::estimation::joint_fit::problem::Candidate;
use crate::estimation::joint_fit::structure::{ParametricEquation, ParametricStructure, ParametricTerm};
use crate::estimation::resonance_scan::fit_with_fixed_poles;
use crate::signal::statistics::median;

/// Frequencies of the resonance scan relative to the bandwidth of the output, logarithmically spaced from 0.15 to 8.
const FREQUENCY_RATIOS: [f64; 14] = [
    0.15,
    0.203_674_807_750_629_52,
    0.276_556_182_081_705_9,
    0.375_516_848_118_263_64,
    0.509_888_812_317_398,
    0.692_343_372_152_952_4,
    0.940_086_021_471_167_4,
    1.276_478_931_281_294_5,
    1.733_244_006_176_311_5,
    2.353_454_264_952_607,
    3.195_595_633_094_143_7,
    4.339_082_174_794_672,
    5.891_744_851_769_920_5,
    8.0,
];
/// Damping ratios at which the resonance scan is evaluated.
const DAMPING_RATIOS: [f64; 4] = [0.03, 0.15, 0.5, 1.0];
/// Maximum number of points of a resonance scan that become candidates.
const MAX_SCAN_CANDIDATES: usize = 4;
/// Difference below which two exponents of t count as equal.
const EXPONENT_TOLERANCE: f64 = 1e-9;

/// Return candidates from a scan over frequency and damping, at integer orders and at the best orders of the order
/// grid.
///
/// `frequencies` are the bandwidths \[rad/s\] of the output of each equation, by run. The first of `candidates` has the
/// best orders of the order grid. The result is empty for a structure with an order law or a coefficient law.
pub(super) fn scan_candidates(
    parameter_set: &ParameterSet,
    search: &GridSearch<'_>,
    frequencies: &[Vec<f64>],
    candidates: &[Candidate],
) -> Result<Vec<Candidate>> {
    let structure = &parameter_set.structure;
    if structure.has_order_law() || !parameter_set.products.is_empty() {
        return Ok(Vec::new());
    }
    let grid_best = candidates.iter().take(usize::from(!parameter_set.orders.is_empty()));
    let points =
        std::iter::once(parameter_set.integer_orders()).chain(grid_best.map(|a| a.result.iterate.point.orders.clone()));
    let mut out = Vec::new();
    for values in points {
        let point: BTreeMap<String, f64> = parameter_set.orders.iter().cloned().zip(values.iter().copied()).collect();
        // Integer orders that coincide after they are limited to their bounds give no valid equation.
        let Ok(fixed_structure) = structure.with_orders(&point) else { continue };
        if has_duplicate_offset(&fixed_structure) {
            continue;
        }
        let scan = |(equation, run_frequencies): (&ParametricEquation, &Vec<f64>)| {
            scan_equation(&fixed_structure, equation, search, median(run_frequencies.clone()))
        };
        let scans = fixed_structure.equations.iter().zip(frequencies).map(scan).collect::<Result<Vec<_>>>()?;
        let rows = merge_tables(&scans, structure);
        out.extend(rows.iter().map(|row| {
            new_candidate(values.clone(), parameter_set.free_coefficients(&row.coefficients), "scan of resonances")
        }));
    }
    Ok(out)
}

/// Return true if an offset coincides with an initial term, so that the two are not separately identifiable.
fn has_duplicate_offset(fixed_structure: &ParametricStructure) -> bool {
    let exponents = match fixed_structure.initial.base() {
        Initial::Powers(powers) if !fixed_structure.history => powers,
        _ => return false,
    };
    let offsets = |e: &ParametricEquation| fixed_structure.initial.offset_exponents(e.order.constant);
    fixed_structure
        .equations
        .iter()
        .flat_map(offsets)
        .any(|power| exponents.iter().any(|e| (power - e).abs() < EXPONENT_TOLERANCE))
}

/// Return the autoregressive coefficients, by name, of a resonance at the frequency `omega` \[rad/s\].
///
/// The equation is D^α y = −2 ζ ω^(α − ν) D^ν y − ω^α y with damping ratio ζ. Several terms D^ν y share the damping
/// equally. Return None if a coefficient is fixed or there is no autoregressive term.
#[allow(clippy::cast_precision_loss)]
fn resonance_coefficients(equation: &ParametricEquation, omega: f64, damping: f64) -> Option<Vec<(String, f64)>> {
    let mut autoregressive_terms: Vec<(usize, &ParametricTerm)> = equation.autoregressive_terms().enumerate().collect();
    autoregressive_terms.sort_by(|(_, a), (_, b)| a.order.constant.total_cmp(&b.order.constant));
    let mut out = vec![(String::new(), 0.0); autoregressive_terms.len()];
    let other_count = autoregressive_terms.len().saturating_sub(1) as f64;
    for (rank, (index, term)) in autoregressive_terms.into_iter().enumerate() {
        let ratio = if rank == 0 { 1.0 } else { 2.0 * damping / other_count };
        let product = -ratio * libm::pow(omega, equation.order.constant - term.order.constant);
        out[index] = (term.coefficient.name()?.clone(), product / term.factor);
    }
    Some(out).filter(|out| !out.is_empty())
}

/// Return the best points of the resonance scan of one equation with fixed orders, sorted by root-mean-square output error.
///
/// There is one point per frequency, with the best damping ratio for that frequency. The frequencies are relative to
/// `frequency` \[rad/s\].
fn scan_equation(
    structure: &ParametricStructure,
    equation: &ParametricEquation,
    search: &GridSearch<'_>,
    frequency: f64,
) -> Result<Vec<GridRow>> {
    let input_terms: Vec<ParametricTerm> = equation.input_terms().cloned().collect();
    let autoregressive_terms: Vec<&ParametricTerm> = equation.autoregressive_terms().collect();
    if input_terms.is_empty() || autoregressive_terms.is_empty() {
        return Ok(Vec::new());
    }
    let points_of_scan = FREQUENCY_RATIOS
        .iter()
        .flat_map(|ratio| DAMPING_RATIOS.iter().map(move |damping| (ratio * frequency, *damping)));
    let candidates: Option<Vec<_>> =
        points_of_scan.map(|(omega, damping)| resonance_coefficients(equation, omega, damping)).collect();
    let Some(candidates) = candidates else { return Ok(Vec::new()) };
    check_linear(structure, equation, "a scan of resonances by least squares")?;
    search.stop.check()?;
    // The Caputo exponents must be those of the full equation, including the autoregressive terms.
    let input_equation = ParametricEquation { terms: input_terms, ..equation.clone() };
    let input_structure = Bare {
        output: input_equation.output,
        order: input_equation.order.constant,
        terms: input_equation.terms.iter().map(|t| BareTerm { signal: t.signal, order: t.order.constant }).collect(),
    };
    input_structure.check(structure.signals.len(), |s| search.inputs.get(s).copied().unwrap_or(false))?;
    let etas: Vec<f64> = autoregressive_terms.iter().map(|t| equation.order.constant - t.order.constant).collect();
    let point = |values: &Vec<(String, f64)>| {
        values.iter().zip(&autoregressive_terms).map(|((_, v), t)| v * t.factor).collect()
    };
    let points: Vec<Vec<f64>> = candidates.iter().map(point).collect();
    let evaluations = fit_with_fixed_poles(
        search.records,
        &input_structure,
        &fixed_coefficients(&input_equation),
        search.initial,
        &etas,
        &points,
    )?;
    let mut best_rows: Vec<(f64, GridRow)> = Vec::new();
    for (evaluations, candidates) in
        evaluations.chunks(DAMPING_RATIOS.len()).zip(candidates.chunks(DAMPING_RATIOS.len()))
    {
        // A point without a result is too fast for the step, or has collinear regressors.
        let finite_evaluations =
            evaluations.iter().zip(candidates).filter_map(|(evaluation, values)| Some((evaluation.as_ref()?, values)));
        let finite_evaluations = finite_evaluations.filter(|(evaluation, _)| evaluation.error.is_finite());
        if let Some((evaluation, values)) = finite_evaluations.min_by(|(a, _), (b, _)| a.error.total_cmp(&b.error)) {
            let coefficients =
                values.iter().cloned().chain(named_coefficients(&input_equation, &evaluation.coefficients)).collect();
            best_rows.push((evaluation.error, GridRow { orders: Vec::new(), coefficients }));
        }
    }
    best_rows.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    Ok(best_rows.into_iter().take(MAX_SCAN_CANDIDATES).map(|(_, row)| row).collect())
}
