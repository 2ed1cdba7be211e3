"""Typesetting of models in HTML: equations as MathML, and a table of parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from ftlm.estimation.output_error import JointFit
from ftlm.model.model import Model
from ftlm.model.parameter_estimates import Parameter, parameter_units
from ftlm.structure.equation import Equation, Term
from ftlm.structure.expression import Expression
from ftlm.structure.input_nonlinearity import (
    INPUT_EFFECT_ABBREVIATIONS,
    INPUT_EFFECT_LABELS,
    InputNonlinearity,
    input_name,
)
from ftlm.structure.order import Order
from ftlm.svg.html_page import Table
from ftlm.utils.formatting import GREEK_LETTERS, SYMBOL_PATTERN, Cell, Exact, format_bound, number, symbol, symbol_html
from ftlm.utils.statistics import NORMAL_95

#: Number of decimals of an order in a displayed equation; a model file stores all digits.
ORDER_DECIMALS = 4
#: Description of an offset by its kind, the part of its name before the first underscore.
OFFSET_PLACES = {"constant": "constant of the equation", "ramp": "ramp of the equation", "level": "level of the output"}
THIN_SPACE = Markup('<mspace width="0.17em"></mspace>')  # safe: a constant
_DELAYED_TIME = Markup("<mrow><mo>(</mo><mi>t</mi><mo>{}</mo>{}{}<mi>s</mi><mo>)</mo></mrow>")
_LIMITED_INPUT = Markup("<mrow><mi>{}</mi><mo>(</mo>{}<mo>,</mo>{}<mo>)</mo></mrow>")
_IN_PARENTHESES = Markup("<mrow><mo>(</mo>{}<mo>)</mo></mrow>")
_GAUSSIAN_DECAY = Markup(
    "<msup><mi>e</mi><mrow><mo>−</mo><msup><mrow><mo>(</mo>{}<mo>/</mo>{}<mo>)</mo></mrow><mn>2</mn></msup></mrow></msup>"
)
_PLAIN_DIGITS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def equation_html(
    equation: Equation,
    delay: Mapping[str, float] | None = None,
    limits: Sequence[InputNonlinearity] = (),
    offset: Mapping[str, float] | str = "",
) -> Markup:
    """Return an identified equation as MathML. Each term is an element, so that lines break between terms.

    Parameters
    ----------
    equation
        Equation with numerical coefficients.
    delay
        Delays of inputs [s] by name. An input with a delay is written u(t − 0.035 s), with a negative delay
        u(t + 0.035 s).
    limits
        Known saturations and dead zones of inputs. An input with a saturation is written sat(u, 0.94).
    offset
        Offset of the equation: estimates by kind (``"constant"``, ``"ramp"``) from one run, or a text to append.
    """
    parts = [_math(_derivative_math(equation.order, equation.output) + Markup("<mo>=</mo>"))]
    for k, term in enumerate(equation.terms):
        value = term.fixed_value or 0.0
        sign = "−" if value < 0 else "" if k == 0 else "+"
        # The sign of the first term is a prefix operator; the other signs are infix operators between terms.
        sign_math = Markup('<mo form="{}">{}</mo>').format("infix" if k else "prefix", sign) if sign else Markup("")
        parts.append(
            _math(sign_math + _number_math(abs(value)) + THIN_SPACE + _operand_math(term, delay or {}, limits), "term")
        )
    if equation.friction is not None:
        fc, fs, vs = equation.friction.law
        speed = _derivative_math(Order(1.0), equation.output)
        minus, sign = Markup('<mo form="infix">−</mo>'), Markup("<mi>sgn</mi><mo>(</mo>{}<mo>)</mo>").format(speed)
        parts.append(_math(minus + _number_math(fc) + THIN_SPACE + sign, "term"))
        if equation.friction.stribeck is not None:
            decay = _GAUSSIAN_DECAY.format(speed, _number_math(vs))
            parts.append(_math(minus + _number_math(fs) + THIN_SPACE + decay + THIN_SPACE + sign, "term"))
    if isinstance(offset, str):
        offset_text = offset.removeprefix(" + ")
        parts += (
            [_math(Markup('<mo form="infix">+</mo><mi>{}</mi>').format(offset_text), "term")] if offset_text else []
        )
    else:
        for name, value in offset.items():
            sign, time = Markup('<mo form="infix">{}</mo>').format("−" if value < 0 else "+"), _symbol_math("t")
            tail = THIN_SPACE + time if name == "ramp" else Markup("")
            parts.append(_math(sign + _number_math(abs(value)) + tail, "term"))
    return Markup('<span class="equation">{}</span>').format(Markup(" ").join(parts))


def equations_html(model: Model, offsets: Sequence[Mapping[str, Mapping[str, float]]] | None = None) -> list[Markup]:
    """Return the equations of a model as MathML.

    `offsets` has the estimated offsets of each run, by output and kind. They are shown as numbers for a single run, and
    as symbols otherwise.
    """
    structure = model.structure
    own_offsets = offsets[0] if offsets is not None and len(offsets) == 1 else {}
    return [
        equation_html(
            e,
            structure.delay,
            structure.limits,
            # An offset of kind "level" is omitted: it is added to the output, and is not a term of the equation.
            "" if "level" in own_offsets.get(e.output, {}) else own_offsets.get(e.output) or structure.offset_text,
        )
        for e in model.equations
    ]


def _math(content: Markup, name: str = "") -> Markup:
    kind = Markup(' class="{}"').format(name) if name else Markup("")
    return Markup("<math{}><mrow>{}</mrow></math>").format(kind, content)


def _number_math(value: float | Exact) -> Markup:
    mantissa, times, power = number(value).partition("×10")
    mantissa_math = Markup("<mn>{}</mn>").format(mantissa)
    if not times:
        return mantissa_math
    exponent = power.translate(_PLAIN_DIGITS)
    sign = Markup("<mo>−</mo>") if exponent.startswith("-") else Markup("")
    exponent_math = Markup("<mrow>{}<mn>{}</mn></mrow>").format(sign, exponent.lstrip("-"))
    return Markup("{}<mo>×</mo><msup><mn>10</mn>{}</msup>").format(mantissa_math, exponent_math)


def _rounded_number(value: float) -> Exact:
    """Return a delay or limit rounded to six significant digits, as a number that is displayed with all its digits."""
    return Exact(f"{value:.6g}")


def _symbol_math(name: str) -> Markup:
    parts = SYMBOL_PATTERN.fullmatch(name)
    if not parts:
        return Markup("<mi>{}</mi>").format(name)
    stem = Markup("<mi>{}</mi>").format(GREEK_LETTERS.get(parts[1], parts[1]))
    return Markup("<msub>{}<mn>{}</mn></msub>").format(stem, parts[2]) if parts[2] else stem


def _derivative_math(order: Order, signal: str, delay: float = 0.0, limits: Sequence[InputNonlinearity] = ()) -> Markup:
    text = _symbol_math(signal)
    if delay:
        text += _DELAYED_TIME.format("−" if delay > 0 else "+", _number_math(_rounded_number(abs(delay))), THIN_SPACE)
    for limit in limits:
        if limit.signal == signal and not isinstance(limit.value, tuple):
            text = _LIMITED_INPUT.format(
                INPUT_EFFECT_ABBREVIATIONS[limit.kind], text, _number_math(_rounded_number(float(limit.value)))
            )
    operator = _operator_math(order)
    return Markup("{}{}{}").format(operator, THIN_SPACE, text) if operator else text


def _operator_math(order: Order) -> Markup:
    """Return the differential operator D of an order as MathML; empty for order 0."""
    if not order.names and round(order.constant, ORDER_DECIMALS) == 0:
        return Markup("")
    if not order.names and round(order.constant, ORDER_DECIMALS) == 1:
        return Markup("<mi>D</mi>")
    value = Markup("<mi>{}</mi>").format(str(order)) if order.names else _signed_math(order.constant)
    return Markup("<msup><mi>D</mi>{}</msup>").format(value)


def _operand_math(term: Term, delay: Mapping[str, float], limits: Sequence[InputNonlinearity]) -> Markup:
    """Return a term without its coefficient as MathML: a derivative of a signal or of an expression."""
    expression = term.nonlinear
    if expression is None:
        return _derivative_math(term.order, term.signal, delay.get(term.signal, 0.0), limits)
    text = _expression_math(expression, delay, limits)
    operator = _operator_math(term.order)
    return operator + (_IN_PARENTHESES.format(text) if operator or expression.operation == "add" else text)


def _expression_math(item: Expression, delay: Mapping[str, float], limits: Sequence[InputNonlinearity]) -> Markup:
    """Return an expression of signals, with their delays and limits, as MathML."""
    match item.operation:
        case "constant":
            sign = Markup("<mo>−</mo>") if item.value < 0 else Markup("")
            return sign + _number_math(_rounded_number(abs(item.value)))
        case "channel":
            return _derivative_math(Order(item.value), item.signal, delay.get(item.signal, 0.0), limits)
    parts = [_expression_math(argument, delay, limits) for argument in item.arguments]
    first_argument = item.arguments[0]
    match item.operation:
        case "add":
            math = parts[0]
            for argument, part in zip(item.arguments[1:], parts[1:], strict=True):
                # The text of a summand with a negative factor already begins with its sign.
                math += part if argument.split_factor()[0] < 0 else Markup("<mo>+</mo>") + part
            return math
        case "multiply":
            if first_argument.operation == "constant" and first_argument.value == -1.0:
                parts[0] = Markup("<mo>−</mo>")
            operand_texts = [
                _IN_PARENTHESES.format(part) if argument.operation == "add" else part
                for argument, part in zip(item.arguments, parts, strict=True)
            ]
            return THIN_SPACE.join(operand_texts)
        case "power":
            is_simple = first_argument.operation == "abs" or (
                first_argument.operation == "channel" and first_argument.value == 0
            )
            base_math = parts[0] if is_simple else _IN_PARENTHESES.format(parts[0])
            return Markup("<msup><mrow>{}</mrow><mn>{}</mn></msup>").format(base_math, f"{item.value:g}")
        case "abs":
            return Markup("<mrow><mo>|</mo>{}<mo>|</mo></mrow>").format(parts[0])
        case "sqrt":
            return Markup("<msqrt>{}</msqrt>").format(parts[0])
    return Markup("<mi>{}</mi>{}").format(item.operation, _IN_PARENTHESES.format(parts[0]))


def _signed_math(value: float) -> Markup:
    value = round(value, ORDER_DECIMALS) + 0.0
    text = number(Exact(abs(value)))
    return Markup("<mrow><mo>−</mo><mn>{}</mn></mrow>" if value < 0 else "<mn>{}</mn>").format(text)


def derivative_html(order: Order, signal: str) -> Markup:
    """Return a derivative of a signal as HTML; the signal alone for order 0."""
    if not order.names and round(order.constant, ORDER_DECIMALS) == 0:
        return symbol_html(signal)
    text = str(order) if order.names else number(Exact(round(order.constant, ORDER_DECIMALS) + 0.0))
    operator = Markup("D") if text == "1" else Markup("D<sup>{}</sup>").format(text)
    return Markup("{} {}").format(operator, symbol_html(signal))


def parameter_table(
    model: Model, joint: JointFit | None = None, offsets: Mapping[str, Parameter] | None = None
) -> Table:
    """Return a table of orders and coefficients with standard errors, 95 % intervals, nominal values and units.

    Parameters
    ----------
    model
        Model. Standard errors and intervals come from its ``estimate`` if `joint` is None.
    joint
        Output-error fit of the model, with standard errors and intervals.
    offsets
        Offsets of the estimation runs by name; see :attr:`ftlm.Identification.offsets`.
    """
    reference = model.structure.nominal_values
    units = parameter_units(model)
    errors: Mapping[str, float | None] = {}
    extra: Mapping[str, float] = {}
    profiles: Mapping[str, tuple[float, float]] = {}
    if joint is not None:
        errors, extra = joint.standard_errors, joint.coefficients
        profiles = {n: (p.low, p.high) for n, p in joint.profiles.items()}
    elif model.estimate is not None:
        errors, extra = model.estimate.standard_errors, model.estimate.values
        profiles = {
            n: (-math.inf if low is None else low, math.inf if high is None else high)
            for n, (low, high) in model.estimate.intervals.items()
        }
    has_errors = any(e is not None for e in errors.values())

    def row(name: str, value: float, reference_value: float | None, description: str) -> list[Cell]:
        error = errors.get(name)
        half_width = None if error is None else NORMAL_95 * error
        interval: list[Cell] = [None, None] if half_width is None else [value - half_width, value + half_width]
        if name in profiles:
            interval = [v if math.isfinite(v) else format_bound(v) for v in profiles[name]]
        return [symbol_html(name), value, error, *interval, reference_value, units.get(name, ""), description]

    rows = [row(n, v if has_errors else Exact(v), None, "free order") for n, v in model.orders.items()]
    names = set(model.orders)
    for equation in model.equations:
        for term in equation.terms:
            if term.name is None:
                continue
            linear = term.nonlinear is None
            derivative = derivative_html(term.order, term.signal) if linear else term.format_operand({})
            description = Markup("of {} in the equation of {}").format(derivative, symbol_html(equation.output))
            reference_value = reference.get(term.name)
            names.add(term.name)
            # Adding 0.0 turns a negative zero, the product of signs, into a positive one.
            rows.append(
                row(
                    term.name,
                    float(term.coefficient),
                    None if reference_value is None else reference_value + 0.0,
                    description,
                )
            )
        if equation.friction is not None:
            stribeck = equation.friction.stribeck
            friction_texts = {equation.friction.name: "Coulomb friction"}
            if stribeck is not None:
                friction_texts |= {
                    stribeck.name: "Stribeck friction, beyond Coulomb's at rest,",
                    stribeck.speed_name: "Stribeck's speed",
                }
            for name, value in equation.friction.identified_coefficients.items():
                names.add(name)
                description = Markup("{} in the equation of {}").format(
                    friction_texts[name], symbol_html(equation.output)
                )
                rows.append(row(name, value, reference.get(name), description))
    inputs = {input_name("delay", n): (f"delay of {symbol(n)}", v) for n, v in model.structure.delay.items()}
    for limit in model.structure.limits:
        if not isinstance(limit.value, tuple):
            inputs[limit.name] = (f"{INPUT_EFFECT_LABELS[limit.kind]} of {symbol(limit.signal)}", limit.value)
    inputs = {n: delay_texts for n, delay_texts in inputs.items() if n in errors}
    rows += [
        row(n, v, None, "free in the coefficient law") for n, v in extra.items() if n not in names and n not in inputs
    ]
    rows += [row(n, v, None, description) for n, (description, v) in inputs.items()]
    for name, p in (offsets or {}).items():
        has_error = not math.isnan(p.standard_error)
        cells: list[Cell] = [p.standard_error, *p.interval] if has_error else [None, None, None]
        kind = OFFSET_PLACES[name.partition("_")[0]]
        rows.append([symbol_html(name), p.value, *cells, None, p.unit, f"{kind}, for this run only"])
    columns = ["parameter", "value", "standard error", "from", "to", "nominal", "unit", "what it is"]
    if has_errors:
        note = "Intervals assume that the model is correct. A coefficient without one is fixed or follows from the law."
        if profiles:
            note += f" Those of {', '.join(map(symbol, profiles))} are by profile likelihood, the others symmetric."
    else:
        note = "Without standard errors, the number of significant digits is unknown."
    omitted_columns = ([] if has_errors else [2, 3, 4]) + ([] if reference else [5]) + ([] if units else [6])
    if reference:
        note += " Nominal values belong to the integer orders of the manufacturer's model."
    column_indices = [i for i in range(len(columns)) if i not in omitted_columns]
    groups = (("", 3), ("95 % interval", 2), ("", len(column_indices) - 5)) if has_errors else ()
    shown_rows = [[cells[i] for i in column_indices] for cells in rows]
    return Table(
        "Orders and coefficients", tuple(columns[i] for i in column_indices), shown_rows, groups=groups, note=note
    )


def model_html(model: Model) -> str:
    """Return the equations of a model, and its parameter table unless it is empty, as HTML."""
    lines = Markup("").join(Markup("<p>{}</p>").format(e) for e in equations_html(model))
    has_values = model.orders or model.coefficients
    return str(lines + parameter_table(model).to_html() if has_values else lines)
