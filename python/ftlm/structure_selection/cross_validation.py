"""A candidate tried: fitted on what it may see, judged by free runs on what it may not."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ftlm.data.run import Run, as_runs
from ftlm.data.sampling import read
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.model.model import Model
from ftlm.simulation.discretization import prepare
from ftlm.simulation.simulate import simulate
from ftlm.structure.structure import Structure
from ftlm.utils.linalg import length
from ftlm.utils.statistics import colour
from ftlm.validation.comparison import compare

#: Blocks of a run, and the rows that one has at least.
BLOCKS = 4
LEAST_BLOCK = 50
#: Relative error of free runs on a block.
TOLERANCE = 1e-4
#: A free run counts as lost below this fit, however far below: one candidate that runs away is not told from another.
LOST = -100.0


@dataclass(frozen=True)
class Fold:
    """Runs to fit, and what is judged: a run of its own, or rows of one of them, whose outputs the fit does not see."""

    runs: tuple[Run, ...]
    judged: Run
    rows: tuple[int, int] | None = None

    @property
    def name(self) -> str:
        """What is judged."""
        if self.rows is None:
            return self.judged.name
        step = self.judged.step
        return f"{self.judged.name} {self.rows[0] * step:g}-{self.rows[1] * step:g} s"

    def seen(self, outputs: Sequence[str]) -> tuple[Run, ...]:
        """Runs as the fit of some outputs sees them."""
        if self.rows is None:
            return self.runs
        return tuple(masked(r, outputs, self.rows) if r is self.judged else r for r in self.runs)

    def fit_percent(self, model: Model) -> dict[str, float]:
        """Free run of a model on what was left out, in percent by output; from what was seen, where that begins.

        Of a run in motion at its start the first rows are judged with its own initial terms, as a whole run is.
        """
        outputs = model.outputs
        if self.rows is None:
            return dict(compare(model, self.judged).fit_percent)
        # Later rows tell nothing of motion from before the start that has died away by then.
        moving = self.rows[0] == 0 and model.structure.initial != "rest"
        before = compare(model, self.judged if moving else masked(self.judged, outputs, self.rows))
        answer = simulate(model, self.judged, tolerance=TOLERANCE, initial=before.initial[0])
        out = {}
        for name in outputs:
            measured, free = (r[name][self.rows[0] : self.rows[1]] for r in (self.judged, answer))
            known = np.isfinite(measured)
            missed, size = measured[known] - free[known], measured[known] - np.mean(measured[known])
            share = length(missed) / max(length(size), 1e-300)
            out[name] = 100.0 * (1.0 - share)
        return out


def masked(run: Run, outputs: Sequence[str], rows: tuple[int, int]) -> Run:
    """A run whose outputs were not read in some rows."""
    signals = {n: np.array(run[n]) for n in run.outputs}
    for name in outputs:
        signals[name][rows[0] : rows[1]] = np.nan
    return Run.from_arrays(
        step=run.step,
        inputs={n: run[n] for n in run.inputs},
        outputs=signals,
        units=run.units,
        intersample=run.intersample,
        name=run.name,
        missing="weight",
    )


@dataclass(frozen=True)
class Folds:
    """What candidates are fitted on and what they are judged on.

    Parameters
    ----------
    runs
        What numbers are finally estimated from.
    parts
        Folds; what one judges, it does not fit to.
    words
        How, in words.
    """

    runs: tuple[Run, ...]
    parts: tuple[Fold, ...]
    words: str

    @classmethod
    def of(cls, runs: Run | Sequence[Run], validation: str | Run | Sequence[Run]) -> Folds:
        """Leave one run out, leave one block of a run out, or runs of their own.

        Raises
        ------
        ModelError
            Words that are not known, one run where several are needed, or a validation run that is fitted to.
        DataError
            Runs that do not fit together, or that are too short to be cut.
        """
        every = tuple(as_runs(runs))
        if not isinstance(validation, (str, Run)) and not validation:
            raise ModelError(
                "validation = [] has no run to validate on; give one that is not fitted to, or use 'runs' or 'blocks'"
            )
        if not isinstance(validation, str):
            others = as_runs(validation)
            as_runs([*every, *others])
            for run in others:
                if any(_same(run, fitted) for fitted in every):
                    raise ModelError(
                        f"validation run {run.name} is one of those that are fitted to, which judges nothing; leave it "
                        "out of one of the two, or use validation='runs'"
                    )
            names = ", ".join(r.name for r in others)
            return cls(every, tuple(Fold(every, run) for run in others), f"{names}, not fitted to")
        if validation == "runs":
            if len(every) < 2:
                raise ModelError(
                    "validation='runs' leaves one run out at a time, and there is one; give two or more, give "
                    "validation= a run of its own, or use validation='blocks'"
                )
            parts = [Fold(tuple(r for k, r in enumerate(every) if k != out), every[out]) for out in range(len(every))]
            return cls(every, tuple(parts), f"each of {len(every)} runs by the others")
        if validation != "blocks":
            raise ModelError(f"validation = {validation!r} is not known; use 'runs', 'blocks', or a run")
        parts = [Fold(every, run, rows) for run in every for rows in blocks(run)]
        return cls(every, tuple(parts), f"each of {len(parts)} blocks, its outputs unread, by the rest")


def _same(one: Run, other: Run) -> bool:
    """Whether two runs hold the same samples."""
    names = one.signals
    return one.length == other.length and all(np.array_equal(one[n], other[n], equal_nan=True) for n in names)


def blocks(run: Run) -> list[tuple[int, int]]:
    """Rows of as many blocks of nearly the same length."""
    if run.length < LEAST_BLOCK * BLOCKS:
        raise DataError(
            f"{run.name} has {run.length} rows, too few to be cut into {BLOCKS} blocks; give validation= another run"
        )
    return list(itertools.pairwise(np.linspace(0, run.length, BLOCKS + 1).astype(int).tolist()))


@dataclass(frozen=True)
class Trial:
    """A candidate and what became of it.

    Parameters
    ----------
    name
        The candidate in words.
    structure
        It.
    numbers
        How many numbers were estimated: orders, coefficients, numbers of inputs, and an offset of each run.
    estimation
        Fit in percent on what it was fitted to, by output.
    validation
        Fit in percent on each run or block that it was not fitted to, by output.
    scores
        ln(1 - fit / 100) of each, outputs of one after another; lower is better.
    bic
        Schwarz's criterion of the residuals' squares, samples counted as their colour lets them; None before it is
        known how coloured the best residuals are.
    values, errors
        Estimates and standard errors on all runs, by name.
    idle
        Numbers whose 95 % interval holds the value at which they do nothing: 0 for a coefficient.
    grows
        Whether it has a pole with a positive real part: within a run the inputs may hide what it does, later nothing.
    failed
        Why there are no figures; None where there are.
    joint
        The fit on all runs.
    fine
        Whether its grid was refined until it no longer mattered.
    """

    name: str
    structure: Structure
    numbers: int
    estimation: Mapping[str, float] = field(default_factory=dict)
    validation: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    scores: tuple[float, ...] = ()
    bic: float | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    idle: tuple[str, ...] = ()
    grows: bool = False
    failed: str | None = None
    joint: JointFit | None = field(default=None, repr=False)
    fine: bool = False

    @property
    def score(self) -> float:
        """Mean of the scores; infinite where there are none."""
        return float(np.mean(self.scores)) if self.scores else math.inf

    @property
    def unseen(self) -> float:
        """Mean fit in percent on what it was not fitted to."""
        fits = [v for part in self.validation.values() for v in part.values()]
        return float(np.mean(fits)) if fits else math.nan

    @property
    def parts(self) -> dict[str, float]:
        """Fit in percent on each part that was left out, in words, one after another as scores are."""
        return {f"{output} of {name}": fit for name, part in self.validation.items() for output, fit in part.items()}

    @property
    def least(self) -> float:
        """The least fit in percent on what it was not fitted to."""
        return min(self.parts.values(), default=math.nan)

    @property
    def looseness(self) -> float:
        """Mean logarithm of the relative standard errors of its numbers; lower is better told."""
        relative = [self.errors.get(n, math.inf) / max(abs(v), 1e-12) for n, v in self.values.items()]
        return float(np.mean([math.log(min(max(r, 1e-12), 1e12)) for r in relative])) if relative else 0.0

    @property
    def seen(self) -> float:
        """Mean fit in percent on what it was fitted to."""
        return float(np.mean(list(self.estimation.values()))) if self.estimation else math.nan


def decided(structure: Structure, runs: Sequence[Run]) -> Structure:
    """The structure with initial terms of one kind for whole and for fractional orders: none from rest, else Caputo's.

    A history of more terms the more orders are free would let a richer candidate fit what no model says.
    """
    if structure.initial != "auto":
        return structure
    start = prepare(runs, structure.as_given(), None, power_of_two=False, gaps=True)[0].initial
    return replace(structure, initial="rest" if start == "rest" else "caputo")


def fit(
    runs: Sequence[Run],
    structure: Structure,
    starts: Sequence[Mapping[str, float]],
    *,
    refine: bool = True,
    near: JointFit | None = None,
) -> JointFit:
    """The lowest of the fits from some starts, or from an automatic start where there are none.

    Where there is a fit of this structure to nearly these runs, it goes on from there.

    Friction that no start knows may have no descent from 0 to where it is: automatic starts stand beside the given
    ones, in which it is 0.
    """
    asked = decided(structure, runs)
    if near is not None:
        return fit_output_error(runs, asked, refine=refine, near=near)
    problem = FreeProblem.of(asked)
    if not starts or any(n not in s for s in starts for n in problem.names):
        # Where friction is 0 the speed at which it falls may be any.
        nothing = {n: 0.0 if low == 0 else 1.0 for n, (low, _) in zip(problem.names, problem.all_bounds, strict=True)}
        return fit_output_error(runs, asked, refine=refine, known=[{**nothing, **s} for s in starts])
    ends: list[JointFit] = []
    last: FtlmError | None = None
    for start in starts:
        try:
            ends.append(fit_output_error(runs, asked, start=start, refine=refine))
        except FtlmError as error:
            last = error
    if not ends:
        assert last is not None
        raise last
    return min(ends, key=power)


def power(joint: JointFit) -> float:
    """What a fit leaves over: mean over outputs of ln of the residuals' mean square, weighted by nothing."""
    return float(np.mean([2.0 * math.log(max(v, 1e-300)) for v in joint.noise.values()]))


def model_of(structure: Structure, joint: JointFit, runs: Sequence[Run]) -> Model:
    """A fit as a model."""
    problem = FreeProblem.of(replace(structure, initial=joint.initial))
    numbers = problem.named(list(joint.coefficients.values()))
    made = decided(structure, runs).with_orders(joint.orders).with_coefficients(numbers).with_inputs(joint.inputs)
    return Model(made, orders=joint.orders)


def judged(name: str, structure: Structure, folds: Folds, joint: JointFit, *, fine: bool = False) -> Trial:
    """A candidate fitted on all runs, fitted anew for each fold from there, and judged on what was left out."""
    model = model_of(structure, joint, folds.runs)
    estimation = compare(model, list(folds.runs)).fit_percent
    grows = not structure.has_friction and model.stability(coupling=structure.coupling).unstable_poles > 0
    start = dict(zip(joint.names, joint.values.tolist(), strict=True))
    # Fine, it was found on half its step as well: each fold tells from the same two grids whether they matter.
    near = replace(joint, refinement=max(1, joint.refinement // 2)) if fine and joint.settled else joint
    validation: dict[str, dict[str, float]] = {}
    for fold in folds.parts:
        runs = fold.seen(structure.outputs)
        try:
            own = joint if runs is folds.runs else fit(runs, structure, [], near=near)
            validation[fold.name] = fold.fit_percent(model_of(structure, own, folds.runs))
        except FtlmError as error:
            # What is wrong is wrong with what is left, not with the runs as they were given.
            raise type(error)(f"without {fold.name}: {error}") from error
    fits = [max(v, LOST) if math.isfinite(v) else LOST for part in validation.values() for v in part.values()]
    scores = tuple(math.log(max(1.0 - v / 100.0, 1e-12)) for v in fits)
    return Trial(
        name,
        structure,
        numbers_of(structure, joint, folds),
        dict(estimation),
        validation,
        scores,
        values=start,
        errors=joint.standard_errors,
        idle=idle(joint),
        grows=grows,
        joint=joint,
        fine=fine,
    )


def least_unseen(joint: JointFit, folds: Folds) -> float:
    """What a candidate leaves over on what it was not fitted to at least, as its score; -infinity where nothing tells.

    A fit without a fold leaves no less on all runs than the fit on all of them, and no more on the rest: so it leaves
    no less on that fold. Of several outputs that holds of the sum of their weighted squares, not of each.
    """
    if not joint.converged:
        return -math.inf
    pooled = {o: read(np.concatenate([part[o] for part in joint.residuals])) for o in joint.noise}
    # Residuals are over the noise that they were weighted with.
    scale = {o: v / max(float(np.sqrt(np.mean(pooled[o] ** 2))), 1e-300) for o, v in joint.noise.items()}
    scores = []
    for fold in folds.parts:
        place = next((k for k, run in enumerate(folds.runs) if run is fold.judged), None)
        if place is None:
            return -math.inf
        first, last = fold.rows or (0, fold.judged.length)
        if fold.rows is not None and first == 0 and joint.initial != "rest":
            # Judged with initial terms that all rows tell of, which may leave less there.
            return -math.inf
        for output, residuals in joint.residuals[place].items():
            if residuals.size != fold.judged.length - 2:
                return -math.inf
            left, there = residuals[max(first - 1, 0) : last - 1], fold.judged[output][first:last]
            size = length(there - np.nanmean(there))
            share = scale[output] * length(read(left)) / max(size, 1e-300)
            scores.append(math.log(min(max(share, 1e-12), 1.0 - LOST / 100.0)))
    return float(np.mean(scores))


def refined(trial: Trial, folds: Folds, joint: JointFit) -> Trial:
    """A candidate with a fit on all runs on grids so fine that its numbers no longer depend on them."""
    estimation = compare(model_of(trial.structure, joint, folds.runs), list(folds.runs)).fit_percent
    return replace(
        trial,
        joint=joint,
        estimation=dict(estimation),
        errors=joint.standard_errors,
        idle=idle(joint),
        fine=True,
        values=dict(zip(joint.names, joint.values.tolist(), strict=True)),
    )


def idle(joint: JointFit) -> tuple[str, ...]:
    """Coefficients that the runs do not tell from 0."""
    intervals = joint.intervals
    return tuple(n for n in joint.coefficients if intervals[n][0] <= 0.0 <= intervals[n][1])


def numbers_of(structure: Structure, joint: JointFit, folds: Folds) -> int:
    """Numbers that were estimated."""
    each = {"none": 0, "auto": 0, "constant": 1, "ramp": 2}[structure.offset]
    return len(joint.names) + each * len(structure.equations) * len(folds.runs)


def spread(joint: JointFit) -> float:
    """How much more sums of the residuals scatter than those of white noise."""
    return max([1.0, *(colour(read(e)) for part in joint.residuals for e in part.values())])


def criterion(joint: JointFit, numbers: int, scatter: float) -> float:
    """Schwarz's criterion where `scatter` samples tell as much as one; doi:10.1214/aos/1176344136."""
    samples = joint.samples / scatter
    each = samples / max(len(joint.noise), 1)
    return sum(each * 2.0 * math.log(max(v, 1e-300)) for v in joint.noise.values()) + numbers * math.log(samples)
