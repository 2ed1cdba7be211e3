//! Instrumental-variable estimation at given orders (refined IV, Young and Jakeman; fractional orders: Victor, Malti,
//! Garnier and Oustaloup, doi:10.1016/j.automatica.2012.12.006).
//!
//! Least squares on the equation error is biased because a measured output enters its own regressors with its noise.
//! Instruments are free of noise, because they are computed from the inputs and the model alone. Coupled equations are
//! refined one by one and then together. [`fit()`] performs all steps, given records of measured signals.

pub mod coupled;
pub mod fit;
pub mod prefilter;
pub mod single;
pub mod solution;

pub use fit::{fit, InstrumentalEstimate, InstrumentalFit};
pub use prefilter::{damped_inverse, low_pass, power_frequency, project, with_projections};
pub use single::{refine, step, InstrumentSource, Scratch};
pub use solution::{ExcludedTerms, InstrumentalSettings, Solution};
