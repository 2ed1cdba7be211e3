"""Runs with jittered times put on a regular step: commands by the mean of the hold, outputs compared when read."""

from __future__ import annotations

import numpy as np
import pytest

import ftlm
from ftlm.data.sampling import resample_uniform

pytestmark = pytest.mark.usefixtures("no_extension_tests")

PLANT = "D^0.8 y = -1.5 y + 1.5 u"
STEP, ROWS, FINE = 0.05, 600, 20


def naive_means(since: np.ndarray, values: np.ndarray, step: float, rows: int) -> np.ndarray:
    """The mean of a hold over each new interval, one interval and one row at a time."""
    out = []
    for k in range(rows):
        low, high, total = k * step, (k + 1) * step, 0.0
        for j, value in enumerate(values):
            begin, end = since[j], since[j + 1] if j + 1 < len(since) else np.inf
            total += value * max(0.0, min(high, end) - max(low, begin))
        out.append(total / step)
    return np.array(out)


def jittered(seed: int, jitter: float = 0.3) -> ftlm.Run:
    """A first-order fractional plant, a command given at times that jitter by a share of the step, 1 % noise."""
    rng = np.random.default_rng(seed)
    # Times on a fine grid, so that the simulated hold is exact.
    ticks = np.arange(ROWS) * FINE + np.round(rng.uniform(-jitter, jitter, ROWS) * FINE).astype(int)
    ticks[0] = 0
    # Some 30 switches: at every one the linear interpolation of the output cuts a corner of its own.
    command = np.where(np.cumsum(rng.random(ROWS) < 0.05) % 2, -1.0, 1.0)
    fine = np.arange(ticks[-1] + 1)
    samples = command[np.searchsorted(ticks, fine, side="right") - 1]
    there = ftlm.Run.from_arrays(inputs={"u": samples}, outputs={"y": np.zeros(fine.size)}, step=STEP / FINE)
    y = ftlm.Model(ftlm.equation(PLANT)).simulate(there)["y"][ticks]
    return ftlm.Run.from_arrays(
        time=ticks * STEP / FINE,
        inputs={"u": command},
        outputs={"y": y + 0.01 * np.std(y) * rng.standard_normal(ROWS)},
        resample=STEP,
    )


@pytest.mark.parametrize("step", [0.37, 0.05, 1.3])
def test_a_held_command_becomes_its_means(step: float) -> None:
    rng = np.random.default_rng(7)
    since = np.concatenate([[0.0], np.cumsum(rng.uniform(0.05, 1.0, 80))])
    data = {"u": rng.standard_normal(81), "y": rng.standard_normal(81)}
    found = resample_uniform(since, data, {"u": "zoh"}, step)
    expected = naive_means(since, data["u"], step, found["u"].size)
    np.testing.assert_allclose(found["u"], expected, rtol=0, atol=1e-11)
    np.testing.assert_array_equal(found["y"], np.interp(np.arange(found["y"].size) * step, since, data["y"]))


def test_what_falls_on_the_grid_keeps_its_bits() -> None:
    values = np.random.default_rng(8).standard_normal(500) * 1e3
    since = np.arange(500) * 0.01
    same = resample_uniform(since + 1e-10 * np.sin(np.arange(500)) * (since > 0), {"u": values}, {"u": "zoh"}, 0.01)
    np.testing.assert_array_equal(same["u"], values)
    np.testing.assert_array_equal(
        resample_uniform(since, {"u": values}, {"u": "zoh"}, 0.0025)["u"], np.repeat(values, 4)[:-3]
    )


def coverage(jitter: float) -> tuple[dict[str, int], list[list[float]]]:
    """How many of 30 runs have the truth within their 95 % intervals, and errors in standard errors."""
    truth, covered, errors = {"alpha": 0.8, "a": -1.5}, {"alpha": 0, "a": 0}, []
    for seed in range(30):
        found = ftlm.identify(jittered(seed, jitter), ftlm.equation("D^alpha y = a y + b u"))
        estimated = found.orders | found.coefficients
        for name, true in truth.items():
            low, high = found.intervals[name]
            covered[name] += low <= true <= high
        errors.append([(estimated[n] - true) / found.standard_errors[n] for n, true in truth.items()])
    return covered, errors


@pytest.mark.slow
def test_regular_times_leave_intervals_that_cover() -> None:
    covered, _ = coverage(0.0)
    assert min(covered.values()) >= 27, covered


@pytest.mark.slow
def test_jitter_of_thirty_percent_leaves_intervals_that_cover_as_well() -> None:
    """The output is compared when it was read; straight lines to a grid moved estimates by a standard error."""
    covered, errors = coverage(0.3)
    assert min(covered.values()) >= 27, covered
    assert np.abs(np.mean(errors, axis=0)).max() < 0.5


@pytest.mark.parametrize("step", [0.01, 0.0125, 0.07])
def test_regular_rows_on_another_step_are_no_more_data_than_they_are(step: float) -> None:
    rng = np.random.default_rng(11)
    u = np.repeat(rng.uniform(-1.0, 1.0, 20), 15)
    plain = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": np.zeros(u.size)}, step=0.05)
    y = ftlm.Model(ftlm.equation(PLANT)).simulate(plain)["y"] + 0.02 * rng.standard_normal(u.size)
    as_is, resampled = (
        ftlm.identify(
            ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, step=0.05, **more),
            ftlm.equation("D^alpha y = a y + b u", initial="rest"),
        )
        for more in ({}, {"resample": step})
    )
    for name, error in as_is.standard_errors.items():
        assert resampled.standard_errors[name] == pytest.approx(error, rel=0.02)
    assert resampled.orders["alpha"] == pytest.approx(as_is.orders["alpha"], abs=0.1 * as_is.standard_errors["alpha"])
    assert not [w for w in resampled.warnings if "not white" in w]
