"""The progress bar on terminals of any width and colour, and nothing in a pipe."""

import io
import re
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm.base import progress
from ftlm.base.pace import by_output_error, expected, pace
from ftlm.base.progress import PARTS, Course, left_in_words
from ftlm.cli.app import app
from ftlm.progress import Progress, Stoppable


class Terminal(io.StringIO):
    """A terminal that remembers what was written to it."""

    def isatty(self):
        return True


def shown(monkeypatch, columns, **environment):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    for name, value in {"COLUMNS": str(columns), "TERM": "xterm-256color", **environment}.items():
        monkeypatch.setenv(name, value)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("searching orders of both equations") as bar:
        for done in (1, 40, 99):
            bar(done, 100, 7)
            time.sleep(0.12)
    return terminal.getvalue()


@pytest.mark.parametrize("columns", [30, 60, 120])
def test_no_line_is_longer_than_the_terminal_is_wide(monkeypatch, columns):
    written = shown(monkeypatch, columns)
    assert written
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
    assert max(len(line) for line in re.split(r"[\r\n]", plain)) <= columns


def test_no_color_means_no_colour(monkeypatch):
    colours = re.compile(r"\x1b\[(?:3[0-7]|38|9[0-7])[;m]|\x1b\[[0-9;]*;(?:3[0-7]|38)")
    assert colours.search(shown(monkeypatch, 80, NO_COLOR=""))
    assert not colours.search(shown(monkeypatch, 80, NO_COLOR="1"))


def test_a_pipe_gets_nothing(monkeypatch, capsys):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    assert not sys.stderr.isatty()
    with Progress("searching") as bar:
        bar.say("next search")
        bar(50, 100)
    assert capsys.readouterr().err == ""


def test_quiet_says_nothing(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("searching", quiet=True) as bar:
        bar.say("next search")
        bar(50, 100)
    assert terminal.getvalue() == ""


def test_two_bars_share_one_display(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    for name, value in {"COLUMNS": "80", "TERM": "xterm-256color"}.items():
        monkeypatch.setenv(name, value)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("whole") as bar, bar.beside() as first, bar.beside() as second:
        first.name("stage 1")
        second.name("stage 2")
        for done in (1, 50, 100):
            first(done, 100)
            second(done // 2, 100)
            time.sleep(0.12)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert "stage 1" in plain
    assert "stage 2" in plain
    assert "\x1b[?25h" in terminal.getvalue()  # the cursor is back: the display has ended


def test_stopping_ends_what_another_thread_reports():
    stop, seen = threading.Event(), []
    told = Stoppable(lambda done, total: seen.append((done, total)), stop)
    told(1, 2, 0)
    stop.set()
    with pytest.raises(KeyboardInterrupt):
        told(2, 2, 0)
    assert seen == [(1, 2)]


def test_a_course_never_goes_back_whatever_its_parts_count():
    told = []
    course = Course(lambda done, total: told.append((done, total)))
    part = course.until(0.5, 0.5)
    for total in (4, 9, 2):
        for done in range(total + 1):
            part(done, total)
    assert course.reached < 0.5
    course.at(0.5)
    course.at(0.2)
    last = course.until(1.0)
    last(1, 1)
    course.at(1.0)
    shares = [done for done, _ in told]
    assert shares == sorted(set(shares))
    assert told[-1] == (PARTS, PARTS)
    # A sweep takes its share of what is left, and the next one of the rest.
    assert 250 in shares
    assert 375 in shares
    Course(None).at(1.0)


def test_a_fit_tells_how_far_it_is_to_its_end():
    t = np.arange(400) * 0.05
    u = np.sign(np.sin(t))
    run = ftlm.Run.from_arrays(
        step=0.05, inputs={"u": u}, outputs={"y": np.cumsum(u) * 0.05 + 0.1 * np.random.default_rng(1).random(400)}
    )
    told = []
    ftlm.identify(run, ftlm.equation("D y = a y + b u"), progress=lambda *done: told.append(done))
    shares = [done / total for done, total in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    # It is told of beyond the starts, too: there the bar used to stand still.
    assert len([s for s in shares if s > 0.4]) >= 3


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "about 1 s left"), (12.4, "about 10 s left"), (17, "about 20 s left"), (44, "about 50 s left"),
     (100, "about 2 min left"), (5000, "about 70 min left"), (9900, "about 3 h left"), (1e6, "about 300 h left")],
)  # fmt: skip
def test_time_is_told_to_a_digit(seconds, words):
    assert left_in_words(seconds) == words


def test_time_left_follows_what_is_behind(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    for name, value in {"COLUMNS": "100", "TERM": "xterm-256color"}.items():
        monkeypatch.setenv(name, value)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    clock = iter(np.arange(0, 4000, 1.0))
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with Progress("fitting") as bar:
        bar.expect("the fit", 31.0)
        bar.expect("nothing to wonder at", 1.0)
        bar(100, PARTS)
        time.sleep(0.15)
    written = terminal.getvalue()
    assert "the fit takes about 30 s; Ctrl-C ends it" in written
    assert "nothing to wonder at" not in written
    assert "10 %" in written
    assert re.search(r"about \d+ s left", written)


@pytest.mark.parametrize(
    ("command", "words"), [("agreement", "fitting all parts"), ("select", "the largest candidate alone")]
)
def test_commands_that_take_long_say_so_beforehand(tmp_path, monkeypatch, command, words):
    told = []
    monkeypatch.setattr(Progress, "expect", lambda self, what, seconds: told.append((what, seconds)))
    t = np.arange(320) * 0.05
    u = np.sign(np.sin(2 * t))
    y = np.cumsum(u) * 0.05 + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    lines = [f"{a:.2f},{b:g},{c:.5f}" for a, b, c in zip(t, u, y, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["t,u,y", *lines]))
    asked = [command, str(tmp_path / "run.csv"), "-u", "u", "-y", "y", "--structure", "D y = a0 y + b0 u"]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 0, done.stderr
    ((what, seconds),) = told
    assert what == words
    assert seconds > 0


def test_expectation_is_a_number_of_this_machine():
    assert 0.1 <= pace() < 1e4
    assert expected(10.0, 4) < expected(10.0, 1)
    assert by_output_error(4000, 5) > by_output_error(400, 5) > by_output_error(400, 2)
