"""HTML of the web app: whole page, files, models and comparison. All text from files and users is escaped."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from typing import Any

from jinja2 import Environment
from markupsafe import Markup

from ftlm._core import __version__
from ftlm.app.forms import LOSS_NAMES, METHOD_NAMES, OFFSET_KINDS, FittedModel
from ftlm.app.session import MAX_FILE_BYTES, STATE_MADE, STATE_RUNNING, File, Model, Session
from ftlm.data.run import Run
from ftlm.data.units import SIGNAL_UNITS, TIME_UNITS
from ftlm.estimation.verdict import verdict
from ftlm.io.dialect import DATE_ORDERS, DECIMAL_CHARACTERS, SEPARATOR_CHARACTERS, THOUSANDS_CHARACTERS
from ftlm.plot.comparison_charts import comparison_charts
from ftlm.report.html_report import behavior_tables, first_findings, model_title, verdict_box
from ftlm.report.typesetting import equations_html, parameter_table
from ftlm.svg.figure import Figure
from ftlm.svg.html_page import read_resource, style_sheet, templates
from ftlm.svg.line_chart import chart_css
from ftlm.utils.formatting import finite, typeset

_VERDICT_RANKS = {"trust": 0, "with care": 1, "do not use": 2}


@cache
def _templates() -> Environment:
    environment = templates("ftlm.app")
    environment.filters |= {"safe_markup": Markup}
    return environment


def _render_template(template: str, **context: Any) -> str:
    return _templates().get_template(template).render(**context)


@cache
def script() -> str:
    """Return the JavaScript code of the page and its charts."""
    return f"{read_resource('charts.js')}\n{read_resource('app.js', 'ftlm.app')}"


@cache
def style() -> str:
    """Return the CSS style sheet of the page, which includes that of reports."""
    return f"{style_sheet()}\n{chart_css()}\n{read_resource('app.css', 'ftlm.app')}"


def page(session: Session) -> str:
    """Return the HTML of the whole page for the current state of `session`."""
    contents = {
        # The templates escape all text.
        "files": Markup("").join(Markup(file(f)) for f in session.files.values()),
        "models": Markup("").join(Markup(model(m)) for m in reversed(session.models.values())),
        "comparison": Markup(comparison(session)),
    }
    return _render_template(
        "page.html.j2",
        **contents,
        version=__version__,
        most=MAX_FILE_BYTES,
        units=[u for u in SIGNAL_UNITS if u],
        methods=METHOD_NAMES,
        offsets=OFFSET_KINDS,
        losses=LOSS_NAMES,
    )


def file(item: File) -> str:
    """Return the HTML element of a file with its columns, options and assumptions."""
    preview = item.preview
    options = {} if preview is None else preview["options"]
    facts = {
        "name": item.name,
        "run": item.is_run,
        "offers": [] if preview is None else preview["offers"],
        "outputs": list(options.get("outputs", {})),
    }
    return _render_template(
        "file.html.j2",
        file=item,
        preview=preview,
        chosen=options,
        layout=options.get("layout", {}),
        facts=json.dumps(facts),
        separators=list(SEPARATOR_CHARACTERS),
        decimals=list(DECIMAL_CHARACTERS),
        groups=list(THOUSANDS_CHARACTERS),
        dates=DATE_ORDERS,
        time_units=list(TIME_UNITS),
        asked=item.user_options,
        converted={unit: si for unit, (si, factor) in SIGNAL_UNITS.items() if factor != 1.0},
    )


def model(item: Model) -> str:
    """Return the HTML element of a model, whether it is queued, running, finished or failed."""
    return _render_template("model.html.j2", model=item, description=item.description, fit_request=item.fit_request)


def comparison(session: Session) -> str:
    """Return an HTML table of all finished models, by verdict and then by the smallest fit of an output, best first."""
    models = [m for m in session.models.values() if m.state == STATE_MADE and m.description is not None]
    models.sort(key=lambda m: (_VERDICT_RANKS.get((m.description or {})["verdict"]["level"], 3), -_worst_fit(m)))
    outputs = list(dict.fromkeys(f["output"] for m in models for f in (m.description or {})["fits"]))
    fits = {m.key: {f["output"]: f for f in (m.description or {})["fits"]} for m in models}
    return _render_template("comparison.html.j2", models=models, outputs=outputs, fits=fits)


def _worst_fit(item: Model) -> float:
    """Return the smallest fit [%] of a model over its outputs, on validation data if there are any."""
    fits = [f["estimation"] if f["validation"] is None else f["validation"] for f in (item.description or {})["fits"]]
    return min((-1e300 if f is None else float(f) for f in fits), default=-1e300)


def state(session: Session) -> dict[str, Any]:
    """Return the versions of all files, and version, phase and progress of all models, by key, for polling."""
    return {
        "files": {f.key: f.version for f in session.files.values()},
        "models": {
            m.key: {
                "version": m.version,
                "busy": m.is_busy,
                "phase": m.phase if m.state == STATE_RUNNING else m.state,
                "share": m.share,
                "left": m.time_left,
            }
            for m in session.models.values()
        },
    }


#: Maximum number of points per line of a chart, and maximum number of charts per model or run.
MAX_CHART_POINTS = 1500
MAX_FIGURES = 12


def model_summary(fitted_model: FittedModel) -> dict[str, Any]:
    """Return the description of a fitted model for the page, as values that JSON can represent.

    All text in its HTML markup is escaped.
    """
    result, checked = fitted_model.result, fitted_model.validation
    overall_verdict = verdict(result, checked)
    warnings, further = first_findings([*result.findings, *(checked.findings if checked else ())])
    figures = []
    if checked is not None:
        figures += comparison_charts(checked, units=result.model.units, label="validation", points=MAX_CHART_POINTS)
    figures += comparison_charts(
        result.comparison, units=result.model.units, label="estimation", points=MAX_CHART_POINTS
    )
    tables = [parameter_table(result.model, result.joint, result.offsets), *behavior_tables(result.model)]
    choice = fitted_model.choice
    return {
        "title": model_title(result.model),
        "verdict": overall_verdict.to_dict(),
        "box": str(verdict_box(overall_verdict)),
        "equations": [str(e) for e in equations_html(result.model, result.comparison.offsets)],
        "parameter_count": len(result.joint.names) if result.joint is not None else len(result.coefficients),
        "fits": [
            {
                "output": output,
                "unit": result.model.units.get(output, ""),
                "estimation": finite(error_metrics.fit),
                "validation": None if checked is None else finite(checked.output_error[output].fit),
                "rmse": finite(error_metrics.rmse),
            }
            for output, error_metrics in result.output_error.items()
        ],
        "runs": [fitted_model.run.name, None if fitted_model.other is None else fitted_model.other.name],
        "warnings": [str(typeset(w)) for w in warnings],
        "more": [str(typeset(w)) for w in further],
        "figures": figure_markup(figures),
        "tables": [str(t.to_html()) for t in tables],
        "choice": None
        if choice is None
        else {"reason": choice.reason, "tables": [str(t.to_html()) for t in choice.tables()]},
        "script": fitted_model.script,
    }


def figure_markup(figures: Sequence[Figure]) -> list[dict[str, str]]:
    """Return the title, caption, and SVG markup (wide and narrow) of each of the first `MAX_FIGURES` figures."""
    return [
        {"title": str(typeset(f.title)), "wide": str(f.svg), "narrow": str(f.narrow), "caption": str(typeset(f.note))}
        for f in figures[:MAX_FIGURES]
    ]


def run_figures(run: Run) -> list[dict[str, str]]:
    """Return the markup of charts of the signals of a run over time, outputs first; see :func:`figure_markup`."""
    return figure_markup(list(run.plot(*[*run.outputs, *run.inputs][:MAX_FIGURES])))
