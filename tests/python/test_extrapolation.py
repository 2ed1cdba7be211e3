"""Extrapolated estimates keep every constraint between orders, and what was fitted becomes a model."""

from __future__ import annotations

import numpy as np
import pytest

import ftlm
from ftlm.estimation.free_parameters import FreeProblem
from measured import DATA, needs_data

#: What stays between the highest order of an equation and those of its own terms.
LEAST_INTEGRATION = 1e-3
WORDS = "D^alpha y = d D^mu y + a y + c D^gamma u + b u"


def holds(problem: FreeProblem, values: np.ndarray) -> bool:
    """Whether orders keep to their bounds and to the highest of their equation, by the model's own checks."""
    orders, _, _ = problem.split(values.tolist())
    if not all(low - 1e-12 <= v <= high + 1e-12 for v, (low, high) in zip(orders, problem.bounds, strict=True)):
        return False
    named = dict(zip(problem.orders, orders, strict=True))
    for item in problem.structure.equations:
        alpha = item.order.at(named)
        for term in item.terms:
            least = LEAST_INTEGRATION - 2e-9 if term.signal == item.output else 0.0
            if alpha - term.order.at(named) < least:
                return False
    return True


def test_the_last_point_of_a_line_is_the_one_that_bisection_finds() -> None:
    problem = FreeProblem.of(ftlm.equation(WORDS))
    rng, shortened = np.random.default_rng(3), 0
    for _ in range(300):
        alpha = rng.uniform(0.5, 2.9)
        at = np.array([alpha, *rng.uniform(0.05, 0.95, 2) * (alpha - 0.01), *rng.standard_normal(4)])
        towards = at + rng.standard_normal(7) * 0.6
        found = problem.feasible_point(at, towards)
        assert holds(problem, found)
        low, high = 0.0, 1.0
        if not holds(problem, towards):
            shortened += 1
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (middle, high) if holds(problem, at + middle * (towards - at)) else (low, middle)
            high = low
        np.testing.assert_allclose(found, at + high * (towards - at), atol=1e-6)
    assert 100 < shortened < 290


def test_a_constraint_that_already_binds_is_followed() -> None:
    problem = FreeProblem.of(ftlm.equation(WORDS))
    at = np.array([1.8, 0.5, 1.8, 0.1, -1.0, 0.2, 0.3])
    towards = at + np.array([-0.02, 0.01, 0.02, 0.05, 0.0, 0.0, 0.0])
    found = problem.feasible_point(at, towards)
    assert holds(problem, found)
    # alpha and gamma stay one; everything else goes where it was going.
    np.testing.assert_allclose(found[[0, 2]], [1.8, 1.8], atol=1e-9)
    np.testing.assert_allclose(found[[1, 3, 4, 5, 6]], towards[[1, 3, 4, 5, 6]], atol=1e-9)


def test_a_bound_that_already_binds_is_kept_alone() -> None:
    problem = FreeProblem.of(ftlm.equation("D^alpha y = a y + b u", orders={"alpha": "0.5:1.5:0.1"}))
    found = problem.feasible_point(np.array([1.5, -1.0, 2.0]), np.array([1.6, -1.1, 2.2]))
    np.testing.assert_allclose(found, [1.5, -1.1, 2.2], rtol=1e-12)


@pytest.mark.slow
@needs_data
def test_the_robot_arm_becomes_a_model() -> None:
    torque, acceleration = np.loadtxt(DATA / "robot_arm" / "robot_arm.dat").T
    run = ftlm.Run.from_arrays(inputs={"u": torque}, outputs={"y": acceleration}, step=1.0)
    found = ftlm.identify(run, ftlm.equation(WORDS))
    assert found.orders["gamma"] <= found.orders["alpha"]
    assert found.orders["mu"] < found.orders["alpha"]
