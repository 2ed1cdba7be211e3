"""Both hubs of the arm under controllers, as a rig asks for their currents."""

from __future__ import annotations

from typing import Any

from ftlm.base.arrays import Floats
from ftlm.base.errors import ModelError
from ftlm.control.fractional import Realised
from ftlm.control.quadratic import Lqg

#: What a rig hands over, in its order.
ANGLES = ("theta11", "theta12", "theta21", "theta22")


class HubLoops:
    """A controller of each hub for :func:`ftlm.rig.control`: angles and reference in, currents out.

    Parameters
    ----------
    first, second
        Of hub 1 and hub 2: a :class:`Realised`, called with reference less hub angle [rad], or an :class:`Lqg`, which
        reads the angles that it names; None leaves a hub without current.

    Raises
    ------
    ModelError
        What is neither, or a controller that reads what the arm does not measure.
    """

    def __init__(self, first: Realised | Lqg | None, second: Realised | Lqg | None = None) -> None:
        self.loops = (first, second)
        self._reads: list[list[int]] = []
        for j, loop in enumerate(self.loops):
            if not isinstance(loop, (Realised, Lqg, type(None))):
                raise ModelError("first and second are Realised or Lqg controllers, or None")
            names = loop.observer.measured if isinstance(loop, Lqg) else (ANGLES[2 * j],)
            unknown = [n for n in names if n not in ANGLES]
            if unknown:
                raise ModelError(f"the controller reads {', '.join(unknown)}; the arm measures {', '.join(ANGLES)}")
            self._reads.append([ANGLES.index(n) for n in names])

    def reset(self) -> None:
        """Forgets what was."""
        for loop in self.loops:
            if loop is not None:
                loop.reset()

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {f"hub{j}": None if loop is None else loop.to_dict() for j, loop in enumerate(self.loops, start=1)}

    def __call__(self, time: float, angles: Floats, reference: Floats) -> tuple[float, float]:
        """Both currents [A]."""
        first, second = (
            0.0 if loop is None
            else loop(angles[reads], float(reference[j])) if isinstance(loop, Lqg)
            else loop(float(reference[j] - angles[reads[0]]))
            for j, (loop, reads) in enumerate(zip(self.loops, self._reads, strict=True))
        )  # fmt: skip
        return first, second
