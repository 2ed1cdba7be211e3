"""Results as fragments of HTML for notebooks: equations typeset, tables, warnings first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from markupsafe import Markup

from ftlm.report.tables import (
    Table,
    equation_html,
    errors_table,
    parameter_table,
    residual_table,
    search_top,
    symbol_html,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ftlm.identification import Identification
    from ftlm.models import Model
    from ftlm.order_search import SearchResult
    from ftlm.report.tables import Cell
    from ftlm.residuals import Residuals
    from ftlm.validation import Comparison

__all__ = ["comparison_html", "identification_html", "model_html", "residuals_html", "search_html"]


def _warned(warnings: Sequence[str]) -> Markup:
    if not warnings:
        return Markup("")
    items = Markup("").join(Markup("<li>{}</li>").format(w) for w in warnings)
    return Markup("<p><strong>Warnings</strong></p><ul>{}</ul>").format(items)


def model_html(model: Model) -> str:
    """Return the equations of a model and its parameters."""
    lines = Markup("").join(Markup("<p>{}</p>").format(equation_html(e)) for e in model.equations)
    known = model.orders or any(t.name for e in model.equations for t in e.terms)
    return str(lines + parameter_table(model).to_html() if known else lines)


def comparison_html(found: Comparison) -> str:
    """Return both errors of every run, warnings first."""
    return str(_warned(found.warnings) + errors_table([("compared", found)]).to_html())


def residuals_html(tests: Residuals) -> str:
    """Return every residual test with its verdict."""
    return str(residual_table(tests, title=f"Residual tests: {', '.join(tests.runs)}").to_html())


def search_html(found: SearchResult) -> str:
    """Return the best rows of an order search and what became of the rest."""
    rows: list[list[Cell]] = [["kept", len(found.table)]]
    rows += [[reason, count] for reason, count in found.pruned.items()]
    name = found.model.outputs[0] if len(found.model.outputs) == 1 else "stage"
    rest = Table(f"{found.candidates} candidates", ("became of them", "count"), rows)
    return str(search_top(name, found).to_html() + rest.to_html())


def identification_html(result: Identification) -> str:
    """Return warnings, equations, parameters with intervals, both errors and the residual verdicts."""
    model = result.model
    parts = [_warned(result.warnings)]
    parts += [Markup("<p>{}</p>").format(equation_html(e)) for e in model.equations]
    parts.append(parameter_table(model, result.joint).to_html())
    parts.append(errors_table([("estimation", result.comparison)], units=model.units).to_html())
    if result.residuals is not None:
        verdicts = [
            Markup("{}: residuals {}, {} of the inputs").format(
                symbol_html(o), "white" if white else "not white",
                "independent" if result.residuals.independent[o] else "not independent",
            )
            for o, white in result.residuals.white.items()
        ]  # fmt: skip
        parts.append(Markup("<p>{} (99 %).</p>").format(Markup("; ").join(verdicts)))
    return str(Markup("").join(parts))
