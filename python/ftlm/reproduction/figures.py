"""Figures of the paper, drawn from computed runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from markupsafe import Markup

from ftlm.estimation.linear import MultiInnovationTrace, trace_chart
from ftlm.plot.comparison_charts import error_chart, pulse_times
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.claims import ClaimVerdict, ReproductionData
from ftlm.reproduction.stage_result import MULTI_INNOVATION_LABELS, Candidate, DroppedDerivative, Stage
from ftlm.svg.figure import NARROW_WIDTH_PX, Figure, svg
from ftlm.svg.line_chart import line_chart
from ftlm.utils.formatting import symbol
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison, metrics

#: Points per line: some fifty charts keep the page below 2 MB.
LINE_POINTS = 500
#: Largest drawn excursion relative to the reference line, and largest drawn error of the recursion relative to its last
#: value. Diverging lines would hide all others.
MAX_EXCURSION_RATIO, MAX_ERROR_RATIO = 4.0, 1000.0


def reference_label(*, simulated: bool) -> str:
    """Label of the line that models are compared with."""
    return "simulated arm" if simulated else "measured"


def mask_excursions(values: Floats, measured: Floats) -> Floats:
    """Replace values far from the measured ones by NaN; the chart marks the gap."""
    middle = float(np.mean(measured))
    limit = MAX_EXCURSION_RATIO * float(np.max(np.abs(measured - middle)))
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values - middle) <= limit, values, np.nan)


def fit_chart(
    models: Sequence[tuple[str, Comparison]], output: str, title: str, caption: str = "", *, simulated: bool
) -> Figure:
    """Chart of an angle and its simulations by some models."""
    first = models[0][1]
    measured = first.measured[output][0]
    lines = [(reference_label(simulated=simulated), measured)]
    gone = []
    for label, comparison in models:
        response = mask_excursions(comparison.simulated[output][0], measured)
        left = np.flatnonzero(np.isnan(response))
        if left.size:
            gone.append(f"{label} leaves the drawing after {pulse_times(first)[left[0]]:.2g} s")
        lines.append((label, response))
    told = " ".join(part for part in (caption, "; ".join(gone) + "." if gone else "") if part)
    return line_chart(
        pulse_times(first),
        [line for line in lines if np.isfinite(line[1]).any()],
        title=title,
        x_label="time [s]",
        y_label=f"{symbol(output)} [rad]",
        points=LINE_POINTS,
        caption=told,
    )


def printed_model_charts(found: ReproductionData) -> list[Figure]:
    """Charts of the printed hub models under the paper's current, beside an angle of the implied standard deviation."""
    charts = []
    for output in dict.fromkeys(r.output for r in found.ran if r.output.endswith("1")):
        rows = [r for r in found.ran if r.output == output]
        last = rows[-1]
        lines = [("simulated arm", last.arm)]
        lines += [(f"printed, p = {r.p}", r.response) for r in rows]
        caption = (
            f"The printed equations of Table {3 + int(output[-2])} from the current alone, and the simulated arm, "
            f"scaled to the deviation that the printed RMSE / NR implies ({last.implied_deviation:.2g} rad). p = "
            f"{last.p} moves "
            f"{last.deviation_ratio:.0f} times less than the angle that it was identified from."
        )
        charts.append(
            line_chart(
                last.time,
                lines,
                title=f"{symbol(output)}: the printed models under the paper's current",
                x_label="time [s]",
                y_label=f"{symbol(output)} [rad]",
                points=LINE_POINTS,
                caption=caption,
            )
        )
    return charts


def share_picture(ruling: ClaimVerdict) -> Markup:
    """Bar of the share of cases in which a claim holds, for every level of the deciding factor."""
    levels = ruling.levels or (("", ruling.cases, ruling.holding_cases),)
    height = 10 * len(levels) - 2
    words = "; ".join(f"{level + ': ' if level else ''}{held} of {count}" for level, count, held in levels)
    out = [Markup('<svg class="share" viewBox="0 0 88 {}" role="img" aria-label="holds in {}">').format(height, words)]
    for k, (_, count, held) in enumerate(levels):
        filled = 88 * held / max(count, 1)
        out.append(Markup('<rect class="held" x="0" y="{}" width="{:.1f}" height="8"/>').format(10 * k, filled))
        out.append(Markup('<rect x=".5" y="{}" width="87" height="7"/>').format(10 * k + 0.5))
    return Markup("").join([*out, Markup("</svg>")])


def convergence_chart(traces: Mapping[int, MultiInnovationTrace], title: str, *, log_x: bool = True) -> Figure:
    """Chart of the error (45) over the steps of the recursion, one line per p."""
    ends = max(float(t.error[-1]) for t in traces.values())
    drawn = {}
    for p, trace in traces.items():
        with np.errstate(invalid="ignore"):
            near = np.where(trace.error <= MAX_ERROR_RATIO * ends, trace.error, np.nan)
        drawn[p] = replace(trace, error=near if np.isfinite(near).any() else trace.error)
    figure = trace_chart([(f"p = {p}", trace) for p, trace in drawn.items()], title=title, log_x=log_x)
    gaps = any(np.isnan(t.error).any() for t in drawn.values())
    words = f"Errors above {MAX_ERROR_RATIO:g} times the last ones are not drawn."
    return replace(figure, caption=f"{figure.caption} {words}".strip()) if gaps else figure


def derivative_chart(derived: DroppedDerivative, *, simulated: bool = True) -> Figure:
    """Chart of the measured deflection, of (14)-(15), and of the published form with the same parameters."""
    nr, bent = metrics(derived.derived, derived.published).nr, derived.correlations
    own = reference_label(simulated=simulated)
    lines = [(own, derived.measured), ("(14)–(15)", derived.derived), ("(22)–(25)", derived.published)]
    caption = (
        f"The same numbers in both, order of the current 0 where it should be {derived.order:.3g}. NR between the two: "
        f"{nr:.3g}. Correlation with the current: {own} {bent['measured']:.2f}, (14)–(15) {bent['derived']:.2f}, "
        f"(22)–(25) {bent['published']:.2f}."
    ).replace(" -", " −")
    return line_chart(
        derived.time,
        lines,
        title=f"{symbol(derived.output)}: which way the link bends",
        x_label="time [s]",
        y_label=f"{symbol(derived.output)} [rad]",
        points=LINE_POINTS,
        caption=caption,
    )


def _fits_chart(
    models: Mapping[str, Candidate], output: str, place: str, *, sine: bool, simulated: bool
) -> list[Figure]:
    """Charts of the models' fits on one input; empty without that run."""
    compared = {label: c.validation if sine else c.estimation for label, c in models.items()}
    present = [(label, c) for label, c in compared.items() if c is not None]
    if not present:
        return []
    fits = ", ".join(f"{label} {c.output_error[output].fit:.4g} %" for label, c in present)
    caption = f"Fit: {fits.replace('inf', '∞').replace('-', '−')}."
    if output.endswith("2") and any(label.startswith("p = ") for label in models):
        caption += " Rows of p are (23), from which a derivative of the current is missing."
    title = f"Figure {place}. {symbol(output)}, {'sine' if sine else 'square'} input"
    return [fit_chart(present, output, title, caption, simulated=simulated)]


def _beside_integer(stage: Stage) -> dict[str, Candidate]:
    """Models of Figures 6, 9 and 10."""
    last = f"p = {printed.INNOVATION_LENGTHS[-1]}"
    labels = {"integer, manual": stage.manual, last: last, "output error": "output error"}
    return {shown: stage.candidates[label] for shown, label in labels.items()}


def stage_figures(stage: Stage, *, simulated: bool) -> list[Figure]:
    """Figures 4-6 or 7-9."""
    first = 4 if stage.number == 1 else 7
    errors = [(f"p = {p}", stage.candidates[f"p = {p}"].estimation) for p in printed.INNOVATION_LENGTHS]
    figures = []
    for place, output in enumerate(stage.outputs, first):
        title = f"Figure {place}(a). {symbol(output)}: absolute error of the free run"
        figures.append(error_chart(errors, output, title=title, units={output: "rad"}, points=LINE_POINTS))
        if output in stage.traces:
            title = f"Figure {place}(b). {symbol(output)}: error (45) after each step"
            figures.append(convergence_chart(stage.traces[output], title))
    for letter, output in zip("ab", stage.outputs, strict=True):
        figures += _fits_chart(
            _beside_integer(stage), output, f"{first + 2}({letter})", sine=False, simulated=simulated
        )
    return figures


def _letter(output: str) -> str:
    return "abcd"[printed.ANGLE_NAMES.index(output)]


def sine_figures(found: ReproductionData) -> list[Figure]:
    """Figure 10."""
    return [
        figure
        for stage, output in found.angles
        for figure in _fits_chart(
            _beside_integer(stage), output, f"10({_letter(output)})", sine=True, simulated=found.simulated
        )
    ]


#: Labels of the lines.
RIVAL_NAMES = {MULTI_INNOVATION_LABELS[0]: "p = 7, K₀ = 1", MULTI_INNOVATION_LABELS[1]: "p = 7, weak prior"}


def rival_figures(found: ReproductionData) -> list[Figure]:
    """Figure 11, on the validation run, or on the estimation run without one."""
    figures = []
    for output, rival in found.rivals.items():
        models = {RIVAL_NAMES.get(n, n): c for n, c in rival.models.items() if n != "differential evolution"}
        unseen = rival.genetic.validation is not None
        figures += _fits_chart(models, output, f"11({_letter(output)})", sine=unseen, simulated=found.simulated)
    return figures


#: Boxes of Figure 2: (heading, equations), from left to right or from top to bottom.
FLOW_CHART_BOXES = (
    ("Energies", "(7)–(11)"),
    ("Equations", "(14)–(21), (26)"),
    ("Pulse means", "(28)–(39)"),
    ("Orders", "on a lattice"),
    ("Coefficients", "(42)–(44)"),
    ("Free run", "(26), (45)"),
    ("Smallest error", "the model"),
)


def flow_chart() -> Figure:
    """Figure 2: from the physics to the model."""
    title = "Figure 2. From the physics to the identified model"
    names = ", then ".join(f"{a} {b}" for a, b in FLOW_CHART_BOXES)
    described = f"Flow chart: {names}. From the free run an arrow leads back to the orders: every candidate in turn."
    return Figure(title, _flow(described, narrow=False), _flow(described, narrow=True))


def _flow(described: str, *, narrow: bool) -> Markup:
    """Flow chart with boxes and arrows; a loop leads from the simulation back to the orders."""
    count = len(FLOW_CHART_BOXES)
    width, step, w, h = (NARROW_WIDTH_PX, 62, 200, 42) if narrow else (980, 140, 122, 54)
    height = 12 + count * step if narrow else 128
    places = [(30, 6 + k * step) if narrow else (4 + k * step, 40) for k in range(count)]
    box, path = Markup('<rect x="{}" y="{}" width="{}" height="{}" rx="5"/>'), Markup('<path d="{}"/>')
    out = [Markup('<g fill="none" stroke="currentColor" stroke-width="1.3">')]
    out += [box.format(x, y, w, h) for x, y in places]
    for (x, y), (x2, y2) in pairwise(places):
        if narrow:
            arrow = f"M{x + w / 2} {y + h}V{y2}M{x + w / 2 - 4} {y2 - 7}l4 7l4 -7"
        else:
            arrow = f"M{x + w} {y + h / 2}H{x2}M{x2 - 7} {y + h / 2 - 4}l7 4l-7 4"
        out.append(path.format(arrow))
    (ox, oy), (fx, fy) = places[3], places[5]
    place: tuple[float, float]
    if narrow:
        edge = ox + w
        loop = f"M{edge} {fy + h / 2}H{edge + 34}V{oy + h / 2}H{edge}m7 -4l-7 4l7 4"
        words, place = "next", (ox + w + 62, (oy + fy + h) / 2 + 4)
    else:
        loop = f"M{fx + w / 2} {fy}V14H{ox + w / 2}V{oy}m-4 -7l4 7l4 -7"
        words, place = "next candidate", ((ox + fx + w) / 2, 10)
    out.append(Markup('<path d="{}" stroke-dasharray="none"/></g>').format(loop))
    out.append(Markup('<g font-size="12" fill="currentColor" text-anchor="middle">'))
    text = Markup('<text x="{}" y="{}" font-weight="600">{}</text><text x="{}" y="{}">{}</text>')
    for (left, top), (head, below) in zip(places, FLOW_CHART_BOXES, strict=True):
        middle = left + w / 2
        out.append(text.format(middle, top + h / 2 - 4, head, middle, top + h / 2 + 13, below))
    out.append(Markup('<text x="{}" y="{}">{}</text></g>').format(*place, words))
    return svg(width, height, "Figure 2", described, out, narrow=narrow)
