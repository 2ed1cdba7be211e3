"""Calls of Python functions whose arguments the extension does not check, each with one or two bad values.

Shapers, designs of controllers and observers, planned moves, files of controllers, what runs them, and a rig's loop; a
fit takes seconds and is not called here.
"""

import json
import signal
import tempfile
import warnings
from pathlib import Path

import extension_calls
import numpy as np

import ftlm
from ftlm import control

POLE = complex(-2.3, 17.5)
PID = control.FractionalPid(1.0, 2.0, 0.1, 0.7, 0.8)
REST = np.zeros((11, 2))
#: Longest message; what somebody hands over is cut where it is shown.
LONGEST = 2000
#: A call that takes longer hangs [s].
PATIENCE = 60


class Unreadable(float):
    def __float__(self):
        raise ValueError("not now")


class Longer(list):
    """A list of two that goes on."""

    def __len__(self):
        return 2

    def __iter__(self):
        return iter([0.0] * 5)


class MuteError(Exception):
    def __str__(self):
        raise ValueError("no words")


def fails(*_):
    raise MuteError


#: What hostile values of the extension's arguments do not have.
ODD = (
    10**5000,
    -(10**5000),
    np.float32(1),
    np.array(1.0),
    np.array([1.0, 2.0]),
    np.array(["a"], dtype=object),
    b"x",
    [],
    [[]],
    {"y": None},
    {None: 1},
    "\ud800",
    "theta",
    Unreadable(1.0),
    Longer(),
    object,
    np.bool_(True),
    1 + 1j,
    np.complex64(1),
    1e-320,
    1e-12,
    1e12,
    1e308,
    1 << 30,
    range(3),
    {1, 2},
    fails,
    np.datetime64("2020-01-01"),
    memoryview(b"abcdefgh"),
    ftlm.ModelError,
)


class Unwritable(ftlm.DataError):
    """What the attack itself cannot write down."""


def file_of(controller):
    """What stands in the file of a controller."""
    with tempfile.TemporaryDirectory() as folder:
        control.save_controller(controller, Path(folder) / "c.json")
        return json.loads((Path(folder) / "c.json").read_bytes())


def ran_from(content):
    """Reads a controller from a file of this content, and runs it."""
    try:
        text = json.dumps(content).encode()
    except (TypeError, ValueError, extension_calls.OursError) as error:
        raise Unwritable("no JSON") from error
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "c.json"
        path.write_bytes(text)
        made = control.load_controller(path)
    for _ in range(3):
        put = made(0.1) if isinstance(made, control.DiscretePid) else made([0.1] * len(made.observer.measured), 0.2)
        if not abs(put) <= made.limit:
            raise AssertionError(f"{put!r} is over the limit of {made.limit!r}")


def recipes():
    """Functions by name with sound arguments."""
    hub = ftlm.Model(ftlm.equation("D^2 theta = -63 D^0.95 theta + 140 I"))
    link = ftlm.Model(ftlm.equation("D^2 y = -300 y - 4 D^0.9 y + 300 u"))
    shaper = control.input_shaper(POLE)
    ran = {
        "reference": REST,
        "rig": "virtual",
        "limit": 30.0,
        "rate": 500.0,
        "seed": 0,
        "parameters": "effective",
        "real_time": False,
        "watchdog": 0.1,
        "arm": False,
        "name": "control",
    }
    turning = "D^2 hub = 160 bend - 30 D hub + 100 I; D^2 bend = -300 bend - 4 D bend - D^2 hub"
    watching = {
        "model": ftlm.Model(ftlm.equation(turning, coupling="simulated")),
        "input": "I",
        "measured": ["hub", "bend"],
        "noise": {"hub": 3e-4, "bend": 2e-4},
        "rate": 500.0,
        "band": (0.5, 150.0),
        "poles": 4,
        "coupling": "simulated",
        "sensor": False,
    }
    quick = watching | {"max_deviation": {"hub": 0.02}, "max_input": 1.0}
    return {
        "input_shaper": (
            control.input_shaper,
            {"model": link, "kind": "zv", "modes": 1, "coupling": "measured"},
        ),
        "input_shaper of a pole": (control.input_shaper, {"model": POLE, "kind": "zvd"}),
        "Shaper.filter": (shaper.filter, {"reference": np.ones(50), "rate": 500.0}),
        "Shaper.impulses": (shaper.impulses, {"rate": 500.0}),
        "fractional_pid": (
            control.fractional_pid,
            {
                "model": hub,
                "output": "theta",
                "input": "I",
                "crossover": 40.0,
                "phase_margin": 60.0,
                "rate": 500.0,
                "samples": 2,
                "seed": 0,
                "coupling": "simulated",
            },
        ),
        "observer": (control.observer, watching | {"process_noise": 0.2}),
        "lqg": (
            control.lqg,
            watching
            | {
                "max_deviation": {"hub": 0.02, "hub + bend": 0.02},
                "max_input": 1.0,
                "output": "hub",
                "process_noise": None,
                "limit": 5.0,
                "samples": 2,
                "seed": 0,
            },
        ),
        "smooth_move": (
            control.point_to_point,
            {"distance": 0.3, "duration": 0.5, "rate": 500.0, "dwell_before": 0.3, "dwell_after": 1.2},
        ),
        "inverse": (
            control.inverse_dynamics,
            {
                "design": control.fractional_pid(hub, crossover=40.0),
                "path": control.point_to_point(0.3, 0.5),
                "output": "theta",
                "limit": 30.0,
                "samples": 2,
                "seed": 0,
            },
        ),
        "load_controller": (control.load_controller, {"path": "none.json"}),
        "load_controller of a PID": (lambda **content: ran_from(content), file_of(control.DiscretePid(PID, 500.0))),
        "load_controller of an LQG": (lambda **content: ran_from(content), file_of(control.lqg(**quick).controller)),
        "FractionalPid": (
            lambda **numbers: control.DiscretePid(control.FractionalPid(**numbers), 500.0)(0.1),
            {"kp": 1.0, "ki": 2.0, "kd": 0.1, "lam": 0.7, "mu": 0.8},
        ),
        "Realised": (
            lambda pid, rate, **options: control.DiscretePid(pid, rate, **options)(0.1),
            {"pid": PID, "rate": 500.0, "limit": 1.0, "band": (1.0, 50.0), "order": 3},
        ),
        "HubLoops": (control.JointControllers, {"first": control.DiscretePid(PID, 500.0), "second": None}),
        "rig.control": (lambda **asked: ftlm.rig.control(lambda *_: (0.1, 0.0), **asked), ran),
        "rig.control, answers": (lambda answer: ftlm.rig.control(lambda *_: answer, REST), {"answer": (0.1, 0.0)}),
        "rig.control, what is called": (
            lambda controller: ftlm.rig.control(controller, REST),
            {"controller": lambda *_: (0.1, 0.0)},
        ),
    }


def bad(value, r):
    """Something else than this."""
    if r.random() < 0.5 or (isinstance(value, np.ndarray) and (value.ndim == 0 or value.dtype.kind == "O")):
        return r.choice(ODD)
    return extension_calls.hostile(value, r, large=False)


def late(*_):
    raise TimeoutError(f"took more than {PATIENCE} s")


def outcome(function, given):
    """None where a call was answered or refused in words, else what was wrong."""
    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(PATIENCE)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            function(**given)
    except (ftlm.FtlmError, MemoryError) as error:
        words = str(error)
        if isinstance(error, ftlm.InternalError) or not words or len(words) > LONGEST:
            return f"{type(error).__name__}: {words[:300]}"
    except extension_calls.OursError:
        pass
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:300]}"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    return None


def calls(r, count, only=()):
    """(name, what was wrong or None) of so many calls, each of a function by chance, of all or of some."""
    known = recipes()
    for _ in range(count):
        name = r.choice(list(only or known))
        function, given = known[name]
        for _ in range(2 if r.random() < extension_calls.TWICE else 1):
            at = r.choice(list(extension_calls.places(given)))
            given = extension_calls.exchanged(given, at, lambda value: bad(value, r))
        told = outcome(function, given)
        yield name, None if told is None else f"{told}: {shown_all(given)}"


def shown_all(given):
    """Arguments as they can be shown."""
    from ftlm.utils.validation import short_repr

    return {name: short_repr(value, 100) for name, value in given.items()}
