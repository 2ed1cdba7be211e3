"""Many runs identified one by one, here or by an executor; one that fails does not stop the others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from dataclasses import dataclass
from typing import Any

from ftlm.base.errors import ConvergenceError, FtlmError, InternalError, ModelError
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.identification.identify import identify
from ftlm.identification.result import Identification


@dataclass(frozen=True)
class Identified:
    """What became of one of many.

    Parameters
    ----------
    name
        Names of its runs.
    result
        The identification, or None.
    error
        Why there is none, or None.
    """

    name: str
    result: Identification | None
    error: FtlmError | None

    def __str__(self) -> str:
        return f"{self.name}\n{self.result}" if self.error is None else f"{self.name}: {self.error}"


def one_of_many(
    runs: Run | Sequence[Run], structure: Structure, options: dict[str, Any]
) -> tuple[Identification | None, FtlmError | None]:
    """Identify; an error of ftlm is a result like another."""
    try:
        return identify(runs, structure, **options), None
    except FtlmError as error:
        return None, error
    except Exception as error:  # the others must go on
        return None, InternalError(f"internal fault: {type(error).__name__}: {error}; please report it")


def identify_many(
    runs: Sequence[Run | Sequence[Run]], structure: Structure, *, executor: Executor | None = None,
    progress: Callable[[int, int], None] | None = None, **options: Any,
) -> list[Identified]:  # fmt: skip
    """Identify each of many runs by itself.

    Parameters
    ----------
    runs
        Runs, or sequences of runs that are one fit together.
    structure
        What all of them are identified as.
    executor
        Any :class:`concurrent.futures.Executor`, such as processes or ``dask.distributed.Client(…).get_executor()``; a
        run is sent to the worker that takes it. Each fit has one thread then unless `threads` says otherwise. None: one
        after the other, here.
    progress
        Called with (runs done, runs in all).
    **options
        Of :func:`ftlm.identify`, but for `store`, which keeps one identification.

    Returns
    -------
    list of Identified
        In the order of the runs, each with its result or the error that stopped it.

    Raises
    ------
    ModelError
        No runs, or something else among them; a store.
    KeyboardInterrupt
        Ctrl-C.
    """
    items = [runs] if isinstance(runs, Run) else list(runs)
    names = []
    for number, item in enumerate(items):
        group = [item] if isinstance(item, Run) else list(item) if isinstance(item, Sequence) else []
        if not group or not all(isinstance(r, Run) for r in group):
            raise ModelError(f"item {number} of {len(items)} is neither a run nor runs; load it with ftlm.load")
        names.append(", ".join(r.name for r in group))
    if not items:
        raise ModelError("there are no runs; give at least one")
    if options.get("store") is not None:
        raise ModelError("a store keeps one identification; call identify for each run with a store of its own")
    if executor is None:
        every = []
        for name, item in zip(names, items, strict=True):
            every.append(Identified(name, *one_of_many(item, structure, options)))
            if progress is not None:
                progress(len(every), len(items))
        return every
    options = {"threads": 1, **options}
    pending: list[Future[Any]] = []
    try:
        for item in items:
            try:
                pending.append(executor.submit(one_of_many, item, structure, options))
            except (BrokenExecutor, RuntimeError) as error:
                lost: Future[Any] = Future()
                lost.set_exception(error)
                pending.append(lost)
        if progress is not None:
            for done, _ in enumerate(as_completed(pending), 1):
                progress(done, len(items))
        return [Identified(name, *_pair(future)) for name, future in zip(names, pending, strict=True)]
    finally:
        for future in pending:
            future.cancel()


def _pair(future: Future[Any]) -> tuple[Identification | None, FtlmError | None]:
    """What a worker made of its run, or that it was lost."""
    try:
        pair: tuple[Identification | None, FtlmError | None] = future.result()
    except (Exception, CancelledError) as error:
        what = f"{type(error).__name__}: {error}"
        return None, ConvergenceError(f"the executor lost this run ({what}); start a new one and identify it again")
    return pair
