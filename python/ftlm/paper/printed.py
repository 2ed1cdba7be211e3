"""What the paper prints in its Tables 3 to 7: numbers to set beside computed ones, never to compute with.

Wang, Li, Li, Liang, Gao, Symmetry 2025, 17, 1072, doi:10.3390/sym17071072. Digits are the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ftlm.data.settings import COMPARED_LENGTHS
from ftlm.paint.text import Exact

#: The paper's p, its number of pulses, and its four angles in the order n = 1 … 4.
INNOVATION_LENGTHS = COMPARED_LENGTHS
POINTS = 2048
OUTPUTS = ("theta11", "theta12", "theta21", "theta22")
#: Letters of the orders and of the coefficients, in the order of the tables' columns.
ORDERS, COEFFICIENTS = ("gamma", "alpha", "beta", "mu"), ("a", "b", "d", "g")


@dataclass(frozen=True)
class Printed:
    """One printed row: its numbers by letter, and criteria (45), (46), (47); None where the table has none."""

    orders: Mapping[str, float]
    coefficients: Mapping[str, float]
    error: float | None = None
    rmse: float | None = None
    nr: float | None = None


def _row(orders: tuple[float | None, ...], coefficients: tuple[float | None, ...], *criteria: float) -> Printed:
    def present(letters: tuple[str, ...], values: tuple[float | None, ...]) -> dict[str, float]:
        return {letter: Exact(v) for letter, v in zip(letters, values, strict=True) if v is not None}

    return Printed(present(ORDERS, orders), present(COEFFICIENTS, coefficients), *map(Exact, criteria))


_WHOLE = (1.0, 2.0, None, 1.0)
_HUB, _LINK = (1.9, 2.0, 1.85, 1.8), (1.95, 2.0, 1.9, 1.85)
#: Integer-order rows of Tables 4 and 5.
INTEGER: dict[str, Printed] = {
    "theta11": _row(_WHOLE, (628.89, -62.956, None, 140.47), 640.31, 0.3829, 4.2028),
    "theta12": _row(_WHOLE, (-863.33, 62.956, None, -140.47), 23.764, 0.0205, 3.4665),
    "theta21": _row(_WHOLE, (2271.12, -496.76, 28.35, 288.12), 242.16, 0.2312, 1.6330),
    "theta22": _row(_WHOLE, (-3336.18, 496.76, -41.65, -288.12), 244.79, 0.1045, 29.967),
}
#: Fractional rows of Tables 4 and 5, by angle and innovation length.
FRACTIONAL: dict[str, dict[int, Printed]] = {
    "theta11": {
        1: _row(_HUB, (-0.5002, 0.0253, 0.0186, 0.0345), 58.973, 0.0336, 0.3683),
        3: _row(_HUB, (-0.7798, 0.0339, 0.0214, 0.0115), 37.764, 0.0212, 0.2323),
        5: _row(_HUB, (-0.8789, 0.0321, 0.0155, 0.0029), 32.426, 0.0186, 0.2045),
        7: _row(_HUB, (-0.9302, 0.0277, 0.0077, -0.0015), 30.561, 0.0180, 0.1974),
    },
    "theta12": {
        1: _row(_LINK, (-0.7308, 0.0039, -0.4494, -0.0016), 1.5643, 0.00097, 0.1653),
        3: _row(_LINK, (-0.9449, 0.0016, -0.2617, -0.0018), 1.4834, 0.00092, 0.1559),
        5: _row(_LINK, (-1.1164, 0.0011, -0.0825, -0.0018), 1.3957, 0.00087, 0.1465),
        7: _row(_LINK, (-1.2655, 0.0008, 0.0779, -0.0017), 1.3136, 0.00081, 0.1378),
    },
    "theta21": {
        1: _row(_HUB, (-0.8114, 0.0108, 0.0067, 0.0228), 81.229, 0.0447, 0.3155),
        3: _row(_HUB, (-1.0049, 0.0043, -0.0028, 0.0395), 57.369, 0.0329, 0.2322),
        5: _row(_HUB, (-1.0556, 0.0048, -0.0146, 0.0439), 54.504, 0.0321, 0.2267),
        7: _row(_HUB, (-1.0791, 0.0144, -0.0266, 0.0459), 53.989, 0.0320, 0.2266),
    },
    "theta22": {
        1: _row(_LINK, (-0.5149, 0.0053, -0.4219, -0.0006), 1.1985, 0.00072, 0.2051),
        3: _row(_LINK, (-0.6531, 0.0026, -0.4494, -0.0009), 1.0105, 0.00062, 0.1781),
        5: _row(_LINK, (-0.7226, 0.0019, -0.4173, 0.0010), 0.9917, 0.00061, 0.1756),
        7: _row(_LINK, (-0.7787, 0.0017, -0.3759, 0.0010), 0.9791, 0.00060, 0.1737),
    },
}
#: Table 6: the genetic algorithm.
GENETIC: dict[str, Printed] = {
    "theta11": _row((1.9299, 1.9722, 1.8977, 1.8655), (-0.2832, 4.8206, -4.1504, 0.0112)),
    "theta12": _row((1.9621, 1.9722, 1.9299, 1.8977), (-0.0159, 0.0238, 0.5145, 0.0172)),
    "theta21": _row((1.9299, 1.9722, 1.8977, 1.8655), (-0.4537, -9.0544, 9.5132, 0.0006)),
    "theta22": _row((1.9621, 1.9722, 1.9299, 1.8977), (-0.0231, -0.0009, 0.2365, 0.0012)),
}
#: Table 7: (error, RMSE, NR) of the genetic algorithm and of multi-innovation.
RIVALS: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "theta11": ((70.844, 0.0401, 0.3554), (30.561, 0.0180, 0.1974)),
    "theta12": ((6.8453, 0.0042, 0.1812), (1.3136, 0.0008, 0.1378)),
    "theta21": ((65.306, 0.0395, 0.2270), (53.989, 0.0320, 0.2266)),
    "theta22": ((7.3449, 0.0042, 0.3058), (0.9791, 0.0006, 0.1737)),
}
#: Table 3: value and printed unit, with the paper's names.
TABLE_3: dict[str, tuple[float, str]] = {
    "L_1": (0.3493, "m"),
    "L_2": (0.2975, "m"),
    "J_11": (0.0635, "kg m²"),
    "J_12": (0.1704, "kg m²"),
    "B_11": (4.0, "Nm²"),
    "B_12": (0.421, "Nm²"),
    "J_21": (0.003, "kg m²"),
    "J_22": (0.0064, "kg m²"),
    "B_21": (1.5, "Nm²"),
    "B_22": (0.856, "Nm²"),
    "K_s1": (2.69, "Nm²"),
    "K_s2": (0.463, "Nm²"),
    "K_τ1": (0.119, "Nm²"),
    "K_τ2": (0.0234, "Nm²"),
}


def last_orders(output: str) -> dict[str, float]:
    """Orders of an angle's row of p = 7 by name, such as alpha1."""
    index = 1 + OUTPUTS.index(output)
    return {f"{n}{index}": v for n, v in FRACTIONAL[output][INNOVATION_LENGTHS[-1]].orders.items()}
