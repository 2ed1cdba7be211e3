//! Incumbent of a search from an initial sample of the grid and a local refinement.
//!
//! The sample also selects the test vectors.

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

/// Candidates of the initial sample, distributed over the grid. They select the test vectors and give the first
/// incumbent.
const SCOUTS: u64 = 2048;
/// Maximum test vectors used in a search.
const VECTORS: usize = 16;
/// Candidates among which the most promising are refined first. Estimates are cheap, and rows from a large part of the
/// grid exclude most of it.
const GUESSED: u64 = 1 << 18;

/// Inverse of the minimum open fraction of the sample for close bounds. Below it they are not worthwhile. Measured: 0.3
/// to 2 % open (9 % at twice the noise) near a true equation, 53 to 100 % in searches that take seconds because there
/// is none.
const EASY: usize = 8;

/// Incumbent found by the initial sample.
pub(super) struct Scouted {
    /// Rows that give the initial limit, and the candidates evaluated for them.
    pub(super) kept: Kept,
    pub(super) tried: HashSet<u64>,
    /// Whether so many candidates remain open at this limit that close bounds are worthwhile.
    pub(super) hard: bool,
    /// Indices of the selected test vectors, the best first.
    pub(super) which: Option<Vec<usize>>,
}

impl Hunt<'_> {
    /// Find an initial incumbent and select test vectors. `thorough` also evaluates the neighbors of the best rows.
    /// `closely` also tests whether close bounds are worthwhile.
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
            // In a small sample the best score is near the final limit. The worst row of the table is not.
            self.nearby(&mut kept, &mut tried)?;
            hard = many(kept.limit);
        }
        let limit = kept.limit;
        // Without initial coefficients all test vectors are used.
        let which = problem.bound.as_ref().filter(|_| !refined).map(|bound| {
            let each: Vec<Vec<f64>> = found.into_iter().map(|(_, each)| each).collect();
            choose(&each, VECTORS.min(bound.len()), limit)
        });
        Ok(Scouted { kept, tried, hard, which })
    }
}

/// Select the test vectors that together exclude most of a sample, in greedy order.
fn choose(each: &[Vec<f64>], wanted: usize, limit: f64) -> Vec<usize> {
    let mut open: Vec<bool> = vec![true; each.len()];
    let mut chosen: Vec<usize> = Vec::new();
    // Among vectors with equal exclusions, the one with the larger bounds is preferred.
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

/// Rows whose neighbors are evaluated.
const BEST: usize = 64;
/// Maximum neighbors evaluated around the best rows.
const FOLLOWED: usize = 1 << 14;
/// Maximum directions of neighbors: all combinations of up to five orders, else pairs of orders.
const DIRECTIONS: usize = 243;
/// Number of sampled blocks of candidates, and their length.
const SAMPLED: (u64, u64) = (2048, 64);
/// Maximum open candidates that are evaluated.
const HARD: usize = 512;

impl Hunt<'_> {
    /// Refine the incumbent from the best rows, and from open candidates sampled over the whole grid.
    pub(super) fn nearby(&mut self, kept: &mut Kept, tried: &mut HashSet<u64>) -> Result<()> {
        self.neighbours(kept, tried)?;
        let hard = self.hard(kept)?;
        self.on_from(&hard, kept, tried)
    }

    /// Evaluate these candidates, then search around the best rows.
    pub(super) fn on_from(&mut self, open: &[Open], kept: &mut Kept, tried: &mut HashSet<u64>) -> Result<()> {
        let anew: Vec<Open> = open.iter().filter(|open| tried.insert(open.index)).copied().collect();
        self.follow(&anew, kept, Place::start(0), false)?;
        self.neighbours(kept, tried)
    }

    /// Evaluate neighbors of the best rows, distant ones first, until none improves them.
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

    /// Neighbors of a candidate at this distance in any of its varying orders.
    fn around(&self, index: u64, stride: usize) -> Vec<u64> {
        let lattice = &*self.catalogue.lattice;
        let cursor = Cursor::at(lattice, index);
        let mut here = vec![0; lattice.width()];
        cursor.each(0, |term, digit| here[term] = digit);
        let mut lengths = vec![0; lattice.width()];
        for group in lattice.groups() {
            group.terms.iter().zip(&group.axes).for_each(|(&term, axis)| lengths[term] = axis.len());
        }
        // The order of the equation comes last.
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

    /// Sample of candidates that no bound excludes, the most promising first.
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
