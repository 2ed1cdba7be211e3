"""Fractional PID controllers, tuned on the exact frequency response of a fractional model and on its intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ftlm.base.arrays import Complex, Floats
from ftlm.base.checks import nearest, real_number, shown
from ftlm.base.errors import ModelError
from ftlm.control.fractional import FractionalPid, Realised
from ftlm.control.margins import JudgedLoop, Margins, Plant, grid, margins_of
from ftlm.control.names import checked_rate, drawn_from
from ftlm.data.solved import Solved, check_solved
from ftlm.solve.frequency import check_unlimited, is_coupled, model_numbers, response_inputs
from ftlm.solve.records import check_linear

#: Orders that are tried: of the integral and of the derivative, first over all, then around the best.
LOWEST, HIGHEST, TRIED = 0.5, 1.0, 15
ROUNDS = 3
#: Frequencies of the curves on which orders are compared.
COMPARED = 300
#: Largest sensitivity over all samples that is aimed at; where none has so little, this much above the least.
CALM, ABOVE = 1.5, 1.05
#: Where the loop's gain is to be high, against friction and offsets: this share of the crossover.
SLOW = 0.1
#: A design that more than this share of the parameters' samples breaks is none.
BROKEN = 0.05
#: A sample keeps a design whose phase margin is at least this share of what was asked for.
KEPT = 0.5
#: The lowest crossover as a share of its rate: below, floating point tells no margins.
SLOWEST = 1e-6
#: Gains of the plant over which flatness is told.
FLAT = (0.7, 1.4)


@dataclass(frozen=True)
class PidDesign(JudgedLoop):
    """A fractional PID with the margins of its loop.

    Parameters
    ----------
    pid
        The controller.
    rate
        Of the loop [Hz].
    nominal
        Margins at the values of the model's numbers.
    samples
        Margins at samples of the numbers from their covariance; none where the model has no covariance.
    flat
        Phase margin with 0.7, 1 and 1.4 times the plant's gain [degrees].
    plants
        Every output that the input moves, that which is controlled first.
    """

    pid: FractionalPid
    rate: float
    nominal: Margins
    samples: tuple[Margins, ...]
    flat: tuple[float, float, float]
    plants: tuple[Plant, ...] = field(default=(), compare=False, repr=False)

    def acting(self, w: Floats | Complex) -> tuple[tuple[str, ...], Complex, Complex]:
        """The output it reads, its response to it and to the reference, at frequencies [rad/s], as it runs."""
        response = Realised(self.pid, self.rate).response(w)
        return (self.plants[0].output,), response[None], response

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"design": "pid", "rate": self.rate, **self.pid.to_dict(), "phase_margin_at_gains": list(self.flat),
                **self._margins()}  # fmt: skip

    def __str__(self) -> str:
        lines = [f"fractional PID: {self.pid}", *self._judged()]
        lines.append("phase margin with {:g}, 1, {:g} of the plant's gain: ".format(*FLAT)
                     + ", ".join(f"{p:.3g}" for p in self.flat) + " degrees")  # fmt: skip
        return "\n".join(lines)


def fractional_pid(
    model: Solved, *, output: str | None = None, input: str | None = None, crossover: float,
    phase_margin: float = 60.0, rate: float = 500.0, samples: int = 100, seed: int = 0,
    coupling: Literal["simulated", "measured"] = "simulated", sensor: bool = False,
) -> PidDesign:  # fmt: skip
    """Tune a fractional PID on a model: crossover, phase margin, flat phase, and the best worst case of its intervals.

    Parameters
    ----------
    model
        A linear model, identified or written down, of any orders.
    output, input : str, optional
        What is controlled and what with; where the model has one of them alone it needs no name.
    crossover
        Where the loop's gain is 1 [rad/s].
    phase_margin
        There [degrees], 10 to 80.
    rate
        Of the loop [Hz], whose sample of delay and whose hold are counted as they are.
    samples
        Of the model's numbers, from their covariance, 0 to 10000.
    seed
        Of the samples.
    coupling
        ``"measured"``: the output's own equation alone.
    sensor
        Whether the loop reads what passed the model's sensor filter; by default the filter was of the run alone.

    Returns
    -------
    PidDesign
        With margins at the values and at each sample.

    Raises
    ------
    ModelError
        A model that is not stable (an integral is), with friction, or whose intervals are too wide: more than a
        twentieth of the samples break the loop or halve its phase margin. A margin that no gains from 0 reach there.

    Notes
    -----
    At given orders three conditions at the crossover, gain 1, phase, and no change of phase with frequency, are linear
    in the three gains: they hold exactly. Of all orders whose largest sensitivity over all samples is at most 1.5 (or
    within 5 % of the least there is) those are taken that give the loop most gain at a tenth of the crossover.
    Monje, Vinagre, Feliu and Chen (2008), doi:10.1016/j.conengprac.2007.08.006.
    """
    plant = plant_of(model, output, input, rate, coupling, sensor=sensor)
    wc = real_number("crossover", crossover)
    if not SLOWEST * plant.rate <= wc < math.pi * plant.rate / 4:
        raise ModelError(
            f"crossover = {shown(crossover)} rad/s is outside [{SLOWEST * plant.rate:.4g}, "
            f"{math.pi * plant.rate / 4:.4g}), from a millionth to an eighth of the rate of {plant.rate:g} Hz"
        )
    asked = real_number("phase_margin", phase_margin)
    if not 10 <= asked <= 80:
        raise ModelError(f"phase_margin = {shown(phase_margin)} degrees is outside [10, 80]")
    count, start = drawn_from(samples, seed)
    plant.check_stable()
    drawn = plant.samples(count, start)
    target = np.exp(1j * (math.radians(asked) - math.pi)) / plant.response(np.array([wc]))[0]
    near = np.array([wc * (1 - 1e-5), wc * (1 + 1e-5)])
    slope = float(np.diff(np.unwrap(np.angle(plant.response(near))))[0] / (near[1] - near[0]))
    w = np.geomspace(wc / 100, min(30 * wc, 0.999 * math.pi * plant.rate), COMPARED)
    curves = np.array([one.response(w) for one in [plant, *drawn[:50]]])
    best = _best(target, slope, wc, w, curves)
    if best is None:
        raise ModelError(
            f"no fractional PID with gains from 0 and orders from {LOWEST:g} to {HIGHEST:g} has a flat phase margin of "
            f"{asked:g} degrees at {wc:g} rad/s on this model, whose phase there is "
            f"{np.degrees(np.angle(plant.response(np.array([wc]))[0])):.4g} degrees; move the crossover, or ask for "
            "another phase margin"
        )
    fine = grid(wc, plant.rate)
    acting = best.response(fine)

    def judged(one: Plant, factor: float = 1.0) -> Margins:
        order = one.integrates() + (best.lam if best.ki > 0 else 0.0)
        return margins_of(factor * acting * one.response(fine), fine, order, one.grows())

    nominal = judged(plant)
    if not nominal.stable:
        raise ModelError(
            f"the loop with a phase margin of {asked:g} degrees at {wc:g} rad/s is not stable on this model: its gain "
            "is 1 elsewhere too, at a resonance; move the crossover away from it"
        )
    margins = tuple(map(judged, drawn))
    broken = [m for m in margins if not (m.stable and m.phase >= KEPT * asked)]
    if len(broken) > BROKEN * len(margins):
        raise ModelError(
            f"the intervals are too wide to design on: in {len(broken)} of {len(margins)} samples of the model's "
            f"numbers the loop is not stable or has less than {KEPT * asked:g} degrees of the phase margin; "
            f"{known_least(model)}; "
            "identify from a longer or richer run, or lower the crossover"
        )
    flat = tuple(judged(plant, factor).phase for factor in (FLAT[0], 1.0, FLAT[1]))
    others = [replace(plant, output=o) for o in model.outputs if o != plant.output]
    moved = (plant, *(p for p in others if p.reached()))
    return PidDesign(best, plant.rate, nominal, margins, (flat[0], flat[1], flat[2]), moved)


def plant_of(
    model: Solved, output: str | None, driver: str | None, rate: float, coupling: str, *, sensor: bool
) -> Plant:
    """The input and output that are meant, or a refusal."""
    check_solved(model)
    if not isinstance(sensor, bool):
        raise ModelError(f"sensor = {shown(sensor)} is neither True nor False")
    check_linear(model.equations, "a loop's margin")
    check_unlimited(model, "a loop's margin")
    inputs = response_inputs(model, coupled=is_coupled(coupling))
    names = []
    for what, name, known in (("output", output, model.outputs), ("input", driver, inputs)):
        if name is None and len(known) == 1:
            names.append(known[0])
        elif name is None:
            raise ModelError(f"the model has several {what}s: say which, {what}=…; it has {', '.join(known)}")
        elif not isinstance(name, str) or name not in known:
            near = nearest(name, known) if isinstance(name, str) else ""
            raise ModelError(
                f"{what} = {shown(name)} is not one of the model's{near}; it has {', '.join(known) or 'none'}"
            )
        else:
            names.append(name)
    return Plant(model, names[0], names[1], checked_rate(rate), coupling, sensor)


def _best(target: complex, slope: float, wc: float, w: Floats, curves: Complex) -> FractionalPid | None:
    """Of the calm controllers that meet all three conditions, the one with most gain at low frequencies."""
    found: list[tuple[float, float, FractionalPid]] = []
    centre, reach = ((LOWEST + HIGHEST) / 2,) * 2, (HIGHEST - LOWEST) / 2
    for _ in range(ROUNDS):
        around = [np.clip(c + reach * np.linspace(-1, 1, TRIED), LOWEST, HIGHEST) for c in centre]
        for lam in np.unique(around[0]).tolist():
            for mu in np.unique(around[1]).tolist():
                pid = _solved(target, slope, wc, lam, mu)
                if pid is None:
                    continue
                worst = float(np.max(1.0 / np.abs(1.0 + pid.response(w) * curves)))
                found.append((worst, float(abs(pid.response(np.array([SLOW * wc]))[0])), pid))
        if not found:
            return None
        calm = max(CALM, ABOVE * min(worst for worst, _, _ in found))
        best = max((f for f in found if f[0] <= calm), key=lambda f: f[1])[2]
        centre, reach = (best.lam, best.mu), reach / TRIED * 2
    return best


def _solved(target: complex, slope: float, wc: float, lam: float, mu: float) -> FractionalPid | None:
    """Gains at given orders: C(j wc) = target and d arg C/dw = -slope; None where one is negative."""
    powers = np.array([0.0, -lam, mu])
    parts = (1j * wc) ** powers
    turning = powers * parts / (wc * target)
    try:
        gains = np.linalg.solve(
            np.array([parts.real, parts.imag, turning.imag]), np.array([target.real, target.imag, -slope])
        )
    except np.linalg.LinAlgError:
        return None
    if not (np.isfinite(gains).all() and (gains >= 0).all()):
        return None
    kp, ki, kd = gains.tolist()
    return FractionalPid(kp, ki, kd, lam, mu)


def known_least(model: Solved) -> str:
    """Which coefficient or order is known least."""
    covariance = None if model.estimate is None else model.estimate.covariance
    if covariance is None:
        return "none is known"
    names = []
    for item in model.equations:
        names += [f"the order of {item.output}"]
        names += [n for t in item.terms for n in (f"the order of {t.signal} in {item.output}", f"the coefficient of "
                                                  f"{t.signal} in {item.output}")]  # fmt: skip
    share = np.sqrt(np.abs(np.diag(covariance))) / np.maximum(np.abs(model_numbers(model)), 1e-12)
    at = int(np.argmax(np.nan_to_num(share, nan=0.0, posinf=1e300)))
    return f"known least is {names[at]}, to {100 * share[at]:.2g} % (one standard error)"
