"""Models: structures whose orders and coefficients are numbers."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
from numpy.typing import ArrayLike

from ftlm.base.arrays import Complex, Floats
from ftlm.base.errors import DataError, ModelError
from ftlm.base.output import write_atomically
from ftlm.data.equations import numeric
from ftlm.data.run import Run
from ftlm.data.solved import Solved
from ftlm.data.structures import Structure, check_initial
from ftlm.judge.comparison import Comparison, compare
from ftlm.judge.residuals import Residuals, resid
from ftlm.model.file import (
    MAX_MODEL_BYTES,
    SCHEMA,
    EquationFile,
    ModelFile,
    TermFile,
    check_estimate,
    equation_of,
)
from ftlm.model.typesetting import model_html
from ftlm.solve.approximation import to_control
from ftlm.solve.free_run import simulate
from ftlm.solve.frequency import frequency_response, step_response
from ftlm.solve.stability import Stability, poles, stability


class Model(Solved):
    """A structure whose orders and coefficients are numbers.

    Parameters
    ----------
    structure
        The structure, nothing free.
    orders
        Free orders by name, as they were found.
    units
        SI units of the signals, where known.
    m
        Number of block pulses on which the model was identified and is compared by default.
    about
        How the model came to be, for people.
    estimate
        Standard errors, covariance and warnings of the identification; None for a model that was written down.
    """

    def simulate(
        self,
        run: Run,
        *,
        tolerance: float = 1e-6,
        initial: Mapping[str, Mapping[float, float]] | None = None,
        largest_m: int = 1 << 21,
    ) -> Run:
        """Free run on a run's inputs; see :func:`ftlm.simulate`."""
        return simulate(self, run, tolerance=tolerance, initial=initial, largest_m=largest_m)

    def compare(self, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
        """Both errors on measured runs; see :func:`ftlm.compare`."""
        return compare(self, runs, m=m)

    def resid(self, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
        """Whiteness of the residuals and their independence of the inputs; see :func:`ftlm.resid`."""
        return resid(self, runs, lags=lags)

    def frequency_response(self, w: ArrayLike, *, coupling: str = "simulated", sensor: bool = True) -> Complex:
        """Exact response at angular frequencies [rad/s], shape (outputs, inputs, W).

        See :func:`ftlm.frequency.frequency_response`.
        """
        return frequency_response(self, w, coupling=coupling, sensor=sensor)

    def step_response(self, time: ArrayLike, *, tolerance: float = 1e-6) -> Floats:
        """Response to unit steps, shape (outputs, inputs, N); see :func:`ftlm.frequency.step_response`."""
        return step_response(self, time, tolerance=tolerance)

    def stability(self, *, coupling: str = "simulated") -> Stability:
        """Whether the model is stable, and why not; see :func:`ftlm.frequency.stability`."""
        return stability(self, coupling=coupling)

    def is_stable(self, *, coupling: str = "simulated") -> bool:
        """Whether bounded inputs give bounded outputs; an integrator is not stable in this sense."""
        return self.stability(coupling=coupling).stable

    def poles(self, *, coupling: str = "simulated") -> Complex:
        """Poles of a model whose orders have a common base; see :func:`ftlm.frequency.poles`."""
        return poles(self, coupling=coupling)

    def to_control(self, *, band: tuple[float, float], order: int = 5) -> Any:
        """A python-control system by Oustaloup's approximation; see :func:`ftlm.exports.to_control`."""
        return to_control(self, band=band, order=order)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the model as JSON, atomically.

        Raises
        ------
        DataError
            The file exists and ``force`` is not set, or cannot be written.
        """
        data = msgspec.json.format(msgspec.json.encode(self._to_file()), indent=2)
        return write_atomically(path, data + b"\n", force=force)

    def _to_file(self) -> ModelFile:
        s = self.structure
        equations = [
            EquationFile(
                e.output,
                e.order.constant,
                [TermFile(t.signal, t.order.constant, float(t.coefficient), t.factor, t.name) for t in e.terms],
            )
            for e in s.equations
        ]
        initial = s.initial if isinstance(s.initial, str) else list(s.initial)
        return ModelFile(
            "ftlm-model", SCHEMA, s.name, equations, s.coupling, dict(s.delay), initial, s.sensor_filter,
            dict(self.units), dict(self.orders), self.m, dict(self.about), self.estimate,
        )  # fmt: skip

    def __str__(self) -> str:
        return "\n".join(numeric(e) for e in self.equations)

    def _repr_html_(self) -> str:
        return model_html(self)


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model written by :meth:`Model.save`.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    Model
        The same to the last bit, without what is of use only before identification (lattices, laws, references).

    Raises
    ------
    DataError
        No such file, a file that is no model (with the place), one of a later schema, or one above 1 MiB.
    """
    file = Path(path)
    try:
        found = file.stat()
        if not stat.S_ISREG(found.st_mode):
            raise DataError(f"{file} is no regular file; give a file written by save()")
        if found.st_size > MAX_MODEL_BYTES:
            raise DataError(
                f"{file} has {found.st_size} bytes, no model is larger than {MAX_MODEL_BYTES}; give a model file"
            )
        read = msgspec.json.decode(file.read_bytes(), type=ModelFile)
    except OSError as error:
        raise DataError(f"model {file} cannot be read: {error.strerror or error}; check the path") from error
    except DataError:
        raise
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise DataError(f"{file} is no ftlm model: {error}; give a file written by save()") from error
    if read.schema > SCHEMA or read.schema < 1:
        raise DataError(f"{file} has schema {read.schema}, this version reads up to {SCHEMA}; upgrade ftlm")
    try:
        structure = Structure(
            equations=tuple(equation_of(e) for e in read.equations), coupling=read.coupling, delay=read.delay,
            initial=check_initial(read.initial), sensor_filter=read.sensor_filter, name=read.name,
        )  # fmt: skip
        check_estimate(read)
        return Model(structure, read.orders, read.units, read.m, read.about, read.estimate)
    except ModelError as error:
        raise DataError(f"{file} holds no usable model: {error}") from error
