//! Equations with non-linear terms: free run by Newton iterations pulse by pulse, sensitivities, output error.
//!
//! D^α y = Σ c D^ν s + Σ k D^μ n, where n is an expression over signals and derivatives of them
//! ([`DerivedSignal`](crate::expression::DerivedSignal)). Orders of the derivatives of outputs are at most α − μ. The
//! scheme is of second order in the step, and implicit. Dry friction may act beside the expressions. Memory is a blocked online convolution with the
//! kernels of fractional integrals alone.

mod channels;
mod contact;
mod forcing;
mod march;
mod model;

pub(crate) use march::refuse_beside;
pub use march::NonlinearSystem;
pub use model::{fit, NonlinearModel};

use crate::error::{check_length, Result};
use crate::regressors::{add_impulses, split_impulses, Record};

impl NonlinearSystem {
    /// Pulse means of each output in a free run with initial terms, (exponent, coefficient) pairs of powers of t by
    /// equation; NaN from the pulse on at which the run leaves the range of numbers. O(d m log² m) for d convolutions.
    ///
    /// The exponents −1, −2, … are an impulse and its derivatives in the output alone, as for
    /// [`Body::run`](crate::friction::Body::run).
    ///
    /// # Errors
    /// [`Error::NoSolution`](crate::error::Error::NoSolution) for a pulse whose equations have no solution, although the run is finite; as
    /// [`NonlinearSystem::check`].
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
    /// let y = &system.run(&run, &[vec![]])?[0];
    /// assert!((0.5 * (y[99] + y[100]) - 1.0_f64.tanh()).abs() < 1e-4);
    /// # Ok::<(), ftlm::error::Error>(())
    /// ```
    pub fn run(&self, record: &Record, initial: &[Vec<(f64, f64)>]) -> Result<Vec<Vec<f64>>> {
        self.check()?;
        check_length("initial terms", self.equations.len(), initial.len())?;
        let (powers, impulses) = split_impulses(initial);
        let operators = march::Operators::new(self, record)?;
        let mut forcing = operators.initial_forcing(self, &powers)?;
        operators.add_inputs(self, record, &mut forcing);
        let (run, end) = operators.run(self, &forcing);
        if let Some(end) = end.filter(|end| !end.is_overflow) {
            return Err(end.error(record.step()));
        }
        let mut outputs = run.sources;
        outputs.truncate(self.equations.len());
        outputs.iter_mut().for_each(|row| row.resize(record.m(), f64::NAN));
        add_impulses(&mut outputs, &impulses, record.step());
        Ok(outputs)
    }
}
