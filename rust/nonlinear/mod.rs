//! Equations with non-linear terms and dry friction: simulation pulse by pulse, sensitivities, output error.
//!
//! An equation is D^α y = Σ c D^ν s + Σ k D^μ n − F(Dy) sgn(Dy) with coefficients c and k. s is a signal, and n the
//! value of an expression over signals and their derivatives ([`DerivedSignal`](crate::expression::DerivedSignal)). F
//! is a [`FrictionLaw`](crate::friction::FrictionLaw). In n, derivatives of outputs have orders of at most α − μ. The
//! scheme is of second order in the step and implicit. Newton iterations solve for the non-linear terms of a pulse, and
//! the contact law gives its friction. The past enters only through online convolutions with the kernels of fractional
//! integrals.

mod channels;
mod contact;
pub mod convolution;
mod fit;
mod initial_state;
mod input_continuation;
mod jumps;
mod model;
mod operators;
mod pulse;
mod sensitivity;
mod system;
mod time_stepping;

pub use contact::BodyMotion;
pub use fit::{fit, InitialGuess, NonlinearFit};
pub use model::{filtered_outputs, FreeFrictionLaw, NonlinearModel};
pub(crate) use system::unsupported_with;
pub use system::NonlinearSystem;

use crate::error::{check_length, Result};
use crate::regressors::{add_impulses, split_impulses, Record};

/// Simulation of a system: its outputs, and the motion of its bodies with friction.
#[derive(Debug, Clone, PartialEq)]
pub struct NonlinearResponse {
    /// Pulse means of each output; NaN from the first pulse that overflows.
    pub outputs: Vec<Vec<f64>>,
    /// Motion of each body with friction.
    pub bodies: Vec<BodyMotion>,
}

impl NonlinearSystem {
    /// Simulate the system with initial terms, which are powers of t. `initial` holds (exponent, coefficient) of each
    /// power, by equation.
    ///
    /// Outputs are NaN from the first pulse that overflows. The cost is O(d m log² m) for d convolutions of m pulses,
    /// and O(d m) for integer orders.
    ///
    /// The exponents −1, −2, … add an impulse and its derivatives to the output alone; they do not enter the equations.
    /// At the output of a sensor filter they become the initial transient of the filter.
    ///
    /// # Errors
    /// [`Error::NoSolution`](crate::error::Error::NoSolution) for a pulse whose equations have no solution although no
    /// value overflows. [`Error::NotSimulable`](crate::error::Error::NotSimulable) if coupled bodies have no unique friction
    /// forces at this step. The errors of [`NonlinearSystem::check`] for an invalid system.
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// use ftlm::equation::{Equation, Structure, Term};
    /// use ftlm::expression::{DerivedSignal, Expression, Instruction};
    /// use ftlm::nonlinear::NonlinearSystem;
    /// use ftlm::regressors::Record;
    /// // D y = u − y² with u = 1 from rest: tanh t. Signal 2 is y².
    /// let square = Expression::new(vec![Instruction::Channel(0), Instruction::Power(2.0)], 1)?;
    /// let terms = vec![Term { signal: 1, order: 0.0 }, Term { signal: 2, order: 0.0 }];
    /// let equation = Equation::new(Structure { output: 0, order: 1.0, terms }, vec![1.0, -1.0])?;
    /// let derived = vec![DerivedSignal::new(square, vec![(0, 0.0)])?];
    /// let frictions = Vec::new();
    /// let system = NonlinearSystem { equations: vec![equation], derived, recorded: 2, coupled: true, frictions };
    /// let run = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 200], vec![1.0; 200]]), None)?;
    /// let y = &system.run(&run, &[vec![]])?.outputs[0];
    /// assert!((0.5 * (y[99] + y[100]) - 1.0_f64.tanh()).abs() < 1e-4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// use ftlm::equation::{Equation, Structure, Term};
    /// use ftlm::friction::FrictionLaw;
    /// use ftlm::nonlinear::NonlinearSystem;
    /// use ftlm::regressors::Record;
    /// // A block slides at 1 m/s with friction of 2 m/s²: it stops after half a second and 0.25 m.
    /// let structure = Structure { output: 0, order: 2.0, terms: vec![Term { signal: 1, order: 0.0 }] };
    /// let frictions = vec![(0, FrictionLaw::coulomb(2.0))];
    /// let block = NonlinearSystem::with_friction(vec![Equation::new(structure, vec![1.0])?], frictions, 2);
    /// let run = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 100], vec![0.0; 100]]), None)?;
    /// let motion = block.run(&run, &[vec![(1.0, 1.0)]])?;
    /// let velocity = &motion.bodies[0].velocity;
    /// assert!((velocity[25] - 0.5).abs() < 1e-12 && velocity[50..].iter().all(|v| v.abs() < 1e-12));
    /// assert!((motion.outputs[0][99] - 0.25).abs() < 1e-9);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn run(&self, record: &Record, initial: &[Vec<(f64, f64)>]) -> Result<NonlinearResponse> {
        self.check()?;
        check_length("initial terms", self.equations.len(), initial.len())?;
        let (powers, impulses) = split_impulses(initial);
        let operators = operators::Operators::new(self, record)?;
        let mut forcing = operators.initial_forcing(self, &powers)?;
        operators.add_inputs(self, record, &mut forcing);
        let (run, end) = operators.run(self, &forcing, None);
        if let Some(end) = end.filter(|end| !end.is_overflow) {
            return Err(end.error(record.step()));
        }
        let bodies = operators.body_motions(&forcing, &run);
        let mut outputs = run.sources;
        outputs.truncate(self.equations.len());
        outputs.iter_mut().for_each(|row| row.resize(record.m(), f64::NAN));
        add_impulses(&mut outputs, &impulses, record.step());
        Ok(NonlinearResponse { outputs, bodies })
    }
}
