"""Model file: its JSON schema, and functions that read and write it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import UNSET

from ftlm.errors import DataError, ModelError
from ftlm.model.model import Estimate, Model
from ftlm.structure.equation import Equation, Friction, Stribeck, Term
from ftlm.structure.grammar import EquationParser
from ftlm.structure.input_nonlinearity import InputNonlinearity
from ftlm.structure.order import Order
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import Offset, Structure, check_initial
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import JsonFormat, write_atomically
from ftlm.utils.validation import error_text

#: Schema version of model files. Files of other versions are rejected; no release wrote such files.
MODEL_SCHEMA = 13


class TermFile(msgspec.Struct, forbid_unknown_fields=True):
    """Term ``factor * coefficient * D^order signal`` of an equation in a model file.

    Fields are those of :class:`ftlm.structure.equation.Term`, with the expression of a non-linear term as text.
    """

    signal: str
    order: float
    coefficient: float
    factor: float = 1.0
    name: str | None = None
    expression: str | None = None

    @classmethod
    def of(cls, item: Term) -> TermFile:
        """Return the file form of a term."""
        expression = None if item.nonlinear is None else str(item.nonlinear)
        return cls(item.signal, item.order.constant, float(item.coefficient), item.factor, item.name, expression)

    def term(self) -> Term:
        """Return the term from its file form."""
        expression = UNSET if self.expression is None else EquationParser(self.expression).parse_expression()
        return Term(self.signal, Order(self.order), self.coefficient, self.factor, self.name, expression)


class FrictionFile(msgspec.Struct, forbid_unknown_fields=True):
    """Coulomb friction ``factor * coefficient * sign(D y)`` in a model file, with its Stribeck term if it has one."""

    coefficient: float
    factor: float = -1.0
    name: str | None = None
    stribeck: Stribeck | None = None

    @classmethod
    def of(cls, friction: Friction) -> FrictionFile:
        """Return the file form of the friction of an equation."""
        return cls(float(friction.coefficient), friction.factor, friction.name, friction.stribeck)

    def friction(self) -> Friction:
        """Return the friction from its file form."""
        return Friction(self.coefficient, self.factor, self.name, self.stribeck)

    @property
    def count(self) -> int:
        """Number of friction parameters in a covariance: 1, or 3 with a Stribeck term."""
        return 1 if self.stribeck is None else 3


class EquationFile(msgspec.Struct, forbid_unknown_fields=True):
    """Equation of a model file, whose orders are numbers."""

    output: str
    order: float
    terms: list[TermFile]
    friction: FrictionFile | None = None

    @classmethod
    def of(cls, item: Equation) -> EquationFile:
        """Return the file form of an equation."""
        terms = [TermFile.of(t) for t in item.terms]
        friction = None if item.friction is None else FrictionFile.of(item.friction)
        return cls(item.output, item.order.constant, terms, friction)

    def equation(self) -> Equation:
        """Return the equation from its file form."""
        terms = tuple(t.term() for t in self.terms)
        friction = None if self.friction is None else self.friction.friction()
        return Equation(self.output, Order(self.order), terms, friction)

    @property
    def count(self) -> int:
        """Number of orders, coefficients and friction parameters of the equation, as in a covariance."""
        return 1 + 2 * len(self.terms) + (0 if self.friction is None else self.friction.count)


class ModelFile(msgspec.Struct, forbid_unknown_fields=True):
    """File form of a model; order grids, laws and nominal values, which only an identification uses, are omitted."""

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
    offset: Offset = "none"
    limits: tuple[InputNonlinearity, ...] = ()

    @classmethod
    def of(cls, model: Model) -> ModelFile:
        """Return the file form of a model."""
        s = model.structure
        return cls(
            "ftlm-model",
            MODEL_SCHEMA,
            s.name,
            [EquationFile.of(e) for e in s.equations],
            s.coupling,
            dict(s.delay),
            s.initial if isinstance(s.initial, str) else list(s.initial),
            s.sensor_filter,
            dict(model.units),
            dict(model.orders),
            model.m,
            dict(model.about),
            model.estimate,
            s.offset,
            s.limits,
        )

    def restore_model(self) -> Model:
        """Return the model from its file form.

        Raises
        ------
        ModelError
            If an equation is invalid, or the covariance has the wrong size.
        """
        structure = Structure(
            equations=tuple(e.equation() for e in self.equations),
            coupling=self.coupling,
            delay=self.delay,
            initial=check_initial(self.initial),
            sensor_filter=self.sensor_filter,
            name=self.name,
            offset=self.offset,
            input_nonlinearities=self.limits or UNSET,
        )
        if self.estimate is not None and self.estimate.covariance is not None:
            count = sum(e.count for e in self.equations) + len(structure.fixed_input_parameters)
            rows = self.estimate.covariance
            if len(rows) != count or any(len(row) != count for row in rows):
                raise ModelError(f"its covariance does not have {count} by {count} elements, as its equations require")
        return Model(structure, self.orders, self.units, self.m, self.about, self.estimate)


#: JSON format of model files.
MODEL_FORMAT = JsonFormat("model", "a file written by save()", ModelFile, MODEL_SCHEMA)


def write_model(model: Model, path: str | os.PathLike[str], *, force: bool) -> Path:
    """Write a model to a JSON file atomically, and return the path; for errors see :meth:`ftlm.Model.save`."""
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
        Model with bit-identical numbers. Order grids, laws and nominal values are not stored, because only an
        identification uses them.

    Raises
    ------
    DataError
        If the file does not exist, is not a model (the message has the position), has another schema version, or
        exceeds 1 MiB.
    """
    file = MODEL_FORMAT.read(path)
    try:
        return file.restore_model()
    except ModelError as error:
        raise DataError(
            f"{path} contains no usable model: {error_text(error)}; give a file written by save()"
        ) from error
