//! Bindings of simulation and output-error fit with friction.

use numpy::{PyArray1, PyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::convert::{initial, record, stack_rows, structure, to_vectors, InitialArg, List, RecordArg, StructureArg};
use super::estimation::{
    coordinates, count_evaluated_pulses, experiment, free_equation, free_inputs, status, ExperimentArg,
    FreeEquationArg, FreeInputArg, MonomialArg,
};
use crate::equation::Equation;
use crate::estimation::output_error as joint;
use crate::friction::contact::Trace;
use crate::friction::law::Phase;
use crate::friction::{self, Body, FreeFrictionLaw, FrictionLaw, FrictionModel, Start};
use crate::python::order_search::watch::{run_interruptible, Stop};

#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn friction_respond<'py>(
    py: Python<'py>,
    run: RecordArg<'py>,
    equations: List<(StructureArg, List<f64>)>,
    frictions: List<(usize, (f64, f64, f64))>,
    terms: List<List<(f64, f64)>>,
) -> PyResult<Bound<'py, PyDict>> {
    let record = record(&run)?;
    let inputs = vec![true; record.len()];
    let frictions = frictions
        .into_iter()
        .map(|(place, (coulomb, stribeck, speed))| (place, FrictionLaw { coulomb, stribeck, speed }))
        .collect();
    let equations = equations
        .into_iter()
        .map(|(arg, coefficients)| {
            let structure = structure(arg, record.len(), &inputs)?;
            Ok(Equation { structure, coefficients: coefficients.into() })
        })
        .collect::<PyResult<_>>()?;
    let body = Body { equations, frictions };
    let motion = run_interruptible(py, record.m(), None, move |_| body.run(&record, &to_vectors(terms)))?;
    let dict = PyDict::new(py);
    dict.set_item("outputs", stack_rows(py, &motion.outputs)?)?;
    let rows = |of: fn(&Trace) -> &Vec<f64>| motion.bodies.iter().map(|body| of(body).clone()).collect::<Vec<_>>();
    dict.set_item("velocity", stack_rows(py, &rows(|body| &body.edges))?)?;
    dict.set_item("force", stack_rows(py, &rows(|body| &body.force))?)?;
    let stuck: Vec<Vec<bool>> =
        (motion.bodies.iter()).map(|body| body.phases.iter().map(|phase| *phase == Phase::Stick).collect()).collect();
    dict.set_item("stuck", PyArray2::from_vec2(py, &stuck)?)?;
    Ok(dict)
}

/// Friction of one equation: (equation, fc, fs and vs).
pub type FrictionArg = (usize, [MonomialArg; 3]);

/// Friction laws with free parameters.
pub fn free_laws(frictions: List<FrictionArg>) -> Vec<(usize, FreeFrictionLaw)> {
    let law = |(place, numbers): FrictionArg| {
        let [coulomb, stribeck, speed] =
            numbers.map(|(factor, powers)| joint::Monomial { factor, powers: powers.into() });
        (place, FreeFrictionLaw { coulomb, stribeck, speed })
    };
    frictions.into_iter().map(law).collect()
}

#[pyfunction]
#[pyo3(signature = (
    runs, laws, frictions, order_bounds, names, terms, orders, coefficients, inputs, states, evaluations,
    tolerance, stop=None,
))]
#[allow(clippy::too_many_arguments, clippy::needless_pass_by_value)]
pub fn friction_error<'py>(
    py: Python<'py>,
    runs: List<ExperimentArg<'py>>,
    laws: List<FreeEquationArg>,
    frictions: List<FrictionArg>,
    order_bounds: List<(f64, f64)>,
    names: List<String>,
    terms: InitialArg,
    orders: List<f64>,
    coefficients: List<f64>,
    inputs: List<FreeInputArg>,
    states: List<List<f64>>,
    evaluations: usize,
    tolerance: f64,
    stop: Option<&Stop>,
) -> PyResult<Bound<'py, PyDict>> {
    let experiments = runs.iter().map(experiment).collect::<PyResult<Vec<_>>>()?;
    let model = FrictionModel {
        equations: laws.into_iter().map(free_equation).collect(),
        frictions: free_laws(frictions),
        inputs: free_inputs(&inputs)?,
        order_bounds: order_bounds.into(),
        coordinates: coordinates(&names)?,
        initial: initial(terms)?,
        filtered: friction::filtered_outputs(&experiments),
    };
    let start = Start {
        orders: orders.into(),
        coefficients: coefficients.into(),
        inputs: inputs.iter().map(|input| input.3).collect(),
        states: to_vectors(states),
    };
    let settings = joint::Settings { evaluations, tolerance };
    let points = count_evaluated_pulses(&experiments, evaluations);
    let fit = run_interruptible(py, points, stop, move |stop| {
        friction::fit_until(&model, &experiments, &start, settings, stop)
    })?;
    let dict = PyDict::new(py);
    dict.set_item("orders", fit.orders)?;
    dict.set_item("coefficients", fit.coefficients)?;
    dict.set_item("inputs", fit.inputs)?;
    dict.set_item("states", fit.states.clone())?;
    dict.set_item("initial", fit.states.into_iter().map(|states| vec![states]).collect::<Vec<_>>())?;
    dict.set_item("powers", fit.initial)?;
    dict.set_item("cost", fit.cost)?;
    dict.set_item("residuals", PyArray1::from_vec(py, fit.residuals))?;
    let samples = fit.jacobian.first().map_or(0, Vec::len);
    let none = fit.jacobian.is_empty() || samples == 0;
    dict.set_item("jacobian", if none { None } else { Some(stack_rows(py, &fit.jacobian)?) })?;
    dict.set_item("evaluations", fit.evaluations)?;
    dict.set_item("status", status(fit.status))?;
    Ok(dict)
}
