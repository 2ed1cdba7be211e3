"""Structures: equations over shared signals, with what is known about them."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from msgspec import UNSET, UnsetType

from ftlm.errors import ModelError
from ftlm.structure.equation import Equation, Term, numeric
from ftlm.structure.input_nonlinearity import FreeInput, Limit, Value, check_limits, input_name, with_values
from ftlm.structure.order import Order, Values, parse_values
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.utils.validation import check_known, real_number


class History(tuple[float, ...]):
    """Powers of time that stand for what a run did before its start, decided from the run."""

    __slots__ = ()


Initial: TypeAlias = Literal["auto", "rest", "caputo", "history"] | tuple[float, ...]
Offset: TypeAlias = Literal["none", "constant", "ramp", "auto"]
#: What initial terms are called.
START_WORDS = ("auto", "rest", "caputo", "history")


def check_initial(initial: str | Iterable[float]) -> Initial:
    """Refuse initial terms that are neither a known word nor exponents above -1."""
    if isinstance(initial, str) and initial in START_WORDS:
        return initial  # type: ignore[return-value]
    try:
        if isinstance(initial, str):
            raise TypeError
        exponents = tuple(real_number("exponent of an initial term", e) for e in initial)
    except TypeError:
        words = f"{', '.join(map(repr, START_WORDS))} or exponents of t"
        raise ModelError(f"initial = {initial!r} is not known; use {words}") from None
    bad = next((e for e in exponents if not (math.isfinite(e) and -1 < e <= 10)), None)
    if bad is not None:
        raise ModelError(f"exponent {bad:g} of an initial term is outside (-1, 10]; t to this power is of no use")
    return exponents


def check_offset(offset: str) -> Offset:
    """Refuse an offset that is no known word."""
    if offset in ("none", "constant", "ramp", "auto"):
        return offset  # type: ignore[return-value]
    raise ModelError(f"offset = {offset!r} is not known; use 'none', 'constant', 'ramp' or 'auto'")


def check_decided(offset: str) -> None:
    """Refuse an offset that nothing has decided yet."""
    if offset == "auto":
        raise ModelError(
            "offset='auto' lets ftlm.identify decide from the runs whether an equation has one; here use offset='none' "
            "or offset='constant'"
        )


@dataclass(frozen=True)
class Hints:
    """What the maker of a structure knows of where its orders lie; it tells a fit where to start, and bounds nothing.

    Parameters
    ----------
    highest
        Usual interval of highest orders; None: anything.
    natural
        Values beside the whole orders of its physics, by order; starts are looked for there, too, if all orders have
        some.
    freed
        Names of the orders that an equation taken out of an order law frees, by the coefficient of their term.
    exceeds
        What a ratio of the coefficient law exceeds by its physics; 1 where nothing is said, as a sum of inertias beside
        one of them.
    positive
        Coefficients of one equation that the law ties to those of another and physics makes positive. Least squares may
        take the one equation for the other; a start then has the other's coefficients by the law, with these signs.
    known
        Values of coefficients by a physics that is nearly right; a fit that frees one also starts with it held there.
    """

    highest: tuple[float, float] | None = None
    natural: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    freed: Mapping[str, str] = field(default_factory=dict)
    exceeds: Mapping[str, float] = field(default_factory=dict)
    positive: tuple[str, ...] = ()
    known: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Structure:
    """Equations over shared signals, with what is known about them; some orders or coefficients may be free.

    Parameters
    ----------
    equations
        One for each output that is modelled.
    order_values
        Lattice of free orders that have one: their values, ascending.
    coupling
        ``"measured"``: each equation is driven by the measured other outputs. ``"simulated"``: all outputs follow
        together from the inputs alone.
    delay
        Known delay of inputs [s].
    free_delays
        Least and largest delay of inputs whose delay is to be estimated [s].
    limited
        Saturations and dead zones of inputs, known or to be estimated.
    initial
        Initial terms, see :func:`equation`.
    sensor_filter
        Known filter that some signals were measured through, inputs or outputs.
    coefficient_law
        Optional law that ties the coefficients: (name, sign, factors) with coefficient = sign * product of factors.
    reference
        Coefficients by name as the maker of the machine states them, to be set beside estimates.
    name
        What this is.
    hints
        Where its orders lie, if its maker knows; no part of what it says, so never compared nor written.
    offset
        ``"constant"``: each equation has an unknown constant on its right-hand side, ``"ramp"``: a constant and a
        constant times t; one each run, estimated as initial terms are and never carried to another run. ``"auto"``:
        identification decides between none and a constant.

    Raises
    ------
    ModelError
        No equation, an output or a coefficient that two of them have, a delay, limit or filter of what is no signal.
    """

    equations: tuple[Equation, ...]
    order_values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    coupling: Literal["measured", "simulated"] = "measured"
    delay: Mapping[str, float] = field(default_factory=dict)
    free_delays: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    initial: Initial = "auto"
    sensor_filter: SensorFilter | None = None
    coefficient_law: tuple[tuple[str, float, tuple[str, ...]], ...] = ()
    reference: Mapping[str, float] = field(default_factory=dict)
    name: str = "equation"
    hints: Hints | UnsetType = field(default=UNSET, repr=False, compare=False)
    offset: Offset = "none"
    # Absent where there is none, so that what is written of a structure without it is as it was.
    limited: tuple[Limit, ...] | UnsetType = UNSET

    def __post_init__(self) -> None:
        if not self.equations:
            raise ModelError("a model needs at least one equation")
        outputs = [e.output for e in self.equations]
        twice = next((o for i, o in enumerate(outputs) if o in outputs[:i]), None)
        if twice is not None:
            raise ModelError(f"two equations have the output {twice}; give each output one equation")
        if self.coupling not in ("measured", "simulated"):
            raise ModelError(f"coupling = {self.coupling!r} is not known; use 'measured' or 'simulated'")
        names = [n for e in self.equations for n in e.coefficient_names]
        twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
        if twice is not None:
            raise ModelError(f"coefficient {twice} stands in two equations; give each its own name")
        external = [s for s in self.signals if s not in outputs]
        check_known("delayed input", [*self.delay, *self.free_delays], external)
        for name, delay in self.delay.items():
            if not 0 <= real_number(f"delay of {name}", delay) < math.inf:
                raise ModelError(f"delay of {name} = {delay} s is not a non-negative number; give seconds")
        for name, (low, high) in self.free_delays.items():
            numbers = real_number(f"least delay of {name}", low), real_number(f"largest delay of {name}", high)
            if not 0 <= numbers[0] < numbers[1] < math.inf:
                raise ModelError(f"delay of {name} from {low} to {high} s is no interval; give two rising times from 0")
        check_known("limited input", [limit.signal for limit in self.limits], external)
        check_limits(self.limits, self.delay, self.free_delays)
        for item in self.free_inputs:
            if item.name in names or item.name in self.order_names:
                raise ModelError(f"{item.name} is the {item.words}; call the coefficient otherwise")
        if self.sensor_filter is not None:
            check_known("filtered signal", self.sensor_filter.signals, self.signals)
        self._check_offset()
        if self.has_friction:
            self._check_friction()

    @property
    def has_friction(self) -> bool:
        """Whether the output of an equation may stick."""
        return any(e.friction is not None for e in self.equations)

    @property
    def sticks(self) -> tuple[int, ...]:
        """Places of the equations with friction."""
        return tuple(i for i, e in enumerate(self.equations) if e.friction is not None)

    def _check_friction(self) -> None:
        """Refuse what a free run with friction does not know yet."""
        rubbing = [self.equations[i].output for i in self.sticks]
        words = f"the equation of {rubbing[0]} has friction"
        for i in self.sticks:
            self.equations[i].check_drives(self.outputs)
        if len(self.equations) > 1 and self.coupling == "measured":
            raise ModelError(
                f"{words}, and the structure {len(self.equations)} equations with measured coupling: driven by "
                f"measured signals they share no free run, so give that of {rubbing[0]} a structure of its own, or "
                "follow them together with coupling='simulated'"
            )
        if self.behind_filter:
            through = [s for s in self.signals if s not in self.outputs and self.measured_through(s)]
            raise ModelError(
                f"{words}, and {' and '.join(through)}, which drives it, passed the sensor filter: what sticks does so "
                "before the filter, and what was filtered is not given back; let it follow from an equation of its "
                "own with coupling='simulated', or leave it out of the filter"
            )
        if self.free_delays:
            raise ModelError(f"{words}, and the delay of {', '.join(self.free_delays)} is free; give it in seconds")
        tied = {n for name, _, factors in self.coefficient_law for n in (name, *factors)}
        held = [n for e in self.equations if e.friction is not None for n in e.friction.names if n in tied]
        if held:
            raise ModelError(f"{words}, and a law ties its {held[0]} to other coefficients; leave one of the two out")
        if isinstance(self.initial, History) or self.initial == "history":
            raise ModelError(
                f"{words}: powers of t for an unknown past would give it velocities that it never had; use "
                "initial='caputo' (level and velocity at the start), or begin the run at rest"
            )

    def _check_offset(self) -> None:
        """Refuse an offset that is no word, or that given initial terms hold already."""
        check_offset(self.offset)
        if isinstance(self.initial, (str, History)):
            # Where the powers of a history hold that of the offset, they are one term.
            return
        for item in self.equations:
            for power in [] if item.order.names else offset_exponents(item.order.constant, self.offset).values():
                if any(abs(power - e) < 1e-9 for e in self.initial):
                    raise ModelError(
                        f"the offset of {item.output} is t^{power:g} in its equation, and so is one of the initial "
                        f"terms {', '.join(f'{e:g}' for e in self.initial)}: they cannot be told apart; "
                        f"leave {power:g} out of initial, or use offset='none'"
                    )

    @property
    def outputs(self) -> tuple[str, ...]:
        """Modelled outputs, one an equation."""
        return tuple(e.output for e in self.equations)

    @property
    def signals(self) -> tuple[str, ...]:
        """Outputs first, then every other signal."""
        return tuple(dict.fromkeys([e.output for e in self.equations] + [s for e in self.equations for s in e.signals]))

    @property
    def behind_filter(self) -> bool:
        """Whether equations and free runs are those of filtered signals, every unfiltered one put through the filter.

        So it is where a filtered signal drives an equation: another output with measured coupling, or what is not
        modelled. What such a structure compares and returns is filtered, in all of its equations. What may stick
        follows from its own velocity, before the filter.
        """
        followed = self.outputs if self.coupling == "simulated" or self.has_friction else ()
        return any(s not in followed and self.measured_through(s) for s in self.signals)

    def filter_states(self, initial: Initial) -> int:
        """How many free motions of the filter stand beside decided initial terms where signals pass it.

        What the filter is applied to here, signals that were not measured through it or outputs that follow from
        others, passes it from the start of the run on, so what the filter still holds of the time before is unknown:
        its answers to an impulse and to derivatives of one. None from rest, nor beside exponents that are given. Of
        outputs that follow from unfiltered signals a filter is refused that may hold more.

        Raises
        ------
        ModelError
            Such a filter.
        """
        sensor = self.sensor_filter
        if sensor is None or not (initial == "caputo" or isinstance(initial, History)):
            return 0
        if not (self.behind_filter or sensor.holds_answers):
            through = [o for o in self.outputs if self.measured_through(o)]
            raise ModelError(
                f"{' and '.join(through)} passed a sensor filter with a zero or a fractional order, and a run starts "
                "in motion: what such a filter still held is more than answers to impulses; use initial='rest' and "
                "begin the run at rest, or give the exponents of its initial terms"
            )
        return sensor.relative_degree

    def held_back(self, output: str) -> bool:
        """Whether the filter may still hold something of the time before a run that an output lacks then."""
        return self.behind_filter or self.measured_through(output)

    def measured_through(self, signal: str) -> bool:
        """Whether a signal was measured through the sensor filter."""
        return self.sensor_filter is not None and signal in self.sensor_filter.signals

    @property
    def order_names(self) -> tuple[str, ...]:
        """Free orders: those that stand alone in order of appearance, then those seen only through a law."""
        orders = [o for e in self.equations for o in (e.order, *(t.order for t in e.terms))]
        alone = [o.names[0] for o in orders if o.is_single]
        return tuple(dict.fromkeys([*alone, *(n for o in orders for n in o.names)]))

    @property
    def coefficient_names(self) -> tuple[str, ...]:
        """Free coefficients."""
        return tuple(n for e in self.equations for n in e.coefficient_names)

    @property
    def has_order_law(self) -> bool:
        """Whether orders depend on one another: one is no plain name, or two are the same."""
        orders = [o for e in self.equations for o in (e.order, *(t.order for t in e.terms)) if o.names]
        names = [o.names[0] for o in orders]
        return any(not o.is_single for o in orders) or len(set(names)) < len(names)

    def parts(self) -> dict[str, Structure]:
        """What an order search takes one by one: equations that share no free order do not wait for one another.

        Equations that an order law ties stay together, as ``"stage"`` where that is all of the structure, else under
        the names of their outputs; any other equation is by itself, with measured coupling. Equations without free
        orders are left out.
        """
        groups: list[tuple[set[str], list[Equation]]] = []
        for item in self.equations:
            names, together = set(item.order_names), [item]
            for group in [g for g in groups if g[0] & names]:
                names |= group[0]
                together = group[1] + together
                groups.remove(group)
            groups.append((names, together))
        out = {}
        for names, together in groups:
            single = len(together) == 1
            if not names:
                continue
            if single and not replace(self, equations=tuple(together), coefficient_law=()).has_order_law:
                out[together[0].output] = self.equation(together[0].output)
                continue
            if len(together) == len(self.equations):
                return {"stage": self}
            out[", ".join(e.output for e in together)] = self._of(tuple(together), self.coupling)
        return out

    def _of(self, equations: tuple[Equation, ...], coupling: Literal["measured", "simulated"]) -> Structure:
        """What is known of some of the equations, free of laws between coefficients."""
        orders = {n for e in equations for n in e.order_names}
        signals = tuple(dict.fromkeys(s for e in equations for s in e.signals))
        return replace(
            self,
            equations=equations,
            order_values={n: v for n, v in self.order_values.items() if n in orders},
            coupling=coupling,
            delay={n: v for n, v in self.delay.items() if n in signals},
            free_delays={n: v for n, v in self.free_delays.items() if n in signals},
            limited=_or_unset([limit for limit in self.limits if limit.signal in signals]),
            sensor_filter=narrowed(self.sensor_filter, signals),
            coefficient_law=(),
            name=f"{self.name}, {', '.join(e.output for e in equations)}",
        )

    def equation(self, output: str) -> Structure:
        """One equation of this structure alone, with measured coupling and free of order laws.

        An order that a law would give becomes a free order of its own, named after its term; the order of an input
        becomes 0 unless it is a number already.

        Raises
        ------
        ModelError
            No such output.
        """
        check_known("output", [output], self.outputs)
        own = next(e for e in self.equations if e.output == output)
        modelled = [s for e in self.equations for s in e.signals if s in self.outputs]

        def freed(k: int, term: Term) -> Term:
            if term.order.is_single or not term.order.names:
                return term
            if term.signal not in modelled:
                return replace(term, order=Order())
            called = str(term.name or term.coefficient)
            name = (self.hints or Hints()).freed.get(called, f"nu_{output}_{k + 1}")
            return replace(term, order=Order(0.0, ((name, 1.0),)))

        single = replace(own, terms=tuple(freed(k, t) for k, t in enumerate(own.terms)))
        return self._of((single,), "measured")

    def driven(self, output: str) -> Structure:
        """One equation of this structure driven by measured signals, its orders as they are here."""
        return self._of(tuple(e for e in self.equations if e.output == output), "measured")

    def with_orders(self, orders: Mapping[str, Values]) -> Structure:
        """Fix free orders (a number) or give them a lattice (see :func:`parse_values`).

        Raises
        ------
        ModelError
            A name that is no free order, or values out of range.
        """
        check_known("order", orders, self.order_names)
        numbers: dict[str, float] = {}
        lattices = dict(self.order_values)
        for name, spec in orders.items():
            values = parse_values(name, spec)
            if isinstance(values, float):
                numbers[name] = values
            else:
                lattices[name] = values
        equations = tuple(e.with_orders(numbers) for e in self.equations)
        return replace(self, equations=equations, order_values={n: v for n, v in lattices.items() if n not in numbers})

    def with_coefficients(self, values: Mapping[str, float]) -> Structure:
        """Fix free coefficients.

        Raises
        ------
        ModelError
            A name that is no free coefficient.
        """
        check_known("coefficient", values, self.coefficient_names)
        return replace(self, equations=tuple(e.with_coefficients(values) for e in self.equations))

    def with_delays(self, delays: Mapping[str, float | tuple[float, float]]) -> Structure:
        """Set delays of inputs [s]: a number is known, (least, largest) is to be estimated.

        Raises
        ------
        ModelError
            A name that is no input, a delay that is negative, or no interval.
        """
        known, free = dict(self.delay), dict(self.free_delays)
        for name, delay in delays.items():
            known.pop(name, None)
            free.pop(name, None)
            if isinstance(delay, (tuple, list)):
                if len(delay) != 2:
                    raise ModelError(f"delay of {name} = {delay!r} is neither a number nor (least, largest) [s]")
                free[name] = (delay[0], delay[1])
            else:
                known[name] = delay
        return replace(self, delay=known, free_delays=free)

    def with_limits(
        self, *, saturation: Mapping[str, Value] | None = None, dead_zone: Mapping[str, Value] | None = None
    ) -> Structure:
        """Set saturations and dead zones of inputs, in their units: a number is known, (least, largest) is estimated.

        Parameters
        ----------
        saturation, dead_zone
            By the name of the input: the size beyond which no more acts, and that up to which nothing does.

        Raises
        ------
        ModelError
            A name that is no input, a limit that is no number above 0, no interval, or not estimated beside others.
        """
        limits = with_values(self.limits, "dead_zone", dead_zone or {})
        return replace(self, limited=_or_unset(with_values(limits, "saturation", saturation or {})))

    @property
    def limits(self) -> tuple[Limit, ...]:
        """Saturations and dead zones of inputs, as inputs pass them."""
        return () if isinstance(self.limited, UnsetType) else self.limited

    @property
    def free_inputs(self) -> tuple[FreeInput, ...]:
        """What is to be estimated of inputs: delays, then limits."""
        late = [FreeInput(n, "delay", (ends[0], ends[1])) for n, ends in self.free_delays.items()]
        return tuple([*late, *(limit.free for limit in self.limits if limit.free is not None)])

    def with_inputs(self, values: Mapping[str, float]) -> Structure:
        """Set free delays and limits by the names of their estimates, such as ``delay_u`` and ``sat_u``."""
        names = {n: input_name("delay", n) for n in self.free_delays}
        delays = {n: values[name] for n, name in names.items() if name in values}
        limits = tuple(
            replace(limit, value=float(values[limit.name])) if limit.free and limit.name in values else limit
            for limit in self.limits
        )
        return replace(self.with_delays(delays), limited=_or_unset(limits))

    def as_given(self) -> Structure:
        """The structure without free delays and limits: inputs as they were given."""
        known = [limit for limit in self.limits if limit.free is None]
        return replace(self, free_delays={}, limited=_or_unset(known))

    def acting(self, digits: str = "r") -> dict[str, str]:
        """How inputs are written that do not act as they are: ``sat(u(t - 0.035 s), 0.94)``."""
        out = {n: f"{n}(t - {d:.6g} s)" for n, d in self.delay.items() if d > 0 and digits != "r"}
        for limit in self.limits:
            out[limit.signal] = limit.written(out.get(limit.signal, limit.signal), digits)
        return out

    def __str__(self) -> str:
        inputs = self.acting()
        return "\n".join(f"{e.written(inputs)}{self.offset_in_words}" for e in self.equations)

    def written(self, item: Equation) -> str:
        """Write an identified equation of this structure with its delays, its limits and its offset."""
        return numeric(item, self.acting(".6g")) + self.offset_in_words

    @property
    def offset_in_words(self) -> str:
        """What an offset adds to an equation in words; nothing without one."""
        taken = {*self.coefficient_names, *self.order_names, *self.signals}
        name = next(n for n in ("c", *(f"c{k}" for k in range(len(taken) + 1))) if n not in taken)
        asked = f" + ({name} if the runs ask for it)"
        return {"none": "", "constant": f" + {name}", "ramp": f" + ({name} + ramp t)", "auto": asked}[self.offset]

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


def _or_unset(limits: Sequence[Limit]) -> tuple[Limit, ...] | UnsetType:
    """Limits as a structure holds them."""
    return tuple(limits) or UNSET


def offset_exponents(alpha: float, offset: Offset) -> dict[str, float]:
    """Powers of t that an offset is once its equation is integrated, by what they are: c t^alpha / Gamma(alpha + 1)."""
    names = {"none": (), "auto": (), "constant": ("constant",), "ramp": ("constant", "ramp")}[offset]
    return {name: round(alpha + i, 9) for i, name in enumerate(names)}


def narrowed(sensor: SensorFilter | None, signals: Sequence[str]) -> SensorFilter | None:
    """Return the filter of those signals that are left, or None."""
    if sensor is None:
        return None
    left = tuple(s for s in sensor.signals if s in signals)
    return SensorFilter(left, sensor.numerator, sensor.denominator) if left else None
