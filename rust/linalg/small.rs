//! Small dense systems: inverses, LU, batched LDLᵀ solutions, recursive least squares. This is the only module that
//! uses `nalgebra`.

use nalgebra::{DMatrix, DVector, Dyn, FullPivLU, Schur};

use crate::error::{check_length, Error, Result};
use crate::simd::Lanes;

/// Pivot of a correlation matrix at or below which a regressor is linearly dependent within rounding. The elements of a
/// Gram matrix of columns with m = 2048 rows have errors of about 1e−13.
pub const PIVOT_FLOOR: f64 = 1e-13;

/// Return the inverse of a row-major n × n matrix, row-major.
///
/// # Errors
/// [`Error::LeadingZero`] with the determinant of a singular matrix. [`Error::Length`] for a wrong number of elements.
///
/// ```
/// # fn main() -> ftlm::error::Result<()> {
/// assert_eq!(ftlm::linalg::small::inverse(&[2.0, 0.0, 0.0, 4.0], 2)?, [0.5, 0.0, 0.0, 0.25]);
/// # Ok(())
/// # }
/// ```
pub fn inverse(matrix: &[f64], n: usize) -> Result<Vec<f64>> {
    check_length("matrix", n * n, matrix.len())?;
    if n == 1 {
        let value = matrix[0];
        return if value != 0.0 && value.is_finite() {
            Ok(vec![1.0 / value])
        } else {
            Err(Error::LeadingZero { leading: value })
        };
    }
    let a = DMatrix::from_row_slice(n, n, matrix);
    let determinant = a.determinant();
    match a.try_inverse() {
        Some(inverse) if inverse.iter().all(|v| v.is_finite()) => Ok(inverse.transpose().as_slice().to_vec()),
        _ => Err(Error::LeadingZero { leading: determinant }),
    }
}

/// Return the inverse (row-major) and the determinant of a row-major n × n matrix. `None` for a singular matrix, or one
/// that is not finite.
///
/// ```
/// use ftlm::linalg::small::inverse_with_determinant;
/// assert_eq!(inverse_with_determinant(&[0.0, 2.0, -4.0, 0.0], 2), Some((vec![0.0, -0.25, 0.5, 0.0], 8.0)));
/// ```
#[must_use]
pub fn inverse_with_determinant(matrix: &[f64], n: usize) -> Option<(Vec<f64>, f64)> {
    let (inverse, determinant) = match (matrix, n) {
        (&[a], 1) => (vec![1.0 / a], a),
        (&[a, b, c, d], 2) => {
            let determinant = a * d - b * c;
            ([d, -b, -c, a].iter().map(|v| v / determinant).collect(), determinant)
        }
        _ => {
            let a = DMatrix::from_row_slice(n, n, matrix);
            let determinant = a.determinant();
            (a.try_inverse()?.transpose().as_slice().to_vec(), determinant)
        }
    };
    (determinant != 0.0 && inverse.iter().all(|v| v.is_finite())).then_some((inverse, determinant))
}

/// Maximum number of steps of an eigenvalue iteration. A polynomial of degree ten needs about thirty.
const MAX_EIGENVALUE_STEPS: usize = 1000;

/// Return the largest magnitude of the zeros of a polynomial. `coefficients` are in ascending order of the power.
///
/// `None` for a polynomial without zeros, or if the leading coefficient is 0 or too small relative to the others.
///
/// ```
/// // (z + 3)(z − 2)
/// assert!((ftlm::linalg::small::spectral_radius(&[-6.0, 1.0, 1.0]).unwrap_or(0.0) - 3.0).abs() < 1e-14);
/// ```
#[must_use]
pub fn spectral_radius(coefficients: &[f64]) -> Option<f64> {
    let roots = polynomial_roots(coefficients)?;
    Some(roots.iter().map(|(re, im)| re.hypot(*im)).fold(0.0, f64::max)).filter(|_| !roots.is_empty())
}

/// Return the zeros of a polynomial as pairs (real part, imaginary part). `coefficients` are in ascending order of the
/// power.
///
/// `None` if there are no coefficients, or if the leading coefficient is 0 or too small relative to the others.
///
/// ```
/// // (s + 1)² + 4
/// let found = ftlm::linalg::small::polynomial_roots(&[5.0, 2.0, 1.0]).unwrap_or_default();
/// assert!(found.iter().all(|(re, im)| (re + 1.0).abs() < 1e-14 && (im.abs() - 2.0).abs() < 1e-14));
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn polynomial_roots(coefficients: &[f64]) -> Option<Vec<(f64, f64)>> {
    let (leading, lower) = coefficients.split_last()?;
    let ratios: Vec<f64> = lower.iter().rev().map(|c| -c / leading).collect();
    if ratios.iter().any(|v| !v.is_finite()) {
        return None;
    }
    // With zeros in this unit, no coefficient is above 1 in modulus.
    let unit = ratios.iter().zip(1..).map(|(v, k)| v.abs().powf(1.0 / k as f64)).fold(0.0, f64::max);
    if unit == 0.0 {
        return Some(vec![(0.0, 0.0); ratios.len()]);
    }
    let rescale = |(k, v): (usize, &f64)| (0..=k).fold(*v, |v, _| v / unit);
    let first_row: Vec<f64> = ratios.iter().enumerate().map(rescale).collect();
    let n = first_row.len();
    let companion = DMatrix::from_fn(n, n, |i, j| if i == 0 { first_row[j] } else { f64::from(u8::from(i == j + 1)) });
    let eigenvalues = Schur::try_new(companion, f64::EPSILON, MAX_EIGENVALUE_STEPS)?.complex_eigenvalues();
    Some(eigenvalues.iter().map(|z| (unit * z.re, unit * z.im)).collect())
}

/// LU factorization of a square matrix after equilibration. The scales of its rows and columns may differ by any
/// factor.
pub struct EquilibratedLu {
    /// Scale of each row: its largest modulus.
    rows: Vec<f64>,
    /// Scale of each column: its largest modulus after scaling the rows.
    columns: Vec<f64>,
    /// LU factorization with full pivoting, `None` for an empty matrix.
    factor: Option<FullPivLU<f64, Dyn, Dyn>>,
}

impl EquilibratedLu {
    /// Factor a row-major k × k matrix.
    ///
    /// # Errors
    /// [`Error::Singular`] for a matrix that is singular within rounding. [`Error::Length`] for a wrong number of
    /// elements.
    ///
    /// ```
    /// let solved = ftlm::linalg::small::EquilibratedLu::new(&[2.0, 0.0, 0.0, 0.25], 2)?.solve(&[1.0, 1.0]);
    /// assert_eq!(solved, [0.5, 4.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn new(matrix: &[f64], k: usize) -> Result<Self> {
        check_length("matrix", k * k, matrix.len())?;
        // Scale rows, then columns, to a largest modulus of 1. The test for singularity then does not depend on units.
        let largest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0_f64, |a, v| a.max(v.abs()));
        let mut a = DMatrix::from_row_slice(k, k, matrix);
        let rows: Vec<f64> = (0..k).map(|i| largest(&mut a.row(i).iter().copied())).collect();
        for (i, scale) in rows.iter().enumerate() {
            a.row_mut(i).unscale_mut(*scale);
        }
        let columns: Vec<f64> = (0..k).map(|j| largest(&mut a.column(j).iter().copied())).collect();
        for (j, scale) in columns.iter().enumerate() {
            a.column_mut(j).unscale_mut(*scale);
        }
        let singular = |index| Error::Singular { index, count: k };
        if let Some(index) = rows.iter().chain(&columns).position(|s| !(*s > 0.0 && s.is_finite())) {
            return Err(singular(index % k.max(1)));
        }
        let factor = (k > 0).then(|| a.full_piv_lu());
        let pivots = factor.iter().flat_map(|f| f.u().diagonal().iter().copied().collect::<Vec<f64>>());
        if let Some(index) = pivots.into_iter().position(|p| p.is_nan() || p.abs() <= PIVOT_FLOOR) {
            return Err(singular(index));
        }
        Ok(Self { rows, columns, factor })
    }

    /// Return the solution for a right-hand side with one value per row.
    #[must_use]
    pub fn solve(&self, rhs: &[f64]) -> Vec<f64> {
        let mut x = DVector::from_iterator(rhs.len(), rhs.iter().zip(&self.rows).map(|(v, scale)| v / scale));
        if let Some(factor) = &self.factor {
            factor.solve_mut(&mut x);
        }
        x.iter().zip(&self.columns).map(|(v, scale)| v / scale).collect()
    }

    /// Return the inverse, row-major.
    #[must_use]
    pub fn inverse(&self) -> Vec<f64> {
        let k = self.rows.len();
        let mut out = vec![0.0; k * k];
        for j in 0..k {
            let mut unit = vec![0.0; k];
            unit[j] = 1.0;
            self.solve(&unit).into_iter().enumerate().for_each(|(i, v)| out[i * k + j] = v);
        }
        out
    }
}

/// Return the inverse (row-major) of a row-major k × k matrix. The scales of its rows and columns may differ by any
/// factor.
///
/// # Errors
/// [`Error::Singular`] for a matrix that is singular within rounding. [`Error::Length`] for a wrong number of elements.
///
/// ```
/// assert_eq!(ftlm::linalg::small::scaled_inverse(&[2.0, 0.0, 0.0, 0.25], 2), Ok(vec![0.5, 0.0, 0.0, 4.0]));
/// // The inverse of an empty matrix is empty.
/// assert_eq!(ftlm::linalg::small::scaled_inverse(&[], 0), Ok(vec![]));
/// ```
pub fn scaled_inverse(matrix: &[f64], k: usize) -> Result<Vec<f64>> {
    Ok(EquilibratedLu::new(matrix, k)?.inverse())
}

/// Return the index of element (i, j), j ≤ i, of a symmetric matrix stored as the rows of its lower triangle.
#[inline(always)]
#[must_use]
pub const fn packed_index(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

/// Solve L symmetric positive definite systems of k unknowns in parallel SIMD lanes, in place, by L D Lᵀ factorization.
/// O(k³).
///
/// `gram` contains the lower triangles ([`packed_index`]) of correlation matrices. Their diagonal elements are 1, or 0
/// for a zero column. `rhs` is overwritten with the solutions. The first `required` unknowns must be linearly
/// independent. The returned flag of a lane is true if these unknowns are linearly dependent. Dependent unknowns after
/// them are set to 0. The operations of a lane depend neither on other lanes nor on L.
#[inline(always)]
pub fn solve_lanes<const L: usize>(gram: &mut [Lanes<L>], rhs: &mut [Lanes<L>], required: usize) -> [bool; L] {
    // For frequent numbers of unknowns, the compiler generates loops of constant length.
    match rhs.len() {
        1 => solve_sized(1, gram, rhs, required),
        2 => solve_sized(2, gram, rhs, required),
        3 => solve_sized(3, gram, rhs, required),
        4 => solve_sized(4, gram, rhs, required),
        5 => solve_sized(5, gram, rhs, required),
        k => solve_sized(k, gram, rhs, required),
    }
}

/// Solve the systems as [`solve_lanes`] does, with the number of unknowns k as a constant for the compiler.
#[inline(always)]
fn solve_sized<const L: usize>(k: usize, gram: &mut [Lanes<L>], rhs: &mut [Lanes<L>], required: usize) -> [bool; L] {
    let (gram, rhs) = (&mut gram[..packed_index(k, 0)], &mut rhs[..k]);
    let mut singular = [false; L];
    for i in 0..k {
        let mut pivot = gram[packed_index(i, i)];
        for j in 0..i {
            // Row i of L D, then of L.
            let mut sum = gram[packed_index(i, j)];
            for l in 0..j {
                let (a, b) = (gram[packed_index(i, l)], gram[packed_index(j, l)]);
                for n in 0..L {
                    sum[n] -= a[n] * b[n];
                }
            }
            gram[packed_index(i, j)] = sum;
        }
        for j in 0..i {
            let (u, inverse) = (gram[packed_index(i, j)], gram[packed_index(j, j)]);
            let row = &mut gram[packed_index(i, j)];
            for n in 0..L {
                row[n] = u[n] * inverse[n];
                pivot[n] -= u[n] * row[n];
            }
        }
        let mut inverse = [0.0; L];
        let mut all_independent = true;
        for n in 0..L {
            let is_independent = pivot[n] > PIVOT_FLOOR;
            inverse[n] = if is_independent { 1.0 / pivot[n] } else { 0.0 };
            all_independent &= is_independent;
            singular[n] |= !is_independent && i < required;
        }
        gram[packed_index(i, i)] = inverse;
        let mut value = rhs[i];
        for j in 0..i {
            let (row, z) = (gram[packed_index(i, j)], rhs[j]);
            for n in 0..L {
                value[n] -= row[n] * z[n];
            }
        }
        rhs[i] = value;
        if !all_independent {
            for n in (0..L).filter(|&n| inverse[n] == 0.0) {
                (0..i).for_each(|j| gram[packed_index(i, j)][n] = 0.0);
                rhs[i][n] = 0.0;
            }
        }
    }
    for i in (0..k).rev() {
        let mut value = rhs[i];
        for n in 0..L {
            value[n] *= gram[packed_index(i, i)][n];
        }
        for j in i + 1..k {
            let (row, x) = (gram[packed_index(j, i)], rhs[j]);
            for n in 0..L {
                value[n] -= row[n] * x[n];
            }
        }
        rhs[i] = value;
    }
    singular
}

/// Return the solution of a small symmetric system with a row-major matrix. `None` if it is not positive definite.
/// O(k³) for k unknowns.
#[must_use]
pub fn positive_solve(matrix: &[f64], rhs: &[f64]) -> Option<Vec<f64>> {
    let k = rhs.len();
    let solution = DMatrix::from_row_slice(k, k, matrix).cholesky()?.solve(&DVector::from_column_slice(rhs));
    Some(solution.iter().copied().collect())
}

/// Return the x ≥ 0 that minimizes ‖Σ x_j column_j − target‖, by the active-set method.
///
/// The algorithm is that of Lawson & Hanson, doi:10.1137/1.9781611971217, §23.3. The coefficient of a linearly
/// dependent column is 0.
///
/// ```
/// let found = ftlm::linalg::small::nonnegative_solution(&[vec![1.0, 0.0], vec![0.0, 1.0]], &[2.0, -1.0]);
/// assert!((found[0] - 2.0).abs() < 1e-15 && found[1] == 0.0);
/// ```
#[must_use]
pub fn nonnegative_solution(columns: &[Vec<f64>], target: &[f64]) -> Vec<f64> {
    let n = columns.len();
    let matrix = DMatrix::from_fn(target.len(), n, |i, j| columns[j][i]);
    let target = DVector::from_column_slice(target);
    let (mut x, mut positive) = (DVector::<f64>::zeros(n), Vec::new());
    for _ in 0..3 * n {
        let gradient = matrix.tr_mul(&(&target - &matrix * &x));
        let rounding = |j: usize| 10.0 * f64::EPSILON * matrix.column(j).norm() * target.norm();
        let ascending = (0..n).filter(|j| !positive.contains(j) && gradient[*j] > rounding(*j));
        let Some(next) = ascending.max_by(|&i, &j| gradient[i].total_cmp(&gradient[j])) else { break };
        positive.push(next);
        while let Ok(solved) = matrix.select_columns(&positive).svd(true, true).solve(&target, PIVOT_FLOOR) {
            // Largest fraction of the step at which no value becomes negative.
            let zero_crossings = positive
                .iter()
                .zip(&solved)
                .filter(|(_, solution_value)| **solution_value <= 0.0)
                .map(|(&j, solution_value)| x[j] / (x[j] - solution_value));
            let step_fraction = zero_crossings.fold(1.0, f64::min);
            positive
                .iter()
                .zip(&solved)
                .for_each(|(&j, solution_value)| x[j] += step_fraction * (solution_value - x[j]));
            if step_fraction == 1.0 {
                break;
            }
            positive.retain(|&j| x[j] > f64::EPSILON * x.amax());
            (0..n).filter(|j| !positive.contains(j)).for_each(|j| x[j] = 0.0);
        }
        if x[next] == 0.0 {
            break;
        }
    }
    x.iter().copied().collect()
}

/// Return the solution x of R x = `rhs` for an upper-triangular row-major matrix R with row stride `stride`.
#[must_use]
pub fn back_substitute(r: &[f64], stride: usize, rhs: &[f64]) -> Vec<f64> {
    let k = rhs.len();
    let mut x = rhs.to_vec();
    for i in (0..k).rev() {
        for j in i + 1..k {
            x[i] -= r[i * stride + j] * x[j];
        }
        x[i] /= r[i * stride + i];
    }
    x
}

/// Replace a packed lower triangle of a k × k matrix by its Cholesky factor. The pivot of a row with diagonal element 0
/// is set to 1. `None` if the matrix is not positive definite.
fn cholesky(packed: &mut [f64], k: usize) -> Option<()> {
    for i in 0..k {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|l| packed[packed_index(i, l)] * packed[packed_index(j, l)]).sum();
            let remainder = packed[packed_index(i, j)] - sum;
            packed[packed_index(i, j)] = if i > j {
                remainder / packed[packed_index(j, j)]
            } else if packed[packed_index(i, i)] == 0.0 {
                1.0
            } else if remainder > 0.0 && remainder < f64::INFINITY {
                remainder.sqrt()
            } else {
                return None;
            };
        }
    }
    Some(())
}

/// Sums Σ q qᵀ and Σ q m over a sliding window of the newest rows, with regressor values q and output m of a row. An
/// update takes amortized O(k²) operations per row of k values, for any length of the window.
///
/// The rows form blocks of the length of the window. A window consists of the end of one block and the beginning of the
/// next. Its sum is therefore a suffix sum plus a prefix sum (van Herk, doi:10.1016/0167-8655(92)90069-C). No sums are
/// subtracted, so there is no cancellation.
#[derive(Debug, Clone)]
pub struct SlidingGram {
    /// Number of values in a row.
    width: usize,
    /// Number of rows of the window.
    length: usize,
    /// Products of each row of the current block: packed lower triangle of q qᵀ, then q m.
    block: Vec<f64>,
    /// Suffix sums of the products over the previous block: from each of its rows to its end.
    suffixes: Vec<f64>,
    /// Sum of the products over the current block.
    prefix: Vec<f64>,
    /// Sum of the products over the rows of the previous block that are still in the window.
    suffix: Vec<f64>,
}

impl SlidingGram {
    /// Return an empty window of at most `length` rows with `width` values each.
    #[must_use]
    pub fn new(width: usize, length: usize) -> Self {
        let zeros = vec![0.0; packed_index(width, 0) + width];
        Self { width, length, block: Vec::new(), suffixes: Vec::new(), prefix: zeros.clone(), suffix: zeros }
    }

    /// Remove all rows from the window.
    pub fn clear(&mut self) {
        self.block.clear();
        self.suffixes.clear();
        self.prefix.fill(0.0);
        self.suffix.fill(0.0);
    }

    /// Add a row and its output. If the window is full, the oldest row is removed.
    ///
    /// # Errors
    /// [`Error::Length`] for a row of wrong length.
    pub fn push(&mut self, row: &[f64], output: f64) -> Result<()> {
        check_length("row", self.width, row.len())?;
        let size = self.prefix.len();
        if self.block.len() == self.length.saturating_mul(size) {
            for index in (0..self.block.len() - size).rev() {
                self.block[index] += self.block[index + size];
            }
            std::mem::swap(&mut self.block, &mut self.suffixes);
            self.block.clear();
            self.prefix.fill(0.0);
        }
        let start = self.block.len();
        for (i, q) in row.iter().enumerate() {
            self.block.extend(row[..=i].iter().map(|other| q * other));
        }
        self.block.extend(row.iter().map(|q| q * output));
        self.prefix.iter_mut().zip(&self.block[start..]).for_each(|(sum, product)| *sum += product);
        let end = self.block.len();
        match self.suffixes.get(end..end + size) {
            Some(suffix) => self.suffix.copy_from_slice(suffix),
            None => self.suffix.fill(0.0),
        }
        Ok(())
    }

    /// Return element `index` of the sums over the window: packed lower triangle of Σ q qᵀ, then Σ q m.
    #[inline]
    fn sum(&self, index: usize) -> f64 {
        self.suffix[index] + self.prefix[index]
    }
}

/// State of the recursion of eq. (44) of the paper: coefficients and inverse covariance (information matrix).
#[derive(Debug, Clone)]
pub struct Recursion {
    coefficients: Vec<f64>,
    /// Inverse covariance, packed as the rows of its lower triangle.
    information: Vec<f64>,
    /// Contribution of new prior precisions to the right-hand side of the next step.
    gain: Vec<f64>,
    /// Cholesky factor of the inverse covariance, packed in the same way.
    factor: Vec<f64>,
}

impl Recursion {
    /// Return the state with coefficients 0. `precision` contains the inverse prior covariance of each coefficient, 0
    /// without a prior.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a precision that is negative or not finite.
    pub fn new(precision: &[f64]) -> Result<Self> {
        if let Some(&value) = precision.iter().find(|&&p| !(p >= 0.0 && p.is_finite())) {
            return Err(Error::OutOfRange {
                name: "inverse prior covariance".into(),
                value,
                range: "[0, ∞)".into(),
                remedy: "use a small number for a weak prior".into(),
            });
        }
        let k = precision.len();
        let mut information = vec![0.0; packed_index(k, 0)];
        precision.iter().enumerate().for_each(|(j, p)| information[packed_index(j, j)] = *p);
        Ok(Self { coefficients: vec![0.0; k], factor: information.clone(), information, gain: vec![0.0; k] })
    }

    /// Multiply the inverse covariance from all earlier rows by a forgetting factor in (0, 1].
    pub fn forget(&mut self, factor: f64) {
        self.information.iter_mut().for_each(|v| *v *= factor);
    }

    /// Add an inverse prior covariance for each coefficient, with prior mean 0. The next step uses them.
    pub fn add_prior(&mut self, precision: impl Iterator<Item = f64>) {
        for (j, increment) in precision.take(self.coefficients.len()).enumerate() {
            self.information[packed_index(j, j)] += increment;
            self.gain[j] -= increment * self.coefficients[j];
        }
    }

    /// Update the state by one step of eq. (44) of the paper with the rows of a window.
    ///
    /// A coefficient with zero information is unchanged.
    ///
    /// # Errors
    /// [`Error::Diverged`] if the inverse covariance is not positive definite. [`Error::Length`] for rows of wrong
    /// length.
    pub fn step(&mut self, window: &SlidingGram) -> Result<()> {
        let k = self.coefficients.len();
        check_length("row", k, window.width)?;
        let mut row_start = 0;
        for i in 0..k {
            for j in 0..i {
                let sum = window.sum(row_start + j);
                self.information[row_start + j] += sum;
                self.gain[i] -= sum * self.coefficients[j];
                self.gain[j] -= sum * self.coefficients[i];
            }
            let sum = window.sum(row_start + i);
            self.information[row_start + i] += sum;
            self.gain[i] -= sum * self.coefficients[i];
            row_start += i + 1;
        }
        for (i, gain) in self.gain.iter_mut().enumerate() {
            *gain += window.sum(row_start + i);
        }
        self.factor.copy_from_slice(&self.information);
        cholesky(&mut self.factor, k)
            .ok_or_else(|| Error::Diverged { what: "covariance of the recursion".into(), index: 0 })?;
        // Solve L Lᵀ x = gain with the Cholesky factor L. The solution replaces the gain.
        let (factor, x) = (&self.factor, &mut self.gain);
        for i in 0..k {
            let partial_sum: f64 = (0..i).map(|j| factor[packed_index(i, j)] * x[j]).sum();
            x[i] = (x[i] - partial_sum) / factor[packed_index(i, i)];
        }
        for i in (0..k).rev() {
            let partial_sum: f64 = (i + 1..k).map(|j| factor[packed_index(j, i)] * x[j]).sum();
            x[i] = (x[i] - partial_sum) / factor[packed_index(i, i)];
        }
        self.coefficients.iter_mut().zip(&mut self.gain).for_each(|(c, x)| *c += std::mem::take(x));
        Ok(())
    }

    /// Return the coefficient estimates after the most recent step.
    #[must_use]
    pub fn coefficients(&self) -> &[f64] {
        &self.coefficients
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Update by one step of eq. (44) of the paper with a dense solution. Rows of the window are added one after
    /// another.
    fn naive_step(information: &mut DMatrix<f64>, x: &mut DVector<f64>, rows: &[(Vec<f64>, f64)]) {
        let mut gain = DVector::zeros(x.len());
        for (row, output) in rows {
            let row = DVector::from_column_slice(row);
            gain += &row * (output - row.dot(x));
            *information += &row * row.transpose();
        }
        *x += information.clone().lu().solve(&gain).unwrap_or_else(|| gain.clone() * f64::NAN);
    }

    #[test]
    fn window_sums_match_naive_steps() -> Result<()> {
        let noise = |i: usize, j: usize| libm::sin((i * i + 7 * i * j + 3) as f64 * 0.7310 + j as f64);
        for (k, length, forgetting) in
            [(1, 1, 1.0), (3, 1, 0.95), (3, 2, 1.0), (4, 7, 0.9), (2, 20, 1.0), (5, 200, 0.99)]
        {
            let mut state = Recursion::new(&vec![0.5; k])?;
            let mut window = SlidingGram::new(k, length);
            let (mut information, mut x) = (DMatrix::identity(k, k) * 0.5, DVector::zeros(k));
            // The second part begins with an empty window.
            for _ in 0..2 {
                let mut rows: Vec<(Vec<f64>, f64)> = Vec::new();
                window.clear();
                for i in 0..100 {
                    // A relation that changes, so that the oldest rows of a window differ from its newest.
                    let row: Vec<f64> = (0..k).map(|j| noise(i, j)).collect();
                    let output = row.iter().sum::<f64>() * (1.0 + 0.1 * i as f64) + noise(i, k);
                    rows.push((row.clone(), output));
                    state.forget(forgetting);
                    information *= forgetting;
                    window.push(&row, output)?;
                    state.step(&window)?;
                    naive_step(&mut information, &mut x, &rows[rows.len().saturating_sub(length)..]);
                    let worst = x.iter().zip(state.coefficients()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                    assert!(worst <= 1e-12 * x.amax(), "k = {k}, p = {length}, row {i}: {worst:e}");
                }
            }
        }
        assert!(SlidingGram::new(2, 3).push(&[1.0], 0.0).is_err());
        Ok(())
    }
}
