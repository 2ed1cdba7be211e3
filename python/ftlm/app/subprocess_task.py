"""A process that does one task: started, listened to line by line, ended at once."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ftlm.errors import DataError

#: The longest line that a task may answer [bytes]: a page of charts takes some hundred kilobytes.
LONGEST = 64 << 20


class TaskError(DataError):
    """A task that ended without an answer, in words for the page."""


class Task:
    """One task in a process of its own.

    Parameters
    ----------
    asked
        What :mod:`ftlm.app.work` is to do.
    folder
        Where.
    told
        Called with each report.
    """

    def __init__(self, asked: Mapping[str, Any], folder: Path, told: Callable[[Mapping[str, Any]], None]) -> None:
        self._asked = asked
        self._folder = folder
        self._told = told
        self._process: asyncio.subprocess.Process | None = None
        self._ended = False

    async def answer(self, seconds: float | None = None) -> dict[str, Any]:
        """Do it.

        Parameters
        ----------
        seconds
            How long it may take; None for as long as it takes.

        Raises
        ------
        TaskError
            It refused in words, crashed, was ended, or took too long.
        """
        if self._ended:
            raise TaskError("stopped")
        # A session of its own: Ctrl-C is for the parent, and what it starts itself ends with it.
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-P",
            "-m",
            "ftlm.app.worker",
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.DEVNULL,
            cwd=self._folder,
            limit=LONGEST,
            start_new_session=True,
        )
        self._process = process
        try:
            if self._ended:
                raise TaskError("stopped")
            async with asyncio.timeout(seconds):
                return await self._listened(process)
        except TimeoutError:
            raise TaskError(f"it took more than {seconds:g} s and was ended; take a smaller file") from None
        finally:
            self._kill()
            await process.wait()

    async def _listened(self, process: asyncio.subprocess.Process) -> dict[str, Any]:
        """The answer of a process, its reports passed on."""
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(ConnectionError):
            process.stdin.write(json.dumps(self._asked).encode() + b"\n")
            await process.stdin.drain()
        while True:
            try:
                line = await process.stdout.readline()
            except ValueError:
                raise TaskError("its answer is too long for a page; take fewer columns") from None
            if not line:
                raise TaskError("stopped" if self._ended else _ending(await process.wait()))
            try:
                said = json.loads(line)
            except ValueError:
                continue
            if "error" in said:
                raise TaskError(str(said["error"]))
            if "answer" in said:
                return dict(said["answer"])
            self._told(said)

    def stop(self) -> None:
        """End it at once; its answer is then an error."""
        self._ended = True
        self._kill()

    def _kill(self) -> None:
        """End the process and what it started."""
        process = self._process
        if process is None or process.returncode is not None:
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


def _ending(code: int) -> str:
    """How a process ended that gave no answer."""
    if code >= 0:
        return f"the process that worked on it ended with code {code}, without an answer; try a smaller file"
    try:
        how = f"signal {-code}, {signal.Signals(-code).name}"
    except ValueError:
        how = f"signal {-code}"
    return f"the process that worked on it crashed ({how}); the page and all models are still here"
