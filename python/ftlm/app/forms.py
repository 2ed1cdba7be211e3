"""Fit requests of the web app: parsing of form fields, fit, equivalent Python script, and suggested structures."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

import msgspec.toml

from ftlm._core import __version__
from ftlm.arm.flexible_link import flexible_link
from ftlm.data.run import Run
from ftlm.errors import DataError, ModelError
from ftlm.estimation.identify import identify
from ftlm.estimation.methods import EstimationMethod, method_with_options
from ftlm.estimation.result import Identification
from ftlm.estimation.verdict import Validation
from ftlm.io.load import base_name, load
from ftlm.progress import ANNOUNCEMENT_THRESHOLD_S, format_time_left
from ftlm.structure.parser import equation
from ftlm.structure.structure import Offset, Structure
from ftlm.structure_selection.result import Selection
from ftlm.structure_selection.select import select
from ftlm.svg.html_page import read_resource
from ftlm.utils.resources import estimate_duration, output_error_cost
from ftlm.utils.validation import check_threads, is_run_name

#: Functions that return named structures, by the Python call that is shown in scripts.
NAMED_STRUCTURES: dict[str, Callable[[], Structure]] = {
    "flexible_link(stage=1)": lambda: flexible_link(stage=1),
    "flexible_link(stage=2)": lambda: flexible_link(stage=2),
}
#: Selection modes: fit the given structure, select terms within one structure, select among several, or automatic.
SELECTION_MODES = ("fit", "inside", "offered", "auto")
METHOD_NAMES = ("output-error", "instrumental-variables", "multi-innovation", "least-squares")
OFFSET_KINDS = ("none", "level", "constant", "ramp", "auto")
LOSS_NAMES = ("squares", "huber")
#: Name of the progress phase of a structure selection.
SELECTION_PHASE = "choosing a structure"
#: Maximum length of a line of a generated script [characters]; longer calls have one argument per line.
MAX_SCRIPT_LINE_CHARACTERS = 100


class ProgressListener(Protocol):
    """Protocol for receivers of progress reports."""

    def phase(self, words: str) -> None:
        """Report the start of the phase that `words` describes."""

    def __call__(self, count: int, total: int) -> None:
        """Report that ``count`` of ``total`` parts of the current phase are done."""


@dataclass(frozen=True)
class RunSource:
    """File in the web app, with the arguments of `ftlm.load` that load it as a run.

    Parameters
    ----------
    file
        File name that the web app shows.
    options
        Keyword arguments of `ftlm.load`, as `ftlm.open_file` returns them; the layout is a dictionary.
    path
        Path at which the web app stores the file. If it is empty, the file has the name `file` in the working
        folder.
    """

    file: str
    options: dict[str, Any] = field(default_factory=dict)
    path: str = ""

    def run(self) -> Run:
        """Load the run; a run that has the name of the stored file is renamed after the uploaded file."""
        run = load(self.path or self.file, **self.options)
        if not self.path or run.name != base_name(Path(self.path)):
            return run
        name = base_name(Path(self.file))
        return run._replace(name=name if is_run_name(name) else "run")

    def script(self, name: str) -> list[str]:
        """Return the lines of a Python script that load the run into the variable `name`."""
        return format_call(name, "ftlm.load", [format_string(self.file)], self.options)


@dataclass(frozen=True)
class FitRequest:
    """Complete definition of a fit that the user requests: runs, structure and options.

    Parameters
    ----------
    estimation
        Run that the model is fitted to.
    validation
        Validation run; None without validation, or if the end of the estimation run is used for it.
    share
        Fraction of the estimation run, at its end, that is used for validation, from 0 (none) to 0.8.
    structure
        Equations, or keys of :data:`NAMED_STRUCTURES`. The mode ``"offered"`` has several, ``"auto"`` has none, and the
        other modes have one.
    selection_mode
        Selection mode, one of :data:`SELECTION_MODES`: ``"fit"`` fits the structure as given, ``"inside"`` selects
        terms of it, ``"offered"`` selects among several structures, and ``"auto"`` requires none.
    method, offset, loss
        Method and offset of :func:`ftlm.identify`, and loss of :class:`ftlm.OutputError`; "" for the defaults.
    """

    estimation: RunSource
    validation: RunSource | None = None
    share: float = 0.0
    structure: tuple[str, ...] = ()
    selection_mode: str = "fit"
    method: str = ""
    offset: str = ""
    loss: str = ""

    @classmethod
    def of(cls, fields: Mapping[str, Any]) -> FitRequest:
        """Return the request from its dictionary, as :meth:`to_dict` returns it."""
        other = fields["validation"]
        parts = {**fields, "structure": tuple(fields["structure"]), "estimation": RunSource(**fields["estimation"])}
        return cls(**{**parts, "validation": None if other is None else RunSource(**other)})

    def to_dict(self) -> dict[str, Any]:
        """Return the request as a dictionary of values that JSON can represent."""
        return asdict(self)

    @property
    def text(self) -> str:
        """Structure or selection mode of the request as one line of text."""
        return {
            "fit": "; ".join(self.structure),
            "inside": f"chosen inside {'; '.join(self.structure)}",
            "offered": f"chosen among {len(self.structure)} structures",
            "auto": "chosen by ftlm",
        }[self.selection_mode]

    def settings(self) -> dict[str, str]:
        """Return method, offset and loss by name; options at their defaults are omitted."""
        options = {"method": self.method, "offset": self.offset, "loss": self.loss}
        return {name: value for name, value in options.items() if value}

    def estimation_method(self) -> EstimationMethod:
        """Return the estimation method with its loss; output error by default."""
        return method_with_options(self.method or METHOD_NAMES[0], {"loss": self.loss} if self.loss else {})

    def identify_arguments(self) -> list[str]:
        """Return the arguments of `ftlm.identify` after runs and structure, as Python expressions."""
        arguments = [f"method={format_string(self.method)}"] if self.method else []
        if self.loss:
            kind = type(self.estimation_method()).__name__
            arguments = [f"method=ftlm.{kind}(loss={format_string(self.loss)})"]
        return [*arguments, *([f"offset={format_string(self.offset)}"] if self.offset else [])]

    def structures(self) -> list[Structure]:
        """Return the structures of the request, parsed from text.

        Raises
        ------
        ModelError
            If an equation is invalid.
        """
        return [structure_of(text) for text in self.structure]

    @property
    def selects_structure(self) -> bool:
        """Whether the request selects a structure. A selection takes so long that a checkpoint file is useful."""
        return self.selection_mode != "fit"

    def fit_model(self, listener: ProgressListener, store: str | None = None) -> FittedModel:
        """Read the runs, fit and validate the model, and return it with its runs and a script.

        Parameters
        ----------
        listener
            Receiver of progress reports.
        store
            Checkpoint file of a structure selection; a stopped selection continues from it.

        Raises
        ------
        DataError, ModelError, ConvergenceError
            In the cases of :func:`ftlm.load`, :func:`ftlm.identify` and :func:`ftlm.select`.
        """
        structures = self.structures()
        listener.phase("reading")
        estimation_run, validation_run, split_at = self._runs()
        listener.phase(
            SELECTION_PHASE
            if self.selects_structure
            else f"fitting{self._time_estimate(estimation_run, structures[0])}"
        )
        choice = None
        if not self.selects_structure:
            method, offset = self.estimation_method(), cast("Offset", self.offset) if self.offset else None
            result = identify(estimation_run, structures[0], method=method, offset=offset, progress=listener)
        else:
            candidates = (
                "auto"
                if self.selection_mode == "auto"
                else structures[0]
                if self.selection_mode == "inside"
                else structures
            )
            choice = select(estimation_run, candidates, progress=listener, store=store)
            # The selection may have assumed zero initial conditions. Its structure allows others, which this fit tests.
            listener.phase("fitting what was chosen")
            result = identify(estimation_run, choice.winner.structure, progress=listener)
        listener.phase("validating")
        return FittedModel(
            result,
            estimation_run,
            validation_run,
            None if validation_run is None else result.validate(validation_run),
            choice,
            self._script(split_at),
        )

    def _time_estimate(self, run: Run, structure: Structure) -> str:
        """Return the estimated duration of an output-error fit as text; empty for a short fit or another method."""
        parameter_count = (
            len(structure.order_names) + len(structure.coefficient_names) + len(structure.free_input_parameters)
        )
        seconds = estimate_duration(
            output_error_cost(run.length * len(structure.outputs), parameter_count), check_threads(None)
        )
        if seconds < ANNOUNCEMENT_THRESHOLD_S or self.method not in ("", METHOD_NAMES[0]):
            return ""
        return f", {format_time_left(seconds).removesuffix(' left')} in all"

    def _runs(self) -> tuple[Run, Run | None, float | None]:
        """Return the estimation run, the validation run (or None), and the split time of one run [s] (or None)."""
        run = self.estimation.run()
        if self.validation is not None:
            return run, self.validation.run(), None
        if not self.share:
            return run, None, None
        cut = split_time(run.length, run.step, self.share)
        return run.window(None, cut), run.window(cut, None), cut

    def _script(self, cut: float | None) -> str:
        """Return a Python script that repeats the fit; `cut` is the time at which the run is split [s], or None."""
        stem = Path(self.estimation.file).stem
        lines = [
            f'"""A model of {sanitize_for_docstring(self.estimation.file)}, as made by the page of ftlm '
            f'{__version__}."""',
            "",
        ]
        lines += ["import ftlm", ""]
        if cut is None:
            lines += self.estimation.script("run")
        else:
            lines += self.estimation.script("whole")
            lines.append(f"run, other = whole.window(None, {cut!r}), whole.window({cut!r}, None)")
        if self.validation is not None:
            lines += self.validation.script("other")
        if not self.selects_structure:
            lines.append(f"structure = {structure_expression(self.structure[0])}")
            lines += format_call("result", "ftlm.identify", ["run", "structure", *self.identify_arguments()], {})
        else:
            if self.selection_mode == "offered":
                lines += ["candidates = [", *(f"    {structure_expression(text)}," for text in self.structure), "]"]
            else:
                is_auto = self.selection_mode == "auto"
                candidates = format_string("auto") if is_auto else structure_expression(self.structure[0])
                lines.append(f"candidates = {candidates}")
            lines += ["choice = ftlm.select(run, candidates)", "print(choice.reason)"]
            lines.append("result = ftlm.identify(run, choice.winner.structure)")
        has_validation = cut is not None or self.validation is not None
        lines.append("print(result.summary(result.validate(other)))" if has_validation else "print(result.summary())")
        lines.append(f"result.model.save({format_string(stem + '-model.json')})")
        lines.append(
            f"result.report({format_string(stem + '-report.html')}{', validation=other' if has_validation else ''})"
        )
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class FittedModel:
    """Identification with its estimation run, validation run, validation result, structure selection and script."""

    result: Identification
    run: Run
    other: Run | None
    validation: Validation | None
    choice: Selection | None
    script: str


def structure_of(text: str) -> Structure:
    """Return the structure of a text, which is an equation or a key of :data:`NAMED_STRUCTURES`."""
    return NAMED_STRUCTURES[text]() if text in NAMED_STRUCTURES else equation(text)


def parse_structures(request: FitRequest) -> list[Structure]:
    """Return the structures of a request.

    Raise ModelError if an option is unknown, the number of structures does not suit the selection mode, the options
    contradict each other, or an equation is invalid.
    """
    for name, value, choices in (
        ("selection_mode", request.selection_mode, SELECTION_MODES),
        ("method", request.method, ("", *METHOD_NAMES)),
        ("offset", request.offset, ("", *OFFSET_KINDS)),
        ("loss", request.loss, ("", *LOSS_NAMES)),
    ):
        if value not in choices:
            raise ModelError(f"{name} = {value!r} is not known; use {' or '.join(filter(None, choices))}")
    if request.selection_mode == "offered" and len(request.structure) < 2:
        raise ModelError("a comparison needs at least two structures; fit this one, or select its terms")
    if request.selection_mode in ("fit", "inside") and len(request.structure) != 1:
        raise ModelError("no structure is given; write an equation, or use a suggested one")
    if request.selection_mode != "fit" and request.settings():
        raise ModelError(
            f"{', '.join(request.settings())}: a structure selection uses output error and decides on the offset; "
            "leave these options at their defaults"
        )
    if not 0.0 <= request.share <= 0.8:
        raise ModelError(
            f"share = {request.share!r} of the run for validation is outside [0, 0.8]; use a smaller share"
        )
    return request.structures()


def split_time(rows: int, step: float, share: float) -> float:
    """Return the time [s] at which to split a run of `rows` samples so that its last part has the fraction `share`."""
    return float(f"{round(rows * (1.0 - share)) * step:.9g}")


def structure_expression(structure: str) -> str:
    """Return the Python expression of a structure that is given as text."""
    return f"ftlm.{structure}" if structure in NAMED_STRUCTURES else f"ftlm.equation({format_string(structure)})"


def format_call(target: str, function: str, values: list[str], keywords: Mapping[str, Any]) -> list[str]:
    """Return the assignment of a function call to `target` as lines of Python code.

    Each argument has its own line if a single line would be too long.
    """
    parts = [*values, *(f"{name}={format_literal(value)}" for name, value in keywords.items())]
    line = f"{target} = {function}({', '.join(parts)})"
    if len(line) <= MAX_SCRIPT_LINE_CHARACTERS:
        return [line]
    return [f"{target} = {function}(", *(f"    {part}," for part in parts), ")"]


def format_literal(value: Any) -> str:
    """Return the Python expression of a JSON value."""
    if isinstance(value, str):
        return format_string(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{format_string(k)}: {format_literal(v)}" for k, v in value.items()) + "}"
    return f"[{', '.join(map(format_literal, value))}]" if isinstance(value, (list, tuple)) else repr(value)


def format_string(text: str) -> str:
    """Return a Python string literal in double quotes, with escaped control characters."""
    if text.isprintable():
        return json.dumps(text, ensure_ascii=False)
    return repr(text).encode("ascii", "backslashreplace").decode()


def sanitize_for_docstring(text: str) -> str:
    """Return a file name with characters that are unsafe in a docstring replaced by "?", at most 100 characters."""
    return "".join(c if c.isalnum() or c in " ._-()" else "?" for c in text)[:100]


#: Form fields of the layout of a text file: those with integer values, and those with text values.
INTEGER_LAYOUT_FIELDS = ("skip", "header")
TEXT_LAYOUT_FIELDS = ("encoding", "separator", "decimal", "thousands", "dates", "sheet")
COLUMN_ROLES = ("", "time", "input", "output")
MAX_SIGNALS = 500


def parse_fields(texts: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of `ftlm.open_file` from form fields; empty fields are omitted.

    Parameters
    ----------
    texts
        Form fields by name. ``columns`` is a list of objects with name, role, signal and unit. ``step``, ``resample``,
        ``from`` and ``to`` are numbers as text. ``time_unit``, ``missing`` and the fields of the layout are text.

    Raises
    ------
    DataError
        If a number is invalid, a field is not text, or the list of columns is invalid.
    """

    def read_fields(parse: Callable[[str, str], Any], *names: str) -> dict[str, Any]:
        """Return the parsed values of the nonempty fields among `names`, by name."""
        return {name: parse(name, text) for name in names if (text := _text(texts, name))}

    options = read_fields(parse_number, "step", "resample") | read_fields(_plain_text, "time_unit", "missing")
    bounds = read_fields(parse_number, "from", "to")
    if bounds:
        options["window"] = [bounds.get("from"), bounds.get("to")]
    layout = read_fields(_plain_text, *TEXT_LAYOUT_FIELDS) | read_fields(_parse_line_count, *INTEGER_LAYOUT_FIELDS)
    if layout:
        options["layout"] = layout
    return options | _roles(texts.get("columns"))


def _roles(columns: Any) -> dict[str, Any]:
    """Return the arguments time, inputs, outputs and units from the list of columns of a form; {} for None.

    Raise DataError for an invalid list, an unknown role, two time columns, or two signals of equal name.
    """
    if columns is None:
        return {}
    if not isinstance(columns, list) or len(columns) > MAX_SIGNALS:
        raise DataError(f"columns is not a list of at most {MAX_SIGNALS} columns; send one object per column")
    roles: dict[str, Any] = {}
    for entry in columns:
        if not isinstance(entry, Mapping):
            raise DataError(
                "columns has an entry that is not an object; give name, role, signal and unit of each column"
            )
        name, role = _text(entry, "name"), _text(entry, "role")
        signal, unit = _text(entry, "signal") or name, _text(entry, "unit")
        if role not in COLUMN_ROLES:
            raise DataError(f"the role {role!r} of column {name!r} is not known; take time, input, output or none")
        if role == "time":
            if "time" in roles:
                raise DataError(f"{roles['time']!r} and {name!r} both have the role time; keep one of them")
            roles["time"] = name
        elif role:
            signals = roles.setdefault(f"{role}s", {})
            if signal in signals or signal in roles.get("inputs", {}) or signal in roles.get("outputs", {}):
                raise DataError(f"two columns are called {signal!r}; give each signal a name of its own")
            signals[signal] = name
            if unit:
                roles.setdefault("units", {})[signal] = unit
    return roles


def parse_number(name: str, text: str) -> float:
    """Return the number in the text of the form field `name`; raise DataError for other text."""
    try:
        return float(text)
    except ValueError:
        raise DataError(f"{name}: {text[:40]!r} is not a number; write one such as 0.5") from None


def _plain_text(_: str, text: str) -> str:
    return text


def _parse_line_count(name: str, text: str) -> int:
    """Return the line count that is given as text in the form field `name`; raise DataError for other text."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise DataError(f"{name}: {text[:40]!r} is not a number of lines; write one such as 2")
    return int(text)


def _text(texts: Mapping[str, Any], name: str) -> str:
    value = texts.get(name)
    if value is None:
        return ""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise DataError(f"{name} is not text; give a text or a number")
    return str(value).strip() if name not in ("name",) else str(value)


#: Maximum number of outputs, and of inputs, for which structures are suggested; longer lists are not readable.
MAX_SUGGESTED_SIGNALS = 6
#: Upper bound of the delay in a suggested structure, as a fraction of the duration of the run.
SUGGESTED_DELAY_FRACTION = 0.1


@cache
def _suggested_kinds() -> list[dict[str, str]]:
    """Return the suggested kinds of structures, with name, purpose ("why") and equation."""
    kinds: list[dict[str, str]] = msgspec.toml.decode(read_resource("suggested_structures.toml", "ftlm.app"))[
        "structures"
    ]
    return kinds


def suggest_structures(inputs: Sequence[str], outputs: Sequence[str], duration: float) -> list[dict[str, str]]:
    """Return suggested structures for the outputs of a run.

    Each suggestion is a dictionary with the keys "name", "why" (purpose), "structure" and "output". `duration` is that
    of the run [s], which determines the range of delays.
    """
    suggestions: list[dict[str, str]] = []
    input_names = list(inputs)[:MAX_SUGGESTED_SIGNALS]
    for output in list(outputs)[:MAX_SUGGESTED_SIGNALS]:
        delay_range = f"0:{SUGGESTED_DELAY_FRACTION * duration:.2g} s"
        terms = {
            "inputs": "".join(f" + b{k} {name}" for k, name in enumerate(input_names)),
            "delayed_inputs": "".join(f" + b{k} {name}(t - {delay_range})" for k, name in enumerate(input_names)),
        }
        for kind in _suggested_kinds():
            structure = kind["equation"].format(y=output, **terms)
            suggestions.append({"name": kind["name"], "why": kind["why"], "structure": structure, "output": output})
    for stage in (1, 2):
        if {f"I{stage}", f"theta{stage}1", f"theta{stage}2"} <= {*inputs, *outputs}:
            suggestions.append(
                {
                    "name": f"Flexible link {stage}",
                    "why": "hub and deflection of a flexible arm",
                    "structure": f"flexible_link(stage={stage})",
                    "output": f"theta{stage}1, theta{stage}2",
                }
            )
    return suggestions
