//! Parameters of bodies with friction: residuals of all experiments and their derivatives.

use super::convolution::{product, IntegratedSignal};
use super::dynamics::{remove_creep, Body, Operators, Run};
use super::initial_state::{merge_powers, InitialForcing, State};
use super::law::FrictionLaw;
use crate::equation::{Equation, Initial, Structure, Term};
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::{Coordinate, Experiment, FreeEquation, FreeInput, InputLaw, Monomial};
use crate::estimation::state_fit::{Evaluation, Parameter, Point, StateModel};
use crate::parallel::Stop;
use crate::regressors::{add_impulses, split_impulses, Record};
use crate::series::Kernel;

/// Friction law with free parameters, each a multiple of one coefficient.
#[derive(Debug, Clone, PartialEq)]
pub struct FreeFrictionLaw {
    /// fc.
    pub coulomb: Monomial,
    /// fs.
    pub stribeck: Monomial,
    /// vs.
    pub speed: Monomial,
}

impl FreeFrictionLaw {
    /// Friction that does not depend on speed.
    #[must_use]
    pub fn coulomb(coulomb: Monomial) -> Self {
        let known = |factor: f64| Monomial { factor, powers: Vec::new() };
        Self { coulomb, stribeck: known(0.0), speed: known(1.0) }
    }

    fn numbers(&self) -> [&Monomial; 3] {
        [&self.coulomb, &self.stribeck, &self.speed]
    }

    /// Law at these coefficients.
    pub(crate) fn at(&self, coefficients: &[f64]) -> FrictionLaw {
        let [coulomb, stribeck, speed] = self.numbers().map(|number| number.at(coefficients));
        FrictionLaw { coulomb, stribeck, speed }
    }

    /// Derivatives of fc, fs and vs with respect to a coefficient.
    pub(crate) fn slope(&self, coefficients: &[f64], coefficient: usize) -> [f64; 3] {
        self.numbers().map(|number| number.slope(coefficients, coefficient))
    }

    /// Whether a coefficient is a force of this law, which must not be negative.
    pub(crate) fn is_force(&self, coefficient: usize) -> bool {
        [&self.coulomb, &self.stribeck].iter().any(|number| number.powers.iter().any(|&(i, _)| i == coefficient))
    }
}

/// Outputs that pass a filter before the comparison.
#[must_use]
pub fn filtered_outputs(experiments: &[Experiment]) -> Vec<bool> {
    experiments.first().and_then(|e| e.filter.as_ref()).map_or_else(Vec::new, |(_, passes)| passes.clone())
}

/// Model with free parameters: coupled equations, some with friction of their own output's velocity.
#[derive(Debug, Clone, PartialEq)]
pub struct FrictionModel {
    /// Linear equations.
    pub equations: Vec<FreeEquation>,
    /// Equations with friction, and F of − F(Dy) sgn(Dy).
    pub frictions: Vec<(usize, FreeFrictionLaw)>,
    /// Free parameters of inputs, at most one an input.
    pub inputs: Vec<FreeInput>,
    /// Bounds of each free order.
    pub order_bounds: Vec<(f64, f64)>,
    /// Coordinate of each free coefficient.
    pub coordinates: Vec<Coordinate>,
    /// Initial terms of each record, offsets, and filter transients of filtered outputs.
    pub initial: Initial,
    /// Outputs that pass the filter of every experiment before the comparison. Empty if none does.
    pub filtered: Vec<bool>,
}

/// Intermediate results of an experiment.
pub(crate) struct Part {
    operators: Operators,
    run: Run,
    /// Derivatives of the means of each input with respect to its free parameter.
    input_slopes: Vec<Vec<f64>>,
}

/// Samples for the initial velocity of a run.
const FIRST_SAMPLES: usize = 8;

/// Step of central differences. Powers of t are smooth in the orders, so the error is about 1e−10.
const DIFFERENCE_STEP: f64 = 1e-5;

/// Constant forces tried as initial guesses, relative to each friction. The rest position depends on the sign of the
/// net force, which a local optimization does not change.
const INITIAL_FORCE_RATIOS: [f64; 2] = [0.5, -0.5];

impl FrictionModel {
    /// Return an error for an inconsistent model, or for experiments that do not fit it.
    ///
    /// # Errors
    /// [`Error::Structure`], [`Error::Length`]; as [`AffineOrder::check`](crate::equation::AffineOrder::check).
    pub fn check(&self, experiments: &[Experiment]) -> Result<()> {
        let refuse = |what: &str, remedy: &str| Err(Error::Structure { what: what.into(), remedy: remedy.into() });
        let Some(signals) = experiments.iter().map(|e| e.record.len()).min() else {
            return Err(Error::Length { name: "experiments".into(), expected: 1, found: 0 });
        };
        let known = |c: &Monomial| c.powers.iter().all(|&(i, _)| i < self.coordinates.len());
        if self.frictions.is_empty() || self.frictions.iter().any(|f| f.0 >= self.equations.len()) {
            return refuse("friction stands in an equation that is not there", "number them from 0");
        }
        for FreeEquation { output, terms, .. } in &self.equations {
            if *output >= signals || terms.iter().any(|t| t.0 >= signals || !known(&t.2)) {
                return refuse("an equation names a signal or a coefficient that is not there", "number them from 0");
            }
        }
        let mut numbers = self.frictions.iter().flat_map(|(_, law)| law.numbers());
        if numbers.any(|n| !known(n) || n.powers.len() > 1 || n.factor < 0.0) {
            return refuse("friction is no multiple of one free coefficient", "give it one that is not negative");
        }
        for (k, &FreeInput { signal, law, bounds: (low, high) }) in self.inputs.iter().enumerate() {
            if signal >= signals || self.equations.iter().any(|e| e.output == signal) {
                return refuse("a free limit of what is no input", "limit inputs only");
            }
            if self.inputs[..k].iter().any(|i| i.signal == signal) {
                return refuse("two free numbers of an input beside friction", "give one of them");
            }
            let is_in_range = low.is_finite() && (low >= 0.0 || law == InputLaw::Delay);
            if !(is_in_range && low <= high && high.is_finite()) {
                return refuse(
                    "bounds of a delay or limit that do not rise",
                    "give two rising values, of a limit from 0",
                );
            }
        }
        if self.order_bounds.iter().any(|(low, high)| low.is_nan() || high.is_nan() || low > high) {
            return refuse("bounds of an order that do not rise", "give two rising orders");
        }
        for equation in &self.equations {
            for order in equation.terms.iter().map(|t| &t.1).chain([&equation.order]) {
                order.check(&self.order_bounds)?;
            }
        }
        for experiment in experiments {
            experiment.check()?;
            check_length("outputs", self.equations.len(), experiment.samples.len())?;
            if experiment.nonuniform.is_some() {
                return refuse("friction with samples at times of their own", "leave them out");
            }
            let passes = experiment.filter.as_ref().map_or(&[][..], |(_, applies)| applies);
            if passes != self.filtered {
                return refuse("experiments whose outputs pass other filters than the model's", "give them all alike");
            }
        }
        self.initial.check()
    }

    fn body(&self, orders: &[f64], coefficients: &[f64]) -> Body {
        let at = |law: &crate::equation::AffineOrder| {
            law.constant + law.weights.iter().zip(orders).map(|(w, x)| w * x).sum::<f64>()
        };
        let of = |equation: &FreeEquation| Equation {
            structure: Structure {
                output: equation.output,
                order: at(&equation.order),
                terms: (equation.terms.iter()).map(|(s, o, _)| Term { signal: *s, order: at(o) }).collect(),
            },
            coefficients: equation.terms.iter().map(|t| t.2.at(coefficients)).collect(),
        };
        Body {
            equations: self.equations.iter().map(of).collect(),
            frictions: self.frictions.iter().map(|(place, law)| (*place, law.at(coefficients))).collect(),
        }
    }

    /// States of every run at these orders, and the equations with zero coefficients.
    fn states(&self, orders: &[f64]) -> (Vec<State>, Vec<Equation>) {
        let moves = |i: usize, term: usize| {
            let alpha = &self.equations[i].order.weights;
            let own = &self.equations[i].terms[term].1.weights;
            alpha.iter().zip(own).any(|(a, w)| (a - w).abs() > 0.0)
        };
        let body = self.body(orders, &vec![0.0; self.coordinates.len()]);
        (State::all(&body.equations, &self.initial, &self.filtered, moves), body.equations)
    }

    /// Initial terms of a run's states by equation: (exponent, coefficient).
    fn initial_powers(&self, orders: &[f64], coefficients: &[f64], values: &[f64]) -> Vec<Vec<(f64, f64)>> {
        let body = self.body(orders, coefficients);
        let links = body.links();
        let (states, _) = self.states(orders);
        let parts = states.iter().zip(values).flat_map(|(state, &x)| {
            state.powers(&body.equations, &links).into_iter().map(move |(i, e, c)| (i, e, x * c))
        });
        merge_powers(body.equations.len(), parts)
    }

    fn initial_forcing(
        &self,
        orders: &[f64],
        coefficients: &[f64],
        values: &[f64],
        record: &Record,
    ) -> Result<InitialForcing> {
        let body = self.body(orders, coefficients);
        let (powers, _) = split_impulses(&self.initial_powers(orders, coefficients, values));
        InitialForcing::of(&powers, &body.links(), record.m(), record.step())
    }

    /// Record with transformed inputs, and their derivatives in the free parameters. None without free inputs.
    fn transform_inputs(&self, record: &Record, values: &[f64]) -> Result<(Option<Record>, Vec<Vec<f64>>)> {
        if self.inputs.is_empty() {
            return Ok((None, Vec::new()));
        }
        let mut signals: Vec<Vec<f64>> = (0..record.len()).map(|s| record.signal(s).to_vec()).collect();
        let mut bent = Vec::with_capacity(self.inputs.len());
        for (input, &value) in self.inputs.iter().zip(values) {
            let means = &signals[input.signal];
            let before = if self.initial.is_at_rest() { 0.0 } else { means.first().copied().unwrap_or(0.0) };
            let (means, slope) = input.law.apply(means, value, record.step(), before)?;
            signals[input.signal] = means;
            bent.push(slope);
        }
        Ok((Some(Record::from_rows(record.step(), signals, None)?), bent))
    }

    fn simulate(&self, experiments: &[Experiment], point: &Point, stop: &Stop) -> Result<Evaluation<Part>> {
        let body = self.body(&point.orders, &point.coefficients);
        // Same error as for a step that is too long, so that an optimizer shortens it.
        let far = |_| Error::Diverged { what: "orders or friction out of range; the free run".into(), index: 0 };
        body.check(usize::MAX).map_err(far)?;
        let mut out = Evaluation::empty();
        for (experiment, values) in experiments.iter().zip(&point.states) {
            stop.check()?;
            let (acting, bent) = self.transform_inputs(&experiment.record, &point.inputs)?;
            let operators = Operators::new(&body, acting.as_ref().unwrap_or(&experiment.record))?;
            let forcing = self.initial_forcing(&point.orders, &point.coefficients, values, &experiment.record)?;
            let run = Run::new(&body, &operators, &forcing)?;
            let mut residuals = experiment.measured_samples();
            out.size = out.size.hypot(residuals.iter().map(|v| v * v).sum::<f64>().sqrt());
            let mut outputs = run.outputs.clone();
            let (_, impulses) = split_impulses(&self.initial_powers(&point.orders, &point.coefficients, values));
            add_impulses(&mut outputs, &impulses, experiment.record.step());
            let sampled = experiment.weighted_samples(&outputs);
            residuals.iter_mut().zip(sampled).for_each(|(e, v)| *e -= v);
            out.residuals.extend(residuals);
            out.parts.push(Part { operators, run, input_slopes: bent });
        }
        Ok(out)
    }

    fn derivatives(
        &self,
        experiments: &[Experiment],
        point: &Point,
        at: &Evaluation<Part>,
        numbers: bool,
        stop: &Stop,
    ) -> Result<Vec<Vec<f64>>> {
        let all = Parameter::all(point, numbers);
        let body = self.body(&point.orders, &point.coefficients);
        let mut columns = vec![Vec::with_capacity(at.residuals.len()); all.len()];
        for (index, (experiment, part)) in experiments.iter().zip(&at.parts).enumerate() {
            let spectra = Spectra::new(part, &body.friction_equations());
            for (column, moved) in columns.iter_mut().zip(&all) {
                if matches!(moved, Parameter::State(run, _) if *run != index) {
                    column.extend(std::iter::repeat_n(0.0, self.equations.len() * experiment.compared_count()));
                    continue;
                }
                stop.check()?;
                let slopes = self.slopes(&body, experiment, part, &spectra, point, index, moved)?;
                // Residuals are measurement minus response.
                column.extend(experiment.weighted_samples(&slopes).into_iter().map(|v| -v));
            }
        }
        if columns.iter().flatten().any(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "sensitivity of the free run".into(), index: 0 });
        }
        Ok(columns)
    }

    /// Derivatives of the outputs' means with respect to one parameter.
    #[allow(clippy::too_many_arguments)]
    fn slopes(
        &self,
        body: &Body,
        experiment: &Experiment,
        part: &Part,
        spectra: &Spectra,
        point: &Point,
        run: usize,
        moved: &Parameter,
    ) -> Result<Vec<Vec<f64>>> {
        let (operators, motion, record) = (&part.operators, &part.run, &experiment.record);
        if let Parameter::State(_, state) = *moved
            && let Some(State::Power(i, e)) = self.states(&point.orders).0.get(state).filter(|s| s.is_impulse())
        {
            // A filter transient does not move a body.
            let mut slopes = vec![vec![0.0; record.m()]; self.equations.len()];
            let mut own = vec![Vec::new(); self.equations.len()];
            own[*i].push((*e, 1.0));
            add_impulses(&mut slopes, &own, record.step());
            return Ok(slopes);
        }
        let BodyDerivatives { alphas, terms: moves, frictions } = self.moves(point, moved);
        let mut total = self.forcing_slope(point, &point.states[run], record, moved)?;
        let mut add = |i: usize, weight: f64, part: &IntegratedSignal| {
            if weight != 0.0 {
                total.add_to(i, weight, part);
            }
        };
        for (i, equation) in body.equations.iter().enumerate() {
            for (k, (&(dc, deta), &c)) in moves[i].iter().zip(&equation.coefficients).enumerate() {
                let signal = equation.structure.terms[k].signal;
                if let (Some(driven), Some((driver, spectrum))) =
                    (&operators.integrated_inputs[i][k], &operators.drivers[i][k])
                {
                    add(i, dc, driven);
                    if deta != 0.0 {
                        add(i, c * deta, &driver.of(spectrum, 1));
                    }
                    if let Parameter::Input(input) = moved
                        && signal == self.inputs[*input].signal
                    {
                        add(i, c, &driver.of(&Kernel::new(&part.input_slopes[*input]), 0));
                    }
                }
                if let (Some(kernels), Some(j)) = (&operators.own[i][k], body.place(signal)) {
                    if dc != 0.0 {
                        add(i, dc, &spectra.own(j, kernels, 0));
                    }
                    if deta != 0.0 {
                        add(i, c * deta, &spectra.own(j, kernels, 1));
                    }
                }
            }
        }
        let sticks = body.friction_equations();
        for ((&b, friction), force) in sticks.iter().zip(&operators.frictions).zip(&motion.forces) {
            if alphas[b] != 0.0 {
                add(b, -alphas[b], &friction.of(force, 1));
            }
        }
        let at_ends = operators.at_edges(&total);
        let start: Vec<f64> = sticks.iter().map(|&b| total.start[b]).collect();
        let first: Vec<f64> =
            sticks.iter().enumerate().map(|(a, &b)| operators.first_slope(body, a, alphas[b], &moves)).collect();
        let forces = motion.march.slope(&at_ends, &operators.responses, &first, &frictions, &start);
        for ((&b, friction), force) in sticks.iter().zip(&operators.frictions).zip(forces.iter().flatten()) {
            let held = friction.of(&Kernel::new(force), 0);
            total.output[b].iter_mut().zip(&held.output).for_each(|(s, v)| *s -= v);
        }
        let mut slopes = operators.through(&total.output);
        if slopes.len() > 1 {
            sticks.iter().zip(&motion.march.bodies).for_each(|(&b, moved)| remove_creep(&mut slopes[b], moved));
        }
        Ok(slopes)
    }

    /// Derivatives of the orders, coefficients and friction parameters with respect to a parameter.
    fn moves(&self, point: &Point, moved: &Parameter) -> BodyDerivatives {
        let mut out = BodyDerivatives {
            alphas: vec![0.0; self.equations.len()],
            terms: self.equations.iter().map(|e| vec![(0.0, 0.0); e.terms.len()]).collect(),
            frictions: vec![[0.0; 3]; self.frictions.len()],
        };
        match *moved {
            Parameter::Order(j) => {
                let of = |weights: &[f64]| weights.get(j).copied().unwrap_or(0.0);
                for (i, equation) in self.equations.iter().enumerate() {
                    let alpha = of(&equation.order.weights);
                    out.alphas[i] = alpha;
                    out.terms[i] = equation.terms.iter().map(|t| (0.0, alpha - of(&t.1.weights))).collect();
                }
            }
            Parameter::Coefficient(j) => {
                for (terms, equation) in out.terms.iter_mut().zip(&self.equations) {
                    *terms = equation.terms.iter().map(|t| (t.2.slope(&point.coefficients, j), 0.0)).collect();
                }
                for (moves, (_, law)) in out.frictions.iter_mut().zip(&self.frictions) {
                    *moves = law.slope(&point.coefficients, j);
                }
            }
            Parameter::State(..) | Parameter::Input(_) => {}
        }
        out
    }

    /// Derivative of the initial forcing, which is linear in states and coefficients and smooth in orders.
    fn forcing_slope(
        &self,
        point: &Point,
        values: &[f64],
        record: &Record,
        moved: &Parameter,
    ) -> Result<InitialForcing> {
        let idle = values.is_empty() || values.iter().all(|x| *x == 0.0);
        let none = || Ok(InitialForcing::zeros(record.m(), self.equations.len()));
        match *moved {
            Parameter::State(_, state) => {
                let unit: Vec<f64> = (0..values.len()).map(|k| if k == state { 1.0 } else { 0.0 }).collect();
                self.initial_forcing(&point.orders, &point.coefficients, &unit, record)
            }
            // Initial forcing does not depend on inputs.
            Parameter::Input(_) => none(),
            _ if idle => none(),
            Parameter::Coefficient(j) => {
                let followed = |signal: usize| self.equations.iter().any(|e| e.output == signal);
                let mut terms = self.equations.iter().flat_map(|e| &e.terms);
                if !terms.any(|t| followed(t.0) && t.2.slope(&point.coefficients, j) != 0.0) {
                    return none();
                }
                let at = |by: f64| {
                    let mut shifted = point.coefficients.clone();
                    shifted[j] += by;
                    self.initial_forcing(&point.orders, &shifted, values, record)
                };
                let size = point.coefficients[j].abs().max(1.0);
                // Quadratic at most for one equation. With direct feedthrough between equations it is rational.
                let by = if self.equations.len() == 1 { size } else { DIFFERENCE_STEP * size };
                Ok(difference(&at(by)?, &at(-by)?, 2.0 * by))
            }
            Parameter::Order(j) => {
                let shifted = |by: f64| {
                    let mut orders = point.orders.clone();
                    orders[j] += by;
                    self.initial_forcing(&orders, &point.coefficients, values, record)
                };
                Ok(difference(&shifted(DIFFERENCE_STEP)?, &shifted(-DIFFERENCE_STEP)?, 2.0 * DIFFERENCE_STEP))
            }
        }
    }
}

impl StateModel for FrictionModel {
    type Part = Part;

    fn order_bounds(&self) -> &[(f64, f64)] {
        &self.order_bounds
    }

    fn coordinates(&self) -> &[Coordinate] {
        &self.coordinates
    }

    fn inputs(&self) -> &[FreeInput] {
        &self.inputs
    }

    /// Friction forces are not negative.
    fn is_nonnegative(&self, coefficient: usize) -> bool {
        self.frictions.iter().any(|(_, law)| law.is_force(coefficient))
    }

    /// Times at which a body stops or reverses move from pulse to pulse with any parameter.
    fn has_kinks(&self) -> bool {
        true
    }

    fn check(&self, experiments: &[Experiment]) -> Result<()> {
        Self::check(self, experiments)
    }

    fn check_orders(&self, orders: &[f64]) -> Result<()> {
        let body = self.body(orders, &vec![0.0; self.coordinates.len()]);
        body.equations.iter().try_for_each(|e| e.structure.check(usize::MAX, |_| true))
    }

    fn state_guesses(&self, orders: &[f64], coefficients: &[f64], experiment: &Experiment) -> Vec<Vec<f64>> {
        state_guesses(&self.states(orders), &self.body(orders, coefficients).frictions, experiment)
    }

    fn state_count(&self, orders: &[f64]) -> usize {
        self.states(orders).0.len()
    }

    fn powers(&self, orders: &[f64], coefficients: &[f64], states: &[f64]) -> Vec<Vec<(f64, f64)>> {
        self.initial_powers(orders, coefficients, states)
    }

    fn evaluate(&self, experiments: &[Experiment], point: &Point, stop: &Stop) -> Result<Evaluation<Part>> {
        self.simulate(experiments, point, stop)
    }

    fn jacobian(
        &self,
        experiments: &[Experiment],
        point: &Point,
        at: &Evaluation<Part>,
        numbers: bool,
        stop: &Stop,
    ) -> Result<Vec<Vec<f64>>> {
        self.derivatives(experiments, point, at, numbers, stop)
    }
}

/// Derivatives of each α, of (coefficient, integration order) of each term, and of each fc, fs and vs.
struct BodyDerivatives {
    alphas: Vec<f64>,
    terms: Vec<Vec<(f64, f64)>>,
    frictions: Vec<[f64; 3]>,
}

/// Guesses of the initial states from the first samples of a run: positions and velocities of the outputs, with several
/// constant forces within the frictions, all other states 0.
pub(crate) fn state_guesses(
    (states, equations): &(Vec<State>, Vec<Equation>),
    frictions: &[(usize, FrictionLaw)],
    experiment: &Experiment,
) -> Vec<Vec<f64>> {
    let begun: Vec<(f64, f64)> = experiment.samples.iter().map(|samples| first_of(samples, experiment)).collect();
    let with_force = |body: usize, force: f64| -> Vec<f64> {
        let value = |state: &State| match *state {
            State::Level(i) => begun[i].0,
            State::Rate(i) => begun[i].1,
            State::Offset(i, 0) if i == body => force / libm::tgamma(equations[i].structure.order + 1.0),
            _ => 0.0,
        };
        states.iter().map(value).collect()
    };
    let mut guesses = vec![with_force(0, 0.0)];
    for ratio in INITIAL_FORCE_RATIOS {
        for &(body, law) in frictions {
            let guess = with_force(body, ratio * law.breakaway());
            if guess != guesses[0] {
                guesses.push(guess);
            }
        }
    }
    guesses
}

/// Initial position and velocity of an output from its first samples.
fn first_of(samples: &[f64], experiment: &Experiment) -> (f64, f64) {
    let near = &samples[..samples.len().min(FIRST_SAMPLES)];
    #[allow(clippy::cast_precision_loss)]
    let (count, step) = (near.len() as f64, experiment.record.step() * experiment.pulses_per_sample as f64);
    let middle = 0.5 * (count - 1.0);
    let mean = near.iter().sum::<f64>() / count.max(1.0);
    #[allow(clippy::cast_precision_loss)]
    let (mut across, mut along) = (0.0, 0.0);
    for (k, value) in near.iter().enumerate() {
        #[allow(clippy::cast_precision_loss)]
        let x = k as f64 - middle;
        across += x * (value - mean);
        along += x * x;
    }
    let rate = if along > 0.0 { across / along / step } else { 0.0 };
    (mean - rate * middle * step, rate)
}

fn difference(up: &InitialForcing, down: &InitialForcing, step: f64) -> InitialForcing {
    let mut out = up.zeros_like();
    out.add(1.0 / step, up);
    out.add(-1.0 / step, down);
    out
}

/// Spectra of outputs and of edge velocities that enter terms.
struct Spectra(Vec<(Kernel, Kernel)>);

impl Spectra {
    fn new(part: &Part, sticks: &[usize]) -> Self {
        let run = &part.run;
        let of = |(j, (y, v)): (usize, (&Vec<f64>, &Vec<f64>))| {
            let solved = sticks.iter().position(|&b| b == j).map_or(y, |a| &run.solved[a]);
            (Kernel::new(solved), Kernel::new(v))
        };
        Self(run.outputs.iter().zip(&run.moved).enumerate().map(of).collect())
    }

    /// Contribution of a term of an output through its kernels (0) or their derivatives (1).
    fn own(&self, output: usize, kernels: &[Vec<f64>; 2], which: usize) -> IntegratedSignal {
        let (position, velocity) = &self.0[output];
        IntegratedSignal { output: product(position, &kernels[which]), edges: product(velocity, &kernels[which]) }
    }
}
