"""Names that runs and signals may have."""

from __future__ import annotations

import re

from ftlm.base.errors import DataError

CSV_TIME = "t_s"
_NAME_LENGTH = 200
_SIGNAL_NAME = re.compile(r"[^\W\d][\w.\[\]]*")


def is_run_name(name: object) -> bool:
    """Return whether a run may be called this."""
    return isinstance(name, str) and 0 < len(name) <= _NAME_LENGTH and name.isprintable() and name[0] not in "=+-@"


def check_run_name(name: object) -> None:
    """Refuse what cannot be written into any file as the name of a run."""
    if not is_run_name(name):
        raise DataError(
            f"name={name!r} cannot name a run; use 1 to {_NAME_LENGTH} printable characters, not beginning with = + - @"
        )


def check_signal_name(name: object) -> None:
    """Refuse what cannot be the name of a column or stand in an equation."""
    if not isinstance(name, str) or len(name) > _NAME_LENGTH or not _SIGNAL_NAME.fullmatch(name):
        raise DataError(
            f"{name!r} cannot name a signal; begin with a letter or _ and use letters, digits, _ . [ ] "
            f"(at most {_NAME_LENGTH})"
        )
    if name == CSV_TIME:
        raise DataError(f"{name!r} is the name of the time in csv files; give the signal another name")
