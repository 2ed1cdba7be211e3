"""The tables as the paper computed them: multi-innovation at the printed orders, judged by the equation error.

What the paper does not say is scanned: K0, which angle each term has, the sign of the coefficients, the stock filter.
The arm is scaled to the deviations that the paper's own RMSE / NR imply.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import numpy as np

from ftlm import _core
from ftlm.arm.link import flexible_link
from ftlm.base.arrays import Floats
from ftlm.base.errors import InternalError
from ftlm.data.run import Run
from ftlm.judge.metrics import Metrics, finite, metrics
from ftlm.paper import printed
from ftlm.paper.arm import PAPERS_ARM, demo_run
from ftlm.solve.operators import haar_transform
from ftlm.solve.records import record, sensor_series

#: What may stand in the terms a, b and d of an angle: the angle itself (own) or the other one of its stage.
READINGS = {
    "(22)–(25)": "as printed there",
    "(26), one angle": "every term has the angle itself",
    "own angle in a": "the angle itself in a, the other one in b and d",
    "a and b exchanged": "the orders of (22)–(25), the columns a and b of the table exchanged",
}
#: K0 that are tried: eight a decade.
SCAN = tuple(float(v) for v in np.logspace(-3, 5, 65))
#: Orders around the printed ones, in the paper's steps, among which the printed ones have their place.
LOW, HIGH, STEP = 1.6, 1.95, 0.05
#: A column agrees with the printed one where its signs do and no entry is further than this factor.
NEAR = 1.25


@dataclass(frozen=True)
class Reading:
    """One way to read what the paper did.

    Parameters
    ----------
    terms
        A key of `READINGS`.
    filtered
        Whether the deflections passed the stock 2 Hz filter.
    reversed
        Whether terms of the angle itself stand on the left-hand side, as in a transfer function: their sign turns.
    prior
        K0.
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
    """What one reading gives with one p, at the printed orders."""

    coefficients: dict[str, float]
    equation: Metrics


@dataclass(frozen=True)
class AsPrinted:
    """One angle's part of Tables 4 and 5 by the reading that comes nearest.

    Parameters
    ----------
    output
        The angle.
    reading
        The nearest of all.
    rows
        By p, with the signs of that reading.
    away
        Factor by which a and NR of the four rows are away from the printed ones, in the geometric mean.
    away_at_one
        The same with K0 = 1 and the nearest of the other choices.
    rank, among
        Place of the printed orders by the error (45) of the equation among neighbouring ones, at p = 7.
    best
        Orders of the first place.
    scale
        What the simulated angle was multiplied by.
    """

    output: str
    reading: Reading
    rows: dict[int, Row]
    away: float
    away_at_one: float
    rank: int
    among: int
    best: dict[str, float]
    scale: float

    @property
    def alike(self) -> list[str]:
        """Coefficients that rise and fall with p as the printed ones do."""
        table = printed.FRACTIONAL[self.output]

        def course(rows: Mapping[int, Any], letter: str) -> list[float]:
            return np.sign(np.diff([rows[p].coefficients[letter] for p in printed.INNOVATION_LENGTHS])).tolist()  # type: ignore[no-any-return]

        return [c for c in printed.COEFFICIENTS if course(self.rows, c) == course(table, c)]

    @property
    def ratios(self) -> dict[str, list[float]]:
        """Ours over printed by p, of every column and of NR."""
        table = printed.FRACTIONAL[self.output]
        columns = {
            c: [r.coefficients[c] / table[p].coefficients[c] for p, r in self.rows.items()]
            for c in printed.COEFFICIENTS
        }
        return columns | {"NR": [r.equation.nr / float(table[p].nr or 1.0) for p, r in self.rows.items()]}

    @property
    def near(self) -> bool:
        """Whether every coefficient has the printed sign and is, as NR is, within a quarter of the printed value."""
        return all(1.0 / NEAR <= q <= NEAR for column in self.ratios.values() for q in column)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "reading": str(self.reading), "K0": self.reading.prior, "terms": self.reading.terms,
            "filtered": self.reading.filtered, "sign reversed": self.reading.reversed, "away": finite(self.away),
            "away at K0 = 1": finite(self.away_at_one), "rank of the printed orders": self.rank, "among": self.among,
            "best orders": self.best, "scale": self.scale, "columns of the printed course": self.alike,
            "ours / printed": self.ratios,
            "rows": {
                str(p): {"coefficients": r.coefficients, "equation_error": r.equation.to_dict()}
                for p, r in self.rows.items()
            },
        }  # fmt: skip


class _Angle:
    """Regressors of one angle at any order, in Haar coordinates, and the closed form of the recursion (44)."""

    def __init__(self, angles: Mapping[str, Floats], current: Floats, output: str, step: float) -> None:
        other = output[:-1] + ("2" if output.endswith("1") else "1")
        self.output, self.step, self.signals = (
            output,
            step,
            {"own": angles[output], "other": angles[other], "u": current},
        )
        self.y = angles[output]
        self.m = self.y.size
        self.haar_y = haar_transform(self.y)
        self._kept: dict[tuple[str, float], tuple[Floats, Floats]] = {}

    def integral(self, signal: str, order: float) -> tuple[Floats, Floats]:
        """I^order of a signal, in time and in Haar coordinates."""
        key = signal, round(order, 6)
        if key not in self._kept:
            kernel = _core.block_pulse_kernel(order, self.m, self.step)
            series = _core.series_multiply(kernel, self.signals[signal], self.m)
            self._kept[key] = series, haar_transform(series)
        return self._kept[key]

    def places(self, terms: str) -> tuple[str, str, str, str]:
        """Which signal the terms a, b, d, g have."""
        hub = self.output.endswith("1")
        return {
            "(22)–(25)": ("other", "own", "other", "u") if hub else ("own", "other", "own", "u"),
            "(26), one angle": ("own", "own", "own", "u"),
            "own angle in a": ("own", "other", "other", "u"),
            "a and b exchanged": ("own", "other", "other", "u") if hub else ("other", "own", "own", "u"),
        }[terms]

    def regressors(self, terms: str, orders: Mapping[str, float]) -> tuple[Floats, Floats]:
        """Columns a, b, d, g of (42)."""
        names = ("gamma", "beta", "mu") if terms == "a and b exchanged" else ("beta", "gamma", "mu")
        etas = [*(orders["alpha"] - orders[n] for n in names), orders["alpha"]]
        parts = [self.integral(s, eta) for s, eta in zip(self.places(terms), etas, strict=True)]
        time, haar = zip(*parts, strict=True)
        return np.stack(time, axis=1), np.stack(haar, axis=1)

    def solved(self, haar: Floats, priors: Sequence[float], p: int) -> list[Floats]:
        """Closed form of (44): row i counts min(p, M - i + 1) times, against the prior."""
        weights = np.minimum(p, self.m - np.arange(self.m)).astype(np.float64)
        weighted = haar * weights[:, None]
        gram, right = weighted.T @ haar, weighted.T @ self.haar_y
        grams = gram + np.eye(haar.shape[1]) / np.asarray(priors)[:, None, None]
        solutions: Floats = np.linalg.solve(grams, right[None, :, None])[:, :, 0]
        return list(solutions)


def implied_spreads() -> dict[str, tuple[float, float]]:
    """Standard deviations that Table 7 implies by RMSE / NR, of the genetic algorithm's record and of the other."""
    return {o: (g[1] / g[2], m[1] / m[2]) for o, (g, m) in printed.RIVALS.items()}


def papers_record() -> tuple[Run, dict[str, float]]:
    """The arm under the paper's square current, every angle scaled to the deviation that the paper implies."""
    run = demo_run("square", parameters=PAPERS_ARM)
    scales = {o: implied[1] / float(np.std(run[o])) for o, implied in implied_spreads().items()}
    outputs = {o: run[o] * scales[o] for o in scales}
    inputs = {n: run[n] for n in ("I1", "I2")}
    return Run.from_arrays(step=run.step, inputs=inputs, outputs=outputs, units=dict(run.units), name="scaled"), scales


def as_printed(outputs: Sequence[str] = printed.OUTPUTS) -> dict[str, AsPrinted]:
    """Tables 4 and 5 by the reading that comes nearest to them, angle by angle.

    Parameters
    ----------
    outputs
        Angles; by default all four.
    """
    run, scales = papers_record()
    found = {}
    for output in outputs:
        stage: Literal[1, 2] = 1 if output[-2] == "1" else 2
        structure = flexible_link(
            stage=stage, form="published", coupling="measured", laws=(), sensor_filter="stock"
        )  # fmt: skip
        own = record(run, structure, printed.POINTS, filtered=False)
        plain = {o: own.of(o) for o in structure.outputs}
        hub, deflection = structure.outputs
        filter_series = sensor_series(structure, printed.POINTS, own.step)
        behind = plain[deflection]
        if filter_series is not None:
            behind = _core.series_multiply(filter_series, behind, printed.POINTS)
        # The implied deviation is that of the angle as it was logged.
        behind = behind * float(np.std(plain[deflection])) / float(np.std(behind))
        seen = {False: plain, True: {hub: plain[hub], deflection: behind}}
        current = own.of(f"I{stage}")
        angles = {filtered: _Angle(series, current, output, own.step) for filtered, series in seen.items()}
        found[output] = _nearest(output, angles, scales[output])
    return found


def _nearest(output: str, angles: Mapping[bool, _Angle], scale: float) -> AsPrinted:
    table, orders = printed.FRACTIONAL[output], printed.FRACTIONAL[output][1].orders
    best: tuple[float, Reading, dict[int, Row]] | None = None
    at_one = math.inf
    deflection = output.endswith("2")
    for filtered, terms in product((False, True) if deflection else (False,), READINGS):
        angle = angles[filtered]
        time, haar = angle.regressors(terms, orders)
        priors = (*SCAN, 1.0)
        solved = {p: angle.solved(haar, priors, p) for p in printed.INNOVATION_LENGTHS}
        for k, prior in enumerate(priors):
            x = {p: solved[p][k] for p in printed.INNOVATION_LENGTHS}
            figures = {p: metrics(angle.y, time @ x[p]) for p in printed.INNOVATION_LENGTHS}
            for flipped in (False, True):
                signs = np.array([-1.0 if flipped and place == "own" else 1.0 for place in angle.places(terms)])
                rows = {
                    p: Row(dict(zip(printed.COEFFICIENTS, (signs * x[p]).tolist(), strict=True)), figures[p])
                    for p in printed.INNOVATION_LENGTHS
                }
                away = _away(rows, table)
                if prior == 1.0:
                    at_one = min(at_one, away)
                if best is None or away < best[0]:
                    best = away, Reading(terms, filtered, flipped, prior), rows
    if best is None:
        raise InternalError(f"no reading of {output} was tried; please report it")
    away, reading, rows = best
    rank, among, first = _ranked(angles[reading.filtered], reading, orders)
    return AsPrinted(output, reading, rows, math.exp(away), math.exp(at_one), rank, among, first, scale)


def _away(rows: Mapping[int, Row], table: Mapping[int, printed.Printed]) -> float:
    """Mean absolute logarithm of ours over the printed, of a and NR; an a of the other sign counts as a decade."""
    logs = []
    for p, row in rows.items():
        ratio = row.coefficients["a"] / table[p].coefficients["a"]
        logs.append(abs(math.log(ratio)) if ratio > 0 else math.log(10.0) + abs(math.log(abs(ratio) or 1e-12)))
        logs.append(abs(math.log(row.equation.nr / float(table[p].nr or 1.0))))
    return sum(logs) / len(logs)


def _ranked(angle: _Angle, reading: Reading, orders: Mapping[str, float]) -> tuple[int, int, dict[str, float]]:
    """Place of the printed orders among all neighbouring ones, at the largest p."""
    values = [round(LOW + k * STEP, 9) for k in range(round((HIGH - LOW) / STEP) + 1)]
    errors: dict[tuple[float, ...], float] = {}
    for beta, gamma, mu in product(values, values, values):
        at = {"alpha": float(orders["alpha"]), "beta": beta, "gamma": gamma, "mu": mu}
        time, haar = angle.regressors(reading.terms, at)
        (x,) = angle.solved(haar, (reading.prior,), printed.INNOVATION_LENGTHS[-1])
        errors[beta, gamma, mu] = float(np.sum(np.abs(angle.y - time @ x)))
    own = errors[tuple(round(float(orders[n]), 9) for n in ("beta", "gamma", "mu"))]
    first = min(errors, key=lambda k: errors[k])
    return (
        1 + sum(e < own for e in errors.values()), len(errors),
        {"alpha": float(orders["alpha"])} | dict(zip(("beta", "gamma", "mu"), first, strict=True)),
    )  # fmt: skip
