"""References to parameters in messages, in the words of Python, of the command line, of a report or of the web app.

The interface is the same for the whole process, so all threads format messages in the same
way. A parent process passes :func:`current_interface` to its child processes.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

Interface = Literal["python", "command line", "report", "app"]
#: Interfaces whose users type parameters.
TYPED_INTERFACES = ("python", "command line")
#: Flags that are not "--" and the name of the parameter with dashes. Two flags set an order grid.
FLAG_BY_PARAMETER = {"inputs": "-u", "outputs": "-y", "order_grid": "--order-grid or --increment"}
#: Places of the web app for the parameters that its forms have.
FIELD_BY_PARAMETER = {
    "step": "the field “Step”",
    "resample": "the field “Put on the step”",
    "time_unit": "the field “Unit of time”",
    "missing": "the field “Gaps”",
    "window": "the fields “From” and “To”",
    "separator": "the field “Between cells”",
    "decimal": "the field “Decimals”",
    "thousands": "the field “Between thousands”",
    "skip": "the field “Lines above the table”",
    "header": "the field “Lines of header”",
    "dates": "the field “Dates”",
    "encoding": "the field “Encoding”",
    "sheet": "the field “Sheet”",
    "time": "the role “time”",
    "inputs": "the role “input”",
    "outputs": "the role “output”",
    "units": "the column “unit”",
    "method": "the field “Method”",
    "offset": "the field “Offset”",
    "loss": "the field “Loss”",
}


class _CurrentInterface:
    """Interface (Python, command line, …) whose syntax error messages use; a global variable."""

    interface: Interface = "python"


class Note(str):
    """Note on an assumption: a text that ends with the parameter that replaces the assumption.

    Parameters
    ----------
    fact
        Text without the parameter, for readers who do not know its syntax.
    override
        Text of the parameter; empty if there is none.
    """

    fact: str
    override: str

    def __new__(cls, fact: str, override: str = "") -> Note:
        """Create the note from its parts."""
        note = super().__new__(cls, f"{fact}; otherwise {override}" if override else fact)
        note.fact, note.override = fact, override
        return note

    def __reduce__(self) -> tuple[type[Note], tuple[str, str]]:
        return Note, (self.fact, self.override)


class Placeholder(str):
    """Word in place of a value in a message, such as ``UNIT``; it is shown without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def type_name(value: object) -> str:
    """Return the name of the type of a value with its article, such as ``a dict`` or ``an int``."""
    name = type(value).__name__
    return f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}"


#: Placeholder mappings in messages: columns of a file by signal name, and by part of a frequency response.
NAMED_COLUMNS = {Placeholder("name"): Placeholder("column")}
PART_COLUMNS = {Placeholder("part"): Placeholder("column")}


def current_interface() -> Interface:
    """Return the interface (Python, command line, …) whose syntax error messages use."""
    return _CurrentInterface.interface


@contextmanager
def use_interface(name: Interface) -> Iterator[None]:
    """Format messages in the syntax of an interface within a ``with`` block."""
    interface_before, _CurrentInterface.interface = _CurrentInterface.interface, name
    try:
        yield
    finally:
        _CurrentInterface.interface = interface_before


def flag_of(name: str) -> str:
    """Return the command-line flag of a parameter."""
    return FLAG_BY_PARAMETER.get(name, f"--{name.replace('_', '-')}")


def parameter(name: str, value: object = None) -> str:
    """Return a reference to a parameter for a message, without or with a value.

    Parameters
    ----------
    name
        Name of the parameter in Python.
    value
        Value; None for the parameter alone. A :class:`Placeholder` is shown without quotes. A mapping is shown as
        ``NAME=VALUE`` on the command line, a pair as ``FROM:TO``. A report and the app have no syntax: they name the
        option, or the field of the app.

    Examples
    --------
    >>> parameter("window")
    'window='
    >>> parameter("method", "output-error")
    "method='output-error'"
    >>> with use_interface("command line"):
    ...     parameter("window"), parameter("method", "output-error")
    ('--window', '--method output-error')
    """
    if _CurrentInterface.interface == "python":
        return f"{name}=" if value is None else f"{name}={value!r}"
    if _CurrentInterface.interface != "command line":
        return _option_in_words(name, value)
    flag = flag_of(name)
    if value is None or value is True:
        return flag
    if value is False:
        return f"--no-{flag.removeprefix('--')}"
    return f"{flag} {_flag_value(value)}"


def _option_in_words(name: str, value: object) -> str:
    """Return a reference to a parameter for a reader who types no options, such as ``the option offset = auto``."""
    field = FIELD_BY_PARAMETER.get(name) if _CurrentInterface.interface == "app" else None
    option = field or f"the option {name}{' of Python' if _CurrentInterface.interface == 'app' else ''}"
    # A placeholder tells how an option is typed.
    is_placeholder = isinstance(value, Placeholder) or (
        isinstance(value, Mapping) and any(isinstance(item, Placeholder) for item in value.values())
    )
    if value is None or value is True or is_placeholder:
        return option
    if value is False:
        return f"no {option.removeprefix('the ')}"
    if isinstance(value, Mapping):
        return f"{option}: {', '.join(f'{key} = {item}' for key, item in value.items())}"
    if isinstance(value, (tuple, list)) and len(value) == 2:
        low, high = ("none" if limit is None else f"{limit}" for limit in value)
        return f"{option} = {low} to {high}"
    return f"{option} = {value}"


def setting(name: str) -> str:
    """Return the start of a message on the value of a parameter, such as ``top =`` or ``--top``.

    A name that is not an identifier, such as "delay of u", is a quantity and always followed by ``=``.
    """
    return parameter(name) if _CurrentInterface.interface == "command line" and name.isidentifier() else f"{name} ="


def choose_text(python: str, command_line: str, page: str | None = None) -> str:
    """Return the text for the interface; a report and the app have the text of Python if there is none for a page."""
    if _CurrentInterface.interface == "command line":
        return command_line
    return python if page is None or _CurrentInterface.interface == "python" else page


def layout_parameter(**values: object) -> str:
    """Return a reference to layout options with values.

    Examples are ``layout=dict(decimal='comma')`` in Python and ``--decimal comma`` on the command line.
    """
    if _CurrentInterface.interface == "python":
        return f"layout=dict({', '.join(f'{name}={value!r}' for name, value in values.items())})"
    separator = " " if _CurrentInterface.interface == "command line" else " and "
    return separator.join(parameter(name, value) for name, value in values.items())


def layout_fields(*names: str) -> str:
    """Return a reference to layout options for the start of a sentence, such as ``layout=: skip`` or ``--skip``."""
    if _CurrentInterface.interface == "python":
        return f"{parameter('layout')}: {' and '.join(names)}"
    return " and ".join(map(parameter, names))


def _flag_value(value: object) -> str:
    """Return the value of a flag as typed on the command line."""
    if isinstance(value, Placeholder):
        return value.upper()
    if isinstance(value, Mapping):
        return " ".join(f"{_flag_value(key)}={_flag_value(item)}" for key, item in value.items())
    if isinstance(value, (tuple, list)):
        return ":".join("" if limit is None else _flag_value(limit) for limit in value)
    return shlex.quote(value) if isinstance(value, str) else repr(value)
