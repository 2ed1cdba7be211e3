"""The local page without a browser or a network: a page, the one that asks it, and waiting for its work."""

import asyncio
import json

from ftlm.app import session as desks
from ftlm.app.session import Session
from ftlm.app.web_application import WebApplication

TOKEN, HOST = "0123456789abcdef", "127.0.0.1:8347"
RAW = "application/octet-stream"


class Page:
    """A page and the one that asks it, without a network."""

    def __init__(self, folder, loop):
        folder.mkdir()
        self.desk = Session(folder)
        self.door = WebApplication(self.desk, TOKEN, (HOST, "localhost:8347"), "once")
        self.loop = loop
        self.pieces = 0
        self.all = []

    def ask(self, method, path, body=b"", headers=None, chunks=None, query="", cut=False):
        """Status, headers and text of one answer; ``chunks`` come one by one, ``cut`` ends them early."""
        given = {"host": HOST, **({} if method in ("GET", "HEAD") else {"origin": f"http://{HOST}"}), **(headers or {})}
        pairs = [(n.encode(), v.encode()) for n, v in given.items() if v is not None]
        coming = iter([body] if chunks is None else chunks)
        sent = []

        async def receive():
            self.pieces += 1
            piece = next(coming, None)
            if piece is None:
                return {"type": "http.disconnect"} if cut else {"type": "http.request", "body": b""}
            return {"type": "http.request", "body": piece, "more_body": chunks is not None}

        async def send(message):
            sent.append(message)

        scope = {"type": "http", "method": method, "path": path, "query_string": query.encode(), "headers": pairs}
        self.loop(self.door(scope, receive, send))
        start, end = sent
        text = end["body"].decode()
        headers = {n.decode(): v.decode("latin-1") for n, v in start["headers"]}
        self.all.append(text)
        return start["status"], headers, text

    def own(self, method, path, said=None, **more):
        """As the page itself asks."""
        body = b"" if said is None else json.dumps(said).encode()
        return self.ask(method, f"/{TOKEN}/{path}", body, **more)

    def upload(self, name, content, **more):
        return self.own(
            "POST", "files", None, headers={"content-type": RAW}, query=f"name={name}", chunks=[content], **more
        )


async def until(condition):
    """Wait for what other tasks of the loop bring about."""
    while not condition():
        await asyncio.sleep(0.005)


async def settled(desk):
    """Until nothing waits or runs."""
    await until(lambda: not any(m.is_busy for m in desk.models.values()))


def error_message(text):
    return json.loads(text)["error"]


async def put_beside(desk, name, size):
    """A file that is there without having been read, which costs a process."""
    file = desks.File(f"key-{name.partition('.')[0]}", name, size)
    desk.files[file.key] = file
    (desk.folder / file.stored_name).write_bytes(b"x" * size)
