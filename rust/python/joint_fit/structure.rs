//! Parsing of structures with named parameters from Python.

use pyo3::prelude::*;

use crate::error::Error;
use crate::estimation::joint_fit::structure::{
    Coefficient, FrictionParameters, Hints, Input, Law, Order, ParametricEquation, ParametricStructure, ParametricTerm,
};
use crate::estimation::output_error::FreeInput;
use crate::python::convert::{derived_signals, initial, DerivedArg, InitialArg, List};
use crate::python::recording::input_law;

/// Order law: (constant, [(name of the free order, weight), …]).
type OrderArg = (f64, List<(String, f64)>);
/// Coefficient with a factor: (factor, coefficient).
type NumberArg = (f64, CoefficientArg);
/// Term: (signal, order, coefficient, factor).
type TermArg = (usize, OrderArg, CoefficientArg, f64);
/// Equation: (output, order, terms, friction). The friction is None, or holds Coulomb friction, Stribeck friction and
/// Stribeck velocity.
type EquationArg = (usize, OrderArg, List<TermArg>, Option<[NumberArg; 3]>);

/// Coefficient: a name if it is free, a number if it is fixed.
#[derive(FromPyObject)]
pub enum CoefficientArg {
    Free(String),
    Fixed(f64),
}

impl From<CoefficientArg> for Coefficient {
    fn from(argument: CoefficientArg) -> Self {
        match argument {
            CoefficientArg::Free(name) => Self::Free(name),
            CoefficientArg::Fixed(value) => Self::Fixed(value),
        }
    }
}

/// Structure from a dictionary with these fields as keys.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct StructureArg {
    signals: List<String>,
    derived: List<DerivedArg>,
    equations: List<EquationArg>,
    bounds: List<(String, (f64, f64))>,
    priors: List<(String, (f64, f64))>,
    coupled: bool,
    delayed: bool,
    initial: InitialArg,
    history: bool,
    inputs: List<(String, usize, String, (f64, f64))>,
    laws: List<(String, f64, List<String>)>,
    hints: HintsArg,
}

/// Prior knowledge of orders and coefficients, from a dictionary with these fields as keys.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct HintsArg {
    highest: Option<(f64, f64)>,
    natural: List<(String, List<f64>)>,
    exceeds: List<(String, f64)>,
    positive: List<String>,
    known: List<(String, f64)>,
}

fn order((constant, weights): OrderArg) -> Order {
    Order { constant, weights: weights.into() }
}

fn friction_parameters([coulomb, stribeck, speed]: [NumberArg; 3]) -> FrictionParameters {
    let number = |(factor, coefficient): NumberArg| (factor, coefficient.into());
    FrictionParameters { coulomb: number(coulomb), stribeck: number(stribeck), speed: number(speed) }
}

/// Parse a structure. Return an error for a signal index out of range, an unknown input law, or an invalid expression.
pub fn parse_structure(argument: StructureArg) -> PyResult<ParametricStructure> {
    let term = |(signal, at, coefficient, factor): TermArg| ParametricTerm {
        signal,
        order: order(at),
        coefficient: coefficient.into(),
        factor,
    };
    let equation = |(output, at, terms, friction): EquationArg| ParametricEquation {
        output,
        order: order(at),
        terms: terms.into_iter().map(term).collect(),
        friction: friction.map(friction_parameters),
    };
    let mut inputs = Vec::new();
    for (name, signal, law, bounds) in argument.inputs {
        inputs.push(Input { name, parameter: FreeInput { signal, law: input_law(&law)?, bounds } });
    }
    let hints = argument.hints;
    let law = |(name, sign, factors): (String, f64, List<String>)| Law { name, sign, factors: factors.into() };
    let structure = ParametricStructure {
        signals: argument.signals.into(),
        derived: derived_signals(argument.derived)?,
        equations: argument.equations.into_iter().map(equation).collect(),
        bounds: argument.bounds.into_iter().collect(),
        priors: argument.priors.into_iter().collect(),
        coupled: argument.coupled,
        delayed: argument.delayed,
        initial: initial(argument.initial)?,
        history: argument.history,
        inputs,
        laws: argument.laws.into_iter().map(law).collect(),
        hints: Hints {
            highest: hints.highest,
            typical_orders: hints.natural.into_iter().map(|(name, values)| (name, values.into())).collect(),
            ratio_lower_bounds: hints.exceeds.into_iter().collect(),
            positive: hints.positive.into_iter().collect(),
            physical_values: hints.known.into_iter().collect(),
        },
    };
    let signals = structure.signals.len();
    let missing =
        structure.equations.iter().flat_map(|e| std::iter::once(e.output).chain(e.terms.iter().map(|t| t.signal)));
    if let Some(signal) = missing.chain(structure.inputs.iter().map(|i| i.parameter.signal)).find(|&s| s >= signals) {
        let what = format!("signal {signal} of {signals}");
        return Err(Error::Structure { what, remedy: "number them from 0".into() }.into());
    }
    Ok(structure)
}
