"""``ftlm`` and ``python -m ftlm``: the command line, whose imports take a moment that may be interrupted as well."""

import os
import signal
import threading

from ftlm.cli import main


def _leave(*_: object) -> None:
    os.write(2, b"ftlm: interrupted; nothing was written\n")
    os._exit(130)


# An exception in the middle of an import may become any other one on its way through libraries.
_OURS = (
    signal.getsignal(signal.SIGINT) is signal.default_int_handler
    and threading.current_thread() is threading.main_thread()
)
if _OURS:
    signal.signal(signal.SIGINT, _leave)

if _OURS:
    signal.signal(signal.SIGINT, signal.default_int_handler)

__all__ = ["main"]

if __name__ == "__main__":
    main()
