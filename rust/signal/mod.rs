//! Signals: samples and block pulses, statistics, and error metrics.

pub mod block_pulse;
pub mod metrics;
pub mod nonuniform;
pub mod statistics;
