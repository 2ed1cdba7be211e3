"""Equivalent circuits of impedances, such as ``R0-p(R1,CPE1)-W1``: parsing, impedance and its derivatives."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ftlm.errors import ModelError
from ftlm.structure.polynomial import Polynomial, add_polynomial, multiply_polynomials
from ftlm.utils.arguments import check_arguments
from ftlm.utils.validation import Complex, Floats, as_floats, check_known

#: Part of a circuit. An element is (letters, name), and a group is ("series" or "parallel", list of parts).
Node: TypeAlias = tuple[str, Any]
#: Impedance [Ω], and the list of its derivatives with respect to the parameters.
Response: TypeAlias = tuple[Any, list[Any]]
#: Real part of sqrt(s tau) above which its hyperbolic tangent is 1 in double precision; sinh and cosh overflow at 700.
MAX_DIFFUSION_ARGUMENT = 40.0
_TOKEN_PATTERN = re.compile(r"p\(|[(),-]|[A-Za-z]+_?\d*")


def _diffusion(s: Complex, p: Sequence[float], *, reflecting: bool) -> Response:
    """Return the impedance of a finite diffusion layer with p = (R, tau), and its derivatives by ln R and ln tau.

    With `reflecting`, the end of the layer reflects; otherwise it transmits.
    """
    x = np.sqrt(s * p[1])
    x = np.where(x.real > MAX_DIFFUSION_ARGUMENT, MAX_DIFFUSION_ARGUMENT * (1 + 1j), x)
    tanh, root = np.tanh(x), np.sqrt(s * p[1])
    z = p[0] / (root * tanh) if reflecting else p[0] * tanh / root
    slope = x / np.sinh(2 * x)
    return z, [z, z * ((-slope if reflecting else slope) - 0.5)]


@dataclass(frozen=True)
class Element:
    """Kind of circuit element, such as a resistor.

    Parameters
    ----------
    description
        Name of the kind, such as "resistor".
    parameters
        Name suffix and unit of each parameter. The suffix is empty if the parameter has the name of the element.
    impedance
        Function of s and the parameters that returns the impedance and its derivatives. Derivatives are with respect to
        the logarithm of each positive parameter, but with respect to an exponent itself.
    ratio
        Function of the parameters that returns numerator and denominator of the impedance as sums of powers of s; None
        if the impedance is not such a ratio.
    """

    description: str
    parameters: tuple[tuple[str, str], ...]
    impedance: Callable[[Complex, Sequence[float]], Response]
    ratio: Callable[[Sequence[float]], tuple[Polynomial, Polynomial]] | None = None


def _power(sign: float, order: float) -> Callable[[Complex, Sequence[float]], Response]:
    """Return a function of s and p = (value,) that returns (value s^order)^sign and its derivative by ln value."""
    return lambda s, p: (z := (p[0] * s**order) ** sign, [sign * z])


def _constant_phase(s: Complex, p: Sequence[float]) -> Response:
    z = 1.0 / (p[0] * s ** p[1])
    return z, [-z, -np.log(s) * z]


def _gerischer(s: Complex, p: Sequence[float]) -> Response:
    z = p[0] / np.sqrt(1.0 + s * p[1])
    return z, [z, -0.5 * z * s * p[1] / (1.0 + s * p[1])]


SQUARE_ROOT_OF_2 = math.sqrt(2.0)
#: Kinds of elements by their letters. Parameters are defined as in impedance.py (doi:10.21105/joss.02349).
CIRCUIT_ELEMENTS = {
    "R": Element("resistor", (("", "Ω"),), _power(1.0, 0.0), lambda p: ({0.0: p[0]}, {0.0: 1.0})),
    "C": Element("capacitor", (("", "F"),), _power(-1.0, 1.0), lambda p: ({0.0: 1.0}, {1.0: p[0]})),
    "L": Element("inductor", (("", "H"),), _power(1.0, 1.0), lambda p: ({1.0: p[0]}, {0.0: 1.0})),
    "CPE": Element(
        "constant-phase element",
        (("_Q", "S s^alpha"), ("_alpha", "")),
        _constant_phase,
        lambda p: ({0.0: 1.0}, {p[1]: p[0]}),
    ),
    "W": Element(
        "Warburg diffusion",
        (("_sigma", "Ω s^-0.5"),),
        lambda s, p: (z := SQUARE_ROOT_OF_2 * p[0] / np.sqrt(s), [z]),
        lambda p: ({0.0: SQUARE_ROOT_OF_2 * p[0]}, {0.5: 1.0}),
    ),
    "Wo": Element(
        "open Warburg: finite diffusion, reflecting end",
        (("_R", "Ω"), ("_tau", "s")),
        lambda s, p: _diffusion(s, p, reflecting=True),
    ),
    "Ws": Element(
        "short Warburg: finite diffusion, transmitting end",
        (("_R", "Ω"), ("_tau", "s")),
        lambda s, p: _diffusion(s, p, reflecting=False),
    ),
    "G": Element("Gerischer element", (("_R", "Ω"), ("_tau", "s")), _gerischer),
}


def _letters(name: str) -> str:
    return name.rstrip("0123456789").rstrip("_")


@check_arguments
@dataclass(frozen=True)
class Circuit:
    """Equivalent circuit of an impedance.

    Parameters
    ----------
    text
        Circuit as text, such as ``R0-p(R1,CPE1)-W1``: ``-`` joins elements in series, and ``p(…, …)`` joins them in
        parallel. Elements are R, C, L, CPE (parameters Q, alpha), W (sigma: half-infinite diffusion), Wo and Ws (R,
        tau: open and short Warburg) and G (R, tau: Gerischer). A number after the letters makes each name unique.
    values
        Known parameter values by name (``R0``, ``CPE1_Q``, ``CPE1_alpha``, ``W1_sigma``) in Ω, F, H and s.

    Raises
    ------
    ModelError
        If an element is unknown, two elements have the same name, the text has a syntax error, or a value has an
        unknown name.
    """

    text: str
    values: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_known("value of the circuit", self.values, self.names)

    @cached_property
    def tree(self) -> Node:
        """Circuit as a tree of nested series and parallel groups; see :data:`Node`."""
        # Reports print a true minus sign between elements.
        text = "".join(c for c in self.text if not c.isspace()).replace("−", "-")
        tokens = _TOKEN_PATTERN.findall(text)
        invalid = _TOKEN_PATTERN.sub("", text)
        if invalid:
            raise ModelError(
                f"circuit {self.text!r} contains invalid characters ({len(invalid)}, first {invalid[0]!r}); write it "
                "as in 'R0-p(R1,CPE1)-W1', where - joins elements in series and p(…,…) in parallel"
            )
        names: set[str] = set()

        def group(kind: str, parts: list[Node]) -> Node:
            return parts[0] if len(parts) == 1 else (kind, parts)

        def series() -> Node:
            parts = [single()]
            while tokens and tokens[0] == "-":
                tokens.pop(0)
                parts.append(single())
            return group("series", parts)

        def single() -> Node:
            if not tokens:
                raise ModelError(f"circuit {self.text!r} ends where an element is expected; write one, as in R0-C1")
            token = tokens.pop(0)
            if token == "p(":
                parts = [series()]
                while tokens and tokens[0] == ",":
                    tokens.pop(0)
                    parts.append(series())
                if not tokens or tokens.pop(0) != ")":
                    raise ModelError(f"circuit {self.text!r}: a parenthesis is not closed; write p(R1,C1)")
                if len(parts) == 1:
                    raise ModelError(
                        f"circuit {self.text!r}: p(…) joins two or more elements in parallel, and one has a single "
                        "branch; write p(R1,C1), or leave p( ) out"
                    )
                return group("parallel", parts)
            if token in ("P", "("):
                raise ModelError(f"circuit {self.text!r}: write p( before elements in parallel, as in p(R1,C1)")
            if _letters(token) not in CIRCUIT_ELEMENTS:
                kinds = [kind for kind in CIRCUIT_ELEMENTS if token.startswith(kind)]
                if kinds:
                    raise ModelError(
                        f"circuit {self.text!r}: {token!r} is not an element; a name is a kind and a number, such as "
                        f"{max(kinds, key=len)}1"
                    )
                elements = ", ".join(f"{n} ({e.description})" for n, e in CIRCUIT_ELEMENTS.items())
                raise ModelError(
                    f"circuit {self.text!r}: {token!r} is not an element; known: {elements}, and p(…,…); an equation "
                    "needs '='"
                )
            if token in names:
                raise ModelError(f"circuit {self.text!r}: two elements are {token}; number them, such as R0 and R1")
            names.add(token)
            return _letters(token), token

        tree = series()
        if tokens:
            raise ModelError(f"circuit {self.text!r}: {tokens[0]!r} is out of place; join elements by - or p(…,…)")
        return tree

    @cached_property
    def elements(self) -> list[tuple[str, str]]:
        """(letters, name) of every element, such as ("CPE", "CPE1"), from left to right."""

        def walk(node: Node) -> list[tuple[str, str]]:
            kind, body = node
            return [item for part in body for item in walk(part)] if kind in ("series", "parallel") else [(kind, body)]

        return walk(self.tree)

    @cached_property
    def units(self) -> dict[str, str]:
        """Unit of every parameter by name; that of ``CPE1_Q`` contains the exponent ``CPE1_alpha`` if it is known."""
        units = {
            name + suffix: unit for kind, name in self.elements for suffix, unit in CIRCUIT_ELEMENTS[kind].parameters
        }
        exponents = {n: self.values.get(n.replace("_Q", "_alpha")) for n in units if n.endswith("_Q")}
        return units | {n: f"S s^{v:.4g}" for n, v in exponents.items() if v is not None}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return tuple(n + suffix for kind, n in self.elements for suffix, _ in CIRCUIT_ELEMENTS[kind].parameters)

    @property
    def free_names(self) -> tuple[str, ...]:
        """Names of the parameters without a known value."""
        return tuple(n for n in self.names if n not in self.values)

    def with_values(self, values: Mapping[str, float]) -> Circuit:
        """Return the circuit with further known parameter values by name; they replace existing ones."""
        return replace(self, values={**self.values, **values})

    def impedance(self, w: ArrayLike) -> Complex:
        """Return the complex impedance [Ω] at positive angular frequencies [rad/s]; all parameters must have values."""
        return impedance_and_derivatives(self, as_floats("w", w), {})[0]

    def polynomials(self) -> tuple[Polynomial, Polynomial]:
        """Return numerator and denominator of the impedance, each as coefficients by power of s.

        All parameters must have values.

        Raises
        ------
        ModelError
            If the impedance of an element is not a ratio of sums of powers of s.
        """

        def add_ratios(parts: Sequence[tuple[Polynomial, Polynomial]]) -> tuple[Polynomial, Polynomial]:
            (numerator, denominator), *others = parts
            for other_numerator, other_denominator in others:
                numerator = multiply_polynomials(numerator, other_denominator)
                add_polynomial(numerator, multiply_polynomials(other_numerator, denominator))
                denominator = multiply_polynomials(denominator, other_denominator)
            return numerator, denominator

        def ratio(node: Node) -> tuple[Polynomial, Polynomial]:
            kind, body = node
            if kind in ("series", "parallel"):
                parts = [ratio(part) for part in body]
                return add_ratios(parts) if kind == "series" else add_ratios([(b, a) for a, b in parts])[::-1]
            element = CIRCUIT_ELEMENTS[kind]
            if element.ratio is None:
                raise ModelError(
                    f"{body} ({element.description}) has no equation with powers of s; use .circuit.impedance(w) for "
                    "the response, or approximate it by p(R,CPE) for a model over time"
                )
            return element.ratio([self.values[body + suffix] for suffix, _ in element.parameters])

        return ratio(self.tree)

    def __str__(self) -> str:
        return "".join(c for c in self.text if not c.isspace())


def impedance_and_derivatives(
    circuit: Circuit, w: Floats, parameters: Mapping[str, float], node: Node | None = None
) -> tuple[Complex, dict[str, Complex]]:
    """Return the complex impedance [Ω] of a circuit or a part of it, and its derivatives by parameter name.

    Derivatives are with respect to the logarithm of a parameter, but with respect to an exponent alpha itself.

    Parameters
    ----------
    circuit
        Circuit with values.
    w
        Angular frequencies [rad/s].
    parameters
        Parameter values by name, in addition to the values in the circuit.
    node
        Part of the circuit's tree; None for the whole circuit.
    """
    kind, body = node or circuit.tree
    if kind not in ("series", "parallel"):
        names = [body + suffix for suffix, _ in CIRCUIT_ELEMENTS[kind].parameters]
        values = {**circuit.values, **parameters}
        z, derivatives = CIRCUIT_ELEMENTS[kind].impedance(
            np.asarray(1j * w, dtype=np.complex128), [values[n] for n in names]
        )
        return z, dict(zip(names, derivatives, strict=True))
    parts = [impedance_and_derivatives(circuit, w, parameters, part) for part in body]
    if kind == "series":
        total = np.asarray(np.sum([z for z, _ in parts], axis=0), dtype=np.complex128)
        return total, {n: derivative for _, derivatives in parts for n, derivative in derivatives.items()}
    total = np.asarray(1.0 / np.sum([1.0 / z for z, _ in parts], axis=0), dtype=np.complex128)
    return total, {
        n: (total / z) ** 2 * derivative for z, derivatives in parts for n, derivative in derivatives.items()
    }
