"""Everything of ftlm that reads what others wrote, as functions of bytes that may only end well or in an FtlmError."""

import functools
import gzip
import os
import struct
import tempfile
from pathlib import Path

import numpy as np

import ftlm
from ftlm.io import binary_reader as reader
from ftlm.io import isolated_reader as apart
from ftlm.io.dialect import Layout
from ftlm.order_search import checkpoint as frames
from ftlm.structure.order import Order, parse_values
from ftlm.utils.checkpoint_file import RECORD_ENCODER, CheckpointFile

#: Files of the fuzzers live in memory where there is such a place.
FOLDER = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())


def _file(suffix, data):
    path = FOLDER / f"ftlm-fuzz-{os.getpid()}{suffix}"
    path.write_bytes(data)
    return path


def _used(run):
    """What a person does next with a run that was taken."""
    assert run.length >= 3
    assert all(np.isfinite(run[n]).all() for n in run.signals)
    str(run)


def csv(data):
    _used(ftlm.load(_file(".csv", data), time=0, inputs={"u": 1}, outputs={"y": 2}))


def opened(data):
    """A file whose layout nobody says."""
    found = ftlm.open_file(_file(".txt", data))
    str(found)
    if not found.problem:
        run = found.load()
        _used(run)
        assert (run.length, run.step) == (found.rows if "missing" not in found.options else run.length, found.step)


def packed(data):
    """A csv packed by gzip: damaged inside, or outside."""
    ftlm.open_file(_file(".csv.gz", data))


def _read(kind, suffix):
    """What the child does, in this process: many more inputs a second; crashes would be seen."""

    def read(data):
        path = str(_file(suffix, data))
        with open(os.devnull, "wb") as out:
            reader.write_result(kind, path, out, reader.SIZE_LIMIT, None)

    return read


def csv_header(data):
    """The header that ftlm writes, over good numbers."""
    _used(ftlm.load(_file(".csv", data + b"\nt,u,y\n0,1,2\n0.1,1,3\n0.2,0,4\n0.3,0,4\n")))


def columns(data):
    table = b"t,u,y\n0,1,2\n0.1,1,3\n0.2,0,4\n0.3,0,4\n"
    _used(ftlm.load(_file(".csv", table), columns=_file(".toml", data)))


def mat(data):
    _used(ftlm.load(_file(".mat", data), step=0.1, outputs={"y": "y"}))


def parquet(data):
    _used(ftlm.load(_file(".parquet", data), outputs={"y": "y"}))


def answer(data):
    """What the child that reads .mat and parquet files says; it may have been taken over by the file."""
    answers = apart._ReaderOutput(data)
    while answers.table(Path("x.mat"), Layout()) is not None:
        pass


def model(data):
    found = ftlm.load_model(_file(".json", data))
    str(found)
    found.frequency_response([1.0])


def equation(data):
    found = ftlm.equation(data.decode("utf-8", "replace"))
    assert ftlm.equation(str(found)).equations == found.equations


def order(data):
    str(Order.parse(data.decode("utf-8", "replace")))


def values(data):
    parse_values("alpha", data.decode("utf-8", "replace"))


def sealed(data):
    """A store whose digests are right, whatever its records say: what a forger would write.

    The input is a chain of payloads, each behind its length.
    """
    payloads, at = [], 0
    while at + 4 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        payloads.append(data[at + 4 : at + 4 + length])
        at += 4 + length
    path = _file(".ftlm", b"")
    with CheckpointFile(path, "search", "create") as file:
        file.append(payloads)
    _search_of(path)


def stored(data):
    """A store as a file."""
    _search_of(_file(".ftlm", data))


def _search_of(path):
    found = ftlm.search_status(path)
    if all(s.candidates <= 200_000 for s in found.values()):
        ftlm.resume_search(path, threads=1)


TARGETS = {
    f.__name__: f
    for f in (
        csv,
        csv_header,
        opened,
        packed,
        columns,
        mat,
        parquet,
        answer,
        model,
        equation,
        order,
        values,
        sealed,
        stored,
    )
} | {
    "read_sheet": _read("sheet", ".xlsx"),
    "read_hdf5": _read("hdf5", ".h5"),
    "read_numpy": _read("numpy", ".npz"),
    "read_feather": _read("feather", ".feather"),
}
#: What must be installed for some.
NEEDS = {
    "mat": "scipy",
    "parquet": "pyarrow",
    "read_feather": "pyarrow",
    "read_hdf5": "h5py",
    "read_sheet": "python_calamine",
}
#: Those that start a child for every input.
SLOW = ("mat", "parquet")


def unsealed(path):
    """Payloads of a store, each behind its length: what :func:`sealed` takes."""
    with CheckpointFile(path, "search") as file:
        payloads, _ = file.read()
    return b"".join(struct.pack("<I", len(payload)) + payload for payload in payloads)


@functools.cache
def seeds(target):
    """Good inputs, from which mutations start: made here, so that they are always of this version."""
    with tempfile.TemporaryDirectory() as folder:
        return _seeds(target, Path(folder))


def _binary_seeds(target, folder, u, y):
    path = folder / "a"
    if target == "read_sheet":
        from openpyxl import Workbook

        book = Workbook()
        for row in (["t", "u", "y"], *([0.1 * k, a, b] for k, (a, b) in enumerate(zip(u, y, strict=True)))):
            book.active.append(list(map(lambda v: v if isinstance(v, str) else float(v), row)))
        book.save(path)
    elif target == "read_hdf5":
        import h5py

        with h5py.File(path, "w") as file:
            file["u"], file["group/y"] = u, y
            file.create_dataset("z", data=np.outer(u, y), chunks=(8, 8), compression="gzip")
            file["y"] = h5py.SoftLink("/group/y")
    elif target == "read_numpy":
        with open(path, "wb") as stream:
            np.savez(stream, t=0.1 * np.arange(y.size), u=u, y=y, both=np.column_stack([u, y]), word=np.array("a"))
    else:
        import pandas

        stamps = pandas.date_range("2024-05-01", periods=y.size, freq="s")
        pandas.DataFrame({"stamp": stamps, "u": u, "y": y}).to_feather(path)
    return (path.read_bytes(),)


def _seeds(target, folder):
    n = 24
    u = np.where(np.arange(n) % 8 < 4, 1.0, -1.0)
    y = np.cumsum(np.random.default_rng(0).standard_normal(n))
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": u}, outputs={"y": y}, units={"y": "deg"}, name="seed")
    words = [
        "D^2.2 y = a1 D^0.9 y + a0 y + b0 u",
        "D^alpha y = -3.5 D^(alpha-0.5) y + 2 D^nu u; D^1.5 z = c y - 1e-3 z",
        "D^(2*alpha1 - mu2 + 0.1) y = - k D^beta y + u",
    ]
    if target in ("csv", "csv_header"):
        run.to_csv(folder / "a.csv")
        own = (folder / "a.csv").read_bytes()
        plain = b"t;u;y\r\n" + b"".join(b"%d,5;1,25;-2e-3\r\n" % i for i in range(9))
        bare = b"\xef\xbb\xbf# note\n" + b"".join(b"%.2f 1 %d\n" % (i / 100, i) for i in range(9))
        return (own, plain, bare) if target == "csv" else (own.split(b"\n")[0],)
    if target in ("opened", "packed"):
        plain = b"t;u;y\r\n" + b"".join(b"%d,5;1,25;-2e-3\r\n" % i for i in range(9))
        log = b"Log 3\n\nDate/Time,in,out\n-,V,mm\n" + b"".join(
            b"2024-05-01 12:00:0%d,1,%d\n" % (i, i) for i in range(9)
        )
        good = (plain, log, plain.decode().encode("utf-16"), "Zeit [ms]\tStrom (A)\tWeg\n1\t2\t3\n".encode("cp1252"))
        return good if target == "opened" else tuple(gzip.compress(g, mtime=0) for g in good)
    if target.startswith("read_"):
        return _binary_seeds(target, folder, u, y)
    if target == "columns":
        return (b'time = "t"\nstep = 0.1\n[inputs]\nu = "u"\n[outputs]\ny = 2\n[units]\ny = "deg"\n',)
    if target == "mat":
        from scipy.io import savemat

        for name, compressed in (("a", False), ("b", True)):
            savemat(folder / f"{name}.mat", {"y": y[:, None], "u": u[:, None]}, do_compression=compressed)
        return tuple((folder / f"{name}.mat").read_bytes() for name in "ab")
    if target == "parquet":
        run.to_parquet(folder / "a.parquet")
        return ((folder / "a.parquet").read_bytes(),)
    if target == "answer":
        good = b'{"arrays": [{"name": "y", "type": "double", "rows": 3, "columns": 1}], "skipped": {"a": "text"}}\n'
        wide = b'{"arrays": [{"name": "y", "type": "single", "rows": 2, "columns": 2}], "text": true}\n'
        return (good + bytes(24) + wide + bytes(32), b'{"error": "it is damaged", "way_out": "get another"}\n')
    if target == "model":
        structure = ftlm.equation(words[0])
        fixed = structure.with_coefficients({"a1": -1.0, "a0": -2.0, "b0": 1.0})
        ftlm.Model(fixed, units={"y": "rad"}, m=64, about={"runs": "a"}).save(folder / "a.json")
        found = ftlm.identify(run, ftlm.equation("D^1.5 y = a y + b u"), method="least-squares", m=16)
        found.model.save(folder / "b.json")
        return tuple((folder / f"{name}.json").read_bytes() for name in "ab")
    if target == "equation":
        return tuple(w.encode() for w in words)
    if target == "order":
        return (b"alpha1 - alpha2 + 2*mu2 - 0.5", b"0.5", b"-(a+b)/2")
    if target == "values":
        return (b"0.5:1.5:0.05", b"1", b"0.1:0.2")
    structure = ftlm.equation("D^alpha y = a D^beta y + b u")
    ftlm.search_orders(
        run, structure, ftlm.order_grid(increment=0.25), m=16, store=folder / "a.ftlm", pruning=False, threads=1
    )
    halves = unsealed(folder / "a.ftlm")
    request = frames.FRAME_DECODER.decode(halves[4 : 4 + struct.unpack_from("<I", halves)[0]])
    half = frames.PartialRounds(
        0, 0, 1, (0, 1, 4, 256, float("inf")), ((0, 1.0, (1.0, 2.0), ((),)),), (0, 0, 1, 0, 0, 0, 0), ()
    )
    payloads = [RECORD_ENCODER.encode(frame) for frame in (request, half)]
    half_done = b"".join(struct.pack("<I", len(p)) + p for p in payloads)
    law = ftlm.equation("D^alpha y = a D^beta y + b D^(alpha-beta) u")
    ftlm.search_orders(run, law, ftlm.order_grid(increment=0.25), m=16, store=folder / "b.ftlm", top=3, threads=1)
    if target == "sealed":
        return halves, half_done, unsealed(folder / "b.ftlm")
    return tuple((folder / f"{name}.ftlm").read_bytes() for name in "ab")
