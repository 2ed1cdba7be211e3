"""Order searches against enumeration in NumPy; one table for any number of threads, counted to the last candidate."""

import io
import itertools
import json
import os
import signal
import subprocess
import sys
from math import gamma

import numpy as np
import pytest

import ftlm
import ftlm.progress
import oracles
from ftlm import _core
from ftlm.validation.comparison import compare_means
from slow_cases import slow_after
from small_lattice import EQUATION, GRID, M


@pytest.fixture(scope="module")
def run(small_run, with_noise):
    return with_noise(small_run, 0.003, 1)


@pytest.fixture(scope="module")
def second(small_model, with_noise):
    """Another run of the same machine, of another length and step, under another input."""
    n = 301
    u = np.sin(np.arange(n) ** 1.3 / 20)
    empty = ftlm.Run.from_arrays(step=0.03, inputs={"u": u}, outputs={"y": np.zeros(n)}, units={"u": "A", "y": "rad"})
    return with_noise(small_model.simulate(empty, tolerance=1e-6), 0.003, 2)


# ----------------------------------------------------------------------------------------------------------------------
# An oracle: every candidate to its end, by dense matrices


def candidates(grid):
    """Orders in the lattice's order: alpha ascending, then the own pair, then the input's; larger own order first."""
    for alpha in grid["alpha"]:
        own = sorted({*grid["beta"]}, reverse=True)
        pairs = [(b, m) for b in own for m in own if b > m and b < alpha]
        for (beta, mu), nu in itertools.product(pairs, sorted(grid["nu"], reverse=True)):
            yield {"alpha": alpha, "beta": beta, "mu": mu, "nu": nu}


class Record:
    def __init__(self, run, m=M):
        self.duration = run.duration
        self.y, self.u = (oracles.pulse_means(run[n], m, how) for n, how in (("y", "foh"), ("u", "zoh")))
        self.m = m

    def regressors(self, o):
        return oracles.regressors(
            [self.y, self.y, self.u], [o["beta"], o["mu"], o["nu"]], o["alpha"], self.duration, haar=False
        )

    def powers(self, exponents):
        edges = np.arange(self.m + 1) * self.duration / self.m
        means = [np.diff(edges ** (e + 1)) / (e + 1) / (self.duration / self.m) for e in exponents]
        return np.stack(means, axis=1) if means else np.zeros((self.m, 0))


def evaluate(records, o, criterion, norm, coefficients, row_basis, exponents=(), p=7, k0=None):
    """Score and coefficients of one candidate."""
    blocks, targets, weights = [], [], []
    for i, r in enumerate(records):
        others = [np.zeros((r.m, len(exponents))) for _ in records]
        others[i] = r.powers(exponents)
        q = np.hstack([r.regressors(o), *others])
        phi = oracles.haar_matrix(r.m) if row_basis == "haar" else np.eye(r.m)
        blocks.append(phi @ q)
        targets.append(phi @ r.y)
        weights.append([min(p, r.m - k) for k in range(r.m)])
    q, y, w = np.vstack(blocks), np.concatenate(targets), np.concatenate(weights)
    if coefficients == "least-squares":
        x = oracles.least_squares(q, y)
    else:
        prior = np.sum(q**2, axis=0) / 1e10 if k0 is None else np.full(q.shape[1], 1 / k0)
        x = np.linalg.solve(q.T @ (w[:, None] * q) + np.diag(prior), q.T @ (w * y))
    raw, points = 0.0, 0
    for i, r in enumerate(records):
        initial = r.powers(exponents) @ x[3 + i * len(exponents) : 3 + (i + 1) * len(exponents)]
        if criterion == "equation-error":
            e = r.y - r.regressors(o) @ x[:3] - initial
        else:
            own = [(x[0], o["beta"]), (x[1], o["mu"])]
            free = oracles.free_run(own, [(x[2], o["nu"], r.u)], o["alpha"], r.m, r.duration, initial=initial)
            e = r.y - free
        raw += np.sum(np.abs(e)) if norm == "l1" else np.sum(e**2)
        points += r.m
    return (raw if norm == "l1" else np.sqrt(raw / points)), x[:3]


def enumerate_all(records, **options):
    rows = []
    for index, o in enumerate(candidates(GRID)):
        score, x = evaluate(records, o, **options)
        rows.append((score, index, o, x))
    return sorted(rows, key=lambda row: row[:2])


def assert_is_table(found, expected, *, rtol=1e-7):
    assert found.candidates == len(expected)
    for row, (score, index, orders, x) in zip(found.table, expected, strict=False):
        assert (row.index, row.orders) == (index, orders)
        assert row.score == pytest.approx(score, rel=rtol)
        assert [row.coefficients[n] for n in "acb"] == pytest.approx(list(x), rel=1e-4)
    assert [row.rank for row in found.table] == list(range(1, len(found.table) + 1))


def search(runs, **options):
    return ftlm.search_orders(
        runs, ftlm.equation(EQUATION, initial="rest"), ftlm.OrderGrid(orders=GRID), m=M, **options
    )


@pytest.mark.parametrize("criterion", ["output-error", "equation-error"])
@pytest.mark.parametrize("norm", ["l1", "l2"])
@pytest.mark.parametrize(
    ("coefficients", "rows"), [("least-squares", "time"), ("multi-innovation", "haar"), ("multi-innovation", "time")]
)
def test_table_is_that_of_enumeration(run, criterion, norm, coefficients, rows):
    options = {"criterion": criterion, "norm": norm, "coefficients": coefficients}
    weighted = {"row_basis": rows} if coefficients == "multi-innovation" else {}
    found = search(run, top=10, **options, **weighted)
    assert len(found.table) == 10
    assert_is_table(found, enumerate_all([Record(run)], row_basis=rows, **options))


@pytest.mark.parametrize(("p", "k0"), [(1, 0.01), (3, 100.0), (200, 1e6)])
def test_innovation_length_and_prior_are_those_asked_for(run, p, k0):
    options = {"criterion": "output-error", "norm": "l1", "coefficients": "multi-innovation"}
    found = search(run, innovation_length=p, prior_covariance=k0, **options)
    assert_is_table(found, enumerate_all([Record(run)], p=p, k0=k0, row_basis="haar", **options))
    assert found.settings["innovation_length"] == p
    assert found.settings["prior_covariance"] == k0


@pytest.mark.parametrize(("of_y", "of_u"), [(1e3, 1.0), (1e-3, 1.0), (1.0, 1e3), (180 / np.pi, 1e-3)])
def test_units_of_signals_change_no_order_under_the_default_prior(run, of_y, of_u):
    scaled = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": of_u * run["u"]}, outputs={"y": of_y * run["y"]}, name=run.name
    )
    found, expected = search(scaled), search(run)
    for row, other in zip(found.table, expected.table, strict=True):
        assert row.orders == other.orders
        assert row.score == pytest.approx(of_y * other.score, rel=1e-9)
        for name, value in other.coefficients.items():
            assert row.coefficients[name] == pytest.approx(value * (of_y / of_u if name == "b" else 1.0), rel=1e-6)


@pytest.mark.parametrize("norm", ["l1", "l2"])
@pytest.mark.parametrize("coefficients", ["least-squares", "multi-innovation"])
def test_several_runs_are_one_fit(run, second, norm, coefficients):
    options = {"criterion": "output-error", "norm": norm, "coefficients": coefficients}
    found = search([run, second], **options)
    assert_is_table(found, enumerate_all([Record(run), Record(second)], row_basis="haar", **options))
    assert found.model.about["runs"] == f"{run.name}, {second.name}"
    assert found.table != search(run, **options).table


def test_initial_terms_belong_to_each_run(run, second):
    moved = [r.window(2.0, None) for r in (run, second)]
    options = {"criterion": "output-error", "norm": "l2", "coefficients": "least-squares"}
    structure = ftlm.equation(EQUATION, initial=(0.0, 1.0))
    found = ftlm.search_orders(moved, structure, ftlm.OrderGrid(orders=GRID), m=M, **options)
    expected = enumerate_all([Record(r) for r in moved], row_basis="time", exponents=(0.0, 1.0), **options)
    assert_is_table(found, expected, rtol=1e-6)


def test_power_means_of_the_oracle_are_those_of_a_power():
    # The oracle above builds initial terms itself: its first pulse has the closed form h^e/(e + 1).
    record = Record(ftlm.Run.from_arrays(step=0.1, inputs={"u": np.zeros(65)}, outputs={"y": np.arange(65.0)}))
    np.testing.assert_allclose(record.powers((0.5,))[0, 0], 0.1**0.5 / 1.5)
    assert gamma(2.5) == pytest.approx(0.75 * np.sqrt(np.pi))


# ----------------------------------------------------------------------------------------------------------------------
# The same for everybody


def exactly(found):
    return [(r.rank, r.index, r.score, r.orders, r.coefficients) for r in found.table]


@pytest.mark.parametrize("criterion", ["output-error", "equation-error"])
@pytest.mark.parametrize("coefficients", ["least-squares", "multi-innovation"])
def test_threads_and_early_stopping_change_no_bit_of_the_table(run, second, criterion, coefficients):
    structure = ftlm.equation(EQUATION)
    order_grid = ftlm.order_grid(increment=0.1, alpha=(1.3, 1.9), nu=(0, 0.3))
    options = {"criterion": criterion, "coefficients": coefficients, "m": 128, "top": 7}
    brute = ftlm.search_orders([run, second], structure, order_grid, threads=1, pruning=False, **options)
    assert brute.candidates == sum(n * (n - 1) // 2 * 4 for n in range(13, 20))
    assert brute.exclusion_counts["stopped early"] == 0
    counts = set()
    for threads, stopping in itertools.product((1, 3), (True, False)):
        found = ftlm.search_orders([run, second], structure, order_grid, threads=threads, pruning=stopping, **options)
        assert exactly(found) == exactly(brute), (threads, stopping)
        assert sum(found.exclusion_counts.values()) + len(found.table) == found.candidates
        if stopping:
            counts.add(tuple(found.exclusion_counts.items()))
            assert found.exclusion_counts["stopped early"] > 0
        else:
            assert found.exclusion_counts == brute.exclusion_counts
    assert len(counts) == 1  # what became of the candidates does not depend on threads either


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("stopping", [True, False])
def test_threads_and_early_stopping_change_no_bit_of_a_stage(drive, plant, with_noise, threads, stopping):
    found = stage_search(drive, plant, with_noise, threads=threads, pruning=stopping)
    alone = stage_search(drive, plant, with_noise, threads=1, pruning=False)
    assert exactly(found) == exactly(alone)
    assert sum(found.exclusion_counts.values()) + len(found.table) == found.candidates == alone.candidates


def test_keeping_more_rows_only_makes_the_table_longer(run):
    few, many, all_rows = (search(run, top=top, coefficients="least-squares") for top in (1, 10, 1000))
    assert exactly(many)[:1] == exactly(few)
    assert exactly(all_rows)[:10] == exactly(many)
    assert len(all_rows.table) == all_rows.candidates == 36
    assert sum(all_rows.exclusion_counts.values()) == 0


# ----------------------------------------------------------------------------------------------------------------------
# A stage under its law

STAGE = {
    "alpha1": [1.9, 2.0],
    "alpha2": [1.9, 2.0],
    "gamma1": [0.85, 0.95, 1.05],
    "beta2": [0.0, 0.1, 0.2],
    "mu2": [0.75, 0.85, 0.95],
}


def stage_search(drive, plant, with_noise, **options):
    made = plant("A").simulate(drive("A", samples=601), tolerance=1e-5)
    noisy = with_noise(made, 1e-5, 3)
    settings = {"coefficients": "least-squares", "m": M, "top": 12} | options
    return ftlm.search_orders(noisy, ftlm.flexible_link(form="published"), ftlm.OrderGrid(orders=STAGE), **settings)


def makes_equations(orders):
    """Whether the law keeps own orders in [0, alpha), the other angle's in [0, alpha], and those of a signal apart."""
    law = {name: order.at(orders) for name, order in ftlm.order_law(1, form="published").items()}
    hub = 0 <= law["gamma1"] < law["alpha1"] and all(0 <= law[n] <= law["alpha1"] for n in ("beta1", "mu1"))
    deflection = all(0 <= law[n] < law["alpha2"] for n in ("beta2", "mu2")) and 0 <= law["gamma2"] <= law["alpha2"]
    return hub and deflection and law["beta1"] != law["mu1"] and law["beta2"] != law["mu2"]


def stage_scores(run, orders, criterion, norm):
    """Score of a tuple of free orders by dense matrices, and its coefficients."""
    structure = ftlm.flexible_link(form="published").with_orders(orders)
    names = ("theta11", "theta12", "I1")
    means = {n: oracles.pulse_means(run[n], M, "zoh" if n == "I1" else "foh") for n in names}
    total = 0.0
    coefficients = {}
    for item in structure.equations:
        y, alpha = means[item.output], item.order.constant
        terms = [(t.signal, t.order.constant, t.coefficient) for t in item.terms]
        q = oracles.regressors(
            [means[s] for s, _, _ in terms], [o for _, o, _ in terms], alpha, run.duration, haar=False
        )
        # Columns differ by orders of magnitude; the core scales them too.
        size = np.linalg.norm(q, axis=0)
        x = oracles.least_squares(q / size, y) / size
        coefficients |= dict(zip([c for _, _, c in terms], x, strict=True))
        if criterion == "equation-error":
            e = y - q @ x
        else:
            own = [(c, o) for c, (s, o, _) in zip(x, terms, strict=True) if s == item.output]
            others = [(c, o, means[s]) for c, (s, o, _) in zip(x, terms, strict=True) if s != item.output]
            e = y - oracles.free_run(own, others, alpha, M, run.duration)
        if norm == "l1":
            total += np.sum(np.abs(e)) / (np.std(y) * M)
        else:
            total += np.sqrt(np.mean(e**2)) / np.std(y)
    return total, coefficients


@slow_after(1, "criterion, norm", [("output-error", "l1"), ("output-error", "l2"), ("equation-error", "l2")])
def test_stage_under_its_law_is_enumeration(drive, plant, with_noise, criterion, norm):
    found = stage_search(drive, plant, with_noise, criterion=criterion, norm=norm)
    made = with_noise(plant("A").simulate(drive("A", samples=601), tolerance=1e-5), 1e-5, 3)
    expected = []
    names = list(found.orders)
    for values in itertools.product(*(sorted(STAGE[n]) for n in names)):
        orders = dict(zip(names, values, strict=True))
        if makes_equations(orders):
            expected.append((*stage_scores(made, orders, criterion, norm), orders))
    assert found.candidates == len(expected) < 108
    expected.sort(key=lambda row: row[0])
    for row, (score, coefficients, orders) in zip(found.table, expected, strict=False):
        assert row.score == pytest.approx(score, rel=1e-5)
        assert row.orders == orders
        assert row.coefficients == {n: pytest.approx(v, rel=1e-3, abs=1e-6) for n, v in coefficients.items()}


def test_failures_under_a_law_are_listed_with_their_reason(run):
    # The same current twice: where the law gives both terms one order they cannot be told apart.
    twice = ftlm.Run.from_arrays(step=run.step, inputs={"u": run["u"], "v": run["u"]}, outputs={"y": run["y"]})
    structure = ftlm.equation("D^alpha y = a D^(alpha-1) y + b u + c D^(alpha-1.5) v", initial="rest")
    order_grid = ftlm.order_grid(increment=0.1, alpha=(1.3, 1.7))
    for threads in (1, 2):
        found = ftlm.search_orders(twice, structure, order_grid, m=M, coefficients="least-squares", threads=threads)
        assert found.failures == [({"alpha": 1.5}, "singular")]
        assert found.exclusion_counts["singular"] == 1
        assert sum(found.exclusion_counts.values()) + len(found.table) == found.candidates == 5


def test_an_empty_lattice_names_its_signal(run):
    with pytest.raises(ftlm.ModelError, match=r"no orders of signal 'y' fit below alpha = 0\.5"):
        search_empty(run)


def search_empty(run):
    order_grid = ftlm.OrderGrid(orders={"alpha": [0.5], "beta": [1.0], "mu": [1.1]})
    return ftlm.search_orders(run, ftlm.equation(EQUATION), order_grid, m=M)


def test_progress_shows_rate_share_pruned_and_time_left(monkeypatch, run):
    shown = io.StringIO()
    shown.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setattr("ftlm.progress.BAR_DELAY_S", 0.0)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    with ftlm.progress.Progress("searching") as bar:
        bar(250, 1000, 200)
        bar(500, 1000, 499)
    text = shown.getvalue()
    assert "searching" in text
    assert "50 % of 1,000" in text
    assert "99.8 % pruned" in text
    assert "/s" in text
    # Somebody else's function is told two numbers, as ever.
    reports = []
    search(run, progress=lambda done, total: reports.append((done, total)))
    assert reports[-1] == (36, 36)


def test_one_equation_under_a_law_is_searched_too(run):
    # D^(alpha - 1) in place of a free order: the same scores as the free search at those orders.
    structure = ftlm.equation("D^alpha y = a D^(alpha-1) y + c y + b u", initial="rest")
    found = ftlm.search_orders(
        run, structure, ftlm.order_grid(increment=0.2, alpha=(1.2, 2.0)), m=M, coefficients="least-squares"
    )
    assert found.candidates == 5
    for row in found.table:
        fixed = {"alpha": row.orders["alpha"], "beta": row.orders["alpha"] - 1, "mu": 0.0, "nu": 0.0}
        score, _ = evaluate([Record(run)], fixed, "output-error", "l1", "least-squares", "time")
        # Each equation's score is divided by its scale, sigma(y) M.
        assert row.score == pytest.approx(score / (np.std(Record(run).y) * M), rel=1e-8)


# ----------------------------------------------------------------------------------------------------------------------
# Candidates without a score


def test_dependent_regressors_are_a_reason_on_the_row(run):
    twice = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": run["u"], "v": 2 * run["u"]}, outputs={"y": run["y"]}, name="twice"
    )
    structure = ftlm.equation("D^1.6 y = a D^beta y + c y + b u + d D^nu v", initial="rest")
    order_grid = ftlm.OrderGrid(orders={"beta": [0.4, 0.6], "nu": [0.0, 0.3]})
    found = ftlm.search_orders(twice, structure, order_grid, m=M, coefficients="least-squares")
    assert found.candidates == 4
    assert found.exclusion_counts["singular"] == 2
    assert found.failures == [({"beta": b, "nu": 0.0}, "singular") for b in (0.6, 0.4)]
    assert {r.orders["nu"] for r in found.table} == {0.3}
    # A prior tells them apart.
    assert ftlm.search_orders(twice, structure, order_grid, m=M).exclusion_counts["singular"] == 0
    with pytest.raises(ftlm.ModelError, match="none of 2 candidates has a finite score"):
        ftlm.search_orders(
            twice,
            structure.with_orders({"nu": 0.0}),
            ftlm.OrderGrid(orders={"beta": [0.4, 0.6]}),
            m=M,
            coefficients="least-squares",
        )


def test_diverging_candidates_are_a_reason_on_the_row():
    # Growth rates 5^(1/alpha) over 200 s: 7.5 and 5 leave the range of numbers, 1.7 does not.
    n = 2001
    u = np.where(np.arange(n) % 80 < 40, 1.0, -1.0)
    growing = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": np.cumsum(u)})
    structure = ftlm.equation("D^alpha y = 5 y + b u", initial="rest")
    order_grid = ftlm.OrderGrid(orders={"alpha": [0.8, 1.0, 3.0]})
    brute = ftlm.search_orders(growing, structure, order_grid, m=2000, coefficients="least-squares", pruning=False)
    assert brute.exclusion_counts["diverged"] == 2
    assert brute.failures == [({"alpha": 0.8}, "diverged"), ({"alpha": 1.0}, "diverged")]
    assert [r.orders["alpha"] for r in brute.table] == [3.0]


@pytest.mark.parametrize(("share", "orders"), [(1, 100), (50, 2), (100, 1)])
@pytest.mark.parametrize("pruning", [True, False])
def test_a_share_of_candidates_that_fail_are_rows_with_a_reason(run, tmp_path, share, orders, pruning):
    """R6: two channels of one current make every candidate singular in which both have one order."""
    twin = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": run["u"], "v": run["u"]}, outputs={"y": run["y"]}, name="twin"
    )
    structure = ftlm.equation("D^1.6 y = a D^0.6 y + b D^nu u + c D^mu v", initial="rest")
    order_grid = ftlm.OrderGrid(orders={"nu": [k / 100 for k in range(orders)], "mu": [0.0]})
    options = {"coefficients": "least-squares", "m": M, "pruning": pruning}
    if share == 100:
        for more in ({}, {"store": tmp_path / "s.ftlm"}):
            with pytest.raises(ftlm.ModelError, match="none of 1 candidates has a finite score"):
                ftlm.search_orders(twin, structure, order_grid, **options, **more)
        return
    found = ftlm.search_orders(twin, structure, order_grid, **options)
    kept = ftlm.search_orders(twin, structure, order_grid, **options, store=tmp_path / "s.ftlm")
    assert kept.to_dict() == found.to_dict()
    assert found.candidates == orders
    assert len(found.table) + sum(found.exclusion_counts.values()) == found.candidates
    assert 100 * found.exclusion_counts["singular"] == share * found.candidates
    assert found.failures == [({"nu": 0.0, "mu": 0.0}, "singular")]
    assert all(row.orders["nu"] > 0 for row in found.table)


@pytest.mark.parametrize("share", [1, 50, 100])
def test_a_share_of_candidates_that_diverge_are_rows_with_a_reason(tmp_path, share):
    """R6: growth rates 5^(1/alpha) over 200 s leave the range of numbers for alpha below 1.27, and for no other."""
    u = np.where(np.arange(2001) % 80 < 40, 1.0, -1.0)
    growing = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": np.cumsum(u)})
    structure = ftlm.equation("D^alpha y = 5 y + b u", initial="rest")
    diverging = [0.6 + k / 200 for k in range(share)]
    order_grid = ftlm.OrderGrid(orders={"alpha": diverging + [2.0 + k / 100 for k in range(100 - share)]})
    for pruning in (False, True):
        options = {"m": 2000, "coefficients": "least-squares", "pruning": pruning}
        for more in ({}, {"store": tmp_path / f"{pruning}.ftlm"}):
            if share == 100:
                with pytest.raises(ftlm.ModelError, match="none of 100 candidates has a finite score"):
                    ftlm.search_orders(growing, structure, order_grid, **options, **more)
                continue
            found = ftlm.search_orders(growing, structure, order_grid, **options, **more)
            assert len(found.table) + sum(found.exclusion_counts.values()) == found.candidates == 100
            assert all(row.orders["alpha"] >= 2 for row in found.table)
            assert all(reason == "diverged" and orders["alpha"] < 1.27 for orders, reason in found.failures)
            if not pruning:
                assert found.exclusion_counts["diverged"] == share
                assert [orders["alpha"] for orders, _ in found.failures] == pytest.approx(diverging)


# ----------------------------------------------------------------------------------------------------------------------
# Results


def test_the_model_is_that_of_the_first_row(run):
    found = search(run, coefficients="least-squares")
    assert (
        found.orders == found.model.orders == found.table[0].orders == {"alpha": 1.6, "beta": 0.6, "mu": 0.0, "nu": 0.0}
    )
    assert found.coefficients == found.model.coefficients
    assert found.score == found.table[0].score
    compared = compare_means(found.model, run, m=M)
    assert compared.output_error["y"].error == pytest.approx(found.score, rel=1e-9)
    assert found.model.m == found.m == M
    assert found.model.units == {"u": "A", "y": "rad"}
    assert found.model.about["orders from"] == "order search"


def test_the_table_prints_and_is_json(run):
    found = search(run, top=2, coefficients="least-squares", norm="l2")
    head, first, second_row, last, judged, *more = str(found).splitlines()
    assert judged == f"rank 1: {found.verdict}"
    assert sum(line.startswith("next: ") for line in more) == 1
    assert head.split() == ["rank", "RMSE", "alpha", "beta", "mu", "nu", "a", "c", "b"]
    assert first.split()[0] == "1"
    assert second_row.split()[0] == "2"
    assert last.startswith("36 candidates: 2 kept, ")
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["candidates"] == 36
    assert document["settings"] == {"criterion": "output-error", "norm": "l2", "coefficients": "least-squares"}
    assert document["table"][0]["orders"] == found.orders
    assert "error" in str(search(run, top=2, coefficients="least-squares")).splitlines()[0]


# ----------------------------------------------------------------------------------------------------------------------
# Progress and interruption


def test_progress_is_told_to_the_end(run):
    reports = []
    found = search(run, progress=lambda done, total: reports.append((done, total)))
    assert reports[-1] == (found.candidates, found.candidates)
    assert [done for done, _ in reports] == sorted(done for done, _ in reports)


def test_an_error_in_progress_is_the_callers(run):
    def fail(done, total):
        raise RuntimeError(f"enough after {total}")

    with pytest.raises(RuntimeError, match="enough after 36"):
        search(run, progress=fail)
    assert search(run).candidates == 36  # and the next search runs


def test_an_error_in_progress_ends_a_long_search(clean_a):
    reports = []

    def fail(done, total):
        reports.append((done, total))
        if total:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        long_search(clean_a, progress=fail)
    done, total = reports[-1]
    assert total == 313_845
    assert done < total


def long_search(run, **options):
    return ftlm.search_orders(
        run,
        ftlm.flexible_link(form="published").equation("theta12"),
        ftlm.order_grid(alpha=(1.05, 2.0)),
        pruning=False,
        coefficients="least-squares",
        **options,
    )


INTERRUPTED = """
import signal, sys
import numpy as np
import ftlm
signal.signal(signal.SIGINT, signal.default_int_handler)
n = 4097
u = np.where(np.arange(n) % 1000 < 500, 1.0, -1.0)
rng = np.random.default_rng(0)
run = ftlm.Run.from_arrays(step=0.002, inputs={"u": u}, outputs={"y": np.cumsum(rng.standard_normal(n))})
small = ftlm.equation("D^alpha y = a y + b u")
large = {large!r}
structure = ftlm.equation(large)
last = [0, 0]
def progress(done, total):
    last[:] = done, total
    print("started", done, total, flush=True)
try:
    ftlm.search_orders(run, structure, pruning=False, m=4096, coefficients="least-squares", progress=progress)
    print("finished")
except KeyboardInterrupt:
    print("interrupted", last[0] < last[1])
print("again", ftlm.search_orders(run, small, m=64).candidates)
"""


@slow_after(
    1,
    "large",
    [
        EQUATION,
        "D^alpha y = a D^beta y + c D^mu y + d D^(alpha-mu) u + b D^nu u",
    ],
    ids=["one equation", "a law"],
)
def test_control_c_ends_a_search(large):
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED.replace("{large!r}", repr(large))],
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as child:
        try:
            for line in child.stdout:
                if line.startswith("started") and line.split()[2] != "0":
                    break
            child.send_signal(signal.SIGINT)
            rest, _ = child.communicate(timeout=120)  # a loose guard: brute force would take minutes
        finally:
            child.kill()
    lines = [line for line in rest.splitlines() if not line.startswith("started")]
    assert lines == ["interrupted True", "again 20"]
    assert child.returncode == 0


# ----------------------------------------------------------------------------------------------------------------------
# The same bits with and without vector instructions


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"norm": "l2"},
        {"criterion": "equation-error", "norm": "l2", "coefficients": "least-squares"},
        {"coefficients": "instrumental-variables", "order_grid": ftlm.order_grid(increment=0.2)},
        {"pruning": False, "order_grid": ftlm.order_grid(increment=0.2)},
    ],
)
def test_the_oldest_machine_ranks_as_the_newest(run, with_noise, options):
    """R4: the whole table and all counts, from kernels compiled for the machine at hand and for any."""
    noisy = with_noise(run, 0.003, 1)
    options = {"order_grid": ftlm.order_grid(increment=0.1), "m": 256, "threads": 2, **options}
    words = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b D^nu u", initial="rest")
    tables = []
    for portable in (False, True):
        _core.force_portable(portable)
        try:
            found = ftlm.search_orders(noisy, words, **options)
        finally:
            _core.force_portable(False)
        tables.append((found.to_dict(), found.failures))
    assert repr(tables[0]) == repr(tables[1])
    assert len(tables[0][0]["table"]) == 20


def test_the_oldest_machine_ranks_a_stage_as_the_newest(drive, plant, with_noise):
    tables = []
    for portable in (False, True):
        _core.force_portable(portable)
        try:
            tables.append(repr(stage_search(drive, plant, with_noise).to_dict()))
        finally:
            _core.force_portable(False)
    assert tables[0] == tables[1]


def test_instruments_of_an_equation_whose_coefficients_are_all_known_estimate_nothing() -> None:
    u = np.repeat([1.0, -1.0, 1.0, 1.0, -1.0], 40)
    blank = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * u})
    y = ftlm.Model(ftlm.equation("D^1.5 y = -1 D^0.5 y + 1 u")).simulate(blank)["y"]
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": y})
    words = ftlm.equation("D^alpha y = -1 D^mu y + 1 u")
    found, plain = (
        [
            (row.orders, row.score)
            for row in ftlm.search_orders(run, words, ftlm.order_grid(increment=0.1), coefficients=c).table
        ]
        for c in ("instrumental-variables", "least-squares")
    )
    assert found == plain
    assert found[0][0] == pytest.approx({"alpha": 1.45, "mu": 0.5})
