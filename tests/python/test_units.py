"""Units do not matter to friction and to laws between coefficients either: the same orders, the same fit."""

import numpy as np
import pytest

import friction
import ftlm
from oracles import held_response
from slow_cases import slow_after

#: What time, outputs and inputs are multiplied by.
UNITS = {"time in ms": (1e3, 1.0, 1.0), "time in min": (1 / 60, 1.0, 1.0), "y x 1000, u x 0.001": (1.0, 1e3, 1e-3)}


def in_units(run, time, outputs, inputs):
    """A run in other units."""
    return ftlm.Run.from_arrays(
        step=time * run.step,
        inputs={n: inputs * run[n] for n in run.inputs},
        outputs={n: outputs * run[n] for n in run.outputs},
        name=run.name,
    )


def identified(runs, structure):
    return ftlm.identify(runs, structure, threads=1, method=ftlm.OutputError(intervals="quadratic"))


def cart(seed):
    """A spring-mounted body on dry friction by slow stepping, in noise of half a percent."""
    rng, rows, step = np.random.default_rng([17, seed]), 200, 0.02
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 10), 10)
    force = np.repeat(3.0 * u, 10)
    position, _ = friction.naive_run(force, step / 10, 2.0, [(-1.0, 1.0), (-4.0, 0.0)], 0.6)
    y = np.append(0.0, position)[::10][:rows]
    y = y + 0.005 * np.std(y) * rng.standard_normal(rows)
    return ftlm.Run.from_arrays(step=step, inputs={"u": u}, outputs={"y": y}, name=f"cart {seed}")


CARTS = {
    "integer orders": ("D^2 y = -d D y - k y + g u - fc*sign(D y)", {}),
    "damping of free order": ("D^2 y = -d D^mu y - k y + g u - fc*sign(D y)", {"mu": (0.5, 1.5, 0.1)}),
    "inertia of free order": ("D^alpha y = -d D y - k y + g u - fc*sign(D y)", {"alpha": (1.6, 2.0, 0.1)}),
    "more near rest": ("D^2 y = -d D y - k y + g u - fc*sign(D y) - fs*exp(-(D y/vs)^2)*sign(D y)", {}),
}


@slow_after(1, "kind", ["damping of free order", *(k for k in CARTS if k != "damping of free order")])
def test_friction_is_the_same_in_any_unit(kind):
    words, orders = CARTS[kind]
    structure, run = ftlm.equation(words, orders=orders), cart(0)
    here = identified(run, structure)
    assert here.coefficients["fc"] > 0.4
    for time, outputs, inputs in UNITS.values():
        there = identified(in_units(run, time, outputs, inputs), structure)
        assert there.orders == pytest.approx(here.orders, abs=1e-6)
        assert there.fit["y"] == pytest.approx(here.fit["y"], abs=1e-5)
        alpha, mu = here.orders.get("alpha", 2.0), here.orders.get("mu", 1.0)
        second = outputs * time**-alpha
        units = {
            "d": time ** (mu - alpha),
            "k": time**-alpha,
            "g": second / inputs,
            "fc": second,
            "fs": second,
            "vs": outputs / time,
        }
        back = {n: v / units[n] for n, v in there.coefficients.items()}
        assert back == pytest.approx(here.coefficients, rel=1e-3)


def test_friction_of_runs_in_another_order_is_the_same():
    words, orders = CARTS["damping of free order"]
    structure, runs = ftlm.equation(words, orders=orders), [cart(0), cart(1)]
    one, other = (identified(r, structure) for r in (runs, runs[::-1]))
    assert other.orders == pytest.approx(one.orders, abs=1e-6)
    assert other.coefficients == pytest.approx(one.coefficients, rel=1e-5)


def stage():
    """A hub and its link by an inverse z-transform, in 1 % of noise; their viscous frictions are of one order."""
    rng, rows, step = np.random.default_rng(13), 300, 0.01
    t = np.arange(rows) * step
    current = np.where(t % 1.0 < 0.5, 0.3, -0.3) * np.where(t % 0.7 < 0.35, 1.0, 0.4)

    def angles(s):
        hub, bent = s**2 + 62.956 * s**0.9, 628.89 * s**0.1 + 6.63 * s**0.9
        link, driven = s**2 + 0.37265 * bent, s**2
        return 140.47 * np.stack([link, -driven]) / (hub * link + bent * driven)

    clean = dict(zip(("theta11", "theta12"), held_response(angles, current, step), strict=True))
    outputs = {n: y + 0.01 * np.std(y) * rng.standard_normal(rows) for n, y in clean.items()}
    return ftlm.Run.from_arrays(step=step, inputs={"I1": current}, outputs=outputs, name="stage")


def test_laws_between_coefficients_are_the_same_in_any_unit():
    """With one order for both frictions the law ties numbers of one dimension, and the known -1 has none."""
    laws = ("orders", "coefficients", "velocities")
    structure, run = ftlm.flexible_link(stage=1, coupling="simulated", laws=laws), stage()
    here = identified(run, structure)
    assert here.orders == pytest.approx({"alpha1": 2.0, "mu2": 0.9, "beta2": 0.1}, abs=0.01)
    for kind in ("time in ms", "y x 1000, u x 0.001"):
        time, outputs, inputs = UNITS[kind]
        there = identified(in_units(run, time, outputs, inputs), structure)
        assert there.orders == pytest.approx(here.orders, abs=1e-6)
        assert there.fit == pytest.approx(here.fit, abs=1e-4)
        alpha, mu, beta = (here.orders[n] for n in ("alpha1", "mu2", "beta2"))
        units = {
            "a1": time ** (beta - 2),
            "b1": time ** (mu - alpha),
            "d1": time ** (mu - 2),
            "g1": outputs / inputs * time**-alpha,
            "a2": time ** (beta - 2),
            "b2": 1.0,
            "d2": time ** (mu - 2),
        }
        back = {n: v / units[n] for n, v in there.coefficients.items()}
        assert back == pytest.approx(here.coefficients, rel=1e-3)


def test_a_file_in_other_units_says_that_results_are_in_si_units(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("time [ms],i [mA],y [mm],v [V]\n" + "".join(f"{10 * k},{k % 7},{k % 5},1\n" for k in range(20)))
    run = ftlm.load(path, inputs={"i": "i [mA]", "v": "v [V]"}, outputs={"y": "y [mm]"})
    assert run.units == {"i": "A", "v": "V", "y": "m"}
    assert [w for w in run.warnings if "SI" in w] == ["converted to SI units: i from mA to A, y from mm to m"]
    plain = ftlm.load(path, inputs={"v": "v [V]"}, outputs={"y": "y [mm]"}, units={"y": ""})
    assert not any("SI" in w for w in plain.warnings)
