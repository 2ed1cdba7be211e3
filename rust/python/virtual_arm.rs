//! Bindings of the virtual arm and of the safety guard.

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::convert::{equations, stack_rows, vector, EquationArg, List};
use super::errors::{run_attached, run_detached};
use crate::error::{check_length, Error};
use crate::fractional::exponential_sum::integral_by_memory;
use crate::rig::arm_model::{Arm, Parameters, SIGNAL_COUNT};
use crate::rig::safety_guard::{self, Fault};
use crate::rig::virtual_arm::{Injection, Pace, Plant, Reading, Sensors};

/// Number of columns of a sample: two commanded currents, four angles, two measured currents, delay.
const SAMPLE_COLUMNS: usize = 9;

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct GuardSettings {
    step: f64,
    strain_scale: [f64; 2],
    sense_scale: f64,
    command_scale: f64,
    encoder_scale: [f64; 2],
    current_limit: [f64; 2],
    slew: [f64; 2],
    continuous: [f64; 2],
    thermal_time: f64,
    deflection_limit: [f64; 2],
    saturation: f64,
    moving_current: f64,
    standstill: f64,
    fastest: f64,
    late_limit: f64,
    missed_limit: u32,
    filter: Option<(f64, f64)>,
}

impl From<GuardSettings> for safety_guard::GuardSettings {
    fn from(s: GuardSettings) -> Self {
        Self {
            step: s.step,
            strain_scale: s.strain_scale,
            sense_scale: s.sense_scale,
            command_scale: s.command_scale,
            encoder_scale: s.encoder_scale,
            current_limit: s.current_limit,
            slew: s.slew,
            continuous: s.continuous,
            thermal_time: s.thermal_time,
            deflection_limit: s.deflection_limit,
            saturation: s.saturation,
            moving_current: s.moving_current,
            standstill: s.standstill,
            fastest: s.fastest,
            late_limit: s.late_limit,
            missed_limit: s.missed_limit,
            filter: s.filter,
        }
    }
}

/// Safety guard of one run; see module `rig::safety_guard` of the core.
#[pyclass(module = "ftlm._core")]
pub struct Guard {
    inner: safety_guard::Guard,
}

#[pymethods]
impl Guard {
    #[new]
    fn new(settings: GuardSettings) -> PyResult<Self> {
        run_attached(|| Ok(Self { inner: safety_guard::Guard::new(settings.into())? }))
    }

    fn rest(&mut self, analog: [f64; 4], counts: [i32; 2], switches: [i8; 4]) -> PyResult<()> {
        run_attached(|| {
            self.inner.rest(&Reading { analog, counts, switches });
            Ok(())
        })
    }

    fn read(&mut self, analog: [f64; 4], counts: [i32; 2], switches: [i8; 4], delay: f64) -> PyResult<[f64; 6]> {
        run_attached(|| Ok(self.inner.read(&Reading { analog, counts, switches }, delay)))
    }

    fn command(&mut self, current: [f64; 2]) -> PyResult<[f64; 2]> {
        run_attached(|| Ok(self.inner.command(current)))
    }

    fn fail(&mut self, reason: String) -> PyResult<()> {
        run_attached(|| {
            self.inner.fail(Fault::Rig(reason));
            Ok(())
        })
    }

    #[getter]
    fn fault(&self) -> PyResult<Option<String>> {
        run_attached(|| Ok(self.inner.fault().map(ToString::to_string)))
    }

    #[getter]
    fn last_currents(&self) -> PyResult<[f64; 2]> {
        run_attached(|| Ok(self.inner.last_currents()))
    }

    #[getter]
    fn bias(&self) -> PyResult<[f64; 2]> {
        run_attached(|| Ok(self.inner.bias()))
    }

    #[getter]
    fn missed_deadlines(&self) -> PyResult<u64> {
        run_attached(|| Ok(self.inner.missed_deadlines()))
    }
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct ArmArg {
    equations: List<EquationArg>,
    coulomb: [f64; 2],
}

impl ArmArg {
    fn parameters(self) -> PyResult<Parameters> {
        let inputs = [false, false, false, false, true, true];
        Ok(Parameters { equations: equations(self.equations, SIGNAL_COUNT, &inputs)?, coulomb: self.coulomb })
    }
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct SensorsArg {
    strain_scale: [f64; 2],
    strain_bias: [f64; 2],
    noise: [f64; 4],
    sense_bias: [f64; 2],
    sense_scale: f64,
    command_scale: f64,
    encoder_scale: [f64; 2],
    range: f64,
    bits: u32,
    current_limit: [f64; 2],
    offset: [f64; 2],
    travel: [f64; 2],
}

impl From<SensorsArg> for Sensors {
    fn from(s: SensorsArg) -> Self {
        Self {
            strain_scale: s.strain_scale,
            strain_bias: s.strain_bias,
            noise: s.noise,
            sense_bias: s.sense_bias,
            sense_scale: s.sense_scale,
            command_scale: s.command_scale,
            encoder_scale: s.encoder_scale,
            range: s.range,
            bits: s.bits,
            current_limit: s.current_limit,
            offset: s.offset,
            travel: s.travel,
        }
    }
}

/// Virtual arm with sensors and converters, see module `rig::virtual_arm` of the core.
#[pyclass(module = "ftlm._core")]
pub struct VirtualArm {
    plant: Plant,
    step: f64,
    pace: Option<Pace>,
    rows: Vec<[f64; SAMPLE_COLUMNS]>,
}

#[pymethods]
impl VirtualArm {
    #[new]
    fn new(
        py: Python<'_>,
        arm: ArmArg,
        sensors: SensorsArg,
        step: f64,
        longest_substep: f64,
        horizon: f64,
    ) -> PyResult<Self> {
        let (arm, sensors) = (arm.parameters()?, sensors.into());
        let plant = run_detached(py, || Plant::new(Arm::new(&arm, step, longest_substep, horizon)?, sensors))?;
        Ok(Self { plant, step, pace: None, rows: Vec::new() })
    }

    /// Start the arm. If `paced`, the arm has real-time deadlines from now on. Otherwise it runs as fast as possible.
    fn start(&mut self, paced: bool) -> PyResult<()> {
        run_attached(|| {
            self.pace = if paced { Some(Pace::new(self.step)?) } else { None };
            Ok(())
        })
    }

    fn read(&mut self, noise: [f64; 4]) -> PyResult<([f64; 4], [i32; 2], [i8; 4])> {
        let reading = run_attached(|| Ok(self.plant.read(noise)))?;
        Ok((reading.analog, reading.counts, reading.switches))
    }

    fn advance(&mut self, volts: [f64; 2], enabled: bool) -> PyResult<()> {
        run_attached(|| {
            self.plant.advance(volts, enabled);
            Ok(())
        })
    }

    fn inject(&mut self, fault: &str, channel: usize, sample: u64, value: f64) -> PyResult<()> {
        let joint = channel;
        let injection = match fault {
            "dead encoder" => Injection::DeadEncoder { joint, from: sample },
            "saturated gauge" => Injection::SaturatedGauge { joint, from: sample },
            "limit switch" => Injection::LimitSwitch { line: channel, from: sample },
            "deflection" => Injection::Deflection { joint, from: sample, angle: value },
            "late" => Injection::Late { at: sample, seconds: value },
            "lost samples" => Injection::LostSamples { from: sample },
            _ => {
                let what = format!("{fault:?} cannot be injected");
                return Err(Error::Structure { what, remedy: "see ftlm.rig.FAULT_INJECTIONS".into() }.into());
            }
        };
        run_attached(|| self.plant.inject(injection))
    }

    /// Simulate the arm with 0 V at both motors, one sample for each row of `noise` (N × 4, standard normal). The guard
    /// checks each reading. The simulation ends early if a fault is latched.
    ///
    /// `output` is called with the two voltages of each sample. It returns (voltages at the amplifiers, true if these
    /// are enabled).
    #[allow(clippy::needless_pass_by_value)]
    fn rest(
        &mut self,
        py: Python<'_>,
        guard: &mut Guard,
        noise: PyReadonlyArray2<'_, f64>,
        output: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        check_length("noise", 4, noise.shape()[1])?;
        for noise in noise.as_array().outer_iter() {
            self.wait(py)?;
            run_attached(|| {
                let reading = self.plant.read(std::array::from_fn(|i| noise[i]));
                guard.inner.rest(&reading);
                Ok(())
            })?;
            self.apply_voltages(output, [0.0; 2])?;
            if guard.inner.fault().is_some() {
                break;
            }
        }
        Ok(())
    }

    /// Simulate the arm with `commands` (N × 2, currents \[A\]) and `noise` (N × 4, standard normal), until the
    /// commands end or a fault is latched. `output` is the same function as in `rest`. `take` returns the samples.
    #[allow(clippy::needless_pass_by_value)]
    fn run(
        &mut self,
        py: Python<'_>,
        guard: &mut Guard,
        commands: PyReadonlyArray2<'_, f64>,
        noise: PyReadonlyArray2<'_, f64>,
        output: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        let (commands, noise) = (commands.as_array(), noise.as_array());
        check_length("commands", 2, commands.ncols())?;
        check_length("noise", 4, noise.ncols())?;
        check_length("noise", commands.nrows(), noise.nrows())?;
        for (command, noise) in commands.outer_iter().zip(noise.outer_iter()) {
            let delay = self.wait(py)? + self.plant.delay();
            if !self.plant.is_sampling() {
                guard.inner.fail(Fault::Rig("the board returned no sample: samples were lost".into()));
                self.apply_voltages(output, [0.0; 2])?;
                break;
            }
            let volts = run_attached(|| {
                let reading = self.plant.read(std::array::from_fn(|i| noise[i]));
                let v = guard.inner.read(&reading, delay);
                let volts = guard.inner.command([command[0], command[1]]);
                let [i1, i2] = guard.inner.last_currents();
                // A reading that is not finite latches a fault and is not stored.
                if v.iter().all(|x| x.is_finite()) {
                    self.rows.push([i1, i2, v[0], v[1], v[2], v[3], v[4], v[5], delay]);
                }
                Ok(volts)
            })?;
            self.apply_voltages(output, volts)?;
            if guard.inner.fault().is_some() {
                break;
            }
        }
        Ok(())
    }

    /// Return the samples since the last call, shape (n, 9): two commanded currents \[A\], four angles \[rad\], two
    /// measured currents \[A\], and the delay \[s\].
    fn take<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rows: Vec<Vec<f64>> =
            run_attached(|| Ok(std::mem::take(&mut self.rows).iter().map(|r| r.to_vec()).collect()))?;
        if rows.is_empty() {
            return Ok(PyArray2::zeros(py, [0, SAMPLE_COLUMNS], false));
        }
        stack_rows(py, &rows)
    }

    #[getter]
    fn sample(&self) -> PyResult<u64> {
        run_attached(|| Ok(self.plant.sample()))
    }

    #[getter]
    fn angles(&self) -> PyResult<[f64; 4]> {
        run_attached(|| Ok(self.plant.arm.angles()))
    }

    #[getter]
    fn memory(&self) -> PyResult<usize> {
        run_attached(|| Ok(self.plant.arm.memory()))
    }
}

impl VirtualArm {
    fn wait(&mut self, py: Python<'_>) -> PyResult<f64> {
        match &mut self.pace {
            Some(pace) => run_detached(py, || Ok(pace.wait())),
            None => Ok(0.0),
        }
    }

    /// Call `output` with two voltages, and advance the arm by one sample with the voltages that it returns.
    fn apply_voltages(&mut self, output: &Bound<'_, PyAny>, volts: [f64; 2]) -> PyResult<()> {
        let (amplifier_volts, enabled): ([f64; 2], bool) = output.call1((volts[0], volts[1]))?.extract()?;
        run_attached(|| {
            self.plant.advance(amplifier_volts, enabled);
            Ok(())
        })
    }
}

/// Return the fractional integral I^q of a signal that is linear between samples, and the number of history states. As
/// in the virtual arm, a sum of exponentials computes it online. q is `order`, and `tolerance` the relative accuracy of
/// the sum.
#[pyfunction]
#[allow(clippy::needless_pass_by_value)]
pub fn fractional_memory<'py>(
    py: Python<'py>,
    samples: PyReadonlyArray1<'py, f64>,
    order: f64,
    step: f64,
    tolerance: f64,
) -> PyResult<(Bound<'py, PyArray1<f64>>, usize)> {
    let x = vector("samples", &samples)?;
    let (integral, memory) = run_detached(py, || integral_by_memory(&x, order, step, tolerance))?;
    Ok((PyArray1::from_vec(py, integral), memory))
}
