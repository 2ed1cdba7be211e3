"""Threads beside the one that Ctrl-C interrupts: what they compute in the core ends with it."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar

from ftlm import _core

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
