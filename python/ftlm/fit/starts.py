"""Where joint fits start: order lattices on prefiltered records, delays, resonances."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.base.errors import FtlmError, ModelError
from ftlm.data.orders import MAX_ORDER, Order
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.fit.problem import ALPHA_BOUNDS, Attempt, FreeProblem
from ftlm.fit.resonance_scan import scan_equation
from ftlm.solve.records import Record, initial_tuple, named_signals, record

#: Pulses of the record on which starts are searched.
START_M = 1024
#: Step of the lattice on which starts are searched; a start within half of it leads to the optimum.
START_STEP = 0.2
#: Candidates of the start's lattice beyond which orders of other signals get fewer values.
START_CANDIDATES = 200_000
#: Prefilters of the start's lattice in units of the frequency below which 90 % of an output's power lies; None: none.
PREFILTERS = (1.0, 2.0, 4.0, 8.0, None)
#: Steps of the lattices on which a row is followed downhill, and how often it may move on each.
ZOOM_STEPS = (0.1, 0.05)
ZOOM_ROUNDS = 8
#: Rows of each prefilter's table, and how many of them become starts: the first ones, then those that differ by
#: APART in some order.
ROWS_PER_FILTER = 400
FIRST_ROWS = 1
STARTS_PER_FILTER = 4
APART = 0.35
#: Points of a scan of resonances that become starts.
SCANNED = 4
#: Starts along the interval of a free delay: one for this phase of the frequency below which 90 % of the power lies,
#: and at most so many over all delayed inputs.
DELAY_PHASE = 1.0
DELAY_STARTS = 12


def power_frequency(run: Run, output: str) -> float:
    """Frequency [rad/s] below which 90 % of an output's power lies."""
    y = run[output] - np.mean(run[output])
    power = np.abs(np.fft.rfft(y * np.hanning(y.size))) ** 2
    share = np.cumsum(power) / np.sum(power)
    at = int(np.searchsorted(share, 0.9))
    return 2.0 * math.pi * max(at, 1) / (y.size * run.step)


def start_axes(problem: FreeProblem) -> dict[str, list[float]]:
    """A coarse lattice of the free orders within their bounds."""
    axes = {}
    highest = {n for e in problem.structure.equations if e.order.is_single for n in e.order.names}
    # A link is second order or a little less; any other equation may be anything.
    usual = (1.2, 2.0) if problem.structure.reference else (0.2, MAX_ORDER)
    for name, bounds in zip(problem.orders, problem.bounds, strict=True):
        low, high = usual if name in highest and bounds == ALPHA_BOUNDS else bounds
        if name not in highest:
            high = min(high, 2.0)
        count = max(round((high - low) / START_STEP), 0)
        axes[name] = [round(v, 9) for v in np.linspace(low, high, count + 1)] if high > low else [low]
    # Orders at which other signals enter matter less for where the optimum is than the output's own.
    driving = {
        n
        for e in problem.structure.equations
        for t in e.terms
        for n in t.order.names
        if t.signal != e.output and n not in highest
    }
    for kept in ((0.0, 1.0), (0.0,)):
        if all(math.prod(len(axes[n]) for n in e.order_names) <= START_CANDIDATES for e in problem.structure.equations):
            break
        for name in driving:
            low, high = axes[name][0], axes[name][-1]
            axes[name] = [v for v in kept if low <= v <= high] or [low]
    return axes


def natural_axes(problem: FreeProblem) -> dict[str, list[float]] | None:
    """A small lattice beside the whole orders of a flexible link's physics, or None for any other structure."""
    if not problem.structure.reference:
        return None
    usual = {"alpha": [2.0], "gamma": [0.9, 1.0], "beta": [0.0, 0.15], "mu": [0.8, 1.0]}
    axes = {}
    for name, (low, high) in zip(problem.orders, problem.bounds, strict=True):
        values = [v for v in usual.get(name.rstrip("0123456789"), []) if low <= v <= high]
        if not values:
            return None
        axes[name] = values
    return axes


def delayed_attempts(runs: Sequence[Run], problem: FreeProblem, initial: Any, threads: int) -> list[Attempt]:
    """Starts at several delays where some are free: a fit from too far away in time ends on a wrong oscillation."""
    if not problem.delays:
        return start_attempts(runs, problem, initial, threads)
    fastest = max(power_frequency(run, o) for run in runs for o in problem.structure.outputs)
    axes = []
    for name in problem.delays:
        low, high = problem.structure.free_delays[name]
        wanted = math.ceil((high - low) * fastest / DELAY_PHASE) + 1
        most = max(2, int(DELAY_STARTS ** (1.0 / len(problem.delays))))
        axes.append(np.linspace(low, high, min(max(wanted, 2), most)).tolist())
    attempts = []
    for point in itertools.product(*axes):
        known = problem.structure.with_delays(dict(zip(problem.delays, point, strict=True)))
        for attempt in start_attempts(runs, FreeProblem.of(known), initial, threads):
            words = ", ".join(f"{1e3 * v:.3g} ms" for v in point)
            attempts.append(replace(attempt, origin=f"{attempt.origin}, delay {words}", delays=list(point)))
    return attempts


def start_attempts(runs: Sequence[Run], problem: FreeProblem, initial: Any, threads: int) -> list[Attempt]:
    """Starts from order lattices on prefiltered records, where least squares suffers less from noise.

    The prefilter commutes with the equation: all signals pass it, so the true coefficients stay the same while noise
    above the band is gone.
    """
    structure = replace(problem.structure, coupling="measured", initial=initial)
    m = min(START_M, min(run.length for run in runs) - 1)
    frequency = float(np.median([power_frequency(run, o) for run in runs for o in structure.outputs]))
    axes = start_axes(problem)
    natural = natural_axes(problem)
    attempts: list[Attempt] = []
    fastest = math.pi / max(run.duration / m for run in runs)
    for multiple in PREFILTERS:
        if multiple is not None and multiple * frequency >= fastest:
            # Nothing on these pulses lies above it.
            continue
        records = [prefiltered(record(run, structure, m), multiple and multiple * frequency) for run in runs]
        origin = "no prefilter" if multiple is None else f"prefilter {multiple * frequency:.3g} rad/s"
        lattices = [(axes, APART)]
        if natural is not None:
            lattices.append((natural, 0.0))
        for points, apart in lattices:
            picked: list[list[float]] = []
            for rank, (orders, estimated) in enumerate(lattice_rows(problem, structure, records, points, threads)):
                values = [orders[n] for n in problem.orders]
                far = all(max(abs(a - b) for a, b in zip(values, p, strict=True)) >= apart for p in picked)
                if picked and rank >= FIRST_ROWS and not far:
                    continue
                picked.append(values)
                zoomed, close = (orders, estimated)
                if rank == 0:
                    zoomed, close = zoom(problem, structure, records, orders, estimated, threads)
                values = [zoomed[n] for n in problem.orders]
                if any(np.allclose(values, a.orders, atol=1e-9) and a.origin == origin for a in attempts):
                    continue
                attempts.append(Attempt(values, problem.free_from(close), origin, {}))
                if len(picked) >= STARTS_PER_FILTER:
                    break
    return attempts + scanned_attempts(runs, problem, structure, m, attempts)


def scanned_attempts(
    runs: Sequence[Run], problem: FreeProblem, structure: Structure, m: int, attempts: Sequence[Attempt]
) -> list[Attempt]:
    """Starts whose own terms are scanned over frequency and damping, at whole orders and at the lattice's best ones."""
    if structure.has_order_law or problem.products:
        return []
    orders = [dict(zip(problem.orders, whole_orders(problem), strict=True))]
    orders += [dict(zip(problem.orders, a.orders, strict=True)) for a in attempts[:1] if problem.orders]
    records = [record(run, structure, m) for run in runs]
    out: list[Attempt] = []
    for point in orders:
        try:
            fixed = structure.with_orders(point)
        except FtlmError:
            # Whole orders that the bounds moved together make no equation.
            continue
        scans = []
        for item in fixed.equations:
            frequency = float(np.median([power_frequency(run, item.output) for run in runs]))
            scans.append(scan_equation(records, item, frequency, keep=SCANNED))
        for rank in range(max(map(len, scans), default=0)):
            estimated: dict[str, float] = {}
            for scan in scans:
                if scan:
                    estimated |= scan[min(rank, len(scan) - 1)][1]
            if len(estimated) == len(structure.coefficient_names):
                values = [point[n] for n in problem.orders]
                out.append(Attempt(values, problem.free_from(estimated), "scan of resonances", {}))
    return out


def whole_orders(problem: FreeProblem) -> list[float]:
    """Second order with one derivative of the output, everything else as it is, as far as the bounds allow."""
    usual: dict[str, float] = {}
    for item in problem.structure.equations:
        usual |= dict.fromkeys(item.order.names, 2.0)
        own = [n for t in item.terms if t.signal == item.output for n in t.order.names]
        usual |= {n: usual.get(n, 1.0 if i == 0 else 0.0) for i, n in enumerate(own)}
    pairs = zip(problem.orders, problem.bounds, strict=True)
    return [min(max(usual.get(n, 0.0), low), high) for n, (low, high) in pairs]


def zoom(
    problem: FreeProblem,
    structure: Structure,
    records: list[Record],
    orders: dict[str, float],
    estimated: dict[str, float],
    threads: int,
) -> tuple[dict[str, float], dict[str, float]]:
    """Follow a row downhill on ever finer lattices around it."""
    bounds = dict(zip(problem.orders, problem.bounds, strict=True))
    for step in ZOOM_STEPS:
        for _ in range(ZOOM_ROUNDS):
            axes = {}
            for name, value in orders.items():
                low, high = bounds[name]
                around = (value - step, value, value + step)
                axes[name] = sorted({round(min(max(v, low), high), 9) for v in around})
            rows = lattice_rows(problem, structure, records, axes, threads, keep=1)
            if not rows or rows[0][0] == orders:
                break
            orders, estimated = rows[0]
    return orders, estimated


def prefiltered(rec: Record, frequency: float | None) -> Record:
    """All signals and the initial terms through a second-order low-pass."""
    if frequency is None:
        return rec
    omega = frequency
    low_pass = _core.filter_series(
        [(omega**2, 0.0)], [(1.0, 2.0), (1.4 * omega, 1.0), (omega**2, 0.0)], rec.m, rec.step
    )
    means = np.stack([_core.series_multiply(low_pass, np.ascontiguousarray(row), rec.m) for row in rec.means])
    sensor = low_pass if rec.sensor is None else _core.series_multiply(low_pass, rec.sensor, rec.m)
    return replace(rec, means=means, sensor=sensor)


def lattice_rows(
    problem: FreeProblem,
    structure: Structure,
    records: list[Record],
    axes: Mapping[str, list[float]],
    threads: int,
    *,
    keep: int = ROWS_PER_FILTER,
) -> list[tuple[dict[str, float], dict[str, float]]]:
    """Best rows of the coarse lattice: orders by name and freely estimated coefficients by name."""
    signals = records[0].signals
    cores = [r.core() for r in records]
    inputs = list(records[0].inputs)
    initial = initial_tuple(records[0].initial)
    settings = ("output-error", "l1", 0, 1.0, False, keep, threads, True, 0)

    def coefficients(item: Any, raw: Sequence[float]) -> dict[str, float]:
        terms = zip(item.terms, raw, strict=True)
        return {t.coefficient: c / t.factor for t, c in terms if isinstance(t.coefficient, str)}

    stages = list(structure.parts().values()) if structure.has_order_law else []
    if len(stages) > 1:
        # Stages that share no order are searched one by one; the best of each belong together.
        tables = [
            lattice_rows(
                problem, part, records, {n: v for n, v in axes.items() if n in part.order_names}, threads, keep=keep
            )
            for part in stages
        ]
        return merged_rows(tables, structure)
    if structure.has_order_law:
        names = list(axes)

        def affine(order: Order) -> tuple[float, list[float]]:
            weights = dict(order.weights)
            return order.constant, [weights.get(n, 0.0) for n in names]

        laws = [
            (signals.index(e.output), affine(e.order), [(signals.index(t.signal), affine(t.order)) for t in e.terms])
            for e in structure.equations
        ]
        scales = [sum(float(np.std(r.of(e.output))) * r.m for r in records) for e in structure.equations]
        fixed = [[t.fixed for t in e.terms] for e in structure.equations]
        joined = _core.search_stage(
            cores, [axes[n] for n in names], laws, inputs, fixed, scales, initial, settings, None
        )
        rows = []
        for _, _, free, parts in joined["rows"]:
            estimated: dict[str, float] = {}
            for item, part in zip(structure.equations, parts, strict=True):
                estimated |= coefficients(item, part[3])
            rows.append((dict(zip(names, free, strict=True)), estimated))
        return rows
    tables = []
    for item in structure.equations:

        def axis(order: Order) -> list[float]:
            return list(axes[order.names[0]]) if order.names else [order.constant]

        terms = [(signals.index(t.signal), axis(t.order), bool(t.order.names) and t.fixed is None) for t in item.terms]
        lattice = (signals.index(item.output), axis(item.order), terms)
        try:
            found = _core.search(cores, lattice, inputs, [t.fixed for t in item.terms], initial, settings, None)
        except ModelError as error:
            raise named_signals(error, signals) from None
        table = []
        for _, _, alpha, orders, raw, _ in found["rows"]:
            every = zip((item.order, *(t.order for t in item.terms)), (alpha, *orders), strict=True)
            table.append(({o.names[0]: v for o, v in every if o.names}, coefficients(item, raw)))
        tables.append(table)
    return merged_rows(tables, structure)


def merged_rows(
    tables: Sequence[Sequence[tuple[dict[str, float], dict[str, float]]]], structure: Structure
) -> list[tuple[dict[str, float], dict[str, float]]]:
    """Rows of independent tables side by side, rank by rank; a table that ends goes on with its last row."""
    rows = []
    for rank in range(max(len(t) for t in tables)):
        merged: tuple[dict[str, float], dict[str, float]] = ({}, {})
        for table in tables:
            if table:
                row = table[min(rank, len(table) - 1)]
                merged[0].update(row[0])
                merged[1].update(row[1])
        if len(merged[1]) == len(structure.coefficient_names):
            rows.append(merged)
    return rows
