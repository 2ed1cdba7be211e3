//! Parameters of equations with non-linear terms: residuals of all experiments and their derivatives.

use super::channels::{ForcingTerms, Moves};
use super::march::{refuse_beside, FreeRun, FrozenProducts, NonlinearSystem, Operators};
use crate::equation::{Equation, Structure, Term};
use crate::error::{check_length, Error, Result};
use crate::estimation::optimization::levenberg_marquardt::MinimizationSettings;
use crate::estimation::output_error::{Coordinate, Experiment, FreeEquation, FreeInput, FreeModel};
use crate::estimation::state_fit::{self, Evaluation, Parameter, Point, Start, StateFit, StateModel};
use crate::expression::DerivedSignal;
use crate::friction::initial_state::{merge_powers, State};
use crate::friction::model::state_guesses;
use crate::friction::FreeFrictionLaw;
use crate::parallel::Stop;
use crate::regressors::{add_impulses, split_impulses, Record};

/// Model with free parameters and non-linear terms.
#[derive(Debug, Clone, PartialEq)]
pub struct NonlinearModel {
    /// Equations over recorded signals and, after these, derived ones.
    pub model: FreeModel,
    /// Expressions of the derived signals, which follow the recorded ones.
    pub derived: Vec<DerivedSignal>,
    /// Equations with dry friction, and F of − F(Dy) sgn(Dy).
    pub frictions: Vec<(usize, FreeFrictionLaw)>,
    /// Outputs that pass the filter of every experiment before the comparison. Empty if none does.
    pub filtered: Vec<bool>,
}

/// Step of central differences of initial terms, which are smooth in orders and at most quadratic in coefficients.
const DIFFERENCE_STEP: f64 = 1e-5;

/// Least-squares fit with weights of the output error from an initial guess.
///
/// # Errors
/// An initial guess whose simulation ends ([`Error::Diverged`], [`Error::NoSolution`]), an inconsistent model or
/// experiments that do not fit it; [`Error::Interrupted`].
pub fn fit(
    model: &NonlinearModel,
    experiments: &[Experiment],
    start: &Start,
    settings: MinimizationSettings,
    stop: &Stop,
) -> Result<StateFit> {
    state_fit::fit(model, experiments, start, settings, stop)
}

/// Intermediate results of an experiment.
pub(crate) struct Part {
    system: NonlinearSystem,
    record: Option<Record>,
    operators: Operators,
    run: FreeRun,
    /// Derivatives of the means of each input with respect to its free parameter.
    input_slopes: Vec<Vec<f64>>,
}

impl NonlinearModel {
    fn system(&self, orders: &[f64], coefficients: &[f64], recorded: usize) -> NonlinearSystem {
        let at = |law: &crate::equation::AffineOrder| {
            law.constant + law.weights.iter().zip(orders).map(|(w, x)| w * x).sum::<f64>()
        };
        let of = |equation: &FreeEquation| Equation {
            structure: Structure {
                output: equation.output,
                order: at(&equation.order),
                terms: equation.terms.iter().map(|(s, o, _)| Term { signal: *s, order: at(o) }).collect(),
            },
            coefficients: equation.terms.iter().map(|t| t.2.at(coefficients)).collect(),
        };
        NonlinearSystem {
            equations: self.model.equations.iter().map(of).collect(),
            derived: self.derived.clone(),
            recorded,
            coupled: self.model.coupled || !self.frictions.is_empty(),
            frictions: self.frictions.iter().map(|(place, law)| (*place, law.at(coefficients))).collect(),
        }
    }

    fn states(&self, orders: &[f64]) -> (Vec<State>, Vec<Equation>) {
        let moves = |i: usize, term: usize| {
            let alpha = &self.model.equations[i].order.weights;
            let own = &self.model.equations[i].terms[term].1.weights;
            alpha.iter().zip(own).any(|(a, w)| (a - w).abs() > 0.0)
        };
        let equations = self.system(orders, &vec![0.0; self.model.coordinates.len()], 0).equations;
        (State::all(&equations, &self.model.initial, &self.filtered, moves), equations)
    }

    /// Forcing by the initial states of a run.
    fn initial_forcing(
        &self,
        operators: &Operators,
        (orders, coefficients, values): (&[f64], &[f64], &[f64]),
    ) -> Result<ForcingTerms> {
        let (powers, _) = split_impulses(&self.powers(orders, coefficients, values));
        operators.initial_forcing(&self.system(orders, coefficients, usize::MAX), &powers)
    }

    /// Derivatives of the system with respect to a parameter.
    fn moves(&self, point: &Point, run: usize, part: &Part, moved: &Parameter) -> Result<Moves> {
        let (values, equations) = (&point.states[run], &self.model.equations);
        let mut moves = Moves {
            terms: equations.iter().map(|e| vec![(0.0, 0.0); e.terms.len() + 1]).collect(),
            forcing: ForcingTerms::default(),
            laws: Vec::new(),
            inputs: Vec::new(),
        };
        let difference = |at: &dyn Fn(f64) -> (Vec<f64>, Vec<f64>), by: f64| -> Result<ForcingTerms> {
            let side = |by: f64| {
                let (orders, coefficients) = at(by);
                self.initial_forcing(&part.operators, (&orders, &coefficients, values))
            };
            let (mut up, down) = (side(by)?, side(-by)?);
            let slope = |up: &mut f64, down: f64| *up = (*up - down) / (2.0 * by);
            for (up, down) in up.channels.iter_mut().zip(down.channels) {
                up.iter_mut().zip(down).for_each(|(up, down)| slope(up, down));
            }
            for (up, down) in up.starts.iter_mut().zip(down.starts) {
                slope(&mut up.0, down.0);
                slope(&mut up.1, down.1);
            }
            Ok(up)
        };
        let idle = values.iter().all(|x| *x == 0.0);
        match *moved {
            Parameter::Order(j) => {
                let of = |weights: &[f64]| weights.get(j).copied().unwrap_or(0.0);
                for (terms, equation) in moves.terms.iter_mut().zip(equations) {
                    let alpha = of(&equation.order.weights);
                    let orders = equation.terms.iter().map(|t| alpha - of(&t.1.weights)).chain([alpha]);
                    *terms = orders.map(|order| (0.0, order)).collect();
                }
                if !idle {
                    let shifted = |by: f64| {
                        let mut orders = point.orders.clone();
                        orders[j] += by;
                        (orders, point.coefficients.clone())
                    };
                    moves.forcing = difference(&shifted, DIFFERENCE_STEP)?;
                }
            }
            Parameter::Coefficient(j) => {
                for (terms, equation) in moves.terms.iter_mut().zip(equations) {
                    let coefficients = equation.terms.iter().map(|t| t.2.slope(&point.coefficients, j)).chain([0.0]);
                    *terms = coefficients.map(|coefficient| (coefficient, 0.0)).collect();
                }
                moves.laws = self.frictions.iter().map(|(_, law)| law.slope(&point.coefficients, j)).collect();
                if !idle {
                    let by = DIFFERENCE_STEP * point.coefficients[j].abs().max(1.0);
                    let shifted = |by: f64| {
                        let mut coefficients = point.coefficients.clone();
                        coefficients[j] += by;
                        (point.orders.clone(), coefficients)
                    };
                    moves.forcing = difference(&shifted, by)?;
                }
            }
            Parameter::State(_, state) => {
                let unit: Vec<f64> = (0..values.len()).map(|k| if k == state { 1.0 } else { 0.0 }).collect();
                let at = (point.orders.as_slice(), point.coefficients.as_slice(), unit.as_slice());
                moves.forcing = self.initial_forcing(&part.operators, at)?;
            }
            Parameter::Input(k) => moves.inputs.push((self.model.inputs[k].signal, part.input_slopes[k].clone())),
        }
        Ok(moves)
    }

    /// Record with transformed inputs, and their derivatives in the free parameters. None without free inputs.
    fn transform_inputs(&self, record: &Record, values: &[f64]) -> Result<(Option<Record>, Vec<Vec<f64>>)> {
        if self.model.inputs.is_empty() {
            return Ok((None, Vec::new()));
        }
        let mut signals: Vec<Vec<f64>> = (0..record.len()).map(|s| record.signal(s).to_vec()).collect();
        let mut slopes = Vec::with_capacity(self.model.inputs.len());
        for (&input, &value) in self.model.inputs.iter().zip(values) {
            let (means, slope) = self.model.apply_input_law(record, input, value)?;
            signals[input.signal] = means;
            slopes.push(slope);
        }
        Ok((Some(Record::from_rows(record.step(), signals, None)?), slopes))
    }
}

impl StateModel for NonlinearModel {
    type Part = Part;

    fn order_bounds(&self) -> &[(f64, f64)] {
        &self.model.order_bounds
    }

    fn coordinates(&self) -> &[Coordinate] {
        &self.model.coordinates
    }

    fn inputs(&self) -> &[FreeInput] {
        &self.model.inputs
    }

    /// Friction forces are not negative.
    fn is_nonnegative(&self, coefficient: usize) -> bool {
        self.frictions.iter().any(|(_, law)| law.is_force(coefficient))
    }

    /// Times at which a body stops or reverses move from pulse to pulse with any parameter.
    fn has_kinks(&self) -> bool {
        !self.frictions.is_empty()
    }

    fn check(&self, experiments: &[Experiment]) -> Result<()> {
        let Some(recorded) = experiments.iter().map(|e| e.record.len()).min() else {
            return Err(Error::Length { name: "experiments".into(), expected: 1, found: 0 });
        };
        let signals = recorded + self.derived.len();
        let missing = |e: &FreeEquation| e.output >= recorded || e.terms.iter().any(|t| t.0 >= signals);
        let lost = self.derived.iter().flat_map(|d| &d.channels).any(|(signal, _)| *signal >= recorded);
        if lost || self.model.equations.iter().any(missing) {
            let what = "an equation names a signal that is not there".to_owned();
            return Err(Error::Structure { what, remedy: "number them from 0".into() });
        }
        for experiment in experiments {
            experiment.check()?;
            check_length("outputs", self.model.equations.len(), experiment.samples.len())?;
            if experiment.nonuniform.is_some() {
                return Err(refuse_beside("samples at times of their own", "resample the runs"));
            }
            let passes = experiment.filter.as_ref().map_or(&[][..], |(_, applies)| applies);
            if passes != self.filtered {
                return Err(refuse_beside("experiments with different filters", "give all runs the same filter"));
            }
        }
        self.model.initial.check()
    }

    fn check_orders(&self, orders: &[f64]) -> Result<()> {
        let system = self.system(orders, &vec![0.0; self.model.coordinates.len()], usize::MAX);
        system.equations.iter().try_for_each(|e| e.structure.check(usize::MAX, |_| true))
    }

    fn state_guesses(&self, orders: &[f64], coefficients: &[f64], experiment: &Experiment) -> Vec<Vec<f64>> {
        let frictions = self.system(orders, coefficients, usize::MAX).frictions;
        state_guesses(&self.states(orders), &frictions, experiment)
    }

    fn state_count(&self, orders: &[f64]) -> usize {
        self.states(orders).0.len()
    }

    fn powers(&self, orders: &[f64], coefficients: &[f64], values: &[f64]) -> Vec<Vec<(f64, f64)>> {
        let system = self.system(orders, coefficients, usize::MAX);
        let links = system.links();
        let (states, _) = self.states(orders);
        let parts = states.iter().zip(values).flat_map(|(state, &x)| {
            state.powers(&system.equations, &links).into_iter().map(move |(i, e, c)| (i, e, x * c))
        });
        merge_powers(system.equations.len(), parts)
    }

    fn evaluate(&self, experiments: &[Experiment], point: &Point, stop: &Stop) -> Result<Evaluation<Part>> {
        let mut out = Evaluation::empty();
        for (experiment, values) in experiments.iter().zip(&point.states) {
            stop.check()?;
            let (acting, input_slopes) = self.transform_inputs(&experiment.record, &point.inputs)?;
            let record = acting.as_ref().unwrap_or(&experiment.record);
            let system = self.system(&point.orders, &point.coefficients, record.len());
            // Same error as for a step that is too long, so that an optimizer shortens it.
            let far = |_| Error::Diverged { what: "orders out of range; the free run".into(), index: 0 };
            system.check().map_err(far)?;
            let operators = Operators::new(&system, record)?;
            let mut forcing = self.initial_forcing(&operators, (&point.orders, &point.coefficients, values))?;
            operators.add_inputs(&system, record, &mut forcing);
            let (run, end) = operators.run(&system, &forcing);
            if let Some(end) = end {
                return Err(end.error(record.step()));
            }
            let mut residuals = experiment.measured_samples();
            out.size = out.size.hypot(residuals.iter().map(|v| v * v).sum::<f64>().sqrt());
            let mut outputs = run.sources[..system.equations.len()].to_vec();
            let (_, impulses) = split_impulses(&self.powers(&point.orders, &point.coefficients, values));
            add_impulses(&mut outputs, &impulses, record.step());
            let sampled = experiment.weighted_samples(&outputs);
            residuals.iter_mut().zip(sampled).for_each(|(e, v)| *e -= v);
            if let Some(index) = residuals.iter().position(|e| !e.is_finite()) {
                return Err(Error::Diverged { what: "free run".into(), index });
            }
            out.residuals.extend(residuals);
            out.parts.push(Part { system, record: acting, operators, run, input_slopes });
        }
        Ok(out)
    }

    fn jacobian(
        &self,
        experiments: &[Experiment],
        point: &Point,
        at: &Evaluation<Part>,
        numbers: bool,
        stop: &Stop,
    ) -> Result<Vec<Vec<f64>>> {
        let all = Parameter::all(point, numbers);
        let states = self.states(&point.orders).0;
        let mut columns = vec![Vec::with_capacity(at.residuals.len()); all.len()];
        for (index, (experiment, part)) in experiments.iter().zip(&at.parts).enumerate() {
            let record = part.record.as_ref().unwrap_or(&experiment.record);
            let mut frozen = FrozenProducts::new(&part.operators, &part.run);
            for (column, moved) in columns.iter_mut().zip(&all) {
                if matches!(moved, Parameter::State(run, _) if *run != index) {
                    column.extend(std::iter::repeat_n(0.0, self.model.equations.len() * experiment.compared_count()));
                    continue;
                }
                stop.check()?;
                let slopes = match moved {
                    Parameter::State(_, state) if states[*state].is_impulse() => {
                        // A filter transient does not enter the equations.
                        let mut slopes = vec![vec![0.0; record.m()]; self.model.equations.len()];
                        let mut own = vec![Vec::new(); self.model.equations.len()];
                        if let State::Power(i, e) = states[*state] {
                            own[i].push((e, 1.0));
                        }
                        add_impulses(&mut slopes, &own, record.step());
                        slopes
                    }
                    _ => {
                        let moves = self.moves(point, index, part, moved)?;
                        part.operators.sensitivity(&part.system, record, &part.run, &mut frozen, &moves)?
                    }
                };
                // Residuals are measurement minus response.
                column.extend(experiment.weighted_samples(&slopes).into_iter().map(|v| -v));
            }
        }
        if columns.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "sensitivity of the free run".into(), index: 0 });
        }
        Ok(columns)
    }
}
