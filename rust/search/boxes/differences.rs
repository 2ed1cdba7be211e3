//! First and second differences of neighbouring regressors, and their products with all regressors.
//!
//! Products of the differences themselves, not differences of products: these would lose what little is left of them.

use std::collections::HashMap;

use rayon::prelude::*;

use crate::dense;
use crate::search::candidate::problem::Problem;

/// Differences whose products are made at a time.
const BATCH: usize = 64;
/// Most bytes of products; above, boxes do without.
const MOST: u64 = 256 << 20;

/// Of columns a, b, c of unit size that follow one another: δ = (c − a)/2 and D = a − 2b + c.
pub(crate) struct Differences {
    rows: HashMap<[usize; 3], usize>,
    width: usize,
    /// Per row: products of δ with every column, then those of D.
    products: Vec<f64>,
    /// Per row: δ·δ, δ·D, D·D.
    own: Vec<[f64; 3]>,
}

impl Differences {
    /// Of these neighbours; none where their products would need too much memory, or more than is left of it [bytes].
    ///
    /// Runs on the current thread pool.
    pub(crate) fn new(problem: &Problem, neighbours: impl Iterator<Item = [usize; 3]>, left: u64) -> Option<Self> {
        let mut rows = HashMap::new();
        let mut triples: Vec<[usize; 3]> = Vec::new();
        for triple in neighbours {
            rows.entry(triple).or_insert_with(|| {
                triples.push(triple);
                triples.len() - 1
            });
        }
        let inverse = problem.equations.whole()?.inverse();
        let width = inverse.len();
        if triples.len().checked_mul(8 * (2 * width + 3))? as u64 > left.min(MOST) {
            return None;
        }
        let mut products = vec![0.0; 2 * triples.len() * width];
        let mut own = vec![[0.0; 3]; triples.len()];
        for bank in problem.banks() {
            let columns: Vec<&[f64]> = (0..width).map(|p| bank.column(p)).collect();
            let batches = products.par_chunks_mut(2 * BATCH * width).zip(own.par_chunks_mut(BATCH));
            batches.zip(triples.par_chunks(BATCH)).for_each(|((products, own), triples)| {
                let vectors: Vec<Vec<f64>> = triples
                    .iter()
                    .flat_map(|&[a, b, c]| {
                        let unit = |p: usize| columns[p].iter().map(move |x| x * inverse[p]);
                        let first = unit(a).zip(unit(c)).map(|(a, c)| (c - a) / 2.0).collect();
                        let second = unit(a).zip(unit(b)).zip(unit(c)).map(|((a, b), c)| (a - b) + (c - b)).collect();
                        [first, second]
                    })
                    .collect();
                let flat: Vec<&[f64]> = vectors.iter().map(Vec::as_slice).collect();
                let inner = dense::inner_products(&flat, &columns);
                for (j, sum) in products.chunks_exact_mut(width).enumerate() {
                    for (p, sum) in sum.iter_mut().enumerate() {
                        *sum += inner[j * width + p] * inverse[p];
                    }
                }
                let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
                for (own, pair) in own.iter_mut().zip(vectors.chunks_exact(2)) {
                    own[0] += dot(&pair[0], &pair[0]);
                    own[1] += dot(&pair[0], &pair[1]);
                    own[2] += dot(&pair[1], &pair[1]);
                }
            });
        }
        Some(Self { rows, width, products, own })
    }

    /// Products of δ and of D with every column, and among themselves.
    pub(super) fn of(&self, neighbours: [usize; 3]) -> Option<([&[f64]; 2], [f64; 3])> {
        let row = *self.rows.get(&neighbours)?;
        let part = |half: usize| &self.products[(2 * row + half) * self.width..(2 * row + half + 1) * self.width];
        Some(([part(0), part(1)], self.own[row]))
    }
}
