//! Bodies between their inputs and the friction of one: operators on pulse means, velocities at the edges of pulses, free
//! runs.
//!
//! The outputs follow from the equations as every linear free run does, friction being one more input once it is known. The
//! velocities obey the same equations, all that drives them differentiated once. At an edge the velocity of the body that
//! may stick is what the pulses before it add up to there, exactly for what is constant within each.

use super::integrals::{edge_kernel, product, Driver, Integrated};
use super::law::{Law, Phase};
use super::march::March;
use super::online::Heads;
use super::states::{Forcing, Link};
use crate::equation::{Equation, Initial, ORDER_GRAIN};
use crate::error::{check_finite, check_length, Error, Result};
use crate::excess::{kernel_and_slope, MAX_EXCESS};
use crate::impulses::{add_impulses, parted};
use crate::regressors::Record;
use crate::regularity::check_regular;
use crate::series::{self, Kernel, Solver};
use crate::small;

/// Equations that follow each other's outputs, one of them with friction of its own output's velocity.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// D^α y = Σ c D^ν s; of the one with friction 1 < α ≤ 2, and orders of every signal below α.
    pub equations: Vec<Equation>,
    /// Which of them has friction.
    pub sticks: usize,
    /// F of − F(Dy) sgn(Dy).
    pub friction: Law,
}

/// A free run.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Pulse means of each equation's output.
    pub outputs: Vec<Vec<f64>>,
    /// Velocity of the body that may stick at the edges of the pulses, one more than there are pulses; exactly 0 at rest.
    pub velocity: Vec<f64>,
    /// Mean of the friction over each pulse, in the unit of its D^α y.
    pub force: Vec<f64>,
    /// What the body did in each pulse.
    pub phases: Vec<Phase>,
}

impl Body {
    /// One equation by itself.
    #[must_use]
    pub fn alone(equation: Equation, friction: Law) -> Self {
        Self { equations: vec![equation], sticks: 0, friction }
    }

    /// Refuses orders that this law does not know, and coefficients that are no numbers.
    ///
    /// # Errors
    /// [`Error::OutOfRange`], [`Error::Structure`], [`Error::Length`], [`Error::NotFinite`].
    pub fn check(&self, signals: usize) -> Result<()> {
        let refuse = |name: &str, value: f64, range: &str, remedy: &str| {
            Err(Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() })
        };
        let Some(own) = self.equations.get(self.sticks) else {
            return Err(Error::Length {
                name: "equations".into(),
                expected: self.sticks + 1,
                found: self.equations.len(),
            });
        };
        for (i, Equation { structure, coefficients }) in self.equations.iter().enumerate() {
            structure.check(signals, |_| true)?;
            check_length("coefficients", structure.terms.len(), coefficients.len())?;
            check_finite("coefficients", coefficients)?;
            if self.equations[..i].iter().any(|e| e.structure.output == structure.output) {
                return Err(Error::Structure {
                    what: format!("two equations have signal {} as their output", structure.output),
                    remedy: "give one equation an output".into(),
                });
            }
        }
        let Law { coulomb, stribeck, speed } = self.friction;
        check_finite("friction", &[coulomb, stribeck, speed])?;
        let alpha = own.structure.order;
        if !(alpha > 1.0 && alpha <= 2.0) {
            return refuse("order of a body with friction", alpha, "(1, 2]", "a velocity needs inertia");
        }
        if let Some(force) = [coulomb, stribeck].into_iter().find(|f| *f < 0.0) {
            return refuse("friction", force, "[0, ∞)", "friction takes energy, it does not give any");
        }
        if speed <= 0.0 {
            return refuse("speed of Stribeck friction", speed, "(0, ∞)", "it is the speed at which friction falls");
        }
        for (i, Equation { structure, .. }) in self.equations.iter().enumerate() {
            // What drives another body must not jump in its velocity; other bodies may lean on accelerations.
            let above = |order: f64| order >= structure.order - ORDER_GRAIN;
            let wrong = |signal: usize| i == self.sticks || self.place(signal).is_none();
            match structure.terms.iter().find(|t| above(t.order) && wrong(t.signal)) {
                Some(term) if i == self.sticks => {
                    return refuse("order beside friction", term.order, "below that of the body", "lower it")
                }
                Some(term) => {
                    return refuse("order of what drives a body", term.order, "below that of the body", "lower it")
                }
                None => {}
            }
        }
        check_regular(&self.equations)
    }

    /// Which equation a signal is the output of.
    pub(super) fn place(&self, signal: usize) -> Option<usize> {
        self.equations.iter().position(|e| e.structure.output == signal)
    }

    /// Free run with given initial terms, (exponent, coefficient) pairs of powers of t by equation. O(n² m log² m).
    ///
    /// The exponents −1, −2, … are an impulse and its derivatives in the output alone, which move no body: through a filter
    /// that the output passes they become what it still held when the run began.
    ///
    /// # Errors
    /// As [`Body::check`]; [`Error::Diverged`] where the run leaves the range of numbers, [`Error::LeadingZero`] where the
    /// grid makes the equations unsolvable.
    ///
    /// ```
    /// use ftlm::equation::{Equation, Structure, Term};
    /// use ftlm::friction::{Body, Law};
    /// use ftlm::regressors::Record;
    /// # fn main() -> ftlm::error::Result<()> {
    /// // A block slides at 1 m/s on friction of 2 m/s²: it stops after half a second, 0.25 m on, and stays.
    /// let structure = Structure { output: 0, order: 2.0, terms: vec![Term { signal: 1, order: 0.0 }] };
    /// let block = Body::alone(Equation::new(structure, vec![1.0])?, Law::coulomb(2.0));
    /// let run = Record::new(0.01, vec![vec![0.0; 100], vec![0.0; 100]], None)?;
    /// let motion = block.run(&run, &[vec![(1.0, 1.0)]])?;
    /// assert!((motion.velocity[25] - 0.5).abs() < 1e-12 && motion.velocity[50..].iter().all(|v| v.abs() < 1e-12));
    /// assert!((motion.outputs[0][99] - 0.25).abs() < 1e-9);
    /// # Ok(())
    /// # }
    /// ```
    pub fn run(&self, record: &Record, initial: &[Vec<(f64, f64)>]) -> Result<Motion> {
        self.check(record.len())?;
        check_length("initial terms", self.equations.len(), initial.len())?;
        let (powers, impulses) = parted(initial);
        for terms in &powers {
            let (exponents, values): (Vec<f64>, Vec<f64>) = terms.iter().copied().unzip();
            check_finite("coefficients of the initial terms", &values)?;
            Initial::Powers(exponents).check()?;
        }
        let forcing = Forcing::of(&powers, &self.links(), self.sticks, record.m(), record.step())?;
        let mut run = Run::new(self, &Operators::new(self, record)?, &forcing)?;
        add_impulses(&mut run.outputs, &impulses, record.step());
        Ok(Motion { outputs: run.outputs, velocity: run.march.edges, force: run.march.force, phases: run.march.phases })
    }

    /// Of each equation the terms of outputs that are followed.
    pub(super) fn links(&self) -> Vec<Vec<Link>> {
        let of = |Equation { structure, coefficients }: &Equation| {
            (structure.terms.iter().zip(coefficients))
                .filter_map(|(term, &coefficient)| {
                    let (order, integration) = (term.order, structure.order - term.order);
                    self.place(term.signal).map(|output| Link { output, order, integration, coefficient })
                })
                .collect()
        };
        self.equations.iter().map(of).collect()
    }
}

/// Everything linear about bodies on a record.
pub(super) struct Operators {
    /// Kernels and spectrum of each term's signal, where it is no output that is followed, by equation.
    pub(super) drivers: Vec<Vec<Option<(Driver, Kernel)>>>,
    /// Each driver's signal, integrated.
    pub(super) driven: Vec<Vec<Option<Integrated>>>,
    /// Kernel of each term of a followed output on means and, in the body's equation, at edges, with slopes.
    pub(super) own: Vec<Vec<Option<[Vec<f64>; 4]>>>,
    /// A of A y = b.
    matrix: Vec<Vec<Vec<f64>>>,
    /// Spectra of A⁻¹.
    inverse: Vec<Vec<Kernel>>,
    /// Inverse of A's leading coefficients.
    leading: Vec<f64>,
    /// Spectrum of what velocities of each output add to the body's at edges, where they add something.
    edges: Vec<Option<Kernel>>,
    /// Kernels of friction.
    pub(super) friction: Driver,
    /// What a pulse of force does to the velocity at the ends of pulses.
    pub(super) response: Heads,
    pub(super) first: f64,
    sticks: usize,
}

impl Operators {
    pub(super) fn new(body: &Body, record: &Record) -> Result<Self> {
        let (m, step, n, sticks) = (record.m(), record.step(), body.equations.len(), body.sticks);
        let mut matrix = vec![vec![vec![0.0; m]; n]; n];
        let mut own_edges: Vec<Option<Vec<f64>>> = vec![None; n];
        let (mut drivers, mut driven, mut own) = (Vec::new(), Vec::new(), Vec::new());
        for (i, Equation { structure, coefficients }) in body.equations.iter().enumerate() {
            matrix[i][i][0] = 1.0;
            let (mut row_drivers, mut row_driven, mut row_own) = (Vec::new(), Vec::new(), Vec::new());
            for (term, &c) in structure.terms.iter().zip(coefficients) {
                let eta = structure.order - term.order;
                if eta <= -MAX_EXCESS {
                    // Reported like a step too far, so that a search shortens it.
                    return Err(Error::Diverged { what: "order of a term above alpha; the free run".into(), index: 0 });
                }
                if let Some(j) = body.place(term.signal) {
                    let means = kernel_and_slope(eta, m, step);
                    matrix[i][j].iter_mut().zip(&means.0).for_each(|(a, v)| *a -= c * v);
                    let edges = if i == sticks { edge_kernel(eta, m, step) } else { (Vec::new(), Vec::new()) };
                    if i == sticks {
                        let sum = own_edges[j].get_or_insert_with(|| vec![0.0; m]);
                        sum.iter_mut().zip(&edges.0).for_each(|(e, v)| *e += c * v);
                    }
                    row_own.push(Some([means.0, means.1, edges.0, edges.1]));
                    row_drivers.push(None);
                    row_driven.push(None);
                } else {
                    let driver = Driver::new(eta, m, step, i == sticks);
                    let signal = Kernel::new(record.signal(term.signal));
                    row_driven.push(Some(driver.of(&signal, 0)));
                    row_drivers.push(Some((driver, signal)));
                    row_own.push(None);
                }
            }
            drivers.push(row_drivers);
            driven.push(row_driven);
            own.push(row_own);
        }
        let leading: Vec<f64> = matrix.iter().flatten().map(|a| a.first().copied().unwrap_or(0.0)).collect();
        let leading = small::inverse(&leading, n)?;
        let inverse = Solver::new(&matrix)?.inverse_spectra(2 * m)?;
        let edges: Vec<Option<Kernel>> = own_edges.iter().map(|e| e.as_deref().map(Kernel::new)).collect();
        let friction = Driver::new(body.equations[sticks].structure.order, m, step, true);
        let mut made = Self {
            drivers,
            driven,
            own,
            matrix,
            inverse,
            leading,
            edges,
            friction,
            response: Heads::new(&[]),
            first: 0.0,
            sticks,
        };
        let mut pulse = vec![Vec::new(); n];
        pulse[sticks].clone_from(&made.friction.velocity[0]);
        let mut response = made.at_edges(&made.through(&pulse), m);
        if let Some(kernels) = &made.friction.edges {
            response.iter_mut().zip(&kernels[0]).for_each(|(g, v)| *g += v);
        }
        made.first = response.first().copied().unwrap_or(0.0);
        made.response = Heads::new(&response);
        Ok(made)
    }

    /// A⁻¹ of right-hand sides, empty ones being zero.
    pub(super) fn through(&self, rhs: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let of = |row: &Vec<Kernel>| {
            let parts = row.iter().zip(rhs).filter(|(_, b)| !b.is_empty()).map(|(kernel, b)| product(kernel, b));
            parts.reduce(|a, b| a.iter().zip(&b).map(|(x, y)| x + y).collect()).unwrap_or_default()
        };
        self.inverse.iter().map(of).collect()
    }

    /// What velocities of all outputs add to that of the body at the ends of pulses.
    pub(super) fn at_edges(&self, velocities: &[Vec<f64>], m: usize) -> Vec<f64> {
        let mut out = vec![0.0; m];
        for (kernel, velocity) in self.edges.iter().zip(velocities) {
            if let Some(kernel) = kernel {
                out.iter_mut().zip(product(kernel, velocity)).for_each(|(s, v)| *s += v);
            }
        }
        out
    }

    /// Derivative of the first number of the response from those of the body's α (`turn`) and of each own term of each
    /// equation: (coefficient's, integration's).
    pub(super) fn first_slope(&self, body: &Body, turn: f64, moves: &[Vec<(f64, f64)>]) -> f64 {
        let Some(kernels) = &self.friction.edges else { return 0.0 };
        let (n, b) = (self.matrix.len(), self.sticks);
        let (through, through_slope) = (self.friction.velocity[0][0], turn * self.friction.velocity[1][0]);
        // First numbers of the velocities that a pulse of force gives, and of the system's slope times them.
        let velocities: Vec<f64> = (0..n).map(|j| self.leading[j * n + b] * through).collect();
        let mut rhs = vec![0.0; n];
        rhs[b] = through_slope;
        let (mut edge, mut edge_slope) = (vec![0.0; n], 0.0);
        for (i, Equation { structure, coefficients }) in body.equations.iter().enumerate() {
            for (k, (own, &c)) in self.own[i].iter().zip(coefficients).enumerate() {
                let (Some([mean, mean_slope, end, end_slope]), (dc, deta)) = (own, moves[i][k]) else { continue };
                let Some(j) = body.place(structure.terms[k].signal) else { continue };
                rhs[i] += (dc * mean[0] + c * deta * mean_slope[0]) * velocities[j];
                if i == b {
                    edge[j] += c * end[0];
                    edge_slope += (dc * end[0] + c * deta * end_slope[0]) * velocities[j];
                }
            }
        }
        let moved: f64 = (0..n).map(|j| edge[j] * (0..n).map(|i| self.leading[j * n + i] * rhs[i]).sum::<f64>()).sum();
        turn * kernels[1][0] + edge_slope + moved
    }
}

/// A free run with all that its derivatives are made of.
pub(super) struct Run {
    pub(super) outputs: Vec<Vec<f64>>,
    /// That of the body as the equations have it, without what [`at_rest`] takes away.
    pub(super) solved: Vec<f64>,
    /// Pulse means of the velocities.
    pub(super) velocities: Vec<Vec<f64>>,
    pub(super) march: March,
    /// Spectrum of the friction.
    pub(super) force: Kernel,
}

impl Run {
    pub(super) fn new(body: &Body, operators: &Operators, forcing: &Forcing) -> Result<Self> {
        let mut total = forcing.clone();
        for (i, (row, equation)) in operators.driven.iter().zip(&body.equations).enumerate() {
            for (driven, &c) in row.iter().zip(&equation.coefficients) {
                if let Some(driven) = driven {
                    total.add_to(i, c, driven);
                }
            }
        }
        let b = body.sticks;
        let m = total.edges.len();
        let free = operators.at_edges(&operators.through(&total.velocity), m);
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
        total.output[b].iter_mut().zip(&held.output).for_each(|(b, v)| *b -= v);
        total.velocity[b].iter_mut().zip(&held.velocity).for_each(|(b, v)| *b -= v);
        let still = march.edges.iter().all(|v| *v == 0.0);
        let mut outputs = if still && body.equations.len() == 1 {
            vec![vec![total.levels[b]; m]]
        } else {
            let rhs: Vec<&[f64]> = total.output.iter().map(Vec::as_slice).collect();
            series::solve(&operators.matrix, &rhs)?
        };
        let solved = outputs[b].clone();
        if still {
            // What never leaves its rest is where it was, not where rounding puts it.
            outputs[b] = vec![total.levels[b]; m];
        } else if outputs.len() > 1 {
            at_rest(&mut outputs[b], &march);
        }
        if let Some(index) = outputs.iter().find_map(|y| y.iter().position(|v| !v.is_finite())) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        let velocities = operators.through(&total.velocity);
        Ok(Self { outputs, solved, velocities, march, force })
    }
}

/// Takes from an output, or its slope, what it creeps while the body rests.
///
/// Its velocity is 0 at the edges of each pulse, but a force that another body exerts changes within it while friction's
/// mean stands, which moves the mean position by a share of the square of the step.
pub(super) fn at_rest(output: &mut [f64], march: &March) {
    let (mut crept, mut before) = (0.0, output.first().copied().unwrap_or(0.0));
    for (value, edges) in output.iter_mut().skip(1).zip(march.edges.windows(3)) {
        let now = *value;
        if edges.iter().all(|v| *v == 0.0) {
            crept += now - before;
        }
        before = now;
        *value = now - crept;
    }
}

/// Ratio of the velocities without and with friction beyond which their difference has lost half of its digits.
const LOST: f64 = 1e8;
