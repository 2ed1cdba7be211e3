//! An attempt in a race: where it is, and where it came from.

use super::attempt::{Attempt, Place};

/// An attempt with the start that led to it, and those of others that came to the same place.
#[derive(Debug, Clone, PartialEq)]
pub struct Runner {
    /// Where it is.
    pub attempt: Attempt,
    /// Its start, in words.
    pub origin: String,
    /// Those of the others.
    pub alike: Vec<String>,
}

impl Runner {
    /// Before its first descent.
    #[must_use]
    pub fn at(place: Place, origin: impl Into<String>) -> Self {
        Self { attempt: Attempt::unrun(place), origin: origin.into(), alike: Vec::new() }
    }

    /// The same where a descent led it.
    #[must_use]
    pub fn moved(&self, attempt: Attempt) -> Self {
        Self { attempt, ..self.clone() }
    }

    /// Cost per residual.
    #[must_use]
    pub fn level(&self) -> f64 {
        self.attempt.level()
    }
}
