"""The paper's claims, and its slips, held against computed numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ftlm.arm.link import order_law
from ftlm.arm.parameters import PARAMETERS
from ftlm.fit.recursion import Trace
from ftlm.judge.metrics import metrics
from ftlm.paper import printed
from ftlm.paper.records import WEAK_PRIOR, Recomputed, Rival, Stage

#: A curve has converged where it stays this close to its end.
SETTLED = 0.05
#: Differences of two errors below this share of them are none.
ALIKE = 0.02


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

    Parameters
    ----------
    found
        The reproduction.

    Returns
    -------
    list of Claim
        Every verdict follows from numbers by a rule; none is written down.
    """
    return [
        *_claims_of_p(found), *_claims_of_orders(found), _claim_of_table_3(), *_claims_of_rivals(found),
        _claim_of_the_derivative(found), _claim_of_the_impossible_row(),
    ]  # fmt: skip


def angle(name: str) -> str:
    """An angle as the paper writes it, in plain text."""
    return "θ" + name.removeprefix("theta").translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def numbers_listed(values: Sequence[float], digits: int = 4) -> str:
    """Numbers in a row."""
    return ", ".join("∞" if math.isinf(v) else f"{v:.{digits}g}" for v in values)


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


def _claims_of_p(found: Recomputed) -> list[Claim]:
    lengths = printed.INNOVATION_LENGTHS
    errors = {
        o: [s.candidates[f"p = {p}"].estimation.output_error[o].error for p in lengths]
        for s in found.stages.values() for o in s.outputs
    }  # fmt: skip
    falls = {o: all(b <= a for a, b in pairwise(e)) for o, e in errors.items()}
    away = {o: printed_saturation(o)[2] for o in printed.OUTPUTS}
    curve = "the printed a lie on x·p / (p + c), the curve of a prior, within " + ", ".join(
        f"{100 * v:.2g} % ({angle(o)})" for o, v in away.items()
    )
    words = "; ".join(f"{angle(o)} {numbers_listed(e)}" for o, e in errors.items())
    out = [
        Claim(
            "A larger innovation length p gives a smaller error (45): Tables 4 and 5.",
            all(falls.values()),
            f"error of the free run for p = 1, 3, 5, 7 at K0 = 1: {words}.",
        )
    ]
    spread = {o: weak_spread(s, o) for s in found.stages.values() for o in s.weak}
    out.append(
        Claim(
            "p itself improves the estimate.",
            not all(v < ALIKE for v in spread.values()) if spread else None,
            (
                f"with a weak prior (K0 = {WEAK_PRIOR:.0e}) the coefficients of p = 1, 3, 5, 7 at the same orders "
                f"differ by at most {100 * max(spread.values()):.2g} %: p is a weight of the data against the prior, "
                "which pulls to 0; "
                if spread
                else ""
            )
            + curve
            + ".",
        )
    )
    steps = {o: [settled_at(t[p]) for p in lengths] for s in found.stages.values() for o, t in s.traces.items()}
    weak = {o: [settled_at(t[p]) for p in lengths] for s in found.stages.values() for o, t in s.weak_traces.items()}
    if steps:
        out.append(
            Claim(
                "A larger p converges faster: Figures 4(b), 5(b), 7(b), 8(b).",
                all(b <= a for each in steps.values() for a, b in pairwise(each)),
                "steps until the error stays within 5 % of its end, for p = 1, 3, 5, 7: at K0 = 1 "
                + "; ".join(f"{angle(o)} {numbers_listed(s)}" for o, s in steps.items())
                + f"; with the weak prior {'; '.join(f'{angle(o)} {numbers_listed(s)}' for o, s in weak.items())}.",
            )
        )
    return out


def _fits(found: Recomputed, label: str) -> dict[str, float]:
    """Fit of the free run, driven as the model was identified, by angle and run."""
    fits: dict[str, float] = {}
    for s in found.stages.values():
        candidate = s.candidates[label]
        for name, comparison in (("square", candidate.estimation), ("sine", candidate.validation)):
            if comparison is not None:
                fits |= {f"{angle(o)} on the {name}": comparison.output_error[o].fit for o in s.outputs}
    return fits


def _claims_of_orders(found: Recomputed) -> list[Claim]:
    last = f"p = {printed.INNOVATION_LENGTHS[-1]}"
    labels = ", ".join(sorted({s.manual for s in found.stages.values()}))
    manual = {
        o: (s.candidates[s.manual].estimation.output_error[o].nr,
            s.candidates[last].estimation.output_error[o].nr)
        for s in found.stages.values() for o in s.outputs
    }  # fmt: skip
    whole, fractional = _fits(found, "integer, identified"), _fits(found, "output error")
    better = [fractional[k] > whole[k] for k in whole]
    near = {
        o: (s.near.estimation.equation_error[o].nr, s.near.estimation.output_error[o].nr)
        for s in found.stages.values() for o in s.outputs
    }  # fmt: skip
    return [
        Claim(
            "The fractional model (p = 7) is closer to the run than the manual's integer-order model: Figures 6 and 9.",
            all(f < i for i, f in manual.values()),
            f"NR of the manual's model ({labels}) and of p = 7: "
            + "; ".join(f"{angle(o)} {numbers_listed(pair, 3)}" for o, pair in manual.items()) + ".",
        ),
        Claim(
            "Fractional orders describe the arm better than whole ones.",
            all(better),
            "both identified by output error from the same run; fit in percent of whole orders, even driven by the "
            "measured other angle, and of fractional ones from the current alone: "
            + "; ".join(f"{k} {numbers_listed([whole[k], fractional[k]])}" for k in whole)
            + ". The manual's model is no measure of whole orders: its parameters were not identified from this run.",
        ),
        Claim(
            "The orders of Tables 4 and 5 (2; 1.95 to 1.8) describe the arm.",
            all(output < FLATTERY * equation and output < EXPLAINS for equation, output in near.values()),
            "with these orders and the best coefficients for them, NR of the equation error and of the free run: "
            + "; ".join(f"{angle(o)} {numbers_listed(pair, 3)}" for o, pair in near.items())
            + ". So close to α, I^(α−ν) y is nearly y, and the equation says that a signal equals itself.",
        ),
    ]  # fmt: skip


#: A free run this many times worse than the equation error, or with a larger NR than this, describes nothing.
FLATTERY, EXPLAINS = 5.0, 0.5


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


def _claims_of_rivals(found: Recomputed) -> list[Claim]:
    spreads = implied_spreads()
    mixed = {o: pair for o, pair in spreads.items() if abs(pair[0] / pair[1] - 1) > MIXED}
    out = [
        Claim(
            "Table 7 compares both algorithms on one record.",
            not mixed,
            "standard deviation of the angle that RMSE / NR implies, genetic algorithm and multi-innovation: "
            + "; ".join(f"{angle(o)} {numbers_listed(pair, 3)}" for o, pair in spreads.items())
            + " rad. One record has one standard deviation.",
        )
    ]
    rivals = {o: r for s in found.stages.values() for o, r in s.rivals.items()}
    if rivals:
        pairs = {
            o: (r.genetic.estimation.output_error[o].error, r.lattice.estimation.output_error[o].error)
            for o, r in rivals.items()
        }
        out.append(
            Claim(
                "Multi-innovation has a smaller error than the genetic algorithm.",
                all(m < g for g, m in pairs.values()),
                "the same record, "
                + ", ".join(sorted({_budget(r) for r in rivals.values()}))
                + "; error (45) of the genetic algorithm's best seed and of p = 7: "
                + "; ".join(f"{angle(o)} {numbers_listed(pair)}" for o, pair in pairs.items())
                + ". The genetic algorithm minimises (45) over the coefficients, too; multi-innovation takes those of "
                "the equation error, pulled towards 0.",
            )
        )
    return out


def _budget(rival: Rival) -> str:
    """How many evaluations a seed of the genetic algorithm had for how many candidates of the lattice."""
    settings = {} if rival.genetic.result is None else rival.genetic.result.settings
    each = sum(settings["evaluations"].values()) / len(settings["seeds"])
    return f"{each:.0f} evaluations a seed for {rival.candidates} candidates"


#: Digits of RMSE and NR in Table 7 allow this much between two standard deviations of one record.
MIXED = 0.15


def _claim_of_the_derivative(found: Recomputed) -> Claim:
    dropped = {}
    for stage in (1, 2):
        row = {n: v for k in (1, 2) for n, v in _paper_orders(stage, k).items()}
        dropped[stage] = order_law(stage, "derived")["input"].at(row)
    nr = {
        s.derived.output: metrics(s.derived.published, s.derived.derived).nr for s in found.stages.values()
    }  # fmt: skip
    orders = ", ".join(f"{s.derived.order:.3g}" for s in found.stages.values())
    return Claim(
        "Eliminating the other angle leaves the current as it is: (19), (21).",
        all(abs(v) < 1e-9 for v in dropped.values()),
        f"the elimination differentiates the current as well, by the order {numbers_listed([*dropped.values()], 2)} at "
        f"the printed orders and {orders} at those identified here, where it changes the deflection's free run by NR "
        + ", ".join(f"{v:.3g} ({angle(o)})" for o, v in nr.items()) + ".",
    )  # fmt: skip


def _paper_orders(stage: int, k: int) -> dict[str, float]:
    index = 2 * stage - 2 + k
    row = printed.FRACTIONAL[f"theta{stage}{k}"][printed.INNOVATION_LENGTHS[-1]]
    return {f"{n}{index}": v for n, v in row.orders.items()}


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
