"""Settings of an order search and of the coefficients that it ranks by, validated."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal, get_args

from ftlm import _core
from ftlm.errors import ModelError
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.resources import memory_limit
from ftlm.utils.validation import check_choice, check_integer, real_number, whole_number

Criterion = Literal["output-error", "equation-error"]
Coefficients = Literal["multi-innovation", "least-squares", "instrumental-variables"]
Norm = Literal["l1", "l2"]
RowBasis = Literal["haar", "time"]
#: Innovation lengths of the paper's tables.
COMPARED_INNOVATION_LENGTHS = (1, 3, 5, 7)
#: Bound on the refined-instrumental-variables iterations per candidate; most converge earlier.
MAX_IV_ITERATIONS = 5
#: Largest number of rows of a table.
MAX_TOP = 100_000
#: Settings of multi-innovation alone.
MULTI_INNOVATION_SETTINGS = ("innovation_length", "prior_covariance", "row_basis")


@dataclass(frozen=True, kw_only=True)
class SearchSettings:
    """Settings that define the result of an order search.

    Parameters
    ----------
    criterion, norm, coefficients, innovation_length, prior_covariance, row_basis, top, pruning
        See :func:`ftlm.search_orders`.

    Raises
    ------
    ModelError
        A value out of range, or a setting of multi-innovation with other coefficients.
    """

    criterion: Criterion = "output-error"
    norm: Norm = "l1"
    coefficients: Coefficients = "multi-innovation"
    innovation_length: int = 7
    prior_covariance: float | None = None
    row_basis: RowBasis = "haar"
    top: int = 20
    pruning: bool = True

    def __post_init__(self) -> None:
        check_choice("criterion", self.criterion, get_args(Criterion))
        check_choice("norm", self.norm, get_args(Norm))
        check_choice("coefficients", self.coefficients, get_args(Coefficients))
        check_choice("row_basis", self.row_basis, get_args(RowBasis))
        top = whole_number(self.top)
        if top is None or not 1 <= top <= MAX_TOP:
            raise ModelError(
                f"{setting('top')} {self.top!r} is outside [1, {MAX_TOP}]; keep as many rows as you will read"
            )
        length = check_integer("innovation_length", self.innovation_length, 1)
        given = self.prior_covariance
        covariance = None if given is None else real_number("prior_covariance", given)
        if covariance is not None and not 0 < covariance < math.inf:
            raise ModelError(
                f"{setting('prior_covariance')} {self.prior_covariance!r} is not positive; a large one is a weak prior"
            )
        if not isinstance(self.pruning, bool):
            raise ModelError(f"pruning = {self.pruning!r} is neither True nor False")
        for name, value in (("top", top), ("innovation_length", length), ("prior_covariance", covariance)):
            object.__setattr__(self, name, value)
        if self.coefficients != "multi-innovation":
            changed = [f.name for f in fields(self) if f.name in MULTI_INNOVATION_SETTINGS and self.differs(f.name)]
            if changed:
                raise ModelError(
                    f"{parameter(changed[0])} is not used by {parameter('coefficients', self.coefficients)}; leave "
                    f"it out, or use {parameter('coefficients', 'multi-innovation')}"
                )

    def differs(self, name: str) -> bool:
        """Whether a setting differs from its default."""
        return bool(getattr(self, name) != getattr(type(self), name))

    @property
    def needs_haar(self) -> bool:
        """Whether m must be a power of two."""
        return self.coefficients == "multi-innovation" and self.row_basis == "haar"

    def core_arguments(self, threads: int) -> _core._Options:
        """Return the settings as arguments of the core; the memory limit is that of this machine."""
        return {
            "criterion": self.criterion,
            "norm": self.norm,
            "innovation_length": self.innovation_length if self.coefficients == "multi-innovation" else 0,
            "prior_covariance": self.prior_covariance,
            "haar_rows": self.row_basis == "haar",
            "top": self.top,
            "threads": threads,
            "pruning": self.pruning,
            "iterations": MAX_IV_ITERATIONS if self.coefficients == "instrumental-variables" else 0,
            "memory": memory_limit(),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the settings that results and reports show."""
        own = MULTI_INNOVATION_SETTINGS if self.coefficients == "multi-innovation" else ()
        return {name: getattr(self, name) for name in ("criterion", "norm", "coefficients", *own)}
