"""The race of starts, by where whole fits end; its parts are tested in the core."""

from __future__ import annotations

import functools
from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

import ftlm
from automatic_plants import held_input
from ftlm.estimation.output_error import fit_output_error
from oracles import held_response
from plants import resonant_plant

pytestmark = pytest.mark.usefixtures("no_extension_tests")


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


def random_plant(seed: int) -> tuple[ftlm.Run, str, float]:
    """Return a run of a random plant at 40 dB, the plant's equation, and the fit of the plant itself in percent.

    Even seeds have integer orders 1 to 5 and random zeros, odd ones two fractional orders. No run is simulated by ftlm.
    """
    g = np.random.default_rng([seed, 45])
    rows = 1000
    if seed % 2:
        alpha, mu, stiff = g.uniform(1.3, 2.0), g.uniform(0.2, 1.1), 10 ** g.uniform(0.3, 1.8)
        damping = 2 * g.uniform(0.05, 0.5) * stiff ** (1 - mu / alpha)
        step, hold = 0.02, 20
        u = held_input(g, rows, hold)
        y = held_response(lambda s: stiff / (s**alpha + damping * s**mu + stiff), u, step, 100)
        words = "D^alpha y = a1 D^mu y + a0 y + b0 u"
    else:
        order = seed // 2 % 5 + 1
        zeros = int(g.integers(0, order))
        pairs = [(10 ** g.uniform(0, 1), 10 ** g.uniform(-1.7, -0.3)) for _ in range(order // 2)]
        lags = 10 ** g.uniform(0, 1, order % 2)
        denominator = functools.reduce(np.polymul, [[1, 2 * z * w, w * w] for w, z in pairs] + [[1, w] for w in lags])
        numerator = np.poly(-g.uniform(-1, 1, zeros) * 10 ** g.uniform(0, 1, zeros))
        step = 2 * np.pi / 12 / max([w for w, _ in pairs] + lags.tolist())
        u = held_input(g, rows, 60)
        b, a, _ = cont2discrete((numerator, denominator), step)[:3]
        y = lfilter(np.ravel(b), a, u)
        own = [f"a{k} D^{k} y" for k in range(order)]
        words = f"D^{order} y = {' + '.join([*own, *(f'b{k} D^{k} u' for k in range(zeros + 1))])}"
    noisy = y + 0.01 * np.std(y) * g.standard_normal(rows)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": noisy}, name=f"plant {seed}")
    return run, words, 100 * (1 - float(np.linalg.norm(noisy - y) / np.linalg.norm(noisy - np.mean(noisy))))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_no_fit_leaves_more_than_the_plant_itself() -> None:
    worse = []
    for seed in range(200):
        run, words, truth = random_plant(seed)
        found = ftlm.identify(
            run, ftlm.equation(words, initial="rest"), method=ftlm.OutputError(intervals="quadratic"), threads=1
        )
        if found.fit["y"] < truth - 1e-3:
            worse.append((seed, words, truth, found.fit["y"]))
    assert worse == []
