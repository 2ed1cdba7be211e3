"""Refuses arguments that are not the numbers they should be, before arithmetic makes something else of them."""

from __future__ import annotations

from ftlm.errors import ModelError

__all__ = ["real_number", "whole_number"]


def whole_number(value: object) -> int | None:
    """Return a value that is a whole number as an int, anything else as None; the message is the caller's."""
    if isinstance(value, (str, bytes, bytearray, bool)):
        return None
    try:
        number = int(value)  # type: ignore[call-overload]
        return int(number) if number == value else None
    except (TypeError, ValueError, OverflowError):
        return None


def real_number(name: str, value: object) -> float:
    """Return a real number as a float; it may be infinite or not a number, which is for the caller to judge.

    Raises
    ------
    ModelError
        Text, nothing, a truth value, or an integer beyond the range of floating point.
    """
    try:
        if isinstance(value, (str, bytes, bytearray, bool)):
            raise TypeError
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        # A long integer has no decimal form in Python.
        shown = f"an integer of {value.bit_length()} bits" if type(value) is int else f"{value!r}"[:60]
        raise ModelError(f"{name} = {shown} is not a number; give one") from None
