"""Equations of fractional order: terms, equations, and how they are written."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from msgspec import UNSET, UnsetType

from ftlm.errors import ModelError
from ftlm.structure.order import MAX_EXCESS, MAX_ORDER, MIN_INPUT_ORDER, Order
from ftlm.utils.validation import real_number


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

    def written(self, signal: str) -> str:
        """Write the term with another name for its signal."""
        if isinstance(self.coefficient, str):
            factor = "" if self.factor == 1 else "-" if self.factor == -1 else f"{self.factor!r} "
            text = f"{factor}{self.coefficient} "
        else:
            text = f"{self.factor * self.coefficient!r} "
        return text + derivative(self.order, signal)

    def __str__(self) -> str:
        return self.written(self.signal)


def derivative(order: Order, signal: str) -> str:
    """Write a signal with its order."""
    if not order.names and order.constant == 0:
        return signal
    text = str(order)
    plain = re.fullmatch(r"[\w.]+", text)
    return f"D^{text if plain else f'({text})'} {signal}"


@dataclass(frozen=True)
class Stribeck:
    """What friction has more near rest: ``factor * coefficient * exp(-(D output / speed)^2) * sign(D output)``.

    Parameters
    ----------
    coefficient
        Name of the free coefficient fs, or its value [unit of D^alpha y]; not negative times a factor that is negative.
    speed
        Name of the free speed vs at which the term has fallen to 1/e, or its value [unit of y per s], positive.
    factor
        Known factor of the coefficient, negative: friction takes energy.
    name, speed_name
        Names that coefficient and speed had before they got their values.
    """

    coefficient: str | float
    speed: str | float
    factor: float = -1.0
    name: str | None = None
    speed_name: str | None = None

    @property
    def strength(self) -> float | None:
        """What friction holds at rest beyond what it takes at speed, [unit of D^alpha y], if it is known."""
        return None if isinstance(self.coefficient, str) else -self.factor * self.coefficient

    def written(self, output: str) -> str:
        """Write the term in words."""
        speed = self.speed if isinstance(self.speed, str) else f"{self.speed!r}"
        return f"- {_sized(self.coefficient, self.factor)} exp(-(D {output}/{speed})^2) sign(D {output})"


@dataclass(frozen=True)
class Friction:
    """Coulomb friction ``factor * coefficient * sign(D output)`` of an equation's own output, set-valued at rest.

    The sign is that of the velocity that the equation itself gives, not of a measured one. At rest it is whatever
    within [-1, 1] keeps the body there; where nothing within does, the body slides.

    Parameters
    ----------
    coefficient
        Name of the free coefficient, or its value [unit of D^alpha y]; not negative times a factor that is negative.
    factor
        Known factor, negative: friction takes energy.
    name
        Name that the coefficient had before it got its value.
    more
        What it has more near rest, if there is such a term: a body then breaks away where the force exceeds both.
    """

    coefficient: str | float
    factor: float = -1.0
    name: str | None = None
    # Absent where there is none, so that what is written of an equation without it is as it was.
    more: Stribeck | UnsetType = UNSET

    @property
    def stribeck(self) -> Stribeck | None:
        """What it has more near rest; None without."""
        return self.more if isinstance(self.more, Stribeck) else None

    @property
    def strength(self) -> float | None:
        """What friction takes at speed, and at rest holds at most by itself, [unit of D^alpha y], if it is known."""
        return None if isinstance(self.coefficient, str) else -self.factor * self.coefficient

    @property
    def law(self) -> tuple[float, float, float]:
        """Numbers fc, fs and vs of friction whose coefficients are known; without a Stribeck term fs is 0, vs 1."""
        more = self.stribeck
        near = (0.0, 1.0) if more is None else (more.strength or 0.0, float(more.speed))
        return (self.strength or 0.0, *near)

    @property
    def names(self) -> tuple[str, ...]:
        """Free coefficients."""
        numbers = [self.coefficient] + (
            [] if self.stribeck is None else [self.stribeck.coefficient, self.stribeck.speed]
        )
        return tuple(n for n in numbers if isinstance(n, str))

    @property
    def found(self) -> dict[str, float]:
        """Coefficients that have their values, by the names that they had."""
        more = self.stribeck
        pairs = [(self.name, self.coefficient)]
        if more is not None:
            pairs += [(more.name, more.coefficient), (more.speed_name, more.speed)]
        return {name: float(value) for name, value in pairs if name is not None}

    def with_coefficients(self, values: Mapping[str, float]) -> Friction:
        """Return it with these free coefficients replaced by values; others stay free."""
        out, more = self, self.stribeck
        if isinstance(self.coefficient, str) and self.coefficient in values:
            out = replace(
                out, coefficient=real_number(self.coefficient, values[self.coefficient]), name=self.coefficient
            )
        if more is None:
            return out
        if isinstance(more.coefficient, str) and more.coefficient in values:
            name = more.coefficient
            more = replace(more, coefficient=real_number(name, values[name]), name=name)
        if isinstance(more.speed, str) and more.speed in values:
            name = more.speed
            more = replace(more, speed=real_number(name, values[name]), speed_name=name)
        return replace(out, more=more)

    def written(self, output: str) -> str:
        """Write the terms in words."""
        near = "" if self.stribeck is None else f" {self.stribeck.written(output)}"
        return f"- {_sized(self.coefficient, self.factor)} sign(D {output}){near}"


def _sized(coefficient: str | float, factor: float) -> str:
    """A coefficient of friction with its factor, the sign left out."""
    if isinstance(coefficient, str):
        return coefficient if factor == -1 else f"{-factor!r} {coefficient}"
    return f"{-factor * coefficient!r}"


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
    coulomb
        Friction of the output's own velocity, of Coulomb and near rest of Stribeck, if there is some; alpha then lies
        in (1, 2], and every order below alpha.

    Raises
    ------
    ModelError
        No term, a coefficient that stands twice, an order or a number out of its range.
    """

    output: str
    order: Order
    terms: tuple[Term, ...]
    # Absent where there is none, so that what is written of an equation without it is as it was.
    coulomb: Friction | UnsetType = UNSET

    def __post_init__(self) -> None:
        if not self.terms:
            raise ModelError(f"the equation of {self.output} has no term; add at least one")
        names = list(self.coefficient_names)
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

        if self.friction is not None:
            self._check_friction(self.friction)

    def _check_friction(self, friction: Friction) -> None:
        """Refuse friction that drives, and orders beside which a velocity has no meaning."""
        words = f"friction in the equation of {self.output}"
        terms: list[Friction | Stribeck] = [friction] if friction.stribeck is None else [friction, friction.stribeck]
        for term in terms:
            if not (math.isfinite(term.factor) and term.factor < 0):
                raise ModelError(
                    f"{words} has the factor {term.factor:g}, but friction takes energy: write "
                    f"'- fc*sign(D {self.output})'"
                )
            if term.strength is not None and not 0 <= term.strength < math.inf:
                raise ModelError(
                    f"{words} has the coefficient {term.coefficient!r}; it is not negative: the sign is in the term"
                )
        if friction.stribeck is not None and not isinstance(friction.stribeck.speed, str):
            speed = friction.stribeck.speed
            if not 0 < speed < math.inf:
                raise ModelError(
                    f"{words} falls with speed at vs = {speed:g}; a speed is positive: give one, in units of "
                    f"{self.output} per s"
                )
        if self.order.names:
            return
        alpha = self.order.constant
        if not 1 < alpha <= 2:
            raise ModelError(
                f"{words} acts on its velocity, but alpha = {alpha:g} is outside (1, 2]; leave it out, or choose "
                "another order"
            )

    def check_drives(self, outputs: Sequence[str]) -> None:
        """Refuse inputs that jump in the velocity of a body; outputs that are followed have inertia of their own.

        Raises
        ------
        ModelError
            An input of alpha or above, as far as both are numbers.
        """
        for item in self.terms:
            known = not (self.order.names or item.order.names or item.signal in outputs)
            if known and item.order.constant >= self.order.constant - 1e-9:
                raise ModelError(
                    f"order {item.order.constant:g} of {item.signal} is not below alpha = {self.order.constant:g}, and "
                    f"friction in the equation of {self.output} then has no velocity to follow; lower it"
                )

    @property
    def friction(self) -> Friction | None:
        """Friction of the output's own velocity; None without."""
        return self.coulomb if isinstance(self.coulomb, Friction) else None

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
        friction = () if self.friction is None else self.friction.names
        return (*(t.coefficient for t in self.terms if isinstance(t.coefficient, str)), *friction)

    def with_orders(self, values: Mapping[str, float]) -> Equation:
        """Return the equation with these free orders replaced by values; others stay free.

        Raises
        ------
        ModelError
            Orders out of range once they are numbers.
        """
        terms = tuple(replace(t, order=t.order.partly(values)) for t in self.terms)
        return Equation(self.output, self.order.partly(values), terms, self.coulomb)

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
        coulomb = self.coulomb.with_coefficients(values) if isinstance(self.coulomb, Friction) else self.coulomb
        return Equation(self.output, self.order, terms, coulomb)

    @property
    def is_identified(self) -> bool:
        """Whether every order and every coefficient is a number."""
        return not self.order_names and not self.coefficient_names

    def written(self, inputs: Mapping[str, str]) -> str:
        """Write the equation, inputs as they act."""
        right = " + ".join(t.written(inputs.get(t.signal, t.signal)) for t in self.terms).replace("+ -", "- ")
        friction = "" if self.friction is None else f" {self.friction.written(self.output)}"
        return f"{derivative(self.order, self.output)} = {right}{friction}"

    def __str__(self) -> str:
        return self.written({})


def numeric(item: Equation, inputs: Mapping[str, str] | None = None) -> str:
    """Write an identified equation with six significant digits, inputs as they act: ``u(t - 0.035 s)``."""
    texts = inputs or {}
    parts = [f"{t.fixed or 0.0:+.6g} {derivative(t.order, texts.get(t.signal, t.signal))}" for t in item.terms]
    right = " ".join([parts[0].removeprefix("+"), *(f"{p[0]} {p[1:]}" for p in parts[1:])])
    if item.friction is not None:
        fc, fs, vs = item.friction.law
        right += f" - {fc:.6g} sign(D {item.output})"
        if item.friction.stribeck is not None:
            right += f" - {fs:.6g} exp(-(D {item.output}/{vs:.6g})^2) sign(D {item.output})"
    return f"{derivative(item.order, item.output)} = {right}"
