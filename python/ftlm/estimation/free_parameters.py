"""Free parameters of a structure: bounds, warm starts, time scaling and collinear inputs."""

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
from ftlm.data.sampling import interpolate_gaps
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.simulation.discretization import affine, derived_signals, initial_tuple
from ftlm.simulation.nonlinear_columns import record_signals
from ftlm.structure.equation import Friction, Stribeck
from ftlm.structure.input_nonlinearity import FreeInputParameter
from ftlm.structure.order import Order
from ftlm.structure.structure import Hints, History, Offset, Structure
from ftlm.utils.linalg import dot, vector_norm
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import Floats, check_known, real_number


@dataclass(frozen=True)
class FreeProblem:
    """Estimation problem: a structure with chosen initial terms, and its free parameters.

    The class wraps the problem of the compiled core.

    Every order of the equations is an affine function of free orders. Every coefficient is a product of free
    coefficients.
    """

    structure: Structure

    @cached_property
    def core(self) -> _core.JointProblem:
        """Same problem as an object of the compiled core."""
        return _core.JointProblem(core_arguments(self.structure))

    @cached_property
    def orders(self) -> tuple[str, ...]:
        """Names of the free orders."""
        return tuple(self.core.orders)

    @cached_property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the free coefficients, including the factors of a coefficient law."""
        return tuple(self.core.coefficients)

    @cached_property
    def products(self) -> Mapping[str, tuple[float, tuple[str, ...]]]:
        """Coefficients that follow from a coefficient law: (sign, names of the factors) by name."""
        return {name: (sign, tuple(factors)) for name, sign, factors in self.core.products}

    @cached_property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Bounds (low, high) of each free order."""
        return tuple(self.core.bounds[: len(self.orders)])

    @property
    def inputs(self) -> tuple[FreeInputParameter, ...]:
        """Free delays, saturations and dead zones of inputs."""
        return self.structure.free_input_parameters

    @property
    def names(self) -> list[str]:
        """Names of all free parameters: orders, coefficients, then input parameters."""
        return [*self.orders, *self.coefficients, *(item.name for item in self.inputs)]

    def split(self, values: Sequence[float]) -> tuple[list[float], list[float], list[float]]:
        """Split a vector of all free parameters into orders, coefficients and input parameters."""
        flat = list(map(float, values))
        first, second = len(self.orders), len(self.orders) + len(self.coefficients)
        return flat[:first], flat[first:second], flat[second:]

    @classmethod
    def of(cls, structure: Structure) -> FreeProblem:
        """Return the problem of a structure; raise ModelError if the core does not support the structure."""
        problem = cls(structure)
        _ = problem.core
        return problem

    @property
    def all_bounds(self) -> list[tuple[float, float]]:
        """Bounds (low, high) of all free parameters.

        Coefficients of friction have a lower bound, so that friction dissipates energy. Other coefficients have
        infinite bounds.
        """
        return self.core.bounds

    def feasible_point(self, at: Floats, target: Floats) -> Floats:
        """Return the last point within all constraints on the line from a feasible point to another point."""
        return self.core.feasible(at, target)

    def coefficients_by_name(self, values: Sequence[float]) -> dict[str, float]:
        """Return all coefficients of the structure by name, from the values of the free ones."""
        free = dict(zip(self.coefficients, map(float, values), strict=True))
        out: dict[str, float] = {}
        for name in self.structure.coefficient_names:
            sign, factors = self.products.get(name, (1.0, (name,)))
            out[name] = sign * float(np.prod([free[f] for f in factors]))
        return out

    def model_parameter_jacobian(self, coefficients: Sequence[float]) -> Floats:
        """Return the Jacobian of the model's orders and coefficients (rows) by the free parameters (columns).

        Rows are, for each equation: its order, then order and coefficient of each term, then the friction coefficient
        if present, followed by coefficient and speed of a Stribeck term. Input parameters have no rows.
        """
        free = dict(zip(self.coefficients, coefficients, strict=True))
        count, input_count = len(self.orders), len(self.inputs)
        rows = []

        def of_order(order: Order) -> Floats:
            return np.array(affine(order, self.orders)[1] + [0.0] * (len(free) + input_count))

        for equation in self.structure.equations:
            rows.append(of_order(equation.order))
            for term in equation.terms:
                row = np.zeros(count + len(free) + input_count)
                if isinstance(term.coefficient, str):
                    sign, factors = self.products.get(term.coefficient, (1.0, (term.coefficient,)))
                    for k, name in enumerate(factors):
                        other_factors = [free[f] for j, f in enumerate(factors) if j != k]
                        row[count + list(free).index(name)] += term.factor * sign * math.prod(other_factors)
                rows += [of_order(term.order), row]
            friction, stribeck = equation.friction, None if equation.friction is None else equation.friction.stribeck
            friction_parameters = [] if friction is None else [friction.coefficient]
            for friction_parameter in friction_parameters + (
                [] if stribeck is None else [stribeck.coefficient, stribeck.speed]
            ):
                row = np.zeros(count + len(free) + input_count)
                if isinstance(friction_parameter, str):
                    row[count + list(free).index(friction_parameter)] = 1.0
                rows.append(row)
        return np.stack(rows)


def core_arguments(structure: Structure) -> Any:
    """Return the arguments, by keyword, from which the compiled core builds a structure with chosen initial terms."""
    signals, hints = record_signals(structure), structure.hints or Hints()
    states = structure.filter_states(structure.initial)
    # The free parameters do not depend on an offset that is not decided yet.
    offset: Offset = "none" if structure.offset == "auto" else structure.offset

    def order(value: Order) -> tuple[float, list[tuple[str, float]]]:
        return value.constant, list(value.weights)

    def friction(term: Friction | None) -> list[tuple[float, str | float]] | None:
        if term is None:
            return None
        stribeck = term.stribeck or Stribeck(0.0, 1.0)
        return [(-term.factor, term.coefficient), (-stribeck.factor, stribeck.coefficient), (1.0, stribeck.speed)]

    equations = [
        (
            signals.index(e.output),
            order(e.order),
            # Terms are sorted, so that rounding errors do not depend on the order in which the terms are written.
            sorted(
                ((signals.index(t.column), order(t.order), t.coefficient, t.factor) for t in e.terms),
                key=lambda term: (term[0] != signals.index(e.output), term[0], -term[1][0], repr(term)),
            ),
            friction(e.friction),
        )
        for e in structure.equations
    ]
    return {
        "signals": list(signals),
        "derived": derived_signals(structure),
        "equations": equations,
        "bounds": [(name, (values[0], values[-1])) for name, values in structure.order_values.items()],
        "priors": list((structure.priors or {}).items()),
        "coupled": structure.coupling == "simulated",
        "delayed": bool(structure.delay),
        "initial": initial_tuple(structure.initial, offset, states),
        "history": isinstance(structure.initial, History),
        "inputs": [(i.name, signals.index(i.signal), i.kind, i.bounds) for i in structure.free_input_parameters],
        "laws": list(structure.coefficient_law),
        "hints": {
            "highest": hints.highest_order_range,
            "natural": [(name, list(values)) for name, values in hints.nominal_orders.items()],
            "exceeds": list(hints.min_ratios.items()),
            "positive": list(hints.positive_coefficients),
            "known": list(hints.nominal_coefficients.items()),
        },
    }


#: Integer initial values of an order for which no value is given, and maximum number of warm starts.
DEFAULT_START_ORDERS = (0.0, 1.0, 2.0)
MAX_WARM_STARTS = 9


def warm_starts(problem: FreeProblem, guess: Mapping[str, float]) -> list[dict[str, float]]:
    """Return complete initial guesses from values of some free parameters by name.

    A coefficient without a value is 0 in each guess, so its term has no effect at first. An order without a value takes
    each integer within its bounds, and every combination gives one guess, up to nine.

    Raises
    ------
    ModelError
        If a name is not a free parameter, no value is given, or a value is not a number within its bounds.
    """
    bounds = dict(zip(problem.names, problem.all_bounds, strict=True))
    check_known("start value", guess, problem.names)
    if not guess:
        raise ModelError(f"{parameter('start')} names no free parameter; give values of {', '.join(problem.names)}")
    for name, value in guess.items():
        low, high = bounds[name]
        if not low <= real_number(f"start value of {name}", value) <= high:
            raise ModelError(
                f"{parameter('start')} has {name} = {value:g}, out of its bounds {low:g} to {high:g}; widen them"
            )
    grid_values: dict[str, list[float]] = {}
    for name, (low, high) in bounds.items():
        if name in guess:
            grid_values[name] = [float(guess[name])]
        elif name in problem.orders:
            grid_values[name] = [v for v in DEFAULT_START_ORDERS if low <= v <= high] or [0.5 * (low + high)]
        else:
            grid_values[name] = [0.0 if low <= 0.0 <= high else low if math.isfinite(low) else high]
    points = itertools.islice(itertools.product(*grid_values.values()), MAX_WARM_STARTS)
    return [dict(zip(grid_values, point, strict=True)) for point in points]


def values_of_model(problem: FreeProblem, model: Model, additional_values: Mapping[str, float]) -> dict[str, float]:
    """Return the values that a model of the same outputs assigns to the free parameters of a problem, by name.

    `additional_values` adds values of the factors of a coefficient law. A fixed order of the model gives a value to the
    free order of the term that has the same coefficient.

    Raises
    ------
    ModelError
        If the model has an output that the problem lacks.
    """
    check_known("output of start", model.outputs, problem.structure.outputs)
    values = {**model.orders, **model.coefficients, **additional_values}
    items = {e.output: e for e in model.equations}

    def set_order(order: Order, value: Order) -> None:
        if order.is_single and not value.names:
            values.setdefault(order.names[0], value.constant)

    for equation in problem.structure.equations:
        other = items.get(equation.output)
        if other is None:
            continue
        set_order(equation.order, other.order)
        terms_by_name = {t.name: t for t in other.terms if t.name is not None}
        for term in equation.terms:
            if term.coefficient in terms_by_name:
                set_order(term.order, terms_by_name[str(term.coefficient)].order)
    return {n: v for n, v in values.items() if n in problem.names}


#: Relative difference, as by rounding in files, up to which two signals count as multiples of each other.
COLLINEARITY_TOLERANCE = 1e-9


def describe_collinear_inputs(runs: Sequence[Run], structure: Structure) -> str | None:
    """Return a message that names two proportional inputs which enter one equation with the same order, or None."""
    for equation in structure.equations:
        linear = [t for t in equation.terms if t.nonlinear is None]
        input_terms = [
            t
            for t in linear
            if t.signal != equation.output and isinstance(t.coefficient, str) and all(t.signal in run for run in runs)
        ]
        for term, other_term in itertools.combinations(input_terms, 2):
            if term.signal == other_term.signal or term.order != other_term.order:
                continue
            first, second = (
                np.concatenate([interpolate_gaps(run[t.signal]) for run in runs]) for t in (term, other_term)
            )
            power = dot(first, first)
            ratio = dot(first, second) / power if power > 0 else 0.0
            if vector_norm(second - ratio * first) <= COLLINEARITY_TOLERANCE * vector_norm(second):
                return (
                    f"{other_term.signal} is {ratio:.6g} times {term.signal} on every run, so their effects are not "
                    f"separately identifiable: leave out the term of {other_term.coefficient} or that of "
                    f"{term.coefficient}, "
                    "fix one of them, or add a run in which the two signals differ"
                )
    return None
