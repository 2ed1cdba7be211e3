"""Structures chosen: what the choice on two real runs costs, and how often a true structure is found.

``python benches/structures.py arm`` chooses the equation of θ12 from everything inside {D^k θ11, D^k θ21, D^k θ22,
k = 0, 1, 2; I1; two own terms of free order; an offset}, each run of the arm judged by a fit on the other one.
``python benches/structures.py truth --plants 3T,A,motor --seeds 20 [--first 0]`` counts in how many seeds at 40 dB the
chosen structure is the one that the run was made by: no term, no free order and no offset more or less. 3T is judged by
blocks of one run, the stage A by blocks of one run under both laws, the motor (SciPy) on two runs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import signal

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from arm_measured import arm_run
from ftlm.selection.candidates import Inside, Variant, signature
from plants import noisy_run
from results import append, heading

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
    wall, spent = time.perf_counter(), time.process_time()
    found = ftlm.select(runs, everything_inside(), threads=threads)
    wall, spent = time.perf_counter() - wall, time.process_time() - spent
    yield from ("```", *str(found).splitlines(), "```", "")
    yield f"- {wall:.0f} s, {spent:.0f} s of processor time on {threads} threads; {found.fitted} candidates fitted"


def motor(seed: int, rows: int = 400, late: int = 4, step: float = 0.02) -> ftlm.Run:
    """D^2 y = -5 D y - 40 y + 40 u(t - 0.08 s) by SciPy, 40 dB."""
    rng = np.random.default_rng([11, seed])
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 15 + 1), 15)[:rows]
    acts = np.concatenate([np.zeros(late), u[: rows - late]])
    system = signal.cont2discrete(signal.tf2ss([40.0], [1.0, 5.0, 40.0]), step, "zoh")
    y = signal.dlsim(system, acts)[1][:, 0]
    y = y + 0.01 * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, name=f"motor {seed}")


def plant(name: str, seed: int) -> tuple[list[ftlm.Run], ftlm.Structure, Variant]:
    """Runs, the structure whose inside is searched, and what is true inside it."""
    if name == "3T":
        words = "D^alpha y = a1 D^nu y + a0 y + b0 u + b1 D^gamma u"
        rich = ftlm.equation(words, orders={"gamma": (0.2, 1.5, 0.1)}, offset="auto")
        return [noisy_run(name, 40, seed)], rich, Variant(frozenset({"a1", "a0", "b0"}), (), offset=False)
    if name == "A":
        rich = replace(ftlm.flexible_link(form="published", stage=1), offset="auto")
        whole = (("alpha1", 2.0), ("alpha2", 2.0))
        return [noisy_run(name, 40, seed)], rich, Variant(frozenset(rich.coefficient_names), whole, offset=False)
    words = "D^2 y = d D^mu y + a y + b0 u + b1 D^gamma u"
    orders = {"mu": (0.1, 1.9, 0.1), "gamma": (0.5, 1.5, 0.1)}
    rich = ftlm.equation(words, orders=orders, offset="auto", delay={"u": (0.0, 0.3)})
    true = Variant(frozenset({"d", "a", "b0"}), (("mu", 1.0),), offset=False, inputs=frozenset({"delay_u"}))
    return [motor(2 * seed), motor(2 * seed + 1)], rich, true


def truth(names: list[str], seeds: range, threads: int) -> Iterator[str]:
    """How often the true structure is found, and what was chosen instead."""
    yield "| plant | seeds | found | processor time a seed | chosen instead |"
    yield "| --- | --- | --- | --- | --- |"
    for name in names:
        others, begun = [], time.process_time()
        for seed in seeds:
            runs, rich, true = plant(name, seed)
            found = ftlm.select(runs, rich, threads=threads)
            if signature(found.winner.structure) != signature(Inside(rich).build(true)):
                others.append(f"{seed}: {found.winner.name}")
            print(name, seed, found.winner.name, found.fitted, file=sys.stderr, flush=True)
        spent, count = (time.process_time() - begun) / max(len(seeds), 1), len(seeds) - len(others)
        which = f"{seeds.start} to {seeds.stop - 1}"
        yield f"| {name} | {which} | {count} of {len(seeds)} | {spent:.0f} s | {'; '.join(others)} |"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["arm", "truth"])
    parser.add_argument("--plants", default="3T,A,motor")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--write", action="store_true", help="append to benches/RESULTS.md")
    given = parser.parse_args()
    rows = (
        arm(given.threads)
        if given.what == "arm"
        else truth(given.plants.split(","), range(given.first, given.first + given.seeds), given.threads)
    )
    lines = [f"{heading()}:", ""]
    for line in rows:
        print(line, flush=True)
        lines.append(line)
    if given.write:
        append(lines)


if __name__ == "__main__":
    main()
