"""Entry point of ``ftlm`` and ``python -m ftlm``; Ctrl-C during imports ends the program without a traceback."""

import gc
import os
import signal
import threading


def _exit_interrupted(*_: object) -> None:
    os.write(2, b"ftlm: interrupted; nothing was written\n")
    os._exit(130)


# Libraries may convert a KeyboardInterrupt during an import to another exception.
_OWNS_INTERRUPT = (
    signal.getsignal(signal.SIGINT) is signal.default_int_handler
    and threading.current_thread() is threading.main_thread()
)
if _OWNS_INTERRUPT:
    signal.signal(signal.SIGINT, _exit_interrupted)
# Imports create no garbage, and the collector would take a twentieth of the start-up time.
gc.disable()
# The handler above must be in place during this import.
from ftlm.cli import main  # noqa: E402

gc.freeze()
gc.enable()

if _OWNS_INTERRUPT:
    signal.signal(signal.SIGINT, signal.default_int_handler)

__all__ = ["main"]

if __name__ == "__main__":
    main()
