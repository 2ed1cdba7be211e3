"""The record of a model: a structure whose orders and coefficients are numbers, and how they were found."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType
from numpy.typing import ArrayLike

from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.structure.equation import Equation
from ftlm.structure.structure import Structure, check_decided
from ftlm.utils.validation import Complex, Floats, check_pulses

if TYPE_CHECKING:
    from ftlm.analysis.poles import Mode, Stability
    from ftlm.plot.model_charts import Answer, Bode
    from ftlm.validation.comparison import Comparison
    from ftlm.validation.residual_tests import Residuals


class Freedom(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What was free in a joint fit and how well it was told, so that another experiment can be laid out from a file.

    Parameters
    ----------
    names
        Free orders, free coefficients, then delays and limits of inputs.
    orders
        Every order of the model as it depends on free ones, in words: equation by equation alpha, then each term's.
    products
        Coefficients that follow from others by a law: sign and factors by name.
    covariance
        Of the free numbers in the order of their names; None where it is not finite.
    noise
        Standard deviation of what the free run left of each output, as it was measured, by name.
    refinement
        Pulses a sample interval of the fit's finest grid.
    """

    names: tuple[str, ...]
    orders: tuple[str, ...]
    noise: dict[str, float]
    products: dict[str, tuple[float, tuple[str, ...]]] = {}
    covariance: tuple[tuple[float, ...], ...] | None = None
    refinement: int = 1


class Against(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What speaks against a model.

    Parameters
    ----------
    level
        What it makes of the model: ``"do not use"`` or ``"with care"``.
    reason
        In a sentence.
    remedy
        What to do about it.
    """

    level: Literal["do not use", "with care"]
    reason: Annotated[str, Meta(min_length=1)]
    remedy: str = ""


class Estimate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is known about how a model was identified, kept with it so that a report needs no other file.

    Parameters
    ----------
    method
        Estimator.
    runs
        Names of the runs.
    values, standard_errors
        Orders and coefficients by name as they were estimated, and their standard errors where there are any.
    covariance
        Of every number of the model in the order of its equations (alpha, then order and coefficient of each term, then
        the coefficient of friction where there is some, with those of Stribeck's term fc, fs and vs); None where the
        estimator gives none. It may be singular: laws tie numbers.
    fit
        Fit of the free run on these runs in percent, by output.
    information
        Information criteria, where known.
    warnings
        What makes the model doubtful, in words.
    intervals
        95 % intervals by profile likelihood, of the values that have one; None for an end that is infinite. Those of
        the others are ± 1.96 standard errors. Not set where no value has one.
    free
        What a joint fit found together, from which the next experiment is laid out. Not set for other methods.
    against
        What spoke against the model when it was identified, as its verdict weighs it; not set where nothing did, and in
        files of earlier versions, which are judged by their warnings.
    """

    method: str
    runs: tuple[str, ...]
    values: dict[str, float]
    standard_errors: dict[str, float | None] = {}
    covariance: tuple[tuple[float, ...], ...] | None = None
    fit: dict[str, float | None] = {}
    information: dict[str, float | None] = {}
    warnings: tuple[str, ...] = ()
    intervals: dict[str, tuple[float | None, float | None]] | UnsetType = UNSET
    free: Freedom | UnsetType = UNSET
    against: tuple[Against, ...] | UnsetType = UNSET


@dataclass(frozen=True)
class Solved:
    """A structure whose orders and coefficients are numbers; its fields are those of :class:`ftlm.Model`."""

    structure: Structure
    orders: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    m: int | None = None
    about: Mapping[str, str | float | int | bool | None] = field(default_factory=dict)
    estimate: Estimate | None = None

    def __post_init__(self) -> None:
        if self.m is not None:
            check_pulses(self.m)
        check_decided(self.structure.offset)
        if self.structure.free_inputs:
            numbers = ", ".join(item.words for item in self.structure.free_inputs)
            way = "with_delays" if self.structure.free_delays else "with_limits"
            raise ModelError(f"the {numbers} is still free; identify it first, or set it by {way}")
        for item in self.structure.equations:
            if not item.is_identified:
                free = [*item.order_names, *item.coefficient_names]
                raise ModelError(f"the equation of {item.output} still has free {', '.join(free)}; identify it first")
            for k, term in enumerate(item.terms):
                if not math.isfinite(float(term.coefficient)):
                    raise ModelError(f"coefficient {k} of {item.output} is not finite; the model cannot be used")

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients by name."""
        named = {t.name: float(t.coefficient) for e in self.equations for t in e.terms if t.name is not None}
        for item in self.equations:
            named |= {} if item.friction is None else item.friction.found
        return named

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The equations, all numbers."""
        return self.structure.equations

    @property
    def outputs(self) -> tuple[str, ...]:
        """Modelled outputs."""
        return self.structure.outputs


def check_solved(model: object) -> None:
    """Refuse what is no model."""
    if not isinstance(model, Solved):
        raise ModelError(f"model is {type(model).__name__}, not a Model; identify a structure or load a model first")


class Model(Solved):
    """Structure with numerical orders and coefficients.

    Parameters
    ----------
    structure
        Structure without free parameters.
    orders
        Estimated values of the free orders by name.
    units
        SI units of the signals, where known.
    m
        Number of block pulses of the identification, the default of comparisons.
    about
        Metadata about the origin of the model.
    estimate
        Standard errors, covariance and warnings of the identification; None for a model defined by hand.
    """

    def simulate(
        self,
        run: Run,
        *,
        tolerance: float = 1e-6,
        initial: Mapping[str, Mapping[float, float]] | None = None,
        largest_m: int = 1 << 22,
    ) -> Run:
        """Simulate the outputs from the inputs of a run; see :func:`ftlm.simulate`."""
        from ftlm.simulation.simulate import simulate

        return simulate(self, run, tolerance=tolerance, initial=initial, largest_m=largest_m)

    def compare(self, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
        """Compare with measured runs by equation error and output error; see :func:`ftlm.compare`."""
        from ftlm.validation.comparison import compare

        return compare(self, runs, m=m)

    def resid(self, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
        """Test residuals for whiteness and independence of the inputs; see :func:`ftlm.resid`."""
        from ftlm.validation.residual_tests import resid

        return resid(self, runs, lags=lags)

    def frequency_response(self, w: ArrayLike, *, coupling: str = "simulated", sensor: bool = True) -> Complex:
        """Exact response at angular frequencies [rad/s], shape (outputs, inputs, W).

        See :func:`ftlm.analysis.frequency_response`.
        """
        from ftlm.analysis.frequency_response import frequency_response

        return frequency_response(self, w, coupling=coupling, sensor=sensor)

    def step_response(self, time: ArrayLike, *, tolerance: float = 1e-6) -> Floats:
        """Response to unit steps, shape (outputs, inputs, N); see :func:`ftlm.analysis.step_response`."""
        from ftlm.analysis.frequency_response import step_response

        return step_response(self, time, tolerance=tolerance)

    def stability(self, *, coupling: str = "simulated") -> Stability:
        """Test stability, with the reason for instability; see :func:`ftlm.analysis.stability`."""
        from ftlm.analysis.poles import stability

        return stability(self, coupling=coupling)

    def is_stable(self, *, coupling: str = "simulated") -> bool:
        """Whether bounded inputs give bounded outputs; an integrator is not stable in this sense."""
        return self.stability(coupling=coupling).stable

    def poles(self, *, coupling: str = "simulated") -> Complex:
        """Poles of a model whose orders have a common base; see :func:`ftlm.analysis.poles`."""
        from ftlm.analysis.poles import poles

        return poles(self, coupling=coupling)

    def modes(self, *, coupling: str = "simulated") -> tuple[Mode, ...]:
        """Frequency, damping and time constant of every pole, for any orders; see :func:`ftlm.analysis.modes`."""
        from ftlm.analysis.poles import modes

        return modes(self, coupling=coupling)

    def dcgain(self) -> Floats:
        """Steady-state gain, shape (outputs, inputs); see :func:`ftlm.analysis.dcgain`."""
        from ftlm.analysis.poles import dcgain

        return dcgain(self)

    def step(self, time: ArrayLike | None = None) -> Answer:
        """Response to unit steps from rest with its standard deviation, plotted in notebooks.

        Parameters
        ----------
        time
            Regular sample times from 0 [s], at least 3; by default until the response has settled.

        Returns
        -------
        Answer
            ``.time``, ``.values`` of shape (outputs, inputs, N), ``.deviation`` from the covariance or None.

        Raises
        ------
        DataError
            Sample times that are not regular from 0.
        ModelError
            An input with saturation or dead zone.
        ConvergenceError
            An unstable model whose response overflows.
        """
        from ftlm.plot.model_charts import answer

        return answer(self, time, "step")

    def impulse(self, time: ArrayLike | None = None) -> Answer:
        """Response to unit impulses, averaged over each sampling interval; otherwise as :meth:`step`."""
        from ftlm.plot.model_charts import answer

        return answer(self, time, "impulse")

    def bode(self, w: ArrayLike | None = None) -> Bode:
        """Gain and phase with 95 % bands, plotted in notebooks.

        Parameters
        ----------
        w
            Angular frequencies [rad/s]; by default around the corner frequencies of the model.

        Returns
        -------
        Bode
            ``.frequency``, ``.curves`` with gain [dB] and phase [degrees].

        Raises
        ------
        DataError
            Frequencies that are not finite numbers from 0.
        ModelError
            An input with saturation or dead zone.
        """
        from ftlm.plot.model_charts import bode

        return bode(self, w)

    @classmethod
    def from_control(
        cls, system: Any, *, inputs: Sequence[str] | None = None, outputs: Sequence[str] | None = None
    ) -> Model:
        """Convert a continuous system of python-control to a model of integer orders, one equation per output.

        Parameters
        ----------
        system
            ``control.StateSpace`` or ``control.TransferFunction``. Equations represent the transfer behavior.
            Uncontrollable or unobservable parts cancel only if they cancel exactly.
        inputs, outputs
            Names of the signals; default the system's own, ``u[0]`` as ``u``, or ``u0`` beside others.

        Raises
        ------
        ModelError
            A discrete-time system, another type, an output without dynamics or input, more zeros than poles, an order
            above 10, invalid or too few names.
        """
        from ftlm.analysis.conversion import structure_of

        return cls(structure_of(system, inputs, outputs))

    def to_control(self, *, band: tuple[float, float], order: int = 5) -> Any:
        """Convert to python-control by Oustaloup's approximation; see :func:`ftlm.analysis.to_control`."""
        from ftlm.analysis.rational_approximation import to_control

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
        from ftlm.model.serialization import write_model

        return write_model(self, path, force=force)

    def __str__(self) -> str:
        return "\n".join(map(self.structure.written, self.equations))

    def _repr_html_(self) -> str:
        from ftlm.report.typesetting import model_html

        return model_html(self)


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model written by :meth:`Model.save`.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    Model
        Bit-identical model, without data that only identification needs (order grids, laws, references).

    Raises
    ------
    DataError
        A file that does not exist, is no model (with the place), has a later schema, or exceeds 1 MiB.
    """
    from ftlm.model.serialization import read_model

    record = read_model(path)
    return Model(record.structure, record.orders, record.units, record.m, record.about, record.estimate)
