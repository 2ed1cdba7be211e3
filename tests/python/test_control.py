"""Shapers, fractional PIDs and their memory, against SciPy, python-control and sums that share no code with them."""

import dataclasses
import math
import re

import control as python_control
import numpy as np
import pytest
from scipy import signal
from scipy.special import gammaln

import ftlm
from ftlm import control
from ftlm.control import stability_margins

W, Z = 17.7, 0.13
POLE = W * complex(-Z, math.sqrt(1 - Z * Z))
HUB = "D^2 theta = -63 D^0.95 theta + 140 I"


def left_after(reference, rate, w, z, arrived):
    """Amplitude of a second-order system's swing about 1 at a sample, by SciPy's exact discretisation."""
    a, b = np.array([[0.0, 1.0], [-w * w, -2 * z * w]]), np.array([[0.0], [w * w]])
    system = signal.cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), 1.0 / rate)
    _, _, states = signal.dlsim((*system[:4], 1.0 / rate), reference)
    pole = w * complex(-z, math.sqrt(1 - z * z))
    return float(abs(states[arrived, 1] - pole.conjugate() * (states[arrived, 0] - 1.0)) / w)


@pytest.mark.parametrize("kind", ["zv", "zvd"])
@pytest.mark.parametrize("rate", [500.0, 93.7, 24.0])
def test_a_shaped_step_leaves_nothing_at_the_pole_whatever_the_rate(kind, rate):
    shaper = control.input_shaper(POLE, kind)
    step = np.r_[0.0, np.ones(round(4 * rate))]
    arrived = len(shaper.impulses(rate)) + 1
    assert left_after(step, rate, W, Z, 1) > 0.5
    shaped = shaper.filter(step, rate)
    assert shaped[-1] == pytest.approx(1.0, abs=1e-14)
    assert np.all(np.diff(shaped) >= 0)
    assert left_after(shaped, rate, W, Z, arrived) < 1e-12


def test_rounding_the_impulses_to_samples_would_leave_vibration():
    """What the exact split is for: the same shaper with its second impulse at the next sample, and interpolated."""
    rate = 24.0
    shaper = control.input_shaper(POLE)
    step = np.r_[0.0, np.ones(100)]
    at = shaper.times[1] * rate
    for taps in (
        np.bincount([0, round(at)], weights=shaper.amplitudes),
        np.bincount(
            [0, int(at), int(at) + 1],
            weights=[shaper.amplitudes[0], *np.multiply(shaper.amplitudes[1], (1 - at % 1, at % 1))],
        ),
    ):
        assert left_after(np.convolve(step, taps)[:101], rate, W, Z, 10) > 0.01


def test_zvd_has_no_slope_and_zv_has_one():
    """Residuals beside the pole, simulated: of first order for zv, of second for zvd."""
    step = np.r_[0.0, np.ones(2000)]
    left = {}
    for kind in ("zv", "zvd"):
        shaper = control.input_shaper(POLE, kind)
        shaped = shaper.filter(step, 500.0)
        left[kind] = [left_after(shaped, 500.0, W * (1 + e), Z, len(shaper.impulses(500.0)) + 1) for e in (0.02, 0.04)]
    assert left["zv"][1] / left["zv"][0] == pytest.approx(2.0, abs=0.2)
    assert left["zvd"][1] / left["zvd"][0] == pytest.approx(4.0, abs=0.5)
    assert left["zvd"][0] < 0.1 * left["zv"][0]


@pytest.mark.parametrize("kind", ["zv", "zvd"])
def test_what_a_shaper_says_is_left_is_what_is_simulated(kind):
    shaper = control.input_shaper(POLE, kind)
    rate = 5000.0
    shaped = shaper.filter(np.r_[0.0, np.ones(3000)], rate)
    arrived = round(shaper.delay * rate) + 1
    for w, z in ((1.2 * W, Z), (0.8 * W, 0.05), (W, 0.3)):
        said = float(shaper.residual_vibration(w, z))
        one = left_after(np.r_[0.0, np.ones(3000)], rate, w, z, 1)
        assert left_after(shaped, rate, w, z, arrived) / one == pytest.approx(said, rel=0.01)


def test_two_modes_are_shaped_together():
    model = ftlm.Model(ftlm.equation("D^4 y = -3.7 D^3 y - 1000 D^2 y - 1500 D y - 200000 y + 200000 u"))
    modes = sorted((m for m in model.modes() if m.oscillatory), key=lambda m: m.damping)
    shaper = control.input_shaper(model, modes=2)
    for mode in modes:
        assert float(shaper.residual_vibration(mode.frequency, mode.damping)) < 1e-12
    assert sum(shaper.amplitudes) == pytest.approx(1.0)
    assert float(control.input_shaper(model).residual_vibration(modes[1].frequency, modes[1].damping)) > 0.05


def test_a_fractional_models_own_pole_is_shaped():
    """A spring-pot: the swing of its exact step response is gone, what relaxes as a power of time stays."""
    model = ftlm.Model(ftlm.equation("D^2 y = -220 D^0.12 y - D^2 x"))
    (mode,) = model.modes()
    shaper = control.input_shaper(model)
    t = np.arange(1501) * 0.002
    step = np.r_[0.0, np.zeros(49), np.ones(1451)]
    left = {}
    for name, x in (("step", step), ("shaped", shaper.filter(step, 500.0))):
        run = ftlm.Run.from_arrays(
            step=0.002,
            inputs={"x": np.convolve(x, np.ones(25) / 25)[:1501]},
            outputs={"y": 0 * t},
            intersample={"x": "foh"},
        )
        bend = model.simulate(run)["y"][200:700]
        # About a mean that creeps, as a power of time does.
        left[name] = np.std(bend - np.polyval(np.polyfit(t[200:700], bend, 3), t[200:700]))
    assert left["shaped"] < 0.02 * left["step"]
    assert shaper.delay == pytest.approx(math.pi / mode.pole.imag)


def test_a_filter_keeps_what_it_is_given_and_begins_at_rest():
    shaper = control.input_shaper(POLE)
    given = np.column_stack([np.linspace(1.0, 2.0, 300), np.full(300, -3.0)])
    kept = given.copy()
    shaped = shaper.filter(given, 500.0)
    assert np.array_equal(given, kept)
    assert np.allclose(shaped[:, 1], -3.0)
    assert shaped[0, 0] == 1.0
    assert np.array_equal(shaper.filter([1, 2, 3], 500.0)[:1], [1.0])


def uncertain(text, errors, **options):
    """A model whose numbers have these standard errors, by their place."""
    model = ftlm.Model(ftlm.equation(text, **options))
    size = sum(1 + 2 * len(e.terms) for e in model.equations)
    covariance = np.zeros((size, size))
    for at, error in errors.items():
        covariance[at, at] = error**2
    estimate = ftlm.Estimate("output-error", (), {}, covariance=tuple(map(tuple, covariance.tolist())))
    return dataclasses.replace(model, estimate=estimate)


def test_intervals_too_wide_for_a_shaper_are_refused_in_words():
    text = "D^2 y = -300 y - 4 D y + 300 u"
    # Of the coefficient of y: 10 % are 5 % of the frequency, a fifth of it leaves too much.
    good = control.input_shaper(uncertain(text, {2: 10.0}))
    assert 0 < good.max_residual_vibration < 0.2
    with pytest.raises(ftlm.ModelError, match=r"too uncertain for a shaper.* may leave .* longer run.*kind='zvd'"):
        control.input_shaper(uncertain(text, {2: 60.0}))
    assert control.input_shaper(uncertain(text, {2: 40.0}), "zvd").max_residual_vibration < 0.1


REFUSED = [
    (lambda: control.input_shaper(POLE, "zvv"), "kind = 'zvv' is not known"),
    (lambda: control.input_shaper(POLE, modes=0), "modes = 0"),
    (lambda: control.input_shaper(POLE, modes="1"), "modes = '1'"),
    (lambda: control.input_shaper(POLE, {"zv": 1}), "kind = {'zv': 1} is not known"),
    (lambda: control.input_shaper(POLE, np.array(["zv", "zvd"])), "kind = array.* is not known"),
    (lambda: control.input_shaper(POLE, "x" * 10**6), "kind = 'x{59}… is not known"),
    (lambda: control.input_shaper(POLE, modes=10**5000), "modes = an integer of 16610 bits is not a whole number"),
    (lambda: control.input_shaper(POLE, modes=np.complex64(1)), "modes = np.complex64"),
    (lambda: control.input_shaper(complex(-1e308, 1e308)), "does not oscillate"),
    (lambda: control.input_shaper(10**400), "pole = an integer of 1329 bits does not oscillate"),
    (lambda: control.input_shaper(None), "model is NoneType, not a Model"),
    (lambda: control.input_shaper(2 + 17j), "not stable"),
    (lambda: control.input_shaper(17j), "not stable"),
    (lambda: control.input_shaper(-3.0), "does not oscillate"),
    (lambda: control.input_shaper(complex("nan")), "does not oscillate"),
    (lambda: control.input_shaper(ftlm.Model(ftlm.equation("D^2 y = -9 y + 0.1 D y + u"))), "not stable"),
    (lambda: control.input_shaper(ftlm.Model(ftlm.equation("D y = -9 y + u"))), "0 modes of the model oscillate"),
    (lambda: control.input_shaper(POLE).impulses(0), "rate = 0"),
    (lambda: control.input_shaper(POLE).impulses(10.0), "fewer than four samples in a period"),
    (lambda: control.input_shaper(POLE).impulses("fast"), "rate = 'fast' is not a number"),
    (lambda: control.input_shaper(POLE).impulses(1e8), r"the shaper 1.79e\+07 samples long; use at most 2.34e\+07 Hz"),
    (lambda: control.input_shaper(POLE).impulses(1e308), "rate = 1e.308 Hz is out of range; give samples per second"),
]


@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_what_is_no_shaper_is_refused(case):
    act, words = REFUSED[case]
    with pytest.raises(ftlm.ModelError, match=words):
        act()


@pytest.mark.parametrize("rate", [93.7, 500.0])
def test_a_reference_is_convolved_with_the_impulses(rate):
    shaper = control.input_shaper(ftlm.Model(ftlm.equation("D^2 y = -300 y - 4 D^0.9 y + 300 u")), "zvd")
    given = np.cumsum(np.random.default_rng(0).standard_normal((200, 2)), axis=0)
    taps = shaper.impulses(rate)
    naive = [np.convolve(column - column[0], taps)[:200] + column[0] for column in given.T]
    assert shaper.filter(given, rate) == pytest.approx(np.column_stack(naive), rel=1e-13)
    half = control.input_shaper(shaper.modes[0].pole).impulses(rate)
    assert taps == pytest.approx(np.convolve(half, half), abs=1e-15)


def test_a_long_shaper_takes_no_longer_than_it_lasts():
    """Two million samples, of which all but nine are zero; each with each would be for hours."""
    taps = control.input_shaper(POLE, "zvd").impulses(6e6)
    assert 2_000_000 < len(taps) < 2_200_000
    assert np.count_nonzero(taps) <= 9
    assert taps.sum() == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("given", ["text", None, [], [1j], np.zeros((2, 2, 2)), [[1, 2], [3]]])
def test_what_cannot_be_filtered_is_refused(given):
    with pytest.raises(ftlm.DataError, match="not an array of numbers"):
        control.input_shaper(POLE).filter(given, 500.0)
    with pytest.raises(ftlm.DataError, match=r"not finite at row 1 .2 such"):
        control.input_shaper(POLE).filter([0.0, np.nan, np.inf], 500.0)


# ----------------------------------------------------------------------------------------------------------------------
# Fractional PID


def test_a_tuned_loop_has_the_margins_that_were_asked_for():
    """Recomputed from the model's powers alone, the sample of delay and the hold included."""
    model = ftlm.Model(ftlm.equation(HUB))
    design = control.fractional_pid(model, crossover=40.0, phase_margin=60.0, rate=500.0)
    pid = design.pid

    def loop(w):
        s = 1j * w
        plant = 140.0 / (s**2 + 63.0 * s**0.95) * np.exp(-s / 500.0) * (1 - np.exp(-s / 500.0)) / (s / 500.0)
        return plant * (pid.kp + pid.ki * s**-pid.lam + pid.kd * s**pid.mu)

    assert abs(loop(40.0)) == pytest.approx(1.0, abs=1e-9)
    assert math.degrees(np.angle(loop(40.0))) + 180.0 == pytest.approx(60.0, abs=1e-6)
    slope = (np.angle(loop(40.4)) - np.angle(loop(39.6))) / 0.8
    assert abs(slope) * 40.0 < 1e-3
    assert min(pid.kp, pid.ki, pid.kd) >= 0.0
    assert design.nominal.stable
    assert design.nominal.phase == pytest.approx(60.0, abs=0.1)
    assert all(abs(phase - 60.0) < 8.0 for phase in design.phase_margin_at_gains)


@pytest.mark.parametrize(("gain", "stable"), [(1.0, True), (3.0, True), (11.0, True), (30.0, True), (38.0, False)])
def test_stability_and_margins_are_those_of_python_control(gain, stable):
    """A plant of whole order with two integrals in its loop; the delay as a high Pade."""
    model = ftlm.Model(ftlm.equation("D^3 y = -70 D^2 y - 600 D y + 4000 u"))
    w = stability_margins.nyquist_frequencies(10.0, 200.0)
    plant = stability_margins.Plant(model, "y", "u", 200.0, "simulated")
    lead = control.FractionalPid(gain, 0.5 * gain, 0.05 * gain, 1.0, 1.0)
    found = stability_margins.margins_of(lead.response(w) * plant.response(w), w, plant.integral_order() + 1.0)
    s = python_control.tf("s")
    top, bottom = python_control.pade(1.5 / 200.0, 6)
    loop = gain * (1 + 0.5 / s + 0.05 * s) * 4000 / (s**3 + 70 * s**2 + 600 * s) * python_control.tf(top, bottom)
    poles = python_control.feedback(loop, 1).poles()
    assert bool(np.all(poles.real < 1e-6)) == stable
    assert found.stable == stable
    if stable:
        upper, phase, _, _ = python_control.margin(loop)
        assert found.phase == pytest.approx(phase, abs=1.5)
        lower = [v for v in (upper,) if math.isfinite(v)]
        assert found.gain == pytest.approx(min(lower), rel=0.02)


def test_designs_are_made_over_the_intervals():
    model = uncertain(HUB, {4: 0.01, 2: 3.0})
    design = control.fractional_pid(model, crossover=40.0, samples=60)
    assert len(design.samples) == 60
    assert design.stable_fraction == 1.0
    low, high = design.margin_interval("phase")
    assert low < 59.9
    assert high > 60.05 or low > 50.0
    assert design == control.fractional_pid(model, crossover=40.0, samples=60)
    assert "over the intervals (60 samples, 100 % stable)" in str(design)


def test_intervals_too_wide_for_a_loop_are_refused_in_words():
    with pytest.raises(
        ftlm.ModelError, match=r"too wide to design on: in [0-9]+ of 40 samples .*the most uncertain is the coeff"
    ):
        control.fractional_pid(uncertain(HUB, {2: 300.0}), crossover=40.0, samples=40)


def test_models_that_cannot_be_designed_on_are_refused():
    def tuned(text, **options):
        return control.fractional_pid(ftlm.Model(ftlm.equation(text)), **{"crossover": 40.0, **options})

    for text, options, words in (
        ("D^2 y = 9 D y + u", {}, "not stable .1 of its poles"),
        ("D^2 y = -9 y + u", {}, "not stable .a pole is on the imaginary axis"),
        (HUB, {"crossover": 0.0}, "crossover = 0.0 rad/s is out of range"),
        (HUB, {"crossover": 1e4}, "crossover = 10000.0 rad/s is out of range"),
        (HUB, {"crossover": "40"}, "crossover = '40' is not a number"),
        (HUB, {"phase_margin": 5.0}, "phase_margin = 5.0 degrees is out of range"),
        (HUB, {"output": "thet"}, "did you mean 'theta'"),
        (HUB, {"input": "U"}, "input = 'U' is not one"),
        (HUB, {"rate": -1.0}, "rate = -1.0"),
        (HUB, {"samples": -1}, "samples = -1"),
        (HUB, {"seed": "x"}, "seed = 'x'"),
        (HUB, {"coupling": "loose"}, "coupling = 'loose'"),
        (HUB, {"coupling": np.array([1.0, 2.0])}, "coupling = array"),
        (HUB, {"rate": 1e308}, "rate = 1e.308 Hz"),
        (HUB, {"rate": np.complex64(500.0)}, "rate = np.complex64.* is not a number"),
        (HUB, {"crossover": 1e-300}, "crossover = 1e-300 rad/s is out of range"),
        (HUB, {"output": np.array(["theta", "theta"])}, "output = array"),
        (HUB, {"input": 10**5000}, "input = an integer of 16610 bits is not one"),
        (HUB, {"seed": -(10**5000)}, "seed = an integer of 16610 bits"),
        ("D^2.9 y = -63 D^2 y + 140 u", {"phase_margin": 80.0}, "no fractional PID with gains of the plant's sign"),
    ):
        with pytest.raises(ftlm.ModelError, match=words):
            tuned(text, **options)


# ----------------------------------------------------------------------------------------------------------------------
# Realization


PID = control.FractionalPid(6.4, 300.0, 2.5, 0.9, 0.6)


def test_what_runs_is_the_exact_controller_within_what_it_says():
    """Its own answer to a sine over many periods, against powers of jw."""
    realised = control.DiscretePid(PID, 500.0)
    assert realised.gain_error < 0.5
    assert realised.phase_error < 5.0
    for w in (5.0, 40.0, 150.0):
        realised.reset()
        t = np.arange(8000) / 500.0
        answer = np.array([realised(v) for v in np.sin(w * t)])
        last = slice(-round(10 * 2 * math.pi / w * 500.0), None)
        both = np.column_stack([np.sin(w * t), np.cos(w * t), np.ones(8000)])[last]
        real, imaginary, _ = np.linalg.lstsq(both, answer[last], rcond=None)[0]
        exact = PID.kp + PID.ki * (1j * w) ** -PID.lam + PID.kd * (1j * w) ** PID.mu
        quotient = complex(real, imaginary) / exact
        assert abs(20 * math.log10(abs(quotient))) < realised.gain_error + 0.05
        assert abs(math.degrees(np.angle(quotient))) < realised.phase_error + 0.5


def test_its_memory_is_bounded_and_of_the_size_it_says():
    realised = control.DiscretePid(PID, 500.0, order=4)
    assert realised.state_count == 2 * 9 + 2  # an integral and the error before besides
    for v in np.random.default_rng(0).standard_normal(5000):
        assert math.isfinite(realised(float(v)))
    assert realised.state_count == 20


def test_its_step_is_that_of_the_sum_over_the_whole_past():
    """Half a second of a ramp against Gruenwald-Letnikov's sums."""
    realised = control.DiscretePid(PID, 500.0)
    rows = 400
    ramp = np.arange(rows) / 500.0
    found = np.array([realised(float(v)) for v in ramp])
    fine = np.arange(20 * rows) / 10_000.0

    def differintegral(power):
        weights = np.cumprod(np.r_[1.0, 1.0 - (power + 1.0) / np.arange(1, fine.size)])
        return np.convolve(weights, fine)[: fine.size] * 10_000.0**power

    exact = PID.kp * fine + PID.ki * differintegral(-PID.lam) + PID.kd * differintegral(PID.mu)
    assert np.max(np.abs(found - exact[::20])[20:]) < 0.03 * np.max(np.abs(exact))


def test_the_first_sample_kicks_nothing_and_the_limit_winds_nothing_up():
    assert control.DiscretePid(PID, 500.0)(0.1) == pytest.approx(PID.kp * 0.1, rel=1e-9)
    realised = control.DiscretePid(PID, 500.0, limit=0.9)
    assert {realised(1.0) for _ in range(2000)} == {0.9}
    # Two seconds at the limit are forgotten within a few samples of the other sign.
    assert [realised(-0.1) < 0 for _ in range(3)][-1]
    free = control.DiscretePid(PID, 500.0)
    for _ in range(2000):
        free(1.0)
    assert free(-0.1) > 100.0


def test_a_reset_forgets():
    realised = control.DiscretePid(PID, 500.0)
    first = [realised(v) for v in (0.1, 0.3, -0.2)]
    realised.reset()
    assert [realised(v) for v in (0.1, 0.3, -0.2)] == first


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate": 0.0}, "rate = 0"),
        ({"limit": 0.0}, "limit = 0"),
        ({"limit": math.nan}, "limit = nan"),
        ({"band": (5.0, 1.0)}, "rad/s is out of range"),
        ({"band": (1.0, 1e5)}, "rad/s is out of range"),
        ({"band": 3.0}, "not a pair of frequencies"),
        ({"order": 0}, "order = 0"),
        ({"order": 51}, "order = 51"),
        ({"band": (5e-324, 50.0)}, "at most 1e.09 times the lower"),
        ({"band": 10**5000}, "not a pair of frequencies"),
        ({"rate": 1e308}, "rate = 1e.308"),
        ({"order": 10**5000}, "order = an integer of"),
    ],
)
def test_what_cannot_be_realised_is_refused(options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        control.DiscretePid(PID, **{"rate": 500.0, **options})
    with pytest.raises(ftlm.ModelError, match="give a DiscretePid, an Lqg or None"):
        control.JointControllers(PID)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"kp": math.nan}, "kp = nan is not finite; give a finite number"),
        ({"ki": "2"}, "ki = '2' is not a number"),
        ({"kd": 1 + 1j}, "kd = .* is not a number"),
        ({"kd": np.array([1.0, 2.0])}, "kd = .* is not a number"),
        ({"lam": 0.0}, "lam = 0 is not an order"),
        ({"lam": -0.5}, "lam = -0.5 is not an order"),
        ({"mu": 1e308}, "mu = 1e.308 is not an order"),
        ({"mu": 10**400}, "mu = an integer of"),
        # What runs is of orders up to 1: another would be another controller.
        ({"lam": 1.2}, "lam = 1.2 cannot be realized"),
        ({"mu": 1.7}, "mu = 1.7 cannot be realized"),
        ({"kd": 1e308}, "has no finite response in its band"),
        ({"kp": 0.0, "ki": 0.0, "kd": 0.0}, "has no finite response in its band"),
    ],
)
def test_what_is_no_controller_is_refused(numbers, words):
    with pytest.raises(ftlm.ModelError, match=words):
        control.DiscretePid(control.FractionalPid(**{**dataclasses.asdict(PID), **numbers}), 500.0)


@pytest.mark.parametrize("given", [None, 3.0, "pid", {}])
def test_what_is_no_model_and_no_controller_is_named(given):
    with pytest.raises(ftlm.ModelError, match="not a Model"):
        control.fractional_pid(given, crossover=40.0)
    with pytest.raises(ftlm.ModelError, match="not a FractionalPid"):
        control.DiscretePid(given, 500.0)


def test_a_designed_loop_runs_on_the_virtual_arm_and_holds_what_it_is_told():
    """Tuned on the arm's linear fractional model, run on the arm with friction, coupling, offset and noise."""
    arm = ftlm.rig.ArmParameters.load("linear").model()
    design = control.fractional_pid(arm, output="theta11", input="I1", crossover=100.0)
    loops = control.JointControllers(
        control.DiscretePid(design.pid, 500.0, limit=0.94), control.DiscretePid(design.pid, 500.0, limit=1.2)
    )
    angle = np.clip(0.5 * (np.arange(1201) * 0.002 - 0.1), 0.0, 0.3)
    run = ftlm.rig.control(loops, np.column_stack([angle, 0 * angle]), offset=(0.02, -0.02))
    assert run.metadata["faults"] == []
    assert np.abs(run["theta11"][-200:] - 0.3).max() < 0.002
    assert np.abs(run["theta21"]).max() < 0.01
    assert run.metadata["control"]["controller"]["settings"]["hub1"]["state_count"] > 10


# ----------------------------------------------------------------------------------------------------------------------
# Where the loop gain is 1


@pytest.mark.parametrize(("damping", "stiffness", "order"), [(3.0, 8.0, 1.6), (0.8, 6.0, 1.7), (0.3, 9.0, 1.9)])
def test_the_crossover_asked_for_is_the_last_one_or_refused(damping, stiffness, order):
    """Oracle: the loop on a fine grid, from the closed form of the plant."""
    plant = ftlm.Model(ftlm.equation(f"D^{order} y = -{damping} D^{order - 1:g} y - {stiffness} y + 5 u"))
    w = np.geomspace(0.01, 500.0, 20001)
    s = 1j * w
    response = 5.0 / (s**order + damping * s ** (order - 1.0) + stiffness)
    response = response * np.exp(-s / 500.0) * (1.0 - np.exp(-s / 500.0)) / (s / 500.0)
    designed = 0
    for crossover in (0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 20.0):
        refused = ""
        try:
            design = control.fractional_pid(plant, crossover=crossover, phase_margin=60.0)
        except ftlm.ModelError as error:
            refused = str(error)
        if refused:
            assert re.search("crosses a gain of 1 again|flat phase margin|is not stable", refused)
            continue
        designed += 1
        loop = response * np.ravel(design.pid.response(w))
        at = np.flatnonzero(np.diff(np.sign(np.abs(loop) - 1.0)))
        margins = np.abs((np.degrees(np.angle(loop[at])) + 360.0) % 360.0 - 180.0)
        assert w[at[-1]] == pytest.approx(crossover, rel=2e-3)
        assert design.nominal.crossover == pytest.approx(crossover, rel=2e-3)
        assert design.nominal.phase == pytest.approx(margins.min(), abs=0.2)
        assert f"highest crossover {design.nominal.crossover:.4g} rad/s, smallest phase margin" in str(design)
    assert designed >= 2


def test_a_crossover_below_a_resonance_that_crosses_again_says_where():
    plant = ftlm.Model(ftlm.equation("D^1.7 y = -0.8 D^0.7 y - 6 y + 5 u"))
    with pytest.raises(ftlm.ModelError, match=r"crossover of 2 rad/s crosses a gain of 1 again .* last at 40\.3"):
        control.fractional_pid(plant, crossover=2.0)


def closed_loop_peak(pid, gain, order, pole, rate=500.0, seconds=4.0):
    """Largest output of a loop with one sample of delay; the plant gain/(s^order + pole) by its exact step response."""
    controller, rows = control.DiscretePid(pid, rate), int(seconds * rate)
    t = np.arange(rows + 2) / rate
    k = np.arange(80)
    powers = (-pole) ** k * t[:, None] ** (order * (k + 1)) / np.exp(gammaln(order * (k + 1) + 1))
    pulse = np.diff(gain * powers.sum(axis=1))
    y, u, command = np.zeros(rows + 1), np.zeros(rows + 1), 0.0
    for row in range(rows):
        u[row] = command
        command = controller(1.0 - y[row])
        y[row + 1] = pulse[: row + 1][::-1] @ u[: row + 1]
        if abs(y[row + 1]) > 1e6:
            break
    return np.max(np.abs(y))


@pytest.mark.parametrize(
    ("order", "pole", "gain", "crossover"),
    [(1.0, 0.5, 2.0, 0.5), (1.0, 0.5, -2.0, 1.0), (0.7, 0.3, 1.0, 1.0), (0.8, 0.1, 0.5, 0.2)],
)
def test_a_loop_is_stable_where_its_design_says_so(order, pole, gain, crossover):
    """A derivative that brings the loop gain near 1 close to the Nyquist frequency is not chosen."""
    plant = ftlm.Model(ftlm.equation(f"D^{order:g} y = -{pole} y + {gain} u"))
    design = control.fractional_pid(plant, crossover=crossover)
    assert design.nominal.gain > 1.4
    assert all(50 < margin < 70 for margin in design.phase_margin_at_gains)
    for factor in (0.7, 1.0, 1.4):
        assert closed_loop_peak(design.pid, factor * gain, order, pole) < 1.5


def test_a_controller_of_negative_gains_is_the_mirrored_one_also_at_its_limit():
    errors = np.r_[np.full(400, 1.0), np.full(400, -0.7), np.random.default_rng(2).standard_normal(200)]
    for orders in ((1.0, 1.0), (0.8, 0.6)):
        positive = control.DiscretePid(control.FractionalPid(0.5, 3.0, 0.02, *orders), 100.0, limit=1.0)
        negative = control.DiscretePid(control.FractionalPid(-0.5, -3.0, -0.02, *orders), 100.0, limit=1.0)
        output = np.array([positive(e) for e in errors])
        np.testing.assert_allclose([negative(e) for e in errors], -output, atol=1e-12)
        # It leaves its limit soon after the error has changed its sign: the integral has not wound up.
        assert 0.9 < output[399] <= 1.0
        assert output[420] < 0.5
