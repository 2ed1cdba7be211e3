"""Intervals of what the runs do not see: no direction is dropped, none is invented."""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
from functools import partial
from pathlib import Path

import mpmath
import numpy as np
import pytest
from scipy.signal import lfilter, lsim

import ftlm
from ftlm.estimation import nuisance_parameters as history
from ftlm.estimation.objective import covariance_of, propagated_covariance, propagated_errors
from ftlm.estimation.output_error import JointFit, fit_output_error
from ftlm.report.html_report import model_page
from ftlm.utils.statistics import is_white

pytestmark = pytest.mark.usefixtures("no_extension_tests")


def digits_of(jacobian: np.ndarray, squares: float) -> np.ndarray:
    """Classical covariance from the normal equations, in 60 digits."""
    with mpmath.workdps(60):
        matrix = mpmath.matrix(jacobian.tolist())
        inverse = (matrix * matrix.T) ** -1
        count = jacobian.shape[1] - jacobian.shape[0]
        return np.array((inverse * squares / count).tolist(), dtype=float)


FITTED = """
import json
import numpy as np
import ftlm
t = 0.05 * np.arange(300)
u = np.sign(np.sin(1.3 * t)) + 0.3 * np.sin(0.7 * t)
y = np.convolve(u, 0.05 * np.exp(-0.6 * t))[: t.size] + 0.02 * np.random.default_rng(3).standard_normal(t.size)
run = ftlm.Run.from_arrays(inputs={"u": u}, outputs={"y": y}, step=0.05)
found = ftlm.identify(run, ftlm.equation("D^alpha y = c y + b u"), method=ftlm.OutputError(intervals="quadratic"))
print(json.dumps([found.to_dict()[key] for key in ("coefficients", "orders", "standard_errors")]))
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="kernels of another processor, by name")
def test_another_linear_algebra_moves_last_digits_alone() -> None:
    reports = []
    for kernels in ("Prescott", "Nehalem"):
        done = subprocess.run(
            [sys.executable, "-c", FITTED],
            check=True,
            capture_output=True,
            text=True,
            timeout=240,
            env={**os.environ, "OPENBLAS_CORETYPE": kernels, "OPENBLAS_NUM_THREADS": "1"},
        )
        reports.append(json.loads(done.stdout))
    (*numbers, spread), (*others, again) = reports
    for one, other in zip(numbers, others, strict=True):
        assert one == pytest.approx(other, rel=1e-9)
    assert again == pytest.approx(spread, rel=1e-9)
    assert len(spread) == 3


@pytest.mark.parametrize("rows", [300, 1031])
@pytest.mark.parametrize("apart", [1.0, 1e-4, 1e-7, 1e-10])
def test_a_flat_direction_has_the_interval_that_sixty_digits_give(apart: float, rows: int) -> None:
    rng = np.random.default_rng(1)
    jacobian = rng.standard_normal((4, rows)) * np.array([[1e6], [1.0], [1.0], [1e-5]])
    jacobian[2] = jacobian[1] + apart * jacobian[2]
    noise = rng.standard_normal(rows)
    found, exact = covariance_of(jacobian, [noise], float(noise @ noise)), digits_of(jacobian, float(noise @ noise))
    spread = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(np.sqrt(np.diag(found)), spread, rtol=1e-5)
    # Dropped directions left 0.04 where 60 digits give 0.04 / apart.
    assert np.sqrt(found[1, 1]) * apart > 0.01
    np.testing.assert_allclose(found / np.outer(spread, spread), exact / np.outer(spread, spread), atol=1e-5)


@pytest.mark.parametrize("coloured", [False, True])
def test_parameters_of_an_unseen_direction_have_infinite_variance_and_the_others_keep_theirs(coloured: bool) -> None:
    rng = np.random.default_rng(2)
    jacobian = rng.standard_normal((5, 400))
    jacobian[3] = jacobian[1]
    jacobian[4] = 0.0
    noise = rng.standard_normal(400)
    residuals = np.convolve(noise, np.ones(20))[:400] if coloured else noise
    found = covariance_of(jacobian, [residuals], float(residuals @ residuals))
    assert np.isinf(np.diag(found)).tolist() == [False, True, False, True, True]
    # What the two others know is what they know where the pair counts once.
    once = covariance_of(jacobian[:3], [residuals], float(residuals @ residuals))
    if not coloured:
        np.testing.assert_allclose(once[:3, :3], digits_of(jacobian[:3], float(residuals @ residuals)), rtol=1e-9)
        once *= (400 - 3) / (400 - 5)
    np.testing.assert_allclose(found[np.ix_([0, 2], [0, 2])], once[np.ix_([0, 2], [0, 2])], rtol=1e-9)
    derived = propagated_errors(np.array([[1.0, 0, 2.0, 0, 0], [1.0, 1.0, 0, 0, 0]]), found)
    np.testing.assert_allclose(derived[0] ** 2, found[0, 0] + 4 * found[2, 2] + 4 * found[0, 2])
    assert math.isinf(derived[1])


def test_a_variance_that_is_only_rounding_error_is_zero() -> None:
    rng = np.random.default_rng(4)
    plain_signs = set()
    for _ in range(40):
        # The last two parameters determine one another exactly, so a combination of them has no variance.
        root = rng.standard_normal((4, 3)) * np.array([[1e-3], [1.0], [1e3], [0.0]])
        root[3] = -0.7 * root[2]
        slopes = np.array([[0.0, 0, 0.7, 1], [1.0, 0, 0, 0], [0, 1.0, 1.0, 0]])
        matrix = root @ np.diag(rng.lognormal(size=3)) @ root.T
        plain, found = slopes @ matrix @ slopes.T, propagated_covariance(slopes, matrix)
        plain_signs.add(float(np.sign(plain[0, 0])))
        assert not found[0].any()
        assert not found[:, 0].any()
        np.testing.assert_array_equal(found[1:, 1:], plain[1:, 1:])
    assert -1.0 in plain_signs
    unknown = np.diag([np.inf, 1.0])
    assert not np.isfinite(propagated_covariance(np.eye(2), unknown)).all()


def driven_twice(seed: int, apart: float) -> ftlm.Run:
    """A resonance at 40 dB whose command stands in two columns, the second this much of its noise apart."""
    rng = np.random.default_rng(seed)
    u = np.repeat(np.where(rng.random(40) < 0.5, -1.0, 1.0), 20)
    y = lsim(([[0, 1], [-4, -0.4]], [[0], [4.0]], [[1, 0]], 0), u, np.arange(u.size) * 0.05, interp=False)[1]
    return ftlm.Run.from_arrays(
        inputs={"u": u, "v": u + apart * rng.standard_normal(u.size)},
        outputs={"y": y + 0.01 * np.std(y) * rng.standard_normal(y.size)},
        step=0.05,
    )


START = {"c": -0.4, "a": -4.0, "b": 2.0, "e": 2.0}
WORDS = "D^2 y = c D y + a y + b u + e v"


@pytest.fixture
def twice(monkeypatch: pytest.MonkeyPatch) -> ftlm.Identification:
    """Two terms that are the same to the runs, from a given start: an automatic one finds nothing to invert."""
    monkeypatch.setattr(history, "fit_output_error", partial(fit_output_error, start=START))
    return ftlm.identify(driven_twice(1, 0.0), ftlm.equation(WORDS))


def test_two_terms_that_are_one_are_told_apart_by_nothing(twice: ftlm.Identification, tmp_path: Path) -> None:
    errors = twice.standard_errors
    assert [n for n, e in errors.items() if math.isinf(e)] == ["b", "e"]
    assert twice.intervals["b"] == (-math.inf, math.inf)
    for name, true in (("a", -4.0), ("c", -0.4)):
        assert abs(twice.coefficients[name] - true) < 3 * errors[name] < 0.1 * abs(true)
    said = [w for w in twice.warnings if "not separately identifiable from these runs: b, e" in w]
    assert len(said) == 1
    assert "infinite" in said[0]
    assert not [w for w in twice.warnings if "b = " in w or "not defined" in w]
    assert "± ∞" in str(twice)
    document = json.loads(json.dumps(twice.to_dict(), allow_nan=False))
    assert document["standard_errors"]["b"] is None
    assert document["intervals"]["e"] == [None, None]
    twice.model.save(tmp_path / "model.json")
    read = ftlm.load_model(tmp_path / "model.json")
    assert read.estimate is not None
    assert read.estimate.standard_errors["b"] is None
    assert read.estimate.standard_errors["a"] == errors["a"]
    page = twice.report(tmp_path / "report.html").read_text(encoding="utf-8")
    assert "−∞" in page
    assert "The runs do not identify all parameters, so there are no bands" in page
    model_page(read, tmp_path / "model.html")


def test_two_terms_that_are_nearly_one_have_the_wide_intervals_of_their_difference() -> None:
    found = fit_output_error([driven_twice(1, 1e-9)], ftlm.equation(WORDS, initial="rest"), start=START)
    for name in ("b", "e"):
        assert 1e6 < found.standard_errors[name] < 1e9
    assert found.standard_errors["a"] < 0.1


def test_derived_errors_of_what_is_not_seen_are_infinite() -> None:
    covariance = np.array([[np.inf, np.nan], [np.nan, 0.04]])
    fit = JointFit(
        {},
        {"a": 2.0, "r": 3.0},
        covariance,
        {},
        0.0,
        9,
        1,
        True,
        True,
        [],
        [],
        products={"both": (1.0, ("a", "r")), "square": (-1.0, ("r", "r"))},
    )
    assert fit.derived_errors == {"both": math.inf, "square": pytest.approx(2 * 3.0 * 0.2)}
    assert np.isnan(fit.correlation[0, 1])
    assert fit.intervals["a"] == (-math.inf, math.inf)


def test_short_records_include_the_correlation_that_the_test_for_white_noise_misses():
    """The mean of samples with a correlation of 0.5 has three times the variance of the mean of white noise."""
    rows, ratios, white_ratios = 40, [], []
    jacobian = np.ones((1, rows))
    for seed in range(60):
        noise = np.random.default_rng(seed).standard_normal(rows + 50)
        for values, out in ((lfilter([1.0], [1.0, -0.5], noise)[50:], ratios), (noise[50:], white_ratios)):
            residuals = values - values.mean()
            if is_white(residuals):
                squares = float(residuals @ residuals)
                variance = covariance_of(jacobian, [residuals], squares)[0, 0]
                out.append(variance / (squares / (rows - 1) / rows))
    assert len(ratios) > 20
    assert len(white_ratios) > 50
    assert np.median(ratios) > 1.8
    assert np.min(ratios + white_ratios) > 1.0 - 1e-9
    assert np.mean(np.array(white_ratios) > 1.01) < 0.1
