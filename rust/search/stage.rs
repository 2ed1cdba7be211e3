//! Order search over all equations of a stage under its order law, by joining score tables.
//!
//! The law ties the equations' orders to a few free ones, so many tuples of free orders share an equation's orders.
//! Each equation's distinct orders are evaluated once; tuples only add table entries. Entries start as lower bounds
//! (left early) and are sharpened until every tuple that could be kept is exact, so the table is that of enumeration.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::Ordering;

use rayon::prelude::*;

use crate::equation::{grains, Structure};
use crate::error::{check_length, Error, Result};
use crate::regressors::{Index, Record};
use crate::search::lattice::LawLattice;
use crate::search::run::{
    index_alpha, index_orders, pool, Control, Counts, Failure, Norm, Options, Problem, Row, Scratches, Verdict, LISTED,
};

/// An equation's candidates are first followed up to this multiple of its best score.
const FIRST_LIMIT: f64 = 4.0;
/// Candidates of one equation evaluated between two looks at its best score.
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

/// What is known of one equation's candidate: its scaled score, or a bound below it.
#[derive(Debug, Clone, Copy)]
struct Entry {
    value: f64,
    exact: bool,
    /// Whether a bound without a run is all that is known.
    bounded: bool,
    failure: Option<Failure>,
}

struct Table<'a> {
    problem: Problem,
    structures: Vec<Structure>,
    entries: Vec<Entry>,
    scale: f64,
    samples: f64,
    options: &'a Options,
}

impl Table<'_> {
    /// The raw sum that corresponds to a scaled score.
    fn raw(&self, score: f64) -> f64 {
        match self.options.norm {
            Norm::L1 => score * self.scale,
            Norm::L2 => (score * self.scale) * (score * self.scale) * self.samples,
        }
    }

    fn evaluate(&mut self, wanted: &[(usize, f64)], pool: &rayon::ThreadPool, control: &Control) -> Result<()> {
        let scratches = Scratches::new(pool.current_num_threads());
        let this = &*self;
        let verdicts: Vec<(usize, Verdict)> = pool.install(|| {
            wanted
                .par_iter()
                .map(|&(id, score)| {
                    if control.stop.load(Ordering::Relaxed) {
                        return Err(Error::Interrupted);
                    }
                    // A hair above, so that a tie in the scaled sum is followed to its end.
                    let limit = this.raw(score) * (1.0 + 1e-12);
                    let structure = &this.structures[id];
                    let (verdict, _) = scratches
                        .with(|scratch| this.problem.evaluate_structure(structure, limit, scratch, control))?;
                    Ok((id, verdict))
                })
                .collect::<Result<_>>()
        })?;
        if control.stop.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        for (id, verdict) in verdicts {
            let score = |raw: f64| self.problem.score(raw) / self.scale;
            let open = Entry { value: 0.0, exact: false, bounded: false, failure: None };
            self.entries[id] = match verdict {
                Verdict::Score(raw) => Entry { value: score(raw), exact: true, ..open },
                Verdict::Bounded(raw) => Entry { value: score(raw), bounded: true, ..open },
                Verdict::Stopped(raw) => Entry { value: score(raw), ..open },
                Verdict::Failed(failure) => Entry { value: f64::INFINITY, exact: true, failure: Some(failure), ..open },
            };
        }
        Ok(())
    }
}

type Key = Vec<i64>;

fn key(structure: &Structure) -> Key {
    std::iter::once(grains(structure.order)).chain(structure.terms.iter().map(|t| grains(t.order))).collect()
}

/// Searches the free orders of a stage: the sum over equations of score / scale is smallest.
///
/// `fixed[e]` gives known coefficients of equation e, `scales[e]` what its score is divided by (say σ(y)·M for norm
/// L1), so that radians of hub and of deflection weigh alike.
///
/// # Errors
/// As [`crate::search::run::search`]; [`Error::EmptyLattice`] where no tuple obeys the law.
pub fn search(
    records: &[Record],
    lattice: &LawLattice,
    fixed: &[Vec<Option<f64>>],
    scales: &[f64],
    options: &Options,
    control: &Control,
) -> Result<StageOutcome> {
    let equations = lattice.equations();
    check_length("fixed coefficients", equations.len(), fixed.len())?;
    check_length("scales", equations.len(), scales.len())?;
    let pool = pool(options.threads)?;

    // Distinct candidates of each equation.
    let mut ids: Vec<HashMap<Key, u32>> = vec![HashMap::new(); equations.len()];
    let mut structures: Vec<Vec<Structure>> = vec![Vec::new(); equations.len()];
    let mut tuples = 0u64;
    for index in 0..lattice.product() {
        if index % 65_536 == 0 && control.stop.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        let Some(found) = lattice.structures(index) else { continue };
        tuples += 1;
        for (e, structure) in found.into_iter().enumerate() {
            let next = u32::try_from(structures[e].len())
                .map_err(|_| Error::Internal { what: "more than 2^32 distinct orders".into() })?;
            let all = &mut structures[e];
            ids[e].entry(key(&structure)).or_insert_with(|| {
                all.push(structure);
                next
            });
        }
    }
    if tuples == 0 {
        return Err(Error::EmptyLattice { why: "no tuple of free orders gives orders in range".into() });
    }
    let distinct: Vec<u64> = structures.iter().map(|s| s.len() as u64).collect();
    control.total.store(distinct.iter().sum(), Ordering::Relaxed);

    let mut tables = Vec::with_capacity(equations.len());
    for (e, structures) in structures.into_iter().enumerate() {
        check_length("fixed coefficients", equations[e].terms.len(), fixed[e].len())?;
        let (mut index, mut seen, mut alphas) = (Index::default(), HashSet::new(), HashSet::new());
        for structure in &structures {
            if alphas.insert(grains(structure.order)) {
                index_alpha(&mut index, structure.order, &options.initial);
            }
            for term in &structure.terms {
                index_orders(&mut index, &mut seen, structure.order, term.signal, term.order, &options.initial);
            }
        }
        #[allow(clippy::cast_precision_loss)]
        let samples = records.iter().map(Record::m).sum::<usize>() as f64;
        let entries = vec![Entry { value: 0.0, exact: false, bounded: false, failure: None }; structures.len()];
        let problem = Problem::new(records, equations[e].output, index, &fixed[e], options)?;
        let problem = pool.install(|| problem.with_bound(structures.len() as u64));
        tables.push(Table { problem, structures, entries, scale: scales[e], samples, options });
    }

    // First pass: each equation's own best, the others left at a few times it.
    for table in &mut tables {
        let mut best = f64::INFINITY;
        let mut start = 0;
        while start < table.structures.len() {
            let end = table.structures.len().min(start + if start == 0 { 256 } else { ROUND });
            let limit = if options.early_stopping { FIRST_LIMIT * best } else { f64::INFINITY };
            let wanted: Vec<(usize, f64)> = (start..end).map(|id| (id, limit)).collect();
            table.evaluate(&wanted, &pool, control)?;
            control.done.fetch_add((end - start) as u64, Ordering::Relaxed);
            best = table.entries[start..end]
                .iter()
                .filter(|entry| entry.exact)
                .fold(best, |best, entry| best.min(entry.value));
            start = end;
        }
    }

    let mut raise = FIRST_LIMIT;
    let (kept, counts, failures) = loop {
        let (kept, counts, failures) = join(lattice, &ids, &tables, options.keep, &pool, control)?;
        let worst = if kept.len() == options.keep { kept[kept.len() - 1].0 } else { f64::INFINITY };
        let wanted = unresolved(lattice, &ids, &tables, worst, raise, &pool, control)?;
        if wanted.iter().all(Vec::is_empty) {
            break (kept, counts, failures);
        }
        for (table, wanted) in tables.iter_mut().zip(&wanted) {
            table.evaluate(wanted, &pool, control)?;
        }
        raise *= FIRST_LIMIT;
    };

    let mut scratch = crate::search::run::Scratch::new();
    let mut rows = Vec::with_capacity(kept.len());
    for (score, index) in kept {
        let structures = lattice
            .structures(index)
            .ok_or_else(|| Error::Internal { what: "a kept tuple without structures".into() })?;
        let mut parts = Vec::with_capacity(structures.len());
        for (table, structure) in tables.iter().zip(&structures) {
            let (_, mut row) = table.problem.evaluate_structure(structure, f64::INFINITY, &mut scratch, control)?;
            row.score = table.problem.score(row.score);
            parts.push(row);
        }
        rows.push(StageRow { index, free: lattice.free(index), score, structures, rows: parts });
    }
    Ok(StageOutcome { rows, counts, failures, distinct })
}

/// Length of the index ranges that threads take.
const CHUNK: u64 = 65_536;

fn chunks(product: u64) -> Vec<(u64, u64)> {
    (0..product.div_ceil(CHUNK)).map(|c| (c * CHUNK, product.min((c + 1) * CHUNK))).collect()
}

/// Table entries of a tuple, or none where it obeys no law.
fn entries(
    lattice: &LawLattice,
    ids: &[HashMap<Key, u32>],
    tables: &[Table<'_>],
    index: u64,
) -> Option<Vec<(usize, Entry)>> {
    let structures = lattice.structures(index)?;
    structures
        .iter()
        .zip(ids)
        .zip(tables)
        .map(|((structure, ids), table)| {
            let id = *ids.get(&key(structure))? as usize;
            Some((id, table.entries[id]))
        })
        .collect()
}

/// Best exact tuples, what became of all, and the first failures.
type Joined = (Vec<(f64, u64)>, Counts, Vec<(u64, Failure)>);

/// Best exact tuples and what became of all.
fn join(
    lattice: &LawLattice,
    ids: &[HashMap<Key, u32>],
    tables: &[Table<'_>],
    keep: usize,
    pool: &rayon::ThreadPool,
    control: &Control,
) -> Result<Joined> {
    let best = |kept: &mut Vec<(f64, u64)>| {
        kept.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        kept.truncate(keep);
    };
    let parts: Vec<Joined> = pool.install(|| {
        chunks(lattice.product())
            .into_par_iter()
            .map(|(lo, hi)| {
                if control.stop.load(Ordering::Relaxed) {
                    return Err(Error::Interrupted);
                }
                let mut kept = Vec::new();
                let mut counts = Counts::default();
                let mut failures = Vec::new();
                for index in lo..hi {
                    let Some(found) = entries(lattice, ids, tables, index) else { continue };
                    counts.candidates += 1;
                    let failure = found.iter().find_map(|(_, entry)| entry.failure);
                    if let (Some(failure), true) = (failure, failures.len() < LISTED) {
                        failures.push((index, failure));
                    }
                    match failure {
                        Some(Failure::Singular) => counts.singular += 1,
                        Some(Failure::Diverged) => counts.diverged += 1,
                        None if found.iter().all(|(_, entry)| entry.exact) => {
                            counts.beaten += 1;
                            kept.push((found.iter().map(|(_, entry)| entry.value).sum(), index));
                            if kept.len() >= 8 * keep.max(64) {
                                best(&mut kept);
                            }
                        }
                        None if found.iter().all(|(_, entry)| entry.exact || entry.bounded) => counts.bounded += 1,
                        None => counts.stopped += 1,
                    }
                }
                best(&mut kept);
                Ok((kept, counts, failures))
            })
            .collect::<Result<_>>()
    })?;
    let mut kept = Vec::new();
    let mut counts = Counts::default();
    let mut failures = Vec::new();
    for (rows, part, failed) in parts {
        kept.extend(rows);
        failures.extend(failed.into_iter().take(LISTED - failures.len()));
        counts.candidates += part.candidates;
        counts.beaten += part.beaten;
        counts.bounded += part.bounded;
        counts.stopped += part.stopped;
        counts.singular += part.singular;
        counts.diverged += part.diverged;
    }
    best(&mut kept);
    counts.kept = kept.len() as u64;
    counts.beaten -= counts.kept;
    Ok((kept, counts, failures))
}

/// Inexact entries that could still be part of a kept tuple, with the score up to which to follow each.
fn unresolved(
    lattice: &LawLattice,
    ids: &[HashMap<Key, u32>],
    tables: &[Table<'_>],
    worst: f64,
    raise: f64,
    pool: &rayon::ThreadPool,
    control: &Control,
) -> Result<Vec<Vec<(usize, f64)>>> {
    let parts: Vec<Vec<HashMap<usize, f64>>> = pool.install(|| {
        chunks(lattice.product())
            .into_par_iter()
            .map(|(lo, hi)| {
                if control.stop.load(Ordering::Relaxed) {
                    return Err(Error::Interrupted);
                }
                let mut wanted = vec![HashMap::new(); tables.len()];
                for index in lo..hi {
                    let Some(found) = entries(lattice, ids, tables, index) else { continue };
                    let bound: f64 = found.iter().map(|(_, entry)| entry.value).sum();
                    // Not finite where one part has failed.
                    if !(bound <= worst && bound.is_finite()) {
                        continue;
                    }
                    for (e, &(id, entry)) in found.iter().enumerate().filter(|(_, (_, entry))| !entry.exact) {
                        // Without a full table any tuple may enter: follow this one a few times further than before.
                        let limit = if worst.is_finite() { worst - (bound - entry.value) } else { raise * entry.value };
                        // Where rounding leaves no room between bound and worst, only its end tells more.
                        let limit = if limit > entry.value { limit } else { f64::INFINITY };
                        let old = wanted[e].entry(id).or_insert(limit);
                        *old = old.max(limit);
                    }
                }
                Ok(wanted)
            })
            .collect::<Result<_>>()
    })?;
    let mut wanted: Vec<HashMap<usize, f64>> = vec![HashMap::new(); tables.len()];
    for part in parts {
        for (all, some) in wanted.iter_mut().zip(part) {
            for (id, limit) in some {
                let old = all.entry(id).or_insert(limit);
                *old = old.max(limit);
            }
        }
    }
    Ok(wanted
        .into_iter()
        .map(|all| {
            let mut list: Vec<(usize, f64)> = all.into_iter().collect();
            list.sort_by_key(|(id, _)| *id);
            list
        })
        .collect())
}
