"""How fast this machine is, as far as a first guess of how long work takes needs it."""

from __future__ import annotations

import time

import numpy as np

#: Length of the transform that is timed, for how long [s], and what one takes on the machine whose figures are known
#: [s]: two cores of an x86-64 server, quiet.
LENGTH, TIMED, KNOWN = 4096, 0.03, 1.5e-5
#: Fits by output error took between these multiples of what their samples and numbers let expect: how many starts lead
#: somewhere, and how far, is seen only then.
FITS = (0.4, 6.0)
#: Samples beyond which a fit takes longer by fewer laps over all of them alone.
LONG = 10_000
#: A second core takes this share of the work off the first.
PARALLEL = 0.7


def pace() -> float:
    """How many times as long as the known machine this one takes for a core's work now, others' work on it included."""
    values, count = np.ones(LENGTH), 0
    begun = time.perf_counter()
    while time.perf_counter() - begun < TIMED:
        np.fft.rfft(values)
        count += 1
    return max((time.perf_counter() - begun) / max(count, 1) / KNOWN, 0.1)


def expected(seconds: float, threads: int) -> float:
    """Seconds that work takes here, of which the known machine needs so many on one core."""
    return seconds * pace() / (1.0 + PARALLEL * (max(threads, 1) - 1))


def between(seconds: float, came_to: tuple[float, float] = FITS) -> tuple[float, float]:
    """Between which times work ends that came to these multiples of what was expected."""
    return came_to[0] * seconds, came_to[1] * seconds


def by_output_error(samples: int, numbers: int) -> float:
    """Seconds of one core that a fit by output error takes on the known machine, within :data:`FITS` of it.

    The race of starts grows with the numbers squared, what follows with the samples of all runs and outputs, of long
    records more slowly: most of their fit is on a part of them.
    """
    return 0.04 * numbers**2 + 3.5e-4 * min(samples, LONG) + 2e-5 * samples
