//! Division of truncated power series by forward substitution in blocks. The blocks are joined by FFT products. O(m
//! log² m) for m terms.
//!
//! Blocks of 64 terms, of 2048 terms and so on each form a level. In each level the spectra of solved blocks and of the
//! segments of the divisor are computed once. For each later block, only products of these spectra are summed. The many
//! short transforms have separate code. The division is exact for every divisor with a nonzero leading coefficient,
//! also if the quotient is unstable. [`Division`] returns the quotient block by block, so that a search can stop the
//! simulation of a candidate early.

use std::borrow::Cow;

use super::block_transform::{self, Tile};
use super::product::Kernel;
use crate::error::{check_length, Error, Result};
use crate::fft::{self, Bin, Plan, Workspace};
use crate::linalg::small;
use crate::simd::{self, LANE_COUNT};

pub use super::block_transform::BLOCK_TERMS;

/// Number of terms whose sums stay in processor registers while products are subtracted.
const TILE_TERMS: usize = 8;

/// Subtract a product from the remaining terms: `remainder[i] −= Σ_s series[TILE_TERMS − s + i]·solved[s]`.
#[inline(always)]
fn subtract_product(remainder: &mut [f64], series: &[f64], solved: &[f64; TILE_TERMS]) {
    let mut offset = TILE_TERMS;
    let mut pairs = remainder.chunks_exact_mut(2 * TILE_TERMS);
    for pair in &mut pairs {
        subtract_tile_product::<{ 2 * TILE_TERMS }>(pair, &series[offset - TILE_TERMS..], solved);
        offset += 2 * TILE_TERMS;
    }
    let mut tiles = pairs.into_remainder().chunks_exact_mut(TILE_TERMS);
    for tile in &mut tiles {
        subtract_tile_product::<TILE_TERMS>(tile, &series[offset - TILE_TERMS..], solved);
        offset += TILE_TERMS;
    }
    let rest = tiles.into_remainder();
    for (s, &y) in solved.iter().enumerate() {
        for (term, &v) in rest.iter_mut().zip(&series[offset - s..]) {
            *term -= v * y;
        }
    }
}

/// Subtract a product from L remaining terms as in [`subtract_product`], with the sums in processor registers.
#[inline(always)]
fn subtract_tile_product<const L: usize>(remainder: &mut [f64], series: &[f64], solved: &[f64; TILE_TERMS]) {
    let mut sums = [0.0; L];
    sums.copy_from_slice(remainder);
    for (s, &y) in solved.iter().enumerate() {
        let part = &series[TILE_TERMS - s..][..L];
        for i in 0..L {
            sums[i] -= part[i] * y;
        }
    }
    remainder.copy_from_slice(&sums);
}

/// Forward substitution within a block of one unknown, in place. This task is compiled for the widest vector
/// instructions available.
struct Substitution<'a> {
    /// Divisor, a power series of at least the length of the block.
    divisor: &'a [f64],
    /// Reciprocal of the leading coefficient of the divisor.
    inverse: f64,
    /// Right-hand side, replaced by the quotient.
    block: &'a mut [f64],
}

impl simd::SimdKernel for Substitution<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let mut head = [0.0; TILE_TERMS];
        let count = self.divisor.len().min(TILE_TERMS);
        head[..count].copy_from_slice(&self.divisor[..count]);
        head.iter_mut().for_each(|v| *v *= self.inverse);
        let mut remainder = self.block;
        while remainder.len() >= TILE_TERMS {
            let (tile, later) = remainder.split_at_mut(TILE_TERMS);
            // With a constant length the loop is unrolled and its values stay in registers.
            let mut solved = [0.0; TILE_TERMS];
            for k in 0..TILE_TERMS {
                solved[k] = tile[k] * self.inverse;
            }
            for k in 0..TILE_TERMS {
                for i in k + 1..TILE_TERMS {
                    solved[i] -= head[i - k] * solved[k];
                }
            }
            tile.copy_from_slice(&solved);
            subtract_product(later, self.divisor, &solved);
            remainder = later;
        }
        for k in 0..remainder.len() {
            remainder[k] *= self.inverse;
            let y = remainder[k];
            for (term, &v) in remainder[k + 1..].iter_mut().zip(&self.divisor[1..]) {
                *term -= v * y;
            }
        }
    }
}

/// Maximum number of blocks of one level. A block of the next level is as long as all these blocks together. 32 was the
/// fastest of 8, 16 and 32 at m = 2048 terms.
const MAX_LEVEL_BLOCKS: usize = 32;

/// Spectra for one block length in a division with n unknown series: the spectra of the solved blocks, and those of
/// segments of the n² series of the matrix. Products of both are the contributions of solved blocks to later blocks.
///
/// Segment d contains the terms d·len to (d + 2)·len of a series. The second half of its product with block k is the
/// contribution to block k + d + 1. Contributions of several blocks are summed as spectra. A tile is a group of
/// adjacent frequency bins. The spectra of one tile are contiguous for each equation, with ascending blocks and
/// descending segments.
struct Level {
    /// Transform for this block length.
    transform: Transform,
    /// Block length in terms.
    len: usize,
    /// Number of blocks of this length for which memory is allocated.
    capacity: usize,
    /// Spectra of the solved blocks, ordered by tile (group of frequency bins), block and unknown.
    blocks: Vec<Tile>,
    /// Spectra of segments of the matrix series, ordered by tile (group of frequency bins), equation, descending
    /// segment and unknown.
    segment_spectra: Vec<Tile>,
    /// Number of segments of each matrix series whose spectra have been computed.
    known_segments: usize,
    /// Spectrum of the contribution of solved blocks to one later block.
    sum: Vec<Tile>,
}

/// Transform for one block length. Products of spectra give the contribution of a block of the quotient to a later
/// block.
enum Transform {
    /// Transform of the shortest blocks, of [`BLOCK_TERMS`] terms.
    Block,
    /// Cyclic transform of twice the length of a block. Terms that wrap around affect only the first half, which is not
    /// used.
    Cyclic(Plan),
}

impl Transform {
    /// Return the number of tiles of a spectrum. A tile is a group of [`LANE_COUNT`] frequency bins.
    fn tiles(&self) -> usize {
        match self {
            Self::Block => LANE_COUNT,
            Self::Cyclic(plan) => plan.bins().div_ceil(LANE_COUNT),
        }
    }
}

impl Level {
    /// Allocate the spectra for the block length `len` in a division with `n` unknown series of `m` terms.
    fn new(len: usize, n: usize, m: usize) -> Self {
        let transform = if len == BLOCK_TERMS { Transform::Block } else { Transform::Cyclic(fft::plan(2 * len)) };
        let capacity = m.div_ceil(len).min(MAX_LEVEL_BLOCKS);
        let tiles = transform.tiles();
        let size = tiles * capacity * n;
        let zeros = |size: usize| vec![[[0.0; LANE_COUNT]; 2]; size];
        Self {
            transform,
            len,
            capacity,
            blocks: zeros(size),
            segment_spectra: zeros(size * n),
            known_segments: 0,
            sum: zeros(tiles),
        }
    }
}

/// Buffers for the transforms of one level.
#[derive(Default)]
struct LevelBuffers {
    time: Vec<f64>,
    spectrum: Vec<Bin>,
    workspace: Workspace,
}

impl LevelBuffers {
    /// Write the spectrum of the values, padded with zeros, to every `stride`-th tile. A tile is a group of frequency
    /// bins.
    fn transform(&mut self, transform: &Transform, values: &[f64], tiles: &mut [Tile], stride: usize) {
        let plan = match transform {
            Transform::Block => return block_transform::transform(values, tiles, stride),
            Transform::Cyclic(plan) => plan,
        };
        self.time.resize(plan.len(), 0.0);
        self.spectrum.resize(plan.bins(), Bin::new(0.0, 0.0));
        self.time[..values.len()].copy_from_slice(values);
        self.time[values.len()..].fill(0.0);
        plan.transform(&mut self.time, &mut self.spectrum, &mut self.workspace);
        for (bins, tile) in self.spectrum.chunks(LANE_COUNT).zip(tiles.iter_mut().step_by(stride)) {
            for (l, bin) in bins.iter().enumerate() {
                (tile[0][l], tile[1][l]) = (bin.re, bin.im);
            }
        }
    }

    /// Return the contribution of solved blocks to a later block, from its spectrum `tiles`.
    fn invert(&mut self, transform: &Transform, tiles: &[Tile]) -> &[f64] {
        let plan = match transform {
            Transform::Block => {
                self.time.clear();
                self.time.extend(block_transform::middle_product(tiles));
                return &self.time;
            }
            Transform::Cyclic(plan) => plan,
        };
        self.time.resize(plan.len(), 0.0);
        self.spectrum.resize(plan.bins(), Bin::new(0.0, 0.0));
        for (bins, tile) in self.spectrum.chunks_mut(LANE_COUNT).zip(tiles) {
            for (l, bin) in bins.iter_mut().enumerate() {
                *bin = Bin::new(tile[0][l], tile[1][l]);
            }
        }
        plan.inverse(&mut self.spectrum, &mut self.time, &mut self.workspace);
        &self.time[plan.len() / 2..]
    }
}

/// Computation of one spectrum, for equation `i` of `n` in the next block: the sum of the contributions of the first
/// `count` solved blocks of one length. This task is compiled for the widest vector instructions available.
struct Contributions<'a> {
    n: usize,
    i: usize,
    count: usize,
    level: &'a Level,
    sum: &'a mut [Tile],
}

impl simd::SimdKernel for Contributions<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { n, i, count, level: Level { capacity, blocks, segment_spectra, .. }, sum } = self;
        let terms = count * n;
        for t in 0..sum.len() {
            let blocks = &blocks[t * capacity * n..][..terms];
            let segment_spectra = &segment_spectra[((t * n + i + 1) * capacity - count) * n..][..terms];
            let [mut re, mut im] = [[0.0; LANE_COUNT]; 2];
            for k in 0..terms {
                let ([x_re, x_im], [k_re, k_im]) = (&blocks[k], &segment_spectra[k]);
                for l in 0..LANE_COUNT {
                    re[l] += x_re[l] * k_re[l] - x_im[l] * k_im[l];
                    im[l] += x_re[l] * k_im[l] + x_im[l] * k_re[l];
                }
            }
            sum[t] = [re, im];
        }
    }
}

/// State of the solution of an n × n system of series, which computes the quotients (unknown series) block by block.
///
/// The caller adds right-hand sides block by block ([`Division::add`]). [`Division::advance`] then solves the next
/// block and subtracts the contributions of solved blocks from one later block. This later block is as long as the
/// longest block that ends at the last solved term. The spectrum of every block is computed once.
pub struct Division {
    n: usize,
    m: usize,
    solved_count: usize,
    /// One series per unknown. Its solved terms are those of the quotient. The other terms are the right-hand side
    /// minus the contributions of the solved blocks.
    remainders: Vec<Vec<f64>>,
    /// Spectra by block length, the shortest first.
    levels: Vec<Level>,
    buffers: LevelBuffers,
}

impl Division {
    /// Return the initial state of a division for n unknown series of m terms, with right-hand sides of 0.
    #[must_use]
    pub fn new(n: usize, m: usize) -> Self {
        Self {
            n,
            m,
            solved_count: 0,
            remainders: vec![vec![0.0; m]; n],
            levels: Vec::new(),
            buffers: LevelBuffers::default(),
        }
    }

    /// Reset the division for another divisor. Memory stays allocated.
    pub fn reset(&mut self) {
        self.levels.iter_mut().for_each(|level| level.known_segments = 0);
        self.restart();
    }

    /// Reset the right-hand sides to 0. The spectra of the divisor are kept, so the divisor must not change.
    pub fn restart(&mut self) {
        self.solved_count = 0;
        self.remainders.iter_mut().for_each(|r| r.fill(0.0));
    }

    /// Solve all terms for complete right-hand sides. `inverse` is the row-major inverse of the matrix of leading
    /// coefficients.
    pub(super) fn run<S: AsRef<[f64]>>(&mut self, matrix: &[Vec<S>], inverse: &[f64], rhs: &[&[f64]]) {
        self.run_to(self.m, matrix, inverse, rhs);
    }

    /// Solve at least the first `terms` terms, rounded up to whole blocks, for complete right-hand sides. `inverse` is
    /// the row-major inverse of the matrix of leading coefficients.
    pub(super) fn run_to<S: AsRef<[f64]>>(&mut self, terms: usize, matrix: &[Vec<S>], inverse: &[f64], rhs: &[&[f64]]) {
        for (i, b) in rhs.iter().enumerate() {
            self.add(i, 0, b);
        }
        while self.solved_count < terms {
            self.advance(inverse, |i, j, len| &matrix[i][j].as_ref()[..len]);
        }
    }

    /// Return the number of terms that are solved in every unknown series.
    #[must_use]
    pub fn solved_terms(&self) -> usize {
        self.solved_count
    }

    /// Add values to the right-hand side of equation i from term `start` on. These terms must not be solved yet.
    pub fn add(&mut self, i: usize, start: usize, values: &[f64]) {
        for (term, &v) in self.remainders[i][start..].iter_mut().zip(values) {
            *term += v;
        }
    }

    /// Return the solved terms of unknown series i.
    #[must_use]
    pub fn quotient(&self, i: usize) -> &[f64] {
        &self.remainders[i][..self.solved_count]
    }

    /// Return all unknown series. Terms that are not solved yet are remainders.
    pub(super) fn quotients(&self) -> &[Vec<f64>] {
        &self.remainders
    }

    /// Return all unknown series, which must be solved completely.
    #[must_use]
    pub fn into_quotients(self) -> Vec<Vec<f64>> {
        self.remainders
    }

    /// Return the number of terms of each divisor series that the next [`Division::advance`] reads.
    #[must_use]
    pub fn required_terms(&self) -> usize {
        let hi = (self.solved_count + BLOCK_TERMS).min(self.m);
        if hi == self.m {
            return hi - self.solved_count;
        }
        let (_, len, count) = level_at(hi);
        ((count + 1) * len).min(self.m)
    }

    /// Return the number of terms of an unknown series.
    #[must_use]
    pub fn terms(&self) -> usize {
        self.m
    }

    /// Solve the next block, and subtract the contributions of solved blocks from later terms.
    ///
    /// `inverse` is the row-major inverse of the matrix of leading coefficients. `series(i, j, len)` returns the first
    /// `len` terms of the matrix series A_ij. `len` never exceeds [`Division::required_terms`].
    pub fn advance<'a>(&mut self, inverse: &[f64], series: impl Fn(usize, usize, usize) -> &'a [f64]) {
        self.solve_block(inverse, &series);
        self.subtract_contributions(&series);
    }

    /// Compute the next block of the quotients by forward substitution, the first step of [`Division::advance`].
    pub fn solve_block<'a>(&mut self, inverse: &[f64], series: impl Fn(usize, usize, usize) -> &'a [f64]) {
        let lo = self.solved_count;
        let hi = (lo + BLOCK_TERMS).min(self.m);
        self.substitute(inverse, &series, lo, hi);
        self.solved_count = hi;
    }

    /// Subtract the contributions of solved blocks from later terms, the second step of [`Division::advance`].
    pub fn subtract_contributions<'a>(&mut self, series: impl Fn(usize, usize, usize) -> &'a [f64]) {
        let (n, hi) = (self.n, self.solved_count);
        if hi == self.m {
            return;
        }
        let (level, len, count) = level_at(hi);
        let end = (hi + len).min(self.m);
        while self.levels.len() <= level {
            let len = self.levels.last().map_or(BLOCK_TERMS, |level| level.len * MAX_LEVEL_BLOCKS);
            self.levels.push(Level::new(len, n, self.m));
        }
        let Self { remainders, levels, buffers, m, .. } = self;
        let level = &mut levels[level];
        let stride = level.capacity * n;
        for segment in level.known_segments..count {
            for k in 0..n * n {
                let (i, j) = (k / n, k % n);
                let terms = ((segment + 2) * len).min(*m);
                let at = (i * level.capacity + level.capacity - 1 - segment) * n + j;
                let values = &series(i, j, terms)[segment * len..];
                buffers.transform(&level.transform, values, &mut level.segment_spectra[at..], n * stride);
            }
        }
        level.known_segments = level.known_segments.max(count);
        for (j, remainder) in remainders.iter().enumerate() {
            let at = (count - 1) * n + j;
            buffers.transform(&level.transform, &remainder[hi - len..hi], &mut level.blocks[at..], stride);
        }
        let mut sum = std::mem::take(&mut level.sum);
        for (i, remainder) in remainders.iter_mut().enumerate() {
            simd::dispatch_simd(Contributions { n, i, count, level, sum: &mut sum });
            let contribution = buffers.invert(&level.transform, &sum);
            for (term, &v) in remainder[hi..end].iter_mut().zip(contribution) {
                *term -= v;
            }
        }
        level.sum = sum;
    }

    /// Solve the terms `lo … hi − 1` of all quotients by forward substitution, with the row-major inverse of the matrix
    /// of leading coefficients.
    fn substitute<'a>(
        &mut self,
        inverse: &[f64],
        series: &impl Fn(usize, usize, usize) -> &'a [f64],
        lo: usize,
        hi: usize,
    ) {
        let n = self.n;
        if n == 1 {
            let (divisor, block) = (series(0, 0, hi - lo), &mut self.remainders[0][lo..hi]);
            simd::dispatch_simd(Substitution { divisor, inverse: inverse[0], block });
            return;
        }
        let mut values = vec![0.0; n];
        for k in lo..hi {
            for (i, value) in values.iter_mut().enumerate() {
                *value = (0..n).map(|j| inverse[i * n + j] * self.remainders[j][k]).sum();
            }
            for (j, &y) in values.iter().enumerate() {
                self.remainders[j][k] = y;
            }
            for i in 0..n {
                for (j, &y) in values.iter().enumerate() {
                    let a = series(i, j, hi - lo);
                    for (term, &v) in self.remainders[i][k + 1..hi].iter_mut().zip(&a[1..]) {
                        *term -= v * y;
                    }
                }
            }
        }
    }
}

/// Return (level, block length, block count) for a number of solved terms. The level is the one with the longest block
/// that ends at these terms. The count is the number of blocks of this level that contribute to the next block.
fn level_at(solved: usize) -> (usize, usize, usize) {
    let (mut level, mut len, mut count) = (0, BLOCK_TERMS, solved / BLOCK_TERMS);
    while count != 0 && count.is_multiple_of(MAX_LEVEL_BLOCKS) {
        (level, len, count) = (level + 1, len * MAX_LEVEL_BLOCKS, count / MAX_LEVEL_BLOCKS);
    }
    (level, len, count % MAX_LEVEL_BLOCKS)
}

/// Return the first m terms of the quotient of two power series, where m is the length of the numerator. The quotient
/// is exact also if it is unstable. O(m log² m).
///
/// # Errors
/// [`Error::LeadingZero`] if the divisor starts with zero, [`Error::Length`] if it is shorter than m.
pub fn divide(numerator: &[f64], divisor: &[f64]) -> Result<Vec<f64>> {
    let quotient = solve(&[vec![divisor]], &[numerator])?;
    quotient.into_iter().next().ok_or_else(|| Error::Internal { what: "a division without a quotient".into() })
}

/// Return the first m terms of the reciprocal of a power series of m terms. The result is not finite if the series
/// starts with zero. O(m log² m).
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

/// Solve the n × n system Σ_j A_ij y_j = b_i of power series, truncated to m terms. The series A_ij have at least m
/// terms, the right-hand sides b_i exactly m. Return the n series y_j. O(n² m log² m).
///
/// # Errors
/// [`Error::LeadingZero`] if the matrix of leading coefficients is singular. [`Error::Length`] for a matrix that is not
/// square, or series of wrong length.
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

/// Solver of a system of series for many right-hand sides. The spectra of the matrix are computed once.
pub struct Solver<'a> {
    matrix: Cow<'a, [Vec<Vec<f64>>]>,
    inverse: Vec<f64>,
    division: Division,
}

impl<'a> Solver<'a> {
    /// Return a solver for an n × n matrix whose elements are series of m terms.
    ///
    /// # Errors
    /// [`Error::LeadingZero`] if the matrix of leading coefficients is singular. [`Error::Length`] for a matrix that is
    /// not square, or series of wrong length.
    pub fn new(matrix: &'a [Vec<Vec<f64>>]) -> Result<Self> {
        Self::of(Cow::Borrowed(matrix))
    }

    /// Return a solver that owns its matrix.
    ///
    /// # Errors
    /// [`Error::LeadingZero`] if the matrix of leading coefficients is singular. [`Error::Length`] if the matrix is not
    /// square or its series differ in length.
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

    /// Return the number of terms m.
    #[must_use]
    pub fn terms(&self) -> usize {
        self.division.terms()
    }

    /// Solve the system for one right-hand side, which is n series of m terms. Shorter series are allowed if all have
    /// equal length. Return n series of this length.
    ///
    /// # Errors
    /// [`Error::Length`] for a wrong number of series, or for series of unequal length or of more than m terms.
    pub fn solve(&mut self, rhs: &[Vec<f64>]) -> Result<Vec<Vec<f64>>> {
        check_length("right-hand sides", self.matrix.len(), rhs.len())?;
        let terms = rhs.first().map_or(0, Vec::len).min(self.division.terms());
        for b in rhs {
            check_length("right-hand side", terms, b.len())?;
        }
        let borrowed: Vec<&[f64]> = rhs.iter().map(Vec::as_slice).collect();
        self.division.restart();
        self.division.run_to(terms, &self.matrix, &self.inverse, &borrowed);
        Ok(self.division.quotients().iter().map(|quotient| quotient[..terms].to_vec()).collect())
    }

    /// Return the series of the inverse A⁻¹ of the matrix. Element `[j][i]` is the response of unknown j to a unit
    /// pulse in the error of equation i. Takes n solutions.
    ///
    /// # Errors
    /// [`Error::Length`] for series that do not match the matrix ([`Solver::solve`]).
    pub fn inverse(&mut self) -> Result<Vec<Vec<Vec<f64>>>> {
        let (m, n) = (self.division.terms(), self.matrix.len());
        let mut rows = vec![Vec::with_capacity(n); n];
        for i in 0..n {
            let mut unit = vec![vec![0.0; m]; n];
            unit[i].first_mut().into_iter().for_each(|first| *first = 1.0);
            for (row, solution) in rows.iter_mut().zip(self.solve(&unit)?) {
                row.push(solution);
            }
        }
        Ok(rows)
    }

    /// Return the spectra of the inverse A⁻¹ of the matrix ([`Solver::inverse`]). They serve for products whose factors
    /// have up to `total` terms together.
    ///
    /// # Errors
    /// [`Error::Length`] for series that do not match the matrix ([`Solver::solve`]).
    pub fn inverse_spectra(&mut self, total: usize) -> Result<Vec<Vec<Kernel>>> {
        let spectra = |row: Vec<Vec<f64>>| row.iter().map(|series| Kernel::with_length(series, total)).collect();
        Ok(self.inverse()?.into_iter().map(spectra).collect())
    }
}
