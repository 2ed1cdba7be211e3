"""Synthetic truth for tests and benches: Plants A and A2, the three-term plant, and random plants, all from seeds."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

import ftlm
from ftlm.reproduction.simulated_arm import demo_plant

#: Cramer-Rao standard deviations at 40 dB, as printed to one to three digits.
CRAMER_RAO_40_DB = {
    "A": {
        "alpha1": 0.0008,
        "alpha2": 0.0008,
        "gamma1": 0.0002,
        "beta2": 0.0002,
        "mu2": 0.0004,
        "a1": 2.01,
        "b1": 0.159,
        "d1": 0.092,
        "g1": 0.351,
        "r1": 0.0011,
    },
    "A2": {
        "alpha3": 0.0016,
        "alpha4": 0.0012,
        "gamma3": 0.0006,
        "beta4": 0.0007,
        "mu4": 0.0009,
        "a3": 42.4,
        "b3": 7.94,
        "d3": 0.98,
        "g3": 4.61,
        "r2": 0.0072,
    },
}
THREE_TERMS = {"alpha": 2.2, "nu": 0.9, "a1": -0.625, "a0": -1.25, "b0": 1.25}


@functools.cache
def clean_run(name: str) -> ftlm.Run:
    """Point samples of a plant without noise, converged to 1e-8."""
    if name == "3T":
        rows, step = 2049, 20.0 / 2048
        t = np.arange(rows) * step
        # Half a sample of slack: sin at a multiple of its half period is a rounding error of either sign.
        u = np.sign(np.sin(2 * np.pi * (t + step / 2) / 5.0))
        truth = ftlm.Model(ftlm.equation("D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u"))
        blank = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": np.zeros(rows)}, name=name)
        return truth.simulate(blank, tolerance=1e-8)
    stage = 1 if name == "A" else 2
    rows, step = 5000, 0.002
    current = np.where((np.arange(rows) % 1000) < 500, 0.3, -0.3)
    outputs = {f"theta{stage}{i}": np.zeros(rows) for i in (1, 2)}
    blank = ftlm.Run.from_arrays(step=step, inputs={f"I{stage}": current}, outputs=outputs, name=name)
    return demo_plant(stage, form="published").simulate(blank, tolerance=1e-8)


def noisy_run(name: str, snr: float, seed: int) -> ftlm.Run:
    """White noise on every output of a plant's clean run, ``snr`` in decibel."""
    clean = clean_run(name)
    return with_noise(clean, snr, [seed, round(snr), ("A", "A2", "3T").index(name)])


def with_noise(clean: ftlm.Run, snr: float, seed: list[int]) -> ftlm.Run:
    """White noise on every output, ``snr`` in decibel."""
    rng = np.random.default_rng(seed)
    outputs = {
        n: clean[n] + np.std(clean[n]) * 10 ** (-snr / 20) * rng.standard_normal(clean.length) for n in clean.outputs
    }
    inputs = {n: clean[n] for n in clean.inputs}
    return ftlm.Run.from_arrays(step=clean.step, inputs=inputs, outputs=outputs, name=f"{clean.name} {seed}")


def structure(name: str) -> ftlm.Structure:
    """What is identified: ten numbers of a stage under both laws, or all five of the three-term plant; at rest."""
    if name == "3T":
        return replace(ftlm.equation("D^alpha y = a1 D^nu y + a0 y + b0 u"), initial="rest")
    return replace(ftlm.flexible_link(form="published", stage=1 if name == "A" else 2), initial="rest")


def truth(name: str) -> dict[str, float]:
    """True value of every free order and coefficient, orders first."""
    if name == "3T":
        return dict(THREE_TERMS)
    stage = 1 if name == "A" else 2
    model = demo_plant(stage, form="published")
    h, d = 2 * stage - 1, 2 * stage
    free = {n: model.coefficients[f"{n}{h}"] for n in "abdg"}
    values = {f"{n}{h}": v for n, v in free.items()}
    return model.orders | values | {f"r{stage}": -model.coefficients[f"a{d}"] / free["a"]}


# ------------------------------------------------------------------------------------------------ random plants


def random_plant(seed: int) -> tuple[ftlm.Model, ftlm.Structure, ftlm.Run]:
    """A stable plant of random orders, its free structure and a clean run whose input reaches the resonance.

    alpha in [0.4, 2]; order 0 and, in half of them, another own order at least 0.2 from 0 and alpha; characteristic
    frequency 0.3 to 30 rad/s, damping 0.02 to 1, gain 0.1 to 10; a pseudo-random binary, square, multisine or chirp
    input over 20 to 200 characteristic times, 2 000 to 8 000 samples.
    """
    rng = np.random.default_rng([2025, seed])
    while True:
        alpha = float(rng.uniform(0.4, 2.0))
        omega = float(np.exp(rng.uniform(np.log(0.3), np.log(30.0))))
        damping = float(np.exp(rng.uniform(np.log(0.02), 0.0)))
        gain = float(np.exp(rng.uniform(np.log(0.1), np.log(10.0))))
        terms = [("a0", 0.0, -(omega**alpha))]
        free = "D^alpha y = a0 y + b0 u"
        if rng.random() < 0.5 and alpha >= 0.6:
            nu = float(rng.uniform(0.2, alpha - 0.2))
            terms.append(("a1", nu, -2 * damping * omega ** (alpha - nu)))
            free = "D^alpha y = a1 D^nu y + a0 y + b0 u"
        rows = int(rng.integers(2000, 8001))
        times = float(np.exp(rng.uniform(np.log(20.0), np.log(200.0))))
        step = times / omega / rows
        kind = ("prbs", "square", "multisine", "chirp")[int(rng.integers(4))]
        u = _drive(kind, rows, step, omega, rng)
        words = " ".join(f"{'+' if c > 0 else '-'} {abs(c)!r} D^{o!r} y" for _, o, c in terms)
        model = ftlm.Model(ftlm.equation(f"D^{alpha!r} y = {words} + {gain * omega**alpha!r} u"))
        if not _stable(alpha, terms, omega) or not _reaches(u, step, omega):
            continue
        blank = ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": np.zeros(rows)}, name=f"plant {seed}")
        clean = model.simulate(blank, tolerance=1e-6)
        return model, replace(ftlm.equation(free), initial="rest"), clean


def random_truth(model: ftlm.Model, free: ftlm.Structure) -> dict[str, float]:
    """True values by the names of the free structure."""
    equation = model.equations[0]
    out = {"alpha": equation.order.constant}
    for term in equation.terms:
        value = float(term.coefficient) * term.factor
        if term.signal == "u":
            out["b0"] = value
        elif term.order.constant == 0:
            out["a0"] = value
        else:
            out |= {"nu": term.order.constant, "a1": value}
    return out


def _drive(kind: str, rows: int, step: float, omega: float, rng: np.random.Generator) -> np.ndarray:
    t = np.arange(rows) * step
    if kind == "prbs":
        hold = max(1, round(rng.uniform(0.5, 3.0) / omega / step))
        return np.repeat(rng.choice([-1.0, 1.0], rows // hold + 1), hold)[:rows]
    if kind == "square":
        half = max(1, round(rng.uniform(1.0, 8.0) / omega / step))
        return np.where((np.arange(rows) // half) % 2 == 0, 1.0, -1.0)
    if kind == "multisine":
        frequencies = omega * np.exp(np.linspace(np.log(0.1), np.log(5.0), 12))
        return np.sum([np.sin(f * t + p) for f, p in zip(frequencies, rng.uniform(0, 6.28, 12), strict=True)], axis=0)
    low, high, duration = 0.1 * omega, 5.0 * omega, rows * step
    return np.sin(low * t + (high - low) * t**2 / (2 * duration))


def _stable(alpha: float, terms: list[tuple[str, float, float]], omega: float) -> bool:
    """No zero of s^alpha - sum c s^nu in the right half-plane: the argument along the imaginary axis does not turn."""
    w = omega * np.exp(np.linspace(-12, 12, 4001))
    s = 1j * w
    value = s**alpha - sum(c * s**nu for _, nu, c in terms)
    turn = np.unwrap(np.angle(value))
    return bool(abs(turn[-1] - turn[0] - alpha * np.pi / 2) < 0.1)


def _reaches(u: np.ndarray, step: float, omega: float) -> bool:
    """At least 2 % of the input's power within an octave of the characteristic frequency."""
    power = np.abs(np.fft.rfft(u)) ** 2
    w = 2 * np.pi * np.fft.rfftfreq(u.size, step)
    return bool(np.sum(power[(w > omega / 2) & (w < 2 * omega)]) > 0.02 * np.sum(power[1:]))


def resonant_plant(seed: int, *, wrong: bool = False) -> ftlm.Run:
    """A random plant of the chain of orders at 40 dB, or one that no single equation is."""
    rng = np.random.default_rng([seed, int(wrong)])
    rows, step = 801, 0.02
    command = np.repeat(rng.choice([-1.0, 1.0], rows // 20 + 1), 20)[:rows]
    stiff, loss = 10 ** rng.uniform(0.3, 1.8), rng.uniform(0.05, 0.5)
    alpha, mu = rng.uniform(1.3, 2.1), rng.uniform(0.2, 1.1)
    damping = loss * stiff ** (1 - mu / alpha) * 2
    words = f"D^{alpha:.6f} y = -{damping:.6g} D^{mu:.6f} y - {stiff:.6g} y + {stiff:.6g} u"
    if wrong:
        # Another mode stands beside it, and the input comes late.
        second = f"D^2 z = -{rng.uniform(0.5, 2):.6g} D z - {6 * stiff:.6g} z + {3 * stiff:.6g} u"
        models = [ftlm.equation(words, delay={"u": 0.05}), ftlm.equation(second)]
    else:
        models = [ftlm.equation(words)]
    total = np.zeros(rows)
    for structure in models:
        name = structure.outputs[0]
        blank = ftlm.Run.from_arrays(step=step, inputs={"u": command}, outputs={name: np.zeros(rows)})
        total = total + ftlm.Model(structure).simulate(blank)[name]
    noisy = total + 0.01 * np.std(total) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(
        step=step, inputs={"u": command}, outputs={"y": noisy}, name=f"{'wrong' if wrong else 'plant'} {seed}"
    )


def written_lag(rows: int, period: float, **more: float) -> str:
    """A lag of first order under a square wave as a text file, in volts and degrees; further columns are constants."""
    t = np.arange(rows) * 0.05
    u = np.sign(np.sin(2 * np.pi * t / period))
    truth = ftlm.Model(ftlm.equation("D y = -2 y + 3 u"))
    run = truth.simulate(ftlm.Run.from_arrays(step=0.05, inputs={"u": u}, outputs={"y": 0 * t}))
    y = run["y"] + 0.01 * np.random.default_rng(1).standard_normal(rows)
    ends = "".join(f",{value:g}" for value in more.values())
    lines = [f"{a:.2f},{b:g},{c:.6f}{ends}" for a, b, c in zip(t, u, y, strict=True)]
    return "\n".join([",".join(["time [s]", "u [V]", "y [deg]", *more]), *lines])
