"""Saturation, dead zone and delay of inputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ftlm.errors import ModelError
from ftlm.utils.formatting import plural
from ftlm.utils.validation import Floats, real_number

#: Effects on an input: delay, saturation, dead zone.
InputEffect = Literal["delay", "saturation", "dead_zone"]
#: Static non-linearities of an input.
NonlinearityKind = Literal["saturation", "dead_zone"]
#: Value of a fixed parameter, or (lower, upper) bounds of an estimated one.
Value = float | tuple[float, float]
#: Names of the effects in messages.
INPUT_EFFECT_LABELS: dict[InputEffect, str] = {"delay": "delay", "saturation": "saturation", "dead_zone": "dead zone"}
#: Function names in equation texts, and prefixes of parameter names.
INPUT_EFFECT_ABBREVIATIONS: dict[InputEffect, str] = {"delay": "delay", "saturation": "sat", "dead_zone": "dead"}


def input_name(kind: InputEffect, signal: str) -> str:
    """Return the parameter name of a delay, saturation or dead zone, such as ``delay_u`` or ``sat_u``."""
    return f"{INPUT_EFFECT_ABBREVIATIONS[kind]}_{signal}"


@dataclass(frozen=True)
class FreeInputParameter:
    """Delay, saturation or dead zone of an input whose value is to be estimated.

    Parameters
    ----------
    signal
        Name of the input.
    kind
        Kind: ``"delay"``, ``"saturation"`` or ``"dead_zone"``.
    bounds
        Lower and upper bound, in seconds for a delay, otherwise in the unit of the input.
    """

    signal: str
    kind: InputEffect
    bounds: tuple[float, float]

    @property
    def name(self) -> str:
        """Parameter name; see :func:`input_name`."""
        return input_name(self.kind, self.signal)

    @property
    def description(self) -> str:
        """Description of the parameter, such as ``delay of u``."""
        return f"{INPUT_EFFECT_LABELS[self.kind]} of {self.signal}"


@dataclass(frozen=True)
class InputNonlinearity:
    """Symmetric saturation or dead zone of an input.

    A saturation gives min(|u|, value) sign(u), a dead zone max(|u| - value, 0) sign(u). If an input has both, the dead
    zone acts first. A delay acts last.

    Parameters
    ----------
    signal
        Name of the input.
    kind
        ``"saturation"`` or ``"dead_zone"``.
    value
        Limit in the unit of the input, positive for a saturation and not negative for a dead zone; (lower, upper)
        bounds if it is estimated.

    Raises
    ------
    ModelError
        If the value is neither a valid number nor a valid interval.
    """

    signal: str
    kind: NonlinearityKind
    value: Value

    def __post_init__(self) -> None:
        subject, relation = (
            f"{INPUT_EFFECT_LABELS[self.kind]} of {self.signal}",
            "above" if self.kind == "saturation" else "from",
        )
        if isinstance(self.value, (tuple, list)):
            if len(self.value) != 2:
                raise ModelError(
                    f"{subject} = {self.value!r} has {plural(len(self.value), 'value')}; give one, or (minimum, "
                    "maximum)"
                )
            low, high = (real_number(f"{subject}", v) for v in self.value)
            if not 0 <= low < high < math.inf:
                raise ModelError(
                    f"{subject} from {low} to {high} is not an interval; give two increasing values of at least 0"
                )
            return
        value = real_number(subject, self.value)
        if not (0 <= value < math.inf and (value > 0 or self.kind == "dead_zone")):
            raise ModelError(
                f"{subject} = {self.value} is out of range; give a number {relation} 0, in the unit of {self.signal}"
            )

    @property
    def free(self) -> FreeInputParameter | None:
        """Parameter to estimate, or None if the value is fixed."""
        return FreeInputParameter(self.signal, self.kind, self.value) if isinstance(self.value, tuple) else None

    @property
    def name(self) -> str:
        """Parameter name of the value; see :func:`input_name`."""
        return input_name(self.kind, self.signal)

    def apply(self, values: Floats) -> Floats:
        """Return input values with the non-linearity applied.

        Raises
        ------
        ModelError
            If the value of the non-linearity is free.
        """
        if isinstance(self.value, tuple):
            raise ModelError(f"the {INPUT_EFFECT_LABELS[self.kind]} of {self.signal} is still free; give its value")
        clipped = np.clip(values, -self.value, self.value)
        return np.asarray(clipped if self.kind == "saturation" else values - clipped)

    def as_text(self, inner: str, digits: str = "r") -> str:
        """Return text such as ``sat(u, 0.94)``; `inner` is the text of the input.

        `digits` is a format specification for numbers; ``"r"`` gives all digits.
        """
        values = self.value if isinstance(self.value, tuple) else (self.value,)
        texts = [repr(float(v)) if digits == "r" else format(v, digits) for v in values]
        return f"{INPUT_EFFECT_ABBREVIATIONS[self.kind]}({inner}, {':'.join(texts)})"


def sort_nonlinearities(limits: Sequence[InputNonlinearity]) -> list[InputNonlinearity]:
    """Return non-linearities in the sequence in which they act: dead zones, then saturations."""
    return sorted(limits, key=lambda limit: limit.kind == "saturation")


def replace_nonlinearities(
    limits: Sequence[InputNonlinearity], kind: NonlinearityKind, values: Mapping[str, Value]
) -> tuple[InputNonlinearity, ...]:
    """Return the non-linearities in the sequence in which they act, with one kind of them replaced.

    Those of the kind `kind` are replaced by new ones with `values` by input.
    """
    others = [limit for limit in limits if limit.kind != kind or limit.signal not in values]
    new = [
        InputNonlinearity(s, kind, (v[0], v[1]) if isinstance(v, list) and len(v) == 2 else v)
        for s, v in values.items()
    ]
    return tuple(sort_nonlinearities([*others, *new]))


def check_nonlinearities(
    limits: Sequence[InputNonlinearity], delays: Mapping[str, object], free_delays: Mapping[str, object]
) -> None:
    """Raise ModelError for a combination of non-linearities and delays of an input that cannot be estimated.

    These are two non-linearities of one kind, more than one free parameter, a free limit with a fixed delay, and a free
    dead zone with a saturation. `delays` are the fixed delays and `free_delays` the free delays, by input.
    """
    for k, limit in enumerate(limits):
        if any((o.signal, o.kind) == (limit.signal, limit.kind) for o in limits[:k]):
            raise ModelError(f"the {INPUT_EFFECT_LABELS[limit.kind]} of {limit.signal} is given twice; give it once")
        if limit.free is None:
            continue
        name, subject = limit.signal, f"the {INPUT_EFFECT_LABELS[limit.kind]} of {limit.signal} is free"
        other = next((o for o in limits if o.signal == name and o is not limit), None)
        if name in free_delays or (other is not None and other.free is not None):
            other_label = "delay" if other is None or other.free is None else INPUT_EFFECT_LABELS[other.kind]
            raise ModelError(
                f"{subject}, and so is its {other_label}; only one parameter of an input can be estimated: give the "
                "other one"
            )
        if delays.get(name):
            raise ModelError(f"{subject}, and {name} has a delay; shift the input by it, or give the limit")
        if other is not None and limit.kind == "dead_zone":
            raise ModelError(
                f"{subject}, and {name} saturates after it; free the saturation instead, or give both values"
            )
