//! Dry friction in a pulse: F(v) sgn(v), set-valued at rest, with F(v) = fc + fs exp(−(v/vs)²).
//!
//! [`law`] computes the friction force of one body in closed form, and [`contact`] the friction forces of coupled
//! bodies. The velocity of a body at the end of the pulse is V = P − g φ. P is this velocity without friction, φ ∈ F(V)
//! sgn(V) the mean friction force over the pulse, and g the decrease of velocity per unit of force. A body at rest
//! stays exactly at rest while the force is at most the static friction. The equations of motion are in
//! [`nonlinear`](crate::nonlinear).

pub mod contact;
pub mod law;

pub use law::FrictionLaw;
