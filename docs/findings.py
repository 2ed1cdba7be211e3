"""Writes docs/findings.md, the catalogue of findings: ``python docs/findings.py``."""

from __future__ import annotations

import re
from pathlib import Path

from ftlm.findings import FINDING_CATALOGUE, FINDING_LEVELS, FINDING_TOPICS

PAGE = Path(__file__).with_suffix(".md")
LEAD = """# Findings

What ftlm says about a result, a run, a selection or a frequency response is a record with a code, a level, a subject
(run, output, input, parameter, method) and numbers: `result.findings`, a tuple of `ftlm.Finding`. Sentences and
remedies are rendered from it, and nothing reads them: `result.warnings` are the sentences. Saved models keep the
records. Verdicts count *do not use* first, then *with care*; a *fact* is worth knowing, a *note* says how data were
read. What stands in italics is filled in. `docs/findings.py` writes this page from the catalogue.
"""


def cell(text: str) -> str:
    """Text of a table's cell, with placeholders in italics."""
    shown = re.sub(r"\{ask\[(\w+)(?: is ([\w-]+))?\]\}", lambda m: f"`{m[1]}={repr(m[2]) if m[2] else ''}`", text)
    shown = re.sub(r"\{choose\[[^\]]*\]\}", "`validate`", shown)
    return re.sub(r"\{(\w+)(?::[^}]*)?\}", r"*\1*", shown).replace("|", "").replace("**", "* *")


def page() -> str:
    """The page."""
    parts = [LEAD]
    for level in FINDING_LEVELS:
        parts += [f"## {level.capitalize()}\n", "| code | sentence | remedy |", "| --- | --- | --- |"]
        for code, kind in FINDING_CATALOGUE.items():
            if kind.level == level:
                topic = FINDING_TOPICS[kind.topic]
                remedy = kind.remedy or "; ".join(part for part in (topic.remedy, topic.alternative) if part)
                text = (kind.prefix + kind.template).replace("{remedy}", remedy)
                parts.append(f"| `{code}` | {cell(text)} | {'' if kind.states_remedy else cell(remedy)} |")
        parts.append("")
    return "\n".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
