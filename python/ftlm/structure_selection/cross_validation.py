"""Cross-validation of a candidate structure: folds, fit, and score of the simulation on validation data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ftlm.data.run import Run, Runs, as_runs
from ftlm.data.sampling import drop_missing
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.estimators import fitted_model
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.model.model import Model
from ftlm.simulation.discretization import prepare
from ftlm.simulation.simulate import simulate
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import vector_norm
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.statistics import variance_inflation, white_noise
from ftlm.validation.comparison import compare

#: Number of blocks of a run, and minimum number of samples of a block.
BLOCKS_PER_RUN = 4
MIN_BLOCK_SAMPLES = 15
#: Relative tolerance of simulations on a block.
SIMULATION_TOLERANCE = 1e-4
#: Lower limit of the fit [%] in scores; diverging candidates are not distinguished.
MIN_FIT_PERCENT = -100.0


@dataclass(frozen=True)
class Fold:
    """Estimation runs, and validation data: another run, or rows of a run whose outputs are masked in the fit."""

    runs: Runs
    validation_run: Run
    rows: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """Name of the validation data."""
        if self.rows is None:
            return self.validation_run.name
        step = self.validation_run.step
        return f"{self.validation_run.name} {self.rows[0] * step:g}-{self.rows[1] * step:g} s"

    @property
    def has_estimation_excitation(self) -> bool:
        """Whether an input changes in the estimation rows, or no input changes at all."""
        inside = 0
        for run in self.runs:
            masked = self.rows if run is self.validation_run and self.rows is not None else (0, 0)
            for name in run.inputs:
                rows = np.flatnonzero(np.diff(run[name])) + 1
                within = int(np.count_nonzero((rows >= masked[0]) & (rows < masked[1])))
                if within < rows.size:
                    return True
                inside += within
        return inside == 0

    @property
    def has_motion(self) -> bool:
        """Whether the standard deviation of an output in the validation rows exceeds √2 times its noise.

        True for whole runs.
        """
        if self.rows is None:
            return True
        pairs = [(self.validation_run[n], slice(*self.rows)) for n in self.validation_run.outputs]
        return any(float(np.nanstd(y[rows])) > math.sqrt(2.0) * white_noise(y) for y, rows in pairs)

    def estimation_runs(self, outputs: Sequence[str]) -> Runs:
        """Runs for the fit, with the validation samples of the given outputs masked."""
        if self.rows is None:
            return self.runs
        return Runs(mask_outputs(r, outputs, self.rows) if r is self.validation_run else r for r in self.runs)

    def fit(self, model: Model) -> dict[str, float]:
        """Return the fit of a simulation on the validation data in percent, by output.

        A validation run has initial terms of its own; its residual is divided by the root of 1 - k/N for k terms and N
        samples. A block has the initial terms that the rest of its run gives, and the first block of a run with nonzero
        initial conditions those of the whole run.
        """
        outputs = model.outputs
        if self.rows is None:
            comparison = compare(model, self.validation_run)
            samples = {o: int(np.isfinite(y[0]).sum()) for o, y in comparison.measured.items()}
            freedom = {o: 1.0 - len(comparison.initial[0].get(o, ())) / max(n, 1) for o, n in samples.items()}
            return {o: 100.0 - (100.0 - f) / math.sqrt(max(freedom[o], 1e-3)) for o, f in comparison.fit.items()}
        # Without the first block, initial terms that decay early would not be identifiable.
        moving = self.rows[0] == 0 and model.structure.initial != "rest"
        rest_comparison = compare(
            model, self.validation_run if moving else mask_outputs(self.validation_run, outputs, self.rows)
        )
        answer = simulate(
            model, self.validation_run, tolerance=SIMULATION_TOLERANCE, initial=rest_comparison.initial[0]
        )
        out = {}
        for name in outputs:
            output, free = (r[name][self.rows[0] : self.rows[1]] for r in (self.validation_run, answer))
            is_finite = np.isfinite(output)
            missed, size = output[is_finite] - free[is_finite], output[is_finite] - np.mean(output[is_finite])
            share = vector_norm(missed) / max(vector_norm(size), 1e-300)
            out[name] = 100.0 * (1.0 - share)
        return out


def mask_outputs(run: Run, outputs: Sequence[str], rows: tuple[int, int]) -> Run:
    """Return a run with missing output samples in a range of rows."""
    signals = {n: np.array(run[n]) for n in run.outputs}
    for name in outputs:
        signals[name][rows[0] : rows[1]] = np.nan
    masked = Run.from_arrays(
        step=run.step,
        inputs={n: run[n] for n in run.inputs},
        outputs=signals,
        units=run.units,
        intersample=run.intersample,
        name=run.name,
        missing="weight",
    )
    return masked.with_unmasked_run(run)


#: Most pieces of the runs of an unstable plant that are folds.
MAX_SPLIT_FOLDS = 16


@dataclass(frozen=True)
class Folds:
    """Estimation and validation data of all candidates.

    Parameters
    ----------
    runs
        Runs to which candidates are fitted.
    parts
        Folds; the validation data of a fold are excluded from its fit.
    description
        Description of the validation.
    split
        Whole runs of an unstable plant, for the final estimate, and the shortest duration [s] of the pieces of them
        that are `runs`; None if `runs` are whole.
    """

    runs: Runs
    parts: tuple[Fold, ...]
    description: str
    split: tuple[Runs, float] | None = None

    @property
    def unseen_runs(self) -> list[Run]:
        """Validation runs that are not estimation runs."""
        return [f.validation_run for f in self.parts if not any(f.validation_run is r for r in self.runs)]

    @classmethod
    def of(cls, runs: Run | Sequence[Run], validation: str | Run | Sequence[Run]) -> Folds:
        """Build folds by leaving out runs, leaving out blocks, or from separate validation runs.

        Raises
        ------
        ModelError
            An unknown option, one run where several are needed, or a validation run that is an estimation run.
        DataError
            Runs that do not fit together, or that are too short to be cut.
        """
        every = as_runs(runs)
        if not isinstance(validation, (str, Run)) and not validation:
            raise ModelError(
                "validation = [] has no run; give a run that is not an estimation run, or use 'runs' or 'blocks'"
            )
        if not isinstance(validation, str):
            others = as_runs(validation)
            as_runs([*every, *others])
            for run in others:
                if any(_same(run, estimation_run) for estimation_run in every):
                    raise ModelError(
                        f"validation run {run.name} is also an estimation run, so it validates nothing; leave it "
                        f"out of one of the two, or use {parameter('validation', 'runs')}"
                    )
            names = ", ".join(r.name for r in others)
            return cls(every, tuple(Fold(every, run) for run in others), f"{names}, not fitted to")
        if validation == "runs":
            if len(every) < 2:
                raise ModelError(
                    f"{parameter('validation', 'runs')} leaves one run out at a time, but there is only one; give "
                    f"several runs, a separate run as {parameter('validation')}, or use "
                    f"{parameter('validation', 'blocks')}"
                )
            parts = [Fold(Runs(r for k, r in enumerate(every) if k != out), every[out]) for out in range(len(every))]
            return cls(every, tuple(parts), f"each of {len(every)} runs by the others")
        if validation != "blocks":
            raise ModelError(f"{setting('validation')} {validation!r} is not known; use 'runs', 'blocks', or a run")
        blocks = [Fold(every, run, rows) for run in every for rows in block_ranges(run)]
        # Without the only rows in which an input changes, a fit has nothing to identify the plant from, and noise about
        # a standstill shows no prediction.
        parts = [fold for fold in blocks if fold.has_estimation_excitation and fold.has_motion] or blocks
        return cls(every, tuple(parts), f"each of {len(parts)} blocks by a fit without its outputs")

    @classmethod
    def of_pieces(cls, runs: Runs, duration: float) -> Folds:
        """Build folds that leave out one piece of the runs of an unstable plant at a time.

        Of more than :data:`MAX_SPLIT_FOLDS` pieces as many are used, spread evenly; the final estimate uses all.
        """
        every = [piece for run in runs for piece in run.split(duration)]
        indices = np.unique(np.linspace(0, len(every) - 1, MAX_SPLIT_FOLDS).astype(int))
        folds = cls.of([every[k] for k in indices], "runs")
        words = f"each of {len(indices)} pieces of {duration:.2g} s by the others"
        return replace(folds, description=words, split=(runs, duration))


def _same(one: Run, other: Run) -> bool:
    """Whether two runs have the same samples."""
    names = one.signals
    return one.length == other.length and all(np.array_equal(one[n], other[n], equal_nan=True) for n in names)


def block_ranges(run: Run) -> list[tuple[int, int]]:
    """Return row ranges of blocks of nearly equal length."""
    if run.length < MIN_BLOCK_SAMPLES * BLOCKS_PER_RUN:
        raise DataError(
            f"{run.name} has {run.length} rows, too few to be cut into {BLOCKS_PER_RUN} blocks; give "
            f"{parameter('validation')} another run"
        )
    return list(itertools.pairwise(np.linspace(0, run.length, BLOCKS_PER_RUN + 1).astype(int).tolist()))


@dataclass(frozen=True)
class Trial:
    """A candidate structure with its fit and its validation.

    Parameters
    ----------
    name
        Description of the candidate.
    structure
        Structure of the candidate.
    parameters
        Number of estimated parameters: orders, coefficients, input parameters, and an offset of each run.
    estimation
        Fit in percent on estimation data, by output.
    validation
        Fit in percent on each validation run or block, by output.
    scores
        ln(1 - fit / 100) of each output of each run or block; lower is better.
    bic
        Schwarz's criterion of the residual sum of squares, with an effective number of samples for correlated
        residuals; None before the autocorrelation of the best residuals is known.
    values, errors
        Estimates and standard errors on all runs, by name.
    insignificant
        Coefficients whose 95 % interval contains 0.
    unstable
        Whether the model has a pole with a positive real part. Inputs may hide the instability within a run.
    failed
        Reason of a failed fit; None for a valid trial.
    joint
        Fit on all runs.
    refined
        Whether the grid was refined until converged.
    """

    name: str
    structure: Structure
    parameters: int
    estimation: Mapping[str, float] = field(default_factory=dict)
    validation: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scores: tuple[float, ...] = ()
    bic: float | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    insignificant: tuple[str, ...] = ()
    unstable: bool = False
    failed: str | None = None
    joint: JointFit | None = field(default=None, repr=False)
    refined: bool = False

    @property
    def score(self) -> float:
        """Mean of the scores; infinite without scores."""
        return float(np.mean(self.scores)) if self.scores else math.inf

    @property
    def validation_fit(self) -> float:
        """Mean fit in percent on validation data."""
        fits = [v for part in self.validation.values() for v in part.values()]
        return float(np.mean(fits)) if fits else math.nan

    @property
    def parts(self) -> dict[str, float]:
        """Fit in percent on each part of the validation data by name, in the order of the scores."""
        return {f"{output} of {name}": fit for name, part in self.validation.items() for output, fit in part.items()}

    @property
    def worst_fold(self) -> float:
        """Worst fit in percent on validation data."""
        return min(self.parts.values(), default=math.nan)

    @property
    def mean_relative_error(self) -> float:
        """Mean log relative standard error of the parameters; lower is better."""
        relative = [self.errors.get(n, math.inf) / max(abs(v), 1e-12) for n, v in self.values.items()]
        return float(np.mean([math.log(min(max(r, 1e-12), 1e12)) for r in relative])) if relative else 0.0

    @property
    def estimation_fit(self) -> float:
        """Mean fit in percent on estimation data."""
        return float(np.mean(list(self.estimation.values()))) if self.estimation else math.nan


def fix_initial_conditions(structure: Structure, runs: Sequence[Run]) -> Structure:
    """Return the structure with fixed initial conditions: rest, or Caputo's initial terms.

    A history has more terms if more orders are free, so a richer candidate could fit more than its model explains.
    """
    if structure.initial != "auto":
        return structure
    start = prepare(runs, structure.without_input_nonlinearities(), None, power_of_two=False, gaps=True)[0].initial
    return replace(structure, initial="rest" if start == "rest" else "caputo")


def fit(
    runs: Sequence[Run],
    structure: Structure,
    starts: Sequence[Mapping[str, float]],
    *,
    refine: bool = True,
    near: JointFit | None = None,
) -> JointFit:
    """Return the best of the fits from some initial guesses, or from an automatic initialization without any.

    A fit of this structure to nearly the same runs (`near`) is used as a warm start.

    Friction that the initial guesses omit is set to 0, where it may have no descent direction. Automatic initial
    guesses are therefore added.
    """
    fixed_structure = fix_initial_conditions(structure, runs)
    if near is not None:
        return fit_output_error(runs, fixed_structure, refine=refine, near=near)
    problem = FreeProblem.of(fixed_structure)
    if not starts or any(n not in s for s in starts for n in problem.names):
        # With zero friction the Stribeck speed is arbitrary.
        nothing = {n: 0.0 if low == 0 else 1.0 for n, (low, _) in zip(problem.names, problem.all_bounds, strict=True)}
        return fit_output_error(runs, fixed_structure, refine=refine, guesses=[{**nothing, **s} for s in starts])
    ends: list[JointFit] = []
    last: FtlmError | None = None
    for start in starts:
        try:
            ends.append(fit_output_error(runs, fixed_structure, start=start, refine=refine))
        except FtlmError as error:
            last = error
    if not ends:
        assert last is not None
        raise last
    return min(ends, key=log_residual_power)


def log_residual_power(joint: JointFit) -> float:
    """Return the mean over outputs of ln(mean square residual), unweighted."""
    return float(np.mean([2.0 * math.log(max(v, 1e-300)) for v in joint.noise.values()]))


def validate_fit(name: str, structure: Structure, folds: Folds, joint: JointFit, *, fine: bool = False) -> Trial:
    """Refit a candidate on each fold from its fit on all runs, and evaluate it on the validation data."""
    model = fitted_model(joint, structure)
    estimation = compare(model, folds.runs).fit
    grows = (
        folds.split is None and structure.is_linear and model.stability(coupling=structure.coupling).unstable_poles > 0
    )
    start = joint.values_by_name
    # A fine fit was also computed on half its step. Each fold starts one level coarser, so it compares the same grids.
    near = replace(joint, refinement=max(1, joint.refinement // 2)) if fine and joint.step_converged else joint
    validation: dict[str, dict[str, float]] = {}
    for fold in folds.parts:
        runs = fold.estimation_runs(structure.outputs)
        try:
            if runs is not folds.runs and fold.rows is not None and _has_measured_drivers(structure):
                validation[fold.name] = _validate_separately(structure, fold, joint, refine=fine)
                continue
            own = joint if runs is folds.runs else fit(runs, structure, [], near=near)
            validation[fold.name] = fold.fit(fitted_model(replace(own, initial=joint.initial), structure))
        except FtlmError as error:
            # The message is about the estimation data of the fold, not about the given runs.
            raise type(error)(f"without {fold.name}: {error}") from error
    fits = [
        max(v, MIN_FIT_PERCENT) if math.isfinite(v) else MIN_FIT_PERCENT
        for part in validation.values()
        for v in part.values()
    ]
    scores = tuple(math.log(max(1.0 - v / 100.0, 1e-12)) for v in fits)
    return Trial(
        name,
        structure,
        parameter_count(structure, joint, folds),
        dict(estimation),
        validation,
        scores,
        values=start,
        errors=joint.standard_errors,
        insignificant=insignificant_coefficients(joint),
        unstable=grows,
        joint=joint,
        refined=fine,
    )


def _has_measured_drivers(structure: Structure) -> bool:
    """Whether measured outputs act as inputs of the equations of other outputs."""
    others = ({*item.signals} - {item.output} for item in structure.equations)
    return structure.coupling == "measured" and any(name in structure.outputs for names in others for name in names)


def _validate_separately(structure: Structure, fold: Fold, joint: JointFit, *, refine: bool) -> dict[str, float]:
    """Refit each equation alone on a fold, and return the fits of the outputs on the validation data.

    Only the output of the equation is masked; other outputs are measured inputs. A parameter that equations share has
    an estimate in each.
    """
    fits: dict[str, float] = {}
    for output in structure.outputs:
        alone = replace(structure.equation(output), initial=joint.initial)
        own = fit(fold.estimation_runs([output]), alone, [joint.values_by_name], refine=refine)
        fits |= fold.fit(fitted_model(replace(own, initial=joint.initial), alone))
    return fits


def validation_score_bound(joint: JointFit, folds: Folds) -> float:
    """Return a lower bound of the score on validation data from the fit on all runs; -infinity if there is none.

    The fit without a fold cannot have smaller residuals than the full fit on all runs, nor larger ones on the rest. So
    its residuals on that fold are at least those of the full fit. For several outputs this holds for the weighted sum
    of squares, not for each output.
    """
    if not joint.converged:
        return -math.inf
    pooled = {o: drop_missing(np.concatenate([part[o] for part in joint.residuals])) for o in joint.noise}
    # Residuals are divided by the noise standard deviations that weighted them.
    scale = {o: v / max(float(np.sqrt(np.mean(pooled[o] ** 2))), 1e-300) for o, v in joint.noise.items()}
    scores = []
    for fold in folds.parts:
        place = next((k for k, run in enumerate(folds.runs) if run is fold.validation_run), None)
        if place is None:
            return -math.inf
        first, last = fold.rows or (0, fold.validation_run.length)
        if fold.rows is not None and first == 0 and joint.initial != "rest":
            # Its initial terms are estimated from all rows, so its residuals may be smaller.
            return -math.inf
        for output, residuals in joint.residuals[place].items():
            if residuals.size != fold.validation_run.length - 2:
                return -math.inf
            residual, output_values = residuals[max(first - 1, 0) : last - 1], fold.validation_run[output][first:last]
            size = vector_norm(output_values - np.nanmean(output_values))
            share = scale[output] * vector_norm(drop_missing(residual)) / max(size, 1e-300)
            scores.append(math.log(min(max(share, 1e-12), 1.0 - MIN_FIT_PERCENT / 100.0)))
    return float(np.mean(scores))


def update_trial(trial: Trial, folds: Folds, joint: JointFit) -> Trial:
    """Return a trial with another fit to all runs, on a grid that was refined until converged."""
    estimation = compare(fitted_model(joint, trial.structure), folds.runs).fit
    return replace(
        trial,
        joint=joint,
        estimation=dict(estimation),
        errors=joint.standard_errors,
        insignificant=insignificant_coefficients(joint),
        refined=True,
        values=joint.values_by_name,
    )


def insignificant_coefficients(joint: JointFit) -> tuple[str, ...]:
    """Return the coefficients that do not differ significantly from 0."""
    intervals = joint.intervals
    return tuple(n for n in joint.coefficients if intervals[n][0] <= 0.0 <= intervals[n][1])


def parameter_count(structure: Structure, joint: JointFit, folds: Folds) -> int:
    """Return the number of estimated parameters, offsets of the runs included."""
    each = {"none": 0, "auto": 0, "level": 1, "constant": 1, "ramp": 2}[structure.offset]
    return len(joint.names) + each * len(structure.equations) * len(folds.runs)


def residual_variance_inflation(joint: JointFit) -> float:
    """Return the largest variance inflation of the residuals over runs and outputs, at least 1.

    It is the ratio of the variance of a sum of residuals to that of white noise of the same power.
    """
    return max([1.0, *(variance_inflation(drop_missing(e)) for part in joint.residuals for e in part.values())])


def schwarz_criterion(joint: JointFit, parameters: int, inflation: float) -> float:
    """Return the Schwarz criterion (BIC) with `inflation` samples per effective sample; doi:10.1214/aos/1176344136.

    Initial terms count as parameters: a canceled pole and zero add one, which can model a level.
    """
    samples = joint.samples / inflation
    each = samples / max(len(joint.noise), 1)
    return sum(each * 2.0 * math.log(max(v, 1e-300)) for v in joint.noise.values()) + (
        parameters + joint.initial_terms
    ) * math.log(samples)
