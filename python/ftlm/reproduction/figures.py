"""Figures of the paper, drawn from computed runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from ftlm.estimation.linear import MultiInnovationTrace, trace_chart
from ftlm.plot.comparison_charts import error_chart, pulse_times
from ftlm.reproduction import published_values as printed
from ftlm.reproduction.checks import ClaimVerdict
from ftlm.reproduction.stage import MULTI_INNOVATION_LABELS, Candidate, DroppedDerivative, Stage
from ftlm.svg.figure import Figure, StaticFigure
from ftlm.svg.line_chart import LineChart
from ftlm.utils.formatting import symbol
from ftlm.utils.validation import Floats
from ftlm.validation.comparison import Comparison, metrics

if TYPE_CHECKING:
    from ftlm.reproduction.reproduction import Reproduction

#: Points per line: some fifty charts keep the page below 2 MB.
LINE_POINTS = 500
#: Largest drawn excursion relative to the reference line, and largest drawn error of the recursion relative to its last
#: value. Diverging lines would hide all others.
MAX_EXCURSION_RATIO, MAX_ERROR_RATIO = 4.0, 1000.0


def angle_chart(
    time: Floats, lines: Sequence[tuple[str, Floats]], output: str, title: str, caption: str, **options: Any
) -> LineChart:
    """Chart of an angle over time by several models; the options are those of a line chart."""
    options = {"points": LINE_POINTS, "caption": caption.replace(" -", " −"), **options}
    return LineChart(time, lines, title=title, x_label="time [s]", y_label=f"{symbol(output)} [rad]", **options)


def reference_label(*, simulated: bool) -> str:
    """Label of the line that models are compared with."""
    return "simulated arm" if simulated else "measured"


def fit_chart(
    models: Sequence[tuple[str, Comparison]], output: str, title: str, caption: str = "", *, simulated: bool
) -> LineChart:
    """Chart of an angle and its simulations by some models, without far excursions."""
    first = models[0][1]
    reference, time = first.measured[output][0], pulse_times(first)
    middle = float(np.mean(reference))
    limit = MAX_EXCURSION_RATIO * float(np.max(np.abs(reference - middle)))
    lines, remarks = [(reference_label(simulated=simulated), reference)], []
    for label, comparison in models:
        response = comparison.simulated[output][0]
        with np.errstate(invalid="ignore"):
            response = np.where(np.abs(response - middle) <= limit, response, np.nan)
        out_of_range = np.flatnonzero(np.isnan(response))
        if out_of_range.size:
            remarks.append(f"{label} leaves the drawing after {time[out_of_range[0]]:.2g} s")
        if out_of_range.size < response.size:
            lines.append((label, response))
    words = " ".join(part for part in (caption, "; ".join(remarks) + "." if remarks else "") if part)
    return angle_chart(time, lines, output, title, words)


def printed_model_charts(reproduction: Reproduction) -> list[Figure]:
    """Charts of the printed hub models under the paper's current, beside an angle of the implied standard deviation."""
    charts: list[Figure] = []
    for output in dict.fromkeys(r.output for r in reproduction.ran if r.output.endswith("1")):
        rows = [r for r in reproduction.ran if r.output == output]
        last = rows[-1]
        caption = (
            f"The printed equations of Table {3 + int(output[-2])} from the current alone, and the simulated arm, "
            f"scaled to the deviation that the printed RMSE / NR implies ({last.implied_deviation:.2g} rad). p = "
            f"{last.p} moves {last.deviation_ratio:.0f} times less than the angle that it was identified from."
        )
        lines = [("simulated arm", last.arm), *((f"printed, p = {r.p}", r.response) for r in rows)]
        title = f"{symbol(output)}: the printed models under the paper's current"
        charts.append(angle_chart(last.time, lines, output, title, caption))
    return charts


def share_picture(ruling: ClaimVerdict) -> Markup:
    """Bar of the share of cases in which a claim holds, for every level of the deciding factor."""
    levels = ruling.levels or (("", ruling.cases, ruling.holding_cases),)
    height = 10 * len(levels) - 2
    words = "; ".join(f"{level + ': ' if level else ''}{holding} of {count}" for level, count, holding in levels)
    out = [Markup('<svg class="share" viewBox="0 0 88 {}" role="img" aria-label="holds in {}">').format(height, words)]
    for k, (_, count, holding) in enumerate(levels):
        filled = 88 * holding / max(count, 1)
        out.append(Markup('<rect class="held" x="0" y="{}" width="{:.1f}" height="8"/>').format(10 * k, filled))
        out.append(Markup('<rect x=".5" y="{}" width="87" height="7"/>').format(10 * k + 0.5))
    return Markup("").join([*out, Markup("</svg>")])


def convergence_chart(traces: Mapping[int, MultiInnovationTrace], title: str, *, log_x: bool = True) -> LineChart:
    """Chart of the error (45) over the steps of the recursion, one line per p."""
    end = max(float(t.error[-1]) for t in traces.values())
    labeled_traces, gaps = [], False
    for p, trace in traces.items():
        with np.errstate(invalid="ignore"):
            near = np.where(trace.error <= MAX_ERROR_RATIO * end, trace.error, np.nan)
        near = near if np.isfinite(near).any() else trace.error
        gaps = gaps or bool(np.isnan(near).any())
        labeled_traces.append((f"p = {p}", replace(trace, error=near)))
    figure = trace_chart(labeled_traces, title=title, log_x=log_x)
    words = f"Errors above {MAX_ERROR_RATIO:g} times the last ones are not drawn."
    return replace(figure, caption=f"{figure.caption} {words}".strip()) if gaps else figure


def derivative_chart(derived: DroppedDerivative, *, simulated: bool = True) -> Figure:
    """Chart of the measured deflection, of (14)-(15), and of the published form with the same parameters."""
    nr, bent = metrics(derived.derived, derived.published).nr, derived.correlations
    own = reference_label(simulated=simulated)
    lines = [(own, derived.measured), ("(14)–(15)", derived.derived), ("(22)–(25)", derived.published)]
    caption = (
        f"Equal parameters in both forms; the order of the current is 0 instead of {derived.order:.3g}. NR between "
        f"both: {nr:.3g}. Correlation with the current: {own} {bent['measured']:.2f}, (14)–(15) {bent['derived']:.2f}, "
        f"(22)–(25) {bent['published']:.2f}."
    )
    title = f"{symbol(derived.output)}: which way the link bends"
    return angle_chart(derived.time, lines, derived.output, title, caption)


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
    """Models of Figures 6, 9 and 10; Euler's method needs a start at rest."""
    manual = "integer, Euler" if stage.traces else "integer, exact"
    last = f"p = {printed.INNOVATION_LENGTHS[-1]}"
    labels = {"integer, manual": manual, last: last, "output error": "output error"}
    return {heading: stage.candidates[label] for heading, label in labels.items()}


def stage_figures(stage: Stage, *, simulated: bool) -> list[Figure]:
    """Figures 4-6 or 7-9."""
    first = 4 if stage.number == 1 else 7
    errors = [(f"p = {p}", stage.candidates[f"p = {p}"].estimation) for p in printed.INNOVATION_LENGTHS]
    figures: list[Figure] = []
    for place, output in enumerate(stage.outputs, first):
        title = f"Figure {place}(a). {symbol(output)}: absolute error of the free run"
        figures.append(error_chart(errors, output, title=title, units={output: "rad"}, points=LINE_POINTS))
        if output in stage.traces:
            title = f"Figure {place}(b). {symbol(output)}: error (45) after each step"
            figures.append(convergence_chart(stage.traces[output], title))
    for letter, output in zip("ab", stage.outputs, strict=True):
        number = f"{first + 2}({letter})"
        figures += _fits_chart(_beside_integer(stage), output, number, sine=False, simulated=simulated)
    return figures


def _place(figure: int, output: str) -> str:
    return f"{figure}({'abcd'[printed.ANGLE_NAMES.index(output)]})"


def sine_figures(reproduction: Reproduction) -> list[Figure]:
    """Figure 10."""
    return [
        figure
        for stage, output in reproduction.angles
        for figure in _fits_chart(
            _beside_integer(stage), output, _place(10, output), sine=True, simulated=reproduction.simulated
        )
    ]


def rival_figures(reproduction: Reproduction) -> list[Figure]:
    """Figure 11, on the validation run, or on the estimation run without one."""
    names = dict(zip(MULTI_INNOVATION_LABELS, ("p = 7, K₀ = 1", "p = 7, weak prior"), strict=True))
    figures = []
    for output, rival in reproduction.rivals.items():
        models = {names.get(n, n): c for n, c in rival.models.items() if n != "differential evolution"}
        has_validation = rival.models["genetic"].validation is not None
        figures += _fits_chart(
            models, output, _place(11, output), sine=has_validation, simulated=reproduction.simulated
        )
    return figures


def flow_chart() -> Figure:
    """Figure 2: from the physics to the model, a drawing for wide and one for narrow screens."""
    files = (Path(__file__).with_name(f"flow_chart_{screen}.svg") for screen in ("wide", "narrow"))
    drawings = (Markup(file.read_text(encoding="utf-8")) for file in files)  # our own files
    return StaticFigure("Figure 2. From the physics to the identified model", *drawings)
