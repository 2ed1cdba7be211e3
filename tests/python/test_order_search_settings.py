"""What an order search may be asked: the lattice of its orders, its settings, and what is refused."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import ftlm
from ftlm.order_search.options import SearchSettings
from ftlm.utils.validation import available_threads, check_threads
from small_lattice import EQUATION, GRID, M


@pytest.fixture(scope="module")
def run(small_run, with_noise):
    return with_noise(small_run, 0.003, 1)


# ----------------------------------------------------------------------------------------------------------------------
# What the orders may be


def values(order_grid, text=EQUATION, **options):
    return order_grid.values(ftlm.equation(text, **options))


def test_default_lattice_is_the_papers():
    found = values(ftlm.order_grid())
    assert found["alpha"] == tuple(round(1.05 + 0.05 * i, 9) for i in range(20))
    assert found["beta"] == found["mu"] == found["nu"] == tuple(round(0.05 * i, 9) for i in range(41))
    assert list(found) == ["alpha", "beta", "mu", "nu"]
    assert ftlm.OrderGrid() == ftlm.order_grid()


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (0.3, (0.3,)),
        ((0.1, 0.5), (0.1, 0.3, 0.5)),
        ((0.1, 0.5, 0.4), (0.1, 0.5)),
        ([0.1, 0.5], (0.1, 0.5)),
        ([0.5, 0.1, 0.4], (0.1, 0.4, 0.5)),
        ("0.1:0.3:0.1", (0.1, 0.2, 0.3)),
        ("0.3", (0.3,)),
        (np.array([0.2, 0.1]), (0.1, 0.2)),
    ],
)
def test_axes_of_a_lattice(spec, expected):
    assert values(ftlm.order_grid(increment=0.2, beta=spec))["beta"] == expected


def test_values_of_the_structure_come_before_the_defaults_and_those_of_the_lattice_before_both():
    options = {"orders": {"alpha": "1:2:0.5", "beta": [0.1, 0.2]}}
    found = values(ftlm.order_grid(increment=0.5), **options)
    assert found["alpha"] == (1.0, 1.5, 2.0)
    assert found["beta"] == (0.1, 0.2)
    assert found["mu"] == (0.0, 0.5, 1.0, 1.5, 2.0)
    found = values(ftlm.order_grid(increment=0.5, beta=0.7), **options)
    assert found["beta"] == (0.7,)
    assert values(ftlm.OrderGrid(0.5, orders={"alpha": "1:1.5:0.25"}))["alpha"] == (1.0, 1.25, 1.5)


def test_other_orders_end_at_the_largest_alpha():
    assert values(ftlm.order_grid(increment=0.1, alpha=(0.3, 0.6)))["beta"] == (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    assert values(ftlm.order_grid(increment=0.5), "D^1.2 y = a D^beta y + b u")["beta"] == (0.0, 0.5, 1.0)


def test_candidates_obey_the_ranges_and_are_counted_once(run):
    structure = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b D^nu u", initial="rest")
    order_grid = ftlm.OrderGrid(
        orders={"alpha": [0.5, 1.0], "beta": [0.0, 0.4, 0.5, 0.9, 1.5], "mu": [0.0, 0.4], "nu": [0.7, -0.2, 1.0]}
    )
    found = ftlm.search_orders(run, structure, order_grid, m=M, coefficients="least-squares", top=1000)
    expected = set()
    for alpha in (0.5, 1.0):
        for beta, mu, nu in itertools.product((0.0, 0.4, 0.5, 0.9, 1.5), (0.0, 0.4), (0.7, -0.2, 1.0)):
            if beta == mu or max(beta, mu) >= alpha or nu > alpha:
                continue
            # (0, 0.4) and (0.4, 0) are one candidate: both lie on both axes.
            expected.add((alpha, *(sorted((beta, mu), reverse=True) if {beta, mu} == {0.0, 0.4} else (beta, mu)), nu))
    assert {(r.orders["alpha"], r.orders["beta"], r.orders["mu"], r.orders["nu"]) for r in found.table} == expected
    assert found.candidates == len(expected)


def test_fixed_coefficients_make_own_orders_distinguishable(run):
    orders = {"beta": [0.0, 0.6], "mu": [0.0, 0.6]}
    order_grid = ftlm.OrderGrid(orders=orders)
    free, tied = (
        ftlm.search_orders(
            run,
            ftlm.equation("D^1.6 y = a D^beta y + c D^mu y + b u", fixed=fixed),
            order_grid,
            m=M,
            coefficients="least-squares",
        )
        for fixed in ({}, {"a": -3.0})
    )
    assert free.candidates == 1
    assert tied.candidates == 2
    assert tied.orders == {"beta": 0.6, "mu": 0.0}
    assert tied.coefficients == {"c": pytest.approx(-8, rel=0.1), "b": pytest.approx(5, rel=0.1)}
    assert tied.model.coefficients["a"] == -3.0


def test_orders_on_the_edge_of_their_interval_are_named(run):
    structure = ftlm.equation("D^alpha y = a D^beta y + c y + b u", initial="rest")

    def edges(**orders):
        order_grid = ftlm.order_grid(increment=0.1, **orders)
        found = ftlm.search_orders(run, structure, order_grid, m=256, coefficients="least-squares")
        return found.at_grid_edge, str(found)

    assert edges(alpha=(1.4, 1.8), beta=(0.3, 0.9))[0] == {}
    found, text = edges(alpha=(1.2, 1.6), beta=(0.3, 0.9))
    assert found == {"alpha": 1.6}
    assert "! order alpha = 1.6 is on the edge of its interval; widen it" in text
    assert edges(alpha=(1.4, 1.8), beta=(0.6, 0.9))[0] == {"beta": 0.6}
    # Two values are a question, not an interval.
    assert edges(alpha=(1.5, 1.6), beta=(0.3, 0.9))[0] == {}


def test_alpha_of_two_is_no_edge(clean_a):
    found = ftlm.search_orders(
        clean_a,
        ftlm.flexible_link(form="published").equation("theta12"),
        ftlm.order_grid(increment=0.1, alpha=(1.5, 2.0), gamma2=1.05, mu2=[0.1, 0.85], beta2=[0.1, 0.85]),
        m=512,
        coefficients="least-squares",
    )
    assert found.orders["alpha2"] == 2.0
    assert found.at_grid_edge == {}


# ----------------------------------------------------------------------------------------------------------------------
# Refusals


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"criterion": "error"}, "criterion = 'error' is not known; use 'output-error' or"),
        ({"norm": "l3"}, "norm = 'l3' is not known; use 'l1' or 'l2'"),
        ({"coefficients": "ridge"}, "coefficients = 'ridge' is not known; use 'multi-innovation' or"),
        ({"coefficients": "genetic"}, "coefficients = 'genetic' is not known"),
        ({"row_basis": "fourier"}, "row_basis = 'fourier' is not known; use 'haar' or 'time'"),
        ({"top": 0}, "top = 0 is outside [1, 100000]"),
        ({"top": 100_001}, "top = 100001 is outside"),
        ({"top": 2.5}, "top = 2.5 is outside"),
        ({"top": "all"}, "top = 'all' is outside"),
        ({"threads": 0}, "threads = 0 is outside [1, 1024]"),
        ({"threads": 10_000}, "threads = 10000 is outside [1, 1024]; leave it out to use all cores"),
        ({"threads": 1025}, "threads = 1025 is outside [1, 1024]"),
        ({"threads": True}, "threads = True is outside"),
        ({"threads": float("inf")}, "threads = inf is outside"),
        ({"innovation_length": 0}, "innovation_length = 0 is not a whole number of at least 1"),
        ({"innovation_length": -7}, "innovation_length = -7 is not a whole number of at least 1"),
        ({"innovation_length": "seven"}, "innovation_length = 'seven' is not a whole number of at least 1"),
        ({"prior_covariance": 0}, "prior_covariance = 0 is not positive"),
        ({"prior_covariance": -1.0}, "prior_covariance = -1.0 is not positive"),
        ({"prior_covariance": float("nan")}, "prior_covariance = nan is not positive"),
        ({"prior_covariance": "weak"}, "prior_covariance = 'weak' is not a number"),
        ({"m": 513}, "m = 513 is more than run 'small, simulated"),
        ({"m": 100}, "m = 100 is not a power of two, which Haar rows need; take m = 64 or 128, or row_basis='time'"),
        ({"m": 0}, "m = 0 is not a number of pulses"),
    ],
)
def test_settings_that_mean_nothing_are_refused(run, options, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.search_orders(run, ftlm.equation(EQUATION), ftlm.OrderGrid(orders=GRID), **options)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ftlm.order_grid(increment=0), "order alpha: increment 0 is not positive; the paper's is 0.05"),
        (lambda: ftlm.order_grid(increment=-0.1), "increment -0.1 is not positive"),
        (lambda: ftlm.order_grid(increment="0.1"), "= '0.1' is not a number"),
        (lambda: ftlm.order_grid(alpha=(0, 2)), "alpha interval 0:2 starts outside (0, 10]"),
        (lambda: ftlm.order_grid(alpha=(1, 11)), "order alpha = 11 is outside [-3, 10]"),
        (lambda: ftlm.order_grid(alpha=(2, 1)), "order alpha: interval 2:1 is empty"),
        (lambda: ftlm.order_grid(alpha=2.0), "alpha = 2.0 is not an interval; write (low, high)"),
        (lambda: ftlm.order_grid(alpha=(1, 2, 3)), "alpha = (1, 2, 3) is not an interval"),
        (lambda: ftlm.order_grid(alpha=("1", 2)), "alpha = '1' is not a number"),
        (lambda: values(ftlm.order_grid(beta="x")), "order beta: 'x' is not an interval"),
        (lambda: values(ftlm.order_grid(beta=(2, 1))), "order beta: interval 2:1 is empty"),
        (
            lambda: values(ftlm.order_grid(gama=1)),
            "order 'gama' of order_grid= is not a free order; free are alpha, beta, mu, nu",
        ),
        (
            lambda: values(ftlm.order_grid(beta=1), "D^1.5 y = a y"),
            "order 'beta' of order_grid= is not a free order; free are none",
        ),
        (lambda: values(ftlm.OrderGrid(increment=1e-7)), "has 9.5e+06 values, more than 1000000"),
    ],
)
def test_lattices_that_are_none_are_refused(make, message):
    with pytest.raises(ftlm.ModelError) as refused:
        make()
    assert message in str(refused.value)


TOO_MANY = "candidates, more than the limit of"


@pytest.mark.parametrize(
    ("text", "order_grid", "message"),
    [
        (EQUATION, {"orders": {"alpha": [0.5], "beta": [1.0]}}, "the order grid has no candidate"),
        (EQUATION, {"orders": {"alpha": [0.0]}}, "order alpha = 0 is outside (0, 10]; move the interval of alpha"),
        ("D^alpha y = a D^b y + c D^e y + d D^f y + g D^h y + u", {"increment": 0.002}, TOO_MANY),
        # Refused from the lengths of the axes: to go through them would take minutes.
        (EQUATION, {"increment": 0.001}, TOO_MANY),
        (
            EQUATION,
            {"increment": 1e-4},
            "at 10 ns per candidate, the best case, a search takes 11.7 years on one core;",
        ),
        ("D^alpha y = a D^(alpha+0.1) y + b u", {}, "the order grid has no candidate"),
        ("D^alpha y = a D^(alpha-beta) y + b D^mu u + c D^nu u", {"increment": 0.002}, TOO_MANY),
        ("D^1.5 y = a y + b u", {}, "every order is a number, so there is nothing to search"),
        ("D^alpha y = a y + b u; D^beta z = c z", {}, "one by one: pass .equation('y') or use identify"),
    ],
)
def test_nothing_or_too_much_to_search_is_refused(run, text, order_grid, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.search_orders(run, ftlm.equation(text), ftlm.OrderGrid(**order_grid), m=M, threads=1)
    assert message in str(refused.value)


def test_what_is_no_structure_no_lattice_and_no_run_is_refused(run):
    with pytest.raises(ftlm.ModelError, match="equation is int; give the text of an equation"):
        ftlm.search_orders(run, 3)
    with pytest.raises(ftlm.ModelError, match="order_grid is dict, not an OrderGrid"):
        ftlm.search_orders(run, ftlm.equation(EQUATION), GRID)
    with pytest.raises(ftlm.DataError, match="no run is given"):
        ftlm.search_orders([], ftlm.equation(EQUATION))
    with pytest.raises(ftlm.DataError, match="has no signal 'w', which the model needs"):
        ftlm.search_orders(run, ftlm.equation("D^alpha y = a y + b w"))


def test_a_constant_output_is_refused(run):
    still = ftlm.Run.from_arrays(step=0.1, inputs={"u": run["u"]}, outputs={"y": np.full(513, 2.5)}, name="still")
    said = r"output 'y' of run 'still': constant, every row is 2\.5, first at row 0, 513 in all"
    with pytest.raises(ftlm.DataError, match=said):
        ftlm.search_orders(still, ftlm.equation(EQUATION))


def test_threads():
    assert check_threads(None) == available_threads() >= 1
    assert check_threads(3) == 3
    assert check_threads(np.int64(2)) == 2


def test_settings_state_what_matters_and_nothing_else():
    made = SearchSettings()
    assert made.needs_haar
    assert made.to_dict() == {
        "criterion": "output-error",
        "norm": "l1",
        "coefficients": "multi-innovation",
        "innovation_length": 7,
        "prior_covariance": None,
        "row_basis": "haar",
    }
    plain = replace(made, coefficients="least-squares")
    assert not plain.needs_haar
    assert plain.to_dict() == {"criterion": "output-error", "norm": "l1", "coefficients": "least-squares"}
    assert plain.core_arguments(1)["innovation_length"] == 0
