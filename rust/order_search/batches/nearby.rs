//! What is learnt around the best of the scouts: a limit that is all but the last one.

use std::collections::HashSet;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::Hunt;
use crate::order_search::batches::vector_generation::thinned;
use crate::order_search::control::Place;
use crate::order_search::grid::spread::visit;
use crate::order_search::grid::traversal::Cursor;
use crate::order_search::result::Kept;
use crate::order_search::screening::{by_guess, screen, Open};

/// Rows whose neighbours are followed.
const BEST: usize = 64;
/// Most candidates followed around the best ones.
const FOLLOWED: usize = 1 << 14;
/// Most directions in which neighbours are looked for: all of up to five orders, else pairs of orders.
const DIRECTIONS: usize = 243;
/// Stretches of candidates, and their length, among which the hard ones are looked for.
const SAMPLED: (u64, u64) = (2048, 64);
/// Most hard candidates that are followed.
const HARD: usize = 512;

impl Hunt<'_> {
    /// Goes down from the best rows, and from what is found all over the lattice by the limit that they give.
    pub(super) fn nearby(&mut self, kept: &mut Kept, tried: &mut HashSet<u64>) -> Result<()> {
        self.neighbours(kept, tried)?;
        let hard = self.hard(kept)?;
        self.on_from(&hard, kept, tried)
    }

    /// Follows these and goes down from the best.
    pub(super) fn on_from(&mut self, open: &[Open], kept: &mut Kept, tried: &mut HashSet<u64>) -> Result<()> {
        let anew: Vec<Open> = open.iter().filter(|open| tried.insert(open.index)).copied().collect();
        self.follow(&anew, kept, Place::start(0), false)?;
        self.neighbours(kept, tried)
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
        if catalogue.problem.squares.is_none() {
            return Ok(self.waiting(kept.limit, 0)?.0);
        }
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
}
