"""The rig: the simulated arm by default, the Q8-USB board for real; one interface, the same limits and checks."""

from ftlm.estimation.linear import Streaming
from ftlm.rig.arm_parameters import ArmParameters, StageParameters
from ftlm.rig.excitation import SHAPES, Excitation
from ftlm.rig.feedback_loop import Controller, control
from ftlm.rig.recording import record
from ftlm.rig.rig import Board, Limits, Rig
from ftlm.rig.virtual_board import INJECTIONS, VirtualBoard

__all__ = [
    "INJECTIONS",
    "SHAPES",
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
