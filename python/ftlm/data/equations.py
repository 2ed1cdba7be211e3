"""Equations of fractional order: terms, equations, and how they are written."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from ftlm.base.checks import real_number
from ftlm.base.errors import ModelError
from ftlm.data.orders import MAX_EXCESS, MAX_ORDER, MIN_INPUT_ORDER, Order


@dataclass(frozen=True)
class Term:
    """One term ``factor * coefficient * D^order signal`` of a right-hand side.

    Parameters
    ----------
    signal
        Name of the signal.
    order
        Its order.
    coefficient
        Name of a free coefficient, or its value.
    factor
        Known factor of the coefficient, such as a sign.
    name
        Name that the coefficient had before it got its value.
    """

    signal: str
    order: Order
    coefficient: str | float
    factor: float = 1.0
    name: str | None = None

    @property
    def fixed(self) -> float | None:
        """Value of factor * coefficient, if it is known."""
        return None if isinstance(self.coefficient, str) else self.factor * self.coefficient

    def __str__(self) -> str:
        if isinstance(self.coefficient, str):
            factor = "" if self.factor == 1 else "-" if self.factor == -1 else f"{self.factor!r} "
            text = f"{factor}{self.coefficient} "
        else:
            text = f"{self.factor * self.coefficient!r} "
        return text + derivative(self.order, self.signal)


def derivative(order: Order, signal: str) -> str:
    """Write a signal with its order."""
    if not order.names and order.constant == 0:
        return signal
    text = str(order)
    plain = re.fullmatch(r"[\w.]+", text)
    return f"D^{text if plain else f'({text})'} {signal}"


@dataclass(frozen=True)
class Equation:
    """D^order output = sum of terms.

    Parameters
    ----------
    output
        Name of the output.
    order
        Its highest order, alpha, in (0, 10].
    terms
        Right-hand side. Orders of the output itself lie in [0, alpha), those of other signals in [-3, alpha + 1): the
        link of an arm hangs on a hub that is differentiated more often than its own deflection. A command that holds
        between samples stays at alpha or below, its jumps have no derivative.
    """

    output: str
    order: Order
    terms: tuple[Term, ...]

    def __post_init__(self) -> None:
        if not self.terms:
            raise ModelError(f"the equation of {self.output} has no term; add at least one")
        names = [t.coefficient for t in self.terms if isinstance(t.coefficient, str)]
        twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
        if twice is not None:
            raise ModelError(
                f"coefficient {twice} stands twice in the equation of {self.output}; give each its own name"
            )
        both = set(names) & set(self.order_names)
        if both:
            raise ModelError(f"{min(both)} names an order and a coefficient; rename one")
        if not self.order.names and not 0 < self.order.constant <= MAX_ORDER:
            raise ModelError(
                f"order alpha = {self.order.constant:g} of {self.output} is outside (0, 10]; choose another"
            )
        for term in self.terms:
            if term.factor == 0 or not math.isfinite(term.factor):
                raise ModelError(
                    f"factor {term.factor:g} of {term.coefficient} {term.signal} in the equation of {self.output} "
                    "leaves nothing to estimate; give a finite number other than 0"
                )
            if term.fixed is not None and not math.isfinite(term.fixed):
                raise ModelError(
                    f"coefficient of {term.signal} in the equation of {self.output} is {term.fixed:g}, which is not "
                    "finite; give a number"
                )
            if term.order.names or self.order.names:
                continue
            own, alpha, order = term.signal == self.output, self.order.constant, term.order.constant
            if own and not 0 <= order < alpha:
                raise ModelError(f"own-output order {order:g} of {self.output} is outside [0, {alpha:g}); lower it")
            if not own and order < MIN_INPUT_ORDER:
                raise ModelError(f"order {order:g} of {term.signal} is below {MIN_INPUT_ORDER:g}; raise it")
            if not own and order >= alpha + MAX_EXCESS - 1e-9:
                raise ModelError(
                    f"order {order:g} of {term.signal} is {order - alpha:g} above alpha = {alpha:g} of {self.output}; "
                    "an equation carries another signal less than one order above its own output: lower it"
                )

    @property
    def signals(self) -> tuple[str, ...]:
        """Output first, then the other signals in order of appearance."""
        return tuple(dict.fromkeys([self.output, *(t.signal for t in self.terms)]))

    @property
    def order_names(self) -> tuple[str, ...]:
        """Free orders in order of appearance."""
        return tuple(dict.fromkeys(n for o in (self.order, *(t.order for t in self.terms)) for n in o.names))

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Free coefficients in order of appearance."""
        return tuple(t.coefficient for t in self.terms if isinstance(t.coefficient, str))

    def with_orders(self, values: Mapping[str, float]) -> Equation:
        """Return the equation with these free orders replaced by values; others stay free.

        Raises
        ------
        ModelError
            Orders out of range once they are numbers.
        """
        terms = tuple(replace(t, order=t.order.partly(values)) for t in self.terms)
        return Equation(self.output, self.order.partly(values), terms)

    def with_coefficients(self, values: Mapping[str, float]) -> Equation:
        """Return the equation with these free coefficients replaced by values; others stay free.

        Raises
        ------
        ModelError
            A value that is no finite number.
        """
        terms = tuple(
            replace(t, coefficient=real_number(t.coefficient, values[t.coefficient]), name=t.coefficient)
            if isinstance(t.coefficient, str) and t.coefficient in values
            else t
            for t in self.terms
        )
        return Equation(self.output, self.order, terms)

    @property
    def is_identified(self) -> bool:
        """Whether every order and every coefficient is a number."""
        return not self.order_names and not self.coefficient_names

    def __str__(self) -> str:
        right = " + ".join(str(t) for t in self.terms).replace("+ -", "- ")
        return f"{derivative(self.order, self.output)} = {right}"


def numeric(item: Equation, delay: Mapping[str, float] | None = None) -> str:
    """Write an identified equation with six significant digits, inputs with their delays [s]: ``u(t - 0.035 s)``."""
    late = {n: f"{n}(t - {d:.6g} s)" for n, d in (delay or {}).items() if d > 0}
    parts = [f"{t.fixed or 0.0:+.6g} {derivative(t.order, late.get(t.signal, t.signal))}" for t in item.terms]
    right = " ".join([parts[0].removeprefix("+"), *(f"{p[0]} {p[1:]}" for p in parts[1:])])
    return f"{derivative(item.order, item.output)} = {right}"
