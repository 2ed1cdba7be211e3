"""Certificates over all orders of intervals: nothing between the values of a lattice does better than is proved."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.errors import ModelError

WORDS = "D^alpha y = a D^beta y + c y + b u"
LATTICE = ftlm.order_grid(increment=0.1, alpha=(1.3, 1.8), beta=(0.5, 0.9))


@pytest.fixture(scope="module")
def run():
    u = np.where(np.arange(401) % 130 < 70, 1.0, -0.6)
    blank = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": np.zeros(401)}, name="machine")
    y = ftlm.Model(ftlm.equation("D^1.63 y = -3 D^0.72 y - 8 y + 5 u")).simulate(blank)["y"]
    noise = 0.01 * np.random.default_rng(3).standard_normal(401)
    return ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y + noise}, name="machine")


@pytest.fixture(scope="module")
def equation():
    return ftlm.equation(WORDS, initial="rest")


@pytest.fixture(scope="module")
def proved(run, equation):
    return ftlm.certify_orders(run, equation, LATTICE, tolerance=0.05, m=128)


def rmse(run, equation, alpha, beta):
    """Of the search itself, at one candidate."""
    return ftlm.search_orders(
        run,
        equation,
        ftlm.OrderGrid(orders={"alpha": [alpha], "beta": [beta]}),
        criterion="equation-error",
        norm="l2",
        coefficients="least-squares",
        m=128,
    ).score


def test_no_search_between_the_values_of_the_lattice_does_better(run, equation, proved):
    assert proved.open_cells == 0
    assert 0.95 * proved.best * (1 - 1e-6) <= proved.lower_bound <= proved.best
    assert proved.proved_tolerance <= 0.05 + 1e-6
    assert rmse(run, equation, *proved.orders.values()) == pytest.approx(proved.best, rel=1e-6)
    fine: dict = {"alpha": "1.3:1.798:0.003", "beta": "0.5:0.899:0.003"}
    found = ftlm.search_orders(
        run,
        equation,
        ftlm.OrderGrid(orders=fine),
        criterion="equation-error",
        norm="l2",
        coefficients="least-squares",
        m=128,
    )
    assert proved.lower_bound <= found.score
    assert proved.best <= found.score * 1.01
    assert set(proved.orders) == {"alpha", "beta"}
    assert proved.intervals == {"alpha": (1.3, 1.8), "beta": (0.5, 0.9)}


def test_the_best_may_stand_on_an_edge(run, equation):
    """Where no middle of a box is."""
    edge = ftlm.order_grid(increment=0.1, alpha=(1.3, 1.5), beta=(0.85, 0.9))
    found = ftlm.certify_orders(run, equation, edge, tolerance=0.05, m=128)
    assert found.orders["alpha"] in (1.3, 1.5) or found.orders["beta"] in (0.85, 0.9)
    order_grid = ftlm.search_orders(
        run, equation, edge, criterion="equation-error", norm="l2", coefficients="least-squares", m=128
    )
    assert found.lower_bound <= order_grid.score
    assert found.best <= order_grid.score * (1 + 1e-9)
    # Cells that an interval only touches have bounds of their own.
    assert found.open_cells == 0
    assert found.proved_tolerance <= 0.05 + 1e-6


def test_several_runs_of_their_own_steps_and_threads(run, equation, proved):
    again = ftlm.certify_orders(run, equation, LATTICE, tolerance=0.05, m=128, threads=1)
    assert again == proved
    twice = ftlm.certify_orders([run, run.window(1.0, 5.0)], equation, LATTICE, tolerance=0.2, m=128)
    assert 0 < twice.lower_bound <= twice.best


def test_it_says_in_words_what_is_proved_and_what_is_not(run, equation, proved):
    text = str(proved)
    assert "no orders with alpha from 1.3 to 1.8, beta from 0.5 to 0.9" in text
    assert "on the order grid or between" in text
    assert f"{proved.cells} boxes" in text
    assert "asked" not in text
    cut = ftlm.certify_orders(run, equation, LATTICE, tolerance=0.05, m=128, max_cells=proved.cells - 1)
    assert cut.open_cells > 0
    assert "was asked for" in str(cut) or "nothing is proved" in str(cut)
    nothing = replace(proved, lower_bound=0.0, open_cells=7)
    assert nothing.proved_tolerance == 1
    assert "nothing is proved" in str(nothing)
    document = json.loads(json.dumps(proved.to_dict()))
    assert document["lower_bound"] == proved.lower_bound
    assert document["orders"] == proved.orders
    # A share that is said is rounded up.
    assert "by more than 5.1 %" in str(replace(proved, lower_bound=0.9495, best=1.0))


@pytest.mark.parametrize(
    ("words", "options", "said"),
    [
        ("D^alpha y = a D^beta y + 3 u", {}, "requires free coefficients, but the equation of y has 1 fixed one"),
        (WORDS, {"tolerance": 0}, "tolerance=0"),
        (WORDS, {"tolerance": "much"}, "tolerance"),
        (WORDS, {"tolerance": float("nan")}, "tolerance"),
        (WORDS, {"min_separation": 0.0}, "min_separation = 0"),
        (WORDS, {"min_separation": -1}, "min_separation = -1"),
        (WORDS, {"max_cells": 0}, "cells = 0"),
        (WORDS, {"max_cells": 1.5}, "cells = 1.5"),
        (WORDS, {"max_cells": 2}, "allow more"),
        (WORDS, {"max_term_ratio": 0.1}, "max_term_ratio"),
        (WORDS, {"order_grid": "fine"}, "order_grid"),
        (WORDS, {"threads": 0}, "threads"),
        (WORDS, {"order_grid": ftlm.order_grid(alpha=(0.5, 0.6), beta=(0.58, 0.7))}, "no orders in these intervals"),
    ],
)
def test_what_cannot_be_had_is_said(run, words, options, said):
    given = {"order_grid": LATTICE, "m": 128} | options
    if "3 u" in words and "order_grid" not in options:
        given["order_grid"] = ftlm.order_grid(increment=0.1, alpha=(1.05, 2.0))
    with pytest.raises(ModelError, match=said):
        ftlm.certify_orders(run, ftlm.equation(words, initial="rest"), **given)


def test_neither_initial_terms_nor_stages_under_a_law_have_one(run):
    with pytest.raises(ModelError, match="initial terms"):
        ftlm.certify_orders(run, ftlm.equation(WORDS, initial="caputo"), LATTICE, m=128)


@pytest.fixture(scope="module")
def csv(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("certificate") / "machine.csv"
    table = np.column_stack([0.02 * np.arange(401), run["u"], run["y"]])
    np.savetxt(path, table, delimiter=",", header="t,u,y", comments="")
    return path


def test_the_command_line_proves_it_for_each_equation(csv, proved):
    words = ["certify", str(csv), "--structure", WORDS, "-u", "u", "-y", "y", "--initial", "rest", "--m", "128"]
    words += ["--increment", "0.1", "--order-grid", "alpha=1.3:1.8:0.1", "--order-grid", "beta=0.5:0.9:0.1"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "certificate: no orders with alpha from 1.3 to 1.8" in result.output
    result = CliRunner().invoke(app, [*words, "--tolerance", "0.05", "--json"])
    assert json.loads(result.output)["y"]["lower_bound"] == pytest.approx(proved.lower_bound, rel=1e-3)
    for options, said in [
        (["--tolerance", "5"], "--tolerance 5.0 is outside"),
        (["--min-separation", "0"], "--min-separation 0.0 is outside"),
        (["--max-cells", "0"], "--max-cells 0 is not a whole number"),
        (["--initial", "caputo"], "--initial rest"),
        (["--order-grid", "gamma=1:2:0.1"], "--order-grid 'gamma' is not a free order"),
    ]:
        at = words.index("--initial")
        kept = [*words[:at], *words[at + 2 :]] if options[0] == "--initial" else words
        refused = CliRunner().invoke(app, [*kept, *options])
        assert refused.exit_code == 2, options
        assert said in refused.stderr


def test_given_tuples_are_scored_and_told_apart(run, equation, proved):
    worse = {name: low for name, (low, _) in proved.intervals.items()} | {"alpha": proved.intervals["alpha"][1]}
    found = ftlm.certify_orders(run, equation, LATTICE, tolerance=0.05, m=128, start=[proved.orders, worse])
    assert found.lower_bound == proved.lower_bound
    assert found.start_errors[0] == pytest.approx(proved.best, rel=1e-6)
    assert found.start_errors[1] > found.start_errors[0]
    assert found.beatable == (False, True)
    assert "start 1: " in str(found)
    assert "other orders may have a smaller error" in str(found)
    assert found.to_dict()["beatable"] == [False, True]
    both = ftlm.equation("D^alpha y = a D^beta y + b D^gamma y + c u", initial="rest")
    grid = ftlm.OrderGrid(
        increment=0.1, alpha=(1.4, 1.5, 0.1), orders={"beta": (0.2, 0.4, 0.1), "gamma": (0.2, 0.4, 0.1)}
    )
    dependent = {"alpha": 1.4, "beta": 0.3, "gamma": 0.3}
    twice = ftlm.certify_orders(run, both, grid, tolerance=0.5, m=128, start=[dependent])
    assert twice.start_errors == (math.inf,)
    for bad in ({"alpha": 1.0}, {**proved.orders, "alpha": 5.0}):
        with pytest.raises(ftlm.ModelError, match=r"start 1 of 2 is .*; give alpha from "):
            ftlm.certify_orders(run, equation, LATTICE, m=128, start=[proved.orders, bad])
