//! Zeros of a candidate's divisor that its driven part lacks: a proof, without a run, that its free run explodes.
//!
//! The free run obeys D ŷ = N. As polynomials, D(z) ŷ(z) = N(z) + τ(z) where τ holds what the record cuts off; inside the
//! unit circle that is next to nothing. If ‖e‖ ≤ L then Σ|ŷ| ≤ Σ|y| + L, so on a closed path there |τ| < |N| may be
//! proved, and by Rouché's theorem D ŷ has as many zeros inside the path as N: at least as many as D. A candidate whose
//! D has more than its N is therefore beyond the limit. Zeros are counted by how often the values along the path turn
//! around 0: values at nodes, chords between them, and what the second derivative allows beside these.

use rayon::prelude::*;

use crate::equation::Equation;
use crate::error::{check_length, Result};
use crate::linalg::dense;
use crate::order_search::dual_bound::tailored_vectors::modulus;
use crate::order_search::options::Norm;
use crate::parallel::Stop;
use crate::regressors::{Bank, Index, Key, Record};
use crate::simd::WIDTH;

/// Decay rates of the paths, per record: a path bounds the half disc of three times its rate to the right of it. Growth
/// that a record does not show makes no free run large; faster growth than the last is stopped early by any run.
const RATES: [f64; 6] = [20.0, 28.0, 14.0, 40.0, 56.0, 80.0];
/// Radius over rate, and chords on the arc and on the line of one half of a path; the other half mirrors it. The chords
/// on the line are half as long, for there the powers decay most slowly.
const RADIUS: f64 = 3.0;
const CHORDS: [usize; 2] = [25, 39];
const SEGMENTS: usize = CHORDS[0] + CHORDS[1];
/// Nodes of a path in the tables, filled up so that each has a next one in whole lanes.
const NODES: usize = SEGMENTS + WIDTH;
/// Samples that are read at a time, and most samples of a record: products with all columns at all nodes take time.
const AT_ONCE: usize = 4096;
const LONGEST: usize = 1 << 14;

/// Whether the zeros of an equation's divisor prove that its output error at rest exceeds `limit`: Σ|y − ŷ| or Σ(y − ŷ)².
///
/// # Errors
/// Orders or signals that make no equation, coefficients that are not one a term.
///
/// ```
/// # use ftlm::equation::{Equation, Structure, Term};
/// # use ftlm::order_search::dual_bound::explodes;
/// # use ftlm::order_search::options::Norm;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..256).map(|k| if k % 64 < 32 { 1.0 } else { -0.5 }).collect();
/// let record = Record::new(0.1, vec![vec![0.0; 256], input], None)?;
/// // D y = c y + u grows as exp(c t) for 25.6 time units, or decays.
/// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
/// let structure = Structure { output: 0, order: 1.0, terms };
/// let equation = |c: f64| Equation { structure: structure.clone(), coefficients: vec![c, 1.0] };
/// assert!(explodes(&record, &equation(1.2), Norm::L1, 100.0)?);
/// assert!(!explodes(&record, &equation(-1.2), Norm::L1, 100.0)?);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn explodes(record: &Record, equation: &Equation, norm: Norm, limit: f64) -> Result<bool> {
    let Equation { structure, coefficients } = equation;
    structure.check(record.len(), |_| true)?;
    check_length("coefficients", structure.terms.len(), coefficients.len())?;
    let mut index = Index::default();
    let columns: Vec<usize> = (0..structure.terms.len())
        .map(|k| index.insert(Key::integral(structure.terms[k].signal, structure.integration(k))))
        .collect();
    let bank = Bank::new(&index, record, structure.output)?;
    let target = record.signal(structure.output).to_vec();
    let roots = Roots::new(&[bank], &[target], norm);
    Ok(roots.exclude(&columns, coefficients, limit, &mut 0))
}

/// What the paths see of every column, on every record.
pub(crate) struct Roots {
    norm: Norm,
    own: Vec<bool>,
    records: Vec<Seen>,
}

/// What they see on one record.
struct Seen {
    paths: usize,
    samples: f64,
    /// Per column and node: real and imaginary part; and per segment what its second derivative and rounding allow.
    values: Vec<[[f64; NODES]; 3]>,
    /// Largest |z^M| of each segment.
    tails: Vec<[f64; SEGMENTS]>,
    /// Sum of the moduli of an own column's kernel, or of another column.
    sums: Vec<f64>,
    /// Σ|y|.
    size: f64,
    /// What rounding may add to a sum of M terms, per unit.
    unit: f64,
}

/// Nodes of a half path of this rate, from the real axis along the arc to the line and down it to the real axis.
#[allow(clippy::cast_precision_loss)]
fn nodes(rate: f64) -> Vec<(f64, f64)> {
    let radius = RADIUS * rate;
    let widest = libm::acos(1.0 / RADIUS);
    let highest = radius * libm::sin(widest);
    let arc = (0..CHORDS[0]).map(|i| {
        let (sin, cos) = libm::sincos(widest * i as f64 / CHORDS[0] as f64);
        (radius * cos, radius * sin)
    });
    let line = (0..=CHORDS[1]).map(|i| (rate, highest * (CHORDS[1] - i) as f64 / CHORDS[1] as f64));
    arc.chain(line).collect()
}

/// What a path sees of some series, and its largest |z^M| by segment; a stretch of samples at a time.
#[allow(clippy::cast_precision_loss)]
fn path(rate: f64, series: &[&[f64]], moduli: &[&[f64]], unit: f64) -> (Vec<[[f64; NODES]; 3]>, [f64; SEGMENTS]) {
    let nodes = nodes(rate);
    let m = series.first().map_or(0, |x| x.len());
    let samples = m as f64;
    let slowest: Vec<f64> = nodes.windows(2).map(|pair| pair[0].0.min(pair[1].0)).collect();
    let bends: Vec<f64> = nodes
        .windows(2)
        .map(|pair| ((pair[1].0 - pair[0].0).powi(2) + (pair[1].1 - pair[0].1).powi(2)) / 8.0)
        .collect();
    let (mut seen, mut slack) = (vec![0.0; series.len() * 2 * (SEGMENTS + 1)], vec![0.0; series.len() * SEGMENTS]);
    for lo in (0..m).step_by(AT_ONCE) {
        let shares: Vec<f64> = (lo..m.min(lo + AT_ONCE)).map(|k| k as f64 / samples).collect();
        let powers: Vec<Vec<f64>> = nodes
            .iter()
            .flat_map(|(re, im)| {
                let power = |share: &f64| {
                    let (sin, cos) = libm::sincos(-im * share);
                    let size = libm::exp(-re * share);
                    (size * cos, size * sin)
                };
                let (re, im): (Vec<f64>, Vec<f64>) = shares.iter().map(power).unzip();
                [re, im]
            })
            .collect();
        let allowed: Vec<Vec<f64>> = slowest
            .iter()
            .zip(&bends)
            .map(|(slowest, bend)| shares.iter().map(|k| (bend * k * k + unit) * libm::exp(-slowest * k)).collect())
            .collect();
        for (of, by, sums) in [(series, &powers, &mut seen), (moduli, &allowed, &mut slack)] {
            let of: Vec<&[f64]> = of.iter().map(|x| &x[lo..lo + shares.len()]).collect();
            let by: Vec<&[f64]> = by.iter().map(Vec::as_slice).collect();
            sums.iter_mut().zip(dense::inner_products(&of, &by, &Stop::default())).for_each(|(sum, x)| *sum += x);
        }
    }
    let row = |p: usize| {
        let mut row = [[0.0; NODES]; 3];
        for j in 0..NODES {
            let node = (p * (SEGMENTS + 1) + j.min(SEGMENTS)) * 2;
            row[0][j] = seen[node];
            row[1][j] = seen[node + 1];
            row[2][j] = slack[p * SEGMENTS + j.min(SEGMENTS - 1)] * (1.0 + unit);
        }
        row
    };
    let tails = std::array::from_fn(|j| libm::exp(-slowest[j]) * (1.0 + unit));
    ((0..series.len()).map(row).collect(), tails)
}

impl Seen {
    #[allow(clippy::cast_precision_loss)]
    fn new(bank: &Bank, target: &[f64]) -> Self {
        let (m, width) = (target.len(), bank.len());
        let samples = m as f64;
        let unit = 16.0 * f64::EPSILON * samples;
        let series: Vec<&[f64]> =
            (0..width).map(|p| if bank.kernel(p).is_empty() { bank.column(p) } else { bank.kernel(p) }).collect();
        let moduli: Vec<Vec<f64>> = series.iter().map(|x| x.iter().map(|v| v.abs()).collect()).collect();
        let moduli: Vec<&[f64]> = moduli.iter().map(Vec::as_slice).collect();
        let sums = series.iter().map(|x| modulus(x)).collect();
        // Beyond this the powers of a pulse alias.
        let rates: Vec<f64> = RATES.into_iter().filter(|rate| RADIUS * rate <= samples).collect();
        let paths: Vec<_> = rates.par_iter().map(|&rate| path(rate, &series, &moduli, unit)).collect();
        let (values, tails): (Vec<_>, Vec<_>) = paths.into_iter().unzip();
        Self { paths: tails.len(), samples, values: values.concat(), tails, sums, size: modulus(target), unit }
    }

    /// How often D, or N, turns around 0 along a path, which is how many zeros it has inside; none where it may pass
    /// through 0, or N through what is left out of it.
    #[inline(always)]
    fn zeros(
        &self,
        path: usize,
        columns: impl Iterator<Item = (usize, f64)>,
        one: f64,
        left_out: [f64; 2],
    ) -> Option<i32> {
        let width = self.sums.len();
        let (mut re, mut im, mut slack) = ([one; NODES], [0.0; NODES], [0.0; SEGMENTS]);
        for (slack, tail) in slack.iter_mut().zip(&self.tails[path]) {
            *slack = left_out[0] + left_out[1] * tail;
        }
        for (p, c) in columns {
            let [a, b, rest] = &self.values[path * width + p];
            for j in 0..NODES {
                re[j] += c * a[j];
                im[j] += c * b[j];
            }
            for j in 0..SEGMENTS {
                slack[j] += c.abs() * rest[j];
            }
        }
        let (mut turns, mut near) = ([0_i32; WIDTH], [false; WIDTH]);
        for j in (0..SEGMENTS).step_by(WIDTH) {
            for n in 0..WIDTH {
                let (a, b, c, d) = (re[j + n], im[j + n], re[j + n + 1], im[j + n + 1]);
                let middle = ((a + c) * (a + c) + (b + d) * (b + d)).sqrt();
                let half = ((c - a) * (c - a) + (d - b) * (d - b)).sqrt();
                // What is not a number is near.
                near[n] |= !(middle - half > 2.0 * slack[j + n] && middle < f64::MAX);
                // Where a half path crosses the imaginary axis the whole one makes a turn, its mirror image the other half.
                let crossed = i32::from((a < 0.0) != (c < 0.0));
                turns[n] += crossed * if a * d > b * c { 1 } else { -1 };
            }
        }
        (!near.contains(&true)).then(|| turns.iter().sum())
    }
}

impl Roots {
    /// Whether records are short enough.
    pub(crate) fn pay(targets: &[Vec<f64>]) -> bool {
        targets.iter().all(|target| target.len() <= LONGEST)
    }

    /// Bytes of them on these banks.
    pub(crate) fn bytes(banks: &[Bank]) -> u64 {
        banks.iter().map(|bank| (bank.len() * RATES.len() * size_of::<[[f64; NODES]; 3]>()) as u64).sum()
    }

    pub(crate) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm) -> Self {
        let own =
            banks.first().map_or(Vec::new(), |bank| (0..bank.len()).map(|p| !bank.kernel(p).is_empty()).collect());
        let records = banks.iter().zip(targets).map(|(bank, target)| Seen::new(bank, target)).collect();
        Self { norm, own, records }
    }

    /// Whether some path proves that a candidate's raw score exceeds the limit; the one that did so last is asked first.
    #[inline(always)]
    pub(crate) fn exclude(&self, terms: &[usize], coefficients: &[f64], limit: f64, last: &mut usize) -> bool {
        for seen in &self.records {
            let error = match self.norm {
                Norm::L1 => limit,
                Norm::L2 => limit.sqrt() * seen.samples.sqrt(),
            };
            let size = seen.size + error * (1.0 + seen.unit);
            let (mut length, mut driven) = (0.0, 0.0);
            for (&p, &c) in terms.iter().zip(coefficients) {
                *(if self.own[p] { &mut length } else { &mut driven }) += c.abs() * seen.sums[p];
            }
            let rounding = seen.unit * (driven + (1.0 + length) * size);
            let of = |own: bool| {
                let all = terms.iter().copied().zip(coefficients.iter().copied());
                all.filter(move |&(p, _)| self.own[p] == own)
            };
            for turn in 0..seen.paths {
                let path = (*last + turn) % seen.paths;
                let divisor = of(true).map(|(p, c)| (p, -c));
                let Some(most @ 1..) = seen.zeros(path, divisor, 1.0, [seen.unit, 0.0]) else { continue };
                let left_out = [rounding, length * size];
                if seen.zeros(path, of(false), 0.0, left_out).is_some_and(|zeros| zeros < most) {
                    *last = path;
                    return true;
                }
            }
        }
        false
    }
}
