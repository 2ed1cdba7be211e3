"""Structures chosen: what the choice on two real runs costs, and how often a true structure is found.

``python benches/structures.py arm`` chooses the equation of θ12 from everything inside {D^k θ11, D^k θ21, D^k θ22,
k = 0, 1, 2; I1; two own terms of free order; an offset}, each run of the arm judged by a fit on the other one.
``python benches/structures.py truth --plants 3T,A,motor --seeds 100 [--first 0] [--kept FILE]`` counts in how many
seeds at 40 dB the chosen structure is the one that the run was made by: no term, no free order and no offset more or
less. 3T is judged by blocks of one run, the stage A by blocks of one run under both laws, the motor on two runs. No run
is simulated by ftlm: the motor's are SciPy's, those of 3T and A an inverse z-transform's (``tests/python/oracles.py``).
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from arm_measured import arm_run
from ftlm.structure_selection.candidates import NestedStructures, Variant, describe_structure, signature
from ftlm.structure_selection.cross_validation import (
    Folds,
    fit,
    residual_variance_inflation,
    schwarz_criterion,
    validate_fit,
)
from oracles import held_response
from results import ResultStore, heading, save

DRIVES = [(hub, k) for hub in ("theta11", "theta21", "theta22") for k in (0, 1, 2)]


def everything_inside(offset: str = "auto") -> ftlm.Structure:
    """The equation of θ12 with all that the choice is made from."""
    orders = {"beta": (0.0, 0.95, 0.05), "mu": (0.05, 1.95, 0.05)}
    terms = ["a D^beta theta12", "d D^mu theta12"]
    for number, (hub, k) in enumerate(DRIVES):
        orders[f"g{number}"] = (max(k - 0.5, 0.0), k + 0.4, 0.05)
        terms.append(f"c{number} D^g{number} {hub}")
    terms.append("i I1")
    sensor = ftlm.SensorFilter.low_pass(["theta12", "theta22"])
    return ftlm.equation(
        f"D^2 theta12 = {' + '.join(terms)}", orders=orders, sensor_filter=sensor, offset=offset, initial="caputo"
    )


def arm(threads: int) -> Iterator[str]:
    """The choice on psf and lqr."""
    runs = [arm_run(n) for n in ("psf", "lqr")]
    wall, cpu = time.perf_counter(), time.process_time()
    selection = ftlm.select(runs, everything_inside(), threads=threads)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    yield from ("```", *str(selection).splitlines(), "```", "")
    times = f"{wall:.0f} s, {cpu:.0f} s of processor time on {threads} threads"
    yield f"- {times}; {selection.fitted_count} candidates fitted"


def motor(seed: int, rows: int = 400, late: int = 4, step: float = 0.02) -> ftlm.Run:
    """D^2 y = -5 D y - 40 y + 40 u(t - 0.08 s) by SciPy, 40 dB."""
    rng = np.random.default_rng([11, seed])
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 15 + 1), 15)[:rows]
    acts = np.concatenate([np.zeros(late), u[: rows - late]])
    system = signal.cont2discrete(signal.tf2ss([40.0], [1.0, 5.0, 40.0]), step, "zoh")
    y = signal.dlsim(system, acts)[1][:, 0]
    y = y + 0.01 * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, name=f"motor {seed}")


def three_terms(seed: int) -> ftlm.Run:
    """D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u under a square wave, by an inverse z-transform, 40 dB."""
    rows, step = 2049, 20.0 / 2048
    u = np.sign(np.sin(2 * np.pi * (np.arange(rows) + 0.5) * step / 5.0))
    y = held_response(lambda s: 1.25 / (s**2.2 + 0.625 * s**0.9 + 1.25), u, step)
    return noisy({"u": u}, {"y": y}, step, [12, seed], f"3T {seed}")


def stage(seed: int) -> ftlm.Run:
    """Plant A, the first stage in the published form, under a square wave, by an inverse z-transform, 40 dB."""
    rows, step = 5000, 0.002
    current = np.where((np.arange(rows) % 1000) < 500, 0.3, -0.3)
    a, b, d, g, r = 628.89, 62.956, 6.63, 140.47, 863.2474823943662 / 628.89

    def angles(s: np.ndarray) -> np.ndarray:
        hub, link = s**2 + b * s**0.95, s**2 + r * a * s**0.1 + r * d * s**0.85
        bent, driven = a + d * s**0.75, b * s**1.05
        size = hub * link - bent * driven
        return np.stack([g * (link - bent) / size, g * (driven - hub) / size])

    theta = held_response(angles, current, step)
    return noisy({"I1": current}, {"theta11": theta[0], "theta12": theta[1]}, step, [13, seed], f"A {seed}")


def noisy(
    inputs: dict[str, np.ndarray], outputs: dict[str, np.ndarray], step: float, seed: list[int], name: str
) -> ftlm.Run:
    """A run with white noise of 1 % on every output."""
    rng = np.random.default_rng(seed)
    read = {n: y + 0.01 * np.std(y) * rng.standard_normal(y.size) for n, y in outputs.items()}
    return ftlm.Run.from_arrays(step=step, inputs=inputs, outputs=read, name=name)


def plant(name: str, seed: int) -> tuple[list[ftlm.Run], ftlm.Structure, Variant]:
    """Runs, the structure whose inside is searched, and what is true inside it."""
    if name == "3T":
        words = "D^alpha y = a1 D^nu y + a0 y + b0 u + b1 D^gamma u"
        rich = ftlm.equation(words, orders={"gamma": (0.2, 1.5, 0.1)}, offset="auto")
        return [three_terms(seed)], rich, Variant(frozenset({"a1", "a0", "b0"}), (), offset=False)
    if name == "A":
        rich = replace(ftlm.flexible_link(form="published", stage=1), offset="auto")
        whole = (("alpha1", 2.0), ("alpha2", 2.0))
        return [stage(seed)], rich, Variant(frozenset(rich.coefficient_names), whole, offset=False)
    words = "D^2 y = d D^mu y + a y + b0 u + b1 D^gamma u"
    orders = {"mu": (0.1, 1.9, 0.1), "gamma": (0.5, 1.5, 0.1)}
    rich = ftlm.equation(words, orders=orders, offset="auto", delay={"u": (0.0, 0.3)})
    true = Variant(frozenset({"d", "a", "b0"}), (("mu", 1.0),), offset=False, inputs=frozenset({"delay_u"}))
    return [motor(2 * seed), motor(2 * seed + 1)], rich, true


def choice(name: str, seed: int, threads: int) -> dict[str, Any]:
    """Whether the true structure is chosen, and where it is not, how the truth stands beside what was chosen."""
    start_time, wall = time.process_time(), time.perf_counter()
    runs, rich, true = plant(name, seed)
    selection = ftlm.select(runs, rich, threads=threads)
    row = {
        "fitted": selection.fitted_count,
        "spent": time.process_time() - start_time,
        "wall": time.perf_counter() - wall,
        "chosen": selection.winner.name,
    }
    structure = NestedStructures(rich).build(true)
    key = signature(structure)
    row["found"] = signature(selection.winner.structure) == key
    if row["found"]:
        return row
    there = next((t for t in selection.trials if signature(t.structure) == key), None)
    row["why"] = "the choice" if there is not None else "the search: the truth was not judged"
    if there is None:
        folds = Folds.of(runs, "runs" if len(runs) > 1 else "blocks")
        there = validate_fit(describe_structure(structure), structure, folds, fit(folds.runs, structure, []))
        there = replace(there, bic=schwarz_criterion(there.joint, scatter_of(selection)))
    for word, trial in {"truth": there, "winner": selection.winner, "best": selection.trials[0]}.items():
        row[word] = {"name": trial.name, "numbers": trial.parameter_count, "bic": trial.bic, "scores": trial.scores}
    return row


def scatter_of(selection: ftlm.Selection) -> float:
    """How many samples told as much as one, when a choice compared criteria."""
    return min(residual_variance_inflation(t.joint) for t in selection.trials if t.joint is not None)


def failure(seed: int, row: dict[str, Any]) -> Iterator[str]:
    """A seed in which something else was chosen, in words."""
    truth, winner, best = (row[n] for n in ("truth", "winner", "best"))
    yield f"seed {seed}: {winner['name']}, by {row['why']}"
    means = {n: float(np.mean(t["scores"])) for n, t in (("truth", truth), ("chosen", winner), ("best", best))}
    for word, trial in (("chosen", winner), ("best", best)):
        apart = np.array(truth["scores"]) - np.array(trial["scores"])
        error = float(np.std(apart, ddof=1)) / np.sqrt(apart.size)
        yield (
            f"  the truth leaves {100 * (np.exp(means['truth'] - means[word]) - 1):.3g} % more where unseen than the "
            f"{word} ({trial['numbers']} numbers for {truth['numbers']}), {float(np.mean(apart)) / error:.2g} standard "
            f"errors of {apart.size} folds; its criterion is {truth['bic'] - trial['bic']:+.3g}"
        )


def truth(names: list[str], seeds: range, threads: int, store: ResultStore) -> Iterator[str]:
    """How often the true structure is found, and what was chosen instead."""
    yield "| plant | seeds | found | processor time a seed, the longest | wall clock a seed | commit |"
    yield "| --- | --- | --- | --- | --- | --- |"
    failures: list[str] = []
    for name in names:
        rows: dict[int, dict[str, Any]] = {}
        for seed in seeds:
            rows[seed] = row = store.row(f"{name} {seed}", functools.partial(choice, name, seed, threads))
            print(f"{name} {seed}: {'' if row['found'] else 'NOT THE TRUE ONE: '}{row['chosen']}", file=sys.stderr)
            print(f"  {row['fitted']} fitted, {row['spent']:.1f} s of processor time", file=sys.stderr, flush=True)
            if not row["found"]:
                failures += [f"- {name}, {line}" if line[0] != " " else line for line in failure(seed, row)]
        cpu, wall = ([r[k] for r in rows.values()] for k in ("spent", "wall"))
        yield (
            f"| {name} | {seeds.start} to {seeds.stop - 1} | {sum(r['found'] for r in rows.values())} of {len(rows)} | "
            f"{np.mean(cpu):.1f} s, {max(cpu):.1f} s | {np.mean(wall):.1f} s | "
            f"{store.commits([f'{name} {s}' for s in seeds])} |"
        )
    yield from ("", *failures)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["arm", "truth"])
    parser.add_argument("--plants", default="3T,A,motor")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--kept", type=Path, help="file of seeds that are done, to go on from")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    rows = (
        arm(arguments.threads)
        if arguments.what == "arm"
        else truth(arguments.plants.split(","), seeds, arguments.threads, ResultStore(arguments.kept))
    )
    lines = [f"{heading()}:", ""]
    for line in rows:
        print(line, flush=True)
        lines.append(line)
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
