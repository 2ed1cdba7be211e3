//! Signals: samples and block pulses, statistics, and metrics of errors.

pub mod block_pulse;
pub mod metrics;
pub mod nonuniform;
pub mod statistics;
