"""Results of an order search: ranked table, certificate, and progress of a checkpoint file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from ftlm.findings import (
    LEVEL_DO_NOT_USE,
    LEVEL_WITH_CARE,
    Finding,
    group_findings,
    make_finding,
    texts,
    unique_findings,
)
from ftlm.model.best_identification import BestIdentification
from ftlm.model.model import Model
from ftlm.model.parameter_estimates import Parameter, parameter_estimates
from ftlm.svg.html_page import Table
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, Exact, attributes, number, symbol, symbol_html, wrap_text
from ftlm.utils.parameters import choose_text, parameter

if TYPE_CHECKING:
    from ftlm.estimation.result import Identification
    from ftlm.estimation.verdict import Verdict

#: RMS simulation error over standard deviation of the output (NR) above which a simulation explains little of it.
MAX_SIMULATION_NR = 0.5
#: Relative difference of scores and coefficients below which two rows of the table count as one model.
SAME_MODEL_TOLERANCE = 1e-6
#: Maximum number of candidates in the table of a report.
MAX_REPORT_ROWS = 10


@dataclass(frozen=True)
class OrderCertificate:
    """Lower bound of the equation error over intervals of orders; result of :func:`ftlm.certify_orders`.

    Parameters
    ----------
    lower_bound
        Lower bound of the RMS equation error for all orders in the intervals and all coefficients that
        `max_term_ratio` admits. It holds for exact arithmetic on the block-pulse means. 0 if nothing is proved.
    best
        Minimum RMS equation error found; infinite if none was found.
    orders
        Values of the free orders with the smallest error found, by name; empty if none was found.
    requested_tolerance
        Requested maximum fraction by which the error at any orders may be below `best`.
    intervals
        Lowest and highest value of each free order.
    min_separation
        Minimum difference between alpha and the order of every output term, and between the orders of two terms of the
        same signal.
    max_term_ratio
        Maximum RMS of all terms of an equation together, divided by the RMS of the output.
    cells
        Number of boxes of orders for which a bound was computed.
    open_cells
        Number of boxes whose bound does not reach the requested tolerance, because they are too small to be halved or
        the maximum number of boxes was reached.
    m
        Block pulses per run.
    simulation_nr
        RMS simulation error of the model with `orders` and its least-squares coefficients, divided by the standard
        deviation of the output; infinite if the simulation fails. The certificate does not bound this error.
    unstable_poles
        Number of poles of this model with a positive real part; NaN if unknown.
    start_errors
        RMS equation error at each point of the argument `start`; infinite if the terms are linearly dependent there.
    """

    lower_bound: float
    best: float
    orders: dict[str, float]
    requested_tolerance: float
    intervals: dict[str, tuple[float, float]]
    min_separation: float
    max_term_ratio: float
    cells: int
    open_cells: int
    m: int
    simulation_nr: float = math.nan
    unstable_poles: float = math.nan
    start_errors: tuple[float, ...] = ()

    @property
    def beatable(self) -> tuple[bool, ...]:
        """For each point of the argument `start`, whether other orders may have an error that is clearly smaller.

        Clearly smaller means by more than the requested tolerance. False means that the lower bound excludes such
        orders.
        """
        return tuple(self.lower_bound < (1 - self.requested_tolerance) * error for error in self.start_errors)

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Finding that the simulation at the best orders is unstable or poor; empty if it is neither.

        The certificate covers only the equation error.
        """
        if self.unstable_poles > 0:
            return (make_finding("best_orders_unstable", poles=int(self.unstable_poles), nr=self.simulation_nr),)
        if self.simulation_nr > MAX_SIMULATION_NR:
            return (make_finding("best_orders_poor_fit", nr=self.simulation_nr),)
        return ()

    @property
    def proved_tolerance(self) -> float:
        """Maximum fraction by which other orders can reduce the smallest error found; 1 without a proof."""
        return max(0.0, 1 - self.lower_bound / self.best)

    def to_dict(self) -> dict[str, Any]:
        """Return the certificate as a dictionary for JSON."""
        bound_fields = ("lower_bound", "best", "proved_tolerance", "requested_tolerance", "orders", "intervals")
        options = ("min_separation", "max_term_ratio", "cells", "open_cells", "m")
        attributes_shown = attributes(
            self, (*bound_fields, *options, "simulation_nr", "start_errors", "beatable", "findings")
        )
        return attributes_shown if self.orders else attributes_shown | {"best": None}

    def __str__(self) -> str:
        lines = [
            f"start {k}: {error:.5g}, "
            + (
                "other orders may have a smaller error"
                if open_
                else "no orders have an error smaller by more than this"
            )
            for k, (error, open_) in enumerate(zip(self.start_errors, self.beatable, strict=True))
        ]
        return "\n".join([self._bound_text, *lines, *(f"! {f}; {f.remedy}" for f in self.findings)])

    @property
    def _bound_text(self) -> str:
        intervals = ", ".join(f"{n} from {low:g} to {high:g}" for n, (low, high) in self.intervals.items())
        separation = f"{self.min_separation:g}"
        separations = f"orders of the output {separation} below its highest, of one signal {separation} apart"
        orders_text = ", ".join(f"{name} {value:.5g}" for name, value in self.orders.items())
        box_text = f"{self.cells} boxes of orders"
        if self.lower_bound == 0:
            return (
                f"certificate: nothing is proved of all orders with {intervals} ({separations}): {self.open_cells} of "
                f"{box_text} are left; narrow the intervals, keep orders farther apart, or allow more boxes"
            )
        # Rounded up, so that the printed bound holds.
        percent = math.ceil(1000 * self.proved_tolerance - 1e-4) / 10
        text = (
            f"certificate: no orders with {intervals} ({separations}), on the order grid or between, have an RMS "
            f"equation error below {self.lower_bound:.5g} with coefficients whose terms are together at most "
            f"{self.max_term_ratio:g} times the output; {orders_text} leave {self.best:.5g}, so nothing is better by "
            f"more than {percent:g} % ({box_text})"
        )
        if self.open_cells:
            text += (
                f"; {100 * self.requested_tolerance:g} % was asked for, and {self.open_cells} boxes were too small to "
                "halve or too many"
            )
        return text


@dataclass(frozen=True)
class SearchRow:
    """Row of the ranked table of an order search.

    Parameters
    ----------
    rank
        Rank in the table, from 1.
    index
        Index of the candidate in the order grid. Of candidates with equal scores, the one with the smallest index ranks
        first.
    score
        Sum of absolute errors, eq. (45) of the paper, for the norm ``"l1"``, or RMSE for ``"l2"``. For coupled
        equations, these values are divided by the standard deviation of the output, and for ``"l1"`` also by the number
        of block pulses. The score is then their sum over the equations.
    orders
        Values of the free orders by name.
    coefficients
        Values of the coefficients by name.
    """

    rank: int
    index: int
    score: float
    orders: dict[str, float]
    coefficients: dict[str, float]


@dataclass(frozen=True)
class SearchResult(BestIdentification):
    """Result of an order search: table of the best candidates, best model, and counts of excluded candidates.

    Parameters
    ----------
    table
        Rows of the best candidates, best first.
    model
        Model with the orders and coefficients of the first row.
    candidates
        Number of candidates of the search.
    exclusion_counts
        Number of candidates that are not in the table, by reason: "beaten" (fully evaluated, worse than the table),
        "bound" (excluded by a lower bound of the score), "stopped early" (excluded by a partial sum of the score),
        "singular" (linearly dependent terms) and "diverged" (simulation). Counts and table rows add up to all
        candidates. A candidate excluded by a bound or stopped early might have diverged in a full evaluation.
    failures
        First singular or diverged candidates, each as (orders by name, reason).
    m
        Block pulses per run.
    settings
        Options by name: criterion, norm, coefficients, innovation length, prior covariance, row basis, initial terms.
    at_grid_edge
        Values of those orders of the first row that are at a limit of their interval, by name.
    excluded_by_box
        Number of candidates, counted as "bound", that were excluded together with a whole box of orders.
    simulated_candidates
        Number of candidates that were simulated if the equations have nonlinear terms: the best by equation error. 0
        for linear equations, for which the search is exhaustive.
    verdict, model_findings
        Verdict and findings of :func:`ftlm.identify` at the orders of rank 1. For a search resumed from a checkpoint
        file, which does not contain the runs, `verdict` is None and `model_findings` is empty.
    best
        Identification at the orders of rank 1, from which fit, standard errors, intervals, covariance, report and
        validation are taken. None for a resumed search, and if the identification failed.
    """

    table: list[SearchRow]
    model: Model
    candidates: int
    exclusion_counts: dict[str, int]
    failures: list[tuple[dict[str, float], str]]
    m: int
    settings: dict[str, Any]
    at_grid_edge: dict[str, float]
    excluded_by_box: int = 0
    simulated_candidates: int = 0
    verdict: Verdict | None = field(default=None, compare=False)
    model_findings: tuple[Finding, ...] = field(default=(), compare=False)
    best: Identification | None = field(default=None, compare=False, repr=False)

    @property
    def orders(self) -> dict[str, float]:
        """Values of the free orders of the best model, by name."""
        return self.table[0].orders

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients of the best model, by name."""
        return self.table[0].coefficients

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Parameters of the best model by name, with standard errors if the estimator gives them."""
        values = {**self.orders, **self.coefficients}
        errors, intervals = ({}, {}) if self.best is None else (self.best.standard_errors, self.best.intervals)
        return parameter_estimates(self.model, values, errors=errors, intervals=intervals, free=values)

    @property
    def score(self) -> float:
        """Score of the first row of the table."""
        return self.table[0].score

    def _repr_html_(self) -> str:
        return search_html(self)

    @property
    def excluded_summary(self) -> str:
        """Numbers of excluded candidates by reason, as text that continues a sentence: ``, 12 bound, 3 singular``."""
        texts = {reason: f"{count} {reason}" for reason, count in self.exclusion_counts.items() if count}
        if self.excluded_by_box:
            texts["bound"] += f" ({self.excluded_by_box} of them in boxes excluded whole)"
        return "".join(f", {words}" for words in texts.values())

    def to_frame(self) -> Any:
        """Return the ranked table as a pandas DataFrame: one row per rank, columns for score, orders, coefficients."""
        rows = [{"rank": r.rank, "score": r.score, **r.orders, **r.coefficients} for r in self.table]
        return to_frame(rows, ["rank"])

    def to_dict(self) -> dict[str, Any]:
        """Return the result as a dictionary for JSON."""
        names = ("candidates", "exclusion_counts", "excluded_by_box", "m", "settings", "table")
        failures = {"failures": [{"orders": o, "reason": reason} for o, reason in self.failures]}
        return attributes(self, names) | failures | {"at_grid_edge": self.at_grid_edge} | self._verdict_dict()

    def _verdict_dict(self) -> dict[str, Any]:
        """Return verdict and findings as a dictionary for JSON; empty for a search without a verdict."""
        if self.verdict is None:
            return {}
        return {"verdict": self.verdict.to_dict(), "findings": [f.to_dict() for f in self.findings]}

    @property
    def distinct_rows(self) -> list[tuple[SearchRow, int]]:
        """Table rows with different models, each as (row, number of equivalent rows including itself).

        Rows are equivalent if their scores and coefficients are equal up to rounding. This occurs if all orders of two
        rows differ by the same number, because a run from rest then satisfies both equations.
        """
        distinct: list[tuple[SearchRow, int]] = []
        for row in self.table:
            at = next((k for k, (kept_row, _) in enumerate(distinct) if _is_same_model(row, kept_row)), None)
            if at is None:
                distinct.append((row, 1))
            else:
                distinct[at] = (distinct[at][0], distinct[at][1] + 1)
        return distinct

    @property
    def search_findings(self) -> tuple[Finding, ...]:
        """Findings on the table: orders at a limit of their interval, candidates not simulated, equivalent rows."""
        edges = [make_finding("order_on_edge", parameter=n, value=v) for n, v in self.at_grid_edge.items()]
        if 0 < self.simulated_candidates < self.candidates:
            edges.append(
                make_finding("candidates_not_simulated", count=self.simulated_candidates, candidates=self.candidates)
            )
        distinct, rows = len(self.distinct_rows), len(self.table)
        if distinct == rows:
            return tuple(edges)
        return (
            *edges,
            make_finding("table_rows_equivalent", rows=rows, models=distinct, plural="s" if distinct > 1 else ""),
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the table, followed by those on the model of rank 1, without duplicates."""
        return unique_findings([*self.search_findings, *(f for f in self.model_findings if f.code != "order_on_edge")])

    @property
    def warnings(self) -> tuple[str, ...]:
        """Findings as sentences."""
        return texts(self.findings)

    def __str__(self) -> str:
        names, coefficients = list(self.orders), list(self.coefficients)
        criterion_text = "error" if self.settings["norm"] == "l1" else "RMSE"
        head = (
            f"{'rank':>4}{criterion_text:>12}"
            + "".join(f"{n:>9}" for n in names)
            + "".join(f"{n:>12}" for n in coefficients)
        )
        lines = [head]
        for row, count in self.distinct_rows:
            orders = "".join(f"{row.orders[n]:>9.5g}" for n in names)
            values = "".join(f"{row.coefficients[n]:>12.5g}" for n in coefficients)
            further_rows = f"  (and {count - 1} more row{'s' if count > 2 else ''})" if count > 1 else ""
            lines.append(f"{row.rank:>4}{row.score:>12.5g}{orders}{values}{further_rows}")
        lines.append(f"{self.candidates} candidates: {len(self.table)} kept{self.excluded_summary}")
        if self.verdict is not None:
            lines.append(f"rank 1: {self.verdict}")
        of_table = [f for f in self.findings if f.kind.topic == "order_table"]
        of_model = [f for f in self.findings if f.level in (LEVEL_DO_NOT_USE, LEVEL_WITH_CARE) and f not in of_table]
        lines += [f"! {g.first_finding}{g.count}" for g in group_findings(of_model)] + [f"! {f}" for f in of_table]
        return "\n".join([*lines, *wrap_text(self.next_step, "next: ")])

    @property
    def next_step(self) -> str:
        """Text that suggests the next call or a remedy after the search."""
        if self.verdict is None:
            return choose_text(
                "search_orders(…) with the runs and this store, which judges rank 1",
                "the ftlm search command with its files and this store, which judges rank 1",
            )
        if self.verdict.level == LEVEL_DO_NOT_USE and self.verdict.remedy:
            return self.verdict.remedy
        return choose_text(
            "identify(runs, equation), which estimates orders between those of the grid with their intervals",
            "ftlm identify with the same FILE and --structure, which estimates orders between those of the grid with "
            "their intervals",
        )


def _is_same_model(row: SearchRow, other: SearchRow) -> bool:
    """Whether scores and coefficients of two rows agree within the relative difference `SAME_MODEL_TOLERANCE`."""
    pairs = [(row.score, other.score), *((v, other.coefficients[n]) for n, v in row.coefficients.items())]
    return all(math.isclose(a, b, rel_tol=SAME_MODEL_TOLERANCE) for a, b in pairs)


@dataclass(frozen=True)
class StoreStatus:
    """Progress of a search in a checkpoint file.

    Parameters
    ----------
    name
        Output of the searched equation, or ``"stage"`` for coupled equations.
    candidates
        Total number of candidates. Under an order law it is the number of candidates of the separate equations that
        must be evaluated, as far as it is known.
    done_count
        Number of candidates that were evaluated or excluded.
    best
        Best score up to now, in the measure of :attr:`SearchRow.score`. None before the first score.
    settings
        Options by name, such as criterion, norm and coefficient estimator.
    runs
        Names of the runs.
    version
        Version of ftlm that created the file.
    corruption
        Description of damage to the file, with the number of the damaged record; None for an intact file.
    """

    name: str
    candidates: int
    done_count: int
    best: float | None
    settings: dict[str, Any]
    runs: tuple[str, ...]
    version: str
    corruption: str | None

    @property
    def complete(self) -> bool:
        """Whether all candidates were evaluated or excluded."""
        return self.done_count == self.candidates

    def to_dict(self) -> dict[str, Any]:
        """Return the status as a dictionary for JSON."""
        return {**asdict(self), "complete": self.complete}

    def __str__(self) -> str:
        percent = 100 * self.done_count / self.candidates
        text = f"{self.name}: {self.done_count} of {self.candidates} candidates done ({percent:.1f} %)"
        text += "" if self.best is None else f", best score {self.best:.6g}"
        text += f", runs {', '.join(self.runs)}"
        if self.corruption is not None:
            text += f"\ndamaged: {self.corruption}; resume with {parameter('recover', True)} to keep what stands before"
        return text


def search_summary(searches: Mapping[str, SearchResult]) -> Table:
    """Return a report table of the numbers of listed and excluded candidates (by reason), one row per search."""
    reasons = list(dict.fromkeys(reason for s in searches.values() for reason in s.exclusion_counts))
    rows: list[list[Cell]] = [
        [
            _search_name(name),
            s.settings["criterion"],
            s.candidates,
            len(s.table),
            *(s.exclusion_counts.get(reason, 0) for reason in reasons),
        ]
        for name, s in searches.items()
    ]
    return Table(
        "Outcome of the candidates",
        ("search", "ranked by", "candidates", "kept", *reasons),
        rows,
        groups=(("", 4), ("left out", len(reasons))) if reasons else (),
        note="Every candidate of the order grid is kept or counted under a reason. “beaten” and “stopped early” were "
        "worse than the last row kept."
        + "".join(
            f" Of the {number(s.exclusion_counts['bound'])} under “bound” of {_search_name(name)}, "
            f"{number(s.excluded_by_box)} are in boxes of orders that one bound excludes whole."
            for name, s in searches.items()
            if s.excluded_by_box
        ),
    )


def search_top(name: str, search: SearchResult) -> Table:
    """Return a report table of the best candidates of an order search: rank, score, orders, coefficients.

    Parameters
    ----------
    name
        Output of the searched equation, or ``"stage"`` for coupled equations; shown in the title.
    search
        Result of the search.
    """
    law = len(search.model.equations) > 1
    score = {"l1": "error (45)", "l2": "RMSE"}.get(search.settings["norm"], "score")
    orders, coefficients = list(search.orders), list(search.coefficients)
    rows_shown = search.table[:MAX_REPORT_ROWS]
    return Table(
        f"Best {len(rows_shown)} of {number(search.candidates)} candidates: {_search_name(name)}",
        ("rank", "score" if law else score, *map(symbol_html, orders), *map(symbol_html, coefficients)),
        [
            [r.rank, r.score, *(Exact(r.orders[n]) for n in orders), *(r.coefficients[n] for n in coefficients)]
            for r in rows_shown
        ],
        groups=(("", 2), ("orders", len(orders)), ("coefficients", len(coefficients))),
        note=f"The score is the sum over the equations of each one's {score}, divided by the spread of its output."
        if law
        else "",
    )


def _search_name(name: str) -> str:
    return "whole stage, under its order law" if name == "stage" else symbol(name)


def search_html(result: SearchResult) -> str:
    """Return an order search as HTML: table of the best rows, and numbers of excluded candidates by reason."""
    rows: list[list[Cell]] = [["kept", len(result.table)]]
    for reason, count in result.exclusion_counts.items():
        rows.append([reason, count])
        if reason == "bound" and result.excluded_by_box:
            rows.append(["of these in boxes excluded whole", result.excluded_by_box])
    name = result.model.outputs[0] if len(result.model.outputs) == 1 else "stage"
    outcome_table = Table(f"{result.candidates} candidates", ("outcome", "count"), rows)
    return str(search_top(name, result).to_html() + outcome_table.to_html())
