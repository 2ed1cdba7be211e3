"""Environment of ftlm: the log of a program, shell completion, threads from environment variables."""

from __future__ import annotations

import logging
import os
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app
from ftlm.estimation.methods import METHODS_BY_NAME
from ftlm.utils.validation import available_threads, check_threads
from slow_cases import slow_after

WORDS = "D^1.5 y = a y + b u"


@pytest.fixture(scope="module")
def run():
    time = np.arange(200) * 0.05
    u = np.sign(np.sin(2 * np.pi * time / 5))
    model = ftlm.Model(ftlm.equation("D^1.5 y = -1.2 y + 2 u"))
    return model.simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * u}, name="square"))


def test_the_log_tells_files_fits_and_doubts(run, tmp_path, caplog):
    with caplog.at_level(logging.INFO, logger="ftlm"):
        run.to_csv(tmp_path / "run.csv")
        found = ftlm.identify(ftlm.load(tmp_path / "run.csv"), ftlm.equation(WORDS), method="least-squares")
    assert all(record.name == "ftlm" for record in caplog.records)
    told = [record.getMessage() for record in caplog.records if record.levelno == logging.INFO]
    assert told[0].startswith("written: ")
    assert told[1] == "read: square, simulated: 200 rows, u, y"
    assert told[2] == "identifying equation from square, simulated by least-squares"
    assert told[3] == f"identified: {found.verdict}"
    doubts = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert tuple(doubts) == tuple(found.warnings)
    caplog.clear()
    w = np.geomspace(0.1, 10, 20)
    data = ftlm.FrequencyData.from_arrays(w, 1 / (1j * w + 2), name="lag")
    with caplog.at_level(logging.INFO, logger="ftlm"):
        ftlm.identify_frequency(data, "D y = a y + b u")
    assert [r.getMessage().partition(":")[0] for r in caplog.records] == ["identifying a, b from lag", "identified"]


def test_a_program_that_does_not_listen_hears_nothing():
    script = (
        "import logging, ftlm, numpy as np; from ftlm.utils.files import PACKAGE_LOGGER as log; log.warning('loud'); "
        "print([type(h).__name__ for h in logging.getLogger('ftlm').handlers], logging.getLogger().handlers)"
    )
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "['NullHandler'] []"
    assert ran.stderr == ""


def test_the_environment_gives_the_threads_of_what_does_not_say_its_own(monkeypatch):
    monkeypatch.delenv("FTLM_THREADS", raising=False)
    assert check_threads(None) == available_threads()
    monkeypatch.setenv("FTLM_THREADS", " 3 ")
    assert check_threads(None) == 3
    assert check_threads(2) == 2
    monkeypatch.setenv("FTLM_THREADS", "")
    assert check_threads(None) == available_threads()
    for wrong in ("0", "-1", "1025", "two", "1.5", "9" * 5000, "\u0663"):
        monkeypatch.setenv("FTLM_THREADS", wrong)
        with pytest.raises(ftlm.ModelError, match=r"^FTLM_THREADS=.* is not a number of threads; give 1 to 1024"):
            check_threads(None)


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("ident", {"identify", "identify-frequency"}),
        ("identify --meth", {"--method"}),
        (
            "identify --method ",
            set(METHODS_BY_NAME),
        ),
        ("identify-frequency --weights ", {"auto", "relative", "uniform", "deviation"}),
    ],
)
def test_a_shell_completes_commands_options_and_their_values(typed, offered):
    words = f"ftlm {typed}"
    asked = {"_FTLM_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split(" ")) - 1)}
    done = CliRunner().invoke(app, prog_name="ftlm", env=asked)
    assert set(done.stdout.split()) == offered


@slow_after(1, "shell", ["bash", "zsh", "fish"])
def test_what_a_shell_is_to_read_is_shown(shell):
    # Without the variable typer looks for the shell that runs it, and there is none here.
    script = "import sys; sys.argv[0] = 'ftlm'; from ftlm.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", script, "--show-completion", shell],
        env={**os.environ, "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "_FTLM_COMPLETE=complete_" in done.stdout
