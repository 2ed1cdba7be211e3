//! The test vectors on one record: what each says of a candidate's error there.

use crate::linalg::dense;
use crate::order_search::dual_bound::test_vectors::{effects, vectors, Wide};
use crate::order_search::options::Norm;
use crate::parallel;
use crate::regressors::Bank;
use crate::simd::WIDTH;
use crate::stop::Stop;

/// A column without an effect on the divisor.
pub(crate) const NONE: usize = usize::MAX;

/// The test vectors on one record: what they make of each column.
pub(crate) struct Probes {
    /// Number of [`Wide`] groups of test vectors.
    pub(crate) groups: usize,
    /// ⟨t, x⟩ of column p and group g at p·groups + g, real and imaginary part.
    pub(crate) products: Vec<[Wide; 2]>,
    /// ⟨t, y⟩.
    pub(crate) target: Vec<[Wide; 2]>,
    /// Row of `effects` of a column, [`NONE`] where it is not of the output itself.
    pub(crate) rows: Vec<usize>,
    /// g·‖t‖ (real, imaginary), ‖Fᵀt − g t‖, and the way that Fᵀt − g t has come since the first row: no two rows are
    /// farther apart than the way between them.
    pub(crate) effects: Vec<[Wide; 4]>,
    /// ‖t‖ in the dual norm.
    pub(crate) size: Vec<Wide>,
    /// What rounding may add to |⟨t, w⟩| per unit of a column's coefficient, and for the target.
    pub(crate) rounding: Vec<f64>,
    pub(crate) target_rounding: f64,
    /// What rounding may add to a sum of m terms, per unit.
    pub(crate) unit: f64,
}

/// Most own columns that are looked at together.
const TOGETHER: usize = 4;

impl Probes {
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(
        bank: &Bank,
        target: &[f64],
        norm: Norm,
        (output_error, count): (bool, usize),
        stop: &Stop,
    ) -> Self {
        let m = target.len();
        let groups = count / WIDTH;
        let vectors = vectors(count, m, stop);
        let dual = |parts: &[&[f64]; 2]| -> f64 {
            let squares = parts[0].iter().zip(parts[1]).map(|(a, b)| a * a + b * b);
            match norm {
                Norm::L1 => squares.fold(0.0, f64::max).sqrt(),
                Norm::L2 => squares.sum::<f64>().sqrt(),
            }
        };
        let sizes: Vec<f64> = parallel::map(vectors.iter().collect(), || (), |(), [a, b]| dual(&[a, b]));

        let mut columns: Vec<&[f64]> = (0..bank.len()).map(|p| bank.column(p)).collect();
        columns.push(target);
        let flat: Vec<&[f64]> = vectors.iter().flatten().map(Vec::as_slice).collect();
        let (inner, halves) = (dense::inner_products(&columns, &flat, stop), flat.len());
        let gathered = |p: usize| -> Vec<[Wide; 2]> {
            (0..groups)
                .map(|g| {
                    let part = |half: usize| std::array::from_fn(|n| inner[p * halves + 2 * (g * WIDTH + n) + half]);
                    [part(0), part(1)]
                })
                .collect()
        };
        let products: Vec<[Wide; 2]> = (0..bank.len()).flat_map(gathered).collect();

        // A generous multiple of what m additions may lose; it covers columns, inner products and the march as well.
        let unit = 16.0 * f64::EPSILON * m as f64;
        let sum = |x: &[f64]| x.iter().map(|v| v.abs()).sum::<f64>();
        let size_of_target = sum(target);
        let own: Vec<usize> = (0..bank.len()).filter(|&p| output_error && !bank.kernel(p).is_empty()).collect();
        let mut rows = vec![NONE; bank.len()];
        own.iter().enumerate().for_each(|(row, &p)| rows[p] = row);
        let rounding = parallel::map(
            (0..bank.len()).collect(),
            || (),
            |(), p| unit * (sum(bank.column(p)) + sum(bank.kernel(p)) * size_of_target),
        );
        let effects = effects(bank, &own, vectors, &sizes, (norm, unit), stop);
        let size = (0..groups).map(|g| std::array::from_fn(|n| sizes[g * WIDTH + n])).collect();
        Self {
            groups,
            products,
            target: gathered(bank.len()),
            rows,
            effects,
            size,
            rounding,
            target_rounding: 2.0 * unit * size_of_target,
            unit,
        }
    }

    pub(super) fn chosen(&self, which: &[usize]) -> Self {
        let groups = which.len() / WIDTH;
        let pick = |source: &[Wide], g: usize| -> Wide {
            std::array::from_fn(|n| source[which[g * WIDTH + n] / WIDTH][which[g * WIDTH + n] % WIDTH])
        };
        let part =
            |rows: &[[Wide; 2]], half: usize, g: usize| pick(&rows.iter().map(|r| r[half]).collect::<Vec<_>>(), g);
        let pairs = |rows: &[[Wide; 2]]| (0..groups).map(|g| [part(rows, 0, g), part(rows, 1, g)]).collect::<Vec<_>>();
        let fours = |rows: &[[Wide; 4]]| {
            let part = |h: usize, g: usize| pick(&rows.iter().map(|r| r[h]).collect::<Vec<_>>(), g);
            (0..groups).map(|g| std::array::from_fn(|h| part(h, g))).collect::<Vec<[Wide; 4]>>()
        };
        Self {
            groups,
            products: self.products.chunks(self.groups).flat_map(pairs).collect(),
            target: pairs(&self.target),
            rows: self.rows.clone(),
            effects: self.effects.chunks(self.groups).flat_map(fours).collect(),
            size: (0..groups).map(|g| pick(&self.size, g)).collect(),
            rounding: self.rounding.clone(),
            target_rounding: self.target_rounding,
            unit: self.unit,
        }
    }

    #[inline(always)]
    pub(super) fn allowance(&self, terms: &[usize], coefficients: &[f64], initial: &[usize], weights: &[f64]) -> f64 {
        let pairs = terms.iter().zip(coefficients).chain(initial.iter().zip(weights));
        pairs.fold(self.target_rounding, |sum, (&p, c)| sum + c.abs() * self.rounding[p])
    }

    /// Bounds and guesses of one group of test vectors.
    #[inline(always)]
    pub(super) fn group(
        &self,
        group: usize,
        terms: &[usize],
        coefficients: &[f64],
        initial: &[usize],
        weights: &[f64],
        rounding: f64,
    ) -> (Wide, Wide) {
        let [mut re, mut im] = self.target[group];
        let mut divisor = self.size[group];
        let (mut divisor_im, mut slack) = ([0.0; WIDTH], [0.0; WIDTH]);
        let (mut own, mut count) = ([(0, 0.0); TOGETHER], 0);
        for (&p, &c) in terms.iter().zip(coefficients) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..WIDTH {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
            }
            let row = self.rows[p];
            if row != NONE {
                let [a, b, rest, _] = &self.effects[row * self.groups + group];
                for n in 0..WIDTH {
                    divisor[n] -= c * a[n];
                    divisor_im[n] -= c * b[n];
                    slack[n] += c.abs() * rest[n];
                }
                if count < TOGETHER {
                    own[count] = (row, c);
                }
                count += 1;
            }
        }
        for (&p, &c) in initial.iter().zip(weights) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..WIDTH {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
            }
        }
        if (2..=TOGETHER).contains(&count) {
            let together = self.together(group, &mut own[..count]);
            for n in 0..WIDTH {
                slack[n] = if together[n] < slack[n] { together[n] } else { slack[n] };
            }
        }
        let (mut bounds, mut guesses) = ([0.0; WIDTH], [0.0; WIDTH]);
        for n in 0..WIDTH {
            let seen = (re[n] * re[n] + im[n] * im[n]).sqrt() - rounding;
            let size = (divisor[n] * divisor[n] + divisor_im[n] * divisor_im[n]).sqrt();
            // A hair more, for the rounding of the divisor and of the score itself.
            bounds[n] = seen / ((size + slack[n]) * (1.0 + self.unit));
            guesses[n] = seen / size;
        }
        (bounds, guesses)
    }

    /// At most ‖Σ c (Fᵀt − g t)‖ of own columns by row, whose coefficients may cancel: all of them times what the first
    /// row has, and all but the first so many times the way to the next.
    #[inline(always)]
    fn together(&self, group: usize, own: &mut [(usize, f64)]) -> Wide {
        for i in 1..own.len() {
            let mut at = i;
            while at > 0 && own[at - 1].0 > own[at].0 {
                own.swap(at - 1, at);
                at -= 1;
            }
        }
        let (mut left, mut all) = (0.0, 0.0);
        for (_, c) in own.iter() {
            left += c;
            all += c.abs();
        }
        let [.., first, mut before] = self.effects[own[0].0 * self.groups + group];
        let [.., last] = &self.effects[own[own.len() - 1].0 * self.groups + group];
        let mut most = [0.0; WIDTH];
        for n in 0..WIDTH {
            // What is left of sums loses as much as they are.
            most[n] = left.abs() * first[n] + 16.0 * f64::EPSILON * all * (first[n] + last[n]);
        }
        for at in 1..own.len() {
            left -= own[at - 1].1;
            let [.., way] = self.effects[own[at].0 * self.groups + group];
            for n in 0..WIDTH {
                most[n] += left.abs() * (way[n] - before[n]);
            }
            before = way;
        }
        most
    }
}
