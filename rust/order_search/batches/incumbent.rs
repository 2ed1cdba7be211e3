//! Scouts: candidates tried beforehand, all over the lattice, which give a first good score and choose the test vectors.
//!
//! What is learnt around the best of the scouts: a limit that is all but the last one.

use std::collections::HashSet;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::Hunt;
use crate::order_search::batches::vector_generation::thinned;
use crate::order_search::candidate::columns::Columns;
use crate::order_search::candidate::normal_equations::Solve;
use crate::order_search::control::Place;
use crate::order_search::grid::traversal::{visit, Cursor};
use crate::order_search::result::Kept;
use crate::order_search::screening::{by_guess, screen, Open};

/// Candidates tried beforehand, spread over the lattice: they choose the test vectors and give the first good score.
const SCOUTS: u64 = 2048;
/// Test vectors that a search works with.
const VECTORS: usize = 16;
/// Candidates among which the most likely ones are refined beforehand: guesses are cheap, and what is kept of a good
/// part of the lattice excludes most of it.
const GUESSED: u64 = 1 << 18;

/// Where test vectors leave fewer than one of so many scouts open at the best score that scouts found, closer proofs do
/// not pay: they left 0.3 to 2 % (and 9 % at twice the noise) where a true equation is near, 53 to 100 % where a search
/// takes seconds because none is.
const EASY: usize = 8;

/// What scouts came to.
pub(super) struct Scouted {
    /// The rows that give a first limit, and what else has been followed.
    pub(super) kept: Kept,
    pub(super) tried: HashSet<u64>,
    /// Whether test vectors leave so many open at it that candidates are to be proved closely.
    pub(super) hard: bool,
    /// The test vectors to work with, the best first.
    pub(super) which: Option<Vec<usize>>,
}

impl Hunt<'_> {
    /// A first limit and test vectors; the neighbours of the best are followed where `thorough` is true. Whether candidates are hard to exclude is asked if `closely`.
    pub(super) fn scout(&mut self, thorough: bool, closely: bool) -> Result<Scouted> {
        let catalogue = self.catalogue;
        let (lattice, problem) = (&*catalogue.lattice, &catalogue.problem);
        let count = lattice.count();
        let order = visit(count);
        let refined = problem.refines();
        let indices: Vec<u64> = (0..count.min(if refined { GUESSED } else { SCOUTS })).map(order).collect();
        let found: Vec<Option<(Open, Vec<f64>)>> = self.pool.install(|| {
            indices
                .par_iter()
                .map(|&index| {
                    let cursor = Cursor::at(lattice, index);
                    let mut positions = vec![0; lattice.width()];
                    let mut initial = Vec::new();
                    catalogue.positions(&cursor, &mut positions);
                    catalogue.initial(&cursor, &mut initial);
                    let sources: Vec<Columns<1>> = positions.iter().map(|&p| Columns::new([p])).collect();
                    let mut solve = Solve::<1>::new();
                    let [failed] = problem.equations.solve(&sources, &initial, &mut solve);
                    if failed {
                        return None;
                    }
                    let coefficients: Vec<f64> = solve.coefficients.iter().map(|c| c[0]).collect();
                    let weights: Vec<f64> = solve.initial.iter().map(|c| c[0]).collect();
                    let columns = |r: usize| {
                        let e = initial.len();
                        (&positions[..], &coefficients[..], &initial[..], &weights[r * e..(r + 1) * e])
                    };
                    let (mut each, mut guess) = (Vec::new(), 0.0);
                    if let Some(bound) = &problem.bound {
                        if !refined {
                            each = vec![0.0; bound.len()];
                            bound.each(columns, &mut each);
                        }
                        guess = bound.evaluate(f64::INFINITY, columns).1;
                    } else if let Some(squares) = &problem.squares {
                        guess = squares.error(&sources, &solve.coefficients).1[0];
                    }
                    Some((Open { index, bound: 0.0, guess }, each))
                })
                .collect()
        });
        self.check_stop()?;
        let found: Vec<(Open, Vec<f64>)> = found.into_iter().flatten().collect();
        let mut likely: Vec<Open> = found.iter().map(|(open, _)| *open).collect();
        by_guess(&mut likely);
        let keep = catalogue.options.keep;
        likely.truncate(keep.max(16).saturating_mul(4));
        let mut kept = Kept::new(keep, f64::INFINITY);
        self.follow(&likely, &mut kept, Place::start(0), false)?;
        let mut tried: HashSet<u64> = likely.iter().map(|open| open.index).collect();
        let many = |limit: f64| {
            let waiting = found.iter().filter(|(_, each)| !each.iter().any(|bound| *bound > limit)).count();
            waiting * EASY >= found.len()
        };
        let mut hard = false;
        if thorough {
            self.nearby(&mut kept, &mut tried)?;
            hard = closely && many(kept.limit);
        } else if closely && kept.rows.first().is_some_and(|best| many(best.score)) {
            // The best score of so few is near the last limit, which the worst of those kept is far from.
            self.nearby(&mut kept, &mut tried)?;
            hard = many(kept.limit);
        }
        let limit = kept.limit;
        // Where no coefficients are known yet all test vectors count.
        let which = problem.bound.as_ref().filter(|_| !refined).map(|bound| {
            let each: Vec<Vec<f64>> = found.into_iter().map(|(_, each)| each).collect();
            choose(&each, VECTORS.min(bound.len()), limit)
        });
        Ok(Scouted { kept, tried, hard, which })
    }
}

/// The test vectors that together exclude most of a sample, those that exclude most by themselves first.
fn choose(each: &[Vec<f64>], wanted: usize, limit: f64) -> Vec<usize> {
    let mut open: Vec<bool> = vec![true; each.len()];
    let mut chosen: Vec<usize> = Vec::new();
    // Where one excludes no more than another the smaller threshold tells: how near it comes.
    let gain = |j: usize, open: &[bool]| -> (usize, f64) {
        let values = each.iter().zip(open).filter(|(_, open)| **open).map(|(e, _)| e[j]);
        values.fold((0, 0.0), |(n, sum), v| (n + usize::from(v > limit), sum + v / (v + limit).max(f64::MIN_POSITIVE)))
    };
    let count = each.first().map_or(0, Vec::len);
    while chosen.len() < wanted.min(count) {
        let best = (0..count)
            .filter(|j| !chosen.contains(j))
            .map(|j| (gain(j, &open), j))
            .max_by(|a, b| a.0 .0.cmp(&b.0 .0).then(a.0 .1.total_cmp(&b.0 .1)).then(b.1.cmp(&a.1)));
        let Some((_, j)) = best else { break };
        each.iter().zip(&mut open).filter(|(e, _)| e[j] > limit).for_each(|(_, open)| *open = false);
        chosen.push(j);
    }
    chosen
}

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
