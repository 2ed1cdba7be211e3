"""The same designs on models of the same run: how still the tip stands, and on which other plants they stay stable.

python benches/tips.py seeds 0 1 2 …   identify a stage three ways, design alike, move; a line of JSON a seed
python benches/tips.py stable          stiffness and delay perturbed: which loops stay stable
python benches/tips.py still           the same plants moved: how still the tip is then
python benches/tips.py table

The last three write docs/tips.json, of which docs/control.md shows its pictures.

The arm, its run of ten seconds and its judge are those of benches/moves.py. Designs here use the whole of a stage's
model, from its current to its tip, and not its pole alone: an observer with state feedback, and inverse dynamics.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import ftlm
import moves
from ftlm import control, rig
from ftlm.control import stability_margins

RATE, ANGLE = moves.RATE, moves.ANGLE
#: 20 degrees in half a second; rest before it for a reference that begins sooner, and a second behind it to be judged.
SECONDS, BEFORE, AFTER = 0.5, 0.3, 1.1
TIP = "theta11 + theta12"
WHOLE = {"alpha1": 2.0, "alpha2": 2.0, "beta2": 0.0, "mu2": 1.0, "gamma1": 1.0}
#: Deviations as dear as 1 A, how fast what is not modelled may walk, and the noise of encoder and gauge [rad].
WEIGHTS = {
    "max_deviation": {"theta11": 0.02, "theta12": 0.02},
    "max_input": 1.0,
    "process_noise": 0.5,
    "noise": {"theta11": 3e-4, "theta12": 2e-4},
}
#: Of the model's numbers, over which designs are judged.
SAMPLES = 20
#: Plants on which stability is decided: stiffness of link 1 times, delay of the angles [s].
FINE_STIFFNESS, FINE_DELAYS = np.linspace(0.3, 1.5, 25), np.linspace(0.0, 0.08, 33)
OUT = Path(__file__).parent.parent / "docs" / "tips.json"
CHECKPOINT = Path(os.environ.get("KEPT", "tips.jsonl"))


def structures():
    """Three models of a stage: the arm's law with free and with integer orders, and integer orders without a law."""
    law = ftlm.flexible_link(stage=1, sensor_filter="stock", offset="constant", friction=True)
    free = ftlm.equation(
        "D^2 theta11 = k theta12 + e D theta12 + b D theta11 + g I1; "
        "D^2 theta12 = a theta12 + d D theta12 + h D^2 theta11",
        sensor_filter=ftlm.SensorFilter.low_pass(["theta12"]),
        offset="constant",
        coupling="simulated",
    )
    return {
        "fractional": law.with_orders({"alpha1": 2.0}),
        "integer": law.with_orders({n: WHOLE[n] for n in law.order_names}),
        "integer, no law": free,
    }


def identified(run, structure):
    """A model of a structure, on every fourth sample."""
    thin = run.resample(0.008)
    thin = thin.select([s for s in structure.signals if s in thin.signals])
    return ftlm.identify(thin, structure, method=ftlm.OutputError(intervals="quadratic")).model


def both(first):
    """Hub 1 under a controller, hub 2 held by the plain one of benches/moves.py."""
    hold = control.DiscretePid(control.FractionalPid(20.0, 50.0, 0.5, 1.0, 1.0), RATE, limit=1.19)
    return control.JointControllers(first, hold)


def designed(name, model, samples):
    """A design of a model over so many samples of its numbers, and what runs of it."""
    if name == "lqg":
        design = control.lqg(model, input="I1", samples=samples, **WEIGHTS)
        return design, design.with_limit(0.93)
    design = control.fractional_pid(
        model,
        output="theta11",
        input="I1",
        crossover=moves.CROSSOVER,
        phase_margin=moves.PHASE,
        rate=RATE,
        samples=samples,
    )
    return design, control.DiscretePid(design.pid, RATE, limit=0.93)


def assessment(controller, reference, ends, **options):
    """RMS of the tip in the second after the path has ended, about its mean and about its goal [rad]."""
    tip = moves.tip_of(controller, reference, **options)
    if tip is None:
        return None
    after = tip[ends : ends + round(RATE)]
    return [float(np.std(after)), float(np.sqrt(np.mean((after - ANGLE) ** 2)))]


def of_seed(seed):
    """Everything of a seed: the move's noise is another's than the run's."""
    run = moves.own_run(seed)
    path = control.point_to_point(ANGLE, SECONDS, RATE, dwell_before=BEFORE, dwell_after=AFTER)
    ends = round((BEFORE + SECONDS) * RATE)
    results = {"seed": seed}
    for kind, structure in structures().items():
        began = time.process_time()
        model = identified(run, structure)
        values = {"seconds": time.process_time() - began, "fit": model.estimate.fit}
        for name in ("lqg", "pid"):
            refused = None
            try:
                design, controller = designed(name, model, SAMPLES)
                planned = control.inverse_dynamics(design, path, output=TIP, samples=0)
            except ftlm.ModelError as error:
                # Its own intervals refuse it; what it would have done is told all the same.
                refused = str(error)
                try:
                    design, controller = designed(name, model, 0)
                    planned = control.inverse_dynamics(design, path, output=TIP, samples=0)
                except ftlm.ModelError as worse:
                    values[name] = {"refused": str(worse), "plain": None, "inverse": None, "none": True}
                    continue
            loop = both(controller)
            values[name] = {
                "refused": refused,
                "plain": assessment(loop, path, ends, seed=1000 + seed),
                "inverse": assessment(loop, planned.reference, ends, seed=1000 + seed),
            }
        results[kind] = values
    return results


def contenders(seed):
    """Designs on models of a seed's run, by name: on the fractional one, and on the best of integer orders."""
    run = moves.own_run(seed)
    models = {kind: identified(run, structure) for kind, structure in structures().items() if kind != "integer"}
    fractional, whole = models["fractional"], models["integer, no law"]
    calm = {**WEIGHTS, "max_deviation": {"theta11": 0.2, "theta12": 0.2}}
    slow = control.fractional_pid(fractional, output="theta11", input="I1", crossover=moves.SLOW, samples=SAMPLES)
    return fractional, {
        "fractional PID, 40 rad/s": designed("pid", fractional, SAMPLES)[0],
        "fractional PID, 12 rad/s": slow,
        "LQG": designed("lqg", fractional, SAMPLES)[0],
        "LQG, ten times the deviations": control.lqg(fractional, input="I1", samples=SAMPLES, **calm),
        "LQG of integer orders": designed("lqg", whole, 0)[0],
    }


def stable(seed=0):
    """Whether each loop is stable on the arm's own linear law: stiffness of link 1 times, delay of the angles."""
    _, loops = contenders(seed)
    w = np.geomspace(0.01, 0.999 * np.pi * RATE, 4000)
    arm = rig.ArmParameters.load("linear")
    acting = {name: (design.acting(w)[:2], integrals(design)) for name, design in loops.items()}
    acting["LQR of the maker's model"] = (("theta11", "theta12"), maker(w)), 0.0
    results = {name: [] for name in acting}
    for times in FINE_STIFFNESS:
        law = replace(arm, stage1=replace(arm.stage1, a=arm.stage1.a * float(times))).model()
        plants = {o: stability_margins.Plant(law, o, "I1", RATE, "simulated") for o in ("theta11", "theta12")}
        responses = {o: plant.response(w) for o, plant in plants.items()}
        grows = plants["theta11"].count_unstable_poles()
        for delay in FINE_DELAYS:
            late = np.exp(-1j * w * float(delay))
            for name, ((read, answers), integral) in acting.items():
                loop = sum(a * responses[o] for o, a in zip(read, answers, strict=True)) * late
                margins = stability_margins.margins_of(loop, w, plants["theta11"].integral_order() + integral, grows)
                results[name].append([float(times), float(delay), margins.stable])
    return {"stable": results}


def integrals(design):
    """Order of a loop's integral."""
    if isinstance(design, control.LqgDesign):
        own = design.controller.poles()
        if np.any(np.abs(own) > 1.0 + 1e-7):
            raise SystemExit("a controller that is not stable by itself is not counted here")
        return float(np.sum(np.abs(own - 1.0) < 1e-7))
    return design.pid.lam


def maker(w):
    """What moves.Lqr answers to both angles: gains of them and of their filtered differences."""
    gains = moves.Lqr().gain
    z = np.exp(1j * w / RATE)
    rate = 0.3 * RATE * (1.0 - 1.0 / z) / (1.0 - 0.7 / z)
    return np.array([gains[0] + gains[2] * rate, gains[1] + gains[3] * rate])


def still(seed=0):
    """How still each design leaves the tip on other plants, moved on the arm as it is; moves to be seen."""
    model, loops = contenders(seed)
    pid, lqg, calm = (loops[n] for n in ("fractional PID, 40 rad/s", "LQG", "LQG, ten times the deviations"))
    path = control.point_to_point(ANGLE, SECONDS, RATE, dwell_before=BEFORE, dwell_after=AFTER)
    ends = round((BEFORE + SECONDS) * RATE)
    shaper = control.input_shaper(model, "zvd", coupling="measured")
    runs = {
        "fractional PID": (lambda: both(control.DiscretePid(pid.pid, RATE, limit=0.93)), path, ends),
        "fractional PID, ZVD": (
            lambda: both(control.DiscretePid(pid.pid, RATE, limit=0.93)),
            shaper.filter(path, RATE),
            ends + round(shaper.delay * RATE),
        ),
        "LQG, inverse": (
            lambda: both(lqg.controlled(0.93)),
            control.inverse_dynamics(lqg, path, output=TIP, samples=0).reference,
            ends,
        ),
        "LQG, ten times the deviations, inverse": (
            lambda: both(calm.controlled(0.93)),
            control.inverse_dynamics(calm, path, output=TIP, samples=0).reference,
            ends,
        ),
    }
    arm = rig.ArmParameters.load("effective")
    results = {n: [] for n in runs}
    for times in moves.STIFFNESS:
        other = replace(arm, stage1=replace(arm.stage1, a=arm.stage1.a * times))
        for delay in moves.DELAYS:
            for name, (make_loop, reference, until) in runs.items():
                after = np.concatenate([reference, np.full(round(0.4 * RATE), reference[-1])])
                residual = assessment(moves.Late(make_loop(), delay), after, until, parameters=other, seed=5000)
                results[name].append([times, delay, None if residual is None else residual[0]])
        print(times, file=sys.stderr, flush=True)
    traces = {}
    for name in ("fractional PID", "fractional PID, ZVD", "LQG, inverse"):
        make_loop, reference, _ = runs[name]
        traces[name] = traced(make_loop(), reference)
    return {"still": results, "traces": traces, "step": 4 / RATE, "path": path[::4].round(6).tolist()}


def traced(controller, reference):
    """The tip of a move, as far as it went before the rig stopped it."""
    try:
        run = rig.control(controller, np.column_stack([reference, 0 * reference]), offset=moves.OFFSET, seed=5000)
    except ftlm.RigFault as fault:
        run = fault.run
    return (run["theta11"] + run["theta12"])[::4].round(6).tolist()


def table():
    """Ratios over the seeds."""
    rows = {r["seed"]: r for r in map(json.loads, CHECKPOINT.read_text(encoding="utf-8").splitlines())}
    rows = [rows[s] for s in sorted(rows)]
    print(f"{len(rows)} seeds")

    def column_values(kind, name, what, about=0):
        values = [r[kind][name].get(what) for r in rows]
        return np.array([np.nan if v is None else 1e3 * v[about] for v in values])

    def quantiles(values):
        there = values[np.isfinite(values)]
        return f"{np.median(there):.3g} ({there.min():.3g} to {there.max():.3g})" if there.size else "none"

    for name in ("lqg", "pid"):
        own = column_values("fractional", name, "inverse")
        for kind in structures():
            plain, inverse, goal = (column_values(kind, name, *w) for w in (("plain",), ("inverse",), ("inverse", 1)))
            none = sum("none" in r[kind][name] for r in rows)
            refused = sum(r[kind][name]["refused"] is not None for r in rows) - none
            print(
                f"{name}, {kind}: no design {none}, refused by its intervals {refused}; mrad plain {quantiles(plain)}, "
                f"stopped {np.isnan(plain).sum() - none}; inverse {quantiles(inverse)}, stopped "
                f"{np.isnan(inverse).sum() - none}, about the goal {quantiles(goal)}; plain over inverse "
                f"{quantiles(plain / inverse)}; inverse over the fractional one {quantiles(inverse / own)}"
            )
    return [
        {"seed": r["seed"]}
        | {k: {n: r[k][n] | {"refused": r[k][n]["refused"] is not None} for n in ("lqg", "pid")} for k in structures()}
        for r in rows
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["seeds", "stable", "still", "table"])
    parser.add_argument("seeds", nargs="*", type=int)
    arguments = parser.parse_args()
    if arguments.what == "seeds":
        for one in arguments.seeds or range(20):
            line = json.dumps(of_seed(one))
            with CHECKPOINT.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
            print(f"seed {one}", file=sys.stderr, flush=True)
    else:
        tables = (
            {"seeds": table()} if arguments.what == "table" else {"stable": stable, "still": still}[arguments.what]()
        )
        before = json.loads(OUT.read_text(encoding="utf-8")) if OUT.exists() else {}
        OUT.write_text(json.dumps(before | tables) + "\n", encoding="utf-8")
