//! What stands on either side of a command: the guard of both rigs, and the simulated arm, stepped and paced.

pub mod arm;
pub mod guard;
pub mod virtual_arm;
