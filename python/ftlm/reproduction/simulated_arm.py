"""Flexible-link arms and runs that are simulated to reproduce the results of the paper."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from ftlm.arm.flexible_link import Form, link_model
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.rig.arm_parameters import PARAMETER_SETS, ArmParameters, StageParameters
from ftlm.rig.recording import record
from ftlm.utils.parameters import setting

StageNumber = Literal[1, 2]
STAGE_NUMBERS: tuple[StageNumber, StageNumber] = (1, 2)
#: Input shapes of the paper with their current amplitudes [A].
CURRENT_AMPLITUDES_A = {"square": 0.3, "sine": 0.6}
#: Arm of the demonstration: effective coefficients, fractional damping of the links, linear.
DEMO_PARAMETERS = ArmParameters.of("linear")
#: Default seed of the noise.
DEFAULT_SEED = 1


def _with_integer_orders(stage: StageParameters, *, friction: bool) -> StageParameters:
    """Return a stage with the manufacturer's integer orders, with or without Coulomb friction."""
    return replace(stage, gamma=1.0, beta=0.0, mu=1.0, coulomb=stage.coulomb if friction else 0.0)


def _integer_order_arm(*, friction: bool, coupling: float) -> ArmParameters:
    rubbing = PARAMETER_SETS["effective"]
    # Stage 1 of the manufacturer's file has no link damping.
    first = replace(_with_integer_orders(rubbing.stage1, friction=friction), d=0.0)
    return replace(
        DEMO_PARAMETERS,
        stage1=first,
        stage2=_with_integer_orders(rubbing.stage2, friction=friction),
        coupling=coupling,
        name="whole orders",
    )


#: Arms for verdicts: that of the demonstration, one with Coulomb friction and stage coupling, and both with the integer
#: orders of the manufacturer. All gauges are exact; every angle has the same noise.
ARM_VARIANTS: dict[str, ArmParameters] = {
    "fractional": DEMO_PARAMETERS,
    "fractional, friction": replace(
        DEMO_PARAMETERS,
        stage1=PARAMETER_SETS["effective"].stage1,
        stage2=PARAMETER_SETS["effective"].stage2,
        coupling=1.0,
    ),
    "whole orders": _integer_order_arm(friction=False, coupling=0.0),
    "whole orders, friction": _integer_order_arm(friction=True, coupling=1.0),
}
#: Key of the demonstration's arm.
MAIN_ARM = "fractional"
#: Guess of the paper's arm: integer orders, friction, uncoupled stages as in its equations.
PAPERS_ARM = _integer_order_arm(friction=True, coupling=0.0)


def letter_of(name: str) -> str:
    """Return a name without its index: alpha1 becomes alpha."""
    return name.rstrip("0123456789")


def demo_plant(stage: int, *, form: Form = "lagrange") -> Model:
    """Return the model of one joint of the demonstration's arm, with fractional orders and an order law.

    Parameters
    ----------
    stage
        1 or 2.
    form
        ``"lagrange"``: the arm as simulated by :func:`demo_run`. ``"published"``: the same parameters in the paper's
        printed equations (22)-(25), whose deflections have the wrong sign, see :func:`ftlm.flexible_link`.

    Returns
    -------
    Model
        Both angles from the current alone.
    """
    arm = parameters_of(stage)
    orders = {n: v for n, v in arm.orders(stage).items() if form == "published" or n != f"alpha{2 * stage}"}
    return link_model(
        stage=1 if stage == 1 else 2, form=form, orders=orders, coefficients=arm.coefficients(stage, form)
    )


def parameters_of(stage: int) -> StageParameters:
    """Parameters of one stage of the demonstration's arm."""
    return DEMO_PARAMETERS.stage1 if stage == 1 else DEMO_PARAMETERS.stage2


def truth_of(stage: int) -> dict[str, float]:
    """Orders and free coefficients of the simulated arm; the deflection's highest order is fixed at 2."""
    arm = parameters_of(stage)
    orders = {n: v for n, v in arm.orders(stage).items() if n != f"alpha{2 * stage}"}
    hub = {f"{c}{2 * stage - 1}": float(getattr(arm, c)) for c in "abdg"}
    return orders | hub | {f"j{stage}": arm.r - 1.0}


def demo_run(
    shape: str,
    *,
    duration: float = 10.0,
    step: float = 0.002,
    noise: float = 1e-4,
    seed: int = DEFAULT_SEED,
    parameters: ArmParameters = DEMO_PARAMETERS,
) -> Run:
    """Return a run of a simulated linear arm under the paper's inputs, with encoders and noise on every angle.

    The links move with their hubs, (14)-(15), as in a real arm, unlike the paper's equations (22)-(25).

    Parameters
    ----------
    shape
        ``"square"``: 0.3 A, period 2 s, duty 50 %. ``"sine"``: 0.6 A at 6.3 rad/s. Both currents are equal and have a
        zero-order hold.
    duration, step
        Length and sampling step [s].
    noise
        Standard deviation of the noise on every angle [rad].
    seed
        Seed of the noise.
    parameters
        Parameters of another arm.

    Returns
    -------
    Run
        I1, I2 [A]; theta11, theta12, theta21, theta22 [rad], point samples.

    Raises
    ------
    ModelError
        Another shape, or negative noise.
    """
    if not (np.isfinite(noise) and noise >= 0):
        raise ModelError(f"{setting('noise')} {noise} rad is not a standard deviation; give a number of at least 0")
    if shape not in CURRENT_AMPLITUDES_A:
        raise ModelError(f"shape = {shape!r} is not known; use 'square' or 'sine'")
    recorded = record(
        input=shape,
        amplitude=CURRENT_AMPLITUDES_A[shape],
        duration=duration,
        limit=duration,
        rate=1.0 / step,
        seed=seed,
        parameters=parameters,
    )
    rng = np.random.default_rng([seed, list(CURRENT_AMPLITUDES_A).index(shape)])
    angles = [f"theta{stage}{k}" for stage in (1, 2) for k in (1, 2)]
    return Run.from_arrays(
        step=step,
        inputs={name: recorded[name] for name in ("I1", "I2")},
        outputs={name: recorded[name] + noise * rng.standard_normal(recorded.length) for name in angles},
        units={"I1": "A", "I2": "A"} | dict.fromkeys(angles, "rad"),
        name=shape,
    )


def decimate_run(run: Run, every: int) -> Run:
    """Decimate a run; zero-order-hold inputs are averaged over each interval, which preserves their effect."""
    rows = run.length // every
    data = {}
    for name in run.signals:
        samples = run[name][: rows * every].reshape(rows, every)
        is_hold = name in run.inputs and run.intersample[name] == "zoh"
        data[name] = samples.mean(axis=1) if is_hold else samples[:, 0]
    return Run.from_arrays(
        step=run.step * every,
        inputs={n: data[n] for n in run.inputs},
        outputs={n: data[n] for n in run.outputs},
        units=dict(run.units),
        intersample=dict(run.intersample),
        name=run.name,
    )
