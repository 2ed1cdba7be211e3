"""Parser from the text of equations to a structure."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Literal

from msgspec import UNSET

from ftlm.errors import ModelError
from ftlm.structure.equation import Equation, Friction, Term, derivative
from ftlm.structure.grammar import NONLINEARITY_KINDS, EquationParser, ParsedTerm
from ftlm.structure.input_nonlinearity import (
    INPUT_EFFECT_ABBREVIATIONS,
    InputNonlinearity,
    NonlinearityKind,
    Value,
    sort_nonlinearities,
)
from ftlm.structure.order import Values
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import Offset, Structure, check_initial, check_offset
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import check_known, real_number


@check_arguments
def equation(
    text: str,
    *,
    orders: Mapping[str, Values] | None = None,
    fixed: Mapping[str, float] | None = None,
    delay: Mapping[str, float | tuple[float, float]] | None = None,
    saturation: Mapping[str, Value] | None = None,
    dead_zone: Mapping[str, Value] | None = None,
    initial: str | Iterable[float] = "auto",
    sensor_filter: SensorFilter | None = None,
    offset: str | None = None,
    coupling: Literal["measured", "simulated"] | None = None,
) -> Structure:
    """Return the structure that the text of one or several fractional-order equations describes.

    Parameters
    ----------
    text
        Equations such as ``"D^2.2 y = a1 D^0.9 y + a0 y + b0 u"``. ``D^alpha`` is a free order, ``D^(alpha-mu)`` an
        order law, ``D y``, ``y'`` or ``dy/dt`` the first derivative. A coefficient is a name, a number (fixed) or a
        number times a name. Terms may stand on both sides, as in ``"y'' + 2 y' + y = u(t - 0.1)"`` with a delay [s] of
        the input, and transfer functions may be written in s: ``"y = (2 s^0.5 + 1)/(s^1.5 + 3) e^(-0.1 s) u"``. An
        input may have a higher order than its equation, or a lead, as in ``u(t + 0.1)``. Such an equation
        can always be fitted to a frequency response, but :func:`identify` raises ModelError if the order or the lead is
        too large for a run. The equation is solved for
        the highest derivative of its output, the signal that is differentiated most on the left-hand side. Separate
        equations by ``;`` or line breaks. A term ``c`` alone (or ``c0``, ``c1``, …) is an offset, an unknown constant;
        write ``1 c`` for a signal of that name. ``- fc*sign(D y)`` in the equation of y is Coulomb friction of the
        simulated velocity, set-valued at rest. ``- fs*exp(-(D y/vs)^2)*sign(D y)`` adds Stribeck friction, with fs and
        vs > 0 each a name or a number; the breakaway force is then fc + fs. Non-linear terms must be linear in their
        coefficients: ``k3 y^3``, ``e y*u``, ``- w abs(D y)*D y``, ``k sin(2 y)``, ``k D^mu (y^3)``, with the functions
        sin, cos, exp, tanh, abs and sqrt. The first name in a product is its coefficient, unless it denotes a signal
        elsewhere in the equations.
    orders
        Values of the free orders by name: a number fixes the order, ``"0.5:1.5:0.05"`` or (low, high, step) is its
        grid.
    fixed
        Values of known coefficients by name.
    delay
        Delays of inputs [s] by name: a number fixes the delay, and (lower, upper) are bounds for its estimation by
        output error. A delay may be negative, down to minus one sampling interval, if an input is logged after it acts.
    saturation, dead_zone
        Symmetric saturation level and half-width of the dead zone of inputs by name, in their units: a number fixes the
        value, and (lower, upper) are bounds for its estimation by output error. The syntax in texts is
        ``sat(u, 0.94)``, ``dead(u, 0.05)``, ``sat(u, 0.5:1.5)``.
    initial
        Initial conditions, as powers of t in the integrated equation: ``"rest"`` (none), ``"caputo"`` (Caputo's initial
        values), ``"history"`` (unknown past inputs: multiples of 1/4 as exponents, as many as are significant), or
        given exponents. ``"auto"`` chooses rest in three cases: the outputs start at zero, they are constant in at
        least five samples before an input changes, or the inputs are constant over the run (with a finding). A nonzero
        level of the outputs is then estimated, and the first value of each input is subtracted. Otherwise ``"auto"``
        chooses ``"caputo"`` if all orders are integers or the data require no further initial terms, and ``"history"``
        if not.
    sensor_filter
        Known filter through which some signals were measured; see :class:`ftlm.SensorFilter`.
    offset
        ``"constant"``: an unknown constant on the right-hand side of each equation, the same as ``+ c`` in the text;
        ``"ramp"``: a constant and a constant times t; ``"level"``: an unknown constant that is added to each output;
        ``"none"``. If a run starts from rest, a constant is a load that acts from the first sample on. If the outputs
        rest at nonzero values first, the constant is replaced by a level. Offsets are estimated for each run together
        with the coefficients, and are not transferred to another run. Default: as in the text.
    coupling
        Coupling of several equations. ``"measured"`` (default): the measured other outputs are inputs of each equation.
        ``"simulated"`` (default if an equation has friction): all outputs are simulated together.

    Returns
    -------
    Structure
        Structure to identify, or the structure of a model if all parameters are fixed.

    Raises
    ------
    ModelError
        If the text has a syntax error (the message has its position), a name is unknown, an order is out of range, or
        only some of several equations have an offset.
    """
    if not isinstance(text, str):
        raise ModelError(f"the equation is {type(text).__name__}, not text; write it as in 'D^1.5 y = a0 y + b0 u'")
    lines = [line for line in re.split(r"[;\n]", text) if line.strip()]
    if not lines:
        raise ModelError("the equation is empty; write it as in 'D^1.5 y = a0 y + b0 u'")
    parsers = _parse_lines(lines)
    equations = [_equation_of(parser) for parser in parsers]
    fixed = dict(fixed or {})
    check_known("fixed coefficient", fixed, [n for e in equations for n in e.coefficient_names])
    for name, value in fixed.items():
        if not math.isfinite(real_number(f"fixed coefficient {name}", value)):
            raise ModelError(f"fixed coefficient {name} = {value} is not finite; give a number")
    equations = [e.with_coefficients(fixed) for e in equations]
    if coupling is None:
        has_friction = len(equations) > 1 and any(e.friction is not None for e in equations)
        coupling = "simulated" if has_friction else "measured"
    structure = (
        Structure(
            equations=tuple(equations),
            coupling=coupling,
            initial=check_initial(initial),
            sensor_filter=sensor_filter,
            offset=_offset_of(list(zip(equations, (parser.offset for parser in parsers), strict=True)), offset),
            input_nonlinearities=_merge_nonlinearities(parsers) or UNSET,
        )
        .with_delays(_merge_delays(parsers, delay or {}))
        .with_orders(orders or {})
    )
    return structure.with_limits(saturation=saturation, dead_zone=dead_zone)


def as_structure(argument: str, value: Structure | str) -> Structure:
    """Return a structure, or the structure that the text of its equations describes.

    `argument` is the name of the argument in messages. Raise ModelError for another object or an invalid text.
    """
    if isinstance(value, str):
        return equation(value)
    if not isinstance(value, Structure):
        raise ModelError(
            f"{argument} is {type(value).__name__}; give the text of an equation, or of several separated by "
            "';', ftlm.equation(…) or ftlm.flexible_link(…)"
        )
    return value


def _parse_lines(lines: Sequence[str]) -> list[EquationParser]:
    """Return one parser per equation text, with the text parsed.

    The first name in a product is a coefficient, unless it denotes a signal elsewhere in the texts.
    """
    parsers = [EquationParser(line).parse() for line in lines]
    items = [item for parser in parsers for item in (*parser.left, *parser.right)]
    signals = {signal for item in items for signal in item.signals}
    if any(item.name in signals for item in items):
        parsers = [EquationParser(line, signals).parse() for line in lines]
    return parsers


def _offset_of(options: Sequence[tuple[Equation, str | None]], offset: str | None) -> Offset:
    """Return the offset option: `offset` if given, otherwise the common option of all equation texts.

    `options` has pairs (equation, option in its text). Raise ModelError if the options contradict each other.
    """
    pairs = [(item.output, option) for item, option in options if option]
    if offset is not None:
        if pairs and check_offset(offset) == "none":
            raise ModelError(
                f"the equation of {pairs[0][0]} has an offset, but {parameter('offset', 'none')}; leave one of them out"
            )
        return check_offset(offset)
    outputs_without = [item.output for item, option in options if not option]
    if pairs and outputs_without:
        raise ModelError(
            f"the equation of {pairs[0][0]} has an offset, that of {outputs_without[0]} has none; write + c in "
            "each equation (its estimate shows whether it is 0), or in none"
        )
    kinds = {option for _, option in pairs}
    if len(kinds) > 1:
        raise ModelError("one equation has a constant offset and another one a ramp; write the same offset in each")
    return check_offset(pairs[0][1] or "none") if pairs else "none"


def _equation_of(parser: EquationParser) -> Equation:
    """Return a parsed equation, solved for its leading derivative.

    The leading derivative is the highest one on the left-hand side, or the first one if an order there is free. Raise
    ModelError if there is no derivative, or terms of the solved equation would not have one coefficient each.
    """
    linear = [item for item in parser.left if item.expression is None]
    derivatives = [item for item in linear if item.order.names or item.order.constant != 0]
    if not derivatives:
        output = linear[0].signal if linear else "y"
        raise ModelError(
            f"equation {parser.text!r}: its left-hand side has no derivative; write it as in 'D^1.5 {output} = …', or "
            "in s, as in 'y = 2/(s^1.5 + 3) u'"
        )
    lead = derivatives[0]
    if not any(item.order.names for item in derivatives):
        lead = max(derivatives, key=lambda item: item.order.constant)
    reason = _division_reason(parser, lead)
    if reason:
        raise ModelError(f"equation {parser.text!r}: {reason}; write {_divided_equation(parser, lead)}")
    divisor, others = 0.0, []
    for sign, items in ((-1.0, parser.left), (1.0, parser.right)):
        for item in items:
            if replace(item, factor=lead.factor) == lead:
                divisor -= sign * item.factor
            else:
                others.append((sign, item))
    if divisor == 0:
        raise ModelError(
            f"equation {parser.text!r}: {derivative(lead.order, lead.signal)} cancels out; leave it out, or correct a "
            "sign"
        )
    terms = []
    for sign, item in others:
        factor = sign * item.factor / divisor
        expression = item.expression or UNSET
        if item.name is None:
            terms.append(Term(item.signal, item.order, factor, expression=expression))
        else:
            terms.append(Term(item.signal, item.order, item.name, factor, expression=expression))
    return Equation(lead.signal, lead.order, tuple(terms), _friction_of(parser, lead.signal, divisor))


def _division_reason(parser: EquationParser, lead: ParsedTerm) -> str | None:
    """Return, as text, why the solved equation would not have one coefficient per term; None if it would.

    `lead` is the leading derivative.
    """
    linear = [item for item in (*parser.left, *parser.right) if item.expression is None]
    leads = [i for i in linear if i in parser.left and (i.signal, i.order) == (lead.signal, lead.order)]
    name = next((item.name for item in leads if item.name), None)
    if name is not None:
        return f"{name} multiplies the highest derivative"
    names = [item.name for item in linear if item.name]
    product = next((name for name in names if "*" in name), None)
    if product is not None:
        return f"{product} is a product of coefficients"
    duplicate = next((name for name in names if parser.is_transfer and names.count(name) > 1), None)
    return duplicate and f"{duplicate} occurs in several terms after multiplication"


def _divided_equation(parser: EquationParser, lead: ParsedTerm) -> str:
    """Return, for an error message, the text of an equation divided by the coefficient of its leading derivative.

    Every term has one new coefficient. The text ends with the definitions of the new coefficients by the old ones.
    """
    sums: dict[tuple[str, str], list[tuple[float, str | None]]] = {}
    for sign, items in ((-1.0, parser.left), (1.0, parser.right)):
        for item in items:
            text = derivative(item.order, _signal_text(parser, item.signal))
            if item.expression is not None:
                text = f"({item.expression.as_text()})"
            sums.setdefault((item.signal, text), []).append((sign * item.factor, item.name))
    divisor = [(-c, name) for c, name in sums.pop((lead.signal, derivative(lead.order, lead.signal)))]
    used_names = {
        name for item in (*parser.left, *parser.right) for name in (*item.signals, *(item.name or "").split("*"))
    }
    counts = {"a": itertools.count(), "b": itertools.count()}
    terms: list[str] = []
    definitions: list[str] = []
    for (signal, text), quotient in reversed(sums.items()):
        if all(name is None for _, name in (*quotient, *divisor)):
            terms.insert(0, f"{sum(c for c, _ in quotient) / sum(c for c, _ in divisor):g} {text}")
            continue
        letter = "a" if signal == lead.signal else "b"
        name = next(name for k in counts[letter] if (name := f"{letter}{k}") not in used_names)
        terms.insert(0, f"{name} {text}")
        definitions.insert(0, f"{name} = {_quotient_text(quotient, divisor)}")
    right_side = " + ".join(terms).replace("+ -", "- ") or "0"
    scaled = []
    forces = [pair for pair in (parser.friction, parser.stribeck) if pair is not None]
    for force, signal in forces:
        right_side += f" {force.as_text(signal)}"
        scaled += [force.coefficient] if isinstance(force.coefficient, str) else []
    right_side += {"constant": " + c", "ramp": " + (c + ramp t)"}.get(parser.offset or "", "")
    if divisor != [(1.0, None)]:
        scaled += ["c"] if parser.offset else []
        definitions += [f"{name} has become {_quotient_text([(1.0, name)], divisor)}" for name in scaled]
    return f"'{derivative(lead.order, lead.signal)} = {right_side}', where {', '.join(definitions)}"


def _signal_text(parser: EquationParser, signal: str) -> str:
    """Return the text of a signal with its delay, saturation and dead zone in a parsed equation."""

    def value_text(value: Value) -> str:
        return ":".join(f"{v:g}" for v in ((value,) if isinstance(value, (int, float)) else value))

    delay = parser.delays.get(signal, 0.0)
    text = signal if delay == 0.0 else f"{signal}(t - {value_text(delay)})"
    for kind in NONLINEARITY_KINDS:
        if (signal, kind) in parser.limits:
            text = f"{INPUT_EFFECT_ABBREVIATIONS[kind]}({text}, {value_text(parser.limits[signal, kind])})"
    return text


def _quotient_text(num: Sequence[tuple[float, str | None]], den: Sequence[tuple[float, str | None]]) -> str:
    """Return the quotient of two sums as text; each term of a sum is a (number, product of names) pair."""

    def product_text(factor: float, name: str | None) -> str:
        counts = Counter(name.split("*")) if name else {}
        texts = [part if count == 1 else f"{part}^{count}" for part, count in counts.items()]
        return "*".join([f"{factor:g}", *texts] if abs(factor) != 1.0 or not texts else texts)

    def sum_text(terms: Sequence[tuple[float, str | None]]) -> str:
        text = " + ".join("-" * (c == -1.0 and n is not None) + product_text(c, n) for c, n in terms)
        return text.replace("+ -", "- ")

    num_text, den_text = sum_text(num), sum_text(den)
    if list(den) == [(1.0, None)]:
        return num_text
    num_text = f"({num_text})" if len(num) > 1 else num_text
    return f"{num_text}/{den_text}" if re.fullmatch(r"\w+", den_text) else f"{num_text}/({den_text})"


def _friction_of(parser: EquationParser, output: str, divisor: float) -> Friction | None:
    """Return the friction of an equation, divided by the factor of its leading derivative; None without friction.

    Raise ModelError for friction of a signal other than the output, and for Stribeck without Coulomb friction.
    """
    for pair in (parser.friction, parser.stribeck):
        if pair is not None and pair[1] != output:
            raise ModelError(
                f"equation {parser.text!r}: friction opposes the velocity of the output of the equation, which is "
                f"{output}, not {pair[1]}; the sign of a measured velocity is the signal coulomb_{pair[1]}"
            )
    if parser.friction is None:
        if parser.stribeck is None:
            return None
        raise ModelError(
            f"equation {parser.text!r}: Stribeck friction is the excess of friction near rest over Coulomb friction; "
            f"add '- fc*sign(D {output})', or '- 0*sign(D {output})' without Coulomb friction"
        )
    scaled = replace(parser.friction[0], factor=parser.friction[0].factor / divisor)
    if parser.stribeck is None:
        return scaled
    return replace(scaled, stribeck=replace(parser.stribeck[0], factor=parser.stribeck[0].factor / divisor))


def _merge_nonlinearities(parsers: Sequence[EquationParser]) -> tuple[InputNonlinearity, ...]:
    """Return the saturations and dead zones in all equation texts; raise ModelError if texts differ for an input."""
    limits: dict[tuple[str, NonlinearityKind], Value] = {}
    for key, limit in chain.from_iterable(parser.limits.items() for parser in parsers):
        if limits.setdefault(key, limit) != limit:
            raise ModelError(
                f"{key[0]} has two different saturations or two different dead zones in these equations; use one"
            )
    unlimited = {signal for parser in parsers for signal in parser.unlimited}
    conflict = next((signal for signal, _ in limits if signal in unlimited), None)
    if conflict is not None:
        raise ModelError(
            f"{conflict} occurs with and without its limit, but an actuator limits all of its effects; limit it in "
            "each term, or give the limited input as another signal of the run"
        )
    return tuple(sort_nonlinearities([InputNonlinearity(s, kind, value) for (s, kind), value in limits.items()]))


def _merge_delays(parsers: Sequence[EquationParser], explicit_delays: Mapping[str, Value]) -> dict[str, Value]:
    """Return the delays in all equation texts and in the argument, by input; raise ModelError if an input has two."""
    delays: dict[str, Value] = {}
    for signal, delay in chain.from_iterable(parser.delays.items() for parser in parsers):
        if delays.setdefault(signal, delay) != delay:
            raise ModelError(
                f"{signal} has two delays in these equations; give the input with the longer delay its own name, "
                "and its own signal in the run"
            )
    nonzero_delays = {signal: delay for signal, delay in delays.items() if delay != 0.0}
    duplicate = next((signal for signal in explicit_delays if signal in nonzero_delays), None)
    if duplicate is not None:
        raise ModelError(
            f"the delay of {duplicate} is in the equation and in {parameter('delay')}; leave one of them out"
        )
    return {**nonzero_delays, **explicit_delays}
