"""The arm that the paper's runs are simulated on, and these runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from ftlm.arm.flexible_link import Form, link_model
from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.rig.arm_parameters import SETS, ArmParameters, StageParameters
from ftlm.rig.recording import record

StageNumber = Literal[1, 2]
STAGES: tuple[StageNumber, StageNumber] = (1, 2)
#: The paper's inputs and their amplitudes [A].
AMPLITUDES = {"square": 0.3, "sine": 0.6}
#: The demonstration's arm: effective coefficients, fractional damping in the links, nothing that is not linear.
PARAMETERS = ArmParameters.of("linear")
#: Its seed unless another is asked for.
SEED = 1


def _whole(stage: StageParameters, *, friction: bool) -> StageParameters:
    """The maker's integer orders; Coulomb friction as it is, or none."""
    return replace(stage, gamma=1.0, beta=0.0, mu=1.0, coulomb=stage.coulomb if friction else 0.0)


def _whole_arm(*, friction: bool, coupling: float) -> ArmParameters:
    rubbing = SETS["effective"]
    # Links of the maker's file have no damping in stage 1.
    first = replace(_whole(rubbing.stage1, friction=friction), d=0.0)
    return replace(
        PARAMETERS,
        stage1=first,
        stage2=_whole(rubbing.stage2, friction=friction),
        coupling=coupling,
        name="whole orders",
    )


#: Arms on which a verdict is computed: the demonstration's, with Coulomb friction in the hubs and stages that push each
#: other as well, and both with the maker's whole orders. Gauges are exact in all: noise is put on every angle alike.
ARMS: dict[str, ArmParameters] = {
    "fractional": PARAMETERS,
    "fractional, friction": replace(
        PARAMETERS, stage1=SETS["effective"].stage1, stage2=SETS["effective"].stage2, coupling=1.0
    ),
    "whole orders": _whole_arm(friction=False, coupling=0.0),
    "whole orders, friction": _whole_arm(friction=True, coupling=1.0),
}
#: The demonstration's arm among them.
MAIN = "fractional"
#: The paper's arm as one can guess it: whole orders, friction, each stage by itself as in its equations.
PAPERS_ARM = _whole_arm(friction=True, coupling=0.0)


def demo_plant(stage: int, *, form: Form = "lagrange") -> Model:
    """One stage of the demonstration's arm: effective coefficients, fractional orders, their law.

    Parameters
    ----------
    stage
        1 or 2.
    form
        ``"lagrange"``: the arm as it is, what :func:`demo_run` records. ``"published"``: the same numbers in the
        paper's own equations (22)-(25) as printed, whose links bend the wrong way, see :func:`ftlm.flexible_link`.

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
    """Of one stage of the demonstration's arm."""
    return PARAMETERS.stage1 if stage == 1 else PARAMETERS.stage2


def truth_of(stage: int) -> dict[str, float]:
    """Orders and free coefficients of the simulated arm; the deflection's highest order is fixed, at 2."""
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
    seed: int = SEED,
    parameters: ArmParameters = PARAMETERS,
) -> Run:
    """A run of the virtual rig under the paper's inputs: the linear arm, encoders and all, and noise on every angle.

    Its links hang on their hubs, (14)-(15), as those of a real arm do; the paper's own (22)-(25) are not this arm.

    Parameters
    ----------
    shape
        ``"square"``: 0.3 A, period 2 s, duty 50 %. ``"sine"``: 0.6 A at 6.3 rad/s. Both currents alike, held over
        a sample.
    duration, step
        Length and sampling step [s].
    noise
        Standard deviation of the noise on every angle [rad].
    seed
        Of the noise.
    parameters
        Of another arm.

    Returns
    -------
    Run
        I1, I2 [A]; theta11, theta12, theta21, theta22 [rad], point samples.

    Raises
    ------
    ModelError
        Another shape, or a noise that is negative.
    """
    if not (np.isfinite(noise) and noise >= 0):
        raise ModelError(f"noise = {noise} rad is not a non-negative number")
    if shape not in AMPLITUDES:
        raise ModelError(f"shape = {shape!r} is not known; use 'square' or 'sine'")
    recorded = record(
        input=shape,
        amplitude=AMPLITUDES[shape],
        duration=duration,
        limit=duration,
        rate=1.0 / step,
        seed=seed,
        parameters=parameters,
    )
    rng = np.random.default_rng([seed, list(AMPLITUDES).index(shape)])
    angles = [f"theta{stage}{k}" for stage in (1, 2) for k in (1, 2)]
    return Run.from_arrays(
        step=step,
        inputs={name: recorded[name] for name in ("I1", "I2")},
        outputs={name: recorded[name] + noise * rng.standard_normal(recorded.length) for name in angles},
        units={"I1": "A", "I2": "A"} | dict.fromkeys(angles, "rad"),
        name=shape,
    )


def thinned(run: Run, every: int) -> Run:
    """Every so manieth row of a run, held inputs by their means until the next one, which act alike."""
    rows = run.length // every
    data = {}
    for name in run.signals:
        samples = run[name][: rows * every].reshape(rows, every)
        held = name in run.inputs and run.intersample[name] == "zoh"
        data[name] = samples.mean(axis=1) if held else samples[:, 0]
    return Run.from_arrays(
        step=run.step * every,
        inputs={n: data[n] for n in run.inputs},
        outputs={n: data[n] for n in run.outputs},
        units=dict(run.units),
        intersample=dict(run.intersample),
        name=run.name,
    )
