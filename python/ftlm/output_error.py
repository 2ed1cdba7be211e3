"""Joint output error: all equations, all runs, continuous orders, from an automatic start to intervals.

For white measurement noise the estimate is maximum likelihood. The core minimises from a start
(Levenberg-Marquardt with an analytic Jacobian); this file finds starts, weighs outputs by their noise, refines the grid
until it no longer matters, and turns the optimum into numbers with intervals.
"""

from __future__ import annotations

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ftlm import _core
from ftlm.errors import ConvergenceError, DataError, FtlmError, ModelError
from ftlm.models import MAX_ORDER, Order, Structure, delay_name
from ftlm.records import initial_tuple, named_signals, noise_of, record, sensor_series
from ftlm.resonance_scan import scan_equation

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from ftlm.records import Record
    from ftlm.runs import Run

    Floats = NDArray[np.float64]

__all__ = ["JointFit", "fit_output_error"]

#: Half-width of a 95 % interval in standard errors.
NORMAL_95 = 1.959963984540054
#: Samples a run of the coarse fits that compare starts; the best ones continue on all samples.
COARSE_SAMPLES = 1200
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
#: Residual that costs 1 in a coarse fit, as a share of an output's size.
COARSE_SHARE = 0.01
#: Evaluations of every coarse fit, then of those that are ahead: one in RUNNERS, but not fewer than FEWEST.
FIRST_LAP = 15
SECOND_LAP = 60
RUNNERS = 3
FEWEST = 8
#: All get as many as those ahead where the best is above the noise by this factor.
ABOVE_FLOOR = 2.0
#: Coarse fits that continue on all samples.
FINALISTS = 3
#: ... unless their coarse cost exceeds the best one's by this factor.
CONTENDER = 3.0
#: Two costs closer than this share are the same optimum.
SAME_COST = 1e-3
#: Weights are settled when no output's residuals differ from their weight by more than this share.
SETTLED = 0.01
#: Refinement ends when halving the step moves no estimate, extrapolated to step 0, by this share of its standard error.
REFINED = 0.1
#: Discretisation that the first fit on all samples may leave, in standard deviations of the noise.
NOTICED = 0.3
#: A pole of this many radians a sample is faster than the samples see.
FAST_POLE = 0.2
#: Finest grid: pulses a sample interval.
FINEST = 16
#: Own bounds of orders where the structure gives none.
ALPHA_BOUNDS = (0.05, MAX_ORDER)
#: Starts along the interval of a free delay: one for this phase of the frequency below which 90 % of the power lies,
#: and at most so many over all delayed inputs.
DELAY_PHASE = 1.0
DELAY_STARTS = 12
#: Lags of the residuals' autocovariance that the robust covariance takes in, as a power of the sample count.
LAG_POWER = 1.0 / 3.0


@dataclass(frozen=True)
class JointFit:
    """An optimum of the joint output error.

    Parameters
    ----------
    orders, coefficients
        Free orders and free coefficients by name; under a coefficient law the free ones of the law.
    covariance
        Of orders, coefficients, then delays, robust to coloured residuals.
    noise
        Standard deviation of the residuals by output.
    cost
        Half the sum of squared weighted residuals.
    samples
        Number of residuals.
    refinement
        Pulses a sample interval on the finest grid; the estimates are the limit that it and the next coarser one tell.
    settled
        Whether halving the step moved no estimate by a tenth of its standard error.
    converged
        Whether neither cost nor parameters moved any more.
    starts
        Coarse cost (per residual) and origin of every start, best first.
    residuals
        By run and output.
    products
        Coefficients that the coefficient law gives: sign and factors by name.
    delays
        Estimated delays [s] by input; in covariance and errors they stand last, as ``delay_`` and the input's name.
    """

    orders: dict[str, float]
    coefficients: dict[str, float]
    covariance: Floats
    noise: dict[str, float]
    cost: float
    samples: int
    refinement: int
    settled: bool
    converged: bool
    starts: list[tuple[float, str]]
    residuals: list[dict[str, Floats]]
    products: Mapping[str, tuple[float, tuple[str, ...]]] = field(default_factory=dict)
    delays: dict[str, float] = field(default_factory=dict)

    @property
    def choice(self) -> str:
        """Why this optimum, in words: which start led to it, and how far behind the next other one was."""
        if not self.starts:
            return "from the start that was given"
        level, origin = self.starts[0]
        same = [v for v, _ in self.starts if v <= (1.0 + SAME_COST) * level]
        words = f"{len(same)} of {len(self.starts)} starts ended in the lowest optimum, first that of: {origin}"
        rest = self.starts[len(same) :]
        return words + (f"; the next costs {rest[0][0] / level:.3g} times as much" if rest and level > 0 else "")

    @property
    def derived_errors(self) -> dict[str, float]:
        """Standard errors of the coefficients that the coefficient law gives, to first order."""
        kept = slice(len(self.orders), len(self.orders) + len(self.coefficients))
        out, spread = {}, self.covariance[kept, kept]
        for name, (sign, factors) in self.products.items():
            value = sign * math.prod(self.coefficients[f] for f in factors)
            slope = np.array([factors.count(n) * value / v if v else 0.0 for n, v in self.coefficients.items()])
            out[name] = float(np.sqrt(slope @ spread @ slope))
        return out

    @property
    def names(self) -> list[str]:
        """Parameters in the order of the covariance."""
        return [*self.orders, *self.coefficients, *map(delay_name, self.delays)]

    @property
    def values(self) -> Floats:
        """Parameters in the order of the covariance."""
        return np.array([*self.orders.values(), *self.coefficients.values(), *self.delays.values()])

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each parameter."""
        with np.errstate(invalid="ignore"):
            return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % interval of each parameter."""
        errors = self.standard_errors
        pairs = zip(self.names, self.values.tolist(), strict=True)
        return {n: (v - NORMAL_95 * errors[n], v + NORMAL_95 * errors[n]) for n, v in pairs}

    @property
    def correlation(self) -> Floats:
        """Correlation matrix of the parameters; not a number where a variance is 0 or not finite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.sqrt(np.diag(self.covariance))
            scaled: Floats = self.covariance / np.outer(spread, spread)
        return scaled


# ------------------------------------------------------------------------------------------------ what is free


@dataclass(frozen=True)
class FreeProblem:
    """A structure as the core takes it: orders affine in free ones, coefficients products of free ones."""

    structure: Structure
    orders: tuple[str, ...]
    coefficients: tuple[str, ...]
    bounds: tuple[tuple[float, float], ...]
    products: Mapping[str, tuple[float, tuple[str, ...]]]
    delays: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """Everything that is free: orders, coefficients, then delays."""
        return [*self.orders, *self.coefficients, *map(delay_name, self.delays)]

    @property
    def all_bounds(self) -> list[tuple[float, float]]:
        """Bounds of everything that is free; those of coefficients are infinite."""
        ends = [self.structure.free_delays[n] for n in self.delays]
        return [*self.bounds, *[(-math.inf, math.inf)] * len(self.coefficients), *ends]

    def split(self, values: Sequence[float]) -> tuple[list[float], list[float], list[float]]:
        """Values of orders, coefficients and delays."""
        flat = list(map(float, values))
        first, second = len(self.orders), len(self.orders) + len(self.coefficients)
        return flat[:first], flat[first:second], flat[second:]

    @classmethod
    def of(cls, structure: Structure) -> FreeProblem:
        """Free orders, free coefficients and their bounds."""
        law = {name: (sign, factors) for name, sign, factors in structure.coefficient_law}
        named = structure.coefficient_names
        products = {n: law[n] for n in named if n in law}
        free = [n for n in named if n not in products]
        free += [f for _, factors in products.values() for f in factors if f not in named]
        highest = {n for e in structure.equations if e.order.is_single for n in e.order.names}
        bounds = []
        for name in structure.order_names:
            if name in structure.order_values:
                values = structure.order_values[name]
                bounds.append((values[0], values[-1]))
            else:
                bounds.append(ALPHA_BOUNDS if name in highest else (0.0, MAX_ORDER))
        coefficients = tuple(dict.fromkeys(free))
        return cls(
            structure, structure.order_names, coefficients, tuple(bounds), products, tuple(structure.free_delays)
        )

    def coordinates(self, start: Sequence[float], *, plain: bool) -> list[str]:
        """Logarithms where the start allows them."""
        ratios = {
            f for _, factors in self.products.values() for f in factors if f not in self.structure.coefficient_names
        }
        out = []
        for name, value in zip(self.coefficients, start, strict=True):
            if plain or value == 0:
                out.append("plain")
            else:
                out.append("excess" if name in ratios and value > 1 else "logarithm")
        return out

    def laws(self, signals: Sequence[str]) -> list[Any]:
        """Equations with affine orders and monomial coefficients."""
        index = {n: i for i, n in enumerate(self.coefficients)}

        def affine(order: Order) -> tuple[float, list[float]]:
            weights = dict(order.weights)
            return order.constant, [weights.get(n, 0.0) for n in self.orders]

        def monomial(coefficient: str | float, factor: float) -> tuple[float, list[tuple[int, int]]]:
            if not isinstance(coefficient, str):
                return factor * coefficient, []
            sign, factors = self.products.get(coefficient, (1.0, (coefficient,)))
            return factor * sign, [(index[f], 1) for f in factors]

        return [
            (
                signals.index(e.output),
                affine(e.order),
                [(signals.index(t.signal), affine(t.order), monomial(t.coefficient, t.factor)) for t in e.terms],
            )
            for e in self.structure.equations
        ]

    def named(self, values: Sequence[float]) -> dict[str, float]:
        """Every coefficient of the structure by name from the free ones."""
        free = dict(zip(self.coefficients, map(float, values), strict=True))
        out: dict[str, float] = {}
        for name in self.structure.coefficient_names:
            sign, factors = self.products.get(name, (1.0, (name,)))
            out[name] = sign * float(np.prod([free[f] for f in factors]))
        return out

    def number_jacobian(self, orders: Sequence[float], coefficients: Sequence[float]) -> Floats:
        """Derivatives of a model's numbers (rows) with respect to everything that is free (columns).

        Rows are, equation by equation, alpha, then order and coefficient of each term; delays are none of them.
        """
        free = dict(zip(self.coefficients, coefficients, strict=True))
        count, idle = len(self.orders), len(self.delays)
        rows = []

        def of_order(order: Order) -> Floats:
            weights = dict(order.weights)
            return np.array([weights.get(n, 0.0) for n in self.orders] + [0.0] * (len(free) + idle))

        for item in self.structure.equations:
            rows.append(of_order(item.order))
            for term in item.terms:
                row = np.zeros(count + len(free) + idle)
                if isinstance(term.coefficient, str):
                    sign, factors = self.products.get(term.coefficient, (1.0, (term.coefficient,)))
                    for k, name in enumerate(factors):
                        others = [free[f] for j, f in enumerate(factors) if j != k]
                        row[count + list(free).index(name)] += term.factor * sign * math.prod(others)
                rows += [of_order(term.order), row]
        found: Floats = np.stack(rows)
        return found

    def free_from(self, estimated: Mapping[str, float]) -> list[float]:
        """Free coefficients from freely estimated ones; ratios as the median of what the equations say, above 1."""
        out = []
        for name in self.coefficients:
            if name in estimated:
                out.append(estimated[name])
                continue
            said = []
            for dependent, (sign, factors) in self.products.items():
                others = [estimated[f] for f in factors if f != name and f in estimated]
                product = float(np.prod(others))
                if name in factors and product:
                    said.append(sign * estimated[dependent] / product)
            usable = [s for s in said if math.isfinite(s) and 1.05 < s < 20]
            out.append(float(np.median(usable)) if usable else 1.5)
        return out


# ------------------------------------------------------------------------------------------------ one fit


def experiment(
    run: Run, problem: FreeProblem, initial: Any, weights: Sequence[float], *, every: int = 1, decimation: int = 1
) -> tuple[Any, ...]:
    """A run as the core compares with it: ``every`` pulses a sample interval, each ``decimation``-th sample."""
    # Free delays are the core's to apply, to inputs as they were given.
    structure = replace(problem.structure, initial=initial, free_delays={})
    rows = (run.length - 1) // decimation * decimation + 1
    if rows != run.length:
        run = run.slice(None, rows * run.step - run.step / 2)
    intervals = (rows - 1) // decimation
    coupled = structure.coupling == "simulated"
    rec = record(run, structure, intervals * every, filtered=not coupled)
    samples = []
    for output in structure.outputs:
        measured_through = structure.sensor_filter is not None and output in structure.sensor_filter.outputs
        if rec.sensor is None or measured_through:
            samples.append(run[output][::decimation])
        else:
            # The equation is compared in filtered signals, so this output passes the filter too.
            samples.append(_core.point_samples(rec.of(output))[::every])
    filtered = None
    if coupled and structure.sensor_filter is not None:
        applies = [o in structure.sensor_filter.outputs for o in structure.outputs]
        filtered = (sensor_series(structure, rec.m, rec.step), applies)
    return rec.core(), every, np.ascontiguousarray(np.stack(samples)), filtered, list(weights)


@dataclass
class Attempt:
    """A point in the space of parameters, and what the core said about it."""

    orders: list[float]
    coefficients: list[float]
    origin: str
    found: Any
    delays: list[float] = field(default_factory=list)

    @property
    def values(self) -> Floats:
        """Orders, coefficients, delays."""
        return np.array(self.orders + self.coefficients + self.delays)

    @property
    def level(self) -> float:
        """Cost per residual: 1 at the noise floor if the weights are right."""
        return 2.0 * float(self.found["cost"]) / len(self.found["residuals"])


def descend(
    problem: FreeProblem,
    experiments: list[Any],
    signals: Sequence[str],
    initial: Any,
    attempt: Attempt,
    *,
    evaluations: int,
    tolerance: float = 1e-9,
    plain: bool = False,
) -> Attempt:
    """Levenberg-Marquardt from an attempt."""
    found = _core.output_error(
        experiments,
        problem.laws(signals),
        list(problem.bounds),
        problem.coordinates(attempt.coefficients, plain=plain),
        problem.structure.coupling == "simulated",
        initial_tuple(initial),
        attempt.orders,
        attempt.coefficients,
        [
            (signals.index(n), problem.structure.free_delays[n], delay)
            for n, delay in zip(problem.delays, attempt.delays, strict=True)
        ],
        evaluations,
        tolerance,
    )
    return Attempt(list(found["orders"]), list(found["coefficients"]), attempt.origin, found, list(found["delays"]))


def lowest(problem: FreeProblem, *arguments: Any, evaluations: int) -> Attempt:
    """Descend in logarithmic coordinates, then in plain ones, which may cross zero."""
    experiments, signals, initial, attempt = arguments
    first = descend(problem, experiments, signals, initial, attempt, evaluations=evaluations)
    second = descend(problem, experiments, signals, initial, first, evaluations=evaluations, plain=True)
    return second if second.found["cost"] <= first.found["cost"] else first


# ------------------------------------------------------------------------------------------------ where to start


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


@dataclass(frozen=True)
class LowerOrder:
    """A problem one of whose equations ends with its highest own term: what is left of it behind a fast pole.

    Parameters
    ----------
    problem
        The problem.
    coefficient
        Of the term that is now the highest, 1 there.
    factor
        Known factor of that term.
    others
        Coefficients of the equation's other terms.
    fast
        Size of the term's coefficient that makes the pole fast.
    initial
        Initial terms of the equation of lower order: a power of t that it integrates to would be a drive.
    """

    problem: FreeProblem
    coefficient: str
    factor: float
    others: tuple[str, ...]
    fast: float
    initial: Any

    def embedded(self, attempt: Attempt, whole: FreeProblem) -> Attempt:
        """The same dynamics in the whole problem, but for what is faster than the sampling."""
        values = dict(zip(self.problem.coefficients, attempt.coefficients, strict=True))
        values |= {n: self.fast * values[n] for n in self.others}
        values[self.coefficient] = -self.fast / self.factor
        known = dict(zip(self.problem.orders, attempt.orders, strict=True))
        return replace(
            attempt,
            orders=[known[n] for n in whole.orders],
            coefficients=[values[n] for n in whole.coefficients],
            origin=f"{attempt.origin}, from the equation of lower order",
        )


def lower_orders(problem: FreeProblem, runs: Sequence[Run], initial: Any) -> list[LowerOrder]:
    """The problem of lower order of one equation whose own orders are numbers; free orders get there by themselves."""
    structure = problem.structure
    if structure.has_order_law or problem.products or len(structure.equations) > 1:
        return []
    step = max(run.step for run in runs)
    item = structure.equations[0]
    own = [t for t in item.terms if t.signal == item.output]
    if item.order.names or not own or any(t.order.names for t in own):
        return []
    highest = max(own, key=lambda t: t.order.constant)
    rest = tuple(t for t in item.terms if t is not highest)
    known = any(t.fixed is not None or t.coefficient == highest.coefficient for t in rest)
    if not isinstance(highest.coefficient, str) or highest.order.constant <= 0 or known:
        return []
    if not isinstance(initial, str):
        initial = tuple(e for e in initial if e < highest.order.constant)
    try:
        lower = replace(item, order=highest.order, terms=rest)
        reduced = FreeProblem.of(replace(structure, equations=(lower,)))
    except FtlmError:
        # A term of another signal differentiates more often than the equation of lower order integrates.
        return []
    fast = (FAST_POLE / step) ** (item.order.constant - highest.order.constant)
    names = tuple(t.coefficient for t in rest if isinstance(t.coefficient, str))
    return [LowerOrder(reduced, highest.coefficient, highest.factor, names, fast, initial)]


@dataclass(frozen=True)
class Simpler:
    """A problem with one own term less.

    Parameters
    ----------
    problem
        The problem.
    coefficient
        What is 0 in it.
    order
        Highest order of the equation that lacks the term.
    initial
        Initial terms.
    """

    problem: FreeProblem
    coefficient: str
    order: Order
    initial: Any

    def embedded(self, attempt: Attempt, whole: FreeProblem) -> Attempt:
        """The same point of the whole problem; the order of a term that is 0 may be any, so it is half the highest."""
        known = dict(zip(self.problem.orders, attempt.orders, strict=True))
        highest = self.order.constant + sum(w * known[n] for n, w in self.order.weights)
        values = dict(zip(self.problem.coefficients, attempt.coefficients, strict=True))
        return replace(
            attempt,
            orders=[known.get(n, 0.5 * highest) for n in whole.orders],
            coefficients=[values.get(n, 0.0) for n in whole.coefficients],
            origin=f"{attempt.origin}, from {self.coefficient} = 0",
        )


def simpler(problem: FreeProblem, initial: Any) -> list[Simpler]:
    """Problems with one own term less; none under a law, where no coefficient can be 0 by itself."""
    structure = problem.structure
    if structure.has_order_law or problem.products:
        return []
    out = []
    for place, item in enumerate(structure.equations):
        own = [t for t in item.terms if t.signal == item.output]
        for term in own if len(own) > 1 else []:
            if not isinstance(term.coefficient, str):
                continue
            rest = replace(item, terms=tuple(t for t in item.terms if t is not term))
            equations = (*structure.equations[:place], rest, *structure.equations[place + 1 :])
            names = {n for e in equations for n in e.order_names}
            values = {n: v for n, v in structure.order_values.items() if n in names}
            reduced = replace(structure, equations=equations, order_values=values)
            out.append(Simpler(FreeProblem.of(reduced), term.coefficient, item.order, initial))
    return out


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


# ------------------------------------------------------------------------------------------------ the whole


def fit_output_error(
    runs: Sequence[Run],
    structure: Structure,
    *,
    threads: int = 1,
    start: Mapping[str, float] | None = None,
    refine: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> JointFit:
    """Fit all equations of a structure on all runs by output error, from an automatic start.

    Parameters
    ----------
    runs
        Runs with the same names and units.
    structure
        Free orders and coefficients; a stated coefficient law is imposed. Its initial terms must be decided.
    threads
        Threads of the start's lattice.
    start
        Values of all free orders, coefficients and delays by name, instead of the automatic start.
    refine
        Whether to refine the grid below the samples until it does not matter.
    progress
        Called with (starts done, starts in all).

    Returns
    -------
    JointFit
        The best optimum found.

    Raises
    ------
    DataError
        Fewer samples than free numbers.
    ConvergenceError
        No start has a finite free run.
    """
    problem = FreeProblem.of(structure)
    initial = structure.initial
    signals = structure.signals
    samples = sum(run.length - 2 for run in runs) * len(structure.outputs)
    if samples <= len(problem.names):
        raise DataError(
            f"{samples} samples between the first and the last do not tell {len(problem.names)} free numbers; use "
            "longer runs, or fix orders or coefficients"
        )
    noise = first_noise(runs, structure)
    decimation = max(1, min(run.length - 1 for run in runs) // COARSE_SAMPLES)

    def experiments(weights: Sequence[float], every: int = 1, thinned: int = 1) -> list[Any]:
        return [experiment(r, problem, initial, weights, every=every, decimation=thinned) for r in runs]

    weights = [1.0 / noise[o] for o in structure.outputs]
    # Starts are compared with every output weighing alike: noise decides where the optimum is, not how to get near it.
    sizes = [math.sqrt(float(np.mean([np.var(run[o]) for run in runs]))) for o in structure.outputs]
    alike = [1.0 / (COARSE_SHARE * size) for size in sizes]
    starts: list[tuple[float, str]] = []
    if start is None:
        coarse: list[Any] = []
        attempts = delayed_attempts(runs, problem, initial, threads)

        def tried(attempt: Attempt, evaluations: int, of: FreeProblem, begin: Any) -> Attempt | None:
            try:
                return descend(of, coarse, signals, begin, attempt, evaluations=evaluations)
            except FtlmError:
                # A start whose free run is not finite is no start; if none is left, that is said below.
                return None

        def race(
            runners: list[Attempt], evaluations: int, of: FreeProblem = problem, begin: Any = initial
        ) -> list[Attempt]:
            ended, count = [], len(runners)
            with ThreadPoolExecutor(threads) as pool:
                try:
                    for done, attempt in enumerate(
                        pool.map(tried, runners, *([v] * count for v in (evaluations, of, begin)))
                    ):
                        if attempt is not None:
                            ended.append(attempt)
                        if progress is not None:
                            progress(min(done, len(attempts) - 1), len(attempts))
                except BaseException:
                    pool.shutdown(cancel_futures=True)
                    raise
            return sorted(ended, key=lambda a: a.level)

        def thinned(weights: Sequence[float], every: int) -> list[Any]:
            return experiments(weights, every, decimation)

        level = 1
        while True:
            coarse = thinned(alike, level)
            reached = race(attempts, FIRST_LAP)
            # A stiff equation may have no stable scheme, and so no start, on a coarse grid.
            settled = bool(reached) and not grid_matters(problem, thinned, alike, initial, reached[0], level)
            if settled or level >= FINEST:
                break
            # The coarse grid has optima of its own: once more from the same starts, on half the step.
            level *= 2
        # Whatever a simpler equation reaches, this one reaches too: it starts there with the term's coefficient at 0,
        # or with a pole too fast to see.
        others: list[Simpler | LowerOrder] = [*simpler(problem, initial), *lower_orders(problem, runs, initial)]
        for less in others if reached else []:
            laps = race(
                delayed_attempts(runs, less.problem, less.initial, threads), FIRST_LAP, less.problem, less.initial
            )
            laps = race(laps[:FINALISTS], SECOND_LAP, less.problem, less.initial)
            reached = sorted(reached + [less.embedded(a, problem) for a in laps[:1]], key=lambda a: a.level)
        ahead = max(FEWEST, len(reached) // RUNNERS)
        rest = reached[ahead:]
        reached = race(reached[:ahead], SECOND_LAP)
        floor = float(
            np.mean([(noise[o] / (COARSE_SHARE * size)) ** 2 for o, size in zip(structure.outputs, sizes, strict=True)])
        )
        if reached and reached[0].level > ABOVE_FLOOR * floor:
            # Noise alone would leave less: those behind may yet be on the way to where it does.
            rest = race(rest, SECOND_LAP)
        reached = by_both_grids(problem, thinned(alike, 2 * level), initial, reached + rest)
        starts = [(a.level, a.origin) for a in reached]
        kept = distinct(reached)[:FINALISTS]
        finalists = [a for a in kept if a.level <= CONTENDER * kept[0].level]
        if progress is not None:
            progress(len(attempts), len(attempts))
    else:
        orders, coefficients, delays = problem.split([start[n] for n in problem.names])
        finalists = [Attempt(orders, coefficients, "given start", {}, delays)]
    if not finalists:
        raise ConvergenceError(
            f"no start of {', '.join(structure.outputs)} has a finite free run; "
            "check the signs of the data and the bounds"
        )
    # Where a step passes faster than the samples see, a grid as coarse as the samples has an optimum of its own.
    every = 1
    while every < FINEST and grid_matters(problem, experiments, weights, initial, finalists[0], every):
        every *= 2
    near = experiments(alike, every)
    ends = []
    for attempt in finalists:
        try:
            ends.append(descend(problem, near, signals, initial, attempt, evaluations=60))
        except FtlmError:
            # No finite free run on this grid; the others have one.
            if attempt is finalists[-1] and not ends:
                raise
    best = by_both_grids(problem, experiments(alike, 2 * every), initial, ends)[0]
    best = lowest(problem, near, signals, initial, best, evaluations=120)
    best = descend(problem, experiments(weights, every), signals, initial, best, evaluations=120)

    def weighed(attempt: Attempt, weights: list[float], every: int) -> tuple[Attempt, list[float]]:
        """Descend on a grid until the weights are those of the residuals, pooled over runs."""
        for _ in range(4):
            full = experiments(weights, every)
            attempt = descend(problem, full, signals, initial, attempt, evaluations=120, plain=True)
            levels = residual_levels(attempt, full, structure)
            if all(abs(v - 1.0) < SETTLED for v in levels.values()):
                break
            weights = [w / max(levels[o], 1e-300) for w, o in zip(weights, structure.outputs, strict=True)]
        return attempt, weights

    best, weights = weighed(best, weights, every)
    estimate, settled = best.values, not refine
    while not settled and every < FINEST:
        # On a finer grid residuals may shrink to their noise, so weights follow anew.
        finer, weights = weighed(best, weights, 2 * every)
        errors = np.sqrt(np.diag(covariance(finer, experiments(weights, 2 * every), structure)))
        # The scheme is of second order, so two grids tell the limit (Richardson); a third tells whether that is so.
        # Of a flat valley in which neither stood still they tell nothing.
        still = finer.found["status"] == "converged" and best.found["status"] == "converged"
        limit = finer.values + (finer.values - best.values) / 3.0 if still else finer.values
        settled = bool(np.all(np.abs(limit - estimate) <= REFINED * errors))
        best, every, estimate = finer, 2 * every, limit
    low, high = np.array(problem.all_bounds).T
    orders, coefficients, delays = problem.split(np.clip(estimate, low, high).tolist())
    full = experiments(weights, every)
    levels = residual_levels(best, full, structure)
    residuals = split_residuals(best, full, structure)
    return JointFit(
        orders=dict(zip(problem.orders, orders, strict=True)),
        coefficients=dict(zip(problem.coefficients, coefficients, strict=True)),
        covariance=covariance(best, full, structure),
        noise={o: levels[o] / w for (o, w) in zip(structure.outputs, weights, strict=True)},
        cost=float(best.found["cost"]),
        samples=len(best.found["residuals"]),
        refinement=every,
        settled=settled,
        converged=best.found["status"] == "converged",
        starts=starts,
        residuals=residuals,
        products=dict(problem.products),
        delays=dict(zip(problem.delays, delays, strict=True)),
    )


def by_both_grids(problem: FreeProblem, finer: list[Any], initial: Any, reached: Sequence[Attempt]) -> list[Attempt]:
    """Attempts by their cost on their own grid or on the finer one, whichever is the larger; the least first.

    The pulse scheme of a stiff equation has a mode that alternates from pulse to pulse. A fit may use it to follow
    noise, at the cost of a free run that no other grid has.
    """

    def worse(attempt: Attempt) -> float:
        try:
            there = descend(problem, finer, problem.structure.signals, initial, attempt, evaluations=1)
        except FtlmError:
            return math.inf
        return max(attempt.level, there.level)

    costs = [worse(a) for a in reached]
    if not any(map(math.isfinite, costs)):
        return sorted(reached, key=lambda a: a.level)
    return [reached[i] for i in sorted(range(len(reached)), key=lambda i: (costs[i], reached[i].level))]


def grid_matters(
    problem: FreeProblem,
    experiments: Callable[[Sequence[float], int], list[Any]],
    weights: Sequence[float],
    initial: Any,
    attempt: Attempt,
    every: int,
) -> bool:
    """Whether halving the step moves the simulated samples by a share of their noise that the fit would notice."""
    signals = problem.structure.signals
    try:
        ends = [
            descend(problem, experiments(weights, e), signals, initial, attempt, evaluations=1).found["residuals"]
            for e in (every, 2 * every)
        ]
    except FtlmError:
        # Finite on one grid and not on the other: it matters.
        return True
    moved: Floats = np.asarray(ends[1]) - np.asarray(ends[0])
    return bool(np.mean(moved**2) > NOTICED**2)


def first_noise(runs: Sequence[Run], structure: Structure) -> dict[str, float]:
    """A first guess of the noise of each output, from second differences, but not below a share of its size."""
    out = {}
    for name in structure.outputs:
        size = float(np.sqrt(np.mean([np.var(run[name]) for run in runs])))
        out[name] = max(float(np.median([noise_of(run[name]) for run in runs])), 1e-3 * size)
    return out


def distinct(reached: Sequence[Attempt]) -> list[Attempt]:
    """Attempts, best first, without those that ended in the optimum of an earlier one."""
    kept: list[Attempt] = []
    for attempt in reached:
        values = np.array(attempt.orders)
        same = any(
            abs(k.level - attempt.level) <= SAME_COST * k.level and np.allclose(values, k.orders, atol=0.02)
            for k in kept
        )
        if not same:
            kept.append(attempt)
    return kept


def split_residuals(attempt: Attempt, experiments: list[Any], structure: Structure) -> list[dict[str, Floats]]:
    """Weighted residuals by run and output."""
    flat = np.asarray(attempt.found["residuals"])
    out, at = [], 0
    for _, _, samples, _, _ in experiments:
        compared = samples.shape[1] - 2
        part = {}
        for output in structure.outputs:
            part[output] = flat[at : at + compared]
            at += compared
        out.append(part)
    return out


def residual_levels(attempt: Attempt, experiments: list[Any], structure: Structure) -> dict[str, float]:
    """Root mean square of the weighted residuals by output, over all runs."""
    parts = split_residuals(attempt, experiments, structure)
    return {o: float(np.sqrt(np.mean(np.concatenate([p[o] for p in parts]) ** 2))) for o in structure.outputs}


def covariance(attempt: Attempt, experiments: list[Any], structure: Structure) -> Floats:
    """Covariance of the parameters: classical where residuals are white, robust to their colour where not.

    The robust form is the sandwich with Bartlett weights (doi:10.2307/1913610).
    """
    jacobian = np.asarray(attempt.found["jacobian"])
    parts = split_residuals(attempt, experiments, structure)
    spread = np.linalg.norm(jacobian, axis=1)
    spread = np.where(spread > 0, spread, 1.0)
    scaled = jacobian / spread[:, None]
    bread = np.linalg.pinv(scaled @ scaled.T, rcond=1e-14, hermitian=True)
    count = jacobian.shape[1]
    variance = 2.0 * float(attempt.found["cost"]) / max(count - jacobian.shape[0], 1)
    if all(is_white(series) for part in parts for series in part.values()):
        middle = variance * bread
    else:
        meat = np.zeros_like(bread)
        at = 0
        for part in parts:
            for series in part.values():
                scores = scaled[:, at : at + series.size] * series
                at += series.size
                lags = int(4 * series.size**LAG_POWER)
                meat += scores @ scores.T
                for lag in range(1, min(lags, series.size - 1)):
                    cross = scores[:, lag:] @ scores[:, :-lag].T
                    meat += (1.0 - lag / lags) * (cross + cross.T)
        middle = bread @ meat @ bread
    result: Floats = middle / np.outer(spread, spread)
    return result


def is_white(series: Floats, lags: int = 25) -> bool:
    """Ljung-Box test at 1 %: whether autocorrelations up to ``lags`` could be those of white noise."""
    e = series - np.mean(series)
    power = float(e @ e)
    if power == 0.0 or e.size <= lags + 1:
        return True
    correlations = np.array([float(e[k:] @ e[:-k]) / power for k in range(1, lags + 1)])
    statistic = e.size * (e.size + 2) * float(np.sum(correlations**2 / (e.size - np.arange(1, lags + 1))))
    # 99 % quantile of chi-squared by Wilson and Hilferty, good to 0.1 % at 25 degrees of freedom.
    quantile = lags * (1 - 2 / (9 * lags) + 2.3263478740408408 * math.sqrt(2 / (9 * lags))) ** 3
    return statistic <= quantile
