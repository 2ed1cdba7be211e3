"""A linear state-space model of jax-sysid fitted to some runs and judged on others, in an environment of its own.

``PYTHON benches/state_space.py FILE psf+lqr`` reads runs from a NumPy archive (``NAME.y``, a column; ``NAME.u``, a
column an input), fits the named ones together and prints JSON: fits of free runs by name, processor time of each start,
and of one with a single step of each optimiser, which is what setting up and compiling take: each fit compiles anew.
Imports nothing of ftlm, which does not need jax-sysid: ``pip install jax-sysid==1.1`` in an environment of its own.
To be run without ``XLA_FLAGS``: with ``--xla_cpu_multi_thread_eigen=false`` the fits of jaxlib 0.4.31 come out lower.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

try:
    import jax
    from jax_sysid.models import LinearModel
    from jax_sysid.utils import standard_scale, unscale
except ImportError:
    LinearModel = None

#: What the words say where it is absent.
ABSENT = "jax-sysid is not here, so nothing was set beside: pip install jax-sysid==1.1, in an environment of its own"
#: Random starts, of which the one that fits best is kept, and steps of both optimisers.
SEEDS = 3
ADAM, LBFGS = 300, 1000

Result = TypeVar("Result")
#: Output and inputs as columns.
Signals = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Scale:
    """Means and gains of the signals fitted, which standardise those judged as well."""

    y: tuple[Any, Any]
    u: tuple[Any, Any]

    @classmethod
    def of(cls, training: Sequence[Signals]) -> Scale:
        """Of all samples fitted."""
        _, *y = standard_scale(np.concatenate([y for y, _ in training]))
        _, *u = standard_scale(np.concatenate([u for _, u in training]))
        return cls((y[0], y[1]), (u[0], u[1]))

    def scaled(self, signals: Signals) -> Signals:
        """Standardised."""
        y, u = signals
        return (y - self.y[0]) * self.y[1], (u - self.u[0]) * self.u[1]


def train(
    training: Sequence[Signals], order: int, seed: int, steps: tuple[int, int] = (ADAM, LBFGS)
) -> tuple[Any, float]:
    """A model of standardised signals from one random start, and what its free runs leave."""
    model = LinearModel(order, 1, training[0][1].shape[1], feedthrough=True)
    model.loss(rho_x0=1e-4, rho_th=1e-6)
    model.optimization(adam_epochs=steps[0], lbfgs_epochs=steps[1], iprint=-1)
    model.init(seed=seed)
    model.fit([y for y, _ in training], [u for _, u in training])
    starts = model.x0 if len(training) > 1 else [model.x0]
    loss = sum(
        float(np.sum((np.asarray(model.predict(x, u)[0]) - y) ** 2)) for x, (y, u) in zip(starts, training, strict=True)
    )
    return model, loss


def fit_percent(model: Any, scale: Scale, run: Signals) -> float:
    """Fit in percent of the free run; the initial state is the judged run's own, as an initial term is."""
    y, u = scale.scaled(run)
    state = model.learn_x0(u, y, rho_x0=1e-8, RTS_epochs=1, verbosity=0)
    ahead = unscale(np.asarray(model.predict(state, u)[0]), *scale.y)
    return 100.0 * (1.0 - float(np.linalg.norm(ahead - run[0]) / np.linalg.norm(run[0] - run[0].mean())))


def best(ends: Sequence[tuple[Any, float]]) -> Any:
    """The model of the start that leaves least, or none where no start has a finite free run."""
    finite = [end for end in ends if np.isfinite(end[1])]
    return min(finite, key=lambda end: end[1])[0] if finite else None


def processor_time(work: Callable[[], Result]) -> tuple[float, Result]:
    """Processor time of all threads, and what came of it."""
    start_time = time.process_time()
    result = work()
    return time.process_time() - start_time, result


def measurement(runs: dict[str, Signals], names: Sequence[str], order: int, seeds: int) -> dict[str, Any]:
    """One set of runs fitted, judged on all."""
    before = peak()
    scale = Scale.of([runs[n] for n in names])
    training = [scale.scaled(runs[n]) for n in names]
    first, *others = (processor_time(lambda seed=seed: train(training, order, seed)) for seed in range(seeds))
    setting_up, _ = processor_time(lambda: train(training, order, 0, (1, 1)))
    fits = {}
    for name, ends in (("one", [first[1]]), ("best", [end for _, end in (first, *others)])):
        model = best(ends)
        fits[name] = {} if model is None else {n: fit_percent(model, scale, run) for n, run in runs.items()}
    inputs = training[0][1].shape[1]
    return {
        "used": list(names),
        "fits": fits,
        "seconds": [s for s, _ in (first, *others)],
        "setting_up": setting_up,
        "numbers": order * order + order * (inputs + 1) + inputs,
        "before": before,
        "peak": peak(),
    }


def peak() -> float:
    """Most memory that this process held [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file")
    parser.add_argument("used", help="names of runs fitted together, joined by +")
    parser.add_argument("--order", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    arguments = parser.parse_args()
    if LinearModel is None:
        print(json.dumps({"absent": ABSENT}))
        return
    jax.config.update("jax_enable_x64", True)
    with np.load(arguments.file) as arrays:
        runs = {
            n.removesuffix(".y"): (arrays[n], arrays[n.removesuffix("y") + "u"]) for n in arrays.files if n[-2:] == ".y"
        }
    answer = measurement(runs, arguments.used.split("+"), arguments.order, arguments.seeds)
    # What jax-sysid prints comes before.
    print(json.dumps(answer))


if __name__ == "__main__":
    main()
