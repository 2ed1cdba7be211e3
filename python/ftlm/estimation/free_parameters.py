"""What is free in a joint fit, as the core takes it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import bridged
from ftlm.errors import ModelError
from ftlm.model.model import Solved
from ftlm.simulation.discretization import affine, initial_tuple
from ftlm.structure.equation import Friction, Stribeck
from ftlm.structure.input_nonlinearity import FreeInput
from ftlm.structure.order import Order
from ftlm.structure.structure import Hints, History, Offset, Structure
from ftlm.utils.linalg import dot, length
from ftlm.utils.validation import Floats, check_known, real_number


@dataclass(frozen=True)
class FreeProblem:
    """A structure, its initial terms decided, as the core takes it.

    Orders are affine in free ones, coefficients products of free ones.
    """

    structure: Structure

    @cached_property
    def core(self) -> _core.JointProblem:
        """What the core makes of the structure."""
        return _core.JointProblem(told(self.structure))

    @cached_property
    def orders(self) -> tuple[str, ...]:
        """Free orders."""
        return tuple(self.core.orders)

    @cached_property
    def coefficients(self) -> tuple[str, ...]:
        """Free coefficients, those of a law among them."""
        return tuple(self.core.coefficients)

    @cached_property
    def products(self) -> Mapping[str, tuple[float, tuple[str, ...]]]:
        """Coefficients that a law gives: sign and factors by name."""
        return {name: (sign, tuple(factors)) for name, sign, factors in self.core.products}

    @cached_property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Bounds of the free orders."""
        return tuple(self.core.bounds[: len(self.orders)])

    @property
    def inputs(self) -> tuple[FreeInput, ...]:
        """Free numbers of inputs."""
        return self.structure.free_inputs

    @property
    def names(self) -> list[str]:
        """Everything that is free: orders, coefficients, then numbers of inputs."""
        return [*self.orders, *self.coefficients, *(item.name for item in self.inputs)]

    def split(self, values: Sequence[float]) -> tuple[list[float], list[float], list[float]]:
        """Values of orders, coefficients and numbers of inputs."""
        flat = list(map(float, values))
        first, second = len(self.orders), len(self.orders) + len(self.coefficients)
        return flat[:first], flat[first:second], flat[second:]

    @classmethod
    def of(cls, structure: Structure) -> FreeProblem:
        """The same, refused at once where the core cannot take it."""
        problem = cls(structure)
        _ = problem.core
        return problem

    @property
    def all_bounds(self) -> list[tuple[float, float]]:
        """Bounds of everything that is free; those of coefficients are infinite, but friction takes energy."""
        return self.core.bounds

    def feasible(self, at: Floats, towards: Floats) -> Floats:
        """The last point on the way from a feasible one to another that keeps bounds and constraints of orders."""
        return self.core.feasible(at, towards)

    def named(self, values: Sequence[float]) -> dict[str, float]:
        """Every coefficient of the structure by name from the free ones."""
        free = dict(zip(self.coefficients, map(float, values), strict=True))
        out: dict[str, float] = {}
        for name in self.structure.coefficient_names:
            sign, factors = self.products.get(name, (1.0, (name,)))
            out[name] = sign * float(np.prod([free[f] for f in factors]))
        return out

    def number_jacobian(self, orders: Sequence[float], coefficients: Sequence[float]) -> Floats:
        """Derivatives of a model's numbers (rows) with respect to everything that is free (columns).

        Rows are, equation by equation, alpha, then order and coefficient of each term, then the coefficient of friction
        where there is some (of Stribeck's term after it fs and vs); numbers of inputs are none of them.
        """
        free = dict(zip(self.coefficients, coefficients, strict=True))
        count, idle = len(self.orders), len(self.inputs)
        rows = []

        def of_order(order: Order) -> Floats:
            return np.array(affine(order, self.orders)[1] + [0.0] * (len(free) + idle))

        for item in self.structure.equations:
            rows.append(of_order(item.order))
            for term in item.terms:
                row = np.zeros(count + len(free) + idle)
                if isinstance(term.coefficient, str):
                    sign, factors = self.products.get(term.coefficient, (1.0, (term.coefficient,)))
                    for k, name in enumerate(factors):
                        others = [free[f] for j, f in enumerate(factors) if j != k]
                        row[count + list(free).index(name)] += term.factor * sign * math.prod(others)
                rows += [of_order(term.order), row]
            rubs, more = item.friction, None if item.friction is None else item.friction.stribeck
            numbers = [] if rubs is None else [rubs.coefficient]
            for number in numbers + ([] if more is None else [more.coefficient, more.speed]):
                row = np.zeros(count + len(free) + idle)
                if isinstance(number, str):
                    row[count + list(free).index(number)] = 1.0
                rows.append(row)
        return np.stack(rows)

    def free_from(self, estimated: Mapping[str, float]) -> list[float]:
        """Free coefficients from freely estimated ones; ratios as the median of what the equations can say."""
        return self.core.free_from(dict(estimated))


def told(structure: Structure) -> Any:
    """A structure, its initial terms decided, as the core takes it."""
    signals, hints = structure.signals, structure.hints or Hints()
    states = structure.filter_states(structure.initial)
    # What is free does not hang on an offset that is still to be decided.
    offset: Offset = "none" if structure.offset == "auto" else structure.offset

    def order(of: Order) -> tuple[float, list[tuple[str, float]]]:
        return of.constant, list(of.weights)

    def friction(rubs: Friction | None) -> list[tuple[float, str | float]] | None:
        if rubs is None:
            return None
        more = rubs.stribeck or Stribeck(0.0, 1.0)
        return [(-rubs.factor, rubs.coefficient), (-more.factor, more.coefficient), (1.0, more.speed)]

    equations = [
        (
            signals.index(e.output),
            order(e.order),
            [(signals.index(t.signal), order(t.order), t.coefficient, t.factor) for t in e.terms],
            friction(e.friction),
        )
        for e in structure.equations
    ]
    return {
        "signals": list(signals),
        "equations": equations,
        "bounds": [(name, (values[0], values[-1])) for name, values in structure.order_values.items()],
        "coupled": structure.coupling == "simulated",
        "delayed": bool(structure.delay),
        "initial": initial_tuple(structure.initial, offset, states),
        "history": isinstance(structure.initial, History),
        "inputs": [(i.name, signals.index(i.signal), i.law, i.bounds) for i in structure.free_inputs],
        "laws": list(structure.coefficient_law),
        "hints": {
            "highest": hints.highest,
            "natural": [(name, list(values)) for name, values in hints.natural.items()],
            "exceeds": list(hints.exceeds.items()),
            "positive": list(hints.positive),
            "known": list(hints.known.items()),
        },
    }


#: Whole orders at which a term starts that what is known does not have, and how many starts that may make.
WHOLE = (0.0, 1.0, 2.0)
MOST = 9


def known_starts(problem: FreeProblem, known: Mapping[str, float]) -> list[dict[str, float]]:
    """Starts from values by name; what they lack has the coefficient 0, so that it does nothing at first.

    An order that they lack starts at each whole value within its bounds.

    Raises
    ------
    ModelError
        A name that is not free, nothing that is, or a value that is none or out of its bounds.
    """
    bounds = dict(zip(problem.names, problem.all_bounds, strict=True))
    check_known("start value", known, problem.names)
    if not known:
        raise ModelError(f"start= has none of the numbers that are free: {', '.join(problem.names)}")
    for name, value in known.items():
        low, high = bounds[name]
        if not low <= real_number(f"start value of {name}", value) <= high:
            raise ModelError(f"start= has {name} = {value:g}, out of its bounds {low:g} to {high:g}; widen them")
    places: dict[str, list[float]] = {}
    for name, (low, high) in bounds.items():
        if name in known:
            places[name] = [float(known[name])]
        elif name in problem.orders:
            places[name] = [v for v in WHOLE if low <= v <= high] or [0.5 * (low + high)]
        else:
            places[name] = [0.0 if low <= 0.0 <= high else low if math.isfinite(low) else high]
    points = itertools.islice(itertools.product(*places.values()), MOST)
    return [dict(zip(places, point, strict=True)) for point in points]


def values_of_model(problem: FreeProblem, model: Solved, more: Mapping[str, float]) -> dict[str, float]:
    """What a model of the same outputs knows of a problem's numbers; ``more`` are those that it holds under a law.

    Orders that are free here and were numbers there are those of the same coefficient's term.

    Raises
    ------
    ModelError
        A model of other outputs.
    """
    check_known("output of start", model.outputs, problem.structure.outputs)
    found = {**model.orders, **model.coefficients, **more}
    there = {e.output: e for e in model.equations}

    def tell(order: Order, value: Order) -> None:
        if order.is_single and not value.names:
            found.setdefault(order.names[0], value.constant)

    for item in problem.structure.equations:
        other = there.get(item.output)
        if other is None:
            continue
        tell(item.order, other.order)
        named = {t.name: t for t in other.terms if t.name is not None}
        for term in item.terms:
            if term.coefficient in named:
                tell(term.order, named[str(term.coefficient)].order)
    return {n: v for n, v in found.items() if n in problem.names}


def spans(runs: Sequence[Run]) -> list[tuple[float, float]]:
    """Sample interval and duration of each run [s]."""
    return [(run.step, run.length * run.step) for run in runs]


def clock(problem: FreeProblem, runs: Sequence[Run]) -> _core.JointClock:
    """The unit of a frequency half way, in logarithms, between that of the runs and Nyquist's.

    A coefficient before D^nu y beside D^alpha y is a time to the power of -(alpha - nu), which free orders change.
    """
    return problem.core.clock(spans(runs))


#: Share of a signal's size that it may differ from a multiple of another one and still be one: rounding of files.
ROUNDED = 1e-9


def twin_words(runs: Sequence[Run], structure: Structure) -> str | None:
    """Which two signals with free coefficients drive an equation at the same order, one a multiple of the other."""
    for item in structure.equations:
        driving = [t for t in item.terms if t.signal != item.output and isinstance(t.coefficient, str)]
        for one, other in itertools.combinations(driving, 2):
            if one.signal == other.signal or one.order != other.order:
                continue
            first, second = (np.concatenate([bridged(run[t.signal]) for run in runs]) for t in (one, other))
            size = dot(first, first)
            ratio = dot(first, second) / size if size > 0 else 0.0
            if length(second - ratio * first) <= ROUNDED * length(second):
                return (
                    f"{other.signal} is {ratio:.6g} times {one.signal} on every run, which no run tells apart: leave "
                    f"out the term of {other.coefficient} or that of {one.coefficient}, fix one of them, or add a run "
                    "in which the two signals differ"
                )
    return None
