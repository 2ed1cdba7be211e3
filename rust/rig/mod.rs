//! Rig: safety guard of real and virtual rigs, and the simulated two-link arm with real-time deadlines.

pub mod arm_model;
pub mod safety_guard;
pub mod virtual_arm;
