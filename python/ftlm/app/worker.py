"""Worker process of the web app, which opens a file or fits a model.

A separate process protects the server from damaged files and long fits. The arguments by which this file is run are
those of `ftlm.utils.resources.subprocess_arguments`.

The first line of standard input is the task, a JSON object with absolute paths: ``{"do": "open", "file": …,
"options": …}`` or ``{"do": "model", "fit_request": …, "store": …, "model": …, "report": …}``. The process exits
when standard input ends.

Standard output has one JSON object per line: progress reports ``{"phase": words}`` and ``{"done": …, "total": …}``,
and finally ``{"answer": …}`` or ``{"error": words}``.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Mapping
from typing import Any, TextIO

from ftlm.app.forms import FitRequest, suggest_structures
from ftlm.app.views import model_summary, run_figures
from ftlm.errors import FtlmError
from ftlm.io.binary_reader import limit_resources
from ftlm.io.preview import OpenedFile, open_file
from ftlm.progress import Progress
from ftlm.utils.parameters import use_interface

#: Memory limit of the process [bytes], and minimum time between two progress reports.
MEMORY_LIMIT = 6 << 30
REPORT_INTERVAL_S = 0.1
#: Maximum number of columns of a file in its preview.
MAX_SHOWN_COLUMNS = 200


class Reports(Progress):
    """Thread-safe progress callback that writes each report as one line of JSON to a stream."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__("", quiet=True)
        self._stream = stream
        self._output_lock = threading.Lock()
        self._last_time = 0.0

    def send(self, **facts: Any) -> None:
        """Write the keyword arguments as one line of JSON."""
        line = json.dumps(facts, allow_nan=False)
        with self._output_lock:
            self._stream.write(line + "\n")
            self._stream.flush()

    def phase(self, words: str) -> None:
        """Report the start of the phase that `words` describes."""
        self.send(phase=words)

    def __call__(self, count: int, total: int, pruned: int | None = None) -> None:
        """Report completed and total parts, at most once per `REPORT_INTERVAL_S` except at the end; ignore `pruned`."""
        time_now = time.monotonic()
        if time_now - self._last_time >= REPORT_INTERVAL_S or count >= total:
            self._last_time = time_now
            self.send(done=int(count), total=int(total))


def main() -> None:
    """Read the task from standard input, run it, and write its answer or error message."""
    # Standard output is redirected, so that output of libraries does not mix with the messages.
    stream = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    reports = Reports(stream)
    task = json.loads(sys.stdin.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    limit_resources(MEMORY_LIMIT)
    try:
        with use_interface("app"):
            result = describe_file(task) if task["do"] == "open" else make_model(task, reports)
    except FtlmError as error:
        reports.send(error=str(error))
    except MemoryError:
        reports.send(error="the task needs more memory than is available; use a shorter file, or a larger step")
    except Exception as error:
        reports.send(error=f"a fault in ftlm itself ({type(error).__name__}: {error}); please report it")
    else:
        reports.send(answer=result)


def _end_with_parent() -> None:
    """Exit the process when standard input ends, as it does when the parent process exits."""
    sys.stdin.read()
    os._exit(1)


def describe_file(task: Mapping[str, Any]) -> dict[str, Any]:
    """Open a file, and return its description for the page as values that JSON can represent."""
    opened = open_file(task["file"], **task["options"])
    description = opened.to_dict()
    return {
        "kind": opened.kind,
        "rows": opened.rows,
        "columns": description["columns"][:MAX_SHOWN_COLUMNS],
        "hidden": max(len(opened.columns) - MAX_SHOWN_COLUMNS, 0),
        "assumptions": [a.evidence for a in opened.assumptions],
        "options": description["options"],
        "step": opened.step,
        "problem": opened.problem,
        "notes": list(opened.warnings),
        "offers": [] if opened.problem else suggest_structures(*_signals(opened), (opened.step or 1.0) * opened.rows),
        **_run_preview(opened),
    }


def _signals(opened: OpenedFile) -> tuple[list[str], list[str]]:
    inputs, outputs = ([c.signal for c in opened.columns if c.role == role] for role in ("input", "output"))
    return inputs, outputs


def _run_preview(opened: OpenedFile) -> dict[str, Any]:
    """Return charts, advice and number of samples of the run in a file; empty if the file cannot be loaded."""
    if opened.problem:
        return {"figures": [], "advice": [], "length": 0}
    # The file is read again with all options given, as the fit reads it, so that both have the same samples.
    run = opened.load()
    return {"figures": run_figures(run), "advice": [a.sentence for a in run.advice()], "length": run.length}


def make_model(task: Mapping[str, Any], reports: Reports) -> dict[str, Any]:
    """Fit a model, write the model file and the report, and return the description for the page."""
    fitted_model = FitRequest.of(task["fit_request"]).fit_model(reports, task["store"])
    reports.phase("writing the report")
    fitted_model.result.model.save(task["model"])
    fitted_model.result.report(task["report"], validation=fitted_model.other)
    return model_summary(fitted_model)


if __name__ == "__main__":
    main()
