"""Starlette application of the web app: request checks, routes, responses, and connection timeouts."""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import h11
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route, Router
from starlette.types import Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from ftlm.app import views as view
from ftlm.app.forms import parse_fields
from ftlm.app.session import STATE_MADE, File, Model, Session
from ftlm.errors import FtlmError

Item = TypeVar("Item", File, Model)
Endpoint = Callable[[Request], Awaitable[Response]]

#: Maximum size of the body of a request other than a file upload.
MAX_BODY_BYTES = 64 << 10
#: Security policy that allows only scripts and styles of this server, requests to it, and no embedding in frames.
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
MAX_QUERY_FIELDS = 10
#: (file name of the download, media type) by the last part of the address. "page" displays the report in the browser.
MODEL_FILES = {
    "report": ("report.html", "text/html"),
    "page": ("report.html", "text/html"),
    "model": ("model.json", "application/json"),
    "script": ("script.py", "text/plain"),
}


def html_response(text: str) -> Response:
    """Return an HTML response with status 200."""
    return Response(text.encode("utf-8", "replace"), media_type="text/html")


def json_response(content: object, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """Return an object as a JSON response."""
    return Response(json.dumps(content), status, headers, "application/json")


async def read_json(request: Request) -> dict[str, Any]:
    """Return the body of a request, a JSON object, as a dictionary.

    Raise HTTPException for other content (status 400) or a body of more than `MAX_BODY_BYTES` (status 413).
    """
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise HTTPException(413, f"the request is longer than {MAX_BODY_BYTES >> 10} kB")
    try:
        document = json.loads(body)
    except (ValueError, RecursionError):
        raise HTTPException(400, "the request is not valid JSON") from None
    if not isinstance(document, dict):
        raise HTTPException(400, "the request is not a JSON object")
    return document


class WebApplication:
    """ASGI application that serves one session of the web app.

    Parameters
    ----------
    session
        Session to serve.
    token
        Secret first part of every path; requests without it are rejected with status 404.
    hosts
        Accepted values of the header ``Host``, such as "127.0.0.1:8347".
    key
        Secret of the address ``/open/KEY``, which works once and redirects to the permanent address. If it is empty,
        there is no such address.
    """

    def __init__(self, session: Session, token: str, hosts: tuple[str, ...], key: str = "") -> None:
        self._session = session
        self._token = token
        self._hosts = hosts
        self._key = key
        self._router = Router(
            [
                Route("/", _view(lambda: view.page(session), "text/html")),
                Route("/app.js", _view(view.script, "text/javascript")),
                Route("/app.css", _view(view.style, "text/css")),
                Route("/state", _view(lambda: json.dumps(view.state(session)), "application/json")),
                Route("/comparison", _view(lambda: view.comparison(session), "text/html")),
                Route("/check", self._check, methods=["POST"]),
                Route("/files", self._upload, methods=["POST"]),
                Route("/files/{key}", self._file, methods=["GET", "POST", "DELETE"]),
                Route("/models", self._start, methods=["POST"]),
                Route("/models/{key}", self._model, methods=["GET", "DELETE"]),
                Route("/models/{key}/stop", self._stop, methods=["POST"]),
                Route("/models/{key}/resume", self._resume, methods=["POST"]),
                *(Route(f"/models/{{key}}/{kind}", self._download) for kind in MODEL_FILES),
            ],
            redirect_slashes=False,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one HTTP request; errors become JSON responses with the key "error"."""
        if scope["type"] != "http":
            return

        async def send_secured(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                if message["status"] in (403, 404, 413, 415):
                    # The connection is closed, so that the rest of a rejected body is not read.
                    headers["connection"] = "close"
            elif scope["method"] == "HEAD":
                message["body"] = b""
            await send(message)

        try:
            path = self._check_head(scope)
            # With the key "app" in the scope, the router raises an HTTPException for an unknown path.
            await self._router({**scope, "path": path, "app": self}, receive, send_secured)
            return
        except HTTPException as refused:
            answer = json_response({"error": refused.detail}, refused.status_code, refused.headers)
        except ClientDisconnect:
            answer = json_response({"error": "the upload was cut off; try again"}, 400)
        except FtlmError as error:
            answer = json_response({"error": self._error_text(error)}, 400)
        except Exception as error:
            # The response has the type of the error only, because a traceback would contain local paths.
            answer = json_response({"error": f"a fault in ftlm itself ({type(error).__name__})"}, 500)
        await answer(scope, receive, send_secured)

    def _error_text(self, error: FtlmError) -> str:
        return self._session.without_paths(str(error))

    def _check_head(self, scope: Scope) -> str:
        """Check host, origin, token and query of a request, and return its path without the token.

        Raise HTTPException for a request that is not allowed, and for redirections.
        """
        headers = Headers(scope=scope)
        for name in ("host", "origin", "content-length"):
            if len(headers.getlist(name)) > 1:
                raise HTTPException(400, f"the header {name} is given twice")
        if headers.get("host", "").lower() not in self._hosts:
            raise HTTPException(403, "this page only accepts requests to its own address")
        method, origin = scope["method"], headers.get("origin")
        if origin is not None and origin not in {f"http://{host}" for host in self._hosts}:
            raise HTTPException(403, "the request comes from another page; only this page may send requests")
        if method not in ("GET", "HEAD") and (
            origin is None or headers.get("sec-fetch-site", "same-origin") != "same-origin"
        ):
            raise HTTPException(403, "only the page itself may change its content")
        first_segment, slash, remaining_path = scope["path"].removeprefix("/").partition("/")
        if method == "GET" and first_segment == "open" and slash and "/" not in remaining_path:
            self._redeem_key(remaining_path)
        if not secrets.compare_digest(first_segment.encode("utf-8", "replace"), self._token.encode()):
            raise HTTPException(404, "there is no page at this address; use the address that ftlm app printed")
        if scope["query_string"].count(b"&") >= MAX_QUERY_FIELDS:
            raise HTTPException(400, "the address has too many fields")
        if not slash and method in ("GET", "HEAD"):
            raise self._redirection()
        return f"{slash}{remaining_path}"

    def _redirection(self) -> HTTPException:
        """Return the redirection to the permanent address as an HTTPException with status 303."""
        return HTTPException(303, headers={"location": f"/{self._token}/"})

    def _redeem_key(self, key: str) -> None:
        """Raise the redirection for the first request with the one-time key, and status 404 for any other request.

        The key works once only, because it is visible in the command line of the browser process.
        """
        good = bool(self._key) and secrets.compare_digest(key.encode("utf-8", "replace"), self._key.encode())
        if not good:
            raise HTTPException(
                404, "this address was valid once; use the permanent address in the terminal of ftlm app"
            )
        self._key = ""
        raise self._redirection()

    async def _check(self, request: Request) -> Response:
        """Return JSON with the key "error": the message for an invalid fit request, or "" for a valid one."""
        request_body = await read_json(request)
        try:
            self._session.parse_request(request_body)
        except FtlmError as error:
            return json_response({"error": self._error_text(error)})
        return json_response({"error": ""})

    async def _upload(self, request: Request) -> Response:
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/octet-stream":
            raise HTTPException(415, "a file must be sent as application/octet-stream, not as a form")
        header = request.headers.get("content-length")
        # A longer number is ignored, because the received bytes are counted in any case.
        size = (
            int(header) if header is not None and header.isascii() and header.isdigit() and len(header) < 20 else None
        )
        name = request.query_params.get("name", "")
        try:
            self._session.unique_file_name(name, size)
            file = await self._session.store_upload(name, size, request.stream())
        except FtlmError as error:
            raise HTTPException(413, self._session.without_paths(str(error))) from None
        return html_response(view.file(file))

    async def _file(self, request: Request) -> Response:
        file = _find(self._session.files, request, "file")
        if request.method == "DELETE":
            self._session.remove_file(file.key)
            return json_response({})
        if request.method == "POST":
            file.user_options = parse_fields(await read_json(request))
            await self._session.open(file)
        return html_response(view.file(file))

    async def _start(self, request: Request) -> Response:
        return html_response(view.model(self._session.start(self._session.parse_request(await read_json(request)))))

    async def _model(self, request: Request) -> Response:
        model = _find(self._session.models, request, "model")
        if request.method == "DELETE":
            self._session.remove_model(model.key)
            return json_response({})
        return html_response(view.model(model))

    async def _stop(self, request: Request) -> Response:
        model = _find(self._session.models, request, "model")
        self._session.stop(model.key)
        return html_response(view.model(model))

    async def _resume(self, request: Request) -> Response:
        model = _find(self._session.models, request, "model")
        return html_response(view.model(self._session.resume(model.key)))

    async def _download(self, request: Request) -> Response:
        """Return the response with a file of a model. No part of the file path is taken from the request.

        Raise HTTPException (status 404) if the model is unknown or not finished, or its file is missing.
        """
        model = _find(self._session.models, request, "model")
        if model.state != STATE_MADE or model.description is None:
            raise HTTPException(404, "this model is not finished yet")
        what = request.url.path.rpartition("/")[2]
        ending, media_type = MODEL_FILES[what]
        if what == "script":
            content = str(model.description["script"]).encode("utf-8", "replace")
        else:
            suffix = "json" if what == "model" else "html"
            try:
                content = (self._session.folder / f"{model.key}.{suffix}").read_bytes()
            except OSError:
                raise HTTPException(404, "the file of this model was removed") from None
        headers = {"content-security-policy": REPORT_POLICY}
        if what != "page":
            stem = Path(model.fit_request.estimation.file).stem
            plain = "".join(c if c.isascii() and (c.isalnum() or c in "._-") else "_" for c in stem)[:80] or "ftlm"
            headers["content-disposition"] = f'attachment; filename="{plain}-{model.number}-{ending}"'
        return Response(content, headers=headers, media_type=media_type)


def _view(render: Callable[[], str], media_type: str) -> Endpoint:
    """Return an endpoint that calls `render` for each request and responds with the returned text."""

    async def endpoint(_: Request) -> Response:
        return Response(render().encode("utf-8", "replace"), media_type=media_type)

    return endpoint


def _find(items: Mapping[str, Item], request: Request, kind: str) -> Item:
    """Return the file or model whose key is in the path; raise HTTPException (status 404) for an unknown key."""
    item = items.get(request.path_params["key"])
    if item is None:
        raise HTTPException(404, f"this {kind} is no longer on the page")
    return item


#: Maximum time for a client to send a request head or the next part of a body, or to read a part of a response.
CLIENT_TIMEOUT_S = 20.0


class TimedConnection(H11Protocol):
    """HTTP connection that is aborted if its client is inactive for :data:`CLIENT_TIMEOUT_S`.

    Activity is checked twice within this time. The keep-alive limit of uvicorn is not sufficient, because it applies
    only to connections that are idle after a response.
    """

    _since = 0.0
    _unsent_bytes = 0
    _next: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the inactivity timeout of a new connection."""
        super().connection_made(transport)
        self._since = self.loop.time()
        self._schedule_check()

    def data_received(self, data: bytes) -> None:
        """Process received data; restart the timeout at the end of a request head and at each part of a body."""
        state_before = self.conn.their_state
        super().data_received(data)
        if self.conn.their_state is not state_before or state_before is h11.SEND_BODY:
            self._since = self.loop.time()

    def on_response_complete(self) -> None:
        """Complete a response, and restart the timeout for the next request head."""
        super().on_response_complete()
        self._since = self.loop.time()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel the timeout of a closed connection."""
        if self._next is not None:
            self._next.cancel()
        super().connection_lost(exc)

    def _schedule_check(self) -> None:
        self._next = self.loop.call_later(CLIENT_TIMEOUT_S / 2, self._check_timeout)

    def _check_timeout(self) -> None:
        """Abort the connection if the client neither sent data nor read its response within the timeout."""
        unsent_bytes, size_before = self.transport.get_write_buffer_size(), self._unsent_bytes
        self._unsent_bytes = unsent_bytes
        if unsent_bytes < size_before or (unsent_bytes and not size_before):
            self._since = self.loop.time()
        is_incomplete = bool(unsent_bytes) or self.conn.their_state in (h11.IDLE, h11.SEND_BODY)
        if is_incomplete and self.loop.time() - self._since >= CLIENT_TIMEOUT_S:
            # close() would wait until the client reads the remaining data.
            self.transport.abort()
        else:
            self._schedule_check()
