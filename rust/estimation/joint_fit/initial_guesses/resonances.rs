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

/// Frequencies of the scan relative to the bandwidth of the output, logarithmically spaced from 0.15 to 8.
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
/// Damping ratios of the scan.
const DAMPING_RATIOS: [f64; 4] = [0.03, 0.15, 0.5, 1.0];
/// Maximum number of points of a scan that become candidates.
const MAX_SCAN_CANDIDATES: usize = 4;
/// Difference below which two exponents of t count as equal.
const EXPONENT_TOLERANCE: f64 = 1e-9;

/// Return candidates from a scan over frequency and damping, at integer orders and at the best orders of the order
/// grid.
///
/// `frequencies` are the bandwidths \[rad/s\] of the output of each equation, by run. The first of `attempts` has the
/// best orders of the order grid. The result is empty for a structure with an order law or a coefficient law.
pub(super) fn scan_candidates(
    free: &ParameterSet,
    coarse: &GridSearch<'_>,
    frequencies: &[Vec<f64>],
    attempts: &[Candidate],
) -> Result<Vec<Candidate>> {
    let structure = &free.structure;
    if structure.has_order_law() || !free.products.is_empty() {
        return Ok(Vec::new());
    }
    let best = attempts.iter().take(usize::from(!free.orders.is_empty()));
    let points = std::iter::once(free.integer_orders()).chain(best.map(|a| a.result.iterate.point.orders.clone()));
    let mut out = Vec::new();
    for values in points {
        let point: BTreeMap<String, f64> = free.orders.iter().cloned().zip(values.iter().copied()).collect();
        // Integer orders that coincide after they are limited to their bounds give no valid equation.
        let Ok(fixed) = structure.with_orders(&point) else { continue };
        if has_duplicate_offset(&fixed) {
            continue;
        }
        let scan =
            |(item, of): (&ParametricEquation, &Vec<f64>)| scan_equation(&fixed, item, coarse, median(of.clone()));
        let scans = fixed.equations.iter().zip(frequencies).map(scan).collect::<Result<Vec<_>>>()?;
        let rows = merge_tables(&scans, structure);
        out.extend(
            rows.iter()
                .map(|row| new_candidate(values.clone(), free.free_from(&row.coefficients), "scan of resonances")),
        );
    }
    Ok(out)
}

/// Return true if an offset coincides with an initial term, so that the two are not separately identifiable.
fn has_duplicate_offset(fixed: &ParametricStructure) -> bool {
    let exponents = match fixed.initial.base() {
        Initial::Powers(powers) if !fixed.history => powers,
        _ => return false,
    };
    let offsets = |e: &ParametricEquation| fixed.initial.offset_exponents(e.order.constant);
    fixed
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
fn resonance_coefficients(item: &ParametricEquation, omega: f64, damping: f64) -> Option<Vec<(String, f64)>> {
    let mut own: Vec<(usize, &ParametricTerm)> = item.autoregressive_terms().enumerate().collect();
    own.sort_by(|(_, a), (_, b)| a.order.constant.total_cmp(&b.order.constant));
    let mut out = vec![(String::new(), 0.0); own.len()];
    let others = own.len().saturating_sub(1) as f64;
    for (rank, (place, term)) in own.into_iter().enumerate() {
        let share = if rank == 0 { 1.0 } else { 2.0 * damping / others };
        let size = -share * libm::pow(omega, item.order.constant - term.order.constant);
        out[place] = (term.coefficient.name()?.clone(), size / term.factor);
    }
    Some(out).filter(|out| !out.is_empty())
}

/// Return the best points of the scan of one equation with fixed orders, sorted by root-mean-square output error.
///
/// There is one point per frequency, with the best damping ratio for that frequency. The frequencies are relative to
/// `frequency` \[rad/s\].
fn scan_equation(
    structure: &ParametricStructure,
    item: &ParametricEquation,
    coarse: &GridSearch<'_>,
    frequency: f64,
) -> Result<Vec<GridRow>> {
    let others: Vec<ParametricTerm> = item.input_terms().cloned().collect();
    let own: Vec<&ParametricTerm> = item.autoregressive_terms().collect();
    if others.is_empty() || own.is_empty() {
        return Ok(Vec::new());
    }
    let grid = FREQUENCY_RATIOS
        .iter()
        .flat_map(|share| DAMPING_RATIOS.iter().map(move |damping| (share * frequency, *damping)));
    let candidates: Option<Vec<_>> =
        grid.map(|(omega, damping)| resonance_coefficients(item, omega, damping)).collect();
    let Some(candidates) = candidates else { return Ok(Vec::new()) };
    check_linear(structure, item, "a scan of resonances by least squares")?;
    coarse.stop.check()?;
    // The Caputo exponents must be those of the full equation, including the autoregressive terms.
    let rest = ParametricEquation { terms: others, ..item.clone() };
    let bare = Bare {
        output: rest.output,
        order: rest.order.constant,
        terms: rest.terms.iter().map(|t| BareTerm { signal: t.signal, order: t.order.constant }).collect(),
    };
    bare.check(structure.signals.len(), |s| coarse.inputs.get(s).copied().unwrap_or(false))?;
    let etas: Vec<f64> = own.iter().map(|t| item.order.constant - t.order.constant).collect();
    let point = |values: &Vec<(String, f64)>| values.iter().zip(&own).map(|((_, v), t)| v * t.factor).collect();
    let points: Vec<Vec<f64>> = candidates.iter().map(point).collect();
    let evaluations =
        fit_with_fixed_poles(coarse.records, &bare, &fixed_coefficients(&rest), coarse.initial, &etas, &points)?;
    let mut best: Vec<(f64, GridRow)> = Vec::new();
    for (evaluations, candidates) in
        evaluations.chunks(DAMPING_RATIOS.len()).zip(candidates.chunks(DAMPING_RATIOS.len()))
    {
        // A point without a result is too fast for the step, or has collinear regressors.
        let finite_evaluations =
            evaluations.iter().zip(candidates).filter_map(|(at, values)| Some((at.as_ref()?, values)));
        let finite_evaluations = finite_evaluations.filter(|(at, _)| at.error.is_finite());
        if let Some((at, values)) = finite_evaluations.min_by(|(a, _), (b, _)| a.error.total_cmp(&b.error)) {
            let coefficients = values.iter().cloned().chain(named_coefficients(&rest, &at.coefficients)).collect();
            best.push((at.error, GridRow { orders: Vec::new(), coefficients }));
        }
    }
    best.sort_by(|(a, _), (b, _)| a.total_cmp(b));
    Ok(best.into_iter().take(MAX_SCAN_CANDIDATES).map(|(_, row)| row).collect())
}
