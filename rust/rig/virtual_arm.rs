//! The arm behind its sensors and converters, stepped and paced in real time or not, and what goes wrong on purpose.

use std::time::{Duration, Instant};

use super::arm::Arm;
use crate::error::{Error, Result};

/// What the arm's sensors and converters make of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensors {
    /// Deflection per volt of strain gauge \[rad/V\].
    pub strain_scale: [f64; 2],
    /// Volts of the gauges at rest.
    pub strain_bias: [f64; 2],
    /// Standard deviation of the noise on strain 1, 2 and current sense 1, 2 \[V\].
    pub noise: [f64; 4],
    /// Offset of the current sense \[V\].
    pub sense_bias: [f64; 2],
    /// Current per volt of the sense \[A/V\].
    pub sense_scale: f64,
    /// Current per volt of the command \[A/V\].
    pub command_scale: f64,
    /// Hub angle per count \[rad\].
    pub encoder_scale: [f64; 2],
    /// Volts from end to end of the converters' range are twice this.
    pub range: f64,
    /// Bits of the converters; 0 for none.
    pub bits: u32,
    /// Largest current of the amplifiers \[A\].
    pub current_limit: [f64; 2],
    /// Hub angle at which a limit switch opens \[rad\].
    pub travel: [f64; 2],
}

/// What goes wrong on purpose, from a sample on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Injection {
    /// The encoder stops counting.
    DeadEncoder {
        /// Stage, from 0.
        stage: usize,
        /// First sample.
        from: u64,
    },
    /// The gauge's amplifier sits at its rail.
    SaturatedGauge {
        /// Stage, from 0.
        stage: usize,
        /// First sample.
        from: u64,
    },
    /// A limit switch opens.
    LimitSwitch {
        /// Line, from 0.
        line: usize,
        /// First sample.
        from: u64,
    },
    /// The link bends by this much more \[rad\].
    Deflection {
        /// Stage, from 0.
        stage: usize,
        /// First sample.
        from: u64,
        /// Angle \[rad\].
        angle: f64,
    },
    /// The loop is late by this much at one sample \[s\], on the virtual clock.
    Late {
        /// Sample.
        at: u64,
        /// Delay \[s\].
        seconds: f64,
    },
    /// The board hands over no samples any more.
    LostSamples {
        /// First sample.
        from: u64,
    },
}

/// One reading of all channels at one instant.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Reading {
    /// Strain 1, 2, current sense 1, 2 \[V\].
    pub analog: [f64; 4],
    /// Encoder counts.
    pub counts: [i32; 2],
    /// Limit switches; 0 is tripped.
    pub switches: [i8; 4],
}

/// The arm behind its converters.
#[derive(Debug, Clone)]
pub struct Plant {
    /// The arm itself.
    pub arm: Arm,
    sensors: Sensors,
    current: [f64; 2],
    frozen: [Option<i32>; 2],
    injections: Vec<Injection>,
    sample: u64,
}

impl Plant {
    /// An arm at rest with no current.
    #[must_use]
    pub fn new(arm: Arm, sensors: Sensors) -> Self {
        Self { arm, sensors, current: [0.0; 2], frozen: [None; 2], injections: Vec::new(), sample: 0 }
    }

    /// Adds something that goes wrong.
    pub fn inject(&mut self, injection: Injection) {
        self.injections.push(injection);
    }

    /// Number of the sample that [`Self::read`] reads next.
    #[must_use]
    pub fn sample(&self) -> u64 {
        self.sample
    }

    /// All channels now; `noise` is standard normal, for strain 1, 2 and sense 1, 2.
    pub fn read(&mut self, noise: [f64; 4]) -> Reading {
        let s = &self.sensors;
        let angles = self.arm.angles();
        let mut bend = [angles[1], angles[3]];
        let mut analog = [0.0; 4];
        let mut switches = [1_i8; 4];
        let mut rail = [false; 2];
        for injection in &self.injections {
            match *injection {
                Injection::SaturatedGauge { stage, from } => rail[stage] |= self.sample >= from,
                Injection::LimitSwitch { line, from } if self.sample >= from => switches[line] = 0,
                Injection::Deflection { stage, from, angle } if self.sample >= from => bend[stage] += angle,
                _ => {}
            }
        }
        for j in 0..2 {
            let strain = s.strain_bias[j] - bend[j] / s.strain_scale[j] + s.noise[j] * noise[j];
            analog[j] = s.convert(if rail[j] { s.range } else { strain });
            let sense = s.sense_bias[j] - self.current[j] / s.sense_scale + s.noise[2 + j] * noise[2 + j];
            analog[2 + j] = s.convert(sense);
            for (line, beyond) in [(2 * j, -angles[2 * j]), (2 * j + 1, angles[2 * j])] {
                if beyond > s.travel[j] {
                    switches[line] = 0;
                }
            }
        }
        // The arm rests in the middle of a count, so that counting has no bias.
        #[allow(clippy::cast_possible_truncation)]
        let mut counts: [i32; 2] = std::array::from_fn(|j| (angles[2 * j] / s.encoder_scale[j] + 0.5).floor() as i32);
        for injection in &self.injections {
            if let Injection::DeadEncoder { stage, from } = *injection {
                if self.sample >= from {
                    counts[stage] = *self.frozen[stage].get_or_insert(counts[stage]);
                }
            }
        }
        Reading { analog, counts, switches }
    }

    /// Whether the board still hands over samples.
    #[must_use]
    pub fn sampling(&self) -> bool {
        !self.injections.iter().any(|i| matches!(i, Injection::LostSamples { from } if self.sample >= *from))
    }

    /// The injected delay at this sample \[s\].
    #[must_use]
    pub fn delay(&self) -> f64 {
        let late = |i: &Injection| match *i {
            Injection::Late { at, seconds } if at == self.sample => seconds,
            _ => 0.0,
        };
        self.injections.iter().map(late).sum()
    }

    /// One sample under these volts at the amplifiers' inputs; disabled amplifiers give no current.
    pub fn advance(&mut self, volts: [f64; 2], enabled: bool) {
        let s = &self.sensors;
        for ((current, volts), limit) in self.current.iter_mut().zip(volts).zip(s.current_limit) {
            let asked = -s.convert(volts) * s.command_scale;
            *current = if enabled { asked.clamp(-limit, limit) } else { 0.0 };
        }
        self.arm.advance(self.current);
        self.sample += 1;
    }
}

impl Sensors {
    /// Clips to the converters' range and rounds to their steps; what is not a number becomes 0 V.
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

/// Deadlines of a loop in real time, counted from its start.
#[derive(Debug)]
pub struct Pace {
    start: Instant,
    step: f64,
    samples: u64,
}

/// The system's sleep ends late by some tens of microseconds; the rest is waited out awake.
const AWAKE: Duration = Duration::from_micros(120);

impl Pace {
    /// Starts now.
    #[must_use]
    pub fn new(step: f64) -> Self {
        Self { start: Instant::now(), step, samples: 0 }
    }

    /// Waits for the next sample instant; how late it is when it returns \[s\].
    pub fn wait(&mut self) -> f64 {
        #[allow(clippy::cast_precision_loss)]
        let due = self.start + Duration::from_secs_f64(self.step * self.samples as f64);
        self.samples += 1;
        loop {
            let now = Instant::now();
            match due.checked_duration_since(now) {
                None => return now.duration_since(due).as_secs_f64(),
                Some(left) if left > AWAKE => std::thread::sleep(left - AWAKE),
                Some(_) => std::hint::spin_loop(),
            }
        }
    }
}
