//! Test vectors that follow coefficients, made where a sample of the lattice says that many candidates wait for them.

use std::collections::BTreeMap;

use rayon::prelude::*;

use crate::error::Result;
use crate::order_search::batches::batch::Hunt;
use crate::order_search::candidate::problem::Known;
use crate::order_search::dual_bound::linearized_vectors::{Tangent, Tangents, MOST_OWN};
use crate::order_search::grid::spread::visit;
use crate::order_search::grid::traversal::Cursor;
use crate::order_search::screening::screen;

/// Candidates of the sample, in stretches of so many: one in eight of a small lattice.
const SAMPLED: u64 = 1 << 19;
const SHARE: u64 = 8;
const STRETCH: u64 = 8;
/// Candidates that a vector must exclude, or that must be left where one more is tried: making one costs as much as ten
/// to twenty free runs.
const WORTH: f64 = 32.0;
/// Most vectors for the same own orders, and most candidates tried in vain.
const MADE: usize = 24;
const VAIN: usize = 6;
/// Most bytes of all.
const MOST: u64 = 1 << 30;

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
        groups.retain(|own, open| (1..=MOST_OWN).contains(&own.len()) && open.len() as f64 * weight >= WORTH);
        let bytes = groups.keys().map(|own| tangents.bytes(own.len())).max().unwrap_or(1);
        let room = self.catalogue.spare.min(MOST) / bytes / (groups.len() as u64).max(1);
        let room = usize::try_from(room).unwrap_or(MADE).min(MADE);
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
        let stretches = count.div_ceil(STRETCH);
        let order = visit(stretches);
        let wanted = (count / SHARE).min(SAMPLED).div_ceil(STRETCH).clamp(1, stretches);
        let open: Vec<Known> = self.pool.install(|| {
            (0..wanted)
                .into_par_iter()
                .flat_map_iter(|i| {
                    let at = order(i) * STRETCH;
                    let open = if self.stopped() {
                        Vec::new()
                    } else {
                        screen(catalogue, at, count.min(at + STRETCH), limit).0
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
        Ok((open, count as f64 / (wanted * STRETCH) as f64))
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
        let many = |count: usize| count as f64 * weight >= WORTH;
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
