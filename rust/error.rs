//! Errors of all computations. Each contains the values found and a remedy.

use thiserror::Error;

/// Error with its cause and a remedy.
///
/// [`Error::kind`] groups the variants for bindings: data, model, convergence, interruption, internal.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum Error {
    /// A signal or argument contains NaN or infinity.
    #[error("{name} is not finite at index {index} ({count} such values in all); remove or replace these samples")]
    NotFinite {
        /// Name of the argument.
        name: String,
        /// Index of the first value that is not finite.
        index: usize,
        /// Number of values that are not finite.
        count: usize,
    },
    /// Lengths that must be equal differ.
    #[error("{name} has length {found}, but {expected} is needed; give signals of equal length")]
    Length {
        /// Name of the argument.
        name: String,
        /// Length that is required.
        expected: usize,
        /// Length found.
        found: usize,
    },
    /// A value is out of range.
    #[error("{name} = {} is outside {range}; {remedy}", format_number(*value))]
    OutOfRange {
        /// Name of the argument.
        name: String,
        /// Value found.
        value: f64,
        /// Valid range as text.
        range: String,
        /// Remedy.
        remedy: String,
    },
    /// Haar coordinates of a length that is not a power of two.
    #[error("Haar coordinates need m to be a power of two, not {m}; take m = {below} or {above}, or block-pulse (time) coordinates")]
    NotPowerOfTwo {
        /// Length that was given.
        m: usize,
        /// Largest power of two below the length.
        below: usize,
        /// Smallest power of two above the length.
        above: usize,
    },
    /// Division by a series whose first coefficient is zero or nearly zero. In a coupled system: a singular leading
    /// matrix.
    #[error("the leading coefficient of a divisor series is {leading:e}, so that the equation cannot be solved for its output; check for a term of the output at the highest order with coefficient 1")]
    LeadingZero {
        /// First coefficient of the series, or the pivot of the leading matrix.
        leading: f64,
    },
    /// Linearly dependent regressors.
    #[error("regressor {index} of {count} is a linear combination of the others to machine precision; remove a term or change its order")]
    Singular {
        /// Index of the first dependent regressor.
        index: usize,
        /// Number of regressors.
        count: usize,
    },
    /// Order grid without candidates.
    #[error(
        "the order grid has no candidate: {reason}; widen the intervals of the orders, or use a smaller increment"
    )]
    EmptyOrderGrid {
        /// Condition that no combination of orders satisfies.
        reason: String,
    },
    /// Order grid with too many candidates.
    #[error("the order grid has up to {count} candidates, more than the limit of {limit}; at 10 ns per candidate, the best case, a search takes {} on one core; use a larger increment of the order grid, narrower intervals of the orders, or fixed orders", format_search_time(*count))]
    OrderGridTooLarge {
        /// Number of candidates. If the candidates were not enumerated, the number of all tuples of orders.
        count: u128,
        /// Maximum number of candidates.
        limit: u128,
    },
    /// Bank of regressors that exceeds the memory limit.
    #[error("{columns} regressors of {m} pulses and their products need {bytes} bytes, more than the limit of {limit}; use a smaller m, a larger increment of the order grid, or narrower intervals of the orders")]
    BankTooLarge {
        /// Number of regressors.
        columns: usize,
        /// Number of pulses of each regressor.
        m: usize,
        /// Memory needed, in bytes.
        bytes: u128,
        /// Memory allowed, in bytes.
        limit: u128,
    },
    /// Working memory that exceeds its limit.
    #[error("{what} need {bytes} bytes, more than the limit of {limit}; use a smaller m, a larger increment of the order grid, narrower intervals of the orders, fewer or shorter runs, or raise the memory limit")]
    Memory {
        /// Description of the data that need the memory.
        what: String,
        /// Memory needed, in bytes.
        bytes: u128,
        /// Memory allowed, in bytes.
        limit: u128,
    },
    /// Inconsistent model, for example an equation with a signal that the record does not have.
    #[error("{what}; {remedy}")]
    Structure {
        /// Cause.
        what: String,
        /// Remedy.
        remedy: String,
    },
    /// Parameter values at which the equations cannot be simulated.
    #[error(
        "the equations cannot be simulated at these parameter values: {reason}; change the orders or coefficients"
    )]
    NotSimulable {
        /// Reason, as a clause.
        reason: String,
    },
    /// Simulation, derivative or estimate without a finite result.
    #[error("the {what} is not finite from index {index} on; the model is unstable on this record, so change its orders or coefficients")]
    Diverged {
        /// Name of the computation.
        what: String,
        /// Index of the first value that is not finite.
        index: usize,
    },
    /// Pulse of a simulation whose non-linear equations have no solution.
    #[error("the equations have no solution at {time:.4} s (pulse {index}) of the simulation: {reason}; shorten the step, or check the coefficients of the non-linear terms")]
    NoSolution {
        /// Middle of the pulse \[s\].
        time: f64,
        /// Index of the pulse.
        index: usize,
        /// Cause.
        reason: String,
    },
    /// Fit in which the squares of the residuals of an output overflow.
    #[error("the simulation of {output} overflows from every initial guess; remove the term that makes the model unstable, or bound its coefficient")]
    Overflow {
        /// Name of the output.
        output: String,
    },
    /// Run with unusable data: too few samples, a signal that is too small, or a body with friction that does not move.
    #[error("{what}; {remedy}")]
    Recording {
        /// Cause.
        what: String,
        /// Remedy.
        remedy: String,
    },
    /// Computation that the caller stopped.
    #[error("interrupted")]
    Interrupted,
    /// Threads that the operating system cannot start.
    #[error("{threads} threads could not be started: {reason}; use fewer threads")]
    Threads {
        /// Number of requested threads.
        threads: usize,
        /// Message of the operating system.
        reason: String,
    },
    /// Internal error of ftlm.
    #[error("internal fault: {what}; please report it")]
    Internal {
        /// Condition that is violated.
        what: String,
    },
}

/// Category of an [`enum@Error`]. Each category is one exception class in Python.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Invalid data.
    Data,
    /// Invalid model, equation or order grid.
    Model,
    /// No convergence.
    Convergence,
    /// Interruption by the caller.
    Interrupted,
    /// Internal error of ftlm.
    Internal,
}

impl Error {
    /// Return the error for a term whose order is above that of its equation.
    pub(crate) fn term_above_equation() -> Self {
        Self::NotSimulable { reason: "the order of a term is above that of its equation".into() }
    }

    /// True if this error ends a simulation early, so that an optimizer must shorten its step.
    #[must_use]
    pub fn ends_simulation(&self) -> bool {
        matches!(
            self,
            Self::Diverged { .. } | Self::NotSimulable { .. } | Self::NoSolution { .. } | Self::LeadingZero { .. }
        )
    }

    /// Return the category of this error.
    #[must_use]
    pub fn kind(&self) -> Kind {
        match self {
            Self::NotFinite { .. } | Self::Length { .. } | Self::Recording { .. } => Kind::Data,
            Self::Diverged { .. }
            | Self::NotSimulable { .. }
            | Self::NoSolution { .. }
            | Self::Singular { .. }
            | Self::Overflow { .. } => Kind::Convergence,
            Self::Interrupted => Kind::Interrupted,
            Self::Internal { .. } => Kind::Internal,
            _ => Kind::Model,
        }
    }
}

/// Result of a computation of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Return an error if a value is not finite.
///
/// # Errors
/// [`Error::NotFinite`] with the index of the first such value and the number of such values.
///
/// ```
/// let error = ftlm::error::check_finite("x", &[0.0, f64::NAN]).unwrap_err();
/// assert!(error.to_string().starts_with("x is not finite at index 1"));
/// ```
pub fn check_finite(name: &str, values: &[f64]) -> Result<()> {
    match values.iter().position(|v| !v.is_finite()) {
        None => Ok(()),
        Some(index) => Err(Error::NotFinite {
            name: name.to_owned(),
            index,
            count: values.iter().filter(|v| !v.is_finite()).count(),
        }),
    }
}

/// Return an error if a length differs from the expected one.
///
/// # Errors
/// [`Error::Length`] with both lengths.
pub fn check_length(name: &str, expected: usize, actual: usize) -> Result<()> {
    if expected == actual {
        Ok(())
    } else {
        Err(Error::Length { name: name.to_owned(), expected, found: actual })
    }
}

/// Return an error if a result that depends on the step is not finite.
///
/// # Errors
/// [`Error::OutOfRange`] for the step.
pub(crate) fn check_overflow(result: &[f64], step: f64) -> Result<()> {
    if result.iter().all(|v| v.is_finite()) {
        return Ok(());
    }
    Err(Error::OutOfRange {
        name: "step".into(),
        value: step,
        range: "the steps for which the result is finite".into(),
        remedy: "change the unit of time or of the signal".into(),
    })
}

/// Format a number. Very small and very large magnitudes have an exponent in place of many zeros.
fn format_number(value: f64) -> String {
    let plain = value == 0.0 || !value.is_finite() || (1e-9..1e16).contains(&value.abs());
    if plain {
        format!("{value}")
    } else {
        format!("{value:e}")
    }
}

/// Return the minimum duration of a search over `candidates` candidates as text, at 10 ns per candidate.
#[allow(clippy::cast_precision_loss)]
fn format_search_time(candidates: u128) -> String {
    let seconds = candidates as f64 * 1e-8;
    let units = [("years", 31_557_600.0), ("days", 86_400.0), ("hours", 3600.0), ("minutes", 60.0)];
    let (unit, size) = units.into_iter().find(|(_, size)| seconds >= 2.0 * size).unwrap_or(("seconds", 1.0));
    let amount = seconds / size;
    if amount < 1e4 {
        format!("{amount:.1} {unit}")
    } else {
        format!("{amount:.1e} {unit}")
    }
}

/// Return an error if the step is not positive and finite.
///
/// # Errors
/// [`Error::OutOfRange`] for the step.
pub fn check_step(step: f64) -> Result<()> {
    if step.is_finite() && step > 0.0 {
        Ok(())
    } else {
        Err(Error::OutOfRange {
            name: "step".into(),
            value: step,
            range: "(0, ∞)".into(),
            remedy: "give the sampling step in seconds".into(),
        })
    }
}

/// Maximum number of points of a series or a record: 1 GiB per signal. A larger number is probably a mistake, and would
/// exhaust memory. Twice this number fits into the 32-bit integers of the tables of prime divisors.
pub const MAX_POINTS: usize = 1 << 27;

/// Return an error if `m` exceeds [`MAX_POINTS`].
///
/// # Errors
/// [`Error::OutOfRange`] for the argument `name`.
pub fn check_points(name: &str, m: usize) -> Result<()> {
    if m <= MAX_POINTS {
        return Ok(());
    }
    #[allow(clippy::cast_precision_loss)]
    Err(Error::OutOfRange {
        name: name.to_owned(),
        value: m as f64,
        range: format!("[0, {MAX_POINTS}]"),
        remedy: "use a number of points between 1 and that of the record".into(),
    })
}

/// Return an error if data need more bytes than the limit. `what` describes the data.
///
/// # Errors
/// [`Error::Memory`] with the bytes needed and the limit.
pub fn check_memory(what: impl FnOnce() -> String, bytes: usize, limit: usize) -> Result<()> {
    if bytes <= limit {
        return Ok(());
    }
    Err(Error::Memory { what: what(), bytes: bytes as u128, limit: limit as u128 })
}

/// Maximum number of rows of a square dense matrix, which takes two gigabytes. Dense matrices are for study only.
pub const MAX_DENSE_ROWS: usize = 1 << 14;

/// Return an error if a dense matrix has no rows or more than [`MAX_DENSE_ROWS`].
///
/// # Errors
/// [`Error::OutOfRange`] for the number of rows `m`.
pub fn check_dense(m: usize) -> Result<()> {
    if (1..=MAX_DENSE_ROWS).contains(&m) {
        return Ok(());
    }
    #[allow(clippy::cast_precision_loss)]
    Err(Error::OutOfRange {
        name: "m".into(),
        value: m as f64,
        range: format!("[1, {MAX_DENSE_ROWS}]"),
        remedy: "apply the operator as a series, since dense matrices of this size are too large".into(),
    })
}
