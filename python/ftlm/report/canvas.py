"""Figures and axes of matplotlib, made without pyplot so that nothing is kept or shown."""

from __future__ import annotations

import importlib
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from ftlm.base.errors import ModelError
from ftlm.judge.charts import with_unit
from ftlm.paint.text import symbol

#: Width of a figure, and height of one row of axes [inches]: a journal's double column.
WIDTH, ROW = 7.0, 2.2
#: Resolution in a notebook.
NOTEBOOK_DPI = 110


def figure_of(rows: int, columns: int = 1, *, row: float = ROW, **options: Any) -> tuple[Any, Any]:
    """A figure with a grid of axes, made without pyplot so that nothing is kept or shown."""
    try:
        module = importlib.import_module("matplotlib.figure")
    except ImportError:
        raise ModelError("matplotlib is not installed; pip install 'ftlm[plot]'") from None

    class Drawing(module.Figure):  # type: ignore[misc, name-defined]
        """A figure that a notebook shows although pyplot does not know it."""

        def _repr_png_(self) -> bytes:
            data = io.BytesIO()
            self.savefig(data, format="png", dpi=NOTEBOOK_DPI)
            return data.getvalue()

    figure = Drawing(figsize=(WIDTH, max(row * rows, 2.0)), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def axes_for(ax: Any, rows: int, columns: int = 1, **options: Any) -> tuple[Any, Any]:
    """The axes that were given, or those of a new figure: (figure, grid of rows by columns)."""
    if ax is None:
        return figure_of(rows, columns, **options)
    given = np.atleast_1d(np.asarray(ax, dtype=object)).ravel()
    strange = [type(a).__name__ for a in given if not hasattr(a, "plot") or not hasattr(a, "figure")]
    if strange:
        raise ModelError(f"ax holds {strange[0]}, which is no matplotlib axes; give what subplots returns")
    if given.size != rows * columns:
        raise ModelError(
            f"this picture has {rows * columns} axes ({rows} by {columns}), and ax has {given.size}; give as many, "
            f"such as subplots({rows}, {columns})[1], or leave ax out"
        )
    return given[0].figure, given.reshape(rows, columns)


def plain(text: str) -> str:
    """Text that matplotlib does not take for mathematics, whatever a name holds."""
    return text.replace("$", r"\$")


def label_of(name: str, units: Mapping[str, str]) -> str:
    """A signal's name with its unit."""
    return plain(with_unit(symbol(name), units, name))
