"""Realizations, observers, linear-quadratic loops and inverse dynamics, against SciPy, recursions and powers of jw."""

import importlib
import math

import numpy as np
import pytest
from scipy import signal

import ftlm
from ftlm import control
from ftlm.control import stability_margins
from ftlm.control.lqg import UNKNOWN_INPUT
from test_control import uncertain

RATE = 500.0
#: A hub that turns a link: two outputs of one current, integer orders and others.
WHOLE = "D^2 hub = 160 bend - 30 D hub + 100 I; D^2 bend = -300 bend - 4 D bend - D^2 hub"
BROKEN = "D^2 hub = 160 bend - 30 D^0.9 hub + 100 I; D^2 bend = -300 D^0.1 bend - 4 D^0.8 bend - D^2 hub"
QUIET = {"hub": 3e-4, "bend": 2e-4}
DEAR = {"hub": 0.02, "bend": 0.02}


def model(text):
    return ftlm.Model(ftlm.equation(text, coupling="simulated"))


def designed(text=BROKEN, **options):
    return control.lqg(model(text), **{"max_deviation": DEAR, "max_input": 1.0, "noise": QUIET, **options})


def by_powers(w):
    """Hub and bend by the current, from the powers of jw in BROKEN."""
    s = 1j * w
    link = -(s**2) / (s**2 + 300 * s**0.1 + 4 * s**0.8)
    hub = 100.0 / (s**2 + 30 * s**0.9 - 160 * link)
    return np.array([hub, link * hub])


def whole_system():
    """The whole-order plant in its own states (hub, its rate, bend, its rate), sampled by SciPy."""
    a = np.array([[0, 1, 0, 0], [0, -30, 160, 0], [0, 0, 0, 1], [0, 30, -460, -4.0]])
    b, c = np.array([[0.0], [100], [0], [-100]]), np.array([[1.0, 0, 0, 0], [0, 0, 1, 0]])
    ad, bd, _, _, _ = signal.cont2discrete((a, b, c, np.zeros((2, 1))), 1.0 / RATE)
    return ad, bd, c


# ----------------------------------------------------------------------------------------------------------------------
# Realization


def test_the_poles_of_whole_orders_are_found_and_no_others():
    made = designed(WHOLE, samples=0).realization
    a, _, _ = whole_system()
    own = np.exp(np.array(made.poles) / RATE)
    own = np.sort_complex(np.concatenate([own, own[own.imag != 0].conjugate()]))
    assert made.state_count == 4
    assert np.allclose(own, np.sort_complex(np.linalg.eigvals(a)), atol=1e-7)
    # What is left is what a hold folds back above half the rate.
    assert max(made.gain_error.values()) < 0.1
    assert max(made.phase_error.values()) < 0.1


def test_a_fractional_model_is_realised_within_the_error_that_is_said():
    made = designed(samples=0).realization
    assert made.state_count <= 14
    w = np.geomspace(*made.band, 333)
    turn = 1j * w / RATE
    quotient = made.response(w) / (by_powers(w) * -np.expm1(-turn) / turn)
    for line, name in zip(quotient, made.outputs, strict=True):
        assert np.max(np.abs(20 * np.log10(np.abs(line)))) < 1.05 * made.gain_error[name] + 1e-4
        assert np.degrees(np.max(np.abs(np.angle(line)))) < 1.05 * made.phase_error[name] + 1e-3
    assert max(made.gain_error.values()) < 0.15
    assert np.all(np.abs(np.linalg.eigvals(made.a)) < 1.0 + 1e-12)


@pytest.mark.parametrize("sensor", [False, True])
def test_the_response_at_complex_frequencies_goes_on_from_the_real_ones(sensor):
    passed = ftlm.SensorFilter.low_pass(["bend"])
    made = ftlm.Model(ftlm.equation(BROKEN, coupling="simulated", delay={"I": 0.003}, sensor_filter=passed))
    w = np.array([0.5, 17.0, 120.0])
    for output in ("hub", "bend"):
        plant = stability_margins.Plant(made, output, "I", RATE, "simulated", sensor)
        assert np.allclose(plant.response(w.astype(complex)), plant.response(w), rtol=1e-10)


def test_too_few_poles_are_refused_with_what_they_are_off():
    with pytest.raises(ftlm.ModelError, match=r"3 states has errors of up to .* dB and .* degrees .* narrower band"):
        designed(poles=2)


# ----------------------------------------------------------------------------------------------------------------------
# Observer


def test_the_observer_is_where_the_recursion_of_the_filter_ends():
    """Kalman's recursion from a wide start, sample by sample, until it stands still."""
    seen = control.observer(model(WHOLE), noise=QUIET, process_noise=0.3)
    a, b, c = seen.matrices
    inside = np.zeros_like(a)
    inside[:-1, :-1] = 0.3**2 * b[:-1] @ b[:-1].T
    inside[-1, -1] = 0.3**2 / RATE
    outside = np.diag([3e-4**2, 2e-4**2])
    spread = np.eye(len(a))
    for _ in range(2000):
        gain = spread @ c.T @ np.linalg.inv(c @ spread @ c.T + outside)
        left = spread - gain @ c @ spread
        spread = a @ left @ a.T + inside
    assert np.allclose(gain, seen.gain, rtol=1e-4, atol=1e-6 * np.max(np.abs(gain)))
    rows = np.column_stack([seen.realization.c, np.zeros(2)])
    assert np.allclose(np.sqrt(np.diag(rows @ left @ rows.T)), list(seen.deviations.values()), rtol=1e-3)


def driven(text, seconds=4.0, noise=0.0, seed=0):
    """A model's run under random switching from rest."""
    rows = round(seconds * RATE) + 1
    current = np.repeat(np.random.default_rng(seed).choice([-0.4, 0.4], rows // 50 + 1), 50)[:rows]
    rest = {"hub": np.zeros(rows), "bend": np.zeros(rows)}
    clean = model(text).simulate(ftlm.Run.from_arrays(step=1 / RATE, inputs={"I": current}, outputs=rest))
    noisy = np.random.default_rng(seed + 1).standard_normal((2, rows)) * noise
    return clean, clean.with_outputs({"hub": clean["hub"] + noisy[0], "bend": clean["bend"] + noisy[1]})


def test_a_bend_that_nothing_measures_is_observed_from_the_hub():
    """The run is the exact one of fractional orders."""
    clean, noisy = driven(BROKEN, noise=1e-4)
    seen = control.observer(model(BROKEN), measured=["hub"], noise={"hub": 1e-4}, process_noise=0.05)
    found = seen.estimate_run(noisy)
    assert np.std(found["bend"] - clean["bend"]) < 0.03 * np.std(clean["bend"])
    assert "observer from hub" in str(seen)


def test_an_observer_along_a_run_is_the_recursion_and_takes_noise_away():
    clean, noisy = driven(BROKEN, noise=2e-3)
    seen = control.observer(model(BROKEN), noise={"hub": 2e-3, "bend": 2e-3}, process_noise=0.05)
    found = seen.estimate_run(noisy)
    a, b, c = seen.matrices
    y = np.array([noisy["hub"], noisy["bend"]])
    state = np.append(seen.equilibrium_state(y[:, 0]), 0.0)
    for k in range(1, 300):
        ahead = a @ state + b[:, 0] * noisy["I"][k - 1]
        state = ahead + seen.gain @ (y[:, k] - c @ ahead)
    assert found["bend"][299] == pytest.approx((seen.realization.c @ state[:-1])[1], abs=1e-9)
    tip, measured = clean["hub"] + clean["bend"], noisy["hub"] + noisy["bend"]
    assert np.std(found["hub"] + found["bend"] - tip) < 0.4 * np.std(measured - tip)
    # As much as it says, give or take what the poles are off.
    assert np.std(found["bend"] - clean["bend"]) < 1.3 * seen.deviations["bend"]


# ----------------------------------------------------------------------------------------------------------------------
# Linear-quadratic loop


def closed(controller, factor):
    """Largest eigenvalue of SciPy's plant, times a factor, under a controller: plant, what acts now, controller."""
    a, b, c = whole_system()
    own, into = controller._transition_matrices()
    gains = controller._gains
    # The command of a sample is the controller's next state; it acts from the next sample on.
    size, width = len(a), len(own)
    whole = np.zeros((size + 1 + width,) * 2)
    whole[:size, :size], whole[:size, size : size + 1] = a, b * factor
    whole[size : size + 1, :size] = -gains @ into @ c
    whole[size : size + 1, size + 1 :] = -gains @ own
    whole[size + 1 :, :size], whole[size + 1 :, size + 1 :] = into @ c, own
    return float(np.max(np.abs(np.linalg.eigvals(whole))))


def test_margins_on_the_response_are_those_of_eigenvalues():
    design = designed(WHOLE, samples=0)
    controller, nominal = design.controller, design.nominal
    assert nominal.stable
    assert closed(controller, 1.0) < 1.0
    # The smaller of both gain margins, up or down.
    sides = [closed(controller, nominal.gain * 1.02) > 1.0, closed(controller, 1 / (nominal.gain * 1.02)) > 1.0]
    assert any(sides)
    assert closed(controller, nominal.gain * 0.98) < 1.0
    assert closed(controller, 1 / (nominal.gain * 0.98)) < 1.0


def test_its_response_is_that_of_what_runs():
    """The answer to one sample that is not 0, transformed."""
    controller = designed(samples=0).controller
    w = np.array([3.0, 20.0, 90.0, 400.0])
    heard, asked = controller.response(w)
    rows = 1 << 13
    turn = np.exp(-1j * np.outer(w, np.arange(rows)) / RATE)

    def answer(at):
        controller.reset()
        controller([0.0, 0.0], 0.0)
        first = controller([float(at == 0), float(at == 1)], float(at == 2))
        return np.array([first, *(controller([0.0, 0.0], 0.0) for _ in range(rows - 1))])

    for at, exact in enumerate([*heard, asked]):
        pulse = answer(at)
        # The integral's answer stays: its own part is that of a step from there on.
        settled = pulse[-1]
        found = turn @ (pulse - settled) + settled / (1 - np.exp(-1j * w / RATE))
        assert np.allclose(found, exact, rtol=2e-3), at


def test_the_first_sample_kicks_nothing_and_the_limit_winds_nothing_up():
    design = designed(samples=0)
    controller = design.with_limit(0.9)
    assert controller([0.7, 0.0], 0.7) == pytest.approx(0.0, abs=1e-9)
    controller.reset()
    assert abs(controller([0.7, 1e-3], 0.7)) < 0.2
    controller.reset()
    # A hub that stands still whatever is asked for, for two seconds; then it is where it should be.
    assert {controller([0.0, 0.0], 1.0) for _ in range(1000)} == {0.9}
    assert controller.state_count == len(design.realization.a) + 2
    free = design.with_limit(math.inf)
    for _ in range(1000):
        free([0.0, 0.0], 1.0)
    told = [abs(c.estimate[UNKNOWN_INPUT]) for c in (controller, free)]
    assert told[0] < 2.0
    assert told[1] > 5.0 * told[0]


def test_designs_are_made_over_the_intervals_or_refused_in_words():
    text = "D^2 y = -63 D^0.95 y + 140 I"
    options = {"max_deviation": {"y": 0.02}, "max_input": 1.0, "noise": {"y": 3e-4}, "samples": 40}
    good = control.lqg(uncertain(text, {4: 0.01, 2: 3.0}), **options)
    assert len(good.samples) == 40
    assert good.stable_fraction == 1.0
    low, high = good.margin_interval("phase")
    assert low < good.nominal.phase < high
    assert "over the intervals (40 samples, 100 % stable)" in str(good)
    with pytest.raises(
        ftlm.ModelError, match=r"too wide to design on: in [0-9]+ of 40 .*the most uncertain is the coeff"
    ):
        control.lqg(uncertain(text, {2: 300.0, 4: 0.3}), **options)


def test_a_tip_comes_to_rest_on_the_virtual_arm_without_any_shaper():
    """Designed on the arm's linear fractional law; run with friction, coupling, offset and noise."""
    arm = ftlm.rig.ArmParameters.load("linear").model()
    design = control.lqg(
        arm,
        input="I1",
        max_deviation={"theta11": 0.02, "theta12": 0.02},
        max_input=1.0,
        process_noise=0.5,
        noise={"theta11": 3e-4, "theta12": 2e-4},
    )
    path = control.point_to_point(math.radians(20.0), 0.5, dwell_before=0.2, dwell_after=0.8)
    planned = control.inverse_dynamics(design, path, output="theta11 + theta12", limit=0.93)
    hold = control.DiscretePid(control.FractionalPid(20.0, 50.0, 0.5, 1.0, 1.0), RATE, limit=1.19)
    left = {}
    for name, reference in (("plain", path), ("inverse", planned.reference)):
        loops = control.JointControllers(design.with_limit(0.93), hold)
        run = ftlm.rig.control(loops, np.column_stack([reference, 0 * reference]), offset=(0.02, -0.02))
        assert run.metadata["faults"] == []
        tip = (run["theta11"] + run["theta12"])[-400:]
        left[name] = float(np.std(tip))
        assert abs(np.mean(tip[-100:]) - path[-1]) < 2e-3
    assert left["inverse"] < 1.2e-3
    assert left["inverse"] < 0.1 * left["plain"]
    told = run.metadata["control"]["controller"]["settings"]["hub1"]
    assert told["kind"] == "lqg"
    assert 0 < told["gain_error_db"] < 0.2
    with pytest.raises(ftlm.ModelError, match="reads hub, bend; the arm measures theta11"):
        control.JointControllers(designed(samples=0).controller)


REFUSED = [
    ({"max_deviation": {}}, r"max_deviation = {} is not a mapping .* to deviations; give such as \{'hub': 0.01\}"),
    ({"max_deviation": [0.1]}, "is not a mapping"),
    ({"max_deviation": {"hub + bent": 0.1}}, "did you mean 'bend'"),
    (
        {"max_deviation": {"hub": 0.0}},
        r"max_deviation\['hub'\] = 0.0 is not positive and finite; give a number above 0",
    ),
    ({"max_deviation": {"bend": 0.01}}, "state a maximum deviation of every output that integrates"),
    ({"max_input": -1.0}, "max_input = -1.0"),
    ({"max_input": "1"}, "max_input = '1' is not a number"),
    ({"process_noise": math.inf}, "process_noise = inf"),
    ({"noise": {"hub": 1e-4}}, "noise of bend is not known"),
    ({"noise": {"hob": 1e-4}}, "did you mean 'hub'"),
    ({"noise": 1e-4}, "noise = 0.0001 is not a mapping"),
    ({"measured": "hub"}, "measured = 'hub' is not a list"),
    ({"measured": ["hubb"]}, "did you mean 'hub'"),
    ({"measured": ["hub", "hub"]}, "is not a list of different outputs"),
    ({"measured": [["hub"], "bend"]}, r"measured = \['hub'\] is not one of the outputs"),
    ({"measured": ["h" * 9999]}, "measured = 'h{59}… is not one of the outputs"),
    ({"noise": {("hub",): 1e-4}}, r"\('hub',\): …}: this is not a measured output"),
    ({"noise": {"hub": 1e308, "bend": 1e-4}}, "noise of hub = 1e.308 is out of range"),
    ({"noise": {"hub": 1e30, "bend": 1e-4}}, "no observer from hub, bend .*; measure more, or narrow the band"),
    ({"max_deviation": {"hub": 5e-324}}, "= 5e-324 is out of range"),
    ({"max_deviation": {7: 0.1}}, "max_deviation = 7 is not a sum"),
    ({"max_deviation": 10**5000}, "max_deviation = an integer of 16610 bits is not a mapping"),
    ({"band": (1e-320, 100.0)}, "; use a narrower band"),
    ({"band": (10**5000,)}, "band = a tuple is not a pair"),
    ({"measured": ["bend"], "noise": {"bend": 1e-4}}, "no observer from bend"),
    ({"output": "huub"}, "did you mean 'hub'"),
    ({"output": "bend"}, "bend cannot follow a constant reference"),
    ({"input": "U"}, "input = 'U' is not one"),
    ({"limit": 0.0}, "limit = 0.0"),
    ({"rate": 0}, "rate = 0"),
    ({"band": (5.0, 1.0)}, "rad/s is out of range"),
    ({"band": 3.0}, "not a pair of frequencies"),
    ({"poles": 1}, "poles = 1"),
    ({"poles": "8"}, "poles = '8'"),
    ({"samples": -1}, "samples = -1"),
    ({"seed": 0.5}, "seed = 0.5"),
    ({"coupling": "loose"}, "coupling = 'loose'"),
    ({"sensor": "yes"}, "sensor = 'yes' is neither"),
    ({"max_deviation": {"hub": 1e-5, "bend": 1e-5}, "max_input": 10.0}, "no guaranteed margins"),
    ({"text": WHOLE.replace("- 30 D hub", "+ 30 D hub")}, "not stable .[12] of its poles"),
    ({"text": "D hub = -hub + sat(I, 0.5)"}, "I passes a saturation"),
    ({"text": "D^2 hub = -hub - D hub - fc*sign(D hub) + I", "fixed": {"fc": 0.1}}, "has friction"),
]


@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_what_is_no_loop_is_refused(case):
    options, words = REFUSED[case]
    given = {"max_deviation": DEAR, "max_input": 1.0, "noise": QUIET, **options}
    text, fixed = given.pop("text", WHOLE), given.pop("fixed", {})
    told = ftlm.Model(ftlm.equation(text, coupling="simulated", fixed=fixed))
    with pytest.raises(ftlm.ModelError, match=words):
        control.lqg(told, **given)


def test_what_is_no_model_or_no_loop_is_refused_by_name():
    for wrong in (None, 3, "hub", {}, ftlm.Model):
        with pytest.raises(ftlm.ModelError, match=r"model is .*, not a Model"):
            control.lqg(wrong, max_deviation=DEAR, max_input=1.0)
        with pytest.raises(ftlm.ModelError, match=r"model is .*, not a Model"):
            control.observer(wrong, process_noise=1.0)
        with pytest.raises(ftlm.ModelError, match=r"design is an? .*, not a PidDesign or an LqgDesign"):
            control.inverse_dynamics(wrong, control.point_to_point(0.3, 0.5))


def test_a_controller_answers_no_command_that_is_no_number():
    running = designed(WHOLE, samples=0).controller
    for measured, asked in (([math.nan, 0.0], 0.0), ([0.0, 0.0], math.inf), ([1e308, -1e308], 0.0)):
        running.reset()
        with pytest.raises(ftlm.ModelError, match="a measurement, the reference or a state is not finite"):
            running(measured, asked)


def test_without_python_control_its_name_is_said(monkeypatch):
    def absent(name, *_):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(ftlm.ModelError, match=r"pip install 'ftlm\[control\]'"):
        designed(samples=0)


def test_an_observer_reads_a_run_that_fits_it():
    seen = control.observer(model(WHOLE), noise=QUIET, process_noise=0.3)
    run = driven(WHOLE, seconds=0.2)[0]
    with pytest.raises(ftlm.DataError, match="has no bend; the observer reads I, hub, bend"):
        seen.estimate_run(run.select(["I", "hub"]))
    with pytest.raises(ftlm.DataError, match="design it with rate=250"):
        seen.estimate_run(run.resample(0.004))
    with pytest.raises(ftlm.ModelError, match="process_noise = 0"):
        control.observer(model(WHOLE), noise=QUIET, process_noise=0)


# ----------------------------------------------------------------------------------------------------------------------
# Inverse dynamics


def test_a_planned_command_moves_the_exact_model_along_the_path():
    """The command alone, through the free run of fractional orders."""
    path = control.point_to_point(0.3, 0.5)
    planned = control.inverse_dynamics(designed(samples=0), path, output="hub + bend")
    rest = {"hub": 0 * path, "bend": 0 * path}
    # What is answered acts a sample later.
    run = ftlm.Run.from_arrays(step=1 / RATE, inputs={"I": np.append(0.0, planned.command[:-1])}, outputs=rest)
    moved = model(BROKEN).simulate(run)
    assert np.max(np.abs(moved["hub"] + moved["bend"] - path)) < 1e-3 * 0.3
    assert np.max(np.abs(moved["bend"] - planned.outputs["bend"])) < 1e-3 * 0.3
    assert planned.uncompensated_vibration > 5e-3
    assert planned.residual_vibration is None


def test_a_planned_reference_moves_the_loop_along_the_path():
    """Sample by sample: SciPy's plant under the controller."""
    design = designed(WHOLE, samples=0)
    path = control.point_to_point(0.3, 0.5)
    planned = control.inverse_dynamics(design, path, output="hub + bend")
    a, b, c = whole_system()
    state, acting, tip = np.zeros((4, 1)), 0.0, []
    design.controller.reset()
    for asked in planned.reference:
        y = (c @ state)[:, 0]
        tip.append(float(y.sum()))
        answer = design.controller(y, float(asked))
        state = a @ state + b * acting
        acting = answer
    assert np.max(np.abs(np.array(tip) - path)) < 1e-3 * 0.3


def test_a_fractional_pid_moves_a_hub_along_the_path():
    hub = ftlm.Model(ftlm.equation("D^2 theta = -63 D^0.95 theta + 140 I"))
    design = control.fractional_pid(hub, crossover=60.0)
    path = control.point_to_point(0.3, 0.4)
    planned = control.inverse_dynamics(design, path)
    run = ftlm.Run.from_arrays(
        step=1 / RATE, inputs={"I": np.append(0.0, planned.command[:-1])}, outputs={"theta": 0 * path}
    )
    assert np.max(np.abs(hub.simulate(run)["theta"] - path)) < 1e-3 * 0.3
    # What is off behind the path without it is a loop's lag, and its integral's.
    assert planned.uncompensated_vibration > 5e-4


def test_a_move_begins_and_ends_at_rest():
    path = control.point_to_point(-0.5, 0.4, 1000.0, dwell_before=0.1, dwell_after=0.2)
    assert path.size == 701
    assert path[0] == 0.0
    assert path[-1] == -0.5
    assert np.all(np.diff(path) <= 0)
    jerk = np.diff(path, 3) * 1000.0**3
    assert abs(jerk[98]) < 0.01 * np.max(np.abs(jerk))


PATHS = [
    ({"path": "text"}, ftlm.DataError, r"has shape \(\); give 16"),
    ({"path": [1.0, 2.0]}, ftlm.DataError, r"has shape \(2,\); give 16"),
    ({"path": np.zeros(100)}, ftlm.DataError, "all points are equal"),
    ({"path": np.r_[np.zeros(50), 1e308, 1e308]}, ftlm.DataError, r"beyond 1e.100 at row 50 .2 such"),
    ({"output": 10**5000}, ftlm.ModelError, "output = an integer of 16610 bits is not a sum"),
    ({"path": np.arange(100.0)}, ftlm.DataError, "does not begin at rest"),
    ({"path": np.r_[0, 0, np.arange(100.0)]}, ftlm.DataError, "does not end at rest"),
    ({"path": np.r_[0, 0, np.nan, np.inf, np.ones(50)]}, ftlm.DataError, r"not finite at row 2 .2 such"),
    ({"limit": 0.2}, ftlm.ModelError, r"needs a command of .* over the limit of 0.2; give it more time"),
    ({"limit": "1"}, ftlm.ModelError, "limit = '1' is not a number"),
    ({"output": "hub + bned"}, ftlm.ModelError, "did you mean 'bend'"),
    ({"output": None}, ftlm.ModelError, "output = None is not a sum"),
    ({"samples": 1.5}, ftlm.ModelError, "samples = 1.5"),
    ({"seed": -1}, ftlm.ModelError, "seed = -1"),
    (
        {"path": control.point_to_point(0.3, 0.2, dwell_before=0.0)},
        ftlm.ModelError,
        "stay at rest longer before the move",
    ),
]


@pytest.fixture(scope="module")
def ready():
    return designed(WHOLE, samples=0)


@pytest.mark.parametrize("case", range(len(PATHS)))
def test_what_cannot_be_followed_is_refused(case, ready):
    options, kind, words = PATHS[case]
    with pytest.raises(kind, match=words):
        control.inverse_dynamics(ready, **{"path": control.point_to_point(0.3, 0.5), "output": "hub + bend", **options})


def test_intervals_too_wide_for_a_path_are_refused_in_words():
    text = "D^2 y = -63 D^0.95 y + 140 I"
    options = {"crossover": 40.0, "samples": 0}
    path = control.point_to_point(0.3, 0.5)
    good = control.inverse_dynamics(control.fractional_pid(uncertain(text, {4: 0.002, 2: 0.2}), **options), path)
    assert 0 < good.residual_vibration < good.uncompensated_vibration
    with pytest.raises(ftlm.ModelError, match=r"too wide to design on: within them .* longer or richer run"):
        control.inverse_dynamics(control.fractional_pid(uncertain(text, {2: 20.0}), **options), path)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"distance": math.nan}, "distance = nan"),
        ({"distance": "20"}, "distance = '20'"),
        ({"duration": 0.0}, "duration = 0.0"),
        ({"duration": 0.01}, "fewer than ten samples"),
        ({"duration": 1e6}, "longer than 100000"),
        ({"dwell_before": -1.0}, "dwell_before = -1.0"),
        ({"dwell_after": math.inf}, "dwell_after = inf"),
        ({"rate": -5}, "rate = -5"),
    ],
)
def test_what_is_no_move_is_refused(options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        control.point_to_point(**{"distance": 0.3, "duration": 0.5, **options})
