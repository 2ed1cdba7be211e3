"""What checks a wheel sees what it is for; notices and bill are of what is linked; pins have hashes."""

import json
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import ftlm

ROOT = Path(__file__).resolve().parents[2]
WHEEL = runpy.run_path(str(ROOT / "tests" / "wheel.py"))
NOTICES = runpy.run_path(str(ROOT / "tests" / "notices.py"))


def test_a_wheel_without_terms_or_with_a_folder_of_its_maker_is_seen(tmp_path):
    path = tmp_path / "a.whl"
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr("a/LICENSE", "free")
        wheel.writestr("a/THIRD-PARTY-NOTICES.txt", "free, too")
        wheel.writestr("a/ftlm.cdx.json", "{}")
        wheel.writestr("a/_core.so", b"\0/house/me/src/lib.rs\0/housely/lib.rs")
    assert WHEEL["lacks"](path, []) == []
    assert WHEEL["lacks"](path, ["/house/you", "/house/m", "/hous", "/"]) == []
    assert WHEEL["lacks"](path, ["/house/me"]) == ["a/_core.so names /house/me"]
    with zipfile.ZipFile(path, "w") as wheel:
        wheel.writestr("a/LICENSE", "free")
    assert WHEEL["lacks"](path, []) == ["it lacks THIRD-PARTY-NOTICES.txt", "it lacks ftlm.cdx.json"]


def test_the_check_of_a_wheel_ends_with_its_verdict(tmp_path):
    path = tmp_path / "a.whl"
    call = [sys.executable, str(ROOT / "tests" / "wheel.py"), "--holds", str(path)]
    for names, code, told in (
        (("LICENSE", "THIRD-PARTY-NOTICES.txt", "ftlm.cdx.json"), 0, ""),
        (("LICENSE", "ftlm.cdx.json"), 1, f"{path}: it lacks THIRD-PARTY-NOTICES.txt\n"),
    ):
        with zipfile.ZipFile(path, "w") as wheel:
            for name in names:
                wheel.writestr(f"a/{name}", "free")
        done = subprocess.run(call, capture_output=True, text=True, timeout=240, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (code, "", told)


SHOWN = {
    "wheel": "ftlm-1-cp311-abi3-manylinux2014_x86_64.manylinux_2_17_x86_64.whl",
    "overall_tag": "manylinux_2_17_x86_64",
    "sym_tag": "manylinux_2_17_x86_64",
    "versioned_symbols": {"libc.so.6": ["GLIBC_2.17"]},
    "external_libs": {},
    "unsupported_isa": False,
    "pure": False,
}
#: As auditwheel tells it on a machine whose C library is another one.
SHOWN_MUSL = {
    **SHOWN,
    "wheel": "ftlm-1-cp311-abi3-musllinux_1_2_x86_64.whl",
    "overall_tag": "linux_x86_64",
    "sym_tag": "musllinux_1_2_x86_64",
    "versioned_symbols": {},
    "external_libs": {"libc.so": None},
}


@pytest.mark.parametrize(
    "shown", [SHOWN, SHOWN_MUSL, {**SHOWN_MUSL, "overall_tag": "musllinux_1_2_x86_64", "external_libs": {}}]
)
def test_a_wheel_that_meets_its_tag_is_good_and_any_other_is_not(shown):
    def wrong(**changed):
        return "; ".join(WHEEL["faults"]({**shown, **changed}))

    assert wrong() == ""
    lowest = "musllinux_1_2" if "musl" in shown["wheel"] else "manylinux_2_17"
    other = shown["wheel"].replace(lowest, f"{lowest[:-1]}9").replace("manylinux2014", "linux")
    assert "it claims" in wrong(wheel=other)
    assert "no policy" in wrong(overall_tag="linux_x86_64", sym_tag="linux_x86_64")
    assert "libssl.so.3" in wrong(external_libs={"libssl.so.3": None, "libc.so": None})
    assert "libssl.so.3" in wrong(versioned_symbols={"libssl.so.3": []})
    assert "newer processor" in wrong(unsupported_isa=True)
    assert "no extension" in wrong(pure=True)


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


# ----------------------------------------------------------------------------------------------------------------------
# Pins, and what a hosted machine is told to do


def pins(name):
    """(name, version) of each pinned package; refuse a line that is neither a pin nor one of its hashes."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", "")
    found = []
    for line in text.splitlines():
        if not line.startswith("#"):
            package, *hashes = line.split()
            assert hashes, line
            assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", h) for h in hashes), line
            found.append(tuple(re.fullmatch(r"([a-z0-9.-]+)==([^;]+)", package).groups()))
    assert len(dict(found)) == len(found)
    return dict(found)


def test_every_pin_has_its_hashes_and_every_dependency_its_pin():
    tested, made = pins("requirements-test.txt"), pins("requirements-wheels.txt")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = [*project["dependencies"], *(n for extra in project["optional-dependencies"].values() for n in extra)]
    assert {re.match(r"[\w-]+", n)[0].lower() for n in (*asked, "maturin")} <= set(tested)
    # Wheels are made and checked with what made and checked them in the tests.
    assert {name: tested[name] for name in made if name in tested} == {n: v for n, v in made.items() if n in tested}
    assert set(made) - set(tested) == {"ziglang"}


def test_a_package_has_one_floor_and_each_is_tried():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    found = WHEEL["floors"](project)
    names = [re.fullmatch(r"([\w-]+)==[\d.]+", line)[1] for line in found]
    assert len(set(names)) == len(names)
    assert {"numpy", "typer", "rich", "scipy", "pygad", "uvicorn"} <= set(names)
    assert "ruff" not in names
    recipe = re.search(
        r"^wheel-test:.*?\n\n", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    assert "wheel.py --floors" in recipe[0]
    assert "wheel.py --commands" in recipe[0]


@pytest.mark.skipif(shutil.which("cargo") is None, reason="needs cargo")
def test_rust_is_as_new_as_the_newest_crate_needs():
    words = ["cargo", "metadata", "--offline", "--locked", "--all-features", "--format-version", "1"]
    ended = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    if ended.returncode:
        pytest.skip(f"cargo has not all crates: {ended.stderr[-200:]}")
    needed = {p["name"]: p["rust_version"] or "0" for p in json.loads(ended.stdout)["packages"]}
    own = needed.pop("ftlm")
    newest = max(needed.values(), key=lambda version: [*map(int, version.split("."))])
    assert [*map(int, own.split("."))] == [*map(int, newest.split("."))][:2], needed


def test_every_push_is_checked_by_targets_of_the_makefile():
    text = (ROOT / ".github" / "workflows" / "checks.yml").read_text(encoding="utf-8")
    workflow = yaml.safe_load(text)
    # YAML 1.1 reads the key `on` as true.
    assert set(workflow[True]) == {"push", "pull_request"}
    job = workflow["jobs"]["checks"]
    assert job["steps"][-1]["run"] == "make ${{ matrix.target }}"
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (parts,) = re.findall(r"^test: (.*)$", makefile, re.MULTILINE)
    assert {*job["strategy"]["matrix"]["target"], "wheel-test"} == set(parts.split())


def test_the_citation_has_the_version_of_the_package():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == ftlm.__version__
    assert {"cff-version", "message", "title", "authors"} <= cited.keys()


def test_hosted_machines_are_told_what_there_is():
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8")
    jobs = yaml.safe_load(text)["jobs"]
    systems = {job["runs-on"] for job in jobs.values()} | {
        os for job in jobs.values() for os in job.get("strategy", {}).get("matrix", {}).get("os", [])
    }
    assert {system.split("-")[0] for system in systems if "$" not in system} == {"ubuntu", "macos", "windows"}
    # Images that were taken away, or will be within the year, end a release before it begins.
    assert systems - {system for system in systems if "$" in system} <= {
        "ubuntu-latest",
        "ubuntu-24.04-arm",
        "macos-15-intel",
        "macos-latest",
        "windows-latest",
    }
    suite = jobs["suite"]
    assert suite["strategy"]["matrix"]["os"] == ["macos-latest", "windows-latest"]
    assert any("pytest" in step.get("run", "") for step in suite["steps"])
    assert jobs["tried"]["strategy"]["matrix"]["python"] == ["3.11", "3.12", "3.13", "3.14"]
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([\w-]+):(?!=)", makefile, re.MULTILINE))
    phony = set(re.search(r"^\.PHONY:((?:[^\n\\]|\\\n)*)$", makefile, re.MULTILINE)[1].replace("\\", "").split())
    assert phony == targets
    called = {word for run in re.findall(r"run: make (.*)", text) for word in run.split()}
    assert {"wheels", "wheels-twice", "sdist-test", "wheel-test"} <= called <= phony
    for file in re.findall(r"-r (\S+\.txt)", text):
        assert (ROOT / file).is_file()


def test_the_bill_is_the_notices_with_checksums():
    whole = json.loads((ROOT / "ftlm.cdx.json").read_text(encoding="utf-8"))
    text = (ROOT / "THIRD-PARTY-NOTICES.txt").read_text(encoding="utf-8").split("-" * 80)[0]
    named = set(re.findall(r"^(\S+) (\d\S*): (?=\S)", text, re.MULTILINE))
    assert {(c["name"], c["version"]) for c in whole["components"]} == named
    packages = tomllib.loads((ROOT / "Cargo.lock").read_text())["package"]
    locked = {(p["name"], p["version"]): p.get("checksum") for p in packages}
    for component in whole["components"]:
        assert component["hashes"] == [{"alg": "SHA-256", "content": locked[component["name"], component["version"]]}]
    references = {c["bom-ref"] for c in (whole["metadata"]["component"], *whole["components"])}
    assert {d["ref"] for d in whole["dependencies"]} == references
    assert {on for d in whole["dependencies"] for on in d["dependsOn"]} <= references
    assert "path+file" not in json.dumps(whole)
