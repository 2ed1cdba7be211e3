//! Multi-innovation recursion, eq. (44) of the paper, sample by sample, with constant time per sample.
//!
//! A new row requires the fractional integrals of every signal at the newest pulse, which depend on all past samples.
//! The newest two pulses enter by the exact kernel, eq. (32) of the paper. Older pulses enter through a sum of
//! exponentials, which is accurate to rounding error. An integral of an order η above 1 is computed as the running
//! integral of an integral of order η − 1. A row costs O((signals + terms)·rates + k³) for k coefficients. The cost
//! depends neither on the innovation length nor on the length of the run. Earlier rows may be forgotten exponentially.
//! A stream with nonzero initial conditions has powers of time as additional terms.

use crate::equation::{Initial, Structure};
use crate::error::{check_finite, check_length, check_step, Error, Result};
use crate::estimation::multi_innovation::{Innovation, Prior, RowBasis};
use crate::fractional::exponential_sum::{decay, Rates};
use crate::fractional::kernels::{block_pulse_kernel, PowerMeans};
use crate::linalg::small::{Recursion, SlidingGram};
use crate::simd::{self, dot};

/// Relative accuracy of the sum of exponentials. It equals the rounding error of a computation on the whole record.
const MEMORY_TOLERANCE: f64 = 2e-15;

/// History of one signal: exponential states of all pulses except the newest two, and the mean of the last pulse.
#[derive(Debug, Clone)]
struct SignalHistory {
    states: Vec<f64>,
    last: f64,
}

/// Weights with which the pulse means enter the mean of an integral over the newest pulse, for an order of at most 1.
///
/// For a higher order, the weighted sum is added to a running sum ([`RunningIntegral`]).
#[derive(Debug, Clone)]
struct PulseWeights {
    /// Weights of the newest pulse and of the previous one.
    recent: [f64; 2],
    /// Weights of the exponential states of older pulses.
    history: Vec<f64>,
}

impl PulseWeights {
    #[inline(always)]
    fn apply(&self, newest: f64, history: &SignalHistory) -> f64 {
        self.recent[0] * newest
            + self.recent[1] * history.last
            + dot(&self.history, &history.states[..self.history.len()])
    }
}

/// Running integral I^η of one signal at the newest pulse.
#[derive(Debug, Clone)]
struct RunningIntegral {
    signal: usize,
    local: PulseWeights,
    /// Weights of the integral of order η − 1, and the running sum of that integral; None for η ≤ 1.
    inner: Option<(PulseWeights, f64)>,
    step: f64,
}

impl RunningIntegral {
    fn new(signal: usize, eta: f64, step: f64, rates: &Rates) -> Result<Self> {
        // The sum of orders may exceed 2 by rounding alone.
        let eta = if (eta - 2.0).abs() < 1e-9 { 2.0 } else { eta };
        if eta == 0.0 {
            let local = PulseWeights { recent: [1.0, 0.0], history: Vec::new() };
            return Ok(Self { signal, local, inner: None, step });
        }
        if !(eta > 0.0 && eta <= 2.0) {
            return Err(Error::OutOfRange {
                name: "order of an integral in a stream".into(),
                value: eta,
                range: "[0, 2]".into(),
                remedy: "identify an equation with this term from the recorded run instead".into(),
            });
        }
        let history = |q: f64, weight: fn((f64, f64, f64), f64) -> f64| -> Vec<f64> {
            let decays = rates.rates().iter().map(|rate| decay(rate * step));
            rates.weights(q).iter().zip(decays).map(|(w, parts)| w * parts.0 * weight(parts, step)).collect()
        };
        let kernel = |eta: f64| {
            let kernel = block_pulse_kernel(eta, 2, step);
            [kernel[0], kernel[1]]
        };
        let means =
            |q: f64| PulseWeights { recent: kernel(q), history: history(q, |(_, first, last), _| first + last) };
        if eta <= 1.0 {
            return Ok(Self { signal, local: means(eta), inner: None, step });
        }
        let mut recent = kernel(eta);
        // The running sum already contains the contribution of the last pulse at its end.
        recent[1] -= libm::pow(step, eta) / libm::tgamma(eta + 1.0);
        let local = PulseWeights { recent, history: history(eta - 1.0, |(_, _, last), step| step * last) };
        Ok(Self { signal, local, inner: Some((means(eta - 1.0), 0.0)), step })
    }

    /// Advance by one pulse and return the mean of the integral over the newest pulse.
    #[inline(always)]
    fn next(&mut self, newest: f64, history: &SignalHistory) -> f64 {
        let local = self.local.apply(newest, history);
        match &mut self.inner {
            None => local,
            Some((inner, sum)) => {
                let value = *sum + local;
                *sum += self.step * inner.apply(newest, history);
                value
            }
        }
    }
}

/// Regression column of an initial term t^e, integrated with the order by which the whole equation is integrated.
#[derive(Debug, Clone)]
struct InitialColumn {
    means: PowerMeans,
    scale: f64,
}

/// Recursion of one equation in a stream.
#[derive(Debug, Clone)]
struct EquationRecursion {
    output: usize,
    /// Integral of the output. Its order is 0, unless a term has a higher order than the equation.
    target: RunningIntegral,
    integrals: Vec<RunningIntegral>,
    initial: Vec<InitialColumn>,
    fixed: Vec<Option<f64>>,
    recursion: Recursion,
    /// Gram matrix of the p newest rows, where p is the innovation length.
    window: SlidingGram,
    /// Fractional integrals at the newest pulse: of the output, then of the signal of each term.
    values: Vec<f64>,
    /// Newest row of regressors: those of the free terms, then those of the initial terms.
    row: Vec<f64>,
}

/// Options of a recursion on a stream of samples.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamingOptions {
    /// Innovation length p ≥ 1: number of newest rows in each step.
    pub length: usize,
    /// Prior covariance. A relative prior uses the sums of squares of the rows so far.
    pub prior: Prior,
    /// Forgetting factor in (0, 1] by which the information of all earlier rows is multiplied at every row.
    pub forgetting: f64,
    /// Initial conditions of the stream. Exponents of t must be above −1.
    pub initial: Initial,
}

impl Default for StreamingOptions {
    fn default() -> Self {
        Self { length: 7, prior: Prior::WEAK, forgetting: 1.0, initial: Initial::Rest }
    }
}

impl StreamingOptions {
    fn check(&self) -> Result<()> {
        Innovation { length: self.length, prior: self.prior, row_basis: RowBasis::Time }.check()?;
        self.initial.check()?;
        if self.forgetting > 0.0 && self.forgetting <= 1.0 {
            return Ok(());
        }
        Err(Error::OutOfRange {
            name: "forgetting factor".into(),
            value: self.forgetting,
            range: "(0, 1]".into(),
            remedy: "use 1 for no forgetting".into(),
        })
    }
}

/// Multi-innovation recursion, eq. (44) of the paper, of several equations on one stream of samples.
#[derive(Debug, Clone)]
pub struct Streaming {
    inputs: Vec<bool>,
    decay_factors: Vec<f64>,
    pulse_weights: Vec<f64>,
    histories: Vec<SignalHistory>,
    fits: Vec<EquationRecursion>,
    /// Last sample of every signal; empty before the first one.
    sample: Vec<f64>,
    means: Vec<f64>,
    options: StreamingOptions,
    pulses: usize,
    max_pulses: usize,
}

impl Streaming {
    /// Return a recursion on samples with the interval `step` \[s\], for at most `max_pulses` pulses.
    ///
    /// `inputs` flags the zero-order-hold inputs. The other signals are outputs. `equations` holds the structure of
    /// each equation, and one entry per term: the value of a fixed coefficient, or None for a free one.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for an invalid step, option or integration order. [`Error::Length`] if an equation does
    /// not have one such entry per term. [`Error::NotFinite`] if a fixed coefficient is not finite.
    /// [`Error::Structure`] for an unknown signal.
    ///
    /// ```
    /// # fn main() -> ftlm::error::Result<()> {
    /// use ftlm::equation::{Structure, Term};
    /// use ftlm::estimation::streaming::{Streaming, StreamingOptions};
    /// // y = c I^1 u, sampled every 0.1 s.
    /// let structure = Structure { output: 0, order: 1.0, terms: vec![Term { signal: 1, order: 0.0 }] };
    /// let mut stream = Streaming::new(0.1, 50, &[false, true], &[(structure, vec![None])], StreamingOptions::default())?;
    /// (0..50).try_for_each(|k| stream.push(&[0.3 * f64::from(k), 1.0]))?;
    /// assert!((stream.coefficients()[0][0] - 3.0).abs() < 1e-3);
    /// # Ok(())
    /// # }
    /// ```
    pub fn new(
        step: f64,
        max_pulses: usize,
        inputs: &[bool],
        equations: &[(Structure, Vec<Option<f64>>)],
        options: StreamingOptions,
    ) -> Result<Self> {
        check_step(step)?;
        options.check()?;
        #[allow(clippy::cast_precision_loss)]
        let rates = Rates::new(step, step * (max_pulses.max(2) as f64), MEMORY_TOLERANCE)?;
        let mut fits = Vec::with_capacity(equations.len());
        for (structure, fixed) in equations {
            structure.check(inputs.len(), |s| inputs[s])?;
            check_length("fixed coefficients", structure.terms.len(), fixed.len())?;
            let fixed_values: Vec<f64> = fixed.iter().flatten().copied().collect();
            check_finite("fixed coefficients", &fixed_values)?;
            // A stream integrates only. The whole equation is integrated by the excess order of an improper term.
            let orders: Vec<f64> = (0..structure.terms.len()).map(|k| structure.integration(k)).collect();
            let excess = orders.iter().fold(0.0, |largest: f64, order| largest.max(-order));
            let integrals = structure
                .terms
                .iter()
                .zip(&orders)
                .map(|(term, order)| RunningIntegral::new(term.signal, order + excess, step, &rates))
                .collect::<Result<Vec<_>>>()?;
            let initial = structure
                .initial_exponents(&options.initial)
                .into_iter()
                .map(|e| InitialColumn::new(e, excess, step))
                .collect::<Result<Vec<_>>>()?;
            let free = fixed.iter().filter(|f| f.is_none()).count() + initial.len();
            fits.push(EquationRecursion {
                output: structure.output,
                target: RunningIntegral::new(structure.output, excess, step, &rates)?,
                integrals,
                initial,
                fixed: fixed.clone(),
                recursion: Recursion::new(&vec![options.prior.precision(0.0); free])?,
                window: SlidingGram::new(free, options.length),
                values: vec![0.0; 1 + orders.len()],
                row: Vec::with_capacity(free),
            });
        }
        let decays: Vec<_> = rates.rates().iter().map(|s| decay(s * step)).collect();
        let count = decays.len();
        Ok(Self {
            inputs: inputs.to_vec(),
            decay_factors: decays.iter().map(|d| d.0).collect(),
            pulse_weights: decays.iter().map(|d| step * (d.1 + d.2)).collect(),
            histories: vec![SignalHistory { states: vec![0.0; count], last: 0.0 }; inputs.len()],
            fits,
            sample: Vec::new(),
            means: vec![0.0; inputs.len()],
            options,
            pulses: 0,
            max_pulses,
        })
    }

    /// Add one sample of every signal, in constant time.
    ///
    /// # Errors
    /// [`Error::Length`] if there is not one value per signal. [`Error::NotFinite`] if a value is not finite.
    /// [`Error::OutOfRange`] if the stream exceeds `max_pulses`. [`Error::Diverged`] if rounding makes the
    /// covariance indefinite.
    pub fn push(&mut self, sample: &[f64]) -> Result<()> {
        check_length("sample", self.inputs.len(), sample.len())?;
        check_finite("sample", sample)?;
        if self.sample.is_empty() {
            self.sample.extend_from_slice(sample);
            return Ok(());
        }
        if self.pulses == self.max_pulses {
            #[allow(clippy::cast_precision_loss)]
            return Err(Error::OutOfRange {
                name: "pulses in the stream".into(),
                value: (self.pulses + 1) as f64,
                range: format!("[0, {}]", self.max_pulses),
                remedy: "set a longer duration of the stream".into(),
            });
        }
        for (s, mean) in self.means.iter_mut().enumerate() {
            *mean = if self.inputs[s] { self.sample[s] } else { 0.5 * (self.sample[s] + sample[s]) };
        }
        self.sample.copy_from_slice(sample);
        let Self { fits, histories, means, decay_factors, pulse_weights, .. } = self;
        simd::dispatch_simd(Integration { fits, histories, means, decay_factors, pulse_weights });
        for fit in &mut self.fits {
            fit.step(&self.options, self.pulses)?;
        }
        self.pulses += 1;
        Ok(())
    }

    /// Return the coefficients of every equation after the newest sample.
    ///
    /// For each equation, the coefficients of the terms, including fixed ones, precede those of the initial terms.
    #[must_use]
    pub fn coefficients(&self) -> Vec<Vec<f64>> {
        self.fits.iter().map(|fit| fit.coefficients().collect()).collect()
    }

    /// Total number of coefficients of all equations, including fixed ones.
    #[must_use]
    pub fn coefficient_count(&self) -> usize {
        self.fits.iter().map(|fit| fit.fixed.len() + fit.initial.len()).sum()
    }

    /// Append the coefficients of all equations after the newest sample to `out`.
    pub fn append_coefficients(&self, out: &mut Vec<f64>) {
        self.fits.iter().for_each(|fit| out.extend(fit.coefficients()));
    }

    /// Number of pulses so far. The first sample starts the first pulse, and each further sample ends a pulse.
    #[must_use]
    pub fn pulses(&self) -> usize {
        self.pulses
    }
}

impl InitialColumn {
    /// Column of I^q t^e = Γ(e + 1)/Γ(e + 1 + q) t^(e + q), with q = `excess`.
    fn new(exponent: f64, excess: f64, step: f64) -> Result<Self> {
        if exponent <= -1.0 {
            return Err(Error::OutOfRange {
                name: "exponent of an initial term in a stream".into(),
                value: exponent,
                range: "(-1, ∞)".into(),
                remedy: "identify an equation with this term from the recorded run instead".into(),
            });
        }
        let scale = libm::tgamma(exponent + 1.0) / libm::tgamma(exponent + excess + 1.0);
        Ok(Self { means: PowerMeans::new(exponent + excess, step), scale })
    }
}

/// SIMD task that integrates the newest pulse for every equation and then updates the histories of all signals.
struct Integration<'a> {
    fits: &'a mut [EquationRecursion],
    histories: &'a mut [SignalHistory],
    means: &'a [f64],
    decay_factors: &'a [f64],
    pulse_weights: &'a [f64],
}

impl simd::SimdKernel for Integration<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { fits, histories, means, decay_factors, pulse_weights } = self;
        for fit in fits {
            fit.values[0] = fit.target.next(means[fit.output], &histories[fit.output]);
            for (value, integral) in fit.values[1..].iter_mut().zip(&mut fit.integrals) {
                *value = integral.next(means[integral.signal], &histories[integral.signal]);
            }
        }
        for (history, mean) in histories.iter_mut().zip(means) {
            for ((z, decay_factor), pulse_weight) in history.states.iter_mut().zip(decay_factors).zip(pulse_weights) {
                *z = *z * decay_factor + pulse_weight * history.last;
            }
            history.last = *mean;
        }
    }
}

impl EquationRecursion {
    fn step(&mut self, options: &StreamingOptions, pulse: usize) -> Result<()> {
        let (mut target, row) = (self.values[0], &mut self.row);
        row.clear();
        for (value, fixed) in self.values[1..].iter().zip(&self.fixed) {
            match fixed {
                None => row.push(*value),
                Some(coefficient) => target -= coefficient * value,
            }
        }
        row.extend(self.initial.iter().map(|column| column.scale * column.means.mean(pulse)));
        self.recursion.forget(options.forgetting);
        if let Prior::Relative(_) = options.prior {
            self.recursion.add_prior(row.iter().map(|value| options.prior.precision(value * value)));
        }
        self.window.push(row, target)?;
        self.recursion
            .step(&self.window)
            .map_err(|_| Error::Diverged { what: "covariance of the recursion".into(), index: pulse })
    }

    /// Coefficients of the terms, then of the initial terms.
    fn coefficients(&self) -> impl Iterator<Item = f64> + '_ {
        let mut free = self.recursion.coefficients().iter();
        let fixed = self.fixed.iter().copied().chain(self.initial.iter().map(|_| None));
        fixed.map(move |f| f.unwrap_or_else(|| free.next().copied().unwrap_or(0.0)))
    }
}
