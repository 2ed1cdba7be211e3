"""Values printed in the paper's Tables 3 to 7, with recomputed tables and simulations of the printed models.

Paper: Wang, Li, Li, Liang, Gao, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072. All printed digits are included. In
this module, p is the innovation length and K0 the prior covariance of multi-innovation. Equation and table numbers are
those of the paper.
"""

from __future__ import annotations

import csv
import math
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from itertools import product
from operator import itemgetter
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.analysis.poles import Stability, stability
from ftlm.arm.flexible_link import ORDER_OF, flexible_link
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.fractional_calculus import haar_transform
from ftlm.kernels import block_pulse_kernel, pulse_means
from ftlm.model.model import Model
from ftlm.order_search.options import COMPARED_INNOVATION_LENGTHS, OrderGrid
from ftlm.order_search.result import SearchResult
from ftlm.order_search.search import rank_orders
from ftlm.plot.comparison_charts import pulse_times
from ftlm.reproduction.simulated_arm import ANGLE_NAMES, PAPERS_ARM, StageNumber, demo_run, signals_of
from ftlm.simulation.discretization import record, sensor_series
from ftlm.structure.equation import Equation, Term
from ftlm.structure.order import Order
from ftlm.structure.structure import Structure
from ftlm.svg.html_page import read_resource
from ftlm.utils.formatting import SUPERSCRIPT_DIGITS, Exact, attributes, finite, json_value
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Metrics, compare_means, metrics

#: Innovation lengths p of the paper, their minimum and maximum, and the paper's number of block pulses.
INNOVATION_LENGTHS = COMPARED_INNOVATION_LENGTHS
FIRST_P, LAST_P = INNOVATION_LENGTHS[0], INNOVATION_LENGTHS[-1]
PULSE_COUNT = 2048
#: Letters of the orders and of the coefficients, in the order of the tables' columns.
ORDER_LETTERS, COEFFICIENT_LETTERS = ("gamma", "alpha", "beta", "mu"), ("a", "b", "d", "g")
#: Prior covariance that is so large that only the data determine the estimates.
WEAK_PRIOR = 1e10
#: Prior covariances K0 that are compared: that of the paper (identity matrix), and a weak prior.
PRIOR_COVARIANCES = (1.0, WEAK_PRIOR)
#: Options of every order search, and of every recursion of multi-innovation. They are given explicitly, so that new
#: defaults would not change a table.
SEARCH_OPTIONS: dict[str, Any] = {"criterion": "output-error", "norm": "l1"}
RECURSION_OPTIONS: dict[str, Any] = {"row_basis": "haar"}


@dataclass(frozen=True)
class PublishedRow:
    """Row of one of the paper's Tables 4 to 7.

    Orders are named alpha, beta, gamma and mu, and coefficients a, b, d and g. The criteria are the sum of absolute
    errors, RMSE and NR, eqs. (45)-(47). They are NaN if the table does not contain them.
    """

    orders: Mapping[str, float]
    coefficients: Mapping[str, float]
    error: float = math.nan
    rmse: float = math.nan
    nr: float = math.nan

    @property
    def a(self) -> float:
        """Coefficient a."""
        return self.coefficients["a"]

    @property
    def criteria(self) -> tuple[float, float, float]:
        """Sum of absolute errors, RMSE and normalized residual NR: eqs. (45), (46) and (47) of the paper."""
        return self.error, self.rmse, self.nr


def read_paper_table(name: str) -> list[dict[str, str]]:
    """Return the rows of the csv file `name` in the folder of this module, each as texts by column name."""
    return list(csv.DictReader(read_resource(name, "ftlm.reproduction").splitlines()))


@cache
def read_texts(name: str) -> dict[str, Any]:
    """Return the contents of the file `name`.toml in the folder of this module, by key."""
    return tomllib.loads(read_resource(f"{name}.toml", "ftlm.reproduction"))


def page_text(key: str, **values: Any) -> str:
    """Return the text of page.toml with this key, in which `values` replace the placeholders."""
    text: str = read_texts("page")["texts"][key]
    return text.format(**values)


def _read_rows() -> dict[tuple[str, str, str], PublishedRow]:
    """Return the rows of the paper's Tables 4 to 7 by (table number, angle, model)."""
    rows = {}
    for cells in read_paper_table("published_tables.csv"):
        place = cells.pop("table"), cells.pop("angle"), cells.pop("model")
        values = {name: Exact(text) for name, text in cells.items() if text}
        orders = {name: values.pop(name) for name in ORDER_LETTERS if name in values}
        coefficients = {name: values.pop(name) for name in COEFFICIENT_LETTERS if name in values}
        rows[place] = PublishedRow(orders, coefficients, **values)
    return rows


_ROWS_BY_PLACE = _read_rows()
#: Rows of the integer-order models in Tables 4 and 5, by angle.
INTEGER_ROWS = {o: row for (_, o, model), row in _ROWS_BY_PLACE.items() if model == "integer"}
#: Rows of the fractional models in Tables 4 and 5, by angle and innovation length.
FRACTIONAL_ROWS = {
    o: {int(model): row for (_, angle, model), row in _ROWS_BY_PLACE.items() if angle == o and model.isdigit()}
    for o in ANGLE_NAMES
}
#: Rows of Table 6 (models from the genetic algorithm), by angle.
GENETIC_ROWS = {o: _ROWS_BY_PLACE["6", o, "genetic"] for o in ANGLE_NAMES}
#: Table 7: criteria (45)-(47) of the genetic algorithm and of multi-innovation, by angle.
TABLE_7_CRITERIA = {
    o: tuple(_ROWS_BY_PLACE["7", o, model].criteria for model in ("genetic", "multi-innovation")) for o in ANGLE_NAMES
}
#: Table 3 by the paper's names of the parameters: value, printed unit, joint, and field of `LinkParameters`.
TABLE_3 = {
    each["parameter"]: (float(each["value"]), each["unit"], int(each["stage"]), each["field"])
    for each in read_paper_table("published_parameters.csv")
}


def parameter_name(letter: str, output: str) -> str:
    """Return an order's or coefficient's name with the index of the angle: alpha and theta11 give alpha1."""
    return f"{letter}{1 + ANGLE_NAMES.index(output)}"


def stage_of(output: str) -> StageNumber:
    """Return the number of the joint (stage) to which an angle belongs: 1 for theta11 and theta12, else 2."""
    return 1 if output[-2] == "1" else 2


def printed_saturation(output: str) -> tuple[float, float, float]:
    """Fit the curve x·p / (p + c) to the printed coefficient a of an angle at innovation lengths p = 1 and 7.

    Parameters
    ----------
    output
        Name of the angle, such as ``"theta11"``.

    Returns
    -------
    tuple of float
        x, c, and the largest relative error of the curve at p = 3 and 5.
    """
    first, *between, last = ((p, row.a) for p, row in FRACTIONAL_ROWS[output].items())
    # 1/a = 1/x + (c/x)/p is a line in 1/p.
    slope = (1 / first[1] - 1 / last[1]) / (1 / first[0] - 1 / last[0])
    x = 1 / (1 / first[1] - slope / first[0])
    c = slope * x
    return x, c, max(abs(x * p / (p + c) / a - 1) for p, a in between)


def neighboring_values(value: float, increment: float, steps: int) -> list[float]:
    """Return the 2 steps + 1 values from value - steps·increment to value + steps·increment."""
    return [round(value + k * increment, 9) for k in range(-steps, steps + 1)]


def best_orders(run: Run, single: Structure, grid: OrderGrid, p: int, prior: float, **work: Any) -> SearchResult:
    """Return the result of an order search by multi-innovation, whose table has only the best candidate.

    `p` is the innovation length, `prior` the prior covariance K0, and `work` are further options.
    """
    options = {"innovation_length": p, "prior_covariance": prior, **RECURSION_OPTIONS, **SEARCH_OPTIONS, **work}
    return rank_orders(run, single, grid, top=1, coefficients="multi-innovation", **options)


def prior_text(prior: float) -> str:
    """Return a prior covariance as text: 1, or a power of ten such as 10¹⁰."""
    return "1" if prior == PRIOR_COVARIANCES[0] else f"10{str(round(math.log10(prior))).translate(SUPERSCRIPT_DIGITS)}"


#: Interpretations of the terms with coefficients a, b, d and g. Each has a meaning, the orders of a, b and d, and the
#: signal in every term of the equation of a hub angle and of a deflection: the angle itself ("own"), the other angle of
#: its joint ("other"), or the current ("u").
TERM_INTERPRETATIONS: Mapping[str, Mapping[str, Any]] = read_texts("page")["terms"]
#: Prior covariances K0 that are tried to match the printed tables: eight per decade.
PRIOR_GRID = tuple(float(v) for v in np.logspace(-3, 5, 65))
#: Limits and increment (the paper's) of the grid on which the printed orders are ranked.
MIN_GRID_ORDER, MAX_GRID_ORDER, GRID_INCREMENT = 1.6, 1.95, 0.05
#: Maximum ratio between a recomputed and a printed coefficient of equal sign, in either direction, for agreement.
MAX_COEFFICIENT_RATIO = 1.25


@dataclass(frozen=True)
class Interpretation:
    """Interpretation of the settings that the paper does not state.

    Parameters
    ----------
    terms
        Signals in the terms of an equation, as a key of `TERM_INTERPRETATIONS`.
    filtered
        Whether the deflections passed the 2 Hz low-pass filter of the arm's stock real-time model.
    reversed
        Whether terms in the angle itself are on the left-hand side, as in a transfer function. This reverses their
        sign.
    prior
        Prior covariance K0.
    """

    terms: str
    filtered: bool
    reversed: bool
    prior: float

    def __str__(self) -> str:
        parts = [self.terms, "stock filter" if self.filtered else "no filter"]
        return ", ".join([*parts, *["own terms on the left"] * self.reversed, f"K0 = {self.prior:.3g}"])


@dataclass(frozen=True)
class Row:
    """Coefficients and metrics of the equation error, recomputed at the printed orders for one innovation length."""

    coefficients: dict[str, float]
    equation: Metrics


@dataclass(frozen=True)
class AsPrinted:
    """Part of the paper's Table 4 or 5 on one angle, recomputed by the closest interpretation of unstated settings.

    Parameters
    ----------
    output
        Name of the angle.
    interpretation
        Interpretation whose values are closest to the printed ones.
    rows
        Recomputed rows by innovation length p.
    ratio
        Geometric mean, over all four rows, of the factors between recomputed and printed values of coefficient a and
        normalized residual NR; at least 1. A wrong sign of a counts as a further factor of 10.
    ratio_at_unit_prior
        Smallest such mean among interpretations with prior covariance K0 = 1.
    rank, grid_count
        Rank of the printed orders by equation error among all points of an order grid around them, and number of these
        points, at p = 7.
    best
        Orders with rank 1, by name.
    scale
        Factor by which the simulated angle was multiplied to give the standard deviation that the paper implies.
    """

    output: str
    interpretation: Interpretation
    rows: dict[int, Row]
    ratio: float
    ratio_at_unit_prior: float
    rank: int
    grid_count: int
    best: dict[str, float]
    scale: float

    @property
    def matching_trends(self) -> list[str]:
        """Letters of the coefficients that rise or fall between innovation lengths as the printed values do."""
        table = FRACTIONAL_ROWS[self.output]

        def course(rows: Mapping[int, Any], letter: str) -> list[float]:
            return np.sign(np.diff([rows[p].coefficients[letter] for p in INNOVATION_LENGTHS])).tolist()  # type: ignore[no-any-return]

        return [c for c in COEFFICIENT_LETTERS if course(self.rows, c) == course(table, c)]

    @property
    def ratios(self) -> dict[str, list[float]]:
        """Ratios of recomputed to printed values of coefficients a, b, d and g and of the normalized residual NR.

        Each list has one ratio per innovation length.
        """
        table = FRACTIONAL_ROWS[self.output]
        columns = {
            c: [r.coefficients[c] / table[p].coefficients[c] for p, r in self.rows.items()] for c in COEFFICIENT_LETTERS
        }
        return columns | {"NR": [r.equation.nr / table[p].nr for p, r in self.rows.items()]}

    @property
    def is_close(self) -> bool:
        """Whether coefficients and NR have the printed signs and are within a factor of 1.25 of the printed values.

        NR is the normalized residual.
        """
        low, high = 1.0 / MAX_COEFFICIENT_RATIO, MAX_COEFFICIENT_RATIO
        return all(low <= ratio <= high for column in self.ratios.values() for ratio in column)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a dictionary for JSON."""
        settings = {"closest settings": str(self.interpretation), "interpretation": json_value(self.interpretation)}
        numbers = attributes(self, ("ratio", "ratio_at_unit_prior", "scale", "matching_trends", "ratios", "rows"))
        return settings | numbers | attributes(self, ("rank", "grid_count", "best"))


class _AngleRegression:
    """Regressors of one angle at any orders, and coefficients by the closed form of eq. (44) of the paper.

    `output` is this angle, and `step` the width of a block pulse [s]. `means` are block-pulse means by signal: "own"
    (this angle), "other" (the other angle of the joint) and "u" (the motor current).
    """

    def __init__(self, output: str, means: Mapping[str, Floats], step: float) -> None:
        self.output, self.means, self.step, self.y = output, means, step, means["own"]
        self.haar_y = haar_transform(self.y)
        self._transforms: dict[tuple[str, float], tuple[Floats, Floats]] = {}

    def integral(self, signal: str, order: float) -> tuple[Floats, Floats]:
        """Return the fractional integral of the signal "own", "other" or "u", and its Haar transform, each (m,)."""
        key = signal, round(order, 6)
        if key not in self._transforms:
            kernel = block_pulse_kernel(order, PULSE_COUNT, step=self.step)
            series = _core.series_multiply(kernel, self.means[signal], PULSE_COUNT)
            self._transforms[key] = series, haar_transform(series)
        return self._transforms[key]

    def term_signals(self, terms: str) -> list[str]:
        """Return the signal ("own", "other" or "u") in each of the terms with coefficients a, b, d and g.

        `terms` is a key of `TERM_INTERPRETATIONS`.
        """
        signals: list[str] = TERM_INTERPRETATIONS[terms]["hub" if self.output.endswith("1") else "deflection"]
        return signals

    def regressors(self, terms: str, orders: Mapping[str, float]) -> tuple[Floats, Floats]:
        """Return the regressors of a, b, d and g, eq. (42) of the paper, as time signals and Haar transforms.

        Both arrays have the shape (m, 4).
        """
        alpha = orders["alpha"]
        etas = [*(alpha - orders[n] for n in TERM_INTERPRETATIONS[terms]["orders"]), alpha]
        time, haar = zip(*map(self.integral, self.term_signals(terms), etas), strict=True)
        return np.stack(time, axis=1), np.stack(haar, axis=1)

    def solve_coefficients(self, haar: Floats, priors: Sequence[float], p: int) -> list[Floats]:
        """Return the coefficients by eq. (44) of the paper, one array (4,) for each prior covariance.

        They are weighted least-squares estimates with a prior. `haar` are the Haar transforms of the regressors, with M
        rows. With the innovation length p, row i = 1 … M has the weight min(p, M - i + 1).
        """
        weights = np.minimum(p, PULSE_COUNT - np.arange(PULSE_COUNT)).astype(np.float64)
        weighted = haar * weights[:, None]
        gram, right = weighted.T @ haar, weighted.T @ self.haar_y
        grams = gram + np.eye(haar.shape[1]) / np.asarray(priors)[:, None, None]
        solutions: Floats = np.linalg.solve(grams, right[None, :, None])[:, :, 0]
        return list(solutions)


def implied_spreads() -> dict[str, tuple[float, float]]:
    """Return the standard deviations [rad] of each angle that its rows in the paper's Table 7 imply by RMSE / NR.

    The first is from the row of the genetic algorithm, the second from that of multi-innovation.
    """
    return {o: (g[1] / g[2], m[1] / m[2]) for o, (g, m) in TABLE_7_CRITERIA.items()}


def papers_record() -> tuple[Run, dict[str, float]]:
    """Return a simulated run under the paper's square current, and the scale factor of each angle.

    Every angle is scaled to the standard deviation that the paper's Table 7 implies for multi-innovation.
    """
    run = demo_run("square", parameters=PAPERS_ARM)
    scales = {o: implied[1] / float(np.std(run[o])) for o, implied in implied_spreads().items()}
    outputs = {o: run[o] * scales[o] for o in scales}
    inputs = {n: run[n] for n in ("I1", "I2")}
    return Run.from_arrays(step=run.step, inputs=inputs, outputs=outputs, units=dict(run.units), name="scaled"), scales


def as_printed(outputs: Sequence[str] = ANGLE_NAMES) -> dict[str, AsPrinted]:
    """Recompute the paper's Tables 4 and 5 with the interpretation of unstated settings that fits them best.

    Parameters
    ----------
    outputs
        Names of the angles; by default all four.

    Returns
    -------
    dict of AsPrinted
        Recomputed table of each angle, by name.
    """
    run, scales = papers_record()
    tables = {}
    for output in outputs:
        structure = flexible_link(
            stage=stage_of(output), form="published", coupling="measured", laws=(), sensor_filter="stock"
        )
        own = record(run, structure, PULSE_COUNT, filtered=False)
        hub, deflection = map(own.of, structure.outputs)
        filter_series, filtered = sensor_series(structure, PULSE_COUNT, own.step), deflection
        if filter_series is not None:
            filtered = _core.series_multiply(filter_series, deflection, PULSE_COUNT)
        # The standard deviation that the paper implies is that of the recorded angle, which has passed the filter.
        filtered = filtered * float(np.std(deflection)) / float(np.std(filtered))
        angles = []
        for link in (deflection, filtered):
            pair = (hub, link) if output == structure.outputs[0] else (link, hub)
            means = {"own": pair[0], "other": pair[1], "u": own.of(f"I{output[-2]}")}
            angles.append(_AngleRegression(output, means, own.step))
        tables[output] = _closest_recomputation(output, angles, scales[output])
    return tables


def _closest_recomputation(output: str, angles: Sequence[_AngleRegression], scale: float) -> AsPrinted:
    """Return the recomputed table of an angle that is closest to the printed one, over all interpretations.

    `angles` has the regressors without and with the sensor filter. The filter is tried for deflections only.
    """
    table, orders = FRACTIONAL_ROWS[output], FRACTIONAL_ROWS[output][FIRST_P].orders
    priors = (*PRIOR_GRID, 1.0)
    candidates: list[tuple[float, Interpretation, dict[int, Row]]] = []
    for filtered, terms in product((False, True) if output.endswith("2") else (False,), TERM_INTERPRETATIONS):
        angle = angles[filtered]
        time, haar = angle.regressors(terms, orders)
        solved = {p: angle.solve_coefficients(haar, priors, p) for p in INNOVATION_LENGTHS}
        own_terms = np.array([signal == "own" for signal in angle.term_signals(terms)])
        for k, prior in enumerate(priors):
            errors = {p: metrics(angle.y, time @ x[k]) for p, x in solved.items()}
            for flipped in (False, True):
                signs = np.where(flipped & own_terms, -1.0, 1.0)
                rows = {
                    p: Row(dict(zip(COEFFICIENT_LETTERS, (signs * x[k]).tolist(), strict=True)), errors[p])
                    for p, x in solved.items()
                }
                candidates.append((_log_distance(rows, table), Interpretation(terms, filtered, flipped, prior), rows))
    away, interpretation, rows = min(candidates, key=itemgetter(0))
    at_one = min(distance for distance, each, _ in candidates if each.prior == 1.0)
    ranks = _rank_orders(angles[interpretation.filtered], interpretation, orders)
    return AsPrinted(output, interpretation, rows, math.exp(away), math.exp(at_one), *ranks, scale)


def _log_distance(rows: Mapping[int, Row], table: Mapping[int, PublishedRow]) -> float:
    """Return the mean absolute logarithm of the ratios of recomputed to printed values, over all rows.

    The values are coefficient a and normalized residual NR. Each row in which a has the wrong sign adds ln 10 to the
    sum.
    """
    logs = []
    for p, row in rows.items():
        ratio = row.coefficients["a"] / table[p].a
        logs.append(abs(math.log(ratio)) if ratio > 0 else math.log(10.0) + abs(math.log(abs(ratio) or 1e-12)))
        logs.append(abs(math.log(row.equation.nr / table[p].nr)))
    return sum(logs) / len(logs)


def _rank_orders(
    angle: _AngleRegression, interpretation: Interpretation, orders: Mapping[str, float]
) -> tuple[int, int, dict[str, float]]:
    """Rank the printed orders beta, gamma and mu among all orders of a grid, by the sum of absolute equation errors.

    Return the rank of the printed orders, the number of grid points, and the orders with the smallest sum. The
    coefficients of each point are those of the largest innovation length p.
    """
    varied, count = ("beta", "gamma", "mu"), round((MAX_GRID_ORDER - MIN_GRID_ORDER) / GRID_INCREMENT) + 1
    values = [round(MIN_GRID_ORDER + k * GRID_INCREMENT, 9) for k in range(count)]
    errors: dict[tuple[float, ...], float] = {}
    for each in product(values, repeat=len(varied)):
        time, haar = angle.regressors(interpretation.terms, {**orders, **dict(zip(varied, each, strict=True))})
        (x,) = angle.solve_coefficients(haar, (interpretation.prior,), LAST_P)
        errors[each] = float(np.sum(np.abs(angle.y - time @ x)))
    own = errors[tuple(round(float(orders[n]), 9) for n in varied)]
    best = min(errors, key=errors.__getitem__)
    first = {"alpha": float(orders["alpha"]), **dict(zip(varied, best, strict=True))}
    return 1 + sum(e < own for e in errors.values()), len(errors), first


#: Increment and radius [increments] of the order grid around the printed orders, in fits to simulated printed models.
SEARCH_INCREMENT, SEARCH_RADIUS_STEPS = 0.05, 2


@dataclass(frozen=True)
class PrintedModelRun:
    """Simulation of a model printed in the paper, for one angle, under the paper's current from rest.

    Parameters
    ----------
    output, p
        Angle and innovation length of the row in the paper's Table 4 or 5.
    stability
        Stability of the two coupled printed equations of the joint.
    angle_deviation, single_equation_deviation
        Standard deviation of the simulated angle [rad], by both coupled equations, and by eq. (26) of the paper, which
        contains only this angle.
    implied_deviation
        Standard deviation of the measured angle that the paper implies by RMSE / NR [rad].
    time, response
        Middle of every block pulse [s], and mean of the angle over the pulse [rad], simulated by both equations.
    arm
        Angle of the simulated arm, scaled to the implied standard deviation, as means over the pulses [rad].
    returned_coefficients
        Coefficients by prior covariance K0 and name that multi-innovation identifies from the simulated angles at the
        printed orders.
    orders
        Orders by K0 and name that are identified on a grid around the printed ones; empty unless p is the largest.
    """

    output: str
    p: int
    stability: Stability
    angle_deviation: float
    single_equation_deviation: float
    implied_deviation: float
    time: Floats
    response: Floats
    arm: Floats
    returned_coefficients: dict[float, dict[str, float]]
    orders: dict[float, dict[str, float]]

    @property
    def row(self) -> PublishedRow:
        """Row of the paper's Table 4 or 5 with the printed model."""
        return FRACTIONAL_ROWS[self.output][self.p]

    @property
    def returned_a(self) -> dict[float, float]:
        """Coefficient a among the returned coefficients, by prior covariance K0."""
        return {k: values[parameter_name("a", self.output)] for k, values in self.returned_coefficients.items()}

    @property
    def deviation_ratio(self) -> float:
        """Ratio of the implied to the simulated standard deviation; infinite if the simulated angle is constant."""
        return self.implied_deviation / self.angle_deviation if self.angle_deviation else np.inf

    def to_dict(self) -> dict[str, Any]:
        """Return stability, deviations, coefficients and orders as a dictionary for JSON, without the samples."""
        own = {"stability": str(self.stability), "unstable_poles": finite(self.stability.unstable_poles)}
        deviations = ("angle_deviation", "single_equation_deviation", "implied_deviation", "deviation_ratio")
        return own | attributes(self, ("output", "p", *deviations, "returned_coefficients", "orders"))


def printed_numbers(stage: StageNumber, p: int) -> tuple[dict[str, float], dict[str, float]]:
    """Return (orders, coefficients) that the paper prints for a joint and innovation length p, by name.

    Names are those in its eqs. (22)-(25).
    """
    rows = {o: FRACTIONAL_ROWS[o][p] for o in ANGLE_NAMES if stage_of(o) == stage}
    orders = {parameter_name(n, o): float(v) for o, row in rows.items() for n, v in row.orders.items()}
    return orders, {parameter_name(n, o): float(v) for o, row in rows.items() for n, v in row.coefficients.items()}


def printed_model(stage: StageNumber, p: int) -> Model:
    """Return the model of both printed equations of a joint, which are coupled and have the current as input."""
    orders, coefficients = printed_numbers(stage, p)
    structure = flexible_link(stage=stage, form="published", coupling="simulated", laws=())
    return Model(structure.with_orders(orders).with_coefficients(coefficients), orders=orders, m=PULSE_COUNT)


def one_angle(output: str, p: int) -> Model:
    """Return the printed model of one angle by eq. (26) of the paper, with terms in this angle and the current only."""
    row = FRACTIONAL_ROWS[output][p]
    terms = [Term(output, Order(float(row.orders[o])), float(row.coefficients[c])) for c, o in ORDER_OF.items()]
    terms.append(Term(f"I{stage_of(output)}", Order(), float(row.coefficients["g"])))
    return Model(Structure((Equation(output, Order(float(row.orders["alpha"])), tuple(terms)),)), m=PULSE_COUNT)


def papers_current(stage: StageNumber) -> Run:
    """Return a run whose input is the paper's square current of one joint; its simulated angles are not used."""
    return demo_run("square", noise=0.0).select(signals_of(stage))


def run_printed_models(stage: StageNumber, threads: int | None = None) -> list[PrintedModelRun]:
    """Simulate every printed fractional model of a joint, and identify each model from its own simulated response.

    Return one result per innovation length and angle.
    """
    drive, runs = papers_current(stage), []
    scaled, _ = papers_record()
    structure = flexible_link(stage=stage, form="published", coupling="measured", laws=())
    for p in INNOVATION_LENGTHS:
        model, orders = printed_model(stage, p), printed_numbers(stage, p)[0]
        free, own, verdict = compare_means(model, drive), model.simulate(drive), stability(model)
        for output in model.outputs:
            response = free.simulated[output][0]
            single = compare_means(one_angle(output, p), drive.select([f"I{stage}", output])).simulated[output][0]
            deviations = float(np.std(response)), float(np.std(single)), implied_spreads()[output][1]
            arm = pulse_means(scaled[output], PULSE_COUNT)
            refits = _reidentify(own, structure.equation(output), orders, p, threads)
            runs.append(PrintedModelRun(output, p, verdict, *deviations, pulse_times(free), response, arm, *refits))
    return runs


def _reidentify(
    run: Run, single: Structure, orders: dict[str, float], p: int, threads: int | None
) -> tuple[dict[float, dict[str, float]], dict[float, dict[str, float]]]:
    """Identify one equation of a printed model from the run that this model simulates.

    Return the coefficients at the printed `orders`, and the best orders on a grid around them. Both are dictionaries by
    prior covariance K0, whose values are dictionaries by name. The best orders are computed only for the largest
    innovation length p, and are empty otherwise. A K0 without a finite simulation error is omitted.
    """

    def best(axes: dict[str, list[float]]) -> dict[float, Model]:
        grid, models = OrderGrid(increment=SEARCH_INCREMENT, orders=axes), {}
        for prior in PRIOR_COVARIANCES:
            with suppress(FtlmError):  # no candidate has a finite error
                models[prior] = best_orders(run, single, grid, p, prior, m=PULSE_COUNT, threads=threads).model
        return models

    own = {n: [orders[n]] for n in single.order_names}
    coefficients = {k: dict(model.coefficients) for k, model in best(own).items()}
    if p != LAST_P:
        return coefficients, {}
    near = {n: neighboring_values(v, SEARCH_INCREMENT, SEARCH_RADIUS_STEPS) for n, (v,) in own.items()}
    wide = {n: v if n.startswith("alpha") else [w for w in near[n] if w < 2.0] for n, v in own.items()}
    return coefficients, {k: {n: model.orders[n] for n in own} for k, model in best(wide).items()}
