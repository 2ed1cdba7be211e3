//! The virtual arm and the guard of both rigs.

use numpy::{PyArray1, PyArray2, PyReadonlyArray1, PyReadonlyArray2, PyUntypedArrayMethods};
use pyo3::prelude::*;

use super::arrays::{stacked, vector};
use crate::error::{check_length, Error};
use crate::memory::{decay, Rates};
use crate::rig::arm::{Arm, Parameters, Stage};
use crate::rig::guard::{self, Fault};
use crate::rig::virtual_arm::{Injection, Pace, Plant, Reading, Sensors};

/// Columns of a row: written currents, four angles, two measured currents, delay.
const COLUMNS: usize = 9;

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

impl From<GuardSettings> for guard::Settings {
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

/// Limits, conversions and latched faults of one run; see the module `guard` of the core.
#[pyclass(module = "ftlm._core")]
pub struct Guard {
    inner: guard::Guard,
}

#[pymethods]
impl Guard {
    #[new]
    fn new(settings: GuardSettings) -> PyResult<Self> {
        Ok(Self { inner: guard::Guard::new(settings.into())? })
    }

    fn rest(&mut self, analog: [f64; 4], counts: [i32; 2], switches: [i8; 4]) {
        self.inner.rest(&Reading { analog, counts, switches });
    }

    fn read(&mut self, analog: [f64; 4], counts: [i32; 2], switches: [i8; 4], late: f64) -> [f64; 6] {
        self.inner.read(&Reading { analog, counts, switches }, late)
    }

    fn command(&mut self, current: [f64; 2]) -> [f64; 2] {
        self.inner.command(current)
    }

    fn fail(&mut self, why: String) {
        self.inner.fail(Fault::Rig(why));
    }

    #[getter]
    fn fault(&self) -> Option<String> {
        self.inner.fault().map(ToString::to_string)
    }

    #[getter]
    fn written(&self) -> [f64; 2] {
        self.inner.written()
    }

    #[getter]
    fn bias(&self) -> [f64; 2] {
        self.inner.bias()
    }

    #[getter]
    fn missed(&self) -> u64 {
        self.inner.missed()
    }
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct StageArg {
    hub_orders: [f64; 3],
    hub: [f64; 4],
    deflection_orders: [f64; 3],
    deflection: [f64; 4],
    coulomb: f64,
}

#[derive(FromPyObject)]
#[pyo3(from_item_all)]
struct ArmArg {
    stages: [StageArg; 2],
    coupling: f64,
    inertia_ratio: f64,
}

impl From<ArmArg> for Parameters {
    fn from(a: ArmArg) -> Self {
        let stages = a.stages.map(|s| Stage {
            hub_orders: s.hub_orders,
            hub: s.hub,
            deflection_orders: s.deflection_orders,
            deflection: s.deflection,
            coulomb: s.coulomb,
        });
        Self { stages, coupling: a.coupling, inertia_ratio: a.inertia_ratio }
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
            travel: s.travel,
        }
    }
}

/// The physical arm behind its converters, stepped and paced; see the module `virtual_arm` of the core.
#[pyclass(module = "ftlm._core")]
pub struct VirtualArm {
    plant: Plant,
    step: f64,
    pace: Option<Pace>,
    rows: Vec<[f64; COLUMNS]>,
}

#[pymethods]
impl VirtualArm {
    #[new]
    fn new(arm: ArmArg, sensors: SensorsArg, step: f64, longest_substep: f64, horizon: f64) -> PyResult<Self> {
        let arm = Arm::new(&arm.into(), step, longest_substep, horizon)?;
        Ok(Self { plant: Plant::new(arm, sensors.into()), step, pace: None, rows: Vec::new() })
    }

    /// Counts deadlines from now on, or steps as fast as possible.
    fn start(&mut self, paced: bool) {
        self.pace = paced.then(|| Pace::new(self.step));
    }

    fn read(&mut self, noise: [f64; 4]) -> ([f64; 4], [i32; 2], [i8; 4]) {
        let reading = self.plant.read(noise);
        (reading.analog, reading.counts, reading.switches)
    }

    fn advance(&mut self, volts: [f64; 2], enabled: bool) {
        self.plant.advance(volts, enabled);
    }

    fn inject(&mut self, what: &str, channel: usize, sample: u64, value: f64) -> PyResult<()> {
        let stage = channel.min(1);
        let injection = match what {
            "dead encoder" => Injection::DeadEncoder { stage, from: sample },
            "saturated gauge" => Injection::SaturatedGauge { stage, from: sample },
            "limit switch" => Injection::LimitSwitch { line: channel.min(3), from: sample },
            "deflection" => Injection::Deflection { stage, from: sample, angle: value },
            "late" => Injection::Late { at: sample, seconds: value },
            "lost samples" => Injection::LostSamples { from: sample },
            _ => {
                let what = format!("{what:?} cannot be injected");
                return Err(Error::Structure { what, remedy: "see ftlm.rig.INJECTIONS".into() }.into());
            }
        };
        self.plant.inject(injection);
        Ok(())
    }

    /// Samples at rest: readings go to the guard, 0 V to the output.
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
            self.wait(py);
            let reading = self.plant.read(std::array::from_fn(|i| noise[i]));
            guard.inner.rest(&reading);
            self.write(output, [0.0; 2])?;
            if guard.inner.fault().is_some() {
                break;
            }
        }
        Ok(())
    }

    /// Samples under commands, until they end or a fault latches; what was read waits in `take`.
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
            let late = self.wait(py) + self.plant.delay();
            if !self.plant.sampling() {
                guard.inner.fail(Fault::Rig("the board handed over no sample: samples were lost".into()));
                self.write(output, [0.0; 2])?;
                break;
            }
            let reading = self.plant.read(std::array::from_fn(|i| noise[i]));
            let v = guard.inner.read(&reading, late);
            let volts = guard.inner.command([command[0], command[1]]);
            let [i1, i2] = guard.inner.written();
            self.rows.push([i1, i2, v[0], v[1], v[2], v[3], v[4], v[5], late]);
            self.write(output, volts)?;
            if guard.inner.fault().is_some() {
                break;
            }
        }
        Ok(())
    }

    /// Rows since the last call, shape (n, 9).
    fn take<'py>(&mut self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rows: Vec<Vec<f64>> = std::mem::take(&mut self.rows).iter().map(|r| r.to_vec()).collect();
        if rows.is_empty() {
            return Ok(PyArray2::zeros(py, [0, COLUMNS], false));
        }
        stacked(py, &rows)
    }

    #[getter]
    fn sample(&self) -> u64 {
        self.plant.sample()
    }

    #[getter]
    fn angles(&self) -> [f64; 4] {
        self.plant.arm.angles()
    }

    #[getter]
    fn memory(&self) -> usize {
        self.plant.arm.memory()
    }
}

impl VirtualArm {
    fn wait(&mut self, py: Python<'_>) -> f64 {
        match &mut self.pace {
            Some(pace) => py.detach(|| pace.wait()),
            None => 0.0,
        }
    }

    /// Hands volts to the output stage and steps the arm under what the stage lets through.
    fn write(&mut self, output: &Bound<'_, PyAny>, volts: [f64; 2]) -> PyResult<()> {
        let (through, enabled): ([f64; 2], bool) = output.call1((volts[0], volts[1]))?.extract()?;
        self.plant.advance(through, enabled);
        Ok(())
    }
}

/// I^q of a signal that is linear between its samples, online through the sum of exponentials: what the arm computes.
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
    if !(order > 0.0 && order <= 1.0) {
        let (range, remedy) = ("(0, 1]".into(), "integrate whole orders apart".into());
        return Err(Error::OutOfRange { name: "order".into(), value: order, range, remedy }.into());
    }
    #[allow(clippy::cast_precision_loss)]
    let rates = Rates::new(step, step * (x.len() + 1) as f64, tolerance)?;
    let weights = rates.weights(order);
    let scale = libm::pow(step, order) / libm::tgamma(order + 2.0);
    let decays: Vec<_> = rates.rates().iter().map(|s| decay(s * step)).collect();
    let mut past = vec![0.0; weights.len()];
    let mut out = vec![0.0; x.len()];
    for n in 1..x.len() {
        let mut value = scale * (x[n] + order * x[n - 1]);
        for ((z, w), (keep, first, last)) in past.iter_mut().zip(&weights).zip(&decays) {
            value += w * keep * *z;
            *z = *z * keep + step * (first * x[n - 1] + last * x[n]);
        }
        out[n] = value;
    }
    Ok((PyArray1::from_vec(py, out), past.len()))
}
