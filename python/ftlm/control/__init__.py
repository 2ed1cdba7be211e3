"""Control design on identified models: input shapers, fractional PID, LQG, observers, inverse dynamics."""

from ftlm.control.controller_file import HubLoops, load_controller, save_controller
from ftlm.control.fractional_pid import FractionalPid, PidDesign, Realised, fractional_pid
from ftlm.control.input_shaping import Shaper, input_shaper
from ftlm.control.inverse_dynamics import PlannedMove, inverse, smooth_move
from ftlm.control.lqg import Lqg, LqgDesign, Observer, lqg, observer
from ftlm.control.realization import Realisation
from ftlm.control.stability_margins import Margins

__all__ = [
    "FractionalPid",
    "HubLoops",
    "Lqg",
    "LqgDesign",
    "Margins",
    "Observer",
    "PidDesign",
    "PlannedMove",
    "Realisation",
    "Realised",
    "Shaper",
    "fractional_pid",
    "input_shaper",
    "inverse",
    "load_controller",
    "lqg",
    "observer",
    "save_controller",
    "smooth_move",
]
