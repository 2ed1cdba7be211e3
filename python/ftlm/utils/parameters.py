"""References to parameters in messages, in the syntax of Python or of the command line.

The interface (Python or command line) is the same for the whole process, so all threads format messages in the same
way. A parent process passes :func:`current_interface` to its child processes.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

Interface = Literal["python", "command line"]
#: Flags that are not "--" and the name of the parameter with dashes. Two flags set an order grid.
FLAG_BY_PARAMETER = {"inputs": "-u", "outputs": "-y", "order_grid": "--order-grid or --increment"}


class _Current:
    """Global variable for the interface whose syntax messages use."""

    interface: Interface = "python"


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
    """Return the interface whose syntax messages use."""
    return _Current.interface


@contextmanager
def use_interface(name: Interface) -> Iterator[None]:
    """Format messages in the syntax of an interface within a ``with`` block."""
    interface_before, _Current.interface = _Current.interface, name
    try:
        yield
    finally:
        _Current.interface = interface_before


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
        ``NAME=VALUE`` on the command line, a pair as ``FROM:TO``.

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
    if _Current.interface == "python":
        return f"{name}=" if value is None else f"{name}={value!r}"
    flag = flag_of(name)
    if value is None or value is True:
        return flag
    if value is False:
        return f"--no-{flag.removeprefix('--')}"
    return f"{flag} {_flag_value(value)}"


def setting(name: str) -> str:
    """Return the start of a message on the value of a parameter, such as ``top =`` or ``--top``.

    A name that is not an identifier, such as "delay of u", is a quantity and always followed by ``=``.
    """
    return f"{name} =" if _Current.interface == "python" or not name.isidentifier() else parameter(name)


def choose_text(python: str, command_line: str) -> str:
    """Return the first text if the interface is Python, the second if it is the command line."""
    return python if _Current.interface == "python" else command_line


def layout_parameter(**values: object) -> str:
    """Return a reference to layout options with values.

    Examples are ``layout=dict(decimal='comma')`` in Python and ``--decimal comma`` on the command line.
    """
    if _Current.interface == "python":
        return f"layout=dict({', '.join(f'{name}={value!r}' for name, value in values.items())})"
    return " ".join(parameter(name, value) for name, value in values.items())


def layout_fields(*names: str) -> str:
    """Return a reference to layout options for the start of a sentence, such as ``layout=: skip`` or ``--skip``."""
    if _Current.interface == "python":
        return f"{parameter('layout')}: {' and '.join(names)}"
    return " and ".join(map(parameter, names))


def _flag_value(value: object) -> str:
    """Return the value of a flag as typed on the command line."""
    if isinstance(value, Placeholder):
        return value.upper()
    if isinstance(value, Mapping):
        return " ".join(f"{_flag_value(key)}={_flag_value(item)}" for key, item in value.items())
    if isinstance(value, (tuple, list)):
        return ":".join("" if end is None else _flag_value(end) for end in value)
    return shlex.quote(value) if isinstance(value, str) else repr(value)
