//! Lower bounds of the squared equation error for a row of candidates, which differ in one term only.
//!
//! The varying term comes last in the factorization L D Lᵀ of the Gram matrix. All candidates of the row therefore have
//! the factor of the other (common) terms in common.

use crate::order_search::candidate::columns::{part_of, Columns};
use crate::order_search::candidate::normal_equations::ResidualSumOfSquares;
use crate::simd::Lanes;

/// Maximum number of common terms of a row of candidates. The varying term is not counted.
const MAX_COMMON_TERMS: usize = 7;

/// Factor L D Lᵀ of the Gram matrix of the common terms of a row of candidates, and the regression of the measured
/// output on these terms.
pub(crate) struct CommonFactor<'a> {
    squares: &'a ResidualSumOfSquares,
    /// Number of common terms, which all candidates of a row have.
    count: usize,
    /// Regressor columns of the common terms.
    columns: [usize; MAX_COMMON_TERMS],
    /// Rows of the triangular factor L to the left of its unit diagonal.
    lower: [[f64; MAX_COMMON_TERMS]; MAX_COMMON_TERMS],
    /// Inverse elements of the diagonal factor D, infinite for a nonpositive pivot.
    inverse: [f64; MAX_COMMON_TERMS],
    /// Inner products of the common terms with the measured output, multiplied by the inverse of the triangular factor
    /// L.
    values: [f64; MAX_COMMON_TERMS],
    /// Coefficients of the regression of the measured output on the common terms.
    common_coefficients: [f64; MAX_COMMON_TERMS],
    /// Norms of the regressor columns of the common terms.
    norms: [f64; MAX_COMMON_TERMS],
    /// Residual sum of squares of the regression of the measured output on the common terms.
    residual: f64,
    /// Trace of the inverse correlation matrix of the common terms. It bounds every inverse eigenvalue from above.
    trace: f64,
}

impl<'a> CommonFactor<'a> {
    /// Factor the terms with these columns except term number `varying_term`. `None` if there are too many terms, or if
    /// they are so nearly dependent that no bound holds.
    #[inline(always)]
    pub(crate) fn new(squares: &'a ResidualSumOfSquares, columns: &[usize], varying_term: usize) -> Option<Self> {
        let count = columns.len().checked_sub(1).filter(|count| *count <= MAX_COMMON_TERMS)?;
        let zero = [0.0; MAX_COMMON_TERMS];
        let mut factor = Self {
            squares,
            count,
            columns: [0; MAX_COMMON_TERMS],
            lower: [zero; MAX_COMMON_TERMS],
            inverse: zero,
            values: zero,
            common_coefficients: zero,
            norms: zero,
            residual: squares.product(squares.target(), squares.target()),
            trace: 0.0,
        };
        for i in 0..count {
            factor.columns[i] = columns[i + usize::from(i >= varying_term)];
            factor.extend(i);
        }
        // This form of the condition also rejects NaN.
        (factor.trace * squares.min_eigenvalue() <= 1.0).then_some(factor)
    }

    /// Add the common term number `i` to the triangular factor and to the regression.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // triangular arrays, indexed by row and column
    fn extend(&mut self, i: usize) {
        let (squares, column) = (self.squares, self.columns[i]);
        let square = squares.product(column, column);
        let (mut pivot, mut value) = (square, squares.product(squares.target(), column));
        let mut row = [0.0; MAX_COMMON_TERMS];
        for j in 0..i {
            row[j] = squares.product(column, self.columns[j]);
            for l in 0..j {
                row[j] -= row[l] * self.lower[j][l];
            }
        }
        for j in 0..i {
            self.lower[i][j] = row[j] * self.inverse[j];
            pivot -= row[j] * self.lower[i][j];
            value -= self.lower[i][j] * self.values[j];
        }
        self.inverse[i] = if pivot > 0.0 { 1.0 / pivot } else { f64::INFINITY };
        self.values[i] = value;
        self.norms[i] = squares.norms()[column];
        let last = value * self.inverse[i];
        self.residual -= value * last;
        // Back substitution gives the regression of this column on the previous ones, which changes their coefficients.
        let mut sum = square;
        for j in (0..i).rev() {
            row[j] = self.lower[i][j];
            for l in j + 1..i {
                row[j] -= self.lower[l][j] * row[l];
            }
            sum += row[j] * row[j] * self.norms[j] * self.norms[j];
            self.common_coefficients[j] -= row[j] * last;
        }
        self.common_coefficients[i] = last;
        self.trace += sum * self.inverse[i];
    }

    /// Append the indices into `columns` of the candidates that this bound does not exclude at a limit of the sum of
    /// squared equation errors. `columns` contains the column of the varying term for each candidate, sorted by
    /// increasing index.
    #[inline(always)]
    pub(crate) fn append_open<const L: usize>(&self, columns: &[usize], limit: f64, open: &mut Vec<usize>) {
        // For frequent numbers of terms, the compiler generates loops of constant length.
        match self.count {
            0 => self.append_open_sized::<L>(0, columns, limit, open),
            1 => self.append_open_sized::<L>(1, columns, limit, open),
            2 => self.append_open_sized::<L>(2, columns, limit, open),
            3 => self.append_open_sized::<L>(3, columns, limit, open),
            4 => self.append_open_sized::<L>(4, columns, limit, open),
            count => self.append_open_sized::<L>(count, columns, limit, open),
        }
    }

    /// Append the indices as [`Self::append_open`] does, with `count` common terms as a constant for the compiler.
    #[inline(always)]
    fn append_open_sized<const L: usize>(&self, count: usize, columns: &[usize], limit: f64, open: &mut Vec<usize>) {
        let mut start = 0;
        while start + L <= columns.len() {
            let changing = Columns::<L>::from_ascending(part_of(&columns[start..]));
            self.append_open_lanes(count, &changing, (start, L), limit, open);
            start += L;
        }
        if start < columns.len() {
            let remaining = &columns[start..];
            let mut lane_columns = [remaining[0]; L];
            lane_columns[..remaining.len()].copy_from_slice(remaining);
            let mut changing = Columns::new(lane_columns);
            changing.compare();
            self.append_open_lanes(count, &changing, (start, remaining.len()), limit, open);
        }
    }

    /// Append `from` + n for each of the first `lanes` SIMD lanes n whose candidate is not excluded.
    #[inline(always)]
    fn append_open_lanes<const L: usize>(
        &self,
        count: usize,
        changing: &Columns<L>,
        (from, lanes): (usize, usize),
        limit: f64,
        open: &mut Vec<usize>,
    ) {
        let flags = self.exclusion_flags(count, changing, limit);
        if flags == [true; L] {
            return;
        }
        open.extend((from..from + lanes).zip(flags).filter(|(_, flag)| !flag).map(|(position, _)| position));
    }

    /// Return one flag for each of L candidates. It is true if no coefficients reduce the sum of squared equation
    /// errors of the candidate to the limit.
    #[inline(always)]
    #[allow(clippy::needless_range_loop)] // triangular arrays of lanes, indexed by row and column
    fn exclusion_flags<const L: usize>(&self, count: usize, changing: &Columns<L>, limit: f64) -> [bool; L] {
        let squares = self.squares;
        let square = changing.gather(squares.diagonal());
        let norms = changing.gather(squares.norms());
        let (mut pivot, mut value) = (square, changing.gather(squares.row(squares.target())));
        // Row of L D for the varying term, later its row of L.
        let mut row: [Lanes<L>; MAX_COMMON_TERMS] = [[0.0; L]; MAX_COMMON_TERMS];
        for j in 0..count {
            let mut sum = changing.gather(squares.row(self.columns[j]));
            for l in 0..j {
                for n in 0..L {
                    sum[n] -= row[l][n] * self.lower[j][l];
                }
            }
            row[j] = sum;
        }
        for j in 0..count {
            for n in 0..L {
                let scaled = row[j][n] * self.inverse[j];
                pivot[n] -= row[j][n] * scaled;
                value[n] -= scaled * self.values[j];
                row[j][n] = scaled;
            }
        }
        let (mut error, mut size, mut sum) = ([0.0; L], [0.0; L], square);
        let (mut inverse, mut last) = ([0.0; L], [0.0; L]);
        for n in 0..L {
            inverse[n] = 1.0 / pivot[n];
            last[n] = value[n] * inverse[n];
            error[n] = self.residual - value[n] * last[n];
            size[n] = squares.norms()[squares.target()] + last[n].abs() * norms[n];
        }
        // Back substitution gives the regression of the varying column on the common ones, which changes their
        // coefficients.
        for j in (0..count).rev() {
            for l in j + 1..count {
                for n in 0..L {
                    row[j][n] -= self.lower[l][j] * row[l][n];
                }
            }
            for n in 0..L {
                let coefficient = row[j][n] * self.norms[j];
                sum[n] += coefficient * coefficient;
                size[n] += (self.common_coefficients[j] - row[j][n] * last[n]).abs() * self.norms[j];
            }
        }
        let (slack, flat) = (squares.slack(), squares.min_eigenvalue());
        let mut flags = [false; L];
        for n in 0..L {
            // This form of the condition lets NaN exclude nothing.
            let is_sound = (pivot[n] > 0.0) & ((self.trace + sum[n] * inverse[n]) * flat <= 1.0);
            flags[n] = is_sound & (error[n] - slack * size[n] * size[n] > limit);
        }
        flags
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::least_squares;
    use crate::linalg::dense;
    use crate::parallel::Stop;

    /// Return reproducible pseudorandom numbers in [−1, 1).
    fn noise(state: &mut u64, count: usize) -> Vec<f64> {
        let mut next = || {
            *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            #[allow(clippy::cast_precision_loss)]
            let value = (*state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0;
            value
        };
        (0..count).map(|_| next()).collect()
    }

    /// Return columns that deviate from a common one by the fraction `share`, with different scales.
    fn correlated_columns(state: &mut u64, count: usize, m: usize, share: f64) -> Vec<Vec<f64>> {
        let base = noise(state, m);
        let mut one = |i: usize| {
            let unit = libm::pow(10.0, (i % 5) as f64 - 2.0);
            base.iter().zip(noise(state, m)).map(|(b, v)| unit * (b + share * v)).collect()
        };
        (0..count).map(&mut one).collect()
    }

    #[test]
    fn candidates_within_the_limit_remain_for_collinear_columns() {
        let state = &mut 5;
        let (mut proved, mut open_count, mut none) = (0, 0, 0);
        for case in 0..240_u32 {
            let (m, terms, along) = (30 + case as usize % 170, 1 + case as usize % 6, 3 + case as usize % 23);
            let share = libm::pow(10.0, -f64::from(case % 15) / 2.0);
            let columns = correlated_columns(state, terms - 1 + along, m, share);
            let level = libm::pow(10.0, -f64::from(case % 8));
            let sum: Vec<f64> = (0..m).map(|t| columns[..terms].iter().map(|c| c[t]).sum()).collect();
            let target: Vec<f64> = sum.iter().zip(noise(state, m)).map(|(s, v)| s + level * v).collect();
            let squares = ResidualSumOfSquares::new(
                dense::gram(&columns.concat(), &target, &Stop::default()),
                columns.len(),
                m,
                terms,
                1,
            );
            let varying_term = case as usize % terms;
            let others: Vec<usize> = (0..terms - 1).collect();
            let changing: Vec<usize> = (terms - 1..columns.len()).collect();
            let mut named = others.clone();
            named.insert(varying_term, changing[0]);
            let Some(shared) = CommonFactor::new(&squares, &named, varying_term) else {
                none += 1;
                continue;
            };
            for (n, &column) in changing.iter().enumerate() {
                let fitted: Vec<Vec<f64>> = others.iter().chain([&column]).map(|&c| columns[c].clone()).collect();
                let Ok((c, _)) = least_squares::solve(&fitted, &target, terms) else { continue };
                let error = |t: usize| target[t] - fitted.iter().zip(&c).map(|(x, c)| c * x[t]).sum::<f64>();
                let score: f64 = (0..m).map(|t| error(t) * error(t)).sum();
                let mut open = Vec::new();
                shared.append_open::<8>(&changing, score, &mut open);
                assert!(open.contains(&n), "case {case}: {n} of {along} has score {score:e}");
                assert!(open.windows(2).all(|pair| pair[0] < pair[1]) && open.iter().all(|&at| at < along));
                let mut one = Vec::new();
                shared.append_open::<1>(&changing, score, &mut one);
                assert_eq!(one, open, "one at a time");
                open.clear();
                shared.append_open::<8>(&changing, 0.5 * score, &mut open);
                *(if open.contains(&n) { &mut open_count } else { &mut proved }) += 1;
            }
        }
        println!("{proved} excluded at half their score, {open_count} not; {none} stretches without a factor");
        assert!(proved > 1000 && proved > open_count && none > 10);
    }
}
