"""Control on an identified model: shapers, fractional and linear-quadratic controllers, observers, inverse dynamics."""

from ftlm.control.file import load_controller, save_controller
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
           "Realisation", "Realised", "Shaper", "fractional_pid", "input_shaper", "inverse", "load_controller", "lqg",
           "observer", "save_controller", "smooth_move"]  # fmt: skip
