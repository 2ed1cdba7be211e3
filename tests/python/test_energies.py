"""Energies and forces (7)-(11): the paper's formulas, balance of power, what a fractional force stores and loses."""

from dataclasses import replace

import numpy as np
import pytest

import ftlm
from ftlm.arm.energy_balance import power
from ftlm.arm.flexible_link import PARAMETER_SETS

FRACTIONAL = {"gamma1": 0.95, "beta2": 0.1, "mu2": 0.85}
LINK = replace(PARAMETER_SETS["effective"][1], link_friction=0.4)


def run_of(orders, samples):
    """Stage 1 from rest under a smooth current: differences across jumps of an acceleration are of first order."""
    step = 10.0 / samples
    t = np.arange(samples + 1) * step
    current = 0.3 * np.sin(6.3 * t) * (1 - np.exp(-t))
    still = {"theta11": 0 * t, "theta12": 0 * t}
    drive = ftlm.Run.from_arrays(step=step, inputs={"I1": current}, outputs=still, intersample={"I1": "foh"})
    whole = {"alpha1": 2.0, "gamma1": 1.0, "beta2": 0.0, "mu2": 1.0}
    return ftlm.link_model(stage=1, orders=whole | orders, parameters={1: LINK}).simulate(drive)


def integrated(values, step):
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1])) * step])


def imbalance(orders, samples):
    """Largest difference of the motor's work and of where it went, over the work."""
    run = run_of(orders, samples)
    found = ftlm.energies(run, stage=1, parameters=LINK, orders=orders)
    work = integrated(found.motor, run.step)
    went = integrated(found.inertia, run.step)
    for part in (found.elastic, found.hub_friction, found.link_friction):
        went = went + part.stored + integrated(part.dissipated, run.step)
        assert part.dissipated.min() >= 0.0
        assert part.stored.min() >= 0.0
    return np.max(np.abs(work - went)) / np.max(np.abs(work))


def test_power_balances_with_whole_orders_to_second_order_in_the_step():
    coarse, fine = (imbalance({}, n) for n in (2500, 5000))
    assert coarse < 3e-4
    assert fine == pytest.approx(coarse / 4, rel=0.1)


def test_power_balances_with_fractional_storage_and_loss():
    coarse, fine = (imbalance(FRACTIONAL, n) for n in (2500, 5000))
    assert coarse < 5e-4
    assert fine < 0.6 * coarse


def test_energies_and_forces_are_the_paper_s():
    run = run_of({}, 2500)
    found = ftlm.energies(run, stage=1, parameters=LINK)
    hub, bend = (np.gradient(run[n], run.step) for n in ("theta11", "theta12"))
    inner = slice(2, -2)

    def alike(ours, theirs):
        return np.max(np.abs(ours - theirs)[inner]) < 2e-3 * np.max(np.abs(theirs))

    j1, j2 = LINK.hub_inertia, LINK.link_inertia
    assert alike(found.potential, 0.5 * LINK.stiffness * run["theta12"] ** 2)
    # (9), written out.
    assert alike(found.kinetic, 0.5 * (j1 + j2) * hub**2 + j2 * bend * hub + 0.5 * j2 * bend**2)
    assert alike(found.hub_force, LINK.torque_constant * run["I1"] - LINK.hub_friction * hub)
    assert alike(found.link_force, -LINK.link_friction * bend)
    assert np.array_equal(found.lagrangian, found.kinetic - found.potential)
    # With integer orders what inertia takes is the kinetic energy, and the link gives back all that it took.
    assert alike(integrated(found.inertia, run.step), found.kinetic)
    assert alike(found.elastic.stored, found.potential)
    assert not found.elastic.dissipated.any()
    assert not found.hub_friction.stored.any()


@pytest.mark.parametrize("order", [0.1, 0.5, 0.95])
def test_a_fractional_force_loses_in_a_cycle_what_its_phase_says(order):
    step, frequency = 0.004, 2 * np.pi
    t = np.arange(5001) * step
    angle = np.sin(frequency * t) * (1 - np.exp(-t))
    found = power(angle, 3.0, order, step)
    cycles = slice(-2501, -1)
    lost = 0.5 * 3.0 * frequency ** (1 + order) * np.sin(0.5 * np.pi * order)
    assert np.mean(found.dissipated[cycles]) == pytest.approx(lost, rel=5e-3)
    # The force itself, by the definition.
    rate = np.gradient(angle, step)
    derivative = ftlm.fractional_derivative(angle, order, step=step, definition="caputo", initial=[0.0, 0.0])
    assert np.max(np.abs(found.supplied - 3.0 * derivative * rate)) < 5e-3 * np.max(np.abs(found.supplied))


def test_between_whole_orders_storage_and_loss_are_between():
    t = np.arange(1001) * 0.01
    angle = np.sin(t) ** 2
    for order, near in ((1e-6, 0.0), (1 - 1e-6, 1.0)):
        ours, whole = power(angle, 2.0, order, 0.01), power(angle, 2.0, near, 0.01)
        for name in ("supplied", "stored", "dissipated"):
            assert np.max(np.abs(getattr(ours, name) - getattr(whole, name))) < 1e-3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"stage": 3}, "stage = 3 is not known"),
        ({"orders": {"gamma2": 1.0}}, "order 'gamma2' is not known; the stage's free orders are alpha1"),
        ({"orders": {"beta2": 1.2}}, r"beta2 = 1.2 is outside \[0, 1\]"),
        ({"orders": {"mu2": float("nan")}}, r"mu2 = nan is outside"),
        ({"stage": 2}, "theta21"),
    ],
)
def test_what_cannot_be_balanced_is_said(words, message):
    run = run_of({}, 100)
    with pytest.raises(ftlm.FtlmError, match=message):
        ftlm.energies(run, **words)


def test_a_run_that_does_not_start_at_rest_is_refused():
    run = run_of({}, 100)
    t, rest = run.time, {n: run[n] for n in ("theta11", "theta12")}

    def made(rows=101, **angles):
        outputs = {n: x[:rows] for n, x in (rest | angles).items()}
        return ftlm.Run.from_arrays(step=run.step, inputs={"I1": run["I1"][:rows]}, outputs=outputs, name="mine")

    with pytest.raises(
        ftlm.DataError, match=r"run 'mine': theta12 starts at 0.5 rad, not at 0; .* cut the run where it rests, .*"
    ):
        ftlm.energies(made(theta12=0 * t + 0.5))
    with pytest.raises(ftlm.DataError, match=r"theta11 moves by 0.2 rad in its first step"):
        ftlm.energies(made(theta11=2.0 * t))
    with pytest.raises(ftlm.DataError, match="run 'mine' has 3 rows; energies need at least 4"):
        ftlm.energies(made(rows=3))
    assert ftlm.energies(made(rows=4)).time.shape == (4,)
    assert not ftlm.energies(made(theta11=0 * t, theta12=0 * t)).kinetic.any()
    # A current that jumps starts from rest too.
    still = {n: 0 * t for n in rest}
    drive = ftlm.Run.from_arrays(step=0.01, inputs={"I1": 0 * t + 0.3}, outputs=still)
    ftlm.energies(ftlm.link_model(stage=1, parameters={1: LINK}).simulate(drive))
