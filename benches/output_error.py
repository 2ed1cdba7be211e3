"""Promise P7: the joint output-error fit of a stage beside SciPy's on a NumPy simulator of the same scheme.

``python benches/output_error.py [--write]`` fits Plant A's ten numbers to two outputs of 5 000 samples at 40 dB, from
one start, one pulse a sample, and prints both times, their ratio, how far the two optima are apart, and what the
automatic start costs beside a fit.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import fftconvolve, lfilter
from scipy.special import binom, gamma

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import plants
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, minimize_cost, sample_run
from ftlm.estimation.output_error import fit_output_error
from ftlm.simulation.discretization import record
from laws import laws
from results import heading, save

#: Factors on the true coefficients and shifts of the true orders from which both start.
FACTORS = np.array([1.3, 0.8, 1.5, 1.2])
SHIFT = 0.05


def kernel(eta: float, m: int, step: float) -> np.ndarray:
    """Block-pulse kernel of I^eta, by the even binomial sum where the second difference cancels."""
    n = np.arange(1, m + 1, dtype=float)
    v = np.empty(m)
    v[0] = 1.0
    v[1] = 2.0 * np.expm1(eta * np.log(2.0))
    centre = n[2:] - 1.0
    terms = sum(binom(eta + 1.0, 2 * k) * centre ** (-2.0 * k) for k in range(25, 0, -1))
    v[2:] = 2.0 * centre ** (eta + 1.0) * terms
    return step**eta / gamma(eta + 2.0) * v


def simulated(problem: FreeProblem, x: np.ndarray, rec: object, signals: tuple[str, ...]) -> list[np.ndarray]:
    """Coupled free run of two equations: the 2 x 2 series system by elimination."""
    equations = laws(problem)
    orders, free = x[: len(problem.orders)], x[len(problem.orders) :]
    outputs = [law[0] for law in equations]
    m, step = rec.m, rec.step
    a = [[np.zeros(m), np.zeros(m)], [np.zeros(m), np.zeros(m)]]
    b = [np.zeros(m), np.zeros(m)]
    for i, (_, (constant, weights), terms) in enumerate(equations):
        a[i][i][0] += 1.0
        alpha = constant + np.dot(weights, orders)
        for signal, (base, slopes), (factor, powers) in terms:
            c = factor * np.prod([free[k] ** n for k, n in powers])
            v = kernel(alpha - base - np.dot(slopes, orders), m, step)
            if signal in outputs:
                a[i][outputs.index(signal)] -= c * v
            else:
                b[i] += c * fftconvolve(v, rec.means[signal])[:m]
    product = lambda p, q: fftconvolve(p, q)[:m]  # noqa: E731
    determinant = product(a[0][0], a[1][1]) - product(a[0][1], a[1][0])
    tops = (product(a[1][1], b[0]) - product(a[0][1], b[1]), product(a[0][0], b[1]) - product(a[1][0], b[0]))
    # Division of series is the recursive filter of that many taps.
    return [lfilter([1.0], determinant, top) for top in tops]


def main() -> None:
    """Measure and print; write them with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    run, structure = plants.noisy_run("A", 40.0, 0), plants.structure("A")
    problem, truth = FreeProblem.of(structure), plants.truth("A")
    weights = [1.0 / (0.01 * float(np.std(plants.clean_run("A")[o]))) for o in structure.outputs]
    prepared = [sample_run(run, problem, weights)]
    rec = record(run, structure, run.length - 1, filtered=False)
    signals = structure.signals
    orders = [
        min(max(truth[n] - SHIFT, low), high) for n, (low, high) in zip(problem.orders, problem.bounds, strict=True)
    ]
    coefficients = [truth[n] for n in problem.coefficients]
    coefficients[:4] = [c * f for c, f in zip(coefficients, FACTORS, strict=False)]
    coefficients[4] = 1.0 + 1.3 * (coefficients[4] - 1.0)

    start = time.perf_counter()
    rounds = 5
    for _ in range(rounds):
        ours = minimize_cost(problem, prepared, Iterate(orders, coefficients, "given", {}), evaluations=200)
    own = (time.perf_counter() - start) / rounds

    signs = np.sign(coefficients[:4])

    def back(z: np.ndarray) -> np.ndarray:
        return np.concatenate([z[:5], signs * np.exp(z[5:9]), [1.0 + np.exp(z[9])]])

    def residuals(z: np.ndarray) -> np.ndarray:
        out = []
        for y, w, o in zip(simulated(problem, back(z), rec, signals), weights, structure.outputs, strict=True):
            means = 0.5 * (y[:-1] + y[1:])
            out.append(w * (run[o][1:-1] - means))
        return np.concatenate(out)

    z0 = np.concatenate([orders, np.log(np.abs(coefficients[:4])), [np.log(coefficients[4] - 1.0)]])
    start = time.perf_counter()
    theirs = least_squares(residuals, z0, x_scale="jac", method="lm", xtol=1e-9, ftol=1e-9)
    rival = time.perf_counter() - start
    at = np.array(ours.orders + ours.coefficients)
    errors = np.array([plants.CRAMER_RAO_40_DB["A"][n] for n in (*problem.orders, *problem.coefficients)])
    apart = np.max(np.abs(back(theirs.x) - at) / errors)
    z = np.concatenate([at[:5], np.log(np.abs(at[5:9])), [np.log(at[9] - 1.0)]])
    same = float(np.max(np.abs(residuals(z) - np.asarray(ours.outcome["residuals"]))))
    # By processor time on one core, which other work on the machine does not stretch.
    start = time.process_time()
    for _ in range(rounds):
        minimize_cost(problem, prepared, Iterate(orders, coefficients, "given", {}), evaluations=200)
    one = (time.process_time() - start) / rounds
    start = time.process_time()
    fit_output_error([run], structure, threads=1, refine=False)
    whole = time.process_time() - start
    # As a person waits for it: with its fits on all cores.
    cores = os.cpu_count() or 1
    start = time.perf_counter()
    fit_output_error([run], structure, threads=cores, refine=False)
    waited = time.perf_counter() - start
    lines = [
        f"{heading()}:",
        "",
        f"- P7, ten numbers, two outputs of 5 000 samples, 40 dB, same start: {own:.3f} s, "
        f"{ours.outcome['evaluations']} evaluations, one core; SciPy on NumPy {rival:.1f} s, "
        f"{theirs.nfev} evaluations: {rival / own:.0f} times; "
        f"simulators differ by {same:.1g} of the noise; costs {ours.outcome['cost']:.4f} and {theirs.cost:.4f}, optima "
        f"{apart:.1g} standard errors apart",
        f"- automatic start with its fits, processor time: {whole:.2f} s, {whole / one:.0f} times that of the fit "
        f"({one:.3f} s); wall time on {cores} cores {waited:.2f} s, {waited / own:.0f} times (promised 60); load "
        f"{os.getloadavg()[0]:.1f}",
    ]
    print("\n".join(lines))
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
