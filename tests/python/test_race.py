"""The race of starts, by where whole fits end; its parts are tested in the core."""

from __future__ import annotations

import ftlm
from plants import resonant_plant


def test_what_only_a_coarse_grid_carries_gives_way_to_another_optimum() -> None:
    # The samples' own grid is lowest where finer ones lead to two orders in one, 3 % above what is contained.
    run, noise = resonant_plant(39), []
    for text in ("D^alpha y = d D^mu y + a y + b u", "D^alpha y = d D^mu y + e D^nu y + a y + b u"):
        found = ftlm.identify(run, ftlm.equation(text), method=ftlm.OutputError(intervals="quadratic"))
        assert found.fit is not None
        noise.append(found.fit.noise["y"])
    assert noise[1] < 1.0005 * noise[0]


def test_of_two_free_orders_each_is_known_in_a_race_of_its_own_where_noise_would_leave_less() -> None:
    # A resonance and a dead time that neither has: with both orders free the lowest optimum lies far from the others.
    run = resonant_plant(27, wrong=True)
    fits = [
        ftlm.identify(
            run, ftlm.equation(f"D^alpha y = d D^{mu} y + a y + b u"), method=ftlm.OutputError(intervals="quadratic")
        ).fit
        for mu in ("1", "mu")
    ]
    assert fits[0] is not None
    assert fits[1] is not None
    assert fits[1].noise["y"] < 1.0005 * fits[0].noise["y"]
