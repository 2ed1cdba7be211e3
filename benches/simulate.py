"""What a free run on a run's own samples costs, in transforms of 4096, beside SciPy's lsim for integer orders; and what
a default identification of a long run spends outside its fit.

    python benches/simulate.py runs [--write]
    python benches/simulate.py outside 50000 [--write]
"""

from __future__ import annotations

import resource
import sys
import time

import numpy as np
from scipy.signal import lsim

import ftlm
import results
from ftlm.estimation import estimators as estimate
from ftlm.estimation import identify
from ftlm.estimation import identify as offsets
from ftlm.simulation.step_refinement import simulate_refined

ROWS, STEP = 2300, 0.01
#: Words, and state space of y from u where orders are whole.
CASES = {
    "D^2 y = -4 y - 1 D y + 2 u": ([[0, 1], [-4, -1]], [[0], [2]]),
    "D^2 y = -400 y - 1 D y + 2 u": ([[0, 1], [-400, -1]], [[0], [2]]),
    "D y = -100 y + u": ([[-100]], [[1]]),
    "D^1.4 y = -4 y + 2 u": None,
    "D^2 y = -400 y - 3 D^0.5 y + 2 u": None,
    "D^1.6 y = -40 y - 3 D^0.5 y + 2 D^0.7 u": None,
    "D^0.5 y = -4 y + u": None,
}
INPUTS = {
    "steps": lambda rng, n: np.repeat(rng.standard_normal(n // 100 + 1), 100)[:n],
    "white": lambda rng, n: rng.standard_normal(n),
}


def least(work: object, times: int) -> float:
    """Least processor time of one call [s]."""
    shortest = np.inf
    for _ in range(times):
        start = time.process_time()
        work()
        shortest = min(shortest, time.process_time() - start)
    return shortest


def transform() -> float:
    """Processor time of one forward real FFT of 4096 in NumPy [s]."""
    x = np.random.default_rng(0).standard_normal(4096)
    return least(lambda: [np.fft.rfft(x) for _ in range(100)], 20) / 100


def runs() -> list[str]:
    """A line a case: FFTs of 4096, pulses a sample that it took, distance from lsim."""
    unit = transform()
    lines = [f"- one forward real FFT of 4096 (NumPy): {unit * 1e6:.1f} us of processor time; {ROWS} samples"]
    for words, space in CASES.items():
        model = ftlm.Model(ftlm.equation(words))
        for name, make_input in INPUTS.items():
            u = make_input(np.random.default_rng(0), ROWS)
            run = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": 0 * u})
            free = simulate_refined(model, run, {}, tolerance=1e-6)
            took = least(lambda model=model, run=run: model.simulate(run), 15)
            line = f"- {words}, {name}: {took / unit:.0f} FFTs ({took * 1e3:.1f} ms), {free.refinement} pulses a sample"
            if space is not None:
                a, b = (np.array(part, dtype=float) for part in space)
                c, t = np.eye(len(a))[:1], np.arange(ROWS) * STEP

                def exact(a=a, b=b, c=c, u=u, t=t) -> np.ndarray:
                    return lsim((a, b, c, [[0.0]]), u, t, interp=False)[1]

                apart = np.max(np.abs(free.outputs[0] - exact())) / np.max(np.abs(exact()))
                line += f"; lsim {least(exact, 5) / unit:.0f} FFTs, {apart:.1e} apart"
            lines.append(line)
    return lines


def outside(rows: int) -> list[str]:
    """Processor time of the parts of one default identification of a simulated run, and the peak memory."""
    rng = np.random.default_rng(0)
    u = INPUTS["steps"](rng, rows)
    structure = ftlm.equation("D^alpha y = a y + b u")
    truth = structure.with_orders({"alpha": 1.4}).with_coefficients({"a": -4.0, "b": 2.0})
    run = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": 0 * u})
    y = ftlm.Model(truth).simulate(run)["y"]
    noisy = y + 0.01 * np.std(y) * rng.standard_normal(rows)
    run = ftlm.Run.from_arrays(step=STEP, inputs={"u": u}, outputs={"y": noisy})
    took: dict[str, float] = {}

    def timed(module: object, name: str) -> None:
        work = getattr(module, name)

        def call(*args: object, **options: object) -> object:
            start = time.process_time()
            try:
                return work(*args, **options)
            finally:
                took[name] = took.get(name, 0.0) + time.process_time() - start

        setattr(module, name, call)

    parts = [
        (estimate, "fit_any_start"),
        (estimate, "with_intervals"),
        (offsets, "tested"),
        (identify, "free_runs"),
        (identify, "compared_samples"),
        (identify, "tested_residuals"),
    ]
    for module, name in parts:
        timed(module, name)
    unit, start = transform(), time.process_time()
    str(ftlm.identify(run, structure, threads=1))
    total = time.process_time() - start
    rest = total - took["fit_any_start"] - took["with_intervals"]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    times_text = ", ".join(f"{name} {value:.2f}" for name, value in took.items())
    return [
        f"- {rows} samples, three numbers: {total:.2f} s of processor time ({times_text})",
        f"- outside fit and intervals {rest:.2f} s, {rest / unit:.0f} FFTs",
        f"- FFT of 4096 beside it {unit * 1e6:.1f} us; peak of the process {peak:.0f} MB, made its own data",
    ]


def main() -> None:
    """Print what was measured; with ``--write``, keep it."""
    arguments = [a for a in sys.argv[1:] if a != "--write"]
    lines = outside(int(arguments[1])) if arguments and arguments[0] == "outside" else runs()
    print("\n".join(lines))
    if "--write" in sys.argv:
        results.append([results.heading() + ":", "", *lines])


if __name__ == "__main__":
    main()
