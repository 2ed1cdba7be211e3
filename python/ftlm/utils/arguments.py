"""Decorator that replaces exceptions from arguments of a wrong type by messages with actual and expected type."""

from __future__ import annotations

import builtins
import difflib
import functools
import inspect
import math
import os
import re
import sys
import types
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, Literal, Protocol, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

from ftlm.errors import FtlmError, ModelError
from ftlm.utils.parameters import parameter, setting, type_name
from ftlm.utils.validation import MAX_SEQUENCE_LENGTH, real_number, short_repr, whole_number

#: Exceptions that an argument of a wrong type can cause.
_FROM_ARGUMENTS = (TypeError, AttributeError, LookupError, ArithmeticError, RecursionError)

#: Folder names in the paths of installed packages.
_PACKAGE_FOLDERS = ("site-packages", "dist-packages")

Decorated = TypeVar("Decorated", bound=Callable[..., Any])

#: Operators whose arguments are checked like those of public methods.
_CHECKED_OPERATORS = ("__call__", "__contains__", "__getitem__")
#: Annotated list types, for which iterables of matching items are accepted, except bytes, mappings and arrays.
_LIST_TYPES = (Sequence, Iterable, Collection, tuple, list)
#: Names of types in messages.
_KIND_WORDS: dict[Any, str] = {
    float: "a finite number",
    complex: "a number",
    int: "a whole number",
    bool: "True or False",
    str: "text",
    Mapping: "a mapping of names",
    Callable: "a function",
    os.PathLike: "a path",
    types.NoneType: "None",
    tuple: "a tuple",
    **dict.fromkeys((Sequence, Iterable, Collection, list), "a list"),
}
#: Public functions and classes that construct an argument, by the name of the argument.
_ARGUMENT_CONSTRUCTORS = {
    "structure": ("equation", "flexible_link"),
    "equation": ("equation", "flexible_link"),
    "method": ("OutputError", "MultiInnovation", "InstrumentalVariables", "LeastSquares", "GeneticAlgorithm"),
}
#: Maximum number of items of a mapping or list whose types are checked.
_MAX_CHECKED_ITEMS = 1000
#: Magnitude from which a number counts as a wrong argument after a failure.
_MAX_NUMBER = 2.0**62


def check_arguments(decorated: Decorated) -> Decorated:
    """Decorate a function so that an exception caused by an argument of a wrong type becomes a ModelError.

    For a class, the constructor, the public methods and the operators in `_CHECKED_OPERATORS` are decorated. Arguments
    are compared with their annotations only after a call has failed, so successful calls take no additional time. Other
    errors of ftlm, and exceptions from code of the user, are not changed. A Python ``range`` with more than 50 million
    values is rejected before the call.
    """
    if inspect.isclass(decorated):
        type.__setattr__(decorated, "__init__", check_arguments(decorated.__init__))
        for name, member in list(vars(decorated).items()):
            if name.startswith("_") and name not in _CHECKED_OPERATORS:
                continue
            if inspect.isfunction(member):
                type.__setattr__(decorated, name, check_arguments(member))
            elif isinstance(member, classmethod):
                type.__setattr__(decorated, name, classmethod(check_arguments(member.__func__)))
        return decorated

    @functools.wraps(decorated)
    def call_function(*args: Any, **kwargs: Any) -> Any:
        for value in (*args, *kwargs.values()):
            if isinstance(value, range):
                _check_range(decorated, args, kwargs)
        try:
            return decorated(*args, **kwargs)
        except Exception as error:
            # An error of an inner decorated function names its own argument; the caller needs the argument of this one.
            cause = error.__cause__ if isinstance(error, FtlmError) else error
            is_foreign = cause is error or isinstance(cause, _FROM_ARGUMENTS)
            if is_foreign and cause is not None and not _is_raised_by_caller(cause):
                _raise_type_error(decorated, args, kwargs, error)
            raise

    return cast("Decorated", call_function)


def warn_caller(message: str) -> None:
    """Issue a UserWarning that shows the line of the user's code which called ftlm."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and str(frame.f_globals.get("__name__")).partition(".")[0] == "ftlm":
        frame, level = frame.f_back, level + 1
    warnings.warn(message, UserWarning, stacklevel=level)


def _check_range(function: Callable[..., Any], args: Any, kwargs: Any) -> None:
    """Raise ModelError for the first argument that is a range with more than `MAX_SEQUENCE_LENGTH` values."""
    for name, value in inspect.signature(function).bind_partial(*args, **kwargs).arguments.items():
        if isinstance(value, range) and value and abs((value[-1] - value[0]) // value.step) >= MAX_SEQUENCE_LENGTH:
            raise ModelError(
                f"{setting(name)} {short_repr(value)} has more than {MAX_SEQUENCE_LENGTH} values; give fewer"
            )


def _is_raised_by_caller(error: BaseException) -> bool:
    """Whether an exception comes from code of the user that ftlm called, such as a callback or a controller."""
    trace = error.__traceback__
    while trace is not None:
        package = str(trace.tb_frame.f_globals.get("__name__")).partition(".")[0]
        file = trace.tb_frame.f_code.co_filename
        if package not in ("ftlm", *sys.stdlib_module_names) and not any(f in file for f in _PACKAGE_FOLDERS):
            return True
        trace = trace.tb_next
    return False


def _unknown_keyword_hint(unknown: str, names: Sequence[str], arguments: Mapping[str, Any]) -> str:
    """Return a hint for an unknown keyword: where it belongs, a similar keyword, or the known keywords.

    `names` are the known keywords, and `arguments` the arguments with known keywords.
    """
    for argument in [n for n in names if n in _ARGUMENT_CONSTRUCTORS]:
        functions = [
            f"ftlm.{function}(…, {unknown}=…)"
            for function in _ARGUMENT_CONSTRUCTORS[argument]
            if unknown in inspect.signature(getattr(sys.modules["ftlm"], function)).parameters
        ]
        if functions:
            return f"it is an argument of {argument}={' or '.join(functions)}"
    for argument in [n for n in arguments if "equation" in _ARGUMENT_CONSTRUCTORS.get(n, ())]:
        if re.search(rf"\b{re.escape(unknown)}\b", str(arguments[argument])):
            return (
                f"{unknown} is in the equation: write its value there, or give it to ftlm.equation by "
                f"{parameter('orders')} or {parameter('fixed')}"
            )
    match = difflib.get_close_matches(unknown, names, 1)
    known = ", ".join(n for n in names if n not in ("self", "cls"))
    return f"did you mean {match[0]}=?" if match else f"known: {known}"


def _raise_unknown_keyword(
    signature: inspect.Signature, args: Any, kwargs: Mapping[str, Any], error: Exception
) -> None:
    """Raise TypeError with a hint if a given keyword is not a parameter of the function."""
    names = [n for n, p in signature.parameters.items() if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    takes_any = any(p.kind == p.VAR_KEYWORD for p in signature.parameters.values())
    unknown = next((name for name in kwargs if name not in names), None)
    if unknown is not None and not takes_any:
        known_arguments = {**dict(zip(names, args, strict=False)), **{n: v for n, v in kwargs.items() if n in names}}
        raise TypeError(f"{error}; {_unknown_keyword_hint(unknown, names, known_arguments)}") from None


def _raise_type_error(function: Callable[..., Any], args: Any, kwargs: Any, error: Exception) -> None:
    """Raise ModelError for the first argument that does not match its annotation; return if all arguments match.

    Raise TypeError for an unknown keyword.
    """
    signature = inspect.signature(function)
    try:
        bound = signature.bind(*args, **kwargs)
    except TypeError:
        _raise_unknown_keyword(signature, args, kwargs, error)
        return
    names = _Names(getattr(inspect.unwrap(function), "__globals__", {}))
    for name, value in bound.arguments.items():
        annotation = _annotation(signature.parameters[name].annotation, names)
        is_single = signature.parameters[name].kind not in (
            inspect.Parameter.VAR_POSITIONAL,
            inspect.Parameter.VAR_KEYWORD,
        )
        if is_single and not _fits(value, annotation):
            types_text = " or ".join(dict.fromkeys(_describe_type(kind) for kind in _alternatives(annotation)))
            raise ModelError(f"{setting(name)} {short_repr(value)} is {type_name(value)}; give {types_text}") from error


class _UnknownType:
    """Placeholder for a type that is imported only for type checkers; it matches every value."""

    def __class_getitem__(cls, item: object) -> type[_UnknownType]:
        return cls


class _Names(dict[str, Any]):
    """Mapping from names of a module, builtins and public names of ftlm to objects; other names are unknown types."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, None) or getattr(sys.modules.get("ftlm"), name, _UnknownType)


def _annotation(annotation: Any, names: _Names) -> Any:
    """Return the type that the text of an annotation denotes; `_UnknownType` if there is no annotation."""
    owner = types.SimpleNamespace(__annotations__={"value": annotation})
    return _UnknownType if annotation is inspect.Parameter.empty else get_type_hints(owner, {}, names)["value"]


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    """Return the member types of a union, or the type itself."""
    if get_origin(annotation) in (Union, types.UnionType):
        return tuple(kind for member in get_args(annotation) for kind in _alternatives(member))
    return (annotation,)


def _describe_type(kind: Any) -> str:
    """Return the name of a type that is not a union, as used in messages."""
    if get_origin(kind) is Literal:
        return ", ".join(map(repr, get_args(kind)))
    kind = get_origin(kind) or kind
    return _KIND_WORDS.get(kind, getattr(kind, "__name__", repr(kind)))


def _fits(value: object, annotation: Any) -> bool:
    """Whether a value matches an annotation; True for annotations that cannot be checked."""
    return any(_fits_one(value, kind) for kind in _alternatives(annotation))


def _fits_one(value: object, kind: Any) -> bool:
    origin, inner = get_origin(kind) or kind, get_args(kind)
    if origin in (None, types.NoneType):
        return value is None
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in inner)
    if origin in (float, complex):
        return (origin is complex and isinstance(value, complex)) or (type(value) in (int, float) and _is_real(value))
    if origin is int:
        return whole_number(value) is not None and _is_real(value)
    if not isinstance(origin, type) or origin in (Any, _UnknownType) or Protocol in origin.__mro__:
        return True
    if issubclass(origin, Mapping):
        items = list(value.items())[:_MAX_CHECKED_ITEMS] if isinstance(value, Mapping) else None
        key, item = inner or (Any, Any)
        return items is not None and all(_fits(k, key) and _fits(v, item) for k, v in items)
    if origin in _LIST_TYPES:
        if isinstance(value, (bytes, Mapping, np.ndarray)) or not isinstance(value, Iterable):
            return False
        if origin is tuple and inner and Ellipsis not in inner:
            return isinstance(value, (list, tuple)) and len(value) == len(inner) and all(map(_fits, value, inner))
        member = inner[0] if inner else Any
        if isinstance(value, str):
            return _fits(value, member)
        return not isinstance(value, (list, tuple)) or all(_fits(v, member) for v in value[:_MAX_CHECKED_ITEMS])
    return isinstance(value, origin)


def _is_real(value: object) -> bool:
    try:
        return math.isfinite(real_number("value", value)) and abs(real_number("value", value)) < _MAX_NUMBER
    except ModelError:
        return False
