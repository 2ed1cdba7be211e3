"""The rig: the simulated arm by default, the Q8-USB board for real; one interface, the same limits and checks."""

from ftlm.rig.experiment import SHAPES, Excitation, record
from ftlm.rig.rig import Board, Limits, Rig
from ftlm.rig.virtual import INJECTIONS, ArmParameters, StageParameters, VirtualBoard
from ftlm.streaming import Streaming

__all__ = [
    "INJECTIONS",
    "SHAPES",
    "ArmParameters",
    "Board",
    "Excitation",
    "Limits",
    "Rig",
    "StageParameters",
    "Streaming",
    "VirtualBoard",
    "record",
]
