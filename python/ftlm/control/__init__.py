"""Control on an identified model: shapers, fractional and linear-quadratic controllers, observers, inverse dynamics."""

from ftlm.control.fractional import FractionalPid, Realised
from ftlm.control.hubs import HubLoops
from ftlm.control.kalman import Observer, observer
from ftlm.control.margins import Margins
from ftlm.control.pid import PidDesign, fractional_pid
from ftlm.control.planned import PlannedMove, inverse, smooth_move
from ftlm.control.quadratic import Lqg, LqgDesign, lqg
from ftlm.control.realisation import Realisation
from ftlm.control.shaper import Shaper, input_shaper

__all__ = ["FractionalPid", "HubLoops", "Lqg", "LqgDesign", "Margins", "Observer", "PidDesign", "PlannedMove",
           "Realisation", "Realised", "Shaper", "fractional_pid", "input_shaper", "inverse", "lqg", "observer",
           "smooth_move"]  # fmt: skip
