//! Initial terms that represent the past inputs of a run, under a Gaussian prior on these inputs.
//!
//! Initial terms are multiples of powers of time that are added to the right-hand sides of the equations, and levels of
//! the outputs. Before the first sample, each equation has an unknown zero-mean Gaussian input, which is piecewise
//! constant on octaves of time over [`PAST_LENGTHS`] lengths of the run. The standard deviation of these inputs is
//! relative to the response to the inputs of the run. It maximizes the marginal likelihood (empirical Bayes). Without
//! the prior, the initial terms would absorb errors of the model. Initial values by Caputo's definition and levels have
//! no prior.

use std::sync::Arc;

use super::initial_terms;
use super::refinement::{Refinement, FIRST_REFINEMENT};
use super::richardson::{add_multiple, combine, Rows};
use super::simulation::{InitialTerms, OutputSimulation, Terms};
use crate::equation::{Equation, Structure, Term};
use crate::error::{check_length, Error, Kind, Result};
use crate::linalg::dense::{minimum_norm_solution, singular_values, SingularValues};
use crate::linalg::orthogonal::{norm, project_out};
use crate::parallel::Stop;
use crate::recording::{Channel, Recording, Role};
use crate::signal::block_pulse::Intersample;
use crate::signal::nonuniform::interpolate;
use crate::signal::statistics::{inner, mean, variance_inflation};

/// Length of the past that is modeled, in lengths of the run.
const PAST_LENGTHS: usize = 4;
/// Candidate standard deviations of past inputs. At the value 1, the response to past inputs is as large at the first
/// sample as the root mean square of the response to the inputs of the run.
const PAST_INPUT_SIZES: [f64; 6] = [0.0, 0.03, 0.1, 0.3, 1.0, 3.0];
/// Ratio to the largest singular value below which a singular value of responses counts as rounding error.
const MIN_SINGULAR_VALUE_RATIO: f64 = 1e-10;

/// Regressors of the fit of initial terms: one column of weighted samples per term.
struct WeightedColumns {
    /// Columns of unit norm.
    columns: Rows,
    /// Norm of each column before the division by it.
    norms: Vec<f64>,
    /// Column indices of the terms without a prior.
    columns_without_prior: Vec<usize>,
}

impl OutputSimulation {
    /// Return the posterior mean of the initial terms that represent past inputs: (exponent, coefficient) by equation.
    ///
    /// `exponents[i]` are the exponents of the powers of time in equation i, and `exponents_without_prior[i]` are those
    /// among them whose terms have no prior. With `has_level`, the level of each output is a further term without a
    /// prior; it has the exponent ∞ and belongs to the equation of the output. None if a response is not finite.
    ///
    /// # Errors
    /// The errors of [`OutputSimulation::refine`]. [`Error::Length`] if `exponents` or `exponents_without_prior` do not
    /// have one entry per equation.
    ///
    /// ```
    /// use ftlm::equation::{Equation, Structure, Term};
    /// use ftlm::output_samples::{InitialTerms, OutputSimulation, Refinement};
    /// use ftlm::parallel::Stop;
    /// use ftlm::recording::{Channel, Recording, Role};
    /// // D^0.5 y = −y after a unit step of an unknown input, which lasted 2 s and ended at the first sample.
    /// let structure = Structure { output: 0, order: 0.5, terms: vec![Term { signal: 0, order: 0.0 }] };
    /// let (tolerance, max_pulses) = (1e-6, 1 << 14);
    /// let options = Refinement { tolerance, max_pulses, long_record_intervals: 1 << 14, memory: 1 << 30 };
    /// let decay = |t: f64| t.exp() * libm::erfc(t.sqrt());
    /// let y: Vec<f64> = (0..200).map(|k| 0.05 * f64::from(k)).map(|t| decay(t) - decay(t + 2.0)).collect();
    /// let run = Recording::new("run", 0.05, None, vec![Channel::new("y", y.clone(), Role::Output)], vec![0])?;
    /// let plant = vec![Equation::new(structure, vec![-1.0])?];
    /// let simulation = OutputSimulation::new(run.into(), plant, Vec::new(), None)?;
    /// let exponents = [vec![0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0]];
    /// let terms = simulation.fit_past_inputs(&exponents, &[vec![0.0]], false, options, &Stop::default())?;
    /// let terms = InitialTerms::Given(terms.unwrap_or_default());
    /// let fit = simulation.refine(&terms, options, &Stop::default())?.samples;
    /// assert!(fit.outputs[0].iter().zip(&y).all(|(fitted, y)| (fitted - y).abs() < 2e-3));
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn fit_past_inputs(
        &self,
        exponents: &[Vec<f64>],
        exponents_without_prior: &[Vec<f64>],
        has_level: bool,
        options: Refinement,
        stop: &Stop,
    ) -> Result<Option<Terms>> {
        let n = self.equations.len();
        check_length("exponents without a prior", n, exponents_without_prior.len())?;
        let units = self.unit_terms(exponents)?;
        let initial = InitialTerms::UnitResponses { exponents: exponents.to_vec() };
        let responses = self.refine(&initial, options, stop)?.samples.outputs;
        let Some(past) = self.past_responses(options, stop)? else { return Ok(None) };
        if !responses.iter().flatten().all(|v| v.is_finite()) {
            return Ok(None);
        }
        let measured = self.recording.compared_rows(FIRST_REFINEMENT)?;
        let weights: Vec<f64> = measured.iter().map(|row| initial_terms::weight(row)).collect();
        // Weighted samples of all outputs at which an output was measured.
        let weight_rows = |rows: &[Vec<f64>]| -> Vec<f64> {
            let weighted_row = |((row, output), weight)| {
                let measured = std::iter::zip::<&Vec<f64>, &Vec<f64>>(row, output).filter(|(_, y)| !y.is_nan());
                measured.map(move |(v, _): (&f64, &f64)| weight * v)
            };
            rows.iter().zip(&measured).zip(&weights).flat_map(weighted_row).collect()
        };
        let mut blocks = responses.chunks(n);
        let input_response = blocks.next().unwrap_or_default();
        let mut terms_of_columns = units.clone();
        let mut columns: Vec<Vec<f64>> = blocks.map(&weight_rows).collect();
        for i in 0..if has_level { n } else { 0 } {
            terms_of_columns.push((i, f64::INFINITY));
            columns.push(weight_rows(
                &(0..n).map(|j| vec![f64::from(u8::from(i == j)); measured[j].len()]).collect::<Rows>(),
            ));
        }
        let norms: Vec<f64> = columns.iter().map(|column| norm(column)).collect();
        let nonzero_columns: Vec<usize> = (0..terms_of_columns.len()).filter(|&k| norms[k] > 0.0).collect();
        let is_free =
            |(i, exponent): (usize, f64)| exponent.is_infinite() || exponents_without_prior[i].contains(&exponent);
        let terms = WeightedColumns {
            columns: nonzero_columns.iter().map(|&k| columns[k].iter().map(|v| v / norms[k]).collect()).collect(),
            norms: nonzero_columns.iter().map(|&k| norms[k]).collect(),
            columns_without_prior: (0..nonzero_columns.len())
                .filter(|&k| is_free(terms_of_columns[nonzero_columns[k]]))
                .collect(),
        };
        let is_driven = input_response.iter().flatten().any(|v| *v != 0.0);
        let target = weight_rows(&combine(&measured, &input_response.to_vec(), |y, v| y - v));
        let groups = past.iter().map(|octaves| {
            let first_squares =
                |rows: &Rows| rows.iter().zip(&weights).map(|(row, weight)| (weight * row[0]).powi(2)).sum::<f64>();
            (octaves.iter().map(first_squares).sum(), octaves.iter().map(|rows| weight_rows(rows)).collect())
        });
        let values = terms.fit(&target, is_driven.then(|| weight_rows(input_response)), &groups.collect::<Vec<_>>())?;
        let mut fitted_terms = vec![Vec::new(); n];
        for (&k, value) in nonzero_columns.iter().zip(values) {
            fitted_terms[terms_of_columns[k].0].push((terms_of_columns[k].1, value));
        }
        Ok(Some(fitted_terms))
    }

    /// Return the responses `[equation][octave]` to a unit input that acted in this equation during this octave of past
    /// time. Each has one row per output, at the sample times of the simulation. None if a response is not finite.
    fn past_responses(&self, options: Refinement, stop: &Stop) -> Result<Option<Vec<Vec<Rows>>>> {
        let (n, rows) = (self.equations.len(), self.recording.len());
        let past = PAST_LENGTHS * rows;
        let octaves = std::iter::successors(Some(1), |k| Some(2 * k)).take_while(|k| *k < past);
        let octaves: Vec<usize> = std::iter::once(0).chain(octaves).chain([past]).collect();
        let rest = InitialTerms::Given(vec![Vec::new(); n]);
        let mut responses = Vec::with_capacity(n);
        for equation_index in 0..n {
            let simulation = self.unit_step(equation_index, rows + past)?;
            let steps = match simulation.exact_samples(&rest, stop) {
                Ok(None) => simulation.refine(&rest, options, stop).map(|refined| refined.samples.outputs),
                Ok(Some(samples)) => Ok(samples.outputs),
                Err(error) => Err(error),
            };
            let steps = match steps {
                Err(error) if !matches!(error.kind(), Kind::Interrupted | Kind::Internal) => return Ok(None),
                steps => steps?,
            };
            if !steps.iter().flatten().all(|v| v.is_finite()) {
                return Ok(None);
            }
            let shifted_responses: Vec<Rows> =
                octaves.iter().map(|&k| steps.iter().map(|row| self.samples_after(row, k)).collect()).collect();
            responses.push(
                shifted_responses.windows(2).map(|pair| combine(&pair[1], &pair[0], |new, old| new - old)).collect(),
            );
        }
        Ok(Some(responses))
    }

    /// Return uniform samples that are interpolated linearly at the sample times of the simulation plus `shift`
    /// sampling intervals.
    fn samples_after(&self, samples: &[f64], shift: usize) -> Vec<f64> {
        let Some(times) = &self.times else { return samples[shift..shift + self.recording.len()].to_vec() };
        let sample_times: Vec<f64> = (0..samples.len()).map(|k| self.recording.step() * k as f64).collect();
        let shifted_times: Vec<f64> = times.iter().map(|time| time + self.recording.step() * shift as f64).collect();
        shifted_times.iter().map(|time| interpolate(*time, &sample_times, samples)).collect()
    }

    /// Return a simulation from rest with `rows` uniform samples. A unit step is added to the right-hand side of the
    /// equation with index `equation_index`. The inputs of the run are zero.
    fn unit_step(&self, equation_index: usize, rows: usize) -> Result<Self> {
        let outputs = self.recording.outputs();
        let output_index = |signal: usize, i: usize| {
            let output = outputs.iter().position(|output| *output == signal);
            output.filter(|&output| output == i || self.recording.is_coupled)
        };
        let equation = |(i, equation): (usize, &Equation)| {
            let terms_of_outputs = equation.structure.terms.iter().zip(&equation.coefficients);
            let terms_of_outputs = terms_of_outputs
                .filter_map(|(term, c)| output_index(term.signal, i).map(|signal| (Term { signal, ..*term }, *c)));
            let forcing = (i == equation_index).then_some((Term { signal: outputs.len(), order: 0.0 }, 1.0));
            let (terms, coefficients) = terms_of_outputs.chain(forcing).unzip();
            Equation::new(Structure { output: i, order: equation.structure.order, terms }, coefficients)
        };
        let output = |signal: &usize| {
            let channel = &self.recording.channels()[*signal];
            Channel { is_filtered: channel.is_filtered, ..Channel::new(&channel.name, vec![0.0; rows], Role::Output) }
        };
        let forcing = Channel::new("past input", vec![1.0; rows], Role::Input(Intersample::Hold));
        let channels: Vec<Channel> = outputs.iter().map(output).chain([forcing]).collect();
        let filter = self.recording.filter.clone().filter(|_| channels.iter().any(|channel| channel.is_filtered));
        let mut recording =
            Recording::new(self.recording.name(), self.recording.step(), None, channels, (0..outputs.len()).collect())?;
        recording.filter = filter;
        recording.is_coupled = self.recording.is_coupled;
        let equations = self.equations.iter().enumerate().map(equation).collect::<Result<Vec<_>>>()?;
        Self::new(Arc::new(recording), equations, Vec::new(), None)
    }
}

impl WeightedColumns {
    /// Fit all terms to a target, and return their coefficients, one per column. The target is the weighted measured
    /// samples minus the response to the inputs.
    ///
    /// `input_response` are the weighted samples of the response to the inputs, None if it is zero. Each entry of
    /// `groups` belongs to one equation. It holds the sum of squares of the first samples of the octave responses, and
    /// these responses.
    fn fit(&self, target: &[f64], input_response: Option<Vec<f64>>, groups: &[(f64, Rows)]) -> Result<Vec<f64>> {
        let space = decompose(&self.columns)?;
        let free_columns: Rows = self.columns_without_prior.iter().map(|&k| self.columns[k].clone()).collect();
        let basis = if free_columns.is_empty() { Vec::new() } else { significant_vectors(decompose(&free_columns)?).0 };
        let project = |mut column: Vec<f64>| {
            project_out(&basis, &mut column);
            column
        };
        let remainder = project(target.to_vec());
        // If no input changes, only the past moves the output.
        let reference = input_response.map_or_else(|| remainder.clone(), project);
        let mean_square = mean(&reference.iter().map(|v| v * v).collect::<Vec<_>>());
        let (left, values, right) = {
            let right_vectors = space.right.clone();
            let (left, values) = significant_vectors(space);
            let right: Rows = right_vectors.into_iter().take(values.len()).collect();
            (left, values, right)
        };
        // Coefficients of the terms that reproduce the response to each octave.
        let octave_coefficients: Rows = (groups.iter())
            .flat_map(|(first, octaves)| {
                let scale = if *first > 0.0 { (mean_square / first).sqrt() } else { 0.0 };
                octaves.iter().map(move |octave| (scale, octave))
            })
            .map(|(scale, octave)| {
                let weights = left.iter().zip(&values).map(|(u, value)| scale * inner(u, octave) / value);
                linear_combination(&right, &weights.collect::<Vec<_>>(), self.columns.len())
            })
            .collect();
        let octave_responses: Rows = octave_coefficients
            .iter()
            .map(|weights| project(linear_combination(&self.columns, weights, target.len())))
            .collect();
        let mut values = linear_combination(
            &octave_coefficients,
            &posterior_mean(&octave_responses, &remainder)?,
            self.columns.len(),
        );
        let explained = linear_combination(&self.columns, &values, target.len());
        let residuals: Vec<f64> = target.iter().zip(explained).map(|(y, v)| y - v).collect();
        let offsets = minimum_norm_solution(&free_columns, &residuals, MIN_SINGULAR_VALUE_RATIO)
            .ok_or_else(decomposition_error)?;
        self.columns_without_prior.iter().zip(offsets).for_each(|(&k, value)| values[k] += value);
        Ok(values.iter().zip(&self.norms).map(|(value, norm)| value / norm).collect())
    }
}

/// Return the posterior mean of the coefficients in a linear regression of a target on columns, under independent
/// normal priors of equal variance.
///
/// The variance of the prior maximizes the marginal likelihood. The part of the target that the columns do not explain
/// is noise, whose variance is increased for autocorrelation.
fn posterior_mean(columns: &[Vec<f64>], target: &[f64]) -> Result<Vec<f64>> {
    let SingularValues { left, values, right } = decompose(columns)?;
    let projections: Vec<f64> = left.iter().map(|u| inner(u, target)).collect();
    let explained = linear_combination(&left, &projections, target.len());
    let noise: Vec<f64> = target.iter().zip(explained).map(|(y, v)| y - v).collect();
    let variance = mean(&noise.iter().map(|v| v * v).collect::<Vec<_>>()) * variance_inflation(&noise);
    let ratios = |factor_of: &dyn Fn(f64) -> f64| -> Vec<f64> {
        projections.iter().zip(&values).map(|(a, value)| a * factor_of(*value)).collect()
    };
    if variance.is_nan() || variance <= 0.0 {
        let exact = ratios(&|value| if value > 0.0 { 1.0 / value } else { 0.0 });
        return Ok(linear_combination(&right, &exact, columns.len()));
    }
    let power = |scale: f64, value: f64| (scale * value).powi(2);
    let cost = |scale: &f64| -> f64 {
        let terms = projections
            .iter()
            .zip(&values)
            .map(|(a, value)| a * a / (variance + power(*scale, *value)) + (power(*scale, *value) / variance).ln_1p());
        terms.sum()
    };
    let best_scale = PAST_INPUT_SIZES.into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b))).unwrap_or(0.0);
    let means = ratios(&|value| best_scale * best_scale * value / (variance + power(best_scale, value)));
    Ok(linear_combination(&right, &means, columns.len()))
}

/// Return the singular value decomposition of the matrix with these columns.
fn decompose(columns: &[Vec<f64>]) -> Result<SingularValues> {
    singular_values(columns).ok_or_else(decomposition_error)
}

fn decomposition_error() -> Error {
    Error::Internal { what: "singular values of responses to past inputs that do not converge".into() }
}

/// Return the left singular vectors and the singular values, without those at the level of rounding errors.
fn significant_vectors(decomposition: SingularValues) -> (Rows, Vec<f64>) {
    let threshold = MIN_SINGULAR_VALUE_RATIO * decomposition.values.first().copied().unwrap_or(0.0);
    decomposition.left.into_iter().zip(decomposition.values).filter(|(_, value)| *value > threshold).unzip()
}

/// Return the sum of the columns times their coefficients, as a vector of `length` values.
fn linear_combination(columns: &[Vec<f64>], coefficients: &[f64], length: usize) -> Vec<f64> {
    let mut sum = vec![0.0; length];
    columns.iter().zip(coefficients).for_each(|(column, c)| add_multiple(&mut sum, *c, column));
    sum
}
