"""Structures that are asked for in no words: one output, any inputs, whole orders first."""

from __future__ import annotations

from collections.abc import Sequence

from ftlm.base.errors import ModelError
from ftlm.data.language import equation
from ftlm.data.run import Run
from ftlm.data.structures import Structure

#: Highest whole orders that are tried.
ORDERS = (1, 2, 3, 4)


def automatic(runs: Sequence[Run], output: str | None = None) -> list[Structure]:
    """Equations of one output driven by every input, of each whole order, to be grown and pruned.

    Each has all own derivatives below its order and each input; the highest order and those of one own term and of one
    input may become free. A measured input (``"foh"``) may be differentiated, a command that holds may not.

    Raises
    ------
    ModelError
        Several outputs and none chosen, or no input.
    """
    first = runs[0]
    outputs = list(first.outputs)
    if output is None:
        if len(outputs) != 1:
            raise ModelError(
                f"the runs have the outputs {', '.join(outputs)}; structure='auto' is of one: use run.select([…]), or "
                "name it in a structure in words"
            )
        output = outputs[0]
    if not first.inputs:
        raise ModelError("the runs have no input, and structure='auto' needs one; name inputs when loading")
    made = []
    for order in ORDERS:
        own = [f"a{k} D^mu{k} {output}" for k in range(order - 1, 0, -1)] + [f"a0 {output}"]
        driving = [f"b{j} D^gamma{j} {name}" for j, name in enumerate(first.inputs, 1)]
        orders = {f"gamma{j}": _reach(first, name, order) for j, name in enumerate(first.inputs, 1)}
        orders["alpha"] = (max(order - 0.9, 0.1), order + 0.9, 0.1)
        orders |= {f"mu{k}": (max(k - 0.9, 0.05), k + 0.9, 0.05) for k in range(1, order)}
        text = f"D^alpha {output} = {' + '.join([*own, *driving])}"
        made.append(equation(text, orders=orders, offset="auto"))
    return made


def _reach(run: Run, name: str, order: int) -> tuple[float, float, float]:
    """Orders at which an input may enter."""
    return (0.0, float(order) if run.intersample[name] == "foh" else max(order - 1.0, 0.05), 0.05)
