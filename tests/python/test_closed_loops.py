"""Closed loops: found in the residuals, told, and cured by the reference as instrument."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import butter, cont2discrete, lfilter
from typer.testing import CliRunner

import ftlm
import loops
from ftlm import cli
from ftlm.estimation.closed_loop import instrument_runs
from ftlm.validation.feedback import feedback_test

STRUCTURE = ftlm.equation("D^alpha y = -a y + b u", initial="rest")


def loop_codes(found: ftlm.Identification) -> list[str]:
    return [f.code for f in found.findings if f.code in ("loop_found", "loop_harmless")]


@pytest.mark.parametrize(
    ("kind", "state", "code"),
    [
        ("open, white", "command", None),
        ("open, coloured", "command", None),
        ("closed, white", "found", "loop_harmless"),
        ("closed, coloured", "found", "loop_harmless"),
        ("closed, coloured, strong", "found", "loop_found"),
    ],
)
def test_a_loop_is_found_and_weighs_what_it_moves(kind, state, code):
    found = ftlm.identify(loops.loop(kind, 1, rows=1000), STRUCTURE, method=ftlm.OutputError(intervals="quadratic"))
    tests = found.residuals.outputs["y"]
    assert tests.feedback_tests["u"].state == state
    assert loop_codes(found) == ([] if code is None else [code])
    assert ("closed loop of u around y" in found.details()) == (state == "found")
    bias = tests.feedback_tests["u"].bias
    assert bias is None if code is None else (bias > 1) == (code == "loop_found")
    # What a controller does at once is not taken for what the model lacks.
    assert not tests.inputs["u"].failed
    if code == "loop_found":
        (said,) = [f for f in found.findings if f.code == code]
        assert said.text.startswith("y: u depends on past values of y")
        assert "name it with reference=" in said.text
        assert "name the reference signal with reference=" in said.remedy


#: Plants as numerator and denominator in s, of loops.STEP; inputs and noises of open loops by name.
PLANTS = {
    "lag": ([2.0], [0.5, 1.0]),
    "swing": ([100.0], [1.0, 0.4, 100.0]),
    "integrator": ([1.0], [0.3, 1.0, 0.02]),
    "two modes": ([364.0, 101.2, 61_760.0], [1.0, 1.3, 964.4, 501.2, 57_600.0]),
}
INPUTS = (
    *("white", "held", "correlated", "low-pass", "PRBS", "telegraph", "chirp"),
    *("multisine", "sine and noise", "walk", "bursts", "quantized", "cubed", "uneven"),
)
NOISES = ("white", "strong", "correlated", "walk", "ringing", "heavy")


def filtered(b, a, x):
    """Output of a discrete filter, by its impulse response."""
    impulse = np.zeros(x.size)
    impulse[0] = 1.0
    return loops.convolved(lfilter(b, a, impulse), x)


def open_input(kind, rows, rng):
    """An input that is drawn before anything is simulated."""
    t, white = np.arange(rows) * loops.STEP, rng.standard_normal(rows)
    match kind:
        case "white":
            return white
        case "held":
            return np.repeat(rng.uniform(-1, 1, rows // 5 + 1), 5)[:rows]
        case "correlated":
            return lfilter([1], [1, -0.9], white)
        case "low-pass":
            return lfilter(*butter(3, 0.1), white)
        case "PRBS":
            return np.repeat(rng.choice([-1.0, 1.0], rows // 10 + 1), 10)[:rows]
        case "telegraph":
            return np.cumprod(np.where(rng.random(rows) < 0.05, -1.0, 1.0))
        case "chirp":
            return np.sin(0.2 * t + 0.15 * t**2)
        case "multisine":
            return sum(np.sin(w * t + rng.uniform(0, 6)) for w in np.geomspace(0.4, 20, 12))
        case "sine and noise":
            return np.sin(3 * t) + 0.3 * white
        case "walk":
            return np.cumsum(white)
        case "bursts":
            return white * (np.sin(np.arange(rows) / 120) > 0) + 0.05 * rng.standard_normal(rows)
        case "quantized":
            return np.round(8 * lfilter(*butter(2, 0.2), white)) / 8
        case "cubed":
            return white**3
    return np.repeat(rng.uniform(-1, 1, rows), rng.integers(2, 12, rows))[:rows]


def open_noise(kind, rows, rng):
    """Noise of a sensor, as a share of the output's deviation."""
    white = rng.standard_normal(rows)
    match kind:
        case "white":
            return 0.02 * white
        case "strong":
            return 0.2 * white
        case "correlated":
            return 0.1 * loops.coloured(rng, rows, 0.9)
        case "walk":
            walk = np.cumsum(white)
            return 0.1 * walk / np.std(walk)
        case "ringing":
            return 0.1 * lfilter([0.3], [1, -1.9 * np.cos(0.3), 0.9025], white)
    return 0.05 * rng.standard_t(2.5, rows)


def open_records(seeds, rows=1000):
    """Residuals of a right model, of one that is short of all but five lags, and outputs themselves, in open loops."""
    for plant, (numerator, denominator) in PLANTS.items():
        b, a, _ = cont2discrete((numerator, denominator), loops.STEP)[:3]
        for seed, (i, kind), (k, noise) in itertools.product(seeds, enumerate(INPUTS), enumerate(NOISES)):
            rng = np.random.default_rng([seed, len(plant), i, k])
            u = open_input(kind, rows, rng)
            clean = filtered(np.ravel(b), a, u)
            added = np.std(clean) * open_noise(noise, rows, rng)
            past = np.column_stack([np.concatenate([np.zeros(j), u[: rows - j]]) for j in range(1, 6)])
            y = clean + added
            short = y - past @ np.linalg.lstsq(past, y, rcond=None)[0]
            yield (plant, kind, noise, seed), (added, y, short)[(seed + k) % 3], u


def false_alarms(seeds, rows=1000):
    """Records of open loops in which feedback is found, and number of records."""
    found, count = [], 0
    for name, residuals, u in open_records(seeds, rows):
        count += 1
        found += [name] if feedback_test([residuals], [u]).has_feedback else []
    return found, count


def test_an_open_loop_is_not_called_closed():
    found, count = false_alarms([1], rows=600)
    assert len(found) <= 0.02 * count, found


@pytest.mark.slow
def test_false_alarms_and_power_of_the_feedback_test():
    found, count = false_alarms(range(10, 18))
    by_input = {kind: sum(name[1] == kind for name in found) / (count / len(INPUTS)) for kind in INPUTS}
    assert len(found) <= 0.01 * count
    assert max(by_input.values()) <= 0.04, by_input
    for kind in ("closed, coloured", "closed, coloured, biased", "closed, coloured, strong"):
        states = [fed(kind, seed).state for seed in range(10, 30)]
        # 20, 20 and 17 of 20 were found; the strong one answers least beside its noise.
        assert states.count("found") >= 0.8 * len(states), (kind, states)


def fed(kind, seed, **parts):
    """Feedback test on the noise of a loop itself."""
    run = loops.loop(kind, seed, **parts)
    pulse = np.diff(np.concatenate([[0.0], loops.step_response(run.length)]))
    noise = run["y"] - loops.convolved(pulse, run["u"])
    return feedback_test([noise], [run["u"]], [[run["r"]]])


def test_a_loop_is_found_beside_its_reference():
    for seed in range(4):
        assert fed("closed, coloured", seed).state == "found"
        assert fed("open, coloured", seed).state == "command"


def integral_loop(seed, gain, deviation, colour, every):
    """A lag of 0.5 s under an integral controller that reads it with noise: the input and the noise."""
    rng = np.random.default_rng([seed, 5])
    reference = np.repeat(rng.choice([-1.0, 1.0], loops.ROWS // every + 1), every)[: loops.ROWS]
    noise = deviation * loops.coloured(rng, loops.ROWS, colour)
    pole, y, collected = np.exp(-loops.STEP / 0.5), 0.0, 0.0
    u = np.zeros(loops.ROWS)
    for k in range(loops.ROWS):
        collected += gain * loops.STEP * (reference[k] - y - noise[k])
        u[k] = collected
        y = pole * y + (1 - pole) * collected
    return u, noise


@pytest.mark.parametrize(
    ("gain", "deviation", "colour", "every"),
    [(1.0, 0.1, 0.0, 100), (3.0, 0.1, 0.9, 100), (1.0, 0.02, 0.9, 100), (1.0, 0.1, 0.9, 2000), (0.2, 0.1, 0.9, 100)],
)
def test_an_integral_controller_is_no_command(gain, deviation, colour, every):
    # Its own past holds all that it answered before: the noise of the same row alone is new.
    for seed in range(3):
        u, noise = integral_loop(seed, gain, deviation, colour, every)
        assert feedback_test([noise], [u]).state in ("found", "undecided")


def test_several_short_runs_are_pooled():
    pulse = np.diff(np.concatenate([[0.0], loops.step_response(400)]))
    runs = [loops.loop("closed, coloured", seed, rows=400) for seed in range(4)]
    noise = [run["y"] - loops.convolved(pulse, run["u"]) for run in runs]
    inputs, references = [run["u"] for run in runs], [run["r"] for run in runs]
    alone = [feedback_test([e], [u], [[r]]).ratio for e, u, r in zip(noise, inputs, references, strict=True)]
    pooled = feedback_test(noise, inputs, [references])
    assert pooled.state == "found"
    assert pooled.ratio > max(alone)
    assert [v.size for v in pooled.response] == [400] * 4
    # A run too short for the test changes nothing.
    more = feedback_test([*noise, noise[0][:100]], [*inputs, inputs[0][:100]], [[*references, references[0][:100]]])
    assert more.ratio == pytest.approx(pooled.ratio)
    assert np.all(more.response[-1] == 0)


def test_two_inputs_beside_each_other():
    # The second input answers; the first was drawn beforehand and shares nothing with it.
    rng = np.random.default_rng(7)
    e = loops.coloured(rng, 1500, 0.8)
    u = rng.standard_normal(1500)
    v = 0.5 * rng.standard_normal(1500) - np.concatenate([[0.0, 0.0], e[:-2]])
    assert feedback_test([e], [u], [[v]]).state == "none"
    assert feedback_test([e], [v], [[u]]).state == "found"


@pytest.mark.parametrize(
    ("u", "state", "reason"),
    [
        (np.zeros(500), "undecided", "is constant"),
        (np.ones(100), "undecided", "runs of 100 rows; 150 are needed"),
        (np.sign(np.sin(np.arange(500) * 2 * np.pi / 50 + 0.1)), "command", "repeats itself exactly"),
        (np.repeat([0.0, 1.0, 0.5, 2.0, -1.0, 3.0, 0.2, -2.0, 0.7, 0.1], 50), "undecided", "changes"),
        (np.sign(np.random.default_rng(1).standard_normal(500)), "undecided", "a relay"),
        (np.sin(np.arange(500) * 0.1) + np.sin(np.arange(500) * 0.037), "command", "its own past determines it"),
    ],
)
def test_what_the_test_cannot_tell_it_says(u, state, reason):
    test = feedback_test([np.random.default_rng(2).standard_normal(u.size)], [u])
    assert test.state == state
    assert reason in test.reason
    assert json.loads(json.dumps(test.to_dict()))["state"] == state


@pytest.mark.slow
def test_the_reference_takes_the_bias_out():
    # Long runs, so that the bias shows beside the scatter.
    errors: dict[str, list[float]] = {"measured": [], "r": []}
    for seed in range(3):
        run = loops.loop("closed, coloured, biased", seed, rows=6000)
        for how, reference in (("measured", None), ("r", "r")):
            found = ftlm.identify(run, STRUCTURE, method=ftlm.OutputError(reference=reference))
            errors[how].append((found.coefficients["b"] - loops.TRUTH["b"]) / found.standard_errors["b"])
            assert loop_codes(found) == (["loop_found"] if how == "measured" else [])
            assert found.joint.converged
    assert abs(np.mean(errors["r"])) < 0.5 * abs(np.mean(errors["measured"]))


def test_a_noise_model_gives_the_least_prediction_errors():
    # The oracle: exact recursions of a lag, prediction errors by differences of lagged residuals, scipy's optimum.
    step, rows, rng = 0.1, 600, np.random.default_rng(3)
    u, noise, y = np.zeros(rows), 0.3 * loops.coloured(rng, rows, 0.9), np.zeros(rows)
    reference = np.repeat(rng.choice([-1.0, 1.0], rows // 20), 20)
    for k in range(rows - 1):
        u[k] = 4.0 * (reference[k] - y[k] - noise[k])
        y[k + 1] = np.exp(-step) * y[k] + 2.0 * (1.0 - np.exp(-step)) * u[k]
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u, "r": reference}, outputs={"y": y + noise})
    structure = ftlm.equation("D y = -a y + b u", initial="rest")

    def errors(p: np.ndarray) -> np.ndarray:
        simulated = lfilter([0.0, p[1] / p[0] * (1.0 - np.exp(-p[0] * step))], [1.0, -np.exp(-p[0] * step)], u)
        v = run["y"] - simulated
        # The last sample has a pulse on one side only.
        return (v[1:] - p[2] * v[:-1])[:-1]

    oracle = least_squares(errors, [1.0, 2.0, 0.9], x_scale=[1.0, 2.0, 1.0], xtol=1e-12, ftol=1e-12)
    spread = np.linalg.inv(oracle.jac.T @ oracle.jac) * 2.0 * oracle.cost / (rows - 2)
    found = ftlm.identify(run, structure, method=ftlm.OutputError(noise="ar"))
    (colour,) = found.settings["noise_model"]
    assert [found.coefficients["a"], found.coefficients["b"], -colour] == pytest.approx(list(oracle.x), rel=0.01)
    for k, name in enumerate("ab"):
        assert found.standard_errors[name] == pytest.approx(np.sqrt(spread[k, k]), rel=0.05)
        assert abs(found.coefficients[name] - (1.0, 2.0)[k]) < 3.0 * found.standard_errors[name]
    assert loop_codes(found) == []
    assert "noise: autoregression of order 1" in found.details().replace("\n", " ")
    with pytest.raises(ftlm.ModelError, match="noise='ar' has no profile"):
        found.profile("a")


@pytest.mark.parametrize(
    ("options", "words"),
    [({"reference": "r"}, "reference="), ({"intervals": "profile"}, "intervals="), ({"loss": "huber"}, "loss=")],
)
def test_a_noise_model_stands_alone(options, words):
    with pytest.raises(ftlm.ModelError, match=f"noise='ar' is not used with {words}"):
        ftlm.OutputError(noise="ar", **options)


def test_a_noise_model_is_of_one_linear_output():
    run = loops.loop("closed, coloured", 3, rows=200)
    method, two = ftlm.OutputError(noise="ar"), run.with_outputs({"z": run["y"]})
    with pytest.raises(ftlm.ModelError, match="supports one output, and the structure has y, z"):
        ftlm.identify(two, ftlm.equation("D y = -a y + b u; D z = -c z + d u"), method=method)
    with pytest.raises(ftlm.ModelError, match="requires a linear model"):
        ftlm.identify(run, ftlm.equation("D y = -a y + b u").with_limits(saturation={"u": (0.5, 1.0)}), method=method)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["open, coloured", "closed, coloured, biased", "closed, coloured, strong"])
def test_coverage_of_a_noise_model_beside_output_error_and_a_reference(kind):
    methods = {
        "white": ftlm.OutputError(intervals="quadratic"),
        "ar": ftlm.OutputError(noise="ar"),
        "reference": ftlm.OutputError(reference="r"),
    }
    apart: dict[str, list[list[float]]] = {name: [] for name in methods}
    for seed in range(20):
        run = loops.loop(kind, seed)
        for name, method in methods.items():
            found = ftlm.identify(run, STRUCTURE, method=method)
            errors = [found.parameter_values[n] - truth for n, truth in loops.TRUTH.items()]
            apart[name].append([e / found.standard_errors[n] for e, n in zip(errors, loops.TRUTH, strict=True)])
    covered = {name: float(np.mean(np.abs(v) < 1.96)) for name, v in apart.items()}
    print(kind, *(f"{name}: {100 * share:.0f} % within 95 % intervals" for name, share in covered.items()))
    assert covered["ar"] >= 0.85
    assert covered["ar"] >= covered["white"]


def test_residuals_are_orthogonal_to_what_follows_the_reference():
    # The oracle: sensitivities by differences of the exact step response's convolutions with the answer to r.
    run = loops.loop("closed, coloured", 3, rows=700)
    found = ftlm.identify(run, STRUCTURE, method=ftlm.OutputError(reference="r"))
    assert found.joint.converged
    values = {n: p.value for n, p in found.parameters.items()}
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
    run = loops.loop("closed, coloured", 2, rows=600)
    run.to_csv(tmp_path / "run.csv")
    words = ["identify", str(tmp_path / "run.csv"), "--structure", "D^alpha y = -a y + b u", "--initial", "rest"]
    words += ["--reference", "r", "--report", str(tmp_path / "r.html"), "--verbose"]
    said = CliRunner().invoke(cli.app, words)
    assert said.exit_code == 0, said.output
    assert "instrument: the part of the inputs that r explains" in said.output.replace("\n", " ")
    # The loop is known, so its colour is no reason.
    assert said.output.startswith("WITH CARE: the model was not validated on another run")
    assert "instrument: the part of the inputs that it explains" in (tmp_path / "r.html").read_text()


def test_a_weak_reference_is_named():
    # It hardly moves beside the noise that the loop feeds back.
    run = loops.loop("closed, coloured, integral", 0, rows=600)
    rng = np.random.default_rng(1)
    weak = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": run["u"], "r": np.repeat(rng.choice([-1.0, 1.0], 12), 50)}, outputs={"y": run["y"]}
    )
    found = ftlm.identify(weak, STRUCTURE, method=ftlm.OutputError(reference="r"))
    assert [w for w in found.warnings if "weak instrument" in w]


@pytest.mark.parametrize(
    ("reference", "error", "words"),
    [
        ("q", ftlm.DataError, "has no signal 'q'"),
        ("u", ftlm.ModelError, "is a signal of the model"),
        (3, ftlm.ModelError, "give the name of a signal"),
        ("still", ftlm.DataError, "is constant, so it explains no input"),
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
    for seed in range(2):
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


@pytest.mark.parametrize("color", [0.3, 0.9])
def test_a_controller_that_acts_in_the_same_row_is_no_missing_dynamics(color):
    """A PI controller that reads a sample and acts at once puts the noise of this sample into the input."""
    step, rate, gain, samples = 0.02, 1 / 0.6, 2.0, 600
    decay = np.exp(-rate * step)
    for seed in range(3):
        g = np.random.default_rng(seed)
        noise = 0.05 * lfilter([np.sqrt(1 - color**2)], [1, -color], g.standard_normal(samples + 200))[200:]
        u, y, state, integral = np.empty(samples), np.empty(samples), 0.0, 0.0
        for k in range(samples):
            y[k] = state + noise[k]
            error = (k >= 40) - y[k]
            integral += step * error / 0.42
            u[k] = 1.5 * (error + integral)
            state = decay * state + gain * (1 - decay) * u[k]
        run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y})
        found = ftlm.identify(run, ftlm.equation("D y = -a y + b u"))
        assert found.parameters["b"].value == pytest.approx(gain * rate, rel=0.2)
        codes = {f.code for f in found.findings}
        assert "moves_within_row" in codes
        assert not codes & {"dynamics_missing", "zero_fits", "residuals_not_white", "delay_fits", "lag_fits"}
