//! Small dense systems: inverses, LU, batched LDLᵀ solves, recursive least squares. The only user of `nalgebra`.

use nalgebra::{DMatrix, DVector, Dyn, FullPivLU, Schur};

use crate::error::{check_length, Error, Result};
use crate::simd::Lanes;

/// Pivot of a correlation matrix below which a regressor is linearly dependent within rounding. The Gram matrix of m =
/// 2048 products has errors of about 1e−13.
pub const PIVOT_FLOOR: f64 = 1e-13;

/// Inverse of a row-major n × n matrix, row-major.
///
/// # Errors
/// [`Error::LeadingZero`] with the determinant of a singular matrix, [`Error::Length`].
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

/// Most steps of an iteration for eigenvalues, of which a polynomial of degree ten needs about thirty.
const MAX_EIGENVALUE_STEPS: usize = 1000;

/// Magnitude of the largest zero of a polynomial with these coefficients, the constant first.
///
/// None without a zero, or for coefficients of which the leading one is 0 or too small beside the others.
///
/// ```
/// // (z + 3)(z − 2)
/// assert!((ftlm::linalg::small::spectral_radius(&[-6.0, 1.0, 1.0]).unwrap_or(0.0) - 3.0).abs() < 1e-14);
/// ```
#[must_use]
pub fn spectral_radius(coefficients: &[f64]) -> Option<f64> {
    let found = polynomial_roots(coefficients)?;
    Some(found.iter().map(|(re, im)| re.hypot(*im)).fold(0.0, f64::max)).filter(|_| !found.is_empty())
}

/// Real and imaginary part of the zeros of a polynomial with these coefficients, the constant first.
///
/// None for coefficients of which the leading one is 0 or too small beside the others.
///
/// ```
/// // (s + 1)² + 4
/// let found = ftlm::linalg::small::polynomial_roots(&[5.0, 2.0, 1.0]).unwrap_or_default();
/// assert!(found.iter().all(|(re, im)| (re + 1.0).abs() < 1e-14 && (im.abs() - 2.0).abs() < 1e-14));
/// ```
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn polynomial_roots(coefficients: &[f64]) -> Option<Vec<(f64, f64)>> {
    let (leading, others) = coefficients.split_last()?;
    let ratios: Vec<f64> = others.iter().rev().map(|c| -c / leading).collect();
    if ratios.iter().any(|v| !v.is_finite()) {
        return None;
    }
    // In this unit no coefficient is above 1.
    let unit = ratios.iter().zip(1..).map(|(v, k)| v.abs().powf(1.0 / k as f64)).fold(0.0, f64::max);
    if unit == 0.0 {
        return Some(vec![(0.0, 0.0); ratios.len()]);
    }
    let scaled = |(k, v): (usize, &f64)| (0..=k).fold(*v, |v, _| v / unit);
    let top: Vec<f64> = ratios.iter().enumerate().map(scaled).collect();
    let n = top.len();
    let companion = DMatrix::from_fn(n, n, |i, j| if i == 0 { top[j] } else { f64::from(u8::from(i == j + 1)) });
    let found = Schur::try_new(companion, f64::EPSILON, MAX_EIGENVALUE_STEPS)?.complex_eigenvalues();
    Some(found.iter().map(|z| (unit * z.re, unit * z.im)).collect())
}

/// LU factorization of an equilibrated square matrix, whose rows and columns may differ in scale by any factor.
pub struct EquilibratedLu {
    /// Largest element of each row, then of each column.
    rows: Vec<f64>,
    columns: Vec<f64>,
    /// None for a matrix without rows.
    factor: Option<FullPivLU<f64, Dyn, Dyn>>,
}

impl EquilibratedLu {
    /// Factorization of a row-major k × k matrix.
    ///
    /// # Errors
    /// [`Error::Singular`] for a matrix that is singular within rounding, [`Error::Length`].
    ///
    /// ```
    /// let solved = ftlm::linalg::small::EquilibratedLu::new(&[2.0, 0.0, 0.0, 0.25], 2)?.solve(&[1.0, 1.0]);
    /// assert_eq!(solved, [0.5, 4.0]);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn new(matrix: &[f64], k: usize) -> Result<Self> {
        check_length("matrix", k * k, matrix.len())?;
        // Scale rows, then columns, to unit largest element. Near singularity then does not depend on units.
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
        if let Some(bad) = rows.iter().chain(&columns).position(|s| !(*s > 0.0 && s.is_finite())) {
            return Err(singular(bad % k.max(1)));
        }
        let factor = (k > 0).then(|| a.full_piv_lu());
        let pivots = factor.iter().flat_map(|f| f.u().diagonal().iter().copied().collect::<Vec<f64>>());
        if let Some(bad) = pivots.into_iter().position(|p| p.is_nan() || p.abs() <= PIVOT_FLOOR) {
            return Err(singular(bad));
        }
        Ok(Self { rows, columns, factor })
    }

    /// Solution for this right-hand side, one value a row.
    #[must_use]
    pub fn solve(&self, rhs: &[f64]) -> Vec<f64> {
        let mut x = DVector::from_iterator(rhs.len(), rhs.iter().zip(&self.rows).map(|(v, scale)| v / scale));
        if let Some(factor) = &self.factor {
            factor.solve_mut(&mut x);
        }
        x.iter().zip(&self.columns).map(|(v, scale)| v / scale).collect()
    }

    /// Inverse, row-major.
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

/// Inverse of a row-major k × k matrix whose rows and columns may differ in scale by any factor.
///
/// # Errors
/// [`Error::Singular`] for a matrix that is singular within rounding, [`Error::Length`].
///
/// ```
/// assert_eq!(ftlm::linalg::small::scaled_inverse(&[2.0, 0.0, 0.0, 0.25], 2), Ok(vec![0.5, 0.0, 0.0, 4.0]));
/// // The inverse of an empty matrix is empty.
/// assert_eq!(ftlm::linalg::small::scaled_inverse(&[], 0), Ok(vec![]));
/// ```
pub fn scaled_inverse(matrix: &[f64], k: usize) -> Result<Vec<f64>> {
    Ok(EquilibratedLu::new(matrix, k)?.inverse())
}

/// Index of element (i, j), j ≤ i, of a symmetric matrix stored by its lower rows.
#[inline(always)]
#[must_use]
pub const fn packed_index(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

/// Solve L symmetric positive definite systems of k unknowns side by side, in place, by L D Lᵀ.
///
/// `gram` has the lower rows ([`packed_index`]) of correlation matrices. Their diagonals are 1, or 0 for an absent
/// column. `rhs` is overwritten with the solutions. The first `needed` unknowns must be independent; the returned flags
/// mark the lanes in which they are not. Later dependent unknowns are set to 0. O(k³). The operations of a lane depend
/// neither on other lanes nor on L.
#[inline(always)]
pub fn solve_lanes<const L: usize>(gram: &mut [Lanes<L>], rhs: &mut [Lanes<L>], needed: usize) -> [bool; L] {
    // Common sizes get loops of constant length.
    match rhs.len() {
        1 => solve_sized(1, gram, rhs, needed),
        2 => solve_sized(2, gram, rhs, needed),
        3 => solve_sized(3, gram, rhs, needed),
        4 => solve_sized(4, gram, rhs, needed),
        5 => solve_sized(5, gram, rhs, needed),
        k => solve_sized(k, gram, rhs, needed),
    }
}

#[inline(always)]
fn solve_sized<const L: usize>(k: usize, gram: &mut [Lanes<L>], rhs: &mut [Lanes<L>], needed: usize) -> [bool; L] {
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
        let mut all = true;
        for n in 0..L {
            let fits = pivot[n] > PIVOT_FLOOR;
            inverse[n] = if fits { 1.0 / pivot[n] } else { 0.0 };
            all &= fits;
            singular[n] |= !fits && i < needed;
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
        if !all {
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

/// Solution of a small symmetric row-major system. None if it is not positive definite. O(k³).
#[must_use]
pub fn positive_solve(matrix: &[f64], rhs: &[f64]) -> Option<Vec<f64>> {
    let k = rhs.len();
    let solved = DMatrix::from_row_slice(k, k, matrix).cholesky()?.solve(&DVector::from_column_slice(rhs));
    Some(solved.iter().copied().collect())
}

/// Nonnegative least squares: minimize ‖Σ xⱼ columnⱼ − target‖ for x ≥ 0, by active sets.
///
/// Lawson & Hanson, doi:10.1137/1.9781611971217, §23.3. A dependent column gets 0.
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
        let rises = (0..n).filter(|j| !positive.contains(j) && gradient[*j] > rounding(*j));
        let Some(next) = rises.max_by(|&i, &j| gradient[i].total_cmp(&gradient[j])) else { break };
        positive.push(next);
        while let Ok(solved) = matrix.select_columns(&positive).svd(true, true).solve(&target, PIVOT_FLOOR) {
            // The last share of the way on which no value becomes negative.
            let ends = positive.iter().zip(&solved).filter(|(_, to)| **to <= 0.0).map(|(&j, to)| x[j] / (x[j] - to));
            let share = ends.fold(1.0, f64::min);
            positive.iter().zip(&solved).for_each(|(&j, to)| x[j] += share * (to - x[j]));
            if share == 1.0 {
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

/// Solve `R x = c` for upper-triangular row-major R, k × k with row stride `stride`.
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

/// State of recursion (44): coefficients and inverse covariance.
#[derive(Debug, Clone)]
pub struct Recursion {
    coefficients: DVector<f64>,
    information: DMatrix<f64>,
}

impl Recursion {
    /// Recursion from coefficients `start` with covariance `prior`·I.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a prior that is not positive and finite.
    pub fn new(start: &[f64], prior: f64) -> Result<Self> {
        Self::with_prior(start, &vec![prior; start.len()])
    }

    /// Recursion from coefficients `start` with a prior covariance of each.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a prior that is not positive and finite, [`Error::Length`].
    pub fn with_prior(start: &[f64], prior: &[f64]) -> Result<Self> {
        check_length("prior covariances", start.len(), prior.len())?;
        if let Some(&value) = prior.iter().find(|&&p| !(p > 0.0 && p.is_finite())) {
            return Err(Error::OutOfRange {
                name: "prior covariance K0".into(),
                value,
                range: "(0, ∞)".into(),
                remedy: "use a large number for a weak prior".into(),
            });
        }
        let precision: Vec<f64> = prior.iter().map(|p| 1.0 / p).collect();
        Ok(Self {
            coefficients: DVector::from_column_slice(start),
            information: DMatrix::from_diagonal(&DVector::from_column_slice(&precision)),
        })
    }

    /// One update of (44) with the innovation of these rows, in any order.
    ///
    /// # Errors
    /// [`Error::Diverged`] where the covariance is no longer positive, [`Error::Length`] for a row of another length.
    pub fn step<'a>(&mut self, rows: impl Iterator<Item = (&'a [f64], f64)> + Clone) -> Result<()> {
        let k = self.coefficients.len();
        let mut gain = DVector::zeros(k);
        for (row, output) in rows.clone() {
            check_length("row", k, row.len())?;
            let q = DVector::from_column_slice(row);
            gain += &q * (output - q.dot(&self.coefficients));
            self.information.ger(1.0, &q, &q, 1.0);
        }
        let factor = self
            .information
            .clone()
            .cholesky()
            .ok_or_else(|| Error::Diverged { what: "covariance of the recursion".into(), index: 0 })?;
        self.coefficients += factor.solve(&gain);
        Ok(())
    }

    /// Coefficients after the last step.
    #[must_use]
    pub fn coefficients(&self) -> &[f64] {
        self.coefficients.as_slice()
    }
}
