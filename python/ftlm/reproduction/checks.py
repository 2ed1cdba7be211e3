"""Checks of the paper's claims: computed numbers, numbers printed in the paper, and a verdict over cases.

A case is the outcome of one test of a claim, for one angle, record or arm. In this module, p is the innovation length
and K0 the prior covariance of multi-innovation.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from ftlm.arm.flexible_link import PARAMETER_SETS, order_law
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.published_values import FIRST_P, LAST_P, PRIOR_COVARIANCES, page_text, prior_text, read_texts
from ftlm.reproduction.simulated_arm import ANGLE_NAMES, STAGE_NUMBERS
from ftlm.reproduction.stage import TRACE_EVERY, OptimizerErrors, Trial, are_usable
from ftlm.utils.formatting import symbol
from ftlm.validation.comparison import metrics

if TYPE_CHECKING:
    from ftlm.reproduction.reproduction import Reproduction

Word = Literal["holds", "does not hold", "depends on", "not decidable by a simulation", "inconclusive"]
#: Case of a claim: whether the claim holds, and the level of each factor, such as the angle, by the factor's name. All
#: cases of a claim have the same factors.
Case = tuple[bool, dict[str, str]]
#: Result on one angle of one record.
ByAngle = TypeVar("ByAngle", Trial, OptimizerErrors)
#: Factor that the author of the simulation chose: which arm is simulated. A claim that depends on it is not decidable.
ARM_FACTOR = "the arm"
#: Thresholds in the rules of claims.toml, by name; relative differences are in percent.
RULE_NUMBERS: Mapping[str, float] = read_texts("claims")["rules"]


@dataclass(frozen=True)
class ClaimVerdict:
    """Verdict on a claim over all its cases.

    Parameters
    ----------
    word
        Verdict. If it is "depends on", the text of the verdict continues with `factors`.
    factors
        Factors on which the outcome depends, the most decisive first.
    cases, holding_cases
        Number of cases, and number of cases in which the claim holds.
    levels
        (level, number of cases, number of cases in which the claim holds) for each level of the first factor.
    """

    word: Word
    factors: tuple[str, ...] = ()
    cases: int = 0
    holding_cases: int = 0
    levels: tuple[tuple[str, int, int], ...] = ()

    def __str__(self) -> str:
        if self.word != "depends on":
            return self.word
        *others, last = self.factors
        return f"{self.word} {', '.join(others)} and {last}" if others else f"{self.word} {last}"

    @property
    def counts(self) -> str:
        """Text with the number of cases in which the claim holds, in all and for each level of the first factor."""
        name = "K0 = " if self.factors[:1] == ("K0",) else ""
        parts = "; ".join(f"{name}{level}: {holding} of {count}" for level, count, holding in self.levels)
        return f"{self.holding_cases} of {self.cases} cases" + (f"; {parts}" if parts else "")


def case(holds: object, **factors: str) -> Case:
    """Return (whether the claim holds, level of each factor by name); "_" in a keyword becomes a space in the name."""
    return bool(holds), {name.replace("_", " "): level for name, level in factors.items()}


def combine_cases(cases: Sequence[Case], *, of_the_machine: bool = False) -> ClaimVerdict:
    """Return the verdict on a claim over all its cases.

    A claim holds if it holds in every case, and does not hold if it holds in none. Otherwise it depends on each factor
    whose change, with all others fixed, changes the outcome. If a single factor determines the outcome of every case,
    only this factor is named. A claim about the real machine (`of_the_machine`) is not decidable by simulation if it
    depends on the simulated arm, or if only one arm was simulated.
    """
    holding = sum(holds for holds, _ in cases)

    def outcomes(level_of: Callable[[Mapping[str, str]], Any]) -> dict[Any, list[bool]]:
        outcomes_by_level: dict[Any, list[bool]] = defaultdict(list)
        for holds, factors in cases:
            outcomes_by_level[level_of(factors)].append(holds)
        return outcomes_by_level

    def flips(name: str) -> int:
        """Return the number of pairs of cases with different outcomes that differ in no factor but `name`."""
        groups = outcomes(lambda factors: tuple(level for n, level in factors.items() if n != name))
        return sum(sum(g) * (len(g) - sum(g)) for g in groups.values())

    def verdict(word: Word, factors: Sequence[str] = (), by: str | None = None) -> ClaimVerdict:
        groups = {} if by is None else outcomes(itemgetter(by))
        levels = tuple((level, len(each), sum(each)) for level, each in groups.items())
        return ClaimVerdict(word, tuple(factors), len(cases), holding, levels)

    if not cases:
        return verdict("inconclusive")
    if of_the_machine and len({factors.get(ARM_FACTOR) for _, factors in cases}) < 2:
        return verdict("not decidable by a simulation", [ARM_FACTOR])
    if holding in (0, len(cases)):
        return verdict("holds" if holding else "does not hold")
    names = list(cases[0][1])
    turning = sorted(filter(flips, names), key=flips, reverse=True)
    if of_the_machine and ARM_FACTOR in turning:
        return verdict("not decidable by a simulation", [ARM_FACTOR], ARM_FACTOR)
    # If one factor determines every outcome, the others need not be named.
    deciding = [n for n in names if all(len(set(g)) == 1 for g in outcomes(itemgetter(n)).values())]
    factors = deciding[:1] or turning or names
    return verdict("depends on", factors, factors[0])


@dataclass(frozen=True)
class Check:
    """Claim of the paper (or error in the paper) with a verdict from computed numbers.

    Parameters
    ----------
    claim
        Claim as a sentence.
    ruling
        Verdict and numbers of cases.
    computed, printed
        Texts with the computed numbers and with the numbers printed in the paper.
    rule
        Text of the condition under which the claim holds in a case.
    """

    claim: str
    ruling: ClaimVerdict
    computed: str
    printed: str
    rule: str

    @property
    def verdict(self) -> str:
        """Verdict as text, such as "holds", "does not hold" or "depends on the angle"."""
        return str(self.ruling)

    @property
    def brief(self) -> str:
        """First sentence of the text with the computed numbers."""
        return self.computed.partition(". ")[0]

    @property
    def holds(self) -> bool | None:
        """Whether the claim holds: True in every case, False in none, None for any other verdict."""
        return {"holds": True, "does not hold": False}.get(self.ruling.word)

    def to_dict(self) -> dict[str, Any]:
        """Return the check as a dictionary for JSON."""
        counts = {"cases": self.ruling.cases, "held": self.ruling.holding_cases}
        texts = {"computed": self.computed, "printed": self.printed, "rule": self.rule}
        return {"claim": self.claim, "verdict": self.verdict, "depends on": list(self.ruling.factors)} | counts | texts


def by_angle(numbers: Mapping[str, Iterable[float]], digits: int = 3) -> str:
    """Return text with the symbol of each angle and its numbers, with `digits` significant digits."""
    return "; ".join(f"{symbol(name)} {format_list(values, digits)}" for name, values in numbers.items())


def format_list(values: Iterable[float], digits: int = 3) -> str:
    """Return numbers as text, separated by commas, with `digits` significant digits."""
    return ", ".join("∞" if math.isinf(v) else f"{v:.{digits}g}" for v in values)


def _of_angles(holding: Mapping[str, bool]) -> list[Case]:
    return [case(v, the_angle=symbol(o)) for o, v in holding.items()]


def _of_rows(rows: Iterable[printed.PrintedModelRun], holds: Callable[[printed.PrintedModelRun], bool]) -> list[Case]:
    return [case(holds(r), the_angle=symbol(r.output), p=str(r.p)) for r in rows]


def _of_trials(trials: Iterable[Trial], holds: Callable[[Trial], Any]) -> list[Case]:
    return [
        case(holds(t), K0=prior_text(t.prior), the_arm=t.arm, the_angle=symbol(t.output), the_record=str(t.seed))
        for t in trials
    ]


def _first_by_angle(results: Iterable[ByAngle]) -> dict[str, ByAngle]:
    """Return the first result on each angle, that of the first record of the main arm, in the order of the angles."""
    first = {r.output: r for r in reversed(list(results))}
    return {o: first[o] for o in ANGLE_NAMES if o in first}


def _by_prior(reproduction: Reproduction, numbers: Callable[[Trial], Iterable[float]]) -> str:
    """Return text with numbers of the multi-innovation trials on the first record of the main arm.

    The numbers are sorted by prior covariance K0, then by angle. `numbers` returns the numbers of one trial.
    """
    texts = []
    for prior in PRIOR_COVARIANCES:
        first = _first_by_angle(t for t in reproduction.cases.trials if t.prior == prior)
        texts.append(f"K0 = {prior_text(prior)}: {by_angle({o: numbers(t) for o, t in first.items()}, 4)}")
    return "; ".join(texts)


def _printed_text(name: str, outputs: Iterable[str], lengths: Sequence[int] = (LAST_P,), digits: int = 5) -> str:
    """Return text with one number of each fractional row of the paper's Tables 4 and 5, by angle.

    `name` is the attribute of a row with this number, and `lengths` are the innovation lengths p of the rows.
    """
    return by_angle({o: [getattr(printed.FRACTIONAL_ROWS[o][p], name) for p in lengths] for o in outputs}, digits)


def deviation_text(reproduction: Reproduction) -> str:
    """Return text on the ratios of the implied to the simulated standard deviation of each printed model.

    The implied standard deviation of the measured angle is RMSE / NR of the printed row. If a ratio makes the printed
    NR of a row impossible, the text also has the smallest possible NR.
    """
    rows = reproduction.printed_model_runs
    ratios = sorted(r.deviation_ratio for r in rows)
    # If the standard deviation of a response is r times smaller than that of the angle, NR is at least 1 - 1/r.
    floors = [max(1 - 1 / r.deviation_ratio, 0.0) for r in rows]
    values = [r.row.nr for r in rows]
    count = sum(low > nr for low, nr in zip(floors, values, strict=True))
    middle = f"from {ratios[0]:.3g} to {ratios[-1]:.3g}, median {statistics.median(ratios):.3g}"
    if not count:
        return middle
    floor, nr = ((min(v), max(v)) for v in (floors, values))
    return page_text("deviations", ratios=middle, floors=floor, values=nr, count=count, rows=len(values))


#: Cases of a claim, and numbers for the placeholders in its texts in claims.toml.
Evidence = tuple[Sequence[Case], dict[str, Any]]


def movement(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that the models printed in the paper move as much as the paper's arm.

    It holds if the ratio of standard deviations is within a factor of 2.
    """
    rows, most = reproduction.printed_model_runs, RULE_NUMBERS["deviation_ratio"]
    worst = max(rows, key=attrgetter("deviation_ratio"))
    return _of_rows(rows, lambda r: 1 / most < r.deviation_ratio < most), {
        "angle": symbol(worst.output),
        "worst": worst,
        "ratios": deviation_text(reproduction),
        "deviations": by_angle({r.output: [r.implied_deviation] for r in rows}),
    }


def stability(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that the models printed in the paper are stable."""
    rows = reproduction.printed_model_runs
    poles: dict[str, list[float]] = defaultdict(list)
    for r in rows:
        poles[r.output].append(r.stability.unstable_poles)
    return _of_rows(rows, lambda r: r.stability.stable), {"poles": by_angle(poles, 2)}


def returned_coefficients(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that printed models can be recovered from their own simulated responses.

    It holds for a model if a fit at the printed orders returns its coefficient a within 2 %.
    """
    cases: list[Case] = []
    last: dict[float, dict[str, list[float]]] = {k: {} for k in PRIOR_COVARIANCES}
    orders: list[str] = []
    for r, k in product(reproduction.printed_model_runs, PRIOR_COVARIANCES):
        angle, K0 = symbol(r.output), prior_text(k)
        a = r.returned_a.get(k, math.nan)
        away = abs(a / r.row.a - 1)
        cases.append(case(away < RULE_NUMBERS["difference"] / 100, K0=K0, the_angle=angle, p=str(r.p)))
        if r.p == LAST_P:
            last[k][r.output] = [a]
        if k in r.orders:
            found = ", ".join(f"{symbol(n)} {v:g}" for n, v in r.orders[k].items() if not n.startswith("alpha"))
            orders.append(f"{angle}, K0 = {K0}: {found}")
    return cases, {
        "values": ". ".join(f"a of p = {LAST_P} with K0 = {prior_text(k)}: {by_angle(a)}" for k, a in last.items()),
        "orders": "; ".join(orders),
        "printed_text": _printed_text("a", last[PRIOR_COVARIANCES[0]]),
    }


def recomputed_tables(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that Tables 4 and 5 of the paper can be recomputed.

    It holds for an angle if recomputed coefficients and normalized residuals (NR) are within a factor of 1.25 of the
    printed ones, with equal signs.
    """
    tables = reproduction.as_printed
    settings = (f"{symbol(o)} {t.interpretation}, with K0 = 1 {t.ratio_at_unit_prior:.3g}" for o, t in tables.items())
    return _of_angles({o: t.is_close for o, t in tables.items()}), {
        "away": ", ".join(f"{t.ratio:.2f} ({symbol(o)})" for o, t in tables.items()),
        "ratios": by_angle({o: [t.ratios[c][-1] for c in "bdg"] for o, t in tables.items()}),
        "settings": "; ".join(settings),
        "printed_text": _printed_text("a", tables),
    }


def printed_orders(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that the orders printed in the paper are the best ones.

    It holds for an angle if no other orders on a grid around the printed ones have a smaller equation error.
    """
    tables = reproduction.as_printed
    return _of_angles({o: t.rank == 1 for o, t in tables.items()}), {
        "places": ", ".join(f"{symbol(o)} {t.rank} of {t.grid_count}" for o, t in tables.items()),
        "best": by_angle({o: [t.best[n] for n in ("beta", "gamma", "mu")] for o, t in tables.items()}),
    }


def error_falls(t: Trial) -> bool:
    """Whether the error, eq. (45) of the paper, never increases with innovation length p and falls by over 2 %."""
    e = list(t.errors.values())
    return all(b <= a for a, b in pairwise(e)) and e[-1] < (1 - RULE_NUMBERS["difference"] / 100) * e[0]


def converges_faster(arrived: Mapping[int, float]) -> bool | None:
    """Whether larger innovation lengths p converge in fewer steps; None if all converge at the first evaluated step.

    `arrived` is the number of steps by p. The largest p must save at least 10 % of the steps of the smallest.
    """
    steps = list(arrived.values())
    if max(steps) <= TRACE_EVERY:
        return None
    # The claim fails if an error never converges, because infinite numbers of steps cannot be compared.
    earlier = all(b <= a for a, b in pairwise(steps)) and steps[-1] <= (1 - RULE_NUMBERS["saving"] / 100) * steps[0]
    return math.isfinite(max(steps)) and earlier


def innovation_length(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that a larger innovation length p gives a smaller simulation error."""
    return _of_trials(reproduction.cases.trials, error_falls), {
        "errors": _by_prior(reproduction, lambda t: t.errors.values()),
        "printed_text": _printed_text("error", ANGLE_NAMES, printed.INNOVATION_LENGTHS),
    }


def convergence(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that a larger innovation length p converges in fewer recursion steps."""
    trials = reproduction.cases.trials
    comparable = [t for t in trials if converges_faster(t.convergence_steps) is not None]
    return _of_trials(comparable, lambda t: converges_faster(t.convergence_steps)), {
        "steps": _by_prior(reproduction, lambda t: t.convergence_steps.values()),
        "left_out": len(trials) - len(comparable),
        "trials": len(trials),
    }


def weak_prior(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that a larger innovation length p gives a smaller simulation error.

    Only results with a weak prior are used.
    """
    weak = [t for t in reproduction.cases.trials if t.prior == printed.WEAK_PRIOR]
    cases = _of_trials(weak, error_falls)
    ratios = [t.errors[LAST_P] / e for t in weak if math.isfinite(e := t.errors[FIRST_P]) and e]
    spread = [
        weak_prior_variation(each) for s in reproduction.stages.values() for each in s.weak_prior_coefficients.values()
    ]
    words = "no record that starts at rest"
    if ratios:
        counts = combine_cases(cases).counts
        words = f"{counts}; errors of p = {LAST_P} over p = {FIRST_P}: {min(ratios):.4g} to {max(ratios):.4g}"
    if spread:
        words += f"; coefficients at the same orders differ by at most {100 * max(spread):.2g} %"
    away = (f"{100 * printed.printed_saturation(o)[2]:.2g} % ({symbol(o)})" for o in ANGLE_NAMES)
    return cases, {"words": words, "away": ", ".join(away)}


def weak_prior_variation(each: Mapping[int, Mapping[str, float]]) -> float:
    """Return the largest relative change of a coefficient from innovation length p = 1 to any other p.

    `each` has the coefficients by p and name.
    """
    first = each[FIRST_P]
    return max(abs(c[n] / first[n] - 1) for c in each.values() for n in first if first[n])


def has_smaller_error(error: float, seeds: Iterable[float]) -> bool:
    """Whether an error is finite and below the median of an optimizer's errors over its seeds (`seeds`).

    The minimum over seeds would depend on their number.
    """
    return math.isfinite(error) and error < statistics.median(seeds)


def optimizers(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that multi-innovation has a smaller error than the other optimizers."""
    comparisons = reproduction.cases.optimizer_errors
    cases = []
    for c in comparisons:
        for k, (name, errors) in product(c.order_grid, c.optimizers.items()):
            holds = has_smaller_error(c.order_grid[k], errors.values())
            cases.append(case(holds, K0=prior_text(k), the_arm=c.arm, the_angle=symbol(c.output), the_optimizer=name))
    own = _first_by_angle(comparisons)
    of_seeds = (min, statistics.median, max)
    both = {
        o: (*c.order_grid.values(), *(f(each.values()) for each in c.optimizers.values() for f in of_seeds))
        for o, c in own.items()
    }
    seeds = [len(c.optimizers["genetic"]) for c in comparisons]
    return cases, {
        "errors": by_angle(both),
        "budgets": ", ".join(dict.fromkeys(f"{c.candidates} candidates and evaluations a seed" for c in own.values())),
        "seeds": " to ".join(dict.fromkeys(map(str, (min(seeds), max(seeds))))),
        "printed_text": by_angle({o: [part[0] for part in printed.TABLE_7_CRITERIA[o]] for o in own}, 5),
    }


def manual(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that multi-innovation is more accurate than the manufacturer's model.

    It holds if the normalized residual (NR) of the model with innovation length 7 is smaller.
    """
    both = {o: [printed.INTEGER_ROWS[o].nr, printed.FRACTIONAL_ROWS[o][LAST_P].nr] for o in ANGLE_NAMES}
    return _of_trials(reproduction.cases.trials, lambda t: t.nr < t.manual), {
        "errors": _by_prior(reproduction, lambda t: (t.manual, t.nr)),
        "printed_text": by_angle(both, 4),
    }


def fractional_orders(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that fractional orders improve the fit significantly."""
    freed = reproduction.cases.order_comparisons
    verdicts = [(f, o, improves) for f in freed for o in f.free_nr if (improves := f.improves(o)) is not None]
    cases = [case(improves, the_arm=f.arm, the_angle=symbol(o)) for f, o, improves in verdicts]
    both = (f"{f.arm}: {by_angle({o: (f.integer_nr[o], f.free_nr[o]) for o in f.free_nr})}" for f in freed)
    return cases, {
        "unknown": sum(len(f.free_nr) for f in freed) - len(verdicts),
        "errors": "; ".join(both),
        "orders": "; ".join(f"{f.arm}, stage {f.stage}: {f.fractional_text}" for f in freed),
    }


def close_orders(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that models with the orders printed in the paper describe the arm.

    It holds for an angle if the normalized residual (NR) of the simulation is small, both in itself and relative to the
    NR of the equation error.
    """
    near = {o: s.printed_orders.estimation for s, o in reproduction.angles}
    nr = {o: (c.equation_error[o].nr, c.output_error[o].nr) for o, c in near.items()}
    ratio, most = RULE_NUMBERS["error_ratio"], RULE_NUMBERS["explaining_nr"]
    holding = {o: free < ratio * equation and free < most for o, (equation, free) in nr.items()}
    return _of_angles(holding), {
        "errors": by_angle(nr),
        "printed_text": _printed_text("nr", near, digits=4),
    }


def published_form(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that the published equations recover the orders of the arm.

    The published equations are (22)-(25) of the paper. The arm is simulated by its eqs. (14)-(15). The claim holds for
    a joint if all order estimates are within four standard errors of the true values.
    """
    cases: list[Case] = []
    away: list[str] = []
    fits: dict[str, list[float]] = {}
    omitted, count, limit = "", 0, RULE_NUMBERS["standard_errors"]
    for number, stage in reproduction.stages.items():
        both = [stage.candidates[n] for n in ("output error", "published, output error")]
        result = both[1].result
        if result is None or not are_usable(*both):
            omitted += f"; stage {number} is no case, because one of its fits must not be used"
            continue
        fits |= {o: [c.estimation.output_error[o].fit for c in both] for o in stage.outputs}
        wrong = []
        for name, value in result.orders.items():
            # One order is free in the published form only; in the simulated arm it is fixed at 2.
            truth, error = reproduction.truth[number].get(name, 2.0), result.standard_errors[name]
            if not (math.isfinite(error) and abs(value - truth) <= limit * error):
                wrong.append(f"{symbol(name)} {value:.4g} ± {error:.2g} ({truth:g})")
        away += wrong
        count += len(result.orders)
        cases.append(case(not wrong, the_stage=str(number)))
    texts = {"listed": ", ".join(away) or "none", "fits": by_angle(fits, 4), "omitted": omitted}
    return cases, {"away": len(away), "count": count, **texts}


def table_3_coefficients() -> dict[str, tuple[float, float, float]]:
    """Return three values of each coefficient of eqs. (22)-(25) of the paper, by name.

    The first value follows from Table 3 of the paper, and the second from the manufacturer's effective parameters. The
    third value is printed in the paper.
    """
    coefficients = {}
    for output, row in printed.INTEGER_ROWS.items():
        stage = printed.stage_of(output)
        table, effective = (PARAMETER_SETS[n][stage].coefficients(stage) for n in ("table-3", "effective"))
        for letter, value in row.coefficients.items():
            name = printed.parameter_name(letter, output)
            coefficients[name] = (table[name], effective[name], value)
    return coefficients


def dropped_derivative(reproduction: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that the paper may drop the derivative of the current.

    Equations (19) and (21) drop it. The claim holds if the printed orders give this derivative the order 0.
    """
    orders = {n: printed.printed_numbers(n, LAST_P)[0] for n in STAGE_NUMBERS}
    dropped = {n: order_law(n, "derived")["input"].at(each) for n, each in orders.items()}
    parts = [stage.dropped_derivative_effect for stage in reproduction.stages.values()]
    return [case(abs(v) < 1e-9, the_stage=str(n)) for n, v in dropped.items()], {
        "printed_orders": format_list(dropped.values(), 2),
        "orders": format_list(p.order for p in parts),
        "changed": ", ".join(f"{metrics(p.derived, p.published).nr:.3g} ({symbol(p.output)})" for p in parts),
        "correlations": by_angle({p.output: p.correlations.values() for p in parts}, 2),
    }


def table_3(_: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that the parameters in Table 3 give the printed integer-order models.

    It holds if all coefficients agree within 2 %.
    """
    rows = table_3_coefficients()
    ratios = {n: t / p for n, (t, _, p) in rows.items()}
    off = {n: r for n, r in ratios.items() if abs(r - 1) > RULE_NUMBERS["difference"] / 100}
    worst = max(off, key=lambda n: abs(math.log(abs(off[n]))))
    return [case(not off)], {
        "off": len(off),
        "count": len(rows),
        "worst": worst,
        "ratio": ratios[worst],
        "effective": 100 * max(abs(e / p - 1) for _, e, p in rows.values()),
        "printed_text": rows[worst][2],
    }


def one_record(_: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that Table 7 of the paper is based on one record.

    It holds for an angle if both of its rows imply the same standard deviation (RMSE / NR) within 15 %.
    """
    spreads = printed.implied_spreads()
    agreeing = {o: abs(g / m - 1) <= RULE_NUMBERS["mismatch"] / 100 for o, (g, m) in spreads.items()}
    return _of_angles(agreeing), {"deviations": by_angle(spreads)}


def possible_row(_: Reproduction) -> Evidence:
    """Return cases and numbers on the claim that the mean absolute error of one printed row is at most its RMSE.

    This inequality holds for any data.
    """
    row = printed.INTEGER_ROWS["theta22"]
    mean = row.error / printed.PULSE_COUNT
    return [case(mean <= row.rmse, the_angle="θ₂₂")], {"mean": mean, "row": row}


#: Values of placeholders that the texts of several claims contain.
SHARED_FIELDS = {"first_p": FIRST_P, "last_p": LAST_P, "trace_every": TRACE_EVERY, "published": printed, **RULE_NUMBERS}


def make_check(name: str, reproduction: Reproduction) -> Check:
    """Evaluate the function of one claim, and return its verdict with its texts from claims.toml."""
    texts = read_texts("claims")[name]
    cases, fields = globals()[name](reproduction)
    ruling = combine_cases(cases, of_the_machine=texts.get("of_the_machine", False) and reproduction.simulated)
    values = {"counts": ruling.counts, **SHARED_FIELDS, **fields}
    return Check(ruling=ruling, **{n: texts[n].format(**values) for n in ("claim", "computed", "printed", "rule")})


def checks(reproduction: Reproduction) -> list[Check]:
    """Return the checks of all claims of the paper; a claim is omitted if the reproduction lacks results for it."""
    return [
        make_check(name, reproduction)
        for name, texts in read_texts("claims").items()
        if name != "rules" and all(attrgetter(part)(reproduction) for part in texts.get("needs", ()))
    ]
