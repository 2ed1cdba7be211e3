"""Control on an identified model: input shapers from its poles, fractional controllers tuned on its exact response."""

from ftlm.control.loop import HubLoops, Realised
from ftlm.control.margins import Margins
from ftlm.control.pid import FractionalPid, PidDesign, fractional_pid
from ftlm.control.shaper import Shaper, input_shaper

__all__ = ["FractionalPid", "HubLoops", "Margins", "PidDesign", "Realised", "Shaper", "fractional_pid",
           "input_shaper"]  # fmt: skip
