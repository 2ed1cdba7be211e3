"""Missing dynamics are named, and told from colored noise: records by SciPy's exact discretization."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp

import ftlm
from ftlm.estimation import extensions
from slow_cases import slow_after

RATE = 0.4
#: Numerator and denominator of the plant, rows of delay of the input (negative: it was logged late), the finding.
MISSING = {
    "resonance": ([1.0], [1 / RATE**2, 0.4 / RATE, 1.0], 0, "lag_fits"),
    "lag": ([1.0], [0.3 / RATE**2, 1.3 / RATE, 1.0], 0, "lag_fits"),
    "fast lag": ([1.0], [0.1 / RATE**2, 1.1 / RATE, 1.0], 0, "lag_fits"),
    "feedthrough": ([0.3 / RATE, 1.0], [1 / RATE, 1.0], 0, "zero_fits"),
    "slow mode": ([11 / RATE, 1.0], [10 / RATE**2, 11 / RATE, 1.0], 0, "mode_fits"),
    "delay": ([1.0], [1 / RATE, 1.0], 5, "delay_fits"),
    "late log": ([1.0], [1 / RATE, 1.0], -1, "lead_fits"),
}
#: Inputs as they act on a first-order plant, and the finding.
ACTING = {
    "saturation": (lambda u: np.clip(u, -0.5, 0.5), "saturation_fits", 0.5),
    "dead zone": (lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.3, 0.0), "dead_zone_fits", 0.3),
    "curve": (lambda u: u + 0.5 * u**2, "square_fits", None),
}
CODES = {
    "dynamics_missing",
    "drift_fits",
    "level_missing",
    "offset_missing",
    "motion_missing",
    "friction_fits",
    "load_step_fits",
    "nonlinear_term_fits",
    *(code for _, code, _ in ACTING.values()),
    *(code for *_, code in MISSING.values()),
}
STEP = 0.05 / RATE
#: Equation without friction, and the friction term to add; J v' = u - c v - k x - friction in both.
RUBBING = {
    "speed": ("D y = a y + b u", "- fc*tanh(100 y)"),
    "servo": ("D^2 y = d D y + a y + b u", "- fc*sign(D y)"),
    "motor": ("D^2 y = d D y + b u", "- fc*sign(D y)"),
}


def record(numerator, denominator, delay, seed, noise, rows=500, acting=np.asarray):
    """Steps of random length through the plant, with noise of 2 % of the output, colored by a filter."""
    g = np.random.default_rng(seed)
    u = np.repeat(g.uniform(-1, 1, rows), g.integers(4, 60, rows))[:rows]
    b, a, _ = signal.cont2discrete((numerator, denominator), STEP)
    y = signal.lfilter(b.ravel(), a, np.r_[np.zeros(max(delay, 0)), acting(u)][:rows])
    e = signal.lfilter([1.0], noise, g.standard_normal(rows))
    y += 0.02 * y.std() / e.std() * e
    logged = np.r_[np.zeros(max(-delay, 0)), u][:rows]
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": logged}, outputs={"y": y})


def codes_of(run, equation="D y = a y + b u"):
    return {f.code for f in ftlm.identify(run, ftlm.equation(equation)).findings}


@slow_after(1, "seeds", [1, 6])
@pytest.mark.parametrize("kind", MISSING)
def test_what_a_first_order_model_lacks_is_named(kind, seeds):
    *plant, expected = MISSING[kind]
    named = [codes_of(record(*plant, seed, [1.0])) & CODES for seed in range(seeds)]
    assert 6 * sum(codes == {expected} for codes in named) >= 5 * seeds, named
    assert all(named), named


def test_the_estimated_delay_and_the_term_to_write():
    *plant, _ = MISSING["delay"]
    run = record(*plant, 1, [1.0])
    poor = ftlm.identify(run, ftlm.equation("D^alpha y = a y + b u"))
    (said,) = (f for f in poor.findings if f.code == "delay_fits")
    assert abs(said.numbers["value"] / (5 * STEP) - 1) < 0.05
    assert "u(t - 0:" in said.remedy
    assert poor.verdict.reason.startswith("y follows u with a delay of")
    # What the remedy says to write finds the plant.
    limit = said.numbers["longest"]
    better = ftlm.identify(run, ftlm.equation(f"D^alpha y = a y + b u(t - 0:{limit:.2g})"))
    assert abs(better.orders["alpha"] - 1) < 3 * better.standard_errors["alpha"]
    *plant, _ = MISSING["feedthrough"]
    poor = ftlm.identify(record(*plant, 1, [1.0]), ftlm.equation("D y = a y + b u"))
    (said,) = (f for f in poor.findings if f.code == "zero_fits")
    assert "D^1 u" in said.remedy


@pytest.mark.parametrize("rows", [0, 5])
@pytest.mark.parametrize("given", [-1, 3])
def test_a_given_delay_that_is_wrong_is_named_beside_the_right_one(rows, given):
    run = record([1.0], [1 / RATE, 1.0], rows, 1, [1.0])
    delayed = f"u(t {'-' if given > 0 else '+'} {abs(given) * STEP})"
    found = ftlm.identify(run, ftlm.equation(f"D y = a y + b {delayed}"))
    (named,) = (f for f in found.findings if f.code == "delay_differs")
    assert abs(named.numbers["value"] - rows * STEP) < 0.1 * STEP
    assert named.numbers["before"] == pytest.approx(given * STEP)
    # The interval of the remedy holds the delay.
    bounds = named.numbers["low"], named.numbers["high"]
    better = ftlm.identify(run, ftlm.equation("D y = a y + b u", delay={"u": bounds}))
    assert better.verdict.level != "do not use"
    assert abs(better.parameters["delay_u"].value - rows * STEP) < 0.1 * STEP


@pytest.mark.parametrize(
    "noise",
    [[1.0], [1.0, -0.95], pytest.param([1.0, -1.92 * np.cos(0.2), 0.9216], marks=pytest.mark.slow)],
    ids=["white", "AR1", "AR2"],
)
@slow_after(1, "seeds", [2, 30])
def test_colored_noise_is_no_missing_dynamics(noise, seeds):
    right = [codes_of(record([1.0], [1 / RATE, 1.0], 0, seed, noise)) & CODES for seed in range(seeds)]
    assert sum(map(bool, right)) == 0, right


@slow_after(1, "seed", range(4))
@pytest.mark.parametrize("kind", ACTING)
def test_how_an_input_acts_is_named(kind, seed):
    acting, expected, limit = ACTING[kind]
    run = record([1.0], [1 / RATE, 1.0], 0, seed, [1.0], acting=acting)
    found = ftlm.identify(run, ftlm.equation("D y = a y + b u"))
    (said,) = (f for f in found.findings if f.code in CODES)
    assert said.code == expected
    assert said.reason in found.verdict.reasons
    # Levels of both signs tell it from any other cause.
    assert "causes_alike" not in {f.code for f in found.findings}
    if limit is not None:
        assert abs(said.numbers["value"] / limit - 1) < 0.03
        # What the remedy says to write is read, and finds the limit.
        (term,) = re.findall(r"(?:sat|dead)\(.*?\)", said.remedy)
        better = ftlm.identify(run, ftlm.equation(f"D y = a y + b {term}"))
        (value,) = better.limits.values()
        assert abs(value / limit - 1) < 0.03


def rubbing(kind, seed, friction, rows=500, steps=40):
    """A mass with Coulomb friction that sticks, by Euler steps of a fortieth of a row; noise of 2 % of the output."""
    g = np.random.default_rng(seed)
    u = np.repeat(g.uniform(-1, 1, rows), g.integers(4, 60, rows))[:rows]
    servo = kind == "servo"
    mass, drag, spring = (1 / RATE**2, 0.4 / RATE, 1.0) if servo else (1 / RATE, 1.0, 0.0)
    h, v, x = STEP / steps, 0.0, 0.0
    y = np.zeros(rows)
    for k in range(rows - 1):
        for _ in range(steps):
            force = u[k] - drag * v - spring * x
            if v == 0.0:
                v = 0.0 if abs(force) <= friction else h * (force - np.sign(force) * friction) / mass
            else:
                later = v + h * (force - np.sign(v) * friction) / mass
                v = 0.0 if later * v < 0.0 else later
            x += h * v
        y[k + 1] = v if kind == "speed" else x
    y += 0.02 * y.std() * g.standard_normal(rows)
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": y}), friction / mass


@slow_after(1, "friction", [0.05, 0.25])
@slow_after(1, "seed", range(3))
@pytest.mark.parametrize("kind", RUBBING)
def test_dry_friction_is_named_and_its_term_finds_it(kind, seed, friction):
    poor, term = RUBBING[kind]
    run, true = rubbing(kind, seed, friction)
    found = ftlm.identify(run, ftlm.equation(poor))
    (said,) = (f for f in found.findings if f.code in CODES)
    assert said.code == "friction_fits"
    assert said.reason in found.verdict.reasons
    assert abs(said.numbers["value"] / true - 1) < 0.1
    assert term.split("(")[0] in said.remedy
    added = said.remedy.removeprefix("add the term ")
    better = ftlm.identify(run, ftlm.equation(f"{poor} {added}"))
    assert abs(better.coefficients["fc"] / true - 1) < 0.1
    assert not {f.code for f in better.findings} & CODES


@pytest.mark.slow
def test_a_drag_that_drives_near_standstill_is_no_friction():
    for seed in range(2):
        g = np.random.default_rng(seed)
        u = np.repeat(g.uniform(-1, 1, 500), g.integers(4, 60, 500))[:500]
        y = np.zeros(500)
        for k in range(499):
            y[k + 1] = y[k]
            for _ in range(40):
                y[k + 1] += STEP / 40 * RATE * (u[k] - y[k + 1] + 0.25 * np.tanh(50 * y[k + 1]))
        y += 0.02 * y.std() * g.standard_normal(500)
        run = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": y})
        codes = codes_of(run)
        assert "friction_fits" not in codes
        # No friction explains it, but the residuals are more than noise.
        assert "dynamics_missing" in codes
        assert "noise_coloured" not in codes
        (item,) = ftlm.select(run, "auto").best.model.structure.equations
        assert not any("tanh" in str(term) for term in item.terms)


@slow_after(1, "seeds", [2, 10])
@pytest.mark.parametrize("equation", ["D y = a y + b u", "D^2 y = d D y + a y + b u"])
def test_resonant_noise_is_no_friction(equation, seeds):
    noise = [1.0, -1.96 * np.cos(0.05), 0.9604]
    plant = [1 / RATE, 1.0] if equation.startswith("D y") else [1 / RATE**2, 0.4 / RATE, 1.0]
    named = []
    for seed in range(seeds):
        run = record([1.0], plant, 0, seed, [1.0])
        e = signal.lfilter([1.0], noise, np.random.default_rng(seed).standard_normal(run.length))
        y = run["y"] + 0.3 * run["y"].std() / e.std() * e
        run = ftlm.Run.from_arrays(step=STEP, inputs={"u": run["u"]}, outputs={"y": y})
        named.append(codes_of(run, equation) & (CODES | {"residuals_follow_direction"}))
    assert sum(map(bool, named)) == 0, named


@slow_after(1, "seeds", [2, 6])
def test_a_drift_of_the_level_is_no_mode(seeds):
    found = []
    for seed in range(seeds):
        run = record([1.0], [1 / RATE, 1.0], 0, seed, [1.0])
        y = run["y"] + run["y"].std() * np.linspace(0.0, 1.0, run.length)
        drifting = ftlm.Run.from_arrays(step=STEP, inputs={"u": run["u"]}, outputs={"y": y})
        found.append(codes_of(drifting) & CODES)
    assert all(codes == {"drift_fits"} for codes in found), found


@slow_after(1, "seed", range(4))
def test_a_load_that_steps_in_the_record_is_named(seed):
    def acting(u):
        return u + np.where(np.arange(u.size) >= 280, 0.6, 0.0)

    run = record([1.0], [1 / RATE, 1.0], 0, seed, [1.0], acting=acting)
    found = ftlm.identify(run, ftlm.equation("D y = a y + b u"))
    (said,) = (f for f in found.findings if f.code in CODES)
    assert said.code == "load_step_fits"
    assert abs(said.numbers["time"] / STEP - 280) <= 3
    assert abs(said.numbers["value"] / (0.6 * RATE) - 1) < 0.05


#: Numerator, denominator and equation of plants that rest at an input of 0, and inputs of one sign or of two values.
RESTING = {
    "swing": ([50.0], [1.0, 2.0, 25.0], "D^2 y = -p D y - q y + b u"),
    "two lags": ([2.0], [0.192, 1.04, 1.0], "D^2 y = -p D y - q y + b u"),
    "zero": ([-0.64, 2.0], [0.256, 1.12, 1.0], "D^2 y = -p D y - q y + b u + c D u"),
    "integrator": ([1.0], [1.0, 0.0], "D y = b u"),
}
ONE_SIDED = {
    "staircase": lambda g: np.repeat(np.arange(6.0), 100),
    "pulse": lambda g: np.where(np.arange(600) // 40 % 15 == 1, 1.0, 0.0),
    "two values": lambda g: np.repeat(g.integers(0, 2, 30) * 1.0, 20),
}


def resting(plant, u, seed, color, read=0.0, raised=0.0):
    """A run from rest whose input is read too high by `read` and whose output by `raised`; noise of 1 %."""
    numerator, denominator, words = RESTING[plant]
    b, a, _ = signal.cont2discrete((numerator, denominator), 0.02)
    y = signal.lfilter(b.ravel(), a, u)
    e = signal.lfilter([1.0], [1.0, -color], np.random.default_rng([seed, 3]).standard_normal(u.size))
    y = y + (0.01 * e / e.std() + raised) * y.std()
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u + read}, outputs={"y": y})
    return run, ftlm.equation(words, initial="rest")


@slow_after(1, "color", [0.8, 0.0])
@pytest.mark.parametrize("kind", ONE_SIDED)
@pytest.mark.parametrize("plant", RESTING)
def test_an_offset_of_an_input_is_no_dead_zone(plant, kind, color):
    # Under an input of one sign or of two values a dead zone and a saturation are an offset, in numbers.
    u = ONE_SIDED[kind](np.random.default_rng(4))
    found = ftlm.identify(*resting(plant, u, 1, color, read=0.25 * u.max()))
    assert {f.code for f in found.findings} & CODES == {"offset_missing"}


@slow_after(1, "seed", [0, 2])
def test_a_raised_output_and_motion_at_the_start_are_no_dynamics(seed):
    u = np.repeat(np.random.default_rng([seed, 4]).uniform(-1, 1, 30), 20)
    run, structure = resting("swing", u, seed, 0.0, raised=0.5)
    assert {f.code for f in ftlm.identify(run, structure).findings} & CODES == {"level_missing"}
    run, structure = resting("swing", u, seed, 0.0)
    moving = run.window(150 * run.step, None)
    assert {f.code for f in ftlm.identify(moving, structure).findings} & CODES == {"motion_missing"}


@slow_after(1, "color", [0.0, 0.8])
def test_causes_that_a_run_does_not_tell_apart_are_both_named(color):
    # A motor that moves in one direction only: its friction takes as much from every input as a dead zone does.
    u, fc, v, x = np.repeat(np.arange(6.0), 100), 0.75, 0.0, 0.0
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        for _ in range(40):
            v = max(v + 0.0005 * (max(u[k] - fc, 0.0) - 0.5 * v) / 0.2, 0.0)
            x += 0.0005 * v
        y[k + 1] = x
    e = signal.lfilter([1.0], [1.0, -color], np.random.default_rng(1).standard_normal(u.size))
    run = ftlm.Run.from_arrays(step=0.02, inputs={"u": u}, outputs={"y": y + 0.01 * y.std() * e / e.std()})
    found = ftlm.identify(run, ftlm.equation("D^2 y = -p D y + b u", initial="rest"))
    (said,) = (f for f in found.findings if f.code == "causes_alike")
    causes = f"{said.numbers['cause']}, {said.numbers['others']}"
    assert "a dead zone" in causes
    assert "dry friction" in causes
    assert said.reason in found.verdict.reasons


@slow_after(1, "seeds", [4, 12])
def test_a_drift_beside_colored_noise_is_named(seeds):
    # Without the drift, an autoregression near a random walk explains most of it.
    named = []
    for seed in range(seeds):
        u = np.where(np.arange(600) // 40 % 4 > 0, 1.0, 0.0) * (np.arange(600) < 160)
        run, structure = resting("two lags", u, seed, 0.8)
        y = run["y"] + 0.1 * run["y"].std() * np.linspace(0.0, 1.0, run.length)
        drifting = ftlm.Run.from_arrays(step=run.step, inputs={"u": u}, outputs={"y": y})
        found = ftlm.identify(drifting, replace(structure, initial="auto"))
        named.append({f.code for f in found.findings} & CODES)
    assert 4 * sum(codes == {"drift_fits"} for codes in named) >= 3 * seeds, named


def test_names_of_the_equation_are_no_obstacle():
    *plant, _ = MISSING["lag"]
    run = record(*plant, 1, [1.0])
    taken = "D load = lag load + k lag1", {"y": "load", "u": "lag1"}
    assert codes_of(run.rename(taken[1]), taken[0]) & CODES == {"lag_fits"}


def test_long_records_are_tested_on_their_first_samples():
    *plant, _ = MISSING["lag"]
    found = ftlm.identify(record(*plant, 1, [1.0], rows=20_000), ftlm.equation("D y = a y + b u"))
    assert {f.code for f in found.findings} & CODES == {"lag_fits"}


def test_what_the_remedy_of_a_lag_says_to_write_finds_the_plant():
    *plant, _ = MISSING["resonance"]
    run = record(*plant, 1, [1.0])
    (said,) = (f for f in ftlm.identify(run, ftlm.equation("D y = a y + b u")).findings if f.code == "lag_fits")
    assert said.remedy.endswith("a term of its former order: lag D^1 y")
    better = ftlm.identify(run, ftlm.equation("D^2 y = lag D^1 y + a y + b u"))
    assert abs(better.coefficients["a"] / -(RATE**2) - 1) < 0.02
    assert not {f.code for f in better.findings} & CODES


def test_colored_noise_alone_starts_no_multistart(monkeypatch):
    """A local fit tells that a lag, a delay or friction explains nothing; a load step has cheap starts of its own."""
    automatic = []
    fit = extensions.fit_output_error

    def counted(runs, structure, **options):
        if (
            options.get("start") is None
            and options.get("initial_fit") is None
            and "load" not in structure.coefficient_names
        ):
            automatic.append(structure)
        return fit(runs, structure, **options)

    monkeypatch.setattr(extensions, "fit_output_error", counted)
    plant = [1.0], [1 / RATE, 1.0], 0
    for seed in range(2):
        assert codes_of(record(*plant, seed, [1.0, -0.9])) & CODES == set()
    assert automatic == []
    # A missing lag is found from an automatic start.
    codes_of(record([1.0], [0.3 / RATE**2, 1.3 / RATE, 1.0], 0, 0, [1.0]))
    assert automatic


@slow_after(1, "seeds", [2, 6])
@pytest.mark.parametrize("rows", [40, 200])
def test_color_under_a_constant_input_is_not_blamed_on_the_model(rows, seeds):
    """A step from the first row on: residuals of the right structure are colored, and no test tells why."""
    found = []
    for seed in range(seeds):
        g = np.random.default_rng(seed)
        t = np.arange(rows) * STEP
        e = signal.lfilter([1.0], [1.0, -0.9], g.standard_normal(rows))
        y = 2.0 * (1.0 - np.exp(-6.0 * t / t[-1])) + 0.03 * e / e.std()
        found.append(codes_of(ftlm.Run.from_arrays(step=STEP, inputs={"u": np.ones(rows)}, outputs={"y": y})))
    wrong = {"residuals_not_white", "output_not_white", "noise_coloured", "dynamics_missing"}
    assert all(wrong.isdisjoint(codes) for codes in found), found
    assert 6 * sum("color_undecided" in codes for codes in found) >= 4 * seeds, found


def heated(_, x, u):
    return [-2e-3 * x[0] - 8e-12 * ((x[0] + 293) ** 4 - 293.0**4) + 0.02 * u]


def swinging(_, x, u):
    return [x[1], -0.5 * x[1] - 9.81 * np.sin(x[0]) + u]


def multiplied(_, x, u):
    return [-0.8 * x[0] + 2 * u + 0.5 * x[0] * u]


#: Slope of the state, number of states, step, rows between changes of the input, its range, noise, a structure that
#: lacks a non-linear term, and the terms that may be named.
CURVED = {
    "pendulum": (swinging, 2, 0.02, 40, (-6, 6), 0.005, "D^2 y = -c D y - k y + b u", ("y^3",)),
    "heating": (heated, 1, 10.0, 40, (0, 50), 0.1, "D y = -a y + b u", ("y^2", "y^3")),
    "radiation": (heated, 1, 10.0, 40, (0, 50), 0.1, "D y = -e ((y + 293)^4 - 293^4) + b u", ("y", "y^2", "y^3")),
    "product": (multiplied, 1, 0.1, 20, (-1, 1), 0.01, "D y = -a y - e y^2 + b u", ("y*u",)),
}


@pytest.mark.parametrize("name", CURVED)
def test_a_missing_nonlinear_term_is_not_called_noise(name):
    slope, states, step, hold, interval, noise, text, terms = CURVED[name]
    rng, rows = np.random.default_rng(1), 700
    u = np.repeat(rng.uniform(*interval, rows // hold + 1), hold)[:rows]
    y, x = np.empty(rows), np.zeros(states)
    for k in range(rows):
        y[k] = x[0]
        x = solve_ivp(slope, (0, step), x, args=(u[k],), rtol=1e-8, atol=1e-10).y[:, -1]
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y + noise * rng.standard_normal(rows)})
    found = ftlm.identify(run, ftlm.equation(text), threads=1)
    (finding,) = (f for f in found.findings if f.code in CODES)
    assert finding.code == "nonlinear_term_fits"
    assert re.search(rf": k\d* ({'|'.join(map(re.escape, terms))}) explains", finding.sentence)
    assert 20 < finding.numbers["share"] <= 100
    assert "noise_coloured" not in {f.code for f in found.findings}
