"""Figures for papers hold the numbers of the results, touch no global state, and name what is missing."""

import io
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import ftlm

pytest.importorskip("matplotlib")
HOSTILE = r"$\frac{ <b> & $x^"


@pytest.fixture(scope="module")
def found(small_run, with_noise):
    run = with_noise(small_run, 0.02, 1)
    run = ftlm.Run.from_arrays(
        step=run.step, inputs={"u": run["u"]}, outputs={"y": run["y"]}, units={"y": "rad"}, name=HOSTILE
    )
    structure = ftlm.equation("D^alpha y = a D^nu y + c y + b u", orders={"alpha": "1.3:1.9:0.1", "nu": "0.2:1.2:0.1"})
    return ftlm.identify(run, structure, method="least-squares")


def saved(figure):
    assert figure._repr_png_().startswith(b"\x89PNG")  # a notebook shows it
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=60)
    assert data.getvalue().startswith(b"\x89PNG")
    return figure


def test_a_fit_is_the_comparison(found, small_run):
    figure = saved(ftlm.plot.fit(found))
    upper, lower = figure.axes
    comparison = found.comparison
    np.testing.assert_array_equal(upper.lines[0].get_ydata(), comparison.measured["y"][0])
    np.testing.assert_array_equal(upper.lines[1].get_ydata(), comparison.simulated["y"][0])
    np.testing.assert_array_equal(
        lower.lines[0].get_ydata(), comparison.measured["y"][0] - comparison.simulated["y"][0]
    )
    assert upper.get_ylabel() == "y [rad]"
    assert len(ftlm.plot.fit(found.model, [small_run, small_run]).axes) == 4
    assert len(ftlm.plot.fit(comparison).axes) == 2


def test_residuals_are_the_tests(found):
    figure = saved(ftlm.plot.residuals(found))
    assert [a.get_title().partition(":")[0] for a in figure.axes] == ["y with itself", "y with u"]
    segments = figure.axes[1].collections[0].get_segments()
    np.testing.assert_allclose([s[1][1] for s in segments], found.residuals.outputs["y"].inputs["u"].values)
    assert len(ftlm.plot.residuals(found.residuals).axes) == 2


def test_the_landscape_has_its_minimum_at_the_best_orders(found):
    figure = saved(ftlm.plot.landscape(found))
    ring = figure.axes[0].lines[0]
    assert (ring.get_xdata()[0], ring.get_ydata()[0]) == (found.orders["alpha"], found.orders["nu"])


def test_bode_is_the_frequency_response(found):
    w = np.geomspace(0.1, 100, 30)
    figure = saved(ftlm.plot.bode(found, w))
    exact = found.model.frequency_response(w)[0, 0]
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), 20 * np.log10(np.abs(exact)))
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), np.degrees(np.unwrap(np.angle(exact))))
    assert not figure.axes[0].collections
    fitted = ftlm.identify(found.task.runs, ftlm.equation("D^alpha y = a D^0.6 y + c y + b u"))
    assert ftlm.plot.bode(fitted).axes[0].collections  # its band


def test_what_cannot_be_drawn_is_said(found, small_model):
    for call, words in (
        (lambda: ftlm.plot.fit(small_model), "give runs"),
        (lambda: ftlm.plot.fit("x"), "result is str"),
        (lambda: ftlm.plot.residuals(replace(found, residuals=None)), "too short"),
        (lambda: ftlm.plot.residuals(3), "tests is int"),
        (lambda: ftlm.plot.landscape(replace(found, searches={})), "searched no lattice"),
        (lambda: ftlm.plot.landscape(found, "z"), "there is no search 'z'; there are y"),
        (lambda: ftlm.plot.landscape(found.model), "result is Model"),
        (lambda: ftlm.plot.bode(None), "model is NoneType"),
    ):
        with pytest.raises(ftlm.ModelError, match=words):
            call()


def test_without_matplotlib_the_way_out_is_named(found, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ftlm.ModelError, match=r"pip install 'ftlm\[plot\]'"):
        ftlm.plot.fit(found)


def test_nothing_is_imported_before_something_is_drawn():
    script = (
        "import sys, ftlm; ftlm.plot; assert 'matplotlib' not in sys.modules; assert 'pyplot' not in str(sys.modules)"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", script], check=True)
    with pytest.raises(AttributeError, match="no attribute 'plots'"):
        ftlm.plots  # noqa: B018


def test_the_command_writes_a_figure(found, small_run, tmp_path):
    found.model.save(tmp_path / "m.json")
    small_run.to_csv(tmp_path / "r.csv")

    def command(*words):
        return subprocess.run(
            [sys.executable, "-m", "ftlm", "plot", *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )

    ran = command("m.json", "r.csv", "-o", "fit.pdf")
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "fit.pdf").read_bytes().startswith(b"%PDF")
    assert command("m.json", "r.csv", "-o", "fit.pdf").returncode == 3
    assert command("m.json", "-o", "b.svg", "--kind", "bode").returncode == 0
    assert command("m.json", "r.csv", "-o", "b.png", "--kind", "residuals").returncode == 0
    assert command("m.json", "-o", "c.png").returncode == 2
    assert command("m.json", "r.csv", "-o", "c.exe").returncode == 2
