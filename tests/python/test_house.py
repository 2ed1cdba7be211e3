"""The checkers of the house see what they are for: on small trees that keep every rule, and break one at a time."""

import pytest

import house

PYTHON = {
    "__init__.py": '"""Top."""\n\nfrom ftlm import _core\nfrom ftlm.model.model import Model\n',
    "_core.pyi": "",
    "errors.py": '"""Face."""\n\nfrom ftlm.base.checks import Error\n\n__all__ = ["Error"]\n',
    "base/__init__.py": '"""Ground."""\n',
    "base/checks.py": '"""Checks."""\n\nimport math\n\nclass Error(Exception):\n    pass\n',
    "base/files.py": '"""Files."""\n\nfrom ftlm.base import checks\n\ndef frame():\n    import pandas\n',
    "data/__init__.py": '"""Data."""\n',
    "data/run.py": '"""Run."""\n\nfrom ftlm import _core\nfrom ftlm._core import means\n'
    "from ftlm.base.files import frame\n",
    "paint/__init__.py": '"""Paint."""\n',
    "paint/lines.py": '"""Lines."""\n\nimport ftlm.base.checks\n',
    "model/__init__.py": '"""Model."""\n',
    "model/model.py": '"""Model."""\n\nfrom ..data.run import frame\nfrom ftlm.paint import lines\n',
}
RUST = {
    "lib.rs": "//! Top.\n#![forbid(unsafe_code)]\npub mod error;\npub mod series;\npub mod estimate;\n",
    "error.rs": "//! Errors: not `crate::series`.\npub struct Error;\n"
    'pub fn check() -> &\'static str { "crate::series::go()" }\n',
    "series.rs": "//! Series.\nuse crate::error::{self, Error};\npub struct Plan;\n"
    "pub fn go<'a>(x: &'a str) -> char { 'a' }\n#[cfg(test)]\nmod tests {\n    use crate::estimate::fit;\n}\n",
    "estimate/mod.rs": "//! Face.\nmod common;\nmod joint;\nmod single;\n"
    "pub use common::{Settings, Solution as Answer};\npub use joint::fit;\n",
    "estimate/common.rs": "//! Common.\npub struct Settings;\npub struct Solution;\n",
    "estimate/single.rs": "//! Single.\nuse super::Settings;\nuse crate::series::{Plan, go};\npub fn one() {}\n",
    "estimate/joint.rs": "//! Joint.\nuse crate::estimate::{single, Answer};\npub fn fit() { single::one(); }\n",
}


def tree(folder, files, changed=()):
    """A tree of files, some of them changed or added."""
    for name, text in {**files, **dict(changed)}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder


def python(folder, changed=()):
    return tree(folder / "ftlm", PYTHON, changed)


def test_a_sound_house_is_sound(tmp_path):
    package, root = python(tmp_path), tree(tmp_path / "rust", RUST)
    for checker in (house.upward_imports, house.python_circles, house.hidden_imports, house.broken_faces,
                    house.uses_of_faces):  # fmt: skip
        assert checker(package) == []
    assert house.rust_circles(root) == []
    assert house.long_files(package, ".py") == house.long_files(root, ".rs") == []
    edges = house.Crate(root).edges()
    assert edges["estimate", "single"] == {("estimate", "common"), ("series",)}
    assert edges["estimate", "joint"] == {("estimate", "single"), ("estimate", "common")}
    assert edges["series",] == {("error",)}
    assert edges["error",] == set()


HIDDEN = "def f():\n    {}\n"
UP = [
    "from ftlm.data.run import frame",
    "from ftlm.data import run",
    "import ftlm.data.run",
    "import ftlm.data.run as r, math",
    "from ..data import run",
    "from ..data.run import frame",
    "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ftlm.data.run import frame",
    "try:\n    from ftlm.data import run\nexcept ImportError:\n    pass",
    HIDDEN.format("from ftlm.data.run import frame"),
    HIDDEN.format("import ftlm.data.run"),
    HIDDEN.format("import importlib; importlib.import_module('ftlm.data.run')"),
    HIDDEN.format("return __import__('ftlm.data.run')"),
]


@pytest.mark.parametrize("text", UP)
def test_an_import_turned_round_is_seen_however_it_is_written(tmp_path, text):
    package = python(tmp_path, {"base/files.py": f'"""Files."""\n\n{text}\n\nframe = 1\n'})
    (up,) = house.upward_imports(package)
    assert up.startswith("ftlm.base.files:")
    assert up.endswith(" imports ftlm.data.run")
    assert house.python_circles(package) == [["ftlm.base.files", "ftlm.data.run"]]


def test_a_neighbour_on_the_same_storey_and_a_folder_without_one_are_seen(tmp_path):
    package = python(tmp_path, {"paint/lines.py": '"""Lines."""\n\nfrom ftlm.data import run\n'})
    assert house.upward_imports(package) == ["ftlm.paint.lines:3 imports ftlm.data.run"]
    package = python(tmp_path / "more", {"cellar/wine.py": '"""Wine."""\n\nfrom ftlm.base import checks\n'})
    assert house.upward_imports(package) == ["ftlm.cellar.wine:3 ftlm.base.checks: a folder without a storey"]


def test_a_circle_within_a_folder_is_seen(tmp_path):
    package = python(
        tmp_path,
        {
            "base/checks.py": '"""Checks."""\n\nfrom ftlm.base.more import x\n',
            "base/more.py": '"""More."""\n\ndef f():\n    from ftlm.base import files\n',
        },
    )
    assert house.upward_imports(package) == []
    assert house.python_circles(package) == [["ftlm.base.checks", "ftlm.base.files", "ftlm.base.more"]]


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("from ftlm.base import checks", "ftlm.base"),
        ("from html import escape", "html"),
        ("import importlib; importlib.import_module('json')", "json"),
        ("return (lambda: __import__('io'))()", "io"),
    ],
)
def test_an_import_hidden_in_a_function_is_seen(tmp_path, text, what):
    package = python(tmp_path, {"data/run.py": f'"""Run."""\n\nclass A:\n    async def f(self):\n        {text}\n'})
    assert [line.split(" imports ")[1] for line in house.hidden_imports(package) if "importlib" not in line] == [what]


@pytest.mark.parametrize("suffix", [".py", ".rs"])
def test_a_line_too_many_is_seen(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_text("\n" * house.LONGEST)
    assert house.long_files(tmp_path, suffix) == []
    (tmp_path / f"a{suffix}").write_text("\n" * (house.LONGEST + 1))
    assert house.long_files(tmp_path, suffix) == [f"a{suffix}: 601 lines"]


def test_a_face_that_is_more_and_its_use_from_inside_are_seen(tmp_path):
    face = PYTHON["errors.py"]
    assert house.broken_faces(python(tmp_path, {"errors.py": face + "\n" * 8})) == ["errors.py: 13 lines"]
    package = python(tmp_path, {"errors.py": face + "LIMIT = 3\n"})
    assert house.broken_faces(package) == ["errors.py:6 is no import"]
    for number, text in enumerate(
        ["from ftlm.errors import Error", "from ftlm import errors", "from ftlm import Model"]
    ):
        package = python(tmp_path / str(number), {"data/run.py": f'"""Run."""\n\n{text}\n'})
        assert len(house.uses_of_faces(package)) == 1
        assert len(house.upward_imports(package)) == 1


def test_a_folder_with_a_functions_name_is_seen(tmp_path):
    package = python(tmp_path, {"identify/__init__.py": '"""Taken."""\n'})
    assert house.folders_named_as(package, ["identify", "load"]) == ["identify"]


@pytest.mark.parametrize(
    "text",
    [
        "use super::joint::fit;",
        "use super::fit;",
        "use super::*;",
        "use super::{Settings, self as all};\nfn f() { all::fit(); }",
        "use crate::{error, estimate::{self, joint::{fit as go}}};",
        "use crate::estimate;\nfn f() { estimate::fit(); }",
        "fn f() { super::joint::fit(); }",
        "fn f() { crate::estimate::fit(); }",
        'fn f() -> char {\n    let s = r#"a " { b"#; /* { /* */ { */\n    if s == "//" { \'"\' } '
        "else { crate::estimate::fit() }\n}",
        "mod inner {\n    use super::super::joint;\n}",
        "mod inner {\n    pub fn f<'a>() { super::super::joint::fit() }\n}",
        "fn f() {\n    use crate::estimate::joint;\n    joint::fit();\n}",
    ],
)
def test_a_circle_of_rust_files_is_seen_however_it_is_written(tmp_path, text):
    root = tree(tmp_path, RUST, {"estimate/single.rs": f"//! Single.\n{text}\npub fn one() {{}}\n"})
    assert house.rust_circles(root) == [["estimate/joint.rs", "estimate/single.rs"]]


@pytest.mark.parametrize(
    "text",
    [
        "// use super::joint::fit;",
        "/* use super::joint::fit; /* nested */ use super::fit; */",
        'const A: &str = "use super::joint::fit;";',
        'const A: &str = r##"crate::estimate::fit() "# "##;',
        "use super::Settings;\nuse std::joint::fit;",
        "#[cfg(test)]\nmod tests {\n    use super::super::joint::fit;\n    fn f() { if true { '{'; } }\n}",
        "#[cfg(test)]\nuse super::joint::fit;",
        "mod joint { pub fn fit() {} }\nfn f() { self::joint::fit() }",
    ],
)
def test_what_is_no_import_of_rust_is_none(tmp_path, text):
    root = tree(tmp_path, RUST, {"estimate/single.rs": f"//! Single.\n{text}\npub fn one() {{}}\n"})
    assert house.rust_circles(root) == []


def test_a_module_with_code_of_its_own_is_no_face(tmp_path):
    mod = RUST["estimate/mod.rs"] + "pub fn shared() {}\n"
    assert house.rust_circles(tree(tmp_path / "a", RUST, {"estimate/mod.rs": mod})) == []
    single = "//! Single.\nuse super::shared;\npub fn one() {}\n"
    root = tree(tmp_path / "b", RUST, {"estimate/mod.rs": mod, "estimate/single.rs": single})
    assert house.rust_circles(root) == [["estimate/joint.rs", "estimate/mod.rs", "estimate/single.rs"]]


BINDINGS = """//! Bindings.
#[pyfunction]
#[pyo3(signature = (x, n=None))]
pub fn wrapped(py: Python<'_>, x: f64, n: Option<usize>) -> PyResult<f64> {
    detached(py, || crate::go(x))
}

#[pyfunction]
fn watched_too(py: Python<'_>) -> PyResult<()> {
    watched(py, || Ok(()))
}

fn watched<T>(py: Python<'_>, work: impl FnOnce() -> T) -> T {
    py.detach(|| caught(work))
}

#[pymethods]
impl Thing {
    #[new]
    fn new() -> Self {
        // detached(
        Thing {}
    }

    fn step(&mut self, py: Python<'_>) -> PyResult<()> {
        detached(py, || self.0.step())
    }
}
"""


def test_an_entry_that_is_not_wrapped_is_seen(tmp_path):
    (tmp_path / "some.rs").write_text(BINDINGS)
    bodies, _ = house.entries(tmp_path)
    assert sorted(bodies) == ["some::Thing.new", "some::Thing.step", "some::watched_too", "some::wrapped"]
    assert house.unwrapped(tmp_path, ["detached"]) == ["some::Thing.new"]
    (tmp_path / "some.rs").write_text(BINDINGS.replace("detached(py, || crate::go(x))", "Ok(crate::go(x))"))
    assert house.unwrapped(tmp_path, ["detached"]) == ["some::Thing.new", "some::wrapped"]
