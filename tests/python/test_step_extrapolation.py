"""Extrapolation to step 0: against powers of the step, kinks, grids without numbers, and a filtered state space."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lsim

import ftlm
from ftlm import _core
from ftlm.simulation import step_refinement
from ftlm.simulation.output_samples import FIRST_REFINEMENT, simulate_samples
from ftlm.simulation.step_refinement import simulate_refined
from output_samples_oracle import extrapolate_row

TRUTH = np.random.default_rng(0).standard_normal((1, 200))
SHAPES = list(np.random.default_rng(1).standard_normal((3, 1, 200)))


def grids(powers: tuple[float, ...], count: int) -> list[np.ndarray]:
    """A truth with an error of these powers of the step."""
    steps = 0.5 ** np.arange(count)
    return [TRUTH + sum(s * h**p for s, p in zip(SHAPES, powers, strict=False)) for h in steps]


def extrapolate(samples: list[np.ndarray]) -> tuple[np.ndarray, float]:
    found, change, _ = _core.richardson_limit([(each, []) for each in samples], [])
    return found, float(np.max(change))


def test_three_powers_of_the_step_are_taken_away():
    rows: list[np.ndarray] = []
    for samples in grids((2, 3, 4), 4):
        rows = extrapolate_row(samples, rows)
    np.testing.assert_allclose(rows[3], TRUTH, atol=1e-14)
    np.testing.assert_allclose(extrapolate_row(*[grids((2,), 2)[1], [grids((2,), 2)[0]]])[1], TRUTH, atol=1e-14)


@pytest.mark.parametrize(
    "powers", [(2, 3, 4), (2, 2.4), (1.5,), (1,), (2, 3, 3.5), (0.5,), (2.1, 2.4, 3), (1.3, 2), (2, 2.05)]
)
def test_the_change_bounds_the_error_whatever_its_powers(powers):
    # A kink leaves powers between those that are taken away.
    for count in range(3, 9):
        found, change = extrapolate(grids(powers, count))
        error = float(np.max(np.abs(found - TRUTH)) / np.max(np.abs(found)))
        assert error <= 2.5 * change + 1e-14


def test_a_power_that_no_column_has_is_told_by_four_grids():
    # The factor by which its error shrinks is the last two moves'; a fourth grid says whether it is one.
    found, change = extrapolate(grids((1.37,), 4))
    np.testing.assert_allclose(found, TRUTH, atol=1e-12)
    assert change < 1e-12


def test_a_logarithm_of_the_step_takes_fewer_grids():
    # Orders that meet leave h^2 ln h, which the next power of the triangle does not take away.
    samples = [TRUTH + SHAPES[0] * h**2 * (1.0 - np.log(h)) for h in 0.5 ** np.arange(2, 9)]
    every = [extrapolate(samples[: count + 1]) for count in range(2, 7)]
    for found, change in every:
        assert np.max(np.abs(found - TRUTH)) / np.max(np.abs(found)) <= 2.5 * change
    assert [change < 1e-6 for _, change in every].index(True) == 2
    rows: list[np.ndarray] = []
    moved = []
    for each in samples:
        rows, before = extrapolate_row(each, rows), rows
        moved.append([float(np.max(np.abs(a - b))) for a, b in zip(rows[1:], before[1:], strict=False)])
    # Not even the finest of these grids was enough for the triangle.
    assert min(moved[5]) > 1e-6


def test_numbers_beside_samples_go_where_these_go():
    # Two outputs of different powers, and a number of each that is one of its samples.
    samples = [np.concatenate([a, b]) for a, b in zip(grids((1.37,), 4), grids((1.8,), 4), strict=True)]
    places = [1, 0, 0], [5, 3, 4]
    found, _, terms = _core.richardson_limit([(each, each[places].tolist()) for each in samples], places[0])
    np.testing.assert_allclose(terms, TRUTH[0, [5, 3, 4]], atol=1e-12)
    np.testing.assert_array_equal(terms, found[places])


def test_one_sample_that_moves_tells_no_factor():
    # Its moves are in a ratio whatever they are: here the same one twice, and then not.
    wild = [np.zeros((1, 50)) for _ in range(4)]
    for each, value in zip(wild, (1.0, 0.7, 0.55, 0.475), strict=True):
        each[0, 7] = value
        each[0, 8] = 1.0
    assert extrapolate(wild)[1] > 0.02


def test_two_grids_tell_no_change_and_three_do():
    assert extrapolate(grids((2, 3), 1))[1] == extrapolate(grids((2, 3), 2))[1] == np.inf
    assert extrapolate(grids((2, 3), 3))[1] < 1.0


def test_a_grid_without_numbers_tells_nothing():
    lost = np.full_like(TRUTH, np.nan)
    found, change = extrapolate([lost, *grids((2, 3, 4), 5)])
    after = extrapolate(grids((2, 3, 4), 5))
    assert (change, found.tolist()) == (after[1], after[0].tolist())
    assert np.isnan(extrapolate([*grids((2,), 3), lost])[0]).all()
    # In the middle it tells nothing of those after it either.
    between = extrapolate([*grids((2, 3, 4), 3), lost, *grids((2, 3, 4), 2)])
    assert (between[1], between[0].tolist()) == (np.inf, extrapolate(grids((2, 3, 4), 2))[0].tolist())


def test_what_does_not_move_has_stood_still():
    assert extrapolate([np.zeros((1, 3))] * 3)[1] == 0.0


#: The last row of each companion matrix, and what the input drives.
WHOLE = {
    "D^2 y = -40 y - 1.5 D y + 30 u": ([-40, -1.5], 30),
    "D y = -30 y + 25 u": ([-30], 25),
    "D^3 y = -40 y - 60 D y + u": ([-40, -60, 0], 1),
}


@pytest.mark.parametrize("words", WHOLE)
@pytest.mark.parametrize("kind", ["zoh", "foh"])
def test_fewer_grids_are_as_close_to_state_space_as_was_asked(words, kind, monkeypatch):
    monkeypatch.setattr(step_refinement, "exact_samples", lambda *_: None)
    # The oracle shares no code: SciPy's matrix exponential, exact for inputs that hold or are linear in between.
    rng = np.random.default_rng(3)
    u = np.cumsum(rng.standard_normal(400)) * 0.1
    last, driven = WHOLE[words]
    n = len(last)
    a, b = np.vstack([np.eye(n)[1:], last]), np.zeros((n, 1))
    b[-1] = driven
    t = np.arange(u.size) * 0.02
    exact = lsim((a, b, np.eye(n)[:1], [[0.0]]), u, t, interp=kind == "foh")[1]
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0 * u}, intersample={"u": kind})
    model = ftlm.Model(ftlm.equation(words))
    free = simulate_refined(model, run, {}, tolerance=1e-6)
    assert np.max(np.abs(free.outputs[0] - exact)) <= 1e-6 * np.max(np.abs(exact))
    # One power alone would have taken more pulses to be as close.
    two = [simulate_samples(model, run, every, {})[0][0] for every in (free.refinement, free.refinement // 2)]
    once = (4.0 * two[0] - two[1]) / 3.0
    assert free.refinement <= 16 * FIRST_REFINEMENT
    assert np.max(np.abs(free.outputs[0] - exact)) <= np.max(np.abs(once - exact)) + 1e-9


def test_a_filtered_signal_with_corners_feeds_through_as_it_was_read():
    # D y = -2 y + D w + 3 u, w and y read through the filter, u not: y = w + z, D z = -2 z - 2 w + 3 F u.
    rng = np.random.default_rng(5)
    w, u = (np.concatenate([[0.0], np.cumsum(rng.standard_normal(300))]) for _ in range(2))
    step, t = 0.02, np.arange(301) * 0.02
    omega = 2.0 * np.pi * 2.0
    a = np.array([[0.0, 1.0, 0.0], [-(omega**2), -1.8 * omega, 0.0], [3.0, 0.0, -2.0]])
    b = np.array([[0.0, 0.0], [0.0, omega**2], [-2.0, 0.0]])
    exact = w + lsim((a, b, [[0.0, 0.0, 1.0]], [[0.0, 0.0]]), np.stack([w, u], axis=1), t, interp=True)[1]
    structure = ftlm.equation(
        "D y = -2 y + D w + 3 u", sensor_filter=ftlm.SensorFilter.low_pass(("w", "y")), initial="rest"
    )
    run = ftlm.Run.from_arrays(
        step=step, inputs={"u": u, "w": w}, outputs={"y": 0 * u}, intersample={"u": "foh", "w": "foh"}
    )
    # A mean across a corner is off by a share of the step, which no power of it takes away.
    assert structure.all_filtered
    found = simulate_refined(ftlm.Model(structure), run, {}, tolerance=1e-7)
    assert np.max(np.abs(found.outputs[0] - exact)) <= 1e-6 * np.max(np.abs(exact))
    assert found.refinement <= 32
