"""An order search ready to be done: one equation, or a stage under its order law."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from typing import cast

import numpy as np
from msgspec import UNSET

from ftlm import _core
from ftlm.base.errors import ModelError
from ftlm.data.lattice import axis_of
from ftlm.data.orders import Order
from ftlm.data.settings import Settings
from ftlm.data.structures import Structure
from ftlm.model.model import Model
from ftlm.search.frames import RecordFile, Request
from ftlm.search.result import SearchResult, SearchRow
from ftlm.search.rounds import do_rounds, do_stage
from ftlm.search.store import Store
from ftlm.search.work import StageWork, Work
from ftlm.solve.records import Record, initial_tuple, named_coefficients, named_signals


@dataclass(frozen=True)
class Job:
    """What a search works on."""

    runs: tuple[str, ...]
    units: Mapping[str, str]
    structure: Structure
    values: Mapping[str, tuple[float, ...]]
    records: list[Record]
    settings: Settings
    progress: Callable[[int, int, int], None] | None

    @property
    def name(self) -> str:
        """What its result is called among others."""
        return "stage" if self.structure.has_order_law else self.structure.outputs[0]

    def request(self, name: str) -> Request:
        """As a store keeps it."""
        settings = {f.name: getattr(self.settings, f.name) for f in fields(self.settings) if f.name != "threads"}
        records = tuple(RecordFile.of(r) for r in self.records)
        # Hints are not written: they tell a fit where to start and change no search.
        structure = replace(self.structure, hints=UNSET)
        return Request(name, structure, dict(self.values), settings, records, self.runs, dict(self.units))

    @classmethod
    def of(cls, request: Request, threads: int, progress: Callable[[int, int, int], None] | None) -> Job:
        """From a store.

        Raises
        ------
        ModelError
            A request that is none.
        """
        s = request.settings
        try:
            settings = Settings.check(
                cast("str", s["criterion"]), cast("str", s["norm"]), cast("str", s["coefficients"]),
                cast("int", s["innovation_length"]), cast("float", s["prior_covariance"]), cast("str", s["rows"]),
                cast("int", s["keep"]), threads, bool(s["early_stopping"]),
            )  # fmt: skip
        except KeyError as error:
            raise ModelError(f"setting {error} is missing") from None
        records = [r.record() for r in request.records]
        structure = request.structure
        signals = structure.signals
        if not records or (len(structure.equations) != 1 and not structure.has_order_law):
            raise ModelError("it is not the search of one equation, or of some under a law, on a record")
        if any(r.signals != signals or r.inputs != records[0].inputs for r in records):
            raise ModelError("its records do not hold the signals of its equation")
        if any(n not in request.values for n in structure.order_names):
            raise ModelError("an order has no values")
        return cls(request.runs, request.units, structure, request.values, records, settings, progress)

    def work(self) -> tuple[Work, list[str]]:
        """As rounds are computed from it, and the signals by number."""
        item, first = self.structure.equations[0], self.records[0]
        signals = list(first.signals)
        axes = [
            (signals.index(t.signal), axis_of(t.order, self.values), bool(t.order.names) and t.fixed is None)
            for t in item.terms
        ]
        orders = (signals.index(item.output), axis_of(item.order, self.values), axes)
        work = Work(
            tuple(r.core() for r in self.records), orders, list(first.inputs), [t.fixed for t in item.terms],
            initial_tuple(first.initial), self.settings.core(),
        )  # fmt: skip
        return work, signals

    def stage_work(self) -> tuple[StageWork, list[str]]:
        """As the search of a stage is computed from it, and the free orders by number."""
        structure, records, settings = self.structure, self.records, self.settings
        names = list(structure.order_names)
        signals = records[0].signals

        def affine(order: Order) -> tuple[float, list[float]]:
            weights = dict(order.weights)
            return order.constant, [weights.get(n, 0.0) for n in names]

        laws = [
            (signals.index(e.output), affine(e.order), [(signals.index(t.signal), affine(t.order)) for t in e.terms])
            for e in structure.equations
        ]
        # Each output's deviation makes radians of hub and of deflection weigh alike.
        points = sum(r.m for r in records)
        with np.errstate(over="ignore", invalid="ignore"):
            spread = [
                math.sqrt(sum(float(((r.of(e.output) - r.of(e.output).mean()) ** 2).sum()) for r in records) / points)
                for e in structure.equations
            ]
        for item, size in zip(structure.equations, spread, strict=True):
            if not 0 < size < math.inf:
                raise ModelError(
                    f"the deviation of {item.output} is {size:g}; scale it so that its squares are numbers"
                )
        work = StageWork(
            tuple(r.core() for r in records), [list(self.values[n]) for n in names], laws, list(records[0].inputs),
            [[t.fixed for t in e.terms] for e in structure.equations],
            [s * points if settings.norm == "l1" else s for s in spread],
            initial_tuple(records[0].initial), settings.core(),
        )  # fmt: skip
        return work, names


def run_job(job: Job, *, store: Store | None = None, number: int = 0, executor: Executor | None = None) -> SearchResult:
    """Search; with a store, as search `number` of it.

    Raises
    ------
    DataError, ModelError, ConvergenceError, KeyboardInterrupt
        As :func:`search_orders`.
    """
    if job.structure.has_order_law:
        return _search_law(job, store, number, executor)
    return _search_one(job, store, number, executor)


def _search_one(job: Job, store: Store | None, number: int, executor: Executor | None) -> SearchResult:
    item = job.structure.equations[0]
    work, signals = job.work()
    try:
        if store is None and executor is None:
            found = _core.search(
                list(work.runs), work.orders, work.inputs, work.fixed, work.initial, work.settings, job.progress
            )
        else:
            parts = do_rounds(
                work, store=store, number=number, executor=executor, threads=job.settings.threads, progress=job.progress
            )
            found = work.join(parts)
    except ModelError as error:
        raise named_signals(error, signals) from None

    def named(alpha: float, orders: list[float]) -> dict[str, float]:
        pairs = zip((item.order, *(t.order for t in item.terms)), (alpha, *orders), strict=True)
        return {o.names[0]: v for o, v in pairs if o.names}

    table = [
        SearchRow(rank, index, score, named(alpha, orders), named_coefficients(item, c))
        for rank, (index, score, alpha, orders, c, _) in enumerate(found["rows"], 1)
    ]
    failures = [(named(alpha, orders), str(reason)) for _, alpha, orders, reason in found["failures"]]
    return _result(job, table, dict(cast("Mapping[str, int]", found["counts"])), failures)


def _search_law(job: Job, store: Store | None, number: int, executor: Executor | None) -> SearchResult:
    structure = job.structure
    work, names = job.stage_work()
    if store is None and executor is None:
        found = work.search(job.progress)
    else:
        found = do_stage(
            work, store=store, number=number, executor=executor, threads=job.settings.threads, progress=job.progress
        )
    table = []
    for rank, (index, score, free, parts) in enumerate(found["rows"], 1):
        coefficients: dict[str, float] = {}
        for item, (_, _, _, c, _) in zip(structure.equations, parts, strict=True):
            coefficients |= named_coefficients(item, c)
        table.append(SearchRow(rank, index, score, dict(zip(names, free, strict=True)), coefficients))
    failures = [(dict(zip(names, free, strict=True)), str(reason)) for _, free, reason in found["failures"]]
    return _result(job, table, dict(cast("Mapping[str, int]", found["counts"])), failures)


def _result(
    job: Job, table: list[SearchRow], counts: Mapping[str, int], failures: list[tuple[dict[str, float], str]]
) -> SearchResult:
    structure, values, settings = job.structure, job.values, job.settings
    m = job.records[0].m
    if not table:
        raise ModelError(f"none of {counts['candidates']} candidates has a finite score; check the data and the orders")
    best = table[0]
    model = Model(
        structure.with_orders(best.orders).with_coefficients(best.coefficients),
        orders=best.orders,
        units=job.units,
        m=m,
        about={"runs": ", ".join(job.runs), "orders from": "order search", **settings.to_dict()},
    )
    edges = {
        n: v for n, v in best.orders.items() if len(values[n]) > 2 and v in (values[n][0], values[n][-1]) and v != 0
    }
    # alpha = 2 is where the physics puts it, not an accident of the interval.
    edges = {n: v for n, v in edges.items() if not (v == 2.0 and n in _highest(structure))}
    pruned = {k: int(v) for k, v in counts.items() if k not in ("candidates", "kept")}
    return SearchResult(table, model, int(counts["candidates"]), pruned, failures, m, settings.to_dict(), edges)


def _highest(structure: Structure) -> set[str]:
    return {n for e in structure.equations for n in e.order.names}
