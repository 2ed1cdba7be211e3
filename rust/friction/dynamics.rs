//! The body between its inputs and its friction: operators on pulse means, velocities at the edges of pulses, free runs.
//!
//! The output follows from the equation as every linear free run does, friction being one more input once it is known. The velocity obeys the same equation, all that drives it differentiated once. At an edge it is what the pulses
//! before it add up to there, exactly for what is constant within each.

use super::law::{Law, Phase};
use super::march::March;
use super::online::Heads;
use super::states::Forcing;
use crate::equation::{Structure, ORDER_GRAIN};
use crate::error::{check_finite, check_length, Error, Result};
use crate::excess::kernel_and_slope;
use crate::kernels::digamma;
use crate::regressors::Record;
use crate::series::{divide, reciprocal, Buffers, Kernel};

/// An equation with friction of its own output's velocity.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// D^α y = Σ c D^ν s, 1 < α ≤ 2; orders of every signal below α.
    pub structure: Structure,
    /// One coefficient a term.
    pub coefficients: Vec<f64>,
    /// F of − F(Dy) sgn(Dy).
    pub friction: Law,
}

/// A free run.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Pulse means of the output.
    pub output: Vec<f64>,
    /// Velocity at the edges of the pulses, one more than there are pulses; exactly 0 at rest.
    pub velocity: Vec<f64>,
    /// Mean of the friction over each pulse, in the unit of D^α y.
    pub force: Vec<f64>,
    /// What the body did in each pulse.
    pub phases: Vec<Phase>,
}

impl Body {
    /// Refuses orders that this law does not know, and coefficients that are no numbers.
    ///
    /// # Errors
    /// [`Error::OutOfRange`], [`Error::Structure`], [`Error::Length`], [`Error::NotFinite`].
    pub fn check(&self, signals: usize) -> Result<()> {
        self.structure.check(signals, |_| true)?;
        check_length("coefficients", self.structure.terms.len(), self.coefficients.len())?;
        check_finite("coefficients", &self.coefficients)?;
        let Law { coulomb, stribeck, speed } = self.friction;
        check_finite("friction", &[coulomb, stribeck, speed])?;
        let refuse = |name: &str, value: f64, range: &str, remedy: &str| {
            Err(Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() })
        };
        let alpha = self.structure.order;
        if !(alpha > 1.0 && alpha <= 2.0) {
            return refuse("order of a body with friction", alpha, "(1, 2]", "a velocity needs inertia");
        }
        if let Some(force) = [coulomb, stribeck].into_iter().find(|f| *f < 0.0) {
            return refuse("friction", force, "[0, ∞)", "friction takes energy, it does not give any");
        }
        if speed <= 0.0 {
            return refuse("speed of Stribeck friction", speed, "(0, ∞)", "it is the speed at which friction falls");
        }
        match self.structure.terms.iter().find(|t| t.order >= alpha - ORDER_GRAIN) {
            Some(term) => refuse("order beside friction", term.order, "below that of the body", "lower it"),
            None => Ok(()),
        }
    }

    /// Free run with given initial terms, (exponent, coefficient) pairs of powers of t. O(m log² m).
    ///
    /// # Errors
    /// As [`Body::check`]; [`Error::Diverged`] where the run leaves the range of numbers.
    ///
    /// ```
    /// use ftlm::equation::{Structure, Term};
    /// use ftlm::friction::{Body, Law};
    /// use ftlm::regressors::Record;
    /// # fn main() -> ftlm::error::Result<()> {
    /// // A block slides at 1 m/s on friction of 2 m/s²: it stops after half a second, 0.25 m on, and stays.
    /// let structure = Structure { output: 0, order: 2.0, terms: vec![Term { signal: 1, order: 0.0 }] };
    /// let block = Body { structure, coefficients: vec![1.0], friction: Law::coulomb(2.0) };
    /// let run = Record::new(0.01, vec![vec![0.0; 100], vec![0.0; 100]], None)?;
    /// let motion = block.run(&run, &[(1.0, 1.0)])?;
    /// assert!((motion.velocity[25] - 0.5).abs() < 1e-12 && motion.velocity[50..].iter().all(|v| v.abs() < 1e-12));
    /// assert!((motion.output[99] - 0.25).abs() < 1e-9);
    /// # Ok(())
    /// # }
    /// ```
    pub fn run(&self, record: &Record, initial: &[(f64, f64)]) -> Result<Motion> {
        self.check(record.len())?;
        let (exponents, values): (Vec<f64>, Vec<f64>) = initial.iter().copied().unzip();
        check_finite("coefficients of the initial terms", &values)?;
        crate::equation::Initial::Powers(exponents).check()?;
        let forcing = Forcing::of(initial, &self.own(), record.m(), record.step());
        let run = Run::new(self, &Operators::new(self, record), &forcing)?;
        Ok(Motion { output: run.output, velocity: run.march.edges, force: run.march.force, phases: run.march.phases })
    }

    /// Integration and coefficient of each own term.
    pub(super) fn own(&self) -> Vec<(f64, f64)> {
        let structure = &self.structure;
        (structure.terms.iter().zip(&self.coefficients))
            .filter(|(term, _)| term.signal == structure.output)
            .map(|(term, &c)| (structure.order - term.order, c))
            .collect()
    }
}

/// What pulses of a signal give at the ends of pulses, integrated by η > 0, and its derivative with respect to η.
#[allow(clippy::cast_precision_loss)]
fn edge_kernel(eta: f64, m: usize, step: f64) -> (Vec<f64>, Vec<f64>) {
    let scale = libm::pow(step, eta) / libm::tgamma(eta + 1.0);
    let turn = libm::log(step) - digamma(eta + 1.0);
    (0..m)
        .map(|n| {
            // (n + 1)^η − n^η without the cancellation.
            let (value, slope) = if n == 0 {
                (1.0, 0.0)
            } else {
                let (n, near) = (n as f64, libm::log1p(1.0 / n as f64));
                let (power, grown) = (libm::pow(n, eta), libm::expm1(eta * near));
                (power * grown, power * (libm::log(n) * grown + near * (grown + 1.0)))
            };
            (scale * value, scale * (value * turn + slope))
        })
        .unzip()
}

/// Below this integration a signal shows at an edge as the pulses on either side have it.
const SEEN_AT_ONCE: f64 = 1e-6;

/// A signal integrated as its term asks on all three levels, or the slope of that with respect to the order.
#[derive(Debug, Clone)]
pub(super) struct Integrated {
    pub(super) output: Vec<f64>,
    pub(super) velocity: Vec<f64>,
    pub(super) edges: Vec<f64>,
}

/// Kernels of a signal that drives the body, integrated by η on the level of the output: values and slopes.
pub(super) struct Driver {
    output: [Vec<f64>; 2],
    velocity: [Vec<f64>; 2],
    edges: Option<[Vec<f64>; 2]>,
}

impl Driver {
    fn new(eta: f64, m: usize, step: f64) -> Self {
        let (output, velocity) = (kernel_and_slope(eta, m, step), kernel_and_slope(eta - 1.0, m, step));
        let edges = (eta - 1.0 > SEEN_AT_ONCE).then(|| edge_kernel(eta - 1.0, m, step));
        Self {
            output: [output.0, output.1],
            velocity: [velocity.0, velocity.1],
            edges: edges.map(|(value, slope)| [value, slope]),
        }
    }

    /// The signal through the kernels (0) or their slopes (1).
    pub(super) fn of(&self, signal: &Kernel, which: usize) -> Integrated {
        let velocity = product(signal, &self.velocity[which]);
        let edges = match &self.edges {
            Some(kernels) => product(signal, &kernels[which]),
            None => at_edges(&velocity),
        };
        Integrated { output: product(signal, &self.output[which]), velocity, edges }
    }
}

/// A product with what was cached.
pub(super) fn product(cached: &Kernel, series: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; series.len()];
    cached.apply(series, &mut out, &mut Buffers::default());
    out
}

/// Values at the ends of the pulses from means: those on either side, the last extended.
fn at_edges(means: &[f64]) -> Vec<f64> {
    let m = means.len();
    let mut out: Vec<f64> = means.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])).collect();
    let last = means.last().copied().unwrap_or(0.0);
    out.push(if m > 1 { 1.5 * last - 0.5 * means[m - 2] } else { last });
    out
}

/// Everything linear about a body on a record.
pub(super) struct Operators {
    /// Kernels and spectrum of each term's signal, where it is another than the output.
    pub(super) drivers: Vec<Option<(Driver, Kernel)>>,
    /// Each driver's signal, integrated.
    pub(super) driven: Vec<Option<Integrated>>,
    /// Kernel of each own term on means and at edges, with slopes.
    pub(super) own: Vec<Option<[Vec<f64>; 4]>>,
    /// A of A y = b.
    divisor: Vec<f64>,
    /// Spectrum of 1/A.
    pub(super) inverse: Kernel,
    /// Spectrum of the own terms at edges, together.
    pub(super) own_edges: Kernel,
    /// Kernels of friction.
    pub(super) friction: Driver,
    /// What a pulse of force does to the velocity at the ends of pulses.
    pub(super) response: Heads,
    pub(super) first: f64,
}

impl Operators {
    pub(super) fn new(body: &Body, record: &Record) -> Self {
        let (m, step, structure) = (record.m(), record.step(), &body.structure);
        let mut divisor = vec![0.0; m];
        divisor[0] = 1.0;
        let mut own_edges = vec![0.0; m];
        let (mut drivers, mut driven, mut own) = (Vec::new(), Vec::new(), Vec::new());
        for (term, &c) in structure.terms.iter().zip(&body.coefficients) {
            let eta = structure.order - term.order;
            if term.signal == structure.output {
                let (means, edges) = (kernel_and_slope(eta, m, step), edge_kernel(eta, m, step));
                divisor.iter_mut().zip(&means.0).for_each(|(a, v)| *a -= c * v);
                own_edges.iter_mut().zip(&edges.0).for_each(|(e, v)| *e += c * v);
                own.push(Some([means.0, means.1, edges.0, edges.1]));
                drivers.push(None);
                driven.push(None);
            } else {
                let (driver, signal) = (Driver::new(eta, m, step), Kernel::new(record.signal(term.signal)));
                driven.push(Some(driver.of(&signal, 0)));
                drivers.push(Some((driver, signal)));
                own.push(None);
            }
        }
        let inverse = Kernel::new(&reciprocal(&divisor));
        let own_edges = Kernel::new(&own_edges);
        let friction = Driver::new(structure.order, m, step);
        let mut response = product(&own_edges, &product(&inverse, &friction.velocity[0]));
        if let Some(kernels) = &friction.edges {
            response.iter_mut().zip(&kernels[0]).for_each(|(g, v)| *g += v);
        }
        let first = response.first().copied().unwrap_or(0.0);
        let response = Heads::new(&response);
        Self { drivers, driven, own, divisor, inverse, own_edges, friction, response, first }
    }

    /// Derivative of the first number of the response from those of α (`turn`) and of each own term: (coefficient's,
    /// integration's).
    pub(super) fn first_slope(&self, body: &Body, turn: f64, moves: &[(f64, f64)]) -> f64 {
        let Some(kernels) = &self.friction.edges else { return 0.0 };
        let (through, through_slope) = (self.friction.velocity[0][0], turn * self.friction.velocity[1][0]);
        let (mut edge, mut edge_slope, mut divisor_slope) = (0.0, 0.0, 0.0);
        for ((own, &c), &(dc, deta)) in self.own.iter().zip(&body.coefficients).zip(moves) {
            if let Some([mean, mean_slope, end, end_slope]) = own {
                edge += c * end[0];
                edge_slope += dc * end[0] + c * deta * end_slope[0];
                divisor_slope -= dc * mean[0] + c * deta * mean_slope[0];
            }
        }
        let a = self.divisor[0];
        turn * kernels[1][0] + (edge_slope * through + edge * through_slope) / a
            - edge * through * divisor_slope / (a * a)
    }
}

/// A free run with all that its derivatives are made of.
pub(super) struct Run {
    pub(super) output: Vec<f64>,
    /// Pulse means of the velocity.
    pub(super) velocity: Vec<f64>,
    pub(super) march: March,
    /// Spectrum of the friction.
    pub(super) force: Kernel,
}

impl Run {
    pub(super) fn new(body: &Body, operators: &Operators, forcing: &Forcing) -> Result<Self> {
        let mut total = forcing.clone();
        for (driven, &c) in operators.driven.iter().zip(&body.coefficients) {
            if let Some(driven) = driven {
                for (sum, part) in [
                    (&mut total.output, &driven.output),
                    (&mut total.velocity, &driven.velocity),
                    (&mut total.edges, &driven.edges),
                ] {
                    sum.iter_mut().zip(part).for_each(|(s, v)| *s += c * v);
                }
            }
        }
        let free = product(&operators.own_edges, &product(&operators.inverse, &total.velocity));
        let linear: Vec<f64> = free.iter().zip(&total.edges).map(|(a, b)| a + b).collect();
        if let Some(index) = linear.iter().position(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        let march = March::new(&linear, &operators.response, operators.first, body.friction, total.start);
        if let Some(index) = march.edges.iter().position(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        // What friction holds back though nothing else would is a difference of two large numbers.
        let largest = |values: &[f64]| values.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        if largest(&linear) > LOST * (largest(&march.edges) + body.friction.breakaway() * operators.first) {
            return Err(Error::Diverged { what: "free run without its friction".into(), index: linear.len() });
        }
        let force = Kernel::new(&march.force);
        let held = operators.friction.of(&force, 0);
        total.output.iter_mut().zip(&held.output).for_each(|(b, v)| *b -= v);
        total.velocity.iter_mut().zip(&held.velocity).for_each(|(b, v)| *b -= v);
        let output = if march.edges.iter().all(|v| *v == 0.0) {
            // What never leaves its rest is where it was, not where rounding puts it.
            vec![total.level; linear.len()]
        } else {
            divide(&total.output, &operators.divisor)?
        };
        if let Some(index) = output.iter().position(|v| !v.is_finite()) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        let velocity = product(&operators.inverse, &total.velocity);
        Ok(Self { output, velocity, march, force })
    }
}

/// Ratio of the velocities without and with friction beyond which their difference has lost half of its digits.
const LOST: f64 = 1e8;
