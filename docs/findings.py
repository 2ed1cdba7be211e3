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


#: Cases whose level was changed: the level before, the code that it has today, and the reason.
CHANGED_LEVELS = (
    ("do not use", "simulation_unbounded", "a pole in the right half-plane, by more than 2.33 standard errors"),
    ("do not use", "instability_not_significant", "a pole in the right half-plane, by less: 20 of 40 true integrators"),
    ("do not use", "plant_unstable", "pieces of the run show that the plant itself is unstable"),
    ("do not use", "not_separately_identifiable", "an infinite standard error"),
    ("do not use", "parameters_correlated", "a correlation alone, which intervals include already"),
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
        "residuals that follow an input, or a model that is not known to be complete",
    ),
    ("with care", "noise_coloured", "residuals that follow no input: 100 of 100 right models under colored noise"),
    ("with care", "outliers", "up to half of the sum of squares; it was false on 40 of 100 runs with a phase at rest"),
    ("with care", "outliers_dominate", "more than half of the sum of squares"),
    ("with care", "channel_off", "an input acts while the output is constant"),
    ("with care", "signal_constant", "no input acts: a machine at rest does not have a dead channel"),
    ("with care", "loop_found", "feedback that biases a parameter by a standard error"),
    ("with care", "loop_harmless", "feedback that biases no parameter by as much"),
    (
        "with care",
        "feedback_inconclusive",
        "commands and sweeps, for which the test is inconclusive: 223 of 370 records",
    ),
    ("with care", "intervals_rough", "a property of the intervals, not a fault of the model"),
    ("with care", "constant_instead_of_past", "both describe the run; one needs fewer parameters"),
    ("with care", "rest_rejected", "nonzero initial conditions were estimated, because the residuals require it"),
    ("fact", "simulated_from_rest", "a comparison that leaves motion out is wrong at its start"),
    ("fact", "rest_assumed", "a constant input: the gain is that of an assumption"),
    ("fact", "prior_shifts_estimate", "an order search whose prior changes the coefficients"),
    ("none", "second_optimum", "another optimum as good, with other parameters"),
    ("none", "tied_orders_far_apart", "an order search in which noise decides the ranks"),
    ("none", "gain_depends_on_initial_conditions", "two initial conditions explain a run, with two gains"),
    (
        "none",
        "other_intersample_fits",
        "an input whose behavior between samples was not as assumed (constant or linear)",
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
