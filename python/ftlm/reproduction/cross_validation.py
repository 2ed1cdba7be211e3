"""Cross-validation of fractional against integer orders on the links of a measured arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ftlm.arm.flexible_link import flexible_link
from ftlm.data.run import Run
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import MIN_FIT_GAIN, have_common_value, improves_prediction, is_degenerate
from ftlm.progress import Progress
from ftlm.reproduction.simulated_arm import STAGE_NUMBERS, StageNumber, decimate_run
from ftlm.structure.structure import Structure
from ftlm.utils.formatting import symbol
from ftlm.utils.parameters import Placeholder, parameter
from ftlm.utils.resources import duration_bounds, estimate_duration, output_error_cost
from ftlm.utils.validation import check_threads, join_names
from ftlm.validation.comparison import Comparison, finite

#: Free orders of each structure; the other orders are integer.
INTEGER_KIND = "whole orders"
FREE_ORDERS_BY_KIND: dict[str, tuple[str, ...]] = {
    INTEGER_KIND: (),
    "fractional elasticity": ("beta",),
    "fractional damping": ("mu",),
    "both fractional": ("beta", "mu"),
}
WHOLE_ORDERS = {"beta": 0.0, "mu": 1.0}
#: Most samples of a run in a fit; the arm's modes are a decade below the reduced rate of a 20 s run.
MOST_ROWS = 1250
#: Label of the structures of ``Deflection.before``.
WITHOUT_RATE_LABEL = "without the rate of the other deflection"


@dataclass(frozen=True)
class RunFit:
    """Structure fitted to one run, with its simulations on all runs.

    Parameters
    ----------
    result
        The identification.
    comparisons
        Comparisons by the name of the run, the estimation run included.
    """

    result: Identification
    comparisons: dict[str, Comparison]

    def fit(self, run: str) -> float:
        """Fit of the simulation in percent; minus infinity on overflow."""
        value = next(iter(self.comparisons[run].fit.values()))
        return value if math.isfinite(value) else -math.inf

    @property
    def estimates(self) -> dict[str, tuple[float, float, float]]:
        """Free parameters with their 95 % intervals; orders first.

        Two terms of the deflection differ only in their orders. The lower order belongs to the elasticity, regardless
        of its name in the fit.
        """
        joint = self.result.joint
        values = {**self.result.orders, **({} if joint is None else joint.coefficients)}
        letters = {n.rstrip("0123456789"): n for n in values}
        names = {n: n for n in values}
        if {"beta", "mu"} <= letters.keys() and values[letters["beta"]] > values[letters["mu"]]:
            for one, other in (("beta", "mu"), ("a", "d")):
                names |= {letters[one]: letters[other], letters[other]: letters[one]}
        return {n: (values[names[n]], *self.result.intervals[names[n]]) for n in values}

    @property
    def numbers(self) -> int:
        """Number of free orders and coefficients."""
        return len(self.estimates)


@dataclass(frozen=True)
class Verdict:
    """Decision whether a kind of fractional order improves the prediction significantly.

    Parameters
    ----------
    kind
        A key of ``FREE_ORDERS_BY_KIND``.
    earns
        The decision; None if it is inconclusive.
    words
        Numbers that it follows from, as text.
    """

    kind: str
    earns: bool | None
    words: str


@dataclass(frozen=True)
class Deflection:
    """Cross-validation of one deflection of the arm.

    Parameters
    ----------
    output
        Name of the deflection.
    structure
        Structure with both orders free.
    fits
        Fits by kind, then by estimation run.
    failed
        Reasons for missing fits, by kind and run.
    before
        Cross-validation without the rate of the other deflection; None if the other stage was not measured.
    """

    output: str
    structure: Structure
    fits: dict[str, dict[str, RunFit]]
    failed: dict[tuple[str, str], str] = field(default_factory=dict)
    before: Deflection | None = None

    def gains(self, kind: str) -> dict[tuple[str, str], float]:
        """Gain in fit over integer orders by (estimation run, validation run) [percentage points]."""
        found = {}
        for run, whole in self.fits[INTEGER_KIND].items():
            other = self.fits[kind].get(run)
            for judged in whole.comparisons:
                if judged != run:
                    alone, free = whole.fit(judged), -math.inf if other is None else other.fit(judged)
                    found[run, judged] = 0.0 if alone == free else free - alone
        return found

    def worse(self, kind: str) -> list[str]:
        """Runs on which a fit is worse than that of integer orders, which its structure contains."""
        both = ((run, each, self.fits[INTEGER_KIND][run]) for run, each in self.fits[kind].items())
        return [run for run, free, whole in both if not free.fit(run) > whole.fit(run) - MIN_FIT_GAIN]

    def intervals(self, kind: str) -> dict[str, dict[str, tuple[float, float]]]:
        """Return 95 % intervals of the free orders, by order, then by estimation run."""
        return {
            name: {run: each.estimates[name][1:] for run, each in self.fits[kind].items()}
            for name in self.structure.order_names
            if name.rstrip("0123456789") in FREE_ORDERS_BY_KIND[kind]
        }

    @property
    def verdicts(self) -> list[Verdict]:
        """Verdicts of all kinds with a fractional order."""
        return [self.verdict(kind) for kind in FREE_ORDERS_BY_KIND if kind != INTEGER_KIND]

    def verdict(self, kind: str) -> Verdict:
        """Verdict of one kind, from its gains and intervals."""
        told = self.intervals(kind)
        whole = {name: WHOLE_ORDERS[name.rstrip("0123456789")] for name in told}
        worse = self.worse(kind)
        degenerate = [r for r, f in self.fits[kind].items() if is_degenerate(f.result)]
        degenerate += [r for r, f in self.fits[INTEGER_KIND].items() if is_degenerate(f.result) and r not in degenerate]
        complete = not worse and not degenerate and not any(k in (kind, INTEGER_KIND) for k, _ in self.failed)
        earns = improves_prediction(list(self.gains(kind).values()), told, whole) if complete else None
        before, after = (
            {
                pair: "no fit" if pair[0] not in self.fits[k] else percent(self.fits[k][pair[0]].fit(pair[1]))
                for pair in self.gains(kind)
            }
            for k in (INTEGER_KIND, kind)
        )
        fits = "; ".join(f"{run} → {other} {before[run, other]}, then {after[run, other]}" for run, other in before)
        orders = "; ".join(
            f"{symbol(name)} " + ", ".join(f"{_range(low, high)} on {run}" for run, (low, high) in each.items())
            for name, each in told.items()
        )
        words = f"Fit of unseen runs, percent: {fits}. 95 % intervals: {orders}."
        if not all(have_common_value(each.values()) for each in told.values()):
            words += " The runs contradict each other."
        if worse:
            words += f" On {', '.join(worse)} it fits worse than the whole orders that it contains: no optimum found."
        if degenerate:
            words += f" On {', '.join(degenerate)} one of the two fits must not be used, so nothing follows from it."
        return Verdict(kind, earns, words)


def _range(low: float, high: float) -> str:
    """Format an interval; unbounded ends are left out."""
    ends = [f"{v:.2f}".replace("-", "−") if math.isfinite(v) else "" for v in (low, high)]
    if all(ends):
        return " to ".join(ends)
    return f"up to {ends[1]}" if ends[1] else f"from {ends[0]} up" if ends[0] else "anything"


def percent(value: float) -> str:
    """Format a fit in percent."""
    return f"{value:.1f}".replace("-", "−") if math.isfinite(value) else "−∞"


@dataclass(frozen=True)
class UnseenOrders:
    """Cross-validation of integer against fractional orders over several runs.

    Parameters
    ----------
    runs
        Runs as used for estimation and validation.
    deflections
        Results by output.
    filtered
        Whether the deflections passed the stock filter.
    notes
        Preprocessing of the runs.
    """

    runs: tuple[Run, ...]
    deflections: dict[str, Deflection]
    filtered: bool
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return fits and verdicts for JSON."""
        return {
            "runs": [run.name for run in self.runs],
            "filtered": self.filtered,
            "margin": MIN_FIT_GAIN,
            "deflections": {
                output: _deflection_dict(d) | ({} if d.before is None else {"without_rate": _deflection_dict(d.before)})
                for output, d in self.deflections.items()
            },
            "notes": list(self.notes),
        }


def _deflection_dict(deflection: Deflection) -> dict[str, Any]:
    """Return fits and verdicts of one structure for JSON."""
    return {
        "equation": str(deflection.structure),
        "verdicts": {v.kind: {"earns": v.earns, "words": v.words} for v in deflection.verdicts},
        "fits": {
            kind: {
                run: {
                    "numbers": f.numbers,
                    "fit": {other: finite(f.fit(other)) for other in f.comparisons},
                    "estimates": {n: float(v) for n, (v, *_) in f.estimates.items()},
                    "intervals": {n: list(map(finite, ends)) for n, (_, *ends) in f.estimates.items()},
                    "warnings": list(f.result.warnings),
                }
                for run, f in each.items()
            }
            for kind, each in deflection.fits.items()
        },
        "failed": {f"{kind}, {run}": words for (kind, run), words in deflection.failed.items()},
    }


def link_structure(stage: StageNumber, *, both: bool, filtered: bool, rate: bool = True) -> Structure:
    """Deflection by (15) with the measured hub as input: elasticity and damping of any order, gauge and cable.

    With the angles of the other stage it includes their accelerations, by the energies of the planar arm, and the rate
    of the other deflection, an observer's gain (``rate``). Initial terms are Caputo's. A history would give fractional
    orders more parameters on the validation run than integer ones.
    """
    made = flexible_link(
        stage=stage,
        hub=False,
        cross_stage="inertial" if both else False,
        cross_sensitivity=True,
        cross_damping=both and rate,
        sensor_filter="stock" if filtered else None,
        laws=("orders", "coefficients", "velocities"),
        offset="constant",
    )
    return replace(made, initial="caputo")


def orders_on_unseen_runs(
    runs: Sequence[Run],
    *,
    filtered: bool = True,
    threads: int | None = None,
    log: Callable[[str], None] = lambda _: None,
    progress: Callable[[int, int], None] | None = None,
) -> UnseenOrders:
    """Fit every deflection of the arm to each run with integer and fractional orders, and validate it on all others.

    A link is (15) with the terms that a real arm needs: the measured hub motion, the accelerations of the other stage
    and the rate of its deflection if both stages were measured, hub angles in the gauge, and an offset of the gauge per
    run. All structures have the same terms and differ in the orders of the link's elasticity (integer 0) and damping
    (integer 1). If both stages were measured, everything is repeated without the rate of the other deflection
    (``Deflection.before``): an order that improves the prediction only there compensates for the missing term.

    Parameters
    ----------
    runs
        Two or more, with theta11 and theta12 and (or) theta21 and theta22 [rad]. Runs with more than 1250 samples are
        decimated. Initial terms, initial filter state and gauge offset are separate for each run.
    filtered
        Whether both deflections passed the 2 Hz low-pass of the arm's stock model.
    threads, progress
        See :func:`ftlm.search_orders`.
    log
        Called with a line about the next step.

    Returns
    -------
    UnseenOrders
        Fits, intervals and verdicts.

    Raises
    ------
    DataError
        Fewer than two runs, two of one name, or runs without both angles of a stage.
    ModelError
        No fit with integer orders.
    """
    runs = [run if run.name else replace(run, name=f"run {k}") for k, run in enumerate(runs, 1)]
    if len(runs) < 2:
        raise DataError(f"{len(runs)} run cannot be both fitted and unseen; give two or more")
    if len({run.name for run in runs}) < len(runs):
        raise DataError(f"runs {join_names(r.name for r in runs)} do not all have names of their own; rename a file")
    stages = stages_in(runs)
    notes: list[str] = []
    used = []
    for run in runs:
        every = -(-run.length // MOST_ROWS)
        if every > 1:
            notes.append(f"of run {run.name} one of {every} rows is used, {every * run.step:.4g} s apart")
        used.append(decimate_run(run, every) if every > 1 else run)
    deflections = {}
    both = len(stages) == 2
    if isinstance(progress, Progress):
        structures = [link_structure(stage, both=both, filtered=filtered) for stage in stages]
        each = sum(
            output_error_cost(run.length, len(s.order_names) + len(s.coefficient_names))
            for s in structures
            for run in used
        )
        fits = len(FREE_ORDERS_BY_KIND) * (2 if both else 1) * each
        progress.expect("all of it", *duration_bounds(estimate_duration(fits, check_threads(threads))))
    for stage in stages:
        found = _deflection(link_structure(stage, both=both, filtered=filtered), "", used, threads, log, progress)
        if both:
            less = link_structure(stage, both=True, filtered=filtered, rate=False)
            found = replace(found, before=_deflection(less, f", {WITHOUT_RATE_LABEL}", used, threads, log, progress))
        deflections[found.output] = found
    return UnseenOrders(tuple(used), deflections, filtered, tuple(notes))


def stages_in(runs: Sequence[Run]) -> list[StageNumber]:
    """Return the stages of which all runs contain both angles.

    Raises
    ------
    DataError
        There is none.
    """
    found = [n for n in STAGE_NUMBERS if all(f"theta{n}{k}" in run.signals for run in runs for k in (1, 2))]
    if not found:
        have = "; ".join(f"{run.name}: {', '.join(run.signals)}" for run in runs)
        raise DataError(
            f"no stage of the arm has both of its angles in all runs ({have}); needed are theta11 and theta12, or "
            f"theta21 and theta22: name their columns with {parameter('columns')}, or "
            f"{parameter('outputs', {'theta11': Placeholder('COLUMN')})}"
        )
    return found


def _deflection(
    structure: Structure,
    told: str,
    runs: Sequence[Run],
    threads: int | None,
    log: Callable[[str], None],
    progress: Callable[[int, int], None] | None,
) -> Deflection:
    """Fit every kind of structure to every run."""
    output = structure.outputs[0]
    runs = [run.select(list(structure.signals)) for run in runs]
    fits: dict[str, dict[str, RunFit]] = {kind: {} for kind in FREE_ORDERS_BY_KIND}
    failed = {}
    for kind, free in FREE_ORDERS_BY_KIND.items():
        letters = {n: n.rstrip("0123456789") for n in structure.order_names}
        held = {n: WHOLE_ORDERS[letter] for n, letter in letters.items() if letter not in free}
        for run in runs:
            log(f"{output}{told}: {kind}, fitted to {run.name}")
            try:
                result = identify(run, structure.with_orders(held), threads=threads, progress=progress)
                fits[kind][run.name] = RunFit(result, {other.name: result.model.compare(other) for other in runs})
            except FtlmError as error:
                if kind == INTEGER_KIND:
                    raise ModelError(f"{output}, whole orders, fitted to {run.name}: {error}") from error
                failed[kind, run.name] = str(error)
    return Deflection(output, structure, fits, failed)
