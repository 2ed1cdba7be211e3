"""Warm starts from known values: never a larger cost than from there, in any form in which the values are given."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.estimation.free_parameters import FreeProblem, values_of_model, warm_starts
from plants import noisy_run, resonant_plant, structure

pytestmark = pytest.mark.usefixtures("no_extension_tests")

RICH = "D^alpha y = d D^mu y + a y + b u"


@pytest.fixture(scope="module")
def run():
    return resonant_plant(4, wrong=True)


@pytest.fixture(scope="module")
def simple(run):
    return ftlm.identify(
        run, ftlm.equation("D^2 y = d D y + a y + b u", initial="rest"), method=ftlm.OutputError(intervals="quadratic")
    )


def test_a_simpler_model_says_where_the_richer_one_starts(simple):
    problem = FreeProblem.of(ftlm.equation(RICH, initial="rest"))
    values = values_of_model(problem, simple.model, {})
    assert values == {"alpha": 2.0, "mu": 1.0, **simple.coefficients}
    assert warm_starts(problem, values) == [values]


def test_what_is_not_known_does_nothing_at_first():
    problem = FreeProblem.of(ftlm.equation("D^2 y = d D^mu y + a y + b u + e D^nu y", orders={"mu": (0.5, 1.8, 0.1)}))
    starts = warm_starts(problem, {"a": -2.0, "b": 1.0})
    assert {(s["mu"], s["nu"]) for s in starts} == {(1.0, 0.0), (1.0, 1.0), (1.0, 2.0)}
    assert all((s["a"], s["b"], s["d"], s["e"]) == (-2.0, 1.0, 0.0, 0.0) for s in starts)


def test_a_richer_structure_from_a_simpler_one_is_never_worse(run, simple):
    rich = ftlm.identify(
        run,
        ftlm.equation(RICH, initial="rest"),
        method=ftlm.OutputError(start=simple, intervals="quadratic"),
        threads=1,
    )
    assert rich.joint.noise["y"] <= simple.joint.noise["y"] * (1 + 1e-6)
    from_model = ftlm.identify(
        run,
        ftlm.equation(RICH, initial="rest"),
        method=ftlm.OutputError(start=simple.model, intervals="quadratic"),
        threads=1,
    )
    assert from_model.parameters == rich.parameters


def test_a_start_leads_where_automatic_ones_do_not():
    """A start at the truth beside automatic starts ends at the lowest optimum of both."""
    run = noisy_run("3T", 40, 3)
    truth = {"alpha": 2.2, "nu": 0.9, "a1": -0.625, "a0": -1.25, "b0": 1.25}
    with_start = ftlm.identify(
        run, structure("3T"), method=ftlm.OutputError(start=truth, intervals="quadratic"), threads=1
    )
    alone = ftlm.identify(run, structure("3T"), method=ftlm.OutputError(intervals="quadratic"), threads=1)
    assert with_start.joint.cost <= alone.joint.cost * (1 + 1e-9)
    np.testing.assert_allclose(with_start.joint.values, alone.joint.values, rtol=1e-3)


def test_the_command_takes_a_saved_model(run, simple, tmp_path):
    table = np.column_stack([np.arange(run.length) * run.step, run["u"], run["y"]])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="t,u,y", comments="")
    simple.model.save(tmp_path / "simple.json")
    words = ["identify", str(tmp_path / "run.csv"), "--time", "t", "-u", "u=u", "-y", "y=y", "--structure", RICH]
    more = ["--initial", "rest", "--intervals", "quadratic", "--threads", "1", "--json"]
    done = CliRunner().invoke(app, [*words, *more, "--start", str(tmp_path / "simple.json")])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["output_error"]["y"]["rmse"] <= simple.output_error["y"].rmse * (1 + 1e-3)
    unused = CliRunner().invoke(
        app,
        [
            *words,
            "--method",
            "least-squares",
            "--order-grid",
            "alpha=1.5:2:0.1",
            "--start",
            str(tmp_path / "simple.json"),
        ],
    )
    assert unused.exit_code == 2
    assert "--start is not used by --method least-squares" in unused.output
    wrong = CliRunner().invoke(app, [*words, *more, "--start", str(tmp_path / "none.json")])
    assert wrong.exit_code == 3


def test_words_for_a_start_that_is_none(run, simple):
    rich = ftlm.equation(RICH, initial="rest")
    with pytest.raises(ftlm.ModelError, match="start value 'c' does not occur"):
        ftlm.identify(run, rich, method=ftlm.OutputError(start={"c": 1.0}))
    with pytest.raises(ftlm.ModelError, match="start= names no free parameter; give values of alpha, mu, d, a, b"):
        ftlm.identify(run, rich, method=ftlm.OutputError(start={}))
    with pytest.raises(ftlm.ModelError, match="start= has alpha = 9, out of its bounds"):
        ftlm.identify(run, rich, method=ftlm.OutputError(start={"alpha": 9.0}))
    with pytest.raises(ftlm.ModelError, match="start value of a"):
        ftlm.identify(run, rich, method=ftlm.OutputError(start={"a": "much"}))
    with pytest.raises(ftlm.ModelError, match="start is int; give an identification"):
        ftlm.identify(run, rich, method=ftlm.OutputError(start=3))
    with pytest.raises(TypeError, match="unexpected keyword argument 'start'"):
        ftlm.LeastSquares(start=simple)
    other = ftlm.Model(ftlm.equation("D z = -1.0 z + 1.0 u"))
    with pytest.raises(ftlm.ModelError, match="output of start 'z' does not occur"):
        ftlm.identify(run, rich, method=ftlm.OutputError(start=other))
