"""The file of a controller: what a machine needs to run it, sample by sample, and how it is read back."""

from __future__ import annotations

import math
import os
from typing import Literal, TypeAlias

import msgspec
import numpy as np

from ftlm._core import __version__
from ftlm.base.checks import words_of
from ftlm.base.errors import DataError, FtlmError, ModelError
from ftlm.base.output import write_atomically
from ftlm.base.saved import Saved
from ftlm.control.fractional import FractionalPid, Realised
from ftlm.control.kalman import Observer
from ftlm.control.quadratic import Lqg
from ftlm.control.realisation import MOST, Realisation

SCHEMA = 1
#: How to run either kind without ftlm.
MEANING = {
    "pid": "each sample, with e = reference - measured: every lag becomes x = keep x + now e + before e_last, and the "
    "output is (kp + direct) e + the sum of weight x, cut at the limit; lags of the derivative begin with "
    "e (now + before)/(1 - keep), those of the integral with 0 and stand still where they would push further",
    "lqg": "each sample, with y what is measured and u what the last sample put out, cut at the limit: "
    "x = x + correction (y - [c 0] x); x = [[a, b], [0, 1]] x + [b; 0] u; output = ahead reference - [feedback 1] x",
}

Matrix: TypeAlias = list[list[float]]


class Lag(msgspec.Struct, forbid_unknown_fields=True):
    """A memory of one number."""

    of: Literal["integral", "derivative"]
    keep: float
    now: float
    before: float
    weight: float


class PidFile(msgspec.Struct, forbid_unknown_fields=True, tag="pid"):
    """A fractional PID at a rate: what it is, and what it does from sample to sample."""

    kp: float
    ki: float
    kd: float
    lam: float
    mu: float
    rate: float
    limit: float | None
    band: tuple[float, float]
    order: int
    direct: float
    lags: list[Lag]

    def controller(self) -> Realised:
        """The controller, made again."""
        pid = FractionalPid(self.kp, self.ki, self.kd, self.lam, self.mu)
        limit = math.inf if self.limit is None else self.limit
        return Realised(pid, self.rate, limit=limit, band=self.band, order=self.order)


class LqgFile(msgspec.Struct, forbid_unknown_fields=True, tag="lqg"):
    """An observer and a state feedback at a rate."""

    rate: float
    limit: float | None
    input: str
    outputs: list[str]
    measured: list[str]
    tracked: str
    a: Matrix
    b: Matrix
    c: Matrix
    correction: Matrix
    feedback: Matrix
    ahead: float
    poles: list[tuple[float, float]]
    band: tuple[float, float]
    gain_error_db: list[float]
    phase_error_degrees: list[float]
    noise: list[float]
    drift: float
    deviations: list[float]

    def controller(self) -> Lqg:
        """The controller, made again."""
        a, b, c, correction, feedback = (
            np.array(m, dtype=np.float64) for m in (self.a, self.b, self.c, self.correction, self.feedback)
        )
        size, seen = len(self.a), len(self.measured)
        shapes = {"a": (a, (size, size)), "b": (b, (size, 1)), "c": (c, (len(self.outputs), size)),
                  "correction": (correction, (size + 1, seen)), "feedback": (feedback, (1, size))}  # fmt: skip
        for name, (matrix, shape) in shapes.items():
            if matrix.shape != shape:
                raise ModelError(f"{name} has shape {matrix.shape}, not {shape}")
            if not np.isfinite(matrix).all():
                raise ModelError(f"{name} is not finite")
        if not 0 < size <= MOST + 1:
            raise ModelError(f"{size} states are not 1 to {MOST + 1}")
        if not 0 < len(self.poles) <= size:
            raise ModelError(f"{len(self.poles)} poles are not those of {size} states")
        absent = [n for n in (*self.measured, self.tracked) if n not in self.outputs]
        if absent:
            raise ModelError(f"{absent[0]} is not one of its outputs")
        if not (self.rate > 0 and len(self.noise) == seen):
            raise ModelError("its rate is not above 0, or not every measured output has its noise")
        lists = (self.gain_error_db, self.phase_error_degrees, self.deviations)
        if any(len(one) != len(self.outputs) for one in lists):
            raise ModelError("not every output has its errors")
        gain, phase, deviations = (dict(zip(self.outputs, one, strict=True)) for one in lists)
        realisation = Realisation(
            tuple(self.outputs), self.input, self.rate, self.band, tuple(complex(*p) for p in self.poles), a, b, c,
            gain, phase,
        )  # fmt: skip
        observer = Observer(realisation, tuple(self.measured), tuple(self.noise), self.drift, correction, deviations)
        limit = math.inf if self.limit is None else self.limit
        return Lqg(observer, feedback, self.tracked, limit=limit)


class ControllerFile(msgspec.Struct, forbid_unknown_fields=True):
    """The whole file."""

    format: Literal["ftlm-controller"]
    schema: int
    written_by: str
    model: str
    meaning: str
    controller: PidFile | LqgFile


#: A controller of thirty states has a few tens of kilobytes.
CONTROLLER = Saved("controller", "a file that ftlm control wrote", ControllerFile, SCHEMA)


def save_controller(
    controller: Realised | Lqg, path: str | os.PathLike[str], *, model: str = "", force: bool = False
) -> None:
    """Write a controller as JSON: what it was made of, and the numbers that a machine runs from sample to sample.

    Parameters
    ----------
    controller
        What runs.
    path
        File to write.
    model
        What it was designed on, in words.
    force
        Overwrite a file that exists.

    Raises
    ------
    ModelError
        Something that is no controller of ftlm.
    DataError
        The file exists and ``force`` is not set, or it cannot be written.
    """
    if isinstance(controller, Realised):
        written: PidFile | LqgFile = _pid(controller)
    elif isinstance(controller, Lqg):
        written = _lqg(controller)
    else:
        raise ModelError(f"controller is a {type(controller).__name__}; give a Realised or an Lqg")
    kind = "pid" if isinstance(written, PidFile) else "lqg"
    file = ControllerFile("ftlm-controller", SCHEMA, f"ftlm {__version__}", str(model), MEANING[kind], written)
    write_atomically(path, msgspec.json.format(msgspec.json.encode(file), indent=1) + b"\n", force=force)


def load_controller(path: str | os.PathLike[str]) -> Realised | Lqg:
    """Read a controller that :func:`save_controller` or ``ftlm control`` wrote.

    Raises
    ------
    DataError
        A file that cannot be read, or is no controller of this version.
    """
    read = CONTROLLER.read(path)
    CONTROLLER.check_schema(path, read, SCHEMA)
    try:
        return read.controller.controller()
    except (FtlmError, ValueError) as error:
        raise DataError(f"{path} is damaged: {words_of(error)}; write it again") from error


def _limit(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _pid(controller: Realised) -> PidFile:
    pid = controller.pid
    lags = [Lag(of, *values) for of, values in controller.lags()]
    return PidFile(
        pid.kp, pid.ki, pid.kd, pid.lam, pid.mu, controller.rate, _limit(controller.limit), controller.band,
        controller.order, controller.direct, lags,
    )  # fmt: skip


def _lqg(controller: Lqg) -> LqgFile:
    observer = controller.observer
    made = observer.realisation
    return LqgFile(
        made.rate, _limit(controller.limit), made.input, list(made.outputs), list(observer.measured),
        controller.tracked, made.a.tolist(), made.b.tolist(), made.c.tolist(), observer.gain.tolist(),
        controller.feedback.tolist(), controller.ahead, [(p.real, p.imag) for p in made.poles], made.band,
        [made.gain_error[o] for o in made.outputs], [made.phase_error[o] for o in made.outputs],
        list(observer.noise), observer.drift, [observer.deviations[o] for o in made.outputs],
    )  # fmt: skip
