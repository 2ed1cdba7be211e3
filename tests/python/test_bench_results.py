"""Measured figures: the page is generated from the records of the benches, and each record names its command."""

import sys

import pytest


@pytest.fixture
def results(root, monkeypatch):
    monkeypatch.syspath_prepend(str(root / "benches"))
    monkeypatch.delitem(sys.modules, "results", raising=False)
    import results

    return results


def test_the_page_is_made_from_the_records(results):
    assert results.PAGE.read_text("utf-8") == results.page(results.read())
    assert len(results.PAGE.read_text("utf-8").split()) <= 1500


def test_every_record_has_a_bench_a_commit_and_a_date(results, root):
    records = results.read()
    assert len({r["command"] for r in records}) == len(records)
    for r in records:
        assert (root / r["command"].split()[1]).exists(), r["command"]
        assert r["commit"] != "unknown"
        assert r["date"].startswith("20")
        assert r["machine"]
        assert r["figures"]
        assert all(len(figure) == 2 for figure in r["figures"])


def test_a_run_replaces_the_record_of_its_command(results, tmp_path, monkeypatch):
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(results, "PAGE", tmp_path / "RESULTS.md")
    monkeypatch.setattr(sys, "argv", ["benches/robust.py", "--write"])
    results.save(["- fit: 1 s", "", "| plant | fit | time |", "| --- | --- | --- |", "| A | 99 % | 2 s |"])
    results.save([f"{results.heading()}:", "", "- fit: 3 s"])
    (record,) = results.read()
    assert record["command"] == "python benches/robust.py"
    assert record["figures"] == [["fit", "3 s"]]
    assert {"python", "numpy"} <= record["versions"].keys()
    assert "|fit|3 s|" in (tmp_path / "RESULTS.md").read_text("utf-8")
    monkeypatch.setattr(sys, "argv", ["benches/boxes.py"])
    results.save(["| plant | fit | time |", "| --- | --- | --- |", "| A | 99 % | 2 s |"])
    assert [r["figures"] for r in results.read()] == [[["A", "fit 99 %; time 2 s"]], [["fit", "3 s"]]]
