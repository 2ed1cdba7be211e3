//! Inner products for a certificate, computed once for the midpoints of all cells. Also the region of orders and its
//! cells (boxes of orders).

use std::collections::BTreeMap;

use crate::error::{Error, Result};
use crate::linalg::dense::inner_products;
use crate::order_search::certificate::cell_bound::CellProducts;
use crate::order_search::certificate::regressor_expansion::{RegressorExpansion, EXPANSION_COLUMNS, MAX_TERMS};
use crate::order_search::certificate::subspace_bound::DerivativeSubspace;
use crate::order_search::control::Control;
use crate::parallel;
use crate::regressors::Record;

/// Width of the largest cells in each order. A bound over wider cells rarely exceeds 0.
const MAX_CELL_WIDTH: f64 = 0.1;
/// Maximum bisection level for which inner products are stored. For deeper cells (boxes of orders), up to
/// [`MAX_CELL_LEVEL`], they are expanded about the midpoints of this level.
const MAX_TABLE_LEVEL: u8 = 3;
/// Maximum bisection level of a cell (box of orders).
pub(super) const MAX_CELL_LEVEL: u8 = 10;
/// Orders of the pairs of derivatives whose products are stored, in the sequence of [`pair_position`].
const DERIVATIVE_PAIRS: [(usize, usize); EXPANSION_COLUMNS * (EXPANSION_COLUMNS + 1) / 2] =
    [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3)];
/// Number of columns per parallel task whose products with all columns are computed.
const COLUMNS_PER_TASK: usize = 64;

/// Cell of the bisection: an interval of orders of integration for each term.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cell {
    /// Bisection level of the interval of each term.
    pub(super) level: [u8; MAX_TERMS],
    /// Index of the interval of each term. The interval starts at this index times the interval width of its level.
    pub(super) position: [u32; MAX_TERMS],
    /// Lower bound of the relative squared residual that was proved for the parent cell.
    pub(super) inherited_bound: f64,
}

/// Intervals of the orders of integration of one signal, by bisection level: index of the first interval, and index of
/// the midpoint (node) of that interval.
type LevelIntervals = Vec<(usize, usize)>;

/// Tables of inner products for the bounds of cells (boxes of orders). A node is the midpoint of an interval of orders
/// of integration of one signal.
pub(super) struct GramTables {
    /// Intervals of orders of integration of each term, and index of its node. The intervals are None for a term of
    /// fixed order, and the index is unused for other terms.
    terms: Vec<(Option<LevelIntervals>, usize)>,
    /// Highest bisection level of intervals with stored inner products.
    table_level: u8,
    /// Memory of the tables \[bytes\].
    pub(super) bytes: u64,
    /// Number of nodes: orders of integration with stored inner products.
    nodes: usize,
    /// Total number of samples of all records.
    samples: usize,
    /// Products x_i⁽ⁿ⁾·x_j⁽ᵐ⁾ of the derivatives of orders n and m of the columns at nodes i and j. The entries are
    /// sorted by the pair (n, m) of [`DERIVATIVE_PAIRS`], then by j, then by i.
    products: [Vec<f64>; DERIVATIVE_PAIRS.len()],
    /// Inner products of the measured output, scaled to unit norm, with the regressor columns and their derivatives
    /// with respect to the order. The entries are sorted by derivative, then by node.
    target: [Vec<f64>; EXPANSION_COLUMNS],
    /// Upper bounds of the norms of a regressor column and its derivatives with respect to the order. There is one
    /// array per node.
    sizes: Vec<[f64; EXPANSION_COLUMNS]>,
    /// For each node, an upper bound of the remainder of the Taylor series of a regressor column in its order. A node
    /// is an order about which columns are expanded.
    remainder_bounds: Vec<f64>,
}

/// Distance from an interval, relative to its width, up to which orders belong to it. It is above the rounding error.
const TOUCHING_TOLERANCE: f64 = 1e-6;

/// Return the position of the pair (n, m), n ≤ m, in [`DERIVATIVE_PAIRS`].
fn pair_position(n: usize, m: usize) -> usize {
    m * (m + 1) / 2 + n
}

/// Midpoint of a cell (box of orders) for one term. A node is an order of integration with stored inner products.
#[derive(Debug, Clone, Copy, Default)]
struct Middle {
    /// Index of the node about which inner products are expanded.
    node: usize,
    /// Powers of the distance of the midpoint from the node, divided by factorials, from power 0 on.
    taylor_powers: [f64; EXPANSION_COLUMNS],
    /// Half width of the interval of orders of integration.
    half: f64,
}

/// Return the width of an interval of orders at this bisection level.
pub(super) fn cell_width(level: u8) -> f64 {
    MAX_CELL_WIDTH / f64::from(1_u32 << level)
}

/// Return the intervals of a bisection level that contain or touch orders in this range: the index of the first
/// interval, and their count.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn level_intervals((low, high): (f64, f64), level: u8) -> (usize, usize) {
    let first = (low / cell_width(level) - TOUCHING_TOLERANCE).floor().max(0.0) as usize;
    let end = (high / cell_width(level) + TOUCHING_TOLERANCE).ceil().max(0.0) as usize;
    (first, end.max(first + 1) - first)
}

/// Nodes of all signals. A node is the midpoint of an interval of orders of integration of one signal.
struct NodeLayout {
    /// Signal, order of integration at the midpoint, and half width of each node.
    nodes: Vec<(usize, f64, f64)>,
    /// Intervals of orders of integration of each term, and index of its node. The intervals are None for a term of
    /// fixed order, and the index is unused for other terms.
    terms: Vec<(Option<LevelIntervals>, usize)>,
}

/// Return the nodes of a region, for bisection levels up to `deepest`.
#[allow(clippy::cast_precision_loss)]
fn lay_out_nodes(region: &Region, deepest: u8) -> NodeLayout {
    let mut nodes = Vec::new();
    let mut ranges: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
    let is_point = |(low, high): (f64, f64)| high - low < 1e-12;
    for (term, range) in region.terms.iter().enumerate() {
        let (low, high) = region.integrations(term);
        if !is_point((low, high)) {
            let all = ranges.entry(range.signal).or_insert((low, high));
            *all = (all.0.min(low), all.1.max(high));
        }
    }
    let mut intervals_of_level: BTreeMap<usize, LevelIntervals> = BTreeMap::new();
    for (&signal, &range) in &ranges {
        for level in 0..=deepest {
            let (first, count) = level_intervals(range, level);
            intervals_of_level.entry(signal).or_default().push((first, nodes.len()));
            let half = cell_width(level) / 2.0;
            nodes.extend((first..first + count).map(|i| (signal, (2 * i + 1) as f64 * half, half)));
        }
    }
    let mut terms = Vec::new();
    for (term, range) in region.terms.iter().enumerate() {
        let integrations = region.integrations(term);
        if is_point(integrations) {
            nodes.push((range.signal, integrations.1, 0.0));
            terms.push((None, nodes.len() - 1));
        } else {
            terms.push((intervals_of_level.get(&range.signal).cloned(), 0));
        }
    }
    NodeLayout { nodes, terms }
}

/// Return the memory of the regressors, their derivatives and all inner products for this number of nodes \[bytes\].
fn bytes(nodes: usize, samples: usize) -> u64 {
    8 * nodes as u64 * (DERIVATIVE_PAIRS.len() * nodes + 2 * EXPANSION_COLUMNS * samples) as u64
}

impl GramTables {
    /// Build the tables to the deepest bisection level that `memory` \[bytes\] allows. Runs on the current thread pool.
    ///
    /// # Errors
    /// [`Error::Memory`] if even the tables to level 2 need too much memory, [`Error::Interrupted`] after a stop
    /// request. [`Error::Structure`] for a signal that is zero or overflows.
    pub(super) fn new(records: &[Record], region: &Region, memory: u64, control: &Control) -> Result<Self> {
        let target: Vec<f64> = records.iter().flat_map(|r| r.signal(region.output)).copied().collect();
        let samples = target.len();
        let fits_memory = |deepest: u8| bytes(lay_out_nodes(region, deepest).nodes.len(), samples) <= memory;
        let Some(tabled) = (2..=MAX_TABLE_LEVEL).rev().find(|d| fits_memory(*d)) else {
            let (bytes, limit) = (bytes(lay_out_nodes(region, 2).nodes.len(), samples).into(), memory.into());
            return Err(Error::Memory {
                what: "the regressors of a certificate and their inner products".into(),
                bytes,
                limit,
            });
        };
        let NodeLayout { nodes, terms } = lay_out_nodes(region, tabled);
        let curves: Vec<Result<RegressorExpansion>> = parallel::map(
            nodes.clone(),
            || (),
            |(), (signal, middle, half)| RegressorExpansion::new(records, signal, middle, half, &control.stop),
        );
        let curves = curves.into_iter().collect::<Result<Vec<RegressorExpansion>>>()?;
        let size = target.iter().map(|v| v * v).sum::<f64>().sqrt();
        let count = nodes.len();
        let all: [Vec<&[f64]>; EXPANSION_COLUMNS] =
            std::array::from_fn(|n| curves.iter().map(|c| &c.columns[n][..]).collect());
        let batches: Vec<(usize, &[RegressorExpansion])> = (0..DERIVATIVE_PAIRS.len())
            .flat_map(|pair| curves.chunks(COLUMNS_PER_TASK).map(move |batch| (pair, batch)))
            .collect();
        let pair_products = parallel::map(
            batches,
            || (),
            |(), (pair, batch)| {
                let (n, m) = DERIVATIVE_PAIRS[pair];
                if control.is_stopped() {
                    return (pair, Vec::new(), Vec::new());
                }
                let columns: Vec<&[f64]> = batch.iter().map(|c| &c.columns[m][..]).collect();
                let target_products =
                    if n == 0 { inner_products(&columns, &[&target], &control.stop) } else { Vec::new() };
                (pair, inner_products(&columns, &all[n], &control.stop), target_products)
            },
        );
        control.check_stop()?;
        let (mut products, mut target_products): ([Vec<f64>; DERIVATIVE_PAIRS.len()], [Vec<f64>; EXPANSION_COLUMNS]) =
            Default::default();
        for (pair, inner, target) in pair_products {
            products[pair].extend(inner);
            target_products[DERIVATIVE_PAIRS[pair].1].extend(target.into_iter().map(|v| v / size));
        }
        Ok(Self {
            terms,
            table_level: tabled,
            bytes: bytes(count, samples),
            nodes: count,
            samples,
            products,
            target: target_products,
            sizes: curves.iter().map(|c| c.sizes).collect(),
            remainder_bounds: curves.iter().map(|c| c.remainder).collect(),
        })
    }

    /// Return true if the order of integration of a term is fixed.
    pub(super) fn has_fixed_order(&self, term: usize) -> bool {
        self.terms[term].0.is_none()
    }

    /// Return the interval of orders of integration of a term in a cell (box of orders).
    pub(super) fn order_interval(&self, region: &Region, cell: &Cell, term: usize) -> (f64, f64) {
        if self.has_fixed_order(term) {
            let (_, fixed_order) = region.integrations(term);
            return (fixed_order, fixed_order);
        }
        let (width, position) = (cell_width(cell.level[term]), f64::from(cell.position[term]));
        (position * width, (position + 1.0) * width)
    }

    /// Return the intervals of a term at the coarsest bisection level: the index of the first interval, and their
    /// count.
    pub(super) fn initial_intervals(&self, region: &Region, term: usize) -> (usize, usize) {
        if self.has_fixed_order(term) {
            (0, 1)
        } else {
            level_intervals(region.integrations(term), 0)
        }
    }

    /// Return the midpoint of a cell (box of orders) for each term.
    fn middle(&self, cell: &Cell) -> [Middle; MAX_TERMS] {
        let mut out = [Middle::default(); MAX_TERMS];
        for (term, ((stretches, fixed_node), out)) in self.terms.iter().zip(&mut out).enumerate() {
            (out.node, out.taylor_powers[0]) = (*fixed_node, 1.0);
            let Some(stretches) = stretches else { continue };
            let (level, position) = (cell.level[term], cell.position[term]);
            let above = level.min(self.table_level);
            let ancestor = position >> (level - above);
            let (first, node) = stretches[usize::from(above)];
            out.node = node + ancestor as usize - first;
            out.half = cell_width(level) / 2.0;
            let distance =
                f64::from(2 * position + 1) * out.half - f64::from(2 * ancestor + 1) * cell_width(above) / 2.0;
            for m in 1..EXPANSION_COLUMNS {
                #[allow(clippy::cast_precision_loss)]
                let next = out.taylor_powers[m - 1] * distance / m as f64;
                out.taylor_powers[m] = next;
            }
        }
        out
    }

    /// Return the product of the nth derivative of the column at node i and the mth derivative of the column at node j.
    fn raw(&self, (i, n): (usize, usize), (j, m): (usize, usize)) -> f64 {
        if n <= m {
            self.products[pair_position(n, m)][j * self.nodes + i]
        } else {
            self.products[pair_position(m, n)][i * self.nodes + j]
        }
    }

    /// Return the product of the nth derivative of one column and the mth derivative of another, both at cell
    /// midpoints. It follows from cubic expansions about the nodes, at which products are stored.
    fn product(&self, a: &Middle, n: usize, b: &Middle, m: usize) -> f64 {
        let mut sum = 0.0;
        for p in n..EXPANSION_COLUMNS {
            for q in m..EXPANSION_COLUMNS {
                let weight = a.taylor_powers[p - n] * b.taylor_powers[q - m];
                if weight != 0.0 {
                    sum += weight * self.raw((a.node, p), (b.node, q));
                }
            }
        }
        sum
    }

    /// Return the product of the measured output with the mth derivative of a column at a cell (box of orders)
    /// midpoint. Also return an upper bound of the norm of this derivative.
    fn target_product(&self, a: &Middle, m: usize) -> (f64, f64) {
        let all = (m..EXPANSION_COLUMNS).map(|q| (a.taylor_powers[q - m], q));
        all.fold((0.0, 0.0), |(sum, size), (weight, q)| {
            (sum + weight * self.target[q][a.node], size + weight.abs() * self.sizes[a.node][q])
        })
    }

    /// Return the inner products from which the bound of a cell (box of orders) is computed.
    pub(super) fn local(&self, cell: &Cell) -> CellProducts {
        let k = self.terms.len();
        let middles = self.middle(cell);
        let mut local = CellProducts::new(k, self.samples);
        for (j, b) in middles.iter().enumerate().take(k) {
            for m in 0..EXPANSION_COLUMNS {
                for (i, a) in middles.iter().enumerate().take(k) {
                    local.products[m][i][j] = self.product(a, 0, b, m);
                }
                (local.target[m][j], local.sizes[m][j]) = self.target_product(b, m);
            }
            local.remainder_bounds[j] = self.remainder_bounds[b.node];
            local.halves[j] = b.half;
        }
        local
    }

    /// Return the subspace spanned by the columns at the midpoint of a cell (box of orders) and their derivatives.
    pub(super) fn span(&self, cell: &Cell) -> DerivativeSubspace {
        let middles = self.middle(cell);
        let mut span = DerivativeSubspace::new(self.samples);
        for middle in middles.iter().take(self.terms.len()) {
            let sizes = std::array::from_fn(|m| self.target_product(middle, m).1);
            span.add(middle.half, sizes, self.remainder_bounds[middle.node]);
        }
        let product = |(i, n): (usize, usize), (j, m): (usize, usize)| self.product(&middles[i], n, &middles[j], m);
        span.fill(product, |(j, m)| self.target_product(&middles[j], m).0);
        span
    }
}

/// Rounding tolerance of an order or of a difference of orders.
const ORDER_TOLERANCE: f64 = 1e-9;

/// Interval of orders ν of one term.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Signal index of the term.
    pub signal: usize,
    /// Lowest order, equal to `highest` for a fixed order.
    pub lowest: f64,
    /// Highest order, equal to `lowest` for a fixed order.
    pub highest: f64,
}

/// Region of orders of one equation: an interval for each order.
#[derive(Debug, Clone, PartialEq)]
pub struct Region {
    /// Signal index of the output.
    pub output: usize,
    /// Lowest and highest order α of the equation.
    pub alpha: (f64, f64),
    /// Intervals of the orders of the terms. Orders above the order of the equation are excluded.
    pub terms: Vec<Range>,
    /// Minimum difference between the order of an output term and the order of the equation, and between two orders of
    /// one signal. At difference 0 the equation would be an identity, or two terms would coincide.
    pub min_separation: f64,
}

impl Region {
    /// Return [`Error::OutOfRange`] if the intervals do not form a region.
    pub(super) fn check(&self) -> Result<()> {
        let range = |name: &str, value: f64, range: &str| Error::OutOfRange {
            name: name.into(),
            value,
            range: range.into(),
            remedy: "give intervals whose lower end is not above the upper end".into(),
        };
        let (low, high) = self.alpha;
        if !(0.0 < low && low <= high && high <= 10.0) {
            return Err(range("the interval of alpha", low, "0 < low <= high <= 10"));
        }
        if !(self.min_separation > 0.0 && self.min_separation <= 1.0) {
            return Err(range("apart", self.min_separation, "(0, 1]"));
        }
        for term in &self.terms {
            if !(-3.0 <= term.lowest && term.lowest <= term.highest && term.highest <= 10.0) {
                return Err(range("the interval of a term", term.lowest, "-3 <= low <= high <= 10"));
            }
        }
        Ok(())
    }

    /// Return true if the signal of a term is the output.
    fn is_output_term(&self, term: usize) -> bool {
        self.terms[term].signal == self.output
    }

    /// Return the lowest and the highest order of integration α − ν of a term.
    pub(super) fn integrations(&self, term: usize) -> (f64, f64) {
        let min_integration = if self.is_output_term(term) { self.min_separation } else { 0.0 };
        ((self.alpha.0 - self.terms[term].highest).max(min_integration), self.alpha.1 - self.terms[term].lowest)
    }

    /// Return true if two terms are interchangeable: their signals and intervals are equal, and their orders vary.
    fn are_interchangeable(&self, a: usize, b: usize) -> bool {
        self.terms[a] == self.terms[b] && self.terms[a].lowest < self.terms[a].highest
    }

    /// Return the interval of the order α of the equation that permits orders of integration of the first terms within
    /// the intervals `intervals`. `None` if it is empty.
    pub(super) fn alpha_interval(&self, intervals: &[(f64, f64)]) -> Option<(f64, f64)> {
        let (mut low, mut high) = self.alpha;
        for (term, &(a, b)) in intervals.iter().enumerate() {
            let (min_integration, max_integration) = self.integrations(term);
            let (a, b) = (a.max(min_integration), b.min(max_integration));
            if a > b + ORDER_TOLERANCE {
                return None;
            }
            low = low.max(a + self.terms[term].lowest);
            high = high.min(b + self.terms[term].highest);
            for (other, &(c, d)) in intervals.iter().enumerate().take(term) {
                if self.terms[other].signal != self.terms[term].signal {
                    continue;
                }
                // Interchangeable terms are sorted by their orders.
                let distances = [d - a, if self.are_interchangeable(other, term) { f64::NEG_INFINITY } else { b - c }];
                if distances[0].max(distances[1]) < self.min_separation - ORDER_TOLERANCE {
                    return None;
                }
            }
        }
        (low <= high + ORDER_TOLERANCE).then_some((low, high))
    }

    /// Return the order α of the equation and the orders ν of its terms for the orders of integration `etas`. `None` if
    /// no α of the region allows them.
    pub(super) fn orders(&self, etas: &[f64]) -> Option<(f64, Vec<f64>)> {
        let points: Vec<(f64, f64)> = etas.iter().map(|&eta| (eta, eta)).collect();
        let (low, high) = self.alpha_interval(&points)?;
        let alpha = ((low + high) / 2.0).clamp(self.alpha.0, self.alpha.1);
        Some((alpha, etas.iter().map(|eta| alpha - eta).collect()))
    }

    /// Return the orders of integration in the region that are nearest to the midpoint of a cell (box of orders), given
    /// as one interval per term. `None` if the cell contains no orders of the region.
    pub(super) fn midpoint_orders(&self, intervals: &[(f64, f64)]) -> Option<Vec<f64>> {
        let (low, high) = self.alpha_interval(intervals)?;
        let alpha = ((low + high) / 2.0).clamp(self.alpha.0, self.alpha.1);
        let etas: Vec<f64> = intervals.iter().map(|(a, b)| (a + b) / 2.0).collect();
        self.of_orders(alpha, &etas.iter().map(|eta| alpha - eta).collect::<Vec<_>>())
    }

    /// Return the orders of integration for the order `alpha` of the equation and the orders of its terms, each clipped
    /// to its interval. `None` if the result is not in the region.
    pub(super) fn of_orders(&self, alpha: f64, orders: &[f64]) -> Option<Vec<f64>> {
        let alpha = alpha.clamp(self.alpha.0, self.alpha.1);
        let clamped_integration = |(term, order): (usize, &f64)| {
            let (min_integration, range) = (self.integrations(term).0, self.terms[term]);
            (alpha - order.clamp(range.lowest, range.highest)).max(min_integration)
        };
        let etas: Vec<f64> = orders.iter().enumerate().map(clamped_integration).collect();
        self.orders(&etas).map(|_| etas)
    }
}
