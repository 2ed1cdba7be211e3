"""Frequency-response data: measured response of one output to one input, or an impedance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ftlm.data.sampling import make_read_only
from ftlm.errors import DataError
from ftlm.utils.arguments import check_arguments
from ftlm.utils.formatting import plural
from ftlm.utils.parameters import parameter
from ftlm.utils.validation import Complex, Floats, as_complex, as_floats, real_number

#: Angular frequency [rad/s] of one unit, by accepted frequency unit; lower-case m means milli.
FREQUENCY_UNITS: dict[str, float] = {
    "rad/s": 1.0,
    "Hz": 2 * math.pi,
    "kHz": 2e3 * math.pi,
    "MHz": 2e6 * math.pi,
    "mHz": 2e-3 * math.pi,
}


@check_arguments
@dataclass(frozen=True, eq=False)
class FrequencyData:
    """Frequency response as measured from one input to one output; :meth:`from_arrays` creates it from arrays.

    Parameters
    ----------
    frequency
        Angular frequencies [rad/s], shape (N,), finite, above 0, in the sequence of the file.
    response
        Complex response, shape (N,), finite: output over input.
    deviation
        Standard deviation of the real part, equal to that of the imaginary part, at each frequency, shape (N,), above
        0; None if unknown.
    output, input
        Names of the output and the input; "" means the only output or input of the structure.
    unit
        Unit of the response, such as "Ω".
    name
        Name of the data in reports.
    warnings
        Assumptions of the reader of the file, as sentences.

    Raises
    ------
    DataError
        If there is no frequency, shapes differ, a frequency or deviation is not finite and positive, or the response is
        not finite.
    """

    frequency: Floats
    response: Complex
    deviation: Floats | None = None
    output: str = ""
    input: str = ""
    unit: str = ""
    name: str = "data"
    warnings: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        frequency = _column(f"{self.name}: frequency", self.frequency)
        if frequency.size == 0:
            raise DataError(f"{self.name}: there is no frequency, 0 rows; give at least one")
        _reject(~(frequency > 0), frequency, f"{self.name}: frequency", "is not above 0")
        response = as_complex(f"{self.name}: response", self.response)
        if response.shape != frequency.shape:
            raise DataError(
                f"{self.name}: response has shape {response.shape}, frequency {frequency.shape}; give one value each"
            )
        _reject(~np.isfinite(response), response, f"{self.name}: response", "is not finite")
        object.__setattr__(self, "frequency", make_read_only(frequency.copy()))
        object.__setattr__(self, "response", make_read_only(response.copy()))
        if self.deviation is not None:
            deviation = _column(f"{self.name}: deviation", self.deviation)
            if deviation.ndim == 1 and deviation.size != frequency.size:
                raise DataError(
                    f"{self.name}: deviation has {plural(deviation.size, 'value')}, frequency {frequency.size}; give "
                    "one each"
                )
            remedy = "leave such rows out, or weight without deviations"
            _reject(~(deviation > 0), deviation, f"{self.name}: deviation", "is not above 0", remedy)
            object.__setattr__(self, "deviation", make_read_only(deviation.copy()))

    @classmethod
    def from_arrays(
        cls,
        frequency: ArrayLike,
        response: ArrayLike,
        *,
        frequency_unit: str = "rad/s",
        deviation: ArrayLike | None = None,
        output: str = "",
        input: str = "",
        unit: str = "",
        name: str = "data",
    ) -> FrequencyData:
        """Return frequency-response data built from arrays.

        Parameters
        ----------
        frequency
            Frequencies in `frequency_unit`, shape (N,), positive.
        response
            Complex response, shape (N,).
        frequency_unit
            ``"rad/s"``, ``"Hz"``, ``"kHz"``, ``"MHz"`` or ``"mHz"``.
        deviation, output, input, unit, name
            See :class:`FrequencyData`.

        Raises
        ------
        DataError
            If a unit is unknown, or in the cases of :class:`FrequencyData`.
        """
        factor = frequency_factor(frequency_unit)
        omega = _column(f"{name}: frequency", frequency) * factor
        deviations = None if deviation is None else _column(f"{name}: deviation", deviation)
        return cls(omega, as_complex(f"{name}: response", response), deviations, output, input, unit, name)

    @property
    def gain(self) -> Floats:
        """Gain of the response [dB], shape (N,)."""
        with np.errstate(divide="ignore"):
            return np.asarray(20.0 * np.log10(np.abs(self.response)))

    @property
    def phase(self) -> Floats:
        """Phase of the response [degrees], shape (N,), unwrapped from the lowest to the highest frequency."""
        order = np.argsort(self.frequency, kind="stable")
        out = np.empty(order.size)
        out[order] = np.degrees(np.unwrap(np.angle(self.response[order])))
        return out

    def slice(self, low: float | None = None, high: float | None = None) -> FrequencyData:
        """Return the data from one angular frequency to another, both included.

        Parameters
        ----------
        low, high
            Limits [rad/s]; None for no limit.

        Raises
        ------
        DataError
            If a limit is not a number, or there are no data between the limits.
        """
        limits = [
            default if limit is None else real_number(name, limit)
            for name, limit, default in (("low", low, 0.0), ("high", high, math.inf))
        ]
        is_inside = (self.frequency >= limits[0]) & (self.frequency <= limits[1])
        if not is_inside.any():
            raise DataError(
                f"{self.name}: there are no data from {limits[0]:g} to {limits[1]:g} rad/s; the data cover "
                f"{self.frequency.min():.5g} to {self.frequency.max():.5g} rad/s"
            )
        deviation = None if self.deviation is None else self.deviation[is_inside]
        return replace(
            self, frequency=self.frequency[is_inside], response=self.response[is_inside], deviation=deviation
        )

    @property
    def pair(self) -> str:
        """Output and input as text, such as ``y from u``; the name of the data if one of them is not named."""
        return f"{self.output} from {self.input}" if self.output and self.input else self.name

    def __str__(self) -> str:
        low, high = float(self.frequency.min()), float(self.frequency.max())
        magnitude = np.abs(self.response)
        unit = f" {self.unit}" if self.unit else ""
        pair = f" of {self.output} from {self.input}" if self.output and self.input else ""
        deviations = "with" if self.deviation is not None else "without"
        return "\n".join(
            [
                f"{self.name}: frequency response{pair}, {self.frequency.size} frequencies from {low:.5g} to "
                f"{high:.5g} rad/s ({low / (2 * math.pi):.4g} to {high / (2 * math.pi):.4g} Hz)",
                f"  magnitude {magnitude.min():.5g} to {magnitude.max():.5g}{unit}, {deviations} standard deviations",
                *(f"  note: {w}" for w in self.warnings),
            ]
        )


def as_frequency_data(data: object) -> tuple[FrequencyData, ...]:
    """Return one or several frequency responses as a tuple; raise DataError for other types or an empty sequence."""
    items = (data,) if isinstance(data, FrequencyData) else data
    if not isinstance(items, Sequence) or isinstance(items, str):
        raise DataError(
            f"data is {type(data).__name__}; give frequency data of load_frequency or FrequencyData.from_arrays"
        )
    for k, item in enumerate(items):
        if not isinstance(item, FrequencyData):
            raise DataError(f"data[{k}] is {type(item).__name__}; give frequency data, such as load_frequency returns")
    if not items:
        raise DataError("data is empty; give at least one frequency response")
    return tuple(items)


def frequency_factor(unit: str) -> float:
    """Return the angular frequency [rad/s] of one `unit` of frequency; raise DataError for an unknown unit."""
    if unit not in FREQUENCY_UNITS:
        raise DataError(
            f"{parameter('frequency_unit', unit)} is unknown; the known ones are {', '.join(FREQUENCY_UNITS)}"
        )
    return FREQUENCY_UNITS[unit]


def _column(name: str, values: object) -> Floats:
    array = as_floats(name, values)
    if array.ndim != 1:
        raise DataError(f"{name} has shape {array.shape}; give a vector")
    _reject(~np.isfinite(array), array, name, "is not finite")
    return array


def _reject(bad: np.ndarray, values: np.ndarray, name: str, problem: str, remedy: str = "leave such rows out") -> None:
    if np.any(bad):
        row = int(np.argmax(bad))
        raise DataError(f"{name} {problem}: {values[row]} at row {row}, {int(np.sum(bad))} in all; {remedy}")
