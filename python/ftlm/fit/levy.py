"""Where a fit of a frequency response starts: linear least squares at the points of any lattice of orders.

At known orders and delays an equation is linear in its coefficients (Levy, doi:10.1109/TAC.1959.6429401). Divided by
the denominator of the answer before, its residuals become those of the response (Sanathanan and Koerner,
doi:10.1109/TAC.1963.1105517).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from ftlm.base.arrays import Complex, Floats
from ftlm.data.equations import Equation
from ftlm.fit.response import Measured, ResponseProblem

#: Points of orders and delays that are tried, frequencies that are looked at, reweightings, and starts that are kept.
MOST_POINTS, MOST_FREQUENCIES, REWEIGHTED, KEPT = 3000, 160, 4, 8
#: Points whose true cost is computed, corners of one own term that are tried besides, and at how many points.
JUDGED, CORNERS, CORNERED = 60, 14, 120


def starts(problem: ResponseProblem) -> list[Floats]:
    """Numbers to start from, the most promising first; all within the inequalities."""
    points = _points(problem)
    found = _solved(problem, points) if problem.coefficients else list(points)
    judged = []
    for values in found:
        left, _ = problem.residuals(values, slopes=False)
        cost = float(left @ left)
        if np.isfinite(cost):
            judged.append((cost, values))
    judged.sort(key=lambda pair: pair[0])
    kept: list[Floats] = []
    first, last = len(problem.orders), len(problem.orders) + len(problem.coefficients)
    free = [k for k in range(len(problem.names)) if not first <= k < last]
    for _, values in judged:
        if all(np.max(np.abs(values[free] - other[free]), initial=0.0) > 0.1 for other in kept) or not kept:
            kept.append(values)
        if len(kept) == KEPT:
            break
    return kept


def _points(problem: ResponseProblem) -> Floats:
    """Orders and delays that are tried, a row each, coefficients 0."""
    axes = list(problem.searched().values())
    given = [n in problem.structure.order_values for n in problem.orders]
    delays = [(item.bounds[0] * problem.unit, item.bounds[1] * problem.unit) for item in problem.structure.free_inputs]
    # A delay that is off by a third of a period at the highest frequency still leads downhill.
    fastest = max(float(r.frequency.max()) for r in problem.records)
    fine = [int(np.clip(np.ceil((high - low) * fastest / 2.0) + 1, 2, 60)) for low, high in delays]
    room = max(MOST_POINTS // int(np.prod(fine, initial=1)), 60)
    count = len(axes)
    lattice = int(np.prod([len(a) if g else 1 for a, g in zip(axes, given, strict=True)], initial=1))
    free = count - sum(given)
    each = int(np.floor((room / max(lattice, 1)) ** (1.0 / free))) if free and lattice <= room else 0
    if (free and each < 4) or (not free and lattice > room):
        # Too many axes for a lattice: points that fill the box evenly, the same every time.
        spread = _halton(room, count)
        columns = [
            np.asarray(a)[(spread[:, k] * len(a)).astype(int)] if g else a[0] + spread[:, k] * (a[1] - a[0])
            for k, (a, g) in enumerate(zip(axes, given, strict=True))
        ]
        orders = np.stack(columns, axis=1)
    else:
        sides = [a if g else np.linspace(a[0], a[1], min(each, 31)) for a, g in zip(axes, given, strict=True)]
        orders = _product(sides)
    late = _product([np.linspace(a, b, n) for (a, b), n in zip(delays, fine, strict=True)])
    table = np.zeros((len(orders) * len(late), len(problem.names)))
    table[:, :count] = np.repeat(orders, len(late), axis=0)
    table[:, len(problem.names) - len(delays) :] = np.tile(late, (len(orders), 1))
    rows, limits, _ = problem.constraints()
    inside = np.all(table @ rows.T <= limits + 1e-12, axis=1)
    kept: Floats = table[inside]
    return kept


def _product(sides: Sequence[Sequence[float] | Floats]) -> Floats:
    """Every point of a lattice, a row each; a lattice without axes has one."""
    rows = list(itertools.product(*sides))
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(sides))


def _halton(count: int, width: int) -> Floats:
    """Points that fill a unit box evenly, by radical inverses in the first primes."""
    primes = [p for p in range(2, 300) if all(p % q for q in range(2, int(p**0.5) + 1))][:width]
    out = np.zeros((count, width))
    for k, base in enumerate(primes):
        index, share = np.arange(1, count + 1), 1.0
        while np.any(index):
            share /= base
            out[:, k] += share * (index % base)
            index = index // base
    return out


def _solved(problem: ResponseProblem, points: Floats) -> list[Floats]:
    """Coefficients at every point, one equation after the other; the most promising points only."""
    slow = points[np.unique(np.linspace(0, len(points) - 1, min(CORNERED, len(points))).astype(int))]
    points, corners = np.concatenate([points, np.repeat(slow, CORNERS, axis=0)]), _corners(problem, len(points), slow)
    table = points.copy()
    total = np.zeros(len(points))
    for i, item in enumerate(problem.structure.equations):
        names = [n for n in item.coefficient_names if n in problem.coefficients]
        records = [r for r in problem.records if r.output == i]
        if not records:
            continue
        answers, cost = _equation(problem, i, names, [_thinned(r) for r in records], points, corners)
        for k, name in enumerate(names):
            table[:, problem.names.index(name)] = answers[:, k]
        total += np.where(np.isfinite(cost), cost, np.inf)
    best = np.argsort(total, kind="stable")[:JUDGED]
    return [table[k] for k in best if np.isfinite(total[k])]


def _corners(problem: ResponseProblem, first: int, slow: Floats) -> Floats:
    """Where an own term turns the response over, for points after the first; NaN where nothing is said.

    Where noise hides a small arc, reweighted least squares are biased and their own terms far too small or too large.
    Given the slowest of them, what is left is hardly so.
    """
    every = np.concatenate([r.frequency for r in problem.records])
    tried = np.geomspace(every.min(), every.max(), CORNERS)
    return np.concatenate([np.full(first, np.nan), np.tile(tried, len(slow))])


def _thinned(record: Measured) -> Measured:
    """A record of no more frequencies than a start needs, spread over its order."""
    order = np.argsort(record.frequency, kind="stable")
    if order.size > MOST_FREQUENCIES:
        order = order[np.linspace(0, order.size - 1, MOST_FREQUENCIES).astype(int)]
    return Measured(record.output, record.input, record.frequency[order], record.response[order], record.weight[order])


def _equation(
    problem: ResponseProblem,
    place: int,
    names: Sequence[str],
    records: Sequence[Measured],
    points: Floats,
    corners: Floats,
) -> tuple[Floats, Floats]:
    """Coefficients of one equation at every point, and the cost that they leave."""
    item = problem.structure.equations[place]
    alpha = _orders(problem, item.order.constant, item.order.weights, points)
    columns: dict[str, list[Complex]] = {n: [] for n in names}
    own: dict[str, list[Complex]] = {}
    wanted, below = [], []
    for record in records:
        log = np.log(1j * record.frequency)
        late = np.exp(-1j * record.frequency * _shifts(problem, record.input, points)[:, None])
        known = np.exp(alpha[:, None] * log)
        below.append(known)
        goal = known * record.response
        for term in item.terms:
            signal = _signal(problem, record, term.signal, late)
            power = np.exp(_orders(problem, term.order.constant, term.order.weights, points)[:, None] * log)
            if isinstance(term.coefficient, str):
                columns[term.coefficient].append(term.factor * power * signal)
                if term.signal == item.output:
                    own.setdefault(term.coefficient, []).append(term.factor * power)
            else:
                gap = alpha - _orders(problem, term.order.constant, term.order.weights, points)
                size = float(term.fixed or 0.0) * problem.unit ** -gap[:, None]
                goal = goal - size * power * signal
                if term.signal == item.output:
                    below[-1] = below[-1] - size * power
        wanted.append(goal)
    weight = np.concatenate([r.weight for r in records])
    goal, known = np.concatenate(wanted, axis=1), np.concatenate(below, axis=1)
    left = np.stack([np.concatenate(columns[n], axis=1) for n in names], axis=2) if names else None
    ours = {n: np.concatenate(parts, axis=1) for n, parts in own.items()}
    slowest = _slowest(problem, item, points)
    bottom = 1.0 + np.abs(known) + 0j
    answers = np.zeros((len(points), len(names)))
    cost = np.full(len(points), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(REWEIGHTED):
            scaled = weight / np.abs(bottom)
            if left is not None:
                answers = _least_squares(left * scaled[..., None], goal * scaled)
                if slowest is not None:
                    k, power = names.index(slowest[0]), slowest[1]
                    given = np.isfinite(corners)
                    held = -(corners[given] ** power[given])
                    rest = goal[given] - left[given][:, :, k] * held[:, None]
                    others = np.delete(left[given], k, axis=2)
                    solved = _least_squares(others * scaled[given][..., None], rest * scaled[given])
                    answers[given] = np.insert(solved, k, held, axis=1)
            bottom = known - sum((answers[:, [names.index(n)]] * part for n, part in ours.items()), 0.0 * known)
            missed = goal if left is None else goal - np.einsum("bnp,bp->bn", left, answers)
            cost = np.sum(np.abs(missed / bottom * weight) ** 2, axis=1)
    return answers, cost


def _slowest(problem: ResponseProblem, item: Equation, points: Floats) -> tuple[str, Floats] | None:
    """The free own term of an equation that acts at the lowest frequencies, and by how much its order is lower."""
    own = [t for t in item.terms if t.signal == item.output and isinstance(t.coefficient, str) and t.factor == 1]
    if not own:
        return None
    alpha = _orders(problem, item.order.constant, item.order.weights, points)
    gaps = [alpha - _orders(problem, t.order.constant, t.order.weights, points) for t in own]
    at = int(np.argmax([float(np.mean(g)) for g in gaps]))
    return str(own[at].coefficient), gaps[at]


def _least_squares(left: Complex, right: Complex) -> Floats:
    """Real answers to complex equations, for every point; directions that nothing tells are left at 0."""
    lengths = np.sqrt(np.sum(np.abs(left) ** 2, axis=1))
    unit = np.where((lengths > 0) & np.isfinite(lengths), lengths, 1.0)
    scaled = np.nan_to_num(left / unit[:, None, :])
    normal = np.einsum("bnp,bnq->bpq", scaled.conj(), scaled).real
    moment = np.einsum("bnp,bn->bp", scaled.conj(), np.nan_to_num(right)).real
    inverse = np.linalg.pinv(normal, rcond=1e-13, hermitian=True)
    answers: Floats = np.einsum("bpq,bq->bp", inverse, moment) / unit
    return answers


def _orders(problem: ResponseProblem, constant: float, weights: Sequence[tuple[str, float]], points: Floats) -> Floats:
    total = np.full(len(points), constant)
    for name, weight in weights:
        total = total + weight * points[:, problem.orders.index(name)]
    return total


def _shifts(problem: ResponseProblem, signal: str, points: Floats) -> Floats:
    if signal in problem.delays:
        return np.asarray(points[:, len(problem.orders) + len(problem.coefficients) + problem.delays.index(signal)])
    return np.full(len(points), problem.known_delays.get(signal, 0.0))


def _signal(problem: ResponseProblem, record: Measured, name: str, late: Complex) -> Complex | float:
    """What a term reads: a measured response, the input itself, or nothing."""
    outputs = problem.structure.outputs
    if name not in outputs:
        return late if name == record.input else 0.0
    if outputs.index(name) == record.output:
        return record.response
    other = next((r for r in problem.records if r.output == outputs.index(name) and r.input == record.input), None)
    if other is None:
        return 0.0
    # Between measured frequencies, where there are other ones; a start needs no more.
    order = np.argsort(other.frequency, kind="stable")
    at, x = np.log(record.frequency), np.log(other.frequency[order])
    values = other.response[order]
    return np.interp(at, x, values.real) + 1j * np.interp(at, x, values.imag)
