"""Framework of the command line: commands from functions, help texts, option values, errors and exit codes."""

from __future__ import annotations

import contextlib
import functools
import inspect
import io
import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand

from ftlm import cli
from ftlm.data.run import Run
from ftlm.errors import FtlmError, InternalError, ModelError, RigFault
from ftlm.progress import Progress
from ftlm.utils.files import check_ending, check_writable, write_atomically
from ftlm.utils.formatting import line_length, wrap_text
from ftlm.utils.parameters import use_interface
from ftlm.utils.resources import duration_bounds, estimate_duration
from ftlm.utils.validation import join_names, nearest


def pairs(option: str, texts: list[str] | None) -> dict[str, str]:
    """Parse NAME=VALUE options into a dictionary; NAME alone means NAME=NAME. Raise ModelError for other text."""
    values: dict[str, str] = {}
    for item in texts or []:
        name, equals, value = item.partition("=")
        value = value if equals else name
        if not equals and name and not re.fullmatch(r"[^\W\d][\w.\[\]]*", name):
            short = re.sub(r"\W+", "_", name.partition("(")[0]).strip("_0123456789").lower() or "name"
            raise ModelError(f'{option} {item!r} has no name; write NAME=…, such as {option} "{short}={item}"')
        if not name or not value:
            raise ModelError(f"{option} {item!r} is not a pair; give NAME=VALUE")
        if name in values:
            raise ModelError(f"{option} names {name!r} twice; give it once")
        values[name] = value
    return values


def numbers(option: str, texts: list[str] | None) -> dict[str, float]:
    """Parse NAME=NUMBER options into a dictionary; raise ModelError for other text."""
    values = {}
    for name, value in pairs(option, texts).items():
        try:
            values[name] = float(value)
        except ValueError:
            raise ModelError(f"{option} {name}={value}: {value!r} is not a number; give NAME=NUMBER") from None
    return values


def ranges(option: str, texts: list[str] | None) -> dict[str, float | tuple[float, float]]:
    """Parse NAME=NUMBER or NAME=FIRST:SECOND options into a dictionary of numbers or pairs of numbers.

    Raise ModelError for other text.
    """
    forms = {
        "--delay": "neither seconds nor LOW:HIGH; give one, such as 0:0.02",
        "--priors": "not MEAN:DEVIATION; write it as in 2:0.1",
    }
    problem = forms.get(option, "neither a number nor LOW:HIGH; give one, such as 0.5:1.5")
    values: dict[str, float | tuple[float, float]] = {}
    for name, value in pairs(option, texts).items():
        bounds = split_numbers(value)
        if len(bounds) not in ((2,) if option == "--priors" else (1, 2)):
            raise ModelError(f"{option} {name}={value}: {value!r} is {problem}")
        values[name] = bounds[0] if len(bounds) == 1 else (bounds[0], bounds[1])
    return values


def interval(text: str, option: str, example: str) -> tuple[float | None, float | None]:
    """Parse FROM:TO into two numbers, with None for an empty end; raise ModelError for other text.

    `option` and `example` are named in the message.
    """
    texts = text.split(":")
    try:
        if len(texts) != 2:
            raise ValueError
        start, stop = (float(p) if p.strip() else None for p in texts)
    except ValueError:
        raise ModelError(f"{option} {text!r} is not an interval; give FROM:TO, such as {example}") from None
    return start, stop


def parse_numbers(option: str, text: str, *counts: int) -> list[float]:
    """Parse numbers that are separated by colons; raise ModelError unless their count is one of `counts`."""
    values = split_numbers(text)
    if len(values) not in counts:
        choices = " or ".join(str(c) for c in counts)
        raise ModelError(f"{option} {text!r} has {len(values)} numbers; give {choices}, joined by colons")
    return values


def split_numbers(text: str) -> list[float]:
    """Parse numbers that are separated by colons; return [] if one of them is invalid."""
    try:
        return [float(part) for part in text.split(":")]
    except ValueError:
        return []


#: Options that do not exist, with the correct option that an error message suggests.
OPTION_ALIASES = {"--equation": "--structure", "--circuit": "--structure"}
#: Minimum number of gaps of two or more spaces in a line that is treated as a table row, and pattern of such a gap.
MIN_TABLE_GAPS, _GAP_PATTERN = 3, re.compile(" {2,}")
#: Pattern of the beginning of a list entry.
_ENTRY_PATTERN = re.compile(r" *(?:[\w ]+\S {2,}|! |-> |\* |warning: |note: |assumed: )")
#: Message of typer's option parser for a value that is not among the choices of an option.
_CHOICE_PATTERN = re.compile(r".*?'([^']*)' is not one of (.*)\.")
#: Names of types in help texts.
TYPE_LABELS = {str: "TEXT", float: "NUMBER", int: "N"}
EXIT_INTERNAL, EXIT_USAGE, EXIT_DATA, EXIT_VALIDATION, EXIT_RIG, EXIT_INTERRUPTED = 1, 2, 3, 4, 5, 130


#: Options that select the estimation method of a command, and the flag that shows the help of all methods.
METHOD_FLAGS, HELP_ALL_FLAG = ("--method", "--coefficients"), "--help-all"
#: Panels of a help text in their sequence. Options without a panel follow in the panel OTHER_PANEL.
OPTION_PANELS = ("File", "Structure", "Method", "Output")
OTHER_PANEL = "Options"


def _number_message(details: Mapping[str, Any]) -> str:
    """Return the message for an option value that is not a number or is out of range; `details` has its value."""
    value, kind = details["input"], details["type"]
    if kind not in ("float_parsing", "int_parsing"):
        return f"{value!r} is out of range: {details['msg'].removeprefix('Input ')}."
    description = "number" if kind == "float_parsing" else "whole number"
    remedy = f"; write {value.replace(',', '.')!r}" if re.fullmatch(r"-?\d+,\d+", str(value)) else ""
    return f"{value!r} is not a {description}{remedy}."


class Command(TyperCommand):
    """Command whose help is grouped in panels, and whose errors suggest the correct option or choice."""

    @property
    def methods_by_field(self) -> dict[str, tuple[str, ...]]:
        """Names of the methods that use an option, by option name; options without an entry apply to all methods."""
        return getattr(self.callback, "methods_by_field", {})

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; errors name the correct option or the valid choices."""
        names = {name for parameter in self.params for name in parameter.opts}
        for option_name in (a.partition("=")[0] for a in args):
            if option_name not in names and OPTION_ALIASES.get(option_name) in names:
                ctx.fail(
                    f"No such option: {option_name}; {OPTION_ALIASES[option_name]} takes equations as text, and ftlm "
                    "identify-frequency takes circuits: fit each, and compare their AICc."
                )
        ctx.meta["method"] = self._chosen_method(args)
        if HELP_ALL_FLAG in args:
            ctx.meta["method"] = None
            args = ["--help"]
        self._check_repetition(ctx, args)
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            choice = _CHOICE_PATTERN.fullmatch(error.message)
            if choice is not None:
                choices = re.findall("'([^']*)'", choice[2])
                error.message = f"{choice[1]!r} is not one of {join_names(choices)}{nearest(choice[1], choices)}."
            elif callable(problems := getattr(error.__cause__, "errors", None)):
                error.message = _number_message(problems()[0])
            raise

    def _check_repetition(self, ctx: Any, args: Sequence[str]) -> None:
        """Raise a usage error for a repeated option with a single value; the parser would use the last value only."""
        order: list[Any] = self.make_parser(ctx).parse_args(list(args))[2]
        single_valued = [p for p in order if p.param_type_name == "option" and not (p.multiple or p.is_flag or p.count)]
        for option in single_valued:
            if single_valued.count(option) > 1:
                (flag, *_), remedy = sorted(option.opts, key=len, reverse=True), "give it once"
                if flag == "--structure":
                    remedy = "join the equations of several outputs by a semicolon"
                ctx.fail(f"{flag} is given {single_valued.count(option)} times, but takes one value; {remedy}.")

    def _chosen_method(self, args: Sequence[str]) -> str | None:
        """Return the method that the arguments select, or the default method; None if the command has no methods."""
        option: Any = next((p for p in self.params if not set(METHOD_FLAGS).isdisjoint(p.opts)), None)
        if option is None:
            return None
        choice = option.default
        for word, next_argument in zip(args, [*args, ""][1:], strict=True):
            flag, equals, value = word.partition("=")
            if flag in option.opts:
                choice = value if equals else next_argument
        return str(choice)

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the help of arguments and options, grouped by panel.

        Options that the selected method does not use are omitted, except with --help-all.
        """
        method = ctx.meta.get("method")
        panels: dict[str, list[tuple[str, str]]] = {
            "Arguments": [],
            **{name: [] for name in (*OPTION_PANELS, OTHER_PANEL)},
        }
        is_method_section = False
        for parameter in self.get_params(ctx):
            shown_parameter: Any = parameter
            record = shown_parameter.get_help_record(ctx)
            methods = self.methods_by_field.get(shown_parameter.name)
            if methods is not None and method is not None and method not in methods:
                is_method_section = True
            elif record is not None and shown_parameter.param_type_name == "argument":
                # Some versions of typer add a type after the name, so the name is used alone.
                panels["Arguments"].append((shown_parameter.metavar, record[1]))
            elif record is not None:
                panels[getattr(shown_parameter, "rich_help_panel", None) or OTHER_PANEL].append(record)
        if self.methods_by_field and self._chosen_method([]) is not None:
            panels[OTHER_PANEL].append((HELP_ALL_FLAG, "Show the options of all methods and exit."))
        for name, records in panels.items():
            if records:
                with formatter.section(f"{name} of {method}" if name == "Method" and is_method_section else name):
                    formatter.write_dl(records)


@dataclass(frozen=True)
class OptionDetails:
    """Annotation of an option with details that its name, type and default do not define.

    Parameters
    ----------
    flags
        Flags, such as ("-o", "--out"). By default they are those of `OPTION_FLAGS`, or "--" and the name.
    min
        Minimum value of an integer.
    is_output
        Whether the value is a file to write. A path that cannot be written is rejected before the computation.
    ending
        Required file extension; any extension if empty.
    help_entry
        Name of the entry in the shared help texts; by default the name of the option.
    """

    flags: tuple[str, ...] = ()
    min: int | None = None
    is_output: bool = False
    ending: str = ""
    help_entry: str | None = None


OutputFile = Annotated[str, OptionDetails(is_output=True)]
OutputPage = Annotated[str, OptionDetails(is_output=True, ending=".html", help_entry="page")]
OptionalOutputFile = Annotated[str | None, OptionDetails(is_output=True)]
OptionalOutputPage = Annotated[str | None, OptionDetails(is_output=True, ending=".html")]
OptionalOutputCsv = Annotated[str | None, OptionDetails(is_output=True, ending=".csv")]
OptionalOutputJson = Annotated[str | None, OptionDetails(is_output=True, ending=".json")]
NonNegative = Annotated[int, OptionDetails(min=0)]
Positive = Annotated[int, OptionDetails(min=1)]
#: Flags of options that have other flags than "--" and their name.
OPTION_FLAGS = {
    "as_json": ("--json",),
    "structures": ("--structure",),
    "inputs": ("-u", "--inputs"),
    "outputs": ("-y", "--outputs"),
    "out": ("-o", "--out"),
    "verbose": ("-v", "--verbose"),
}


@dataclass(frozen=True)
class OptionText:
    """Help of an option: name of its panel, name of its value (metavar), and text."""

    panel: str | None
    metavar: str | None
    help: str


def parse_option_texts(docstring: str | None) -> tuple[str, dict[str, OptionText]]:
    """Return the summary of a docstring, and the help of each option in its sections by option name.

    The summary is the text before the first section. Each section is a panel of the help, and its entries have the
    form of numpydoc: option name, colon and metavar, then the text. Options in the section ``Options`` have no panel.
    """
    summary, *sections = re.split(r"^(\w+)\n-+\n", inspect.cleandoc(docstring or ""), flags=re.MULTILINE)
    texts = {}
    for panel, parameters in zip(sections[::2], sections[1::2], strict=True):
        for name, metavar, description in re.findall(r"^(\w+)(?: : (.+))?\n((?: +.*\n?)+)", parameters, re.MULTILINE):
            texts[name] = OptionText(
                None if panel == OTHER_PANEL else panel, metavar or None, " ".join(description.split())
            )
    return summary.strip(), texts


#: Help of options that several commands share, by option name.
SHARED_TEXTS = parse_option_texts(cli.__doc__)[1]


def command(work: Callable[..., None]) -> Callable[..., None]:
    """Decorator that turns a function into a command for typer.

    Positional parameters become arguments, and keyword-only parameters become options. Their help texts are in the
    docstring of the function. Options that several commands share have their help in the docstring of ``ftlm.cli``. A
    dataclass parameter is expanded: each field becomes an option, and the function receives the dataclass. If the
    dataclass has a function `methods_of`, this function returns the names of the estimation methods that use an option.

    An error becomes one line on standard error and an exit code. An output file that already exists is an error unless
    `force` is set.
    """
    records: dict[str, type[Any]] = {}
    options: list[inspect.Parameter] = []
    methods_by_field: dict[str, tuple[str, ...]] = {}
    summary, texts = parse_option_texts(work.__doc__)
    for parameter in inspect.signature(work, eval_str=True).parameters.values():
        kind = parameter.annotation
        if isinstance(kind, type) and is_dataclass(kind):
            records[parameter.name] = kind
            hints, option_texts = get_type_hints(kind, include_extras=True), parse_option_texts(kind.__doc__)[1] | texts
            options += [_option(f.name, hints[f.name], f.default, option_texts) for f in fields(kind)]
            if hasattr(kind, "methods_of"):
                methods_by_field |= {f.name: kind.methods_of(f.name) for f in fields(kind)}
        else:
            positional = parameter.kind is not inspect.Parameter.KEYWORD_ONLY
            options.append(_option(parameter.name, kind, parameter.default, texts, positional=positional))
    described = {option.name: option.annotation.__metadata__[0] for option in options}
    outputs = {name: option.ending for name, option in described.items() if option.is_output}

    @functools.wraps(work)
    @use_interface("command line")
    def run(**arguments: Any) -> None:
        option_records = {
            name: kind(**{f.name: arguments.pop(f.name) for f in fields(kind)}) for name, kind in records.items()
        }
        try:
            if outputs:
                check_writable(*(arguments[name] for name in outputs), force=arguments["force"])
            for name, ending in outputs.items():
                if ending and arguments[name] is not None:
                    check_ending(arguments[name], ending)
            work(**arguments, **option_records)
            sys.stdout.flush()
        except KeyboardInterrupt:
            print("ftlm: interrupted; nothing was written", file=sys.stderr)
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except BrokenPipeError:
            # A program such as head closed the pipe before reading all of it, which is not an error.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None
        except FtlmError as error:
            print(f"ftlm: {error}", file=sys.stderr)
            raise typer.Exit(exit_code(error)) from None
        except OSError as error:
            # This is an error of standard output or of the working folder; errors of files are FtlmError.
            file_text = "" if error.filename is None else f" {error.filename!r}"
            print(
                f"ftlm: the system refuses{file_text}: {error.strerror or error}; files that were written are "
                "complete; "
                "check the destination of standard output and the working folder",
                file=sys.stderr,
            )
            with contextlib.suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(EXIT_DATA) from None

    # typer reads the options and the help from these attributes.
    run.__doc__ = summary
    run.__annotations__ = {option.name: option.annotation for option in options}
    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.methods_by_field = methods_by_field  # type: ignore[attr-defined]
    return run


def _option(
    name: str, hint: Any, default: Any, texts: Mapping[str, OptionText], *, positional: bool = False
) -> inspect.Parameter:
    """Return a parameter of a command with the annotation that typer requires.

    `texts` has the help texts of the command by option name; shared help texts are the fallback.
    """
    kind, details = get_args(hint) if get_origin(hint) is Annotated else (hint, OptionDetails())
    text = texts.get(name) or SHARED_TEXTS.get(details.help_entry or name) or OptionText(None, None, "")
    metavar = text.metavar or ("FILE" if details.is_output else _type_label(kind))
    described: Any
    if positional:
        described = typer.Argument(metavar=metavar, help=text.help)
    else:
        # For a switch that is on by default, typer creates the two flags --name and --no-name.
        flags = details.flags or OPTION_FLAGS.get(name) or (() if default is True else (f"--{name.replace('_', '-')}",))
        described = typer.Option(*flags, metavar=metavar, rich_help_panel=text.panel, help=text.help, min=details.min)
    described.is_output, described.ending = details.is_output, details.ending
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, described]
    )


def _type_label(kind: Any) -> str | None:
    """Return the name of the type of an option's value for help texts; None for a switch without a value."""
    if get_origin(kind) is Literal:
        return f"<{'|'.join(get_args(kind))}>"
    # An optional type or a list has the name of its element type.
    parts = get_args(kind)
    return _type_label(parts[0]) if parts else TYPE_LABELS.get(kind)


def exit_code(error: FtlmError) -> int:
    """Return the exit code of an error: 1 internal error, 2 usage, 3 data or convergence, 5 rig."""
    if isinstance(error, InternalError):
        return EXIT_INTERNAL
    if isinstance(error, ModelError):
        return EXIT_USAGE
    return EXIT_RIG if isinstance(error, RigFault) else EXIT_DATA


def show(result: Any, *, as_json: bool) -> None:
    """Print a result as text, or as JSON by its method ``to_dict``."""
    if as_json:
        show_json(result.to_dict())
    else:
        print_text(str(result))


def print_text(text: str, end: str = "\n") -> None:
    """Print text, wrapped between words to the width of the terminal.

    Table rows and commands to copy are not wrapped.
    """
    if sys.stdout.isatty():
        text = "\n".join(wrapped for line in text.split("\n") for wrapped in wrap_line(line))
    print(text, end=end)


def wrap_line(line: str) -> list[str]:
    """Return a line of text wrapped to the width of the terminal, as a list of lines.

    Table rows, and lines that begin with "next: ", are not wrapped.
    """
    indent = line[: len(line) - len(line.lstrip())]
    if (
        len(line) <= line_length()
        or line.startswith("next: ")
        or len(_GAP_PATTERN.findall(line.strip())) >= MIN_TABLE_GAPS
    ):
        return [line]
    # Further lines of a list entry are indented to the column where the text of the entry begins.
    entry = _ENTRY_PATTERN.match(line)
    return wrap_text(line.strip(), indent, " " * (entry.end() if entry else len(indent) + 2))


def show_json(document: Any) -> None:
    """Print a document of Python and NumPy values as indented JSON."""
    print(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False, default=_to_json_value))


def print_outcome(sentence: str, *, as_json: bool, **data: Any) -> None:
    """Print the outcome of a command as a sentence, or `data` as one line of JSON."""
    print(json.dumps(data, ensure_ascii=False) if as_json else sentence)


def _to_json_value(value: Any) -> Any:
    """Return a NumPy scalar or array as a Python number or list; return other objects as text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


#: File extensions for figures, without the dot.
FIGURE_FORMATS = ("png", "pdf", "svg")


def figure_kind(path: str | None) -> str:
    """Return the format of a figure file from its extension; "" for None. Raise ModelError for other extensions."""
    kind = "" if path is None else Path(path).suffix.removeprefix(".").lower()
    if path is not None and kind not in FIGURE_FORMATS:
        raise ModelError(f"{path} ends in {kind or 'nothing'!r}; write .png, .pdf or .svg")
    return kind


def write_figure(figure: Any, path: str, *, force: bool) -> None:
    """Write a matplotlib figure to a file at 200 dpi, in the format of the file extension."""
    data = io.BytesIO()
    figure.savefig(data, format=figure_kind(path), dpi=200)
    write_atomically(path, data.getvalue(), force=force)


def print_written_files(*paths: str | None) -> None:
    """Print one line for each path of a written file; a path that is None is skipped."""
    for path in paths:
        if path is not None:
            print(f"written: {path}")


#: Time to read one byte of a file, and to simulate one sample of an output, on the reference machine [s]. Lowest and
#: highest ratio of the actual to the estimated duration: numbers with few digits take more time per byte, and
#: oscillating simulations use a smaller step.
READ_TIME_PER_BYTE_S, SIMULATION_TIME_PER_SAMPLE_S, DURATION_FACTORS = 8e-8, 4e-6, (0.4, 4.0)
MIN_ANNOUNCED_TIME_S = 0.2
#: Time of a controller design, and of the loop analysis for one parameter sample, on the reference machine [s].
DESIGN_TIME_S, LOOP_ANALYSIS_TIME_S = {"pid": 0.1, "lqg": 1.2}, {"pid": 0.005, "lqg": 0.01}


def announce_reading(files: Sequence[str]) -> None:
    """Print the expected duration of reading files if it is long. A missing file is not reported here."""
    size = 0
    for file in files:
        try:
            size += os.stat(file).st_size
        except (OSError, ValueError):
            # The file reader raises the error later, with a message.
            return
    _announce("reading", READ_TIME_PER_BYTE_S * size)


def announce_simulation(runs: Sequence[Run], outputs: int, *, quiet: bool) -> None:
    """Print the expected duration of simulating `outputs` outputs of a model on runs if it is long."""
    samples = outputs * sum(run.length for run in runs)
    _announce("running the model", SIMULATION_TIME_PER_SAMPLE_S * samples, quiet=quiet)


def announce_design(design: str, samples: int) -> None:
    """Print the expected duration of a controller design checked on `samples` parameter samples if it is long."""
    _announce("designing", DESIGN_TIME_S[design] + LOOP_ANALYSIS_TIME_S[design] * max(samples, 0))


def _announce(operation: str, seconds: float, *, quiet: bool = False) -> None:
    """Print the expected duration of `operation` if it is long; `seconds` is its time on the reference machine."""
    # The speed of this machine is measured only for long work, because the measurement itself takes time.
    if seconds > MIN_ANNOUNCED_TIME_S:
        bounds = duration_bounds(estimate_duration(seconds, 1), DURATION_FACTORS)
        Progress("", quiet=quiet).announce(operation, *bounds)
