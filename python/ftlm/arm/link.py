"""The paper's physics: the flexible two-link arm, its order law, its coefficient law and its parameter sets.

Stage j has the hub angle theta_j1, the deflection theta_j2 and the motor current I_j. Eliminating the highest
derivatives from the fractional Euler-Lagrange equations (14)-(15) leaves (17) and (19), which (22)-(25) abbreviate.
The orders and the coefficients that appear in them are not free: both follow from the physical ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

from ftlm.arm.parameters import INTEGER_ORDERS, PARAMETERS, LinkParameters
from ftlm.base.errors import ModelError
from ftlm.data.equations import Equation, Term
from ftlm.data.orders import Order
from ftlm.data.structures import Hints, SensorFilter, Structure, check_offset
from ftlm.model.model import Model

#: Orders of the cross-stage terms: torques of the other stage act through its angles and its current as they are.
CROSS_ORDER = 0.0
#: A link is second order or a little less.
HIGHEST = (1.2, 2.0)
#: Values beside the whole orders of a link's physics: damping on the rate or a little below, stiffness on the angle.
NATURAL = {"alpha": (2.0,), "gamma": (0.9, 1.0), "beta": (0.0, 0.15), "mu": (0.8, 1.0)}
#: Orders by the letter of the coefficient whose term they differentiate, as in (22)-(25).
ORDER_OF = {"a": "beta", "b": "gamma", "d": "mu"}
#: What no order law changes: where the orders of either stage lie, and what they are called.
HINTS = Hints(
    HIGHEST,
    {f"{order}{n}": values for order, values in NATURAL.items() for n in range(1, 5)},
    {f"{letter}{n}": f"{order}{n}" for letter, order in ORDER_OF.items() for n in range(1, 5)},
)


def order_law(stage: int, input_order: Literal["published", "derived"] = "published") -> dict[str, Order]:
    """Every order of a stage's two equations as a function of the five free ones.

    Parameters
    ----------
    stage
        1 or 2.
    input_order
        ``"published"`` or ``"derived"``.

    Returns
    -------
    dict
        alpha, beta, gamma, mu of the hub (index 2*stage - 1) and of the deflection (2*stage), and ``input``, the order
        of the current in the deflection's equation: 0 as published in (23), alpha_2 - mu_2 + gamma_1 - alpha_1 as
        derived (the published elimination drops it).

    Raises
    ------
    ModelError
        A stage that is neither 1 nor 2, an input order that is not known.
    """
    if stage not in (1, 2):
        raise ModelError(f"stage = {stage!r} is not known; use 1, 2 or 'both'")
    if input_order not in ("published", "derived"):
        raise ModelError(f"input_order = {input_order!r} is not known; use 'published' or 'derived'")
    h, d = 2 * stage - 1, 2 * stage
    law = {
        f"alpha{h}": f"alpha{h}",
        f"beta{h}": f"alpha{h} - alpha{d} + mu{d} - gamma{h} + beta{d}",
        f"gamma{h}": f"gamma{h}",
        f"mu{h}": f"alpha{h} - alpha{d} + 2*mu{d} - gamma{h}",
        f"alpha{d}": f"alpha{d}",
        f"beta{d}": f"beta{d}",
        f"gamma{d}": f"2*gamma{h} - alpha{h} + alpha{d} - mu{d}",
        f"mu{d}": f"mu{d}",
        "input": f"alpha{d} - mu{d} + gamma{h} - alpha{h}" if input_order == "derived" else "0",
    }
    return {name: Order.parse(text) for name, text in law.items()}


def flexible_link(
    *,
    stage: Literal[1, 2, "both"] = 1, input_order: Literal["published", "derived"] = "published",
    coupling: Literal["simulated", "measured"] = "simulated", cross_stage: bool = False, friction: bool = False,
    laws: Sequence[Literal["orders", "coefficients"]] = ("orders", "coefficients"),
    parameters: Literal["effective", "table-3"] = "effective",
    sensor_filter: SensorFilter | Literal["stock"] | None = None,
    offset: Literal["none", "constant", "ramp"] = "none",
) -> Structure:  # fmt: skip
    """Make the paper's structure (22)-(25): two equations a stage.

    Parameters
    ----------
    stage
        1 (theta11, theta12, I1), 2 (theta21, theta22, I2) or both.
    input_order
        Order of the current in the deflection's equation, see :func:`order_law`. With ``"derived"`` alpha_2 (alpha_4)
        is fixed at 2: it is seen only through the link's viscous friction.
    coupling
        Whether free runs couple the two simulated outputs (from the currents alone) or take the other as measured.
    cross_stage
        Adds the other stage's angles and current to every equation (order 0); with ``stage="both"`` those are
        modelled too.
    friction
        Adds a Coulomb term c * sign(D theta_j1) to both equations; needs measured coupling.
    laws
        ``"orders"``: orders obey :func:`order_law`, five are free. Without it each equation has its own four orders.
        ``"coefficients"``: the coefficient law is stated in the structure. The equation-error estimators estimate the
        eight coefficients freely and report how far they are from the law.
    parameters
        Named set that results are set beside.
    sensor_filter
        ``"stock"`` for the 2 Hz low-pass that the arm's stock real-time model puts on both deflections, or a filter.
    offset
        ``"constant"`` or ``"ramp"``: an unknown constant (and a ramp) in each equation, one a run, such as the current
        that it takes to hold the arm still; see :func:`ftlm.equation`.

    Returns
    -------
    Structure
        Orders and coefficients free.

    Raises
    ------
    ModelError
        An argument that is not known.
    """
    if stage not in (1, 2, "both"):
        raise ModelError(f"stage = {stage!r} is not known; use 1, 2 or 'both'")
    for law in laws:
        if law not in ("orders", "coefficients"):
            raise ModelError(f"law {law!r} is not known; use 'orders', 'coefficients', both or ()")
    if parameters not in PARAMETERS:
        raise ModelError(f"parameters = {parameters!r} is not known; use {' or '.join(map(repr, PARAMETERS))}")
    if friction and coupling == "simulated":
        raise ModelError("friction=True makes the coupled free run non-linear; use coupling='measured'")
    stages: tuple[int, ...] = (1, 2) if stage == "both" else (stage,)
    equations: list[Equation] = []
    coefficient_law: list[tuple[str, float, tuple[str, ...]]] = []
    reference: dict[str, float] = {}
    for j in stages:
        equations += _stage(j, order_law(j, input_order), "orders" in laws, cross_stage, friction)
        h, d = 2 * j - 1, 2 * j
        coefficient_law += [
            (f"{c}{d}", -1.0, (f"{c}{h}", *ratio))
            for c, ratio in (("a", (f"r{j}",)), ("b", ()), ("d", (f"r{j}",)), ("g", ()))
        ]
        reference |= PARAMETERS[parameters][j].coefficients(j)
    if sensor_filter == "stock":
        sensor_filter = SensorFilter.low_pass([f"theta{j}2" for j in stages])
    if not (sensor_filter is None or isinstance(sensor_filter, SensorFilter)):
        raise ModelError(f"sensor_filter = {sensor_filter!r} is not known; use 'stock' or a SensorFilter")
    structure = Structure(
        equations=tuple(equations), coupling=coupling, sensor_filter=sensor_filter,
        coefficient_law=tuple(coefficient_law) if "coefficients" in laws else (), reference=reference,
        name=f"flexible link, stage {stage}" if stage != "both" else "flexible link, both stages", hints=HINTS,
        offset=check_offset(offset),
    )  # fmt: skip
    if input_order == "derived":
        structure = structure.with_orders({f"alpha{2 * j}": 2.0 for j in stages})
    return structure


def _stage(
    stage: int, law: Mapping[str, Order], tied: bool, cross_stage: bool, friction: bool
) -> tuple[Equation, Equation]:
    """Equations of the hub and of the deflection."""
    h, d = 2 * stage - 1, 2 * stage
    hub, deflection, current = f"theta{stage}1", f"theta{stage}2", f"I{stage}"
    other = 3 - stage

    def order(name: str) -> Order:
        return law[name] if tied else Order(0.0, ((name, 1.0),))

    def extra(n: int) -> list[Term]:
        terms = []
        if cross_stage:
            signals = [f"theta{other}1", f"theta{other}2", f"I{other}"]
            terms += [Term(s, Order(CROSS_ORDER), f"{c}{n}") for c, s in zip("pqs", signals, strict=True)]
        if friction:
            terms.append(Term(f"coulomb_{hub}", Order(), f"c{n}"))
        return terms

    def equation(output: str, n: int, drive: Order) -> Equation:
        terms = [
            Term(deflection, order(f"beta{n}"), f"a{n}"),
            Term(hub, order(f"gamma{n}"), f"b{n}"),
            Term(deflection, order(f"mu{n}"), f"d{n}"),
            Term(current, drive, f"g{n}"),
        ]
        return Equation(output, order(f"alpha{n}"), (*terms, *extra(n)))

    return equation(hub, h, Order()), equation(deflection, d, law["input"] if tied else Order())


def link_model(
    *, stage: Literal[1, 2, "both"] = 1,
    parameters: Literal["effective", "table-3"] | Mapping[int, LinkParameters] = "effective",
    orders: Mapping[str, float] | None = None, coefficients: Mapping[str, float] | None = None,
    input_order: Literal["published", "derived"] = "published",
    coupling: Literal["simulated", "measured"] = "simulated",
) -> Model:  # fmt: skip
    """Make the arm with everything known: by default the integer-order model of the maker's manual.

    Parameters
    ----------
    stage
        1, 2 or both.
    parameters
        Named set, or physical parameters by stage.
    orders
        Free orders of the law, by name; default the manual's integer ones.
    coefficients
        Coefficients to use instead of the parameters', by name.
    input_order, coupling
        See :func:`flexible_link`.

    Returns
    -------
    Model
        Ready to simulate.

    Raises
    ------
    ModelError
        A name that is not known, orders out of range.
    """
    named = parameters if isinstance(parameters, str) else "effective"
    structure = flexible_link(stage=stage, input_order=input_order, coupling=coupling, parameters=named)
    values = dict(structure.reference)
    if not isinstance(parameters, str):
        for j, link in parameters.items():
            values |= link.coefficients(j)
    values |= dict(coefficients or {})
    integer = {name: INTEGER_ORDERS.get(name.rstrip("0123456789"), 2.0) for name in structure.order_names}
    free = integer | dict(orders or {})
    return Model(
        structure.with_orders(free).with_coefficients(values),
        orders=free,
        units={s: "A" if s.startswith("I") else "rad" for s in structure.signals},
        about={"origin": f"parameters {named}" if isinstance(parameters, str) else "given parameters"},
    )
