"""The readers of the crate's structure find circles and unwrapped entries, on small trees that have one."""

import pytest

import crate_structure

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


def test_uses_between_files_are_found(tmp_path):
    root = tree(tmp_path, RUST)
    assert crate_structure.rust_circles(root) == []
    edges = crate_structure.Crate(root).edges()
    assert edges["estimate", "single"] == {("estimate", "common"), ("series",)}
    assert edges["estimate", "joint"] == {("estimate", "single"), ("estimate", "common")}
    assert edges["series",] == {("error",)}
    assert edges["error",] == set()


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
    assert crate_structure.rust_circles(root) == [["estimate/joint.rs", "estimate/single.rs"]]


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
    assert crate_structure.rust_circles(root) == []


def test_a_module_with_code_of_its_own_is_no_face(tmp_path):
    mod = RUST["estimate/mod.rs"] + "pub fn shared() {}\n"
    assert crate_structure.rust_circles(tree(tmp_path / "a", RUST, {"estimate/mod.rs": mod})) == []
    single = "//! Single.\nuse super::shared;\npub fn one() {}\n"
    root = tree(tmp_path / "b", RUST, {"estimate/mod.rs": mod, "estimate/single.rs": single})
    assert crate_structure.rust_circles(root) == [["estimate/joint.rs", "estimate/mod.rs", "estimate/single.rs"]]


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
    bodies, _ = crate_structure.entries(tmp_path)
    assert sorted(bodies) == ["some::Thing.new", "some::Thing.step", "some::watched_too", "some::wrapped"]
    assert crate_structure.unwrapped(tmp_path, ["detached"]) == ["some::Thing.new"]
    (tmp_path / "some.rs").write_text(BINDINGS.replace("detached(py, || crate::go(x))", "Ok(crate::go(x))"))
    assert crate_structure.unwrapped(tmp_path, ["detached"]) == ["some::Thing.new", "some::wrapped"]
