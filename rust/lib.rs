//! Fractional-order models of flexible machines from measured data.
//!
//! The modules in the order in which a measurement passes them:
//!
//! 1. [`means`]: point samples become means over block pulses;
//! 2. [`fractional`], [`series`], [`haar`], [`operational`]: fractional integrals as truncated power series in the
//!    one-step delay, and the operational matrices of the literature beside them ([`fft`] and [`dense`] serve them);
//! 3. [`equation`]: terms, orders, order laws, sensor filters;
//! 4. [`regressors`]: a record and an equation become regressors I^{α−ν} s;
//! 5. [`estimate`]: coefficients at given orders, by least squares and multi-innovation least squares ([`small`]);
//! 6. [`search`]: the orders themselves, exhaustively over a lattice;
//! 7. [`simulate`], [`metrics`]: free runs, the two errors, and what they amount to.
//!
//! Runs come from a file or from a rig: [`virtual_arm`] is the arm itself, with its past in bounded [`memory`];
//! [`guard`] stands between commands and motors.
//!
//! The mathematics knows no file, no clock (but for the pace of the virtual rig) and no Python; bindings live behind the feature `python`.
#![forbid(unsafe_op_in_unsafe_fn)]
#![cfg_attr(not(feature = "python"), forbid(unsafe_code))]

pub mod error;
pub mod means;

pub mod fractional;
pub mod haar;
pub mod operational;
pub mod series;

pub mod dense;
pub mod fft;
pub mod lanes;

pub mod equation;
pub mod regressors;

pub mod estimate;
pub mod small;

pub mod search;

pub mod metrics;
pub mod simulate;

pub mod guard;
pub mod memory;
pub mod virtual_arm;

#[cfg(feature = "python")]
mod python;
