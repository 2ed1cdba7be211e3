"""Cost surface of a joint fit: its valley follows the covariance, its optimum is the fit, its texts are true."""

from dataclasses import replace

import numpy as np
import pytest

import ftlm
from ftlm.estimation.cost_surface import correlated_orders, output_error_landscape
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective

pytestmark = pytest.mark.usefixtures("no_extension_tests")

WORDS = "D^alpha y = a D^nu y + c y + b u"


@pytest.fixture(scope="module")
def fit(small_run, with_noise):
    return ftlm.identify(with_noise(small_run, 0.02, 1), ftlm.equation(WORDS))


def form(fit, landscape):
    """The quadratic form of both orders' covariance over the landscape's points."""
    at = [fit.joint.names.index(n) for n in landscape.names]
    spread = fit.joint.covariance[np.ix_(at, at)]
    x, y = np.meshgrid(landscape.x - landscape.x.mean(), landscape.y - landscape.y.mean())
    moved = np.stack([x.ravel(), y.ravel()])
    return np.einsum("ki,kl,li->i", moved, np.linalg.inv(spread), moved).reshape(x.shape)


def test_refitted_the_cost_is_that_of_the_covariance(fit):
    found = output_error_landscape(fit)
    assert set(found.names) == {"alpha", "nu"}
    centre = found.scores.shape[0] // 2
    assert found.scores[centre, centre] == pytest.approx(found.scores.min(), abs=0.1)
    assert found.scores.min() == pytest.approx(1.0, abs=1e-6)
    wanted = 1.0 + form(fit, found)
    near = wanted < 10
    assert near.sum() > 8
    # The form holds in the small; four standard errors of this noise are not small everywhere.
    ratio = found.scores[near] / wanted[near]
    assert np.all((ratio > 0.4) & (ratio < 2.5))
    assert np.corrcoef(np.log(found.scores.ravel()), np.log(wanted.ravel()))[0, 1] > 0.9
    assert found.other_orders_note.startswith("All other parameters are refitted")


def test_costs_are_those_of_residuals_after_a_linear_step(fit):
    found = output_error_landscape(fit)
    joint, task = fit.joint, fit.task
    problem = FreeProblem.of(replace(task.structure, initial=joint.initial))
    weights = [1.0 / joint.noise[o] for o in task.structure.outputs]
    grid = Objective(problem, task.runs, weights, joint.refinement)

    def at(values, evaluations):
        orders, coefficients, inputs = problem.split(values.tolist())
        return grid.minimize(Iterate(orders, coefficients, "", {}, inputs), evaluations, linear_scale=True)

    best = at(joint.values, 20)
    pair = [problem.names.index(n) for n in found.names]
    others = np.delete(best.outcome["jacobian"], pair, axis=0).T
    for row, column in ((0, 0), (3, 8), (10, 5)):
        values = best.values
        values[pair] = found.x[column], found.y[row]
        residuals = at(values, 1).outcome["residuals"]
        step = np.linalg.lstsq(others, residuals, rcond=None)[0]
        cost = np.sum((residuals - others @ step) ** 2)
        wanted = found.scores[row, column] - found.scores.min()
        center = np.sum(best.outcome["residuals"] ** 2)
        assert cost - center == pytest.approx(wanted, rel=1e-5, abs=1e-4 * center)


def test_held_the_cost_is_never_lower(fit):
    refitted, held = (output_error_landscape(fit, refit=r) for r in (True, False))
    assert np.all(held.scores >= refitted.scores - 0.5)
    assert held.scores.max() > 2 * refitted.scores.max()
    assert "fixed at the optimum" in held.other_orders_note


def test_the_pair_least_told_apart_is_named(fit):
    first, second, correlation = correlated_orders(fit)
    assert (first, second) == ("alpha", "nu")
    assert correlation == pytest.approx(fit.joint.correlation[0, 1])
    drawn = output_error_landscape(fit)
    assert "All other parameters are refitted" in drawn.caption
    assert "increase of the weighted sum of squares" in drawn.caption


def test_the_report_shows_it_and_says_what_it_is(fit, tmp_path):
    text = fit.report(tmp_path / "fit.html").read_text()
    assert "Order landscape" in text
    assert "orders with the most correlated estimates are α and" in text


def test_without_two_orders_or_errors_there_is_none(fit, small_run, with_noise):
    run = with_noise(small_run, 0.02, 1)
    one = ftlm.identify(run, ftlm.equation("D^alpha y = a D^0.6 y + c y + b u"))
    assert correlated_orders(one) is None
    assert output_error_landscape(one) is None
    unknown = replace(fit, joint=replace(fit.joint, covariance=np.full_like(fit.joint.covariance, np.nan)))
    assert output_error_landscape(unknown) is None
    searched = ftlm.identify(run, ftlm.equation("D^1.6 y = a D^0.6 y + c y + b u"), method="least-squares")
    assert output_error_landscape(searched) is None
    with pytest.raises(ftlm.ModelError, match="needs two different free orders; this fit has alpha, nu"):
        output_error_landscape(fit, ("alpha", "mu"))


def test_matplotlib_draws_it_too(fit):
    figure = ftlm.plot.landscape(fit)
    assert "increase of the weighted sum of squares" in figure.axes[1].get_ylabel().replace("\n", " ")
