"""From measured frequency responses to a model: orders, coefficients, delays, what they are worth."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftlm.base.arrays import Floats, as_floats
from ftlm.base.checks import check_known
from ftlm.base.errors import ConvergenceError, DataError, ModelError
from ftlm.base.log import LOG
from ftlm.base.pace import between, expected
from ftlm.base.progress import Course, Progress
from ftlm.base.statistics import ROUNDING, chi_squared_99, is_white
from ftlm.data.language import equation
from ftlm.data.orders import Values
from ftlm.data.response import FrequencyData, as_frequency_data
from ftlm.data.solved import Estimate
from ftlm.data.structures import Structure
from ftlm.fit.damped import Fitted, damped
from ftlm.fit.levy import starts
from ftlm.fit.response import ResponseProblem
from ftlm.fit.uncertainty import covariance_of
from ftlm.identification.frequency_result import FrequencyIdentification
from ftlm.model.model import Model

Weights = Literal["auto", "relative", "uniform", "deviation"]
#: Two fits whose sums of squares differ by no more than this share ended at one optimum.
SAME = 1e-6
#: Residuals below this share of the response leave nothing to gain.
FLOOR = 1e-13
#: Frequencies of a record on which starts race.
RACING = 800
#: Shares of the whole that are done once starts are found, and once they have raced.
STARTED, RACED = 0.25, 0.85
#: Fits took between these multiples of what their numbers and frequencies let expect.
CAME_TO = (0.4, 4.0)
#: Lags at which residuals are looked at, from one frequency to the next.
LAGS = 8


def identify_frequency(
    data: FrequencyData | Sequence[FrequencyData], structure: Structure | str, *, weights: Weights | ArrayLike = "auto",
    orders: Mapping[str, Values] | None = None, fixed: Mapping[str, float] | None = None,
    delay: Mapping[str, float | tuple[float, float]] | None = None, start: Mapping[str, float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FrequencyIdentification:  # fmt: skip
    """Identify orders, coefficients and delays of equations from a measured frequency response or impedance.

    The same equations as of runs over time: ``"D^alpha y = a0 y + b0 u"`` has the response
    b0 / ((jω)^α - a0), and ``"D^alpha U = a U + r D^alpha I + b I"`` is a resistor before a depressed arc. Starts come
    by themselves, from linear least squares over the lattice of orders; then all numbers move together, by damped least
    squares of the complex residuals with exact derivatives.

    Parameters
    ----------
    data
        One record, or several: of other outputs and inputs, or of other bands.
    structure
        What to identify; see :func:`ftlm.equation`. Several outputs follow together from the inputs.
    weights
        ``"deviation"``: residuals over the records' standard deviations. ``"relative"``: over the size of the response
        at each frequency, as noise in proportion to the size asks for. ``"uniform"``: as they are. ``"auto"``
        (default): deviation where all records have one, else relative. An array, of one record: a standard deviation
        of real and imaginary part for each frequency.
    orders, fixed, delay
        See :func:`ftlm.equation`: lattices of orders bound them, too; a delay (least, largest) is estimated.
    start
        Values of free numbers by name to start from besides; what it leaves out is 1, 0 of a delay.
    progress
        Called with parts done and parts in all.

    Returns
    -------
    FrequencyIdentification
        Prints well; ``.model`` simulates over time, draws and saves.

    Raises
    ------
    DataError
        Data that are none, of signals that the equations do not have, too few for the free numbers, or of size 0 under
        relative weights.
    ModelError
        A structure with nothing free, friction, limits of inputs, an offset, a sensor filter or a law of coefficients;
        weights or names that are not known.
    ConvergenceError
        No start with a finite response.
    """
    wanted = _structure(structure, orders, fixed, delay)
    records = _fitting(as_frequency_data(data), wanted)
    kind, weight = _weights(records, weights)
    problem = ResponseProblem(wanted, records, weight)
    count, numbers = 2 * sum(r.frequency.size for r in records), len(problem.names)
    if count <= numbers:
        raise DataError(
            f"{count // 2} frequencies give {count} numbers, and {numbers} are free ({', '.join(problem.names)}); "
            "measure more frequencies, or fix numbers"
        )
    if isinstance(progress, Progress):
        progress.expect("the fit", *between(expected(0.007 * numbers**2 + 2e-6 * numbers * count, 1), CAME_TO))
    course = Course(progress)
    rows, limits, words = problem.constraints()
    LOG.info("identifying %s from %s", ", ".join(problem.names), ", ".join(r.name for r in records))
    total = sum(float(np.sum(np.abs(r.response * w) ** 2)) for r, w in zip(records, weight, strict=True))
    # Starts race on no more frequencies than tell them apart; the best goes on with all.
    few, light = zip(*(_thinned(r, w) for r, w in zip(records, weight, strict=True)), strict=True)
    racing = problem if count <= 2 * RACING else ResponseProblem(wanted, few, light)
    begun = [*_begun(racing, start, *racing.constraints()[:2]), *starts(racing)]
    course.at(STARTED)
    fits = []
    for values in begun:
        fits.append(_fit(racing, values, *racing.constraints()[:2], FLOOR**2 * total))
        course.at(STARTED + (RACED - STARTED) * len(fits) / len(begun))
    fits = [f for f in fits if math.isfinite(f.cost)]
    if not fits:
        raise ConvergenceError(
            "no start has a finite response: the lattice of orders is empty or singular; widen orders=, or give start="
        )
    first = min(fits, key=lambda f: f.cost)
    reached = sum(f.cost <= first.cost * (1 + SAME) + 1e4 * FLOOR**2 * total for f in fits)
    # A last race from where the best ended, so that what a wall had cut goes on.
    best = _fit(problem, problem.scaled(racing.in_seconds(first.values)), rows, limits, FLOOR**2 * total)
    if racing is problem and first.cost < best.cost:
        best = first
    course.at(1.0)
    held = [words[k] for k in best.held]
    result = _result(problem, records, best, kind, (reached, len(fits)), held, exact=best.cost <= ROUNDING**2 * total)
    LOG.info("identified: %s", result.verdict())
    for warning in result.warnings:
        LOG.warning("%s", warning)
    return result


def _structure(
    structure: Structure | str, orders: Mapping[str, Values] | None, fixed: Mapping[str, float] | None,
    delay: Mapping[str, float | tuple[float, float]] | None,
) -> Structure:  # fmt: skip
    """What is to be identified, all of its outputs together; refuses what a frequency response does not know."""
    wanted = equation(structure) if isinstance(structure, str) else structure
    if not isinstance(wanted, Structure):
        raise ModelError(f"structure is {type(structure).__name__}; give an equation: 'D^alpha y = a0 y + b0 u'")
    if fixed:
        check_known("fixed coefficient", fixed, wanted.coefficient_names)
    wanted = wanted.with_delays(delay or {}).with_orders(orders or {}).with_coefficients(fixed or {})
    lacking = "which a frequency response does not know"
    if wanted.has_friction:
        raise ModelError(f"the equations have friction, {lacking}; identify runs over time, or leave it out")
    if wanted.limits:
        raise ModelError(f"{wanted.limits[0].signal} saturates or has a dead zone, {lacking}; identify runs over time")
    if wanted.offset != "none":
        raise ModelError(f"the equations have an offset, {lacking}; leave '+ c' out, or offset=")
    if wanted.sensor_filter is not None:
        raise ModelError("the structure has a sensor filter; divide the data by its response, and leave it out")
    if wanted.coefficient_law:
        raise ModelError("the structure has a law of its coefficients, which this fit does not keep; leave laws= out")
    if not (wanted.order_names or wanted.coefficient_names or wanted.free_inputs):
        raise ModelError("nothing is free: every order, coefficient and delay is a number; name what is unknown")
    return replace(wanted, coupling="simulated", initial="auto")


def _fitting(records: Sequence[FrequencyData], structure: Structure) -> list[FrequencyData]:
    """The records with the names of what they are of; refuses those of other signals, and equations without any."""
    outputs = structure.outputs
    inputs = tuple(s for s in structure.signals if s not in outputs)
    if not inputs:
        raise ModelError(f"the equations of {', '.join(outputs)} have no input; add what drives them, as in '+ b0 u'")
    found = []
    for record in records:
        own = {"output": record.output, "input": record.input}
        for side, known in (("output", outputs), ("input", inputs)):
            if not own[side]:
                if len(known) > 1:
                    raise DataError(
                        f"{record.name} does not say its {side}, and the equations have {', '.join(known)}; say "
                        f"{side}= when loading it"
                    )
                own[side] = known[0]
            elif own[side] not in known:
                raise DataError(
                    f"{record.name} has the {side} {own[side]!r}, which is no {side} of the equations; these have "
                    f"{', '.join(known)}: write the equation in the names of the data, or say {side}= when loading"
                )
        found.append(replace(record, output=own["output"], input=own["input"]))
    for output in outputs:
        if not any(r.output == output for r in found):
            raise DataError(f"no record is of {output}, which has an equation; give one, or leave the equation out")
    for name in inputs:
        if not any(r.input == name for r in found):
            raise DataError(f"no record is from {name}, an input of the equations; give one, or leave it out")
    return found


def _weights(records: Sequence[FrequencyData], weights: object) -> tuple[str, list[Floats]]:
    """What residuals are multiplied by."""
    if not isinstance(weights, str):
        if len(records) > 1:
            raise ModelError("weights= as an array are of one record; give each record its deviation instead")
        (record,) = records
        return "deviation", [1.0 / _stated(record, weights)]
    if weights not in ("auto", "relative", "uniform", "deviation"):
        raise ModelError(
            f"weights={weights!r} is not known; use 'auto', 'relative', 'uniform', 'deviation' or standard deviations"
        )
    known = [r.deviation for r in records]
    if weights == "deviation" or (weights == "auto" and all(d is not None for d in known)):
        without = [r.name for r, d in zip(records, known, strict=True) if d is None]
        if without:
            raise DataError(f"{without[0]} states no standard deviation; use weights='relative' or give deviation=")
        return "deviation", [1.0 / d for d in known if d is not None]
    if weights == "uniform":
        return "uniform", [np.ones(r.frequency.size) for r in records]
    for record in records:
        size = np.abs(record.response)
        if not np.all(size > 0):
            at = int(np.argmin(size))
            raise DataError(
                f"{record.name}: the response is 0 at row {at}, {int(np.sum(size == 0))} in all, and has no relative "
                "weight; leave such rows out, or use weights='uniform'"
            )
    return "relative", [1.0 / np.abs(r.response) for r in records]


def _stated(record: FrequencyData, weights: object) -> Floats:
    """Standard deviations that stand in the place of a record's own."""
    given = as_floats("weights", weights)
    if given.shape != record.frequency.shape:
        raise DataError(f"weights has shape {given.shape}, the data {record.frequency.shape}; give one deviation each")
    return np.asarray(replace(record, deviation=given).deviation)


def _thinned(record: FrequencyData, weight: Floats) -> tuple[FrequencyData, Floats]:
    """A record of no more frequencies than a race needs, spread evenly over its own, with their weights."""
    if record.frequency.size <= RACING:
        return record, weight
    order = np.argsort(record.frequency, kind="stable")
    kept = order[np.linspace(0, order.size - 1, RACING).astype(int)]
    return replace(record, frequency=record.frequency[kept], response=record.response[kept], deviation=None), weight[
        kept
    ]


def _begun(problem: ResponseProblem, start: Mapping[str, float] | None, rows: Floats, limits: Floats) -> list[Floats]:
    """The start that a person gives."""
    if start is None:
        return []
    if not isinstance(start, Mapping):
        raise ModelError(f"start is {type(start).__name__}; give values by name, such as {{'alpha': 0.8}}")
    check_known("start", start, problem.names)
    free = len(problem.orders) + len(problem.coefficients)
    values = np.array([float(start.get(n, 1.0 if k < free else 0.0)) for k, n in enumerate(problem.names)])
    begun = problem.scaled(values)
    if not (np.all(np.isfinite(values)) and np.all(rows @ begun <= limits + 1e-9)):
        raise ModelError("start= is out of the bounds of orders or delays, or not finite; choose values within them")
    return [begun]


def _fit(problem: ResponseProblem, values: Floats, rows: Floats, limits: Floats, floor: float) -> Fitted:
    def cost(numbers: Floats) -> float:
        left, _ = problem.residuals(numbers, slopes=False)
        return float(left @ left)

    if not math.isfinite(cost(values)):
        return Fitted(values, math.inf, False, 1, ())
    return damped(problem.residuals, cost, values, rows, limits, floor=floor)


def _result(
    problem: ResponseProblem, records: list[FrequencyData], best: Fitted, kind: str, reached: tuple[int, int],
    held: list[str], *, exact: bool,
) -> FrequencyIdentification:  # fmt: skip
    left, slopes = problem.residuals(best.values)
    steep = problem.slopes_in_seconds(best.values, slopes)
    values = problem.in_seconds(best.values)
    rising = _rising(records)
    left, steep = left[rising], steep[rising]
    series = _series(records, left)
    free = left.size - values.size
    chi = best.cost / free
    too_large = kind == "deviation" and best.cost > chi_squared_99(free)
    warnings: list[str] = []
    if kind == "deviation" and not too_large:
        covariance = covariance_of(steep.T, [np.zeros(e.size) for e in series], float(free))
    else:
        covariance = covariance_of(steep.T, series, best.cost)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    white = exact or all(is_white(e, min(LAGS, max(e.size // 4, 1))) for e in series)
    factor = float(_student(free)) if kind != "deviation" or too_large else NormalDist().inv_cdf(0.975)
    names = problem.names
    standard = dict(zip(names, errors.tolist(), strict=True))
    if too_large:
        warnings.append(
            f"residuals are {math.sqrt(chi):.3g} times the standard deviations that the data state (99 %): the model "
            "leaves something out, or they are too small; intervals are widened to what is left over"
        )
    if not white:
        warnings.append(
            "residuals are not white: from one frequency to the next they follow each other, so the model leaves "
            "something out"
        )
    if not best.converged:
        warnings.append("the fit ended before it stood still")
    warnings += [f"an order or a delay is on its bound: {w}" for w in held]
    warnings += _untold(problem, values, standard)
    named = dict(zip(names, values.tolist(), strict=True))
    model = _model(problem, records, named, values, covariance, standard, warnings)
    intervals = {n: (named[n] - factor * e, named[n] + factor * e) for n, e in standard.items()}
    return FrequencyIdentification(
        model, tuple(records), kind, named, standard, intervals, names, covariance,
        chi if kind == "deviation" else None, best.converged, reached, white, tuple(warnings),
    )  # fmt: skip


def _rising(records: Sequence[FrequencyData]) -> NDArray[np.intp]:
    """Places of residuals with the frequencies of each record in their order."""
    places, at = [], 0
    for record in records:
        places.append(at + np.argsort(record.frequency, kind="stable"))
        at += record.frequency.size
    every = np.concatenate(places)
    return np.concatenate([every, at + every])


def _series(records: Sequence[FrequencyData], left: Floats) -> list[Floats]:
    """Real and imaginary parts of every record's residuals, one after the other as they stand in `left`."""
    ends = np.cumsum([r.frequency.size for r in records])
    half = left.size // 2
    return [*np.split(left[:half], ends[:-1]), *np.split(left[half:], ends[:-1])]


def _untold(problem: ResponseProblem, values: Floats, standard: Mapping[str, float]) -> list[str]:
    """Numbers that the data do not tell, or hardly."""
    unseen = [n for n, e in standard.items() if not math.isfinite(e)]
    out = []
    if unseen:
        out.append(f"moved together they change nothing: {', '.join(unseen)}; leave a term out, or fix one of them")
    for name, value in zip(problem.names, values.tolist(), strict=True):
        error = standard[name]
        vague = error > 0.25 if name in problem.orders else error > 0.5 * abs(value)
        if math.isfinite(error) and vague:
            out.append(f"{name} = {value:.4g} ± {error:.2g} cannot be told from other values; fix it, or leave it out")
    return out


def _model(
    problem: ResponseProblem, records: Sequence[FrequencyData], named: Mapping[str, float], values: Floats,
    covariance: Floats, standard: Mapping[str, float], warnings: Sequence[str],
) -> Model:  # fmt: skip
    """The model with what its file keeps of the identification."""
    orders = {n: round(named[n], 9) for n in problem.orders}
    late = {free.signal: named[free.name] for free in problem.structure.free_inputs}
    found = problem.structure.with_delays(late).with_orders(orders)
    found = found.with_coefficients({n: named[n] for n in problem.coefficients})
    spread = None
    if np.all(np.isfinite(covariance)):
        rows = []
        for item in problem.structure.equations:
            for order, term in [(item.order, None), *((t.order, t) for t in item.terms)]:
                row = np.zeros(values.size)
                for n, w in order.weights:
                    row[problem.names.index(n)] = w
                rows.append(row)
                if term is not None:
                    row = np.zeros(values.size)
                    if isinstance(term.coefficient, str):
                        row[problem.names.index(term.coefficient)] = term.factor
                    rows.append(row)
        table = np.array(rows)
        spread = tuple(tuple(row) for row in (table @ covariance @ table.T).tolist())
    units: dict[str, str] = {}
    if all(r.unit == "Ω" for r in records):
        units = {r.output: "V" for r in records} | {r.input: "A" for r in records}
    estimate = Estimate(
        method="frequency-response", runs=tuple(dict.fromkeys(r.name for r in records)), values=dict(named),
        standard_errors={n: e if math.isfinite(e) else None for n, e in standard.items()}, covariance=spread,
        warnings=tuple(warnings),
    )  # fmt: skip
    return Model(found, orders, units, None, {"identified from": "frequency response"}, estimate)


def _student(degrees: int) -> float:
    """97.5 % quantile of Student's distribution, by its series about the normal one; good to 1 % from 4 degrees."""
    z, n = NormalDist().inv_cdf(0.975), float(degrees)
    terms = [(z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96, (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384]
    return z + sum(t / n ** (k + 1) for k, t in enumerate(terms))
