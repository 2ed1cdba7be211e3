"""Validation of arguments that several control designs have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ftlm.errors import ModelError
from ftlm.utils.parameters import setting
from ftlm.utils.validation import Floats, check_integer, check_seed, nearest, real_number, short_repr

#: Range of sampling rates [Hz] for which stability margins can be computed in floating point.
RATE_RANGE_HZ = (1e-9, 1e9)
#: Permitted range of positive arguments, such as standard deviations and times.
POSITIVE_RANGE = (1e-100, 1e100)


def checked_rate(rate: object) -> float:
    """Return a sampling rate [Hz] as a float; raise ModelError if it is out of range."""
    value = real_number("rate", rate)
    if not RATE_RANGE_HZ[0] <= value <= RATE_RANGE_HZ[1]:
        raise ModelError(
            f"{setting('rate')} {short_repr(rate)} Hz is out of range; give samples per second from "
            f"{RATE_RANGE_HZ[0]:g} to {RATE_RANGE_HZ[1]:g}"
        )
    return value


def same_rate(first: float, second: float) -> bool:
    """Whether two sampling rates are equal up to a relative difference of 1e-9."""
    return abs(first - second) <= 1e-9 * second


def select_outputs(argument: str, choice: Sequence[str] | None, outputs: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of chosen outputs; all outputs if the choice is None.

    Raise ModelError if a name is unknown or repeated, or the choice is empty. `argument` names the argument in the
    message.
    """
    if choice is None:
        return outputs
    names = [] if isinstance(choice, str) or not isinstance(choice, Sequence) else [*choice[: len(outputs) + 1]]
    unknown_names = [n for n in names if not (isinstance(n, str) and n in outputs)]
    if not names or (not unknown_names and len(set(names)) < len(names)):
        raise ModelError(
            f"{argument} = {short_repr(choice)} is not a list of different outputs; the input affects "
            f"{', '.join(outputs)}"
        )
    if unknown_names:
        suggestion = nearest(unknown_names[0], outputs) if isinstance(unknown_names[0], str) else ""
        raise ModelError(
            f"{argument} = {short_repr(unknown_names[0])} is not one of the outputs that the input "
            f"reaches{suggestion}; they are "
            f"{', '.join(outputs)}"
        )
    return tuple(names)


def positive(name: str, value: object) -> float:
    """Return the argument `name` as a float; raise ModelError if it is not positive and finite, or out of range."""
    number = real_number(name, value)
    if not (math.isfinite(number) and number > 0):
        raise ModelError(f"{name} = {short_repr(value)} is not positive and finite; give a number above 0")
    if not POSITIVE_RANGE[0] <= number <= POSITIVE_RANGE[1]:
        raise ModelError(
            f"{name} = {short_repr(value)} is out of range; give a number from {POSITIVE_RANGE[0]:g} to "
            f"{POSITIVE_RANGE[1]:g}"
        )
    return number


def check_limit(limit: object) -> float:
    """Return the maximum magnitude of a command, which may be infinite; raise ModelError if it is not positive."""
    maximum = real_number("limit", limit)
    if not maximum > 0:
        raise ModelError(f"{setting('limit')} {short_repr(limit)} is not positive; give a number above 0, or inf")
    return maximum


def check_samples(samples: object, seed: object) -> tuple[int, int]:
    """Return (number of parameter samples, seed); raise ModelError if one is invalid.

    The number is 0 to 10000.
    """
    return check_integer("samples", samples, 0, 10_000), check_seed(seed)


def sum_row(argument: str, text: object, outputs: tuple[str, ...]) -> Floats:
    """Return the coefficient of each output in a sum such as "theta11 + theta12", shape (outputs,).

    Raise ModelError if a term is not an output. `argument` names the argument in the message.
    """
    row = np.zeros(len(outputs))
    for part in text.split("+") if isinstance(text, str) else [""]:
        name = part.strip()
        if name not in outputs:
            suggestion = nearest(name, outputs)
            raise ModelError(
                f"{argument} = {short_repr(text)} is not a sum of outputs that the input reaches{suggestion}; they are "
                f"{', '.join(outputs)}"
            )
        row[outputs.index(name)] += 1.0
    return row
