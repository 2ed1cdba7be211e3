"""HTML of the page, of its files and of its models; the templates escape all text from files and users."""

from __future__ import annotations

import json
import re
from functools import cache
from importlib import resources
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from ftlm._core import __version__
from ftlm.app.forms import LOSSES, METHODS, OFFSETS, Made
from ftlm.app.session import MADE, MOST_BYTES, RUNNING, Desk, File, Model
from ftlm.data.run import Run
from ftlm.data.units import TIME_UNITS, UNITS
from ftlm.io.dialect import DATES, DECIMALS, GROUPS, SEPARATORS
from ftlm.plot.comparison_charts import comparison_charts
from ftlm.report.html_report import behaviour_tables, first_warnings, title_of, verdict_box
from ftlm.report.typesetting import equations_html, parameter_table
from ftlm.svg.figure import Figure
from ftlm.svg.html_page import chart_script, look
from ftlm.svg.line_chart import chart_css
from ftlm.utils.formatting import number
from ftlm.validation.comparison import finite

#: Label of the form field of each Python argument.
_FIELDS = {
    "step": "Step",
    "resample": "Put on the step",
    "time_unit": "Unit of time",
    "missing": "Gaps",
    "separator": "Between cells",
    "decimal": "Decimals",
    "thousands": "Between thousands",
    "skip": "Lines above the table",
    "header": "Lines of header",
    "dates": "Dates",
    "encoding": "Encoding",
    "sheet": "Sheet",
    "slice": "From” and “To",
}
#: Python argument with its value, or with a placeholder in capitals.
_ARGUMENT = re.compile(
    r"\b(resample|time_unit|missing|step|time|slice)=(?:'([\w-]+)'|(\d[\w.+-]*\w|\d)|[A-Z]+\b)?|layout=dict\((\w+)=[^)]*\)"
)
_PLAIN = (
    (re.compile(r" \(commands: [^)]*\)"), ""),
    (re.compile(r"inputs=\{name: column\} and outputs=\{name: column\}"), "the roles below"),
)
_ORDER = {"trust": 0, "with care": 1, "do not use": 2}


def _field(found: re.Match[str]) -> str:
    """Label of the form field of an argument, with its value."""
    name, value = found[1] or found[4], found[2] or found[3]
    shown = "the role “time”" if name == "time" else f"the field “{_FIELDS.get(name, name)}”"
    return f"{shown} {value}" if value else shown


def _read(name: str) -> str:
    return resources.files("ftlm.app").joinpath(name).read_text("utf-8")


@cache
def _templates() -> Environment:
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, loader=FunctionLoader(_read)
    )
    environment.filters |= {"number": number, "page_words": page_words, "safe_markup": Markup}
    return environment


def _rendered(template: str, **told: Any) -> str:
    return _templates().get_template(template).render(**told)


@cache
def script() -> str:
    """Return the script of the page, after that of its charts."""
    return f"{chart_script()}\n{_read('app.js')}"


@cache
def style() -> str:
    """Return the style of reports and of the page."""
    return f"{look()}\n{chart_css()}\n{_read('app.css')}"


def page_words(text: str) -> str:
    """Return an error message with form labels in place of Python arguments."""
    for pattern, words in _PLAIN:
        text = pattern.sub(words, text)
    return _ARGUMENT.sub(_field, text)


def page(desk: Desk) -> str:
    """Return the whole page in its current state."""
    parts = {
        "files": Markup("").join(Markup(file(f)) for f in desk.files.values()),  # escaped by its template
        "models": Markup("").join(Markup(model(m)) for m in reversed(desk.models.values())),
        "comparison": Markup(comparison(desk)),
    }
    return _rendered(
        "page.html.j2",
        **parts,
        version=__version__,
        most=MOST_BYTES,
        units=[u for u in UNITS if u],
        methods=METHODS,
        offsets=OFFSETS,
        losses=LOSSES,
    )


def file(shown: File) -> str:
    """Return a file with its columns and assumptions."""
    told = shown.told
    chosen = {} if told is None else told["options"]
    facts = {
        "name": shown.name,
        "run": shown.is_run,
        "offers": [] if told is None else told["offers"],
        "outputs": list(chosen.get("outputs", {})),
    }
    return _rendered(
        "file.html.j2",
        file=shown,
        told=told,
        chosen=chosen,
        layout=chosen.get("layout", {}),
        facts=json.dumps(facts),
        separators=list(SEPARATORS),
        decimals=list(DECIMALS),
        groups=list(GROUPS),
        dates=DATES,
        time_units=list(TIME_UNITS),
        asked=shown.asked,
    )


def model(shown: Model) -> str:
    """Return a model in any state."""
    return _rendered("model.html.j2", model=shown, told=shown.told, recipe=shown.recipe)


def comparison(desk: Desk) -> str:
    """Return a table of the models, the most trustworthy first."""
    made = [m for m in desk.models.values() if m.state == MADE and m.told is not None]
    made.sort(key=lambda m: (_ORDER.get((m.told or {})["verdict"]["level"], 3), -_worst(m)))
    outputs = list(dict.fromkeys(f["output"] for m in made for f in (m.told or {})["fits"]))
    fits = {m.key: {f["output"]: f for f in (m.told or {})["fits"]} for m in made}
    return _rendered("comparison.html.j2", models=made, outputs=outputs, fits=fits)


def _worst(shown: Model) -> float:
    """Worst fit of a model, on validation data if there are any."""
    fits = [f["estimation"] if f["validation"] is None else f["validation"] for f in (shown.told or {})["fits"]]
    return min((-1e300 if f is None else float(f) for f in fits), default=-1e300)


def state(desk: Desk) -> dict[str, Any]:
    """Return versions and progress of files and models, for polling by the page."""
    return {
        "files": {f.key: f.version for f in desk.files.values()},
        "models": {
            m.key: {
                "version": m.version,
                "busy": m.is_busy,
                "phase": m.phase if m.state == RUNNING else m.state,
                "share": m.share,
                "left": m.left,
            }
            for m in desk.models.values()
        },
    }


#: Points per line of a chart, and charts per model or run.
POINTS = 1500
MOST = 12


def shown(made: Made) -> dict[str, Any]:
    """Return the page content of a model; markup consists of escaped parts."""
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
                "output": output,
                "unit": result.model.units.get(output, ""),
                "estimation": finite(own.fit),
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
    }


def drawn(figures: list[Figure]) -> list[dict[str, str]]:
    """Return the markup of figures for wide and narrow screens."""
    return [
        {"title": f.title, "wide": str(f.svg), "narrow": str(f.narrow), "caption": f.caption} for f in figures[:MOST]
    ]


def pictures(run: Run) -> list[dict[str, str]]:
    """Return charts of a run's signals over time, outputs first."""
    return drawn(list(run.plot(*[*run.outputs, *run.inputs][:MOST])))
