"""The paper's structure: order law, coefficient law, parameter sets and every option of the two-link arm."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec import UNSET

import ftlm
from ftlm.order_search.options import SearchSettings
from ftlm.order_search.search import make_job
from ftlm.utils.checkpoint_file import RECORD_ENCODER

pytestmark = pytest.mark.usefixtures("no_extension_tests")

FREE = {1: ("alpha1", "beta2", "alpha2", "gamma1", "mu2"), 2: ("alpha3", "beta4", "alpha4", "gamma3", "mu4")}


def orders_of(structure):
    return {
        e.output: (str(e.order), [(t.signal, str(t.order), t.coefficient) for t in e.terms])
        for e in structure.equations
    }


# ----------------------------------------------------------------------------------------------------------------------
# The laws


@pytest.mark.parametrize("name", ["A", "A2"])
def test_plants_follow_from_their_free_orders_and_coefficients(plants, name):
    described = plants[name]
    stage = described["stage"]
    law = ftlm.order_law(stage, form="published")
    found = {key: order.at(described["free_orders"]) for key, order in law.items()}
    for key, value in {**described["free_orders"], **described["derived_orders"], "input": 0.0}.items():
        assert found[key] == value, key
    derived = ftlm.order_law(stage, "derived")["input"]
    assert derived.at(described["free_orders"]) == described["derived_input_order"]

    structure = ftlm.flexible_link(form="published", stage=stage)
    at = structure.with_orders(described["free_orders"])
    for item, expected in zip(at.equations, described["equations"], strict=True):
        assert item.output == expected["output"]
        assert item.order.constant == expected["alpha"]
        for term, wanted in zip(item.terms, expected["terms"], strict=True):
            assert (term.signal, term.coefficient) == (wanted["signal"], wanted["name"])
            assert term.order.constant == wanted["order"], wanted["name"]
    # The coefficient law gives the deflection's coefficients from the hub's and r.
    printed = described["law_coefficients"]
    hub = 2 * stage - 1
    values = {f"{letter}{hub}": printed[letter] for letter in "abdg"} | {f"r{stage}": printed["r"]}
    expected = {t["name"]: t["coefficient"] for e in described["equations"] for t in e["terms"]}
    for dependent, sign, factors in structure.coefficient_law:
        assert sign * np.prod([values[f] for f in factors]) == pytest.approx(expected[dependent], rel=1e-14)
    assert {name for name, _, _ in structure.coefficient_law} == {f"{letter}{hub + 1}" for letter in "abdg"}


@pytest.mark.parametrize("stage", [1, 2])
def test_integer_orders_obey_the_law(stage):
    h, d = 2 * stage - 1, 2 * stage
    free = {f"alpha{h}": 2.0, f"alpha{d}": 2.0, f"gamma{h}": 1.0, f"beta{d}": 0.0, f"mu{d}": 1.0}
    for input_order in ("published", "derived"):
        found = {name: order.at(free) for name, order in ftlm.order_law(stage, input_order).items()}
        assert found == free | {f"beta{h}": 0.0, f"mu{h}": 1.0, f"gamma{d}": 1.0, "input": 0.0}


def test_inertia_ratio_and_coefficients_of_parameters():
    link = ftlm.LinkParameters(
        stiffness=6.0, hub_inertia=2.0, link_inertia=4.0, hub_friction=1.0, link_friction=0.5, torque_constant=3.0
    )
    assert link.inertia_ratio == 1.5
    assert link.coefficients(2) == {
        "a3": 3.0,
        "b3": -0.5,
        "d3": 0.25,
        "g3": 1.5,
        "a4": -4.5,
        "b4": 0.5,
        "d4": -0.375,
        "g4": -1.5,
    }


# ----------------------------------------------------------------------------------------------------------------------
# The structure


@pytest.mark.parametrize("stage", [1, 2])
def test_published_structure(stage):
    h, d = 2 * stage - 1, 2 * stage
    hub, deflection, current = f"theta{stage}1", f"theta{stage}2", f"I{stage}"
    structure = ftlm.flexible_link(form="published", stage=stage)
    assert structure.coupling == "simulated"
    assert structure.has_order_law
    assert set(structure.order_names) == set(FREE[stage])
    assert structure.signals == (hub, deflection, current)
    assert structure.coefficient_names == tuple(f"{c}{n}" for n in (h, d) for c in "abdg")
    assert structure.sensor_filter is None
    assert structure.name == f"flexible link, stage {stage}"
    terms = {t.coefficient: t for e in structure.equations for t in e.terms}
    assert [terms[f"{c}{h}"].signal for c in "abdg"] == [deflection, hub, deflection, current]
    assert [terms[f"{c}{d}"].signal for c in "abdg"] == [deflection, hub, deflection, current]
    assert str(terms[f"g{d}"].order) == "0"


@pytest.mark.parametrize("stage", [1, 2])
def test_derived_structure_fixes_alpha_of_the_deflection(stage):
    h, d = 2 * stage - 1, 2 * stage
    structure = ftlm.flexible_link(form="published", stage=stage, input_order="derived")
    assert set(structure.order_names) == set(FREE[stage]) - {f"alpha{d}"}
    assert structure.equations[1].order == ftlm.Order(2.0)
    current = structure.equations[1].terms[3]
    assert current.order == ftlm.Order.parse(f"2 - mu{d} + gamma{h} - alpha{h}")


def test_without_laws_every_order_is_its_own():
    structure = ftlm.flexible_link(form="published", laws=())
    assert not structure.has_order_law
    assert structure.coefficient_law == ()
    assert orders_of(structure) == {
        "theta11": (
            "alpha1",
            [("theta12", "beta1", "a1"), ("theta11", "gamma1", "b1"), ("theta12", "mu1", "d1"), ("I1", "0", "g1")],
        ),
        "theta12": (
            "alpha2",
            [("theta12", "beta2", "a2"), ("theta11", "gamma2", "b2"), ("theta12", "mu2", "d2"), ("I1", "0", "g2")],
        ),
    }


def test_laws_are_chosen_one_by_one():
    orders_only = ftlm.flexible_link(form="published", laws=("orders",))
    assert orders_only.has_order_law
    assert orders_only.coefficient_law == ()
    coefficients_only = ftlm.flexible_link(form="published", laws=("coefficients",))
    assert not coefficients_only.has_order_law
    assert len(coefficients_only.coefficient_law) == 4


@pytest.mark.parametrize("laws", [("orders",), ()])
def test_one_equation_alone_has_its_own_orders(laws):
    structure = ftlm.flexible_link(form="published", laws=laws)
    hub, deflection = structure.equation("theta11"), structure.equation("theta12")
    assert hub.order_names == ("alpha1", "beta1", "gamma1", "mu1")
    assert deflection.order_names == ("alpha2", "beta2", "gamma2", "mu2")
    for single in (hub, deflection):
        assert single.coupling == "measured"
        assert not single.has_order_law
        assert single.coefficient_law == ()
        assert str(single.equations[0].terms[3].order) == "0"  # of the current, unless it is named
    assert hub.name == "flexible link, stage 1, theta11"
    with pytest.raises(ftlm.ModelError, match="output 'theta21' does not occur in the equation"):
        structure.equation("theta21")


def test_one_derived_equation_alone_takes_the_current_as_it_is():
    single = ftlm.flexible_link(form="published", input_order="derived").equation("theta12")
    assert single.order_names == ("beta2", "gamma2", "mu2")
    assert single.equations[0].terms[3].order == ftlm.Order()


def test_cross_stage_terms():
    structure = ftlm.flexible_link(form="published", stage=1, coupling="measured", cross_stage=True)
    assert structure.signals == ("theta11", "theta12", "I1", "I2", "theta21", "theta22")
    for item, n in zip(structure.equations, (1, 2), strict=True):
        extra = [(t.signal, t.coefficient, t.order.constant) for t in item.terms[4:]]
        assert extra == [("theta21", f"p{n}", 0.0), ("theta22", f"q{n}", 0.0), ("I2", f"s{n}", 0.0)]
    second = ftlm.flexible_link(form="published", stage=2, coupling="measured", cross_stage=True)
    assert second.signals == ("theta21", "theta22", "I1", "I2", "theta11", "theta12")


def test_friction_terms():
    structure = ftlm.flexible_link(form="published", stage=2, coupling="measured", friction=True)
    assert [e.terms[-1] for e in structure.equations] == [
        ftlm.Term("coulomb_theta21", ftlm.Order(), "c3"),
        ftlm.Term("coulomb_theta21", ftlm.Order(), "c4"),
    ]
    with pytest.raises(ftlm.ModelError, match="requires form='lagrange', in which hub friction"):
        ftlm.flexible_link(form="published", friction=True)
    followed = ftlm.flexible_link(stage=2, coupling="simulated", friction=True)
    assert [e.friction for e in followed.equations] == [ftlm.Friction("fc2"), None]
    assert "coulomb_theta21" not in followed.signals


def test_both_stages():
    structure = ftlm.flexible_link(form="published", stage="both")
    assert structure.outputs == ("theta11", "theta12", "theta21", "theta22")
    assert set(structure.order_names) == {*FREE[1], *FREE[2]}
    assert len(structure.coefficient_law) == 8
    assert len(ftlm.flexible_link(form="published", stage="both", parameters="effective").nominal_values) == 16
    # Nominal values are those of one arm, so another arm has none.
    assert structure.nominal_values == ftlm.flexible_link(stage=2).nominal_values == {}
    assert structure.name == "flexible link, both stages"
    first, second = ftlm.flexible_link(form="published", stage=1), ftlm.flexible_link(form="published", stage=2)
    assert structure.equations == first.equations + second.equations
    coupled = ftlm.flexible_link(form="published", stage="both", cross_stage=True)
    assert {t.signal for t in coupled.equations[0].terms} >= {"theta21", "theta22", "I2"}
    derived = ftlm.flexible_link(form="published", stage="both", input_order="derived")
    assert {e.order.constant for e in (derived.equations[1], derived.equations[3])} == {2.0}


@pytest.mark.parametrize(("stage", "outputs"), [(1, ("theta12",)), (2, ("theta22",)), ("both", ("theta12", "theta22"))])
def test_stock_sensor_filter(stage, outputs):
    sensor = ftlm.flexible_link(form="published", stage=stage, sensor_filter="stock").sensor_filter
    assert sensor == ftlm.SensorFilter.low_pass(outputs)
    own = ftlm.SensorFilter.low_pass(["theta12"], frequency=5.0, damping=0.7)
    assert ftlm.flexible_link(form="published", sensor_filter=own).sensor_filter is own


def test_sensor_filter_follows_its_output_into_one_equation():
    structure = ftlm.flexible_link(form="published", stage="both", sensor_filter="stock")
    assert structure.equation("theta11").sensor_filter.signals == ("theta12",)
    assert structure.equation("theta22").sensor_filter.signals == ("theta22",)
    # A deflection that drives a stage passed the filter as well as the one that is modelled.
    pushed = ftlm.flexible_link(stage=2, cross_stage="inertial", sensor_filter="stock")
    assert pushed.sensor_filter.signals == ("theta12", "theta22")
    assert ftlm.flexible_link(stage=1, cross_stage=True, sensor_filter="stock").equation("theta12").all_filtered
    uncoupled = ftlm.equation("D y = a y; D z = b z", sensor_filter=ftlm.SensorFilter.low_pass(["z"]))
    assert uncoupled.equation("y").sensor_filter is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"stage": 3}, "stage = 3 is not known; use 1, 2 or 'both'"),
        ({"stage": "1"}, "stage = '1' is not known"),
        ({"input_order": "other"}, "input_order = 'other' is not known; use 'published' or 'derived'"),
        ({"coupling": "loose"}, "coupling = 'loose' is not known; use 'measured' or 'simulated'"),
        ({"laws": ("order",)}, "law 'order' is not known; use 'orders', 'coefficients', both or ()"),
        ({"laws": "orders"}, "law 'o' is not known"),
        ({"parameters": "table-4"}, "parameters = 'table-4' is not known; use 'effective' or 'table-3'"),
        ({"sensor_filter": "low-pass"}, "sensor_filter = 'low-pass' is not known; use 'stock' or a SensorFilter"),
        ({"sensor_filter": ftlm.SensorFilter.low_pass(["theta22"])}, "filtered signal 'theta22' does not occur"),
    ],
)
def test_options_that_are_not_known_are_refused(options, message):
    with pytest.raises(ftlm.ModelError) as refused:
        ftlm.flexible_link(form="published", **options)
    assert message in str(refused.value)
    with pytest.raises(ftlm.ModelError, match="stage = 3 is not known"):
        ftlm.order_law(3)


# ----------------------------------------------------------------------------------------------------------------------
# Models with everything known


def test_manual_model_is_the_integer_rows_of_the_paper():
    model = ftlm.link_model(stage=1, form="published")
    assert model.orders == {"alpha1": 2.0, "beta2": 0.0, "alpha2": 2.0, "gamma1": 1.0, "mu2": 1.0}
    assert model.coefficients == ftlm.PARAMETER_SETS["effective"][1].coefficients(1)
    assert model.units == {"theta11": "rad", "theta12": "rad", "I1": "A"}
    assert str(model).splitlines()[0] == (
        "D^2 theta11 = 628.889 theta12 - 62.9562 D^1 theta11 + 0 D^1 theta12 + 140.471 I1"
    )
    assert model.about == {"origin": "parameters effective"}


def test_the_manuals_model_is_one_in_either_form():
    lagrange, published = ftlm.link_model(stage="both"), ftlm.link_model(stage="both", form="published")
    assert lagrange.structure.coupling == "simulated"
    assert str(lagrange).splitlines()[1].startswith("D^2 theta12 = -234.444 theta12 - 1 D^2 theta11")
    w = np.geomspace(0.1, 100.0, 20)
    published_response = published.frequency_response(w)
    assert (
        np.max(
            np.abs(lagrange.frequency_response(w) - published_response)[published_response != 0]
            / np.abs(published_response[published_response != 0])
        )
        < 1e-10
    )
    with pytest.raises(ftlm.ModelError, match="input_order = 'derived' is not used by form='lagrange'"):
        ftlm.link_model(form="lagrange", input_order="derived")


def test_models_of_other_parameters_orders_and_coefficients():
    link = ftlm.LinkParameters(6.0, 2.0, 4.0, 1.0, 0.5, 3.0)
    model = ftlm.link_model(
        stage=2, parameters={2: link}, orders={"gamma3": 0.9}, coefficients={"g3": 7.0}, form="published"
    )
    assert model.coefficients == link.coefficients(2) | {"g3": 7.0}
    assert model.orders["gamma3"] == 0.9
    assert model.orders["mu4"] == 1.0
    assert model.structure.nominal_values == {}
    assert ftlm.link_model(stage="both", parameters="table-3").coefficients["d3"] == pytest.approx(0.856 / 0.003)
    with pytest.raises(ftlm.ModelError, match="order 'gama3' does not occur in the equation; did you mean gamma3"):
        ftlm.link_model(stage=2, orders={"gama3": 0.9})
    with pytest.raises(ftlm.ModelError, match="coefficient 'a1' does not occur in the equation"):
        ftlm.link_model(stage=2, coefficients={"a1": 1.0})


def test_derived_manual_model_is_the_published_one():
    # With integer orders the current is not differentiated.
    published, derived = (ftlm.link_model(stage=1, input_order=kind) for kind in ("published", "derived"))
    assert [e.terms for e in derived.equations] == [e.terms for e in published.equations]


def test_both_stages_simulate_as_each_alone(plant, drive):
    first, second = plant("A"), plant("A2")
    runs = drive("A", samples=301), drive("A2", samples=301)
    both = ftlm.Model(
        ftlm.flexible_link(form="published", stage="both")
        .with_orders(first.orders | second.orders)
        .with_coefficients(first.coefficients | second.coefficients)
    )
    together = ftlm.Run.from_arrays(
        step=0.002,
        inputs={"I1": runs[0]["I1"], "I2": runs[1]["I2"]},
        outputs={name: np.zeros(301) for name in both.outputs},
    )
    found = both.simulate(together, tolerance=1e-6)
    for model, run in zip((first, second), runs, strict=True):
        alone = model.simulate(run, tolerance=1e-6)
        for name in model.outputs:
            np.testing.assert_allclose(found[name], alone[name], atol=2e-6 * np.abs(alone[name]).max())


def arm_in_motion(rows, noise=0.0):
    """Both stages under one square current; they do not drive each other in the model."""
    from ftlm.reproduction.simulated_arm import demo_plant

    step = 0.002
    current = np.where((np.arange(rows) * step + step / 2) % 2 < 1, 0.3, -0.3)
    rng = np.random.default_rng(0)
    outputs = {}
    for stage in (1, 2):
        names = [f"theta{stage}{k}" for k in (1, 2)]
        blank = ftlm.Run.from_arrays(
            step=step, inputs={f"I{stage}": current}, outputs={n: np.zeros(rows) for n in names}
        )
        clean = demo_plant(stage, form="published").simulate(blank, tolerance=1e-6)
        outputs |= {n: clean[n] + noise * np.std(clean[n]) * rng.standard_normal(rows) for n in names}
    return ftlm.Run.from_arrays(step=step, inputs={"I1": current, "I2": current}, outputs=outputs)


def test_stages_that_share_no_order_are_parts_of_their_own():
    both = ftlm.flexible_link(form="published", stage="both").with_delays({"I2": 0.01})
    parts = both.independent_groups()
    assert list(parts) == ["theta11, theta12", "theta21, theta22"]
    for stage, part in zip((1, 2), parts.values(), strict=True):
        assert part.equations == ftlm.flexible_link(form="published", stage=stage).equations
        assert part.order_names == ftlm.flexible_link(form="published", stage=stage).order_names
    assert [p.delay for p in parts.values()] == [{}, {"I2": 0.01}]
    assert list(ftlm.flexible_link(form="published", stage=1).independent_groups()) == ["stage"]
    assert list(ftlm.flexible_link(form="published", stage=1, laws=()).independent_groups()) == ["theta11", "theta12"]
    assert list(ftlm.equation("D^2 y = a D y + b u").independent_groups()) == []
    # One equation may carry a law by itself, and equations may share an order without one.
    assert list(ftlm.equation("D^alpha y = a D^(alpha-nu) y + b D^nu u").independent_groups()) == ["stage"]
    mixed = ftlm.equation("D^alpha y = a D^nu x + b u; D^kappa x = c D^nu y + d u; D^rho z = e z + f u")
    assert list(mixed.independent_groups()) == ["y, x", "z"]


def test_the_whole_arm_is_searched_stage_by_stage():
    run = arm_in_motion(1025)
    coarse = ftlm.order_grid(
        alpha=(1.9, 2.0),
        **{f"gamma{h}": (0.9, 1.0) for h in (1, 3)},
        **{f"{n}{d}": v for d in (2, 4) for n, v in (("beta", (0.1, 0.2)), ("mu", (0.8, 0.9)))},
    )
    whole = ftlm.identify(
        run, ftlm.flexible_link(form="published", stage="both"), method=ftlm.LeastSquares(order_grid=coarse)
    )
    for stage in (1, 2):
        kept = ("alpha", f"gamma{2 * stage - 1}", f"beta{2 * stage}", f"mu{2 * stage}")
        own = replace(coarse, orders={n: v for n, v in coarse.orders.items() if n in kept})
        alone = ftlm.identify(
            run, ftlm.flexible_link(form="published", stage=stage), method=ftlm.LeastSquares(order_grid=own)
        )
        assert alone.orders.items() <= whole.orders.items()
        assert alone.coefficients.items() <= whole.coefficients.items()


@pytest.mark.slow
def test_the_whole_arm_is_one_joint_fit():
    from ftlm.reproduction.simulated_arm import demo_plant

    found = ftlm.identify(
        arm_in_motion(5000, 0.01), replace(ftlm.flexible_link(form="published", stage="both"), initial="rest")
    )
    assert len(found.joint.names) == 20
    for stage in (1, 2):
        for name, value in demo_plant(stage, form="published").orders.items():
            assert abs(found.orders[name] - value) < 5 * found.standard_errors[name], name
    # One percent of noise leaves 99.00 on average.
    assert min(found.fit.values()) > 98.98


def test_hints_are_kept_by_what_changes_a_structure_and_stand_in_no_file_text_or_comparison(clean_a):
    structure = ftlm.flexible_link(form="published", stage=1, coupling="measured")
    fixed = structure.with_orders({"alpha1": 2.0}).with_coefficients({"a1": 600.0})
    assert fixed.hints.order_names_by_coefficient["a1"] == "beta1"
    assert replace(structure, hints=UNSET) == structure
    assert "hints" not in repr(structure) + str(structure)
    job = make_job(
        [clean_a], structure.equation("theta11"), ftlm.order_grid(increment=0.5), SearchSettings(row_basis="time"), m=64
    )
    assert b"hints" not in RECORD_ENCODER.encode(job.request("theta11"))
    assert set(structure.equation("theta11").order_names) == {"alpha1", "beta1", "gamma1", "mu1"}


def test_a_bound_of_a_coefficient_that_a_law_sets_is_refused_by_the_law():
    structure = ftlm.flexible_link(stage=1, laws=("orders", "coefficients"))
    run = ftlm.Run.from_arrays(
        step=0.01,
        inputs={"I1": np.ones(50)},
        outputs={"theta11": np.linspace(0, 1, 50) ** 2, "theta12": np.linspace(0, 1, 50) ** 3},
    )
    with pytest.raises(ftlm.ModelError, match=r"a2, which follows from the coefficient law a2 = - a1 j1; use 'a1', or"):
        ftlm.identify(run, structure, bounds={"a2": (0.0, 1.0)})
