//! Order search over all equations of a stage under its order law, by joining the equations' score tables on the law.
//!
//! The law ties the equations' orders to a few free ones, so many tuples of free orders share an equation's orders.
//! Each equation's distinct orders are evaluated once. The free orders are split between the first equation and the
//! others: x = (a, b). An equation's orders are then what its own half of x gives plus what the other half adds, and
//! that addend takes few distinct values: (a, addend from b) and (b, addend from a) fit together exactly where each
//! names the other's addend. Rows of both halves meet in the bucket of the two addends; within a bucket every pair is a
//! tuple, and every tuple is one pair of one bucket. So the best tuples come from the best rows of the best buckets,
//! and what became of all is counted bucket by bucket; the product of the axes is never gone through.
//!
//! Table entries start as lower bounds (left early) and are sharpened until every tuple that could be kept is exact, so
//! the result is that of enumeration, ties by index.

use std::borrow::Cow;
use std::collections::hash_map::Entry as Slot;
use std::collections::{HashMap, HashSet};
use std::ops::Range;
use std::sync::atomic::Ordering;

use rayon::prelude::*;

use crate::equation::{grains, Structure, Term};
use crate::error::{check_length, Error, Result};
use crate::regressors::{Index, Record};
use crate::search::lattice::{LawEquation, LawLattice, Sums};
use crate::search::run::{
    index_alpha, index_orders, pool, Control, Counts, Failure, Norm, Options, Problem, Row, Scratch, Scratches,
    Verdict, LISTED,
};

/// An equation's candidates are first followed up to this multiple of its best score.
const FIRST_LIMIT: f64 = 4.0;
/// Candidates of one equation evaluated between two looks at its best score, at first: a later look tells less.
const ROUND: usize = 4096;

/// One kept tuple of free orders.
#[derive(Debug, Clone, PartialEq)]
pub struct StageRow {
    /// Index in the product of the axes.
    pub index: u64,
    /// Free orders.
    pub free: Vec<f64>,
    /// Sum of the equations' scores, each divided by its scale.
    pub score: f64,
    /// The structure of each equation.
    pub structures: Vec<Structure>,
    /// The row of each equation (its index is not used).
    pub rows: Vec<Row>,
}

/// The result of a search over a stage.
#[derive(Debug, Clone, PartialEq)]
pub struct StageOutcome {
    /// Kept rows, best first, ties by index.
    pub rows: Vec<StageRow>,
    /// What became of the tuples.
    pub counts: Counts,
    /// The first tuples without a score by index, at most 100.
    pub failures: Vec<(u64, Failure)>,
    /// Distinct candidates of each equation.
    pub distinct: Vec<u64>,
}

/// Sums of scores are compared with this much room: their terms may have been added in another order.
const ROUNDING: f64 = 1e-12;

/// What is known of one equation's candidate: its scaled score, or a bound below it.
#[derive(Debug, Clone, Copy)]
struct Entry {
    value: f64,
    class: Class,
}

/// What became of a candidate, or of several together: the first failure, else the largest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Class {
    Exact,
    /// A bound without a run is all that is known.
    Bounded,
    /// Left at a partial sum, or not looked at.
    Open,
    Failed(Failure),
}

impl Class {
    fn failed(self) -> bool {
        matches!(self, Self::Failed(_))
    }

    fn with(self, later: Self) -> Self {
        if self.failed() {
            self
        } else {
            self.max(later)
        }
    }
}

const OPEN: Entry = Entry { value: 0.0, class: Class::Open };

/// What is known of every candidate of every equation.
type Entries = Vec<Vec<Entry>>;

/// What the candidates of one equation share.
struct Table {
    problem: Problem,
    candidates: Candidates,
    /// Those that some tuple needs.
    used: Vec<usize>,
    scale: f64,
}

impl Table {
    fn entry(&self, verdict: Verdict) -> Entry {
        let score = |raw: f64| self.problem.score(raw) / self.scale;
        match verdict {
            Verdict::Score(raw) => Entry { value: score(raw), class: Class::Exact },
            Verdict::Bounded(raw) => Entry { value: score(raw), class: Class::Bounded },
            Verdict::Stopped(raw) => Entry { value: score(raw), class: Class::Open },
            Verdict::Failed(failure) => Entry { value: f64::INFINITY, class: Class::Failed(failure) },
        }
    }
}

/// Candidates `first … last − 1` of one equation, to be followed up to one limit of its scaled score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Span {
    /// Equation.
    pub equation: usize,
    /// See above.
    pub first: usize,
    /// See above.
    pub last: usize,
    /// See above.
    pub limit: f64,
}

/// Candidates of an equation with the limit of each, in stretches that share one.
fn spans(equation: usize, wanted: impl Iterator<Item = (usize, f64)>) -> Vec<Span> {
    let mut spans: Vec<Span> = Vec::new();
    for (id, limit) in wanted {
        match spans.last_mut() {
            Some(span) if span.last == id && span.limit.to_bits() == limit.to_bits() => span.last = id + 1,
            _ => spans.push(Span { equation, first: id, last: id + 1, limit }),
        }
    }
    spans
}

/// Distinct orders of one equation.
struct Candidates {
    output: usize,
    signals: Vec<usize>,
    /// α and the terms' orders, one candidate after the other.
    orders: Vec<f64>,
    ids: HashMap<Box<[i64]>, u32>,
}

impl Candidates {
    fn new(equation: &LawEquation) -> Self {
        let signals = equation.terms.iter().map(|t| t.0).collect();
        Self { output: equation.output, signals, orders: Vec::new(), ids: HashMap::new() }
    }

    fn len(&self) -> usize {
        self.ids.len()
    }

    /// Number of the candidate with these orders, added at the end if new.
    fn id(&mut self, orders: &[f64], key: &mut Vec<i64>) -> Result<u32> {
        key.clear();
        key.extend(orders.iter().map(|&v| grains(v)));
        if let Some(&id) = self.ids.get(key.as_slice()) {
            return Ok(id);
        }
        let id = number(self.ids.len())?;
        self.ids.insert(key.as_slice().into(), id);
        self.orders.extend_from_slice(orders);
        Ok(id)
    }

    fn structure(&self, id: usize) -> Structure {
        let width = self.signals.len() + 1;
        let orders = &self.orders[id * width..(id + 1) * width];
        let terms = self.signals.iter().zip(&orders[1..]).map(|(&signal, &order)| Term { signal, order }).collect();
        Structure { output: self.output, order: orders[0], terms }
    }
}

fn number(count: usize) -> Result<u32> {
    u32::try_from(count).map_err(|_| Error::Internal { what: "more than 2^32 distinct orders".into() })
}

/// A row of one half of the join: a choice of its own free orders, and the addend of the other half's.
#[derive(Debug, Clone, Copy)]
struct Part {
    /// The two addends by which it meets rows of the other half.
    bucket: u64,
    /// What its own free orders contribute to the index of a tuple.
    index: u64,
    /// Which candidates of its equations it names.
    combination: u32,
}

/// One half of the join.
struct Half {
    equations: Range<usize>,
    /// Candidates of each equation, combination after combination.
    combinations: Vec<u32>,
    parts: Vec<Part>,
}

impl Half {
    /// Sum and class of every combination.
    fn states(&self, known: &Entries) -> Vec<Entry> {
        let width = self.equations.len();
        if width == 0 {
            return vec![Entry { value: 0.0, class: Class::Exact }];
        }
        self.combinations
            .chunks_exact(width)
            .map(|ids| {
                let entries = self.equations.clone().zip(ids).map(|(e, &id)| known[e][id as usize]);
                entries.fold(Entry { value: 0.0, class: Class::Exact }, |sum, entry| Entry {
                    value: sum.value + entry.value,
                    class: sum.class.with(entry.class),
                })
            })
            .collect()
    }

    fn ids(&self, combination: u32) -> &[u32] {
        let width = self.equations.len();
        &self.combinations[combination as usize * width..][..width]
    }
}

/// Rows of both halves that fit together, each with each.
struct Bucket {
    rows: [Range<usize>; 2],
}

/// The layout of a join.
struct Join {
    halves: [Half; 2],
    buckets: Vec<Bucket>,
}

/// Most rows of both halves: they take a GB.
const MAX_PARTS: u128 = 40_000_000;
/// Free orders whose place in either half is tried; more go to the second.
const PLACED: usize = 10;

/// The free orders that go to the first half: those that leave the fewest rows.
fn split(lattice: &LawLattice, rows: &[Sums; 2], control: &Control) -> Result<Vec<usize>> {
    let axes: Vec<usize> = (0..lattice.axes().len()).collect();
    let size = |axes: &[usize]| axes.iter().map(|&a| lattice.axes()[a].len() as u128).product::<u128>();
    let several: Vec<usize> = axes.iter().copied().filter(|&a| lattice.axes()[a].len() > 1).take(PLACED).collect();
    let mut plans: Vec<(u128, Vec<usize>, Vec<usize>)> = (0..1usize << several.len())
        .map(|mask| {
            let own: Vec<usize> =
                several.iter().enumerate().filter(|(i, _)| mask >> i & 1 == 1).map(|(_, &axis)| axis).collect();
            let other: Vec<usize> = axes.iter().copied().filter(|axis| !own.contains(axis)).collect();
            (size(&own) + size(&other), own, other)
        })
        .collect();
    plans.sort();
    let (mut least, mut best) = (u128::MAX, Vec::new());
    for (floor, own, other) in plans {
        if control.stop.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        if floor >= least {
            break;
        }
        let limit = |size: u128| usize::try_from((least / size).min(MAX_PARTS)).unwrap_or(usize::MAX);
        let Some(first) = rows[0].image(lattice, &other, limit(size(&own))) else { continue };
        let Some(second) = rows[1].image(lattice, &own, limit(size(&other))) else { continue };
        let count = size(&own) * first.len() as u128 + size(&other) * second.len() as u128;
        if count < least {
            (least, best) = (count, own);
        }
    }
    if least > MAX_PARTS {
        return Err(Error::LatticeTooLarge { count: least.min(u128::from(lattice.product())), limit: MAX_PARTS });
    }
    Ok(best)
}

impl Join {
    /// Lays out the join and the distinct candidates of every equation; marks those that some tuple needs.
    fn new(
        lattice: &LawLattice,
        candidates: &mut [Candidates],
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<(Self, Vec<Vec<usize>>)> {
        let count = candidates.len();
        let ranges = [0..count.min(1), count.min(1)..count];
        let rows = ranges.clone().map(|range| Sums::new(lattice, range));
        let own = split(lattice, &rows, control)?;
        let other: Vec<usize> = (0..lattice.axes().len()).filter(|axis| !own.contains(axis)).collect();
        let full = |axes: &[usize], rows: &Sums| {
            rows.image(lattice, axes, usize::MAX)
                .ok_or_else(|| Error::Internal { what: "an image without a limit".into() })
        };
        let addends = [full(&other, &rows[0])?, full(&own, &rows[1])?];
        let stride = addends[1].len() as u64;
        let mut halves = Vec::with_capacity(2);
        for (h, axes) in [&own, &other].into_iter().enumerate() {
            let equations = ranges[h].clone();
            let mut half = Half { equations: equations.clone(), combinations: Vec::new(), parts: Vec::new() };
            let mut known: HashMap<Box<[u32]>, u32> = HashMap::new();
            let (mut orders, mut key, mut ids) = (Vec::new(), Vec::new(), Vec::new());
            let mut failed = None;
            rows[h].each(lattice, axes, &rows[1 - h], |index, sums, theirs| {
                if control.stop.load(Ordering::Relaxed) {
                    failed = Some(Error::Interrupted);
                }
                let Some(named) = addends[1 - h].find(theirs) else { return };
                for (number_of_addend, addend) in addends[h].each().enumerate() {
                    if failed.is_some() {
                        return;
                    }
                    if !rows[h].orders(lattice, sums, addend, &mut orders) {
                        continue;
                    }
                    match combination(lattice, candidates, &mut half, &mut known, &orders, &mut key, &mut ids) {
                        Ok(combination) => {
                            let mine = number_of_addend as u64;
                            let named = u64::from(named);
                            let bucket = if h == 0 { mine * stride + named } else { named * stride + mine };
                            half.parts.push(Part { bucket, index, combination });
                        }
                        Err(error) => failed = Some(error),
                    }
                }
            });
            if let Some(error) = failed {
                return Err(error);
            }
            pool.install(|| half.parts.par_sort_unstable_by_key(|part| (part.bucket, part.index)));
            halves.push(half);
        }
        let [first, second] =
            <[Half; 2]>::try_from(halves).map_err(|_| Error::Internal { what: "a join without two halves".into() })?;
        let mut join = Self { halves: [first, second], buckets: Vec::new() };
        join.meet();
        let mut used: Vec<Vec<bool>> = candidates.iter().map(|c| vec![false; c.len()]).collect();
        for bucket in &join.buckets {
            for (half, rows) in join.halves.iter().zip(&bucket.rows) {
                for part in &half.parts[rows.clone()] {
                    for (e, &id) in half.equations.clone().zip(half.ids(part.combination)) {
                        used[e][id as usize] = true;
                    }
                }
            }
        }
        let used = used.iter().map(|u| (0..u.len()).filter(|&id| u[id]).collect()).collect();
        Ok((join, used))
    }

    /// Finds the buckets that hold rows of both halves.
    fn meet(&mut self) {
        let [a, b] = [&self.halves[0].parts, &self.halves[1].parts];
        let end = |parts: &[Part], start: usize| {
            start + parts[start..].iter().take_while(|part| part.bucket == parts[start].bucket).count()
        };
        let (mut i, mut j) = (0, 0);
        while i < a.len() && j < b.len() {
            match a[i].bucket.cmp(&b[j].bucket) {
                std::cmp::Ordering::Less => i += 1,
                std::cmp::Ordering::Greater => j += 1,
                std::cmp::Ordering::Equal => {
                    let rows = [i..end(a, i), j..end(b, j)];
                    (i, j) = (rows[0].end, rows[1].end);
                    self.buckets.push(Bucket { rows });
                }
            }
        }
    }

    /// Number of tuples.
    fn tuples(&self) -> u64 {
        self.buckets.iter().map(|b| b.rows[0].len() as u64 * b.rows[1].len() as u64).sum()
    }

    /// Least value in each half of a bucket among rows that pass; none where a half has no such row.
    fn least(&self, bucket: &Bucket, states: &[Vec<Entry>; 2], passes: impl Fn(Class) -> bool) -> Option<[f64; 2]> {
        let mut least = [f64::INFINITY; 2];
        for h in 0..2 {
            for part in &self.halves[h].parts[bucket.rows[h].clone()] {
                let state = states[h][part.combination as usize];
                if passes(state.class) && state.value < least[h] {
                    least[h] = state.value;
                }
            }
        }
        least.iter().all(|v| v.is_finite()).then_some(least)
    }

    /// Score of a tuple: its equations' in their order, as enumeration adds them.
    fn score(&self, known: &Entries, pair: [u32; 2]) -> f64 {
        let halves = self.halves.iter().zip(pair);
        halves
            .flat_map(|(half, combination)| half.equations.clone().zip(half.ids(combination)))
            .map(|(e, &id)| known[e][id as usize].value)
            .sum()
    }

    /// The best exact tuples, best first, ties by index.
    fn best(
        &self,
        states: &[Vec<Entry>; 2],
        known: &Entries,
        keep: usize,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<Vec<(f64, u64)>> {
        let exact = |class: Class| class == Class::Exact;
        let mut order: Vec<(f64, usize, [f64; 2])> = pool.install(|| {
            let found = self.buckets.par_iter().enumerate().filter_map(|(i, bucket)| {
                self.least(bucket, states, exact).map(|least| (least[0] + least[1], i, least))
            });
            let mut order: Vec<_> = found.collect();
            order.par_sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            order
        });
        order.dedup_by_key(|o| o.1);
        let mut kept: Vec<(f64, u64)> = Vec::new();
        let trim = |kept: &mut Vec<(f64, u64)>| {
            kept.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            kept.truncate(keep);
            if kept.len() == keep {
                kept[keep - 1].0 * (1.0 + ROUNDING)
            } else {
                f64::INFINITY
            }
        };
        let mut worst = f64::INFINITY;
        let room = 2 * keep.max(512);
        for (bound, i, least) in order {
            if control.stop.load(Ordering::Relaxed) {
                return Err(Error::Interrupted);
            }
            if bound > worst {
                break;
            }
            let rows: [Vec<(f64, Part)>; 2] = std::array::from_fn(|h| {
                let parts = self.halves[h].parts[self.buckets[i].rows[h].clone()].iter();
                let mut rows: Vec<(f64, Part)> = parts
                    .map(|&part| (states[h][part.combination as usize], part))
                    .filter(|(state, _)| exact(state.class) && state.value + least[1 - h] <= worst)
                    .map(|(state, part)| (state.value, part))
                    .collect();
                rows.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.index.cmp(&b.1.index)));
                rows
            });
            for (a, first) in &rows[0] {
                if a + least[1] > worst {
                    break;
                }
                for (b, second) in &rows[1] {
                    if a + b > worst {
                        break;
                    }
                    let pair = [first.combination, second.combination];
                    kept.push((self.score(known, pair), first.index + second.index));
                    if kept.len() >= room {
                        worst = trim(&mut kept);
                    }
                }
            }
            if worst == f64::INFINITY && kept.len() >= keep {
                worst = trim(&mut kept);
            }
        }
        trim(&mut kept);
        Ok(kept)
    }

    /// Inexact entries that could still be part of a kept tuple, with the score up to which to follow each.
    fn unresolved(
        &self,
        states: &[Vec<Entry>; 2],
        known: &Entries,
        worst: f64,
        raise: f64,
        control: &Control,
    ) -> Result<Vec<Span>> {
        let mut limits: Vec<Vec<f64>> = known.iter().map(|k| vec![f64::NEG_INFINITY; k.len()]).collect();
        for bucket in &self.buckets {
            if control.stop.load(Ordering::Relaxed) {
                return Err(Error::Interrupted);
            }
            // Not finite where all of one half have failed.
            let Some(least) = self.least(bucket, states, |class| !class.failed()) else { continue };
            if least[0] + least[1] > worst * (1.0 + ROUNDING) {
                continue;
            }
            for (h, half) in self.halves.iter().enumerate() {
                for part in &half.parts[bucket.rows[h].clone()] {
                    let state = states[h][part.combination as usize];
                    let open = matches!(state.class, Class::Bounded | Class::Open);
                    if !open || state.value + least[1 - h] > worst * (1.0 + ROUNDING) {
                        continue;
                    }
                    for (e, &id) in half.equations.clone().zip(half.ids(part.combination)) {
                        let entry = known[e][id as usize];
                        if entry.class == Class::Exact {
                            continue;
                        }
                        // Without a full table any tuple may enter: follow this one a few times further than before.
                        let limit = if worst.is_finite() {
                            worst - least[1 - h] - (state.value - entry.value)
                        } else {
                            raise * entry.value
                        };
                        // Where rounding leaves no room between bound and worst, only its end tells more.
                        let limit = if limit > entry.value { limit } else { f64::INFINITY };
                        let old = &mut limits[e][id as usize];
                        *old = old.max(limit);
                    }
                }
            }
        }
        let wanted = limits
            .into_iter()
            .enumerate()
            .flat_map(|(e, all)| spans(e, all.into_iter().enumerate().filter(|(_, limit)| *limit > f64::NEG_INFINITY)));
        Ok(wanted.collect())
    }

    /// What became of all tuples, and the first failures by index.
    fn count(&self, states: &[Vec<Entry>; 2]) -> (Counts, Vec<(u64, Failure)>) {
        let mut counts = Counts::default();
        let mut failures: Vec<(u64, Failure)> = Vec::new();
        for bucket in &self.buckets {
            let parts: [&[Part]; 2] = std::array::from_fn(|h| &self.halves[h].parts[bucket.rows[h].clone()]);
            let tally: [Vec<(Class, u64)>; 2] = std::array::from_fn(|h| {
                let mut tally: Vec<(Class, u64)> = Vec::new();
                for part in parts[h] {
                    let class = states[h][part.combination as usize].class;
                    match tally.iter_mut().find(|t| t.0 == class) {
                        Some(t) => t.1 += 1,
                        None => tally.push((class, 1)),
                    }
                }
                tally
            });
            let mut failed = false;
            for &(a, x) in &tally[0] {
                for &(b, y) in &tally[1] {
                    let count = x * y;
                    counts.candidates += count;
                    *match a.with(b) {
                        Class::Exact => &mut counts.beaten,
                        Class::Bounded => &mut counts.bounded,
                        Class::Open => &mut counts.stopped,
                        Class::Failed(Failure::Singular) => &mut counts.singular,
                        Class::Failed(Failure::Diverged) => &mut counts.diverged,
                    } += count;
                    failed |= a.with(b).failed();
                }
            }
            if failed {
                self.list(parts, states, &mut failures);
            }
        }
        failures.sort_unstable();
        failures.truncate(LISTED);
        (counts, failures)
    }

    /// Adds the failures of a bucket that may be among the first; parts come in the order of their index.
    fn list(&self, parts: [&[Part]; 2], states: &[Vec<Entry>; 2], failures: &mut Vec<(u64, Failure)>) {
        for first in parts[0] {
            for second in parts[1] {
                let index = first.index + second.index;
                if failures.len() >= LISTED && index > failures[LISTED - 1].0 {
                    break;
                }
                let [a, b] = [(0, first), (1, second)].map(|(h, p)| states[h][p.combination as usize].class);
                if let Class::Failed(failure) = a.with(b) {
                    failures.push((index, failure));
                    if failures.len() >= 8 * LISTED {
                        failures.sort_unstable();
                        failures.truncate(LISTED);
                    }
                }
            }
        }
        failures.sort_unstable();
        failures.truncate(LISTED);
    }
}

/// The combination of candidates with these orders, equation after equation, added at the end if new.
fn combination(
    lattice: &LawLattice,
    candidates: &mut [Candidates],
    half: &mut Half,
    known: &mut HashMap<Box<[u32]>, u32>,
    orders: &[f64],
    key: &mut Vec<i64>,
    ids: &mut Vec<u32>,
) -> Result<u32> {
    ids.clear();
    let mut rest = orders;
    for e in half.equations.clone() {
        let (mine, others) = rest.split_at(lattice.equations()[e].terms.len() + 1);
        ids.push(candidates[e].id(mine, key)?);
        rest = others;
    }
    match known.entry(ids.as_slice().into()) {
        Slot::Occupied(slot) => Ok(*slot.get()),
        Slot::Vacant(slot) => {
            // Every equation adds its candidates in the order of combinations where it is alone.
            let next = number(if ids.is_empty() { 0 } else { half.combinations.len() / ids.len() })?;
            half.combinations.extend_from_slice(ids);
            Ok(*slot.insert(next))
        }
    }
}

/// A stage made ready: what the candidates of its equations share.
pub struct Stage<'a> {
    lattice: Cow<'a, LawLattice>,
    options: Options,
    tables: Vec<Table>,
    samples: f64,
}

/// How far the search of a stage is: what is known of every candidate, and which are to be followed next.
///
/// What comes next depends on nothing but what the candidates before came to, so these may be followed anywhere, in any
/// order, and a search goes on from their verdicts.
pub struct Course {
    join: Join,
    known: Entries,
    /// In the first pass: the equation, how many of its candidates are done or wanted, its best score so far.
    pass: (usize, usize, f64),
    raise: f64,
    wanted: Vec<Span>,
    total: u64,
    /// The best exact tuples, once the first pass is over.
    kept: Vec<(f64, u64)>,
}

impl<'a> Stage<'a> {
    /// Lays out the join and builds what every equation's candidates share.
    ///
    /// `fixed[e]` gives known coefficients of equation e, `scales[e]` what its score is divided by (say σ(y)·M for norm
    /// L1), so that radians of hub and of deflection weigh alike.
    ///
    /// # Errors
    /// As [`crate::search::run::search`]; [`Error::EmptyLattice`] where no tuple obeys the law.
    pub fn new(
        records: &[Record],
        lattice: Cow<'a, LawLattice>,
        fixed: &[Vec<Option<f64>>],
        scales: &[f64],
        options: &Options,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<(Self, Course)> {
        let equations = lattice.equations();
        check_length("fixed coefficients", equations.len(), fixed.len())?;
        check_length("scales", equations.len(), scales.len())?;
        let mut candidates: Vec<Candidates> = equations.iter().map(Candidates::new).collect();
        let (join, used) = Join::new(&lattice, &mut candidates, pool, control)?;
        if join.tuples() == 0 {
            return Err(Error::EmptyLattice { why: "no tuple of free orders gives orders in range".into() });
        }
        #[allow(clippy::cast_precision_loss)]
        let samples = records.iter().map(Record::m).sum::<usize>() as f64;
        let mut tables = Vec::with_capacity(equations.len());
        for (e, (candidates, used)) in candidates.into_iter().zip(used).enumerate() {
            check_length("fixed coefficients", equations[e].terms.len(), fixed[e].len())?;
            let (mut index, mut seen, mut alphas) = (Index::default(), HashSet::new(), HashSet::new());
            for &id in &used {
                let structure = candidates.structure(id);
                if alphas.insert(grains(structure.order)) {
                    index_alpha(&mut index, structure.order, &options.initial);
                }
                for term in &structure.terms {
                    index_orders(&mut index, &mut seen, structure.order, term.signal, term.order, &options.initial);
                }
            }
            index.sort();
            let problem = Problem::new(records, equations[e].output, index, &fixed[e], options)?;
            let problem = pool.install(|| problem.with_bound(used.len() as u64));
            tables.push(Table { problem, candidates, used, scale: scales[e] });
        }
        let stage = Self { lattice, options: options.clone(), tables, samples };
        let mut course = Course {
            join,
            known: stage.tables.iter().map(|t| vec![OPEN; t.candidates.len()]).collect(),
            pass: (0, 0, f64::INFINITY),
            raise: FIRST_LIMIT,
            wanted: Vec::new(),
            total: stage.tables.iter().map(|t| t.used.len() as u64).sum(),
            kept: Vec::new(),
        };
        course.next(&stage, pool, control)?;
        Ok((stage, course))
    }

    /// The raw sum up to which a candidate is followed for a scaled score.
    fn raw(&self, equation: usize, score: f64) -> f64 {
        let scaled = score * self.tables[equation].scale;
        let raw = match self.options.norm {
            Norm::L1 => scaled,
            Norm::L2 => scaled * scaled * self.samples,
        };
        // A hair above, so that a tie in the scaled sum is followed to its end.
        raw * (1.0 + 1e-12)
    }

    /// Follows these candidates: what each came to, in raw sums.
    ///
    /// # Errors
    /// Candidates that this stage has not, or [`Error::Interrupted`].
    pub fn evaluate(&self, spans: &[Span], pool: &rayon::ThreadPool, control: &Control) -> Result<Vec<Verdict>> {
        let mut wanted = Vec::new();
        for &Span { equation, first, last, limit } in spans {
            let count = self.tables.get(equation).map_or(0, |t| t.candidates.len());
            if last > count || first > last || limit.is_nan() {
                let what = format!("candidates {first} to {last} of equation {equation} are not among {count}");
                return Err(Error::Structure { what, remedy: "start the search again".into() });
            }
            let limit = self.raw(equation, limit);
            wanted.extend((first..last).map(|id| (equation, id, limit)));
        }
        let scratches = Scratches::new(pool.current_num_threads());
        let verdicts: Vec<Verdict> = pool.install(|| {
            wanted
                .par_iter()
                .map(|&(e, id, limit)| {
                    if control.stop.load(Ordering::Relaxed) {
                        return Err(Error::Interrupted);
                    }
                    let Table { problem, candidates, .. } = &self.tables[e];
                    let structure = candidates.structure(id);
                    let (verdict, _) =
                        scratches.with(|scratch| problem.evaluate_structure(&structure, limit, scratch, control))?;
                    control.done.fetch_add(1, Ordering::Relaxed);
                    let left = matches!(verdict, Verdict::Bounded(_) | Verdict::Stopped(_));
                    control.pruned.fetch_add(u64::from(left), Ordering::Relaxed);
                    Ok(verdict)
                })
                .collect::<Result<_>>()
        })?;
        if control.stop.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        Ok(verdicts)
    }

    /// The result of a search that has nothing left to follow.
    ///
    /// # Errors
    /// A search that has something left, or an internal fault.
    pub fn outcome(&self, course: &Course, control: &Control) -> Result<StageOutcome> {
        if !course.wanted.is_empty() {
            let what = "a search that has candidates left to follow has no result".into();
            return Err(Error::Structure { what, remedy: "follow them, and take in what they come to".into() });
        }
        let (mut counts, failures) = course.join.count(&course.states());
        counts.kept = course.kept.len() as u64;
        counts.beaten -= counts.kept;
        let mut scratch = Scratch::new();
        let mut rows = Vec::with_capacity(course.kept.len());
        for &(score, index) in &course.kept {
            let structures = self
                .lattice
                .structures(index)
                .ok_or_else(|| Error::Internal { what: "a kept tuple without structures".into() })?;
            let mut parts = Vec::with_capacity(structures.len());
            for (table, structure) in self.tables.iter().zip(&structures) {
                let (_, mut row) = table.problem.evaluate_structure(structure, f64::INFINITY, &mut scratch, control)?;
                row.score = table.problem.score(row.score);
                parts.push(row);
            }
            rows.push(StageRow { index, free: self.lattice.free(index), score, structures, rows: parts });
        }
        let distinct = self.tables.iter().map(|t| t.used.len() as u64).collect();
        Ok(StageOutcome { rows, counts, failures, distinct })
    }

    /// Its lattice.
    #[must_use]
    pub fn lattice(&self) -> &LawLattice {
        &self.lattice
    }
}

impl Course {
    /// Candidates to follow next; none at the end.
    #[must_use]
    pub fn wanted(&self) -> &[Span] {
        &self.wanted
    }

    /// Candidates to follow in all, as far as is known: one that was left early may have to be followed further.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Best score of a tuple, once there is one.
    #[must_use]
    pub fn best(&self) -> Option<f64> {
        self.kept.first().map(|kept| kept.0)
    }

    fn states(&self) -> [Vec<Entry>; 2] {
        std::array::from_fn(|h| self.join.halves[h].states(&self.known))
    }

    /// Takes in what the wanted candidates came to, in their order, and finds those to follow next.
    ///
    /// # Errors
    /// Verdicts that are not theirs, or [`Error::Interrupted`].
    pub fn take(
        &mut self,
        stage: &Stage<'_>,
        verdicts: &[Verdict],
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<()> {
        let wanted: usize = self.wanted.iter().map(|span| span.last - span.first).sum();
        let sound = |verdict: &Verdict| match *verdict {
            Verdict::Score(raw) | Verdict::Bounded(raw) | Verdict::Stopped(raw) => raw >= 0.0,
            Verdict::Failed(_) => true,
        };
        if verdicts.len() != wanted || !verdicts.iter().all(sound) {
            let what = format!("{} verdicts are not those of {wanted} candidates", verdicts.len());
            return Err(Error::Structure { what, remedy: "start the search again".into() });
        }
        let first_pass = self.pass.0 < stage.tables.len();
        let mut verdicts = verdicts.iter();
        for span in &self.wanted {
            let table = &stage.tables[span.equation];
            for (entry, &verdict) in self.known[span.equation][span.first..span.last].iter_mut().zip(&mut verdicts) {
                *entry = table.entry(verdict);
                if first_pass && entry.class == Class::Exact {
                    self.pass.2 = self.pass.2.min(entry.value);
                }
            }
        }
        self.next(stage, pool, control)
    }

    fn next(&mut self, stage: &Stage<'_>, pool: &rayon::ThreadPool, control: &Control) -> Result<()> {
        control.total.store(self.total, Ordering::Relaxed);
        // First pass: each equation's own best, the others left at a few times it.
        while let Some(Table { used, .. }) = stage.tables.get(self.pass.0) {
            let (equation, start, best) = self.pass;
            if start < used.len() {
                let end = used.len().min(start + if start == 0 { 256 } else { ROUND.max(start / 2) });
                let limit = if stage.options.early_stopping { FIRST_LIMIT * best } else { f64::INFINITY };
                self.wanted = spans(equation, used[start..end].iter().map(|&id| (id, limit)));
                self.pass.1 = end;
                return Ok(());
            }
            self.pass = (equation + 1, 0, f64::INFINITY);
        }
        let keep = stage.options.keep;
        let states = self.states();
        self.kept = self.join.best(&states, &self.known, keep, pool, control)?;
        let worst = if self.kept.len() == keep { self.kept[keep - 1].0 } else { f64::INFINITY };
        self.wanted = self.join.unresolved(&states, &self.known, worst, self.raise, control)?;
        self.raise *= FIRST_LIMIT;
        self.total += self.wanted.iter().map(|span| (span.last - span.first) as u64).sum::<u64>();
        control.total.store(self.total, Ordering::Relaxed);
        Ok(())
    }
}

/// Searches the free orders of a stage: the sum over equations of score / scale is smallest.
///
/// # Errors
/// As [`Stage::new`].
pub fn search(
    records: &[Record],
    lattice: &LawLattice,
    fixed: &[Vec<Option<f64>>],
    scales: &[f64],
    options: &Options,
    control: &Control,
) -> Result<StageOutcome> {
    let pool = pool(options.threads)?;
    let (stage, mut course) = Stage::new(records, Cow::Borrowed(lattice), fixed, scales, options, &pool, control)?;
    while !course.wanted().is_empty() {
        let verdicts = stage.evaluate(course.wanted(), &pool, control)?;
        course.take(&stage, &verdicts, &pool, control)?;
    }
    stage.outcome(&course, control)
}
