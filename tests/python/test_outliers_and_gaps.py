"""Real records: missing samples, irregular sample times, outliers, colored noise, coarse quantization."""

from __future__ import annotations

import json
from math import gamma

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lfilter, lsim

import ftlm
from ftlm import _core
from ftlm.data.sampling import grid_positions, interpolate_gaps
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective, covariance_of
from ftlm.estimation.output_error import fit_output_error
from ftlm.simulation.output_samples import simulate_samples
from ftlm.utils.statistics import (
    HUBER_THRESHOLD,
    MAD_OVER_SIGMA,
    NORMAL_95,
    autocovariances,
    huber_excess,
    is_white,
    quantization_step,
)
from ftlm.validation.comparison import simulate_runs

STEP, ROWS, FINE = 0.1, 400, 20
WORDS = "D^2 y = -0.8 D y - 4 y + 4 u"
FREE = "D^2 y = c D y + a y + b u"
TRUTH = {"c": -0.8, "a": -4.0, "b": 4.0}


def answer(u: np.ndarray, tick: float) -> np.ndarray:
    """The resonance of WORDS under a held input, by its state space."""
    system = ([[0.0, 1.0], [-4.0, -0.8]], [[0.0], [4.0]], [[1.0, 0.0]], [[0.0]])
    return lsim(system, u, np.arange(u.size) * tick, interp=False)[1]


def record(seed: int, jitter: float = 0.0, rows: int = ROWS) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, a switching command and the exact answer to it at these times."""
    rng = np.random.default_rng(seed)
    ticks = np.arange(rows) * FINE + np.round(rng.uniform(-jitter, jitter, rows) * FINE).astype(int)
    ticks[0] = 0
    command = np.where(np.cumsum(rng.random(rows) < 0.08) % 2, -1.0, 1.0)
    samples = command[np.searchsorted(ticks, np.arange(ticks[-1] + 1), side="right") - 1]
    return ticks * STEP / FINE, command, answer(samples, STEP / FINE)[ticks]


def run_of(u: np.ndarray, y: np.ndarray, **options: object) -> ftlm.Run:
    return ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, step=STEP, **options)


def noisy(seed: int, share: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """A command and its answer with white noise."""
    _, u, y = record(seed)
    return u, y + share * np.std(y) * np.random.default_rng(seed + 100).standard_normal(y.size)


def near_truth(found: ftlm.Identification, sigmas: float = 4.0) -> None:
    for name, true in TRUTH.items():
        assert abs(found.coefficients[name] - true) < sigmas * found.standard_errors[name], name


# ---------------------------------------------------------------------------------------------- what was not read


def holes(y: np.ndarray, seed: int = 5) -> np.ndarray:
    """The same with 15 % of its values and a long stretch gone."""
    y = y.copy()
    y[np.random.default_rng(seed).random(y.size) < 0.15] = np.nan
    y[150:190] = np.nan
    return y


def test_missing_samples_are_refused_with_the_way_out() -> None:
    u, y = noisy(1)
    with pytest.raises(ftlm.DataError, match=r"signal 'y': NaN, first at row .* missing='weight'"):
        run_of(u, holes(y))
    gone = u.copy()
    gone[7] = np.nan
    for missing in ("refuse", "weight"):
        with pytest.raises(ftlm.DataError, match=r"signal 'u': NaN, first at row 7, 1 in all; .* missing='hold'"):
            run_of(gone, y, missing=missing)
    with pytest.raises(ftlm.DataError, match=r"missing='fill' is unknown"):
        run_of(u, y, missing="fill")
    first = u.copy()
    first[0] = np.nan
    with pytest.raises(ftlm.DataError, match=r"no value, and there is no earlier value to hold"):
        run_of(first, y, missing="hold")
    with pytest.raises(ftlm.DataError, match=r"2 values, but 3 are needed"):
        run_of(u, np.where(np.arange(y.size) < 2, y, np.nan), missing="weight")


def test_an_input_goes_on_as_it_behaves_between_rows() -> None:
    u = np.array([1.0, 2.0, np.nan, np.nan, 5.0])
    y = np.arange(5.0)
    assert run_of(u, y, missing="hold")["u"].tolist() == [1.0, 2.0, 2.0, 2.0, 5.0]
    linear = run_of(u, y, missing="hold", intersample={"u": "foh"})
    assert linear["u"].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert linear.warnings == (
        "input u: 2 of 5 rows have no value, the first is row 2; a straight line was drawn, which is a guess",
    )


def test_what_was_not_read_is_nan_and_said() -> None:
    u, y = noisy(1)
    run = run_of(u, holes(y), missing="weight")
    assert np.array_equal(run["y"], holes(y), equal_nan=True)
    assert np.array_equal(run.missing_samples["y"], np.isnan(holes(y)))
    assert run_of(u, y).missing_samples == {}
    (said,) = run.warnings
    assert said.startswith(f"output y: {np.isnan(holes(y)).sum()} of 400 rows have no value")
    assert np.array_equal(run.window(3.0, 9.0)["y"], holes(y)[30:90], equal_nan=True)
    assert len(run.advice()) == len(
        ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": interpolate_gaps(run["y"])}, step=STEP).advice()
    )


def test_missing_samples_weigh_nothing() -> None:
    """A fit to what is there is that of a naive sum over what is there."""
    u, y = noisy(2)
    run = run_of(u, holes(y), missing="weight")
    problem = FreeProblem.of(ftlm.equation(FREE, initial="rest"))
    kept = ~np.isnan(run["y"])[1:-1]
    point = Iterate([], [-0.7, -3.9, 4.1], "here", {})
    part, whole = (Objective(problem, [r], [50.0]).minimize(point, 1) for r in (run, run_of(u, y)))
    known, every = np.asarray(part.outcome["residuals"]), np.asarray(whole.outcome["residuals"])
    np.testing.assert_allclose(known[kept], every[kept], rtol=0, atol=1e-12)
    assert np.all(known[~kept] == 0.0)
    assert part.outcome["cost"] == pytest.approx(0.5 * np.sum(every[kept] ** 2), rel=1e-12)
    jacobian = np.asarray(part.outcome["jacobian"])
    assert np.all(jacobian[:, ~kept] == 0.0)
    np.testing.assert_allclose(jacobian[:, kept], np.asarray(whole.outcome["jacobian"])[:, kept], rtol=1e-12)


def test_what_stood_in_a_gap_changes_nothing_and_all_figures_count_what_is_there() -> None:
    u, y = noisy(3)
    gaps = np.isnan(holes(y))
    found = ftlm.identify(run_of(u, holes(y), missing="weight"), ftlm.equation(FREE))
    near_truth(found)
    count = int(np.sum(~gaps[1:-1]))
    assert found.information is not None
    assert found.information.sample_count == count
    assert found.joint is not None
    assert found.joint.samples == count
    # The figures of the free run by hand, on what was read.
    simulated = found.model.simulate(run_of(u, y))["y"]
    read = y[~gaps]
    fit = 100 * (1 - np.linalg.norm(read - simulated[~gaps]) / np.linalg.norm(read - read.mean()))
    assert found.fit["y"] == pytest.approx(fit, abs=1e-4)
    assert found.joint.noise["y"] == pytest.approx(np.sqrt(np.mean((read - simulated[~gaps]) ** 2)), rel=0.01)
    assert found.residuals is not None
    assert found.residuals.passed
    assert np.isnan(found.equation_error["y"].nr)
    assert "y has no equation error: some of its samples are missing" in str(found.comparison)
    document = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert document["equation_error"]["y"]["fit"] is None
    # A gap costs precision, and no more.
    whole = ftlm.identify(run_of(u, y), ftlm.equation(FREE))
    for name, error in whole.standard_errors.items():
        assert 1.0 < found.standard_errors[name] / error < 1.6


def test_methods_that_cannot_leave_samples_out_refuse_them() -> None:
    u, y = noisy(1)
    run = run_of(u, holes(y), missing="weight")
    for method in ("instrumental-variables", "least-squares", "multi-innovation"):
        with pytest.raises(ftlm.DataError, match=r"output 'y' of run 'run' has no value in .* method='output-error'"):
            ftlm.identify(run, ftlm.equation(FREE), method=method)
    with pytest.raises(ftlm.DataError, match=r"requires all samples"):
        ftlm.search_orders(run, ftlm.equation("D^alpha y = a y + b u"))
    pair = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"x": holes(y), "y": y}, step=STEP, missing="weight")
    driven = ftlm.equation("D^2 y = c D y + a y + b x")
    with pytest.raises(ftlm.DataError, match=r"signal 'x' .* enters the equation of y as measured"):
        ftlm.identify(pair, driven)


def test_whiteness_with_gaps_keeps_its_level() -> None:
    rng = np.random.default_rng(9)
    passed = [is_white(holes(rng.standard_normal(600), seed)) for seed in range(150)]
    assert np.mean(passed) > 0.95
    colour = lfilter([1.0], [1.0, -0.5], rng.standard_normal(600))
    assert not is_white(holes(colour))
    values = rng.standard_normal(200)
    expected = [np.mean(values[k:] * values[: 200 - k]) for k in range(4)]
    found, pairs = autocovariances([values - 0.0 * values.mean()], 3)
    assert found == pytest.approx(expected, abs=0.02)
    assert pairs.tolist() == [200, 199, 198, 197]


def test_rows_that_a_regular_time_lacks_are_missing(tmp_path) -> None:
    u, y = noisy(4)
    kept = np.ones(ROWS, bool)
    kept[[30, 31, 90, 200]] = False
    t = np.arange(ROWS) * STEP
    given = {"outputs": {"y": y[kept]}, "time": t[kept]}
    words = r"gap of 0.3 s .* use missing='weight'; .* no input changed there, missing='hold'"
    with pytest.raises(ftlm.DataError, match=words):
        ftlm.Run.from_arrays(inputs={"u": u[kept]}, **given)
    with pytest.raises(ftlm.DataError, match=r"4 rows are missing in a regular grid of 0.1 s, the first before row 30"):
        ftlm.Run.from_arrays(inputs={"u": u[kept]}, missing="weight", **given)
    run = ftlm.Run.from_arrays(inputs={"u": u[kept]}, missing="hold", **given)
    assert (run.length, run.step) == (ROWS, STEP)
    assert np.flatnonzero(run.missing_samples["y"]).tolist() == [30, 31, 90, 200]
    assert run["u"][30] == run["u"][31] == u[29]
    assert any("its last value was held, which is a guess" in w for w in run.warnings)
    # Written and read again, what is missing is still missing.
    run.to_csv(tmp_path / "run.csv")
    again = ftlm.load(tmp_path / "run.csv")
    assert np.array_equal(again["y"], run["y"], equal_nan=True)


def test_places_on_a_grid_with_holes() -> None:
    places = np.array([0, 1, 2, 5, 6, 9, 400, 401])
    found = grid_positions(3.0 + 0.0033333 * places)
    assert found is not None
    assert found[0].tolist() == places.tolist()
    assert found[1] == pytest.approx(0.0033333, rel=1e-9)
    assert grid_positions(np.array([0.0, 0.1, 0.25, 0.3])) is None


def test_empty_cells_may_be_missing(tmp_path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,u,y\n0,1,0\n0.1,1,\n0.2,,2\n0.3,0,3\n0.4,0,4\n")
    columns = {"inputs": ["u"], "outputs": ["y"]}
    with pytest.raises(
        ftlm.DataError,
        match=r"column 'u', line 4: empty cell, .* missing='weight' \(outputs and times\) or missing='hold'",
    ):
        ftlm.load(path, **columns)
    with pytest.raises(ftlm.DataError, match=r"column 'u', line 4: empty cell"):
        ftlm.load(path, missing="weight", **columns)
    run = ftlm.load(path, missing="hold", **columns)
    assert run["u"].tolist() == [1.0, 1.0, 1.0, 0.0, 0.0]
    assert np.flatnonzero(np.isnan(run["y"])).tolist() == [1]
    path.write_text("t,u,y\n0,1,0\n0.1,1,off\n0.2,0,2\n")
    with pytest.raises(ftlm.DataError, match=r"'off' is not a number"):
        ftlm.load(path, missing="hold", **columns)


# ------------------------------------------------------------------------------------------- times of their own


def irregular(seed: int, share: float = 0.0, **options: object) -> tuple[ftlm.Run, np.ndarray]:
    """A run whose rows jitter by 30 % of a step, and the exact answer at its rows."""
    t, u, y = record(seed, 0.3)
    noise = share * np.std(y) * np.random.default_rng(seed + 100).standard_normal(y.size)
    options = {"time": t, "resample": STEP, **options}
    return ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y + noise}, **options), y


def test_readings_keep_what_was_read() -> None:
    run, y = irregular(1)
    t, u, _ = record(1, 0.3)
    assert run.nonuniform_samples is not None
    assert np.array_equal(run.nonuniform_samples.times, t)
    assert np.array_equal(run.nonuniform_samples.data["y"], y)
    assert np.array_equal(run.nonuniform_samples.data["u"], u)
    assert "outputs at their original times in output-error fits" in run.warnings[0]
    regular = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, step=STEP, resample=0.2)
    assert regular.nonuniform_samples is None
    part = run.window(5.0, 20.0)
    assert part.nonuniform_samples is not None
    inside = (t >= 5.0) & (t <= 20.0)
    np.testing.assert_allclose(part.nonuniform_samples.data["y"][1:][: inside.sum()], y[inside])
    assert part.nonuniform_samples.data["u"][0] == u[np.searchsorted(t, 5.0) - 1]
    assert run.rename({"y": "z"}).nonuniform_samples.data.keys() == {"u", "z"}
    assert np.array_equal(run.resample(0.05).nonuniform_samples.data["y"], y)
    np.testing.assert_allclose(run.detrend().nonuniform_samples.data["y"], y - run["y"].mean(), atol=1e-12)


@pytest.mark.parametrize(("every", "error"), [(2, 8e-3), (8, 5e-4), (16, 1.2e-4)])
def test_readings_of_a_free_run_are_those_of_the_state_space(every: int, error: float) -> None:
    run, y = irregular(2)
    times = run.nonuniform_samples.times[run.nonuniform_samples.indices_within(run.duration)]
    found, _ = simulate_samples(ftlm.Model(ftlm.equation(WORDS)), run, every, {}, times)
    assert np.abs(found[0] - y[: times.size]).max() < error * np.std(y)


def test_readings_extrapolated_in_the_step_are_exact() -> None:
    run, y = irregular(3)
    (free,) = simulate_runs(ftlm.Model(ftlm.equation(WORDS)), [run])
    assert np.abs(free.outputs[0] - y[: free.outputs.shape[1]]).max() < 1e-6 * np.std(y)


@pytest.mark.parametrize("words", ["D^0.7 y = -2 y + 3 u + 0.5 D^0.7 u", "D^1.6 y = -0.5 D^0.6 y - 4 y + 4 u"])
def test_readings_on_a_grid_are_the_samples_there(words: str) -> None:
    """The same run as a grid has it and as readings at those very times."""
    _, u, _ = record(4)
    model = ftlm.Model(ftlm.equation(words))
    run = run_of(u, 0 * u + np.arange(u.size))
    times = run.time
    expected = model.simulate(run)["y"]
    found = [simulate_samples(model, run, every, {}, times)[0][0] for every in (8, 16)]
    moved = np.abs((4 * found[1] - found[0]) / 3 - expected).max()
    assert moved < 2e-3 * np.std(expected)
    assert np.abs(found[1] - expected).max() < 4e-3 * np.std(expected)


def test_the_slope_at_times_of_their_own_is_that_of_the_residuals() -> None:
    run, _ = irregular(5, 0.01)
    structure = ftlm.equation("D^alpha y = c D^nu y + a y + b u + d D^alpha u", initial="rest")
    problem = FreeProblem.of(structure)
    grid = Objective(problem, [run], [30.0], pulses_per_sample=2)

    def at(values: np.ndarray) -> dict[str, object]:
        orders, coefficients, _ = problem.split(values.tolist())
        return grid.minimize(Iterate(orders, coefficients, "here", {}), 1).outcome

    here = np.array([1.9, 0.9, -0.8, -4.0, 4.0, 0.3])
    slopes = np.asarray(at(here)["jacobian"])
    for i in range(here.size):
        shift = np.eye(here.size)[i] * 1e-5
        naive = (np.asarray(at(here + shift)["residuals"]) - np.asarray(at(here - shift)["residuals"])) / 2e-5
        np.testing.assert_allclose(slopes[i], naive, atol=2e-5 * np.abs(naive).max())


def test_corners_are_those_of_the_definition() -> None:
    """A reading from exact pulse means, and what the corner adds, is the integral of the jump itself."""
    m, h, eta = 40, 0.25, 0.7
    jumps = np.array([1.3, 4.0, 7.75])
    sizes = np.array([1.0, -2.0, 0.5])
    places = np.linspace(0.0, 12.0, 97)
    edges = np.arange(m + 1)
    integrals = np.array([np.sum(sizes * np.clip(e - jumps, 0, None)) for e in edges])
    means = np.diff(integrals)
    response = (
        h**eta
        * np.array(
            [
                sum(
                    v * np.sum(np.diff([np.clip(x - k, 0, None) ** (eta + 1) for x in (n, n + 1)]))
                    for k, v in enumerate(np.diff(means, prepend=0.0))
                    if k <= n
                )
                for n in range(m)
            ]
        )
        / 1.5446858458505939
    )
    read = _core.interpolate_samples(response[None], places)[0]
    read += _core.kink_correction(m, places, (jumps, sizes), eta, h)
    exact = [np.sum(sizes * np.clip(p - jumps, 0, None) ** eta) * h**eta / gamma(eta + 1) for p in places]
    assert gamma(eta + 2) == pytest.approx(1.5446858458505939)
    near = np.array([np.min(np.abs(p - jumps)) < 14 for p in places])
    np.testing.assert_allclose(read[near], np.array(exact)[near], atol=2e-3)


@pytest.mark.parametrize("kind", ["zoh", "foh"])
@pytest.mark.parametrize("delay", [0.0, 0.137])
def test_means_of_irregular_inputs_are_integrals(kind: str, delay: float) -> None:
    rng = np.random.default_rng(8)
    times = np.append(0.0, np.cumsum(rng.uniform(0.05, 0.3, 30)))
    values = rng.standard_normal(31)
    duration, m = 5.0, 64
    t = (np.arange(m * 4000) + 0.5) * duration / (m * 4000)
    own, known = (times + delay, values) if delay == 0.0 else (np.append(0.0, times + delay), np.append(0.4, values))
    found = _core.nonuniform_means(own, known, m, duration / m, kind == "zoh")
    there = known[np.searchsorted(own, t, side="right") - 1] if kind == "zoh" else np.interp(t, own, known)
    np.testing.assert_allclose(found, there.reshape(m, -1).mean(axis=1), atol=2e-3)


def test_a_run_of_irregular_rows_is_identified_as_a_regular_one() -> None:
    run, _ = irregular(6, 0.01)
    found = ftlm.identify(run, ftlm.equation(FREE))
    near_truth(found)
    assert found.residuals is not None
    assert found.residuals.passed
    assert found.fit["y"] > 98.8
    t = record(6, 0.3)[0]
    assert np.array_equal(found.comparison.times[0], t[t <= run.duration])
    assert found.comparison.measured["y"][0].size == found.comparison.times[0].size
    assert found.model.compare(run).fit["y"] == pytest.approx(found.fit["y"], abs=1e-9)
    # A third of the outputs gone as well: the same mechanism serves.
    u, part = run.nonuniform_samples.data["u"], run.nonuniform_samples.data["y"].copy()
    part[::3] = np.nan
    both = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": part}, time=t, resample=STEP, missing="weight")
    fewer = ftlm.identify(both, ftlm.equation(FREE))
    near_truth(fewer)
    assert fewer.joint is not None
    assert fewer.joint.samples == pytest.approx(2 / 3 * ROWS, abs=4)


def test_a_known_delay_is_honoured_and_a_free_one_says_what_it_costs() -> None:
    t, u, y = record(7, 0.3)
    late = np.searchsorted(t, t[-1] - 0.25)
    run = ftlm.Run.from_arrays(
        inputs={"u": u[:late]}, outputs={"y": np.interp(t[:late] - 0.2, t, y, left=0.0)}, time=t[:late], resample=STEP
    )
    known = ftlm.identify(run, ftlm.equation(FREE, delay={"u": 0.2}))
    assert known.fit["y"] > 99
    free = ftlm.identify(run, ftlm.equation(FREE, delay={"u": (0.1, 0.3)}))
    assert free.delays["u"] == pytest.approx(0.2, abs=0.02)
    assert any("outputs were interpolated linearly" in w for w in free.warnings)
    assert not any("outputs were interpolated linearly" in w for w in known.warnings)


def test_further_outputs_are_on_the_grid() -> None:
    run, _ = irregular(1)
    more = run.with_outputs({"z": np.arange(float(run.length))})
    assert more.outputs == ("y", "z")
    assert more["z"][7] == 7.0
    assert more.nonuniform_samples is not None
    assert more.nonuniform_samples.data["z"].size == more.nonuniform_samples.times.size
    with pytest.raises(ftlm.DataError, match=r"'u' is an input"):
        run.with_outputs({"u": np.zeros(run.length)})
    with pytest.raises(ftlm.DataError, match=r"rows where"):
        run.with_outputs({"z": np.zeros(3)})


# ------------------------------------------------------------------------------------------------------- outliers


def struck(seed: int) -> ftlm.Run:
    """1 % noise, and every hundredth sample off by as much as the output moves."""
    u, y = noisy(seed)
    rng = np.random.default_rng(seed + 200)
    rows = rng.choice(np.arange(1, ROWS - 1), 4, replace=False)
    y[rows] += np.std(y) * rng.choice([-1.5, 1.5], 4)
    return run_of(u, y)


def test_outliers_are_named_with_the_way_out_and_huber_ignores_them() -> None:
    run = struck(1)
    plain = ftlm.identify(run, ftlm.equation(FREE))
    (said,) = [w for w in plain.warnings if "huber" in w]
    assert said.startswith(
        "4 of 398 residuals of y lie beyond 5 times the usual deviation and contribute 99 % of the sum of squares, "
    )
    assert "first at row " in said
    robust = ftlm.identify(run, ftlm.equation(FREE), method=ftlm.OutputError(loss="huber"))
    near_truth(robust)
    for name, error in plain.standard_errors.items():
        assert robust.standard_errors[name] < 0.3 * error
    assert not [w for w in robust.warnings if "huber" in w]
    assert robust.settings["loss"] == "huber"
    assert robust.settings["outliers"] == 4
    assert (
        f"loss: huber ({robust.settings['downweighted_count']} of 398 residuals down-weighted, 4 of them"
        in robust.details()
    )
    # The noise is that of the usual samples, and the figures are those of all.
    y = noisy(1)[1]
    assert robust.joint.noise["y"] == pytest.approx(0.01 * np.std(y), rel=0.15)
    assert robust.fit["y"] < 90


def test_one_outlier_that_holds_most_of_the_squares_is_named() -> None:
    u, y = noisy(3)
    y[150] += 30 * np.std(y)
    (said,) = [w for w in ftlm.identify(run_of(u, y), ftlm.equation(FREE)).warnings if "huber" in w]
    assert said.startswith(
        "1 of 398 residuals of y lies beyond 5 times the usual deviation and contributes 100 % of the sum of squares"
    )
    # One of four deviations more is not worth a word.
    u, y = noisy(3)
    y[150] += 0.06 * np.std(y)
    assert not [w for w in ftlm.identify(run_of(u, y), ftlm.equation(FREE)).warnings if "huber" in w]


def test_the_excess_of_a_smaller_model_is_chi_squared_whatever_a_few_outliers_are() -> None:
    """Eight numbers that explain nothing, fitted by SciPy's least squares under Huber's loss."""
    excess = []
    for seed in range(60):
        rng = np.random.default_rng([77, seed])
        columns, noise = rng.standard_normal((400, 8)), rng.standard_normal(400)
        noise[:2] += 1000.0
        scale = float(np.median(np.abs(noise))) / MAD_OVER_SIGMA
        fit = least_squares(
            lambda x, c=columns, e=noise: e - c @ x, np.zeros(8), loss="huber", f_scale=HUBER_THRESHOLD * scale
        )
        excess.append(huber_excess(noise, noise - columns @ fit.x))
    # Mean and variance of chi-squared of 8 degrees are 8 and 16.
    assert abs(np.mean(excess) - 8.0) < 4 * np.sqrt(16 / 60)
    assert 8 < np.var(excess) < 32
    assert huber_excess(np.full(5, np.inf), np.ones(5)) == np.inf


def test_huber_is_the_minimum_of_its_loss() -> None:
    """No small step in any direction lowers the sum of Huber's losses over the scale found."""
    run = struck(2)
    structure = ftlm.equation(FREE, initial="rest")
    # On one grid: an estimate extrapolated to step 0 is the minimum of none.
    joint = fit_output_error([run], structure, loss="huber", refine=False)
    problem = FreeProblem.of(structure)
    grid = Objective(problem, [run], [1.0 / joint.noise["y"]], joint.refinement)

    def loss(values: np.ndarray) -> float:
        r = np.abs(np.asarray(grid.minimize(Iterate([], values.tolist(), "", {}), 1).outcome["residuals"]))
        return float(np.sum(np.where(r <= 1.345, 0.5 * r**2, 1.345 * r - 0.5 * 1.345**2)))

    best, errors = joint.values, np.array(list(joint.standard_errors.values()))
    steps = np.linspace(-0.3, 0.3, 25)
    for i in range(3):
        along = [loss(best + x * errors[i] * np.eye(3)[i]) for x in steps]
        assert abs(steps[int(np.argmin(along))]) < 0.04
    plain = fit_output_error([run], structure, refine=False)
    assert loss(best) < loss(plain.values) - 0.5


def test_without_outliers_huber_is_nearly_as_sure_as_squares() -> None:
    u, y = noisy(3)
    plain = ftlm.identify(run_of(u, y), ftlm.equation(FREE))
    robust = ftlm.identify(run_of(u, y), ftlm.equation(FREE), method=ftlm.OutputError(loss="huber"))
    assert not [w for w in plain.warnings if "huber" in w]
    for name, error in plain.standard_errors.items():
        assert robust.standard_errors[name] == pytest.approx(1.026 * error, rel=0.12)
        assert abs(robust.coefficients[name] - plain.coefficients[name]) < error


def test_huber_belongs_to_output_error() -> None:
    u, y = noisy(1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'loss'"):
        ftlm.LeastSquares(loss="huber")  # type: ignore[call-arg]
    with pytest.raises(ftlm.ModelError, match=r"loss = 'l1' is not known"):
        ftlm.identify(run_of(u, y), ftlm.equation(FREE), method=ftlm.OutputError(loss="l1"))


# -------------------------------------------------------------------------------------------- colour, coarse steps


def test_the_covariance_of_colour_is_that_of_its_autocovariances() -> None:
    """Linear answers to noise of 0.9 a sample, beside the scatter of two thousand of them."""
    rng = np.random.default_rng(4)
    count = 500
    t = np.arange(count) / count
    regressors = np.stack([np.ones(count), t, np.sin(40 * t)])
    inverse = np.linalg.inv(regressors @ regressors.T) @ regressors
    colour = lfilter([1.0], [1.0, -0.9], rng.standard_normal((2000, count + 300)))[:, 300:]
    exact = np.cov(colour @ inverse.T, rowvar=False)
    told = []
    for noise in colour[:60]:
        left = noise - regressors.T @ (inverse @ noise)
        told.append(np.diag(covariance_of(regressors, [left], float(left @ left))))
    # Sums over lags alone leave less than 0.75 of it.
    ratio = np.mean(told, axis=0) / np.diag(exact)
    assert np.all((ratio > 0.85) & (ratio < 1.4)), ratio
    through, power = _core.whitening_filter([colour[0]], 10)
    assert through[1] == pytest.approx(-0.9, abs=0.08)
    assert power == pytest.approx(1.0, abs=0.2)


def test_coarse_steps_of_an_output_are_named() -> None:
    u, y = noisy(5, 0.001)
    step = 0.15 * np.std(y)
    found = ftlm.identify(run_of(u, step * np.round(y / step)), ftlm.equation(FREE))
    assert [w for w in found.warnings if w.startswith(f"y is quantized in steps of {step:.3g}")]
    fine = ftlm.identify(run_of(u, 1e-4 * np.round(y / 1e-4)), ftlm.equation(FREE))
    assert not [w for w in fine.warnings if "quantized" in w]
    assert quantization_step(np.array([0.0, 0.3, 0.9, 1.5])) == pytest.approx(0.3)
    assert quantization_step(np.random.default_rng(1).standard_normal(500)) == 0.0
    assert quantization_step(np.ones(4)) == 0.0


@pytest.mark.parametrize("rows", [100, 400, 2500, 100_000])
def test_a_quantization_step_is_found_only_where_samples_are_multiples_of_it(rows) -> None:
    for seed in range(100 if rows < 100_000 else 10):
        noise = np.random.default_rng(seed).standard_normal(rows)
        for samples in (noise, noise.astype(np.float32).astype(float), 5.0 + np.sin(0.01 * np.arange(rows)) + noise):
            assert quantization_step(samples) == 0.0
    motion = np.sin(0.01 * np.arange(rows)) + 0.01 * np.cumsum(noise)
    for step in (2 * np.pi / 512, 2 * np.pi / 4096, 2 * np.pi / 65536, 1e-3, 10 / 4096):
        for offset in (0.0, 1.2345, 100.0):
            for scale in (1.0, np.pi / 180, 1e-3):
                found = quantization_step(scale * (np.round(motion / step) * step + offset))
                assert found == pytest.approx(scale * step, rel=1e-6)
    single = (np.round(motion / 0.01) * 0.01 + 1.2345).astype(np.float32).astype(float)
    assert quantization_step(single) == pytest.approx(0.01, rel=1e-5)


def test_missing_times_are_interpolated(tmp_path) -> None:
    u, y = noisy(4)
    t = np.arange(ROWS) * STEP
    t[[30, 31, 90]] = np.nan
    given = {"inputs": {"u": u}, "outputs": {"y": y}, "time": t}
    with pytest.raises(ftlm.DataError, match="time: NaN, first at row 30, 3 in all"):
        ftlm.Run.from_arrays(**given)
    run = ftlm.Run.from_arrays(**given, missing="weight")
    assert (run.length, run.step) == (ROWS, pytest.approx(STEP))
    assert any("3 of 400 rows have no value, the first is row 30; they were inter" in w for w in run.warnings)
    path = tmp_path / "run.csv"
    rows = "\n".join(f"{'' if np.isnan(a) else a},{b},{c}" for a, b, c in zip(t, u, y, strict=True))
    path.write_text(f"t,u,y\n{rows}\n")
    for policy in ("weight", "hold"):
        np.testing.assert_array_equal(ftlm.load(path, inputs=["u"], outputs=["y"], missing=policy)["y"], y)
    t[0] = np.nan
    with pytest.raises(ftlm.DataError, match="time: NaN, first at row 0"):
        ftlm.Run.from_arrays(**given, missing="weight")


def test_rows_added_to_a_gap_with_their_inputs_leave_the_model_unbiased() -> None:
    u, y = noisy(4)
    y[100:150] = np.nan
    found = ftlm.identify(run_of(u, y, missing="weight"), ftlm.equation(FREE))
    assert all(abs(found.coefficients[n] - v) < 4 * found.standard_errors[n] for n, v in TRUTH.items())


@pytest.mark.slow
@pytest.mark.parametrize(
    "make", [lambda s: irregular(s, 0.01)[0], lambda s: run_of(noisy(s)[0], holes(noisy(s)[1]), missing="weight")]
)
def test_intervals_cover_with_what_is_missing_and_what_jitters(make) -> None:
    inside = []
    for seed in range(20):
        found = ftlm.identify(make(seed), ftlm.equation(FREE))
        inside.append([abs(found.coefficients[n] - v) < NORMAL_95 * found.standard_errors[n] for n, v in TRUTH.items()])
    assert np.mean(inside) > 0.85
