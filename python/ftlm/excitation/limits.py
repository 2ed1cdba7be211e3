"""What an experiment may do to a machine: how far its inputs and outputs may go, and how fast an input may change."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.checks import nearest, real_number, shown
from ftlm.base.errors import ModelError

#: Sizes that a limit may have, or infinity: of others squares of their quotients are none.
SIZES = (1e-50, 1e50)


@dataclass(frozen=True)
class Bounds:
    """Limits of a run, in the units of its signals.

    Parameters
    ----------
    peaks
        Largest size of each input.
    slews
        Fastest change of each input, a second; infinite where there is none.
    swings
        Largest size of each output; infinite where there is none.
    """

    peaks: Mapping[str, float]
    slews: Mapping[str, float]
    swings: Mapping[str, float]

    def ramp(self, step: float) -> int:
        """Samples over which a change from one peak to the other has to be spread."""
        return max(1, *(math.ceil(min(2 * p / self.slews[n] / step, 1e18) - 1e-9) for n, p in self.peaks.items()))

    def scale(self, commands: Floats, moved: Floats) -> float:
        """Factor, at most 1, by which commands within their peaks keep all outputs within theirs; rows by name."""
        return min(
            1.0,
            *(
                limit / float(np.max(np.abs(row), initial=0.0)) if np.any(row) else 1.0
                for limit, row in zip(self.swings.values(), moved, strict=True)
            ),
            *(
                limit / float(np.max(np.abs(row), initial=0.0)) if np.any(row) else 1.0
                for limit, row in zip(self.peaks.values(), commands, strict=True)
            ),
        )


def by_name(what: str, given: object, names: Sequence[str], default: Mapping[str, float] | None) -> dict[str, float]:
    """One positive number for all names, or some by name; what is not said is as the default says.

    Raises
    ------
    ModelError
        A name that is none of them, a value that is no positive number, or one that is not said without a default.
    """
    if isinstance(given, Mapping):
        for name in given:
            if name not in names:
                near = nearest(name, names) if isinstance(name, str) else ""
                raise ModelError(
                    f"{what} names {shown(name)}{near}, which is none of {', '.join(names) or 'nothing'}; "
                    "name one of them"
                )
    elif given is not None:
        given = dict.fromkeys(names, given)
    out = {}
    for name in names:
        said = None if given is None else given.get(name)
        if said is None:
            if default is None or name not in default:
                raise ModelError(
                    f"{what} of {name} is not given; give {what}= a number, or one by name, or like= a run"
                )
            out[name] = default[name]
            continue
        value = real_number(f"{what} of {name}", said)
        if not value > 0:
            raise ModelError(f"{what} of {name} = {value:g} is not above 0; give the largest size it may have")
        if not SIZES[0] <= value <= SIZES[1] and not math.isinf(value):
            raise ModelError(
                f"{what} of {name} = {value:g} is no size from {SIZES[0]:g} to {SIZES[1]:g}; use other units"
            )
        out[name] = value
    return out
