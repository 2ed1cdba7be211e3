"""Parametrized tests of which only the first cases run by default."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_after(count: int, names: str, cases: Iterable[Any], **options: Any) -> pytest.MarkDecorator:
    """Parametrize a test: the first `count` cases run by default, and the others only by ``make test-slow``."""
    all_cases = list(cases)
    slow_cases = []
    for case in all_cases[count:]:
        if hasattr(case, "marks"):
            slow_cases.append(pytest.param(*case.values, marks=[*case.marks, pytest.mark.slow], id=case.id))
        else:
            slow_cases.append(pytest.param(*(case if "," in names else (case,)), marks=pytest.mark.slow))
    return pytest.mark.parametrize(names, [*all_cases[:count], *slow_cases], **options)
