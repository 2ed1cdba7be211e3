"""Models as text for other tools: python-control, MATLAB with FOMCON, JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import Literal

from ftlm._core import __version__
from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.data.equations import numeric
from ftlm.data.solved import Solved
from ftlm.solve.approximation import approximate, identifier
from ftlm.solve.frequency import check_unlimited, transfer_functions


def _comment(text: str, mark: str) -> str:
    """Text as comment lines: nothing in a name can begin a line of code."""
    lines = re.split(r"[\r\n\u2028\u2029\x0b\x0c\x85]+", text)
    return "\n".join(f"{mark} {''.join(c if c.isprintable() else '?' for c in line)}" for line in lines)


def json_text(model: Solved) -> str:
    """The transfer functions of a model as JSON, exact in powers and coefficients.

    Parameters
    ----------
    model
        A linear model.

    Raises
    ------
    ModelError
        An input that saturates or has a dead zone, or friction: there is no transfer function.
    """
    check_unlimited(model, "a transfer function")
    transfer = transfer_functions(model)
    document = {
        "format": "ftlm-transfer-functions",
        "written_by": f"ftlm {__version__}",
        "name": model.structure.name,
        "outputs": list(transfer.outputs),
        "inputs": list(transfer.inputs),
        "units": dict(model.units),
        "delay_s": transfer.delay,
        "meaning": "output = sum over inputs of (sum of c s^p) / (sum of c s^p) exp(-s delay); pairs are [c, p]",
        "denominator": {o: [list(pair) for pair in pairs] for o, pairs in transfer.denominator.items()},
        "numerator": {
            o: {u: [list(pair) for pair in transfer.numerators[o, u]] for u in transfer.inputs}
            for o in transfer.outputs
        },
        "equations": [str(e) for e in model.equations],
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def matlab_text(model: Solved) -> str:
    """A MATLAB script: the transfer functions as vectors, and as FOMCON's ``fotf`` objects where FOMCON is there.

    Parameters
    ----------
    model
        A linear model.

    Raises
    ------
    ModelError
        As :func:`json_text`.
    """
    check_unlimited(model, "a transfer function")
    transfer = transfer_functions(model)

    def vector(values: Sequence[float]) -> str:
        return "[" + " ".join(f"{v:.17g}" for v in values) + "]"

    lines = [
        _comment(f"{model.structure.name}, written by ftlm {__version__}", "%"),
        *(_comment(numeric(e, model.structure.acting(".6g")), "%") for e in model.equations),
        "% G_y_u = (b(1)*s^nb(1) + ...)/(a(1)*s^na(1) + ...)*exp(-s*delay); SI units.",
        "% FOMCON (https://fomcon.net) makes fotf objects of them; without it the vectors remain.",
    ]
    used: set[str] = set()
    for output in transfer.outputs:
        for signal in transfer.inputs:
            top = transfer.numerators[output, signal]
            if not top:
                continue
            name = f"G_{identifier(output)}_{identifier(signal)}"
            while name in used:
                name += "_"
            used.add(name)
            bottom = transfer.denominator[output]
            lines += [
                "",
                _comment(f"{output} from {signal}", "%"),
                f"{name}.b = {vector([c for c, _ in top])};",
                f"{name}.nb = {vector([p for _, p in top])};",
                f"{name}.a = {vector([c for c, _ in bottom])};",
                f"{name}.na = {vector([p for _, p in bottom])};",
                f"{name}.delay = {transfer.delay[signal]:.17g};",
                "if exist('fotf', 'file')",
                f"  {name} = fotf({name}.a, {name}.na, {name}.b, {name}.nb, {name}.delay);",
                "end",
            ]
    return "\n".join(lines) + "\n"


def control_text(model: Solved, *, band: tuple[float, float], order: int = 5) -> str:
    """A Python script that makes the python-control system, without ftlm.

    Parameters
    ----------
    model
        A linear model.
    band
        Frequencies (low, high) within which it is to hold [rad/s].
    order
        Of Oustaloup's filter, 1 to 50.

    Raises
    ------
    ModelError
        As :func:`to_control`, which it does not need installed.
    """
    near = approximate(model, band=band, order=order)

    def matrix(values: Floats) -> str:
        rows = ",\n    ".join(repr([float(v) for v in row]) for row in values)
        return f"np.array([\n    {rows},\n])" if values.size else f"np.zeros({values.shape})"

    lines = [
        _comment(f"{model.structure.name}, written by ftlm {__version__}", "#"),
        *(_comment(numeric(e, model.structure.acting(".6g")), "#") for e in model.equations),
        *(_comment(line, "#") for line in str(near).splitlines()),
        "import control",
        "import numpy as np",
        "",
        f"A = {matrix(near.a)}",
        f"B = {matrix(near.b)}",
        f"C = {matrix(near.c)}",
        f"D = {matrix(near.d)}",
        f"system = control.ss(A, B, C, D, inputs={list(near.inputs)!r}, outputs={list(near.outputs)!r}, "
        f"name={identifier(model.structure.name)!r})",
    ]
    return "\n".join(lines) + "\n"


def export_text(
    model: Solved, to: Literal["control", "matlab", "json"], *, band: tuple[float, float] | None = None, order: int = 5
) -> str:
    """A model as text for another tool; refuses another one, and no band where one is needed."""
    if to == "json":
        return json_text(model)
    if to == "matlab":
        return matlab_text(model)
    if to != "control":
        raise ModelError(f"to = {to!r} is not known; use 'control', 'matlab' or 'json'")
    if band is None:
        raise ModelError("python-control has no fractional orders: give the band of frequencies, as in --band 0.1:100")
    return control_text(model, band=band, order=order)
