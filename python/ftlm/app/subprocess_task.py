"""Worker processes of the server: start, messages and end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ftlm.errors import DataError
from ftlm.io.isolated_reader import describe_crash
from ftlm.utils.resources import subprocess_arguments

_WORKER_PATH = Path(__file__).with_name("worker.py")
#: Maximum length of a message of a worker process; a model with its charts takes some hundred kilobytes.
MAX_ANSWER_LINE_BYTES = 64 << 20


class TaskError(DataError):
    """Error of a worker process that ended without an answer; the message is shown on the page."""


class Task:
    """Task that runs in a separate worker process.

    Parameters
    ----------
    request
        Task for :mod:`ftlm.app.worker`, a JSON object.
    listener
        Callback that is called with each progress report, a JSON object.
    """

    def __init__(self, request: Mapping[str, Any], listener: Callable[[Mapping[str, Any]], None]) -> None:
        self._request = request
        self._listener = listener
        self._process: asyncio.subprocess.Process | None = None
        self._ended = False

    async def answer(self, seconds: float | None = None) -> dict[str, Any]:
        """Run the task in a worker process, and return its answer.

        Parameters
        ----------
        seconds
            Time limit [s]; None for no limit.

        Raises
        ------
        TaskError
            If the task reports an error, crashes, is stopped or exceeds the time limit.
        """
        if self._ended:
            raise TaskError("stopped")
        # The process has a new session: Ctrl-C does not reach it, and killing its group also kills its children.
        child = subprocess_arguments(_WORKER_PATH)
        process = await asyncio.create_subprocess_exec(
            *child.pop("args"),
            **child,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
            limit=MAX_ANSWER_LINE_BYTES,
            start_new_session=True,
        )
        self._process = process
        try:
            if self._ended:
                raise TaskError("stopped")
            async with asyncio.timeout(seconds):
                return await self._read_answer(process)
        except TimeoutError:
            raise TaskError(f"the task took more than {seconds:g} s and was stopped; use a smaller file") from None
        finally:
            self._kill()
            await process.wait()

    async def _read_answer(self, process: asyncio.subprocess.Process) -> dict[str, Any]:
        """Send the request to the process, pass its progress reports to the listener, and return its answer.

        Raise TaskError if the process reports an error or exits without an answer, or a message is too long.
        """
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(ConnectionError):
            process.stdin.write(json.dumps(self._request).encode() + b"\n")
            await process.stdin.drain()
        while True:
            try:
                line = await process.stdout.readline()
            except ValueError:
                raise TaskError("the result is too long for a page; use fewer columns") from None
            if not line:
                raise TaskError("stopped" if self._ended else _describe_exit(await process.wait()))
            try:
                message = json.loads(line)
            except ValueError:
                continue
            if "error" in message:
                raise TaskError(str(message["error"]))
            if "answer" in message:
                return dict(message["answer"])
            self._listener(message)

    def stop(self) -> None:
        """Kill the worker process; :meth:`answer` then raises TaskError."""
        self._ended = True
        self._kill()

    def _kill(self) -> None:
        """Kill the worker process and its children, if it is running."""
        process = self._process
        if process is None or process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


def _describe_exit(code: int) -> str:
    """Return an error message for a process that exited with `code` without an answer."""
    if code >= 0:
        return f"the process of this task ended with code {code}, without an answer; try a smaller file"
    return f"the process of this task crashed ({describe_crash(code)}); the page and all models are still here"
