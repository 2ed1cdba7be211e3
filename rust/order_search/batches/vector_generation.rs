//! Test vectors made for candidates that no other one excludes, then for those that these leave, as long as it pays.

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::Hunt;
use crate::order_search::dual_bound::tailored_vectors::Fitted;
use crate::order_search::grid::spread::visit;
use crate::order_search::grid::traversal::Cursor;
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
