//! Dry friction of a pulse: F(v) sgn(v), set-valued at rest, with F(v) = fc + fs exp(−(v/vs)²).
//!
//! [`law`] computes the friction of one body in closed form, [`contact`] that of coupled bodies. The end velocity of a
//! body is V = P − g φ. P is the end velocity without its friction, φ ∈ F(V) sgn(V) the mean friction over the pulse,
//! and g the velocity change per unit of force. A body at rest stays exactly at rest while the force is at most the
//! static friction. The equations of motion are in [`nonlinear`](crate::nonlinear).

pub mod contact;
pub mod law;

pub use law::FrictionLaw;
