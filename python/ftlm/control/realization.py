"""Low-order state-space realization of a model by vector fitting of its exact frequency response, in discrete time."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from ftlm.analysis.poles import modes
from ftlm.control.stability_margins import Plant
from ftlm.errors import ModelError
from ftlm.utils.arguments import check_arguments
from ftlm.utils.resources import python_control
from ftlm.utils.validation import Complex, Floats, as_floats, check_integer, check_vector, error_text, frequency_pair

#: Number of frequencies of the fit. The error is evaluated at these and at as many frequencies between them.
FIT_FREQUENCIES = 120
#: Maximum number of pole relocations of vector fitting, and relative change of the poles at which they have converged.
MAX_POLE_ITERATIONS, POLE_TOLERANCE = 30, 1e-6
#: Minimum contribution of a pole to the response of an output, relative to this response. A pole whose contributions
#: are smaller for all outputs and frequencies is removed.
MIN_POLE_CONTRIBUTION = 1e-6
#: Fraction of the lower end of the band. Poles closer to 0 duplicate the integrator and are removed.
INTEGRATOR_BAND_FRACTION = 1e-3
#: Target values of the maximum gain error [dB] and phase error [degrees].
GAIN_DB, PHASE_DEGREES = 0.1, 1.0
#: Range of the number of poles without the integrator.
MIN_POLES, MAX_POLES = 2, 30
#: Maximum gain error [dB] and phase error [degrees] of a realization on which a controller may be designed.
COARSE_DB, COARSE_DEGREES = 1.0, 6.0


@check_arguments
@dataclass(frozen=True)
class Realization:
    """Integer-order state-space realization of a model from one input to several outputs, in discrete time.

    Parameters
    ----------
    outputs, input
        Names of the outputs and of the input.
    rate
         Sampling rate [Hz]; the input has a zero-order hold.
    band
        Frequency band (low, high) of the fit [rad/s].
    poles
        Poles in the s-plane [rad/s], one of each conjugate pair. An integrator (0) comes first.
    a, b, c
        Matrices of the discrete-time system x_{k+1} = a x_k + b u_k, y_k = c x_k. Shapes are (states, states),
        (states, 1) and (outputs, states).
    gain_error, phase_error
        Maximum gain error [dB] and phase error [degrees] over the band, by output, relative to the exact response.
    """

    outputs: tuple[str, ...]
    input: str
    rate: float
    band: tuple[float, float]
    poles: tuple[complex, ...]
    a: Floats
    b: Floats
    c: Floats
    gain_error: dict[str, float]
    phase_error: dict[str, float]

    @property
    def state_count(self) -> int:
        """Number of states."""
        return len(self.a)

    def response(self, w: Floats) -> Complex:
        """Return the frequency response of the discrete-time system at w [rad/s], shape (outputs, W)."""
        z = np.exp(1j * check_vector("w", as_floats("w", w)) / self.rate)
        system = z[:, None, None] * np.eye(self.state_count) - self.a
        states = np.linalg.solve(system, np.broadcast_to(self.b, (z.size, *self.b.shape)))[:, :, 0]
        return np.asarray((states @ self.c.T).T)

    def __str__(self) -> str:
        gain, phase = max(self.gain_error.values()), max(self.phase_error.values())
        return (
            f"{self.state_count} states for {self.band[0]:.3g} to {self.band[1]:.3g} rad/s: within {gain:.2g} dB and "
            f"{phase:.2g} degrees of the model"
        )


def fit_realization(plants: Sequence[Plant], band: tuple[float, float] | None, poles: int | None) -> Realization:
    """Fit an integer-order system to the exact responses of outputs to one input, and discretize it.

    Parameters
    ----------
    plants
        Plants of one model, one per output, with the same input and sampling rate.
    band
        Frequency band (low, high) [rad/s]; by default from 1/5000 to 1/8 of the Nyquist frequency.
    poles
        Number of poles without the integrator; by default as many as errors below 0.1 dB and 1 degree require.

    Returns
    -------
    Realization
        Discrete-time system with its approximation errors.

    Raises
    ------
    ModelError
        If the band or number of poles is invalid, python-control is not installed, or errors exceed 1 dB or 6 degrees.

    Notes
    -----
    Vector fitting (Gustavsen and Semlyen 1999, doi:10.1109/61.772353) gives poles that are common to all outputs.
    Relative errors have equal weight for all outputs and frequencies. python-control discretizes the system with a
    zero-order hold.
    """
    low, high = _band(band, plants[0].rate)
    counts = (
        list(range(2, MAX_POLES + 1, 2)) if poles is None else [check_integer("poles", poles, MIN_POLES, MAX_POLES)]
    )
    library = python_control()
    w = np.geomspace(low, high, FIT_FREQUENCIES)
    with catch_numerical_errors(f"no response from {low:.3g} to {high:.3g} rad/s", "use a narrower band"):
        responses = np.array([p.exact(w) for p in plants])
    model_poles = [
        m.pole
        for m in modes(plants[0].model, coupling=plants[0].coupling)
        if m.oscillatory and low < m.frequency < high
    ]
    has_integrator = [p.integral_order() > 0.5 for p in plants]
    best_realization: Realization | None = None
    for count in counts:
        with catch_numerical_errors(f"no {count} poles from {low:.3g} to {high:.3g} rad/s", "use a narrower band"):
            poles_and_residues = _fit(
                np.asarray(1j * w, dtype=np.complex128),
                responses,
                has_integrator,
                _initial_poles(model_poles, low, high, count),
            )
            realization = _discretize(library, plants, (low, high), *poles_and_residues)
        if best_realization is None or _scaled_error(realization) < _scaled_error(best_realization):
            best_realization = realization
        if _scaled_error(best_realization) <= 1.0:
            break
    assert best_realization is not None
    gain, phase = max(best_realization.gain_error.values()), max(best_realization.phase_error.values())
    if not (gain <= COARSE_DB and phase <= COARSE_DEGREES):
        raise ModelError(
            f"a realization with {best_realization.state_count} states has errors of up to {gain:.2g} dB and "
            f"{phase:.2g} degrees between {low:.3g} and {high:.3g} rad/s, too large for a design; use a narrower band"
            + ("" if poles is None else ", or more poles")
        )
    return best_realization


@contextmanager
def catch_numerical_errors(operation: str, way_out: str) -> Iterator[None]:
    """Raise ModelError in place of an overflow, a singular matrix or another numerical error in a ``with`` block.

    The message names the failed computation (`operation`) and a remedy (`way_out`).
    """
    with np.errstate(over="raise", divide="raise", invalid="raise"), warnings.catch_warnings():
        # SciPy reports a singular matrix only by a warning.
        warnings.simplefilter("error", RuntimeWarning)
        try:
            yield
        except ModelError:
            raise
        except (np.linalg.LinAlgError, ArithmeticError, ValueError, RuntimeWarning) as error:
            raise ModelError(f"{operation} ({error_text(error, 200)}); {way_out}") from None


def _band(band: tuple[float, float] | None, rate: float) -> tuple[float, float]:
    half = math.pi * rate
    if band is None:
        return half / 5000.0, half / 8.0
    low, high = frequency_pair(band)
    if not (math.isfinite(low) and 0 < low < high <= half / 2):
        raise ModelError(
            f"band = ({low:g}, {high:g}) rad/s is out of range; give two increasing frequencies up to a quarter of "
            f"the rate, {half / 2:g} rad/s"
        )
    return low, high


def _initial_poles(model_poles: Sequence[complex], low: float, high: float, count: int) -> Complex:
    """Return initial poles for vector fitting [rad/s], one of each conjugate pair; pairs count twice in `count`.

    They are the poles `model_poles` of oscillatory modes of the model, followed by real poles that are spread over the
    band.
    """
    pairs = list(model_poles)[: count // 2]
    real = -np.geomspace(low, high, count - 2 * len(pairs))
    return np.asarray([*pairs, *real.tolist()], dtype=np.complex128)


def _basis(s: Complex, poles: Complex) -> Complex:
    """Return the partial-fraction basis of the poles at the points s: 1/(s - p) for a real pole p.

    The shape is (number of points, number of poles with their conjugates). A conjugate pair has two columns, whose
    coefficients are real.
    """
    columns = []
    for p in poles:
        pole_term = 1.0 / (s - p)
        if p.imag == 0:
            columns.append(pole_term)
        else:
            conjugate_term = 1.0 / (s - p.conjugate())
            columns += [pole_term + conjugate_term, 1j * (pole_term - conjugate_term)]
    return np.array(columns).T


def _system(poles: Complex) -> tuple[Floats, Floats]:
    """Return (a, b) of a real system whose responses from input to states are the columns of :func:`_basis`."""
    state_count = int(np.sum(np.where(poles.imag == 0, 1, 2)))
    a, b = np.zeros((state_count, state_count)), np.zeros((state_count, 1))
    at = 0
    for p in poles:
        if p.imag == 0:
            a[at, at], b[at, 0] = p.real, 1.0
            at += 1
        else:
            a[at : at + 2, at : at + 2] = [[p.real, p.imag], [-p.imag, p.real]]
            b[at, 0] = 2.0
            at += 2
    return a, b


def _fit(
    s: Complex, responses: Complex, has_integrator: Sequence[bool], poles: Complex
) -> tuple[Complex, Floats, bool]:
    """Fit a system with common poles to `responses`, shape (outputs, points), at the points s.

    `has_integrator` states for each output whether it has an integrator, and `poles` are the initial poles. Return
    (poles, residues, whether there is an integrator). Residues have one row per output. Their first column contains the
    residues of the integrator, 0 for an output without one.
    """
    weight = 1.0 / np.abs(responses)
    for _ in range(MAX_POLE_ITERATIONS):
        basis = _basis(s, poles)
        blocks, right_sides = [], []
        basis_size = basis.shape[1]
        columns_each = basis_size + 1
        for i, (line, w) in enumerate(zip(responses, weight, strict=True)):
            block = np.zeros((s.size, columns_each * len(responses) + basis_size), dtype=complex)
            block[:, i * columns_each] = 1.0 / s if has_integrator[i] else 0.0
            block[:, i * columns_each + 1 : (i + 1) * columns_each] = basis
            block[:, columns_each * len(responses) :] = -line[:, None] * basis
            blocks.append(block * w[:, None])
            right_sides.append(line * w)
        matrix, vector = np.concatenate(blocks), np.concatenate(right_sides)
        scale = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
        solution = _least_squares(matrix / scale, vector) / scale
        a, b = _system(poles)
        stable_poles = np.linalg.eigvals(a - b @ solution[None, columns_each * len(responses) :])
        # The model is stable. A pole that errors of the fit put into the right half-plane is mirrored.
        stable_poles = -np.abs(stable_poles.real) + 1j * stable_poles.imag
        poles_before, poles = (
            poles,
            np.array(sorted(stable_poles[stable_poles.imag >= 0], key=lambda p: (p.imag == 0, abs(p)))),
        )
        if len(poles_before) == len(poles) and np.max(np.abs(poles_before - poles) / np.abs(poles)) < POLE_TOLERANCE:
            break
    residues = _residues(s, responses, has_integrator, poles)
    # Superfluous poles have negligible residues, so their states would not be observable. A second integrator would not
    # be observable either.
    at, is_significant = 1, []
    lowest_frequency = INTEGRATOR_BAND_FRACTION * float(np.min(s.imag)) if any(has_integrator) else 0.0
    for p in poles:
        pole_count = 1 if p.imag == 0 else 2
        contribution = residues[:, at : at + pole_count] @ _basis(s, np.array([p])).T
        is_significant.append(
            bool(np.max(np.abs(contribution) * weight) > MIN_POLE_CONTRIBUTION and abs(p) > lowest_frequency)
        )
        at += pole_count
    if not all(is_significant) and any(is_significant):
        poles = poles[is_significant]
        residues = _residues(s, responses, has_integrator, poles)
    return poles, residues, any(has_integrator)


def _least_squares(matrix: Complex, vector: Complex) -> Floats:
    """Return the real least-squares solution x of complex equations matrix x = vector, by QR factorization."""
    both = np.column_stack([matrix, vector])
    triangle = np.asarray(np.linalg.qr(np.concatenate([both.real, both.imag]), mode="r"), dtype=np.float64)
    return np.asarray(np.linalg.lstsq(triangle[:, :-1], triangle[:, -1])[0])


def _residues(s: Complex, responses: Complex, has_integrator: Sequence[bool], poles: Complex) -> Floats:
    """Return the residues for given poles, shape (outputs, 1 + number of poles with their conjugates).

    The first column is the residue of the integrator, 0 for an output without one. The others are coefficients of the
    columns of :func:`_basis`.
    """
    basis = _basis(s, poles)
    residues = np.zeros((len(responses), basis.shape[1] + 1))
    for i, line in enumerate(responses):
        matrix = (np.column_stack([1.0 / s, basis]) if has_integrator[i] else basis) / np.abs(line)[:, None]
        scale = np.linalg.norm(matrix, axis=0)
        unit_phasors = line / np.abs(line)
        solution = _least_squares(matrix / scale, unit_phasors) / scale
        residues[i, -len(solution) :] = solution
    return residues


def _discretize(
    library: Any, plants: Sequence[Plant], band: tuple[float, float], poles: Complex, residues: Floats, integral: bool
) -> Realization:
    """Return the discrete-time realization of a system with given poles and residues, and its approximation errors.

    `library` is the module of python-control. `integral` states whether the first column of `residues` belongs to an
    integrator.
    """
    a, b = _system(poles)
    c = residues[:, 1:]
    if integral:
        a = np.pad(a, ((1, 0), (1, 0)))
        b = np.vstack([[[1.0]], b])
        c = residues
        poles = np.append(0.0, poles)
    rate = plants[0].rate
    system = library.sample_system(library.ss(a, b, c, np.zeros((len(c), 1))), 1.0 / rate, "zoh")
    # Scale the states, so that their units do not influence the process noise and the weights of a design.
    column_norms = np.maximum(np.sqrt(np.sum(c * c, axis=0)), 1e-300)
    realization = Realization(
        tuple(p.output for p in plants),
        plants[0].input,
        rate,
        band,
        tuple(complex(p) for p in poles),
        np.asarray(system.A) * column_norms[:, None] / column_norms,
        np.asarray(system.B) * column_norms[:, None],
        c / column_norms,
        {},
        {},
    )
    w = np.geomspace(*band, 2 * FIT_FREQUENCIES - 1)
    quotient = realization.response(w) / np.array([p.held_response(w) for p in plants])
    for name, line in zip(realization.outputs, quotient, strict=True):
        realization.gain_error[name] = float(np.max(np.abs(20.0 * np.log10(np.abs(line)))))
        realization.phase_error[name] = float(np.degrees(np.max(np.abs(np.angle(line)))))
    return realization


def _scaled_error(realization: Realization) -> float:
    """Return the largest gain or phase error of all outputs, relative to its target of 0.1 dB or 1 degree."""
    largest_error = max(
        max(realization.gain_error.values()) / GAIN_DB, max(realization.phase_error.values()) / PHASE_DEGREES
    )
    return largest_error if math.isfinite(largest_error) else math.inf
