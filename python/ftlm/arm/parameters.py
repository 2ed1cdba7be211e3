"""Physical parameters of the two-link arm: named sets."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LinkParameters:
    """Physical parameters of one stage.

    Parameters
    ----------
    stiffness
        Viscoelastic coefficient of the link, K_s [N m/rad] (for integer orders).
    hub_inertia, link_inertia
        J_j1 and J_j2 [kg m^2].
    hub_friction, link_friction
        B_j1 and B_j2 [N m s/rad].
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
        """Inertia ratio r = (J_1 + J_2) / J_2, by which the coefficients of the deflection exceed those of the hub."""
        return (self.hub_inertia + self.link_inertia) / self.link_inertia

    def coefficients(self, stage: int) -> dict[str, float]:
        """Coefficients a, b, d, g of both equations of a stage, by name (paper, after (21))."""
        hub, deflection = 2 * stage - 1, 2 * stage
        a, b = self.stiffness / self.hub_inertia, -self.hub_friction / self.hub_inertia
        d, g = self.link_friction / self.hub_inertia, self.torque_constant / self.hub_inertia
        r = self.inertia_ratio
        return {
            f"a{hub}": a, f"b{hub}": b, f"d{hub}": d, f"g{hub}": g,
            f"a{deflection}": -a * r, f"b{deflection}": -b, f"d{deflection}": 0.0 - d * r, f"g{deflection}": -g,
        }  # fmt: skip

    def lagrange_coefficients(self, stage: int) -> dict[str, float]:
        """Coefficients a, b, d, g of the hub's equation and a, b, d of the deflection's as (15) has them."""
        hub, deflection = 2 * stage - 1, 2 * stage
        own = {n: v for n, v in self.coefficients(stage).items() if n.endswith(str(hub))}
        stiffness, friction = self.stiffness / self.link_inertia, self.link_friction / self.link_inertia
        return own | {f"a{deflection}": -stiffness, f"b{deflection}": -1.0, f"d{deflection}": 0.0 - friction}


#: Named parameter sets, by stage. "effective" reproduces the integer-order rows of the paper's Tables 4 and 5: the
#: torque per ampere holds gear efficiency, gear ratio and torque constant. "table-3" is the paper's Table 3 as printed,
#: whose stiffnesses are about 14.8 times smaller and whose torque constants lack gear and efficiency.
PARAMETERS: dict[str, dict[int, LinkParameters]] = {
    "effective": {
        1: LinkParameters(39.9572, 0.0635362, 0.170434, 4.0, 0.0, 0.75 * 100 * 0.119),
        2: LinkParameters(6.85775, 0.00301955, 0.0064387, 1.5, 0.085608, 0.75 * 50 * 0.0232),
    },
    "table-3": {
        1: LinkParameters(2.69, 0.0635, 0.1704, 4.0, 0.421, 0.119),
        2: LinkParameters(0.463, 0.003, 0.0064, 1.5, 0.856, 0.0234),
    },
}
#: The manual's integer orders: alpha = 2, stiffness on the angle, damping and friction on its rate.
INTEGER_ORDERS = {"gamma": 1.0, "beta": 0.0, "mu": 1.0}


def whole_order(name: str) -> float:
    """The manual's integer order of an order's name, such as gamma1."""
    return INTEGER_ORDERS.get(name.rstrip("0123456789"), 2.0)
