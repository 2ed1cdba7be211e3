"""The public functions and methods of ftlm, each once, by name."""

import importlib
import inspect

import ftlm

#: Special methods that take arguments of the caller.
SPECIAL_METHODS = {"__call__", "__getitem__", "__contains__", "__init__"}


def modules():
    """Public modules by name, the package itself first."""
    return {"ftlm": ftlm, **{name: importlib.import_module(f"ftlm.{name}") for name in sorted(ftlm._PUBLIC_MODULES)}}


def functions():
    """Functions by name, and methods of classes by that of their class, such as ``ftlm.Run.select``."""
    names = {}
    for owner, module in modules().items():
        own = [n for n, v in vars(module).items() if n[0] != "_" and getattr(v, "__module__", "") == module.__name__]
        for name in getattr(module, "__all__", own):
            value = getattr(module, name)
            if inspect.isfunction(value):
                names.setdefault(value, f"{owner}.{name}")
            elif inspect.isclass(value):
                for key, attribute in vars(value).items():
                    method = getattr(attribute, "__func__", attribute)
                    if inspect.isfunction(method) and (key[0] != "_" or key in SPECIAL_METHODS):
                        names.setdefault(method, f"{owner}.{name}.{key}")
    return {name: function for function, name in names.items()}
