"""Draws the pictures of the pages from seeded runs, so that they are always what this version does."""

import sys
from pathlib import Path

import numpy as np

import ftlm


def example(name: str, kind: str, seed: int) -> ftlm.Run:
    """The tutorial's machine: a fractional oscillator with 1 % noise."""
    t = np.arange(2001) * 0.01
    u = np.sign(np.sin(2 * np.pi * t / 5 + 1e-9)) if kind == "square" else np.sin(0.2 * t**1.6)
    truth = ftlm.Model(ftlm.equation("D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u"))
    clean = truth.simulate(ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": 0 * t}, name=name))
    noise = 0.01 * np.std(clean["y"]) * np.random.default_rng(seed).standard_normal(t.size)
    return ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": clean["y"] + noise}, name=name)


def draw(folder: Path) -> None:
    """Write every picture."""
    folder.mkdir(exist_ok=True)
    square, chirp = example("square", "square", 1), example("chirp", "chirp", 2)
    structure = ftlm.equation(
        "D^alpha y = a1 D^nu y + a0 y + b0 u", orders={"alpha": "1.4:2:0.05", "nu": "0.2:1.2:0.05"}
    )
    best = ftlm.identify(square, ftlm.equation("D^alpha y = a1 D^nu y + a0 y + b0 u"))
    searched = ftlm.identify(square, structure, method="multi-innovation")
    drawn = {
        "fit": ftlm.plot.fit(best.model, chirp),
        "residuals": ftlm.plot.residuals(best),
        "bode": ftlm.plot.bode(best),
        "landscape": ftlm.plot.landscape(searched),
    }
    for name, figure in drawn.items():
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("pictures"))
