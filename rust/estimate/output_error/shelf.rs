//! What the evaluations of one search have in common: kernels of orders that stay, and their spectra.

use super::experiment::Experiment;
use super::model::FreeModel;
use crate::excess::{kernel, kernel_and_slope};
use crate::series::Kernel;
use std::cell::OnceCell;
use std::collections::HashMap;
use std::rc::Rc;

/// Terms of a product of three series of m terms: spectra of this length multiply without wrapping onto the first m.
pub(super) const FACTORS: usize = 3;

/// Spectra of longer records are made anew each time: those of all terms together would be many times the record.
const KEPT_PULSES: usize = 1 << 15;

/// The kernel of a term's integral, and the kernel's derivative with respect to its order where the order is free.
pub(super) struct Operator {
    eta: f64,
    pub(super) kernel: Vec<f64>,
    pub(super) slope: Vec<f64>,
    spectra: [OnceCell<Rc<Kernel>>; 2],
}

impl Operator {
    /// The spectrum of the kernel, or of its derivative, for products of [`FACTORS`] series.
    pub(super) fn spectrum(&self, slope: bool) -> Rc<Kernel> {
        let series = if slope { &self.slope } else { &self.kernel };
        let made = || Rc::new(Kernel::with_length(series, FACTORS * series.len()));
        if series.len() > KEPT_PULSES {
            return made();
        }
        self.spectra[usize::from(slope)].get_or_init(made).clone()
    }
}

/// What stays of one experiment from one evaluation to the next.
#[derive(Default)]
pub(super) struct Shelf {
    /// The last operator of each term of each equation.
    operators: HashMap<(usize, usize), Rc<Operator>>,
    /// Spectra of signals that drive and have no free number.
    drivers: HashMap<usize, Rc<Kernel>>,
    /// Spectra of powers of t that initial terms bring, by the bits of their exponents.
    powers: HashMap<u64, Rc<Kernel>>,
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
        let (kernel, slope) = if free { kernel_and_slope(eta, m, step) } else { (kernel(eta, m, step), Vec::new()) };
        let made = Rc::new(Operator { eta, kernel, slope, spectra: [OnceCell::new(), OnceCell::new()] });
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

    /// The spectrum of what an initial term t^e adds, for products of [`FACTORS`] series.
    pub(super) fn power(&mut self, experiment: &Experiment, exponent: f64) -> Rc<Kernel> {
        let (record, total) = (&experiment.record, FACTORS * experiment.record.m());
        let made = || Rc::new(Kernel::with_length(&record.initial_term(exponent), total));
        if record.m() > KEPT_PULSES {
            return made();
        }
        // Exponents that move with free orders would fill the shelf.
        if self.powers.len() > 64 {
            self.powers.clear();
        }
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
