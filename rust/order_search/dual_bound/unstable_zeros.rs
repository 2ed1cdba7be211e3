//! Unstable zeros of the denominator of a candidate. They prove without simulation that its simulated output diverges.
//!
//! Let y be the measured output, ŷ the simulated output and e = y − ŷ. The simulation solves D ŷ = N with the
//! denominator series D and the input part N. As polynomials in the delay z, D(z) ŷ(z) = N(z) + τ(z). The terms τ
//! beyond the record are negligible inside the unit circle. If ‖e‖ ≤ L for a limit L, then Σ|ŷ| ≤ Σ|y| + L. Therefore
//! |τ| < |N| can be proved on a closed path inside the unit circle. By Rouché's theorem, D ŷ and N then have the same
//! number of zeros inside the path, and D has no more zeros than N. A candidate whose D has more zeros than its N
//! therefore exceeds the limit. The zeros are counted by the winding number along the path. It is computed from values
//! at nodes, chords between the nodes, and bounds of the second derivative.

use rayon::prelude::*;

use crate::equation::Equation;
use crate::error::{check_length, Result};
use crate::linalg::dense;
use crate::order_search::dual_bound::tailored_vectors::sum_of_moduli;
use crate::order_search::options::Norm;
use crate::parallel::Stop;
use crate::regressors::{Bank, Index, Key, Record};
use crate::simd::LANE_COUNT;

/// Growth rates at which the paths run, per record length. In the plane of growth rate and angular frequency, a path
/// encloses the part of a disc about 0 to the right of its rate. The radius of the disc is three times the rate. Slower
/// modes hardly increase the simulated output, and faster modes end the simulation early.
const PATH_GROWTH_RATES: [f64; 6] = [20.0, 28.0, 14.0, 40.0, 56.0, 80.0];
/// Ratio of the radius of a path in the complex plane to its growth rate.
const PATH_RADIUS_RATIO: f64 = 3.0;
/// Number of chords along the arc and along the straight line of the upper half of a path in the complex plane.
const PATH_CHORD_COUNTS: [usize; 2] = [25, 39];
/// Number of chords of the upper half of a path in the complex plane.
const PATH_SEGMENT_COUNT: usize = PATH_CHORD_COUNTS[0] + PATH_CHORD_COUNTS[1];
/// Number of nodes of the upper half of a path in the tables, padded to whole SIMD lanes.
const PADDED_NODE_COUNT: usize = PATH_SEGMENT_COUNT + LANE_COUNT;
/// Number of samples that are processed at a time.
const SAMPLES_PER_BLOCK: usize = 4096;
/// Maximum number of samples of a record for which the test for unstable zeros is used.
const MAX_RECORD_SAMPLES: usize = 1 << 14;

/// Return true if unstable zeros of an equation's denominator prove that its output error exceeds `limit`. The output
/// error is Σ|y − ŷ| or Σ(y − ŷ)² with zero initial conditions.
///
/// # Errors
/// [`crate::error::Error::OutOfRange`] or [`crate::error::Error::Structure`] for orders or signals that do not form an
/// equation. [`crate::error::Error::Length`] for a number of coefficients that differs from the number of terms.
///
/// ```
/// # use ftlm::signal::block_pulse::PulseMeans;
/// # use ftlm::equation::{Equation, Structure, Term};
/// # use ftlm::order_search::dual_bound::has_unstable_zeros;
/// # use ftlm::order_search::options::Norm;
/// # use ftlm::regressors::Record;
/// # let input: Vec<f64> = (0..256).map(|k| if k % 64 < 32 { 1.0 } else { -0.5 }).collect();
/// let record = Record::new(0.1, PulseMeans::from_signals(vec![vec![0.0; 256], input]), None)?;
/// // The solution of D y = c y + u increases as exp(c t) for 25.6 time units, or decays for c < 0.
/// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
/// let structure = Structure { output: 0, order: 1.0, terms };
/// let equation = |c: f64| Equation { structure: structure.clone(), coefficients: vec![c, 1.0] };
/// assert!(has_unstable_zeros(&record, &equation(1.2), Norm::L1, 100.0)?);
/// assert!(!has_unstable_zeros(&record, &equation(-1.2), Norm::L1, 100.0)?);
/// # Ok::<(), ftlm::error::Error>(())
/// ```
pub fn has_unstable_zeros(record: &Record, equation: &Equation, norm: Norm, limit: f64) -> Result<bool> {
    let Equation { structure, coefficients } = equation;
    structure.check(record.len(), |_| true)?;
    check_length("coefficients", structure.terms.len(), coefficients.len())?;
    let mut index = Index::default();
    let columns: Vec<usize> = (0..structure.terms.len())
        .map(|k| index.insert(Key::integral(structure.terms[k].signal, structure.integration(k))))
        .collect();
    let bank = Bank::new(&index, record, structure.output)?;
    let target = record.signal(structure.output).to_vec();
    let unstable_zeros = UnstableZeros::new(&[bank], &[target], norm);
    Ok(unstable_zeros.excludes_candidate(&columns, coefficients, limit, &mut 0))
}

/// Test for unstable zeros of the denominator: values of every regressor column along closed paths in the complex
/// plane, on every record.
pub(crate) struct UnstableZeros {
    norm: Norm,
    /// True for the regressor columns that are integrals of the output.
    is_output_column: Vec<bool>,
    records: Vec<PathSums>,
}

/// Values of the z-transform of every regressor column along closed paths in the complex plane, on one record. For an
/// output column the kernel is transformed.
struct PathSums {
    /// Number of paths in the complex plane.
    paths: usize,
    /// Number of samples of the record.
    samples: f64,
    /// Values of the z-transform of each column, ordered by path, then by column: real part and imaginary part at each
    /// node. The third entry bounds, for each segment, the second-derivative term and the rounding error.
    values: Vec<[[f64; PADDED_NODE_COUNT]; 3]>,
    /// Maximum of |z^M| on each segment of a path, by path. z is the delay variable, and M is the number of samples.
    tails: Vec<[f64; PATH_SEGMENT_COUNT]>,
    /// Sum of the moduli of each column. For an output column, sum of the moduli of its kernel.
    sums: Vec<f64>,
    /// Sum of moduli Σ|y| of the output.
    output_modulus: f64,
    /// Relative rounding-error bound of a sum over all samples.
    unit: f64,
}

/// Return the nodes (growth rate, angular frequency) of the upper half of a path with this rate, per record length.
/// They run from the real axis along the arc, then down the straight line to the real axis.
#[allow(clippy::cast_precision_loss)]
fn path_nodes(rate: f64) -> Vec<(f64, f64)> {
    let radius = PATH_RADIUS_RATIO * rate;
    let widest = libm::acos(1.0 / PATH_RADIUS_RATIO);
    let highest = radius * libm::sin(widest);
    let arc = (0..PATH_CHORD_COUNTS[0]).map(|i| {
        let (sin, cos) = libm::sincos(widest * i as f64 / PATH_CHORD_COUNTS[0] as f64);
        (radius * cos, radius * sin)
    });
    let line = (0..=PATH_CHORD_COUNTS[1])
        .map(|i| (rate, highest * (PATH_CHORD_COUNTS[1] - i) as f64 / PATH_CHORD_COUNTS[1] as f64));
    arc.chain(line).collect()
}

/// Compute the values of several series along a path, and the largest |z^M| by segment. M is the number of samples, and
/// `moduli` are the moduli of the series. The samples are read block by block.
#[allow(clippy::cast_precision_loss)]
fn path_sums(
    rate: f64,
    series: &[&[f64]],
    moduli: &[&[f64]],
    unit: f64,
) -> (Vec<[[f64; PADDED_NODE_COUNT]; 3]>, [f64; PATH_SEGMENT_COUNT]) {
    let nodes = path_nodes(rate);
    let m = series.first().map_or(0, |x| x.len());
    let samples = m as f64;
    let slowest: Vec<f64> = nodes.windows(2).map(|pair| pair[0].0.min(pair[1].0)).collect();
    let bends: Vec<f64> = nodes
        .windows(2)
        .map(|pair| ((pair[1].0 - pair[0].0).powi(2) + (pair[1].1 - pair[0].1).powi(2)) / 8.0)
        .collect();
    let (mut response, mut slack) =
        (vec![0.0; series.len() * 2 * (PATH_SEGMENT_COUNT + 1)], vec![0.0; series.len() * PATH_SEGMENT_COUNT]);
    for lo in (0..m).step_by(SAMPLES_PER_BLOCK) {
        let times: Vec<f64> = (lo..m.min(lo + SAMPLES_PER_BLOCK)).map(|k| k as f64 / samples).collect();
        let powers: Vec<Vec<f64>> = nodes
            .iter()
            .flat_map(|(re, im)| {
                let power = |time: &f64| {
                    let (sin, cos) = libm::sincos(-im * time);
                    let size = libm::exp(-re * time);
                    (size * cos, size * sin)
                };
                let (re, im): (Vec<f64>, Vec<f64>) = times.iter().map(power).unzip();
                [re, im]
            })
            .collect();
        let decays: Vec<Vec<f64>> = slowest
            .iter()
            .zip(&bends)
            .map(|(slowest, bend)| times.iter().map(|k| (bend * k * k + unit) * libm::exp(-slowest * k)).collect())
            .collect();
        for (values, factors, sums) in [(series, &powers, &mut response), (moduli, &decays, &mut slack)] {
            let values: Vec<&[f64]> = values.iter().map(|x| &x[lo..lo + times.len()]).collect();
            let factors: Vec<&[f64]> = factors.iter().map(Vec::as_slice).collect();
            sums.iter_mut()
                .zip(dense::inner_products(&values, &factors, &Stop::default()))
                .for_each(|(sum, x)| *sum += x);
        }
    }
    let row = |p: usize| {
        let mut row = [[0.0; PADDED_NODE_COUNT]; 3];
        for j in 0..PADDED_NODE_COUNT {
            let node = (p * (PATH_SEGMENT_COUNT + 1) + j.min(PATH_SEGMENT_COUNT)) * 2;
            row[0][j] = response[node];
            row[1][j] = response[node + 1];
            row[2][j] = slack[p * PATH_SEGMENT_COUNT + j.min(PATH_SEGMENT_COUNT - 1)] * (1.0 + unit);
        }
        row
    };
    let tails = std::array::from_fn(|j| libm::exp(-slowest[j]) * (1.0 + unit));
    ((0..series.len()).map(row).collect(), tails)
}

impl PathSums {
    /// Compute the values of all columns of a bank along all paths.
    #[allow(clippy::cast_precision_loss)]
    fn new(bank: &Bank, target: &[f64]) -> Self {
        let (m, width) = (target.len(), bank.len());
        let samples = m as f64;
        let unit = 16.0 * f64::EPSILON * samples;
        let series: Vec<&[f64]> =
            (0..width).map(|p| if bank.kernel(p).is_empty() { bank.column(p) } else { bank.kernel(p) }).collect();
        let moduli: Vec<Vec<f64>> = series.iter().map(|x| x.iter().map(|v| v.abs()).collect()).collect();
        let moduli: Vec<&[f64]> = moduli.iter().map(Vec::as_slice).collect();
        let sums = series.iter().map(|x| sum_of_moduli(x)).collect();
        // A larger radius would alias at the sampling interval.
        let rates: Vec<f64> =
            PATH_GROWTH_RATES.into_iter().filter(|rate| PATH_RADIUS_RATIO * rate <= samples).collect();
        let paths: Vec<_> = rates.par_iter().map(|&rate| path_sums(rate, &series, &moduli, unit)).collect();
        let (values, tails): (Vec<_>, Vec<_>) = paths.into_iter().unzip();
        Self {
            paths: tails.len(),
            samples,
            values: values.concat(),
            tails,
            sums,
            output_modulus: sum_of_moduli(target),
            unit,
        }
    }

    /// Return the number of zeros that a weighted sum of columns plus the constant `unit` has inside a path. It is the
    /// winding number of the values of the sum along the path. `omission` bounds the omitted part: a constant, and a
    /// multiple of |z^M| for M samples. `None` if the sum may be 0 on the path.
    #[inline(always)]
    fn count_zeros(
        &self,
        path: usize,
        columns: impl Iterator<Item = (usize, f64)>,
        unit: f64,
        omission: [f64; 2],
    ) -> Option<i32> {
        let width = self.sums.len();
        let (mut re, mut im, mut slack) =
            ([unit; PADDED_NODE_COUNT], [0.0; PADDED_NODE_COUNT], [0.0; PATH_SEGMENT_COUNT]);
        for (slack, tail) in slack.iter_mut().zip(&self.tails[path]) {
            *slack = omission[0] + omission[1] * tail;
        }
        for (p, c) in columns {
            let [a, b, rest] = &self.values[path * width + p];
            for j in 0..PADDED_NODE_COUNT {
                re[j] += c * a[j];
                im[j] += c * b[j];
            }
            for j in 0..PATH_SEGMENT_COUNT {
                slack[j] += c.abs() * rest[j];
            }
        }
        let (mut windings, mut is_near_zero) = ([0_i32; LANE_COUNT], [false; LANE_COUNT]);
        for j in (0..PATH_SEGMENT_COUNT).step_by(LANE_COUNT) {
            for n in 0..LANE_COUNT {
                let (a, b, c, d) = (re[j + n], im[j + n], re[j + n + 1], im[j + n + 1]);
                let middle = ((a + c) * (a + c) + (b + d) * (b + d)).sqrt();
                let half = ((c - a) * (c - a) + (d - b) * (d - b)).sqrt();
                // NaN counts as a value that may be 0.
                is_near_zero[n] |= !(middle - half > 2.0 * slack[j + n] && middle < f64::MAX);
                // A crossing of the imaginary axis by the half path counts as one turn, because the mirrored half adds
                // a second half turn.
                let crosses_axis = i32::from((a < 0.0) != (c < 0.0));
                windings[n] += crosses_axis * if a * d > b * c { 1 } else { -1 };
            }
        }
        (!is_near_zero.contains(&true)).then(|| windings.iter().sum())
    }
}

impl UnstableZeros {
    /// Return true if all records are short enough for the tables of the test.
    pub(crate) fn is_affordable(targets: &[Vec<f64>]) -> bool {
        targets.iter().all(|target| target.len() <= MAX_RECORD_SAMPLES)
    }

    /// Return the memory of the tables of the test for these banks \[bytes\].
    pub(crate) fn bytes(banks: &[Bank]) -> u64 {
        banks
            .iter()
            .map(|bank| (bank.len() * PATH_GROWTH_RATES.len() * size_of::<[[f64; PADDED_NODE_COUNT]; 3]>()) as u64)
            .sum()
    }

    /// Compute the tables of all records. `targets` is the measured output of each record.
    pub(crate) fn new(banks: &[Bank], targets: &[Vec<f64>], norm: Norm) -> Self {
        let is_output_column =
            banks.first().map_or(Vec::new(), |bank| (0..bank.len()).map(|p| !bank.kernel(p).is_empty()).collect());
        let records = banks.iter().zip(targets).map(|(bank, target)| PathSums::new(bank, target)).collect();
        Self { norm, is_output_column, records }
    }

    /// Return true if some path proves that the raw score (Σ|e| or Σe²) of a candidate exceeds the limit. The path
    /// `last`, which excluded the most recent candidate, is tried first.
    #[inline(always)]
    pub(crate) fn excludes_candidate(
        &self,
        terms: &[usize],
        coefficients: &[f64],
        limit: f64,
        last: &mut usize,
    ) -> bool {
        for record in &self.records {
            let error = match self.norm {
                Norm::L1 => limit,
                Norm::L2 => limit.sqrt() * record.samples.sqrt(),
            };
            let size = record.output_modulus + error * (1.0 + record.unit);
            let (mut length, mut input_norm) = (0.0, 0.0);
            for (&p, &c) in terms.iter().zip(coefficients) {
                *(if self.is_output_column[p] { &mut length } else { &mut input_norm }) += c.abs() * record.sums[p];
            }
            let rounding = record.unit * (input_norm + (1.0 + length) * size);
            let terms_of = |is_output: bool| {
                let all = terms.iter().copied().zip(coefficients.iter().copied());
                all.filter(move |&(p, _)| self.is_output_column[p] == is_output)
            };
            for path_index in 0..record.paths {
                let path = (*last + path_index) % record.paths;
                let divisor = terms_of(true).map(|(p, c)| (p, -c));
                let Some(most @ 1..) = record.count_zeros(path, divisor, 1.0, [record.unit, 0.0]) else { continue };
                let omission = [rounding, length * size];
                if record.count_zeros(path, terms_of(false), 0.0, omission).is_some_and(|zeros| zeros < most) {
                    *last = path;
                    return true;
                }
            }
        }
        false
    }
}
