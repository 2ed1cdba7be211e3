"""The Euler-Lagrange form of the arm, (14)-(15) with nothing eliminated, and signals above their equation's alpha."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import ftlm
from ftlm import _core
from ftlm.estimation.free_parameters import FreeProblem
from ftlm.estimation.objective import sample_run
from lagrange import INPUTS, clean_run, model, structure, truth
from plants import with_noise
from test_derivation import Stage, deriv, vanishes

pytestmark = pytest.mark.usefixtures("no_extension_tests")

STAGES = pytest.mark.parametrize("stage", [1, 2])


# ----------------------------------------------------------------------------------------------------------------------
# What it says, against the energies


def operator(order: ftlm.Order, arm: Stage) -> sp.Expr:
    """An order of the package in the symbols of the derivation."""
    symbols = {str(symbol).replace("_", ""): symbol for symbol in (arm.a1, arm.a2, arm.gamma, arm.beta, arm.mu)}
    return sp.nsimplify(order.constant) + sum(sp.nsimplify(w) * symbols[n] for n, w in order.weights)


@STAGES
def test_both_equations_follow_from_the_energies_7_to_13(stage: int) -> None:
    arm, h = Stage(stage), 2 * stage - 1
    built = ftlm.flexible_link(stage=stage)
    ratio = arm.J1 / arm.J2
    values = {
        f"a{h}": arm.Ks / arm.J1,
        f"b{h}": -arm.B1 / arm.J1,
        f"d{h}": arm.B2 / arm.J1,
        f"g{h}": arm.Kt / arm.J1,
        f"j{stage}": ratio,
    }
    for name, sign, factors in built.coefficient_law:
        values[name] = sp.nsimplify(sign) * sp.prod([values[f] for f in factors])
    signals = {f"theta{stage}1": arm.hub, f"theta{stage}2": arm.link, f"I{stage}": arm.current}
    sides = []
    for item in built.equations:
        right = sum(
            (sp.nsimplify(t.fixed_value) if t.fixed_value is not None else t.factor * values[t.coefficient])
            * deriv(operator(t.order, arm), signals[t.signal])
            for t in item.terms
        )
        sides.append(deriv(operator(item.order, arm), signals[item.output]) - right)
    whole = {arm.a2: 2}
    # (15) per inertia of the link as it stands; (14) less (16) per inertia of the hub.
    assert vanishes((sides[1] - arm.link_equation() / arm.J2).subs(whole))
    raised = deriv(arm.a1 - arm.a2 + arm.mu - arm.gamma, arm.link_equation())
    assert vanishes((sides[0] - (arm.motor_equation() - raised) / arm.J1).subs(whole))
    # No current, no hub friction and no motor constant bend the link.
    assert f"I{stage}" not in {t.signal for t in built.equations[1].terms}


@STAGES
def test_the_hub_is_carried_above_the_deflections_own_order(stage: int) -> None:
    built, h, d = ftlm.flexible_link(stage=stage), 2 * stage - 1, 2 * stage
    hub = built.equations[1].terms[1]
    assert (hub.signal, hub.fixed_value, hub.name) == (f"theta{stage}1", -1.0, f"b{d}")
    assert hub.order == ftlm.Order.parse(f"2 - mu{d} + gamma{h}")
    assert ftlm.order_law(stage)[f"gamma{d}"] == ftlm.Order.parse(f"alpha{d} - mu{d} + gamma{h}")
    assert "input" not in ftlm.order_law(stage)
    assert built.coupling == "measured"
    assert ftlm.flexible_link(stage=stage, form="published").coupling == "simulated"
    assert set(built.order_names) == {f"alpha{h}", f"gamma{h}", f"beta{d}", f"mu{d}"}
    assert ftlm.flexible_link(stage=stage, laws=("orders",)).equations[1].terms[1].coefficient == f"b{d}"
    alone = built.equation(f"theta{stage}2")
    assert alone.order_names == (f"beta{d}", f"gamma{d}", f"mu{d}")
    assert alone.equations[0].terms[1].fixed_value == -1.0


@pytest.mark.parametrize("velocities", [False, True])
def test_inertial_coupling_follows_from_the_energies_of_the_planar_arm(velocities: bool) -> None:
    # Every signal as a power of s: kinetic energy in the absolute rates of (8), Lagrange's equation of each angle.
    s, h, m1, m2, n1, n2, k1, k2, d1, d2, f1, f2, t1, t2 = sp.symbols("s H J11 J12 J21 J22 K1 K2 D1 D2 F1 F2 T1 T2")
    alpha1, gamma1, beta2, mu2, alpha3, gamma3, beta4, mu4 = sp.symbols(
        "alpha1 gamma1 beta2 mu2 alpha3 gamma3 beta4 mu4"
    )
    if velocities:
        gamma1, gamma3 = mu2, mu4
    x = dict(zip(("theta11", "theta12", "theta21", "theta22", "I1", "I2"), sp.symbols("x1:7"), strict=True))
    names = ("theta11", "theta12", "theta21", "theta22")
    own = dict(zip(names, (gamma1, mu2, gamma3, mu4), strict=True))
    highest = dict(zip(names, (alpha1, 2, alpha3, 2), strict=True))
    rates = sp.symbols("w1:5")
    of = [sum(s ** own[n] * x[n] for n in names[: i + 1]) for i in range(4)]
    energy = sum(j * w**2 for j, w in zip((m1, m2, n1, n2), rates, strict=True)) / 2 + h * rates[1] * rates[3]
    momenta = [sp.diff(energy, w).subs(dict(zip(rates, of, strict=True))) for w in rates]

    def lagrange(i: int) -> sp.Expr:
        # The rate of angle i stands in all absolute rates from the i-th on.
        return s ** (highest[names[i]] - own[names[i]]) * sum(momenta[i:])

    link = {
        1: lagrange(1) + k1 * s**beta2 * x["theta12"] + d1 * s**mu2 * x["theta12"],
        3: lagrange(3) + k2 * s**beta4 * x["theta22"] + d2 * s**mu4 * x["theta22"],
    }
    hub = {
        0: lagrange(0) + f1 * s**gamma1 * x["theta11"] - t1 * x["I1"],
        2: lagrange(2) + f2 * s**gamma3 * x["theta21"] - t2 * x["I2"],
    }
    carried = m2 + n1 + n2 + 2 * h
    inertia = {0: m1, 1: carried, 2: n1, 3: n2}
    sides = {i: link[i] / inertia[i] for i in link}
    for i, equation in hub.items():
        raised = s ** (highest[names[i]] - own[names[i]] - highest[names[i + 1]] + own[names[i + 1]])
        sides[i] = (equation - raised * link[i + 1]) / inertia[i]
    values = {
        "a1": k1 / m1,
        "b1": -f1 / m1,
        "d1": d1 / m1,
        "g1": t1 / m1,
        "j1": m1 / carried,
        "a3": k2 / n1,
        "b3": -f2 / n1,
        "d3": d2 / n1,
        "g3": t2 / n1,
        "j2": n1 / n2,
        "p2": -(n1 + n2 + h) / carried,
        "q2": -(n2 + h) / carried,
        "p3": sp.Integer(-1),
        "p4": -(n2 + h) / n2,
    }
    laws = ("orders", "coefficients", "velocities") if velocities else ("orders", "coefficients")
    built = ftlm.flexible_link(stage="both", cross_stage="inertial", laws=laws)
    for name, sign, factors in built.coefficient_law:
        values[name] = sp.nsimplify(sign) * sp.prod([values[f] for f in factors])

    def power(order: ftlm.Order) -> sp.Expr:
        return sp.nsimplify(order.constant) + sum(sp.nsimplify(w) * sp.Symbol(n) for n, w in order.weights)

    for i, item in enumerate(built.equations):
        right = sum(
            (sp.nsimplify(t.fixed_value) if t.fixed_value is not None else t.factor * values[t.coefficient])
            * s ** power(t.order)
            * x[t.signal]
            for t in item.terms
        )
        left = s ** power(item.order) * x[item.output] - right
        assert sp.simplify(sp.powsimp(sp.expand(left - sides[i]))) == 0, item.output


def test_inertial_coupling_has_its_words_and_orders() -> None:
    alone = ftlm.flexible_link(stage=1, cross_stage="inertial", cross_sensitivity=True)
    assert str(alone).splitlines()[1] == (
        "D^2 theta12 = a2 D^beta2 theta12 - 1.0 D^(gamma1-mu2+2) theta11 + d2 D^mu2 theta12"
        " + p2 D^2 theta21 + q2 D^2 theta22 + e2 theta11 + f2 theta21"
    )
    assert alone.equations[0] == ftlm.flexible_link(stage=1).equations[0]
    second = ftlm.flexible_link(stage=2, cross_stage="inertial")
    assert {n: f for n, _, f in second.coefficient_law if n[0] == "q"} == {"q3": ("p3",), "q4": ("p4",)}
    assert "q4" in second.equation("theta22").coefficient_names
    tied = ftlm.flexible_link(stage=1, laws=("orders", "coefficients", "velocities"))
    assert tied.order_names == ("alpha1", "mu2", "beta2")
    assert tied.equations[1].terms[1].order == ftlm.Order(2.0)
    assert ftlm.flexible_link(cross_stage="torques") == ftlm.flexible_link(cross_stage=True)
    for options, words in [
        ({"cross_stage": "inertia"}, "cross_stage = 'inertia' is not known"),
        ({"cross_stage": "inertial", "form": "published"}, "cross_stage='inertial' requires form='lagrange'"),
        ({"laws": ("velocities",)}, "law 'velocities' relates two orders of form='lagrange' under the order law"),
        ({"laws": ("orders", "velocities"), "form": "published"}, "law 'velocities' relates two orders"),
    ]:
        with pytest.raises(ftlm.ModelError, match=words):
            ftlm.flexible_link(**options)


def test_forms_and_their_options() -> None:
    assert ftlm.flexible_link(input_order="derived") == ftlm.flexible_link(form="published", input_order="derived")
    with pytest.raises(ftlm.ModelError, match="input_order = 'derived' is not used by form='lagrange'"):
        ftlm.flexible_link(form="lagrange", input_order="derived")
    with pytest.raises(ftlm.ModelError, match="form = 'newton' is not known; use 'lagrange' or 'published'"):
        ftlm.flexible_link(form="newton")
    link = ftlm.LinkParameters(6.0, 2.0, 4.0, 1.0, 0.5, 3.0)
    assert link.lagrange_coefficients(1) == {
        "a1": 3.0,
        "b1": -0.5,
        "d1": 0.25,
        "g1": 1.5,
        "a2": -1.5,
        "b2": -1.0,
        "d2": -0.125,
    }
    made = ftlm.link_model(form="lagrange", parameters={1: link})
    assert made.coefficients == link.lagrange_coefficients(1)
    friction = ftlm.flexible_link(friction=True)
    assert [[t.signal for t in e.terms if t.signal.startswith("coulomb")] for e in friction.equations] == [
        ["coulomb_theta11"],
        [],
    ]


# ----------------------------------------------------------------------------------------------------------------------
# The same model as the derived form


def derived(stage: int) -> ftlm.Model:
    """The Lagrange model with the hub's acceleration eliminated and nothing dropped."""
    known, h, d = truth(stage), 2 * stage - 1, 2 * stage
    made = ftlm.flexible_link(stage=stage, form="published", input_order="derived")
    r = known[f"j{stage}"] + 1.0
    hub = {f"{c}{h}": known[f"{c}{h}"] for c in "abdg"}
    link = {f"a{d}": -hub[f"a{h}"] * r, f"b{d}": -hub[f"b{h}"], f"d{d}": -hub[f"d{h}"] * r, f"g{d}": -hub[f"g{h}"]}
    return ftlm.Model(made.with_orders({n: known[n] for n in made.order_names}).with_coefficients(hub | link))


@STAGES
def test_frequency_responses_are_those_of_the_derived_form(stage: int) -> None:
    w = np.geomspace(0.1, 300.0, 40)
    direct, from_lagrangian = (m.frequency_response(w) for m in (model(stage), derived(stage)))
    assert np.max(np.abs(direct - from_lagrangian) / np.abs(from_lagrangian)) < 1e-11


@STAGES
def test_free_runs_are_those_of_the_derived_form(stage: int) -> None:
    t = 0.001 * np.arange(401)
    run = ftlm.Run.from_arrays(
        step=0.001,
        inputs={f"I{stage}": 0.3 * np.sin(6.0 * t) ** 4},
        intersample={f"I{stage}": "foh"},
        outputs={f"theta{stage}{k}": np.zeros(t.size) for k in (1, 2)},
    )
    direct, from_lagrangian = (m.simulate(run, tolerance=2e-10) for m in (model(stage), derived(stage)))
    for name in direct.outputs:
        assert np.max(np.abs(direct[name] - from_lagrangian[name])) < 1e-9 * np.max(np.abs(from_lagrangian[name])), name


@STAGES
def test_driven_by_the_measured_hub_the_link_bends_as_it_does_coupled(stage: int) -> None:
    run = clean_run(stage, "multisine")
    alone = ftlm.Model(replace(model(stage).structure, coupling="measured", initial="rest"))
    assert alone.compare(run).fit[f"theta{stage}2"] > 99.8


# ----------------------------------------------------------------------------------------------------------------------
# A signal above its equation's own order


# What the samples leave out, joined by lines, counts the more the more often it is differentiated.
@pytest.mark.parametrize(("excess", "share"), [(0.1, 2e-4), (0.5, 2e-4), (0.8, 2e-3)])
def test_a_measured_signal_is_differentiated(excess: float, share: float) -> None:
    # D y = D^(1 + q) x with x = t^3 gives y = 6 t^(3 - q)/Gamma(4 - q).
    t = 0.01 * np.arange(301)
    run = ftlm.Run.from_arrays(step=0.01, inputs={"x": t**3}, outputs={"y": np.zeros(t.size)}, intersample={"x": "foh"})
    found = ftlm.Model(ftlm.equation(f"D y = D^{1 + excess} x", initial="rest")).simulate(run, tolerance=1e-4)["y"]
    exact = 6.0 * t ** (3 - excess) / math.gamma(4 - excess)
    assert np.max(np.abs(found - exact)[1:]) < share * exact[-1]


def dense_free_run(orders: list[float], step: float, x: np.ndarray) -> np.ndarray:
    """Pulse means of y in D^a y = c D^nu x + b D^mu y, integrated by nu, its highest order, with dense matrices."""
    (alpha, nu, mu), (c, b), m = orders, (-1.3, -4.0), len(x)

    def integral(eta: float) -> np.ndarray:
        v = [step**eta / math.gamma(eta + 2)]
        v += [v[0] * ((n + 1) ** (eta + 1) - 2 * n ** (eta + 1) + (n - 1) ** (eta + 1)) for n in range(1, m)]
        return np.array([[v[i - j] if i >= j else 0.0 for j in range(m)] for i in range(m)])

    # All of the equation divided by the integral of the excess, which own terms commute with.
    own = np.eye(m) - b * integral(alpha - mu)
    return np.linalg.solve(integral(nu - alpha) @ own, c * x)


def test_the_core_integrates_by_the_highest_order_whichever_signal_carries_it() -> None:
    rng = np.random.default_rng(4)
    x = np.cumsum(rng.standard_normal(80)) * 0.1
    words = ftlm.equation("D^1.6 y = -1.3 D^1.85 x - 4 D^0.3 y")
    item = ((0, 1.6, [(1, 1.85), (0, 0.3)]), [-1.3, -4.0])
    means = np.stack([np.zeros(80), x])
    found = _core.respond((0.05, means, None), [item], [False, False], [[]])
    np.testing.assert_allclose(found[0], dense_free_run([1.6, 1.85, 0.3], 0.05, x), rtol=1e-9, atol=1e-12)
    assert words.equations[0].terms[0].order.constant == 1.85


def test_the_jacobian_above_alpha_is_that_of_finite_differences() -> None:
    run = with_noise(clean_run(1, "multisine"), 40, [1]).window(None, 0.6)
    for coupling in ("simulated", "measured"):
        problem = FreeProblem.of(replace(ftlm.flexible_link(coupling=coupling), initial="rest"))
        prepared = [sample_run(run, problem, [1.0, 10.0], pulses_per_sample=2)]
        named = {"alpha1": 1.93, "gamma1": 0.9, "beta2": 0.23, "mu2": 0.7}
        named |= {"a1": 500.0, "b1": -50.0, "d1": 8.0, "g1": 120.0, "j1": 0.5}
        names = [*problem.orders, *problem.coefficients]
        point = np.array([named[n] for n in names])

        def at(values: np.ndarray, problem=problem, prepared=prepared) -> dict:
            return problem.core.minimize(prepared, (values.tolist(), []), True, [], 1, 1e-12, False)

        base = np.asarray(at(point)["jacobian"])
        for i, name in enumerate(names):
            shift = 1e-6 * max(abs(point[i]), 1.0) * np.eye(point.size)[i]
            slope = (np.asarray(at(point + shift)["residuals"]) - at(point - shift)["residuals"]) / (2 * shift[i])
            assert np.max(np.abs(slope - base[i])) < 2e-5 * np.max(np.abs(base[i])) + 1e-12, (coupling, name)


@pytest.mark.parametrize(
    "words",
    [
        "D^2 y = D^2 x + u; D^2 x = D^2 y + v",
        "D y = D^1.5 x + u; D^1.5 x = D y + v",
        "D^2 y = 0.5 D^2.4 x + u; D^2.4 x = 2 D^2 y - 3 D x + v",
    ],
)
def test_equations_that_cancel_each_other_at_their_highest_orders_are_refused(words: str) -> None:
    t = 0.01 * np.arange(100)
    zeros = np.zeros(t.size)
    run = ftlm.Run.from_arrays(step=0.01, inputs={"u": np.sin(t), "v": np.cos(t)}, outputs={"y": zeros, "x": zeros})
    with pytest.raises(ftlm.ModelError, match="leading matrix of the equations is singular"):
        ftlm.Model(replace(ftlm.equation(words), coupling="simulated")).simulate(run)


def test_a_held_input_is_not_differentiated_beyond_the_output() -> None:
    u = np.sign(np.sin(0.3 * np.arange(200)))
    held = ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": np.cumsum(u)})
    words = ftlm.equation("D y = a y + b D^1.4 u")
    with pytest.raises(
        ftlm.ModelError, match=r"order 1\.4 of u is above alpha = 1 of y, and u of run .* has a zero-order hold"
    ):
        ftlm.identify(held, words)
    smooth = ftlm.Run.from_arrays(
        step=0.01, inputs={"u": np.sin(0.1 * np.arange(200))}, outputs={"y": np.cumsum(u)}, intersample={"u": "foh"}
    )
    assert ftlm.identify(smooth, words).coefficients.keys() == {"a", "b"}
    with pytest.raises(ftlm.ModelError, match=r"order 2 of u is 1 above alpha = 1 of y; .*lower it"):
        ftlm.identify(smooth, ftlm.equation("D y = a y + b D^2 u"))


# ----------------------------------------------------------------------------------------------------------------------
# Recovery


def scores(stage: int, shape: str, level: float, seed: int) -> np.ndarray:
    """z-scores of all nine numbers from the automatic start."""
    run = with_noise(clean_run(stage, shape), level, [seed, round(level), stage])
    found = ftlm.identify(run, structure(stage), method="output-error", threads=1).joint
    values = dict(zip(found.names, found.values.tolist(), strict=True))
    assert found.names == list(truth(stage))
    return np.array([(values[n] - v) / found.standard_errors[n] for n, v in truth(stage).items()])


@pytest.mark.slow
@STAGES
@pytest.mark.parametrize("shape", INPUTS)
def test_the_truth_is_recovered_from_the_automatic_start(stage: int, shape: str) -> None:
    for level in (20.0, 60.0):
        assert np.max(np.abs(scores(stage, shape, level, 0))) < 4.0, level
