"""Parametrized tests of which few cases run by default."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_after(count: int, names: str, cases: Iterable[Any], **options: Any) -> pytest.MarkDecorator:
    """Parametrize a test by cases of which the first ones run by default, and the others by ``make test-slow``."""
    given = list(cases)
    later = [
        case if hasattr(case, "marks") else pytest.param(*(case if "," in names else (case,)), marks=pytest.mark.slow)
        for case in given[count:]
    ]
    return pytest.mark.parametrize(names, [*given[:count], *later], **options)
