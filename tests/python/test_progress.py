"""The progress bar on terminals of any width and colour, and nothing in a pipe."""

import io
import re
import sys
import time

import pytest

from ftlm import progress
from ftlm.progress import Progress


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
