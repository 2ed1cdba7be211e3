"""The record of a model: a structure whose orders and coefficients are numbers, and how they were found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from ftlm.base.checks import check_pulses
from ftlm.base.errors import ModelError
from ftlm.data.equations import Equation
from ftlm.data.structures import Structure, check_decided


class Freedom(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What was free in a joint fit and how well it was told, so that another experiment can be laid out from a file.

    Parameters
    ----------
    names
        Free orders, free coefficients, then delays and limits of inputs.
    orders
        Every order of the model as it depends on free ones, in words: equation by equation alpha, then each term's.
    products
        Coefficients that follow from others by a law: sign and factors by name.
    covariance
        Of the free numbers in the order of their names; None where it is not finite.
    noise
        Standard deviation of what the free run left of each output, as it was measured, by name.
    refinement
        Pulses a sample interval of the fit's finest grid.
    """

    names: tuple[str, ...]
    orders: tuple[str, ...]
    noise: dict[str, float]
    products: dict[str, tuple[float, tuple[str, ...]]] = {}
    covariance: tuple[tuple[float, ...], ...] | None = None
    refinement: int = 1


class Against(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What speaks against a model.

    Parameters
    ----------
    level
        What it makes of the model: ``"do not use"`` or ``"with care"``.
    reason
        In a sentence.
    remedy
        What to do about it.
    """

    level: Literal["do not use", "with care"]
    reason: Annotated[str, Meta(min_length=1)]
    remedy: str = ""


class Estimate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is known about how a model was identified, kept with it so that a report needs no other file.

    Parameters
    ----------
    method
        Estimator.
    runs
        Names of the runs.
    values, standard_errors
        Orders and coefficients by name as they were estimated, and their standard errors where there are any.
    covariance
        Of every number of the model in the order of its equations (alpha, then order and coefficient of each term, then
        the coefficient of friction where there is some, with those of Stribeck's term fc, fs and vs); None where the
        estimator gives none. It may be singular: laws tie numbers.
    fit
        Fit of the free run on these runs in percent, by output.
    information
        Information criteria, where known.
    warnings
        What makes the model doubtful, in words.
    intervals
        95 % intervals by profile likelihood, of the values that have one; None for an end that is infinite. Those of
        the others are ± 1.96 standard errors. Not set where no value has one.
    free
        What a joint fit found together, from which the next experiment is laid out. Not set for other methods.
    against
        What spoke against the model when it was identified, as its verdict weighs it; not set where nothing did, and in
        files of earlier versions, which are judged by their warnings.
    """

    method: str
    runs: tuple[str, ...]
    values: dict[str, float]
    standard_errors: dict[str, float | None] = {}
    covariance: tuple[tuple[float, ...], ...] | None = None
    fit: dict[str, float | None] = {}
    information: dict[str, float | None] = {}
    warnings: tuple[str, ...] = ()
    intervals: dict[str, tuple[float | None, float | None]] | UnsetType = UNSET
    free: Freedom | UnsetType = UNSET
    against: tuple[Against, ...] | UnsetType = UNSET


@dataclass(frozen=True)
class Solved:
    """A structure whose orders and coefficients are numbers; its fields are those of :class:`ftlm.Model`."""

    structure: Structure
    orders: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    m: int | None = None
    about: Mapping[str, str | float | int | bool | None] = field(default_factory=dict)
    estimate: Estimate | None = None

    def __post_init__(self) -> None:
        if self.m is not None:
            check_pulses(self.m)
        check_decided(self.structure.offset)
        if self.structure.free_inputs:
            numbers = ", ".join(item.words for item in self.structure.free_inputs)
            way = "with_delays" if self.structure.free_delays else "with_limits"
            raise ModelError(f"the {numbers} is still free; identify it first, or set it by {way}")
        for item in self.structure.equations:
            if not item.is_identified:
                free = [*item.order_names, *item.coefficient_names]
                raise ModelError(f"the equation of {item.output} still has free {', '.join(free)}; identify it first")
            for k, term in enumerate(item.terms):
                if not math.isfinite(float(term.coefficient)):
                    raise ModelError(f"coefficient {k} of {item.output} is not finite; the model cannot be used")

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients by name."""
        named = {t.name: float(t.coefficient) for e in self.equations for t in e.terms if t.name is not None}
        for item in self.equations:
            named |= {} if item.friction is None else item.friction.found
        return named

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The equations, all numbers."""
        return self.structure.equations

    @property
    def outputs(self) -> tuple[str, ...]:
        """Modelled outputs."""
        return self.structure.outputs


def check_solved(model: object) -> None:
    """Refuse what is no model."""
    if not isinstance(model, Solved):
        raise ModelError(f"model is {type(model).__name__}, not a Model; identify a structure or load a model first")
