"""Model file: its JSON schema, and functions that read and write it."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import UNSET, UnsetType

from ftlm.errors import DataError, ModelError
from ftlm.model.model import Estimate, Model
from ftlm.structure.equation import Equation, Friction, Stribeck, Term
from ftlm.structure.grammar import EquationParser
from ftlm.structure.input_nonlinearity import InputNonlinearity, NonlinearityKind
from ftlm.structure.order import Order
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import Offset, Structure, check_initial
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import JsonFormat, write_atomically
from ftlm.utils.validation import error_text

#: Schema versions: base, offset, profile likelihood intervals or sensor filters of signals that are not outputs,
#: friction, input non-linearities, Stribeck friction, free parameters of the fit, findings as records, levels,
#: non-linear terms.
BASE_SCHEMA, OFFSET_SCHEMA, PROFILE_SCHEMA, FRICTION_SCHEMA, LIMIT_SCHEMA = 2, 3, 4, 5, 6
STRIBECK_SCHEMA, FIT_SCHEMA, FINDING_SCHEMA, LEVEL_SCHEMA, NONLINEAR_SCHEMA, PIECES_SCHEMA = 7, 8, 9, 10, 11, 12


class TermFile(msgspec.Struct, forbid_unknown_fields=True):
    """Term ``factor * coefficient * D^order signal`` of an equation in a model file.

    `name` is the name of the coefficient as a parameter. A non-linear term is stored with the text of its expression.
    """

    signal: str
    order: float
    coefficient: float
    factor: float = 1.0
    name: str | None = None
    expression: str | UnsetType = UNSET

    @classmethod
    def of(cls, item: Term) -> TermFile:
        """Return the file form of a term."""
        shape = UNSET if item.nonlinear is None else str(item.nonlinear)
        return cls(item.signal, item.order.constant, float(item.coefficient), item.factor, item.name, shape)

    def term(self) -> Term:
        """Return the term from its file form."""
        shape = UNSET if isinstance(self.expression, UnsetType) else EquationParser(self.expression).parse_expression()
        return Term(self.signal, Order(self.order), self.coefficient, self.factor, self.name, shape)


class StribeckFile(msgspec.Struct, forbid_unknown_fields=True):
    """Stribeck term ``factor * coefficient * exp(-(D y / speed)^2) * sign(D y)`` of friction in a model file."""

    coefficient: float
    speed: float
    factor: float = -1.0
    name: str | None = None
    speed_name: str | None = None


class FrictionFile(msgspec.Struct, forbid_unknown_fields=True):
    """Coulomb friction ``factor * coefficient * sign(D y)`` in a model file, with any Stribeck term."""

    coefficient: float
    factor: float = -1.0
    name: str | None = None
    stribeck: StribeckFile | UnsetType = UNSET

    @classmethod
    def of(cls, rubs: Friction) -> FrictionFile:
        """Return the file form of a friction."""
        out, near = cls(float(rubs.coefficient), rubs.factor, rubs.name), rubs.stribeck
        if near is not None:
            more = StribeckFile(float(near.coefficient), float(near.speed), near.factor, near.name, near.speed_name)
            out.stribeck = more
        return out

    def friction(self) -> Friction:
        """Return the friction from its file form."""
        s = self.stribeck
        near = UNSET if s is UNSET else Stribeck(s.coefficient, s.speed, s.factor, s.name, s.speed_name)
        return Friction(self.coefficient, self.factor, self.name, near)

    @property
    def count(self) -> int:
        """Number of friction parameters."""
        return 1 if self.stribeck is UNSET else 3


class LimitFile(msgspec.Struct, forbid_unknown_fields=True):
    """Saturation or dead zone of an input in a model file, in the unit of the input."""

    signal: str
    law: NonlinearityKind
    value: float


class EquationFile(msgspec.Struct, forbid_unknown_fields=True):
    """Equation with numerical orders in a model file."""

    output: str
    order: float
    terms: list[TermFile]
    friction: FrictionFile | UnsetType = UNSET

    @classmethod
    def of(cls, item: Equation) -> EquationFile:
        """Return the file form of an equation."""
        terms = [TermFile.of(t) for t in item.terms]
        friction = UNSET if item.friction is None else FrictionFile.of(item.friction)
        return cls(item.output, item.order.constant, terms, friction)

    def equation(self) -> Equation:
        """Return the equation from its file form."""
        terms = tuple(t.term() for t in self.terms)
        rubs = UNSET if self.friction is UNSET else self.friction.friction()
        return Equation(self.output, Order(self.order), terms, rubs)

    @property
    def count(self) -> int:
        """Number of parameters of the equation in a covariance: orders, coefficients and friction."""
        return 1 + 2 * len(self.terms) + (0 if self.friction is UNSET else self.friction.count)

    @property
    def schema(self) -> int:
        """Smallest schema version that can represent the equation."""
        if any(t.expression is not UNSET for t in self.terms):
            return NONLINEAR_SCHEMA
        if self.friction is UNSET:
            return BASE_SCHEMA
        return FRICTION_SCHEMA if self.friction.stribeck is UNSET else STRIBECK_SCHEMA


class FilterFile(msgspec.Struct, forbid_unknown_fields=True):
    """Sensor filter in a model file.

    A filter of outputs is stored so that every version can read it, one of any signals in a newer form.
    """

    numerator: tuple[tuple[float, float], ...]
    denominator: tuple[tuple[float, float], ...]
    outputs: tuple[str, ...] | UnsetType = UNSET
    signals: tuple[str, ...] | UnsetType = UNSET

    @classmethod
    def of(cls, structure: Structure) -> FilterFile | None:
        """Return the file form of a structure's sensor filter; None without a filter."""
        sensor = structure.sensor_filter
        if sensor is None:
            return None
        if set(sensor.signals) <= set(structure.outputs):
            return cls(sensor.numerator, sensor.denominator, outputs=sensor.signals)
        return cls(sensor.numerator, sensor.denominator, signals=sensor.signals)

    def sensor(self, *, followed: Collection[str]) -> SensorFilter | None:
        """Return the sensor filter from its file form; None if it applies to no signal.

        ``followed`` are the outputs of coupled equations; it is empty with measured coupling.

        A filter in the old form applies to the coupled outputs that it names, or with measured coupling to every signal
        that it names.
        """
        if isinstance(self.signals, UnsetType) == isinstance(self.outputs, UnsetType):
            raise ModelError(
                "its sensor filter has neither signals nor outputs, or both; exactly one of them is expected"
            )
        if not isinstance(self.signals, UnsetType):
            return SensorFilter(self.signals, self.numerator, self.denominator)
        names = () if isinstance(self.outputs, UnsetType) else self.outputs
        signals = tuple(n for n in names if n in followed or not followed)
        return SensorFilter(signals, self.numerator, self.denominator) if signals else None


class ModelFile(msgspec.Struct, forbid_unknown_fields=True):
    """File form of a model, without data that only the identification requires."""

    format: Literal["ftlm-model"]
    schema: int
    name: str
    equations: list[EquationFile]
    coupling: Literal["measured", "simulated"]
    delay: dict[str, float]
    initial: str | list[float]
    sensor_filter: FilterFile | None
    units: dict[str, str]
    orders: dict[str, float]
    m: int | None
    about: dict[str, str | float | int | bool | None]
    estimate: Estimate | None = None
    offset: Offset | UnsetType = UNSET
    limits: list[LimitFile] | UnsetType = UNSET

    @classmethod
    def of(cls, model: Model) -> ModelFile:
        """Return the file form of a model."""
        s = model.structure
        # Absent fields are omitted, so that files of older structures do not change.
        offset: Offset | UnsetType = UNSET if s.offset == "none" else s.offset
        sensor = FilterFile.of(s)
        values = [(limit, limit.value) for limit in s.limits]
        limits = [LimitFile(limit.signal, limit.law, v) for limit, v in values if not isinstance(v, tuple)] or UNSET
        equations = [EquationFile.of(e) for e in s.equations]
        return cls(
            "ftlm-model",
            schema_of(equations, limits, offset, sensor, model.estimate),
            s.name,
            equations,
            s.coupling,
            dict(s.delay),
            s.initial if isinstance(s.initial, str) else list(s.initial),
            sensor,
            dict(model.units),
            dict(model.orders),
            model.m,
            dict(model.about),
            model.estimate,
            offset,
            limits,
        )

    def restore_model(self) -> Model:
        """Return the model from its file form.

        Raises
        ------
        ModelError
            If an equation is invalid, or the covariance has the wrong size.
        """
        followed = [e.output for e in self.equations] if self.coupling == "simulated" else []
        sensor = None if self.sensor_filter is None else self.sensor_filter.sensor(followed=followed)
        structure = Structure(
            equations=tuple(e.equation() for e in self.equations),
            coupling=self.coupling,
            delay=self.delay,
            initial=check_initial(self.initial),
            sensor_filter=sensor,
            name=self.name,
            offset="none" if self.offset is UNSET else self.offset,
            input_nonlinearities=UNSET
            if self.limits is UNSET
            else tuple(InputNonlinearity(x.signal, x.law, x.value) for x in self.limits),
        )
        if self.estimate is not None and self.estimate.covariance is not None:
            count = sum(e.count for e in self.equations)
            rows = self.estimate.covariance
            if len(rows) != count or any(len(row) != count for row in rows):
                raise ModelError(f"its covariance does not have {count} by {count} elements, as its equations require")
        return Model(structure, self.orders, self.units, self.m, self.about, self.estimate)


#: Model files have a few kilobytes; the default size limit suffices.
MODEL_FORMAT = JsonFormat("model", "a file written by save()", ModelFile, PIECES_SCHEMA)


def schema_of(
    equations: Sequence[EquationFile],
    limits: list[LimitFile] | UnsetType,
    offset: Offset | UnsetType,
    sensor: FilterFile | None,
    estimate: Estimate | None,
) -> int:
    """Return the smallest schema version that can represent all parts of a model.

    Files of models without newer features therefore do not change.
    """
    profiled = estimate is not None and estimate.intervals is not UNSET
    doubted = estimate is not None and not (estimate.findings is UNSET and estimate.against is UNSET)
    is_partial = sensor is not None and not isinstance(sensor.signals, UnsetType)
    has_parameter_set = estimate is not None and estimate.free is not UNSET
    in_pieces = estimate is not None and estimate.piece_duration is not UNSET
    return max(
        BASE_SCHEMA if isinstance(offset, UnsetType) else LEVEL_SCHEMA if offset == "level" else OFFSET_SCHEMA,
        PROFILE_SCHEMA if profiled or is_partial else BASE_SCHEMA,
        BASE_SCHEMA if isinstance(limits, UnsetType) else LIMIT_SCHEMA,
        *(e.schema for e in equations),
        FIT_SCHEMA if has_parameter_set else BASE_SCHEMA,
        FINDING_SCHEMA if doubted else BASE_SCHEMA,
        PIECES_SCHEMA if in_pieces else BASE_SCHEMA,
    )


def write_model(model: Model, path: str | os.PathLike[str], *, force: bool) -> Path:
    """Write a model to a JSON file, atomically, and return the path; see :meth:`ftlm.Model.save`."""
    data = msgspec.json.format(msgspec.json.encode(ModelFile.of(model)), indent=2)
    return write_atomically(path, data + b"\n", force=force)


@check_arguments
def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model written by :meth:`Model.save`.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    Model
        Model with bit-identical numbers, without data that only the identification requires (order grids, laws, nominal
        values).

    Raises
    ------
    DataError
        If the file does not exist, is not a model (the message has the position), has a later schema version, or
        exceeds 1 MiB.
    """
    read = MODEL_FORMAT.read(path)
    of = schema_of(read.equations, read.limits, read.offset, read.sensor_filter, read.estimate)
    MODEL_FORMAT.check_schema(path, read, of)
    try:
        return read.restore_model()
    except ModelError as error:
        raise DataError(f"{path} holds no usable model: {error_text(error)}") from error
