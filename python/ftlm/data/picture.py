"""A run as charts: its outputs, and what drove them below."""

from __future__ import annotations

from ftlm.base.errors import DataError
from ftlm.data.measured import Measured
from ftlm.paint.axes import POINTS
from ftlm.paint.figure import Figures
from ftlm.paint.lines import line_chart
from ftlm.paint.text import symbol


def picture(run: Measured, *signals: str) -> Figures:
    """Charts of a run; see :meth:`ftlm.Run.plot`."""
    unknown = [name for name in signals if name not in run]
    if unknown:
        raise DataError(f"signal {unknown[0]!r} is not in run {run.name!r}; its signals are {', '.join(run.signals)}")
    charts = []
    for name in signals or (*run.outputs, *run.inputs):
        unit = run.units[name]
        role = "input" if name in run.inputs else "output"
        # A command is held until the next row: a straight line to it was never sent.
        times, values = run.time, run[name]
        if run.intersample.get(name) == "zoh":
            times, values = times.repeat(2)[1:], values.repeat(2)[:-1]
        charts.append(
            line_chart(
                times, [("", values)], title=f"{symbol(name)}, {role} of {run.name}", x_label="time [s]",
                y_label=f"{symbol(name)} [{unit}]" if unit else symbol(name), points=POINTS,
                height=240 if role == "output" else 180,
            )
        )  # fmt: skip
    return Figures(charts)
