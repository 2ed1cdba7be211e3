"""What both boards refuse, in the same words."""

from __future__ import annotations

from ftlm.base.errors import ModelError

#: The board's clock [Hz]: lowest, and highest in fast update.
RATES = (1.0, 8000.0)
EXPIRED = "the watchdog expired: the program did not answer in time, and the board put 0 V out"


def check_rate(rate: float) -> None:
    """Refuse samples a second that the board's clock cannot do."""
    low, high = RATES
    if not low <= rate <= high:
        raise ModelError(f"rate = {rate!r} Hz cannot be done by this board; use {low:g} to {high:g} Hz")


def check_watchdog(rate: float, seconds: float) -> None:
    """Refuse a watchdog that would expire between one sample and the next, each of which reloads it."""
    if seconds * rate < 2.0:
        raise ModelError(
            f"watchdog = {seconds:g} s is shorter than two samples at {rate:g} Hz and would expire between them; use "
            f"at least {2.0 / rate:g} s, or a higher rate"
        )


def unset(*, analog: bool, digital: bool) -> str | None:
    """What keeps the watchdog from stopping the motors, given which of its expiration states are set."""
    if not analog:
        return "the watchdog's expiration state of the analog outputs is not 0 V"
    if not digital:
        return "the watchdog's expiration state of the digital lines is not tristate, so analog outputs would stay"
    return None
