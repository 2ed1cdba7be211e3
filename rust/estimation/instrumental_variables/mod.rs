//! Refined instrumental variables at given orders (Young and Jakeman; fractional orders: Victor, Malti, Garnier and
//! Oustaloup, doi:10.1016/j.automatica.2012.12.006).
//!
//! Least squares on the equation error is biased because a measured output is its own noise. Instruments hold none: they
//! are what the inputs alone make of the equations ([`prefilter`], [`single`]). Several equations that drive each other
//! are refined one by one and then together ([`coupled`]); [`fit()`] does all of it from raw records.

pub mod coupled;
pub mod fit;
pub mod prefilter;
pub mod single;
pub mod solution;

pub use fit::{fit, Estimate, Fit};
pub use prefilter::{damped_inverse, low_pass, power_frequency, project, with_projections};
pub use single::{refine, step, Scratch, Source};
pub use solution::{Dropped, Settings, Solution};
