//! Lower bound of the squared equation error over a cell (a box of orders), for optimal coefficients.
//!
//! Let X be the regressor columns at the midpoint, G = XᵀX, and e = y − Xc₀ the residual of the output y for any
//! coefficients c₀. At other orders of the cell the columns are X + U. The part of U in the span of X is XA, and the
//! remaining part P is orthogonal to X. For any coefficients c, with h = c + Ac − c₀, τ = Xᵀe and γ = Uᵀe,
//!
//!   ‖y − (X + U)c‖² = ‖e − Xh − Pc‖² ≥ ‖e‖² − 2τᵀh − 2(γ − Aᵀτ)ᵀc + ‖Xh‖².
//!
//! Here c = (I + A)⁻¹(c₀ + h). With the solution β of (I + Aᵀ)β = γ − Aᵀτ, the minimum over h is ‖e‖² − 2βᵀc₀ − (β +
//! τ)ᵀG⁻¹(β + τ). The moduli of γ and A are bounded by the expansions of the columns. A vector B is a bound of |β| if B
//! ≥ |γ| + |A|ᵀ(|τ| + B).

use crate::error::{check_length, Error, Result};
use crate::linalg::dense::inner_products;
use crate::order_search::certificate::regressor_expansion::{
    rounding_unit, taylor_sum, RegressorExpansion, EXPANSION_COLUMNS, MAX_TERMS,
};
use crate::order_search::certificate::subspace_bound::DerivativeSubspace;
use crate::parallel::Stop;
use crate::regressors::Record;

/// One value per term of the equation.
type Row = [f64; MAX_TERMS];

/// Relative margin of the vector of [`dominating_vector`], far above its rounding error.
const BOUND_MARGIN: f64 = 1e-6;
/// Relative margin for the error of the inverse Gram matrix. No bound is computed if an estimate of this error exceeds
/// the square of the margin.
const INVERSE_TOLERANCE: f64 = 1.0 / 16.0;

/// Inner products of the regressor columns and their derivatives at the midpoint of a cell (box of orders). The columns
/// and the measured output have unit norm. Derivatives are with respect to the order of integration.
#[derive(Debug, Clone, Copy)]
pub(super) struct CellProducts {
    /// Number of terms of the equation.
    pub(super) k: usize,
    /// Products of the column of term i with the mth derivative of the column of term j, by m, then i, then j.
    /// Derivatives are with respect to the order of integration.
    pub(super) products: [[Row; MAX_TERMS]; EXPANSION_COLUMNS],
    /// Products of the measured output with the mth derivative of the column of term j, by m, then j.
    pub(super) target: [Row; EXPANSION_COLUMNS],
    /// Upper bounds of the norms of the mth derivatives of the column of term j, by m, then j.
    pub(super) sizes: [Row; EXPANSION_COLUMNS],
    /// Upper bound of the remainder of the expansion of each column within the cell (box of orders).
    pub(super) remainder_bounds: Row,
    /// Half width of the cell (box of orders) for each order of integration.
    pub(super) halves: Row,
    /// Upper bound of the rounding error in the inner product of two unit-norm columns.
    pub(super) rounding: f64,
}

impl CellProducts {
    /// Return products of 0 for `k` terms and `samples` samples, to be filled in.
    pub(super) fn new(k: usize, samples: usize) -> Self {
        Self {
            k,
            products: [[[0.0; MAX_TERMS]; MAX_TERMS]; EXPANSION_COLUMNS],
            target: [[0.0; MAX_TERMS]; EXPANSION_COLUMNS],
            sizes: [[0.0; MAX_TERMS]; EXPANSION_COLUMNS],
            remainder_bounds: [0.0; MAX_TERMS],
            halves: [0.0; MAX_TERMS],
            // The rounding error of products of stored columns is an eighth of the error of a chain of transforms.
            rounding: rounding_unit(samples) / 8.0,
        }
    }
}

/// Bound of a cell (a box of orders), relative to the squared norm of the measured output.
#[derive(Debug, Clone, Copy)]
pub(super) struct CellBound {
    /// Lower bound of the relative squared residual at all orders in the cell (box of orders), 0 without a proof.
    pub(super) lower_bound: f64,
    /// Relative squared residual at the midpoint of the cell (box of orders), infinite if it cannot be computed.
    pub(super) midpoint_residual: f64,
    /// Decrease of the bound due to the width of the cell (box of orders) in each order. The cell is halved along the
    /// order with the largest value.
    pub(super) costs: Row,
}

impl CellProducts {
    /// Compute the bound of the cell (box of orders) for any coefficients.
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn bound(&self) -> CellBound {
        let k = self.k;
        let mut cell_bound = CellBound { lower_bound: 0.0, midpoint_residual: f64::INFINITY, costs: self.halves };
        let Some(inverse) = inverse(self.products[0], k) else { return cell_bound };
        let trace: f64 = (0..k).map(|i| inverse[i][i]).sum();
        let terms = (k * k) as f64;
        let rounding = self.rounding * terms;
        let elimination = 64.0 * f64::EPSILON * terms * terms * trace * trace;
        // This form of the condition also rejects NaN.
        if !(trace * rounding < INVERSE_TOLERANCE * INVERSE_TOLERANCE
            && elimination < INVERSE_TOLERANCE * INVERSE_TOLERANCE)
        {
            return cell_bound;
        }
        let mut c = [0.0; MAX_TERMS];
        for i in 0..k {
            c[i] = (0..k).map(|j| inverse[i][j] * self.target[0][j]).sum();
        }
        let all = 1.0 + (0..k).map(|i| c[i].abs() * self.sizes[0][i]).sum::<f64>();
        let correction = |m: usize, j: usize| -> f64 {
            self.target[m][j] - (0..k).map(|i| c[i] * self.products[m][i][j]).sum::<f64>()
        };
        // ‖e‖² follows from the quadratic form, which is valid for any coefficients.
        let explained_square: f64 = (0..k).map(|i| c[i] * (self.target[0][i] + correction(0, i))).sum();
        let square = 1.0 - explained_square;
        let error = self.rounding * all * all;
        if !(square.is_finite() && square > error) {
            return cell_bound;
        }
        cell_bound.midpoint_residual = square;
        let size = (square + error).sqrt();
        let (mut tau, mut gamma, mut a) = ([0.0; MAX_TERMS], [0.0; MAX_TERMS], [[0.0; MAX_TERMS]; MAX_TERMS]);
        for j in 0..k {
            let half = self.halves[j];
            tau[j] = correction(0, j).abs() + self.rounding * all;
            gamma[j] = taylor_sum(half, |m| correction(m, j).abs() + self.rounding * all * self.sizes[m][j])
                + size * self.remainder_bounds[j];
            for i in 0..k {
                let part = |m: usize| -> (f64, f64) {
                    let terms = (0..k).map(|l| inverse[i][l] * self.products[m][l][j]);
                    terms.fold((0.0, 0.0), |(sum, all), x| (sum + x, all + x.abs()))
                };
                let rounded = rounding * trace;
                let cell_deviation = taylor_sum(half, |m| {
                    let (sum, all) = part(m);
                    sum.abs() + rounded * (all + (1.0 + trace) * self.sizes[m][j])
                });
                let outer = (inverse[i][i].max(0.0) * (1.0 + INVERSE_TOLERANCE)).sqrt() * self.remainder_bounds[j];
                a[i][j] = cell_deviation + outer;
            }
        }
        let costs = |j: usize| (0..k).map(|i| a[i][j]).sum::<f64>();
        (0..k).for_each(|j| cell_bound.costs[j] = costs(j));
        let Some(b) = dominating_vector(&a, &gamma, &tau, k) else { return cell_bound };
        let (mut first, mut second) = (0.0, 0.0);
        for i in 0..k {
            let cost = 2.0 * c[i].abs() * b[i];
            cell_bound.costs[i] = cost;
            first += cost;
            for j in 0..k {
                second += (b[i] + tau[i]) * inverse[i][j].abs() * (b[j] + tau[j]);
            }
        }
        let lower_bound =
            (square - error - first - second * (1.0 + INVERSE_TOLERANCE)) * (1.0 - BOUND_MARGIN * BOUND_MARGIN);
        // Neither NaN nor an overflow proves anything.
        if lower_bound > 0.0 && lower_bound.is_finite() {
            cell_bound.lower_bound = lower_bound;
        }
        cell_bound
    }
}

/// Return the inverse of a positive definite k × k matrix. `None` if a pivot is not positive and finite.
fn inverse(mut matrix: [Row; MAX_TERMS], k: usize) -> Option<[Row; MAX_TERMS]> {
    let mut out = [[0.0; MAX_TERMS]; MAX_TERMS];
    (0..k).for_each(|i| out[i][i] = 1.0);
    for i in 0..k {
        let pivot = matrix[i][i];
        if !(pivot > 0.0 && pivot.is_finite()) {
            return None;
        }
        for j in 0..k {
            matrix[i][j] /= pivot;
            out[i][j] /= pivot;
        }
        for l in (0..k).filter(|l| *l != i) {
            let factor = matrix[l][i];
            for j in 0..k {
                matrix[l][j] -= factor * matrix[i][j];
                out[l][j] -= factor * out[i][j];
            }
        }
    }
    Some(out)
}

/// Return a vector B with B > γ + Aᵀ(τ + B), which proves that I + A is nonsingular. The arguments are bounds of the
/// moduli of the matrix A and the vectors γ and τ. `None` if no such vector is found.
fn dominating_vector(a: &[Row; MAX_TERMS], gamma: &Row, tau: &Row, k: usize) -> Option<Row> {
    let (mut matrix, mut right) = ([[0.0; MAX_TERMS]; MAX_TERMS], [0.0; MAX_TERMS]);
    for i in 0..k {
        right[i] = gamma[i] + (0..k).map(|j| a[j][i] * tau[j]).sum::<f64>() + f64::MIN_POSITIVE.sqrt();
        for j in 0..k {
            matrix[i][j] = f64::from(u8::from(i == j)) - a[j][i];
        }
    }
    let target = right;
    for i in 0..k {
        let pivot = matrix[i][i];
        if !(pivot > 0.0 && pivot.is_finite()) {
            return None;
        }
        for l in i + 1..k {
            let (factor, row) = (matrix[l][i] / pivot, matrix[i]);
            matrix[l].iter_mut().zip(&row).skip(i).for_each(|(x, y)| *x -= factor * y);
            right[l] -= factor * right[i];
        }
    }
    let mut b = [0.0; MAX_TERMS];
    for i in (0..k).rev() {
        let sum: f64 = (i + 1..k).map(|j| matrix[i][j] * b[j]).sum();
        b[i] = (right[i] - sum) / matrix[i][i];
    }
    b[..k].iter_mut().for_each(|b| *b *= 1.0 + BOUND_MARGIN);
    // Accept the vector only if it satisfies the inequality.
    let is_dominating =
        |i: usize| (target[i] + (0..k).map(|j| a[j][i] * b[j]).sum::<f64>()) * (1.0 + 1e-3 * BOUND_MARGIN) <= b[i];
    (0..k).all(is_dominating).then_some(b)
}

/// Return two lower bounds of Σε² over a cell (a box of orders), 0 without a proof. ε is the equation error with zero
/// initial conditions. `terms` lists (signal, midpoint, half width) of the order of integration of each term.
///
/// The first bound holds for any coefficients. The second is optimized to reach `target_bound`. It holds for
/// coefficients for which the norms of the terms sum up to at most `max_coefficient` times the norm of the output.
///
/// # Errors
/// [`Error::Structure`] without records or terms, for too many terms, or for a signal that is missing or zero.
/// [`Error::OutOfRange`] for a midpoint below its half width.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::order_search::certificate::cell_bounds;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.8);
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// // y is the integral of order 0.8 of u: the residual is 0 at this order, and positive near order 0.5.
/// let proved = |middle: f64| cell_bounds(&[record.clone()], 0, &[(1, middle, 0.01)], (10.0, 1.0));
/// assert!(proved(0.8)? == (0.0, 0.0) && proved(0.5)?.0 > 0.0 && proved(0.5)?.1 > 0.0);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn cell_bounds(
    records: &[Record],
    output: usize,
    terms: &[(usize, f64, f64)],
    (max_coefficient, target_bound): (f64, f64),
) -> Result<(f64, f64)> {
    check_records(records, output, terms.iter().map(|t| t.0))?;
    for &(_, middle, half) in terms {
        if !(half >= 0.0 && half <= middle && middle < 20.0) {
            return Err(Error::OutOfRange {
                name: "half width".into(),
                value: half,
                range: format!("[0, {middle}], the midpoint of the interval of orders"),
                remedy: "give nonnegative orders of integration".into(),
            });
        }
    }
    let (local, span, square) = expand_cell(records, output, terms, &Stop::default())?;
    Ok((local.bound().lower_bound * square, span.bound(max_coefficient, target_bound / square) * square))
}

/// Compute the inner products and the subspace of a cell (box of orders). `terms` lists (signal, midpoint, half width)
/// of the order of integration of each term. Also return the squared norm of the output.
pub(super) fn expand_cell(
    records: &[Record],
    output: usize,
    terms: &[(usize, f64, f64)],
    stop: &Stop,
) -> Result<(CellProducts, DerivativeSubspace, f64)> {
    let target: Vec<f64> = records.iter().flat_map(|r| r.signal(output)).copied().collect();
    let square = target.iter().map(|v| v * v).sum::<f64>();
    let curves = terms
        .iter()
        .map(|&(s, middle, half)| RegressorExpansion::new(records, s, middle, half, stop))
        .collect::<Result<Vec<_>>>()?;
    let all: Vec<&[f64]> = curves.iter().flat_map(|c| c.columns.iter().map(Vec::as_slice)).collect();
    let (products, target_products) = (inner_products(&all, &all, stop), inner_products(&[&target], &all, stop));
    stop.check()?;
    let product = |(i, n): (usize, usize), (j, m): (usize, usize)| {
        products[(i * EXPANSION_COLUMNS + n) * all.len() + j * EXPANSION_COLUMNS + m]
    };
    let target_product = |(j, m): (usize, usize)| target_products[j * EXPANSION_COLUMNS + m] / square.sqrt();
    let (mut local, mut span) = (CellProducts::new(terms.len(), target.len()), DerivativeSubspace::new(target.len()));
    for (j, (curve, &(_, _, half))) in curves.iter().zip(terms).enumerate() {
        for m in 0..EXPANSION_COLUMNS {
            for i in 0..terms.len() {
                local.products[m][i][j] = product((i, 0), (j, m));
            }
            local.target[m][j] = target_product((j, m));
            local.sizes[m][j] = curve.sizes[m];
        }
        local.remainder_bounds[j] = curve.remainder;
        local.halves[j] = half;
        span.add(half, curve.sizes, curve.remainder);
    }
    span.fill(product, target_product);
    Ok((local, span, square))
}

/// Return an error for records or signals to which certificates do not apply: [`Error::Length`] for records with
/// different numbers of signals. [`Error::Structure`] without records, for a missing signal, a zero or overflowing
/// output, or a number of terms outside 1 to [`MAX_TERMS`].
pub(super) fn check_records(records: &[Record], output: usize, signals: impl Iterator<Item = usize>) -> Result<()> {
    let Some(first) = records.first() else {
        return Err(Error::Structure { what: "no record is given".into(), remedy: "give at least one run".into() });
    };
    for record in records {
        check_length("signals of a record", first.len(), record.len())?;
    }
    let signals: Vec<usize> = signals.collect();
    if let Some(signal) = signals.iter().chain([&output]).find(|s| **s >= first.len()) {
        return Err(Error::Structure {
            what: format!(
                "the equation contains signal {signal}, but the number of signals of the record is {}",
                first.len()
            ),
            remedy: "give the record all signals of the equation".into(),
        });
    }
    let size: f64 = records.iter().flat_map(|r| r.signal(output)).map(|v| v * v).sum();
    if !(size > 0.0 && size < f64::MAX) {
        return Err(Error::Structure {
            what: format!("the squares of the output sum up to {size}"),
            remedy: "scale it so that its squares are positive numbers".into(),
        });
    }
    if !(1..=MAX_TERMS).contains(&signals.len()) {
        return Err(Error::Structure {
            what: format!("the equation has {} terms", signals.len()),
            remedy: format!("give an equation with 1 to {MAX_TERMS} terms"),
        });
    }
    Ok(())
}
