"""What a user would pick instead: a linear state-space model of jax-sysid, same runs, same inputs, same table.

Used by ``python benches/arm.py rival``; jax-sysid is no dependency of ftlm.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import ftlm

try:
    import jax
    from jax_sysid.models import LinearModel
    from jax_sysid.utils import standard_scale, unscale
except ImportError:
    LinearModel = None

#: What the words say where it is absent.
ABSENT = "jax-sysid is not here, so nothing was set beside: pip install jax-sysid==1.1, in an environment of its own"
ORDERS = (2, 4, 6)
#: Random starts, of which the one that fits best is kept, and steps of both optimisers.
SEEDS = 3
ADAM, LBFGS = 300, 1000


def rows(runs: dict[str, ftlm.Run], uses: dict[str, tuple[str, ...]]) -> Iterator[tuple[str, ...]]:
    """Rows of output, order, numbers, runs fitted, fits, processor time; uses are the outputs with their inputs.

    Signals are standardised by the runs fitted. The initial state is the judged run's own, as an initial term is.
    """
    if LinearModel is None:
        yield (ABSENT,)
        return
    jax.config.update("jax_enable_x64", True)
    for output, inputs in uses.items():
        for order in ORDERS:
            for used in (("psf",), ("lqr",), ("psf", "lqr")):
                begun = time.process_time()
                seen = [signals(runs[n], output, inputs) for n in used]
                _, y_mean, y_gain = standard_scale(np.concatenate([y for y, _ in seen]))
                _, u_mean, u_gain = standard_scale(np.concatenate([u for _, u in seen]))
                scaled = [((y - y_mean) * y_gain, (u - u_mean) * u_gain) for y, u in seen]
                best, least = None, np.inf
                for seed in range(SEEDS):
                    model = LinearModel(order, 1, len(inputs), feedthrough=True)
                    model.loss(rho_x0=1e-4, rho_th=1e-6)
                    model.optimization(adam_epochs=ADAM, lbfgs_epochs=LBFGS, iprint=-1)
                    model.init(seed=seed)
                    model.fit([y for y, _ in scaled], [u for _, u in scaled])
                    starts = model.x0 if len(scaled) > 1 else [model.x0]
                    left = sum(
                        float(np.sum((np.asarray(model.predict(x, u)[0]) - y) ** 2))
                        for x, (y, u) in zip(starts, scaled, strict=True)
                    )
                    if left < least:
                        best, least = model, left
                if best is None:
                    yield output, str(order), "", "+".join(used), "no start has a finite free run", ""
                    continue
                told = []
                for name, run in runs.items():
                    y, u = signals(run, output, inputs)
                    u = (u - u_mean) * u_gain
                    state = best.learn_x0(u, (y - y_mean) * y_gain, rho_x0=1e-8, RTS_epochs=1, verbosity=0)
                    ahead = unscale(np.asarray(best.predict(state, u)[0]), y_mean, y_gain)
                    fit = 100.0 * (1.0 - np.linalg.norm(ahead - y) / np.linalg.norm(y - y.mean()))
                    told.append(f"{fit:.1f}" if name in used else f"**{fit:.1f}**")
                count = order * order + order * (len(inputs) + 1) + len(inputs)
                taken = f"{time.process_time() - begun:.0f} s"
                yield output, str(order), str(count), "+".join(used), ", ".join(told), taken


def signals(run: ftlm.Run, output: str, inputs: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Output and inputs as columns."""
    return run[output][:, None], np.stack([run[n] for n in inputs], axis=1)
