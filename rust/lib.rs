//! Fractional-order models of flexible machines from measured data.
//!
//! Modules in the order of data flow:
//!
//! 1. [`signal`]: point samples become means over block pulses, and pulse means become nonuniform samples;
//! 2. [`fractional`], [`series`]: fractional integrals as truncated power series in the one-step delay, and the
//!    operational matrices of the literature; [`fft`], [`linalg`] and [`simd`] serve them;
//! 3. [`equation`]: terms, orders, order laws, sensor filters; solvability of coupled equations;
//! 4. [`regressors`]: a record and an equation become regressors I^{α−ν} s;
//! 5. [`estimation`]: coefficients at fixed orders by least squares, multi-innovation least squares and instrumental
//!    variables; orders and coefficients together by joint output error; [`friction`]: simulation and output error
//!    with dry friction;
//! 6. [`recording`]: measured runs with gaps, nonuniform times, delays, limits and sensor filters, sampled on any grid;
//! 7. [`order_search`]: orders by exhaustive search over an order grid;
//! 8. [`simulate`], [`state_space`], [`output_samples`], [`signal::metrics`]: simulation by pulse means, exactly, and at
//!    sample times in the limit for zero step; output and equation error, figures of merit;
//!    [`signal::statistics`]: residual analysis.
//!
//! ```
//! use ftlm::equation::{Equation, Initial, Structure, Term};
//! use ftlm::estimation::least_squares;
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
//! None is on by default. `rig`: [`rig`], the simulated arm and the safety guard of the rigs. `oracles`: slow
//! computations by definition, against which tests compare the fast ones. `python`: the Python bindings, with both of
//! these.
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
pub mod regressors;
mod series_system;
pub mod simulate;
pub mod state_space;

pub mod estimation;
pub mod friction;
pub mod order_search;
pub mod output_samples;
pub mod recording;

#[cfg(feature = "rig")]
pub mod rig;

#[cfg(feature = "python")]
mod python;
