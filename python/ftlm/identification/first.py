"""The first things on a page: verdict, warnings in groups, equations, what the model does by itself."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence

from markupsafe import Markup

from ftlm.base.errors import FtlmError
from ftlm.identification.summary import order_in_words
from ftlm.identification.verdict import Verdict
from ftlm.judge.concerns import SHOWN, concerns
from ftlm.model.charts import pole_charts
from ftlm.model.model import Model
from ftlm.paint.figure import Figure
from ftlm.paint.table import Table
from ftlm.paint.text import Cell, number, symbol, symbol_html
from ftlm.solve.modes import modes, steady_states

#: Figures of what a model does by itself, on a page.
MOST_FIGURES = 9
_LOOKS = {"trust": "trust", "with care": "care", "do not use": "not"}


def verdict_box(judged: Verdict, of: str = "") -> Markup:
    """A verdict as the first box of a page, perhaps of one of several; its word says what its colour says."""
    remedy = Markup(' <span class="todo">→ {}</span>').format(judged.remedy) if judged.remedy else ""
    return Markup('<div class="first {}" role="note"><strong>{}</strong>{}{}</div>').format(
        _LOOKS[judged.level],
        f"{of}{judged.level}" if of else judged.level.capitalize(),
        judged.reason[0].upper() + judged.reason[1:],
        remedy,
    )


def first_warnings(warnings: Sequence[str]) -> tuple[list[str], list[str]]:
    """At most three groups of warnings with what to do, the most serious first, and all warnings that are left."""
    found = concerns(warnings)
    shown: list[str] = []
    left: list[str] = []
    for k, concern in enumerate(found):
        if k >= SHOWN:
            left += concern.warnings
            continue
        remedy = concern.remedy if concern.remedy not in concern.warnings[0] else ""
        todo = Markup(' <span class="todo">→ {}</span>').format(remedy) if remedy else Markup("")
        shown.append(Markup("{}{}{}").format(concern.warnings[0], concern.count, todo))
        left += concern.warnings[1:]
    return shown, left


def title_of(model: Model) -> str:
    """What a page about a model is called."""
    structure = model.structure
    if structure.name != "equation":
        return structure.name
    inputs = [s for s in structure.signals if s not in structure.outputs]
    driven = f" from {', '.join(map(symbol, inputs))}" if inputs else ""
    return f"Model of {', '.join(map(symbol, structure.outputs))}{driven}"


def behaviour_tables(model: Model) -> list[Table]:
    """Steady state and modes with standard errors; nothing of what has none."""
    if model.structure.has_friction:
        return []
    tables = []
    try:
        found = modes(model)
        grows = any(mode.grows for mode in found)
        states = () if grows or model.structure.limits else steady_states(model)
    except FtlmError:
        # Equations that cannot be solved for their outputs together have neither.
        return []
    if states:
        rows: list[list[Cell]] = []
        for state in states:
            above, below = (model.units.get(n, "") for n in (state.output, state.input))
            pair = Markup("{} from {}").format(symbol_html(state.output), symbol_html(state.input))
            unit = f"{above}/{below}" if above and below else ""
            sure = order_in_words(state)
            if state.order > 0:
                runs = f" t^{state.order:.4g}/Γ({state.order + 1:.4g})" if state.order != 1 else " per second"
                rows.append([pair, state.rate, state.error, unit, f"none: it runs on, so much{runs}{sure}"])
            else:
                back = state.order < 0
                what = "0: it dies away" if back else "gain"
                rows.append([pair, state.gain, None if back else state.error, unit, f"{what}{sure}"])
        tables.append(
            Table("Steady state under a unit step", ("output", "value", "standard error", "unit", "what it is"), rows)
        )
    if found:
        rows = [
            [
                f"{k + 1}", f"{number(m.pole.real, 4)} ± {number(abs(m.pole.imag), 4)}j" if m.swings
                else number(m.pole.real, 4), m.frequency, m.frequency_error, m.damping, m.damping_error,
                m.time_constant if math.isfinite(m.time_constant) else "∞", m.time_constant_error,
            ]
            for k, m in enumerate(found)
        ]  # fmt: skip
        note = (
            "A swing has the time constant 1/|Re s|, a relaxation 1/|s|; standard errors are to first order from the "
            "covariance of the fit."
        )
        columns = ("mode", "pole s [rad/s]", "frequency [rad/s]", "±", "damping", "±", "time constant [s]", "±")
        tables.append(Table("Modes", columns, rows, note=note))
    return tables


def behaviour_figures(model: Model) -> list[Figure]:
    """Pole map and step responses; nothing of what has none, or leaves the range of numbers."""
    figures: list[Figure] = []
    if model.structure.has_friction or model.structure.limits:
        return figures
    with contextlib.suppress(FtlmError):
        figures += pole_charts(model)
        figures += model.step().figures()
    return figures[:MOST_FIGURES]
