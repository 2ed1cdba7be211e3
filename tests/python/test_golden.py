"""Models and stores that released versions wrote are read by this one."""

import json
import shutil

import pytest

import ftlm
from conftest import ROOT

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
    assert (found.candidates, found.pruned) == (expected["candidates"], expected["pruned"])
    assert path.read_bytes() == (folder / "search.ftlm").read_bytes()


def test_a_half_finished_store_goes_on(folder, expected, tmp_path):
    shutil.copy(folder / "half.ftlm", tmp_path)
    status = ftlm.search_status(tmp_path / "half.ftlm")["y"]
    assert 0 < status.done < status.candidates == expected["candidates"]
    assert status.version == folder.name
    found = ftlm.resume_search(tmp_path / "half.ftlm")["y"]
    # The processor that began it may have rounded otherwise in the last place.
    assert [row.index for row in found.table] == [row["index"] for row in expected["table"]]
    assert [row.score for row in found.table] == pytest.approx([row["score"] for row in expected["table"]], rel=1e-9)
    assert found.pruned == expected["pruned"]


def test_a_finished_store_under_an_order_law_is_read_to_the_bit(folder, tmp_path):
    shutil.copy(folder / "law.ftlm", tmp_path)
    path = tmp_path / "law.ftlm"
    expected = json.loads((folder / "law.json").read_text(encoding="utf-8"))
    assert ftlm.search_status(path)["stage"].complete
    assert json.loads(json.dumps(ftlm.resume_search(path)["stage"].to_dict())) == expected
    assert path.read_bytes() == (folder / "law.ftlm").read_bytes()


def test_a_store_under_an_order_law_that_was_cut_goes_on(folder, tmp_path):
    path = tmp_path / "law.ftlm"
    whole = (folder / "law.ftlm").read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 5])
    status = ftlm.search_status(path)["stage"]
    assert 0 < status.done < status.candidates
    expected = json.loads((folder / "law.json").read_text(encoding="utf-8"))
    found = ftlm.resume_search(path)["stage"]
    # The processor that began it may have rounded otherwise in the last place.
    assert [row.index for row in found.table] == [row["index"] for row in expected["table"]]
    assert [row.score for row in found.table] == pytest.approx([r["score"] for r in expected["table"]], rel=1e-9)
    assert found.candidates == expected["candidates"]
