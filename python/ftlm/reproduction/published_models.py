"""Simulation of the paper's printed models: stability, standard deviations, re-identified parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ftlm.analysis.poles import Stability, stability
from ftlm.arm.flexible_link import flexible_link
from ftlm.data.run import Run
from ftlm.errors import FtlmError
from ftlm.kernels import pulse_means
from ftlm.model.model import Model
from ftlm.order_search.search import rank_orders
from ftlm.plot.comparison_charts import pulse_times
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.published_values import implied_spreads, papers_record
from ftlm.reproduction.simulated_arm import StageNumber, demo_run
from ftlm.reproduction.stage_result import PRIOR_COVARIANCES
from ftlm.structure.equation import Equation, Term
from ftlm.structure.order import Order
from ftlm.structure.order_grid import OrderGrid
from ftlm.structure.structure import Structure
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import compare_means, finite

#: Increment and radius [increments] of the order grid around the printed orders.
SEARCH_INCREMENT, SEARCH_RADIUS_STEPS = 0.05, 2


@dataclass(frozen=True)
class PrintedModelRun:
    """Simulation of one printed model of one angle under the paper's current from rest.

    Parameters
    ----------
    output, p
        Row of Tables 4 and 5.
    stability
        Stability of the stage's two coupled printed equations.
    angle_deviation, single_equation_deviation
        Standard deviation of the angle [rad], by both coupled equations and by (26) with one angle alone.
    implied_deviation
        Standard deviation of the measured angle that the paper's RMSE / NR implies [rad].
    time, response
        Middle of every block pulse [s], and the angle by both equations [rad].
    arm
        Angle of the simulated arm, scaled to the implied standard deviation [rad].
    returned_coefficients
        Coefficients that multi-innovation identifies from that response at the printed orders, by K0.
    orders
        Orders identified by K0 on a grid around the printed ones; empty unless p is the largest.
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
    def deviation_ratio(self) -> float:
        """Ratio of the implied to the simulated standard deviation."""
        return self.implied_deviation / self.angle_deviation if self.angle_deviation else np.inf

    def to_dict(self) -> dict[str, Any]:
        """Return the simulation for JSON."""
        return {
            "output": self.output,
            "p": self.p,
            "stability": str(self.stability),
            "unstable poles": finite(self.stability.unstable_poles),
            "moved": finite(self.angle_deviation),
            "moved, one angle": finite(self.single_equation_deviation),
            "implied": self.implied_deviation,
            "implied / moved": finite(self.deviation_ratio),
            "returned": {f"{k:g}": v for k, v in self.returned_coefficients.items()},
            "orders": {f"{k:g}": v for k, v in self.orders.items()},
        }


def printed_numbers(stage: StageNumber, p: int) -> tuple[dict[str, float], dict[str, float]]:
    """Orders and coefficients of a stage's two printed equations, by the names of (22)-(25)."""
    orders: dict[str, float] = {}
    coefficients: dict[str, float] = {}
    for k in (1, 2):
        row, n = printed.FRACTIONAL_ROWS[f"theta{stage}{k}"][p], 2 * stage - 2 + k
        orders |= {f"{name}{n}": float(v) for name, v in row.orders.items()}
        coefficients |= {f"{name}{n}": float(v) for name, v in row.coefficients.items()}
    return orders, coefficients


def printed_model(stage: StageNumber, p: int) -> Model:
    """Model of both printed equations of a stage with the current as input."""
    orders, coefficients = printed_numbers(stage, p)
    structure = flexible_link(stage=stage, form="published", coupling="simulated", laws=())
    known = structure.with_orders(orders).with_coefficients(coefficients)
    return Model(known, orders=orders, m=printed.PULSE_COUNT)


def one_angle(output: str, p: int) -> Model:
    """Model of the printed row by (26): every term but the current's contains the angle itself."""
    row = printed.FRACTIONAL_ROWS[output][p]
    terms = [
        Term(output, Order(float(row.orders[order])), float(row.coefficients[letter]))
        for letter, order in zip("abd", ("beta", "gamma", "mu"), strict=True)
    ]
    terms.append(Term(f"I{output[-2]}", Order(), float(row.coefficients["g"])))
    return Model(Structure((Equation(output, Order(float(row.orders["alpha"])), tuple(terms)),)), m=printed.PULSE_COUNT)


def papers_current(stage: StageNumber) -> Run:
    """Run with the paper's square current of one stage; the simulated angles are not used."""
    return demo_run("square", noise=0.0).select([f"I{stage}", f"theta{stage}1", f"theta{stage}2"])


def run_printed_models(stage: StageNumber, threads: int | None = None) -> list[PrintedModelRun]:
    """Simulate every printed fractional model of a stage, and identify each from its own response."""
    drive, found = papers_current(stage), []
    spreads = implied_spreads()
    scaled, _ = papers_record()
    for p in printed.INNOVATION_LENGTHS:
        model = printed_model(stage, p)
        free = compare_means(model, drive)
        verdict = stability(model)
        own = model.simulate(drive)
        structure = flexible_link(stage=stage, form="published", coupling="measured", laws=())
        for output in model.outputs:
            response = free.simulated[output][0]
            single = compare_means(one_angle(output, p), drive.select([f"I{stage}", output]))
            found.append(
                PrintedModelRun(
                    output,
                    p,
                    verdict,
                    float(np.std(response)),
                    float(np.std(single.simulated[output][0])),
                    spreads[output][1],
                    pulse_times(free),
                    response,
                    pulse_means(scaled[output], printed.PULSE_COUNT),
                    *_reidentify(own, structure.equation(output), printed_numbers(stage, p)[0], p, threads),
                )
            )
    return found


def _reidentify(
    run: Run, single: Structure, orders: dict[str, float], p: int, threads: int | None
) -> tuple[dict[float, dict[str, float]], dict[float, dict[str, float]]]:
    """Coefficients at the model's own orders, and for the largest p the best orders around them, by K0."""
    own = {n: orders[n] for n in single.order_names}
    wide = {
        n: [
            round(v + k * SEARCH_INCREMENT, 9)
            for k in range(-SEARCH_RADIUS_STEPS, SEARCH_RADIUS_STEPS + 1)
            if v + k * SEARCH_INCREMENT < 2.0 or n.startswith("alpha")
        ]
        for n, v in own.items()
    }
    wide |= {n: [v] for n, v in own.items() if n.startswith("alpha")}

    def best(axes: dict[str, list[float]], prior: float) -> Model | None:
        try:
            return rank_orders(
                run,
                single,
                OrderGrid(increment=SEARCH_INCREMENT, orders=axes),
                coefficients="multi-innovation",
                innovation_length=p,
                prior_covariance=prior,
                m=printed.PULSE_COUNT,
                top=1,
                threads=threads,
            ).model
        except FtlmError:  # no candidate has a finite error
            return None

    coefficients = {k: best({n: [v] for n, v in own.items()}, k) for k in PRIOR_COVARIANCES}
    searched = {k: best(wide, k) for k in PRIOR_COVARIANCES} if p == printed.INNOVATION_LENGTHS[-1] else {}
    return (
        {k: dict(m.coefficients) for k, m in coefficients.items() if m is not None},
        {k: {n: m.orders[n] for n in own} for k, m in searched.items() if m is not None},
    )
