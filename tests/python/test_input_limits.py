"""Saturation and dead zone of inputs: simulations against SciPy's of limited inputs, estimates, messages."""

import json

import numpy as np
import pytest
from scipy import signal
from typer.testing import CliRunner

import ftlm
from ftlm import cli
from ftlm.report.typesetting import equation_html, parameter_table
from ftlm.structure.input_nonlinearity import InputNonlinearity
from slow_cases import slow_after

pytestmark = pytest.mark.usefixtures("no_extension_tests")

STEP = 0.05
MATRICES = (np.array([[0.0, 1.0], [-9.0, -1.2]]), np.array([[0.0], [4.5]]), np.eye(2)[:1], np.zeros((1, 1)))
SYSTEM = signal.cont2discrete(MATRICES, STEP)
PLANT = "D^2 y = -1.2 D y - 9 y + 4.5 {}"
FREE = "D^2 y = d D y + a y + b {}"
TRUTH = {"d": -1.2, "a": -9.0, "b": 4.5}


def bent(u, sat=np.inf, dead=0.0):
    """By hand: a dead zone, then a saturation."""
    out = np.zeros_like(u)
    for k, v in enumerate(u):
        beyond = abs(v) - dead
        out[k] = 0.0 if beyond <= 0 else np.sign(v) * min(beyond, sat)
    return out


def response(u):
    """SciPy's answer to an input that holds."""
    return signal.dlsim((*SYSTEM[:4], STEP), u)[1][:, 0]


def levels(rows, seed, size=1.0):
    rng = np.random.default_rng(seed)
    return size * np.repeat(rng.standard_normal(rows // 25 + 1), 25)[:rows]


def run_of(u, y, **options):
    return ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": y}, **options)


# ------------------------------------------------------------------------------------------------ known limits


@pytest.mark.parametrize(
    ("words", "options", "by_hand"),
    [
        ("sat(u, 0.8)", {}, {"sat": 0.8}),
        ("dead(u, 0.3)", {}, {"dead": 0.3}),
        ("sat(dead(u, 0.3), 0.8)", {}, {"sat": 0.8, "dead": 0.3}),
        ("u", {"saturation": {"u": 0.8}}, {"sat": 0.8}),
        ("u", {"dead_zone": {"u": 0.3}, "saturation": {"u": 0.8}}, {"sat": 0.8, "dead": 0.3}),
    ],
)
def test_a_free_run_is_scipys_of_the_input_bent_by_hand(words, options, by_hand):
    u = levels(400, 1)
    y = response(bent(u, **by_hand))
    model = ftlm.Model(ftlm.equation(PLANT.format(words), initial="rest", **options))
    np.testing.assert_allclose(model.simulate(run_of(u, 0 * y))["y"], y, atol=1e-6 * np.max(np.abs(y)))
    assert model.compare(run_of(u, y)).fit["y"] > 99.999
    # Data in is never changed.
    run = run_of(u, y)
    model.simulate(run)
    np.testing.assert_array_equal(run["u"], u)


def test_an_input_that_feeds_through_is_limited_at_once():
    u = levels(300, 2)
    y = response(bent(u, sat=0.5)) + 0.7 * bent(u, sat=0.5)
    words = "D^2 y = -1.2 D y - 9 y + 4.5 sat(u, 0.5) + 0.7 D^2 sat(u, 0.5) + 0.84 D sat(u, 0.5) + 6.3 sat(u, 0.5)"
    model = ftlm.Model(ftlm.equation(words, initial="rest"))
    np.testing.assert_allclose(model.simulate(run_of(u, 0 * y))["y"], y, atol=1e-5 * np.max(np.abs(y)))


def test_a_limit_before_a_delay():
    u = levels(300, 3)
    y = np.append(np.zeros(3), response(bent(u, sat=0.5))[:-3])
    model = ftlm.Model(ftlm.equation(PLANT.format("u"), saturation={"u": 0.5}, delay={"u": 3 * STEP}, initial="rest"))
    np.testing.assert_allclose(model.simulate(run_of(u, 0 * y))["y"], y, atol=1e-6 * np.max(np.abs(y)))
    assert "sat(u(t - 0.15 s), 0.5)" in str(model)


@pytest.mark.parametrize("method", ["least-squares", "instrumental-variables", "multi-innovation", "output-error"])
def test_every_method_reads_the_limited_input(method):
    u = levels(1200, 4)
    run = run_of(u, response(bent(u, sat=0.6)))
    limited = ftlm.identify(run, ftlm.equation(FREE.format("sat(u, 0.6)")), method=method)
    by_hand = ftlm.identify(run_of(bent(u, sat=0.6), run["y"]), ftlm.equation(FREE.format("u")), method=method)
    for name, value in by_hand.coefficients.items():
        assert limited.coefficients[name] == pytest.approx(value, rel=1e-9)
    assert limited.limits == {"sat_u": 0.6}


def test_rows_at_times_of_their_own_are_limited_too():
    rng = np.random.default_rng(5)
    times = STEP * (np.arange(500) + rng.uniform(-0.3, 0.3, 500))
    times[0] = 0.0
    u = levels(500, 5)
    options = {"time": times - times[0], "outputs": {"y": 0 * u}, "resample": STEP, "intersample": {"u": "zoh"}}
    given = ftlm.Run.from_arrays(inputs={"u": u}, **options)
    by_hand = ftlm.Run.from_arrays(inputs={"u": bent(u, dead=0.3)}, **options)
    found = ftlm.Model(ftlm.equation(PLANT.format("dead(u, 0.3)"), initial="rest")).simulate(given)["y"]
    other = ftlm.Model(ftlm.equation(PLANT.format("u"), initial="rest")).simulate(by_hand)["y"]
    np.testing.assert_allclose(found, other, atol=1e-9)


def test_an_input_that_is_linear_in_between_is_limited_at_its_samples():
    # The corners of what acts lie between samples: the error falls with the step's square, by lsim on a fine grid.
    errors = []
    for every in (64, 32, 16):
        t = np.arange(20 * 640 + 1) * STEP / 64
        u = 1.5 * np.sin(1.3 * t) + 0.4 * np.sin(4.1 * t)
        y = signal.lsim(signal.StateSpace(*MATRICES), np.clip(u, -0.8, 0.8), t)[1][::every]
        run = ftlm.Run.from_arrays(
            step=STEP * every / 64, inputs={"u": u[::every]}, outputs={"y": 0 * y}, intersample={"u": "foh"}
        )
        model = ftlm.Model(ftlm.equation(PLANT.format("sat(u, 0.8)"), initial="rest"))
        errors.append(float(np.max(np.abs(model.simulate(run)["y"] - y)) / np.max(np.abs(y))))
    assert errors[0] < 5e-3
    assert errors[2] < errors[0] / 8
    # Left free, it is found all the same.
    noisy = y + 0.01 * np.std(y) * np.random.default_rng(14).standard_normal(y.size)
    given = ftlm.Run.from_arrays(step=run.step, inputs={"u": run["u"]}, outputs={"y": noisy}, intersample={"u": "foh"})
    found = ftlm.identify(given, ftlm.equation(FREE.format("sat(u, 0.1:3)"), initial="rest"), threads=1)
    assert found.limits["sat_u"] == pytest.approx(0.8, abs=4 * found.standard_errors["sat_u"])
    assert found.standard_errors["sat_u"] < 0.01


# ------------------------------------------------------------------------------------------------ limits that are found


@pytest.mark.parametrize(
    ("words", "name", "value", "by_hand"),
    [
        ("sat(u, 0.1:5)", "sat_u", 0.8, {"sat": 0.8}),
        ("dead(u, 0:1)", "dead_u", 0.3, {"dead": 0.3}),
        ("sat(dead(u, 0.2), 0.1:5)", "sat_u", 0.7, {"sat": 0.7, "dead": 0.2}),
    ],
)
@slow_after(1, "seeds", [3, 12])
def test_a_limit_is_found_within_its_interval(words, name, value, by_hand, seeds):
    within = np.zeros(4)
    for seed in range(seeds):
        u = levels(600, 100 + seed)
        y = response(bent(u, **by_hand))
        noisy = y + 0.02 * np.std(y) * np.random.default_rng(seed).standard_normal(y.size)
        found = ftlm.identify(run_of(u, noisy), ftlm.equation(FREE.format(words), initial="rest"), threads=1)
        assert found.joint.converged
        for k, (n, v) in enumerate((TRUTH | {name: value}).items()):
            low, high = found.intervals[n]
            within[k] += low <= v <= high
        assert found.limits[name] == pytest.approx(value, abs=4 * found.standard_errors[name])
    # 95 % intervals of twelve seeds miss three or more of one number in two of a hundred cases.
    assert within.min() >= 0.75 * seeds - 0.5, within


def test_without_its_limit_the_plant_is_another():
    u = levels(600, 7)
    y = response(bent(u, sat=0.6))
    noisy = run_of(u, y + 0.01 * np.std(y) * np.random.default_rng(7).standard_normal(y.size))
    plain = ftlm.identify(noisy, ftlm.equation(FREE.format("u"), initial="rest"), threads=1)
    found = ftlm.identify(noisy, ftlm.equation(FREE.format("sat(u, 0.1:3)"), initial="rest"), threads=1)
    assert plain.fit["y"] < 90
    assert found.fit["y"] > 98
    u = levels(600, 8)
    other = run_of(u, response(bent(u, sat=0.6)))
    assert found.model.compare(other).fit["y"] > 99 > plain.model.compare(other).fit["y"]


def test_a_limit_is_found_where_rows_have_times_of_their_own():
    rng = np.random.default_rng(15)
    times = STEP * (np.arange(600) + np.append(0.0, rng.uniform(-0.05, 0.05, 599)))
    u = levels(600, 15)
    fine = np.repeat(bent(u, sat=0.6), 20)
    y = np.interp(
        times,
        np.arange(fine.size) * STEP / 20,
        signal.lsim(signal.StateSpace(*MATRICES), fine, np.arange(fine.size) * STEP / 20, interp=False)[1],
    )
    noisy = y + 0.02 * np.std(y) * rng.standard_normal(y.size)
    run = ftlm.Run.from_arrays(time=times, inputs={"u": u}, outputs={"y": noisy}, resample=STEP)
    found = ftlm.identify(run, ftlm.equation(FREE.format("sat(u, 0.1:3)"), initial="rest"), threads=1)
    assert found.limits["sat_u"] == pytest.approx(0.6, abs=0.03)


def test_a_limit_beside_friction_is_found():
    u = levels(800, 9, 3.0)
    cart = ftlm.Model(ftlm.equation("D^2 y = -1.0 D y + 1.0 sat(u, 1.7) - 0.5*sign(D y)", initial="rest"))
    y = cart.simulate(run_of(u, 0 * u))["y"]
    noisy = run_of(u, y + 0.002 * np.std(y) * np.random.default_rng(9).standard_normal(y.size))
    words = "D^2 y = -v D y + g sat(u, 0.2:5) - f*sign(D y)"
    found = ftlm.identify(noisy, ftlm.equation(words, initial="rest"), threads=1)
    for name, value in {"v": 1.0, "g": 1.0, "f": 0.5}.items():
        assert found.coefficients[name] == pytest.approx(value, abs=4 * found.standard_errors[name])
    assert found.limits["sat_u"] == pytest.approx(1.7, abs=4 * found.standard_errors["sat_u"])
    assert found.standard_errors["sat_u"] < 0.05


def test_a_limit_that_is_never_reached_is_said_not_to_be_seen():
    u = levels(400, 10)
    y = response(u)
    noisy = run_of(u, y + 0.02 * np.std(y) * np.random.default_rng(10).standard_normal(y.size))
    largest = float(np.max(np.abs(u)))
    words = FREE.format(f"sat(u, {1.5 * largest:.3f}:{3 * largest:.3f})")
    found = ftlm.identify(noisy, ftlm.equation(words, initial="rest"), threads=1)
    assert any(f.parameter == "sat_u" for f in found.findings)
    assert found.intervals["sat_u"] == (-np.inf, np.inf)
    for name, value in TRUTH.items():
        assert found.coefficients[name] == pytest.approx(value, abs=4 * found.standard_errors[name])


# ------------------------------------------------------------------------------------------------ words, files, pages


def test_words_are_printed_back():
    text = "D^2 y = d D^0.5 y + a y + b sat(dead(u, 0.05), 0.5:1.5)"
    structure = ftlm.equation(text)
    assert str(structure) == text
    assert structure.limits == (
        InputNonlinearity("u", "dead_zone", 0.05),
        InputNonlinearity("u", "saturation", (0.5, 1.5)),
    )
    assert ftlm.equation(str(structure)) == structure
    same = ftlm.equation("D^2 y = d D^0.5 y + a y + b u", dead_zone={"u": 0.05}, saturation={"u": (0.5, 1.5)})
    assert same == structure
    # A signal may be called like a law, as long as no bracket follows.
    assert ftlm.equation("D y = a y + b sat").signals == ("y", "sat")


def test_a_model_with_limits_is_kept(tmp_path):
    u = levels(400, 11)
    y = response(bent(u, sat=0.6))
    noisy = run_of(u, y + 0.02 * np.std(y) * np.random.default_rng(11).standard_normal(y.size))
    found = ftlm.identify(noisy, ftlm.equation(FREE.format("sat(u, 0.1:3)"), initial="rest"), threads=1)
    path = found.model.save(tmp_path / "model.json")
    written = json.loads(path.read_text())
    assert written["limits"] == [{"signal": "u", "kind": "saturation", "value": found.limits["sat_u"]}]
    again = ftlm.load_model(path)
    assert again == found.model
    np.testing.assert_array_equal(again.simulate(noisy)["y"], found.model.simulate(noisy)["y"])
    assert f"sat(u, {found.limits['sat_u']:.6g})" in str(found)
    html = str(equation_html(again.equations[0], limits=again.structure.limits))
    assert "<mi>sat</mi>" in html
    assert "saturation of u" in parameter_table(again, found.joint).to_html()
    text = found.report(tmp_path / "report.html").read_text()
    assert "saturation of" in text
    assert found.to_dict()["limits"] == found.limits


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        ("D y = a y + b sat(u, -1)", {}, "saturation of u = -1.0 is out of range; give a number above 0"),
        ("D y = a y + b sat(u)", {}, "expected ','"),
        ("D y = a y + b sat(u, 0)", {}, "saturation of u = 0.0 is out of range; give a number above 0"),
        ("D y = a y + b sat(u, 2:1)", {}, "from 2.0 to 1.0 is not an interval"),
        ("D y = a y + b sat(u, 1", {}, "expected '\\)'"),
        ("D y = a y + b sat(D u, 1)", {}, "the name of a signal"),
        ("D y = a y + b sat(u, 1) + c u", {}, "with and without its limit"),
        ("D y = a y + b sat(u, 1) + d D^0.5 sat(u, 2)", {}, "two saturations or two dead zones"),
        ("D y = a y + b dead(sat(u, 1), 0.1)", {}, "a dead zone acts before a saturation"),
        ("D y = a sat(y, 1) + b u", {}, "limited input"),
        ("D y = a y + b u", {"saturation": {"v": 1.0}}, "limited input"),
        ("D y = a y + b u", {"saturation": {"u": "much"}}, "saturation of u"),
        ("D y = a y + b u", {"saturation": {"u": (1, 2, 3)}}, r"has 3 values; give one, or \(minimum"),
        ("D y = a y + b u", {"dead_zone": {"u": (0, 1)}, "saturation": {"u": 2.0}}, "saturates after it"),
        (
            "D y = a y + b u",
            {"dead_zone": {"u": (0, 1)}, "saturation": {"u": (1, 2)}},
            "one parameter of an input",
        ),
        ("D y = a y + b u", {"saturation": {"u": (1, 2)}, "delay": {"u": 0.1}}, "has a delay"),
        ("D y = a y + b u", {"delay": {"u": "0:0.2"}}, r"is not a number; give seconds, or \(minimum, maximum\)"),
        ("D y = a y + b u", {"saturation": {"u": (1, 2)}, "delay": {"u": (0, 0.1)}}, "only one parameter of an input"),
        ("D y = a y + sat_u u", {"saturation": {"u": (1, 2)}}, "give the coefficient another name"),
    ],
)
def test_what_is_no_limit_is_refused_in_words(text, options, words):
    with pytest.raises(ftlm.ModelError, match=words):
        ftlm.equation(text, **options)


def test_what_does_not_know_limits_says_so():
    u = levels(200, 12)
    run = run_of(u, response(bent(u, sat=0.6)))
    free = ftlm.equation(FREE.format("sat(u, 0.1:3)"), initial="rest")
    with pytest.raises(ftlm.ModelError, match="only method='output-error' estimates limits"):
        ftlm.identify(run, free, method="least-squares")
    with pytest.raises(ftlm.ModelError, match="the saturation of u is still free"):
        ftlm.Model(free.with_coefficients(TRUTH))
    known = ftlm.Model(ftlm.equation(PLANT.format("sat(u, 0.6)")))
    for linear in (
        lambda: known.step_response(np.arange(9.0)),
        lambda: known.frequency_response([1.0]),
        lambda: known.to_control(band=(0.1, 10)),
    ):
        with pytest.raises(ftlm.ModelError, match="passes a saturation before it acts"):
            linear()


def test_the_command_line_limits_inputs(tmp_path):
    u = levels(600, 13)
    y = response(bent(u, sat=0.6))
    noisy = y + 0.01 * np.std(y) * np.random.default_rng(13).standard_normal(y.size)
    rows = np.column_stack([STEP * np.arange(u.size), u, noisy])
    file = tmp_path / "run.csv"
    np.savetxt(file, rows, delimiter=",", header="time,u,y", comments="")
    call = ["identify", str(file), "-u", "u", "-y", "y", "--structure", FREE.format("u"), "--json"]
    said = CliRunner().invoke(cli.app, [*call, "--saturation", "u=0.1:3"])
    assert said.exit_code == 0, said.output
    assert json.loads(said.stdout)["limits"]["sat_u"] == pytest.approx(0.6, abs=0.02)
    wrong = CliRunner().invoke(cli.app, [*call, "--dead-zone", "u=much"])
    assert wrong.exit_code == 2
    assert "--dead-zone u=much" in wrong.stderr
