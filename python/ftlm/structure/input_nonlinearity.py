"""What an actuator does to an input before it drives an equation: a saturation, a dead zone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ftlm.errors import ModelError
from ftlm.utils.validation import Floats, real_number

#: How an input acts: later, no further than a limit, by what exceeds a threshold.
InputLaw = Literal["delay", "saturation", "dead_zone"]
#: Those of them that know no time.
LimitLaw = Literal["saturation", "dead_zone"]
#: A number that is known, or (least, largest) of one that is estimated.
Value = float | tuple[float, float]
#: The laws in words.
WORDS: dict[InputLaw, str] = {"delay": "delay", "saturation": "saturation", "dead_zone": "dead zone"}
#: What equations in words and names of parameters call them.
SHORT: dict[InputLaw, str] = {"delay": "delay", "saturation": "sat", "dead_zone": "dead"}


def input_name(law: InputLaw, signal: str) -> str:
    """Name under which a number of an input stands among the parameters, such as ``delay_u`` and ``sat_u``."""
    return f"{SHORT[law]}_{signal}"


@dataclass(frozen=True)
class FreeInput:
    """A number of an input that is estimated.

    Parameters
    ----------
    signal
        The input.
    law
        How it acts.
    bounds
        Least and largest value, [s] of a delay, else in the input's unit.
    """

    signal: str
    law: InputLaw
    bounds: tuple[float, float]

    @property
    def name(self) -> str:
        """Name of the estimate; see :func:`input_name`."""
        return input_name(self.law, self.signal)

    @property
    def words(self) -> str:
        """What it is, such as ``delay of u``."""
        return f"{WORDS[self.law]} of {self.signal}"


@dataclass(frozen=True)
class Limit:
    """A saturation or a dead zone of an input, alike on both sides of 0.

    A saturation passes ``u`` no further than its value: min(|u|, value) sign(u); a dead zone what exceeds it:
    max(|u| - value, 0) sign(u). An input with both passes the dead zone first, and any delay last.

    Parameters
    ----------
    signal
        The input.
    law
        Which of the two.
    value
        The limit in the input's unit, above 0 of a saturation, not negative of a dead zone; (least, largest) where it
        is to be estimated.

    Raises
    ------
    ModelError
        A value that is no such number or interval.
    """

    signal: str
    law: LimitLaw
    value: Value

    def __post_init__(self) -> None:
        words, least = f"{WORDS[self.law]} of {self.signal}", "above" if self.law == "saturation" else "from"
        if isinstance(self.value, (tuple, list)):
            if len(self.value) != 2:
                raise ModelError(f"{words} = {self.value!r} is neither a number nor (least, largest)")
            low, high = (real_number(f"{words}", v) for v in self.value)
            if not 0 <= low < high < math.inf:
                raise ModelError(f"{words} from {low} to {high} is no interval; give two rising values from 0")
            return
        value = real_number(words, self.value)
        if not (0 <= value < math.inf and (value > 0 or self.law == "dead_zone")):
            raise ModelError(f"{words} = {self.value} is no number {least} 0, in the unit of {self.signal}")

    @property
    def free(self) -> FreeInput | None:
        """What is to be estimated; None where the value is known."""
        return FreeInput(self.signal, self.law, self.value) if isinstance(self.value, tuple) else None

    @property
    def name(self) -> str:
        """Name of its value; see :func:`input_name`."""
        return input_name(self.law, self.signal)

    def of(self, values: Floats) -> Floats:
        """What acts of an input's values.

        Raises
        ------
        ModelError
            A value that is still to be estimated.
        """
        if isinstance(self.value, tuple):
            raise ModelError(f"the {WORDS[self.law]} of {self.signal} is still free; give its value")
        clipped = np.clip(values, -self.value, self.value)
        return np.asarray(clipped if self.law == "saturation" else values - clipped)

    def written(self, inner: str, digits: str = "r") -> str:
        """Write it around what stands for its input."""
        ends = self.value if isinstance(self.value, tuple) else (self.value,)
        texts = [repr(float(v)) if digits == "r" else format(v, digits) for v in ends]
        return f"{SHORT[self.law]}({inner}, {':'.join(texts)})"


def in_order(limits: Sequence[Limit]) -> list[Limit]:
    """Limits as inputs pass them: dead zones first."""
    return sorted(limits, key=lambda limit: limit.law == "saturation")


def with_values(limits: Sequence[Limit], law: LimitLaw, values: Mapping[str, Value]) -> tuple[Limit, ...]:
    """Limits with those of one law set anew by input."""
    kept = [limit for limit in limits if limit.law != law or limit.signal not in values]
    new = [Limit(s, law, (v[0], v[1]) if isinstance(v, list) and len(v) == 2 else v) for s, v in values.items()]
    return tuple(in_order([*kept, *new]))


def check_limits(limits: Sequence[Limit], delays: Mapping[str, object], late: Mapping[str, object]) -> None:
    """Refuse limits that stand twice, and what is not estimated together: one number of an input is free at most.

    ``delays`` are known, ``late`` free.
    """
    for k, limit in enumerate(limits):
        if any((o.signal, o.law) == (limit.signal, limit.law) for o in limits[:k]):
            raise ModelError(f"the {WORDS[limit.law]} of {limit.signal} stands there twice; give it once")
        if limit.free is None:
            continue
        name, words = limit.signal, f"the {WORDS[limit.law]} of {limit.signal} is free"
        other = next((o for o in limits if o.signal == name and o is not limit), None)
        if name in late or (other is not None and other.free is not None):
            second = "delay" if other is None or other.free is None else WORDS[other.law]
            raise ModelError(f"{words}, and so is its {second}; one number of an input is estimated: give the other")
        if delays.get(name):
            raise ModelError(f"{words}, and {name} has a delay; shift the input by it, or give the limit")
        if other is not None and limit.law == "dead_zone":
            raise ModelError(f"{words}, and {name} saturates behind it; free the saturation instead, or give both")
