"""The race of starts, by where whole fits end; its parts are tested in the core."""

from __future__ import annotations

from itertools import pairwise

import pytest

import ftlm
from ftlm.estimation.output_error import fit_output_error
from plants import resonant_plant


def test_what_only_a_coarse_grid_carries_gives_way_to_another_optimum() -> None:
    # The samples' own grid is lowest where finer ones lead to two orders in one, 3 % above what is contained.
    run, noise = resonant_plant(39), []
    for text in ("D^alpha y = d D^mu y + a y + b u", "D^alpha y = d D^mu y + e D^nu y + a y + b u"):
        found = ftlm.identify(run, ftlm.equation(text), method=ftlm.OutputError(intervals="quadratic"))
        assert found.joint is not None
        noise.append(found.joint.noise["y"])
    assert noise[1] < 1.0005 * noise[0]


def test_of_two_free_orders_each_is_known_in_a_race_of_its_own_where_noise_would_leave_less() -> None:
    # A resonance and a dead time that neither has: with both orders free the lowest optimum lies far from the others.
    run = resonant_plant(27, wrong=True)
    fits = [
        ftlm.identify(
            run, ftlm.equation(f"D^alpha y = d D^{mu} y + a y + b u"), method=ftlm.OutputError(intervals="quadratic")
        ).joint
        for mu in ("1", "mu")
    ]
    assert fits[0] is not None
    assert fits[1] is not None
    assert fits[1].noise["y"] < 1.0005 * fits[0].noise["y"]


def test_the_order_of_an_input_is_freed_from_where_orders_are_integers() -> None:
    run, noise = resonant_plant(4), []
    for text in ("D^alpha y = d D^mu y + a y + b u", "D^alpha y = d D^mu y + a y + b u + c D^gamma u"):
        found = ftlm.identify(
            run, ftlm.equation(text, initial="rest"), method=ftlm.OutputError(intervals="quadratic"), threads=1
        )
        assert found.joint is not None
        noise.append(found.joint.noise["y"])
    assert noise[1] < 0.99995 * noise[0]


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [False, True])
def test_a_structure_is_never_worse_than_one_inside_it(wrong: bool) -> None:
    chain = (
        "D^2 y = d D y + a y + b u",
        "D^alpha y = d D y + a y + b u",
        "D^alpha y = d D^mu y + a y + b u",
        "D^alpha y = d D^mu y + a y + b u + c D^gamma u",
    )
    worse = []
    for seed in range(40):
        run = resonant_plant(seed, wrong=wrong)
        costs = [
            fit_output_error([run], ftlm.equation(text, initial="rest"), threads=1).noise["y"] ** 2 for text in chain
        ]
        worse += [(seed, richer / simpler) for simpler, richer in pairwise(costs) if richer > 1.001 * simpler]
    assert worse == []
