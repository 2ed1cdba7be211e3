"""The virtual arm's set "measured", measured again: both links, then both hubs, from the runs of two laboratories.

``python benches/virtual_arm.py fit`` fits each link driven by the measured hubs, all signals behind the arm's filter,
then each hub with its friction and one offset a run, driven by its current and by what its link does before the filter.
``python benches/virtual_arm.py beside`` puts the real currents into the virtual arm and sets what it does beside what
the real one did: correlations with their signs, amplitudes as a whole and by band.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from scipy import signal

import ftlm
from ftlm.arm.flexible_link import PARAMETER_SETS
from ftlm.rig.recording import STOCK_FILTER

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "python"))

import real_arm
from measured import DATA

HUBS, DEFLECTIONS = ("theta11", "theta21"), ("theta12", "theta22")
ANGLES = {"theta11": "th11_deg", "theta12": "th12_deg", "theta21": "th21_deg", "theta22": "th22_deg"}
#: Deflections of psf are zeroed before.
FIRST = {"psf": 1.1, "lqr": 0.0}
THIN = 4
#: Links of integer orders; their hub's own acceleration is known, stages push on each other as the energies say.
LINKS = {
    1: "D^2 theta12 = a theta12 + d D theta12 - D^2 theta11 + p D^2 second",
    2: "D^2 theta22 = a theta22 + d D theta22 - D^2 theta21 + p D^2 tip",
}
#: (J_j1 + J_j2)/J_j2 of the maker's file: torque per ampere and the hub's inertia are seen only together.
RATIOS = {j: link.inertia_ratio for j, link in PARAMETER_SETS["effective"].items()}
HUB = "D^2 {hub} = - v D {hub} + g {current} + {k:.6g} {bend} - f*sign(D {hub}) + c"


def laboratory(name: str) -> ftlm.Run:
    """A whole run, measured currents, angles in rad."""
    return ftlm.load(
        DATA / f"two_link_{name}" / f"{name}.csv",
        time="t_s",
        inputs={"I1": "Im1_meas_A", "I2": "Im2_meas_A"},
        outputs=ANGLES,
        units=dict.fromkeys(ANGLES, "deg"),
        name=name,
    )


def behind_filter(values: np.ndarray, step: float) -> np.ndarray:
    """A signal through the arm's low-pass, at rest where it begins."""
    w, damping = STOCK_FILTER
    system = signal.cont2discrete(([w * w], [1.0, 2.0 * damping * w, w * w]), step, method="foh")
    return signal.lfilter(system[0].ravel(), system[1], values - values[0]) + values[0]


def cut(run: ftlm.Run, inputs: dict[str, np.ndarray], outputs: dict[str, np.ndarray]) -> ftlm.Run:
    """Signals of a run from where they can be used, at 8 ms."""
    skip = round(FIRST.get(run.name, 0.0) / run.step)

    def thin(values: np.ndarray) -> np.ndarray:
        return values[skip::THIN]

    return ftlm.Run.from_arrays(
        step=THIN * run.step,
        inputs={n: thin(v) for n, v in inputs.items()},
        name=run.name,
        outputs={n: thin(v) for n, v in outputs.items()},
        intersample=dict.fromkeys(inputs, "foh"),
    )


def for_links(run: ftlm.Run) -> ftlm.Run:
    """All angles behind the filter, and the angles of what stands on link 1 and of link 2 on its hub."""
    signals = {n: behind_filter(run[n], run.step) for n in HUBS} | {n: run[n] for n in DEFLECTIONS}
    sums = {"tip": signals["theta11"] + signals["theta12"], "second": signals["theta21"] + signals["theta22"]}
    return cut(run, {n: signals[n] for n in HUBS} | sums, {n: signals[n] for n in DEFLECTIONS})


def fit_and_print(words: str, runs: list[ftlm.Run], validation: list[ftlm.Run]) -> ftlm.Identification:
    """Fit, and say numbers with standard errors and the fit on every run."""
    start_time = time.process_time()
    result = ftlm.identify(runs, ftlm.equation(words), threads=1, method=ftlm.OutputError(intervals="quadratic"))
    output = result.model.outputs[0]
    fits = ", ".join(f"{r.name} {result.model.compare(r).fit[output]:.1f}" for r in validation)
    numbers = ", ".join(f"{n} {v:.5g} ± {result.standard_errors[n]:.2g}" for n, v in result.coefficients.items())
    names = "+".join(r.name for r in runs)
    print(f"| {output} | {names} | {numbers} | {fits} | {time.process_time() - start_time:.0f} s", flush=True)
    return result


def bends(run: ftlm.Run, links: dict[int, dict[str, float]]) -> dict[str, np.ndarray]:
    """Both deflections before the filter, as the fitted links have them from the measured hubs."""
    p1, p2 = links[1]["p"], links[2]["p"]
    words = [
        f"D^2 theta12 = {links[1]['a']} theta12 + {links[1]['d']} D theta12 - D^2 theta11 + {p1} D^2 theta21"
        f" + {p1} D^2 theta22",
        f"D^2 theta22 = {links[2]['a']} theta22 + {links[2]['d']} D theta22 - D^2 theta21 + {p2} D^2 theta11"
        f" + {p2} D^2 theta12",
    ]
    # The signs as they are read: an equation in words takes no "+ -".
    equations = tuple(ftlm.equation(w.replace("+ -", "- ")).equations[0] for w in words)
    model = ftlm.Model(ftlm.Structure(equations, coupling="simulated", initial="rest"))
    driven = ftlm.Run.from_arrays(
        step=run.step,
        inputs={n: run[n] - run[n][0] for n in HUBS},
        outputs={n: run[n] for n in DEFLECTIONS},
        intersample=dict.fromkeys(HUBS, "foh"),
        name=run.name,
    )
    solved = model.simulate(driven, tolerance=1e-4)
    return {n: solved[n] for n in DEFLECTIONS}


def fit() -> None:
    """Every number of the set, with its source."""
    whole = {n: laboratory(n) for n in ("psf", "lqr")}
    runs = {n: for_links(r) for n, r in whole.items()}
    both = list(runs.values())
    links = {}
    for stage, words in LINKS.items():
        for runs_of_fit in ([runs["psf"]], [runs["lqr"]], both):
            links[stage] = fit_and_print(words, runs_of_fit, both).coefficients
    bent = {n: bends(r, links) for n, r in whole.items()}
    for stage in (1, 2):
        hub, bend, current = f"theta{stage}1", f"theta{stage}2", f"I{stage}"
        own = [cut(r, {current: r[current], bend: bent[n][bend]}, {hub: r[hub]}) for n, r in whole.items()]
        # The link is as stiff for its hub as for itself: K_s/J_j1 is K_s/J_j2 over J_j1/J_j2 of the maker's file.
        words = HUB.format(hub=hub, bend=bend, current=current, k=-links[stage]["a"] / (RATIOS[stage] - 1.0))
        for run in own:
            result = fit_and_print(words, [run], [run])
            if result.standard_errors["g"] > 0.1 * result.coefficients["g"]:
                # A hub that friction holds so well tells torque and friction apart only where one is known.
                torque = PARAMETER_SETS["effective"][stage].coefficients(stage)[f"g{2 * stage - 1}"]
                fit_and_print(words.replace("g I", f"{torque:.6g} I"), [run], [run])


def beside() -> None:
    """Each unit's run beside that of the virtual arm under the same currents, by each set."""
    bands = [(0.2, 1.0), (1.0, 1.5), (1.5, 2.0), (2.0, 3.0), (3.0, 5.0)]
    for unit in real_arm.UNITS:
        real = real_arm.commanded(unit)
        words = ", ".join(f"{v:+.2f}" for v in real_arm.correlations(real))
        print(f"| {unit} | real | {words} |", flush=True)
        for name in ("effective", "measured", "measured-lqr"):
            run = real_arm.beside(real, name)
            words = ", ".join(f"{v:+.2f}" for v in real_arm.correlations(run))
            ratios = ", ".join(f"{n} {run[n][600:].std() / real[n][600:].std():.2f}" for n in ANGLES)
            worst = {n: real_arm.factor(run, real, (n,), bands) for n in ANGLES}
            bands_text = ", ".join(f"{n} {v:.1f}" for n, v in worst.items())
            print(
                f"| {unit} | {name} | {words} | deviation over the real one: {ratios} | worst band: {bands_text} |",
                flush=True,
            )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("fit", "beside"))
    if parser.parse_args().what == "fit":
        fit()
    else:
        beside()


if __name__ == "__main__":
    main()
