"""``ftlm`` and ``python -m ftlm``: the command line, whose imports take a moment that may be interrupted as well."""

import importlib
import os
import signal


def main() -> None:
    """Entry point."""
    # An exception in the middle of an import may become any other one on its way through libraries.
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, _leave)
    run = importlib.import_module("ftlm.cli").main
    if ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    run()


def _leave(*_: object) -> None:
    os.write(2, b"ftlm: interrupted; nothing was written\n")
    os._exit(130)


if __name__ == "__main__":
    main()
