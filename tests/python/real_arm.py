"""The real arm beside the virtual one under the same currents: runs, correlations, amplitudes by band."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import signal

import ftlm
from ftlm import rig
from ftlm.rig.recording import STOCK_FILTER
from measured import DATA

ANGLES = ("theta11", "theta12", "theta21", "theta22")
#: Unit of the arm, by the run that it made, and the set that is fitted to it.
UNITS = {"psf": "measured", "lqr": "measured-lqr"}
#: -K_s/J_2 and -B_2/J_2 of a link that is driven by a hub: the maker's stiffnesses, and a damping that lets it forget.
LINKS = {1: (39.9572 / 0.170434, 1.0), 2: (6.85775 / 0.0064387, 0.085608 / 0.0064387)}
#: What is left out at the start: deflections are zeroed there, and the reference link has not forgotten its start.
FIRST = 600


def commanded(unit: str) -> ftlm.Run:
    """The run of a unit under its commanded currents."""
    return ftlm.load(
        DATA / f"two_link_{unit}" / f"{unit}.csv",
        time="t_s",
        inputs={"I1": "Im1_cmd_A", "I2": "Im2_cmd_A"},
        outputs={
            "theta11": "th11_deg",
            "theta12": "th12_deg",
            "theta21": "th21_deg",
            "theta22": "th22_deg",
            "I1_measured": "Im1_meas_A",
            "I2_measured": "Im2_meas_A",
        },
        units=dict.fromkeys(ANGLES, "deg"),
        name=unit,
    )


def beside(real: ftlm.Run, name: str) -> ftlm.Run:
    """A virtual run under the commands of a measured one; without the controller it may drift further."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "currents.csv"
        columns = np.column_stack([real.time, real["I1"], real["I2"]])
        np.savetxt(path, columns, delimiter=",", header="t_s,I1,I2", comments="")
        arm = replace(rig.ArmParameters.load(name), travel=(9.0, 9.0))
        return rig.record(input="csv", file=path, duration=real.duration, parameters=arm, sensor_filter="stock", seed=1)


def filtered(values: np.ndarray, numerator: list[float], denominator: list[float], step: float) -> np.ndarray:
    """A signal that starts from rest through a transfer function, linear between its samples."""
    system = signal.cont2discrete((numerator, denominator), step, method="foh")
    return signal.lfilter(system[0].ravel(), system[1], values - values[0])


def correlations(run: ftlm.Run) -> list[float]:
    """Of each deflection with its current, and with a link of the maker's stiffness that its hub drives alone."""
    w, damping = STOCK_FILTER
    out = []
    for stage, (stiffness, friction) in LINKS.items():
        bend = run[f"theta{stage}2"][FIRST:]
        driven = filtered(run[f"theta{stage}1"], [-1.0, 0.0, 0.0], [1.0, friction, stiffness], run.step)
        driven = filtered(driven, [w * w], [1.0, 2.0 * damping * w, w * w], run.step)[FIRST:]
        out += [float(np.corrcoef(bend, other)[0, 1]) for other in (run[f"I{stage}"][FIRST:], driven)]
    return out


def levels(values: np.ndarray, bands: list[tuple[float, float]]) -> np.ndarray:
    """Amplitude density in each band, from 1.2 s on."""
    f, density = signal.welch(signal.detrend(values[600:9700]), 500.0, nperseg=2048)
    return np.array([np.sqrt(density[(f >= low) & (f < high)].mean()) for low, high in bands])


def factor(run: ftlm.Run, real: ftlm.Run, names: tuple[str, ...], bands: list[tuple[float, float]]) -> float:
    """How far apart the levels are at worst, as a factor."""
    ratios = [np.log(levels(run[n], bands) / levels(real[n], bands)) for n in names]
    return float(np.exp(np.abs(ratios).max()))
