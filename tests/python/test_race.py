"""The race of starts: who goes on, and on which grid all compete."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import ftlm
from ftlm.fit import starts
from ftlm.fit.grid import Attempt, Grid
from ftlm.fit.problem import FreeProblem
from ftlm.fit.race import (
    PIONEERS,
    Laps,
    coarse_samples,
    distinct,
    finalists,
    fine_enough,
    in_reach,
    is_rich,
    same_place,
    stirred,
    thinned,
)
from ftlm.fit.simpler import simpler, unlike
from plants import resonant_plant


def ended(level: float, order: float = 1.0, coefficient: float = 1.0, origin: str = "") -> Attempt:
    """An attempt of this cost per residual at an order and a coefficient."""
    return Attempt([order], [coefficient], origin, {"cost": level, "residuals": np.zeros(2)})


# ----------------------------------------------------------------------------------------------------------------------
# Who goes on


def test_those_up_to_three_times_as_far_off_as_the_best_go_on() -> None:
    assert [a.level for a in in_reach([ended(v) for v in (2.0, 2.1, 5.9, 6.1, 40.0)])] == [2.0, 2.1, 5.9]
    assert [a.level for a in in_reach([ended(v) for v in (0.0, 0.0, 1e-9)])] == [0.0, 0.0]


def test_finalists_are_three_different_optima_that_are_in_reach() -> None:
    reached = [ended(1.0, 0.5), ended(1.0, 0.51), ended(1.1, 0.9), ended(1.2, 1.5), ended(1.3, 1.9)]
    assert [a.orders for a in finalists(reached)] == [[0.5], [0.9], [1.5]]
    assert [a.orders for a in finalists([reached[0], ended(3.1, 0.9)])] == [[0.5]]


def test_starts_are_in_one_place_by_every_number_optima_by_cost_and_orders() -> None:
    here, there = ended(1.0, 1.0, 100.0, "here"), ended(1.0, 1.0, 103.0, "there")
    near, far = ended(1.5, 1.01, 101.0, "near"), ended(1.5, 1.01, 101.0, "far")
    assert [(a.origin, a.alike) for a in distinct([here, there])] == [("here", ("there",))]
    assert [(a.origin, a.alike) for a in distinct([here, there, near, far], same_place)] == [
        ("here", ("near", "far")), ("there", ())
    ]  # fmt: skip
    assert [a.origin for a in distinct([here, near])] == ["here", "near"]
    # A share of a number: of an order near 0 that is little.
    assert len(distinct([ended(1.0, 0.01), ended(1.0, 0.02)], same_place)) == 2
    assert len(distinct([ended(1.0, 0.01), ended(1.0, 0.02)])) == 1


# ----------------------------------------------------------------------------------------------------------------------
# On which grid all compete


@dataclass(frozen=True)
class Staged(Grid):
    """A grid that matters until so many pulses a sample interval."""

    enough: int = 1

    def matters(self, attempt: Attempt) -> bool:
        return self.every < self.enough


@dataclass(frozen=True)
class Told(Laps):
    """Laps whose ends are told: where a start gets on a grid, or None."""

    ends: Callable[[Grid, Attempt, int], Attempt | None] = lambda grid, attempt, evaluations: attempt
    calls: list[tuple[int, int]] | None = None

    def run(self, grid: Grid, runners: Sequence[Attempt], evaluations: int, problem: Any = None) -> list[Attempt]:
        if self.calls is not None:
            self.calls.append((grid.every, len(runners)))
        there = [self.ends(grid, a, evaluations) for a in runners]
        return sorted((a for a in there if a is not None), key=lambda a: a.level)


#: Five starts, each in a place of its own.
STARTS = [ended(1.0 + k, 0.3 * (k + 1), origin=str(k)) for k in range(5)]


def staged(enough: int) -> Staged:
    return Staged(FreeProblem.of(ftlm.equation("D y = -a y + b u", initial="rest")), [], [], enough=enough)


def test_starts_compete_on_the_first_grid_where_it_tells_where_they_lead() -> None:
    calls: list[tuple[int, int]] = []
    grid, going, ran = fine_enough(staged(1), STARTS, Told(5, 1, None, calls=calls))
    # All glance, and a few run ahead: nobody runs a lap twice.
    assert (grid.every, [a.origin for a in ran], [a.origin for a in going]) == (1, list("012"), list("34"))
    assert calls == [(1, 5), (1, PIONEERS)]


def test_few_starts_need_none_to_run_ahead() -> None:
    calls: list[tuple[int, int]] = []
    grid, going, ran = fine_enough(staged(4), STARTS[:PIONEERS], Told(3, 1, None, calls=calls))
    assert (grid.every, len(going), ran, calls) == (1, PIONEERS, [], [(1, PIONEERS)])


@pytest.mark.parametrize(("moved", "begin"), [(0.05, 2), (0.2, 5)])
def test_starts_go_on_from_a_coarse_grid_only_if_a_finer_one_moves_its_optimum_little(moved: float, begin: int) -> None:
    def ends(grid: Grid, attempt: Attempt, evaluations: int) -> Attempt:
        # Two optima, the lower one at another coefficient on a finer grid.
        if evaluations < 5:
            return attempt
        low = int(attempt.origin) < 3
        return replace(
            attempt, orders=[0.5 if low else 1.5], coefficients=[1.0 if grid.every == 1 else 1.0 + moved],
            outcome={"cost": 1.0 if low else 2.0, "residuals": np.zeros(2)},
        )  # fmt: skip

    calls: list[tuple[int, int]] = []
    grid, going, _ = fine_enough(staged(2), STARTS, Told(5, 1, None, ends, calls))
    assert grid.every == 2
    # Where it tells, one for each optimum that it has; where it does not, all from where they started.
    assert calls[-1] == (2, begin)
    assert [a.orders[0] for a in going] == ([0.5, 1.5] if begin == 2 else [s.orders[0] for s in STARTS])
    assert sum(1 + len(a.alike) for a in going) == len(STARTS)


def test_a_start_that_a_coarse_grid_does_not_carry_begins_on_the_finer_one() -> None:
    def ends(grid: Grid, attempt: Attempt, evaluations: int) -> Attempt | None:
        return None if grid.every == 1 and attempt.origin == "4" else attempt

    grid, going, _ = fine_enough(staged(2), STARTS, Told(5, 1, None, ends))
    assert (grid.every, [a.origin for a in going]) == (2, list("01234"))


def test_where_no_start_has_a_scheme_the_step_is_halved_until_one_has() -> None:
    def ends(grid: Grid, attempt: Attempt, evaluations: int) -> Attempt | None:
        return None if grid.every < 4 else attempt

    grid, going, _ = fine_enough(staged(1), STARTS, Told(5, 1, None, ends))
    assert (grid.every, len(going)) == (4, 5)


def test_of_those_far_behind_who_still_falls_goes_on(grid: Grid) -> None:
    # One at rest in its valley, one on its way down, one too far behind to be asked.
    best = grid.descend(Attempt([], [1.5, 1.5], "best", {}), 60)
    falls = grid.evaluated(Attempt([], [40.0, 1.0], "falls", {}))
    far = grid.evaluated(Attempt([], [1e3, 1e5], "far", {}))
    moving, still = stirred(grid, [best, falls, far], 2.0 * falls.level, Laps(3, 1, None))
    assert [a.origin for a in moving] == ["falls"]
    assert moving[0].level < 0.9 * falls.level
    assert [a.origin for a in still] == ["far", "best"]
    # Those that stay are as they were.
    assert still == [far, best]


@pytest.fixture(scope="module")
def grid() -> Grid:
    """First order, driven in exact steps, with a little noise."""
    rng, y = np.random.default_rng(4), np.zeros(81)
    u = np.repeat(rng.uniform(-1.0, 1.0, 10), 9)[:81]
    for k in range(80):
        y[k + 1] = np.exp(-0.2) * y[k] + (1.0 - np.exp(-0.2)) * u[k]
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": y + 0.01 * rng.normal(size=81)})
    return Grid(FreeProblem.of(ftlm.equation("D y = -a y + b u", initial="caputo")), [run], [100.0])


# ----------------------------------------------------------------------------------------------------------------------
# What is contained


def test_of_two_terms_alike_one_is_left_out() -> None:
    text = "D^alpha y = d D^mu y + e D^nu y + a y + b u"
    alike = simpler(FreeProblem.of(ftlm.equation(text)))
    assert [less.coefficient for less in alike] == ["d", "e", "a"]
    assert [less.coefficient for less in unlike(alike)] == ["d", "a"]
    apart = simpler(FreeProblem.of(ftlm.equation(text, orders={"mu": (0.0, 1.0, 0.1)})))
    assert [less.coefficient for less in unlike(apart)] == ["d", "e", "a"]
    known = simpler(FreeProblem.of(ftlm.equation("D^2 y = d D y + e D^nu y + a y + b u")))
    assert [less.coefficient for less in unlike(known)] == ["d", "e", "a"]


@pytest.mark.parametrize(
    ("text", "rich"),
    [
        ("D^alpha y = d D^mu y + e D^nu y + b u", True),
        ("D^alpha y = d D^mu y + a y + b D^gamma u", False),
        ("D^2 y = d D^mu y + p z; D^2 z = e D^nu z + a z + b u", False),
    ],
)
def test_an_equation_is_rich_with_two_own_terms_of_free_order(text: str, rich: bool) -> None:
    assert is_rich(FreeProblem.of(ftlm.equation(text))) is rich


def test_what_only_a_coarse_grid_carries_gives_way_to_another_optimum() -> None:
    # The samples' own grid is lowest where finer ones lead to two orders in one, 3 % above what is contained.
    run, noise = resonant_plant(39), []
    for text in ("D^alpha y = d D^mu y + a y + b u", "D^alpha y = d D^mu y + e D^nu y + a y + b u"):
        found = ftlm.identify(run, ftlm.equation(text), intervals="quadratic")
        assert found.joint is not None
        noise.append(found.joint.noise["y"])
    assert noise[1] < 1.0005 * noise[0]


def test_of_two_free_orders_each_is_known_in_a_race_of_its_own_where_noise_would_leave_less() -> None:
    # A resonance and a dead time that neither has: with both orders free the lowest optimum lies far from the others.
    run = resonant_plant(27, wrong=True)
    fits = [ftlm.identify(run, ftlm.equation(f"D^alpha y = d D^{mu} y + a y + b u"), intervals="quadratic").joint
            for mu in ("1", "mu")]  # fmt: skip
    assert fits[0] is not None
    assert fits[1] is not None
    assert fits[1].noise["y"] < 1.0005 * fits[0].noise["y"]


# ----------------------------------------------------------------------------------------------------------------------
# Rows of a lattice that become starts


@pytest.mark.parametrize(
    ("places", "asked", "found"),
    [((0, 1, 2, 3), [25], [0, 1, 2, 3]), ((0, 30, 60), [25, 400], [0, 30, 60])],
)
def test_a_lattice_is_asked_for_more_rows_only_where_the_first_lie_together(places, asked, found, monkeypatch) -> None:
    # 100 rows at one order, but for some that each lie apart.
    orders = [1.0 + (places.index(k) if k in places else 0.0) for k in range(100)]
    rows = [starts.Row({"alpha": v}, {"a": float(k)}) for k, v in enumerate(orders)]
    calls: list[int] = []

    def lattice_rows(structure, records, axes, coarse):
        calls.append(coarse.keep)
        return rows[: coarse.keep]

    monkeypatch.setattr(starts, "lattice_rows", lattice_rows)
    monkeypatch.setattr(starts, "zoom", lambda problem, structure, records, row, coarse: row)
    structure = ftlm.equation("D^alpha y = -a y + b u", initial="rest")
    problem = FreeProblem.of(structure)
    monkeypatch.setattr(FreeProblem, "free_from", lambda self, coefficients: [coefficients["a"], 1.0])
    coarse = starts.Coarse(1, 1 << 30)
    attempts = starts.lattice_attempts(problem, structure, [], {}, starts.APART, "here", [], coarse)
    assert calls == asked
    assert [a.coefficients[0] for a in attempts] == found


def test_runs_share_the_samples_that_starts_compete_on() -> None:
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.zeros(2401)}, outputs={"y": np.zeros(2401)})
    assert [coarse_samples([run] * n) for n in (1, 2, 3, 18)] == [1200, 600, 400, 400]
    problem = FreeProblem.of(ftlm.equation("D y = -a y + b u", initial="rest"))
    assert [thinned(Grid(problem, [run] * n, [1.0])).decimation for n in (1, 2, 4)] == [2, 4, 6]
