//! Dry friction: simulation of bodies with friction, alone or coupled, and their output error.
//!
//! D^α y = Σ c D^ν s − F(Dy) sgn(Dy) + … with 1 < α ≤ 2, sgn set-valued at rest and F(v) = fc + fs exp(−(v/vs)²)
//! ([`law`]). Everything except friction is linear. Superposition therefore leaves one unknown a pulse and body: the
//! velocity at the pulse edges is V = L − g ∗ φ with φ ∈ F(V) sgn(V). L is the velocity without friction and g its
//! response to a pulse of force, both from the coupled equations ([`dynamics`]). Time stepping ([`contact`]) solves for
//! φ pulse by pulse, for all bodies at once, with a blocked convolution over the past ([`convolution`]). A body at rest
//! stays exactly at rest while friction can hold it.
//!
//! Derivatives follow the time stepping: φ is F while the body slides, and the holding force while it sticks. Offsets
//! and initial states enter through the velocity. They are parameters of each run and are not projected out.

pub mod contact;
pub mod convolution;
pub mod dynamics;
pub mod fit;
pub(crate) mod initial_state;
pub mod law;
pub(crate) mod model;

pub use dynamics::{Body, Motion};
pub use fit::{fit, fit_until, Start, StateFit};
pub use law::FrictionLaw;
pub use model::{filtered_outputs, FreeFrictionLaw, FrictionModel};
