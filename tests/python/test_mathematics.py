"""Every number of the design's page of mathematics, each by its name, with a stated tolerance.

Where a number there was measured with other noise or by another estimator than its sentence says, the test states what
it measures and why.
"""

import json
from dataclasses import replace
from math import gamma
from pathlib import Path

import numpy as np
import pytest

import ftlm
import oracles
from ftlm import _core
from ftlm.kernels import block_pulse_kernel
from ftlm.simulation.discretization import equation_tuple, record, structure_tuple

REST = (False, [])


def steps(means, step):
    """Return a record of one output, to be simulated, and one input given by its pulse means."""
    return step, np.stack([np.zeros(len(means)), np.asarray(means, float)]), None


@pytest.fixture(scope="module")
def record_a(clean_a, plants):
    """Plant A's record of 2 048 means, and its structure with the true orders."""
    structure = ftlm.flexible_link(form="published", stage=1).with_orders(plants["A"]["free_orders"])
    return record(clean_a, structure, 2048), structure


# ----------------------------------------------------------------------------------------------------------------------
# 2. Kernels


KERNELS = json.loads((Path(__file__).resolve().parents[1] / "reference" / "block_pulse_kernel.json").read_text())[
    "records"
]


@pytest.mark.parametrize("known", KERNELS, ids=lambda known: f"eta={known['eta']}")
def test_kernel_is_a_few_ulps_from_exact(known):
    n = np.array(known["n"])
    kernel = block_pulse_kernel(known["eta"], int(n.max()), step=1.0)[n - 1] * gamma(known["eta"] + 2)
    np.testing.assert_allclose(kernel, known["v"], rtol=1e-13)


def test_derivative_of_the_kernel_is_a_few_ulps_from_exact():
    for known in KERNELS:
        n = np.array([k for k in known["n"] if k <= 2048])
        v, dv = (np.array(known[key])[: len(n)] for key in ("v", "dv"))
        exact = (dv - v * known["digamma"]) / known["gamma"]
        found = block_pulse_kernel(known["eta"], 2048, step=1.0, derivative=True)[n - 1]
        scale = np.maximum(np.abs(exact), np.abs(v) / known["gamma"])
        assert np.max(np.abs(found - exact) / scale) <= 1e-13, known["eta"]


@pytest.mark.parametrize(
    ("near", "printed"), [(100, 3e-11), (2_000, 6e-9), (1 << 17, 3e-5), (1 << 20, 2e-3)], ids=lambda x: f"{x:g}"
)
def test_printed_kernel_formula_cancels(near, printed):
    # Worst relative error within 50 of n, eta = 0.15; a factor 2 covers what other machines round otherwise.
    exact = block_pulse_kernel(0.15, near + 50, step=1.0) * gamma(2.15)
    as_printed = oracles.block_pulse_kernel_as_printed(0.15, near + 50)
    worst = np.max(np.abs(as_printed / exact - 1)[near - 50 :])
    assert printed / 2 < worst < 2 * printed


# ----------------------------------------------------------------------------------------------------------------------
# 2. Accuracy of simulation

ACCURACY = {
    0.5: {512: 5.66e-6, 2048: 3.61e-7, 8192: 2.28e-8},
    # The page prints 3.6e-7 for the last; it is 3.37e-7.
    1.8: {512: 8.63e-5, 2048: 5.39e-6, 8192: 3.37e-7},
}


@pytest.mark.parametrize("alpha", [0.5, 1.8])
def test_accuracy_is_second_order_away_from_the_start(reference, alpha):
    (known,) = (r for r in reference("step_responses")["relaxation"] if r["alpha"] == alpha)
    errors = {}
    for entry in known["means"]:
        m, k = entry["m"], np.array(entry["k"])
        step = known["duration"] / m
        equation = ((0, alpha, [(0, 0.0), (1, 0.0)]), [-known["coefficient"], known["input"]])
        means = _core.respond(steps(np.ones(m), step), [equation], [False, True], [[]])[0]
        late = (k - 0.5) * step > 1.0
        errors[m] = np.max(np.abs(means[k - 1] - entry["mean"])[late])
        assert errors[m] == pytest.approx(ACCURACY[alpha][m], rel=0.005)
    assert np.log2(errors[512] / errors[8192]) / 4 == pytest.approx(2.0, abs=0.02)


def test_number_of_pulses_need_not_be_a_power_of_two(reference):
    # 1 000 pulses lie between 512 and 2 048 in accuracy; Haar coordinates alone ask for a power of two.
    (known,) = (r for r in reference("step_responses")["relaxation"] if r["alpha"] == 1.8)
    equation = ((0, 1.8, [(0, 0.0), (1, 0.0)]), [-2.0, 2.0])
    means = _core.respond(steps(np.ones(1000), 0.01), [equation], [False, True], [[]])[0]
    points = dict(zip(known["t"], known["y"], strict=True))
    for t in (1.0, 2.0, 5.0):
        k = round(t / 0.01)
        assert (means[k - 1] + means[k]) / 2 == pytest.approx(points[t], abs=4 * 5.4e-6)


STEP_3T = {1.0: 0.423976252450147, 5.0: 0.585082992742685, 10.0: 0.820332518587934, 20.0: 0.991079096205464}


@pytest.fixture(scope="module")
def response_3t():
    model = ftlm.Model(ftlm.equation("D^2.2 y = -0.625 D^0.9 y - 1.25 y + 1.25 u"))
    run = ftlm.Run.from_arrays(step=0.01, inputs={"u": np.ones(2001)}, outputs={"y": np.zeros(2001)})
    return model.simulate(run, tolerance=1e-9)["y"]


@pytest.mark.parametrize("t", STEP_3T)
def test_step_response_of_3t(response_3t, t):
    assert response_3t[round(t / 0.01)] == pytest.approx(STEP_3T[t], abs=5e-11)


def test_step_response_of_3t_at_every_reference_instant(response_3t, reference):
    known = reference("step_responses")["three_term"]
    found = response_3t[np.round(np.array(known["t"]) / 0.01).astype(int)]
    np.testing.assert_allclose(found, known["y"], rtol=0, atol=5e-11)


# ----------------------------------------------------------------------------------------------------------------------
# 2. Division

DIVISORS = {
    # (coefficient, eta) of 1 - sum of c F^eta over 20 s; the last three grow.
    "D^0.5": [(-2.0, 0.5)],
    "3T": [(-0.625, 1.3), (-1.25, 2.2)],
    "Plant A, theta12": [(-863.2474823943662, 1.9), (-9.10068661971831, 1.15)],
    "growing, order 0.5": [(1.5, 0.5)],
    "growing, order 1.7": [(3.0, 1.7), (-0.5, 0.3)],
    "growing, near identity": [(2.16, 0.05), (-1.17, 0.1)],
}


@pytest.mark.parametrize("m", [1000, 4096])
@pytest.mark.parametrize("name", DIVISORS)
def test_division_is_exact_stable_or_not(name, m):
    step = 20.0 / m
    divisor = -sum(c * block_pulse_kernel(eta, m, step=step) for c, eta in DIVISORS[name])
    divisor[0] += 1.0
    numerator = np.random.default_rng(1).standard_normal(m)
    fast = _core.series_divide(numerator, divisor)
    naive = _core.series_divide(numerator, divisor, naive=True)
    # Relative to the size reached so far: a growing quotient is not judged by its end alone.
    size = np.maximum.accumulate(np.abs(naive))
    assert np.max(np.abs(fast - naive) / size) <= 5e-12
    if name.startswith("growing"):
        assert size[-1] > 10 * np.abs(numerator).max()
    # An oracle outside the core: what was divided comes back.
    back = _core.series_multiply(divisor, fast, m, naive=True)
    assert np.max(np.abs(back - numerator) / np.maximum(size, 1.0)) <= 5e-12


# ----------------------------------------------------------------------------------------------------------------------
# 2. Samples and means


def naive_record(run):
    """Point samples taken for means: sample k stands for the pulse that begins there."""
    return run.step, np.stack([run[s][:-1] for s in ("theta11", "theta12", "I1")]), None


def hub_a1(core, structure):
    equation = structure_tuple(structure.equations[0], ("theta11", "theta12", "I1"))
    return _core.least_squares([core], equation, [False, False, True], [None] * 4, REST)[0][0]


def test_samples_taken_for_means_bias_the_stiffness(clean_a, with_noise, record_a):
    # The page's 593 for 628.9 comes from the joint output-error fit. The same slip in least squares on the hub's
    # equation gives 603.7 without noise; with means it is 629.03. At noise 1e-4 (ten seeds) 604 against 630, standard
    # deviation 7: 3.4 of it off against 0.1.
    structure = record_a[1]
    truth = 628.89
    means = record(clean_a, structure, clean_a.length - 1)
    assert hub_a1(naive_record(clean_a), structure) == pytest.approx(603.7, abs=0.1)
    assert hub_a1(means.core(), structure) == pytest.approx(truth, rel=3e-4)
    naive, right = [], []
    for seed in range(10):
        run = with_noise(clean_a, 1e-4, seed)
        naive.append(hub_a1(naive_record(run), structure))
        right.append(hub_a1(record(run, structure, run.length - 1).core(), structure))
    spread = np.std(right, ddof=1)
    assert spread == pytest.approx(7.5, rel=0.4)
    assert abs(np.mean(right) - truth) < 0.01 * truth
    assert abs(np.mean(right) - truth) / spread < 1.0
    assert (np.mean(naive) - truth) / spread < -2.0


def test_sensor_filter_of_the_stock_model():
    stock = ftlm.SensorFilter.low_pass(["theta12"])
    # 157.9137/(s^2 + 22.6195 s + 157.9137): 2 Hz, damping 0.9.
    assert dict((order, c) for c, order in stock.denominator) == {
        2.0: 1.0,
        1.0: pytest.approx(22.6195, abs=5e-5),
        0.0: pytest.approx(157.9137, abs=5e-5),
    }
    assert stock.numerator == ((pytest.approx(157.9137, abs=5e-5), 0.0),)


# ----------------------------------------------------------------------------------------------------------------------
# 3. Initial terms


def relaxation_from_one(t):
    """D^1.8 y + 2 D^0.9 y + y = 0, y(0) = 1, y'(0) = 0 (Caputo): E(-x) + x E'(-x), E the Mittag-Leffler function of
    order 0.9, x = t^0.9; its power series."""
    x = t**0.9
    total, power = np.zeros_like(t), np.ones_like(t)
    for k in range(120):
        weight = 1.0 / gamma(0.9 * k + 1)
        total += weight * (1 - k) * power
        power = -power * x
    return total


def initial_terms_left(duration, exponents):
    """NR of the free run of the true equation with these initial terms, on a record of the scheme itself."""
    m = 2048
    step = duration / m
    terms = [(0.0, 1.0), (0.9, 2 / gamma(1.9))]  # 1 + 2 t^0.9/Gamma(1.9), what D^1.8 and 2 D^0.9 leave behind
    model = ((0, 1.8, [(0, 0.9), (0, 0.0)]), [-2.0, -1.0])
    zero = (step, np.zeros((1, m)), None)
    y = _core.respond(zero, [model], [False], [terms])
    outputs, _, found = _core.respond_with_initial((step, y, None), [model], [False], exponents, None)
    return ftlm.metrics(y[0], outputs[0]).nr, dict(zip(exponents[1], found[0], strict=False)), y[0]


def test_initial_terms_of_the_scheme_are_those_of_caputo():
    # 3 s in 2 048 pulses: the response to the initial terms is the Mittag-Leffler solution to second order.
    _, _, y = initial_terms_left(3.0, (True, []))
    t = np.arange(1, 2048) * 3.0 / 2048
    exact = relaxation_from_one(t)
    late = t > 0.5
    assert np.max(np.abs((y[1:] + y[:-1]) / 2 - exact)[late]) < 2e-6


@pytest.mark.parametrize("duration", [1.0, 2.0, 5.0, 10.0, 20.0])
def test_initial_terms_one_and_t_are_not_enough(duration):
    # The page's NR of 0.155 states no length of record. Measured: 0.216 over 1 s, 0.181 over 2 s, 0.175 from 3 s on.
    measured = {1.0: 0.216, 2.0: 0.181, 5.0: 0.176, 10.0: 0.176, 20.0: 0.175}
    assert initial_terms_left(duration, (False, [0.0, 1.0]))[0] == pytest.approx(measured[duration], abs=0.001)
    assert initial_terms_left(duration, (True, []))[0] <= 1e-12
    nr, found, _ = initial_terms_left(duration, (False, [0.0, 0.9, 1.0]))
    assert nr <= 1e-12
    assert found == {
        0.0: pytest.approx(1, abs=1e-9),
        0.9: pytest.approx(2 / gamma(1.9), abs=1e-9),
        1.0: pytest.approx(0, abs=1e-9),
    }


# ----------------------------------------------------------------------------------------------------------------------
# 3. The two-link arm

DERIVED = """
    D^alpha1 theta11 = a1 D^(alpha1-alpha2+mu2-gamma1+beta2) theta12 + b1 D^gamma1 theta11
                       + d1 D^(alpha1-alpha2+2*mu2-gamma1) theta12 + g1 I1;
    D^alpha2 theta12 = a2 D^beta2 theta12 + b2 D^(2*gamma1-alpha1+alpha2-mu2) theta11
                       + d2 D^mu2 theta12 + g2 D^{input} I1
""".replace("\n                       +", " +")


def two_link(plants, link_friction, shift, input_order):
    """Plant A with all five orders free, alpha_2 and beta_2 moved together."""
    described = plants["A"]
    coefficients = {t["name"]: t["coefficient"] for e in described["equations"] for t in e["terms"]}
    coefficients |= {name: value * link_friction for name, value in coefficients.items() if name[0] == "d"}
    orders = dict(described["free_orders"])
    orders |= {"alpha2": orders["alpha2"] + shift, "beta2": orders["beta2"] + shift}
    law = {"published": "(0*gamma1)", "derived": "(alpha2-mu2+gamma1-alpha1)"}[input_order]
    structure = ftlm.equation(DERIVED.replace("{input}", law)).with_orders(orders).with_coefficients(coefficients)
    return ftlm.Model(replace(structure, coupling="simulated"))


@pytest.mark.parametrize(
    ("input_order", "link_friction", "seen"),
    [("derived", 0.0, False), ("derived", 1.0, True), ("published", 0.0, True)],
)
def test_alpha_2_is_seen_only_through_link_friction(plants, drive, input_order, link_friction, seen):
    run = drive("A", samples=1001)
    plain, shifted = (
        two_link(plants, link_friction, shift, input_order).simulate(run, tolerance=1e-5) for shift in (0.0, -0.1)
    )
    for name in ("theta11", "theta12"):
        moved = np.max(np.abs(shifted[name] - plain[name])) / np.max(np.abs(plain[name]))
        assert moved > 1e-3 if seen else moved < 1e-5, name


def test_written_out_law_is_the_structure_of_flexible_link(plants, plant):
    written = two_link(plants, 1.0, 0.0, "published")
    built = plant("A")
    for ours, theirs in zip(written.equations, built.equations, strict=True):
        assert ours.order == theirs.order
        assert [(t.signal, t.order.constant, t.fixed_value) for t in ours.terms] == [
            (t.signal, t.order.constant, t.fixed_value) for t in theirs.terms
        ]


EFFECTIVE = {
    "a1": 628.889,
    "b1": -62.956,
    "g1": 140.471,
    "a2": -863.332,
    "a3": 2271.117,
    "b3": -496.763,
    "d3": 28.351,
    "g3": 288.122,
    "a4": -3336.200,
    "d4": -41.647,
}


@pytest.mark.parametrize("name", EFFECTIVE)
def test_effective_parameters(name):
    found = ftlm.flexible_link(form="published", stage="both", parameters="effective").nominal_values[name]
    # a2 is -863.3325…: it rounds to -863.333 where the page, cutting, has -863.332.
    assert found == pytest.approx(EFFECTIVE[name], abs=0.0011 if name == "a2" else 0.0006)


def test_printed_a4_differs_in_the_fourth_digit():
    effective = ftlm.flexible_link(form="published", stage=2, parameters="effective")
    assert effective.nominal_values["a4"] - -3336.18 == pytest.approx(-0.02, abs=0.005)


@pytest.mark.parametrize(("name", "value"), [("a1", "42.4"), ("g1", "1.87"), ("d3", "285")])
def test_table_3_parameters(name, value):
    found = ftlm.flexible_link(form="published", stage="both", parameters="table-3").nominal_values[name]
    assert f"{found:.3g}" == value


def test_how_table_3_differs_from_the_effective_parameters():
    effective, printed = ftlm.PARAMETER_SETS["effective"], ftlm.PARAMETER_SETS["table-3"]
    for stage in (1, 2):
        assert effective[stage].stiffness / printed[stage].stiffness == pytest.approx(14.8, abs=0.06)
    assert printed[2].link_friction / effective[2].link_friction == pytest.approx(10, rel=1e-3)
    assert (printed[1].link_friction, effective[1].link_friction) == (0.421, 0.0)
    assert effective[1].torque_constant == pytest.approx(8.925)
    assert effective[2].torque_constant == pytest.approx(0.87)
    assert printed[2].torque_constant == 0.0234


# ----------------------------------------------------------------------------------------------------------------------
# 4. Multi-innovation least squares


@pytest.fixture(scope="module")
def regressors_a(record_a):
    """Haar-coordinate regressors and outputs of both of Plant A's equations, by the dense matrices of the oracle."""
    found, structure = record_a
    phi = oracles.haar_matrix(2048)
    made = {}
    for item in structure.equations:
        signals = [found.of(t.signal) for t in item.terms]
        orders = [t.order.constant for t in item.terms]
        plain = oracles.regressors(signals, orders, item.order.constant, 2048 * found.step, haar=False)
        made[item.output] = (plain, phi @ plain, found.of(item.output), phi @ found.of(item.output))
    return made


@pytest.mark.parametrize("k0", [1.0, 100.0])
@pytest.mark.parametrize("p", [1, 3, 5, 7])
@pytest.mark.parametrize("output", ["theta11", "theta12"])
def test_recursion_equals_its_closed_form(record_a, regressors_a, output, p, k0):
    found, structure = record_a
    (item,) = (e for e in structure.equations if e.output == output)
    arguments = (
        [found.core()],
        structure_tuple(item, found.signals),
        list(found.inputs),
        [None] * 4,
        REST,
        p,
        k0,
        True,
    )
    closed = np.array(_core.multi_innovation(*arguments, False)[0][0])
    (last, *_), trace = _core.multi_innovation(*arguments, True)
    size = np.max(np.abs(closed))
    assert trace.shape == (2048, 4)
    assert np.array_equal(trace[-1], last)
    assert np.max(np.abs(last - closed)) <= 1e-9 * size
    _, q, _, y = regressors_a[output]
    oracle = oracles.multi_innovation_closed_form(q, y, p, k0)
    assert np.max(np.abs(closed - oracle)) <= 1e-9 * size


def test_recursion_is_that_of_the_oracle_step_by_step(record_a, regressors_a):
    found, structure = record_a
    item = structure.equations[0]
    _, q, _, y = regressors_a["theta11"]
    path = oracles.multi_innovation_recursion(q[:300], y[:300], 3, 1.0)
    arguments = ([found.core()], structure_tuple(item, found.signals), list(found.inputs), [None] * 4, REST)
    _, trace = _core.multi_innovation(*arguments, 3, 1.0, True, True)
    np.testing.assert_allclose(trace[:300], path, rtol=1e-9, atol=1e-9 * np.abs(path).max())


@pytest.mark.parametrize("output", ["theta11", "theta12"])
def test_batch_least_squares_agrees_in_haar_and_block_pulse_coordinates(record_a, regressors_a, output):
    found, structure = record_a
    (item,) = (e for e in structure.equations if e.output == output)
    arguments = ([found.core()], structure_tuple(item, found.signals), list(found.inputs), [None] * 4, REST)
    batch = _core.least_squares(*arguments)[0]
    plain, haar, y, y_haar = regressors_a[output]
    np.testing.assert_allclose(oracles.least_squares(haar, y_haar), batch, rtol=1e-11)
    np.testing.assert_allclose(oracles.least_squares(plain, y), batch, rtol=1e-11)
    # p = 1 weighs all rows alike, so the coordinates do not matter there either.
    haar_rows, time_rows = (_core.multi_innovation(*arguments, 1, 1e8, h, False)[0][0] for h in (True, False))
    np.testing.assert_allclose(haar_rows, time_rows, rtol=1e-11)


def test_every_innovation_length_tends_to_least_squares(record_a):
    found, structure = record_a
    item = structure.equations[0]
    arguments = ([found.core()], structure_tuple(item, found.signals), list(found.inputs), [None] * 4, REST)
    batch = np.array(_core.least_squares(*arguments)[0])
    for p in (1, 7):
        far, near, nearest = (
            np.max(np.abs(np.array(_core.multi_innovation(*arguments, p, k0, True, False)[0][0]) / batch - 1))
            for k0 in (1e8, 1e10, 1e12)
        )
        assert far > near > nearest
        # The residuals of the last p - 1 rows are discretisation here, so p > 1 keeps a trace of its weights.
        assert nearest < 1e-6


PRINTED_A1 = {1: -0.5002, 3: -0.7798, 5: -0.8789, 7: -0.9302}


@pytest.mark.parametrize("p", PRINTED_A1)
def test_printed_a1_column_is_a_prior_weighed_against_the_data(p):
    assert -1.0824 * p / (p + 1.164) == pytest.approx(PRINTED_A1[p], rel=0.003)


PRINTED_COLUMNS = {
    # p = 1, 3, 5, 7 of the paper's tables, and how closely x p/(p + c) follows: a2 has two strong directions.
    "a1": ((-0.5002, -0.7798, -0.8789, -0.9302), 0.003),
    "a3": ((-0.8114, -1.0049, -1.0556, -1.0791), 0.003),
    "a2": ((-0.7308, -0.9449, -1.1164, -1.2655), 0.1),
}


@pytest.mark.parametrize("name", PRINTED_COLUMNS)
def test_printed_columns_follow_x_p_over_p_plus_c(name):
    column, share = PRINTED_COLUMNS[name]
    p = np.array([1.0, 3.0, 5.0, 7.0])
    # 1/a = 1/x + (c/x)/p: a straight line in 1/p.
    slope, level = np.polyfit(1 / p, 1 / np.array(column), 1)
    x, c = 1 / level, slope / level
    miss = np.max(np.abs(x * p / (p + c) / column - 1))
    assert miss <= share
    if name == "a1":
        assert (x, c) == (pytest.approx(-1.0824, rel=0.003), pytest.approx(1.164, rel=0.005))
    if name == "a2":
        assert miss > 0.02


def test_one_coefficient_follows_x_p_over_p_plus_c():
    # What the column shows, on the estimator itself: with one coefficient the prior of K0 = 1 is worth c = 1/|q|^2
    # rows, but for the p - 1 last rows, which are used less often and here carry nothing.
    m, step = 256, 0.01
    u = np.zeros(m)
    u[:128] = 12.0
    y = -1.0824 * _core.fractional_integral(u[None], 1.5, step, "block-pulse")[0]
    q = _core.fractional_integral(u[None], 1.5, step, "block-pulse")[0]
    arguments = ([(step, np.stack([y, u]), None)], (0, 1.5, [(1, 0.0)]), [False, True], [None], REST)
    tail = np.cumsum((oracles.haar_matrix(m) @ q)[::-1] ** 2)
    for p in (1, 3, 5, 7):
        found = _core.multi_innovation(*arguments, p, 1.0, True, False)[0][0][0]
        c = 1 / np.sum(q**2)
        lost = np.sum(tail[: p - 1])
        assert lost < 0.01 * p * np.sum(q**2)
        assert found == pytest.approx(-1.0824 * p / (p + c), rel=0.01)


# ----------------------------------------------------------------------------------------------------------------------
# 5. The two errors and near-identities


def equation_error_search(run, structure, alpha):
    lattice = ftlm.order_grid(alpha=alpha)
    return ftlm.search_orders(
        run, structure, lattice, criterion="equation-error", coefficients="least-squares", norm="l2", top=3
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_equation_error_prefers_near_identities_at_alpha_2(clean_a, with_noise, seed):
    found = equation_error_search(
        with_noise(clean_a, 1e-4, seed), ftlm.flexible_link(form="published").equation("theta12"), (2.0, 2.0)
    )
    assert found.candidates == 31_980
    assert (found.orders["beta2"], found.orders["mu2"]) == (1.95, 1.90)
    assert found.coefficients["a2"] == pytest.approx(2.16, abs=0.005)
    assert found.coefficients["d2"] == pytest.approx(-1.17, abs=0.005)
    compared = found.model.compare(with_noise(clean_a, 1e-4, seed))
    assert compared.equation_error["theta12"].nr < 0.01
    assert compared.output_error["theta12"].nr == pytest.approx(172, rel=0.03)
    (warning,) = compared.warnings
    assert "orders 1.95, 1.9 are close to alpha = 2" in warning
    assert "Do not use the model with these orders" in warning


@pytest.mark.parametrize("seed", [0, 1])
def test_equation_error_prefers_near_identities_over_all_alpha(clean_a, with_noise, seed):
    run = with_noise(clean_a, 1e-4, seed)
    found = equation_error_search(run, ftlm.flexible_link(form="published").equation("theta12"), (1.05, 2.0))
    assert found.candidates == 313_845  # the lattice of P1
    assert {n: found.orders[n] for n in ("alpha2", "beta2", "mu2")} == {"alpha2": 1.05, "beta2": 1.0, "mu2": 0.95}
    compared = found.model.compare(run)
    assert compared.output_error["theta12"].nr == pytest.approx(0.42, abs=0.01)
    assert any("the equation nearly says that theta12 equals itself" in w for w in compared.warnings)
    # The truth is on the lattice, and its free run is ten times better.
    truth = {"alpha2": 2.0, "beta2": 0.1, "gamma2": 1.05, "mu2": 0.85}
    right = ftlm.identify(
        run, ftlm.flexible_link(form="published").equation("theta12").with_orders(truth), method="least-squares"
    )
    assert right.output_error["theta12"].nr < 0.05


def test_least_squares_at_the_true_orders_is_biased_by_noise(clean_a, record_a):
    # Noise of 1e-3 rad on each of the 2 048 means of both angles, 30 seeds; the page has -212 (-764 to +79), its own
    # seeds. The standard deviation of one is about 170, of the mean 31.
    found, structure = record_a
    equation, inputs = structure_tuple(structure.equations[1], found.signals), list(found.inputs)
    estimates = []
    for seed in range(30):
        means = found.means.copy()
        means[:2] += 1e-3 * np.random.default_rng(seed).standard_normal((2, 2048))
        core = (found.step, means, None)
        estimates.append(_core.least_squares([core], equation, inputs, [None] * 4, REST)[0][0])
    assert np.mean(estimates) == pytest.approx(-212, abs=3.5 * 170 / np.sqrt(30))
    assert np.std(estimates, ddof=1) == pytest.approx(170, rel=0.45)
    assert min(estimates) == pytest.approx(-764, abs=150)
    assert max(estimates) == pytest.approx(79, abs=150)


@pytest.mark.slow
def test_least_squares_bias_with_noise_on_point_samples(clean_a, with_noise, record_a):
    # The same noise on the 5 000 point samples is averaged by the pulses: -322 on average, standard deviation 198.
    structure = replace(record_a[1], coefficient_law=())
    estimates = [
        ftlm.identify(with_noise(clean_a, 1e-3, seed), structure, method="least-squares", m=2048).coefficients["a2"]
        for seed in range(30)
    ]
    assert np.mean(estimates) == pytest.approx(-322, abs=3.5 * 198 / np.sqrt(30))
    assert np.mean(estimates) > -863.25 / 2


# ----------------------------------------------------------------------------------------------------------------------
# 7. Plants


def test_plant_a_standard_deviations(clean_a):
    assert clean_a.length == 5000
    assert np.std(clean_a["theta11"]) == pytest.approx(0.297, abs=0.0005)
    assert np.std(clean_a["theta12"]) == pytest.approx(0.0280, abs=0.00005)


def test_plant_a_standard_deviations_with_derived_input_order(plants, drive):
    free = {n: v for n, v in plants["A"]["free_orders"].items() if n != "alpha2"}
    coefficients = {t["name"]: t["coefficient"] for e in plants["A"]["equations"] for t in e["terms"]}
    model = ftlm.link_model(stage=1, orders=free, coefficients=coefficients, input_order="derived")
    assert model.equations[1].terms[3].order.constant == plants["A"]["derived_input_order"] == 0.1
    run = model.simulate(drive("A"), tolerance=1e-8)
    assert np.std(run["theta11"]) == pytest.approx(0.2026, abs=0.00005)
    assert np.std(run["theta12"]) == pytest.approx(0.01733, abs=0.000005)


@pytest.mark.parametrize("coefficients", ["least-squares"])
def test_search_finds_plant_a_from_clean_samples(clean_a, coefficients):
    structure = ftlm.flexible_link(form="published").equation("theta12")
    found = ftlm.search_orders(clean_a, structure, ftlm.order_grid(alpha=(1.05, 2.0)), coefficients=coefficients)
    assert found.candidates == 313_845
    # Own orders are unordered within the signal: the larger comes first.
    assert found.orders == {"alpha2": 2.0, "beta2": 0.85, "gamma2": 1.05, "mu2": 0.1}
    assert found.coefficients["d2"] == pytest.approx(-863.25, rel=1e-3)
    assert found.table[1].score > 3 * found.score


def test_plant_a_hub_orders_are_found_from_clean_samples(clean_a):
    structure = ftlm.flexible_link(form="published").equation("theta11")
    found = ftlm.search_orders(clean_a, structure, ftlm.order_grid(alpha=(1.8, 2.0)), coefficients="least-squares")
    assert found.orders == {"alpha1": 2.0, "beta1": 0.75, "gamma1": 0.95, "mu1": 0.0}
    assert found.coefficients["d1"] == pytest.approx(628.89, rel=1e-3)


LEAST_SQUARES_3T = {
    40: ((-0.6255, 0.0034), (-1.2498, 0.0013), (1.2501, 0.0040)),
    20: ((-0.6266, 0.037), (-1.2355, 0.022), (1.2450, 0.050)),
    10: ((-0.5996, 0.11), (-1.1613, 0.080), (1.1565, 0.204)),
}


@pytest.mark.parametrize("snr", LEAST_SQUARES_3T)
def test_least_squares_column_of_3t(snr):
    # 50 runs of our own seeds: means within 3.5 standard errors of the two together, spreads within a factor of 1.7.
    m, duration = 2048, 20.0
    step = duration / m
    u = np.sign(np.sin(2 * np.pi * (np.arange(m) + 0.5) * step / 5))
    equation = (0, 2.2, [(0, 0.9), (0, 0.0), (1, 0.0)])
    clean = _core.respond(steps(u, step), [(equation, [-0.625, -1.25, 1.25])], [False, True], [[]])[0]
    found = []
    for seed in range(50):
        noise = np.std(clean) * 10 ** (-snr / 20) * np.random.default_rng(seed).standard_normal(m)
        run = (step, np.stack([clean + noise, u]), None)
        found.append(_core.least_squares([run], equation, [False, True], [None] * 3, REST)[0])
    for column, (mean, spread) in zip(np.transpose(found), LEAST_SQUARES_3T[snr], strict=True):
        ours = np.std(column, ddof=1)
        assert abs(np.mean(column) - mean) < 3.5 * np.hypot(ours, spread) / np.sqrt(50)
        assert spread / 1.7 < ours < 1.7 * spread


# ----------------------------------------------------------------------------------------------------------------------
# 8. The lattice of P1


def test_lattice_of_p1_has_313_845_candidates():
    structure = ftlm.flexible_link(form="published").equation("theta12")
    values = ftlm.order_grid(alpha=(1.05, 2.0)).values(structure)
    term = {n: list(values[n]) for n in values}
    axes = [(0, term["beta2"], True), (1, term["gamma2"], False), (0, term["mu2"], True), (2, [0.0], False)]
    assert _core.order_grid_size((0, term["alpha2"], axes), [False, False, True]) == 313_845
    # Counted by hand: unordered pairs 0 <= mu < beta < alpha and 0 <= gamma <= alpha on the step 0.05.
    alphas = range(21, 41)
    assert sum(n * (n - 1) // 2 * (n + 1) for n in alphas) == 313_845
    assert len(values["alpha2"]) == len(alphas)


def test_equation_error_of_the_truth_is_what_discretisation_leaves(record_a, plant):
    # Outputs are linear between samples 2 ms apart and integrated twice: a tenth of a milliradian after 10 s.
    found, _ = record_a
    for item, left in zip(plant("A").equations, (2.6e-4, 2.76e-3), strict=True):
        y = found.of(item.output)
        residual = _core.equation_error(found.core(), equation_tuple(item, found.signals), list(found.inputs), REST)
        assert ftlm.metrics(y, y - residual).nr == pytest.approx(left, rel=0.05)
