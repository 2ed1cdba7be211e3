//! Test vectors made for candidates that no other one excludes, then for those that these leave, as long as it pays.
//!
//! Test vectors that follow coefficients, made where a sample of the lattice says that many candidates wait for them.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::Hunt;
use crate::order_search::candidate::problem::Known;
use crate::order_search::dual_bound::linearized_vectors::{Tangent, Tangents, MOST_OWN};
use crate::order_search::dual_bound::tailored_vectors::Fitted;
use crate::order_search::grid::traversal::{visit, Cursor};
use crate::order_search::screening::{by_guess, screen, Open};

/// Candidates among which open ones are looked for, in stretches of so many (those of one stretch are open together or
/// not at all): at first, and the share of a large lattice later on, when few are open and it takes many to see enough.
const SAMPLED: u64 = 1 << 17;
const SHARE: u64 = 512;
const STRETCH: u64 = 16;
const BATCH: u64 = 1 << 11;
/// Enough of them, and as many as are followed or as test vectors are held against.
const HARD: usize = 512;
/// Most test vectors that are tried at a time, and most that are kept of these.
const TRIED: usize = 32;
const MADE: usize = 12;
/// Most times.
const TIMES: u64 = 4;
/// Candidates that must be left open in all for another time to pay, and that a vector must exclude: trying some takes as
/// long as running so many.
const WORTH: f64 = 16_384.0;
const ENOUGH: f64 = 512.0;
const BIASED: usize = 4;
/// Most bytes of test vectors, tried ones too.
const MOST: u64 = 256 << 20;

/// What came of making some.
#[derive(Default)]
pub(super) struct Made {
    pub(super) vectors: Vec<Fitted>,
    /// What is open to them in the sample.
    pub(super) left: Vec<Open>,
    /// Whether another time may pay.
    pub(super) again: bool,
}

impl Hunt<'_> {
    /// Some candidates all over the lattice that no bound excludes at this limit, the most likely first, and how many of
    /// the lattice each stands for; other ones each time.
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

    /// Test vectors that together exclude most of what is open at this limit, each of them much, and what they leave: the
    /// first time for the best row too, for what is near it. None where they would not pay, or where there is no memory
    /// for them.
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
        // They were chosen to exclude these very candidates: of others they leave more.
        let again = time + 1 < TIMES && !made.is_empty() && all(BIASED * left.len()) >= WORTH;
        Ok(Made { vectors: made, left, again })
    }
}

/// At most so many of these, evenly.
pub(super) fn thinned(all: &[Open], most: usize) -> Vec<Open> {
    let count = all.len().min(most);
    (0..count).map(|i| all[i * all.len() / count]).collect()
}

/// Candidates of the sample, in stretches of so many: one in eight of a small lattice.
const MAX_LINEARIZED_SAMPLE: u64 = 1 << 19;
const LINEARIZED_SAMPLE_RATIO: u64 = 8;
const LINEARIZED_SAMPLE_BLOCK: u64 = 8;
/// Candidates that a vector must exclude, or that must be left where one more is tried: making one costs as much as ten
/// to twenty free runs.
const MIN_LINEARIZED_EXCLUSIONS: f64 = 32.0;
/// Most vectors for the same own orders, and most candidates tried in vain.
const MAX_LINEARIZED_VECTORS: usize = 24;
const VAIN: usize = 6;
/// Most bytes of all.
const MAX_LINEARIZED_BYTES: u64 = 1 << 30;

impl Hunt<'_> {
    /// For each tuple of own orders, vectors that exclude what a sample left open at this limit; none where there are
    /// none to make, or no memory for them.
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

    /// What a sample of the lattice leaves open at this limit, and how many candidates each stands for.
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

    /// Vectors for candidates of the same own columns: one for the middle of what is open along the first coefficient,
    /// and again on both sides of it.
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
