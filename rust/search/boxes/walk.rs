//! The candidates of a slab that no box excludes: boxes are halved until they are excluded or small.

use std::borrow::Cow;
use std::ops::Range;

use crate::error::Result;
use crate::lanes::{self, WIDTH};
use crate::regressors::Record;
use crate::search::bound::lower::Bound;
use crate::search::bound::probes::{Probes, NONE};
use crate::search::boxes::cell::{Common, Slab, Stretch, Strip, MOST_OTHERS};
use crate::search::boxes::side::{Others, Side};
use crate::search::candidate::problem::Problem;
use crate::search::catalogue::Catalogue;
use crate::search::lattice::cursor::Cursor;
use crate::search::lattice::slab;
use crate::search::lattice::Lattice;
use crate::search::options::{Criterion, Estimator, Norm, Options};
use crate::search::screen::{Open, Screen};
use crate::search::threads::pool;
use crate::small;
use crate::stop::Stop;

/// Fewest candidates of a slab for which its tables pay.
pub(crate) const LEAST: u64 = 4096;
/// Levels that a box begins with: stretches of 32 values.
const COARSE: usize = 5;
/// Levels, of both orders together, below which candidates are screened one by one.
const FINE: usize = 4;

/// What all boxes of a search share.
pub(crate) struct Boxes {
    common: Common,
    rounding: f64,
}

impl Boxes {
    /// Whether boxes can be had for a search and pay: it ranks by free runs at rest or by squared equation errors, its
    /// coefficients are all least squares', and some slab is large.
    pub(crate) fn pay(catalogue: &Catalogue<'_>) -> bool {
        let (options, lattice) = (&catalogue.options, &*catalogue.lattice);
        options.early_stopping
            && options.estimator == Estimator::LeastSquares
            && (options.criterion == Criterion::OutputError || options.scored_by_products())
            && catalogue.problem.equations.whole().is_some()
            && (2..=MOST_OTHERS + 2).contains(&lattice.width())
            && lattice
                .blocks()
                .iter()
                .any(|block| lattice.slab(block.start).is_some_and(|slab| lattice.largest(&slab) >= LEAST))
    }

    /// What they share; none where there is no bound, or where it would need too much memory. Runs on the current thread
    /// pool.
    pub(crate) fn new(catalogue: &Catalogue<'_>) -> Option<Self> {
        let problem = &catalogue.problem;
        let (probes, normal) = (probes(problem)?, problem.equations.whole()?);
        #[allow(clippy::cast_precision_loss)]
        let rounding = f64::EPSILON * problem.samples() as f64;
        let others = Others { normal, probes, columns: &[], inverse: &[], trace: 0.0, rounding, partner: None };
        let common = Common::new(&others, catalogue.options.norm, problem.squares.is_some(), problem.size());
        Some(Self { common, rounding })
    }

    fn others<'a>(&self, catalogue: &'a Catalogue<'_>, columns: &'a [usize], inverse: &'a [f64]) -> Option<Others<'a>> {
        let (k, probes) = (columns.len(), probes(&catalogue.problem)?);
        let partner = probes.first().and_then(|probes| columns.iter().position(|&p| probes.rows[p] != NONE));
        Some(Others {
            normal: catalogue.problem.equations.whole()?,
            probes,
            partner,
            columns,
            inverse,
            trace: (0..k).map(|i| inverse[i * k + i]).sum::<f64>().max(1.0),
            rounding: self.rounding,
        })
    }
}

/// The test vectors of a search, which has none where squared equation errors rank; none at all where nothing is proved.
fn probes(problem: &Problem) -> Option<&[Probes]> {
    match (&problem.squares, &problem.bound) {
        (Some(_), _) => Some(&[]),
        (None, bound) => bound.as_ref().map(Bound::probes),
    }
}

/// Screens candidates `lo … hi − 1` of a slab against a limit: the open ones, and the singular ones among those that no
/// box excludes; how many are in boxes that are excluded whole. None where boxes prove nothing here.
pub(crate) fn screen_slab(
    catalogue: &Catalogue<'_>,
    boxes: &Boxes,
    slab: &slab::Slab,
    (lo, hi): (u64, u64),
    limit: f64,
) -> Option<(Vec<Open>, Vec<u64>, u64)> {
    lanes::widest(Walk { catalogue, boxes, slab, lo, hi, limit })
}

/// [`screen_slab`] as a kernel.
struct Walk<'a> {
    catalogue: &'a Catalogue<'a>,
    boxes: &'a Boxes,
    slab: &'a slab::Slab,
    lo: u64,
    hi: u64,
    limit: f64,
}

impl lanes::Kernel for Walk<'_> {
    type Output = Option<(Vec<Open>, Vec<u64>, u64)>;

    #[inline(always)]
    fn run(self) -> Self::Output {
        let Self { catalogue, boxes, slab, lo, hi, limit } = self;
        let len = slab.len as u64;
        #[allow(clippy::cast_possible_truncation)]
        let rows = ((lo - slab.lo) / len) as usize..((hi - slab.lo).div_ceil(len)) as usize;
        let columns = columns(catalogue, slab);
        let (others, inverse) = others(catalogue, slab, &columns)?;
        let others = boxes.others(catalogue, &others, &inverse)?;
        let ready = ready(catalogue, boxes, slab, &others, rows.clone())?;
        let start = slab.lo + rows.start as u64 * len;
        let mut screen = Screen::<WIDTH>::new(columns.len());
        let (mut found, mut waiting) = ((Vec::new(), Vec::new()), [(0, 0, 0); WIDTH]);
        let (mut count, mut boxed) = (0, hi - lo);
        let lengths = [rows.len(), slab.len];
        let coarse = lengths.map(|n| COARSE.min(n.next_power_of_two().trailing_zeros() as usize));
        let (mut stack, mut strip) = (Vec::new(), Strip::default());
        for at in 0..lengths[0].div_ceil(1 << coarse[0]) {
            ready.lay(&mut strip, at << coarse[0]..lengths[0].min((at + 1) << coarse[0]));
            for by in 0..lengths[1].div_ceil(1 << coarse[1]) {
                stack.push([Stretch { level: coarse[0], at }, Stretch { level: coarse[1], at: by }]);
                while let Some([u, v]) = stack.pop() {
                    if let Some(cell) = ready.cell(&strip, [u, v]) {
                        if ready.bound([u, v], &cell, limit) > limit {
                            continue;
                        }
                    }
                    if u.level + v.level > FINE {
                        let part = usize::from(v.level > u.level);
                        let halved = [u, v][part];
                        for at in [2 * halved.at + 1, 2 * halved.at] {
                            if at << (halved.level - 1) < lengths[part] {
                                let mut next = [u, v];
                                next[part] = Stretch { level: halved.level - 1, at };
                                stack.push(next);
                            }
                        }
                        continue;
                    }
                    let ((u0, u1), (v0, v1)) = (u.ends(lengths[0]), v.ends(lengths[1]));
                    for row in u0..=u1 {
                        for value in v0..=v1 {
                            let index = start + row as u64 * len + value as u64;
                            if index < lo || index >= hi {
                                continue;
                            }
                            boxed -= 1;
                            waiting[count] = (index, ready.sides[0].columns[row], ready.sides[1].columns[value]);
                            count += 1;
                            if count == WIDTH {
                                screen.these(catalogue, slab, &columns, &waiting[..count], limit, &mut found);
                                count = 0;
                            }
                        }
                    }
                }
            }
        }
        if count > 0 {
            screen.these(catalogue, slab, &columns, &waiting[..count], limit, &mut found);
        }
        let (open, singular) = found;
        Some((open, singular, boxed))
    }
}

/// Column of every term at the first candidate of a slab.
#[inline(always)]
fn columns(catalogue: &Catalogue<'_>, slab: &slab::Slab) -> Vec<usize> {
    slab.digits.iter().enumerate().map(|(term, &digit)| catalogue.columns(slab.block, term)[digit]).collect()
}

/// Columns of the terms whose orders do not vary, and the inverse of their correlations.
#[inline(always)]
fn others(catalogue: &Catalogue<'_>, slab: &slab::Slab, columns: &[usize]) -> Option<(Vec<usize>, Vec<f64>)> {
    let others: Vec<usize> =
        (0..columns.len()).filter(|&t| t != slab.outer && t != slab.inner).map(|t| columns[t]).collect();
    let normal = catalogue.problem.equations.whole()?;
    let inverse = inverse(&others, |a, b| normal.product(a, b)).ok()?;
    Some((others, inverse))
}

/// The tables of some rows of a slab.
#[inline(always)]
fn ready<'a>(
    catalogue: &Catalogue<'_>,
    boxes: &'a Boxes,
    slab: &slab::Slab,
    others: &'a Others<'a>,
    rows: Range<usize>,
) -> Option<Slab<'a>> {
    let columns_of = |term: usize| catalogue.columns(slab.block, term);
    let outer = slab.rows[rows].iter().map(|&digit| columns_of(slab.outer)[digit]).collect();
    let inner = columns_of(slab.inner)[slab.first..slab.first + slab.len].to_vec();
    let sides = [Side::new(others, outer)?, Side::new(others, inner)?];
    Some(Slab::new(others, &boxes.common, sides))
}

/// Inverse of the correlations of some columns.
fn inverse(columns: &[usize], product: impl Fn(usize, usize) -> f64) -> Result<Vec<f64>> {
    if columns.is_empty() {
        return Ok(Vec::new());
    }
    let matrix: Vec<f64> =
        columns.iter().flat_map(|&a| columns.iter().map(move |&b| (a, b))).map(|(a, b)| product(a, b)).collect();
    small::inverse(&matrix, columns.len())
}

/// What is proved of a box of candidates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Boxed {
    /// The candidates `first + i·stride + j`, i below `rows` and j below `values`.
    pub first: u64,
    /// See `first`.
    pub rows: u64,
    /// See `first`.
    pub values: u64,
    /// See `first`.
    pub stride: u64,
    /// No candidate's raw error at rest, Σ|e| or Σe² with least-squares coefficients, is below this.
    pub bound: f64,
}

/// What is proved of every box of the slab that holds a candidate: the boxes of all sizes, down to single candidates, of
/// output errors in either norm or of equation errors in squares.
///
/// Empty where the lattice has no slabs (its fastest signal has several terms, or no other has orders to vary) or where
/// nothing is proved of this one.
///
/// # Errors
/// As [`crate::search::rounds::search`].
///
/// ```
/// # use ftlm::search::{boxes::box_bounds, lattice::{Lattice, TermAxis}};
/// # use ftlm::search::options::{Criterion, Norm};
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..64).map(|k| if k % 16 < 8 { 1.0 } else { -1.0 }).collect();
/// # let output = Record::new(0.1, vec![input.clone()], None)?.integral(0, 0.8);
/// let record = Record::new(0.1, vec![output, input], None)?;
/// let axis = |signal, values: &[f64]| TermAxis { signal, values: values.to_vec(), interchangeable: false };
/// let lattice = Lattice::new(0, &[1.6], &[axis(0, &[0.1, 0.3, 0.5]), axis(1, &[0.0, 0.4])], |s| s == 1)?;
/// let boxes = box_bounds(&[record], &lattice, Criterion::OutputError, Norm::L1, 0)?;
/// assert!(boxes.iter().any(|b| b.rows * b.values == 6) && boxes.iter().any(|b| b.rows * b.values == 1));
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn box_bounds(
    records: &[Record],
    lattice: &Lattice,
    criterion: Criterion,
    norm: Norm,
    index: u64,
) -> Result<Vec<Boxed>> {
    with_slab(records, lattice, (criterion, norm), index, |catalogue, boxes, slab| {
        let columns = columns(catalogue, slab);
        let (others, inverse) = others(catalogue, slab, &columns)?;
        let others = boxes.others(catalogue, &others, &inverse)?;
        let ready = ready(catalogue, boxes, slab, &others, 0..slab.rows.len())?;
        let mut strip = Strip::default();
        ready.lay(&mut strip, 0..slab.rows.len());
        let mut found = Vec::new();
        let levels = [0, 1].map(|side: usize| ready.sides[side].levels.len());
        for (a, b) in (0..levels[0]).flat_map(|a| (0..levels[1]).map(move |b| (a, b))) {
            for at in 0..ready.sides[0].levels[a].plain.len() {
                for by in 0..ready.sides[1].levels[b].plain.len() {
                    let both = [Stretch { level: a, at }, Stretch { level: b, at: by }];
                    let ((u0, u1), (v0, v1)) = (both[0].ends(slab.rows.len()), both[1].ends(slab.len));
                    let cell = ready.cell(&strip, both);
                    let bound = cell.map_or(0.0, |cell| ready.bound(both, &cell, f64::INFINITY));
                    found.push(Boxed {
                        first: slab.lo + (u0 * slab.len + v0) as u64,
                        rows: (u1 - u0 + 1) as u64,
                        values: (v1 - v0 + 1) as u64,
                        stride: slab.len as u64,
                        bound,
                    });
                }
            }
        }
        Some(found)
    })
}

/// The candidates `lo … hi − 1` of the slab that holds `index` that no box excludes and no bound of their own: among them
/// are all whose raw error at rest is at most `limit`. Empty where [`box_bounds`] is.
///
/// # Errors
/// As [`crate::search::rounds::search`].
pub fn left_open(
    records: &[Record],
    lattice: &Lattice,
    criterion: Criterion,
    norm: Norm,
    index: u64,
    range: Range<u64>,
    limit: f64,
) -> Result<Vec<u64>> {
    with_slab(records, lattice, (criterion, norm), index, |catalogue, boxes, slab| {
        let range = (range.start.clamp(slab.lo, slab.hi), range.end.clamp(slab.lo, slab.hi));
        let (open, ..) = screen_slab(catalogue, boxes, slab, range, limit)?;
        Some(open.iter().map(|open| open.index).collect())
    })
}

/// What comes of the slab that holds a candidate, with all test vectors; nothing where it has no boxes.
fn with_slab<T>(
    records: &[Record],
    lattice: &Lattice,
    (criterion, norm): (Criterion, Norm),
    index: u64,
    work: impl FnOnce(&Catalogue<'_>, &Boxes, &slab::Slab) -> Option<Vec<T>> + Send,
) -> Result<Vec<T>>
where
    T: Send,
{
    let pool = pool(1)?;
    let options = Options { criterion, norm, ..Options::default() };
    let fixed = vec![None; lattice.width()];
    let mut catalogue = Catalogue::new(records, Cow::Borrowed(lattice), &fixed, &options, &pool, &Stop::default())?;
    catalogue.problem = pool.install(|| catalogue.problem.with_bound(u64::MAX >> 8, &Stop::default()));
    if criterion == Criterion::OutputError {
        let mut adapted = catalogue.problem.no_adapted().0;
        for made_for in [index, 0, lattice.count() / 2, lattice.count() - 1] {
            let mut positions = vec![0; lattice.width()];
            catalogue.positions(&Cursor::at(lattice, made_for), &mut positions);
            adapted.each.extend(pool.install(|| catalogue.problem.fit(&adapted, &positions)));
        }
        catalogue.problem.adapted = Some(adapted);
    }
    let slab = lattice.slab(index).filter(|_| (2..=MOST_OTHERS + 2).contains(&lattice.width()));
    let Some(slab) = slab else { return Ok(Vec::new()) };
    Ok(pool.install(|| work(&catalogue, &Boxes::new(&catalogue)?, &slab)).unwrap_or_default())
}
