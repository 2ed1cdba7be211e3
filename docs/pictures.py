"""Draw the pictures of the pages from seeded runs, so that they show the results of this version."""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import ftlm
from ftlm import control

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Folder of the tutorials.
TUTORIALS = Path(__file__).parent / "tutorials"


def example(name: str, kind: str, seed: int) -> ftlm.Run:
    """Return a run of the tutorial's machine: a fractional oscillator with 1 % noise."""
    t = np.arange(2001) * 0.01
    u = np.sign(np.sin(2 * np.pi * t / 5 + 1e-9)) if kind == "square" else np.sin(0.2 * t**1.6)
    truth = ftlm.Model(ftlm.equation("D^1.8 y = -0.6 D^0.8 y - 9 y + 4 u"))
    clean = truth.simulate(ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": 0 * t}, name=name))
    noise = 0.01 * np.std(clean["y"]) * np.random.default_rng(seed).standard_normal(t.size)
    return ftlm.Run.from_arrays(step=0.01, inputs={"u": u}, outputs={"y": clean["y"] + noise}, name=name)


def draw(folder: Path) -> None:
    """Write every picture; the picture of the README is stored beside this file."""
    folder.mkdir(exist_ok=True)
    square, chirp = example("square", "square", 1), example("chirp", "chirp", 2)
    structure = ftlm.equation(
        "D^alpha y = a1 D^nu y + a0 y + b0 u", orders={"alpha": "1.4:2:0.05", "nu": "0.2:1.2:0.05"}
    )
    best = ftlm.identify(square, ftlm.equation("D^alpha y = a1 D^nu y + a0 y + b0 u"))
    searched = ftlm.identify(square, structure, method="multi-innovation")
    drawn = {
        "fit": ftlm.plot.fit(best.model, chirp),
        "residuals": ftlm.plot.residuals(best),
        "bode": ftlm.plot.bode(best),
        "landscape": ftlm.plot.landscape(searched),
        "unseen": unseen(),
    }
    drawn["next-experiment"] = next_experiment(folder)
    for name, figure in (drawn | performance() | moves() | {"boxes": boxes()} | tutorials()).items():
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


def performance() -> dict[str, Figure]:
    """Return charts of computation time over problem size, from the results of the benchmark."""
    from matplotlib.figure import Figure  # noqa: PLC0415 — only drawing needs it

    measured = json.loads((Path(__file__).parent / "performance.json").read_text(encoding="utf-8"))
    searches = measured["searches"]

    def axes(x: str, y: str) -> tuple[Figure, Axes]:
        figure = Figure(figsize=(7, 3.6), layout="constrained")
        figure.suptitle(
            "commit {commit}, {machine}, {cores} cores, load {load:.1f}".format(**measured["measured"]),
            fontsize="small",
        )
        plot = figure.add_subplot(xscale="log", yscale="log", xlabel=x, ylabel=y)
        plot.grid(visible=True, which="major", linewidth=0.4)
        return figure, plot

    drawn = {}
    pulses = max({s["m"] for s in searches}, key=lambda m: sum(s["m"] == m for s in searches))
    smallest = min(s["candidates"] for s in searches if s["m"] != pulses)
    for name, x, label, chosen in (
        ("cost-by-candidates", "candidates", "candidates", [s for s in searches if s["m"] == pulses]),
        (
            "cost-by-pulses",
            "m",
            f"pulses (searches over {smallest} candidates)",
            [s for s in searches if s["m"] != pulses],
        ),
    ):
        figure, plot = axes(label, "seconds a candidate")
        for threads in sorted({s["threads"] for s in chosen}):
            rows = sorted((s[x], s["wall"] / s["candidates"]) for s in chosen if s["threads"] == threads)
            plot.plot(*zip(*rows, strict=True), marker="o", label=f"wall time, {threads} thread{'s'[: threads - 1]}")
        # The system counts processor time in hundredths of a second.
        rows = [s for s in chosen if s["threads"] == 1 and s["processor"] >= 0.1]
        rows = sorted((s[x], s["processor"] / s["candidates"]) for s in rows)
        plot.plot(*zip(*rows, strict=True), marker=".", linestyle=":", label="processor time, 1 thread")
        plot.legend()
        drawn[name] = figure
    figure, plot = axes("pulses", "seconds")
    operators = {"simulate": "free run", "apply": "fractional integral", "rfft": "real FFT of twice the length"}
    for key, label in operators.items():
        rows = sorted((int(k.split()[1]), v) for k, v in measured["operators"].items() if k.split()[0] == key)
        plot.plot(*zip(*rows, strict=True), marker="o", label=label)
    plot.legend()
    drawn["cost-of-operators"] = figure
    return drawn


def boxes() -> Figure:
    """Return the processor time of branch-and-bound searches over the size of the order grid, from the benchmark."""
    from matplotlib.figure import Figure  # noqa: PLC0415 — only drawing needs it

    measured = json.loads((Path(__file__).parent / "boxes.json").read_text(encoding="utf-8"))
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    figure.suptitle("commit {commit}, {machine}".format(**measured), fontsize="small")
    plot = figure.add_subplot(xscale="log", yscale="log", xlabel="candidates", ylabel="processor time [s]")
    plot.grid(visible=True, which="major", linewidth=0.4)
    searches = measured["searches"]
    for name in dict.fromkeys(s["run"] for s in searches):
        rows = sorted((s["candidates"], s["processor"]) for s in searches if s["run"] == name)
        plot.plot(*zip(*rows, strict=True), marker="o", label=name)
    first, last = (end(s["candidates"] for s in searches) for end in (min, max))
    start = min(s["processor"] for s in searches)
    plot.plot((first, last), (start, start * (last / first) ** 0.5), "k:", label="as candidates to the 0.5")
    plot.legend()
    return figure


def moves() -> dict[str, Figure]:
    """Return charts of tip moves, of stable loops and of residual vibration from the benchmark, and phase charts."""
    from matplotlib.figure import Figure  # noqa: PLC0415 — only drawing needs it

    measured = json.loads((Path(__file__).parent / "tips.json").read_text(encoding="utf-8"))
    move = Figure(figsize=(7, 3.2), layout="constrained")
    plot = move.add_subplot(xlabel="time [s]", ylabel="tip [degrees]")
    time = np.arange(len(measured["path"])) * measured["step"]
    plot.plot(time, np.degrees(measured["path"]), color="0.6", linewidth=2.4, label="asked for")
    for (name, tip), style in zip(measured["traces"].items(), ("C1", "C2", "C0"), strict=True):
        if tip is not None:
            t = np.arange(len(tip)) * measured["step"]
            plot.plot(t, np.degrees(tip), style, linewidth=1.2, label=name)
    plot.legend(fontsize="small", loc="lower right")
    stable = Figure(figsize=(9, 5.2), layout="constrained")
    stable.suptitle("dark: the loop is stable on the arm's linear law", fontsize="small")
    for at, (name, rows) in enumerate(measured["stable"].items(), start=1):
        plot = stable.add_subplot(2, 3, at)
        share = sum(row[2] for row in rows) / len(rows)
        plot.set_title(f"{name}: {100 * share:.0f} %", fontsize="small")
        grid, times, delays = _plants(rows)
        span = (times[0], times[-1], 1e3 * delays[0], 1e3 * delays[-1])
        plot.imshow(grid, origin="lower", aspect="auto", cmap="Blues", vmin=0, vmax=1.4, extent=span)
        plot.plot(1.0, 0.0, "C1o", markersize=6, clip_on=False)
        plot.set_xlabel("stiffness of link 1, times", fontsize=7)
        plot.set_ylabel("delay of the angles [ms]", fontsize=7)
    still = Figure(figsize=(9, 5.2), layout="constrained")
    still.suptitle("tip in the second after 20 degrees, RMS [mrad]; x: the rig stopped the run", fontsize="small")
    worst, best = 5e-2, 3e-4
    for at, (name, rows) in enumerate(measured["still"].items(), start=1):
        plot = still.add_subplot(2, 2, at)
        plot.set_title(name, fontsize="small")
        grid, times, delays = _plants(rows)
        plot.set_xticks(range(len(times)), [f"{a:g}" for a in times], fontsize=7)
        plot.set_yticks(range(len(delays)), [f"{1e3 * b:.0f}" for b in delays], fontsize=7)
        plot.set_xlabel("stiffness of link 1, times", fontsize=7)
        plot.set_ylabel("delay of the angles [ms]", fontsize=7)
        colours = np.log(np.clip(grid, best, worst))
        plot.imshow(colours, origin="lower", aspect="auto", cmap="viridis_r", vmin=np.log(best), vmax=np.log(worst))
        for (i, j), value in np.ndenumerate(grid):
            shown = "x" if np.isnan(value) else f"{1e3 * value:.2g}"
            dark = not np.isnan(value) and value > np.sqrt(best * worst)
            plot.text(j, i, shown, ha="center", va="center", fontsize=7, color="white" if dark else "black")
    return {"control-move": move, "control-stable": stable, "control-still": still, "control-phase": phases()}


def _plants(rows: list[list[float]]) -> tuple[np.ndarray, list[float], list[float]]:
    """Return a table of results by delay and stiffness, with both axes."""
    times, delays = (sorted({row[k] for row in rows}) for k in (0, 1))
    found = {(a, b): c for a, b, c in rows}
    grid = [[np.nan if found[a, b] is None else float(found[a, b]) for a in times] for b in delays]
    return np.array(grid), times, delays


def phases() -> Figure:
    """Return the open-loop phase around the crossover, for a fractional PID and for one of integer orders."""
    from matplotlib.figure import Figure  # noqa: PLC0415 — only drawing needs it

    hub = ftlm.Model(ftlm.equation("D^2 theta11 = -63 D^0.95 theta11 + 140 I1"))
    design = control.fractional_pid(hub, crossover=40.0, phase_margin=60.0)
    w = np.geomspace(8.0, 200.0, 300)
    plant = design.plants[0].response(w)
    # The three gains of a PID of integer orders give the same crossover and margin, and an integral of the same size.
    at = design.plants[0].response(np.array([40.0]))[0]
    wanted = np.exp(1j * np.radians(-120.0)) / at
    slow = design.pid.ki * 40.0 ** (1.0 - design.pid.lam)
    whole = control.FractionalPid(float(wanted.real), slow, float(wanted.imag + slow / 40.0) / 40.0, 1.0, 1.0)
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    plot = figure.add_subplot(xlabel="frequency [rad/s]", ylabel="phase of the open loop [degrees]", xscale="log")
    for name, pid, style in (("fractional PID", design.pid, "C0"), ("PID of integer orders", whole, "C1")):
        loop = pid.response(w) * plant
        plot.plot(w, np.degrees(np.unwrap(np.angle(loop))), style, linewidth=1.2, label=name)
        for factor in (0.7, 1.0, 1.4):
            cross = int(np.argmin(np.abs(np.log(np.abs(factor * loop)))))
            plot.plot(w[cross], np.degrees(np.unwrap(np.angle(loop)))[cross], style + "o", markersize=5)
    plot.axhline(-120.0, color="0.6", linewidth=0.8)
    plot.legend(fontsize="small")
    return figure


def next_experiment(folder: Path) -> Figure:
    """Return the intervals of Plant A's orders after a designed run, and write their table, from the benchmark."""
    from matplotlib.figure import Figure  # noqa: PLC0415 — only drawing needs it

    measured = json.loads((Path(__file__).parent / "next_experiment.json").read_text(encoding="utf-8"))
    seeds = measured["seeds"]
    orders = ("alpha1", "alpha2", "gamma1", "beta2", "mu2")

    def ratios(name: str) -> tuple[list[float], list[float]]:
        before = [s["predicted"]["now"][name] for s in seeds]
        found = [b / s["found"][name] for b, s in zip(before, seeds, strict=True)]
        told = [b / s["predicted"]["designed"][name] for b, s in zip(before, seeds, strict=True)]
        return found, told

    found, told = (np.array([ratios(n)[k] for n in orders]) for k in (0, 1))
    rows = [
        [n, *(f"{np.median(v[i]):.2f}" for v in (told, found)), f"{found[i].min():.2f} to {found[i].max():.2f}"]
        for i, n in enumerate(orders)
    ]
    both = [np.prod(v, axis=0) for v in (told, found)]
    rows.append(
        ["product of all five", *(f"{np.median(v):.1f}" for v in both), f"{both[1].min():.1f} to {both[1].max():.1f}"]
    )
    head = ["", "predicted (median)", f"found (median of {len(seeds)} seeds)", "found, least to most"]
    lines = ["Intervals after the square over intervals after the designed run:", ""]
    lines += [f"| {' | '.join(row)} |" for row in (head, ["---"] * 4, *rows)]
    (folder / "next_experiment.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    first = seeds[0]
    time = 0.002 * np.arange(len(first["input"]))
    figure = Figure(figsize=(7, 5.6), layout="constrained")
    figure.suptitle("commit {commit}, {machine}".format(**measured), fontsize="small")
    current, hub, bars = figure.subplots(3, 1)
    square = np.where((np.arange(time.size) % 1000) < 500, 0.3, -0.3)
    current.plot(time, square, "C1", linewidth=0.9, drawstyle="steps-post", label="the paper's square")
    current.plot(time, first["input"], "C0", linewidth=1, drawstyle="steps-post", label="designed")
    current.set(xlabel="time [s]", ylabel="current [A]")
    current.legend(fontsize="small", ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    hub.plot(time[::10], first["angles"]["theta11"], "C0", linewidth=1)
    for side in (-1, 1):
        hub.axhline(side * first["allowed"]["theta11"], color="0.5", linestyle=":", linewidth=0.8)
    hub.set(xlabel="time [s]", ylabel="hub angle [rad]")
    bars.plot(np.arange(5), np.median(told, axis=1), "C0_", markersize=28, label="predicted")
    for k in range(5):
        bars.plot(np.full(len(seeds), k), found[k], "C0.", alpha=0.5, label="found" if k == 0 else None)
    bars.axhline(1.0, color="C1", linewidth=0.9, label="the paper's square")
    bars.set(xticks=range(5), xticklabels=orders, ylabel="times smaller", ylim=(0.8, None))
    bars.legend(fontsize="small", ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return figure


def unseen() -> Figure:
    """Return the simulation of the model of the README on its validation run, a chirp."""
    from matplotlib.figure import Figure  # noqa: PLC0415 — only drawing needs it

    shown = run_first_block(Path(__file__).parents[1] / "README.md")
    run = shown["measure"](shown["chirp"], 2)
    found = shown["result"].validate(run)
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    figure.suptitle("Example: a chirp that was not used for the identification", fontsize="small")
    plot = figure.add_subplot(xlabel="time [s]", ylabel="y")
    plot.plot(run.time, run["y"], color="0.7", linewidth=2, label="measured")
    plot.plot(run.time, found.simulated["y"][0], "C0", linewidth=1, label=f"model, fit {found.fit['y']:.1f} %")
    figure.legend(fontsize="small", loc="outside lower center", ncols=2)
    return figure


def run_first_block(page: Path) -> dict[str, Any]:
    """Run the first Python block of a page in an empty folder, and return its variables by name."""
    blocks = re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    variables: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
        exec(compile(blocks[0], page, "exec"), variables)
    return variables


def tutorials() -> dict[str, Figure]:
    """Return a chart for each tutorial: validation data and the simulation of its model, or an impedance spectrum."""
    from matplotlib.figure import Figure  # noqa: PLC0415 — only drawing needs it

    drawn = {}

    def axes(name: str, x: str, y: str) -> Axes:
        drawn[f"tutorial-{name}"] = figure = Figure(figsize=(7, 2.6), layout="constrained")
        return figure.add_subplot(xlabel=x, ylabel=y)

    for name, run_name, output, label in (
        ("motor", "sines", "w", "speed [rad/s]"),
        ("heat", "tuesday", "T", "temperature [K]"),
        ("flexible_arm", "nod", "tip", "tip [rad]"),
        ("matlab", "test", "y", "y"),
    ):
        found = run_first_block(TUTORIALS / f"{name}.md")
        run = found[run_name]
        models = {"free order": found["free"], "first order": found["first"]} if name == "heat" else {}
        models = models or {"simulated": found["found"]}
        plot = axes(name, "time [s]", label)
        thin = slice(None, None, max(1, run.length // 600))
        plot.plot(run.time[thin], run[output][thin], color="0.7", linewidth=3, label=f"measured, {run.name}")
        for (words, result), style in zip(models.items(), ("C0", "C1"), strict=False):
            check = result.validate(run)
            text = f"{words}: {check.fit[output]:.1f} %"
            plot.plot(run.time[thin], check.simulated[output][0][thin], style, linewidth=1, label=text)
        drawn[f"tutorial-{name}"].legend(fontsize="small", loc="outside lower center", ncols=3)
    found = run_first_block(TUTORIALS / "battery.md")
    second, model = found["second"], found["found"].model
    plot = axes("battery", "real part [mΩ]", "negative imaginary part [mΩ]")
    measured, fitted = 1e3 * second.response, 1e3 * model.frequency_response(second.frequency)[0, 0]
    plot.plot(measured.real, -measured.imag, "o", color="0.6", markersize=4, label=f"measured, {second.name}")
    plot.plot(fitted.real, -fitted.imag, "C0", linewidth=1, label="model")
    plot.set_aspect("equal")
    drawn["tutorial-battery"].legend(fontsize="small", loc="outside right")
    return drawn


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path("pictures"))
