"""The arm that the paper's runs are simulated on, and these runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from ftlm.arm.link import link_model
from ftlm.base.errors import ModelError
from ftlm.data.run import Run
from ftlm.model.model import Model
from ftlm.rig.experiment import record
from ftlm.rig.parameters import ArmParameters

StageNumber = Literal[1, 2]
STAGES: tuple[StageNumber, StageNumber] = (1, 2)
#: The paper's inputs and their amplitudes [A].
AMPLITUDES = {"square": 0.3, "sine": 0.6}
#: The demonstration's arm: the effective coefficients, with fractional damping and friction in the link.
PLANTS: dict[int, tuple[dict[str, float], dict[str, float]]] = {
    1: (
        {"alpha1": 2.0, "alpha2": 2.0, "gamma1": 0.95, "beta2": 0.1, "mu2": 0.85},
        {"a1": 628.89, "b1": -62.956, "d1": 6.63, "g1": 140.47, "r": (0.0635 + 0.1704) / 0.1704},
    ),
    2: (
        {"alpha3": 2.0, "alpha4": 2.0, "gamma3": 0.9, "beta4": 0.2, "mu4": 0.8},
        {"a3": 2271.117, "b3": -496.763, "d3": 28.351, "g3": 288.122, "r": (0.00301955 + 0.0064387) / 0.0064387},
    ),
}  # fmt: skip


def demo_plant(stage: int) -> Model:
    """The arm of the paper's own equations (22)-(25) as printed: effective coefficients, fractional orders, their law.

    Its links bend the wrong way, see :func:`ftlm.flexible_link`: it is what the paper's tables are set beside.
    """
    orders, free = PLANTS[stage]
    h, d, r = 2 * stage - 1, 2 * stage, free["r"]
    law = {f"a{d}": -free[f"a{h}"] * r, f"b{d}": -free[f"b{h}"], f"d{d}": -free[f"d{h}"] * r, f"g{d}": -free[f"g{h}"]}
    coefficients = {name: value for name, value in free.items() if name != "r"} | law
    return link_model(stage=1 if stage == 1 else 2, form="published", orders=orders, coefficients=coefficients)


def truth_of(stage: int) -> dict[str, float]:
    """Orders and free coefficients of the simulated arm."""
    orders, free = PLANTS[stage]
    return orders | {(f"r{stage}" if name == "r" else name): value for name, value in free.items()}


def demo_run(shape: str, *, duration: float = 10.0, step: float = 0.002, noise: float = 1e-4, seed: int = 1) -> Run:
    """A run of the virtual rig under the paper's inputs: the linear arm, encoders and all, and noise on every angle.

    The arm obeys the published equations (22)-(25), as the paper's identification assumes.

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
        input=shape, amplitude=AMPLITUDES[shape], duration=duration, limit=duration, rate=1.0 / step, seed=seed,
        parameters=replace(ArmParameters.of("linear"), form="published"),
    )  # fmt: skip
    rng = np.random.default_rng([seed, list(AMPLITUDES).index(shape)])
    angles = [f"theta{stage}{k}" for stage in (1, 2) for k in (1, 2)]
    return Run.from_arrays(
        step=step,
        inputs={name: recorded[name] for name in ("I1", "I2")},
        outputs={name: recorded[name] + noise * rng.standard_normal(recorded.length) for name in angles},
        units={"I1": "A", "I2": "A"} | dict.fromkeys(angles, "rad"),
        name=shape,
    )
