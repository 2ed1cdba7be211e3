"""Frames and datasets in and out: dates, time zones, indices, and what a round trip keeps."""

import datetime
import sys

import numpy as np
import pandas as pd
import polars as pl
import pytest
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app

N = 40
U, Y = np.arange(N) % 7 * 1.0, np.sin(np.arange(N) / 5)
STAMPS = pd.date_range("2024-03-31 01:59:50", periods=N, freq="500ms")
ZONED = pd.date_range("2024-03-31 01:59:50", periods=N, freq="500ms", tz="Europe/Berlin")
ROLES = {"inputs": ["u"], "outputs": ["y"]}
SIGNALS = {"inputs": {"u": U}, "outputs": {"y": Y}}


def frame(index):
    return pd.DataFrame({"u": U, "y": Y}, index=index)


DATES = {
    "numpy": STAMPS.to_numpy(),
    "seconds of numpy": STAMPS[::2].to_numpy().astype("datetime64[s]"),
    "pandas": pd.Series(STAMPS),
    "zoned": pd.Series(ZONED),
    "index": ZONED,
    "polars": pl.Series(STAMPS.to_numpy()),
    "datetime": STAMPS.to_pydatetime().tolist(),
    "zoned datetime": ZONED.to_pydatetime().tolist(),
    "lapses": (STAMPS - STAMPS[0]).to_numpy(),
    "days": np.arange(N) + np.datetime64("2024-02-20", "D"),
}


@pytest.mark.parametrize("kind", DATES)
def test_dates_are_times(kind):
    time = DATES[kind]
    signals = {role: {n: v[: len(time)] for n, v in given.items()} for role, given in SIGNALS.items()}
    run = ftlm.Run.from_arrays(time=time, **signals)
    assert (run.start, run.step) == (0.0, {"days": 86400.0, "seconds of numpy": 1.0}.get(kind, 0.5))
    said = [w for w in run.warnings if "time counted from" in w]
    assert len(said) == (kind != "lapses")
    with pytest.raises(ftlm.DataError, match="time_unit='ms' is the unit of numbers"):
        ftlm.Run.from_arrays(time=time, time_unit="ms", **signals)


BAD = {
    "no date": ([*STAMPS[:5], None, *STAMPS[6:]], "time: no date, first at row 5, 1 in all"),
    "two at once": ([*STAMPS[:5], STAMPS[4], *STAMPS[6:]], "repeated time"),
    "backwards": (STAMPS[::-1], "decreasing"),
    "dates among numbers": ([*STAMPS[:5].to_pydatetime(), 3.0, *STAMPS[6:].to_pydatetime()], "not one date per row"),
    "words": (["2024-01-01"] * N, "'2024-01-01' is not a number"),
    "too far apart": (
        np.array(["-9000-01-01", "9000-01-01", *["9001-01-01"] * (N - 2)], "datetime64[s]"),
        "more than 292 years; split the record",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_dates_that_are_none_are_refused(case):
    time, words = BAD[case]
    with pytest.raises(ftlm.DataError, match=words):
        ftlm.Run.from_arrays(time=time, **SIGNALS)


def test_an_index_is_the_time_where_it_says_so():
    for index in (STAMPS, ZONED, STAMPS - STAMPS[0], pd.Index(np.arange(N) * 0.5, name="t")):
        assert ftlm.Run.from_frame(frame(index), **ROLES).step == 0.5
    run = ftlm.Run.from_frame(frame(pd.Index(np.arange(N) * 500.0, name="time [ms]")), **ROLES)
    assert run.step == 0.5
    assert "time read in ms, as the header 'time [ms]' says" in run.warnings
    for index in (STAMPS, STAMPS - STAMPS[0], pd.Index(np.arange(N) * 500.0, name="time [ms]")):
        assert ftlm.Run.from_frame(frame(index), step=0.5, **ROLES).step == 0.5
        with pytest.raises(ftlm.DataError, match=r"step=2.0, but time \(the index.* 0.5 s"):
            ftlm.Run.from_frame(frame(index), step=2.0, **ROLES)
    named = frame(pd.Index(np.arange(N) * 0.5, name="clock"))
    assert ftlm.Run.from_frame(named, time="clock", **ROLES).step == 0.5
    for index in (None, pd.Index(np.arange(N) * 0.5), named.index, pd.MultiIndex.from_arrays([U, Y])):
        with pytest.raises(ftlm.DataError, match="step= and time=: neither is given"):
            ftlm.Run.from_frame(frame(index), **ROLES)
    with pytest.raises(ftlm.DataError, match=r"time \(the index\): decreasing"):
        ftlm.Run.from_frame(frame(STAMPS[::-1]), **ROLES)
    column = pd.DataFrame({"when": ZONED, "u": U, "y": Y})
    assert ftlm.Run.from_frame(column, time="when", **ROLES).step == 0.5
    assert (
        ftlm.Run.from_frame(pl.DataFrame({"when": STAMPS.to_numpy(), "u": U, "y": Y}), time="when", **ROLES).step == 0.5
    )


@pytest.fixture
def run():
    made = ftlm.Run.from_arrays(
        time=1.25 + np.arange(N) * 0.1, units={"y": "deg", "u": "mA"}, intersample={"u": "foh"}, name="bench", **SIGNALS
    )
    return made


@pytest.mark.parametrize("kind", ["frame", "xarray"])
def test_a_run_goes_out_and_comes_back(run, kind):
    out = run.to_frame() if kind == "frame" else run.to_xarray()
    back = ftlm.Run.from_frame(out, **ROLES, units=run.units, intersample=run.intersample, name=out.attrs["name"])
    assert (back.step, back.start, back.units, back.intersample) == (run.step, run.start, run.units, run.intersample)
    assert all(back[n].tobytes() == run[n].tobytes() for n in run.signals)
    assert out.attrs["inputs"] == ["u"]
    # What is done to it is not done to the run.
    assert not any(np.shares_memory(np.asarray(out[n]), run[n]) for n in run.signals)
    assert run["y"].any()


def test_a_dataset_of_others_is_read_by_its_variables(run):
    xarray = pytest.importorskip("xarray")
    data = xarray.Dataset({"u": ("when", U), "y": ("when", Y), "gain": 3.0}, coords={"when": STAMPS})
    assert ftlm.Run.from_frame(data, **ROLES).step == 0.5
    assert ftlm.Run.from_frame(data.drop_vars("when"), step=0.5, **ROLES).length == N
    two = xarray.Dataset({"u": ("when", U), "y": ("where", Y)}, coords={"when": STAMPS, "where": np.arange(N)})
    with pytest.raises(ftlm.DataError, match="neither is given"):
        ftlm.Run.from_frame(two, **ROLES)
    with pytest.raises(ftlm.DataError, match=r"'v' .* is not in the frame.*'when'"):
        ftlm.Run.from_frame(data, inputs=["v"], outputs=["y"])


@pytest.mark.parametrize(("library", "way"), [("pandas", "to_frame"), ("xarray", "to_xarray")])
def test_what_is_missing_is_named(run, monkeypatch, library, way):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ftlm.ModelError, match=f"pip install {library}"):
        getattr(run, way)()


def test_dates_of_python_count_like_those_of_numpy():
    day = [datetime.date(2024, 2, 28), datetime.date(2024, 2, 29), datetime.date(2024, 3, 1)]
    assert ftlm.Run.from_arrays(time=day, outputs={"y": [1.0, 2.0, 4.0]}, inputs=None).step == 86400.0


@pytest.mark.usefixtures("reader_in_process")
def test_units_survive_pandas_xarray_parquet_and_csv(tmp_path):
    pandas, xarray = pytest.importorskip("pandas"), pytest.importorskip("xarray")
    t = np.arange(50) * 0.1
    run = ftlm.Run.from_arrays(
        step=0.1, inputs={"u": np.sin(t)}, outputs={"y": np.cos(t)}, units={"u": "mV", "y": "deg"}
    )
    frame, signals = run.to_frame(), {"inputs": ["u"], "outputs": ["y"]}
    frame.to_parquet(tmp_path / "pandas.parquet")
    run.to_parquet(tmp_path / "run.parquet")
    run.to_csv(tmp_path / "run.csv")
    foreign = pandas.DataFrame({"t": t, "u": run["u"] * 1e3, "y": np.degrees(run["y"])})
    foreign.rename(columns={"t": "t [s]", "u": "u [mV]", "y": "y [deg]"}).to_csv(tmp_path / "named.csv", index=False)
    rows = foreign.to_csv(index=False).split("\n", 1)
    (tmp_path / "below.csv").write_text(f"{rows[0]}\ns,mV,deg\n{rows[1]}")
    attributes = xarray.Dataset({n: ("t", foreign[n], {"units": u}) for n, u in (("u", "mV"), ("y", "deg"))}, {"t": t})
    for again in (
        ftlm.Run.from_frame(frame, **signals),
        ftlm.Run.from_frame(run.to_xarray(), **signals),
        ftlm.Run.from_frame(attributes, **signals),
        *(ftlm.load(path, **signals) for path in sorted(tmp_path.iterdir())),
    ):
        assert again.units == {"u": "V", "y": "rad"}
        np.testing.assert_allclose(again["y"], run["y"], rtol=1e-12)
    # A unit that is given takes precedence, and an empty one takes the numbers as they are.
    raw = ftlm.load(tmp_path / "named.csv", **signals, units={"y": "", "u": "V"})
    assert raw.units == {"u": "V", "y": ""}
    np.testing.assert_allclose(raw["y"], foreign["y"])
    np.testing.assert_allclose(raw["u"], foreign["u"])


@pytest.mark.parametrize("units", [{}, {"units": "s"}])
@pytest.mark.usefixtures("reader_in_process")
def test_groups_of_an_hdf5_file_have_a_time_each(tmp_path, units):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "two.h5", "w") as file:
        for rows, step in ((40, 0.1), (50, 0.05)):
            t = step * np.arange(rows)
            file[f"run{rows}/time"], file[f"run{rows}/u"], file[f"run{rows}/y"] = t, np.sin(t), np.cos(t)
            file[f"run{rows}/time"].attrs.update(units)
    for rows, step in ((40, 0.1), (50, 0.05)):
        run = ftlm.load(tmp_path / "two.h5", inputs={"u": f"run{rows}/u"}, outputs={"y": f"run{rows}/y"})
        assert (run.step, run.length) == (step, rows)
        group = ftlm.load(tmp_path / "two.h5" / f"run{rows}")
        assert (group.name, group.step, list(group.inputs), list(group.outputs)) == (f"run{rows}", step, ["u"], ["y"])
    with pytest.raises(ftlm.DataError, match=r"contains 2 runs, each in a group with its own time; .*two\.h5/run40"):
        ftlm.load(tmp_path / "two.h5")
    with pytest.raises(ftlm.DataError, match=r"the group 'run41' is not in the file.*did you mean 'run40'"):
        ftlm.load(tmp_path / "two.h5" / "run41")
    shown = CliRunner().invoke(app, ["inspect", str(tmp_path / "two.h5")])
    assert shown.exit_code == 0, shown.output
    assert "run40" in shown.output
    assert "run50" in shown.output
