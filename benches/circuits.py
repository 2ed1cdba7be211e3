"""A circuit fitted to the example spectrum of impedance.py, by ftlm and by impedance.py.

``python benches/circuits.py exampleData.csv`` (github.com/ECSHackWeek/impedance.py, folder data: frequency [Hz], real
and imaginary part [Ω]) uses the package that its environment has: ftlm from automatic initial guesses, or impedance.py
1.7.1 from the initial guess of its documentation. Both minimize the absolute errors of the spectrum below the axis.
"""

from __future__ import annotations

import sys
import time

import numpy as np

CIRCUIT = "R0-p(R1,C1)-p(R2-Wo1,C2)"
#: Initial guess of impedance.py's documentation, in the sequence of its parameters.
DOCUMENTED_GUESS = (0.01, 0.01, 100, 0.01, 0.05, 100, 1)


def spectrum(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [Hz] and impedances [Ω] with a negative imaginary part."""
    frequency, real, imaginary = np.loadtxt(path, delimiter=",").T
    is_below = imaginary < 0
    return frequency[is_below], (real + 1j * imaginary)[is_below]


def by_ftlm(frequency: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the impedance of the circuit that ftlm identifies."""
    import ftlm  # noqa: PLC0415

    data = ftlm.FrequencyData.from_arrays(frequency, z, frequency_unit="Hz", unit="Ω", output="U", input="I")
    found = ftlm.identify_frequency(data, ftlm.Circuit(CIRCUIT), weights="uniform")
    assert found.circuit is not None
    return np.ravel(found.circuit.impedance(2 * np.pi * frequency))


def by_impedance_py(frequency: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the impedance of the circuit that impedance.py fits."""
    from impedance.models.circuits import CustomCircuit  # noqa: PLC0415

    return np.asarray(CustomCircuit(CIRCUIT, initial_guess=list(DOCUMENTED_GUESS)).fit(frequency, z).predict(frequency))


def main() -> None:
    """Measure and print."""
    frequency, z = spectrum(sys.argv[1])
    for name, fit in (("ftlm", by_ftlm), ("impedance.py", by_impedance_py)):
        try:
            # The first fit imports the package.
            fit(frequency, z)
        except ModuleNotFoundError:
            continue
        start_time = time.process_time()
        fitted = fit(frequency, z)
        error = np.sqrt(np.mean(np.abs(z - fitted) ** 2))
        print(f"- {name}: RMS error {1e3 * error:.3f} mΩ, {time.process_time() - start_time:.2f} s of processor time")


if __name__ == "__main__":
    main()
