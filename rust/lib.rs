//! Fractional-order models of flexible machines from measured data.
//!
//! Modules in the sequence of the data flow:
//!
//! 1. [`signal`]: point samples become means over block pulses, and pulse means become nonuniform samples;
//! 2. [`fractional`], [`series`]: fractional integrals as truncated power series in the one-step delay, and the
//!    operational matrices of the literature; [`fft`], [`linalg`] and [`simd`] support them;
//! 3. [`equation`]: terms, orders, order laws, sensor filters; solvability of coupled equations;
//! 4. [`regressors`]: a record and an equation become regressors I^{α−ν} s;
//! 5. [`estimation`]: coefficients at fixed orders by least squares, multi-innovation least squares and instrumental
//!    variables; orders and coefficients together by joint output error; [`friction`]: dry friction in one pulse;
//!    [`expression`], [`nonlinear`]: simulation and output error with friction and non-linear terms;
//! 6. [`recording`]: measured runs with gaps, nonuniform times, delays, saturations, dead zones and sensor filters,
//!    sampled on any grid of block pulses;
//! 7. [`order_search`]: orders by exhaustive search over an order grid;
//! 8. [`simulate`], [`state_space`], [`output_samples`], [`signal::metrics`]: simulation by pulse means, by exact state
//!    space, and at sample times in the limit of zero step; output and equation error, figures of merit;
//!    [`signal::statistics`]: residual analysis.
//!
//! ```
//! use ftlm::prelude::*;
//!
//! # fn main() -> Result<()> {
//! # let (step, mut y) = (0.05, vec![0.0]);
//! # let u: Vec<f64> = (0..200).map(|k| if k % 40 < 20 { 1.0 } else { -1.0 }).collect();
//! # let fall = f64::exp(-2.0 * step);
//! # u.iter().for_each(|u| y.push(fall * y[y.len() - 1] + 1.5 * (1.0 - fall) * u));
//! # y.pop();
//! // Samples y and u of D y = −2 y + 3 u, fitted by D^alpha y = a y + b u.
//! let y = Channel::new("y", y, Role::Output);
//! let u = Channel::new("u", u, Role::Input(Intersample::Hold));
//! let run = Recording::from_channels(step, vec![y, u])?;
//! let equation = ParametricEquation::new(0, Order::free("alpha"))
//!     .with_term("a", Order::number(0.0), 0)
//!     .with_term("b", Order::number(0.0), 1);
//! let found = fit_equations(vec![run], vec![equation])?;
//! assert!((found.values["alpha"] - 1.0).abs() < 1e-2 && (found.values["a"] + 2.0).abs() < 1e-2);
//! # Ok(())
//! # }
//! ```
//!
//! A [`recording::Recording`] contains samples, and a [`regressors::Record`] contains
//! [`signal::block_pulse::PulseMeans`]. Estimates from samples in place of pulse means would be biased.
//!
//! # Features
//!
//! No feature is enabled by default. `rig`: [`rig`], the simulated arm and the safety guard of the rigs. `oracles`:
//! slow reference computations for tests. `python`: the Python bindings, which enable `rig` and `oracles`.
//!
//! Numerical code does not access files, clocks (except the timer of the virtual rig) or Python.
#![forbid(unsafe_op_in_unsafe_fn)]
#![cfg_attr(not(feature = "python"), forbid(unsafe_code))]
#![cfg_attr(docsrs, feature(doc_cfg))]

pub mod error;
pub mod parallel;

pub mod fft;
pub mod linalg;
pub mod simd;

pub mod signal;

pub mod fractional;
pub mod series;

pub mod equation;
pub mod expression;
pub mod regressors;
mod series_system;
pub mod simulate;
pub mod state_space;

pub mod estimation;
pub mod friction;
pub mod nonlinear;
pub mod order_search;
pub mod output_samples;
pub mod recording;

#[cfg(feature = "rig")]
pub mod rig;

/// Types and functions for a fit of measured signals.
pub mod prelude {
    pub use crate::error::{Error, Result};
    pub use crate::estimation::joint_fit::structure::{Order, ParametricEquation};
    pub use crate::estimation::joint_fit::{fit_equations, EquationFit};
    pub use crate::recording::{Channel, Recording, Role};
    pub use crate::signal::block_pulse::{Intersample, PulseMeans};
}

#[cfg(feature = "python")]
mod python;
