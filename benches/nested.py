"""Nested structures: how often one that contains another ends with a larger cost.

``python benches/nested.py [--records psf,lqr,steps,heating,robot_arm,plants,wrong] [--seeds 40] [--first 0] [--kept
FILE]`` fits chains of four structures, each of which contains the one before it, by the default call, and compares the
mean squares of their residuals, each richer structure against the least of all that it contains. Plants are random ones
of the chain at 40 dB; wrong ones have a resonance and a dead time that the chain lacks.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from arm_measured import FOLDER, arm_run, step_run
from plants import resonant_plant
from results import ResultStore, heading, save

#: The share of the cost beyond which a richer structure counts as worse.
COST_TOLERANCE = 1e-3
#: A driven link with one order after another freed; and with a term more.
LINK = {
    "whole": ("D^2 {y} = d D {y} + a {y} + b D^2 {u}", {}),
    "mu": ("D^2 {y} = d D^mu {y} + a {y} + b D^2 {u}", {}),
    "mu, gamma": ("D^2 {y} = d D^mu {y} + a {y} + b D^gamma {u}", {}),
    "alpha, mu, gamma": ("D^alpha {y} = d D^mu {y} + a {y} + b D^gamma {u}", {}),
}
LINK_TERMS = {
    "three": ("D^2 {y} = d D {y} + a {y} + b D^2 {u}", {}),
    "gamma": ("D^2 {y} = d D {y} + a {y} + b D^gamma {u}", {}),
    "a spring-pot": ("D^2 {y} = d D {y} + a D^beta {y} + b D^gamma {u}", {}),
    "and a fractional damper": ("D^2 {y} = d D {y} + a D^beta {y} + e D^nu {y} + b D^gamma {u}", {}),
}
#: One input: integer orders, then the output's, then a term's, then a term more.
ORDERS = {
    "whole": ("D^2 {y} = d D {y} + a {y} + b {u}", {}),
    "alpha": ("D^alpha {y} = d D {y} + a {y} + b {u}", {}),
    "alpha, mu": ("D^alpha {y} = d D^mu {y} + a {y} + b {u}", {}),
    "alpha, mu, nu": ("D^alpha {y} = d D^mu {y} + e D^nu {y} + a {y} + b {u}", {}),
}
FIRST = {
    "whole": ("D {y} = a {y} + b {u}", {}),
    "alpha": ("D^alpha {y} = a {y} + b {u}", {}),
    "mu": ("D^alpha {y} = d D^mu {y} + a {y} + b {u}", {}),
    "and nu": ("D^alpha {y} = d D^mu {y} + e D^nu {y} + a {y} + b {u}", {}),
}
CHAINS = {"link": LINK, "link, terms": LINK_TERMS, "orders": ORDERS, "diffusive": FIRST}


def driven(run: ftlm.Run, output: str, hub: str) -> ftlm.Run:
    """A deflection and its hub's angle as two signals of a record."""
    return ftlm.Run.from_arrays(
        step=run.step, inputs={"u": run[hub]}, outputs={"y": run[output]}, intersample={"u": "foh"}, name=run.name
    )


def records(names: list[str], seeds: range) -> Iterator[tuple[ftlm.Run, list[str]]]:
    """Each record with its chains."""
    for name in ("psf", "lqr"):
        if name in names:
            run = arm_run(name)
            for stage in (1, 2):
                yield driven(run, f"theta{stage}2", f"theta{stage}1"), ["link", "link, terms"]
    if "steps" in names:
        for name in ("lqg_20", "lqg_minus10", "lqg_30", "lqr_20", "lqr_minus20", "lqr_5"):
            yield driven(step_run(FOLDER / "two_link_steps" / f"{name}.csv"), "theta12", "theta11"), ["link"]
    if "heating" in names:
        table = np.loadtxt(FOLDER / "heating" / "heating_system.dat")
        yield (
            ftlm.Run.from_arrays(
                step=2.0, inputs={"u": table[:, 1]}, outputs={"y": table[:, 2] - table[0, 2]}, name="heating"
            ),
            ["diffusive", "orders"],
        )
    if "robot_arm" in names:
        table = np.loadtxt(FOLDER / "robot_arm" / "robot_arm.dat")
        yield (
            ftlm.Run.from_arrays(step=1.0, inputs={"u": table[:, 0]}, outputs={"y": table[:, 1]}, name="robot_arm"),
            ["orders"],
        )
    for seed in seeds:
        if "plants" in names:
            yield resonant_plant(seed, wrong=False), ["orders"]
        if "wrong" in names:
            yield resonant_plant(seed, wrong=True), ["orders"]


def chain(run: ftlm.Run, name: str) -> Iterator[str]:
    """Fit a chain; a row a structure, the ratio of its cost to the least of those that it contains."""
    least = np.inf
    for kind, (text, orders) in CHAINS[name].items():
        start_time = time.process_time()
        structure = ftlm.equation(text.format(y="y", u="u"), orders=orders)
        try:
            result = ftlm.identify(run, structure, threads=1, method=ftlm.OutputError(intervals="quadratic"))
        except ftlm.FtlmError as error:
            yield f"| {run.name} | {name} | {kind} | {error} | | |"
            continue
        assert result.joint is not None
        cost = result.joint.noise["y"] ** 2
        ratio = cost / least
        worse = " **worse**" if ratio > 1.0 + COST_TOLERANCE else ""
        numbers = ", ".join(f"{p.name} {p.value:.4g}" for p in result.parameters.values())
        seconds = time.process_time() - start_time
        yield (
            f"| {run.name} | {name} | {kind} | {result.fit['y']:.2f} | {ratio:.4f}{worse} | {numbers}; "
            f"{result.joint.initial_terms} initial terms | {seconds:.1f} s |"
        )
        least = min(least, cost)


def rows_of(run: ftlm.Run, name: str) -> dict[str, list[str]]:
    """A chain's rows, to be kept."""
    return {"rows": list(chain(run, name))}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", default="psf,lqr,steps,heating,robot_arm,plants,wrong")
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--kept", type=Path, help="file of chains that are done, to go on from")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    store = ResultStore(arguments.kept)
    lines = [f"{heading()}:", "", "| record | chain | structure | fit | cost | numbers | time |"]
    lines += ["| --- | --- | --- | --- | --- | --- | --- |"]
    print("\n".join(lines))
    pairs = worse = 0
    for run, chains in records(arguments.records.split(","), range(arguments.first, arguments.first + arguments.seeds)):
        for name in chains:
            # Two outputs of one record have its name.
            of = f"{run.name} {np.std(run['y']):.6g}, {name}"
            for row, line in enumerate(store.row(of, functools.partial(rows_of, run, name))["rows"]):
                pairs += row > 0
                worse += "**worse**" in line
                lines.append(line)
                print(line, flush=True)
    lines += ["", f"- {worse} of {pairs} richer structures worse by over {100 * COST_TOLERANCE:g} % of the cost"]
    print(lines[-1])
    if arguments.write:
        save(lines)


if __name__ == "__main__":
    main()
