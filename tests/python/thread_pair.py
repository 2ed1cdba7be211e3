"""Two threads that start together, with a switch interval that keeps one from running in Python for the other."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable


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
