"""Where joint fits of a body with friction start: at fits that are linear, its sign as measured or left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from msgspec import UNSET, UnsetType

from ftlm.base.errors import DataError, FtlmError
from ftlm.base.statistics import noise_of
from ftlm.data.equations import Equation, Friction, Stribeck, Term
from ftlm.data.orders import Order
from ftlm.data.readings import read
from ftlm.data.run import Run
from ftlm.data.structures import Structure
from ftlm.fit.grid import FINEST, Attempt, Grid
from ftlm.fit.problem import FRICTION_BOUNDS, FreeProblem
from ftlm.fit.race import COARSE_SAMPLES, FINALISTS, FIRST_LAP, SECOND_LAP, Laps, race
from ftlm.fit.sliding import slid
from ftlm.solve.records import COULOMB

#: Friction at a start as shares of the force that drives the body, from next to none upwards.
SHARES = (0.01, 0.05, 0.2, 0.5)
#: The same as shares of what the measured sign of the velocity says.
MULTIPLES = (1.0, 0.3)
#: Stribeck friction at a start as shares of Coulomb's, and its speed as shares of that of the body.
NEAR = (0.02, 0.2, 1.0)
FALLS = (0.05, 0.2, 0.6)
#: What hangs on a body at a start, as shares of the body's own inertia.
CARRIED = (0.1, 0.3, 1.0, 3.0)
#: A body that moves by less than this many deviations of its noise, peak to peak, has not moved.
STILL = 10.0


def race_with_friction(
    alike: Grid, floor: float, threads: int, progress: Callable[[int, int], None] | None
) -> list[Attempt]:
    """Coarse fits of a body with friction, best first, every output weighing alike.

    The sign of the measured velocity makes the equation linear; where the body rests it is noise, and so are its
    numbers, but they are near enough. Beside them stand those without friction, with some of it put in. Friction that
    falls with speed starts where friction that does not ends, with some more of it near rest.
    """
    problem, runs = alike.problem, alike.runs
    structure = problem.structure
    check_moves(runs, structure)
    rubs = structure.equations[structure.sticks].friction
    if rubs is None:
        return race(alike, floor, threads, progress)
    coarse = replace(alike, decimation=max(1, min(run.length - 1 for run in runs) // COARSE_SAMPLES))
    starts: list[Attempt] = []
    if rubs.stribeck is not None:
        less = FreeProblem.of(with_friction(structure, replace(rubs, more=UNSET)))
        reached = race_with_friction(replace(alike, problem=less), floor, threads, progress)
        for attempt in reached[:FINALISTS]:
            values = dict(zip(less.names, attempt.values.tolist(), strict=True))
            starts += falling(coarse, values, rubs.stribeck, attempt.origin)
        return raced(coarse, starts, threads)
    # Driven by measured signals, each of several bodies is told from its own equation, whatever the others do.
    signed = FreeProblem.of(replace(with_measured_sign(structure, rubs), coupling="measured"))
    reached = race(replace(alike, problem=signed), floor, threads, progress)
    for attempt in reached[:FINALISTS]:
        values = dict(zip(signed.names, attempt.values.tolist(), strict=True))
        starts += started(coarse, values, rubs, attempt.origin)
    if len(structure.equations) > 1 and reached:
        values = dict(zip(signed.names, reached[0].values.tolist(), strict=True))
        starts += carrying(problem, runs, {**values, **signed.named(reached[0].coefficients)})
    return raced(coarse, starts, threads)


def carrying(problem: FreeProblem, runs: Sequence[Run], values: dict[str, float]) -> list[Attempt]:
    """Starts of a body by itself, with what hangs on it put back as action and reaction ask for, shares of its inertia.

    The others are as they are when the measured body drives them; the body itself, driven by measured others, may be
    explained by what they tell of its motion, without what drives it and without friction.
    """
    structure = problem.structure
    item = structure.equations[structure.sticks]
    if item.friction is None:
        return []
    # A filter's lag is no part of a start.
    alone = replace(structure, sensor_filter=None).equation(item.output)
    kept = tuple(t for t in alone.equations[0].terms if t.signal not in structure.outputs or t.signal == item.output)
    if not kept:
        return []
    alone = replace(alone, equations=(replace(alone.equations[0], terms=kept),))
    bounds = dict(zip(problem.orders, problem.bounds, strict=True))
    usual = {n: 0.0 for n in alone.order_names} | {
        n: 1.0 for t in kept if t.signal == item.output for n in t.order.names
    } | {n: FRICTION_BOUNDS[1] for n in item.order.names}  # fmt: skip
    shared = {n for e in structure.equations if e is not item for n in e.order_names}
    orders = {n: values[n] if n in shared and n not in item.order.names else v for n, v in usual.items()}
    orders = {n: min(max(v, bounds[n][0]), bounds[n][1]) if n in bounds else v for n, v in orders.items()}
    numbers = slid(runs, alone.with_orders(orders))
    out = []
    for share in CARRIED if numbers else ():
        # What drives it and brakes it moves the others, too.
        found = {**values, **reacting(structure, values, share), **{n: (1.0 + share) * v for n, v in numbers.items()}}
        free = dict(zip(problem.coefficients, problem.free_from(found), strict=True))
        rest = {n: v for n, v in {**values, **orders}.items() if n in problem.names}
        out.append(at(problem, {**rest, **free}, f"{item.output} by itself, carrying {share:g} of its inertia"))
    return out


def reacting(structure: Structure, values: dict[str, float], share: float) -> dict[str, float]:
    """Coefficients by which others act on the body: against what moves them, by their inertia over its own."""
    item = structure.equations[structure.sticks]
    out: dict[str, float] = {}
    for other in structure.equations:
        if other is item:
            continue
        named = {**values, **{n: 0.0 for n in other.order_names if n not in values}}

        def highest(term: Term, named: dict[str, float] = named) -> float:
            return term.order.constant + sum(w * named[n] for n, w in term.order.weights)

        own = sorted((t for t in other.terms if t.signal == other.output), key=highest)
        back = sorted((t for t in item.terms if t.signal == other.output), key=highest)
        for there, here in zip(own, back, strict=False):
            if not isinstance(here.coefficient, str):
                continue
            value = there.fixed if there.fixed is not None else there.factor * values[str(there.coefficient)]
            out[here.coefficient] = -share * value / here.factor
    return out


def raced(coarse: Grid, starts: list[Attempt], threads: int) -> list[Attempt]:
    """Where starts get on coarse grids, best first."""
    laps = Laps(len(starts), threads, None)
    ended = laps.run(coarse, starts, FIRST_LAP)
    while coarse.every < FINEST and not ended:
        coarse = coarse.finer
        ended = laps.run(coarse, starts, FIRST_LAP)
    return laps.run(coarse, ended[: 2 * FINALISTS], SECOND_LAP)


def check_moves(runs: Sequence[Run], structure: Structure) -> None:
    """Refuse runs in none of which the body moves."""
    output = structure.outputs[structure.sticks]
    if all(float(np.ptp(read(run[output]))) <= STILL * noise_of(run[output]) for run in runs):
        raise DataError(
            f"{output} never moves beyond its noise in {', '.join(r.name for r in runs)}, and a body that only rests "
            "tells nothing but that its friction is not exceeded; add a run in which it slides"
        )


def with_friction(structure: Structure, rubs: Friction | UnsetType) -> Structure:
    """The structure with other friction, or none."""
    return changed(structure, replace(structure.equations[structure.sticks], coulomb=rubs))


def with_measured_sign(structure: Structure, rubs: Friction) -> Structure:
    """The structure with the sign of the measured velocity as a signal in the place of friction."""
    item = structure.equations[structure.sticks]
    term = Term(f"{COULOMB}{item.output}", Order(), rubs.coefficient, rubs.factor)
    return changed(structure, replace(item, terms=(*item.terms, term), coulomb=UNSET))


def changed(structure: Structure, item: Equation) -> Structure:
    """The structure with another equation of the body that may stick."""
    before = structure.equations
    return replace(structure, equations=(*before[: structure.sticks], item, *before[structure.sticks + 1 :]))


def started(coarse: Grid, values: dict[str, float], rubs: Friction, origin: str) -> list[Attempt]:
    """Starts at numbers of a linear fit, with friction as it says, and as shares of the force that drives the body."""
    problem = coarse.problem
    if not isinstance(rubs.coefficient, str):
        return [at(problem, values, origin)]
    name = rubs.coefficient
    said = values[name] if values[name] > 0 else 0.0
    strengths = [(m * said, f"{m:g} of the measured sign") for m in MULTIPLES if said > 0]
    out = [at(problem, {**values, name: v}, f"{origin}, friction {words}") for v, words in strengths]
    plain = with_friction(problem.structure, UNSET)
    linear = FreeProblem.of(plain)
    try:
        without = replace(coarse, problem=linear).descend(at(linear, values, origin), FIRST_LAP)
    except FtlmError:
        # Without any friction it runs away.
        return out
    values = {**values, **dict(zip(linear.names, without.values.tolist(), strict=True))}
    force = driving(coarse.runs, identified_body(linear, values))
    for share in SHARES if force > 0 else ():
        strength = share * force / -rubs.factor
        out.append(at(problem, {**values, name: strength}, f"{origin}, friction {share:g} of what drives"))
    return out


def falling(coarse: Grid, values: dict[str, float], more: Stribeck, origin: str) -> list[Attempt]:
    """Starts at numbers of a fit with Coulomb friction alone, with some more of it at low speeds."""
    problem = coarse.problem
    rubs = problem.structure.equations[problem.structure.sticks].friction
    fc = (
        abs(rubs.factor) * values.get(str(rubs.coefficient), 0.0) if rubs is not None and rubs.strength is None else 0.0
    )
    fc = fc or (0.0 if rubs is None else rubs.strength or 0.0)
    plain = FreeProblem.of(with_friction(problem.structure, UNSET))
    size = fc or driving(coarse.runs, identified_body(plain, values))
    pace = speed_of(coarse)
    forces = (
        [(NEAR[0], None)] if not isinstance(more.coefficient, str) else [(n, n * size / -more.factor) for n in NEAR]
    )
    speeds = [(FALLS[0], None)] if not isinstance(more.speed, str) else [(f, f * pace) for f in FALLS]
    out = []
    for near, force in forces:
        for fall, speed in speeds:
            known = {str(more.coefficient): force, str(more.speed): speed}
            here = values | {n: v for n, v in known.items() if v is not None}
            out.append(at(problem, here, f"{origin}, Stribeck {near:g} of Coulomb below {fall:g} of the speed"))
    return out


def speed_of(coarse: Grid) -> float:
    """Root mean square of the body's measured speed, over intervals that noise does not fill."""
    output = coarse.problem.structure.outputs[coarse.problem.structure.sticks]
    parts = [np.diff(read(run[output])[:: coarse.decimation]) / (run.step * coarse.decimation) for run in coarse.runs]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def at(problem: FreeProblem, values: dict[str, float], origin: str) -> Attempt:
    """A start at named values."""
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    return Attempt(orders, coefficients, origin, {}, inputs)


def identified_body(problem: FreeProblem, values: dict[str, float]) -> Equation:
    """The equation of the body that may stick, without its friction, at named values."""
    structure = problem.structure
    coefficients = problem.named([values[n] for n in problem.coefficients])
    item = structure.equations[structure.sticks]
    return item.with_coefficients({n: coefficients[n] for n in item.coefficient_names})


def driving(runs: Sequence[Run], item: Equation) -> float:
    """Root mean square of the largest force that another signal exerts by itself [unit of D^alpha y]."""
    sizes = [0.0]
    for term in item.terms:
        if term.signal == item.output or term.order.names or term.order.constant != 0:
            continue
        signal = np.concatenate([read(run[term.signal]) for run in runs])
        sizes.append(abs(term.fixed or 0.0) * float(np.sqrt(np.mean(signal**2))))
    return max(sizes)
