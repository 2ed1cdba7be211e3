"""The attack on the extension reaches every entry behind its first check, and sees what breaks."""

import random
import runpy
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import crate_structure
import ftlm
from ftlm import _core

TESTS = Path(__file__).resolve().parents[1]
ATTACK = runpy.run_path(str(TESTS / "attack.py"))
HOSTILE = runpy.run_path(str(TESTS / "extension_calls.py"))
sys.path.insert(0, str(TESTS))
import public_calls  # noqa: E402
import unchecked_calls  # noqa: E402


def test_every_entry_of_the_bindings_is_attacked():
    bodies, _ = crate_structure.entries(TESTS.parent / "rust" / "python")
    bound = {name.rpartition("::")[2].replace(".new", ".__new__") for name in bodies} | {"force_portable"}
    # VirtualArm and Guard have private helpers that are no entries.
    assert set(HOSTILE["entries"]()) | {HOSTILE["PANICS"]} == bound


def test_sound_arguments_are_answered():
    for seed in range(3):
        sound = HOSTILE["Sound"](seed)
        for name in HOSTILE["entries"]():
            call, given, named = sound.call(name)
            call(*given, **named)
    _core.force_portable(False)


def test_hostile_values_leave_no_number_untouched():
    r = random.Random(0)
    given = [(0.1, np.ones((2, 8)), None), [1.0, 2], "l1", True, lambda: None]
    touched = Counter()
    for _ in range(4000):
        (other,), _ = HOSTILE["attacked"]("respond", [given], {}, r)
        if not isinstance(other, list):
            continue
        touched.update(
            k for k, (a, b) in enumerate(zip(given, other, strict=False)) if a is not b and repr(a) != repr(b)
        )
    assert set(touched) == {0, 1, 2, 3, 4}
    assert given[1] == [1.0, 2]
    assert given[0][1].sum() == 16


def test_a_fit_is_not_asked_for_more_time_than_an_attack_waits():
    r = random.Random(0)
    for name, at in HOSTILE["EVALUATIONS"].items():
        _, given, named = HOSTILE["Sound"](0).call(name)
        asked = [HOSTILE["attacked"](name, given, named, r)[0][at] for _ in range(2000)]
        assert max(v for v in asked if isinstance(v, int)) == HOSTILE["MAX_EVALUATIONS"]
        assert any(not isinstance(v, int) for v in asked)
        assert any(isinstance(v, int) and v < 0 for v in asked)


def test_calls_of_controllers_and_loops_end_in_an_answer_or_in_words():
    assert [told for _, told in unchecked_calls.calls(random.Random(7), 60) if told is not None] == []
    assert all(
        unchecked_calls.outcome(function, given) is None for function, given in unchecked_calls.recipes().values()
    )


@pytest.mark.slow
def test_odd_arguments_of_public_functions_end_in_an_answer_or_in_words():
    tried = [
        (name, word, parameter, wrong) for name, parameter, word, wrong in public_calls.calls(("ftlm.", "analysis."))
    ]
    assert [call for call in tried if call[-1] is not None] == []
    assert len(tried) > 10_000


def test_the_examples_of_odd_arguments_are_refused_by_name():
    model = ftlm.Model(ftlm.equation("D y = -3 y + 5 u"))
    for call, words in (
        (lambda: ftlm.equation("D y = a y + b u", delay="u"), "delay = 'u' is a str; give a mapping of names"),
        (lambda: ftlm.energies(3), "run = 3 is an int; give Run"),
        (lambda: model.step(10**400), "time"),
        (lambda: ftlm.equation("D y = a y + b u", initial=range(10**12)), "initial"),
    ):
        with pytest.raises(ftlm.FtlmError, match=words):
            call()


def test_what_is_no_answer_of_a_controller_is_seen():
    def call(**given):
        raise given["error"]

    for error in (TypeError("x"), ftlm.ModelError(""), ftlm.ModelError("x" * 9999), ftlm.InternalError("a fault")):
        assert unchecked_calls.outcome(call, {"error": error}).startswith(type(error).__name__)
    warns = unchecked_calls.outcome(lambda: warnings.warn("overflow", RuntimeWarning, stacklevel=1), {})
    assert warns == "RuntimeWarning: overflow"


def test_hostile_calls_end_in_an_answer_or_in_words(tmp_path):
    table = ATTACK["Table"]()
    ATTACK["calls"](table, 4, tmp_path)
    assert table.breaks == {}
    names = HOSTILE["entries"]()
    assert set(table.calls) == set(names)
    assert table.counts == {ATTACK["CALLS"]: 4 * len(names)}
    assert all(counted["calls"] == 4 == counted.total() - 4 for counted in table.calls.values())
    shown = str(table)
    assert f"| all | {4 * len(names)} |" in shown
    assert "entries answered no hostile call" in shown


def test_calls_go_on_where_a_file_of_counts_ends(tmp_path, monkeypatch, capsys):
    counts, calls = tmp_path / "counts.jsonl", ATTACK["calls"]
    monkeypatch.setitem(calls.__globals__, "BATCH", 2)
    monkeypatch.setitem(calls.__globals__, "lines_of", lambda command, folder, hang: made.append(command) or ANSWERED)
    made, late = [], ATTACK["Table"]()
    calls(late, 3, tmp_path, counts=counts, until=float("-inf"))
    assert (made, late.counts, late.notes) == (
        [],
        {ATTACK["CALLS"]: 0},
        [f"{ATTACK['CALLS']}: time is up before batch 0 of 2"],
    )
    calls(ATTACK["Table"](), 3, tmp_path, counts=counts)
    # The second batch had one call of two, and what a kill cut off is made again.
    counts.write_text(counts.read_text() + '{"core": "')
    more = ATTACK["Table"]()
    calls(more, 6, tmp_path, counts=counts)
    assert [command[command.index("--batch") + 1] for command in made] == ["0", "1", "1", "2"]
    assert more.calls == {"metrics": Counter(calls=3, DataError=3)}
    assert more.breaks == {ATTACK["CALLS"]: [f"batch {k}: metrics took more than 5 s" for k in range(3)]}
    assert len(counts.read_text().splitlines()) == 4
    counts.write_text(counts.read_text().replace('"core": "', '"core": "f'))
    with pytest.raises(SystemExit, match="another build of the extension"):
        calls(ATTACK["Table"](), 6, tmp_path, counts=counts)
    assert "took more than 5 s" in capsys.readouterr().err


#: What a child writes that refuses a call, and hangs at the next.
ANSWERED = ["metrics ", "=DataError", "!took more than 5 s"]


def test_a_panic_is_seen(tmp_path):
    table = ATTACK["Table"]()
    ATTACK["calls"](table, 20, tmp_path, only=["panic_on_purpose", "metrics"])
    (told, *_) = table.breaks[ATTACK["CALLS"]]
    assert "panic_on_purpose: InternalError: internal fault: on purpose" in told
    assert table.calls["metrics"]["calls"] == 20


def test_a_process_that_others_leave_no_processor_does_not_hang(tmp_path, monkeypatch):
    began = time.monotonic()
    given = ATTACK["lines_of"].__globals__
    monkeypatch.setitem(given, "PATIENCE", 5)
    command = [sys.executable, "-c", "import os, time\nos.write(1, b'1\\n')\ntime.sleep(1.5)\nos.write(1, b'2\\n')"]
    assert list(ATTACK["lines_of"](command, tmp_path, 0.1)) == ["1", "!took more than 0.1 s"]
    monkeypatch.setitem(given, "waited", lambda child: time.monotonic() - began)
    assert list(ATTACK["lines_of"](command, tmp_path, 0.1)) == ["1", "2"]


@pytest.mark.parametrize(
    ("does", "told"),
    [
        ("os.abort()", ["first", "!ended the process with -6: "]),
        ("time.sleep(60)", ["first", "!took more than 0.1 s"]),
        ("while True: pass", ["first", "!took more than 0.1 s"]),
        ("sys.exit(0)", ["first"]),
        ("raise SystemError('no words')", ["first", "!ended the process with 1: "]),
    ],
)
def test_a_process_that_ends_or_hangs_is_seen(does, told, tmp_path):
    command = [sys.executable, "-c", f"import os, sys, time\nos.write(1, b'first\\n')\n{does}"]
    lines = list(ATTACK["lines_of"](command, tmp_path, 0.1))
    assert len(lines) == len(told)
    assert all(line.startswith(begin) for line, begin in zip(lines, told, strict=True))
