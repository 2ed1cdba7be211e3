"""Models and stores that released versions wrote are read by this one."""

import contextlib
import json
import math
import shutil
import sqlite3

import msgspec
import pytest

import ftlm
from conftest import ROOT
from ftlm.utils.checkpoint_file import CheckpointFile

GOLDEN = ROOT / "tests" / "golden"

RELEASES = sorted(path.name for path in GOLDEN.iterdir() if path.is_dir() and path.name[0].isdigit())


@pytest.fixture(params=RELEASES)
def folder(request):
    return GOLDEN / request.param


@pytest.fixture
def expected(folder):
    return json.loads((folder / "expected.json").read_text(encoding="utf-8"))


def test_there_are_files_of_the_first_release():
    assert "0.1.0" in RELEASES


def test_a_model_is_read_to_the_bit(folder, expected):
    model = ftlm.load_model(folder / "model.json")
    assert model.coefficients == expected["coefficients"]
    assert dict(model.orders) == expected["orders"]
    run = ftlm.load(folder / "run.csv")
    assert run.units == {"u": "A", "y": "rad"}
    assert model.simulate(run).length == run.length


def test_a_finished_store_is_read_to_the_bit(folder, expected, tmp_path):
    shutil.copy(folder / "search.ftlm", tmp_path)
    path = tmp_path / "search.ftlm"
    assert ftlm.search_status(path)["y"].complete
    found = ftlm.resume_search(path)["y"]
    assert json.loads(json.dumps(found.to_dict()["table"])) == expected["table"]
    assert (found.candidates, found.exclusion_counts) == (expected["candidates"], expected["exclusion_counts"])
    assert path.read_bytes() == (folder / "search.ftlm").read_bytes()


def test_a_half_finished_store_goes_on(folder, expected, tmp_path):
    shutil.copy(folder / "half.ftlm", tmp_path)
    status = ftlm.search_status(tmp_path / "half.ftlm")["y"]
    assert 0 < status.done_count < status.candidates == expected["candidates"]
    assert status.version == folder.name
    found = ftlm.resume_search(tmp_path / "half.ftlm")["y"]
    # The processor that began it may have rounded otherwise in the last place.
    assert [row.index for row in found.table] == [row["index"] for row in expected["table"]]
    assert [row.score for row in found.table] == pytest.approx([row["score"] for row in expected["table"]], rel=1e-9)
    assert found.exclusion_counts == expected["exclusion_counts"]


def test_a_finished_store_under_an_order_law_is_read_to_the_bit(folder, tmp_path):
    shutil.copy(folder / "law.ftlm", tmp_path)
    path = tmp_path / "law.ftlm"
    expected = json.loads((folder / "law.json").read_text(encoding="utf-8"))
    assert ftlm.search_status(path)["stage"].complete
    found = json.loads(json.dumps(ftlm.resume_search(path)["stage"].to_dict()))
    assert found == expected
    assert path.read_bytes() == (folder / "law.ftlm").read_bytes()


def test_a_store_under_an_order_law_that_was_stopped_goes_on(folder, tmp_path):
    path = tmp_path / "law.ftlm"
    shutil.copy(folder / "law.ftlm", path)
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        file.execute("DELETE FROM search WHERE number > 2")
    status = ftlm.search_status(path)["stage"]
    assert 0 < status.done_count < status.candidates
    expected = json.loads((folder / "law.json").read_text(encoding="utf-8"))
    found = ftlm.resume_search(path)["stage"]
    # The processor that began it may have rounded otherwise in the last place.
    assert [row.index for row in found.table] == [row["index"] for row in expected["table"]]
    assert [row.score for row in found.table] == pytest.approx([r["score"] for r in expected["table"]], rel=1e-9)
    assert found.candidates == expected["candidates"]


def payloads(path):
    """Records of a store, whatever their classes are called now: the request's records, keys and tags as they stand."""
    with CheckpointFile(path, "search") as file:
        read, damage = file.read()
    assert damage is None
    return [msgspec.msgpack.decode(payload) for payload in read]


@pytest.mark.parametrize("name", ["search", "law"])
def test_a_store_is_written_as_it_was_then(folder, tmp_path, monkeypatch, name):
    """Keys, tags, order and numbers of the request; of the rest all but the last places, which are the processor's."""
    monkeypatch.setattr("ftlm.order_search.checkpoint.FLUSH_INTERVAL_S", math.inf)
    # Made anew, exponentials of another processor would end in another last place.
    run = ftlm.load(folder / "run.csv")
    path = tmp_path / "now.ftlm"
    if name == "law":
        structure = ftlm.equation("D^alpha y = a D^beta y + b D^(alpha-beta) u", initial="rest")
        lattice, options = ftlm.order_grid(increment=0.05, alpha=(1.05, 2.0)), {"m": 32}
    else:
        structure = ftlm.equation("D^alpha y = a D^beta y + c D^mu y + b u", initial="rest")
        lattice = ftlm.order_grid(increment=0.05, alpha=(1.05, 2.0), beta=(0.0, 1.0), mu=(0.0, 1.0))
        options = {"m": 32, "pruning": False}
    ftlm.search_orders(run, structure, lattice, prior_covariance=1.0, threads=1, top=5, store=path, **options)
    now, then = payloads(path), payloads(folder / f"{name}.ftlm")
    assert (now[0].pop("version"), then[0].pop("version")) == (ftlm.__version__, folder.name)
    assert now[0]["algorithm"] == then[0]["algorithm"] == 1
    # Compared as bytes: the order of keys counts.
    assert msgspec.msgpack.encode(now[0]) == msgspec.msgpack.encode(then[0])
    assert {tuple(frame) for frame in now[1:]} == {tuple(frame) for frame in then[1:]}
    assert {frame["type"] for frame in now[1:]} == {frame["type"] for frame in then[1:]}
    assert now[-1]["type"] == then[-1]["type"] == ("joined" if name == "law" else "rounds")
    if name == "law":
        assert now[-1]["counts"] == then[-1]["counts"]
    else:
        assert [f["part"][1] for f in now[1:]] == [f["part"][1] for f in then[1:]]
