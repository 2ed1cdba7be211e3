//! Fractional-order models of flexible machines from measured data.
//!
//! The modules in the order in which a measurement passes them:
//!
//! 1. [`means`]: point samples become means over block pulses; [`readings`]: and means samples at times of their own;
//! 2. [`kernels`], [`excess`], [`fractional`], [`series`], [`haar`], [`operational`]: fractional integrals as truncated power series
//!    in the one-step delay, and the operational matrices of the literature beside them ([`fft`] and [`dense`] serve
//!    them);
//! 3. [`equation`], [`regularity`]: terms, orders, order laws, sensor filters; whether equations tell their outputs
//!    apart;
//! 4. [`regressors`]: a record and an equation become regressors I^{α−ν} s;
//! 5. [`estimate`]: coefficients at given orders by least squares, multi-innovation least squares and instrumental
//!    variables; orders and coefficients together by joint output error ([`small`] and [`memory`] serve them);
//!    [`friction`]: free runs of a body that may stick, and their output error;
//! 6. [`search`]: the orders themselves, exhaustively over a lattice;
//! 7. [`simulate`], [`metrics`]: free runs, the two errors, and what they amount to; [`statistics`], [`colour`]: what the
//!    residuals say.
//!
//! ```
//! use ftlm::equation::{Equation, Initial, Structure, Term};
//! use ftlm::estimate::least_squares;
//! use ftlm::regressors::Record;
//! use ftlm::simulate;
//!
//! # fn main() -> ftlm::error::Result<()> {
//! // D^1.5 y = −4 D^0.5 y + 2 u, driven by a square wave.
//! let terms = vec![Term { signal: 0, order: 0.5 }, Term { signal: 1, order: 0.0 }];
//! let plant = Equation::new(Structure { output: 0, order: 1.5, terms }, vec![-4.0, 2.0])?;
//! let input: Vec<f64> = (0..400).map(|k| if k % 100 < 50 { 1.0 } else { -1.0 }).collect();
//! let driven = Record::new(0.01, vec![vec![0.0; 400], input.clone()], None)?;
//! let output = simulate::respond(std::slice::from_ref(&plant), &driven, &[])?.remove(0);
//!
//! let run = Record::new(0.01, vec![output, input], None)?;
//! let found = least_squares::fit(&[run], &plant.structure, &[None, None], &Initial::Rest)?;
//! assert!((found.coefficients[0] + 4.0).abs() < 1e-9);
//! # Ok(())
//! # }
//! ```
//!
//! # Features
//!
//! None is on by default. `rig`: [`rig`], the simulated arm and the guard between commands and motors. `oracles`: the slow
//! computations by definition that tests compare the fast ones with. `python`: the bindings, with both of these.
//!
//! The mathematics knows no file, no clock (but for the pace of the virtual rig) and no Python.
#![forbid(unsafe_op_in_unsafe_fn)]
#![cfg_attr(not(feature = "python"), forbid(unsafe_code))]
#![cfg_attr(docsrs, feature(doc_cfg))]

pub mod error;
pub mod means;
pub mod readings;
pub mod stop;

pub mod excess;
pub mod fractional;
pub mod haar;
pub mod kernels;
pub mod operational;
pub mod series;

mod abreast;
pub mod dense;
pub mod fft;
pub mod lanes;
mod orthogonal;
mod powers;
mod shared;

mod driven;
pub mod equation;
mod impulses;
pub mod regressors;
pub mod regularity;

pub mod estimate;
pub mod friction;
pub mod memory;
pub mod small;

pub mod search;

pub mod colour;
pub mod metrics;
pub mod simulate;
pub mod statistics;

#[cfg(feature = "rig")]
pub mod rig;

#[cfg(feature = "python")]
mod python;
