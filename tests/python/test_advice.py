"""Advice on runs: every injected fault is found, clean runs raise no alarm, measured runs get what is true of them."""

import json

import numpy as np
import pytest

import ftlm
from ftlm import rig
from ftlm.validation.data_advice import spectral_lines
from measured import DATA, needs_data
from slow_cases import slow_after

ARM = {
    "time": "t_s",
    "inputs": {"I1": "Im1_meas_A", "I2": "Im2_meas_A"},
    "outputs": {f"theta{i}": f"th{i}_deg" for i in (11, 12, 21, 22)},
    "units": {f"theta{i}": "deg" for i in (11, 12, 21, 22)},
    "intersample": {"I1": "foh", "I2": "foh"},
}
KINDS = ("prbs", "square", "multisine", "chirp")


def made(h, u, y):
    return ftlm.Run.from_arrays(step=h, inputs={"u": u}, outputs={"y": y}, units={"y": "rad"})


def shape(kind, t, h, rng):
    if kind == "prbs":
        clock = max(1, int(rng.uniform(0.5, 3) / h))
        return np.repeat(rng.choice([-1.0, 1.0], t.size // clock + 1), clock)[: t.size]
    if kind == "square":
        period = rng.uniform(5, 20)
        return np.where((t + h / 2) % period < period / 2, 1.0, -1.0)
    if kind == "multisine":
        omega = np.arange(1, 9) * 2 * np.pi / rng.uniform(20, 40)
        return sum(np.cos(w * t + phase) for w, phase in zip(omega, rng.uniform(0, 6, 8), strict=True))
    return np.sin(2 * np.pi * (0.02 * t + 0.48 * t**2 / 2 / t[-1]))


def clean_runs(count):
    """Runs of random stable plants of order 0.4 to 2 with a time constant of about 1 s; every fifth without noise."""
    for seed in range(count):
        rng = np.random.default_rng([77, seed])
        alpha = rng.uniform(0.4, 2.0)
        own = [(1.0, 0.0)]
        if alpha > 1:
            own.insert(0, (2 * rng.uniform(0.05, 1), alpha / 2))
        terms = " ".join(f"- {c:.6f} D^{order:.4f} y" for c, order in own)
        duration, rows = rng.uniform(60, 200), int(rng.integers(1500, 3000))
        h = duration / rows
        t = np.arange(rows) * h
        u = shape(KINDS[seed % 4], t, h, rng)
        plant = ftlm.Model(ftlm.equation(f"D^{alpha:.4f} y = {terms} + {rng.uniform(0.1, 10):.6f} u"))
        y = plant.simulate(made(h, u, 0 * t), tolerance=1e-3)["y"]
        noise = 0.01 * np.std(y) * (seed % 5 != 4)
        yield seed, h, u, y + noise * rng.standard_normal(rows), rng


def with_faults(u, y, rng):
    """The same run with each fault in turn, of random size, sign and place."""
    n, size = y.size, np.std(y)
    sign = rng.choice([-1, 1])
    yield "starts_off_zero", u, y + sign * rng.uniform(0.3, 2) * size
    yield "drift", u, y + sign * rng.uniform(1, 3) * size * np.arange(n) / n
    limit = np.quantile(np.abs(y), rng.uniform(0.7, 0.97))
    yield "saturation", u, np.clip(y, -limit, limit)
    dead, first = y.copy(), int(rng.uniform(0, 0.6) * n)
    dead[first : first + int(rng.uniform(0.06, 0.3) * n)] = 0.0 if rng.random() < 0.5 else y[first]
    yield "channel_off", u, dead
    yield "constant_output", u, np.full(n, 0.3)
    yield "constant_input", np.ones(n), y
    spiked, at = y.copy(), rng.choice(np.arange(5, n - 5), rng.integers(1, 5), replace=False)
    spiked[at] += rng.choice([-1, 1], at.size) * rng.uniform(0.25, 2, at.size) * np.ptp(y)
    yield "spikes", u, spiked
    yield "wrap", u, (4 * y / size + np.pi) % (2 * np.pi) - np.pi


@slow_after(1, "seeds", [2, 20])
def test_injected_faults_are_found_and_clean_runs_raise_no_alarm(seeds):
    found, injected, alarms = {}, {}, []
    for seed, h, u, y, rng in clean_runs(seeds):
        advice = made(h, u, y).advice()
        alarms += [(seed, f.sentence) for f in advice]
        for fault, *signals in with_faults(u, y, rng):
            injected[fault] = injected.get(fault, 0) + 1
            found[fault] = found.get(fault, 0) + (fault in made(h, *signals).advice().codes)
    assert alarms == []
    recall = {fault: found[fault] / count for fault, count in injected.items()}
    assert min(recall.values()) >= 0.95, recall


def test_a_measured_current_that_follows_its_command_is_no_encoder_that_wraps():
    for seed in range(2):
        run = rig.record(input="prbs", period=0.05, duration=6, seed=seed)
        assert "wrap" not in run.advice().codes


@slow_after(3, "seed", range(8))
@pytest.mark.parametrize("closed", [True, False])
def test_feedback_is_told_from_a_command(closed, seed):
    # x' = -a x + b u sampled exactly; the controller reads the noisy output and drives it along a random reference.
    rng = np.random.default_rng([5, seed])
    n, h, a, b = 2000, 0.02, rng.uniform(0.2, 2), rng.uniform(0.5, 3)
    noise = rng.uniform(0.002, 0.02) * rng.standard_normal(n)
    reference = np.repeat(rng.choice([-1.0, 1.0], 40), 50)
    gain = rng.uniform(2, 8)
    decay, x = np.exp(-a * h), 0.0
    u, y = np.zeros(n), np.zeros(n)
    for k in range(n):
        y[k] = x + noise[k]
        error = reference[k] - (y[k] if closed else 0.0)
        # The command is computed from the last row's measurement, as by a controller of its own.
        u[k] = 0.0 if k == 0 else (gain * (reference[k] - y[k - 1]) if closed else error)
        x = decay * x + (1 - decay) / a * b * u[k]
    # A loop near its limit of stability has a tone of its own, which a command may have too.
    said = {"loop_in_data", "feedback_inconclusive"} & set(made(h, u, y).advice().codes)
    assert bool(said) == closed


def test_one_sine_excites_little_and_its_lines_are_counted():
    t = np.arange(4000) * 0.005
    wave = np.sin(6.3 * t)
    y = np.sin(6.3 * t - 0.5) * (1 - np.exp(-t)) + 1e-3 * np.random.default_rng(1).standard_normal(t.size)
    (finding,) = (f for f in made(0.005, wave, y).advice() if f.code == "one_sine")
    assert "a single sine at 6.28 rad/s" in finding.sentence
    assert "persistently exciting of order 2" in finding.sentence
    for lines in (1, 2, 3, 7):
        # Frequencies in no relation to the record, far enough apart to be told.
        u = sum(np.cos((3.1 + 5.7 * k) * t + k) for k in range(lines))
        assert spectral_lines(u)[0] == lines
    assert spectral_lines(np.sign(np.sin(np.pi * t + 1e-9)))[0] > 8


def test_free_numbers_are_counted_against_lines():
    t = np.arange(6000) * 0.005
    rng = np.random.default_rng(1)
    plant = ftlm.Model(ftlm.equation("D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u"))
    wanted = ftlm.equation("D^alpha y = a D^nu y + c y + b u")
    for waves, enough in (((3.1,), False), ((3.1, 7.7), False), ((1.3, 3.1, 7.7), True)):
        u = sum(np.sin(w * t) for w in waves)
        clean = plant.simulate(made(0.005, u, 0 * t), tolerance=1e-3)
        run = made(0.005, u, clean["y"] + 1e-3 * rng.standard_normal(t.size))
        said = [f.sentence for f in run.advice(wanted) if "free parameters" in f.sentence]
        assert bool(said) is not enough, waves
        if said:
            assert f"has 5 free parameters, but in steady state u determines only {2 * len(waves)}" in said[0]
        assert not [f for f in run.advice(plant.structure) if "free parameters" in f.sentence]
    arm = ftlm.flexible_link(form="published", stage=1)
    still = ftlm.Run.from_arrays(step=0.005, inputs={"I1": 0 * t + 1}, outputs={"theta11": t, "theta12": t**0.5})
    assert [f.code for f in still.advice(arm)].count("excitation_short") == 2


def test_inputs_that_move_together_are_named():
    rng = np.random.default_rng(2)
    u = np.repeat(rng.choice([-1.0, 1.0], 60), 30)
    y = np.convolve(u, 0.1 * 0.9 ** np.arange(200))[: u.size] + 1e-3 * rng.standard_normal(u.size)
    y[0] = 0.0
    other = np.repeat(rng.choice([-1.0, 1.0], 60), 30)
    for second, expected in ((-2 * u, True), (other, False)):
        run = ftlm.Run.from_arrays(step=0.1, inputs={"u": u, "v": second}, outputs={"y": y})
        assert any("are collinear" in f.sentence for f in run.advice()) is expected


def test_short_runs_are_named(small_model):
    few = made(0.1, np.ones(50) * np.arange(50) % 7, np.sin(np.arange(50)))
    assert "only 50 rows, too few" in str(few.advice())
    # A mode of 4 s seen for one second.
    t = np.arange(500) * 0.002
    swing = made(0.002, np.sign(np.sin(9 * t)), 1 - np.cos(2 * np.pi / 4 * t))
    assert "short" in swing.advice().codes
    assert "still moving at the end" in str(swing.advice())


def test_a_channel_that_was_zeroed_is_told_from_a_machine_at_rest():
    rng = np.random.default_rng(3)
    n = 3000
    u = np.repeat(rng.choice([-1.0, 1.0], 30), 100)
    noise = 1e-3 * rng.standard_normal(n)
    y = np.convolve(u, 0.02 * 0.98 ** np.arange(900))[:n] + noise
    zeroed = y.copy()
    zeroed[:200] = 0.0
    sentence = str(made(0.01, u, zeroed).advice())
    assert "exactly 0 rad from 0 s to 2 s (200 rows)" in sentence
    assert "window=(2.0, None)" in sentence
    # Simulated without noise, at rest until the input moves: nothing is wrong with it.
    late = u.copy()
    late[:200] = 0.0
    resting = np.convolve(late, 0.02 * 0.98 ** np.arange(900))[:n]
    assert "channel_off" not in made(0.01, late, resting).advice().codes


def test_a_fit_to_a_channel_that_was_off_says_so():
    rng = np.random.default_rng(5)
    u = np.repeat(rng.choice([-1.0, 1.0], 20), 40)
    link = ftlm.Model(ftlm.equation("D y = a y + b u", fixed={"a": -2.0, "b": 2.0}))
    y = link.simulate(made(0.01, u, 0 * u))["y"] + 1e-3 * rng.standard_normal(u.size)
    structure = ftlm.equation("D y = a y + b u")
    said = [w for w in ftlm.identify(made(0.01, u, y), structure).warnings if "exactly" in w]
    assert said == []
    y[:60] = 0.0
    run = made(0.01, u, y)
    said = [w for w in ftlm.identify(run, structure).warnings if "exactly" in w]
    (found,) = [f for f in run.advice() if f.code == "channel_off"]
    assert said == [f"run {run.name}: {found.sentence}"]


def test_advice_prints_counts_and_is_json(small_run):
    empty = small_run.advice()
    assert len(empty) == 0
    assert str(empty) == "advice on small, simulated: no findings"
    assert "no findings" in empty._repr_html_()
    hostile = ftlm.Run.from_arrays(
        step=1, inputs={"u": np.ones(200)}, outputs={"y": np.arange(200) % 9.0}, name="<b>x</b>"
    )
    advice = hostile.advice()
    assert "<b>" not in advice._repr_html_()
    document = json.loads(json.dumps(advice.to_dict()))
    assert document[0]["code"] == "constant_input"
    assert document[0]["input"] == "u"
    assert "1 in all 200 rows" in document[0]["text"]


def test_advice_changes_nothing_and_takes_hostile_runs():
    rng = np.random.default_rng(4)
    for y in (
        np.zeros(3),
        np.array([0.0, 1e150, -1e150]),
        np.full(300, 1e-310),
        1e149 * rng.standard_normal(300),
        np.where(np.arange(600) == 300, 1e100, 0.0),
        np.arange(400.0),
        5e-324 * (np.arange(300) % 2),
    ):
        run = ftlm.Run.from_arrays(step=0.1, inputs={"u": y[::-1]}, outputs={"y": y})
        before = run["y"].copy()
        str(run.advice())
        assert np.array_equal(run["y"], before)
    str(ftlm.Run.from_arrays(step=0.1, inputs={}, outputs={"y": rng.standard_normal(300)}).advice())


# ------------------------------------------------------------------------------------------------ the real arm


#: A loop in the data, or one that a tone of its own hides.
LOOP_CODES = {"loop_in_data", "feedback_inconclusive"}


@needs_data
def test_the_arms_record_of_2011():
    advice = ftlm.load(DATA / "two_link_psf" / "psf.csv", **ARM).advice()
    text = str(advice)
    assert "theta12 is exactly 0 rad from 0 s to 1.004 s" in text
    assert "theta22 is exactly 0 rad from 0 s to 0.204 s" in text
    assert {f.input for f in advice if f.code in LOOP_CODES} == {"I1", "I2"}
    assert set(advice.codes) <= {"channel_off", *LOOP_CODES, "starts_off_zero"}
    later = ftlm.load(DATA / "two_link_psf" / "psf.csv", window=(1.1, 19.5), **ARM).advice()
    assert set(later.codes) - LOOP_CODES == {"starts_off_zero"}
    assert LOOP_CODES & set(later.codes)


@needs_data
def test_the_arm_under_lqr():
    advice = ftlm.load(DATA / "two_link_lqr" / "lqr.csv", window=(0.1, 19.9), **ARM).advice()
    assert {f.input for f in advice if f.code in LOOP_CODES} == {"I1", "I2"}
    assert set(advice.codes) - LOOP_CODES == {"starts_off_zero"}


@needs_data
def test_the_heating_system_does_not_start_at_rest():
    table = np.loadtxt(DATA / "heating" / "heating_system.dat")
    run = ftlm.Run.from_arrays(step=2.0, inputs={"u": table[:, 1]}, outputs={"T": table[:, 2]}, units={"T": "degC"})
    assert run.advice().codes == ("starts_off_zero",)
    assert "129.3 degC" in str(run.advice())


def test_a_command_has_no_quantization():
    y = np.round(np.sin(0.1 * np.arange(200)), 2)
    signals = {"inputs": {"u": np.sign(y) + 2.0}, "outputs": {"y": y + 1.0}}
    figures = {s.name: s for s in ftlm.Run.from_arrays(step=0.1, **signals).inspect().signals}
    assert figures["u"].quantum == 0.0
    assert figures["y"].quantum == pytest.approx(0.01)
    measured = ftlm.Run.from_arrays(step=0.1, **signals, intersample={"u": "foh"}).inspect()
    assert {s.name: s.quantum for s in measured.signals}["u"] == pytest.approx(1.0)
