//! Rows of coarse lattices.

use std::collections::BTreeMap;

use super::axes::{values, Axes};
use super::parts::parts;
use crate::equation::Initial;
use crate::error::{Error, Result};
use crate::estimation::joint_fit::order::Order;
use crate::estimation::joint_fit::structure::{Equation, Structure, Term};
use crate::order_search::batches;
use crate::order_search::control::Control;
use crate::order_search::grid::{Lattice, LawEquation, LawLattice, TermAxis};
use crate::order_search::options::Options;
use crate::order_search::stage_join;
use crate::regressors::Record;
use crate::signal::statistics::mean;
use crate::stop::Stop;

/// A row of a lattice: its orders, and the coefficients freely estimated there, by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Row {
    /// Orders, in the order of their axes.
    pub orders: Vec<(String, f64)>,
    /// Coefficients.
    pub coefficients: BTreeMap<String, f64>,
}

impl Row {
    /// Values of these orders.
    pub(super) fn values(&self, names: &[String]) -> Vec<f64> {
        let value = |name: &String| self.orders.iter().find(|(n, _)| n == name).map_or(f64::NAN, |(_, value)| *value);
        names.iter().map(value).collect()
    }

    /// Whether another one has the same orders, in whatever order they stand.
    pub(super) fn is_at(&self, other: &Self) -> bool {
        self.orders.len() == other.orders.len() && self.orders.iter().all(|pair| other.orders.contains(pair))
    }

    /// Takes in the orders and coefficients of another one.
    fn take(&mut self, other: &Self) {
        for (name, value) in &other.orders {
            match self.orders.iter_mut().find(|(n, _)| n == name) {
                Some((_, here)) => *here = *value,
                None => self.orders.push((name.clone(), *value)),
            }
        }
        self.coefficients.extend(other.coefficients.iter().map(|(name, value)| (name.clone(), *value)));
    }
}

/// How coarse lattices are searched: by least squares, in time, on so many threads, within so many bytes.
#[derive(Clone, Copy)]
pub(super) struct Coarse<'a> {
    /// What they are searched on.
    pub records: &'a [Record],
    /// Which signals are inputs.
    pub inputs: &'a [bool],
    /// Initial terms of each record.
    pub initial: &'a Initial,
    /// Threads.
    pub threads: usize,
    /// Bytes.
    pub memory: u64,
    /// Ends a search.
    pub stop: &'a Stop,
}

impl Coarse<'_> {
    /// The same on other records.
    pub(super) fn on<'b>(&'b self, records: &'b [Record]) -> Coarse<'b> {
        Coarse { records, ..*self }
    }

    /// So many best rows of a coarse lattice, by least squares.
    pub(super) fn rows(&self, structure: &Structure, axes: &Axes, keep: usize) -> Result<Vec<Row>> {
        if !structure.has_order_law() {
            let tables: Result<Vec<_>> =
                structure.equations.iter().map(|e| self.of_equation(structure, e, axes, keep)).collect();
            return Ok(side_by_side(&tables?, structure));
        }
        let stages = parts(structure);
        if stages.len() <= 1 {
            return self.of_stage(structure, axes, keep);
        }
        // Stages that share no order are searched one by one; the best of each belong together.
        let table = |stage: &Structure| {
            let names = stage.order_names();
            let own: Axes = axes.iter().filter(|(name, _)| names.contains(name)).cloned().collect();
            self.rows(stage, &own, keep)
        };
        Ok(side_by_side(&stages.iter().map(table).collect::<Result<Vec<_>>>()?, structure))
    }

    fn options(&self, keep: usize) -> Options {
        let (initial, threads, memory) = (self.initial.clone(), self.threads, self.memory);
        Options { initial, keep, threads, memory, ..Options::default() }
    }

    fn control(&self) -> Control {
        Control { stop: self.stop.clone(), ..Control::default() }
    }

    /// Best rows of equations under their order law.
    #[allow(clippy::cast_precision_loss)]
    fn of_stage(&self, structure: &Structure, axes: &Axes, keep: usize) -> Result<Vec<Row>> {
        let (names, along): (Vec<String>, Vec<Vec<f64>>) = axes.iter().cloned().unzip();
        let law = |e: &Equation| LawEquation {
            output: e.output,
            order: e.order.affine(&names),
            terms: e.terms.iter().map(|t| (t.signal, t.order.affine(&names))).collect(),
        };
        let equations = &structure.equations;
        let laws: Vec<LawEquation> = equations.iter().map(law).collect();
        let fixed: Vec<Vec<Option<f64>>> = equations.iter().map(known).collect();
        let size = |e: &Equation| self.records.iter().map(|r| deviation(r.signal(e.output)) * r.m() as f64).sum();
        let scales: Vec<f64> = equations.iter().map(size).collect();
        let lattice = LawLattice::new(&along, &laws, self.inputs)?.with_known(&fixed);
        let found = stage_join::search(self.records, &lattice, &fixed, &scales, &self.options(keep), &self.control())?;
        let row = |found: stage_join::StageRow| {
            let pairs = equations.iter().zip(&found.rows);
            let coefficients = pairs.flat_map(|(item, part)| named_coefficients(item, &part.coefficients)).collect();
            Row { orders: names.iter().cloned().zip(found.free).collect(), coefficients }
        };
        Ok(found.rows.into_iter().map(row).collect())
    }

    /// Best rows of one equation whose orders are free by themselves.
    fn of_equation(&self, structure: &Structure, item: &Equation, axes: &Axes, keep: usize) -> Result<Vec<Row>> {
        check_linear(structure, item, "an order search")?;
        let axis = |order: &Order| match order.names().next() {
            Some(name) => values(axes, name).to_vec(),
            None => vec![order.constant],
        };
        let term = |t: &Term| TermAxis {
            signal: t.signal,
            values: axis(&t.order),
            interchangeable: t.order.is_free() && t.fixed().is_none(),
        };
        let terms: Vec<TermAxis> = item.terms.iter().map(term).collect();
        let is_input = |signal: usize| self.inputs.get(signal).copied().unwrap_or(false);
        let named = |error| named_signals(error, &structure.signals);
        let lattice = Lattice::new(item.output, &axis(&item.order), &terms, is_input).map_err(named)?;
        let (options, control) = (self.options(keep), self.control());
        let found = batches::search(self.records, &lattice, &known(item), &options, &control).map_err(named)?;
        let row = |found: crate::order_search::result::Row| {
            let at = lattice.structure(found.index);
            let there = std::iter::once(at.order).chain(at.terms.iter().map(|term| term.order));
            let pairs = item.orders().zip(there);
            let orders = pairs.filter_map(|(order, value)| Some((order.names().next()?.clone(), value))).collect();
            Row { orders, coefficients: named_coefficients(item, &found.coefficients).collect() }
        };
        Ok(found.rows.into_iter().map(row).collect())
    }
}

/// Rows of independent tables side by side, rank by rank; a table that ends goes on with its last row.
pub(super) fn side_by_side(tables: &[Vec<Row>], structure: &Structure) -> Vec<Row> {
    let wanted = structure.coefficient_names().len();
    let merged = |rank: usize| {
        let mut merged = Row::default();
        tables.iter().filter_map(|table| table.get(rank).or(table.last())).for_each(|row| merged.take(row));
        merged
    };
    let ranks = tables.iter().map(Vec::len).max().unwrap_or(0);
    (0..ranks).map(merged).filter(|row| row.coefficients.len() == wanted).collect()
}

/// Free coefficients by name from the core's products of factor and coefficient.
pub(super) fn named_coefficients<'a>(item: &'a Equation, raw: &'a [f64]) -> impl Iterator<Item = (String, f64)> + 'a {
    let pairs = item.terms.iter().zip(raw);
    pairs.filter_map(|(term, c)| Some((term.coefficient.name()?.clone(), c / term.factor)))
}

/// Products of factor and coefficient where they are known.
pub(super) fn known(item: &Equation) -> Vec<Option<f64>> {
    item.terms.iter().map(Term::fixed).collect()
}

/// Refuses friction where nothing knows it.
pub(super) fn check_linear(structure: &Structure, item: &Equation, what: &str) -> Result<()> {
    if item.friction.is_none() {
        return Ok(());
    }
    let output = &structure.signals[item.output];
    Err(Error::Structure {
        what: format!("the equation of {output} has friction, which {what} does not know"),
        remedy: "use free runs, or leave the friction out".into(),
    })
}

/// The core knows signals by number; people know them by name.
fn named_signals(error: Error, signals: &[String]) -> Error {
    let named = |mut text: String| {
        // From the last on, so that no number is the beginning of another.
        for (i, signal) in signals.iter().enumerate().rev() {
            text = text.replace(&format!("signal {i}"), &format!("signal '{signal}'"));
        }
        text
    };
    match error {
        Error::EmptyLattice { why } => Error::EmptyLattice { why: named(why) },
        Error::Structure { what, remedy } => Error::Structure { what: named(what), remedy },
        other => other,
    }
}

/// Standard deviation of values.
fn deviation(values: &[f64]) -> f64 {
    let centre = mean(values);
    let squares: Vec<f64> = values.iter().map(|v| (v - centre) * (v - centre)).collect();
    mean(&squares).sqrt()
}
