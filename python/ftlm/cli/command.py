"""What makes a function a command: options from records, errors as one line, results for people or for scripts."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import os
import re
import sys
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints

import typer
from typer.core import TyperCommand

from ftlm.base.errors import FtlmError, InternalError, ModelError, RigFault
from ftlm.cli.words import in_options
from ftlm.paint.text import columns, wrapped

#: Options that people take for others, from other programs or from the names of ftlm's functions.
MEANT = {"--equation": "--structure"}
#: So many gaps between its cells make a line the row of a table.
ROW, _GAPS, _ENTRY = 3, re.compile(" {2,}"), re.compile(r" *(?:[\w ]+\S {2,}|! |-> |\* |warning: |note: |assumed: )")
#: Types as a person names them.
KINDS = {
    "<str>": "TEXT", "<list[str]>": "TEXT", "<float>": "NUMBER", "<int>": "N", "<int range>": "N", "<list[int]>": "N",
    "<list[int range]>": "N",
}  # fmt: skip
EXIT_INTERNAL, EXIT_USAGE, EXIT_DATA, EXIT_VALIDATION, EXIT_RIG, EXIT_INTERRUPTED = 1, 2, 3, 4, 5, 130


class Command(TyperCommand):
    """A command that knows which of its options another name was meant for, and names kinds of values in words."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        for parameter in self.params:
            # An argument is named by what it is of, and what no option names is a text or a number to a person.
            told: Any = parameter
            told.display_type_rich = functools.partial(
                _kind, told.display_type_rich, argument=told.param_type_name == "argument"
            )

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Options as usual; one that is another's name ends in a sentence."""
        known = {name for parameter in self.params for name in parameter.opts}
        for given in (a.partition("=")[0] for a in args):
            if given not in known and MEANT.get(given) in known:
                ctx.fail(f"No such option: {given}; {MEANT[given]} takes equations in words, too.")
        return super().parse_args(ctx, args)


def _kind(kind: Callable[..., str], *, ctx: Any, argument: bool) -> str:
    """What an option takes, in words."""
    return "" if argument else KINDS.get(kind(ctx=ctx), kind(ctx=ctx))


def command(work: Callable[..., None]) -> Callable[..., None]:
    """Make a function a command.

    A parameter that is a dataclass stands for its fields: each is an option of the command, in that place, and the
    function receives the record. An error becomes one line on standard error and an exit code.
    """
    records: dict[str, type[Any]] = {}
    options: list[inspect.Parameter] = []
    for parameter in inspect.signature(work, eval_str=True).parameters.values():
        kind = parameter.annotation
        if isinstance(kind, type) and is_dataclass(kind):
            records[parameter.name] = kind
            options += _options_of(kind)
        else:
            options.append(parameter)

    @functools.wraps(work)
    def run(**given: Any) -> None:
        made = {name: kind(**{f.name: given.pop(f.name) for f in fields(kind)}) for name, kind in records.items()}
        try:
            work(**given, **made)
            sys.stdout.flush()
        except KeyboardInterrupt:
            print("ftlm: interrupted; nothing was written", file=sys.stderr)
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except BrokenPipeError:
            # The reader of a pipe has gone; what it did not read is nobody's loss.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(0) from None
        except FtlmError as error:
            print(f"ftlm: {in_options(str(error))}", file=sys.stderr)
            raise typer.Exit(exit_code(error)) from None
        except OSError as error:
            # Of what is printed, or of a working folder that is gone; files have sentences of their own.
            what = "" if error.filename is None else f" {error.filename!r}"
            print(
                f"ftlm: the system refuses{what}: {error.strerror or error}; what was written to files is there, check "
                "where the output goes and the working folder",
                file=sys.stderr,
            )
            with contextlib.suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(EXIT_DATA) from None

    # What typer reads.
    run.__annotations__ = {option.name: option.annotation for option in options}
    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    return run


def _options_of(record: type[Any]) -> list[inspect.Parameter]:
    """The fields of a record as parameters of a function."""
    hints = get_type_hints(record, include_extras=True)
    return [
        inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default, annotation=hints[f.name])
        for f in fields(record)
    ]


def exit_code(error: FtlmError) -> int:
    """Exit code of an error: 1 internal, 2 usage, 3 data refused, 5 rig."""
    if isinstance(error, InternalError):
        return EXIT_INTERNAL
    if isinstance(error, ModelError):
        return EXIT_USAGE
    return EXIT_RIG if isinstance(error, RigFault) else EXIT_DATA


def show(result: Any, *, as_json: bool) -> None:
    """Print a result, for people or as JSON."""
    if as_json:
        show_json(result.to_dict())
    else:
        say(str(result))


def say(text: str, end: str = "\n") -> None:
    """Print what people read, in lines that a terminal does not break within words.

    Rows of tables and commands to be copied stay as they are.
    """
    text = in_options(text)
    if sys.stdout.isatty():
        text = "\n".join(broken for line in text.split("\n") for broken in broken_line(line))
    print(text, end=end)


def broken_line(line: str) -> list[str]:
    """A line as a terminal takes it: itself, or several where it is longer."""
    lead = line[: len(line) - len(line.lstrip())]
    if len(line) <= columns() or line.startswith("next: ") or len(_GAPS.findall(line.strip())) >= ROW:
        return [line]
    # An entry such as "  mode  of so much": what follows stands under its words.
    entry = _ENTRY.match(line)
    return wrapped(line.strip(), lead, " " * (entry.end() if entry else len(lead) + 2))


def show_json(document: Any) -> None:
    """Print a document of plain values and NumPy's."""
    print(json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False, default=_plain))


def tell(sentence: str, *, as_json: bool, **facts: Any) -> None:
    """Print what was done, as a sentence or as one line of JSON."""
    print(json.dumps(facts, ensure_ascii=False) if as_json else sentence)


def _plain(value: Any) -> Any:
    """NumPy scalars and arrays as JSON knows them."""
    return value.tolist() if hasattr(value, "tolist") else str(value)
