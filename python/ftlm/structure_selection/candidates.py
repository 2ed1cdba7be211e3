"""Structures nested in a given structure: fewer terms, integer or free orders, with or without an offset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from msgspec import UNSET

from ftlm.errors import ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.structure.equation import Equation, Term
from ftlm.structure.input_nonlinearity import input_name
from ftlm.structure.parser import as_structure
from ftlm.structure.structure import Structure, restrict_structure

#: Integer values that replace a free order.
INTEGER_ORDER_VALUES = (0.0, 1.0, 2.0, 3.0)


@dataclass(frozen=True)
class Variant:
    """Choice of terms, integer orders, offset and input parameters that defines a nested structure.

    Parameters
    ----------
    coefficients
        Names of the coefficients of its terms.
    integer_orders
        (name, value) of orders that are fixed to integers; all others are free.
    offset
        Whether each run has an unknown constant offset.
    inputs
        Names of its free delays and input non-linearities. Optional ones that are not named are absent.
    frictions
        Names of its friction terms, as in :attr:`NestedStructures.frictions`.
    """

    coefficients: frozenset[str]
    integer_orders: tuple[tuple[str, float], ...]
    offset: bool
    inputs: frozenset[str] = frozenset()
    frictions: frozenset[str] = frozenset()

    def integer_order_values(self) -> dict[str, float]:
        """Values of the orders that are fixed to integers, by name."""
        return dict(self.integer_orders)

    def with_integer_orders(self, values: Mapping[str, float | None]) -> Variant:
        """Return the variant with some orders fixed to integers, or free if the value is None."""
        orders = {**self.integer_order_values(), **values}
        return replace(self, integer_orders=tuple(sorted((n, v) for n, v in orders.items() if v is not None)))


@dataclass(frozen=True)
class Change:
    """Variant that results from a change, with a description of the change."""

    words: str
    variant: Variant


@dataclass(frozen=True)
class NestedStructures:
    """Structure whose optional elements define the set of structures nested in it.

    Optional elements are an offset if the structure allows one, free delays, free input non-linearities, and friction
    with a free coefficient. In a single equation without order or coefficient law, terms with a free coefficient are
    also optional. An order that is a single parameter may be fixed to an integer.
    """

    structure: Structure

    @property
    def droppable(self) -> tuple[str, ...]:
        """Names of the coefficients of optional terms."""
        structure = self.structure
        if structure.has_order_law or structure.coefficient_law or len(structure.equations) > 1:
            return ()
        return tuple(t.coefficient for t in structure.equations[0].terms if isinstance(t.coefficient, str))

    @property
    def offset_allowed(self) -> bool:
        """Whether the structures may have an offset."""
        return self.structure.offset in ("auto", "constant")

    @property
    def frictions(self) -> dict[str, str | None]:
        """Optional friction terms by name, each with the friction term that it requires or None.

        Stribeck friction requires Coulomb friction.
        """
        out: dict[str, str | None] = {}
        for equation in self.structure.equations:
            friction = equation.friction
            if friction is None:
                continue
            friction_name = f"friction of {equation.output}"
            if isinstance(friction.coefficient, str):
                out[friction_name] = None
            if friction.stribeck is not None and isinstance(friction.stribeck.coefficient, str):
                out[f"{friction_name} near rest"] = friction_name if friction_name in out else None
        return out

    def _with_frictions(self, equation: Equation, frictions: frozenset[str]) -> Equation:
        """Return an equation with all mandatory friction terms and the given optional friction terms."""
        friction, friction_name, choices = equation.friction, f"friction of {equation.output}", self.frictions
        if friction is None:
            return equation
        if friction_name in choices and friction_name not in frictions:
            return replace(equation, friction=None)
        stribeck_name = f"{friction_name} near rest"
        return (
            replace(equation, friction=replace(friction, stribeck=None))
            if stribeck_name in choices and stribeck_name not in frictions
            else equation
        )

    @property
    def without_optional_friction(self) -> Structure:
        """Structure without its optional friction terms."""
        equations = tuple(self._with_frictions(e, frozenset()) for e in self.structure.equations)
        return replace(self.structure, equations=equations)

    def build(self, variant: Variant) -> Structure:
        """Return the structure of a variant."""
        structure, droppable = self.structure, set(self.droppable)
        equations = []
        for equation in structure.equations:
            terms = tuple(
                t for t in equation.terms if t.coefficient not in droppable or t.coefficient in variant.coefficients
            )
            equations.append(self._with_frictions(replace(equation, terms=terms), variant.frictions))
        dropped = {i.name for i in structure.free_input_parameters} - variant.inputs
        candidate = restrict_structure(
            structure,
            tuple(equations),
            offset=structure.offset if structure.offset == "ramp" else "constant" if variant.offset else "none",
        )
        candidate = replace(
            candidate,
            free_delays={n: v for n, v in candidate.free_delays.items() if input_name("delay", n) not in dropped},
            input_nonlinearities=tuple(x for x in candidate.limits if x.name not in dropped) or UNSET,
        )
        return candidate.with_orders({n: v for n, v in variant.integer_orders if n in candidate.order_names})

    def is_valid(self, variant: Variant) -> bool:
        """Whether a variant can be built, with distinct orders of each signal.

        The orders of output terms must be below the order of the equation.
        """
        try:
            candidate = self.build(variant)
        except ModelError:
            return False
        for equation in candidate.equations:
            columns_and_orders = [(t.column, t.order.constant) for t in equation.terms if not t.order.names]
            if len(set(columns_and_orders)) < len(columns_and_orders):
                return False
            output_orders = [order for signal, order in columns_and_orders if signal == equation.output]
            if not equation.order.names and any(o >= equation.order.constant for o in output_orders):
                return False
        return True

    def integer_values(self, name: str) -> list[float]:
        """Return the integers to which a free order may be fixed."""
        problem = FreeProblem.of(self.structure)
        low, high = problem.bounds[problem.orders.index(name)]
        return [v for v in INTEGER_ORDER_VALUES if low <= v <= high and (v > 0 or name not in self._highest)] or [
            round(0.5 * (low + high), 6)
        ]

    @property
    def _highest(self) -> set[str]:
        return {n for e in self.structure.equations for n in e.order.names}

    def simplest(self) -> Iterator[Change]:
        """Yield the simplest variants: integer orders, the terms of the output, and one input term."""
        free = [n for n in self.structure.order_names if n in self._highest]
        tops: list[dict[str, float]] = [{}]
        for name in free:
            tops = [{**orders, name: v} for orders in tops for v in self.integer_values(name) if v > 0]
        for orders in tops:
            variant = self._with_output_terms(orders)
            if variant is None:
                continue
            # A non-linear term that contains the output is not an input term.
            equation = self.structure.equations[0]
            input_terms = [
                t for t in equation.terms if t.coefficient in self.droppable and equation.output not in t.signals
            ]
            has_fixed_terms = any(
                not self._is_optional_output_term(t) and t.fixed_value is not None for t in equation.terms
            )
            if not input_terms or has_fixed_terms:
                yield Change(describe_structure(self.build(variant)), variant)
                continue
            for term in input_terms:
                yield from self._with_term(variant, term)

    def highest_orders(self, variant: Variant) -> tuple[float | None, ...]:
        """Return the order of each equation in a variant if it is fixed to an integer, else None."""
        orders = variant.integer_order_values()
        return tuple(orders.get(n) for n in sorted(self._highest))

    def _is_optional_output_term(self, term: Term) -> bool:
        return any(term in e.terms and term.column == e.output for e in self.structure.equations)

    def _with_output_terms(self, highest_order_values: Mapping[str, float]) -> Variant | None:
        """Return the variant with all output terms at distinct integer orders and all mandatory terms; None if invalid.

        `highest_order_values` are the integer values of the highest orders by name.
        """
        droppable = self.droppable
        integer_orders: dict[str, float] = dict(highest_order_values)
        names_used: list[str] = []
        for equation in self.structure.equations:
            highest = (
                highest_order_values.get(equation.order.names[0])
                if equation.order.is_single
                else equation.order.constant
            )
            values_used = {
                t.order.constant for t in equation.terms if t.column == equation.output and not t.order.names
            }
            for term in equation.terms:
                if term.order.is_single and term.order.names[0] in integer_orders:
                    continue
                is_output_term = term.column == equation.output
                if not is_output_term and term.coefficient in droppable:
                    continue
                if term.order.is_single:
                    name = term.order.names[0]
                    values = [
                        v
                        for v in self.integer_values(name)
                        if not is_output_term or (v < (highest or 0.0) and v not in values_used)
                    ]
                    if not values:
                        if term.coefficient in droppable:
                            continue
                        return None
                    # The last output term with a free order is damping (order 1). Output terms before it have lower
                    # orders.
                    later_terms = equation.terms[equation.terms.index(term) + 1 :]
                    has_lower_term = any(t.column == equation.output and t.order.is_single for t in later_terms)
                    value = (
                        1.0
                        if is_output_term and 1.0 in values and not (has_lower_term and 0.0 in values)
                        else values[0]
                    )
                    integer_orders[name] = value
                    values_used |= {value} if is_output_term else set()
                elif is_output_term and not term.order.names and term.order.constant >= (highest or 0.0):
                    if term.coefficient in droppable:
                        continue
                    return None
                if isinstance(term.coefficient, str):
                    names_used.append(term.coefficient)
        names_used += [n for n in self.structure.coefficient_names if n not in droppable]
        variant = Variant(
            frozenset(names_used), tuple(sorted(integer_orders.items())), self.structure.offset == "constant"
        )
        # Without output terms, the equation becomes valid only when an input term is added.
        has_output_term = any(
            self._is_optional_output_term(t) for equation in self.structure.equations for t in equation.terms
        )
        return variant if self.is_valid(variant) or not has_output_term else None

    def _with_term(self, variant: Variant, term: Term) -> Iterator[Change]:
        """Yield the variants with one more term, at each integer value of its order."""
        assert isinstance(term.coefficient, str)
        extended = replace(variant, coefficients=variant.coefficients | {term.coefficient})
        variants = [extended]
        if term.order.is_single and term.order.names[0] not in variant.integer_order_values():
            name = term.order.names[0]
            variants = [extended.with_integer_orders({name: v}) for v in self.integer_values(name)]
            if self._is_optional_output_term(term):
                # If other output terms occupy all integer orders, the order is free from the start.
                variants = [v for v in variants if self.is_valid(v)] or [extended]
        for smaller in variants:
            if self.is_valid(smaller):
                yield Change(f"+ {self._term_in(smaller, term)}", smaller)

    def _term_in(self, variant: Variant, term: Term) -> str:
        """Return the text of a term at its order in a variant."""
        candidate = self.build(variant)
        match = next(t for e in candidate.equations for t in e.terms if t.coefficient == term.coefficient)
        return str(match)

    def richest(self, variant: Variant) -> Variant:
        """Return the variant extended by all terms for which an unused integer order remains."""
        for equation in self.structure.equations:
            for term in equation.terms:
                if term.coefficient in self.droppable and term.coefficient not in variant.coefficients:
                    variants = [c.variant for c in self._with_term(variant, term)]
                    free = set(self.build(variant).order_names)
                    variant = next((v for v in variants if set(self.build(v).order_names) <= free), variant)
        return variant

    def larger(self, variant: Variant) -> Iterator[Change]:
        """Yield every valid variant with one more term, free order, offset, free input parameter or friction term."""
        for equation in self.structure.equations:
            for term in equation.terms:
                if term.coefficient in self.droppable and term.coefficient not in variant.coefficients:
                    yield from self._with_term(variant, term)
        present = self.build(variant.with_integer_orders(dict.fromkeys(variant.integer_order_values()))).order_names
        for name in variant.integer_order_values():
            if name in present:
                yield Change(f"{name} free", variant.with_integer_orders({name: None}))
        if self.offset_allowed and not variant.offset:
            yield Change("an offset of each run", replace(variant, offset=True))
        for parameter in self.structure.free_input_parameters:
            if parameter.name not in variant.inputs:
                yield Change(f"{parameter.name} free", replace(variant, inputs=variant.inputs | {parameter.name}))
        for name, simpler_name in self.frictions.items():
            if name not in variant.frictions and (simpler_name is None or simpler_name in variant.frictions):
                yield Change(name, replace(variant, frictions=variant.frictions | {name}))

    def smaller(self, variant: Variant) -> Iterator[Change]:
        """Yield every valid variant with one optional element removed or one free order fixed to an integer.

        Optional elements are terms, the offset, free input parameters and friction terms.
        """
        candidate = self.build(variant)
        for equation in candidate.equations:
            for term in equation.terms:
                is_output_term = term.column == equation.output
                remaining = [
                    t for t in equation.terms if t is not term and (t.column == equation.output) == is_output_term
                ]
                if term.coefficient in self.droppable and remaining:
                    reduced = replace(variant, coefficients=variant.coefficients - {str(term.coefficient)})
                    if self.is_valid(reduced):
                        yield Change(f"without {term}", reduced)
        for name in candidate.order_names:
            for value in self.integer_values(name):
                reduced = variant.with_integer_orders({name: value})
                if self.is_valid(reduced):
                    yield Change(f"{name} = {value:g}", reduced)
        if self.offset_allowed and variant.offset:
            yield Change("without an offset", replace(variant, offset=False))
        for name in sorted(variant.inputs):
            yield Change(f"without {name}", replace(variant, inputs=variant.inputs - {name}))
        for name in sorted(variant.frictions):
            dependent_names = {n for n, simpler_name in self.frictions.items() if simpler_name == name}
            yield Change(f"without {name}", replace(variant, frictions=variant.frictions - {name} - dependent_names))


def describe_structure(structure: Structure) -> str:
    """Return a structure as one line of text, including an output level, which the equations do not show."""
    level = ", with an output level" if structure.offset == "level" else ""
    return str(structure).replace("\n", "; ") + level


def signature(structure: Structure) -> str:
    """Return a text that identifies a structure up to parameter names."""
    parts = []
    for equation in structure.equations:
        terms = sorted(
            (
                t.column,
                "free" if t.order.is_single else str(t.order),
                "free" if t.fixed_value is None else repr(t.fixed_value),
            )
            for t in equation.terms
        )
        parts.append(f"{equation.output} {'free' if equation.order.is_single else equation.order} {terms}")
    frictions = [(e.output, e.friction.stribeck is not None) for e in structure.equations if e.friction is not None]
    options = (structure.offset, structure.initial, structure.coupling, frictions)
    return f"{parts} {options} {[i.name for i in structure.free_input_parameters]}"


def name_candidates(structures: Sequence[Structure | str] | Mapping[str, Structure | str]) -> dict[str, Structure]:
    """Return candidates by name; the default name of a candidate is its equation.

    A structure with ``offset="auto"`` gives two candidates, with and without an offset.

    Raises
    ------
    ModelError
        If there is no candidate, an object is not a structure, or two candidates differ only in parameter names.
    """
    listed = list(structures.values() if isinstance(structures, Mapping) else structures)
    if not listed:
        raise ModelError("there are no candidates; give structures, or one structure whose terms are selected")
    parsed = [as_structure(f"candidate {position} of {len(listed)}", s) for position, s in enumerate(listed)]
    names = list(structures) if isinstance(structures, Mapping) else [describe_structure(s) for s in parsed]
    items = list(zip(names, parsed, strict=True))
    if len({n for n, _ in items}) < len(items):
        # Structures with equal texts may differ in other properties. Numbers distinguish their names.
        items = [(f"{n} ({k + 1})", s) for k, (n, s) in enumerate(items)]
    out: dict[str, Structure] = {}
    for name, structure in items:
        if structure.offset == "auto":
            # The structure without an offset and the structure with one are two candidates.
            out |= {name: replace(structure, offset="none"), f"{name}, offset": replace(structure, offset="constant")}
        else:
            out[name] = structure
    names_by_content: dict[str, str] = {}
    for name, structure in out.items():
        first_name = names_by_content.setdefault(_content(structure), name)
        if first_name != name:
            exception_text = "" if repr(out[first_name]) == repr(structure) else " except for parameter names"
            raise ModelError(
                f"candidates {first_name!r} and {name!r} are the same structure{exception_text}; leave one out"
            )
    return out


def _content(structure: Structure) -> str:
    """Return a text that identifies a candidate up to parameter names and the sequence of its terms."""
    if structure.has_order_law or structure.coefficient_law:
        return repr(structure)
    options = (
        sorted((v[0], v[-1], len(v)) for v in structure.order_values.values()),
        sorted(structure.delay.items()),
        sorted(structure.free_delays.items()),
        structure.limits,
        structure.sensor_filter,
        [e.friction for e in structure.equations],
    )
    return f"{signature(structure)} {options!r}"
