"""Test for an unstable plant that a controller stabilizes, by simulations of short pieces of the runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ftlm.analysis.poles import modes
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.estimation.fit import Fit
from ftlm.estimation.linear import estimate_coefficients
from ftlm.estimation.model_checks import stability_findings
from ftlm.findings import Finding, make_finding
from ftlm.model.model import Model
from ftlm.order_search.options import SearchSettings
from ftlm.simulation.output_samples import measured_samples
from ftlm.structure.structure import Structure
from ftlm.validation.comparison import MAX_NORMALIZED_RESIDUAL, Comparison, simulate_runs

#: Length of a piece, and minimum length if a run is shorter, both in time constants of the most unstable mode; and
#: minimum number of samples. Over a piece, a model error grows by the factor e^5, or at least e^2.5.
PIECE_TIME_CONSTANTS, MIN_PIECE_TIME_CONSTANTS, MIN_PIECE_SAMPLES = 5.0, 2.5, 20
#: Maximum exponent a T of the growth exp(a T) of a mode over the shortest piece.
MAX_GROWTH_EXPONENT = 15.0
#: Minimum number of pieces for a decision, and maximum number that are simulated, spread evenly.
MIN_PIECES, MAX_PIECES = 5, 40
#: Maximum residual of an acceptable model, relative to the standard deviations of the outputs, in pieces. A model whose
#: residual over whole runs is larger is compared with least squares in pieces.
MAX_PIECE_RESIDUAL = 0.3
#: Codes of findings on unstable plants whose runs are divided, because simulations of whole runs diverge or
#: explain less than those of the pieces.
SPLIT_CODES = ("plant_needs_pieces", "plant_unstable_in_pieces")


@dataclass(frozen=True)
class PieceTest:
    """Simulation of a model on short pieces of runs, each piece with its own initial values.

    Parameters
    ----------
    seconds
        Length of a piece [s].
    residual
        RMS residual divided by the RMS of the output about its mean in each piece; largest over all outputs.
    """

    seconds: float
    residual: float

    @property
    def passed(self) -> bool:
        """Whether the residual is so small that the model explains the pieces."""
        return self.residual <= MAX_PIECE_RESIDUAL

    @property
    def fit(self) -> float:
        """Fit of the simulation to the pieces in percent."""
        return 100.0 * (1.0 - self.residual)


def piece_test(model: Model, runs: Sequence[Run]) -> PieceTest | None:
    """Simulate an unstable model on short pieces of the runs and return the result; None if not possible.

    Runs of an unstable plant are bounded only because a controller feeds back the output. A correct unstable model
    reproduces the output within a piece. If the plant is stable, an unstable model cannot reproduce the output over
    five time constants, whatever its initial values are. The result is None if the model is stable, its modes are
    unknown, or a simulation fails. It is also None if the runs are sampled nonuniformly, too short for several pieces,
    or sampled too coarsely for the growth rate of the model.
    """
    try:
        growth_rates = [m.pole.real for m in modes(model, coupling=model.structure.coupling) if m.unstable]
    except FtlmError:
        return None
    step = max(run.step for run in runs)
    if not growth_rates or max(growth_rates) * MIN_PIECE_SAMPLES * step > MAX_GROWTH_EXPONENT:
        return None
    shortest = min(run.length * run.step for run in runs)
    seconds = max(PIECE_TIME_CONSTANTS / max(growth_rates), MIN_PIECE_SAMPLES * step)
    if shortest < seconds and shortest * max(growth_rates) >= MIN_PIECE_TIME_CONSTANTS:
        seconds = shortest
    pieces = [
        run.window(k * seconds, min((k + 1) * seconds, run.length * run.step))
        for run in runs
        for k in range(int(run.length * run.step / seconds + 1e-9))
    ]
    if len(pieces) < MIN_PIECES or any(run.nonuniform_samples is not None for run in runs):
        return None
    sample_pieces = [pieces[k] for k in np.unique(np.linspace(0, len(pieces) - 1, MAX_PIECES).astype(int))]
    model_in_motion = replace(model, structure=replace(model.structure, initial="caputo"))
    try:
        free = simulate_runs(model_in_motion, sample_pieces)
    except FtlmError:
        return None
    ratios = []
    for k in range(len(model.outputs)):
        outputs = [
            measured_samples(model_in_motion, run, f.refinement)[k] for run, f in zip(sample_pieces, free, strict=True)
        ]
        residuals = [y - simulated.outputs[k] for y, simulated in zip(outputs, free, strict=True)]
        power = sum(float(np.nansum((y - np.nanmean(y)) ** 2)) for y in outputs)
        with np.errstate(over="ignore", invalid="ignore"):
            residual_power = sum(float(np.nansum(e**2)) for e in residuals)
        ratios.append(math.sqrt(residual_power / power) if power > 0 and math.isfinite(residual_power) else math.inf)
    return PieceTest(seconds, max(ratios))


def unstable_plant_findings(fit: Fit, model: Model, runs: Sequence[Run], comparison: Comparison) -> list[Finding]:
    """Return a finding if short pieces of the runs are evidence of an unstable plant.

    The pieces are simulated with the model, and with a least-squares fit at its orders.
    """
    if not model.structure.is_linear:
        return []
    residual = float(np.max([f.nr for f in comparison.output_error.values()]))
    is_explained = residual <= MAX_NORMALIZED_RESIDUAL
    is_unstable = any(f.code == "simulation_unbounded" for f in stability_findings(model))
    if is_unstable:
        test = piece_test(model, runs)
        if test is not None and test.passed:
            code = "plant_unstable" if is_explained and fit.joint is not None else "plant_unstable_in_pieces"
            return [make_finding(code, fit=test.fit, seconds=test.seconds)]
    if fit.joint is None or (not is_unstable and residual <= MAX_PIECE_RESIDUAL):
        return []
    test = least_squares_piece_test(runs, fit.task.structure.with_orders(model.orders), model.units)
    if test is None or (is_explained and test.residual >= residual):
        return []
    return [make_finding("plant_needs_pieces", fit=test.fit, seconds=test.seconds)]


def least_squares_piece_test(runs: Sequence[Run], structure: Structure, units: Mapping[str, str]) -> PieceTest | None:
    """Fit a structure by least squares; return its piece test if the model is unstable and passes, else None."""
    try:
        linear = estimate_coefficients(runs, structure, SearchSettings(coefficients="least-squares"), None)
        model = Model(structure.with_coefficients(linear.values), units=units, m=linear.m)
        test = piece_test(model, runs) if stability_findings(model) else None
    except FtlmError:
        return None
    return test if test is not None and test.passed else None
