"""A connection to the page that ends where its client keeps it waiting: nobody holds one of a hundred for ever."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uvicorn.protocols.http.h11_impl import H11Protocol

#: Seconds that a client may take for a request's head, between two pieces of its body, and for a part of an answer.
PATIENCE = 20.0


def patient() -> type[H11Protocol]:
    """Make the connections of uvicorn that are looked at twice in the time of :data:`PATIENCE`.

    Its own limit holds for connections that have been answered and then are silent altogether.
    """
    import h11  # noqa: PLC0415 — an extra
    from uvicorn.protocols.http.h11_impl import H11Protocol  # noqa: PLC0415 — an extra

    class Connection(H11Protocol):
        """One that looks after itself."""

        _since = 0.0
        _unread = 0
        _next: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
            """Begin to wait."""
            super().connection_made(transport)
            self._since = self.loop.time()
            self._again()

        def data_received(self, data: bytes) -> None:
            """Take a piece: of a body it is a sign of life, of a head only the last one is."""
            before = self.conn.their_state
            super().data_received(data)
            if self.conn.their_state is not before or before is h11.SEND_BODY:
                self._since = self.loop.time()

        def on_response_complete(self) -> None:
            """Wait for the next head from here on."""
            super().on_response_complete()
            self._since = self.loop.time()

        def connection_lost(self, exc: Exception | None) -> None:
            """Wait no longer."""
            if self._next is not None:
                self._next.cancel()
            super().connection_lost(exc)

        def _again(self) -> None:
            self._next = self.loop.call_later(PATIENCE / 2, self._look)

        def _look(self) -> None:
            """End what is silent for too long, and what does not read what it is sent."""
            unread, before = self.transport.get_write_buffer_size(), self._unread
            self._unread = unread
            if unread < before or (unread and not before):
                self._since = self.loop.time()
            owes = bool(unread) or self.conn.their_state in (h11.IDLE, h11.SEND_BODY)
            if owes and self.loop.time() - self._since >= PATIENCE:
                # Not closed: that would wait for what was sent to be read.
                self.transport.abort()
            else:
                self._again()

    return Connection
