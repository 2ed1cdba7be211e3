"""Control design on identified models: input shapers, fractional PID, LQG, observers, inverse dynamics."""

from ftlm.control.controller_file import JointControllers, load_controller, save_controller
from ftlm.control.fractional_pid import DiscretePid, FractionalPid, PidDesign, fractional_pid
from ftlm.control.input_shaping import Shaper, input_shaper
from ftlm.control.inverse_dynamics import Trajectory, inverse_dynamics, point_to_point
from ftlm.control.lqg import Lqg, LqgDesign, Observer, lqg, observer
from ftlm.control.realization import Realization
from ftlm.control.stability_margins import Margins

__all__ = [
    "DiscretePid",
    "FractionalPid",
    "JointControllers",
    "Lqg",
    "LqgDesign",
    "Margins",
    "Observer",
    "PidDesign",
    "Realization",
    "Shaper",
    "Trajectory",
    "fractional_pid",
    "input_shaper",
    "inverse_dynamics",
    "load_controller",
    "lqg",
    "observer",
    "point_to_point",
    "save_controller",
]
