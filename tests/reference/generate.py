"""Write the reference numbers (JSON, from mpmath at 60 digits and more) that the Rust and the Python tests both read.

Run it with ``python tests/reference/generate.py``; it rewrites every ``*.json`` file beside it and needs a few
seconds. Two rules keep the numbers usable from both languages:

* every argument (an order, a time) is a float, and the mathematics is evaluated at exactly that float, so that the
  distance between 0.15 and its nearest double is never charged to the code under test;
* every result is rounded once, to the nearest double, and printed in the shortest form that reads back unchanged.

Wherever a second, unrelated route to the same number exists, the generator takes it too and refuses to write a file
when the two disagree.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

import mpmath as mp

HERE = Path(__file__).resolve().parent
NOTE = "do not edit; made by generate.py"
DIGITS = 60

# Grid of the orders: both ends, both sides of every integer (where v_n changes character), and a few in between.
KERNEL_ORDERS = [
    1e-3,
    0.05,
    0.1,
    0.15,
    0.3,
    0.5,
    0.75,
    0.95,
    0.999,
    1.0,
    1.001,
    1.05,
    1.3,
    1.5,
    1.85,
    1.95,
    2.0,
    2.05,
    2.2,
    2.5,
    2.75,
    2.95,
    2.999,
    3.0,
]
# Dense where a series in 1/n converges slowly, then both sides of the powers of two where block sizes change.
KERNEL_INDICES = sorted(
    {*range(1, 17), 24, 50, 99, 100, 101, 200, 500, 1000, 1999, 2000, 2001, 5000, 10_000, 50_000, 100_000, 500_000}
    | {2**e + d for e in (5, 6, 7, 8, 10, 11, 12, 13, 14, 16, 17, 18, 19) for d in (0, 1)}
    | {2**17 - 1, 2**20 - 1, 2**20}
)
DERIVATIVE_ORDERS = [0.3, 0.5, 0.8, 1.2, 1.5, 1.8, 2.4]
DERIVATIVE_TIMES = [0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0]
RELAXATION_DURATION = 10.0
RELAXATION_PULSES = [512, 2048, 8192]
# Pulses are chosen by the time they contain, so that the three grids are compared at the same places. 1.0035 lies in
# the first pulse whose midpoint is past t = 1 on two of the grids, where the error of alpha = 0.5 is largest, and
# 5.054 in the pulse where the error of alpha = 1.8 is.
RELAXATION_TIMES = [
    1.001,
    1.0035,
    1.01,
    1.03,
    1.06,
    1.1,
    1.15,
    1.2,
    1.3,
    1.4,
    1.5,
    1.6,
    1.8,
    2.0,
    2.2,
    2.4,
    2.6,
    2.8,
    3.0,
    3.25,
    3.5,
    3.75,
    4.0,
    4.25,
    4.5,
    4.75,
    5.0,
    5.054,
    5.1,
    5.25,
    5.5,
    5.75,
    6.0,
    6.5,
    7.0,
    7.5,
    8.0,
    8.5,
    9.0,
    9.5,
    9.9,
    9.9995,
]


def rounded(values: Iterable[mp.mpf]) -> list[float]:
    """Round each value once, to the nearest double."""
    return [float(value) for value in values]


def require_agreement(first: mp.mpf, second: mp.mpf, digits: int, what: str) -> None:
    """Stop when two routes to one number differ by more than `digits` digits."""
    if abs(first - second) > mp.mpf(10) ** (-digits) * max(1, abs(first)):
        raise ValueError(f"{what}: {mp.nstr(first, 25)} and {mp.nstr(second, 25)} disagree")


def mittag_leffler(alpha: mp.mpf, beta: mp.mpf, z: mp.mpf) -> mp.mpf:
    """E_{alpha,beta}(z) by its defining series, with the digits its cancellation costs added beforehand.

    The largest term is about exp(|z|^(1/alpha)), which bounds what cancels; the terms rise to one maximum and fall.
    """
    lost = int(abs(mp.mpf(z)) ** (1 / mp.mpf(alpha)) / mp.log(10)) + 5
    with mp.workdps(mp.mp.dps + 2 * lost):
        smallest = mp.mpf(10) ** (-mp.mp.dps)
        total, power, k = mp.mpf(0), mp.mpf(1), 0
        while True:
            term = power * mp.rgamma(alpha * k + beta)
            total += term
            # A term can vanish at a pole of the gamma function, hence the first condition.
            if alpha * k + beta > 1 and abs(term) < smallest:
                break
            power *= z
            k += 1
    return +total


def block_pulse_kernel() -> dict:
    """Return v_n of (32), its derivative by the order, and the two gamma factors of the matrix."""

    def xlogx_power(base: int, exponent: mp.mpf) -> tuple[mp.mpf, mp.mpf]:
        if base <= 0:
            return mp.mpf(0), mp.mpf(0)
        power = mp.mpf(base) ** exponent
        return power, power * mp.log(base)

    records = []
    for eta in KERNEL_ORDERS:
        exponent = mp.mpf(eta) + 1
        v, dv = [], []
        for n in KERNEL_INDICES:
            if n == 1:
                v.append(mp.mpf(1))
                dv.append(mp.mpf(0))
                continue
            (p0, d0), (p1, d1), (p2, d2) = (xlogx_power(n - back, exponent) for back in range(3))
            v.append(p0 - 2 * p1 + p2)
            dv.append(d0 - 2 * d1 + d2)
        records.append(
            {
                "eta": eta,
                "n": KERNEL_INDICES,
                "v": rounded(v),
                "dv": rounded(dv),
                "gamma": float(mp.gamma(exponent + 1)),
                "digamma": float(mp.digamma(exponent + 1)),
            }
        )
    return {
        "what": "v_n = n^(eta+1) - 2(n-1)^(eta+1) + (n-2)^(eta+1), v_1 = 1; dv = dv_n/deta; gamma and digamma at eta+2",
        "records": records,
    }


def digamma() -> dict:
    """Return psi(x) on (1, 6], the range eta + 2 can take and a little more, its zero near 1.4616 included."""
    x = [1.0 + 2.0**-40, 1.001, 1.01, 1.4616321449683623, 2.0 - 2.0**-40]
    x += [1.0 + k / 16 for k in range(1, 81)]
    x += [2.001, 2.05, 2.15, 2.95, 3.05, 3.999, 4.999]
    x = sorted(set(x))
    return {"what": "psi(x), the logarithmic derivative of gamma", "x": x, "psi": rounded(mp.digamma(v) for v in x)}


def grunwald_letnikov() -> dict:
    """Return w_j = (-1)^j C(alpha, j); a negative alpha integrates."""
    wanted = sorted({*range(13), 20, 50, 100, 500, 1000, 1001, 2047, 2048, 5000, 10_000, 50_000, 99_999, 100_000})
    records = []
    for alpha in [-2.5, -1.8, -1.0, -0.5, -0.15, 0.0, 0.05, 0.3, 0.5, 0.95, 1.0, 1.2, 1.8, 2.0, 2.4, 2.95]:
        exact = mp.mpf(alpha)
        weight, picked = mp.mpf(1), []
        for j in range(wanted[-1] + 1):
            if j:
                weight *= (j - 1 - exact) / j
            if j in wanted:
                picked.append(weight)
        if alpha not in (0.0, 1.0, 2.0):  # C(alpha, j) is 0 past an integer alpha, and the gamma form is 0 times a pole
            last = wanted[-1]
            by_gamma = mp.gammaprod([last - exact], [-exact, last + 1])
            require_agreement(mp.mpf(1), picked[-1] / by_gamma, 40, "Grünwald-Letnikov weight")
        records.append({"alpha": alpha, "j": wanted, "w": rounded(picked)})
    return {"what": "w_j = (-1)^j binomial(alpha, j)", "records": records}


def three_term_step(t: mp.mpf) -> mp.mpf:
    """Response of 0.8 D^2.2 y + 0.5 D^0.9 y + y to a unit step, expanding its transfer function in powers of 1/s."""
    a, b, high, low = mp.mpf(0.8), mp.mpf(0.5), mp.mpf(2.2), mp.mpf(0.9)
    target = mp.mpf(10) ** (-mp.mp.dps)
    with mp.workdps(2 * mp.mp.dps):
        own, direct = (b / a) * t ** (high - low), t**high / a
        total = mp.mpf(0)
        for n in range(1000):
            layer = mp.mpf(0)
            for i in range(n + 1):
                exponent = high + i * (high - low) + (n - i) * high
                layer += mp.binomial(n, i) * own**i * direct ** (n - i) * mp.rgamma(exponent + 1)
            total += (-1) ** n * layer
            if n > 10 and layer < target:
                break
        total *= t**high / a
    return +total


def step_responses() -> dict:
    """Return the three-term step response and the relaxation D^alpha y + 2y = 2 from rest, points and pulse means."""

    def three_term_image(s: mp.mpf) -> mp.mpf:
        return 1 / (s * (mp.mpf(0.8) * s ** mp.mpf(2.2) + mp.mpf(0.5) * s ** mp.mpf(0.9) + 1))

    times = [0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 20.0]
    values = []
    for t in times:
        value = three_term_step(mp.mpf(t))
        require_agreement(value, mp.invertlaplace(three_term_image, mp.mpf(t), method="talbot", degree=80), 25, "3T")
        values.append(value)
    three_term = {
        "equation": "0.8 D^2.2 y + 0.5 D^0.9 y + y = u, u the unit step, at rest",
        "terms": [[0.8, 2.2], [0.5, 0.9], [1.0, 0.0]],
        "t": times,
        "y": rounded(values),
    }

    duration = mp.mpf(RELAXATION_DURATION)
    relaxation = []
    for alpha in (0.5, 1.8):
        order = mp.mpf(alpha)

        def integral(t: mp.mpf, order: mp.mpf = order) -> mp.mpf:
            return t - t * mittag_leffler(order, mp.mpf(2), -2 * t**order)

        times = [0.01, 0.1, 0.5, 1.0, 2.0, 3.0, 5.0, 7.5, 10.0]
        values = []
        for t in times:
            value = 1 - mittag_leffler(order, mp.mpf(1), -2 * mp.mpf(t) ** order)
            image: Callable = lambda s, order=order: 2 / (s * (s**order + 2))  # noqa: E731
            require_agreement(value, mp.invertlaplace(image, mp.mpf(t), method="talbot", degree=80), 25, "relaxation")
            if alpha == 0.5:
                require_agreement(value, 1 - mp.exp(4 * mp.mpf(t)) * mp.erfc(2 * mp.sqrt(t)), 40, "erfc")
            values.append(value)
        means = []
        for m in RELAXATION_PULSES:
            h = duration / m
            pulses = sorted({int(mp.floor(mp.mpf(t) / h)) + 1 for t in RELAXATION_TIMES})
            means.append(
                {
                    "m": m,
                    "k": pulses,
                    "mean": rounded((integral(k * h) - integral((k - 1) * h)) / h for k in pulses),
                }
            )
        relaxation.append(
            {
                "equation": f"D^{alpha} y + 2 y = 2, at rest",
                "alpha": alpha,
                "coefficient": 2.0,
                "input": 2.0,
                "duration": RELAXATION_DURATION,
                "t": times,
                "y": rounded(values),
                "means": means,
            }
        )
    return {
        "what": "exact responses; means are over the pulses [(k-1)h, kh), h = duration/m, k counted from 1",
        "three_term": three_term,
        "relaxation": relaxation,
    }


def derivatives() -> dict:
    """Return the closed forms of I^eta and of both D^alpha for t^p, exp(-t) and sin(t), lower limit 0."""

    def power_term(coefficient: mp.mpf, exponent: mp.mpf, order: mp.mpf, t: mp.mpf) -> mp.mpf:
        # order > 0 differentiates, order < 0 integrates; rgamma is 0 where a derivative annihilates the power.
        return coefficient * mp.gamma(exponent + 1) * mp.rgamma(exponent + 1 - order) * t ** (exponent - order)

    def exponential(order: mp.mpf, t: mp.mpf) -> mp.mpf:
        return t ** (-order) * mittag_leffler(mp.mpf(1), 1 - order, -t)

    def sine(order: mp.mpf, t: mp.mpf) -> mp.mpf:
        return t ** (1 - order) * mittag_leffler(mp.mpf(2), 2 - order, -(t**2))

    # Taylor coefficients at 0, which the Caputo derivative of order alpha drops for powers below ceil(alpha).
    smooth = {"exp(-t)": (exponential, [1, -1, mp.mpf(1) / 2]), "sin(t)": (sine, [0, 1, 0])}

    records = []

    def add(function: str, exponent: float | None, definition: str, order: float, values: list[mp.mpf]) -> None:
        records.append(
            {
                "function": function,
                "exponent": exponent,
                "definition": definition,
                "order": order,
                "values": rounded(values),
            }
        )

    times = [mp.mpf(t) for t in DERIVATIVE_TIMES]
    for order in DERIVATIVE_ORDERS:
        exact, whole = mp.mpf(order), int(mp.ceil(order))
        for p in (0.0, 0.5, 1.0, 2.0, 2.5, 3.0):
            exponent = mp.mpf(p)
            add("t^p", p, "integral", order, [power_term(mp.mpf(1), exponent, -exact, t) for t in times])
            differentiated = [power_term(mp.mpf(1), exponent, exact, t) for t in times]
            add("t^p", p, "riemann-liouville", order, differentiated)
            if p > whole - 1:
                add("t^p", p, "caputo", order, differentiated)
            elif p == int(p):
                add("t^p", p, "caputo", order, [mp.mpf(0)] * len(times))
            # else the ceil(alpha)-th derivative is not integrable at 0 and the Caputo derivative does not exist
        for function, (closed, taylor) in smooth.items():
            add(function, None, "integral", order, [closed(-exact, t) for t in times])
            add(function, None, "riemann-liouville", order, [closed(exact, t) for t in times])
            caputo = [
                closed(exact, t) - mp.fsum(power_term(mp.mpf(taylor[i]), mp.mpf(i), exact, t) for i in range(whole))
                for t in times
            ]
            add(function, None, "caputo", order, caputo)
            check_by_quadrature(function, exact, whole, times[3], caputo[3])
    return {
        "what": "integral: I^order f; riemann-liouville, caputo: D^order f; lower limit 0; a Caputo record is absent "
        "where that derivative does not exist",
        "t": DERIVATIVE_TIMES,
        "records": records,
    }


def check_by_quadrature(function: str, order: mp.mpf, whole: int, t: mp.mpf, value: mp.mpf) -> None:
    """Compare a Caputo derivative with its definition, (t-x)^(m-alpha-1) f^(m)(x) / Gamma(m-alpha) integrated."""

    def ordinary(x: mp.mpf) -> mp.mpf:
        if function == "exp(-t)":
            return (-1) ** whole * mp.exp(-x)
        return mp.sin(x + whole * mp.pi / 2)

    gap = whole - order
    # With x = t - z^(1/gap) the singular weight becomes 1/gap, and the integrand is bounded.
    integral = mp.quad(lambda z: ordinary(t - z ** (1 / gap)), mp.linspace(0, t**gap, 9)) / gap
    require_agreement(value, integral * mp.rgamma(gap), 8, f"Caputo derivative of {function}")


def plants() -> dict:
    """Return the two synthetic stages with known truth, every order and coefficient worked out from the link's law."""
    kinds = {
        "A": {
            "stage": 1,
            "law": {"a": "628.89", "b": "-62.956", "d": "6.63", "g": "140.47"},
            "inertias": ("0.0635", "0.1704"),
            "free": {"alpha1": "2", "alpha2": "2", "gamma1": "0.95", "beta2": "0.1", "mu2": "0.85"},
        },
        "A2": {
            "stage": 2,
            "law": {"a": "2271.117", "b": "-496.763", "d": "28.351", "g": "288.122"},
            "inertias": ("0.00301955", "0.0064387"),
            "free": {"alpha3": "2", "alpha4": "2", "gamma3": "0.9", "beta4": "0.2", "mu4": "0.8"},
        },
    }
    described = {}
    for name, plant in kinds.items():
        stage, hub, link = plant["stage"], 2 * plant["stage"] - 1, 2 * plant["stage"]
        # Rational arithmetic: the orders of the law come out as the decimals they are.
        free = {key: Fraction(value) for key, value in plant["free"].items()}
        alpha_hub, alpha_link = free[f"alpha{hub}"], free[f"alpha{link}"]
        gamma, beta, mu = free[f"gamma{hub}"], free[f"beta{link}"], free[f"mu{link}"]
        law = {key: Fraction(value) for key, value in plant["law"].items()}
        motor, arm = (Fraction(value) for value in plant["inertias"])
        r = (motor + arm) / arm
        theta_hub, theta_link, current = f"theta{stage}1", f"theta{stage}2", f"I{stage}"
        orders = {
            f"beta{hub}": alpha_hub - alpha_link + mu - gamma + beta,
            f"mu{hub}": alpha_hub - alpha_link + 2 * mu - gamma,
            f"gamma{link}": 2 * gamma - alpha_hub + alpha_link - mu,
        }
        equations = [
            {
                "output": theta_hub,
                "alpha": alpha_hub,
                "terms": [
                    (f"a{hub}", theta_link, law["a"], orders[f"beta{hub}"]),
                    (f"b{hub}", theta_hub, law["b"], gamma),
                    (f"d{hub}", theta_link, law["d"], orders[f"mu{hub}"]),
                    (f"g{hub}", current, law["g"], Fraction(0)),
                ],
            },
            {
                "output": theta_link,
                "alpha": alpha_link,
                "terms": [
                    (f"a{link}", theta_link, -law["a"] * r, beta),
                    (f"b{link}", theta_hub, -law["b"], orders[f"gamma{link}"]),
                    (f"d{link}", theta_link, -law["d"] * r, mu),
                    (f"g{link}", current, -law["g"], Fraction(0)),
                ],
            },
        ]
        described[name] = {
            "stage": stage,
            "input_order": "published",
            "free_orders": {key: float(value) for key, value in free.items()},
            "derived_orders": {key: float(value) for key, value in orders.items()},
            "law_coefficients": {**{key: float(value) for key, value in law.items()}, "r": float(r)},
            "derived_input_order": float(alpha_link - mu + gamma - alpha_hub),
            "equations": [
                {
                    "output": equation["output"],
                    "alpha": float(equation["alpha"]),
                    "terms": [
                        {"name": term, "signal": signal, "coefficient": float(coefficient), "order": float(order)}
                        for term, signal, coefficient, order in equation["terms"]
                    ],
                }
                for equation in equations
            ],
            "input": {
                "signal": current,
                "shape": "square",
                "amplitude": 0.3,
                "period": 2.0,
                "sample_step": 0.002,
                "samples": 5000,
            },
        }
    return {
        "what": "D^alpha output = sum of coefficient D^order signal, from rest; the input is +amplitude in the first "
        "half of each period and held over its samples; derived_input_order is the order on the current that the "
        "published equation of the deflection leaves out",
        "plants": described,
    }


FILES: dict[str, Callable[[], dict]] = {
    "block_pulse_kernel.json": block_pulse_kernel,
    "digamma.json": digamma,
    "grunwald_letnikov.json": grunwald_letnikov,
    "step_responses.json": step_responses,
    "derivatives.json": derivatives,
    "plants.json": plants,
}


def render(document: dict) -> str:
    """Print a document as JSON with one record to a line, so that a change shows as the records it touches."""
    lines = []
    for key, value in {"note": NOTE, **document}.items():
        if key == "records":
            body = "[\n" + ",\n".join("  " + json.dumps(record) for record in value) + "\n ]"
        elif isinstance(value, dict):
            body = "{\n" + ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in value.items()) + "\n }"
        else:
            body = json.dumps(value)
        lines.append(f" {json.dumps(key)}: {body}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def main() -> None:
    """Rewrite every reference file."""
    for name, make in FILES.items():
        with mp.workdps(DIGITS):
            text = render(make())
        (HERE / name).write_text(text, encoding="utf-8")
        print(f"{name}: {len(text)} bytes")


if __name__ == "__main__":
    main()
