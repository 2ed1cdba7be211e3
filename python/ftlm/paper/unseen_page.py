"""Integer against fractional orders on unseen runs as a page and as text: pictures and verdicts first."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from ftlm.base.output import check_free
from ftlm.identification.page import grouped_warnings
from ftlm.judge.charts import pulse_times
from ftlm.model.typesetting import equation_html
from ftlm.paint.figure import SMALL, Figure
from ftlm.paint.lines import line_chart
from ftlm.paint.page import Section, write_page
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, Exact, symbol, symbol_html, unbounded
from ftlm.paper.unseen import KINDS, MARGIN, WHOLE, WITHOUT, Deflection, UnseenOrders, Verdict, percent

#: The structure of the pictures: everything that the paper says of a link may be fractional.
SHOWN = "both fractional"
#: What each kind is called in a verdict, and how it goes on.
WHAT = {
    "fractional elasticity": ("a fractional order of the elasticity", "earns its place", "does not earn its place"),
    "fractional damping": ("a fractional order of the damping", "earns its place", "does not earn its place"),
    SHOWN: ("fractional orders", "earn their place", "do not earn their place"),
}  # fmt: skip
#: A verdict in a cell.
SHORT = {True: "yes", False: "no", None: "cannot be told"}
#: Points of a line of the pictures.
LINE_POINTS = 700


def sentence(output: str, verdict: Verdict) -> str:
    """A verdict in words."""
    what, yes, no = WHAT[verdict.kind]
    if verdict.earns is None:
        return f"{symbol(output)}: whether {what} {yes} cannot be told."
    return f"{symbol(output)}: {what} {yes if verdict.earns else no}."


def _verdict(output: str, verdict: Verdict) -> Markup:
    template = Markup('<span class="verdict"><strong>{}</strong><span class="note">{}</span></span>')
    return template.format(sentence(output, verdict), verdict.words)


def unseen_charts(found: UnseenOrders, deflection: Deflection) -> list[Figure]:
    """Measured deflection and both free runs on the run after the one that was fitted."""
    charts = []
    names = [run.name or "" for run in found.runs]
    for run, judged in zip(names, names[1:] + names[:1], strict=True):
        output = deflection.output
        whole = deflection.fits[WHOLE][run]
        at = whole.compared[judged]
        lines = [("measured", at.measured[output][0])]
        told = []
        for kind in (WHOLE, SHOWN):
            fitted = deflection.fits[kind].get(run)
            if fitted is None:
                told.append(f"{kind}: no fit")
                continue
            lines.append((kind, fitted.compared[judged].simulated[output][0]))
            told.append(f"{kind} {percent(fitted.fit(judged))} % with {fitted.numbers} numbers")
        words = "; ".join(told)
        charts.append(
            line_chart(
                pulse_times(at), lines, title=f"{symbol(output)} on {judged}, fitted to {run}", x_label="time [s]",
                y_label=f"{symbol(output)} [rad]", points=LINE_POINTS, width=SMALL,
                caption=f"{words[0].upper()}{words[1:]}.",
            )
        )  # fmt: skip
    return charts


def _each(found: UnseenOrders) -> list[tuple[str, Deflection]]:
    """Every structure that was judged, with its heading; those without the rate after those with it."""
    out = []
    for output, deflection in found.deflections.items():
        out.append((symbol(output), deflection))
        if deflection.before is not None:
            out.append((f"{symbol(output)}, {WITHOUT}", deflection.before))
    return out


def places_table(found: UnseenOrders) -> Table | None:
    """Which orders earn their place before the rate of the other deflection stood in the equation, and with it."""
    rows: list[list[Cell]] = []
    headings = {}
    for output, deflection in found.deflections.items():
        if deflection.before is not None:
            headings[len(rows)] = symbol(output)
            pair = (deflection.before, deflection)
            rows += [[kind, *(SHORT[d.verdict(kind).earns] for d in pair)] for kind in KINDS if kind != WHOLE]
    if not rows:
        return None
    return Table(
        "Does the order earn its place?",
        ("order", "without rate", "with rate"),
        rows,
        headings=headings,
        note="The rate of the other deflection stands in a link's equation as the gain of an observer would. An order "
        "that earns its place only without it stood in for that gain.",
    )


def fits_table(found: UnseenOrders) -> Table:
    """Every structure on every run, seen and unseen, with its orders."""
    names = [run.name or "" for run in found.runs]
    pairs = [(run, other) for run in names for other in names]
    rows: list[list[Cell]] = []
    headings = {}
    for heading, deflection in _each(found):
        headings[len(rows)] = heading
        for kind, each in deflection.fits.items():
            numbers = next((f.numbers for f in each.values()), None)
            fits: list[Cell] = []
            for run, other in pairs:
                value = each[run].fit(other) if run in each else None
                shown = None if value is None else percent(value)
                fits.append(shown if shown is None or run == other else Markup("<strong>{}</strong>").format(shown))
            rows.append([kind, None if numbers is None else Exact(numbers), *fits])
    heads = [f"{run}, fitted" if run == other else f"{run} → {other}" for run, other in pairs]
    return Table(
        "Fit of the free run in percent", ("structure", "numbers free", *heads), rows,
        headings=headings,
        note="In bold the runs that were not fitted to. 100 is perfect, 0 is as good as the mean. Initial terms, the "
        "filter's state and the gauge's zero are each run's own; of the judged run nothing else is estimated.",
    )  # fmt: skip


def estimates_table(deflection: Deflection, told: str = "") -> Table:
    """What every fit found, with intervals, a line a number."""
    rows: list[list[Cell]] = []
    headings = {}
    for kind, each in deflection.fits.items():
        for run, fitted in each.items():
            headings[len(rows)] = f"{kind}, fitted to {run}"
            for name, (value, low, high) in fitted.estimates.items():
                rows.append([symbol_html(name), value, *(v if math.isfinite(v) else unbounded(v) for v in (low, high))])
    title = f"{symbol(deflection.output)}{told}: estimates and their 95 % intervals"
    return Table(title, ("number", "estimate", "from", "to"), rows, headings=headings)


def _first_section(found: UnseenOrders) -> Section:
    verdicts = [_verdict(o, d.verdict(SHOWN)) for o, d in found.deflections.items()]
    charts = [chart for d in found.deflections.values() for chart in unseen_charts(found, d)]
    return Section("On runs that were not fitted to", verdicts, figures=charts, small=True)


def _deflection_section(deflection: Deflection) -> Section:
    parts = [("", deflection)] + ([] if deflection.before is None else [(f", {WITHOUT}", deflection.before)])
    results = {
        f"{k}, {run}{told}": f.result for told, d in parts for k, each in d.fits.items() for run, f in each.items()
    }
    failed = [f"{kind}, {run}{told}: {words}" for told, d in parts for (kind, run), words in d.failed.items()]
    last = next(iter(deflection.fits[WHOLE].values())).result.model
    first, run = next((f.result.model, run) for run, f in {
        **deflection.fits[WHOLE], **deflection.fits[SHOWN]
    }.items())  # fmt: skip
    equations = [equation_html(e) for e in dict.fromkeys((*last.equations, *first.equations))]
    words = f"With whole orders and with both free, fitted to {run}:"
    return Section(
        symbol(deflection.output), [words, *equations], warnings=[*failed, *grouped_warnings(results)],
        tables=[estimates_table(d, told) for told, d in parts],
    )  # fmt: skip


def _method_section(found: UnseenOrders) -> Section:
    rows: list[list[Cell]] = [[r.name, r.length, Exact(round(r.step, 9)), r.duration] for r in found.runs]
    words = [
        "A link is the Euler–Lagrange equation (15) with what a real arm needs: it hangs on the measured motion of its "
        "hub, whose coefficient −1 is known; the other stage's accelerations push on it where both stages were "
        "measured, and the rate of the other deflection steadies it as an observer's gain would; hub angles leak into "
        "its gauge; the gauge has an unknown zero."
        + (" Both deflections passed the 2 Hz low-pass of the arm's stock model." if found.filtered else ""),
        "All structures have the same terms. Whole orders: elasticity of order 0, damping of order 1.",
        f"An order earns its place where every fitted run's 95 % interval excludes the whole one, the runs' intervals "
        f"have a value in common, no unseen run loses {MARGIN:g} points of fit and the middle one gains as much. "
        "It does not where no unseen run gains that, or no interval excludes the whole order and the middle run gains "
        "less. The rest cannot be told, as where a fit is worse on its own run than the whole orders that it contains.",
        *found.notes,
    ]
    return Section("How it is judged", words, tables=[Table("Runs", ("run", "rows", "step [s]", "length [s]"), rows)])


def unseen_page(found: UnseenOrders, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write pictures, verdicts and numbers as one page.

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
    alone = [
        _verdict(o, v) for o, d in found.deflections.items() for v in d.verdicts if v.kind != SHOWN
    ]  # fmt: skip
    places = places_table(found)
    sections = [
        _first_section(found),
        Section("One order at a time", alone, tables=[*([] if places is None else [places]), fits_table(found)]),
        *(_deflection_section(d) for d in found.deflections.values()),
        _method_section(found),
    ]  # fmt: skip
    names = ", ".join(run.name or "" for run in found.runs)
    lead = (
        f"Deflections of a flexible arm in runs {names}: each model is fitted to one run and runs free on another, "
        "with whole orders and with fractional ones in the same terms."
    )
    return write_page(path, title="Integer against fractional orders", sections=sections, lead=lead, force=force)


def unseen_text(found: UnseenOrders) -> str:
    """Verdicts and fits for a terminal."""
    lines: list[str] = []
    for output, deflection in found.deflections.items():
        for verdict in deflection.verdicts:
            lines += [sentence(output, verdict), f"    {verdict.words}"]
    names = [run.name or "" for run in found.runs]
    for output, deflection in found.deflections.items():
        if deflection.before is not None:
            lines += ["", f"{symbol(output)}, {WITHOUT}:"]
            lines += [f"    {sentence(output, verdict)}" for verdict in deflection.before.verdicts]
    for heading, deflection in _each(found):
        lines += ["", f"{heading}: fit of the free run in percent, fitted to the first, judged on the second"]
        lines.append(" " * 24 + "numbers".rjust(8) + "".join(f"{a} → {b}".rjust(18) for a in names for b in names))
        lines += [_line(kind, deflection, names) for kind in KINDS]
    return "\n".join([*lines, *(f"note: {n}" for n in found.notes)])


def _line(kind: str, deflection: Deflection, names: Sequence[str]) -> str:
    each = deflection.fits[kind]
    numbers = next((str(f.numbers) for f in each.values()), "–")
    shown = [percent(each[a].fit(b)) if a in each else "no fit" for a in names for b in names]
    return kind.ljust(24) + numbers.rjust(8) + "".join(text.rjust(18) for text in shown)
