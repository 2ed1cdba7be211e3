//! Division of series by forward substitution in blocks that are joined by FFT products, O(m log² m).
//!
//! Exact for every divisor with a nonzero leading coefficient, stable or not. [`Division`] returns the quotient block
//! by block, so that a search can drop a candidate early.

use std::borrow::Cow;

use super::product::Kernel;
use crate::error::{check_length, Error, Result};
use crate::fft::{self, Bin, Plan, Workspace};
use crate::linalg::small;
use crate::simd;

/// Length of a block of forward substitution. 64 was the fastest of 16, 32, 64, 128 at m = 2048.
pub const BLOCK_TERMS: usize = 64;

/// Longest half length of blocks that are joined directly, which is faster there and has no transform rounding.
const JOINED_DIRECTLY: usize = 64;

/// Terms whose sums stay in registers while the products with a tile are subtracted.
const TILE_TERMS: usize = 8;

/// `open[i] −= Σ_s series[start − s + i]·solved[s]`, s from 0 on, with the same operations for every term.
#[inline(always)]
fn take_off(open: &mut [f64], series: &[f64], start: usize, solved: &[f64]) {
    let mut at = start;
    let mut tiles = open.chunks_exact_mut(2 * TILE_TERMS);
    for tile in &mut tiles {
        let mut sums = [0.0; 2 * TILE_TERMS];
        sums.copy_from_slice(tile);
        for (s, &y) in solved.iter().enumerate() {
            let part = &series[at - s..at - s + 2 * TILE_TERMS];
            for i in 0..2 * TILE_TERMS {
                sums[i] -= part[i] * y;
            }
        }
        tile.copy_from_slice(&sums);
        at += 2 * TILE_TERMS;
    }
    let rest = tiles.into_remainder();
    for (s, &y) in solved.iter().enumerate() {
        for (term, &v) in rest.iter_mut().zip(&series[at - s..]) {
            *term -= v * y;
        }
    }
}

/// Forward substitution within a block of one unknown, in place, tile by tile.
struct Substitution<'a> {
    divisor: &'a [f64],
    inverse: f64,
    block: &'a mut [f64],
}

impl simd::SimdKernel for Substitution<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let mut open = self.block;
        while open.len() >= TILE_TERMS {
            let (tile, later) = open.split_at_mut(TILE_TERMS);
            // With a constant length the loop is unrolled and its values stay in registers.
            let mut head = [0.0; TILE_TERMS];
            let known = self.divisor.len().min(TILE_TERMS);
            head[..known].copy_from_slice(&self.divisor[..known]);
            let mut solved = [0.0; TILE_TERMS];
            solved.copy_from_slice(tile);
            for k in 0..TILE_TERMS {
                solved[k] *= self.inverse;
                for i in k + 1..TILE_TERMS {
                    solved[i] -= head[i - k] * solved[k];
                }
            }
            tile.copy_from_slice(&solved);
            take_off(later, self.divisor, TILE_TERMS, &solved);
            open = later;
        }
        for k in 0..open.len() {
            open[k] *= self.inverse;
            let y = open[k];
            for (rest, &v) in open[k + 1..].iter_mut().zip(&self.divisor[1..]) {
                *rest -= v * y;
            }
        }
    }
}

/// Contribution of a solved block to the terms right after it.
struct Join<'a> {
    series: &'a [f64],
    solved: &'a [f64],
    open: &'a mut [f64],
}

impl simd::SimdKernel for Join<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        take_off(self.open, self.series, self.solved.len(), self.solved);
    }
}

/// Transform of one length in a division: plan and spectra of the n² series, computed on demand.
struct Level {
    plan: Plan,
    ready: bool,
    spectra: Vec<Vec<Bin>>,
}

/// State of an n × n division that computes the quotients block by block.
///
/// Right-hand sides are added block by block ([`Division::add`]). [`Division::advance`] then solves the next block and
/// adds its contributions to the rest. After block b the only finished left half of the recursion has the largest power
/// of two that divides b + 1 as its length, so one transform pair a block is enough.
pub struct Division {
    n: usize,
    m: usize,
    solved: usize,
    /// Right-hand side minus the contributions of solved blocks, then the quotient, per unknown.
    rest: Vec<Vec<f64>>,
    /// Transforms, one per power of two of blocks.
    levels: Vec<Level>,
    spectra: Vec<Vec<Bin>>,
    product: Vec<Bin>,
    time: Vec<f64>,
    workspace: Workspace,
}

impl Division {
    /// Division of n unknown series of m terms.
    #[must_use]
    pub fn new(n: usize, m: usize) -> Self {
        Self {
            n,
            m,
            solved: 0,
            rest: vec![vec![0.0; m]; n],
            levels: Vec::new(),
            spectra: vec![Vec::new(); n],
            product: Vec::new(),
            time: Vec::new(),
            workspace: Workspace::new(),
        }
    }

    /// Reset everything except allocated memory.
    pub fn reset(&mut self) {
        self.levels.iter_mut().for_each(|level| level.ready = false);
        self.restart();
    }

    /// Reset the right-hand side and keep the spectra, for the same divisor.
    pub fn restart(&mut self) {
        self.solved = 0;
        self.rest.iter_mut().for_each(|r| r.fill(0.0));
    }

    /// Solve for complete right-hand sides.
    pub(super) fn run<S: AsRef<[f64]>>(&mut self, matrix: &[Vec<S>], inverse: &[f64], rhs: &[&[f64]]) {
        self.run_to(self.m, matrix, inverse, rhs);
    }

    /// Solve for the first terms only, rounded up to blocks.
    pub(super) fn run_to<S: AsRef<[f64]>>(&mut self, terms: usize, matrix: &[Vec<S>], inverse: &[f64], rhs: &[&[f64]]) {
        for (i, b) in rhs.iter().enumerate() {
            self.add(i, 0, b);
        }
        while self.solved < terms {
            self.advance(inverse, |i, j, len| &matrix[i][j].as_ref()[..len]);
        }
    }

    /// Number of solved terms.
    #[must_use]
    pub fn solved_terms(&self) -> usize {
        self.solved
    }

    /// Add to the right-hand side of equation i from term `start` on, which must not be solved yet.
    pub fn add(&mut self, i: usize, start: usize, values: &[f64]) {
        for (rest, &v) in self.rest[i][start..].iter_mut().zip(values) {
            *rest += v;
        }
    }

    /// Quotient i as far as it is solved.
    #[must_use]
    pub fn quotient(&self, i: usize) -> &[f64] {
        &self.rest[i][..self.solved]
    }

    /// All quotients. Terms beyond the solved ones are remainders.
    pub(super) fn quotients(&self) -> &[Vec<f64>] {
        &self.rest
    }

    /// All quotients.
    #[must_use]
    pub fn into_quotients(self) -> Vec<Vec<f64>> {
        self.rest
    }

    /// Number of terms of each series that the next [`Division::advance`] reads.
    #[must_use]
    pub fn reads(&self) -> usize {
        let hi = (self.solved + BLOCK_TERMS).min(self.m);
        if hi == self.m {
            return hi - self.solved;
        }
        (2 * (BLOCK_TERMS << (hi / BLOCK_TERMS).trailing_zeros())).min(self.m)
    }

    /// Total number of terms.
    #[must_use]
    pub fn terms(&self) -> usize {
        self.m
    }

    /// Solve the next block and join it to the rest.
    ///
    /// `inverse` is the row-major inverse of the leading matrix. `series(i, j, len)` returns the first `len` terms of
    /// A_ij (fewer if m is smaller), never more than [`Division::reads`].
    pub fn advance<'a>(&mut self, inverse: &[f64], series: impl Fn(usize, usize, usize) -> &'a [f64]) {
        self.solve_block(inverse, &series);
        self.join(&series);
    }

    /// First half of [`Division::advance`]: next block of the quotients, by forward substitution.
    pub fn solve_block<'a>(&mut self, inverse: &[f64], series: impl Fn(usize, usize, usize) -> &'a [f64]) {
        let lo = self.solved;
        let hi = (lo + BLOCK_TERMS).min(self.m);
        self.substitute(inverse, &series, lo, hi);
        self.solved = hi;
    }

    /// Second half of [`Division::advance`]: contributions of the solved blocks to later ones.
    pub fn join<'a>(&mut self, series: impl Fn(usize, usize, usize) -> &'a [f64]) {
        let (n, hi) = (self.n, self.solved);
        if hi == self.m {
            return;
        }
        let lo = hi.saturating_sub(BLOCK_TERMS);
        let blocks = hi / BLOCK_TERMS;
        let level = blocks.trailing_zeros() as usize;
        let half = BLOCK_TERMS << level;
        let end = (hi + half).min(self.m);
        if half <= JOINED_DIRECTLY {
            for i in 0..n {
                for j in 0..n {
                    let a = series(i, j, (2 * half).min(self.m));
                    // Split borrows: the solved part of j contributes to the open part of i.
                    let mut solved = [0.0; BLOCK_TERMS];
                    solved[..hi - lo].copy_from_slice(&self.rest[j][lo..hi]);
                    let open = &mut self.rest[i][hi..end];
                    simd::dispatch_simd(Join { series: a, solved: &solved[..hi - lo], open });
                }
            }
            return;
        }
        self.prepare(level, &series);
        let zero = Bin::new(0.0, 0.0);
        let Level { plan, spectra: kernels, .. } = &self.levels[level];
        self.time.resize(self.time.len().max(plan.len()), 0.0);
        self.product.resize(self.product.len().max(plan.bins()), zero);
        for j in 0..n {
            let time = &mut self.time[..plan.len()];
            time[..half].copy_from_slice(&self.rest[j][hi - half..hi]);
            time[half..].fill(0.0);
            let bins = plan.bins().max(self.spectra[j].len());
            self.spectra[j].resize(bins, zero);
            plan.transform(time, &mut self.spectra[j][..plan.bins()], &mut self.workspace);
        }
        for i in 0..n {
            let product = &mut self.product[..plan.bins()];
            product.fill(zero);
            for j in 0..n {
                for ((p, x), k) in product.iter_mut().zip(&self.spectra[j]).zip(&kernels[i * n + j]) {
                    *p += x * k;
                }
            }
            // Wrapped-around terms of the cyclic product fall on the first half, which is not read.
            plan.inverse(product, &mut self.time[..plan.len()], &mut self.workspace);
            for (rest, &v) in self.rest[i][hi..end].iter_mut().zip(&self.time[half..]) {
                *rest -= v;
            }
        }
    }

    fn substitute<'a>(
        &mut self,
        inverse: &[f64],
        series: &impl Fn(usize, usize, usize) -> &'a [f64],
        lo: usize,
        hi: usize,
    ) {
        let n = self.n;
        if n == 1 {
            let (divisor, block) = (series(0, 0, hi - lo), &mut self.rest[0][lo..hi]);
            simd::dispatch_simd(Substitution { divisor, inverse: inverse[0], block });
            return;
        }
        let mut values = vec![0.0; n];
        for k in lo..hi {
            for (i, value) in values.iter_mut().enumerate() {
                *value = (0..n).map(|j| inverse[i * n + j] * self.rest[j][k]).sum();
            }
            for (j, &y) in values.iter().enumerate() {
                self.rest[j][k] = y;
            }
            for i in 0..n {
                for (j, &y) in values.iter().enumerate() {
                    let a = series(i, j, hi - lo);
                    for (rest, &v) in self.rest[i][k + 1..hi].iter_mut().zip(&a[1..]) {
                        *rest -= v * y;
                    }
                }
            }
        }
    }

    fn prepare<'a>(&mut self, level: usize, series: &impl Fn(usize, usize, usize) -> &'a [f64]) {
        while self.levels.len() <= level {
            let plan = fft::plan(2 * (BLOCK_TERMS << self.levels.len()));
            self.levels.push(Level { plan, ready: false, spectra: Vec::new() });
        }
        let Level { plan, ready, spectra } = &mut self.levels[level];
        if *ready {
            return;
        }
        spectra.resize_with(self.n * self.n, Vec::new);
        self.time.resize(self.time.len().max(plan.len()), 0.0);
        let time = &mut self.time[..plan.len()];
        for (place, spectrum) in spectra.iter_mut().enumerate() {
            let a = series(place / self.n, place % self.n, plan.len().min(self.m));
            time[..a.len()].copy_from_slice(a);
            time[a.len()..].fill(0.0);
            spectrum.resize(plan.bins(), Bin::new(0.0, 0.0));
            plan.transform(time, spectrum, &mut self.workspace);
        }
        *ready = true;
    }
}

/// Quotient mod z^m with m the numerator's length, exact for stable and unstable divisors. O(m log² m).
///
/// # Errors
/// [`Error::LeadingZero`] where the divisor starts with zero, [`Error::Length`] where it is shorter than m.
pub fn divide(numerator: &[f64], divisor: &[f64]) -> Result<Vec<f64>> {
    let quotient = solve(&[vec![divisor]], &[numerator])?;
    quotient.into_iter().next().ok_or_else(|| Error::Internal { what: "a division without a quotient".into() })
}

/// Reciprocal of a series mod z^m. Not finite if the series starts with zero. O(m log² m).
///
/// ```
/// assert_eq!(ftlm::series::reciprocal(&[1.0, -1.0, 0.0]), [1.0, 1.0, 1.0]);
/// ```
#[must_use]
pub fn reciprocal(series: &[f64]) -> Vec<f64> {
    let mut unit = vec![0.0; series.len()];
    unit.first_mut().into_iter().for_each(|first| *first = 1.0);
    let mut division = Division::new(1, series.len());
    let inverse = [1.0 / series.first().copied().unwrap_or(f64::NAN)];
    division.run(&[vec![series]], &inverse, &[&unit]);
    division.into_quotients().pop().unwrap_or_default()
}

/// Solve the n × n system Σ_j A_ij y_j = b_i of series mod z^m, A_ij of length m at least. O(n² m log² m).
///
/// # Errors
/// [`Error::LeadingZero`] where the matrix of leading coefficients is singular, [`Error::Length`].
pub fn solve<S: AsRef<[f64]>>(matrix: &[Vec<S>], rhs: &[&[f64]]) -> Result<Vec<Vec<f64>>> {
    let n = rhs.len();
    let m = rhs.first().map_or(0, |b| b.len());
    check_length("matrix of series", n, matrix.len())?;
    for row in matrix {
        check_length("row of the matrix of series", n, row.len())?;
        for series in row {
            if series.as_ref().len() < m {
                return Err(Error::Length { name: "series".into(), expected: m, found: series.as_ref().len() });
            }
        }
    }
    for b in rhs {
        check_length("right-hand side", m, b.len())?;
    }
    // An empty series starts with zero, so division by it fails too.
    let first = |s: &S| s.as_ref().first().copied().unwrap_or(0.0);
    let leading: Vec<f64> = matrix.iter().flat_map(|row| row.iter().map(first)).collect();
    let inverse = small::inverse(&leading, n)?;
    let mut division = Division::new(n, m);
    division.run(matrix, &inverse, rhs);
    Ok(division.into_quotients())
}

/// Solver of a system of series for many right-hand sides. The spectra of its matrix are computed once.
pub struct Solver<'a> {
    matrix: Cow<'a, [Vec<Vec<f64>>]>,
    inverse: Vec<f64>,
    division: Division,
}

impl<'a> Solver<'a> {
    /// Solver of an n × n matrix of series of m terms.
    ///
    /// # Errors
    /// [`Error::LeadingZero`] where the matrix of leading coefficients is singular, [`Error::Length`].
    pub fn new(matrix: &'a [Vec<Vec<f64>>]) -> Result<Self> {
        Self::of(Cow::Borrowed(matrix))
    }

    /// Solver that owns its matrix.
    ///
    /// # Errors
    /// As [`Solver::new`].
    pub fn from_matrix(matrix: Vec<Vec<Vec<f64>>>) -> Result<Solver<'static>> {
        Solver::of(Cow::Owned(matrix))
    }

    fn of(matrix: Cow<'a, [Vec<Vec<f64>>]>) -> Result<Self> {
        let n = matrix.len();
        let m = matrix.first().and_then(|row| row.first()).map_or(0, Vec::len);
        for row in matrix.iter() {
            check_length("row of the matrix of series", n, row.len())?;
            for series in row {
                check_length("series", m, series.len())?;
            }
        }
        let first = |s: &Vec<f64>| s.first().copied().unwrap_or(0.0);
        let leading: Vec<f64> = matrix.iter().flat_map(|row| row.iter().map(first)).collect();
        let inverse = small::inverse(&leading, n)?;
        Ok(Self { matrix, inverse, division: Division::new(n, m) })
    }

    /// Number of terms m.
    #[must_use]
    pub fn terms(&self) -> usize {
        self.division.terms()
    }

    /// Solve for one right-hand side of n series of m terms. Shorter series are allowed if all have equal length.
    ///
    /// # Errors
    /// [`Error::Length`].
    pub fn solve(&mut self, rhs: &[Vec<f64>]) -> Result<Vec<Vec<f64>>> {
        check_length("right-hand sides", self.matrix.len(), rhs.len())?;
        let asked = rhs.first().map_or(0, Vec::len).min(self.division.terms());
        for b in rhs {
            check_length("right-hand side", asked, b.len())?;
        }
        let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
        self.division.restart();
        self.division.run_to(asked, &self.matrix, &self.inverse, &borrowed);
        Ok(self.division.quotients().iter().map(|quotient| quotient[..asked].to_vec()).collect())
    }

    /// Series of A⁻¹: `[j][i]` is the response of unknown j to a unit pulse in the error of equation i. n solutions.
    ///
    /// # Errors
    /// As [`Solver::solve`].
    pub fn inverse(&mut self) -> Result<Vec<Vec<Vec<f64>>>> {
        let (m, n) = (self.division.terms(), self.matrix.len());
        let mut rows = vec![Vec::with_capacity(n); n];
        for i in 0..n {
            let mut unit = vec![vec![0.0; m]; n];
            unit[i].first_mut().into_iter().for_each(|first| *first = 1.0);
            for (row, answer) in rows.iter_mut().zip(self.solve(&unit)?) {
                row.push(answer);
            }
        }
        Ok(rows)
    }

    /// Spectra of A⁻¹ for products of up to `total` terms in all factors together, see [`Solver::inverse`].
    ///
    /// # Errors
    /// As [`Solver::solve`].
    pub fn inverse_spectra(&mut self, total: usize) -> Result<Vec<Vec<Kernel>>> {
        let spectra = |row: Vec<Vec<f64>>| row.iter().map(|series| Kernel::with_length(series, total)).collect();
        Ok(self.inverse()?.into_iter().map(spectra).collect())
    }
}
