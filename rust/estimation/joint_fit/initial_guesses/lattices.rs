//! Starts from coarse lattices.

use std::collections::BTreeMap;

use super::axes::Axes;
use super::order_grid::{Coarse, Row};
use crate::error::{Error, Result};
use crate::estimation::joint_fit::attempt::Place;
use crate::estimation::joint_fit::format::short;
use crate::estimation::joint_fit::parameter_set::Free;
use crate::estimation::joint_fit::runner::Runner;
use crate::estimation::joint_fit::structure::Law;
use crate::estimation::output_error::Point;

/// Steps of the lattices on which a row is followed downhill, and how often it may move on each.
const ZOOM_STEPS: [f64; 2] = [0.1, 0.05];
const ZOOM_ROUNDS: usize = 8;
/// Rows of each prefilter's table that are looked at, all where the first few do not do, and how many of them become
/// starts: the first, then those that differ by APART in some order.
const FIRST_ROWS: usize = 25;
const ROWS_PER_FILTER: usize = 400;
const STARTS_PER_FILTER: usize = 4;
/// Ratios of a coefficient law at which a start takes one equation's coefficients from another's.
const LAW_RATIOS: [f64; 3] = [0.25, 1.0, 4.0];
/// Orders are one where they differ by less than these shares of 1 and of themselves.
const CLOSE: (f64, f64) = (1e-9, 1e-5);

/// A start.
pub(super) fn runner(orders: Vec<f64>, coefficients: Vec<f64>, origin: &str) -> Runner {
    Runner::at(Place { point: Point { orders, coefficients, inputs: Vec::new() }, states: Vec::new() }, origin)
}

/// Starts from the rows of a lattice that lie apart, the best one followed downhill; none that stood before.
pub(super) fn lattice_attempts(
    free: &Free,
    coarse: &Coarse<'_>,
    (axes, apart): &(Axes, f64),
    origin: &str,
    before: &[Runner],
) -> Result<Vec<Runner>> {
    let mut attempts: Vec<Runner> = Vec::new();
    let mut rows = LyingApart::new(free, coarse, axes, *apart);
    let mut rank = 0;
    while let Some(row) = rows.next()? {
        let start = if rank == 0 { zoom(free, coarse, row)? } else { row };
        rank += 1;
        let values = start.values(&free.orders);
        if before.iter().chain(&attempts).any(|other| close(&values, &other.attempt.place.point.orders)) {
            continue;
        }
        attempts.push(runner(values, free.free_from(&start.coefficients), origin));
        if rank >= STARTS_PER_FILTER {
            break;
        }
    }
    Ok(attempts)
}

fn close(values: &[f64], others: &[f64]) -> bool {
    values.iter().zip(others).all(|(a, b)| (a - b).abs() <= CLOSE.0 + CLOSE.1 * b.abs())
}

/// The rows of a lattice, best first, that each differ from all before in some order; many are asked for late.
struct LyingApart<'a> {
    free: &'a Free,
    coarse: &'a Coarse<'a>,
    axes: &'a Axes,
    apart: f64,
    picked: Vec<Vec<f64>>,
    rows: std::vec::IntoIter<Row>,
    seen: usize,
    /// How many are asked for next; none where no more are there.
    wanted: Vec<usize>,
}

impl<'a> LyingApart<'a> {
    fn new(free: &'a Free, coarse: &'a Coarse<'a>, axes: &'a Axes, apart: f64) -> Self {
        let (picked, rows, wanted) = (Vec::new(), Vec::new().into_iter(), vec![ROWS_PER_FILTER, FIRST_ROWS]);
        Self { free, coarse, axes, apart, picked, rows, seen: 0, wanted }
    }

    fn next(&mut self) -> Result<Option<Row>> {
        loop {
            for row in self.rows.by_ref() {
                let values = row.values(&self.free.orders);
                let distance = |p: &Vec<f64>| p.iter().zip(&values).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                if self.picked.iter().all(|p| distance(p) >= self.apart) {
                    self.picked.push(values);
                    return Ok(Some(row));
                }
            }
            let Some(keep) = self.wanted.pop() else { return Ok(None) };
            let mut rows = self.coarse.rows(&self.free.structure, self.axes, keep)?;
            let found = rows.len();
            rows.drain(..self.seen.min(found));
            (self.rows, self.seen) = (rows.into_iter(), found);
            if found < keep {
                self.wanted.clear();
            }
        }
    }
}

/// Starts with one equation's coefficients from another's by the law, the rest of it by least squares.
///
/// The hub of an arm is overdamped: current and friction nearly cancel, and what is left of the hub's acceleration is told
/// as well by the link's own equation. Freely estimated, the hub's becomes the link's, stiffness reversed.
pub(super) fn lawful_attempts(free: &Free, coarse: &Coarse<'_>, axes: &Axes, origin: &str) -> Result<Vec<Runner>> {
    let (structure, signs) = (&free.structure, &free.structure.hints.positive);
    let tied: Vec<(&Law, &String, usize)> = (free.products.iter())
        .filter_map(|law| law.factors.split_first().map(|(first, others)| (law, first, others.len())))
        .filter(|(_, first, _)| signs.contains(*first))
        .collect();
    if tied.is_empty() {
        return Ok(Vec::new());
    }
    let named = structure.coefficient_names();
    let mut attempts = Vec::new();
    for row in coarse.rows(structure, axes, STARTS_PER_FILTER)? {
        let point: Axes = row.orders.iter().map(|(name, value)| (name.clone(), vec![*value])).collect();
        for ratio in LAW_RATIOS {
            let value = |(law, first, others): &(&Law, &String, usize)| {
                let size = row.coefficients.get(&law.name).copied().unwrap_or(f64::NAN).abs();
                ((*first).clone(), (0..*others).fold(size, |size, _| size / ratio))
            };
            let known: BTreeMap<String, f64> = tied.iter().map(value).collect();
            if !known.values().all(|v| v.is_finite() && *v != 0.0) {
                continue;
            }
            if let Some(lost) = known.keys().find(|name| !named.contains(name)) {
                let what = format!("no free coefficient {lost}");
                return Err(Error::Structure { what, remedy: "name one of the equations'".into() });
            }
            for rest in coarse.rows(&structure.with_coefficients(&known), &point, 1)? {
                let found = |name: &String| known.get(name).or(rest.coefficients.get(name)).copied().unwrap_or(ratio);
                let coefficients = free.coefficients.iter().map(found).collect();
                let words = format!("{origin}, by the law at {}", short(ratio, 6));
                attempts.push(runner(row.values(&free.orders), coefficients, &words));
            }
        }
    }
    Ok(attempts)
}

/// Follow a row downhill on ever finer lattices around it.
fn zoom(free: &Free, coarse: &Coarse<'_>, mut row: Row) -> Result<Row> {
    if row.orders.is_empty() {
        return Ok(row);
    }
    for step in ZOOM_STEPS {
        for _ in 0..ZOOM_ROUNDS {
            let axis = |(name, value): &(String, f64)| {
                let place = free.orders.iter().position(|n| n == name);
                let (low, high) = place.map_or((*value, *value), |at| free.bounds()[at]);
                let around = [value - step, *value, value + step];
                let mut values: Vec<f64> = around.iter().map(|v| to_nine(v.max(low).min(high))).collect();
                values.sort_by(f64::total_cmp);
                values.dedup();
                (name.clone(), values)
            };
            let axes: Axes = row.orders.iter().map(axis).collect();
            let found = coarse.rows(&free.structure, &axes, 1)?.into_iter().next();
            match found {
                Some(best) if !best.is_at(&row) => row = best,
                _ => break,
            }
        }
    }
    Ok(row)
}

/// A number to nine decimals, the nearest of them that there is.
fn to_nine(value: f64) -> f64 {
    format!("{value:.9}").parse().unwrap_or(value)
}
