"""Write docs/findings.md, the catalogue of findings: ``python docs/findings.py``."""

from __future__ import annotations

import re
from pathlib import Path

from ftlm.findings import FINDING_LEVELS, finding_catalogue

PAGE = Path(__file__).with_suffix(".md")
LEAD = """# Findings

What ftlm says about a result, a run, a selection or a frequency response is a record with a code, a level, a subject
(run, output, input, parameter, method) and numbers: `result.findings`, a tuple of `ftlm.Finding`. Sentences and
remedies are rendered from it, and nothing reads them: `result.warnings` are the sentences. Saved models keep the
records. Verdicts count *do not use* first, then *with care*; a *fact* is worth knowing, a *note* says how data were
read. What stands in italics is filled in. `docs/findings.py` writes this page from the catalogue.
"""


#: Cases whose level was changed: the level before, the code that it has today, and the reason.
CHANGED_LEVELS = (
    ("do not use", "free_run_grows", "a pole on the right by more than 2.33 standard errors"),
    ("do not use", "growth_not_told", "a pole on the right, by less: 20 of 40 true integrators had one"),
    ("do not use", "plant_unstable", "pieces of the run show that the plant itself is unstable"),
    ("do not use", "not_told_apart", "an infinite standard error"),
    ("do not use", "numbers_correlated", "a correlation alone, which intervals hold already"),
    ("do not use", "explains_little", "residuals that follow an input or are not white"),
    ("do not use", "buried_in_noise", "white residuals: the noise is larger than the signal, and nothing is missing"),
    (
        "with care",
        "not_different_from_0",
        "the equation without the term is a structure of its own, such as an integrator",
    ),
    (
        "with care",
        "residuals_not_white",
        "residuals that follow an input, or of a model that is not told to be complete",
    ),
    ("with care", "noise_coloured", "residuals that follow no input: 100 of 100 right models under colored noise"),
    ("with care", "outliers", "up to half of the squares; 40 of 100 runs with a still phase were accused"),
    ("with care", "outliers_dominate", "more than half of the squares"),
    ("with care", "channel_off", "an input acts while the output stands still"),
    ("with care", "signal_constant", "nothing acts: a machine at rest is no dead channel"),
    ("with care", "loop_found", "feedback that biases a number by a standard error"),
    ("with care", "loop_harmless", "feedback that biases none by as much"),
    ("with care", "loop_not_told", "commands and sweeps, of which the data cannot tell: 223 of 370 records"),
    ("with care", "intervals_rough", "a property of the intervals, not a fault of the model"),
    ("with care", "constant_instead_of_past", "both describe the run; one costs fewer numbers"),
    ("with care", "looked_like_rest", "a history was estimated, as the residuals ask"),
    ("fact", "simulated_from_rest", "a comparison that leaves motion out is wrong at its start"),
    ("fact", "rest_assumed", "a constant input: the gain is that of an assumption"),
    ("fact", "prior_pulls", "coefficients of an order search that its prior moves"),
    ("none", "second_optimum", "another optimum as good, with other numbers"),
    ("none", "noise_decides", "an order search whose ranks noise decides"),
    ("none", "start_not_told", "two starts explain a run, with two gains"),
    (
        "none",
        "other_intersample_fits",
        "an input that was not constant between samples, or not linear, as it was taken",
    ),
    ("none", "drift_fits", "levels that drift, which bias every parameter"),
    ("none", "moves_before_input", "an output that leaves its level before its input changes"),
)


def changed_levels() -> list[str]:
    """Return the table of the findings whose severity depends on the case."""
    rows = ["## Levels that were changed\n", "| code | before | now | where |", "| --- | --- | --- | --- |"]
    return rows + [
        f"| `{c}` | {old} | {finding_catalogue().kinds[c].level} | {why} |" for old, c, why in CHANGED_LEVELS
    ]


def cell(text: str) -> str:
    """Return the text of a table cell, with placeholders in italics."""
    shown = re.sub(r"\{ask\[(\w+)(?: is ([\w-]+))?\]\}", lambda m: f"`{m[1]}={repr(m[2]) if m[2] else ''}`", text)
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
    return "\n".join([*parts, *changed_levels(), ""])


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
