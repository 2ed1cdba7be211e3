//! Python bindings. Only these modules use the crates `pyo3` and `numpy`.
//!
//! The bindings check arrays, and release the Python interpreter lock during every computation that takes longer than
//! microseconds.

mod convert;
mod errors;
mod estimation;
mod friction;
mod joint_fit;
mod kernels;
mod operators;
mod optimization;
mod order_search;
mod recording;
mod simulation;
mod virtual_arm;

use pyo3::prelude::*;

/// The compiled core of ftlm.
#[pymodule]
mod _core {
    use super::*;

    #[pymodule_export]
    use crate::python::operators::{
        block_pulse_matrix, delay_samples, filter_series, fractional_derivative, fractional_integral, haar_inverse,
        haar_matrix, haar_transform, operational_matrix, point_samples, series_divide, series_multiply,
    };

    #[pymodule_export]
    use crate::python::operators::{singular_values, triangular_factor};

    #[pymodule_export]
    use crate::python::kernels::{
        block_pulse_kernels, multi_innovation_rows, pulse_mean_rows, toeplitz_apply, toeplitz_solve,
    };

    #[pymodule_export]
    use crate::python::estimation::{
        has_unstable_pole, instrumental_variables, least_squares, multi_innovation, projected_errors, Streaming,
    };

    #[pymodule_export]
    use crate::python::friction::friction_respond;

    #[pymodule_export]
    use crate::python::joint_fit::{
        arx_model, autocovariances, chi_squared, cost_surface, covariance_of, fit_covariance, is_white, joint_fit,
        joint_multistart, long_run_covariance, portmanteau, prediction_ratio, profile_intervals, variance_inflation,
        whitening_filter, JointMultistart, JointProblem,
    };

    #[pymodule_export]
    use crate::python::optimization::minimize;

    #[pymodule_export]
    use crate::python::recording::{nonuniform_means, Experiment, Recording};

    #[pymodule_export]
    use crate::python::simulation::{
        correlation, equation_error, explicit_euler, interpolate_samples, kink_correction, metrics, nyquist_margin,
        respond, respond_with_initial, richardson_limit, trace_errors, OutputSimulation,
    };

    #[pymodule_export]
    use crate::python::order_search::{
        certify, force_portable, order_grid_size, panic_on_purpose, search, search_join, search_plan, search_stage,
        OrderSearch, Points, StageSearch,
    };

    #[pymodule_export]
    use crate::python::order_search::watch::Stop;

    #[pymodule_export]
    use crate::python::virtual_arm::{fractional_memory, Guard, VirtualArm};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        // NumPy imports its C API and its borrow checker on first use. A Ctrl-C at that moment would cause a panic.
        module.py().import("numpy")?;
        crate::python::errors::run_attached(|| {
            drop(numpy::PyArrayMethods::readonly(&numpy::PyArray1::<f64>::zeros(module.py(), 0, false)));
            Ok(())
        })?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("SIMD", simd())
    }

    /// Name of the widest vector instruction set of this processor.
    fn simd() -> &'static str {
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                return "avx512f";
            }
            if std::arch::is_x86_feature_detected!("avx2") {
                return "avx2";
            }
            "sse2"
        }
        #[cfg(not(target_arch = "x86_64"))]
        "portable"
    }
}
