"""Closed loops: found in the residuals, told, and cured by the reference as instrument."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import f as fisher
from typer.testing import CliRunner

import ftlm
import loops
from ftlm import cli
from ftlm.estimation.closed_loop import instrument_runs
from ftlm.validation.residual_tests import feedback_test, past_regressors

STRUCTURE = ftlm.equation("D^alpha y = -a y + b u", initial="rest")


def loop_warnings(found: ftlm.Identification) -> list[str]:
    return [w for w in found.warnings if "closed loop" in w]


@pytest.mark.parametrize("kind", list(loops.KINDS))
def test_a_loop_is_found_and_an_open_one_is_not(kind):
    # Two seeds here; thirty in benches/RESULTS.md.
    closed, harmful = kind.startswith("closed"), kind.startswith("closed, coloured")
    for seed in range(2):
        found = ftlm.identify(loops.loop(kind, seed), STRUCTURE)
        assert found.residuals.outputs["y"].feedback == (("u",) if closed else ())
        assert bool(loop_warnings(found)) == harmful
        assert ("closed loop of u around y" in found.details()) == closed
        # What a controller does at once is not taken for what the model lacks.
        assert found.residuals.outputs["y"].inputs["u"].first == int(closed)


def test_the_warning_names_the_way_out():
    (said,) = loop_warnings(ftlm.identify(loops.loop("closed, coloured, integral", 1), STRUCTURE))
    assert "u answers" in said
    assert "name it with reference=" in said


def test_the_regression_is_that_of_dense_least_squares():
    # The oracle: F of two dense regressions over the same rows, one with and one without the future.
    rng = np.random.default_rng(4)
    noise, u = rng.standard_normal(400), rng.standard_normal(400)
    u[3:] += 0.4 * noise[:-3]
    test = feedback_test([noise], [u], [], direct=True)
    ends = []
    for horizon in (5, 25):
        rows = range(25, 400 - 25)
        past = [past_regressors(u, 0, 200)[k][25:375] for k in range(len(past_regressors(u, 0, 200)))]
        future = [[u[t + k] for t in rows] for k in range(1, horizon + 1)]
        target = noise[25:375]
        sums = []
        for columns in ([*past, np.ones(350)], [*past, np.ones(350), *future]):
            x = np.stack(columns, axis=1)
            sums.append((float(np.sum((target - x @ np.linalg.lstsq(x, target, rcond=None)[0]) ** 2)), x.shape[1]))
        degrees = 350 - sums[1][1]
        statistic = (sums[0][0] - sums[1][0]) / (sums[1][0] / degrees)
        ends.append((statistic / (horizon * fisher.ppf(1 - 0.005, horizon, degrees)), statistic))
    ratio, statistic = max(ends)
    assert test.has_feedback
    assert test.statistic == pytest.approx(statistic, rel=1e-9)
    assert test.statistic / test.limit == pytest.approx(ratio, rel=0.1)


@pytest.mark.parametrize("kind", ["square", "levels", "chirp", "multisine"])
def test_an_open_loop_with_a_wrong_model_is_not_called_closed(kind):
    found = []
    for seed in range(2):
        rng = np.random.default_rng([seed, 3])
        t = np.arange(loops.ROWS) * loops.STEP
        u = {
            "square": np.sign(np.sin(2 * np.pi * (t + 0.01) / 6)),
            "levels": np.repeat(rng.uniform(-1, 1, loops.ROWS // 25), 25),
            "chirp": np.sin(0.3 * t + 0.12 * t**2),
            "multisine": sum(np.sin(w * t + rng.uniform(0, 6)) for w in np.geomspace(0.3, 8, 8)),
        }[kind]
        y = loops.convolved(np.diff(u, prepend=0.0), loops.step_response())
        slow = loops.convolved(u, 0.3 * np.exp(-t / 8) * loops.STEP)
        noise = 0.1 * np.std(y) * loops.coloured(rng, loops.ROWS, 0.9)
        run = ftlm.Run.from_arrays(step=loops.STEP, inputs={"u": u}, outputs={"y": y + slow + noise})
        found += ftlm.identify(run, STRUCTURE).residuals.outputs["y"].feedback
    assert found == []


@pytest.mark.slow
def test_the_reference_takes_the_bias_out():
    # Long runs, so that the bias shows beside the scatter.
    errors: dict[str, list[float]] = {"measured": [], "r": []}
    for seed in range(3):
        run = loops.loop("closed, coloured, biased", seed, rows=6000)
        for how, reference in (("measured", None), ("r", "r")):
            found = ftlm.identify(run, STRUCTURE, method=ftlm.OutputError(reference=reference))
            errors[how].append((found.coefficients["b"] - loops.TRUTH["b"]) / found.standard_errors["b"])
            assert bool(loop_warnings(found)) == (how == "measured")
            assert found.fit.converged
    assert abs(np.mean(errors["r"])) < 0.5 * abs(np.mean(errors["measured"]))


def test_residuals_are_orthogonal_to_what_follows_the_reference():
    # The oracle: sensitivities by differences of the exact step response's convolutions with the answer to r.
    run = loops.loop("closed, coloured", 3)
    found = ftlm.identify(run, STRUCTURE, method=ftlm.OutputError(reference="r"))
    assert found.fit.converged
    values = found.parameter_values
    (answer,), _ = instrument_runs([run], STRUCTURE, "r")

    def free(u: np.ndarray, alpha: float, a: float, b: float) -> np.ndarray:
        t = np.arange(run.length) * loops.STEP
        return b / a * loops.convolved(np.diff(u, prepend=0.0), 1.0 - loops.relaxation(t, alpha, a))

    here = [values[n] for n in ("alpha", "a", "b")]
    missed = run["y"] - free(run["u"], *here)
    for k in range(3):
        there = list(here)
        there[k] *= 1.0 + 1e-5
        slope = free(answer["u"], *there) - free(answer["u"], *here)
        along = slope[1:-1] @ missed[1:-1] / (np.linalg.norm(slope[1:-1]) * np.linalg.norm(missed[1:-1]))
        assert abs(along) < 2e-3


def test_a_reference_is_told(tmp_path):
    run = loops.loop("closed, coloured", 2)
    run.to_csv(tmp_path / "run.csv")
    words = ["identify", str(tmp_path / "run.csv"), "--structure", "D^alpha y = -a y + b u", "--initial", "rest"]
    words += ["--reference", "r", "--report", str(tmp_path / "r.html"), "--verbose"]
    said = CliRunner().invoke(cli.app, words)
    assert said.exit_code == 0, said.output
    assert "instrument: what of the inputs follows r" in said.output.replace("\n", " ")
    # The loop is known, so its colour is no reason.
    assert said.output.startswith("WITH CARE: no run that it was not fitted to has been tried")
    assert "instrument: what of the inputs follows it" in (tmp_path / "r.html").read_text()


def test_a_weak_reference_is_named():
    # It hardly moves beside the noise that the loop feeds back.
    run = loops.loop("closed, coloured, integral", 0)
    rng = np.random.default_rng(1)
    weak = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": run["u"], "r": np.repeat(rng.choice([-1.0, 1.0], 30), 50)}, outputs={"y": run["y"]}
    )
    found = ftlm.identify(weak, STRUCTURE, method=ftlm.OutputError(reference="r"))
    assert [w for w in found.warnings if "weak instrument" in w]


@pytest.mark.parametrize(
    ("reference", "error", "words"),
    [
        ("q", ftlm.DataError, "has no signal 'q'"),
        ("u", ftlm.ModelError, "is a signal of the model"),
        (3, ftlm.ModelError, "not the name of a signal"),
        ("still", ftlm.DataError, "does not move"),
    ],
)
def test_what_is_no_reference_is_refused(reference, error, words):
    run = loops.loop("closed, white", 0)
    more = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": run["u"], "r": run["r"], "still": np.ones(run.length)}, outputs={"y": run["y"]}
    )
    with pytest.raises(error, match=words):
        ftlm.identify(more, STRUCTURE, method=ftlm.OutputError(reference=reference))


def test_instrumental_variables_count_the_error_of_their_orders():
    # The true order is on no lattice; errors at the order found alone covered one in three.
    held = []
    near = ftlm.order_grid(alpha=(1.5, 1.9))
    for seed in range(3):
        run = loops.open_run(seed, noise=0.05)
        found = ftlm.identify(run, STRUCTURE, method=ftlm.InstrumentalVariables(order_grid=near))
        truth = {**loops.TRUTH, "alpha": 1.73}
        held += [found.intervals[n][0] <= v <= found.intervals[n][1] for n, v in truth.items()]
        assert found.standard_errors["alpha"] >= 0.5 * abs(found.orders["alpha"] - 1.73)
        at_order = ftlm.identify(
            run, STRUCTURE.with_orders({"alpha": found.orders["alpha"]}), method="instrumental-variables"
        )
        assert found.standard_errors["a"] > at_order.standard_errors["a"]
    assert np.mean(held) >= 0.9
