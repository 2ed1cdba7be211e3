"""How long a person waits for what tells of no progress: large files being read, long records run, loops judged."""

from __future__ import annotations

import os
from collections.abc import Sequence

from ftlm.base.pace import between, expected
from ftlm.base.progress import Progress
from ftlm.data.run import Run

#: What the machine that base/pace.py knows takes to read a byte and to judge a sample of an output [s], and between
#: which multiples of it that came out: numbers in few digits are more of them, free runs of lasting motion are refined.
OF_BYTE, OF_SAMPLE, CAME_TO = 8e-8, 4e-6, (0.4, 4.0)
#: A controller's design, and judging one sample of the model's numbers with it [s].
OF_DESIGN, OF_JUDGED = {"pid": 0.1, "lqg": 1.2}, {"pid": 0.005, "lqg": 0.01}


def expect_reading(files: Sequence[str]) -> None:
    """Say about how long it takes to read these files, where that is long."""
    size = 0
    for file in files:
        try:
            size += os.stat(file).st_size
        except (OSError, ValueError):
            # Who reads it says so in words.
            return
    if OF_BYTE * size > 0.2:
        Progress("").expect("reading", *between(expected(OF_BYTE * size, 1), CAME_TO))


def expect_judging(runs: Sequence[Run], outputs: int, *, quiet: bool) -> None:
    """Say about how long it takes to run a model of so many outputs over these runs, where that is long."""
    samples = outputs * sum(run.length for run in runs)
    if OF_SAMPLE * samples > 0.2:
        Progress("", quiet=quiet).expect("running the model", *between(expected(OF_SAMPLE * samples, 1), CAME_TO))


def expect_designing(design: str, samples: int) -> None:
    """Say about how long a design takes whose loop is judged on so many samples, where that is long."""
    seconds = OF_DESIGN[design] + OF_JUDGED[design] * max(samples, 0)
    Progress("").expect("designing", *between(expected(seconds, 1), CAME_TO))
