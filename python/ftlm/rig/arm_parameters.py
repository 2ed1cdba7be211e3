"""Parameters of the simulated arm and its sensors: named sets, and TOML files."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import msgspec
from msgspec import UNSET, UnsetType

from ftlm import _core
from ftlm.arm.flexible_link import Form, flexible_link
from ftlm.errors import DataError, ModelError
from ftlm.model.model import Model
from ftlm.rig.rig import COMMAND_SCALE, CURRENT_LIMIT, ENCODER_SCALE, SENSE_SCALE, STRAIN_SCALE
from ftlm.simulation.discretization import equation_tuple
from ftlm.utils.arguments import check_arguments
from ftlm.utils.files import read_toml
from ftlm.utils.parameters import setting, type_name
from ftlm.utils.validation import join_names, nearest, short_repr

#: Signals of the arm, in the order of their indices in the Rust core.
ARM_SIGNALS = ("theta11", "theta12", "theta21", "theta22", "I1", "I2")
#: Ratios from the manufacturer's data. Link 1 has a length of 0.202 m and, with everything it carries, an inertia of
#: 0.170434 kg m^2. Link 2 has an inertia of 0.0064387 kg m^2, with a mass of 0.157 kg at 0.20185 m. Hub 2 has an
#: inertia of 0.00301955 kg m^2. Of this, 0.002575 kg m^2 belong to the rotor, 1.03e-6 kg m^2 behind a gear of 50. Only
#: one fiftieth of the rotor's part couples to link 1.
INERTIA_RATIO = 0.00301955 / 0.170434
LINK_COUPLING_RATIO = 0.157 * 0.202 * 0.20185 / 0.0064387
ROTATING_INERTIA_FRACTION = (0.00301955 - 0.002575 + 0.002575 / 50.0) / 0.00301955
#: Maximum step of the simulation within a sampling interval [s]. The error of deflections is then below 2e-4 of their
#: standard deviation, and for joint 1 below 1e-5.
MAX_SUBSTEP_S = 1e-4


@check_arguments
@dataclass(frozen=True)
class StageParameters:
    """Parameters of one joint of the simulated arm: coefficients, orders, and Coulomb friction.

    Parameters
    ----------
    a, b, d
        Coefficients of the hub equation: link stiffness, hub friction (negative) and link damping, each divided by the
        hub inertia J_1. The coefficient of a term of order n has the unit s^(n - 2).
    g
        Motor torque per hub inertia and motor current [rad/(s^2 A)].
    r
        Inertia ratio (J_1 + J_2)/J_2 of hub J_1 and link J_2, with which the coefficients of the link equation follow
        from those of the hub equation.
    gamma, beta, mu
        Orders of hub friction, link elasticity and link damping. All other orders follow from the order law
        (:func:`ftlm.arm.flexible_link.order_law`) and must lie in [0, 3). The highest order of both equations is 2.
    coulomb
        Coulomb friction of the hub as an equivalent motor current [A]; 0 for none.
    """

    a: float
    b: float
    d: float
    g: float
    r: float
    gamma: float
    beta: float
    mu: float
    coulomb: float = 0.0

    def orders(self, stage: int) -> dict[str, float]:
        """Return the five free orders of the order law by name, with the indices of joint 1 or 2 (`stage`)."""
        h, k = 2 * stage - 1, 2 * stage
        return {f"alpha{h}": 2.0, f"alpha{k}": 2.0, f"gamma{h}": self.gamma, f"beta{k}": self.beta, f"mu{k}": self.mu}

    def coefficients(self, stage: int, form: Form = "lagrange") -> dict[str, float]:
        """Return the coefficients of hub and link equation by name, with the indices of joint 1 or 2 (`stage`).

        `form` selects the form of the equations; see :class:`ArmParameters`.
        """
        h, k = 2 * stage - 1, 2 * stage
        hub = {f"a{h}": self.a, f"b{h}": self.b, f"d{h}": self.d, f"g{h}": self.g}
        if form == "lagrange":
            # By the definition of r, J_1/J_2 is r - 1.
            return hub | {f"a{k}": -self.a * (self.r - 1.0), f"d{k}": -self.d * (self.r - 1.0)}
        return hub | {f"a{k}": -self.a * self.r, f"b{k}": -self.b, f"d{k}": -self.d * self.r, f"g{k}": -self.g}


@check_arguments
@dataclass(frozen=True)
class ArmParameters:
    """Parameters of the simulated arm and its sensors.

    Parameters
    ----------
    stage1, stage2
        Parameters of the two joints.
    coupling
        Inertial coupling between the joints: 0 for none, 1 for joint 2 mounted on link 1, as in
        :func:`ftlm.flexible_link` with ``cross_stage="inertial"``. A value in between scales the motion of link 1 in
        the kinetic energy of joint 2.
    inertia_ratio
        Inertia of hub 2 divided by the inertia of link 1 with everything that it carries, J_21/J_12.
    link_coupling_ratio
        Coupling ratio H/J_22. H is the length of link 1 times the first moment of mass of link 2, and J_22 the inertia
        of link 2. The ratio is 1 for equally long links with the mass at the tip.
    rotating_inertia_fraction
        Fraction of the hub inertia J_21 that rotates with link 1. A rotor behind a gear contributes only its inertia
        divided by the gear ratio.
    current_offset
        Current offset of each motor while the amplifiers are enabled [A]. On the real arm it differs from run to run.
    strain_noise, current_noise
        Standard deviation of the noise on the strain-gauge and current-sense voltages [V], for joints 1 and 2.
    strain_bias, current_bias
        Offsets of the strain-gauge and current-sense voltages [V], for joints 1 and 2.
    bits
        Resolution of the analog-to-digital converters over ±10 V [bit]; 0 for no quantization.
    encoder_scale
        Hub angle per encoder count [rad], for joints 1 and 2.
    travel
        Magnitude of the hub angle at which a limit switch opens [rad], for joints 1 and 2.
    form
        ``"lagrange"``: Euler-Lagrange equations (14)-(15) of the paper. ``"published"``: its equations (22)-(25), whose
        deflections have the wrong sign, for comparison with the paper; only without coupling of the joints.
    name
        Name of the parameter set in files.
    """

    stage1: StageParameters
    stage2: StageParameters
    coupling: float = 1.0
    inertia_ratio: float = INERTIA_RATIO
    link_coupling_ratio: float = LINK_COUPLING_RATIO
    rotating_inertia_fraction: float = ROTATING_INERTIA_FRACTION
    current_offset: tuple[float, float] = (0.0, 0.0)
    strain_noise: tuple[float, float] = (0.015, 0.0134)
    current_noise: tuple[float, float] = (0.0012, 0.0012)
    strain_bias: tuple[float, float] = (0.12, -0.2)
    current_bias: tuple[float, float] = (0.006, 0.0105)
    bits: int = 16
    encoder_scale: tuple[float, float] = ENCODER_SCALE
    travel: tuple[float, float] = (math.pi / 2, math.pi / 2)
    form: Form = "lagrange"
    name: str = "effective"

    @classmethod
    def load(cls, source: str | os.PathLike[str] | ArmParameters) -> ArmParameters:
        """Return the parameter set that a name or a TOML file denotes, or the argument itself.

        Raises
        ------
        ModelError
            If the name is unknown.
        DataError
            If the file cannot be read, or has an invalid key or value.
        """
        if isinstance(source, ArmParameters):
            return source
        if isinstance(source, str) and source in PARAMETER_SETS:
            return PARAMETER_SETS[source]
        if not isinstance(source, (str, os.PathLike)):
            raise ModelError(
                f"parameters is {type_name(source)}; use {join_names(PARAMETER_SETS)}, or a TOML file's path"
            )
        if not os.fspath(source).endswith(".toml"):
            raise ModelError(
                f"{setting('parameters')} {short_repr(os.fspath(source))} is not "
                f"known{nearest(source, PARAMETER_SETS)}; use {join_names(PARAMETER_SETS)}, or a file whose name ends "
                "with .toml"
            )
        return cls._from_toml(Path(source))

    @classmethod
    def _from_toml(cls, path: Path) -> ArmParameters:
        values = _values_of(
            read_toml(path, "parameters of the arm", "a file of numbers by name, such as coupling = 0.5", _ArmFile)
        )
        base = values.pop("base", "effective")
        if base not in PARAMETER_SETS:
            raise DataError(
                f"{path.name}: base = {short_repr(base)} is not known{nearest(base, PARAMETER_SETS)}; use "
                f"{join_names(PARAMETER_SETS)}"
            )
        start = PARAMETER_SETS[base]
        stages = {name: _values_of(values.pop(name, _StageFile())) for name in ("stage1", "stage2")}
        for location, table in (("the file", values), *stages.items()):
            _check_values(path, location, table)
        merged = {name: replace(getattr(start, name), **table) for name, table in stages.items()}
        return replace(start, **{**values, **merged, "name": path.name[:100]})

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as a dictionary for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    def coupling_coefficients(self) -> dict[str, float]:
        """Return the coefficients of the terms in accelerations of the other joint, by name.

        Raises
        ------
        ModelError
            If a parameter is out of range, or the kinetic energy of the arm is not positive definite.
        """
        for name, highest in (
            ("coupling", 1.0),
            ("rotating_inertia_fraction", 1.0),
            ("inertia_ratio", math.inf),
            ("link_coupling_ratio", math.inf),
        ):
            value = getattr(self, name)
            if not (0.0 <= value <= highest and math.isfinite(value)):
                raise ModelError(f"{name} = {value!r} is outside [0, {highest:g}]; correct the arm's parameters")
        if not self.stage2.r > 1.0:
            raise ModelError(f"r = {self.stage2.r!r} of stage 2 is not above 1; give (J_1 + J_2)/J_2")
        hub = self.coupling * self.rotating_inertia_fraction * self.inertia_ratio
        arm = self.coupling * self.inertia_ratio / (self.stage2.r - 1.0) * (1.0 + self.link_coupling_ratio)
        base_coefficient, link_coefficient = (
            -self.coupling * self.rotating_inertia_fraction,
            -self.coupling * (1.0 + self.link_coupling_ratio),
        )
        # Determinant of the inertia matrix, relative to that of uncoupled joints.
        if not 1.0 + hub * base_coefficient + arm * link_coefficient > 0.0:
            raise ModelError(
                f"inertia_ratio = {self.inertia_ratio:g} and link_coupling_ratio = {self.link_coupling_ratio:g} give "
                "joint 2 more inertia than link 1 carries, so that the kinetic energy of the arm is not positive "
                "definite; make them smaller"
            )
        return {
            "p2": -hub - arm,
            "q2": -arm,
            "p3": base_coefficient,
            "q3": base_coefficient,
            "p4": link_coefficient,
            "q4": link_coefficient,
        }

    def model(self, *, friction: bool = False) -> Model:
        """Return the model of the arm from motor currents to angles.

        With friction, it describes the same motion as the simulation of :meth:`arm`.

        Parameters
        ----------
        friction
            Whether the hubs have Coulomb friction; only for the Lagrange form.

        Raises
        ------
        ModelError
            If orders or coefficients are invalid, or the published form is combined with coupling or friction.
        """
        if self.form == "published" and self.coupling != 0.0:
            raise ModelError(
                "form = 'published' has no coupling of the joints: set coupling = 0, or use form = 'lagrange'"
            )
        coupled = self.coupling != 0.0
        structure = flexible_link(
            stage="both",
            form=self.form,
            coupling="simulated",
            cross_stage="inertial" if coupled else False,
            friction=friction,
        )
        orders: dict[str, float] = {}
        coefficients: dict[str, float] = self.coupling_coefficients() if coupled else {}
        for j, stage in ((1, self.stage1), (2, self.stage2)):
            orders |= stage.orders(j)
            coefficients |= stage.coefficients(j, self.form)
            if friction:
                coefficients[f"fc{j}"] = stage.g * stage.coulomb
        order_values = {n: v for n, v in orders.items() if n in structure.order_names}
        return Model(structure.with_orders(order_values).with_coefficients(coefficients), orders=order_values)

    def arm(self, step: float, horizon: float) -> _core.VirtualArm:
        """Return the simulated arm at rest, for runs of at most `horizon` seconds with sampling interval `step` [s]."""
        model = self.model()
        links = {
            "equations": [equation_tuple(equation, ARM_SIGNALS) for equation in model.equations],
            "coulomb": [self.stage1.coulomb, self.stage2.coulomb],
        }
        sensors = {
            **vars(self),
            "strain_scale": STRAIN_SCALE,
            "noise": [*self.strain_noise, *self.current_noise],
            "sense_bias": self.current_bias,
            "sense_scale": SENSE_SCALE,
            "command_scale": COMMAND_SCALE,
            "range": 10.0,
            "current_limit": CURRENT_LIMIT,
            "offset": self.current_offset,
        }
        return _core.VirtualArm(links, sensors, step, MAX_SUBSTEP_S, horizon)


def _optional_toml_keys(kind: type[Any], **replacements: Any) -> list[tuple[str, Any, Any]]:
    """Return the fields of a dataclass, except `name`, as (name, type, default) of optional keys of a TOML file.

    `replacements` are the types of additional keys, and of keys whose type in the file differs from that of the field.
    """
    hints = {**get_type_hints(kind), **replacements}
    return [(name, hint | UnsetType, UNSET) for name, hint in hints.items() if name != "name"]


_StageFile = msgspec.defstruct("StageFile", _optional_toml_keys(StageParameters), forbid_unknown_fields=True)
_ArmFile = msgspec.defstruct(
    "ArmFile",
    _optional_toml_keys(ArmParameters, stage1=_StageFile, stage2=_StageFile, base=str),
    forbid_unknown_fields=True,
)


def _values_of(file: msgspec.Struct) -> dict[str, Any]:
    """Return the values that are set in a decoded TOML file, by key."""
    return {key: value for key, value in msgspec.structs.asdict(file).items() if value is not UNSET}


def _check_values(path: Path, location: str, table: Mapping[str, Any]) -> None:
    """Raise DataError if a number in a table of a TOML file is not finite or out of range.

    `location` is the name of the table in the message.
    """
    for key, value in table.items():
        values = [v for v in (value if isinstance(value, tuple) else (value,)) if not isinstance(v, str)]
        if not all(map(math.isfinite, values)):
            raise DataError(f"{path.name}: {key} = {value!r} in {location} is not finite; write a number")
        if key == "bits" and not 0 <= value <= 24:
            raise DataError(f"{path.name}: bits = {value!r} is not a whole number from 0 to 24; write one")
        if (key.endswith("noise") and min(values) < 0) or (key in ("travel", "encoder_scale") and min(values) <= 0):
            raise DataError(
                f"{path.name}: {key} = {value!r} in {location} must not be negative; write a positive number"
            )


_STAGE1 = StageParameters(
    a=628.89, b=-62.956, d=6.63, g=140.47, r=(0.0635 + 0.1704) / 0.1704, gamma=0.95, beta=0.1, mu=0.85, coulomb=0.08
)
_STAGE2 = StageParameters(
    a=2271.117,
    b=-496.763,
    d=28.351,
    g=288.122,
    r=(0.00301955 + 0.0064387) / 0.0064387,
    gamma=0.9,
    beta=0.2,
    mu=0.8,
    coulomb=0.1,
)
#: Parameters of the real arm, whose links were fitted with integer orders to one run of each of two units. For links 1
#: and 2, stiffness -K_s/J_2 is -164 and -418, and damping -B_2/J_2 is -0.365 and -2.09. The coupling coefficient is
#: -0.170 from joint 2 to link 1, and -2.36 from joint 1 to link 2. J_1/J_2 is the manufacturer's value. The free order
#: of the stiffness term of link 1 is estimated as 0 within 0.01. benches/virtual_arm.py repeats these fits.
_SOFT1 = StageParameters(a=439.9, b=-17.4, d=0.979, g=112.6, r=_STAGE1.r, gamma=1.0, beta=0.0, mu=1.0, coulomb=0.179)
_SOFT2 = StageParameters(a=891.0, b=-142.0, d=4.46, g=288.0, r=_STAGE2.r, gamma=1.0, beta=0.0, mu=1.0, coulomb=0.228)
_MEASURED_ARM = ArmParameters(_SOFT1, _SOFT2, inertia_ratio=0.0327, link_coupling_ratio=1.36, name="measured")
#: Named parameter sets. "effective" has the manufacturer's effective parameters with fractional damping, friction,
#: coupling and noise. "linear" has the same joints without coupling, friction, noise and quantization of the gauges.
#: "measured" and "measured-lqr" are two units of the real arm, under partial-state feedback and under LQR. Torque
#: constant, viscous and Coulomb friction of each hub were fitted to the run of its unit. For hub 2 of the first unit,
#: they are identifiable only if the manufacturer's torque constant is used.
PARAMETER_SETS: dict[str, ArmParameters] = {
    "effective": ArmParameters(_STAGE1, _STAGE2),
    "linear": ArmParameters(
        replace(_STAGE1, coulomb=0.0),
        replace(_STAGE2, coulomb=0.0),
        coupling=0.0,
        strain_noise=(0.0, 0.0),
        current_noise=(0.0, 0.0),
        strain_bias=(0.0, 0.0),
        current_bias=(0.0, 0.0),
        bits=0,
        name="linear",
    ),
    "measured": _MEASURED_ARM,
    "measured-lqr": replace(
        _MEASURED_ARM,
        stage1=replace(_SOFT1, b=-25.6, g=120.0, coulomb=0.254),
        stage2=replace(_SOFT2, b=-18.7, g=196.5, coulomb=0.148),
        name="measured-lqr",
    ),
}
