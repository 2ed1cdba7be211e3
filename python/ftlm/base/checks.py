"""Refuses arguments that are not what they should be, and finds the words for it."""

from __future__ import annotations

import difflib
import operator
import os
from collections.abc import Hashable, Iterable, Mapping, Sequence

from ftlm.base.errors import DataError, ModelError

#: Environment variable that gives the threads of what does not say its own.
THREADS = "FTLM_THREADS"
#: Kinds of NumPy's numbers that a real number may be; `float` of others drops their imaginary part, or counts days.
_REAL = frozenset("fiuO")


def shown(value: object, most: int = 60) -> str:
    """Return a value as an error message shows it, whatever it is: cut off, and long integers by their length."""
    if type(value) is int and value.bit_length() > 3 * most:
        # A long integer has no decimal form in Python.
        return f"an integer of {value.bit_length()} bits"
    try:
        text = repr(value)
    except Exception:
        return f"a {type(value).__name__}"
    return text if len(text) <= most else f"{text[:most]}…"


def words_of(error: BaseException, most: int = 500) -> str:
    """Return what an error of somebody else's says: cut off, in characters that a file can hold."""
    try:
        text = str(error)
    except Exception:
        return "what it says cannot be read"
    return (text if len(text) <= most else f"{text[:most]}…").encode("utf-8", "backslashreplace").decode()


def check_choice(name: str, value: object, known: Iterable[str]) -> None:
    """Refuse anything but one of some words."""
    words = list(known)
    if not isinstance(value, str) or value not in words:
        raise ModelError(f"{name} = {shown(value)} is not known; use {' or '.join(map(repr, words))}")


def _is_number(value: object) -> bool:
    """Whether a value may be a real number; a complex one is none, whatever its imaginary part."""
    if isinstance(value, (str, bytes, bytearray, bool, complex)):
        return False
    return getattr(getattr(value, "dtype", None), "kind", "f") in _REAL


def whole_number(value: object) -> int | None:
    """Return a value that is a whole number as an int, anything else as None; the message is the caller's."""
    if not _is_number(value):
        return None
    try:
        number = int(value)  # type: ignore[call-overload]
        return int(number) if number == value else None
    except (TypeError, ValueError, OverflowError):
        return None


def check_seed(seed: object) -> int:
    """Return the seed of random numbers as an int: any integer, NumPy's too, and neither a truth value nor 3.0."""
    try:
        number = -1 if isinstance(seed, bool) else operator.index(seed)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if number < 0:
        raise ModelError(f"seed = {shown(seed)} is not a whole number from 0")
    return number


def check_pulses(m: object, below: float = 1 << 62) -> int:
    """Return a number of block pulses, of which the core counts fewer than 2^62."""
    pulses = whole_number(m)
    if pulses is None or not 1 <= pulses < below:
        raise ModelError(f"m = {m!r} is no number of pulses; give a whole number, at least 1")
    return pulses


def real_number(name: str, value: object) -> float:
    """Return a real number as a float; it may be infinite or not a number, which is for the caller to judge.

    Raises
    ------
    ModelError
        Text, nothing, a truth value, a complex number, or an integer beyond the range of floating point.
    """
    try:
        if not _is_number(value):
            raise TypeError
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise ModelError(f"{name} = {shown(value)} is not a number; give one") from None


def listed(names: Iterable[object], most: int = 40) -> str:
    """Return names for an error message: quoted, joined, and cut off after `most` of them."""
    every = [repr(name) for name in names]
    if not every:
        return "none"
    return ", ".join(every[:most]) + (f", … and {len(every) - most} more" if len(every) > most else "")


def nearest(word: object, names: Iterable[object]) -> str:
    """Return " (did you mean …?)" for the closest of names, or an empty string."""
    options = [str(name) for name in names]
    begun = [option for option in options if len(option) > 1 and str(word).casefold().startswith(option.casefold())]
    close = [max(begun, key=len)] if begun else difflib.get_close_matches(str(word), options, n=1, cutoff=0.5)
    return f" (did you mean {close[0]!r}?)" if close else ""


def bad_rows(thing: str, what: str, first: int, count: int, way_out: str) -> DataError:
    """Return the error for bad rows: the thing, the first 0-based row, the count and the way out."""
    return DataError(f"{thing}: {what}, first at row {first}, {count} in all; {way_out}")


def names_to_columns(argument: str, given: object) -> dict[str, Hashable]:
    """Return {signal: column} for what a person gave: nothing, one name, a list of names or a mapping."""
    if given is None:
        return {}
    if isinstance(given, str):
        return {given: given}
    if isinstance(given, Mapping):
        return dict(given)
    if not isinstance(given, Iterable):
        raise DataError(f"{argument}= is a {type(given).__name__}; pass a dict of name: column, or a list of names")
    names = list(given)
    for index, name in enumerate(names):
        if not isinstance(name, str):
            raise DataError(f"{argument}=: entry {index} is {name!r}, not a name; pass a dict of name: column")
        if name in names[:index]:
            raise DataError(f"{argument}=: the name {name!r} is given twice; give every name once")
    return {name: name for name in names}


def as_mapping(argument: str, given: object, of: str = "array") -> Mapping[str, object]:
    """Return a mapping by name as it is, and refuse anything else."""
    if not isinstance(given, Mapping):
        raise DataError(f"{argument}= is a {type(given).__name__}; pass a dict of name: {of}")
    return given


def check_known(what: str, given: Iterable[str], known: Sequence[str]) -> None:
    """Refuse a name that does not occur in an equation."""
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(dict.fromkeys(known)) or 'none'}"
            raise ModelError(f"{what} {name!r} does not occur in the equation; {hint}")


def available_threads() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS or Windows
        return os.cpu_count() or 1


def check_threads(threads: int | None) -> int:
    """Threads to use: by default what ``FTLM_THREADS`` gives, else all cores.

    Raises
    ------
    ModelError
        Fewer than one or more than 1 024, or ``FTLM_THREADS`` is no such number.
    """
    if threads is None:
        given = os.environ.get(THREADS, "").strip()
        if given and not (given.isascii() and given.isdecimal() and len(given) < 5 and 1 <= int(given) <= 1024):
            raise ModelError(f"{THREADS}={given!r} is no number of threads; give 1 to 1024, or leave it out")
        return int(given) if given else available_threads()
    count = whole_number(threads)
    if count is None or not 1 <= count <= 1024:
        raise ModelError(f"threads = {threads!r} is outside [1, 1024]; leave it out to use all cores")
    return count
