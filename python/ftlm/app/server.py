"""HTTP server of the web app on 127.0.0.1: socket, start and shutdown."""

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

from ftlm.app.session import Session
from ftlm.errors import DataError, ModelError
from ftlm.utils.parameters import setting, use_interface

#: Default port, loopback address, maximum number of connections, and chunk size of files that are read from disk.
DEFAULT_PORT, LOOPBACK_ADDRESS = 8347, "127.0.0.1"
MAX_CONNECTIONS = 100
READ_CHUNK_BYTES = 1 << 20


def check_installed() -> None:
    """Raise ModelError if a package that the server requires is not installed."""
    for package in ("uvicorn", "starlette"):
        if importlib.util.find_spec(package) is None:
            raise ModelError(f"ftlm app needs {package}; run: pip install 'ftlm[app]'")


def open_socket(port: int | None) -> tuple[socket.socket, str]:
    """Open a listening socket on the loopback address.

    Parameters
    ----------
    port
        Port number. None selects the default port, or a free port if the default port is in use.

    Returns
    -------
    tuple
        The socket, and a note for the user if the default port is in use (otherwise empty).

    Raises
    ------
    ModelError
        If the port is out of range.
    DataError
        If the given port is in use, or a port cannot be opened.
    """
    if port is not None and not 0 <= port <= 65535:
        raise ModelError(f"{setting('port')} {port} is not a valid port; take one from 1024 to 65535, or 0 for any")
    port_number = DEFAULT_PORT if port is None else port
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if sys.platform != "win32":
        # On Windows, this option would let two programs share the port.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((LOOPBACK_ADDRESS, port_number))
        sock.listen(MAX_CONNECTIONS)
    except OSError as error:
        sock.close()
        is_taken = error.errno == errno.EADDRINUSE
        if port is None and is_taken:
            return open_socket(0)[
                0
            ], f"port {DEFAULT_PORT} is taken, perhaps by another ftlm app; this one has a port of its own"
        reason = "is taken, perhaps by another ftlm app" if is_taken else f"cannot be used ({error.strerror})"
        raise DataError(f"{setting('port')} {port_number} {reason}; take another one, or leave it out") from None
    return sock, ""


def serve(files: Sequence[str] = (), *, port: int | None = None, browser: bool = True) -> None:
    """Run the web application until Ctrl-C; files of the session are removed at the end.

    Parameters
    ----------
    files
        Files to open at the start.
    port
        Port on 127.0.0.1; None for the default port, or a free port if it is in use.
    browser
        Whether the address is opened in a browser.

    Raises
    ------
    DataError
        If a file does not exist, or the port is in use.
    ModelError
        If a package of the server is not installed, or the port is out of range.
    """
    check_installed()
    paths = [Path(file) for file in files]
    for path in paths:
        if not path.is_file():
            raise DataError(f"{str(path)!r} is not a file; check the path")
    sock, note = open_socket(port)
    if note:
        print(f"ftlm: {note}", file=sys.stderr)
    with sock, use_interface("app"), contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(sock, paths, browser))
    print("\nftlm app has ended; its files are removed", file=sys.stderr)


async def _serve(sock: socket.socket, paths: Sequence[Path], browser: bool) -> None:
    import uvicorn  # noqa: PLC0415 — an extra

    from ftlm.app.web_application import TimedConnection, WebApplication  # noqa: PLC0415 — needs an extra

    token, key = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
    own = sock.getsockname()[1]
    hosts = (f"{LOOPBACK_ADDRESS}:{own}", f"localhost:{own}")
    session = Session()
    config = uvicorn.Config(
        WebApplication(session, token, hosts, key if browser else ""),
        log_config=None,
        log_level="critical",
        access_log=False,
        lifespan="off",
        server_header=False,
        ws="none",
        http=TimedConnection,
        loop="asyncio",
        timeout_keep_alive=15,
        timeout_graceful_shutdown=1,
        limit_concurrency=MAX_CONNECTIONS,
        proxy_headers=False,
    )
    server = uvicorn.Server(config)
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is not signal.SIG_IGN:
            signal.signal(getattr(signal, name), lambda *_: setattr(server, "should_exit", True))
    address = f"http://{hosts[0]}/{token}/"
    try:
        for path in paths:
            await session.store_upload(path.name, path.stat().st_size, _read_chunks(path))
        print(f"ftlm app: {address}\nCtrl-C ends it. Who knows this address can use it: do not pass it on.", flush=True)
        opener = None
        if browser:
            first = f"http://{hosts[0]}/open/{key}"
            opener = asyncio.get_running_loop().run_in_executor(None, webbrowser.open, first)
        await server.serve(sockets=[sock])
        del opener
    finally:
        # Ctrl-C cancels the next await. This one is cancelled in place of the cleanup.
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(0)
        await session.close()


async def _read_chunks(path: Path) -> AsyncIterator[bytes]:
    """Yield the content of a local file in chunks of `READ_CHUNK_BYTES` bytes."""
    with open(path, "rb") as stream:
        while piece := stream.read(READ_CHUNK_BYTES):
            yield piece
