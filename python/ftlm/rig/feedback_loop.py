"""Feedback control on a rig by a controller function that is called once per sample."""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ftlm.control.arguments import same_rate
from ftlm.control.controller_file import MOTOR_INPUTS, JointControllers
from ftlm.control.fractional_pid import DiscretePid
from ftlm.control.lqg import Lqg
from ftlm.control.stability_margins import LoopDesign
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.estimation.linear import Streaming
from ftlm.rig.arm_parameters import ArmParameters
from ftlm.rig.excitation import finite_number
from ftlm.rig.recording import Experiment, check_times
from ftlm.rig.rig import MAX_RUN_DURATION_S, Board, Rig
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter, setting, type_name
from ftlm.utils.validation import Floats, as_array, check_seed, error_text

#: Controller: function of time [s], measured angles [rad] and reference [rad] that returns two currents [A].
Controller: TypeAlias = Callable[[float, Floats, Floats], Sequence[float] | Floats]
#: Names in a run of the reference angles of joints 1 and 2.
REFERENCE_SIGNALS = ("reference1", "reference2")
#: Maximum length of the JSON description of a controller in the metadata of a run.
MAX_CONTROLLER_JSON_CHARACTERS = 100_000
DEFAULT_RATE_HZ = 500.0
#: Default magnitude of the joint angles at which a limit switch opens [rad], for a board that does not specify them.
DEFAULT_TRAVEL_RAD = (math.pi / 2, math.pi / 2)


@check_arguments
def control(
    controller: Controller,
    reference: ArrayLike,
    rig: str | Board = "virtual",
    *,
    duration: float | None = None,
    limit: float = 30.0,
    rate: float | None = None,
    seed: int = 0,
    parameters: str | os.PathLike[str] | ArmParameters = "effective",
    offset: tuple[float, float] | None = None,
    real_time: bool = False,
    sensor_filter: Literal["stock"] | None = None,
    watchdog: float = 0.1,
    arm: bool = False,
    board: str = "0",
    name: str = "control",
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    live: Streaming | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Run a feedback controller on a rig, and record the run.

    The controller is called once per sample. Limits, watchdog and shutdown are those of :func:`ftlm.rig.record`. The
    command computed from a sample is applied at the next sample, so the loop has a constant delay of one sample. The
    first and the last command are 0 A.

    Parameters
    ----------
    controller : callable
        ``controller(time, angles, reference)`` with the time [s], an array of theta11, theta12, theta21, theta22 [rad]
        as recorded, and the reference of both joints [rad] at that time. It returns the currents of motors 1 and 2 [A],
        at most 0.94 and 1.2 in magnitude. If the controller has a method ``reset()``, it is called before the run. The
        result of a method ``to_dict()`` is stored in the `metadata` of the run. If the controller has an attribute
        `rate` [Hz], this is the only permitted rate. An :class:`ftlm.control.Lqg` commands the motor that is its input.
        A :class:`ftlm.control.DiscretePid` must be passed in an :class:`ftlm.control.JointControllers`.
    reference : array_like
        Reference of the joint angles [rad]: an array of shape (rows, 2) with one row per sample, or a pair of constant
        angles, which requires `duration`.
    rig : {"virtual", "q8"} or Board, default "virtual"
        The simulated arm, the arm on a Q8-USB board, or a user-defined board.
    duration : float, optional
        Duration [s]; by default that of the reference.
    rate : float, optional
        Sampling rate [Hz]; by default that of the controller, or 500.
    limit, seed, parameters, offset, real_time, sensor_filter, watchdog, arm, board, out, force, live, progress
        As for :func:`ftlm.rig.record`.
    name : str
        Name of the run.

    Returns
    -------
    Run
        Run as from :func:`ftlm.rig.record`, with the additional inputs reference1 and reference2 [rad].

    Raises
    ------
    ModelError
        If an argument is out of range, the controller has another rate, the reference exceeds the arm's travel, or
        hardware is used without ``arm=True``. The arm has not moved.
    DataError
        If the reference array is invalid, or the file already exists. The arm has not moved.
    RigFault
        If the rig stopped the run, or the controller raised an exception, returned invalid or excessive currents, or
        was too late. 0 V was written immediately, or by the watchdog if the controller did not return. The message
        states the cause, and ``__cause__`` is the exception of the controller. The recorded samples are in the
        attribute `run` of the exception and in the file.

    Notes
    -----
    In real time, a computation longer than one sampling interval is a missed deadline. The run stops after 21
    consecutive missed deadlines, or when a write is 50 ms late. Without real time, only the watchdog applies, with a
    timeout of 2 s.
    """
    if not callable(controller):
        hint = "; a design is run by its controller" if isinstance(controller, LoopDesign) else ""
        raise ModelError(
            f"controller is {type_name(controller)}; give a function controller(time, angles, reference) "
            f"that returns two currents [A]{hint}"
        )
    controller = _of_both_joints(controller)
    rate = _rate_of(controller, rate)
    path = _reference_array(reference)
    if duration is None:
        if path.ndim == 1:
            raise ModelError(
                f"a constant reference needs {parameter('duration')} [s]; or give it as rows, one per sample"
            )
        duration = (len(path) - 1) / rate
    duration, limit, rate = check_times(duration, limit, rate)
    seed = check_seed(seed)
    description: dict[str, Any] = {"controller": _describe_controller(controller)}

    def loop(board: Board) -> ControllerSource:
        board_parameters = getattr(board, "parameters", None)
        travel = board_parameters.travel if isinstance(board_parameters, ArmParameters) else DEFAULT_TRAVEL_RAD
        rows = _reference_per_sample(path, round(duration * rate) + 1, rate, travel)
        reset = getattr(controller, "reset", None)
        if callable(reset):
            reset()
        return ControllerSource(controller, rows, rate, getattr(board, "clock", time.perf_counter))

    board_options = rig, seed, parameters, offset, real_time, sensor_filter, watchdog, arm, board
    experiment = Experiment(*board_options, duration, limit, rate, name, out, force, live, progress)
    return experiment.record_run(loop, {"control": description})


def _of_both_joints(controller: Controller) -> Controller:
    """Return a controller of both joints, called with (time, angles, reference).

    An LQG controller of one motor is wrapped in :class:`ftlm.control.JointControllers`. Raise ModelError for a PID
    controller, and for an LQG controller whose input is not a motor current.
    """
    if isinstance(controller, Lqg) and controller.observer.realization.input in MOTOR_INPUTS:
        is_second_joint = controller.observer.realization.input == MOTOR_INPUTS[1]
        return JointControllers(None, controller) if is_second_joint else JointControllers(controller)
    if isinstance(controller, (Lqg, DiscretePid)):
        raise ModelError(
            f"controller is {type_name(controller)} of one joint; pass JointControllers(controller) for joint 1 "
            "or JointControllers(None, controller) for joint 2, of ftlm.control"
        )
    return controller


def _rate_of(controller: Controller, rate: float | None) -> float:
    """Return the sampling rate [Hz]: `rate` if it is given, otherwise the rate of the controller, or else the default.

    Raise ModelError if it is out of range or differs from the rate of the controller.
    """
    controller_rate = finite_number(getattr(controller, "rate", None))
    _, _, checked = check_times(
        MAX_RUN_DURATION_S, MAX_RUN_DURATION_S, (controller_rate or DEFAULT_RATE_HZ) if rate is None else rate
    )
    if controller_rate is not None and not same_rate(checked, controller_rate):
        raise ModelError(
            f"{setting('rate')} {checked:g} Hz is not the {controller_rate:g} Hz for which the controller was "
            f"designed; leave {parameter('rate')} out, or design a controller for {checked:g} Hz"
        )
    return checked


class ControllerSource:
    """Command source that calls a controller once per sample.

    Parameters
    ----------
    controller
        Function of time, measured angles and reference that returns both currents [A]; see :func:`control`.
    reference
        Reference of both joints, shape (rows, 2) [rad].
    rate
        Sampling rate [Hz].
    clock
        Function that returns the time [s]. It measures the computing time of the controller.
    """

    def __init__(self, controller: Controller, reference: Floats, rate: float, clock: Callable[[], float]) -> None:
        self.controller, self.reference = controller, reference
        self.rows, self.rate, self.clock = len(reference), rate, clock
        self.extra_signals = {name: reference[:, j] for j, name in enumerate(REFERENCE_SIGNALS)}
        self._rig: Rig | None = None
        self._at = -1
        self._since: float | None = None
        self._computation_time = 0.0

    def first_commands(self, rig: Rig, block: int) -> Floats:
        """Return one command of 0 A, shape (1, 2), because no sample is measured yet."""
        self._rig, self._at = rig, -1
        return np.zeros((1, 2))

    def next_commands(self, rows: Floats) -> Floats:
        """Return the controller's command [A], shape (1, 2), for the last of the measured samples `rows`.

        The last command of a run is 0 A, and after it the result is empty. Raise RigFault if the controller fails or
        returns invalid currents, and ModelError if the board recorded no sample.
        """
        if self._rig is None or not len(rows):
            raise ModelError("the take() method of the board returned no row for a sample; correct it")
        self._at += 1
        if self._at + 2 >= self.rows:
            return np.zeros((1 if self._at + 2 == self.rows else 0, 2))
        t = self._at / self.rate
        self._since = self.clock()
        try:
            returned = self.controller(t, rows[-1, 2:6].copy(), self.reference[self._at].copy())
        except Exception as error:
            self._since = None
            self._rig.fail(f"at {t:.6g} s the controller failed ({type(error).__name__}: {error_text(error)})", error)
        except BaseException:
            with contextlib.suppress(Exception):
                self._rig.board.write((0.0, 0.0))
            raise
        self._computation_time = self.clock() - self._since
        self._since = None
        try:
            currents, fault_text = _currents(returned, self._rig.limits.current)
        except Exception as error:
            # User-defined sequences and numbers may raise on access.
            message = f"at {t:.6g} s what the controller returned cannot be read ({type(error).__name__}: "
            self._rig.fail(f"{message}{error_text(error)})", error)
        if fault_text:
            self._rig.fail(f"at {t:.6g} s the controller {fault_text}")
        return currents

    def explain_fault(self, fault: str) -> str:
        """Return a fault message; add the computing time if the controller took over one sample or did not return."""
        location = f"the sample at {max(self._at, 0) / self.rate:.6g} s"
        if self._since is not None:
            return f"{fault}: the controller had not answered to {location} for {self.clock() - self._since:.3g} s"
        if self._computation_time * self.rate > 1.0:
            return f"{fault}; the controller took {self._computation_time:.3g} s to answer to {location}"
        return fault


def _currents(returned: object, limits: tuple[float, float]) -> tuple[Floats, str]:
    """Return the currents [A] in a controller's result, shape (1, 2), and an error text ("" if they are valid).

    `limits` are the maximum magnitudes of both currents. Invalid currents are returned as 0.
    """
    zero_currents = np.zeros((1, 2))
    if returned is None:
        return zero_currents, "returned nothing; return both currents [A], such as (0.1, 0.0)"
    if isinstance(returned, (str, bytes, bytearray)):
        return (
            zero_currents,
            f"returned text ({bytes(returned[:20]) if not isinstance(returned, str) else returned[:20]!r})",
        )
    if not isinstance(returned, (tuple, list, np.ndarray)):
        return zero_currents, f"returned a {type(returned).__name__}, not both currents [A]"
    if isinstance(returned, np.ndarray) and returned.shape != (2,):
        return zero_currents, f"returned an array of shape {returned.shape}, not both currents [A]"
    if len(returned) != 2:
        return zero_currents, f"returned {len(returned)} values, not both currents [A]"
    values = []
    for motor, (current, maximum) in enumerate(zip(returned, limits, strict=True), start=1):
        if isinstance(current, (bool, np.bool_)) or not isinstance(current, (int, float, np.integer, np.floating)):
            return zero_currents, f"returned a {type(current).__name__} for motor {motor}, not a current [A]"
        try:
            value = float(current)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            return zero_currents, f"returned {value} for motor {motor}, not a finite current"
        if abs(value) > maximum * (1 + 1e-12):
            return zero_currents, (
                f"asked motor {motor} for {value:.4g} A, over the limit of {maximum:g} A; clip what it returns, and "
                "let "
                "no integral grow meanwhile"
            )
        values.append(value)
    return np.array([values]), ""


def _reference_array(reference: ArrayLike) -> Floats:
    """Return the reference as an array of shape (rows, 2) or (2,); raise DataError for any other shape or type."""
    samples = as_array("reference", reference)
    if samples.dtype.kind not in "fiu" or samples.ndim not in (1, 2) or samples.shape[-1] != 2:
        raise DataError(
            "reference is not an array of hub angles; give numbers [rad] of shape (rows, 2), one row per sample, or a "
            "pair of angles to hold"
        )
    return np.array(samples, dtype=np.float64)


def _reference_per_sample(values: Floats, rows: int, rate: float, travel: tuple[float, float]) -> Floats:
    """Return the reference [rad] with one row per sample, shape (rows, 2); a pair of angles is repeated.

    Raise DataError for another number of rows or a value that is not finite. Raise ModelError if an angle exceeds the
    travel of its joint [rad].
    """
    reference = np.tile(values, (rows, 1)) if values.ndim == 1 else values
    if len(reference) != rows:
        raise DataError(
            f"reference has {plural(len(reference), 'row')}, and a run of {(rows - 1) / rate:g} s at {rate:g} Hz has "
            f"{rows}; give as many, or leave {parameter('duration')} out"
        )
    for hub, maximum in enumerate(travel):
        angles = reference[:, hub]
        invalid_rows = np.flatnonzero(~np.isfinite(angles))
        if invalid_rows.size:
            raise DataError(
                f"reference of hub {hub + 1} is {angles[invalid_rows[0]]} at row {invalid_rows[0]} "
                f"({invalid_rows.size} such rows in all); give "
                "finite angles [rad]"
            )
        exceeding_rows = np.flatnonzero(np.abs(angles) > maximum)
        if exceeding_rows.size:
            raise ModelError(
                f"reference of hub {hub + 1} is {math.degrees(angles[exceeding_rows[0]]):.4g} degrees at "
                f"{exceeding_rows[0] / rate:.4g} s "
                f"({exceeding_rows.size} samples in all), beyond its travel of {math.degrees(maximum):.4g} degrees; "
                "it is in rad: "
                "give a smaller one"
            )
    return reference


def _describe_controller(controller: Controller) -> dict[str, Any]:
    """Return name and settings of a controller for the metadata of a run.

    Settings are the result of its method ``to_dict()``, if any. Raise ModelError if they are invalid JSON or too long.
    """
    name = getattr(controller, "__name__", type(controller).__name__)
    description: dict[str, Any] = {"name": str(name)[:100]}
    describe = getattr(controller, "to_dict", None)
    if callable(describe):
        description |= {"settings": describe()}
    try:
        length = len(json.dumps(description, allow_nan=False))
    except (TypeError, ValueError, RecursionError) as error:
        raise ModelError(
            f"the result of to_dict() of the controller is not valid JSON ({error_text(error, 200)}); correct it"
        ) from None
    if length > MAX_CONTROLLER_JSON_CHARACTERS:
        raise ModelError(
            f"the result of to_dict() of the controller is {length} characters long, more than the "
            f"{MAX_CONTROLLER_JSON_CHARACTERS} that the metadata of a run may contain; shorten it"
        )
    return description
