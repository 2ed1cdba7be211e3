"""Flexible-link arms and runs that are simulated to reproduce the results of the paper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from ftlm.arm.flexible_link import Form, link_model
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.model.model import Model
from ftlm.rig.arm_parameters import PARAMETER_SETS, ArmParameters, StageParameters
from ftlm.rig.recording import record
from ftlm.utils.parameters import Placeholder, parameter, setting
from ftlm.utils.validation import check_integer, join_names, nearest

StageNumber = Literal[1, 2]
STAGE_NUMBERS: tuple[StageNumber, StageNumber] = (1, 2)
#: Angles of the arm, in the order of the paper's indices n = 1 … 4.
ANGLE_NAMES = ("theta11", "theta12", "theta21", "theta22")
#: Amplitude [A] and period [s] of the paper's motor currents, by shape of the signal.
PAPER_CURRENTS: dict[str, dict[str, float]] = {
    "square": {"amplitude": 0.3, "period": 2.0},
    "sine": {"amplitude": 0.6, "period": 2 * math.pi / 6.3},
}
#: Parameters of the demonstration's arm: the manufacturer's effective coefficients, fractional damping, no friction.
DEMO_PARAMETERS = ArmParameters.load("linear")
#: Parameters of the manufacturer's arm, with fractional damping and friction.
EFFECTIVE_PARAMETERS = PARAMETER_SETS["effective"]
#: Maximum number of simulated records of one arm.
MAX_RECORDS = 1000
#: Default seed of the noise on the angles.
DEFAULT_SEED = 1


def _integer_order_arm(*, friction: bool, coupling: float) -> ArmParameters:
    """Return the arm with the manufacturer's integer orders, with or without its Coulomb friction."""
    stage1, stage2 = (
        replace(stage, gamma=1.0, beta=0.0, mu=1.0, coulomb=stage.coulomb if friction else 0.0)
        for stage in (EFFECTIVE_PARAMETERS.stage1, EFFECTIVE_PARAMETERS.stage2)
    )
    # In the manufacturer's parameters, link 1 has no damping.
    stage1 = replace(stage1, d=0.0)
    return replace(DEMO_PARAMETERS, stage1=stage1, stage2=stage2, coupling=coupling, name="integer orders")


#: Key of the demonstration's arm in `ARM_VARIANTS`.
MAIN_ARM = "fractional"
#: Simulated arms on which claims of the paper are tested: the arm of the demonstration, one with Coulomb friction and
#: coupled joints, and both with integer orders. Strain gauges are exact, and the noise is equal on all angles.
ARM_VARIANTS: dict[str, ArmParameters] = {
    MAIN_ARM: DEMO_PARAMETERS,
    "fractional, friction": replace(
        DEMO_PARAMETERS, stage1=EFFECTIVE_PARAMETERS.stage1, stage2=EFFECTIVE_PARAMETERS.stage2, coupling=1.0
    ),
    "integer orders": _integer_order_arm(friction=False, coupling=0.0),
    "integer orders, friction": _integer_order_arm(friction=True, coupling=1.0),
}
#: Assumed parameters of the paper's arm: integer orders, friction, and uncoupled joints as in its equations.
PAPERS_ARM = _integer_order_arm(friction=True, coupling=0.0)


def letter_of(name: str) -> str:
    """Return the name of an order or coefficient without its index, such as alpha for alpha1."""
    return name.rstrip("0123456789")


def signals_of(stage: StageNumber, *, current: bool = True) -> list[str]:
    """Return the names of the signals of one joint: its motor current, if `current`, and its two angles."""
    return [*[f"I{stage}"] * current, f"theta{stage}1", f"theta{stage}2"]


def stages_with(runs: Sequence[Run], *, current: bool) -> list[StageNumber]:
    """Return the numbers of the joints (stages) of which every run contains all signals; see :func:`signals_of`.

    Raises
    ------
    DataError
        If there is no such joint.
    """
    needed = {n: signals_of(n, current=current) for n in STAGE_NUMBERS}
    stages = [n for n, names in needed.items() if all(s in run.signals for run in runs for s in names)]
    if not stages:
        have = "; ".join(f"{run.name}: {', '.join(run.signals)}" for run in runs)
        wanted = ", or ".join(" and ".join(", ".join(names).rsplit(", ", 1)) for names in needed.values())
        inputs = f"{parameter('inputs', {'I1': Placeholder('COLUMN')})} " if current else ""
        raise DataError(
            f"no stage of the arm has all of its signals in every run ({have}); a stage of the arm needs {wanted}: "
            f"name its columns with {parameter('columns')}, or "
            f"{inputs}{parameter('outputs', {'theta11': Placeholder('COLUMN')})}"
        )
    return stages


def stages_of(square: Run, sine: Run | None) -> list[StageNumber]:
    """Return the numbers of the joints (stages) for which the square run contains all signals.

    Raises
    ------
    DataError
        If there is no such joint, or the sine run lacks a signal of one.
    """
    stages = stages_with([square], current=True)
    lacking = [s for n in stages for s in signals_of(n) if sine is not None and s not in sine.signals]
    if sine is not None and lacking:
        raise DataError(
            f"the sine run, {sine.name!r}, lacks {', '.join(lacking)}, which the square run, {square.name!r}, has; "
            "both runs need the same names"
        )
    return stages


def other_arms(arms: Sequence[str] | None, records: int) -> list[str]:
    """Return the names of the simulated arms other than the main one, by default all.

    Raise ModelError if a name is unknown or `records` is out of range.
    """
    if isinstance(arms, str):
        raise ModelError(f"{setting('arms')} {arms!r} is a text; give a list of names, such as [{arms!r}]")
    for name in arms or ():
        if name not in ARM_VARIANTS:
            raise ModelError(f"arm {name!r} is not known{nearest(name, ARM_VARIANTS)}; use {join_names(ARM_VARIANTS)}")
    check_integer("records", records, 1, MAX_RECORDS)
    return [name for name in (ARM_VARIANTS if arms is None else dict.fromkeys(arms)) if name != MAIN_ARM]


def demo_plant(stage: int, *, form: Form = "lagrange") -> Model:
    """Return the model of one joint of the demonstration's arm, with fractional orders and an order law.

    Parameters
    ----------
    stage
        Number of the joint, 1 or 2.
    form
        ``"lagrange"``: the arm as simulated by :func:`demo_run`. ``"published"``: the same parameters in the paper's
        printed equations (22)-(25), whose deflections have the wrong sign; see :func:`ftlm.flexible_link`.

    Returns
    -------
    Model
        Model from the motor current to both angles of the joint.
    """
    arm, number = parameters_of(stage), STAGE_NUMBERS[0 if stage == 1 else 1]
    orders = arm.orders(stage) if form == "published" else free_orders(stage)
    return link_model(stage=number, form=form, orders=orders, coefficients=arm.coefficients(stage, form))


def parameters_of(stage: int) -> StageParameters:
    """Return the parameters of joint 1 or 2 (stage) of the demonstration's arm."""
    return DEMO_PARAMETERS.stage1 if stage == 1 else DEMO_PARAMETERS.stage2


def free_orders(stage: int) -> dict[str, float]:
    """Return the orders of one joint of the demonstration's arm, without the fixed order of the deflection."""
    return {n: v for n, v in parameters_of(stage).orders(stage).items() if n != f"alpha{2 * stage}"}


def truth_of(stage: int) -> dict[str, float]:
    """Return the true free orders and coefficients of one joint of the demonstration's arm, by name.

    The highest order of the deflection is not among them, because it is fixed at 2.
    """
    arm = parameters_of(stage)
    hub = {f"{c}{2 * stage - 1}": float(getattr(arm, c)) for c in "abdg"}
    return free_orders(stage) | hub | {f"j{stage}": arm.r - 1.0}


def demo_run(
    shape: str,
    *,
    duration: float = 10.0,
    step: float = 0.002,
    noise: float = 1e-4,
    seed: int = DEFAULT_SEED,
    parameters: ArmParameters = DEMO_PARAMETERS,
) -> Run:
    """Return a run of a simulated arm under an input of the paper, with encoder quantization and noise on all angles.

    The arm is simulated by the Euler-Lagrange equations (14)-(15) of the paper, in which links move with their hubs as
    on a real arm. In equations (22)-(25) of the paper, links do not move with their hubs.

    Parameters
    ----------
    shape
        Signal of both motor currents. ``"square"``: 0.3 A, period 2 s, duty cycle 50 %. ``"sine"``: 0.6 A at
        6.3 rad/s. Currents have a zero-order hold.
    duration, step
        Duration and sampling interval [s].
    noise
        Standard deviation of the noise on every angle [rad].
    seed
        Seed of the noise.
    parameters
        Parameters of the simulated arm; by default those of the demonstration.

    Returns
    -------
    Run
        Run with inputs I1, I2 [A] and outputs theta11, theta12, theta21, theta22 [rad], sampled at points in time.

    Raises
    ------
    ModelError
        If the shape is unknown, or the noise is negative or not finite.
    """
    if not (np.isfinite(noise) and noise >= 0):
        raise ModelError(f"{setting('noise')} {noise} rad is not a standard deviation; give a number of at least 0")
    if shape not in PAPER_CURRENTS:
        raise ModelError(f"shape = {shape!r} is not known; use 'square' or 'sine'")
    timing: dict[str, Any] = {"duration": duration, "limit": duration, "rate": 1.0 / step, **PAPER_CURRENTS[shape]}
    recorded = record(input=shape, **timing, seed=seed, parameters=parameters)
    rng = np.random.default_rng([seed, list(PAPER_CURRENTS).index(shape)])
    return Run.from_arrays(
        step=step,
        inputs={name: recorded[name] for name in ("I1", "I2")},
        outputs={name: recorded[name] + noise * rng.standard_normal(recorded.length) for name in ANGLE_NAMES},
        units={"I1": "A", "I2": "A"} | dict.fromkeys(ANGLE_NAMES, "rad"),
        name=shape,
    )


def decimate_run(run: Run, every: int) -> Run:
    """Return a run with every `every`-th sample of each signal.

    Zero-order-hold inputs are averaged over each new sampling interval, which preserves their integral.
    """
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
        units=run.units,
        intersample=run.intersample,
        name=run.name,
    )
