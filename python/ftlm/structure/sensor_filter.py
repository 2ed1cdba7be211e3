"""Sensor filter: a known transfer function of measured signals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from ftlm.errors import ModelError
from ftlm.structure.order import MAX_ORDER
from ftlm.utils.arguments import check_arguments
from ftlm.utils.validation import real_number


class SensorFilter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Sensor filter: a known transfer function through which some signals were measured.

    The filter may apply to inputs and outputs, because it commutes with every linear equation. If a filtered signal is
    an input of an equation, all other signals, including the measured output, are filtered by software, and the
    equation is applied to filtered signals. If all inputs are unfiltered, or an equation has friction, the unfiltered
    motion is simulated; the filter is then applied to the simulated outputs that were measured through it. See
    :attr:`Structure.all_filtered`.

    Parameters
    ----------
    signals
        Names of the signals that were measured through the filter, at least one.
    numerator, denominator
        Numerator and denominator, each a sum of coefficient * D^order, as (coefficient, order) pairs.

    Raises
    ------
    ModelError
        If there is no signal, a signal is repeated, a term is invalid, or the order of the numerator exceeds the order
        of the denominator.
    """

    signals: tuple[str, ...]
    numerator: tuple[tuple[float, float], ...]
    denominator: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        """Validate the signals and the transfer function."""
        if not self.signals:
            raise ModelError("sensor filter: it names no signal; name the signals that were measured through it")
        duplicate = next((s for i, s in enumerate(self.signals) if s in self.signals[:i]), None)
        if duplicate is not None:
            raise ModelError(f"sensor filter: it names {duplicate} twice; name each signal once")
        for part, terms in (("numerator", self.numerator), ("denominator", self.denominator)):
            for coefficient, order in terms:
                if not (math.isfinite(coefficient) and 0 <= order <= MAX_ORDER):
                    raise ModelError(
                        f"sensor filter: {coefficient:g} D^{order:g} in its {part} is not a term; give a finite "
                        "coefficient and an order in [0, 10]"
                    )
        highest = max((order for coefficient, order in self.denominator if coefficient), default=None)
        if highest is None:
            raise ModelError("sensor filter: its denominator has no term; give at least one")
        improper = next((order for _, order in self.numerator if order > highest), None)
        if improper is not None:
            raise ModelError(
                f"sensor filter: order {improper:g} of its numerator is above {highest:g}, the highest of its "
                "denominator; give a proper filter"
            )

    @property
    def relative_degree(self) -> int:
        """Relative degree: order of the denominator minus order of the numerator, rounded down."""
        denominator_order, numerator_order = (
            max((order for coefficient, order in part if coefficient), default=0.0)
            for part in (self.denominator, self.numerator)
        )
        return int(denominator_order - numerator_order + 1e-9)

    @property
    def has_impulse_transient(self) -> bool:
        """Whether the transient of the filter is a sum of impulse responses: no zeros and only integer orders."""
        is_integer = all(order == round(order) for coefficient, order in self.denominator if coefficient)
        return is_integer and not any(order for coefficient, order in self.numerator if coefficient)

    @classmethod
    @check_arguments
    def low_pass(cls, signals: Sequence[str], frequency: float = 2.0, damping: float = 0.9) -> SensorFilter:
        """Return a second-order low-pass filter; the defaults are those of the robot arm's original real-time model.

        Parameters
        ----------
        signals
            Names of the filtered signals.
        frequency
            Natural frequency [Hz].
        damping
            Damping ratio.

        Raises
        ------
        ModelError
            If there are no signals, or frequency or damping is not positive.
        """
        if isinstance(signals, str):
            raise ModelError(f"sensor filter: signals = {signals!r} is one text; give a list of names, [{signals!r}]")
        for name, value in (("frequency", frequency), ("damping", damping)):
            if not 0 < real_number(f"{name} of the sensor filter", value) < math.inf:
                raise ModelError(
                    f"{name} of the sensor filter = {value} is not positive; give a positive number, such as 2.0 [Hz] "
                    "and 0.9"
                )
        omega = 2 * math.pi * frequency
        return cls(tuple(signals), ((omega**2, 0.0),), ((1.0, 2.0), (2 * damping * omega, 1.0), (omega**2, 0.0)))
