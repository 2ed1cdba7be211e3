"""R7: forty bad inputs in four formats are refused, or taken with a word; the page of the docs says the same."""

import sys

import numpy as np
import pytest

import ftlm
from conftest import ROOT

sys.path.insert(0, str(ROOT / "docs"))

import bad_data

#: Formats that are read in a child process take half a second a case: a few here, all of them in the slow test.
FEW = list(bad_data.CASES)[::9]
QUICK = [(case, kind) for case in bad_data.CASES for kind in ("arrays", "csv")]
QUICK += [(case, kind) for case in FEW for kind in ("mat", "parquet")]


@pytest.fixture(scope="module")
def page():
    return bad_data.lines_of(bad_data.PAGE.read_text(encoding="utf-8"))


def check(case, kind, folder, page):
    if kind == "mat":
        pytest.importorskip("scipy")
    if kind == "parquet":
        pytest.importorskip("pyarrow")
    verdict, words, run, data = bad_data.said(case, kind, folder)
    shown = bad_data.cell(words.replace(f"bad.{kind}", "the file"))
    assert page[case, kind] == (verdict, shown), "python docs/bad_data.py makes the page anew"
    if run is None:
        assert verdict == "–" or words.startswith("DataError: ")
        return
    options = bad_data.CASES[case][1]
    for part in ("inputs", "outputs"):
        for name, column in options.get(part, {"inputs": {"u": "u"}, "outputs": {"y": "y"}}[part]).items():
            assert np.array_equal(run[name], np.asarray(data[column], float))
    assert verdict in ("said", "taken")
    dated = data["t"].dtype.kind == "U"
    times = np.asarray(data["t"].astype("datetime64[s]").astype(float) if dated else data["t"], float)
    assert np.allclose(run.time, times - times[0], rtol=1e-9, atol=0.02 * run.step)


def test_there_are_forty_cases_in_four_formats(page):
    assert len(bad_data.CASES) >= 40
    assert set(page) == {(case, kind) for case in bad_data.CASES for kind in bad_data.FORMATS}


@pytest.mark.parametrize(("case", "kind"), QUICK)
@pytest.mark.usefixtures("reader_in_process")
def test_bad_data_is_refused_or_taken_with_a_word(case, kind, tmp_path, page):
    check(case, kind, tmp_path, page)


@pytest.mark.slow
def test_every_case_in_every_format(tmp_path, page):
    for case in bad_data.CASES:
        for kind in bad_data.FORMATS:
            check(case, kind, tmp_path, page)


def test_what_is_silently_taken_shows_in_no_number(page):
    """The cases without a word are those whose numbers are good numbers."""
    silent = {case for (case, _), (verdict, _) in page.items() if verdict == "taken"}
    assert silent <= {
        "time in ms, said to be s",
        "time since 1970",
        "whole numbers",
        "truth values",
        "degrees, said to be rad",
    }


@pytest.mark.parametrize("size", [1e-141, 1e-200, 1e-310, 5e-324])
def test_signals_whose_squares_vanish_are_refused_before_anything_is_computed(size):
    y = size * np.ceil(2 * np.sin(np.arange(50.0)))
    run = ftlm.Run.from_arrays(step=0.1, inputs={"u": np.ones(50)}, outputs={"y": y})
    structure = ftlm.equation("D^alpha y = a y + b u")
    for call in (
        lambda: ftlm.identify(run, structure.with_orders({"alpha": 1.5}), m=49),
        lambda: ftlm.search_orders(run, structure, m=32),
    ):
        with pytest.raises(
            ftlm.DataError, match=r"signal 'y' of run 'run': no mean is larger than .* scale the signal"
        ):
            call()
