"""Free runs: against dense solves, closed forms and explicit Euler; coupling, refinement, initial terms, failures."""

import re
from dataclasses import replace
from math import gamma

import numpy as np
import pytest

import ftlm
import oracles
from ftlm import _core
from ftlm.simulation.discretization import record
from ftlm.simulation.simulate import comparison_records, simulate_record


def zeros_run(n=301, step=0.02, inputs=None, outputs=("y",), **options):
    u = np.where(np.arange(n) % 90 < 50, 1.0, -0.6)
    given = {"u": u} if inputs is None else inputs
    return ftlm.Run.from_arrays(step=step, inputs=given, outputs={o: np.zeros(n) for o in outputs}, **options)


def model(text, coupling="measured", **options):
    return ftlm.Model(replace(ftlm.equation(text, **options), coupling=coupling))


TWO = "D^1.7 y = -20 y - 2 D^0.7 y + 15 z + 10 u; D^1.2 z = -5 z + 3 D^0.4 y + u"

# ----------------------------------------------------------------------------------------------------------------------
# Against the oracles


@pytest.mark.parametrize("m", [100, 300, 301 * 2])
def test_one_equation_is_the_dense_solve(m):
    run = zeros_run()
    truth = model("D^1.6 y = -3 D^0.6 y - 8 y + 5 D^0.2 u + 2 u")
    duration = run.duration
    rec = record(run, truth.structure, m)
    found = _core.respond(
        rec.core(), [((0, 1.6, [(0, 0.6), (0, 0.0), (1, 0.2), (1, 0.0)]), [-3, -8, 5, 2])], [False, True], [[]]
    )[0]
    u = oracles.pulse_means(run["u"], m, "zoh")
    dense = oracles.free_run([(-3, 0.6), (-8, 0.0)], [(5, 0.2, u), (2, 0.0, u)], 1.6, m, duration)
    np.testing.assert_allclose(found, dense, atol=1e-11 * np.abs(dense).max())


@pytest.mark.parametrize("m", [64, 200])
def test_coupled_equations_are_the_dense_solve(m):
    run = zeros_run(n=201, outputs=("y", "z"))
    coupled = model(TWO, "simulated")
    (rec,) = comparison_records([run], coupled, m)
    responses, _ = simulate_record(coupled, rec)
    u = oracles.pulse_means(run["u"], m, "zoh")
    described = [
        {
            "output": e.output,
            "alpha": e.order.constant,
            "terms": [{"signal": t.signal, "coefficient": t.fixed_value, "order": t.order.constant} for t in e.terms],
        }
        for e in coupled.equations
    ]
    dense = oracles.coupled_free_run(described, {"u": u}, m, run.duration)
    for name in ("y", "z"):
        np.testing.assert_allclose(responses[name], dense[name], atol=1e-10 * np.abs(dense[name]).max())


@pytest.mark.parametrize("alpha", [0.2, 0.5, 0.9, 1.1, 1.6, 2.0])
def test_step_response_of_any_order_converges(alpha):
    # D^alpha y = -y + u with u = 1: 1 - E_alpha(-t^alpha), by its power series.
    found = model(f"D^{alpha} y = -y + u").simulate(zeros_run(n=101, inputs={"u": np.ones(101)}), tolerance=1e-8)["y"]
    for k in (1, 10, 50, 100):
        x = (k * 0.02) ** alpha
        exact = -sum((-x) ** j / gamma(alpha * j + 1) for j in range(1, 160) if alpha * j < 169)
        assert found[k] == pytest.approx(exact, abs=2e-7)
    assert found[0] == 0.0


def test_integer_orders_are_a_special_case():
    # y'' = -4 y' - 13 y + 13 u, u = 1: damped oscillation in closed form.
    found = model("D^2 y = -4 D y - 13 y + 13 u").simulate(zeros_run(inputs={"u": np.ones(301)}), tolerance=1e-9)["y"]
    t = np.arange(301) * 0.02
    exact = 1 - np.exp(-2 * t) * (np.cos(3 * t) + 2 / 3 * np.sin(3 * t))
    np.testing.assert_allclose(found, exact, atol=1e-9)


def test_negative_order_of_an_input_integrates_it():
    # D^1.5 y = -y + D^-0.5 u, u = 1: sum of (-1)^j t^(1.5 j + 2)/Gamma(1.5 j + 3).
    found = model("D^1.5 y = -y + D^-0.5 u").simulate(zeros_run(inputs={"u": np.ones(301)}), tolerance=1e-8)["y"]
    t = np.arange(301) * 0.02
    exact = sum((-1) ** j * t ** (1.5 * j + 2) / gamma(1.5 * j + 3) for j in range(60))
    np.testing.assert_allclose(found, exact, atol=1e-7 * exact.max())


# ----------------------------------------------------------------------------------------------------------------------
# Refinement


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5, 1e-7])
def test_the_response_is_as_close_as_asked(small_model, small_run, tolerance):
    found = small_model.simulate(small_run, tolerance=tolerance)["y"]
    best = small_model.simulate(small_run, tolerance=1e-10)["y"]
    assert np.max(np.abs(found - best)) <= tolerance * np.max(np.abs(best))


def test_the_result_is_a_run_like_the_one_given(small_model):
    run = ftlm.Run.from_arrays(
        step=0.02,
        inputs={"u": np.ones(50), "v": np.ones(50)},
        outputs={"y": np.ones(50), "w": np.ones(50)},
        units={"u": "mA", "w": "V"},
        intersample={"u": "foh"},
        name="measured",
    )
    found = ftlm.simulate(small_model, run)
    assert found.inputs == ("u", "v")
    assert found.outputs == ("y",)
    assert (found.step, found.length, found.name) == (0.02, 50, "measured, simulated")
    assert found.intersample == {"u": "foh", "v": "zoh"}
    # The model's units for what it makes, the run's for what it is given.
    assert found.units == {"u": "A", "v": "", "y": "rad"}
    np.testing.assert_array_equal(found["u"], run["u"])
    np.testing.assert_array_equal(run["y"], 1.0)


def test_measured_values_of_the_output_are_not_used(small_model, small_run):
    other = ftlm.Run.from_arrays(
        step=small_run.step, inputs={"u": small_run["u"]}, outputs={"y": 7 + np.random.default_rng(1).random(513)}
    )
    np.testing.assert_array_equal(small_model.simulate(other)["y"], small_model.simulate(small_run)["y"])
    without = ftlm.Run.from_arrays(step=small_run.step, inputs={"u": small_run["u"]}, outputs={"w": np.zeros(513)})
    np.testing.assert_array_equal(small_model.simulate(without)["y"], small_model.simulate(small_run)["y"])


def test_a_sample_belongs_to_its_instant_after_the_command_has_acted():
    run = zeros_run(inputs={"u": np.full(50, 3.0)}, n=50)
    through = model("D^1.5 y = -y + 2 D^1.5 u").simulate(run)["y"]  # direct feed-through of a held input
    assert through[0] == pytest.approx(6.0)
    assert through[1] == pytest.approx(6.0, rel=0.05)
    assert model("D^1.5 y = -y + 2 u").simulate(run)["y"][0] == 0.0  # without one, what integrates starts at rest
    measured = zeros_run(inputs={"u": np.full(50, 3.0)}, n=50, intersample={"u": "foh"})
    assert model("D^1.5 y = -y + 2 D^1.5 u").simulate(measured)["y"][0] == pytest.approx(6.0)


def test_first_sample_is_what_initial_terms_feed_through_and_filter_make_it():
    run = zeros_run(inputs={"u": np.zeros(41)}, n=41, outputs=("y", "z"))
    text = "D^2 y = -4 y + 0.5 D^2 z + u; D^1.5 z = -2 z"
    start = {"z": {0.0: 2.0}, "y": {0.0: 3.0}}
    coupled = model(text, "simulated").simulate(run, initial=start, tolerance=1e-5)
    assert (coupled["z"][0], coupled["y"][0]) == (pytest.approx(2.0), pytest.approx(4.0))
    assert coupled["y"][1] == pytest.approx(4.0, abs=0.2)
    # A lead (2 D + 1)/(D + 1) passes what is there at once, doubled.
    lead = ftlm.SensorFilter(("z",), ((2.0, 1.0), (1.0, 0.0)), ((1.0, 1.0), (1.0, 0.0)))
    filtered = model(text, "simulated", sensor_filter=lead).simulate(run, initial=start, tolerance=1e-5)
    assert (filtered["z"][0], filtered["y"][0]) == (pytest.approx(4.0), pytest.approx(4.0))
    assert filtered["z"][1] == pytest.approx(4.0, abs=0.2)


# ----------------------------------------------------------------------------------------------------------------------
# Coupling


def test_measured_and_simulated_coupling_of_the_truth_agree():
    run = zeros_run(outputs=("y", "z"), n=601, step=0.01)
    made = model(TWO, "simulated").simulate(run, tolerance=1e-8)
    driven = model(TWO, "measured").simulate(made, tolerance=1e-6)
    for name in ("y", "z"):
        # The measured other output is linear between samples, hence not exactly the one simulated.
        assert ftlm.metrics(made[name], driven[name]).fit > 99.9


def test_measured_coupling_needs_the_other_output():
    run = zeros_run(outputs=("y",))
    with pytest.raises(ftlm.DataError, match="run 'run' has no signal 'z', which enters the equation of y as measured"):
        model(TWO, "measured").simulate(run)
    assert model(TWO, "simulated").simulate(run).outputs == ("y", "z")


def test_sensor_filter_acts_on_simulated_outputs_alone():
    sensor = ftlm.SensorFilter.low_pass(["z"], frequency=1.0)
    run = zeros_run(outputs=("y", "z"), n=401, step=0.01)
    bare, filtered = (model(TWO, "simulated", sensor_filter=s).simulate(run, tolerance=1e-8) for s in (None, sensor))
    np.testing.assert_array_equal(filtered["y"], bare["y"])
    omega = 2 * np.pi
    through = model(f"D^2 f = {-1.8 * omega} D f - {omega**2} f + {omega**2} z")
    again = ftlm.Run.from_arrays(
        step=0.01, inputs={"z": bare["z"]}, outputs={"f": np.zeros(401)}, intersample={"z": "foh"}
    )
    # z is linear between samples here, which rounds its kinks.
    expected = through.simulate(again, tolerance=1e-8)["f"]
    np.testing.assert_allclose(filtered["z"], expected, atol=2e-4 * np.abs(expected).max())


# ----------------------------------------------------------------------------------------------------------------------
# Initial terms


def test_initial_terms_are_added():
    run = zeros_run(inputs={"u": np.zeros(301)})
    t = np.arange(301) * 0.02
    relaxing = model("D^1 y = -2 y + u").simulate(run, initial={"y": {0.0: 3.0}}, tolerance=1e-8)["y"]
    np.testing.assert_allclose(relaxing, 3 * np.exp(-2 * t), atol=3e-7)
    swinging = model("D^2 y = -9 y + u").simulate(run, initial={"y": {0.0: 1.0, 1.0: -6.0}}, tolerance=1e-8)["y"]
    np.testing.assert_allclose(swinging, np.cos(3 * t) - 2 * np.sin(3 * t), atol=3e-7)


def test_initial_terms_of_nothing_are_refused(small_model, small_run):
    with pytest.raises(ftlm.ModelError, match="initial terms of 'z', which is no output of the model; give those of y"):
        small_model.simulate(small_run, initial={"z": {0.0: 1.0}})
    with pytest.raises(ftlm.ModelError, match=r"exponent -2 of an initial term is outside \(-1, 10\]"):
        small_model.simulate(small_run, initial={"y": {-2.0: 1.0}})


# ----------------------------------------------------------------------------------------------------------------------
# Failures


def test_an_unstable_model_says_when_it_leaves_the_range_of_numbers():
    run = zeros_run(n=2001, step=0.1)
    with pytest.raises(ftlm.ConvergenceError) as refused:
        model("D^1 y = 5 y + u").simulate(run)
    # e^(5 t) overflows after 142 s.
    found = re.fullmatch(
        r"the simulation of y overflows ([\d.]+) s into run 'run'; the model is unstable: .*",
        str(refused.value),
    )
    assert float(found[1]) == pytest.approx(142, abs=2)


def test_a_response_that_does_not_stand_still_says_so():
    with pytest.raises(
        ftlm.ConvergenceError, match=r"still changes by more than 1e-12 of its size at 2400 pulses; raise"
    ):
        model("D^0.5 y = -3 y + u").simulate(zeros_run(), tolerance=1e-12, max_m=3000)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0}, "tolerance = 0 is not positive"),
        ({"tolerance": -1e-6}, "tolerance = -1e-06 is not positive"),
        ({"tolerance": float("nan")}, "tolerance = nan is not positive"),
        ({"tolerance": "small"}, "tolerance = 'small' is not a number"),
        ({"max_m": 100}, "run 'small, simulated' has 512 intervals, more than 100; slice it"),
    ],
)
def test_options_out_of_range_are_refused(small_model, small_run, options, message):
    with pytest.raises(ftlm.ModelError) as refused:
        small_model.simulate(small_run, **options)
    assert message in str(refused.value)


def test_what_is_no_model_and_no_run_is_refused(small_model, small_run):
    with pytest.raises(ftlm.ModelError, match="model is Structure, not a Model"):
        ftlm.simulate(small_model.structure, small_run)
    with pytest.raises(ftlm.DataError, match="run is ndarray, not a Run"):
        ftlm.simulate(small_model, small_run["y"])
    with pytest.raises(ftlm.DataError, match="has no signal 'u', which the model needs"):
        small_model.simulate(ftlm.Run.from_arrays(step=0.1, inputs={}, outputs={"y": np.zeros(9)}))


def test_an_equation_that_cannot_be_solved_for_its_output_is_refused():
    # Each output is the other, at the same order.
    with pytest.raises(ftlm.ModelError, match="leading matrix of the equations is singular"):
        model("D^2 y = D^2 z; D^2 z = D^2 y", "simulated").simulate(zeros_run(outputs=("y", "z")))


# ----------------------------------------------------------------------------------------------------------------------
# Explicit Euler


def test_explicit_euler_is_the_loop_that_it_says():
    run = zeros_run(n=200, outputs=("y", "z"))
    whole = model("D^2 y = -13 y - 4 D y + 2 z + 13 u; D z = -z + 0.5 y", "simulated")
    found = ftlm.explicit_euler(whole, run)
    y = v = z = 0.0
    for k in range(200):
        assert found["y"][k] == pytest.approx(y, abs=1e-12)
        assert found["z"][k] == pytest.approx(z, abs=1e-12)
        acceleration = -13 * y - 4 * v + 2 * z + 13 * run["u"][k]
        y, v, z = y + 0.02 * v, v + 0.02 * acceleration, z + 0.02 * (-z + 0.5 * y)


def test_explicit_euler_tends_to_the_exact_response_as_the_step_shrinks():
    errors = []
    for step in (0.01, 0.005, 0.0025):
        n = round(4 / step) + 1
        run = zeros_run(n=n, step=step, inputs={"u": np.ones(n)})
        whole = model("D^2 y = -13 y - 4 D y + 13 u")
        errors.append(np.max(np.abs(ftlm.explicit_euler(whole, run)["y"] - whole.simulate(run)["y"])))
    assert errors[2] < 0.01
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(2, rel=0.1)


def test_explicit_euler_of_the_manual_model(drive):
    # The paper's baseline: 2 ms steps, both stages.
    for stage, name in ((1, "A"), (2, "A2")):
        run = drive(name, samples=1001)
        manual = ftlm.link_model(stage=stage, form="published")
        euler, exact = ftlm.explicit_euler(manual, run), manual.simulate(run, tolerance=1e-5)
        hub = f"theta{stage}1"
        assert ftlm.metrics(exact[hub], euler[hub]).fit > 90


@pytest.mark.parametrize("text", ["D^1.5 y = -y + u", "D^2 y = -y + D u", "D^2 y = - D^0.5 y + u"])
def test_explicit_euler_steps_whole_orders_only(text):
    with pytest.raises(ftlm.ModelError, match="equation 0 has orders that explicit Euler cannot step"):
        ftlm.explicit_euler(model(text), zeros_run())
