//! The integral of a term and the power of t of an initial term, with spectra that are made when they are asked for.

use crate::excess::{kernel, kernel_and_slope};
use crate::series::{Kernel, MAX_SUMS};
use std::cell::OnceCell;
use std::rc::Rc;

/// Terms of a product of three series of m terms: spectra of this length multiply without wrapping onto the first m.
pub(super) const FACTORS: usize = 3;

/// Spectra of longer records are made anew each time: those of all terms together would be many times the record.
pub(super) const KEPT_PULSES: usize = 1 << 15;

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
    /// That integrates by `eta` on a grid of m pulses; its order may be free.
    pub(super) fn new(eta: f64, free: bool, m: usize, step: f64) -> Self {
        Self { eta, free, m, step, series: OnceCell::new(), spectra: [OnceCell::new(), OnceCell::new()] }
    }

    fn series(&self) -> &(Vec<f64>, Vec<f64>) {
        self.series.get_or_init(|| match self.free {
            true => kernel_and_slope(self.eta, self.m, self.step),
            false => (kernel(self.eta, self.m, self.step), Vec::new()),
        })
    }

    /// The order of the integral.
    pub(super) fn eta(&self) -> f64 {
        self.eta
    }

    /// Whether it is the integral of this order, with or without a derivative.
    pub(super) fn serves(&self, eta: f64, free: bool) -> bool {
        self.eta.to_bits() == eta.to_bits() && self.free == free
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
    /// Of its series.
    pub(super) fn new(series: Vec<f64>) -> Self {
        Self { series, spectrum: OnceCell::new() }
    }

    /// Its spectrum.
    pub(super) fn spectrum(&self) -> Rc<Kernel> {
        let made = || Rc::new(Kernel::with_length(&self.series, FACTORS * self.series.len()));
        if self.series.len() > KEPT_PULSES {
            return made();
        }
        self.spectrum.get_or_init(made).clone()
    }
}
