//! What the tests share: reference numbers, seeded random numbers, measures of error, oracles and small records.

use ftlm::equation::{Equation, Structure, Term};
use ftlm::regressors::Record;
use ftlm::signal::block_pulse::PulseMeans;
use proptest::test_runner::{Config, RngSeed};
use serde_json::Value;

/// A reference file by its name.
pub fn reference(name: &str) -> Value {
    let path = format!("{}/tests/reference/{name}.json", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

pub fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

pub fn numbers(value: &Value) -> Vec<f64> {
    list(value).iter().map(number).collect()
}

pub fn counts(value: &Value) -> Vec<usize> {
    list(value).iter().map(|v| usize::try_from(v.as_u64().unwrap()).unwrap()).collect()
}

pub fn list(value: &Value) -> &[Value] {
    value.as_array().unwrap()
}

/// Settings of a property test: this many cases, always the same ones, no file left behind.
pub fn cases(cases: u32) -> Config {
    Config { cases, rng_seed: RngSeed::Fixed(1), failure_persistence: None, ..Config::default() }
}

/// Fails where `measured` is not below `tolerance`; prints the measured number for `--nocapture`.
#[track_caller]
pub fn check(what: &str, measured: f64, tolerance: f64) {
    println!("{what}: {measured:.3e} (allowed {tolerance:.1e})");
    assert!(measured <= tolerance, "{what}: {measured:.3e} exceeds {tolerance:.1e}");
}

/// Fails where `measured` lies outside the interval.
#[track_caller]
pub fn check_between(what: &str, measured: f64, low: f64, high: f64) {
    println!("{what}: {measured:.4} (allowed {low} to {high})");
    assert!((low..=high).contains(&measured), "{what}: {measured:.6} is outside [{low}, {high}]");
}

/// SplitMix64: small, seeded, the same numbers everywhere.
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Uniform on [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// A whole number from 0 to `end` − 1.
    pub fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }

    pub fn chance(&mut self, probability: f64) -> bool {
        self.unit() < probability
    }

    /// Standard normal (Box–Muller, one of the pair).
    pub fn normal(&mut self) -> f64 {
        (-2.0 * (1.0 - self.unit()).ln()).sqrt() * (std::f64::consts::TAU * self.unit()).cos()
    }

    pub fn signal(&mut self, m: usize) -> Vec<f64> {
        (0..m).map(|_| self.uniform(-1.0, 1.0)).collect()
    }

    /// Held at a random level of [−1, 1] for `hold` pulses at a time.
    pub fn steps(&mut self, m: usize, hold: usize) -> Vec<f64> {
        let levels: Vec<f64> = (0..m.div_ceil(hold)).map(|_| self.uniform(-1.0, 1.0)).collect();
        (0..m).map(|k| levels[k / hold]).collect()
    }
}

pub fn norm(x: &[f64]) -> f64 {
    x.iter().map(|v| v * v).sum::<f64>().sqrt()
}

pub fn largest(x: &[f64]) -> f64 {
    x.iter().fold(0.0, |a, v| f64::max(a, v.abs()))
}

/// max|a − b|; infinite where lengths differ or a value is not a number.
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    if a.len() != b.len() {
        return f64::INFINITY;
    }
    a.iter().zip(b).map(|(x, y)| if (x - y).is_nan() { f64::INFINITY } else { (x - y).abs() }).fold(0.0, f64::max)
}

/// max|a − b| / max|b|.
pub fn relative_distance(a: &[f64], b: &[f64]) -> f64 {
    distance(a, b) / largest(b).max(f64::MIN_POSITIVE)
}

/// max|a/b − 1|, where b is 0 only if a is.
pub fn relative_error(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(&x, &y)| if x == y { 0.0 } else { ((x - y) / y).abs() }).fold(0.0, |worst, e| {
        if e.is_nan() {
            f64::INFINITY
        } else {
            worst.max(e)
        }
    })
}

pub fn bits(x: &[f64]) -> Vec<u64> {
    x.iter().map(|v| v.to_bits()).collect()
}

pub fn deviation(x: &[f64]) -> f64 {
    let mean = x.iter().sum::<f64>() / x.len() as f64;
    (x.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / x.len() as f64).sqrt()
}

/// Orders of convergence from errors on grids that double.
pub fn orders(errors: &[f64]) -> Vec<f64> {
    errors.windows(2).map(|e| (e[0] / e[1]).log2()).collect()
}

/// Solution of a dense row-major system by elimination with row exchanges.
pub fn dense_solve(matrix: &[f64], rhs: &[f64]) -> Vec<f64> {
    let n = rhs.len();
    let (mut a, mut x) = (matrix.to_vec(), rhs.to_vec());
    for column in 0..n {
        let pivot = (column..n).max_by(|&i, &j| a[i * n + column].abs().total_cmp(&a[j * n + column].abs())).unwrap();
        for j in 0..n {
            a.swap(column * n + j, pivot * n + j);
        }
        x.swap(column, pivot);
        for i in column + 1..n {
            let factor = a[i * n + column] / a[column * n + column];
            if factor != 0.0 {
                for j in column..n {
                    a[i * n + j] -= factor * a[column * n + j];
                }
                x[i] -= factor * x[column];
            }
        }
    }
    for i in (0..n).rev() {
        for j in i + 1..n {
            x[i] -= a[i * n + j] * x[j];
        }
        x[i] /= a[i * n + i];
    }
    x
}

/// Row-major lower-triangular Toeplitz matrix: multiplication by a series, mod z^m.
pub fn toeplitz(series: &[f64]) -> Vec<f64> {
    let m = series.len();
    let mut matrix = vec![0.0; m * m];
    for i in 0..m {
        for j in 0..=i {
            matrix[i * m + j] = series[i - j];
        }
    }
    matrix
}

pub fn structure(output: usize, order: f64, terms: &[(usize, f64)]) -> Structure {
    Structure { output, order, terms: terms.iter().map(|&(signal, order)| Term { signal, order }).collect() }
}

/// An equation from (signal, order, coefficient) terms.
pub fn equation(output: usize, order: f64, terms: &[(usize, f64, f64)]) -> Equation {
    let orders: Vec<(usize, f64)> = terms.iter().map(|t| (t.0, t.1)).collect();
    Equation { structure: structure(output, order, &orders), coefficients: terms.iter().map(|t| t.2).collect() }
}

pub fn record(step: f64, signals: Vec<Vec<f64>>) -> Record {
    Record::new(step, PulseMeans::from_signals(signals), None).unwrap()
}

/// A record like `record` with one signal replaced.
pub fn with_signal(record: &Record, index: usize, values: Vec<f64>) -> Record {
    let mut signals: Vec<Vec<f64>> = (0..record.len()).map(|s| record.signal(s).to_vec()).collect();
    signals[index] = values;
    Record::new(record.step(), PulseMeans::from_signals(signals), None).unwrap()
}
