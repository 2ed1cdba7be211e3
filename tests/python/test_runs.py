"""Tests that a Run keeps what it is given, and refuses what it cannot keep, by name, row and count."""

import copy
import json
import math
import os
import pickle

import numpy as np
import pandas as pd
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ftlm.data.run import Run
from ftlm.data.runs import check_compatible
from ftlm.errors import DataError, FtlmError
from ftlm.io.load import load

N = 50


def ramp(n=N):
    return np.linspace(-1.0, 1.0, n)


def grid(n=N, step=0.01):
    return np.arange(n) * step


def make(**changes):
    settings_ = {"step": 0.01, "inputs": {"u": ramp()}, "outputs": {"y": ramp() ** 2}}
    settings_.update(changes)
    return Run.from_arrays(**settings_)


def put(values, rows, bad):
    changed = np.array(values, dtype=float)
    changed[rows] = bad
    return changed


def pulses(n=N):
    return (np.arange(n) // 7 % 2).astype(float)


# --- what is refused --------------------------------------------------------------------------------------------------

BAD_ARRAYS = {
    "nan": ({"inputs": {"u": put(ramp(), [3, 9], np.nan)}}, ["'u'", "NaN", "row 3", "2 in all", "window="]),
    "infinity": ({"outputs": {"y": put(ramp(), [7], np.inf)}}, ["'y'", "infinity", "row 7", "1 in all"]),
    "minus infinity": ({"outputs": {"y": put(ramp(), [7, 8], -np.inf)}}, ["'y'", "-inf", "row 7", "2 in all"]),
    "1e308": ({"outputs": {"y": put(ramp(), [4, 5, 6], 1e308)}}, ["'y'", "1e+308", "row 4", "3 in all"]),
    "overflow by unit": (
        {"inputs": {"u": put(ramp(), [4], 9e149)}, "units": {"u": "kPa"}},
        ["'u'", "Pa", "row 4", "1 in all"],
    ),
    "empty": ({"inputs": {"u": []}}, ["'u'", "empty", "0 rows"]),
    "two rows": ({"inputs": {"u": [1, 2]}, "outputs": {"y": [1, 2]}}, ["2 rows", "3 are needed"]),
    "mixed lengths": ({"inputs": {"u": ramp(), "v": ramp(9)}}, ["'v'", "9 rows", "50 are expected", "1 of 3"]),
    "two dimensions": ({"inputs": {"u": ramp().reshape(-1, 1)}}, ["'u'", "(50, 1)", "x[:, 0]"]),
    "scalar": ({"inputs": {"u": 3.0}}, ["'u'", "()"]),
    "none": ({"inputs": {"u": None}}, ["'u'", "None"]),
    "one word": ({"inputs": {"u": "fast"}}, ["'u'", "fast"]),
    "ragged": ({"inputs": {"u": [[1.0], [1.0, 2.0]]}}, ["'u'", "not an array of numbers"]),
    "complex": (
        {"inputs": {"u": put(ramp(), [], 0) + 1j * (np.arange(N) >= 40)}},
        ["'u'", "row 40", "10 in all", ".real"],
    ),
    "text": ({"inputs": {"u": ["a"] * N}}, ["'u'", "'a' is not a number", "row 0", "50 in all"]),
    "a word among numbers": (
        {"inputs": {"u": [1.0] * 5 + ["x" * 99] + [None]}},
        ["'u'", "xxx…' is not a number", "row 5", "2 in all"],
    ),
    "a word in a list": ({"inputs": {"u": [1.0] * 5 + ["x"]}}, ["'u'", "'x'", "row 5", "1 in all"]),
    "numbers as text": ({"inputs": {"u": np.array(["1.0"] * N)}}, ["'u'", "'1.0'", "row 0", "50 in all"]),
    "none among numbers": ({"inputs": {"u": [1.0] * 5 + [None] + [2.0]}}, ["'u'", "None", "row 5", "1 in all"]),
    "huge integers": ({"inputs": {"u": [10**400] + [1] * 4}}, ["'u'", "object"]),
    "objects": ({"inputs": {"u": ramp().astype(object)}}, ["'u'", "object", "50 in all", "dtype=float"]),
    "dates": ({"inputs": {"u": np.arange(N).astype("datetime64[s]")}}, ["'u'", "dates", "seconds"]),
    "masked": (
        {"inputs": {"u": np.ma.masked_array(ramp(), np.arange(N) == 6)}},
        ["'u'", "masked", "row 6", "1 in all"],
    ),
    "dict": ({"inputs": {"u": {"a": 1}}}, ["'u'"]),
    "inputs not a dict": ({"inputs": [ramp()]}, ["inputs=", "dict"]),
    "no outputs": ({"outputs": {}}, ["outputs="]),
    "input and output": ({"outputs": {"u": ramp()}}, ["'u'", "both", "1 in all"]),
    "formula name": ({"outputs": {"=cmd()": ramp()}}, ["'=cmd()'", "begin with a letter"]),
    "at name": ({"outputs": {"@x": ramp()}}, ["'@x'"]),
    "digit name": ({"outputs": {"1y": ramp()}}, ["'1y'"]),
    "space name": ({"outputs": {"y 1": ramp()}}, ["'y 1'"]),
    "newline name": ({"outputs": {"y\n": ramp()}}, ["name a signal"]),
    "number name": ({"outputs": {1: ramp()}}, ["1 cannot name"]),
    "reserved name": ({"outputs": {"t_s": ramp()}}, ["'t_s'", "csv"]),
    "run name": ({"name": "=1+1"}, ["'=1+1'", "name="]),
    "run name with newline": ({"name": "a\nb"}, ["name="]),
    "empty run name": ({"name": ""}, ["name="]),
    "step zero": ({"step": 0.0}, ["step=0.0", "positive"]),
    "step negative": ({"step": -1}, ["step=-1.0"]),
    "step nan": ({"step": math.nan}, ["step=nan"]),
    "step infinite": ({"step": math.inf}, ["step=inf"]),
    "step subnormal": ({"step": 5e-324}, ["step=5e-324"]),
    "step too large an integer": ({"step": 10**400}, ["step=inf"]),
    "step text": ({"step": "0.01"}, ["step='0.01'", "not a number"]),
    "step array": ({"step": np.ones(1)}, ["not a number"]),
    "neither": ({"step": None}, ["step= and time=", "neither"]),
    "both": ({"time": grid()}, ["step= and time=", "both"]),
    "unit unknown": ({"units": {"u": "degrees"}}, ["'degrees'", "'u'", "did you mean 'deg'", "'rpm'"]),
    "unit not text": ({"units": {"u": 3}}, ["unit 3", "'u'"]),
    "unit of no signal": ({"units": {"yy": "deg"}}, ["'yy'", "not a signal", "did you mean 'y'"]),
    "units not a dict": ({"units": "deg"}, ["units=", "dict"]),
    "intersample unknown": ({"intersample": {"u": "spline"}}, ["'spline'", "'u'", "'foh'"]),
    "intersample of an output": ({"intersample": {"y": "zoh"}}, ["'y'", "not an input"]),
    "time unit without time": ({"time_unit": "ms"}, ["time_unit='ms'"]),
    "window not a pair": ({"window": (1, 2, 3)}, ["window=(1, 2, 3)", "pair"]),
    "window text": ({"window": ("0", 1)}, ["window", "'0'"]),
    "window nan": ({"window": (math.nan, 1)}, ["window", "finite"]),
    "window outside": ({"window": (0.0, 0.6)}, ["window", "0.6", "out of range", "0.5 s"]),
    "window before": ({"window": (-0.1, 0.3)}, ["window", "-0.1", "out of range"]),
    "window decreasing": ({"window": (0.3, 0.1)}, ["window", "do not increase"]),
    "window short": ({"window": (0.1, 0.12)}, ["2 rows in the window"]),
    "window nothing": ({"window": (0.101, 0.102)}, ["no row lies between"]),
    "nan in the window counts from the file": (
        {"window": (0.1, 0.3), "inputs": {"u": put(ramp(), [2, 15, 16], np.nan)}},
        ["'u'", "row 15", "2 in all"],
    ),
    "resample zero": ({"resample": 0.0}, ["resample=0.0"]),
    "resample too coarse": ({"resample": 0.4}, ["resample=0.4", "2 rows"]),
    "resample bomb": ({"resample": 1e-12}, ["resample=1e-12", "larger step"]),
}

BAD_TIMES = {
    "nan": (put(grid(), [5], np.nan), ["time", "NaN", "row 5", "1 in all"]),
    "infinite": (put(grid(), [5, 6], np.inf), ["time", "infinity", "row 5", "2 in all"]),
    "huge": (grid() * 1e300, ["time", "row 1", "49 in all"]),
    "repeated": (put(grid(), [5, 9], [grid()[4], grid()[8]]), ["time", "repeated", "row 5", "2 in all", "digits"]),
    "decreasing": (np.concatenate([grid(25), grid(25)]), ["time", "decreasing", "row 25", "1 in all", "split"]),
    "backwards": (grid()[::-1], ["time", "decreasing", "row 1", "49 in all"]),
    "constant": (np.zeros(N), ["time", "repeated", "row 1", "49 in all"]),
    "jitter": (grid() + 0.001 * np.sin(np.arange(N)), ["time", "jitter", "%", "resample=STEP"]),
    "one late row": (put(grid(), [20], 0.203), ["time", "jitter", "row 20", "1 in all"]),
    "gap": (np.concatenate([grid(20), grid(30) + 5.0]), ["time", "gap of 4.81 s", "row 20", "1 in all", "window="]),
    "dropped rows": (
        np.delete(grid(N + 2), [10, 30]),
        ["time", "gap of 0.02 s", "row 10", "2 in all", "resample=STEP"],
    ),
    "length": (grid(N - 1), ["time", "49 rows", "50 are expected"]),
    "text": (["0:00"] * N, ["time", "'0:00'", "row 0"]),
    "two dimensions": (grid().reshape(2, 25), ["time", "(2, 25)"]),
    "subnormal step": (np.arange(N) * 5e-324, ["time", "mean step"]),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_bad_arrays_are_refused_by_name_row_and_count(case):
    changes, words = BAD_ARRAYS[case]
    with pytest.raises(DataError) as caught:
        make(**changes)
    assert [word for word in words if word not in str(caught.value)] == [], str(caught.value)


@pytest.mark.parametrize("case", BAD_TIMES)
def test_bad_times_are_refused_by_row_and_count(case):
    times, words = BAD_TIMES[case]
    with pytest.raises(DataError) as caught:
        make(step=None, time=times)
    assert [word for word in words if word not in str(caught.value)] == [], str(caught.value)


def test_an_error_is_both_an_ftlm_error_and_a_value_error():
    with pytest.raises(FtlmError):
        make(step=0)
    with pytest.raises(ValueError, match="step=0"):
        make(step=0)


def test_unknown_time_unit_is_refused():
    with pytest.raises(DataError, match="time_unit='fortnight'"):
        make(step=None, time=grid(), time_unit="fortnight")


# --- what is kept -----------------------------------------------------------------------------------------------------


def test_fields_of_a_run():
    run = make(units={"u": "A", "y": "deg"}, name="square 0.3 A", step=0.01)
    assert (run.name, run.step, run.start, run.length) == ("square 0.3 A", 0.01, 0.0, N)
    assert run.inputs == ("u",)
    assert run.outputs == ("y",)
    assert run.signals == ("u", "y")
    assert run.units == {"u": "A", "y": "rad"}
    assert run.intersample == {"u": "zoh"}
    assert run.duration == 49 * 0.01
    assert run.warnings == ()
    np.testing.assert_array_equal(run.time, grid())
    np.testing.assert_array_equal(run["y"], np.deg2rad(ramp() ** 2))
    assert "u" in run
    assert "time" not in run
    assert 3 not in run


def test_a_run_never_changes():
    u = ramp()
    run = make(inputs={"u": u})
    u[:] = 7.0
    np.testing.assert_array_equal(run["u"], ramp())
    for values in (run["u"], run.time):
        assert values.flags.c_contiguous
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 1.0
        with pytest.raises(ValueError, match="WRITEABLE"):
            values.setflags(write=True)
    with pytest.raises(AttributeError, match="a Run is immutable"):
        run.step = 3.0
    with pytest.raises(AttributeError, match="a Run is immutable"):
        del run.name
    run.units["u"] = "kg"
    run.intersample["u"] = "foh"
    assert run.units["u"] == ""
    assert run.intersample["u"] == "zoh"
    with pytest.raises(TypeError, match="from_arrays"):
        Run()


def test_unknown_signal_suggests_the_nearest():
    run = make(outputs={"theta12": ramp()})
    with pytest.raises(DataError, match=r"'theta21' is not in run 'run' \(did you mean 'theta12'"):
        run["theta21"]


@pytest.mark.parametrize(
    "kind",
    [
        list,
        tuple,
        np.float32,
        np.float16,
        np.int32,
        bool,
        pd.Series,
        pl.Series,
        lambda x: np.asfortranarray(np.tile(x, (2, 1)))[0],
        lambda x: x[::-1][::-1],
        lambda x: x.astype(">f8"),
        lambda x: pd.Series(x, dtype="Float64"),
        lambda x: pd.Series(x.astype(int), dtype="Int64"),
        np.ma.masked_array,
    ],
)
def test_arrays_of_many_kinds_are_taken(kind):
    x = pulses()
    converted = x.astype(kind) if isinstance(kind, type) and issubclass(kind, (np.generic, bool)) else kind(x)
    run = make(inputs={"u": converted})
    np.testing.assert_array_equal(run["u"], x)
    assert run["u"].dtype == np.float64
    assert run["u"].dtype.isnative


@pytest.mark.parametrize(
    "column", [pd.Series([1, None, 3, 4], dtype="Int64"), pl.Series([1, None, 3, 4]), pl.Series([1.0, None, 3.0, 4.0])]
)
def test_missing_values_of_frames_are_refused_as_nan(column):
    with pytest.raises(DataError, match="'u': NaN, first at row 1, 1 in all"):
        Run.from_arrays(step=1, inputs={"u": column}, outputs={"y": ramp(4)})


def test_subnormal_values_and_minus_zero_are_kept_to_the_bit():
    values = put(ramp(), [0, 1, 2, 3], [5e-324, -5e-324, -0.0, 1e150])
    run = make(outputs={"y": values})
    assert run["y"].tobytes() == values.tobytes()


FACTORS = {
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180),
    "mrad": ("rad", 1e-3),
    "A": ("A", 1.0),
    "mA": ("A", 1e-3),
    "V": ("V", 1.0),
    "mV": ("V", 1e-3),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "s": ("s", 1.0),
    "N": ("N", 1.0),
    "N·m": ("N·m", 1.0),
    "N*m": ("N·m", 1.0),
    "Nm": ("N·m", 1.0),
    "N.m": ("N·m", 1.0),
    "degC": ("degC", 1.0),
    "°C": ("degC", 1.0),
    "C": ("degC", 1.0),
    "K": ("K", 1.0),
    "rad/s": ("rad/s", 1.0),
    "deg/s": ("rad/s", math.pi / 180),
    "rpm": ("rad/s", math.pi / 30),
    "m/s": ("m/s", 1.0),
    "m/s^2": ("m/s^2", 1.0),
    "g": ("m/s^2", 9.80665),
    "Pa": ("Pa", 1.0),
    "kPa": ("Pa", 1e3),
    "W": ("W", 1.0),
    "Hz": ("Hz", 1.0),
    "1": ("1", 1.0),
    "": ("", 1.0),
}


@pytest.mark.parametrize("unit", FACTORS)
def test_units_are_converted_to_si(unit):
    si, factor = FACTORS[unit]
    run = make(units={"y": unit})
    assert run.units["y"] == si
    np.testing.assert_allclose(run["y"], ramp() ** 2 * factor, rtol=4e-16)


def test_constant_output_is_taken_with_a_warning_and_refused_by_require_outputs():
    run = make(outputs={"y": ramp(), "dead": np.full(N, 0.5)})
    assert run.warnings == ("output 'dead' is constant (0.5 in all 50 rows): nothing can be identified from it",)
    run.require_outputs(["y"])
    with pytest.raises(DataError, match=r"'dead' of run 'run': constant, every row is 0.5, first at row 0, 50 in all;"):
        run.require_outputs(["y", "dead"])
    with pytest.raises(DataError, match="'u' is not in run"):
        run.require_outputs(["u"])


def test_a_slice_can_be_constant_although_the_run_is_not():
    run = make(outputs={"y": np.r_[np.zeros(25), np.ones(25)]})
    assert run.warnings == ()
    assert len(run.window(0, 0.2).warnings) == 1


# --- time -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [3, 4, 100, 10_000])
@pytest.mark.parametrize("start", [0.0, 82.174, -3.5, 1e6])
@pytest.mark.parametrize(("step", "decimals"), [(0.002, 3), (0.1, 1), (1.0, 0), (0.0125, 4), (0.003, 6)])
def test_printed_times_give_exactly_the_step_that_was_printed(n, start, step, decimals):
    times = np.array([float(f"{start + j * step:.{max(decimals, 3)}f}") for j in range(n)])
    if decimals == 4:
        times = np.round(start + np.arange(n) * step, 4)
    run = Run.from_arrays(time=times, inputs={}, outputs={"y": ramp(n)})
    assert run.step == step
    assert run.start == times[0]
    assert run.warnings == ()


@pytest.mark.parametrize(
    ("times", "step"),
    [
        (np.cumsum(np.full(10_000, 0.002)), 0.002),
        ((np.arange(10_000) * 0.002).astype(np.float32), 0.002),
        (1.7e9 + np.arange(100) * 0.002, 0.002),
        (np.arange(100), 1.0),
        (np.linspace(0, 20, 10_001), 0.002),
    ],
)
def test_times_with_rounding_errors_give_the_short_step(times, step):
    assert Run.from_arrays(time=times, inputs={}, outputs={"y": ramp(times.size)}).step == step


@pytest.mark.parametrize("step", [1 / 300, math.pi / 1000, 0.00123456789012345])
def test_a_step_with_many_digits_keeps_them(step):
    run = Run.from_arrays(time=np.arange(1000) * step, inputs={}, outputs={"y": ramp(1000)})
    assert run.step == pytest.approx(step, rel=1e-15, abs=0)


@pytest.mark.parametrize(("unit", "scale"), [("s", 1), ("ms", 1e3), ("us", 1e6), ("min", 1 / 60), ("h", 1 / 3600)])
def test_time_units(unit, scale):
    run = make(step=None, time=grid() * scale + 5 * scale, time_unit=unit)
    assert run.step == 0.01
    assert run.start == pytest.approx(5.0)


def test_a_little_jitter_is_taken_as_regular_and_said():
    times = grid()
    times[20] += 0.00015
    run = make(step=None, time=times)
    assert run.step == 0.01
    assert len(run.warnings) == 1
    assert "1.5 % of a step, the most at row 20" in run.warnings[0]


def test_a_gap_can_be_avoided_with_slice():
    times = np.concatenate([grid(20), grid(30) + 5.0])
    before = make(step=None, time=times, window=(0, 0.2))
    after = make(step=None, time=times, window=(5, None))
    assert (before.length, before.start, before.step) == (20, 0.0, 0.01)
    assert (after.length, after.start, after.step) == (30, 5.0, 0.01)
    np.testing.assert_array_equal(after["u"], ramp()[20:])


def test_limits_of_a_slice_are_exact_beside_a_gap_of_any_length():
    times = np.concatenate([grid(25), grid(25) + 1e7])
    assert make(step=None, time=times, window=(0.05, 0.1)).length == 5
    nan = put(grid(), [40], np.nan)
    assert make(step=None, time=nan, window=(0, 0.3)).length == 30
    messages = [
        ((0, 0.5), "NaN, first at row 40, 1 in all"),
        ((0.35, None), "NaN, first at row 40, 1 in all"),
    ]
    for limits, words in messages:
        with pytest.raises(DataError, match=words):
            make(step=None, time=nan, window=limits)
    with pytest.raises(DataError, match="not finite, first at row 0, 1 in all"):
        make(step=None, time=put(grid(), [0], np.nan), window=(0, 0.3))


def test_slice_of_a_clock_that_starts_again_is_refused():
    times = np.concatenate([grid(25), grid(25)])
    with pytest.raises(DataError, match=r"decreasing time.* row 25, 1 in all"):
        make(step=None, time=times, window=(0, 0.1))


def test_resample_of_irregular_times_holds_and_interpolates_and_says_so():
    times = np.array([0.0, 1.0, 1.5, 4.0, 6.0])
    run = Run.from_arrays(
        time=times + 3,
        inputs={"held": [0, 1, 2, 3, 4], "line": times * 2},
        outputs={"y": times},
        intersample={"line": "foh"},
        resample=0.5,
    )
    np.testing.assert_array_equal(run.time, np.arange(13) * 0.5)
    np.testing.assert_allclose(run["y"], run.time)
    np.testing.assert_allclose(run["line"], 2 * run.time)
    np.testing.assert_array_equal(run["held"], [0, 0, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 4])
    assert run.start == 3.0
    assert len(run.warnings) == 1
    for word in ("resampled to 0.5 s", "0.5 to 2.5 s", "after row 2", "means over the new intervals for held"):
        assert word in run.warnings[0]


def test_resample_still_needs_increasing_times():
    for times, word in ((put(grid(), [5], 0.04), "repeated"), (put(grid(), [5], 0.0), "decreasing")):
        with pytest.raises(DataError, match=word):
            make(step=None, time=times, resample=0.01)


# --- parts of runs ----------------------------------------------------------------------------------------------------


def test_slice_shares_no_row_and_keeps_the_source_time():
    n = 10_000
    run = Run.from_arrays(time=np.round(82.174 + np.arange(n) * 0.002, 3), inputs={}, outputs={"y": np.arange(n)})
    est, val = run.window(1.1, 11.0), run.window(11.0, None)
    assert (est.start, est.length, est["y"][0], est["y"][-1]) == (83.274, 4950, 550.0, 5499.0)
    assert (val.start, val["y"][0], val.length) == (93.174, 5500.0, 4500)
    assert est.step == val.step == 0.002
    assert est.time[0] == 0.0
    assert run.window(None, None).length == run.window(0, 20.0).length == n
    assert run.window(None, 11.0).window(1.1, None)["y"].tobytes() == est["y"].tobytes()


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        ((0.6, None), ["0.6", "out of range", "0.5 s"]),
        ((None, 0.51), ["0.51", "out of range"]),
        ((-0.01, 0.2), ["-0.01", "out of range"]),
        ((0.3, 0.2), ["do not increase"]),
        ((0.2, 0.2), ["do not increase"]),
        ((0.2, 0.22), ["2 rows remain"]),
        ((0.5, None), ["no row"]),
        ((math.nan, 0.2), ["finite"]),
        (("a", 0.2), ["'a'", "number"]),
    ],
)
def test_bad_slices_are_refused(limits, words):
    with pytest.raises(DataError) as caught:
        make().window(*limits)
    assert [word for word in ["window", *words] if word not in str(caught.value)] == [], str(caught.value)


def test_resample_of_a_run():
    run = make(inputs={"u": pulses(), "v": ramp()}, outputs={"y": ramp()}, intersample={"v": "foh"})
    finer = run.resample(0.005)
    np.testing.assert_array_equal(finer["u"], np.repeat(pulses(), 2)[:-1])
    np.testing.assert_allclose(finer["v"], np.linspace(-1, 1, 99), atol=1e-15)
    assert (finer.step, finer.length, finer.duration) == (0.005, 99, run.duration)
    assert (
        "resampled from 0.01 s to 0.005 s (means over the new intervals for u; outputs at their original times"
        in finer.warnings[0]
    )
    # Values between the rows are not measurements; every second row is.
    np.testing.assert_array_equal(finer.nonuniform_samples.data["y"], run["y"])
    assert run.resample(0.02).nonuniform_samples is None
    assert run.resample(0.015).nonuniform_samples is not None
    back = finer.resample(0.01)
    for name in run.signals:
        np.testing.assert_allclose(back[name], run[name], atol=1e-15)
    assert len(back.warnings) == 2
    for step, word in ((0, "step"), (math.nan, "nan"), (0.4, "2 rows"), (1e-15, "larger step"), ("x", "'x'")):
        with pytest.raises(DataError, match="resample=") as caught:
            run.resample(step)
        assert word in str(caught.value) or step == 0


def test_rename_select_and_intersample():
    run = make(inputs={"u": ramp(), "v": pulses()}, units={"u": "mA", "y": "deg"}, intersample={"v": "foh"})
    swapped = run.rename({"u": "v", "v": "u", "y": "θ12"})
    assert swapped.inputs == ("v", "u")
    assert swapped.outputs == ("θ12",)
    assert swapped.units == {"v": "A", "u": "", "θ12": "rad"}
    assert swapped.intersample == {"v": "zoh", "u": "foh"}
    assert swapped["v"] is not run["v"]
    np.testing.assert_array_equal(swapped["u"], pulses())
    part = run.select(["y", "v"])
    assert part.signals == ("v", "y")
    assert part.intersample == {"v": "foh"}
    assert run.with_intersample({"u": "foh"}).intersample == {"u": "foh", "v": "foh"}
    bad = [
        (lambda: run.rename({"w": "x"}), "'w' is not in run"),
        (lambda: run.rename({"u": "v"}), "two signals would have the name 'v'"),
        (lambda: run.rename({"u": "=1"}), "cannot name a signal"),
        (lambda: run.select(["u"]), "no output is left"),
        (lambda: run.select(["y", "z"]), "'z' is not in run"),
        (lambda: run.select(["y", "y"]), "'y' is given twice"),
        (lambda: run.with_intersample({"y": "foh"}), "'y' is not an input"),
    ]
    for call, words in bad:
        with pytest.raises(DataError, match=words):
            call()


def test_check_compatible():
    run = make()
    check_compatible([run])
    check_compatible([run, run.window(0, 0.2), run.resample(0.005)])
    with pytest.raises(DataError, match="runs: there is none"):
        check_compatible([])
    with pytest.raises(DataError, match=r"run 1 \('run'\) and run 0 .* different outputs: 'z' and 'y'"):
        check_compatible([run, run.rename({"y": "z"})])
    with pytest.raises(DataError, match="different inputs: none and 'u'"):
        check_compatible([run, run.select(["y"])])
    with pytest.raises(DataError, match="different units: signal 'y' is in 'rad' and '', 1 in all"):
        check_compatible([run, run, make(units={"y": "deg"})])


def test_pickle_and_copy_keep_everything():
    run = make(units={"y": "deg"}, intersample={"u": "foh"}).resample(0.005)
    for other in (pickle.loads(pickle.dumps(run)), copy.deepcopy(run), copy.copy(run)):
        assert repr(other) == repr(run)
        assert other.warnings == run.warnings
        for name in run.signals:
            assert other[name].tobytes() == run[name].tobytes()
            assert not other[name].flags.writeable


def test_printing_escapes_names():
    run = make(name='</script>"><svg onload=x>', units={"y": "deg"})
    text = run._repr_html_()
    assert "<svg" not in text
    assert "</script" not in text
    assert "&lt;svg" in text
    assert "y [rad]" in repr(run)
    assert "50 rows, step 0.01 s" in repr(run)
    assert "is constant" in repr(make(outputs={"y": np.zeros(N)}))
    assert "is constant" in make(outputs={"y": np.zeros(N)})._repr_html_()


# --- frames -----------------------------------------------------------------------------------------------------------


def frame_columns():
    return {"t_s": grid(), "cur A": ramp(), "th_deg": ramp() ** 2, "word": ["a"] * N}


FRAMES = {
    "pandas": lambda: pd.DataFrame(frame_columns()),
    "polars": lambda: pl.DataFrame(frame_columns()),
    "dict": frame_columns,
    "structured": lambda: pd.DataFrame(frame_columns()).drop(columns="word").to_records(index=False),
}


@pytest.mark.parametrize("kind", FRAMES)
def test_from_frame(kind):
    run = Run.from_frame(
        FRAMES[kind](), time="t_s", inputs={"I": "cur A"}, outputs=["th_deg"], units={"th_deg": "deg"}, name="f"
    )
    assert run.step == 0.01
    np.testing.assert_array_equal(run["I"], ramp())
    np.testing.assert_array_equal(run["th_deg"], np.deg2rad(ramp() ** 2))
    assert Run.from_frame(FRAMES[kind](), step=1, inputs=None, outputs="th_deg").inputs == ()


@pytest.mark.parametrize("kind", FRAMES)
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"inputs": {"I": "cur_A"}}, ["'cur_A'", "signal 'I'", "did you mean 'cur A'", "'th_deg'"]),
        ({"time": "time"}, ["'time'", "(time)"]),
        ({"outputs": ["th_deg", "th_deg"]}, ["'th_deg'", "twice"]),
        ({"outputs": [3]}, ["outputs=", "entry 0"]),
        ({"outputs": 3}, ["outputs=", "int"]),
        ({"step": 0.01}, ["both"]),
        ({"time": None}, ["neither"]),
    ],
)
def test_bad_frames_are_refused(kind, changes, words):
    arguments = {"time": "t_s", "inputs": {"I": "cur A"}, "outputs": ["th_deg"], **changes}
    with pytest.raises(DataError) as caught:
        Run.from_frame(FRAMES[kind](), **arguments)
    assert [word for word in words if word not in str(caught.value)] == [], str(caught.value)


def test_errors_of_frames_name_the_column_too():
    frame = pd.DataFrame(frame_columns())
    frame.loc[4, "cur A"] = np.nan
    with pytest.raises(DataError, match=r"signal 'I' \(column 'cur A'\): NaN, first at row 4, 1 in all"):
        Run.from_frame(frame, time="t_s", inputs={"I": "cur A"}, outputs=["th_deg"])
    with pytest.raises(DataError, match=r"signal 'I' \(column 'word'\): 'a' is not a number"):
        Run.from_frame(frame, time="t_s", inputs={"I": "word"}, outputs=["th_deg"])
    with pytest.raises(DataError, match=r"'th_deg' .* occurs 2 times"):
        Run.from_frame(pd.concat([frame, frame], axis=1), step=1, inputs=None, outputs=["th_deg"])
    with pytest.raises(DataError, match="collect"):
        Run.from_frame(pl.DataFrame(frame_columns()).lazy(), step=1, inputs=None, outputs=["th_deg"])
    with pytest.raises(DataError, match="frame is a list"):
        Run.from_frame([1, 2], step=1, inputs=None, outputs=["th_deg"])


# --- csv --------------------------------------------------------------------------------------------------------------


def test_csv_is_never_overwritten_unasked(tmp_path):
    path = tmp_path / "run.csv"
    make().to_csv(path)
    content = path.read_bytes()
    with pytest.raises(DataError, match=r"exists; .*force=True"):
        make(name="other").to_csv(path)
    assert path.read_bytes() == content
    make(name="other").to_csv(path, force=True)
    assert path.read_bytes() != content
    assert os.listdir(tmp_path) == ["run.csv"]


def test_csv_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    with pytest.raises(DataError, match="folder"):
        make().to_csv(tmp_path)
    with pytest.raises(DataError, match="cannot be written"):
        make().to_csv(tmp_path / "no" / "run.csv")
    path = tmp_path / "run.csv"
    make().to_csv(path)
    content = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DataError, match="No space left on device"):
        make(name="other").to_csv(path, force=True)
    assert path.read_bytes() == content
    assert os.listdir(tmp_path) == ["run.csv"]


def test_csv_holds_what_the_first_line_says(tmp_path):
    make(units={"y": "deg"}, name="n").resample(0.02).to_csv(tmp_path / "a.csv")
    lines = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].startswith("# ftlm-run 1 {")
    header = json.loads(lines[0].removeprefix("# ftlm-run 1 "))
    assert header["inputs"] == ["u"]
    assert header["units"] == {"u": "", "y": "rad"}
    assert header["step"] == 0.02
    assert len(header["warnings"]) == 1
    assert lines[1] == "t_s,u,y"
    assert [line.split(",")[0] for line in lines[2:6]] == ["0.0", "0.02", "0.04", "0.06"]


# --- properties -------------------------------------------------------------------------------------------------------

VALUES = st.floats(-1e150, 1e150, allow_subnormal=True)
NAMES = st.from_regex(r"[a-zA-Zäθ_][a-zA-Z0-9_.\[\]]{0,8}", fullmatch=True).filter(lambda name: name != "t_s")
STEPS = st.floats(1e-12, 1e6, allow_nan=False)


@st.composite
def runs(draw):
    n = draw(st.integers(3, 40))
    names = draw(st.lists(NAMES, min_size=1, max_size=4, unique=True))
    count = draw(st.integers(0, len(names) - 1))
    signals = {name: draw(hnp.arrays(np.float64, n, elements=VALUES)) for name in names}
    inputs, outputs = names[:count], names[count:]
    return Run.from_arrays(
        step=draw(STEPS),
        inputs={name: signals[name] for name in inputs},
        outputs={name: signals[name] for name in outputs},
        units={name: draw(st.sampled_from(["", "rad", "N·m", "1", "degC"])) for name in names},
        intersample={name: draw(st.sampled_from(["zoh", "foh"])) for name in inputs},
        name=draw(st.text(min_size=1, max_size=20).filter(lambda s: s.isprintable() and s[0] not in "=+-@")),
    )


@settings(max_examples=150, deadline=None)
@given(run=runs(), drop=st.integers(0, 3))
def test_csv_round_trip_is_exact_to_the_bit(run, drop, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "x.csv"
    if run.length - drop >= 3:
        run = run.window(drop * run.step, None)
    run.to_csv(path)
    back = load(path)
    assert (back.name, back.step, back.start) == (run.name, run.step, run.start)
    assert (back.inputs, back.outputs, back.units) == (run.inputs, run.outputs, run.units)
    assert (back.intersample, back.warnings, back.length) == (run.intersample, run.warnings, run.length)
    assert back.time.tobytes() == run.time.tobytes()
    for name in run.signals:
        assert back[name].tobytes() == run[name].tobytes()


@settings(max_examples=200, deadline=None)
@given(
    n=st.integers(6, 300),
    step=st.sampled_from([0.002, 0.1, 1.0, 1 / 300, 7e-5]),
    start=st.sampled_from([0.0, 82.174, -5.0]),
    data=st.data(),
)
def test_slices_by_time_agree_with_rows(n, step, start, data):
    times = start + np.arange(n) * step
    first = data.draw(st.integers(0, n - 3))
    last = data.draw(st.integers(first + 3, n))
    values = np.arange(float(n))
    whole = Run.from_arrays(time=times, inputs={"u": values}, outputs={"y": values})
    limits = (first * step, last * step)
    at_once = Run.from_arrays(time=times, inputs={"u": values}, outputs={"y": values}, window=limits)
    for part in (whole.window(*limits), at_once):
        np.testing.assert_array_equal(part["y"], values[first:last])
        assert part.start == pytest.approx(times[first], rel=1e-11, abs=1e-11)
        assert part.step == pytest.approx(step, rel=1e-9)
        np.testing.assert_array_equal(part.time, np.arange(last - first) * part.step)
        assert part.duration == (last - first - 1) * part.step


@settings(max_examples=100, deadline=None)
@given(
    values=hnp.arrays(np.float64, st.integers(3, 30), elements=st.floats(allow_nan=True, allow_infinity=True)),
    unit=st.sampled_from(["deg", "", "rpm"]),
)
def test_data_given_in_is_never_changed(values, unit):
    before = values.tobytes()
    times = np.arange(values.size) * 0.5
    try:
        run = Run.from_arrays(time=times, inputs={}, outputs={"y": values}, units={"y": unit})
    except DataError:
        assert not np.isfinite(values).all() or np.abs(values).max() > 1e149
    else:
        run.window(0, None).resample(0.25)
        assert not np.shares_memory(run["y"], values)
    assert values.tobytes() == before
    assert values.flags.writeable
    assert times.tobytes() == (np.arange(values.size) * 0.5).tobytes()
