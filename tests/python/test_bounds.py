"""Bounds of coefficients and orders beside SciPy's bounded least squares, over time and over frequency."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import least_squares
from typer.testing import CliRunner

import ftlm
from ftlm.cli.main import app

pytestmark = pytest.mark.usefixtures("no_extension_tests")

STEP = 0.02
TIME = STEP * np.arange(600)
INPUT = np.where(np.sin(1.3 * TIME) + np.sin(3.1 * TIME + 1) > 0, 1.0, -1.0)
OSCILLATOR = ftlm.equation("D^2 y = a1 D y + a0 y + b u")
ARC = "D^alpha U = a U + r D^alpha I + b I"


def oscillator(a1: float, a0: float, b: float) -> np.ndarray:
    """Return exact samples of the oscillator for a held input."""
    whole = expm(STEP * np.array([[0, 1, 0], [a0, a1, b], [0, 0, 0]]))
    states = [np.zeros(2)]
    for held in INPUT[:-1]:
        states.append(whole[:2, :2] @ states[-1] + whole[:2, 2] * held)
    return np.array(states)[:, 0]


@pytest.fixture(scope="module")
def run() -> ftlm.Run:
    return ftlm.Run.from_arrays(outputs={"y": oscillator(-0.05, -4, 3)}, inputs={"u": INPUT}, step=STEP)


@pytest.fixture(scope="module")
def spectrum() -> ftlm.FrequencyData:
    f, noise = np.geomspace(0.01, 1e4, 60), np.random.default_rng(1)
    z = 0.01 + 0.05 / (1 + (2j * np.pi * f * 0.01) ** 0.8)
    z = z * (1 + 0.005 * (noise.standard_normal(60) + 1j * noise.standard_normal(60)))
    return ftlm.FrequencyData.from_arrays(f, z, frequency_unit="Hz", unit="Ω", output="U", input="I")


@pytest.mark.parametrize(
    ("bounds", "on"),
    [
        ({"a1": (-10, 0)}, []),
        ({"a1": (-10, -0.3)}, ["a1"]),
        ({"a1": (-10, -0.3), "a0": (-3.9, math.inf)}, ["a0", "a1"]),
        # Alone each of a0 and b lies within its bounds, or beyond them because of the other.
        ({"a1": (-10, -0.3), "a0": (-4.2, 0), "b": (0, 2.9)}, ["a1", "b"]),
    ],
)
def test_coefficients_within_bounds_are_those_of_bounded_least_squares(run, bounds, on):
    found = ftlm.identify(run, OSCILLATOR, bounds=bounds)
    low, high = np.transpose([bounds.get(n, (-99, 99)) for n in ("a1", "a0", "b")])
    start = np.clip([-0.31, -3.5, 2.5], low + 1e-3, high - 1e-3)
    oracle = least_squares(lambda p: oscillator(*p) - run["y"], start, bounds=(low, high), xtol=1e-15, ftol=1e-15)
    assert [found.coefficients[n] for n in ("a1", "a0", "b")] == pytest.approx(oracle.x, rel=3e-4)
    assert sorted(f.parameter for f in found.findings if f.code == "coefficient_on_bound") == on
    assert sorted(n for n, p in found.parameters.items() if p.fixed) == on
    assert all(np.isnan(found.parameters[n].standard_error) for n in on)


def test_a_coefficient_is_freed_from_a_bound_that_another_pushed_it_to(run):
    # The best fit without bounds has the terms in the other places, and both coefficients beyond their bounds.
    swapped = ftlm.equation("D^2 y = a D^mu y + c D^nu y + b u")
    found = ftlm.identify(run, swapped, bounds={"a": (-1, 0), "c": (-5, -2), "mu": (0.5, 1.5), "nu": (0, 0.4)})
    assert found.coefficients == pytest.approx({"a": -0.05, "c": -4, "b": 3}, rel=1e-3)
    assert not any(f.code == "coefficient_on_bound" for f in found.findings)


def test_offsets_loss_and_noise_models_keep_the_bounds(run):
    for options in ({"offset": "auto"}, {"method": ftlm.OutputError(loss="huber", start={"b": 1.0})}):
        found = ftlm.identify(run, OSCILLATOR, bounds={"b": (0, 2.9)}, **options)
        assert found.coefficients["b"] == 2.9
    found = ftlm.identify(run, OSCILLATOR, bounds={"a1": (-1, -0.3)}, method=ftlm.OutputError(noise="ar"))
    assert found.coefficients["a1"] == -0.3


def test_a_spectrum_keeps_bounds_of_coefficients_and_orders(spectrum):
    found = ftlm.identify_frequency(
        spectrum, ARC, bounds={"r": (0.012, math.inf), "alpha": (0.5, 0.75)}, start={"b": 2}
    )
    s = 1j * spectrum.frequency

    def left(p: np.ndarray) -> np.ndarray:
        e = (p[1] * s ** p[0] + 10 ** p[3]) / (s ** p[0] + 10 ** p[2]) / spectrum.response - 1
        return np.r_[e.real, e.imag]

    ends = [0.5, 0.012, -3, -3], [0.75, 1, 3, 3]
    oracle = least_squares(left, [0.7, 0.013, 1.5, 0.1], bounds=ends, xtol=1e-15, ftol=1e-15, x_scale=[0.1, 0.01, 1, 1])
    values = {**found.values, **found.model.coefficients}
    expected = [*oracle.x[:2], -(10 ** oracle.x[2]), 10 ** oracle.x[3]]
    assert [values[n] for n in ("alpha", "r", "a", "b")] == pytest.approx(expected, rel=1e-3)
    assert found.parameters["r"].fixed
    assert "fixed" in found.summary()
    assert [f.parameter for f in found.findings if f.code == "coefficient_on_bound"] == ["r"]


def test_a_fit_whose_only_parameter_is_on_its_bound_prints(run, spectrum):
    assert "fixed" in str(ftlm.identify(run, ftlm.equation("D^2 y = -0.05 D y - 4 y + b u"), bounds={"b": (0, 2)}))
    found = ftlm.identify_frequency(spectrum, "D^0.8 U = -39.8 U + r D^0.8 I + 2.39 I", bounds={"r": (0.012, 1)})
    assert "r  0.012 fixed" in str(found)


@pytest.mark.parametrize(
    ("bounds", "options", "words"),
    [
        ({"B": (0, 1)}, {}, "bound of 'B' does not occur in the equation; known: a1, a0, b"),
        ({"b": (2, 1)}, {}, r"bounds of b = \(2, 1\) are not an interval; write bounds=\{'b': \(low, high\)\}"),
        ({"b": 3}, {}, "bounds of b = 3 are not an interval"),
        ({"b": (0, math.nan)}, {}, r"bounds of b = \(0, nan\) are not an interval"),
        ({"b": (0, 1)}, {"method": "multi-innovation"}, "bounds= is not used by method='multi-innovation'"),
        ({"b": (0, 1)}, {"method": ftlm.OutputError(start={"b": 3})}, "start= has b = 3, out of its bounds 0 to 1"),
    ],
)
def test_bounds_that_are_none_are_refused(run, bounds, options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.identify(run, OSCILLATOR, bounds=bounds, **options)


def test_bounds_of_a_delay_are_where_it_is_freed(run):
    with pytest.raises(ftlm.ModelError, match=r"the bounds of the delay of u, 0 to 0\.2, are part of the structure"):
        ftlm.identify(run, OSCILLATOR.with_delays({"u": (0, 0.2)}), bounds={"delay_u": (0, 0.1)})


def test_bounds_on_the_command_line(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savetxt("run.csv", np.c_[TIME, INPUT, run["y"]], delimiter=",", header="t [s],u,y", comments="")
    words = ["identify", "run.csv", "--structure", "D^2 y = a1 D y + a0 y + b u", "-u", "u", "-y", "y"]
    result = CliRunner().invoke(app, [*words, "--bounds", "b=-inf:2.9"])
    assert "b = 2.9 is on its bound" in " ".join(result.output.split())
    result = CliRunner().invoke(app, [*words, "--bounds", "b=0:2", "--method", "least-squares"])
    assert "--bounds is not used by --method least-squares" in result.output
