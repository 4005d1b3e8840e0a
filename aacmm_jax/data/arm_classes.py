"""Classes of arms: the noise that plans assume of one that has not been calibrated, and how its tool comes to a socket.

The only place that says so. A calibration estimates its noise from the data, and compares it with what is usual.
"""

import math
from typing import NamedTuple

import numpy as np

from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm, joint_limits
from ..kinematics.chain import joint_motion
from .noise import Noise, encoder_covariances, noise_of

SEATING = 0.005  # mm: a ball in a kinematic seat
_SAMPLES = 2000
# ISO 9283: repeatability is the mean distance from the barycentre plus three of its standard deviations. Distances of
# three normal components of standard deviation s have the mean 2 s sqrt(2 / pi) and the variance (3 - 8 / pi) s^2.
_REPEATABILITY = 2 * math.sqrt(2 / math.pi) + 3 * math.sqrt(3 - 8 / math.pi)


class ArmClass(NamedTuple):
    """What arms of a class have in common, where nothing is known of the single one."""

    repeatability: float | None  # pose repeatability of ISO 9283, mm; None where the encoders are known instead
    cone: float  # half angle of the cone from which the tool comes to a socket, rad
    retract: float  # distance of the approach point from the socket, mm
    source: str


class ArmNoise(NamedTuple):
    """What is usual for an arm: its class and its noise, and where the numbers come from.

    Example:
        >>> usual = aj.files.load_noise("panda")
        >>> print(usual.arm_class, f"{usual.noise.encoder_arcsec:.1f} arcsec, {usual.noise.seating} mm")
        robot 9.0 arcsec, 0.005 mm
    """

    arm_class: str
    noise: Noise
    source: str


CLASSES = {
    # A person turns the probe in its seat as the standards' tests ask for, and takes it there by hand.
    "measuring arm": ArmClass(None, math.pi, 0.0, "encoders of a small commercial arm"),
    # The middle of makers' data sheets for six and seven axes of 0.5 to 1.5 m; 55 deg is what recorded captures keep.
    "robot": ArmClass(0.05, math.radians(60), 50.0, "typical of data sheets of industrial and collaborative robots"),
    "hobby arm": ArmClass(1.0, math.radians(60), 50.0, "typical of arms with hobby servos"),
}


def class_named(name: str) -> ArmClass:
    """The class of this name.

    Raises:
        InputError: There is none.
    """
    if name not in CLASSES:
        raise InputError(f"there is no class of arms '{name}'; give one of {', '.join(CLASSES)}.")
    return CLASSES[name]


def small_arm_noise() -> Noise:
    """The noise of a small commercial measuring arm."""
    return Noise(encoder_arcsec=2.0, seating=SEATING)


def class_noise(arm: Arm, name: str) -> Noise:
    """The noise that plans assume of an arm of a class."""
    repeatability = class_named(name).repeatability
    return small_arm_noise() if repeatability is None else noise_of_repeatability(arm, repeatability)


def noise_of_repeatability(arm: Arm, repeatability: float, seating: float = SEATING) -> Noise:
    """The noise of readings that explains a published pose repeatability.

    All encoders have the same standard deviation s (of a prismatic joint at 1 m, see `Noise`); the tip of a
    configuration then scatters by s^2 trace(J J^T) / 3 a coordinate, on average over the joint limits.

    Args:
        arm: One arm.
        repeatability: Pose repeatability (RP of ISO 9283), mm.
        seating: Standard deviation of the tip in its seat, mm.

    Raises:
        InputError: The repeatability is not above 0.
    """
    if not (math.isfinite(repeatability) and repeatability > 0):
        raise InputError(f"a repeatability of {repeatability:g} mm is none; give a number above 0.")
    limits = np.asarray(joint_limits(arm, None))
    q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_SAMPLES, arm.joints))
    geometry = to_numpy(arm.geometry)
    one = noise_of(np.asarray(1.0), np.asarray(0.0)).of_readings(geometry.kinds)
    scattered = np.asarray(encoder_covariances(geometry, joint_motion(geometry, q), one))
    lever = math.sqrt(float(np.mean(np.trace(scattered))) / 3)
    if lever == 0:
        raise InputError("no joint moves the tip of this arm, so its repeatability says nothing of the readings.")
    return noise_of(np.asarray(repeatability / _REPEATABILITY / lever), np.asarray(seating))
