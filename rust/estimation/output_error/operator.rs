//! The integral of a term and the power of t of an initial term, with spectra that are made when they are asked for.

use std::cell::OnceCell;
use std::rc::Rc;

use crate::fractional::excess::kernel;
use crate::fractional::kernels::{
    kernel_with_derivative, power_means, power_means_slope, power_pulses, power_pulses_slope,
};
use crate::series::{multiply, Buffers, Kernel, MAX_SUMS};

/// Terms of a product of three series of m terms: spectra of this length multiply without wrapping onto the first m.
pub(crate) const FACTORS: usize = 3;

/// Spectra of longer records are made anew each time: those of all terms together would be many times the record.
pub(crate) const KEPT_PULSES: usize = 1 << 15;

/// How near to a whole number an order of integration is one: the kernels differ by as much.
const WHOLE: f64 = 1e-12;

/// The integral of a term: its kernel, and the kernel's derivative with respect to its order where the order is free.
pub(crate) struct Operator {
    eta: f64,
    free: bool,
    m: usize,
    step: f64,
    /// Kernel and, of an order above 0, its derivative, once they are asked for.
    series: OnceCell<(Vec<f64>, Vec<f64>)>,
    spectra: [OnceCell<Rc<Kernel>>; 2],
}

impl Operator {
    /// That integrates by `eta` on a grid of m pulses; its order may be free.
    pub(crate) fn new(eta: f64, free: bool, m: usize, step: f64) -> Self {
        Self { eta, free, m, step, series: OnceCell::new(), spectra: [OnceCell::new(), OnceCell::new()] }
    }

    fn series(&self) -> &(Vec<f64>, Vec<f64>) {
        self.series.get_or_init(|| match self.free && self.eta >= 0.0 {
            true => kernel_with_derivative(self.eta, self.m, self.step),
            false => (kernel(self.eta, self.m, self.step), Vec::new()),
        })
    }

    /// The spectrum of the kernel's derivative. Below order 0 that is a product of three, which no rejected step asks for.
    fn slope(&self) -> Kernel {
        let total = FACTORS * self.m;
        if self.eta >= 0.0 || !self.free {
            return Kernel::with_length(&self.series().1, total);
        }
        // d/dη of 1/F(−η) is F′(−η)/F(−η)².
        let (_, turned) = kernel_with_derivative(-self.eta, self.m, self.step);
        let (mut product, made) = (Kernel::with_length(&turned, total), self.spectrum(false));
        product.multiply(&made);
        let mut slope = vec![0.0; self.m];
        product.times(&made, &mut slope, &mut Buffers::default());
        Kernel::with_length(&slope, total)
    }

    /// The order of the integral.
    pub(crate) fn eta(&self) -> f64 {
        self.eta
    }

    /// Whether it is the integral of this order, with or without a derivative.
    pub(crate) fn serves(&self, eta: f64, free: bool) -> bool {
        self.eta.to_bits() == eta.to_bits() && self.free == free
    }

    /// Of the integral.
    pub(crate) fn kernel(&self) -> &[f64] {
        &self.series().0
    }

    /// The order of the integral where it is whole and stays so.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(crate) fn whole(&self) -> Option<usize> {
        let near = self.eta.round();
        let stays = !self.free && (self.eta - near).abs() <= WHOLE && near >= 0.0;
        (stays && near <= MAX_SUMS as f64).then_some(near as usize)
    }

    /// The spectrum of the kernel, or of its derivative, for products of [`FACTORS`] series.
    pub(crate) fn spectrum(&self, slope: bool) -> Rc<Kernel> {
        let made = || Rc::new(if slope { self.slope() } else { Kernel::with_length(self.kernel(), FACTORS * self.m) });
        if self.m > KEPT_PULSES {
            return made();
        }
        self.spectra[usize::from(slope)].get_or_init(made).clone()
    }
}

/// What an initial term t^e adds, behind the filter that all signals pass, and how that turns with its exponent.
pub(crate) struct Power {
    exponent: f64,
    step: f64,
    filter: Option<Rc<Filter>>,
    raw: Vec<f64>,
    series: OnceCell<Vec<f64>>,
    spectrum: OnceCell<Rc<Kernel>>,
    slope: OnceCell<Vec<f64>>,
}

/// A filter with its spectrum for products of [`FACTORS`] series.
pub(crate) struct Filter {
    series: Vec<f64>,
    spectrum: Kernel,
}

impl Filter {
    /// Of its series.
    pub(crate) fn new(series: &[f64]) -> Self {
        Self { series: series.to_vec(), spectrum: Kernel::with_length(series, FACTORS * series.len()) }
    }

    /// What it makes of a series.
    pub(crate) fn of(&self, series: &[f64]) -> Vec<f64> {
        multiply(&self.series, series, series.len())
    }
}

impl Power {
    /// On a grid of m pulses.
    pub(crate) fn new(exponent: f64, m: usize, step: f64, filter: Option<Rc<Filter>>) -> Self {
        let raw = if filter.is_some() { power_pulses(exponent, m, step) } else { power_means(exponent, m, step) };
        let (series, spectrum, slope) = Default::default();
        Self { exponent, step, filter, raw, series, spectrum, slope }
    }

    /// Pulse means.
    pub(crate) fn series(&self) -> &[f64] {
        match &self.filter {
            None => &self.raw,
            Some(filter) => self.series.get_or_init(|| filter.of(&self.raw)),
        }
    }

    /// The derivative of t^e with respect to e, before the filter.
    pub(crate) fn slope(&self) -> &[f64] {
        let of = if self.filter.is_some() { power_pulses_slope } else { power_means_slope };
        self.slope.get_or_init(|| of(self.exponent, self.raw.len(), self.step))
    }

    /// Their spectrum, for a product with one more series.
    pub(crate) fn spectrum(&self) -> Rc<Kernel> {
        let made = || Rc::new(filtered_spectrum(&self.raw, self.filter.as_deref(), FACTORS * self.raw.len()));
        if self.raw.len() > KEPT_PULSES {
            return made();
        }
        self.spectrum.get_or_init(made).clone()
    }
}

/// The spectrum of a series that passes a filter, for products of so many terms in all.
pub(crate) fn filtered_spectrum(series: &[f64], filter: Option<&Filter>, total: usize) -> Kernel {
    let mut spectrum = Kernel::with_length(series, total);
    if let Some(filter) = filter {
        spectrum.multiply(&filter.spectrum);
    }
    spectrum
}
