"""Rules of the source: who uses which library, what files and public names document, one test a rule."""

import ast
import functools
import importlib
import inspect
import pydoc
import re
import shutil
import subprocess
import sys
import textwrap
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

import crate_structure
import ftlm
from ftlm import _core

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "python" / "ftlm"
PYTHON = sorted(PACKAGE.rglob("*.py"))
RUST = sorted((ROOT / "rust").rglob("*.rs"))
FUNCTIONS = [n for n in ftlm.__all__ if inspect.isfunction(getattr(ftlm, n))]


def name_of(path):
    return str(path.relative_to(ROOT))


@functools.cache
def code_of(path):
    """Rust source without comments, strings and test modules."""
    text = path.read_text(encoding="utf-8")
    text = re.sub(r'"(?:\\.|[^"\\])*"', '""', text)
    text = re.sub(r"//[^\n]*", "", text)
    return re.sub(r"#\[cfg\(test\)\]\s*mod \w+ \{.*?\n\}", "", text, flags=re.DOTALL)


@functools.cache
def tree_of(path):
    """Syntax tree of a Python file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def imports_of(path):
    """Top-level names of everything that a Python file imports, at whatever depth."""
    found = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


# ----------------------------------------------------------------------------------------------------------------------
# The map and the crate; `test_layers.py` has the layers of Python, `crate_structure.py` reads the crate


def test_no_circle_of_rust_files():
    assert crate_structure.rust_circles(ROOT / "rust") == []


def test_the_map_names_every_folder():
    table = section("The map")
    folders = {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert folders == set(re.findall(r"^\| `python/ftlm/(\w+)/` \|", table, re.MULTILINE))
    assert all((ROOT / name).exists() for name in re.findall(r"`((?:python|rust)/[\w/.]+)`", table))


#: Calls that need no wrapper, and why.
ATTACHED = {
    "force_portable": "sets one flag, for tests",
}

#: Classes without methods, whose objects are only handed back to the core.
HANDLES = {"JointMultistart"}


def test_every_entry_of_the_extension_computes_detached_and_caught():
    """A panic becomes InternalError, and other Python threads go on: each entry calls the one way into the core."""
    bodies, _ = crate_structure.entries(ROOT / "rust" / "python")
    reached = {name.split("::")[1] for name in bodies}
    public = {name for name in dir(_core) if not name.startswith("__") and callable(getattr(_core, name))}
    assert public - HANDLES == {name for name in reached if "." not in name} | {
        n.split(".")[0] for n in reached if "." in n
    }
    bare = crate_structure.unwrapped(ROOT / "rust" / "python", ["run_detached", "run_attached"])
    assert [name for name in bare if name.split("::")[1] not in ATTACHED] == []


# ----------------------------------------------------------------------------------------------------------------------
# The walk of a run


def section(title):
    """A section of CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", text, re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


def test_the_walk_of_a_run_is_the_one_it_takes(tmp_path, small_run):
    """Each line of the walk names one function; a run passes them in that order."""
    lines = re.findall(r"^(\d+)\. (.*(?:\n   .*)*)", section("From a run to a report"), re.MULTILINE)
    assert [int(number) for number, _ in lines] == list(range(1, 11))
    walk = []
    for _, line in lines:
        (name,) = re.findall(r"`((?:\w+\.)+\w+)`", line)
        module, _, function = name.rpartition(".")
        code = inspect.unwrap(getattr(importlib.import_module(f"ftlm.{module}"), function)).__code__
        walk.append((name, code))
    names, passed = {code: name for name, code in walk}, []

    def note(frame, event, _):
        if event == "call" and names.get(frame.f_code, passed) not in (passed, *passed):
            passed.append(names[frame.f_code])

    small_run.to_csv(tmp_path / "run.csv")
    before = sys.getprofile()
    sys.setprofile(note)
    try:
        run = ftlm.load(tmp_path / "run.csv")
        structure = ftlm.equation("D^alpha y = a D^beta y + b u", initial="rest")
        method = ftlm.MultiInnovation(order_grid=ftlm.order_grid(increment=0.25))
        ftlm.identify(run, structure, method=method, m=64, threads=1).report(tmp_path / "run.html")
    finally:
        sys.setprofile(before)
    assert passed == [name for name, _ in walk]


# ----------------------------------------------------------------------------------------------------------------------
# Who may use what


def uses(path, crate):
    return re.search(rf"\b(?:use\s+{crate}\b|{crate}::)", code_of(path)) is not None


@pytest.mark.parametrize(
    ("crate", "home"),
    [
        ("faer", "linalg/dense.rs"),
        ("nalgebra", "linalg/small.rs"),
        ("realfft", "fft.rs"),
        ("rustfft", "fft.rs"),
        ("num_complex", "fft.rs"),
    ],
)
def test_one_file_uses_a_crate_of_linear_algebra_or_transforms(crate, home):
    users = [name_of(path) for path in RUST if uses(path, crate)]
    assert set(users) <= {f"rust/{home}"}
    if crate in ("faer", "nalgebra", "realfft"):
        assert users == [f"rust/{home}"]


@pytest.mark.parametrize("crate", ["pyo3", "numpy"])
def test_only_the_bindings_know_python(crate):
    users = {name_of(path.parent) for path in RUST if uses(path, crate)}
    assert users == {"rust/python", "rust/python/joint_fit", "rust/python/order_search"}


def test_bindings_are_an_optional_feature():
    manifest = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))
    assert manifest["features"]["default"] == []
    assert all(manifest["dependencies"][crate]["optional"] for crate in ("pyo3", "numpy"))
    assert re.search(r'#\[cfg\(feature = "python"\)\]\s*mod python;', (ROOT / "rust" / "lib.rs").read_text())
    assert not manifest["dependencies"]["faer"]["default-features"]  # its rayon would nest inside a search


def test_rust_does_no_files_clocks_or_unsafe_code():
    for path in RUST:
        code = code_of(path)
        assert "std::fs" not in code, path
        assert not re.search(r"\bunsafe\b(?!_)", code), path
        if path.name not in ("virtual_arm.rs", "watch.rs"):
            assert "std::time" not in code, path


def test_rust_does_not_panic_on_user_data():
    pattern = re.compile(r"\.unwrap\(\)|\.expect\(|\b(?:panic|unreachable|todo|unimplemented)!")
    assert {name_of(path): found for path in RUST if (found := pattern.findall(code_of(path)))} == {}


def test_no_method_is_checked_twice():
    """`check_arguments` of a class decorates its public methods; a second time would name the keywords twice."""
    twice = [
        f"{name_of(path)}: {kind.name}.{method.name}"
        for path in PYTHON
        for kind in ast.walk(tree_of(path))
        if isinstance(kind, ast.ClassDef) and "check_arguments" in map(ast.unparse, kind.decorator_list)
        for method in kind.body
        if isinstance(method, ast.FunctionDef) and "check_arguments" in map(ast.unparse, method.decorator_list)
    ]
    assert not twice
    model = ftlm.Model(ftlm.equation("D y = -1 y + 2 u"))
    with pytest.raises(TypeError) as refused:
        model.simulate(tol=2)
    assert str(refused.value).count("known: run, ") == 1


def test_only_the_report_draws():
    users = {name_of(path) for path in PYTHON if imports_of(path) & {"matplotlib", "pylab", "plotly"}}
    assert all(name.startswith("python/ftlm/report/") for name in users)


def test_no_code_is_run_or_unpickled_from_data():
    for path in PYTHON:
        tree = tree_of(path)
        called = {n.func.id for n in ast.walk(tree) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}
        assert not called & {"eval", "exec", "compile"}, path
        assert not imports_of(path) & {"pickle", "shelve", "marshal", "dill", "joblib"}, path
        keywords = {k.arg for n in ast.walk(tree) if isinstance(n, ast.Call) for k in n.keywords}
        assert "shell" not in keywords, path


#: Functions that start processes, by module; "" for those that are recognised by their name alone.
STARTERS = {
    "subprocess": {"run", "Popen", "call", "check_call", "check_output", "getoutput", "getstatusoutput"},
    "os": {"system", "popen", "startfile"},
    "": {"create_subprocess_exec", "create_subprocess_shell", "ProcessPoolExecutor", "subprocess_exec"},
}
STARTER_PATTERN = re.compile(r"(exec|spawn|posix_spawn)[lvpe]*|fork(pty)?")


def starts_process(call):
    """Whether a call starts a process."""
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    owner = ast.unparse(call.func.value) if isinstance(call.func, ast.Attribute) else ""
    return (
        name in STARTERS[""]
        or name in STARTERS.get(owner, ())
        or (owner == "os" and STARTER_PATTERN.fullmatch(name) is not None)
    )


def careless_processes(source):
    """Calls that start a process in another way than `subprocess_arguments` says, and imports that may."""
    tree = ast.parse(source)
    functions = [n for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))]
    careful = {
        call
        for function in functions
        if "subprocess_arguments(" in source and "subprocess_arguments(" in ast.unparse(function)
        for call in ast.walk(function)
        if isinstance(call, ast.Call) and any(k.arg is None for k in call.keywords)
    }
    calls = [n for n in ast.walk(tree) if isinstance(n, ast.Call) and starts_process(n)]
    taken = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module in ("subprocess", "os")]
    found = [ast.unparse(call) for call in calls if call not in careful]
    found += [ast.unparse(n) for n in taken]
    return found + [
        ast.unparse(n)
        for n in ast.walk(tree)
        if isinstance(n, (ast.Import, ast.ImportFrom))
        and {name.split(".")[0] for name in (*(a.name for a in n.names), getattr(n, "module", None) or "")}
        & {"multiprocessing", "pty"}
        # It starts nothing.
        and [a.name for a in n.names] != ["parent_process"]
    ]


def test_every_process_is_started_in_one_way():
    found = {name_of(path): careless_processes(path.read_text(encoding="utf-8")) for path in PYTHON}
    assert {name: calls for name, calls in found.items() if calls} == {}
    users = [name_of(p) for p in PYTHON if "subprocess_arguments(" in p.read_text(encoding="utf-8")]
    assert sorted(users) == [
        "python/ftlm/app/subprocess_task.py",
        "python/ftlm/io/isolated_reader.py",
        "python/ftlm/rig/virtual_board.py",
        "python/ftlm/utils/resources.py",
    ]


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("def f():\n    subprocess.run(**subprocess_arguments(p), stdin=0)", 0),
        ("def f():\n    subprocess.run([sys.executable, p])", 1),
        ("def f():\n    subprocess_arguments(p)\n    subprocess.Popen([p])", 1),
        ("subprocess.run(**options)", 1),
        ("async def f():\n    await asyncio.create_subprocess_exec(p)", 1),
        ("os.execv(p, [])", 1),
        ("os.fork()", 1),
        ("from subprocess import run", 1),
        ("import multiprocessing.pool", 1),
        ("from multiprocessing import Process", 1),
        ("from multiprocessing import parent_process", 0),
        ("from concurrent.futures import ProcessPoolExecutor as P\nProcessPoolExecutor(2)", 1),
        ("rig.run(commands)", 0),
    ],
)
def test_the_check_for_processes_finds_them(source, count):
    assert len(careless_processes(source)) == count


def private_names(source):
    """Private names of other packages that a module uses, as dotted names."""
    tree, found, modules = ast.parse(source), [], {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {a.asname or a.name.partition(".")[0]: a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module != "__future__":
            modules |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
    found += modules.values()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            names = ast.unparse(node).split(".")
            found += [".".join([modules[names[0]], *names[1:]])] if names[0] in modules else []
    private = re.compile(r"(?!ftlm\.)[\w.]*\._(?!_)[\w.]*")
    return sorted({name for name in found if private.fullmatch(name)})


def test_no_private_name_of_a_library_is_used():
    assert private_names("import typer.core as c\nc.TyperOption._parse\nfrom a import _b") == [
        "a._b",
        "typer.core.TyperOption._parse",
    ]
    used = {name for path in PYTHON for name in private_names(path.read_text(encoding="utf-8"))}
    # Documented, despite its name.
    assert used <= {"os._exit"}


def test_importing_the_package_imports_little():
    script = (
        "import sys; before = set(sys.modules); import ftlm; "
        "new = {m.split('.')[0] for m in set(sys.modules) - before}; "
        "print(sorted(m for m in new if m not in sys.stdlib_module_names))"
    )
    ran = subprocess.run([sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, check=True)
    found = set(ast.literal_eval(ran.stdout))
    assert not found & {"scipy", "pandas", "polars", "pyarrow", "matplotlib", "sympy", "mpmath", "control", "dask"}
    # The core needs NumPy and msgspec; the rest of the core install serves the command line and the report.
    # (msgspec looks for typing_extensions and takes it where it is.)
    assert found <= {"ftlm", "numpy", "msgspec", "typing_extensions"}


# ----------------------------------------------------------------------------------------------------------------------
# No loop over samples in Python

COUNTS = ("size", "length", "m")


def counts_samples(node):
    """Whether an expression is the number of samples or pulses of something, give or take a constant."""
    if isinstance(node, ast.BinOp):
        return counts_samples(node.left) or counts_samples(node.right)
    if isinstance(node, ast.Attribute):
        return node.attr in COUNTS
    if isinstance(node, ast.Name):
        return node.id == "m"
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
        return ast.unparse(node.slice) in ("0", "-1")
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "len":
        return any(is_signal(a) for a in node.args)
    return False


def is_signal(node):
    """Whether an expression is a signal of a run or a record."""
    if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
        return node.value.id == "run"
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        return node.func.attr in ("of", "nditer") or (node.func.attr == "tolist" and is_signal(node.func.value))
    return isinstance(node, ast.Name) and node.id == "samples"


def loops_over_samples(source):
    """What the loops and comprehensions run over that step through samples."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, (ast.For, ast.comprehension)):
            continue
        pending = [node.iter]
        while pending:
            it = pending.pop()
            if isinstance(it, ast.Call) and isinstance(it.func, ast.Name):
                if it.func.id in ("enumerate", "zip", "reversed", "iter"):
                    pending += it.args
                    continue
                if it.func.id == "range" and any(counts_samples(a) for a in it.args):
                    found.add(ast.unparse(node.iter))
            if is_signal(it):
                found.add(ast.unparse(node.iter))
    return sorted(found)


def test_python_does_not_loop_over_samples():
    # Approximate: it knows the names that samples and their number go by. Exempt are the q8 loop, paced by its board,
    # and drawing, which writes the thinned points of a picture one by one.
    drawing = ("python/ftlm/rig/quanser.py", "python/ftlm/svg/", "python/ftlm/plot/", "python/ftlm/data/export.py")
    found = {name_of(p): loops_over_samples(p.read_text(encoding="utf-8")) for p in PYTHON}
    assert {name: loops for name, loops in found.items() if loops and not name.startswith(drawing)} == {}


@pytest.mark.parametrize(
    ("source", "count"),
    [
        ("for i in range(len(run['y'])): pass", 1),
        ("for i, v in enumerate(run['y']): pass", 1),
        ("for i in range(run.length): pass", 1),
        ("for k in range(1, m): pass", 1),
        ("for k in range(y.shape[0] - 1): pass", 1),
        ("x = [v * 2 for v in samples]", 1),
        ("x = [a - b for a, b in zip(rec.of('y'), rec.of('u'))]", 1),
        ("for name in run.outputs: pass", 0),
        ("for i in range(4): pass", 0),
        ("for k in range(x.shape[1]): pass", 0),
        ("x = [run[n] for n in run.inputs]", 0),
    ],
)
def test_the_check_for_loops_finds_loops(source, count):
    assert len(loops_over_samples(source)) == count


# ----------------------------------------------------------------------------------------------------------------------
# What files and names say of themselves

OWN = sorted(
    {
        *PYTHON,
        *(ROOT / "tests" / "python").glob("*.py"),
        *(ROOT / "benches").glob("*.py"),
        *(ROOT / "examples").glob("*.py"),
    }
)


def test_every_python_file_begins_with_its_purpose():
    for path in OWN:
        text = ast.get_docstring(tree_of(path))
        assert text, path
        first = text.split("\n\n")[0].strip()
        assert first[-1] in ".:", path
        assert len(first) > 20, path


def test_every_rust_file_begins_with_its_purpose():
    for path in [*RUST, *(ROOT / "tests" / "rust").rglob("*.rs"), *(ROOT / "benches").glob("*.rs")]:
        opening = path.read_text(encoding="utf-8").split("\n\n")[0]
        lines = [line for line in opening.splitlines() if line.startswith("//!")]
        assert opening.startswith("//! "), path
        assert "." in " ".join(lines), path


def test_public_names_are_what_they_should_be():
    assert ftlm.__all__ == sorted(
        ftlm.__all__, key=lambda n: (not n.isupper(), not n[0].isupper(), n.startswith("_") * -1, n)
    )
    for name in ftlm.__all__:
        assert hasattr(ftlm, name)
    public = {n for n, value in vars(ftlm).items() if not n.startswith("_") and not inspect.ismodule(value)}
    assert public <= set(ftlm.__all__)


def test_every_public_name_has_a_docstring():
    for name in set(ftlm.__all__) - {"PARAMETER_SETS", "__version__"}:
        text = getattr(ftlm, name).__doc__
        assert text, name
        assert text.strip().splitlines()[0].rstrip()[-1] in ".:", name


def documented(text):
    """Names in the Parameters section of a numpydoc docstring."""
    found = re.search(
        r"^Parameters\n-{10}\n(.*?)(?=^\S[^\n]*\n-{3,}\n|\Z)", inspect.cleandoc(text), re.MULTILINE | re.DOTALL
    )
    if found is None:
        return set()
    heads = [line.split(" : ")[0] for line in found[1].splitlines() if line and not line.startswith(" ")]
    return {name.strip().lstrip("*").replace("\\", "") for head in heads for name in head.split(",")}


def test_every_parameter_of_every_public_function_is_documented():
    for name in FUNCTIONS:
        function = getattr(ftlm, name)
        parameters = set(inspect.signature(function).parameters)
        assert documented(function.__doc__) == parameters, name
        sections = re.findall(r"^(\w[\w ]*)\n-{3,}$", inspect.cleandoc(function.__doc__), re.MULTILINE)
        assert {"Returns", "Raises"} <= set(sections), name
        assert [s for s in ("Parameters", "Returns", "Raises", "Notes", "Examples") if s in sections] == sections, name


def is_made_of_its_fields(record):
    """Whether a public record is made by giving its fields; a run, say, refuses to be."""
    return is_dataclass(record) and bool(inspect.signature(record).parameters)


def test_every_field_of_every_public_record_is_documented():
    for record in (getattr(ftlm, name) for name in ftlm.__all__):
        if is_made_of_its_fields(record):
            assert documented(record.__doc__) == {f.name for f in fields(record)}, record


@pytest.mark.parametrize(
    "name", ["Run", "Model", "Structure", "Identification", "SearchResult", "Comparison", "Order", "OrderGrid"]
)
def test_every_public_member_has_a_docstring(name):
    for member, value in vars(getattr(ftlm, name)).items():
        if member.startswith("_") or not (callable(value) or isinstance(value, (property, classmethod))):
            continue
        assert inspect.getdoc(getattr(getattr(ftlm, name), member)), member


def in_the_reference():
    """What docs/reference.toml shows: functions, classes and the members of these that it names, or all."""
    topics = tomllib.loads((ROOT / "docs" / "reference.toml").read_text(encoding="utf-8"))
    found = {}
    for holder, members in (row for topic in topics.values() for row in topic["names"].items()):
        found[holder] = value = pydoc.locate(holder)
        public = [n for n, v in vars(value).items() if not n.startswith("_") and inspect.getdoc(v)] if members else []
        known = public if members == ["*"] else members
        found |= {f"{holder}.{n}": inspect.getattr_static(value, n, None) for n in known}
    return {n: v.__func__ if isinstance(v, (classmethod, staticmethod)) else v for n, v in found.items()}


REFERENCE = in_the_reference()


def referred_to(name, text):
    """Docstrings that one refers to for what it does not say itself: what is in its class, its module, or anywhere."""
    for other in re.findall(r":(?:func|meth):`~?([\w.]+)`", text):
        homes = (name.rpartition(".")[0], name.rpartition(".")[0].rpartition(".")[0], "ftlm", "")
        known = (pydoc.locate(f"{home}.{other}".lstrip(".")) for home in homes)
        yield next((inspect.getdoc(o) for o in known if o is not None), "") or ""


def undocumented(name, function):
    """What a docstring does not say of arguments and refusals, nor one that it refers to."""
    text = inspect.getdoc(function) or ""
    named = set(inspect.signature(function).parameters) - {"self", "cls"}
    others = list(referred_to(name, text))
    own, method = documented(text), inspect.isclass(pydoc.locate(name.rpartition(".")[0]))
    # A method of one argument says in its line what it is.
    enough = own == named if own else (method and len(named) <= 1) or any(named <= documented(o) for o in ("", *others))
    body = ast.parse(textwrap.dedent(inspect.getsource(function)))
    raised = [n.exc for n in ast.walk(body) if isinstance(n, ast.Raise)]
    kinds = {ast.unparse(e.func).rpartition(".")[2] for e in raised if isinstance(e, ast.Call)}
    told = [t.partition("Raises\n------\n")[2] for t in (text, *others)]
    silent = {
        k for k in kinds & {"DataError", "ModelError", "ConvergenceError", "RigFault"} if not any(k in t for t in told)
    }
    sections = re.findall(r"^(\w[\w ]*)\n-{3,}$", text, re.MULTILINE)
    ordered = [s for s in ("Parameters", "Returns", "Warns", "Raises", "Notes", "Examples") if s in sections]
    return [
        *([] if enough else [f"arguments {sorted(named ^ own)}"]),
        *sorted(silent),
        *([] if sections == ordered else [f"sections {sections}"]),
    ]


def test_everything_in_the_reference_exists():
    assert [name for name, value in REFERENCE.items() if value is None] == []
    assert len(REFERENCE) > 250


def test_the_reference_documents_every_argument_and_error():
    missing = {name: undocumented(name, value) for name, value in REFERENCE.items() if inspect.isfunction(value)}
    assert {name: found for name, found in missing.items() if found} == {}


def test_the_reference_documents_the_arguments_of_every_class():
    for name, kind in REFERENCE.items():
        if not inspect.isclass(kind) or issubclass(kind, Exception):
            continue
        text = inspect.getdoc(kind)
        # A run, say, is constructed by its own methods.
        arguments = set(inspect.signature(kind).parameters) - {"args", "kwargs"}
        assert documented(text) >= arguments, name
        written = [vars(kind)[n] for n in ("__init__", "__post_init__") if n in vars(kind)]
        checks = [f for f in map(inspect.unwrap, written) if not f.__code__.co_filename.startswith("<")]
        if arguments and any(re.search(r"raise (Model|Data)Error", inspect.getsource(f)) for f in checks):
            assert "\nRaises\n------\n" in text, name


def test_what_a_docstring_does_not_say_is_seen():
    def none(first, second):
        """Do something."""

    def part(first, second):
        """Do something.

        Parameters
        ----------
        first
            One.
        """
        raise ftlm.ModelError("no")

    def other(first):
        """See :func:`ftlm.nothing`.

        Raises
        ------
        DataError
            Always.

        Parameters
        ----------
        first
            One.
        """
        raise ftlm.DataError("no")

    def refers(run):
        """See :func:`ftlm.resid`."""

    assert undocumented("ftlm.none", none) == ["arguments ['first', 'second']"]
    assert undocumented("ftlm.part", part) == ["arguments ['second']", "ModelError"]
    assert undocumented("ftlm.other", other) == ["sections ['Raises', 'Parameters']"]
    assert undocumented("ftlm.refers", refers) == ["arguments ['run']"]
    assert undocumented("ftlm.Model.refers", refers) == []


# ----------------------------------------------------------------------------------------------------------------------
# One version, one machine's paths nowhere, stubs that are true


def test_one_version():
    manifest = tomllib.loads((ROOT / "Cargo.toml").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert ftlm.__version__ == manifest["package"]["version"]
    assert project["project"]["dynamic"] == ["version"]


def tracked():
    git = shutil.which("git")
    if git is None or not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    listed = subprocess.run([git, "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).is_file()]


def test_no_path_of_a_machine_in_a_tracked_file():
    # Put together here, so that this file does not find itself.
    machine = re.compile(
        "|".join(["/ho" + "me/", "/ro" + "ot/", "/wo" + "rk/", "/Us" + "ers/", r"[A-Z]:\\Us" + "ers"]).encode()
    )
    found = [name_of(path) for path in tracked() if machine.search(path.read_bytes())]
    assert found == []


def test_no_built_or_temporary_file_is_tracked():
    bad = (".so", ".pyd", ".pyc", ".orig", ".rej", ".whl", ".egg-info")
    assert [name_of(p) for p in tracked() if p.name.endswith(bad) or "__pycache__" in p.parts] == []


def test_the_package_has_types():
    assert (PACKAGE / "py.typed").exists()
