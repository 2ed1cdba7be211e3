"""The unit of time does not matter: a flat fit ends at the same numbers in seconds, milliseconds and minutes."""

import numpy as np
import pytest
from scipy import signal

import ftlm
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import Iterate, Objective, minimize_cost

pytestmark = pytest.mark.usefixtures("no_extension_tests")

#: Of a lag of first order two orders and an own term too many: along the bottom of a valley nothing tells them.
FLAT = "D^alpha y = d D^mu y + a y + b u"
UNITS = {"s": 1.0, "ms": 1e3, "min": 1.0 / 60.0}


def lag(seed, scale):
    """A lag of first order by SciPy, in 5 % of noise, its time in another unit."""
    rows = 240
    rng = np.random.default_rng([31, seed])
    u = np.repeat(rng.choice([-1.0, 1.0], rows // 20 + 1), 20)[:rows]
    system = signal.cont2discrete(signal.tf2ss([3.0], [1.0, 3.0]), 0.02, "zoh")
    y = signal.dlsim(system, u)[1][:, 0]
    y = y + 0.05 * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=0.02 * scale, inputs={"u": u}, outputs={"y": y}, name="lag")


def in_seconds(values, scale):
    """Coefficients told in seconds: the power of time that each is follows from the orders."""
    alpha, mu = values["alpha"], values["mu"]
    powers = {"d": alpha - mu, "a": alpha, "b": alpha}
    return {n: values[n] * scale**power for n, power in powers.items()}


@pytest.mark.parametrize("seed", [0, 2])
def test_a_flat_fit_does_not_depend_on_the_unit_of_time(seed):
    found = {
        unit: ftlm.identify(
            lag(seed, scale), ftlm.equation(FLAT), threads=1, method=ftlm.OutputError(intervals="quadratic")
        ).joint
        for unit, scale in UNITS.items()
    }
    seconds = found["s"]
    values = dict(zip(seconds.names, seconds.values, strict=True))
    # Told to no more than this: the same numbers in any unit are no accident of a well-determined fit.
    assert seconds.standard_errors["alpha"] > 0.01
    for unit, scale in UNITS.items():
        other = found[unit]
        assert other.orders == pytest.approx(seconds.orders, abs=1e-6)
        converted = in_seconds(dict(zip(other.names, other.values, strict=True)), scale)
        assert converted == pytest.approx(in_seconds(values, 1.0), rel=1e-4)
        assert other.noise == pytest.approx(seconds.noise, rel=1e-8)
        assert other.refinement == seconds.refinement
        assert other.standard_errors["alpha"] == pytest.approx(seconds.standard_errors["alpha"], rel=1e-3)


@pytest.mark.parametrize("plain", [False, True])
def test_a_descent_takes_the_same_steps_in_any_unit(plain):
    """Far from the optimum, and stopped on the way: the path is the same, not the end alone."""
    problem = FreeProblem.of(ftlm.equation(FLAT, initial="rest"))
    start = {"alpha": 1.4, "mu": 0.8, "d": -1.0, "a": -9.0, "b": 9.0}
    ended = []
    for scale in UNITS.values():
        here = start | {n: v for n, v in in_seconds(start, 1.0 / scale).items()}
        grid = Objective(problem, [lag(1, scale)], [20.0])
        attempt = Iterate([here[n] for n in problem.orders], [here[n] for n in problem.coefficients], "", {})
        ended.append(minimize_cost(problem, grid.experiments, attempt, evaluations=6, linear_scale=plain))
    for other in ended[1:]:
        assert other.orders == pytest.approx(ended[0].orders, abs=1e-7)
        assert other.outcome["cost"] == pytest.approx(ended[0].outcome["cost"], rel=1e-9)
