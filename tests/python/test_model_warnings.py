"""Warnings on models that must not be used; printed values can be computed again from saved files."""

import re

import numpy as np
import pytest

import ftlm
from ftlm.findings import texts

WORDS = "D^alpha y = a D^0.6 y + c y + b u"


def said(found, words):
    return [w for w in found.warnings if words in w]


@pytest.fixture(scope="module")
def noisy(small_run, with_noise):
    return with_noise(small_run, 0.01, 4)


def test_a_model_that_can_be_trusted_warns_of_nothing(noisy, small_model):
    found = ftlm.identify(noisy, ftlm.equation(WORDS))
    assert found.warnings == ()
    n = 700
    blank = ftlm.Run.from_arrays(
        step=0.02, inputs={"u": np.sin(np.arange(n) ** 1.2 / 30)}, outputs={"y": np.zeros(n)}, units=noisy.units
    )
    assert found.validate(small_model.simulate(blank, tolerance=1e-4)).warnings == ()


def test_near_identity_orders_say_so(clean_a, with_noise):
    run = with_noise(clean_a, 1e-4, 1)
    structure = ftlm.flexible_link(form="published", stage=1, coupling="measured", laws=()).equation("theta12")
    orders = {"alpha2": 2.0, "beta2": 1.95, "mu2": 1.9, "gamma2": 1.05}
    found = ftlm.identify(run, structure.with_orders(orders), method="least-squares")
    (warning,) = said(found, "nearly says that theta12 equals itself")
    assert "orders 1.95, 1.9 are close to alpha = 2" in warning
    assert found.equation_error["theta12"].nr < 0.2 * found.output_error["theta12"].nr


@pytest.mark.parametrize("method", ["least-squares", "output-error"])
def test_orders_on_the_edge_of_their_interval_say_so(noisy, method):
    structure = ftlm.equation(WORDS, orders={"alpha": "1.1:1.4:0.1"})
    found = ftlm.identify(noisy, structure, method=method)
    assert found.orders["alpha"] == pytest.approx(1.4)
    assert said(found, "order alpha = 1.4 is on ")


def test_an_order_that_the_run_says_nothing_of_says_so(small_run, with_noise):
    # The truth has no such term: its order can be anything.
    run = with_noise(small_run, 0.3, 2)
    structure = ftlm.equation("D^1.6 y = -3 D^0.6 y + c y + b u + d D^kappa u", orders={"kappa": "0:0.5:0.05"})
    found = ftlm.identify(run, structure)
    width = 0.5
    assert found.standard_errors["kappa"] > width or abs(found.coefficients["d"]) < 2 * found.standard_errors["d"]
    assert [w for w in found.warnings if "kappa" in w or "coefficient d" in w], found.warnings


def test_standard_errors_wider_than_the_bounds_say_so(noisy):
    from dataclasses import replace

    from ftlm.estimation.free_parameters import FreeProblem
    from ftlm.estimation.model_checks import identifiability_findings

    structure = ftlm.equation(WORDS, orders={"alpha": "1.5:1.7:0.1"})
    joint = ftlm.identify(noisy, structure).joint
    problem = FreeProblem.of(structure)
    assert not [w for w in identifiability_findings(joint, problem) if "alpha" in w.text]
    for value in (0.3**2, np.nan, np.inf):
        covariance = joint.covariance.copy()
        covariance[0, 0] = value
        words = texts(identifiability_findings(replace(joint, covariance=covariance), problem))
        said = (
            "not separately identifiable from these runs: alpha"
            if value == np.inf
            else "order alpha is not identifiable from these runs"
        )
        assert any(w.startswith(said) for w in words), value


def test_correlated_numbers_are_told_apart_where_each_is_known(noisy):
    from dataclasses import replace

    from ftlm.estimation.model_checks import correlation_findings

    joint = ftlm.identify(noisy, ftlm.equation(WORDS)).joint
    n = len(joint.names)
    # All of them correlated by 0.999; only the size of their errors differs.
    alike = np.full((n, n), 0.999) + 0.001 * np.eye(n)
    sizes = np.array(
        [1.0 if name in joint.orders else abs(v) for name, v in zip(joint.names, joint.values, strict=True)]
    )

    def said_of(shares):
        spread = np.asarray(shares) * sizes
        return list(texts(correlation_findings(replace(joint, covariance=alike * np.outer(spread, spread)))))

    assert said_of(np.full(n, 0.01)) == []
    assert said_of([0.2, *np.full(n - 1, 0.01)]) == []
    listed = f"{', '.join(joint.names[:-1])} and {joint.names[-1]}"
    assert said_of(np.full(n, 0.2)) == [
        f"{listed} are strongly correlated: these runs hardly distinguish them (correlations up to 0.9990)"
    ]
    assert said_of([0.2, 0.2, *np.full(n - 2, 0.01)]) == [
        f"{joint.names[0]} and {joint.names[1]} are strongly correlated: these runs hardly distinguish them "
        "(correlation 0.9990)"
    ]
    lost = [np.inf, np.inf, *np.full(n - 2, 0.01)]
    with np.errstate(invalid="ignore"):
        assert said_of(lost) == [
            f"{joint.names[0]} and {joint.names[1]} are strongly correlated: these runs hardly distinguish them "
            "(their standard errors are not finite)"
        ]


def test_one_sine_for_many_numbers_says_so(small_model):
    n = 900
    blank = ftlm.Run.from_arrays(step=0.02, inputs={"u": np.sin(0.1 * np.arange(n))}, outputs={"y": np.zeros(n)})
    clean = small_model.simulate(blank, tolerance=1e-5)
    y = clean["y"] + 0.01 * np.random.default_rng(1).standard_normal(n)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": clean["u"]}, outputs={"y": y})
    structure = ftlm.equation("D^alpha y = a D^nu y + c y + b u")
    found = ftlm.identify(run, structure)
    assert said(found, "the equation of y has 5 free parameters, but in steady state u determines only 2")


def test_what_is_printed_is_what_compare_says(noisy, tmp_path):
    for method in ("output-error", "least-squares", "multi-innovation"):
        found = ftlm.identify(noisy, ftlm.equation(WORDS, orders={"alpha": "1.5:1.7:0.1"}), method=method)
        loaded = ftlm.load_model(found.model.save(tmp_path / f"{method}.json"))
        again = loaded.compare(noisy)
        for name, figures in found.output_error.items():
            assert again.output_error[name].fit == pytest.approx(figures.fit, rel=1e-12)
            assert again.equation_error[name].nr == pytest.approx(found.equation_error[name].nr, rel=1e-12)
        for printed in (
            re.search(r"^  y +(\S+) +not tried", str(found), re.MULTILINE),
            re.search(r"^y +output error.* ([\d.]+)$", found.details(), re.MULTILINE),
        ):
            assert float(printed[1]) == pytest.approx(again.fit["y"], rel=1e-3)


def test_every_figure_of_a_report_follows_from_the_saved_model_and_the_run(noisy, tmp_path):
    found = ftlm.identify(noisy, ftlm.equation(WORDS))
    page = found.report(tmp_path / "p.html").read_text("utf-8")
    shown = {float(v) for v in re.findall(r'<data value="([^"]+)">', page)}
    loaded = ftlm.load_model(found.model.save(tmp_path / "m.json"))
    comparison, tests = loaded.compare(noisy), loaded.resid(noisy)
    figures = [*comparison.output_error.values(), *comparison.equation_error.values()]
    expected = {v for f in figures for v in (f.error, f.rmse, f.nr, f.fit)}
    expected |= {
        v for t in (tests.outputs["y"].whiteness, tests.outputs["y"].inputs["u"]) for v in (t.statistic, t.limit)
    }
    expected |= set(loaded.orders.values()) | set(loaded.coefficients.values())
    expected |= {v for v in loaded.estimate.standard_errors.values() if v is not None}
    assert expected <= shown


@pytest.mark.parametrize("method", ["output-error", "instrumental-variables", "least-squares"])
def test_an_unstable_model_is_called_so_however_well_it_fits(method: str) -> None:
    rng = np.random.default_rng(4)
    u = np.repeat(rng.choice([-1.0, 1.0], 20), 20)
    blank = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": 0 * u})
    for growth, grows in ((0.5, True), (-0.5, False)):
        clean = ftlm.Model(ftlm.equation(f"D y = {growth} y + u")).simulate(blank, tolerance=1e-6)["y"]
        noisy = clean + 1e-4 * np.std(clean) * rng.standard_normal(u.size)
        run = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": noisy})
        found = ftlm.identify(run, ftlm.equation("D y = a0 y + b0 u", initial="rest"), method=method)
        assert found.fit["y"] > 99
        said = [w for w in found.warnings if "1 pole with a positive real part" in w and "grows without bound" in w]
        assert len(said) == grows


@pytest.mark.parametrize(("gain", "level"), [(2.0, "with care"), (0.5, "trust")])
def test_equations_that_are_unstable_only_together_are_called_so(gain: float, level: str) -> None:
    # The poles of both equations together are -1 ± sqrt(gain).
    truth = ftlm.Model(ftlm.equation(f"D x = -x + {gain} y + 2 u; D y = -y + x", coupling="simulated"))
    rng = np.random.default_rng(5)
    runs = []
    for _ in range(2):
        u = np.repeat(rng.choice([-1.0, 1.0], 40), 20)
        blank = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"x": 0 * u, "y": 0 * u})
        clean = truth.simulate(blank)
        outputs = {n: clean[n] + 1e-3 * np.std(clean[n]) * rng.standard_normal(u.size) for n in ("x", "y")}
        runs.append(ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs=outputs))
    found = ftlm.identify(runs[0], ftlm.equation("D x = a x + b y + c u; D y = d y + e x", initial="rest"))
    verdict = found.validate(runs[1]).verdict
    assert found.model.stability(coupling="measured").stable
    assert (verdict.level, found.model.stability().stable) == (level, level == "trust"), verdict
    reason = "simulated together, the equations are unstable (1 pole with a positive real part)"
    assert (verdict.reason == reason) == (level == "with care")
    assert (reason in [f.reason for f in found.findings]) == (level == "with care")
