"""Write docs/findings.md, the catalogue of findings: ``python docs/findings.py``."""

from __future__ import annotations

import re
from pathlib import Path

from ftlm.findings import FINDING_LEVELS, finding_catalogue

PAGE = Path(__file__).with_suffix(".md")
LEAD = """# Findings

A finding (`ftlm.Finding`) is a record of what ftlm reports about a result, a run, a selection or a frequency response.
It has a code, a level, a subject (run, output, input, parameter, method) and numbers. `result.findings` is the tuple
of findings, and `result.warnings` has their sentences. Sentences and remedies are formatted from the records, and no
code depends on their wording. Saved models keep the records. A verdict follows from the most severe level: *do not
use*, then *with care*. A *fact* and a *note* do not change it; a note states how data were read. Words in italics
stand for values. `docs/findings.py` writes this page from the catalogue.
"""


def cell(text: str) -> str:
    """Return the text of a table cell, with placeholders in italics."""
    shown = re.sub(r"\{option\[(\w+)(?: is ([\w-]+))?\]\}", lambda m: f"`{m[1]}={repr(m[2]) if m[2] else ''}`", text)
    shown = re.sub(r"\{choose\[[^\]]*\]\}", "`validate`", shown)
    return re.sub(r"\{(\w+)(?::[^}]*)?\}", r"*\1*", shown).replace("|", "").replace("**", "* *")


def page() -> str:
    """Return the page as Markdown."""
    parts = [LEAD]
    for level in FINDING_LEVELS:
        parts += [f"## {level.capitalize()}\n", "| code | sentence | remedy |", "| --- | --- | --- |"]
        for code, kind in finding_catalogue().kinds.items():
            if kind.level == level:
                topic = finding_catalogue().topics[kind.topic]
                remedy = kind.remedy or "; ".join(part for part in (topic.remedy, topic.alternative) if part)
                text = (kind.prefix + kind.template).replace("{remedy}", remedy)
                parts.append(f"| `{code}` | {cell(text)} | {'' if kind.states_remedy else cell(remedy)} |")
        parts.append("")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
