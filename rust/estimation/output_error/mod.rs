//! Output-error estimation of all equations of a model on all records, with continuous orders, by Levenberg–Marquardt.
//!
//! The output error is the measured minus the simulated output. For white output noise, the estimate is maximum
//! likelihood. The simulation (free run: only inputs and initial conditions are used) solves A y = b by exact division
//! of power series. A contains the operators of the outputs y, and b is the contribution of the inputs. The sensitivity
//! to a parameter is A⁻¹(∂b − ∂A y), a sum of products of three series. With the spectra of A⁻¹, it costs one inverse
//! transform per parameter and output. Initial terms are linear and projected out (variable projection in Kaufman's
//! form, doi:10.1007/BF01932995).
//!
//! A sample at a time t is compared with the mean of the two pulses next to t, plus the direct feedthrough of the
//! inputs. The pulses can be shorter than the sampling interval. Missing samples have zero weight. Nonuniform samples
//! are compared at their own times. For integer orders, and for any orders on long records, exact samples are computed
//! without pulses.

pub(crate) mod evaluation;
mod evaluation_cache;
pub mod experiment;
mod feedthrough;
pub mod fit;
pub(crate) mod fractional_orders;
pub(crate) mod integer_orders;
mod jacobian;
mod kink_correction;
pub mod parameterization;
mod residuals;
pub mod stability;
mod system_inverse;

pub use crate::estimation::optimization::levenberg_marquardt::{MinimizationSettings, Status};
pub use experiment::{Experiment, NonuniformSamples, PointValues};
pub use fit::{fit, fit_stable, fit_until, OutputErrorFit};
pub use parameterization::{Coordinate, FreeEquation, FreeInput, FreeModel, InputLaw, Monomial, ParameterPoint};
