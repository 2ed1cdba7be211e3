//! Joint output error: all equations of a model, all records, all orders continuous, by Levenberg–Marquardt.
//!
//! For white noise on the outputs this is maximum likelihood. The free run solves A y = b in series, by exact division.
//! Its sensitivity to a parameter is A⁻¹(∂b − ∂A y), a sum of products of three series: with the spectra of A⁻¹ at hand,
//! one inverse transform a parameter and output. Rejected steps cost no Jacobian. Initial terms are linear and projected
//! out (variable projection, Kaufman's form, doi:10.1007/BF01932995). Records are compared sample by sample: y_k with the
//! mean of the pulses on either side of kh, on a grid that may be finer than the samples, plus what the inputs of that
//! instant feed through. Samples that were not read weigh nothing; samples at times of their own are compared there.

pub(crate) mod clock;
mod corners;
mod curvature;
pub mod experiment;
mod feedthrough;
pub mod fit;
mod free_run;
pub mod input;
mod inverse;
pub mod levenberg_marquardt;
mod linear;
pub mod model;
mod operator;
mod part;
pub mod poles;
mod problem;
mod sensitivities;
mod shelf;
mod step;
mod valley;

pub use experiment::{Experiment, Instant, OwnTimes};
pub use fit::{fit, fit_steady, fit_until, Fit};
pub use input::{FreeInput, InputLaw};
pub use levenberg_marquardt::{Settings, Status};
pub use model::{Coordinate, FreeEquation, FreeModel, Monomial, Point};
