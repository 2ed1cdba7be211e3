//! Safety guard of real and virtual rigs. It limits every motor command and latches faults.

use thiserror::Error;

use crate::error::{Error, Result};
use crate::rig::virtual_arm::Reading;

/// Limits and scales of the guard. Pairs are joint 1 and joint 2.
#[derive(Debug, Clone, PartialEq)]
pub struct GuardSettings {
    /// Sampling interval \[s\].
    pub step: f64,
    /// Deflection per volt of the strain gauge \[rad/V\]. The deflection is minus this scale times the voltage above
    /// the bias.
    pub strain_scale: [f64; 2],
    /// Current per volt of the current sensor \[A/V\]. The current is minus this scale times the voltage.
    pub sense_scale: f64,
    /// Current per volt of the command \[A/V\]. The voltage is minus the current divided by this scale.
    pub command_scale: f64,
    /// Joint angle per encoder count \[rad\].
    pub encoder_scale: [f64; 2],
    /// Maximum permitted command \[A\].
    pub current_limit: [f64; 2],
    /// Maximum permitted rate of change of a command \[A/s\].
    pub slew: [f64; 2],
    /// Maximum permitted continuous current of a motor \[A\]. The mean of the squared current over `thermal_time` stays
    /// below the square of this value.
    pub continuous: [f64; 2],
    /// Averaging time of the squared current \[s\].
    pub thermal_time: f64,
    /// Maximum permitted deflection \[rad\].
    pub deflection_limit: [f64; 2],
    /// Minimum magnitude of the voltage at which a strain gauge counts as saturated \[V\].
    pub saturation: f64,
    /// Minimum commanded current at which a joint must move \[A\]. The encoder of a joint that does not move counts as
    /// dead.
    pub moving_current: f64,
    /// Maximum duration for which a joint may stand still while its commanded current is at least `moving_current`
    /// \[s\].
    pub standstill: f64,
    /// Maximum plausible joint speed \[rad/s\]. A faster change of an encoder is a fault.
    pub fastest: f64,
    /// Maximum permitted delay of a command \[s\].
    pub late_limit: f64,
    /// Maximum permitted number of consecutive missed deadlines.
    pub missed_limit: u32,
    /// Natural frequency \[rad/s\] and damping ratio of the low-pass filter for both deflections; None without a
    /// filter.
    pub filter: Option<(f64, f64)>,
}

impl GuardSettings {
    fn check(&self) -> Result<()> {
        let pairs = [
            ("strain_scale", self.strain_scale),
            ("encoder_scale", self.encoder_scale),
            ("current_limit", self.current_limit),
            ("slew", self.slew),
            ("continuous", self.continuous),
            ("deflection_limit", self.deflection_limit),
        ];
        let single = [
            ("step", self.step),
            ("sense_scale", self.sense_scale),
            ("command_scale", self.command_scale),
            ("thermal_time", self.thermal_time),
            ("saturation", self.saturation),
            ("moving_current", self.moving_current),
            ("standstill", self.standstill),
            ("fastest", self.fastest),
            ("late_limit", self.late_limit),
        ];
        if let Some((frequency, damping)) = self.filter
            && !(frequency > 0.0 && frequency.is_finite() && damping > 0.0 && damping.is_finite())
        {
            let value = if frequency > 0.0 && frequency.is_finite() { damping } else { frequency };
            return Err(Error::OutOfRange {
                name: "sensor filter".into(),
                value,
                range: "(0, ∞)".into(),
                remedy: "give its frequency in rad/s and its damping".into(),
            });
        }
        let all = pairs.iter().flat_map(|(name, v)| v.map(|v| (*name, v))).chain(single);
        for (name, value) in all {
            if !(value > 0.0 && value.is_finite()) {
                return Err(Error::OutOfRange {
                    name: name.into(),
                    value,
                    range: "(0, ∞)".into(),
                    remedy: "correct the rig's limits".into(),
                });
            }
        }
        Ok(())
    }
}

/// Reason why the motors were stopped. Joints, links and motors are numbered from 1.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum Fault {
    /// Command that is NaN or infinite.
    #[error("the command of motor {joint} is {value}, not a finite current; correct the input")]
    Command {
        /// Number of the motor: 1 or 2.
        joint: usize,
        /// Value of the command \[A\].
        value: f64,
    },
    /// Encoder that does not count although its motor has current.
    #[error("encoder {joint} has not changed for {seconds:.2} s under {current:.2} A or more; the encoder is faulty or the joint is blocked; check its cable and the gear")]
    DeadEncoder {
        /// Number of the joint: 1 or 2.
        joint: usize,
        /// Duration of the standstill \[s\].
        seconds: f64,
        /// Minimum commanded current at which the joint must move \[A\].
        current: f64,
    },
    /// Encoder jump that exceeds the highest plausible joint speed.
    #[error(
        "encoder {joint} jumped by {counts} counts in one sample; its counter wrapped or its cable is loose: check it"
    )]
    EncoderJump {
        /// Number of the joint: 1 or 2.
        joint: usize,
        /// Size of the jump in counts.
        counts: i64,
    },
    /// Strain gauge in saturation.
    #[error("strain gauge {joint} is saturated at {volts:.2} V; check its amplifier and cable")]
    Saturated {
        /// Number of the link: 1 or 2.
        joint: usize,
        /// Voltage of the sensor \[V\].
        volts: f64,
    },
    /// Strain gauge that does not respond to its motor.
    #[error("strain gauge {joint} has not changed from {volts:.4} V for {seconds:.2} s although the current changed by {current:.2} A or more; it is faulty and would not detect a bent link; check its amplifier and cable")]
    DeadGauge {
        /// Number of the link: 1 or 2.
        joint: usize,
        /// Voltage of the sensor \[V\].
        volts: f64,
        /// Duration without a response \[s\].
        seconds: f64,
        /// Minimum change of the motor current that must change the voltage of the gauge \[A\].
        current: f64,
    },
    /// Current sensor whose voltage is not finite.
    #[error("the current sense of motor {joint} reads {volts} V; check the board's analog inputs")]
    Sense {
        /// Number of the motor: 1 or 2.
        joint: usize,
        /// Voltage of the sensor \[V\].
        volts: f64,
    },
    /// Deflection above its limit.
    #[error("link {joint} is bent by {degrees:.2} degrees, more than the limit of {limit:.2}; use a smaller amplitude or avoid its resonance")]
    Deflection {
        /// Number of the link: 1 or 2.
        joint: usize,
        /// Deflection \[degrees\].
        degrees: f64,
        /// Limit of the deflection \[degrees\].
        limit: f64,
    },
    /// Limit switch that is tripped.
    #[error(
        "limit switch {line} is tripped; move the arm off the switch by hand with the amplifier off, then start again"
    )]
    Switch {
        /// Index of the digital line, from 0.
        line: usize,
    },
    /// Command whose delay exceeds its limit.
    #[error("a command was {milliseconds:.1} ms late, more than the limit of {limit:.0} ms; lower the rate or the machine's load")]
    Late {
        /// Delay \[ms\].
        milliseconds: f64,
        /// Limit of the delay \[ms\].
        limit: f64,
    },
    /// Too many consecutive missed deadlines.
    #[error("{count} deadlines in a row were missed; lower the rate or the machine's load")]
    Missed {
        /// Number of missed deadlines.
        count: u32,
    },
    /// Fault reported by the rig, with its message.
    #[error("{0}")]
    Rig(String),
}

/// Safety guard of one run. It converts readings, limits commands, and latches faults.
#[derive(Debug, Clone)]
pub struct Guard {
    settings: GuardSettings,
    fault: Option<Fault>,
    rest_count: usize,
    sums: [f64; 2],
    bias: [f64; 2],
    encoder_zero: [i32; 2],
    previous_counts: Option<[i32; 2]>,
    unchanged_time: [f64; 2],
    gauges: [Gauge; 2],
    last_current: [f64; 2],
    mean_square_current: [f64; 2],
    consecutive_missed: u32,
    missed_deadline_count: u64,
    filters: Option<[Filter; 2]>,
}

impl Guard {
    /// Guard at the start of a run, without readings and faults.
    ///
    /// # Errors
    /// [`Error::OutOfRange`] for a setting that is not a positive, finite number.
    ///
    /// ```
    /// # fn main() -> ftlm::error::Result<()> {
    /// use ftlm::rig::safety_guard::{Guard, GuardSettings};
    /// let mut guard = Guard::new(GuardSettings {
    ///     step: 0.002,
    ///     strain_scale: [0.0136, 0.0187],
    ///     sense_scale: 2.0,
    ///     command_scale: 0.5,
    ///     encoder_scale: [1.5e-5, 3.1e-5],
    ///     current_limit: [0.9, 1.2],
    ///     slew: [50.0, 80.0],
    ///     continuous: [0.6, 0.8],
    ///     thermal_time: 1.0,
    ///     deflection_limit: [0.09, 0.13],
    ///     saturation: 9.99,
    ///     moving_current: 0.25,
    ///     standstill: 0.5,
    ///     fastest: 20.0,
    ///     late_limit: 0.05,
    ///     missed_limit: 20,
    ///     filter: None,
    /// })?;
    /// // A step of 5 A is slewed to 0.1 A, 50 A/s for 2 ms.
    /// assert!((guard.command([5.0, 0.0])[0] + 0.2).abs() < 1e-12);
    /// # Ok(())
    /// # }
    /// ```
    pub fn new(settings: GuardSettings) -> Result<Self> {
        settings.check()?;
        let filters = settings.filter.map(|(w, damping)| [Filter::new(w, damping, settings.step); 2]);
        Ok(Self {
            settings,
            fault: None,
            rest_count: 0,
            sums: [0.0; 2],
            bias: [0.0; 2],
            encoder_zero: [0; 2],
            previous_counts: None,
            unchanged_time: [0.0; 2],
            gauges: [Gauge::default(); 2],
            last_current: [0.0; 2],
            mean_square_current: [0.0; 2],
            consecutive_missed: 0,
            missed_deadline_count: 0,
            filters,
        })
    }

    /// First fault of the run, which stays latched; None without a fault.
    #[must_use]
    pub fn fault(&self) -> Option<&Fault> {
        self.fault.as_ref()
    }

    /// Latch a fault, unless one is latched already.
    pub fn fail(&mut self, fault: Fault) {
        self.fault.get_or_insert(fault);
    }

    /// Currents of the last command, after all limits \[A\].
    #[must_use]
    pub fn last_currents(&self) -> [f64; 2] {
        self.last_current
    }

    /// Mean voltages of the strain gauges at rest \[V\].
    #[must_use]
    pub fn bias(&self) -> [f64; 2] {
        self.bias
    }

    /// Total number of missed deadlines.
    #[must_use]
    pub fn missed_deadlines(&self) -> u64 {
        self.missed_deadline_count
    }

    /// Process a reading before the motors are enabled. The gauge bias is the mean voltage of these readings, and the
    /// encoder zero is the last count.
    pub fn rest(&mut self, reading: &Reading) {
        self.check(reading);
        self.rest_count += 1;
        #[allow(clippy::cast_precision_loss)]
        let count = self.rest_count as f64;
        for j in 0..2 {
            self.sums[j] += reading.analog[j];
            self.bias[j] = self.sums[j] / count;
        }
        self.encoder_zero = reading.counts;
        self.previous_counts = Some(reading.counts);
    }

    /// Check a reading and convert it to hub angle and deflection of joint 1, then of joint 2 (θ₁₁, θ₁₂, θ₂₁, θ₂₂
    /// \[rad\]), and both motor currents \[A\]. `delay` \[s\] is the time from the deadline to this reading. A violated
    /// limit latches a fault.
    pub fn read(&mut self, reading: &Reading, delay: f64) -> [f64; 6] {
        self.check(reading);
        let mut hub_angles = [0.0; 2];
        let mut deflections = [0.0; 2];
        for j in 0..2 {
            let s = &self.settings;
            hub_angles[j] = f64::from(reading.counts[j].wrapping_sub(self.encoder_zero[j])) * s.encoder_scale[j];
            deflections[j] = -(reading.analog[j] - self.bias[j]) * s.strain_scale[j];
            if deflections[j].abs() > s.deflection_limit[j] {
                let (degrees, limit) = (deflections[j].to_degrees(), s.deflection_limit[j].to_degrees());
                self.fail(Fault::Deflection { joint: j + 1, degrees, limit });
            }
            self.check_encoder(j, reading.counts[j]);
            self.check_gauge(j, reading.analog[j]);
        }
        self.previous_counts = Some(reading.counts);
        self.check_deadline(delay);
        if let Some(filters) = &mut self.filters {
            for (filter, deflection) in filters.iter_mut().zip(&mut deflections) {
                *deflection = filter.step(*deflection);
            }
        }
        let scale = self.settings.sense_scale;
        [
            hub_angles[0],
            deflections[0],
            hub_angles[1],
            deflections[1],
            -reading.analog[2] * scale,
            -reading.analog[3] * scale,
        ]
    }

    /// Convert commanded currents \[A\] to voltages of both motors \[V\] within all limits. Every command passes
    /// through this function immediately before the output.
    ///
    /// The voltages are zero while a fault is latched. A command that is not finite latches a fault.
    pub fn command(&mut self, current: [f64; 2]) -> [f64; 2] {
        for (j, value) in current.iter().enumerate() {
            if !value.is_finite() {
                self.fail(Fault::Command { joint: j + 1, value: *value });
            }
        }
        if self.fault.is_some() {
            self.last_current = [0.0; 2];
            return [0.0; 2];
        }
        let s = &self.settings;
        let averaging_weight = (s.step / s.thermal_time).min(1.0);
        let mut volts = [0.0; 2];
        for j in 0..2 {
            let change = s.slew[j] * s.step;
            let limited = current[j]
                .clamp(-s.current_limit[j], s.current_limit[j])
                .clamp(self.last_current[j] - change, self.last_current[j] + change);
            // Largest current that keeps the mean square within the continuous limit.
            let max_square = self.mean_square_current[j]
                + (s.continuous[j] * s.continuous[j] - self.mean_square_current[j]) / averaging_weight;
            let continuous_limit = max_square.max(0.0).sqrt().min(s.current_limit[j]);
            let last_current = limited.clamp(-continuous_limit, continuous_limit);
            self.mean_square_current[j] +=
                averaging_weight * (last_current * last_current - self.mean_square_current[j]);
            self.last_current[j] = last_current;
            volts[j] = 0.0 - last_current / s.command_scale;
        }
        volts
    }

    fn check(&mut self, reading: &Reading) {
        for line in 0..4 {
            if reading.switches[line] == 0 {
                self.fail(Fault::Switch { line });
            }
        }
        for j in 0..2 {
            let volts = reading.analog[j];
            if volts.is_nan() || volts.abs() >= self.settings.saturation {
                self.fail(Fault::Saturated { joint: j + 1, volts });
            }
            let volts = reading.analog[2 + j];
            if !volts.is_finite() {
                self.fail(Fault::Sense { joint: j + 1, volts });
            }
        }
    }

    fn check_encoder(&mut self, j: usize, counts: i32) {
        let Some(previous) = self.previous_counts else { return };
        let change = i64::from(counts) - i64::from(previous[j]);
        let s = &self.settings;
        #[allow(clippy::cast_precision_loss)]
        let exceeds_speed = (change.abs() as f64) * s.encoder_scale[j] > s.fastest * s.step + 2.0 * s.encoder_scale[j];
        if exceeds_speed {
            self.fail(Fault::EncoderJump { joint: j + 1, counts: change });
        }
        let s = &self.settings;
        if change != 0 {
            self.unchanged_time[j] = 0.0;
        } else if self.last_current[j].abs() >= s.moving_current {
            self.unchanged_time[j] += s.step;
            if self.unchanged_time[j] > s.standstill {
                let (seconds, current) = (self.unchanged_time[j], s.moving_current);
                self.fail(Fault::DeadEncoder { joint: j + 1, seconds, current });
            }
        }
    }

    /// Latch a fault if a strain gauge does not respond. Noise alone changes the voltage of a working gauge from sample
    /// to sample. Without noise, the voltage changes when the motor current changes.
    fn check_gauge(&mut self, j: usize, volts: f64) {
        let (s, gauge) = (&self.settings, &mut self.gauges[j]);
        #[allow(clippy::float_cmp)]
        if gauge.volts != volts {
            *gauge = Gauge { volts, current_at_change: self.last_current[j], unchanged_time: 0.0 };
        } else if (self.last_current[j] - gauge.current_at_change).abs() >= s.moving_current {
            gauge.unchanged_time += s.step;
            if gauge.unchanged_time > s.standstill {
                let (seconds, current) = (gauge.unchanged_time, s.moving_current);
                self.fail(Fault::DeadGauge { joint: j + 1, volts, seconds, current });
            }
        }
    }

    fn check_deadline(&mut self, delay: f64) {
        let s = &self.settings;
        if delay > s.step {
            self.consecutive_missed += 1;
            self.missed_deadline_count += 1;
        } else {
            self.consecutive_missed = 0;
        }
        if delay.is_nan() || delay > s.late_limit {
            self.fail(Fault::Late { milliseconds: 1e3 * delay, limit: 1e3 * self.settings.late_limit });
        } else if self.consecutive_missed > s.missed_limit {
            self.fail(Fault::Missed { count: self.consecutive_missed });
        }
    }
}

/// Monitor of one strain gauge: its last voltage, and the motor current when this voltage was first read.
/// `unchanged_time` is the time \[s\] for which the voltage has not changed although the current has.
#[derive(Debug, Clone, Copy, Default)]
struct Gauge {
    volts: f64,
    current_at_change: f64,
    unchanged_time: f64,
}

/// Second-order low-pass filter, discretized by the bilinear transform.
#[derive(Debug, Clone, Copy)]
struct Filter {
    input: [f64; 3],
    output: [f64; 2],
    state: [f64; 2],
}

impl Filter {
    fn new(w: f64, damping: f64, step: f64) -> Self {
        let k = w * step / 2.0;
        let a = 1.0 + 2.0 * damping * k + k * k;
        Self {
            input: [k * k / a, 2.0 * k * k / a, k * k / a],
            output: [2.0 * (k * k - 1.0) / a, (1.0 - 2.0 * damping * k + k * k) / a],
            state: [0.0; 2],
        }
    }

    fn step(&mut self, x: f64) -> f64 {
        let y = self.input[0] * x + self.state[0];
        self.state[0] = self.input[1] * x - self.output[0] * y + self.state[1];
        self.state[1] = self.input[2] * x - self.output[1] * y;
        y
    }
}
