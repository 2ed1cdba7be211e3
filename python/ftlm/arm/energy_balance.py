"""Energies, generalized forces and power balance of one joint of the arm, by equations (7)-(15) of the paper."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ftlm import _core
from ftlm.arm.flexible_link import PARAMETER_SETS, LinkParameters, integer_order, order_law
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.fractional_calculus import fractional_derivative
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import plural
from ftlm.utils.validation import Floats

#: Range of the relaxation rates [1/s] whose sum approximates a force of fractional order: from the first factor divided
#: by the duration to the second factor divided by the sampling interval. Slower relaxations equal a spring, and faster
#: ones a dashpot.
MIN_RATE_TIMES_DURATION, MAX_RATE_TIMES_STEP = 1e-3, 1e3
#: Difference in ln(rate) of neighboring relaxations, with which the sum equals the integral over all rates to 1e-6.
RATE_LOG_SPACING = 0.5
#: Limits within which an angle starts at rest at 0: its first value relative to its largest one, its first increment
#: relative to its largest one, and in short runs its first increment relative to the second one. A motion t^alpha from
#: rest has a ratio of first to second increment of 1/3 for alpha = 2, and of 0.55 for alpha = 1.5.
REST_ANGLE_FRACTION, REST_INCREMENT_FRACTION, REST_INCREMENT_RATIO = 0.01, 0.1, 2 / 3
#: Minimum number of samples of a run, which third-order differences require.
MIN_SAMPLES = 4


@dataclass(frozen=True)
class Power:
    """Power that a motion theta(t) supplies against a force c D^nu theta, and its stored and dissipated parts.

    D^nu is the fractional derivative of order nu. Every field has one value per sample, shape (N,).

    Parameters
    ----------
    supplied
        Supplied power [W]: c D^nu theta times the rate of theta.
    stored
        Stored (recoverable) energy [J]: all supplied energy for a spring (nu = 0), 0 for a dashpot (nu = 1).
    dissipated
        Dissipated power [W], never negative.
    """

    supplied: Floats
    stored: Floats
    dissipated: Floats


@dataclass(frozen=True)
class Energies:
    """Energies, generalized forces and powers of one joint of the arm at the samples of a run.

    Equation numbers are those of the paper. Index 1 is the hub and index 2 the link. K_s is the stiffness, B_1 and B_2
    are friction coefficients, and gamma_1, beta_2 and mu_2 are orders. Arrays have shape (N,).

    Parameters
    ----------
    time
        Sample times [s].
    potential
        Viscoelastic potential energy of the link by equation (7). Its unit is J only for beta_2 = 0.
    hub_kinetic, link_kinetic
        Kinetic energies of hub and link by equation (8). Their unit is J only for gamma_1 = mu_2 = 1.
    hub_force, link_force
        Nonconservative generalized forces by equations (10) and (11) [N m].
    motor
        Power of the motor torque on the hub [W].
    inertia
        Power of the inertial terms of equations (14) and (15) [W]. For integer orders it is the time derivative of the
        kinetic energy by equation (9).
    elastic, hub_friction, link_friction
        Powers of the elasticity of the link (K_s, order beta_2), the friction of the hub (B_1, order gamma_1) and the
        friction of the link (B_2, order mu_2).
    """

    time: Floats
    potential: Floats
    hub_kinetic: Floats
    link_kinetic: Floats
    hub_force: Floats
    link_force: Floats
    motor: Floats
    inertia: Floats
    elastic: Power
    hub_friction: Power
    link_friction: Power

    @property
    def kinetic(self) -> Floats:
        """Total kinetic energy of hub and link, equation (9) of the paper."""
        return self.hub_kinetic + self.link_kinetic

    @property
    def lagrangian(self) -> Floats:
        """Lagrangian, equations (12)-(13) of the paper: kinetic energy minus potential energy."""
        return self.kinetic - self.potential


@check_arguments
def energies(
    run: Run, *, stage: int = 1, parameters: LinkParameters | None = None, orders: Mapping[str, float] | None = None
) -> Energies:
    """Return energies, generalized forces and power balance of one joint of the arm during a run.

    Energies and forces are those of equations (7)-(11) of the paper. Its equations (14) and (15), multiplied by the
    rates of their angles, divide the power of the motor into inertia, elasticity of the link, and both frictions. A
    force of fractional order stores a part of the supplied power and dissipates the rest. Its diffusive representation
    is a sum of springs in series with dampers, whose energies are added.

    Parameters
    ----------
    run
        Run from rest with I1 [A], theta11, theta12 [rad], or I2, theta21, theta22, and at least 4 samples. The angles
        are differentiated, so use a simulated run without noise (:func:`ftlm.simulate`).
    stage
        Number of the joint, 1 or 2.
    parameters
        Parameters of the joint; by default the manufacturer's effective ones.
    orders
        Orders by name: alpha and gamma of the hub (such as alpha1, gamma1), and alpha, beta and mu of the link (such as
        alpha2). Orders that are not given have the integer values of the manufacturer's manual.

    Returns
    -------
    Energies
        Energies and powers at the samples of the run.

    Raises
    ------
    ModelError
        If the stage or the name of an order is unknown, or the order of a force is outside [0, 1].
    DataError
        If the run lacks one of the three signals or has fewer than 4 samples, or if an angle does not start at rest at
        0.
    """
    law = order_law(stage)
    h, d = 2 * stage - 1, 2 * stage
    names = [f"alpha{h}", f"alpha{d}", f"gamma{h}", f"beta{d}", f"mu{d}"]
    for name in orders or {}:
        if name not in names:
            raise ModelError(f"order {name!r} is not known; the stage's free orders are {', '.join(names)}")
    values = {n: float((orders or {}).get(n, integer_order(n))) for n in names}
    for name in names[2:]:
        if not 0.0 <= values[name] <= 1.0:
            raise ModelError(f"{name} = {values[name]:g} is outside [0, 1]; give an order of a passive force")
    link = parameters or PARAMETER_SETS["effective"][stage]
    hub, deflection, current = (
        np.asarray(run[n], dtype=np.float64) for n in (f"theta{stage}1", f"theta{stage}2", f"I{stage}")
    )
    step = run.step
    if run.length < MIN_SAMPLES:
        raise DataError(f"run {run.name!r} has {plural(run.length, 'row')}; energies need at least {MIN_SAMPLES}")
    for name, angle in ((f"theta{stage}1", hub), (f"theta{stage}2", deflection)):
        _check_rest(run.name, name, angle)

    def rate(x: Floats, order: float) -> Floats:
        return fractional_derivative(x, order, step=step, definition="caputo", initial=[0.0, 0.0, 0.0])

    hub_rate, deflection_rate = rate(hub, 1.0), rate(deflection, 1.0)
    hub_derivative, deflection_derivative = rate(hub, values[f"gamma{h}"]), rate(deflection, values[f"mu{d}"])
    elastic = rate(deflection, values[f"beta{d}"])
    j1, j2 = link.hub_inertia, link.link_inertia
    # Inertial terms of equations (14) and (15), with orders by the order law.
    cross_order = values[f"alpha{h}"] - values[f"gamma{h}"] + values[f"mu{d}"]
    inertia = hub_rate * ((j1 + j2) * rate(hub, values[f"alpha{h}"]) + j2 * rate(deflection, cross_order))
    inertia += deflection_rate * j2 * (rate(hub, law[f"gamma{d}"].at(values)) + rate(deflection, values[f"alpha{d}"]))
    torque = link.torque_constant * current
    time: Floats = np.arange(run.length, dtype=np.float64) * step
    return Energies(
        time,
        0.5 * link.stiffness * elastic**2,
        0.5 * j1 * hub_derivative**2,
        0.5 * j2 * (hub_derivative + deflection_derivative) ** 2,
        torque - link.hub_friction * hub_derivative,
        -link.link_friction * deflection_derivative,
        torque * hub_rate,
        inertia,
        power(deflection, link.stiffness, values[f"beta{d}"], step),
        power(hub, link.hub_friction, values[f"gamma{h}"], step),
        power(deflection, link.link_friction, values[f"mu{d}"], step),
    )


def _check_rest(run: str, name: str, angle: Floats) -> None:
    """Raise DataError unless an angle [rad] starts at rest at 0; `run` and `name` identify it in the message.

    A motion before the first sample would act as an impulse at the first sample.
    """
    steps = np.diff(angle)
    remedy = "energies need runs that start at rest with angle 0; cut the run where it rests, and subtract that angle"
    if abs(angle[0]) > REST_ANGLE_FRACTION * np.max(np.abs(angle)):
        raise DataError(f"run {run!r}: {name} starts at {angle[0]:.4g} rad, not at 0; {remedy}")
    if abs(steps[0]) > max(REST_INCREMENT_FRACTION * np.max(np.abs(steps)), REST_INCREMENT_RATIO * abs(steps[1])):
        raise DataError(f"run {run!r}: {name} moves by {steps[0]:.4g} rad in its first step; {remedy}")


def power(angle: Floats, coefficient: float, order: float, step: float) -> Power:
    """Return the power that a motion theta(t) from rest supplies against a force c D^nu theta, and its parts.

    The fractional derivative D^nu theta is sin(pi nu)/pi times the integral of w^(nu-1) z_w over w from 0 to infinity,
    where z_w' = -w z_w + theta'. Every z_w is the deflection of a spring in series with a dashpot. It stores the energy
    z_w^2/2 and dissipates the power w z_w^2.

    Parameters
    ----------
    angle
        Angle theta [rad], shape (N,), N at least 2; it starts at rest at 0.
    coefficient
        Coefficient c [N m s^nu/rad].
    order
        Order nu, from 0 (a spring) to 1 (a dashpot).
    step
        Sampling interval [s].

    Returns
    -------
    Power
        Supplied power, stored energy and dissipated power at the N samples.
    """
    increments = np.concatenate([[0.0], np.diff(angle)])
    rate = np.gradient(angle, step)
    zeros = np.zeros(angle.size)
    if order == 0.0:
        return Power(coefficient * angle * rate, 0.5 * coefficient * angle**2, zeros)
    if order == 1.0:
        return Power(coefficient * rate**2, zeros, coefficient * rate**2)
    duration = step * (angle.size - 1)
    low, high = math.log(MIN_RATE_TIMES_DURATION / duration), math.log(MAX_RATE_TIMES_STEP / step)
    count = max(2, round((high - low) / RATE_LOG_SPACING))
    scale = math.sin(math.pi * order) / math.pi
    # Each rate is at the middle of its interval in ln(w), so the intervals cover exactly the range from low to high.
    width = (high - low) / count
    rates = np.exp(low + width * (np.arange(count) + 0.5))
    spring, dashpot = scale * math.exp(low * order) / order, scale * math.exp(high * (order - 1.0)) / (1.0 - order)
    force = spring * angle + dashpot * rate
    stored, dissipated = 0.5 * spring * angle**2, dashpot * rate**2
    k = np.arange(angle.size)
    for w, weight in zip(rates.tolist(), (scale * width * rates**order).tolist(), strict=True):
        # z is exact for an angle that is linear between samples.
        decay = np.exp(-w * step * k) * (-math.expm1(-w * step) / (w * step))
        z = _core.series_multiply(decay, increments, angle.size)
        force += weight * z
        stored += 0.5 * weight * z**2
        dissipated += weight * w * z**2
    return Power(coefficient * force * rate, coefficient * stored, coefficient * dissipated)
