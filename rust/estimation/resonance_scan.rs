//! Output error of an equation with fixed autoregressive terms: linear least squares in all other coefficients.

use super::least_squares::{solve, Regression};
use crate::equation::{Initial, Structure};
use crate::error::{check_finite, check_length, Result};
use crate::fractional::kernels::{block_pulse_kernel, check_order};
use crate::linalg::orthogonal::{extend_orthonormal, norm, project_out};
use crate::regressors::Record;
use crate::series::{reciprocal, Buffers, Kernel};

/// An initial term is omitted as linearly dependent if its response has at most this distance from the span of the
/// responses to the previous initial terms of the record. The distance is relative to the norm of the response.
const RANK_TOLERANCE: f64 = 1e-12;
/// Norm of a column after projection orthogonal to the initial terms, relative to its norm before. If this ratio of any
/// column is at or below the limit, all coefficients are solved together with the initial terms.
const MIN_REMAINING_NORM_RATIO: f64 = 1e-6;

/// Best fit of an equation with fixed autoregressive terms.
#[derive(Debug, Clone, PartialEq)]
pub struct FixedPoleEstimate {
    /// Norm of the output error relative to the norm of the output.
    pub error: f64,
    /// Coefficients, one per term of the structure. A fixed coefficient has the given value.
    pub coefficients: Vec<f64>,
}

/// Regression of one record: target, and spectra of the columns.
struct RecordSpectra {
    target: Vec<f64>,
    terms: Vec<Kernel>,
    initial: Vec<Kernel>,
    /// Kernels of the autoregressive terms.
    autoregressive_kernels: Vec<Vec<f64>>,
}

/// Fit an equation by output error for several sets of fixed autoregressive coefficients.
///
/// `structure` contains the terms in signals other than the output. `autoregressive_orders` contains the integration
/// orders of the autoregressive terms, and each point contains their coefficients. The coefficients of the other terms
/// and of the initial terms follow by linear least squares. There is one result per point. It is None if the response
/// overflows or a free term is linearly dependent.
///
/// Integrals of signals, powers of time and kernels are computed once. The cost is O(points · columns · m log m) for
/// records of m pulses.
///
/// # Errors
/// [`Length`](crate::error::Error::Length) if `fixed` or a point has a wrong number of coefficients, or if there is no
/// record. [`NotFinite`](crate::error::Error::NotFinite) if a fixed coefficient is not finite.
/// [`OutOfRange`](crate::error::Error::OutOfRange) for an invalid order or exponent.
/// [`Structure`](crate::error::Error::Structure) for a signal that does not exist.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # fn main() -> ftlm::error::Result<()> {
/// use ftlm::equation::{Equation, Initial, Structure, Term};
/// use ftlm::estimation::resonance_scan;
/// use ftlm::regressors::Record;
/// // D^2 y = -9 y + 2 u.
/// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
/// let plant = Equation::new(Structure { output: 0, order: 2.0, terms }, vec![-9.0, 2.0])?;
/// let input: Vec<f64> = (0..300).map(|k| f64::from(k % 40 / 20)).collect();
/// let rest = Record::new(0.02, PulseMeans::from_signals(vec![vec![0.0; 300], input.clone()]), None)?;
/// let y = ftlm::simulate::respond(&[plant], &rest, &[])?.remove(0);
/// let run = Record::new(0.02, PulseMeans::from_signals(vec![y, input]), None)?;
/// let structure = Structure { output: 0, order: 2.0, terms: vec![Term { signal: 1, order: 0.0 }] };
/// let points = [vec![-4.0], vec![-9.0]];
/// let estimates = resonance_scan::fit_with_fixed_poles(&[run], &structure, &[None], &Initial::Rest, &[2.0], &points)?;
/// let errors: Vec<f64> = estimates.iter().flatten().map(|estimate| estimate.error).collect();
/// assert!(errors.len() == 2 && errors[0] > 0.1 && errors[1] < 1e-9);
/// # Ok(())
/// # }
/// ```
pub fn fit_with_fixed_poles(
    records: &[Record],
    structure: &Structure,
    fixed: &[Option<f64>],
    initial: &Initial,
    autoregressive_orders: &[f64],
    points: &[Vec<f64>],
) -> Result<Vec<Option<FixedPoleEstimate>>> {
    check_length("fixed coefficients", structure.terms.len(), fixed.len())?;
    check_finite("fixed coefficients", &fixed.iter().flatten().copied().collect::<Vec<_>>())?;
    autoregressive_orders.iter().try_for_each(|&eta| check_order("integration of an autoregressive term", eta))?;
    points
        .iter()
        .try_for_each(|point| check_length("coefficients of a point", autoregressive_orders.len(), point.len()))?;
    let regression = Regression::new(records, structure, &vec![None; fixed.len()], initial)?;
    // Linearly dependent inputs have linearly dependent responses up to rounding.
    if solve(&regression.columns[..regression.free_count()], &regression.target, regression.free_count()).is_err() {
        return Ok(vec![None; points.len()]);
    }
    let parts: Vec<RecordSpectra> = (records.iter().enumerate())
        .map(|(r, record)| record_spectra(&regression, autoregressive_orders, r, record))
        .collect();
    let output_norm = norm(&regression.target).max(1e-300);
    points.iter().map(|point| fit_point(&parts, fixed, point, output_norm)).collect()
}

fn record_spectra(regression: &Regression, autoregressive_orders: &[f64], r: usize, record: &Record) -> RecordSpectra {
    let rows = regression.starts[r]..regression.starts[r + 1];
    let kernel_of = |column: &Vec<f64>| Kernel::new(&column[rows.clone()]);
    let (terms, initial) = regression.columns.split_at(regression.free_count());
    let term_count = initial.len() / (regression.starts.len() - 1);
    RecordSpectra {
        target: regression.target[rows.clone()].to_vec(),
        terms: terms.iter().map(kernel_of).collect(),
        initial: initial[r * term_count..(r + 1) * term_count].iter().map(kernel_of).collect(),
        autoregressive_kernels: autoregressive_orders
            .iter()
            .map(|&eta| block_pulse_kernel(eta, record.m(), record.step()))
            .collect(),
    }
}

/// Fit at one point: compute the responses of each record, then eliminate the initial terms.
///
/// `output_norm` is the norm of the measured output. Return None if a response overflows or a free term is linearly
/// dependent.
fn fit_point(
    parts: &[RecordSpectra],
    fixed: &[Option<f64>],
    point: &[f64],
    output_norm: f64,
) -> Result<Option<FixedPoleEstimate>> {
    let mut buffers = Buffers::default();
    let mut target: Vec<f64> = Vec::new();
    let mut columns: Vec<Vec<f64>> = vec![Vec::new(); fixed.iter().filter(|f| f.is_none()).count()];
    let mut initial_responses = Vec::with_capacity(parts.len());
    for part in parts {
        let m = part.target.len();
        let mut divisor = vec![0.0; m];
        divisor[0] = 1.0;
        for (c, kernel) in point.iter().zip(&part.autoregressive_kernels) {
            divisor.iter_mut().zip(kernel).for_each(|(d, v)| *d -= c * v);
        }
        let response = reciprocal(&divisor);
        if response.iter().any(|v| !v.is_finite()) {
            return Ok(None);
        }
        let response = Kernel::new(&response);
        let mut respond = |series: &Kernel| {
            let mut out = vec![0.0; m];
            response.times(series, &mut out, &mut buffers);
            out
        };
        let mut residual = part.target.clone();
        let mut free = columns.iter_mut();
        for (series, coefficient) in part.terms.iter().zip(fixed) {
            let output = respond(series);
            match coefficient {
                Some(c) => residual.iter_mut().zip(&output).for_each(|(t, v)| *t -= c * v),
                None => free.next().into_iter().for_each(|column| column.extend(&output)),
            }
        }
        target.extend(residual);
        initial_responses.push(part.initial.iter().map(&mut respond).collect::<Vec<_>>());
    }
    let is_finite = |v: &[f64]| v.iter().all(|x| x.is_finite());
    if !is_finite(&target)
        || !columns.iter().all(|c| is_finite(c))
        || !initial_responses.iter().flatten().all(|c| is_finite(c))
    {
        return Ok(None);
    }
    let Some((values, residual_norm)) = solve_with_initial_terms(columns, target, initial_responses) else {
        return Ok(None);
    };
    let mut values = values.into_iter();
    let coefficients = fixed.iter().map(|f| f.or_else(|| values.next()).unwrap_or(f64::NAN)).collect();
    Ok(Some(FixedPoleEstimate { error: residual_norm / output_norm, coefficients }))
}

/// Fit the coefficients of the columns together with the initial terms of each record.
///
/// Return the coefficients and the norm of the residuals; None if the regressors are linearly dependent.
fn solve_with_initial_terms(
    columns: Vec<Vec<f64>>,
    target: Vec<f64>,
    initial_responses: Vec<Vec<Vec<f64>>>,
) -> Option<(Vec<f64>, f64)> {
    let lengths: Vec<usize> = initial_responses.iter().map(|responses| responses.first().map_or(0, Vec::len)).collect();
    let free = columns.len();
    let (mut projected, mut residual) = (columns.clone(), target.clone());
    let mut from = 0;
    for (responses, &m) in initial_responses.iter().zip(&lengths) {
        let mut basis = Vec::new();
        responses.iter().for_each(|column| extend_orthonormal(&mut basis, column.clone(), RANK_TOLERANCE));
        for series in projected.iter_mut().chain(std::iter::once(&mut residual)) {
            let rows = &mut series[from..from + m];
            project_out(&basis, rows);
            project_out(&basis, rows);
        }
        from += m;
    }
    let is_determined = projected
        .iter()
        .zip(&columns)
        .all(|(projected, original)| norm(projected) > MIN_REMAINING_NORM_RATIO * norm(original));
    let (columns, target) = if is_determined {
        (projected, residual)
    } else {
        (append_initial_terms(columns, &initial_responses, &lengths), target)
    };
    let (x, _) = solve(&columns, &target, free).ok()?;
    let mut remaining = target;
    for (column, c) in columns.iter().zip(&x) {
        remaining.iter_mut().zip(column).for_each(|(e, v)| *e -= c * v);
    }
    Some((x, norm(&remaining)))
}

/// Append the columns of the initial terms. Each of them is zero outside its record.
fn append_initial_terms(
    mut columns: Vec<Vec<f64>>,
    initial_responses: &[Vec<Vec<f64>>],
    lengths: &[usize],
) -> Vec<Vec<f64>> {
    let rows = lengths.iter().sum();
    let mut from = 0;
    for (responses, &m) in initial_responses.iter().zip(lengths) {
        for series in responses {
            let mut column = vec![0.0; rows];
            column[from..from + m].copy_from_slice(series);
            columns.push(column);
        }
        from += m;
    }
    columns
}
