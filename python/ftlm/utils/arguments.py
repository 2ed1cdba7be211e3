"""Errors of wrong arguments in words: what an argument is, and what its annotation says that it should be."""

from __future__ import annotations

import functools
import inspect
import math
import os
import sys
import sysconfig
from collections.abc import Callable, Hashable, Iterable, Mapping
from typing import Any, Protocol, TypeVar, cast

import numpy as np

from ftlm.errors import FtlmError, ModelError
from ftlm.utils.parameters import setting
from ftlm.utils.validation import MAX_SEQUENCE_LENGTH, real_number, short_repr, whole_number

#: Exceptions that arguments of another type cause.
_FROM_ARGUMENTS = (TypeError, AttributeError, LookupError, ArithmeticError, RecursionError)

#: Folders of Python and of its packages.
_LIBRARY_FOLDERS = tuple(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))

Decorated = TypeVar("Decorated", bound=Callable[..., Any])

#: Annotations of arguments that are checked by their text, and what they are called in messages.
_KIND_WORDS = {
    "float": "a finite number",
    "complex": "a number",
    "int": "a whole number",
    "bool": "True or False",
    "str": "text",
    "Mapping": "a mapping of names",
    "Sequence": "a list",
    "Iterable": "a list",
    "Collection": "a list",
    "tuple": "a tuple",
    "list": "a list",
    "Callable": "a function",
    "os.PathLike": "a path",
    "None": "None",
}
#: Items of a mapping or a list that are checked.
_MAX_CHECKED_ITEMS = 1000
#: Size from which a number is named as the cause of a failure.
_MAX_NUMBER = 2.0**62


def check_arguments(decorated: Decorated) -> Decorated:
    """Decorate a function or a class: an exception that a wrong argument causes becomes a :class:`ModelError`.

    The arguments are compared with their annotations only after the call failed, so that a call that succeeds costs
    nothing. Messages that the function raises itself are kept. A range with too many values is refused before the call.
    """
    if inspect.isclass(decorated):
        type.__setattr__(decorated, "__init__", check_arguments(decorated.__init__))
        return decorated

    @functools.wraps(decorated)
    def call_function(*given: Any, **named: Any) -> Any:
        for value in (*given, *named.values()):
            if isinstance(value, range):
                _check_range(decorated, given, named)
        try:
            return decorated(*given, **named)
        except Exception as error:
            # A decorated function below names its own argument, and the caller knows the one of this function.
            cause = error.__cause__ if isinstance(error, FtlmError) else error
            foreign = cause is error or isinstance(cause, _FROM_ARGUMENTS)
            if foreign and cause is not None and not _is_raised_by_caller(cause):
                _raise_in_words(decorated, given, named, error)
            raise

    return cast("Decorated", call_function)


def _check_range(function: Callable[..., Any], given: Any, named: Any) -> None:
    """Raise for the first argument that is a range with more values than can be read."""
    for name, value in inspect.signature(function).bind_partial(*given, **named).arguments.items():
        if isinstance(value, range) and value and abs((value[-1] - value[0]) // value.step) >= MAX_SEQUENCE_LENGTH:
            raise ModelError(
                f"{setting(name)} {short_repr(value)} has more than {MAX_SEQUENCE_LENGTH} values; give fewer"
            )


def _is_raised_by_caller(error: BaseException) -> bool:
    """Whether an exception comes from code of the caller that ftlm called: a callback, a controller, a board."""
    trace = error.__traceback__
    while trace is not None:
        package = str(trace.tb_frame.f_globals.get("__name__")).partition(".")[0]
        if package != "ftlm" and not trace.tb_frame.f_code.co_filename.startswith(_LIBRARY_FOLDERS):
            return True
        trace = trace.tb_next
    return False


def _raise_in_words(function: Callable[..., Any], given: Any, named: Any, error: Exception) -> None:
    """Raise for the first argument that is not what its annotation says."""
    signature = inspect.signature(function)
    try:
        bound = signature.bind(*given, **named)
    except TypeError:
        return
    for name, value in bound.arguments.items():
        annotation = signature.parameters[name].annotation
        kinds = _alternatives(annotation) if isinstance(annotation, str) else []
        scope = getattr(inspect.unwrap(function), "__globals__", {})
        if kinds and not any(_fits(value, kind, scope) for kind in kinds):
            words = " or ".join(dict.fromkeys(_KIND_WORDS.get(k.partition("[")[0], k) for k in kinds))
            raise ModelError(
                f"{setting(name)} {short_repr(value)} is a {type(value).__name__}; give {words}"
            ) from error


def _alternatives(annotation: str) -> list[str]:
    """Return the members of a union."""
    found, depth = [""], 0
    for sign in annotation:
        depth += (sign == "[") - (sign == "]")
        if sign == "|" and depth == 0:
            found.append("")
        else:
            found[-1] += sign
    return [part.strip() for part in found]


def _fits(value: object, kind: str, scope: Mapping[str, Any]) -> bool:
    """Whether a value is what an annotation without alternatives says; True for annotations that are not known.

    ``scope`` holds the names of the module; a class is known if it is one of them or public, and no protocol.
    """
    name, _, inner = kind.partition("[")
    inner = inner.removesuffix("]")
    if name == "None":
        return value is None
    if name == "bool":
        return isinstance(value, bool)
    if name == "str":
        return isinstance(value, str)
    if name == "os.PathLike":
        return isinstance(value, os.PathLike)
    if name in ("float", "complex"):
        return (name == "complex" and isinstance(value, complex)) or (type(value) in (int, float) and _is_real(value))
    if name == "int":
        return whole_number(value) is not None and _is_real(value)
    if name == "Hashable":
        return isinstance(value, Hashable)
    if name == "Literal":
        return isinstance(value, str)
    if name == "Mapping":
        key, _, of = inner.partition(", ")
        items = list(value.items())[:_MAX_CHECKED_ITEMS] if isinstance(value, Mapping) else None
        return items is not None and all(_fits_any(k, key, scope) and _fits_any(v, of, scope) for k, v in items)
    if name == "Callable":
        return callable(value)
    if name in ("Sequence", "Iterable", "Collection", "tuple", "list"):
        if isinstance(value, (bytes, Mapping, np.ndarray)) or not isinstance(value, Iterable):
            return False
        members = inner.removesuffix(", ...").split(", ") if name == "tuple" else [inner]
        same = len(set(members)) == 1
        if isinstance(value, str):
            return _fits_any(value, members[0], scope)
        return not (same and isinstance(value, (list, tuple))) or all(
            _fits_any(v, members[0], scope) for v in value[:_MAX_CHECKED_ITEMS]
        )
    known = scope.get(name, getattr(sys.modules.get("ftlm"), name, None))
    return not isinstance(known, type) or Protocol in known.__mro__ or isinstance(value, known)


def _fits_any(value: object, annotation: str, scope: Mapping[str, Any]) -> bool:
    return not annotation or any(_fits(value, kind, scope) for kind in _alternatives(annotation))


def _is_real(value: object) -> bool:
    try:
        return math.isfinite(real_number("value", value)) and abs(real_number("value", value)) < _MAX_NUMBER
    except ModelError:
        return False
