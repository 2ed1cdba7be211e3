//! A lower bound of the output errors of all candidates of a box.
//!
//! With û and v̂ the two columns that vary (of unit size, less their parts along the others) a candidate's coefficients on
//! them solve p + B q = û·y, B p + q = v̂·y, B = û·v̂. Over a box, −1 ≤ s, t ≤ 1, every quantity is its straight line
//! between the corners and a remainder ([`crate::search::boxes::side`]); B is bilinear but for the remainders of û and
//! v̂, by Cauchy and Schwarz. The p and q of the corners, joined bilinearly, leave residuals E, F of the two equations,
//! and the true ones lie within (E + |B|F)/(1 − B²) and (F + |B|E)/(1 − B²) of them. ⟨t, w⟩ and 1 − Σ c g are then
//! polynomials in s and t with remainders: the least of the one over the largest of the other is a bound for all.

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
    /// Largest moduli over all columns of unit size of ⟨t, x⟩ and of g‖t‖, by group of test vectors.
    pub(super) tops: Vec<[Wide; 2]>,
    /// Largest rounding of a column of unit size, by record.
    pub(super) rounding: Vec<f64>,
    /// Size of the output over all records.
    pub(super) size: f64,
}

impl Common {
    pub(super) fn new(others: &Others<'_>, norm: Norm, size: f64) -> Self {
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
        Self { norm, tops, rounding: others.probes.iter().map(|p| most(&p.rounding)).collect(), size }
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

/// A slab, ready for its boxes.
pub(super) struct Slab<'a> {
    pub(super) others: &'a Others<'a>,
    pub(super) common: &'a Common,
    /// The order that changes from row to row, and the one that runs along rows.
    pub(super) sides: [Side; 2],
    /// Coefficients of the output on the other columns.
    along: Vec<f64>,
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
        Self { others, common, sides, along, base, rests }
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

    /// Lower bound of the raw scores of all candidates of a box; ends as soon as it exceeds the limit.
    #[inline(always)]
    pub(super) fn bound(&self, [su, sv]: [Stretch; 2], limit: f64) -> f64 {
        let k = self.others.columns.len();
        let [u, v] = &self.sides;
        let ((u0, u1), (v0, v1)) = (su.ends(u.columns.len()), sv.ends(v.columns.len()));
        let (lu, lv) = (&u.levels[su.level], &v.levels[sv.level]);
        let (wu, wv) = (eighth(u1 - u0), eighth(v1 - v0));
        let (pu, pv) = (lu.plain[su.at], lv.plain[sv.at]);
        let sums = pu.sum + pv.sum;

        // B, p and q.
        let corners = [self.product(u0, v0), self.product(u1, v0), self.product(u0, v1), self.product(u1, v1)];
        let off = wu * pu.curve + wv * pv.curve + self.others.rounding * self.others.trace * sums * sums;
        let b_most = corners.iter().fold(0.0_f64, |m, b| m.max(b.abs())) + off;
        // What is not a number proves nothing.
        if b_most.is_nan() || b_most >= 1.0 {
            return 0.0;
        }
        let left = 1.0 - b_most * b_most;
        let (mut ps, mut qs) = ([0.0; 4], [0.0; 4]);
        for (c, (i, j)) in [(u0, v0), (u1, v0), (u0, v1), (u1, v1)].into_iter().enumerate() {
            let (b, y, z) = (corners[c], u.target[i], v.target[j]);
            let left = (1.0 - b) * (1.0 + b);
            ps[c] = (y - b * z) / left;
            qs[c] = (z - b * y) / left;
        }
        let largest = |x: &[f64; 4]| x.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        let (p_corner, q_corner) = (largest(&ps), largest(&qs));
        let (b, p, q) = (bilinear(corners), bilinear(ps), bilinear(qs));
        let e = residual(b, q, q_corner, off, Line::new(u.target[u0], u.target[u1], wu * pu.target));
        let f = residual(b, p, p_corner, off, Line::new(v.target[v0], v.target[v1], wv * pv.target));
        let (dp, dq) = ((e + b_most * f) / left, (f + b_most * e) / left);
        let (p_most, q_most) = (p_corner + dp, q_corner + dq);

        // Sizes of coefficients, and what rounding may change in them.
        let trace = self.others.trace + sums * sums / left;
        let all =
            self.common.size + self.along.iter().map(|c| c.abs()).sum::<f64>() + p_most * pu.sum + q_most * pv.sum;
        #[allow(clippy::cast_precision_loss)]
        let lost = ELIMINATED * ((k + 2) * (k + 2)) as f64 * trace * all;
        let mut others = [0.0; MOST_OTHERS];
        for (s, other) in others.iter_mut().enumerate().take(k) {
            let a = Line::new(u.mixed[u0 * k + s], u.mixed[u1 * k + s], wu * lu.mixed[su.at * k + s]);
            let b = Line::new(v.mixed[v0 * k + s], v.mixed[v1 * k + s], wv * lv.mixed[sv.at * k + s]);
            let middle = self.along[s] - p[0] * a.middle - q[0] * b.middle - (p[1] * a.slope + q[2] * b.slope) / 2.0;
            let terms = [
                p[0] * a.slope + p[1] * a.middle + q[1] * b.middle,
                p[2] * a.middle + q[0] * b.slope + q[2] * b.middle,
                p[3] * a.middle + p[2] * a.slope + q[3] * b.middle + q[1] * b.slope,
                p[1] * a.slope / 2.0,
                q[2] * b.slope / 2.0,
                p[3] * a.slope,
                q[3] * b.slope,
                p_most * a.rest,
                q_most * b.rest,
                dp * (a.middle.abs() + a.slope.abs()),
                dq * (b.middle.abs() + b.slope.abs()),
            ];
            *other = middle.abs() + terms.iter().map(|t| t.abs()).sum::<f64>() + lost;
        }

        let groups = self.base.len();
        let (mut sum, mut first) = (0.0, 0);
        for (probes, most) in self.others.probes.iter().zip(&self.common.rounding) {
            let rounding = probes.target_rounding + (all + lost) * most;
            let mut best = 0.0;
            for at in first..first + probes.groups {
                let (bu, bv) = (&lu.nodes[su.at * groups + at].bent, &lv.nodes[sv.at * groups + at].bent);
                let (a, b) = (&u.seen[u0 * groups + at], &u.seen[u1 * groups + at]);
                let (c, d) = (&v.seen[v0 * groups + at], &v.seen[v1 * groups + at]);
                let (base, tops) = (&self.base[at], &self.common.tops[at]);
                let mut slack = ZERO;
                for (rest, other) in self.rests[at * k..(at + 1) * k].iter().zip(&others) {
                    for n in 0..WIDTH {
                        slack[n] += other * rest[n];
                    }
                }
                for n in 0..WIDTH {
                    // A scale is at least 1.
                    slack[n] += (p_most + lost) * bu[2][n] + (q_most + lost) * bv[2][n];
                }
                // Modulus in the middle, and how far from it, of ⟨t, w⟩ and of (1 − Σ c g)‖t‖.
                let (mut middles, mut offs) = ([ZERO; 2], [ZERO; 2]);
                for half in 0..2 {
                    let (mut squares, mut along, mut across) = (ZERO, ZERO, ZERO);
                    let mut rough = ZERO;
                    for part in 2 * half..2 * half + 2 {
                        for n in 0..WIDTH {
                            let (a0, a1) = ((a[part][n] + b[part][n]) * 0.5, (b[part][n] - a[part][n]) * 0.5);
                            let (b0, b1) = ((c[part][n] + d[part][n]) * 0.5, (d[part][n] - c[part][n]) * 0.5);
                            let (pa, qb) = (p[1] * a1, q[2] * b1);
                            let middle = base[part][n] - p[0] * a0 - q[0] * b0 - (pa + qb) * 0.5;
                            let s = p[0] * a1 + p[1] * a0 + q[1] * b0;
                            let t = p[2] * a0 + q[0] * b1 + q[2] * b0;
                            let st = p[3] * a0 + p[2] * a1 + q[3] * b0 + q[1] * b1;
                            squares[n] += middle * middle;
                            along[n] += s * s;
                            across[n] += t * t;
                            rough[n] += st.abs()
                                + (pa.abs() + qb.abs()) * 0.5
                                + (p[3] * a1).abs()
                                + (q[3] * b1).abs()
                                + dp * (a0.abs() + a1.abs())
                                + dq * (b0.abs() + b1.abs());
                        }
                    }
                    for n in 0..WIDTH {
                        middles[half][n] = squares[n].sqrt();
                        offs[half][n] = along[n].sqrt()
                            + across[n].sqrt()
                            + rough[n]
                            + wu * bu[half][n] * p_most
                            + wv * bv[half][n] * q_most
                            + lost * tops[half][n];
                    }
                }
                let mut bounds = ZERO;
                for n in 0..WIDTH {
                    let seen = middles[0][n] - offs[0][n] - rounding;
                    let size = middles[1][n] + offs[1][n] + slack[n];
                    // A hair more, for the rounding of the divisor and of the score itself.
                    bounds[n] = seen / (size * (1.0 + probes.unit));
                }
                for bound in bounds {
                    // Neither NaN nor an overflow proves anything.
                    if bound > best && bound < f64::MAX {
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
    #[allow(clippy::cast_precision_loss)]
    let length = length as f64;
    length * length / 8.0
}
