//! Linear dynamics of bodies with friction: operators on pulse means, velocities at pulse edges, simulation.
//!
//! Outputs follow from the equations like any linear response, with friction as one more input. Velocities obey the
//! same equations with all inputs differentiated once, and so do their values at the pulse edges. There an input is the
//! sum of its pulses, which is exact for inputs that are constant within pulses. Velocities are linear between edges,
//! so their integrals have the kernels of pulse means ([`crate::fractional::kernels::block_pulse_kernel`]). Friction of
//! a pulse therefore acts within that pulse.

use super::contact::{is_p_matrix, ContactLaw, ContactSolution, Trace};
use super::convolution::{product, Heads, InputKernels, IntegratedSignal};
use super::initial_state::{InitialForcing, Link};
use super::law::FrictionLaw;
use crate::equation::{check_regular, Equation, Initial, ORDER_GRAIN};
use crate::error::{check_finite, check_length, Error, Result};
use crate::fractional::kernels::{kernel_and_slope, MAX_EXCESS};
use crate::linalg::small;
use crate::regressors::{add_impulses, split_impulses, Record};
use crate::series::{self, Kernel, Solver};

/// System of coupled equations, some of them with friction of their own output's velocity.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// D^α y = Σ c D^ν s, with 1 < α ≤ 2 for equations with friction. Orders of inputs are below α. Terms of other
    /// bodies may include accelerations.
    pub equations: Vec<Equation>,
    /// Equations with friction, and F of − F(Dy) sgn(Dy).
    pub frictions: Vec<(usize, FrictionLaw)>,
}

/// Motion found by simulation.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Pulse means of each equation's output.
    pub outputs: Vec<Vec<f64>>,
    /// Trajectory of each body with friction.
    pub bodies: Vec<Trace>,
}

impl Body {
    /// System of one equation.
    #[must_use]
    pub fn single(equation: Equation, friction: FrictionLaw) -> Self {
        Self { equations: vec![equation], frictions: vec![(0, friction)] }
    }

    /// Return an error for orders that this law does not support, and for coefficients that are not finite.
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
        for &(place, FrictionLaw { coulomb, stribeck, speed }) in &self.frictions {
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
            // An input must not jump in a velocity. Other bodies, which friction moves, may depend on each other's
            // accelerations.
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

    /// Return an error if coupled accelerations move a body against a force on it, so that friction has no unique
    /// solution.
    ///
    /// Terms above a body's own order are checked on the grid instead.
    fn check_yields(&self) -> Result<()> {
        let (n, sticks, links) = (self.equations.len(), self.friction_equations(), self.links());
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

    /// Indices of the equations with friction.
    pub(super) fn friction_equations(&self) -> Vec<usize> {
        self.frictions.iter().map(|f| f.0).collect()
    }

    /// Index of the equation with this signal as output.
    pub(super) fn place(&self, signal: usize) -> Option<usize> {
        self.equations.iter().position(|e| e.structure.output == signal)
    }

    /// Simulation with initial terms, (exponent, coefficient) pairs of powers of t by equation. O(n² m log² m).
    ///
    /// The exponents −1, −2, … are an impulse and its derivatives in the output alone, which do not move a body. After
    /// the filter of an output they become its initial transient.
    ///
    /// # Errors
    /// [`Error::Diverged`] if the simulation overflows, [`Error::LeadingZero`] if the equations are singular on this
    /// grid, and as [`Body::check`].
    ///
    /// ```
    /// # use ftlm::signal::block_pulse::PulseMeans;
    /// use ftlm::equation::{Equation, Structure, Term};
    /// use ftlm::friction::{Body, FrictionLaw};
    /// use ftlm::regressors::Record;
    /// # fn main() -> ftlm::error::Result<()> {
    /// // A block slides at 1 m/s with friction of 2 m/s²: it stops after half a second and 0.25 m.
    /// let structure = Structure { output: 0, order: 2.0, terms: vec![Term { signal: 1, order: 0.0 }] };
    /// let block = Body::single(Equation::new(structure, vec![1.0])?, FrictionLaw::coulomb(2.0));
    /// let run = Record::new(0.01, PulseMeans::from_signals(vec![vec![0.0; 100], vec![0.0; 100]]), None)?;
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
        let (powers, impulses) = split_impulses(initial);
        for terms in &powers {
            let (exponents, values): (Vec<f64>, Vec<f64>) = terms.iter().copied().unzip();
            check_finite("coefficients of the initial terms", &values)?;
            Initial::Powers(exponents).check()?;
        }
        let forcing = InitialForcing::of(&powers, &self.links(), record.m(), record.step())?;
        let mut run = Run::new(self, &Operators::new(self, record)?, &forcing)?;
        add_impulses(&mut run.outputs, &impulses, record.step());
        Ok(Motion { outputs: run.outputs, bodies: run.march.bodies })
    }

    /// Terms of each equation with a simulated output as signal.
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

/// Linear operators of bodies on a record.
pub(super) struct Operators {
    /// Kernels and spectrum of each term's input signal, by equation. None for a simulated output.
    pub(super) drivers: Vec<Vec<Option<(InputKernels, Kernel)>>>,
    /// Signal of each input term, integrated.
    pub(super) integrated_inputs: Vec<Vec<Option<IntegratedSignal>>>,
    /// Kernel of each term of a simulated output, on means and at edges, and its derivative in the order.
    pub(super) own: Vec<Vec<Option<[Vec<f64>; 2]>>>,
    /// A of A y = b.
    matrix: Vec<Vec<Vec<f64>>>,
    /// Spectra of A⁻¹.
    inverse: Vec<Vec<Kernel>>,
    /// Inverse of A's leading coefficients.
    leading: Vec<f64>,
    /// Kernels of friction, of each body that may stick.
    pub(super) frictions: Vec<InputKernels>,
    /// Responses of the velocities (rows) at pulse ends to a pulse of force on each body (columns).
    pub(super) responses: Vec<Vec<Heads>>,
    /// First values of these responses, row by row.
    gains: Vec<f64>,
    sticks: Vec<usize>,
}

impl Operators {
    pub(super) fn new(body: &Body, record: &Record) -> Result<Self> {
        let (m, step, n, sticks) = (record.m(), record.step(), body.equations.len(), body.friction_equations());
        let mut matrix = vec![vec![vec![0.0; m]; n]; n];
        let (mut drivers, mut driven, mut own) = (Vec::new(), Vec::new(), Vec::new());
        for (i, Equation { structure, coefficients }) in body.equations.iter().enumerate() {
            matrix[i][i][0] = 1.0;
            let (mut row_drivers, mut row_driven, mut row_own) = (Vec::new(), Vec::new(), Vec::new());
            for (term, &c) in structure.terms.iter().zip(coefficients) {
                let eta = structure.order - term.order;
                if eta <= -MAX_EXCESS {
                    // Same error as for a step that is too long, so that an optimizer shortens it.
                    return Err(Error::Diverged { what: "order of a term above alpha; the free run".into(), index: 0 });
                }
                if let Some(j) = body.place(term.signal) {
                    let (kernel, slope) = kernel_and_slope(eta, m, step);
                    matrix[i][j].iter_mut().zip(&kernel).for_each(|(a, v)| *a -= c * v);
                    row_own.push(Some([kernel, slope]));
                    row_drivers.push(None);
                    row_driven.push(None);
                } else {
                    let driver = InputKernels::new(eta, m, step);
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
        let frictions: Vec<InputKernels> =
            sticks.iter().map(|&b| InputKernels::new(body.equations[b].structure.order, m, step)).collect();
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
        Ok(Self {
            drivers,
            integrated_inputs: driven,
            own,
            matrix,
            inverse,
            leading,
            frictions,
            responses,
            gains,
            sticks,
        })
    }

    /// A⁻¹ of right-hand sides, empty ones being zero.
    pub(super) fn through(&self, rhs: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let of = |row: &Vec<Kernel>| {
            let parts = row.iter().zip(rhs).filter(|(_, b)| !b.is_empty()).map(|(kernel, b)| product(kernel, b));
            parts.reduce(|a, b| a.iter().zip(&b).map(|(x, y)| x + y).collect()).unwrap_or_default()
        };
        self.inverse.iter().map(of).collect()
    }

    /// Velocities of the bodies with friction at pulse ends, without their friction.
    pub(super) fn at_edges(&self, total: &InitialForcing) -> Vec<Vec<f64>> {
        let of = |&b: &usize| {
            let mut out = vec![total.start[b]; total.edges[b].len()];
            for (kernel, edges) in self.inverse[b].iter().zip(&total.edges) {
                out.iter_mut().zip(product(kernel, edges)).for_each(|(s, v)| *s += v);
            }
            out
        };
        self.sticks.iter().map(of).collect()
    }

    /// Derivative of the first value of a body's response to its own friction.
    ///
    /// `turn` is the derivative of its α, `moves` those of (coefficient, integration order) of each term of each
    /// equation.
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

/// Simulation with the intermediate results that its derivatives need.
pub(super) struct Run {
    pub(super) outputs: Vec<Vec<f64>>,
    /// Outputs of the bodies with friction as solved, before [`remove_creep`].
    pub(super) solved: Vec<Vec<f64>>,
    /// Velocities at pulse ends minus initial velocities.
    pub(super) moved: Vec<Vec<f64>>,
    pub(super) march: ContactSolution,
    /// Spectra of the frictions.
    pub(super) forces: Vec<Kernel>,
}

impl Run {
    pub(super) fn new(body: &Body, operators: &Operators, forcing: &InitialForcing) -> Result<Self> {
        let mut total = forcing.clone();
        for (i, (row, equation)) in operators.integrated_inputs.iter().zip(&body.equations).enumerate() {
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
        let rubbing = ContactLaw::new(laws, operators.gains.clone())?;
        let start: Vec<f64> = operators.sticks.iter().map(|&b| total.start[b]).collect();
        let march = ContactSolution::new(&linear, &operators.responses, rubbing, &start);
        if let Some(index) = march.bodies.iter().find_map(|x| x.edges.iter().position(|v| !v.is_finite())) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        // If the velocity without friction is huge, the difference of motion and friction is lost to rounding, although
        // the result itself has a normal size.
        let largest = |values: &[f64]| values.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let drives = total.edges.iter().chain([&total.start]).map(|row| largest(row)).fold(0.0, f64::max);
        for (a, row) in linear.iter().enumerate() {
            if largest(row)
                > MAX_CANCELLATION_RATIO * (drives + march.contact_law().breakaway(a) * march.contact_law().own(a))
            {
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
        let mut outputs = if alone && march.bodies.iter().all(Trace::is_always_at_rest) {
            total.levels.iter().map(|&level| vec![level; m]).collect()
        } else {
            let rhs: Vec<&[f64]> = total.output.iter().map(Vec::as_slice).collect();
            series::solve(&operators.matrix, &rhs)?
        };
        let solved = operators.sticks.iter().map(|&b| outputs[b].clone()).collect();
        for (&b, moved) in operators.sticks.iter().zip(&march.bodies) {
            if moved.is_always_at_rest() {
                // A body that never moves stays exactly at its initial position, without rounding errors.
                outputs[b] = vec![total.levels[b]; m];
            } else if !alone {
                remove_creep(&mut outputs[b], moved);
            }
        }
        if let Some(index) = outputs.iter().find_map(|y| y.iter().position(|v| !v.is_finite())) {
            return Err(Error::Diverged { what: "free run".into(), index });
        }
        let moved = operators.through(&total.edges);
        Ok(Self { outputs, solved, moved, march, forces })
    }
}

/// Remove the creep of a resting body from its output or from a derivative of it.
///
/// Its velocity is 0 at the edges of each pulse. Within a pulse the force of another body changes while the mean of
/// friction is constant, which moves the mean position in proportion to the square of the step.
pub(super) fn remove_creep(output: &mut [f64], body: &Trace) {
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

/// Largest ratio of the velocity without friction to the inputs. Beyond, fewer than eight of sixteen digits remain.
const MAX_CANCELLATION_RATIO: f64 = 1e8;
