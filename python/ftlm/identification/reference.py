"""The reference of a closed loop as instrument: inputs replaced by the part of them that it explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ftlm.base.arrays import Floats
from ftlm.base.checks import nearest
from ftlm.base.errors import DataError, ModelError
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.identification.estimate import Fit
from ftlm.identification.judged import Task
from ftlm.judge.feedback import past_columns
from ftlm.judge.whitening import is_constant

#: Samples of a reference that stand by themselves, one for so many rows of the shortest run at least; those before are
#: averaged over blocks, each wider by this factor.
DENSE = 60
ROWS_A_SAMPLE = 20
WIDER = 1.25
#: A reference that explains less of an input than this is said to.
WEAK = 0.1


def driven_by(runs: Sequence[Run], structure: Structure, reference: str) -> tuple[list[Run], list[str]]:
    """Runs whose inputs are what a reference explains of them, and what to beware of.

    Two stages (Van den Hof and Schrama, An indirect method for transfer function estimation from closed loop data,
    Automatica 29, 1993, 1523-1527): the controller and the loop are one linear law from reference to input, fitted by
    least squares over all runs. What noise puts into an input is not in its answer to the reference, so a fit to that
    answer has no bias from it.

    Raises
    ------
    ModelError
        A reference that is no signal's name, or a signal of the model.
    DataError
        A reference that a run does not have, or that does not move; no input.
    """
    if not isinstance(reference, str):
        raise ModelError(f"reference is {type(reference).__name__}, not the name of a signal of the runs")
    if reference in structure.signals:
        raise ModelError(
            f"reference={reference!r} is a signal of the model; a reference drives the loop from outside, and the model "
            "does not read it"
        )
    for run in runs:
        if reference not in run:
            raise DataError(
                f"run {run.name!r} has no signal {reference!r}{nearest(reference, run.signals)} for reference=; it has "
                f"{', '.join(run.signals)}"
            )
    inputs = [s for s in structure.signals if s in runs[0].inputs]
    if not inputs:
        raise DataError(f"reference={reference!r}: the model reads no input of run {runs[0].name!r} that it could drive")
    moves = [run[reference] for run in runs]
    if is_constant(moves):
        raise DataError(f"reference={reference!r} does not move, so it explains nothing; record one that does")
    shortest = min(run.length for run in runs)
    dense = max(2, min(DENSE, shortest // ROWS_A_SAMPLE))
    parts = [np.stack(past_columns(r, 0, shortest // 2, dense=dense, wider=WIDER), axis=1) for r in moves]
    columns = np.zeros((sum(run.length for run in runs), parts[0].shape[1] + len(runs)))
    at, places = 0, []
    for k, part in enumerate(parts):
        places.append(slice(at, at + len(part)))
        columns[places[-1], : part.shape[1]] = part
        # Every run has a level of its own.
        columns[places[-1], part.shape[1] + k] = 1.0
        at += len(part)
    answers: dict[str, list[Floats]] = {}
    warnings = []
    for name in inputs:
        measured = np.concatenate([run[name] for run in runs])
        law = np.linalg.lstsq(columns, measured, rcond=1e-10)[0]
        answer = columns @ law
        answers[name] = [answer[p] for p in places]
        spread = sum(float(np.var(run[name])) * run.length for run in runs)
        share = sum(float(np.var(a)) * a.size for a in answers[name]) / spread if spread > 0 else 0.0
        if share < WEAK:
            warnings.append(
                f"{reference} explains only {100 * share:.2g} % of {name}: a weak instrument, whose estimates scatter; "
                "move the reference more"
            )
    return [_answering(run, k, answers) for k, run in enumerate(runs)], warnings


def _answering(run: Run, number: int, answers: dict[str, list[Floats]]) -> Run:
    return Run.from_arrays(
        step=run.step, inputs={n: answers[n][number] if n in answers else run[n] for n in run.inputs},
        outputs={n: run[n] for n in run.outputs}, units={n: u for n, u in run.units.items() if u},
        intersample=run.intersample, name=run.name,
    )  # fmt: skip


def by_reference(fit: Fit, reference: str, runs: tuple[Run, ...], warnings: Sequence[str]) -> Fit:
    """A fit to the answers to a reference as one of the runs as they were measured, on which it is judged."""
    # What noise puts into the inputs stays in these residuals, and is coloured; intervals count it.
    own = [w for w in fit.warnings if "are not white" not in w]
    return replace(
        fit, task=Task(runs, fit.task.structure, fit.task.lattice), warnings=[*own, *warnings],
        settings={**fit.settings, "reference": reference},
    )  # fmt: skip
