//! Every way a computation can fail, with its numbers and the way out.

use thiserror::Error;

/// What went wrong, named so that a person can act on it.
///
/// [`Error::kind`] groups the variants for bindings: data, model, convergence, interruption, internal.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum Error {
    /// A signal holds a NaN or an infinity.
    #[error("{name} is not finite at index {index} ({count} such values in all); remove or replace these samples")]
    NotFinite {
        /// Which argument.
        name: String,
        /// First bad index.
        index: usize,
        /// How many values are not finite.
        count: usize,
    },
    /// Two things that must have the same length do not.
    #[error("{name} has length {found}, but {expected} is needed; give signals of equal length")]
    Length {
        /// Which argument.
        name: String,
        /// Length needed.
        expected: usize,
        /// Length given.
        found: usize,
    },
    /// A number outside the range in which it means something.
    #[error("{name} = {value} is outside {range}; {remedy}")]
    OutOfRange {
        /// Which argument.
        name: String,
        /// The value given.
        value: f64,
        /// The range in words.
        range: String,
        /// What to do.
        remedy: String,
    },
    /// Haar coordinates asked for a length that is no power of two.
    #[error("Haar coordinates need m to be a power of two, not {m}; take m = {below} or {above}, or block-pulse (time) coordinates")]
    NotPowerOfTwo {
        /// The length given.
        m: usize,
        /// Nearest power of two below.
        below: usize,
        /// Nearest power of two above.
        above: usize,
    },
    /// A series cannot be divided by one that starts with zero (or nearly so, for a coupled system).
    #[error("the series to divide by starts with {leading:e} at z^0; the equation is not solvable for its output (an own-output term of the highest order with coefficient 1?)")]
    LeadingZero {
        /// The leading coefficient, or the pivot of the leading matrix.
        leading: f64,
    },
    /// Regressors that cannot be told apart.
    #[error("regressor {index} of {count} is a combination of the others to working precision; remove a term or move its order")]
    Singular {
        /// First dependent regressor.
        index: usize,
        /// Number of regressors.
        count: usize,
    },
    /// A lattice with no candidate in it.
    #[error("the lattice holds no candidate: {why}; widen the intervals or refine the step")]
    EmptyLattice {
        /// Which condition no order met.
        why: String,
    },
    /// A lattice too large to search.
    #[error("the lattice holds up to {count} candidates, more than the limit of {limit}: up to {} of one core at 10 ns each, as fast as searches are at best; take a larger step, narrower intervals or fixed orders", spent(*count))]
    LatticeTooLarge {
        /// Number of candidates, or of the tuples of its axes where they were not gone through.
        count: u128,
        /// Largest number searched.
        limit: u128,
    },
    /// A bank of regressors that would not fit the memory set aside for it.
    #[error("the bank of {columns} regressors of {m} pulses and their products needs {bytes} bytes, more than the limit of {limit}; take a smaller m, a larger step or narrower intervals")]
    BankTooLarge {
        /// Number of columns.
        columns: usize,
        /// Pulses.
        m: usize,
        /// Memory needed.
        bytes: u128,
        /// Memory allowed.
        limit: u128,
    },
    /// What a search would hold at once does not fit the memory that it may take.
    #[error("{what} need {bytes} bytes, more than the {limit} that a search may take; take a smaller m, a larger step, narrower intervals or fewer runs at once, or allow more by FTLM_MEMORY")]
    Memory {
        /// What is to be held.
        what: String,
        /// Memory needed.
        bytes: u128,
        /// Memory allowed.
        limit: u128,
    },
    /// An equation names a signal that the record does not hold, or is otherwise malformed.
    #[error("{what}; {remedy}")]
    Structure {
        /// What is wrong.
        what: String,
        /// What to do.
        remedy: String,
    },
    /// A response or an estimate left the range of floating point.
    #[error("the {what} stopped being finite at index {index}; the model is unstable over this record")]
    Diverged {
        /// Which computation.
        what: String,
        /// First index that is not finite.
        index: usize,
    },
    /// Wherever a fit starts, it ends beyond the range of floating point.
    #[error("wherever it starts, the free run of {output} ends beyond the range of numbers: it grows; leave out the term that pushes, or bound its coefficient")]
    Beyond {
        /// Which output.
        output: String,
    },
    /// Runs that could not be sampled as a fit asked.
    #[error("runs could not be sampled: {why}; give runs that can be")]
    Source {
        /// What their source said.
        why: String,
    },
    /// The caller asked to stop.
    #[error("interrupted")]
    Interrupted,
    /// Threads that the system would not start.
    #[error("{threads} threads could not be started: {why}; ask for fewer")]
    Threads {
        /// Number asked for.
        threads: usize,
        /// What the system said.
        why: String,
    },
    /// A fault in ftlm itself.
    #[error("internal fault: {what}; please report it")]
    Internal {
        /// What was found.
        what: String,
    },
}

/// The family of an [`enum@Error`]; each becomes one exception class in Python.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The data given cannot be used.
    Data,
    /// The model, the equation or the lattice cannot be used.
    Model,
    /// A computation ended without an answer.
    Convergence,
    /// The caller asked to stop.
    Interrupted,
    /// A fault in ftlm.
    Internal,
}

impl Error {
    /// The family of this error.
    #[must_use]
    pub fn kind(&self) -> Kind {
        match self {
            Self::NotFinite { .. } | Self::Length { .. } | Self::Source { .. } => Kind::Data,
            Self::Diverged { .. } | Self::Singular { .. } | Self::Beyond { .. } => Kind::Convergence,
            Self::Interrupted => Kind::Interrupted,
            Self::Internal { .. } => Kind::Internal,
            _ => Kind::Model,
        }
    }
}

/// Result of a computation of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Refuses a slice with a value that is not finite.
///
/// # Errors
/// [`Error::NotFinite`] with the first bad index and the count.
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

/// Refuses a length other than the one needed.
///
/// # Errors
/// [`Error::Length`] with both lengths.
pub fn check_length(name: &str, expected: usize, found: usize) -> Result<()> {
    if expected == found {
        Ok(())
    } else {
        Err(Error::Length { name: name.to_owned(), expected, found })
    }
}

/// What so many candidates take at 10 ns each, in words.
#[allow(clippy::cast_precision_loss)]
fn spent(candidates: u128) -> String {
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

/// Refuses a step that is not a positive, finite number.
///
/// # Errors
/// [`Error::OutOfRange`].
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

/// Most points of a series or a record: a hundred times the longest runs, a gigabyte a signal, and far below 2³¹, where
/// the tables of prime divisors end. More is a slip of the hand that would exhaust memory.
pub const MOST_POINTS: usize = 1 << 27;

/// Refuses a number of points beyond [`MOST_POINTS`].
///
/// # Errors
/// [`Error::OutOfRange`].
pub fn check_points(name: &str, m: usize) -> Result<()> {
    if m <= MOST_POINTS {
        return Ok(());
    }
    #[allow(clippy::cast_precision_loss)]
    Err(Error::OutOfRange {
        name: name.to_owned(),
        value: m as f64,
        range: format!("[0, {MOST_POINTS}]"),
        remedy: "ask for as many points as the record has".into(),
    })
}

/// Largest side of a dense matrix: two gigabytes. They are for study.
pub const LARGEST_DENSE: usize = 1 << 14;

/// Refuses a dense matrix without rows, or with more than [`LARGEST_DENSE`].
///
/// # Errors
/// [`Error::OutOfRange`].
pub fn check_dense(m: usize) -> Result<()> {
    if (1..=LARGEST_DENSE).contains(&m) {
        return Ok(());
    }
    #[allow(clippy::cast_precision_loss)]
    Err(Error::OutOfRange {
        name: "m".into(),
        value: m as f64,
        range: format!("[1, {LARGEST_DENSE}]"),
        remedy: "dense matrices are for study; apply the operator as a series instead".into(),
    })
}
