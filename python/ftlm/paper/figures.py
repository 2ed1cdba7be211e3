"""The paper's figures, drawn from computed runs."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

from markupsafe import Markup

from ftlm.fit.recursion import trace_chart
from ftlm.judge.charts import error_chart, pulse_times
from ftlm.judge.comparison import Comparison
from ftlm.paint.lines import NARROW, Figure, line_chart
from ftlm.paint.text import symbol
from ftlm.paper import printed
from ftlm.paper.stages import Recomputed, Stage

#: Points of a line of these charts: there are some fifty on the page, which stays below 2 MB.
LINE_POINTS = 500


def unit_label(output: str) -> str:
    return f"{symbol(output)} [rad]"


def fit_chart(
    comparison: Comparison, models: Iterable[tuple[str, Comparison]], output: str, title: str, caption: str = ""
) -> Figure:
    """Measured angle and the free runs of some models."""
    measured = comparison.measured[output][0]
    lines = [("measured", measured)] + [(label, c.simulated[output][0]) for label, c in models]
    return line_chart(
        pulse_times(comparison, 0), lines, title=title, x_label="time [s]", y_label=unit_label(output),
        points=LINE_POINTS, caption=caption,
    )  # fmt: skip


def _beside_integer(stage: Stage, output: str, *, sine: bool) -> list[tuple[str, Comparison]]:
    last = f"p = {printed.INNOVATION_LENGTHS[-1]}"
    labels = (("integer, manual", stage.manual), (last, last), ("output error", "output error"))
    found = []
    for shown, label in labels:
        candidate = stage.candidates[label]
        comparison = candidate.validation if sine else candidate.estimation
        if comparison is not None:
            found.append((shown, comparison))
    return found


def _fits_caption(models: Sequence[tuple[str, Comparison]], output: str) -> str:
    listed = ", ".join(f"{label} {c.output_error[output].fit:.4g} %" for label, c in models)
    return f"Fit: {listed.replace('inf', '∞').replace('-', '−')}."


def stage_figures(stage: Stage) -> list[Figure]:
    """Figures 4-6 or 7-9."""
    first = 4 if stage.number == 1 else 7
    lengths = [f"p = {p}" for p in printed.INNOVATION_LENGTHS]
    figures = []
    for k, output in enumerate(stage.outputs):
        place = first + k
        errors = [(label, stage.candidates[label].estimation) for label in lengths]
        chart = error_chart(
            errors, output, title=f"Figure {place}(a). {symbol(output)}: absolute error of the free run",
            units={output: "rad"}, points=LINE_POINTS,
        )  # fmt: skip
        figures.append(chart)
        named = [(f"p = {p}", trace) for p, trace in stage.traces.get(output, {}).items()]
        if not named:
            continue
        title = f"Figure {place}(b). {symbol(output)}: error (45) after each step"
        figures.append(trace_chart(named, title=title, log_x=True))
    for k, output in enumerate(stage.outputs):
        models = _beside_integer(stage, output, sine=False)
        figures.append(
            fit_chart(
                models[0][1], models, output, f"Figure {first + 2}({'ab'[k]}). {symbol(output)}, square input",
                _fits_caption(models, output),
            )
        )  # fmt: skip
    return figures


def sine_figures(found: Recomputed) -> list[Figure]:
    """Figure 10."""
    figures = []
    for stage in found.stages.values():
        for output in stage.outputs:
            models = _beside_integer(stage, output, sine=True)
            if models:
                letter = "abcd"[printed.OUTPUTS.index(output)]
                figures.append(
                    fit_chart(
                        models[0][1], models, output, f"Figure 10({letter}). {symbol(output)}, sine input",
                        _fits_caption(models, output),
                    )
                )  # fmt: skip
    return figures


def rival_figures(found: Recomputed) -> list[Figure]:
    """Figure 11: on the input that neither has seen, or on the one they were identified from."""
    figures = []
    for stage in found.stages.values():
        for output, rival in stage.rivals.items():
            other = rival.genetic.validation is not None
            models = [
                (label, c)
                for label, candidate in (("genetic", rival.genetic), ("p = 7", rival.lattice))
                if (c := candidate.validation if other else candidate.estimation) is not None
            ]
            letter, where = "abcd"[printed.OUTPUTS.index(output)], "sine" if other else "square"
            figures.append(
                fit_chart(
                    models[0][1], models, output, f"Figure 11({letter}). {symbol(output)}, {where} input",
                    _fits_caption(models, output),
                )
            )  # fmt: skip
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
    left = 30 if narrow else 4
    places = [(left, 6 + k * step) if narrow else (left + k * step, 40) for k in range(count)]
    out = [
        Markup('<svg class="chart {}" role="img" viewBox="0 0 {} {}" width="{}" height="{}">').format(
            "narrow" if narrow else "wide", width, height, width, height
        ),
        Markup("<title>{}</title><desc>{}</desc>").format("Figure 2", described),
        Markup('<g fill="none" stroke="currentColor" stroke-width="1.3">'),
    ]
    for x, y in places:
        out.append(Markup('<rect x="{}" y="{}" width="{}" height="{}" rx="5"/>').format(x, y, w, h))
    for (x, y), (x2, y2) in pairwise(places):
        if narrow:
            line, head = f"M{x + w / 2} {y + h}V{y2}", f"M{x + w / 2 - 4} {y2 - 7}l4 7l4 -7"
        else:
            line, head = f"M{x + w} {y + h / 2}H{x2}", f"M{x2 - 7} {y + h / 2 - 4}l7 4l-7 4"
        out.append(Markup('<path d="{}"/>').format(line + head))
    (ox, oy), (fx, fy) = places[3], places[5]
    if narrow:
        edge = ox + w
        loop = f"M{edge} {fy + h / 2}H{edge + 34}V{oy + h / 2}H{edge}m7 -4l-7 4l7 4"
    else:
        loop = f"M{fx + w / 2} {fy}V14H{ox + w / 2}V{oy}m-4 -7l4 7l4 -7"
    out.append(Markup('<path d="{}" stroke-dasharray="none"/></g>').format(loop))
    out.append(Markup('<g font-size="12" fill="currentColor" text-anchor="middle">'))
    for (x, y), (head, below) in zip(places, BOXES, strict=True):
        middle = x + w / 2
        out.append(
            Markup('<text x="{}" y="{}" font-weight="600">{}</text><text x="{}" y="{}">{}</text>').format(
                middle, y + h / 2 - 4, head, middle, y + h / 2 + 13, below
            )
        )
    if narrow:
        out.append(Markup('<text x="{}" y="{}">next</text>').format(ox + w + 62, (oy + fy + h) / 2 + 4))
    else:
        out.append(Markup('<text x="{}" y="{}">next candidate</text>').format((ox + fx + w) / 2, 10))
    out.append(Markup("</g></svg>"))
    return Markup("").join(out)
