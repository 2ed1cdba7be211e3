"""Worker processes that the server starts: start, messages and end."""

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
from ftlm.utils.resources import python_child

_WORKER_PATH = Path(__file__).with_name("worker.py")
#: Longest line of a task's answer. A page of charts takes some hundred kilobytes.
MAX_ANSWER_LINE_BYTES = 64 << 20


class TaskError(DataError):
    """Error of a task that ended without an answer, with a message for the page."""


class Task:
    """Task that runs in a separate worker process.

    Parameters
    ----------
    request
        Task for :mod:`ftlm.app.worker`, as JSON.
    listener
        Callback for each progress report.
    """

    def __init__(self, request: Mapping[str, Any], listener: Callable[[Mapping[str, Any]], None]) -> None:
        self._request = request
        self._listener = listener
        self._process: asyncio.subprocess.Process | None = None
        self._ended = False

    async def answer(self, seconds: float | None = None) -> dict[str, Any]:
        """Run the task and return its answer.

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
        # A session of its own: Ctrl-C is for the parent, and what it starts itself ends with it.
        child = python_child(_WORKER_PATH)
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
        """Return the answer of the process, after its progress reports are passed to the listener."""
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
        """Kill the process; :meth:`answer` then raises TaskError."""
        self._ended = True
        self._kill()

    def _kill(self) -> None:
        """Kill the process and its children."""
        process = self._process
        if process is None or process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


def _describe_exit(code: int) -> str:
    """Return text on the exit of a process that gave no answer."""
    if code >= 0:
        return f"the process that worked on it ended with code {code}, without an answer; try a smaller file"
    return f"the process that worked on it crashed ({describe_crash(code)}); the page and all models are still here"
