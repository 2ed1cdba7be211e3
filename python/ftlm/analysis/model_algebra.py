"""Models from transfer functions with real powers of s, their connections, and linearization of models."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

from ftlm.analysis.frequency_response import check_no_input_nonlinearity, transfer_functions
from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.structure.equation import Equation, Term
from ftlm.structure.expression import Channel, channel
from ftlm.structure.grammar import EquationParser
from ftlm.structure.order import MAX_ORDER, Order
from ftlm.structure.parser import equation
from ftlm.structure.polynomial import Polynomial, add_polynomial, multiply_polynomials
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import check_known, real_number

#: Magnitude of the coefficient of the highest derivative, 1 before linearization, below which it counts as 0.
CANCELLATION_TOLERANCE = 1e-12
#: (coefficient, power) of a term.
Pair = tuple[float, float]


@dataclass(frozen=True)
class Ratio:
    """Transfer function: `numerator` and `denominator` with real powers of s, and a delay [s]."""

    numerator: Polynomial
    denominator: Polynomial
    delay: float

    def model(self, output: str, signal: str, *, improper_order: float = 0.0) -> Model:
        """Return the model of this transfer function as an equation.

        The order of the numerator may exceed the order of the denominator by at most `improper_order`. Raise ModelError
        if it exceeds this limit, if the numerator or denominator is 0, or if the order of the denominator is not in (0,
        10].
        """
        denominator, numerator = (
            {p: c for p, c in polynomial.items() if c != 0.0} for polynomial in (self.denominator, self.numerator)
        )
        if not denominator or not numerator:
            raise ModelError(
                f"the {'denominator' if numerator else 'numerator'} is 0, so the result is not a model; change an "
                "operand"
            )
        # Powers below 0 are integrals of a signal; a multiplication by a power of s removes them from the equation.
        shift = -min(0.0, *denominator, *numerator)
        highest = max(denominator)
        order, gain = highest + shift, denominator[highest]
        if max(numerator) > highest + improper_order:
            raise ModelError(
                f"the numerator is of order {max(numerator) + shift:g} and the denominator of order {order:g}, so a "
                "step "
                "would give an infinite output; add a fast pole, or identify it from frequency responses with "
                "identify_frequency"
            )
        if not 0 < order <= MAX_ORDER:
            raise ModelError(
                f"the denominator is of order {order:g}; an equation has an order above 0, at most {MAX_ORDER:g}"
            )
        terms = [(-c / gain, output, p + shift) for p, c in denominator.items() if p != highest]
        terms += [(c / gain, signal, p + shift) for p, c in numerator.items()]
        right_side = " + ".join(f"{c!r} D^{p!r} {name}" for c, name, p in terms).replace("+ -", "- ")
        delay = {signal: self.delay} if self.delay else None
        return Model(equation(f"D^{order!r} {output} = {right_side}", delay=delay))


@check_arguments
def transfer_function(
    num: Sequence[float] | Sequence[Pair] | tuple[Sequence[float], Sequence[float]],
    den: Sequence[float] | Sequence[Pair] | tuple[Sequence[float], Sequence[float]],
    delay: float = 0.0,
    *,
    output: str = "y",
    input: str = "u",
) -> Model:
    """Return a model from the numerator and denominator of a transfer function.

    Parameters
    ----------
    num, den
        Coefficients of s^n, …, s, 1 as in python-control and MATLAB; or, for fractional powers, pairs (coefficient,
        power) or a tuple of two lists, the coefficients and the powers. FOMCON's ``fotf(a, na, b, nb)`` is
        ``transfer_function((b, nb), (a, na))``.
    delay
        Delay of the input [s], ≥ 0.
    output, input
        Names of the signals.

    Returns
    -------
    Model
        Model of ``output = num / den exp(-s delay) input``, as an equation with leading coefficient 1.

    Raises
    ------
    ModelError
        If the numerator has a higher power than the denominator, the denominator has no power above 0 or one above 10,
        a list is empty or of another form, coefficients and powers differ in number, a number is not finite, the delay
        is negative, or output and input have the same name.

    Examples
    --------
    >>> print(ftlm.transfer_function([1], [(2, 1.5), (1, 0)], 0.1).equations[0])
    D^1.5 y = -0.5 y + 0.5 u
    """
    if isinstance(delay, Real) and delay < 0:
        raise ModelError(f"the delay of {delay:g} s is below 0: the output would lead its input; give 0 or more")
    if output == input:
        raise ModelError(f"{output!r} is the name of the output and of the input; give two different names")
    return Ratio(_polynomial("num", num), _polynomial("den", den), delay).model(output, input)


def _polynomial(name: str, values_argument: Any) -> Polynomial:
    """Return a polynomial from coefficients in descending powers, (coefficient, power) pairs, or a tuple of two lists.

    The lists are the coefficients and the powers. `name` names the argument in messages. Raise ModelError for other
    input.
    """
    if isinstance(values_argument, zip):
        raise ModelError(
            f"{name} is a zip, which omits entries of the longer list; give ({name} coefficients, powers), a tuple of "
            "two lists"
        )
    values = list(values_argument)
    if (
        isinstance(values_argument, tuple)
        and len(values) == 2
        and not any(isinstance(v, (Real, tuple)) for v in values)
    ):
        coefficients, powers = (list(numbers) for numbers in values)
        if len(coefficients) != len(powers):
            raise ModelError(
                f"{name} has {plural(len(coefficients), 'coefficient')} and {plural(len(powers), 'power')}; "
                f"give one power for each "
                "coefficient"
            )
        values = list(zip(coefficients, powers, strict=True))
    pairs = [v if isinstance(v, (tuple, list)) else (v, len(values) - 1.0 - k) for k, v in enumerate(values)]
    out: Polynomial = {}
    for k, pair in enumerate(pairs):
        if len(pair) != 2 or not all(isinstance(v, Real) and math.isfinite(v) for v in pair):
            raise ModelError(
                f"{name}[{k}] is {values[k]!r}; give finite coefficients of s^n, …, s, 1, or pairs (coefficient, power)"
            )
        add_polynomial(out, {float(pair[1]): float(pair[0])})
    if not any(out.values()):
        raise ModelError(f"{name} has no coefficient other than 0; give at least one")
    return out


def _ratio(model: Model, operation: str) -> tuple[Ratio, str, str]:
    """Return (transfer function, output name, input name) of a linear model with one output and one input.

    `operation` names the operation in messages. Raise ModelError for other models.
    """
    check_no_input_nonlinearity(model, operation)
    if model.structure.has_friction or model.structure.sensor_filter is not None:
        raise ModelError(
            f"{operation} requires a linear model without friction and sensor filter; leave these out of the equation"
        )
    transfer = transfer_functions(model)
    if len(transfer.outputs) != 1 or len(transfer.inputs) != 1:
        raise ModelError(
            f"{operation} requires a model with one output and one input; this model has "
            f"{', '.join(transfer.outputs)} from "
            f"{', '.join(transfer.inputs) or 'no input'}"
        )
    (output,), (signal,) = transfer.outputs, transfer.inputs
    numerator = {p: c for c, p in transfer.numerators[output, signal]}
    denominator = {p: c for c, p in transfer.denominator[output]}
    return Ratio(numerator, denominator, transfer.delay[signal]), output, signal


def series(first: Model, second: Model) -> Model:
    """Return the series connection of `first` followed by `second`; see :meth:`ftlm.Model.series`."""
    (a, _, signal), (b, output, _) = _ratio(first, "a series"), _ratio(second, "a series")
    numerator, denominator = (
        multiply_polynomials(a.numerator, b.numerator),
        multiply_polynomials(a.denominator, b.denominator),
    )
    return Ratio(numerator, denominator, a.delay + b.delay).model(_distinct_name(output, signal), signal)


def combine(operator: str, left: Model | float, right: Model | float, operation: str | None = None) -> Model:
    """Return the product, sum, difference or quotient of two models, or of a model and a number, as one model.

    `operator` is ``"*"``, ``"+"``, ``"-"`` or ``"/"``. Messages name `operation`, by default the operator. In a
    product, `right` acts first, as in python-control. Raise ModelError in the cases of :meth:`ftlm.Model.series`,
    :meth:`ftlm.Model.parallel` and :meth:`ftlm.Model.inverse`.
    """
    (a, output, _), (b, _, signal) = (
        _operand(operand, operation or f"the operator {operator}") for operand in (left, right)
    )
    if operator in "+-" and a.delay != b.delay:
        raise ModelError(
            f"the delays are {a.delay:g} s and {b.delay:g} s, but a sum of models has one delay of its input; add the "
            "simulated outputs"
        )
    if operator == "/" and b.delay:
        raise ModelError(f"the divisor has a delay of {b.delay:g} s, so its inverse is not causal; leave the delay out")
    if operator == "/":
        b = Ratio(b.denominator, b.numerator, 0.0)
    numerator, denominator = (
        multiply_polynomials(a.numerator, b.numerator),
        multiply_polynomials(a.denominator, b.denominator),
    )
    delay = a.delay + b.delay
    if operator in "+-":
        numerator, delay = multiply_polynomials(a.numerator, b.denominator), a.delay
        add_polynomial(numerator, multiply_polynomials(b.numerator, a.denominator), 1.0 if operator == "+" else -1.0)
    if not isinstance(left, Model):
        output = _operand(right, "")[1]
    if not isinstance(right, Model) or operator != "*":
        signal = _operand(left if isinstance(left, Model) else right, "")[2]
    return Ratio(numerator, denominator, delay).model(_distinct_name(output, signal), signal)


def _operand(operand: Model | float, operation: str) -> tuple[Ratio, str, str]:
    """Return (transfer function, output name, input name) of a model; for a number, a gain without signals."""
    return (
        _ratio(operand, operation)
        if isinstance(operand, Model)
        else (Ratio({0.0: float(operand)}, {0.0: 1.0}, 0.0), "", "")
    )


def feedback(forward: Model, back: Model | float, sign: int) -> Model:
    """Return the closed loop of two models; see :meth:`ftlm.Model.feedback`."""
    if sign not in (-1, 1):
        raise ModelError(
            f"{parameter('sign', sign)} is neither -1 nor 1; give -1 for negative feedback, or 1 for positive feedback"
        )
    a, output, signal = _ratio(forward, "feedback")
    b, _, _ = _operand(back, "feedback")
    if a.delay or b.delay:
        raise ModelError(
            f"the loop has a delay of {a.delay + b.delay:g} s, and a closed loop with a delay is not an equation; use "
            "frequency_response of both, or ftlm.control"
        )
    denominator = multiply_polynomials(a.denominator, b.denominator)
    add_polynomial(denominator, multiply_polynomials(a.numerator, b.numerator), -float(sign))
    return Ratio(multiply_polynomials(a.numerator, b.denominator), denominator, 0.0).model(output, signal)


def inverse(model: Model) -> Model:
    """Return the model with output and input exchanged; see :meth:`ftlm.Model.inverse`."""
    ratio, output, signal = _ratio(model, "an inverse")
    if ratio.delay:
        raise ModelError(f"the inverse would need the output {ratio.delay:g} s in advance; leave the delay out")
    return Ratio(ratio.denominator, ratio.numerator, 0.0).model(signal, output)


def _distinct_name(output: str, signal: str) -> str:
    """Return the name of an output, with the suffix ``_out`` if it equals the name of the input."""
    return output if output != signal else f"{output}_out"


def linearize(model: Model, at: Mapping[str, float]) -> Model:
    """Return the linear model of small deviations from an operating point; see :meth:`ftlm.Model.linearized`."""
    pairs = [(c, t) for e in model.equations for t in e.nonlinear_terms for c in (t.nonlinear or channel("")).channels]
    channels = list(dict.fromkeys(c for c, _ in pairs))
    names = {str(channel(*c)): c for c in channels}
    point = {_channel_of(name): real_number(f"operating point of {name}", value) for name, value in at.items()}
    check_known("operating point", [str(channel(*c)) for c in point], list(names))
    for c in channels:
        if c not in point and c[1] == 0:
            raise ModelError(
                f"the operating point of {c[0]} is not given, and {next(t for k, t in pairs if k == c)} depends on it; "
                f"give its value with {parameter('at')}"
            )
    values = {c: point.get(c, 0.0) for c in channels}
    equations = tuple(_linearized_equation(equation, values) for equation in model.equations)
    return replace(model, structure=replace(model.structure, equations=equations), estimate=None)


def _channel_of(name: str) -> Channel:
    """Return (signal, order of the derivative) for a text such as ``y`` or ``D^0.5 y``; raise ModelError for others."""
    parsed = EquationParser(name).parse_expression()
    if parsed.operation != "channel":
        raise ModelError(f"the operating point {name!r} is not a signal or derivative of one; write 'y' or 'D y'")
    return parsed.signal, parsed.value


def _linearized_equation(equation: Equation, values: Mapping[Channel, float]) -> Equation:
    """Return an equation with every non-linear term replaced by its first-order terms, without constants.

    `values` is the operating point. Raise ModelError if a term has no derivative there, or the highest derivative
    cancels.
    """
    if not equation.nonlinear_terms:
        return equation
    terms = [t for t in equation.terms if t.nonlinear is None]
    slopes: dict[tuple[str, Order], float] = {}
    for term in equation.nonlinear_terms:
        expression = term.nonlinear
        assert expression is not None
        for (signal, order), slope in expression.gradient(values).items():
            if not math.isfinite(slope):
                point_text = ", ".join(f"{channel(*c)} = {values[c]:g}" for c in expression.channels)
                raise ModelError(f"{expression} has no derivative at {point_text}; choose another operating point")
            column = signal, Order(round(term.order.constant + order, 9))
            slopes[column] = slopes.get(column, 0.0) + float(term.fixed_value or 0.0) * float(slope)
    leading_coefficient = 1.0 - slopes.pop((equation.output, equation.order), 0.0)
    if abs(leading_coefficient) <= CANCELLATION_TOLERANCE:
        raise ModelError(
            f"the highest derivative of {equation.output} cancels at this operating point; choose another one"
        )
    for k, term in enumerate(terms):
        if (term.signal, term.order) in slopes:
            value = float(term.fixed_value or 0.0) + slopes.pop((term.signal, term.order))
            terms[k] = Term(term.signal, term.order, value)
    terms += [
        Term(signal, order, slope) for (signal, order), slope in slopes.items() if slope or signal != equation.output
    ]
    if leading_coefficient != 1.0:
        terms = [Term(t.signal, t.order, float(t.fixed_value or 0.0) / leading_coefficient) for t in terms]
    return replace(equation, terms=tuple(terms))
