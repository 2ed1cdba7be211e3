//! Times that `promises.py` compares with alternatives, one line `name seconds` for each.
//!
//! With the name of a kernel as argument, the program runs this kernel a fixed number of times for callgrind. With
//! `search`, pulses, step and threads, it runs one order search. With `setup` and the same arguments, it only sets up
//! the search.
#![allow(missing_docs, clippy::cast_precision_loss)]

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::hint::black_box;
use std::time::Instant;

use ftlm::equation::{Equation, Initial, Structure, Term};
use ftlm::estimation::joint_fit::fit;
use ftlm::estimation::joint_fit::initial_guesses::OrderGrids;
use ftlm::estimation::joint_fit::parameter_set::ParameterSet;
use ftlm::estimation::joint_fit::structure::{
    Coefficient, Order, ParametricEquation, ParametricStructure, ParametricTerm,
};
use ftlm::estimation::joint_fit::{FitProblem, Initialization, Loss, OutputScale, Settings};
use ftlm::estimation::least_squares;
use ftlm::fft::{self, Bin, Workspace};
use ftlm::fractional::kernels::block_pulse_kernel;
use ftlm::fractional::operational_matrices::{block_pulse_matrix, operational_matrix, operational_matrix_dense};
use ftlm::order_search::batches::{search, BatchEvaluator};
use ftlm::order_search::certificate::{certify, CertificateOptions, Range, Region};
use ftlm::order_search::control::Control;
use ftlm::order_search::grid::{OrderGrid, TermAxis};
use ftlm::order_search::options::{Criterion, Estimator, Norm, Options};
use ftlm::parallel::{pool, Stop};
use ftlm::recording::{Channel, Recording, Recordings, Role};
use ftlm::regressors::Record;
use ftlm::series::{self, Buffers, Division, Kernel};
use ftlm::signal::block_pulse::{Intersample, PulseMeans};
use ftlm::simulate;

/// Return the processor time of this thread \[s\], accurate to a few milliseconds. None if the system does not report
/// it.
fn processor() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    text.split(' ').next()?.parse::<f64>().ok().map(|ns| 1e-9 * ns)
}

/// Return the shortest duration of `work` \[s\]. It runs at least `least` times, and as often as fits in `seconds`. The
/// shortest run is disturbed least by other work on the machine. If it takes more than a millisecond, the mean
/// processor time over many runs is returned if it is shorter.
fn shortest(least: usize, seconds: f64, mut work: impl FnMut()) -> f64 {
    work();
    let mut times = Vec::new();
    let (start, before) = (Instant::now(), processor());
    while times.len() < least || (start.elapsed().as_secs_f64() < seconds && times.len() < 2000) {
        let begin = Instant::now();
        work();
        times.push(begin.elapsed().as_secs_f64());
    }
    let shortest = times.iter().copied().fold(f64::INFINITY, f64::min);
    if shortest < 1e-3 {
        return shortest;
    }
    let mut runs = times.len();
    while let (Some(before), Some(now)) = (before, processor()) {
        if now - before > 0.2 {
            return shortest.min((now - before) / runs as f64);
        }
        work();
        runs += 1;
    }
    shortest
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

/// Return the durations \[s\] of one forward and of one inverse real transform of length n.
fn transforms(n: usize) -> (f64, f64) {
    let plan = fft::plan(n);
    let (signal, mut time) = (noise(n, 1), vec![0.0; n]);
    let mut spectrum = vec![Bin::new(0.0, 0.0); plan.bins()];
    let mut workspace = Workspace::new();
    let copy = shortest(5, 0.3, || time.copy_from_slice(black_box(&signal)));
    let forward = shortest(5, 0.3, || {
        time.copy_from_slice(&signal);
        plan.transform(&mut time, &mut spectrum, &mut workspace);
    });
    time.copy_from_slice(&signal);
    plan.transform(&mut time, &mut spectrum, &mut workspace);
    let kept = spectrum.clone();
    let inverse = shortest(5, 0.3, || {
        spectrum.copy_from_slice(&kept);
        plan.inverse(&mut spectrum, &mut time, &mut workspace);
    });
    ((forward - copy).max(1e-9), (inverse - copy).max(1e-9))
}

/// Number of simulations on which P6 is measured. Their orders are spread over the order grid of P1, and their
/// coefficients are least-squares estimates.
const RUNS: u64 = 9;

fn free_runs() -> Vec<Equation> {
    let Some((record, lattice)) = problem(2048, 0.05) else { return Vec::new() };
    (0..RUNS)
        .filter_map(|i| {
            let structure = lattice.structure(lattice.count() * (2 * i + 1) / (2 * RUNS));
            let fixed = vec![None; structure.terms.len()];
            let records = std::slice::from_ref(&record);
            let fit = least_squares::fit(records, &structure, &fixed, &Initial::Rest).ok()?;
            Some(Equation { structure, coefficients: fit.coefficients })
        })
        .collect()
}

/// Return the duration \[s\] of one simulation as in an order search: kernels and regressors are available, memory is
/// reused, and the division of series is exact.
fn free_run(equation: &Equation, m: usize, division: &mut Division) -> f64 {
    let structure = &equation.structure;
    let step = 10.0 / m as f64;
    let parts: Vec<(bool, f64, Vec<f64>)> = (0..structure.terms.len())
        .map(|k| {
            let kernel = block_pulse_kernel(structure.integration(k), m, step);
            let own = structure.terms[k].signal == structure.output;
            let part = if own { kernel } else { series::multiply(&kernel, &noise(m, 2), m) };
            (own, equation.coefficients[k], part)
        })
        .collect();
    let (mut divisor, mut numerator) = (vec![0.0; m], vec![0.0; m]);
    shortest(3, 0.05, || {
        divisor.fill(0.0);
        numerator.fill(0.0);
        divisor[0] = 1.0;
        for (own, c, part) in &parts {
            let (sum, c) = if *own { (&mut divisor, -c) } else { (&mut numerator, *c) };
            sum.iter_mut().zip(part).for_each(|(s, v)| *s += c * v);
        }
        division.reset();
        division.add(0, 0, black_box(&numerator));
        let inverse = [1.0 / divisor[0]];
        while division.solved_terms() < m {
            division.advance(&inverse, |_, _, len| &divisor[..len]);
        }
        black_box(division.quotient(0));
    })
}

fn operators() {
    let runs = free_runs();
    for log in 9..=20 {
        let m = 1usize << log;
        let (forward, inverse) = transforms(2 * m);
        say(&format!("rfft {m}"), forward);
        say(&format!("irfft {m}"), inverse);
        let signal = noise(m, 2);
        let kernel = Kernel::new(&block_pulse_kernel(0.85, m, 10.0 / m as f64));
        let (mut out, mut buffers) = (vec![0.0; m], Buffers::default());
        say(&format!("apply {m}"), shortest(5, 0.3, || kernel.apply(black_box(&signal), &mut out, &mut buffers)));
        let mut division = Division::new(1, m);
        let mut times: Vec<f64> = runs.iter().map(|equation| free_run(equation, m, &mut division)).collect();
        times.sort_by(f64::total_cmp);
        let Some(&simulate) = times.get(times.len() / 2) else { continue };
        say(&format!("simulate {m}"), simulate);
    }
    let m = 2048;
    say("write 2048", shortest(5, 0.3, || drop(black_box(written(m)))));
    say("block pulse matrix 2048", shortest(5, 0.3, || drop(black_box(block_pulse_matrix(0.85, m, 1e-3)))));
    say("operational matrix 2048", shortest(5, 0.3, || drop(black_box(operational_matrix(0.85, m, 1e-3)))));
    say(
        "operational matrix by faer 2048",
        shortest(1, 0.3, || drop(black_box(operational_matrix_dense(0.85, m, 1e-3)))),
    );
}

/// Return an m × m matrix that is written once, element by element, into newly allocated memory.
fn written(m: usize) -> Vec<f64> {
    (0..m * m).map(|i| i as f64).collect()
}

/// Return a record of the first joint of the arm over `m` pulses with a little noise, and the order grid of its
/// deflection with the increment `step`.
fn problem(m: usize, step: f64) -> Option<(Record, OrderGrid)> {
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
    let driven =
        Record::new(h, PulseMeans::from_signals(vec![vec![0.0; m], vec![0.0; m], current.clone()]), None).ok()?;
    let mut signals = simulate::respond(&stage, &driven, &[]).ok()?;
    for (signal, seed) in signals.iter_mut().zip(4..) {
        signal.iter_mut().zip(noise(m, seed)).for_each(|(y, e)| *y += 1.7e-4 * e);
    }
    signals.push(current);
    let record = Record::new(h, PulseMeans::from_signals(signals), None).ok()?;
    #[allow(clippy::cast_possible_truncation)]
    let all: Vec<f64> = (0..=(2.0 / step).round() as i32).map(|i| step * f64::from(i)).collect();
    let axis = |signal: usize, values: &[f64]| TermAxis { signal, values: values.to_vec(), interchangeable: true };
    let axes = [axis(1, &all), axis(1, &all), axis(0, &all), axis(2, &[0.0])];
    let alphas: Vec<f64> = all.iter().copied().filter(|a| *a > 1.049).collect();
    Some((record, OrderGrid::new(1, &alphas, &axes, |s| s == 2).ok()?))
}

/// Increment of the order grid that is ranked by equation errors for callgrind: five million candidates.
const RANKED: f64 = 0.025;
/// Increment of an order grid of more than 2^25 candidates, whose simulations are excluded in boxes.
const BOXED: f64 = 0.015;

fn options(threads: usize) -> Options {
    Options {
        criterion: Criterion::OutputError,
        norm: Norm::L1,
        estimator: Estimator::LeastSquares,
        initial: Initial::Rest,
        top: 20,
        threads,
        pruning: true,
        memory: 2 << 30,
    }
}

/// Return the processor time of all threads \[s\], in the hundredths of a second that the system counts.
fn processor_of_all() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name of the program, in parentheses, may contain blanks.
    let fields: Vec<&str> = text.rsplit(')').next()?.split_whitespace().collect();
    let ticks = |i: usize| fields.get(i)?.parse::<f64>().ok();
    Some((ticks(11)? + ticks(12)?) / 100.0)
}

/// Run one search. Print the number of candidates, the wall time \[s\] and the processor time \[s\].
fn growth(m: usize, step: f64, threads: usize) {
    let Some((record, lattice)) = problem(m, step) else { return };
    let (start, before) = (Instant::now(), processor_of_all().unwrap_or(f64::NAN));
    let found = black_box(search(&[record], &lattice, &[None; 4], &options(threads), &Control::default()));
    let (wall, cpu) = (start.elapsed().as_secs_f64(), processor_of_all().unwrap_or(f64::NAN) - before);
    if let Ok(found) = found {
        println!("{} {wall:e} {cpu:e}", found.counts.candidates);
    }
}

/// Set up a search and stop before its first batch. Print the wall time \[s\], the processor times \[s\] of all threads
/// and of the busiest thread, and the peak memory of the process \[bytes\].
fn setup(m: usize, step: f64, threads: usize) {
    let (Some((record, lattice)), Ok(pool)) = (problem(m, step), pool(threads)) else { return };
    let (records, options) = ([record], options(threads));
    let before = busy();
    let start = Instant::now();
    let ready =
        BatchEvaluator::new(&records, Cow::Borrowed(&lattice), &[None; 4], &options, &pool, &Control::default());
    let wall = start.elapsed().as_secs_f64();
    if black_box(ready).is_ok() {
        let spent: Vec<f64> =
            busy().into_iter().map(|(thread, now)| now - before.get(&thread).copied().unwrap_or(0.0)).collect();
        let busiest = spent.iter().copied().fold(0.0, f64::max);
        println!("{wall:e} {:e} {busiest:e} {:e}", spent.iter().sum::<f64>(), peak().unwrap_or(f64::NAN));
    }
}

/// Return the processor time \[s\] of every thread of this process, by thread number.
fn busy() -> BTreeMap<String, f64> {
    let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    tasks
        .filter_map(|task| {
            let text = std::fs::read_to_string(task.path().join("schedstat")).ok()?;
            Some((task.file_name().into_string().ok()?, 1e-9 * text.split(' ').next()?.parse::<f64>().ok()?))
        })
        .collect()
}

/// Return the peak memory of this process \[bytes\].
fn peak() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find(|line| line.starts_with("VmHWM"))?;
    Some(1024.0 * line.split_whitespace().nth(1)?.parse::<f64>().ok()?)
}

/// Return the order alpha that a joint fit of D^alpha y = d D^0.6 y + a y + b u finds by multistart. The true order is
/// 1.6.
fn joint_fit(m: usize) -> Option<f64> {
    let h = 0.01;
    let u: Vec<f64> = (0..m).map(|k| if k % 400 < 230 { 1.0 } else { -0.6 }).collect();
    let terms = [(0, 0.6, -3.0), (0, 0.0, -8.0), (1, 0.0, 5.0)];
    let plant = Equation {
        structure: Structure {
            output: 0,
            order: 1.6,
            terms: terms.iter().map(|&(signal, order, _)| Term { signal, order }).collect(),
        },
        coefficients: terms.iter().map(|t| t.2).collect(),
    };
    let input_record = Record::new(h, PulseMeans::from_signals(vec![vec![0.0; m], u.clone()]), None).ok()?;
    let mut y = simulate::respond(&[plant], &input_record, &[]).ok()?.remove(0);
    y.iter_mut().zip(noise(m, 3)).for_each(|(y, e)| *y += 1e-3 * e);
    let scales = [OutputScale::from_runs(&[y.clone()])];
    let run = vec![Channel::new("y", y, Role::Output), Channel::new("u", u, Role::Input(Intersample::Hold))];
    let runs = Recordings::new(vec![Recording::new("run", h, None, run, vec![0]).ok()?]).ok()?;
    let free_term = |(signal, order, _): (usize, f64, f64), name: &str| ParametricTerm {
        signal,
        order: Order::number(order),
        coefficient: Coefficient::Free(name.into()),
        factor: 1.0,
    };
    let terms = terms.into_iter().zip(["d", "a", "b"]).map(|(term, name)| free_term(term, name)).collect();
    let equation = ParametricEquation { output: 0, order: Order::free("alpha"), terms, friction: None };
    let parameter_set = ParameterSet::from_structure(ParametricStructure::new(
        vec!["y".into(), "u".into()],
        vec![equation],
        Initial::Rest,
    ))
    .ok()?;
    let stop = Stop::default();
    let guess_source = OrderGrids::new(&runs, 1, 1 << 28, &stop);
    let fit_problem = FitProblem {
        parameter_set: &parameter_set,
        source: &runs,
        guess_source: &guess_source,
        scales: &scales,
        stop: &stop,
    };
    let settings = Settings { loss: Loss::Squares, refine: true, threads: 1 };
    let found = fit::fit(
        fit_problem,
        Initialization::Multistart { given_guesses: Vec::new(), candidates: None },
        settings,
        &|_, _| Ok(()),
    )
    .ok()??;
    black_box(found).optimum.estimate.first().copied()
}

/// Run one of the most expensive kernels a fixed number of times, for callgrind. Print the number of units of work.
fn kernel(name: &str) {
    let m = 2048;
    match name {
        "screen" | "nothing" => {
            let Some((record, lattice)) = problem(m, 0.1) else { return };
            if name == "screen" {
                let _ = black_box(search(&[record], &lattice, &[None; 4], &options(1), &Control::default()));
            }
            println!("units {}", lattice.count());
        }
        "rank" => {
            let Some((record, lattice)) = problem(m, RANKED) else { return };
            let options = Options { criterion: Criterion::EquationError, norm: Norm::L2, ..options(1) };
            let _ = black_box(search(&[record], &lattice, &[None; 4], &options, &Control::default()));
            println!("units {}", lattice.count());
        }
        "boxes" => {
            let Some((record, lattice)) = problem(m / 4, BOXED) else { return };
            let found = black_box(search(&[record], &lattice, &[None; 4], &options(1), &Control::default()));
            if found.is_ok_and(|found| found.counts.excluded_by_box > lattice.count() / 2) {
                println!("units {}", lattice.count());
            }
        }
        "certify" => {
            let Some((record, _)) = problem(m / 8, RANKED) else { return };
            let range = |signal, highest| Range { signal, lowest: 0.0, highest };
            let region = Region {
                output: 1,
                alpha: (1.05, 2.0),
                terms: vec![range(1, 1.0), range(0, 1.5), range(2, 0.0)],
                min_separation: 0.05,
            };
            let asked = CertificateOptions {
                tolerance: 0.05,
                max_coefficient: 100.0,
                max_cells: 100_000,
                threads: 1,
                memory: 1 << 30,
            };
            let Ok(found) = black_box(certify(&[record], &region, &asked, &Control::default())) else { return };
            println!("units {}", found.cells);
        }
        "fit" => println!("units {}", u8::from(joint_fit(m).is_some_and(|order| (order - 1.6).abs() < 0.05))),
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
    let words: Vec<&str> = arguments.iter().map(String::as_str).collect();
    match words[..] {
        ["search", m, step, threads] => {
            if let (Ok(m), Ok(step), Ok(threads)) = (m.parse(), step.parse(), threads.parse()) {
                growth(m, step, threads);
            }
        }
        ["setup", m, step, threads] => {
            if let (Ok(m), Ok(step), Ok(threads)) = (m.parse(), step.parse(), threads.parse()) {
                setup(m, step, threads);
            }
        }
        [name] => kernel(name),
        _ => operators(),
    }
}
