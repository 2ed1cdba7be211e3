//! Linear least squares for one body with friction, under sign constraints on the coefficients.

use std::collections::BTreeMap;

use crate::error::Result;
use crate::estimation::joint_fit::structure::{Coefficient, ParametricEquation};
use crate::fractional::kernels::{kernel, power_means};
use crate::linalg::dense::triangular_factor;
use crate::linalg::orthogonal::norm;
use crate::linalg::small::nonnegative_solution;
use crate::parallel::Stop;
use crate::recording::Recording;
use crate::regressors::Record;
use crate::series;
use crate::signal::statistics::white_noise_deviation;

/// Time over which a velocity is averaged, as a fraction of the duration of the run.
const VELOCITY_SPAN_FRACTION: f64 = 0.01;
/// Minimum displacement during the averaging time of the velocity at which a body counts as sliding, in standard
/// deviations of the noise.
const VELOCITY_NOISE_RATIO: f64 = 5.0;
/// Maximum number of iterations in which the friction force at rest is recomputed from the input forces.
const MAX_REST_ITERATIONS: usize = 4;

/// Block-pulse record of one run, and the friction force of each pulse relative to Coulomb friction.
///
/// While the body slides, this is the sign of the measured velocity. At rest it is between −1 and 1.
struct RunFriction {
    record: Record,
    sign: Vec<f64>,
}

/// Estimate the coefficients of one equation with friction and given orders, and return them by name.
///
/// The estimate is a least-squares fit of the integrated equation to all runs. Terms of the output and friction have
/// the signs of a passive body. Inputs may have any sign. The friction sign is that of the measured velocity where it
/// exceeds the noise. Elsewhere the body sticks, and friction balances the input forces. Each run has its own initial
/// position, initial velocity and constant force.
///
/// The result is empty if the Coulomb coefficient is fixed, or a term has a higher order than the equation. It is also
/// empty if no finite solution exists.
///
/// # Errors
/// An error if the block-pulse means of a run cannot be computed ([`Recording::pulses`]).
/// [`Error::Interrupted`](crate::error::Error::Interrupted) after a stop request.
pub(super) fn fit_sliding_body(
    runs: &[Recording],
    equation: &ParametricEquation,
    stop: &Stop,
) -> Result<BTreeMap<String, f64>> {
    let Some((factor, Coefficient::Free(coulomb_name))) = equation.friction.as_ref().map(|friction| &friction.coulomb)
    else {
        return Ok(BTreeMap::new());
    };
    let alpha = equation.order.constant;
    if equation.terms.is_empty() || equation.terms.iter().any(|term| alpha < term.order.constant) {
        return Ok(BTreeMap::new());
    }
    let mut run_frictions =
        runs.iter().map(|run| RunFriction::from_run(run, equation.output)).collect::<Result<Vec<_>>>()?;
    let is_at_rest: Vec<Vec<bool>> =
        run_frictions.iter().map(|run_friction| run_friction.sign.iter().map(|v| *v == 0.0).collect()).collect();
    let mut estimates = BTreeMap::new();
    for _ in 0..MAX_REST_ITERATIONS {
        stop.check()?;
        estimates = signed_least_squares(equation, &run_frictions);
        let Some(coulomb) = estimates.get(coulomb_name).map(|value| factor * value).filter(|coulomb| *coulomb > 0.0)
        else {
            break;
        };
        for (run_friction, pulses_at_rest) in run_frictions.iter_mut().zip(&is_at_rest) {
            let mut forces = vec![0.0; run_friction.sign.len()];
            for term in equation.input_terms().filter(|term| term.order.constant == 0.0) {
                let free_coefficient = || {
                    term.coefficient
                        .name()
                        .map_or(0.0, |name| term.factor * estimates.get(name).copied().unwrap_or(0.0))
                };
                let value = term.fixed_coefficient().unwrap_or_else(free_coefficient);
                forces.iter_mut().zip(run_friction.record.signal(term.signal)).for_each(|(p, v)| *p += value * v);
            }
            for ((sign, force), _) in
                run_friction.sign.iter_mut().zip(forces).zip(pulses_at_rest).filter(|(_, at_rest)| **at_rest)
            {
                *sign = (force / coulomb).clamp(-1.0, 1.0);
            }
        }
    }
    Ok(estimates)
}

impl RunFriction {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn from_run(run: &Recording, output: usize) -> Result<Self> {
        let m = run.len() - 1;
        let record = run.pulses(m, false)?.into_record()?;
        let finite: Vec<f64> = run.channel(output)?.samples.iter().copied().filter(|v| !v.is_nan()).collect();
        let min_displacement = VELOCITY_NOISE_RATIO * white_noise_deviation(&finite);
        let span = ((VELOCITY_SPAN_FRACTION * m as f64).round() as usize).max(1);
        let means = record.signal(output);
        let sign = (0..m).map(|i| {
            let start = i.saturating_sub(span / 2).min(m - span - 1);
            let displacement = means[start + span] - means[start];
            if displacement.abs() > min_displacement {
                displacement.signum()
            } else {
                0.0
            }
        });
        let sign = sign.collect();
        Ok(Self { record, sign })
    }
}

/// Return the least-squares coefficients by name, under the sign constraints; empty if the columns are not finite.
fn signed_least_squares(equation: &ParametricEquation, run_frictions: &[RunFriction]) -> BTreeMap<String, f64> {
    let (alpha, rows) =
        (equation.order.constant, run_frictions.iter().map(|run_friction| run_friction.sign.len()).sum());
    let stack_runs = |column_of_run: &dyn Fn(&RunFriction) -> Vec<f64>| {
        run_frictions.iter().flat_map(column_of_run).collect::<Vec<f64>>()
    };
    let mut target = stack_runs(&|run_friction| run_friction.record.signal(equation.output).to_vec());
    // Columns, each with the name of its coefficient. A column occurs with both signs if its coefficient may have any
    // sign.
    let (mut names, mut columns) = (Vec::new(), Vec::new());
    let mut add_columns = |name: Option<&String>, signs: &[f64], column: &[f64]| {
        for sign in signs {
            names.push((name.cloned(), *sign));
            columns.push(column.iter().map(|v| sign * v).collect::<Vec<f64>>());
        }
    };
    for term in &equation.terms {
        let column = stack_runs(&|run_friction| run_friction.record.integral(term.signal, alpha - term.order.constant));
        match term.fixed_coefficient() {
            Some(value) => target.iter_mut().zip(&column).for_each(|(t, c)| *t -= value * c),
            // The product of coefficient and factor is negative for a term of the output itself.
            None if term.signal == equation.output => {
                let column: Vec<f64> = column.iter().map(|v| term.factor * v).collect();
                add_columns(term.coefficient.name(), &[-term.factor.signum()], &column);
            }
            None => {
                let column: Vec<f64> = column.iter().map(|v| term.factor * v).collect();
                add_columns(term.coefficient.name(), &[1.0, -1.0], &column);
            }
        }
    }
    if let Some((factor, coefficient)) = equation.friction.as_ref().map(|friction| &friction.coulomb) {
        let friction_column = |run_friction: &RunFriction| {
            let m = run_friction.sign.len();
            let integral = series::multiply(&kernel(alpha, m, run_friction.record.step()), &run_friction.sign, m);
            integral.into_iter().map(|v| -factor * v).collect()
        };
        add_columns(coefficient.name(), &[1.0], &stack_runs(&friction_column));
    }
    let mut row_start = 0;
    for run_friction in run_frictions {
        let m = run_friction.sign.len();
        for exponent in [0.0, 1.0, alpha] {
            let mut column = vec![0.0; rows];
            column[row_start..row_start + m].copy_from_slice(&power_means(exponent, m, run_friction.record.step()));
            add_columns(None, &[1.0, -1.0], &column);
        }
        row_start += m;
    }
    let norms: Vec<f64> = columns.iter().map(|column| norm(column)).collect();
    if !norms.iter().all(|column_norm| column_norm.is_finite()) {
        return BTreeMap::new();
    }
    for (column, column_norm) in columns.iter_mut().zip(&norms).filter(|(_, column_norm)| **column_norm > 0.0) {
        column.iter_mut().for_each(|v| *v /= column_norm);
    }
    // The triangular factor has the same inner products as the columns, but is small.
    columns.push(target);
    let (k, factor) = (columns.len(), triangular_factor(&columns));
    let mut factor_columns: Vec<Vec<f64>> = (0..k).map(|j| (0..k).map(|i| factor[i * k + j]).collect()).collect();
    let target_values = factor_columns.pop().unwrap_or_default();
    let solution = nonnegative_solution(&factor_columns, &target_values);
    let mut estimates = BTreeMap::new();
    for (((name, sign), column_norm), x) in names.into_iter().zip(norms).zip(solution) {
        if let Some(name) = name {
            *estimates.entry(name).or_insert(0.0) += if column_norm > 0.0 { sign * x / column_norm } else { 0.0 };
        }
    }
    estimates
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::equation;
    use crate::estimation::joint_fit::structure::{FrictionParameters, Order, ParametricTerm};
    use crate::friction::FrictionLaw;
    use crate::nonlinear::NonlinearSystem;
    use crate::recording::{Channel, Role};
    use crate::signal::block_pulse::Intersample;

    #[test]
    fn coefficients_of_a_sliding_body_have_physical_signs() -> Result<()> {
        // D² y = −2 D y + 3 u − 0.5 sgn(D y).
        let (rows, step) = (801, 0.01);
        let u: Vec<f64> = (0..rows).map(|k| if (k / 130) % 2 == 0 { 1.0 } else { -1.0 }).collect();
        let terms = vec![equation::Term { signal: 0, order: 1.0 }, equation::Term { signal: 1, order: 0.0 }];
        let linear = equation::Structure { output: 0, order: 2.0, terms };
        let equation = equation::Equation::new(linear, vec![-2.0, 3.0])?;
        let body = NonlinearSystem::with_friction(vec![equation], vec![(0, FrictionLaw::coulomb(0.5))], 2);
        let record = Record::from_rows(step, vec![vec![0.0; rows - 1], u[..rows - 1].to_vec()], None)?;
        let means = body.run(&record, &[Vec::new()])?.outputs.remove(0);
        let y: Vec<f64> = std::iter::once(0.0).chain(means.windows(2).map(|w| 0.5 * (w[0] + w[1]))).collect();
        let y = [y.as_slice(), &means[rows - 2..]].concat();
        let (y, u) = (Channel::new("y", y, Role::Output), Channel::new("u", u, Role::Input(Intersample::Hold)));
        let run = Recording::new("run", step, None, vec![y, u], vec![0])?;
        let free = |name: &str| Coefficient::Free(name.into());
        let term = |signal, order, name| ParametricTerm {
            signal,
            order: Order::number(order),
            coefficient: free(name),
            factor: 1.0,
        };
        let equation = ParametricEquation {
            output: 0,
            order: Order::number(2.0),
            terms: vec![term(0, 1.0, "v"), term(1, 0.0, "b"), term(0, 0.0, "k")],
            friction: Some(FrictionParameters {
                coulomb: (1.0, free("fc")),
                stribeck: (1.0, Coefficient::Fixed(0.0)),
                speed: (1.0, Coefficient::Fixed(1.0)),
            }),
        };
        let estimates = fit_sliding_body(&[run], &equation, &Stop::default())?;
        for (name, truth) in [("v", -2.0), ("b", 3.0), ("fc", 0.5)] {
            assert!((estimates[name] / truth - 1.0).abs() < 0.1, "{name}: {estimates:?}");
        }
        // The body has no spring, and the sign constraint excludes one that does not restore.
        assert!(estimates["k"] <= 0.0 && estimates["k"] > -0.2, "{estimates:?}");
        Ok(())
    }
}
