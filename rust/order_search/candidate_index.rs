//! Index of the candidates of an order grid: the regressor columns of each candidate, from precomputed tables.

use std::borrow::Cow;

use crate::equation::Initial;
use crate::error::{check_length, Result};
use crate::order_search::candidate::columns::RequiredRegressors;
use crate::order_search::candidate::problem::Problem;
use crate::order_search::dual_bound::lower_bound::Bound;
use crate::order_search::grid::independent::OrderGrid;
use crate::order_search::grid::traversal::Cursor;
use crate::order_search::options::{Budget, Options};
use crate::parallel::Stop;
use crate::regressors::Record;

/// All candidates of an order grid for one equation, with the regressors and bounds that they share.
pub(crate) struct CandidateIndex<'a> {
    pub(crate) problem: Problem,
    pub(crate) grid: Cow<'a, OrderGrid>,
    pub(crate) options: Options,
    /// The unused part of the memory limit \[bytes\].
    pub(crate) spare_bytes: u64,
    /// Column of the regressor, by block of the order grid, then by term, then by grid value of the order of the term.
    /// A block has one order α of the equation.
    tables: Vec<Vec<Vec<usize>>>,
}

impl<'a> CandidateIndex<'a> {
    /// Build the regressors, their inner products and the fixed test vectors for all candidates.
    pub(crate) fn new(
        records: &[Record],
        grid: Cow<'a, OrderGrid>,
        fixed: &[Option<f64>],
        options: &Options,
        pool: &rayon::ThreadPool,
        stop: &Stop,
    ) -> Result<Self> {
        check_length("fixed coefficients", grid.width(), fixed.len())?;
        for record in records {
            grid.structure(0).check(record.len(), |_| true)?;
        }
        let mut required = RequiredRegressors::new(&options.initial);
        for block in grid.blocks() {
            required.add_alpha(block.alpha);
            for (group, slice) in grid.groups().iter().zip(&block.tuples) {
                for (axis, &first) in group.axes.iter().zip(&slice.first) {
                    axis[first..].iter().for_each(|&order| required.add_term(block.alpha, group.signal, order));
                }
            }
        }
        let (output, index, mut budget) = (grid.output(), required.into_index(), Budget::default());
        budget.add(records, output, &index, options, Bound::MAX_TEST_VECTORS);
        budget.check(options.memory)?;
        let spare_bytes = budget.remaining_bytes(options.memory);
        let problem = pool.install(|| {
            Ok(Problem::new(records, output, index, fixed, options, stop)?.with_bound(grid.count(), stop))
        })?;
        stop.check()?;
        let tables = tables(&grid, &problem)?;
        Ok(Self { problem, grid, options: options.clone(), spare_bytes, tables })
    }

    /// Write the column of each term of the candidate at the cursor to `positions`.
    pub(crate) fn positions(&self, cursor: &Cursor<'_>, positions: &mut [usize]) {
        let table = &self.tables[cursor.block()];
        cursor.for_each_term(0, |term, digit| positions[term] = table[term][digit]);
    }

    /// Write the columns of the initial terms of the candidate at a cursor to `initial`. Unchanged for zero initial
    /// conditions.
    pub(crate) fn initial(&self, cursor: &Cursor<'_>, initial: &mut Vec<usize>) {
        if self.options.initial != Initial::Rest {
            self.problem.initial_positions(&cursor.structure(), initial);
        }
    }

    /// Return the columns of all grid values of the order of one term, for the order α at the cursor.
    #[inline(always)]
    pub(crate) fn term_columns(&self, cursor: &Cursor<'_>, term: usize) -> &[usize] {
        &self.tables[cursor.block()][term]
    }

    /// Return the columns of all grid values of the order of one term, for the order α of a block.
    pub(crate) fn columns(&self, block: usize, term: usize) -> &[usize] {
        &self.tables[block][term]
    }

    /// Advance the cursor to the next candidate, and update the columns `terms`.
    #[inline(always)]
    pub(crate) fn next(&self, cursor: &mut Cursor<'_>, terms: &mut [usize]) {
        let changed = cursor.advance();
        let table = &self.tables[cursor.block()];
        cursor.for_each_term(changed, |term, digit| terms[term] = table[term][digit]);
    }
}

/// Return the column of every grid value of every term, by block. A table avoids a lookup of each regressor per
/// candidate.
fn tables(grid: &OrderGrid, problem: &Problem) -> Result<Vec<Vec<Vec<usize>>>> {
    grid.blocks()
        .iter()
        .map(|block| {
            let mut table = vec![Vec::new(); grid.width()];
            for (group, slice) in grid.groups().iter().zip(&block.tuples) {
                for ((&term, axis), &first) in group.terms.iter().zip(&group.axes).zip(&slice.first) {
                    table[term] = axis
                        .iter()
                        .enumerate()
                        .map(|(i, &order)| {
                            // Grid values outside the range of this α are never used.
                            if i < first {
                                Ok(0)
                            } else {
                                problem.position(group.signal, block.alpha - order)
                            }
                        })
                        .collect::<Result<_>>()?;
                }
            }
            Ok(table)
        })
        .collect()
}
