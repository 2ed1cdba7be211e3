"""Models in other tools: python-control within its stated error, MATLAB and JSON text, frames; names stay inert."""

import contextlib
import json
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest

import ftlm
from ftlm import analysis as exports
from ftlm.analysis.rational_approximation import oustaloup
from ftlm.reproduction.simulated_arm import demo_plant

control = pytest.importorskip("control")
ONE = "D^1.6 y = -3 D^0.6 y - 8 y + 5 u"


def model(text, **options):
    return ftlm.Model(ftlm.equation(text, **options))


def test_oustaloups_filter_is_a_power_within_its_band():
    w = np.geomspace(1, 100, 50)
    roots, residues, gain = oustaloup(0.4, (1e-3, 1e5), 10)
    found = gain + np.sum(residues[:, None] / (1j * w + roots[:, None]), axis=0)
    np.testing.assert_allclose(found, (1j * w) ** 0.4, rtol=2e-3)


@pytest.mark.parametrize("text", [ONE, "D^2 y = -0.5 D y - 4 y + 3 u", "D^0.5 y = -y + 2 u + 0.5 D^0.5 u"])
def test_the_approximation_is_as_good_as_it_says(text):
    found = exports.approximate(model(text), band=(0.1, 100), order=7)
    w = np.geomspace(0.1, 100, 333)
    ratio = (found.frequency_response(w) / model(text).frequency_response(w))[0, 0]
    pair = ("y", "u")
    assert np.max(np.abs(20 * np.log10(np.abs(ratio)))) <= found.gain_error[pair] * 1.02 + 1e-6
    assert np.max(np.abs(np.degrees(np.angle(ratio)))) <= found.phase_error[pair] * 1.02 + 1e-6
    assert found.gain_error[pair] < 0.05
    assert found.phase_error[pair] < 0.5
    assert found.stable
    assert found.warnings == ()


def test_more_poles_come_closer():
    errors = [exports.approximate(model(ONE), band=(0.1, 100), order=n).gain_error["y", "u"] for n in (2, 4, 6)]
    assert errors[0] > 4 * errors[1] > 4 * errors[2]


def test_whole_orders_are_exact():
    found = exports.approximate(model("D^3 y = -6 D^2 y - 11 D y - 6 y + 2 D u"), band=(0.01, 100))
    assert found.state_count <= 6
    assert max(found.gain_error.values()) < 1e-9


@pytest.mark.parametrize("stage", [1, 2])
def test_the_arm_keeps_its_shape(stage):
    found = exports.approximate(demo_plant(stage, form="published"), band=(0.5, 60), order=7)
    assert max(found.gain_error.values()) < 0.5
    assert max(found.phase_error.values()) < 3
    assert found.outputs == demo_plant(stage, form="published").outputs


def test_python_control_simulates_the_model():
    one = model(ONE, delay={"u": 0.2})
    # Within 10 rad/s Padé's approximation of the delay is exact to the eye.
    system = one.to_control(band=(0.01, 10), order=7)
    assert isinstance(system, control.StateSpace)
    assert system.input_labels == ["u"]
    assert system.output_labels == ["y"]
    assert system.approximation.phase_error["y", "u"] < 1
    exact = model(ONE).to_control(band=(0.01, 1000), order=7)
    t = np.arange(0, 6, 0.01)
    found = control.step_response(exact, t).outputs
    np.testing.assert_allclose(found, model(ONE).step_response(t)[0, 0], atol=2e-3)
    delayed = control.step_response(system, t).outputs
    np.testing.assert_allclose(delayed[100:], one.step_response(t)[0, 0][100:], atol=5e-3)


def test_systems_of_python_control_become_models():
    rng = np.random.default_rng(5)
    w = np.geomspace(0.05, 50, 40)
    states = control.ss(
        rng.standard_normal((4, 4)) - 3 * np.eye(4),
        rng.standard_normal((4, 2)),
        rng.standard_normal((2, 4)),
        [[0, 0.5], [0, 0]],
        inputs=["force", "torque"],
        outputs=["x", "angle"],
    )
    made = ftlm.Model.from_control(states)
    assert list(made.outputs) == ["x", "angle"]
    np.testing.assert_allclose(made.frequency_response(w), states(1j * w), rtol=1e-9)
    fraction = control.tf([[[2, 1], [3]]], [[[1, 0.4, 9], [2, 4]]])
    both = ftlm.Model.from_control(fraction)
    assert str(both).startswith("D^3 y = ")
    np.testing.assert_allclose(both.frequency_response(w), np.reshape(fraction(1j * w), (1, 2, -1)), rtol=1e-10)
    one = ftlm.Model.from_control(control.tf([4], [1, 5, 40]), inputs=["u"], outputs=["speed"])
    assert str(one) == str(model("D^2 speed = -5 D speed - 40 speed + 4 u"))
    back = one.to_control(band=(0.1, 100))
    np.testing.assert_allclose(back(1j * w), control.tf([4], [1, 5, 40])(1j * w), rtol=1e-9)
    # A double integrator has one term; what rounding leaves of its other coefficients is none.
    cart = ftlm.Model.from_control(control.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]]))
    assert str(cart) == str(model("D^2 y = 1 u"))


def test_models_of_integer_orders_become_exact_transfer_functions_and_come_back():
    rng = np.random.default_rng(8)
    w = np.geomspace(0.05, 50, 12)
    for _ in range(60):
        order = int(rng.integers(1, 5))
        text = [f"D^{order} y = "]
        text += [f"{c:+.4f} D^{k} y " for k, c in enumerate(rng.standard_normal(order))]
        zeros = int(rng.integers(0, order + 1))
        text += [f"{c:+.4f} D^{k} {u} " for u in ("u", "v") for k, c in enumerate(rng.standard_normal(zeros + 1))]
        delay = {"u": round(rng.uniform(0.01, 0.5), 3)} if rng.random() < 0.5 else {}
        one = model("".join(text), delay=delay)
        if delay:
            with pytest.warns(UserWarning, match="the delay of u"):
                system = one.to_tf()
        else:
            system = one.to_tf()
        assert system.delay == delay
        late = np.exp(-1j * w * np.array([[delay.get("u", 0.0)], [0.0]]))
        exact = np.reshape(system(1j * w), (1, 2, -1)) * late
        np.testing.assert_allclose(exact, one.frequency_response(w), rtol=1e-12)
        with pytest.warns(UserWarning, match="the delay of u") if delay else contextlib.nullcontext():
            states = one.to_ss()
        assert states.nstates == order
        assert states.delay == delay
        np.testing.assert_allclose(np.reshape(states(1j * w), (1, 2, -1)) * late, one.frequency_response(w), rtol=1e-9)
        for made in (system, states):
            back = ftlm.Model.from_control(made)
            assert back.structure.delay == delay
            np.testing.assert_allclose(back.frequency_response(w), one.frequency_response(w), rtol=1e-8)
        renamed = ftlm.Model.from_control(system, inputs=["force", "torque"])
        assert renamed.structure.delay == {{"u": "force"}[name]: seconds for name, seconds in delay.items()}


def test_delays_of_a_system_that_are_not_by_input_are_refused():
    system = control.tf([1], [1, 1])
    for delay in (0.2, {"v": 0.2}):
        system.delay = delay
        with pytest.raises(ftlm.ModelError, match=r"attribute delay of the system is .*each of the inputs u\[0\]"):
            ftlm.Model.from_control(system)
    system.delay = {"u[0]": 0.2}
    assert ftlm.Model.from_control(system).structure.delay == {"u": 0.2}


def test_warnings_of_a_conversion_name_the_cause_and_show_the_line_of_the_caller():
    late = ftlm.transfer_function([1], [1, 1], 0.2)
    calls = {
        r"delay of u, 0\.2 s, is left out above 28\.5 rad/s": lambda: late.to_control(band=(0.1, 100)),
        "fractional orders have 3 poles each": lambda: model(ONE).to_control(band=(1e-4, 1e4), order=1),
        "the delay of u, 0.2 s, is not in the system": late.to_tf,
    }
    for words, call in calls.items():
        with pytest.warns(UserWarning, match=words) as caught:
            call()
        assert caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        late.to_control(band=(0.1, 28))


def test_a_band_is_needed_for_an_approximation_only():
    w = np.geomspace(0.01, 100, 30)
    exact = ftlm.transfer_function([1, 2], [1, 0.3, 4])
    np.testing.assert_allclose(exact.to_control()(1j * w), exact.frequency_response(w)[0, 0], rtol=1e-12)
    for one, reason in ((ftlm.transfer_function([1], [1, 1], 0.2), "the delay of u"), (model(ONE), "order")):
        with pytest.raises(ftlm.ModelError, match=rf"{reason}.*approximated within a frequency band; .*band="):
            one.to_control()


@pytest.mark.parametrize("delay", [0.0, 0.3, 0.04, 0.27])
def test_a_sampled_state_space_simulates_held_inputs_and_their_delays(delay):
    import control

    words = "D^2 y = -3 y - 0.6 D y + 2 z + 0.5 D^2 u + u\nD z = -z + 2 v - y"
    options = {"coupling": "simulated", "initial": "rest", "delay": {"u": delay} if delay else {}}
    one = ftlm.Model(ftlm.equation(words, **options))
    rng = np.random.default_rng(3)
    signals = {n: np.repeat(rng.standard_normal(20), 5) for n in "uv"}
    run = ftlm.Run.from_arrays(step=0.1, inputs=signals, outputs={n: np.zeros(100) for n in "yz"})
    exact = one.simulate(run)
    system = one.to_ss(step=0.1)
    assert system.nstates == 3 + int(np.ceil(delay / 0.1 - 1e-9))
    assert system.dt == 0.1
    found = control.forced_response(system, inputs=np.stack([signals[n] for n in system.input_labels]))
    for k, name in enumerate(system.output_labels):
        np.testing.assert_allclose(found.outputs[k], exact[name], atol=1e-8)


def test_a_state_space_carries_the_sensor_filter_and_refuses_what_it_is_not():
    w = np.geomspace(0.1, 100, 9)
    seen = model("D^2 y = -D y - 4 y + u", sensor_filter=ftlm.SensorFilter.low_pass(["y"]))
    np.testing.assert_allclose(seen.to_ss()(1j * w), seen.frequency_response(w)[0, 0], rtol=1e-10)
    for text, options, words in (
        ("D^1.5 y = -y + u", {}, r"order 1\.5 is not a whole number"),
        ("D^2 y = -D y + u - sign(D y)", {}, "has friction"),
        ("D y = -y + u", {"sensor_filter": ftlm.SensorFilter.low_pass(["u"])}, "the input u has a sensor filter"),
    ):
        with pytest.raises(ftlm.ModelError, match=words):
            model(text, **options).to_ss()
    with pytest.raises(ftlm.DataError, match="step"):
        seen.to_ss(step=-1.0)


def test_a_transfer_function_carries_the_sensor_filter_and_refuses_what_it_is_not():
    w = np.geomspace(0.1, 100, 9)
    seen = model("D^2 y = -D y - 4 y + u", sensor_filter=ftlm.SensorFilter.low_pass(["y"]))
    np.testing.assert_allclose(seen.to_tf()(1j * w), seen.frequency_response(w)[0, 0], rtol=1e-12)
    with pytest.raises(ftlm.ModelError, match=r"order 1\.5 is not a whole number .*to_control with band="):
        model("D^1.5 y = -y + u").to_tf()
    with pytest.raises(ftlm.ModelError, match="the input u has a sensor filter"):
        model("D y = -y + u", sensor_filter=ftlm.SensorFilter.low_pass(["u"])).to_tf()


@pytest.mark.parametrize(
    ("system", "options", "words"),
    [
        (control.tf([1], [1, 0.5], 0.1), {}, "sampled"),
        (control.tf([3], [1]), {}, "order 0"),
        (3.0, {}, "float is not a system"),
        (control.tf([1, 0, 0], [1, 1]), {}, "more zeros than poles"),
        (control.tf([0], [1, 1]), {}, "order 0"),
        (control.tf([1], [1, 1]), {"inputs": ["a", "b"]}, "2 names are given"),
        (control.tf([1], [1, 1]), {"inputs": ["y"]}, "name of both an input and an output"),
        (control.tf([1], [1, 1]), {"inputs": ["a b"]}, "a b"),
        (control.frd([1, 2, 3], [1, 2, 3]), {}, "FrequencyData"),
        (control.tf([1], np.poly(-np.arange(1, 12))), {}, "order 11"),
    ],
)
def test_systems_that_are_no_equations_are_refused(system, options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.Model.from_control(system, **options)


def test_a_poor_approximation_warns_about_margins():
    with pytest.warns(UserWarning, match="smaller gain and phase margins are meaningless"):
        system = model(ONE).to_control(band=(1e-4, 1e4), order=1)
    assert system.approximation.warnings
    assert "warning" in str(system.approximation)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"band": (0, 1)}, "is not an interval"),
        ({"band": (2, 1)}, "is not an interval"),
        ({"band": 3}, "not a pair"),
        ({"band": (1, np.inf)}, "is not an interval"),
        ({"band": (1, 2, 3)}, "not a pair"),
        ({"band": (1, 2), "order": 0}, "not a whole number from 1 to 50"),
        ({"band": (1, 2), "order": 51}, "not a whole number from 1 to 50"),
    ],
)
def test_bands_and_orders_that_are_none_are_refused(options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        model(ONE).to_control(**options)


def test_without_python_control_the_way_out_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "control", None)
    with pytest.raises(ftlm.ModelError, match=r"pip install 'ftlm\[control\]'"):
        model(ONE).to_control(band=(1, 10))


# ------------------------------------------------------------------------------------------------ text


def test_json_holds_the_quotients():
    one = model("D^1.5 y = -2 D^0.5 y - 4 y + 3 D^0.2 u", delay={"u": 0.1})
    document = json.loads(exports.json_text(one))
    assert document["denominator"]["y"] == [[1.0, 1.5], [2.0, 0.5], [4.0, 0.0]]
    assert document["numerator"]["y"]["u"] == [[3.0, 0.2]]
    assert document["delay_s"] == {"u": 0.1}


def test_matlab_text_holds_the_quotients():
    text = exports.matlab_text(demo_plant(1, form="published"))
    found = dict(re.findall(r"^(\w+\.\w+) = \[?([^\];]*)\]?;$", text, re.MULTILINE))
    w = np.array([0.7, 5.0])
    s = 1j * w
    exact = demo_plant(1, form="published").frequency_response(w)
    for i, output in enumerate(("theta11", "theta12")):
        read = {k: [float(v) for v in found[f"G_{output}_I1.{k}"].split()] for k in ("b", "nb", "a", "na")}
        top = sum(c * s**p for c, p in zip(read["b"], read["nb"], strict=True))
        bottom = sum(c * s**p for c, p in zip(read["a"], read["na"], strict=True))
        np.testing.assert_allclose(top / bottom, exact[i, 0], rtol=1e-9)
    assert "fotf(G_theta11_I1.a, G_theta11_I1.na, G_theta11_I1.b, G_theta11_I1.nb, G_theta11_I1.delay)" in text


def test_the_python_script_runs_without_ftlm(tmp_path):
    script = exports.control_text(model(ONE), band=(0.1, 100)) + "print(abs(system(2j)))\n"
    ran = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "import ftlm" not in script
    assert float(ran.stdout) == pytest.approx(abs(model(ONE).frequency_response([2.0])[0, 0, 0]), rel=5e-3)


def test_hostile_names_stay_in_comments():
    from dataclasses import replace

    name = "x\nimport os; os.abort()\r\u2028system('rm')\n% \x1b[31m"
    hostile = ftlm.Model(replace(ftlm.equation(ONE), name=name))
    for mark, text in (("%", exports.matlab_text(hostile)), ("#", exports.control_text(hostile, band=(1, 10)))):
        for line in text.splitlines():
            if "abort" in line or "rm')" in line:
                assert line.startswith(mark) or "name='x_import_os" in line, line
        assert "\x1b" not in text
    assert json.loads(exports.json_text(hostile))["name"] == name


def test_other_tools_and_a_missing_band_are_refused():
    with pytest.raises(ftlm.ModelError, match="give the frequency band"):
        exports.export_text(model(ONE), "control")
    with pytest.raises(ftlm.ModelError, match="use 'control', 'matlab' or 'json'"):
        exports.export_text(model(ONE), "excel")


# ------------------------------------------------------------------------------------------------ frames


def test_results_become_frames(small_run, with_noise):
    run = with_noise(small_run, 0.01, 1)
    words = "D^alpha y = a D^0.6 y + c y + b u"
    fit = ftlm.identify(run, ftlm.equation(words))
    frame = fit.to_frame()
    assert list(frame.index) == ["alpha", "a", "c", "b"]
    assert frame.loc["alpha", "value"] == fit.orders["alpha"]
    assert frame.loc["a", "low"] == fit.intervals["a"][0]
    errors = fit.comparison.to_frame()
    assert errors.loc[(run.name, "y", "output error"), "fit"] == fit.fit["y"]
    search = ftlm.identify(run, ftlm.equation(words, orders={"alpha": "1.4:1.8:0.1"}), method="least-squares")
    table = search.searches["y"].to_frame()
    assert table.iloc[0]["alpha"] == search.orders["alpha"]
    assert table.index[0] == search.searches["y"].table[0].rank


def test_without_pandas_the_way_out_is_named(small_model, small_run, monkeypatch):
    found = small_model.compare(small_run)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ftlm.ModelError, match="pip install pandas"):
        found.to_frame()
