//! The synthetic stages with known truth: their coupled responses, and how those converge with the step.

use ftlm::equation::Equation;
use ftlm::signal::block_pulse::{point_samples, pulse_means, Intersample};
use ftlm::simulate::{nyquist_margin, respond};
use serde_json::Value;

use crate::common::{check, check_between, deviation, equation, list, number, orders, record, reference};

const SAMPLES: usize = 5000;

/// The two equations of a stage; signals: hub angle, deflection, current. `derived` adds the current's order.
fn stage(plant: &Value, derived: bool) -> Vec<Equation> {
    let names: Vec<&Value> =
        list(&plant["equations"]).iter().map(|e| &e["output"]).chain([&plant["input"]["signal"]]).collect();
    let signal = |name: &Value| names.iter().position(|n| *n == name).unwrap();
    list(&plant["equations"])
        .iter()
        .map(|e| {
            let terms: Vec<(usize, f64, f64)> = list(&e["terms"])
                .iter()
                .map(|t| (signal(&t["signal"]), number(&t["order"]), number(&t["coefficient"])))
                .map(|(s, order, c)| {
                    let eliminated = derived && s == 2 && signal(&e["output"]) == 1;
                    (s, if eliminated { number(&plant["derived_input_order"]) } else { order }, c)
                })
                .collect();
            equation(signal(&e["output"]), number(&e["alpha"]), &terms)
        })
        .collect()
}

/// Point samples of both angles at the record's own instants, simulated with `every` pulses a sample.
fn simulate_plant(plant: &Value, derived: bool, every: usize) -> Vec<Vec<f64>> {
    let input = &plant["input"];
    let (amplitude, period, step) =
        (number(&input["amplitude"]), number(&input["period"]), number(&input["sample_step"]));
    assert_eq!(input["samples"], SAMPLES);
    // Counted in samples: the edges of the square fall on them.
    let half = (period / step / 2.0).round() as usize;
    let current: Vec<f64> =
        (0..SAMPLES).map(|j| if (j / half).is_multiple_of(2) { amplitude } else { -amplitude }).collect();
    let m = (SAMPLES - 1) * every;
    let held = pulse_means(&current, m, Intersample::Hold).unwrap().into_vec();
    let record = record(step / every as f64, vec![vec![0.0; m], vec![0.0; m], held]);
    respond(&stage(plant, derived), &record, &[])
        .unwrap()
        .iter()
        .map(|means| point_samples(means).into_iter().step_by(every).collect())
        .collect()
}

/// Largest difference of two responses in units of the deviation, output by output, start and end left out.
fn differences(a: &[Vec<f64>], b: &[Vec<f64>]) -> Vec<f64> {
    a.iter()
        .zip(b)
        .map(|(a, b)| (1..SAMPLES - 1).map(|j| (a[j] - b[j]).abs()).fold(0.0, f64::max) / deviation(b))
        .collect()
}

#[test]
fn plant_a_has_the_stated_deviations() {
    let document = reference("plants");
    let plant = &document["plants"]["A"];
    for (derived, hub, deflection) in [(false, 0.297, 0.0280), (true, 0.2026, 0.01733)] {
        let y = simulate_plant(plant, derived, 8);
        check_between("sigma of theta11", deviation(&y[0]) / hub, 0.998, 1.002);
        check_between("sigma of theta12", deviation(&y[1]) / deflection, 0.998, 1.002);
    }
}

#[test]
fn plants_converge_with_the_step() {
    let document = reference("plants");
    for (name, coarsest) in [("A", 1), ("A2", 4)] {
        let plant = &document["plants"][name];
        let responses: Vec<Vec<Vec<f64>>> = (0..5).map(|k| simulate_plant(plant, false, coarsest << k)).collect();
        // Differences of neighbouring grids fall as their errors do.
        let found: Vec<Vec<f64>> = responses.windows(2).map(|p| differences(&p[0], &p[1])).collect();
        for (output, angle) in ["hub", "deflection"].into_iter().enumerate() {
            let errors: Vec<f64> = found.iter().map(|e| e[output]).collect();
            check_between(&format!("order of {name}'s {angle}"), orders(&errors)[2], 1.95, 2.05);
            check(&format!("last difference of {name}'s {angle}"), errors[3], 3e-5);
        }
    }
}

#[test]
fn the_record_step_is_short_enough_for_the_scheme() {
    // The hub pole of the second stage is as fast as the sampling, yet no mode of the scheme itself grows.
    let document = reference("plants");
    for name in ["A", "A2"] {
        for equation in stage(&document["plants"][name], false) {
            let s = &equation.structure;
            let own: Vec<(f64, f64)> = (0..s.terms.len())
                .filter(|&k| s.terms[k].signal == s.output)
                .map(|k| (equation.coefficients[k], s.integration(k)))
                .collect();
            assert!(nyquist_margin(&own, 0.002) > 0.0);
        }
    }
}
