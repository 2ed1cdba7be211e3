//! Direct feedthrough: the instantaneous effect of a term whose order equals the order of its equation.
//!
//! A sample is taken just after its input changes: y(t⁺) = y'(t) + G s(t⁺). Here y' is the output without feedthrough,
//! s the input and G the gain of the feedthrough. The mean of y over the two pulses next to t contains G times the mean
//! of s over these pulses. The correction is G δ, where δ is s(t⁺) minus that mean of s. For a zero-order hold, δ is
//! half a jump. For a linearly interpolated signal, it is a quarter of the second difference.

use super::experiment::Experiment;
use super::parameterization::{FreeModel, ParameterPoint};
use crate::equation::Structure;
use crate::error::Result;
use crate::fractional::kernels::first_coefficient;
use crate::linalg::small;

/// Difference between the orders of term and equation below which the term has direct feedthrough.
pub(crate) const FEEDTHROUGH_ORDER_TOLERANCE: f64 = 1e-9;

/// Direct feedthrough of one experiment.
pub(crate) struct Feedthrough {
    /// (I − C)⁻¹ with the feedthrough gains C between outputs, row-major; None without such gains.
    coupling_inverse: Option<Vec<f64>>,
    /// Deviation δ of each input with feedthrough at the compared samples, and the derivative of δ.
    ///
    /// δ is the value just after a sample time minus the mean of the two adjacent pulses. The derivative is that with
    /// respect to the free parameter of the input.
    deviations: Vec<Option<(Vec<f64>, Vec<f64>)>>,
    /// True for each term with feedthrough, by equation.
    terms: Vec<Vec<bool>>,
    /// (I − C)⁻¹ B δ by output and sample, unweighted.
    ///
    /// δ contains the deviations of the inputs, B the feedthrough gains from inputs to outputs, and C those between
    /// outputs.
    values: Vec<Vec<f64>>,
}

impl Feedthrough {
    /// Return the feedthrough at a point; None if no term has feedthrough.
    ///
    /// # Errors
    /// [`crate::error::Error::LeadingZero`] if the algebraic loop between the outputs is singular.
    pub(crate) fn new(
        model: &FreeModel,
        experiment: &Experiment,
        structures: &[Structure],
        point: &ParameterPoint,
        nonlinearity_outputs: &[(Vec<f64>, Vec<f64>)],
    ) -> Result<Option<Self>> {
        let terms: Vec<Vec<bool>> = structures
            .iter()
            .map(|s| s.terms.iter().map(|term| (s.order - term.order).abs() < FEEDTHROUGH_ORDER_TOLERANCE).collect())
            .collect();
        if !terms.iter().flatten().any(|&has_feedthrough| has_feedthrough) {
            return Ok(None);
        }
        let n = structures.len();
        let mut deviations: Vec<Option<(Vec<f64>, Vec<f64>)>> = vec![None; experiment.record.len()];
        let mut coupling = vec![0.0; n * n];
        (0..n).for_each(|i| coupling[i * n + i] = 1.0);
        for (i, (structure, row)) in structures.iter().zip(&terms).enumerate() {
            for (k, term) in structure.terms.iter().enumerate().filter(|(k, _)| row[*k]) {
                if let Some(j) = model.output_index(i, term.signal) {
                    coupling[i * n + j] -= model.equations[i].terms[k].2.at(&point.coefficients);
                } else if deviations[term.signal].is_none() {
                    deviations[term.signal] = Some(match model.law_of(term.signal) {
                        Some(d) => experiment.input_point_deviation(term.signal, &nonlinearity_outputs[d]),
                        None => (experiment.point_deviation(term.signal), Vec::new()),
                    });
                }
            }
        }
        let is_coupled = (0..n * n).any(|at| at % (n + 1) != 0 && coupling[at] != 0.0);
        let coupling_inverse = if is_coupled { Some(small::inverse(&coupling, n)?) } else { None };
        let mut direct = Self { coupling_inverse, deviations, terms, values: Vec::new() };
        let mut corrections = vec![vec![0.0; experiment.compared_count()]; n];
        direct.add_inputs(
            model,
            &mut corrections,
            |i, k| model.equations[i].terms[k].2.at(&point.coefficients),
            |l| &l.0,
        );
        direct.values = direct.apply_coupling(corrections);
        Ok(Some(direct))
    }

    /// Add the deviations δ of the inputs with feedthrough to `corrections`, which has one row of samples per equation.
    ///
    /// The function `weight` returns the factor of a term, given the indices of equation and term.
    fn add_inputs<'a>(
        &'a self,
        model: &FreeModel,
        corrections: &mut [Vec<f64>],
        weight: impl Fn(usize, usize) -> f64,
        select: impl Fn(&'a (Vec<f64>, Vec<f64>)) -> &'a [f64],
    ) {
        for (i, row) in self.terms.iter().enumerate() {
            for (k, _) in row.iter().enumerate().filter(|&(_, &has_feedthrough)| has_feedthrough) {
                let signal = model.equations[i].terms[k].0;
                let (c, output) = (weight(i, k), model.output_index(i, signal));
                let series = match (output, &self.deviations[signal]) {
                    (Some(j), _) if !self.values.is_empty() => &self.values[j],
                    (None, Some(deviation)) => select(deviation),
                    _ => continue,
                };
                if c != 0.0 {
                    corrections[i].iter_mut().zip(series).for_each(|(v, s)| *v += c * s);
                }
            }
        }
    }

    /// Multiply `corrections`, which has one row of samples per equation, by (I − C)⁻¹.
    pub(crate) fn apply_coupling(&self, corrections: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
        let Some(coupling_inverse) = &self.coupling_inverse else { return corrections };
        let gains = coupling_inverse.chunks_exact(corrections.len());
        let coupled_row = |gains: &[f64]| {
            let mut out = vec![0.0; corrections.first().map_or(0, Vec::len)];
            for (gain, row) in gains.iter().zip(&corrections) {
                out.iter_mut().zip(row).for_each(|(v, d)| *v += gain * d);
            }
            out
        };
        gains.map(coupled_row).collect()
    }

    /// The weighted correction of the compared samples, with all outputs concatenated.
    pub(crate) fn weighted_correction(&self, experiment: &Experiment) -> Vec<f64> {
        experiment.weighted_corrections(&self.values)
    }
}

/// Add the derivative of the feedthrough to `column`, the derivative of the weighted samples.
///
/// Both are derivatives with respect to `parameter`.
pub(crate) fn add_feedthrough_derivative(
    model: &FreeModel,
    experiment: &Experiment,
    direct: &Feedthrough,
    point: &ParameterPoint,
    parameter: usize,
    column: &mut [f64],
) {
    let (orders, first_input) = (point.orders.len(), point.orders.len() + point.coefficients.len());
    if parameter < orders {
        return;
    }
    let mut corrections = vec![vec![0.0; experiment.compared_count()]; model.equations.len()];
    if parameter < first_input {
        let slope = |i: usize, k: usize| model.equations[i].terms[k].2.slope(&point.coefficients, parameter - orders);
        direct.add_inputs(model, &mut corrections, slope, |l| &l.0);
    } else {
        let input_signal = model.inputs[parameter - first_input].signal;
        let weight = |i: usize, k: usize| {
            let (signal, _, c) = &model.equations[i].terms[k];
            if *signal == input_signal {
                c.at(&point.coefficients)
            } else {
                0.0
            }
        };
        direct.add_inputs(model, &mut corrections, weight, |l| &l.1);
    }
    column
        .iter_mut()
        .zip(experiment.weighted_corrections(&direct.apply_coupling(corrections)))
        .for_each(|(v, s)| *v += s);
}

/// Correction of the simulated samples for jumps and slope discontinuities of the inputs.
///
/// In pulse means, the response to a jump is half a pulse early. The mean of the two pulses next to a sample contains
/// half of the response to the pulse that follows the sample. At the sample itself, only the direct gain of this
/// response is present. Without the correction, a first-order equation has an error proportional to the step. With an
/// input derivative of order 0.6, the error is proportional to step^0.4.
pub(crate) struct JumpCorrection {
    /// Per signal: half of the change of the next pulse mean due to a jump or kink, at each compared sample.
    ///
    /// The second list is the derivative with respect to the free parameter of the input.
    jumps: Vec<Option<(Vec<f64>, Vec<f64>)>>,
}

/// Relative step of the central differences that approximate derivatives of the gains. Their error is 1e−10.
const RELATIVE_DIFFERENCE_STEP: f64 = 1e-5;

impl JumpCorrection {
    /// Return the jumps of zero-order-hold signals, and the kinks of linearly interpolated ones.
    pub(crate) fn new(
        model: &FreeModel,
        experiment: &Experiment,
        nonlinearity_outputs: &[(Vec<f64>, Vec<f64>)],
    ) -> Self {
        let jumps = (0..experiment.record.len())
            .map(|signal| {
                // Nonuniform samples have an exact kink correction instead.
                let point_values = experiment.point_values.get(signal).filter(|_| experiment.nonuniform.is_none())?;
                if !point_values.is_zero_order_hold {
                    // The kinks of an input after a nonlinearity with a free parameter are unknown.
                    point_values.values.as_ref().filter(|_| model.law_of(signal).is_none())?;
                    return Some((experiment.point_deviation(signal).iter().map(|v| -v).collect(), Vec::new()));
                }
                let means_and_slope = (experiment.record.signal(signal).to_vec(), Vec::new());
                Some(match model.law_of(signal) {
                    Some(d) => experiment.input_point_deviation(signal, &nonlinearity_outputs[d]),
                    None => (
                        experiment
                            .input_point_deviation(signal, &(means_and_slope.0, vec![0.0; experiment.record.m()]))
                            .0,
                        means_and_slope.1,
                    ),
                })
            })
            .collect();
        Self { jumps }
    }

    /// Gain from each signal to each output within one pulse, minus the direct gain, as a row-major matrix (outputs ×
    /// signals).
    ///
    /// `feedthrough_terms` flags the terms with direct feedthrough.
    fn gains(
        model: &FreeModel,
        step: f64,
        signals: usize,
        feedthrough_terms: &[Vec<bool>],
        point: &ParameterPoint,
    ) -> Result<Vec<f64>> {
        let structures = model.structures(&point.orders);
        let n = structures.len();
        let solve_gains = |leading_gain: &dyn Fn(usize, usize) -> f64| -> Result<Vec<f64>> {
            let (mut coupling, mut input_gains) = (vec![0.0; n * n], vec![0.0; n * signals]);
            for i in 0..n {
                coupling[i * n + i] += 1.0;
                for (k, (signal, _, c)) in model.equations[i].terms.iter().enumerate() {
                    let gain = c.at(&point.coefficients) * leading_gain(i, k);
                    match model.output_index(i, *signal) {
                        Some(j) => coupling[i * n + j] -= gain,
                        None => input_gains[i * signals + signal] += gain,
                    }
                }
            }
            let inverse = small::inverse(&coupling, n)?;
            let entry =
                |i: usize, s: usize| (0..n).map(|j| inverse[i * n + j] * input_gains[j * signals + s]).sum::<f64>();
            Ok((0..n * signals).map(|at| entry(at / signals, at % signals)).collect())
        };
        let first_gains =
            solve_gains(&|i, k| first_coefficient(structures[i].order - structures[i].terms[k].order, step))?;
        let direct = solve_gains(&|i, k| f64::from(u8::from(feedthrough_terms[i][k])))?;
        Ok(first_gains.iter().zip(direct).map(|(first_gain, direct)| first_gain - direct).collect())
    }

    fn feedthrough_terms(model: &FreeModel, point: &ParameterPoint) -> Vec<Vec<bool>> {
        let structures = model.structures(&point.orders);
        let feedthrough = |s: &Structure| {
            s.terms.iter().map(|term| (s.order - term.order).abs() < FEEDTHROUGH_ORDER_TOLERANCE).collect()
        };
        structures.iter().map(feedthrough).collect()
    }

    /// Subtract the correction for jumps and kinks from weighted samples: the given gains times the entries of `jumps`.
    ///
    /// If `slopes` is true, the derivatives of these entries are used instead.
    fn add(&self, experiment: &Experiment, gains: &[f64], slopes: bool, samples: &mut [f64]) {
        let (signals, compared_count) = (self.jumps.len(), experiment.compared_count());
        for (i, row) in samples.chunks_exact_mut(compared_count.max(1)).enumerate() {
            if experiment.filter.as_ref().is_some_and(|(_, applies)| applies[i]) {
                continue;
            }
            for (signal, jump) in self.jumps.iter().enumerate() {
                let gain = gains[i * signals + signal];
                let Some(jump) = jump.as_ref().filter(|_| gain != 0.0) else { continue };
                let values = if slopes { &jump.1 } else { &jump.0 };
                let weights = experiment.weights_of(i);
                row.iter_mut().zip(values).zip(weights).for_each(|((v, j), w)| *v -= w * gain * j);
            }
        }
    }

    /// Correct the weighted samples of all outputs in place.
    ///
    /// # Errors
    /// [`crate::error::Error::LeadingZero`] if the scheme is singular.
    pub(crate) fn correct(
        &self,
        model: &FreeModel,
        experiment: &Experiment,
        point: &ParameterPoint,
        samples: &mut [f64],
    ) -> Result<()> {
        if self.jumps.iter().all(Option::is_none) {
            return Ok(());
        }
        let feedthrough_terms = Self::feedthrough_terms(model, point);
        let gains = Self::gains(model, experiment.record.step(), self.jumps.len(), &feedthrough_terms, point)?;
        self.add(experiment, &gains, false, samples);
        Ok(())
    }

    /// Correct the derivative of the weighted samples with respect to a parameter in place.
    ///
    /// # Errors
    /// [`crate::error::Error::LeadingZero`] if the scheme is singular ([`JumpCorrection::correct`]).
    pub(crate) fn correct_slope(
        &self,
        model: &FreeModel,
        experiment: &Experiment,
        point: &ParameterPoint,
        parameter: usize,
        column: &mut [f64],
    ) -> Result<()> {
        if self.jumps.iter().all(Option::is_none) {
            return Ok(());
        }
        let feedthrough_terms = Self::feedthrough_terms(model, point);
        let (orders, first_input) = (point.orders.len(), point.orders.len() + point.coefficients.len());
        let gains = |point: &ParameterPoint| {
            Self::gains(model, experiment.record.step(), self.jumps.len(), &feedthrough_terms, point)
        };
        if parameter >= first_input {
            let input_signal = model.inputs[parameter - first_input].signal;
            let mut gains = gains(point)?;
            gains
                .iter_mut()
                .enumerate()
                .filter(|(at, _)| at % self.jumps.len() != input_signal)
                .for_each(|(_, g)| *g = 0.0);
            self.add(experiment, &gains, true, column);
            return Ok(());
        }
        let (mut upper, mut lower) = (point.clone(), point.clone());
        let shift = |point: &mut ParameterPoint, sign: f64| {
            let value = match parameter.checked_sub(orders) {
                None => &mut point.orders[parameter],
                Some(c) => &mut point.coefficients[c],
            };
            let difference = sign
                * RELATIVE_DIFFERENCE_STEP
                * if parameter < orders { 1.0 } else { value.abs().max(RELATIVE_DIFFERENCE_STEP) };
            *value += difference;
            difference
        };
        let width = shift(&mut upper, 1.0) - shift(&mut lower, -1.0);
        let slopes: Vec<f64> = gains(&upper)?.iter().zip(gains(&lower)?).map(|(u, d)| (u - d) / width).collect();
        self.add(experiment, &slopes, false, column);
        Ok(())
    }
}
