"""Structures and models of the flexible two-link arm, and its physical parameters.

Equation numbers are those of the paper (Wang et al., Symmetry 2025, 17, 1072). A joint is also called a stage. Its hub
has an odd index (1 or 3), and its link has an even index (2 or 4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from ftlm.errors import ModelError
from ftlm.model.model import Model
from ftlm.structure.equation import Equation, Friction, Stribeck, Term
from ftlm.structure.order import Order
from ftlm.structure.sensor_filter import SensorFilter
from ftlm.structure.structure import Hints, Structure, check_offset
from ftlm.utils.arguments import check_arguments
from ftlm.utils.parameters import choose_text, parameter, setting
from ftlm.utils.validation import check_choice, short_repr


@check_arguments
@dataclass(frozen=True)
class LinkParameters:
    """Physical parameters of one joint of the arm. Units are those for integer orders.

    Parameters
    ----------
    stiffness
        Stiffness K_s of the link [N m/rad].
    hub_inertia, link_inertia
        Inertias J_1 of the hub and J_2 of the link [kg m^2].
    hub_friction, link_friction
        Viscous friction coefficients B_1 of the hub and B_2 of the link [N m s/rad].
    torque_constant
        Torque at the hub per ampere of motor current [N m/A].
    """

    stiffness: float
    hub_inertia: float
    link_inertia: float
    hub_friction: float
    link_friction: float
    torque_constant: float

    @property
    def inertia_ratio(self) -> float:
        """Inertia ratio r = (J_1 + J_2)/J_2 of hub J_1 and link J_2.

        In the published form, coefficients a and d of the deflection equation are -r times those of the hub equation.
        """
        return (self.hub_inertia + self.link_inertia) / self.link_inertia

    def coefficients(self, stage: int) -> dict[str, float]:
        """Return the coefficients a, b, d and g of both equations of joint 1 or 2 in the published form, by name.

        The published form is equations (22)-(25) of the paper, which defines the coefficients after its equation (21).
        """
        hub, deflection = 2 * stage - 1, 2 * stage
        a, b = self.stiffness / self.hub_inertia, -self.hub_friction / self.hub_inertia
        d, g = self.link_friction / self.hub_inertia, self.torque_constant / self.hub_inertia
        r = self.inertia_ratio
        return {
            f"a{hub}": a,
            f"b{hub}": b,
            f"d{hub}": d,
            f"g{hub}": g,
            f"a{deflection}": -a * r,
            f"b{deflection}": -b,
            f"d{deflection}": 0.0 - d * r,
            f"g{deflection}": -g,
        }

    def lagrange_coefficients(self, stage: int) -> dict[str, float]:
        """Return the coefficients of both equations of joint 1 or 2 in the Lagrange form, by name.

        They are a, b, d and g of the hub equation, and a, b and d of the deflection equation, eq. (15) of the paper.
        """
        hub, deflection = 2 * stage - 1, 2 * stage
        values = {n: v for n, v in self.coefficients(stage).items() if n.endswith(str(hub))}
        stiffness, friction = self.stiffness / self.link_inertia, self.link_friction / self.link_inertia
        return values | {f"a{deflection}": -stiffness, f"b{deflection}": -1.0, f"d{deflection}": 0.0 - friction}


#: Named parameter sets, by joint number. "effective" reproduces the integer-order rows of the paper's Tables 4 and 5.
#: Its torque per ampere is the product of gear efficiency, gear ratio and torque constant. "table-3" is the paper's
#: Table 3 as printed. Its stiffnesses are about 14.8 times smaller, and its torque constants are without gear and
#: efficiency.
PARAMETER_SETS: dict[str, dict[int, LinkParameters]] = {
    "effective": {
        1: LinkParameters(39.9572, 0.0635362, 0.170434, 4.0, 0.0, 0.75 * 100 * 0.119),
        2: LinkParameters(6.85775, 0.00301955, 0.0064387, 1.5, 0.085608, 0.75 * 50 * 0.0232),
    },
    "table-3": {
        1: LinkParameters(2.69, 0.0635, 0.1704, 4.0, 0.421, 0.119),
        2: LinkParameters(0.463, 0.003, 0.0064, 1.5, 0.856, 0.0234),
    },
}
#: Integer orders of the manufacturer's manual: hub friction and link damping act on rates, link stiffness on the angle.
#: alpha is 2.
INTEGER_ORDERS = {"gamma": 1.0, "beta": 0.0, "mu": 1.0}


def integer_order(name: str) -> float:
    """Return the integer order in the manufacturer's manual for the name of an order, such as gamma1."""
    return INTEGER_ORDERS.get(name.rstrip("0123456789"), 2.0)


#: Order of the terms by which the torques of the other joint act: they contain its angles and current undifferentiated.
CROSS_ORDER = 0.0
#: Range of the highest order alpha of an equation: that of a link is 2 or slightly less.
HIGHEST_ORDER_RANGE = (1.2, 2.0)
#: Typical orders for initial guesses, at or near the integer orders.
TYPICAL_ORDERS = {"alpha": (2.0,), "gamma": (0.9, 1.0), "beta": (0.0, 0.15), "mu": (0.8, 1.0)}
#: Grids (low, high, increment) of the elasticity and damping orders of a link if its equation is identified alone.
DEFLECTION_ORDER_RANGES = {"beta": (0.0, 0.5, 0.05), "mu": (0.5, 1.95, 0.05)}
#: Name of the order of the term with each coefficient, as in equations (22)-(25) of the paper.
ORDER_OF = {"a": "beta", "b": "gamma", "d": "mu"}
Form: TypeAlias = Literal["lagrange", "published"]
InputOrder: TypeAlias = Literal["published", "derived"]
CrossStage: TypeAlias = Literal["torques", "inertial"] | bool
FrictionLaw: TypeAlias = Literal["coulomb", "stribeck"] | bool
Law: TypeAlias = Literal["orders", "coefficients", "velocities"]
#: Names of the physical laws that can be imposed on orders and coefficients; see :func:`flexible_link`.
LAW_NAMES = ("orders", "coefficients", "velocities")


def _hints(form: Form) -> Hints:
    """Return hints for the initial guesses of a fit, such as typical orders and lower bounds of inertia ratios."""
    return Hints(
        HIGHEST_ORDER_RANGE,
        {f"{order}{n}": values for order, values in TYPICAL_ORDERS.items() for n in range(1, 5)},
        {f"{letter}{n}": f"{order}{n}" for letter, order in ORDER_OF.items() for n in range(1, 5)},
        {"j1": 0.0, "j2": 0.0} if form == "lagrange" else {"r1": 1.0, "r2": 1.0},
        ("a1", "d1", "a3", "d3") if form == "lagrange" else (),
        {"b2": -1.0, "b4": -1.0} if form == "lagrange" else {},
    )


def _resolve_form(form: Form | None, input_order: InputOrder | None) -> tuple[Form, InputOrder]:
    """Return the form and the input order with defaults resolved; an input order selects the published form.

    Raise ModelError if one is unknown, or an input order is given for the Lagrange form.
    """
    if form is None:
        form = "lagrange" if input_order is None else "published"
    check_choice("form", form, ("lagrange", "published"))
    if form == "lagrange" and input_order is not None:
        raise ModelError(
            f"{setting('input_order')} {input_order!r} is not used by {parameter('form', 'lagrange')}, whose "
            f"equation of the deflection has no current; leave it out, or use {parameter('form', 'published')}"
        )
    input_order = input_order or "published"
    check_choice("input_order", input_order, ("published", "derived"))
    return form, input_order


@check_arguments
def order_law(
    stage: int, input_order: InputOrder | None = None, *, form: Form | None = None, velocities: bool = False
) -> dict[str, Order]:
    """Return the order law of one joint: every order of its two equations as a function of five free orders.

    Equation numbers are those of the paper. Indices are those of joint 1: 1 for the hub, 2 for the deflection.

    Parameters
    ----------
    stage
        Number of the joint, 1 or 2.
    input_order
        ``"published"`` or ``"derived"``, only for the published form; see the returned ``input``.
    form
        ``"lagrange"`` or ``"published"``; see :func:`flexible_link`. The default is ``"lagrange"``, or ``"published"``
        if an input order is given.
    velocities
        Whether gamma_1 = mu_2. The terms D^gamma_1 theta_11 and D^mu_2 theta_12, which equation (8) adds, then have the
        same order. The order of the hub angle in the deflection equation (15) is then alpha_2.

    Returns
    -------
    dict
        Orders by name: alpha, beta, gamma, mu of the hub (index 2*stage - 1) and of the deflection (index 2*stage). The
        order of the hub angle in the deflection equation is gamma_2 = alpha_2 - mu_2 + gamma_1 by (15), which exceeds
        alpha_2 if gamma_1 exceeds mu_2. In the published form it is 2 gamma_1 - alpha_1 + alpha_2 - mu_2. The published
        form also has ``input``, the order of the current in the deflection equation. It is 0 with the input order
        ``"published"``, as in (23), and alpha_2 - mu_2 + gamma_1 - alpha_1 with ``"derived"``.

    Raises
    ------
    ModelError
        If the stage is neither 1 nor 2, or a form or input order is unknown or does not belong to the form.
    """
    if stage not in (1, 2):
        raise ModelError(f"{setting('stage')} {stage!r} is not known; use 1, 2 or 'both'")
    form, input_order = _resolve_form(form, input_order)
    h, d = 2 * stage - 1, 2 * stage
    law = {
        f"alpha{h}": f"alpha{h}",
        f"beta{h}": f"alpha{h} - alpha{d} + mu{d} - gamma{h} + beta{d}",
        f"gamma{h}": f"gamma{h}",
        f"mu{h}": f"alpha{h} - alpha{d} + 2*mu{d} - gamma{h}",
        f"alpha{d}": f"alpha{d}",
        f"beta{d}": f"beta{d}",
        f"gamma{d}": f"alpha{d} - mu{d} + gamma{h}",
        f"mu{d}": f"mu{d}",
    }
    if form == "published":
        law[f"gamma{d}"] = f"2*gamma{h} - alpha{h} + alpha{d} - mu{d}"
        law["input"] = f"alpha{d} - mu{d} + gamma{h} - alpha{h}" if input_order == "derived" else "0"
    if velocities:
        law = {name: text.replace(f"gamma{h}", f"mu{d}") for name, text in law.items()}
    return {name: Order.parse(text) for name, text in law.items()}


#: Beginning of the names of these structures.
FLEXIBLE_LINK = "flexible link"


@check_arguments
def flexible_link(
    *,
    stage: Literal[1, 2, "both"] = 1,
    form: Form | None = None,
    input_order: InputOrder | None = None,
    coupling: Literal["simulated", "measured"] | None = None,
    cross_stage: CrossStage = False,
    friction: FrictionLaw = False,
    cross_sensitivity: bool = False,
    cross_damping: bool = False,
    hub: bool = True,
    laws: Sequence[Law] = ("orders", "coefficients"),
    parameters: Literal["effective", "table-3"] | None = None,
    sensor_filter: SensorFilter | Literal["stock"] | None = None,
    offset: Literal["none", "level", "constant", "ramp"] = "none",
) -> Structure:
    """Return the structure of a flexible joint: an equation of its hub angle and one of its link's deflection.

    Equation numbers are those of the paper. Indices are those of joint 1: 1 for the hub, 2 for the link. K_s is the
    stiffness, B a viscous friction coefficient, and J an inertia.

    Parameters
    ----------
    stage
        Joint: 1 (theta11, theta12, I1), 2 (theta21, theta22, I2) or ``"both"``.
    form
        ``"lagrange"`` (default): the Euler-Lagrange equations (14)-(15) with (16), without elimination. The equation of
        the deflection is D^alpha_2 theta_12 = a_2 D^beta_2 theta_12 - D^(alpha_2 - mu_2 + gamma_1) theta_11 + d_2
        D^mu_2 theta_12 with a_2 = -K_s/J_2 and d_2 = -B_2/J_2. Its only input is the hub angle, whose order exceeds
        alpha_2 if gamma_1 exceeds mu_2. The equation of the hub is (17). ``"published"``: equations (22)-(25) as
        printed, for comparison with the paper. They eliminate the acceleration of the hub from the equation of the
        deflection, and drop a derivative of the current. With fractional orders, the simulated deflection then has the
        wrong sign.
    input_order
        Order of the current in the deflection equation of the published form; see :func:`order_law`. ``"derived"``
        eliminates the acceleration of the hub without dropping a term, which gives the same simulations as the Lagrange
        form. The deflection then depends on a small difference of large terms. This argument selects the published
        form.
    coupling
        ``"measured"`` (default of the Lagrange form): the other angle of the joint is a measured input of each
        equation. ``"simulated"`` (default of the published form): both angles are simulated from the currents, so noise
        on the measured hub angle has no effect.
    cross_stage
        ``"torques"`` (or True) adds angles and current of the other joint to every equation, with order 0.
        ``"inertial"``, for the Lagrange form, adds the linearized inertial coupling of the planar arm, in which hub 2
        is mounted on the tip of link 1. Accelerations of joint 2 act on link 1 (p_2 D^2 theta_21 + q_2 D^2 theta_22).
        Those of joint 1 act on hub 2 and link 2, with coefficients p_3 and p_4 of theta_11, and q_3 and q_4 of
        theta_12. Joint 2 acts on hub 1 only through link 1. With ``stage="both"`` the other joint is modeled too, and
        orders follow from the sum of velocities in (8). For example, theta_21 has the order alpha_2 - mu_2 + gamma_3 in
        the equation of theta_12. For a single joint, these terms have the order alpha of their equation.
    friction
        ``"coulomb"`` (or True) adds Coulomb friction of hub j to its equation. With ``coupling="simulated"`` (Lagrange
        form only), it is -fc_j sign(D theta_j1) of the simulated velocity, set-valued at rest (:class:`Friction`), and
        is estimated by output error. With measured coupling, it is a linear term c coulomb_theta_j1 in the sign of the
        measured velocity; in the published form, both equations have it. ``"stribeck"``, with simulated coupling, adds
        a larger friction fs_j at speeds below vs_j (:class:`Stribeck`).
    cross_sensitivity
        Whether hub angles are added to the deflection equation with order 0, because strain gauges and cables make a
        measured deflection depend on the hub angle. The terms in the equation of theta_12 are e_2 theta_11 and, with
        ``cross_stage="inertial"``, f_2 theta_21.
    cross_damping
        Whether the rate of the deflection of the other link is added to the deflection equation, as w_2 D theta_22 in
        the equation of theta_12. It requires ``cross_stage="inertial"`` and measured coupling. The term is not a
        physical dissipation. Like the gain of an observer, it makes the simulation less sensitive to errors of the
        measured inputs; docs/arm.md shows its effect.
    hub
        Whether the equation of the hub is included. Without it, the deflection has the measured hub angle as input, and
        the friction of the hub need not be known. There is then no coefficient law, and the data hardly distinguish the
        spring of the link from its damper. The order beta is therefore searched up to 1/2, and mu from 1/2.
    laws
        ``"orders"``: orders obey :func:`order_law`, with five free orders. Without it, each equation has four free
        orders. In the Lagrange form and with ``"derived"``, alpha_2 (alpha_4) is fixed at 2, because only the viscous
        friction of the link depends on it. ``"coefficients"``: coefficients obey the coefficient law. In the Lagrange
        form, it is a_2 = -j a_1 and d_2 = -j d_1 with the ratio j = J_1/J_2, and the coefficient of the hub motion is
        -1 instead of the free b_2. In the published form, it is a_2 = -r a_1, b_2 = -b_1, d_2 = -r d_1 and g_2 = -g_1
        with r = (J_1 + J_2)/J_2. With inertial coupling, the law also has q_3 = p_3 and q_4 = p_4. Equation-error
        methods estimate all coefficients freely, and report their deviation from the law. ``"velocities"``: gamma_1 =
        mu_2 (gamma_3 = mu_4), for the Lagrange form together with ``"orders"``; see :func:`order_law`.
    parameters
        Named set of nominal values of the paper's arm, which are printed next to the estimates and bound a genetic
        search; by default there are none.
    sensor_filter
        Filter that the deflections have passed in the measurement. ``"stock"`` is the 2 Hz low-pass of the arm's stock
        real-time model on both deflections.
    offset
        Unknown offset of each run; see :func:`ftlm.equation`. ``"constant"``: a constant in each equation, such as from
        a current offset. ``"ramp"``: a constant and a linear drift in each equation. ``"level"``: a constant that is
        added to each output.

    Returns
    -------
    Structure
        Structure with free orders and coefficients.

    Raises
    ------
    ModelError
        If an argument is unknown, or cannot be combined with the form or with another argument.

    Notes
    -----
    Time must be in seconds. If gamma_1 may differ from mu_2, the coefficient law (including the fixed -1) relates
    coefficients whose dimensions differ by time to the power gamma_1 - mu_2. The law then depends on the unit of time.
    With ``"velocities"`` it does not.
    """
    if stage not in (1, 2, "both"):
        raise ModelError(f"{setting('stage')} {stage!r} is not known; use 1, 2 or 'both'")
    form, input_order = _resolve_form(form, input_order)
    for law in laws:
        if law not in LAW_NAMES:
            raise ModelError(f"law {law!r} is not known; use 'orders', 'coefficients', both or ()")
    if "velocities" in laws and (form != "lagrange" or "orders" not in laws):
        order_law_text = choose_text("laws=('orders', …)", "--laws orders")
        raise ModelError(
            f"law 'velocities' relates two orders of {parameter('form', 'lagrange')} under the order law; use it with "
            f"{order_law_text}"
        )
    if cross_stage not in (False, True, "torques", "inertial"):
        raise ModelError(f"{setting('cross_stage')} {cross_stage!r} is not known; use False, 'torques' or 'inertial'")
    if cross_stage == "inertial" and form != "lagrange":
        raise ModelError(
            f"{parameter('cross_stage', 'inertial')} requires {parameter('form', 'lagrange')}; use that form"
        )
    if parameters is not None:
        check_choice("parameters", parameters, PARAMETER_SETS)
    if not (isinstance(friction, bool) or friction in ("coulomb", "stribeck")):
        raise ModelError(
            f"{setting('friction')} {short_repr(friction)} is not known; use False, 'coulomb' or 'stribeck'"
        )
    flags = {"cross_sensitivity": cross_sensitivity, "cross_damping": cross_damping, "hub": hub}
    for name, flag in flags.items():
        if not isinstance(flag, bool):
            raise ModelError(f"{name} = {short_repr(flag)} is neither True nor False; use one of them")
    if coupling is None:
        coupling = "measured" if form == "lagrange" else "simulated"
    if friction == "stribeck" and coupling != "simulated":
        raise ModelError(
            f"{parameter('friction', 'stribeck')} requires the simulated velocity; use "
            f"{parameter('coupling', 'simulated')}, or {parameter('friction', 'coulomb')}"
        )
    if friction and coupling == "simulated" and form != "lagrange":
        raise ModelError(
            f"{parameter('friction', True)} with {parameter('coupling', 'simulated')} requires "
            f"{parameter('form', 'lagrange')}, in which hub friction does not enter the links' equations; use that "
            f"form, or {parameter('coupling', 'measured')}, whose friction has the sign of the measured velocity"
        )
    if not hub and (form != "lagrange" or coupling == "simulated" or friction):
        raise ModelError(
            f"{parameter('hub', False)} makes the measured hub angle an input of the deflection; use "
            f"{parameter('form', 'lagrange')} and {parameter('coupling', 'measured')}, without "
            f"{parameter('friction', True)}"
        )
    if cross_damping and (cross_stage != "inertial" or coupling == "simulated"):
        raise ModelError(
            f"{parameter('cross_damping', True)} needs the measured other deflection; use it with "
            f"{parameter('cross_stage', 'inertial')} and {parameter('coupling', 'measured')}"
        )
    stages: tuple[int, ...] = (1, 2) if stage == "both" else (stage,)
    equations: list[Equation] = []
    coefficient_law: list[tuple[str, float, tuple[str, ...]]] = []
    nominal_values: dict[str, float] = {}
    for j in stages:
        order_option = input_order if form == "published" else None
        orders = order_law(j, form=form, input_order=order_option, velocities="velocities" in laws)
        pair = _joint_equations(j, form, orders, laws, bool(friction) and coupling == "measured")
        if friction and coupling == "simulated":
            stribeck = Stribeck(f"fs{j}", f"vs{j}") if friction == "stribeck" else None
            pair = (replace(pair[0], friction=Friction(f"fc{j}", stribeck=stribeck)), pair[1])
        if cross_stage:
            pair = (
                _add_cross_inertia(pair, j, laws, stage == "both")
                if cross_stage == "inertial"
                else _add_cross_torques(pair, j)
            )
        if cross_damping:
            pair = (pair[0], _append_terms(pair[1], [Term(f"theta{3 - j}2", Order(1.0), f"w{2 * j}")]))
        if cross_sensitivity:
            pair = (pair[0], _add_cross_sensitivity(pair[1], j, other=cross_stage == "inertial"))
        equations += pair if hub else pair[1:]
        h, d = 2 * j - 1, 2 * j
        ratio = f"j{j}" if form == "lagrange" else f"r{j}"
        law_terms: tuple[tuple[str, tuple[str, ...]], ...] = (("a", (ratio,)), ("d", (ratio,)))
        if form == "published":
            law_terms = (("a", (ratio,)), ("b", ()), ("d", (ratio,)), ("g", ()))
        coefficient_law += [(f"{c}{d}", -1.0, (f"{c}{h}", *factors)) for c, factors in law_terms]
        if cross_stage == "inertial" and j == 2:
            # Both angles of joint 1 rotate joint 2, which is mounted on the tip of link 1.
            coefficient_law += [(f"q{n}", 1.0, (f"p{n}",)) for n in (h, d)]
        if parameters is not None:
            link = PARAMETER_SETS[parameters][j]
            values = link.lagrange_coefficients(j) if form == "lagrange" else link.coefficients(j)
            nominal_values |= {n: v for n, v in values.items() if any(n in e.coefficient_names for e in equations)}
    if sensor_filter == "stock":
        signals = {s for e in equations for s in e.signals}
        sensor_filter = SensorFilter.low_pass([s for s in ("theta12", "theta22") if s in signals])
    if not (sensor_filter is None or isinstance(sensor_filter, SensorFilter)):
        raise ModelError(f"{setting('sensor_filter')} {sensor_filter!r} is not known; use 'stock' or a SensorFilter")
    structure = Structure(
        equations=tuple(equations),
        coupling=coupling,
        sensor_filter=sensor_filter,
        coefficient_law=tuple(coefficient_law) if "coefficients" in laws and hub else (),
        nominal_values=nominal_values,
        name=f"{FLEXIBLE_LINK}, stage {stage}" if stage != "both" else f"{FLEXIBLE_LINK}, both stages",
        hints=_hints(form),
        offset=check_offset(offset),
    )
    if form == "lagrange" or input_order == "derived":
        structure = structure.with_orders({f"alpha{2 * j}": 2.0 for j in stages})
    if not hub:
        # Only the ranges of their orders distinguish elasticity and damping, whose exchange gives the same equation.
        structure = structure.with_orders(
            {f"{n}{2 * j}": DEFLECTION_ORDER_RANGES[n] for j in stages for n in DEFLECTION_ORDER_RANGES}
        )
    return structure


def _joint_equations(
    stage: int, form: Form, law: Mapping[str, Order], laws: Sequence[str], friction: bool
) -> tuple[Equation, Equation]:
    """Return (hub equation, deflection equation) of one joint.

    `law` contains the orders that :func:`order_law` returns. They are used if `laws` contains "orders"; otherwise each
    order of the equations is a separate free order. `friction` adds the linear Coulomb term.
    """
    h, d = 2 * stage - 1, 2 * stage
    hub, deflection, current = f"theta{stage}1", f"theta{stage}2", f"I{stage}"
    has_order_law = "orders" in laws

    def order(name: str) -> Order:
        return law[name] if has_order_law else Order(0.0, ((name, 1.0),))

    def friction_terms(n: int) -> list[Term]:
        has_friction = friction and (n == h or form == "published")
        return [Term(f"coulomb_{hub}", Order(), f"c{n}")] if has_friction else []

    def equation(output: str, n: int, input_order: Order | None) -> Equation:
        terms = [
            Term(deflection, order(f"beta{n}"), f"a{n}"),
            Term(hub, order(f"gamma{n}"), f"b{n}"),
            Term(deflection, order(f"mu{n}"), f"d{n}"),
        ]
        if input_order is None and "coefficients" in laws:
            # The motion of the hub has the coefficient -1 for any parameters of the link.
            terms[1] = Term(hub, order(f"gamma{n}"), -1.0, name=f"b{n}")
        if input_order is not None:
            terms.append(Term(current, input_order, f"g{n}"))
        return Equation(output, order(f"alpha{n}"), (*terms, *friction_terms(n)))

    input_order = None if form == "lagrange" else law["input"] if has_order_law else Order()
    return equation(hub, h, Order()), equation(deflection, d, input_order)


def _append_terms(item: Equation, terms: Sequence[Term]) -> Equation:
    """Return an equation with additional terms, which are inserted before its terms of Coulomb friction."""
    friction_terms = tuple(t for t in item.terms if t.signal.startswith("coulomb_"))
    return replace(item, terms=(*item.terms[: len(item.terms) - len(friction_terms)], *terms, *friction_terms))


def _add_cross_torques(pair: tuple[Equation, Equation], stage: int) -> tuple[Equation, Equation]:
    """Return both equations of a joint with added terms of order 0 in the angles and the current of the other joint."""
    other, first = 3 - stage, 2 * stage - 1
    signals = (f"theta{other}1", f"theta{other}2", f"I{other}")
    hub, deflection = (
        _append_terms(item, [Term(s, Order(CROSS_ORDER), f"{c}{n}") for c, s in zip("pqs", signals, strict=True)])
        for n, item in enumerate(pair, first)
    )
    return hub, deflection


def _add_cross_inertia(
    pair: tuple[Equation, Equation], stage: int, laws: Sequence[str], both: bool
) -> tuple[Equation, Equation]:
    """Return (hub equation, deflection equation) of a joint with added accelerations of the other joint.

    The terms follow from the kinetic energy T of the planar arm, with the absolute rates in eq. (8) of the paper: T =
    (J_11 w_1^2 + J_12 w_2^2 + J_21 w_3^2 + J_22 w_4^2)/2 + H w_2 w_4 with w_1 = D theta_11, w_2 = w_1 + D theta_12, w_3
    = w_2 + D theta_21 and w_4 = w_3 + D theta_22. J_12 includes all masses beyond link 1, at its tip. H is the length
    of link 1 times the first moment of mass of link 2. The equation of hub 1 gets no terms: accelerations of joint 2
    cancel in it, because it is the difference of the Lagrange equations of theta_11 and theta_12. `both` states whether
    the other joint is modeled too.
    """
    h, d, other = 2 * stage - 1, 2 * stage, 3 - stage
    other_hub, other_deflection = 2 * other - 1, 2 * other
    rates = (f"mu{other_deflection}" if "velocities" in laws else f"gamma{other_hub}", f"mu{other_deflection}")
    law = both and "orders" in laws

    def terms(n: int, damping: str) -> list[Term]:
        orders = [Order.parse(f"alpha{n} - {damping} + {rate}" if law else f"alpha{n}") for rate in rates]
        return [Term(f"theta{other}{k}", order, f"{c}{n}") for k, c, order in zip((1, 2), "pq", orders, strict=True)]

    hub, deflection = pair
    # The derivative from rate to acceleration has the order alpha_3 - gamma_3 for a hub and alpha_2 - mu_2 for a link.
    hub_rate = f"mu{d}" if "velocities" in laws else f"gamma{h}"
    return hub if stage == 1 else _append_terms(hub, terms(h, hub_rate)), _append_terms(deflection, terms(d, f"mu{d}"))


def _add_cross_sensitivity(item: Equation, stage: int, *, other: bool) -> Equation:
    """Return a deflection equation with an added term of order 0 in its hub angle.

    With `other`, a term in the other hub angle is added too.
    """
    signals = (f"theta{stage}1", f"theta{3 - stage}1")[: 1 + other]
    return _append_terms(item, [Term(s, Order(), f"{c}{2 * stage}") for c, s in zip("ef", signals, strict=False)])


def link_structure(stage: Literal[1, 2, "both"], *, both: bool, filtered: bool = True, rate: bool = True) -> Structure:
    """Return the structure of one or both link deflections by eq. (15) of the paper, with measured hub angles as input.

    `stage` is the joint, 1, 2 or "both". Elasticity and damping have free orders. The effect of the hub angle on the
    strain gauge and the offset of the gauge are included. If both joints are measured (`both`), each equation also
    contains the accelerations of the other joint and, if `rate` is True, the rate of its deflection. `filtered` states
    whether deflections passed the stock 2 Hz low-pass.

    Initial conditions are those of Caputo derivatives. With a history before the run, a model of fractional orders
    would have more free initial terms on the validation run than a model of integer orders.
    """
    structure = flexible_link(
        stage=stage,
        hub=False,
        cross_stage="inertial" if both else False,
        cross_sensitivity=True,
        cross_damping=both and rate,
        sensor_filter="stock" if filtered else None,
        laws=("orders", "coefficients", "velocities"),
        offset="constant",
    )
    return replace(structure, initial="caputo")


@check_arguments
def link_model(
    *,
    stage: Literal[1, 2, "both"] = 1,
    parameters: Literal["effective", "table-3"] | Mapping[int, LinkParameters] = "effective",
    orders: Mapping[str, float] | None = None,
    coefficients: Mapping[str, float] | None = None,
    form: Form | None = None,
    input_order: InputOrder | None = None,
    coupling: Literal["simulated", "measured"] = "simulated",
) -> Model:
    """Return a model of the arm with known parameters, by default the integer-order model of the manufacturer's manual.

    With integer orders, the Lagrange form and the published form are the same model. With fractional orders, the
    deflection of the published form has the wrong sign.

    Parameters
    ----------
    stage
        Joint: 1, 2 or ``"both"``.
    parameters
        Named parameter set, or physical parameters by joint number.
    orders
        Values of the free orders of the order law by name; by default the integer orders of the manual.
    coefficients
        Coefficients by name, which replace those that follow from the parameters.
    form, input_order, coupling
        As for :func:`flexible_link`, except that both angles are simulated from the current by default.

    Returns
    -------
    Model
        Model without free parameters.

    Raises
    ------
    ModelError
        If a name is unknown, or an order is out of range.
    """
    parameters_name = parameters if isinstance(parameters, str) else "effective"
    form, order = _resolve_form(form, input_order)
    structure = flexible_link(
        stage=stage,
        form=form,
        input_order=order if form == "published" else None,
        coupling=coupling,
        parameters=parameters_name,
    )
    values = dict(structure.nominal_values)
    if not isinstance(parameters, str):
        for j, link in parameters.items():
            link_values = link.lagrange_coefficients(j) if form == "lagrange" else link.coefficients(j)
            values |= {n: v for n, v in link_values.items() if n in structure.coefficient_names}
        # Those of the named set belong to another arm.
        structure = replace(structure, nominal_values={})
    values |= dict(coefficients or {})
    free = {name: integer_order(name) for name in structure.order_names} | dict(orders or {})
    return Model(
        structure.with_orders(free).with_coefficients(values),
        orders=free,
        units={s: "A" if s.startswith("I") else "rad" for s in structure.signals},
        about={"origin": f"parameters {parameters_name}" if isinstance(parameters, str) else "given parameters"},
    )
