"""What a model is for: a tip that stands still after a move, from ten seconds of the arm's own run.

python benches/moves.py seeds 0 1 2 …   identify, design and move, a line of JSON a seed (--kept FILE appends)
python benches/moves.py table --kept FILE

The last one writes docs/control.json. Other plants, and designs on the whole stage, are in benches/tips.py.

The arm is the virtual one as it is: friction, coupled stages, offsets, noise, quantisation; the run that is identified
passes the stock filter. The judge is the measured tip, theta11 + theta12, in the second after the reference arrived.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from scipy.linalg import solve_continuous_are

import ftlm
from ftlm import control, rig

RATE = 500.0
ANGLE = np.radians(20.0)
#: Speed of the move [rad/s]: the loop follows it within the current's limit, and no link trips unshaped.
SPEED = 1.0
START, ROWS = 0.1, 901
OFFSET = (0.01, -0.02)
#: The same structure twice: orders free, and whole.
LINKS = {
    "fractional": "D^2 theta12 = a D^beta theta12 + b D^gamma theta11",
    "integer": "D^2 theta12 = a theta12 + d D theta12 + b D^2 theta11",
}
HUBS = {
    "fractional": "D^2 theta11 = b D^gamma theta11 + g I1 + c",
    "integer": "D^2 theta11 = b D theta11 + g I1 + c",
}
CROSSOVER, SLOW, PHASE = 40.0, 12.0, 60.0
STIFFNESS = (0.3, 0.5, 0.7, 0.85, 1.0, 1.25, 1.5)
DELAYS = (0.0, 0.02, 0.04, 0.06, 0.08)
OUT = Path(__file__).parent.parent / "docs" / "control.json"


def own_run(seed):
    """Ten seconds of the arm, motor 1 driven at random; with less where chance led to a limit switch or a trip."""
    for amplitude in (0.4, 0.3, 0.2):
        try:
            return rig.record(
                input="prbs",
                period=0.1,
                amplitude=(amplitude, 0.0),
                duration=10.0,
                seed=seed,
                offset=OFFSET,
                sensor_filter="stock",
            )
        except ftlm.RigFault as fault:
            print(f"seed {seed}, {amplitude} A: {fault}", file=sys.stderr)
    raise SystemExit(f"seed {seed} has no run of ten seconds")


def model_of(run, text):
    """A model of one equation, on every fourth sample."""
    passed = ftlm.SensorFilter.low_pass(["theta12"]) if "theta12" in text else None
    structure = ftlm.equation(text, sensor_filter=passed)
    return ftlm.identify(run.resample(0.008).select(sorted(set(structure.signals))), structure).model


def loops(pid, delay=0.0):
    """Both hubs; hub 2 is held by a plain one. Angles reach the controllers so much later."""
    hold = control.DiscretePid(control.FractionalPid(20.0, 50.0, 0.5, 1.0, 1.0), RATE, limit=1.19)
    return Late(control.JointControllers(control.DiscretePid(pid, RATE, limit=0.93), hold), delay)


class Late:
    """A controller that sees what was measured some time ago."""

    def __init__(self, controller, delay):
        self.controller, self.samples = controller, round(delay * RATE)
        self.reset()

    def reset(self):
        self.controller.reset()
        self.seen = []

    def __call__(self, t, angles, reference):
        self.seen.append(angles)
        return self.controller(t, self.seen[-1 - min(self.samples, len(self.seen) - 1)], reference)


class Lqr:
    """State feedback on the maker's model of integer orders, rates by filtered differences; weights are ours."""

    def __init__(self):
        arm = rig.ArmParameters.load("effective").stage1
        # theta11, theta12 and their rates; the link hangs on the hub.
        hub = np.array([0.0, arm.a, arm.b, arm.d])
        link = np.array([0.0, -arm.a * (arm.r - 1), 0.0, -arm.d * (arm.r - 1)]) - hub
        a = np.array([[0, 0, 1, 0], [0, 0, 0, 1], hub, link])
        b = np.array([[0.0], [0.0], [arm.g], [-arm.g]])
        weights = np.diag([1 / 0.02**2, 1 / 0.05**2, 0.0, 0.0])
        self.gain = (b.T @ solve_continuous_are(a, b, weights, np.eye(1)))[0]
        self.hold = control.DiscretePid(control.FractionalPid(20.0, 50.0, 0.5, 1.0, 1.0), RATE, limit=1.19)
        self.reset()

    def reset(self):
        self.hold.reset()
        self.past = self.rates = None

    def __call__(self, t, angles, reference):
        now = angles[:2]
        if self.past is None:
            self.past, self.rates = now, np.zeros(2)
        self.rates = self.rates + 0.3 * ((now - self.past) * RATE - self.rates)
        self.past = now
        error = np.array([reference[0] - now[0], -now[1], -self.rates[0], -self.rates[1]])
        return float(np.clip(self.gain @ error, -0.93, 0.93)), self.hold(float(reference[1] - angles[2]))


def ramp():
    """The move without a shaper."""
    return np.clip((np.arange(ROWS) / RATE - START) * SPEED, 0.0, ANGLE)


def tip_of(controller, reference, **options):
    """The measured tip of a move [rad]; None where the rig stopped it."""
    both = np.column_stack([reference, 0 * reference])
    try:
        run = rig.control(controller, both, offset=OFFSET, **options)
    except ftlm.RigFault:
        return None
    return run["theta11"] + run["theta12"]


def movement(controller, reference, **options):
    """RMS of the tip about its mean in the second after the reference has arrived [rad]; None where the rig stopped."""
    tip = tip_of(controller, reference, **options)
    if tip is None:
        return None
    first = int(np.argmax(reference >= reference[-1] - 1e-9))
    return float(np.std(tip[first : first + round(RATE)]))


def designed(run, kind):
    """Hub loop and shapers of a model of a kind."""
    began = time.process_time()
    link, hub = model_of(run, LINKS[kind]), model_of(run, HUBS[kind])
    design = control.fractional_pid(hub, input="I1", crossover=CROSSOVER, phase_margin=PHASE, rate=RATE)
    shapers = {name: control.input_shaper(link, name) for name in ("zv", "zvd")}
    return design, shapers, time.process_time() - began


def of_seed(seed):
    """Everything of a seed: the move's noise is another's than the run's."""
    run = own_run(seed)
    results = {"seed": seed}
    for kind in LINKS:
        design, shapers, took = designed(run, kind)
        mode = shapers["zv"].modes[0]
        loop = loops(design.pid)
        angles = {
            "frequency": mode.frequency,
            "damping": mode.damping,
            "pid": design.pid.to_dict(),
            "seconds": took,
            "phase": design.margin_interval("phase"),
        }
        angles["unshaped"] = movement(loop, ramp(), seed=1000 + seed)
        for name, shaper in shapers.items():
            angles[name] = movement(loop, shaper.filter(ramp(), RATE), seed=1000 + seed)
        results[kind] = angles
    return results


def save(results):
    """Put what was measured into the page's file."""
    content = json.loads(OUT.read_text(encoding="utf-8")) if OUT.exists() else {}
    OUT.write_text(json.dumps(content | results) + "\n", encoding="utf-8")


def table(path):
    """Ratios over the seeds."""
    rows = [json.loads(line) for line in Path(path).read_text(encoding="utf-8").splitlines()]
    rows = list({row["seed"]: row for row in rows}.values())
    print(f"{len(rows)} seeds")
    for kind in LINKS:
        plain = np.array([r[kind]["unshaped"] or np.nan for r in rows])
        for name in ("zv", "zvd"):
            shaped = np.array([r[kind][name] or np.nan for r in rows])
            times = plain / shaped
            print(
                f"{kind} {name}: {1e3 * np.nanmedian(plain):.2f} -> {1e3 * np.nanmedian(shaped):.3f} mrad, "
                f"median {np.nanmedian(times):.1f} times less, least {np.nanmin(times):.1f}, "
                f"at least 10 in {np.sum(times >= 10)} of {np.sum(np.isfinite(times))}"
            )
    for name in ("zv", "zvd"):
        times = np.array([(r["integer"][name] or np.nan) / (r["fractional"][name] or np.nan) for r in rows])
        print(
            f"integer over fractional, {name}: median {np.nanmedian(times):.2f}, {np.nanmin(times):.2f} to "
            f"{np.nanmax(times):.2f}, at least 2 in {np.sum(times >= 2)}"
        )
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=["seeds", "table"])
    parser.add_argument("seeds", nargs="*", type=int)
    parser.add_argument("--kept", default="control.jsonl")
    arguments = parser.parse_args()
    if arguments.what == "seeds":
        for one in arguments.seeds or range(20):
            line = json.dumps(of_seed(one))
            with Path(arguments.kept).open("a", encoding="utf-8") as file:
                file.write(line + "\n")
            print(line, flush=True)
    else:
        save({"seeds": table(arguments.kept)})
