//! Generation of tailored and linearized test vectors while they are worthwhile.
//!
//! Vectors are built for candidates that no other vector excludes, in a sample of the grid.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::Hunt;
use crate::order_search::candidate::problem::Known;
use crate::order_search::dual_bound::linearized_vectors::{Tangent, Tangents, MOST_OWN};
use crate::order_search::dual_bound::tailored_vectors::Fitted;
use crate::order_search::grid::traversal::{visit, Cursor};
use crate::order_search::screening::{by_guess, screen, Open};

/// Sample in which open candidates are searched, and its block length. Candidates of one block are open together or not
/// at all. The first pass takes the minimum sample. Later passes take a fraction of a large grid, since few candidates
/// remain open.
const SAMPLED: u64 = 1 << 17;
const SHARE: u64 = 512;
const STRETCH: u64 = 16;
const BATCH: u64 = 1 << 11;
/// Number of open candidates at which sampling stops.
const HARD: usize = 512;
/// Maximum vectors tried per pass, and maximum vectors selected from them.
const TRIED: usize = 32;
const MADE: usize = 12;
/// Maximum passes.
const TIMES: u64 = 4;
/// Open candidates that make another pass worthwhile, and exclusions that make a vector worthwhile. One pass costs as
/// much as simulating so many candidates.
const WORTH: f64 = 16_384.0;
const ENOUGH: f64 = 512.0;
const BIASED: usize = 4;
/// Maximum memory of test vectors, including those on trial [bytes].
const MOST: u64 = 256 << 20;

/// Result of one pass of vector generation.
#[derive(Default)]
pub(super) struct Made {
    pub(super) vectors: Vec<Fitted>,
    /// Candidates of the sample that the vectors leave open.
    pub(super) left: Vec<Open>,
    /// Whether another pass may be worthwhile.
    pub(super) again: bool,
}

impl Hunt<'_> {
    /// Sample of candidates that no bound excludes at this limit, the most promising first. Also returns the number of
    /// candidates that each represents. Each pass draws another sample.
    pub(super) fn waiting(&self, limit: f64, time: u64) -> Result<(Vec<Open>, f64)> {
        let catalogue = self.catalogue;
        let count = catalogue.lattice.count();
        let stretches = count.div_ceil(STRETCH);
        let share = if time == 0 { 0 } else { count / SHARE };
        let most = SAMPLED.max(share).div_ceil(STRETCH).min(stretches);
        let order = visit(stretches);
        let (mut open, mut seen, mut candidates) = (Vec::new(), 0, 0);
        while seen < most && open.len() < HARD {
            let next = most.min(seen + BATCH);
            let starts: Vec<u64> = (seen..next).map(|i| order((time * most + i) % stretches) * STRETCH).collect();
            candidates += starts.iter().map(|&at| count.min(at + STRETCH) - at).sum::<u64>();
            let found = |&at: &u64| screen(catalogue, at, count.min(at + STRETCH), limit).0;
            open.extend(self.pool.install(|| starts.par_iter().flat_map(found).collect::<Vec<Open>>()));
            self.check_stop()?;
            seen = next;
        }
        by_guess(&mut open);
        #[allow(clippy::cast_precision_loss)]
        let each = count as f64 / candidates.max(1) as f64 * open.len() as f64;
        let open = thinned(&open, HARD);
        #[allow(clippy::cast_precision_loss)]
        let each = each / open.len().max(1) as f64;
        Ok((open, each))
    }

    /// Generate test vectors that together exclude most open candidates at this limit. The first pass includes a vector
    /// for the best row and its neighbors. Empty if the vectors are not worthwhile or memory is lacking.
    pub(super) fn made(&self, limit: f64, time: u64, best: Option<u64>) -> Result<Made> {
        let catalogue = self.catalogue;
        let (lattice, problem) = (&*catalogue.lattice, &catalogue.problem);
        let (mut one, bytes) = problem.no_adapted();
        let known = problem.adapted.as_ref().map_or(0, |adapted| adapted.each.len() as u64);
        let room = catalogue.spare.min(MOST.saturating_sub(known * bytes)) / bytes.max(1);
        let room = usize::try_from(room).unwrap_or(TRIED).min(TRIED);
        if room == 0 {
            return Ok(Made::default());
        }
        let (open, each) = self.waiting(limit, time)?;
        #[allow(clippy::cast_precision_loss)]
        let all = |count: usize| count as f64 * each;
        let best = best.filter(|_| time == 0);
        if best.is_none() && all(open.len()) < WORTH {
            return Ok(Made { left: open, ..Made::default() });
        }
        let columns = |index: u64| {
            let mut positions = vec![0; lattice.width()];
            catalogue.positions(&Cursor::at(lattice, index), &mut positions);
            positions
        };
        let some = thinned(&open, room);
        let tried = best.into_iter().chain(some.iter().map(|open| open.index)).take(room);
        let places: Vec<Vec<usize>> = open.iter().map(|open| columns(open.index)).collect();
        let mut excluded: Vec<(Fitted, Vec<bool>)> = Vec::new();
        for index in tried {
            one.each.extend(self.pool.install(|| problem.fit(&one, &columns(index))));
            let out = self
                .pool
                .install(|| places.par_iter().map(|columns| problem.excluded_by(&one, columns, limit)).collect());
            excluded.extend(one.each.pop().map(|vector| (vector, out)));
            self.check_stop()?;
        }
        let (mut left, mut made) = (vec![true; open.len()], Vec::new());
        let gain = |out: &[bool], left: &[bool]| out.iter().zip(left).filter(|(out, left)| **out && **left).count();
        let mut next = best.map(|_| 0);
        while made.len() < MADE {
            let gains = excluded.iter().map(|(_, out)| gain(out, &left)).enumerate();
            let most = gains.max_by(|a, b| a.1.cmp(&b.1).then(b.0.cmp(&a.0)));
            let chosen = next.take().filter(|_| !excluded.is_empty());
            let Some(chosen) = chosen.or(most.filter(|(_, most)| all(*most) >= ENOUGH).map(|(at, _)| at)) else {
                break;
            };
            let (vector, out) = excluded.swap_remove(chosen);
            made.push(vector);
            left.iter_mut().zip(&out).for_each(|(left, out)| *left &= !out);
        }
        let left: Vec<Open> = open.into_iter().zip(left).filter_map(|(open, left)| left.then_some(open)).collect();
        // The vectors were selected on this sample, so they leave more of other candidates open.
        let again = time + 1 < TIMES && !made.is_empty() && all(BIASED * left.len()) >= WORTH;
        Ok(Made { vectors: made, left, again })
    }
}

/// Subsample at most `most` candidates, evenly spaced.
pub(super) fn thinned(all: &[Open], most: usize) -> Vec<Open> {
    let count = all.len().min(most);
    (0..count).map(|i| all[i * all.len() / count]).collect()
}

/// Maximum candidates of the sample, and its block length. A small grid is sampled by one in eight.
const MAX_LINEARIZED_SAMPLE: u64 = 1 << 19;
const LINEARIZED_SAMPLE_RATIO: u64 = 8;
const LINEARIZED_SAMPLE_BLOCK: u64 = 8;
/// Minimum exclusions per vector, and minimum open candidates for another vector. Building one costs as much as ten to
/// twenty simulations.
const MIN_LINEARIZED_EXCLUSIONS: f64 = 32.0;
/// Maximum vectors for the same own orders, and maximum unsuccessful trials.
const MAX_LINEARIZED_VECTORS: usize = 24;
const VAIN: usize = 6;
/// Maximum memory of all vectors [bytes].
const MAX_LINEARIZED_BYTES: u64 = 1 << 30;

impl Hunt<'_> {
    /// Generate vectors for each tuple of own orders that exclude the open candidates of a sample. `None` if no vector
    /// is worthwhile or memory is lacking.
    pub(super) fn along(&self, limit: f64) -> Result<Option<Tangents>> {
        let problem = &self.catalogue.problem;
        let mut tangents = problem.no_tangents();
        if limit == f64::INFINITY {
            return Ok(None);
        }
        let (open, weight) = self.sample(limit)?;
        let mut groups: BTreeMap<Vec<usize>, Vec<Known>> = BTreeMap::new();
        for (columns, coefficients) in open {
            groups.entry(tangents.own(&columns)).or_default().push((columns, coefficients));
        }
        #[allow(clippy::cast_precision_loss)]
        groups.retain(|own, open| {
            (1..=MOST_OWN).contains(&own.len()) && open.len() as f64 * weight >= MIN_LINEARIZED_EXCLUSIONS
        });
        let bytes = groups.keys().map(|own| tangents.bytes(own.len())).max().unwrap_or(1);
        let room = self.catalogue.spare.min(MAX_LINEARIZED_BYTES) / bytes / (groups.len() as u64).max(1);
        let room = usize::try_from(room).unwrap_or(MAX_LINEARIZED_VECTORS).min(MAX_LINEARIZED_VECTORS);
        let made: Vec<(Vec<usize>, Vec<Tangent>)> = self.pool.install(|| {
            groups
                .into_iter()
                .collect::<Vec<_>>()
                .into_par_iter()
                .with_max_len(1)
                .map(|(own, open)| {
                    let made = if self.stopped() {
                        Vec::new()
                    } else {
                        self.cover(&tangents, &own, open, weight, limit, room)
                    };
                    (own, made)
                })
                .collect()
        });
        self.check_stop()?;
        for (own, made) in made {
            if !made.is_empty() {
                tangents.add(own, made);
            }
        }
        Ok((tangents.len() > 0).then_some(tangents))
    }

    /// Open candidates in a sample of the grid at this limit, and the number of candidates that each represents.
    #[allow(clippy::cast_precision_loss)]
    fn sample(&self, limit: f64) -> Result<(Vec<Known>, f64)> {
        let catalogue = self.catalogue;
        let (lattice, problem) = (&*catalogue.lattice, &catalogue.problem);
        let count = lattice.count();
        let stretches = count.div_ceil(LINEARIZED_SAMPLE_BLOCK);
        let order = visit(stretches);
        let wanted = (count / LINEARIZED_SAMPLE_RATIO)
            .min(MAX_LINEARIZED_SAMPLE)
            .div_ceil(LINEARIZED_SAMPLE_BLOCK)
            .clamp(1, stretches);
        let open: Vec<Known> = self.pool.install(|| {
            (0..wanted)
                .into_par_iter()
                .flat_map_iter(|i| {
                    let at = order(i) * LINEARIZED_SAMPLE_BLOCK;
                    let open = if self.stopped() {
                        Vec::new()
                    } else {
                        screen(catalogue, at, count.min(at + LINEARIZED_SAMPLE_BLOCK), limit).0
                    };
                    open.into_iter().filter_map(|open| {
                        let mut columns = vec![0; lattice.width()];
                        catalogue.positions(&Cursor::at(lattice, open.index), &mut columns);
                        let coefficients = problem.alone(&columns)?;
                        Some((columns, coefficients))
                    })
                })
                .collect()
        });
        self.check_stop()?;
        Ok((open, count as f64 / (wanted * LINEARIZED_SAMPLE_BLOCK) as f64))
    }

    /// Generate vectors for candidates with the same own columns. The first is built at the median of the first
    /// coefficient, then both halves are processed likewise.
    fn cover(
        &self,
        tangents: &Tangents,
        own: &[usize],
        mut open: Vec<Known>,
        weight: f64,
        limit: f64,
        room: usize,
    ) -> Vec<Tangent> {
        let problem = &self.catalogue.problem;
        let first = |known: &Known| known.0.iter().position(|p| *p == own[0]).map_or(0.0, |i| known.1[i]);
        open.sort_by(|a, b| first(a).total_cmp(&first(b)).then_with(|| a.0.cmp(&b.0)));
        let (mut made, mut vain) = (Vec::new(), 0);
        let mut parts = vec![open];
        #[allow(clippy::cast_precision_loss)]
        let many = |count: usize| count as f64 * weight >= MIN_LINEARIZED_EXCLUSIONS;
        while let Some(mut part) = parts.pop() {
            if !many(part.len()) || made.len() >= room || vain >= VAIN {
                continue;
            }
            let middle = part.remove(part.len() / 2);
            let at = first(&middle);
            let mut gained = false;
            if let Some(tangent) = problem.tangent(tangents, &middle.0, &middle.1, limit) {
                let left: Vec<Known> = problem.left_by(tangents, &tangent, &part, limit);
                gained = many(part.len() + 1 - left.len());
                if gained {
                    made.push(tangent);
                    part = left;
                }
            }
            vain += usize::from(!gained);
            let above = part.split_off(part.partition_point(|known| first(known) < at));
            parts.push(above);
            parts.push(part);
        }
        made
    }
}
