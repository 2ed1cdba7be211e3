"""Laboratory rig: a simulated arm and a Q8-USB board with the same interface, limits and checks."""

from ftlm.estimation.linear import Streaming
from ftlm.rig.arm_parameters import ArmParameters, StageParameters
from ftlm.rig.excitation import SIGNAL_SHAPES, Excitation
from ftlm.rig.feedback_loop import Controller, control
from ftlm.rig.recording import record
from ftlm.rig.rig import Board, Limits, Rig
from ftlm.rig.virtual_board import FAULT_INJECTIONS, VirtualBoard

__all__ = [
    "FAULT_INJECTIONS",
    "SIGNAL_SHAPES",
    "ArmParameters",
    "Board",
    "Controller",
    "Excitation",
    "Limits",
    "Rig",
    "StageParameters",
    "Streaming",
    "VirtualBoard",
    "control",
    "record",
]
