"""Models: structures whose orders and coefficients are numbers."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from ftlm.base.arrays import Complex, Floats
from ftlm.data.run import Run
from ftlm.data.solved import Solved
from ftlm.judge.comparison import Comparison, compare
from ftlm.judge.residuals import Residuals, resid
from ftlm.model.charts import Answer, Bode, answer, bode
from ftlm.model.file import read_model, write_model
from ftlm.model.typesetting import model_html
from ftlm.solve.approximation import to_control
from ftlm.solve.free_run import simulate
from ftlm.solve.frequency import frequency_response, step_response
from ftlm.solve.modes import Mode, dcgain, modes
from ftlm.solve.stability import Stability, poles, stability
from ftlm.solve.whole_orders import structure_of


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
        self, run: Run, *, tolerance: float = 1e-6, initial: Mapping[str, Mapping[float, float]] | None = None,
        largest_m: int = 1 << 22,
    ) -> Run:  # fmt: skip
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

    def modes(self, *, coupling: str = "simulated") -> tuple[Mode, ...]:
        """Frequency, damping and time constant of every pole, whatever the orders; see :func:`ftlm.frequency.modes`."""
        return modes(self, coupling=coupling)

    def dcgain(self) -> Floats:
        """Steady-state gain, shape (outputs, inputs); see :func:`ftlm.frequency.dcgain`."""
        return dcgain(self)

    def step(self, time: ArrayLike | None = None) -> Answer:
        """Response to unit steps from rest, with its uncertainty: a record that prints and draws itself in a notebook.

        Parameters
        ----------
        time
            Regular instants from 0 [s], at least 3; by default until the model has settled.

        Returns
        -------
        Answer
            ``.time``, ``.values`` of shape (outputs, inputs, N), ``.deviation`` from the covariance or None.

        Raises
        ------
        DataError
            Instants that are not regular from 0.
        ModelError
            An input that saturates or has a dead zone.
        ConvergenceError
            A model so unstable that the response leaves the range of numbers.
        """
        return answer(self, time, "step")

    def impulse(self, time: ArrayLike | None = None) -> Answer:
        """Response to unit impulses, as the mean over each interval of the instants; else as :meth:`step`."""
        return answer(self, time, "impulse")

    def bode(self, w: ArrayLike | None = None) -> Bode:
        """Gain and phase with 95 % bands: a record that prints and, in a notebook, draws itself.

        Parameters
        ----------
        w
            Angular frequencies [rad/s]; by default around the model's own.

        Returns
        -------
        Bode
            ``.frequency``, ``.curves`` with gain [dB] and phase [degrees].

        Raises
        ------
        DataError
            Frequencies that are not finite numbers from 0.
        ModelError
            An input that saturates or has a dead zone.
        """
        return bode(self, w)

    @classmethod
    def from_control(
        cls, system: Any, *, inputs: Sequence[str] | None = None, outputs: Sequence[str] | None = None
    ) -> Model:
        """A continuous system of python-control as a model of whole orders, one equation an output.

        Parameters
        ----------
        system
            ``control.StateSpace`` or ``control.TransferFunction``. Equations show transfer behaviour: what no input
            reaches, or no output shows, cancels in them only if it cancels exactly there.
        inputs, outputs
            Names of the signals; default the system's own, ``u[0]`` as ``u``, or ``u0`` beside others.

        Raises
        ------
        ModelError
            A sampled system, one of another kind, an output without dynamics or input, more zeros than poles, an order
            above 10, names that are none or too few.
        """
        return cls(structure_of(system, inputs, outputs))

    def to_control(self, *, band: tuple[float, float], order: int = 5) -> Any:
        """A python-control system by Oustaloup's approximation; see :func:`ftlm.exports.to_control`."""
        return to_control(self, band=band, order=order)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the model as JSON, atomically.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite an existing file.

        Raises
        ------
        DataError
            The file exists and ``force`` is not set, or cannot be written.
        """
        return write_model(self, path, force=force)

    def __str__(self) -> str:
        return "\n".join(map(self.structure.written, self.equations))

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
    record = read_model(path)
    return Model(record.structure, record.orders, record.units, record.m, record.about, record.estimate)
