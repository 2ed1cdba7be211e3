"""Pages of the reference, one a topic, and an index of one line per name, from reference.toml and the docstrings."""

from __future__ import annotations

import inspect
import pydoc
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Topic:
    """Topic of the reference.

    Parameters
    ----------
    title, text
        Heading and introduction of its page, as reStructuredText.
    names
        Shown members by the full name of a function or class; "*" stands for all public members.
    """

    title: str
    text: str
    names: dict[str, list[str]]


def topics() -> dict[str, Topic]:
    """Return the topics by the name of their page, in the order in which data flows."""
    return {page: Topic(**row) for page, row in tomllib.loads((HERE / "reference.toml").read_text("utf-8")).items()}


def object_of(name: str) -> Any:
    """Return the object of a full name."""
    found = pydoc.locate(name)
    if found is None:
        raise LookupError(f"reference.toml: {name} does not exist; correct the name")
    return found


def directive(name: str, members: list[str]) -> str:
    """Return the directive of a function or class with its members."""
    kind = "class" if inspect.isclass(object_of(name)) else "function"
    shown = [f"   :members: {'' if members == ['*'] else ', '.join(members)}".rstrip()] if members else []
    return "\n".join([f".. auto{kind}:: {name}", *shown, ""])


def topic_page(topic: Topic) -> str:
    """Return the page of a topic."""
    directives = [directive(name, members) for name, members in topic.names.items()]
    return "\n".join([topic.title, "=" * len(topic.title), "", topic.text, "", *directives])


def summary(name: str) -> str:
    """Return the first line of a docstring."""
    return (inspect.getdoc(object_of(name)) or "").partition("\n")[0]


def index() -> str:
    """Return the names of all topics with a line each, and the hidden contents."""
    lines = [".. toctree::", "   :hidden:", "", *(f"   _reference/{page}" for page in topics()), ""]
    for page, topic in topics().items():
        lines += [f".. rubric:: :doc:`{topic.title} <_reference/{page}>`", "   :heading-level: 2", "", topic.text, ""]
        lines += [".. list-table::", "   :class: names", "   :widths: 34 66", ""]
        for name in topic.names:
            lines += [f"   * - :py:obj:`{name} <{name}>`", f"     - {summary(name)}"]
        lines.append("")
    return "\n".join(lines)


def write(folder: Path) -> None:
    """Write the pages and the index (``index.txt``), and remove pages of topics that no longer exist."""
    folder.mkdir(exist_ok=True)
    pages = {f"{page}.rst": topic_page(topic) for page, topic in topics().items()} | {"index.txt": index()}
    for path in folder.iterdir():
        if path.name not in pages:
            path.unlink()
    for name, text in pages.items():
        path = folder / name
        # Sphinx reads pages again that are newer than its last build.
        if not path.exists() or path.read_text("utf-8") != text:
            path.write_text(text, encoding="utf-8")
