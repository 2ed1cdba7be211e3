"""How the score of an order search changes around its best orders: every candidate of the lattice in two of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ftlm.errors import ModelError
from ftlm.models import Structure
from ftlm.order_search import Lattice, SearchResult, search_orders

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ftlm.runs import Run

    Floats = NDArray[np.float64]

__all__ = ["Landscape", "landscape"]


@dataclass(frozen=True)
class Landscape:
    """Scores of a lattice over two orders, the others as in the best model.

    Parameters
    ----------
    names
        The two orders, across and upward.
    x, y
        Their values, ascending.
    scores
        Shape (y, x); infinite where a pair is no candidate or its free run diverges.
    """

    names: tuple[str, str]
    x: Floats
    y: Floats
    scores: Floats


def landscape(
    runs: Run | Sequence[Run],
    structure: Structure,
    search: SearchResult,
    lattice: Lattice | None = None,
    *,
    orders: tuple[str, str] | None = None,
    threads: int | None = None,
) -> Landscape:
    """Score every pair of values of two orders by the search's own criterion.

    Parameters
    ----------
    runs, structure, lattice
        What was searched: an equation, or a stage under its order law.
    search
        What was found.
    orders
        Names of the two; by default the first two free orders that the lattice gives several values.
    threads
        See :func:`ftlm.search_orders`.

    Returns
    -------
    Landscape

    Raises
    ------
    ModelError
        Fewer than two orders with several values, or a name that is none of them.
    """
    axes = {n: v for n, v in (lattice or Lattice()).values(structure).items() if len(v) > 1}
    best = search.orders
    names = orders or tuple(list(axes)[:2])
    if len(names) != 2 or names[0] == names[1] or any(n not in axes for n in names):
        free = ", ".join(axes) or "none"
        raise ModelError(f"a landscape needs two different orders with several values each; this lattice has {free}")
    x, y = (np.array(axes[n]) for n in names)
    fixed = structure.with_orders({n: v for n, v in best.items() if n not in names})
    settings: dict[str, Any] = {
        n: search.settings[n]
        for n in ("criterion", "norm", "coefficients", "innovation_length", "prior_covariance", "rows")
        if n in search.settings
    }
    found = search_orders(
        runs, fixed, Lattice(orders={names[0]: x.tolist(), names[1]: y.tolist()}), m=search.m, keep=x.size * y.size,
        threads=threads, **settings,
    )  # fmt: skip
    scores = np.full((y.size, x.size), np.inf)
    columns = np.array([r.orders[names[0]] for r in found.table])
    rows = np.array([r.orders[names[1]] for r in found.table])
    values = np.array([r.score for r in found.table])
    scores[np.abs(y[:, None] - rows).argmin(axis=0), np.abs(x[:, None] - columns).argmin(axis=0)] = values
    return Landscape((names[0], names[1]), x, y, scores)
