"""Reports as one HTML file that opens offline: sections with their warnings first, then words, tables and charts."""

from __future__ import annotations

import base64
import hashlib
import math
import os
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from jinja2 import Environment, StrictUndefined, Template
from markupsafe import Markup

from ftlm import __version__
from ftlm.errors import DataError
from ftlm.identification import multi_innovation_trace
from ftlm.models import write_atomically
from ftlm.report.figures import (
    POINTS,
    Figure,
    bode_charts,
    chart_css,
    comparison_charts,
    heat_map,
    residual_charts,
    response_frequencies,
    trace_chart,
)
from ftlm.report.landscape import landscape, output_error_landscape
from ftlm.report.tables import (
    Table,
    equation_html,
    errors_table,
    information_table,
    initial_terms_table,
    number,
    parameter_table,
    residual_table,
    search_summary,
    search_top,
    settings_table,
    starts_table,
    symbol,
    symbol_html,
)
from ftlm.residuals import resid
from ftlm.validation import as_runs, compare, lost_fits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ftlm.identification import Identification
    from ftlm.models import Model
    from ftlm.output_error import JointFit
    from ftlm.report.tables import Cell
    from ftlm.residuals import InformationCriteria, Residuals
    from ftlm.runs import Run
    from ftlm.validation import Comparison

__all__ = ["Section", "check_free", "identification_page", "model_page", "write_page"]

#: Charts of a page and points in all of them: at no more than 10 bytes a point the page stays below 2 MB.
PAGE_CHARTS = 60
PAGE_POINTS = 90_000
#: Charts of residuals, and of the frequency response, on a page.
SMALL_CHARTS = 24
#: Lags of the residual tests.
LAGS = 25
#: Innovation lengths of the paper's tables, and points of a convergence curve.
INNOVATION_LENGTHS = (1, 3, 5, 7)
TRACE_POINTS = 64


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
    small
        Whether two figures stand side by side where there is room.
    """

    heading: str
    paragraphs: Sequence[str] = ()
    warnings: Sequence[str] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()
    small: bool = False

    def __post_init__(self) -> None:
        # A text is a sequence of letters, too; nobody wants a paragraph for each.
        for name in ("paragraphs", "warnings"):
            if isinstance(getattr(self, name), str):
                object.__setattr__(self, name, (getattr(self, name),))


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(resources.files("ftlm.report").joinpath("page.html.j2").read_text("utf-8"))


@cache
def _script() -> tuple[Markup, str]:
    """The zoom of the charts, and the hash under which the page allows it and nothing else."""
    text = resources.files("ftlm.report").joinpath("zoom.js").read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return Markup(text), f"sha256-{digest}"  # our own file


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
    script, digest = _script()
    page = _template().render(
        title=title, lead=lead, sections=list(sections), version=__version__, chart_css=chart_css(), script=script,
        script_hash=digest,
    )  # fmt: skip
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
    check_free(path, force=force)
    model = result.model
    others = [] if validation is None else as_runs(validation)
    validated = [result.validate(run) for run in others]
    warnings = list(result.warnings)
    undefined = [n for n, e in result.standard_errors.items() if not math.isfinite(e)]
    if undefined:
        warnings.append(
            f"the standard errors of {', '.join(undefined)} are not defined: the fit's covariance is not finite; "
            "nothing is known of how sure these numbers are"
        )
    for run, found in zip(others, validated, strict=True):
        warnings += [f"validation run {run.name}: {w.removeprefix(run.name + ': ')}" for w in found.warnings]
        warnings += [f"validation run {run.name}: {w}" for w in run.warnings]
    compared = [("estimation", result.comparison), *(("validation", c) for c in validated)]
    tests = [] if result.residuals is None else [("estimation", result.residuals)]
    tests += _tests_on(model, others)
    sections = _first_sections(model, warnings, compared, bool(others), result.joint)
    sections.append(_residual_section(tests, result.information))
    task = result.task
    steps = [(r.step, r.duration) for r in ((() if task is None else task.runs) or others)]
    sections.append(_frequency_section(model, steps))
    sections += _search_sections(result)
    titled = ((f"Initial terms of the free runs, {label}", c) for label, c in compared)
    initial = [t for title, c in titled if (t := initial_terms_table(c, title=title)) is not None]
    starts = [starts_table(result.joint)] if result.joint is not None and result.joint.starts else []
    sections.append(Section("Settings", tables=[settings_table(result), *starts, *initial]))
    return write_page(path, title=model.structure.name, sections=sections, lead=_lead(compared), force=force)


def model_page(
    model: Model,
    path: str | os.PathLike[str],
    *,
    validation: Run | Sequence[Run] | None = None,
    force: bool = False,
) -> Path:
    """Write the report of a saved model: what its file knows of its identification, and validation runs.

    Parameters
    ----------
    model
        From :func:`ftlm.load_model`.
    path, validation, force
        See :func:`identification_page`.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    DataError
        See :func:`identification_page`.
    """
    check_free(path, force=force)
    others = [] if validation is None else as_runs(validation)
    known = model.estimate
    warnings = [] if known is None else list(known.warnings)
    validated = [compare(model, run) for run in others]
    for run, found in zip(others, validated, strict=True):
        words = [*found.warnings, *run.warnings]
        if known is not None:
            words += lost_fits({n: f for n, f in known.fit.items() if f is not None}, found)
            words += ["it has the name of a run that the model was identified from"] * (run.name in known.runs)
        warnings += [f"validation run {run.name}: {w.removeprefix(run.name + ': ')}" for w in words]
    compared = [("validation", c) for c in validated]
    sections = _first_sections(model, warnings, compared, bool(others), None)
    tests = _tests_on(model, others)
    if tests:
        sections.append(_residual_section(tests, None))
    sections.append(_frequency_section(model, [(r.step, r.duration) for r in others]))
    about: list[list[Cell]] = [["structure", model.structure.name], ["coupling in free runs", model.structure.coupling]]
    if known is not None:
        about += [["estimator", known.method], ["identified from", ", ".join(known.runs)]]
        about += [[Markup("fit of {} there, %").format(symbol_html(n)), f] for n, f in known.fit.items()]
        about += [[n.upper().replace("AICC", "AICc"), v] for n, v in known.information.items()]
    initial = [t for _, c in compared if (t := initial_terms_table(c)) is not None]
    sections.append(Section("Settings", tables=[Table("What the file says", ("setting", "value"), about), *initial]))
    return write_page(path, title=model.structure.name, sections=sections, lead=_lead(compared), force=force)


def check_free(path: str | os.PathLike[str], *, force: bool) -> None:
    """Refuse before any work what could not be written after it.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or its folder is not there or cannot be written.
    """
    file = Path(path)
    if os.path.lexists(file) and not force:
        raise DataError(f"{file} exists; choose another name, or overwrite it with force=True (--force)")
    if not file.absolute().parent.is_dir():
        raise DataError(f"{file.parent} is no folder; make it first")
    if not os.access(file.absolute().parent, os.W_OK):
        raise DataError(f"{file} cannot be written: {file.parent} is read-only; choose another folder")


def _first_sections(
    model: Model,
    warnings: Sequence[str],
    compared: Sequence[tuple[str, Comparison]],
    validated: bool,
    joint: JointFit | None,
) -> list[Section]:
    """Warnings, equations, errors, charts."""
    units = model.units
    words = [
        "No check raised a warning. Checked: free run against equation error, orders close to one another or on the "
        "edge of their interval, pull of the prior, coefficient law, residuals, stability of the discretisation, the "
        "data."
    ]
    if not validated:
        words.append("No validation run was given: how well the model predicts other data is not known.")
    warned = list(dict.fromkeys(warnings))
    charts = sum(len(c.per_run) for _, c in compared) * len(model.outputs)
    # Two lines a chart, drawn once wide and once narrow with half the points.
    points = min(POINTS, PAGE_POINTS // (3 * max(min(charts, PAGE_CHARTS), 1)))
    drawn = [f for label, c in compared for f in comparison_charts(c, units=units, label=label, points=points)]
    stable = model.stability()
    sections = [
        Section("Warnings", words[1:] if warned else words, warned),
        Section(
            "Equations",
            [*(equation_html(e) for e in model.equations), f"As a whole, the model is {stable}."],
            tables=[parameter_table(model, joint)],
        ),
    ]
    if compared:
        left_out = f"{charts - PAGE_CHARTS} further charts are left out; the table above has every run."
        sections += [
            Section("Errors", tables=[errors_table(compared, units=units)]),
            Section(
                "Measured and simulated",
                left_out if charts > PAGE_CHARTS else (),
                figures=drawn[:PAGE_CHARTS],
            ),
        ]
    return sections


def _tests_on(model: Model, runs: Sequence[Run]) -> list[tuple[str, Residuals]]:
    """Residual tests of each run that is long enough for them."""
    return [("validation", resid(model, run)) for run in runs if run.length >= 2 * LAGS + 3]


def _residual_section(tests: Sequence[tuple[str, Residuals]], information: InformationCriteria | None) -> Section:
    tables = [residual_table(t, title=f"{label}: {', '.join(t.runs)}") for label, t in tests]
    if information is not None:
        tables.append(information_table(information))
    figures = [f for label, t in tests for f in residual_charts(t, label=label)]
    words = () if tests else ("The runs are too short for residual tests.",)
    return Section("Residuals", words, tables=tables, figures=figures[:SMALL_CHARTS], small=True)


def _frequency_section(model: Model, steps: Sequence[tuple[float, float]]) -> Section:
    omega = response_frequencies(model, *min(steps)) if steps else response_frequencies(model)
    words = "Exact, orders as they are; the equations together, from what is not modelled."
    if model.estimate is None or model.estimate.covariance is None:
        words += " This estimator gives no covariance, so there are no bands."
    return Section("Frequency response", words, figures=bode_charts(model, omega)[:SMALL_CHARTS], small=True)


def _search_sections(result: Identification) -> list[Section]:
    """Convergence of the recursion, and the order search with its landscape."""
    sections = []
    traces = _traces(result)
    if traces:
        words = (
            "Error (45) of the free run after every step of the recursion, at the orders found. p weighs the data "
            "against the prior; all lines end where the closed form is."
        )
        sections.append(Section("Convergence of the recursion", words, figures=traces))
    if result.searches:
        tops = [search_top(name, found) for name, found in result.searches.items()]
        maps = []
        if result.task is not None:
            for name, found in result.searches.items():
                part = result.task.structure if name == "stage" else result.task.structure.equation(name)
                own = result.task.lattice_of(part)
                axes = {n: v for n, v in own.values(part).items() if len(v) > 1}
                if len(axes) >= 2:  # one order alone has no landscape; its table says all
                    maps.append(heat_map(landscape(result.task.runs, part, found, own)))
        sections.append(
            Section("Order search", tables=[search_summary(result.searches), *tops], figures=maps, small=True)
        )
    around = output_error_landscape(result)
    if around is not None:
        first, second = map(symbol, around.names)
        words = (
            f"The two orders that these runs tell apart least are {first} and {second}: the correlation of their "
            f"estimates is {number(around.correlation, 3)}. For white residuals the 95 % region of both ends at a "
            "score of 7."
        )
        sections.append(Section("Order landscape", words, figures=[heat_map(around)], small=True))
    return sections


def _traces(result: Identification) -> list[Figure]:
    """The recursion at the orders found, for the paper's p and the one used, where the first run starts at rest."""
    if result.task is None or result.method != "multi-innovation" or result.settings["initial"] != "rest":
        return []
    run, used = result.task.runs[0], result.settings
    lengths = sorted({*INNOVATION_LENGTHS, int(used["innovation_length"])})
    figures = []
    for item in result.task.structure.equations:
        single = replace(result.task.structure.equation(item.output), coefficient_law=())
        found = next(e for e in result.model.equations if e.output == item.output)
        orders = {
            o.names[0]: v.constant
            for o, v in zip(
                (single.equations[0].order, *(t.order for t in single.equations[0].terms)),
                (found.order, *(t.order for t in found.terms)), strict=True,
            )
            if o.names
        }  # fmt: skip
        at = single.with_orders(orders)
        if not at.coefficient_names:
            continue
        every = max(1, int(used["m"]) // TRACE_POINTS)
        traces = [
            (
                f"p = {p}",
                multi_innovation_trace(
                    run, at, innovation_length=p, prior_covariance=used["prior_covariance"], rows=used["rows"],
                    m=int(used["m"]), every=every,
                ),
            )
            for p in lengths
        ]  # fmt: skip
        figures.append(trace_chart(traces, title=f"Error (45) of {symbol(item.output)}, run {run.name}"))
    return figures


def _lead(compared: Sequence[tuple[str, Comparison]]) -> str:
    """Return the fits of the free runs, in a sentence a data set."""
    sentences = []
    for label, found in compared:
        fits = ", ".join(f"{symbol(name)} {number(fit, 4)}\u00a0%" for name, fit in found.fit_percent.items())
        runs = ", ".join(name for name, _, _ in found.per_run)
        sentences.append(f"Fit of the free run, {label} ({runs}): {fits}.")
    return " ".join(sentences)
