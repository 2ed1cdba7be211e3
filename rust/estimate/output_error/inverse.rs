//! A⁻¹ of the equations of one experiment, applied to any right-hand side: by products of spectra, or by running sums where
//! every order of integration is whole and stays so.

use super::shelf::{Operator, FACTORS};
use crate::error::Result;
use crate::series::{Buffers, Kernel, Recursion, Solver, Source, SumOfProducts, ABREAST};
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

    /// What an inverse by spectra makes of it.
    fn through(
        &self,
        rows: &[Vec<Kernel>],
        m: usize,
        target: &mut SumOfProducts,
        buffers: &mut Buffers,
    ) -> Option<Vec<Vec<f64>>> {
        let Self::Spectra(rights) = self else { return None };
        let of_row = |row: &Vec<Kernel>| {
            let moved = row.iter().zip(rights).filter(|(_, (used, _))| *used);
            moved.for_each(|(entry, (_, right))| target.add_product(right, entry));
            let mut means = vec![0.0; m];
            target.take(&mut means, buffers);
            means
        };
        self.moves().then(|| rows.iter().map(of_row).collect())
    }

    /// What running sums take.
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
    /// For each of `count` right-hand sides, as `given` adds it up, the pulse means of each unknown to `taken`; none where
    /// nothing was added.
    ///
    /// # Errors
    /// Those of `given` and `taken`.
    pub(super) fn each<'a>(
        &self,
        (n, m): (usize, usize),
        count: usize,
        mut given: impl FnMut(usize, &mut Rights<'a>) -> Result<()>,
        mut taken: impl FnMut(usize, Option<Vec<Vec<f64>>>) -> Result<()>,
    ) -> Result<()> {
        match self {
            Self::Spectra(rows) => {
                let mut rights =
                    Rights::Spectra((0..n).map(|_| (false, SumOfProducts::with_length(FACTORS * m))).collect());
                let mut target = SumOfProducts::with_length(FACTORS * m);
                let mut buffers = Buffers::default();
                for place in 0..count {
                    given(place, &mut rights)?;
                    taken(place, rights.through(rows, m, &mut target, &mut buffers))?;
                    rights.clear();
                }
            }
            Self::Sums(recursion) => {
                for first in (0..count).step_by(ABREAST) {
                    let mut lists = Vec::with_capacity(ABREAST);
                    for place in first..(first + ABREAST).min(count) {
                        let mut rights = Rights::Sums(Vec::new());
                        given(place, &mut rights)?;
                        lists.push(rights);
                    }
                    let sources: Vec<Vec<Source>> = lists.iter().map(Rights::sources).collect();
                    for (place, (means, rights)) in (first..).zip(recursion.solve(m, &sources)?.into_iter().zip(&lists))
                    {
                        taken(place, rights.moves().then_some(means))?;
                    }
                }
            }
        }
        Ok(())
    }
}
