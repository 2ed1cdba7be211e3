"""Where joint fits start: order lattices on prefiltered records, delays, resonances."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ftlm import _core
from ftlm.base.arrays import Floats
from ftlm.base.errors import FtlmError, ModelError
from ftlm.base.memory import memory_limit
from ftlm.data.equations import Equation
from ftlm.data.limits import FreeInput
from ftlm.data.orders import SEARCHED_ORDER
from ftlm.data.readings import bridged, read
from ftlm.data.run import Run
from ftlm.data.samples import locked
from ftlm.data.settings import Settings
from ftlm.data.structures import Hints, Structure
from ftlm.fit.grid import Attempt
from ftlm.fit.problem import ALPHA_BOUNDS, FreeProblem
from ftlm.fit.resonance_scan import scan_equation
from ftlm.solve.records import (
    Record,
    affine,
    lattice_tuple,
    named_coefficients,
    named_signals,
    record,
)

#: Pulses of the record on which starts are searched.
START_M = 1024
#: Step of the lattice on which starts are searched; a start within half of it leads to the optimum.
START_STEP = 0.2
#: Candidates of the start's lattice beyond which orders of other signals get fewer values.
START_CANDIDATES = 200_000
#: Prefilters of the start's lattice in units of the frequency below which 90 % of an output's power lies; None: none.
PREFILTERS = (1.0, 2.0, 4.0, 8.0, None)
#: Series of prefilters that are kept: those of a few runs.
KEPT_LOW_PASSES = 32
#: Steps of the lattices on which a row is followed downhill, and how often it may move on each.
ZOOM_STEPS = (0.1, 0.05)
ZOOM_ROUNDS = 8
#: Rows of each prefilter's table that are looked at, all where the first few do not do, and how many of them become
#: starts: the first, then those that differ by APART in some order.
FIRST_ROWS, ROWS_PER_FILTER = 25, 400
STARTS_PER_FILTER = 4
APART = 0.35
#: Ratios of a coefficient law at which a start takes one equation's coefficients from another's.
LAW_RATIOS = (0.25, 1.0, 4.0)
#: Points of a scan of resonances that become starts.
SCANNED = 4
#: Starts along the interval of a free delay: one for this phase of the frequency below which 90 % of the power lies,
#: and at most so many over all delayed inputs.
DELAY_PHASE = 1.0
DELAY_STARTS = 12
#: Limits are tried at so many values from this share of the largest input.
LIMIT_STARTS, LEAST_LIMIT = 4, 0.1


def power_frequency(run: Run, output: str) -> float:
    """Frequency [rad/s] below which 90 % of an output's power lies."""
    samples = bridged(run[output])
    y = samples - np.mean(samples)
    power = np.abs(np.fft.rfft(y * np.hanning(y.size))) ** 2
    share = np.cumsum(power) / np.sum(power)
    at = int(np.searchsorted(share, 0.9))
    return 2.0 * math.pi * max(at, 1) / (y.size * run.step)


@dataclass(frozen=True)
class Row:
    """A row of a lattice: its orders, and the coefficients freely estimated there, by name."""

    orders: dict[str, float]
    coefficients: dict[str, float]


@dataclass(frozen=True)
class Coarse:
    """How coarse lattices are searched: by least squares, in time, on so many threads, within so many bytes."""

    threads: int
    memory: int
    keep: int = STARTS_PER_FILTER

    def core(self) -> tuple[str, str, int, float, bool, int, int, bool, int, int]:
        """As the core takes it."""
        settings = Settings(coefficients="least-squares", rows="time", keep=self.keep, threads=self.threads)
        return settings.core(self.memory)


def start_axes(problem: FreeProblem) -> dict[str, list[float]]:
    """A coarse lattice of the free orders within their bounds."""
    equations = problem.structure.equations
    highest = {n for e in equations if e.order.is_single for n in e.order.names}
    usual = (problem.structure.hints or Hints()).highest or (0.2, SEARCHED_ORDER)
    axes = {}
    for name, bounds in zip(problem.orders, problem.bounds, strict=True):
        low, high = usual if name in highest and bounds == ALPHA_BOUNDS else bounds
        if name not in highest:
            high = min(high, 2.0)
        count = max(round((high - low) / START_STEP), 0)
        axes[name] = [round(v, 9) for v in np.linspace(low, high, count + 1)] if high > low else [low]
    # Orders at which other signals enter matter less for where the optimum is than the output's own.
    driving = {n for e in equations for t in e.terms if t.signal != e.output for n in t.order.names} - highest
    for kept in ((0.0, 1.0), (0.0,)):
        if all(math.prod(len(axes[n]) for n in e.order_names) <= START_CANDIDATES for e in equations):
            break
        for name in driving:
            low, high = axes[name][0], axes[name][-1]
            axes[name] = [v for v in kept if low <= v <= high] or [low]
    return axes


def natural_axes(problem: FreeProblem) -> dict[str, list[float]] | None:
    """A small lattice beside the whole orders of a structure's physics, or None where it knows of none."""
    natural = (problem.structure.hints or Hints()).natural
    axes = {}
    for name, (low, high) in zip(problem.orders, problem.bounds, strict=True):
        values = [v for v in natural.get(name, ()) if low <= v <= high]
        if not values:
            return None
        axes[name] = values
    return axes if natural else None


def delayed_attempts(runs: Sequence[Run], problem: FreeProblem, threads: int) -> list[Attempt]:
    """Starts at several delays and limits where some are free.

    A fit from too far away in time ends on a wrong oscillation; a limit that no sample reaches moves nothing.
    """
    if not problem.inputs:
        return start_attempts(runs, problem, threads)
    fastest = max(power_frequency(run, o) for run in runs for o in problem.structure.outputs)
    axes = []
    most = max(2, int(DELAY_STARTS ** (1.0 / len(problem.inputs))))
    for item in problem.inputs:
        low, high = item.bounds
        if item.law == "delay":
            wanted = math.ceil((high - low) * fastest / DELAY_PHASE) + 1
            axes.append(np.linspace(low, high, min(max(wanted, 2), most)).tolist())
        else:
            largest = max(float(np.max(np.abs(read(run[item.signal])), initial=0.0)) for run in runs)
            least, reached = max(low, LEAST_LIMIT * largest), min(high, largest)
            axes.append(np.linspace(min(least, reached), reached, min(LIMIT_STARTS, most) + 1).tolist()[:-1])
    attempts = []
    for point in itertools.product(*axes):
        known = problem.structure.with_inputs({i.name: v for i, v in zip(problem.inputs, point, strict=True)})
        words = ", ".join(_at(item, v) for item, v in zip(problem.inputs, point, strict=True))
        attempts += [
            replace(attempt, origin=f"{attempt.origin}, {words}", inputs=list(point))
            for attempt in start_attempts(runs, FreeProblem.of(known), threads)
        ]
    return attempts


def _at(item: FreeInput, value: float) -> str:
    """Where a start is, in words."""
    return f"delay {1e3 * value:.3g} ms" if item.law == "delay" else f"{item.name} {value:.3g}"


def start_attempts(runs: Sequence[Run], problem: FreeProblem, threads: int) -> list[Attempt]:
    """Starts from order lattices on prefiltered records, where least squares suffers less from noise.

    The prefilter commutes with the equation: all signals pass it, so the true coefficients stay the same while noise
    above the band is gone.
    """
    structure = replace(problem.structure, coupling="measured")
    m = min(START_M, min(run.length for run in runs) - 1)
    frequency = float(np.median([power_frequency(run, o) for run in runs for o in structure.outputs]))
    natural = natural_axes(problem)
    lattices = [(start_axes(problem), APART)] + ([] if natural is None else [(natural, 0.0)])
    attempts: list[Attempt] = []
    fastest = math.pi / max(run.duration / m for run in runs)
    # What memory there is is asked for once: these lattices are many, and small.
    coarse = Coarse(threads, memory_limit())
    unfiltered = [record(run, structure, m) for run in runs]
    for multiple in PREFILTERS:
        if multiple is not None and multiple * frequency >= fastest:
            # Nothing on these pulses lies above it.
            continue
        records = [prefiltered(rec, multiple and multiple * frequency) for rec in unfiltered]
        origin = "no prefilter" if multiple is None else f"prefilter {multiple * frequency:.3g} rad/s"
        here: list[Attempt] = []
        for axes, apart in lattices:
            here += lattice_attempts(problem, structure, records, axes, apart, origin, here, coarse)
        if natural is not None and multiple in (PREFILTERS[0], None):
            here += lawful_attempts(problem, structure, records, natural, origin, coarse)
        attempts += here
    return attempts + scanned_attempts(runs, problem, structure, unfiltered, attempts)


def lattice_attempts(
    problem: FreeProblem, structure: Structure, records: list[Record], axes: Mapping[str, list[float]], apart: float,
    origin: str, before: Sequence[Attempt], coarse: Coarse,
) -> list[Attempt]:  # fmt: skip
    """Starts from the rows of a lattice that lie apart, the best one followed downhill; none that stood before."""
    attempts: list[Attempt] = []
    for rank, row in enumerate(_lying_apart(problem, structure, records, axes, apart, coarse)):
        start = row if rank else zoom(problem, structure, records, row, coarse)
        values = [start.orders[n] for n in problem.orders]
        if any(np.allclose(values, a.orders, atol=1e-9) for a in (*before, *attempts)):
            continue
        attempts.append(Attempt(values, problem.free_from(start.coefficients), origin, {}))
        if rank + 1 >= STARTS_PER_FILTER:
            break
    return attempts


def _lying_apart(
    problem: FreeProblem, structure: Structure, records: list[Record], axes: Mapping[str, list[float]], apart: float,
    coarse: Coarse,
) -> Iterator[Row]:  # fmt: skip
    """The rows of a lattice, best first, that each differ from all before in some order; many are asked for late."""
    picked: list[list[float]] = []
    seen = 0
    for keep in (FIRST_ROWS, ROWS_PER_FILTER):
        rows = lattice_rows(structure, records, axes, replace(coarse, keep=keep))
        for row in rows[seen:]:
            values = [row.orders[n] for n in problem.orders]
            if not picked or all(max(abs(a - b) for a, b in zip(values, p, strict=True)) >= apart for p in picked):
                picked.append(values)
                yield row
        seen = len(rows)
        if seen < keep:
            return


def lawful_attempts(
    problem: FreeProblem, structure: Structure, records: list[Record], axes: Mapping[str, list[float]], origin: str,
    coarse: Coarse,
) -> list[Attempt]:  # fmt: skip
    """Starts with one equation's coefficients from another's by the law, the rest of it by least squares.

    The hub of an arm is overdamped: current and friction nearly cancel, and what is left of the hub's acceleration is
    told as well by the link's own equation. Freely estimated, the hub's becomes the link's, stiffness reversed.
    """
    signs = (structure.hints or Hints()).positive
    tied = {n: (free[0], free[1:]) for n, (_, free) in problem.products.items() if free and free[0] in signs}
    if not tied:
        return []
    attempts = []
    for row in lattice_rows(structure, records, axes, coarse)[:STARTS_PER_FILTER]:
        point = {n: [v] for n, v in row.orders.items()}
        for ratio in LAW_RATIOS:
            known = {free: abs(row.coefficients[n]) / ratio ** len(others) for n, (free, others) in tied.items()}
            if not all(math.isfinite(v) and v for v in known.values()):
                continue
            for rest in lattice_rows(structure.with_coefficients(known), records, point, replace(coarse, keep=1)):
                values = dict.fromkeys(problem.coefficients, ratio) | rest.coefficients | known
                orders = [row.orders[n] for n in problem.orders]
                words = f"{origin}, by the law at {ratio:g}"
                attempts.append(Attempt(orders, [values[n] for n in problem.coefficients], words, {}))
    return attempts


def scanned_attempts(
    runs: Sequence[Run], problem: FreeProblem, structure: Structure, records: Sequence[Record],
    attempts: Sequence[Attempt],
) -> list[Attempt]:  # fmt: skip
    """Starts whose own terms are scanned over frequency and damping, at whole orders and at the lattice's best ones."""
    if structure.has_order_law or problem.products:
        return []
    orders = [dict(zip(problem.orders, whole_orders(problem), strict=True))]
    orders += [dict(zip(problem.orders, a.orders, strict=True)) for a in attempts[:1] if problem.orders]
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
            scans.append([Row({}, c) for _, c in scan_equation(records, item, frequency, keep=SCANNED)])
        values = [point[n] for n in problem.orders]
        out += [
            Attempt(values, problem.free_from(row.coefficients), "scan of resonances", {})
            for row in side_by_side(scans, structure)
        ]
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


def zoom(problem: FreeProblem, structure: Structure, records: list[Record], row: Row, coarse: Coarse) -> Row:
    """Follow a row downhill on ever finer lattices around it."""
    if not row.orders:
        return row
    bounds = dict(zip(problem.orders, problem.bounds, strict=True))
    for step in ZOOM_STEPS:
        for _ in range(ZOOM_ROUNDS):
            axes = {}
            for name, value in row.orders.items():
                low, high = bounds[name]
                around = (value - step, value, value + step)
                axes[name] = sorted({round(min(max(v, low), high), 9) for v in around})
            rows = lattice_rows(structure, records, axes, replace(coarse, keep=1))
            if not rows or rows[0].orders == row.orders:
                break
            row = rows[0]
    return row


def prefiltered(rec: Record, frequency: float | None) -> Record:
    """All signals and the initial terms through a second-order low-pass."""
    if frequency is None:
        return rec
    low_pass = _low_pass(frequency, rec.m, rec.step)
    means = np.stack([_core.series_multiply(low_pass, np.ascontiguousarray(row), rec.m) for row in rec.means])
    sensor = low_pass if rec.sensor is None else _core.series_multiply(low_pass, rec.sensor, rec.m)
    return replace(rec, means=means, sensor=sensor)


@lru_cache(maxsize=KEPT_LOW_PASSES)
def _low_pass(omega: float, m: int, step: float) -> Floats:
    """The series of a second-order low-pass of this corner [rad/s]: the same one for every problem inside a race."""
    denominator = [(1.0, 2.0), (1.4 * omega, 1.0), (omega**2, 0.0)]
    return locked(_core.filter_series([(omega**2, 0.0)], denominator, m, step))


def lattice_rows(
    structure: Structure, records: list[Record], axes: Mapping[str, list[float]], coarse: Coarse
) -> list[Row]:
    """Best rows of a coarse lattice, by least squares."""
    if not structure.has_order_law:
        return side_by_side([equation_rows(e, records, axes, coarse) for e in structure.equations], structure)
    stages = list(structure.parts().values())
    if len(stages) <= 1:
        return stage_rows(structure, records, axes, coarse)
    # Stages that share no order are searched one by one; the best of each belong together.
    own = [{n: v for n, v in axes.items() if n in stage.order_names} for stage in stages]
    tables = [lattice_rows(s, records, a, coarse) for s, a in zip(stages, own, strict=True)]
    return side_by_side(tables, structure)


def stage_rows(
    structure: Structure, records: list[Record], axes: Mapping[str, list[float]], coarse: Coarse
) -> list[Row]:
    """Best rows of equations under their order law."""
    signals, names = records[0].signals, list(axes)
    laws = [
        (
            signals.index(e.output), affine(e.order, names),
            [(signals.index(t.signal), affine(t.order, names)) for t in e.terms],
        )
        for e in structure.equations
    ]  # fmt: skip
    scales = [sum(float(np.std(r.of(e.output))) * r.m for r in records) for e in structure.equations]
    joined = _core.search_stage(
        [r.core() for r in records], [axes[n] for n in names], laws, list(records[0].inputs),
        [[t.fixed for t in e.terms] for e in structure.equations], scales,
        records[0].start, coarse.core(), None,
    )  # fmt: skip
    rows = []
    for _, _, free, parts in joined["rows"]:
        row = Row(dict(zip(names, free, strict=True)), {})
        for item, (_, _, _, raw, _) in zip(structure.equations, parts, strict=True):
            row.coefficients.update(named_coefficients(item, raw))
        rows.append(row)
    return rows


def equation_rows(item: Equation, records: list[Record], axes: Mapping[str, list[float]], coarse: Coarse) -> list[Row]:
    """Best rows of one equation whose orders are free by themselves."""
    signals = records[0].signals
    try:
        table = _core.search(
            [r.core() for r in records], lattice_tuple(item, signals, axes), list(records[0].inputs),
            [t.fixed for t in item.terms], records[0].start, coarse.core(), None,
        )  # fmt: skip
    except ModelError as error:
        raise named_signals(error, signals) from None
    placed = enumerate((item.order, *(t.order for t in item.terms)))
    names = [(place, order.names[0]) for place, order in placed if order.names]
    free = [(k, t.coefficient, t.factor) for k, t in enumerate(item.terms) if isinstance(t.coefficient, str)]
    return [
        Row({name: (alpha, *orders)[place] for place, name in names}, {name: raw[k] / f for k, name, f in free})
        for _, _, alpha, orders, raw, _ in table["rows"]
    ]


def side_by_side(tables: Sequence[Sequence[Row]], structure: Structure) -> list[Row]:
    """Rows of independent tables side by side, rank by rank; a table that ends goes on with its last row."""
    rows, wanted = [], len(structure.coefficient_names)
    for rank in range(max(map(len, tables), default=0)):
        merged = Row({}, {})
        for table in filter(None, tables):
            row = table[min(rank, len(table) - 1)]
            merged.orders.update(row.orders)
            merged.coefficients.update(row.coefficients)
        if len(merged.coefficients) == wanted:
            rows.append(merged)
    return rows
