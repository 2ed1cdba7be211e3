"""Missing dynamics are named, and told from colored noise: records by SciPy's exact discretization."""

import re

import numpy as np
import pytest
from scipy import signal

import ftlm

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
    "load_step_fits",
    *(code for _, code, _ in ACTING.values()),
    *(code for *_, code in MISSING.values()),
}
STEP = 0.05 / RATE


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


@pytest.mark.parametrize("kind", MISSING)
def test_what_a_first_order_model_lacks_is_named(kind):
    *plant, expected = MISSING[kind]
    named = [codes_of(record(*plant, seed, [1.0])) & CODES for seed in range(6)]
    assert sum(codes == {expected} for codes in named) >= 5, named
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


@pytest.mark.parametrize(
    "noise", [[1.0], [1.0, -0.95], [1.0, -1.92 * np.cos(0.2), 0.9216]], ids=["white", "AR1", "AR2"]
)
def test_colored_noise_is_no_missing_dynamics(noise):
    right = [codes_of(record([1.0], [1 / RATE, 1.0], 0, seed, noise)) & CODES for seed in range(30)]
    assert sum(map(bool, right)) == 0, right


@pytest.mark.parametrize("kind", ACTING)
def test_how_an_input_acts_is_named(kind):
    acting, expected, limit = ACTING[kind]
    for seed in range(4):
        run = record([1.0], [1 / RATE, 1.0], 0, seed, [1.0], acting=acting)
        found = ftlm.identify(run, ftlm.equation("D y = a y + b u"))
        (said,) = (f for f in found.findings if f.code in CODES)
        assert said.code == expected
        assert said.reason in found.verdict.reasons
        if limit is not None:
            assert abs(said.numbers["value"] / limit - 1) < 0.03
            # What the remedy says to write is read, and finds the limit.
            (term,) = re.findall(r"(?:sat|dead)\(.*?\)", said.remedy)
            better = ftlm.identify(run, ftlm.equation(f"D y = a y + b {term}"))
            (value,) = better.limits.values()
            assert abs(value / limit - 1) < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_a_load_that_steps_in_the_record_is_named(seed):
    def acting(u):
        return u + np.where(np.arange(u.size) >= 280, 0.6, 0.0)

    run = record([1.0], [1 / RATE, 1.0], 0, seed, [1.0], acting=acting)
    found = ftlm.identify(run, ftlm.equation("D y = a y + b u"))
    (said,) = (f for f in found.findings if f.code in CODES)
    assert said.code == "load_step_fits"
    assert abs(said.numbers["time"] / STEP - 280) <= 3
    assert abs(said.numbers["value"] / (0.6 * RATE) - 1) < 0.05


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
