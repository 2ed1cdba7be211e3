"""What a certificate over all orders says."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from ftlm.model.model import Model
from ftlm.svg.html_page import Table
from ftlm.utils.files import to_frame
from ftlm.utils.formatting import Cell, Exact, number, symbol, symbol_html


@dataclass(frozen=True)
class OrderCertificate:
    """What is proved of the equation errors of all orders in some intervals.

    Parameters
    ----------
    at_least
        No orders of the intervals leave a smaller RMS equation error, with any coefficients whose terms are not beyond
        `largest`, in exact arithmetic on the pulse means; 0 where nothing is proved.
    best
        The smallest that was found on the way, infinite where none was.
    orders
        Where that is: free orders by name.
    asked
        How much better than that other orders might have been, as a share.
    intervals
        Lowest and highest value of each free order.
    apart
        How far orders of the output stay below its highest one, and orders of one signal from one another.
    largest
        How many times the RMS size of the output those of an equation's terms have together at most.
    cells
        Boxes of orders that were bounded.
    open
        Those of them whose bound is lower than was asked for, too small to be halved or one too many.
    m
        Block pulses a run.
    """

    at_least: float
    best: float
    orders: dict[str, float]
    asked: float
    intervals: dict[str, tuple[float, float]]
    apart: float
    largest: float
    cells: int
    open: int
    m: int

    @property
    def within(self) -> float:
        """By what share of the best found other orders may be better: 1 where nothing is proved."""
        return max(0.0, 1 - self.at_least / self.best)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "at_least": self.at_least,
            "best": self.best if self.orders else None,
            "within": self.within,
            "asked": self.asked,
            "orders": self.orders,
            "intervals": {name: list(interval) for name, interval in self.intervals.items()},
            "apart": self.apart,
            "largest": self.largest,
            "cells": self.cells,
            "open": self.open,
            "m": self.m,
        }

    def __str__(self) -> str:
        intervals = ", ".join(f"{n} from {low:g} to {high:g}" for n, (low, high) in self.intervals.items())
        apart = f"orders of the output {self.apart:g} below its highest, of one signal {self.apart:g} apart"
        found = ", ".join(f"{name} {value:.5g}" for name, value in self.orders.items())
        cells = f"{self.cells} boxes of orders"
        if self.at_least == 0:
            return (
                f"certificate: nothing is proved of all orders with {intervals} ({apart}): {self.open} of {cells} are "
                "left; narrow the intervals, keep orders farther apart, or allow more boxes"
            )
        # Rounded up: a share that is said must be true.
        share = math.ceil(1000 * self.within - 1e-4) / 10
        text = (
            f"certificate: no orders with {intervals} ({apart}), on a lattice or between, leave an RMS equation error "
            f"below {self.at_least:.5g} with coefficients whose terms are together at most {self.largest:g} times the "
            f"output; {found} leave {self.best:.5g}, so nothing is better by more than {share:g} % ({cells})"
        )
        if self.open:
            text += f"; {100 * self.asked:g} % was asked for, and {self.open} boxes were too small to halve or too many"
        return text


@dataclass(frozen=True)
class SearchRow:
    """One kept candidate.

    Parameters
    ----------
    rank
        From 1.
    index
        Index of the candidate in the lattice, by which ties are broken.
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
    """A ranked table, the best model and what became of every candidate.

    Parameters
    ----------
    table
        Kept rows, best first.
    model
        Model of the first row.
    candidates
        Number of candidates.
    pruned
        Candidates not in the table, by reason: "beaten" (run to the end), "bound" (excluded by a lower bound of their
        score), "stopped early" (left at a partial sum), "singular", "diverged". Kept rows and these are all candidates.
        One that was excluded or left early might have diverged had it been run.
    failures
        The first candidates without a score: (orders by name, reason).
    m
        Block pulses a run.
    settings
        Criterion, norm, coefficients, innovation length, prior covariance, rows, initial terms.
    edges
        Orders of the first row that stand on the edge of their interval, by name with the edge.
    boxed
        Of those under "bound", the candidates whose whole box of orders was excluded by one bound.
    certificate
        What is proved of the orders between the lattice's, where that was asked for (``ftlm search --certify``,
        :func:`ftlm.certify_orders`).
    """

    table: list[SearchRow]
    model: Model
    candidates: int
    pruned: dict[str, int]
    failures: list[tuple[dict[str, float], str]]
    m: int
    settings: dict[str, Any]
    edges: dict[str, float]
    boxed: int = 0
    certificate: OrderCertificate | None = None

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
    def left_out(self) -> str:
        """What became of the candidates that are not in the table, in words."""
        told = {reason: f"{count} {reason}" for reason, count in self.pruned.items() if count}
        if self.boxed:
            told["bound"] += f" ({self.boxed} of them in boxes excluded whole)"
        return "".join(f", {words}" for words in told.values())

    def to_frame(self) -> Any:
        """The ranked table as a pandas frame, by rank."""
        rows = [{"rank": r.rank, "score": r.score, **r.orders, **r.coefficients} for r in self.table]
        return to_frame(rows, ["rank"])

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "candidates": self.candidates,
            "pruned": self.pruned,
            "boxed": self.boxed,
            "m": self.m,
            "settings": self.settings,
            "table": [dict(vars(row)) for row in self.table],
            "failures": [{"orders": o, "reason": reason} for o, reason in self.failures],
            "edges": self.edges,
        } | ({} if self.certificate is None else {"certificate": self.certificate.to_dict()})

    def __str__(self) -> str:
        names, coefficients = list(self.orders), list(self.coefficients)
        what = "error" if self.settings["norm"] == "l1" else "RMSE"
        head = f"{'rank':>4}{what:>12}" + "".join(f"{n:>9}" for n in names) + "".join(f"{n:>12}" for n in coefficients)
        lines = [head]
        for row in self.table:
            orders = "".join(f"{row.orders[n]:>9.5g}" for n in names)
            values = "".join(f"{row.coefficients[n]:>12.5g}" for n in coefficients)
            lines.append(f"{row.rank:>4}{row.score:>12.5g}{orders}{values}")
        lines.append(f"{self.candidates} candidates: {len(self.table)} kept{self.left_out}")
        lines += [f"warning: order {n} = {v:g} is on the edge of its interval; widen it" for n, v in self.edges.items()]
        if self.certificate is not None:
            lines.append(str(self.certificate))
        return "\n".join(lines)


@dataclass(frozen=True)
class StoreStatus:
    """How far a search in a store is.

    Parameters
    ----------
    name
        Output that was searched, or ``"stage"``.
    candidates
        Candidates in all. Under an order law those of the equations one by one, as far as is known: one that was left
        early may have to be followed further.
    done
        Candidates dealt with.
    best
        Best score so far: error (45) for norm l1, RMSE for l2; None before the first.
    settings
        Criterion, norm, coefficients.
    runs
        Names of the runs.
    version
        Version of ftlm that began the store.
    torn
        Bytes of an unfinished write at its end.
    damage
        What is damaged, with its offset, or None.
    """

    name: str
    candidates: int
    done: int
    best: float | None
    settings: dict[str, Any]
    runs: tuple[str, ...]
    version: str
    torn: int
    damage: str | None

    @property
    def complete(self) -> bool:
        """Whether nothing is left to do."""
        return self.done == self.candidates

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "complete": self.complete}

    def __str__(self) -> str:
        share = 100 * self.done / self.candidates
        text = f"{self.name}: {self.done} of {self.candidates} candidates done ({share:.1f} %)"
        text += "" if self.best is None else f", best score {self.best:.6g}"
        text += f", runs {', '.join(self.runs)}"
        if self.torn:
            text += f"\n{self.torn} bytes of an unfinished write at its end: being written now, or dropped on resuming"
        if self.damage is not None:
            text += f"\ndamaged: {self.damage}; resume with --salvage to keep what stands before"
        return text


def search_summary(searches: Mapping[str, SearchResult], *, title: str = "What became of the candidates") -> Table:
    """Return what became of every candidate: kept, or left out for a reason; kept and left out are all candidates."""
    reasons = list(dict.fromkeys(reason for s in searches.values() for reason in s.pruned))
    rows: list[list[Cell]] = [
        [
            _search_name(name),
            s.settings["criterion"],
            s.candidates,
            len(s.table),
            *(s.pruned.get(reason, 0) for reason in reasons),
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
            f" Of the {number(s.pruned['bound'])} under “bound” of {_search_name(name)}, {number(s.boxed)} are in "
            "boxes of orders that one bound excludes whole."
            for name, s in searches.items()
            if s.boxed
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
    """Return the best rows of an order search and what became of the rest."""
    rows: list[list[Cell]] = [["kept", len(found.table)]]
    for reason, count in found.pruned.items():
        rows.append([reason, count])
        if reason == "bound" and found.boxed:
            rows.append(["of these in boxes excluded whole", found.boxed])
    name = found.model.outputs[0] if len(found.model.outputs) == 1 else "stage"
    note = "" if found.certificate is None else str(found.certificate)
    rest = Table(f"{found.candidates} candidates", ("became of them", "count"), rows, note=note)
    return str(search_top(name, found).to_html() + rest.to_html())
