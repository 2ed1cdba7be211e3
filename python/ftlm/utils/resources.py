"""How much memory a search may take: what is given, or a share of what the machine has left."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import numpy as np

from ftlm import _core
from ftlm.errors import ModelError

#: Environment variable that gives the limit: bytes, or a number with K, M, G or T (powers of 1024).
GIVEN = "FTLM_MEMORY"
#: Share of the memory at hand that a search takes unasked: the rest is for records, threads and other programs.
SHARE = 0.8
#: Bytes where the system tells nothing.
UNKNOWN = 2 << 30
_SYSTEM = Path("/")


def memory_limit(system: Path = _SYSTEM) -> int:
    """Bytes that regressors, products, test vectors and layouts of a search may take together.

    Parameters
    ----------
    system
        Where the system's files lie.

    Raises
    ------
    ModelError
        ``FTLM_MEMORY`` is no positive size.
    """
    given = os.environ.get(GIVEN, "")
    if given:
        size = re.fullmatch(r"([0-9]{1,18})([KMGT]?)(?:i?B)?", given.strip(), re.ASCII)
        count = int(size[1]) << 10 * " KMGT".index(size[2] or " ") if size else 0
        if not 0 < count < 1 << 63:
            raise ModelError(f"{GIVEN}={given!r} is no size of memory; give bytes, or a number with K, M, G or T")
        return count
    return int(SHARE * (available_memory(system) or UNKNOWN / SHARE))


def available_memory(system: Path = _SYSTEM) -> int | None:
    """Bytes that this process can still take before the system swaps or ends it; None where the system tells nothing.

    The least of what the kernel calls available and what every control group above this process has left.
    """
    left = [*_of_kernel(system), *_of_groups(system)]
    if not left:
        try:
            left = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2]
        except (AttributeError, ValueError, OSError):  # not on Windows
            return None
    return max(min(left), 1)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""


def _of_kernel(system: Path) -> list[int]:
    found = re.search(r"^MemAvailable:\s+([0-9]+) kB", _text(system / "proc/meminfo"), re.MULTILINE)
    return [int(found[1]) << 10] if found else []


def _of_groups(system: Path) -> list[int]:
    """What each control group has left, its files in memory that can be dropped counted as left; both versions."""
    left = []
    for line in _text(system / "proc/self/cgroup").splitlines():
        number, controllers, name = (*line.split(":", 2), "", "")[:3]
        if number == "0" and not controllers:
            root, most, now, droppable = "sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"
        elif "memory" in controllers.split(","):
            root, most, now, droppable = (
                "sys/fs/cgroup/memory",
                "memory.limit_in_bytes",
                "memory.usage_in_bytes",
                "total_inactive_file",
            )
        else:
            continue
        parts = [part for part in name.split("/") if part not in ("", "..")]
        for depth in range(len(parts), -1, -1):
            folder = system.joinpath(root, *parts[:depth])
            limit, used = _text(folder / most).strip(), _text(folder / now).strip()
            # "max" is no limit; one beyond all memory is the older version's way to say so.
            if limit.isdecimal() and used.isdecimal() and int(limit) < 1 << 60:
                found = re.search(rf"^{droppable} ([0-9]+)$", _text(folder / "memory.stat"), re.MULTILINE)
                left.append(int(limit) - int(used) + (int(found[1]) if found else 0))
    return left


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


_STOP: ContextVar[_core.Stop | None] = ContextVar("stop", default=None)


def stop() -> _core.Stop | None:
    """The flag that ends what this thread computes; None for one that is interrupted itself."""
    return _STOP.get()


@contextmanager
def pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Threads that work for this one: where it is interrupted, they end what they compute and take up nothing more."""
    flag = stop() or _core.Stop()
    with ThreadPoolExecutor(threads, initializer=_STOP.set, initargs=(flag,)) as made:
        try:
            yield made
        except BaseException as error:
            if not isinstance(error, Exception):
                flag.set()
            made.shutdown(wait=False, cancel_futures=True)
            raise
