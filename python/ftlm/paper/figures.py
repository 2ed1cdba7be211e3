"""The paper's figures, drawn from computed runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

from markupsafe import Markup

from ftlm.fit.recursion import Trace, trace_chart
from ftlm.judge.charts import error_chart, pulse_times
from ftlm.judge.comparison import Comparison
from ftlm.judge.metrics import metrics
from ftlm.paint.figure import NARROW, Figure, svg
from ftlm.paint.lines import line_chart
from ftlm.paint.text import symbol
from ftlm.paper import printed
from ftlm.paper.records import Candidate, Derived, Recomputed, Stage

#: Points of a line of these charts: there are some fifty on the page, which stays below 2 MB.
LINE_POINTS = 500


def fit_chart(models: Sequence[tuple[str, Comparison]], output: str, title: str, caption: str = "") -> Figure:
    """Measured angle and the free runs of some models."""
    first = models[0][1]
    lines = [("measured", first.measured[output][0])] + [(label, c.simulated[output][0]) for label, c in models]
    return line_chart(
        pulse_times(first), lines, title=title, x_label="time [s]", y_label=f"{symbol(output)} [rad]",
        points=LINE_POINTS, caption=caption,
    )  # fmt: skip


def convergence_chart(traces: Mapping[int, Trace], title: str, *, log_x: bool = True) -> Figure:
    """Error (45) after every step of the recursion, a line for each p."""
    return trace_chart([(f"p = {p}", trace) for p, trace in traces.items()], title=title, log_x=log_x)


def derivative_chart(derived: Derived) -> Figure:
    """The deflection as measured, by (14)-(15), and with the same numbers as published."""
    nr, bent = metrics(derived.derived, derived.published).nr, derived.correlations
    lines = [("measured", derived.measured), ("(14)–(15)", derived.derived), ("(22)–(25)", derived.published)]
    caption = (
        f"The same numbers in both, order of the current 0 where it should be {derived.order:.3g}. NR between the two: "
        f"{nr:.3g}. Correlation with the current: measured {bent['measured']:.2f}, (14)–(15) {bent['derived']:.2f}, "
        f"(22)–(25) {bent['published']:.2f}."
    ).replace(" -", " −")
    return line_chart(
        derived.time, lines, title=f"{symbol(derived.output)}: which way the link bends", x_label="time [s]",
        y_label=f"{symbol(derived.output)} [rad]", points=LINE_POINTS, caption=caption,
    )  # fmt: skip


def _fits_chart(models: Mapping[str, Candidate], output: str, place: str, *, sine: bool) -> list[Figure]:
    """Models on one input with their fits, or nothing without that run."""
    compared = {label: c.validation if sine else c.estimation for label, c in models.items()}
    present = [(label, c) for label, c in compared.items() if c is not None]
    if not present:
        return []
    fits = ", ".join(f"{label} {c.output_error[output].fit:.4g} %" for label, c in present)
    caption = f"Fit: {fits.replace('inf', '∞').replace('-', '−')}."
    title = f"Figure {place}. {symbol(output)}, {'sine' if sine else 'square'} input"
    return [fit_chart(present, output, title, caption)]


def _beside_integer(stage: Stage) -> dict[str, Candidate]:
    """The models of Figures 6, 9 and 10."""
    last = f"p = {printed.INNOVATION_LENGTHS[-1]}"
    labels = {"integer, manual": stage.manual, last: last, "output error": "output error"}
    return {shown: stage.candidates[label] for shown, label in labels.items()}


def stage_figures(stage: Stage) -> list[Figure]:
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
        figures += _fits_chart(_beside_integer(stage), output, f"{first + 2}({letter})", sine=False)
    return figures


def _letter(output: str) -> str:
    return "abcd"[printed.OUTPUTS.index(output)]


def sine_figures(found: Recomputed) -> list[Figure]:
    """Figure 10."""
    return [
        figure for stage, output in found.angles
        for figure in _fits_chart(_beside_integer(stage), output, f"10({_letter(output)})", sine=True)
    ]  # fmt: skip


def rival_figures(found: Recomputed) -> list[Figure]:
    """Figure 11: on the input that neither has seen, or on the one they were identified from."""
    figures = []
    for output, rival in found.rivals.items():
        models = {"genetic": rival.genetic, "p = 7": rival.lattice}
        unseen = rival.genetic.validation is not None
        figures += _fits_chart(models, output, f"11({_letter(output)})", sine=unseen)
    return figures


#: Boxes of Figure 2: (heading, what it holds), from left to right or from above.
BOXES = (
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
    names = ", then ".join(f"{a} {b}" for a, b in BOXES)
    described = f"Flow chart: {names}. From the free run an arrow leads back to the orders: every candidate in turn."
    return Figure(title, _flow(described, narrow=False), _flow(described, narrow=True))


def _flow(described: str, *, narrow: bool) -> Markup:
    """Boxes with arrows between them; the loop over the orders goes back from the free run."""
    count = len(BOXES)
    width, step, w, h = (NARROW, 62, 200, 42) if narrow else (980, 140, 122, 54)
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
    for (left, top), (head, below) in zip(places, BOXES, strict=True):
        middle = left + w / 2
        out.append(text.format(middle, top + h / 2 - 4, head, middle, top + h / 2 + 13, below))
    out.append(Markup('<text x="{}" y="{}">{}</text></g>').format(*place, words))
    return svg(width, height, "Figure 2", described, out, narrow=narrow)
