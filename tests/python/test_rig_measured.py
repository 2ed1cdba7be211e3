"""The virtual rig beside measured runs of the real arm under the same currents: steps, noise levels, spectra."""

import numpy as np
import pytest

import real_arm
from measured import needs_data
from real_arm import ANGLES, UNITS, beside, correlations, factor
from slow_cases import slow_after

#: Bands of the arm's motion and of the sensors' noise [Hz].
MOTION, NOISE = [(0.2, 1.0), (1.0, 1.5), (1.5, 2.0), (2.0, 3.0), (3.0, 5.0)], [(80.0, 160.0)]
#: What :func:`real_arm.correlations` finds on the real runs: of each deflection with its current and a hub-driven link.
REAL = {"psf": (-0.34, 0.69, -0.13, 0.33), "lqr": (-0.32, 0.92, -0.37, 0.44)}

pytestmark = needs_data


@pytest.fixture(scope="module", params=list(UNITS))
def measured(request):
    return real_arm.commanded(request.param)


@slow_after(1, "name, motion", [("own", 4.5), ("effective", 13.0)])
def test_spectra_and_noise_are_within_the_stated_factors(measured, name, motion):
    run = beside(measured, UNITS[measured.name] if name == "own" else name)
    assert run.metadata["faults"] == []
    assert factor(run, measured, ANGLES, MOTION) < motion
    assert factor(run, measured, ("theta12", "theta22", "I1_measured", "I2_measured"), NOISE) < 3.0
    assert factor(run, measured, ("I1_measured", "I2_measured"), MOTION) < 2.0


def test_deflections_go_with_currents_and_hubs_as_those_of_the_arm_do(measured):
    real = correlations(measured)
    assert real == pytest.approx(REAL[measured.name], abs=0.005)
    found = correlations(beside(measured, UNITS[measured.name]))
    # Link 2 under LQR follows its hub less than the real one does; it hangs on link 1 more than on its own hub.
    away = [0.1, 0.1, 0.1, 0.2 if measured.name == "lqr" else 0.1]
    for value, truth, allowed in zip(found, real, away, strict=True):
        assert value == pytest.approx(truth, abs=allowed)


def test_each_set_is_nearer_to_its_own_unit_than_the_other_is(measured):
    def deviation(name):
        run = beside(measured, name)
        return np.array([np.log(run[n][600:].std() / measured[n][600:].std()) for n in ("theta11", "theta21")])

    own = UNITS[measured.name]
    other = next(name for name in UNITS.values() if name != own)
    assert np.abs(deviation(own)).sum() < 0.6 * np.abs(deviation(other)).sum()


def test_quantisation_steps_are_those_of_the_arm(measured):
    run = beside(measured, "effective")

    def step(values):
        found = np.diff(np.unique(np.round(values, 9)))
        return found[found > 1e-8].min()

    for name in ("theta11", "theta21"):
        assert step(run[name]) == pytest.approx(step(measured[name]), rel=1e-3)
    # The second laboratory has the Q8-USB; the first had a board of 12 bits.
    board = {"lqr": 1.0, "psf": 4.0}[measured.name]
    for name in ("I1_measured", "I2_measured"):
        assert board * step(run[name]) == pytest.approx(step(measured[name]), rel=1e-3)
