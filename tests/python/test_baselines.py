"""The genetic baseline: finds what is there, repeats itself, leaves early without a change, refuses nonsense."""

import random
import sys

import numpy as np
import pytest

import ftlm
from ftlm.estimation import genetic
from ftlm.estimation.genetic import GeneticAlgorithm, genetic_search, polynomial_mutation, simulated_binary_crossover
from ftlm.simulation.discretization import prepare
from ftlm.validation.comparison import compare_means

pytestmark = pytest.mark.usefixtures("no_extension_tests")

EQUATION = "D^alpha y = a D^nu y + c y + b u"
BOUNDS = {"a": (-10.0, 0.0), "c": (-20.0, 0.0), "b": (0.0, 10.0)}
LATTICE = ftlm.order_grid(increment=0.1, alpha=(1.3, 1.9))


@pytest.fixture(scope="module")
def found(small_run):
    return ftlm.identify(
        small_run,
        ftlm.equation(EQUATION),
        method=ftlm.GeneticAlgorithm(
            order_grid=LATTICE, seeds=(0, 1), evaluations=12000, population=100, bounds=BOUNDS
        ),
    )


def test_the_optimum_of_a_clean_run_is_found(found):
    assert found.method == "genetic"
    assert found.fit["y"] > 98
    assert all(BOUNDS[n][0] <= value <= BOUNDS[n][1] for n, value in found.coefficients.items())
    assert found.intervals == {}


def test_the_error_is_that_of_compare_and_of_the_best_seed(found, small_run):
    errors = found.settings["errors"]["y"]
    assert set(errors) == {"0", "1"}
    means = compare_means(found.model, small_run, m=found.settings["m"])
    assert min(errors.values()) == pytest.approx(means.output_error["y"].error, rel=1e-9)
    assert found.model.compare(small_run).output_error["y"] == found.output_error["y"]


def test_what_the_result_depends_on_is_told(found):
    assert found.settings["seeds"] == [0, 1]
    assert found.settings["bounds"]["a"] == [-10.0, 0.0]
    assert found.settings["bounds"]["alpha"] == [1.3, 1.9]
    # The last generation may go a little past what was asked for.
    assert 2 * 12000 <= found.settings["evaluations"]["y"] <= 2 * (12000 + 100)
    assert "seeds 0, 1" in found.details()
    assert "genetic" in str(found.to_dict())


def test_orders_keep_to_their_steps_and_below_alpha(found):
    for value in found.orders.values():
        assert value == pytest.approx(round(value / genetic.ORDER_RESOLUTION) * genetic.ORDER_RESOLUTION, abs=1e-12)
    assert found.orders["nu"] < found.orders["alpha"]


def searched(run, threads=1, **options):
    structure = ftlm.equation(EQUATION)
    given = {"order_grid": LATTICE, "seeds": (3,), "evaluations": 600, "population": 40, "bounds": BOUNDS, **options}
    return genetic_search(
        prepare([run], structure, 256, power_of_two=True), structure, GeneticAlgorithm(**given), threads=threads
    )


def test_equal_seeds_give_equal_results_for_any_number_of_threads_and_touch_no_global_generator(small_run):
    np.random.seed(5)
    random.seed(5)
    before = np.random.get_state()[1].tolist(), random.getstate()
    first = searched(small_run)
    assert first == searched(small_run, threads=3)
    assert (np.random.get_state()[1].tolist(), random.getstate()) == before
    assert searched(small_run, seeds=(4,)).errors != first.errors


def test_leaving_hopeless_candidates_early_changes_nothing(small_run, monkeypatch):
    early = searched(small_run)
    monkeypatch.setattr(genetic._ParentThreshold, "limit", property(lambda self: np.inf))
    assert searched(small_run) == early


def test_as_many_evaluations_as_the_lattice_has_candidates(small_run):
    lattice = ftlm.order_grid(increment=0.25, alpha=(1.25, 2.0))
    candidates = ftlm.search_orders(
        small_run, ftlm.equation(EQUATION), lattice, coefficients="least-squares"
    ).candidates
    reports = []
    structure = ftlm.equation(EQUATION)
    found = genetic_search(
        prepare([small_run], structure, 256, power_of_two=True),
        structure,
        GeneticAlgorithm(order_grid=lattice, seeds=(0,), population=8, bounds=BOUNDS),
        progress=lambda done, total: reports.append((done, total)),
    )
    assert candidates <= found.evaluations[0] <= candidates + 8
    assert reports[-1] == (candidates, candidates)
    assert [done for done, _ in reports] == sorted(done for done, _ in reports)


def test_all_equations_of_a_stage_under_their_order_law(clean_a):
    structure = ftlm.flexible_link(form="published", stage=1, coupling="measured")
    found = ftlm.identify(
        clean_a,
        structure,
        method=ftlm.GeneticAlgorithm(
            order_grid=ftlm.order_grid(alpha=(2.0, 2.0)), seeds=(0,), evaluations=400, population=40
        ),
        m=256,
    )
    assert set(found.orders) == set(structure.order_names)
    law = ftlm.order_law(1, form="published")["beta1"].at(found.orders)
    assert found.model.equations[0].terms[0].order.constant == pytest.approx(law, abs=1e-9)
    assert np.isfinite(found.settings["errors"]["stage"]["0"])
    with pytest.raises(
        ftlm.ModelError, match=r"candidates, too many to evaluate one by one; give GeneticAlgorithm\(evaluations"
    ):
        ftlm.identify(clean_a, structure, method="genetic", m=256)


def test_operators_keep_to_what_they_promise():
    generator = np.random.RandomState(0)
    low, high = np.array([-1.0, 0.0, 5.0]), np.array([1.0, 2.0, 5.0 + 1e-9])
    parents = generator.uniform(low, high, (30, 3))
    children = simulated_binary_crossover(parents, (201, 3), generator)
    assert children.shape == (201, 3)
    # Children spread around their parents without a drift.
    assert np.allclose(children.mean(axis=0), parents.mean(axis=0), atol=0.2)
    moved = polynomial_mutation(children, low, high, generator)
    assert np.all(moved >= low)
    assert np.all(moved <= high)
    assert np.any(moved != children)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"population": 4}, r"population = 4 is out of range; give an integer from 8 to 100000"),
        ({"evaluations": 100}, "evaluations = 100 is less than two generations of 200"),
        ({"seeds": ()}, r"seeds = \(\): give 1 to 1000 whole numbers"),
        ({"seeds": (-1,)}, "give 1 to 1000 whole numbers"),
        ({"seeds": "12"}, "give 1 to 1000 whole numbers"),
        ({"bounds": {"a": (1.0, 0.0)}}, "are not an interval"),
        ({"bounds": {"a": (0.0, np.nan)}}, "are not an interval"),
        ({"bounds": ((0.0, 1.0),)}, "is not a mapping"),
        ({"seeds": 3}, "give 1 to 1000 whole numbers"),
        ({"norm": "l0"}, "norm = 'l0' is not known"),
        ({"order_grid": {"alpha": 1}}, "is dict, not"),
    ],
)
def test_settings_that_mean_nothing_are_refused(options, message):
    with pytest.raises(ftlm.ModelError, match=message):
        GeneticAlgorithm(**options)


def test_what_cannot_be_done_is_said(small_run, monkeypatch):
    structure = ftlm.equation(EQUATION)
    with pytest.raises(ftlm.ModelError, match="bounds of 'q': not a free parameter; free are alpha, nu, a, c, b"):
        ftlm.identify(small_run, structure, method=ftlm.GeneticAlgorithm(bounds={"q": (0, 1)}))
    late = small_run.window(2.0, None)
    with pytest.raises(ftlm.ModelError, match="does not estimate initial terms and needs runs that start at rest"):
        ftlm.identify(late, structure, method=ftlm.GeneticAlgorithm(evaluations=400))
    monkeypatch.setitem(sys.modules, "pygad", None)
    with pytest.raises(ftlm.ModelError, match=r"pip install 'ftlm\[genetic\]'"):
        ftlm.identify(small_run, structure, method=ftlm.GeneticAlgorithm(evaluations=400))
