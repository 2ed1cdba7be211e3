"""Checks of arguments: numbers, choices, names, arrays, and suggestions for misspelled names."""

from __future__ import annotations

import difflib
import math
import operator
import os
import re
import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias, TypeGuard, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ftlm.errors import DataError, ModelError
from ftlm.utils.parameters import parameter, setting, type_name
from ftlm.utils.resources import available_memory

#: Environment variable with the default number of threads.
THREADS_VARIABLE = "FTLM_THREADS"
#: NumPy dtype kinds of scalars that are accepted as real numbers; `float` would also convert complex numbers and dates.
_REAL_DTYPE_KINDS = frozenset("fiuO")
#: NumPy dtype kinds of arrays that are accepted as real numbers.
_NUMBER_DTYPE_KINDS = frozenset("fiub")


def short_repr(value: object, max_length: int = 60) -> str:
    """Return the repr of a value, truncated to `max_length` characters; for a long integer, its size in bits."""
    if type(value) is int and value.bit_length() > 3 * max_length:
        # Python refuses to convert a long integer to decimal text.
        return f"an integer of {value.bit_length()} bits"
    try:
        text = repr(value)
    except Exception:
        return f"a {type(value).__name__}"
    return text if len(text) <= max_length else f"{text[:max_length]}…"


def error_text(error: BaseException, max_length: int = 500) -> str:
    """Return the message of another package's exception, truncated to `max_length` characters, encodable in UTF-8."""
    try:
        text = str(error)
    except Exception:
        return "its message cannot be read"
    return (text if len(text) <= max_length else f"{text[:max_length]}…").encode("utf-8", "backslashreplace").decode()


def check_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """Raise ModelError unless a value is one of the strings in `choices`; `name` is the parameter in the message."""
    options = list(choices)
    if not isinstance(value, str) or value not in options:
        raise ModelError(f"{setting(name)} {short_repr(value)} is not known; use {' or '.join(map(repr, options))}")


def is_masked_array(value: object) -> TypeGuard[np.ma.MaskedArray[Any, Any]]:
    """Whether a value is a masked array or a masked element of one."""
    # Masked arrays exist only if numpy.ma is imported, and its import would take a tenth of the time of NumPy's.
    return "numpy.ma" in sys.modules and np.ma.isMaskedArray(value)


def _is_number(value: object) -> bool:
    """Whether a value may be a real number: not text, a boolean, a complex number or a masked value."""
    if isinstance(value, (str, bytes, bytearray, bool, complex)) or is_masked_array(value):
        return False
    return getattr(getattr(value, "dtype", None), "kind", "f") in _REAL_DTYPE_KINDS


def whole_number(value: object) -> int | None:
    """Return an integral value as an int, or None for any other value."""
    if not _is_number(value):
        return None
    try:
        number = int(value)  # type: ignore[call-overload]
        return int(number) if number == value else None
    except (TypeError, ValueError, OverflowError):
        return None


def check_integer(name: str, value: object, low: int, high: int | None = None) -> int:
    """Return a value as an int; raise ModelError unless it is an integer from `low` to `high` (by default 2^62 - 1)."""
    number = whole_number(value)
    if number is None or not low <= number <= ((1 << 62) - 1 if high is None else high):
        limits = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise ModelError(f"{setting(name)} {short_repr(value)} is not a whole number {limits}; give one")
    return number


def check_seed(seed: object) -> int:
    """Return a random seed as an int; raise ModelError for floats, booleans and negative numbers."""
    try:
        number = -1 if isinstance(seed, bool) else operator.index(seed)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if number < 0:
        raise ModelError(f"{setting('seed')} {short_repr(seed)} is not a seed; give an integer of at least 0")
    return number


def check_pulses(m: object, limit: float = 1 << 62) -> int:
    """Return the number of block pulses as an int; raise ModelError unless it is positive and less than `limit`."""
    pulses = whole_number(m)
    if pulses is None or not 1 <= pulses < limit:
        raise ModelError(f"{setting('m')} {m!r} is not a number of pulses; give a whole number, at least 1")
    return pulses


def real_number(name: str, value: object) -> float:
    """Return a real number as a float; it may be infinite or NaN.

    Raises
    ------
    ModelError
        If the value is text, None, a boolean, a complex number, or an integer too large for a float.
    """
    try:
        if not _is_number(value):
            raise TypeError
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise ModelError(f"{setting(name)} {short_repr(value)} is not a number; give one") from None


def frequency_pair(band: Iterable[object]) -> tuple[float, float]:
    """Return the limits of a frequency band [rad/s] as (low, high) floats; raise ModelError unless it is a pair."""
    try:
        low, high = (real_number("band", b) for b in band)
    except (TypeError, ValueError):
        raise ModelError(
            f"{setting('band')} {short_repr(band)} is not a pair of frequencies; give (low, high) in rad/s"
        ) from None
    return low, high


def join_names(names: Iterable[object], max_count: int = 40) -> str:
    """Return quoted names, joined by commas, for a message; names beyond the first `max_count` are only counted."""
    texts = [repr(name) for name in names]
    if not texts:
        return "none"
    return ", ".join(texts[:max_count]) + (f", … and {len(texts) - max_count} more" if len(texts) > max_count else "")


def nearest(word: object, names: Iterable[object], min_similarity: float = 0.5) -> str:
    """Return text such as " (did you mean …?)" with the name most similar to `word`, or "" if none is similar."""
    options = [str(name) for name in names]
    prefixes = [option for option in options if len(option) > 1 and str(word).casefold().startswith(option.casefold())]
    similar_names = prefixes or difflib.get_close_matches(str(word), options, n=1, cutoff=min_similarity)
    return f" (did you mean {max(similar_names, key=len)!r}?)" if similar_names else ""


def bad_rows_error(label: str, problem: str, first: int, count: int, remedy: str) -> DataError:
    """Return a DataError for invalid rows.

    The message states the object, what is wrong, the first invalid row (from 0), the number of such rows and the
    remedy.
    """
    return DataError(f"{label}: {problem}, first at row {first}, {count} in all; {remedy}")


def names_to_columns(argument: str, column_names: object) -> dict[str, Hashable]:
    """Return the column of each signal by name; raise DataError if `column_names` has an invalid type.

    Valid are None, a name, a list of names and a mapping.
    """
    if column_names is None:
        return {}
    if isinstance(column_names, str):
        return {column_names: column_names}
    if isinstance(column_names, Mapping):
        return dict(column_names)
    if not isinstance(column_names, Iterable):
        raise DataError(
            f"{parameter(argument)} is {type_name(column_names)}; pass a dict of name: column, or a list of names"
        )
    names = list(column_names)
    for index, name in enumerate(names):
        if not isinstance(name, str):
            raise DataError(
                f"{parameter(argument)}: entry {index} is {name!r}, not a name; pass a dict of name: column"
            )
        if name in names[:index]:
            raise DataError(f"{parameter(argument)}: the name {name!r} is given twice; give every name once")
    return {name: name for name in names}


def as_mapping(argument: str, value: object, item: str = "array") -> Mapping[str, object]:
    """Return a mapping unchanged; raise DataError for any other value of the argument.

    `item` is the kind of its values in the message.
    """
    if not isinstance(value, Mapping):
        raise DataError(f"{parameter(argument)} is {type_name(value)}; pass a dict of name: {item}")
    return value


def check_known(kind: str, names: Iterable[str], choices: Sequence[str]) -> None:
    """Raise ModelError for a name that is not in `choices`; `kind` is the kind of object in the message."""
    for name in names:
        if name not in choices:
            matches = difflib.get_close_matches(str(name), choices, 1)
            hint = f"did you mean {matches[0]}?" if matches else f"known: {', '.join(dict.fromkeys(choices)) or 'none'}"
            raise ModelError(f"{kind} {name!r} does not occur in the equation; {hint}")


def available_threads() -> int:
    """Return the number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS or Windows
        return os.cpu_count() or 1


def check_threads(threads: int | None) -> int:
    """Return the number of threads to use: the argument, or ``FTLM_THREADS``, or all cores.

    Raises
    ------
    ModelError
        If there are fewer than one or more than 1024 threads, or ``FTLM_THREADS`` is invalid.
    """
    if threads is None:
        text = os.environ.get(THREADS_VARIABLE, "").strip()
        if text and not (text.isascii() and text.isdecimal() and len(text) < 5 and 1 <= int(text) <= 1024):
            raise ModelError(f"{THREADS_VARIABLE}={text!r} is not a number of threads; give 1 to 1024, or leave it out")
        return int(text) if text else available_threads()
    count = whole_number(threads)
    if count is None or not 1 <= count <= 1024:
        raise ModelError(f"{setting('threads')} {threads!r} is outside [1, 1024]; leave it out to use all cores")
    return count


#: Real and complex arrays of double precision.
Floats: TypeAlias = NDArray[np.float64]
Complex: TypeAlias = NDArray[np.complex128]


Scalar = TypeVar("Scalar", bound=np.generic)
#: Maximum length of a sequence, which NumPy reads value by value. Larger arrays are compared with the available memory.
MAX_SEQUENCE_LENGTH = 50_000_000
#: Maximum nesting depth of sequences. In a sequence that contains itself, NumPy would follow every path.
MAX_DIMENSIONS = 16


def as_array(name: str, values: object, *, gaps: bool = False) -> NDArray[Any]:
    """Return an argument of the user as an array of any dtype, possibly a view; `name` is the argument in messages.

    Masked values are missing samples. They become NaN with `gaps`, and raise an error otherwise.

    Raises
    ------
    DataError
        If samples are masked, rows differ in length, or the array does not fit into memory.
    """
    _check_sequence(name, values)
    try:
        if isinstance(values, (list, tuple)) and any(map(is_masked_array, values)):
            # NumPy would use the values under the masks of the items.
            values = np.ma.stack([np.ma.asarray(item) for item in values])
        mask = np.ma.getmaskarray(values) if is_masked_array(values) else None
        array = np.asarray(values)
    except Exception as error:
        raise DataError(
            f"{name} is not an array of numbers ({error_text(error, 200).rstrip('.')}); give rows of equal length"
        ) from error
    if array.size > MAX_SEQUENCE_LENGTH and array.size * 8 > (available_memory() or math.inf):
        raise DataError(f"{name} has shape {array.shape} and does not fit into memory; give fewer values")
    if mask is None or not mask.any():
        return array
    if gaps and array.dtype.kind in _NUMBER_DTYPE_KINDS:
        return np.where(mask, np.nan, array)
    first = int(np.argwhere(np.atleast_1d(mask))[0][0])
    raise bad_rows_error(name, "masked (missing) value", first, int(mask.sum()), "remove or fill these rows yourself")


def _check_sequence(name: str, values: object) -> None:
    """Raise DataError for a sequence with more than 50 million values or 16 levels of nesting."""
    depth, first = 0, values
    while isinstance(first, Sequence) and not isinstance(first, (str, bytes, bytearray, memoryview)):
        try:
            length, item = len(first), first[0] if first else None
        except OverflowError:
            length, item = MAX_SEQUENCE_LENGTH + 1, None
        except Exception as error:
            raise DataError(f"{name} is not an array of numbers ({error_text(error, 200)}); give an array") from error
        if length > MAX_SEQUENCE_LENGTH or depth > MAX_DIMENSIONS:
            size = f"{MAX_SEQUENCE_LENGTH} values" if length > MAX_SEQUENCE_LENGTH else f"{MAX_DIMENSIONS} dimensions"
            raise DataError(f"{name} is not an array of numbers, but a sequence of more than {size}; give an array")
        if not length:
            return
        depth, first = depth + 1, item


def check_vector(name: str, array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a vector unchanged; raise DataError if it is empty or not one-dimensional."""
    if array.ndim != 1 or not array.size:
        raise DataError(f"{name} has shape {array.shape}; give a vector of at least one number")
    return array


def as_floats(name: str, values: object, *, gaps: bool = False) -> NDArray[np.float64]:
    """Return a float64 array of real numbers, possibly a view of the argument; see :func:`as_array`.

    Raises
    ------
    DataError
        If the values are text, objects or complex numbers, or in the cases of :func:`as_array`.
    """
    array = as_array(name, values, gaps=gaps)
    if array.dtype.kind not in _NUMBER_DTYPE_KINDS:
        raise DataError(f"{name} has {array.dtype} values; give real numbers")
    with np.errstate(over="ignore"):
        return np.asarray(array, dtype=np.float64, order="C")


def as_complex(name: str, values: object) -> NDArray[np.complex128]:
    """Return a complex128 array of real or complex numbers; see :func:`as_array`.

    Raises
    ------
    DataError
        If the values are text or objects, or in the cases of :func:`as_array`.
    """
    array = as_array(name, values)
    if array.dtype.kind not in _NUMBER_DTYPE_KINDS | {"c"}:
        raise DataError(f"{name} has {array.dtype} values; give numbers")
    with np.errstate(over="ignore"):
        return np.asarray(array, dtype=np.complex128, order="C")


def finite_floats(name: str, values: object) -> NDArray[np.float64]:
    """Return a float64 array of finite real numbers.

    Raises
    ------
    DataError
        If values are not finite (the message has the first index and their number), or as in :func:`as_floats`.
    """
    array = as_floats(name, values)
    if not np.isfinite(array).all():
        if array.ndim == 0:
            raise DataError(f"{setting(name)} {array} is not finite; give a finite number")
        bad = np.argwhere(~np.isfinite(array))
        index = bad[0].tolist() if array.ndim > 1 else int(bad[0, 0])
        raise DataError(
            f"{name} is not finite at index {index} ({len(bad)} such values in all); remove or replace them"
        )
    return array


def apply_along_axis(x: ArrayLike, axis: int, function: Callable[[Floats], Floats]) -> Floats:
    """Return the result of `function` along one axis of an array, in the shape of the array; messages call the array x.

    `function` maps a matrix to a matrix of the same shape, row by row. Raise DataError for values that are not finite,
    an empty array or an unknown axis.
    """
    array = finite_floats("x", x)
    if array.ndim == 0 or not -array.ndim <= axis < array.ndim:
        raise DataError(f"x has {array.ndim} dimensions and no axis {axis}; give an array and one of its axes")
    samples = np.moveaxis(array, axis, -1)
    if samples.shape[-1] == 0:
        raise DataError(f"x has shape {array.shape} and no values; give at least one")
    rows = np.ascontiguousarray(samples.reshape(-1, samples.shape[-1]))
    return np.moveaxis(function(rows).reshape(samples.shape), -1, axis)


CSV_TIME = "t_s"
_NAME_LENGTH = 200
_SIGNAL_NAME = re.compile(r"[^\W\d][\w.\[\]]*")


def is_run_name(name: object) -> bool:
    """Whether an object is a run name: 1 to 200 printable characters that do not begin with = + - or @."""
    return isinstance(name, str) and 0 < len(name) <= _NAME_LENGTH and name.isprintable() and name[0] not in "=+-@"


def check_run_name(name: object) -> None:
    """Raise DataError if a run name cannot be written to every file format."""
    if not is_run_name(name):
        raise DataError(
            f"{parameter('name', name)} cannot name a run; use 1 to {_NAME_LENGTH} printable characters, not "
            "beginning with = + - @"
        )


def check_signal_name(name: object) -> None:
    """Raise DataError if a signal name cannot be a column name or part of an equation."""
    if not isinstance(name, str) or len(name) > _NAME_LENGTH or not _SIGNAL_NAME.fullmatch(name):
        raise DataError(
            f"{name!r} cannot name a signal; begin with a letter or _ and use letters, digits, _ . [ ] "
            f"(at most {_NAME_LENGTH})"
        )
    if name == CSV_TIME:
        raise DataError(f"{name!r} is the name of the time in csv files; give the signal another name")
