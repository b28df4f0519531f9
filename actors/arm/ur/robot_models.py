"""The supported robots: lengths and limits, and the calibration of a single robot. Plain values.

Sources:

- lengths and joint speeds: `default_kinematics.yaml` and `joint_limits.yaml` of the manufacturer's ROS 2 description;
- payloads: product pages, second-hand. A UR10e takes 10 kg or 12.5 kg; its label says which;
- robot types: the manufacturer's client library.

No value was compared with a robot. A UR5 of the CB3 generation exists in three series of different lengths. The names
on the dashboard, and the types of UR7e and UR12e, are unverified: both should report those of UR5e and UR10e.

Lengths are nominal. A factory-calibrated robot differs from them by 2–8 mm and 0.4–1.4° (`Calibration`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import pi, radians

Joints = tuple[float, float, float, float, float, float]

TWISTS: Joints = (pi / 2, 0.0, 0.0, pi / 2, -pi / 2, 0.0)
"""Denavit–Hartenberg twists of every model [rad]."""

SAME_PLACE, SAME_ANGLE = 0.5e-3, radians(0.1)
"""Largest distance and angle between the tool's pose by own kinematics and by the controller's [m], [rad]."""

CB3_FREQUENCY, FREQUENCY = 125, 500
"""Control cycles per second of the older generation and of all later ones [Hz]."""


@dataclass(frozen=True)
class Calibration:
    """Denavit–Hartenberg parameters of one robot, as measured in the factory.

    The axes of joints 2 to 4 are nearly parallel, so that `d[1]` and `d[2]` may be hundreds of metres and `theta[1]`
    and `theta[2]` any angle. Only the product of all transformations has a meaning, not a single parameter.

    Attributes:
        theta, a, d, alpha: of the six joints [rad], [m], [m], [rad].
        checksum: eight hexadecimal digits; '' for a nominal robot, such as a simulator.
    """

    theta: Joints
    a: Joints
    d: Joints
    alpha: Joints
    checksum: str


@dataclass(frozen=True)
class RobotModel:
    """One model of robot.

    Attributes:
        name: on the controller's dashboard.
        d1, a2, a3, d4, d5, d6: lengths [m]; a2 and a3 are negative by convention.
        joint_speed: largest speed of each joint [rad/s].
        payload: largest payload [kg].
        kind: type of robot in configuration data.
        frequency: control cycles per second [Hz].
        joint_range: largest rotation of each joint in either direction [rad].
        calibration: of a single robot; None for nominal lengths.
    """

    name: str
    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    joint_speed: Joints
    payload: float
    kind: int
    frequency: int = FREQUENCY
    joint_range: Joints = field(default=tuple(radians(363.0) for _ in range(6)))  # type: ignore[assignment]
    calibration: Calibration | None = None

    @property
    def cb3(self) -> bool:
        """Whether the robot is of the older generation."""
        return self.frequency == CB3_FREQUENCY

    @property
    def a(self) -> Joints:
        """Nominal lengths along x of the six joints [m]."""
        return (0.0, self.a2, self.a3, 0.0, 0.0, 0.0)

    @property
    def d(self) -> Joints:
        """Nominal lengths along z of the six joints [m]."""
        return (self.d1, 0.0, 0.0, self.d4, self.d5, self.d6)

    @property
    def parameters(self) -> Calibration:
        """All Denavit–Hartenberg parameters: calibrated, or nominal."""
        return self.calibration or Calibration((0.0,) * 6, self.a, self.d, TWISTS, "")

    @cached_property
    def nominal(self) -> RobotModel:
        """The model without calibration."""
        return self if self.calibration is None else replace(self, calibration=None)


def _speeds(*degrees: float) -> Joints:
    a, b, c, d, e, f = (radians(v) for v in degrees)
    return a, b, c, d, e, f


_SMALL = _speeds(180, 180, 180, 360, 360, 360)
_MIDDLE = _speeds(180, 180, 180, 180, 180, 180)
_LARGE = _speeds(120, 120, 180, 180, 180, 180)
_FAST = _speeds(180, 180, 240, 300, 300, 300)
_HEAVY = _speeds(120, 120, 150, 210, 210, 210)


def _robot(
    name: str,
    millimetres: tuple[float, ...],
    speeds: Joints,
    payload: float,
    kind: int,
    frequency: int = FREQUENCY,
) -> RobotModel:
    d1, a2, a3, d4, d5, d6 = (round(length / 1000.0, 9) for length in millimetres)
    return RobotModel(name, d1, a2, a3, d4, d5, d6, speeds, payload, kind, frequency)


_UR5E = _robot("UR5", (162.5, -425, -392.2, 133.3, 99.7, 99.6), _MIDDLE, 5.0, 1)
_UR10E = _robot("UR10", (180.7, -612.7, -571.55, 174.15, 119.85, 116.55), _LARGE, 12.5, 2)

MODELS = {
    "ur3": _robot("UR3", (151.9, -243.65, -213.25, 112.35, 85.35, 81.9), _SMALL, 3.0, 3, CB3_FREQUENCY),
    "ur5": _robot("UR5", (89.159, -425, -392.25, 109.15, 94.65, 82.3), _MIDDLE, 5.0, 1, CB3_FREQUENCY),
    "ur10": _robot("UR10", (127.3, -612, -572.3, 163.941, 115.7, 92.2), _LARGE, 10.0, 2, CB3_FREQUENCY),
    "ur3e": _robot("UR3", (151.85, -243.55, -213.2, 131.05, 85.35, 92.1), _SMALL, 3.0, 3),
    "ur5e": _UR5E,
    "ur7e": replace(_UR5E, payload=7.5),
    "ur10e": _UR10E,
    "ur12e": _UR10E,
    "ur16e": _robot("UR16", (180.7, -478.4, -360, 174.15, 119.85, 116.55), _LARGE, 16.0, 4),
    "ur8long": _robot("UR8L", (218.6, -898.9, -714.9, 182.4, 136.1, 143.4), _FAST, 10.0, 6),
    "ur15": _robot("UR15", (218.6, -647.5, -516.4, 182.4, 136.1, 143.4), _FAST, 17.5, 9),
    "ur18": _robot("UR18", (218.6, -475, -338.9, 182.4, 136.1, 143.4), _FAST, 18.0, 5),
    "ur20": _robot("UR20", (236.3, -862, -728.7, 201, 159.3, 154.3), _HEAVY, 25.0, 7),
    "ur30": _robot("UR30", (236.3, -637, -503.7, 201, 159.3, 154.3), _HEAVY, 35.0, 8),
}
"""Models by their names in configuration files."""

_CB3_DIFFERENCES = (
    (-7.290070070824746e-05, -0.01713897289704999, -0.03707159413492756, 0.054279462160583214, 1.488984257025741e-07,
     1.551499479707493e-05),
    (4.6311376834935676e-05, -0.00012568315331862312, 0.00186216581161458, 9.918593870679266e-05,
     4.215462720453189e-06, 0.0),
    (0.00065609212979853, 1.4442162376284788, 0.854147723854608, -2.2989425877563705, -1.573498686836816e-05,
     1.9072435590711256e-05),
    (0.000211987863869334, -0.0072553625957652995, -0.013483226769541364, 0.0013495820227329425,
     -0.001263136163679901, 0.0),
)  # fmt: skip

_E_SERIES_DIFFERENCES = (
    (-2.41478068943590252e-07, 1.60233952386694556, -1.68607190752171299, 0.0837331147700118711,
     -1.01260355871157781e-07, 3.91986209186123702e-08),
    (2.12234865571205891e-05, 0.632017132627700651, 0.00229833638891230319, -4.61409023720933908e-05,
     -6.39280053471801522e-05, 0.0),
    (-0.000160188285741325043, 439.140974079900957, -446.027059806332147, 6.88618689642360149,
     -3.86588496858186748e-05, -0.00087908274257374186),
    (-0.000650246557584166496, 0.00139416666825590402, 0.00693818880325995126, -0.000811641562390219562,
     0.000411120504570705592, 0.0),
)  # fmt: skip


def plausible_calibration(model: RobotModel) -> Calibration:
    """The calibration of a plausible robot: the virtual controller reports it, and checks before a connection use it.

    The differences from nominal are those of a UR10 and of a UR10e, from the tests of the manufacturer's ROS driver,
    with lengths in proportion to the upper arm. In the second one, axes 2 and 3 are nearly parallel: d2 and d3 are
    hundreds of metres.
    """
    theta, a, d, alpha = _CB3_DIFFERENCES if model.cb3 else _E_SERIES_DIFFERENCES
    size = model.a2 / MODELS["ur10" if model.cb3 else "ur10e"].a2
    nominal = model.nominal.parameters

    def shifted(values: Joints, differences: Joints, scale: float = 1.0) -> Joints:
        base, two, three, four, five, six = (v + scale * x for v, x in zip(values, differences, strict=True))
        return base, two, three, four, five, six

    return Calibration(
        theta, shifted(nominal.a, a, size), shifted(nominal.d, d, size), shifted(nominal.alpha, alpha), "virtual"
    )


def model_named(name: str, software: Sequence[int]) -> str:
    """The name in configuration files of the model that a controller reports; its own name if it is not supported.

    Args:
        name: as the dashboard reports it; controllers leave out the 'e' of the e-Series.
        software: version of the controller's software.
    """
    plain = name.strip().lower().replace(" ", "")
    plain = "ur8long" if plain == "ur8l" else plain
    cb3 = bool(software) and software[0] < 5
    return next((key for key in (f"{plain}e", plain) if key in MODELS and MODELS[key].cb3 == cb3), plain)


def same_robot(a: str, b: str) -> bool:
    """Whether two models cannot be told apart by their controllers, such as UR5e and UR7e."""
    if a not in MODELS or b not in MODELS:
        return a == b
    first, second = MODELS[a], MODELS[b]
    return (first.kind, first.a, first.d, first.cb3) == (second.kind, second.a, second.d, second.cb3)
