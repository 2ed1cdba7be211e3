"""Synthetic truth in the Euler-Lagrange form: both stages under square, sine and multisine currents, from seeds."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

import ftlm

INPUTS = ("square", "sine", "multisine")
ROWS, STEP = 5000, 0.002
#: The effective coefficients, with fractional damping in the links.
PLANTS: dict[int, tuple[dict[str, float], dict[str, float]]] = {
    1: (
        {"alpha1": 2.0, "alpha2": 2.0, "gamma1": 0.95, "beta2": 0.1, "mu2": 0.85},
        {"a1": 628.89, "b1": -62.956, "d1": 6.63, "g1": 140.47, "r": (0.0635 + 0.1704) / 0.1704},
    ),
    2: (
        {"alpha3": 2.0, "alpha4": 2.0, "gamma3": 0.9, "beta4": 0.2, "mu4": 0.8},
        {"a3": 2271.117, "b3": -496.763, "d3": 28.351, "g3": 288.122, "r": (0.00301955 + 0.0064387) / 0.0064387},
    ),
}


def truth(stage: int) -> dict[str, float]:
    """True value of every free order and coefficient; alpha of the deflection is 2 by the form."""
    orders, free = PLANTS[stage]
    orders = {n: v for n, v in orders.items() if n != f"alpha{2 * stage}"}
    return orders | {n: v for n, v in free.items() if n != "r"} | {f"j{stage}": free["r"] - 1.0}


def structure(stage: int) -> ftlm.Structure:
    """What is identified: both angles from the current alone, at rest."""
    return replace(ftlm.flexible_link(stage=stage, coupling="simulated"), initial="rest")


def model(stage: int) -> ftlm.Model:
    """The arm with everything known; the deflection's coefficients by the law, written out."""
    values, h, d = truth(stage), 2 * stage - 1, 2 * stage
    form = structure(stage)
    orders = {n: values[n] for n in form.order_names}
    ratio = values[f"j{stage}"]
    link = {f"{c}{d}": -values[f"{c}{h}"] * ratio for c in "ad"}
    return ftlm.Model(form.with_orders(orders).with_coefficients({f"{c}{h}": values[f"{c}{h}"] for c in "abdg"} | link))


def current(shape: str, rows: int = ROWS) -> np.ndarray:
    """The paper's square and sine, and ten sines from 0.1 to 8.3 Hz; held over a sample [A]."""
    t = np.arange(rows) * STEP
    if shape == "square":
        return np.where((np.arange(rows) % 1000) < 500, 0.3, -0.3)
    if shape == "sine":
        return 0.6 * np.sin(6.3 * t)
    frequencies = (0.1, 0.3, 0.5, 0.9, 1.3, 2.1, 3.1, 4.3, 6.1, 8.3)
    phases = np.random.default_rng(3).uniform(0, 2 * np.pi, len(frequencies))
    return 0.12 * np.sum([np.sin(2 * np.pi * f * t + p) for f, p in zip(frequencies, phases, strict=True)], axis=0)


@functools.cache
def clean_run(stage: int, shape: str) -> ftlm.Run:
    """Point samples without noise, converged to 1e-7."""
    blank = ftlm.Run.from_arrays(
        step=STEP,
        inputs={f"I{stage}": current(shape)},
        outputs={f"theta{stage}{k}": np.zeros(ROWS) for k in (1, 2)},
        name=shape,
    )
    return model(stage).simulate(blank, tolerance=1e-7)
