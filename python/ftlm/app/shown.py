"""A model as the page shows it: verdict first, then the equation, its fits, its picture, its numbers."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from ftlm.app.recipe import Made
from ftlm.data.run import Run
from ftlm.identification.first import behaviour_tables, first_warnings, title_of, verdict_box
from ftlm.judge.charts import comparison_charts
from ftlm.judge.metrics import finite
from ftlm.model.typesetting import equations_html, parameter_table
from ftlm.paint.figure import Figure

#: Points of a line on the page, and pictures of a model or a run.
POINTS = 1500
MOST = 12


def shown(made: Made) -> dict[str, Any]:
    """All that the page shows of a model, markup of escaped parts."""
    result, checked = made.result, made.checked
    judged = result.verdict(checked)
    warnings, left = first_warnings(list(dict.fromkeys([*result.warnings, *(checked.warnings if checked else ())])))
    figures = []
    if checked is not None:
        figures += comparison_charts(checked, units=result.model.units, label="validation", points=POINTS)
    figures += comparison_charts(result.comparison, units=result.model.units, label="estimation", points=POINTS)
    tables = [parameter_table(result.model, result.joint), *behaviour_tables(result.model)]
    choice = made.choice
    return {
        "title": title_of(result.model),
        "verdict": judged.to_dict(),
        "box": str(verdict_box(judged)),
        "equations": [str(e) for e in equations_html(result.model, result.comparison.offsets)],
        "numbers": len(result.joint.names) if result.joint is not None else len(result.coefficients),
        "fits": [
            {
                "output": output, "unit": result.model.units.get(output, ""), "estimation": finite(own.fit),
                "validation": None if checked is None else finite(checked.output_error[output].fit),
                "rmse": finite(own.rmse),
            }
            for output, own in result.output_error.items()
        ],
        "runs": [made.run.name, None if made.other is None else made.other.name],
        "warnings": [str(Markup("{}").format(w)) for w in warnings],
        "more": [str(Markup("{}").format(w)) for w in left],
        "figures": drawn(figures),
        "tables": [str(t.to_html()) for t in tables],
        "choice": None if choice is None else {"reason": choice.reason, "table": str(choice.table().to_html())},
        "script": made.script,
    }  # fmt: skip


def drawn(figures: list[Figure]) -> list[dict[str, str]]:
    """Figures for screens wide and narrow."""
    return [
        {"title": f.title, "wide": str(f.svg), "narrow": str(f.narrow), "caption": f.caption} for f in figures[:MOST]
    ]


def pictures(run: Run) -> list[dict[str, str]]:
    """A run's signals over time, outputs first."""
    return drawn(list(run.plot(*[*run.outputs, *run.inputs][:MOST])))
