"""Friction that falls with speed: breakaway, stick-slip between events, limits of its law, words, estimates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf

import friction
import ftlm
from ftlm.errors import DataError, ModelError
from numbered_problem import NumberedProblem
from test_friction import level_and_rate, motion, run_of

pytestmark = pytest.mark.usefixtures("no_extension_tests")

NEAR = "- fs*exp(-(D y/vs)^2)*sign(D y)"
BLOCK = f"D^2 y = u - fc*sign(D y) {NEAR}"
#: A sledge that a spring pulls: a slow one stops and jumps.
SLEDGE = f"D^2 y = - v D y - k y + k2 u - fc*sign(D y) {NEAR}"


def means_of(force, m: int, end: float) -> np.ndarray:
    fine = (np.arange(50 * m) + 0.5) * end / (50 * m)
    return force(fine).reshape(m, 50).mean(axis=1)


# ------------------------------------------------------------------------------------------------------------ free runs


@pytest.mark.parametrize(("fc", "fs"), [(0.5, 0.3), (0.0, 0.7), (0.2, 1.0)])
def test_a_slow_ramp_breaks_away_at_the_sum_and_slides_on_at_less(fc: float, fs: float) -> None:
    step, slope = 0.001, 0.25
    m = int((fc + fs) / slope / step) + 1000
    found = motion(slope * step * (np.arange(m) + 0.5), step, 2.0, [], (fc, fs, 0.05))
    away = int(np.flatnonzero(found["velocity"])[0])
    # The pulse within which the ramp passes fc + fs.
    assert away == pytest.approx((fc + fs) / slope / step, abs=1.01)
    assert np.max(found["force"]) == pytest.approx(fc + fs, rel=1e-3)
    # At twenty times vs nothing but fc is left.
    assert found["velocity"][-1] > 0.2
    assert found["force"][-1] == pytest.approx(fc, abs=1e-6)


def test_a_sliding_block_stops_where_the_energy_says() -> None:
    # v dv/dx = -F(v): distance is the integral of v / F(v), time that of 1 / F(v).
    fc, fs, vs = 0.4, 0.6, 0.3
    v = np.linspace(0.0, 1.0, 200001)
    braking = fc + fs * np.exp(-((v / vs) ** 2))
    time, distance = np.trapezoid(1.0 / braking, v), np.trapezoid(v / braking, v)
    errors = []
    for m in (500, 1000, 2000):
        found = motion(np.zeros(m), 3.0 / m, 2.0, [], (fc, fs, vs), [(1.0, 1.0)])
        rest = np.flatnonzero(found["velocity"] == 0.0)
        assert rest[0] * 3.0 / m == pytest.approx(time, abs=3.1 / m)
        assert not found["velocity"][rest[0] :].any()
        errors.append(abs(found["output"][-1] - distance))
    assert errors[2] < 1e-6
    assert errors[2] < errors[0] / 10.0


@pytest.mark.parametrize("law", [(0.8, 0.4, 0.1), (0.8, 0.7, 0.3), (0.5, 0.9, 0.05)])
def test_stops_turns_and_break_aways_are_those_between_events(law) -> None:
    def force(t):
        return 2.0 * np.sin(3.0 * t) + 0.3

    fc, fs, vs = law
    times = np.linspace(0.0, 4.0, 2001)
    _, v = friction.between_events(force, times, 1.0, fc, 1.0, more=fs, speed=vs)
    assert np.mean(v == 0.0) > 0.02
    assert v.min() < 0.0 < v.max()
    errors = []
    for m in (250, 500, 1000):
        found = motion(means_of(force, m, 4.0), 4.0 / m, 2.0, [(-1.0, 1.0)], law, [(1.0, 1.0)])
        assert np.array_equal(found["velocity"][1:][found["stuck"]], np.zeros(found["stuck"].sum()))
        assert np.all(np.abs(found["force"]) <= (fc + fs) * (1.0 + 1e-9))
        edges = np.arange(m + 1) * 4.0 / m
        errors.append(float(np.max(np.abs(found["velocity"] - np.interp(edges, times, v)))))
    assert errors[0] < 1e-3
    # The second order, up to where in its pulse each event lies.
    assert errors[2] < errors[0] / 7.0


@pytest.mark.parametrize("law", [(0.3, 0.4, 0.2), (0.2, 0.6, 0.05)])
def test_a_sledge_on_a_slow_spring_sticks_and_slips(law) -> None:
    def pull(t):
        return 2.0 * t

    times = np.linspace(0.0, 8.0, 4001)
    _, v = friction.between_events(pull, times, 0.1, law[0], more=law[1], speed=law[2], spring=4.0)
    # Several rests with jumps between them.
    assert np.sum(np.diff((v == 0.0).astype(int)) == -1) >= 3
    errors = []
    for m in (250, 500, 1000):
        found = motion(means_of(pull, m, 8.0), 8.0 / m, 2.0, [(-0.1, 1.0), (-4.0, 0.0)], law)
        edges = np.arange(m + 1) * 8.0 / m
        errors.append(float(np.max(np.abs(found["velocity"] - np.interp(edges, times, v)))))
    assert errors[0] < 2e-3
    assert errors[1] < errors[0] / 3.5
    assert errors[2] < errors[1] / 3.5
    # Coulomb friction of the same breakaway creeps along behind the spring.
    creeps = motion(means_of(pull, 1000, 8.0), 0.008, 2.0, [(-0.1, 1.0), (-4.0, 0.0)], law[0] + law[1])
    assert np.max(creeps["velocity"]) < 0.95 * np.max(v)


@pytest.mark.parametrize(
    ("alpha", "own", "law"),
    [
        (2.0, [(-1.0, 1.0)], (0.6, 0.4, 0.3)),
        (1.8, [(-1.0, 0.9)], (0.6, 0.4, 0.3)),
        (1.7, [(-2.0, 0.0), (-0.5, 1.2)], (0.6, 0.4, 0.2)),
        (1.4, [(-0.3, 0.5)], (0.6, 0.4, 0.3)),
    ],
)
def test_fractional_bodies_are_those_of_slow_stepping(alpha: float, own, law) -> None:
    errors = []
    for count in (250, 500, 1000):
        step = 4.0 / count
        force = 2.0 * np.sin(3.0 * np.arange(count + 1) * step) + 0.3
        y, v = friction.naive_run(force, step, alpha, own, law[0], 0.2, 1.0, more=law[1], speed=law[2])
        found = motion(0.5 * (force[1:] + force[:-1]), step, alpha, own, law, level_and_rate(alpha, own, 0.2, 1.0))
        errors.append(float(np.max(np.abs(found["output"] - 0.5 * (y[1:] + y[:-1])))))
        assert np.ptp(np.sign(v)) == 2.0
    # The slow one is of first order.
    assert errors[2] < 0.005
    assert errors[2] < 0.3 * errors[0]


def test_its_limits_are_coulombs() -> None:
    means = 2.0 * np.sin(0.03 * np.arange(600)) + 0.3 * np.cos(0.11 * np.arange(600))
    own = [(-1.0, 0.9)]

    def velocity(law):
        return motion(means, 0.02, 1.8, own, law, [(1.0, 0.5)])["velocity"]

    plain, both = velocity(0.7), velocity(1.1)
    np.testing.assert_array_equal(velocity((0.7, 0.0, 0.1)), plain)
    np.testing.assert_allclose(velocity((0.7, 1e-13, 0.1)), plain, atol=1e-12)
    np.testing.assert_allclose(velocity((0.7, 0.4, 1e8)), both, atol=1e-12)
    # What falls at once holds at rest only: a body that slides feels fc.
    assert np.max(np.abs(velocity((0.7, 0.4, 1e-3)) - plain)) < np.max(np.abs(both - plain))


@pytest.mark.parametrize(
    ("v", "push"), [(0.0, 1.205), (0.0, 1.25), (0.04, 0.0), (0.04, -0.1), (0.01, -0.15), (0.03, 2.0), (0.1, -0.6)]
)
def test_of_several_ends_of_a_long_pulse_the_first_on_the_way_is_taken(v: float, push: float) -> None:
    # A fall that passes within a pulse: e = p - g F, the mean from v to e, has up to three roots.
    fc, fs, vs, g = 0.2, 1.0, 0.01, 0.1
    grid = np.linspace(0.0, 0.5, 500001) + 1e-9
    mean = 0.5 * np.sqrt(np.pi) * vs * (erf(grid / vs) - erf(v / vs)) / (grid - v)
    off = grid - (v + g * push) + g * (fc + fs * mean)
    roots = grid[:-1][off[:-1] * off[1:] <= 0.0]
    # Above v where the body is driven on, below where it is held back.
    driven = push > fc + fs * np.exp(-((v / vs) ** 2))
    ways = roots[roots > v] if driven else roots[roots < v][::-1]
    assert roots.size > 1 or (v, push) not in [(0.0, 1.205), (0.04, 0.0)]
    found = motion(np.array([push]), g, 2.0, [], (fc, fs, vs), [(1.0, v)])
    assert found["velocity"][1] == pytest.approx(ways[0] if ways.size else 0.0, abs=2e-6)


# ------------------------------------------------------------------------------------------------------- sensitivities


@pytest.mark.parametrize("orders", [(1.9, 0.9), (1.8, 0.4), (1.95, 1.2)])
def test_derivatives_are_those_of_finite_differences(orders) -> None:
    runs, law = friction.two_records()

    friction_law = [(1.0, [(i, 1)]) for i in (2, 3, 4)]
    problem = NumberedProblem([law], [(0, friction_law)], [(1.05, 2.0), (0.0, 1.5)], (True, [], 1))

    def at(point):
        return problem.evaluate(runs, point[:7], [point[7:10], point[10:]])

    point = np.array([*orders, 0.7, 1.1, 0.6, 0.3, 0.15, 0.1, 0.2, 0.05, -0.2, 0.4, -0.1])
    assert max(friction.slope_errors(at, point, 7)) < 1e-6


# --------------------------------------------------------------------------------------------------------------- words


def known(words: str = SLEDGE, **values: float) -> ftlm.Model:
    return ftlm.Model(ftlm.equation(words, fixed=values))


SAID = {"v": 0.5, "k": 4.0, "k2": 4.0, "fc": 0.5, "fs": 0.25, "vs": 0.2}


def test_words_are_read_and_written() -> None:
    structure = ftlm.equation(BLOCK + " + c")
    assert str(structure) == "D^2 y = 1.0 u - fc sign(D y) - fs exp(-(D y/vs)^2) sign(D y) + c"
    assert structure.coefficient_names == ("fc", "fs", "vs")
    assert ftlm.equation(str(structure)) == structure
    # In any order, with numbers.
    turned = ftlm.equation("D^2 y = - 2 fs exp(-(D y / 0.05)^2) sign(D y) + u - 0.5*sign(D y)")
    rubs = turned.equations[0].friction
    assert turned.coefficient_names == ("fs",)
    assert (rubs.strength, rubs.stribeck.strength, rubs.stribeck.speed) == (0.5, None, 0.05)
    assert str(turned) == "D^2 y = 1.0 u - 0.5 sign(D y) - 2.0 fs exp(-(D y/0.05)^2) sign(D y)"
    assert ftlm.equation(str(turned)) == turned
    assert turned.equations[0].with_coefficients({"fs": 0.2}).friction.law == (0.5, 0.4, 0.05)
    # A signal, or a coefficient, may still be called exp.
    assert ftlm.equation("D^2 y = - exp D y + exp2 u").coefficient_names == ("exp", "exp2")
    model = known(**SAID)
    assert str(model) == ("D^2 y = -0.5 D^1 y - 4 y + 4 u - 0.5 sign(D y) - 0.25 exp(-(D y/0.2)^2) sign(D y)")
    assert model.coefficients == SAID
    page = model._repr_html_()
    assert page.count("<mi>sgn</mi>") == 2
    assert "Stribeck friction, beyond Coulomb's at rest, in the equation of" in page.replace("&#39;", "'")
    assert "Stribeck's speed" in page.replace("&#39;", "'")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (f"D^2 y = u {NEAR}", r"add '- fc\*sign\(D y\)'"),
        (f"{BLOCK} {NEAR.replace('fs', 'fs2')}", "Stribeck friction of D y occurs twice"),
        ("D^2 y = u - fc*sign(D y) + fs*exp(-(D y/vs)^2)*sign(D y)", "it is subtracted"),
        ("D^2 y = u - fc*sign(D y) - fs*exp(-(D u/vs)^2)*sign(D u)", "velocity of the output of the equation"),
        ("D^2 y = u - fc*sign(D y) - fs*exp(-(D u/vs)^2)*sign(D y)", "use the same velocity in both"),
        ("D^2 y = u - fc*sign(D y) - fs*exp((D y/vs)^2)*sign(D y)", r"expected -\(D y/vs\)\^2"),
        ("D^2 y = u - fc*sign(D y) - fs*exp(-(D y/vs)^3)*sign(D y)", "expected '2'"),
        ("D^2 y = u - fc*sign(D y) - fs*exp(-(y/vs)^2)*sign(D y)", "D and the name of a signal"),
        ("D^2 y = u - fc*sign(D y) - fs*exp(-(D y/-1)^2)*sign(D y)", "a speed"),
        ("D^2 y = u - fc*sign(D y) - fs*exp(-(D y/vs)^2)", "'vs' at character 41 divides inside a non-linear term"),
        ("D^2 y = u - fc*sign(D y) - fs*exp(-(D y/0)^2)*sign(D y)", "vs = 0; give a positive one"),
        ("D^2 y = u - fc*sign(D y) - fc*exp(-(D y/vs)^2)*sign(D y)", "fc occurs twice"),
        ("D^0.8 y = u - fc*sign(D y) - fs*exp(-(D y/vs)^2)*sign(D y)", r"requires an order alpha in \(1, 2\]"),
    ],
)
def test_words_that_mean_nothing_are_refused(words: str, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        ftlm.equation(words)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"fs": -0.1}, "at least 0"),
        ({"vs": 0.0}, "positive"),
        ({"vs": -1.0}, "positive"),
        ({"vs": np.nan}, "finite"),
        ({"vs": np.inf}, "finite"),
    ],
)
def test_numbers_that_mean_nothing_are_refused(values, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        known(**{**SAID, **values})
    law = tuple({**SAID, **values}[n] for n in ("fc", "fs", "vs"))
    with pytest.raises((ModelError, DataError)):
        motion(np.ones(10), 0.1, 2.0, [], law)


def test_no_friction_beside_it_is_said_with_a_zero() -> None:
    block = ftlm.Model(ftlm.equation("D^2 y = u - 0*sign(D y) - 0.5*exp(-(D y/0.1)^2)*sign(D y)"))
    assert not block.simulate(run_of(np.full(100, 0.499), 0.01))["y"].any()
    assert block.simulate(run_of(np.full(100, 0.501), 0.01))["y"][-1] > 0.0


def test_a_file_keeps_it(tmp_path) -> None:
    model = known(**SAID)
    path = model.save(tmp_path / "sledge.json")
    again = ftlm.load_model(path)
    assert again.structure.equations == model.structure.equations
    assert again.coefficients == SAID
    run = run_of(np.sin(np.arange(300) * 0.02), 0.02)
    np.testing.assert_array_equal(again.simulate(run)["y"], model.simulate(run)["y"])
    text = path.read_text()
    path.write_text(text.replace('"speed": 0.2', '"speed": -0.2'))
    with pytest.raises(DataError, match="give a positive one"):
        ftlm.load_model(path)


def test_the_regularised_law_is_refused_by_what_is_linear() -> None:
    model = known(**SAID)
    for linear in (model.stability, model.poles, lambda: model.frequency_response([1.0])):
        with pytest.raises(ModelError, match="has friction"):
            linear()
    with pytest.raises(ModelError, match="has friction"):
        ftlm.identify(sledge(0)[0], ftlm.equation(SLEDGE), method="instrumental-variables")


# ----------------------------------------------------------------------------------------------------------- estimates

TRUTH = {"v": 0.5, "k": 4.0, "k2": 4.0, "fc": 0.5, "fs": 0.5, "vs": 0.2}


def sledge(seed: int, *, noise: float = 0.005, offset: float = 0.0, rows: int = 601):
    """A sledge on a spring that two slow sinusoids pull, between its events, with white noise; its velocity."""
    step = 0.02
    rng = np.random.default_rng(seed)
    first, second = rng.uniform(0.0, 2.0 * np.pi, 2)

    def pulled(t):
        return 0.9 * np.sin(0.9 * t + first) + 0.35 * np.sin(2.3 * t + second)

    times = np.arange(rows) * step
    clean, v = friction.between_events(
        lambda t: 4.0 * pulled(t) + offset, times, 0.5, 0.5, more=0.5, speed=0.2, spring=4.0
    )
    samples = clean + noise * np.std(clean) * rng.standard_normal(rows)
    return run_of(pulled(times), step, samples, hold=False, name=f"sledge {seed}"), v


def test_it_is_recovered_from_the_automatic_start_with_intervals(tmp_path) -> None:
    run, v = sledge(1)
    assert np.mean(v == 0.0) > 0.04
    found = ftlm.identify(run, ftlm.equation(SLEDGE, initial="rest"))
    for name, truth in TRUTH.items():
        error = found.standard_errors[name]
        assert error < 0.08 * truth
        assert abs(found.coefficients[name] - truth) < 4.0 * error
    assert found.fit["y"] > 99.0
    assert found.warnings == ()
    page = found.report(tmp_path / "sledge.html").read_text()
    assert "Stribeck" in page
    # Coulomb friction alone leaves what it is for.
    plain = ftlm.identify(run, ftlm.equation(SLEDGE.replace(NEAR, ""), initial="rest"))
    assert plain.fit["y"] < found.fit["y"] - 0.3
    # A run that was not fitted.
    other = sledge(2)[0]
    assert found.model.compare(other).fit["y"] > max(99.0, plain.model.compare(other).fit["y"])
    kept = ftlm.load_model(found.model.save(tmp_path / "sledge.json"))
    assert kept.estimate.covariance == found.model.estimate.covariance
    assert kept.compare(other).fit["y"] == found.model.compare(other).fit["y"]


def test_offsets_of_several_runs_stand_beside_it() -> None:
    runs = [sledge(1, offset=0.3, rows=401)[0], sledge(2, offset=-0.2, rows=401)[0]]
    words = SLEDGE.replace("vs)", "0.2)").replace("- v D y", "- 0.5 D y")
    found = ftlm.identify(runs, ftlm.equation(words + " + c", initial="rest"))
    for name in ("k", "k2", "fc", "fs"):
        assert abs(found.coefficients[name] - TRUTH[name]) < 4.0 * found.standard_errors[name] + 0.002
    np.testing.assert_allclose([o["y"]["constant"] for o in found.comparison.offsets], [0.3, -0.2], atol=0.05)


def test_a_body_that_is_never_slow_does_not_tell_how_friction_falls() -> None:
    # Thrown at ten times vs, never slower than five.
    step, rows = 0.01, 301
    times = np.arange(rows) * step
    y, v = friction.between_events(lambda t: 0.9 + np.sin(4.0 * t), times, 0.3, 0.5, 2.0, more=0.5, speed=0.2)
    assert v.min() > 1.0
    rng = np.random.default_rng(0)
    run = run_of(0.9 + np.sin(4.0 * times), step, y + 1e-3 * rng.standard_normal(rows), hold=False)
    words = f"D^2 y = - 0.3 D y + u - fc*sign(D y) {NEAR}"
    found = ftlm.identify(run, ftlm.equation(words, initial="caputo"))
    said = any(
        f.code == "slow_motion_missing" or (f.code == "parameters_correlated" and "fs and vs" in str(f))
        for f in found.findings
    )
    assert said or not found.standard_errors["fs"] < abs(found.coefficients["fs"])
    assert said


def test_a_body_that_is_never_fast_tells_the_sum_alone() -> None:
    run = sledge(1, noise=0.001)[0]
    words = f"D^2 y = - 0.5 D y - 4 y + 4 u - fc*sign(D y) {NEAR.replace('vs)', '20)')}"
    found = ftlm.identify(run, ftlm.equation(words, initial="rest"))
    assert any("never moves faster than vs = 20" in w for w in found.warnings)
