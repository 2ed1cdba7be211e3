"""Joint output error: the Jacobian, the optimum beside SciPy's, recovery of the truth with honest intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import ftlm
from ftlm.estimation.free_parameters import FreeProblem, describe_collinear_inputs
from ftlm.estimation.objective import sample_run
from ftlm.estimation.output_error import fit_output_error
from ftlm.reproduction.simulated_arm import demo_plant
from ftlm.utils.statistics import is_white

pytestmark = pytest.mark.usefixtures("no_extension_tests")

THREE_TERMS = {"alpha": 2.2, "nu": 0.9, "a1": -0.625, "a0": -1.25, "b0": 1.25}


def three_terms(noise_db: float, seed: int, *, rows: int = 1025, period: float = 5.0) -> ftlm.Run:
    """0.8 D^2.2 y + 0.5 D^0.9 y + y = u under a square input, white noise on y."""
    step = 20.0 / (rows - 1)
    t = np.arange(rows) * step
    u = np.sign(np.sin(2 * np.pi * (t + step / 2) / period))
    truth = ftlm.Model(ftlm.equation("D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u"))
    clean = truth.simulate(ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": 0 * t}), tolerance=1e-7)
    sigma = np.std(clean["y"]) * 10 ** (-noise_db / 20)
    noisy = clean["y"] + sigma * np.random.default_rng(seed).standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": noisy}, name=f"seed {seed}")


def structure() -> ftlm.Structure:
    return replace(ftlm.equation("D^alpha y = a1 D^nu y + a0 y + b0 u"), initial="rest")


def arm_run(stage: int, rows: int, noise: float, seed: int) -> ftlm.Run:
    t = np.arange(rows) * 0.002
    current = np.where((t + 0.001) % 2 < 1, 0.3, -0.3)
    names = (f"theta{stage}1", f"theta{stage}2")
    blank = ftlm.Run.from_arrays(
        step=0.002, inputs={f"I{stage}": current}, outputs={n: np.zeros(rows) for n in names}, name="arm"
    )
    clean = ftlm.simulate(demo_plant(stage, form="published"), blank, tolerance=1e-7)
    rng = np.random.default_rng(seed)
    outputs = {n: clean[n] + noise * np.std(clean[n]) * rng.standard_normal(rows) for n in names}
    return ftlm.Run.from_arrays(step=0.002, inputs={f"I{stage}": current}, outputs=outputs, name="arm")


def residuals_at(problem: FreeProblem, prepared: list, values: np.ndarray) -> dict:
    """One evaluation, no step."""
    return problem.core.minimize(prepared, (values.tolist(), []), True, [], 1, 1e-12, False)


@pytest.mark.parametrize("coupling", ["simulated", "measured"])
@pytest.mark.parametrize("initial", [(False, []), (True, [])])
def test_the_analytic_jacobian_is_that_of_finite_differences(coupling: str, initial: tuple) -> None:
    run = arm_run(1, 301, 1e-3, 0)
    words = "caputo" if initial[0] else "rest"
    problem = FreeProblem.of(replace(ftlm.flexible_link(form="published", stage=1, coupling=coupling), initial=words))
    prepared = [sample_run(run, problem, [1.0, 10.0], pulses_per_sample=2)]
    # Away from whole differences of orders, where initial terms merge.
    named = {"alpha1": 1.93, "alpha2": 1.91, "gamma1": 0.9, "beta2": 0.13, "mu2": 0.8}
    named |= {"a1": 500.0, "b1": -50.0, "d1": 8.0, "g1": 120.0, "r1": 1.5}
    names = [*problem.orders, *problem.coefficients]
    point = np.array([named[n] for n in names])
    base = residuals_at(problem, prepared, point)
    weights = np.linalg.norm(base["jacobian"], axis=1)
    for i, name in enumerate(names):
        shift = 1e-6 * max(abs(point[i]), 1.0)
        sides = []
        for sign in (1, -1):
            moved = point.copy()
            moved[i] += sign * shift
            sides.append(residuals_at(problem, prepared, moved))
        slope = (np.asarray(sides[0]["residuals"]) - np.asarray(sides[1]["residuals"])) / (2 * shift)
        found = np.asarray(base["jacobian"][i])
        if initial[0]:
            # The projection on the initial terms is Kaufman's: exact up to terms of the size of the residual, so the
            # gradient of the cost, not each residual's slope, is exact.
            gradient = float(slope @ base["residuals"])
            assert float(found @ base["residuals"]) == pytest.approx(gradient, rel=2e-3, abs=1e-4 * weights[i]), name
        else:
            assert np.max(np.abs(slope - found)) < 2e-5 * np.max(np.abs(found)) + 1e-9 * weights[i], name


def test_the_optimum_is_scipys() -> None:
    run = three_terms(30, 5, rows=513)
    problem = FreeProblem.of(structure())
    prepared = [sample_run(run, problem, [20.0])]
    start = np.array([2.1, 1.0, -0.7, -1.1, 1.1])

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.asarray(residuals_at(problem, prepared, x)["residuals"])

    reference = least_squares(residuals, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    core_fit = problem.core.minimize(prepared, (start.tolist(), []), False, [], 100, 1e-12, False)
    assert core_fit["status"] == "converged"
    assert core_fit["cost"] == pytest.approx(reference.cost, rel=1e-8)
    assert np.array(core_fit["values"]) == pytest.approx(reference.x, rel=1e-4)
    assert core_fit["evaluations"] < reference.nfev * 3


@pytest.mark.slow
def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    scores = []
    for seed in range(16):
        found = fit_output_error([three_terms(40, seed)], structure())
        assert found.names == list(THREE_TERMS)
        errors = np.array(list(found.standard_errors.values()))
        scores.append((found.values - np.array(list(THREE_TERMS.values()))) / errors)
    z = np.array(scores)
    # 80 correlated scores: wide bounds, but a scheme that is biased or overconfident fails them.
    assert np.mean(np.abs(z) < 1.96) > 0.85
    assert np.all(np.abs(z.mean(axis=0)) < 1.0)
    assert np.max(np.abs(z)) < 4.5


@pytest.mark.parametrize(
    ("stage", "noise", "rows"),
    [
        (1, 1e-2, 1501),
        *(pytest.param(k, noise, 3001, marks=pytest.mark.slow) for k, noise in ((1, 1e-2), (1, 1e-4), (2, 1e-2))),
    ],
)
def test_the_arm_is_recovered_from_an_automatic_start_under_both_laws(stage: int, noise: float, rows: int) -> None:
    run = arm_run(stage, rows, noise, 3)
    found = ftlm.identify(run, ftlm.flexible_link(form="published", stage=stage), method="output-error")
    plant = demo_plant(stage, form="published")
    truth = {n: v for n, v in plant.orders.items()} | plant.coefficients
    assert found.joint is not None
    for name, value in {**found.orders, **found.joint.coefficients}.items():
        if name in truth:
            assert abs(value - truth[name]) < 5 * found.standard_errors[name], name
    for name, (low, high) in found.intervals.items():
        assert low < high, name
    for output, noise_found in found.joint.noise.items():
        assert noise_found == pytest.approx(noise * np.std(run[output]), rel=0.06)
    coefficients = found.coefficients
    d, h = 2 * stage, 2 * stage - 1
    assert coefficients[f"b{d}"] == -coefficients[f"b{h}"]
    assert coefficients[f"a{d}"] == pytest.approx(-coefficients[f"a{h}"] * found.joint.coefficients[f"r{stage}"])


def test_printed_figures_are_those_of_compare_and_the_model_saves(tmp_path) -> None:
    run = three_terms(40, 1)
    found = ftlm.identify(run, ftlm.equation("D^alpha y = a1 D^nu y + a0 y + b0 u"))
    assert found.method == "output-error"
    assert found.fit["y"] > 98
    again = ftlm.load_model(found.model.save(tmp_path / "m.json")).compare(run)
    assert again.fit["y"] == pytest.approx(found.fit["y"], abs=1e-12)
    assert "±" in str(found)
    assert set(found.to_dict()["intervals"]) == set(THREE_TERMS)


def test_several_runs_of_different_length_and_step_tell_more_than_one() -> None:
    short, long = three_terms(30, 2, rows=513), three_terms(30, 3, rows=1025, period=3.0)
    alone = fit_output_error([short], structure())
    both = fit_output_error([short, long], structure())
    values = dict(zip(both.names, both.values, strict=True))
    for name, truth in THREE_TERMS.items():
        assert both.standard_errors[name] < alone.standard_errors[name]
        assert abs(values[name] - truth) < 4.5 * both.standard_errors[name]


def test_a_run_that_does_not_start_at_rest_keeps_its_initial_terms_to_itself() -> None:
    # Free decay from y(0) = 1 under a small input: without initial terms nothing fits.
    t = np.arange(801) * 0.02
    u = 0.3 * np.sign(np.sin(2.5 * t))
    model = ftlm.Model(ftlm.equation("D^1.6 y = -0.8 D^0.7 y - 2.0 y + 1.5 u", initial="caputo"))
    blank = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0 * t})
    # D^0.7 of the constant leaves t^0.9 beside t^0 (mathematics of initial terms): 0.8/Γ(1.9).
    clean = model.simulate(blank, initial={"y": {0.0: 1.0, 0.9: 0.8 / 0.9617658319073874}})
    noisy = clean["y"] + 1e-3 * np.random.default_rng(0).standard_normal(801)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": noisy})
    found = ftlm.identify(run, ftlm.equation("D^alpha y = a1 D^nu y + a0 y + b0 u"))
    truth = {"alpha": 1.6, "nu": 0.7, "a1": -0.8, "a0": -2.0, "b0": 1.5}
    for name, value in {**found.orders, **found.coefficients}.items():
        assert abs(value - truth[name]) < 5 * found.standard_errors[name] + 1e-6, name
    assert found.fit["y"] > 99


def test_what_the_run_cannot_tell_is_said_in_words() -> None:
    # One sine at one frequency cannot tell five numbers.
    t = np.arange(1025) * 0.02
    u = np.sin(2.0 * t)
    truth = ftlm.Model(ftlm.equation("D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u"))
    clean = truth.simulate(ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": 0 * t}))["y"]
    noisy = clean + 0.05 * np.std(clean) * np.random.default_rng(4).standard_normal(t.size)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": noisy}).window(8.0, None)
    found = ftlm.identify(run, ftlm.equation("D^alpha y = a1 D^nu y + a0 y + b0 u"))
    assert any(
        "not identifiable" in w or "does not differ significantly from 0" in w or "bound" in w for w in found.warnings
    )


def test_white_noise_is_white_and_coloured_noise_is_not() -> None:
    rng = np.random.default_rng(11)
    whites = [is_white(rng.standard_normal(2000)) for _ in range(200)]
    assert 0.95 < np.mean(whites) <= 1.0
    coloured = np.convolve(rng.standard_normal(2001), [1.0, 0.3])[1:2001]
    assert not is_white(coloured)


def test_the_search_is_the_same_for_any_number_of_threads() -> None:
    run = three_terms(30, 7, rows=513)
    first, second = (fit_output_error([run], structure(), threads=n) for n in (1, 2))
    assert np.array_equal(first.values, second.values)
    assert first.cost == second.cost


def test_the_choice_of_an_optimum_is_given_in_words() -> None:
    found = ftlm.identify(three_terms(40, 0), structure())
    joint = found.joint
    level = joint.starts[0][0]
    same = sum(v <= 1.001 * level for v, _ in joint.starts)
    assert joint.origin_text.startswith(
        f"{same} of {len(joint.starts)} starts ended in the lowest optimum, first that of: "
    )
    assert joint.origin_text in found.details()
    assert found.to_dict()["choice"] == joint.origin_text
    given = fit_output_error([three_terms(40, 0)], structure(), start=THREE_TERMS)
    assert given.origin_text == "from the start that was given"
    behind = replace(joint, starts=[(1.0, "a"), (1.0005, "b"), (3.0, "c")])
    assert behind.origin_text == (
        "2 of 3 starts ended in the lowest optimum, first that of: a; the next costs 3 times as much"
    )


def test_two_signals_that_drive_alike_are_named() -> None:
    run = three_terms(40, 0)
    (signal,) = run.inputs
    u = run[signal]
    twice = ftlm.Run.from_arrays(step=run.step, inputs={"u": u, "v": -2.5 * u}, outputs={"y": run["y"]})
    words = (
        "v is -2.5 times u on every run, so their effects are not separately identifiable: leave out the term of c or "
        "that of b, fix one of"
    )
    with pytest.raises(ftlm.ConvergenceError, match=words):
        ftlm.identify(twice, ftlm.equation("D^alpha y = a1 D^mu y + a0 y + b u + c v"))
    # At another order, or with a share that differs, they can be told apart.
    apart = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": u, "v": u + 1e-6 * np.cos(run.time)}, outputs={"y": run["y"]}
    )
    assert describe_collinear_inputs([apart], ftlm.equation("D^alpha y = a0 y + b u + c v")) is None
    assert describe_collinear_inputs([twice], ftlm.equation("D^alpha y = a0 y + b u + c D^gamma v")) is None
