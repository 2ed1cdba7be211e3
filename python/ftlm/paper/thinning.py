"""Fewer rows of a run for joint fits, whose cost and whose grid's refinement grow with the rows."""

from __future__ import annotations

from ftlm.data.run import Run


def thinned(run: Run, every: int) -> Run:
    """Every so manieth row of a run, held inputs by their means until the next one, which act alike."""
    rows = run.length // every
    data = {}
    for name in run.signals:
        samples = run[name][: rows * every].reshape(rows, every)
        held = name in run.inputs and run.intersample[name] == "zoh"
        data[name] = samples.mean(axis=1) if held else samples[:, 0]
    return Run.from_arrays(
        step=run.step * every, inputs={n: data[n] for n in run.inputs}, outputs={n: data[n] for n in run.outputs},
        units=dict(run.units), intersample=dict(run.intersample), name=run.name,
    )  # fmt: skip
