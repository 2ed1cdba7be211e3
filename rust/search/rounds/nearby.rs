//! What is learnt around the best of the scouts: a limit that is all but the last one, and test vectors made for the
//! candidates that are hard to exclude.

use std::collections::HashSet;

use rayon::prelude::*;

use crate::error::Result;
use crate::search::bound::adapted::{Adapted, Fitted};
use crate::search::control::Place;
use crate::search::lattice::cursor::Cursor;
use crate::search::outcome::Kept;
use crate::search::rounds::hunt::Hunt;
use crate::search::screen::{by_guess, screen, Open};
use crate::search::spread::visit;

/// Rows whose neighbours are followed.
const BEST: usize = 64;
/// Most candidates followed around the best ones.
const FOLLOWED: usize = 1 << 14;
/// Most directions in which neighbours are looked for: all of up to five orders, else pairs of orders.
const DIRECTIONS: usize = 243;
/// Stretches of candidates, and their length, among which the hard ones are looked for.
const SAMPLED: (u64, u64) = (2048, 64);
/// Most hard candidates that test vectors are held against, test vectors that are tried, and those that are kept.
const HARD: usize = 512;
const TRIED: usize = 32;
const MADE: usize = 12;
/// Most bytes of test vectors that are tried.
const MOST: u64 = 256 << 20;

impl Hunt<'_> {
    /// Goes down from the best rows, and from what is found all over the lattice by the limit that they give; then test
    /// vectors made for candidates that the others do not exclude, and the bytes of each. None where there is no memory
    /// for them, or no use.
    pub(super) fn nearby(&mut self, kept: &mut Kept, tried: &mut HashSet<u64>) -> Result<Option<(Adapted, u64)>> {
        let hard = self.better(kept, tried)?;
        // Of equation errors in squares the Gram matrix says all.
        if self.catalogue.problem.squares.is_some() {
            return Ok(None);
        }
        self.adapted(kept, hard)
    }

    /// Goes down from the best rows, and from what is found all over the lattice by the limit that they give, which it
    /// returns.
    pub(super) fn better(&mut self, kept: &mut Kept, tried: &mut HashSet<u64>) -> Result<Vec<Open>> {
        self.neighbours(kept, tried)?;
        let hard = self.hard(kept)?;
        let anew: Vec<Open> = hard.iter().filter(|open| tried.insert(open.index)).copied().collect();
        self.follow(&anew, kept, Place::start(0), false)?;
        self.neighbours(kept, tried)?;
        Ok(hard)
    }

    /// Follows neighbours of the best rows, far ones first, until none is better.
    pub(super) fn neighbours(&mut self, kept: &mut Kept, tried: &mut HashSet<u64>) -> Result<()> {
        let lattice = &*self.catalogue.lattice;
        let longest = lattice.groups().iter().flat_map(|group| &group.axes).map(Vec::len);
        let longest = longest.chain([lattice.blocks().len()]).max().unwrap_or(1);
        let mut stride = (longest / 8).max(1).next_power_of_two();
        let first = tried.len();
        while stride > 0 {
            let best = |kept: &Kept| kept.rows.iter().take(BEST).map(|row| row.index).collect::<Vec<u64>>();
            let before = best(kept);
            let mut around: Vec<u64> = before.iter().flat_map(|&index| self.around(index, stride)).collect();
            around.retain(|&index| tried.insert(index));
            let open: Vec<Open> = around.iter().map(|&index| Open { index, bound: 0.0, guess: 0.0 }).collect();
            self.follow(&open, kept, Place::start(0), false)?;
            if best(kept) == before {
                stride /= 2;
            }
            if tried.len() - first > FOLLOWED {
                break;
            }
        }
        Ok(())
    }

    /// Neighbours of a candidate at this distance in any of its orders that vary.
    fn around(&self, index: u64, stride: usize) -> Vec<u64> {
        let lattice = &*self.catalogue.lattice;
        let cursor = Cursor::at(lattice, index);
        let mut here = vec![0; lattice.width()];
        cursor.each(0, |term, digit| here[term] = digit);
        let mut lengths = vec![0; lattice.width()];
        for group in lattice.groups() {
            group.terms.iter().zip(&group.axes).for_each(|(&term, axis)| lengths[term] = axis.len());
        }
        // The order of the equation itself comes last.
        here.push(cursor.block());
        lengths.push(lattice.blocks().len());
        let vary: Vec<usize> = (0..here.len()).filter(|&i| lengths[i] > 1).collect();
        let whole = u32::try_from(vary.len()).ok().and_then(|n| 3_usize.checked_pow(n)).filter(|n| *n <= DIRECTIONS);
        let moves: Vec<Vec<(usize, usize)>> = match whole {
            Some(count) => (1..count)
                .map(|number| {
                    let digit = |place: usize| number / 3_usize.pow(u32::try_from(place).unwrap_or(0)) % 3;
                    vary.iter().enumerate().map(|(place, &i)| (i, digit(place))).collect()
                })
                .collect(),
            None => vary
                .iter()
                .enumerate()
                .flat_map(|(n, &i)| vary[n..].iter().map(move |&j| (i, j)))
                .flat_map(|(i, j)| (0..9).map(move |way| vec![(i, way % 3), (j, if i == j { 0 } else { way / 3 })]))
                .collect(),
        };
        let there = |moves: Vec<(usize, usize)>| {
            let mut place = here.clone();
            for (i, way) in moves {
                place[i] = match way {
                    0 => place[i],
                    1 => place[i].checked_add(stride).filter(|&digit| digit < lengths[i])?,
                    _ => place[i].checked_sub(stride)?,
                };
            }
            let block = place.pop()?;
            Cursor::find(lattice, block, &place)
        };
        moves.into_iter().filter_map(there).collect()
    }

    /// Some candidates all over the lattice that no bound excludes, the most likely first.
    fn hard(&mut self, kept: &Kept) -> Result<Vec<Open>> {
        let catalogue = self.catalogue;
        let (count, (stretches, length)) = (catalogue.lattice.count(), SAMPLED);
        let order = visit(count.div_ceil(length));
        let starts: Vec<u64> = (0..stretches.min(count.div_ceil(length))).map(|i| order(i) * length).collect();
        let mut hard: Vec<Open> = self.pool.install(|| {
            starts.par_iter().flat_map(|&at| screen(catalogue, at, count.min(at + length), kept.limit).0).collect()
        });
        self.check_stop()?;
        by_guess(&mut hard);
        Ok(thinned(&hard, HARD))
    }

    /// Test vectors made for the best candidate and for some of the hard ones.
    fn adapted(&mut self, kept: &Kept, hard: Vec<Open>) -> Result<Option<(Adapted, u64)>> {
        let catalogue = self.catalogue;
        let (lattice, problem) = (&*catalogue.lattice, &catalogue.problem);
        let (mut adapted, bytes) = problem.no_adapted();
        let room = usize::try_from(catalogue.spare.min(MOST) / bytes.max(1)).unwrap_or(TRIED).min(TRIED);
        if room == 0 || kept.rows.is_empty() || kept.limit == f64::INFINITY {
            return Ok(None);
        }
        let rows = kept.rows.iter().map(|row| row.index);
        let tried: Vec<u64> =
            rows.take(1).chain(thinned(&hard, room - 1).iter().map(|open| open.index)).take(room).collect();
        let columns = |index: u64| {
            let mut positions = vec![0; lattice.width()];
            catalogue.positions(&Cursor::at(lattice, index), &mut positions);
            positions
        };
        let mut fitted = Vec::new();
        for &index in &tried {
            fitted.extend(self.pool.install(|| problem.fit(&adapted, &columns(index))));
            self.check_stop()?;
        }
        // The best candidate's own one, for what is near it, then those that together exclude most of the hard ones.
        let places: Vec<Vec<usize>> = hard.iter().map(|open| columns(open.index)).collect();
        let mut left = vec![true; hard.len()];
        let mut excluded: Vec<(Fitted, Vec<bool>)> = Vec::new();
        for vector in fitted {
            adapted.each.push(vector);
            let out = self.pool.install(|| {
                places.par_iter().map(|columns| problem.excluded_by(&adapted, columns, kept.limit)).collect()
            });
            excluded.extend(adapted.each.pop().map(|vector| (vector, out)));
        }
        let gain = |out: &[bool], left: &[bool]| out.iter().zip(left).filter(|(out, left)| **out && **left).count();
        let mut next = 0;
        while next < excluded.len() && adapted.each.len() < MADE {
            let (vector, out) = excluded.swap_remove(next);
            adapted.each.push(vector);
            left.iter_mut().zip(&out).for_each(|(left, out)| *left &= !out);
            let gains = excluded.iter().map(|(_, out)| gain(out, &left)).enumerate();
            match gains.max_by(|a, b| a.1.cmp(&b.1).then(b.0.cmp(&a.0))) {
                Some((best, most)) if most > 0 => next = best,
                _ => break,
            }
        }
        Ok(Some((adapted, bytes)))
    }
}

/// At most so many of these, evenly.
fn thinned(all: &[Open], most: usize) -> Vec<Open> {
    let count = all.len().min(most);
    (0..count).map(|i| all[i * all.len() / count]).collect()
}
