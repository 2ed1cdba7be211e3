"""Whether parts of a run, or several runs, are one model: each identified by itself, number by number and together."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ftlm.data.run import Run, as_runs
from ftlm.data.sampling import FEWEST_ROWS
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.result import Identification
from ftlm.structure.structure import Structure
from ftlm.svg.html_page import Page, Reported, Section, Table
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, unbounded
from ftlm.utils.statistics import NORMAL_95, chi_squared_99
from ftlm.utils.validation import whole_number
from ftlm.validation.comparison import compare, finite

#: Parts that one run is cut into.
PARTS = 2
#: Words of the table, by what the intervals of two parts do.
APART, TOGETHER, UNTOLD = "apart", "overlap", "not told"
#: An end of an interval nearer or farther than this many times where a parabola has it.
SKEWED = 2.0


@dataclass(frozen=True)
class Difference:
    """What two parts say of one number.

    Parameters
    ----------
    name
        The number.
    parts
        Places of the two parts.
    errors
        Standard errors of the difference that lie between them, of intervals by profile likelihood by the ends that
        face each other; not a number where one part does not tell it.
    apart
        Whether their 95 % intervals have nothing in common.
    """

    name: str
    parts: tuple[int, int]
    errors: float
    apart: bool


@dataclass(frozen=True)
class Agreement(Reported):
    """Parts of a run, or runs, identified each by itself, and whether they are one model.

    Parameters
    ----------
    names
        What the parts are called.
    results
        The identification of each.
    differences
        Of each number between each two parts, the farthest apart first.
    distance, degrees
        How far all numbers together are from those that serve every part best, in the covariances that the parts give
        them: chi-squared of so many degrees where it is one model. None where a method gives no covariance.
    crossed
        Fit in percent of each part's model (first) on each part (second), by output; outputs of one run stand apart.
    """

    names: tuple[str, ...]
    results: tuple[Identification, ...]
    differences: tuple[Difference, ...]
    distance: float | None
    degrees: int
    crossed: tuple[tuple[dict[str, float], ...], ...] = field(repr=False)

    @property
    def same(self) -> bool | None:
        """Whether nothing tells the parts apart; None where no number is told by two of them."""
        if all(math.isnan(d.errors) for d in self.differences):
            return None
        return not any(d.apart for d in self.differences) and not self._far

    @property
    def limit(self) -> float:
        """What chance leaves the distance below in 99 % of cases."""
        return chi_squared_99(self.degrees) if self.degrees else math.inf

    @property
    def _far(self) -> bool:
        return self.distance is not None and self.distance > self.limit

    @property
    def untold(self) -> tuple[str, ...]:
        """Numbers that some part does not tell, with which any other agrees."""
        return tuple(dict.fromkeys(d.name for d in self.differences if math.isnan(d.errors)))

    @property
    def _together(self) -> str:
        if self.distance is None or not self.degrees:
            return ""
        return f"{self.distance:.3g} where chance leaves less than {self.limit:.3g} in 99 of 100 cases"

    def _values(self, part: int) -> dict[str, float]:
        return values_of(self.results[part])

    def words(self, difference: Difference) -> str:
        """A number in two parts: its values, its intervals, and how many standard errors lie between."""
        said = []
        for part in difference.parts:
            low, high = self.results[part].intervals[difference.name]
            value = f"{self._values(part)[difference.name]:.4g}"
            said.append(f"{value} ({unbounded(low, '.4g')} to {unbounded(high, '.4g')}) in {self.names[part]}")
        return f"{difference.name} is {said[0]} and {said[1]}, {difference.errors:.2g} standard errors apart"

    @property
    def reason(self) -> str:
        """Whether it is one model, and which number of which parts says so."""
        told = [d for d in self.differences if not math.isnan(d.errors)]
        if self.same is None:
            return "Not told: no number is known by two parts"
        if self.same:
            words = "The same model as far as the parts tell: the 95 % intervals of every number overlap; the farthest "
            words += f"from each other: {self.words(told[0])}"
            return words + (f"; all numbers together: {self._together}" if self._together else "")
        far = [d for d in told if d.apart]
        if far:
            words = f"Not the same model: {'; '.join(self.words(d) for d in far)}"
            return words + (f"; all numbers together: {self._together}" if self._far else "")
        return (
            f"Not the same model: the 95 % intervals of each number overlap, but all numbers together do not agree "
            f"({self._together}); the farthest from each other: {self.words(told[0])}"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What speaks against the comparison: numbers that are not told, and what speaks against each part."""
        out = []
        if self.untold and self.same is not None:
            out.append(f"{', '.join(self.untold)}: not told by some part, so any other agrees with it")
        for name, result in zip(self.names, self.results, strict=True):
            if result.joint is not None and not result.joint.converged:
                out.append(f"{name}: the fit ended before it stood still")
        if any(w.startswith("residuals of ") and "white" in w for r in self.results for w in r.warnings):
            out.append(
                "residuals are not white: the structure leaves something out, which parts that are excited in other "
                "ways may answer with other numbers; then it is the structure and not the machine that changes"
            )
        return tuple(out)

    def numbers_table(self) -> Table:
        """Numbers of each part, with their intervals, and how far they are apart."""
        rows: list[list[Cell]] = []
        for name in dict.fromkeys(d.name for d in self.differences):
            worst = next(d for d in self.differences if d.name == name)
            cells: list[Cell] = [name]
            for part, result in enumerate(self.results):
                low, high = result.intervals[name]
                interval = f"{unbounded(low, '.4g')} to {unbounded(high, '.4g')}"
                cells.append(f"{self._values(part)[name]:.5g} ({interval})")
            verdict = UNTOLD if math.isnan(worst.errors) else APART if worst.apart else TOGETHER
            rows.append([*cells, None if math.isnan(worst.errors) else worst.errors, verdict])
        return Table(
            "Numbers of each part, with 95 % intervals",
            ("number", *self.names, "standard errors between", "95 % intervals"),
            rows,
            wrap=True,
            note="Standard errors between: of the difference, of the two parts that are farthest apart.",
        )

    def fits_table(self) -> Table:
        """What the model of each part predicts of each."""
        rows: list[list[Cell]] = [
            [f"{name}, {output}", *(self.crossed[k][j].get(output) for j in range(len(self.names)))]
            for k, name in enumerate(self.names)
            for output in self.crossed[k][k]
        ]
        return Table("Fit of each part's model on each part, in %", ("model of", *self.names), rows)

    def _page(self) -> Page:
        first = Section(
            "Whether it is one model",
            paragraphs=[f"{self.reason}."],
            warnings=list(self.warnings),
            tables=[self.numbers_table(), self.fits_table()],
        )
        sections = [Section(n, paragraphs=str(r).splitlines()) for n, r in zip(self.names, self.results, strict=True)]
        lead = {True: "the same model", False: "not the same model", None: "not told"}[self.same]
        return Page("Parts of a run", [first, *sections], lead)

    def to_frame(self) -> Any:
        """Numbers as a pandas frame by number and part."""
        rows = [
            {
                "number": name,
                "part": self.names[part],
                "value": self._values(part)[name],
                "standard_error": error,
                "low": result.intervals[name][0],
                "high": result.intervals[name][1],
            }
            for part, result in enumerate(self.results)
            for name, error in result.standard_errors.items()
        ]
        return to_frame(rows, ["number", "part"])

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "same": self.same,
            "reason": self.reason,
            "parts": list(self.names),
            "differences": [
                {
                    "number": d.name,
                    "parts": [self.names[k] for k in d.parts],
                    "standard_errors": finite(d.errors),
                    "apart": d.apart,
                }
                for d in self.differences
            ],
            "distance": None if self.distance is None else finite(self.distance),
            "degrees": self.degrees,
            "fits": {
                name: dict(zip(self.names, row, strict=True))
                for name, row in zip(self.names, self.crossed, strict=True)
            },
            "warnings": list(self.warnings),
            "identifications": [r.to_dict() for r in self.results],
        }

    def __str__(self) -> str:
        lines = [f"{self.reason}."]
        for table in (self.numbers_table(), self.fits_table()):
            rows = [list(table.columns), *([_cell(c) for c in row] for row in table.rows)]
            wide = [max(len(row[k]) for row in rows) for k in range(len(table.columns))]
            lines += ["", f"{table.title}:"]
            lines += ["  ".join(c.ljust(w) for c, w in zip(row, wide, strict=True)).rstrip() for row in rows]
        return "\n".join([*lines, *(f"! {w}" for w in self.warnings)])


def _cell(value: Cell) -> str:
    return "" if value is None else value if isinstance(value, str) else f"{value:.4g}"


def values_of(result: Identification) -> dict[str, float]:
    """Everything that has a standard error, by name."""
    return {**result.orders, **result.coefficients, **({} if result.joint is None else result.joint_values)}


def agreement(
    runs: Run | Sequence[Run],
    structure: Structure,
    *,
    parts: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Any,
) -> Agreement:
    """Identify parts of a run each by itself, and tell whether they are one model.

    A structure that is the machine's gives the same numbers whichever part of a run it is identified from. Parts whose
    95 % intervals of some number have nothing in common are not one model, nor are those whose numbers together are
    farther apart than their covariances explain in 99 of 100 cases: either the machine changed, or the structure leaves
    something out that one part shows and another does not.

    Parameters
    ----------
    runs
        One run, which is cut into parts of the same length, or several, each a part.
    structure
        What each is identified as. A part that begins in motion has initial terms, or a history, of its own.
    parts
        How many parts of one run, by default 2; not used with several runs.
    progress
        Called with (parts done, parts in all).
    **options
        Of :func:`ftlm.identify`, but for `store` and `start`; a method with standard errors.

    Returns
    -------
    Agreement
        Prints well; ``.same``, ``.reason`` in words, ``.differences`` by number, ``.report`` writes a page.

    Raises
    ------
    ModelError
        One part, a number of parts with several runs, a method without standard errors, or nothing to estimate.
    DataError
        A run too short to be cut, runs that do not fit together, or a part that cannot be identified.
    ConvergenceError
        A part that cannot be fitted.
    """
    every = as_runs(runs)
    given = None if parts is None else whole_number(parts)
    if parts is not None and (given is None or given < PARTS):
        raise ModelError(f"parts = {parts!r}; use a whole number, at least {PARTS}")
    if len(every) > 1 and given is not None:
        raise ModelError(f"{len(every)} runs are parts by themselves; leave parts= out, or give one run")
    kept = [n for n in ("store", "start") if options.get(n) is not None]
    if kept:
        raise ModelError(f"{kept[0]}= is of one identification, and each part has its own; leave it out")
    pieces = cut(every[0], given or PARTS) if len(every) == 1 else list(every)
    names = _named(pieces)
    results: list[Identification] = []
    for name, piece in zip(names, pieces, strict=True):
        try:
            results.append(identify(piece, structure, **options))
        except FtlmError as error:
            raise type(error)(f"{name}: {error}") from error
        if not results[0].standard_errors:
            raise ModelError(
                f"method {results[0].method!r} gives no standard errors of {structure}, and without them nothing tells "
                "whether numbers differ; use method='output-error', and leave something to estimate"
            )
        if progress is not None:
            progress(len(results), len(pieces))
    crossed = tuple(tuple(_crossed(r, p, s) for p, s in zip(pieces, results, strict=True)) for r in results)
    distance, degrees = together(results)
    return Agreement(tuple(names), tuple(results), tuple(differences(results)), distance, degrees, crossed)


def cut(run: Run, parts: int) -> list[Run]:
    """Parts of a run of the same length, but for a row."""
    if parts * FEWEST_ROWS > run.length:
        raise DataError(f"{run.name} has {run.length} rows, too few to be cut into {parts} parts; use fewer")
    ends = [k * run.length // parts for k in range(parts + 1)]
    return [
        run.slice(a * run.step if a else None, b * run.step if b < run.length else None)
        for a, b in itertools.pairwise(ends)
    ]


def _named(pieces: Sequence[Run]) -> list[str]:
    """What parts are called: runs of different names by these, others by when they were."""
    names = [p.name for p in pieces]
    if len(set(names)) == len(names):
        return names
    spans = [f"{p.name} {p.start:g} to {p.start + p.length * p.step:g} s" for p in pieces]
    if len(set(spans)) == len(spans):
        return spans
    return [f"{name} ({k})" for k, name in enumerate(names, 1)]


def _crossed(result: Identification, piece: Run, own: Identification) -> dict[str, float]:
    """Fit of a part's model on a part, which begins as its own fit found; none where the free run is not finite."""
    if result is own:
        return dict(result.fit_percent)
    begun = replace(result.model.structure, initial=own.model.structure.initial)
    try:
        return dict(compare(replace(result.model, structure=begun), piece).fit_percent)
    except FtlmError:
        return {}


def differences(results: Sequence[Identification]) -> list[Difference]:
    """Of each number between each two parts, the farthest apart first; what is not told last."""
    out = []
    for places in itertools.combinations(range(len(results)), 2):
        pair = [results[k] for k in places]
        for name in pair[0].standard_errors:
            (first, low), (second, high) = sorted((values_of(r)[name], r.intervals[name]) for r in pair)
            # Of each interval the end that faces the other part: those by profile likelihood are not symmetric.
            width = (low[1] - first, second - high[0])
            error = math.hypot(*width) / NORMAL_95
            told = 0.0 < error < math.inf and all(tells(r, name) for r in pair)
            apart = told and second - first > sum(width)
            out.append(Difference(name, places, (second - first) / error if told else math.nan, apart))
    return sorted(out, key=lambda d: (not d.apart, math.isnan(d.errors), 0.0 if math.isnan(d.errors) else -d.errors))


def tells(result: Identification, name: str) -> bool:
    """Whether a part says anything of a number: not where it may be anything."""
    low, high = result.intervals[name]
    return 0.0 < result.standard_errors[name] < math.inf and (low > -math.inf or high < math.inf)


def is_quadratic(result: Identification, name: str) -> bool:
    """Whether both ends of an interval are about where the standard error has them."""
    value, usual = values_of(result)[name], NORMAL_95 * result.standard_errors[name]
    low, high = result.intervals[name]
    return tells(result, name) and all(usual / SKEWED <= end <= SKEWED * usual for end in (value - low, high - value))


def together(results: Sequence[Identification]) -> tuple[float | None, int]:
    """Chi-squared of all numbers about those that serve every part best, and its degrees of freedom.

    Left out of all are numbers whose interval in some part is no parabola's: there a covariance says little. Each is
    told in units of its standard errors, so that powers of the unit of time do not decide what rounding is.
    """
    joints = [r.joint for r in results if r.joint is not None]
    if len(joints) < len(results):
        return None, 0
    known = np.array([all(is_quadratic(r, n) for r in results) for n in joints[0].names])
    count = int(known.sum())
    if count == 0:
        return None, 0
    unit = np.sqrt(np.mean([np.diag(j.covariance)[known] for j in joints], axis=0))
    spreads = [j.covariance[np.ix_(known, known)] / np.outer(unit, unit) for j in joints]
    points = [j.values[known] / unit for j in joints]
    weights = [np.linalg.pinv(s, hermitian=True) for s in spreads]
    centre = np.linalg.lstsq(np.sum(weights, axis=0), sum(w @ p for w, p in zip(weights, points, strict=True)))[0]
    distance = float(sum((p - centre) @ w @ (p - centre) for w, p in zip(weights, points, strict=True)))
    return distance, count * (len(joints) - 1)
