"""Options of estimators and order searches, validated."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

from ftlm.errors import ModelError
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.resources import memory_limit
from ftlm.utils.validation import check_threads, real_number, whole_number

Criterion = Literal["output-error", "equation-error"]
Coefficients = Literal["multi-innovation", "least-squares", "instrumental-variables"]
Loss = Literal["squares", "huber"]
Intervals = Literal["auto", "quadratic", "profile"]
LOSS_CHOICES = ("squares", "huber")
INTERVAL_CHOICES = ("auto", "quadratic", "profile")
METHOD_CHOICES = ("output-error", "instrumental-variables", "multi-innovation", "least-squares", "genetic")
_GRID_SEARCH_METHODS = METHOD_CHOICES[1:4]
#: Methods of `identify` that use an option; options that are not listed (runs, structure, m, …) apply to all methods.
METHODS_BY_OPTION: dict[str, tuple[str, ...]] = {
    "order_grid": METHOD_CHOICES[1:],
    "criterion": _GRID_SEARCH_METHODS,
    "norm": METHOD_CHOICES[1:],
    "top": _GRID_SEARCH_METHODS,
    "innovation_length": ("multi-innovation",),
    "prior_covariance": ("multi-innovation",),
    "row_basis": ("multi-innovation",),
    "genetic": ("genetic",),
    "loss": METHOD_CHOICES[:1],
    "reference": METHOD_CHOICES[:1],
    "intervals": METHOD_CHOICES[:1],
    "start": METHOD_CHOICES[:1],
    "store": _GRID_SEARCH_METHODS,
    "executor": _GRID_SEARCH_METHODS,
}
#: Options of the order search; grid methods use them only if an order is free.
SEARCH_OPTIONS = ("order_grid", "criterion", "norm", "top", "store", "executor")
#: Innovation lengths of the paper's tables.
COMPARED_INNOVATION_LENGTHS = (1, 3, 5, 7)
#: Bound on the refined-instrumental-variables iterations per candidate; most converge earlier.
MAX_IV_ITERATIONS = 5


def check_options_used(method: str, given: Iterable[str], *, free: bool = True, argument: str = "method") -> None:
    """Raise a `ModelError` if options are given that a method does not use.

    Parameters
    ----------
    method
        One of :data:`METHODS`.
    given
        Names of the options that were given.
    free
        Whether an order is free.
    argument
        Name of the method argument in the error message.
    """
    useless = [n for n in given if method not in METHODS_BY_OPTION.get(n, METHOD_CHOICES)]
    fixed = [
        n for n in given if not free and method in _GRID_SEARCH_METHODS and n in SEARCH_OPTIONS and n not in useless
    ]
    count = len(useless) + len(fixed)
    others = f", nor {count - 1} other{'s' if count > 2 else ''} given here" if count > 1 else ""
    if useless:
        users = " or ".join(parameter(argument, m) for m in METHODS_BY_OPTION[useless[0]])
        raise ModelError(
            f"{parameter(useless[0])} is not used by {parameter(argument, method)}{others}; leave it out, or use "
            f"{users}"
        )
    if fixed:
        raise ModelError(
            f"{parameter(fixed[0])} is not used{others}: it is for order searches, and every order here is a number; "
            "leave it out, or free an order"
        )


@dataclass(frozen=True)
class Settings:
    """Settings of a coefficient estimator and of the order search that ranks by it, validated."""

    criterion: str = "output-error"
    norm: str = "l1"
    coefficients: str = "multi-innovation"
    innovation_length: int = 7
    prior_covariance: float = 1.0
    row_basis: str = "haar"
    top: int = 20
    threads: int = 1
    pruning: bool = True

    @classmethod
    def check(
        cls,
        criterion: str = "output-error",
        norm: str = "l1",
        coefficients: str = "multi-innovation",
        innovation_length: int = 7,
        prior_covariance: float = 1.0,
        row_basis: str = "haar",
        top: int = 20,
        threads: int | None = None,
        pruning: bool = True,
    ) -> Settings:
        """Validate the arguments; raise a `ModelError` that names the invalid one."""
        for name, value, known in (
            ("criterion", criterion, ("output-error", "equation-error")),
            ("norm", norm, ("l1", "l2")),
            ("coefficients", coefficients, ("multi-innovation", "least-squares", "instrumental-variables")),
            ("row_basis", row_basis, ("haar", "time")),
        ):
            if value not in known:
                raise ModelError(
                    f"{setting(name)} {value!r} is not known in this version; use {' or '.join(map(repr, known))}"
                )
        rows_kept, p = whole_number(top), whole_number(innovation_length)
        if rows_kept is None or not 1 <= rows_kept <= 100_000:
            raise ModelError(f"{setting('top')} {top!r} is outside [1, 100000]; keep as many rows as you will read")
        if p is None or not 1 <= p < 1 << 62:
            raise ModelError(
                f"{setting('innovation_length')} {innovation_length!r} is no whole number from 1; the paper's is 7"
            )
        k0 = real_number("prior_covariance", prior_covariance)
        if not 0 < k0 < math.inf:
            raise ModelError(
                f"{setting('prior_covariance')} {prior_covariance!r} is not positive; a large one is a weak prior"
            )
        return cls(criterion, norm, coefficients, p, k0, row_basis, rows_kept, check_threads(threads), pruning)

    @property
    def needs_haar(self) -> bool:
        """Whether m must be a power of two."""
        return self.coefficients == "multi-innovation" and self.row_basis == "haar"

    def core_arguments(self, memory: int | None = None) -> tuple[str, str, int, float, bool, int, int, bool, int, int]:
        """Return the settings as arguments of the core; the default memory limit is that of this machine."""
        p = self.innovation_length if self.coefficients == "multi-innovation" else 0
        steps = MAX_IV_ITERATIONS if self.coefficients == "instrumental-variables" else 0
        ranked = (self.criterion, self.norm, p, self.prior_covariance, self.row_basis == "haar")
        most = memory_limit() if memory is None else memory
        return *ranked, self.top, self.threads, self.pruning, steps, most

    def to_dict(self) -> dict[str, Any]:
        """Return the settings that results and reports show."""
        out: dict[str, Any] = {"criterion": self.criterion, "norm": self.norm, "coefficients": self.coefficients}
        if self.coefficients == "multi-innovation":
            out |= {"innovation_length": self.innovation_length, "prior_covariance": self.prior_covariance}
            out["row_basis"] = self.row_basis
        return out
