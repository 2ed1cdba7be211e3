"""The paper's claims, and its slips, held against computed numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ftlm.arm.link import order_law
from ftlm.arm.parameters import PARAMETERS
from ftlm.fit.recursion import Trace
from ftlm.judge.metrics import metrics
from ftlm.paint.text import symbol
from ftlm.paper import printed
from ftlm.paper.arm import STAGES
from ftlm.paper.records import WEAK_PRIOR, Recomputed, Rival, Stage

#: A curve has converged where it stays this close to its end.
SETTLED = 0.05
#: Differences of two errors below this share of them are none.
ALIKE = 0.02
#: A free run this many times worse than the equation error, or with a larger NR than this, describes nothing.
FLATTERY, EXPLAINS = 5.0, 0.5
#: Digits of RMSE and NR in Table 7 allow this much between two standard deviations of one record.
MIXED = 0.15
#: Standard errors that an estimate may be away from the truth by chance.
BY_CHANCE = 4.0


@dataclass(frozen=True)
class Claim:
    """One claim of the paper, or slip in it, with a verdict from computed numbers.

    Parameters
    ----------
    claim
        In words.
    holds
        Whether the numbers bear it out; None where they cannot tell.
    evidence
        The numbers, in words.
    """

    claim: str
    holds: bool | None
    evidence: str


def claims(found: Recomputed) -> list[Claim]:
    """Hold the paper's claims, and its slips, against computed numbers.

    Every verdict follows from numbers by a rule; none is written down.
    """
    each = (
        _claim_of_smaller_errors(found), _claim_of_p_itself(found), _claim_of_convergence(found),
        *_claims_of_orders(found), _claim_of_the_form(found), _claim_of_table_3(), _claim_of_one_record(),
        _claim_of_rivals(found), _claim_of_the_derivative(found), _claim_of_the_impossible_row(),
    )  # fmt: skip
    return [claim for claim in each if claim is not None]


def numbers_listed(values: Iterable[float], digits: int = 4) -> str:
    """Numbers in a row."""
    return ", ".join("∞" if math.isinf(v) else f"{v:.{digits}g}" for v in values)


def listed(numbers: Mapping[str, Iterable[float]], digits: int = 4) -> str:
    """The numbers of every angle."""
    return "; ".join(f"{symbol(name)} {numbers_listed(values, digits)}" for name, values in numbers.items())


def settled_at(trace: Trace) -> int:
    """First step from which a curve stays within a share of its end."""
    end = trace.error[-1]
    with np.errstate(invalid="ignore"):
        away = np.flatnonzero(~(np.abs(trace.error - end) <= SETTLED * end))
    return int(trace.step[min(int(away[-1]) + 1, trace.step.size - 1)]) if away.size else int(trace.step[0])


def printed_saturation(output: str) -> tuple[float, float, float]:
    """Return x and c of x·p / (p + c) through the printed a of p = 1 and 7, and how far p = 3 and 5 are from it."""
    rows = printed.FRACTIONAL[output]
    first, last = printed.INNOVATION_LENGTHS[0], printed.INNOVATION_LENGTHS[-1]
    # 1/a = 1/x + (c/x)/p is a line in 1/p.
    slope = (1 / rows[first].coefficients["a"] - 1 / rows[last].coefficients["a"]) / (1 / first - 1 / last)
    x = 1 / (1 / rows[first].coefficients["a"] - slope / first)
    c = slope * x
    between = [(p, rows[p].coefficients["a"]) for p in printed.INNOVATION_LENGTHS[1:-1]]
    return x, c, max(abs(x * p / (p + c) / a - 1) for p, a in between)


def weak_spread(stage: Stage, output: str) -> float:
    """Largest relative difference of a coefficient between p = 1 and any other p, with a weak prior."""
    each = stage.weak[output]
    first = each[printed.INNOVATION_LENGTHS[0]]
    return max(abs(c[n] / first[n] - 1) for c in each.values() for n in first if first[n])


def _claim_of_smaller_errors(found: Recomputed) -> Claim:
    errors = {
        o: [s.candidates[f"p = {p}"].estimation.output_error[o].error for p in printed.INNOVATION_LENGTHS]
        for s, o in found.angles
    }
    return Claim(
        "A larger innovation length p gives a smaller error (45): Tables 4 and 5.",
        all(b <= a for each in errors.values() for a, b in pairwise(each)),
        f"error of the free run for p = 1, 3, 5, 7 at K0 = 1: {listed(errors)}.",
    )


def _claim_of_p_itself(found: Recomputed) -> Claim:
    away = ", ".join(f"{100 * printed_saturation(o)[2]:.2g} % ({symbol(o)})" for o in printed.OUTPUTS)
    curve = f"the printed a lie on x·p / (p + c), the curve of a prior, within {away}."
    spread = [weak_spread(s, o) for s in found.stages.values() for o in s.weak]
    words = ""
    if spread:
        words = (
            f"with a weak prior (K0 = {WEAK_PRIOR:.0e}) the coefficients of p = 1, 3, 5, 7 at the same orders differ "
            f"by at most {100 * max(spread):.2g} %: p is a weight of the data against the prior, which pulls to 0; "
        )
    return Claim(
        "p itself improves the estimate.", not all(v < ALIKE for v in spread) if spread else None, words + curve
    )


def _claim_of_convergence(found: Recomputed) -> Claim | None:
    strong, weak = (
        {o: [settled_at(each[p]) for p in printed.INNOVATION_LENGTHS] for o, each in traces.items()}
        for traces in (found.traces, found.weak_traces)
    )
    if not strong:
        return None
    return Claim(
        "A larger p converges faster: Figures 4(b), 5(b), 7(b), 8(b).",
        all(b <= a for each in strong.values() for a, b in pairwise(each)),
        "steps until the error stays within 5 % of its end, for p = 1, 3, 5, 7: at K0 = 1 "
        f"{listed(strong)}; with the weak prior {listed(weak)}.",
    )


def _fits(found: Recomputed, label: str) -> dict[str, float]:
    """Fit of the free run, driven as the model was identified, by angle and run."""
    fits: dict[str, float] = {}
    for s in found.stages.values():
        candidate = s.candidates[label]
        for name, comparison in (("square", candidate.estimation), ("sine", candidate.validation)):
            if comparison is not None:
                fits |= {f"{symbol(o)} on the {name}": comparison.output_error[o].fit for o in s.outputs}
    return fits


def _claims_of_orders(found: Recomputed) -> list[Claim]:
    last = f"p = {printed.INNOVATION_LENGTHS[-1]}"
    labels = ", ".join(sorted({s.manual for s in found.stages.values()}))
    manual = {
        o: [s.candidates[label].estimation.output_error[o].nr for label in (s.manual, last)] for s, o in found.angles
    }
    whole, fractional = _fits(found, "integer, identified"), _fits(found, "output error")
    near = {o: (s.near.estimation.equation_error[o].nr, s.near.estimation.output_error[o].nr) for s, o in found.angles}
    return [
        Claim(
            "The fractional model (p = 7) is closer to the run than the manual's integer-order model: Figures 6 and 9.",
            all(f < i for i, f in manual.values()),
            f"NR of the manual's model ({labels}) and of p = 7: {listed(manual, 3)}.",
        ),
        Claim(
            "Fractional orders describe the arm better than whole ones.",
            all(fractional[k] > whole[k] for k in whole),
            "both in (14)–(15), identified by output error from the same run; fit in percent of whole orders, even "
            "driven by the measured other angle, and of fractional ones from the current alone: "
            + "; ".join(f"{k} {numbers_listed((whole[k], fractional[k]))}" for k in whole)
            + ". The manual's model is no measure of whole orders: its parameters were not identified from this run.",
        ),
        Claim(
            "The orders of Tables 4 and 5 (2; 1.95 to 1.8) describe the arm.",
            all(output < FLATTERY * equation and output < EXPLAINS for equation, output in near.values()),
            "with these orders and the best coefficients for them, NR of the equation error and of the free run: "
            f"{listed(near, 3)}. So close to α, I^(α−ν) y is nearly y, and the equation says that a signal equals "
            "itself.",
        ),
    ]


def table_3_coefficients() -> dict[str, tuple[float, float, float]]:
    """Coefficients of (22)-(25) from Table 3, from the effective parameters, and as printed in the integer rows."""
    found = {}
    for stage in (1, 2):
        table, effective = (PARAMETERS[n][stage].coefficients(stage) for n in ("table-3", "effective"))
        for k in (1, 2):
            row = printed.INTEGER[f"theta{stage}{k}"]
            for letter, value in row.coefficients.items():
                name = f"{letter}{2 * stage - 2 + k}"
                found[name] = (table[name], effective[name], value)
    return found


def _claim_of_table_3() -> Claim:
    rows = table_3_coefficients()
    ratios = {n: t / p for n, (t, _, p) in rows.items()}
    effective = max(abs(e / p - 1) for _, e, p in rows.values())
    off = [n for n, r in ratios.items() if abs(r - 1) > ALIKE]
    worst = max(off, key=lambda n: abs(math.log(abs(ratios[n]))), default=None)
    words = "" if worst is None else f"; {worst} is {ratios[worst]:.3g} times the printed value"
    return Claim(
        "Table 3 gives the integer-order models of Tables 4 and 5.",
        not off,
        f"{len(off)} of {len(rows)} coefficients from Table 3 are not those printed{words}. The maker's effective "
        f"parameters (torque with gear and efficiency) give every one of them to {100 * effective:.1g} %.",
    )


def implied_spreads() -> dict[str, tuple[float, float]]:
    """Standard deviations that Table 7 implies by RMSE / NR, of the genetic algorithm's record and of the other."""
    return {o: (g[1] / g[2], m[1] / m[2]) for o, (g, m) in printed.RIVALS.items()}


def _claim_of_one_record() -> Claim:
    spreads = implied_spreads()
    return Claim(
        "Table 7 compares both algorithms on one record.",
        all(abs(genetic / lattice - 1) <= MIXED for genetic, lattice in spreads.values()),
        "standard deviation of the angle that RMSE / NR implies, genetic algorithm and multi-innovation: "
        f"{listed(spreads, 3)} rad. One record has one standard deviation.",
    )


def _claim_of_rivals(found: Recomputed) -> Claim | None:
    if not found.rivals:
        return None
    pairs = {
        o: [candidate.estimation.output_error[o].error for candidate in (rival.genetic, rival.lattice)]
        for o, rival in found.rivals.items()
    }
    budgets = ", ".join(sorted({_budget(rival) for rival in found.rivals.values()}))
    return Claim(
        "Multi-innovation has a smaller error than the genetic algorithm.",
        all(lattice < genetic for genetic, lattice in pairs.values()),
        f"the same record, {budgets}; error (45) of the genetic algorithm's best seed and of p = 7: {listed(pairs)}. "
        "The genetic algorithm minimises (45) over the coefficients, too; multi-innovation takes those of the equation "
        "error, pulled towards 0.",
    )


def _budget(rival: Rival) -> str:
    """How many evaluations a seed of the genetic algorithm had for how many candidates of the lattice."""
    each = sum(rival.settings["evaluations"].values()) / len(rival.settings["seeds"])
    return f"{each:.0f} evaluations a seed for {rival.candidates} candidates"


def _claim_of_the_derivative(found: Recomputed) -> Claim:
    hub_and_link = {n: printed.last_orders(f"theta{n}1") | printed.last_orders(f"theta{n}2") for n in STAGES}
    dropped = [order_law(n, "derived")["input"].at(orders) for n, orders in hub_and_link.items()]
    parts = [stage.derived for stage in found.stages.values()]
    orders = ", ".join(f"{part.order:.3g}" for part in parts)
    changed = ", ".join(f"{metrics(p.derived, p.published).nr:.3g} ({symbol(p.output)})" for p in parts)
    bent = {p.output: p.correlations.values() for p in parts}
    return Claim(
        "Eliminating the other angle leaves the current as it is: (19), (21).",
        all(abs(v) < 1e-9 for v in dropped),
        f"the elimination differentiates the current as well, by the order {numbers_listed(dropped, 2)} at the printed "
        f"orders and {orders} at those identified here, where it changes the deflection's free run by NR {changed}. "
        "Correlation of the deflection with the current as measured, by (14)–(15) and with the same numbers by "
        f"(22)–(25): {listed(bent, 2)}.",
    )


def _claim_of_the_form(found: Recomputed) -> Claim | None:
    """Whether the published form finds the orders of an arm that hangs on its hub; of simulated runs, where known."""
    away: list[str] = []
    fits: dict[str, list[float]] = {}
    count = 0
    for number, truth in found.truth.items():
        lagrange, published = (
            found.stages[number].candidates[n] for n in ("output error", "published, output error")
        )  # fmt: skip
        for o in found.stages[number].outputs:
            fits[o] = [c.estimation.output_error[o].fit for c in (lagrange, published)]
        if published.result is not None:
            for name, value in published.result.orders.items():
                # The one order that the published form alone leaves free is fixed in the other.
                known, error = truth.get(name, 2.0), published.result.standard_errors[name]
                count += 1
                if not abs(value - known) <= BY_CHANCE * error:
                    away.append(f"{symbol(name)} {value:.4g} ± {error:.2g} ({known:g})")
    if not count:
        return None
    words = f"All {count} orders of (22)–(25) are within {BY_CHANCE:g} standard errors of the truth."
    if away:
        words = (
            f"{len(away)} of {count} orders of (22)–(25) are more than {BY_CHANCE:g} standard errors from the truth "
            f"(in brackets): {', '.join(away)}. They make up for the derivative that is missing."
        )
    return Claim(
        "Equations (22)–(25) find the orders of an arm that (14)–(15) describe.",
        not away,
        "the simulated arm integrates (14)–(15). Both forms fitted by output error to the currents alone, fit in "
        f"percent of (14)–(15) and of (22)–(25): {listed(fits)}. {words}",
    )


def _claim_of_the_impossible_row() -> Claim:
    row = printed.INTEGER["theta22"]
    error, rmse = float(row.error or 0.0), float(row.rmse or 0.0)
    mean = error / printed.POINTS
    return Claim(
        "The integer row of θ₂₂ in Table 5 is possible.",
        mean <= rmse,
        f"its error {error:g} over {printed.POINTS} points is a mean of {mean:.4g} rad, its RMSE {rmse:g} rad; a mean "
        "absolute value never exceeds the root mean square.",
    )
