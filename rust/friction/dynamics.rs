//! Bodies between their inputs and their friction: operators on pulse means, velocities at the edges of pulses, free
//! runs.
//!
//! The outputs follow from the equations as every linear free run does, friction being one more input once it is known. The
//! velocities obey the same equations, all that drives them differentiated once, and so do their values at the edges of
//! the pulses: what drives them is there what its pulses add up to, exactly for what is constant within each, and they
//! themselves are lines between edges, whose integrals have the kernels of pulse means
//! ([`crate::fractional::kernels::block_pulse_kernel`]). So a body feels at once what carries it, friction of the pulse
//! included.

use super::contact::{is_p_matrix, March, Rubbing, Trace};
use super::convolution::{product, Driver, Heads, Integrated};
use super::initial_state::{Forcing, Link};
use super::law::Law;
use crate::equation::{check_regular, Equation, Initial, ORDER_GRAIN};
use crate::error::{check_finite, check_length, Error, Result};
use crate::fractional::kernels::{kernel_and_slope, MAX_EXCESS};
use crate::linalg::small;
use crate::regressors::{add_impulses, parted, Record};
use crate::series::{self, Kernel, Solver};

/// Equations that follow each other's outputs, some of them with friction of their own output's velocity.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// D^α y = Σ c D^ν s; of those with friction 1 < α ≤ 2. Orders of inputs are below α; other bodies may lean on
    /// accelerations.
    pub equations: Vec<Equation>,
    /// Which of them have friction, and F of − F(Dy) sgn(Dy).
    pub frictions: Vec<(usize, Law)>,
}

/// A free run.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Pulse means of each equation's output.
    pub outputs: Vec<Vec<f64>>,
    /// What each body that may stick did.
    pub bodies: Vec<Trace>,
}

impl Body {
    /// One equation by itself.
    #[must_use]
    pub fn alone(equation: Equation, friction: Law) -> Self {
        Self { equations: vec![equation], frictions: vec![(0, friction)] }
    }

    /// Refuses orders that this law does not know, and coefficients that are no numbers.
    ///
    /// # Errors
    /// [`Error::OutOfRange`], [`Error::Structure`], [`Error::Length`], [`Error::NotFinite`].
    pub fn check(&self, signals: usize) -> Result<()> {
        let refuse = |name: &str, value: f64, range: &str, remedy: &str| {
            Err(Error::OutOfRange { name: name.into(), value, range: range.into(), remedy: remedy.into() })
        };
        if self.frictions.is_empty() {
            return Err(Error::Length { name: "frictions".into(), expected: 1, found: 0 });
        }
        for (k, &(place, _)) in self.frictions.iter().enumerate() {
            if place >= self.equations.len() || self.frictions[..k].iter().any(|f| f.0 == place) {
                return Err(Error::Structure {
                    what: format!("friction in equation {place}"),
                    remedy: format!("there are {}, each with one friction", self.equations.len()),
                });
            }
        }
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
        for &(place, Law { coulomb, stribeck, speed }) in &self.frictions {
            check_finite("friction", &[coulomb, stribeck, speed])?;
            let alpha = self.equations[place].structure.order;
            if !(alpha > 1.0 && alpha <= 2.0) {
                return refuse("order of a body with friction", alpha, "(1, 2]", "a velocity needs inertia");
            }
            if let Some(force) = [coulomb, stribeck].into_iter().find(|f| *f < 0.0) {
                return refuse("friction", force, "[0, ∞)", "friction takes energy, it does not give any");
            }
            if speed <= 0.0 {
                return refuse(
                    "speed of Stribeck friction",
                    speed,
                    "(0, ∞)",
                    "it is the speed at which friction falls",
                );
            }
        }
        for (i, Equation { structure, .. }) in self.equations.iter().enumerate() {
            // An input must not jump in a velocity; other bodies, which it moves, may lean on each other's accelerations.
            let above = |order: f64| order >= structure.order - ORDER_GRAIN;
            if let Some(term) = structure.terms.iter().find(|t| above(t.order) && self.place(t.signal).is_none()) {
                let rubs = self.frictions.iter().any(|f| f.0 == i);
                let name = if rubs { "order beside friction" } else { "order of what drives a body" };
                return refuse(name, term.order, "below that of the body", "lower it");
            }
        }
        check_regular(&self.equations)?;
        self.check_yields()
    }

    /// Refuses accelerations that bodies hand each other by which a force on one would move it against the force, so that
    /// what friction does has no one answer. Orders above a body's own are left to the grid, which sees the same.
    fn check_yields(&self) -> Result<()> {
        let (n, sticks, links) = (self.equations.len(), self.sticks(), self.links());
        if links.iter().flatten().any(|link| link.integration < -ORDER_GRAIN) {
            return Ok(());
        }
        let mut matrix = vec![0.0; n * n];
        for (i, row) in links.iter().enumerate() {
            matrix[i * n + i] = 1.0;
            for link in row.iter().filter(|link| link.integration.abs() < ORDER_GRAIN) {
                matrix[i * n + link.output] -= link.coefficient;
            }
        }
        let inverse = small::inverse(&matrix, n)?;
        let moved: Vec<f64> =
            sticks.iter().flat_map(|&a| sticks.iter().map(move |&b| (a, b))).map(|(a, b)| inverse[a * n + b]).collect();
        if is_p_matrix(&moved, sticks.len()) {
            return Ok(());
        }
        Err(Error::Structure {
            what: "bodies with friction hand each other so much of their accelerations that a force on one moves it \
                   against the force"
                .into(),
            remedy: "make the coefficients of each other's accelerations smaller, as those of inertias are".into(),
        })
    }

    /// Equations with friction.
    pub(super) fn sticks(&self) -> Vec<usize> {
        self.frictions.iter().map(|f| f.0).collect()
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
    /// let velocity = &motion.bodies[0].edges;
    /// assert!((velocity[25] - 0.5).abs() < 1e-12 && velocity[50..].iter().all(|v| v.abs() < 1e-12));
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
        let forcing = Forcing::of(&powers, &self.links(), record.m(), record.step())?;
        let mut run = Run::new(self, &Operators::new(self, record)?, &forcing)?;
        add_impulses(&mut run.outputs, &impulses, record.step());
        Ok(Motion { outputs: run.outputs, bodies: run.march.bodies })
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
    /// Kernel of each term of a followed output, on means and at edges, and its slope.
    pub(super) own: Vec<Vec<Option<[Vec<f64>; 2]>>>,
    /// A of A y = b.
    matrix: Vec<Vec<Vec<f64>>>,
    /// Spectra of A⁻¹.
    inverse: Vec<Vec<Kernel>>,
    /// Inverse of A's leading coefficients.
    leading: Vec<f64>,
    /// Kernels of friction, of each body that may stick.
    pub(super) frictions: Vec<Driver>,
    /// What a pulse of force on each body (columns) does to the velocity of each (rows) at the ends of pulses.
    pub(super) responses: Vec<Vec<Heads>>,
    /// Their first numbers, row by row.
    gains: Vec<f64>,
    sticks: Vec<usize>,
}

impl Operators {
    pub(super) fn new(body: &Body, record: &Record) -> Result<Self> {
        let (m, step, n, sticks) = (record.m(), record.step(), body.equations.len(), body.sticks());
        let mut matrix = vec![vec![vec![0.0; m]; n]; n];
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
                    let (kernel, slope) = kernel_and_slope(eta, m, step);
                    matrix[i][j].iter_mut().zip(&kernel).for_each(|(a, v)| *a -= c * v);
                    row_own.push(Some([kernel, slope]));
                    row_drivers.push(None);
                    row_driven.push(None);
                } else {
                    let driver = Driver::new(eta, m, step);
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
        let frictions: Vec<Driver> =
            sticks.iter().map(|&b| Driver::new(body.equations[b].structure.order, m, step)).collect();
        let count = sticks.len();
        let mut gains = vec![0.0; count * count];
        let mut responses: Vec<Vec<Heads>> = (0..count).map(|_| Vec::with_capacity(count)).collect();
        for (b, friction) in frictions.iter().enumerate() {
            for (a, row) in responses.iter_mut().enumerate() {
                let response = product(&inverse[sticks[a]][sticks[b]], &friction.edges[0]);
                gains[a * count + b] = response.first().copied().unwrap_or(0.0);
                row.push(Heads::new(&response));
            }
        }
        Ok(Self { drivers, driven, own, matrix, inverse, leading, frictions, responses, gains, sticks })
    }

    /// A⁻¹ of right-hand sides, empty ones being zero.
    pub(super) fn through(&self, rhs: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let of = |row: &Vec<Kernel>| {
            let parts = row.iter().zip(rhs).filter(|(_, b)| !b.is_empty()).map(|(kernel, b)| product(kernel, b));
            parts.reduce(|a, b| a.iter().zip(&b).map(|(x, y)| x + y).collect()).unwrap_or_default()
        };
        self.inverse.iter().map(of).collect()
    }

    /// Velocities at the ends of pulses of the bodies that may stick, without their friction.
    pub(super) fn at_edges(&self, total: &Forcing) -> Vec<Vec<f64>> {
        let of = |&b: &usize| {
            let mut out = vec![total.start[b]; total.edges[b].len()];
            for (kernel, edges) in self.inverse[b].iter().zip(&total.edges) {
                out.iter_mut().zip(product(kernel, edges)).for_each(|(s, v)| *s += v);
            }
            out
        };
        self.sticks.iter().map(of).collect()
    }

    /// Derivative of the first number of a body's response to its own friction from those of its α (`turn`) and of each
    /// own term of each equation: (coefficient's, integration's).
    pub(super) fn first_slope(&self, body: &Body, which: usize, turn: f64, moves: &[Vec<(f64, f64)>]) -> f64 {
        let (n, b) = (self.matrix.len(), self.sticks[which]);
        let [first, first_slope] = [0, 1].map(|k| self.frictions[which].edges[k].first().copied().unwrap_or(0.0));
        let mut moved = 0.0;
        for (i, Equation { structure, coefficients }) in body.equations.iter().enumerate() {
            for (k, (own, &c)) in self.own[i].iter().zip(coefficients).enumerate() {
                let (Some([kernel, slope]), (dc, deta)) = (own, moves[i][k]) else { continue };
                let Some(j) = body.place(structure.terms[k].signal) else { continue };
                moved += self.leading[b * n + i] * (dc * kernel[0] + c * deta * slope[0]) * self.leading[j * n + b];
            }
        }
        moved * first + turn * self.leading[b * n + b] * first_slope
    }
}

/// A free run with all that its derivatives are made of.
pub(super) struct Run {
    pub(super) outputs: Vec<Vec<f64>>,
    /// Those of the bodies that may stick as the equations have them, without what [`at_rest`] takes away.
    pub(super) solved: Vec<Vec<f64>>,
    /// Velocities at the ends of pulses, less those at the start.
    pub(super) moved: Vec<Vec<f64>>,
    pub(super) march: March,
    /// Spectra of the frictions.
    pub(super) forces: Vec<Kernel>,
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
        let m = total.output.first().map_or(0, Vec::len);
        let linear = operators.at_edges(&total);
        if let Some(index) = linear.iter().find_map(|row| row.iter().position(|v| !v.is_finite())) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        let laws = body.frictions.iter().map(|f| f.1).collect();
        let rubbing = Rubbing::new(laws, operators.gains.clone())?;
        let start: Vec<f64> = operators.sticks.iter().map(|&b| total.start[b]).collect();
        let march = March::new(&linear, &operators.responses, rubbing, &start);
        if let Some(index) = march.bodies.iter().find_map(|x| x.edges.iter().position(|v| !v.is_finite())) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        // What friction holds back though nothing else would is a difference of two large numbers, which its own size
        // does not show: nothing is left of it but their rounding.
        let largest = |values: &[f64]| values.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let drives = total.edges.iter().chain([&total.start]).map(|row| largest(row)).fold(0.0, f64::max);
        for (a, row) in linear.iter().enumerate() {
            if largest(row) > LOST * (drives + march.rubbing().breakaway(a) * march.rubbing().own(a)) {
                return Err(Error::Diverged { what: "free run without its friction".into(), index: row.len() });
            }
        }
        let forces: Vec<Kernel> = march.bodies.iter().map(|x| Kernel::new(&x.force)).collect();
        for ((&b, friction), force) in operators.sticks.iter().zip(&operators.frictions).zip(&forces) {
            let held = friction.of(force, 0);
            total.output[b].iter_mut().zip(&held.output).for_each(|(b, v)| *b -= v);
            total.edges[b].iter_mut().zip(&held.edges).for_each(|(b, v)| *b -= v);
        }
        let alone = body.equations.len() == 1;
        let mut outputs = if alone && march.bodies.iter().all(Trace::is_still) {
            total.levels.iter().map(|&level| vec![level; m]).collect()
        } else {
            let rhs: Vec<&[f64]> = total.output.iter().map(Vec::as_slice).collect();
            series::solve(&operators.matrix, &rhs)?
        };
        let solved = operators.sticks.iter().map(|&b| outputs[b].clone()).collect();
        for (&b, moved) in operators.sticks.iter().zip(&march.bodies) {
            if moved.is_still() {
                // What never leaves its rest is where it was, not where rounding puts it.
                outputs[b] = vec![total.levels[b]; m];
            } else if !alone {
                at_rest(&mut outputs[b], moved);
            }
        }
        if let Some(index) = outputs.iter().find_map(|y| y.iter().position(|v| !v.is_finite())) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        let moved = operators.through(&total.edges);
        Ok(Self { outputs, solved, moved, march, forces })
    }
}

/// Takes from an output, or its slope, what it creeps while the body rests.
///
/// Its velocity is 0 at the edges of each pulse, but a force that another body exerts changes within it while friction's
/// mean stands, which moves the mean position by a share of the square of the step.
pub(super) fn at_rest(output: &mut [f64], body: &Trace) {
    let (mut crept, mut before) = (0.0, output.first().copied().unwrap_or(0.0));
    for (value, edges) in output.iter_mut().skip(1).zip(body.edges.windows(3)) {
        let now = *value;
        if edges.iter().all(|v| *v == 0.0) {
            crept += now - before;
        }
        before = now;
        *value = now - crept;
    }
}

/// How much larger than what drives a body its velocity without friction may become: of sixteen digits eight are left.
const LOST: f64 = 1e8;
