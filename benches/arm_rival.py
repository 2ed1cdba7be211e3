"""What a user would pick instead: a linear state-space model of jax-sysid, same runs, same inputs, same table.

Used by ``python benches/arm.py rival``; jax-sysid is no dependency of ftlm.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import ftlm
from state_space import ABSENT, SEEDS, LinearModel, Scale, best, fit_percent, train

ORDERS = (2, 4, 6)


def rows(runs: dict[str, ftlm.Run], uses: dict[str, tuple[str, ...]]) -> Iterator[tuple[str, ...]]:
    """Rows of output, order, numbers, runs fitted, fits, processor time; uses are the outputs with their inputs.

    Signals are standardised by the runs fitted. The initial state is the judged run's own, as an initial term is.
    """
    if LinearModel is None:
        yield (ABSENT,)
        return
    for output, inputs in uses.items():
        all_of = {n: signals(run, output, inputs) for n, run in runs.items()}
        for order in ORDERS:
            for names in (("psf",), ("lqr",), ("psf", "lqr")):
                start_time = time.process_time()
                scale = Scale.of([all_of[n] for n in names])
                training = [scale.scaled(all_of[n]) for n in names]
                model = best([train(training, order, seed) for seed in range(SEEDS)])
                if model is None:
                    yield output, str(order), "", "+".join(names), "no start has a finite free run", ""
                    continue
                fits = {n: fit_percent(model, scale, run) for n, run in all_of.items()}
                fits_text = [f"{fit:.1f}" if n in names else f"**{fit:.1f}**" for n, fit in fits.items()]
                count = order * order + order * (len(inputs) + 1) + len(inputs)
                time_text = f"{time.process_time() - start_time:.0f} s"
                yield output, str(order), str(count), "+".join(names), ", ".join(fits_text), time_text


def signals(run: ftlm.Run, output: str, inputs: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Output and inputs as columns."""
    return run[output][:, None], np.stack([run[n] for n in inputs], axis=1)
