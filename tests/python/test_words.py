"""What is printed is true, what is asked for is used: options, delays, units of time, brackets, words of commands."""

from __future__ import annotations

import ast
import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command
from typer.testing import CliRunner

import ftlm
from ftlm.cli.framework import OPTION_BY_ARGUMENT, in_options
from ftlm.cli.main import app
from ftlm.data.units import TIME_UNITS
from ftlm.report.typesetting import equation_html
from ftlm.structure.equation import format_equation

WORDS = "D^1.6 y = a D^0.6 y + c y + b u"
FREE = "D^alpha y = a D^0.6 y + c y + b u"
PACKAGE = Path(ftlm.__file__).parent


def run_command(*words):
    return CliRunner().invoke(app, list(map(str, words)), env={"COLUMNS": "200", "NO_COLOR": "1"})


@pytest.fixture(scope="module")
def saved(small_run, tmp_path_factory):
    path = tmp_path_factory.mktemp("words") / "small.csv"
    small_run.to_csv(path)
    return path


# ------------------------------------------------------------------------------------------------ options of commands


@pytest.mark.parametrize(
    "words",
    [
        ["--friction"],
        ["--cross-stage"],
        ["--laws", "orders"],
        ["--laws", "none"],
        ["--coupling", "measured"],
        ["--input-order", "derived"],
        ["--stock-filter"],
        ["--inertial"],
        ["--cross-sensitivity"],
    ],
)
@pytest.mark.parametrize("command", ["identify", "search"])
def test_options_of_the_flexible_link_are_refused_with_an_equation(command, words, saved):
    done = run_command(command, saved, "--structure", FREE, *words)
    assert done.exit_code == 2
    assert words[0] in done.stderr
    assert "not used with one equation in words; leave it out" in done.stderr


def test_what_is_identified_live_needs_live(tmp_path):
    done = run_command("record", "-o", tmp_path / "r.csv", "--p", "3", "--order", "alpha1=1.9")
    assert done.exit_code == 2
    assert "--order, --p: of --live, which is not given" in done.stderr
    assert not (tmp_path / "r.csv").exists()


# ------------------------------------------------------------------------------------------------ delays


def test_a_delay_is_printed_wherever_the_equation_is(small_run):
    structure = ftlm.equation("D^1.6 y = -3 D^0.6 y - 8 y + 5 D^0.5 u + 2 u").with_delays({"u": 0.035})
    model = ftlm.Model(structure)
    assert str(model) == "D^1.6 y = -3 D^0.6 y - 8 y + 5 D^0.5 u(t - 0.035 s) + 2 u(t - 0.035 s)"
    plain = re.sub(r"<[^>]*>", "", str(equation_html(model.equations[0], structure.delay)))
    assert plain.count("u(t−0.035s)") == 2
    assert re.sub(r"<[^>]*>", "", model._repr_html_()).count("u(t−0.035s)") == 2
    assert "(t" not in format_equation(model.equations[0])
    found = ftlm.identify(small_run, ftlm.equation(WORDS).with_delays({"u": 0.04}), method="least-squares")
    assert "u(t - 0.04 s)" in str(found)
    assert "u(t - 0.04 s)" in found.to_dict()["equations"]["y"]
    assert "u(t−0.04s)" in re.sub(r"<[^>]*>", "", found._repr_html_())


# ------------------------------------------------------------------------------------------------ units of time


def table(path, header, scale=1.0, rows=40):
    lines = [f"{header},u,y"] + [f"{k * 0.01 / scale!r},{k % 3},{k % 7}" for k in range(rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


SIGNALS = {"inputs": {"u": "u"}, "outputs": {"y": "y"}}


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("time [ms]", "ms"),
        ("time (ms)", "ms"),
        ("Time_ms", "ms"),
        ("time/ms", "ms"),
        ("t [us]", "us"),
        ("t [µs]", "us"),
        ("t_μs", "us"),
        ("time [min]", "min"),
        ("t_h", "h"),
        ("time [msec]", "ms"),
        ("t (s)", "s"),
        ("time_s", "s"),
        ("T", "s"),
        ("seconds", "s"),
    ],
)
@pytest.mark.parametrize("named", [True, False])
def test_a_header_states_the_unit_of_time(header, unit, named, tmp_path):
    path = table(tmp_path / "r.csv", header, TIME_UNITS[unit])
    run = ftlm.load(path, **SIGNALS, **({"time": header} if named else {}))
    assert run.step == pytest.approx(0.01, rel=1e-9)
    said = [w for w in run.warnings if "time read in" in w]
    assert said == ([] if unit == "s" else [f"time read in {unit}, as the header {header!r} says"])


def test_no_other_header_states_one(tmp_path):
    for header in ("time_abs", "t (run 3)", "clock", "time of ms"):
        run = ftlm.load(table(tmp_path / "r.csv", header), time=header, **SIGNALS)
        assert (run.step, [w for w in run.warnings if "time read" in w]) == (0.01, [])


def test_a_header_and_an_argument_that_contradict_each_other_are_refused(tmp_path):
    path = table(tmp_path / "r.csv", "time [ms]", 1e-3)
    assert ftlm.load(path, **SIGNALS, time_unit="ms").step == pytest.approx(0.01, rel=1e-9)
    with pytest.raises(ftlm.DataError, match=r"its header states 'ms', and time_unit='s' is asked for; leave"):
        ftlm.load(path, **SIGNALS, time_unit="s")
    unknown = table(tmp_path / "x.csv", "time [samples]")
    with pytest.raises(ftlm.DataError, match=r"its header states the unit 'samples', which is unknown"):
        ftlm.load(unknown, **SIGNALS)
    assert ftlm.load(unknown, **SIGNALS, time_unit="ms").step == pytest.approx(1e-5)
    with pytest.raises(ftlm.DataError, match="is the unit of time=, which is not used; step= is in s"):
        ftlm.load(path, **SIGNALS, step=0.1, time_unit="s")
    frame = {"t [ms]": np.arange(40) * 10.0, "u": np.ones(40), "y": np.arange(40.0)}
    assert ftlm.Run.from_frame(frame, time="t [ms]", inputs=["u"], outputs=["y"]).step == pytest.approx(0.01)


def test_the_command_line_takes_a_unit_of_time(tmp_path):
    path = table(tmp_path / "r.csv", "clock", 1e-3)
    words = ["inspect", path, "--time", "clock", "-u", "u", "-y", "y"]
    done = run_command(*words, "--time-unit", "ms", "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)[0]["step"] == pytest.approx(0.01)
    done = run_command(
        "inspect", table(tmp_path / "s.csv", "time [ms]", 1e-3), "-u", "u", "-y", "y", "--time-unit", "s"
    )
    assert done.exit_code == 3
    assert "--time-unit s is asked for; leave --time-unit out" in done.stderr
    readers = {n for n, c in get_command(app).commands.items() if any("--sampling" in p.opts for p in c.params)}
    takers = {n for n, c in get_command(app).commands.items() if any("--time-unit" in p.opts for p in c.params)}
    assert readers == takers
    assert len(readers) >= 8


# ------------------------------------------------------------------------------------------------ help and messages


@pytest.mark.parametrize("name", sorted(get_command(app).commands))
def test_every_bracket_of_a_help_text_shows(name):
    shown = "".join(run_command(name, "--help").stdout.split())
    for parameter in get_command(app).commands[name].params:
        text = "".join((getattr(parameter, "help", None) or "").split())
        assert text in shown, parameter.name


def literals():
    """Every text in the package that somebody may read, with X for what is put in; docstrings left out."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.parent.name in ("cli", "paint"):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or not ast.unparse(node.func).endswith(("Error", "append", "bad_rows")):
                continue
            for inner in ast.walk(node):
                if isinstance(inner, ast.JoinedStr):
                    yield path.name, "".join(str(v.value) if isinstance(v, ast.Constant) else "X" for v in inner.values)
                elif isinstance(inner, ast.Constant) and isinstance(inner.value, str):
                    yield path.name, inner.value


def test_no_message_of_a_command_names_an_argument_of_python():
    pattern = re.compile(r"(?<![\w'\"])(" + "|".join(OPTION_BY_ARGUMENT) + r")=")
    found = [(name, text) for name, text in literals() if pattern.search(text)]
    assert len(found) > 20
    left = [(name, in_options(text)) for name, text in found if pattern.search(in_options(text))]
    assert left == []


@pytest.mark.parametrize(
    ("python", "shown"),
    [
        ("x exists; overwrite it with force=True (--force)", "x exists; overwrite it with --force"),
        ("interpolate with resample=STEP", "interpolate with --resample STEP"),
        ("use method='output-error', which", "use --method output-error, which"),
        ("avoid them with slice=", "avoid them with --slice"),
        ("time= and step=: both are given", "--time and --sampling: both are given"),
        ("Raise prior_covariance or use method='least-squares'", "Raise --k0 or use --method least-squares"),
        ("name the columns with inputs= and outputs= (commands: -u and -y)", "name the columns with -u and -y"),
        ("being zeroed; use slice(1.004, None)", "being zeroed; use --slice 1.004:"),
        ("use slice(1.1, 19.5) instead", "use --slice 1.1:19.5 instead"),
        ("-u m=3 is not there", "-u m=3 is not there"),
        ("say layout=dict(separator='comma', decimal='comma') for", "say --separator comma --decimal comma for"),
        ("otherwise layout=dict(skip=LINES)", "otherwise --skip LINES"),
        ("layout=: skip is -1; give a number", "skip is -1; give a number"),
        ("'m=3.csv' does not exist", "'m=3.csv' does not exist"),
        ("M = 2048, p = 7", "M = 2048, p = 7"),
    ],
)
def test_messages_of_commands_name_their_own_options(python, shown):
    assert in_options(python) == shown


def test_commands_speak_of_their_options(saved, tmp_path):
    path = tmp_path / "bare.csv"
    path.write_text("t,u,y\n0,1,2\n1,2,3\n2,1,nan\n3,1,1\n", encoding="utf-8")
    done = run_command("inspect", path)
    assert done.exit_code == 3
    assert "-u NAME=COLUMN and -y NAME=COLUMN" in done.stderr
    assert "inputs=" not in done.stderr
    done = run_command("inspect", path, "-u", "u", "-y", "y")
    assert "--slice" in done.stderr
    assert "slice=" not in done.stderr
