//! A⁻¹ of the equations of one experiment, applied to any right-hand side: by products of spectra, or by running sums where
//! every order of integration is whole and stays so.

use super::shelf::{Operator, FACTORS};
use crate::error::{Error, Result};
use crate::series::{Buffers, Kernel, Recursion, Solver, Source, SumOfProducts};
use std::borrow::Cow;
use std::cell::OnceCell;
use std::rc::Rc;

/// A⁻¹ at a point.
pub(super) enum Inverse {
    /// Spectra of its entries.
    Spectra(Vec<Vec<Kernel>>),
    /// Running sums, one solution a right-hand side.
    Sums(Recursion),
}

/// What stands on the right-hand sides of the equations: integrals of signals, added up.
pub(super) enum Rights<'a> {
    /// Of each equation, and whether anything was added.
    Spectra(Vec<(bool, SumOfProducts)>),
    /// Equation, order, weight and signal of each.
    Sums(Vec<(usize, usize, f64, Cow<'a, [f64]>)>),
}

impl<'a> Rights<'a> {
    /// Nothing yet, for n equations and m pulses, as the inverse takes it.
    pub(super) fn new(inverse: &Inverse, n: usize, m: usize) -> Self {
        match inverse {
            Inverse::Spectra(_) => {
                Self::Spectra((0..n).map(|_| (false, SumOfProducts::with_length(FACTORS * m))).collect())
            }
            Inverse::Sums(_) => Self::Sums(Vec::new()),
        }
    }

    /// Forgets what was added.
    pub(super) fn clear(&mut self) {
        match self {
            Self::Spectra(rights) => {
                for (used, right) in rights.iter_mut().filter(|(used, _)| *used) {
                    right.clear();
                    *used = false;
                }
            }
            Self::Sums(sources) => sources.clear(),
        }
    }

    /// Whether anything was added.
    pub(super) fn moves(&self) -> bool {
        match self {
            Self::Spectra(rights) => rights.iter().any(|(used, _)| *used),
            Self::Sums(sources) => !sources.is_empty(),
        }
    }

    /// Adds an operator, or with `slope` its derivative with respect to its order, of a signal; its spectrum is asked for
    /// only where it is needed, and so is its series.
    pub(super) fn add(
        &mut self,
        equation: usize,
        weight: f64,
        (operator, slope): (&Operator, bool),
        series: impl FnOnce() -> Cow<'a, [f64]>,
        spectrum: impl FnOnce() -> Rc<Kernel>,
    ) {
        match self {
            Self::Spectra(rights) => {
                let (used, right) = &mut rights[equation];
                *used = true;
                right.add(weight, &operator.spectrum(slope), &spectrum());
            }
            Self::Sums(sources) => {
                // Orders that are whole here stay so, and have no slope.
                sources.extend(operator.whole().filter(|_| !slope).map(|order| (equation, order, weight, series())));
            }
        }
    }

    /// Adds a series as it is.
    pub(super) fn add_series(
        &mut self,
        equation: usize,
        series: Cow<'a, [f64]>,
        spectrum: impl FnOnce(&[f64]) -> Rc<Kernel>,
    ) {
        match self {
            Self::Spectra(rights) => {
                let (used, right) = &mut rights[equation];
                *used = true;
                right.add_series(&spectrum(&series));
            }
            Self::Sums(sources) => sources.push((equation, 0, 1.0, series)),
        }
    }
}

/// What a free run leaves of A: its inverse, made when it is first asked for.
pub(super) struct Solved {
    matrix: Vec<Vec<Vec<f64>>>,
    made: OnceCell<Inverse>,
}

impl Solved {
    /// A itself, entry by entry.
    pub(super) fn by(matrix: Vec<Vec<Vec<f64>>>) -> Self {
        Self { matrix, made: OnceCell::new() }
    }

    /// An inverse that is there already.
    pub(super) fn of(inverse: Inverse) -> Self {
        Self { matrix: Vec::new(), made: OnceCell::from(inverse) }
    }

    /// A⁻¹ on m pulses.
    ///
    /// # Errors
    /// As [`Solver::new`].
    pub(super) fn inverse(&self, m: usize) -> Result<&Inverse> {
        if let Some(made) = self.made.get() {
            return Ok(made);
        }
        let spectra = Solver::new(&self.matrix)?.inverse_spectra(FACTORS * m)?;
        Ok(self.made.get_or_init(|| Inverse::Spectra(spectra)))
    }
}

impl Inverse {
    /// Pulse means of each unknown, m of them.
    pub(super) fn times(&self, rights: &Rights, m: usize, buffers: &mut Buffers) -> Result<Vec<Vec<f64>>> {
        match (self, rights) {
            (Self::Spectra(rows), Rights::Spectra(rights)) => {
                let mut target = SumOfProducts::with_length(FACTORS * m);
                let of_row = |row: &Vec<Kernel>| {
                    let moved = row.iter().zip(rights).filter(|(_, (used, _))| *used);
                    moved.for_each(|(entry, (_, right))| target.add_product(right, entry));
                    let mut means = vec![0.0; m];
                    target.take(&mut means, buffers);
                    means
                };
                Ok(rows.iter().map(of_row).collect())
            }
            (Self::Sums(recursion), Rights::Sums(sources)) => {
                let sources: Vec<Source> = (sources.iter())
                    .map(|(equation, order, weight, series)| Source {
                        equation: *equation,
                        order: *order,
                        weight: *weight,
                        series,
                    })
                    .collect();
                recursion.solve(m, &sources)
            }
            _ => Err(Error::Internal { what: "right-hand sides of another inverse".into() }),
        }
    }
}
