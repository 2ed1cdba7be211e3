"""Automatic structures beside subspace identification (nfoursid) and a fit of linear state spaces (jax-sysid).

``python benches/automatic.py [--plants known,drawn,measured] [--seeds 1] [--kept FILE]`` compares the fit of the
simulation on data that were not fitted, in percent, and the processor time. The known plants are those of
``tests/python/automatic_plants.py``, the drawn ones random ones of seed 2026, drawn after the rules of the selection
were fixed. Of ``robot_arm`` and ``heating`` the first half is for estimation, the second for validation. The other
programs use orders 1 to 6; a fit to the first three quarters, validated on the last quarter, selects the order. A
program that is not installed has no column. For ``heating``, which starts from a nonzero steady state, the other
programs get deviations from the first sample.
"""

from __future__ import annotations

import argparse
import functools
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import dlsim

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
from automatic_plants import NOISE_RATIOS, PLANTS, drawn_plants
from measured import DATA
from results import ResultStore, heading, save

#: Orders that the other programs try, and block rows of the subspace method.
ORDERS, BLOCK_ROWS = range(1, 7), 15
#: Seed of the drawn plants.
DRAWN_SEED = 2026

#: A state space (A, B, C, D) from input and output.
StateSpace = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Rival = Callable[[np.ndarray, np.ndarray, int], StateSpace]


def percent(y: np.ndarray, free: np.ndarray) -> float:
    """Fit of a simulation in percent."""
    return 100 * (1 - float(np.linalg.norm(y - free) / np.linalg.norm(y - y.mean())))


def by_subspace(u: np.ndarray, y: np.ndarray, order: int) -> StateSpace:
    """State space by nfoursid."""
    import pandas as pd  # noqa: PLC0415
    from nfoursid.nfoursid import NFourSID  # noqa: PLC0415

    method = NFourSID(
        pd.DataFrame({"u": u, "y": y}), input_columns=["u"], output_columns=["y"], num_block_rows=BLOCK_ROWS
    )
    method.subspace_identification()
    system, _ = method.system_identification(rank=order)
    return system.a, system.b, system.c, system.d


def by_state_space(u: np.ndarray, y: np.ndarray, order: int) -> StateSpace:
    """State space by jax-sysid: L-BFGS on the simulation error."""
    import jax  # noqa: PLC0415
    from jax_sysid.models import LinearModel  # noqa: PLC0415

    jax.config.update("jax_enable_x64", True)
    sizes = np.std(u), np.std(y)
    model = LinearModel(order, 1, 1, feedthrough=True)
    model.loss(rho_x0=1e-3, rho_th=1e-8)
    model.optimization(adam_epochs=0, lbfgs_epochs=1000, iprint=-1)
    model.fit(y[:, None] / sizes[1], u[:, None] / sizes[0])
    a, b, c, d = (np.asarray(m) for m in model.ssdata())
    return a, b / sizes[0], c * sizes[1], d * sizes[1] / sizes[0]


def simulate(system: StateSpace, u: np.ndarray) -> np.ndarray:
    """Simulate from rest."""
    return np.ravel(dlsim((*system, 1.0), u[:, None])[1])


def rival(method: Rival, u: np.ndarray, y: np.ndarray) -> StateSpace:
    """Fit with the order that predicts the last quarter best."""
    part = 3 * u.size // 4
    scores = {}
    for order in ORDERS:
        try:
            free = simulate(method(u[:part], y[:part], order), u)
        except (ValueError, np.linalg.LinAlgError):
            continue
        if np.all(np.isfinite(free)):
            scores[order] = float(np.sum((y - free)[part:] ** 2))
    return method(u, y, min(scores, key=lambda order: scores[order]))


RIVALS: dict[str, tuple[str, Rival]] = {
    "nfoursid": ("nfoursid", by_subspace),
    "jax-sysid": ("jax_sysid", by_state_space),
}


def compare(run: ftlm.Run, other: ftlm.Run, after: int) -> dict[str, Any]:
    """Fit of each method on the rows of another run from `after` on, and its processor time [s]."""
    row: dict[str, Any] = {}
    y, start_time = other["y"][after:], time.process_time()
    selection = ftlm.select(run, "auto", threads=1)
    row["ftlm"] = [0.0, time.process_time() - start_time]
    row["ftlm"][0] = percent(y, ftlm.compare(selection.best.model, other).simulated["y"][0][after:])
    row["chosen"] = selection.winner.name
    u0, y0 = (float(run[n][0]) for n in "uy") if run.name == "heating" else (0.0, 0.0)
    for name, (package, method) in RIVALS.items():
        if find_spec(package) is None:
            continue
        start_time = time.process_time()
        system = rival(method, run["u"] - u0, run["y"] - y0)
        seconds = time.process_time() - start_time
        row[name] = [percent(y, y0 + simulate(system, other["u"] - u0)[after:]), seconds]
    return row


def measurement(name: str) -> tuple[ftlm.Run, ftlm.Run, int]:
    """First half of a measured record, all of it, and the row from which it is judged."""
    if name == "robot_arm":
        table = np.loadtxt(DATA / "robot_arm" / "robot_arm.dat")
        step, u, y = 1.0, table[:, 0], table[:, 1]
    else:
        table = np.loadtxt(DATA / "heating" / "heating_system.dat")
        step, u, y = 2.0, table[:, 1], table[:, 2]
    half = y.size // 2
    return (
        ftlm.Run.from_arrays(step=step, inputs={"u": u[:half]}, outputs={"y": y[:half]}, name=name),
        ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, name=name),
        half,
    )


def cases(groups: list[str], seeds: int) -> Iterator[tuple[str, str, Callable[[], dict[str, Any]]]]:
    """Groups and names of records, and what measures them."""
    for group, plants in {"known": PLANTS, "drawn": drawn_plants(12, DRAWN_SEED)}.items():
        for name, plant in plants.items() if group in groups else ():
            for seed in range(seeds):
                noise = NOISE_RATIOS[seed % len(NOISE_RATIOS)]
                run = plant.run(5000 + seed, noise=noise, name=name)
                other = plant.run(6000 + seed, noise=0.0, name=f"{name}, unseen")
                yield f"{group} plants", f"{name}, seed {seed}", functools.partial(compare, run, other, 0)
    for name in ("robot_arm", "heating") if "measured" in groups else ():
        yield name, name, functools.partial(compare, *measurement(name))


def summarize(rows: list[list[float]]) -> str:
    """Median and least fit, and median processor time."""
    if not rows:
        return ""
    fits, seconds = zip(*rows, strict=True)
    return f"median {np.median(fits):.2f} %, least {min(fits):.2f} %, {np.median(seconds):.1f} s"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plants", default="known,drawn,measured")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--kept", type=Path, help="file of records that are done, to go on from")
    parser.add_argument("--write", action="store_true", help="write benches/results.json")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    store, methods = ResultStore(arguments.kept), ["ftlm", *RIVALS]
    lines = [heading(), "", "| record | " + " | ".join(methods) + " |", "|" + " --- |" * (1 + len(methods))]
    print("\n".join(lines), flush=True)
    groups: dict[str, list[dict[str, Any]]] = {}
    for group, name, measure in cases(arguments.plants.split(","), arguments.seeds):
        row = store.row(name, measure)
        groups.setdefault(group, []).append(row)
        cells = [f"{row[m][0]:.2f} %, {row[m][1]:.1f} s" if m in row else "" for m in methods]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    summary = ["", "| group | " + " | ".join(methods) + " |", "|" + " --- |" * (1 + len(methods))]
    for group, rows in groups.items():
        cells = [summarize([row[m] for row in rows if m in row]) for m in methods]
        summary.append(f"| {group} | " + " | ".join(cells) + " |")
    print("\n".join(summary))
    if arguments.write:
        save([*summary, *lines])


if __name__ == "__main__":
    main()
