//! Benchmarks of the kernels: series algebra, Haar transforms, operational matrices, correlations, and candidates of an
//! order search.

use std::hint::black_box;
use std::time::Duration;

use criterion::{criterion_group, criterion_main, BatchSize, BenchmarkId, Criterion, SamplingMode, Throughput};
use ftlm::equation::{Equation, Initial, Structure, Term};
use ftlm::fractional::kernels::{block_pulse_kernel, kernel_with_derivative};
use ftlm::fractional::operational_matrices;
use ftlm::order_search::batches::search;
use ftlm::order_search::control::Control;
use ftlm::order_search::grid::{OrderGrid, TermAxis};
use ftlm::order_search::options::{Criterion as Criterium, Estimator, Norm, Options};
use ftlm::regressors::Record;
use ftlm::series::{self, Buffers, Kernel};
use ftlm::signal::block_pulse::PulseMeans;
use ftlm::signal::metrics;
use ftlm::simulate;

/// Lengths of the test signals in pulses. A record of the paper has 2048 pulses. The longer lengths show how the time
/// grows.
const LENGTHS: [usize; 3] = [1 << 11, 1 << 14, 1 << 17];

/// Return pseudorandom numbers, uniform in [−1, 1). They are the same in every run.
fn noise(m: usize, mut state: u64) -> Vec<f64> {
    (0..m)
        .map(|_| {
            // Knuth's MMIX generator, whose upper bits are good enough for test data.
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        })
        .collect()
}

/// Return the divisor series of the damped oscillator D^1.8 y + 5 D^0.9 y + 100 y, with `m` pulses over ten seconds.
fn divisor(m: usize) -> Vec<f64> {
    let step = 10.0 / m as f64;
    let mut d = vec![0.0; m];
    d[0] = 1.0;
    for (c, eta) in [(5.0, 0.9), (100.0, 1.8)] {
        d.iter_mut().zip(block_pulse_kernel(eta, m, step)).for_each(|(d, v)| *d += c * v);
    }
    d
}

fn series_algebra(c: &mut Criterion) {
    let mut group = c.benchmark_group("series");
    for m in LENGTHS {
        group.throughput(Throughput::Elements(m as u64));
        group.bench_with_input(BenchmarkId::new("kernel", m), &m, |b, &m| {
            b.iter(|| block_pulse_kernel(black_box(0.85), m, 1e-3));
        });
        group.bench_with_input(BenchmarkId::new("kernel with derivative", m), &m, |b, &m| {
            b.iter(|| kernel_with_derivative(black_box(0.85), m, 1e-3));
        });
        let signal = noise(m, 1);
        let kernel = Kernel::new(&block_pulse_kernel(0.85, m, 1e-3));
        let (mut out, mut buffers) = (vec![0.0; m], Buffers::default());
        group.bench_with_input(BenchmarkId::new("apply", m), &m, |b, _| {
            b.iter(|| kernel.apply(black_box(&signal), &mut out, &mut buffers));
        });
        let d = divisor(m);
        group.bench_with_input(BenchmarkId::new("divide", m), &m, |b, _| {
            b.iter(|| series::divide(black_box(&signal), &d));
        });
    }
    // The naive reference is slow, so it is measured at the shortest length only.
    let (signal, d) = (noise(1 << 11, 2), divisor(1 << 11));
    group.throughput(Throughput::Elements(1 << 11));
    group.bench_function(BenchmarkId::new("divide naively", 1 << 11), |b| {
        b.iter(|| series::divide_naive(black_box(&signal), &d));
    });
    group.finish();
}

fn haar_transform(c: &mut Criterion) {
    let mut group = c.benchmark_group("haar");
    for m in LENGTHS {
        let signal = noise(m, 3);
        group.throughput(Throughput::Elements(m as u64));
        group.bench_with_input(BenchmarkId::new("transform", m), &m, |b, _| {
            b.iter_batched_ref(|| signal.clone(), |x| operational_matrices::haar_transform(x), BatchSize::LargeInput);
        });
    }
    group.finish();
}

fn correlations(c: &mut Criterion) {
    let mut group = c.benchmark_group("correlations of a residual, 25 lags");
    for m in [1 << 12, 1 << 16] {
        let (x, y) = (noise(m, 1), noise(m, 2));
        group.throughput(Throughput::Elements(m as u64));
        // The residual tests compute correlations up to a quarter of the run, for the confidence band.
        group.bench_with_input(BenchmarkId::new("by spectra, N/4 lags", m), &m, |b, &m| {
            b.iter(|| metrics::covariances(black_box(&x), &y, m / 4));
        });
        group.bench_with_input(BenchmarkId::new("by definition, 25 lags", m), &m, |b, _| {
            b.iter(|| metrics::covariances_naive(black_box(&x), &y, 25));
        });
    }
    group.finish();
}

fn operational_matrices(c: &mut Criterion) {
    let mut group = c.benchmark_group("operational matrix of 2048");
    group.sample_size(10);
    group.bench_function("fast", |b| b.iter(|| operational_matrices::operational_matrix(black_box(0.85), 2048, 1e-3)));
    group.bench_function("dense", |b| {
        b.iter(|| operational_matrices::operational_matrix_dense(black_box(0.85), 2048, 1e-3))
    });
    group.finish();
}

/// Return the record and the order grid of problem P1: the deflection equation of a simulated joint over 2048 pulses.
/// Free are alpha, the orders of two terms of the deflection, and the order of one term of the hub angle. The current
/// has order 0. The noise has a standard deviation of 1e−4 rad.
fn first_problem() -> (Record, OrderGrid) {
    let m = 2048;
    let step = 10.0 / m as f64;
    let signals = |output: usize, terms: &[(usize, f64, f64)]| Equation {
        structure: Structure {
            output,
            order: 2.0,
            terms: terms.iter().map(|&(signal, order, _)| Term { signal, order }).collect(),
        },
        coefficients: terms.iter().map(|t| t.2).collect(),
    };
    let stage = [
        signals(0, &[(1, 0.0, 628.89), (0, 0.95, -62.956), (1, 0.75, 6.63), (2, 0.0, 140.47)]),
        signals(1, &[(1, 0.1, -863.247), (0, 1.05, 62.956), (1, 0.85, -9.1007), (2, 0.0, -140.47)]),
    ];
    let current: Vec<f64> = (0..m).map(|k| if (k as f64 + 0.5) * step % 2.0 < 1.0 { 0.3 } else { -0.3 }).collect();
    let make = |signals| Record::new(step, PulseMeans::from_signals(signals), None);
    let Ok(driven) = make(vec![vec![0.0; m], vec![0.0; m], current.clone()]) else { unreachable!() };
    let Ok(mut angles) = simulate::respond(&stage, &driven, &[]) else { unreachable!() };
    for (angle, seed) in angles.iter_mut().zip(4..) {
        // Uniform noise with a standard deviation of 1e−4 rad.
        angle.iter_mut().zip(noise(m, seed)).for_each(|(y, e)| *y += 1e-4 * 3.0_f64.sqrt() * e);
    }
    angles.push(current);
    let Ok(record) = make(angles) else { unreachable!() };
    let all: Vec<f64> = (0..=40).map(|i| 0.05 * f64::from(i)).collect();
    let axis =
        |signal: usize, values: &[f64]| TermAxis { signal, values: values.to_vec(), interchangeable: signal == 1 };
    let axes = [axis(1, &all), axis(1, &all), axis(0, &all), axis(2, &[0.0])];
    let alphas: Vec<f64> = (21..=40).map(|i| 0.05 * f64::from(i)).collect();
    let Ok(lattice) = OrderGrid::new(1, &alphas, &axes, |s| s == 2) else { unreachable!() };
    (record, lattice)
}

fn order_search(c: &mut Criterion) {
    let (record, lattice) = first_problem();
    let mut group = c.benchmark_group("order search P1");
    group.sample_size(10).warm_up_time(Duration::from_millis(100)).throughput(Throughput::Elements(lattice.count()));
    let records = [record];
    for (name, criterion, seconds) in
        [("output error", Criterium::OutputError, 20), ("equation error", Criterium::EquationError, 2)]
    {
        // Ten searches are measured, regardless of their duration.
        group.measurement_time(Duration::from_secs(seconds)).sampling_mode(SamplingMode::Flat);
        let options = Options {
            criterion,
            norm: Norm::L1,
            estimator: Estimator::LeastSquares,
            initial: Initial::Rest,
            top: 20,
            threads: 1,
            pruning: true,
            memory: 2 << 30,
        };
        group.bench_function(name, |b| {
            b.iter(|| search(&records, &lattice, &[None; 4], &options, &Control::default()));
        });
    }
    group.finish();
}

fn quick() -> Criterion {
    Criterion::default()
        .sample_size(20)
        .warm_up_time(Duration::from_millis(150))
        .measurement_time(Duration::from_millis(600))
}

criterion_group! {
    name = kernels;
    config = quick();
    targets = series_algebra, haar_transform, correlations, operational_matrices, order_search
}
criterion_main!(kernels);
