"""Physical parameters of the flexible arm from identified coefficients, with uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ftlm.errors import ModelError
from ftlm.estimation.objective import propagated_errors
from ftlm.estimation.output_error import JointFit
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import format_bound
from ftlm.utils.statistics import NORMAL_95
from ftlm.utils.validation import real_number

#: Physical parameters of stage j by name, and their units (of whole orders).
PHYSICAL_UNITS = {
    "K_s{j}": "N m/rad",
    "J_{j}1": "kg m^2",
    "J_{j}2": "kg m^2",
    "B_{j}1": "N m s/rad",
    "B_{j}2": "N m s/rad",
    "K_tau{j}": "N m/A",
}
#: Relative step of the numerical gradient: its error is far below any standard error's own.
GRADIENT_STEP = 1e-6


@dataclass(frozen=True)
class PhysicalParameter:
    """Physical parameter with its uncertainty.

    Parameters
    ----------
    value, standard_error
        In ``unit``; a known parameter has standard error 0.
    unit
        For whole orders; a fractional order adds a power of a second.
    """

    value: float
    standard_error: float
    unit: str

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval."""
        return self.value - NORMAL_95 * self.standard_error, self.value + NORMAL_95 * self.standard_error

    def __str__(self) -> str:
        return f"{self.value:.6g} ± {format_bound(self.standard_error)} {self.unit}"


@check_arguments
def physical_parameters(joint: JointFit, known: Mapping[str, float]) -> dict[str, PhysicalParameter]:
    """Compute the physical parameters of a link from its coefficients, given one parameter per stage.

    a = K_s/J_1, b = -B_1/J_1, d = B_2/J_1, g = K_tau/J_1 and r = (J_1 + J_2)/J_2 (paper (16)-(21)), or j = J_1/J_2, fix
    five ratios of six parameters. Standard errors follow from the joint covariance to first order; the known value is
    taken as exact.

    Parameters
    ----------
    joint
        Joint output-error fit of a :func:`flexible_link` with its coefficient law.
    known
        One parameter per stage by name: K_s1, J_11, J_12, B_11, B_12 or K_tau1 (2 for the second stage).

    Returns
    -------
    dict
        All parameters of every stage that a known one belongs to.

    Raises
    ------
    ModelError
        No or an unknown name, two of one stage, a value that is not positive, a fit without the coefficient law.
    """
    out: dict[str, PhysicalParameter] = {}
    names = {name.format(j=j): (j, unit) for j in (1, 2) for name, unit in PHYSICAL_UNITS.items()}
    if not known:
        raise ModelError(f"no physical parameter is given; one per stage must be known: {', '.join(names)}")
    stages = []
    for name, value in known.items():
        if name not in names:
            raise ModelError(f"{name!r} is not a physical parameter of the arm; use one of {', '.join(names)}")
        stage = names[name][0]
        if stage in stages:
            raise ModelError(f"two parameters of stage {stage} are given, but only one may be known; leave {name} out")
        stages.append(stage)
        amount = real_number(name, value)
        if not 0 < amount < math.inf:
            raise ModelError(f"{name} = {value!r} is not positive")
        h = 2 * stage - 1
        ratio = f"j{stage}" if f"j{stage}" in joint.coefficients else f"r{stage}"
        needed = [f"a{h}", f"b{h}", f"d{h}", f"g{h}", ratio]
        missing = [n for n in needed if n not in joint.coefficients]
        if missing:
            raise ModelError(
                f"coefficient {missing[0]} is not in the fit; identify flexible_link(stage={stage}) with "
                "laws=('orders', 'coefficients') and all terms free"
            )
        place = [joint.names.index(n) for n in needed]
        # J_1/J_2, or that and 1.
        centre = joint.values[place] + np.array([0.0, 0.0, 0.0, 0.0, float(ratio.startswith("j"))])
        spread = joint.covariance[np.ix_(place, place)]
        values = _physical(centre, name, amount, stage)
        slopes = []
        for i, c in enumerate(centre):
            step = GRADIENT_STEP * (abs(c) if c else 1.0)
            shift = step * np.eye(centre.size)[i]
            above, below = (_physical(centre + side, name, amount, stage) for side in (shift, -shift))
            slopes.append((above - below) / (2 * step))
        gradient = np.array(slopes).T
        errors = propagated_errors(gradient, spread)
        units = list(PHYSICAL_UNITS.items())
        for (pattern, unit), v, e in zip(units, values.tolist(), errors.tolist(), strict=True):
            out[pattern.format(j=stage)] = PhysicalParameter(v, e, unit)
    return out


def _physical(coefficients: NDArray[np.float64], name: str, value: float, stage: int) -> NDArray[np.float64]:
    """Return K_s, J_1, J_2, B_1, B_2 and K_tau from a, b, d, g, r and one of them."""
    a, b, d, g, r = coefficients
    # Every parameter in units of J_1.
    shares = np.array([a, 1.0, 1.0 / (r - 1.0), -b, d, g])
    known = [pattern.format(j=stage) for pattern in PHYSICAL_UNITS].index(name)
    out: NDArray[np.float64] = value / shares[known] * shares
    return out
