"""Non-linear terms in identifications: equation error, order searches, results from file to page."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.estimation.linear import _estimate_coefficients, estimate_coefficients
from ftlm.estimation.nonlinear_checks import nonlinear_findings
from ftlm.order_search import search as order_search
from ftlm.order_search.options import SearchSettings
from ftlm.simulation.nonlinear_columns import differentiate
from ftlm.simulation.output_samples import OutputSamples, simulate_samples
from nonlinear_plants import PLANTS
from slow_cases import slow_after


@pytest.fixture(scope="module")
def runs():
    return {name: plant.run(plant.clean(), 1) for name, plant in PLANTS.items()}


def at_true_orders(name):
    plant = PLANTS[name]
    return plant.structure.with_orders({n: plant.truth[n] for n in plant.structure.order_names})


@pytest.mark.parametrize("name", PLANTS)
@slow_after(1, "method", ["least-squares", "multi-innovation"])
def test_equation_error_at_the_true_orders(runs, name, method):
    result = ftlm.identify(runs[name], at_true_orders(name), method=method)
    for parameter, estimate in result.parameters.items():
        # The bias of noise on the regressors of D^mu y.
        assert estimate.value == pytest.approx(PLANTS[name].truth[parameter], rel=0.15)
    assert result.comparison.fit["y"] > 90


def test_column_of_a_nonlinear_term_is_that_of_its_signals(runs):
    structure = ftlm.equation("D^2 y = a D^0.6 y + k y + k3 y^3 + b u", initial="rest")
    own = estimate_coefficients([runs["duffing"]], structure, SearchSettings(coefficients="least-squares"), 500).values
    cubed = runs["duffing"]
    means = ftlm.kernels.pulse_means(cubed["y"], 500) ** 3
    step = cubed.duration / 500
    rows = [ftlm.kernels.pulse_means(cubed["y"], 500), means, ftlm.kernels.pulse_means(cubed["u"], 500, hold=True)]
    columns = [
        ftlm.kernels.integrate(rows[signal], order, step=step) for signal, order in ((0, 1.4), (0, 2), (1, 2), (2, 2))
    ]
    expected = np.linalg.lstsq(np.stack(columns, axis=1), rows[0], rcond=None)[0]
    np.testing.assert_allclose([own[n] for n in ("a", "k", "k3", "b")], expected, rtol=1e-6)


def test_derivatives_of_pulse_means():
    step, m = 0.01, 400
    edges = step * np.arange(m + 1)
    means = np.diff(edges**4) / (4 * step)  # of t^3
    middles = (edges[1:] + edges[:-1]) / 2
    for order, exact in ((1.0, 3 * middles**2), (0.5, 6 / 3.3233509704478426 * middles**2.5)):
        for smooth in (False, True):
            found = differentiate(means, order, step, local_smoothing=smooth)
            assert np.abs(found - exact)[2:].max() < 2e-3
    noisy = means + 0.1 * np.random.default_rng(0).standard_normal(m)
    raw, smooth = (differentiate(noisy, 1.0, step, local_smoothing=s) - 3 * middles**2 for s in (False, True))
    assert np.std(smooth) < 0.2 * np.std(raw)


def test_of_raw_and_smooth_velocities_the_better_free_run_decides(runs):
    structure, settings = at_true_orders("drag"), SearchSettings(coefficients="least-squares")
    chosen = estimate_coefficients([runs["drag"]], structure, settings, None)
    smooth, raw = (
        _estimate_coefficients([runs["drag"]], structure, settings, None, local_smoothing=s)[0] for s in (True, False)
    )
    assert chosen.values == smooth.values != raw.values
    coarse = runs["drag"].resample(0.2)
    chosen = estimate_coefficients([coarse], structure, settings, None)
    ways = [
        _estimate_coefficients([coarse], structure, settings, None, local_smoothing=s)[0].values for s in (True, False)
    ]
    # Windows of 31 points are too wide here.
    assert chosen.values == ways[1] != ways[0]


GRID = ftlm.OrderGrid(orders={"alpha": "1.8:2.2:0.05", "mu": "0.4:0.9:0.05"})


def test_order_search_ranks_by_free_runs(runs, tmp_path, monkeypatch):
    structure = PLANTS["duffing"].structure
    result = ftlm.search_orders(runs["duffing"], structure, GRID)
    assert result.orders["alpha"] == 2.0
    assert result.orders["mu"] == pytest.approx(0.6, abs=0.06)
    scores = [row.score for row in result.table]
    assert scores == sorted(scores)
    assert (result.simulated_candidates, result.candidates) == (99, 99)
    assert sum(result.exclusion_counts.values()) + len(result.table) == 99
    assert result.settings["criterion"] == "output-error"
    monkeypatch.setattr("ftlm.order_search.search.FREE_RUN_CANDIDATES", 30)
    few = ftlm.search_orders(runs["duffing"], structure, GRID, store=tmp_path / "search.store")
    assert few.simulated_candidates == 30
    assert "only the best 30 of 99 candidates by equation error were simulated and ranked" in str(few)
    assert few.table[0].orders == result.table[0].orders
    again = ftlm.resume_search(tmp_path / "search.store")["y"]
    assert again.table == few.table
    assert ftlm.search_orders(runs["duffing"], structure, GRID, criterion="equation-error").simulated_candidates == 0


def test_candidates_whose_free_run_diverges_are_left_out(runs):
    structure = PLANTS["duffing"].structure.with_coefficients({"k3": 40.0})
    with pytest.raises(ftlm.ModelError, match=r"the simulations of the best \d+ candidates .* all diverge"):
        ftlm.search_orders(runs["duffing"], structure, GRID)


def test_a_record_is_the_run_of_its_pulse_means(runs):
    structure = at_true_orders("duffing").with_coefficients(
        {n: v for n, v in PLANTS["duffing"].truth.items() if n not in ("alpha", "mu")}
    )
    (rec,) = ftlm.simulation.discretization.prepare([runs["duffing"]], structure, None, power_of_two=False)
    run = order_search.record_run(rec, structure)
    left = order_search.free_run_errors(ftlm.Model(structure), rec, run)["y"]
    noise = np.std(runs["duffing"]["y"]) * 0.01
    assert np.std(left) < 1.2 * noise


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "D y = a sqrt(y) + b u",
            "sqrt(y) of run 'run' is not finite in 95 pulses, first at 3.15 s, where y = -0.00839674; use",
        ),
        ("D y = a y + b D^0.5 (u*D u)", "has a zero-order hold for u, whose jumps have no derivative"),
        ("D y = a y + b exp(1000 y)", "exp(1000*y) of run 'run' is not finite"),
    ],
)
def test_expressions_without_a_value(text, message):
    y = np.sin(np.arange(200) / 10)
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.sign(y) + 2}, outputs={"y": y}, name="run")
    with pytest.raises(ftlm.FtlmError) as refused:
        ftlm.identify(run, ftlm.equation(text, initial="rest"), method="least-squares")
    assert message in str(refused.value)


def test_a_term_without_a_value_has_no_equation_error_but_a_free_run():
    step = 0.05
    u = np.repeat(np.random.default_rng(2).uniform(0, 2, 20), 20)
    truth = ftlm.Model(ftlm.equation("D y = -0.5 sqrt(y + 0.01) + u - y"))
    blank = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": np.zeros(u.size)})
    y = truth.simulate(blank)["y"] + 0.01 * np.random.default_rng(3).standard_normal(u.size)
    y[:6] = -0.05
    run = blank.with_outputs({"y": y})
    result = ftlm.identify(run, ftlm.equation("D y = -k sqrt(y + 0.01) + u - y", initial="rest"))
    assert result.parameters["k"].value == pytest.approx(0.5, abs=0.05)
    reason = "a non-linear term of the measured signals has no value in some of the rows"
    assert result.comparison.without_equation_error == {"y": reason}


def test_the_linear_model_is_the_derivative_of_the_free_run():
    step, rows = 0.02, 1500
    model = ftlm.Model(ftlm.equation("D^1.8 y = -2 y - 0.5 D^0.5 y - 3 y^3 + 0.7 y*u + u - 0.2 abs(D y)*D y"))
    # The equilibrium of a constant input: 2 y + 3 y^3 - 0.7 y u - u = 0.
    y = 0.3
    u = (2 * y + 3 * y**3) / (1 + 0.7 * y)
    settle = rows - 300
    change = np.where(np.arange(rows) >= settle, np.sin(0.05 * np.arange(rows)), 0.0)

    def output(model, input):
        run = ftlm.Run.from_arrays(step=step, inputs={"u": input}, outputs={"y": np.zeros(rows)})
        return model.simulate(run, tolerance=1e-5)["y"]

    moved, still = (output(model, u + size * change) for size in (1e-3, 0.0))
    linear = output(model.linearized(at={"y": y, "u": u}), change)
    difference = (moved - still)[settle:] / 1e-3
    assert np.abs(difference - linear[settle:]).max() < 0.02 * np.abs(linear).max()


def test_findings_say_range_and_share_of_each_term(runs):
    result = ftlm.identify(runs["drag"], at_true_orders("drag"), method="least-squares")
    (found,) = (f for f in result.findings if f.code == "nonlinear_range")
    assert (found.output, found.numbers["term"]) == ("y", "abs(D y)*D y")
    assert re.search(r"D y from -\d\.\d+ to \d\.\d+", str(found))
    velocity = np.gradient(runs["drag"]["y"], 0.01)
    assert 20 < found.numbers["share"] < 100
    assert f"{velocity.max():.1f}"[:1] in str(found)


def test_a_run_that_forgets_its_parameters_is_said():
    rows, step = 4000, 0.05
    u = np.cos(1.2 * step * np.arange(rows))
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": np.zeros(rows)})

    def codes(text):
        model = ftlm.Model(ftlm.equation(text))
        free = OutputSamples(*simulate_samples(model, run, 1, None), 1, np.zeros(1))
        return {f.code: f for f in nonlinear_findings(model, [run], [free])}

    chaos = codes("D^2 y = -0.3 D^0.9 y + 1 y - 1 y^3 + 0.6 u")["simulation_chaotic"]
    assert chaos.level == "do not use"
    assert 20 < chaos.numbers["seconds"] < 150
    assert "simulation_chaotic" not in codes("D^2 y = -0.3 D^0.9 y - 1 y - 1 y^3 + 0.6 u")
    # A linear unstable model grows with its output.
    assert "simulation_chaotic" not in codes("D y = 0.1 y - 1e-9 y^3 + 0.1 u")


@pytest.mark.parametrize("at", [300, 450, 600])
def test_a_late_step_is_not_chaos(at):
    """A tank in equilibrium at 0.4 m, and one step of its pump."""
    rows, rng = 800, np.random.default_rng(0)
    u = np.where(np.arange(rows) < at, 2.0 * np.sqrt(0.4), 1.8)
    y = np.full(rows, 0.4)
    rate = lambda _, level: -0.02 * np.sqrt(level) + 0.018  # noqa: E731
    y[at:] = solve_ivp(rate, (0, rows), [0.4], t_eval=np.arange(rows - at), rtol=1e-10, atol=1e-12).y[0]
    run = ftlm.Run.from_arrays(step=1.0, inputs={"u": u}, outputs={"y": y + 0.003 * rng.standard_normal(rows)})
    found = ftlm.identify(run, ftlm.equation("D y = -k sqrt(y) + b u"), threads=1)
    assert {f.code for f in found.findings if f.level == "do not use"} == set()
    for name, truth in (("k", 0.02), ("b", 0.01)):
        assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].standard_error < 0.02 * truth


@pytest.mark.parametrize("rows_at_rest", [0, 1, 40])
@pytest.mark.parametrize("root", ["sqrt(y)", "sqrt(abs(y))"])
def test_a_tank_that_is_empty_until_its_pump_starts_is_simulated_and_found(rows_at_rest, root):
    """The slope of the square root is infinite at rest."""
    rows = 300
    u = np.where(np.arange(rows) < rows_at_rest, 0.0, 1.2)
    y = np.zeros(rows)
    rate = lambda _, level: -0.02 * np.sqrt(np.maximum(level, 0.0)) + 0.012  # noqa: E731
    times = np.arange(rows - rows_at_rest)
    y[rows_at_rest:] = solve_ivp(rate, (0, rows), [0.0], t_eval=times, rtol=1e-9, atol=1e-11).y[0]
    noise = 0.003 * np.random.default_rng(0).standard_normal(rows)
    run = ftlm.Run.from_arrays(step=1.0, inputs={"u": u}, outputs={"y": y + noise})
    simulated = ftlm.Model(ftlm.equation(f"D y = -0.02 {root} + 0.01 u")).simulate(run)["y"]
    np.testing.assert_allclose(simulated, y, atol=2e-6)
    assert not simulated[: rows_at_rest + 1].any()
    found = ftlm.identify(run, ftlm.equation(f"D y = -k {root} + b u"), threads=1)
    assert found.coefficients == pytest.approx({"k": 0.02, "b": 0.01}, rel=0.03)


@pytest.mark.parametrize("at", [100, 320])
def test_radiation_at_ambient_temperature_is_simulated_and_found(at):
    """Near y = 0 the fourth powers cancel to rounding errors, which no Newton step reduces."""
    step, rows = 5.0, 600
    heat = np.where(np.arange(rows) < at, 0.0, 60.0)
    rate = lambda _, y: -2e-3 * y - 8e-12 * ((y + 293) ** 4 - 293.0**4) + 1.2  # noqa: E731
    y = np.zeros(rows)
    times = step * np.arange(rows - at)
    y[at:] = solve_ivp(rate, (0, step * rows), [0.0], t_eval=times, rtol=1e-10, atol=1e-9).y[0]
    noise = 0.05 * np.random.default_rng(1).standard_normal(rows)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": heat}, outputs={"y": y + noise})
    model = ftlm.Model(ftlm.equation("D y = -0.002 y - 8e-12 ((y + 293)^4 - 293^4) + 0.02 u"))
    np.testing.assert_allclose(model.simulate(run)["y"], y, atol=1e-5)
    found = ftlm.identify(run, ftlm.equation("D y = -a y - e ((y + 293)^4 - 293^4) + b u"), threads=1)
    assert found.coefficients == pytest.approx({"a": 2e-3, "e": 8e-12, "b": 0.02}, rel=0.02)
    assert "step_moves_estimate" not in {f.code for f in found.findings}


def test_a_fit_to_chaotic_motion_has_no_intervals():
    step, rows = 0.02, 1500
    blank = ftlm.Run.from_arrays(
        step=step, inputs={"u": np.cos(1.2 * step * np.arange(rows))}, outputs={"y": np.zeros(rows)}
    )
    clean = ftlm.Model(ftlm.equation("D^2 y = -0.3 D y + 1 y - 1 y^3 + 0.5 u")).simulate(blank)
    run = clean.with_outputs({"y": clean["y"] + 0.005 * np.random.default_rng(0).standard_normal(rows)})
    # The cost of a chaotic run has so many minima that rounding decides which one an automatic start ends in.
    truth = {"d": -0.3, "k": 1.0, "c": -1.0, "b": 0.5}
    method = ftlm.OutputError(start=truth)
    found = ftlm.identify(run, ftlm.equation("D^2 y = d D y + k y + c y^3 + b u"), method=method)
    assert found.verdict.level == "do not use"
    assert "chaotic" in str(found.verdict)
    assert set(found.intervals.values()) == {(-np.inf, np.inf)}


@pytest.mark.parametrize("offset", [None, "auto", "level"])
def test_an_offset_of_the_sensor_is_estimated_as_a_level(offset):
    rng = np.random.default_rng(12)
    u = np.repeat(rng.uniform(0, 2, 16), 25)
    rest = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": np.zeros(u.size)})
    y = ftlm.Model(ftlm.equation("D y = -1 y - 0.3 y^3 + 1 u")).simulate(rest, tolerance=1e-6)["y"]
    run = rest.with_outputs({"y": y + 5.0 + 0.01 * rng.standard_normal(u.size)})
    found = ftlm.identify(run, ftlm.equation("D y = a y + c y^3 + b u"), offset=offset, threads=1)
    truth = {"a": -1.0, "c": -0.3, "b": 1.0}
    for name, value in truth.items():
        # An error of 0.01 in the level changes a by 2 %, which the errors of the coefficients include.
        assert abs(found.values[name] - value) < 3 * found.standard_errors[name] < 0.1, name
    level = found.offsets["level_y"]
    assert abs(level.value - 5.0) < 3 * level.standard_error < 0.05
    assert found.joint.noise["y"] == pytest.approx(0.01, rel=0.1)
    assert found.model.compare(run).fit["y"] == pytest.approx(found.fit_percent["y"], abs=1e-9)
    # The range of y is that in y^3, without the level.
    ranges = next(finding.numbers["ranges"] for finding in found.findings if finding.code == "nonlinear_range")
    low, high = map(float, re.fullmatch(r"y from (\S+) to (\S+)", ranges).groups())
    assert abs(low) < 0.1
    assert 1.0 < high < 2.0


@slow_after(2, "seed", range(30))
def test_colored_noise_is_no_level_beside_a_nonlinear_term(seed):
    rng = np.random.default_rng(100 + seed)
    u = np.repeat(rng.uniform(0, 2, 16), 25)
    rest = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": np.zeros(u.size)})
    y = ftlm.Model(ftlm.equation("D y = -1 y - 0.3 y^3 + 1 u")).simulate(rest, tolerance=1e-6)["y"]
    noise = lfilter([0.6], [1, -0.8], rng.standard_normal(u.size + 50))[50:]
    run = rest.with_outputs({"y": y + 0.02 * noise})
    found = ftlm.identify(run, ftlm.equation("D y = a y + c y^3 + b u"), threads=1)
    assert not {"level_estimated", "constant_estimated"} & {finding.code for finding in found.findings}


@slow_after(1, "seed", range(3))
def test_a_step_in_the_first_row_of_a_drag_at_a_level(seed):
    """Initial values explain the run alike, with a negative damping; rest at a level is assumed, and said to be."""
    rate = lambda _, y: 2.0 - 0.5 * np.abs(y) * y - 0.5 * y  # noqa: E731
    y = 3.0 + solve_ivp(rate, (0, 8), [0.0], t_eval=0.02 * np.arange(400), rtol=1e-9, atol=1e-11).y[0]
    noise = 0.002 * np.random.default_rng(seed).standard_normal(400)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": np.ones(400)}, outputs={"y": y + noise})
    found = ftlm.identify(run, ftlm.equation("D y = -w abs(y)*y - a y + b u"), threads=1)
    for name, truth in {"w": 0.5, "a": 0.5, "b": 2.0}.items():
        assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].standard_error < 0.1, name
    assert found.offsets["level_y"].value == pytest.approx(3.0, abs=0.01)
    assert "rest_assumed" in {finding.code for finding in found.findings}


def test_a_tank_that_fills_from_a_level_does_not_rest_there():
    """The root tells the level from an initial value, although the input is constant."""
    rate = lambda _, y: 0.04 - 0.02 * np.sqrt(y)  # noqa: E731
    y = solve_ivp(rate, (0, 300), [1.0], t_eval=np.arange(300.0), rtol=1e-9, atol=1e-11).y[0]
    y += 0.003 * np.random.default_rng(0).standard_normal(300)
    run = ftlm.Run.from_arrays(step=1.0, inputs={"u": np.ones(300)}, outputs={"y": y})
    found = ftlm.identify(run, ftlm.equation("D y = -k sqrt(y) + b u"), threads=1)
    for name, truth in {"k": 0.02, "b": 0.04}.items():
        assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].standard_error < truth, name
    assert not found.offsets


@slow_after(1, "seed", range(4))
@pytest.mark.parametrize("first", [0.2, 0.5])
def test_growth_from_a_start_below_the_noise(first, seed):
    y = 20.0 / (1.0 + (20.0 / first - 1.0) * np.exp(-0.05 * np.arange(300)))
    y += 0.1 * np.random.default_rng(seed).standard_normal(300)
    run = ftlm.Run.from_arrays(step=0.1, inputs={}, outputs={"y": y})
    found = ftlm.identify(run, ftlm.equation("D y = r y - k y^2"), threads=1)
    for name, truth in {"r": 0.5, "k": 0.025}.items():
        assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].standard_error < 0.02 * truth
    assert "constant_estimated" not in {finding.code for finding in found.findings}


def test_from_the_command_line_to_a_page(runs, tmp_path):
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    plant = PLANTS["rotor"]
    runs["rotor"].to_csv(first)
    plant.run(plant.clean(), 2).to_csv(second)
    model, page = tmp_path / "model.json", tmp_path / "page.html"

    def call(*arguments):
        return CliRunner().invoke(app, [*map(str, arguments)])

    found = call("identify", first, "--structure", plant.text, "-o", model, "--report", page, "--validation", second)
    assert found.exit_code == 0, found.output
    assert "TRUST" in found.output
    assert re.search(r"of that of D\^0\.(89|90)\d* y in the equation of y", " ".join(found.output.split()))
    assert "<msup><mrow><mi>y</mi></mrow><mn>2</mn></msup>" in page.read_text(encoding="utf-8")
    assert "only its linear model about a point has poles" in page.read_text(encoding="utf-8")
    compared = call("compare", model, second)
    assert compared.exit_code == 0
    assert "99" in compared.output
    simulated = call("simulate", model, second, "-o", tmp_path / "simulated.csv")
    assert simulated.exit_code == 0, simulated.output
    assert call("resid", model, second).exit_code == 0
    assert call("report", model, "-o", tmp_path / "saved.html", "--force").exit_code == 0
    refused = call("export", model, "--to", "matlab", "-o", tmp_path / "model.m")
    assert refused.exit_code == 2
    assert "Model.linearized in Python" in refused.output


def test_selection_finds_the_nonlinear_term(runs):
    structure = ftlm.equation("D^0.9 y = c u^2 - w y^2 + k y + e y*u", initial="rest")
    selection = ftlm.select(runs["rotor"].window(0.0, 30.0), structure)
    assert {"c", "w"} <= {t.name for t in selection.model.equations[0].terms}


@slow_after(1, "start", [1.1, 1.6])
def test_an_order_may_fall_below_an_integer_in_motion(start):
    # Of two initial values at the start one is left at the optimum.
    time = np.arange(400) * 0.02
    u = np.sign(np.sin(1.3 * time) + 0.3 * np.sin(4.1 * time))
    drive = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": np.zeros(400)})
    y = ftlm.Model(ftlm.equation("D^0.9 y = -1.2 y - 0.8 y^3 + 2 u")).simulate(drive)["y"]
    y = y + 1e-3 * np.random.default_rng(0).normal(size=400)
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y})
    structure = replace(ftlm.equation("D^alpha y = a y + c y^3 + b u"), initial="caputo")
    guess = {"alpha": start, "a": -1.2, "c": -0.8, "b": 2.0}
    result = ftlm.identify(run, structure, method=ftlm.OutputError(start=guess, intervals="quadratic"))
    truth = {"alpha": 0.9, "a": -1.2, "c": -0.8, "b": 2.0}
    for name, value in truth.items():
        estimate = result.parameters[name]
        assert abs(estimate.value - value) < 4 * estimate.standard_error


def test_a_nonlinear_term_is_fitted_to_irregular_rows_on_their_grid():
    rng, rows = np.random.default_rng(15), 300
    t = np.cumsum(rng.uniform(0.5, 1.5, rows))
    u = np.repeat(rng.uniform(0.5, 1.8, 6), 50)
    level = np.full(rows, 0.4)
    for k, duration in enumerate(np.diff(t)):
        rate = lambda _, x, flow=u[k]: -0.02 * np.sqrt(x) + 0.01 * flow  # noqa: E731
        level[k + 1] = solve_ivp(rate, (0, duration), [level[k]], rtol=1e-8, atol=1e-10).y[0, -1]
    y = level + 0.003 * rng.standard_normal(rows)
    run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, time=t - t[0], resample=1.0)
    found = ftlm.identify(run, ftlm.equation("D y = -k sqrt(y) + b u"), threads=1)
    for name, truth in (("k", 0.02), ("b", 0.01)):
        assert abs(found.parameters[name].value - truth) < 4 * found.parameters[name].standard_error < 0.03 * truth
    assert "sample_times_interpolated" in {f.code for f in found.findings}
    assert found.model.compare(run).fit["y"] > 95
