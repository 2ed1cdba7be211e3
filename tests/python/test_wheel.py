"""What checks a wheel sees what it is for, and the notices are those of what is linked."""

import re
import runpy
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WHEEL = runpy.run_path(str(ROOT / "tests" / "wheel.py"))
NOTICES = runpy.run_path(str(ROOT / "tests" / "notices.py"))


def test_a_wheel_without_terms_or_with_a_folder_of_its_maker_is_seen(tmp_path):
    path = tmp_path / "a.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr("a/LICENSE", "free")
        wheel.writestr("a/THIRD-PARTY-NOTICES.txt", "free, too")
        wheel.writestr("a/_core.so", b"\0/house/me/src/lib.rs\0/housely/lib.rs")
    assert WHEEL["lacks"](path, []) == []
    assert WHEEL["lacks"](path, ["/house/you", "/house/m", "/hous", "/"]) == []
    assert WHEEL["lacks"](path, ["/house/me"]) == ["a/_core.so names /house/me"]
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr("a/LICENSE", "free")
    assert WHEEL["lacks"](path, []) == ["it lacks THIRD-PARTY-NOTICES.txt"]


def test_the_check_of_a_wheel_ends_with_its_verdict(tmp_path):
    path = tmp_path / "a.whl"
    call = [sys.executable, str(ROOT / "tests" / "wheel.py"), "--holds", str(path)]
    for names, code, told in (
        (("LICENSE", "THIRD-PARTY-NOTICES.txt"), 0, ""),
        (("LICENSE",), 1, f"{path}: it lacks THIRD-PARTY-NOTICES.txt\n"),
    ):
        with zipfile.ZipFile(path, "w") as wheel:
            for name in names:
                wheel.writestr(f"a/{name}", "free")
        done = subprocess.run(call, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (code, "", told)


def test_linked_is_what_normal_dependencies_reach():
    kinds = dict.fromkeys(("ours", "a", "b", "of_macro", "test", "built"), "lib") | {"macro": "proc-macro"}
    of_ours = {"a": None, "test": "dev", "built": "build", "macro": None}
    depends = {"ours": of_ours, "a": {"b": None}, "macro": {"of_macro": None}}
    packages = [{"id": n, "name": n, "version": "1", "targets": [{"kind": [kind]}]} for n, kind in kinds.items()]
    nodes = [
        {"id": n, "deps": [{"pkg": to, "dep_kinds": [{"kind": k}]} for to, k in depends.get(n, {}).items()]}
        for n in kinds
    ]
    metadata = {"packages": packages, "resolve": {"root": "ours", "nodes": nodes}}
    assert [package["name"] for package in NOTICES["linked"](metadata)] == ["a", "b"]


def test_the_notices_name_crates_of_this_lock_with_their_terms():
    text = (ROOT / "THIRD-PARTY-NOTICES.txt").read_text(encoding="utf-8")
    locked = {(p["name"], p["version"]) for p in tomllib.loads((ROOT / "Cargo.lock").read_text())["package"]}
    named = dict.fromkeys(re.findall(r"^(\S+) (\d\S*): (?=\S)", text.split("-" * 80)[0], re.MULTILINE))
    assert named.keys() <= locked
    assert {"faer", "nalgebra", "numpy", "pulp", "pyo3", "rayon", "realfft", "rustfft"} <= {name for name, _ in named}
    for number in re.findall(r"\d+", " ".join(re.findall(r"\(text ([^)]*)\)", text))):
        assert f"\nText {number}\n" in text


def test_what_is_linked_has_terms_that_are_allowed():
    allowed = set(tomllib.loads((ROOT / "deny.toml").read_text())["licenses"]["allow"])
    text = (ROOT / "THIRD-PARTY-NOTICES.txt").read_text(encoding="utf-8").split("-" * 80)[0]
    terms = dict(re.findall(r"^(\S+) \d\S*: (.*?) \((?:text|no text)", text, re.MULTILINE))
    assert len(terms) > 50
    for name, expression in terms.items():
        choices = re.split(r" OR |/", expression)
        assert any(set(choice.strip("()").split(" AND ")) <= allowed for choice in choices), f"{name}: {expression}"
