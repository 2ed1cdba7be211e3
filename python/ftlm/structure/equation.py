"""Fractional-order equations of a structure: terms and friction, their validation and their text."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from msgspec import UNSET, UnsetType

from ftlm.errors import ModelError
from ftlm.structure.expression import Expression
from ftlm.structure.order import MAX_ORDER, MIN_INPUT_ORDER, ORDER_RESOLUTION, Order
from ftlm.utils.arguments import check_arguments
from ftlm.utils.validation import real_number


@check_arguments
@dataclass(frozen=True)
class Term:
    """Term ``factor * coefficient * D^order signal`` on the right-hand side of an equation.

    A non-linear term has an expression in place of the signal, such as ``y^3`` or ``abs(D y)*D y``.

    Parameters
    ----------
    signal
        Name of the signal; for an expression, the name of its first signal.
    order
        Order of the derivative that is applied to the signal, or to the whole expression.
    coefficient
        Name of a free coefficient, or its value.
    factor
        Known factor of the coefficient, such as a sign.
    name
        Name of a free coefficient that has been fixed to its value.
    expression
        Expression of a non-linear term.
    """

    signal: str
    order: Order
    coefficient: str | float
    factor: float = 1.0
    name: str | None = None
    # Omitted from digests and files when unset.
    expression: Expression | UnsetType = UNSET

    @property
    def nonlinear(self) -> Expression | None:
        """Expression of a non-linear term; None if the term is linear."""
        return self.expression if isinstance(self.expression, Expression) else None

    @property
    def column(self) -> str:
        """Name of the term's row in a block-pulse record: the signal, or the text of the expression."""
        return self.signal if self.nonlinear is None else str(self.nonlinear)

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals of the term, in the sequence in which they first occur."""
        if self.nonlinear is None:
            return (self.signal,)
        return tuple(dict.fromkeys(signal for signal, _ in self.nonlinear.channels))

    @property
    def fixed_value(self) -> float | None:
        """Value of factor * coefficient; None if the coefficient is free."""
        return None if isinstance(self.coefficient, str) else self.factor * self.coefficient

    def format(self, inputs: Mapping[str, str]) -> str:
        """Return the term as text; `inputs` maps the name of an input to its text with delay and non-linearity."""
        if isinstance(self.coefficient, str):
            factor = "" if self.factor == 1 else "-" if self.factor == -1 else f"{self.factor!r} "
            text = f"{factor}{self.coefficient} "
        else:
            text = f"{self.factor * self.coefficient!r} "
        return text + self.format_operand(inputs)

    def format_operand(self, inputs: Mapping[str, str]) -> str:
        """Return the term as text without its coefficient; `inputs` is as in :meth:`format`."""
        expression = self.nonlinear
        if expression is None:
            return derivative(self.order, inputs.get(self.signal, self.signal))
        text = expression.as_text(inputs)
        if self.order.names or self.order.constant != 0:
            return derivative(self.order, f"({text})")
        if expression.operation == "add":
            # The parser multiplies a number into a sum without a constant; a second pair of parentheses prevents this.
            is_unambiguous = isinstance(self.coefficient, str) or expression.arguments[-1].operation == "constant"
            return f"({text})" if is_unambiguous else f"(({text}))"
        first = expression.arguments[0]
        is_product = expression.operation == "multiply" and (first.operation, first.value) == ("channel", 0.0)
        if is_product and not isinstance(self.coefficient, str):
            # The parser reads the first of two names in a product as a coefficient; parentheses prevent this.
            return text.replace(first.as_text(inputs), f"({first.as_text(inputs)})", 1)
        return text

    def __str__(self) -> str:
        return self.format({})


Parametric = TypeVar("Parametric", Term, "Stribeck", "Friction")


def _fix_parameter(
    item: Parametric, values: Mapping[str, float], field: str = "coefficient", name_field: str = "name"
) -> Parametric:
    """Return a term or friction with the free parameter in `field` fixed to its value, if `values` contains it.

    The field `name_field` then stores the name of the parameter.
    """
    name = getattr(item, field)
    if not isinstance(name, str) or name not in values:
        return item
    changes: dict[str, Any] = {field: real_number(name, values[name]), name_field: name}
    return replace(item, **changes)


def derivative(order: Order, signal: str) -> str:
    """Return the derivative of a signal as text, such as ``D^0.5 y``."""
    if not order.names and order.constant == 0:
        return signal
    text = str(order)
    is_simple = re.fullmatch(r"[\w.]+", text)
    return f"D^{text if is_simple else f'({text})'} {signal}"


@check_arguments
@dataclass(frozen=True)
class Stribeck:
    """Stribeck term of friction: ``factor * coefficient * exp(-(D output / speed)^2) * sign(D output)``.

    Parameters
    ----------
    coefficient
        Name of the free coefficient fs, or its nonnegative value [unit of D^alpha y].
    speed
        Stribeck speed vs, at which the term has decayed to 1/e: its name if free, otherwise its positive value [unit of
        y per s].
    factor
        Known factor of the coefficient. It is negative, because friction dissipates energy.
    name, speed_name
        Names of a free coefficient and a free speed that have been fixed to their values.
    """

    coefficient: str | float
    speed: str | float
    factor: float = -1.0
    name: str | None = None
    speed_name: str | None = None

    @property
    def strength(self) -> float | None:
        """Stiction minus Coulomb friction [unit of D^alpha y]; None if the coefficient is free."""
        return None if isinstance(self.coefficient, str) else -self.factor * self.coefficient

    def as_text(self, output: str) -> str:
        """Return the Stribeck term in the equation of an output as text."""
        speed = self.speed if isinstance(self.speed, str) else f"{self.speed!r}"
        return f"- {_format_coefficient(self.coefficient, self.factor)} exp(-(D {output}/{speed})^2) sign(D {output})"


@check_arguments
@dataclass(frozen=True)
class Friction:
    """Coulomb friction ``factor * coefficient * sign(D output)`` on the output of an equation, set-valued at rest.

    The sign is taken from the simulated velocity, not from a measured one. At rest, the sign is replaced by the value
    in [-1, 1] that keeps the output at rest. If there is no such value, the output slides.

    Parameters
    ----------
    coefficient
        Name of the free coefficient, or its nonnegative value [unit of D^alpha y].
    factor
        Known factor of the coefficient. It is negative, because friction dissipates energy.
    name
        Name of a free coefficient that has been fixed to its value.
    stribeck
        Stribeck term; None if there is none. The breakaway force is then the sum of both coefficients.
    """

    coefficient: str | float
    factor: float = -1.0
    name: str | None = None
    stribeck: Stribeck | None = None

    @property
    def strength(self) -> float | None:
        """Coulomb friction force [unit of D^alpha y]; None if the coefficient is free."""
        return None if isinstance(self.coefficient, str) else -self.factor * self.coefficient

    @property
    def law(self) -> tuple[float, float, float]:
        """Coulomb coefficient fc, Stribeck coefficient fs and Stribeck speed vs, as (fc, fs, vs).

        Parameters must be fixed. Without a Stribeck term, fs is 0 and vs is 1.
        """
        stribeck_term = self.stribeck
        stribeck = (0.0, 1.0) if stribeck_term is None else (stribeck_term.strength or 0.0, float(stribeck_term.speed))
        return (self.strength or 0.0, *stribeck)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free friction parameters."""
        return tuple(n for n in self._parameters if isinstance(n, str))

    @property
    def identified_coefficients(self) -> dict[str, float]:
        """Values of friction parameters that were free and have been fixed, by name."""
        stribeck_term = self.stribeck
        pairs = [(self.name, self.coefficient)]
        if stribeck_term is not None:
            pairs += [(stribeck_term.name, stribeck_term.coefficient), (stribeck_term.speed_name, stribeck_term.speed)]
        return {name: float(value) for name, value in pairs if name is not None}

    @property
    def parameter_values(self) -> list[float]:
        """Coulomb coefficient and, with a Stribeck term, its coefficient and speed; no parameter may be free."""
        return [float(v) for v in self._parameters]

    @property
    def _parameters(self) -> list[str | float]:
        stribeck = self.stribeck
        return [self.coefficient, *([] if stribeck is None else [stribeck.coefficient, stribeck.speed])]

    def with_parameter_values(self, values: Sequence[float]) -> Friction:
        """Return the friction with new parameter values, given in the sequence of :attr:`parameter_values`."""
        coefficient, *rest = values
        stribeck = None if self.stribeck is None else replace(self.stribeck, coefficient=rest[0], speed=rest[1])
        return replace(self, coefficient=coefficient, stribeck=stribeck)

    def with_coefficients(self, values: Mapping[str, float]) -> Friction:
        """Return the friction with some free parameters fixed to values; the others stay free."""
        fixed = _fix_parameter(self, values)
        if self.stribeck is None:
            return fixed
        stribeck = _fix_parameter(_fix_parameter(self.stribeck, values), values, "speed", "speed_name")
        return replace(fixed, stribeck=stribeck)

    def as_text(self, output: str) -> str:
        """Return the friction terms in the equation of an output as text."""
        stribeck = "" if self.stribeck is None else f" {self.stribeck.as_text(output)}"
        return f"- {_format_coefficient(self.coefficient, self.factor)} sign(D {output}){stribeck}"


def _format_coefficient(coefficient: str | float, factor: float) -> str:
    """Return -`factor` times a friction coefficient as text; it has no minus sign, because `factor` is negative."""
    if isinstance(coefficient, str):
        return coefficient if factor == -1 else f"{-factor!r} {coefficient}"
    return f"{-factor * coefficient!r}"


@check_arguments
@dataclass(frozen=True)
class Equation:
    """Fractional-order equation ``D^order output = sum of terms``.

    Parameters
    ----------
    output
        Name of the output.
    order
        Highest order alpha, in (0, 10].
    terms
        Terms of the right-hand side. Orders of the output lie in [0, alpha), orders of other signals in [-3, 10].
        Orders above alpha occur, for example, if the measured hub angle of an arm is an input of the link. For
        simulation they must be below alpha + 1, and for zero-order-hold inputs at most alpha, because jumps have no
        derivative.
    friction
        Coulomb friction with an optional Stribeck term; None if there is none. With friction, alpha must lie in (1, 2],
        and all other orders below alpha.

    Raises
    ------
    ModelError
        If there is no term, a coefficient is repeated, or an order or value is out of range.
    """

    output: str
    order: Order
    terms: tuple[Term, ...]
    friction: Friction | None = None

    def __post_init__(self) -> None:
        if not self.terms:
            raise ModelError(f"the equation of {self.output} has no term; add at least one")
        names = list(self.coefficient_names)
        duplicate = next((n for i, n in enumerate(names) if n in names[:i]), None)
        if duplicate is not None:
            raise ModelError(
                f"coefficient {duplicate} occurs twice in the equation of {self.output}; give each its own name"
            )
        duplicates = set(names) & set(self.order_names)
        if duplicates:
            raise ModelError(f"{min(duplicates)} names an order and a coefficient; rename one")
        duplicates = {self.output, *(signal for term in self.terms for signal in term.signals)} & set(self.order_names)
        if duplicates:
            raise ModelError(f"{min(duplicates)} names an order and a signal; rename the order")
        if not self.order.names and not 0 < self.order.constant <= MAX_ORDER:
            raise ModelError(
                f"order alpha = {self.order.constant:g} of {self.output} is outside (0, 10]; choose another"
            )
        for term in self.terms:
            if term.factor == 0 or not math.isfinite(term.factor):
                raise ModelError(
                    f"factor {term.factor:g} of {term.coefficient} {term.signal} in the equation of {self.output} "
                    "is 0 or not finite; give a finite number other than 0"
                )
            if term.fixed_value is not None and not math.isfinite(term.fixed_value):
                raise ModelError(
                    f"coefficient of {term.signal} in the equation of {self.output} is {term.fixed_value:g}, which is "
                    "not finite; give a number"
                )
            if term.nonlinear is not None:
                self._check_expression(term, term.nonlinear)
                continue
            if term.order.names or self.order.names:
                continue
            is_output, alpha, order = term.signal == self.output, self.order.constant, term.order.constant
            if is_output and not 0 <= order < alpha:
                raise ModelError(
                    f"order {order:g} of a term of the output {self.output} is outside [0, {alpha:g}); lower it"
                )
            if not is_output and order < MIN_INPUT_ORDER:
                raise ModelError(f"order {order:g} of {term.signal} is below {MIN_INPUT_ORDER:g}; raise it")
            if not is_output and order > MAX_ORDER:
                raise ModelError(f"order {order:g} of {term.signal} is above {MAX_ORDER:g}; lower it")

        if self.friction is not None:
            self._check_friction(self.friction)

    def _check_expression(self, term: Term, expression: Expression) -> None:
        """Raise ModelError if the order of a non-linear term, or of an output derivative in it, is out of range."""
        subject = f"{term} in the equation of {self.output}"
        if term.order.names or self.order.names:
            return
        alpha, order = self.order.constant, term.order.constant
        lowest = 0.0 if self.output in term.signals else MIN_INPUT_ORDER
        if not lowest <= order <= alpha:
            raise ModelError(
                f"order {order:g} of the non-linear term {subject} is outside [{lowest:g}, {alpha:g}]; change it"
            )
        for signal, inner_order in expression.channels:
            if signal == self.output and inner_order > alpha - order + ORDER_RESOLUTION:
                raise ModelError(
                    f"{subject} has the derivative of order {inner_order:g} of {signal}, above {alpha - order:g}: with "
                    f"the order of the term, {order:g}, it exceeds alpha = {alpha:g}; lower it"
                )

    def _check_friction(self, friction: Friction) -> None:
        """Raise ModelError if friction adds energy, a parameter of it is out of range, or alpha is outside (1, 2]."""
        subject = f"friction in the equation of {self.output}"
        terms: list[Friction | Stribeck] = [friction] if friction.stribeck is None else [friction, friction.stribeck]
        for term in terms:
            if not (math.isfinite(term.factor) and term.factor < 0):
                raise ModelError(
                    f"{subject} has the factor {term.factor:g}, but friction dissipates energy: write "
                    f"'- fc*sign(D {self.output})'"
                )
            if term.strength is not None and not 0 <= term.strength < math.inf:
                raise ModelError(
                    f"{subject} has the coefficient {term.coefficient!r}; give a value of at least 0: the term has the "
                    "minus sign"
                )
        if friction.stribeck is not None and not isinstance(friction.stribeck.speed, str):
            speed = friction.stribeck.speed
            if not 0 < speed < math.inf:
                raise ModelError(
                    f"{subject} has the Stribeck speed vs = {speed:g}; give a positive one, in units of {self.output} "
                    "per s"
                )
        if self.order.names:
            return
        alpha = self.order.constant
        if not 1 < alpha <= 2:
            raise ModelError(
                f"{subject} requires an order alpha in (1, 2], not {alpha:g}, because it depends on the velocity; "
                f"choose another order, or write '- fc*tanh(100 {self.output})' if {self.output} is itself a velocity"
            )

    def check_input_orders(self, outputs: Sequence[str]) -> None:
        """Raise ModelError if the order of an input is not below alpha, as the output would then jump with the input.

        Equations with friction or non-linear terms must pass this check. Friction depends on the velocity of the
        output, and a non-linear term on the values of the output within a block pulse, so both require a continuous
        output. Terms whose signals are all among the simulated `outputs` are exempt.

        Raises
        ------
        ModelError
            If a fixed order of an input is not below a fixed alpha.
        """
        for item in self.terms:
            is_fixed = not (self.order.names or item.order.names or set(item.signals) <= set(outputs))
            if is_fixed and item.order.constant >= self.order.constant - 1e-9:
                terms = self.nonlinear_terms
                subject, quantity = (f"the non-linear term {terms[0]}", "motion") if terms else ("friction", "velocity")
                raise ModelError(
                    f"order {item.order.constant:g} of {item.signal} is not below alpha = {self.order.constant:g}, but "
                    f"{subject} in the equation of {self.output} requires a continuous {quantity}; lower it"
                )

    @property
    def nonlinear_terms(self) -> tuple[Term, ...]:
        """Non-linear terms, in the sequence in which they occur."""
        return tuple(t for t in self.terms if t.nonlinear is not None)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals: the output, then the others in the sequence in which they first occur."""
        return tuple(dict.fromkeys([self.output, *(s for t in self.terms for s in t.signals)]))

    @property
    def orders(self) -> tuple[Order, ...]:
        """Order of the equation, then the orders of its terms."""
        return (self.order, *(t.order for t in self.terms))

    @property
    def order_names(self) -> tuple[str, ...]:
        """Names of the free orders, in the sequence in which they first occur."""
        return tuple(dict.fromkeys(n for o in self.orders for n in o.names))

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the free coefficients, in the sequence in which they first occur."""
        friction = () if self.friction is None else self.friction.names
        return (*(t.coefficient for t in self.terms if isinstance(t.coefficient, str)), *friction)

    def with_orders(self, values: Mapping[str, float]) -> Equation:
        """Return the equation with some free orders fixed to values; the others stay free.

        Raises
        ------
        ModelError
            If an order is out of range.
        """
        terms = tuple(replace(t, order=t.order.substitute(values)) for t in self.terms)
        return Equation(self.output, self.order.substitute(values), terms, self.friction)

    def with_coefficients(self, values: Mapping[str, float]) -> Equation:
        """Return the equation with some free coefficients fixed to values; the others stay free.

        Raises
        ------
        ModelError
            If a value is not a finite number.
        """
        terms = tuple(_fix_parameter(t, values) for t in self.terms)
        friction = None if self.friction is None else self.friction.with_coefficients(values)
        return Equation(self.output, self.order, terms, friction)

    @property
    def is_identified(self) -> bool:
        """Whether all orders and coefficients, including those of friction, are fixed."""
        return not self.order_names and not self.coefficient_names

    def as_text(self, inputs: Mapping[str, str]) -> str:
        """Return the equation as text; `inputs` maps the name of an input to its text with delay and non-linearity."""
        right_side = " + ".join(t.format(inputs) for t in self.terms).replace("+ -", "- ")
        friction = "" if self.friction is None else f" {self.friction.as_text(self.output)}"
        return f"{derivative(self.order, self.output)} = {right_side}{friction}"

    def __str__(self) -> str:
        return self.as_text({})


def format_equation(item: Equation, inputs: Mapping[str, str] | None = None) -> str:
    """Return an identified equation as text with six significant digits.

    `inputs` maps the name of an input to its text, such as ``u(t - 0.035 s)``.
    """
    texts = inputs or {}
    parts = [f"{t.fixed_value or 0.0:+.6g} {t.format_operand(texts)}" for t in item.terms]
    right_side = " ".join([parts[0].removeprefix("+"), *(f"{p[0]} {p[1:]}" for p in parts[1:])])
    if item.friction is not None:
        fc, fs, vs = item.friction.law
        right_side += f" - {fc:.6g} sign(D {item.output})"
        if item.friction.stribeck is not None:
            right_side += f" - {fs:.6g} exp(-(D {item.output}/{vs:.6g})^2) sign(D {item.output})"
    return f"{derivative(item.order, item.output)} = {right_side}"
