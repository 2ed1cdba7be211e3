"""Model structures: coupled equations with delays, offsets, initial conditions, and laws between coefficients."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from msgspec import UNSET, UnsetType

from ftlm.errors import ModelError
from ftlm.structure.equation import Equation, Term, format_equation
from ftlm.structure.input_nonlinearity import (
    FreeInputParameter,
    InputNonlinearity,
    Value,
    check_nonlinearities,
    input_name,
    replace_nonlinearities,
)
from ftlm.structure.order import Order, Values, format_shortest, parse_values
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.validation import check_choice, check_known, real_number


class History(tuple[float, ...]):
    """Exponents of t in the initial terms that represent unknown past inputs, selected from the data."""

    __slots__ = ()


Initial: TypeAlias = Literal["auto", "rest", "caputo", "history"] | tuple[float, ...]
Offset: TypeAlias = Literal["none", "level", "constant", "ramp", "auto"]
#: Accepted names of initial conditions; see :func:`ftlm.equation`.
INITIAL_CHOICES = ("auto", "rest", "caputo", "history")


def check_initial(initial: str | Iterable[float]) -> Initial:
    """Return initial conditions, a known name or exponents of t in (-1, 10]; raise ModelError for other values."""
    if isinstance(initial, str) and initial in INITIAL_CHOICES:
        return initial  # type: ignore[return-value]
    try:
        if isinstance(initial, str):
            raise TypeError
        exponents = tuple(real_number("exponent of an initial term", e) for e in initial)
    except TypeError:
        words = f"{', '.join(map(repr, INITIAL_CHOICES))} or exponents of t"
        raise ModelError(f"{setting('initial')} {initial!r} is not known; use {words}") from None
    bad = next((e for e in exponents if not (math.isfinite(e) and -1 < e <= 10)), None)
    if bad is not None:
        raise ModelError(f"exponent {bad:g} of an initial term is outside (-1, 10]; choose another exponent")
    return exponents


def check_offset(offset: str) -> Offset:
    """Return `offset` if it is an option of :class:`Structure`; raise ModelError otherwise."""
    if offset in ("none", "level", "constant", "ramp", "auto"):
        return offset  # type: ignore[return-value]
    raise ModelError(f"{setting('offset')} {offset!r} is not known; use 'none', 'level', 'constant', 'ramp' or 'auto'")


def check_offset_resolved(offset: str) -> None:
    """Raise ModelError if the offset is still ``"auto"``."""
    if offset == "auto":
        raise ModelError(
            f"{parameter('offset', 'auto')} lets ftlm.identify decide from the runs whether an equation has one; "
            f"here use {parameter('offset', 'none')} or {parameter('offset', 'constant')}"
        )


@dataclass(frozen=True)
class Hints:
    """Prior knowledge for the initial guesses of a fit, without bounds on the result.

    Parameters
    ----------
    highest_order_range
        (lower, upper) interval in which the highest order of an equation usually lies; None for a default interval.
    nominal_orders
        Typical values of free orders by name. They give additional initial guesses, but only if there are typical
        values for every free order.
    order_names_by_coefficient
        Names of free orders by the coefficient of their term. :meth:`Structure.equation` uses them for the free orders
        that replace expressions of an order law.
    min_ratios
        Physical lower bounds of factors in the coefficient law that are ratios of two coefficients, by name. The
        default is 1, which holds for a sum of inertias divided by one of them.
    positive_coefficients
        Names of physically positive coefficients that the coefficient law relates to another equation. Least squares
        can give them the wrong sign, so an additional initial guess uses the law with positive values.
    nominal_coefficients
        Nominal values of coefficients by name, which give an additional initial guess.
    """

    highest_order_range: tuple[float, float] | None = None
    nominal_orders: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    order_names_by_coefficient: Mapping[str, str] = field(default_factory=dict)
    min_ratios: Mapping[str, float] = field(default_factory=dict)
    positive_coefficients: tuple[str, ...] = ()
    nominal_coefficients: Mapping[str, float] = field(default_factory=dict)


@check_arguments
@dataclass(frozen=True)
class Structure:
    """Structure of a model: coupled fractional-order equations whose orders and coefficients may be free.

    Parameters
    ----------
    equations
        One equation per modeled output.
    order_values
        Ascending grid values of free orders by name, for those that have a grid.
    coupling
        ``"measured"``: the measured other outputs are inputs of each equation. ``"simulated"``: all outputs are
        simulated together from the inputs.
    delay
        Fixed delays of inputs [s] by name.
    free_delays
        (lower, upper) bounds of estimated input delays [s] by name.
    input_nonlinearities
        Saturations and dead zones of inputs, fixed or estimated.
    initial
        Initial conditions; see :func:`equation`.
    sensor_filter
        Known filter through which some signals were measured.
    coefficient_law
        Laws between coefficients, each as (name, sign, factors): the named coefficient is sign * product of factors.
    nominal_values
        Nominal values of coefficients by name, which are printed next to the estimates.
    name
        Name of the structure.
    hints
        Prior knowledge for initial guesses. Hints are not saved and do not affect equality of structures.
    priors
        (mean, standard deviation) of normal priors of free parameters by name, which :func:`ftlm.identify` sets. Like
        hints, they are not saved and do not affect equality.
    offset
        ``"none"``; ``"constant"``: an unknown constant on the right-hand side of each equation; ``"ramp"``: a constant
        and a constant times t; ``"level"``: an unknown constant that is added to each output; ``"auto"``: the
        identification decides between none and a constant. Offsets are estimated for each run, like initial terms, and
        are not transferred to another run. For a run that rests at nonzero values before an input changes, ``"none"``
        and ``"constant"`` are replaced by ``"level"`` (see `initial`).

    Raises
    ------
    ModelError
        If there is no equation, an output or coefficient is repeated, a delay, non-linearity or filter names an unknown
        signal, or friction is combined with an option that its simulation does not support.
    """

    equations: tuple[Equation, ...]
    order_values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    coupling: Literal["measured", "simulated"] = "measured"
    delay: Mapping[str, float] = field(default_factory=dict)
    free_delays: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    initial: Initial = "auto"
    sensor_filter: SensorFilter | None = None
    coefficient_law: tuple[tuple[str, float, tuple[str, ...]], ...] = ()
    nominal_values: Mapping[str, float] = field(default_factory=dict)
    name: str = "equation"
    hints: Hints | UnsetType = field(default=UNSET, repr=False, compare=False)
    offset: Offset = "none"
    # Omitted from digests and files when unset.
    input_nonlinearities: tuple[InputNonlinearity, ...] | UnsetType = UNSET
    priors: Mapping[str, tuple[float, float]] | UnsetType = field(default=UNSET, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not self.equations:
            raise ModelError("the structure has no equation; give at least one")
        outputs = [e.output for e in self.equations]
        duplicate = next((o for i, o in enumerate(outputs) if o in outputs[:i]), None)
        if duplicate is not None:
            raise ModelError(f"two equations have the output {duplicate}; give each output one equation")
        check_choice("coupling", self.coupling, ("measured", "simulated"))
        names = [n for e in self.equations for n in e.coefficient_names]
        duplicate = next((n for i, n in enumerate(names) if n in names[:i]), None)
        if duplicate is not None:
            raise ModelError(f"coefficient {duplicate} occurs in two equations; give each its own name")
        external = [s for s in self.signals if s not in outputs]
        check_known("delayed input", [*self.delay, *self.free_delays], external)
        for name, delay in self.delay.items():
            if not math.isfinite(real_number(f"delay of {name}", delay)):
                raise ModelError(f"delay of {name} = {delay} s is not a finite number; give seconds")
        for name, (low, high) in self.free_delays.items():
            numbers = real_number(f"minimum delay of {name}", low), real_number(f"maximum delay of {name}", high)
            if not -math.inf < numbers[0] < numbers[1] < math.inf:
                raise ModelError(
                    f"delay of {name} from {low} to {high} s is not an interval; give the smaller time first"
                )
        check_known("limited input", [limit.signal for limit in self.limits], external)
        check_nonlinearities(self.limits, self.delay, self.free_delays)
        for item in self.free_input_parameters:
            if item.name in names or item.name in self.order_names:
                raise ModelError(
                    f"{item.name} is the name of the {item.description}; give the coefficient another name"
                )
        if self.sensor_filter is not None:
            check_known("filtered signal", self.sensor_filter.signals, self.signals)
        self._check_offset()
        for equation in self.equations:
            if equation.friction is not None or equation.nonlinear_terms:
                equation.check_input_orders(self.outputs)
        if self.has_friction:
            self._check_friction()

    @property
    def has_friction(self) -> bool:
        """Whether at least one equation has friction."""
        return any(e.friction is not None for e in self.equations)

    @property
    def has_nonlinear_terms(self) -> bool:
        """Whether at least one equation has a non-linear term."""
        return any(e.nonlinear_terms for e in self.equations)

    @property
    def is_linear(self) -> bool:
        """Whether no equation has friction or a non-linear term."""
        return not (self.has_friction or self.has_nonlinear_terms)

    @property
    def integrates(self) -> bool:
        """Whether at least one equation contains only derivatives of its output, not the output itself."""
        return not all(
            any(term.signal == item.output and not term.order.names and term.order.constant == 0 for term in item.terms)
            for item in self.equations
        )

    @property
    def friction_equations(self) -> tuple[int, ...]:
        """Indices of the equations with friction."""
        return tuple(i for i, e in enumerate(self.equations) if e.friction is not None)

    def _check_friction(self) -> None:
        """Raise ModelError if friction is combined with an option that its simulation does not support.

        These are several equations with measured coupling, a filtered input, a coefficient law on a friction parameter,
        and a history as initial conditions.
        """
        friction_outputs = [self.equations[i].output for i in self.friction_equations]
        words = f"the equation of {friction_outputs[0]} has friction"
        if len(self.equations) > 1 and self.coupling == "measured":
            raise ModelError(
                f"{words}, but the structure has {len(self.equations)} equations with measured coupling, which are "
                f"not simulated together; give the equation of {friction_outputs[0]} a structure of its own, or "
                f"use {parameter('coupling', 'simulated')}"
            )
        if self.all_filtered:
            filtered = [s for s in self.signals if s not in self.outputs and self.is_filtered(s)]
            raise ModelError(
                f"{words}, and {' and '.join(filtered)}, an input of it, passed the sensor filter: friction acts "
                "before the filter, and the unfiltered input is not known; add an equation with this signal as output "
                f"and use {parameter('coupling', 'simulated')}, or exclude it from the filter"
            )
        tied = {n for name, _, factors in self.coefficient_law for n in (name, *factors)}
        names = [n for e in self.equations if e.friction is not None for n in e.friction.names if n in tied]
        if names:
            raise ModelError(
                f"{words}, and a coefficient law relates its {names[0]} to other coefficients; leave one of the two out"
            )
        if isinstance(self.initial, History) or self.initial == "history":
            raise ModelError(
                f"{words}: powers of t for unknown past inputs are not used with friction; use "
                f"{parameter('initial', 'caputo')} (level and velocity at the start), or begin the run at rest"
            )

    def _check_offset(self) -> None:
        """Raise ModelError if the offset is unknown, or if it and a given initial term are the same power of t."""
        check_offset(self.offset)
        if isinstance(self.initial, (str, History)):
            # An automatic initial term with the exponent of the offset is merged with the offset.
            return
        for item in self.equations:
            for power in [] if item.order.names else offset_exponents(item.order.constant, self.offset).values():
                if any(abs(power - e) < 1e-9 for e in self.initial):
                    raise ModelError(
                        f"the offset of {item.output} is t^{power:g} in its equation, and so is one of the initial "
                        f"terms {', '.join(f'{e:g}' for e in self.initial)}: they are not separately identifiable; "
                        f"leave {power:g} out of initial, or use {parameter('offset', 'none')}"
                    )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the modeled outputs, one per equation."""
        return tuple(e.output for e in self.equations)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of all signals: outputs in the sequence of their equations, then the others alphabetically."""
        return (*self.outputs, *sorted({s for e in self.equations for s in e.signals} - set(self.outputs)))

    @property
    def all_filtered(self) -> bool:
        """Whether the sensor filter must be applied to all signals, because the equations hold for filtered signals.

        This is the case if a filtered signal is an input of an equation: an external signal, or another output with
        measured coupling. It is False for every valid structure with friction, whose outputs are simulated before the
        filter.
        """
        followed = self.outputs if self.coupling == "simulated" or self.has_friction else ()
        return any(s not in followed and self.is_filtered(s) for s in self.signals)

    def filter_states(self, initial: Initial) -> int:
        """Return the number of unknown initial states of the sensor filter under given initial conditions.

        The transient from these states is modeled by responses to an impulse and its derivatives. The number is 0
        without a filter, for ``"rest"`` and for exponents that the user gives.

        Raises
        ------
        ModelError
            If the filter of simulated outputs has zeros or fractional orders. Its transient is then not a sum of these
            responses.
        """
        sensor = self.sensor_filter
        if sensor is None or not (initial == "caputo" or isinstance(initial, History)):
            return 0
        if not (self.all_filtered or sensor.has_impulse_transient):
            filtered = [o for o in self.outputs if self.is_filtered(o)]
            raise ModelError(
                f"{' and '.join(filtered)} passed a sensor filter with a fractional order or a zero, and a run has "
                "nonzero initial conditions: the transient of such a filter is not a sum of impulse responses; use "
                f"{parameter('initial', 'rest')} and begin the run at rest, or give the exponents of its initial "
                "terms"
            )
        return sensor.relative_degree

    def has_filter_transient(self, output: str) -> bool:
        """Whether an output may contain a transient from the initial state of the sensor filter."""
        return self.all_filtered or self.is_filtered(output)

    def is_filtered(self, signal: str) -> bool:
        """Whether a signal was measured through the sensor filter."""
        return self.sensor_filter is not None and signal in self.sensor_filter.signals

    @property
    def order_names(self) -> tuple[str, ...]:
        """Names of the free orders: first those that equal the order of a term, then those only in expressions."""
        orders = [o for e in self.equations for o in e.orders]
        single = [o.names[0] for o in orders if o.is_single]
        return tuple(dict.fromkeys([*single, *(n for o in orders for n in o.names)]))

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Names of the free coefficients."""
        return tuple(n for e in self.equations for n in e.coefficient_names)

    @property
    def has_order_law(self) -> bool:
        """Whether an order law relates the orders: an order is an expression, or two terms share a free order."""
        orders = [o for e in self.equations for o in e.orders if o.names]
        names = [o.names[0] for o in orders]
        return any(not o.is_single for o in orders) or len(set(names)) < len(names)

    def independent_groups(self) -> dict[str, Structure]:
        """Return groups of equations that share free orders, each as a structure for an order search, by name.

        Equations related by an order law form one group. Its name is ``"stage"`` if the group is the whole structure,
        otherwise the names of its outputs. Every other equation forms a group by itself, with measured coupling and the
        name of its output. Equations without free orders are omitted.
        """
        groups: list[tuple[set[str], list[Equation]]] = []
        for item in self.equations:
            names, members = set(item.order_names), [item]
            for group in [g for g in groups if g[0] & names]:
                names |= group[0]
                members = group[1] + members
                groups.remove(group)
            groups.append((names, members))
        out = {}
        for names, members in groups:
            single = len(members) == 1
            if not names:
                continue
            if single and not replace(self, equations=tuple(members), coefficient_law=()).has_order_law:
                out[members[0].output] = self.equation(members[0].output)
                continue
            if len(members) == len(self.equations):
                return {"stage": self}
            out[", ".join(e.output for e in members)] = self._substructure(tuple(members), self.coupling)
        return out

    def _substructure(self, equations: tuple[Equation, ...], coupling: Literal["measured", "simulated"]) -> Structure:
        """Return a structure of only the given equations, with the given coupling and without coefficient laws."""
        name = f"{self.name}, {', '.join(e.output for e in equations)}"
        return restrict_structure(self, equations, coupling=coupling, coefficient_law=(), name=name)

    def equation(self, output: str) -> Structure:
        """Return the equation of one output as a structure, with measured coupling and without order laws.

        An order that is an expression of free orders becomes a single free order, or 0 in a term without modeled
        outputs. Numbers and single free orders are unchanged.

        Raises
        ------
        ModelError
            If the structure has no such output.
        """
        check_known("output", [output], self.outputs)
        own = next(e for e in self.equations if e.output == output)
        modelled = [s for e in self.equations for s in e.signals if s in self.outputs]

        def free_order(k: int, term: Term) -> Term:
            if term.order.is_single or not term.order.names:
                return term
            if not set(term.signals) & set(modelled):
                return replace(term, order=Order())
            label = str(term.name or term.coefficient)
            name = (self.hints or Hints()).order_names_by_coefficient.get(label, f"nu_{output}_{k + 1}")
            return replace(term, order=Order(0.0, ((name, 1.0),)))

        single = replace(own, terms=tuple(free_order(k, t) for k, t in enumerate(own.terms)))
        return self._substructure((single,), "measured")

    def with_orders(self, orders: Mapping[str, Values]) -> Structure:
        """Return the structure with some free orders fixed or with new grid values; see :func:`parse_values`.

        Raises
        ------
        ModelError
            If a name is not a free order, or a value is out of range.
        """
        check_known("order", orders, self.order_names)
        numbers: dict[str, float] = {}
        grids = dict(self.order_values)
        for name, spec in orders.items():
            values = parse_values(name, spec)
            if isinstance(values, float):
                numbers[name] = values
            else:
                grids[name] = values
        equations = tuple(e.with_orders(numbers) for e in self.equations)
        return replace(self, equations=equations, order_values={n: v for n, v in grids.items() if n not in numbers})

    def with_coefficients(self, values: Mapping[str, float]) -> Structure:
        """Return the structure with some free coefficients fixed to values.

        Raises
        ------
        ModelError
            If a name is not a free coefficient.
        """
        check_known("coefficient", values, self.coefficient_names)
        return replace(self, equations=tuple(e.with_coefficients(values) for e in self.equations))

    def with_delays(self, delays: Mapping[str, float | tuple[float, float]]) -> Structure:
        """Return the structure with other delays of inputs [s].

        A number fixes the delay, and (lower, upper) are bounds between which it is estimated.

        A delay may be negative, down to minus one sampling interval, if an input is logged after it acts.

        Raises
        ------
        ModelError
            If a name is not an input, a delay is not finite, or bounds are not an interval.
        """
        fixed, free = dict(self.delay), dict(self.free_delays)
        for name, delay in delays.items():
            fixed.pop(name, None)
            free.pop(name, None)
            if isinstance(delay, str):
                raise ModelError(f"delay of {name} = {delay!r} is not a number; give seconds, or (minimum, maximum)")
            if isinstance(delay, (tuple, list)):
                if len(delay) != 2:
                    raise ModelError(
                        f"delay of {name} = {delay!r} has {plural(len(delay), 'value')}; give seconds, or (minimum, "
                        "maximum)"
                    )
                free[name] = (delay[0], delay[1])
            else:
                fixed[name] = delay
        return replace(self, delay=fixed, free_delays=free)

    def with_limits(
        self, *, saturation: Mapping[str, Value] | None = None, dead_zone: Mapping[str, Value] | None = None
    ) -> Structure:
        """Return the structure with other saturations and dead zones of inputs.

        A number fixes the limit, and (lower, upper) are bounds between which it is estimated.

        Parameters
        ----------
        saturation, dead_zone
            Saturation level and half-width of the dead zone by input, in the unit of the input.

        Raises
        ------
        ModelError
            If a name is not an input, a limit or interval is invalid, or an input has more than one free parameter.
        """
        limits = replace_nonlinearities(self.limits, "dead_zone", dead_zone or {})
        return replace(
            self, input_nonlinearities=_or_unset(replace_nonlinearities(limits, "saturation", saturation or {}))
        )

    @property
    def limits(self) -> tuple[InputNonlinearity, ...]:
        """Saturations and dead zones of inputs, in the sequence in which they act."""
        return () if isinstance(self.input_nonlinearities, UnsetType) else self.input_nonlinearities

    @property
    def free_input_parameters(self) -> tuple[FreeInputParameter, ...]:
        """Parameters of inputs to estimate: free delays, then free saturations and dead zones."""
        delay_parameters = [FreeInputParameter(n, "delay", (ends[0], ends[1])) for n, ends in self.free_delays.items()]
        return tuple([*delay_parameters, *(limit.free for limit in self.limits if limit.free is not None)])

    @property
    def fixed_input_parameters(self) -> dict[str, float]:
        """Values of fixed delays, saturations and dead zones by name, such as ``delay_u``, ``sat_u``."""
        delays = {input_name("delay", n): delay for n, delay in self.delay.items()}
        return delays | {limit.name: limit.value for limit in self.limits if not isinstance(limit.value, tuple)}

    def with_input_parameters(self, values: Mapping[str, float]) -> Structure:
        """Return the structure with delays and limits fixed to values by name, such as ``delay_u``, ``sat_u``."""
        names = {n: input_name("delay", n) for n in (*self.delay, *self.free_delays)}
        delays = {n: values[name] for n, name in names.items() if name in values}
        limits = tuple(
            replace(limit, value=float(values[limit.name])) if limit.name in values else limit for limit in self.limits
        )
        return replace(self.with_delays(delays), input_nonlinearities=_or_unset(limits))

    def without_free_input_parameters(self) -> Structure:
        """Return the structure without its free delays, free saturations and free dead zones; fixed ones are kept."""
        fixed_limits = [limit for limit in self.limits if limit.free is None]
        return replace(self, free_delays={}, input_nonlinearities=_or_unset(fixed_limits))

    def describe_inputs(self, digits: str = "r") -> dict[str, str]:
        """Return, for each input with a delay or non-linearity, its text such as ``sat(u(t - 0.035 s), 0.94)``.

        `digits` is a format specification for numbers; ``"r"`` gives all digits.
        """
        known = {n: f"{'+' if d < 0 else '-'} {_format(abs(d), digits)}" for n, d in self.delay.items() if d}
        free = {n: f"- {_format(low, digits)}:{_format(high, digits)}" for n, (low, high) in self.free_delays.items()}
        out = {n: f"{n}(t {text} s)" for n, text in {**known, **free}.items()}
        for limit in self.limits:
            out[limit.signal] = limit.as_text(out.get(limit.signal, limit.signal), digits)
        return out

    def __str__(self) -> str:
        inputs = self.describe_inputs()
        return "\n".join(f"{e.as_text(inputs)}{self.offset_text}" for e in self.equations)

    def equation_text(self, item: Equation) -> str:
        """Return an identified equation as text with six significant digits, with input effects and offset."""
        return format_equation(item, self.describe_inputs(".6g")) + self.offset_text

    @property
    def offset_text(self) -> str:
        """Text of the offset at the end of an equation, such as " + c"; empty for ``"none"`` and ``"level"``."""
        (name,) = unused_names("c", 1, self)
        return {
            "none": "",
            "level": "",
            "constant": f" + {name}",
            "ramp": f" + ({name} + ramp t)",
            "auto": f" + ({name} if significant)",
        }[self.offset]

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


def _format(value: float, digits: str) -> str:
    """Return a number as text by the format specification `digits`; ``"r"`` gives all digits."""
    return format_shortest(value) if digits == "r" else format(value, digits)


def _or_unset(limits: Sequence[InputNonlinearity]) -> tuple[InputNonlinearity, ...] | UnsetType:
    """Return the non-linearities as a tuple, or msgspec's UNSET if there are none, so that files omit the field."""
    return tuple(limits) or UNSET


def unused_names(base: str, count: int, structure: Structure, signals: Iterable[str] = ()) -> list[str]:
    """Return `count` names, built from `base`, that no parameter or signal of a structure and none of `signals` has.

    A single name is `base` itself if it is unused. Other names are `base` with a number.
    """
    reserved_names = {*structure.order_names, *structure.coefficient_names, *structure.signals, *signals}
    numbered = (f"{base}{k}" for k in itertools.count(1))
    names = itertools.chain([base] if count == 1 else [], numbered)
    return list(itertools.islice((n for n in names if n not in reserved_names), count))


def offset_exponents(alpha: float, offset: Offset) -> dict[str, float]:
    """Return the exponents of t that an offset has after alpha-fold integration, by ``"constant"`` and ``"ramp"``.

    A constant c becomes c t^alpha / Gamma(alpha + 1).
    """
    names = {"none": (), "level": (), "auto": (), "constant": ("constant",), "ramp": ("constant", "ramp")}[offset]
    return {name: round(alpha + i, 9) for i, name in enumerate(names)}


def restrict_structure(structure: Structure, equations: tuple[Equation, ...], **changes: Any) -> Structure:
    """Return a structure with other equations, and only those options that concern them.

    Grids, delays, non-linearities and filtered signals are kept if their order or signal occurs in the equations.

    `changes` are new values of other fields.
    """
    orders = {n for e in equations for n in e.order_names}
    signals = {s for e in equations for s in e.signals}
    return replace(
        structure,
        equations=equations,
        order_values={n: v for n, v in structure.order_values.items() if n in orders},
        delay={n: v for n, v in structure.delay.items() if n in signals},
        free_delays={n: v for n, v in structure.free_delays.items() if n in signals},
        input_nonlinearities=_or_unset([limit for limit in structure.limits if limit.signal in signals]),
        sensor_filter=_restrict_filter(structure.sensor_filter, signals),
        **changes,
    )


def _restrict_filter(sensor: SensorFilter | None, signals: Collection[str]) -> SensorFilter | None:
    """Return a sensor filter restricted to some signals; None if none of them is filtered."""
    if sensor is None:
        return None
    filtered_signals = tuple(s for s in sensor.signals if s in signals)
    return SensorFilter(filtered_signals, sensor.numerator, sensor.denominator) if filtered_signals else None
