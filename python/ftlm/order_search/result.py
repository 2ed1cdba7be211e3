"""Certificate of an order search."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from ftlm.findings import Finding, make_finding
from ftlm.model.model import Model
from ftlm.svg.html_page import Table
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, Exact, number, symbol, symbol_html
from ftlm.utils.parameters import parameter


@dataclass(frozen=True)
class OrderCertificate:
    """Lower bound of the equation error over all orders in some intervals.

    Parameters
    ----------
    lower_bound
        No orders of the intervals have a smaller RMS equation error, with any coefficients whose terms do not exceed
        `max_term_ratio`, in exact arithmetic on the pulse means; 0 if nothing is proved.
    best
        Smallest error found; infinite if none was found.
    orders
        Free orders of that error, by name.
    requested_tolerance
        Requested tolerance: by what fraction the error of other orders might be smaller.
    intervals
        Lowest and highest value of each free order.
    min_separation
        Minimum distance of orders of the output from its highest one, and of orders of one signal from one another.
    max_term_ratio
        Maximum RMS size of all terms of an equation together, relative to that of the output.
    cells
        Number of boxes of orders that were bounded.
    open_cells
        Number of boxes whose bound misses the requested tolerance, too small to be halved or beyond the maximum.
    m
        Block pulses per run.
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

    @property
    def proved_tolerance(self) -> float:
        """Tolerance achieved: by what fraction other orders may be better; 1 if nothing is proved."""
        return max(0.0, 1 - self.lower_bound / self.best)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "lower_bound": self.lower_bound,
            "best": self.best if self.orders else None,
            "proved_tolerance": self.proved_tolerance,
            "requested_tolerance": self.requested_tolerance,
            "orders": self.orders,
            "intervals": {name: list(interval) for name, interval in self.intervals.items()},
            "min_separation": self.min_separation,
            "max_term_ratio": self.max_term_ratio,
            "cells": self.cells,
            "open_cells": self.open_cells,
            "m": self.m,
        }

    def __str__(self) -> str:
        intervals = ", ".join(f"{n} from {low:g} to {high:g}" for n, (low, high) in self.intervals.items())
        separation = f"{self.min_separation:g}"
        apart = f"orders of the output {separation} below its highest, of one signal {separation} apart"
        found = ", ".join(f"{name} {value:.5g}" for name, value in self.orders.items())
        cells = f"{self.cells} boxes of orders"
        if self.lower_bound == 0:
            return (
                f"certificate: nothing is proved of all orders with {intervals} ({apart}): {self.open_cells} of "
                f"{cells} are "
                "left; narrow the intervals, keep orders farther apart, or allow more boxes"
            )
        # Rounded up: a share that is said must be true.
        share = math.ceil(1000 * self.proved_tolerance - 1e-4) / 10
        text = (
            f"certificate: no orders with {intervals} ({apart}), on a lattice or between, leave an RMS equation error "
            f"below {self.lower_bound:.5g} with coefficients whose terms are together at most "
            f"{self.max_term_ratio:g} times the "
            f"output; {found} leave {self.best:.5g}, so nothing is better by more than {share:g} % ({cells})"
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
        From 1.
    index
        Index of the candidate in the order grid; breaks ties.
    score
        Its score: error (45) for norm l1, RMSE for l2; for a stage the sum of the equations' scores, each divided by
        its scale.
    orders
        Free orders by name.
    coefficients
        Coefficients by name.
    """

    rank: int
    index: int
    score: float
    orders: dict[str, float]
    coefficients: dict[str, float]


@dataclass(frozen=True)
class SearchResult:
    """Table of an order search, best first, with its best model, and counts of the excluded candidates.

    Parameters
    ----------
    table
        Kept rows, best first.
    model
        Model of the first row.
    candidates
        Number of candidates.
    exclusion_counts
        Number of candidates not in the table, by reason: "beaten" (fully evaluated), "bound" (excluded by a lower bound
        of their score), "stopped early" (excluded by a partial sum), "singular", "diverged". With the rows of the table
        they add up to all candidates. An excluded candidate might have diverged in a full evaluation.
    failures
        The first candidates without a score: (orders by name, reason).
    m
        Block pulses per run.
    settings
        Criterion, norm, coefficients, innovation length, prior covariance, rows, initial terms.
    at_grid_edge
        Orders of the first row at an end of their interval, by name.
    excluded_by_box
        Number of candidates under "bound" that were excluded with a whole box of orders.
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

    @property
    def orders(self) -> dict[str, float]:
        """Free orders of the best model."""
        return self.table[0].orders

    @property
    def coefficients(self) -> dict[str, float]:
        """Coefficients of the best model."""
        return self.table[0].coefficients

    @property
    def score(self) -> float:
        """Score of the best model."""
        return self.table[0].score

    def _repr_html_(self) -> str:
        return search_html(self)

    @property
    def excluded_summary(self) -> str:
        """Text with the counts of the excluded candidates, by reason."""
        told = {reason: f"{count} {reason}" for reason, count in self.exclusion_counts.items() if count}
        if self.excluded_by_box:
            told["bound"] += f" ({self.excluded_by_box} of them in boxes excluded whole)"
        return "".join(f", {words}" for words in told.values())

    def to_frame(self) -> Any:
        """Return the ranked table as a pandas frame, by rank."""
        rows = [{"rank": r.rank, "score": r.score, **r.orders, **r.coefficients} for r in self.table]
        return to_frame(rows, ["rank"])

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "candidates": self.candidates,
            "exclusion_counts": self.exclusion_counts,
            "excluded_by_box": self.excluded_by_box,
            "m": self.m,
            "settings": self.settings,
            "table": [dict(vars(row)) for row in self.table],
            "failures": [{"orders": o, "reason": reason} for o, reason in self.failures],
            "at_grid_edge": self.at_grid_edge,
        }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings on the best orders: those on the edge of their interval."""
        return tuple(make_finding("on_edge", parameter=n, value=v) for n, v in self.at_grid_edge.items())

    def __str__(self) -> str:
        names, coefficients = list(self.orders), list(self.coefficients)
        what = "error" if self.settings["norm"] == "l1" else "RMSE"
        head = f"{'rank':>4}{what:>12}" + "".join(f"{n:>9}" for n in names) + "".join(f"{n:>12}" for n in coefficients)
        lines = [head]
        for row in self.table:
            orders = "".join(f"{row.orders[n]:>9.5g}" for n in names)
            values = "".join(f"{row.coefficients[n]:>12.5g}" for n in coefficients)
            lines.append(f"{row.rank:>4}{row.score:>12.5g}{orders}{values}")
        lines.append(f"{self.candidates} candidates: {len(self.table)} kept{self.excluded_summary}")
        lines += [f"warning: {f}" for f in self.findings]
        return "\n".join(lines)


@dataclass(frozen=True)
class StoreStatus:
    """Progress of a search in a checkpoint file.

    Parameters
    ----------
    name
        Output that was searched, or ``"stage"``.
    candidates
        Total number of candidates. Under an order law those of the single equations, as far as known: one that was
        stopped early may have to be evaluated further.
    done_count
        Number of candidates evaluated or excluded.
    best
        Best score so far: error (45) for norm l1, RMSE for l2; None before the first.
    settings
        Criterion, norm, coefficients.
    runs
        Names of the runs.
    version
        Version of ftlm that created the file.
    truncated
        Bytes of an unfinished write at its end.
    corruption
        Description of corrupt data with its offset, or None.
    """

    name: str
    candidates: int
    done_count: int
    best: float | None
    settings: dict[str, Any]
    runs: tuple[str, ...]
    version: str
    truncated: int
    corruption: str | None

    @property
    def complete(self) -> bool:
        """Whether the search is complete."""
        return self.done_count == self.candidates

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "complete": self.complete}

    def __str__(self) -> str:
        share = 100 * self.done_count / self.candidates
        text = f"{self.name}: {self.done_count} of {self.candidates} candidates done ({share:.1f} %)"
        text += "" if self.best is None else f", best score {self.best:.6g}"
        text += f", runs {', '.join(self.runs)}"
        if self.truncated:
            text += (
                f"\n{self.truncated} bytes of an unfinished write at its end: being written now, or dropped on resuming"
            )
        if self.corruption is not None:
            text += f"\ndamaged: {self.corruption}; resume with {parameter('recover', True)} to keep what stands before"
        return text


def search_summary(searches: Mapping[str, SearchResult], *, title: str = "What became of the candidates") -> Table:
    """Return a table of kept and excluded candidates, by reason; together they are all candidates."""
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
        title,
        ("search", "ranked by", "candidates", "kept", *reasons),
        rows,
        groups=(("", 4), ("left out", len(reasons))) if reasons else (),
        note="Every candidate of the lattice is kept or counted under a reason. “beaten” and “stopped early” were "
        "worse than the last row kept."
        + "".join(
            f" Of the {number(s.exclusion_counts['bound'])} under “bound” of {_search_name(name)}, "
            f"{number(s.excluded_by_box)} are in "
            "boxes of orders that one bound excludes whole."
            for name, s in searches.items()
            if s.excluded_by_box
        ),
    )


def search_top(name: str, search: SearchResult, *, rows: int = 10, title: str = "") -> Table:
    """Return the first rows of an order search.

    Parameters
    ----------
    name
        Output searched, or ``"stage"``.
    search
        The search.
    rows
        Most rows.
    title
        Caption; by default it names the search.
    """
    law = len(search.model.equations) > 1
    score = {"l1": "error (45)", "l2": "RMSE"}.get(search.settings["norm"], "score")
    orders, coefficients = list(search.orders), list(search.coefficients)
    kept = search.table[:rows]
    return Table(
        title or f"Best {len(kept)} of {number(search.candidates)} candidates: {_search_name(name)}",
        ("rank", "score" if law else score, *map(symbol_html, orders), *map(symbol_html, coefficients)),
        [
            [r.rank, r.score, *(Exact(r.orders[n]) for n in orders), *(r.coefficients[n] for n in coefficients)]
            for r in kept
        ],
        groups=(("", 2), ("orders", len(orders)), ("coefficients", len(coefficients))),
        note=f"The score is the sum over the equations of each one's {score}, divided by the spread of its output."
        if law
        else "",
    )


def _search_name(name: str) -> str:
    return "whole stage, under its order law" if name == "stage" else symbol(name)


def search_html(found: SearchResult) -> str:
    """Return the best rows of an order search and the counts of the excluded candidates."""
    rows: list[list[Cell]] = [["kept", len(found.table)]]
    for reason, count in found.exclusion_counts.items():
        rows.append([reason, count])
        if reason == "bound" and found.excluded_by_box:
            rows.append(["of these in boxes excluded whole", found.excluded_by_box])
    name = found.model.outputs[0] if len(found.model.outputs) == 1 else "stage"
    rest = Table(f"{found.candidates} candidates", ("became of them", "count"), rows)
    return str(search_top(name, found).to_html() + rest.to_html())
