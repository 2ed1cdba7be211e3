//! A lower bound of a candidate's output error from a few inner products, without running the candidate.
//!
//! With D = 1 − Σ c_i F_i over the own-output terms and w = y − Σ c x the equation error, the output error obeys
//! D e = w. For any test vector t, ⟨t, w⟩ = ⟨t, D e⟩ = ⟨Dᵀt, e⟩, so by Hölder's inequality
//!
//!   ‖e‖ ≥ |⟨t, w⟩| / ‖Dᵀt‖ in the dual norm, and ‖Dᵀt‖ ≤ |1 − Σ c_i g_i|·‖t‖ + Σ |c_i|·‖F_iᵀt − g_i t‖
//!
//! for any numbers g_i. Where coefficients are yet to be refined, `Bound::excludes` proves the same of all coefficients
//! at once: with d = 1 − Σ c g and S = Σ |c_i| ρ_i, a score of at most L needs |⟨t, w⟩|² ≤ L²(|d|‖t‖ + S)² for every t, and
//!
//!   (a + S)² ≤ (1+κ)a² + (1+1/κ)S², S² ≤ Σ c_i²ρ_i²/p_i for any κ, p_i > 0 with Σ p_i = 1,
//!
//! so each condition implies that a quadratic form in (c, 1) is not positive; where a weighted sum of these forms is
//! positive definite, no coefficients meet them all.
//!
//! Test vectors are complex exponentials under windows that end gently: there F_iᵀt is nearly a
//! multiple of t. All inner products and norms are made once; a candidate costs about thirty operations a vector.

use rayon::prelude::*;

use crate::dense;
use crate::equation::{Equation, Structure};
use crate::error::{check_length, Result};
use crate::lanes::WIDTH;
use crate::regressors::{Bank, Index, Key, Record};
use crate::search::run::Norm;
use crate::series::{Buffers, Kernel, SumOfProducts};
use crate::small::packed;

/// One value for each of [`WIDTH`] test vectors.
type Wide = [f64; WIDTH];

/// A column without an effect on the divisor.
const NONE: usize = usize::MAX;

/// Lowest frequency of a test vector, in cycles a record.
const LOWEST: f64 = 0.3;

/// Spectra of test vectors held at a time, in bytes.
const SPECTRA: usize = 64 << 20;

/// How a test vector fades; it must not stop dead, which its integrals would all feel.
#[derive(Debug, Clone, Copy)]
enum Window {
    /// One up to this share of the record, then half a cosine down to zero.
    Taper(f64),
    /// Down to e to the minus this.
    Decay(f64),
}

impl Window {
    fn at(self, x: f64) -> f64 {
        match self {
            Self::Taper(flat) if x <= flat => 1.0,
            Self::Taper(flat) => 0.5 + 0.5 * libm::cos(std::f64::consts::PI * (x - flat) / (1.0 - flat)),
            Self::Decay(rate) => libm::exp(-rate * x),
        }
    }
}

/// Windows and how many frequencies each gets; measured on Plant A's lattice at three levels of noise, where the late
/// taper removes most and the decays see the candidates whose error is early.
const WINDOWS: [(Window, usize); 3] = [(Window::Taper(0.5), 24), (Window::Taper(0.0), 12), (Window::Decay(5.0), 12)];

/// Number of test vectors to choose from.
pub(crate) const POOL: usize = 48;

/// What each test vector of the pool proves of an equation's output error at rest: lower bounds of Σ|y − ŷ| or
/// Σ(y − ŷ)².
///
/// # Errors
/// Orders or signals that make no equation, coefficients that are not one a term.
pub fn lower_bounds(record: &Record, equation: &Equation, norm: Norm) -> Result<Vec<f64>> {
    let (bound, positions) = pooled(record, &equation.structure, norm)?;
    check_length("coefficients", positions.len(), equation.coefficients.len())?;
    let mut each = vec![0.0; bound.len()];
    bound.each(|_| (&positions[..], &equation.coefficients[..], &[][..], &[][..]), &mut each);
    Ok(each)
}

/// Whether the pool of test vectors proves that no coefficients of this structure, but for the fixed ones, give an output
/// error at rest of at most `limit`: Σ|y − ŷ| or Σ(y − ŷ)². The proof is sought from `start`.
///
/// # Errors
/// Orders or signals that make no equation, coefficients that are not one a term.
pub fn out_of_reach(
    record: &Record,
    structure: &Structure,
    fixed: &[Option<f64>],
    start: &[f64],
    norm: Norm,
    limit: f64,
) -> Result<bool> {
    let (bound, positions) = pooled(record, structure, norm)?;
    check_length("fixed coefficients", structure.terms.len(), fixed.len())?;
    check_length("coefficients", structure.terms.len(), start.len())?;
    Ok(bound.excludes(limit, &positions, fixed, &[], start, &mut Reach::default()))
}

/// The whole pool on one record, and the columns of a structure's terms.
fn pooled(record: &Record, structure: &Structure, norm: Norm) -> Result<(Bound, Vec<usize>)> {
    structure.check(record.len(), |_| true)?;
    let mut index = Index::default();
    let positions: Vec<usize> = (0..structure.terms.len())
        .map(|k| index.insert(Key::integral(structure.terms[k].signal, structure.integration(k))))
        .collect();
    let bank = Bank::new(&index, record, structure.output)?;
    let target = record.signal(structure.output).to_vec();
    Ok((Bound::new(&[bank], &[target], norm, true, POOL), positions))
}

/// The test vectors of a search, on every record.
pub(crate) struct Bound {
    norm: Norm,
    probes: Vec<Probes>,
}

/// The test vectors on one record: what they make of each column.
struct Probes {
    /// Number of [`Wide`] groups of test vectors.
    groups: usize,
    /// ⟨t, x⟩ of column p and group g at p·groups + g, real and imaginary part.
    products: Vec<[Wide; 2]>,
    /// ⟨t, y⟩.
    target: Vec<[Wide; 2]>,
    /// Row of `effects` of a column, [`NONE`] where it is not of the output itself.
    rows: Vec<usize>,
    /// g·‖t‖ (real, imaginary) and ‖Fᵀt − g t‖.
    effects: Vec<[Wide; 3]>,
    /// ‖t‖ in the dual norm.
    size: Vec<Wide>,
    /// What rounding may add to |⟨t, w⟩| per unit of a column's coefficient, and for the target.
    rounding: Vec<f64>,
    target_rounding: f64,
    /// What rounding may add to a sum of m terms, per unit.
    unit: f64,
}

impl Bound {
    /// Makes `count` test vectors (a multiple of [`WIDTH`], at most [`POOL`]) for these records.
    ///
    /// `output_error` tells whether own-output columns act on the divisor; in the equation error D = 1. Runs on the
    /// current thread pool.
    pub(crate) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm, output_error: bool, count: usize) -> Self {
        let probes = banks.iter().zip(targets).map(|(b, y)| Probes::new(b, y, norm, output_error, count)).collect();
        Self { norm, probes }
    }

    /// Number of test vectors.
    pub(crate) fn len(&self) -> usize {
        self.probes.first().map_or(0, |p| p.groups * WIDTH)
    }

    /// Only these test vectors (a multiple of [`WIDTH`] of them), in this order.
    pub(crate) fn chosen(&self, which: &[usize]) -> Self {
        Self { norm: self.norm, probes: self.probes.iter().map(|p| p.chosen(which)).collect() }
    }

    /// Lower bound of the raw score (Σ|e| or Σe²) of a candidate, and a guess at it by which to order visits.
    ///
    /// `columns(r)` gives positions and coefficients on record r. Ends as soon as the bound exceeds the limit.
    #[inline(always)]
    pub(crate) fn evaluate<'a>(
        &self,
        limit: f64,
        columns: impl Fn(usize) -> (&'a [usize], &'a [f64], &'a [usize], &'a [f64]),
    ) -> (f64, f64) {
        let (mut bound, mut guess) = (0.0, 0.0);
        for (r, probes) in self.probes.iter().enumerate() {
            let (terms, coefficients, initial, weights) = columns(r);
            let rounding = probes.allowance(terms, coefficients, initial, weights);
            let (mut largest, mut farthest) = (0.0, 0.0);
            for group in 0..probes.groups {
                let (bounds, guesses) = probes.group(group, terms, coefficients, initial, weights, rounding);
                for n in 0..WIDTH {
                    // Neither NaN nor an overflow proves anything.
                    if bounds[n] > largest && bounds[n] < f64::MAX {
                        largest = bounds[n];
                    }
                    if guesses[n] > farthest {
                        farthest = guesses[n];
                    }
                }
                if bound + self.raw(largest) > limit {
                    break;
                }
            }
            bound += self.raw(largest);
            guess += self.raw(farthest);
        }
        (bound, guess)
    }

    /// Whether no coefficients whatever of these columns give a raw score of at most `limit`.
    ///
    /// `fixed` are known coefficients of terms; all others, and those of the initial terms, are free. `start` says where
    /// to begin: coefficients of the terms, then of the initial terms by record.
    #[inline(always)]
    pub(crate) fn excludes(
        &self,
        limit: f64,
        terms: &[usize],
        fixed: &[Option<f64>],
        initial: &[usize],
        start: &[f64],
        scratch: &mut Reach,
    ) -> bool {
        let largest = match self.norm {
            Norm::L1 => limit,
            Norm::L2 => limit.sqrt(),
        };
        scratch.lay_out(&self.probes, largest, terms, fixed, initial, start);
        scratch.search()
    }

    /// The bound of each test vector alone, summed over records.
    pub(crate) fn each<'a>(
        &self,
        columns: impl Fn(usize) -> (&'a [usize], &'a [f64], &'a [usize], &'a [f64]),
        out: &mut [f64],
    ) {
        out.fill(0.0);
        for (r, probes) in self.probes.iter().enumerate() {
            let (terms, coefficients, initial, weights) = columns(r);
            let rounding = probes.allowance(terms, coefficients, initial, weights);
            for (group, out) in out.chunks_exact_mut(WIDTH).enumerate().take(probes.groups) {
                let (bounds, _) = probes.group(group, terms, coefficients, initial, weights, rounding);
                for (sum, bound) in out.iter_mut().zip(bounds) {
                    if bound > 0.0 && bound < f64::MAX {
                        *sum += self.raw(bound);
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn raw(&self, norm: f64) -> f64 {
        match self.norm {
            Norm::L1 => norm,
            Norm::L2 => norm * norm,
        }
    }
}

impl Probes {
    #[allow(clippy::cast_precision_loss)]
    fn new(bank: &Bank, target: &[f64], norm: Norm, output_error: bool, count: usize) -> Self {
        let m = target.len();
        let groups = count / WIDTH;
        let vectors: Vec<[Vec<f64>; 2]> = pool(count, m);
        let dual = |parts: &[&[f64]; 2]| -> f64 {
            let squares = parts[0].iter().zip(parts[1]).map(|(a, b)| a * a + b * b);
            match norm {
                Norm::L1 => squares.fold(0.0, f64::max).sqrt(),
                Norm::L2 => squares.sum::<f64>().sqrt(),
            }
        };
        let sizes: Vec<f64> = vectors.iter().map(|[a, b]| dual(&[a, b])).collect();

        let mut columns: Vec<&[f64]> = (0..bank.len()).map(|p| bank.column(p)).collect();
        columns.push(target);
        let flat: Vec<&[f64]> = vectors.iter().flatten().map(Vec::as_slice).collect();
        let inner = dense::inner_products(&columns, &flat);
        let gathered = |p: usize| -> Vec<[Wide; 2]> {
            (0..groups)
                .map(|g| {
                    let part =
                        |half: usize| std::array::from_fn(|n| inner[p * flat.len() + 2 * (g * WIDTH + n) + half]);
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
        let rounding =
            (0..bank.len()).map(|p| unit * (sum(bank.column(p)) + sum(bank.kernel(p)) * size_of_target)).collect();
        let effects = effects(bank, &own, &vectors, &sizes, norm, unit);
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

    fn chosen(&self, which: &[usize]) -> Self {
        let groups = which.len() / WIDTH;
        let pick = |source: &[Wide], g: usize| -> Wide {
            std::array::from_fn(|n| source[which[g * WIDTH + n] / WIDTH][which[g * WIDTH + n] % WIDTH])
        };
        let part =
            |rows: &[[Wide; 2]], half: usize, g: usize| pick(&rows.iter().map(|r| r[half]).collect::<Vec<_>>(), g);
        let pairs = |rows: &[[Wide; 2]]| (0..groups).map(|g| [part(rows, 0, g), part(rows, 1, g)]).collect::<Vec<_>>();
        let triples = |rows: &[[Wide; 3]]| {
            let half = |h: usize, g: usize| pick(&rows.iter().map(|r| r[h]).collect::<Vec<_>>(), g);
            (0..groups).map(|g| [half(0, g), half(1, g), half(2, g)]).collect::<Vec<_>>()
        };
        Self {
            groups,
            products: self.products.chunks(self.groups).flat_map(pairs).collect(),
            target: pairs(&self.target),
            rows: self.rows.clone(),
            effects: self.effects.chunks(self.groups).flat_map(triples).collect(),
            size: (0..groups).map(|g| pick(&self.size, g)).collect(),
            rounding: self.rounding.clone(),
            target_rounding: self.target_rounding,
            unit: self.unit,
        }
    }

    #[inline(always)]
    fn allowance(&self, terms: &[usize], coefficients: &[f64], initial: &[usize], weights: &[f64]) -> f64 {
        let pairs = terms.iter().zip(coefficients).chain(initial.iter().zip(weights));
        pairs.fold(self.target_rounding, |sum, (&p, c)| sum + c.abs() * self.rounding[p])
    }

    /// Bounds and guesses of one group of test vectors.
    #[inline(always)]
    fn group(
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
        for (&p, &c) in terms.iter().zip(coefficients) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..WIDTH {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
            }
            let row = self.rows[p];
            if row != NONE {
                let [a, b, rest] = &self.effects[row * self.groups + group];
                for n in 0..WIDTH {
                    divisor[n] -= c * a[n];
                    divisor_im[n] -= c * b[n];
                    slack[n] += c.abs() * rest[n];
                }
            }
        }
        for (&p, &c) in initial.iter().zip(weights) {
            let [a, b] = &self.products[p * self.groups + group];
            for n in 0..WIDTH {
                re[n] -= c * a[n];
                im[n] -= c * b[n];
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
}

/// Steps in which weights of test vectors are sought that exclude a candidate; measured on Plant A's lattice, where three
/// do on average.
const SOUGHT: usize = 12;
/// Share of a diagonal element that rounding may have added to it and its row: a generous multiple of k² ε.
const DEFINITE: f64 = 1e-12;

/// What one unknown contributes to a group of conditions: to ⟨t, w⟩ over the limit and to d‖t‖ (real and imaginary
/// parts), and ρ.
#[derive(Debug, Clone, Copy)]
struct Effect {
    error: [Wide; 2],
    divisor: [Wide; 2],
    slack: Wide,
}

const NO_EFFECT: Effect = Effect { error: [[0.0; WIDTH]; 2], divisor: [[0.0; WIDTH]; 2], slack: [0.0; WIDTH] };

/// Memory of [`Bound::excludes`].
#[derive(Default)]
pub(crate) struct Reach {
    /// Unknowns, the constant 1 the last.
    unknowns: usize,
    /// Effect of unknown i on group g at g·unknowns + i.
    effects: Vec<Effect>,
    at: Vec<f64>,
    weights: Vec<Wide>,
    /// Lower rows of the weighted form, of its part from ⟨t, w⟩ alone, and sizes of its diagonal.
    form: Vec<f64>,
    errors: Vec<f64>,
    sizes: Vec<f64>,
    factor: Vec<f64>,
}

impl Reach {
    #[inline(always)]
    fn lay_out(
        &mut self,
        probes: &[Probes],
        limit: f64,
        terms: &[usize],
        fixed: &[Option<f64>],
        initial: &[usize],
        start: &[f64],
    ) {
        let free = fixed.iter().filter(|f| f.is_none()).count();
        let last = free + initial.len() * probes.len();
        self.unknowns = last + 1;
        self.effects.clear();
        for (r, probes) in probes.iter().enumerate() {
            // A hair more, for the rounding of the divisor and of the score itself.
            let scale = 1.0 / (limit * (1.0 + probes.unit));
            for group in 0..probes.groups {
                let first = self.effects.len();
                self.effects.resize(first + self.unknowns, NO_EFFECT);
                let effects = &mut self.effects[first..];
                let column = |p: usize, c: f64| -> Effect {
                    let [re, im] = &probes.products[p * probes.groups + group];
                    let mut effect = NO_EFFECT;
                    for n in 0..WIDTH {
                        effect.error[0][n] = -c * re[n] * scale;
                        effect.error[1][n] = -c * im[n] * scale;
                        effect.slack[n] = c.abs() * probes.rounding[p] * scale;
                    }
                    let row = probes.rows[p];
                    if row != NONE {
                        let [re, im, rest] = &probes.effects[row * probes.groups + group];
                        for n in 0..WIDTH {
                            effect.divisor[0][n] = -c * re[n];
                            effect.divisor[1][n] = -c * im[n];
                            effect.slack[n] += c.abs() * rest[n];
                        }
                    }
                    effect
                };
                let mut constant = NO_EFFECT;
                for n in 0..WIDTH {
                    constant.error[0][n] = probes.target[group][0][n] * scale;
                    constant.error[1][n] = probes.target[group][1][n] * scale;
                    constant.divisor[0][n] = probes.size[group][n];
                    constant.slack[n] = probes.target_rounding * scale;
                }
                let mut next = 0;
                for (&p, known) in terms.iter().zip(fixed) {
                    match *known {
                        Some(c) => {
                            let effect = column(p, c);
                            for half in 0..2 {
                                for n in 0..WIDTH {
                                    constant.error[half][n] += effect.error[half][n];
                                    constant.divisor[half][n] += effect.divisor[half][n];
                                }
                            }
                            for n in 0..WIDTH {
                                constant.slack[n] += effect.slack[n];
                            }
                        }
                        None => {
                            effects[next] = column(p, 1.0);
                            next += 1;
                        }
                    }
                }
                for (i, &p) in initial.iter().enumerate() {
                    effects[free + r * initial.len() + i] = column(p, 1.0);
                }
                effects[last] = constant;
            }
        }
        self.at.clear();
        self.at.extend(start.iter().zip(fixed).filter(|(_, f)| f.is_none()).map(|(x, _)| *x));
        self.at.extend(&start[fixed.len()..]);
        self.at.push(1.0);
    }

    /// Seeks weights whose form is positive definite: each step goes where the last form was least, and gives more
    /// weight to the conditions that fail there. Ends where none fails.
    #[inline(always)]
    fn search(&mut self) -> bool {
        let k = self.unknowns;
        let groups = self.effects.len() / k;
        self.weights.clear();
        for step in 0..SOUGHT {
            let smallest = 1e-6 * self.at.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
            if !smallest.is_finite() {
                return false;
            }
            let states: Vec<[Wide; 3]> = (0..groups).map(|g| self.state(g)).collect();
            let mut worst = 0.0_f64;
            for [ratios, _, _] in &states {
                for &q in ratios {
                    if q.is_nan() {
                        return false;
                    }
                    worst = worst.max(q);
                }
            }
            // Not even here do the conditions fail.
            if worst <= 1.0 || worst.is_infinite() {
                return false;
            }
            if step == 0 {
                self.weights.extend(states.iter().map(|[_, size, slack]| {
                    let mut weight = [0.0; WIDTH];
                    for n in 0..WIDTH {
                        let all = size[n] + slack[n];
                        weight[n] = 1.0 / (all * all);
                    }
                    weight
                }));
            }
            for (weight, [ratios, _, _]) in self.weights.iter_mut().zip(&states) {
                for n in 0..WIDTH {
                    weight[n] *= (ratios[n] / worst + 1e-3).sqrt();
                }
            }
            self.assemble(&states, smallest);
            if !self.form.iter().chain(&self.errors).all(|v| v.is_finite()) {
                return false;
            }
            let convex = factorise(&self.form, k, &mut self.factor);
            if convex == k {
                return true;
            }
            if convex < k - 1 && factorise(&self.errors, k, &mut self.factor) < k - 1 {
                return false;
            }
            // The least point of the form, its last coordinate 1.
            self.at[k - 1] = 1.0;
            for i in (0..k - 1).rev() {
                let mut value = -self.factor[packed(k - 1, i)];
                for j in i + 1..k - 1 {
                    value -= self.factor[packed(j, i)] * self.at[j];
                }
                self.at[i] = value;
            }
        }
        false
    }

    /// Of one group of conditions at the present point: how far beyond what is allowed, |d|‖t‖ and S.
    #[inline(always)]
    fn state(&self, group: usize) -> [Wide; 3] {
        let zero = [0.0; WIDTH];
        let (mut error, mut divisor, mut slack) = ([zero; 2], [zero; 2], zero);
        for (effect, &x) in self.effects[group * self.unknowns..(group + 1) * self.unknowns].iter().zip(&self.at) {
            for n in 0..WIDTH {
                error[0][n] += x * effect.error[0][n];
                error[1][n] += x * effect.error[1][n];
                divisor[0][n] += x * effect.divisor[0][n];
                divisor[1][n] += x * effect.divisor[1][n];
                slack[n] += x.abs() * effect.slack[n];
            }
        }
        let (mut ratios, mut size) = (zero, zero);
        for n in 0..WIDTH {
            size[n] = (divisor[0][n] * divisor[0][n] + divisor[1][n] * divisor[1][n]).sqrt();
            let allowed = size[n] + slack[n];
            ratios[n] = (error[0][n] * error[0][n] + error[1][n] * error[1][n]) / (allowed * allowed);
        }
        [ratios, size, slack]
    }

    /// The weighted form; its inequalities are tight at the present point.
    #[inline(always)]
    fn assemble(&mut self, states: &[[Wide; 3]], smallest: f64) {
        let k = self.unknowns;
        self.form.clear();
        self.form.resize(packed(k, 0), 0.0);
        self.errors.clear();
        self.errors.resize(packed(k, 0), 0.0);
        self.sizes.clear();
        self.sizes.resize(k, 0.0);
        for (g, (weight, [_, size, slack])) in self.weights.iter().zip(states).enumerate() {
            let effects = &self.effects[g * k..(g + 1) * k];
            let (mut own, mut rest, mut total) = ([0.0; WIDTH], [0.0; WIDTH], [0.0; WIDTH]);
            for (effect, x) in effects.iter().zip(&self.at) {
                for (sum, slack) in total.iter_mut().zip(&effect.slack) {
                    *sum += slack * x.abs().max(smallest);
                }
            }
            for n in 0..WIDTH {
                let kappa = (slack[n] / size[n]).clamp(1e-6, 1e6);
                own[n] = weight[n] * (1.0 + kappa);
                rest[n] = weight[n] * (1.0 + 1.0 / kappa) * total[n];
            }
            for (i, a) in effects.iter().enumerate() {
                let (mut left, mut right) = ([[0.0; WIDTH]; 2], [[0.0; WIDTH]; 2]);
                for half in 0..2 {
                    for n in 0..WIDTH {
                        left[half][n] = weight[n] * a.error[half][n];
                        right[half][n] = own[n] * a.divisor[half][n];
                    }
                }
                for (j, b) in effects[..=i].iter().enumerate() {
                    let (mut errors, mut divisors) = ([0.0; WIDTH], [0.0; WIDTH]);
                    for n in 0..WIDTH {
                        errors[n] = left[0][n] * b.error[0][n] + left[1][n] * b.error[1][n];
                        divisors[n] = right[0][n] * b.divisor[0][n] + right[1][n] * b.divisor[1][n];
                    }
                    let (errors, divisors) = (errors.iter().sum::<f64>(), divisors.iter().sum::<f64>());
                    self.errors[packed(i, j)] += errors;
                    self.form[packed(i, j)] += errors - divisors;
                    if i == j {
                        self.sizes[i] += errors + divisors;
                    }
                }
                let slacks = rest.iter().zip(&a.slack).map(|(r, s)| r * s).sum::<f64>();
                let slacks = slacks / self.at[i].abs().max(smallest);
                self.form[packed(i, i)] -= slacks;
                self.sizes[i] += slacks;
            }
        }
        for i in 0..k {
            self.form[packed(i, i)] -= DEFINITE * self.sizes[i];
            self.errors[packed(i, i)] += DEFINITE * self.sizes[i];
        }
    }
}

/// Factors a symmetric matrix by its lower rows into L D Lᵀ, as far as its pivots are positive: how many are. The rows
/// of L are made up to the first that is not, that row included.
#[inline(always)]
fn factorise(matrix: &[f64], k: usize, factor: &mut Vec<f64>) -> usize {
    factor.clear();
    factor.extend_from_slice(matrix);
    for i in 0..k {
        let mut pivot = factor[packed(i, i)];
        for j in 0..i {
            let mut sum = factor[packed(i, j)];
            for l in 0..j {
                sum -= factor[packed(i, l)] * factor[packed(j, l)] * factor[packed(l, l)];
            }
            factor[packed(i, j)] = sum / factor[packed(j, j)];
            pivot -= sum * factor[packed(i, j)];
        }
        // Written so that a pivot that is not a number is none.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return i;
        }
        factor[packed(i, i)] = pivot;
    }
    k
}

/// g·‖t‖ and ‖Fᵀt − g t‖ of every own column and test vector, columns first.
fn effects(
    bank: &Bank,
    own: &[usize],
    vectors: &[[Vec<f64>; 2]],
    sizes: &[f64],
    norm: Norm,
    unit: f64,
) -> Vec<[Wide; 3]> {
    let m = vectors.first().map_or(0, |v| v[0].len());
    let groups = vectors.len() / WIDTH;
    let mut out = vec![[[0.0; WIDTH]; 3]; own.len() * groups];
    // Fᵀt is F applied to t read backwards, read backwards.
    let backwards = |x: &[f64]| -> Vec<f64> { x.iter().rev().copied().collect() };
    let batch = (SPECTRA / (64 * m.max(1))).clamp(1, vectors.len().max(1));
    for start in (0..vectors.len()).step_by(batch) {
        let end = (start + batch).min(vectors.len());
        let spectra: Vec<[Kernel; 2]> = vectors[start..end]
            .par_iter()
            .map(|[a, b]| [Kernel::new(&backwards(a)), Kernel::new(&backwards(b))])
            .collect();
        let found: Vec<Vec<[f64; 3]>> = own
            .par_iter()
            .map(|&p| {
                let kernel = Kernel::new(bank.kernel(p));
                let length: f64 = bank.kernel(p).iter().map(|v| v.abs()).sum();
                let mut product = SumOfProducts::new(m);
                let mut buffers = Buffers::default();
                let (mut re, mut im) = (vec![0.0; m], vec![0.0; m]);
                (start..end)
                    .map(|j| {
                        for (part, out) in spectra[j - start].iter().zip([&mut re, &mut im]) {
                            product.add(1.0, &kernel, part);
                            product.take(out, &mut buffers);
                        }
                        effect(&vectors[j], sizes[j], &re, &im, norm, unit * length)
                    })
                    .collect()
            })
            .collect();
        for (row, values) in found.iter().enumerate() {
            for (value, j) in values.iter().zip(start..) {
                for (half, v) in value.iter().enumerate() {
                    out[row * groups + j / WIDTH][half][j % WIDTH] = *v;
                }
            }
        }
    }
    out
}

/// g·‖t‖ and ‖u − g t‖ for u given backwards; g is the projection of u on t, best for the norm of squares.
#[allow(clippy::cast_precision_loss)]
fn effect([a, b]: &[Vec<f64>; 2], size: f64, re: &[f64], im: &[f64], norm: Norm, rounding: f64) -> [f64; 3] {
    let rows = || a.iter().zip(b).zip(re.iter().zip(im).rev());
    let (mut x, mut y, mut squares) = (0.0, 0.0, 0.0);
    for ((a, b), (u, v)) in rows() {
        // conj(t)·u
        x += a * u + b * v;
        y += a * v - b * u;
        squares += a * a + b * b;
    }
    let (g, h) = (x / squares, y / squares);
    let rests = rows().map(|((a, b), (u, v))| {
        let (p, q) = (u - (g * a - h * b), v - (g * b + h * a));
        p * p + q * q
    });
    let (rest, count) = match norm {
        Norm::L1 => (rests.fold(0.0, f64::max).sqrt(), 1.0),
        Norm::L2 => (rests.sum::<f64>().sqrt(), (a.len() as f64).sqrt()),
    };
    [g * size, h * size, rest + rounding * count + 16.0 * f64::EPSILON * (g.abs() + h.abs()) * size]
}

/// The first `count` test vectors, real and imaginary parts; every window's frequencies span the whole range.
#[allow(clippy::cast_precision_loss)]
fn pool(count: usize, m: usize) -> Vec<[Vec<f64>; 2]> {
    let highest = (m as f64 / 32.0).max(4.0);
    // Where fewer are asked for, every window gives its share.
    let all: Vec<(Window, f64)> = WINDOWS
        .iter()
        .flat_map(|&(window, full)| {
            let n = (full * count).div_ceil(POOL);
            (0..n).map(move |i| {
                let share = if n > 1 { i as f64 / (n - 1) as f64 } else { 0.5 };
                (window, LOWEST * libm::pow(highest / LOWEST, share))
            })
        })
        .take(count)
        .collect();
    all.par_iter()
        .map(|&(window, cycles)| {
            (0..m)
                .map(|k| {
                    let x = (k as f64 + 0.5) / m as f64;
                    let (sin, cos) = libm::sincos(-std::f64::consts::TAU * cycles * x);
                    let size = window.at(x);
                    (size * cos, size * sin)
                })
                .unzip()
        })
        .map(|(re, im)| [re, im])
        .collect()
}
