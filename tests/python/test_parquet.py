"""Runs in parquet files: written and read back bit for bit, other people's files by column, damaged ones refused."""

import sys

import numpy as np
import pandas as pd
import pytest

import ftlm
from ftlm import rig

pytest.importorskip("pyarrow", reason="pyarrow is not here; pip install -r requirements-test.txt")


@pytest.fixture(scope="module")
def run():
    return rig.record(duration=0.5, seed=4)


@pytest.fixture(scope="module")
def content(run, tmp_path_factory):
    path = tmp_path_factory.mktemp("parquet") / "run.parquet"
    run.to_parquet(path)
    return path.read_bytes()


def test_a_run_comes_back_bit_for_bit(run, tmp_path):
    path = tmp_path / "run.parquet"
    run.to_parquet(path)
    loaded = ftlm.load(path)
    assert (loaded.name, loaded.step, loaded.start) == (run.name, run.step, run.start)
    assert (loaded.inputs, loaded.outputs, loaded.units) == (run.inputs, run.outputs, run.units)
    assert loaded.metadata == run.metadata
    assert all(np.array_equal(loaded[n], run[n]) for n in run.signals)
    with pytest.raises(ftlm.DataError, match="exists"):
        run.to_parquet(path)
    run.to_parquet(path, force=True)
    assert [p.name for p in tmp_path.iterdir()] == ["run.parquet"]


@pytest.mark.usefixtures("reader_in_process")
def test_a_record_is_written_as_parquet_where_its_name_says_so(tmp_path):
    path = tmp_path / "run.parquet"
    run = rig.record(duration=0.5, seed=4, out=path)
    assert np.array_equal(ftlm.load(path)["theta12"], run["theta12"])
    assert [p.name for p in tmp_path.iterdir()] == ["run.parquet"]
    with pytest.raises(ftlm.DataError, match=r"neither .csv nor .parquet"):
        rig.record(duration=0.5, out=tmp_path / "run.txt")


@pytest.mark.usefixtures("reader_in_process")
def test_columns_of_other_peoples_files_are_named(tmp_path):
    path = tmp_path / "x.parquet"
    t = np.arange(50) * 0.01
    frame = pd.DataFrame({"time": t, "u": np.arange(50), "y": np.sin(t).astype(np.float32), "note": ["a"] * 50})
    frame.to_parquet(path)
    run = ftlm.load(path, inputs=["u"], outputs=["y"])
    assert run.step == pytest.approx(0.01)
    assert np.array_equal(run["u"], np.arange(50.0))
    with pytest.raises(ftlm.DataError, match=r"not read: 'note' \(.*string"):
        ftlm.load(path, outputs=["z"])


@pytest.mark.usefixtures("reader_in_process")
def test_missing_values_are_rows_that_are_refused(tmp_path):
    path = tmp_path / "x.parquet"
    pd.DataFrame({"time": np.arange(5) * 0.1, "y": [1.0, None, 2.0, 3.0, 4.0]}).to_parquet(path)
    with pytest.raises(ftlm.DataError, match="NaN, first at row 1, 1 in all"):
        ftlm.load(path, outputs=["y"])


def test_files_that_are_none_are_refused(tmp_path, content):
    path = tmp_path / "x.parquet"
    rng = np.random.default_rng(3)
    damaged = [b"", b"PAR1", b"PAR1" * 100, content[:-4], content[: len(content) // 2], b"x" * 1000]
    for _ in range(3):
        # The footer, where everything is declared.
        bad = bytearray(content)
        for at in rng.integers(len(bad) - 3000, len(bad) - 8, size=40):
            bad[at] ^= int(rng.integers(1, 256))
        damaged.append(bytes(bad))
    for wrong in damaged:
        path.write_bytes(wrong)
        with pytest.raises(ftlm.DataError):
            ftlm.load(path, outputs=["theta11"], inputs=["I1"])


def test_a_flipped_byte_of_the_data_is_refused_or_changes_nothing(tmp_path, content, run):
    path = tmp_path / "x.parquet"
    refused = 0
    for at in range(200, len(content) - 4000, 1999):
        path.write_bytes(content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :])
        try:
            loaded = ftlm.load(path)
        except ftlm.DataError:
            refused += 1
            continue
        assert all(np.array_equal(loaded[n], run[n]) for n in run.signals)
    assert refused > 5


def test_without_pyarrow_the_words_say_what_to_install(run, tmp_path, monkeypatch):
    path = tmp_path / "x.parquet"
    path.write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ftlm.DataError, match=r"ftlm\[parquet\]"):
        run.to_parquet(tmp_path / "y.parquet")
