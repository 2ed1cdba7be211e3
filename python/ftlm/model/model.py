"""Model: structure with fixed parameters, and details of its estimation."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
from numpy.typing import ArrayLike

from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.findings import Finding
from ftlm.structure.equation import Equation
from ftlm.structure.structure import Structure, check_offset_resolved
from ftlm.utils.arguments import check_arguments
from ftlm.utils.validation import Complex, Floats, check_pulses

if TYPE_CHECKING:
    from ftlm.analysis.poles import Mode, Stability
    from ftlm.plot.model_charts import Bode, TimeResponse
    from ftlm.validation.comparison import Comparison
    from ftlm.validation.residual_tests import Residuals


class FitParameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Free parameters of an output-error fit, with covariance and noise, as required for experiment design.

    Parameters
    ----------
    names
        Names of the free orders, then of the free coefficients, then of the free delays and limits of inputs.
    orders
        All orders of the model as expressions of free orders: for each equation alpha, then the order of each term.
    products
        Coefficients that a coefficient law determines, by name: (sign, names of the factors).
    covariance
        Covariance of the free parameters in the sequence of `names`; None if it is not finite.
    noise
        Standard deviation of the output error of each measured output, by name.
    refinement
        Number of block pulses per sampling interval on the finest time grid of the fit.
    """

    names: tuple[str, ...]
    orders: tuple[str, ...]
    noise: dict[str, float]
    products: dict[str, tuple[float, tuple[str, ...]]] = {}
    covariance: tuple[tuple[float, ...], ...] | None = None
    refinement: int = 1


class Estimate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Results of the identification of a model, stored in the model file so that a report requires no other file.

    Parameters
    ----------
    method
        Name of the estimator.
    runs
        Names of the runs.
    values, standard_errors
        Estimates of orders and coefficients by name, and their standard errors by name, None if not available.
    covariance
        Covariance of all orders and coefficients, and of delays, saturations and dead zones. For each equation, its
        rows are alpha, then order and coefficient of each term, then friction parameters (fc, fs, vs). The delays
        follow, then the limits. None if the estimator gives none. It is singular if laws relate parameters.
    fit
        Fit of the simulation to the runs of the identification [%], by output.
    information
        Values of the information criteria by name; None if not available.
    intervals
        95 % profile-likelihood intervals (low, high) by name, with None for an unbounded side. Parameters that are not
        listed have Wald intervals of ± 1.96 standard errors.
    free_parameters
        Free parameters of the output-error fit, with their covariance. None for other methods.
    findings
        Findings about data, fit and model.
    verdict_findings
        Findings of the identification that determine the verdict.
    piece_duration
        Minimum duration [s] of the segments into which the runs of an unstable plant were split, each with its own
        initial values. Comparisons split other runs in the same way. None if whole runs were simulated.
    """

    method: str
    runs: tuple[str, ...]
    values: dict[str, float]
    standard_errors: dict[str, float | None] = {}
    covariance: tuple[tuple[float, ...], ...] | None = None
    fit: dict[str, float | None] = {}
    information: dict[str, float | None] = {}
    intervals: dict[str, tuple[float | None, float | None]] = {}
    free_parameters: FitParameters | None = None
    findings: tuple[Finding, ...] = ()
    verdict_findings: tuple[Finding, ...] = ()
    piece_duration: float | None = None


@check_arguments
@dataclass(frozen=True)
class Model:
    """Model: a structure with fixed orders and coefficients.

    Parameters
    ----------
    structure
        Structure without free parameters.
    orders
        Estimated values of the free orders by name.
    units
        SI units of the signals by name, as far as known.
    m
        Number of block pulses in the identification, which is the default for comparisons; None if not applicable.
    about
        Metadata about the origin of the model, such as method and runs.
    estimate
        Standard errors, covariance and findings of the identification; None for a model without identification.

    Raises
    ------
    ModelError
        If an order, coefficient, delay or limit is free, a coefficient is not finite, or the offset is ``"auto"``.
    """

    structure: Structure
    orders: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    m: int | None = None
    about: Mapping[str, str | float | int | bool | None] = field(default_factory=dict)
    estimate: Estimate | None = None

    def __post_init__(self) -> None:
        if self.m is not None:
            check_pulses(self.m)
        check_offset_resolved(self.structure.offset)
        if self.structure.free_input_parameters:
            names = ", ".join(item.description for item in self.structure.free_input_parameters)
            method = "with_delays" if self.structure.free_delays else "with_limits"
            raise ModelError(f"the {names} is still free; identify it first, or set it by {method}")
        for item in self.structure.equations:
            if not item.is_identified:
                free = [*item.order_names, *item.coefficient_names]
                raise ModelError(f"the equation of {item.output} still has free {', '.join(free)}; identify it first")
            for k, term in enumerate(item.terms):
                if not math.isfinite(float(term.coefficient)):
                    raise ModelError(f"coefficient {k} of {item.output} is not finite; the model cannot be used")

    @property
    def coefficients(self) -> dict[str, float]:
        """Values of all coefficients with a name, including friction parameters, by name."""
        values = {t.name: float(t.coefficient) for e in self.equations for t in e.terms if t.name is not None}
        for item in self.equations:
            values |= {} if item.friction is None else item.friction.identified_coefficients
        return values

    @property
    def equations(self) -> tuple[Equation, ...]:
        """Equations with fixed orders and coefficients."""
        return self.structure.equations

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the modeled outputs."""
        return self.structure.outputs

    def linearized(self, at: Mapping[str, float]) -> Model:
        """Return the linear model of small deviations from an operating point.

        Every non-linear term is replaced by its first-order expansion. Constants are omitted, so signals of the linear
        model are deviations from the operating point.

        Parameters
        ----------
        at
            Values of the signals in non-linear terms, such as ``{"y": 0.3, "u": 1.0}``. Derivatives are 0 unless given,
            as in ``{"y": 0.3, "D y": 0.1}``.

        Raises
        ------
        ModelError
            If `at` lacks a signal of a non-linear term or contains another name, or a term has no derivative at the
            point.
        """
        from ftlm.analysis.model_algebra import linearize

        return linearize(self, at)

    def simulate(
        self,
        run: Run,
        *,
        tolerance: float = 1e-6,
        initial: Mapping[str, Mapping[float, float] | Sequence[float]] | None = None,
        max_m: int = 1 << 22,
    ) -> Run:
        """Simulate the outputs from the inputs of a run; see :func:`ftlm.simulate`."""
        from ftlm.simulation.simulate import simulate

        return simulate(self, run, tolerance=tolerance, initial=initial, max_m=max_m)

    def compare(self, runs: Run | Sequence[Run], *, m: int | None = None) -> Comparison:
        """Compare the model with measured runs by equation error and output error; see :func:`ftlm.compare`."""
        from ftlm.validation.comparison import compare

        return compare(self, runs, m=m)

    def resid(self, runs: Run | Sequence[Run], *, lags: int = 25) -> Residuals:
        """Test whether residuals are white and independent of the inputs; see :func:`ftlm.resid`."""
        from ftlm.validation.residual_tests import resid

        return resid(self, runs, lags=lags)

    def frequency_response(self, w: ArrayLike, *, coupling: str = "simulated", sensor: bool = True) -> Complex:
        """Return the exact complex frequency response, shape (outputs, inputs, W), at angular frequencies w [rad/s].

        See :func:`ftlm.analysis.frequency_response`.
        """
        from ftlm.analysis.frequency_response import frequency_response

        return frequency_response(self, w, coupling=coupling, sensor=sensor)

    def step_response(self, time: ArrayLike, *, tolerance: float = 1e-6) -> Floats:
        """Return the response to unit steps, shape (outputs, inputs, N); see :func:`ftlm.analysis.step_response`."""
        from ftlm.analysis.frequency_response import step_response

        return step_response(self, time, tolerance=tolerance)

    def stability(self, *, coupling: str = "simulated") -> Stability:
        """Return whether the model is stable, with the reason; see :func:`ftlm.analysis.stability`."""
        from ftlm.analysis.poles import stability

        return stability(self, coupling=coupling)

    def is_stable(self, *, coupling: str = "simulated") -> bool:
        """Return whether bounded inputs give bounded outputs; an integrator is not stable in this sense."""
        return self.stability(coupling=coupling).stable

    def poles(self, *, coupling: str = "simulated") -> Complex:
        """Return the poles [rad/s] on the principal Riemann sheet; see :func:`ftlm.analysis.poles`."""
        from ftlm.analysis.poles import poles

        return poles(self, coupling=coupling)

    def zeros(self, output: str | None = None, input: str | None = None) -> Complex:
        """Return the zeros of a transfer function [rad/s] on the principal sheet; see :func:`ftlm.analysis.zeros`."""
        from ftlm.analysis.poles import zeros

        return zeros(self, output, input)

    def modes(self, *, coupling: str = "simulated") -> tuple[Mode, ...]:
        """Return frequency, damping and time constant of every mode; see :func:`ftlm.analysis.modes`."""
        from ftlm.analysis.poles import modes

        return modes(self, coupling=coupling)

    def dcgain(self) -> Floats:
        """Return the steady-state gains, shape (outputs, inputs); see :func:`ftlm.analysis.dcgain`."""
        from ftlm.analysis.poles import dcgain

        return dcgain(self)

    def step(self, time: ArrayLike | None = None) -> TimeResponse:
        """Return the response to unit steps from rest with its standard deviation; notebooks show it as a plot.

        Parameters
        ----------
        time
            Uniform sample times from 0 [s], at least 3; by default up to the settling time.

        Returns
        -------
        TimeResponse
            Response with ``.time`` [s], ``.values`` of shape (outputs, inputs, N), and ``.deviation``, the standard
            deviation of the values, or None without a covariance.

        Raises
        ------
        DataError
            If the sample times are not uniform from 0.
        ModelError
            If an input has a saturation or dead zone.
        ConvergenceError
            If the response of an unstable model overflows.
        """
        from ftlm.plot.model_charts import time_response

        return time_response(self, time, "step")

    def impulse(self, time: ArrayLike | None = None) -> TimeResponse:
        """Return the response to unit impulses as means over sampling intervals; otherwise as :meth:`step`."""
        from ftlm.plot.model_charts import time_response

        return time_response(self, time, "impulse")

    def bode(self, w: ArrayLike | None = None) -> Bode:
        """Return gain and phase of the frequency response with 95 % bands; notebooks show them as a plot.

        Parameters
        ----------
        w
            Angular frequencies [rad/s]; by default a range around the corner frequencies of the model.

        Returns
        -------
        Bode
            Result with ``.frequency`` [rad/s] and ``.curves``, each with gain [dB] and phase [degrees].

        Raises
        ------
        DataError
            If a frequency is negative or not finite.
        ModelError
            If an input has a saturation or dead zone.
        """
        from ftlm.plot.model_charts import bode

        return bode(self, w)

    @classmethod
    def from_control(
        cls, system: Any, *, inputs: Sequence[str] | None = None, outputs: Sequence[str] | None = None
    ) -> Model:
        """Return a model of integer orders, one equation per output, from a continuous-time python-control system.

        Parameters
        ----------
        system
            ``control.StateSpace`` or ``control.TransferFunction``. The equations represent its transfer functions.
            Uncontrollable or unobservable parts are removed only if they cancel exactly. The attribute ``delay`` of
            the system, which :meth:`to_tf` and :meth:`to_ss` set, has the delays of the inputs [s].
        inputs, outputs
            Names of the signals. The default is the names in the system, where ``u[0]`` becomes ``u``, or ``u0`` if
            there are several signals.

        Raises
        ------
        ModelError
            If the system is discrete-time or of another type, an output has no poles or no input, a transfer function
            has more zeros than poles, an order is above 10, names are invalid or of a wrong number, or ``delay`` is not
            a mapping of inputs to numbers.
        """
        from ftlm.analysis.conversion import structure_of

        return cls(structure_of(system, inputs, outputs))

    def to_control(self, *, band: tuple[float, float] | None = None, order: int = 5) -> Any:
        """Return a python-control system by Oustaloup's approximation; see :func:`ftlm.analysis.to_control`."""
        from ftlm.analysis.rational_approximation import to_control

        return to_control(self, band=band, order=order)

    def series(self, following: Model) -> Model:
        """Return the exact series connection, in which the output of this model is the input of `following`.

        Both models must have one output and one input. Their delays are added. Common factors are not canceled.

        Raises
        ------
        ModelError
            If a model has more than one output or input, friction, a saturation, a dead zone or a sensor filter, or an
            order exceeds 10.
        """
        from ftlm.analysis.model_algebra import series

        return series(self, following)

    def parallel(self, other: Model) -> Model:
        """Return the exact parallel connection, the sum of the outputs of both models for the same input.

        Both models must have one output and one input. Common factors are not canceled.

        Raises
        ------
        ModelError
            If the delays differ, or in the cases of :meth:`series`.
        """
        from ftlm.analysis.model_algebra import combine

        return combine("+", self, other, "a sum")

    def feedback(self, back: Model | float = 1.0, *, sign: int = -1) -> Model:
        """Return the exact closed loop G / (1 - sign G H), where G is this model.

        Parameters
        ----------
        back
            Model H in the feedback path, or a gain.
        sign
            -1 for negative feedback, 1 for positive.

        Raises
        ------
        ModelError
            If there is a delay in the loop, or in the cases of :meth:`series`.
        """
        from ftlm.analysis.model_algebra import feedback

        return feedback(self, back, sign)

    def __mul__(self, other: Model | float) -> Model:
        """Return the series connection in which `other`, a model or a gain, acts first, as in python-control."""
        return self._combine("*", self, other)

    def __rmul__(self, other: float) -> Model:
        return self._combine("*", other, self)

    def __add__(self, other: Model | float) -> Model:
        """Return the parallel connection with another model or a gain."""
        return self._combine("+", self, other)

    def __radd__(self, other: float) -> Model:
        return self._combine("+", other, self)

    def __sub__(self, other: Model | float) -> Model:
        """Return the difference of the outputs of this model and another model or a gain, for the same input."""
        return self._combine("-", self, other)

    def __rsub__(self, other: float) -> Model:
        return self._combine("-", other, self)

    def __truediv__(self, other: Model | float) -> Model:
        """Return this model times the inverse of another model or of a gain."""
        return self._combine("/", self, other)

    def __rtruediv__(self, other: float) -> Model:
        return self._combine("/", other, self)

    def __neg__(self) -> Model:
        return self._combine("*", -1.0, self)

    @staticmethod
    def _combine(operator: str, left: Model | float, right: Model | float) -> Model:
        """Return the result of an operator; NotImplemented for an operand that is neither a model nor a number."""
        from ftlm.analysis.model_algebra import combine

        if not all(isinstance(operand, (Model, Real)) for operand in (left, right)):
            return NotImplemented  # type: ignore[no-any-return]
        return combine(operator, left, right)

    def inverse(self) -> Model:
        """Return the exact inverse model, from the output to the input.

        Raises
        ------
        ModelError
            If the model has a delay or is strictly proper (its inverse is improper), or in the cases of :meth:`series`.
        """
        from ftlm.analysis.model_algebra import inverse

        return inverse(self)

    def to_tf(self) -> Any:
        """Return an exact python-control TransferFunction of this model, which must have integer orders.

        See :func:`ftlm.analysis.to_tf`.
        """
        from ftlm.analysis.conversion import to_tf

        return to_tf(self)

    def to_ss(self, *, step: float | None = None) -> Any:
        """Return an exact python-control StateSpace if all orders are integers; see :func:`ftlm.analysis.to_ss`."""
        from ftlm.analysis.conversion import to_ss

        return to_ss(self, step=step)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write the model to a JSON file, atomically, and return the path.

        Parameters
        ----------
        path
            File to write.
        force
            Overwrite an existing file.

        Raises
        ------
        DataError
            If the file exists and ``force`` is False, or it cannot be written.
        """
        from ftlm.model.serialization import write_model

        return write_model(self, path, force=force)

    def __str__(self) -> str:
        return "\n".join(map(self.structure.equation_text, self.equations))

    def _repr_html_(self) -> str:
        from ftlm.report.typesetting import model_html

        return model_html(self)


def check_model(model: object) -> None:
    """Raise ModelError if an object is not a :class:`Model`."""
    if not isinstance(model, Model):
        raise ModelError(f"model is {type(model).__name__}, not a Model; identify a structure or load a model first")
