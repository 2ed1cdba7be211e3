//! Free runs of bodies with dry friction, alone or among bodies coupled to them, and their output error.
//!
//! D^α y = Σ c D^ν s − F(Dy) sgn(Dy) + … with 1 < α ≤ 2, sgn set-valued at rest and F(v) = fc + fs exp(−(v/vs)²)
//! ([`law`]). Everything but friction is linear, so superposition leaves one number a pulse and body that may stick: the
//! velocity at the edges of the pulses is V = L − g ∗ φ with φ ∈ F(V) sgn(V), L the velocity without friction and g what a
//! pulse of force does to it, both of the coupled equations ([`dynamics`]). It is marched pulse by pulse, the
//! frictions of several bodies decided together ([`contact`]), the sum over the past by blocked transforms
//! ([`convolution`]). A body at rest stays exactly at rest while friction can hold it.
//!
//! Derivatives follow the march: φ is F while the body slides, and what holds it while it sticks. Offsets and the state in
//! which a run starts enter through the velocity, so they are no projection here but numbers of each run.

pub mod contact;
pub mod convolution;
pub mod dynamics;
pub mod fit;
mod initial_state;
pub mod law;
mod model;

pub use dynamics::{Body, Motion};
pub use fit::{fit, fit_until, Fit, Start};
pub use law::Law;
pub use model::{passing, FreeLaw, FrictionModel};
