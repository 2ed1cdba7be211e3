//! The layout of a join: which orders of the equations fit together under the law.
//!
//! The law ties the equations' orders to a few free ones, so many tuples of free orders share an equation's orders.
//! The free orders are split between the first equation and the others: x = (a, b). An equation's orders are then what
//! its own half of x gives plus what the other half adds, and that addend takes few distinct values: (a, addend from b)
//! and (b, addend from a) fit together exactly where each names the other's addend. Rows of both halves meet in the
//! bucket of the two addends; within a bucket every pair is a tuple, and every tuple is one pair of one bucket. The
//! product of the axes is never gone through.

use std::collections::hash_map::Entry as Slot;
use std::collections::HashMap;
use std::ops::Range;

use rayon::prelude::*;

use crate::error::{Error, Result};
use crate::order_search::control::Control;
use crate::order_search::grid::order_law::LawLattice;
use crate::order_search::stage_join::known::{Class, Entries, Entry};
use crate::order_search::stage_join::orders::{number, Candidates};
use crate::order_search::stage_join::sums::{Sums, LOOK};

/// A row of one half of the join: a choice of its own free orders, and the addend of the other half's.
#[derive(Debug, Clone, Copy)]
pub(super) struct Part {
    /// The two addends by which it meets rows of the other half.
    bucket: u64,
    /// What its own free orders contribute to the index of a tuple.
    pub(super) index: u64,
    /// Which candidates of its equations it names.
    pub(super) combination: u32,
}

/// One half of the join.
pub(super) struct Half {
    pub(super) equations: Range<usize>,
    /// Candidates of each equation, combination after combination.
    combinations: Vec<u32>,
    pub(super) parts: Vec<Part>,
}

impl Half {
    /// Sum and class of every combination.
    pub(super) fn states(&self, known: &Entries) -> Vec<Entry> {
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

    pub(super) fn ids(&self, combination: u32) -> &[u32] {
        let width = self.equations.len();
        &self.combinations[combination as usize * width..][..width]
    }
}

/// Rows of both halves that fit together, each with each.
pub(super) struct Bucket {
    pub(super) rows: [Range<usize>; 2],
}

/// The layout of a join.
pub(super) struct Join {
    pub(super) halves: [Half; 2],
    pub(super) buckets: Vec<Bucket>,
}

/// Most rows of both halves: they take a GB.
const MAX_PARTS: u128 = 40_000_000;
/// Memory of a row, and as much again while their list grows.
const ROW: u128 = 2 * size_of::<Part>() as u128;
/// Free orders whose place in either half is tried; more go to the second.
const PLACED: usize = 10;

/// The free orders that go to the first half: those that leave the fewest rows.
fn split(lattice: &LawLattice, rows: &[Sums; 2], memory: u64, control: &Control) -> Result<Vec<usize>> {
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
        control.check_stop()?;
        if floor >= least {
            break;
        }
        let limit = |size: u128| usize::try_from((least / size).min(MAX_PARTS)).unwrap_or(usize::MAX);
        let Some(first) = rows[0].image(lattice, &other, limit(size(&own)), control)? else { continue };
        let Some(second) = rows[1].image(lattice, &own, limit(size(&other)), control)? else { continue };
        let count = size(&own) * first.len() as u128 + size(&other) * second.len() as u128;
        if count < least {
            (least, best) = (count, own);
        }
    }
    if least > MAX_PARTS {
        return Err(Error::LatticeTooLarge { count: least.min(u128::from(lattice.product())), limit: MAX_PARTS });
    }
    let (bytes, limit) = (ROW * least, u128::from(memory));
    if bytes > limit {
        return Err(Error::Memory { what: format!("{least} rows of the layout of the order law"), bytes, limit });
    }
    Ok(best)
}

impl Join {
    /// Lays out the join and the distinct candidates of every equation; marks those that some tuple needs. Refuses rows of
    /// more than so many bytes.
    pub(super) fn new(
        lattice: &LawLattice,
        candidates: &mut [Candidates],
        memory: u64,
        pool: &rayon::ThreadPool,
        control: &Control,
    ) -> Result<(Self, Vec<Vec<usize>>)> {
        let count = candidates.len();
        let ranges = [0..count.min(1), count.min(1)..count];
        let rows = ranges.clone().map(|range| Sums::new(lattice, range));
        let own = split(lattice, &rows, memory, control)?;
        let other: Vec<usize> = (0..lattice.axes().len()).filter(|axis| !own.contains(axis)).collect();
        let full = |axes: &[usize], rows: &Sums| {
            rows.image(lattice, axes, usize::MAX, control)?
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
            rows[h].each(lattice, axes, &rows[1 - h], |index, sums, theirs| {
                control.check_stop()?;
                let Some(named) = addends[1 - h].find(theirs) else { return Ok(()) };
                for (number_of_addend, addend) in addends[h].each().enumerate() {
                    if number_of_addend % LOOK == LOOK - 1 {
                        control.check_stop()?;
                    }
                    if !rows[h].orders(lattice, sums, addend, &mut orders) {
                        continue;
                    }
                    let combination =
                        combination(lattice, candidates, &mut half, &mut known, &orders, &mut key, &mut ids)?;
                    let (mine, named) = (number_of_addend as u64, u64::from(named));
                    let bucket = if h == 0 { mine * stride + named } else { named * stride + mine };
                    half.parts.push(Part { bucket, index, combination });
                }
                Ok(())
            })?;
            control.check_stop()?;
            pool.install(|| half.parts.par_sort_unstable_by_key(|part| (part.bucket, part.index)));
            halves.push(half);
        }
        let [first, second] =
            <[Half; 2]>::try_from(halves).map_err(|_| Error::Internal { what: "a join without two halves".into() })?;
        let mut join = Self { halves: [first, second], buckets: Vec::new() };
        join.meet(control)?;
        let mut used: Vec<Vec<bool>> = candidates.iter().map(|c| vec![false; c.len()]).collect();
        for (i, bucket) in join.buckets.iter().enumerate() {
            if i % LOOK == 0 {
                control.check_stop()?;
            }
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
    fn meet(&mut self, control: &Control) -> Result<()> {
        let [a, b] = [&self.halves[0].parts, &self.halves[1].parts];
        let end = |parts: &[Part], start: usize| {
            start + parts[start..].iter().take_while(|part| part.bucket == parts[start].bucket).count()
        };
        let (mut i, mut j) = (0, 0);
        for step in 0usize.. {
            if i >= a.len() || j >= b.len() {
                break;
            }
            if step % LOOK == 0 {
                control.check_stop()?;
            }
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
        Ok(())
    }

    /// Memory of its rows.
    pub(super) fn bytes(&self) -> u128 {
        self.halves.iter().map(|half| (half.parts.capacity() * size_of::<Part>()) as u128).sum()
    }

    /// Number of tuples.
    pub(super) fn tuples(&self) -> u64 {
        self.buckets.iter().map(|b| b.rows[0].len() as u64 * b.rows[1].len() as u64).sum()
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
