"""Identification while a run is recorded: recursion (44) at given orders, sample by sample."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.data.structures import Structure
from ftlm.solve.records import named_coefficients, structure_tuple


class Streaming:
    """Coefficients of a structure after every sample of a run that starts at rest.

    Each sample costs the same, whatever the length of the run: the past is held by about a hundred numbers a signal.
    After the last sample the coefficients are those of ``identify(method="multi-innovation", rows="time")`` at the
    same orders on the run's own grid, to rounding.

    Parameters
    ----------
    structure
        One or several equations whose orders are numbers, without delays, initial terms or sensor filter; alpha - nu
        of every term in [0, 2].
    step
        Time between samples [s].
    longest
        Longest run [s].
    inputs
        Which of the structure's signals are inputs, held between samples.
    innovation_length, prior_covariance
        p and K0 of (44).

    Raises
    ------
    ModelError
        A structure that a stream cannot do, settings out of range.
    """

    def __init__(
        self, structure: Structure, *, step: float, longest: float, inputs: Sequence[str] = ("I1", "I2"),
        innovation_length: int = 7, prior_covariance: float = 1.0,
    ) -> None:  # fmt: skip
        if structure.order_names:
            raise ModelError(
                f"the orders {', '.join(structure.order_names)} are free; a stream needs numbers: give them with "
                "with_orders(…)"
            )
        if structure.offset != "none":
            raise ModelError(
                f"offset = {structure.offset!r} cannot be followed in a stream; identify the recorded run, or use "
                "offset='none'"
            )
        if (
            structure.delay
            or structure.limits
            or structure.sensor_filter is not None
            or structure.initial not in ("auto", "rest")
        ):
            raise ModelError(
                "delays, limits, initial terms and sensor filters cannot be followed in a stream; identify the "
                "recorded run"
            )
        self.signals = tuple(structure.signals)
        self.structure = structure
        known = [name in inputs for name in self.signals]
        equations = [(structure_tuple(e, self.signals), [t.fixed for t in e.terms]) for e in structure.equations]
        rows = max(2, round(longest / step) + 1)
        self._core = _core.Streaming(step, rows, known, equations, innovation_length, prior_covariance)

    def push(self, samples: Floats) -> None:
        """Takes samples, shape (n, len(signals)), in SI units and in the order of `signals`.

        Raises
        ------
        DataError
            A sample that is not finite.
        ModelError
            More samples than `longest` holds.
        ConvergenceError
            The covariance lost its sign to rounding.
        """
        self._core.push(np.ascontiguousarray(samples, dtype=np.float64))

    @property
    def coefficients(self) -> dict[str, float]:
        """By name, after the newest sample."""
        values = zip(self.structure.equations, self._core.coefficients, strict=True)
        return {name: c for item, raw in values for name, c in named_coefficients(item, raw).items()}

    @property
    def pulses(self) -> int:
        """Rows of (44) so far: samples less one."""
        return self._core.pulses

    def __str__(self) -> str:
        return ", ".join(f"{name} = {value:.6g}" for name, value in self.coefficients.items())
