"""A body that sticks, measured: recovery with intervals, cost of a free run, hubs of real arms.

``python benches/friction.py recovery [--seeds 20]``, ``stribeck [--seeds 20]``, ``speed``, ``measured``,
``measured-stribeck``, ``coupled [--seeds 20]``, ``coupled-measured``, ``two [--seeds 20]``. Truth of the recovery is a
cart in closed form between its events (tests/python/friction.py) with offsets a run, that of ``stribeck`` a sledge on a
spring that sticks and slips, that of ``coupled`` a hub that sticks with a link that rings, both followed from the
current alone, that of ``two`` two bodies that both stick (tests/python/test_two_frictions.py); real runs are those of
``FTLM_DATA``.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import ftlm
from ftlm import _core

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import friction
import test_two_frictions as two_frictions
from measured import DATA

CART = "D^2 y = - v D y + g u - fc*sign(D y) + c"
TRUTH = {"v": 1.0, "g": 1.0, "fc": 0.8, "alpha": 2.0}
HUB = "D^2 theta11 = - v D theta11 + g {current} + k theta12{rubs} + c"
RUBS = " - fc*sign(D theta11)"
FALLS = " - fs*exp(-(D theta11/vs)^2)*sign(D theta11)"
SLEDGE = "D^2 y = - v D y - k y + g u - fc*sign(D y) - fs*exp(-(D y/vs)^2)*sign(D y)"
STICKS = {"v": 0.5, "k": 4.0, "g": 4.0, "fc": 0.5, "fs": 0.5, "vs": 0.2}
#: A hub with a link: both from what drives the hub.
ARM = "D^2 x = a q + d D q - b D x + g u - fc*sign(D x); D^2 q = - 1 D^2 x - k q - e D q"
ARM_TRUTH = {"a": 30.0, "d": 0.4, "b": 1.5, "g": 1.0, "fc": 4.0, "k": 90.0, "e": 1.2}
#: Steps that are fitted; the amplifier of the arm clips its command at a limit that the fit is left to find.
ESTIMATION_STEPS = ("30", "20", "minus10", "minus20")
VALIDATION_STEPS = ("10", "minus30", "0_return", "5", "minus5")
SATURATION_STEPS = ("30", "20", "minus10", "minus30")
SATURATES = "sat(I1, 0.3:3)"


def cart(seed: int, noise: float, rows: int = 801) -> ftlm.Run:
    """A cart under two sinusoids of held values, with an offset of its own."""
    rng = np.random.default_rng(seed)
    step, offset = 0.0125, rng.uniform(-0.2, 0.2)
    times, phases = np.arange(rows) * step, rng.uniform(0.0, 2.0 * np.pi, 2)
    force = 1.6 * np.sin(2.2 * times + phases[0]) + 0.8 * np.sin(5.1 * times + phases[1])
    y, _ = friction.exact_cart(force + offset, step, 1.0, 0.8, 0.3, 0.0)
    y += noise * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": force}, outputs={"y": y}, name=f"cart {seed}")


def recovery(seeds: int) -> None:
    """Coverage of 95 % intervals, order fixed and free, two runs a fit."""
    free = CART.replace("D^2", "D^alpha")
    for words, orders in ((CART, {}), (free, {"alpha": (1.5, 2.0, 0.1)})):
        structure = ftlm.equation(words, initial="caputo", orders=orders)
        names = (*orders, "v", "g", "fc")
        for noise in (0.002, 0.02):
            scores, times = [], []
            for seed in range(seeds):
                start_time = time.process_time()
                result = ftlm.identify([cart(2 * seed, noise), cart(2 * seed + 1, noise)], structure, threads=1)
                times.append(time.process_time() - start_time)
                values = {**result.orders, **result.coefficients}
                scores.append([(values[n] - TRUTH[n]) / result.standard_errors[n] for n in names])
            z = np.array(scores)
            inside = ", ".join(f"{n} {c}" for n, c in zip(names, np.sum(np.abs(z) < 1.96, axis=0), strict=True))
            mean = ", ".join(f"{v:+.2f}" for v in z.mean(axis=0))
            order = "free" if orders else "2"
            print(
                f"| {order} | {noise:g} | {inside} of {seeds} | {mean} | {np.abs(z).max():.2f} | "
                f"{statistics.median(times):.2g} |",
                flush=True,
            )


def sledge(seed: int, noise: float, rows: int = 601) -> ftlm.Run:
    """A sledge on a spring that two slow sinusoids pull, between its events."""
    rng = np.random.default_rng(seed)
    times, phases = np.arange(rows) * 0.02, rng.uniform(0.0, 2.0 * np.pi, 2)

    def pulled(t: Any) -> Any:
        return 0.9 * np.sin(0.9 * t + phases[0]) + 0.35 * np.sin(2.3 * t + phases[1])

    y, _ = friction.between_events(lambda t: 4.0 * pulled(t), times, 0.5, 0.5, more=0.5, speed=0.2, spring=4.0)
    y += noise * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(
        step=0.02, inputs={"u": pulled(times)}, outputs={"y": y}, intersample={"u": "foh"}, name=f"sledge {seed}"
    )


def covered(
    structure: ftlm.Structure, records: Iterable[list[ftlm.Run]], truth: dict[str, float]
) -> tuple[np.ndarray, str, list[float]]:
    """Scores of fits to each of some records, how many intervals hold the truth, and processor time of each."""
    scores, inside, times = [], [], []
    for runs in records:
        start_time = time.process_time()
        result = ftlm.identify(runs, structure, threads=1)
        times.append(time.process_time() - start_time)
        scores.append([(result.coefficients[n] - v) / result.standard_errors[n] for n, v in truth.items()])
        inside.append([result.intervals[n][0] <= v <= result.intervals[n][1] for n, v in truth.items()])
    counts = ", ".join(f"{n} {c}" for n, c in zip(truth, np.sum(inside, axis=0), strict=True))
    return np.array(scores), counts, times


def stribeck(seeds: int) -> None:
    """Coverage of 95 % intervals of a body that sticks and slips, a run a fit."""
    structure = ftlm.equation(SLEDGE, initial="rest")
    for noise in (0.002, 0.005, 0.02):
        z, counts, times = covered(structure, ([sledge(seed, noise)] for seed in range(seeds)), STICKS)
        mean = ", ".join(f"{v:+.2f}" for v in z.mean(axis=0))
        print(
            f"| {noise:g} | {counts} of {seeds} | {mean} | {np.abs(z).max():.2f} | {statistics.median(times):.2g} |",
            flush=True,
        )


def arm(seed: int, noise: float, *, offset: float = 0.0, start: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)) -> ftlm.Run:
    """A hub on dry friction that carries a link, between its events."""
    rng = np.random.default_rng(seed)
    times, phases = np.arange(601) * 0.01, rng.uniform(0.0, 2.0 * np.pi, 2)

    def pulled(t: Any) -> Any:
        return 6.0 * np.sin(2.1 * t + phases[0]) + 3.0 * np.sin(5.3 * t + phases[1])

    angles, _ = friction.hub_and_link(
        lambda t: pulled(t) + offset, times, (30.0, 0.4, -1.5), (90.0, 1.2), 4.0, start=start
    )
    angles += noise * np.std(angles, axis=1)[:, None] * rng.standard_normal(angles.shape)
    return ftlm.Run.from_arrays(
        step=0.01,
        inputs={"u": pulled(times)},
        outputs={"x": angles[0], "q": angles[1]},
        intersample={"u": "foh"},
        name=f"arm {seed}",
    )


def coupled(seeds: int) -> None:
    """Coverage of 95 % intervals of a hub that sticks and its link: one run from rest, two in motion with offsets."""
    for noise, moving in ((0.003, False), (0.02, False), (0.003, True)):
        more = {"initial": "caputo", "offset": "constant"} if moving else {"initial": "rest"}
        pairs = ((0.5, (0.2, 0.8, 0.02, -0.1)), (-0.3, (0.0, 0.0, 0.03, 0.0)))
        moving_runs = (
            [arm(2 * seed + k, noise, offset=o, start=s) for k, (o, s) in enumerate(pairs)] for seed in range(seeds)
        )
        still = ([arm(seed, noise)] for seed in range(seeds))
        z, counts, times = covered(ftlm.equation(ARM, **more), moving_runs if moving else still, ARM_TRUTH)
        kind = "two runs in motion, offsets" if moving else "one run from rest"
        print(
            f"| {noise:g} | {kind} | {counts} of {seeds} | {np.abs(z).max():.2f} | {statistics.median(times):.2g} |",
            flush=True,
        )


def two(seeds: int) -> None:
    """Coverage of 95 % intervals of two bodies that pull at each other and both stick, a run a fit."""
    truth = {**two_frictions.TRUTH, **two_frictions.STRENGTH}
    for start in ((0.0,) * 4, (0.2, 0.8, -0.1, -0.6)):
        structure = ftlm.equation(two_frictions.WORDS, initial="caputo" if any(start) else "rest")
        z, counts, times = covered(structure, ([two_frictions.noisy(seed, start)] for seed in range(seeds)), truth)
        kind = "in motion" if any(start) else "from rest"
        print(f"| {kind} | {counts} of {seeds} | {np.abs(z).max():.2f} | {statistics.median(times):.2g} |", flush=True)


def coupled_measured() -> None:
    """Hub and link of the real arm from the current alone, with friction and without, fitted on one unit."""
    runs = {
        "psf": run_of(DATA / "two_link_psf" / "psf.csv", "Im1_meas_A", name="psf", window=(1.1, 19.5)),
        "lqr": run_of(DATA / "two_link_lqr" / "lqr.csv", "Im1_meas_A", name="lqr"),
    }
    whole = {"alpha1": 2.0, "gamma1": 1.0, "beta2": 0.0, "mu2": 1.0}
    for rubs in (False, True):
        arm1 = ftlm.flexible_link(coupling="simulated", friction=rubs, offset="constant").with_orders(whole)
        print_fit(replace(arm1, initial="caputo"), [runs["psf"]], runs)


def speed() -> None:
    """A free run of order 1.8 with friction, at one strength and falling, beside the linear one."""
    rng = np.random.default_rng(0)
    equation = (0, 1.8, [(0, 0.9), (1, 0.0)])
    for m in (1 << 11, 1 << 14, 1 << 17):
        record = (1e-3, np.stack([np.zeros(m), rng.normal(size=m)]), None)
        rubs = timed(partial(_core.friction_respond, record, [(equation, [-3.0, 1.0])], [(0, (0.5, 0.0, 1.0))], [[]]))
        falls = timed(partial(_core.friction_respond, record, [(equation, [-3.0, 1.0])], [(0, (0.5, 0.3, 0.01))], [[]]))
        plain = timed(partial(_core.respond, record, [(equation, [-3.0, 1.0])], [False, True], [[]]))
        print(f"| {m} | {1e3 * rubs:.1f} | {rubs / plain:.1f} | {falls / plain:.1f} |", flush=True)


def timed(work: Any) -> float:
    """Median of five [s of processor time]."""
    times = []
    for _ in range(5):
        start_time = time.process_time()
        work()
        times.append(time.process_time() - start_time)
    return statistics.median(times)


def run_of(path: Path, current: str, *, name: str, **options: Any) -> ftlm.Run:
    """A run of the arm at 8 ms, angles in rad."""
    run = ftlm.load(
        path,
        time="t_s",
        inputs={"I1": current},
        outputs={"theta11": "th11_deg", "theta12": "th12_deg"},
        units={"theta11": "deg", "theta12": "deg"},
        **options,
    )
    return ftlm.Run.from_arrays(
        step=4 * run.step,
        inputs={"I1": run["I1"][::4]},
        outputs={n: run[n][::4] for n in ("theta11", "theta12")},
        name=name,
    )


def measurements() -> None:
    """Hubs of the real arm, from the current and the measured deflection."""
    runs = {
        "psf": run_of(DATA / "two_link_psf" / "psf.csv", "Im1_meas_A", name="psf", window=(1.1, 19.5)),
        "lqr": run_of(DATA / "two_link_lqr" / "lqr.csv", "Im1_meas_A", name="lqr"),
    }
    for words in ("", RUBS):
        structure = ftlm.equation(HUB.format(current="I1", rubs=words), initial="caputo")
        for run in runs.values():
            print_fit(structure, [run], runs)
    steps = {
        n: run_of(DATA / "two_link_steps" / f"lqr_{n}.csv", "Im1_cmd_A", name=n)
        for n in (*ESTIMATION_STEPS, *VALIDATION_STEPS)
    }
    # In the first four the command stays below what the amplifier gives; the limit is seen in the step of -30 degrees.
    for names, current in ((ESTIMATION_STEPS, "I1"), (SATURATION_STEPS, "I1"), (SATURATION_STEPS, SATURATES)):
        for words in ("", RUBS):
            print_fit(
                ftlm.equation(HUB.format(current=current, rubs=words), initial="caputo"),
                [steps[n] for n in names],
                steps,
            )


def measured_stribeck() -> None:
    """The same hubs with friction that falls with speed, beside friction that does not."""
    runs = {
        "psf": run_of(DATA / "two_link_psf" / "psf.csv", "Im1_meas_A", name="psf", window=(1.1, 19.5)),
        "lqr": run_of(DATA / "two_link_lqr" / "lqr.csv", "Im1_meas_A", name="lqr"),
    }
    for words in (RUBS, RUBS + FALLS):
        for run in runs.values():
            print_fit(ftlm.equation(HUB.format(current="I1", rubs=words), initial="caputo"), [run], runs)
    steps = {
        n: run_of(DATA / "two_link_steps" / f"lqr_{n}.csv", "Im1_cmd_A", name=n)
        for n in (*ESTIMATION_STEPS, *VALIDATION_STEPS)
    }
    for words in (RUBS, RUBS + FALLS):
        print_fit(
            ftlm.equation(HUB.format(current=SATURATES, rubs=words), initial="caputo"),
            [steps[n] for n in SATURATION_STEPS],
            steps,
        )


def print_fit(structure: ftlm.Structure, estimation: list[ftlm.Run], runs: dict[str, ftlm.Run]) -> None:
    """Fit, print numbers with standard errors, and judge on every run."""
    start_time = time.process_time()
    result = ftlm.identify(estimation, structure, threads=1)
    seconds = time.process_time() - start_time
    values = {n: v for n, v in {**result.coefficients, **result.limits}.items() if n in result.standard_errors}
    numbers = ", ".join(f"{n} {v:.4g} ± {result.standard_errors[n]:.2g}" for n, v in values.items())
    names = {run.name for run in estimation}
    print(f"{structure}: {numbers}; {seconds:.2g} s", flush=True)
    for warning in result.warnings:
        print(f"    ! {warning}", flush=True)
    for name, run in runs.items():
        there = result.model.compare(run)
        fits = ", ".join(f"{n} {v:.2f}" for n, v in there.fit.items())
        print(
            f"    {name} {'fitted' if name in names else 'judged'}: {fits}, "
            f"offset {there.offsets[0]['theta11']['constant']:+.3f}",
            flush=True,
        )


WHAT = ("recovery", "stribeck", "speed", "measured", "measured-stribeck", "coupled", "coupled-measured", "two")


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=WHAT)
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    {
        "recovery": lambda: recovery(arguments.seeds),
        "stribeck": lambda: stribeck(arguments.seeds),
        "speed": speed,
        "measured": measurements,
        "measured-stribeck": measured_stribeck,
        "coupled": lambda: coupled(arguments.seeds),
        "coupled-measured": coupled_measured,
        "two": lambda: two(arguments.seeds),
    }[arguments.what]()


if __name__ == "__main__":
    main()
