"""Truth under noise, measured: bias against step, Monte-Carlo of the joint fit, the three-term table, random plants.

``python benches/truth.py WHAT [--seeds 100] [--plants A,A2,3T] [--levels 20,40,60,80] [--write]``
prints tables; ``--write`` writes them to benches/results.json. WHAT is bias, intervals, instruments, orders,
three-terms, random-plants, arm (real runs, see arm_measured.py) or heating. Seeds are 0 to ``--seeds`` less one, and
are never changed.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import arm_measured
import ftlm
import plants
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, minimize_cost, sample_run
from ftlm.estimation.output_error import fit_output_error
from ftlm.reproduction.simulated_arm import demo_plant
from results import ResultStore, heading, save

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

#: Half-width of a 95 % interval in standard errors.
NORMAL_95 = 1.959963984540054
#: A start ends in the global optimum if its noise variance is within this share of that reached from the truth.
SAME_OPTIMUM = 0.01


@dataclass(frozen=True)
class Scores:
    """z-scores of every seed and parameter of one plant at one noise level."""

    plant: str
    level: float
    names: tuple[str, ...]
    z: np.ndarray
    seconds: float

    @property
    def mean(self) -> np.ndarray:
        """Mean z of each parameter."""
        return self.z.mean(axis=0)

    @property
    def coverage(self) -> np.ndarray:
        """Share of 95 % intervals that hold the truth, of each parameter, in percent."""
        return 100.0 * np.mean(np.abs(self.z) < NORMAL_95, axis=0)

    def __str__(self) -> str:
        mean, share = self.mean, 100 * np.mean(np.abs(self.z) < NORMAL_95)
        at = int(np.argmax(np.abs(mean)))
        worst = f"{abs(mean[at]):.2f} ({self.names[at]})"
        return (
            f"{self.plant} {self.level:g} dB, {len(self.z)} seeds: largest |mean z| {worst}; "
            f"95 % intervals cover {share:.1f} % pooled, {self.coverage.min():.0f} to {self.coverage.max():.0f} % by "
            f"parameter; largest |z| {np.max(np.abs(self.z)):.1f}; {self.seconds:.1f} s a fit on one core"
        )


def workers() -> int:
    """Cores."""
    return os.cpu_count() or 1


def fit(task: tuple[str, float, int]) -> tuple[np.ndarray, tuple[str, ...], float]:
    """z-scores of one seed from the automatic start."""
    name, level, seed = task
    start = time.process_time()
    result = fit_output_error([plants.noisy_run(name, level, seed)], plants.structure(name))
    truth = plants.truth(name)
    z = (result.values - np.array([truth[n] for n in result.names])) / np.sqrt(np.diag(result.covariance))
    return z, tuple(result.names), time.process_time() - start


def intervals(names: Iterable[str], levels: Iterable[float], seeds: int) -> Iterator[Scores]:
    """Monte-Carlo of the joint fit from the automatic start."""
    with ProcessPoolExecutor(workers()) as pool:
        for name in names:
            for level in levels:
                ended = list(pool.map(fit, [(name, level, s) for s in range(seeds)]))
                z = np.array([e[0] for e in ended])
                yield Scores(name, level, ended[0][1], z, float(np.mean([e[2] for e in ended])))


def bias(names: Iterable[str]) -> Iterator[str]:
    """Error of the estimates from noise-free samples against pulses a sample, in standard errors at 40 dB."""
    for name in names:
        structure, run, truth = plants.structure(name), plants.clean_run(name), plants.truth(name)
        problem = FreeProblem.of(structure)
        true = [truth[n] for n in (*problem.orders, *problem.coefficients)]
        weights = [1.0 / (0.01 * float(np.std(run[o]))) for o in structure.outputs]
        split = len(problem.orders)
        before: np.ndarray | None = None
        for every in (1, 2, 4, 8, 16):
            prepared = [sample_run(run, problem, weights, pulses_per_sample=every)]
            start = Iterate(true[:split], true[split:], "truth", {})
            end = minimize_cost(problem, prepared, start, evaluations=60, linear_scale=True)
            jacobian = np.asarray(end.outcome["jacobian"])
            size = np.linalg.norm(jacobian, axis=1)
            scaled = jacobian / size[:, None]
            errors = np.sqrt(np.diag(np.linalg.inv(scaled @ scaled.T))) / size
            values = np.array(end.orders + end.coefficients)
            plain = np.max(np.abs(values - true) / errors)
            limit = (
                ""
                if before is None
                else (f"; extrapolated {np.max(np.abs((4 * values - before) / 3 - true) / errors):.2g}")
            )
            before = values
            yield f"{name}, {every} pulses a sample: largest bias {plain:.2g} standard errors{limit}"


def three_terms(task: tuple[float, int]) -> float:
    """Fit to the noise-free output of one seed."""
    level, seed = task
    run, clean = plants.noisy_run("3T", level, seed), plants.clean_run("3T")
    result = ftlm.identify(run, plants.structure("3T"), threads=1)
    y = clean["y"]
    simulated = result.model.simulate(clean, tolerance=1e-6)["y"]
    return float(100 * (1 - np.linalg.norm(simulated - y) / np.linalg.norm(y - y.mean())))


def three_terms_table(seeds: int) -> Iterator[str]:
    """Median fit to the noise-free output, all five numbers free."""
    with ProcessPoolExecutor(workers()) as pool:
        for level in (40, 20, 10):
            fits = np.array(list(pool.map(three_terms, [(level, s) for s in range(seeds)])))
            yield (
                f"3T {level} dB, {seeds} seeds: median fit to the clean output {np.median(fits):.3f} %, "
                f"least {fits.min():.3f} %"
            )


def random_plant(seed: int) -> tuple[int, float, float, str]:
    """Excess noise variance of one plant's automatic start over the fit from the truth, and its time."""
    model, structure, clean = plants.random_plant(seed)
    run = plants.with_noise(clean, 40.0, [seed, 40, 9])
    truth = plants.random_truth(model, structure)
    words = ", ".join(f"{n} {v:.3g}" for n, v in truth.items())
    start = time.process_time()
    try:
        result = fit_output_error([run], structure)
        seconds = time.process_time() - start
        reference = fit_output_error([run], structure, start=truth)
    except ftlm.FtlmError as error:
        return seed, np.inf, time.process_time() - start, f"{words}: {error}"
    return seed, (result.noise["y"] / reference.noise["y"]) ** 2 - 1.0, seconds, words


def random_plants(seeds: int, store: ResultStore) -> Iterator[str]:
    """Share of random plants whose automatic start ends in the global optimum; the others one by one."""
    seeds_missing = [s for s in range(seeds) if f"random plant {s}" not in store.known]
    with ProcessPoolExecutor(workers()) as pool:
        for end in pool.map(random_plant, seeds_missing):
            store.row(f"random plant {end[0]}", functools.partial(dict, end=end))
    ended = [store.known[f"random plant {s}"]["end"] for s in range(seeds)]
    missed = [e for e in ended if e[1] > SAME_OPTIMUM]
    yield (
        f"random plants, seeds 0 to {seeds - 1}, 40 dB: {seeds - len(missed)} of {seeds} end in the global optimum; "
        f"{np.mean([e[2] for e in ended]):.2f} s a fit on one core"
    )
    for seed, excess, _, words in missed:
        yield f"  missed: seed {seed} ({words}), noise variance {100 * excess:.3g} % above"


def shortfall(model: ftlm.Model, best: ftlm.Model, clean: ftlm.Run) -> float:
    """Points of fit to the noise-free outputs that one model has less than another; of the worst output."""
    reached, best_fits = clean_fits(model, clean), clean_fits(best, clean)
    return max(best_fits[n] - reached[n] for n in clean.outputs)


def instruments(seeds: int) -> Iterator[str]:
    """Coefficients of Plant A by instrumental variables at the true orders, and fit of their coupled free run."""
    structure, clean = plants.structure("A"), plants.clean_run("A")
    true = structure.with_orders({n: v for n, v in plants.truth("A").items() if n in structure.order_names})
    exact = demo_plant(1, form="published").coefficients
    for level in (60, 40, 20):
        results = [
            ftlm.identify(plants.noisy_run("A", level, s), true, method="instrumental-variables") for s in range(seeds)
        ]
        for name, value in exact.items():
            values = np.array([f.coefficients[name] for f in results])
            errors = np.array([f.standard_errors[name] for f in results])
            z = (values - value) / errors
            yield (
                f"A {level} dB, {seeds} seeds: {name} {values.mean():.5g} ± {values.std():.2g} (truth {value:.5g}), "
                f"standard error {np.median(errors):.2g}, mean z {z.mean():.2f}, |z| < 1.96 in "
                f"{100 * np.mean(np.abs(z) < NORMAL_95):.0f} %"
            )
        fits = np.array([list(clean_fits(f.model, clean).values()) for f in results])
        words = ", ".join(
            f"{o} {m:.3f} % (least {w:.3f})"
            for o, m, w in zip(clean.outputs, np.median(fits, axis=0), fits.min(axis=0), strict=True)
        )
        yield f"A {level} dB, {seeds} seeds: median fit of the coupled free run to the clean outputs {words}"


def clean_fits(model: ftlm.Model, clean: ftlm.Run) -> dict[str, float]:
    """Fit of a model's free run to noise-free outputs."""
    simulated = model.simulate(clean, tolerance=1e-6)
    return {
        n: 100 * (1 - float(np.linalg.norm(simulated[n] - clean[n]) / np.linalg.norm(clean[n] - clean[n].mean())))
        for n in clean.outputs
    }


#: Values of the orders around the truth; every true order is one of them.
LATTICES = {
    "3T": {"alpha": (1.05, 2.6)},
    "A": {"alpha": (1.85, 2.0), "gamma1": (0.8, 1.1), "beta2": (0.0, 0.25), "mu2": (0.7, 1.0)},
}


def orders_by_lattice(task: tuple[str, int]) -> tuple[dict[str, float], float]:
    """Orders of one seed by the lattice with instrumental variables, and what their model lacks."""
    name, seed = task
    run, clean, structure = plants.noisy_run(name, 40.0, seed), plants.clean_run(name), plants.structure(name)
    true = structure.with_orders({n: v for n, v in plants.truth(name).items() if n in structure.order_names})
    best = ftlm.identify(run, true, method="instrumental-variables", threads=1)
    try:
        result = ftlm.identify(
            run, structure, method=ftlm.InstrumentalVariables(order_grid=ftlm.order_grid(**LATTICES[name])), threads=1
        )
        return result.orders, shortfall(result.model, best.model, clean)
    except ftlm.ConvergenceError:
        return dict.fromkeys(structure.order_names, np.inf), np.inf


def orders(names: Iterable[str], seeds: int) -> Iterator[str]:
    """Share of seeds whose lattice with instrumental variables returns every order within one step of the truth."""
    step = 0.05
    with ProcessPoolExecutor(workers()) as pool:
        for name in names:
            ended = list(pool.map(orders_by_lattice, [(name, s) for s in range(seeds)]))
            truth = plants.truth(name)
            off = [max(abs(v - truth[n]) for n, v in e[0].items()) for e in ended]
            near = sum(o < 1.001 * step for o in off)
            close, most = sum(e[1] < 0.1 for e in ended), max(e[1] for e in ended)
            yield (
                f"{name} 40 dB, {seeds} seeds: every order within one step of the truth in {near}; fit to the clean "
                f"outputs within 0.1 points of the true orders' in {close} (most lacking {most:.3f}); "
                f"largest miss {max(off):.2f}"
            )


# ------------------------------------------------------------------------------------------------ the heating system

HEATING = {
    "order 1": ("D T = a0 T + b0 u + c0 one", (0.0,)),
    "order 2": ("D^2 T = a1 D T + a0 T + b0 u + c0 one", (0.0, 1.0)),
    "order alpha": ("D^alpha T = a0 T + b0 u + c0 one", (0.0,)),
    "orders alpha, nu": ("D^alpha T = a1 D^nu T + a0 T + b0 u + c0 one", (0.0,)),
}


def heating() -> Iterator[str]:
    """A diffusive system that does not start at rest: T(0) as an initial term, the surroundings as a constant input."""
    folder = Path(os.environ.get("FTLM_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    table = np.loadtxt(folder / "heating" / "heating_system.dat")
    run = ftlm.Run.from_arrays(
        step=2.0,
        inputs={"u": table[:, 1], "one": np.ones(len(table))},
        outputs={"T": table[:, 2]},
        units={"T": "degC", "u": "V"},
        name="heating",
    )
    for name, (words, initial) in HEATING.items():
        structure = replace(ftlm.equation(words), initial=initial)
        result = ftlm.identify(run, structure)
        part = ftlm.identify(run.window(0, 1000), structure)
        numbers = ", ".join(f"{n} {v:.3f} ± {result.standard_errors[n]:.2g}" for n, v in result.orders.items())
        finer = result.joint.noise["T"] if result.joint is not None else np.nan
        yield (
            f"{name}: fit {result.fit['T']:.2f} %, residuals {finer:.2f} degC, BIC {result.information.bic:.0f}"
            f"{'; ' + numbers if numbers else ''}; identified from the first 1000 of 1600 s: "
            f"{part.model.compare(run).fit['T']:.2f} % of all"
        )
        yield from (f"  {name}: {w}" for w in result.warnings)


def main() -> None:
    """Measure and print; write them with ``--write``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "what",
        choices=("bias", "intervals", "instruments", "orders", "three-terms", "random-plants", "arm", "heating"),
    )
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--plants", default="A,A2,3T")
    parser.add_argument("--levels", default="20,40,60,80")
    parser.add_argument("--kept", type=Path, help="file of random plants that are done, to go on from")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    names = arguments.plants.split(",")
    rows: Iterable[object] = {
        "bias": lambda: bias(names),
        "intervals": lambda: intervals(names, [float(x) for x in arguments.levels.split(",")], arguments.seeds),
        "instruments": lambda: instruments(arguments.seeds),
        "orders": lambda: orders([n for n in names if n in LATTICES], arguments.seeds),
        "three-terms": lambda: three_terms_table(arguments.seeds),
        "random-plants": lambda: random_plants(arguments.seeds, ResultStore(arguments.kept)),
        "arm": lambda: itertools.chain(arm_measured.measurements(), arm_measured.orders(), arm_measured.steps()),
        "heating": heating,
    }[arguments.what]()
    lines = [f"{heading()}:", ""]
    print(lines[0])
    for row in rows:
        # Rows of a table stay one.
        lines.append(str(row) if str(row).startswith("|") else f"- {row}")
        print(lines[-1], flush=True)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
