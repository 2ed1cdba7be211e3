//! Bindings of simulation with friction.

use numpy::PyArray2;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::convert::{record, stack_rows, structure, to_vectors, List, RecordArg, StructureArg};
use crate::equation::Equation;
use crate::friction::law::Phase;
use crate::friction::FrictionLaw;
use crate::nonlinear::{BodyMotion, NonlinearSystem};
use crate::python::order_search::watch::run_interruptible;

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
        .map(|(equation, (coulomb, stribeck, speed))| (equation, FrictionLaw { coulomb, stribeck, speed }))
        .collect();
    let equations = equations
        .into_iter()
        .map(|(arg, coefficients)| {
            let structure = structure(arg, record.len(), &inputs)?;
            Ok(Equation { structure, coefficients: coefficients.into() })
        })
        .collect::<PyResult<_>>()?;
    let system = NonlinearSystem::with_friction(equations, frictions, record.len());
    let motion = run_interruptible(py, record.m(), None, move |_| system.run(&record, &to_vectors(terms)))?;
    let dict = PyDict::new(py);
    dict.set_item("outputs", stack_rows(py, &motion.outputs)?)?;
    let rows =
        |field: fn(&BodyMotion) -> &Vec<f64>| motion.bodies.iter().map(|body| field(body).clone()).collect::<Vec<_>>();
    dict.set_item("velocity", stack_rows(py, &rows(|body| &body.velocity))?)?;
    dict.set_item("force", stack_rows(py, &rows(|body| &body.force))?)?;
    let stuck: Vec<Vec<bool>> =
        (motion.bodies.iter()).map(|body| body.phases.iter().map(|phase| *phase == Phase::Stick).collect()).collect();
    dict.set_item("stuck", PyArray2::from_vec2(py, &stuck)?)?;
    Ok(dict)
}
