"""Every Python block of the README and of the pages runs as it stands, commands exist, links lead somewhere."""

from __future__ import annotations

import importlib.util
import inspect
import json
import pydoc
import re
import shlex
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ftlm
from command_line import run_command
from slow_cases import slow_after

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = sorted([*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")])
DOCUMENTS = [README, *PAGES]


def blocks(document: Path, language: str) -> list[str]:
    text = document.read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)


#: What takes long on a page, with what takes its place by default; make test-slow runs these pages as they stand.
SHORTENED = {
    "arm.md": {"duration=6.0": "duration=2.0", "increment=0.2": "increment=0.3"},
    "choosing.md": {"601": "401"},
    "control.md": {"run.resample(0.008)": "run.resample(0.032)", "duration=10,": "duration=6,"},
    "own_algorithm.md": {"M, increment = 2048, 0.1": "M, increment = 1024, 0.2"},
}
WITH_BLOCKS = [d for d in DOCUMENTS if blocks(d, "python")]


@slow_after(
    len(WITH_BLOCKS),
    "document, shortened",
    [*((d, True) for d in WITH_BLOCKS), *((d, False) for d in WITH_BLOCKS if d.name in SHORTENED)],
    ids=lambda case: case.name if isinstance(case, Path) else "" if case else "as it stands",
)
def test_the_python_blocks_run_one_after_the_other(
    document: Path,
    shortened: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    found = blocks(document, "python")
    program = "\n".join(found)
    if shortened:
        for text, shorter in SHORTENED.get(document.name, {}).items():
            assert text in program
            program = program.replace(text, shorter)
    monkeypatch.chdir(tmp_path)
    exec(compile(program, str(document), "exec"), {"__name__": "__main__"})
    out = capsys.readouterr().out
    if document == README or document.name == "nonlinear.md":
        printed = "".join(blocks(document, "text"))
        # Lines break at the width of the terminal.
        assert words_of(" ".join(printed.split())) == words_of(" ".join(out.split()))
    if document.name == "start.md":
        assert len(found) >= 2
        assert "order search (y)" in out
    if document.name == "tutorial.md":
        assert (tmp_path / "model.html").stat().st_size > 50_000


def words_of(text: str) -> list[Any]:
    """Words of a text; numbers equal where they agree to three digits, as those of another processor do."""
    numbers = r"-?\d+\.\d+"
    return [
        pytest.approx(float(w), rel=2e-3) if re.fullmatch(numbers, w) else w
        for w in re.split(f"({numbers}|\\s+)", text)
    ]


def test_the_pages_that_teach_have_blocks_that_run() -> None:
    own = {"motor.md", "battery.md", "heat.md", "flexible_arm.md", "matlab.md"}
    assert own | {"start.md", "tutorial.md", "arm.md", "choosing.md", "numbers.md", "comparison.md"} <= {
        d.name for d in PAGES if blocks(d, "python")
    }


def test_the_commands_of_the_tutorial_run(tmp_path: Path) -> None:
    tutorial = ROOT / "docs" / "tutorial.md"
    made = subprocess.run(
        [sys.executable, "-c", blocks(tutorial, "python")[0]], cwd=tmp_path, capture_output=True, check=False
    )
    assert made.returncode == 0, made.stderr
    for command in commands_of(blocks(tutorial, "sh")[-1]):
        ran = run_command(*shlex.split(command)[1:], cwd=tmp_path)
        assert ran.returncode == 0, command + ran.stdout + ran.stderr
    assert (tmp_path / "model.html").exists()


def test_the_parameter_file_of_the_rig_page_is_read(tmp_path: Path) -> None:
    (text,) = blocks(ROOT / "docs" / "rig.md", "toml")
    path = tmp_path / "arm.toml"
    path.write_text(text, encoding="utf-8")
    assert ftlm.rig.ArmParameters.load(path).stage1.coulomb == 0.08


def commands_of(text: str) -> list[str]:
    return [line for line in text.replace("\\\n", " ").splitlines() if line.startswith("ftlm ")]


def commands() -> list[str]:
    found = [command for d in DOCUMENTS for block in blocks(d, "sh") for command in commands_of(block)]
    return list(dict.fromkeys(found))


@pytest.mark.parametrize("command", commands())
def test_every_command_and_option_of_the_documents_exists(command: str) -> None:
    words = shlex.split(command, comments=True)
    shown = help_of(words[1])
    for word in words[2:]:
        if re.fullmatch(r"--?[a-z][\w-]*", word):
            assert re.search(rf"{re.escape(word)}\b", shown), f"{word} is no option of ftlm {words[1]}"


@cache
def help_of(name: str) -> str:
    """Help of a command."""
    shown = run_command(name, "--help", columns=250)
    assert shown.returncode == 0, shown.stderr
    return shown.stdout


def wide() -> dict[str, str]:
    import os

    return {**os.environ, "COLUMNS": "250", "NO_COLOR": "1", "TERM": "dumb"}


@pytest.mark.parametrize("document", [*DOCUMENTS, ROOT / "CONTRIBUTING.md"], ids=lambda d: d.name)
def test_linked_files_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)", text):
        assert (document.parent / target).exists(), f"{document.name} links {target}"


NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


@pytest.mark.parametrize(
    "notebook",
    [pytest.param(p, marks=pytest.mark.slow if p.stem == "flexible_link" else ()) for p in NOTEBOOKS],
    ids=[p.stem for p in NOTEBOOKS],
)
def test_the_notebooks_run(notebook: Path, tmp_path: Path) -> None:
    script = (
        "import sys, nbformat, nbclient\n"
        "notebook = nbformat.read(sys.argv[1], as_version=4)\n"
        "nbclient.NotebookClient(notebook, timeout=240, kernel_name='python3').execute()\n"
        "kinds = [set(o.get('data', {})) for c in notebook.cells for o in c.get('outputs', [])]\n"
        "print(sum('text/html' in k for k in kinds), sum('image/png' in k for k in kinds))\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", script, str(notebook)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**wide(), "IPYTHONDIR": str(tmp_path)},
    )
    assert ran.returncode == 0, ran.stderr[-3000:]
    rich, pictures = map(int, ran.stdout.split())
    assert rich >= 3
    assert pictures >= 2


def test_notebooks_are_kept_without_output() -> None:
    assert len(NOTEBOOKS) >= 2
    for notebook in NOTEBOOKS:
        cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
        assert all(not c.get("outputs") and c.get("execution_count") is None for c in cells), notebook.name


def test_the_changelog_is_short_and_has_the_sections_of_keep_a_changelog() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 1000
    entries = [line.removeprefix("- ") for line in text.splitlines() if line.startswith("- ")]
    assert len(entries) > 40
    assert [line for line in entries if len(line.split()) > 20] == []
    sections = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}
    assert set(re.findall(r"^### (.*)$", text, flags=re.MULTILINE)) <= sections


def test_every_page_is_in_the_contents() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = re.findall(r"```\{toctree\}\n:hidden:\n:caption: .*?\n\n(.*?)```", index, re.DOTALL)
    assert len(listed) == 4
    there = {d.relative_to(ROOT / "docs").with_suffix("").as_posix() for d in PAGES}
    assert sorted(" ".join(listed).split()) == sorted(there - {"index"})


def test_negative_numbers_have_minus_signs_in_prose_and_hyphens_in_code(monkeypatch: pytest.MonkeyPatch) -> None:
    core = pytest.importorskip("docutils.core")
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from signs import MinusSigns

    document = core.publish_doctree("Between -1 and -0.5, ``a = -1``, one-sided, p -q.\n\n::\n\n  b = -2\n")
    MinusSigns(document).apply()
    assert document.astext() == "Between −1 and −0.5, a = -1, one-sided, p -q.\n\nb = -2"


def test_every_formula_of_the_pages_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from formulas import draw

    drawn_formulas: set[str] = set()
    for document in PAGES:
        text = re.sub(r"^```.*?^```", "", document.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
        found = re.findall(r"\$\$(.+?)\$\$|\$(.+?)\$", re.sub(r"`[^`\n]*`", "", text), flags=re.DOTALL)
        for formula in {*map("".join, found)} - drawn_formulas:
            drawn = draw(formula)
            assert drawn.startswith("<svg"), (document.name, formula)
            assert "http" not in drawn
        drawn_formulas |= {*map("".join, found)}
        if document.name == "mathematics.md":
            assert len(found) > 100


def test_lines_break_in_formulas_after_relations_and_signs_outside_brackets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from formulas import split_at_breaks

    formula = r"D^\alpha y = -\frac{a + b}{2} (c - d) + e_{i+1} \leq \left(f - g\right)^+ u"
    broken = [r"D^\alpha y =", r" -\frac{a + b}{2} (c - d) +", r" e_{i+1} \leq", r" \left(f - g\right)^+ u"]
    assert split_at_breaks(formula) == broken


def test_the_reference_names_every_public_name() -> None:
    topics = tomllib.loads((ROOT / "docs" / "reference.toml").read_text(encoding="utf-8"))
    listed = [name for topic in topics.values() for name in topic["names"]]
    assert len(listed) == len(set(listed))
    for name in ftlm.__all__:
        if name not in ("PARAMETER_SETS", "__version__") and not inspect.ismodule(getattr(ftlm, name)):
            assert f"ftlm.{name}" in listed, f"{name} is not in docs/reference.toml"


def test_the_reference_has_a_page_per_topic_and_a_line_per_name(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import reference

    (tmp_path / "former.rst").write_text("", encoding="utf-8")
    reference.write(tmp_path)
    topics = reference.topics()
    assert {p.name for p in tmp_path.iterdir()} == {"index.txt", *(f"{page}.rst" for page in topics)}
    index = (tmp_path / "index.txt").read_text(encoding="utf-8")
    for page, topic in topics.items():
        text = (tmp_path / f"{page}.rst").read_text(encoding="utf-8")
        assert re.findall(r"^\.\. auto\w+:: (.*)$", text, flags=re.MULTILINE) == list(topic.names)
        for name in topic.names:
            ((line),) = re.findall(rf"`{re.escape(name)} <.*>`\n     - (.*)$", index, flags=re.MULTILINE)
            assert 10 < len(line) <= 120, name


def test_the_map_names_only_what_exists() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for row in re.findall(r"^\| (`.*?) \|", text, flags=re.MULTILINE):
        names = re.findall(r"`([^`]+)`", row)
        folder = Path(names[0]).parent if not names[0].endswith("/") else Path()
        for name in names:
            path = ROOT / name if "/" in name else ROOT / folder / name
            assert path.exists(), f"the map names {name}"


def test_the_map_names_parts_and_steps_that_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for first, contents in re.findall(r"^\| `([^`]+)`.*? \| (.*) \|$", text, flags=re.MULTILINE):
        for name in re.findall(r"`([\w./]+(?:/|\.(?:rs|py|toml)))`", contents):
            top = ROOT / ("rust" if first.startswith("rust") else "python/ftlm")
            assert any(top.rglob(name.rstrip("/"))), f"the map names {name}"
    steps = re.findall(r"^\d+\. .*: `([\w.]+)`\.$", text, flags=re.MULTILINE)
    assert len(steps) == 10
    for step in steps:
        assert callable(pydoc.locate(f"ftlm.{step}")), step
    for name in re.findall(r"`((?:tests|docs|benches|examples)/[\w./]*)`", text):
        assert (ROOT / name).exists(), name


def test_every_module_stands_on_the_map() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for file in sorted((ROOT / "python/ftlm").glob("*.py")):
        if file.stem not in ("__init__", "__main__", "errors"):
            assert f"{file.name}`" in text, f"{file.name} is not on the map"
    for file in sorted((ROOT / "rust").glob("*.rs")):
        if file.stem not in ("lib", "error"):
            assert f"{file.name}`" in text, f"{file.name} is not on the map"
    for folder in ("python/ftlm", "rust"):
        for file in sorted((ROOT / folder).glob("*/*")):
            inside = file.parent.relative_to(ROOT).as_posix()
            if file.suffix in (".py", ".rs"):
                assert f"`{inside}/`" in text, f"{inside} is not on the map"


def test_the_catalogue_of_findings_is_the_packages_own():
    spec = importlib.util.spec_from_file_location("findings_page", ROOT / "docs" / "findings.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    # Otherwise: python docs/findings.py
    assert module.PAGE.read_text(encoding="utf-8") == module.page()


def test_every_tutorial_shows_its_validation_data_and_the_simulation() -> None:
    pytest.importorskip("matplotlib")
    specification = importlib.util.spec_from_file_location("pictures", ROOT / "docs" / "pictures.py")
    assert specification is not None
    assert specification.loader is not None
    pictures = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(pictures)
    drawn = pictures.tutorials()
    pages = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
    assert len(pages) == len(drawn)
    for page in pages:
        shown = re.findall(r"^```{image} ../_pictures/(.*)\.svg\n:alt: \S", page.read_text(), flags=re.MULTILINE)
        assert shown == [f"tutorial-{page.stem}"]
        measured, *models = drawn[shown[0]].axes[0].lines
        assert models
        assert measured.get_label().startswith("measured, ")
        # The simulation of the first model follows the data.
        spread = np.ptp(measured.get_ydata())
        assert np.max(np.abs(models[0].get_ydata() - measured.get_ydata())) < 0.1 * spread
