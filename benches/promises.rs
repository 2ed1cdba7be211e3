//! Times that `promises.py` sets beside its rivals, one `name seconds` a line; with a kernel's name, runs that kernel a
//! fixed number of times for callgrind.
#![allow(missing_docs, clippy::cast_precision_loss)]

use std::hint::black_box;
use std::time::Instant;

use ftlm::equation::{Equation, Initial, Structure, Term};
use ftlm::fft::{self, Bin, Workspace};
use ftlm::fractional::block_pulse_kernel;
use ftlm::operational::{block_pulse_matrix, operational_matrix, operational_matrix_dense};
use ftlm::regressors::Record;
use ftlm::search::lattice::{Lattice, TermAxis};
use ftlm::search::run::{search, Control, Criterion, Estimator, Norm, Options};
use ftlm::series::{self, Buffers, Kernel};
use ftlm::simulate;

/// Shortest of at least `least` runs, and of as many as half a second holds: what other work on the machine disturbs
/// least.
fn shortest(least: usize, mut work: impl FnMut()) -> f64 {
    work();
    let mut times = Vec::new();
    let start = Instant::now();
    while times.len() < least || (start.elapsed().as_secs_f64() < 0.5 && times.len() < 2000) {
        let begin = Instant::now();
        work();
        times.push(begin.elapsed().as_secs_f64());
    }
    times.into_iter().fold(f64::INFINITY, f64::min)
}

fn say(name: &str, seconds: f64) {
    println!("{name} {seconds:e}");
}

fn noise(m: usize, seed: u64) -> Vec<f64> {
    let mut state = seed;
    (0..m)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64 * 2.0 - 1.0
        })
        .collect()
}

/// Seconds of one forward and of one inverse real transform of length n.
fn transforms(n: usize) -> (f64, f64) {
    let plan = fft::plan(n);
    let (signal, mut time) = (noise(n, 1), vec![0.0; n]);
    let mut spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
    let mut workspace = Workspace::new();
    let copy = shortest(5, || time.copy_from_slice(black_box(&signal)));
    let forward = shortest(5, || {
        time.copy_from_slice(&signal);
        plan.forward(&mut time, &mut spectrum, &mut workspace);
    });
    time.copy_from_slice(&signal);
    plan.forward(&mut time, &mut spectrum, &mut workspace);
    let kept = spectrum.clone();
    let inverse = shortest(5, || {
        spectrum.copy_from_slice(&kept);
        plan.inverse(&mut spectrum, &mut time, &mut workspace);
    });
    ((forward - copy).max(1e-9), (inverse - copy).max(1e-9))
}

/// The deflection of the arm's first stage: own kernels of orders 1.9 and 1.15 and their coefficients.
const OWN: [(f64, f64); 2] = [(1.9, -863.247), (1.15, -9.1007)];

fn operators() {
    for log in 11..=20 {
        let m = 1usize << log;
        let (forward, inverse) = transforms(2 * m);
        say(&format!("rfft {m}"), forward);
        say(&format!("irfft {m}"), inverse);
        let signal = noise(m, 2);
        let kernel = Kernel::new(&block_pulse_kernel(0.85, m, 10.0 / m as f64));
        let (mut out, mut buffers) = (vec![0.0; m], Buffers::default());
        say(&format!("apply {m}"), shortest(5, || kernel.apply(black_box(&signal), &mut out, &mut buffers)));
        let own: Vec<Vec<f64>> = OWN.iter().map(|(eta, _)| block_pulse_kernel(*eta, m, 10.0 / m as f64)).collect();
        let mut divisor = vec![0.0; m];
        let simulate = shortest(3, || {
            divisor.fill(0.0);
            divisor[0] = 1.0;
            for (kernel, (_, c)) in own.iter().zip(OWN) {
                divisor.iter_mut().zip(kernel).for_each(|(d, k)| *d -= c * k);
            }
            let _ = black_box(series::divide(black_box(&signal), &divisor));
        });
        say(&format!("simulate {m}"), simulate);
    }
    let m = 2048;
    say("write 2048", shortest(5, || drop(black_box(written(m)))));
    say("block pulse matrix 2048", shortest(5, || drop(black_box(block_pulse_matrix(0.85, m, 1e-3)))));
    say("operational matrix 2048", shortest(5, || drop(black_box(operational_matrix(0.85, m, 1e-3)))));
    say("operational matrix by faer 2048", shortest(1, || drop(black_box(operational_matrix_dense(0.85, m, 1e-3)))));
}

/// A matrix written once, element by element, into memory never touched before.
fn written(m: usize) -> Vec<f64> {
    (0..m * m).map(|i| i as f64).collect()
}

/// The arm's first stage at 2048 pulses with a little noise, and the lattice of its deflection at this step.
fn problem(step: f64) -> Option<(Record, Lattice)> {
    let m = 2048;
    let h = 10.0 / m as f64;
    let equation = |output: usize, terms: &[(usize, f64, f64)]| Equation {
        structure: Structure {
            output,
            order: 2.0,
            terms: terms.iter().map(|&(signal, order, _)| Term { signal, order }).collect(),
        },
        coefficients: terms.iter().map(|t| t.2).collect(),
    };
    let stage = [
        equation(0, &[(1, 0.0, 628.89), (0, 0.95, -62.956), (1, 0.75, 6.63), (2, 0.0, 140.47)]),
        equation(1, &[(1, 0.1, -863.247), (0, 1.05, 62.956), (1, 0.85, -9.1007), (2, 0.0, -140.47)]),
    ];
    let current: Vec<f64> = (0..m).map(|k| if (k as f64 + 0.5) * h % 2.0 < 1.0 { 0.3 } else { -0.3 }).collect();
    let driven = Record::new(h, vec![vec![0.0; m], vec![0.0; m], current.clone()], None).ok()?;
    let mut signals = simulate::respond(&stage, &driven, &[]).ok()?;
    for (signal, seed) in signals.iter_mut().zip(4..) {
        signal.iter_mut().zip(noise(m, seed)).for_each(|(y, e)| *y += 1.7e-4 * e);
    }
    signals.push(current);
    let record = Record::new(h, signals, None).ok()?;
    #[allow(clippy::cast_possible_truncation)]
    let all: Vec<f64> = (0..=(2.0 / step).round() as i32).map(|i| step * f64::from(i)).collect();
    let axis = |signal: usize, values: &[f64]| TermAxis { signal, values: values.to_vec(), interchangeable: true };
    let axes = [axis(1, &all), axis(1, &all), axis(0, &all), axis(2, &[0.0])];
    let alphas: Vec<f64> = all.iter().copied().filter(|a| *a > 1.049).collect();
    Some((record, Lattice::new(1, &alphas, &axes, |s| s == 2).ok()?))
}

/// One of the hottest kernels a fixed number of times, for callgrind; prints how many units of work it did.
fn kernel(name: &str) {
    let m = 2048;
    match name {
        "screen" | "nothing" => {
            let Some((record, lattice)) = problem(0.1) else { return };
            let options = Options {
                criterion: Criterion::OutputError,
                norm: Norm::L1,
                estimator: Estimator::LeastSquares,
                initial: Initial::Rest,
                keep: 20,
                threads: 1,
                early_stopping: true,
            };
            if name == "screen" {
                let _ = black_box(search(&[record], &lattice, &[None; 4], &options, &Control::default()));
            }
            println!("units {}", lattice.count());
        }
        "divide" => {
            let (signal, mut divisor) = (noise(m, 2), block_pulse_kernel(1.9, m, 0.005));
            divisor.iter_mut().for_each(|d| *d *= 863.0);
            divisor[0] += 1.0;
            (0..50).for_each(|_| drop(black_box(series::divide(&signal, &divisor))));
            println!("units 50");
        }
        "apply" => {
            let kernel = Kernel::new(&block_pulse_kernel(0.85, m, 0.005));
            let (signal, mut out, mut buffers) = (noise(m, 2), vec![0.0; m], Buffers::default());
            (0..200).for_each(|_| kernel.apply(black_box(&signal), &mut out, &mut buffers));
            println!("units 200");
        }
        _ => {}
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    match arguments.first() {
        Some(name) => kernel(name),
        None => operators(),
    }
}
