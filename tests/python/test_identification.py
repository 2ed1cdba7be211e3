"""From measured runs to a model: estimators, several runs, orders given and searched, warnings, traces."""

import json
from dataclasses import replace

import numpy as np
import pytest

import ftlm
import oracles
from ftlm import _core
from ftlm.estimation.methods import method_with_options
from ftlm.simulation.discretization import record, structure_tuple
from ftlm.validation.comparison import compare_means

METHODS = ("least-squares", "multi-innovation")
WORDS = "D^1.6 y = a D^0.6 y + c y + b u"
TRUTH = {"a": -3.0, "c": -8.0, "b": 5.0}


@pytest.fixture(scope="module")
def structure():
    return ftlm.equation(WORDS)


@pytest.fixture(scope="module")
def second(small_model):
    """Another run of the same machine, of another length and step."""
    n = 401
    u = np.sin(np.arange(n) ** 1.3 / 20)
    empty = ftlm.Run.from_arrays(
        step=0.03, inputs={"u": u}, outputs={"y": np.zeros(n)}, units={"u": "A", "y": "rad"}, name="second"
    )
    return small_model.simulate(empty, tolerance=1e-6)


def regression(runs, m):
    """Regressors and outputs of the small equation in Haar coordinates, one pair a run."""
    parts = []
    for run in runs:
        y, u = (oracles.pulse_means(run[n], m, how) for n, how in (("y", "foh"), ("u", "zoh")))
        q = oracles.regressors([y, y, u], [0.6, 0.0, 0.0], 1.6, run.duration)
        parts.append((q, oracles.haar_matrix(m) @ y))
    return parts


# ----------------------------------------------------------------------------------------------------------------------
# Estimators at given orders


def test_least_squares_is_the_oracles(small_run, structure, with_noise):
    run = with_noise(small_run, 0.005, 1)
    found = ftlm.identify(run, structure, method="least-squares", m=256)
    ((q, y),) = regression([run], 256)
    assert [found.coefficients[n] for n in "acb"] == pytest.approx(list(oracles.least_squares(q, y)), rel=1e-9)
    assert found.settings == {
        "criterion": "output-error",
        "norm": "l1",
        "coefficients": "least-squares",
        "m": 256,
        "initial": "rest",
    }


@pytest.mark.parametrize(("p", "k0"), [(1, 1.0), (7, 1.0), (3, 1e-4), (50, 1e6)])
def test_multi_innovation_is_the_oracles(small_run, structure, p, k0):
    found = ftlm.identify(
        small_run, structure, method=ftlm.MultiInnovation(innovation_length=p, prior_covariance=k0), m=256
    )
    ((q, y),) = regression([small_run], 256)
    expected = oracles.multi_innovation_closed_form(q, y, p, k0)
    assert [found.coefficients[n] for n in "acb"] == pytest.approx(list(expected), rel=1e-9)
    for name, value in (("innovation_length", p), ("prior_covariance", k0), ("row_basis", "haar")):
        assert found.settings[name] == value


def test_the_default_prior_is_relative_to_the_regressors(small_run, structure):
    found = ftlm.identify(small_run, structure, method="multi-innovation", m=256)
    ((q, y),) = regression([small_run], 256)
    expected = oracles.multi_innovation_closed_form(q, y, 7, np.diag(1e10 / np.sum(q**2, axis=0)))
    assert [found.coefficients[n] for n in "acb"] == pytest.approx(list(expected), rel=1e-9)
    trace = ftlm.multi_innovation_trace(small_run, structure, m=256)
    assert [trace.coefficients[n][-1] for n in "acb"] == pytest.approx(list(expected), rel=1e-6)
    assert "p = 7, weak prior, haar rows" in found.details()


def test_multi_innovation_in_the_order_of_time_takes_any_number_of_pulses(small_run, structure):
    method = ftlm.MultiInnovation(row_basis="time", prior_covariance=1.0)
    found = ftlm.identify(small_run, structure, method=method, m=300)
    y, u = (oracles.pulse_means(small_run[n], 300, how) for n, how in (("y", "foh"), ("u", "zoh")))
    q = oracles.regressors([y, y, u], [0.6, 0.0, 0.0], 1.6, small_run.duration, haar=False)
    expected = oracles.multi_innovation_closed_form(q, y, 7, 1.0)
    assert [found.coefficients[n] for n in "acb"] == pytest.approx(list(expected), rel=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_the_truth_is_found_without_noise(small_run, structure, method):
    weak = ftlm.MultiInnovation(prior_covariance=1e9) if method == "multi-innovation" else method
    found = ftlm.identify(small_run, structure, method=weak, m=512)
    assert found.coefficients == {n: pytest.approx(v, rel=2e-3) for n, v in TRUTH.items()}
    assert found.fit["y"] > 99.9
    assert found.warnings == ()
    assert found.method == method
    assert found.searches == {}
    assert found.orders == {}
    assert found.intervals == {}


@pytest.mark.parametrize("method", METHODS)
def test_several_runs_are_one_fit(small_run, second, structure, method, with_noise):
    runs = [with_noise(small_run, 0.01, 1), with_noise(second, 0.02, 2)]
    found = ftlm.identify(runs, structure, method=method, m=256)
    parts = regression(runs, 256)
    if method == "least-squares":
        expected = oracles.least_squares(np.vstack([q for q, _ in parts]), np.concatenate([y for _, y in parts]))
    else:
        weights = np.array([min(7, 256 - k) for k in range(256)])
        prior = np.diag(sum(np.sum(q**2, axis=0) for q, _ in parts)) / 1e10
        normal = sum(q.T @ (weights[:, None] * q) for q, _ in parts) + prior
        expected = np.linalg.solve(normal, sum(q.T @ (weights * y) for q, y in parts))
    assert [found.coefficients[n] for n in "acb"] == pytest.approx(list(expected), rel=1e-8)
    assert [name for name, _, _ in found.comparison.per_run] == [run.name for run in runs]
    assert found.model.about["runs"] == f"{runs[0].name}, {runs[1].name}"


def test_default_m_is_what_the_runs_carry(small_run, second, structure):
    assert ftlm.identify(small_run, structure, method="multi-innovation").settings["m"] == 512
    assert ftlm.identify(small_run, structure, method="least-squares").settings["m"] == 512
    assert ftlm.identify([small_run, second], structure, method="multi-innovation").settings["m"] == 256
    assert ftlm.identify([small_run, second], structure, method="least-squares").settings["m"] == 400


def test_runs_that_do_not_start_at_rest_get_initial_terms(small_run, structure):
    # From t = 3 s on nothing before is known: a history is estimated, of this run alone, and reported.
    piece = replace_name(small_run.window(3.0, None), "piece")
    found = ftlm.identify([small_run, piece], structure, method="least-squares", m=256)
    assert found.settings["initial"] == "history, 10 powers of t up to 2.25"
    assert found.coefficients == {n: pytest.approx(v, rel=0.05) for n, v in TRUTH.items()}
    assert "initial terms of y in piece (of that run alone): " in found.details()
    fixed = ftlm.identify(piece, replace(structure, initial=(0.0, 1.0)), method="least-squares", m=256)
    assert fixed.settings["initial"] == "t^[0.0, 1.0]"
    assert set(fixed.comparison.initial[0]["y"]) == {0.0, 1.0}


def replace_name(run, name):
    return ftlm.Run.from_arrays(
        step=run.step,
        inputs={n: run[n] for n in run.inputs},
        outputs={n: run[n] for n in run.outputs},
        units=run.units,
        name=name,
    )


def test_known_coefficients_stay_what_they_are(small_run):
    known = ftlm.equation(WORDS, fixed={"c": -8.0})
    found = ftlm.identify(small_run, known, method="least-squares")
    assert found.coefficients["c"] == -8.0
    assert found.coefficients["a"] == pytest.approx(-3, rel=2e-3)
    everything = ftlm.identify(small_run, ftlm.equation(WORDS, fixed=TRUTH), method="least-squares")
    assert everything.coefficients == TRUTH
    assert everything.fit["y"] > 99.9


# ----------------------------------------------------------------------------------------------------------------------
# Orders


def test_orders_of_one_equation_are_searched(small_run):
    words = ftlm.equation("D^alpha y = a D^nu y + c y + b u")
    order_grid = ftlm.order_grid(increment=0.2, alpha=(1.2, 2.0))
    found = ftlm.identify(small_run, words, method=ftlm.LeastSquares(order_grid=order_grid), m=512)
    assert found.orders == {"alpha": 1.6, "nu": 0.6}
    assert found.coefficients == {n: pytest.approx(v, rel=2e-3) for n, v in TRUTH.items()}
    (search,) = found.searches.values()
    assert list(found.searches) == ["y"]
    assert search.orders == found.orders
    assert search.coefficients == pytest.approx(found.coefficients, rel=1e-6)
    given = ftlm.identify(small_run, words.with_orders(found.orders), method="least-squares", m=512)
    assert given.coefficients == found.coefficients
    assert given.searches == {}


@pytest.mark.parametrize("criterion", ["output-error", "equation-error"])
@pytest.mark.parametrize("norm", ["l1", "l2"])
def test_search_settings_are_handed_on(small_run, criterion, norm):
    words = ftlm.equation("D^alpha y = a D^nu y + c y + b u")
    settings = {"criterion": criterion, "norm": norm, "top": 3}
    options = {"threads": 1, "m": 128}
    order_grid = ftlm.order_grid(increment=0.2, alpha=(1.2, 2.0))
    reports = []
    found = ftlm.identify(
        small_run,
        words,
        method=ftlm.MultiInnovation(innovation_length=3, prior_covariance=50.0, order_grid=order_grid, **settings),
        progress=lambda done, total: reports.append((done, total)),
        **options,
    )
    same = ftlm.search_orders(
        small_run,
        words,
        order_grid,
        coefficients="multi-innovation",
        innovation_length=3,
        prior_covariance=50.0,
        **settings,
        **options,
    )
    assert found.searches["y"].table == same.table
    assert len(same.table) == 3
    assert reports[-1] == (same.candidates, same.candidates)


def test_equations_without_a_law_are_searched_one_by_one(clean_a):
    structure = ftlm.flexible_link(form="published", laws=(), coupling="measured")
    order_grid = ftlm.OrderGrid(
        orders={
            "alpha1": [1.95, 2.0],
            "beta1": [0.75],
            "gamma1": [0.9, 0.95],
            "mu1": [0.0],
            "alpha2": [2.0],
            "beta2": [0.85, 0.8],
            "gamma2": [1.0, 1.05],
            "mu2": [0.1],
        }
    )
    found = ftlm.identify(clean_a, structure, method=ftlm.LeastSquares(order_grid=order_grid))
    assert list(found.searches) == ["theta11", "theta12"]
    assert [s.candidates for s in found.searches.values()] == [4, 4]
    assert found.orders == {
        "alpha1": 2.0,
        "beta1": 0.75,
        "gamma1": 0.95,
        "mu1": 0.0,
        "alpha2": 2.0,
        "beta2": 0.85,
        "gamma2": 1.05,
        "mu2": 0.1,
    }
    # One equation that has all its orders is not searched.
    half = structure.with_orders({n: v for n, v in found.orders.items() if n.endswith("1")})
    assert list(
        ftlm.identify(
            clean_a,
            half,
            method=ftlm.LeastSquares(
                order_grid=replace(order_grid, orders={n: v for n, v in order_grid.orders.items() if n.endswith("2")})
            ),
        ).searches
    ) == ["theta12"]


def test_law_search_recovers_the_five_free_orders_of_plant_a(clean_a, plants):
    order_grid = ftlm.OrderGrid(
        increment=0.05,
        orders={
            "alpha1": (1.9, 2.0),
            "alpha2": (1.9, 2.0),
            "gamma1": (0.9, 1.0),
            "beta2": (0.0, 0.2),
            "mu2": (0.75, 0.95),
        },
    )
    found = ftlm.identify(
        clean_a, ftlm.flexible_link(form="published"), method=ftlm.LeastSquares(order_grid=order_grid)
    )
    assert found.orders == plants["A"]["free_orders"]
    assert list(found.searches) == ["stage"]
    assert found.searches["stage"].candidates > 300
    for described in plants["A"]["equations"]:
        for term in described["terms"]:
            assert found.coefficients[term["name"]] == pytest.approx(term["coefficient"], rel=1e-3)
    assert all(fit > 99.9 for fit in found.fit.values())
    assert found.warnings == ()
    assert found.model.units == {"theta11": "rad", "theta12": "rad", "I1": "A"}


# ----------------------------------------------------------------------------------------------------------------------
# What is printed can be recomputed


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("initial", ["auto", "caputo"])
def test_printed_figures_are_those_of_compare(small_run, second, with_noise, method, initial, tmp_path):
    runs = [with_noise(small_run, 0.01, 1), with_noise(second, 0.02, 2).window(1.0, None)]
    words = ftlm.equation("D^alpha y = a D^nu y + c y + b u", initial=initial)
    order_grid = ftlm.order_grid(increment=0.2, alpha=(1.4, 1.8))
    method = method_with_options(method, {"order_grid": order_grid})
    found = ftlm.identify(runs, words, method=method, m=128)
    saved = ftlm.load_model(found.model.save(tmp_path / "model.json"))
    for again in (found.model.compare(runs), ftlm.compare(found.model, runs), saved.compare(runs)):
        assert again.m == 128
        for kind in ("output_error", "equation_error"):
            first_statistics, repeated_statistics = getattr(found, kind)["y"], getattr(again, kind)["y"]
            for figure in ("error", "rmse", "nr", "fit"):
                assert getattr(repeated_statistics, figure) == pytest.approx(
                    getattr(first_statistics, figure), rel=1e-12
                ), figure
        assert again.fit == pytest.approx(found.fit, rel=1e-12)
    if initial == "caputo":
        return  # each run's free run then fits its own initial terms, which a search does not
    if len(found.comparison.initial[0]["y"]) == 0:
        alone = ftlm.identify(runs[0], words, method=method, m=128)
        # Searches rank by pulse means, as the paper's (45).
        means = compare_means(alone.model, runs[0], m=128)
        assert means.output_error["y"].error == pytest.approx(alone.searches["y"].score, rel=1e-9)


def test_results_print_and_are_json(clean_a, plants):
    structure = ftlm.flexible_link(form="published", parameters="effective").with_orders(plants["A"]["free_orders"])
    found = ftlm.identify(clean_a, structure, method=ftlm.MultiInnovation(prior_covariance=100.0), m=256)
    text = found.details()
    assert text.startswith(
        "flexible link, stage 1: multi-innovation, M = 256, p = 7, K0 = 100, haar rows, initial terms: rest"
    )
    assert "(nominal 628.889)" in text
    for line in str(found.comparison).splitlines()[:5]:
        assert line in text
    for warning in found.warnings:
        assert f"warning: {warning}" in text
    assert "<math>" in found._repr_html_()
    assert "Both errors" in found._repr_html_()
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["coefficients"] == found.coefficients
    assert document["warnings"] == list(found.warnings)
    assert document["output_error"]["theta11"]["nr"] == found.output_error["theta11"].nr


# ----------------------------------------------------------------------------------------------------------------------
# Warnings in words


def test_a_prior_that_pulls_is_named(small_run, structure):
    found = ftlm.identify(small_run, structure, method=ftlm.MultiInnovation(prior_covariance=0.01))
    (warning,) = (w for w in found.warnings if "the prior" in w)
    assert "y: the prior (covariance K0 = 0.01, mean 0) shifts a coefficient by" in warning
    assert "Raise prior_covariance=, or use method='least-squares'" in warning
    assert "p = 7 only sets the weight of the data relative to the prior" in warning
    weak = ftlm.identify(small_run, structure, method=ftlm.MultiInnovation(prior_covariance=1e6))
    assert not any("the prior" in w for w in weak.warnings)
    # As weak as numbers go.
    weakest = ftlm.identify(small_run, structure, method=ftlm.MultiInnovation(prior_covariance=1e299))
    assert weakest.coefficients == {n: pytest.approx(v, rel=2e-3) for n, v in TRUTH.items()}


def test_a_prior_that_decides_the_ranking_is_named(small_run):
    free = ftlm.equation("D^alpha y = a0 y + b u", initial="rest")
    grid = ftlm.order_grid(increment=0.2)
    strong = ftlm.identify(small_run, free, method=ftlm.MultiInnovation(prior_covariance=1e-4, order_grid=grid), m=256)
    (finding,) = (f for f in strong.findings if f.code == "prior_decides_ranking")
    assert finding.text.startswith(
        "y: the prior determines the ranking of orders: with K0 = 0.0001 the error of the best candidate is "
    )
    for usual in (None, 1e8):
        method = ftlm.MultiInnovation(prior_covariance=usual, order_grid=grid)
        found = ftlm.identify(small_run, free, method=method, m=256)
        assert not [f for f in found.findings if f.code in ("prior_decides_ranking", "prior_shifts_estimate")]


def test_the_papers_prior_on_plant_a_is_named(clean_a, plants):
    # K0 = 1 in SI units: a1 = 1.25 for 629. The paper's columns show the same pull.
    structure = ftlm.flexible_link(form="published").with_orders(plants["A"]["free_orders"])
    found = ftlm.identify(clean_a, structure, method=ftlm.MultiInnovation(prior_covariance=1.0))
    assert found.settings["m"] == 2048
    assert found.coefficients["a1"] == pytest.approx(1.25, abs=0.01)
    for output in ("theta11", "theta12"):
        assert any(w.startswith(f"{output}: the prior (covariance K0 = 1") for w in found.warnings)
        assert any(w.startswith(f"{output}: the simulation explains little") for w in found.warnings)


def test_a_broken_coefficient_law_is_named(clean_a, with_noise, plants):
    structure = ftlm.flexible_link(form="published").with_orders(plants["A"]["free_orders"])
    found = ftlm.identify(with_noise(clean_a, 3e-3, 1), structure, method="least-squares")
    broken = [w for w in found.warnings if w.startswith("coefficient law: ")]
    assert any(w.startswith("coefficient law: b2 = ") and "but the other equation requires" in w for w in broken)
    assert any("the inertia ratio r1 must exceed 1, but is" in w for w in broken)
    free = ftlm.identify(with_noise(clean_a, 3e-3, 1), replace(structure, coefficient_law=()), method="least-squares")
    assert not any("coefficient law" in w for w in free.warnings)


def test_near_identities_are_named(clean_a, with_noise):
    structure = ftlm.flexible_link(form="published").equation("theta12")
    found = ftlm.identify(
        with_noise(clean_a, 1e-4, 1),
        structure,
        method=ftlm.LeastSquares(
            criterion="equation-error", norm="l2", order_grid=ftlm.order_grid(alpha=(2.0, 2.0), gamma2=0.65)
        ),
        m=1024,
    )
    assert any("so the equation nearly says that theta12 equals itself" in w for w in found.warnings)


def test_orders_on_the_edge_and_facts_about_the_run_are_repeated(small_run):
    words = ftlm.equation("D^alpha y = a D^0.6 y + c y + b u")
    resampled = small_run.resample(0.04)
    found = ftlm.identify(
        resampled, words, method=ftlm.LeastSquares(order_grid=ftlm.order_grid(increment=0.1, alpha=(1.2, 1.5))), m=256
    )
    assert "order alpha = 1.5 is on the edge of its interval; widen it" in found.warnings
    assert any(w.startswith(f"run {resampled.name}: resampled from 0.02 s to 0.04 s") for w in found.warnings)


def test_a_discretization_that_is_itself_unstable_is_named():
    # D^2 y = -c y at pulses wider than sqrt(12/c): the scheme's Nyquist mode grows, whether or not the model does.
    n = 401
    u = np.where(np.arange(n) % 100 < 50, 1.0, -1.0)
    empty = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": np.zeros(n)})
    stiff = ftlm.Model(ftlm.equation("D^2 y = -2000 y - 60 D y + 2000 u"))
    run = stiff.simulate(empty, tolerance=1e-6)
    words = ftlm.equation("D^2 y = -2000 y - 60 D y + b u")
    coarse, fine = (ftlm.identify(run, words, method="least-squares", m=m) for m in (100, 400))
    assert _core.nyquist_margin([(-2000.0, 2.0), (-60.0, 1.0)], 0.08) == pytest.approx(1 - 2000 * 0.08**2 / 12)
    (warning,) = (w for w in coarse.warnings if "discretization" in w)
    assert warning.startswith(
        "y: with 100 block pulses per run the discretization itself is unstable (stability margin -0.067), whether"
    )
    assert "raise m" in warning
    assert not any("discretization" in w for w in fine.warnings)


# ----------------------------------------------------------------------------------------------------------------------
# The recursion's path


@pytest.mark.parametrize("rows", ["haar", "time"])
@pytest.mark.parametrize("p", [1, 7])
def test_the_last_row_of_a_trace_is_the_closed_form(small_run, structure, p, rows):
    options = {"innovation_length": p, "prior_covariance": 10.0, "row_basis": rows}
    trace = ftlm.multi_innovation_trace(small_run, structure, m=256, **options)
    assert trace.innovation_length == p
    assert trace.step.tolist() == list(range(1, 257))
    found = ftlm.identify(small_run, structure, method=ftlm.MultiInnovation(**options), m=256)
    size = max(abs(v) for v in found.coefficients.values())
    for name, value in found.coefficients.items():
        assert trace.coefficients[name][-1] == pytest.approx(value, abs=1e-9 * size)
    means = compare_means(found.model, small_run, m=256)
    assert trace.error[-1] == pytest.approx(means.output_error["y"].error, rel=1e-6)


def test_a_trace_is_the_recursion_of_the_oracle(small_run, structure):
    trace = ftlm.multi_innovation_trace(small_run, structure, innovation_length=3, prior_covariance=1.0, m=128)
    ((q, y),) = regression([small_run], 128)
    path = oracles.multi_innovation_recursion(q, y, 3, 1.0)
    for k, name in enumerate("acb"):
        np.testing.assert_allclose(trace.coefficients[name], path[:, k], rtol=1e-8, atol=1e-9)
    u = oracles.pulse_means(small_run["u"], 128, "zoh")
    means = oracles.pulse_means(small_run["y"], 128, "foh")
    for step in (0, 1, 30, 127):
        a, c, b = path[step]
        free = oracles.free_run([(a, 0.6), (c, 0.0)], [(b, 0.0, u)], 1.6, 128, small_run.duration)
        assert trace.error[step] == pytest.approx(oracles.absolute_error(means, free), rel=1e-7)


@pytest.mark.parametrize(
    ("every", "steps"), [(1, range(1, 65)), (10, [10, 20, 30, 40, 50, 60, 64]), (64, [64]), (1000, [64])]
)
def test_every_nth_step_and_the_last(small_run, structure, every, steps):
    trace = ftlm.multi_innovation_trace(small_run, structure, m=64, every=every)
    assert trace.step.tolist() == list(steps)
    assert all(len(v) == len(trace.step) for v in (trace.error, *trace.coefficients.values()))
    whole = ftlm.multi_innovation_trace(small_run, structure, m=64)
    np.testing.assert_array_equal(trace.error, whole.error[trace.step - 1])


def test_a_trace_of_a_signed_and_of_a_known_coefficient(small_run):
    words = ftlm.equation("D^1.6 y = -2 a D^0.6 y - 8 y + b u")
    trace = ftlm.multi_innovation_trace(small_run, words, prior_covariance=1e9, m=256)
    assert set(trace.coefficients) == {"a", "b"}
    assert trace.coefficients["a"][-1] == pytest.approx(1.5, rel=0.01)


def test_a_trace_that_diverges_is_infinite_there():
    n = 1001
    u = np.where(np.arange(n) % 80 < 40, 1.0, -1.0)
    run = ftlm.Run.from_arrays(step=0.5, inputs={"u": u}, outputs={"y": np.cumsum(np.cumsum(u)) * 1e3})
    trace = ftlm.multi_innovation_trace(run, ftlm.equation("D^1 y = 1.9 y + b u"), m=512, every=511)
    assert trace.error.tolist() == [np.inf, np.inf]


@pytest.mark.parametrize(
    ("words", "options", "message"),
    [
        ("D^alpha y = a y + b u", {}, "a convergence trace needs one equation whose orders are numbers"),
        ("D y = a y; D z = b z", {}, "a convergence trace needs one equation whose orders are numbers"),
        (WORDS, {"every": 0}, "every = 0 is not a whole number of at least 1"),
        (WORDS, {"every": "x"}, "every = 'x' is not a whole number of at least 1"),
        (WORDS, {"innovation_length": 0}, "innovation_length = 0"),
        (WORDS, {"prior_covariance": 0}, "prior_covariance = 0 is not positive"),
        (WORDS, {"m": 300}, "m = 300 is not a power of two"),
        (WORDS, {"row_basis": "x"}, "row_basis = 'x' is not known"),
    ],
)
def test_traces_of_nothing_are_refused(small_run, words, options, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.multi_innovation_trace(small_run, ftlm.equation(words), **options)
    assert message in str(refused.value)


# ----------------------------------------------------------------------------------------------------------------------
# Output error


def test_output_error_is_the_default_and_gives_intervals(small_run, with_noise):
    words = ftlm.equation("D^alpha y = a D^nu y + c y + b u", orders={"alpha": [1.2, 2.0], "nu": [0.2, 1.0]})
    run = with_noise(small_run, 0.01, 4)
    found = ftlm.identify(run, words)
    assert found.method == "output-error"
    truth = TRUTH | {"alpha": 1.6, "nu": 0.6}
    for name, (low, high) in found.intervals.items():
        width = high - low
        assert low - width / 2 < truth[name] < high + width / 2, name
        assert found.standard_errors[name] == pytest.approx(width / 2 / 1.96, rel=1e-3)
    assert set(found.intervals) == set(truth)
    assert found.fit["y"] > 95
    assert found.output_error["y"].rmse == pytest.approx(found.model.compare(run).output_error["y"].rmse, rel=1e-12)


# ----------------------------------------------------------------------------------------------------------------------
# Refusals


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "method = 'magic' is not known; use "),
        ({"method": "genetics"}, "method = 'genetics' is not known; use "),
        ({"threads": 0}, "threads = 0 is outside [1, 1024]"),
        ({"m": 600}, "m = 600 is more than run 'small, simulated' allows: 513 rows give 512 pulses"),
    ],
)
@pytest.mark.parametrize("method", ["output-error", *METHODS])
def test_settings_that_mean_nothing_are_refused_by_every_method(small_run, structure, method, options, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.identify(small_run, structure, **{"method": method, **options})
    assert message in str(refused.value)


@pytest.mark.parametrize("method", METHODS)
def test_what_is_no_structure_and_no_run_is_refused(small_run, structure, method):
    with pytest.raises(ftlm.ModelError, match="structure is int; give the text"):
        ftlm.identify(small_run, 1, method=method)
    with pytest.raises(ftlm.ModelError, match=r"use ftlm.select\(runs, 'auto'\).best"):
        ftlm.identify(small_run, "auto", method=method)
    with pytest.raises(ftlm.DataError, match="no run is given; give at least one"):
        ftlm.identify([], structure, method=method)
    with pytest.raises(ftlm.DataError, match=r"runs\[1\] is ndarray, not a Run"):
        ftlm.identify([small_run, small_run["y"]], structure, method=method)
    with pytest.raises(ftlm.DataError, match="runs is NoneType; give a Run or a list of them"):
        ftlm.identify(None, structure, method=method)


def test_regressors_that_cannot_be_told_apart_are_refused(small_run):
    twice = ftlm.Run.from_arrays(
        step=0.02, inputs={"u": small_run["u"], "v": 3 * small_run["u"]}, outputs={"y": small_run["y"]}
    )
    words = ftlm.equation("D^1.6 y = a D^0.6 y + c y + b u + d v")
    with pytest.raises(ftlm.ConvergenceError, match="regressor 3 of 4 is a linear combination of the others"):
        ftlm.identify(twice, words, method="least-squares")
    silent = ftlm.Run.from_arrays(step=0.02, inputs={"u": np.zeros(513)}, outputs={"y": small_run["y"]})
    with pytest.raises(ftlm.DataError, match="u is 0 in all rows, so its coefficient in the equation of y cannot"):
        ftlm.identify(silent, ftlm.equation(WORDS), method="least-squares")


def test_arguments_are_never_changed(small_run, structure):
    before = {n: small_run[n].copy() for n in small_run.signals}
    words = str(structure)
    order_grid = ftlm.order_grid(increment=0.4, alpha=(1.2, 2.0))
    ftlm.identify(
        small_run, ftlm.equation("D^alpha y = a y + b u"), method=ftlm.LeastSquares(order_grid=order_grid), m=64
    )
    assert all(np.array_equal(small_run[n], before[n]) for n in before)
    assert str(structure) == words
    assert order_grid == ftlm.order_grid(increment=0.4, alpha=(1.2, 2.0))


def test_the_record_that_is_estimated_on_is_that_of_the_core(small_run, structure):
    rec = record(small_run, structure, 256)
    raw = _core.least_squares(
        [rec.core()], structure_tuple(structure.equations[0], rec.signals), list(rec.inputs), [None] * 3, (False, [])
    )[0]
    found = ftlm.identify(small_run, structure, method="least-squares", m=256)
    assert list(found.coefficients.values()) == raw
