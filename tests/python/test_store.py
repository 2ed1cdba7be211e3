"""The search store: the same bytes after any interruption, and never a wrong row out of a cut or damaged file."""

import contextlib
import json
import math
import os
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import ftlm
import store as bench
from ftlm import _core
from ftlm.order_search import checkpoint as frames
from ftlm.order_search.batches import EquationSearchState
from ftlm.order_search.checkpoint import Section, Store, read_store
from ftlm.utils.checkpoint_file import RECORD_ENCODER, CheckpointFile
from small_lattice import EQUATION
from stored_searches import COARSE, bytes_of, job_of, records, search, tables_of
from stores import keep


@pytest.fixture(scope="module")
def run(small_run, with_noise):
    return with_noise(small_run, 0.003, 1)


@pytest.fixture(scope="module")
def expected(run):
    return bytes_of(search(run))


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """Bytes of a complete store."""
    path = tmp_path_factory.mktemp("store") / "whole.ftlm"
    with pytest.MonkeyPatch.context() as patch:
        # A slow machine would note how far it is.
        patch.setattr("ftlm.order_search.checkpoint.FLUSH_INTERVAL_S", math.inf)
        search(run, path)
    return path.read_bytes()


def rows_of(contents):
    parts = [frame.part for frame in contents.sections[0].frames.values()]
    parts += [half.checkpoint[2] for half in contents.sections[0].open.values()]
    return [row for rows, _, _ in parts for row in rows]


# ----------------------------------------------------------------------------------------------------------------------
# The same table


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"pruning": True},
        {"pruning": True, "criterion": "equation-error", "norm": "l2", "row_basis": "time"},
        {"coefficients": "least-squares", "norm": "l2", "top": 3, "threads": 3},
        {"pruning": True, "coefficients": "instrumental-variables", "order_grid": ftlm.order_grid(increment=0.2)},
    ],
)
def test_a_search_with_a_store_is_the_search_without(run, tmp_path, options):
    path = tmp_path / "s.ftlm"
    expected = bytes_of(search(run, **options))
    assert bytes_of(search(run, path, **options)) == expected
    size = path.stat().st_size
    assert bytes_of(search(run, path, **options)) == expected
    assert bytes_of(ftlm.resume_search(path)["y"]) == expected
    assert path.stat().st_size == size
    status = ftlm.search_status(path)["y"]
    assert status.complete
    assert status.candidates == search(run, **options).candidates
    assert status.best == pytest.approx(search(run, **options).score, rel=1e-15)


def test_several_runs_a_delay_and_a_sensor_filter_survive_in_a_store(run, tmp_path):
    structure = ftlm.equation(
        "D^alpha y = a D^beta y + b u", delay={"u": 0.01}, sensor_filter=ftlm.SensorFilter.low_pass(["y"])
    )
    path = tmp_path / "s.ftlm"
    runs = [run, run.window(1.0, 6.0)]
    found = ftlm.search_orders(runs, structure, m=128, store=path)
    assert bytes_of(found) == bytes_of(ftlm.search_orders(runs, structure, m=128))
    assert bytes_of(ftlm.resume_search(path)["y"]) == bytes_of(found)


def test_rounds_do_not_depend_on_how_they_are_cut_up(run):
    """R4: any number of threads, any stretch of rounds, in any order."""
    job = job_of(run, ftlm.equation(EQUATION, initial="rest"), COARSE, m=32, pruning=False)
    work = job.equation_problem()
    count, ends = work.plan()
    assert count == 19_295
    assert ends == [1, 3, 5]
    ready = work.build_evaluator()
    tables = []
    for threads, cuts in ((1, [1, 3, 5]), (2, [1, 2, 3, 4, 5]), (3, [1, 3, 4, 5]), (8, [1, 3, 5])):
        parts, seed, first = [], [], 0
        waves = []
        for last in cuts:
            waves.append(ready.evaluate_batches(first, last, seed, None, threads, None, None))
            if last in ends:
                parts += waves[::-1]
                waves = []
                seed = sorted([(r[0], r[1]) for p in parts for r in p[0]], key=lambda r: r[::-1])[:20]
            first = last
        tables.append(work.join(parts))
    assert all(repr(t) == repr(tables[0]) for t in tables)


def test_several_equations_are_kept_in_one_store_by_the_command_line(tmp_path, clean_a, monkeypatch):
    from typer.testing import CliRunner

    from ftlm.cli.main import app

    data, path = tmp_path / "a.csv", str(tmp_path / "s.ftlm")
    clean_a.to_csv(data)
    common = ["--structure", "flexible-link:1", "--increment", "0.25", "--m", "128", "--json"]
    call = ["search", str(data), *common]
    plain = CliRunner().invoke(app, call)
    kept = CliRunner().invoke(app, [*call, "--store", path])
    resumed = CliRunner().invoke(app, ["resume", path, "--json"])
    assert [r.exit_code for r in (plain, kept, resumed)] == [0, 0, 0], kept.output + resumed.output
    assert plain.stdout == kept.stdout
    assert tables_of(plain.stdout) == tables_of(resumed.stdout)
    status = CliRunner().invoke(app, ["status", path, "--json"])
    assert {n: s["complete"] for n, s in json.loads(status.stdout).items()} == {"theta11": True, "theta12": True}
    assert "100.0 %" in CliRunner().invoke(app, ["status", path]).stdout
    other = CliRunner().invoke(app, [*call, "--store", path, "--top", "5"])
    assert other.exit_code == 3
    assert "other settings: top = 5" in other.stderr
    # Under the order law both are one search.
    law = ["search", str(data), *common, "--laws", "orders"]
    plain = CliRunner().invoke(app, law)
    kept = CliRunner().invoke(app, [*law, "--store", str(tmp_path / "l.ftlm")])
    resumed = CliRunner().invoke(app, ["resume", str(tmp_path / "l.ftlm"), "--json"])
    assert [r.exit_code for r in (plain, kept, resumed)] == [0, 0, 0], kept.output + resumed.output
    assert plain.stdout == kept.stdout
    assert tables_of(plain.stdout) == tables_of(resumed.stdout)
    assert list(json.loads(plain.stdout)) == ["stage"]
    assert "stage: " in CliRunner().invoke(app, ["status", str(tmp_path / "l.ftlm")]).stdout


# ----------------------------------------------------------------------------------------------------------------------
# Interruptions


def test_kill_loses_no_finished_work_and_changes_no_byte():
    lost, _, same = bench.kills(1)
    assert len(lost) == 1
    assert same


@pytest.mark.slow
def test_fifty_kills_of_a_stage():
    lost, ended, same = bench.kills(50, of=bench.stage)
    print(f"\n{len(lost)} kills, {ended} searches ended, worst loss {max(lost):.3f} s")
    assert same


@pytest.mark.slow
def test_fifty_kills():
    lost, ended, same = bench.kills(50)
    print(f"\n{len(lost)} kills, {ended} searches ended, worst loss {max(lost):.3f} s")
    assert same


@pytest.mark.slow
def test_control_c_leaves_a_store_that_goes_on(tmp_path):
    data, path = tmp_path / "a.csv", tmp_path / "s.ftlm"
    bench.run().to_csv(data)
    # With the handler that a terminal's shell leaves.
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); import ftlm.cli; ftlm.cli.main()"
    call = [
        sys.executable,
        "-c",
        start,
        "search",
        str(data),
        "--structure",
        EQUATION,
        "--increment",
        "0.1",
        "--m",
        "2048",
    ]
    call += ["--coefficients", "least-squares", "--norm", "l2", "--initial", "rest"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        [*call, "--store", str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as child:
        try:
            while child.poll() is None and not (path.exists() and path.stat().st_size > 0):
                pass
            child.send_signal(signal.SIGINT)
            _, errors = child.communicate(timeout=240)
        finally:
            child.kill()
    # A search that was faster than the signal has ended well.
    assert child.returncode in (0, 130), errors
    if child.returncode == 130:
        assert f"interrupted; go on with: ftlm resume {path}" in errors
    resumed = subprocess.run([sys.executable, "-m", "ftlm", "resume", path, "--json"], capture_output=True, check=True)
    plain = subprocess.run([*call, "--json"], capture_output=True, check=True)
    assert tables_of(resumed.stdout) == tables_of(plain.stdout)


def test_control_c_at_a_terminal_ends_a_search_that_can_be_resumed(tmp_path):
    """R3: the search gives the terminal back, exit code 130, and goes on to the same bytes."""
    path, data = tmp_path / "s.ftlm", tmp_path / "a.csv"
    bench.run().to_csv(data)
    call = ["search", str(data), "--structure", EQUATION, "--increment", "0.02", "--m", "2048", "--initial", "rest"]
    call += ["--coefficients", "instrumental-variables"]
    code, _, said = bench.control_c([*call, "--store", str(path)], path, 3)
    assert code == 130
    # The terminal's own echo, then what to do; nothing after it, no traceback.
    assert said.replace("\r\n", "\n").endswith(f"ftlm: interrupted; go on with: ftlm resume {path}\n")
    assert "Traceback" not in said
    status = ftlm.search_status(path)["y"]
    assert 0 < status.done_count < status.candidates
    assert status.corruption is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "s.ftlm"]
    with Store(path) as kept:
        assert kept.notes == []
        assert kept.contents.sections[0].processed_count == status.done_count


def test_a_store_cut_at_any_byte_holds_only_right_rows_and_is_recovered(run, whole, expected, tmp_path):
    path = tmp_path / "cut.ftlm"
    path.write_bytes(whole)
    rows, found = rows_of(read_store(path)), []
    for size in range(0, len(whole), 15):
        path.write_bytes(whole[:size])
        try:
            contents = read_store(path)
        except ftlm.DataError:
            continue
        got = rows_of(contents)
        assert got == rows[: len(got)]
        assert contents.corruption is not None
        found.append(size)
    for size in found[:: max(len(found) // 5, 1)]:
        path.write_bytes(whole[:size])
        for again in (lambda: search(run, path), lambda: ftlm.resume_search(path)):
            with pytest.raises(ftlm.DataError, match=r"is damaged: .*recover=True"):
                again()
        assert path.read_bytes() == whole[:size]
        assert bytes_of(ftlm.resume_search(path, recover=True)["y"]) == expected
        (tmp_path / "cut.ftlm.damaged").unlink()
    assert len(found) > len(whole) // 120
    path.write_bytes(b"")
    assert bytes_of(search(run, path)) == expected


def test_a_search_stopped_after_any_record_goes_on(run, whole, expected, tmp_path, monkeypatch):
    monkeypatch.setattr("ftlm.order_search.checkpoint.FLUSH_INTERVAL_S", math.inf)
    path = tmp_path / "s.ftlm"
    path.write_bytes(whole)
    payloads = records(path)
    assert len(payloads) > 3
    for count in range(len(payloads)):
        path.write_bytes(whole)
        keep(path, count)
        if count:
            assert bytes_of(ftlm.resume_search(path)["y"]) == expected
        else:
            with pytest.raises(ftlm.DataError, match="before its first record"):
                ftlm.resume_search(path)
            assert bytes_of(search(run, path)) == expected
        assert records(path) == payloads


@pytest.mark.parametrize("order", [0, 12345])
def test_a_half_done_stretch_of_another_visiting_order_is_done_again(run, whole, expected, tmp_path, order):
    """Its candidates would be followed twice or never: the table is that of an uninterrupted search all the same."""
    path = tmp_path / "half.ftlm"
    path.write_bytes(whole)
    _, (wave, *_) = job_of(run, ftlm.equation(EQUATION, initial="rest"), COARSE, m=32).equation_problem().plan()
    found = read_store(path).sections[0].frames[0].part
    # A row that would win, were it believed.
    rows = ((found[0][0][0], 0.0, *found[0][0][2:]),)
    place = (0, 5, 256, 256, math.inf)
    begun = frames.PartialRounds(0, 0, wave, place, rows, (0, 0, 5, 0, 0, 0, 0), (), order)
    keep(path, 1)
    with CheckpointFile(path, "search", "resume") as file:
        file.append([RECORD_ENCODER.encode(begun)])
    assert read_store(path).sections[0].open[0].order == order
    assert bytes_of(search(run, path)) == expected
    section = read_store(path).sections[0]
    assert not section.open
    assert section.processed_count == sum(sum(f.part[1][1:]) for f in section.frames.values()) > 0


def test_what_stood_before_a_stretch_was_begun_anew_does_not_count():
    section = Section()
    row = (3, 1.0, (1.0, 2.0, 3.0), ((),))
    counts = (0, 0, 5, 0, 0, 0, 0)
    first = frames.PartialRounds(0, 0, 2, (1, 5, 256, 256, 1.0), (row,), counts, ((7, False),), 9, True)
    section.add_frame(first)
    section.add_frame(msgspec.structs.replace(first, rows=((4, *row[1:]),), failures=None, restarted=False))
    assert [r[0] for r in section.open[0].rows] == [3, 4]
    assert section.open[0].failures == ((7, False),)
    assert section.open[0].checkpoint[0] == (1, 5, 256, 256, 1.0, 9)
    section.add_frame(msgspec.structs.replace(first, rows=((5, *row[1:]),), failures=()))
    assert [r[0] for r in section.open[0].rows] == [5]
    assert section.open[0].failures == ()
    assert section.processed_count == 5


@pytest.mark.parametrize(
    ("mask", "stride"),
    [pytest.param(0xFF, 1, marks=pytest.mark.slow), (0xFF, 25), pytest.param(0x01, 25, marks=pytest.mark.slow)],
)
def test_a_store_flipped_at_any_byte_never_gives_a_wrong_row(run, whole, expected, tmp_path, mask, stride):
    path = tmp_path / "flipped.ftlm"
    path.write_bytes(whole)
    rows, damaged = rows_of(read_store(path)), []
    for at in range(0, len(whole), stride):
        flipped = bytearray(whole)
        flipped[at] ^= mask
        path.write_bytes(flipped)
        try:
            found = read_store(path)
        except ftlm.DataError:
            continue
        # Some bytes of a page hold nothing.
        got = rows_of(found)
        assert got == rows[: len(got)]
        if found.corruption is None:
            assert got == rows
        else:
            damaged.append(at)
    assert len(damaged) > len(whole) // stride // 8
    for at in damaged[:: len(damaged) // 5]:
        flipped = bytearray(whole)
        flipped[at] ^= mask
        path.write_bytes(flipped)
        with pytest.raises(ftlm.DataError, match="is damaged: "):
            search(run, path)
        assert path.read_bytes() == flipped
        assert bytes_of(ftlm.resume_search(path, recover=True)["y"]) == expected
        (tmp_path / "flipped.ftlm.damaged").unlink()


def test_a_record_that_is_lost_or_changed_is_damage_that_recovery_drops(run, whole, expected, tmp_path):
    path = tmp_path / "s.ftlm"
    for change, damage in {
        "DELETE FROM search WHERE number = 3": "record 3 does not match its digest",
        "UPDATE search SET payload = zeroblob(50) WHERE number = 3": "record 3 does not match its digest",
        "UPDATE search SET payload = 'text' WHERE number = 2": "record 2 does not match its digest",
        "UPDATE search SET number = number + 1 WHERE number = (SELECT max(number) FROM search)": "record 4 does not",
    }.items():
        path.write_bytes(whole)
        with contextlib.closing(sqlite3.connect(path)) as file, file:
            file.execute(change)
        changed = path.read_bytes()
        for again in (lambda: search(run, path), lambda: ftlm.resume_search(path)):
            with pytest.raises(ftlm.DataError, match=f"is damaged: {damage}.*recover=True"):
                again()
        assert path.read_bytes() == changed
        assert f"damaged: {damage}" in str(ftlm.search_status(path)["y"])
        with Store(path, recover=True) as kept:
            assert kept.contents.corruption is None
            assert damage in kept.notes[0]
        assert (tmp_path / "s.ftlm.damaged").read_bytes() == changed
        assert bytes_of(ftlm.resume_search(path)["y"]) == expected
        (tmp_path / "s.ftlm.damaged").unlink()


# ----------------------------------------------------------------------------------------------------------------------
# What a store refuses


def another(text):
    equation = ftlm.equation(text, initial="rest")
    return lambda run, path: ftlm.search_orders(run, equation, COARSE, m=32, pruning=False, store=path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda run, path: search(run.window(0.0, 8.0), path), "this one has other data"),
        (lambda run, path: search(run, path, m=64), "this one has other data"),
        (
            lambda run, path: search(run, path, order_grid=ftlm.order_grid(increment=0.2)),
            "this one has another order grid",
        ),
        (lambda run, path: search(run, path, norm="l2"), "this one has other settings: norm = l2"),
        (another("D^alpha y = a D^beta y + c D^mu y + b u"), "this one has another equation"),
        (another("D^alpha y = a D^beta y + c D^mu y + 5 D^nu u"), "this one has another equation"),
    ],
)
def test_another_search_is_refused_and_leaves_the_store(run, whole, tmp_path, change, message):
    path = tmp_path / "s.ftlm"
    path.write_bytes(whole)
    with pytest.raises(ftlm.DataError, match=message):
        change(run, path)
    assert path.read_bytes() == whole


def test_a_store_of_another_algorithm_is_refused_and_kept(run, whole, tmp_path, monkeypatch):
    path = tmp_path / "finished.ftlm"
    path.write_bytes(whole)
    monkeypatch.setattr("ftlm.order_search.checkpoint.ALGORITHM_VERSION", 2)
    for call in (lambda: search(run, path), lambda: ftlm.resume_search(path), lambda: ftlm.search_status(path)):
        with pytest.raises(ftlm.DataError, match=r"with algorithm 1, .* has algorithm 2; start the search again in an"):
            call()
    assert path.read_bytes() == whole


def test_a_second_writer_is_refused_and_readers_are_not(run, whole, expected, tmp_path):
    path = tmp_path / "s.ftlm"
    path.write_bytes(whole)
    with Store(path):
        for again in (lambda: search(run, path), lambda: ftlm.resume_search(path)):
            with pytest.raises(ftlm.DataError, match="is in use by another search"):
                again()
        call = [sys.executable, "-m", "ftlm", "resume", str(path)]
        other = subprocess.run(call, capture_output=True, text=True, check=False)
        assert other.returncode == 3
        assert "is in use by another search" in other.stderr
        assert ftlm.search_status(path)["y"].complete
    assert path.read_bytes() == whole
    assert bytes_of(search(run, path)) == expected


def test_a_second_writer_does_not_slip_in_after_an_append(run, whole, tmp_path):
    """A writer has no lock for some microseconds after each append."""
    path = tmp_path / "s.ftlm"
    path.write_bytes(whole)
    with Store(path) as kept:
        kept._file._connection.execute("ROLLBACK")
        # What the writer does next, while the second one pauses between its attempts.
        threading.Timer(0.003, kept._file._connection.execute, ["BEGIN IMMEDIATE"]).start()
        with pytest.raises(ftlm.DataError, match="is in use by another search"):
            Store(path)


def test_a_full_disk_leaves_the_store_whole(run, expected, tmp_path, monkeypatch):
    path = tmp_path / "s.ftlm"
    _header(run, path)
    begun = records(path)
    with monkeypatch.context() as patch:
        connect = sqlite3.connect

        def full(*args, **options):
            made = connect(*args, **options)
            made.execute("PRAGMA max_page_count = 1")
            return made

        patch.setattr("ftlm.utils.checkpoint_file.sqlite3.connect", full)
        with pytest.raises(
            ftlm.DataError, match=r"cannot be written: database or disk is full; its stored records are intact"
        ):
            search(run, path)
    assert records(path)[: len(begun)] == begun
    assert [p.name for p in tmp_path.iterdir()] == ["s.ftlm"]
    assert bytes_of(search(run, path)) == expected


def _header(run, path):
    """A store whose search has only begun: its size."""
    job = job_of(run, ftlm.equation(EQUATION, initial="rest"), COARSE, m=32, pruning=False)
    Store(path, [job.request("y")]).close()
    return path.stat().st_size


@pytest.mark.parametrize("room", [-8192, 100, 5000])
def test_a_limit_of_the_system_on_file_sizes_leaves_the_store_whole(run, expected, tmp_path, room):
    path = tmp_path / "s.ftlm"
    begun = _header(run, path)
    stored = path.read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Less than the journal needs, or less than the file does.
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(begun + room, 600), before[1]))
    try:
        with pytest.raises(ftlm.DataError, match=r"cannot be (written|opened): .*; (its stored records|choose)"):
            search(run, path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes()[: len(stored)] == stored or records(path)
    assert [p.name for p in tmp_path.iterdir()] == ["s.ftlm"]
    assert bytes_of(search(run, path)) == expected


@pytest.fixture
def folder():
    """A folder that any user can reach."""
    with tempfile.TemporaryDirectory() as path:
        Path(path).chmod(0o777)
        yield Path(path)


@contextlib.contextmanager
def as_nobody():
    """Without the rights of root, to whom no folder is read-only."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


def test_a_read_only_folder_is_an_error_and_leaves_the_store_whole(run, whole, expected, folder):
    path = folder / "s.ftlm"
    path.write_bytes(whole)
    keep(path, 2)
    half = path.read_bytes()
    path.chmod(0o444)
    folder.chmod(0o555)
    try:
        with as_nobody():
            with pytest.raises(ftlm.DataError, match=r"cannot be opened: unable to open .*; choose another file"):
                search(run, folder / "new.ftlm")
            for again in (lambda: search(run, path), lambda: ftlm.resume_search(path)):
                with pytest.raises(ftlm.DataError, match=r"cannot be opened: .*readonly database; choose another file"):
                    again()
            assert 0 < ftlm.search_status(path)["y"].done_count < 19_295
        assert [p.name for p in folder.iterdir()] == ["s.ftlm"]
        assert path.read_bytes() == half
        # The file may be written, but nothing beside it: neither a journal nor a copy of a damaged file.
        damaged = bytearray(whole)
        damaged[len(whole) - len(whole) // 3] ^= 4
        path.chmod(0o666)
        path.write_bytes(damaged)
        with as_nobody(), pytest.raises(ftlm.DataError, match=r"cannot be opened: .*; choose another file"):
            ftlm.resume_search(path, recover=True)
        assert path.read_bytes() == damaged
        # No journal can be written beside it either.
        path.write_bytes(half)
        with as_nobody(), pytest.raises(ftlm.DataError, match=r"cannot be opened: .*; choose another file"):
            search(run, path)
        assert path.read_bytes() == half
    finally:
        folder.chmod(0o777)
    assert bytes_of(search(run, path)) == expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"t,y\n0,1\n", "is not an ftlm search store"),
        (b"", "ends before its first record"),
        (b"SQLite format 3\0" + bytes(4080), "is not an ftlm search store"),
    ],
)
def test_what_is_no_store_is_refused_and_kept(run, tmp_path, content, message):
    path = tmp_path / "s.ftlm"
    path.write_bytes(content)
    calls = [lambda: ftlm.resume_search(path), lambda: ftlm.search_status(path)]
    # An empty file may become one.
    calls += [lambda: search(run, path)] if content else []
    for call in calls:
        with pytest.raises(ftlm.DataError, match=message):
            call()
        assert path.read_bytes() == content


def test_paths_that_hold_no_store_are_refused(run, tmp_path):
    for path in (tmp_path / "missing.ftlm", tmp_path / "no" / "folder.ftlm", "nul\0"):
        for call in (ftlm.resume_search, ftlm.search_status):
            with pytest.raises(ftlm.DataError):
                call(path)
    for path in (tmp_path, tmp_path / "no" / "folder.ftlm", "nul\0"):
        with pytest.raises(ftlm.DataError, match=r"cannot be opened|is not a regular file"):
            search(run, path)


def test_the_core_refuses_checkpoints_and_parts_of_another_search(run):
    job = job_of(run, ftlm.equation(EQUATION, initial="rest"), COARSE, m=32, pruning=False)
    work = job.equation_problem()
    ready = work.build_evaluator()
    counts = (0, 0, 0, 0, 0, 0, 0)
    row = (3, 1.0, (1.0, 2.0, 3.0), ((),))
    for first, last, start in (
        (0, 6, None),
        (3, 2, None),
        (0, 1, ((2, 0, 0, 0, 1.0, 0), False, ((), counts, ()))),
        (0, 1, ((0, 5, 4, 256, 1.0, 0), False, ((), counts, ()))),
        (0, 1, ((0, 0, 256, 0, 1.0, 0), False, ((), counts, ()))),
        (0, 1, ((0, 0, 256, 256, float("nan"), 0), False, ((), counts, ()))),
        (0, 1, ((0, 0, 0, 0, 1.0, 0), False, (((3, 1.0, (1.0,), ((),)),), counts, ()))),
        (0, 1, ((0, 0, 0, 0, 1.0, 0), False, (((1 << 60, 1.0, (1.0, 2.0, 3.0), ((),)),), counts, ()))),
    ):
        with pytest.raises(ftlm.ModelError, match="start the search again"):
            ready.evaluate_batches(first, last, [], start, 1, None, None)
    part = ready.evaluate_batches(0, 1, [], None, 1, None, None)
    # One that lies in a round of another visiting order is left for the start of its stretch.
    assert ready.evaluate_batches(0, 1, [], ((0, 0, 5000, 256, 1.0, 0), False, ((), counts, ())), 1, None, None) == part
    for parts in ([], [part], [part] * 5, [(((1 << 40, *row[1:]),), counts, ())], [((), (19_295, *counts[1:]), ())]):
        with pytest.raises(ftlm.ModelError, match="start the search again"):
            work.join(parts)
    with pytest.raises(ftlm.ModelError, match="threads"):
        ready.evaluate_batches(0, 1, [], None, 0, None, None)
    assert isinstance(ready, _core.OrderSearch)
    with ThreadPoolExecutor(2) as pool:
        again = list(pool.map(lambda _: ready.evaluate_batches(0, 1, [], None, 1, None, None), range(4)))
    assert all(a == part for a in again)
    assert np.isfinite(part[0][0][1])


# ----------------------------------------------------------------------------------------------------------------------
# The file


def test_a_database_of_another_program_is_refused_and_kept(run, tmp_path):
    path = tmp_path / "s.ftlm"
    for tables in (["a (b)"], ["search (number)"], ["search_ (number)", "selection (number)"]):
        path.unlink(missing_ok=True)
        with contextlib.closing(sqlite3.connect(path)) as file, file:
            for table in tables:
                file.execute(f"CREATE TABLE {table}")
        stored = path.read_bytes()
        for call in (lambda: search(run, path), lambda: ftlm.resume_search(path), lambda: ftlm.search_status(path)):
            with pytest.raises(ftlm.DataError, match="is not an ftlm search store"):
                call()
        assert path.read_bytes() == stored


def test_an_append_that_a_kill_cut_short_is_void(run, whole, expected, tmp_path):
    """Killed between the journal and the end of an append: the journal is rolled back, by a reader too."""
    path = tmp_path / "s.ftlm"
    path.write_bytes(whole)
    keep(path, 2)
    stored = records(path)
    script = """if True:
        import os, signal, sqlite3, sys
        file = sqlite3.connect(sys.argv[1], isolation_level=None)
        file.execute("PRAGMA cache_size = 1")
        file.execute("BEGIN IMMEDIATE")
        for number in range(3, 40):
            file.execute("INSERT INTO search VALUES (?, zeroblob(3000), x'00')", (number,))
        os.kill(os.getpid(), signal.SIGKILL)
    """
    for read in (records, lambda path: (search(run, path), records(path)[:2])[1]):
        assert subprocess.run([sys.executable, "-c", script, path], check=False).returncode == -signal.SIGKILL
        assert (tmp_path / "s.ftlm-journal").exists()
        assert read(path) == stored
        assert [p.name for p in tmp_path.iterdir()] == ["s.ftlm"]
    assert bytes_of(search(run, path)) == expected


def test_a_store_that_was_given_a_log_is_one_file_again(run, whole, expected, tmp_path):
    path = tmp_path / "s.ftlm"
    path.write_bytes(whole)
    keep(path, 2)
    with contextlib.closing(sqlite3.connect(path)) as file:
        assert file.execute("PRAGMA journal_mode = WAL").fetchone() == ("wal",)
    with Store(path) as kept:
        assert kept._file._connection.execute("PRAGMA journal_mode").fetchone() == ("delete",)
        assert [p.name for p in tmp_path.iterdir()] == ["s.ftlm"]
    assert bytes_of(search(run, path)) == expected


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": np.zeros((2, 4, 4))}, "sizes of a record are inconsistent"),
        ({"means": np.zeros((2, 0))}, "sizes of a record are inconsistent"),
        ({"means": np.zeros((3, 8))}, "sizes of a record are inconsistent"),
        ({"sensor": np.ones((2, 2))}, "sizes of a record are inconsistent"),
        ({"states": 3}, "3 states of its sensor filter"),
        ({"initial": "nowhere"}, "has an unexpected entry in record 1"),
    ],
)
def test_records_that_fit_no_search_are_refused(run, tmp_path, changes, message):
    job = job_of(run, ftlm.equation(EQUATION, initial="rest"), COARSE, m=32, pruning=False)
    request = job.request("y")
    forged = msgspec.structs.replace(request, records=(replace(request.records[0], **changes),))
    path = tmp_path / "s.ftlm"
    with CheckpointFile(path, "search", "create") as file:
        file.append([RECORD_ENCODER.encode(frames.Requests(frames.ALGORITHM_VERSION, "0", (forged,)))])
    for call in (ftlm.resume_search, ftlm.search_status):
        with pytest.raises(ftlm.DataError, match=message):
            call(path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_forked_child_does_not_keep_the_lock(tmp_path):
    path = tmp_path / "a.ftlm"
    file = CheckpointFile(path, "search", "create")
    ready, started = os.pipe()
    child = os.fork()
    if child == 0:
        signal.alarm(60)
        os.write(started, b".")
        signal.pause()
    try:
        os.read(ready, 1)
        # The child takes nothing away either.
        with pytest.raises(ftlm.DataError, match="in use by another search"):
            CheckpointFile(path, "search", "create")
        file.close()
        CheckpointFile(path, "search", "create").close()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(ready)
        os.close(started)


def test_candidates_excluded_in_boxes_count_once_in_the_progress():
    state = object.__new__(EquationSearchState)
    state._parts, state.done = [], 0
    # 100 candidates: 2 kept, 3 beaten, 90 excluded by a bound, 60 of them in boxes, 4 stopped early, 1 singular.
    counts = (100, 2, 3, 90, 4, 1, 0, 60)
    state.add_block(frames.Rounds(0, 0, 1, ((), counts, ())))
    assert state.done == counts[0]
