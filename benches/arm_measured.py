"""Real runs of the arm predicted: what each piece of physics and each fractional order is worth on runs never fitted.

``python benches/arm.py measured`` fits deflections on the run of one laboratory (and on both) and judges them on each.
``orders`` frees one order after another on each stage of the physics, ``gains`` estimates the gains of the judged
unit's gauges besides, ``steps`` fits five LQG steps and judges all others, ``left-out`` leaves each of the eighteen
steps out, ``rival`` sets state-space models of jax-sysid beside. Every figure is the fit in percent of the free run,
sample by sample, other angles as measured. Initial terms, the filter's state and, where the equation has one, the
gauge's zero are the judged run's own; everything else is fitted.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import ftlm
import lsim_link
from arm_rival import rows as rival_rows

FOLDER = Path(os.environ.get("FTLM_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
ANGLES = {"theta11": "th11_deg", "theta12": "th12_deg", "theta21": "th21_deg", "theta22": "th22_deg"}


def arm_run(name: str, thin: int = 4) -> ftlm.Run:
    """One of the two laboratories' runs, thinned to 8 ms, in rad."""
    run = ftlm.load(
        FOLDER / f"two_link_{name}" / f"{name}.csv",
        time="t_s",
        inputs={"I1": "Im1_meas_A", "I2": "Im2_meas_A"},
        outputs=ANGLES,
        units=dict.fromkeys(ANGLES, "deg"),
        intersample={"I1": "foh", "I2": "foh"},
    )
    if name == "psf":
        run = run.window(1.1, 19.5)
    signals = {n: run[n][::thin] for n in (*run.inputs, *run.outputs)}
    return ftlm.Run.from_arrays(
        step=thin * run.step,
        inputs={n: signals[n] for n in run.inputs},
        outputs={n: signals[n] for n in run.outputs},
        units=run.units,
        intersample=run.intersample,
        name=name,
    )


def step_run(path: Path, thin: int = 4) -> ftlm.Run:
    """A step of the single stage, both angles, thinned to 8 ms."""
    angles = {n: ANGLES[n] for n in ("theta11", "theta12")}
    run = ftlm.load(path, time="t_s", outputs=angles, units=dict.fromkeys(angles, "deg"))
    return ftlm.Run.from_arrays(
        step=thin * run.step, inputs={}, outputs={n: run[n][::thin] for n in angles}, name=path.stem
    )


#: The link's equation (15) and what physics adds, piece by piece: words, filtered signals, whether a gauge's zero is
#: estimated.
STAGES: dict[str, list[tuple[str, str, tuple[str, ...], bool]]] = {
    "theta12": [
        ("(15), no filter", "{a} + {d} - {h}", (), False),
        ("filter", "{a} + {d} - {h}", ("theta12",), False),
        ("stage coupling", "{a} + {d} - {h} + p D^2 theta21 + q D^2 theta22", ("theta12", "theta22"), False),
        ("offset", "{a} + {d} - {h} + p D^2 theta21 + q D^2 theta22", ("theta12", "theta22"), True),
        ("hub angle", "{a} + {d} - {h} + p D^2 theta21 + q D^2 theta22 + e theta11", ("theta12", "theta22"), True),
        (
            "hub angle, rate of theta22",
            "{a} + {d} - {h} + p D^2 theta21 + q D^2 theta22 + e theta11 + w D theta22",
            ("theta12", "theta22"),
            True,
        ),
        ("gain", "{a} + {d} + b {h} + p D^2 theta21 + q D^2 theta22 + e theta11", ("theta12", "theta22"), True),
    ],
    "theta22": [
        ("(15), no filter", "{a} + {d} - {h}", (), False),
        ("filter", "{a} + {d} - {h}", ("theta22",), False),
        ("stage coupling", "{a} + {d} - {h} + p D^2 theta11 + q D^2 theta12", ("theta12", "theta22"), False),
        ("offset", "{a} + {d} - {h} + p D^2 theta11 + q D^2 theta12", ("theta12", "theta22"), True),
        ("hub angle", "{a} + {d} - {h} + p D^2 theta11 + q D^2 theta12 + e theta21", ("theta12", "theta22"), True),
        (
            "offset, rate of theta12",
            "{a} + {d} - {h} + p D^2 theta11 + q D^2 theta12 + w D theta12",
            ("theta12", "theta22"),
            True,
        ),
        ("gain", "{a} + {d} + b {h} + p D^2 theta11 + q D^2 theta12 + e theta21", ("theta12", "theta22"), True),
    ],
}
#: What may be fractional: the link's elasticity, its damping, the hub's motion.
FREED = {
    "whole": {},
    "D^beta elasticity": {"a": "a D^beta {y}"},
    "D^mu damping": {"d": "d D^mu {y}"},
    "D^gamma hub": {"h": "D^gamma {hub}"},
}


#: Where they are looked for.
BOUNDS = {"beta": (0.0, 0.95), "mu": (0.05, 1.95), "gamma": (1.5, 2.4)}


def words(output: str, text: str, freed: str = "whole") -> str:
    """An equation of a deflection, one of its orders freed."""
    hub = output[:-1] + "1"
    parts = {"a": "a {y}", "d": "d D {y}", "h": "D^2 {hub}"} | FREED[freed]
    return f"D^2 {output} = " + text.format(**{n: p.format(y=output, hub=hub) for n, p in parts.items()})


def structure(text: str, filtered: Sequence[str], offset: bool) -> ftlm.Structure:
    """Words with the stock filter; initial terms are Caputo's, so that whole and fractional orders have alike ones."""
    sensor = ftlm.SensorFilter.low_pass(filtered) if filtered else None
    bounds = {n: (*ends, 0.05) for n, ends in BOUNDS.items() if f"^{n} " in text}
    return ftlm.equation(
        text, sensor_filter=sensor, offset="constant" if offset else "none", initial="caputo", orders=bounds
    )


#: Beyond the stages: the torque of link 2's spring in place of its acceleration, the -1 of a rigid gauge, what was best
#: while a deflection that drives was filtered twice, and all of the hub's gain freed.
OTHERS = [
    (
        "spring torque of link 2, gauge, b = -1",
        "D^2 theta12 = a theta12 + d D theta12 - D^2 theta11 + p D^2 theta21 + q theta22 + s theta21 + r theta11",
        ("theta12", "theta22"),
        False,
    ),
    (
        "the same, offset",
        "D^2 theta12 = a theta12 + d D theta12 - D^2 theta11 + p D^2 theta21 + q theta22 + s theta21 + r theta11",
        ("theta12", "theta22"),
        True,
    ),
    (
        "the same, offset, b free",
        "D^2 theta12 = a theta12 + d D theta12 + b D^2 theta11 + p D^2 theta21 + q theta22 + s theta21 + r theta11",
        ("theta12", "theta22"),
        True,
    ),
    (
        "theta22 filtered twice",
        "D^2 theta12 = a theta12 + d D theta12 + b D^2 theta11 + p D^2 theta21 + q theta22 + s theta21 + r theta11",
        ("theta12",),
        False,
    ),
    (
        "theta22 filtered twice, a spring-pot",
        "D^2 theta12 = a D^beta theta12 + d D theta12 + b D^2 theta11"
        " + p D^2 theta21 + q theta22 + s theta21 + r theta11",
        ("theta12",),
        False,
    ),
    (
        "rate of theta22, b free",
        "D^2 theta12 = a theta12 + d D theta12 + b D^2 theta11 + p D^2 theta21"
        " + q D^2 theta22 + e theta11 + w D theta22",
        ("theta12", "theta22"),
        True,
    ),
    (
        "rate of theta12, b free",
        "D^2 theta22 = a theta22 + d D theta22 + b D^2 theta21 + p D^2 theta11 + q D^2 theta12 + w D theta12",
        ("theta12", "theta22"),
        True,
    ),
    (
        "gain, no offset, no hub angle",
        "D^2 theta22 = a theta22 + d D theta22 + b D^2 theta21 + p D^2 theta11 + q D^2 theta12",
        ("theta12", "theta22"),
        False,
    ),
    (
        "gain, no hub angle",
        "D^2 theta22 = a theta22 + d D theta22 + b D^2 theta21 + p D^2 theta11 + q D^2 theta12",
        ("theta12", "theta22"),
        True,
    ),
]


def numbers(result: ftlm.Identification, names: Sequence[str] = ()) -> str:
    """Values with standard errors, orders with intervals."""
    joint = result.joint
    assert joint is not None
    out = []
    for name, value in zip(joint.names, joint.values.tolist(), strict=True):
        if name in result.orders:
            low, high = joint.intervals[name]
            out.append(f"{name} {value:.3f} ({low:.3f} to {high:.3f})")
        elif not names or name in names:
            out.append(f"{name} {value:.4g} ± {joint.standard_errors[name]:.2g}")
    return ", ".join(out)


def fit_quadratic(runs: Sequence[ftlm.Run], structure: ftlm.Structure) -> ftlm.Identification:
    """A joint fit on one thread."""
    return ftlm.identify(list(runs), structure, method=ftlm.OutputError(intervals="quadratic"), threads=1)


def validation_rows(
    runs: dict[str, ftlm.Run], structure: ftlm.Structure, uses: Sequence[tuple[str, ...]]
) -> Iterator[tuple[str, ...]]:
    """Fitted on some of the runs, the fit on each of them, its numbers, processor time."""
    output = structure.outputs[0]
    for names in uses:
        start_time = time.process_time()
        try:
            result = fit_quadratic([runs[u] for u in names], structure)
            fits = {n: result.model.compare(r).fit[output] for n, r in runs.items()}
        except ftlm.FtlmError as error:
            yield "+".join(names), str(error), "", ""
            continue
        fits_text = ", ".join(f"{v:.1f}" if n in names else f"**{v:.1f}**" for n, v in fits.items())
        yield "+".join(names), fits_text, numbers(result), f"{time.process_time() - start_time:.0f} s"


ONE_AND_BOTH = (("psf",), ("lqr",), ("psf", "lqr"))


def measurements() -> Iterator[str]:
    """Physics piece by piece, integer orders; the run that was not fitted to in bold."""
    runs = {n: arm_run(n) for n in ("psf", "lqr")}
    yield "| output | physics | fitted on | psf, lqr | numbers | time |"
    yield "| --- | --- | --- | --- | --- | --- |"
    rows = [
        (o, name, words(o, text), filtered, zero)
        for o, stages in STAGES.items()
        for name, text, filtered, zero in stages
    ]
    rows += [(text[4:11], name, text, filtered, zero) for name, text, filtered, zero in OTHERS]
    for output, name, text, filtered, zero in rows:
        for row in validation_rows(runs, structure(text, filtered, zero), ONE_AND_BOTH):
            yield f"| {output} | {name} | {' | '.join(row)} |"


def orders(outputs: Sequence[str] = ("theta12", "theta22")) -> Iterator[str]:
    """Return the free orders that improve the prediction of the validation run, for each stage of the physics."""
    runs = {n: arm_run(n) for n in ("psf", "lqr")}
    yield "| output | physics so far | order free | fitted on | psf, lqr | the order, 95 % |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for output, stages in ((o, STAGES[o]) for o in outputs):
        for name, text, filtered, zero in stages:
            for freed in FREED:
                model_structure = structure(words(output, text, freed), filtered, zero)
                for names, fits_text, values, _ in validation_rows(runs, model_structure, ONE_AND_BOTH[:2]):
                    order = next((v for v in values.split(", ") if v.startswith(("beta", "mu", "gamma"))), "")
                    yield f"| {output} | {name} | {freed} | {names} | {fits_text} | {order} |"


#: Equations whose gauges are compared: what the hubs' motion drives, in which the own gauge's gain stands, and what
#: the other gauge read, in which the ratio of both stands. Signals, integer orders, coefficients; -1 if there is none.
GAUGES = {
    "theta12": (
        [("theta11", 2, ""), ("theta21", 2, "p"), ("theta21", 0, "s"), ("theta11", 0, "r")],
        [("theta22", 0, "q")],
    ),
    "theta22": ([("theta21", 2, ""), ("theta11", 2, "p")], [("theta12", 2, "q")]),
}


def gains() -> Iterator[str]:
    """What two gains of the judged unit's gauges explain: everything else as fitted on the other unit."""
    runs = {n: arm_run(n) for n in ("psf", "lqr")}
    yield "| output | fitted on | judged on | as fitted | with its gains | own gain | ratio |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    filtered = ("theta12", "theta22")
    for output, (hubs, other) in GAUGES.items():
        driving = " ".join(f"+ {c} D^{m} {n}" if c else f"- D^{m} {n}" for n, m, c in (*hubs, *other))
        model_structure = structure(
            f"D^2 {output} = a {output} + d D {output} {driving}".replace("D^0 ", ""), filtered, offset=True
        )
        for name, judge in (("psf", "lqr"), ("lqr", "psf")):
            result = fit_quadratic([runs[name]], model_structure)
            coefficients, run = result.coefficients, runs[judge]
            # SciPy's responses of the fitted link: the two gains are linear in them.
            table = lsim_link.columns(
                {n: np.asarray(run[n]) for n in ANGLES},
                run.step,
                coefficients["a"],
                coefficients["d"],
                [(n, m) for n, m, _ in (*hubs, *other)],
                filtered,
                offset=True,
            )
            parts = [coefficients[c] if c else -1.0 for *_, c in (*hubs, *other)]
            shares = table[:, : len(hubs)] @ parts[: len(hubs)], table[:, len(hubs) : len(parts)] @ parts[len(hubs) :]
            columns = np.column_stack((*shares, table[:, len(parts) :]))
            size = np.linalg.norm(columns, axis=0)
            gain = np.linalg.lstsq(columns / size, run[output], rcond=1e-12)[0] / size
            free = run[output] - np.column_stack(shares).sum(axis=1)
            rest = columns[:, 2:]
            residual = free - rest @ np.linalg.lstsq(rest, free, rcond=1e-12)[0]
            fits = [lsim_link.fit(run[output], e) for e in (residual, run[output] - columns @ gain)]
            ours = result.model.compare(run).fit[output]
            yield (
                f"| {output} | {name} | {judge} | **{ours:.1f}** (SciPy {fits[0]:.1f}) | {fits[1]:.1f} | "
                f"{gain[0]:.3f} | {gain[1]:.3f} |"
            )


#: Both links from the hubs' motion alone: no measured deflection drives a free run, so nothing observes it.
LINKS = (
    "D^2 theta12 = a2 theta12 + d2 D theta12 - D^2 theta11 + p2 D^2 theta21 + q2 D^2 theta22 + e2 theta11",
    "D^2 theta22 = a4 theta22 + d4 D theta22 - D^2 theta21 + p4 D^2 theta11 + q4 D^2 theta12",
)
RATES = (" + w2 D theta22", " + w4 D theta12")
#: About what either link has alone, driven by the other as it was measured: found from nowhere, psf's fit has -17 %.
NEAR = {
    "a2": -187.0,
    "d2": -0.6,
    "p2": -0.14,
    "q2": -0.33,
    "e2": -0.6,
    "a4": -460.0,
    "d4": -2.0,
    "p4": -2.0,
    "q4": -2.5,
}


def hubs() -> Iterator[str]:
    """What the rate of the other deflection is worth where it is simulated: dissipation would be worth as much."""
    runs = {}
    for name in ("psf", "lqr"):
        run = arm_run(name)
        runs[name] = ftlm.Run.from_arrays(
            step=run.step,
            inputs={n: run[n] for n in ("theta11", "theta21")},
            outputs={n: run[n] for n in ("theta12", "theta22")},
            name=name,
            intersample=dict.fromkeys(("theta11", "theta21"), "foh"),
        )
    yield "| both links from the hubs | fitted on | theta12: psf, lqr | theta22: psf, lqr | numbers |"
    yield "| --- | --- | --- | --- | --- |"
    sensor = ftlm.SensorFilter.low_pass(["theta12", "theta22"])
    for name, more in (("own damping", ("", "")), ("and rates of the other", RATES)):
        words = [text + rate for text, rate in zip(LINKS, more, strict=True)]
        structure = ftlm.equation("\n".join(words), sensor_filter=sensor, offset="constant", initial="caputo")
        structure = replace(structure, coupling="simulated")
        for run_name in ("psf", "lqr"):
            start = NEAR | ({"w2": 0.0, "w4": 0.0} if more[0] else {})
            result = ftlm.identify(
                runs[run_name], structure, method=ftlm.OutputError(intervals="quadratic", start=start), threads=1
            )
            fits = {n: result.model.compare(r).fit for n, r in runs.items()}
            fits_text = " | ".join(
                ", ".join(f"{f[y]:.1f}" if n == run_name else f"**{f[y]:.1f}**" for n, f in fits.items())
                for y in structure.outputs
            )
            yield f"| {name} | {run_name} | {fits_text} | {numbers(result)} |"


def rival() -> Iterator[str]:
    """Linear state-space models of jax-sysid on the same runs and inputs."""
    yield "| output | order | numbers | fitted on | psf, lqr | time |"
    yield "| --- | --- | --- | --- | --- | --- |"
    uses = {"theta12": ("theta11", "theta21", "theta22"), "theta22": ("theta21", "theta11", "theta12")}
    for row in rival_rows({n: arm_run(n) for n in ("psf", "lqr")}, uses):
        yield f"| {' | '.join(row)} |" if len(row) > 1 else row[0]


# ------------------------------------------------------------------------------------ the single stage's eighteen steps

#: LQG runs that are fitted: 5° and the way back are left to be judged, and the largest step down.
FIVE = ("lqg_30", "lqg_20", "lqg_10", "lqg_minus10", "lqg_minus20")
SINGLE = {
    "whole": ("{a} + {d} + b {h} + r theta11", "whole", False),
    "whole, offset, b = -1": ("{a} + {d} - {h} + r theta11", "whole", True),
    "D^mu, offset, b = -1": ("{a} + {d} - {h} + r theta11", "D^mu damping", True),
    "D^beta, offset, b = -1": ("{a} + {d} - {h} + r theta11", "D^beta elasticity", True),
    "whole, offset": ("{a} + {d} + b {h} + r theta11", "whole", True),
    "D^mu": ("{a} + {d} + b {h} + r theta11", "D^mu damping", False),
    "D^mu, offset": ("{a} + {d} + b {h} + r theta11", "D^mu damping", True),
    "D^beta, offset": ("{a} + {d} + b {h} + r theta11", "D^beta elasticity", True),
}


def all_steps() -> dict[str, ftlm.Run]:
    """All eighteen."""
    return {p.stem: step_run(p) for p in sorted((FOLDER / "two_link_steps").glob("*.csv"))}


def spread(fits: Sequence[float]) -> str:
    """Median and least."""
    return f"{np.median(fits):.1f} ({min(fits):.1f})"


def steps() -> Iterator[str]:
    """Five LQG runs fitted together, all others judged: median (least)."""
    runs = all_steps()
    yield "| θ₁₂ | five fitted | four other LQG | nine LQR | all thirteen | numbers |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for name, (text, freed, zero) in SINGLE.items():
        result = fit_quadratic([runs[n] for n in FIVE], structure(words("theta12", text, freed), ["theta12"], zero))
        fits = {n: result.model.compare(r).fit["theta12"] for n, r in runs.items()}
        own = [fits[n] for n in FIVE]
        lqg = [v for n, v in fits.items() if n.startswith("lqg") and n not in FIVE]
        lqr = [v for n, v in fits.items() if n.startswith("lqr")]
        yield f"| {name} | {spread(own)} | {spread(lqg)} | {spread(lqr)} | {spread(lqg + lqr)} | {numbers(result)} |"


def left_out() -> Iterator[str]:
    """Each of the eighteen steps judged by a fit on the seventeen others."""
    runs = all_steps()
    kinds = ("whole, offset", "D^mu, offset")
    yield f"| left out | {' | '.join(kinds)} |"
    yield "| --- | --- | --- |"
    fits: dict[str, list[float]] = {k: [] for k in kinds}
    for name, run in runs.items():
        for kind in kinds:
            text, freed, zero = SINGLE[kind]
            model_structure = structure(words("theta12", text, freed), ["theta12"], zero)
            result = fit_quadratic([r for n, r in runs.items() if n != name], model_structure)
            fits[kind].append(result.model.compare(run).fit["theta12"])
        yield f"| {name} | {' | '.join(f'{v[-1]:.1f}' for v in fits.values())} |"
    yield f"| median (least) | {' | '.join(spread(v) for v in fits.values())} |"
