"""Input-design problem: limits of signals, optimality criterion, and sensitivities of outputs to parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from ftlm.data.run import Run
from ftlm.errors import ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective
from ftlm.estimation.output_error import parameter_set_of, problem_of
from ftlm.model.model import Model
from ftlm.simulation.simulate import simulate
from ftlm.structure.equation import Term
from ftlm.structure.order import Order
from ftlm.utils.linalg import orthonormal, thin_svd
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.validation import Complex, Floats, nearest, real_number, short_repr

Kind = Literal["D", "E"]
#: Exponent of Kiefer's mean, which replaces the longest axis by a smooth function. For s parameters it is within a
#: factor of s^(1/16) of the longest axis.
KIEFER_MEAN_EXPONENT = 16
#: Limit of the determinant of an information matrix, scaled to a unit diagonal, for numerical singularity.
MIN_SCALED_DETERMINANT = 1e-28


@dataclass(frozen=True)
class Criterion:
    """Optimality criterion, which assigns a score to the Fisher information matrix of an input; higher is better.

    The score is minus the logarithm of a size of the confidence ellipsoid of the parameters of interest. Doubling the
    input amplitude increases the score by ln 2.

    Parameters
    ----------
    kind
        Size of the ellipsoid. ``"D"``: geometric mean of its axes. ``"E"``: its longest axis.
    indices
        Indices of the parameters of interest among all p free parameters.
    units
        Scale of each parameter of interest, by which its standard error is divided.
    """

    kind: Kind
    indices: tuple[int, ...]
    units: tuple[float, ...]

    @property
    def count(self) -> int:
        """Number of parameters of interest."""
        return len(self.indices)

    def score(self, information: Floats) -> Floats:
        """Return the scores, shape (…), of information matrices, shape (…, p, p).

        A score is -inf if the parameters of interest are not identifiable.
        """
        covariance = self._inverse(information)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "D":
                sign, log_determinant = np.linalg.slogdet(covariance)
                scores = np.where(sign > 0, -0.5 * log_determinant / self.count, -np.inf)
            else:
                axes = np.linalg.eigvalsh(np.where(np.isfinite(covariance), covariance, 0.0))
                scores = np.where(axes[..., 0] > 0, -0.5 * np.log(axes[..., -1]), -np.inf)
        return np.where(np.isfinite(covariance[..., 0, 0]), scores, -np.inf)

    def smooth_score(self, information: Floats) -> float:
        """Return a differentiable upper bound of the score of an information matrix, shape (p, p).

        For criterion E, Kiefer's mean over all axes of the confidence ellipsoid replaces the longest axis. For D, the
        bound is the score itself.
        """
        if self.kind == "D":
            return float(self.score(information))
        axes = np.linalg.eigvalsh(self._inverse(information))
        if not (np.all(np.isfinite(axes)) and axes[0] > 0):
            return -math.inf
        return float(
            -0.5
            * (np.log(axes[-1]) + np.log(np.mean((axes / axes[-1]) ** KIEFER_MEAN_EXPONENT)) / KIEFER_MEAN_EXPONENT)
        )

    def gradient(self, information: Floats) -> Floats:
        """Return the gradient of twice the smooth score with respect to the information matrix, shape (p, p).

        Its inner product with the information matrix is 1.
        """
        p = len(information)
        scale = np.sqrt(np.diag(information))
        covariance = np.linalg.inv(information / np.outer(scale, scale)) / np.outer(scale, scale)
        covariance_rows = covariance[:, self.indices] / np.asarray(self.units)
        block = covariance_rows[list(self.indices)] / np.asarray(self.units)[:, None]
        axes, eigenvectors = np.linalg.eigh(0.5 * (block + block.T))
        axes = np.maximum(axes, np.finfo(np.float64).tiny)
        power = KIEFER_MEAN_EXPONENT if self.kind == "E" else 0
        ratios = (axes / axes[-1]) ** power
        weights = ratios / axes / np.sum(ratios)
        rotated_rows = covariance_rows @ eigenvectors
        return np.asarray((rotated_rows * weights) @ rotated_rows.T).reshape(p, p)

    def _inverse(self, information: Floats) -> Floats:
        """Return the covariance matrix of the scaled parameters of interest for each information matrix (…, p, p).

        All its elements are infinite if the information matrix is singular.
        """
        diagonal = np.diagonal(information, axis1=-2, axis2=-1)
        is_positive = np.all(diagonal > 0, axis=-1)
        scale = np.sqrt(np.where(is_positive[..., None], diagonal, 1.0))
        scaled = information / (scale[..., :, None] * scale[..., None, :])
        scaled = np.where(is_positive[..., None, None], scaled, np.eye(scaled.shape[-1]))
        sign, determinant = np.linalg.slogdet(scaled)
        is_regular = is_positive & (sign > 0) & (determinant > math.log(MIN_SCALED_DETERMINANT) * 2)
        scaled = np.where(is_regular[..., None, None], scaled, np.eye(scaled.shape[-1]))
        indices = list(self.indices)
        unit = scale[..., indices] * np.asarray(self.units)
        inverse = np.linalg.inv(scaled)[..., indices, :][..., indices] / (unit[..., :, None] * unit[..., None, :])
        return np.where(is_regular[..., None, None], inverse, np.inf)


#: Range of finite limits of signals. Outside it, squares of ratios overflow.
LIMIT_RANGE = (1e-50, 1e50)


@dataclass(frozen=True)
class Bounds:
    """Limits of inputs, input rates and outputs during a run, in the units of the signals.

    Parameters
    ----------
    peaks
        Maximum absolute value of each input.
    slews
        Maximum rate of change of each input [unit/s]; infinite if unlimited.
    output_limits
        Maximum absolute value of each output; infinite if unlimited.
    """

    peaks: Mapping[str, float]
    slews: Mapping[str, float]
    output_limits: Mapping[str, float]

    def ramp_samples(self, step: float) -> int:
        """Return the maximum over inputs of the number of samples from one peak to the opposite at the maximum rate.

        It is at least 1. `step` is the sampling interval [s].
        """
        return max(1, *(math.ceil(min(2 * p / self.slews[n] / step, 1e18) - 1e-9) for n, p in self.peaks.items()))

    def scale(self, commands: Floats, outputs: Floats) -> float:
        """Return the largest factor, at most 1, with which scaled commands and outputs meet their limits.

        `commands` has one row per input and `outputs` one per output, in the sequence of the limits.
        """
        limits = [*self.output_limits.values(), *self.peaks.values()]
        rows = zip(limits, [*outputs, *commands], strict=True)
        return min([1.0, *(limit / float(np.max(np.abs(row))) for limit, row in rows if np.any(row))])


def per_signal_values(
    argument: str, values: object, names: Sequence[str], default: Mapping[str, float] | None
) -> dict[str, float]:
    """Return one positive number for each of `names`, from a number, a mapping by name, or the default.

    `argument` is the argument in error messages.

    Raises
    ------
    ModelError
        If a name is unknown, a value is not positive or out of range, or a value without a default is missing.
    """
    if isinstance(values, Mapping):
        for name in values:
            if name not in names:
                hint = nearest(name, names) if isinstance(name, str) else ""
                raise ModelError(
                    f"{argument} names {short_repr(name)}{hint}, which is not one of {', '.join(names) or 'nothing'}; "
                    "name one of them"
                )
    elif values is not None:
        values = dict.fromkeys(names, values)
    out = {}
    for name in names:
        stated_value = None if values is None else values.get(name)
        if stated_value is None:
            if default is None or name not in default:
                raise ModelError(
                    f"{argument} of {name} is not given; give {parameter(argument)} a number, or one by name, or "
                    f"{parameter('reference_run')} a run"
                )
            out[name] = default[name]
            continue
        value = real_number(f"{argument} of {name}", stated_value)
        if not value > 0:
            raise ModelError(f"{argument} of {name} = {value:g} is not above 0; give its largest absolute value")
        if not LIMIT_RANGE[0] <= value <= LIMIT_RANGE[1] and not math.isinf(value):
            raise ModelError(
                f"{argument} of {name} = {value:g} is not between {LIMIT_RANGE[0]:g} and {LIMIT_RANGE[1]:g}; use other "
                "units"
            )
        out[name] = value
    return out


#: Relative singular value below which a direction of the responses to offsets counts as rounding error.
OFFSET_RANK_TOLERANCE = 1e-10
#: Relative change of a simulation at which its step refinement terminates.
SIMULATION_TOLERANCE = 1e-7


@dataclass(frozen=True)
class ModelFit:
    """Model and results of its fit that an input design requires.

    Parameters
    ----------
    model
        Model with simulated coupling, whose outputs depend only on its inputs.
    problem, values
        Estimation problem of a run that starts at rest, and the values of its p free parameters.
    noise
        Noise standard deviation of each output.
    refinement
        Number of block pulses per sampling interval.
    """

    model: Model
    problem: FreeProblem
    values: tuple[float, ...]
    noise: Mapping[str, float]
    refinement: int

    @classmethod
    def of(cls, model: Model, noise: Mapping[str, float]) -> ModelFit:
        """Return the fit of an output-error model; `noise` has the noise standard deviation of each output."""
        problem, values = problem_of(model)
        simulated_model = replace(model, structure=replace(model.structure, coupling="simulated", initial="rest"))
        return cls(simulated_model, problem, tuple(values), noise, parameter_set_of(model).refinement)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(self.problem.names)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the modeled outputs."""
        return self.problem.structure.outputs

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs of the model: its signals that are not outputs."""
        return tuple(s for s in self.problem.structure.signals if s not in self.outputs)

    @property
    def covariance(self) -> Floats:
        """Covariance matrix of the free parameters in the fit, shape (p, p)."""
        parameters = parameter_set_of(self.model)
        indices = [parameters.names.index(n) for n in self.names]
        return np.asarray(parameters.covariance)[np.ix_(indices, indices)]

    def run(self, commands: Floats, step: float, name: str) -> Run:
        """Return a run with commands, shape (inputs, rows), as inputs, and the simulated outputs of the model.

        `step` is the sampling interval [s], and `name` the name of the run.
        """
        empty_run = Run.from_arrays(
            step=step,
            inputs=dict(zip(self.inputs, commands, strict=True)),
            outputs={o: np.zeros(commands.shape[1]) for o in self.outputs},
            units={s: u for s, u in self.model.units.items() if u and s in (*self.inputs, *self.outputs)},
            name=name,
        )
        simulated = simulate(self.model, empty_run, tolerance=SIMULATION_TOLERANCE)
        return empty_run.with_outputs({o: simulated[o] for o in self.outputs})

    def jacobian(self, run: Run, *, offset: bool = True) -> Floats:
        """Return derivatives of outputs with respect to parameters, divided by the noise, for a simulated run.

        The shape is (parameters, outputs * samples). As in a fit, the first and the last sample are not used. Responses
        to offsets, if the model has any, are projected out unless `offset` is False.
        """
        problem = self.problem
        if not offset:
            problem = replace(problem, structure=replace(problem.structure, offset="none"))
        return _derivatives(problem, self.values, run, [1.0 / self.noise[o] for o in self.outputs], self.refinement)

    def predicted_covariance(self, run: Run) -> Floats:
        """Return the covariance matrix (p, p) that is predicted for a fit to a simulated run alone.

        It is the inverse of the Fisher information from exact derivatives. If a parameter is not identifiable, all
        variances are infinite.
        """
        rows = self.jacobian(run)
        norms = np.linalg.norm(rows, axis=1)
        scaled = rows / np.where(norms > 0, norms, 1.0)[:, None]
        _, singular_values, vt = thin_svd(scaled.T)
        tolerance = np.finfo(np.float64).eps * np.sqrt(rows.shape[1])
        if np.any(norms == 0) or singular_values[-1] <= tolerance * singular_values[0]:
            return np.diag(np.full(len(rows), np.inf))
        factor = vt.T / singular_values / norms[:, None]
        return np.asarray(factor @ factor.T)


def _derivatives(
    problem: FreeProblem, values: tuple[float, ...], run: Run, weights: list[float], pulses: int
) -> Floats:
    orders, coefficients, inputs = problem.split(values)
    grid = Objective(problem, [run], weights, pulses_per_sample=pulses)
    point = grid.minimize(Iterate(orders, coefficients, "the model", {}, inputs), 1, linear_scale=True)
    return np.asarray(point.outcome["jacobian"])


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives of the outputs with respect to the parameters, for one zero-order-hold sample of each input.

    The derivatives for any input follow by convolution. This is exact, because all equations are linear in their inputs
    and start at rest.

    Parameters
    ----------
    fit
        Model and its fit.
    step, rows
        Sampling interval [s], and number of samples of the run without the last one, which the fit does not use.
    ramp
        Number of samples over which a change of a command is spread by a moving average, to limit its slew rate.
    kernels
        Derivatives for one sample of each input, divided by the noise standard deviation of the output, shape (inputs,
        parameters, outputs, rows).
    responses
        Outputs for one sample of each input, shape (inputs, outputs, rows).
    nuisance
        Orthonormal basis of the responses to unknown offsets, divided by the noise, shape (basis vectors, outputs *
        rows).
    """

    fit: ModelFit
    step: float
    rows: int
    ramp: int
    kernels: Floats
    responses: Floats
    nuisance: Floats

    @classmethod
    def of(cls, fit: ModelFit, step: float, rows: int, ramp: int) -> Sensitivities:
        """Return the sensitivities of a fitted model, from one simulation per input; see the class for arguments."""
        kernels, responses, inputs = [], [], len(fit.inputs)
        for k in range(inputs):
            # A fit does not use the first sample of a run, so the pulse is at the second.
            commands = np.zeros((inputs, rows + 2))
            commands[k, 1 : 1 + ramp] = 1.0 / ramp
            run = fit.run(commands, step, "pulse")
            jacobian = fit.jacobian(run, offset=False)
            kernels.append(jacobian.reshape(len(fit.names), len(fit.outputs), rows))
            responses.append(np.stack([run[o][1:-1] for o in fit.outputs]))
        nuisance = _offset_responses(fit, step, rows)
        return cls(fit, step, rows, ramp, np.stack(kernels), np.stack(responses), nuisance)

    @cached_property
    def length(self) -> int:
        """Length of the Fourier transforms [samples], long enough to avoid circular convolution."""
        return fast_length(2 * self.rows)

    @cached_property
    def spectra(self) -> tuple[Complex, Complex]:
        """Fourier transforms of `kernels` and of `responses` along their last axis."""
        return np.fft.rfft(self.kernels, self.length), np.fft.rfft(self.responses, self.length)

    def derivatives(self, commands: Floats) -> Floats:
        """Return output derivatives with respect to parameters, divided by noise, shape (parameters, outputs, rows).

        `commands` has shape (inputs, rows).
        """
        spectrum = np.fft.rfft(commands, self.length)
        total = np.einsum("ipof,if->pof", self.spectra[0], spectrum)
        return np.asarray(np.fft.irfft(total, self.length)[..., : self.rows])

    def outputs(self, commands: Floats) -> Floats:
        """Return the outputs of the model, shape (outputs, rows), for commands of shape (inputs, rows)."""
        total = np.einsum("iof,if->of", self.spectra[1], np.fft.rfft(commands, self.length))
        return np.asarray(np.fft.irfft(total, self.length)[..., : self.rows])

    def information(self, derivatives: Floats) -> Floats:
        """Return the Fisher information matrix of the free parameters from `derivatives`, shape (p, p).

        Responses to offsets are projected out.
        """
        rows = derivatives.reshape(len(derivatives), -1)
        information = rows @ rows.T
        if len(self.nuisance):
            overlaps = rows @ self.nuisance.T
            information = information - overlaps @ overlaps.T
        return np.asarray(information)

    def rig_commands(self, commands: Floats) -> Floats:
        """Return commands for a rig, shape (inputs, rows + 1): each change is a ramp, and the last sample is zero."""
        total = np.cumsum(commands, axis=1)
        delayed = np.pad(total, ((0, 0), (self.ramp, 0)))[:, : self.rows]
        smooth = commands if self.ramp == 1 else (total - delayed) / self.ramp
        return np.pad(smooth, ((0, 0), (0, 1)))


def _offset_responses(fit: ModelFit, step: float, rows: int) -> Floats:
    """Return an orthonormal basis of the responses to unknown constants (and ramps) in the equations.

    Responses are divided by the noise standard deviation of the output. The shape is (basis vectors, outputs * rows).
    Raise ModelError if the kind of offset of the model is unknown.
    """
    structure = fit.problem.structure
    count = {"none": 0, "level": 0, "constant": 1, "ramp": 2}.get(structure.offset)
    if count is None:
        raise ModelError(f"{setting('offset')} {structure.offset!r} of the model is not resolved; identify it again")
    if not count:
        return np.zeros((0, len(fit.outputs) * rows))
    names = {*structure.signals, *structure.coefficient_names, *structure.order_names}
    prefix = next(n for n in (f"one{k}" for k in range(len(names) + 1)) if not any(t.startswith(n) for t in names))
    time = step * np.arange(rows + 2)
    shapes = {f"{prefix}_{k}": np.asarray(time**k, dtype=np.float64) for k in range(count)}
    equations = tuple(
        replace(e, terms=(*e.terms, *(Term(s, Order(), f"{s}_{e.output}") for s in shapes)))
        for e in structure.equations
    )
    problem = FreeProblem.of(replace(structure, equations=equations, offset="none"))
    values = dict(zip(fit.names, fit.values, strict=True))
    zero_run = fit.run(np.zeros((len(fit.inputs), rows + 2)), step, "still")
    run = zero_run.with_outputs(shapes)
    derivatives = _derivatives(
        problem,
        tuple(values.get(n, 0.0) for n in problem.names),
        run,
        [1.0 / fit.noise[o] for o in fit.outputs],
        fit.refinement,
    )
    rows_of_offsets = [i for i, n in enumerate(problem.names) if n not in values]
    # The first sample of a run from rest does not depend on an offset, so the responses start at the second one.
    responses = derivatives[rows_of_offsets].reshape(len(rows_of_offsets), len(fit.outputs), rows)
    responses = np.pad(responses, ((0, 0), (0, 0), (1, 0)))[..., :rows]
    return orthonormal(responses.reshape(len(rows_of_offsets), -1).T, OFFSET_RANK_TOLERANCE).T


def fast_length(minimum: int) -> int:
    """Return the smallest number 2^a, 3·2^a, 5·2^a or 15·2^a that is at least `minimum`, for which an FFT is fast."""
    return min(f << max((minimum - 1) // f, 0).bit_length() for f in (1, 3, 5, 15))
