"""The demonstration: the simulated arm, its runs, and the main job on them."""

from ftlm.paper.arm import demo_plant, demo_run
from ftlm.paper.demo import Demo, StageRow, run_demo

__all__ = ["Demo", "StageRow", "demo_plant", "demo_run", "run_demo"]
