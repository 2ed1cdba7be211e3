"""HTTP server on 127.0.0.1: routes, request checks, token, timeouts."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import importlib.util
import json
import secrets
import signal
import socket
import sys
import webbrowser
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs

from ftlm.app import views as view
from ftlm.app.forms import parse_fields
from ftlm.app.session import STATE_MADE, Session
from ftlm.errors import DataError, FtlmError, ModelError
from ftlm.utils.parameters import setting, use_interface

if TYPE_CHECKING:
    from uvicorn.protocols.http.h11_impl import H11Protocol

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]

#: Longest body of a request that uploads no file.
MAX_BODY_BYTES = 64 << 10
#: Allows only the page's own script, style and server, and no embedding in frames.
CONTENT_SECURITY_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
#: Reports are sandboxed: their scripts cannot access the application.
REPORT_POLICY = "sandbox allow-scripts; frame-ancestors 'none'"
SECURITY_HEADERS = {
    "content-security-policy": CONTENT_SECURITY_POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "x-frame-options": "DENY",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
}
HTML_TYPE, JSON_TYPE, TEXT_TYPE = "text/html; charset=utf-8", "application/json", "text/plain; charset=utf-8"


@dataclass(frozen=True)
class HttpResponse:
    """HTTP response.

    Parameters
    ----------
    status
        HTTP status code.
    body
        Text or bytes.
    content_type
        Media type of the body.
    extra_headers
        Additional headers.
    """

    status: int
    body: str | bytes = ""
    content_type: str = JSON_TYPE
    extra_headers: Mapping[str, str] | None = None


class RefusedError(Exception):
    """Refusal of a request, with HTTP status and reason."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


@dataclass
class Request:
    """Request with a valid head."""

    method: str
    path: list[str]
    query: dict[str, str]
    headers: dict[str, str]
    receive: Receive

    async def chunks(self) -> AsyncIterator[bytes]:
        """Yield the body in chunks; raise for a truncated body."""
        while True:
            message = await self.receive()
            if message["type"] == "http.disconnect":
                raise RefusedError(400, "the upload was cut off; try again")
            if message.get("body"):
                yield message["body"]
            if not message.get("more_body"):
                return

    async def read_json(self) -> dict[str, Any]:
        """Return the body as a JSON object."""
        body = b""
        async for chunk in self.chunks():
            body += chunk
            if len(body) > MAX_BODY_BYTES:
                raise RefusedError(413, f"the request is longer than {MAX_BODY_BYTES >> 10} kB")
        try:
            said = json.loads(body)
        except (ValueError, RecursionError):
            raise RefusedError(400, "the request is no JSON") from None
        if not isinstance(said, dict):
            raise RefusedError(400, "the request is no JSON object")
        return said


class WebApplication:
    """ASGI application of the page.

    Parameters
    ----------
    desk
        Session to serve.
    token
        Secret part of the address.
    hosts
        Accepted host names with ports.
    key
        Secret of the one-time address that redirects to the permanent one.
    """

    def __init__(self, desk: Session, token: str, hosts: tuple[str, ...], key: str = "") -> None:
        self._desk = desk
        self._token = token
        self._hosts = hosts
        self._key = key

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            return
        try:
            answer = await self._dispatch(self._check_request(scope, receive))
        except _RedirectError:
            answer = HttpResponse(303, extra_headers={"location": f"/{self._token}/"})
        except RefusedError as refused:
            answer = HttpResponse(refused.status, json.dumps({"error": str(refused)}))
        except FtlmError as error:
            words = view.page_words(self._desk.without_paths(str(error)))
            answer = HttpResponse(400, json.dumps({"error": words}))
        except Exception as error:
            # The page must be told; a traceback would name folders of this machine.
            answer = HttpResponse(500, json.dumps({"error": f"a fault in ftlm itself ({type(error).__name__})"}))
        body = answer.body.encode("utf-8", "replace") if isinstance(answer.body, str) else answer.body
        headers = {
            **SECURITY_HEADERS,
            "content-type": answer.content_type,
            "content-length": str(len(body)),
            **(answer.extra_headers or {}),
        }
        if answer.status in (403, 404, 413, 415):
            # What is left of a refused body is not waited for.
            headers["connection"] = "close"
        pairs = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
        await send({"type": "http.response.start", "status": answer.status, "headers": pairs})
        await send({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else body})

    def _check_request(self, scope: Scope, receive: Receive) -> Request:
        """Check the head of a request and parse it."""
        headers: dict[str, str] = {}
        for name, value in scope["headers"]:
            key = name.decode("latin-1").lower()
            if key in headers and key in ("host", "origin", "content-length"):
                raise RefusedError(400, f"the header {key} is given twice")
            headers[key] = value.decode("latin-1")
        if headers.get("host", "").lower() not in self._hosts:
            raise RefusedError(403, "this page answers to its own address alone")
        method, origin = scope["method"], headers.get("origin")
        if origin is not None and origin not in {f"http://{host}" for host in self._hosts}:
            raise RefusedError(403, "another page asks; this one answers to itself alone")
        if method not in ("GET", "HEAD") and (
            origin is None or headers.get("sec-fetch-site", "same-origin") != "same-origin"
        ):
            raise RefusedError(403, "only the page itself may change what is on it")
        path = scope["path"].split("/")[1:]
        if method == "GET" and len(path) == 2 and path[0] == "open":
            self._redeem_key(path[1])
        if not secrets.compare_digest(path[0].encode("utf-8", "replace"), self._token.encode()):
            raise RefusedError(404, "there is nothing here; use the address that ftlm app printed")
        try:
            query = parse_qs(scope["query_string"].decode("latin-1"), max_num_fields=10, errors="replace")
        except ValueError:
            raise RefusedError(400, "the address has too many fields") from None
        return Request(method, path[1:], {k: v[0] for k, v in query.items()}, headers, receive)

    def _redeem_key(self, key: str) -> None:
        """Redirect the first visitor with the one-time key. The key is visible in the command line of the browser."""
        good = bool(self._key) and secrets.compare_digest(key.encode("utf-8", "replace"), self._key.encode())
        if not good:
            raise RefusedError(404, "this address was good once; the one that lasts is in the terminal of ftlm app")
        self._key = ""
        raise _RedirectError(303, "")

    async def _dispatch(self, request: Request) -> HttpResponse:
        """Return the response of the route."""
        method = "GET" if request.method == "HEAD" else request.method
        match method, request.path:
            case "GET", []:
                raise _RedirectError(303, "")
            case "GET", [""]:
                return HttpResponse(200, view.page(self._desk), HTML_TYPE)
            case "GET", ["app.js"]:
                return HttpResponse(200, view.script(), "text/javascript; charset=utf-8")
            case "GET", ["app.css"]:
                return HttpResponse(200, view.style(), "text/css; charset=utf-8")
            case "GET", ["state"]:
                return HttpResponse(200, json.dumps(view.state(self._desk)))
            case "POST", ["files"]:
                return await self._upload(request)
            case _, ["files", key]:
                return await self._file(method, key, request)
            case "POST", ["models"]:
                model = self._desk.start(self._desk.parse_request(await request.read_json()))
                return HttpResponse(200, view.model(model), HTML_TYPE)
            case "POST", ["check"]:
                return HttpResponse(200, json.dumps({"error": self._request_problem(await request.read_json())}))
            case "GET", ["comparison"]:
                return HttpResponse(200, view.comparison(self._desk), HTML_TYPE)
            case _, ["models", key, *what]:
                return self._model(method, key, what)
        known = request.path in (
            [""],
            ["app.js"],
            ["app.css"],
            ["state"],
            ["files"],
            ["models"],
            ["check"],
            ["comparison"],
        )
        raise RefusedError(405 if known else 404, "there is nothing here" if not known else "not in this way")

    def _request_problem(self, wanted: Mapping[str, Any]) -> str:
        """Return the error message of a fit request, or "" if it is valid."""
        try:
            self._desk.parse_request(wanted)
        except FtlmError as error:
            return view.page_words(self._desk.without_paths(str(error)))
        return ""

    async def _upload(self, request: Request) -> HttpResponse:
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/octet-stream":
            raise RefusedError(415, "a file is sent as it is (application/octet-stream), not as a form")
        said = request.headers.get("content-length")
        # Of more digits than Python reads none is a size; what comes is counted whatever is said.
        size = int(said) if said is not None and said.isascii() and said.isdigit() and len(said) < 20 else None
        name = request.query.get("name", "")
        try:
            self._desk.check_room(name, size)
            file = await self._desk.take(name, size, request.chunks())
        except FtlmError as error:
            raise RefusedError(413, self._desk.without_paths(str(error))) from None
        return HttpResponse(200, view.file(file), HTML_TYPE)

    async def _file(self, method: str, key: str, request: Request) -> HttpResponse:
        file = self._desk.files.get(key)
        if file is None:
            raise RefusedError(404, "this file is no longer on the page")
        match method:
            case "GET":
                pass
            case "POST":
                file.user_options = parse_fields(await request.read_json())
                await self._desk.open(file)
            case "DELETE":
                self._desk.remove_file(key)
                return HttpResponse(200, "{}")
            case _:
                raise RefusedError(405, "not in this way")
        return HttpResponse(200, view.file(file), HTML_TYPE)

    def _model(self, method: str, key: str, what: list[str]) -> HttpResponse:
        model = self._desk.models.get(key)
        if model is None:
            raise RefusedError(404, "this model is no longer on the page")
        match method, what:
            case "GET", []:
                return HttpResponse(200, view.model(model), HTML_TYPE)
            case "POST", ["stop"]:
                self._desk.stop(key)
                return HttpResponse(200, view.model(model), HTML_TYPE)
            case "POST", ["resume"]:
                return HttpResponse(200, view.model(self._desk.resume(key)), HTML_TYPE)
            case "DELETE", []:
                self._desk.remove_model(key)
                return HttpResponse(200, "{}")
            case "GET", ["report" | "model" | "script" | "page"]:
                if model.state != STATE_MADE or model.description is None:
                    raise RefusedError(404, "this model is not made yet")
                return self._download(key, what[0], Path(model.recipe.estimation.file).stem)
        raise RefusedError(405 if what in ([], ["stop"], ["resume"]) else 404, "not in this way")

    def _download(self, key: str, what: str, stem: str) -> HttpResponse:
        """Return a file of a model. Its path never comes from the request."""
        model = self._desk.models[key]
        ending, kind = {
            "report": ("report.html", HTML_TYPE),
            "page": ("report.html", HTML_TYPE),
            "model": ("model.json", JSON_TYPE),
            "script": ("script.py", TEXT_TYPE),
        }[what]
        if what == "script":
            content = str((model.description or {})["script"]).encode("utf-8", "replace")
        else:
            suffix = "json" if what == "model" else "html"
            try:
                content = (self._desk.folder / f"{key}.{suffix}").read_bytes()
            except OSError:
                raise RefusedError(404, "its file is no longer there") from None
        policy = {"content-security-policy": REPORT_POLICY}
        if what == "page":
            return HttpResponse(200, content, kind, policy)
        plain = "".join(c if c.isascii() and (c.isalnum() or c in "._-") else "_" for c in stem)[:80] or "ftlm"
        name = f'attachment; filename="{plain}-{model.number}-{ending}"'
        return HttpResponse(200, content, kind, {"content-disposition": name, **policy})


class _RedirectError(RefusedError):
    """Redirect to the permanent address."""


#: Time that a client may take for a request head, between two parts of a body, and to read a part of an answer.
CLIENT_TIMEOUT_S = 20.0


def make_connection_class() -> type[H11Protocol]:
    """Return a connection class of uvicorn that checks its client twice per :data:`CLIENT_TIMEOUT_S`.

    The keep-alive limit of uvicorn only covers connections that are idle after an answer.
    """
    import h11  # noqa: PLC0415 — an extra
    from uvicorn.protocols.http.h11_impl import H11Protocol  # noqa: PLC0415 — an extra

    class Connection(H11Protocol):
        """HTTP connection that closes itself after a timeout."""

        _since = 0.0
        _unread = 0
        _next: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            """Start the timeout."""
            super().connection_made(transport)
            self._since = self.loop.time()
            self._schedule_check()

        def data_received(self, data: bytes) -> None:
            """Restart the timeout at each part of a body, and at the end of a head."""
            before = self.conn.their_state
            super().data_received(data)
            if self.conn.their_state is not before or before is h11.SEND_BODY:
                self._since = self.loop.time()

        def on_response_complete(self) -> None:
            """Restart the timeout for the next request head."""
            super().on_response_complete()
            self._since = self.loop.time()

        def connection_lost(self, exc: Exception | None) -> None:
            """Cancel the timeout."""
            if self._next is not None:
                self._next.cancel()
            super().connection_lost(exc)

        def _schedule_check(self) -> None:
            self._next = self.loop.call_later(CLIENT_TIMEOUT_S / 2, self._check_timeout)

        def _check_timeout(self) -> None:
            """Abort the connection if the client sends nothing or does not read its answer."""
            unread, before = self.transport.get_write_buffer_size(), self._unread
            self._unread = unread
            if unread < before or (unread and not before):
                self._since = self.loop.time()
            owes = bool(unread) or self.conn.their_state in (h11.IDLE, h11.SEND_BODY)
            if owes and self.loop.time() - self._since >= CLIENT_TIMEOUT_S:
                # Not closed: that would wait for what was sent to be read.
                self.transport.abort()
            else:
                self._schedule_check()

    return Connection


#: Default address and port, limit of connections, and chunk size of files read from disk.
DEFAULT_PORT, LOOPBACK_ADDRESS = 8347, "127.0.0.1"
MAX_CONNECTIONS = 100
READ_CHUNK_BYTES = 1 << 20


def check_installed() -> None:
    """Raise if the server package is not installed."""
    if importlib.util.find_spec("uvicorn") is None:
        raise ModelError("ftlm app needs uvicorn; run: pip install 'ftlm[app]'")


def open_socket(port: int | None) -> tuple[socket.socket, str]:
    """Open a socket on the loopback address; return it with a note about its port.

    Parameters
    ----------
    port
        Port; None for the default, or for any free one if the default is taken.

    Raises
    ------
    ModelError
        A port out of range.
    DataError
        A port that is taken or not allowed.
    """
    if port is not None and not 0 <= port <= 65535:
        raise ModelError(f"{setting('port')} {port} is none; take one from 1024 to 65535, or 0 for any")
    wanted = DEFAULT_PORT if port is None else port
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if sys.platform != "win32":
        # There it would let two programs share the port.
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((LOOPBACK_ADDRESS, wanted))
        sock.listen(MAX_CONNECTIONS)
    except OSError as error:
        sock.close()
        taken = error.errno == errno.EADDRINUSE
        if port is None and taken:
            return open_socket(0)[
                0
            ], f"port {DEFAULT_PORT} is taken, perhaps by another ftlm app; this one has a port of its own"
        why = "is taken, perhaps by another ftlm app" if taken else f"cannot be used ({error.strerror})"
        raise DataError(f"{setting('port')} {wanted} {why}; take another one, or leave it out") from None
    return sock, ""


def serve(files: Sequence[str] = (), *, port: int | None = None, browser: bool = True) -> None:
    """Serve the application until Ctrl-C.

    Parameters
    ----------
    files
        Files to open at the start.
    port
        Port on 127.0.0.1.
    browser
        Whether to open a browser.

    Raises
    ------
    DataError
        A file that does not exist, or a port that is taken.
    ModelError
        The server package is not installed.
    """
    check_installed()
    paths = [Path(file) for file in files]
    for path in paths:
        if not path.is_file():
            raise DataError(f"{str(path)!r} is no file; check the path")
    sock, note = open_socket(port)
    if note:
        print(f"ftlm: {note}", file=sys.stderr)
    # The page turns parameters of Python into labels of its fields.
    with sock, use_interface("python"), contextlib.suppress(KeyboardInterrupt):
        asyncio.run(_serve(sock, paths, browser))
    print("\nftlm app has ended; its files are removed", file=sys.stderr)


async def _serve(sock: socket.socket, paths: Sequence[Path], browser: bool) -> None:
    import uvicorn  # noqa: PLC0415 — an extra

    token, key = secrets.token_urlsafe(24), secrets.token_urlsafe(24)
    own = sock.getsockname()[1]
    hosts = (f"{LOOPBACK_ADDRESS}:{own}", f"localhost:{own}")
    desk = Session()
    config = uvicorn.Config(
        WebApplication(desk, token, hosts, key if browser else ""),
        log_config=None,
        log_level="critical",
        access_log=False,
        lifespan="off",
        server_header=False,
        ws="none",
        http=make_connection_class(),
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
            await desk.take(path.name, path.stat().st_size, _read_chunks(path))
        print(f"ftlm app: {address}\nCtrl-C ends it. Who knows this address can use it: do not pass it on.", flush=True)
        opener = None
        if browser:
            first = f"http://{hosts[0]}/open/{key}"
            opener = asyncio.get_running_loop().run_in_executor(None, webbrowser.open, first)
        await server.serve(sockets=[sock])
        del opener
    finally:
        # Ctrl-C cancels the next await, which must not skip the cleanup.
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(0)
        await desk.close()


async def _read_chunks(path: Path) -> AsyncIterator[bytes]:
    """Yield the chunks of a file on this machine."""
    with open(path, "rb") as stream:
        while piece := stream.read(READ_CHUNK_BYTES):
            yield piece
