"""The file of a model: what stands in it, and how it is read."""

from __future__ import annotations

from typing import Literal

import msgspec

from ftlm.base.errors import ModelError
from ftlm.data.equations import Equation, Term
from ftlm.data.orders import Order
from ftlm.data.solved import Estimate
from ftlm.data.structures import SensorFilter

#: Largest model file read: a model is a few kilobytes.
MAX_MODEL_BYTES = 1 << 20
SCHEMA = 2


class TermFile(msgspec.Struct, forbid_unknown_fields=True):
    signal: str
    order: float
    coefficient: float
    factor: float = 1.0
    name: str | None = None


class EquationFile(msgspec.Struct, forbid_unknown_fields=True):
    output: str
    order: float
    terms: list[TermFile]


class ModelFile(msgspec.Struct, forbid_unknown_fields=True):
    format: Literal["ftlm-model"]
    schema: int
    name: str
    equations: list[EquationFile]
    coupling: Literal["measured", "simulated"]
    delay: dict[str, float]
    initial: str | list[float]
    sensor_filter: SensorFilter | None
    units: dict[str, str]
    orders: dict[str, float]
    m: int | None
    about: dict[str, str | float | int | bool | None]
    estimate: Estimate | None = None


def check_estimate(read: ModelFile) -> None:
    if read.estimate is None or read.estimate.covariance is None:
        return
    count = sum(1 + 2 * len(e.terms) for e in read.equations)
    rows = read.estimate.covariance
    if len(rows) != count or any(len(row) != count for row in rows):
        raise ModelError(f"its covariance is not of {count} by {count} numbers, as its equations need")


def equation_of(item: EquationFile) -> Equation:
    terms = tuple(Term(t.signal, Order(t.order), t.coefficient, t.factor, t.name) for t in item.terms)
    return Equation(item.output, Order(item.order), terms)
