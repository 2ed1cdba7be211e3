"""Inverse dynamics: the reference that moves an output along a path, from the inverse of the frequency response."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ftlm.control.arguments import POSITIVE_RANGE, check_limit, check_samples, positive, sum_row
from ftlm.control.fractional_pid import least_certain_parameter
from ftlm.control.stability_margins import LoopDesign, Plant
from ftlm.errors import DataError, ModelError
from ftlm.model.model import Model
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import setting, type_name
from ftlm.utils.validation import Complex, Floats, as_array, real_number, short_repr

#: Minimum length of the Fourier transform relative to the path, and exponent to which the weight exp(-a t) decays over
#: the transform. The weight suppresses the effect of the periodic continuation, which a fractional model would never
#: forget.
TRANSFORM_LENGTH_FACTOR, WEIGHT_DECAY = 8, 28.0
#: Maximum deviation of the reference from its start, relative to the move. A larger one shows an unstable inverse.
MAX_REFERENCE_RATIO = 20.0
#: Maximum length of a path [samples].
MAX_PATH_ROWS = 100_000
#: Maximum deviation of the first sample of a reference from the path, relative to the move. Above it, the path needs a
#: longer dwell before the move.
MAX_INITIAL_OFFSET_FRACTION = 1e-3
#: Maximum residual vibration, relative to that with the path itself as reference. Above it, the model is too uncertain.
MAX_RESIDUAL_FRACTION = 0.5


class Loop(Protocol):
    """Protocol of a loop design, with the frequency responses that :func:`inverse_dynamics` requires."""

    @property
    def rate(self) -> float:
        """Sampling rate [Hz]."""

    @property
    def plants(self) -> tuple[Plant, ...]:
        """Plants from the manipulated input of the loop, one per output."""

    def controller_response(self, w: Floats | Complex) -> tuple[tuple[str, ...], Complex, Complex]:
        """Return the names of the measured outputs, and two frequency responses of the controller at w [rad/s].

        The first is the response of the command to the negative of each measured output, shape (outputs, W). The second
        is the response of the command to the reference, shape (W,).
        """


@dataclass(frozen=True)
class Trajectory:
    """Result of :func:`inverse_dynamics`: the reference for a move along a path, and its predicted effect.

    Arrays have shape (N,), with one value per sample.

    Parameters
    ----------
    reference
        Reference for the loop.
    path
        Desired path of the output.
    command
        Command of the controller, as predicted by the linear model of the loop.
    outputs
        Outputs by name, as predicted by the model.
    residual_vibration
        RMS deviation of the output from the path after the move, as the 97.5 % quantile over the parameter samples.
        None if the model has no covariance.
    uncompensated_vibration
        RMS deviation of the output from the path after the move if the path itself is the reference, at the nominal
        parameters.
    """

    reference: Floats
    path: Floats
    command: Floats
    outputs: dict[str, Floats]
    residual_vibration: float | None
    uncompensated_vibration: float

    def to_dict(self) -> dict[str, Any]:
        """Return length, largest command and residual vibrations as a dictionary for JSON, without the samples."""
        return {
            "rows": len(self.path),
            "largest_command": float(np.max(np.abs(self.command))),
            "residual_vibration": self.residual_vibration,
            "uncompensated_vibration": self.uncompensated_vibration,
        }

    def __str__(self) -> str:
        command_text = f"largest command {np.max(np.abs(self.command)):.3g}"
        uncertainty_text = (
            ""
            if self.residual_vibration is None
            else f", at most {self.residual_vibration:.2g} off it afterwards within the intervals"
        )
        return (
            f"a path of {np.ptp(self.path):.4g} in {len(self.path)} samples: {command_text}{uncertainty_text}; the "
            "path itself as the "
            f"reference would leave {self.uncompensated_vibration:.2g}"
        )


@check_arguments
def point_to_point(
    distance: float, duration: float, rate: float = 500.0, *, dwell_before: float = 0.3, dwell_after: float = 1.2
) -> Floats:
    """Return a path from 0 to `distance` with one value per sample, shape (N,): a polynomial of degree 7 in time.

    Velocity, acceleration and jerk are zero at both ends of the move.

    Parameters
    ----------
    distance
        Distance of the move, in the unit of the output.
    duration
        Duration of the move [s].
    rate
        Sampling rate [Hz].
    dwell_before, dwell_after
        Dwell times before and after the move [s].

    Raises
    ------
    ModelError
        If an argument is out of range, the move has fewer than ten samples, or the path has more than 100 000.
    """
    distance_value = real_number("distance", distance)
    if not math.isfinite(distance_value):
        raise ModelError(f"{setting('distance')} {short_repr(distance)} is not a finite number; give a number")
    times = positive("duration", duration), positive("rate", rate)
    rests = [real_number(n, v) for n, v in (("dwell_before", dwell_before), ("dwell_after", dwell_after))]
    if not all(0 <= r < math.inf for r in rests):
        raise ModelError(
            f"{setting('dwell_before')} {short_repr(dwell_before)} and {setting('dwell_after')} "
            f"{short_repr(dwell_after)} must be finite times [s] of at least 0; pass 0 for no dwell"
        )
    if times[0] * times[1] < 10:
        raise ModelError(
            f"{setting('duration')} {short_repr(duration)} s has fewer than ten samples at {times[1]:g} Hz; give it "
            "more time"
        )
    rows = (sum(rests) + times[0]) * times[1] + 1
    if rows > MAX_PATH_ROWS:
        raise ModelError(f"a move of {rows:.4g} samples is longer than {MAX_PATH_ROWS}; give it less time")
    s = np.clip((np.arange(round(rows)) / times[1] - rests[0]) / times[0], 0.0, 1.0)
    return np.asarray(distance_value * s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3))


@check_arguments
def inverse_dynamics(
    design: Loop,
    path: ArrayLike,
    *,
    output: str | None = None,
    limit: float = math.inf,
    samples: int = 40,
    seed: int = 0,
) -> Trajectory:
    """Compute the reference with which a loop moves an output, or a sum of outputs such as a tip, along a path.

    Parameters
    ----------
    design : PidDesign or LqgDesign
        Loop design. The inverted response includes the exact fractional model, delay, hold and the discrete-time
        controller.
    path : array_like
        Desired path, one value per sample at the rate of the loop. It must be at rest at both ends. The reference may
        have to start before the move, so the path must begin with a sufficiently long dwell.
    output : str, optional
        Output of the model, or a sum of outputs such as ``"theta11 + theta12"``; may be omitted for a model with one
        output.
    limit
        Maximum permitted magnitude of the command.
    samples, seed
        Number of parameter vectors drawn from the covariance of the model, 0 to 10000, and seed of the drawing.

    Returns
    -------
    Trajectory
        Reference, predicted command and outputs, and residual vibration.

    Raises
    ------
    DataError
        If the path is invalid.
    ModelError
        If the command exceeds the limit, the reference would have to start before the first row of the path or
        diverges, or the model is too uncertain. It is too uncertain if the 97.5 % quantile of the residual vibration
        exceeds half of the residual vibration with the path itself as reference.

    Notes
    -----
    In the frequency domain, a nonminimum-phase response has a bounded inverse that starts before the path (Bayo 1987,
    doi:10.1002/rob.4620040406).
    """
    if not isinstance(design, LoopDesign):
        raise ModelError(f"design is {type_name(design)}, not a PidDesign or an LqgDesign; design a loop first")
    rows = _path(path)
    count, start = check_samples(samples, seed)
    maximum = check_limit(limit)
    names = tuple(p.output for p in design.plants)
    row = sum_row("output", names[0] if output is None and len(names) == 1 else output, names)
    transform_length = 1 << math.ceil(math.log2(TRANSFORM_LENGTH_FACTOR * len(rows)))
    # Frequencies on a line s = jw with a constant positive real part, right of all poles, and left of the zeros in the
    # right half-plane that the response of a tip has.
    fall = WEIGHT_DECAY * design.rate / transform_length
    w: Complex = np.asarray(
        2.0 * math.pi * np.fft.rfftfreq(transform_length, 1.0 / design.rate) - 1j * fall, dtype=np.complex128
    )
    is_below_nyquist = w.real < 0.999 * math.pi * design.rate
    weight = np.exp(-fall * np.arange(transform_length) / design.rate)
    measured, feedback_response, reference_response = design.controller_response(w[is_below_nyquist])

    def closed_loop_response(model: Model) -> tuple[Complex, Complex]:
        """Return the closed-loop responses of the command, (W,), and of the outputs, (outputs, W), to the reference."""
        responses = np.array([replace(p, model=model).response(w[is_below_nyquist]) for p in design.plants])
        loop = np.sum([a * responses[names.index(o)] for o, a in zip(measured, feedback_response, strict=True)], axis=0)
        command = reference_response / (1.0 + loop)
        return command, responses * command

    command, outputs = closed_loop_response(design.plants[0].model)
    padded_path = np.concatenate([rows, np.full(transform_length - len(rows), rows[-1])]) - rows[0]
    spectrum = np.fft.rfft(padded_path * weight)[is_below_nyquist]
    command_spectrum = spectrum / (row @ outputs)

    def inverse_transform(half_spectrum: Complex) -> Floats:
        full_spectrum = np.zeros(len(w), dtype=complex)
        full_spectrum[is_below_nyquist] = half_spectrum
        return np.asarray((np.fft.irfft(full_spectrum, transform_length) / weight)[: len(rows)])

    reference = inverse_transform(command_spectrum) + rows[0]
    range_width = float(np.ptp(rows))
    off = float(np.max(np.abs(reference[:1] - rows[0])))
    if off > MAX_INITIAL_OFFSET_FRACTION * range_width:
        raise ModelError(
            f"the reference would have to begin before the path: at its first row it differs from rest by {off:.3g}, "
            f"more than {MAX_INITIAL_OFFSET_FRACTION:g} of the move; let the path stay at rest longer before the move"
        )
    effort = inverse_transform(command_spectrum * command)
    if not np.max(np.abs(reference - rows[0])) < MAX_REFERENCE_RATIO * range_width:
        raise ModelError(
            "the reference diverges, because the output first moves in the wrong direction (non-minimum phase); give "
            "the path more time, or choose another output"
        )
    if np.max(np.abs(effort)) > maximum:
        at = int(np.argmax(np.abs(effort)))
        raise ModelError(
            f"the path needs a command of {np.max(np.abs(effort)):.3g} at {at / design.rate:.4g} s, over the limit of "
            f"{maximum:g}; give it more time, or a smaller move"
        )
    end_row = int(np.flatnonzero(np.abs(rows - rows[-1]) > MAX_INITIAL_OFFSET_FRACTION * range_width)[-1]) + 1
    unshaped_residual = _residual_rms(inverse_transform(spectrum * (row @ outputs)) + rows[0], rows, end_row)
    errors = [
        _residual_rms(
            inverse_transform(command_spectrum * (row @ closed_loop_response(plant_sample.model)[1])) + rows[0],
            rows,
            end_row,
        )
        for plant_sample in design.plants[0].samples(count, start)
    ]
    worst_error = float(np.quantile(errors, 0.975)) if errors else None
    if worst_error is not None and not worst_error <= MAX_RESIDUAL_FRACTION * unshaped_residual:
        raise ModelError(
            "the confidence intervals are too wide to design on: within them the deviation after the end of the path "
            "may be "
            f"{worst_error:.2g}, and {unshaped_residual:.2g} with the path itself as reference; "
            f"{least_certain_parameter(design.plants[0].model)}; identify from a longer or richer run (ftlm "
            "design-input designs one)"
        )
    ways = {n: inverse_transform(command_spectrum * line) for n, line in zip(names, outputs, strict=True)}
    return Trajectory(reference, rows, effort, ways, worst_error, unshaped_residual)


def _path(path: ArrayLike) -> Floats:
    """Return a path as an array of shape (rows,).

    Raise DataError if the path is not one-dimensional, has fewer than 16 or more than 100 000 rows, contains a value
    that is not finite or too large, is constant, or is not at rest at both ends.
    """
    samples = as_array("path", path)
    if samples.dtype.kind not in "fiu" or samples.ndim != 1 or not 16 <= samples.size <= MAX_PATH_ROWS:
        raise DataError(f"path has shape {samples.shape}; give 16 to {MAX_PATH_ROWS} numbers, one per sample")
    rows = np.array(samples, dtype=np.float64)
    invalid_rows = np.flatnonzero(~np.isfinite(rows))
    if invalid_rows.size:
        raise DataError(
            f"path is not finite at row {invalid_rows[0]} ({invalid_rows.size} such rows in all); give finite numbers"
        )
    large = np.flatnonzero(np.abs(rows) > POSITIVE_RANGE[1])
    if large.size:
        raise DataError(
            f"path is beyond {POSITIVE_RANGE[1]:g} at row {large[0]} ({large.size} such rows in all); scale it"
        )
    if np.ptp(rows) < POSITIVE_RANGE[0]:
        raise DataError("path: all points are equal; give at least two different points")
    for end_name, pair in (("begin", rows[:2]), ("end", rows[-2:])):
        if abs(pair[1] - pair[0]) > MAX_INITIAL_OFFSET_FRACTION * np.ptp(rows):
            raise DataError(
                f"path does not {end_name} at rest; repeat its {'first' if end_name == 'begin' else 'last'} row"
            )
    return rows


def _residual_rms(output: Floats, rows: Floats, end_row: int) -> float:
    """Return the RMS deviation of an output from the path `rows`, from sample index `end_row` to the last sample."""
    return float(np.sqrt(np.mean(np.square((output - rows)[min(end_row, len(rows) - 1) :]))))
