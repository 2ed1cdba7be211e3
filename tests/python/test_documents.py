"""The Python blocks of the README run as they stand, its commands exist, and what it links is there."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


def test_the_python_blocks_run_one_after_the_other(tmp_path: Path) -> None:
    found = blocks("python")
    assert len(found) >= 2
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(found)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "order search (y)" in ran.stdout


def commands() -> list[str]:
    text = "\n".join(blocks("sh")).replace("\\\n", " ")
    return [line for line in text.splitlines() if line.startswith("ftlm ")]


@pytest.mark.parametrize("command", commands())
def test_every_command_and_option_of_the_readme_exists(command: str) -> None:
    words = shlex.split(command, comments=True)
    shown = subprocess.run(
        [sys.executable, "-m", "ftlm", words[1], "--help"], capture_output=True, text=True, check=False, env=wide()
    )
    assert shown.returncode == 0, shown.stderr
    for word in words[2:]:
        if re.fullmatch(r"--?[a-z][\w-]*", word):
            assert re.search(rf"{re.escape(word)}\b", shown.stdout), f"{word} is no option of ftlm {words[1]}"


def wide() -> dict[str, str]:
    import os

    return {**os.environ, "COLUMNS": "250", "NO_COLOR": "1", "TERM": "dumb"}


def test_linked_files_exist() -> None:
    for document in ("README.md", "CONTRIBUTING.md"):
        text = (ROOT / document).read_text(encoding="utf-8")
        for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", text):
            assert (ROOT / target).exists(), f"{document} links {target}"


def test_the_map_names_only_what_exists() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for row in re.findall(r"^\| (`.*?) \|", text, flags=re.MULTILINE):
        names = re.findall(r"`([^`]+)`", row)
        folder = Path(names[0]).parent if not names[0].endswith("/") else Path()
        for name in names:
            path = ROOT / name if "/" in name else ROOT / folder / name
            assert path.exists(), f"the map names {name}"


def test_every_module_stands_on_the_map() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for file in sorted((ROOT / "python/ftlm").glob("*.py")):
        if file.stem not in ("__init__", "__main__", "errors"):
            assert f"{file.name}`" in text, f"{file.name} is not on the map"
    for file in sorted((ROOT / "rust").glob("*.rs")):
        if file.stem not in ("lib", "error"):
            assert f"{file.name}`" in text, f"{file.name} is not on the map"
