//! A lower bound of the errors of all candidates of a box.
//!
//! With û and v̂ the two columns that vary (of unit size, less their parts along the others) a candidate's coefficients on
//! them solve p + B q = û·y, B p + q = v̂·y, B = û·v̂. Over a box, −1 ≤ s, t ≤ 1, every quantity is its straight line
//! between the corners and a remainder ([`crate::search::boxes::side`]); B is bilinear but for the remainders of û and
//! v̂, by Cauchy and Schwarz. The p and q of the corners, joined bilinearly, leave residuals E, F of the two equations,
//! and the true ones lie within (E + |B|F)/(1 − B²) and (F + |B|E)/(1 − B²) of them. ⟨t, w⟩, 1 − Σ c g and what the
//! columns explain of y are then bilinear in s and t but for remainders of second order, and what follows of bilinear
//! functions at the corners follows over the box: |⟨t, w⟩| is at least its part along one direction, which is bilinear,
//! less λ times moduli of bilinear functions, which is concave in s and in t, so least at a corner.

use crate::lanes::WIDTH;
use crate::search::boxes::side::{each_group, Others, Seen, Side, Wide, ZERO};
use crate::search::options::Norm;

/// What rounding may change in coefficients, in units of ε and the sum of the diagonal of an inverse correlation
/// matrix: sixteen times the square of the number of terms, far above what elimination loses.
const ELIMINATED: f64 = 16.0 * f64::EPSILON;

/// Most other columns of a slab.
pub(super) const MOST_OTHERS: usize = 16;

/// What the boxes of all slabs share.
pub(super) struct Common {
    pub(super) norm: Norm,
    /// Whether candidates are ranked by their squared equation error.
    pub(super) squares: bool,
    /// Largest moduli over all columns of unit size of ⟨t, x⟩ and of g‖t‖, by group of test vectors.
    pub(super) tops: Vec<[Wide; 2]>,
    /// Largest rounding of a column of unit size, by record.
    pub(super) rounding: Vec<f64>,
    /// Size of the output over all records.
    pub(super) size: f64,
}

impl Common {
    pub(super) fn new(others: &Others<'_>, norm: Norm, squares: bool, size: f64) -> Self {
        let width = others.normal.inverse().len();
        let tops = each_group(others.probes)
            .map(|(r, g)| {
                let mut tops = [ZERO; 2];
                for p in 0..width {
                    let (seen, _) = others.seen(r, g, p);
                    for half in 0..2 {
                        for n in 0..WIDTH {
                            tops[half][n] = tops[half][n].max(seen[2 * half][n].hypot(seen[2 * half + 1][n]));
                        }
                    }
                }
                tops
            })
            .collect();
        let most = |rounding: &[f64]| -> f64 {
            rounding.iter().zip(others.normal.inverse()).map(|(r, i)| r * i).fold(0.0, f64::max)
        };
        Self { norm, squares, tops, rounding: others.probes.iter().map(|p| most(&p.rounding)).collect(), size }
    }
}

/// A stretch of values of one order: node `at` of a level.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stretch {
    pub(super) level: usize,
    pub(super) at: usize,
}

impl Stretch {
    /// Its first and last value of so many.
    #[inline(always)]
    pub(super) fn ends(self, n: usize) -> (usize, usize) {
        (self.at << self.level, n.min((self.at + 1) << self.level) - 1)
    }
}

/// Middle, slope and remainder of a quantity over a stretch.
#[derive(Debug, Clone, Copy)]
struct Line {
    middle: f64,
    slope: f64,
    rest: f64,
}

impl Line {
    #[inline(always)]
    fn new(first: f64, last: f64, rest: f64) -> Self {
        Self { middle: (first + last) / 2.0, slope: (last - first) / 2.0, rest }
    }
}

/// Coefficients of 1, s, t, st from the values at (−1, −1), (1, −1), (−1, 1), (1, 1).
#[inline(always)]
fn bilinear([a, b, c, d]: [f64; 4]) -> [f64; 4] {
    [(a + b + c + d) / 4.0, ((b + d) - (a + c)) / 4.0, ((c + d) - (a + b)) / 4.0, ((a + d) - (b + c)) / 4.0]
}

/// Largest residual of z − p − B q, all exact at the corners, where B is off by at most `rest`.
#[inline(always)]
fn residual(b: [f64; 4], q: [f64; 4], most: f64, rest: f64, line: Line) -> f64 {
    let curved = (b[1] * q[1]).abs() + (b[2] * q[2]).abs() + (b[3] * q[3]).abs();
    let mixed = (b[1] * q[3] + b[3] * q[1]).abs() + (b[2] * q[3] + b[3] * q[2]).abs();
    curved + mixed + line.rest + rest * most
}

/// What the candidates of a box have in common.
struct Cell {
    /// Rows and values at the corners.
    at: [(usize, usize); 4],
    /// Eighths of the squares of the sides' lengths.
    wide: [f64; 2],
    /// p and q at the corners, the largest over the box, and how far from bilinear they run.
    ps: [f64; 4],
    qs: [f64; 4],
    most: [f64; 2],
    off: [f64; 2],
    /// Of p the coefficients of s and st, of q those of t and st, in moduli: what bends a product with a line in s or t.
    bends: [f64; 2],
    /// û·y and v̂·y.
    lines: [Line; 2],
    /// Size of the output and of all coefficients, and what rounding may change in one of these.
    all: f64,
    lost: f64,
}

impl Cell {
    /// How far p times the first of these quantities along the sides and q times the second run from bilinear.
    #[inline(always)]
    fn rest(&self, [a, b]: [Line; 2]) -> f64 {
        let side = |n: usize, line: Line| {
            self.bends[n] * line.slope.abs()
                + self.most[n] * line.rest
                + self.off[n] * (line.middle.abs() + line.slope.abs())
        };
        side(0, a) + side(1, b)
    }
}

/// A slab, ready for its boxes.
pub(super) struct Slab<'a> {
    pub(super) others: &'a Others<'a>,
    pub(super) common: &'a Common,
    /// The order that changes from row to row, and the one that runs along rows.
    pub(super) sides: [Side; 2],
    /// Coefficients of the output on the other columns.
    along: Vec<f64>,
    /// Squared size of the output less its part along the others.
    unexplained: f64,
    /// Of the output less its part along the others: ⟨t, y⟩ and ‖t‖, by group.
    base: Vec<Seen>,
    /// ‖Fᵀt − g t‖ of the other columns, k a group.
    rests: Vec<Wide>,
}

impl<'a> Slab<'a> {
    #[inline(always)]
    pub(super) fn new(others: &'a Others<'a>, common: &'a Common, sides: [Side; 2]) -> Self {
        let k = others.columns.len();
        let mut along = vec![0.0; k];
        let rhs: Vec<f64> = others.columns.iter().map(|&s| others.normal.rhs()[s]).collect();
        others.solve(&rhs, &mut along);
        let (mut base, mut rests) = (Vec::new(), Vec::new());
        for (r, g) in each_group(others.probes) {
            let probes = &others.probes[r];
            let mut here = [probes.target[g][0], probes.target[g][1], probes.size[g], ZERO];
            for (c, &s) in along.iter().zip(others.columns) {
                let (seen, rest) = others.seen(r, g, s);
                for (here, seen) in here.iter_mut().zip(&seen) {
                    for n in 0..WIDTH {
                        here[n] -= c * seen[n];
                    }
                }
                rests.push(rest);
            }
            base.push(here);
        }
        let explained: f64 = along.iter().zip(&rhs).map(|(c, g)| c * g).sum();
        Self { others, common, sides, along, unexplained: common.size * common.size - explained, base, rests }
    }

    /// û·v̂ of a row and a value along it.
    #[inline(always)]
    fn product(&self, row: usize, value: usize) -> f64 {
        let k = self.others.columns.len();
        let [u, v] = &self.sides;
        let raw = self.others.normal.product(u.columns[row], v.columns[value]);
        let along: f64 =
            u.mixed[row * k..(row + 1) * k].iter().zip(&v.shared[value * k..(value + 1) * k]).map(|(a, g)| a * g).sum();
        (raw * u.scale[row] - along) * v.scale[value]
    }

    /// What the candidates of a box have in common; none where nothing is proved of it.
    #[inline(always)]
    fn cell(&self, [su, sv]: [Stretch; 2]) -> Option<Cell> {
        let [u, v] = &self.sides;
        let ((u0, u1), (v0, v1)) = (su.ends(u.columns.len()), sv.ends(v.columns.len()));
        let (wu, wv) = (eighth(u1 - u0), eighth(v1 - v0));
        let (pu, pv) = (u.levels[su.level].plain[su.at], v.levels[sv.level].plain[sv.at]);
        let sums = pu.sum + pv.sum;
        let at = [(u0, v0), (u1, v0), (u0, v1), (u1, v1)];
        let corners = at.map(|(i, j)| self.product(i, j));
        let off = wu * pu.curve + wv * pv.curve + self.others.rounding * self.others.trace * sums * sums;
        let b_most = corners.iter().fold(0.0_f64, |m, b| m.max(b.abs())) + off;
        // What is not a number proves nothing.
        if b_most.is_nan() || b_most >= 1.0 {
            return None;
        }
        let left = 1.0 - b_most * b_most;
        let (mut ps, mut qs) = ([0.0; 4], [0.0; 4]);
        for (c, (i, j)) in at.into_iter().enumerate() {
            let (b, y, z) = (corners[c], u.target[i], v.target[j]);
            let left = (1.0 - b) * (1.0 + b);
            ps[c] = (y - b * z) / left;
            qs[c] = (z - b * y) / left;
        }
        let largest = |x: &[f64; 4]| x.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        let (p_corner, q_corner) = (largest(&ps), largest(&qs));
        let (b, p, q) = (bilinear(corners), bilinear(ps), bilinear(qs));
        let y = Line::new(u.target[u0], u.target[u1], wu * pu.target);
        let z = Line::new(v.target[v0], v.target[v1], wv * pv.target);
        let (e, f) = (residual(b, q, q_corner, off, y), residual(b, p, p_corner, off, z));
        let (dp, dq) = ((e + b_most * f) / left, (f + b_most * e) / left);
        let (p_most, q_most) = (p_corner + dp, q_corner + dq);

        // Sizes of coefficients, and what rounding may change in them.
        let trace = self.others.trace + sums * sums / left;
        let all =
            self.common.size + self.along.iter().map(|c| c.abs()).sum::<f64>() + p_most * pu.sum + q_most * pv.sum;
        let terms = count(self.others.columns.len() + 2);
        let lost = ELIMINATED * terms * terms * trace * all;
        let bends = [p[1].abs() + p[3].abs(), q[2].abs() + q[3].abs()];
        Some(Cell {
            at,
            wide: [wu, wv],
            ps,
            qs,
            most: [p_most, q_most],
            off: [dp, dq],
            bends,
            lines: [y, z],
            all,
            lost,
        })
    }

    /// Lower bound of the raw scores of all candidates of a box; ends as soon as it exceeds the limit.
    #[inline(always)]
    pub(super) fn bound(&self, both: [Stretch; 2], limit: f64) -> f64 {
        match self.cell(both) {
            None => 0.0,
            Some(cell) if self.common.squares => self.squares(&cell),
            Some(cell) => self.errors(both, &cell, limit),
        }
    }

    /// Lower bound of their squared equation errors.
    #[inline(always)]
    fn squares(&self, cell: &Cell) -> f64 {
        let [u, v] = &self.sides;
        let explained =
            cell.at.iter().enumerate().map(|(c, &(i, j))| cell.ps[c] * u.target[i] + cell.qs[c] * v.target[j]);
        let largest = explained.fold(f64::NEG_INFINITY, f64::max) + cell.rest(cell.lines);
        let rounding = self.others.rounding * cell.all + count(self.others.columns.len() + 2) * cell.lost;
        let bound = self.unexplained - largest - 4.0 * rounding * cell.all;
        // Neither NaN nor an overflow proves anything.
        if bound > 0.0 && bound < f64::MAX && largest > f64::MIN {
            bound
        } else {
            0.0
        }
    }

    /// Lower bound of their output errors.
    #[inline(always)]
    fn errors(&self, [su, sv]: [Stretch; 2], cell: &Cell, limit: f64) -> f64 {
        let k = self.others.columns.len();
        let [u, v] = &self.sides;
        let Cell { at, wide: [wu, wv], ps, qs, most: [p_most, q_most], off: [dp, dq], bends, all, lost, .. } = *cell;
        let ((u0, v0), (u1, v1)) = (at[0], at[3]);
        let (lu, lv) = (&u.levels[su.level], &v.levels[sv.level]);
        // Moduli of the other coefficients at the corners, and how far from bilinear they run.
        let (mut others, mut rests) = ([[0.0; 4]; MOST_OTHERS], [0.0; MOST_OTHERS]);
        for s in 0..k {
            for (c, (i, j)) in at.into_iter().enumerate() {
                others[s][c] = (self.along[s] - ps[c] * u.mixed[i * k + s] - qs[c] * v.mixed[j * k + s]).abs();
            }
            let a = Line::new(u.mixed[u0 * k + s], u.mixed[u1 * k + s], wu * lu.mixed[su.at * k + s]);
            let b = Line::new(v.mixed[v0 * k + s], v.mixed[v1 * k + s], wv * lv.mixed[sv.at * k + s]);
            rests[s] = cell.rest([a, b]) + lost;
        }

        let groups = self.base.len();
        let (mut sum, mut first) = (0.0, 0);
        for (probes, most) in self.others.probes.iter().zip(&self.common.rounding) {
            let rounding = probes.target_rounding + (all + lost) * most;
            let mut best = 0.0;
            for group in first..first + probes.groups {
                let (bu, bv) = (&lu.nodes[su.at * groups + group].bent, &lv.nodes[sv.at * groups + group].bent);
                let (a, b) = (&u.seen[u0 * groups + group], &u.seen[u1 * groups + group]);
                let (c, d) = (&v.seen[v0 * groups + group], &v.seen[v1 * groups + group]);
                let (base, tops) = (&self.base[group], &self.common.tops[group]);
                // How far ⟨t, w⟩ and the divisor run from bilinear.
                let mut rough = [[0.0; WIDTH]; 2];
                for half in 0..2 {
                    for n in 0..WIDTH {
                        let mut sizes = [0.0; 4];
                        for part in 2 * half..2 * half + 2 {
                            sizes[0] += (a[part][n] + b[part][n]).abs() * 0.5;
                            sizes[1] += (b[part][n] - a[part][n]).abs() * 0.5;
                            sizes[2] += (c[part][n] + d[part][n]).abs() * 0.5;
                            sizes[3] += (d[part][n] - c[part][n]).abs() * 0.5;
                        }
                        rough[half][n] = bends[0] * sizes[1]
                            + bends[1] * sizes[3]
                            + dp * (sizes[0] + sizes[1])
                            + dq * (sizes[2] + sizes[3])
                            + wu * bu[half][n] * p_most
                            + wv * bv[half][n] * q_most
                            + lost * tops[half][n];
                    }
                }
                // What is added to each divisor: of the varying columns (a scale is at least 1) and of the others.
                let mut slack = [ZERO; 4];
                for n in 0..WIDTH {
                    rough[0][n] += rounding;
                    rough[1][n] += (dp + lost) * bu[2][n] + (dq + lost) * bv[2][n];
                    for corner in 0..4 {
                        slack[corner][n] = ps[corner].abs() * bu[2][n] + qs[corner].abs() * bv[2][n];
                    }
                }
                for (s, rest) in self.rests[group * k..(group + 1) * k].iter().enumerate() {
                    for n in 0..WIDTH {
                        rough[1][n] += rests[s] * rest[n];
                        for corner in 0..4 {
                            slack[corner][n] += others[s][corner] * rest[n];
                        }
                    }
                }
                // ⟨t, w⟩ and the divisor at the corners.
                let mut values = [[ZERO; 4]; 4];
                for (corner, value) in values.iter_mut().enumerate() {
                    let (of_u, of_v) = ([a, b][corner % 2], [c, d][corner / 2]);
                    for part in 0..4 {
                        for n in 0..WIDTH {
                            value[part][n] = base[part][n] - ps[corner] * of_u[part][n] - qs[corner] * of_v[part][n];
                        }
                    }
                }
                // All are looked at along the middle's direction.
                let mut along = [ZERO; 2];
                for n in 0..WIDTH {
                    let re = values[0][0][n] + values[1][0][n] + values[2][0][n] + values[3][0][n];
                    let im = values[0][1][n] + values[1][1][n] + values[2][1][n] + values[3][1][n];
                    let size = (re * re + im * im).sqrt();
                    let inverse = if size > 0.0 { 1.0 / size } else { 0.0 };
                    along[0][n] = re * inverse;
                    along[1][n] = im * inverse;
                }
                let mut bounds = [f64::MAX; WIDTH];
                for (value, slack) in values.iter().zip(&slack) {
                    for n in 0..WIDTH {
                        let seen = value[0][n] * along[0][n] + value[1][n] * along[1][n] - rough[0][n];
                        let size = (value[2][n] * value[2][n] + value[3][n] * value[3][n]).sqrt();
                        // A hair more, for the rounding of the divisor and of the score itself.
                        let bound = seen / ((size + slack[n] + rough[1][n]) * (1.0 + probes.unit));
                        // Neither NaN nor an overflow proves anything.
                        let bound = if bound > 0.0 && bound < f64::MAX { bound } else { 0.0 };
                        bounds[n] = if bound < bounds[n] { bound } else { bounds[n] };
                    }
                }
                for bound in bounds {
                    if bound > best {
                        best = bound;
                    }
                }
                if sum + self.raw(best) > limit {
                    break;
                }
            }
            first += probes.groups;
            sum += self.raw(best);
        }
        sum
    }

    #[inline(always)]
    fn raw(&self, norm: f64) -> f64 {
        match self.common.norm {
            Norm::L1 => norm,
            Norm::L2 => norm * norm,
        }
    }
}

/// An eighth of a length squared.
#[inline(always)]
fn eighth(length: usize) -> f64 {
    let length = count(length);
    length * length / 8.0
}

#[inline(always)]
#[allow(clippy::cast_precision_loss)]
fn count(n: usize) -> f64 {
    n as f64
}
