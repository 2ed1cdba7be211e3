//! Kink correction: slope discontinuities of the output near input jumps, at nonuniform sample times.
//!
//! Block-pulse means smooth out the kinks after jumps of zero-order-hold inputs. The leading kinks of an output come
//! from the input terms of its equation. In these terms, a signal is integrated with the order α − ν. α is the order of
//! the equation, and ν that of the term. Further kinks arise when these terms pass once through the autoregressive
//! terms. After several passes the response is smoother, and the error of its pulse means decreases with the step.

use std::cell::OnceCell;
use std::rc::Rc;

use super::experiment::Experiment;
use super::feedthrough::{Feedthrough, FEEDTHROUGH_ORDER_TOLERANCE};
use super::parameterization::{FreeModel, ParameterPoint};
use crate::equation::Structure;

/// Step in an order of the central difference, whose error is 1e−10.
const ORDER_DIFFERENCE_STEP: f64 = 1e-5;

/// Integration order from which block pulses represent a kink accurately.
const SMOOTH_INTEGRATION_ORDER: f64 = 2.0;

/// Most recently used kink of each input term and of each pass through an autoregressive term.
#[derive(Default)]
pub(crate) struct KinkCache(Vec<Rc<Kink>>);

impl KinkCache {
    /// Return the kink of the given terms of an equation at an integration order. `compute` computes it if the order
    /// differs from that of the last evaluation.
    fn kink(
        &mut self,
        equation: usize,
        terms: Vec<usize>,
        integration_order: f64,
        compute: impl FnOnce(Vec<usize>) -> Kink,
    ) -> Rc<Kink> {
        let has_terms = |kink: &Rc<Kink>| kink.equation == equation && kink.terms == terms;
        let is_current = |kink: &&Rc<Kink>| kink.integration_order.to_bits() == integration_order.to_bits();
        if let Some(kink) = self.0.iter().find(|kink| has_terms(kink)).filter(is_current) {
            return kink.clone();
        }
        self.0.retain(|kink| !has_terms(kink));
        let kink = Rc::new(compute(terms));
        self.0.push(kink.clone());
        kink
    }
}

/// Kink of one input term, either alone or after one pass through an autoregressive term.
struct Kink {
    /// Index of the equation.
    equation: usize,
    /// Indices of the input term and, if there is one, of the autoregressive term.
    terms: Vec<usize>,
    /// Index of the input signal.
    signal: usize,
    /// Integration order of the input.
    integration_order: f64,
    /// Correction of the compared samples for coefficients of 1.
    values: Vec<f64>,
    /// Derivative of the correction `values` with respect to the integration order; computed when first needed.
    slopes: OnceCell<Vec<f64>>,
}

impl Kink {
    /// Return the corrections of the samples for the integration order `order` of the input `signal`; empty if the
    /// signal has no jumps.
    fn corrections(experiment: &Experiment, signal: usize, order: f64) -> Vec<f64> {
        let samples = experiment.nonuniform.as_ref();
        let samples_and_jumps = samples.and_then(|n| Some((n, n.jumps.get(signal)?.as_ref()?)));
        samples_and_jumps.map_or_else(Vec::new, |(n, jumps)| {
            n.interpolation.kink_corrections(jumps, order, experiment.record.step())
        })
    }

    /// Return the derivative of the correction with respect to the integration order.
    fn slopes(&self, experiment: &Experiment) -> &[f64] {
        self.slopes.get_or_init(|| {
            let shift = ORDER_DIFFERENCE_STEP.min(0.5 * self.integration_order);
            let shifted = |shift| Self::corrections(experiment, self.signal, self.integration_order + shift);
            shifted(shift).iter().zip(shifted(-shift)).map(|(upper, lower)| (upper - lower) / (2.0 * shift)).collect()
        })
    }
}

/// Kink correction of one experiment.
pub(crate) struct KinkCorrection {
    kinks: Vec<Rc<Kink>>,
}

impl KinkCorrection {
    /// Return the kinks of the outputs due to the steps of zero-order-hold inputs; None for uniform samples.
    ///
    /// Kinks whose integration orders have not changed since the last evaluation are taken from the cache.
    pub(crate) fn new(
        model: &FreeModel,
        experiment: &Experiment,
        structures: &[Structure],
        cache: &mut KinkCache,
    ) -> Option<Self> {
        let jumps = &experiment.nonuniform.as_ref()?.jumps;
        let mut kinks = Vec::new();
        for (equation, structure) in structures.iter().enumerate() {
            let integration_order = |term: usize| structure.order - structure.terms[term].order;
            let autoregressive_terms: Vec<usize> = (0..structure.terms.len())
                .filter(|&k| model.output_index(equation, structure.terms[k].signal) == Some(equation))
                .collect();
            for (term, input_term) in structure.terms.iter().enumerate() {
                let signal = input_term.signal;
                let has_jumps = matches!(jumps.get(signal), Some(Some(_)));
                if !has_jumps || model.output_index(equation, signal).is_some() {
                    continue;
                }
                for terms in std::iter::once(vec![term]).chain(autoregressive_terms.iter().map(|&k| vec![term, k])) {
                    let eta: f64 = terms.iter().map(|&k| integration_order(k)).sum();
                    // Direct feedthrough has its own correction.
                    if eta < FEEDTHROUGH_ORDER_TOLERANCE || (terms.len() > 1 && eta >= SMOOTH_INTEGRATION_ORDER) {
                        continue;
                    }
                    kinks.push(cache.kink(equation, terms, eta, |terms| Kink {
                        equation,
                        terms,
                        signal,
                        integration_order: eta,
                        values: Kink::corrections(experiment, signal, eta),
                        slopes: OnceCell::new(),
                    }));
                }
            }
        }
        Some(Self { kinks })
    }

    /// Correction of the weighted samples for an initial term t^e with e = `exponent`; 0 for uniform samples.
    pub(crate) fn initial_term_correction(experiment: &Experiment, equation: usize, exponent: f64) -> Vec<f64> {
        let mut rows = vec![vec![0.0; experiment.compared_count()]; experiment.samples.len()];
        if let Some(nonuniform) = experiment.nonuniform.as_ref().filter(|_| exponent.fract() != 0.0) {
            let start = nonuniform.interpolation.jumps(&[0.0], &[libm::tgamma(exponent + 1.0)]);
            rows[equation] = nonuniform.interpolation.kink_corrections(&start, exponent, experiment.record.step());
        }
        experiment.weighted_corrections(&rows)
    }

    /// Return the weighted sum of the corrections of all kinks, with all outputs concatenated.
    ///
    /// `weights` returns the factors of the values and of the derivatives of a kink.
    fn weighted_sum(
        &self,
        model: &FreeModel,
        experiment: &Experiment,
        direct: Option<&Feedthrough>,
        weights: impl Fn(&Kink) -> (f64, f64),
    ) -> Vec<f64> {
        let mut corrections = vec![vec![0.0; experiment.compared_count()]; model.equations.len()];
        for kink in &self.kinks {
            let (value, slope) = weights(kink);
            let correction = &mut corrections[kink.equation];
            correction.iter_mut().zip(&kink.values).for_each(|(v, c)| *v += value * c);
            if slope != 0.0 {
                correction.iter_mut().zip(kink.slopes(experiment)).for_each(|(v, s)| *v += slope * s);
            }
        }
        experiment.weighted_corrections(&match direct {
            Some(direct) => direct.apply_coupling(corrections),
            None => corrections,
        })
    }

    /// Kink correction of the weighted samples of one experiment, with all outputs concatenated.
    pub(crate) fn weighted_correction(
        &self,
        model: &FreeModel,
        experiment: &Experiment,
        point: &ParameterPoint,
        direct: Option<&Feedthrough>,
    ) -> Vec<f64> {
        let weight = |c: &Kink| {
            let terms = &model.equations[c.equation].terms;
            (c.terms.iter().map(|&k| terms[k].2.at(&point.coefficients)).product(), 0.0)
        };
        self.weighted_sum(model, experiment, direct, weight)
    }

    /// Add the derivative of the correction with respect to a parameter to `column`, at constant feedthrough gains.
    pub(crate) fn add_slope(
        &self,
        model: &FreeModel,
        experiment: &Experiment,
        direct: Option<&Feedthrough>,
        point: &ParameterPoint,
        parameter: usize,
        column: &mut [f64],
    ) {
        let weight = |c: &Kink| {
            let equation = &model.equations[c.equation];
            let value = |k: usize| equation.terms[k].2.at(&point.coefficients);
            match parameter.checked_sub(point.orders.len()) {
                None => {
                    let order_weight = |weights: &[f64]| weights.get(parameter).copied().unwrap_or(0.0);
                    let exponent_slope =
                        |k: &usize| order_weight(&equation.order.weights) - order_weight(&equation.terms[*k].1.weights);
                    let product: f64 = c.terms.iter().map(|&k| value(k)).product();
                    (0.0, product * c.terms.iter().map(exponent_slope).sum::<f64>())
                }
                Some(j) => {
                    let term_slope = |k: usize| equation.terms[k].2.slope(&point.coefficients, j);
                    let other_factors =
                        |k: usize| c.terms.iter().filter(|&&l| l != k).map(|&l| value(l)).product::<f64>();
                    (c.terms.iter().map(|&k| term_slope(k) * other_factors(k)).sum(), 0.0)
                }
            }
        };
        let slopes = self.weighted_sum(model, experiment, direct, weight);
        column.iter_mut().zip(slopes).for_each(|(v, m)| *v += m);
    }
}
