"""How text and sheets are laid out: what is found, what is said, what is refused because it could be two things."""

import datetime
import gzip
import io
import shlex
import struct
import zipfile

import numpy as np
import pytest

import ftlm
import unknown_files
from ftlm.io import binary_reader as reader
from ftlm.io import delimited_text as text
from ftlm.io import dialect
from ftlm.io import isolated_reader as apart
from test_files import messages, rows, write

SIGNALS = {"inputs": {"u": "u"}, "outputs": {"y": "y"}}


def read(folder, content, name="x.csv", **options):
    return ftlm.load(write(folder, content, name), **{**SIGNALS, **options})


# --- what is found ----------------------------------------------------------------------------------------------------

COMMAS = "t;u;y\n0,0;0,5;1\n0,1;-1,25e-3;2\n0,2;,5;3\n0,3;7;4\n"
FOUND = {
    "decimal commas": (COMMAS, {"decimal": "comma"}),
    "tabs": (COMMAS.replace(";", "\t"), {"decimal": "comma", "separator": "tab"}),
    "white space": (COMMAS.replace(";", "   "), {"decimal": "comma", "separator": "space"}),
    "quoted": (COMMAS.replace("0,5", '"0,5"'), {"decimal": "comma"}),
    "no mark of UTF-16": (COMMAS.encode("utf-16-be"), {"encoding": "utf-16-be"}),
    "UTF-32": (COMMAS.encode("utf-32"), {"encoding": "utf-32"}),
    "lines above": ("Program 3.1;;\nDate;2024-05-01;\nRate;10;Hz\n" + COMMAS, {"skip": 3}),
    "lines above of other widths": ("Program\n\na;1\nb;2\nc;3\n;;;;\n" + COMMAS, {"skip": 6}),
    "remarks above": ("# made by hand\n" + COMMAS, {"skip": 0}),
    "units": (COMMAS.replace("y\n", "y\ns;V;mm\n"), {"header": 2}),
    "units in brackets": (COMMAS.replace("y\n", "y\n[s];(V);(mm)\n"), {"header": 2}),
    "units behind a blank line": (COMMAS.replace("y\n", "y\n(s);(V);(furlong)\n\n"), {"header": 2}),
    "an empty last name": (COMMAS.replace("y\n", "y;\n"), {"header": 1}),
    "empty last cells of rows": ("".join(line + ";\n" for line in COMMAS.split()).replace("y;", "y"), {"header": 1}),
}


@pytest.mark.parametrize("case", FOUND)
def test_what_is_found_is_said_and_saying_it_gives_the_same_run(tmp_path, case):
    content, told = FOUND[case]
    run = read(tmp_path, content)
    np.testing.assert_array_equal(run["u"], [0.5, -1.25e-3, 0.5, 7.0])
    scale = 1e-3 if case in ("units", "units in brackets") else 1.0
    np.testing.assert_allclose(run["y"], np.array([1, 2, 3, 4]) * scale)
    assert run.step == 0.1
    opened = ftlm.open_file(tmp_path / "x.csv", **SIGNALS)
    assert {key: getattr(opened.layout, key) for key in told} == told
    said = ftlm.load(tmp_path / "x.csv", **SIGNALS, layout=opened.layout)
    assert all(said[n].tobytes() == run[n].tobytes() for n in "uy")
    assert not any("decimal" in w or "line" in w for w in said.warnings)
    assert any(w == "decimal commas, as in '0,0'; otherwise layout=dict(decimal='point')" for w in run.warnings)


def test_units_and_settings_of_an_oscilloscope_are_no_row(tmp_path):
    lines = "".join(f"{k},{k % 3}.5,{k},,\n" for k in range(9))
    text = "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-1.2e-03,1.0e-03\n" + lines
    opened = ftlm.open_file(write(tmp_path, text), step=1e-3, inputs={"u": "CH1"}, outputs={"y": "CH2"})
    assert [c.unit for c in opened.columns] == ["Sequence", "Volt", "Volt", "-1.2e-03", "1.0e-03"]
    np.testing.assert_array_equal(opened.load()["y"], np.arange(9))
    # Words that are not units stay a damaged row.
    messages(
        ["line 2", "'open'"], lambda: ftlm.load(write(tmp_path, text.replace("Volt", "open")), outputs=["CH1"], step=1)
    )


def test_a_layout_that_is_said_is_not_looked_for(tmp_path):
    # Names that are numbers, and a first row that could be names.
    odd = write(tmp_path, "1;2;3\n0;0,5;x\n1;0,6;1\n2;0,7;2\n3;0,8;4\n")
    run = ftlm.load(odd, step=1, outputs={"y": "2"}, layout=dict(header=1))
    np.testing.assert_array_equal(run["y"], [0.5, 0.6, 0.7, 0.8])
    run = ftlm.load(odd, step=1, outputs={"y": "c3"}, layout=dict(skip=2, header=0, separator=";", decimal=","))
    np.testing.assert_array_equal(run["y"], [1, 2, 4])
    toml = write(tmp_path, 'step = 1\n[outputs]\ny = "c3"\n[layout]\nskip = 2\nheader = 0\n', "x.toml")
    assert ftlm.load(odd, columns=toml).length == 3
    assert ftlm.load(odd, columns=toml, layout=ftlm.Layout(skip=1), outputs={"y": "c2"}).length == 4
    messages(["no table below the first 99 lines"], lambda: ftlm.load(odd, layout=dict(skip=99), **SIGNALS))
    messages(
        ["header is 2, but the number of lines above the rows is 1"],
        lambda: ftlm.load(odd, layout=dict(skip=4, header=2), **SIGNALS),
    )


BAD_LAYOUTS = {
    "unknown key": ({"decmal": ","}, ["'decmal'", "did you mean 'decimal'"]),
    "separator": ({"separator": "|"}, ["separator is '|'", "'semicolon'"]),
    "decimal": ({"decimal": 3}, ["decimal is 3"]),
    "both commas": ({"separator": ",", "decimal": "comma"}, ["both a comma"]),
    "skip": ({"skip": -1}, ["skip is -1"]),
    "skip text": ({"skip": "3"}, ["skip is '3'"]),
    "header": ({"header": 3}, ["header is 3", "names and units"]),
    "dates": ({"dates": "dym"}, ["'dym'", "'dmy'"]),
    "encoding": ({"encoding": "utf-9"}, ["'utf-9'"]),
    "no encoding of text": ({"encoding": "base64"}, ["'base64'"]),
    "sheet": ({"sheet": "a"}, ["layout=: sheet is not used with text"]),
    "sheet number": ({"sheet": 1}, ["sheet is an int"]),
    "wrong encoding": ({"encoding": "ascii"}, ["line 1 is not ASCII", "0xc3"]),
}


@pytest.mark.parametrize("case", BAD_LAYOUTS)
def test_bad_layouts_are_refused(tmp_path, case):
    layout, words = BAD_LAYOUTS[case]
    messages(words, lambda: read(tmp_path, "t,u,y,größe\n" + rows().replace("\n", ",1\n"), layout=layout))
    with pytest.raises(ftlm.DataError, match="layout= is a str"):
        read(tmp_path, "", layout="comma")


# --- what could be two things -----------------------------------------------------------------------------------------

OPEN = {
    "commas between numbers alone": ("0,5\n1,6\n2,7\n", ["line 1", "'0,5'", "separator='comma'", "decimal='comma'"]),
    "pairs of commas": ("1,5, 2,5\n1,6, 2,6\n1,7, 2,7\n", ["line 1", "'1,5, 2,5'", "cell separators or decimal marks"]),
    "thousands": ("t;u;y\n1;1,234;5\n2;2,345;6\n3;12,345;7\n", ["line 2", "'1,234'", "thousands", "decimal='comma'"]),
    "mixed separators": ("t;u,y\n0;1,2\n1;1,3\n2;0,4\n", ["line 1", "commas and semicolons", "separator='semicolon'"]),
    "mixed lines": ("t;u;y\n0;1;2\n1;1;3\n2,1,4\n3;1;2\n", ["line 4 has 1 cells", "that line has commas"]),
    "two times": ("time;Time (s);u;y\n0;0;1;2\n1;1;1;3\n2;2;1;4\n", ["'time', 'Time (s)'", "time="]),
    "two other times": ("Zeit;Timestamp;u;y\n0;0;1;2\n1;1;1;3\n2;2;1;4\n", ["'Zeit', 'Timestamp'", "time="]),
    "two dates": ("a;b;u;y\n" + "2024-01-01;2024-01-02;1;2\n" * 3, ["'a', 'b'", "time="]),
    "day or month": (
        "t;u;y\n01/02/2024 00:00;1;2\n02/02/2024 00:00;1;3\n03/02/2024 00:00;1;4\n",
        ["column 't' (time)", "'01/02/2024 00:00' may begin with the day or with the month", "dates='dmy'"],
    ),
    "no such date": (
        "t;u;y\n30.02.2024;1;2\n01.03.2024;1;3\n02.03.2024;1;3\n",
        ["'t' (time)", "row 0", "invalid date"],
    ),
    "dates among numbers": (
        "t;u;y\n0;1;2\n1;1;3\n2024-01-01;1;4\n3;1;2\n",
        ["column 't', line 4", "'2024-01-01' stands among numbers", "row 2, 1 in all"],
    ),
    "numbers among dates": (
        "t;u;y\n2024-01-01;1;2\n2024-01-02;1;3\n5;1;3\n2024-01-03;1;4\n",
        ["column 't', line 4", "'5' stands among dates", "row 2, 1 in all"],
    ),
    "dates in two ways": (
        "t;u;y\n2024-01-01;1;2\n2024/01/02;1;3\n2024-01-03;1;4\n",
        ["column 't'", "'2024-01-01'"],
    ),
    "dates in a signal": ("t;u;y\n0;1;2024-01-01\n1;1;2024-01-02\n2;2;2024-01-03\n", ["'y'", "dates", "time="]),
    "a clock that passes midnight": (
        "t;u;y\n23:59:58;1;2\n23:59:59;1;3\n00:00:00;1;4\n00:00:01;1;4\n",
        ["'t' (time)", "decreasing"],
    ),
    "rows above a table of another width": (
        "0;1;2\n1;2\n2;3\n3;4\n4;5\n",
        ["line 1 has 3 numbers, 1 such lines in all", "table of 2 cells", "skip=LINES"],
    ),
    "rows of decimal commas above a table": (
        "0,5;1,5;2\n1,5;2\n2,5;3\n3,5;4\n4,5;5\n",
        ["line 1 has 3 numbers, 1 such lines in all"],
    ),
    "a short first row": ("t;u;y\n0\n1;2;3\n2;3;3\n3;4;4\n", ["line 2 has 1 cells where the line of names has 3"]),
    "words among the first numbers": ("0.0;abc;3\n1;2;3\n2;2;3\n", ["line 1", "'abc'", "neither a header nor a row"]),
    "numbers among names": ("t;5;u;y\n0;1;2;3\n1;1;2;3\n2;1;2;3\n", ["'5'"]),
    "gzip within gzip": (gzip.compress(gzip.compress(rows().encode())), ["x.csv"]),
}


@pytest.mark.parametrize("case", OPEN)
def test_what_could_be_two_things_is_refused_in_words(tmp_path, case):
    content, words = OPEN[case]
    if case == "numbers among names":
        # A number among names is a name of its own, where no row begins so.
        messages(["mixes words and numbers"], lambda: read(tmp_path, content))
        return
    messages(words, lambda: read(tmp_path, content))


def test_what_was_open_is_read_as_it_is_said(tmp_path):
    both = write(tmp_path, OPEN["commas between numbers alone"][0])
    assert ftlm.load(both, outputs={"y": "c2"}, time="c1", layout=dict(separator="comma"))["y"][0] == 5.0
    assert ftlm.load(both, outputs={"y": "c1"}, step=1, layout=dict(decimal="comma"))["y"][0] == 0.5
    grouped = OPEN["thousands"][0]
    assert read(tmp_path, grouped, layout=dict(decimal="comma"))["u"][0] == 1.234
    dates = OPEN["day or month"][0]
    assert read(tmp_path, dates, layout=dict(dates="dmy")).step == 86400.0
    messages(["'t' (time)", "jitter"], lambda: read(tmp_path, dates, layout=dict(dates="mdy")))
    for shown in (
        "2024-03-31T01:59:59+01:00,2024-03-31T03:00:00+02:00,2024-03-31T03:00:01+02:00",
        "12/31/23 11:59:59 PM,1/1/24 12:00:00 AM,1/1/24 12:00:01 AM",
        "31.12.23 23:59:59,1.1.24 0:00,1.1.24 0:00:01",
        "2023-12-31 23:59:59.000000000,2024-01-01,2024/01/01 00:00:01".replace("/", "-"),
    ):
        lines = [f"{stamp};{k};{k * k}\n" for k, stamp in enumerate(shown.split(","))]
        run = read(tmp_path, "stamp;u;y\n" + "".join(lines))
        assert (run.step, run.start) == (1.0, 0.0)
        assert any("the time is column 'stamp'" in w for w in run.warnings)


def test_columns_are_found_without_their_units(tmp_path):
    path = write(tmp_path, "time [ms],u (V),y [°],y (mm)\n" + "".join(f"{k},{k % 3},{k},5\n" for k in range(9)))
    run = ftlm.load(path, inputs=["u"], outputs={"y": "y [°]"})
    assert (run.step, run.units) == (0.001, {"u": "V", "y": "rad"})
    messages(["'y' (signal 'y')", "'y [°]', 'y (mm)'"], lambda: ftlm.load(path, outputs=["y"]))
    opened = ftlm.open_file(path, inputs=["u"], outputs={"y": "y [°]"})
    assert opened.options["units"] == {"u": "V", "y": "°"}
    assert opened.load()["y"][3] == pytest.approx(np.pi / 60)


# --- packed, huge, hostile --------------------------------------------------------------------------------------------


def test_packed_text_is_limited_and_damage_is_said(tmp_path, monkeypatch):
    whole = gzip.compress(("t,u,y\n" + rows(400)).encode(), mtime=0)
    assert read(tmp_path, whole, "x.csv.gz").length == 400
    assert read(tmp_path, whole, "x.csv").name == "x"
    assert read(tmp_path, whole, "x.csv.gz").name == "x"
    for bad in (whole[:-9], whole[: len(whole) // 2], whole[:5], b"", whole[:60] + b"\xff" + whole[61:]):
        messages(["x.csv.gz"], lambda bad=bad: read(tmp_path, bad, "x.csv.gz"))
    monkeypatch.setattr(text, "_MAX_UNPACKED_BYTES", 1000)
    monkeypatch.setattr(text, "_BLOCK_BYTES", 500)
    messages(["unpacked", "more than 1000 bytes"], lambda: read(tmp_path, whole, "x.csv.gz"))
    for name, kind in (("x.mat.gz", ".mat"), ("x.xlsx.gz", "sheet")):
        messages([kind, "unpack it"], lambda name=name: read(tmp_path, whole, name))


def test_thousands_of_columns_are_read_and_shown_in_part(tmp_path):
    width = 10_000
    names = ",".join(["t", *(f"n{k}" for k in range(width - 1))])
    path = write(tmp_path, names + "\n" + "".join(f"{j}" + f",{j}" * (width - 1) + "\n" for j in range(3)))
    opened = ftlm.open_file(path)
    assert len(opened.columns) == width
    assert "… and 9960 more" in str(opened)
    assert len(str(opened)) < 6000


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_a_million_columns_are_refused_before_they_are_parsed(tmp_path, separator, monkeypatch):
    monkeypatch.setattr(dialect, "_choose_separator", lambda *_: pytest.fail("parsed"))
    line = separator.join(["1.5"] * 1_000_000)
    path = write(tmp_path, f"{line}\n{line}\n")
    messages(["line 1 has 1000000 cells, more than 100000", "transpose"], lambda: ftlm.open_file(path))


SCRIPTS = [
    "<script>alert(1)</script>",
    "$(reboot)",
    "`reboot`",
    "\x1b[2J\x1b]0;x\x07",
    "=cmd|' /C calc'!A0",
    "'; rm -rf ~ #",
    "__import__('os')",
    "{{7*7}}",
    "../../etc/passwd",
    "\u202egnp",
]


@pytest.mark.parametrize("name", SCRIPTS)
def test_names_with_scripts_are_names(tmp_path, name):
    path = write(
        tmp_path, f"t\tu\t{name}\ty\n".encode() + rows(separator="\t").replace("\n", "\t1\n").encode(), "a b;c.txt"
    )
    shown = str(ftlm.open_file(path))
    assert "\x1b" not in shown
    assert "\u202e" not in shown
    command = ftlm.open_file(path, inputs=["u"], outputs={"y": name}).command()
    assert shlex.split(command)[:3] == ["ftlm", "identify", str(path)]
    assert f"y={name}" in shlex.split(command)


# --- sheets -----------------------------------------------------------------------------------------------------------


def sheet(folder, table, name="x.xlsx", merged=(), **more):
    """A workbook of one sheet, or of several; of the first, ranges of cells may be merged."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.title = "first"
    for title, lines in {"first": table, **more}.items():
        page = book[title] if title in book.sheetnames else book.create_sheet(title)
        for line in lines:
            page.append(line)
    for cells in merged:
        book["first"].merge_cells(cells)
    book.save(folder / name)
    return folder / name


HEAD = ["t", "u", "y"]
BODY = [[0.1 * k, k % 3, 0.5 * k] for k in range(9)]
BAD_SHEETS = {
    "empty": ([], ["its sheet is empty"]),
    "names alone": ([HEAD], ["header and no rows"]),
    "an empty cell": ([HEAD, *BODY[:4], [0.4, None, 1], *BODY[5:]], ["'u', line 6", "empty cell", "row 4, 1 in all"]),
    "a formula that nobody computed": ([HEAD, *BODY[:4], [0.4, "=A1+1", 1], *BODY[5:]], ["'u', line 6", "empty cell"]),
    "text for a number": ([HEAD, *BODY[:4], [0.4, "0,5", 1], *BODY[5:]], ["'u', line 6", "'0,5' has a decimal comma"]),
    "an error": ([HEAD, *BODY[:4], [0.4, "#DIV/0!", 1], *BODY[5:]], ["'u', line 6", "cell, or one with an error"]),
    "dates among numbers": (
        [HEAD, *BODY[:4], [np.datetime64("2024-01-01T00:00").item(), 1, 1], *BODY[5:]],
        ["'t', line 6", "'2024-01-01' stands among numbers"],
    ),
    "a script": ([["t", "u", "<script>"], *BODY], ["'y'", "'<script>'"]),
}


@pytest.mark.parametrize("case", BAD_SHEETS)
@pytest.mark.usefixtures("reader_in_process")
def test_bad_sheets_are_refused_in_words(tmp_path, case):
    lines, words = BAD_SHEETS[case]
    path = sheet(tmp_path, lines)
    messages(["x.xlsx", *words], lambda: ftlm.load(path, **SIGNALS))


def test_what_merged_cells_cover_is_empty(tmp_path):
    path = sheet(tmp_path, [["a title", None, None], HEAD, *BODY], merged=["A1:C1", "B4:B6"])
    messages(["'u', line 5", "empty cell", "row 2, 2 in all"], lambda: ftlm.load(path, **SIGNALS))
    held = ftlm.load(path, **SIGNALS, missing="hold")
    np.testing.assert_array_equal(held["u"][:5], [0, 1, 1, 1, 1])
    assert "input u: 2 of 9 rows" in " ".join(held.warnings)


def test_sheets_of_a_workbook_and_what_is_not_used_with_them(tmp_path):
    path = sheet(tmp_path, [HEAD, *BODY], second=[["Zeit", "u", "y"], ["ms", "V", "-"], *BODY])
    messages(["2 sheets that are not empty: 'first', 'second'", "sheet=NAME"], lambda: ftlm.load(path, **SIGNALS))
    assert ftlm.load(path, **SIGNALS, layout=dict(sheet="first")).step == 0.1
    assert ftlm.load(path, **SIGNALS, layout=dict(sheet="second")).step == 1e-4
    messages(["no sheet 'third'", "'first'"], lambda: ftlm.load(path, **SIGNALS, layout=dict(sheet="third")))
    messages(["decimal is not used with sheet"], lambda: ftlm.load(path, **SIGNALS, layout=dict(decimal="comma")))
    dated = [[np.datetime64("2024-01-01T00:00").item() + k * np.timedelta64(500, "ms").item(), k, k] for k in range(9)]
    assert ftlm.load(sheet(tmp_path, [["when", "u", "y"], *dated]), **SIGNALS).step == 0.5


def test_a_workbook_that_is_none_or_too_large_is_refused(tmp_path):
    whole = sheet(tmp_path, [HEAD, *BODY]).read_bytes()
    for bad in (b"", b"PK\x03\x04", whole[:-30], whole[: len(whole) // 2], b"t,u,y\n" + rows().encode()):
        messages(["x.xlsx", "damaged"], lambda bad=bad: read(tmp_path, bad, "x.xlsx"))
    good, refused = reader.read_sheet(str(write(tmp_path, whole, "whole.xlsx")), None), 0
    for at in range(50, len(whole), 17):
        # A flipped bit is refused, or is none of the sheet's.
        path = write(tmp_path, whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :], "flipped.xlsx")
        out = io.BytesIO()
        reader.write_result("sheet", str(path), out, 1 << 20, None)
        refused += b'"error"' in out.getvalue()
        assert b'"error"' in out.getvalue() or out.getvalue().endswith(good[1])
    assert refused > 200
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as book, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as bomb:
        for entry in book.infolist():
            content = book.read(entry)
            if entry.filename.endswith("sheet1.xml"):
                # A cell at the far corner makes a table of 17 billion cells.
                content = content.replace(b'r="A3"', b'r="XFD1048576"')
            bomb.writestr(entry.filename, content)
    messages(["x.xlsx"], lambda: read(tmp_path, out.getvalue(), "x.xlsx"))
    # The list at its end says what each part has unpacked.
    large, at = bytearray(whole), whole.rindex(b"PK\x01\x02")
    large[at + 24 : at + 28] = struct.pack("<I", 3 << 30)
    (tmp_path / "x.xlsx").write_bytes(large)
    messages(["unpacked, it has", "more than"], lambda: ftlm.load(tmp_path / "x.xlsx", **SIGNALS))


# --- arrays -----------------------------------------------------------------------------------------------------------


def test_bytes_behind_an_array_of_numpy_are_refused(tmp_path):
    """A header that says fewer rows than there are, or another type, gives other numbers without a word."""
    stored = io.BytesIO()
    np.save(stored, np.arange(40.0))
    shorter = stored.getvalue().replace(b"(40,)", b"(39,)")
    assert len(shorter) == len(stored.getvalue())
    (tmp_path / "x.npy").write_bytes(shorter)
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("y.npy", shorter)
    words = ["has more than the 312 bytes that its header declares", "damaged", "save it again"]
    messages(["'the array'", *words], lambda: ftlm.load(tmp_path / "x.npy", outputs={"y": "c1"}, step=1.0))
    messages(["'y'", *words], lambda: ftlm.load(tmp_path / "x.npz", outputs={"y": "y"}, step=1.0))


@pytest.mark.usefixtures("reader_in_process")
def test_arrays_of_numpy(tmp_path):
    t, u, y = unknown_files.record()
    np.savez(
        tmp_path / "x.npz",
        t=t,
        V=np.column_stack([u, y]),
        z=1j * u,
        bad=np.array([{}], object),
        cube=u.reshape(2, 2, 60),
    )
    run = ftlm.load(tmp_path / "x.npz", inputs={"u": "V.1"}, outputs={"y": "V.2"})
    np.testing.assert_array_equal(run["y"], y)
    messages(
        ["'bad' (pickled objects", "'z' (complex)", "'cube' (3 dim"],
        lambda: ftlm.load(tmp_path / "x.npz", outputs=["q"]),
    )
    np.save(tmp_path / "a.npy", np.column_stack([t, u, y]))
    assert ftlm.load(tmp_path / "a.npy", time=0, inputs={"u": 1}, outputs={"y": "c3"}).length == unknown_files.ROWS
    table = np.zeros(9, [("time", "f8"), ("y", "f4"), ("word", "U3")])
    table["time"] = np.arange(9)
    np.save(tmp_path / "b.npy", table)
    assert ftlm.load(tmp_path / "b.npy", outputs=["y"]).step == 1.0
    np.save(tmp_path / "c.npy", np.array([{}], object), allow_pickle=True)
    messages(["pickled objects, which are not read"], lambda: ftlm.load(tmp_path / "c.npy", outputs=["y"], step=1))
    messages(["not used with NumPy"], lambda: ftlm.load(tmp_path / "a.npy", outputs=["c3"], layout=dict(skip=1)))
    head = (
        b"\x93NUMPY\x01\x00v\x00"
        + b"{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999,), }".ljust(117)
        + b"\n"
    )
    messages(["more than 1073741824 bytes"], lambda: read(tmp_path, head + bytes(64), "d.npy"))


@pytest.mark.usefixtures("reader_in_process")
def test_matrices_of_hdf5(tmp_path):
    h5py = pytest.importorskip("h5py")
    t, u, y = unknown_files.record()
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file["bench/time"], file["bench/V"] = t, np.column_stack([u, y])
        file["bench/time"].attrs["units"] = "s"
        file["out"] = h5py.ExternalLink("other.h5", "/secret")
        file["soft"] = h5py.SoftLink("/bench/time")
        file["word"] = "a"
        layout = h5py.VirtualLayout(shape=(9,), dtype="f8")
        layout[:] = h5py.VirtualSource("other.h5", "secret", shape=(9,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("vast", shape=(1 << 40,), dtype="i1", chunks=(1 << 20,))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["secret"] = t[:9]
    messages(["more than 1073741824 bytes"], lambda: ftlm.load(path, outputs=["q"]))
    with h5py.File(path, "a") as file:
        del file["vast"]
    run = ftlm.load(path, time="bench/time", inputs={"u": "bench/V.1"}, outputs={"y": "bench/V.2"})
    np.testing.assert_array_equal(run["y"], y)
    messages(
        ["'out' (a link)", "'soft' (a link)", "'virtual' (its numbers lie in other files)", "'word' ("],
        lambda: ftlm.load(path, outputs=["q"]),
    )


@pytest.mark.usefixtures("reader_in_process")
def test_mat_of_version_4_is_read(tmp_path):
    scipy_io = pytest.importorskip("scipy.io")
    t, u, y = unknown_files.record()
    scipy_io.savemat(tmp_path / "x.mat", {"t": t, "u": u, "y": y, "word": "a"}, format="4")
    np.testing.assert_array_equal(ftlm.load(tmp_path / "x.mat", inputs=["u"], outputs=["y"])["y"], y)
    whole = (tmp_path / "x.mat").read_bytes()
    messages(["x.mat"], lambda: read(tmp_path, whole[: len(whole) // 2], "x.mat"))


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [("x.xlsx", "python-calamine", "excel"), ("x.h5", "h5py", "hdf5"), ("x.feather", "pyarrow", "parquet")],
)
def test_a_reader_that_is_missing_is_named_with_its_line(tmp_path, monkeypatch, name, package, extra):
    find = apart.importlib.util.find_spec
    gone = package.replace("-", "_")
    monkeypatch.setattr(apart.importlib.util, "find_spec", lambda wanted: None if wanted == gone else find(wanted))
    messages([f"needs {package}", f"pip install 'ftlm[{extra}]'"], lambda: read(tmp_path, b"x", name))


@pytest.mark.parametrize(
    ("content", "wanted"),
    [
        ("u,y\n0,1\n#N/A,2\n2,3\n4,5\n", "line 3 begins with #"),
        ("u\ty\n0\t1\n\t\n2\t3\n4\t5\n", "empty cell"),
        ("y,u\nNone,0\n1,1\n2,5\n3,4\n", "'None'"),
        ("u\ty\n\t\n0\t1\n2\t3\n4\t5\n", "line 2: empty cell"),
        ("u\ty\nV\tmm\n\t\n0\t1\n2\t3\n4\t5\n", "line 3: empty cell"),
    ],
)
def test_no_row_vanishes(tmp_path, content, wanted):
    messages([wanted], lambda: read(tmp_path, content, step=0.1))


@pytest.mark.parametrize("clock", ["13:00 AM", "24:30", "1" + " " * 70])
def test_what_is_no_time_of_day(clock):
    assert not text.is_timestamp(clock)
    assert text.Timestamps.read(["11:59", "1:00 PM"]) is None


def test_years_of_two_digits_that_may_be_days_are_refused():
    days = text.Timestamps.read([f"24-05-0{k}" for k in range(1, 7)])
    messages(["dates='ymd'", "dates='dmy'"], lambda: days.seconds("x", None))
    assert days.seconds("x", "ymd")[-1] == 5 * 86400.0


def test_a_long_header_costs_no_time(tmp_path):
    rest = "".join(f"{k},{k % 3},{k}\n" for k in range(5))
    messages(["'q'"], lambda: read(tmp_path, "t,u,y(" + " " * 20000 + "x\n" + rest, outputs={"y": "q"}))


def test_files_with_the_same_dates_agree(tmp_path):
    paths = []
    for name in ("u", "y"):
        body = "".join(f"2024-05-01 10:00:0{k},{k % 3}\n" for k in range(6))
        paths.append(write(tmp_path, f"date,{name}\n{body}", f"{name}.csv"))
    assert ftlm.load(paths, **SIGNALS).step == 1.0


def test_no_escape_reaches_the_terminal(tmp_path):
    content = "t,u\x1b[31m,y\n" + "".join(f"{k},{k % 3},{k}\n" for k in range(5))
    shown = str(ftlm.open_file(write(tmp_path, content), inputs={"u": "u\x1b[31m"}, outputs={"y": "y"}))
    assert "\x1b" not in shown
    assert "next:" not in shown


def test_an_empty_row_of_a_sheet_below_its_names_is_left_out_and_said(tmp_path):
    run = ftlm.load(sheet(tmp_path, [HEAD, [None, None, None], *BODY]), **SIGNALS)
    assert (run.length, run.step) == (9, 0.1)
    assert any("line 2, right below the header, is empty and left out" in w for w in run.warnings)
    opened = ftlm.open_file(tmp_path / "x.xlsx", **SIGNALS)
    assert opened.load().warnings == ()


@pytest.mark.parametrize("title", ["time [ms]", "t", "time [min]"])
def test_a_cell_that_holds_a_duration_has_its_unit_in_itself(tmp_path, title):
    span = [datetime.timedelta(milliseconds=10 * k) for k in range(9)]
    lines = [[title, "u", "y"], *([t, k % 3, k] for k, t in enumerate(span))]
    run = ftlm.load(sheet(tmp_path, lines), **SIGNALS)
    assert run.step == pytest.approx(0.01)
    assert "time counted from 'PT0.000000S' on" in run.warnings
    messages(["time_unit='ms'", "has dates"], lambda: ftlm.load(tmp_path / "x.xlsx", **SIGNALS, time_unit="ms"))


def test_durations_in_words_of_iso_8601():
    found = text.Timestamps.read(["-PT0.5S", "PT0S", "PT90000.25S"])
    assert found.seconds("t", None).tolist() == [0.0, 0.5, 90000.75]
    assert text.Timestamps.read(["PT1S", "12:00"]) is None


DATED = {
    "12/02/2024,13/02/2024,14/02/2024,15/02/2024": "dmy",
    "02/12/2024,02/13/2024,02/14/2024,02/15/2024": "mdy",
    "01.02.2024,02.02.2024,03.02.2024,04.02.2024": "dmy",
    "2024-02-01,2024-02-02,2024-02-03,2024-02-04": "",
    "01.02.2024 10:00,01.02.2024 10:01,01.02.2024 10:02,01.02.2024 10:03": "",
}


@pytest.mark.parametrize("dates", DATED)
def test_the_order_of_dates_that_was_inferred_is_said_and_an_option(tmp_path, dates):
    path = write(tmp_path, "date,u,y\n" + "".join(f"{d},{k % 3},{k}\n" for k, d in enumerate(dates.split(","))))
    order, opened = DATED[dates], ftlm.open_file(path, **SIGNALS)
    assert [a.value for a in opened.assumptions if a.option == "dates"] == [order] * bool(order)
    assert opened.options.get("layout", ftlm.Layout()).dates == (order or None)
    run = ftlm.load(path, **SIGNALS)
    assert any("dates begin with" in w for w in run.warnings) is bool(order)
    said = opened.load()
    assert said.step == run.step
    assert not any("dates begin with" in w for w in said.warnings)
    assert shlex.split(opened.command("inspect"))[-2:] == (["--dates", order] if order else ["-y", "y"])


@pytest.mark.parametrize(
    ("title", "assumed"),
    [("t", True), ("time", True), ("Zeit", True), ("t_s", False), ("time [ms]", False), ("seconds", False)],
)
def test_seconds_that_nobody_stated_are_said_and_an_option(tmp_path, title, assumed):
    opened = ftlm.open_file(write(tmp_path, f"{title},u,y\n" + rows()), **SIGNALS)
    assert any(a.option == "time_unit" for a in opened.assumptions) is assumed
    assert opened.options.get("time_unit") == ("s" if assumed else None)
    assert opened.load().step == opened.step
    # The default need not be typed.
    assert "--time-unit" not in opened.command()


@pytest.mark.parametrize("first", ["12 hours", "24 hours", "another piece"])
def test_clocks_of_12_and_of_24_hours_in_one_column_are_refused(tmp_path, monkeypatch, first):
    stamps = ["9:58 AM", "9:59 AM", "10:00", "10:01"]
    stamps = stamps[::-1] if first == "24 hours" else stamps
    if first == "another piece":
        # A piece ends between the two, so that each of them is written in one way.
        monkeypatch.setattr(text, "_BLOCK_BYTES", 21)
        monkeypatch.setattr(text, "_SAMPLE_CHARACTERS", 1)
    content = "time,u,y\n" + "".join(f"{stamp},{k},{k}\n" for k, stamp in enumerate(stamps))
    words = ["have several notations"] if first == "another piece" else [stamps[2], stamps[0], "written in two ways"]
    messages(["'time'", *words], lambda: read(tmp_path, content))


def test_a_column_of_marks_for_missing_numbers_is_named(tmp_path):
    path = write(tmp_path, "t,u,y\n" + "".join(f"{k},N/A,{k}\n" for k in range(5)))
    opened = ftlm.open_file(path)
    assert (opened.columns[1].role, opened.columns[1].description) == ("input", "empty")
    assert "column 'u', line 2: 'N/A' stands for no number" in opened.problem
    words = write(tmp_path, "t,u,y\n" + "".join(f"{k},off,{k}\n" for k in range(5)))
    assert "no column of numbers is 'u' (line 2: 'off' is not a number)" in ftlm.open_file(words).problem


@pytest.mark.parametrize("words", [("True", "False"), ("true", "false"), ("TRUE", "FALSE")])
def test_boolean_cells_are_numbers(tmp_path, words):
    cells = "".join(f"{k},{words[k % 2]},{k}\n" for k in range(5))
    run = ftlm.load(write(tmp_path, "t,u,y\n" + cells), **SIGNALS)
    assert run["u"].tolist() == [1.0, 0.0, 1.0, 0.0, 1.0]


# --- how numbers are written ------------------------------------------------------------------------------------------


def german(value):
    return f"{value:,.3f}".translate(str.maketrans(",.", ".,"))


#: How a number is written, between which cells, and the mark between its thousands.
GROUPED = {
    "german": (german, ";", "point"),
    "american": (lambda v: f"{v:,.3f}", ";", "comma"),
    "american, quoted": (lambda v: f'"{v:,.3f}"', ",", "comma"),
    "american, tabs": (lambda v: f"{v:,.2f}", "\t", "comma"),
    "french": (lambda v: f"{v:,.3f}".replace(",", "\u202f").replace(".", ","), ";", "space"),
    "typewriter": (lambda v: f"{v:,.3f}".replace(",", " "), ";", "space"),
    "swiss": (lambda v: f"{v:,.3f}".replace(",", "'"), ";", "apostrophe"),
    "swiss, typeset": (lambda v: f"{v:,.2f}".replace(",", "’"), "\t", "apostrophe"),
}
VALUES = [0.5, -1.25, 12345.5, 999.0, 1000.0, -1234567.5, 1234.5]


@pytest.mark.parametrize("case", GROUPED)
def test_marks_between_thousands_are_read_where_nothing_else_can_be_meant(tmp_path, case):
    written, between, mark = GROUPED[case]
    lines = [between.join((str(k), written(v), str(k * k))) for k, v in enumerate(VALUES)]
    path = write(tmp_path, "\n".join([between.join(("t", "u", "y")), *lines, ""]))
    run = ftlm.load(path, **SIGNALS)
    np.testing.assert_array_equal(run["u"], VALUES)
    (said,) = [w for w in run.warnings if "thousands" in w]
    assert said.endswith(
        "group thousands, as in " + repr(written(VALUES[2]).strip('"')) + "; otherwise layout=dict(thousands='none')"
    )
    opened = ftlm.open_file(path, **SIGNALS)
    assert opened.layout.thousands == opened.options["layout"].thousands == mark
    assert f"--thousands {mark}" in opened.command()
    assert not any("thousands" in w for w in opened.load().warnings)
    np.testing.assert_array_equal(opened.load()["u"], VALUES)
    # Who says that there are none has none.
    messages(["'u'", "line 4"], lambda: ftlm.load(path, **SIGNALS, layout=dict(thousands="none")))


def test_marks_between_thousands_that_may_be_decimals_are_refused_or_said(tmp_path):
    header = "t;u;y\n"
    # A point alone, among decimal commas: thousands of one program, decimals of another.
    mixed = write(tmp_path, header + "0;0,5;1\n1;1.250;2\n2;0,5;3\n")
    words = ["line 3", "'1.250' has a point where decimals follow a comma", "thousands='point'"]
    messages(words, lambda: ftlm.load(mixed, **SIGNALS))
    said = ftlm.load(mixed, **SIGNALS, layout=dict(thousands="point"))
    np.testing.assert_array_equal(said["u"], [0.5, 1250.0, 0.5])
    # What the first lines do not show is refused where it comes, with what says it.
    late = header + "".join(f"{k};0,5;{k}\n" for k in range(9000)) + "9000;1.234,5;1\n"
    path = write(tmp_path, late)
    messages(["line 9002", "'1.234,5'", "thousands='point'"], lambda: ftlm.load(path, **SIGNALS))
    assert ftlm.load(path, **SIGNALS, layout=dict(thousands="point"))["u"][9000] == 1234.5
    # Groups of other than three digits are none; nor are they decimals.
    for cell in ("12.34,5", "1.2345,6", "0.123,4", ".123,4", "1..234,5", "1.234,5.6"):
        wrong = write(tmp_path, header + f"0;1.234,5;1\n1;{cell};2\n2;0,5;3\n")
        messages(["line 3", repr(cell)], lambda wrong=wrong: ftlm.load(wrong, **SIGNALS))
    for layout in (dict(thousands="comma", decimal="comma"), dict(thousands="point", decimal="point")):
        messages(["thousands and decimal are both"], lambda layout=layout: ftlm.load(mixed, **SIGNALS, layout=layout))
    messages(
        ["separator and thousands are both"],
        lambda: ftlm.load(mixed, **SIGNALS, layout=dict(thousands="space", separator="space")),
    )
    messages(["thousands is 3"], lambda: ftlm.load(mixed, **SIGNALS, layout=dict(thousands=3)))


@pytest.mark.parametrize("between", [",", ";", "\t", "  "])
def test_exponents_of_fortran_are_exponents(tmp_path, between):
    cells = ["1.5D-03", "-0.25D+02", "3D+00", "4.d1", ".5D0", "1.25E-3"]
    lines = [between.join((f"0.{k}D+00", cell, str(k))) for k, cell in enumerate(cells)]
    run = read(tmp_path, "\n".join([between.join("tuy"), *lines, ""]))
    np.testing.assert_array_equal(run["u"], [1.5e-3, -25.0, 3.0, 40.0, 0.5, 1.25e-3])
    comma = read(tmp_path, "t;u;y\n0;1,5D-03;1\n1;2,5D-03;1\n2;3,5E-03;1\n")
    np.testing.assert_array_equal(comma["u"], [1.5e-3, 2.5e-3, 3.5e-3])


@pytest.mark.parametrize("cell", ["1D3", "12D", "D5", "1.5D", "1.5D+", "1.5DD3", "0x1D3", "1.5D-3456", "１.5D-03"])
def test_what_only_looks_like_an_exponent_is_none(tmp_path, cell):
    messages(["column 'u', line 3", "is not a number"], lambda: read(tmp_path, f"t,u,y\n0,1,2\n1,{cell},3\n2,1,2\n"))


@pytest.mark.parametrize("mark", ["N/A", "n/a", "NA", "#N/A", "null", "None", "-", "--", " - "])
def test_marks_for_no_number_are_gaps(tmp_path, mark):
    def lines(cells):
        return "t;u;y\n" + "".join(f"{k};{k % 3};{cell}\n" for k, cell in enumerate(cells))

    path = write(tmp_path, lines(["1", "2", mark, "4", mark, "6", "7"]))
    shown = repr(mark.strip())
    words = ["column 'y', line 4", f"{shown} stands for no number", "row 2, 2 in all", "missing='weight'"]
    messages(words, lambda: ftlm.load(path, **SIGNALS))
    run = ftlm.load(path, **SIGNALS, missing="weight")
    assert np.isnan(run["y"]).tolist() == [False, False, True, False, True, False, False]
    opened = ftlm.open_file(path)
    assert [c.role for c in opened.columns] == ["time", "input", "output"]
    assert f"{shown} stands for no number" in opened.problem
    assert ftlm.open_file(path, missing="weight").load().length == 7
    # Beside words that are none of these it is a word.
    other = write(tmp_path, lines(["1", mark, "broken", "4"]))
    messages(["'y', line 4", "'broken' is not a number"], lambda: ftlm.load(other, **SIGNALS, missing="weight"))


def test_units_behind_a_stroke_are_units(tmp_path):
    path = write(tmp_path, "t/ms,I/A,phi/rad,v/m/s,T/°C\n" + "".join(f"{k},{k % 3},{k},5,20\n" for k in range(9)))
    opened = ftlm.open_file(path, inputs={"i": "I"}, outputs={"phi": "phi", "v": "v", "T": "T"})
    assert opened.options["units"] == {"i": "A", "phi": "rad", "v": "m/s", "T": "°C"}
    assert opened.load().step == 0.001
    assert ftlm.load(path, inputs=["I"], outputs={"v": "v/m/s"})["v"][0] == 5.0
    named = write(tmp_path, "t/s,I/A,theta/deg\n" + "".join(f"{k},{k % 3},{k}\n" for k in range(9)))
    opened = ftlm.open_file(named)
    assert [(c.role, c.signal, c.unit) for c in opened.columns] == [
        ("time", "", "s"),
        ("input", "I", "A"),
        ("output", "theta", "deg"),
    ]
    assert opened.load()["theta"][3] == pytest.approx(np.pi / 60)
    # A path, a unit, an abbreviation and a mark for nothing are none of these.
    for name in ("rig/ai/V", "m/s", "N/A", "I/O", "1/s", "in/out", "/A", "A/", "U/min"):
        path = write(tmp_path, f"t,{name},y\n" + "".join(f"{k},{k % 3},{k}\n" for k in range(9)))
        assert ftlm.open_file(path, inputs={"u": name}, outputs=["y"]).options.get("units", {}) == {}, name


def test_units_behind_a_stroke_are_those_of_a_spectrum_too(tmp_path):
    rows = "".join(f"{k + 1},{k + 2},{k + 3}\n" for k in range(9))
    data = ftlm.load_frequency(write(tmp_path, "freq/Hz,Re(Z)/mOhm,-Im(Z)/mOhm\n" + rows))
    assert data.frequency[0] == pytest.approx(2 * np.pi)
    assert data.response[0] == pytest.approx(0.002 - 0.003j)


def test_a_name_of_an_array_is_no_name_with_a_unit(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for k, name in enumerate(("rig/s", "rig/A", "rig/V")):
            file[name] = np.arange(9.0) * (k + 1)
    opened = ftlm.open_file(tmp_path / "x.h5", time="rig/s", inputs={"u": "rig/A"}, outputs={"y": "rig/V"})
    assert "units" not in opened.options
    assert [c.unit for c in opened.columns] == ["", "", ""]
