//! Simulation of models: response, equation error, output error, and explicit Euler as a baseline.

use crate::equation::{check_regular, Equation, Initial, Structure, ORDER_GRAIN};
use crate::error::{check_finite, check_length, check_step, Error, Result};
use crate::estimation::least_squares;
use crate::fractional::kernels::kernel;
use crate::regressors::{is_impulse, Record};
use crate::series;
use crate::series_system::System;

/// Response of a model whose initial terms are fitted to the measured outputs.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Response {
    /// Pulse means of each equation's output.
    pub outputs: Vec<Vec<f64>>,
    /// Exponents of t of the initial terms, by equation.
    pub exponents: Vec<Vec<f64>>,
    /// Coefficients of the initial terms, by equation. The coefficient of a linearly dependent term is 0.
    pub initial: Vec<Vec<f64>>,
}

/// Sensor filter, and the outputs to which it applies.
#[derive(Debug, Clone, Copy)]
pub struct OutputFilter<'a> {
    /// Filter as a power series in the one-step delay.
    pub series: &'a [f64],
    /// For each equation, whether the filter applies to its output.
    pub applies: &'a [bool],
}

/// Simulate equations (free run: only inputs and initial conditions are used). Return the pulse means of their outputs.
///
/// Signals that are not outputs of `equations` are taken from the record. A single equation therefore uses other
/// outputs as measured, and a complete system uses only the inputs. `initial` holds (exponent, coefficient) pairs of
/// powers of t by equation; it is empty for zero initial conditions. Integer exponents below 0 denote impulses. An
/// impulse that acts on the sensor only is added to the output. This is the case if the record is not filtered, or if
/// the output has a filter transient ([`Record::with_initial_state`]). An unstable model may overflow, so that values
/// are not finite. O(n² m log² m) for n equations and m pulses.
///
/// # Errors
/// Errors for invalid orders, signals or coefficients ([`Equation::check`]). [`Error::LeadingZero`] or
/// [`Error::Structure`] if the equations cannot be solved for their outputs.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// use ftlm::equation::{Equation, Structure, Term};
/// use ftlm::regressors::Record;
/// # fn main() -> ftlm::error::Result<()> {
/// // y′ = −y + u.
/// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
/// let model = Equation::new(Structure { output: 0, order: 1.0, terms }, vec![-1.0, 1.0])?;
/// let run = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 300], vec![1.0; 300]]), None)?;
/// let response = ftlm::simulate::respond(&[model], &run, &[])?;
/// assert!((response[0][299] - (1.0 - (-2.995_f64).exp())).abs() < 1e-4);
/// # Ok(())
/// # }
/// ```
pub fn respond(equations: &[Equation], record: &Record, initial: &[Vec<(f64, f64)>]) -> Result<Vec<Vec<f64>>> {
    build_system(equations, record, initial)?.respond(initial)
}

/// Build the system of equations on a record. Return an error for invalid equations or initial terms.
fn build_system<'a>(equations: &[Equation], record: &'a Record, initial: &[Vec<(f64, f64)>]) -> Result<System<'a>> {
    for equation in equations {
        equation.check(record.len())?;
    }
    if !initial.is_empty() {
        check_length("initial terms", equations.len(), initial.len())?;
    }
    for terms in initial {
        let (exponents, coefficients): (Vec<f64>, Vec<f64>) = terms.iter().copied().unzip();
        check_finite("coefficients of the initial terms", &coefficients)?;
        // An impulse that passes a filter afterwards is an ordinary input, so its exponent is not checked.
        Initial::Powers(exponents.into_iter().filter(|&e| !is_impulse(e)).collect()).check()?;
    }
    let system = System::new(equations, record)?;
    check_regular(equations)?;
    Ok(system)
}

/// Simulate damped equations: the power series of the system are evaluated at ρz, where z is the one-step delay and ρ =
/// e^{−decay}. Inputs and initial terms are not damped.
///
/// A large enough decay \[1/pulse\] makes every model stable. Damped responses serve as instruments, which need to be
/// free of noise but not exact.
///
/// # Errors
/// The errors of [`respond`], for invalid equations or equations that cannot be solved for the outputs.
pub fn respond_damped(
    equations: &[Equation],
    record: &Record,
    initial: &[Vec<(f64, f64)>],
    decay: f64,
) -> Result<Vec<Vec<f64>>> {
    build_system(equations, record, initial)?.with_damping(decay).respond(initial)
}

/// Return the inverse of the matrix A of the equations A y = b, whose elements are power series in the one-step delay.
/// `[j][i]` is the response of output j to a unit pulse on the right-hand side of equation i. O(n³ m log² m) for n
/// equations and m pulses.
///
/// # Errors
/// The errors of [`respond`], for invalid equations or equations that cannot be solved for the outputs.
pub fn inverse(equations: &[Equation], record: &Record) -> Result<Vec<Vec<Vec<f64>>>> {
    build_system(equations, record, &[])?.inverse()
}

/// Return the response of every output to a unit of each initial term, with all other inputs zero.
///
/// `units` holds (index of the equation, exponent of t) of each initial term. `[k][j]` holds the pulse means of output
/// j for initial term k. All responses need one division, O(n³ m log² m) for n equations and m pulses, and one product
/// each. Strongly growing responses are divided one by one, which preserves the digits of their first terms.
///
/// # Errors
/// [`Error::Structure`] for an equation index out of range. The errors of [`respond`] for invalid equations.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::equation::{Equation, Structure, Term};
/// # use ftlm::regressors::Record;
/// # use ftlm::simulate;
/// # fn main() -> ftlm::error::Result<()> {
/// // D y = -2 y from y(0) = 1, and from a constant on its right-hand side, which is t^1.
/// let structure = Structure { output: 0, order: 1.0, terms: vec![Term { signal: 0, order: 0.0 }] };
/// let record = Record::new(0.001, PulseMeans::from_signals(vec![vec![0.0; 1000]]), None)?;
/// let decay = Equation { structure, coefficients: vec![-2.0] };
/// let units = simulate::unit_responses(&[decay], &record, &[(0, 0.0), (0, 1.0)])?;
/// assert!((units[0][0][999] - (-1.999_f64).exp()).abs() < 1e-6);
/// assert!((units[1][0][999] - 0.5 * (1.0 - (-1.999_f64).exp())).abs() < 1e-6);
/// # Ok(())
/// # }
/// ```
pub fn unit_responses(equations: &[Equation], record: &Record, units: &[(usize, f64)]) -> Result<Vec<Vec<Vec<f64>>>> {
    build_system(equations, record, &unit_terms(equations.len(), units)?)?.unit_responses(units)
}

/// Return the response with zero initial conditions ([`respond`]) and the [`unit_responses`]. Both share their
/// transforms.
///
/// # Errors
/// [`Error::Structure`] for an equation index out of range in `units`. The errors of [`respond`] for invalid equations.
#[allow(clippy::type_complexity)]
pub fn respond_and_units(
    equations: &[Equation],
    record: &Record,
    units: &[(usize, f64)],
) -> Result<(Vec<Vec<f64>>, Vec<Vec<Vec<f64>>>)> {
    let system = build_system(equations, record, &unit_terms(equations.len(), units)?)?;
    system.zero_initial_and_unit_responses(units)
}

/// Return the initial terms `units` with coefficient 1, by equation. Return an error for an equation index out of
/// range.
fn unit_terms(equations: usize, units: &[(usize, f64)]) -> Result<Vec<Vec<(f64, f64)>>> {
    let mut initial = vec![Vec::new(); equations];
    for &(i, exponent) in units {
        initial
            .get_mut(i)
            .ok_or_else(|| Error::Structure {
                what: format!("an initial term of equation {i}"),
                remedy: format!("use an index from 0 to {}", equations.saturating_sub(1)),
            })?
            .push((exponent, 1.0));
    }
    Ok(initial)
}

/// Simulate with the initial terms that fit the measured outputs best.
///
/// The response is linear in the initial terms. Their coefficients follow by least squares on the output error, with
/// each output weighted by 1/σ, where σ is the standard deviation of its measurement. They apply to this record only.
///
/// # Errors
/// The errors of [`respond`] for invalid equations. [`Error::Length`] for a filter of the wrong length.
pub fn respond_with_initial(
    equations: &[Equation],
    record: &Record,
    initial: &Initial,
    filter: Option<OutputFilter<'_>>,
) -> Result<Response> {
    let system = build_system(equations, record, &[])?;
    initial.check()?;
    if let Some(filter) = filter {
        check_length("filter", record.m(), filter.series.len())?;
        check_length("filtered outputs", equations.len(), filter.applies.len())?;
    }
    let is_filtered = |i: usize| record.is_filtered() || filter.is_some_and(|f| f.applies[i]);
    let exponents: Vec<Vec<f64>> = (equations.iter().enumerate())
        .map(|(i, e)| e.structure.initial_exponents(if is_filtered(i) { initial } else { initial.without_filter() }))
        .collect();
    let apply_filter = |mut outputs: Vec<Vec<f64>>| {
        if let Some(filter) = filter {
            for (output, _) in outputs.iter_mut().zip(filter.applies).filter(|&(_, &applies)| applies) {
                *output = series::multiply(filter.series, output, record.m());
            }
        }
        outputs
    };
    let mut outputs = apply_filter(system.solve(&system.rhs)?);
    let mut coefficients: Vec<Vec<f64>> = exponents.iter().map(|e| vec![0.0; e.len()]).collect();
    let is_finite = |outputs: &[Vec<f64>]| outputs.iter().flatten().all(|v| v.is_finite());
    if exponents.iter().all(Vec::is_empty) || !is_finite(&outputs) {
        return Ok(Response { outputs, exponents, initial: coefficients });
    }
    let weights: Vec<f64> = equations.iter().map(|e| output_weight(record.signal(e.structure.output))).collect();
    let stack = |outputs: &[Vec<f64>]| -> Vec<f64> {
        outputs.iter().zip(&weights).flat_map(|(o, w)| o.iter().map(move |v| v * w)).collect()
    };
    let units: Vec<(usize, usize, f64)> = (exponents.iter().enumerate())
        .flat_map(|(i, list)| list.iter().enumerate().map(move |(e, &exponent)| (i, e, exponent)))
        .collect();
    let terms: Vec<(usize, f64)> = units.iter().map(|&(i, _, exponent)| (i, exponent)).collect();
    let responses: Vec<(usize, usize, Vec<Vec<f64>>)> = (units.iter().zip(system.unit_responses(&terms)?))
        .map(|(&(i, e, _), outputs)| (i, e, apply_filter(outputs)))
        .filter(|(_, _, response)| is_finite(response))
        .collect();
    let columns: Vec<Vec<f64>> = responses.iter().map(|(_, _, r)| stack(r)).collect();
    let residuals: Vec<Vec<f64>> = equations
        .iter()
        .zip(&outputs)
        .map(|(e, o)| record.signal(e.structure.output).iter().zip(o).map(|(y, v)| y - v).collect())
        .collect();
    let (solution, _) = least_squares::solve(&columns, &stack(&residuals), 0)?;
    for ((i, e, response), x) in responses.iter().zip(solution) {
        coefficients[*i][*e] = x;
        for (output, r) in outputs.iter_mut().zip(response) {
            output.iter_mut().zip(r).for_each(|(o, v)| *o += x * v);
        }
    }
    Ok(Response { outputs, exponents, initial: coefficients })
}

#[allow(clippy::cast_precision_loss)]
fn output_weight(y: &[f64]) -> f64 {
    let mean = y.iter().sum::<f64>() / y.len() as f64;
    let variance = y.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / y.len() as f64;
    if variance > 0.0 {
        1.0 / variance.sqrt()
    } else {
        1.0
    }
}

/// Return the equation error ε = y − Σ c_k I^{α−ν_k} s_k − initial terms in each pulse, with measured output y and
/// signals s_k.
///
/// Initial terms are fitted by least squares at the given coefficients.
///
/// # Errors
/// The errors of [`respond`] for an invalid equation.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// use ftlm::equation::{Equation, Initial, Structure, Term};
/// use ftlm::regressors::Record;
/// # fn main() -> ftlm::error::Result<()> {
/// // y′ = −y + u.
/// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
/// let model = Equation::new(Structure { output: 0, order: 1.0, terms }, vec![-1.0, 1.0])?;
/// let run = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 100], vec![0.0; 100]]), None)?;
/// assert_eq!(ftlm::simulate::equation_error(&model, &run, &Initial::Rest)?, vec![0.0; 100]);
/// # Ok(())
/// # }
/// ```
pub fn equation_error(equation: &Equation, record: &Record, initial: &Initial) -> Result<Vec<f64>> {
    equation.check(record.len())?;
    let fixed: Vec<Option<f64>> = equation.coefficients.iter().copied().map(Some).collect();
    let records = std::slice::from_ref(record);
    let regression = least_squares::Regression::new(records, &equation.structure, &fixed, initial)?;
    let (solution, _) = least_squares::solve(&regression.columns, &regression.target, 0)?;
    let mut residuals = regression.target;
    for (column, x) in regression.columns.iter().zip(solution) {
        residuals.iter_mut().zip(column).for_each(|(e, v)| *e -= x * v);
    }
    Ok(residuals)
}

/// Simulate integer-order equations by explicit Euler from zero initial conditions, the baseline of the paper.
///
/// `signals` holds point samples of the signals of the record at intervals of `step` \[s\]. Samples of the outputs are
/// ignored. Every α must be an integer, every order of an output an integer below its α, and every other order 0.
/// Return the samples of the output of each equation. They are not finite if the step is unstable.
///
/// # Errors
/// [`Error::Structure`] with the index of an equation whose orders are not supported. The errors of
/// [`Equation::check`], and errors for signals of different lengths or an invalid step.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn explicit_euler(equations: &[Equation], signals: &[Vec<f64>], step: f64) -> Result<Vec<Vec<f64>>> {
    check_step(step)?;
    for (i, signal) in signals.iter().enumerate() {
        check_finite(&format!("signal {i}"), signal)?;
        check_length(&format!("signal {i}"), signals[0].len(), signal.len())?;
    }
    let is_integer = |order: f64| (order - order.round()).abs() < ORDER_GRAIN && order >= 0.0;
    let outputs: Vec<usize> = equations.iter().map(|e| e.structure.output).collect();
    let alpha: Vec<usize> = equations.iter().map(|e| e.structure.order.round() as usize).collect();
    for (i, equation) in equations.iter().enumerate() {
        let structure = &equation.structure;
        structure.check(signals.len(), |s| !outputs.contains(&s))?;
        equation.check(signals.len())?;
        let is_supported = |term: &crate::equation::Term| match outputs.iter().position(|&o| o == term.signal) {
            Some(j) => is_integer(term.order) && (term.order.round() as usize) < alpha[j],
            None => term.order.abs() < ORDER_GRAIN,
        };
        // An order within the resolution of 0 is an integer, but has no state.
        if !is_integer(structure.order) || alpha[i] == 0 || !structure.terms.iter().all(is_supported) {
            return Err(Error::Structure {
                what: format!("equation {i} has orders that explicit Euler cannot step"),
                remedy: "use integer orders below that of each output, and order 0 for inputs, or use the simulation by series"
                    .into(),
            });
        }
    }
    let rows = signals.iter().map(Vec::len).min().unwrap_or(0);
    // states[i][ν] is D^ν of output i.
    let mut states: Vec<Vec<f64>> = alpha.iter().map(|&a| vec![0.0; a]).collect();
    let mut out = vec![Vec::with_capacity(rows); equations.len()];
    let sample = |signal: usize, row: usize| signals[signal][row];
    for row in 0..rows {
        let highest: Vec<f64> = equations
            .iter()
            .map(|equation| {
                let terms = equation.structure.terms.iter().zip(&equation.coefficients);
                terms
                    .map(|(term, c)| {
                        c * match outputs.iter().position(|&o| o == term.signal) {
                            Some(j) => states[j][term.order.round() as usize],
                            None => sample(term.signal, row),
                        }
                    })
                    .sum()
            })
            .collect();
        for ((samples, state), high) in out.iter_mut().zip(&mut states).zip(highest) {
            samples.push(state[0]);
            for nu in 0..state.len() {
                let slope = state.get(nu + 1).copied().unwrap_or(high);
                state[nu] += step * slope;
            }
        }
    }
    Ok(out)
}

/// Return the output error Σ|y − ŷ| between measurement y and simulation ŷ, eq. (45) of the paper, for each row of
/// coefficients of one structure. Initial conditions are zero. The error is infinite if the simulation overflows.
///
/// The errors show the convergence of a recursive estimate. Regressors are computed once, and each row costs one
/// division.
///
/// # Errors
/// Errors for invalid orders or signals ([`Structure::check`]). [`Error::Length`] for a row of the wrong length.
pub fn trace_errors(structure: &Structure, record: &Record, rows: &[Vec<f64>]) -> Result<Vec<f64>> {
    structure.check(record.len(), |_| true)?;
    let m = record.m();
    let parts: Vec<(bool, Vec<f64>)> = (0..structure.terms.len())
        .map(|k| {
            let (term, eta) = (structure.terms[k], structure.integration(k));
            if term.signal == structure.output {
                (true, kernel(eta, m, record.step()))
            } else {
                (false, record.integral(term.signal, eta))
            }
        })
        .collect();
    let measured = record.signal(structure.output);
    rows.iter()
        .map(|row| {
            check_length("coefficients", parts.len(), row.len())?;
            let mut divisor = vec![0.0; m];
            divisor[0] = 1.0;
            let mut numerator = vec![0.0; m];
            for ((is_output_term, series), c) in parts.iter().zip(row) {
                if *is_output_term {
                    divisor.iter_mut().zip(series).for_each(|(d, v)| *d -= c * v);
                } else {
                    numerator.iter_mut().zip(series).for_each(|(n, v)| *n += c * v);
                }
            }
            let response = series::divide(&numerator, &divisor)?;
            let error: f64 = measured.iter().zip(response).map(|(y, v)| (y - v).abs()).sum();
            Ok(if error.is_nan() { f64::INFINITY } else { error })
        })
        .collect()
}

/// Return the stability margin of the block-pulse scheme at the Nyquist frequency. `output_terms` holds (coefficient c,
/// integration order η = α − ν) of the terms of the output, and `step` is the pulse length h \[s\].
///
/// The scheme divides by 1 − Σ c F^η, where F^η is the power series of I^η. At z = −1 the divisor is 1 − Σ c h^η
/// A(η)/Γ(η+2) with A(η) = 4(1 − 2^{η+2})·ζ(−η−1), the Abel sum of the alternating kernel (A(1) = 0, A(2) = −1/2). If
/// it is not positive, the scheme has a mode that grows from pulse to pulse even for a stable model. The step must then
/// be refined. For D²y = −c y the margin is 1 − c·h²/12.
///
/// ```
/// let margin = ftlm::simulate::nyquist_margin(&[(-12.0, 2.0)], 0.5);
/// assert!((margin - 0.75).abs() < 1e-12);
/// ```
#[must_use]
pub fn nyquist_margin(output_terms: &[(f64, f64)], step: f64) -> f64 {
    1.0 - output_terms
        .iter()
        .map(|&(c, eta)| c * libm::pow(step, eta) * alternating_sum(eta) / libm::tgamma(eta + 2.0))
        .sum::<f64>()
}

/// Return the Abel sum A(η) of [`nyquist_margin`] by the functional equation of the Riemann zeta function: A = 4(1 −
/// 2^{s+1})·2^{−s}π^{−s−1}·sin(−πs/2)·Γ(1+s)·ζ(1+s), s = η + 1.
fn alternating_sum(eta: f64) -> f64 {
    use std::f64::consts::PI;
    let s = eta + 1.0;
    let zeta =
        -libm::pow(2.0, -s) * libm::pow(PI, -s - 1.0) * libm::sin(PI * s / 2.0) * libm::tgamma(1.0 + s) * zeta(1.0 + s);
    4.0 * (1.0 - libm::exp2(s + 1.0)) * zeta
}

/// Riemann zeta function ζ(x) for x > 1, by Euler–Maclaurin summation with 16 terms.
fn zeta(x: f64) -> f64 {
    const TERM_COUNT: f64 = 16.0;
    let mut sum = 0.0;
    let mut n = 1.0;
    while n < TERM_COUNT {
        sum += libm::pow(n, -x);
        n += 1.0;
    }
    let last = libm::pow(TERM_COUNT, -x);
    let slope = x * last / TERM_COUNT;
    let third = slope * (x + 1.0) * (x + 2.0) / (TERM_COUNT * TERM_COUNT);
    let fifth = third * (x + 3.0) * (x + 4.0) / (TERM_COUNT * TERM_COUNT);
    sum + last * TERM_COUNT / (x - 1.0) + 0.5 * last + slope / 12.0 - third / 720.0 + fifth / 30240.0
}
