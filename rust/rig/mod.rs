//! What stands on either side of a command: the guard of both rigs, and the simulated arm, stepped and paced.

pub mod arm_model;
pub mod safety_guard;
pub mod virtual_arm;
