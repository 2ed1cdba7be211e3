"""The paper's section 5 as a page: verdicts first, then every table and figure beside what is printed."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from ftlm import printed
from ftlm.flexible_link import PARAMETERS
from ftlm.models import numeric
from ftlm.report.figures import (
    NARROW,
    Figure,
    bode_charts,
    error_chart,
    heat_map,
    line_chart,
    pulse_times,
    response_frequencies,
    trace_chart,
)
from ftlm.report.landscape import output_error_landscape
from ftlm.report.page import Section, check_free, write_page
from ftlm.report.tables import (
    Exact,
    Table,
    equation_html,
    estimates_table,
    grouped_warnings,
    number,
    search_summary,
    symbol,
    symbol_html,
)
from ftlm.reproduction import (
    RIVAL_ALPHA,
    TRACE_EVERY,
    WEAK_PRIOR,
    implied_spreads,
    printed_saturation,
    table_3_coefficients,
)
from ftlm.validation import metrics

if TYPE_CHECKING:
    import os
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from ftlm.printed import Printed
    from ftlm.report.tables import Cell
    from ftlm.reproduction import Candidate, Reproduction, Rival, Stage
    from ftlm.validation import Comparison, Metrics

__all__ = ["reproduction_page", "reproduction_text"]

#: Points of a line of these charts: there are some fifty on the page, which stays below 2 MB.
LINE_POINTS = 500
WEAK = f"10{str(round(math.log10(WEAK_PRIOR))).translate(str.maketrans('0123456789', '⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
LETTERS = ("gamma", "alpha", "beta", "mu"), ("a", "b", "d", "g")
PAPER = (
    "Wang, Li, Li, Liang, Gao: Establishment and Identification of Fractional-Order Model for Structurally Symmetric "
    "Flexible Two-Link Manipulator System, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072"
)
PRINTED_NOTE = "Rows in which “printed” stands are the paper's numbers, from the authors' arm; all others are computed."

#: Table 1: the symbols, what they are, and what they are called here.
SYMBOLS = (
    ("θ₁₁, θ₂₁", "hub angles: how far each motor has turned", "theta11, theta21 [rad]"),
    ("θ₁₂, θ₂₂", "deflection angles: how far each link bends at its root", "theta12, theta22 [rad]"),
    ("I₁, I₂", "motor currents", "I1, I2 [A]"),
    ("T₁, T₂", "motor torques, proportional to the currents", "LinkParameters.torque_constant [N m/A]"),
    ("V", "viscoelastic potential energy of a link, (7)", "LinkParameters.stiffness"),
    ("Tr₁₁, Tr₁₂, Tr", "kinetic energies of motor, link and both, (8), (9)", "hub_inertia, link_inertia"),
    ("Q₁₁, Q₁₂", "generalised forces: motor and its friction, friction of the link, (10), (11)",
     "hub_friction, link_friction"),
    ("D^α θ", "highest derivative of an equation", "alpha1 … alpha4"),
    ("D^γ θ₁₁, D^γ θ₂₁", "derivative of the hub angle in the hub's friction", "gamma1, gamma3 (gamma2, gamma4 follow)"),
    ("D^β θ₁₂, D^β θ₂₂", "derivative of the deflection in the link's elasticity", "beta2, beta4 (beta1, beta3 follow)"),
    ("D^μ θ₁₂, D^μ θ₂₂", "derivative of the deflection in the link's friction", "mu2, mu4 (mu1, mu3 follow)"),
)  # fmt: skip

#: Table 2: the seven steps, and what does each.
STEPS = (
    ("Record currents and angles", "rig.record, load", "Run: point samples with units"),
    ("Choose M, make the operational matrix", "operational_matrix, haar_matrix",
     "never formed: every integral is a truncated power series, by fast Fourier transform"),
    ("Turn the equation into an integral equation, (38)", "flexible_link, equation", "divided by D^α, exactly"),
    ("Expand the data in Haar wavelets, (39)", "haar_transform", "a change of basis; pulse means do as well"),
    ("Vary the orders, coefficients by (44)", "search_orders, identify(method='multi-innovation')",
     "closed form of (44); multi_innovation_trace is the recursion"),
    ("Simulate, and sum the errors, (45)", "compare, simulate", "both errors, kept apart"),
    ("Take the orders of the smallest error", "SearchResult.table, .model", "every candidate accounted for"),
)  # fmt: skip


# ------------------------------------------------------------------------------------------------ rows and tables


def _letters(found: dict[str, Any], output: str) -> dict[str, Any]:
    """Numbers of one angle's equation without their index: alpha1 is alpha."""
    index = str(printed.OUTPUTS.index(output) + 1)
    return {n.rstrip("0123456789"): v for n, v in found.items() if n[len(n.rstrip("0123456789")) :] == index}


def _numbers(candidate: Candidate, output: str) -> tuple[dict[str, float], dict[str, float]]:
    """Orders and coefficients of one equation by letter."""
    item = next(e for e in candidate.model.equations if e.output == output)
    greek = {"a": "beta", "b": "gamma", "d": "mu"}
    orders, coefficients = {"alpha": item.order.constant}, {}
    for term in item.terms:
        letter = (term.name or "").rstrip("0123456789")
        coefficients[letter] = float(term.coefficient) + 0.0
        if letter in greek:
            orders[greek[letter]] = term.order.constant
    return orders, coefficients


def _three(figures: Metrics | None) -> list[Cell]:
    return [None] * 3 if figures is None else [figures.error, figures.rmse, figures.nr]


def _printed_cells(row: Printed) -> list[Cell]:
    orders = [Exact(row.orders[n]) if n in row.orders else None for n in LETTERS[0]]
    coefficients = [Exact(row.coefficients[n]) if n in row.coefficients else None for n in LETTERS[1]]
    criteria: list[Cell] = [None if v is None else Exact(v) for v in (row.error, row.rmse, row.nr)]
    return [*orders, *coefficients, *criteria]


def model_rows(stage: Stage, output: str) -> list[list[Cell]]:
    """Rows of Table 4 or 5 for one angle, computed and printed in turn."""
    beside = {"integer, Euler": printed.INTEGER[output]}
    beside |= {f"p = {p}": row for p, row in printed.FRACTIONAL[output].items()}
    rows: list[list[Cell]] = []
    for label, candidate in stage.candidates.items():
        orders, coefficients = _numbers(candidate, output)
        rows.append(
            [
                label,
                *(Exact(round(orders[n], 4) + 0.0) if n in orders else None for n in LETTERS[0]),
                *(coefficients.get(n) for n in LETTERS[1]),
                *_three(candidate.estimation.output_error.get(output)),
            ]
        )
        if label in beside:
            shown = label.partition(",")[0]
            rows.append([Markup("<em>printed: {}</em>").format(shown), *_printed_cells(beside[label])])
    return rows


def model_table(stage: Stage, title: str) -> Table:
    """Table 4 or 5."""
    rows: list[list[Cell]] = []
    headings = {}
    for output in stage.outputs:
        headings[len(rows)] = symbol_html(output)
        rows += model_rows(stage, output)
    heads = ("error (45)", "RMSE", "NR")
    return Table(
        title,
        ("model", *(symbol_html(n) for n in (*LETTERS[0], *LETTERS[1])), *heads),
        rows,
        groups=(("", 1), ("orders", 4), ("coefficients", 4), ("output error (free run)", 3)),
        headings=headings,
        note="Free runs are driven as the method drives them: rows of p, least squares, instrumental variables and the "
        "identified integer model by the current and the measured other angle; the manual's integer model (by explicit "
        "Euler at the run's step, and exactly) and output error by the current alone. Errors in rad. " + PRINTED_NOTE,
    )  # fmt: skip


def fits_table(stage: Stage) -> Table:
    """Both errors of every model, and its fit on both inputs, as identified and from the current alone."""
    rows: list[list[Cell]] = []
    headings = {}
    for output in stage.outputs:
        headings[len(rows)] = symbol_html(output)
        for label, candidate in stage.candidates.items():
            alone = [found[output].fit for found in candidate.alone.values()]
            validation = candidate.validation
            rows.append(
                [
                    label,
                    candidate.estimation.equation_error[output].nr,
                    candidate.estimation.output_error[output].nr,
                    candidate.estimation.output_error[output].fit,
                    None if validation is None else validation.output_error[output].fit,
                    *[*alone, None, None][:2],
                ]
            )
    return Table(
        f"Stage {stage.number}: both errors, and the fit of the free run on both inputs",
        ("model", "equation error", "free run", "square", "sine", "square", "sine"),
        rows,
        groups=(("", 1), ("NR on the square", 2), ("fit %, driven as identified", 2), ("fit %, current alone", 2)),
        headings=headings,
        note="Everything was identified from the square run. 100 is perfect, 0 is as good as the mean.",
    )


def verdicts(found: Reproduction) -> list[str]:
    """What holds and what does not, a paragraph each."""
    words = {True: "Holds.", False: "Does not hold.", None: "Cannot be told."}
    return [
        Markup('<span class="verdict"><strong>{} {}</strong><span class="note">{}</span></span>').format(
            words[c.holds], c.claim, c.evidence[0].upper() + c.evidence[1:]
        )
        for c in found.claims
    ]


def symbols_table() -> Table:
    """Table 1."""
    rows: list[list[Cell]] = [list(row) for row in SYMBOLS]
    return Table("Table 1. Symbols", ("symbol", "what it is", "name here"), rows, wrap=True)


def steps_table() -> Table:
    """Table 2, every step with the function that does it."""
    rows: list[list[Cell]] = [
        [f"{k}. {step}", Markup(", ").join(Markup("<code>{}</code>").format(f) for f in functions.split(", ")), how]
        for k, (step, functions, how) in enumerate(STEPS, 1)
    ]
    title = "Table 2. The seven steps, and the functions of ftlm that do them"
    return Table(title, ("step", "function", "how"), rows, wrap=True)


def parameters_table() -> Table:
    """Table 3 beside the maker's effective parameters."""
    names = {
        "J": ("hub_inertia", "link_inertia"), "B": ("hub_friction", "link_friction"), "K_s": ("stiffness",) * 2,
        "K_τ": ("torque_constant",) * 2,
    }  # fmt: skip
    rows: list[list[Cell]] = []
    for name, (value, unit) in printed.TABLE_3.items():
        stem, index = name.rstrip("0123456789"), name[len(name.rstrip("0123456789")) :]
        field = names.get(stem.rstrip("_"))
        effective: Cell = None
        if field is not None:
            place = int(index[1]) - 1 if len(index) == 2 else 0
            effective = Exact(getattr(PARAMETERS["effective"][int(index[0])], field[place]))
        shown = Markup("<i>{}</i><sub>{}</sub>").format(name[0], name.partition("_")[2])
        ratio = value / effective if isinstance(effective, float) and effective else None
        rows.append([shown, Exact(value), unit, effective, ratio])
    return Table(
        "Table 3. Parameters: printed, and the maker's effective ones",
        ("parameter", "printed", "printed unit", "effective, SI", "printed / effective"),
        rows,
        note="Effective torque constants hold gear ratio and efficiency. Lengths enter no equation.",
    )


def integer_table() -> Table:
    """What Table 3 and the effective parameters make of the integer-order rows."""
    rows: list[list[Cell]] = [
        [symbol_html(n), t + 0.0, e + 0.0, Exact(p), t / p, e / p] for n, (t, e, p) in table_3_coefficients().items()
    ]
    return Table(
        "Coefficients of the integer-order models",
        ("coefficient", "from Table 3", "from the effective set", "printed in Tables 4, 5", "Table 3 / printed",
         "effective / printed"),
        rows,
    )  # fmt: skip


def saturation_table(found: Reproduction) -> Table:
    """What p does: coefficients with the prior of the paper's kind, and with a weak one."""
    rows: list[list[Cell]] = []
    headings = {}
    for stage in found.stages.values():
        last = stage.candidates[f"p = {printed.INNOVATION_LENGTHS[-1]}"]
        for output in stage.outputs:
            headings[len(rows)] = symbol_html(output)
            x, c, _ = printed_saturation(output)
            name = f"a{printed.OUTPUTS.index(output) + 1}"
            for p in printed.INNOVATION_LENGTHS:
                own = stage.candidates[f"p = {p}"]
                alike = _numbers(own, output)[0] == _numbers(last, output)[0]
                value, stated = own.model.coefficients[name], printed.FRACTIONAL[output][p].coefficients["a"]
                weak = stage.weak[output][p][name] if stage.weak else None
                rows.append(
                    [f"p = {p}", value, "yes" if alike else "no", weak, Exact(stated),
                     x * p / (p + c)]
                )  # fmt: skip
    prior = Markup("<i>K</i><sub>0</sub> = {}")
    return Table(
        "Coefficient a by innovation length",
        ("innovation length", prior.format("1"), "orders of p = 7", prior.format(WEAK),
         "printed", Markup("<i>x p</i> / (<i>p</i> + <i>c</i>)")),
        rows,
        headings=headings,
        note="The last column is the curve of a prior through the printed values of p = 1 and p = 7. With the weak "
        "prior all p are at the orders of p = 7.",
    )  # fmt: skip


def genetic_table(found: Reproduction) -> Table:
    """Table 6."""
    rows: list[list[Cell]] = []
    for stage in found.stages.values():
        for output, rival in stage.rivals.items():
            orders, coefficients = _numbers(rival.genetic, output)
            rows.append(
                [Markup("{}, best of {} seeds").format(symbol_html(output), len(_seeds(rival))),
                 *(Exact(round(orders[n], 4) + 0.0) for n in LETTERS[0]), *(coefficients[n] for n in LETTERS[1])]
            )  # fmt: skip
            row = printed.GENETIC[output]
            rows.append(
                [Markup("<em>printed: {}</em>").format(symbol_html(output)),
                 *(Exact(row.orders[n]) for n in LETTERS[0]), *(Exact(row.coefficients[n]) for n in LETTERS[1])]
            )  # fmt: skip
    return Table(
        "Table 6. Orders and coefficients by the genetic algorithm",
        ("angle", *(symbol_html(n) for n in (*LETTERS[0], *LETTERS[1]))),
        rows,
        groups=(("", 1), ("orders", 4), ("coefficients", 4)),
        note=PRINTED_NOTE,
    )


def _seeds(rival: Rival) -> dict[str, float]:
    result = rival.genetic.result
    errors: dict[str, float] = {} if result is None else next(iter(result.settings["errors"].values()))
    return errors


def rivals_table(found: Reproduction) -> Table:
    """Table 7, like for like."""
    rows: list[list[Cell]] = []
    headings = {}
    spreads = implied_spreads()
    for stage in found.stages.values():
        for output, rival in stage.rivals.items():
            headings[len(rows)] = symbol_html(output)
            for label, candidate in (("genetic algorithm", rival.genetic), ("multi-innovation, p = 7", rival.lattice)):
                other = candidate.validation
                rows.append(
                    [label, *_three(candidate.estimation.output_error[output]),
                     *_three(None if other is None else other.output_error[output]),
                     float(np.std(candidate.estimation.measured[output][0]))]
                )  # fmt: skip
            for k, label in enumerate(("genetic algorithm", "multi-innovation")):
                values: list[Cell] = [Exact(v) for v in printed.RIVALS[output][k]]
                rows.append(
                    [Markup("<em>printed: {}</em>").format(label), *values, None, None, None, spreads[output][k]]
                )
    return Table(
        "Table 7. Genetic algorithm and multi-innovation: the same record, the same number of candidates",
        ("algorithm", "error (45)", "RMSE", "NR", "error (45)", "RMSE", "NR", "σ of the angle"),
        rows,
        groups=(("", 1), ("square, identified from", 3), ("sine, never seen", 3), ("", 1)),
        headings=headings,
        note="Free runs, driven by the current and the measured other angle. Both keep to α from "
        f"{RIVAL_ALPHA[0]:g} to {RIVAL_ALPHA[1]:g}; what p = 7 comes to on the whole lattice stands in Tables 4 and 5. "
        "Printed σ is RMSE / NR. " + PRINTED_NOTE,
    )


def seeds_table(found: Reproduction) -> Table:
    """What each seed came to, and with how many evaluations."""
    rivals = {o: r for s in found.stages.values() for o, r in s.rivals.items()}
    seeds = list(dict.fromkeys(seed for r in rivals.values() for seed in _seeds(r)))
    rows: list[list[Cell]] = []
    for output, rival in rivals.items():
        settings = {} if rival.genetic.result is None else rival.genetic.result.settings
        rows.append(
            [symbol_html(output), rival.candidates, settings["evaluations"][output] // max(len(seeds), 1),
             settings["population"], *(_seeds(rival).get(s) for s in seeds),
             rival.lattice.estimation.output_error[output].error]
        )  # fmt: skip
    return Table(
        "Error (45) by seed",
        ("angle", "candidates", "evaluations a seed", "population", *(f"seed {s}" for s in seeds), "p = 7"),
        rows,
    )


def bounds_table(found: Reproduction) -> Table:
    """Bounds of the genetic algorithm."""
    rows: list[list[Cell]] = []
    for stage in found.stages.values():
        for output, rival in stage.rivals.items():
            settings = {} if rival.genetic.result is None else rival.genetic.result.settings
            bounds = _letters({n: tuple(b) for n, b in settings["bounds"].items()}, output)
            cells = [
                f"{number(Exact(low), 4)} … {number(Exact(high), 4)}" for low, high in (bounds[n] for n in LETTERS[0])
            ]
            cells += [f"±{number(high, 4)}" for _, high in (bounds[n] for n in LETTERS[1])]
            rows.append([symbol_html(output), *cells])
    return Table(
        "Bounds of the genetic algorithm",
        ("angle", *(symbol_html(n) for n in (*LETTERS[0], *LETTERS[1]))),
        rows,
        note="Orders in steps of 0.001, on the interval of the lattice. Coefficients: twice the value that the maker "
        "states, or four times what makes a term alone as large as the output.",
    )


# ------------------------------------------------------------------------------------------------ figures


def _unit_label(output: str) -> str:
    return f"{symbol(output)} [rad]"


def fit_chart(
    comparison: Comparison, models: Iterable[tuple[str, Comparison]], output: str, title: str, caption: str = ""
) -> Figure:
    """Measured angle and the free runs of some models."""
    measured = comparison.measured[output][0]
    lines = [("measured", measured)] + [(label, c.simulated[output][0]) for label, c in models]
    return line_chart(
        pulse_times(comparison, 0), lines, title=title, x_label="time [s]", y_label=_unit_label(output),
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


def sine_figures(found: Reproduction) -> list[Figure]:
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


def rival_figures(found: Reproduction) -> list[Figure]:
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


# ------------------------------------------------------------------------------------------------ the page


def _stage_section(found: Reproduction, stage: Stage) -> Section:
    number = stage.number
    table = 4 if number == 1 else 5
    joint = stage.candidates["output error"]
    searches = {
        f"{label}, {o}": s
        for label, c in stage.candidates.items()
        if c.result is not None
        for o, s in c.result.searches.items()
    }
    return Section(
        f"Stage {number} (Table {table}, Figures {3 * number + 1}–{3 * number + 3})",
        paragraphs=[
            "Joint output error, order law and coefficient law imposed:",
            *(equation_html(e) for e in joint.model.equations),
        ],
        warnings=grouped_warnings({label: c.result for label, c in stage.candidates.items()}),
        tables=[
            model_table(stage, f"Table {table}. Identified models of stage {number}, square input"),
            estimates_table(joint.result, found.truth.get(stage.number, {})),
            fits_table(stage),
            search_summary(searches),
        ],
        figures=stage_figures(stage),
    )


def _weak_section(found: Reproduction) -> Section:
    figures = []
    for stage in found.stages.values():
        for output, traces in stage.weak_traces.items():
            named = [(f"p = {p}", trace) for p, trace in traces.items()]
            figures.append(trace_chart(named, title=f"{symbol(output)}: error (45), weak prior", log_x=True))
    return Section(
        "What p does",
        paragraphs=[
            "Recursion (44) is least squares with weights: row i counts min(p, M − i + 1) times, against a prior that "
            "holds the coefficients near 0 with covariance K0. So p is a weight of the data against the prior. With a "
            "weak prior every p gives the least-squares answer, step by step.",
        ],
        tables=[saturation_table(found)],
        figures=figures,
        small=True,
    )


def _near_section(found: Reproduction) -> Section:
    rows: list[list[Cell]] = []
    figures = []
    for stage in found.stages.values():
        for label, candidate in (("printed", stage.near), ("smallest equation error", stage.by_equation)):
            for output in stage.outputs:
                orders, _ = _numbers(candidate, output)
                rows.append(
                    [Markup("{}, {}").format(symbol_html(output), label), *(Exact(orders[n]) for n in LETTERS[0]),
                     candidate.estimation.equation_error[output].nr, candidate.estimation.output_error[output].nr]
                )  # fmt: skip
        output = stage.outputs[1]
        figures.append(
            fit_chart(
                stage.near.estimation, [("printed orders", stage.near.estimation)], output,
                f"{symbol(output)}: the orders of Table {3 + stage.number} with the best coefficients for this run",
            )
        )  # fmt: skip
    table = Table(
        "Orders close to α: equation error and free run",
        ("angle, orders", *(symbol_html(n) for n in LETTERS[0]), "NR of the equation error", "NR of the free run"),
        rows,
        note="Coefficients by least squares. “Smallest equation error”: the orders that the lattice gives when the "
        "equation error (RMSE) ranks its candidates.",
    )
    words = (
        "With α − ν small, I^(α−ν) y is nearly y itself. A few such terms reproduce any smooth signal on the "
        "right-hand side, whatever the machine is; only the free run shows what the equation knows."
    )
    return Section("Orders close to one another", [words], tables=[table], figures=figures)


def _derivative_section(found: Reproduction) -> Section:
    figures = []
    for stage in found.stages.values():
        part = stage.derived
        nr = metrics(part.published, part.derived).nr
        figures.append(
            line_chart(
                part.time, [("as published", part.published), ("as derived", part.derived)],
                title=f"{symbol(part.output)} from the current alone, order of the current 0 and {part.order:.3g}",
                x_label="time [s]", y_label=_unit_label(part.output), points=LINE_POINTS,
                caption=f"All other numbers alike. NR between the two: {nr:.3g}.",
            )
        )  # fmt: skip
    words = (
        "Eliminating the hub angle's highest derivative from (15) by (17) differentiates the current as well, by the "
        "order α₂ − μ₂ + γ₁ − α₁, which (19) and (21) leave out. It vanishes for whole orders. "
        "flexible_link(input_order='derived') keeps it; a symbolic test derives both."
    )
    return Section("The dropped derivative", [words], figures=figures)


def _landscape_section(found: Reproduction) -> Section:
    figures, words = [], []
    fits = [(stage, stage.candidates["output error"].result) for stage in found.stages.values()]
    joint = [(stage, result) for stage, result in fits if result is not None and result.joint is not None]
    with ThreadPoolExecutor(max(1, len(joint))) as pool:
        landscapes = list(pool.map(output_error_landscape, [result for _, result in joint]))
    for (stage, _), drawn in zip(joint, landscapes, strict=True):
        if drawn is not None:
            figures.append(heat_map(drawn))
            words.append(
                f"Stage {stage.number}: the two orders that this run tells apart least are {symbol(drawn.names[0])} "
                f"and {symbol(drawn.names[1])} (correlation {number(drawn.correlation, 3)})."
            )
    return Section("Order landscape", words, figures=figures, small=True)


def _bode_section(found: Reproduction) -> Section:
    figures = []
    for stage in found.stages.values():
        model = stage.candidates["output error"].model
        omega = response_frequencies(model, found.square.step, found.square.duration)
        figures += bode_charts(model, omega)
    return Section(
        "Frequency response", ["Of the joint output-error models, with 95 % bands."], figures=figures, small=True
    )


def _runs_section(found: Reproduction) -> Section:
    rows: list[list[Cell]] = []
    for run in (found.square, found.sine):
        if run is not None:
            rows.append(
                [run.name, run.length, Exact(run.step), run.duration,
                 ", ".join(f"{symbol(n)} ±{np.max(np.abs(run[n])):.3g} {run.units[n]}" for n in run.inputs)]
            )  # fmt: skip
    first = next(iter(found.stages.values()))
    m = first.candidates["p = 7"].estimation.m
    notes = [
        f"M = {m} block pulses, order lattice in steps of {found.lattice.step:g}, α from {found.lattice.alpha[0]:g} to "
        f"{found.lattice.alpha[1]:g}, K0 = 1, rows in Haar coordinates from coarse to fine. Convergence is drawn at "
        f"every {TRACE_EVERY}th step. Instrumental variables are searched two steps around the "
        "orders of least squares.",
        "Explicit Euler steps at the step of the run, 0.002 s on the virtual rig, as in the paper.",
        *found.notes,
    ]
    return Section(
        "Runs and settings", notes, tables=[Table("Runs", ("run", "rows", "step [s]", "length [s]", "currents"), rows)]
    )


def reproduction_page(found: Reproduction, path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """Write the reproduction as one page.

    Parameters
    ----------
    found
        From :func:`ftlm.reproduce`.
    path
        File to write.
    force
        Whether to overwrite.

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
    missing = (
        [] if found.sine is not None else ["No second run was given: nothing is validated, Figure 10 is left out."]
    )
    sections = [
        Section("What holds and what does not", verdicts(found), warnings=[*missing, *found.notes]),
        Section(
            "Symbols and steps",
            ["Figures 1 and 3 are pictures of the authors' arm and are not shown."],
            tables=[symbols_table(), steps_table()],
            figures=[flow_chart()],
        ),
        Section("Parameters (Table 3)", tables=[parameters_table(), integer_table()]),
        *(_stage_section(found, s) for s in found.stages.values()),
    ]
    if found.sine is not None:
        sections.append(Section("The other input (Figure 10)", figures=sine_figures(found)))
    if any(s.rivals for s in found.stages.values()):
        words = (
            "Both search the same record; the genetic algorithm may evaluate as many candidates as the lattice has. It "
            "varies orders and coefficients and is judged by (45) itself."
        )
        sections.append(
            Section(
                "The genetic algorithm (Tables 6 and 7, Figure 11)", [words],
                tables=[genetic_table(found), rivals_table(found), seeds_table(found), bounds_table(found)],
                figures=rival_figures(found),
            )
        )  # fmt: skip
    sections += [
        _weak_section(found), _near_section(found), _derivative_section(found), _landscape_section(found),
        _bode_section(found), _runs_section(found),
    ]  # fmt: skip
    origin = "a simulated arm whose truth is known" if found.simulated else f"the runs {_names(found)}"
    lead = (
        f"Section 5 of the paper, recomputed on {origin}, beside what the paper prints. {PAPER}. Numbers in rows "
        "marked “printed” are the paper's; every other number, figure and verdict on this page is computed."
    )
    return write_page(path, title="The paper reproduced", sections=sections, lead=lead, force=force)


def _names(found: Reproduction) -> str:
    return " and ".join(f"“{r.name}”" for r in (found.square, found.sine) if r is not None)


def reproduction_text(found: Reproduction) -> str:
    """Verdicts and fits for a terminal."""
    words = {True: "holds", False: "does not hold", None: "cannot be told"}
    lines = []
    for claim in found.claims:
        lines += [f"{words[claim.holds].upper()}: {claim.claim}", f"    {claim.evidence}"]
    for stage in found.stages.values():
        lines += ["", f"Stage {stage.number}: fit of the free run in percent, driven as identified"]
        heads = [f"{o} {run}" for o in stage.outputs for run in ("square", "sine")]
        lines.append(" " * 26 + "".join(f"{h:>16}" for h in heads))
        for label, candidate in stage.candidates.items():
            cells = ""
            for o in stage.outputs:
                other = candidate.validation
                fits = (
                    candidate.estimation.output_error[o].fit,
                    math.nan if other is None else other.output_error[o].fit,
                )
                cells += "".join(f"{'–' if math.isnan(f) else f'{f:.2f}':>16}" for f in fits)
            lines.append(f"{label:<26}{cells}")
        lines += [f"  {numeric(e)}" for e in stage.candidates["output error"].model.equations]
    lines += [f"note: {n}" for n in found.notes]
    return "\n".join(lines)
