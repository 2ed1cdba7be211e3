//! Separate unit responses of a simulation, on short and on long records.

use ftlm::equation::{Equation, Structure, Term};
use ftlm::output_samples::{InitialTerms, OutputSimulation, Refinement};
use ftlm::parallel::Stop;
use ftlm::recording::{Channel, Recording, Role};
use ftlm::signal::block_pulse::Intersample;

/// D^`order` y = −2 y + 3 u with a square-wave input.
fn simulation(order: f64, rows: usize) -> OutputSimulation {
    let u = (0..rows).map(|k| if k / 20 % 2 == 0 { 1.0 } else { -1.0 }).collect();
    let u = Channel::new("u", u, Role::Input(Intersample::Hold));
    let y = Channel::new("y", vec![0.0; rows], Role::Output);
    let run = Recording::new("run", 0.05, None, vec![y, u], vec![0]).unwrap();
    let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
    let plant = Equation::new(Structure { output: 0, order, terms }, vec![-2.0, 3.0]).unwrap();
    OutputSimulation::new(run.into(), vec![plant], Vec::new(), None).unwrap()
}

#[test]
fn unit_responses_add_up_to_the_simulation() {
    let exponents = [0.0, 0.6, 1.0];
    let coefficients = [0.7, -1.3, 0.4];
    let options =
        Refinement { tolerance: 1e-6, max_pulses: 1 << 18, long_record_intervals: 1 << 12, memory: usize::MAX };
    // The second record is simulated by superposition, the last two without a grid as far as possible.
    for (order, rows) in [(0.7, 300), (0.7, 1 << 13), (1.0, 300), (1.0, 1 << 13)] {
        let simulation = simulation(order, rows);
        let separate = InitialTerms::UnitResponses { exponents: vec![exponents.to_vec()] };
        let separate = simulation.refine(&separate, options, &Stop::default()).unwrap().samples;
        assert_eq!(separate.outputs.len(), 1 + exponents.len());
        assert!(separate.initial.iter().all(Vec::is_empty));
        let given = InitialTerms::Given(vec![exponents.into_iter().zip(coefficients).collect()]);
        let whole = simulation.refine(&given, options, &Stop::default()).unwrap().samples.outputs;
        for row in 0..rows {
            let units = separate.outputs[1..].iter().zip(coefficients).map(|(response, c)| c * response[row]);
            let sum = separate.outputs[0][row] + units.sum::<f64>();
            assert!((sum - whole[0][row]).abs() < 1e-4, "order {order}, {rows} rows, row {row}: {sum}");
        }
    }
}

#[test]
fn exact_unit_responses_follow_the_rest_samples() {
    let simulation = simulation(1.0, 100);
    let separate = InitialTerms::UnitResponses { exponents: vec![vec![0.0]] };
    let separate = simulation.exact_samples(&separate, &Stop::default()).unwrap().unwrap().outputs;
    for (row, value) in separate[1].iter().enumerate() {
        assert!((value - (-0.1 * row as f64).exp()).abs() < 1e-12);
    }
}
