"""The virtual arm: coupled stages, friction and offsets against the energies, naive sums and models' free runs."""

from dataclasses import replace

import numpy as np
import pytest

import ftlm
import lagrange
from ftlm import rig
from ftlm.rig.recording import STOCK_FILTER
from planar_arm import Planar
from real_arm import correlations, filtered
from slow_cases import slow_after

STEP = 0.002
ANGLES = ("theta11", "theta12", "theta21", "theta22")


def currents(rows):
    """Two held currents that push, let go, turn and hold the hubs [A]."""
    t = np.arange(rows) * STEP
    first = np.where(t % 1.0 < 0.3, 0.3, np.where(t % 1.0 < 0.5, 0.0, -0.2))
    return np.column_stack([first, np.where(t % 0.8 < 0.4, -0.25, 0.15)])


def states_of(parameters, driven, step=STEP):
    """All four angles."""
    arm = parameters.arm(step, 30.0)
    out = np.zeros((len(driven), 4))
    for k, (first, second) in enumerate(driven):
        out[k] = arm.angles
        arm.advance([-first / 0.5, -second / 0.5], True)
    return out


def exact(name="effective", **changes):
    """A set whose converters do not round the commands."""
    return replace(rig.ArmParameters.load(name), bits=0, **changes)


def whole(parameters):
    """The same arm with integer orders."""
    one, two = (replace(s, gamma=1.0, beta=0.0, mu=1.0) for s in (parameters.stage1, parameters.stage2))
    return replace(parameters, stage1=one, stage2=two)


def smooth(parameters):
    """The same arm without Coulomb friction."""
    one, two = (replace(s, coulomb=0.0) for s in (parameters.stage1, parameters.stage2))
    return replace(parameters, stage1=one, stage2=two)


def errors(found, truth):
    """Largest error of each angle over its deviation."""
    return np.abs(found - truth).max(axis=0) / truth.std(axis=0)


# ----------------------------------------------------------------------------------------------------------------------
# Against the energies


@slow_after(1, "coupling", [1.0, 0.4])
def test_hubs_that_stick_slip_and_turn_are_those_of_the_energies_event_by_event(coupling):
    parameters, driven = whole(exact(coupling=coupling, current_offset=(0.01, -0.02))), currents(1251)
    found = states_of(parameters, driven)
    truth, changes = Planar(parameters).by_events(driven + np.array([0.01, -0.02]), STEP)
    assert min(changes) >= 4
    assert errors(found, truth).max() < 4e-5
    # Hubs at rest stand still exactly.
    for hub in (0, 2):
        assert np.count_nonzero(np.diff(found[:, hub]) == 0.0) > 30
    # Without friction it is another run altogether, and friction does not hide in the tolerance.
    assert errors(states_of(smooth(parameters), driven), truth).min() > 0.1


def test_fractional_orders_with_friction_are_those_of_sums_over_the_whole_past():
    parameters, driven = exact(), currents(401)
    found = states_of(parameters, driven)
    sums = [Planar(parameters).by_steps(np.repeat(driven, k, axis=0), STEP / k)[::k] for k in (2, 4)]
    away = [errors(s, found).max() for s in sums]
    # Naive sums are first order in their step, and their extrapolation is nearer by far.
    assert away[1] < 0.65 * away[0]
    assert errors(2.0 * sums[1] - sums[0], found).max() < 0.02
    assert errors(states_of(whole(parameters), driven), found).min() > 0.05


# ----------------------------------------------------------------------------------------------------------------------
# Against the package's own free runs


@pytest.mark.parametrize("name", ["effective", "measured"])
def test_the_arm_without_friction_is_its_model_under_inertial_coupling(name):
    parameters, driven = smooth(exact(name)), currents(1001)
    model = parameters.model()
    law = ftlm.flexible_link(stage="both", coupling="simulated", cross_stage="inertial").with_orders(model.orders)
    for item, lawful in zip(model.equations, law.equations, strict=True):
        assert [(t.signal, t.order) for t in item.terms] == [(t.signal, t.order) for t in lawful.terms]
    blank = ftlm.Run.from_arrays(
        step=STEP, inputs={"I1": driven[:, 0], "I2": driven[:, 1]}, outputs={n: np.zeros(1001) for n in ANGLES}
    )
    solved = model.simulate(blank, tolerance=1e-6)
    truth = np.column_stack([solved[n] for n in ANGLES])
    assert errors(states_of(parameters, driven), truth).max() < 1e-3


@pytest.mark.parametrize("name", ["effective", "measured", "measured-lqr"])
def test_the_whole_arm_is_its_model_with_friction(name):
    parameters, driven = exact(name), currents(1001)
    model = parameters.model(friction=True)
    law = ftlm.flexible_link(stage="both", coupling="simulated", cross_stage="inertial", friction=True)
    assert model.structure.friction_equations == law.friction_equations == (0, 2)
    assert [e.signals for e in model.equations] == [e.signals for e in law.equations]
    blank = ftlm.Run.from_arrays(
        step=STEP, inputs={"I1": driven[:, 0], "I2": driven[:, 1]}, outputs={n: np.zeros(1001) for n in ANGLES}
    )
    solved = model.simulate(blank)
    found = states_of(parameters, driven)
    assert errors(found, np.column_stack([solved[n] for n in ANGLES])).max() < 1e-4
    # Both hubs rest now and then, and each is shaken while the other moves.
    for hub in (0, 2):
        assert 0.02 < np.mean(np.diff(found[:, hub]) == 0.0) < 0.98


def test_a_hub_by_itself_is_the_body_with_friction_of_the_free_run():
    # The link weighs as much as no link: what is left is D^2 theta11 = b D^gamma theta11 + g (I1 - sign).
    stage = replace(rig.ArmParameters.load("effective").stage1, a=0.0, d=0.0)
    parameters, driven = exact(coupling=0.0, stage1=stage), currents(1501)
    body = ftlm.equation(
        f"D^2 theta11 = {stage.b} D^{stage.gamma} theta11 + {stage.g} I1 - {stage.g * stage.coulomb}*sign(D theta11)",
        initial="rest",
    )
    blank = ftlm.Run.from_arrays(step=STEP, inputs={"I1": driven[:, 0]}, outputs={"theta11": np.zeros(1501)})
    truth = ftlm.Model(body).simulate(blank)["theta11"]
    found = states_of(parameters, driven)[:, 0]
    assert np.abs(found - truth).max() < 1e-4 * truth.std()


# ----------------------------------------------------------------------------------------------------------------------
# As the real arm


def run_of(parameters, driven):
    """A run without noise, deflections behind the stock filter."""
    angles, (w, damping) = states_of(parameters, driven), STOCK_FILTER
    seen = [filtered(angles[:, k], [w * w], [1.0, 2.0 * damping * w, w * w], STEP) for k in (1, 3)]
    outputs = {"theta11": angles[:, 0], "theta12": seen[0], "theta21": angles[:, 2], "theta22": seen[1]}
    return ftlm.Run.from_arrays(step=STEP, inputs={"I1": driven[:, 0], "I2": driven[:, 1]}, outputs=outputs)


@pytest.mark.parametrize("shape", ["square", "multisine"])
def test_deflections_go_against_their_currents_and_with_their_hubs(shape):
    # The real arm, under currents of its own (tests/python/test_rig_measured.py): -0.34 and 0.69, -0.32 and 0.92.
    driven = np.column_stack([2.0 * lagrange.current(shape, 5000)] * 2)
    for name in ("linear", "effective", "measured", "measured-lqr"):
        current, hub, second, _ = correlations(run_of(exact(name), driven))
        assert current < -0.15, name
        assert hub > 0.4, name
        assert second < -0.15, name
    # The published form bends the other way, and follows no hub.
    current, hub, second, other = correlations(run_of(exact("linear", form="published"), driven))
    assert min(current, second) > 0.1
    assert max(hub, other) < 0.2


@pytest.mark.slow
def test_the_links_of_a_noisy_run_with_friction_and_offset_are_recovered_with_intervals():
    # Friction, torque and offset are those of hubs: driven by these the links know nothing of them.
    arm = rig.ArmParameters.load("effective")
    run = rig.record(
        input="multisine",
        amplitude=(0.6, 0.8),
        period=8.0,
        band=(0.125, 8.0),
        duration=8.0,
        seed=1,
        parameters=arm,
        offset=(0.01, -0.02),
    )
    hubs, deflections = ("theta11", "theta21"), ("theta12", "theta22")
    driven = ftlm.Run.from_arrays(
        step=2 * run.step,
        inputs={n: run[n][::2] for n in hubs},
        outputs={n: run[n][::2] for n in deflections},
        intersample=dict.fromkeys(hubs, "foh"),
    )
    truth = {**arm.model().orders, **arm.model().coefficients}
    structure = ftlm.flexible_link(stage="both", hub=False, cross_stage="inertial")
    structure = replace(structure, coupling="simulated", initial="rest")
    known = {n: truth[n] for n in ("gamma1", "gamma3")}
    found = ftlm.identify(
        driven, structure.with_orders(known), threads=1, method=ftlm.OutputError(intervals="quadratic")
    )
    names = ("beta2", "mu2", "beta4", "mu4", "a2", "d2", "p2", "q2", "a4", "d4", "p4", "q4")
    values = {**found.orders, **found.coefficients}
    away = {n: (values[n] - truth[n]) / found.standard_errors[n] for n in names}
    # 12 numbers at once: 99.9 % each.
    assert max(map(abs, away.values())) < 3.3, away
    assert max(found.standard_errors[n] for n in ("beta2", "mu2", "beta4", "mu4")) < 0.002
    assert found.standard_errors["p4"] < 0.01


# ----------------------------------------------------------------------------------------------------------------------
# A run


def test_an_offset_is_of_the_run_and_ends_with_the_amplifiers(tmp_path):
    offset = (0.02, -0.03)
    still = rig.record(input="square", amplitude=0.0001, duration=1.0, parameters="linear", offset=offset)
    assert still["theta11"][0] == 0.0
    assert still["theta11"][-1] > 0.01
    assert still["theta21"][-1] < -0.01
    assert still.metadata["parameters"]["current_offset"] == list(offset)
    assert np.abs(still["I1"]).max() < 0.001
    arm = exact("linear", current_offset=offset).arm(STEP, 5.0)
    for _ in range(100):
        arm.advance([0.0, 0.0], False)
    assert list(arm.angles) == [0.0] * 4
    path = tmp_path / "arm.toml"
    path.write_text('base = "linear"\ncurrent_offset = [0.02, -0.03]\n', encoding="utf-8")
    same = rig.record(input="square", amplitude=0.0001, duration=1.0, parameters=path)
    assert np.array_equal(same["theta11"], still["theta11"])


def test_an_offset_that_friction_holds_moves_nothing():
    run = rig.record(input="square", amplitude=0.05, duration=1.0, offset=(0.02, 0.03))
    assert (run["theta11"] == 0.0).all()
    assert (run["theta21"] == 0.0).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"coulomb": -0.1}, "Coulomb friction = -0.1 is outside [0, ∞) A"),
        ({"coulomb": float("nan")}, "Coulomb friction = NaN is outside [0, ∞) A"),
        ({"g": 0.0}, "motor 2 does not move its hub"),
        ({"r": 1.0}, "r = 1.0 of stage 2 is not above 1"),
        ({"gamma": -0.2}, "order"),
        ({"mu": 2.3}, "order"),
    ],
)
def test_a_stage_that_cannot_be_is_refused(changes, words):
    arm = rig.ArmParameters.load("effective")
    with pytest.raises(ftlm.ModelError) as refused:
        rig.record(duration=0.5, parameters=replace(arm, stage2=replace(arm.stage2, **changes)))
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"link_coupling_ratio": 20.0}, "the kinetic energy of the arm is not positive"),
        ({"inertia_ratio": 0.2}, "not positive definite"),
        ({"inertia_ratio": -0.1}, "inertia_ratio = -0.1 is outside [0, inf]"),
        ({"link_coupling_ratio": float("nan")}, "link_coupling_ratio = nan is outside [0, inf]"),
        ({"rotating_inertia_fraction": 1.5}, "rotating_inertia_fraction = 1.5 is outside [0, 1]"),
        ({"form": "published"}, "form = 'published' has no coupling of the joints: set coupling = 0"),
        ({"current_offset": (float("nan"), 0.0)}, "current offset is not finite at index 0"),
    ],
)
def test_an_arm_that_cannot_be_is_refused(changes, words):
    with pytest.raises(ftlm.FtlmError) as refused:
        rig.record(duration=0.5, parameters=replace(rig.ArmParameters.load("effective"), **changes))
    assert words in str(refused.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"offset": (0.1,)}, "offset = (0.1,) is not a pair of currents"),
        ({"offset": (float("nan"), 0.0)}, "is not a pair of currents"),
        ({"rig": "q8", "offset": (0.1, 0.0), "arm": True}, "offset applies only to the virtual arm"),
    ],
)
def test_an_offset_that_cannot_be_is_refused(options, words):
    with pytest.raises(ftlm.ModelError) as refused:
        rig.record(duration=0.5, **options)
    assert words in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["effective", "measured-lqr"])
def test_the_whole_arm_is_recovered_from_its_currents(name):
    """Both stages, both hubs' friction and the coupling, from the automatic start, within the printed intervals."""
    parameters, rng = exact(name), np.random.default_rng(0)
    # Held over two steps of the arm, of which one is read.
    t, phases = np.arange(1501) * 2 * STEP, rng.uniform(0.0, 2.0 * np.pi, 4)
    first = 0.45 * np.sign(np.sin(2.2 * t + phases[0])) + 0.15 * np.sin(13.2 * t + phases[1])
    second = 0.4 * np.sign(np.sin(3.33 * t + phases[2])) + 0.12 * np.sin(19.5 * t + phases[3])
    driven = np.column_stack([first, second])
    driven[0] = 0.0
    angles = states_of(parameters, np.repeat(driven, 2, axis=0))[::2]
    angles += 0.003 * angles.std(axis=0) * rng.standard_normal(angles.shape)
    run = ftlm.Run.from_arrays(
        step=2 * STEP,
        inputs={"I1": driven[:, 0], "I2": driven[:, 1]},
        outputs={n: angles[:, k] for k, n in enumerate(ANGLES)},
    )
    structure = ftlm.flexible_link(stage="both", coupling="simulated", cross_stage="inertial", friction=True)
    found = ftlm.identify(run, structure)
    assert min(found.fit.values()) > 99.5
    truth = parameters.model(friction=True)
    held = [
        abs(value - known[n]) < 4.0 * found.standard_errors[n]
        for estimated, known in ((found.orders, truth.orders), (found.coefficients, truth.coefficients))
        for n, value in estimated.items()
        if n in found.standard_errors and known[n] != round(known[n])
    ]
    assert len(held) > 15
    assert all(held)
