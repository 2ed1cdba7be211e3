"""The paper's tables, each computed row beside the printed one."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from markupsafe import Markup

from ftlm.arm.parameters import PARAMETERS
from ftlm.judge.metrics import Metrics
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, Exact, number, symbol_html
from ftlm.paper import printed
from ftlm.paper.claims import implied_spreads, printed_saturation, table_3_coefficients
from ftlm.paper.printed import Printed
from ftlm.paper.stages import RIVAL_ALPHA, WEAK_PRIOR, Candidate, Recomputed, Rival, Stage

WEAK = f"10{str(round(math.log10(WEAK_PRIOR))).translate(str.maketrans('0123456789', '⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
LETTERS = ("gamma", "alpha", "beta", "mu"), ("a", "b", "d", "g")
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


def letters(found: dict[str, Any], output: str) -> dict[str, Any]:
    """Numbers of one angle's equation without their index: alpha1 is alpha."""
    index = str(printed.OUTPUTS.index(output) + 1)
    return {n.rstrip("0123456789"): v for n, v in found.items() if n[len(n.rstrip("0123456789")) :] == index}


def numbers_of(candidate: Candidate, output: str) -> tuple[dict[str, float], dict[str, float]]:
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


def three(figures: Metrics | None) -> list[Cell]:
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
        orders, coefficients = numbers_of(candidate, output)
        rows.append(
            [
                label,
                *(Exact(round(orders[n], 4) + 0.0) if n in orders else None for n in LETTERS[0]),
                *(coefficients.get(n) for n in LETTERS[1]),
                *three(candidate.estimation.output_error.get(output)),
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


def saturation_table(found: Recomputed) -> Table:
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
                alike = numbers_of(own, output)[0] == numbers_of(last, output)[0]
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


def genetic_table(found: Recomputed) -> Table:
    """Table 6."""
    rows: list[list[Cell]] = []
    for stage in found.stages.values():
        for output, rival in stage.rivals.items():
            orders, coefficients = numbers_of(rival.genetic, output)
            rows.append(
                [Markup("{}, best of {} seeds").format(symbol_html(output), len(seeds_of(rival))),
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


def seeds_of(rival: Rival) -> dict[str, float]:
    result = rival.genetic.result
    errors: dict[str, float] = {} if result is None else next(iter(result.settings["errors"].values()))
    return errors


def rivals_table(found: Recomputed) -> Table:
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
                    [label, *three(candidate.estimation.output_error[output]),
                     *three(None if other is None else other.output_error[output]),
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


def seeds_table(found: Recomputed) -> Table:
    """What each seed came to, and with how many evaluations."""
    rivals = {o: r for s in found.stages.values() for o, r in s.rivals.items()}
    seeds = list(dict.fromkeys(seed for r in rivals.values() for seed in seeds_of(r)))
    rows: list[list[Cell]] = []
    for output, rival in rivals.items():
        settings = {} if rival.genetic.result is None else rival.genetic.result.settings
        rows.append(
            [symbol_html(output), rival.candidates, settings["evaluations"][output] // max(len(seeds), 1),
             settings["population"], *(seeds_of(rival).get(s) for s in seeds),
             rival.lattice.estimation.output_error[output].error]
        )  # fmt: skip
    return Table(
        "Error (45) by seed",
        ("angle", "candidates", "evaluations a seed", "population", *(f"seed {s}" for s in seeds), "p = 7"),
        rows,
    )


def bounds_table(found: Recomputed) -> Table:
    """Bounds of the genetic algorithm."""
    rows: list[list[Cell]] = []
    for stage in found.stages.values():
        for output, rival in stage.rivals.items():
            settings = {} if rival.genetic.result is None else rival.genetic.result.settings
            bounds = letters({n: tuple(b) for n, b in settings["bounds"].items()}, output)
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
