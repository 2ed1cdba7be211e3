//! Joint output error: all equations of a model, all records, all orders continuous, by Levenberg–Marquardt.
//!
//! For white noise on the outputs this is maximum likelihood. The free run solves A y = b in series, by exact division.
//! Its sensitivity to a parameter is A⁻¹(∂b − ∂A y), a sum of products of three series: with the spectra of A⁻¹ at hand,
//! one inverse transform a parameter and output. Rejected steps cost no Jacobian. Initial terms are linear and projected
//! out (variable projection, Kaufman's form, doi:10.1007/BF01932995). Records are compared sample by sample: y_k with the
//! mean of the pulses on either side of kh, on a grid that may be finer than the samples, plus what the inputs of that
//! instant feed through. Samples that were not read weigh nothing; samples at times of their own are compared there.

mod evaluation_cache;
pub mod experiment;
mod feedthrough;
pub mod fit;
mod jacobian;
mod kink_correction;
pub mod parameterization;
mod residuals;
pub mod stability;
mod system_inverse;

pub use crate::estimation::optimization::levenberg_marquardt::{Settings, Status};
pub use experiment::{Experiment, Instant, OwnTimes};
pub use fit::{fit, fit_steady, fit_until, Fit};
pub use parameterization::{Coordinate, FreeEquation, FreeInput, FreeModel, InputLaw, Monomial, Point};
