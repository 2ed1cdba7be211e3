"""The progress bar on terminals of any width and colour, and nothing in a pipe."""

import io
import math
import re
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm import progress
from ftlm.cli import framework as wait
from ftlm.cli.main import app
from ftlm.order_search.batches import EquationProblem
from ftlm.order_search.checkpoint import Store
from ftlm.order_search.options import SearchSettings
from ftlm.order_search.search import announce_time, expected_seconds, make_job, run_job
from ftlm.progress import (
    TOTAL_PARTS,
    CancellableProgress,
    FractionTracker,
    Progress,
    format_duration_estimate,
    format_time_left,
)
from ftlm.reproduction import cross_validation as unseen
from ftlm.utils import resources
from ftlm.utils.resources import estimate_duration, machine_slowdown, output_error_cost


class Terminal(io.StringIO):
    """A terminal that remembers what was written to it."""

    def isatty(self):
        return True


def shown(monkeypatch, columns, **environment):
    monkeypatch.setattr(progress, "BAR_DELAY_S", 0.0)
    for name, value in {"COLUMNS": str(columns), "TERM": "xterm-256color", **environment}.items():
        monkeypatch.setenv(name, value)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("searching orders of both equations") as bar:
        for done in (1, 40, 99):
            bar(done, 100, 7)
            bar._current_bar().refresh()
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
    monkeypatch.setattr(progress, "BAR_DELAY_S", 0.0)
    assert not sys.stderr.isatty()
    with Progress("searching") as bar:
        bar.print_label("next search")
        bar(50, 100)
    assert capsys.readouterr().err == ""


def test_quiet_says_nothing(monkeypatch):
    monkeypatch.setattr(progress, "BAR_DELAY_S", 0.0)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("searching", quiet=True) as bar:
        bar.print_label("next search")
        bar(50, 100)
    assert terminal.getvalue() == ""


def test_stopping_ends_what_another_thread_reports():
    stop, seen = threading.Event(), []
    callback = CancellableProgress(lambda done, total: seen.append((done, total)), stop)
    callback(1, 2, 0)
    stop.set()
    with pytest.raises(KeyboardInterrupt):
        callback(2, 2, 0)
    assert seen == [(1, 2)]


def test_a_course_never_goes_back_whatever_its_parts_count():
    reports = []
    tracker = FractionTracker(lambda done, total: reports.append((done, total)))
    part = tracker.subtask(0.5, 0.5)
    for total in (4, 9, 2):
        for done in range(total + 1):
            part(done, total)
    assert tracker.fraction < 0.5
    tracker.advance_to(0.5)
    tracker.advance_to(0.2)
    last = tracker.subtask(1.0)
    last(1, 1)
    tracker.advance_to(1.0)
    shares = [done for done, _ in reports]
    assert shares == sorted(set(shares))
    assert reports[-1] == (TOTAL_PARTS, TOTAL_PARTS)
    # A sweep takes its share of what is left, and the next one of the rest.
    assert 250 in shares
    assert 375 in shares
    FractionTracker(None).advance_to(1.0)


def test_a_fit_tells_how_far_it_is_to_its_end():
    t = np.arange(400) * 0.05
    u = np.sign(np.sin(t))
    run = ftlm.Run.from_arrays(
        step=0.05, inputs={"u": u}, outputs={"y": np.cumsum(u) * 0.05 + 0.1 * np.random.default_rng(1).random(400)}
    )
    reports = []
    ftlm.identify(run, ftlm.equation("D y = a y + b u"), progress=lambda *done: reports.append(done))
    shares = [done / total for done, total in reports]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    # It is told of beyond the starts, too: there the bar used to stand still.
    assert len([s for s in shares if s > 0.4]) >= 3


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.2, "about 1 s left"),
        (12.4, "about 10 s left"),
        (17, "about 20 s left"),
        (44, "about 50 s left"),
        (100, "about 2 min left"),
        (5000, "about 70 min left"),
        (9900, "about 3 h left"),
        (1e6, "about 300 h left"),
    ],
)
def test_time_is_told_to_a_digit(seconds, words):
    assert format_time_left(seconds) == words


def test_time_left_follows_what_is_behind(monkeypatch):
    monkeypatch.setattr(progress, "BAR_DELAY_S", 0.0)
    for name, value in {"COLUMNS": "100", "TERM": "xterm-256color"}.items():
        monkeypatch.setenv(name, value)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    clock = iter(np.arange(0, 4000, 1.0))
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with Progress("fitting") as bar:
        bar.announce("the fit", 31.0)
        bar.announce("nothing to wonder at", 1.0)
        bar(100, TOTAL_PARTS)
        bar._current_bar().refresh()
    written = terminal.getvalue()
    assert "the fit takes about 30 s; Ctrl-C ends it" in written
    assert "nothing to wonder at" not in written
    assert "10 %" in written
    assert re.search(r"about \d+ s left", written)


@pytest.fixture
def estimates(monkeypatch):
    """What commands say beforehand, as if somebody sat before them: what takes how long at least and at most."""
    said = []

    def announce(self, what, least, most=None):
        said.append((what, least, least if most is None else most))

    monkeypatch.setattr(Progress, "announce", announce)
    monkeypatch.setattr(Progress, "quiet", property(lambda self: False))
    return said


@pytest.fixture
def folder(tmp_path):
    """A run, a frequency response and a model."""
    t = np.arange(320) * 0.05
    u = np.sign(np.sin(2 * t))
    y = np.cumsum(u) * 0.05 + 0.01 * np.random.default_rng(1).standard_normal(t.size)
    lines = [f"{a:.2f},{b:g},{c:.5f}" for a, b, c in zip(t, u, y, strict=True)]
    (tmp_path / "run.csv").write_text("\n".join(["t,u,y", *lines]))
    w = np.geomspace(0.1, 10, 12)
    answers = 1 / ((1j * w) ** 0.8 + 1)
    cells = [f"{a:.6g},{h.real:.8g},{h.imag:.8g}" for a, h in zip(w, answers, strict=True)]
    (tmp_path / "bode.csv").write_text("\n".join(["w [rad/s],real,imag", *cells]))
    run = ftlm.load(tmp_path / "run.csv", inputs={"u": "u"}, outputs={"y": "y"})
    ftlm.identify(run, ftlm.equation("D y = a0 y + b0 u")).model.save(tmp_path / "model.json")
    return tmp_path


ASKED = {
    "identify": ("the fit", "run.csv -u u -y y --structure", "D y = a0 y + b0 u"),
    "identify --method multi-innovation": (
        "the search",
        "run.csv -u u -y y --increment 0.1 --structure",
        "D^alpha y = a D^beta y + b0 u",
    ),
    "identify --method genetic --evaluations 400": (
        "the genetic algorithm on y",
        "run.csv -u u -y y --increment 0.1 --structure",
        "D^alpha y = a0 y + b0 u",
    ),
    "consistency": ("the fits of all segments", "run.csv -u u -y y --structure", "D y = a0 y + b0 u"),
    "select": ("the selection of a structure", "run.csv -u u -y y --structure", "D y = a0 y + b0 u"),
    "search": ("the search", "run.csv -u u -y y --increment 0.1 --structure", "D^alpha y = a D^beta y + b0 u"),
    "identify-frequency": ("the fit", "bode.csv -u u -y y --structure", "D^alpha y = a0 y + b0 u"),
    "design-input": ("the design", "model.json --peak 1 --duration 5 --step", "0.05"),
}


@pytest.mark.parametrize("command", ASKED)
def test_commands_that_take_long_say_so_beforehand(folder, monkeypatch, estimates, command):
    monkeypatch.chdir(folder)
    what, asked, last = ASKED[command]
    done = CliRunner().invoke(app, [*command.split(), *asked.split(), last])
    assert done.exit_code == 0, done.stderr
    ((words, least, most),) = estimates
    assert words == what
    assert 0 < least < most < math.inf


def test_large_files_and_long_records_are_announced_and_small_ones_are_not(folder, monkeypatch, estimates):
    monkeypatch.chdir(folder)
    asked = ["compare", "model.json", "run.csv", "-u", "u", "-y", "y"]
    assert CliRunner().invoke(app, asked).exit_code == 0
    assert estimates == []
    size = (folder / "run.csv").stat().st_size
    monkeypatch.setattr(wait, "READ_TIME_PER_BYTE_S", 1.0 / size)
    monkeypatch.setattr(wait, "SIMULATION_TIME_PER_SAMPLE_S", 1.0 / 320)
    for command in (
        asked,
        ["resid", *asked[1:]],
        ["simulate", *asked[1:], "-o", "out.csv"],
        ["report", "model.json", "--validation", *asked[2:], "-o", "out.html"],
    ):
        estimates.clear()
        assert CliRunner().invoke(app, command).exit_code in (0, 4)
        assert [words for words, *_ in estimates] == ["reading", "running the model"], command
        assert all(0 < least < most for _, least, most in estimates)
    estimates.clear()
    assert CliRunner().invoke(app, ["open", "run.csv"]).exit_code == 0
    assert [words for words, *_ in estimates] == ["reading"]


def test_designs_are_announced_by_the_samples_that_their_loops_are_judged_on(monkeypatch, estimates):
    monkeypatch.setattr(wait, "estimate_duration", lambda seconds, threads: seconds)
    for design, samples in (("pid", 100), ("lqg", 100), ("lqg", 1000)):
        wait.announce_design(design, samples)
    assert [words for words, *_ in estimates] == ["designing"] * 3
    times = [(least, most) for _, least, most in estimates]
    assert times == sorted(times)
    # On the known machine they took 0.6, 1.4 and some 10 s.
    assert all(least < took < most for (least, most), took in zip(times, (0.6, 1.4, 10.0), strict=True))


def test_cross_validate_orders_says_how_long_all_of_their_fits_take(monkeypatch, estimates):
    signals = {f"theta{n}{k}": np.zeros(300) for n in (1, 2) for k in (1, 2)}
    runs = [ftlm.Run.from_arrays(step=0.01, inputs={"I1": np.ones(300)}, outputs=signals, name=n) for n in "ab"]
    monkeypatch.setattr(unseen, "identify", lambda *_, **__: sys.exit("begun"))
    with pytest.raises(SystemExit, match="begun"):
        unseen.cross_validate_orders(runs, threads=1, progress=Progress(""))
    ((words, least, most),) = estimates
    assert words == "the cross-validation"
    # Thirty-two fits of some ten numbers.
    assert 0.4 < least < most < math.inf


def job(step=0.1, **options):
    t = np.arange(129) * 0.05
    u = np.sign(np.sin(2 * t))
    run = ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": np.cumsum(u) * 0.05})
    structure = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b D^nu u")
    return make_job(run, structure, ftlm.order_grid(increment=step), SearchSettings(), **options)


def test_a_search_is_announced_by_what_coarse_lattices_of_it_take(monkeypatch):
    """A core that takes a millisecond a candidate, so that the whole search is known: within what is said."""
    asked = job(threads=1)
    whole = asked.equation_problem().plan()[0]
    now, seen = [0.0], []

    def search(self, progress):
        seen.append(self.plan()[0])
        now[0] += 1e-3 * seen[-1]

    monkeypatch.setattr(EquationProblem, "search", search)
    least, most = expected_seconds(asked, clock=lambda: now[0])
    assert least < 1e-3 * whole < most
    assert seen == sorted(set(seen))
    assert max(seen) <= whole / 12
    # Twice as slow a machine takes twice as long.
    monkeypatch.setattr(EquationProblem, "search", lambda self, _: now.__setitem__(0, now[0] + 2e-3 * self.plan()[0]))
    assert expected_seconds(asked, clock=lambda: now[0])[0] == pytest.approx(2 * least, rel=0.5)


def test_of_a_store_only_what_is_left_is_announced(tmp_path, estimates):
    asked = job(0.2)
    path = tmp_path / "search.ftlm"
    with Store(path, [asked.request("y")]) as kept:
        announce_time(Progress(""), [asked], kept)
        run_job(asked, store=kept)
        announce_time(Progress(""), [asked], kept)
    (_, least, most), (_, *nothing) = estimates
    assert 0 < least < most
    assert nothing == [0.0, 0.0]


def test_nobody_waits_for_an_announcement_that_nobody_sees(monkeypatch):
    monkeypatch.setattr(EquationProblem, "plan", lambda *_: pytest.fail("measured for nobody"))
    announce_time(Progress("", quiet=True), [job()])
    announce_time(lambda done, total: None, [job()])


@pytest.mark.parametrize(
    ("least", "most", "words"),
    [
        (12.0, 12.0, "about 10 s"),
        (0.4, 5.0, "up to 5 s"),
        (5.0, 18.0, "5 to 20 s"),
        (30.0, 200.0, "30 s to 3 min"),
        (4e3, 1e5, "70 min to 30 h"),
    ],
)
def test_times_beforehand_are_told_as_what_they_are_known_to(least, most, words):
    assert format_duration_estimate(least, most) == words


def test_work_that_grows_is_counted_and_no_end_is_made_up(monkeypatch):
    monkeypatch.setattr(progress, "BAR_DELAY_S", 0.0)
    for name, value in {"COLUMNS": "80", "TERM": "xterm-256color"}.items():
        monkeypatch.setenv(name, value)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("fitting candidates") as bar:
        for done in (3, 8, 8):
            bar.show_count(done, 8)
            bar._current_bar().refresh()
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert "fitting candidates" in plain
    assert "8 of 8 so far" in plain
    assert "left" not in plain


@pytest.mark.parametrize("columns", [40, 80, 120])
def test_a_long_label_leaves_bar_and_figures_their_room(monkeypatch, columns):
    monkeypatch.setattr(progress, "BAR_DELAY_S", 0.0)
    for name, value in {"COLUMNS": str(columns), "TERM": "xterm-256color"}.items():
        monkeypatch.setenv(name, value)
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    clock = iter(np.arange(0.0, 0.8, 0.1))
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    with Progress("stage 1: all orders and coefficients together by output error, from the current alone") as bar:
        for done in (300, 400):
            bar(done, TOTAL_PARTS)
            bar._current_bar().refresh()
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())
    assert re.search(r"━+.* 40 %.*about 1 s left", plain)
    assert max(len(line) for line in re.split(r"[\r\n]", plain)) <= columns


def test_expectation_is_a_number_of_this_machine(monkeypatch):
    # How much slower is a matter of what else runs; of one slowdown more threads take less.
    slowdown = machine_slowdown()
    assert 0.1 <= slowdown < math.inf
    monkeypatch.setattr(resources, "machine_slowdown", lambda: slowdown)
    assert estimate_duration(10.0, 4) < estimate_duration(10.0, 1)
    assert (
        output_error_cost(40_000, 5)
        > output_error_cost(4000, 5)
        > output_error_cost(400, 5)
        > output_error_cost(400, 2)
    )
