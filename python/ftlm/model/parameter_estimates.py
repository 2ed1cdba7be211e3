"""Parameters of an identified model: value, standard error, interval and unit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ftlm.data.units import coefficient_unit, nonlinear_coefficient_unit
from ftlm.model.model import Model
from ftlm.structure.circuit import Circuit
from ftlm.utils.files import to_frame
from ftlm.utils.statistics import NORMAL_95


@dataclass(frozen=True)
class Parameter:
    """Parameter of an identified model: value, standard error, interval and unit.

    Parameters
    ----------
    name
        Name in the equation; ``delay_u``, ``sat_u`` and ``dead_u`` for the delay, saturation and dead zone of input u;
        ``constant_y``, ``ramp_y`` and ``level_y`` for the offset of output y, with ``[run]`` if there are several runs.
    value
        Estimate, or the given value of a fixed parameter.
    standard_error
        Standard error in the unit of the value; NaN if the parameter is fixed or the method gives none, infinite if the
        parameter is not identifiable.
    interval
        (low, high) of the 95 % confidence interval, from the standard error or by profile likelihood. A bound is
        infinite if the data do not bound the parameter, and NaN without a standard error.
    unit
        SI unit; empty if the parameter is dimensionless or the unit of a signal is unknown.
    fixed
        Whether the user gave the value, so that it is not an estimate.
    """

    name: str
    value: float
    standard_error: float = math.nan
    interval: tuple[float, float] = (math.nan, math.nan)
    unit: str = ""
    fixed: bool = False

    def __str__(self) -> str:
        value = f"{self.value:.6g}{f' {self.unit}' if self.unit else ''}"
        if self.fixed:
            return f"{self.name} = {value} (fixed)"
        if math.isnan(self.standard_error):
            return f"{self.name} = {value}"
        low, high = self.interval
        return (
            f"{self.name} = {value} (standard error {self.standard_error:.3g}, 95 % interval {low:.6g} to {high:.6g})"
        )


def parameter_estimates(
    model: Model | Circuit,
    values: Mapping[str, float],
    *,
    errors: Mapping[str, float],
    intervals: Mapping[str, tuple[float, float]],
    free: Collection[str],
) -> dict[str, Parameter]:
    """Return the parameters of a model by name.

    Parameters
    ----------
    model
        Model or circuit that gives the units of the parameters.
    values, errors, intervals
        Values, standard errors and 95 % intervals by name. Errors and intervals may be missing.
    free
        Names of the estimated parameters; all other parameters are fixed.
    """
    units = model.units if isinstance(model, Circuit) else parameter_units(model)
    undefined = (math.nan, math.nan)
    return {
        n: Parameter(n, v, errors.get(n, math.nan), intervals.get(n, undefined), units.get(n, ""), n not in free)
        for n, v in values.items()
    }


def offset_estimates(
    model: Model,
    runs: Sequence[str],
    offsets: Sequence[Mapping[str, Mapping[str, float]]],
    errors: Sequence[Mapping[str, Mapping[str, float]]],
) -> dict[str, Parameter]:
    """Return the offsets of all runs as parameters by name, such as ``constant_y[run]``.

    `offsets` and their standard `errors` have, for each run, the value by output and kind of offset. `errors` may be
    empty.
    """
    orders = {e.output: e.order.constant for e in model.equations}
    out = {}
    for k, run in enumerate(offsets):
        for output, values in run.items():
            output_unit = model.units.get(output, "")
            exponents = {"constant": orders[output], "ramp": orders[output] + 1.0, "level": 0.0}
            for kind, value in values.items():
                name = f"{kind}_{output}{f'[{runs[k]}]' if len(offsets) > 1 else ''}"
                error = errors[k][output][kind] if errors else math.nan
                unit = f"s^-{exponents[kind]:g} {output_unit}" if output_unit and exponents[kind] else output_unit
                half_width = NORMAL_95 * error
                out[name] = Parameter(name, value, error, (value - half_width, value + half_width), unit)
    return out


def parameter_frame(parameters: Iterable[Parameter], reference_values: Mapping[str, float]) -> Any:
    """Return a pandas DataFrame of parameters with value, standard error, 95 % interval, unit and nominal value."""
    rows = [
        {
            "parameter": p.name,
            "value": p.value,
            "standard_error": p.standard_error,
            "low": p.interval[0],
            "high": p.interval[1],
            "unit": p.unit,
            "fixed": p.fixed,
            "nominal": reference_values.get(p.name, math.nan),
        }
        for p in parameters
    ]
    return to_frame(rows, ["parameter"])


def parameter_units(model: Model) -> dict[str, str]:
    """Return the units of coefficients, friction parameters, delays and limits by name; unknown units are omitted."""
    out = {}
    for item in model.equations:
        alpha = item.order.constant
        for term in item.terms:
            if term.name is not None:
                context, expression, order = (model.units, item.output, alpha), term.nonlinear, term.order.constant
                out[term.name] = (
                    coefficient_unit(*context, term.signal, order)
                    if expression is None
                    else nonlinear_coefficient_unit(*context, expression, order)
                )
        if item.friction is not None:
            unit = model.units.get(item.output, "")
            force = f"s^-{alpha:g} {unit}" if unit else ""
            stribeck = item.friction.stribeck
            units_by_name = [(item.friction.name, force)]
            if stribeck is not None:
                units_by_name += [(stribeck.name, force), (stribeck.speed_name, f"{unit}/s" if unit else "")]
            out |= {name: unit for name, unit in units_by_name if name is not None}
    out |= {f"delay_{name}": "s" for name in model.structure.delay}
    out |= {limit.name: model.units.get(limit.signal, "") for limit in model.structure.limits}
    return {name: unit for name, unit in out.items() if unit}
