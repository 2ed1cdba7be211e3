//! Virtual arm: sensors, converters, real-time deadlines and fault injection of the simulated arm.

use std::time::{Duration, Instant};

use super::arm_model::Arm;
use crate::error::{check_finite, check_step, Error, Result};

/// Sensors, converters and amplifiers of the arm. Pairs are joint 1 and joint 2.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensors {
    /// Deflection per volt of the strain gauge \[rad/V\]. The gauge voltage falls with the deflection.
    pub strain_scale: [f64; 2],
    /// Voltage of the strain gauges without deflection \[V\].
    pub strain_bias: [f64; 2],
    /// Standard deviation of the noise on strain gauges 1, 2 and current sensors 1, 2 \[V\].
    pub noise: [f64; 4],
    /// Voltage of the current sensors at zero current \[V\].
    pub sense_bias: [f64; 2],
    /// Current per volt of the current sensor \[A/V\]. The sensor voltage falls with the current.
    pub sense_scale: f64,
    /// Current per volt of the command \[A/V\]. A positive voltage gives a negative current.
    pub command_scale: f64,
    /// Hub angle per encoder count \[rad\].
    pub encoder_scale: [f64; 2],
    /// Half of the voltage range of the converters, which is symmetric about 0 \[V\].
    pub range: f64,
    /// Resolution of the converters in bits. 0 disables quantization.
    pub bits: u32,
    /// Maximum current that each amplifier supplies \[A\].
    pub current_limit: [f64; 2],
    /// Disturbance that is added to each motor current while its amplifier is enabled \[A\].
    pub offset: [f64; 2],
    /// Magnitude of the hub angle above which a limit switch opens \[rad\].
    pub travel: [f64; 2],
}

/// Fault that is injected from a given sample on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Injection {
    /// Encoder that stops counting.
    DeadEncoder {
        /// Index of the joint, from 0.
        joint: usize,
        /// Index of the first sample with the fault.
        from: u64,
    },
    /// Strain gauge whose amplifier is saturated, so that its voltage stays at the limit of the converter.
    SaturatedGauge {
        /// Index of the joint, from 0.
        joint: usize,
        /// Index of the first sample with the fault.
        from: u64,
    },
    /// Limit switch that opens.
    LimitSwitch {
        /// Index of the digital line, from 0.
        line: usize,
        /// Index of the first sample with the fault.
        from: u64,
    },
    /// Deflection increased by a constant angle.
    Deflection {
        /// Index of the joint, from 0.
        joint: usize,
        /// Index of the first sample with the fault.
        from: u64,
        /// Angle that is added to the deflection \[rad\].
        angle: f64,
    },
    /// Delay of the control loop at one sample.
    Late {
        /// Index of the sample.
        at: u64,
        /// Delay \[s\].
        seconds: f64,
    },
    /// Board that delivers no samples.
    LostSamples {
        /// Index of the first sample with the fault.
        from: u64,
    },
}

/// Simultaneous reading of all channels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Reading {
    /// Voltages of strain gauges 1, 2 and of current sensors 1, 2 \[V\].
    pub analog: [f64; 4],
    /// Counts of encoders 1 and 2.
    pub counts: [i32; 2],
    /// State of each limit switch: 0 if tripped, otherwise 1.
    pub switches: [i8; 4],
}

/// Virtual arm: arm model with sensors, converters and injected faults.
#[derive(Debug, Clone)]
pub struct Plant {
    /// Arm model.
    pub arm: Arm,
    sensors: Sensors,
    current: [f64; 2],
    frozen_counts: [Option<i32>; 2],
    injections: Vec<Injection>,
    sample: u64,
}

impl Plant {
    /// Virtual arm at rest with zero current.
    ///
    /// # Errors
    /// The errors of [`Sensors::check`], for a value of the sensors out of range.
    pub fn new(arm: Arm, sensors: Sensors) -> Result<Self> {
        sensors.check()?;
        Ok(Self { arm, sensors, current: [0.0; 2], frozen_counts: [None; 2], injections: Vec::new(), sample: 0 })
    }

    /// Add a fault injection.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for the index of a joint or a line that does not exist. [`Error::NotFinite`] for an angle
    /// or a delay that is not finite.
    pub fn inject(&mut self, injection: Injection) -> Result<()> {
        let check_index = |name: &str, index: usize, count: usize| {
            if index < count {
                return Ok(());
            }
            #[allow(clippy::cast_precision_loss)]
            Err(out_of_range(name, index as f64, &format!("[0, {count})")))
        };
        match injection {
            Injection::DeadEncoder { joint, .. } | Injection::SaturatedGauge { joint, .. } => {
                check_index("joint", joint, 2)?
            }
            Injection::LimitSwitch { line, .. } => check_index("line", line, 4)?,
            Injection::Deflection { joint, angle, .. } => {
                check_index("joint", joint, 2)?;
                check_finite("injected deflection", &[angle])?;
            }
            Injection::Late { seconds, .. } => check_finite("injected delay", &[seconds])?,
            Injection::LostSamples { .. } => {}
        }
        self.injections.push(injection);
        Ok(())
    }

    /// Index of the sample that the next [`Self::read`] returns.
    #[must_use]
    pub fn sample(&self) -> u64 {
        self.sample
    }

    /// Read all channels at the current sample. `noise` holds standard normal values for strain gauges 1, 2 and current
    /// sensors 1, 2.
    pub fn read(&mut self, noise: [f64; 4]) -> Reading {
        let s = &self.sensors;
        let angles = self.arm.angles();
        let mut deflections = [angles[1], angles[3]];
        let mut analog = [0.0; 4];
        let mut switches = [1_i8; 4];
        let mut is_saturated = [false; 2];
        for injection in &self.injections {
            match *injection {
                Injection::SaturatedGauge { joint, from } => is_saturated[joint] |= self.sample >= from,
                Injection::LimitSwitch { line, from } if self.sample >= from => switches[line] = 0,
                Injection::Deflection { joint, from, angle } if self.sample >= from => deflections[joint] += angle,
                _ => {}
            }
        }
        for j in 0..2 {
            let strain = s.strain_bias[j] - deflections[j] / s.strain_scale[j] + s.noise[j] * noise[j];
            analog[j] = s.convert(if is_saturated[j] { s.range } else { strain });
            let sense = s.sense_bias[j] - self.current[j] / s.sense_scale + s.noise[2 + j] * noise[2 + j];
            analog[2 + j] = s.convert(sense);
            for (line, excess) in [(2 * j, -angles[2 * j]), (2 * j + 1, angles[2 * j])] {
                if excess > s.travel[j] {
                    switches[line] = 0;
                }
            }
        }
        // The arm rests in the middle of an encoder count, so that quantization has no bias.
        #[allow(clippy::cast_possible_truncation)]
        let mut counts: [i32; 2] = std::array::from_fn(|j| (angles[2 * j] / s.encoder_scale[j] + 0.5).floor() as i32);
        for injection in &self.injections {
            if let Injection::DeadEncoder { joint, from } = *injection
                && self.sample >= from
            {
                counts[joint] = *self.frozen_counts[joint].get_or_insert(counts[joint]);
            }
        }
        Reading { analog, counts, switches }
    }

    /// True if the board delivers samples.
    #[must_use]
    pub fn is_sampling(&self) -> bool {
        !self.injections.iter().any(|i| matches!(i, Injection::LostSamples { from } if self.sample >= *from))
    }

    /// Delay that is injected into the control loop at the current sample \[s\].
    #[must_use]
    pub fn delay(&self) -> f64 {
        let injected_delay = |i: &Injection| match *i {
            Injection::Late { at, seconds } if at == self.sample => seconds,
            _ => 0.0,
        };
        self.injections.iter().map(injected_delay).sum()
    }

    /// Advance by one sample with these voltages at the amplifiers \[V\]. Disabled amplifiers supply no current.
    pub fn advance(&mut self, volts: [f64; 2], enabled: bool) {
        let s = &self.sensors;
        for ((current, volts), limit) in self.current.iter_mut().zip(volts).zip(s.current_limit) {
            let current_command = -s.convert(volts) * s.command_scale;
            *current = if enabled { current_command.clamp(-limit, limit) } else { 0.0 };
        }
        let offset = if enabled { s.offset } else { [0.0; 2] };
        self.arm.advance(std::array::from_fn(|j| self.current[j] + offset[j]));
        self.sample += 1;
    }
}

/// Return the error for a parameter of the virtual arm that is out of range.
fn out_of_range(name: &str, value: f64, range: &str) -> Error {
    Error::OutOfRange {
        name: name.into(),
        value,
        range: range.into(),
        remedy: "correct the parameters of the virtual arm".into(),
    }
}

/// Maximum resolution of the converters in bits. With more bits, the quantization step would be below the rounding
/// error of a voltage.
const MAX_BITS: u32 = 52;

impl Sensors {
    /// Return an error for invalid parameters.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a scale, limit or range that is not positive, for negative noise, or for more than 52
    /// bits. [`Error::NotFinite`] for an offset that is not finite.
    pub fn check(&self) -> Result<()> {
        let pairs = [
            ("strain_scale", self.strain_scale),
            ("encoder_scale", self.encoder_scale),
            ("current_limit", self.current_limit),
            ("travel", self.travel),
        ];
        let single = [("sense_scale", self.sense_scale), ("command_scale", self.command_scale), ("range", self.range)];
        for (name, value) in pairs.iter().flat_map(|(name, v)| v.map(|v| (*name, v))).chain(single) {
            if !(value > 0.0 && value.is_finite()) {
                return Err(out_of_range(name, value, "(0, ∞)"));
            }
        }
        if let Some(&noise) = self.noise.iter().find(|v| !(**v >= 0.0 && v.is_finite())) {
            return Err(out_of_range("noise", noise, "[0, ∞) V"));
        }
        check_finite("strain_bias", &self.strain_bias)?;
        check_finite("sense_bias", &self.sense_bias)?;
        check_finite("current offset", &self.offset)?;
        if self.bits > MAX_BITS {
            return Err(out_of_range("bits", f64::from(self.bits), &format!("[0, {MAX_BITS}]")));
        }
        Ok(())
    }

    /// Clip a voltage to the converter range and quantize it. NaN and infinity become 0 V. Without quantization (0
    /// bits), a finite voltage is not clipped.
    fn convert(&self, volts: f64) -> f64 {
        if !volts.is_finite() {
            return 0.0;
        }
        if self.bits == 0 {
            return volts;
        }
        let codes = libm::ldexp(1.0, i32::try_from(self.bits).unwrap_or(16));
        let step = 2.0 * self.range / codes;
        (volts / step).round().clamp(-codes / 2.0, codes / 2.0 - 1.0) * step
    }
}

/// Timer for the real-time deadlines of a control loop.
#[derive(Debug)]
pub struct Pace {
    start: Instant,
    step: f64,
    samples: u64,
}

/// Duration of busy waiting before a deadline. A sleep may end late by some tens of microseconds.
const SPIN_WAIT: Duration = Duration::from_micros(120);

/// Maximum sampling interval in real time \[s\]: one day, so that times do not overflow.
const MAX_REAL_TIME_STEP_S: f64 = 86_400.0;

impl Pace {
    /// Timer that starts now, with a deadline every `step` \[s\]. The first deadline is the start.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a step that is not positive or longer than a day.
    pub fn new(step: f64) -> Result<Self> {
        check_step(step)?;
        if step > MAX_REAL_TIME_STEP_S {
            return Err(out_of_range("step", step, "(0, 86400] s"));
        }
        Ok(Self { start: Instant::now(), step, samples: 0 })
    }

    /// Wait for the next deadline. Return the time by which it was missed \[s\].
    pub fn wait(&mut self) -> f64 {
        #[allow(clippy::cast_precision_loss)]
        let deadline = Duration::try_from_secs_f64(self.step * self.samples as f64)
            .ok()
            .and_then(|elapsed| self.start.checked_add(elapsed))
            .unwrap_or(self.start);
        self.samples += 1;
        loop {
            let now = Instant::now();
            match deadline.checked_duration_since(now) {
                None => return now.duration_since(deadline).as_secs_f64(),
                Some(remaining) if remaining > SPIN_WAIT => std::thread::sleep(remaining - SPIN_WAIT),
                Some(_) => std::hint::spin_loop(),
            }
        }
    }
}
