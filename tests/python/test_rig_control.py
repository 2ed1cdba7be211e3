"""Controllers in the loop: what a good one is handed, and that a bad one ends at 0 V with its cause and its run."""

import os
import re
import signal
import time

import numpy as np
import pytest

import ftlm
from ftlm import control, rig
from ftlm.rig import recording
from ftlm.rig import rig as rig_module
from ftlm.rig.quanser import QuanserBoard
from quanser_stand_in import Board
from rig_bench import Bench

HOLD = (0.1, 0.05)


@pytest.fixture(params=["virtual", "q8"])
def bench(request, tmp_path, monkeypatch):
    return Bench(request.param, tmp_path, monkeypatch)


def proportional(time, angles, reference):
    """A spring between both hubs and their references."""
    return np.clip(3.0 * (reference - angles[[0, 2]]), -0.5, 0.5)


class Bad:
    """Drives for a tenth of a second; then it does what is asked."""

    def __init__(self, answer):
        self.answer, self.asked = answer, 0

    def __call__(self, time, angles, reference):
        self.asked += 1
        return self.answer(self) if time > 0.0999 else (0.2, 0.1)


def borne(monkeypatch):
    """A busy machine may be late in real time; that is not what is tested here."""
    monkeypatch.setattr(recording, "Limits", lambda: rig.Limits(max_write_delay=60.0, max_missed_deadlines=10**9))
    monkeypatch.setattr(rig_module, "WATCHDOG_RANGE_S", (0.01, 60.0))


def run_with(bench, controller, **options):
    return rig.control(controller, HOLD, bench.board, arm=True, duration=0.4, rate=bench.rate, **options)


def test_each_sample_is_answered_at_the_next_and_recorded(bench, tmp_path):
    seen = []

    def controller(time, angles, reference):
        seen.append((time, angles, reference))
        answer = proportional(time, angles, reference)
        # What it is handed is its own to spoil.
        angles[:] = reference[:] = np.nan
        return answer

    told = []
    reference = np.linspace(0.0, 0.1, 201)[:, None] * (1.0, -0.5)

    def spy(time, angles, reference):
        told.append((time, angles.copy(), reference.copy()))
        return controller(time, angles, reference)

    run = rig.control(spy, reference, bench.board, arm=True, rate=bench.rate, out=tmp_path / "run.csv")
    bench.assert_safe()
    assert run.length == 201
    assert len(told) == 199
    assert np.allclose([t for t, _, _ in told], np.arange(199) / bench.rate)
    angles = np.column_stack([run[n] for n in ("theta11", "theta12", "theta21", "theta22")])
    assert np.array_equal([y for _, y, _ in told], angles[:199])
    assert np.array_equal(np.column_stack([run["reference1"], run["reference2"]]), reference)
    assert np.array_equal([r for _, _, r in told], reference[:199])
    currents = np.column_stack([run["I1"], run["I2"]])
    assert np.allclose(currents[1:200], [proportional(*row) for row in told], atol=1e-12)
    assert np.all(currents[[0, -1]] == 0.0)
    loaded = ftlm.load(tmp_path / "run.csv")
    assert loaded.inputs == ("I1", "I2", "reference1", "reference2")
    assert np.array_equal(loaded["reference2"], reference[:, 1])
    assert loaded.metadata["control"] == {"controller": {"name": "spy"}}


def test_the_loop_closes_the_same_way_on_both_rigs_and_in_real_time(tmp_path, monkeypatch):
    runs = [run_with(Bench(kind, tmp_path, monkeypatch), proportional) for kind in ("virtual", "q8")]
    borne(monkeypatch)
    real_time = rig.control(proportional, HOLD, parameters="linear", duration=0.4, real_time=True, watchdog=60.0)
    for name in ("theta11", "theta12", "I1", "I2"):
        assert np.abs(runs[0][name] - runs[1][name]).max() < 1e-12
        assert np.array_equal(runs[0][name], real_time[name])
    assert 0.05 < runs[0]["theta11"][-1] < 0.11


def test_equal_seeds_close_equal_loops():
    first, second = (rig.control(proportional, HOLD, duration=0.5, seed=3) for _ in range(2))
    assert all(np.array_equal(first[n], second[n]) for n in (*first.inputs, *first.outputs))


def fails(bad):
    raise ZeroDivisionError("in the controller")


class MuteError(Exception):
    def __str__(self):
        raise ValueError("no words")


class Liar(list):
    """A list of two that goes on."""

    def __iter__(self):
        return iter([0.0] * 5)


class Unreadable(float):
    def __float__(self):
        raise ValueError("not now")


def raises(error):
    raise error


BAD = {
    "nan": (lambda bad: (np.nan, 0.0), "returned nan for motor 1, not a finite current"),
    "infinite": (lambda bad: (0.0, -np.inf), "returned -inf for motor 2"),
    "text": (lambda bad: "0.1", "returned text"),
    "bytes": (lambda bad: b"12", "returned text"),
    "nothing": (lambda bad: None, "returned nothing"),
    "a number": (lambda bad: 0.1, "returned a float, not both currents"),
    "one": (lambda bad: [0.1], "returned 1 values"),
    "three": (lambda bad: [0.1, 0.1, 0.1], "returned 3 values"),
    "shape": (lambda bad: np.zeros((1, 2)), r"an array of shape \(1, 2\)"),
    "too much": (lambda bad: (0.95, 0.0), r"asked motor 1 for 0.95 A, over the limit of 0.94 A"),
    "far too much": (lambda bad: (0.0, 10**400), "returned inf for motor 2"),
    "truth": (lambda bad: (True, 0.0), "returned a bool for motor 1"),
    "texts": (lambda bad: ("0.1", "0.1"), "returned a str for motor 1"),
    "complex": (lambda bad: (0.1j, 0.0), "returned a complex for motor 1"),
    "exception": (fails, r"failed \(ZeroDivisionError: in the controller\)"),
    # What is told of an error must neither fail by itself nor leave a file that cannot be read.
    "mute": (lambda bad: raises(MuteError()), r"failed \(MuteError: its message cannot be read\)"),
    "endless": (lambda bad: raises(ValueError("x" * 10**7)), r"failed \(ValueError: x{500}…\)"),
    "half a pair": (lambda bad: raises(ValueError("\ud800")), r"failed \(ValueError: \\ud800\)"),
    "a liar": (lambda bad: Liar((0.1, 0.1)), r"returned cannot be read \(ValueError: "),
    "a float of its own": (lambda bad: (Unreadable(0.1), 0.0), r"returned cannot be read \(ValueError: not now\)"),
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_answer_is_0_v_at_once_with_its_cause_and_its_run(bench, tmp_path, what):
    answer, words = BAD[what]
    bad = Bad(answer)
    path = tmp_path / "run.csv"
    with pytest.raises(ftlm.RigFault, match=f"at 0.1 s .*the controller .*{words}") as fault:
        run_with(bench, bad, out=path)
    bench.assert_safe(within=153)
    assert bad.asked == 51
    loaded = ftlm.load(path)
    assert loaded.length == fault.value.run.length == 51
    assert np.array_equal(loaded["I1"], [0.0] + [0.2] * 50)
    assert re.search(words, loaded.metadata["faults"][0])
    caused = {"exception": ZeroDivisionError, "mute": MuteError}
    raised = ValueError if words.startswith((r"failed \(V", "returned cannot")) else type(None)
    assert isinstance(fault.value.__cause__, caused.get(what, raised))


def test_a_fault_of_the_rig_stays_the_rigs(bench, tmp_path):
    bench.inject("limit switch", 100, 2)
    with pytest.raises(ftlm.RigFault, match=r"limit switch 2 is tripped; [^;]*; [0-9]+ rows") as fault:
        run_with(bench, proportional)
    assert "controller" not in str(fault.value)
    bench.assert_safe()


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.06, "a command was 5[0-9].[0-9] ms late, more than the limit of 50 ms"), (0.3, "the watchdog expired")],
)
def test_a_late_answer_of_the_board_is_0_v_and_named(tmp_path, monkeypatch, seconds, words):
    bench = Bench("q8", tmp_path, monkeypatch)
    bad = Bad(lambda bad: bench.hardware.sleep(seconds) or (0.2, 0.1))
    with pytest.raises(ftlm.RigFault, match=words) as fault:
        run_with(bench, bad)
    assert f"the controller took {seconds} s to answer to the sample at 0.1 s" in str(fault.value)
    assert fault.value.run.length in (51, 52)
    bench.assert_safe()
    expired = [at for what, at, _ in bench.hardware.log if what == "expired"]
    assert len(expired) == (seconds == 0.3)


def test_answers_a_little_late_every_time_are_a_fault(tmp_path, monkeypatch):
    bench = Bench("q8", tmp_path, monkeypatch)
    with pytest.raises(ftlm.RigFault, match="21 deadlines in a row were missed") as fault:
        run_with(bench, Bad(lambda bad: bench.hardware.sleep(0.0042) or (0.2, 0.1)))
    assert "the controller took 0.0042 s" in str(fault.value)
    bench.assert_safe()


def test_a_controller_that_freezes_is_stopped_by_the_watchdog(tmp_path, monkeypatch):
    """In real time, against the process that watches: 0 V is out before the controller comes back."""
    bench = Bench("virtual", tmp_path, monkeypatch)
    bench.board.real_time = True
    borne(monkeypatch)
    seen = []

    def freeze(bad):
        page, until = bench.board._page, time.monotonic() + 120.0
        assert page.volts != (0.0, 0.0)
        while page.volts != (0.0, 0.0) and time.monotonic() < until:
            time.sleep(0.01)
        seen.append((page.volts, page.has_expired, page.get("enabled")))
        return (0.2, 0.1)

    with pytest.raises(ftlm.RigFault, match=r"the watchdog expired.*the controller took .* s to answer") as fault:
        run_with(bench, Bad(freeze), watchdog=3.0)
    assert seen == [((0.0, 0.0), True, 0)]
    assert fault.value.run.length in (51, 52)
    bench.assert_safe()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_ends_a_program_while_it_waits_for_an_answer_ends_the_run(bench, tmp_path, number, request):
    if number == signal.SIGINT:
        kept = signal.signal(number, signal.default_int_handler)
        request.addfinalizer(lambda: signal.signal(number, kept))

    def ended(bad):
        os.kill(os.getpid(), number)
        time.sleep(5.0)

    with pytest.raises(KeyboardInterrupt if number == signal.SIGINT else SystemExit):
        run_with(bench, Bad(ended), out=tmp_path / "run.csv")
    bench.assert_safe(within=153)
    loaded = ftlm.load(tmp_path / "run.csv")
    assert loaded.length == 51
    assert "the controller had not answered to the sample at 0.1 s" in loaded.metadata["faults"][0]


def test_a_controller_is_reset_and_told_of():
    class Held:
        def __init__(self):
            self.calls = 0

        def reset(self):
            self.calls = 0

        def to_dict(self):
            return {"gain": 2.0}

        def __call__(self, time, angles, reference):
            self.calls += 1
            return 0, np.float32(0.1)

    held = Held()
    for _ in range(2):
        run = rig.control(held, (0, 0), duration=0.1, parameters="linear")
    assert held.calls == 49
    assert run.metadata["control"] == {"controller": {"name": "Held", "settings": {"gain": 2.0}}}
    assert run.metadata["faults"] == []


REFUSED = [
    ({"controller": 3, "reference": HOLD}, ftlm.ModelError, "controller is an int"),
    ({"reference": "text"}, ftlm.DataError, "not an array of hub angles"),
    ({"reference": None}, ftlm.DataError, "not an array of hub angles"),
    ({"reference": []}, ftlm.DataError, "not an array of hub angles"),
    ({"reference": [[0.1], [0.1]]}, ftlm.DataError, "not an array of hub angles"),
    ({"reference": [(0.1, 0.1j)] * 200}, ftlm.DataError, "not an array of hub angles"),
    ({"reference": [(0, 1), (0,)]}, ftlm.DataError, "not an array of numbers"),
    ({"reference": (0.1, 0.1)}, ftlm.ModelError, "needs duration"),
    ({"reference": np.zeros((2, 2))}, ftlm.ModelError, "fewer than three samples"),
    ({"reference": np.zeros((50, 2)), "duration": 0.2}, ftlm.DataError, "has 50 rows, .* has 101"),
    ({"reference": [(0.0, 0.0)] * 60 + [(0.0, np.nan)] * 3}, ftlm.DataError, "hub 2 is nan at row 60 .3 such rows"),
    ({"reference": [(0.0, 0.0)] * 60 + [(20.0, 0.0)]}, ftlm.ModelError, "hub 1 is 1146 degrees at 0.12 s .*travel"),
    ({"reference": np.zeros((200, 2)), "limit": 0.1}, ftlm.ModelError, "exceeds the limit of 0.1 s"),
    ({"reference": np.zeros((200, 2)), "rate": 0}, ftlm.ModelError, "rate = 0"),
    ({"reference": np.zeros((200, 2)), "watchdog": 0.0}, ftlm.ModelError, "watchdog = 0"),
    ({"reference": np.zeros((200, 2)), "rig": "q9"}, ftlm.ModelError, "'q9' is not known"),
    ({"reference": range(1 << 40)}, ftlm.ModelError, "has more than 50000000 values"),
    ({"reference": np.zeros((200, 2)), "rig": 10**5000}, ftlm.ModelError, "rig is an int"),
    ({"reference": np.zeros((200, 2)), "rate": 10**5000}, ftlm.ModelError, "rate = an integer of"),
    ({"reference": np.zeros((200, 2)), "watchdog": "0.1"}, ftlm.ModelError, "watchdog = '0.1' is not a number"),
    (
        {"reference": np.zeros((200, 2)), "real_time": None},
        ftlm.ModelError,
        "real_time = None is neither True nor False",
    ),
    ({"reference": np.zeros((200, 2)), "arm": "no"}, ftlm.ModelError, "arm = 'no' is neither True nor False"),
    ({"reference": np.zeros((200, 2)), "progress": 5}, ftlm.ModelError, "progress is an int"),
    ({"reference": np.zeros((200, 2)), "offset": "ab"}, ftlm.ModelError, "offset = 'ab' is not a pair"),
    ({"reference": np.zeros((200, 2)), "offset": 0.1}, ftlm.ModelError, "offset = 0.1 is not a pair"),
    ({"reference": np.zeros((200, 2)), "parameters": np.zeros(2)}, ftlm.ModelError, "parameters is a ndarray"),
    ({"reference": np.zeros((200, 2)), "sensor_filter": np.zeros(2)}, ftlm.ModelError, "sensor_filter = array"),
    ({"reference": np.zeros((200, 2)), "name": 10**5000}, ftlm.DataError, "an integer of .* cannot name a run"),
    ({"reference": np.zeros((200, 2)), "name": ""}, ftlm.DataError, "cannot name a run"),
    ({"reference": np.zeros((200, 2)), "out": "run.xlsx"}, ftlm.DataError, "neither .csv nor .parquet"),
]


@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_what_no_loop_can_be_run_with_is_refused_before_anything_moves(case):
    options, kind, words = REFUSED[case]
    with pytest.raises(kind, match=words):
        rig.control(**{"controller": proportional, **options})


class Telling:
    def __init__(self, told):
        self.told = told

    def to_dict(self):
        return self.told

    def __call__(self, time, angles, reference):
        return 0.0, 0.0


def nested(depth):
    told = {}
    for _ in range(depth):
        told = {"x": told}
    return told


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"x": np.nan}, "not valid JSON"),
        ({"x": 10**5000}, "not valid JSON"),
        (nested(10**5), "not valid JSON"),
        # What stands in a file must be read again: the line that holds it has its limit.
        ({"x": "x" * 10**6}, "1000042 characters long, more than the 100000"),
    ],
)
def test_a_controller_that_cannot_be_told_of_is_refused(told, words):
    with pytest.raises(ftlm.ModelError, match=words):
        rig.control(Telling(told), (0, 0), duration=0.1)


def test_whatever_a_controller_says_is_read_again(tmp_path):
    told = {"half a pair \ud800": "\udfff", "mark\n# ftlm-run 9 {}": "\x1b]0;x\x07\0</script>"}
    rig.control(Telling(told), (0, 0), duration=0.02, out=tmp_path / "run.csv")
    assert ftlm.load(tmp_path / "run.csv").metadata["control"]["controller"]["settings"] == told


def test_the_board_needs_arm(monkeypatch):
    hardware = Board("linear")
    hardware.install(monkeypatch)
    with pytest.raises(ftlm.ModelError, match="moves a real arm"):
        rig.control(proportional, HOLD, QuanserBoard(clock=lambda: hardware.time), duration=0.4)
    assert hardware.log == []


# ----------------------------------------------------------------------------------------------------------------------
# A controller keeps its rate

PID = control.FractionalPid(2.0, 1.0, 0.1, 0.9, 0.8)


def observed(rate, driven="I1", hub="theta11"):
    """An LQG of a double integrator with friction."""
    model = ftlm.Model(ftlm.equation(f"D^2 {hub} = -63 D^1 {hub} + 140 {driven}"))
    design = control.lqg(
        model, max_deviation={hub: 0.02}, max_input=1.0, noise={hub: 1e-4}, rate=rate, limit=0.9, samples=0
    )
    return design.controller


class Own:
    """A controller of a user that carries its rate."""

    rate = 250.0

    def __call__(self, time, angles, reference):
        return proportional(time, angles, reference)


@pytest.mark.parametrize(
    "make",
    [
        lambda: control.JointControllers(control.DiscretePid(PID, 250.0, limit=0.9)),
        lambda: control.JointControllers(None, control.DiscretePid(PID, 250.0, limit=0.9)),
        lambda: control.JointControllers(observed(250.0)),
        lambda: observed(250.0),
        Own,
    ],
    ids=["pid", "second", "lqg in joints", "lqg", "own"],
)
def test_a_controller_runs_at_its_own_rate_only(bench, make):
    for rate in (500.0, 100.0, 250.1):
        with pytest.raises(ftlm.ModelError, match=rf"rate = {rate:g} Hz is not the 250 Hz for which the controller"):
            rig.control(make(), HOLD, bench.board, arm=True, duration=0.1, rate=rate)
    assert bench.kind == "q8" or bench.board._page is None
    assert bench.kind == "virtual" or bench.hardware.log == []
    run = rig.control(make(), HOLD, bench.board, arm=True, duration=0.1)
    assert run.step == 1 / 250.0
    assert run.metadata["rate"] == 250.0
    assert rig.control(make(), np.zeros((26, 2)), bench.board, arm=True, rate=250).length == 26


def test_a_saved_controller_runs_as_it_is_loaded_or_says_what_to_wrap_it_in(tmp_path):
    lqgs = {"I1": observed(250.0), "I2": observed(250.0, "I2", "theta21")}
    for name, controller in lqgs.items():
        control.save_controller(controller, tmp_path / f"{name}.json")
        loaded = control.load_controller(tmp_path / f"{name}.json")
        run = rig.control(loaded, HOLD, duration=0.4, parameters="linear")
        assert run.step == 1 / 250.0
        other = {"I1": "I2", "I2": "I1"}[name]
        assert np.ptp(run[name]) > 0.0
        assert np.all(run[other] == 0.0)
        wrapped = control.JointControllers(*((loaded,) if name == "I1" else (None, loaded)))
        same = rig.control(wrapped, HOLD, duration=0.4, parameters="linear")
        assert np.array_equal(run[name], same[name])
    control.save_controller(control.DiscretePid(PID, 500.0, limit=0.9), tmp_path / "pid.json")
    loaded = control.load_controller(tmp_path / "pid.json")
    with pytest.raises(
        ftlm.ModelError, match=r"JointControllers\(controller\) for joint 1 or JointControllers\(None, "
    ):
        rig.control(loaded, HOLD, duration=0.1)
    run = rig.control(control.JointControllers(loaded), HOLD, duration=0.4, parameters="linear")
    assert np.abs(run["I1"]).max() <= 0.9


def test_joint_controllers_have_one_rate_and_their_own_motors():
    slow, fast = (control.DiscretePid(PID, rate, limit=0.9) for rate in (250.0, 500.0))
    with pytest.raises(ftlm.ModelError, match="have the rates 250 and 500 Hz"):
        control.JointControllers(slow, fast)
    assert control.JointControllers(slow, slow).rate == 250.0
    assert control.JointControllers(None).rate is None
    assert rig.control(control.JointControllers(None), HOLD, duration=0.1).step == 0.002
    with pytest.raises(ftlm.ModelError, match="controller of joint 1 commands I2, the current of joint 2; give it"):
        control.JointControllers(observed(250.0, "I2", "theta21"))
    with pytest.raises(ftlm.ModelError, match="controller of joint 2 commands I1"):
        control.JointControllers(None, observed(250.0))


def test_a_design_is_no_controller_and_says_so():
    model = ftlm.Model(ftlm.equation("D^2 theta11 = -63 D^0.95 theta11 + 140 I1"))
    with pytest.raises(ftlm.ModelError, match=r"controller is a PidDesign; .* a design is run by its controller"):
        rig.control(control.fractional_pid(model, crossover=20.0, samples=0), HOLD, duration=0.1)


def test_a_live_estimate_for_another_rate_is_refused():
    structure = ftlm.equation("D^2 theta11 = a D^0.95 theta11 + b I1")
    live = rig.Streaming(structure, step=0.004, max_duration=1.0)
    with pytest.raises(ftlm.ModelError, match=r"live = a stream with a step of 0.004 s, and the rig has 0.002 s"):
        rig.record(duration=0.1, live=live)
