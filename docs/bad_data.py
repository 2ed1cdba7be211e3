"""Write the table of bad data: forty inputs in every format, and the message of ftlm on each."""

import tempfile
from pathlib import Path

import numpy as np

import ftlm

ROWS = 128
STEP = 0.01
NAN, INF = float("nan"), float("inf")


def good():
    """Return columns of a good run: a square input and an oscillation."""
    t = np.arange(ROWS) * STEP
    u = np.where(np.arange(ROWS) % 32 < 20, 1.0, -1.0)
    y = np.sin(20 * t) * np.exp(-2 * t) + 0.01 * np.cos(3 * np.arange(ROWS) ** 1.5)
    return {"t": t, "u": u, "y": y}


def put(column, rows, value):
    """Return a good run with a value at some rows of a column."""

    def change(data):
        data[column][rows] = value
        return data

    return change


def replaced(column, make):
    """Return a good run in which the function `make` computes a column."""
    return lambda data: {**data, column: make(data[column])}


def cut(start, stop):
    """Return some rows of a good run."""
    return lambda data: {name: values[start:stop] for name, values in data.items()}


def without(*rows):
    """Return a good run without some rows."""
    return lambda data: {name: np.delete(values, rows) for name, values in data.items()}


def jittered(share):
    """Return sample times with a jitter of a share of the step."""
    return replaced("t", lambda t: t + share * STEP * np.sin(1.7 * np.arange(t.size) + 1))


def texts(values):
    """Return numbers as text."""
    return np.array([repr(float(v)) for v in values], object)


#: What is wrong: how to make it from a good run, and options of the reader.
CASES = {
    "NaN in the output": (put("y", 20, NAN), {}),
    "NaN in the input": (put("u", [5, 9], NAN), {}),
    "NaN in time": (put("t", 7, NAN), {}),
    "infinity in the output": (put("y", 3, INF), {}),
    "minus infinity in the input": (put("u", 127, -INF), {}),
    "infinity in time": (put("t", 127, INF), {}),
    "an output of NaN only": (put("y", slice(None), NAN), {}),
    "no rows": (cut(0, 0), {}),
    "one row": (cut(0, 1), {}),
    "two rows": (cut(0, 2), {}),
    "three rows": (cut(0, 3), {}),
    "a constant output": (put("y", slice(None), 2.5), {}),
    "a constant input": (put("u", slice(None), 1.0), {}),
    "an input of zeros": (put("u", slice(None), 0.0), {}),
    "an output that is the input": (lambda d: {**d, "y": d["u"].copy()}, {}),
    "a time twice": (put("t", 30, 29 * STEP), {}),
    "a time that steps back": (put("t", 30, 5 * STEP), {}),
    "time running backwards": (replaced("t", lambda t: t[::-1].copy()), {}),
    "time standing still": (put("t", slice(None), 1.0), {}),
    "time jittered by 1 % of the step": (jittered(0.01), {}),
    "time jittered by 30 % of the step": (jittered(0.3), {}),
    "one row missing": (without(30), {}),
    "a gap of twenty rows": (without(*range(30, 50)), {}),
    "time in ms, said to be s": (replaced("t", lambda t: 1000 * t), {}),
    "time since 1970": (replaced("t", lambda t: t + 1.7e9), {}),
    "an output longer than its time": (replaced("y", lambda y: np.append(y, [0.0, 1.0])), {}),
    "an output shorter than its time": (replaced("y", lambda y: y[:-5]), {}),
    "words in the output": (replaced("y", lambda y: np.where(np.arange(y.size) == 4, "off", texts(y))), {}),
    "an empty cell": (replaced("y", lambda y: np.where(np.arange(y.size) == 4, "", texts(y))), {}),
    "dates for times": (
        replaced("t", lambda t: np.array([f"2026-01-01 00:{i // 60:02d}:{i % 60:02d}" for i in range(t.size)])),
        {},
    ),
    "complex numbers": (replaced("y", lambda y: y + 1j), {}),
    "1e308 in the output": (put("y", 10, 1e308), {}),
    "1e200 in the input": (put("u", 10, 1e200), {}),
    "denormal numbers": (replaced("y", lambda y: y * 1e-310), {}),
    "whole numbers": (replaced("u", lambda u: u.astype(np.int64)), {}),
    "truth values": (replaced("u", lambda u: u > 0), {}),
    "degrees, said to be rad": (replaced("y", lambda y: 57.3 * y), {"units": {"y": "rad"}}),
    "a unit that is none": (lambda d: d, {"units": {"y": "furlong"}}),
    "a column that is not there": (lambda d: d, {"outputs": {"y": "z"}}),
    "one column for input and output": (lambda d: d, {"inputs": {"u": "y"}}),
    "an input named like the output": (lambda d: d, {"inputs": {"y": "u"}}),
    "a step beside the time": (lambda d: d, {"step": 0.02}),
}
FORMATS = ("arrays", "csv", "mat", "parquet")


def read(kind, data, folder, options):
    """Return a run loaded from columns that are written in a file format.

    Raises
    ------
    NotImplementedError
        The format cannot hold this.
    """
    told = {"inputs": {"u": "u"}, "outputs": {"y": "y"}, "time": "t", **options}
    path = Path(folder) / f"bad.{kind}"
    lengths = {len(values) for values in data.values()}
    if kind == "arrays":
        arrays = {part: {n: data.get(c) for n, c in told[part].items()} for part in ("inputs", "outputs")}
        rest = {k: v for k, v in told.items() if k not in ("inputs", "outputs", "time")}
        return ftlm.Run.from_arrays(time=data["t"], **arrays, **rest, name="bad")
    if kind == "csv":
        longest = max(lengths)
        cells = [[str(c) for c in values.tolist()] + [""] * (longest - len(values)) for values in data.values()]
        path.write_text("\n".join([",".join(data), *(",".join(row) for row in zip(*cells, strict=True))]) + "\n")
    elif kind == "mat":
        from scipy.io import savemat

        savemat(path, {name: values if values.dtype == object else values[:, None] for name, values in data.items()})
    else:
        import pyarrow
        from pyarrow import parquet

        if len(lengths) > 1 or any(np.iscomplexobj(values) for values in data.values()):
            raise NotImplementedError
        parquet.write_table(
            pyarrow.table({name: pyarrow.array(values.tolist()) for name, values in data.items()}), path
        )
    return ftlm.load(path, **told)


def said(name, kind, folder):
    """Return the message of ftlm: (verdict, text, run or None, columns).

    The verdict is "refused", "said", "taken" or "–".
    """
    make, options = CASES[name]
    data = make(good())
    try:
        run = read(kind, data, folder, options)
    except NotImplementedError:
        return "–", "the format cannot hold it", None, data
    except ftlm.FtlmError as error:
        text = str(error).replace(repr(str(Path(folder) / f"bad.{kind}")), f"bad.{kind}")
        return "refused", f"{type(error).__name__}: {text}", None, data
    words = list(run.warnings)
    advice = run.advice()
    words += [line for line in str(advice).splitlines()[1:] if line.strip()]
    try:
        ftlm.identify(run, ftlm.equation("D^1.8 y = a D^0.8 y + c y + b u"), method="least-squares", m=run.length - 1)
    except ftlm.FtlmError as error:
        words.append(f"identify: {type(error).__name__}: {error}")
    return (
        ("said" if words else "taken"),
        " ".join(w.strip() for w in words) or "nothing: the numbers are used as they are",
        run,
        data,
    )


def table(folder):
    """Return rows of (case, format, verdict, message)."""
    return [(name, kind, *said(name, kind, folder)[:2]) for name in CASES for kind in FORMATS]


def cell(text):
    """Return text for a cell of a table in Markdown."""
    for old, new in (
        ("\\", "\\\\"),
        ("|", "\\|"),
        ("*", "\\*"),
        ("_", "\\_"),
        ("`", "\\`"),
        ("<", "\\<"),
        ("[", "\\["),
    ):
        text = text.replace(old, new)
    return text


PAGE = Path(__file__).resolve().parent / "bad_data.md"
HEAD = """# Bad data

This table lists faults of a run in four formats, with the message of ftlm on each. `python docs/bad_data.py` writes it,
and the tests compare it with the answers of this version. *Refused* is an error that names the column, the first bad
row (counted from 0), the count and a remedy. *Said* is a run with a warning, an advice or a refusal to identify. Its
numbers are exactly those given. *Taken* is a run without a message. Its numbers are those given, and nothing in them
shows the fault. There is no other outcome: data are repaired, filled, dropped or clipped only on request.

"""


def page(rows):
    """Return the page; formats with the same message share a row."""
    lines = ["| what is wrong | in | verdict | what ftlm said |", "| --- | --- | --- | --- |"]
    for name in CASES:
        groups = {}
        for _, kind, verdict, words in (row for row in rows if row[0] == name):
            groups.setdefault((verdict, words.replace(f"bad.{kind}", "the file")), []).append(kind)
        for number, ((verdict, words), kinds) in enumerate(groups.items()):
            first = name if number == 0 else ""
            lines.append(f"| {first} | {', '.join(kinds)} | {verdict} | {cell(words)} |")
    return HEAD + "\n".join(lines) + "\n"


def lines_of(text):
    """Return the table row of each (case, format)."""
    found, case = {}, ""
    for line in text.splitlines():
        cells = [c.strip() for c in line.split(" | ")]
        if line.startswith("| ") and len(cells) == 4 and not line.startswith(("| ---", "| what")):
            case = cells[0].removeprefix("|").strip() or case
            found |= {(case, kind): (cells[2], cells[3].removesuffix(" |")) for kind in cells[1].split(", ")}
    return found


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        PAGE.write_text(page(table(made)), encoding="utf-8")
