"""Figures for papers hold the numbers of the results, touch no global state, and name what is missing."""

import io
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import ftlm
from command_line import run_command
from ftlm import cli

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
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=60)
    assert data.getvalue().startswith(b"\x89PNG")
    return figure


def test_a_fit_is_the_comparison(found, small_run):
    figure = saved(ftlm.plot.fit(found))
    assert figure._repr_png_().startswith(b"\x89PNG")  # a notebook shows it
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
    tests = found.residuals.outputs["y"]
    assert [a.get_title() for a in figure.axes] == [
        f"Residual of y with itself, {tests.whiteness.verdict}",
        f"Residual of y with u, {tests.inputs['u'].verdict}",
    ]
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
        (lambda: ftlm.plot.fit("x"), "is a str; give Identification or Model"),
        (lambda: ftlm.plot.residuals(replace(found, residuals=None)), "too short"),
        (lambda: ftlm.plot.residuals(3), "tests = 3 is an int; give Residuals"),
        (lambda: ftlm.plot.landscape(replace(found, searches={})), "has no order search"),
        (lambda: ftlm.plot.landscape(found, "z"), "there is no order search 'z'; the searches are y"),
        (lambda: ftlm.plot.landscape(found.model), "is a Model; give Identification or Landscape"),
        (lambda: ftlm.plot.bode(None), "model = None is a NoneType; give Model"),
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
        return run_command("plot", *words, cwd=tmp_path)

    ran = command("m.json", "r.csv", "-o", "fit.pdf")
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "fit.pdf").read_bytes().startswith(b"%PDF")
    assert command("m.json", "r.csv", "-o", "fit.pdf").returncode == 3
    assert command("m.json", "-o", "b.svg", "--kind", "bode").returncode == 0
    assert command("m.json", "r.csv", "-o", "b.png", "--kind", "residuals").returncode == 0
    assert command("m.json", "-o", "c.png").returncode == 2
    assert command("m.json", "r.csv", "-o", "c.exe").returncode == 2


# ----------------------------------------------------------------------------------------------------------------------
# Pictures that people look for


@pytest.fixture(scope="module")
def joint(small_run, with_noise):
    return ftlm.identify(with_noise(small_run, 0.02, 1), ftlm.equation("D^1.6 y = a D^0.8 y + c y + b u"))


def test_a_run_has_its_inputs_below_its_outputs(small_run):
    figure = saved(ftlm.plot.run(small_run))
    assert [a.get_ylabel() for a in figure.axes] == ["y [rad]", "u [A]"]
    np.testing.assert_array_equal(figure.axes[1].lines[0].get_ydata(), small_run["u"])
    drawn = small_run.plot()
    assert str(drawn).splitlines() == [f"y, output of {small_run.name}", f"u, input of {small_run.name}"]
    assert drawn._repr_html_().count("<figure>") == 2
    assert len(small_run.plot("u")) == 1
    with pytest.raises(ftlm.errors.DataError, match="signal 'v' is not in run"):
        small_run.plot("v")


def test_a_fit_has_its_inputs_where_they_are_asked_for(joint, small_run):
    figure = saved(ftlm.plot.fit(joint, inputs=True))
    assert [a.get_ylabel() for a in figure.axes] == ["y [rad]", "residual", "u [A]"]
    assert len(ftlm.plot.fit(joint.model, [small_run, small_run], inputs=True).axes) == 6
    with pytest.raises(ftlm.errors.ModelError, match="there are no runs"):
        ftlm.plot.fit(joint.comparison, inputs=True)


def test_poles_are_those_of_the_model(joint):
    axis = saved(ftlm.plot.poles(joint)).axes[0]
    crosses = next(line for line in axis.lines if line.get_marker() == "x")
    poles = [m.pole**0.8 for m in joint.model.modes() if m.oscillatory]
    plotted = crosses.get_xdata() + 1j * crosses.get_ydata()
    assert plotted[np.argmax(plotted.imag)] == pytest.approx(poles[0])
    assert "s^{0.8}" in axis.get_xlabel()
    with pytest.raises(ftlm.errors.ModelError, match="no poles to draw"):
        ftlm.plot.poles(ftlm.Model(ftlm.equation("D^2 y = -3 D y + 6 u - 0.5*sign(D y)")))


def test_steps_have_their_bands(joint):
    axis = saved(ftlm.plot.step(joint)).axes[0]
    answer = joint.model.step()
    np.testing.assert_allclose(axis.lines[0].get_ydata(), answer.values[0, 0])
    edge = axis.collections[0].get_paths()[0].vertices[:, 1]
    assert edge.max() == pytest.approx(np.max(answer.values[0, 0] + 1.959964 * answer.deviation[0, 0]), rel=1e-6)
    assert saved(ftlm.plot.impulse(joint.model)).axes[0].lines[0].get_ydata().size == 400


def test_correlations_are_those_of_the_fit(joint):
    axis = saved(ftlm.plot.correlation(joint)).axes[0]
    np.testing.assert_array_equal(axis.images[0].get_array(), joint.joint.correlation)
    assert len(axis.texts) == 6
    with pytest.raises(ftlm.errors.ModelError, match="gives no joint covariance"):
        ftlm.plot.correlation(replace(joint, joint=None))


def test_residuals_over_time_and_how_often(joint):
    left, right = saved(ftlm.plot.residual_series(joint)).axes
    missed = joint.comparison.measured["y"][0] - joint.comparison.simulated["y"][0]
    np.testing.assert_array_equal(left.lines[0].get_ydata(), missed)
    assert sum(p.get_height() for p in right.patches) == missed.size


def test_models_side_by_side(joint, found):
    figure = saved(ftlm.plot.models({"one": joint.comparison, HOSTILE: found.comparison}))
    widths = [p.get_width() for p in figure.axes[0].patches]
    assert widths == pytest.approx([joint.fit["y"], found.fit["y"]])
    other = replace(joint.comparison, output_error={"z": joint.output_error["y"]})
    with pytest.raises(ftlm.errors.ModelError, match="has the outputs z"):
        ftlm.plot.models({"one": joint.comparison, "two": other})


def test_every_picture_draws_into_axes_that_are_given(joint, small_run):
    from matplotlib.figure import Figure

    plot, model = ftlm.plot, joint.model
    pictures = [
        (lambda ax: plot.fit(joint, ax=ax), 2),
        (lambda ax: plot.residuals(joint, ax=ax), 2),
        (lambda ax: plot.bode(model, ax=ax), 2),
        (lambda ax: plot.poles(model, ax=ax), 1),
        (lambda ax: plot.step(model, ax=ax), 1),
        (lambda ax: plot.impulse(model, ax=ax), 1),
        (lambda ax: plot.run(small_run, ax=ax), 2),
        (lambda ax: plot.correlation(joint, ax=ax), 1),
        (lambda ax: plot.residual_series(joint, ax=ax), 2),
        (lambda ax: plot.models({"a": joint.comparison}, ax=ax), 1),
    ]
    for draw, count in pictures:
        figure = Figure()
        axes = figure.subplots(1, count)
        assert draw(axes) is figure
        assert all(a.has_data() for a in np.atleast_1d(axes))
        with pytest.raises(ftlm.errors.ModelError, match=rf"this figure has {count} axes .* ax has {count + 1}"):
            draw(Figure().subplots(1, count + 1))
        with pytest.raises(ftlm.errors.ModelError, match="ax contains an object of type str, not matplotlib axes"):
            draw("axes")


@pytest.mark.parametrize("bad", [None, 3, "model", []])
def test_what_is_nothing_to_draw_is_refused(bad):
    plot = ftlm.plot
    for draw in (
        plot.fit,
        plot.residuals,
        plot.bode,
        plot.poles,
        plot.step,
        plot.impulse,
        plot.run,
        plot.correlation,
        plot.residual_series,
        plot.models,
    ):
        with pytest.raises(ftlm.errors.ModelError):
            draw(bad)


def test_every_kind_is_drawn_by_the_command(joint, small_run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    joint.model.save("m.json")
    small_run.to_csv("r.csv")
    for kind, runs in (("poles", []), ("step", []), ("impulse", []), ("series", ["r.csv"]), ("fit", ["r.csv"])):
        ran = CliRunner().invoke(cli.app, ["plot", "m.json", *runs, "-o", f"{kind}.svg", "--kind", kind])
        assert ran.exit_code == 0, ran.output
        assert "<svg" in Path(f"{kind}.svg").read_text("utf-8")
    assert CliRunner().invoke(cli.app, ["plot", "m.json", "-o", "x.svg", "--kind", "series"]).exit_code == 2
