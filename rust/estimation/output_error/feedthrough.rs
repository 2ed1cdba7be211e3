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
    pub(crate) fn of(
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
        if !terms.iter().flatten().any(|&at_once| at_once) {
            return Ok(None);
        }
        let n = structures.len();
        let mut lacking: Vec<Option<(Vec<f64>, Vec<f64>)>> = vec![None; experiment.record.len()];
        let mut between = vec![0.0; n * n];
        (0..n).for_each(|i| between[i * n + i] = 1.0);
        for (i, (structure, row)) in structures.iter().zip(&terms).enumerate() {
            for (k, term) in structure.terms.iter().enumerate().filter(|(k, _)| row[*k]) {
                if let Some(j) = model.output_index(i, term.signal) {
                    between[i * n + j] -= model.equations[i].terms[k].2.at(&point.coefficients);
                } else if lacking[term.signal].is_none() {
                    lacking[term.signal] = Some(match model.law_of(term.signal) {
                        Some(d) => experiment.input_point_deviation(term.signal, &nonlinearity_outputs[d]),
                        None => (experiment.point_deviation(term.signal), Vec::new()),
                    });
                }
            }
        }
        let coupled = (0..n * n).any(|at| at % (n + 1) != 0 && between[at] != 0.0);
        let between = if coupled { Some(small::inverse(&between, n)?) } else { None };
        let mut direct = Self { coupling_inverse: between, deviations: lacking, terms, values: Vec::new() };
        let mut driven = vec![vec![0.0; experiment.compared_count()]; n];
        direct.add_inputs(model, &mut driven, |i, k| model.equations[i].terms[k].2.at(&point.coefficients), |l| &l.0);
        direct.values = direct.apply_coupling(driven);
        Ok(Some(direct))
    }

    /// Add the deviations δ of the inputs with feedthrough to `driven`, which has one row of samples per equation.
    ///
    /// The function `weight` returns the factor of a term, given the indices of equation and term.
    fn add_inputs<'a>(
        &'a self,
        model: &FreeModel,
        driven: &mut [Vec<f64>],
        weight: impl Fn(usize, usize) -> f64,
        which: impl Fn(&'a (Vec<f64>, Vec<f64>)) -> &'a [f64],
    ) {
        for (i, row) in self.terms.iter().enumerate() {
            for (k, _) in row.iter().enumerate().filter(|&(_, &at_once)| at_once) {
                let signal = model.equations[i].terms[k].0;
                let (c, unknown) = (weight(i, k), model.output_index(i, signal));
                let series = match (unknown, &self.deviations[signal]) {
                    (Some(j), _) if !self.values.is_empty() => &self.values[j],
                    (None, Some(lacking)) => which(lacking),
                    _ => continue,
                };
                if c != 0.0 {
                    driven[i].iter_mut().zip(series).for_each(|(v, s)| *v += c * s);
                }
            }
        }
    }

    /// Multiply `driven`, which has one row of samples per equation, by (I − C)⁻¹.
    pub(crate) fn apply_coupling(&self, driven: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
        let Some(between) = &self.coupling_inverse else { return driven };
        let gains = between.chunks_exact(driven.len());
        let mixed = |gains: &[f64]| {
            let mut out = vec![0.0; driven.first().map_or(0, Vec::len)];
            for (gain, row) in gains.iter().zip(&driven) {
                out.iter_mut().zip(row).for_each(|(v, d)| *v += gain * d);
            }
            out
        };
        gains.map(mixed).collect()
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
    let (orders, numbers) = (point.orders.len(), point.orders.len() + point.coefficients.len());
    if parameter < orders {
        return;
    }
    let mut driven = vec![vec![0.0; experiment.compared_count()]; model.equations.len()];
    if parameter < numbers {
        let slope = |i: usize, k: usize| model.equations[i].terms[k].2.slope(&point.coefficients, parameter - orders);
        direct.add_inputs(model, &mut driven, slope, |l| &l.0);
    } else {
        let acting = model.inputs[parameter - numbers].signal;
        let weight = |i: usize, k: usize| {
            let (signal, _, c) = &model.equations[i].terms[k];
            if *signal == acting {
                c.at(&point.coefficients)
            } else {
                0.0
            }
        };
        direct.add_inputs(model, &mut driven, weight, |l| &l.1);
    }
    column.iter_mut().zip(experiment.weighted_corrections(&direct.apply_coupling(driven))).for_each(|(v, s)| *v += s);
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
    pub(crate) fn of(
        model: &FreeModel,
        experiment: &Experiment,
        nonlinearity_outputs: &[(Vec<f64>, Vec<f64>)],
    ) -> Self {
        let jumps = (0..experiment.record.len())
            .map(|signal| {
                // Nonuniform samples have an exact kink correction instead.
                let instant = experiment.point_values.get(signal).filter(|_| experiment.nonuniform.is_none())?;
                if !instant.is_zero_order_hold {
                    // The kinks of an input after a nonlinearity with a free parameter are unknown.
                    instant.values.as_ref().filter(|_| model.law_of(signal).is_none())?;
                    return Some((experiment.point_deviation(signal).iter().map(|v| -v).collect(), Vec::new()));
                }
                let unchanged = (experiment.record.signal(signal).to_vec(), Vec::new());
                Some(match model.law_of(signal) {
                    Some(d) => experiment.input_point_deviation(signal, &nonlinearity_outputs[d]),
                    None => (
                        experiment.input_point_deviation(signal, &(unchanged.0, vec![0.0; experiment.record.m()])).0,
                        unchanged.1,
                    ),
                })
            })
            .collect();
        Self { jumps }
    }

    /// Gain from each signal to each output within one pulse, minus the direct gain, as a row-major matrix (outputs ×
    /// signals).
    ///
    /// `at_once` flags the terms with direct feedthrough.
    fn gains(
        model: &FreeModel,
        step: f64,
        signals: usize,
        at_once: &[Vec<bool>],
        point: &ParameterPoint,
    ) -> Result<Vec<f64>> {
        let structures = model.structures(&point.orders);
        let n = structures.len();
        let solved = |leading: &dyn Fn(usize, usize) -> f64| -> Result<Vec<f64>> {
            let (mut between, mut driving) = (vec![0.0; n * n], vec![0.0; n * signals]);
            for i in 0..n {
                between[i * n + i] += 1.0;
                for (k, (signal, _, c)) in model.equations[i].terms.iter().enumerate() {
                    let gain = c.at(&point.coefficients) * leading(i, k);
                    match model.output_index(i, *signal) {
                        Some(j) => between[i * n + j] -= gain,
                        None => driving[i * signals + signal] += gain,
                    }
                }
            }
            let inverse = small::inverse(&between, n)?;
            let entry = |i: usize, s: usize| (0..n).map(|j| inverse[i * n + j] * driving[j * signals + s]).sum::<f64>();
            Ok((0..n * signals).map(|at| entry(at / signals, at % signals)).collect())
        };
        let first_gains = solved(&|i, k| first_coefficient(structures[i].order - structures[i].terms[k].order, step))?;
        let direct = solved(&|i, k| f64::from(u8::from(at_once[i][k])))?;
        Ok(first_gains.iter().zip(direct).map(|(first, direct)| first - direct).collect())
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
        let (signals, compared) = (self.jumps.len(), experiment.compared_count());
        for (i, row) in samples.chunks_exact_mut(compared.max(1)).enumerate() {
            if experiment.filter.as_ref().is_some_and(|(_, applies)| applies[i]) {
                continue;
            }
            for (signal, jump) in self.jumps.iter().enumerate() {
                let gain = gains[i * signals + signal];
                let Some(jump) = jump.as_ref().filter(|_| gain != 0.0) else { continue };
                let half = if slopes { &jump.1 } else { &jump.0 };
                let weights = experiment.weights_of(i);
                row.iter_mut().zip(half).zip(weights).for_each(|((v, j), w)| *v -= w * gain * j);
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
        let at_once = Self::feedthrough_terms(model, point);
        let gains = Self::gains(model, experiment.record.step(), self.jumps.len(), &at_once, point)?;
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
        let at_once = Self::feedthrough_terms(model, point);
        let (orders, numbers) = (point.orders.len(), point.orders.len() + point.coefficients.len());
        let gains =
            |point: &ParameterPoint| Self::gains(model, experiment.record.step(), self.jumps.len(), &at_once, point);
        if parameter >= numbers {
            let acting = model.inputs[parameter - numbers].signal;
            let mut gains = gains(point)?;
            gains.iter_mut().enumerate().filter(|(at, _)| at % self.jumps.len() != acting).for_each(|(_, g)| *g = 0.0);
            self.add(experiment, &gains, true, column);
            return Ok(());
        }
        let (mut up, mut down) = (point.clone(), point.clone());
        let shift = |point: &mut ParameterPoint, sign: f64| {
            let value = match parameter.checked_sub(orders) {
                None => &mut point.orders[parameter],
                Some(c) => &mut point.coefficients[c],
            };
            let by = sign
                * RELATIVE_DIFFERENCE_STEP
                * if parameter < orders { 1.0 } else { value.abs().max(RELATIVE_DIFFERENCE_STEP) };
            *value += by;
            by
        };
        let width = shift(&mut up, 1.0) - shift(&mut down, -1.0);
        let slopes: Vec<f64> = gains(&up)?.iter().zip(gains(&down)?).map(|(u, d)| (u - d) / width).collect();
        self.add(experiment, &slopes, false, column);
        Ok(())
    }
}
