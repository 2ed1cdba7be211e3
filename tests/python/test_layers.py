"""Import rules of the package: folders in layers, and late imports in the modules of the central classes alone."""

import ast
import re
from pathlib import Path

import pytest

import ftlm

PACKAGE = Path(ftlm.__file__).parent

#: Bottom to top. A module imports its own folder and the folders below; folders of one layer do not import each other.
LAYERS = (
    {"errors", "_core", "_version"},
    {"utils"},
    {"progress", "findings"},
    {"svg", "structure", "fractional_calculus"},
    {"data", "kernels"},
    {"io", "model"},
    {"simulation", "arm"},
    {"analysis", "validation", "order_search"},
    {"estimation", "control"},
    {"structure_selection", "experiment_design", "rig", "sklearn"},
    {"plot"},
    {"report"},
    {"reproduction", "app"},
    {"cli"},
    {"__main__"},
)
LAYER_OF = {folder: number for number, folders in enumerate(LAYERS) for folder in folders}
#: Modules of the classes that people hold: their methods import the verb that they call, from a layer above.
CENTRAL_MODULES = {"data/run.py", "model/model.py", "estimation/result.py", "estimation/frequency_result.py"}
IMPORTERS = {"import_module", "importlib.import_module", "__import__"}


def imports_of(tree, path):
    """Modules of the package that a file imports: (dotted name below ftlm, line, whether inside a function)."""
    found = []
    package = ("ftlm", *path.parts[:-1])

    def walk(node, late):
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
                continue
            names = []
            if isinstance(child, ast.ImportFrom):
                base = package[: len(package) + 1 - child.level] if child.level else ()
                home = ".".join([*base, *([child.module] if child.module else [])])
                names = [f"{home}.{alias.name}" for alias in child.names]
            elif isinstance(child, ast.Import):
                names = [alias.name for alias in child.names]
            elif isinstance(child, ast.Call) and ast.unparse(child.func) in IMPORTERS:
                names = [a.value for a in child.args[:1] if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            found.extend((name, child.lineno, late) for name in names if re.match(r"ftlm(\.|$)", name))
            walk(child, late or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda))

    walk(tree, False)
    return found


def violations(package):
    """Imports of a package that break the rules, one line each."""
    wrong = []
    for path in sorted(package.rglob("*.py")):
        name = path.relative_to(package)
        own = name.parts[0].removesuffix(".py")
        if own == "__init__":
            continue
        if own not in LAYER_OF:
            wrong.append(f"{name} is on no layer; add its folder to LAYERS")
            continue
        for target, line, late in imports_of(ast.parse(path.read_text(encoding="utf-8")), name):
            folder = target.split(".")[1] if "." in target else ""
            if folder == own or f"ftlm.{folder}" == "ftlm._core":
                continue
            if folder not in LAYER_OF:
                wrong.append(
                    f"{name}:{line} imports {target} from the package's own top; import the module that holds it"
                )
                continue
            upward, central = LAYER_OF[folder] >= LAYER_OF[own], name.as_posix() in CENTRAL_MODULES
            if upward and not (late and central):
                wrong.append(f"{name}:{line} imports {target} from a layer that is no lower")
            if late and not upward:
                wrong.append(f"{name}:{line} imports {target} inside a function without need")
    return wrong


def test_imports_go_to_lower_layers():
    assert violations(PACKAGE) == []


def test_no_folder_has_the_name_of_a_public_function():
    assert {path.name for path in PACKAGE.iterdir() if path.is_dir()} & set(ftlm.__all__) <= {"rig"}


@pytest.mark.parametrize(
    ("file", "text", "count"),
    [
        ("utils/files.py", "from ftlm.errors import FtlmError", 0),
        ("utils/files.py", "from ftlm.data.run import Run", 1),
        ("utils/files.py", "import ftlm.data.run as r, math", 1),
        ("utils/files.py", "from ..data import run", 1),
        ("utils/files.py", "from ftlm import Run", 1),
        ("utils/files.py", "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ftlm.data.run import Run", 0),
        ("utils/files.py", "def f():\n    from ftlm.data.run import Run", 1),
        ("utils/files.py", "def f():\n    return __import__('ftlm.data.run')", 1),
        ("svg/figure.py", "from ftlm.structure import order", 1),
        ("data/run.py", "def f():\n    from ftlm.model.model import Model", 0),
        ("data/run.py", "def f():\n    from ftlm.utils import files", 1),
        ("data/run.py", "from ftlm.model.model import Model", 1),
        ("cellar/wine.py", "import math", 1),
    ],
)
def test_a_broken_rule_is_found(tmp_path, file, text, count):
    path = tmp_path / file
    path.parent.mkdir(parents=True)
    path.write_text(f'"""Sample."""\n\n{text}\n', encoding="utf-8")
    assert len(violations(tmp_path)) == count
