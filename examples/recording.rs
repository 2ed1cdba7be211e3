//! Joint output-error fit of columns of samples with a gap and a delay. `cargo run --release --example recording` takes
//! seconds.

use ftlm::equation::Initial;
use ftlm::error::Result;
use ftlm::estimation::joint_fit::initial_guesses::OrderGrids;
use ftlm::estimation::joint_fit::parameter_set::ParameterSet;
use ftlm::estimation::joint_fit::structure::{
    Coefficient, Order, ParametricEquation, ParametricStructure, ParametricTerm,
};
use ftlm::estimation::joint_fit::{fit, FitProblem, Initialization, Loss, OutputScale, Settings};
use ftlm::output_samples::{InitialTerms, OutputSimulation};
use ftlm::parallel::Stop;
use ftlm::recording::{Channel, Recording, Recordings, Role};
use ftlm::signal::block_pulse::Intersample;

/// Number of samples of the run.
const ROWS: usize = 300;
/// Sampling interval \[s\].
const STEP: f64 = 0.05;
/// Delay of the input \[s\].
const DELAY: f64 = 0.15;

/// Return samples of y and u, as they would be read from a file. The plant is D y = −2 y + 3 u with u delayed by three
/// samples. Five samples of y are missing (NaN).
fn columns() -> (Vec<f64>, Vec<f64>) {
    let u: Vec<f64> = (0..ROWS).map(|k| if k % 60 < 30 { 1.0 } else { -1.0 }).collect();
    let decay = f64::exp(-2.0 * STEP);
    let mut y = vec![0.0; ROWS];
    for k in 1..ROWS {
        let late = if k < 4 { 0.0 } else { u[k - 4] };
        y[k] = decay * y[k - 1] + 1.5 * (1.0 - decay) * late;
    }
    y[100..105].fill(f64::NAN);
    (y, u)
}

fn main() -> Result<()> {
    let (y, u) = columns();
    let samples: Vec<f64> = y.iter().copied().filter(|v| !v.is_nan()).collect();
    let scales = [OutputScale::from_runs(&[samples])];
    let input = Channel { delay: Some(DELAY), ..Channel::new("u", u, Role::Input(Intersample::Hold)) };
    let run = Recording::new("run", STEP, None, vec![Channel::new("y", y, Role::Output), input], vec![0])?;
    let runs = Recordings::new(vec![run.clone()])?;

    // D^alpha y = a y + b u.
    let term = |signal, name: &str| {
        let coefficient = Coefficient::Free(name.into());
        ParametricTerm { signal, order: Order::number(0.0), coefficient, factor: 1.0 }
    };
    let terms = vec![term(0, "a"), term(1, "b")];
    let equation = ParametricEquation { output: 0, order: Order::free("alpha"), terms, friction: None };
    let signals = vec!["y".into(), "u".into()];
    let parameter_set = ParameterSet::from_structure(ParametricStructure::new(signals, vec![equation], Initial::Rest))?;
    let stop = Stop::default();
    let guess_source = OrderGrids::new(&runs, 1, 1 << 28, &stop);
    let problem = FitProblem {
        parameter_set: &parameter_set,
        source: &runs,
        guess_source: &guess_source,
        scales: &scales,
        stop: &stop,
    };
    let settings = Settings { loss: Loss::Squares, refine: true, threads: 1 };
    let initialization = Initialization::Multistart { given_guesses: Vec::new(), candidates: None };
    let Some(joint_fit) = fit::fit(problem, initialization, settings, &|_, _| Ok(()))? else {
        println!("no start has a finite simulation");
        return Ok(());
    };
    let [alpha, a, b] = joint_fit.optimum.estimate[..] else { return Ok(()) };
    println!("D^{alpha:.4} y = {a:.3} y + {b:.3} u, with u {DELAY} s late");

    // Simulated output at the missing samples.
    let terms = vec![(0, 0.0), (1, 0.0)].into_iter().map(|(signal, order)| ftlm::equation::Term { signal, order });
    let structure = ftlm::equation::Structure { output: 0, order: alpha, terms: terms.collect() };
    let model = ftlm::equation::Equation::new(structure, vec![a, b])?;
    let simulation = OutputSimulation::new(run.into(), vec![model], Vec::new(), None)?;
    let samples = simulation.samples(8, &InitialTerms::Given(vec![Vec::new()]))?;
    println!("y from {} s on: {:.3?}", 100.0 * STEP, &samples.outputs[0][100..105]);
    Ok(())
}
