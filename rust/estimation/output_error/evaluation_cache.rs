//! What the evaluations of one search have in common: kernels of orders that stay, their spectra, and of runs on one grid
//! whatever does not depend on the run.

use std::cell::RefCell;
use std::collections::HashMap;
use std::rc::Rc;

use super::experiment::Experiment;
use super::parameterization::FreeModel;
use super::system_inverse::{filtered_spectrum, Filter, Means, Operator, Power, Solved, FACTORS, KEPT_PULSES};
use crate::error::Result;
use crate::regressors::Record;
use crate::series::Kernel;

/// Powers of t that are kept of long records and of others.
const FEW_POWERS: usize = 8;
const MANY_POWERS: usize = 64;

/// Runs of one grid are this share as long as the longest at least: shorter ones would pay for transforms of its length.
const AS_LONG: f64 = 0.7;

/// What runs of one step and one filter share: kernels, powers of t, and A⁻¹ at the last point, as long as the longest.
struct Grid {
    /// A record of nothing, as long as the longest.
    bare: Record,
    /// The filter that all its signals pass.
    filter: Option<Rc<Filter>>,
    runs: usize,
    /// The last operator of each term of each equation.
    operators: HashMap<(usize, usize), Rc<Operator>>,
    /// Powers of t that initial terms bring, by the bits of their exponents.
    powers: HashMap<u64, Rc<Power>>,
    /// What the last equations were, by the bits of their own terms, and their inverse.
    solved: Option<(Vec<u64>, Rc<Solved>)>,
}

impl Grid {
    /// Whether an experiment is on the grid of a longer one.
    fn holds(&self, experiment: &Experiment) -> bool {
        let record = &experiment.record;
        let filters = match (self.bare.filter(), record.filter()) {
            (None, None) => true,
            (Some(long), Some(short)) => long.starts_with(short),
            _ => false,
        };
        let long = self.bare.m();
        filters
            && self.bare.step().to_bits() == record.step().to_bits()
            && record.m() <= long
            && record.m() as f64 >= AS_LONG * long as f64
    }
}

/// What stays of one experiment from one evaluation to the next.
pub(crate) struct Shelf {
    grid: Rc<RefCell<Grid>>,
    /// Points of every series that is multiplied, in all factors together.
    pub(crate) total: usize,
    /// Spectra of signals that drive and have no free number.
    drivers: HashMap<(usize, bool), Rc<Kernel>>,
    /// Weighted samples of impulses that the filter of an output gets, by output and the bits of their exponents.
    impulses: HashMap<(usize, u64), Vec<f64>>,
}

impl Shelf {
    /// One for each experiment; what is on one grid shares it.
    ///
    /// # Errors
    /// As [`Record::new`].
    pub(crate) fn of(experiments: &[Experiment]) -> Result<Vec<Self>> {
        let mut longest: Vec<usize> = (0..experiments.len()).collect();
        longest.sort_by_key(|&k| std::cmp::Reverse(experiments[k].record.m()));
        let mut grids: Vec<Rc<RefCell<Grid>>> = Vec::new();
        let mut places: Vec<(usize, Rc<RefCell<Grid>>)> = Vec::with_capacity(experiments.len());
        for k in longest {
            let grid = match grids.iter().find(|grid| grid.borrow().holds(&experiments[k])) {
                Some(known) => known.clone(),
                None => {
                    let record = &experiments[k].record;
                    let bare =
                        Record::new(record.step(), vec![vec![0.0; record.m()]], record.filter().map(<[f64]>::to_vec))?;
                    let filter = record.filter().map(|series| Rc::new(Filter::new(series)));
                    let (operators, powers) = (HashMap::new(), HashMap::new());
                    let grid = Rc::new(RefCell::new(Grid { bare, filter, runs: 0, operators, powers, solved: None }));
                    grids.push(grid.clone());
                    grid
                }
            };
            grid.borrow_mut().runs += 1;
            places.push((k, grid));
        }
        places.sort_by_key(|(k, _)| *k);
        let shelf = |(_, grid): (usize, Rc<RefCell<Grid>>)| {
            let total = FACTORS * grid.borrow().bare.m();
            Self { grid, total, drivers: HashMap::new(), impulses: HashMap::new() }
        };
        Ok(places.into_iter().map(shelf).collect())
    }

    /// Answers to the powers t^e of equations, each with `m` pulses of `n` unknowns or more.
    ///
    /// # Errors
    /// As [`Solved::natural`].
    pub(crate) fn natural(
        &self,
        solved: &Solved,
        (n, m): (usize, usize),
        terms: &[(usize, f64)],
    ) -> Result<Vec<Rc<Means>>> {
        let shared = self.shared();
        solved.natural((n, if shared { self.pulses() } else { m }), terms, shared, |exponent| self.power(exponent))
    }

    /// Pulses of the longest run on the grid.
    pub(crate) fn pulses(&self) -> usize {
        self.grid.borrow().bare.m()
    }

    /// Whether other runs are on the grid.
    fn shared(&self) -> bool {
        self.grid.borrow().runs > 1
    }

    /// The operator of a term that is integrated by `eta`; its order may be free.
    pub(crate) fn operator(&self, place: (usize, usize), eta: f64, free: bool) -> Rc<Operator> {
        let mut grid = self.grid.borrow_mut();
        if let Some(known) = grid.operators.get(&place).filter(|o| o.eta().to_bits() == eta.to_bits()) {
            return known.clone();
        }
        let (m, step) = (grid.bare.m(), grid.bare.step());
        // Terms of one order are integrated alike, whatever they are of.
        let alike = grid.operators.values().find(|o| o.serves(eta, free)).cloned();
        let made = alike.unwrap_or_else(|| Rc::new(Operator::new(eta, free, m, step)));
        grid.operators.insert(place, made.clone());
        made
    }

    /// The equations whose own terms have these bits, or what is made of them.
    ///
    /// # Errors
    /// Those of `made`.
    pub(crate) fn solved(&self, bits: Vec<u64>, made: impl FnOnce() -> Result<Solved>) -> Result<Rc<Solved>> {
        let known = self.grid.borrow().solved.as_ref().filter(|(known, _)| *known == bits).map(|(_, s)| s.clone());
        match known {
            Some(solved) => Ok(solved),
            None => {
                // What is past frees its memory before what follows takes its own.
                self.grid.borrow_mut().solved = None;
                let solved = Rc::new(made()?);
                if self.shared() {
                    self.grid.borrow_mut().solved = Some((bits, solved.clone()));
                }
                Ok(solved)
            }
        }
    }

    /// The spectrum of a signal that drives a term integrated by `eta`, for products of [`FACTORS`] series; of what an actuator makes of it.
    pub(crate) fn driver(
        &mut self,
        model: &FreeModel,
        experiment: &Experiment,
        (signal, eta): (usize, f64),
        acted: &[(Vec<f64>, Vec<f64>)],
    ) -> Rc<Kernel> {
        if let Some(law) = model.law_of(signal) {
            return self.spectrum(&acted[law].0);
        }
        let series = experiment.record.driver(signal, eta);
        if experiment.record.m() > KEPT_PULSES {
            return self.spectrum(series);
        }
        let total = self.total;
        let made = || Rc::new(Kernel::with_length(series, total));
        self.drivers.entry((signal, eta < 0.0)).or_insert_with(made).clone()
    }

    /// Of a series, for products of [`FACTORS`] of them.
    pub(crate) fn spectrum(&self, series: &[f64]) -> Rc<Kernel> {
        Rc::new(Kernel::with_length(series, self.total))
    }

    /// What an initial term t^e adds, as long as the longest run.
    pub(crate) fn power(&self, exponent: f64) -> Rc<Power> {
        let mut grid = self.grid.borrow_mut();
        // Exponents that move with free orders would fill the shelf.
        if grid.powers.len() > if grid.bare.m() > KEPT_PULSES { FEW_POWERS } else { MANY_POWERS } {
            grid.powers.clear();
        }
        if let Some(known) = grid.powers.get(&exponent.to_bits()) {
            return known.clone();
        }
        let made = Rc::new(Power::new(exponent, grid.bare.m(), grid.bare.step(), grid.filter.clone()));
        grid.powers.insert(exponent.to_bits(), made.clone());
        made
    }

    /// What the filter makes of a series that is no signal of the record.
    pub(crate) fn filtered(&self, series: &[f64]) -> Vec<f64> {
        self.grid.borrow().filter.as_ref().map_or_else(|| series.to_vec(), |filter| filter.of(series))
    }

    /// Its spectrum, for a product with one more series.
    pub(crate) fn filtered_spectrum(&self, series: &[f64]) -> Rc<Kernel> {
        Rc::new(filtered_spectrum(series, self.grid.borrow().filter.as_deref(), self.total))
    }

    /// Weighted samples of an impulse, or of a derivative of one, that only the filter of an output gets.
    pub(crate) fn impulse(&mut self, experiment: &Experiment, output: usize, exponent: f64) -> Vec<f64> {
        let made = || {
            let mut means = vec![vec![0.0; experiment.record.m()]; experiment.samples.len()];
            means[output] = experiment.record.initial_term(exponent);
            experiment.sampled(&means)
        };
        self.impulses.entry((output, exponent.to_bits())).or_insert_with(made).clone()
    }
}
