//! Inverse A⁻¹ of the system matrix of one experiment, and the integral operators of its terms.
//!
//! If all integration orders are fixed integers, running sums replace the spectra.

use std::borrow::Cow;
use std::cell::{OnceCell, RefCell};
use std::collections::HashMap;
use std::rc::Rc;

use crate::error::{Error, Result};
use crate::fractional::kernels::{
    kernel, kernel_with_derivative, power_means, power_means_slope, power_pulses, power_pulses_slope,
};
use crate::series::{
    multiply, Buffers, Kernel, RunningSumSystem, Solver, Source, SumOfProducts, MAX_SUMS, RIGHT_SIDE_LANES,
};

/// Representation of A⁻¹ at a parameter point.
pub(crate) enum Inverse {
    /// Spectra of the entries of A⁻¹, and the length to which they are padded for products.
    Spectra { rows: Vec<Vec<Kernel>>, total: usize },
    /// Running sums, which are solved again for each right-hand side.
    Sums(RunningSumSystem),
}

/// Right-hand sides of the equations: sums of integrals of signals.
pub(crate) enum RightHandSides<'a> {
    /// Sum of each equation, with a flag that is true if the sum is nonzero.
    Spectra(Vec<(bool, SumOfProducts)>),
    /// Index of the equation, integration order, weight and signal of each summand.
    Sums(Vec<(usize, usize, f64, Cow<'a, [f64]>)>),
}

impl<'a> RightHandSides<'a> {
    /// Set all sums to zero.
    pub(crate) fn clear(&mut self) {
        match self {
            Self::Spectra(sums) => {
                for (is_nonzero, sum) in sums.iter_mut().filter(|(is_nonzero, _)| *is_nonzero) {
                    sum.clear();
                    *is_nonzero = false;
                }
            }
            Self::Sums(sources) => sources.clear(),
        }
    }

    /// Return true if a summand was added.
    pub(crate) fn is_nonzero(&self) -> bool {
        match self {
            Self::Spectra(sums) => sums.iter().any(|(is_nonzero, _)| *is_nonzero),
            Self::Sums(sources) => !sources.is_empty(),
        }
    }

    /// Multiply by the spectra of the inverse, and return `m` pulse means of each output.
    ///
    /// Return None if the right-hand sides are zero or have no spectra.
    fn apply_inverse(
        &self,
        rows: &[Vec<Kernel>],
        m: usize,
        target: &mut SumOfProducts,
        buffers: &mut Buffers,
    ) -> Option<Vec<Vec<f64>>> {
        let Self::Spectra(sums) = self else { return None };
        let multiply_row = |row: &Vec<Kernel>| {
            let nonzero_pairs = row.iter().zip(sums).filter(|(_, (is_nonzero, _))| *is_nonzero);
            nonzero_pairs.for_each(|(entry, (_, sum))| target.add_product(sum, entry));
            let mut means = vec![0.0; m];
            target.take(&mut means, buffers);
            means
        };
        self.is_nonzero().then(|| rows.iter().map(multiply_row).collect())
    }

    /// Return the summands as sources of the running sums; empty for spectra.
    fn sources(&self) -> Vec<Source<'_>> {
        let Self::Sums(sources) = self else { return Vec::new() };
        (sources.iter())
            .map(|(equation, order, weight, series)| Source {
                equation: *equation,
                order: *order,
                weight: *weight,
                series,
            })
            .collect()
    }

    /// Add `weight` times an operator applied to a signal to the right-hand side of an equation.
    ///
    /// With `slope`, the derivative of the operator with respect to its order is applied instead.
    ///
    /// The series and the spectrum of the signal are computed only if needed.
    pub(crate) fn add(
        &mut self,
        equation: usize,
        weight: f64,
        (operator, slope): (&Operator, bool),
        series: impl FnOnce() -> Cow<'a, [f64]>,
        spectrum: impl FnOnce() -> Rc<Kernel>,
    ) {
        match self {
            Self::Spectra(sums) => {
                let (is_nonzero, sum) = &mut sums[equation];
                *is_nonzero = true;
                sum.add(weight, &operator.spectrum(slope), &spectrum());
            }
            Self::Sums(sources) => {
                // Integer orders are fixed and have no derivative.
                sources.extend(
                    operator.integer_order().filter(|_| !slope).map(|order| (equation, order, weight, series())),
                );
            }
        }
    }

    /// Add a series to the right-hand side of an equation.
    ///
    /// Only the form that is needed, series or spectrum, is computed.
    pub(crate) fn add_series(
        &mut self,
        equation: usize,
        series: impl FnOnce() -> Cow<'a, [f64]>,
        spectrum: impl FnOnce() -> Rc<Kernel>,
    ) {
        match self {
            Self::Spectra(sums) => {
                let (is_nonzero, sum) = &mut sums[equation];
                *is_nonzero = true;
                sum.add_series(&spectrum());
            }
            Self::Sums(sources) => sources.push((equation, 0, 1.0, series())),
        }
    }
}

/// Pulse means of every output.
pub(crate) type PulseMeans = Vec<Vec<f64>>;

/// Inverse of the matrix A in the system A y = b of the equations. Its series are as long as the longest run.
pub(crate) struct SystemInverse {
    /// Solver that divides by A; None with running sums.
    solver: Option<RefCell<Solver<'static>>>,
    inverse: OnceCell<Inverse>,
    /// Cache of the responses to initial terms, by index of the equation and bit pattern of the exponent. It is used if
    /// several runs share this inverse.
    initial_responses: RefCell<HashMap<(usize, u64), Rc<PulseMeans>>>,
}

impl SystemInverse {
    /// Return the inverse of a matrix A of series.
    ///
    /// # Errors
    /// An error if the matrix of leading coefficients is singular, or if the series have unequal lengths
    /// ([`Solver::new`]).
    pub(crate) fn from_matrix(matrix: Vec<Vec<Vec<f64>>>) -> Result<Self> {
        let solver = Some(RefCell::new(Solver::from_matrix(matrix)?));
        Ok(Self { solver, inverse: OnceCell::new(), initial_responses: RefCell::default() })
    }

    /// Return an inverse by running sums.
    pub(crate) fn from_running_sums(sums: RunningSumSystem) -> Self {
        Self { solver: None, inverse: OnceCell::from(Inverse::Sums(sums)), initial_responses: RefCell::default() }
    }

    /// Solve A y = b by division, which is exact also if A⁻¹ is unstable; None with running sums.
    ///
    /// # Errors
    /// An error if the series of `rhs` do not match the matrix ([`Solver::solve`]).
    pub(crate) fn solve_by_division(&self, rhs: &[Vec<f64>]) -> Result<Option<PulseMeans>> {
        self.solver.as_ref().map(|solver| solver.borrow_mut().solve(rhs)).transpose()
    }

    /// Return the inverse A⁻¹. Its spectra, if it has any, are padded so that products of [`SPECTRUM_FACTORS`] series
    /// of the longest run have no aliasing.
    ///
    /// # Errors
    /// An error if the series do not match the matrix ([`Solver::solve`]).
    pub(crate) fn inverse(&self) -> Result<&Inverse> {
        if let (None, Some(solver)) = (self.inverse.get(), &self.solver) {
            let mut solver = solver.borrow_mut();
            let total = SPECTRUM_FACTORS * solver.terms();
            let rows = solver.inverse_spectra(total)?;
            return Ok(self.inverse.get_or_init(|| Inverse::Spectra { rows, total }));
        }
        self.inverse.get().ok_or_else(|| Error::Internal { what: "system without a solver".into() })
    }

    /// Return the responses of `n` outputs over `m` pulses to the initial terms t^e of equations.
    ///
    /// `terms` contains the pairs (index of the equation, e), and `initial_term_of` returns the initial term of an
    /// exponent. If `stores_responses`, the responses are cached.
    ///
    /// # Errors
    /// An error if the series do not match the matrix ([`Solver::solve`]).
    pub(crate) fn initial_term_responses(
        &self,
        (n, m): (usize, usize),
        terms: &[(usize, f64)],
        stores_responses: bool,
        initial_term_of: impl Fn(f64) -> Rc<InitialTerm>,
    ) -> Result<Vec<Rc<PulseMeans>>> {
        let key = |&(i, e): &(usize, f64)| (i, e.to_bits());
        let uncached_terms: Vec<(usize, f64)> =
            terms.iter().filter(|t| !self.initial_responses.borrow().contains_key(&key(t))).copied().collect();
        let powers: Vec<Rc<InitialTerm>> = uncached_terms.iter().map(|&(_, e)| initial_term_of(e)).collect();
        let mut new_responses = HashMap::new();
        self.inverse()?.solve_each(
            (n, m),
            uncached_terms.len(),
            |index, right_hand_sides| {
                let power = &powers[index];
                right_hand_sides.add_series(
                    uncached_terms[index].0,
                    || Cow::Borrowed(power.series()),
                    || power.spectrum(),
                );
                Ok(())
            },
            |index, means| {
                new_responses.insert(key(&uncached_terms[index]), Rc::new(means.unwrap_or_default()));
                Ok(())
            },
        )?;
        let mut cache = self.initial_responses.borrow_mut();
        let responses =
            terms.iter().filter_map(|t| cache.get(&key(t)).or_else(|| new_responses.get(&key(t))).cloned()).collect();
        if stores_responses {
            cache.extend(new_responses);
        }
        Ok(responses)
    }
}

impl Inverse {
    /// Solve for `count` right-hand sides, with `n` outputs and `m` pulses.
    ///
    /// `fill` fills each right-hand side. `receive_means` receives the pulse means of the outputs, or None for a zero
    /// right-hand side.
    ///
    /// # Errors
    /// The errors of `fill` and `receive_means`.
    pub(crate) fn solve_each<'a>(
        &self,
        (n, m): (usize, usize),
        count: usize,
        mut fill: impl FnMut(usize, &mut RightHandSides<'a>) -> Result<()>,
        mut receive_means: impl FnMut(usize, Option<Vec<Vec<f64>>>) -> Result<()>,
    ) -> Result<()> {
        match self {
            Self::Spectra { rows, total } => {
                let sum = || (false, SumOfProducts::with_length(*total));
                let mut right_hand_sides = RightHandSides::Spectra((0..n).map(|_| sum()).collect());
                let mut target = SumOfProducts::with_length(*total);
                let mut buffers = Buffers::default();
                for index in 0..count {
                    fill(index, &mut right_hand_sides)?;
                    receive_means(index, right_hand_sides.apply_inverse(rows, m, &mut target, &mut buffers))?;
                    right_hand_sides.clear();
                }
            }
            Self::Sums(recursion) => {
                for first in (0..count).step_by(RIGHT_SIDE_LANES) {
                    let mut batch = Vec::with_capacity(RIGHT_SIDE_LANES);
                    for index in first..(first + RIGHT_SIDE_LANES).min(count) {
                        let mut right_hand_sides = RightHandSides::Sums(Vec::new());
                        fill(index, &mut right_hand_sides)?;
                        batch.push(right_hand_sides);
                    }
                    let sources: Vec<Vec<Source>> = batch.iter().map(RightHandSides::sources).collect();
                    for (index, (means, right_hand_sides)) in
                        (first..).zip(recursion.solve(m, &sources)?.into_iter().zip(&batch))
                    {
                        receive_means(index, right_hand_sides.is_nonzero().then_some(means))?;
                    }
                }
            }
        }
        Ok(())
    }
}

/// Maximum number of series in a product. Spectra of this multiple of the series length multiply without aliasing.
pub(crate) const SPECTRUM_FACTORS: usize = 3;

/// Number of pulses above which spectra are not cached, because they need many times the memory of the record.
pub(crate) const MAX_CACHED_PULSES: usize = 1 << 15;

/// Difference from an integer below which an integration order counts as that integer.
const INTEGER_TOLERANCE: f64 = 1e-12;

/// Integral operator of a term: kernel, and its derivative with respect to the order if the order is free.
pub(crate) struct Operator {
    eta: f64,
    is_free: bool,
    m: usize,
    step: f64,
    /// Kernel and, for orders of at least 0, its derivative; computed when first needed.
    series: OnceCell<(Vec<f64>, Vec<f64>)>,
    spectra: [OnceCell<Rc<Kernel>>; 2],
}

impl Operator {
    /// Return the operator of integration order `eta` on a grid of `m` pulses of width `step` \[s\].
    pub(crate) fn new(eta: f64, is_free: bool, m: usize, step: f64) -> Self {
        Self { eta, is_free, m, step, series: OnceCell::new(), spectra: [OnceCell::new(), OnceCell::new()] }
    }

    fn series(&self) -> &(Vec<f64>, Vec<f64>) {
        self.series.get_or_init(|| match self.is_free && self.eta >= 0.0 {
            true => kernel_with_derivative(self.eta, self.m, self.step),
            false => (kernel(self.eta, self.m, self.step), Vec::new()),
        })
    }

    /// Spectrum of the derivative of the kernel with respect to the order.
    ///
    /// For a negative order, the derivative is a product of three series.
    fn slope(&self) -> Kernel {
        let total = SPECTRUM_FACTORS * self.m;
        if self.eta >= 0.0 || !self.is_free {
            return Kernel::with_length(&self.series().1, total);
        }
        // With the kernel F(η), the kernel of a negative order is 1/F(−η). Its derivative with respect to η is
        // F′(−η)/F(−η)².
        let (_, derivative) = kernel_with_derivative(-self.eta, self.m, self.step);
        let (mut product, spectrum) = (Kernel::with_length(&derivative, total), self.spectrum(false));
        product.multiply(&spectrum);
        let mut slope = vec![0.0; self.m];
        product.times(&spectrum, &mut slope, &mut Buffers::default());
        Kernel::with_length(&slope, total)
    }

    /// Integration order.
    pub(crate) fn eta(&self) -> f64 {
        self.eta
    }

    /// Return true if the operator has the order `eta` and the flag `is_free`.
    pub(crate) fn matches_order(&self, eta: f64, is_free: bool) -> bool {
        self.eta.to_bits() == eta.to_bits() && self.is_free == is_free
    }

    /// Kernel of the integral.
    pub(crate) fn kernel(&self) -> &[f64] {
        &self.series().0
    }

    /// Integration order if it is a fixed integer from 0 to [`MAX_SUMS`], else None.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(crate) fn integer_order(&self) -> Option<usize> {
        let nearest = self.eta.round();
        let is_integer = !self.is_free && (self.eta - nearest).abs() <= INTEGER_TOLERANCE && nearest >= 0.0;
        (is_integer && nearest <= MAX_SUMS as f64).then_some(nearest as usize)
    }

    /// Spectrum of the kernel, or of its derivative if `slope` is true, padded for products of [`SPECTRUM_FACTORS`]
    /// series.
    pub(crate) fn spectrum(&self, slope: bool) -> Rc<Kernel> {
        let compute = || {
            Rc::new(if slope { self.slope() } else { Kernel::with_length(self.kernel(), SPECTRUM_FACTORS * self.m) })
        };
        if self.m > MAX_CACHED_PULSES {
            return compute();
        }
        self.spectra[usize::from(slope)].get_or_init(compute).clone()
    }
}

/// Initial term t^e after the sensor filter of all signals, and its derivative with respect to the exponent e.
pub(crate) struct InitialTerm {
    exponent: f64,
    step: f64,
    filter: Option<Rc<SeriesFilter>>,
    unfiltered: Vec<f64>,
    series: OnceCell<Vec<f64>>,
    spectrum: OnceCell<Rc<Kernel>>,
    slope: OnceCell<Vec<f64>>,
}

/// Series of a filter, with its spectrum padded for products of [`SPECTRUM_FACTORS`] series.
pub(crate) struct SeriesFilter {
    series: Vec<f64>,
    spectrum: Kernel,
}

impl SeriesFilter {
    /// Return the filter with the given series.
    pub(crate) fn new(series: &[f64]) -> Self {
        Self { series: series.to_vec(), spectrum: Kernel::with_length(series, SPECTRUM_FACTORS * series.len()) }
    }

    /// Apply the filter to a series.
    pub(crate) fn apply(&self, series: &[f64]) -> Vec<f64> {
        multiply(&self.series, series, series.len())
    }
}

impl InitialTerm {
    /// Return the initial term t^e with e = `exponent` on a grid of `m` pulses of width `step` \[s\].
    pub(crate) fn new(exponent: f64, m: usize, step: f64, filter: Option<Rc<SeriesFilter>>) -> Self {
        let unfiltered =
            if filter.is_some() { power_pulses(exponent, m, step) } else { power_means(exponent, m, step) };
        let (series, spectrum, slope) = Default::default();
        Self { exponent, step, filter, unfiltered, series, spectrum, slope }
    }

    /// Pulse means after the filter.
    pub(crate) fn series(&self) -> &[f64] {
        match &self.filter {
            None => &self.unfiltered,
            Some(filter) => self.series.get_or_init(|| filter.apply(&self.unfiltered)),
        }
    }

    /// Pulse means of the derivative of t^e with respect to e, before the filter.
    pub(crate) fn slope(&self) -> &[f64] {
        let slope_function = if self.filter.is_some() { power_pulses_slope } else { power_means_slope };
        self.slope.get_or_init(|| slope_function(self.exponent, self.unfiltered.len(), self.step))
    }

    /// Spectrum of the pulse means after the filter, padded for a product with one more series.
    pub(crate) fn spectrum(&self) -> Rc<Kernel> {
        let compute = || {
            Rc::new(filtered_spectrum(
                &self.unfiltered,
                self.filter.as_deref(),
                SPECTRUM_FACTORS * self.unfiltered.len(),
            ))
        };
        if self.unfiltered.len() > MAX_CACHED_PULSES {
            return compute();
        }
        self.spectrum.get_or_init(compute).clone()
    }
}

/// Spectrum of a filtered series that is padded to the length `total`.
pub(crate) fn filtered_spectrum(series: &[f64], filter: Option<&SeriesFilter>, total: usize) -> Kernel {
    let mut spectrum = Kernel::with_length(series, total);
    if let Some(filter) = filter {
        spectrum.multiply(&filter.spectrum);
    }
    spectrum
}
