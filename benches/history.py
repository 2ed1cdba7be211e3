"""Runs that start in motion, measured: coverage of intervals, bases for the history against each other, weak pasts.

``python benches/history.py WHAT [--seeds 20] [--plants "0.7|1.7, 0.6"] [--write]`` prints tables; ``--write`` writes
benches/results.json. WHAT is intervals (fits of both halves of a motion, and of the second with Caputo's terms),
bases (the bias that each basis leaves and what it costs, by linear algebra on its own scheme) or waits (a run from
rest, or after a wait that lets a past fade). Seeds are 0 to ``--seeds`` less one, noise is 1 %.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from math import ceil, gamma
from pathlib import Path

import numpy as np
from scipy.signal import fftconvolve

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
import motion
from results import heading, save

#: Half-width of a 95 % interval in standard errors.
NORMAL_95 = 1.959963984540054
PROCESSES = 1


def cell(names: list[str], numbers: np.ndarray, form: str) -> str:
    """Numbers by name on one line."""
    return ", ".join(f"{n} {v:{form}}" for n, v in zip(names, numbers, strict=True))


# -------------------------------------------------------------------------------------------------- intervals


def halves(name: str, seed: int) -> tuple[list[list[float]], list[list[float]], list[list[float]]]:
    """z-scores, values and standard errors of the first half, the second, and the second with Caputo's terms."""
    plant = motion.PLANTS[name]
    first, second = motion.pieces(plant, seed)
    z, values, errors = [], [], []
    for run, initial in ((first, "auto"), (second, "auto"), (second, "caputo")):
        result = ftlm.identify(run, ftlm.equation(plant.words, initial=initial), threads=1)
        z.append(list(motion.scores(result, plant).values()))
        numbers = {**result.orders, **result.coefficients}
        values.append([numbers[n] for n in plant.truth])
        errors.append([result.standard_errors[n] for n in plant.truth])
    return z, values, errors


def intervals(plants: list[str], seeds: int) -> Iterator[str]:
    """Coverage from rest and in motion, and whether halves agree."""
    pooled = []
    with ProcessPoolExecutor(PROCESSES) as pool:
        for name in plants:
            z, values, errors = (np.array(x) for x in zip(*pool.map(partial(halves, name), range(seeds)), strict=True))
            hits = np.abs(z) < NORMAL_95
            apart = np.abs(values[:, 0] - values[:, 1]) / np.hypot(errors[:, 0], errors[:, 1]) < NORMAL_95
            pooled.append((hits[:, 0].ravel(), hits[:, 1].ravel(), apart.ravel()))
            names = list(motion.PLANTS[name].truth)
            yield (
                f"alpha {name}, {seeds} seeds, within 95 % intervals: from rest {cell(names, hits[:, 0].sum(0), 'd')}; "
                f"in motion {cell(names, hits[:, 1].sum(0), 'd')}; with Caputo's terms "
                f"{cell(names, hits[:, 2].sum(0), 'd')}; halves agree {cell(names, apart.sum(0), 'd')}; standard "
                f"errors in motion over those from rest {cell(names, np.median(errors[:, 1] / errors[:, 0], 0), '.2f')}"
            )
    rest, moving, agree = (100 * np.mean(np.concatenate(part)) for part in zip(*pooled, strict=True))
    yield f"pooled: from rest {rest:.1f} %, in motion {moving:.1f} %, halves agree {agree:.1f} %"


# ------------------------------------------------------------------------------------------------------ waits


def after(name: str, wait: int | None, seed: int) -> tuple[list[float], str]:
    """z-scores of a run after a motion and a wait of so many samples at u = 0; None: from rest."""
    plant, rows, step = motion.PLANTS[name], 500, 0.05
    lead = 0 if wait is None else rows + wait
    u = motion.held_command(rows + lead, seed, 20)
    u[min(rows, lead) : lead] = 0.0
    y = motion.response(plant, u, step)[lead:]
    y = y + 0.01 * np.std(y) * np.random.default_rng([seed, 2]).standard_normal(rows)
    run = ftlm.Run.from_arrays(step=step, inputs={"u": u[lead:]}, outputs={"y": y})
    result = ftlm.identify(run, ftlm.equation(plant.words), threads=1)
    return list(motion.scores(result, plant).values()), str(result.settings["initial"]).partition(",")[0]


def waits(plants: list[str], seeds: int) -> Iterator[str]:
    """Coverage where the past fades, and what was estimated of it."""
    with ProcessPoolExecutor(PROCESSES) as pool:
        for name in plants:
            names = list(motion.PLANTS[name].truth)
            for wait in (None, 0, 20, 100, 400, 1600, 6400):
                z, kinds = zip(*pool.map(partial(after, name, wait), range(seeds)), strict=True)
                hits = np.sum(np.abs(np.array(z)) < NORMAL_95, axis=0)
                when = "from rest" if wait is None else f"{wait} samples after a motion of 500"
                terms = ", ".join(f"{kind} {kinds.count(kind)}" for kind in sorted(set(kinds)))
                yield f"alpha {name}, {when}, {seeds} seeds: within {cell(names, hits, 'd')}; initial terms: {terms}"


# ------------------------------------------------------------------------------------------------------ bases


def kernel(eta: float, m: int, step: float) -> np.ndarray:
    """I^eta on pulse means, as printed: good to 1e-9 at these lengths."""
    powers = np.arange(m + 1.0) ** (eta + 1)
    v = np.concatenate([[1.0], np.diff(powers, 2)])
    return v * step**eta / gamma(eta + 2)


def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of series."""
    return fftconvolve(a, b)[: len(b)]


def inverse(series: np.ndarray) -> np.ndarray:
    """1 / series by Newton's iteration."""
    out = np.array([1.0 / series[0]])
    while len(out) < len(series):
        k = min(2 * len(out), len(series))
        out = np.concatenate([out, np.zeros(k - len(out))])
        rest = -times(series[:k], out)
        rest[0] += 2.0
        out = times(out, rest)
    return out


def powers_of_time(exponents: np.ndarray, m: int, step: float) -> list[np.ndarray]:
    """Means of t^e."""
    edges = np.arange(m + 1) * step
    return [np.diff(edges ** (e + 1)) / (e + 1) / step for e in exponents]


def quarters(last: int) -> Callable[[motion.Plant, int, float], list[np.ndarray]]:
    """Powers of t in quarters, and t^2."""
    exponents = np.array(sorted({*(k / 4 for k in range(last + 1)), 1.0, 2.0}))
    return lambda _, m, step: powers_of_time(exponents, m, step)


def caputo(plant: motion.Plant, m: int, step: float) -> list[np.ndarray]:
    """Caputo's terms."""
    exponents = {float(i) for i in range(ceil(plant.alpha))}
    exponents |= {round(plant.alpha - nu + i, 9) for _, nu in plant.own for i in range(ceil(nu))}
    return powers_of_time(np.array(sorted(exponents)), m, step)


def decays(count: int) -> Callable[[motion.Plant, int, float], list[np.ndarray]]:
    """Diffusive states: whole powers and exponentials, rates from half the record's to a third of a pulse's."""

    def basis(plant: motion.Plant, m: int, step: float) -> list[np.ndarray]:
        edges = np.arange(m + 1) * step
        rates = np.geomspace(0.5 / (m * step), 0.3 / step, count)
        return powers_of_time(np.arange(ceil(plant.alpha), dtype=float), m, step) + [
            -np.diff(np.exp(-rate * edges)) / rate / step for rate in rates
        ]

    return basis


def tails(plant: motion.Plant, m: int, step: float) -> list[np.ndarray]:
    """What past pieces of the signals leave, at the true orders: their principal components are the best basis."""
    edges, past = np.arange(m + 1) * step, np.geomspace(step, 100 * m * step, 60)
    columns = []
    for eta in sorted({plant.alpha - nu for _, nu in (*plant.own, *plant.inputs)}):
        since = [np.diff((edges + s) ** (eta + 1)) / step / gamma(eta + 2) for s in past]
        pieces = zip(since[1:], since[:-1], np.sqrt(np.diff(past)), strict=True)
        columns += [(late - early) / root for late, early, root in pieces]
        columns.append(since[0] - powers_of_time(np.array([eta]), m, step)[0] / gamma(eta + 1))
    return columns


BASES = {
    "Caputo's terms": (caputo, 0),
    "0, 1/4, 1/2, 3/4, 1, 2": (quarters(4), 0),
    "quarters to 1.5, 2": (quarters(6), 0),
    "quarters to 2": (quarters(8), 0),
    "quarters to 2.5": (quarters(10), 0),
    "4 exponentials": (decays(4), 0),
    "6 exponentials": (decays(6), 0),
    "8 exponentials": (decays(8), 0),
    "4 principal tails": (tails, 4),
    "6 principal tails": (tails, 6),
    "8 principal tails": (tails, 8),
}


#: Sizes of a past input to choose from, in units of the root mean square of the run's.
SIZES = (0.03, 0.1, 0.3, 1.0, 3.0)
#: Length of the past, in lengths of the run.
PAST = 4


def octaves(answer: np.ndarray, every: int) -> np.ndarray:
    """What a past input that is constant on octaves of time leaves, by the response to a step over all of the past.

    The first octave is one sample long; one column an octave, pulse means of the run.
    """
    m = answer.size // (1 + PAST)
    edges = [0, *(every << k for k in range((PAST * m // every - 1).bit_length())), PAST * m]
    after = [answer[edge : edge + m] for edge in edges]
    return np.array([late - early for early, late in itertools.pairwise(after)])


def residual_basis(
    plant: motion.Plant, seed: int, noise: float
) -> dict[str, tuple[float, np.ndarray, np.ndarray, int]]:
    """Of each basis: misfit over noise, bias and cost of each number in standard errors, and how many terms it has."""
    rows, over, step = 500, 4, 0.05
    m, fine = rows * over, step / over
    u = np.repeat(motion.held_command(2 * rows, seed, 20), over)
    truth = np.array(
        [plant.alpha, *(c for c, _ in plant.own), *(b for b, _ in plant.inputs), *(nu for _, nu in plant.own if nu)]
    )

    def system(numbers: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
        orders = iter(numbers[1 + len(plant.own) + len(plant.inputs) :])
        own = [(c, next(orders) if nu else 0.0) for c, (_, nu) in zip(numbers[1:], plant.own, strict=False)]
        after_own = numbers[1 + len(plant.own) :]
        divisor = -sum(c * kernel(numbers[0] - nu, length, fine) for c, nu in own)
        divisor[0] += 1.0
        drive = [b * kernel(numbers[0] - nu, length, fine) for b, (_, nu) in zip(after_own, plant.inputs, strict=False)]
        return inverse(divisor), np.sum(drive, axis=0)

    def samples(means: np.ndarray) -> np.ndarray:
        return 0.5 * (means[over - 1 : -1 : over] + means[over::over])

    def slopes(past: np.ndarray) -> np.ndarray:
        columns = []
        for i in range(len(truth)):
            ends = []
            for sign in (1e-4, -1e-4):
                shifted = truth.copy()
                shifted[i] += sign
                solved, drive = system(shifted, m)
                ends.append(times(solved, times(drive, u[m:]) + past))
            columns.append(samples(ends[0] - ends[1]) / 2e-4)
        return np.array(columns).T

    def past_answers(numbers: np.ndarray) -> np.ndarray:
        solved, drive = system(numbers, (1 + PAST) * m)
        return np.array([samples(row) for row in octaves(times(solved, np.cumsum(drive)), over)]).T

    def sensitivities(x: np.ndarray) -> np.ndarray:
        return np.array(
            [(past_answers(truth + move) - past_answers(truth - move)) @ x / 2e-4 for move in 1e-4 * np.eye(truth.size)]
        ).T

    solved, drive = system(truth, 2 * m)
    y = times(solved, times(drive, u))[m:]
    sigma = noise * np.std(y)
    solved, drive = solved[:m], drive[:m]
    rest = samples(y - times(solved, times(drive, u[m:])))
    alone = slopes(np.zeros(m))
    errors = np.sqrt(np.diag(np.linalg.inv(alone.T @ alone)))
    out = {}
    for name, (make_basis, basis_size) in BASES.items():
        basis = make_basis(plant, m, fine)
        if basis_size:
            responses = np.array([samples(times(solved, b)) for b in basis]).T
            _, sizes, rows_of = np.linalg.svd(responses, full_matrices=False)
            basis = [sum(v * b for v, b in zip(rows_of[i] / sizes[i], basis, strict=True)) for i in range(basis_size)]
        columns = np.array([samples(times(solved, b)) for b in basis]).T
        size = np.linalg.norm(columns, axis=0)
        spanned, _ = np.linalg.qr(columns / size)
        x = np.linalg.lstsq(columns / size, rest, rcond=1e-13)[0] / size
        sensitive = slopes(sum(v * b for v, b in zip(x, basis, strict=True)))
        sensitive -= spanned @ (spanned.T @ sensitive)
        missed = rest - spanned @ (spanned.T @ rest)
        covariance = np.linalg.inv(sensitive.T @ sensitive)
        deviations = np.sqrt(np.diag(covariance))
        bias = covariance @ (sensitive.T @ missed) / (sigma * deviations)
        out[name] = (float(np.linalg.norm(missed) / sigma), bias, deviations / errors, len(basis))
    # A past under a prior, whose size has the largest likelihood on one record with noise.
    columns = past_answers(truth)
    record = rest + sigma * np.random.default_rng([seed, 3]).standard_normal(rest.size)
    best = np.inf
    for size in SIZES:
        ratio = (size * np.sqrt(np.mean(u[m:] ** 2)) / sigma) ** 2
        inner = np.eye(columns.shape[1]) + ratio * columns.T @ columns
        x = ratio * np.linalg.solve(inner, columns.T @ record)
        deviance = (record @ record - record @ columns @ x) / sigma**2 + np.linalg.slogdet(inner)[1]
        if deviance < best:
            best, best_point = deviance, (ratio, inner, x)
    ratio, inner, x = best_point

    def whitened(v: np.ndarray) -> np.ndarray:
        return v - columns @ (ratio * np.linalg.solve(inner, columns.T @ v))

    sensitive = alone + sensitivities(x)
    covariance = np.linalg.inv(sensitive.T @ whitened(sensitive))
    deviations, missed = np.sqrt(np.diag(covariance)), whitened(rest)
    bias = covariance @ (sensitive.T @ missed) / (sigma * deviations)
    out["octaves of the past, prior"] = (
        float(np.linalg.norm(missed) / sigma),
        bias,
        deviations / errors,
        columns.shape[1],
    )
    return out


def bases(plants: list[str], seeds: int) -> Iterator[str]:
    """What each basis leaves of the second half of a motion, and what it costs, to first order.

    Misfit and bias are proportional to the signal over the noise: at 0.1 % they are ten times these.
    """
    for name in plants:
        with ProcessPoolExecutor(PROCESSES) as pool:
            tables = list(pool.map(partial(residual_basis, motion.PLANTS[name], noise=0.01), range(seeds)))
        for basis in tables[0]:
            misfit, bias, cost, terms = zip(*(table[basis] for table in tables), strict=True)
            worst = float(np.max(np.sqrt(np.mean(np.array(bias) ** 2, axis=0))))
            price = np.median(np.array(cost), axis=0)
            yield (
                f"alpha {name}, {basis} ({terms[0]} terms): misfit {np.median(misfit):.2g} standard deviations of the "
                f"noise, bias {worst:.2g} standard errors of the worst number, standard errors {price.min():.2f} to "
                f"{price.max():.2f} times those from rest"
            )


def main() -> None:
    """Measure and print; write them with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("intervals", "bases", "waits"))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--plants", default="|".join(motion.PLANTS))
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    rows_of_part = {"intervals": intervals, "bases": bases, "waits": waits}[arguments.what]
    lines = [f"{heading()}:", ""]
    print(lines[0])
    for row in rows_of_part(arguments.plants.split("|"), arguments.seeds):
        lines.append(f"- {row}")
        print(lines[-1], flush=True)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
