"""Rows as a pandas frame, which ftlm itself does not need."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

from ftlm.base.errors import ModelError


def to_frame(rows: Sequence[Mapping[str, Any]], index: Sequence[str]) -> Any:
    """Rows as a pandas frame.

    Raises
    ------
    ModelError
        pandas is not installed.
    """
    try:
        pandas = importlib.import_module("pandas")
    except ImportError:
        raise ModelError("pandas is not installed; pip install pandas") from None
    return pandas.DataFrame.from_records(list(rows)).set_index(list(index))
