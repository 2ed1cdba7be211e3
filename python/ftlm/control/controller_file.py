"""JSON files of discrete-time controllers, and the pair of controllers for the two joints of the rig."""

from __future__ import annotations

import math
import os
from typing import Any, Literal, TypeAlias

import msgspec
import numpy as np

from ftlm._core import __version__
from ftlm.control.arguments import same_rate
from ftlm.control.fractional_pid import DiscretePid, FractionalPid
from ftlm.control.lqg import Lqg, Observer
from ftlm.control.realization import MAX_POLES, Realization
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import JsonFormat, write_atomically
from ftlm.utils.formatting import finite
from ftlm.utils.parameters import type_name
from ftlm.utils.validation import Floats, as_floats, error_text

CONTROLLER_SCHEMA = 1
#: Algorithm of each kind of controller as text in the file, for implementations without ftlm.
ALGORITHM_TEXTS = {
    "pid": "each sample, with e = reference - measured: every lag becomes x = keep x + now e + before e_last, and the "
    "output is (kp + direct) e + the sum of weight x, cut at the limit; lags of the derivative begin with "
    "e (now + before)/(1 - keep), those of the integral with 0 and are not updated while the output is "
    "saturated in their direction",
    "lqg": "each sample, with y what is measured and u what the last sample put out, cut at the limit: "
    "x = x + correction (y - [c 0] x); x = [[a, b], [0, 1]] x + [b; 0] u; output = ahead reference - [feedback 1] x",
}

Matrix: TypeAlias = list[list[float]]


class Lag(msgspec.Struct, forbid_unknown_fields=True):
    """First-order lag of a fractional PID controller, as stored in a controller file.

    The state for the control error e is x_k = keep x_{k-1} + now e_k + before e_{k-1}. ``weight`` is the factor of the
    state in the controller output, and ``of`` is the part of the controller to which the lag belongs.
    """

    of: Literal["integral", "derivative"]
    keep: float
    now: float
    before: float
    weight: float


class PidFile(msgspec.Struct, forbid_unknown_fields=True, tag="pid"):
    """Fractional PID controller as stored in a controller file: gains, orders and discrete-time coefficients."""

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

    def controller(self) -> DiscretePid:
        """Return the controller with these settings; raise ModelError if they are invalid."""
        pid = FractionalPid(self.kp, self.ki, self.kd, self.lam, self.mu)
        limit = math.inf if self.limit is None else self.limit
        return DiscretePid(pid, self.rate, limit=limit, band=self.band, order=self.order)


class LqgFile(msgspec.Struct, forbid_unknown_fields=True, tag="lqg"):
    """LQG controller as stored in a controller file: discrete-time observer and state feedback."""

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
        """Return the controller with these matrices; raise ModelError if shapes, numbers or names are invalid."""
        state_count, count = len(self.a), len(self.measured)
        shapes = {"a": (state_count, state_count), "b": (state_count, 1), "c": (len(self.outputs), state_count)}
        shapes |= {"correction": (state_count + 1, count), "feedback": (1, state_count)}
        matrices = {name: np.array(getattr(self, name), dtype=np.float64) for name in shapes}
        for name, shape in shapes.items():
            matrix = matrices[name]
            if matrix.shape != shape:
                raise ModelError(f"{name} has shape {matrix.shape}, not {shape}")
            if not np.isfinite(matrix).all():
                raise ModelError(f"{name} is not finite")
        if not 0 < state_count <= MAX_POLES + 1:
            raise ModelError(f"the number of states, {state_count}, is not from 1 to {MAX_POLES + 1}")
        if not 0 < len(self.poles) <= state_count:
            raise ModelError(f"{len(self.poles)} poles do not match {state_count} states")
        missing_names = [n for n in (*self.measured, self.tracked) if n not in self.outputs]
        if missing_names:
            raise ModelError(f"{missing_names[0]} is not one of its outputs")
        if not (self.rate > 0 and len(self.noise) == count):
            raise ModelError("the rate is not above 0, or a measured output has no noise level")
        lists = (self.gain_error_db, self.phase_error_degrees, self.deviations)
        if any(len(values) != len(self.outputs) for values in lists):
            raise ModelError("an output has no approximation errors")
        gain, phase, deviations = (dict(zip(self.outputs, values, strict=True)) for values in lists)
        realization = Realization(
            tuple(self.outputs),
            self.input,
            self.rate,
            self.band,
            tuple(complex(*p) for p in self.poles),
            matrices["a"],
            matrices["b"],
            matrices["c"],
            gain,
            phase,
        )
        design = tuple(self.measured), tuple(self.noise), self.drift, matrices["correction"], deviations
        limit = math.inf if self.limit is None else self.limit
        return Lqg(Observer(realization, *design), matrices["feedback"], self.tracked, limit=limit)


class ControllerFile(msgspec.Struct, forbid_unknown_fields=True):
    """Content of a controller file: one fractional PID or LQG controller, and information on the file."""

    format: Literal["ftlm-controller"]
    schema: int
    written_by: str
    model: str
    meaning: str
    controller: PidFile | LqgFile


#: Format of controller files. With thirty states, a file has a few tens of kilobytes, below the default size limit.
CONTROLLER_FORMAT = JsonFormat("controller", "a file that ftlm control wrote", ControllerFile, CONTROLLER_SCHEMA)


@check_arguments
def save_controller(
    controller: DiscretePid | Lqg, path: str | os.PathLike[str], *, model: str = "", force: bool = False
) -> None:
    """Write a controller to a JSON file, with its design data and discrete-time coefficients.

    Parameters
    ----------
    controller
        Controller to write.
    path
        File to write.
    model
        Text that describes the model for which the controller was designed.
    force
        Whether to overwrite an existing file.

    Raises
    ------
    ModelError
        If the controller has another type.
    DataError
        If the file exists and ``force`` is False, or it cannot be written.
    """
    if isinstance(controller, DiscretePid):
        record: PidFile | LqgFile = _pid(controller)
    elif isinstance(controller, Lqg):
        record = _lqg(controller)
    else:
        raise ModelError(f"controller is {type_name(controller)}; give a DiscretePid or an Lqg")
    kind = "pid" if isinstance(record, PidFile) else "lqg"
    file = ControllerFile(
        "ftlm-controller", CONTROLLER_SCHEMA, f"ftlm {__version__}", str(model), ALGORITHM_TEXTS[kind], record
    )
    write_atomically(path, msgspec.json.format(msgspec.json.encode(file), indent=1) + b"\n", force=force)


@check_arguments
def load_controller(path: str | os.PathLike[str]) -> DiscretePid | Lqg:
    """Return the controller in a file that :func:`save_controller` or ``ftlm control`` wrote.

    Raises
    ------
    DataError
        If the file cannot be read, or is not a controller file of this version.
    """
    stored = CONTROLLER_FORMAT.read(path)
    try:
        return stored.controller.controller()
    except (FtlmError, ValueError) as error:
        raise DataError(f"{path} is damaged: {error_text(error)}; save the controller again") from error


def _pid(controller: DiscretePid) -> PidFile:
    return PidFile(
        **controller.pid.to_dict(),
        rate=controller.rate,
        limit=finite(controller.limit),
        band=controller.band,
        order=controller.order,
        direct=controller.direct_gain,
        lags=[Lag(kind, *values) for kind, values in controller.lags()],
    )


def _lqg(controller: Lqg) -> LqgFile:
    observer, shown = controller.observer, controller.to_dict()
    realization, outputs = observer.realization, observer.realization.outputs
    same = ("rate", "limit", "input", "measured", "tracked", "a", "b", "c", "correction", "feedback")
    return LqgFile(
        **{name: shown[name] for name in same},
        outputs=list(outputs),
        ahead=controller.ahead,
        poles=[(p.real, p.imag) for p in realization.poles],
        band=realization.band,
        gain_error_db=[realization.gain_error[o] for o in outputs],
        phase_error_degrees=[realization.phase_error[o] for o in outputs],
        noise=list(observer.noise),
        drift=observer.process_noise,
        deviations=[observer.deviations[o] for o in outputs],
    )


#: Names of the angles that the rig measures, and of the motor currents, in the order of the rig.
ANGLE_NAMES = ("theta11", "theta12", "theta21", "theta22")
MOTOR_INPUTS = ("I1", "I2")


@check_arguments
class JointControllers:
    """Pair of controllers for both joints of the rig, as a function of angles and references that returns currents.

    :func:`ftlm.rig.control` calls it once per sample.

    Parameters
    ----------
    first, second
        Controllers of joint 1 and joint 2. The control error of a :class:`DiscretePid` is the reference minus the hub
        angle of the joint [rad]. An :class:`Lqg` gets the angles that its observer measures. With None, the current of
        the joint is zero.

    Raises
    ------
    ModelError
        If a controller has another type, requires a signal that the arm does not measure, or commands the other motor,
        or if the sampling rates differ.
    """

    def __init__(self, first: DiscretePid | Lqg | None, second: DiscretePid | Lqg | None = None) -> None:
        self.loops = (first, second)
        self._measured_indices: list[list[int]] = []
        for j, loop in enumerate(self.loops):
            if not isinstance(loop, (DiscretePid, Lqg, type(None))):
                raise ModelError(f"controller {j + 1} is {type_name(loop)}; give a DiscretePid, an Lqg or None")
            names = loop.observer.measured if isinstance(loop, Lqg) else (ANGLE_NAMES[2 * j],)
            unknown_names = [n for n in names if n not in ANGLE_NAMES]
            if unknown_names:
                raise ModelError(
                    f"the controller reads {', '.join(unknown_names)}; the arm measures {', '.join(ANGLE_NAMES)}"
                )
            motor_input = loop.observer.realization.input if isinstance(loop, Lqg) else None
            if motor_input in MOTOR_INPUTS and motor_input != MOTOR_INPUTS[j]:
                raise ModelError(
                    f"the controller of joint {j + 1} commands {motor_input}, the current of joint {2 - j}; give it "
                    "as the "
                    f"{('second', 'first')[j]} one"
                )
            self._measured_indices.append([ANGLE_NAMES.index(n) for n in names])
        rates = [loop.rate for loop in self.loops if loop is not None]
        if len(rates) == 2 and not same_rate(*rates):
            raise ModelError(
                f"the controllers have the rates {rates[0]:g} and {rates[1]:g} Hz; design both for the rate of the rig"
            )
        #: Sampling rate of both controllers [Hz]; None without a controller.
        self.rate = rates[0] if rates else None

    def reset(self) -> None:
        """Reset the states of both controllers."""
        for loop in self.loops:
            if loop is not None:
                loop.reset()

    def to_dict(self) -> dict[str, Any]:
        """Return both controllers as a dictionary for JSON, with the keys ``hub1`` and ``hub2``."""
        return {f"hub{j}": None if loop is None else loop.to_dict() for j, loop in enumerate(self.loops, start=1)}

    def __call__(self, time: float, angles: Floats, reference: Floats) -> tuple[float, float]:
        """Return the motor currents (joint 1, joint 2) [A] for one sample.

        `angles` are theta11, theta12, theta21, theta22 [rad], and `reference` are the reference angles of both joints
        [rad]. `time` is not used. Raise DataError for other shapes.
        """
        angles, reference = as_floats("angles", angles), as_floats("reference", reference)
        if angles.shape != (4,) or reference.shape != (2,):
            raise DataError(
                f"angles and reference have shapes {angles.shape} and {reference.shape}; give (4,) and (2,)"
            )
        first_current, second_current = (
            0.0
            if loop is None
            else loop(angles[indices], float(reference[j]))
            if isinstance(loop, Lqg)
            else loop(float(reference[j] - angles[indices[0]]))
            for j, (loop, indices) in enumerate(zip(self.loops, self._measured_indices, strict=True))
        )
        return first_current, second_current
