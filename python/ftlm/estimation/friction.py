"""Linear least squares for one body with friction, under sign constraints on the coefficients."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from msgspec import UNSET, UnsetType

from ftlm import _core
from ftlm.data.run import Run
from ftlm.data.sampling import drop_missing
from ftlm.errors import DataError, FtlmError
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective
from ftlm.simulation.discretization import COULOMB_PREFIX, record
from ftlm.structure.equation import Equation, Friction, Term
from ftlm.structure.order import Order
from ftlm.structure.structure import Hints, Structure
from ftlm.utils.linalg import minimum_norm_solution
from ftlm.utils.resources import memory_limit, stop_flag
from ftlm.utils.statistics import estimate_noise
from ftlm.utils.validation import Floats

#: Span over which the velocity is measured, as a fraction of the run, and its smallest size in noise standard
#: deviations.
VELOCITY_SPAN_FRACTION, VELOCITY_NOISE_RATIO = 0.01, 5.0
#: Iterations in which the friction force at rest is recomputed from the input forces.
MAX_REST_ITERATIONS = 4


def fit_sliding_body(runs: Sequence[Run], alone: Structure) -> dict[str, float]:
    """Fit the coefficients of one equation with friction, at fixed orders, to its integrals on all runs.

    Own terms restore and friction dissipates; inputs may have any sign. The friction sign is that of the measured
    velocity where it exceeds the noise. Elsewhere the body rests and friction balances the input forces. Each run has
    its own level, velocity and constant.

    Returns
    -------
    dict
        Coefficients by name; empty if no finite solution exists.
    """
    item = alone.equations[0]
    if item.friction is None or not isinstance(item.friction.coefficient, str):
        return {}
    parts = [_regressors(run, alone) for run in runs]
    rest = [part[2] == 0.0 for part in parts]
    signs = [part[2].copy() for part in parts]
    strength, found = item.friction.coefficient, dict[str, float]()
    for _ in range(MAX_REST_ITERATIONS):
        found = _signed_least_squares(item, parts, signs)
        if not found:
            return {}
        holds = -item.friction.factor * found[strength]
        if holds <= 0.0:
            break
        for sign, still, part in zip(signs, rest, parts, strict=True):
            push = sum((_value(item, k, found) * drive for k, drive in part[3].items()), start=np.zeros(sign.size))
            sign[still] = np.clip(push[still] / holds, -1.0, 1.0)
    return found


_Part = tuple[list[Floats], Floats, Floats, dict[int, Floats], float]


def _regressors(run: Run, alone: Structure) -> _Part:
    """Return integrals of all terms, output means, velocity signs, input forces and the step."""
    item, m = alone.equations[0], run.length - 1
    rec = record(run, alone, m, filtered=False)
    alpha, means = item.order.constant, rec.of(item.output)
    integrals = [_integral(rec.of(t.signal), rec.step, alpha - t.order.constant) for t in item.terms]
    pace = max(1, round(VELOCITY_SPAN_FRACTION * m))
    gone = means[pace:] - means[:-pace]
    gone = np.concatenate([gone[:1].repeat(pace // 2), gone, gone[-1:].repeat(pace - pace // 2)])
    sign = np.where(
        np.abs(gone) > VELOCITY_NOISE_RATIO * estimate_noise(drop_missing(run[item.output])), np.sign(gone), 0.0
    )
    drives = {
        k: rec.of(t.signal) for k, t in enumerate(item.terms) if t.signal != item.output and t.order.constant == 0.0
    }
    return integrals, means, sign, drives, rec.step


def _integral(means: Floats, step: float, order: float) -> Floats:
    """Return block-pulse means of the fractional integral of positive order."""
    signals = np.stack([np.zeros_like(means), means])
    found: Floats = _core.respond((step, signals, None), [((0, order, [(1, 0.0)]), [1.0])], [False, True], [[]])[0]
    return found


def _value(item: Equation, k: int, found: Mapping[str, float]) -> float:
    """Return the coefficient of a term, multiplied by its factor."""
    term = item.terms[k]
    return term.fixed if term.fixed is not None else term.factor * found[str(term.coefficient)]


def _signed_least_squares(item: Equation, parts: Sequence[_Part], signs: Sequence[Floats]) -> dict[str, float]:
    """Return the least-squares solution with correct signs, trying each set of coefficients fixed at 0."""
    alpha, rubs = item.order.constant, item.friction
    assert rubs is not None
    target, rows = [], []
    for r, ((integrals, means, _, _, step), sign) in enumerate(zip(parts, signs, strict=True)):
        times = (np.arange(means.size) + 0.5) * step
        free = [c * t.factor for c, t in zip(integrals, item.terms, strict=True) if t.fixed is None]
        known = [c * t.fixed for c, t in zip(integrals, item.terms, strict=True) if t.fixed is not None]
        rub = rubs.factor * _integral(sign, step, alpha)
        starts = [times * 0.0] * (3 * len(parts))
        starts[3 * r : 3 * r + 3] = [np.ones_like(times), times, times**alpha]
        rows.append(np.stack([*free, rub, *starts], axis=1))
        target.append(means - sum(known, start=np.zeros_like(means)))
    matrix, wanted = np.concatenate(rows), np.concatenate(target)
    sizes = np.linalg.norm(matrix, axis=0)
    terms = [t for t in item.terms if t.fixed is None]
    names = [*(str(t.coefficient) for t in terms), str(rubs.coefficient)]
    # A coefficient times its factor is negative of an own term, and of friction.
    bound = {k: -np.sign(t.factor) for k, t in enumerate(terms) if t.signal == item.output} | {len(terms): 1.0}
    best: tuple[float, dict[str, float]] = (np.inf, {})
    for out in itertools.chain.from_iterable(itertools.combinations(bound, n) for n in range(len(bound) + 1)):
        kept = [k for k in range(matrix.shape[1]) if k not in out and sizes[k] > 0]
        if not np.all(np.isfinite(matrix[:, kept])):
            return {}
        x = np.zeros(matrix.shape[1])
        x[kept] = minimum_norm_solution(matrix[:, kept] / sizes[kept], wanted, None) / sizes[kept]
        if any(x[k] * side < 0.0 for k, side in bound.items()):
            continue
        left = float(np.sum((wanted - matrix @ x) ** 2))
        if left < best[0]:
            best = (left, dict(zip(names, x[: len(names)].tolist(), strict=True)))
    return best[1]


#: Samples of the coarse fits, evaluations of one such fit, and number of survivors that seed further fits.
COARSE_SAMPLES, FIRST_BUDGET_EVALUATIONS, MAX_SURVIVORS = 1200, 15, 3
#: Highest order of a body with friction.
MAX_BODY_ORDER = 2.0
#: Initial Coulomb friction as fractions of the force that acts on the body.
COULOMB_FORCE_FRACTIONS = (0.01, 0.05, 0.2, 0.5)
#: Initial Coulomb friction as multiples of the estimate with the measured sign of the velocity.
MEASURED_SIGN_MULTIPLES = (1.0, 0.3)
#: Initial Stribeck friction as fractions of Coulomb friction, and its speed as fractions of the speed of the body.
STRIBECK_COULOMB_RATIOS = (0.02, 0.2, 1.0)
STRIBECK_SPEED_FRACTIONS = (0.05, 0.2, 0.6)
#: Initial inertia of the attached bodies as fractions of the inertia of the body.
LOAD_INERTIA_RATIOS = (0.1, 0.3, 1.0, 3.0)
#: Largest number of initial guesses in which each body carries a load of its own.
MAX_LOAD_COMBINATIONS = 64
#: Largest difference of two orders that are taken for action and reaction of two coupled equations.
MAX_REACTION_ORDER_GAP = 0.5
#: Smallest peak-to-peak motion of a body, in standard deviations of its noise.
MIN_MOTION_NOISE_RATIO = 10.0


def run_friction_multistart(
    alike: Objective, floor: float, threads: int, progress: Callable[[int, int], None] | None
) -> _core.JointMultistart:
    """Rank initial guesses of bodies with friction by coarse fits, with equal weight for every output.

    With the measured sign of the velocity the equation is linear. Where the body rests, the sign is noise, but the
    estimates are close enough. Fits without friction add guesses with several amounts of friction. Stribeck friction
    starts from the best fits with Coulomb friction.
    """
    problem, runs = alike.problem, alike.runs
    structure = problem.structure
    check_moves(runs, structure)
    if not structure.has_friction:
        return run_plain_multistart(alike, floor, threads, progress)
    coarse = replace(alike, decimation=max(1, min(run.length - 1 for run in runs) // COARSE_SAMPLES))
    starts: list[Iterate] = []
    if any(rubs.stribeck is not None for _, rubs in equations_with_friction(structure)):
        less = FreeProblem.of(with_friction(structure, lambda rubs: replace(rubs, more=UNSET)))
        reached = run_friction_multistart(replace(alike, problem=less), floor, threads, progress)
        for values, origin in list(zip(reached.values, reached.origins, strict=True))[:MAX_SURVIVORS]:
            starts += stribeck_starts(coarse, dict(zip(less.names, values, strict=True)), origin)
        return fit_on_coarse_grids(coarse, starts, threads)
    if 1 < len(equations_with_friction(structure)) < len(structure.equations):
        # What hangs on them is told from its own equation; that of a body, driven by all that hangs on it, may be
        # explained by what they tell of its motion.
        for orders in initial_order_sets(problem):
            starts += loaded_body_starts(
                problem, runs, fit_frictionless_equations(alike, orders, floor, threads), together=False
            )
        return fit_on_coarse_grids(coarse, starts, threads)
    # Driven by measured signals, each of several bodies is told from its own equation, whatever the others do.
    signed = FreeProblem.of(replace(with_measured_sign(structure), coupling="measured"))
    reached = run_plain_multistart(replace(alike, problem=signed), floor, threads, progress)
    for values, origin in list(zip(reached.values, reached.origins, strict=True))[:MAX_SURVIVORS]:
        starts += coulomb_starts(coarse, dict(zip(signed.names, values, strict=True)), origin)
    if len(structure.equations) > 1 and len(reached):
        best = reached.values[0]
        named = signed.coefficients_by_name(signed.split(best)[1])
        starts += loaded_body_starts(problem, runs, {**dict(zip(signed.names, best, strict=True)), **named})
    return fit_on_coarse_grids(coarse, starts, threads)


def equations_with_friction(structure: Structure) -> list[tuple[Equation, Friction]]:
    """Return the equations with friction, each with its friction term."""
    return [(e, e.friction) for e in structure.equations if e.friction is not None]


def initial_order_sets(problem: FreeProblem) -> list[dict[str, float]]:
    """Return the order sets of the linear initial fits: integer orders and natural orders of the hints.

    Equations that share orders determine each of them poorly. An overdamped body has a different optimum at every
    order.
    """
    ends = dict(zip(problem.orders, problem.bounds, strict=True))
    natural = (problem.structure.hints or Hints()).nominal_orders
    known = {n: natural[n] for n in problem.orders if natural.get(n)}
    whole = dict(zip(problem.orders, problem.core.whole_orders, strict=True))
    whole |= {n: v for n, values in known.items() for v in values if v == round(v)}
    other = {n: v for n, values in known.items() for v in values if v != whole[n]}
    sets = [whole, whole | other] if other else [whole]
    return [{n: min(max(v, ends[n][0]), ends[n][1]) for n, v in orders.items()} for orders in sets]


def fit_frictionless_equations(
    alike: Objective, orders: dict[str, float], floor: float, threads: int
) -> dict[str, float]:
    """Fit each equation without friction by itself, with measured signals as inputs.

    Returns the orders and the coefficients; coefficients of the other equations are 0.
    """
    structure = alike.problem.structure
    values = orders | dict.fromkeys(structure.coefficient_names, 0.0)
    for item, weight in zip(structure.equations, alike.weights, strict=True):
        if item.friction is None:
            named = {n: orders[n] for n in item.order_names}
            alone = FreeProblem.of(structure.with_measured_inputs(item.output).with_orders(named))
            reached = run_plain_multistart(replace(alike, problem=alone, weights=[weight]), floor, threads, None)
            values |= alone.coefficients_by_name(alone.split(reached.values[0])[1]) if len(reached) else {}
    return values


def loaded_body_starts(
    problem: FreeProblem, runs: Sequence[Run], values: dict[str, float], *, together: bool = True
) -> list[Iterate]:
    """Return initial guesses of isolated bodies with the coupling forces of the attached bodies added.

    Coupling forces follow from action and reaction. A body driven by measured neighbors may be explained by their
    motion alone, without its input and its friction, so each body is fitted in isolation first. All bodies carry the
    same fraction of their inertia, or each its own.
    """
    structure = problem.structure
    bounds = dict(zip(problem.orders, problem.bounds, strict=True))
    alone = [
        (item, *fit_isolated_body(runs, structure, item, values, bounds))
        for item, _ in equations_with_friction(structure)
    ]
    told = [(item, orders, numbers) for item, orders, numbers in alone if numbers]
    out = []
    together = together or len(LOAD_INERTIA_RATIOS) ** len(told) > MAX_LOAD_COMBINATIONS
    for shares in (
        [[s] * len(told) for s in LOAD_INERTIA_RATIOS]
        if together
        else itertools.product(LOAD_INERTIA_RATIOS, repeat=len(told))
    ):
        # What drives a body and brakes it moves the others, too.
        found, rest = dict(values), dict(values)
        for (item, orders, numbers), share in zip(told, shares, strict=True):
            found |= reaction_coefficients(structure, item, values, share)
            found |= {n: (1.0 + share) * v for n, v in numbers.items()}
            rest |= orders
        free = dict(zip(problem.coefficients, problem.core.free_from(found), strict=True))
        rest = {n: v for n, v in rest.items() if n in problem.names}
        words = " and ".join(item.output for item, _, _ in told) + (", each" if len(told) > 1 else "")
        carried = " and ".join(f"{share:g}" for share in (shares[:1] if together else shares))
        out.append(start_at(problem, {**rest, **free}, f"{words} by itself, carrying {carried} of its inertia"))
    return out if told else []


def fit_isolated_body(
    runs: Sequence[Run],
    structure: Structure,
    item: Equation,
    values: dict[str, float],
    bounds: dict[str, tuple[float, float]],
) -> tuple[dict[str, float], dict[str, float]]:
    """Return orders and coefficients of an isolated body with friction, fitted to its inputs."""
    # A filter's lag is no part of a start.
    alone = replace(structure, sensor_filter=None).equation(item.output)
    kept = tuple(t for t in alone.equations[0].terms if t.signal not in structure.outputs or t.signal == item.output)
    if not kept:
        return {}, {}
    alone = replace(alone, equations=(replace(alone.equations[0], terms=kept),))
    usual = (
        {n: 0.0 for n in alone.order_names}
        | {n: 1.0 for t in kept if t.signal == item.output for n in t.order.names}
        | {n: MAX_BODY_ORDER for n in item.order.names}
    )
    shared = {n for e in structure.equations if e is not item for n in e.order_names}
    orders = {n: values[n] if n in shared and n not in item.order.names else v for n, v in usual.items()}
    orders = {n: min(max(v, bounds[n][0]), bounds[n][1]) if n in bounds else v for n, v in orders.items()}
    return orders, fit_sliding_body(runs, alone.with_orders(orders))


def reaction_coefficients(
    structure: Structure, item: Equation, values: dict[str, float], share: float
) -> dict[str, float]:
    """Return the coefficients by which attached bodies act on a body, scaled by the inertia ratio."""
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
            if not isinstance(here.coefficient, str) or abs(highest(there) - highest(here)) > MAX_REACTION_ORDER_GAP:
                continue
            value = there.fixed if there.fixed is not None else there.factor * values[str(there.coefficient)]
            out[here.coefficient] = -share * value / here.factor
    return out


def run_plain_multistart(
    alike: Objective, floor: float, threads: int, progress: Callable[[int, int], None] | None
) -> _core.JointMultistart:
    """Run the multistart of a problem without friction, with equal weight for every output."""
    limits = (threads, memory_limit())
    return _core.joint_multistart(
        alike.problem.core, alike.recordings, alike.weights, floor, limits, progress, stop_flag()
    )


def fit_on_coarse_grids(coarse: Objective, starts: Sequence[Iterate], threads: int) -> _core.JointMultistart:
    """Refine initial guesses on coarse grids and return them ranked, best first."""
    return _core.refine_candidates(
        coarse.problem.core,
        coarse.recordings,
        coarse.weights,
        coarse.decimation,
        [(a.values.tolist(), a.origin) for a in starts],
        threads,
        stop_flag(),
    )


def check_moves(runs: Sequence[Run], structure: Structure) -> None:
    """Raise DataError if a body with friction moves in no run."""
    for item, _ in equations_with_friction(structure):
        output = item.output
        if all(
            float(np.ptp(drop_missing(run[output]))) <= MIN_MOTION_NOISE_RATIO * estimate_noise(run[output])
            for run in runs
        ):
            raise DataError(
                f"{output} never moves beyond its noise in {', '.join(r.name for r in runs)}, and a body that only "
                "rests tells nothing but that its friction is not exceeded; add a run in which it slides"
            )


def with_friction(structure: Structure, other: Callable[[Friction], Friction | UnsetType]) -> Structure:
    """Return the structure with each friction term replaced by `other(friction)`."""
    equations = [e if e.friction is None else replace(e, coulomb=other(e.friction)) for e in structure.equations]
    return replace(structure, equations=tuple(equations))


def without_friction(structure: Structure) -> Structure:
    """Return the structure without friction."""
    return with_friction(structure, lambda _: UNSET)


def with_measured_sign(structure: Structure) -> Structure:
    """Return the structure with friction replaced by the sign of the measured velocity as a signal."""

    def replace_friction(item: Equation) -> Equation:
        if item.friction is None:
            return item
        term = Term(f"{COULOMB_PREFIX}{item.output}", Order(), item.friction.coefficient, item.friction.factor)
        return replace(item, terms=(*item.terms, term), coulomb=UNSET)

    return replace(structure, equations=tuple(map(replace_friction, structure.equations)))


def coulomb_starts(coarse: Objective, values: dict[str, float], origin: str) -> list[Iterate]:
    """Return initial guesses of Coulomb friction from a linear fit and from fractions of the input force."""
    problem = coarse.problem
    free = [(e.output, rubs, rubs.coefficient) for e, rubs in equations_with_friction(problem.structure)]
    named = [(output, rubs, name) for output, rubs, name in free if isinstance(name, str)]
    if not named:
        return [start_at(problem, values, origin)]
    said = {name: max(values[name], 0.0) for _, _, name in named}
    strengths = [({n: m * v for n, v in said.items()}, f"{m:g} of the measured sign") for m in MEASURED_SIGN_MULTIPLES]
    out = [start_at(problem, values | v, f"{origin}, friction {words}") for v, words in strengths if any(said.values())]
    linear = FreeProblem.of(without_friction(problem.structure))
    try:
        without = replace(coarse, problem=linear).minimize(start_at(linear, values, origin), FIRST_BUDGET_EVALUATIONS)
    except FtlmError:
        # Without any friction it runs away.
        return out
    values = {**values, **dict(zip(linear.names, without.values.tolist(), strict=True))}
    forces = {
        name: largest_input_force(coarse.runs, identified_body(linear, output, values)) for output, _, name in named
    }
    for share in COULOMB_FORCE_FRACTIONS if any(force > 0 for force in forces.values()) else ():
        strength = {name: share * forces[name] / -rubs.factor for _, rubs, name in named}
        out.append(start_at(problem, values | strength, f"{origin}, friction {share:g} of what drives"))
    return out


def stribeck_starts(coarse: Objective, values: dict[str, float], origin: str) -> list[Iterate]:
    """Return initial guesses of Stribeck friction from a fit with Coulomb friction alone."""
    problem = coarse.problem
    plain = FreeProblem.of(without_friction(problem.structure))
    sizes: dict[str, float] = {}
    paces: dict[str, float] = {}
    for item, rubs in equations_with_friction(problem.structure):
        more = rubs.stribeck
        if more is None:
            continue
        fc = abs(rubs.factor) * values.get(str(rubs.coefficient), 0.0) if rubs.strength is None else rubs.strength
        if isinstance(more.coefficient, str):
            size = fc or largest_input_force(coarse.runs, identified_body(plain, item.output, values))
            sizes[more.coefficient] = size / -more.factor
        if isinstance(more.speed, str):
            paces[more.speed] = rms_speed(coarse, item.output)
    out = []
    for near in STRIBECK_COULOMB_RATIOS if sizes else STRIBECK_COULOMB_RATIOS[:1]:
        for fall in STRIBECK_SPEED_FRACTIONS if paces else STRIBECK_SPEED_FRACTIONS[:1]:
            known = {n: near * v for n, v in sizes.items()} | {n: fall * v for n, v in paces.items()}
            origin_here = f"{origin}, Stribeck {near:g} of Coulomb below {fall:g} of the speed"
            out.append(start_at(problem, values | known, origin_here))
    return out


def rms_speed(coarse: Objective, output: str) -> float:
    """Return the root-mean-square speed of a body, over sample intervals long enough to exceed the noise."""
    parts = [
        np.diff(drop_missing(run[output])[:: coarse.decimation]) / (run.step * coarse.decimation) for run in coarse.runs
    ]
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


def start_at(problem: FreeProblem, values: dict[str, float], origin: str) -> Iterate:
    """Return an initial guess at named values."""
    orders, coefficients, inputs = problem.split([values[n] for n in problem.names])
    return Iterate(orders, coefficients, origin, {}, inputs)


def identified_body(problem: FreeProblem, output: str, values: dict[str, float]) -> Equation:
    """Return the equation of a body without its friction, at named values."""
    coefficients = problem.coefficients_by_name([values[n] for n in problem.coefficients])
    item = next(e for e in problem.structure.equations if e.output == output)
    return item.with_coefficients({n: coefficients[n] for n in item.coefficient_names})


def largest_input_force(runs: Sequence[Run], item: Equation) -> float:
    """Return the largest root-mean-square force of one input, in the unit of D^alpha y."""
    sizes = [0.0]
    for term in item.terms:
        if term.signal == item.output or term.order.names or term.order.constant != 0:
            continue
        signal = np.concatenate([drop_missing(run[term.signal]) for run in runs])
        sizes.append(abs(term.fixed or 0.0) * float(np.sqrt(np.mean(signal**2))))
    return max(sizes)
