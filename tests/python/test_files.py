"""Tests that load() reads what measurement programs write, and refuses hostile, damaged and doubtful files."""

import functools
import gzip
import json
import math
import os
import struct
import subprocess
import sys
import warnings
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

import ftlm
from ftlm.data.run import Run
from ftlm.errors import DataError
from ftlm.io import isolated_reader as apart
from ftlm.io.dialect import Layout
from ftlm.io.load import LoadOptions, load, run_from_tables, select_columns
from ftlm.io.preview import open_file
from ftlm.io.table import FileTable
from measured import DATA, needs_data

PSF = DATA / "two_link_psf"
SIGNALS = {"inputs": {"u": "c2"}, "outputs": {"y": "c3"}}
HEADED = {"inputs": ["u"], "outputs": ["y"]}
ANGLES = ("theta11", "theta12", "theta21", "theta22")


def rows(n=12, separator=",", step=0.01):
    return "".join(f"{separator.join([f'{j * step:.2f}', repr(math.sin(j)), repr(0.1 * j)])}\n" for j in range(n))


def sines(n=12):
    return np.array([math.sin(j) for j in range(n)])


def write(folder, content, name="x.csv"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def messages(words, call):
    with pytest.raises(DataError) as caught:
        call()
    missing = [word for word in words if word not in str(caught.value)]
    assert missing == [], str(caught.value)


# --- text that is read ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", "   ", " \t ", ", ", "; "])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("header", [True, False])
def test_separators_and_newlines(tmp_path, separator, newline, header):
    text = (separator.join(["t", "u", "y"]) + "\n" if header else "") + rows(separator=separator)
    path = write(tmp_path, text.replace("\n", newline))
    run = load(path, **HEADED) if header else load(path, time="c1", **SIGNALS)
    assert (run.length, run.step, run.name) == (12, 0.01, "x")
    np.testing.assert_array_equal(run["u"], sines())
    np.testing.assert_array_equal(run["y"], 0.1 * np.arange(12))


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbft,u,y\n" + rows().encode(),
        "# a comment\n\n  # another\nt,u,y\n" + rows(6) + "\n#,,,,\n" + rows(12).split("\n", 6)[6] + "\n\n",
        '"t","u","y"\n' + rows(),
        "t,u,y\n" + "".join(",".join(f'"{cell}"' for cell in line.split(",")) + "\n" for line in rows().split()),
        " t , u , y \n" + rows(),
        "t,u,y\n" + rows().rstrip("\n"),
        "TIME [S],u,y\n" + rows(),
        "Seconds,u,y\n" + rows(),
        "t,u,y,mode\n" + rows().replace("\n", ",auto\n"),
        "t,u,y,\n" + rows().replace("\n", ",\n"),
        ",t,u,y\n" + "".join(f"{index},{line}\n" for index, line in enumerate(rows().split())),
    ],
)
def test_text_as_programs_write_it(tmp_path, content):
    run = load(write(tmp_path, content), **HEADED)
    assert (run.length, run.step) == (12, 0.01)
    np.testing.assert_array_equal(run["u"], sines())


@pytest.mark.parametrize("name", ["x.txt", "x.dat", "x.tsv", "x.CSV", "x.log", "x"])
def test_any_file_that_is_text_is_read_as_text(tmp_path, name):
    assert load(write(tmp_path, rows(), name), time=0, inputs={"u": 1}, outputs={"y": "c3"}).length == 12


def test_a_file_of_many_blocks_is_read_whole(tmp_path, monkeypatch):
    path = write(tmp_path, "# note\nt,u,y\n" + rows(500))
    whole = load(path, **HEADED)
    monkeypatch.setattr("ftlm.io.delimited_text._BLOCK_BYTES", 97)
    pieces = load(path, **HEADED)
    assert pieces["u"].tobytes() == whole["u"].tobytes()
    text = ("t,u,y\n" + rows(500)).replace("\n1.50,", "\n1.50,oops").replace("\n3.50,", "\n3.50,oops")
    messages(
        ["column 'u', line 152", "oops", "row 150", "2 in all"],
        lambda: load(write(tmp_path, text, "b.csv"), **HEADED),
    )
    lines = rows(500).split("\n")
    lines[300] = lines[300] + ",1"
    lines[400] = "1"
    messages(
        ["line 301 has 4 cells", "2 lines in all"], lambda: load(write(tmp_path, "\n".join(lines)), time=0, **SIGNALS)
    )
    messages(["line 1 is longer"], lambda: load(write(tmp_path, "1" * 500), time=0, **SIGNALS))


def test_times_units_and_slices(tmp_path):
    path = write(tmp_path, "t,u,y\n" + rows(100))
    run = load(path, **HEADED, units={"y": "deg"}, window=(0.2, 0.5), intersample={"u": "foh"}, name="part")
    assert (run.start, run.length, run.name, run.units["y"], run.intersample["u"]) == (0.2, 30, "part", "rad", "foh")
    assert load(path, **HEADED, step=0.01).step == 0.01
    assert load(path, **HEADED, time_unit="ms").step == 1e-5
    assert load(path, **HEADED, resample=0.02).length == 50
    assert load(str(path), outputs="y").inputs == ()
    assert load([path], outputs="y").length == 100


def test_header_of_ftlm_tells_what_is_not_told(tmp_path):
    n = 20
    run = Run.from_arrays(
        step=0.01,
        inputs={"u": np.arange(n), "v": np.ones(n)},
        outputs={"y": np.arange(n), "z": np.arange(n)},
        units={"y": "deg", "u": "mA"},
        intersample={"v": "foh"},
    )
    path = tmp_path / "r.csv"
    run.to_csv(path)
    assert load(path).intersample == {"u": "zoh", "v": "foh"}
    assert load(path, outputs=["y"]).signals == ("u", "v", "y")
    assert load(path, inputs={"i": "v"}, name="other").intersample == {"i": "foh"}
    renamed = load(path, outputs={"theta": "y"})
    assert renamed.units["theta"] == "rad"
    assert renamed["theta"].tobytes() == run["y"].tobytes()
    assert load(path, units={"y": "rad", "z": "deg"})["z"][1] == pytest.approx(np.pi / 180)
    assert load(path, window=(0.05, None)).start == 0.05
    messages(["'deg'", "'y'", "'rad'", "leave the unit out"], lambda: load(path, units={"y": "deg"}))
    messages(["complete run"], lambda: load([path, write(tmp_path, rows())]))
    # Rows may be cut off by hand; the step stays.
    lines = path.read_text().splitlines(keepends=True)
    cut = load(write(tmp_path, "".join(lines[:2] + lines[5:])))
    assert (cut.start, cut.length, cut.step) == (0.03, 17, 0.01)
    messages(
        ["header says 0.02"], lambda: load(write(tmp_path, "".join(lines).replace('"step": 0.01', '"step": 0.02')))
    )


def test_what_no_reader_would_take_for_a_header_is_not_written(tmp_path):
    """A header has its longest line; before, such a file was written and could not be loaded."""
    long = {f"y{k:0>90}": np.zeros(3) for k in range(6000)}
    run = Run.from_arrays(inputs={"u": np.zeros(3)}, outputs=long, step=0.1)
    with pytest.raises(DataError, match=r"take \d{7} bytes, more than the 1048576 .* \.parquet"):
        run.to_csv(tmp_path / "run.csv")
    assert list(tmp_path.iterdir()) == []
    few = Run.from_arrays(inputs={"u": np.zeros(3)}, outputs=dict(list(long.items())[:5000]), step=0.1)
    few.to_csv(tmp_path / "run.csv")
    assert load(tmp_path / "run.csv").outputs == few.outputs


@pytest.mark.parametrize(
    "header",
    [
        "# ftlm-run 2 {}",
        "# ftlm-run",
        "# ftlm-run 1",
        "# ftlm-run 1 {}",
        "# ftlm-run 1 []",
        "# ftlm-run 1 " + "[" * 100_000,
        '# ftlm-run 1 {"name": "n", "step": NaN, "inputs": [], "outputs": ["y"], "units": {}, "intersample": {}, '
        '"warnings": []}',
        '# ftlm-run 1 {"name": "n", "step": 0.01, "inputs": [], "outputs": [["y"]], "units": {}, "intersample": {}, '
        '"warnings": []}',
        '# ftlm-run 1 {"name": "n", "step": 0.01, "inputs": [], "outputs": ["=y"], "units": {}, "intersample": {}, '
        '"warnings": []}',
        '# ftlm-run 1 {"name": "n", "step": 0.01, "inputs": [], "outputs": ["y"], "units": {"y": 3}, '
        '"intersample": {}, "warnings": []}',
        '# ftlm-run 1 {"name": "n", "step": 0.01, "inputs": ["u"], "outputs": ["y"], "units": {"y": "stone"}, '
        '"intersample": {}, "warnings": []}',
        '# ftlm-run 1 {"name": "n", "step": 0.01, "inputs": ["u"], "outputs": ["y"], "units": {}, '
        '"intersample": {"u": "x"}, "warnings": []}',
    ],
)
def test_damaged_headers_of_ftlm_are_refused(tmp_path, header):
    path = write(tmp_path, header + "\nt_s,u,y\n" + rows())
    with pytest.raises(DataError):
        load(path)


# --- text that is refused ---------------------------------------------------------------------------------------------


def changed(line, old, new, *more):
    lines = ("t,u,y\n" + rows()).split("\n")
    for number in (line, *more):
        cells = lines[number - 1].split(",")
        cells[old] = new
        lines[number - 1] = ",".join(cells)
    return "\n".join(lines)


BAD_TEXT = {
    "empty": ("", ["x.csv", "empty", "0 rows"]),
    "blank": ("\n\n  \n", ["empty"]),
    "comments only": ("# a\n# b\n", ["empty"]),
    "header only": ("t,u,y\n", ["header and no rows"]),
    "one row": ("t,u,y\n" + rows(1), ["1 row,", "3 are needed"]),
    "zero byte": (b"t,u,y\n0,1,2\n0.01,1\0,2\n", ["zero byte", "line 3"]),
    "latin-1": ("t,u,y\n0,1,2\n1,°,2\n".encode("latin-1"), ["column 'u', line 3", "'°' is not a number"]),
    "late latin-1": (
        b"t,u,y\n" + 120_000 * b"0,1,23456\n" + b"9,\xb0,2\n",
        ["line 120002", "UTF-8", "0xb0", "encoding="],
    ),
    "neither UTF-8 nor text": (b"t,u,y\n0,1,\xb0\x01\n", ["line 2", "0xb0", "not text", "encoding="]),
    "gzip": (gzip.compress(rows().encode(), mtime=0), ["x.csv"]),
    "duplicate names": ("t,u,y,u\n0,1,2,3\n1,1,2,3\n2,1,2,3\n", ["line 1", "'u'", "2 times"]),
    "short line": ("t,u,y\n0,1,2\n1,1\n2,1,2\n3,1\n", ["line 3 has 2 cells", "has 3", "2 lines in all", "comma"]),
    "long line": ("t,u,y\n0,1,2\n1,1,2\n2,1,2,\n", ["line 4 has 4 cells", "1 lines in all"]),
    "text in a number": (changed(5, 1, "oops", 9), ["column 'u', line 5", "'oops'", "row 3", "2 in all"]),
    "long text": (changed(5, 1, "x" * 200), ["column 'u', line 5", "x" * 40 + "…'"]),
    "script": (changed(5, 1, "\x1b[2J"), ["'\\x1b[2J'"]),
    "empty cell": (changed(4, 2, "", 6, 7), ["column 'y', line 4", "empty cell", "row 2", "3 in all"]),
    "empty last cell crlf": (
        changed(4, 2, "").replace("\n", "\r\n"),
        ["column 'y', line 4", "empty cell", "row 2", "1 in all"],
    ),
    "a decimal comma among points": (
        "t;u;y\n0.0;0.5;1\n1.0;0,6;1\n2.0;0.7;1\n3.0;0.7;1\n",
        ["column 'u', line 3", "'0,6'", "decimal comma", "1 in all"],
    ),
    "a point among decimal commas": (
        "t;u;y\n0,0;0,5;1\n1,0;1.234,5;1\n2,0;0.7;1\n3,0;0,7;1\n4,0;0,7;1\n",
        ["column 'u', line 4", "'0.7' has a point where decimals follow a comma", "1 in all; write all numbers alike"],
    ),
    "half a header": ("0.0,abc,3\n1,2,3\n2,2,3\n", ["line 1", "'abc'", "mixes words and numbers", "1 in all"]),
    "nan": (changed(5, 1, "nan"), ["x.csv: column 'u' (signal 'u')", "NaN", "row 3", "1 in all"]),
    "inf": (changed(5, 1, "-inf", 6), ["column 'u'", "infinity", "row 3", "2 in all"]),
    "1e999": (changed(5, 1, "1e999"), ["column 'u'", "infinity", "row 3"]),
    "1e308": (changed(5, 1, "1e308"), ["column 'u'", "1e+308", "row 3"]),
    "hexadecimal": (changed(5, 1, "0x10"), ["column 'u'", "'0x10'"]),
    "complex": (changed(5, 1, "1+2j"), ["column 'u'", "'1+2j'"]),
    "time repeated": (changed(5, 0, "0.02"), ["x.csv: column 't' (time)", "repeated", "row 3", "1 in all"]),
    "time decreasing": (changed(5, 0, "0.00"), ["column 't' (time)", "decreasing", "row 3"]),
    "time jitter": (changed(5, 0, "0.031"), ["column 't' (time)", "jitter", "row 3", "1 in all", "resample=STEP"]),
    "time gap": ("t,u,y\n" + rows(4) + "9,1,2\n9.01,1,2\n", ["column 't' (time)", "gap", "row 4", "1 in all"]),
    "time nan": (changed(5, 0, "nan"), ["column 't' (time)", "NaN", "row 3"]),
    "time text": (changed(5, 0, "12:00:01"), ["column 't', line 5", "'12:00:01'"]),
    "two times": ("t,time,u,y\n0,0,1,2\n1,1,1,2\n2,2,1,2\n", ["'t', 'time'", "time="]),
    "no time": ("a,u,y\n" + rows(), ["time", "step=", "'a', 'u', 'y'"]),
    "unknown column": ("t,uu,y\n" + rows(), ["'u'", "signal 'u'", "x.csv", "'t', 'uu', 'y'"]),
    "open quote": ('t,u,y\n0,"1,2\n' + rows(), ["quote"]),
}


@pytest.mark.parametrize("case", BAD_TEXT)
def test_bad_text_is_refused(tmp_path, case):
    content, words = BAD_TEXT[case]
    path = write(tmp_path, content)
    messages(words, lambda: load(path, **HEADED))


BAD_CALLS = {
    "no outputs": ({"inputs": ["u"]}, ["outputs="]),
    "time and step": ({**HEADED, "time": "t", "step": 1}, ["time= and step=", "both"]),
    "position": ({**HEADED, "time": 3}, ["column 3 (time)", "0 to 2"]),
    "negative position": ({**HEADED, "time": -1}, ["column -1 (time)", "0 to 2"]),
    "boolean": ({**HEADED, "time": True}, ["column True"]),
    "float": ({**HEADED, "time": 0.0}, ["column 0.0 (time)"]),
    "misspelt": ({"inputs": {"u": "uu"}, "outputs": ["y"]}, ["'uu'", "signal 'u'", "did you mean 'u'"]),
    "unit": ({**HEADED, "units": {"y": "degg"}}, ["'degg'", "did you mean 'deg'"]),
    "both roles": ({"inputs": {"a": "u"}, "outputs": {"a": "y"}}, ["'a'", "both"]),
    "columns key": ({"columns": {"tiem": "t"}}, ["'tiem'", "did you mean 'time'", "'units'"]),
    "columns kind": ({"columns": 3}, ["columns=", "int"]),
    "columns time and step": ({"columns": {"time": "t", "step": 1.0, "outputs": ["y"]}}, ["columns=", "time and step"]),
    "columns step": ({"columns": {"step": "fast", "outputs": ["y"]}}, ["step='fast'"]),
    "columns table": ({"columns": {"inputs": 3, "outputs": ["y"]}}, ["inputs=", "int"]),
    "columns units": ({"columns": {"units": "deg", "outputs": ["y"]}}, ["units=", "str"]),
    "columns missing": ({"columns": "no_such.toml"}, ["no_such.toml", "No such file"]),
    "window": ({**HEADED, "window": (0, 99)}, ["window", "99"]),
    "name": ({**HEADED, "name": "@x"}, ["name='@x'"]),
}


@pytest.mark.parametrize("case", BAD_CALLS)
def test_bad_calls_are_refused(tmp_path, case):
    arguments, words = BAD_CALLS[case]
    path = write(tmp_path, "t,u,y\n" + rows())
    messages(words, lambda: load(path, **arguments))


def test_bad_paths_are_refused(tmp_path, monkeypatch):
    path = write(tmp_path, "t,u,y\n" + rows(), "square.csv")
    messages(["sqare.csv", "does not exist", "did you mean 'square.csv'"], lambda: load(tmp_path / "sqare.csv"))
    messages(["not a file"], lambda: load(tmp_path))
    messages(["list is empty"], lambda: load([]))
    messages(["path is an int"], lambda: load(3))
    messages(["path is a list"], lambda: load([3]))
    messages(["given twice"], lambda: load([path, str(path)]))
    messages(["cannot be opened"], lambda: load("a\0b"))
    for name in ("x.parquet", "x.PQ"):
        pytest.importorskip("pyarrow", reason="pyarrow is not here; pip install -r requirements-test.txt")
        messages(["damaged", "intact copy"], lambda name=name: load(write(tmp_path, b"PAR1", name)))
    monkeypatch.setattr("ftlm.io.load._MAX_FILE_BYTES", 100)
    messages(["square.csv", "more than the limit of 100"], lambda: load(path, **HEADED))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes in folders")
def test_pipes_and_devices_are_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    messages(["not a file"], lambda: load(tmp_path / "pipe.csv"))
    messages(["not a file"], lambda: load("/dev/zero"))


def test_names_that_cannot_name_a_run_do_not_stop_a_file(tmp_path):
    assert load(write(tmp_path, "t,u,y\n" + rows(), "=x.csv"), **HEADED).name == "run"


# --- columns files ----------------------------------------------------------------------------------------------------

TOML = """
time = "t"
[inputs]
I = "u"
[outputs]
theta = "y"
[units]
theta = "deg"
[intersample]
I = "foh"
"""


def test_a_step_that_contradicts_the_time_column_is_refused(tmp_path):
    def reads(text, seconds, **options):
        return load(write(tmp_path, text), inputs=["u"], outputs=["y"], step=seconds, **options).step

    plain = rows(100)
    for header, factor in (("t,u,y", 1.0), ("time [ms],u,y", 1e-3), ("clock,u,y", 1.0)):
        text, columns = f"{header}\n{plain}", {"time": header.split(",")[0]}
        own = 0.01 * factor
        assert reads(text, own, columns=columns) == own
        assert reads(text, 1.01 * own, columns=columns) == 1.01 * own
        for wrong in (1.1 * own, 2 * own, 0.5 * own):
            for given_columns in (columns, {}) if header[0] == "t" else (columns,):
                call = functools.partial(reads, text, wrong, columns=given_columns)
                messages([f"step={wrong!r}", f"{own:g} s", "omit"], call)
    # A column of any other name, a unit that is unknown, and times that do not increase are no time axis.
    assert reads(f"clock,u,y\n{plain}", 3.0) == reads(f"time [ticks],u,y\n{plain}", 3.0) == 3.0
    assert reads("t,u,y\n" + "0,1,2\n" * 9, 3.0) == 3.0
    dated = "when,u,y\n" + "".join(f"2024-05-01 12:00:{s:02},{s % 3},{s}\n" for s in range(20))
    assert reads(dated, 1.0) == 1.0
    messages(["step=2.0", "'when'", "1 s"], lambda: reads(dated, 2.0))
    path = write(tmp_path, f"t,u,y\n{plain}")
    opened = ftlm.open_file(path, step=0.01)
    assert [c.role for c in opened.columns] == ["time", "input", "output"]
    assert opened.problem == ""
    assert opened.load().step == 0.01
    assert "0.01 s" in ftlm.open_file(path, step=0.02).problem


def test_columns_file(tmp_path):
    lines = [f"{line},{line.split(',')[2]}\n" for line in rows().splitlines()]
    path, toml = write(tmp_path, "t,u,y,v\n" + "".join(lines)), write(tmp_path, TOML, "arm.toml")
    run = load(path, columns=toml)
    assert (run.signals, run.units, run.intersample) == (("I", "theta"), {"I": "", "theta": "rad"}, {"I": "foh"})
    assert load(path, columns=toml, step=0.01, intersample={"I": "zoh"}).step == 0.01
    more = load(path, columns=toml, inputs={"I": "v", "w": "u"}, units={"theta": "mrad", "w": "A"})
    assert more.inputs == ("I", "w")
    np.testing.assert_array_equal(more["I"], 0.1 * np.arange(12))
    assert more["theta"][10] == pytest.approx(1e-3)
    as_dict = {"step": 0.5, "outputs": {"theta": "y"}}
    messages(["step=0.5", "column 't'", "0.01 s", "omit step="], lambda: load(path, columns=as_dict))
    assert load(path, columns=as_dict, time="t").step == 0.01
    for content in ("time = ", b"\xff\xfe", "a = [" * 50_000):
        messages(["bad.toml", "not a TOML file"], lambda c=content: load(path, columns=write(tmp_path, c, "bad.toml")))


# --- several files ----------------------------------------------------------------------------------------------------


def test_columns_of_several_text_files_are_pooled(tmp_path):
    a = write(tmp_path, "t,u\n" + "".join(f"{j},{j * j}\n" for j in range(9)), "a.csv")
    b = write(tmp_path, "t,y\n" + "".join(f"{j},{-j}\n" for j in range(9)), "b.csv")
    run = load([a, b], **HEADED)
    assert (run.step, run["u"][3], run["y"][3]) == (1.0, 9.0, -3.0)
    assert load([a, b], **HEADED, time="b/t").step == 1.0
    messages(["positions are for single text files"], lambda: load([a, b], **HEADED, time=0))
    late = write(tmp_path, "t,y\n" + "".join(f"{j + (j > 4) * 1e-6},{-j}\n" for j in range(9)), "late.csv")
    messages(["'a/t'", "'late/t'", "row 5", "4 in all"], lambda: load([a, late], **HEADED))
    short = write(tmp_path, "t,y\n0,1\n1,2\n2,3\n", "short.csv")
    messages(["'a/t'", "'short/t'", "9 and 3 rows"], lambda: load([a, short], **HEADED))
    messages(["3 rows", "9 are expected"], lambda: load([a, short], **HEADED, step=1))
    (tmp_path / "d").mkdir()
    same = write(tmp_path / "d", "t,u\n0,1\n", "a.csv")
    messages(["'a/t'", "rename"], lambda: load([a, same], **HEADED))


# --- MATLAB -----------------------------------------------------------------------------------------------------------


def mat(folder, name="x.mat", **variables):
    scipy.io.savemat(folder / name, variables, do_compression=variables.pop("_compress", False))
    return folder / name


def table(n=30, step=0.002):
    t = np.arange(n) * step
    return np.column_stack([t, np.sin(t), np.cos(t)])


@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.usefixtures("reader_in_process")
def test_mat_matrices_vectors_and_what_is_skipped(tmp_path, compress):
    path = mat(
        tmp_path,
        V=table(),
        row=np.arange(30.0),
        column=np.arange(30, dtype=np.int16).reshape(-1, 1),
        single=np.arange(30, dtype=np.float32),
        yes=np.arange(30) > 9,
        word="text",
        cell=np.array([1, "a"], dtype=object),
        struct={"a": 1},
        cube=np.zeros((3, 3, 3)),
        z=np.arange(30) * 1j,
        none=np.zeros((0, 0)),
        _compress=compress,
    )
    run = load(path, inputs={"a": "V.2", "b": "row", "c": "column", "d": "single", "e": "yes"}, outputs={"y": "V(:,3)"})
    assert (run.step, run.length, run.name) == (0.002, 30, "x")
    np.testing.assert_array_equal(run["y"], table()[:, 2])
    for name in "bcd":
        np.testing.assert_array_equal(run[name], np.arange(30))
    np.testing.assert_array_equal(run["e"], np.arange(30) > 9)
    assert load(path, outputs=["row"], step=1).step == 1
    assert load(path, outputs=["row"], time="V.1").step == 0.002
    messages(["time", "step="], lambda: load(path, outputs=["row"]))
    for name in ("word", "cell", "cube", "z", "none"):
        messages([repr(name), "not in", "not read", f"{name!r} ("], lambda name=name: load(path, outputs=[name]))
    for name in ("V", "V.0", "V.4", "V(:,4)", "V(:,99999999999999999999)", "row.1"):
        messages([repr(name), "the columns are 'V.1', 'V.2'"], lambda name=name: load(path, outputs={"y": name}))
    messages(["positions"], lambda: load(path, outputs={"y": 0}))


@pytest.mark.parametrize("others", [{}, {"rate": 100.0}])
@pytest.mark.usefixtures("reader_in_process")
def test_mat_struct_fields_are_columns_of_one_table(tmp_path, others):
    t = np.arange(50) * 0.01
    u, y = np.sign(np.sin(9 * t)), np.cos(t)
    struct = {"t": t[:, None], "u": u, "y": y[:, None], "comment": "bench 3"}
    scipy.io.savemat(tmp_path / "s.mat", {"data": struct, **others})
    run = load(tmp_path / "s.mat", inputs=["u"], outputs=["y"])
    assert run.step == pytest.approx(0.01)
    np.testing.assert_array_equal(run["u"], u)
    np.testing.assert_array_equal(run["y"], y)


@pytest.mark.usefixtures("reader_in_process")
def test_mat_structs_that_share_field_names_stay_apart(tmp_path):
    t = np.arange(50.0)
    scipy.io.savemat(tmp_path / "s.mat", {"a": {"t": t, "u": t}, "b": {"t": t, "u": -t}})
    assert [c.name for c in open_file(tmp_path / "s.mat").columns] == ["a.t", "a.u", "b.t", "b.u"]


@pytest.mark.usefixtures("reader_in_process")
def test_mat_time_of_a_named_vector_single_precision_and_nan(tmp_path):
    t = np.arange(3000) * 0.002
    y = np.column_stack([np.sin(t), np.cos(t)])
    path = mat(tmp_path, t=t, Y=y)
    assert load(path, outputs={"y": "Y.1"}).step == 0.002
    assert load(mat(tmp_path, t=t.astype(np.float32), Y=y), outputs={"y": "Y.1"}).step == 0.002
    bad = table()
    bad[7, 2] = np.nan
    messages(["x.mat: column 'V.3'", "NaN", "row 7"], lambda: load(mat(tmp_path, V=bad), outputs={"y": "V.3"}))
    bad[7, 0] = np.nan
    messages(["column 'V.1' (time)", "NaN", "row 7"], lambda: load(mat(tmp_path, V=bad), outputs={"y": "V.2"}))


@pytest.mark.usefixtures("reader_in_process")
def test_mat_matrices_of_one_run_must_share_their_time(tmp_path):
    other = table()
    other[10:, 0] += 0.0001
    a, b = mat(tmp_path, "a.mat", A=table()), mat(tmp_path, "b.mat", B=other)
    signals = {"inputs": {"u": "A.3"}, "outputs": {"y": "B.3"}}
    messages(["'A.1' of a.mat", "'B.1' of b.mat", "row 10", "20 in all", "time="], lambda: load([a, b], **signals))
    assert load([a, b], **signals, time="A.1").step == 0.002
    short = mat(tmp_path, "b.mat", B=table(20))
    messages(["'A.1'", "'B.1'", "30 and 20 rows"], lambda: load([a, short], **signals))
    messages(["20 rows where 30 are expected"], lambda: load([a, short], **signals, time="A.1"))
    same = mat(tmp_path, "b.mat", A=table())
    run = load([a, same], inputs={"u": "a/A.3"}, outputs={"y": "b/A(:,2)"})
    np.testing.assert_array_equal(run["y"], table()[:, 1])
    messages(["'A.3'", "'a/A.1'"], lambda: load([a, same], outputs={"y": "A.3"}))


@pytest.mark.usefixtures("reader_in_process")
def test_mat_with_signals_in_rows_is_refused(tmp_path):
    path = mat(tmp_path, V=table().T)
    messages(["'V'", "3 rows and 30 columns", "transpose"], lambda: load(path, outputs={"y": "V.1"}))


def raw_mat(*elements):
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + b"".join(elements)


def bomb(count):
    """Return a compressed variable that declares `count` rows and delivers zeros for ever."""
    body = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, count, 1)
    body += struct.pack("<II", 1, 1) + b"V" + b"\0" * 7 + struct.pack("<II", 9, (8 * count) & 0xFFFFFFFF)
    packer = zlib.compressobj(9)
    parts = [packer.compress(struct.pack("<II", 14, (len(body) + 8 * count) & 0xFFFFFFFF) + body)]
    parts += [packer.compress(bytes(1 << 20)) for _ in range(8)]
    packed = b"".join(parts) + packer.flush()
    return raw_mat(struct.pack("<II", 15, len(packed)), packed)


BAD_MATS = {
    "empty": (b"", ["version 4, 5 or 7.3"]),
    "text": (b"t,u,y\n0,1,2\n" * 50, ["version 4, 5 or 7.3"]),
    "hdf5": (b"MATLAB 7.3 MAT-file, Platform".ljust(124) + b"\x00\x02IM" + bytes(400), ["damaged", "-v7'"]),
    "hdf5 without text": (b"\x89HDF\r\n\x1a\n" + bytes(400), ["damaged", "-v7'"]),
    "hdf5 with user block": (bytes(512) + b"\x89HDF\r\n\x1a\n" + bytes(400), ["damaged", "-v7'"]),
    "version 4, cut": (struct.pack("<IIIII", 0, 300, 1, 0, 2) + b"V\0" + bytes(24), ["-v7'"]),
    "no variables": (raw_mat(), ["no real numeric matrix"]),
    "size bomb": (bomb(1 << 28), ["more than 1073741824 bytes", "a part of it"]),
    "short bomb": (bomb(1 << 26), ["x.mat"]),
}


@pytest.mark.parametrize("case", BAD_MATS)
def test_bad_mat_files_are_refused(tmp_path, case):
    content, words = BAD_MATS[case]
    path = write(tmp_path, content, "x.mat")
    messages(["x.mat", *words], lambda: load(path, outputs={"y": "V"}, step=1))


@pytest.mark.usefixtures("reader_in_process")
def test_mat_with_text_only_is_refused(tmp_path):
    messages(["no real numeric matrix", "'word' (char)"], lambda: load(mat(tmp_path, word="a"), outputs=["word"]))


def damaged(content, seed):
    """Return a cut or flipped copy: mostly in the headers, where a wrong type code sends the reader astray."""
    random = np.random.default_rng(seed)
    if seed % 3 == 0:
        return content[: int(random.integers(0, len(content)))]
    flipped = bytearray(content)
    reach = len(content) if seed % 3 == 1 else 220
    for position in random.integers(0 if seed % 2 else 120, reach, size=int(random.integers(1, 6))):
        flipped[position] ^= int(random.integers(1, 256))
    return bytes(flipped)


def answered(paths, kind=apart.MATLAB_FORMAT):
    """What becomes of files, read by as few children as live through them: tables, errors, or how a child ended."""
    found = {}
    told = json.dumps({"folders": [str(Path(m.__file__).parents[1]) for m in (np, scipy)], "sheet": None})
    while paths:
        command = [sys.executable, "-I", str(apart._READER_PATH), kind.kind, told, *map(str, paths)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=120, check=False)
        answers = apart._ReaderOutput(done.stdout)
        for path in paths:
            try:
                found[path] = answers.table(path, Layout())
            except DataError as error:
                found[path] = error
            if found[path] is None:
                found[path] = done.returncode
                break
        paths = [path for path in paths if path not in found]
    return found


def test_damaged_mat_files_give_a_run_or_a_data_error(tmp_path):
    paths = []
    for seed in range(40):
        whole = mat(tmp_path, V=table(), s={"a": np.arange(4)}, w="word", _compress=seed % 4 == 1).read_bytes()
        paths.append(write(tmp_path, damaged(whole, seed), f"x{seed}.mat"))
    found = answered(paths)
    kinds = Counter(type(answer) for answer in found.values())
    assert kinds[FileTable] > 3 < kinds[DataError]
    for path, answer in found.items():
        if isinstance(answer, FileTable):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    wanted = select_columns(None, None, None, {"u": "V.2"}, {"y": "V.3"}, None, None, None)
                    text = f"{path.name} with {run_from_tables([answer], wanted, LoadOptions()).length} rows"
                except DataError as error:
                    text = str(error)
        else:
            # A child that died is said to have, as the tests of its ends below say.
            text = str(answer) if isinstance(answer, DataError) else f"{path.name}: ended with {answer}"
        assert path.name in text
        assert len(text) < 1500
    # The same by the way that people take.
    path = next(path for path, answer in found.items() if isinstance(answer, DataError))
    messages([path.name], lambda: load(path, inputs={"u": "V.2"}, outputs={"y": "V.3"}))


def test_type_code_that_crashes_scipy_costs_only_the_child(tmp_path):
    path = mat(tmp_path, V=table())
    content = bytearray(path.read_bytes())
    paths = []
    for code in range(0, 24):
        # The type code of the numbers stands behind the flags, the shape and the short name.
        content[128 + 8 + 16 + 16 + 8] = code
        paths.append(write(tmp_path, bytes(content), f"y{code}.mat"))
    found = answered(paths)
    died = [path for path, answer in found.items() if isinstance(answer, int)]
    good = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18)
    for code, answer in zip(range(24), (found[path] for path in paths), strict=True):
        assert isinstance(answer, FileTable) <= (code in good)
    for path in died[:1]:
        messages([path.name, "the reader crashed"], lambda path=path: load(path, outputs={"y": "V.3"}))


def reader(folder, body):
    path = folder / "reader.py"
    path.write_text(f"import os, signal, sys, time\n{body}\n")
    return path


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", ["damaged file", "crashed (signal 11, SIGSEGV)", "-v7"]),
        ("os.abort()", ["damaged file", "signal 6"]),
        ("sys.exit(3)", ["damaged file", "code 3"]),
        ("", ["damaged file", "too early"]),
        ("print('hello')", ["damaged file", "too early"]),
        ("print('[1]')", ["too early"]),
        ("print('{}')", ["no real numeric matrix"]),
        ("print('[' * 100000)", ["too early"]),
        ("print('{\"arrays\": 3}')", ["too early"]),
        ('print(\'{"arrays": [{"name": "V", "rows": -1, "columns": 1, "type": "x"}]}\')', ["x.mat"]),
        ('print(\'{"arrays": [{"name": "V", "rows": 9, "columns": 1, "type": "x"}]}\')', ["too early"]),
        ("time.sleep(60)", ["did not finish in 1 s"]),
    ],
)
def test_a_reader_that_dies_or_babbles_gives_a_data_error(tmp_path, monkeypatch, body, words):
    path = mat(tmp_path, V=table())
    monkeypatch.setattr(apart, "_READER_PATH", reader(tmp_path, body))
    if "sleep" in body:
        monkeypatch.setattr(apart, "_READER_TIMEOUT_S", 1.0)
    messages(["x.mat", *words], lambda: load(path, outputs={"y": "V.3"}))


def test_a_crash_names_the_file_that_caused_it(tmp_path, monkeypatch):
    paths = [mat(tmp_path, f"{name}.mat", **{name: table()}) for name in "abc"]
    body = "print('{}', flush=True)\nos.kill(os.getpid(), signal.SIGSEGV)"
    monkeypatch.setattr(apart, "_READER_PATH", reader(tmp_path, body.replace("{}", '{"error": "e", "way_out": "w"}')))
    messages(["a.mat", "e; w"], lambda: load(paths, outputs={"y": "a.3"}))
    good = '{"arrays": [{"name": "a", "rows": 1, "columns": 1, "type": "float64"}], "skipped": {}}'
    body = f"sys.stdout.write('{good}\\\\n' + '\\\\0' * 8)\nsys.stdout.flush()\nos.kill(os.getpid(), signal.SIGSEGV)"
    monkeypatch.setattr(apart, "_READER_PATH", reader(tmp_path, body.replace("\\\\", "\\")))
    messages(["b.mat", "signal 11"], lambda: load(paths, outputs={"y": "a"}))


def test_missing_scipy_is_said(tmp_path, monkeypatch):
    path = mat(tmp_path, V=table())
    found = apart.importlib.util.find_spec
    monkeypatch.setattr(apart.importlib.util, "find_spec", lambda name: None if name == "scipy" else found(name))
    messages(["scipy", "pip install 'ftlm[mat]'"], lambda: load(path, outputs={"y": "V.3"}))


# --- properties -------------------------------------------------------------------------------------------------------


@settings(max_examples=300, deadline=None)
@given(content=st.binary(max_size=300) | st.text("0123456789.,;\t \n\r#-e\"na'i", max_size=200).map(str.encode))
def test_no_text_gives_anything_but_a_run_or_a_data_error(content, tmp_path_factory):
    path = write(tmp_path_factory.mktemp("text"), content)
    try:
        run = load(path, outputs={"y": 0}, step=1)
    except DataError as error:
        text = str(error)
    else:
        text = f"x.csv {'is finite' if np.isfinite(run['y']).all() else ''}"
    assert "x.csv:" in text or "x.csv is finite" in text or "column 0" in text


@settings(max_examples=100, deadline=None)
@given(
    values=st.lists(st.tuples(*[st.floats(-1e150, 1e150)] * 3), min_size=3, max_size=30),
    separator=st.sampled_from([",", ";", "\t", " "]),
    header=st.booleans(),
)
def test_numbers_are_read_to_the_bit(values, separator, header, tmp_path_factory):
    lines = [["a", "b", "c"]] * header + [[repr(cell) for cell in row] for row in values]
    text = "\n".join(separator.join(cells) for cells in lines)
    path = write(tmp_path_factory.mktemp("text"), text)
    run = load(path, inputs={"x": 0}, outputs={"y": 1, "z": 2}, step=1)
    for name, column in zip("xyz", np.array(values).T, strict=True):
        assert run[name].tobytes() == column.tobytes()


# --- measured data ----------------------------------------------------------------------------------------------------


@needs_data
def test_measured_csv_and_mat_agree():
    from_csv = load(
        PSF / "psf.csv",
        time="t_s",
        inputs={"I1": "Im1_meas_A", "I2": "Im2_meas_A"},
        outputs={angle: f"th{angle[-2:]}_deg" for angle in ANGLES},
        units={**dict.fromkeys(ANGLES, "deg"), "I1": "A", "I2": "A"},
    )
    from_mat = load(
        [PSF / f"data_psf_{name}.mat" for name in ("Im1", "Im2", "th11", "th12", "th21", "th22")],
        inputs={"I1": "data_Im1.3", "I2": "data_Im2(:,3)"},
        outputs={angle: f"data_th{angle[-2:]}.3" for angle in ANGLES},
        units={**dict.fromkeys(ANGLES, "deg"), "I1": "A", "I2": "A"},
    )
    converted = ", ".join(f"{angle} from deg to rad" for angle in ANGLES)
    for run in (from_csv, from_mat):
        assert (run.length, run.step, run.start, run.duration) == (9820, 0.002, 0.0, 19.638)
        assert run.warnings == (f"converted to SI units: {converted}",)
        run.require_outputs(ANGLES)
    for name in from_csv.signals:
        np.testing.assert_allclose(from_csv[name], from_mat[name], rtol=0, atol=1e-6)
    with pytest.raises(DataError, match=r"'theta12' .* constant"):
        from_csv.window(0, 1.0).require_outputs(["theta12"])


@needs_data
def test_measured_record_whose_time_starts_late():
    run = load(
        DATA / "two_link_lqr" / "lqr.csv",
        inputs={"I1": "Im1_cmd_A"},
        outputs={"theta11": "th11_deg"},
        units={"theta11": "deg"},
        window=(1.1, None),
    )
    assert (run.step, run.start, run.length) == (0.002, 83.274, 9450)


@needs_data
def test_measured_records_without_header():
    arm = load(DATA / "robot_arm" / "robot_arm.dat", inputs={"torque": "c1"}, outputs={"acceleration": "c2"}, step=1.0)
    assert (arm.length, arm.step) == (1024, 1.0)
    assert np.corrcoef(arm["torque"][512:], arm["torque"][:512])[0, 1] < -0.99
    heating = load(
        DATA / "heating" / "heating_system.dat",
        time="c1",
        inputs={"u": "c2"},
        outputs={"y": "c3"},
        units={"u": "V", "y": "°C"},
    )
    assert (heating.length, heating.step, heating.units) == (801, 2.0, {"u": "V", "y": "degC"})
    assert heating["y"][0] == 129.32


@pytest.mark.parametrize("header", ["Time,Q,T", "t,Q,T", "T,Q,Time"])
def test_a_column_that_is_named_as_a_signal_is_not_taken_for_the_time(tmp_path, header):
    clock = "t" if "t," in header[:2] else "Time"
    columns = {clock: np.arange(60) * 0.5, "Q": np.ones(60), "T": np.linspace(20.0, 30.0, 60)}
    path = tmp_path / "heat.csv"
    table = np.column_stack([columns[n] for n in header.split(",")])
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    run = load(path, inputs=["Q"], outputs=["T"])
    assert run.step == 0.5
    assert run["T"] == pytest.approx(columns["T"])
    opened = open_file(path, inputs=["Q"], outputs=["T"])
    assert (opened.problem, opened.step) == ("", 0.5)


def test_the_only_column_called_t_is_no_time_where_it_is_a_signal(tmp_path):
    path = tmp_path / "heat.csv"
    np.savetxt(path, np.column_stack([np.ones(60), np.arange(60.0)]), delimiter=",", header="Q,T", comments="")
    with pytest.raises(DataError, match="no column is called t, time or seconds"):
        load(path, inputs=["Q"], outputs=["T"])
    # Named as both it is both.
    assert load(path, inputs=["T"], outputs=["Q"], time="T").step == 1.0
    scipy.io.savemat(tmp_path / "heat.mat", {"V": np.column_stack([np.arange(60.0), np.ones(60)])})
    with pytest.raises(DataError, match="no column is called t, time or seconds"):
        load(tmp_path / "heat.mat", inputs={"u": "V.1"}, outputs={"y": "V.2"})


def matlab_object(name):
    """Return the bytes of an object of MATLAB, such as a datetime, as version 5 writes it beside the variables."""

    def element(kind, body):
        return struct.pack("<II", kind, len(body)) + body + b"\0" * (-len(body) % 8)

    def matrix(body):
        return struct.pack("<II", 14, len(body)) + body

    content = [
        element(6, struct.pack("<II", 13, 0)),
        element(5, struct.pack("<ii", 6, 1)),
        element(1, b""),
        element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1)),
    ]
    words = [element(1, text) for text in (name.encode(), b"MCOS", b"datetime")]
    return matrix(b"".join([element(6, struct.pack("<II", 17, 0)), *words, matrix(b"".join(content))]))


def test_a_mat_file_is_read_beside_an_object_of_matlab(tmp_path):
    variables = {"t": np.arange(40)[:, None] * 0.1, "u": np.ones((40, 1)), "y": np.sin(np.arange(40.0))[:, None]}
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, variables)
    plain = load(path, time="t", inputs=["u"], outputs=["y"])
    path.write_bytes(path.read_bytes() + matlab_object("when"))
    run = load(path, time="t", inputs=["u"], outputs=["y"])
    for signal in ("u", "y"):
        np.testing.assert_array_equal(run[signal], plain[signal])
    # The object alone is no table.
    scipy.io.savemat(path, {})
    path.write_bytes(path.read_bytes() + matlab_object("when"))
    with pytest.raises(DataError, match="object"):
        load(path, time="t", inputs=["u"], outputs=["y"])
