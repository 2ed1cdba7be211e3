"""The progress bar on terminals of any width and colour, and nothing in a pipe."""

import io
import re
import sys
import threading
import time

import pytest

from ftlm.base import progress
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
