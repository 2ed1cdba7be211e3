"""The rig: the simulated arm by default, the Q8-USB board for real; one interface, the same limits and checks."""

from ftlm.fit.streaming import Streaming
from ftlm.rig.excitation import SHAPES, Excitation
from ftlm.rig.experiment import record
from ftlm.rig.loop import Controller, control
from ftlm.rig.parameters import ArmParameters, StageParameters
from ftlm.rig.rig import Board, Limits, Rig
from ftlm.rig.virtual import INJECTIONS, VirtualBoard

__all__ = ["INJECTIONS", "SHAPES", "ArmParameters", "Board", "Controller", "Excitation", "Limits", "Rig",
           "StageParameters", "Streaming", "VirtualBoard", "control", "record"]  # fmt: skip
