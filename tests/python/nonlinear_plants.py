"""Plants with non-linear terms: a fractional Duffing oscillator, drag, a radiating plate, a wind rotor."""

from dataclasses import dataclass

import numpy as np

import ftlm

ROWS = 2300
#: Signal-to-noise ratio of the measured output.
NOISE = 0.01


def switching(step, every, size, seed=1):
    """Input that switches to a uniform random value every so many seconds."""
    rows = round(every / step)
    values = np.random.default_rng(seed).uniform(-size, size, ROWS // rows + 1)
    return np.repeat(values, rows)[:ROWS]


@dataclass(frozen=True)
class Plant:
    """Structure with its true numbers, and a run without noise."""

    text: str
    truth: dict[str, float]
    step: float
    inputs: dict[str, np.ndarray]

    @property
    def structure(self):
        """Structure to identify."""
        return ftlm.equation(self.text)

    @property
    def output(self):
        """Name of the output."""
        return self.structure.outputs[0]

    def model(self):
        """True model."""
        orders = {n: v for n, v in self.truth.items() if n in self.structure.order_names}
        coefficients = {n: v for n, v in self.truth.items() if n not in orders}
        return ftlm.Model(self.structure.with_orders(orders).with_coefficients(coefficients))

    def clean(self):
        """Samples of the output in the limit for zero step."""
        blank = ftlm.Run.from_arrays(step=self.step, inputs=self.inputs, outputs={self.output: np.zeros(ROWS)})
        return self.model().simulate(blank, tolerance=1e-5)[self.output]

    def run(self, clean, seed):
        """Run with white noise."""
        noise = NOISE * np.std(clean) * np.random.default_rng(seed).standard_normal(ROWS)
        return ftlm.Run.from_arrays(
            step=self.step, inputs=self.inputs, outputs={self.output: clean + noise}, name=f"run {seed}"
        )


PLANTS = {
    "duffing": Plant(
        "D^alpha y = a D^mu y + k y + k3 y^3 + b u",
        {"alpha": 2.0, "mu": 0.6, "a": -0.6, "k": -9.0, "k3": -40.0, "b": 4.0},
        0.01,
        {"u": switching(0.01, 1.0, 3.0)},
    ),
    "drag": Plant(
        "D^2 y = a D^mu y + k y - w abs(D y)*D y + b u",
        {"mu": 1.5, "a": -0.5, "k": -9.0, "w": 0.7, "b": 4.0},
        0.01,
        {"u": switching(0.01, 1.0, 5.0)},
    ),
    "plate": Plant(
        "D y = a D^mu y + b q - e ((y + 300)^4 - 300^4)",
        {"mu": 0.5, "a": -0.2, "b": 1.0, "e": 4.0 / 300.0**4},
        0.2,
        {"q": 10.0 + switching(0.2, 20.0, 10.0)},
    ),
    "rotor": Plant(
        "D^alpha y = c u^2 - w y^2",
        {"alpha": 0.9, "c": 0.5, "w": 0.02},
        0.05,
        {"u": 8.0 + switching(0.05, 5.0, 4.0)},
    ),
}
