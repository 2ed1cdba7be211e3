"""Reports as one HTML file that opens offline: sections with their warnings first, then words, tables and charts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

from jinja2 import Environment, StrictUndefined, Template

from ftlm import __version__
from ftlm.models import write_atomically
from ftlm.report.figures import POINTS, Figure, chart_css, comparison_charts
from ftlm.report.tables import (
    Table,
    equation_html,
    errors_table,
    initial_terms_table,
    number,
    parameter_table,
    search_summary,
    search_top,
    settings_table,
    symbol,
)
from ftlm.validation import as_runs

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence
    from pathlib import Path

    from ftlm.identification import Identification
    from ftlm.runs import Run
    from ftlm.validation import Comparison

__all__ = ["Section", "identification_page", "write_page"]

#: Charts of a page and points in all of them: at no more than 10 bytes a point the page stays below 2 MB.
PAGE_CHARTS = 60
PAGE_POINTS = 120_000


@dataclass(frozen=True)
class Section:
    """One section of a report.

    Parameters
    ----------
    heading
        Heading.
    paragraphs
        Text, escaped unless it is ``Markup``.
    warnings
        Shown first, in a box.
    tables, figures
        See :class:`ftlm.report.Table` and :func:`ftlm.report.line_chart`.
    """

    heading: str
    paragraphs: Sequence[str] = ()
    warnings: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()

    def __post_init__(self) -> None:
        # A text is a sequence of letters, too; nobody wants a paragraph for each.
        for name in ("paragraphs", "warnings"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(resources.files("ftlm.report").joinpath("page.html.j2").read_text("utf-8"))


def write_page(
    path: str | os.PathLike[str], *, title: str, sections: Sequence[Section], lead: str = "", force: bool = False
) -> Path:
    """Write sections as one HTML file.

    Parameters
    ----------
    path
        File to write.
    title
        Title.
    sections
        In their order on the page.
    lead
        What a hurried reader should know, below the title.
    force
        Overwrite an existing file.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or cannot be written.
    """
    page = _template().render(
        title=title, lead=lead, sections=list(sections), version=__version__, chart_css=chart_css()
    )
    # A name may hold half a surrogate pair, which no file can.
    return write_atomically(path, page.encode("utf-8", "backslashreplace"), force=force)


def identification_page(
    result: Identification,
    path: str | os.PathLike[str],
    *,
    validation: Run | Sequence[Run] | None = None,
    force: bool = False,
) -> Path:
    """Write the report of one identification.

    Parameters
    ----------
    result
        From :func:`ftlm.identify`.
    path
        File to write.
    validation
        Runs that the model was not identified from.
    force
        Overwrite an existing file.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    DataError
        A validation run that does not fit the model; the file exists and ``force`` is not set, or cannot be written.
    """
    model, units = result.model, result.model.units
    others = [] if validation is None else as_runs(validation)
    validated = [result.validate(run) for run in others]
    estimation = ("estimation", result.comparison)
    compared = [estimation, *(("validation", c) for c in validated)]

    warnings = list(result.warnings)
    for run, found in zip(others, validated, strict=True):
        warnings += [f"validation run {run.name}: {w.removeprefix(run.name + ': ')}" for w in found.warnings]
        warnings += [f"validation run {run.name}: {w}" for w in run.warnings]
    warnings = list(dict.fromkeys(warnings))
    words = [
        "No check raised a warning. Checked: free run against equation error, orders close to one another or on the "
        "edge of their interval, pull of the prior, coefficient law, stability of the discretisation, the data."
    ]
    if not others:
        words.append("No validation run was given: how well the model predicts other data is not known.")

    charts = sum(len(c.per_run) for _, c in compared) * len(model.outputs)
    # Two lines a chart, drawn once wide and once narrow with half the points.
    points = min(POINTS, PAGE_POINTS // (3 * min(charts, PAGE_CHARTS)))
    drawn = [f for label, c in compared for f in comparison_charts(c, units=units, label=label, points=points)]
    titled = ((f"Initial terms of the free runs, {label}", c) for label, c in compared)
    initial = [t for title, c in titled if (t := initial_terms_table(c, title=title)) is not None]
    sections = [
        Section("Warnings", words[1:] if warnings else words, warnings),
        Section(
            "Equations", [equation_html(e) for e in model.equations], tables=[parameter_table(model, result.joint)]
        ),
        Section("Errors", tables=[errors_table(compared, units=units)]),
        Section(
            "Measured and simulated",
            f"{charts - PAGE_CHARTS} further charts are left out; the table above has every run."
            if charts > PAGE_CHARTS
            else (),
            figures=drawn[:PAGE_CHARTS],
        ),
    ]
    if result.searches:
        tops = [search_top(name, found) for name, found in result.searches.items()]
        sections.append(Section("Order search", tables=[search_summary(result.searches), *tops]))
    sections.append(Section("Settings", tables=[settings_table(result), *initial]))
    return write_page(path, title=model.structure.name, sections=sections, lead=_lead(compared), force=force)


def _lead(compared: Sequence[tuple[str, Comparison]]) -> str:
    """Return the fits of the free runs, in a sentence a data set."""
    sentences = []
    for label, found in compared:
        fits = ", ".join(f"{symbol(name)} {number(fit, 4)}\u00a0%" for name, fit in found.fit_percent.items())
        runs = ", ".join(name for name, _, _ in found.per_run)
        sentences.append(f"Fit of the free run, {label} ({runs}): {fits}.")
    return " ".join(sentences)
