"""Simpler problems inside a joint fit's, whose optima it starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ftlm import _core
from ftlm.base.errors import FtlmError
from ftlm.data.orders import Order
from ftlm.data.run import Run
from ftlm.data.structures import Hints, History
from ftlm.fit.grid import Attempt
from ftlm.fit.problem import FreeProblem
from ftlm.fit.starts import whole_orders

#: Whole orders that stand for a free one, and how many points of them a race looks at.
WHOLE = (0.0, 1.0, 2.0, 3.0)
MOST_WHOLE = 12
#: A pole of this many radians a sample is faster than the samples see.
FAST_POLE = 0.2


@dataclass(frozen=True)
class LowerOrder:
    """A problem one of whose equations ends with its highest own term: what is left of it behind a fast pole.

    The coefficient of that term, but for its known factor, is 1 there, and `fast` where the pole is; `others` are the
    coefficients of the equation's other terms.
    """

    problem: FreeProblem
    coefficient: str
    factor: float
    others: tuple[str, ...]
    fast: float

    def embedded(self, attempt: Attempt, whole: FreeProblem) -> Attempt:
        """The same dynamics in the whole problem, but for what is faster than the sampling."""
        values = dict(zip(self.problem.coefficients, attempt.coefficients, strict=True))
        values |= {n: self.fast * values[n] for n in self.others}
        values[self.coefficient] = -self.fast / self.factor
        known = dict(zip(self.problem.orders, attempt.orders, strict=True))
        return replace(
            attempt,
            orders=[known[n] for n in whole.orders],
            coefficients=[values[n] for n in whole.coefficients],
            origin=f"{attempt.origin}, from the equation of lower order",
        )


def lower_orders(problem: FreeProblem, runs: Sequence[Run]) -> list[LowerOrder]:
    """The problem of lower order of one equation whose own orders are numbers; free orders get there by themselves."""
    structure = problem.structure
    if structure.has_order_law or problem.products or len(structure.equations) > 1:
        return []
    step = max(run.step for run in runs)
    item = structure.equations[0]
    own = [t for t in item.terms if t.signal == item.output]
    if item.order.names or not own or any(t.order.names for t in own):
        return []
    highest = max(own, key=lambda t: t.order.constant)
    rest = tuple(t for t in item.terms if t is not highest)
    known = any(t.fixed is not None or t.coefficient == highest.coefficient for t in rest)
    if not isinstance(highest.coefficient, str) or highest.order.constant <= 0 or known:
        return []
    initial = structure.initial
    if not isinstance(initial, (str, History)):
        # A power of t that the equation of lower order integrates to would be a drive.
        initial = tuple(e for e in initial if e < highest.order.constant)
    if any(not t.order.names and t.order.constant > highest.order.constant for t in rest if t.signal != item.output):
        # Another signal would stand above the order of the lower equation: it cannot where it holds between samples.
        return []
    try:
        lower = replace(item, order=highest.order, terms=rest)
        reduced = FreeProblem.of(replace(structure, equations=(lower,), initial=initial))
    except FtlmError:
        # A term of another signal differentiates more often than the equation of lower order integrates.
        return []
    fast = (FAST_POLE / step) ** (item.order.constant - highest.order.constant)
    names = tuple(t.coefficient for t in rest if isinstance(t.coefficient, str))
    return [LowerOrder(reduced, highest.coefficient, highest.factor, names, fast)]


@dataclass(frozen=True)
class Simpler:
    """A problem with one term less, or known: its coefficient, and the highest order of the equation that lacks it.

    Whether it is an equation driven by measured signals, all of which it still has.
    """

    problem: FreeProblem
    coefficient: str
    order: Order
    value: float = 0.0
    driven: bool = False

    def without(self, attempt: Attempt, whole: FreeProblem) -> Attempt:
        """A point of the whole problem as a start of this one."""
        orders = dict(zip(whole.orders, attempt.orders, strict=True))
        values = dict(zip(whole.coefficients, attempt.coefficients, strict=True))
        return replace(
            attempt,
            orders=[orders[n] for n in self.problem.orders],
            coefficients=[values[n] for n in self.problem.coefficients],
            outcome={},
            alike=(),
        )

    def embedded(self, attempt: Attempt, whole: FreeProblem) -> Attempt:
        """The same point of the whole problem; the order of a term that is 0 may be any, so it is half the highest."""
        known = dict(zip(self.problem.orders, attempt.orders, strict=True))
        highest = self.order.constant + sum(w * known[n] for n, w in self.order.weights)
        values = dict(zip(self.problem.coefficients, attempt.coefficients, strict=True))
        return replace(
            attempt,
            orders=[known.get(n, 0.5 * highest) for n in whole.orders],
            coefficients=[values.get(n, self.value) for n in whole.coefficients],
            origin=f"{attempt.origin}, from {self.coefficient} = {self.value:g}",
        )


@dataclass(frozen=True)
class Whole:
    """A problem with every free order at a whole value: what a fractional one is to be better than."""

    problem: FreeProblem
    orders: tuple[float, ...]

    def embedded(self, attempt: Attempt, whole: FreeProblem) -> Attempt:
        """The same point of the whole problem."""
        return replace(attempt, orders=list(self.orders), origin=f"{attempt.origin}, from whole orders")


@dataclass(frozen=True)
class Held:
    """A problem with one free order at the whole value that the equation would have, the others still free."""

    problem: FreeProblem
    order: int
    value: float

    def without(self, attempt: Attempt, whole: FreeProblem, clock: _core.JointClock) -> Attempt:
        """A point of the whole problem as a start of this one: coefficients keep their numbers in the clock's unit."""
        told = clock.told(attempt.values)
        told[self.order] = self.value
        orders, coefficients, inputs = whole.split(clock.untold(told).tolist())
        del orders[self.order]
        return replace(attempt, orders=orders, coefficients=coefficients, inputs=inputs, outcome={}, alike=())

    def embedded(self, attempt: Attempt, name: str) -> Attempt:
        """The same point of the whole problem."""
        orders = [*attempt.orders[: self.order], self.value, *attempt.orders[self.order :]]
        return replace(attempt, orders=orders, origin=f"{attempt.origin}, from {name} = {self.value:g}")


def held(problem: FreeProblem) -> list[Held]:
    """Problems with one order less, where there are several: none may end below the whole one."""
    out = []
    for place, (name, value) in enumerate(zip(problem.orders, whole_orders(problem), strict=True)):
        if len(problem.orders) < 2 or value != round(value):
            continue
        try:
            reduced = FreeProblem.of(problem.structure.with_orders({name: value}))
        except FtlmError:
            # Two terms of a signal have become one.
            continue
        rest = tuple(n for n in problem.orders if n != name)
        if reduced.coefficients == problem.coefficients and reduced.orders == rest:
            out.append(Held(reduced, place, value))
    return out


def whole(problem: FreeProblem, near: Sequence[float]) -> list[Whole]:
    """The problem with whole orders: the usual ones, those nearest to a point, and each with one of them at another.

    Between two whole orders the coefficient of what drives may change its sign, and no descent crosses that: what is
    nearest need not be what is lowest. None where they make no equation.
    """
    natural = (problem.structure.hints or Hints()).natural
    usual = whole_orders(problem)
    values: list[list[float]] = []
    points: list[list[float]] = []
    for name, (low, high) in zip(problem.orders, problem.bounds, strict=True):
        known = [v for v in natural.get(name, ()) if v == round(v)] or WHOLE
        values.append([v for v in known if low <= v <= high])
    if not values or not all(values):
        return []
    for point in (usual, near):
        first = [_nearest(v, at) for v, at in zip(values, point, strict=True)]
        points += [first, *([*first[:k], w, *first[k + 1 :]] for k, v in enumerate(values) for w in v if w != first[k])]
    each = {tuple(point): None for point in points}
    return [found for orders in each if (found := _at_whole(problem, orders)) is not None][:MOST_WHOLE]


def _nearest(values: Sequence[float], at: float) -> float:
    return min(values, key=lambda v: abs(v - at))


def _at_whole(problem: FreeProblem, orders: Sequence[float]) -> Whole | None:
    """The problem at some whole orders, if they make an equation."""
    try:
        reduced = FreeProblem.of(problem.structure.with_orders(dict(zip(problem.orders, orders, strict=True))))
    except FtlmError:
        # Two terms of a signal have become one.
        return None
    # Terms in the order in which they stand, so coefficients keep their places.
    return Whole(reduced, tuple(orders)) if reduced.coefficients == problem.coefficients else None


def simpler(problem: FreeProblem) -> list[Simpler]:
    """Problems with one term less; none under a law, where no coefficient can be 0 by itself.

    A term of a measured signal is left out where it is not the only one that drives: signals of one machine go with
    each other, and where one stands for the rest there is an optimum that tells nothing of the machine. For the same
    reason a coefficient that physics knows is held there first.
    """
    structure = problem.structure
    if structure.has_order_law or problem.products:
        return []
    out = []
    for place, item in enumerate(structure.equations):
        own = [t for t in item.terms if t.signal == item.output]
        for term in own if len(own) > 1 else []:
            if not isinstance(term.coefficient, str):
                continue
            rest = replace(item, terms=tuple(t for t in item.terms if t is not term))
            equations = (*structure.equations[:place], rest, *structure.equations[place + 1 :])
            names = {n for e in equations for n in e.order_names}
            values = {n: v for n, v in structure.order_values.items() if n in names}
            reduced = replace(structure, equations=equations, order_values=values)
            out.append(Simpler(FreeProblem.of(reduced), term.coefficient, item.order))
        driving = [t for t in item.terms if t.signal != item.output and isinstance(t.coefficient, str)]
        if structure.coupling == "measured" and len(driving) > 1:
            # The signal stays, at 0: records have it.
            out += [
                Simpler(
                    FreeProblem.of(structure.with_coefficients({t.coefficient: 0.0})),
                    t.coefficient,
                    item.order,
                    driven=True,
                )
                for t in driving
                if isinstance(t.coefficient, str) and not t.order.names
            ]
        known = (structure.hints or Hints()).known
        for name in [n for n in item.coefficient_names if n in known]:
            held = structure.with_coefficients({name: known[name]})
            out.append(Simpler(FreeProblem.of(held), name, item.order, known[name], driven=True))
    return out


def unlike(problems: Sequence[Simpler]) -> list[Simpler]:
    """One of those that are one equation but for the names of its free numbers: of two terms alike either may go."""
    kept: dict[object, Simpler] = {}
    for less in problems:
        structure = less.problem.structure
        alone = len(structure.equations) == 1 and not less.driven and not structure.delay
        kept.setdefault(_nameless(less.problem) if alone else id(less), less)
    return list(kept.values())


def _nameless(problem: FreeProblem) -> tuple[object, ...]:
    """The equation of a problem, its terms in an order of their own, and bounds in place of the names of orders."""
    (item,), bounds = problem.structure.equations, dict(zip(problem.orders, problem.bounds, strict=True))

    def of(order: Order) -> tuple[object, ...]:
        return order.constant, *((w, bounds[n]) for n, w in order.weights)

    terms = [(t.signal, of(t.order), t.fixed, t.factor) for t in item.terms]
    return item.output, of(item.order), *sorted(terms, key=repr)
