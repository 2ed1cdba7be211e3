//! Dry friction of a pulse: F(v) sgn(v), set-valued at rest, with F(v) = fc + fs exp(−(v/vs)²).
//!
//! [`law`] has the friction of one body in closed form, [`contact`] that of bodies that move each other. The end velocity
//! of a body is V = P − g φ: P without its friction, φ ∈ F(V) sgn(V) the mean friction over the pulse, g the velocity
//! change for a unit of force. A body at rest stays exactly at rest while friction can hold it. The equations of
//! motion belong to [`nonlinear`](crate::nonlinear).

pub mod contact;
pub mod law;

pub use law::FrictionLaw;
