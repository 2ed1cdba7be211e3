"""The sensor filter: a known rational filter that signals were measured through."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from ftlm.errors import ModelError
from ftlm.structure.order import MAX_ORDER
from ftlm.utils.validation import real_number


class SensorFilter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A known rational filter that some signals were measured through.

    It belongs to signals, inputs and outputs alike, for it commutes with every linear equation. Where an equation is
    driven by a filtered signal, all of its signals are taken behind the filter: a filtered one as it was measured, any
    other one put through it, the output that the equation is compared with included. A free run in which all outputs
    follow from unfiltered signals is the machine's own motion, and only its filtered outputs pass the filter before
    they are compared; so it always is where a body has friction. See :attr:`Structure.behind_filter`.

    Parameters
    ----------
    signals
        Names of the signals that were measured through it, at least one.
    numerator, denominator
        (coefficient, order) pairs of sums of coefficient * D^order.

    Raises
    ------
    ModelError
        No signal, one named twice, a term that is none, or a numerator of higher order than the denominator.
    """

    signals: tuple[str, ...]
    numerator: tuple[tuple[float, float], ...]
    denominator: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Refuse a filter that is none."""
        if not self.signals:
            raise ModelError("sensor filter: it names no signal; name those that were measured through it")
        twice = next((s for i, s in enumerate(self.signals) if s in self.signals[:i]), None)
        if twice is not None:
            raise ModelError(f"sensor filter: it names {twice} twice; a signal passes it once")
        for part, terms in (("numerator", self.numerator), ("denominator", self.denominator)):
            for coefficient, order in terms:
                if not (math.isfinite(coefficient) and 0 <= order <= MAX_ORDER):
                    raise ModelError(
                        f"sensor filter: {coefficient:g} D^{order:g} in its {part} is no term; give a finite "
                        "coefficient and an order in [0, 10]"
                    )
        highest = max((order for coefficient, order in self.denominator if coefficient), default=None)
        if highest is None:
            raise ModelError("sensor filter: its denominator has no term; give at least one")
        improper = next((order for _, order in self.numerator if order > highest), None)
        if improper is not None:
            raise ModelError(
                f"sensor filter: order {improper:g} of its numerator is above {highest:g}, the highest of its "
                "denominator; a filter that can be built is proper"
            )

    @property
    def relative_degree(self) -> int:
        """By how many whole orders the denominator exceeds the numerator: derivatives of an impulse that it answers."""
        bottom, top = (
            max((order for coefficient, order in part if coefficient), default=0.0)
            for part in (self.denominator, self.numerator)
        )
        return int(bottom - top + 1e-9)

    @property
    def holds_answers(self) -> bool:
        """Whether all that it can hold are such answers: it has no zero and no fractional order."""
        whole = all(order == round(order) for coefficient, order in self.denominator if coefficient)
        return whole and not any(order for coefficient, order in self.numerator if coefficient)

    @classmethod
    def low_pass(cls, signals: Sequence[str], frequency: float = 2.0, damping: float = 0.9) -> SensorFilter:
        """Second-order low-pass of ``frequency`` [Hz]; the default is that of the arm's stock real-time model.

        Parameters
        ----------
        signals
            Names of the signals that were measured through it.
        frequency
            Its own [Hz].
        damping
            Ratio.

        Raises
        ------
        ModelError
            No signals, or a frequency or damping that is not positive.
        """
        if isinstance(signals, str):
            raise ModelError(f"sensor filter: signals = {signals!r} is one text; give a list of names, [{signals!r}]")
        for name, value in (("frequency", frequency), ("damping", damping)):
            if not 0 < real_number(f"{name} of the sensor filter", value) < math.inf:
                raise ModelError(f"{name} of the sensor filter = {value} is not positive; give 2.0 [Hz] and 0.9, say")
        omega = 2 * math.pi * frequency
        return cls(tuple(signals), ((omega**2, 0.0),), ((1.0, 2.0), (2 * damping * omega, 1.0), (omega**2, 0.0)))
