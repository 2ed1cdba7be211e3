"""HTML page and terminal summary of the cross-validation of integer against fractional orders."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from ftlm.estimation.verdict import MIN_FIT_GAIN
from ftlm.plot.comparison_charts import pulse_times
from ftlm.report.html_report import grouped_findings
from ftlm.report.typesetting import equation_html
from ftlm.reproduction.cross_validation import (
    FREE_ORDERS_BY_KIND,
    INTEGER_KIND,
    WITHOUT_RATE_LABEL,
    Deflection,
    UnseenOrders,
    Verdict,
    percent,
)
from ftlm.svg.figure import SMALL_WIDTH_PX, Figure
from ftlm.svg.html_page import Section, Table, write_page
from ftlm.svg.line_chart import line_chart
from ftlm.utils.files import check_free
from ftlm.utils.formatting import Cell, Exact, format_bound, symbol, symbol_html

#: Structure in the charts: elasticity and damping fractional, as in the paper.
CHARTED_KIND = "both fractional"
#: Subject of a verdict for each kind; one of them is a plural.
VERDICT_SUBJECTS = {
    "fractional elasticity": "a fractional order of the elasticity",
    "fractional damping": "a fractional order of the damping",
    CHARTED_KIND: "fractional orders",
}
#: Verdict in a table cell.
VERDICT_CELLS = {True: "yes", False: "no", None: "cannot be told"}
#: Points of a line.
LINE_POINTS = 700


def sentence(output: str, verdict: Verdict) -> str:
    """Return a verdict as a sentence."""
    several = verdict.kind == CHARTED_KIND
    what, yes = VERDICT_SUBJECTS[verdict.kind], "earn their place" if several else "earns its place"
    if verdict.earns is None:
        return f"{symbol(output)}: whether {what} {yes} cannot be told."
    no = f"do{'' if several else 'es'} not {yes.replace('earns', 'earn')}"
    return f"{symbol(output)}: {what} {yes if verdict.earns else no}."


def _structures(found: UnseenOrders) -> list[tuple[str, Deflection]]:
    """Return every structure with its heading; those without the rate follow those with it."""
    both = [(o, suffix, d) for o, full in found.deflections.items() for suffix, d in _with_and_without(full)]
    return [(f"{symbol(o)}{suffix}", d) for o, suffix, d in both]


def _with_and_without(full: Deflection) -> list[tuple[str, Deflection]]:
    return [("", full)] + ([] if full.before is None else [(f", {WITHOUT_RATE_LABEL}", full.before)])


def _verdict(output: str, verdict: Verdict) -> Markup:
    template = Markup('<span class="verdict"><strong>{}</strong><span class="note">{}</span></span>')
    return template.format(sentence(output, verdict), verdict.words)


def unseen_charts(found: UnseenOrders, deflection: Deflection) -> list[Figure]:
    """Charts of a deflection and its simulations by both structures on the run after the estimation run."""
    charts, output = [], deflection.output
    names = [run.name or "" for run in found.runs]
    for run, judged in zip(names, names[1:] + names[:1], strict=True):
        at = deflection.fits[INTEGER_KIND][run].comparisons[judged]
        lines, words = [("measured", at.measured[output][0])], []
        for kind in (INTEGER_KIND, CHARTED_KIND):
            fitted = deflection.fits[kind].get(run)
            if fitted is None:
                words.append(f"{kind}: no fit")
                continue
            lines.append((kind, fitted.comparisons[judged].simulated[output][0]))
            words.append(f"{kind} {percent(fitted.fit(judged))} % with {fitted.numbers} numbers")
        caption = "; ".join(words)
        charts.append(
            line_chart(
                pulse_times(at),
                lines,
                title=f"{symbol(output)} on {judged}, fitted to {run}",
                x_label="time [s]",
                y_label=f"{symbol(output)} [rad]",
                points=LINE_POINTS,
                width=SMALL_WIDTH_PX,
                caption=f"{caption[0].upper()}{caption[1:]}.",
            )
        )
    return charts


def places_table(found: UnseenOrders) -> Table | None:
    """Table of the verdicts without and with the rate of the other deflection."""
    rows: list[list[Cell]] = []
    headings = {}
    for output, full in found.deflections.items():
        if full.before is not None:
            headings[len(rows)] = symbol(output)
            for kind in VERDICT_SUBJECTS:
                rows.append([kind, *(VERDICT_CELLS[d.verdict(kind).earns] for d in (full.before, full))])
    if not rows:
        return None
    return Table(
        "Does the order earn its place?",
        ("order", "without rate", "with rate"),
        rows,
        headings=headings,
        note="The rate of the other deflection stands in a link's equation as the gain of an observer would. An order "
        "that earns its place only without the rate compensates for that gain.",
    )


def fits_table(found: UnseenOrders) -> Table:
    """Table of the fits of every structure on all runs, with its orders."""
    names = [run.name or "" for run in found.runs]
    pairs = [(run, other) for run in names for other in names]
    rows: list[list[Cell]] = []
    headings = {}
    for heading, deflection in _structures(found):
        headings[len(rows)] = heading
        for kind, each in deflection.fits.items():
            numbers = next((Exact(f.numbers) for f in each.values()), None)
            fits: list[Cell] = []
            for run, other in pairs:
                shown = percent(each[run].fit(other)) if run in each else None
                fits.append(shown if shown is None or run == other else Markup("<strong>{}</strong>").format(shown))
            rows.append([kind, numbers, *fits])
    heads = [f"{run}, fitted" if run == other else f"{run} → {other}" for run, other in pairs]
    return Table(
        "Fit of the free run in percent",
        ("structure", "numbers free", *heads),
        rows,
        headings=headings,
        note="Bold: validation runs. 100 is perfect, 0 is as good as the mean. Initial terms, initial state of the "
        "filter and gauge offset belong to a run; of a validation run nothing else is estimated.",
    )


def estimates_table(deflection: Deflection, suffix: str = "") -> Table:
    """Table of the estimates with 95 % intervals of every fit, one line per parameter."""
    rows: list[list[Cell]] = []
    headings = {}
    for kind, each in deflection.fits.items():
        for run, fitted in each.items():
            headings[len(rows)] = f"{kind}, fitted to {run}"
            for name, (value, *ends) in fitted.estimates.items():
                rows.append([symbol_html(name), value, *(v if math.isfinite(v) else format_bound(v) for v in ends)])
    title = f"{symbol(deflection.output)}{suffix}: estimates and their 95 % intervals"
    return Table(title, ("number", "estimate", "from", "to"), rows, headings=headings)


def _deflection_section(full: Deflection) -> Section:
    parts = _with_and_without(full)
    results = {
        f"{kind}, {run}{suffix}": f.result for suffix, d in parts for kind, e in d.fits.items() for run, f in e.items()
    }
    failed = [f"{kind}, {run}{suffix}: {words}" for suffix, d in parts for (kind, run), words in d.failed.items()]
    whole, free = full.fits[INTEGER_KIND], full.fits[CHARTED_KIND]
    run, fitted = next(iter({**whole, **free}.items()))
    models = next(iter(whole.values())).result.model, fitted.result.model
    return Section(
        symbol(full.output),
        [
            f"With integer orders and with both free, fitted to {run}:",
            *(equation_html(e) for e in dict.fromkeys(e for m in models for e in m.equations)),
        ],
        warnings=[*failed, *grouped_findings(results)],
        tables=[estimates_table(d, suffix) for suffix, d in parts],
    )


def _method_section(found: UnseenOrders) -> Section:
    rows: list[list[Cell]] = [[r.name, r.length, Exact(round(r.step, 9)), r.duration] for r in found.runs]
    filtered = " Both deflections passed the 2 Hz low-pass of the arm's stock model." if found.filtered else ""
    words = [
        "A link is the Euler–Lagrange equation (15) with the terms of a real arm: the measured motion of its hub, "
        "whose coefficient −1 is known; the accelerations of the other stage and the rate of its deflection, if both "
        f"stages were measured; hub angles in the gauge; an offset of the gauge.{filtered}",
        "All structures have the same terms. Integer orders: elasticity of order 0, damping of order 1.",
        "An order earns its place if every estimation run's 95 % interval excludes the integer order, the intervals of "
        f"the runs have a common value, no validation run loses {MIN_FIT_GAIN:g} points of fit and the median gain is "
        "as large. It does not if no validation run gains as much, or if no interval excludes the integer order and "
        "the median gain is smaller. Otherwise the verdict cannot be told, for example for a fit that is worse on its "
        "own run than the integer orders that its structure contains.",
        *found.notes,
    ]
    return Section("How it is judged", words, tables=[Table("Runs", ("run", "rows", "step [s]", "length [s]"), rows)])


def unseen_page(found: UnseenOrders, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write charts, verdicts and numbers as one HTML page.

    Parameters
    ----------
    found
        From :func:`orders_on_unseen_runs`.
    path
        File to write.
    force
        Overwrite.

    Returns
    -------
    pathlib.Path
        The file.

    Raises
    ------
    DataError
        The file exists and ``force`` is not set, or cannot be written.
    """
    check_free(path, force=force)
    each = {kind: [_verdict(o, d.verdict(kind)) for o, d in found.deflections.items()] for kind in VERDICT_SUBJECTS}
    first = each.pop(CHARTED_KIND)
    charts = [chart for d in found.deflections.values() for chart in unseen_charts(found, d)]
    places = places_table(found)
    alone = [verdict for pair in zip(*each.values(), strict=True) for verdict in pair]
    sections = [
        Section("On runs that were not fitted to", first, figures=charts, small=True),
        Section("One order at a time", alone, tables=[*([] if places is None else [places]), fits_table(found)]),
        *(_deflection_section(d) for d in found.deflections.values()),
        _method_section(found),
    ]
    names = ", ".join(run.name or "" for run in found.runs)
    lead = (
        f"Deflections of a flexible arm in runs {names}: each model is fitted to one run and simulated on another, "
        "with integer orders and with fractional ones in the same terms."
    )
    return write_page(path, title="Integer against fractional orders", sections=sections, lead=lead, force=force)


def unseen_text(found: UnseenOrders) -> str:
    """Summary of verdicts and fits for a terminal."""
    lines: list[str] = []
    for output, full in found.deflections.items():
        for verdict in full.verdicts:
            lines += [sentence(output, verdict), f"    {verdict.words}"]
    for output, full in found.deflections.items():
        if full.before is not None:
            lines += ["", f"{symbol(output)}, {WITHOUT_RATE_LABEL}:"]
            lines += [f"    {sentence(output, verdict)}" for verdict in full.before.verdicts]
    names = [run.name or "" for run in found.runs]
    for heading, deflection in _structures(found):
        lines += ["", f"{heading}: fit of the free run in percent, fitted to the first, judged on the second"]
        lines.append(" " * 24 + "numbers".rjust(8) + "".join(f"{a} → {b}".rjust(18) for a in names for b in names))
        lines += [_line(kind, deflection, names) for kind in FREE_ORDERS_BY_KIND]
    return "\n".join([*lines, *(f"note: {n}" for n in found.notes)])


def _line(kind: str, deflection: Deflection, names: Sequence[str]) -> str:
    each = deflection.fits[kind]
    numbers = next((str(f.numbers) for f in each.values()), "–")
    shown = [percent(each[a].fit(b)) if a in each else "no fit" for a in names for b in names]
    return kind.ljust(24) + numbers.rjust(8) + "".join(text.rjust(18) for text in shown)
