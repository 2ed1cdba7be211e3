//! Simulation of a model on a recording: samples of its outputs on one grid of block pulses.

use std::sync::Arc;

use super::initial_terms::{self, fit_initial_terms, OutputSamples};
use super::richardson::{add_multiple, combine, Rows};
use crate::equation::{AffineOrder, Equation, Filter, Initial, Term};
use crate::error::{check_length, Error, Result};
use crate::estimation::output_error::{FreeEquation, FreeModel, MinimizationSettings, Monomial};
use crate::expression::DerivedSignal;
use crate::fractional::kernels::first_coefficient;
use crate::friction::FrictionLaw;
use crate::linalg::small;
use crate::nonlinear::{self, FreeFrictionLaw, InitialGuess, NonlinearModel, NonlinearSystem};
use crate::parallel::Stop;
use crate::recording::{Recording, Role, Sampling};
use crate::regressors::Record;
use crate::series;
use crate::signal::block_pulse::{point_samples, SampleInterpolation};
use crate::simulate;

/// Initial terms of each equation as (exponent, coefficient).
pub(super) type Terms = Vec<Vec<(f64, f64)>>;

/// Difference of two orders below which they count as equal.
pub(super) const ORDER_TOLERANCE: f64 = 1e-9;
/// Minimum integration order at which pulse means resolve a slope discontinuity without a correction.
const SMOOTH_INTEGRATION_ORDER: f64 = 2.0;
/// Termination criteria of the fit of initial states for models with friction or non-linear terms.
const INITIAL_STATE_SETTINGS: MinimizationSettings = MinimizationSettings { evaluations: 60, tolerance: 1e-12 };

/// Initial terms of a simulation: powers of t in the outputs. The exponents −1, −2, … denote an impulse and its
/// derivatives at the sensor filter. The exponent ∞ denotes the level of an output.
#[derive(Debug, Clone, PartialEq)]
pub enum InitialTerms {
    /// Terms with given coefficients as (exponent, coefficient), by equation.
    Given(Vec<Vec<(f64, f64)>>),
    /// Terms whose coefficients are fitted to the measured samples by least squares.
    Fitted {
        /// Exponents of the terms, by equation.
        exponents: Vec<Vec<f64>>,
        /// True if each output also has an unknown level.
        has_level: bool,
    },
    /// Separate responses instead of their sum: first the outputs from rest, then, for each initial term, the outputs
    /// without inputs if this term is 1 and all others are 0.
    UnitResponses {
        /// Exponents by equation.
        exponents: Vec<Vec<f64>>,
    },
}

/// Model with known orders and coefficients on a recording, whose outputs can be simulated.
#[derive(Debug, Clone)]
pub struct OutputSimulation {
    pub(super) recording: Arc<Recording>,
    pub(super) equations: Vec<Equation>,
    pub(super) frictions: Vec<(usize, FrictionLaw)>,
    pub(super) times: Option<Vec<f64>>,
    pub(super) derived: Vec<DerivedSignal>,
}

impl OutputSimulation {
    /// Build the simulation of linear equations with optional friction. The equations are in the sequence of the
    /// recording's outputs.
    ///
    /// `frictions` holds (index of the equation, friction law). `times` holds the sample times \[s\]; None stands for
    /// the uniform samples of the recording.
    ///
    /// # Errors
    /// The errors of [`Equation::check`] for an invalid equation. [`Error::Structure`] if the outputs of the equations
    /// are not those of the recording.
    ///
    /// ```
    /// use ftlm::equation::{Equation, Structure, Term};
    /// use ftlm::output_samples::{InitialTerms, OutputSimulation, Refinement};
    /// use ftlm::recording::{Channel, Recording, Role};
    /// use ftlm::signal::block_pulse::Intersample;
    /// # fn main() -> ftlm::error::Result<()> {
    /// // D^0.5 y = −y + u from y(0) = 0, and a step: 1 − e^t erfc(√t), 0.5724 at 1 s.
    /// let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
    /// let plant = Equation::new(Structure { output: 0, order: 0.5, terms }, vec![-1.0, 1.0])?;
    /// let u = Channel::new("u", vec![1.0; 21], Role::Input(Intersample::Hold));
    /// let run = Recording::new("run", 0.05, None, vec![Channel::new("y", vec![0.0; 21], Role::Output), u], vec![0])?;
    /// let simulation = OutputSimulation::new(run.into(), vec![plant], Vec::new(), None)?;
    /// let rest = InitialTerms::Given(vec![Vec::new()]);
    /// assert!((simulation.samples(4, &rest)?.outputs[0][20] - 0.5724).abs() < 1e-2);
    /// let options = Refinement { tolerance: 1e-6, max_pulses: 1 << 16, long_record_intervals: 1 << 14, memory: 1 << 30 };
    /// let found = simulation.refine(&rest, options, &ftlm::parallel::Stop::default())?;
    /// assert!((found.samples.outputs[0][20] - 0.572_416_423_844_193).abs() < 1e-6);
    /// # Ok(())
    /// # }
    /// ```
    pub fn new(
        recording: Arc<Recording>,
        equations: Vec<Equation>,
        frictions: Vec<(usize, FrictionLaw)>,
        times: Option<Vec<f64>>,
    ) -> Result<Self> {
        equations.iter().try_for_each(|equation| equation.check(recording.channels().len()))?;
        let equation_outputs: Vec<usize> = equations.iter().map(|equation| equation.structure.output).collect();
        if equation_outputs != recording.outputs() {
            let what = format!("equations of signals {equation_outputs:?} for outputs {:?}", recording.outputs());
            return Err(Error::Structure {
                what,
                remedy: "give one equation per output, in the sequence of the outputs".into(),
            });
        }
        Ok(Self { recording, equations, frictions, times, derived: Vec::new() })
    }

    /// Build the simulation of equations with non-linear terms and optional friction. A non-linear term is a term whose
    /// signal is derived. Derived signals are numbered after the signals of the recording.
    ///
    /// # Errors
    /// The errors of [`NonlinearSystem::check`] for an invalid system. [`Error::Structure`] if the outputs of the
    /// equations are not those of the recording, or if a measured signal in the equations has passed the sensor filter.
    /// [`Error::OutOfRange`] for an input term whose order is not below the order of its equation.
    ///
    /// ```
    /// # use ftlm::equation::{Equation, Structure, Term};
    /// # use ftlm::expression::{DerivedSignal, Expression, Instruction};
    /// # use ftlm::output_samples::{InitialTerms, OutputSimulation};
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// // D y = u − y² after a step is tanh t. Signal 2 is y².
    /// let square = Expression::new(vec![Instruction::Channel(0), Instruction::Power(2.0)], 1)?;
    /// let terms = vec![Term { signal: 1, order: 0.0 }, Term { signal: 2, order: 0.0 }];
    /// let plant = Equation::new(Structure { output: 0, order: 1.0, terms }, vec![1.0, -1.0])?;
    /// let u = Channel::new("u", vec![1.0; 21], Role::Input(Intersample::Hold));
    /// let run = Recording::new("run", 0.05, None, vec![Channel::new("y", vec![0.0; 21], Role::Output), u], vec![0])?;
    /// let derived = vec![DerivedSignal::new(square, vec![(0, 0.0)])?];
    /// let simulation = OutputSimulation::with_derived(run.into(), vec![plant], Vec::new(), derived, None)?;
    /// let rest = InitialTerms::Given(vec![Vec::new()]);
    /// assert!((simulation.samples(8, &rest)?.outputs[0][20] - 1.0_f64.tanh()).abs() < 1e-4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn with_derived(
        recording: Arc<Recording>,
        equations: Vec<Equation>,
        frictions: Vec<(usize, FrictionLaw)>,
        derived: Vec<DerivedSignal>,
        times: Option<Vec<f64>>,
    ) -> Result<Self> {
        let recorded = recording.channels().len();
        let equation_outputs: Vec<usize> = equations.iter().map(|equation| equation.structure.output).collect();
        if equation_outputs != recording.outputs() {
            let what = format!("equations of signals {equation_outputs:?} for outputs {:?}", recording.outputs());
            return Err(Error::Structure {
                what,
                remedy: "give one equation per output, in the sequence of the outputs".into(),
            });
        }
        if recording.is_all_filtered() {
            let remedy = "the sensor filter does not commute with non-linear terms: use coupling='simulated' and inputs before it";
            return Err(nonlinear::unsupported_with("inputs behind the sensor filter", remedy));
        }
        let simulation = Self { recording, equations, frictions, times, derived };
        simulation.system().check()?;
        for (i, Equation { structure, .. }) in simulation.equations.iter().enumerate() {
            let depends_on_input = |signal: usize| match signal.checked_sub(recorded) {
                None => simulation.system().output_index(i, signal).is_none(),
                Some(index) => {
                    let channels = &simulation.derived[index].channels;
                    channels.iter().any(|channel| simulation.system().output_index(i, channel.0).is_none())
                }
            };
            let is_improper = |t: &&Term| t.order >= structure.order - ORDER_TOLERANCE && depends_on_input(t.signal);
            if let Some(term) = structure.terms.iter().find(is_improper) {
                return Err(Error::OutOfRange {
                    name: "order of an input in equations with non-linear terms".into(),
                    value: term.order,
                    range: format!("below {}, that of the equation", structure.order),
                    remedy: "use a lower order".into(),
                });
            }
        }
        Ok(simulation)
    }

    /// Return the equations, derived signals and friction laws as one system.
    fn system(&self) -> NonlinearSystem {
        NonlinearSystem {
            equations: self.equations.clone(),
            derived: self.derived.clone(),
            recorded: self.recording.channels().len(),
            coupled: self.recording.is_coupled || !self.frictions.is_empty(),
            frictions: self.frictions.clone(),
        }
    }

    /// True if the outputs are linear in inputs and initial terms.
    pub(super) fn is_linear(&self) -> bool {
        self.frictions.is_empty() && self.derived.is_empty()
    }

    /// Fit the initial terms of a model with friction or non-linear terms to the measured outputs. Return (exponent e,
    /// coefficient c) of each initial term c t^e, by equation. The simulation uses `pulses_per_sample` block pulses per
    /// sampling interval.
    ///
    /// The outputs are not linear in the initial terms, which are therefore found by local optimization. It starts from
    /// the measured position and velocity at the start of the run.
    ///
    /// # Errors
    /// The errors of [`Recording::experiment`], for an invalid number of pulses or too few samples, and of
    /// [`nonlinear::fit`].
    ///
    /// ```
    /// use ftlm::equation::{Equation, Initial, Structure, Term};
    /// use ftlm::friction::FrictionLaw;
    /// use ftlm::output_samples::OutputSimulation;
    /// use ftlm::parallel::Stop;
    /// use ftlm::recording::{Channel, Recording, Role};
    /// use ftlm::signal::block_pulse::Intersample;
    /// // A block rests at 2.
    /// let structure = Structure { output: 0, order: 2.0, terms: vec![Term { signal: 1, order: 0.0 }] };
    /// let u = Channel::new("u", vec![0.0; 21], Role::Input(Intersample::Hold));
    /// let run = Recording::new("run", 0.05, None, vec![Channel::new("y", vec![2.0; 21], Role::Output), u], vec![0])?;
    /// let block = Equation::new(structure, vec![1.0])?;
    /// let friction = vec![(0, FrictionLaw::coulomb(0.5))];
    /// let simulation = OutputSimulation::new(run.into(), vec![block], friction, None)?;
    /// let terms = simulation.fit_initial_states(Initial::Caputo, 1, &Stop::default())?;
    /// assert!((terms[0][0].1 - 2.0).abs() < 1e-6);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn fit_initial_states(
        &self,
        initial: Initial,
        pulses_per_sample: usize,
        stop: &Stop,
    ) -> Result<Vec<Vec<(f64, f64)>>> {
        let experiment = self.recording.experiment(Sampling { pulses_per_sample, ..Sampling::default() })?;
        let weights: Vec<f64> = (self.recording.outputs().iter())
            .map(|&output| initial_terms::weight(&self.recording.channels()[output].samples))
            .collect();
        let experiments = [experiment.with_weights(&weights, None)?];
        let monomial = |factor: f64| Monomial { factor, powers: Vec::new() };
        let order = |constant: f64| AffineOrder { constant, weights: Vec::new() };
        let fixed_equation = |Equation { structure, coefficients }: &Equation| FreeEquation {
            output: structure.output,
            order: order(structure.order),
            terms: (structure.terms.iter().zip(coefficients))
                .map(|(term, c)| (term.signal, order(term.order), monomial(*c)))
                .collect(),
        };
        let law = |law: FrictionLaw| FreeFrictionLaw {
            coulomb: monomial(law.coulomb),
            stribeck: monomial(law.stribeck),
            speed: monomial(law.speed),
        };
        let (equations, filtered) =
            (self.equations.iter().map(fixed_equation).collect(), nonlinear::filtered_outputs(&experiments));
        let frictions = self.frictions.iter().map(|(equation, friction)| (*equation, law(*friction))).collect();
        let model = FreeModel {
            equations,
            order_bounds: Vec::new(),
            coordinates: Vec::new(),
            inputs: Vec::new(),
            coupled: self.recording.is_coupled,
            priors: Vec::new(),
            initial,
        };
        let model = NonlinearModel { model, derived: self.derived.clone(), frictions, filtered };
        let optimum = nonlinear::fit(&model, &experiments, &InitialGuess::default(), INITIAL_STATE_SETTINGS, stop)?;
        Ok(optimum.initial.into_iter().flatten().collect())
    }

    /// Return the samples of the outputs, simulated on a grid of `pulses_per_sample` block pulses per sampling
    /// interval. They are not finite if the simulation diverges.
    ///
    /// # Errors
    /// The errors of [`Recording::pulses`] for an invalid number of pulses, of [`simulate::respond`] for linear models,
    /// and of [`NonlinearSystem::run`] for other models.
    ///
    /// ```
    /// # use ftlm::equation::{Equation, Structure, Term};
    /// # use ftlm::output_samples::{InitialTerms, OutputSimulation};
    /// # use ftlm::recording::{Channel, Recording, Role};
    /// # use ftlm::signal::block_pulse::Intersample;
    /// # let terms = vec![Term { signal: 0, order: 0.0 }, Term { signal: 1, order: 0.0 }];
    /// # let plant = Equation::new(Structure { output: 0, order: 0.5, terms }, vec![-1.0, 1.0])?;
    /// # let u = Channel::new("u", vec![1.0; 21], Role::Input(Intersample::Hold));
    /// # let run = Recording::new("run", 0.05, None, vec![Channel::new("y", vec![0.0; 21], Role::Output), u], vec![0])?;
    /// # let simulation = OutputSimulation::new(run.into(), vec![plant], Vec::new(), None)?;
    /// // D^0.5 y = −y + u from rest, 0.5724 one second after a step.
    /// let rest = InitialTerms::Given(vec![Vec::new()]);
    /// assert!((simulation.samples(4, &rest)?.outputs[0][20] - 0.5724).abs() < 1e-2);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn samples(&self, pulses_per_sample: usize, initial: &InitialTerms) -> Result<OutputSamples> {
        let pulse_grid = Grid::new(self, pulses_per_sample)?;
        let (units, has_level) = match initial {
            InitialTerms::Given(terms) => {
                check_length("initial terms", self.equations.len(), terms.len())?;
                let mut outputs = pulse_grid.samples(&pulse_grid.respond(terms)?, terms, true)?;
                for (row, terms) in outputs.iter_mut().zip(terms) {
                    let level: f64 = terms.iter().filter(|(e, _)| e.is_infinite()).map(|(_, value)| value).sum();
                    row.iter_mut().for_each(|v| *v += level);
                }
                return Ok(OutputSamples { outputs, initial: terms.clone() });
            }
            InitialTerms::Fitted { exponents, has_level } => (self.unit_terms(exponents)?, *has_level),
            InitialTerms::UnitResponses { exponents } => (self.unit_terms(exponents)?, false),
        };
        let no_terms = vec![Vec::new(); self.equations.len()];
        let (means, responses) = pulse_grid.rest_and_units(&units)?;
        let mut rest_samples = pulse_grid.samples(&means, &no_terms, true)?;
        let is_separate = matches!(initial, InitialTerms::UnitResponses { .. });
        let is_finite = rest_samples.iter().flatten().all(|v| v.is_finite());
        if !is_separate && ((units.is_empty() && !has_level) || !is_finite) {
            return Ok(OutputSamples { outputs: rest_samples, initial: no_terms });
        }
        let columns = units.iter().zip(responses).map(|(unit, means)| pulse_grid.unit_samples(*unit, &means));
        let columns = columns.collect::<Result<Vec<_>>>()?;
        if is_separate {
            rest_samples.extend(columns.into_iter().flatten());
            return Ok(OutputSamples { outputs: rest_samples, initial: no_terms });
        }
        fit_initial_terms(&self.recording.compared_rows(pulses_per_sample)?, rest_samples, &units, columns, has_level)
    }

    /// Return (index of the equation, exponent) of each initial term.
    pub(super) fn unit_terms(&self, exponents: &[Vec<f64>]) -> Result<Vec<(usize, f64)>> {
        check_length("exponents of the initial terms", self.equations.len(), exponents.len())?;
        Ok(exponents
            .iter()
            .enumerate()
            .flat_map(|(i, equation_exponents)| equation_exponents.iter().map(move |e| (i, *e)))
            .collect())
    }

    /// Return the index of the equation whose simulated output is this signal. None for inputs. Also None if outputs
    /// enter other equations as measured.
    pub(super) fn simulated_output(&self, signal: usize) -> Option<usize> {
        self.equations.iter().position(|e| self.recording.is_coupled && e.structure.output == signal)
    }

    /// True if an equation has an improper term, whose order is above the order of its equation.
    pub(super) fn has_improper_term(&self) -> bool {
        let has_improper =
            |e: &Equation| e.structure.terms.iter().any(|t| t.order > e.structure.order + ORDER_TOLERANCE);
        self.equations.iter().any(has_improper)
    }
}

/// Return the coefficient of the initial term with this exponent, or 0 if there is no such term.
fn coefficient(terms: &[(f64, f64)], exponent: f64) -> f64 {
    terms.iter().find(|term| term.0 == exponent).map_or(0.0, |term| term.1)
}

/// Multiply rows by a square, row-major matrix. Without a matrix, return the rows unchanged.
fn apply(matrix: Option<&Vec<f64>>, rows: Rows) -> Rows {
    let (Some(matrix), n) = (matrix, rows.len()) else { return rows };
    let product_row = |i: usize| {
        let mut out = vec![0.0; rows[i].len()];
        for (row, gain) in rows.iter().zip(&matrix[i * n..]) {
            out.iter_mut().zip(row).for_each(|(sum, v)| *sum += gain * v);
        }
        out
    };
    (0..n).map(product_row).collect()
}

/// Return the ratio of the leading coefficients of a sensor filter, or 0 if its relative degree is not `degree`.
///
/// For degree 0, this is the gain of the filter for a jump. For a degree n > 0, it is the jump of its response to the
/// derivative of order n − 1 of an impulse.
fn leading_gain(filter: &Filter, degree: f64) -> f64 {
    let leading_term = |part: &[(f64, f64)]| {
        let highest = part.iter().filter(|(c, _)| *c != 0.0).fold(0.0, |most: f64, (_, order)| most.max(*order));
        (highest, part.iter().filter(|(_, order)| *order == highest).map(|(c, _)| c).sum::<f64>())
    };
    let ((numerator_order, numerator_coefficient), (denominator_order, denominator_coefficient)) =
        (leading_term(&filter.numerator), leading_term(&filter.denominator));
    if (denominator_order - numerator_order - degree).abs() > ORDER_TOLERANCE {
        0.0
    } else {
        numerator_coefficient / denominator_coefficient
    }
}

/// Return the relative degree of a filter: order of the denominator minus order of the numerator, rounded down.
fn relative_degree(filter: &Filter) -> f64 {
    let highest = |part: &[(f64, f64)]| part.iter().filter(|(c, _)| *c != 0.0).fold(0.0, |m: f64, t| m.max(t.1));
    (highest(&filter.denominator) - highest(&filter.numerator) + ORDER_TOLERANCE).trunc()
}

/// Pulse means of a recording on one grid of block pulses, and positions of the samples on the grid.
pub(super) struct Grid<'a> {
    simulation: &'a OutputSimulation,
    pulses_per_sample: usize,
    record: Record,
    /// Sensor filter of the simulated outputs as a power series in the one-step delay. None without a filter, or if the
    /// record itself is filtered.
    output_filter: Option<Vec<f64>>,
    interpolation: Option<SampleInterpolation>,
}

impl<'a> Grid<'a> {
    #[allow(clippy::cast_precision_loss)]
    pub(super) fn new(simulation: &'a OutputSimulation, pulses_per_sample: usize) -> Result<Self> {
        let recording = &simulation.recording;
        let is_filtered = recording.is_all_filtered();
        let pulses = recording.pulses((recording.len() - 1).saturating_mul(pulses_per_sample), is_filtered)?;
        let is_nonlinear = !simulation.is_linear();
        let record = if is_nonlinear { pulses.into_record()? } else { pulses.into_record_with_initial_state()? };
        let (m, step) = (record.m(), record.step());
        let filter = recording.filter.as_ref().filter(|_| !is_filtered);
        let output_filter = filter.map(|filter| filter.series(m, step)).transpose()?;
        let positions = simulation.times.as_ref().map(|times| times.iter().map(|t| (t / step).min(m as f64)).collect());
        let interpolation = positions.map(|positions| SampleInterpolation::new(positions, m)).transpose()?;
        Ok(Self { simulation, pulses_per_sample, record, output_filter, interpolation })
    }

    /// Return the pulse means of the outputs before the sensor filter, with these initial terms.
    fn respond(&self, terms: &Terms) -> Result<Rows> {
        let OutputSimulation { recording, equations, .. } = self.simulation;
        if !self.simulation.is_linear() {
            return Ok(self.simulation.system().run(&self.record, terms)?.outputs);
        }
        if recording.is_coupled {
            return simulate::respond(equations, &self.record, terms);
        }
        let outputs = equations.iter().zip(terms).map(|(equation, equation_terms)| {
            simulate::respond(std::slice::from_ref(equation), &self.record, std::slice::from_ref(equation_terms))
        });
        Ok(outputs.collect::<Result<Vec<_>>>()?.concat())
    }

    /// Return the pulse means of the outputs with zero initial conditions. Also return those for each initial term
    /// alone with coefficient 1, without inputs.
    pub(super) fn rest_and_units(&self, units: &[(usize, f64)]) -> Result<(Rows, Vec<Rows>)> {
        let OutputSimulation { recording, equations, .. } = self.simulation;
        if recording.is_coupled {
            return simulate::respond_and_units(equations, &self.record, units);
        }
        // Each equation is simulated alone, because an initial term affects only the output of its own equation.
        let mut rest = Vec::with_capacity(equations.len());
        let mut responses = vec![vec![vec![0.0; self.record.m()]; equations.len()]; units.len()];
        for (i, equation) in equations.iter().enumerate() {
            let indices: Vec<usize> = (0..units.len()).filter(|&k| units[k].0 == i).collect();
            let exponents: Vec<(usize, f64)> = indices.iter().map(|&k| (0, units[k].1)).collect();
            let (outputs, rows) =
                simulate::respond_and_units(std::slice::from_ref(equation), &self.record, &exponents)?;
            rest.extend(outputs);
            indices.into_iter().zip(rows).for_each(|(k, row)| responses[k].splice(i..=i, row).for_each(drop));
        }
        Ok((rest, responses))
    }

    /// Return the samples of the outputs, from their pulse means, for one initial term with coefficient 1 and without
    /// inputs.
    pub(super) fn unit_samples(&self, (equation, exponent): (usize, f64), means: &Rows) -> Result<Rows> {
        let mut terms = vec![Vec::new(); means.len()];
        terms[equation].push((exponent, 1.0));
        self.samples(means, &terms, false)
    }

    /// Return the samples of the outputs from their pulse means. Direct feedthrough uses the values of the inputs at
    /// the sample times.
    ///
    /// Without improper terms, the last two pulse means before each sample time are extrapolated to it. These pulses
    /// contain no jump of a zero-order-hold input, so the extrapolation crosses no slope discontinuity t^α. With
    /// improper terms, the pulse means before and after each sample time are averaged. Nonuniform sample times may be
    /// close to any jump. Samples at these times are interpolated from the surrounding pulses, and kink corrections are
    /// added.
    fn samples(&self, means: &Rows, terms: &Terms, is_driven: bool) -> Result<Rows> {
        let OutputSimulation { recording, equations, times, .. } = self.simulation;
        let (n, m, pulses_per_sample) = (means.len(), self.record.m(), self.pulses_per_sample);
        let count = times.as_ref().map_or(m / pulses_per_sample + 1, Vec::len);
        let mut system = identity(n);
        let (mut feedthrough, mut initial_values) = (vec![vec![0.0; count]; n], vec![vec![0.0]; n]);
        // This array is as long as the grid, so it is allocated only for direct feedthrough.
        let mut input_part: Option<Rows> = None;
        let degree = recording.filter.as_ref().map_or(0.0, relative_degree);
        let after_filter = |i: usize| {
            recording.filter.as_ref().map_or(0.0, |f| coefficient(&terms[i], -degree) * leading_gain(f, degree))
        };
        for (i, Equation { structure, coefficients }) in equations.iter().enumerate() {
            // In a filtered record, the initial terms pass the filter as well. The filter turns one of them into a
            // jump.
            initial_values[i][0] =
                if self.record.is_filtered() { after_filter(i) } else { coefficient(&terms[i], 0.0) };
            for (k, (term, &c)) in structure.terms.iter().zip(coefficients).enumerate() {
                if structure.integration(k).abs() > ORDER_TOLERANCE || self.is_derived(term.signal) {
                    continue;
                }
                if let Some(j) = self.simulation.simulated_output(term.signal) {
                    system[i * n + j] -= c;
                } else if is_driven {
                    let input_part = input_part.get_or_insert_with(|| vec![vec![0.0; m]; n]);
                    add_multiple(&mut input_part[i], c, self.record.signal(term.signal));
                    add_multiple(&mut feedthrough[i], c, &self.values_at_samples(term.signal)?);
                }
            }
        }
        let coupling_inverse = if system == identity(n) { None } else { Some(small::inverse(&system, n)?) };
        let coupling_inverse = coupling_inverse.as_ref();
        let (input_part, feedthrough, initial_values) = (
            input_part.map(|input_part| apply(coupling_inverse, input_part)),
            apply(coupling_inverse, feedthrough),
            apply(coupling_inverse, initial_values),
        );
        let mut smooth_means = match &input_part {
            Some(input_part) => combine(means, input_part, |mean, input_mean| mean - input_mean),
            None => means.clone(),
        };
        let (mut gains, mut offsets) = (vec![1.0; n], vec![0.0; n]);
        if let (Some(series), Some(filter)) = (&self.output_filter, &recording.filter) {
            for i in 0..n {
                if !self.is_filtered(equations[i].structure.output) || !means[i].iter().all(|v| v.is_finite()) {
                    continue;
                }
                gains[i] = leading_gain(filter, 0.0);
                if degree > 0.0 {
                    offsets[i] = after_filter(i);
                }
                smooth_means[i] = series::multiply(series, &means[i], m);
                if let Some(input_part) = &input_part {
                    add_multiple(&mut smooth_means[i], -gains[i], &input_part[i]);
                }
            }
        }
        let mut out = match (&self.interpolation, times) {
            (Some(interpolation), Some(times)) => {
                let mut kinks = apply(coupling_inverse, self.kink_corrections(interpolation, terms, is_driven));
                kinks.iter_mut().zip(&gains).filter(|(_, gain)| **gain != 1.0).for_each(|(row, _)| row.fill(0.0));
                let mut out: Rows = smooth_means.iter().map(|row| interpolation.interpolate(row)).collect();
                for (i, (row, kinks)) in out.iter_mut().zip(kinks).enumerate() {
                    add_multiple(row, 1.0, &kinks);
                    // At t = 0 no input has been integrated yet.
                    let initial_value = gains[i] * initial_values[i][0] + offsets[i];
                    row.iter_mut().zip(times).filter(|(_, t)| **t <= 0.0).for_each(|(v, _)| *v = initial_value);
                }
                out
            }
            _ => {
                let has_improper_term = self.simulation.has_improper_term();
                let later_response =
                    if has_improper_term && is_driven { Some(self.responses_after_sample()?) } else { None };
                let output_samples = |i: usize| {
                    let row = &smooth_means[i];
                    let mut out = Vec::with_capacity(count);
                    out.push(gains[i] * initial_values[i][0] + offsets[i]);
                    for (k, pulse) in (pulses_per_sample..=m).step_by(pulses_per_sample).enumerate() {
                        out.push(if !has_improper_term || m < 3 {
                            1.5 * row[pulse - 1] - 0.5 * row[pulse.saturating_sub(2)]
                        } else if pulse == m {
                            row[m - 1] + 0.5 * row[m - 2] - 0.5 * row[m - 3]
                        } else {
                            // An improper term differentiates. At one order above its equation this is nearly Tustin's
                            // rule, so the pulse means have a component of alternating sign. The average of the pulses
                            // on both sides eliminates it.
                            let later_response = later_response
                                .as_ref()
                                .filter(|_| gains[i] == 1.0)
                                .map_or(0.0, |later_response| later_response[i][k]);
                            0.5 * (row[pulse - 1] + row[pulse]) - later_response
                        });
                    }
                    out
                };
                (0..n).map(output_samples).collect()
            }
        };
        for ((row, gain), feedthrough) in out.iter_mut().zip(gains).zip(&feedthrough) {
            add_multiple(row, gain, feedthrough);
        }
        Ok(out)
    }

    /// True if a signal is a derived signal, which the record does not contain.
    fn is_derived(&self, signal: usize) -> bool {
        signal >= self.record.len()
    }

    fn is_filtered(&self, signal: usize) -> bool {
        self.simulation.recording.channels()[signal].is_filtered
    }

    /// Return the values of a signal just after the sample times.
    fn values_at_samples(&self, signal: usize) -> Result<Vec<f64>> {
        let OutputSimulation { recording, times, .. } = self.simulation;
        let (channel, means) = (recording.channel(signal)?, self.record.signal(signal));
        if let (Some(interpolation), Some(times)) = (&self.interpolation, times) {
            return Ok(recording.values_at(signal, times).unwrap_or_else(|| interpolation.interpolate(means)));
        }
        let is_filtered = self.record.is_filtered() && !channel.is_filtered;
        if !is_filtered && channel.delay.unwrap_or(0.0) == 0.0 {
            // The signal may have a slope discontinuity at the sample, which a mean over pulses would round off.
            return Ok(recording.acting_samples(signal).into_owned());
        }
        if is_filtered || !channel.is_zero_order_hold() {
            return Ok(point_samples(means).into_iter().step_by(self.pulses_per_sample).collect());
        }
        Ok(means.iter().copied().step_by(self.pulses_per_sample).chain(means.last().copied()).collect())
    }

    /// Return, for each output, the part of its samples that is due to the response after the sample time. The first
    /// and the last sample are omitted. This part must be subtracted from a sample that is the average of the pulse
    /// means before and after it.
    ///
    /// This part is half of the response in the first pulse after a jump or a slope discontinuity of an input. At the
    /// sample time only direct feedthrough acts, as in the joint fit.
    fn responses_after_sample(&self) -> Result<Rows> {
        let OutputSimulation { recording, equations, .. } = self.simulation;
        let (n, m, pulses_per_sample) = (equations.len(), self.record.m(), self.pulses_per_sample);
        let signals = recording.channels().len();
        // Gains over the first pulse, and gains of direct feedthrough.
        let mut systems = [identity(n), identity(n)];
        let mut input_gains = [vec![0.0; n * signals], vec![0.0; n * signals]];
        let mut jump_halves: Vec<Option<Vec<f64>>> = vec![None; signals];
        for (i, Equation { structure, coefficients }) in equations.iter().enumerate() {
            for (k, (term, &c)) in structure.terms.iter().zip(coefficients).enumerate() {
                let (eta, channel) = (structure.integration(k), recording.channel(term.signal)?);
                let output =
                    self.simulation.simulated_output(term.signal).or((term.signal == structure.output).then_some(i));
                if output.is_none()
                    && (channel.role == Role::Derived || (self.record.is_filtered() && !channel.is_filtered))
                {
                    // The filter smooths this signal, or only its pulse means are known.
                    continue;
                }
                let gains = [first_coefficient(eta, self.record.step()), f64::from(eta.abs() <= ORDER_TOLERANCE)];
                for ((system, input_gains), gain) in systems.iter_mut().zip(&mut input_gains).zip(gains) {
                    match output {
                        Some(j) => system[i * n + j] -= c * gain,
                        None => input_gains[i * signals + term.signal] += c * gain,
                    }
                }
                if output.is_none() && jump_halves[term.signal].is_none() {
                    let (means, sign) =
                        (self.record.signal(term.signal), if channel.is_zero_order_hold() { 1.0 } else { -1.0 });
                    let values = self.values_at_samples(term.signal)?;
                    let jump_half = (pulses_per_sample..m).step_by(pulses_per_sample).zip(&values[1..]);
                    let jump_half = jump_half
                        .map(|(pulse, value)| sign * (value - 0.5 * (means[pulse - 1] + means[pulse])))
                        .collect();
                    jump_halves[term.signal] = Some(jump_half);
                }
            }
        }
        let inverses = [small::inverse(&systems[0], n)?, small::inverse(&systems[1], n)?];
        let gain = |kind: usize, i: usize, signal: usize| -> f64 {
            (0..n).map(|j| inverses[kind][i * n + j] * input_gains[kind][j * signals + signal]).sum()
        };
        let mut out = vec![vec![0.0; m / pulses_per_sample - 1]; n];
        for (signal, jump_half) in jump_halves.iter().enumerate() {
            for (i, row) in out.iter_mut().enumerate() {
                add_multiple(row, gain(0, i, signal) - gain(1, i, signal), jump_half.as_deref().unwrap_or_default());
            }
        }
        Ok(out)
    }

    /// Return the kink corrections at nonuniform sample times, for the slope discontinuities due to input jumps and
    /// initial terms.
    ///
    /// A correction includes the direct path of a jump and one pass through each term of the output, as in the joint
    /// fit.
    fn kink_corrections(&self, interpolation: &SampleInterpolation, terms: &Terms, is_driven: bool) -> Rows {
        let OutputSimulation { recording, equations, .. } = self.simulation;
        let step = self.record.step();
        let mut out = vec![vec![0.0; interpolation.len()]; equations.len()];
        for (i, Equation { structure, coefficients }) in equations.iter().enumerate() {
            for &(power, value) in terms[i].iter().filter(|(power, value)| *value != 0.0 && power.fract() != 0.0) {
                let jump = interpolation.jumps(&[0.0], &[value * libm::tgamma(power + 1.0)]);
                add_multiple(&mut out[i], 1.0, &interpolation.kink_corrections(&jump, power, step));
            }
            let is_known_correction = |k: usize| {
                let signal = structure.terms[k].signal;
                self.is_derived(signal) || self.simulation.simulated_output(signal).is_some()
            };
            let autoregressive_terms: Vec<usize> =
                (0..coefficients.len()).filter(|&k| structure.terms[k].signal == structure.output).collect();
            for k in (0..coefficients.len())
                .filter(|&k| is_driven && !autoregressive_terms.contains(&k) && !is_known_correction(k))
            {
                let Some((times, jump_sizes)) = recording.jumps(structure.terms[k].signal) else { continue };
                let jumps = interpolation.jumps(&times.iter().map(|time| time / step).collect::<Vec<_>>(), &jump_sizes);
                for path in
                    std::iter::once(vec![k]).chain(autoregressive_terms.iter().map(|&other_term| vec![k, other_term]))
                {
                    let order: f64 = path.iter().map(|&k| structure.order - structure.terms[k].order).sum();
                    if order <= ORDER_TOLERANCE || (path.len() > 1 && order >= SMOOTH_INTEGRATION_ORDER) {
                        continue;
                    }
                    let gain: f64 = path.iter().map(|&k| coefficients[k]).product();
                    add_multiple(&mut out[i], gain, &interpolation.kink_corrections(&jumps, order, step));
                }
            }
        }
        out
    }
}

/// Return the n × n identity matrix, row-major.
fn identity(n: usize) -> Vec<f64> {
    (0..n * n).map(|k| f64::from(u8::from(k % (n + 1) == 0))).collect()
}
