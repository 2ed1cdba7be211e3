"""Estimates do not depend on the order of the terms of an equation, of the runs, or of the inputs of a run."""

import numpy as np
import pytest

import ftlm

TERMS = ["a D^beta y", "b y", "c u", "d D^mu v"]


@pytest.fixture(scope="module")
def runs():
    """Two records of one plant with two inputs."""
    model = ftlm.Model(ftlm.equation("D^1.6 y = -1.2 D^0.6 y - 4 y + 3 u + 1.5 D^0.5 v", initial="rest"))
    made = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        inputs = {"u": np.repeat(rng.choice([-1.0, 1.0], 50), 8), "v": np.repeat(rng.normal(size=50), 8)}
        run = ftlm.Run.from_arrays(step=0.05, inputs=inputs, outputs={"y": np.zeros(400)}, name=f"run {seed}")
        run = model.simulate(run)
        made.append(run.with_outputs({"y": run["y"] + 0.02 * rng.standard_normal(400)}))
    return made


def estimate(runs, terms=TERMS):
    result = ftlm.identify(runs, ftlm.equation("D^alpha y = " + " + ".join(terms), initial="rest"))
    return {**result.orders, **result.coefficients}


def test_terms_runs_and_inputs_in_another_order_have_the_same_estimates(runs):
    expected = pytest.approx(estimate(runs), rel=1e-6)
    assert estimate(runs, TERMS[::-1]) == expected
    assert estimate(runs[::-1]) == expected
    exchanged = [
        ftlm.Run.from_arrays(step=r.step, inputs={"v": r["v"], "u": r["u"]}, outputs={"y": r["y"]}, name=r.name)
        for r in runs
    ]
    assert estimate(exchanged) == expected


def modes(seed, samples=800):
    """Record of three modes at rest, with noise at 30 dB: its best fit is one of several optima."""
    rng = np.random.default_rng(seed)
    frequencies = np.sort(np.exp(rng.uniform(np.log(0.6), np.log(8.0), 3)))
    step = 2 * np.pi / frequencies.max() / 12
    u = np.repeat(rng.choice([-1.0, 1.0], samples // 5), 5)
    time, impulse = np.arange(samples) * step, np.zeros(samples)
    for w in frequencies:
        impulse += rng.normal() * w * np.exp(-rng.uniform(0.02, 0.5) * w * time) * np.sin(w * time)
    y = step * np.convolve(u, impulse)[:samples]
    y += y.std() * 10**-1.5 * rng.standard_normal(samples)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y})


@pytest.mark.parametrize("seed", [1, 2])
def test_many_terms_in_another_order_end_in_the_same_optimum(seed):
    terms = [f"{name}{k} D^{k} {signal}" for name, signal in (("a", "y"), ("b", "u")) for k in range(6)]
    run, method, fits = modes(seed), ftlm.OutputError(intervals="quadratic"), []
    for written in (terms, terms[::-1]):
        structure = ftlm.equation("D^6 y = " + " + ".join(written), initial="rest")
        fits.append(ftlm.identify(run, structure, method=method).fit["y"])
    assert fits == pytest.approx([fits[0]] * 2, abs=1e-9)
