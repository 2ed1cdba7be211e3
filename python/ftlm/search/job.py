"""An order search ready to be done: one equation, or a stage under its order law."""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, fields, replace
from typing import Any, cast

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
from ftlm.search.rounds import search_equation, search_stage
from ftlm.search.store import Store
from ftlm.search.work import CoreRecord, EquationWork, StageWork, Told
from ftlm.solve.records import InitialTuple, Record, named_coefficients, named_signals

#: Settings that tell one search from another; threads make no difference to it.
KEPT = tuple(f.name for f in fields(Settings) if f.name != "threads")
Failures = list[tuple[dict[str, float], str]]


@dataclass(frozen=True)
class Job:
    """What a search works on."""

    runs: tuple[str, ...]
    units: Mapping[str, str]
    structure: Structure
    values: Mapping[str, tuple[float, ...]]
    records: list[Record]
    settings: Settings
    progress: Told | None

    @property
    def name(self) -> str:
        """What its result is called among others."""
        return "stage" if self.structure.has_order_law else self.structure.outputs[0]

    def request(self, name: str) -> Request:
        """As a store keeps it."""
        settings = {n: getattr(self.settings, n) for n in KEPT}
        records = tuple(RecordFile.of(r) for r in self.records)
        # Hints are not written: they tell a fit where to start and change no search.
        structure = replace(self.structure, hints=UNSET)
        # The records say it, where there is one: what has none is written as it always was.
        object.__setattr__(structure, "offset", UNSET)
        return Request(name, structure, dict(self.values), settings, records, self.runs, dict(self.units))

    @classmethod
    def of(cls, request: Request, threads: int, progress: Told | None) -> Job:
        """From a store; refuse a request that is none."""
        try:
            kept: dict[str, Any] = {n: request.settings[n] for n in KEPT}
        except KeyError as error:
            raise ModelError(f"setting {error} is missing") from None
        settings = Settings.check(**kept | {"threads": threads, "early_stopping": bool(kept["early_stopping"])})
        records = [r.record() for r in request.records]
        structure = replace(request.structure, offset=records[0].offset if records else "none")
        signals = structure.signals
        if not records or (len(structure.equations) != 1 and not structure.has_order_law):
            raise ModelError("it is not the search of one equation, or of some under a law, on a record")
        if any(r.signals != signals or r.inputs != records[0].inputs for r in records):
            raise ModelError("its records do not hold the signals of its equation")
        if any(n not in request.values for n in structure.order_names):
            raise ModelError("an order has no values")
        return cls(request.runs, request.units, structure, request.values, records, settings, progress)

    def _recorded(self) -> tuple[tuple[CoreRecord, ...], list[bool], InitialTuple, Settings]:
        record = self.records[0]
        runs = tuple(r.core() for r in self.records)
        return runs, list(record.inputs), record.start, self.settings

    def equation_work(self) -> EquationWork:
        """What the rounds of one equation are computed from."""
        item, signals = self.structure.equations[0], self.records[0].signals
        axes = [
            (signals.index(t.signal), axis_of(t.order, self.values), bool(t.order.names) and t.fixed is None)
            for t in item.terms
        ]
        return EquationWork(
            *self._recorded(),
            orders=(signals.index(item.output), axis_of(item.order, self.values), axes),
            fixed=[t.fixed for t in item.terms],
        )  # fmt: skip

    def stage_work(self) -> StageWork:
        """What the search of a stage is computed from."""
        structure, signals = self.structure, self.records[0].signals
        names = structure.order_names

        def affine(order: Order) -> tuple[float, list[float]]:
            weights = dict(order.weights)
            return order.constant, [weights.get(n, 0.0) for n in names]

        laws = [
            (signals.index(e.output), affine(e.order), [(signals.index(t.signal), affine(t.order)) for t in e.terms])
            for e in structure.equations
        ]
        points = sum(r.m for r in self.records)
        return StageWork(
            *self._recorded(),
            axes=[list(self.values[n]) for n in names],
            laws=laws,
            fixed=[[t.fixed for t in e.terms] for e in structure.equations],
            scales=[s * points if self.settings.norm == "l1" else s for s in self._spreads(points)],
        )  # fmt: skip

    def _spreads(self, points: int) -> list[float]:
        """Each output's deviation, which makes radians of hub and of deflection weigh alike."""
        spreads = []
        for output in self.structure.outputs:
            with np.errstate(over="ignore", invalid="ignore"):
                squares = sum(float(((r.of(output) - r.of(output).mean()) ** 2).sum()) for r in self.records)
            spread = math.sqrt(squares / points)
            if not 0 < spread < math.inf:
                raise ModelError(f"the deviation of {output} is {spread:g}; scale it so that its squares are numbers")
            spreads.append(spread)
        return spreads


def run_job(job: Job, *, store: Store | None = None, number: int = 0, executor: Executor | None = None) -> SearchResult:
    """Search; with a store, as search `number` of it."""
    if executor is not None and not isinstance(executor, Executor):
        raise ModelError(
            f"executor = {executor!r} is no executor of concurrent.futures; pass ProcessPoolExecutor(…) or "
            "Client(…).get_executor()"
        )
    if job.structure.has_order_law:
        stage = search_stage(job.stage_work(), store=store, number=number, executor=executor, progress=job.progress)
        return _result(job, *_stage_rows(job.structure, stage), stage["counts"], 0)
    try:
        one = search_equation(job.equation_work(), store=store, number=number, executor=executor, progress=job.progress)
    except ModelError as error:
        raise named_signals(error, job.records[0].signals) from None
    return _result(job, *_equation_rows(job.structure, one), one["counts"], one["boxed"])


def _equation_rows(structure: Structure, found: _core._Found) -> tuple[list[SearchRow], Failures]:
    """Rows and failures of one equation by the names of its orders and coefficients."""
    item = structure.equations[0]

    def named(alpha: float, orders: list[float]) -> dict[str, float]:
        pairs = zip((item.order, *(t.order for t in item.terms)), (alpha, *orders), strict=True)
        return {o.names[0]: v for o, v in pairs if o.names}

    table = [
        SearchRow(rank, index, score, named(alpha, orders), named_coefficients(item, c))
        for rank, (index, score, alpha, orders, c, _) in enumerate(found["rows"], 1)
    ]
    return table, [(named(alpha, orders), str(reason)) for _, alpha, orders, reason in found["failures"]]


def _stage_rows(structure: Structure, found: _core._FoundStage) -> tuple[list[SearchRow], Failures]:
    """Rows and failures of a stage by the names of its free orders and of all coefficients."""
    names, table = structure.order_names, []
    for rank, (index, score, free, parts) in enumerate(found["rows"], 1):
        coefficients: dict[str, float] = {}
        for item, (_, _, _, c, _) in zip(structure.equations, parts, strict=True):
            coefficients |= named_coefficients(item, c)
        table.append(SearchRow(rank, index, score, dict(zip(names, free, strict=True)), coefficients))
    return table, [(dict(zip(names, free, strict=True)), str(reason)) for _, free, reason in found["failures"]]


def _result(job: Job, table: list[SearchRow], failures: Failures, counts: _core._Counts, boxed: int) -> SearchResult:
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
    highest = {n for e in structure.equations for n in e.order.names}
    edges = {n: v for n, v in edges.items() if not (v == 2.0 and n in highest)}
    pruned = {k: cast("int", v) for k, v in counts.items() if k not in ("candidates", "kept")}
    return SearchResult(table, model, counts["candidates"], pruned, failures, m, settings.to_dict(), edges, boxed)
