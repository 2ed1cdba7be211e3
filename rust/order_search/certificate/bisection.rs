//! Bisection of the cells (boxes of orders) of a region. It ends when no cell can contain orders whose equation error
//! is far below the smallest error found.

use std::sync::atomic::Ordering;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::order_search::certificate::cell_bound::{check_records, expand_cell, CellBound};
use crate::order_search::certificate::gram_tables::{cell_width, Cell, GramTables, Region, MAX_CELL_LEVEL};
use crate::order_search::certificate::regressor_expansion::MAX_TERMS;
use crate::order_search::control::Control;
use crate::parallel::pool;
use crate::regressors::Record;

/// Number of cells (boxes of orders) whose bounds one parallel task computes.
const CELLS_PER_TASK: usize = 256;
/// Number of cells (boxes of orders) whose bounds are computed between two updates of the best orders.
const CELLS_PER_PASS: usize = 1 << 16;
/// Memory per cell (box of orders) during the bisection \[bytes\].
const CELL_MEMORY_BYTES: u64 = 4 * size_of::<Cell>() as u64;

/// Maximum number of evaluations of one local search from the best orders.
const MAX_POLISH_EVALUATIONS: usize = 400;
/// Number of cell midpoints per pass that are evaluated as candidates for the best orders.
const MIDPOINTS_PER_PASS: usize = 4;

/// Options of a certificate, a proved lower bound of the equation error over a region of orders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CertificateOptions {
    /// Relative tolerance. The certificate is complete if no orders have an error below (1 − tolerance) times the best
    /// error found.
    pub tolerance: f64,
    /// Largest admissible sum of the norms of the terms, relative to the norm of the output y: Σ‖c x‖ ≤
    /// `max_coefficient`·‖y‖ with coefficients c and columns x.
    pub max_coefficient: f64,
    /// Maximum number of cells (boxes of orders). If it is reached, the bisection ends with the lower bound proved so
    /// far.
    pub max_cells: u64,
    /// Number of threads.
    pub threads: usize,
    /// Memory limit of a certificate \[bytes\].
    pub memory: u64,
}

/// Lower bound of the equation error over all orders of a region.
#[derive(Debug, Clone, PartialEq)]
pub struct Certificate {
    /// Lower bound of the root mean square of the equation error, 0 without a proof. It holds for all orders of the
    /// region and all admissible coefficients.
    pub lower_bound: f64,
    /// Smallest root mean square of the equation error found, infinite if none was found.
    pub best: f64,
    /// Order α of the equation with the error `best`. NaN if no such equation was found.
    pub order: f64,
    /// Orders ν of the terms of that equation, empty if none was found.
    pub orders: Vec<f64>,
    /// Number of cells (boxes of orders) for which a bound was computed.
    pub cells: u64,
    /// Number of open cells (boxes of orders), whose bound is too small. They are at the finest level, or the maximum
    /// number of cells is reached.
    pub open_cells: u64,
}

/// Compute a lower bound of the equation error that holds for all orders of a region. The coefficients are optimal for
/// each order. Equations whose terms nearly cancel are not covered ([`CertificateOptions::max_coefficient`]).
///
/// The result is bitwise identical for any number of threads.
///
/// # Errors
/// A region without orders, records that lack a signal of the region, an option out of range, too many cells (boxes of
/// orders), or too little memory. [`Error::Interrupted`] after a stop request.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::order_search::certificate::{certify, CertificateOptions, Range, Region};
/// # use ftlm::order_search::control::Control;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output: Vec<f64> = Record::new(0.1, PulseMeans::from_signals(vec![input.clone()]), None)?.integral(0, 0.83);
/// # let output = output.iter().enumerate().map(|(k, y)| y + 0.01 * f64::from((k * k % 7) as u32)).collect();
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![output, input]), None)?;
/// // y is nearly the integral of order 0.83 of u.
/// let region = Region {
///     output: 0,
///     alpha: (0.5, 1.5),
///     terms: vec![Range { signal: 1, lowest: 0.0, highest: 0.0 }],
///     min_separation: 0.05,
/// };
/// let (tolerance, max_coefficient, max_cells) = (0.05, 1e3, 1_000_000);
/// let options = CertificateOptions { tolerance, max_coefficient, max_cells, threads: 1, memory: 1 << 28 };
/// let found = certify(&[record], &region, &options, &Control::default())?;
/// assert!((found.order - 0.83).abs() < 0.02 && found.open_cells == 0);
/// assert!(0.95 * found.best <= found.lower_bound && found.lower_bound <= found.best);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn certify(
    records: &[Record],
    region: &Region,
    options: &CertificateOptions,
    control: &Control,
) -> Result<Certificate> {
    check_records(records, region.output, region.terms.iter().map(|t| t.signal))?;
    region.check()?;
    if !(options.tolerance > 0.0 && options.tolerance < 1.0) {
        return Err(Error::OutOfRange {
            name: "tolerance".into(),
            value: options.tolerance,
            range: "(0, 1)".into(),
            remedy: "a tolerance of 0.05 requires a proof that no orders reduce the error by more than 5 %".into(),
        });
    }
    if !(options.max_coefficient >= 1.0 && options.max_coefficient <= 1e9) {
        return Err(Error::OutOfRange {
            name: "max_coefficient".into(),
            value: options.max_coefficient,
            range: "[1, 1e9]".into(),
            remedy: "a limit of 100 excludes terms that cancel to 1 % of their size".into(),
        });
    }
    let pool = pool(options.threads)?;
    pool.install(|| {
        let tables = GramTables::new(records, region, options.memory, control)?;
        CellBisection { tables, region, options, control }.run(records)
    })
}

/// State of the bisection of the cells (boxes of orders) of a region.
struct CellBisection<'a> {
    tables: GramTables,
    region: &'a Region,
    options: &'a CertificateOptions,
    control: &'a Control,
}

impl CellBisection<'_> {
    /// Bisect the cells (boxes of orders) of the region, and return the certificate.
    fn run(&self, records: &[Record]) -> Result<Certificate> {
        let mut cells = self.initial_cells()?;
        if cells.is_empty() {
            return Err(Error::EmptyOrderGrid {
                reason: format!(
                    "no orders in these intervals differ by {} or more from alpha and from each other",
                    self.region.min_separation
                ),
            });
        }
        let (mut best, mut best_point) = (f64::INFINITY, Vec::new());
        let (mut lower_bound, mut cell_count, mut open_count) = (f64::INFINITY, 0_u64, 0_u64);
        let target = |best: f64| (1.0 - self.options.tolerance).powi(2) * best;
        let max_cells =
            self.options.max_cells.min(self.options.memory.saturating_sub(self.tables.bytes) / CELL_MEMORY_BYTES);
        // Good initial orders save bisections.
        for cells in cells.chunks(CELLS_PER_PASS) {
            let bounds = self.bounds(cells, 0.0)?;
            self.update_best(records, (cells, &bounds), &mut best, &mut best_point)?;
        }
        self.polish(records, &mut best, &mut best_point)?;
        while !cells.is_empty() {
            if cell_count + cells.len() as u64 > max_cells {
                open_count += cells.len() as u64;
                lower_bound = cells.iter().fold(lower_bound, |bound, cell| bound.min(cell.inherited_bound));
                break;
            }
            // The total is the number of cells known so far. Halves of these cells are added later.
            self.control.total.store(cell_count + cells.len() as u64, Ordering::Relaxed);
            let mut next = Vec::new();
            for cells in cells.chunks(CELLS_PER_PASS) {
                let bounds = self.bounds(cells, target(best))?;
                self.control.count(cells.len() as u64, 0);
                self.update_best(records, (cells, &bounds), &mut best, &mut best_point)?;
                let target_bound = target(best);
                for (cell, bounds) in cells.iter().zip(&bounds) {
                    let bound = bounds.lower_bound.max(cell.inherited_bound);
                    if bound >= target_bound {
                        lower_bound = lower_bound.min(bound);
                    } else if let Some(halves) = self.halve_cell(cell, bound, &bounds.costs) {
                        next.extend(halves.into_iter().flatten());
                    } else {
                        open_count += 1;
                        lower_bound = lower_bound.min(bound);
                    }
                }
            }
            cell_count += cells.len() as u64;
            cells = next;
        }
        self.polish(records, &mut best, &mut best_point)?;
        #[allow(clippy::cast_precision_loss)]
        let mean = {
            let squares: f64 = records.iter().flat_map(|r| r.signal(self.region.output)).map(|y| y * y).sum();
            squares / records.iter().map(Record::m).sum::<usize>() as f64
        };
        // Without a point whose error is finite, `best_point` is empty and there is no order.
        let best_orders = if best.is_finite() { self.region.orders(&best_point) } else { None };
        let (order, orders) = best_orders.unwrap_or((f64::NAN, Vec::new()));
        let root = |mean_bound: f64| if mean_bound.is_finite() { (mean_bound * mean).sqrt() } else { f64::INFINITY };
        let lower_bound = if lower_bound.is_finite() { root(lower_bound) * (1.0 - 1e-9) } else { 0.0 };
        Ok(Certificate { lower_bound, best: root(best), order, orders, cells: cell_count, open_cells: open_count })
    }

    /// Compute the bounds of some cells, relative to the squared norm of the output. `target_bound` is the bound at
    /// which a cell (box of orders) is excluded.
    fn bounds(&self, cells: &[Cell], target_bound: f64) -> Result<Vec<CellBound>> {
        let bounds = |chunk: &'_ [Cell]| -> Vec<CellBound> {
            let all = chunk.iter().take(if self.control.is_stopped() { 0 } else { CELLS_PER_TASK });
            all.map(|cell| self.bound(cell, target_bound)).collect()
        };
        let cell_bounds = cells.par_chunks(CELLS_PER_TASK).flat_map_iter(bounds).collect();
        self.control.check_stop()?;
        Ok(cell_bounds)
    }

    /// Evaluate the equation at the midpoints of the best of these cells (boxes of orders). If the relative squared
    /// residual there is below `best`, store it in `best` and the orders of integration in `best_point`.
    fn update_best(
        &self,
        records: &[Record],
        (cells, bounds): (&[Cell], &[CellBound]),
        best: &mut f64,
        best_point: &mut Vec<f64>,
    ) -> Result<()> {
        let mut candidates: Vec<usize> = (0..cells.len()).filter(|&n| bounds[n].midpoint_residual < *best).collect();
        candidates
            .sort_by(|&a, &b| bounds[a].midpoint_residual.total_cmp(&bounds[b].midpoint_residual).then(a.cmp(&b)));
        for n in candidates.into_iter().take(MIDPOINTS_PER_PASS) {
            let Some(orders) = self.region.midpoint_orders(&self.cell_intervals(&cells[n])) else { continue };
            let residual = self.relative_residual(records, &orders)?;
            if residual < *best {
                (*best, *best_point) = (residual, orders);
            }
        }
        Ok(())
    }

    /// Compute the bounds of one cell, relative to the squared norm of the output. The subspace bound is also computed
    /// if the first bound is below `target_bound`.
    fn bound(&self, cell: &Cell, target_bound: f64) -> CellBound {
        let mut cell_bound = self.tables.local(cell).bound();
        if cell_bound.lower_bound.max(cell.inherited_bound) < target_bound {
            cell_bound.lower_bound =
                cell_bound.lower_bound.max(self.tables.span(cell).bound(self.options.max_coefficient, target_bound));
        }
        cell_bound
    }

    /// Compute the squared residual at these orders of integration without tables, relative to the squared norm of the
    /// output.
    fn relative_residual(&self, records: &[Record], etas: &[f64]) -> Result<f64> {
        let terms = self.region.terms.iter().zip(etas).map(|(term, eta)| (term.signal, *eta, 0.0));
        Ok(expand_cell(records, self.region.output, &terms.collect::<Vec<_>>(), &self.control.stop)?
            .0
            .bound()
            .midpoint_residual)
    }

    /// Refine the best orders of integration `best_point` by a local search, which changes one or two orders at a time.
    /// It also reaches the edges of the region, where no cell has its midpoint.
    fn polish(&self, records: &[Record], best: &mut f64, best_point: &mut Vec<f64>) -> Result<()> {
        if best_point.is_empty() {
            return Ok(());
        }
        // The order α of the equation comes last.
        let k = best_point.len();
        let varying: Vec<usize> = (0..k)
            .filter(|&term| self.region.terms[term].lowest < self.region.terms[term].highest)
            .chain((self.region.alpha.0 < self.region.alpha.1).then_some(k))
            .collect();
        let directions = [-1.0, 0.0, 1.0];
        let pairs = varying.iter().enumerate().flat_map(|(n, &i)| varying[n..].iter().map(move |&j| (i, j)));
        let moves: Vec<[(usize, f64); 2]> = pairs
            .flat_map(|(i, j)| {
                directions.into_iter().flat_map(move |a| directions.into_iter().map(move |b| [(i, a), (j, b)]))
            })
            .filter(|[(i, a), (j, b)]| *a != 0.0 && (i == j) == (*b == 0.0))
            .collect();
        let (mut step, mut evaluations) = (cell_width(1), 0);
        while step > cell_width(MAX_CELL_LEVEL) && evaluations < MAX_POLISH_EVALUATIONS {
            let before = *best;
            for moves in &moves {
                self.control.check_stop()?;
                let Some((alpha, mut orders)) = self.region.orders(best_point) else { return Ok(()) };
                orders.push(alpha);
                moves.iter().for_each(|(term, direction)| orders[*term] += direction * step);
                let Some(candidate) =
                    self.region.of_orders(orders[k], &orders[..k]).filter(|candidate| candidate != best_point)
                else {
                    continue;
                };
                evaluations += 1;
                let residual = self.relative_residual(records, &candidate)?;
                if residual < *best {
                    (*best, *best_point) = (residual, candidate);
                }
            }
            if *best >= before {
                step /= 2.0;
            }
        }
        Ok(())
    }

    /// Return the interval of orders of integration of each term in a cell (box of orders).
    fn cell_intervals(&self, cell: &Cell) -> Vec<(f64, f64)> {
        (0..self.region.terms.len()).map(|term| self.tables.order_interval(self.region, cell, term)).collect()
    }

    /// Return true if a cell (box of orders) contains orders of the region.
    fn holds_orders(&self, cell: &Cell) -> bool {
        self.region.alpha_interval(&self.cell_intervals(cell)).is_some()
    }

    /// Return the largest cells that contain orders of the region.
    ///
    /// # Errors
    /// [`Error::Structure`] if there are more than four times the maximum number of cells (boxes of orders).
    fn initial_cells(&self) -> Result<Vec<Cell>> {
        let mut cells = vec![Cell { level: [0; MAX_TERMS], position: [0; MAX_TERMS], inherited_bound: 0.0 }];
        for term in 0..self.region.terms.len() {
            let (first, count) = self.tables.initial_intervals(self.region, term);
            let all = cells.len() as u128 * count as u128;
            if all > 4 * u128::from(self.options.max_cells) {
                return Err(Error::Structure {
                    what: format!(
                        "these intervals hold up to {all} cells of orders, but {} are allowed",
                        self.options.max_cells
                    ),
                    remedy: "narrow the intervals of the orders, or allow more cells".into(),
                });
            }
            let mut next = Vec::new();
            for cell in &cells {
                for position in first..first + count {
                    let mut cell = *cell;
                    cell.position[term] = u32::try_from(position).unwrap_or(u32::MAX);
                    let intervals: Vec<(f64, f64)> =
                        (0..=term).map(|t| self.tables.order_interval(self.region, &cell, t)).collect();
                    if self.region.alpha_interval(&intervals).is_some() {
                        next.push(cell);
                    }
                }
            }
            cells = next;
        }
        Ok(cells)
    }

    /// Halve a cell (box of orders) along the order with the largest cost, and return the halves that contain orders of
    /// the region. `None` if all orders are fixed or at the finest level.
    fn halve_cell(&self, cell: &Cell, lower_bound: f64, costs: &[f64; MAX_TERMS]) -> Option<[Option<Cell>; 2]> {
        let divisible = (0..self.region.terms.len())
            .filter(|&term| !self.tables.has_fixed_order(term) && cell.level[term] < MAX_CELL_LEVEL);
        let term = divisible.max_by(|&a, &b| costs[a].total_cmp(&costs[b]).then(b.cmp(&a)))?;
        Some([0, 1].map(|half| {
            let mut part = Cell { inherited_bound: lower_bound, ..*cell };
            part.level[term] += 1;
            part.position[term] = 2 * part.position[term] + half;
            self.holds_orders(&part).then_some(part)
        }))
    }
}
