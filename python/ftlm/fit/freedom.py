"""What was free in a joint fit: kept with a model, and given back as the problem that the fit was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from msgspec import UnsetType

from ftlm.base.errors import ModelError
from ftlm.data.limits import input_name
from ftlm.data.orders import Order
from ftlm.data.solved import Freedom, Solved
from ftlm.data.structures import Structure
from ftlm.fit.joint import JointFit
from ftlm.fit.problem import FreeProblem

#: Orders keep this distance from bounds of their own: derivatives are taken at them, and nothing is fitted.
ROOM = 0.5


def freedom(joint: JointFit, structure: Structure) -> Freedom:
    """What a joint fit of a structure found together."""
    orders = [order for e in structure.equations for order in (e.order, *(t.order for t in e.terms))]
    spread = joint.covariance
    return Freedom(
        names=tuple(joint.names),
        orders=tuple(map(str, orders)),
        noise={o: float(v) for o, v in joint.noise.items()},
        products={n: (float(sign), tuple(factors)) for n, (sign, factors) in joint.products.items()},
        covariance=tuple(tuple(row) for row in spread.tolist()) if np.all(np.isfinite(spread)) else None,
        refinement=joint.refinement,
    )


def freedom_of(model: Solved) -> Freedom:
    """What was free in the fit that a model is of.

    Raises
    ------
    ModelError
        A model of another method, one that was written down, or one of a file that does not say so.
    """
    known = None if model.estimate is None else model.estimate.free
    if known is None or isinstance(known, UnsetType):
        how = "was not identified" if model.estimate is None else f"is of method {model.estimate.method!r}"
        raise ModelError(
            f"this model {how}, or of a file that does not say what was free in its fit: without intervals and noise "
            "no experiment can be laid out; identify it with method='output-error'"
        )
    return known


def problem_of(model: Solved) -> tuple[FreeProblem, list[float]]:
    """The problem of a model's fit for a run that begins at rest, and the values of its free numbers.

    Raises
    ------
    ModelError
        A model that does not say what was free; orders that are none, or others than its equations have.
    """
    known, estimate = freedom_of(model), model.estimate
    values = {} if estimate is None else estimate.values
    lacking = [n for n in known.names if n not in values]
    count = sum(1 + len(e.terms) for e in model.equations)
    if lacking or len(known.orders) != count:
        what = (
            f"no value of {lacking[0]}" if lacking else f"{len(known.orders)} orders where its equations have {count}"
        )
        raise ModelError(f"what the model says of its fit has {what}; identify it again")
    laws = iter(known.orders)
    equations = []
    for item in model.equations:
        order = Order.parse(next(laws))
        terms = []
        for term in item.terms:
            free = term.name in known.names or term.name in known.products
            coefficient = str(term.name) if free else term.coefficient
            terms.append(replace(term, order=Order.parse(next(laws)), coefficient=coefficient, name=None))
        equations.append(replace(item, order=order, terms=tuple(terms)))
    names = {n for e in equations for n in e.order_names}
    late = {s: input_name("delay", s) for s in model.structure.signals if s not in model.outputs}
    delays = {s: values[n] for s, n in late.items() if n in known.names}
    structure = replace(
        model.structure,
        equations=tuple(equations),
        order_values={n: (values[n] - ROOM, values[n] + ROOM) for n in names},
        coefficient_law=tuple((n, sign, factors) for n, (sign, factors) in known.products.items()),
        delay={s: d for s, d in model.structure.delay.items() if s not in delays},
        free_delays={s: (0.0, 2.0 * d + 1.0) for s, d in delays.items()},
        initial="rest",
    )
    problem = FreeProblem.of(structure)
    if set(problem.names) != set(known.names):
        odd = sorted(set(problem.names) ^ set(known.names))
        raise ModelError(f"what the model says of its fit does not fit its equations: {odd[0]}; identify it again")
    return problem, [values[n] for n in problem.names]
