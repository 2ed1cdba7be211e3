//! What the evaluations of one search have in common: kernels of orders that stay, and their spectra.

use super::experiment::Experiment;
use super::model::FreeModel;
use crate::excess::{kernel, kernel_and_slope};
use crate::series::{Kernel, MAX_SUMS};
use std::cell::OnceCell;
use std::collections::HashMap;
use std::rc::Rc;

/// Terms of a product of three series of m terms: spectra of this length multiply without wrapping onto the first m.
pub(super) const FACTORS: usize = 3;

/// Spectra of longer records are made anew each time: those of all terms together would be many times the record.
const KEPT_PULSES: usize = 1 << 15;

/// Powers of t that are kept of long records and of others.
const FEW_POWERS: usize = 8;
const MANY_POWERS: usize = 64;

/// How near to a whole number an order of integration is one: the kernels differ by as much.
const WHOLE: f64 = 1e-12;

/// The integral of a term: its kernel, and the kernel's derivative with respect to its order where the order is free.
pub(super) struct Operator {
    eta: f64,
    free: bool,
    m: usize,
    step: f64,
    /// Kernel and derivative, once they are asked for.
    series: OnceCell<(Vec<f64>, Vec<f64>)>,
    spectra: [OnceCell<Rc<Kernel>>; 2],
}

impl Operator {
    fn series(&self) -> &(Vec<f64>, Vec<f64>) {
        self.series.get_or_init(|| match self.free {
            true => kernel_and_slope(self.eta, self.m, self.step),
            false => (kernel(self.eta, self.m, self.step), Vec::new()),
        })
    }

    /// Of the integral.
    pub(super) fn kernel(&self) -> &[f64] {
        &self.series().0
    }

    /// The order of the integral where it is whole and stays so.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn whole(&self) -> Option<usize> {
        let near = self.eta.round();
        let stays = !self.free && (self.eta - near).abs() <= WHOLE && near >= 0.0;
        (stays && near <= MAX_SUMS as f64).then_some(near as usize)
    }

    /// The spectrum of the kernel, or of its derivative, for products of [`FACTORS`] series.
    pub(super) fn spectrum(&self, slope: bool) -> Rc<Kernel> {
        let made = || {
            let series = self.series();
            Rc::new(Kernel::with_length(if slope { &series.1 } else { &series.0 }, FACTORS * self.m))
        };
        if self.m > KEPT_PULSES {
            return made();
        }
        self.spectra[usize::from(slope)].get_or_init(made).clone()
    }
}

/// What an initial term t^e adds, and its spectrum for products of [`FACTORS`] series.
pub(super) struct Power {
    pub(super) series: Vec<f64>,
    spectrum: OnceCell<Rc<Kernel>>,
}

impl Power {
    /// Its spectrum.
    pub(super) fn spectrum(&self) -> Rc<Kernel> {
        let made = || Rc::new(Kernel::with_length(&self.series, FACTORS * self.series.len()));
        if self.series.len() > KEPT_PULSES {
            return made();
        }
        self.spectrum.get_or_init(made).clone()
    }
}

/// What stays of one experiment from one evaluation to the next.
#[derive(Default)]
pub(super) struct Shelf {
    /// The last operator of each term of each equation.
    operators: HashMap<(usize, usize), Rc<Operator>>,
    /// Spectra of signals that drive and have no free number.
    drivers: HashMap<usize, Rc<Kernel>>,
    /// Powers of t that initial terms bring, by the bits of their exponents.
    powers: HashMap<u64, Rc<Power>>,
    /// Weighted samples of impulses that the filter of an output gets, by output and the bits of their exponents.
    impulses: HashMap<(usize, u64), Vec<f64>>,
}

impl Shelf {
    /// The operator of a term that is integrated by `eta`; its order may be free.
    pub(super) fn operator(
        &mut self,
        place: (usize, usize),
        eta: f64,
        free: bool,
        experiment: &Experiment,
    ) -> Rc<Operator> {
        if let Some(known) = self.operators.get(&place).filter(|o| o.eta.to_bits() == eta.to_bits()) {
            return known.clone();
        }
        let (m, step) = (experiment.record.m(), experiment.record.step());
        let (series, spectra) = (OnceCell::new(), [OnceCell::new(), OnceCell::new()]);
        let made = Rc::new(Operator { eta, free, m, step, series, spectra });
        self.operators.insert(place, made.clone());
        made
    }

    /// The spectrum of a signal that drives, for products of [`FACTORS`] series; of what an actuator makes of it.
    pub(super) fn driver(
        &mut self,
        model: &FreeModel,
        experiment: &Experiment,
        signal: usize,
        acted: &[(Vec<f64>, Vec<f64>)],
    ) -> Rc<Kernel> {
        let total = FACTORS * experiment.record.m();
        if let Some(law) = model.law_of(signal) {
            return Rc::new(Kernel::with_length(&acted[law].0, total));
        }
        let made = || Rc::new(Kernel::with_length(experiment.record.signal(signal), total));
        if experiment.record.m() > KEPT_PULSES {
            return made();
        }
        self.drivers.entry(signal).or_insert_with(made).clone()
    }

    /// What an initial term t^e adds.
    pub(super) fn power(&mut self, experiment: &Experiment, exponent: f64) -> Rc<Power> {
        let record = &experiment.record;
        // Exponents that move with free orders would fill the shelf.
        if self.powers.len() > if record.m() > KEPT_PULSES { FEW_POWERS } else { MANY_POWERS } {
            self.powers.clear();
        }
        let made = || Rc::new(Power { series: record.initial_term(exponent), spectrum: OnceCell::new() });
        self.powers.entry(exponent.to_bits()).or_insert_with(made).clone()
    }

    /// Weighted samples of an impulse, or of a derivative of one, that only the filter of an output gets.
    pub(super) fn impulse(&mut self, experiment: &Experiment, output: usize, exponent: f64) -> Vec<f64> {
        let made = || {
            let mut means = vec![vec![0.0; experiment.record.m()]; experiment.samples.len()];
            means[output] = experiment.record.initial_term(exponent);
            experiment.sampled(&means)
        };
        self.impulses.entry((output, exponent.to_bits())).or_insert_with(made).clone()
    }
}
