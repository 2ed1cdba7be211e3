"""State of a session of the web app: files in a private folder, a queue of fits, and limits of both."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import secrets
import shutil
import tempfile
import time
from collections.abc import AsyncIterator, Coroutine, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ftlm.app.forms import SELECTION_PHASE, FitRequest, RunSource, parse_structures
from ftlm.app.subprocess_task import Task, TaskError
from ftlm.errors import DataError, ModelError
from ftlm.io.load import base_name
from ftlm.progress import format_time_left
from ftlm.structure.structure import Structure
from ftlm.utils.validation import nearest, real_number

#: Maximum size of one file and of all files, maximum number of files, of models and of queued models, and maximum time
#: to open a file.
MAX_FILE_BYTES, MAX_TOTAL_BYTES = 256 << 20, 1 << 30
MAX_FILES, MAX_MODELS, MAX_QUEUED_MODELS = 20, 40, 8
OPEN_TIMEOUT_S = 600.0
#: Time after which an upload is answered although its file is still being read.
OPEN_REPLY_TIMEOUT_S = 2.0
#: Maximum number of files that are opened at the same time.
MAX_CONCURRENT_OPENS = 2
#: Maximum length of a file name in UTF-8 [bytes]; longer names are truncated.
MAX_NAME_BYTES = 200
#: Characters that are not allowed in file names on Windows.
_RESERVED_CHARACTERS = ':*?"<>|' if os.name == "nt" else ""
#: States of the fit of a model.
STATE_WAITING, STATE_RUNNING, STATE_MADE = "waiting", "running", "made"
STATE_FAILED, STATE_STOPPED = "failed", "stopped"


@dataclass
class File:
    """File that was uploaded to the session.

    Parameters
    ----------
    key, name, size
        Identifier in addresses and in the folder, displayed name, and size in bytes.
    user_options
        Options that the user set, as keyword arguments of `ftlm.open_file`.
    preview
        Description of the file from the worker process; None while it is read or if it cannot be read.
    error
        Reason why the file cannot be read; empty otherwise.
    version
        Number of times that the file was read, by which the page detects changes.
    task
        Worker process that reads the file; None if it is not being read.
    """

    key: str
    name: str
    size: int
    user_options: dict[str, Any] = field(default_factory=dict)
    preview: dict[str, Any] | None = None
    error: str = ""
    version: int = 0
    task: Task | None = None

    @property
    def stored_name(self) -> str:
        """File name in the folder: the key with the original extension, from which readers recognize the format."""
        suffixes = re.search(r"(\.[A-Za-z0-9]{1,10}){0,2}\Z", self.name)
        return self.key + (suffixes[0] if suffixes else "")

    @property
    def is_run(self) -> bool:
        """Whether the file can be loaded as a run."""
        return self.preview is not None and not self.preview["problem"]

    def run_source(self, folder: Path) -> RunSource:
        """Return the source of the run: the file in `folder`, and all arguments of `ftlm.load`.

        The file must have a preview.
        """
        assert self.preview is not None
        return RunSource(self.name, self.preview["options"], str(folder / self.stored_name))


@dataclass
class Model:
    """Model that was requested in the session, with the state of its fit.

    Parameters
    ----------
    key, number, fit_request
        Identifier in addresses, serial number, and fit request.
    state
        ``"waiting"``, ``"running"``, ``"made"``, ``"failed"`` or ``"stopped"``.
    phase, share, time_left
        Current phase of the fit, completed fraction of the phase (or None), and remaining time as text.
    started_at, phase_started_at, took
        Start times of the fit and of the phase on a monotonic clock, and total duration [s].
    description
        Content of the page about the model; None without a model.
    error
        Reason why the fit failed; empty otherwise.
    version
        Number of changes of `state`, by which the page detects changes.
    task
        Worker process of the fit; None if it is not running.
    files
        Keys of the files that contain its runs.
    """

    key: str
    number: int
    fit_request: FitRequest
    state: str = STATE_WAITING
    phase: str = "waiting"
    share: float | None = None
    started_at: float = 0.0
    phase_started_at: float = 0.0
    time_left: str = ""
    took: float = 0.0
    description: dict[str, Any] | None = None
    error: str = ""
    version: int = 0
    task: Task | None = None
    files: tuple[str, ...] = ()

    @property
    def is_busy(self) -> bool:
        """Whether the model is queued or running."""
        return self.state in (STATE_WAITING, STATE_RUNNING)


class Session:
    """State of one session of the web app. It is not thread-safe: only the thread of the server may use it.

    Parameters
    ----------
    folder
        Private folder, which :meth:`close` removes; by default a new temporary folder.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = (folder or Path(tempfile.mkdtemp(prefix="ftlm-app-"))).resolve()
        self.files: dict[str, File] = {}
        self.models: dict[str, Model] = {}
        self._fit_lock = asyncio.Lock()
        self._openings = asyncio.Semaphore(MAX_CONCURRENT_OPENS)
        self._jobs: set[asyncio.Task[None]] = set()
        self._count = 0

    # ------------------------------------------------------------------------------------------------------------ files

    def unique_file_name(self, name: str, size: int | None) -> str:
        """Return a unique displayed name for a new file; raise DataError if a limit on number or size is exceeded.

        `size` is the announced size in bytes; None if it is unknown.
        """
        if len(self.files) >= MAX_FILES:
            raise DataError(f"{MAX_FILES} files are open, the maximum number; remove one")
        if size is not None:
            self._check_size(name, size)
        return self._free_name(safe_name(name))

    def _check_size(self, name: str, size: int, replaced_file: File | None = None) -> None:
        if size > MAX_FILE_BYTES:
            raise DataError(
                f"{safe_name(name)!r} is larger than {MAX_FILE_BYTES >> 20} MB, the maximum size; load it in "
                "Python, or take fewer rows"
            )
        if size + sum(f.size for f in self.files.values() if f is not replaced_file) > MAX_TOTAL_BYTES:
            raise DataError(f"the files together are larger than {MAX_TOTAL_BYTES >> 20} MB; remove one")

    def _free_name(self, name: str) -> str:
        names = {f.name.casefold() for f in self.files.values()}
        stem, dot, suffixes = name.partition(".")
        free, count = name, 1
        while free.casefold() in names:
            count += 1
            free = f"{stem}-{count}{dot}{suffixes}"
        return free

    async def store_upload(self, name: str, size: int | None, chunks: AsyncIterator[bytes]) -> File:
        """Store an uploaded file from its chunks, start to read its preview, and return the file.

        The method waits up to `OPEN_REPLY_TIMEOUT_S` for the preview, which is sufficient for most files.

        Raises
        ------
        DataError
            If the file exceeds a size limit, there are too many files, or the file cannot be written.
        """
        file_name = self.unique_file_name(name, size)
        # The name is reserved here, so that a second upload of the same name gets another one.
        file, byte_count = File(secrets.token_hex(8), file_name, 0), 0
        self.files[file.key] = file
        try:
            with open(self.folder / file.stored_name, "xb") as stream:
                async for chunk in chunks:
                    byte_count += len(chunk)
                    self._check_size(name, byte_count, file)
                    file.size = byte_count
                    stream.write(chunk)
        except OSError as error:
            self.remove_file(file.key)
            raise DataError(f"{safe_name(name)!r} cannot be stored ({error.strerror}); check the disk space") from None
        except BaseException:
            self.remove_file(file.key)
            raise
        await asyncio.wait({self._start_job(self.open(file))}, timeout=OPEN_REPLY_TIMEOUT_S)
        return file

    def _start_job(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Start a background task, store a reference to it until it ends, and return it."""
        job = asyncio.create_task(work)
        self._jobs.add(job)
        job.add_done_callback(self._jobs.discard)
        return job

    async def open(self, file: File) -> None:
        """Read the preview of a file with the options of the user; a read that is in progress is stopped first."""
        if file.task is not None:
            file.task.stop()
        request = {"do": "open", "file": str(self.folder / file.stored_name), "options": file.user_options}
        file.task = task = Task(request, lambda _: None)
        try:
            async with self._openings:
                preview, error = self._with_names(await task.answer(OPEN_TIMEOUT_S)), ""
        except TaskError as failed:
            preview, error = None, self.without_paths(str(failed))
        if file.task is not task:
            return
        file.task, file.preview, file.error = None, preview, error
        file.version += 1

    def remove_file(self, key: str) -> None:
        """Remove a file from the session and the folder; models that were identified from it remain.

        Raises
        ------
        DataError
            If a queued or running model requires the file.
        """
        file = self.files[key]
        if any(m.is_busy and file.name in _file_names(m.fit_request) for m in self.models.values()):
            raise DataError(f"{file.name!r} is in use by a model that is being fitted; stop the fit first")
        del self.files[key]
        if file.task is not None:
            file.task.stop()
        with contextlib.suppress(OSError):
            (self.folder / file.stored_name).unlink()

    # ----------------------------------------------------------------------------------------------------------- models

    def parse_request(self, fields: Mapping[str, Any]) -> FitRequest:
        """Return the fit request of the form fields, after all checks that need no computation.

        Raises
        ------
        DataError, ModelError
            If a file is missing, still being read or not a run. Also if an option is unknown, an equation is invalid,
            or a run lacks a signal of a structure.
        """
        validation_name = str(fields.get("validation") or "")
        share = real_number("share", fields.get("share", 0))
        texts = fields.get("structure") or []
        texts = [texts] if isinstance(texts, str) else texts
        if not isinstance(texts, list) or len(texts) > 20 or not all(isinstance(t, str) for t in texts):
            raise ModelError("structure is not an equation; write one, such as D y = a0 y + b0 u")
        if sum(map(len, texts)) > 4000:
            raise ModelError("the equation has more than 4000 letters; write a shorter one")
        fit_request = FitRequest(
            self._run(str(fields.get("estimation") or "")),
            self._run(validation_name) if validation_name else None,
            0.0 if validation_name else share,
            tuple(t.strip() for t in texts if t.strip()),
            *(
                str(fields.get(name) or default)
                for name, default in (("selection_mode", "fit"), ("method", ""), ("offset", ""), ("loss", ""))
            ),
        )
        for structure in parse_structures(fit_request):
            for source in filter(None, (fit_request.estimation, fit_request.validation)):
                _check_signals(structure, source)
        return fit_request

    def _run(self, key: str) -> RunSource:
        file = self.files.get(key)
        if file is None:
            raise DataError("no file is chosen; add a file first")
        if file.task is not None or (file.preview is None and not file.error):
            raise DataError(f"{file.name!r} is still being read; wait until its columns are shown")
        if not file.is_run:
            raise DataError(
                f"{file.name!r} is not a run yet: {file.preview['problem'] if file.preview else file.error}"
            )
        return file.run_source(self.folder)

    def start(self, fit_request: FitRequest) -> Model:
        """Add a model to the queue of fits, and return it.

        Raises
        ------
        DataError
            If there are `MAX_MODELS` models, or `MAX_QUEUED_MODELS` of them are queued or running.
        """
        if len(self.models) >= MAX_MODELS:
            raise DataError(f"{MAX_MODELS} models are kept, the maximum number; remove one")
        self._check_queue()
        self._count += 1
        model = Model(secrets.token_hex(8), self._count, fit_request)
        model.files = tuple(f.key for f in self.files.values() if f.name in _file_names(fit_request))
        self.models[model.key] = model
        self._start_job(self._make(model))
        return model

    def _check_queue(self) -> None:
        if sum(m.is_busy for m in self.models.values()) >= MAX_QUEUED_MODELS:
            raise DataError(f"{MAX_QUEUED_MODELS} models are already in the queue; stop one of them, or wait")

    def resume(self, key: str) -> Model:
        """Queue a stopped or failed model again, and return it; other models are returned unchanged.

        A structure selection continues from its checkpoint file. A fit starts from the beginning.

        Raises
        ------
        DataError
            If one of its files was removed, or the queue is full.
        """
        model = self.models[key]
        if model.state not in (STATE_STOPPED, STATE_FAILED):
            return model
        if any(file not in self.files for file in model.files):
            raise DataError(
                f"{' or '.join(sorted(_file_names(model.fit_request)))} is no longer on the page; add the file again, "
                "and repeat the request"
            )
        self._check_queue()
        model.state, model.phase, model.error, model.share, model.time_left = STATE_WAITING, "waiting", "", None, ""
        model.version += 1
        self._start_job(self._make(model))
        return model

    async def _make(self, model: Model) -> None:
        async with self._fit_lock:
            if model.state != STATE_WAITING:
                return
            model.state, model.phase, model.started_at = STATE_RUNNING, "starting", time.monotonic()
            model.version += 1
            request = {
                "do": "model",
                "fit_request": model.fit_request.to_dict(),
                "model": str(self.folder / f"{model.key}.json"),
                "report": str(self.folder / f"{model.key}.html"),
                "store": str(self.folder / f"{model.key}.ftlm") if model.fit_request.selects_structure else None,
            }
            model.task = Task(request, lambda message: _record_progress(model, message))
            try:
                description = await model.task.answer()
            except TaskError as failed:
                if model.state == STATE_RUNNING:
                    model.state, model.error = STATE_FAILED, self.without_paths(str(failed))
            else:
                if model.state == STATE_RUNNING:
                    model.state, model.description = STATE_MADE, self._with_names(description)
            model.took += time.monotonic() - model.started_at
            model.task = None
            model.version += 1

    def stop(self, key: str) -> None:
        """Stop the fit of a queued or running model; its files, such as a checkpoint file, remain."""
        model = self.models[key]
        if model.is_busy:
            model.state = STATE_STOPPED
            model.version += 1
            if model.task is not None:
                model.task.stop()

    def remove_model(self, key: str) -> None:
        """Stop the fit of a model, and remove the model and its files."""
        self.stop(key)
        del self.models[key]
        for suffix in (".json", ".html", ".ftlm", ".ftlm-journal"):
            with contextlib.suppress(OSError):
                (self.folder / f"{key}{suffix}").unlink()

    # ------------------------------------------------------------------------------------------------------------- both

    def without_paths(self, message: str) -> str:
        """Return a message in which paths of the folder are replaced by displayed file names."""
        folder = str(self.folder)
        message = message.replace(f"{folder}/", "").replace(f"{folder}\\", "").replace(folder, "the page's folder")
        for file in self.files.values():
            message = message.replace(file.stored_name, file.name).replace(file.key, base_name(Path(file.name)))
        return message

    def _with_names(self, content: Any) -> Any:
        """Return the answer of a worker process, with :meth:`without_paths` applied to all text in it."""
        if isinstance(content, dict):
            return {key: self._with_names(value) for key, value in content.items()}
        if isinstance(content, list):
            return [self._with_names(value) for value in content]
        return self.without_paths(content) if isinstance(content, str) else content

    async def close(self) -> None:
        """Stop all worker processes and remove the folder."""
        for file in self.files.values():
            if file.task is not None:
                file.task.stop()
        for key in self.models:
            self.stop(key)
        try:
            if self._jobs:
                await asyncio.wait(self._jobs, timeout=2.0)
        finally:
            shutil.rmtree(self.folder, ignore_errors=True)


def _check_signals(structure: Structure, source: RunSource) -> None:
    """Raise ModelError if the run lacks a signal of the structure, before a worker process is started."""
    names = [name for role in ("outputs", "inputs") for name in source.options.get(role, {})]
    for name in structure.signals:
        if name not in names:
            raise ModelError(
                f"{source.file!r} has no signal {name!r}{nearest(name, names)}; its signals are {', '.join(names)}, "
                "as the columns above name them"
            )


def _file_names(fit_request: FitRequest) -> set[str]:
    return {fit_request.estimation.file, *(() if fit_request.validation is None else (fit_request.validation.file,))}


def _record_progress(model: Model, message: Mapping[str, Any]) -> None:
    """Store a progress report of the worker process in the model: a new phase, or the completed part of the phase."""
    if "phase" in message:
        model.phase, model.share, model.time_left = str(message["phase"]), None, ""
        model.phase_started_at = time.monotonic()
    elif message.get("total") and model.phase.startswith(SELECTION_PHASE):
        # A selection adds candidates during its work, so that a completed fraction could decrease.
        model.time_left = f"{message['done']} of {message['total']} candidates known so far are fitted"
    elif message.get("total"):
        share = min(max(float(message["done"]) / float(message["total"]), 0.0), 1.0)
        elapsed = time.monotonic() - model.phase_started_at
        model.share = share
        if share > 0.02 and elapsed > 1.0:
            # The remaining time from the measured rate replaces the estimate in the name of the phase.
            model.phase = model.phase.partition(", about")[0]
            model.time_left = format_time_left(elapsed * (1.0 - share) / share)


def safe_name(name: str) -> str:
    """Return a file name without folders and forbidden characters, truncated to `MAX_NAME_BYTES` bytes."""
    last_part = re.split(r"[/\\]", name)[-1]
    bare = (
        "".join(c if c.isprintable() and c not in _RESERVED_CHARACTERS else "_" for c in last_part).strip(" .")
        or "file"
    )
    stem, dot, suffix = bare.rpartition(".")
    while len(bare.encode("utf-8", "replace")) > MAX_NAME_BYTES and (stem or suffix):
        stem, suffix = (stem[:-1], suffix) if stem else (stem, suffix[:-1])
        bare = f"{stem}{dot}{suffix}"
    return bare
