"""How much memory a search may take: what is given, or a share of what the machine has left."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ftlm.base.errors import ModelError

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
                "sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file",
            )  # fmt: skip
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
