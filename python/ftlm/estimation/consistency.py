"""Consistency test: whether segments of a run, or several runs, share the same parameters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ftlm.data.run import Run
from ftlm.data.runs import as_runs
from ftlm.data.sampling import MIN_RUN_SAMPLES
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.methods import EstimationMethod, resolve_method
from ftlm.estimation.result import Identification
from ftlm.findings import Finding, make_finding, texts
from ftlm.structure.structure import Offset, Structure
from ftlm.svg.html_page import Page, ReportMixin, Section, Table
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, finite, format_bound, plural
from ftlm.utils.parameters import parameter
from ftlm.utils.statistics import NORMAL_95, chi_squared_99
from ftlm.utils.validation import Floats, check_integer
from ftlm.validation.comparison import compare

#: Default number of segments of one run.
DEFAULT_SEGMENTS = 2
#: Table entries for the comparison of two intervals.
DISJOINT_TEXT, OVERLAP_TEXT, NOT_IDENTIFIABLE_TEXT = "disjoint", "overlap", "not identifiable"
#: Maximum ratio between the half-widths of an interval and of the Wald interval for which the covariance is used.
MAX_ASYMMETRY_RATIO = 2.0
#: Two runs differ by a delay if the model of one run fits the other run once its inputs are shifted. Maximum shift
#: [samples], maximum residual relative to that without a shift, and relative to that of the other run's own model.
MAX_SHIFT_ROWS, MAX_SHIFTED_RATIO, MAX_OWN_RATIO = 2, 0.5, 1.1


@dataclass(frozen=True)
class ParameterDifference:
    """Difference of one parameter between two segments.

    Parameters
    ----------
    name
        The parameter.
    segments
        Indices of the two segments.
    difference_in_errors
        Absolute difference divided by its standard error; NaN if the parameter is not identifiable from one segment.
        The standard error follows from the upper bound of the smaller estimate and the lower bound of the larger one.
    disjoint
        Whether the 95 % intervals do not overlap.
    """

    name: str
    segments: tuple[int, int]
    difference_in_errors: float
    disjoint: bool


@dataclass(frozen=True)
class Consistency(ReportMixin):
    """Result of a consistency test: separate fits of segments, and whether they agree with one model.

    Parameters
    ----------
    segments
        Names of the segments.
    results
        Identification of each segment.
    differences
        Difference of each parameter between any two segments, those with disjoint intervals first, then by decreasing
        size.
    statistic, degrees_of_freedom
        Chi-squared statistic of all parameters about their common weighted mean, and its degrees of freedom under one
        common model. `statistic` is None, and `degrees_of_freedom` 0, without a covariance.
    cross_validation
        ``cross_validation[k][j]`` is the fit in percent, by output, of the model of segment k on segment j.
    delay_findings
        Findings on runs that the model of another run explains once their inputs are shifted by some samples.
    """

    segments: tuple[str, ...]
    results: tuple[Identification, ...]
    differences: tuple[ParameterDifference, ...]
    statistic: float | None
    degrees_of_freedom: int
    cross_validation: tuple[tuple[dict[str, float], ...], ...] = field(repr=False)
    delay_findings: tuple[Finding, ...] = field(default=(), repr=False)

    @property
    def consistent(self) -> bool | None:
        """Whether the segments share one model; None if no parameter is identifiable from two segments."""
        if all(math.isnan(d.difference_in_errors) for d in self.differences):
            return None
        return not any(d.disjoint for d in self.differences) and not self._exceeds_limit

    @property
    def limit(self) -> float:
        """99 % quantile of ``statistic`` if all segments share one model; infinite without degrees of freedom."""
        return chi_squared_99(self.degrees_of_freedom) if self.degrees_of_freedom else math.inf

    @property
    def _exceeds_limit(self) -> bool:
        return self.statistic is not None and self.statistic > self.limit

    @property
    def not_identifiable(self) -> tuple[str, ...]:
        """Names of the parameters that at least one segment does not identify, in the sequence of `differences`."""
        return tuple(dict.fromkeys(d.name for d in self.differences if math.isnan(d.difference_in_errors)))

    @property
    def _joint_test_text(self) -> str:
        if self.statistic is None or not self.degrees_of_freedom:
            return ""
        return f"statistic {self.statistic:.3g}, 99 % limit {self.limit:.3g}"

    def _values(self, part: int) -> dict[str, float]:
        return values_of(self.results[part])

    def describe_difference(self, difference: ParameterDifference) -> str:
        """Return text on one parameter in two segments: values, intervals and difference in standard errors."""
        text = []
        for part in difference.segments:
            low, high = self.results[part].intervals[difference.name]
            value = f"{self._values(part)[difference.name]:.4g}"
            text.append(f"{value} ({format_bound(low, '.4g')} to {format_bound(high, '.4g')}) in {self.segments[part]}")
        return (
            f"{difference.name} is {text[0]} and {text[1]}, {difference.difference_in_errors:.2g} standard errors apart"
        )

    @property
    def reason(self) -> str:
        """Conclusion in one sentence, with the parameters and segments that decide it."""
        comparable = [d for d in self.differences if not math.isnan(d.difference_in_errors)]
        if self.consistent is None:
            return "Inconclusive: no parameter is identifiable from two segments"
        if self.consistent:
            text = "The same model within its uncertainty: the 95 % intervals of every parameter overlap; the largest "
            text += f"difference: {self.describe_difference(comparable[0])}"
            return text + (f"; all parameters together: {self._joint_test_text}" if self._joint_test_text else "")
        disjoint = [d for d in comparable if d.disjoint]
        if disjoint:
            text = f"Not the same model: {'; '.join(self.describe_difference(d) for d in disjoint)}"
            return text + (f"; all parameters together: {self._joint_test_text}" if self._exceeds_limit else "")
        return (
            f"Not the same model: the 95 % intervals of each parameter overlap, but all parameters together differ "
            f"({self._joint_test_text}); the largest difference: {self.describe_difference(comparable[0])}"
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings that limit the conclusion: first on parameters that are not identifiable, then on each segment."""
        out = []
        if self.not_identifiable and self.consistent is not None:
            out.append(make_finding("not_identifiable_from_segment", parameter=", ".join(self.not_identifiable)))
        for name, result in zip(self.segments, self.results, strict=True):
            if result.joint is not None and not result.joint.converged:
                out.append(make_finding("segment_not_converged", run=name))
        out += self.delay_findings
        if any(f.code == "residuals_not_white" for r in self.results for f in r.findings):
            out.append(make_finding("segment_residuals_not_white"))
        return tuple(out)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences."""
        return texts(self.findings)

    def parameters_table(self) -> Table:
        """Return a table of the parameters of each segment, with intervals and differences."""
        rows: list[list[Cell]] = []
        for name in dict.fromkeys(d.name for d in self.differences):
            worst = next(d for d in self.differences if d.name == name)
            cells: list[Cell] = [name]
            for part, result in enumerate(self.results):
                low, high = result.intervals[name]
                interval = f"{format_bound(low, '.4g')} to {format_bound(high, '.4g')}"
                cells.append(f"{self._values(part)[name]:.5g} ({interval})")
            verdict = (
                NOT_IDENTIFIABLE_TEXT
                if math.isnan(worst.difference_in_errors)
                else DISJOINT_TEXT
                if worst.disjoint
                else OVERLAP_TEXT
            )
            rows.append(
                [*cells, None if math.isnan(worst.difference_in_errors) else worst.difference_in_errors, verdict]
            )
        return Table(
            "Parameters of each segment, with 95 % intervals",
            ("parameter", *self.segments, "difference in standard errors", "95 % intervals"),
            rows,
            wrap=True,
            note="The difference is that of the two segments that differ most, divided by its standard error.",
        )

    def fits_table(self) -> Table:
        """Return a table of the fit of each segment's model on every segment."""
        rows: list[list[Cell]] = [
            [f"{name}, {output}", *(self.cross_validation[k][j].get(output) for j in range(len(self.segments)))]
            for k, name in enumerate(self.segments)
            for output in self.cross_validation[k][k]
        ]
        return Table("Fit of each segment's model on each segment, in %", ("model of", *self.segments), rows)

    def _page(self) -> Page:
        first = Section(
            "Test for one model",
            paragraphs=[f"{self.reason}."],
            warnings=list(self.warnings),
            tables=[self.parameters_table(), self.fits_table()],
        )
        sections = [
            Section(n, paragraphs=str(r).splitlines()) for n, r in zip(self.segments, self.results, strict=True)
        ]
        lead = {True: "the same model", False: "not the same model", None: "inconclusive"}[self.consistent]
        return Page("Parts of a run", [first, *sections], lead)

    def to_frame(self) -> Any:
        """Return a pandas DataFrame of the estimates, indexed by parameter and segment."""
        rows = [
            {
                "parameter": name,
                "segment": self.segments[part],
                "value": self._values(part)[name],
                "standard_error": error,
                "low": result.intervals[name][0],
                "high": result.intervals[name][1],
            }
            for part, result in enumerate(self.results)
            for name, error in result.standard_errors.items()
        ]
        return to_frame(rows, ["parameter", "segment"])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        return {
            "consistent": self.consistent,
            "reason": self.reason,
            "segments": list(self.segments),
            "differences": [
                {
                    "parameter": d.name,
                    "segments": [self.segments[k] for k in d.segments],
                    "difference_in_errors": finite(d.difference_in_errors),
                    "disjoint": d.disjoint,
                }
                for d in self.differences
            ],
            "statistic": None if self.statistic is None else finite(self.statistic),
            "degrees_of_freedom": self.degrees_of_freedom,
            "cross_validation": {
                name: dict(zip(self.segments, row, strict=True))
                for name, row in zip(self.segments, self.cross_validation, strict=True)
            },
            "findings": [f.to_dict() for f in self.findings],
            "warnings": list(self.warnings),
            "identifications": [r.to_dict() for r in self.results],
        }

    def __str__(self) -> str:
        lines = [f"{self.reason}."]
        for table in (self.parameters_table(), self.fits_table()):
            rows = [list(table.columns), *([_cell(c) for c in row] for row in table.rows)]
            wide = [max(len(row[k]) for row in rows) for k in range(len(table.columns))]
            lines += ["", f"{table.title}:"]
            lines += ["  ".join(c.ljust(w) for c, w in zip(row, wide, strict=True)).rstrip() for row in rows]
        return "\n".join([*lines, *(f"! {w}" for w in self.warnings)])


def _cell(value: Cell) -> str:
    return "" if value is None else value if isinstance(value, str) else f"{value:.4g}"


def values_of(result: Identification) -> dict[str, float]:
    """Return the estimates of all parameters that the user did not fix, by name."""
    return {n: p.value for n, p in result.parameters.items() if not p.fixed}


@check_arguments
def consistency(
    runs: Run | Sequence[Run],
    structure: Structure,
    *,
    segments: int | None = None,
    method: str | EstimationMethod = "output-error",
    offset: Offset | None = None,
    m: int | None = None,
    threads: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Consistency:
    """Identify segments of a run separately and test whether they share one model.

    If the structure is right, every segment gives the same parameters within their errors. Segments are inconsistent if
    the 95 % intervals of one parameter do not overlap, or if a chi-squared test of all parameters rejects common values
    at 99 %. Then the plant changed, or the structure lacks an effect that only some segments excite.

    Parameters
    ----------
    runs
        One run, which is split into segments of equal length, or several runs, one segment each.
    structure
        Structure to identify. Each segment that starts in motion has its own initial conditions.
    segments
        Number of segments of one run, by default 2; not used with several runs.
    method, offset, m, threads
        See :func:`ftlm.identify`. The method must give standard errors, and have neither a `store` nor a `start`.
    progress
        Callback with (segments done, total segments).

    Returns
    -------
    Consistency
        Printable result with ``.consistent``, ``.reason`` and ``.differences``; ``.report`` writes an HTML page.

    Raises
    ------
    ModelError
        If there are fewer than two segments, `segments` is given with several runs, the method gives no standard
        errors, or no parameter is free.
    DataError
        If a run is too short to split, runs differ in names or units, or a segment cannot be identified.
    ConvergenceError
        If the fit of a segment fails.
    """
    all_runs = as_runs(runs)
    count = None if segments is None else check_integer("segments", segments, DEFAULT_SEGMENTS)
    if len(all_runs) > 1 and count is not None:
        raise ModelError(
            f"{len(all_runs)} runs are given, and each is a segment; leave {parameter('segments')} out, or give one run"
        )
    estimator = resolve_method(method)
    options = [n for n in ("store", "start") if getattr(estimator, n, None) is not None]
    if options:
        raise ModelError(
            f"{parameter(options[0])} applies to a single identification, but each segment is identified separately; "
            "leave it out"
        )
    pieces = split_run(all_runs[0], count or DEFAULT_SEGMENTS) if len(all_runs) == 1 else list(all_runs)
    names = _segment_names(pieces)
    results: list[Identification] = []
    for name, piece in zip(names, pieces, strict=True):
        try:
            results.append(identify(piece, structure, method=estimator, offset=offset, m=m, threads=threads))
        except FtlmError as error:
            raise type(error)(f"{name}: {error}") from error
        if not results[0].standard_errors:
            raise ModelError(
                f"method {results[0].method!r} gives no standard errors of {structure}, which this test needs; "
                f"use {parameter('method', 'output-error')}, and leave at least one parameter free"
            )
        if progress is not None:
            progress(len(results), len(pieces))
    cross_validation = tuple(
        tuple(_cross_validated_fit(r, p, s) for p, s in zip(pieces, results, strict=True)) for r in results
    )
    statistic, degrees_of_freedom = joint_statistic(results)
    result = Consistency(
        tuple(names), tuple(results), tuple(differences(results)), statistic, degrees_of_freedom, cross_validation
    )
    if result.consistent is not False or len(all_runs) == 1:
        return result
    return replace(result, delay_findings=tuple(_delay_findings(names, pieces, results)))


def _delay_findings(names: Sequence[str], pieces: Sequence[Run], results: Sequence[Identification]) -> list[Finding]:
    """Return findings on runs that another run's model fits equally well once inputs are shifted in time."""
    findings = []
    for (k, piece), (j, result) in itertools.product(enumerate(pieces), enumerate(results)):
        inputs = [n for n in result.model.structure.signals if n in piece.inputs]
        if k == j or piece.nonuniform_samples is not None or piece.length <= 2 * MAX_SHIFT_ROWS:
            continue
        # A fit is 100 (1 - NR).
        segment_fit = results[k].fit
        misfits: dict[int, dict[str, float]] = {}
        for rows in range(-MAX_SHIFT_ROWS, MAX_SHIFT_ROWS + 1):
            shifted = piece.with_samples({n: _shift_rows(piece[n], rows) for n in inputs})
            fits = _cross_validated_fit(result, shifted, results[k])
            misfits[rows] = {o: 100.0 - fit for o, fit in fits.items()}
        for output, misfit_before in misfits[0].items():
            rows = min(misfits, key=lambda r: misfits[r].get(output, math.inf))
            misfit_after = misfits[rows][output]
            if (
                rows
                and misfit_after < MAX_SHIFTED_RATIO * misfit_before
                and misfit_after <= MAX_OWN_RATIO * (100.0 - segment_fit[output])
            ):
                text = f"{abs(rows)} row{'s' if abs(rows) > 1 else ''} {'later' if rows > 0 else 'earlier'}"
                details = {"before": misfit_before, "after": misfit_after, "other": names[j], "shown": text}
                findings.append(make_finding("segments_differ_by_delay", run=names[k], output=output, **details))
    return findings


def _shift_rows(samples: Floats, rows: int) -> Floats:
    """Return samples delayed by `rows` samples, or advanced if `rows` is negative; end values fill the gap."""
    at = np.clip(np.arange(samples.size) - rows, 0, samples.size - 1)
    return np.asarray(samples[at])


def split_run(run: Run, parts: int) -> list[Run]:
    """Return consecutive segments of a run of nearly equal length; raise DataError if the run is too short."""
    if parts * MIN_RUN_SAMPLES > run.length:
        raise DataError(
            f"{run.name} has {plural(run.length, 'row')}, too few to be cut into {parts} parts; use fewer parts"
        )
    ends = [k * run.length // parts for k in range(parts + 1)]
    return [
        run.window(a * run.step if a else None, b * run.step if b < run.length else None)
        for a, b in itertools.pairwise(ends)
    ]


def _segment_names(pieces: Sequence[Run]) -> list[str]:
    """Return segment names: the run names if they differ, otherwise run names with time intervals or numbers."""
    names = [p.name for p in pieces]
    if len(set(names)) == len(names):
        return names
    spans = [f"{p.name} {p.start:g} to {p.start + p.length * p.step:g} s" for p in pieces]
    if len(set(spans)) == len(spans):
        return spans
    return [f"{name} ({k})" for k, name in enumerate(names, 1)]


def _cross_validated_fit(result: Identification, piece: Run, segment_result: Identification) -> dict[str, float]:
    """Return the fit in percent, by output, of the model of `result` on the segment `piece`.

    The simulation uses the initial conditions of `segment_result`, the identification of this segment. The result is {}
    if the simulation fails.
    """
    if result is segment_result:
        return dict(result.fit)
    structure = replace(result.model.structure, initial=segment_result.model.structure.initial)
    try:
        return dict(compare(replace(result.model, structure=structure), piece).fit)
    except FtlmError:
        return {}


def differences(results: Sequence[Identification]) -> list[ParameterDifference]:
    """Return the differences of each parameter between any two segments, most significant first."""
    out = []
    for pair_indices in itertools.combinations(range(len(results)), 2):
        pair = [results[k] for k in pair_indices]
        for name in pair[0].standard_errors:
            (first, low), (second, high) = sorted((values_of(r)[name], r.intervals[name]) for r in pair)
            # Profile-likelihood intervals are asymmetric. The bounds that face each other determine the standard error.
            gap = (low[1] - first, second - high[0])
            error = math.hypot(*gap) / NORMAL_95
            is_determined = 0.0 < error < math.inf and all(is_identifiable(r, name) for r in pair)
            is_apart = is_determined and second - first > sum(gap)
            out.append(
                ParameterDifference(
                    name, pair_indices, (second - first) / error if is_determined else math.nan, is_apart
                )
            )
    return sorted(
        out,
        key=lambda d: (
            not d.disjoint,
            math.isnan(d.difference_in_errors),
            0.0 if math.isnan(d.difference_in_errors) else -d.difference_in_errors,
        ),
    )


def is_identifiable(result: Identification, name: str) -> bool:
    """Whether a parameter has a finite standard error and an interval with at least one finite bound."""
    low, high = result.intervals[name]
    return 0.0 < result.standard_errors[name] < math.inf and (low > -math.inf or high < math.inf)


def is_quadratic(result: Identification, name: str) -> bool:
    """Whether both bounds of a parameter's interval are close to the bounds of its Wald interval."""
    value, half_width = values_of(result)[name], NORMAL_95 * result.standard_errors[name]
    low, high = result.intervals[name]
    return is_identifiable(result, name) and all(
        half_width / MAX_ASYMMETRY_RATIO <= end <= MAX_ASYMMETRY_RATIO * half_width
        for end in (value - low, high - value)
    )


def joint_statistic(results: Sequence[Identification]) -> tuple[float | None, int]:
    """Return the chi-squared statistic of all parameters about their weighted mean, and its degrees of freedom.

    Parameters whose interval in some segment is not close to the Wald interval are omitted, because their covariance is
    inaccurate. Parameters are scaled by their standard errors, so that units do not affect the numerical rank. The
    result is (None, 0) if a segment has no joint fit, or if no parameter remains.
    """
    joints = [r.joint for r in results if r.joint is not None]
    if len(joints) < len(results):
        return None, 0
    is_comparable = np.array([all(is_quadratic(r, n) for r in results) for n in joints[0].names])
    count = int(is_comparable.sum())
    if count == 0:
        return None, 0
    unit = np.sqrt(np.mean([np.diag(j.covariance)[is_comparable] for j in joints], axis=0))
    covariances = [j.covariance[np.ix_(is_comparable, is_comparable)] / np.outer(unit, unit) for j in joints]
    points = [j.values[is_comparable] / unit for j in joints]
    weights = [np.linalg.pinv(s, hermitian=True) for s in covariances]
    weighted_mean = np.linalg.lstsq(np.sum(weights, axis=0), sum(w @ p for w, p in zip(weights, points, strict=True)))[
        0
    ]
    statistic = float(sum((p - weighted_mean) @ w @ (p - weighted_mean) for w, p in zip(weights, points, strict=True)))
    return statistic, count * (len(joints) - 1)
