"""Two threads that start together, with a switch interval that keeps one from running in Python for the other."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

import pytest

#: Pairs of calls that are tried until one overlaps: on a busy machine a call may end before the other thread wakes.
MAX_PAIRS = 200


def overlap(work: Callable[[int], object], monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> bool:
    """Whether two threads are ever within a function at once, which `work` calls in each of them."""
    call, inside, most = getattr(owner, name), [0], [0]

    def watched(*arguments: object, **keywords: object) -> object:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        try:
            return call(*arguments, **keywords)
        finally:
            inside[0] -= 1

    monkeypatch.setattr(owner, name, watched)
    for _ in range(MAX_PAIRS):
        barrier = threading.Barrier(2)
        run_in_two_threads(lambda key, barrier=barrier: (barrier.wait(), work(key)))
        if most == [2]:
            return True
    return False


def run_in_two_threads(work: Callable[[int], object]) -> None:
    """Call `work` with 0 and with 1 in threads of their own; who holds the global lock keeps it for a minute."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(60.0)
    try:
        threads = [threading.Thread(target=work, args=(key,)) for key in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
