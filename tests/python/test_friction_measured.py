"""Hubs of the real arm with friction and offset, from the current: fitted runs, and steps that the model never saw."""

from __future__ import annotations

import numpy as np
import pytest

import ftlm
from measured import DATA, needs_data

pytestmark = [needs_data, pytest.mark.slow]
HUB = "D^2 theta11 = - v D theta11 + g I1 + k theta12 - fc*sign(D theta11) + c"
#: The amplifier's limit [A].
LIMIT = 0.94


def run_of(path: str, current: str, *, clip: float = np.inf, **options) -> ftlm.Run:
    """A run thinned to 8 ms, angles in rad."""
    angles = {"theta11": "th11_deg", "theta12": "th12_deg"}
    run = ftlm.load(
        DATA / path, time="t_s", inputs={"I1": current}, outputs=angles, units=dict.fromkeys(angles, "deg"), **options
    )
    return ftlm.Run.from_arrays(
        step=4 * run.step,
        inputs={"I1": np.clip(run["I1"], -clip, clip)[::4]},
        outputs={n: run[n][::4] for n in angles},
        name=path.rpartition("/")[2],
    )


@pytest.mark.parametrize(
    ("path", "options", "least"),
    [("two_link_psf/psf.csv", {"window": (1.1, 19.5)}, 98.0), ("two_link_lqr/lqr.csv", {}, 99.0)],
)
def test_a_hub_with_friction_follows_its_current(path: str, options, least: float) -> None:
    run = run_of(path, "Im1_meas_A", **options)
    found = ftlm.identify(run, ftlm.equation(HUB, initial="caputo"))
    assert found.fit["theta11"] >= least
    low, high = found.intervals["fc"]
    assert 0.0 < low < high < 10.0
    # Without friction the same equation is further off.
    plain = ftlm.identify(run, ftlm.equation(HUB.replace(" - fc*sign(D theta11)", ""), initial="caputo"))
    assert plain.fit["theta11"] < found.fit["theta11"]


def test_steps_that_were_not_fitted_are_predicted() -> None:
    steps = {
        n: run_of(f"two_link_steps/lqr_{n}.csv", "Im1_cmd_A", clip=LIMIT)
        for n in ("30", "20", "minus10", "minus20", "10", "minus30", "0_return")
    }
    fitted = ("30", "20", "minus10", "minus20")
    found = ftlm.identify([steps[n] for n in fitted], ftlm.equation(HUB, initial="caputo"))
    judged = [found.model.compare(steps[n]).fit["theta11"] for n in steps if n not in fitted]
    assert np.median(judged) >= 85.0
    assert min(judged) >= 60.0
