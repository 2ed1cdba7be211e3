"""Structures that a page offers for the signals of a run, the simplest first."""

from __future__ import annotations

from collections.abc import Sequence

#: Outputs and inputs beyond which nobody reads a list of offers.
MOST = 6


def offers(inputs: Sequence[str], outputs: Sequence[str]) -> list[dict[str, str]]:
    """Structures for each output: what they are called, what they are for, the equation, and of which output."""
    made: list[dict[str, str]] = []
    driven = list(inputs)[:MOST]
    for output in list(outputs)[:MOST]:
        drives = "".join(f" + b{k} {name}" for k, name in enumerate(driven))
        for name, why, left, own in (
            ("Lag", "first order: heating, filling, a motor's speed", "D", "a0 {y}"),
            ("Lag of free order", "diffusion, batteries, creep: its order is estimated", "D^alpha", "a0 {y}"),
            ("Oscillator", "second order: a mass on a spring", "D^2", "a1 D {y} + a0 {y}"),
            ("Oscillator, damping of free order", "viscoelastic damping: its order is estimated", "D^2",
             "a1 D^mu {y} + a0 {y}"),
            ("Oscillator of free orders", "both orders are estimated", "D^alpha", "a1 D^mu {y} + a0 {y}"),
        ):  # fmt: skip
            text = f"{left} {output} = {own.format(y=output)}{drives}"
            made.append({"name": name, "why": why, "structure": text, "output": output})
    for stage in (1, 2):
        if {f"I{stage}", f"theta{stage}1", f"theta{stage}2"} <= {*inputs, *outputs}:
            made.append(
                {
                    "name": f"Flexible link {stage}", "why": "hub and deflection of a flexible arm",
                    "structure": f"flexible_link(stage={stage})", "output": f"theta{stage}1, theta{stage}2",
                }
            )  # fmt: skip
    return made
