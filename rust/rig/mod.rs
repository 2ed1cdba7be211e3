//! Rig: safety guard of real and virtual rigs, and the simulated two-link arm with real-time pacing.

pub mod arm_model;
pub mod safety_guard;
pub mod virtual_arm;
