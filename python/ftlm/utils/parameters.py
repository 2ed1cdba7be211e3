"""References to parameters in messages, in the form of the interface in use: Python or the command line.

The interface is one for the whole process, so that every thread builds its messages alike. A process that another one
starts passes on :func:`current_interface`.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Literal

Interface = Literal["python", "command line"]
#: Flags that are not the name of the parameter with dashes. An order grid has two flags.
FLAG_BY_PARAMETER = {"inputs": "-u", "outputs": "-y", "order_grid": "--order-grid or --increment"}


class _Current:
    """Interface in use."""

    interface: Interface = "python"


class Placeholder(str):
    """Word in a message that stands for a value, such as ``UNIT``; it is shown without quotes."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


#: Columns of a file by name of a signal, and by part of a frequency response.
NAMED_COLUMNS = {Placeholder("name"): Placeholder("column")}
PART_COLUMNS = {Placeholder("part"): Placeholder("column")}


def current_interface() -> Interface:
    """Return the interface that messages are made for."""
    return _Current.interface


@contextmanager
def use_interface(name: Interface) -> Iterator[None]:
    """Make messages for an interface within a block."""
    interface_before, _Current.interface = _Current.interface, name
    try:
        yield
    finally:
        _Current.interface = interface_before


def flag_of(name: str) -> str:
    """Return the flag of a parameter on the command line."""
    return FLAG_BY_PARAMETER.get(name, f"--{name.replace('_', '-')}")


def parameter(name: str, value: object = None) -> str:
    """Reference to a parameter, alone or with a value.

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
    """Start of a sentence on the value of a parameter: ``top =``, or ``--top``; other names are quantities."""
    return f"{name} =" if _Current.interface == "python" or not name.isidentifier() else parameter(name)


def choose_text(python: str, command_line: str) -> str:
    """Return the first text in Python and the second on the command line."""
    return python if _Current.interface == "python" else command_line


def layout_parameter(**values: object) -> str:
    """Reference to fields of a file's layout with values: ``layout=dict(decimal='comma')``, or ``--decimal comma``."""
    if _Current.interface == "python":
        return f"layout=dict({', '.join(f'{name}={value!r}' for name, value in values.items())})"
    return " ".join(parameter(name, value) for name, value in values.items())


def layout_fields(*names: str) -> str:
    """Reference to fields of a file's layout to start a sentence: ``layout=: skip``, or ``--skip``."""
    if _Current.interface == "python":
        return f"{parameter('layout')}: {' and '.join(names)}"
    return " and ".join(map(parameter, names))


def _flag_value(value: object) -> str:
    """Value of a flag as it is typed."""
    if isinstance(value, Placeholder):
        return value.upper()
    if isinstance(value, Mapping):
        return " ".join(f"{_flag_value(key)}={_flag_value(item)}" for key, item in value.items())
    if isinstance(value, (tuple, list)):
        return ":".join("" if end is None else _flag_value(end) for end in value)
    return shlex.quote(value) if isinstance(value, str) else repr(value)
