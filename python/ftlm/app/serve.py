"""Starts the page: a port on 127.0.0.1, a token, the browser, and the way out."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import importlib.util
import secrets
import signal
import socket
import sys
import webbrowser
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

from ftlm.app.connection import patient
from ftlm.app.desk import Desk
from ftlm.app.web import Door
from ftlm.base.errors import DataError, ModelError

#: Where the page is if nobody says otherwise, and whoever else takes part of a request at a time.
PORT, ADDRESS = 8347, "127.0.0.1"
MOST_CONNECTIONS = 100
CHUNK = 1 << 20


def check_installed() -> None:
    """Refuse where what serves pages is missing."""
    if importlib.util.find_spec("uvicorn") is None:
        raise ModelError("ftlm app needs uvicorn; run: pip install 'ftlm[app]'")


def listening(port: int | None) -> tuple[socket.socket, str]:
    """A socket that listens on this machine alone, and what is to be said of its port.

    Parameters
    ----------
    port
        Which; None for the usual one, or any other where that is taken.

    Raises
    ------
    DataError
        The port is taken, not allowed, or none.
    """
    if port is not None and not 0 <= port <= 65535:
        raise ModelError(f"--port {port} is none; take one from 1024 to 65535, or 0 for any")
    wanted = PORT if port is None else port
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if sys.platform != "win32":
        # There it would let two programs share the port.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((ADDRESS, wanted))
        sock.listen(MOST_CONNECTIONS)
    except OSError as error:
        sock.close()
        taken = error.errno == errno.EADDRINUSE
        if port is None and taken:
            return listening(0)[0], f"port {PORT} is taken, perhaps by another ftlm app; this one has a port of its own"
        why = "is taken, perhaps by another ftlm app" if taken else f"cannot be used ({error.strerror})"
        raise DataError(f"--port {wanted} {why}; take another one, or leave it out") from None
    return sock, ""


def serve(files: Sequence[str] = (), *, port: int | None = None, browser: bool = True) -> None:
    """Serve the page until Ctrl-C.

    Parameters
    ----------
    files
        To open at once.
    port
        Of 127.0.0.1.
    browser
        Whether to open a browser.

    Raises
    ------
    DataError
        A file that is not there, a port that is taken.
    ModelError
        What serves pages is not installed.
    """
    check_installed()
    paths = [Path(file) for file in files]
    for path in paths:
        if not path.is_file():
            raise DataError(f"{str(path)!r} is no file; check the path")
    sock, note = listening(port)
    if note:
        print(f"ftlm: {note}", file=sys.stderr)
    with sock, contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(sock, paths, browser))
    print("\nftlm app has ended; its files are removed", file=sys.stderr)


async def _serve(sock: socket.socket, paths: Sequence[Path], browser: bool) -> None:
    import uvicorn  # noqa: PLC0415 — an extra

    token, key = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
    own = sock.getsockname()[1]
    hosts = (f"{ADDRESS}:{own}", f"localhost:{own}")
    desk = Desk()
    config = uvicorn.Config(
        Door(desk, token, hosts, key if browser else ""), log_config=None, log_level="critical", access_log=False,
        lifespan="off", server_header=False, ws="none", http=patient(), loop="asyncio", timeout_keep_alive=15,
        timeout_graceful_shutdown=1, limit_concurrency=MOST_CONNECTIONS, proxy_headers=False,
    )  # fmt: skip
    server = uvicorn.Server(config)
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
            signal.signal(getattr(signal, name), lambda *_: setattr(server, "should_exit", True))
    address = f"http://{hosts[0]}/{token}/"
    try:
        for path in paths:
            await desk.take(path.name, path.stat().st_size, _pieces(path))
        print(f"ftlm app: {address}\nCtrl-C ends it. Who knows this address can use it: do not pass it on.", flush=True)
        opener = None
        if browser:
            first = f"http://{hosts[0]}/open/{key}"
            opener = asyncio.get_running_loop().run_in_executor(None, webbrowser.open, first)
        await server.serve(sockets=[sock])
        del opener
    finally:
        # Ctrl-C cancels what is awaited next, which must not be the end of the work.
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(0)
        await desk.close()


async def _pieces(path: Path) -> AsyncIterator[bytes]:
    """A file of this machine, in pieces."""
    with open(path, "rb") as stream:
        while piece := stream.read(CHUNK):
            yield piece
