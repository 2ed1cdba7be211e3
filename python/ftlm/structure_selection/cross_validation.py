"""Cross-validation of a structure: folds of the data, fits on them, and scores of simulations on validation data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ftlm.data.run import Run
from ftlm.data.runs import Runs, as_runs
from ftlm.data.sampling import drop_missing
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.estimators import fitted_model
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.model.model import Model
from ftlm.simulation.discretization import prepare
from ftlm.simulation.initial_conditions import resolve_start
from ftlm.simulation.simulate import simulate
from ftlm.structure.structure import Structure
from ftlm.utils.formatting import plural
from ftlm.utils.linalg import vector_norm
from ftlm.utils.parameters import parameter, setting
from ftlm.utils.statistics import variance_inflation, white_noise
from ftlm.validation.comparison import compare
from ftlm.validation.information_criteria import normal_log_likelihood, schwarz_criterion

#: Number of blocks of a run, and minimum number of samples of a block.
BLOCKS_PER_RUN = 4
MIN_BLOCK_SAMPLES = 15
#: Relative tolerance of simulations on a block.
SIMULATION_TOLERANCE = 1e-4
#: Lower limit of the fit [%] in scores. All candidates that diverge have the same score.
MIN_FIT_PERCENT = -100.0


@dataclass(frozen=True)
class Fold:
    """Estimation runs and validation data of one fold.

    The validation data are another run, or the samples `rows` (start, stop) of an estimation run. In the latter case,
    the outputs in these samples are masked in the fit.
    """

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
        """Whether an input changes in the estimation samples; True if no input ever changes."""
        masked_changes = 0
        for run in self.runs:
            masked = self.rows if run is self.validation_run and self.rows is not None else (0, 0)
            for name in run.inputs:
                rows = np.flatnonzero(np.diff(run[name])) + 1
                changes = int(np.count_nonzero((rows >= masked[0]) & (rows < masked[1])))
                if changes < rows.size:
                    return True
                masked_changes += changes
        return masked_changes == 0

    @property
    def has_motion(self) -> bool:
        """Whether an output in the validation samples varies by more than √2 times its noise standard deviation.

        True if the validation data are a whole run.
        """
        if self.rows is None:
            return True
        pairs = [(self.validation_run[n], slice(*self.rows)) for n in self.validation_run.outputs]
        return any(float(np.nanstd(y[rows])) > math.sqrt(2.0) * white_noise(y) for y, rows in pairs)

    def estimation_runs(self, outputs: Sequence[str]) -> Runs:
        """Return the runs for the fit, in which validation samples of the given outputs are masked."""
        if self.rows is None:
            return self.runs
        return Runs(mask_outputs(r, outputs, self.rows) if r is self.validation_run else r for r in self.runs)

    def norm(self, output: str) -> float:
        """Return √n σ of an output, for n validation samples and the standard deviation σ of the whole run.

        With the standard deviation of the block itself, no model would fit a block in which the output rests.
        """
        values = self.validation_run[output]
        start, stop = self.rows or (0, values.size)
        count = np.count_nonzero(np.isfinite(values[start:stop]))
        return max(math.sqrt(count) * float(np.nanstd(values)), 1e-300)

    def fit(self, model: Model) -> dict[str, float]:
        """Return the fit of a simulation to the validation data in percent, by output; see :meth:`norm`.

        Initial terms are fitted to a validation run; its residual is divided by the square root of 1 - k/N for k terms
        and N samples. For a block of a run, the initial terms are fitted to the rest of the run. For the first block of
        a run with nonzero initial conditions they are fitted to the whole run.
        """
        outputs = model.outputs
        if self.rows is None:
            comparison = compare(model, self.validation_run)
            samples = {o: int(np.isfinite(y[0]).sum()) for o, y in comparison.measured.items()}
            freedom = {o: 1.0 - len(comparison.initial[0].get(o, ())) / max(n, 1) for o, n in samples.items()}
            return {o: 100.0 - (100.0 - f) / math.sqrt(max(freedom[o], 1e-3)) for o, f in comparison.fit.items()}
        # Without the first block, initial terms that decay early would not be identifiable.
        is_in_motion = self.rows[0] == 0 and model.structure.initial != "rest"
        rest_comparison = compare(
            model, self.validation_run if is_in_motion else mask_outputs(self.validation_run, outputs, self.rows)
        )
        simulated = simulate(
            model, self.validation_run, tolerance=SIMULATION_TOLERANCE, initial=rest_comparison.initial[0]
        )
        out = {}
        for name in outputs:
            output, free = (r[name][self.rows[0] : self.rows[1]] for r in (self.validation_run, simulated))
            out[name] = 100.0 * (1.0 - vector_norm(drop_missing(output - free)) / self.norm(name))
        return out


def mask_outputs(run: Run, outputs: Sequence[str], rows: tuple[int, int]) -> Run:
    """Return a run in which the samples `rows` (start, stop) of some outputs are marked as missing."""
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


#: Maximum number of folds of an unstable plant, whose runs are divided into pieces.
MAX_SPLIT_FOLDS = 16


@dataclass(frozen=True)
class Folds:
    """All folds of a validation, which are the same for every candidate.

    Parameters
    ----------
    runs
        Runs to which candidates are fitted.
    parts
        Folds of the validation.
    description
        Description of the validation as text.
    split
        For an unstable plant, whose `runs` are pieces: the whole runs, for the final estimate, and the shortest
        duration [s] of a piece. None if `runs` are whole.
    """

    runs: Runs
    parts: tuple[Fold, ...]
    description: str
    split: tuple[Runs, float] | None = None

    @property
    def unseen_runs(self) -> list[Run]:
        """Validation runs that no fold uses for estimation."""
        return [f.validation_run for f in self.parts if not any(f.validation_run is r for r in self.runs)]

    @classmethod
    def of(cls, runs: Run | Sequence[Run], validation: str | Run | Sequence[Run]) -> Folds:
        """Return the folds of a cross-validation over runs or blocks, or of a validation on separate runs.

        Raises
        ------
        ModelError
            If `validation` is unknown, there is one run where several are required, or a validation run is an
            estimation run.
        DataError
            If runs differ in names or units, or are too short to be divided.
        """
        all_runs = as_runs(runs)
        if not isinstance(validation, (str, Run)) and not validation:
            raise ModelError(
                "validation = [] has no run; give a run that is not an estimation run, or use 'runs' or 'blocks'"
            )
        if not isinstance(validation, str):
            validation_runs = as_runs(validation)
            as_runs([*all_runs, *validation_runs])
            for run in validation_runs:
                if any(_have_equal_samples(run, estimation_run) for estimation_run in all_runs):
                    raise ModelError(
                        f"validation run {run.name} is also an estimation run, so it does not validate the model; "
                        f"leave it out of one of the two, or use {parameter('validation', 'runs')}"
                    )
            names = ", ".join(r.name for r in validation_runs)
            return cls(all_runs, tuple(Fold(all_runs, run) for run in validation_runs), f"{names}, not fitted to")
        if validation == "runs":
            if len(all_runs) < 2:
                raise ModelError(
                    f"{parameter('validation', 'runs')} leaves one run out at a time, but there is only one; give "
                    f"several runs, a separate run as {parameter('validation')}, or use "
                    f"{parameter('validation', 'blocks')}"
                )
            parts = [
                Fold(Runs(r for k, r in enumerate(all_runs) if k != out), all_runs[out]) for out in range(len(all_runs))
            ]
            return cls(all_runs, tuple(parts), f"each of {len(all_runs)} runs by the others")
        if validation != "blocks":
            raise ModelError(f"{setting('validation')} {validation!r} is not known; use 'runs', 'blocks', or a run")
        blocks = [Fold(all_runs, run, rows) for run in all_runs for rows in block_ranges(run)]
        # Without the only samples in which an input changes, the plant is not identifiable. A block at standstill
        # contains only noise, which does not validate a prediction.
        parts = [fold for fold in blocks if fold.has_estimation_excitation and fold.has_motion] or blocks
        return cls(all_runs, tuple(parts), f"each of {len(parts)} blocks by a fit without its outputs")

    @classmethod
    def of_pieces(cls, runs: Runs, duration: float) -> Folds:
        """Return folds that leave out one piece of the runs of an unstable plant at a time.

        `duration` is the shortest duration of a piece [s]. At most :data:`MAX_SPLIT_FOLDS` pieces, evenly distributed,
        are used. The final estimate uses all pieces.
        """
        pieces = [piece for run in runs for piece in run.split(duration)]
        indices = np.unique(np.linspace(0, len(pieces) - 1, MAX_SPLIT_FOLDS).astype(int))
        folds = cls.of([pieces[k] for k in indices], "runs")
        description = f"each of {len(indices)} pieces of {duration:.2g} s by the others"
        return replace(folds, description=description, split=(runs, duration))


def _have_equal_samples(first: Run, second: Run) -> bool:
    """Whether two runs have equal samples."""
    names = first.signals
    return first.length == second.length and all(np.array_equal(first[n], second[n], equal_nan=True) for n in names)


def block_ranges(run: Run) -> list[tuple[int, int]]:
    """Return (start, stop) of consecutive blocks of nearly equal length; raise DataError if the run is too short."""
    if run.length < MIN_BLOCK_SAMPLES * BLOCKS_PER_RUN:
        raise DataError(
            f"{run.name} has {plural(run.length, 'row')}, too few to be cut into {BLOCKS_PER_RUN} blocks; give "
            f"{parameter('validation')} another run"
        )
    return list(itertools.pairwise(np.linspace(0, run.length, BLOCKS_PER_RUN + 1).astype(int).tolist()))


@dataclass(frozen=True)
class Trial:
    """Candidate structure with its fit and its validation.

    Parameters
    ----------
    name
        Description of the candidate.
    structure
        Structure of the candidate.
    parameter_count
        Number of estimated parameters: orders, coefficients, input parameters, and an offset of each run.
    estimation
        Fit in percent on estimation data, by output.
    validation
        Fit in percent on each validation run or block, by output.
    scores
        ln(1 - fit / 100) of each output of each run or block; lower is better.
    bic
        Schwarz's criterion, as in :class:`ftlm.InformationCriteria`; None without a fit.
    effective_bic
        Schwarz's criterion with the effective number of samples of correlated residuals; candidates are compared by it.
        None until the autocorrelation of the best candidate's residuals is known.
    values, standard_errors
        Estimates and standard errors from all runs, by name.
    insignificant
        Names of coefficients whose 95 % interval contains 0.
    unstable
        Whether the model has a pole with a positive real part. The simulation may still be bounded within a run.
    failure
        Reason why the fit failed; None for a valid trial.
    joint
        Fit on all runs.
    refined
        Whether the time step of the fit was refined until converged.
    """

    name: str
    structure: Structure
    parameter_count: int
    estimation: Mapping[str, float] = field(default_factory=dict)
    validation: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scores: tuple[float, ...] = ()
    bic: float | None = None
    effective_bic: float | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    standard_errors: Mapping[str, float] = field(default_factory=dict)
    insignificant: tuple[str, ...] = ()
    unstable: bool = False
    failure: str | None = None
    joint: JointFit | None = field(default=None, repr=False)
    refined: bool = False

    @property
    def score(self) -> float:
        """Mean of the scores; infinite without scores. Lower is better."""
        return float(np.mean(self.scores)) if self.scores else math.inf

    @property
    def validation_fit(self) -> float:
        """Mean fit in percent on validation data."""
        fits = [v for part in self.validation.values() for v in part.values()]
        return float(np.mean(fits)) if fits else math.nan

    @property
    def fits_by_part(self) -> dict[str, float]:
        """Fit [%] on each part of the validation data (output of a run or block), in the sequence of `scores`."""
        return {f"{output} of {name}": fit for name, part in self.validation.items() for output, fit in part.items()}

    @property
    def worst_fold(self) -> float:
        """Lowest fit in percent over all parts of the validation data; NaN without validation."""
        return min(self.fits_by_part.values(), default=math.nan)

    @property
    def mean_log_relative_error(self) -> float:
        """Logarithm of the geometric mean of the parameters' relative standard errors; lower is better."""
        relative = [self.standard_errors.get(n, math.inf) / max(abs(v), 1e-12) for n, v in self.values.items()]
        return float(np.mean([math.log(min(max(r, 1e-12), 1e12)) for r in relative])) if relative else 0.0

    @property
    def estimation_fit(self) -> float:
        """Mean fit in percent on estimation data."""
        return float(np.mean(list(self.estimation.values()))) if self.estimation else math.nan


def fix_initial_conditions(structure: Structure, runs: Sequence[Run]) -> Structure:
    """Return the structure with fixed initial conditions: rest, or Caputo's initial terms.

    They replace ``"auto"``, whose history (powers of t for past inputs) has more terms if more orders are free. A
    candidate with more free orders could then fit more than its model explains. The offset may become a level; see
    :func:`resolve_start`.
    """
    if structure.initial == "auto":
        start = prepare(runs, structure.without_free_input_parameters(), None, power_of_two=False, gaps=True)[0].initial
        structure = replace(structure, initial="rest" if start == "rest" else "caputo")
    return resolve_start(runs, structure)


def fit(
    runs: Sequence[Run],
    structure: Structure,
    starts: Sequence[Mapping[str, float]],
    *,
    refine: bool = True,
    initial_fit: JointFit | None = None,
) -> JointFit:
    """Return the best output-error fit from the initial guesses `starts`, or from automatic ones if there are none.

    If `initial_fit` is given, which is a fit of this structure to nearly the same runs, the fit starts from it alone.
    Raise the last error if every fit fails.

    If an initial guess omits a parameter, this parameter starts at 0 or 1. The gradient may vanish at such values, for
    example at a friction coefficient of 0. Automatic initial guesses are therefore added.
    """
    fixed_structure = fix_initial_conditions(structure, runs)
    if initial_fit is not None:
        return fit_output_error(runs, fixed_structure, refine=refine, initial_fit=initial_fit)
    problem = FreeProblem.of(fixed_structure)
    if not starts or any(n not in s for s in starts for n in problem.names):
        # With zero friction the Stribeck speed is arbitrary.
        null_values = {
            n: 0.0 if low == 0 else 1.0 for n, (low, _) in zip(problem.names, problem.all_bounds, strict=True)
        }
        return fit_output_error(runs, fixed_structure, refine=refine, guesses=[{**null_values, **s} for s in starts])
    fits: list[JointFit] = []
    last_error: FtlmError | None = None
    for start in starts:
        try:
            fits.append(fit_output_error(runs, fixed_structure, start=start, refine=refine))
        except FtlmError as error:
            last_error = error
    if not fits:
        assert last_error is not None
        raise last_error
    return min(fits, key=log_residual_power)


def log_residual_power(joint: JointFit) -> float:
    """Return the mean over outputs of ln(mean square residual), with residuals in the unit of the output."""
    return float(np.mean([2.0 * math.log(max(v, 1e-300)) for v in joint.noise.values()]))


def validate_fit(name: str, structure: Structure, folds: Folds, joint: JointFit, *, is_final: bool = False) -> Trial:
    """Return the trial of a candidate, which is fitted to each fold from the optimum `joint` of the fit to all runs.

    With `is_final`, the time step of these fits is refined until converged. Raise FtlmError, with the name of the fold,
    if a fit or a simulation fails.
    """
    model = fitted_model(joint, structure)
    estimation = compare(model, folds.runs).fit
    is_unstable = (
        folds.split is None and structure.is_linear and model.stability(coupling=structure.coupling).unstable_poles > 0
    )
    start = joint.values_by_name
    # A fine fit compares its last two grids. Each fold starts on the coarser one, so that it compares the same grids.
    initial_fit = (
        replace(joint, refinement=max(1, joint.refinement // 2)) if is_final and joint.step_converged else joint
    )
    validation: dict[str, dict[str, float]] = {}
    for fold in folds.parts:
        runs = fold.estimation_runs(structure.outputs)
        try:
            if runs is not folds.runs and fold.rows is not None and _has_measured_drivers(structure):
                validation[fold.name] = _validate_separately(structure, fold, joint, refine=is_final)
                continue
            fold_fit = (
                joint if runs is folds.runs else fit(runs, structure, [], refine=is_final, initial_fit=initial_fit)
            )
            validation[fold.name] = fold.fit(fitted_model(replace(fold_fit, initial=joint.initial), structure))
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
        standard_errors=joint.standard_errors,
        insignificant=insignificant_coefficients(joint),
        unstable=is_unstable,
        joint=joint,
        refined=is_final,
    )


def _has_measured_drivers(structure: Structure) -> bool:
    """Whether measured outputs enter the equations of other outputs as inputs."""
    other_signals = ({*equation.signals} - {equation.output} for equation in structure.equations)
    return structure.coupling == "measured" and any(
        name in structure.outputs for names in other_signals for name in names
    )


def _validate_separately(structure: Structure, fold: Fold, joint: JointFit, *, refine: bool) -> dict[str, float]:
    """Return the fits in percent on the validation data by output, with each equation fitted alone.

    Only the output of the equation is masked; other outputs are measured inputs. A parameter that several equations
    share is estimated separately in each.
    """
    fits: dict[str, float] = {}
    for output in structure.outputs:
        single = replace(structure.equation(output), initial=joint.initial)
        fold_fit = fit(fold.estimation_runs([output]), single, [joint.values_by_name], refine=refine)
        fits |= fold.fit(fitted_model(replace(fold_fit, initial=joint.initial), single))
    return fits


def validation_score_bound(joint: JointFit, folds: Folds) -> float:
    """Return a lower bound of the validation score from the fit to all data alone; -inf if no bound can be given.

    The fit to all data minimizes the sum of squares over all data. A fit without the data of one fold minimizes the sum
    of squares over the remaining data. On the data of the fold, the sum of squares of the latter fit is therefore at
    least that of the former. For several outputs, this holds only for the weighted sum of squares.
    """
    if not joint.converged:
        return -math.inf
    pooled = {
        o: drop_missing(np.concatenate([run_residuals[o] for run_residuals in joint.residuals])) for o in joint.noise
    }
    # Stored residuals are divided by the standard deviations that weighted them. This scale restores the noise level.
    scale = {o: v / max(float(np.sqrt(np.mean(pooled[o] ** 2))), 1e-300) for o, v in joint.noise.items()}
    scores = []
    for fold in folds.parts:
        run_index = next((k for k, run in enumerate(folds.runs) if run is fold.validation_run), None)
        if run_index is None:
            return -math.inf
        start, stop = fold.rows or (0, fold.validation_run.length)
        if fold.rows is not None and start == 0 and joint.initial != "rest":
            # The initial terms of this block are estimated from all samples, so its residuals may be smaller.
            return -math.inf
        for output, residuals in joint.residuals[run_index].items():
            if residuals.size != fold.validation_run.length - 2:
                return -math.inf
            residual = residuals[max(start - 1, 0) : stop - 1]
            relative_error = scale[output] * vector_norm(drop_missing(residual)) / fold.norm(output)
            scores.append(math.log(min(max(relative_error, 1e-12), 1.0 - MIN_FIT_PERCENT / 100.0)))
    return float(np.mean(scores))


def update_trial(trial: Trial, folds: Folds, joint: JointFit) -> Trial:
    """Return a trial whose fit to all runs is replaced by a more accurate one, with a refined time step."""
    estimation = compare(fitted_model(joint, trial.structure), folds.runs).fit
    return replace(
        trial,
        joint=joint,
        estimation=dict(estimation),
        standard_errors=joint.standard_errors,
        insignificant=insignificant_coefficients(joint),
        refined=True,
        values=joint.values_by_name,
    )


def insignificant_coefficients(joint: JointFit) -> tuple[str, ...]:
    """Return the names of coefficients whose 95 % interval contains 0."""
    intervals = joint.intervals
    return tuple(n for n in joint.coefficients if intervals[n][0] <= 0.0 <= intervals[n][1])


def parameter_count(structure: Structure, joint: JointFit, folds: Folds) -> int:
    """Return the number of estimated parameters, including the offsets of the runs."""
    offset_count = {"none": 0, "auto": 0, "level": 1, "constant": 1, "ramp": 2}[structure.offset]
    return len(joint.names) + offset_count * len(structure.equations) * len(folds.runs)


def residual_variance_inflation(joint: JointFit) -> float:
    """Return the largest variance inflation of the residuals over runs and outputs, at least 1.

    The variance inflation is the variance of the sum of the residuals, divided by its value for white noise of the same
    power.
    """
    return max(
        [
            1.0,
            *(variance_inflation(drop_missing(e)) for run_residuals in joint.residuals for e in run_residuals.values()),
        ]
    )


def fit_criterion(joint: JointFit, inflation: float = 1.0) -> float:
    """Return the Schwarz criterion (BIC) of a fit, as :func:`ftlm.information_criteria` does from its residuals.

    The number of samples is divided by `inflation`, the variance inflation of correlated residuals. Initial terms and
    offsets count as parameters, because the initial term of a canceled pole and zero can model a level.
    """
    counts = {o: sum(drop_missing(run_residuals[o]).size for run_residuals in joint.residuals) for o in joint.noise}
    # The floor keeps differences between candidates finite.
    noise = [(counts[o] / inflation, max(v, 1e-300)) for o, v in joint.noise.items()]
    parameters = len(joint.names) + joint.initial_terms + len(joint.noise)
    return schwarz_criterion(normal_log_likelihood(noise), parameters, sum(counts.values()) / inflation)
