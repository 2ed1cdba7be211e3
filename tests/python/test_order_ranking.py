"""Order searches say what an identification at their best orders says."""

import json
import math

import numpy as np
import pytest
from scipy.signal import lsim, lti

import ftlm
from ftlm.cli.main import app


def record(seed, noise, *, rows=600, step=0.02, hold=10):
    """Second-order lag under random steps, with noise of some share of the output."""
    g = np.random.default_rng(seed)
    u = np.repeat(g.choice([-1.0, 1.0], rows // hold), hold)
    y = lsim(lti([3.0], [1.0, 2.0, 4.0]), u, np.arange(rows) * step, interp=False)[1]
    y = y + noise * np.std(y) * g.standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, name="lag")


def run_command(*words):
    """Run a command in this process; it must succeed."""
    with pytest.raises(SystemExit) as ended:
        app(list(words))
    assert not ended.value.code


def codes(found):
    return [f.code for f in found.findings]


@pytest.mark.parametrize("method", ["multi-innovation", "least-squares", "instrumental-variables"])
@pytest.mark.parametrize("seed", [21, 22])
def test_rank_1_carries_the_verdict_of_an_identification(seed, method):
    run, equation = record(seed, 0.02), ftlm.equation("D^alpha y = a y + b u")
    grid = ftlm.order_grid(0.1)
    found = ftlm.search_orders(run, equation, grid, coefficients=method)
    kind = {m.name: m for m in (ftlm.MultiInnovation, ftlm.LeastSquares, ftlm.InstrumentalVariables)}[method]
    result = ftlm.identify(run, equation, method=kind(order_grid=grid))
    assert found.verdict == result.verdict
    assert {f.code for f in result.findings} <= set(codes(found)) | {"order_on_edge"}
    assert str(found.verdict) in str(found)


@pytest.mark.parametrize("seed", [31, 32, 33])
def test_noise_decides_where_there_is_nothing_to_find(seed):
    run = record(seed, 0.0)
    noise = np.random.default_rng(seed).standard_normal(run.length)
    run = ftlm.Run.from_arrays(step=run.step, inputs={"u": run["u"]}, outputs={"y": noise})
    found = ftlm.search_orders(run, ftlm.equation("D^alpha y = a y + b u"), ftlm.order_grid(0.1))
    assert "tied_orders_far_apart" in codes(found)
    assert found.verdict.level in ("do not use", "with care")


def test_ranks_are_not_alike_where_the_run_tells_the_order():
    found = ftlm.search_orders(
        record(5, 0.001),
        ftlm.equation("D^alpha y = c D^1 y + a y + b u"),
        ftlm.order_grid(0.1),
        coefficients="least-squares",
    )
    assert not {"tied_orders_far_apart", "tied_orders_close"} & set(codes(found))


def test_rows_that_are_one_model_are_folded_and_counted():
    found = ftlm.search_orders(record(3, 0.01), ftlm.equation("D^alpha y = a D^beta y + b D^gamma u"))
    distinct = found.distinct_rows
    assert len(found.table) == 20
    assert sum(count for _, count in distinct) == 20
    assert len(distinct) <= 4
    said = next(f for f in found.findings if f.code == "table_rows_equivalent")
    assert said.numbers["models"] == len(distinct)
    # Rows of one model differ by one number added to all orders.
    first = distinct[0][0]
    for row in found.table[1 : distinct[0][1]]:
        shifts = [row.orders[n] - first.orders[n] for n in row.orders]
        assert max(shifts) - min(shifts) < 1e-9
    assert str(found).count("\n") < 12
    fixed = ftlm.search_orders(record(3, 0.01), ftlm.equation("D^alpha y = a y + b D^gamma u"))
    assert "table_rows_equivalent" not in codes(fixed)


def test_the_command_prints_verdict_and_next_step(tmp_path, capsys):
    path = tmp_path / "lag.csv"
    record(3, 0.02).to_csv(path)
    words = ["search", str(path), "--structure", "D^alpha y = a y + b u", "--increment", "0.1"]
    store = str(tmp_path / "lag.store")
    run_command(*words, "--store", store)
    text = capsys.readouterr().out
    assert "rank 1: " in text
    assert "next: " in text
    run_command(*words, "--json")
    output = json.loads(capsys.readouterr().out)["y"]
    assert output["verdict"]["level"] in ("do not use", "with care", "trust")
    # A store keeps no runs, so a resumed search says how its rank 1 is judged.
    run_command("resume", store)
    text = capsys.readouterr().out
    assert "rank 1: " not in text
    assert "next: " in text
    assert "judges rank 1" in text


def test_a_certificate_names_a_free_run_that_grows():
    g = np.random.default_rng(8)
    u = np.repeat(g.standard_normal(40), 10)
    # Equation error takes white noise on an integrator's output for a model that grows.
    y = np.cumsum(np.cumsum(g.standard_normal(400))) * 1e-4
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u - u[0]}, outputs={"y": y - y[0]})
    proof = ftlm.certify_orders(run, ftlm.equation("D^alpha y = a D^beta y + b u"), ftlm.order_grid(0.2))
    model = ftlm.identify(
        run,
        ftlm.equation("D^alpha y = a D^beta y + b u").with_orders(proof.orders),
        method="least-squares",
    ).model
    grows = model.stability().unstable_poles > 0
    assert grows or not proof.simulation_nr <= 0.5
    assert [f.code for f in proof.findings] == ["best_orders_unstable" if grows else "best_orders_poor_fit"]
    assert "the model with the best orders" in str(proof) or "the simulation with the best orders" in str(proof)


def test_a_certificate_of_a_good_model_says_nothing_more():
    proof = ftlm.certify_orders(record(4, 0.0), ftlm.equation("D^alpha y = a y + b u"), ftlm.order_grid(0.1))
    assert proof.findings == ()
    assert proof.simulation_nr < 0.5
    assert math.isfinite(proof.to_dict()["simulation_nr"])
