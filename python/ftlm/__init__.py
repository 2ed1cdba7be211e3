"""Fractional-order models of flexible machines from measured data.

Public names are those of ``__init__.pyi``. Each is imported on first use, because importing all of them takes longer
than NumPy.
"""

import ast as _ast
import importlib as _importlib
from pathlib import Path as _Path

#: Module that defines each public name; "" for a name that is itself a public module.
_MODULE_BY_NAME = {
    alias.name: (node.module or "").removeprefix("ftlm").removeprefix(".")
    for node in _ast.parse(_Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, _ast.ImportFrom)
    for alias in node.names
}
#: Public modules that are attributes of the package.
_PUBLIC_MODULES = frozenset(name for name, module in _MODULE_BY_NAME.items() if not module)

__all__ = list(
    sorted(
        {*_MODULE_BY_NAME} - _PUBLIC_MODULES | {"rig"},
        key=lambda name: (not name.isupper(), not name[0].isupper(), name),
    )
)


def __getattr__(name: str) -> object:
    """Import the public object or module `name`, such as `ftlm.rig`, on first use, and return it.

    Raise AttributeError for other names.
    """
    if name not in _MODULE_BY_NAME:
        raise AttributeError(f"module 'ftlm' has no attribute {name!r}")
    module = _MODULE_BY_NAME[name]
    value: object = _importlib.import_module(f"ftlm.{module or name}")
    if module:
        value = getattr(value, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return all names of the package, including public names that are not imported yet."""
    return sorted({*globals(), *_MODULE_BY_NAME})
