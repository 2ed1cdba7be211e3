//! Signals: samples and block pulses, statistics, and metrics of errors.

pub mod block_pulse;
pub mod colour;
pub mod metrics;
pub mod readings;
pub mod statistics;
