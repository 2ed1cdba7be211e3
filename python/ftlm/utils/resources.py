"""Resources of the machine: memory limit, speed, interruptible threads, and isolated processes."""

from __future__ import annotations

import importlib
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ftlm import _core
from ftlm.errors import ModelError

#: Environment variable with the memory limit: bytes, or a number with K, M, G or T (powers of 1024).
MEMORY_VARIABLE = "FTLM_MEMORY"
#: Default share of the available memory. The rest is for records, threads and other programs.
DEFAULT_MEMORY_FRACTION = 0.8
#: Memory limit if the system does not report the available memory.
FALLBACK_MEMORY_BYTES = 2 << 30
_SYSTEM_ROOT = Path("/")


def memory_limit(system: Path = _SYSTEM_ROOT) -> int:
    """Return the memory limit [bytes] of computations, from ``FTLM_MEMORY`` or 80 % of the available memory.

    Parameters
    ----------
    system
        Root folder of the system files, which tests replace.

    Raises
    ------
    ModelError
        If ``FTLM_MEMORY`` is not a positive size.
    """
    text = os.environ.get(MEMORY_VARIABLE, "")
    if text:
        size = re.fullmatch(r"([0-9]{1,18})([KMGT]?)(?:i?B)?", text.strip(), re.ASCII)
        count = int(size[1]) << 10 * " KMGT".index(size[2] or " ") if size else 0
        if not 0 < count < 1 << 63:
            raise ModelError(
                f"{MEMORY_VARIABLE}={text!r} is not a memory size; give bytes, or a number with K, M, G or T"
            )
        return count
    return int(DEFAULT_MEMORY_FRACTION * (available_memory(system) or FALLBACK_MEMORY_BYTES / DEFAULT_MEMORY_FRACTION))


def available_memory(system: Path = _SYSTEM_ROOT) -> int | None:
    """Return the memory [bytes] that this process can still use without swapping; None if the system reports none.

    It is the minimum of the available memory that the kernel reports and the free memory of each control group of this
    process. Without such reports, it is half of the physical memory.
    """
    amounts = [*_kernel_available_bytes(system), *_cgroup_available_bytes(system)]
    if not amounts:
        try:
            amounts = [os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2]
        except (AttributeError, ValueError, OSError):  # not on Windows
            return None
    return max(min(amounts), 1)


def _read_text(path: Path) -> str:
    try:
        # These files are read before each simulation, and reading in text mode takes twice as long.
        with path.open("rb", buffering=0) as file:
            return file.read().decode("ascii", "replace")
    except OSError:
        return ""


def _kernel_available_bytes(system: Path) -> list[int]:
    match = re.search(r"^MemAvailable:\s+([0-9]+) kB", _read_text(system / "proc/meminfo"), re.MULTILINE)
    return [int(match[1]) << 10] if match else []


#: Folder, file with the limit, file with the usage, and key of the reclaimable cache, by version of control groups.
_CGROUP_FILES = {
    1: ("sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    2: ("sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
}


def _cgroup_available_bytes(system: Path) -> list[int]:
    """Return the free memory [bytes] of each control group with a limit; reclaimable page cache counts as free."""
    amounts = []
    # The process can be moved to other groups, and limits can change, so their files are read anew.
    for limit_file, usage_file, cache_file, cache_key in _cgroup_files(system, _read_text(system / "proc/self/cgroup")):
        limit = _read_text(limit_file).strip()
        # In version 2 "max" means no limit, and in version 1 a huge number does.
        if not limit.isdecimal() or int(limit) >= 1 << 60:
            continue
        usage = _read_text(usage_file).strip()
        if usage.isdecimal():
            match = re.search(rf"^{cache_key} ([0-9]+)$", _read_text(cache_file), re.MULTILINE)
            amounts.append(int(limit) - int(usage) + (int(match[1]) if match else 0))
    return amounts


@lru_cache(maxsize=4)
def _cgroup_files(system: Path, groups: str) -> tuple[tuple[Path, Path, Path, str], ...]:
    """Return, for each control group, the files with limit, usage and cache, and the key of the reclaimable cache.

    `groups` is the text of the file that lists the control groups of the process.
    """
    files = []
    for line in groups.splitlines():
        number, controllers, name = (*line.split(":", 2), "", "")[:3]
        version = 2 if number == "0" and not controllers else 1 if "memory" in controllers.split(",") else None
        if version is None:
            continue
        root, limit_file, usage_file, cache_key = _CGROUP_FILES[version]
        parts = [part for part in name.split("/") if part not in ("", "..")]
        for depth in range(len(parts), -1, -1):
            folder = system.joinpath(root, *parts[:depth])
            files.append((folder / limit_file, folder / usage_file, folder / "memory.stat", cache_key))
    return tuple(files)


#: Length of the timed FFT, duration of the measurement [s], and time of one FFT on the reference machine [s], two
#: cores of an idle x86-64 server.
BENCHMARK_FFT_LENGTH, BENCHMARK_DURATION_S, REFERENCE_FFT_TIME_S = 4096, 0.03, 1.5e-5
#: Range of the actual duration of an output-error fit relative to the estimate. The number of candidates in the
#: multistart and their iterations are not known in advance.
FIT_TIME_FACTORS = (0.4, 6.0)
#: Number of samples above which the duration increases more slowly, because most evaluations use a part of the record.
LONG_RECORD_SAMPLES = 10_000
#: Increase of the speedup by each additional core.
PARALLEL_EFFICIENCY = 0.7


def machine_slowdown() -> float:
    """Return the current computing time on one core relative to the reference machine, as measured with FFTs."""
    values, count = np.ones(BENCHMARK_FFT_LENGTH), 0
    start_time = time.perf_counter()
    while time.perf_counter() - start_time < BENCHMARK_DURATION_S:
        np.fft.rfft(values)
        count += 1
    return max((time.perf_counter() - start_time) / max(count, 1) / REFERENCE_FFT_TIME_S, 0.1)


def estimate_duration(seconds: float, threads: int) -> float:
    """Return the expected duration [s] of a computation on this machine with a number of threads.

    `seconds` is its time on one core of the reference machine.
    """
    return seconds * machine_slowdown() / (1.0 + PARALLEL_EFFICIENCY * (max(threads, 1) - 1))


def duration_bounds(seconds: float, factors: tuple[float, float] = FIT_TIME_FACTORS) -> tuple[float, float]:
    """Return the (shortest, longest) expected duration [s]: the estimate `seconds` times each of the two factors."""
    return factors[0] * seconds, factors[1] * seconds


def output_error_cost(samples: int, parameters: int) -> float:
    """Return the time [s] that an output-error fit takes on one core of the reference machine.

    `samples` is the number of samples of all runs and outputs, and `parameters` is the number of free parameters.
    Actual times differ from the result by factors within :data:`FIT_TIME_FACTORS`.

    The time of the multistart is proportional to the square of the number of parameters, and the remaining time to the
    number of samples. The increase is slower for long records, because most evaluations use a part of the record.
    """
    return 0.04 * parameters**2 + 3.5e-4 * min(samples, LONG_RECORD_SAMPLES) + 2e-5 * samples


_STOP_FLAG: ContextVar[_core.Stop | None] = ContextVar("stop", default=None)


def stop_flag() -> _core.Stop | None:
    """Return the stop flag that interrupts the Rust core in this thread; None outside of :func:`interruptible_pool`."""
    return _STOP_FLAG.get()


@contextmanager
def interruptible_pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Yield a thread pool; an interrupt in the ``with`` block stops running tasks and cancels queued tasks.

    Any other exception in the block only cancels queued tasks.
    """
    flag = stop_flag() or _core.Stop()
    with ThreadPoolExecutor(threads, initializer=_STOP_FLAG.set, initargs=(flag,)) as pool:
        try:
            yield pool
        except BaseException as error:
            if not isinstance(error, Exception):
                flag.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def subprocess_arguments(script: Path, *arguments: str, site: bool = True) -> dict[str, Any]:
    """Return arguments for :func:`subprocess.run` with which a script runs in an isolated Python process.

    The process must not import an uploaded or downloaded file as a module. Python therefore runs in the folder of its
    installation and isolated (``-I``: it searches neither ``PYTHONPATH`` nor the working directory). After the folders
    of Python, it searches the absolute module folders of this process, except the working directory.

    Parameters
    ----------
    script
        File to run.
    arguments
        Arguments of the script.
    site
        Whether Python sets up the site packages at the start, which takes some time.
    """
    working_folder = os.getcwd()
    folders = [folder for folder in sys.path if os.path.isabs(folder) and folder != working_folder]
    # This process may have imported the package from the working directory.
    folders.append(str(Path(__file__).resolve().parents[2]))
    program = f"import runpy, sys; sys.path += {folders!a}; runpy.run_path({str(script)!a}, run_name='__main__')"
    command = [sys.executable, "-I", *([] if site else ["-S"]), "-c", program, *arguments]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return {"args": command, "env": environment, "cwd": sys.prefix}


def run_in_worker(function: Callable[..., Any], *arguments: Any) -> Any:
    """Return ``function(*arguments)``; a worker process that calls this function ends when its parent process ends."""
    # Tasks of a process pool run in the main thread, those of a thread pool do not.
    if threading.current_thread() is threading.main_thread():
        _end_with_parent(os.getpid())
    return function(*arguments)


@cache
def _end_with_parent(_process: int) -> None:
    """Start a thread that ends this process when its parent process ends.

    This process would otherwise wait forever.
    """
    from multiprocessing import parent_process  # noqa: PLC0415 — pools alone import it

    parent = parent_process()
    if parent is not None:

        def wait() -> None:
            parent.join()
            os._exit(1)

        threading.Thread(target=wait, name="ftlm parent", daemon=True).start()


def optional_module(name: str, package: str, install: str) -> Any:
    """Return a module of an optional package; raise ModelError with the install command if it is missing."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ModelError(f"{package} is not installed; pip install {install}") from None


def python_control() -> Any:
    """Return the module of python-control; raise ModelError if it is not installed."""
    return optional_module("control", "python-control", "'ftlm[control]'")
