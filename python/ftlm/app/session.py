"""What lies on the page: files in a private folder, models waiting, running and made, and their bounds."""

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

from ftlm.app.forms import CHOOSING, Reading, Recipe, checked_structures
from ftlm.app.subprocess_task import Task, TaskError
from ftlm.errors import DataError, ModelError
from ftlm.progress import left_in_words
from ftlm.structure.structure import Structure
from ftlm.utils.validation import nearest, real_number

#: Bytes of one file and of all, files, models kept, models that wait, and seconds that opening a file may take.
MOST_BYTES, MOST_BYTES_IN_ALL = 256 << 20, 1 << 30
MOST_FILES, MOST_MODELS, MOST_WAITING = 20, 40, 8
SECONDS_TO_OPEN = 600.0
#: Seconds after which a page is told that a file is still being read.
PATIENCE = 2.0
#: Files that are opened at a time.
MOST_OPENING = 2
#: Bytes of a file's name.
MOST_LETTERS = 200
#: What one system refuses in names; the others take it.
_REFUSED = ':*?"<>|' if os.name == "nt" else ""
WAITING, RUNNING, MADE, FAILED, STOPPED = "waiting", "running", "made", "failed", "stopped"


@dataclass
class File:
    """A file on the page.

    Parameters
    ----------
    key, name, size
        What the page calls it, its name in the folder, its bytes.
    asked
        What a person said of it, as arguments of `ftlm.open_file`.
    told
        What it is; None while it is read, or where it cannot be.
    error
        Why it cannot be.
    version
        Counts its changes.
    """

    key: str
    name: str
    size: int
    asked: dict[str, Any] = field(default_factory=dict)
    told: dict[str, Any] | None = None
    error: str = ""
    version: int = 0
    task: Task | None = None

    @property
    def is_run(self) -> bool:
        """Whether a model can be made of it."""
        return self.told is not None and not self.told["problem"]

    @property
    def reading(self) -> Reading:
        """How it becomes a run, everything said."""
        assert self.told is not None
        return Reading(self.name, self.told["options"])


@dataclass
class Model:
    """A model on the page.

    Parameters
    ----------
    key, number, recipe
        What the page calls it, the how-manieth it is, what makes it.
    state
        ``"waiting"``, ``"running"``, ``"made"``, ``"failed"`` or ``"stopped"``.
    phase, share, begun, begun_phase, left, took
        What is done now, how far it is, since when all and this, what is left in words, what it took [s].
    told
        What the page shows of it.
    error
        Why there is none.
    version
        Counts its changes of state.
    files
        Keys of the files that it is made of.
    """

    key: str
    number: int
    recipe: Recipe
    state: str = WAITING
    phase: str = "waiting"
    share: float | None = None
    begun: float = 0.0
    begun_phase: float = 0.0
    left: str = ""
    took: float = 0.0
    told: dict[str, Any] | None = None
    error: str = ""
    version: int = 0
    task: Task | None = None
    files: tuple[str, ...] = ()

    @property
    def is_busy(self) -> bool:
        """Whether it waits or runs."""
        return self.state in (WAITING, RUNNING)


class Desk:
    """Everything of one page; it is used by one thread alone, that of the server.

    Parameters
    ----------
    folder
        A folder of one's own, which :meth:`close` removes; made where none is given.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder or Path(tempfile.mkdtemp(prefix="ftlm-app-"))
        self.files: dict[str, File] = {}
        self.models: dict[str, Model] = {}
        self._turn = asyncio.Lock()
        self._openings = asyncio.Semaphore(MOST_OPENING)
        self._jobs: set[asyncio.Task[None]] = set()
        self._count = 0

    # ------------------------------------------------------------------------------------------------------------ files

    def check_room(self, name: str, size: int | None) -> str:
        """Return what a file will be called, or refuse it: too large, or one too many."""
        if len(self.files) >= MOST_FILES:
            raise DataError(f"{MOST_FILES} files are open, as many as there may be; remove one")
        if size is not None:
            self._check_size(name, size)
        return self._free_name(safe_name(name))

    def _check_size(self, name: str, size: int, own: File | None = None) -> None:
        if size > MOST_BYTES:
            raise DataError(
                f"{safe_name(name)!r} is larger than {MOST_BYTES >> 20} MB, the most that the page takes; load it in "
                "Python, or take fewer rows"
            )
        if size + sum(f.size for f in self.files.values() if f is not own) > MOST_BYTES_IN_ALL:
            raise DataError(f"the files together are larger than {MOST_BYTES_IN_ALL >> 20} MB; remove one")

    def _free_name(self, name: str) -> str:
        taken = {f.name.casefold() for f in self.files.values()}
        stem, dot, suffixes = name.partition(".")
        free, count = name, 1
        while free.casefold() in taken or (self.folder / free).exists():
            count += 1
            free = f"{stem}-{count}{dot}{suffixes}"
        return free

    async def take(self, name: str, size: int | None, chunks: AsyncIterator[bytes]) -> File:
        """Keep a file that comes in pieces, and begin to open it; most are open when this returns.

        Raises
        ------
        DataError
            It is too large, said beforehand or not; or one too many.
        """
        free = self.check_room(name, size)
        path, written = self.folder / free, 0
        # Its name is taken from here on; a second one of that name gets another.
        file = File(secrets.token_hex(8), free, 0)
        self.files[file.key] = file
        try:
            with open(path, "xb") as stream:
                async for chunk in chunks:
                    written += len(chunk)
                    self._check_size(name, written, file)
                    file.size = written
                    stream.write(chunk)
        except OSError as error:
            self.remove_file(file.key)
            raise DataError(f"{safe_name(name)!r} cannot be kept: {error.strerror}; is the disk full?") from None
        except BaseException:
            self.remove_file(file.key)
            raise
        await asyncio.wait({self._begun(self.open(file))}, timeout=PATIENCE)
        return file

    def _begun(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Begin work that goes on by itself, and keep hold of it."""
        job = asyncio.create_task(work)
        self._jobs.add(job)
        job.add_done_callback(self._jobs.discard)
        return job

    async def open(self, file: File) -> None:
        """Say what a file is, by what is asked of it; an earlier reading of it that goes on is ended."""
        if file.task is not None:
            file.task.stop()
        asked = {"do": "open", "file": file.name, "options": file.asked}
        file.task = task = Task(asked, self.folder, lambda _: None)
        try:
            async with self._openings:
                told, error = await task.answer(SECONDS_TO_OPEN), ""
        except TaskError as failed:
            told, error = None, self.without_paths(str(failed))
        if file.task is not task:
            return
        file.task, file.told, file.error = None, told, error
        file.version += 1

    def remove_file(self, key: str) -> None:
        """Forget a file; models made of it stay.

        Raises
        ------
        DataError
            A model that waits or runs still needs it.
        """
        file = self.files[key]
        if any(m.is_busy and file.name in _names(m.recipe) for m in self.models.values()):
            raise DataError(f"{file.name!r} is in use by a model that is being made; stop that first")
        del self.files[key]
        if file.task is not None:
            file.task.stop()
        with contextlib.suppress(OSError):
            (self.folder / file.name).unlink()

    # ----------------------------------------------------------------------------------------------------------- models

    def recipe(self, told: Mapping[str, Any]) -> Recipe:
        """What a person asks for.

        Raises
        ------
        DataError, ModelError
            A file that is not there, being read or no run yet; words that are not known; an equation that is none.
        """
        other = str(told.get("validation") or "")
        share = real_number("share", told.get("share", 0))
        texts = told.get("structure") or []
        texts = [texts] if isinstance(texts, str) else texts
        if not isinstance(texts, list) or len(texts) > 20 or not all(isinstance(t, str) for t in texts):
            raise ModelError("structure is no equation; write one, such as D y = a0 y + b0 u")
        if sum(map(len, texts)) > 4000:
            raise ModelError("the equation has more than 4000 letters; write a shorter one")
        recipe = Recipe(
            self._run(str(told.get("estimation") or "")),
            self._run(other) if other else None,
            0.0 if other else share,
            tuple(t.strip() for t in texts if t.strip()),
            *(
                str(told.get(name) or default)
                for name, default in (("way", "fit"), ("method", ""), ("offset", ""), ("loss", ""))
            ),
        )
        for structure in checked_structures(recipe):
            for reading in filter(None, (recipe.estimation, recipe.validation)):
                _check_signals(structure, reading)
        return recipe

    def _run(self, key: str) -> Reading:
        file = self.files.get(key)
        if file is None:
            raise DataError("no file is chosen; drop one first")
        if file.task is not None or (file.told is None and not file.error):
            raise DataError(f"{file.name!r} is still being read; wait until its columns are shown")
        if not file.is_run:
            raise DataError(f"{file.name!r} is no run yet: {file.told['problem'] if file.told else file.error}")
        return file.reading

    def start(self, recipe: Recipe) -> Model:
        """Make a model as soon as those before it are made.

        Raises
        ------
        DataError
            As many models are kept, or wait, as may be.
        """
        if len(self.models) >= MOST_MODELS:
            raise DataError(f"{MOST_MODELS} models are kept, as many as there may be; remove one")
        self._check_turn()
        self._count += 1
        model = Model(secrets.token_hex(8), self._count, recipe)
        model.files = tuple(f.key for f in self.files.values() if f.name in _names(recipe))
        self.models[model.key] = model
        self._begun(self._make(model))
        return model

    def _check_turn(self) -> None:
        if sum(m.is_busy for m in self.models.values()) >= MOST_WAITING:
            raise DataError(f"{MOST_WAITING} models wait already; stop one, or wait")

    def resume(self, key: str) -> Model:
        """Go on with a model that was stopped: a choice where it was, a fit from its start.

        Raises
        ------
        DataError
            A file of it was removed, or as many models wait as may.
        """
        model = self.models[key]
        if model.state not in (STOPPED, FAILED):
            return model
        if any(file not in self.files for file in model.files):
            raise DataError(
                f"{' or '.join(sorted(_names(model.recipe)))} is no longer on the page; drop it, and ask anew"
            )
        self._check_turn()
        model.state, model.phase, model.error, model.share, model.left = WAITING, "waiting", "", None, ""
        model.version += 1
        self._begun(self._make(model))
        return model

    async def _make(self, model: Model) -> None:
        async with self._turn:
            if model.state != WAITING:
                return
            model.state, model.phase, model.begun = RUNNING, "starting", time.monotonic()
            model.version += 1
            asked = {
                "do": "model",
                "recipe": model.recipe.to_dict(),
                "model": f"{model.key}.json",
                "report": f"{model.key}.html",
                "store": f"{model.key}.ftlm" if model.recipe.is_choice else None,
            }
            model.task = Task(asked, self.folder, lambda said: _note(model, said))
            try:
                told = await model.task.answer()
            except TaskError as failed:
                if model.state == RUNNING:
                    model.state, model.error = FAILED, self.without_paths(str(failed))
            else:
                if model.state == RUNNING:
                    model.state, model.told = MADE, told
            model.took += time.monotonic() - model.begun
            model.task = None
            model.version += 1

    def stop(self, key: str) -> None:
        """End a model that waits or runs; what is made stays."""
        model = self.models[key]
        if model.is_busy:
            model.state = STOPPED
            model.version += 1
            if model.task is not None:
                model.task.stop()

    def remove_model(self, key: str) -> None:
        """Forget a model."""
        self.stop(key)
        del self.models[key]
        for suffix in (".json", ".html", ".ftlm"):
            with contextlib.suppress(OSError):
                (self.folder / f"{key}{suffix}").unlink()

    # ------------------------------------------------------------------------------------------------------------- both

    def without_paths(self, words: str) -> str:
        """Words in which no folder of this machine is named."""
        for folder in {str(self.folder), str(self.folder.resolve())}:
            words = words.replace(f"{folder}/", "").replace(f"{folder}\\", "").replace(folder, "the page's folder")
        return words

    async def close(self) -> None:
        """End all work and remove the folder."""
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


def _check_signals(structure: Structure, reading: Reading) -> None:
    """Refuse a signal that a run does not have, before a process is started for it."""
    there = [name for role in ("outputs", "inputs") for name in reading.options.get(role, {})]
    for name in structure.signals:
        if name not in there:
            raise ModelError(
                f"{reading.file!r} has no signal {name!r}{nearest(name, there)}; it has {', '.join(there)}, as its "
                "columns are named above"
            )


def _names(recipe: Recipe) -> set[str]:
    return {recipe.estimation.file, *(() if recipe.validation is None else (recipe.validation.file,))}


def _note(model: Model, said: Mapping[str, Any]) -> None:
    """Keep what a process says of its progress."""
    if "phase" in said:
        model.phase, model.share, model.left = str(said["phase"]), None, ""
        model.begun_phase = time.monotonic()
    elif said.get("total") and model.phase.startswith(CHOOSING):
        # Candidates come up as others are fitted: a share of those known so far would go back.
        model.left = f"{said['done']} of {said['total']} candidates known so far are fitted"
    elif said.get("total"):
        share = min(max(float(said["done"]) / float(said["total"]), 0.0), 1.0)
        passed = time.monotonic() - model.begun_phase
        model.share = share
        if share > 0.02 and passed > 1.0:
            # What is measured takes the place of what was expected.
            model.phase = model.phase.partition(", about")[0]
            model.left = left_in_words(passed * (1.0 - share) / share)


def safe_name(name: str) -> str:
    """A file's name without folders, and without what no file system takes."""
    last = re.split(r"[/\\]", name)[-1]
    bare = "".join(c if c.isprintable() and c not in _REFUSED else "_" for c in last).strip(" .") or "file"
    stem, dot, suffix = bare.rpartition(".")
    while len(bare.encode("utf-8", "replace")) > MOST_LETTERS and (stem or suffix):
        stem, suffix = (stem[:-1], suffix) if stem else (stem, suffix[:-1])
        bare = f"{stem}{dot}{suffix}"
    return bare
