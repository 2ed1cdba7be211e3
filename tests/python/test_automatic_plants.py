"""The automatic structure of twelve plants: found, and as good as the truth where it was not fitted."""

from __future__ import annotations

import numpy as np
import pytest

import ftlm
from automatic_plants import NOISE_RATIOS, PLANTS


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_structures_of_twelve_plants_are_found_and_predict_as_the_truth() -> None:
    missed = []
    for name, plant in PLANTS.items():
        for seed, noise in enumerate(NOISE_RATIOS):
            run = plant.run(1000 + seed, noise=noise, name=f"{name} {seed}")
            other = plant.run(2000 + seed, noise=0.0, name="unseen")
            found = ftlm.select(run, "auto", threads=1)
            y, free = other["y"], found.best.model.simulate(other)["y"]
            # The truth has 100 %.
            assert 100 * float(np.linalg.norm(y - free) / np.linalg.norm(y - y.mean())) < 0.5, run.name
            if not plant.is_structure(found.winner.name):
                missed.append(f"{run.name}: {found.winner.name}")
    assert len(missed) <= 2, missed
