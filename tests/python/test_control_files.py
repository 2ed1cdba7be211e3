"""Controllers as files, commands control and shape: what they write runs, invalid input is refused with a message."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm import control
from ftlm.cli.main import app
from test_control import PID
from test_lqg import BROKEN, designed, model


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "m.json"
    model(BROKEN).save(path)
    return str(path)


WORDS = [
    "control",
    "--design",
    "lqg",
    "--max-deviation",
    "hub=0.02",
    "--max-deviation",
    "bend=0.02",
    "--max-input",
    "1",
    "--noise",
    "hub=3e-4",
    "--noise",
    "bend=2e-4",
    "--samples",
    "0",
]


def run(*words):
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.mark.parametrize("kind", ["pid", "lqg"])
def test_a_controller_comes_back_from_its_file_to_the_last_bit(kind, tmp_path):
    limit = 0.9
    made = (
        control.DiscretePid(PID, 250.0, limit=limit, order=4)
        if kind == "pid"
        else designed(samples=0).with_limit(limit)
    )
    control.save_controller(made, tmp_path / "c.json", model="by hand")
    read = control.load_controller(tmp_path / "c.json")
    assert type(read) is type(made)
    errors = np.random.default_rng(0).standard_normal((200, 2)) * 0.01
    for e in errors:
        given = (float(e[0]),) if kind == "pid" else (e, 0.1)
        assert read(*given) == made(*given)
    with pytest.raises(ftlm.DataError, match="exists"):
        control.save_controller(made, tmp_path / "c.json")


def test_a_pid_runs_from_the_numbers_of_its_file_alone(tmp_path):
    """As the file says it, in plain Python."""
    made = control.DiscretePid(PID, 250.0, order=4)
    control.save_controller(made, tmp_path / "c.json")
    settings = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))["controller"]
    assert "every lag becomes" in json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))["meaning"]
    states, last = None, 0.0
    for e in np.sin(np.arange(100) * 0.05) + 0.2:
        if states is None:
            states = [
                0.0 if g["of"] == "integral" else e * (g["now"] + g["before"]) / (1 - g["keep"])
                for g in settings["lags"]
            ]
        else:
            states = [
                g["keep"] * x + g["now"] * e + g["before"] * last for g, x in zip(settings["lags"], states, strict=True)
            ]
        output = (settings["kp"] + settings["direct"]) * e
        output += sum(g["weight"] * x for g, x in zip(settings["lags"], states, strict=True))
        assert made(float(e)) == pytest.approx(output, rel=1e-9)
        last = e


def test_an_lqg_runs_from_the_numbers_of_its_file_alone(saved, tmp_path):
    out = tmp_path / "c.json"
    assert run(*WORDS, saved, "--limit", 0.9, "-o", out).exit_code == 0
    made = control.load_controller(out)
    settings = json.loads(out.read_text(encoding="utf-8"))["controller"]
    a, b, c, correction, feedback = (np.array(settings[n]) for n in ("a", "b", "c", "correction", "feedback"))
    size = len(a)
    whole = np.block([[a, b], [np.zeros((1, size)), np.eye(1)]])
    x, u = np.zeros(size + 1), 0.0
    rows = [settings["outputs"].index(n) for n in settings["measured"]]
    for k in range(50):
        y = np.array([0.01 * np.sin(0.1 * k), 0.002 * np.cos(0.3 * k) if k else 0.0])
        x = x + correction @ (y - c[rows] @ x[:-1])
        x = whole @ x + np.append(b[:, 0], 0.0) * u
        u = float(np.clip(settings["ahead"] * 0.3 - np.append(feedback[0], 1.0) @ x, -0.9, 0.9))
        assert made(y, 0.3) == pytest.approx(u, abs=1e-9)


def broken_files():
    good = {"format": "ftlm-controller", "schema": 1, "written_by": "", "model": "", "meaning": ""}
    pid = {
        "type": "pid",
        "kp": 1.0,
        "ki": 1.0,
        "kd": 0.0,
        "lam": 1.0,
        "mu": 1.0,
        "rate": 100.0,
        "limit": None,
        "band": [1.0, 10.0],
        "order": 3,
        "direct": 0.0,
        "lags": [],
    }
    yield b"", "not an ftlm controller"
    yield b"[" * 100_000, "not an ftlm controller"
    yield json.dumps(good).encode(), "missing required field"
    yield json.dumps(good | {"controller": pid | {"kp": "1"}}).encode(), "Expected `float`"
    yield json.dumps(good | {"controller": pid | {"type": "bang"}}).encode(), "Invalid value 'bang'"
    yield json.dumps(good | {"controller": pid, "schema": 2}).encode(), "read it with the version that wrote it, or"
    yield (
        json.dumps(good | {"controller": {"type": "mpc"}, "schema": 2, "written_by": "ftlm 9"}).encode(),
        r"a controller file of schema 2 \(written by .ftlm 9.\), and ftlm .* reads schema 1; read it with the version",
    )
    yield json.dumps(good | {"controller": pid | {"rate": -1.0}}).encode(), "damaged: rate"
    yield json.dumps(good | {"controller": pid | {"order": 10**6}}).encode(), "damaged: order"
    yield json.dumps(good | {"controller": pid, "more": 1}).encode(), "unknown field `more`"
    yield b" " * (1 << 21), "no controller is larger"


@pytest.mark.parametrize("case", range(11))
def test_what_is_no_controller_is_refused(case, tmp_path):
    data, words = list(broken_files())[case]
    path = tmp_path / "c.json"
    path.write_bytes(data)
    with pytest.raises(ftlm.DataError, match=words):
        control.load_controller(path)
    with pytest.raises(ftlm.DataError, match="cannot be read"):
        control.load_controller(tmp_path / "none.json")
    with pytest.raises(ftlm.ModelError, match="give a DiscretePid or an Lqg"):
        control.save_controller(PID, tmp_path / "p.json")


def test_a_damaged_lqg_is_refused_by_what_is_wrong(tmp_path):
    control.save_controller(designed(samples=0).controller, tmp_path / "c.json")
    whole = json.loads((tmp_path / "c.json").read_text(encoding="utf-8"))
    for key, value, words in (
        ("a", [[1.0]], "has shape"),
        ("feedback", [[1.0]], "feedback has shape"),
        ("measured", ["hub", "bond"], "bond is not one of its outputs"),
        ("rate", 0.0, "rate is not above 0"),
        ("noise", [], "has no noise level"),
        ("poles", [], "0 poles do not match"),
        ("tracked", "h" * 9999, "damaged: h{500}"),
        ("deviations", [1.0], "approximation errors"),
        ("b", [1.0], "Expected `array`"),
        ("feedback", [[1e999] * len(whole["controller"]["a"])], "is not an ftlm controller|not finite"),
    ):
        content = whole | {"controller": whole["controller"] | {key: value}}
        (tmp_path / "c.json").write_text(json.dumps(content), encoding="utf-8")
        with pytest.raises(ftlm.DataError, match=words):
            control.load_controller(tmp_path / "c.json")


def test_control_writes_a_controller_and_a_plan(saved, tmp_path):
    out, plan = tmp_path / "c.json", tmp_path / "p.csv"
    done = run(
        *WORDS, saved, "--path", "0.3:0.5", "--output", "hub+bend", "-o", out, "--trajectory", plan, "--limit", 5
    )
    assert done.exit_code == 0, done.output
    assert "realised by" in done.output
    assert "phase margin" in done.output
    rows = np.genfromtxt(plan, delimiter=",", names=True)
    assert rows["path"][-1] == pytest.approx(0.3)
    assert rows["hub"] + rows["bend"] == pytest.approx(rows["path"], abs=1e-6)
    as_json = json.loads(run(*WORDS, saved, "--json", "--path", "0.3:0.5", "--output", "hub+bend").output)
    assert as_json["nominal"]["stable"] is True
    assert as_json["planned"]["rows"] == rows.size
    pid = tmp_path / "pid.json"
    done = run("control", saved, "--output", "hub", "--crossover", 30, "--samples", 0, "-o", pid)
    assert done.exit_code == 0, done.output
    assert isinstance(control.load_controller(pid), control.DiscretePid)


def test_shape_writes_what_a_reference_is_convolved_with(saved, tmp_path):
    out = tmp_path / "s.csv"
    done = run("input-shaper", saved, "--kind", "zvd", "--rate", 200, "--coupling", "measured", "-o", out)
    assert done.exit_code == 0, done.output
    assert "ZVD shaper of" in done.output
    rows = np.genfromtxt(out, delimiter=",", names=True)
    shaper = control.input_shaper(ftlm.load_model(saved), "zvd", coupling="measured")
    assert rows["share"] == pytest.approx(shaper.impulses(200.0), abs=1e-11)
    assert json.loads(run("input-shaper", saved, "--json").output)["kind"] == "zv"


REFUSED = [
    (("control", "MODEL", "--crossover", 40), "several outputs; name one with --output"),
    (("control", "MODEL", "--output", "hub"), "--crossover is missing"),
    (
        ("control", "MODEL", "--output", "hub", "--crossover", 40, "--max-input", 1),
        "--max-input: used with --design lqg",
    ),
    (("control", "MODEL", "--design", "lqg"), "--max-deviation OUTPUT=A and --max-input A are missing"),
    ((*WORDS, "MODEL", "--crossover", 40), "--crossover: used with --design pid"),
    ((*WORDS, "MODEL", "--max-deviation", "hob=1"), "did you mean 'hub'"),
    ((*WORDS, "MODEL", "--noise", "hub"), "names 'hub' twice"),
    ((*WORDS, "MODEL", "--band", "1"), "--band '1' has 1 numbers; give 2, joined"),
    ((*WORDS, "MODEL", "--band", "9:1"), "rad/s is out of range"),
    ((*WORDS, "MODEL", "--path", "0.3"), "--path '0.3' has 1 numbers; give 2, joined"),
    ((*WORDS, "MODEL", "--path", "0.3:0.5", "--output", "hub+tip"), "is not a sum of outputs"),
    ((*WORDS, "MODEL", "--path", "9:0.5", "--output", "hub+bend", "--limit", "0.9"), "over the limit of 0.9"),
    ((*WORDS, "MODEL", "--trajectory", "p.csv"), "give --path SIZE:SECONDS"),
    ((*WORDS, "MODEL", "--output", "hub+bend"), "is not one of the outputs"),
    ((*WORDS, "MODEL", "-o", "c.mat"), "does not end in .json"),
    ((*WORDS, "MODEL", "--path", "0.3:0.5", "--trajectory", "p.txt"), "does not end in .csv"),
    ((*WORDS, "MODEL", "--limit", -1), "--limit -1"),
    ((*WORDS, "MODEL", "--rate", 0), "--rate 0"),
    ((*WORDS[:-2], "MODEL", "--samples", -1), "--samples -1"),
    ((*WORDS, "MODEL", "--input", "U"), "input = 'U' is not one"),
    ((*WORDS, "no.json"), "cannot be read"),
    (("input-shaper", "MODEL", "--modes", 0), "--modes 0"),
    (("input-shaper", "MODEL", "--modes", 9), "9 modes are to be shaped, but"),
    (("input-shaper", "MODEL", "--rate", 1), "fewer than four samples"),
    (("input-shaper", "MODEL", "--kind", "zw"), "is not one of"),
    (("input-shaper", "MODEL", "-o", "s.json"), "does not end in .csv"),
]


@pytest.mark.parametrize("case", range(len(REFUSED)))
def test_what_the_commands_cannot_use_is_refused_in_words(case, saved, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words, said = REFUSED[case]
    failed = run(*[saved if w == "MODEL" else w for w in words])
    assert failed.exit_code in (2, 3), failed.output
    assert said in " ".join(failed.output.split()), failed.output
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_is_not_stable_is_refused(tmp_path):
    path = tmp_path / "u.json"
    ftlm.Model(ftlm.equation("D^2 hub = 9 D hub + I")).save(path)
    for words in (
        ("control", path, "--crossover", 40),
        ("control", path, "--design", "lqg", "--max-deviation", "hub=1", "--max-input", 1, "--noise", "hub=1e-3"),
        ("input-shaper", path),
    ):
        failed = run(*words)
        assert failed.exit_code == 2
        assert "not stable" in failed.output
