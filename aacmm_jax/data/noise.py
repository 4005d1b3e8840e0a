"""The noise of a measurement, errors of the encoders and of the tip in its seat, and what is usual for classes of arms.

A calibration estimates its noise from the data, and compares it with what is usual; plans for an arm that has not been
calibrated assume it.
"""

import math
from typing import Annotated, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arguments import NOT_EMPTY, Range, checked
from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, numpy_if_known, to_jax, to_numpy
from ..core.units import ARCSEC
from ..kinematics.arm import Arm, joint_limits, with_chains
from ..kinematics.chain import Geometry, JointKinds, JointMotion, forward_pass, joint_motion
from ..kinematics.jacobian import reading_columns

_MOST = {"encoder_arcsec": 36_000.0, "linear_encoder": 100.0, "seating": 100.0}  # ten degrees; mm
_ONE = Annotated[Float[AnyArray, ""], Range(least=0)]
_ONE_OR_EACH = Annotated[Float[AnyArray, ""] | Float[AnyArray, " joints"], NOT_EMPTY, Range(least=0)]


class Noise(eqx.Module):
    """Standard deviations of independent errors: of each joint reading, and of each coordinate of the seated tip.

    Args:
        encoder_arcsec: Of a reading, arcsec: a scalar for all encoders, or shape ``(n,)``.
        linear_encoder: Of the reading of a prismatic joint, mm: a scalar for all, or shape ``(n,)``, of which revolute
            joints use nothing. By default what ``encoder_arcsec`` is at a distance of 1 m: 4.8 um for 1 arcsec.
        seating: Of a coordinate of the tip's centre about the socket's, scalar, mm.

    Raises:
        InputError: For values that are negative, not finite or of another shape.

    Example:
        >>> by_joint = aj.Noise(encoder_arcsec=[2, 2, 2, 5, 5, 10], seating=0.005)
        >>> print(by_joint.encoder_arcsec, (by_joint.encoder * 1e6).round(1), "urad")
        [ 2.  2.  2.  5.  5. 10.] [ 9.7  9.7  9.7 24.2 24.2 48.5] urad
    """

    encoder: Float[AnyArray, "..."]  # rad
    seating: Float[AnyArray, ""]  # mm
    linear_encoder: Float[AnyArray, "..."] | None  # mm; None: ``encoder`` at 1 m

    def __init__(self, *, encoder_arcsec: Numbers = 0.0, seating: Numbers = 0.0, linear_encoder: Numbers | None = None):
        arcsec = checked(encoder_arcsec, _ONE_OR_EACH, "encoder_arcsec")
        self.encoder = to_jax(to_numpy(arcsec) * ARCSEC)
        self.seating = checked(seating, _ONE, "seating")
        linear = None if linear_encoder is None else checked(linear_encoder, _ONE_OR_EACH, "linear_encoder")
        self.linear_encoder = linear

    @property
    @numpy_if_known
    def encoder_arcsec(self) -> Float[AnyArray, "..."]:
        """Standard deviation of readings, scalar or ``(n,)``, arcsec."""
        return self.encoder / ARCSEC

    def _given(self) -> dict[str, AnyArray]:
        """The arguments by name."""
        return {what: getattr(self, what) for what in _MOST if getattr(self, what) is not None}

    def of_readings(self, kinds: JointKinds | None) -> Float[AnyArray, "..."]:
        """Standard deviations of the readings of an arm with such joints, scalar or ``(n,)``, rad and mm."""
        if kinds is None:
            return self.encoder
        xp = namespace(self.encoder, self.linear_encoder)
        angular = self.encoder * xp.asarray(kinds.units)
        each = angular if self.linear_encoder is None else xp.where(kinds.mask(), self.linear_encoder, angular)
        return each * kinds.read if kinds.followers else each

    def of_columns(self, kinds: JointKinds | None, joints: int, columns: int) -> Float[np.ndarray, " columns"]:
        """Standard deviations of all columns of readings, rad and mm; 0 for what is recorded beside them."""
        of_joints = np.broadcast_to(np.asarray(self.of_readings(kinds)), (joints,))
        return np.concatenate([of_joints, np.zeros(columns - joints)])

    def check(self, joints: int) -> None:
        """Check that this noise can weight the poses of an arm with so many joints.

        Raises `InputError` where all noise is zero, some is absurdly large, or encoders and joints differ in number.
        """
        given = self._given()
        if is_concrete(*given.values()) and not any(np.any(np.asarray(values)) for values in given.values()):
            raise InputError(
                "every standard deviation of the noise is zero, so the poses cannot be weighted; give a positive "
                "standard deviation, or omit the noise."
            )
        # Not in the constructor: residuals of a failed calibration may be as large, and its file must still be read.
        for what, values in given.items():
            if is_concrete(values) and np.any(np.asarray(values) > _MOST[what]):
                raise InputError(
                    f"{what} is above {_MOST[what]:g}, which is more than any arm has; is {what} in another unit?"
                )
        self.check_joints(joints)

    def check_joints(self, joints: int) -> None:
        """Raise `InputError` where the encoders have neither one value nor one a joint."""
        for what, values in self._given().items():
            if values.ndim and values.shape != (joints,):
                raise InputError(
                    f"{what} has {values.shape[0]} values, but the arm has {joints} joints; give one number, or one "
                    "number per joint."
                )


def noise_of(encoder: Float[AnyArray, "..."], seating: Float[AnyArray, ""]) -> Noise:
    """Noise of these standard deviations, rad and mm, as computed: nothing is converted or checked.

    Linear encoders are as good as the others at 1 m: what has been estimated is one variance of all readings.
    """
    return eqx.tree_at(lambda noise: (noise.encoder, noise.seating), Noise(), (encoder, seating))


def at_tip(noise: Noise, arm: Arm, distance: float) -> tuple[float, float, float]:
    """Standard deviations, mm, by which encoders of revolute joints at a distance (mm), those of prismatic joints, and
    the seat move the tip: each the root mean square of its joints, 0 without such joints."""
    kinds = arm.geometry.kinds
    u = np.broadcast_to(np.asarray(noise.of_readings(kinds)), (arm.joints,))
    linear = np.zeros(arm.joints, dtype=bool) if kinds is None else kinds.mask()
    turning, sliding = (float(np.sqrt(np.mean(x**2))) if len(x) else 0.0 for x in (u[~linear], u[linear]))
    return turning * distance, sliding, float(noise.seating)


def linear_encoder_mm(noise: Noise, arm: Arm) -> float | list[float] | None:
    """Standard deviation of the readings of an arm's prismatic joints, mm, one or one each; None without any."""
    if not arm.prismatic:
        return None
    of_slides = np.asarray(noise.of_readings(arm.geometry.kinds))[np.array(arm.prismatic) - 1].tolist()
    return of_slides[0] if len(set(of_slides)) == 1 else of_slides


def one_arcsec(kinds: JointKinds | None) -> Float[np.ndarray, "..."]:
    """Standard deviations of readings, rad and mm, by encoders of 1 arcsec: the unit of an estimated noise."""
    return np.asarray(ARCSEC) if kinds is None else ARCSEC * kinds.units


def tip_covariances(geometry: Geometry, motion: JointMotion, noise: Noise) -> Float[AnyArray, "... 3 3 N"]:
    """Covariance of the tip of every pose, mm^2: J_q S J_q^T of the encoders, plus the seat's in every direction."""
    # Plus (1 nm)^2: a pose in which no joint moves the tip in some direction would have an infinite weight.
    seat = (noise.seating**2 + 1e-12) * namespace(geometry, noise).eye(3)[..., None]
    encoders = encoder_covariances(geometry, motion, noise.of_readings(geometry.kinds))
    return encoders + seat.reshape((1,) * (encoders.ndim - 3) + seat.shape)


def encoder_covariances(
    geometry: Geometry, motion: JointMotion, encoder: Float[AnyArray, "..."]
) -> Float[AnyArray, "... 3 3 N"]:
    """J_q S J_q^T of every pose, mm^2, for readings of standard deviation ``encoder``, scalar or ``(n,)``."""
    columns = reading_columns(forward_pass(geometry, motion))
    xp = namespace(columns, encoder)
    deviations = xp.broadcast_to(encoder, (columns.shape[0],))
    columns = columns * deviations.reshape(-1, *(1,) * (columns.ndim - 1))
    return xp.sum(columns[..., :, None, :] * columns[..., None, :, :], axis=0)


SEATING = 0.005  # mm: a ball in a kinematic seat
_SAMPLES = 2000
# ISO 9283: repeatability is the mean distance from the barycentre plus three of its standard deviations. Distances of
# three normal components of standard deviation s have the mean 2 s sqrt(2 / pi) and the variance (3 - 8 / pi) s^2.
_REPEATABILITY = 2 * math.sqrt(2 / math.pi) + 3 * math.sqrt(3 - 8 / math.pi)


class ArmClass(NamedTuple):
    """What arms of a class have in common, where nothing is known of the single one."""

    repeatability: float | None  # pose repeatability of ISO 9283, mm; None where the encoders are known instead
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
    "measuring arm": ArmClass(None, 0.0, "encoders of a small commercial arm"),
    # The middle of makers' data sheets for six and seven axes of 0.5 to 1.5 m.
    "robot": ArmClass(0.05, 50.0, "typical of data sheets of industrial and collaborative robots"),
    "hobby arm": ArmClass(1.0, 50.0, "typical of arms with hobby servos"),
}


def small_arm_noise() -> Noise:
    """The noise of a small commercial measuring arm."""
    return Noise(encoder_arcsec=2.0, seating=SEATING)


def class_noise(arm: Arm, name: str) -> Noise:
    """The noise that plans assume of an arm of a class; `InputError` where there is no such class."""
    if name not in CLASSES:
        raise InputError(f"unknown class of arms '{name}'; give one of {', '.join(CLASSES)}.")
    repeatability = CLASSES[name].repeatability
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
        raise InputError(f"the repeatability is {repeatability:g} mm; give a positive number.")
    limits = np.asarray(joint_limits(arm, None))
    q = with_chains(arm, np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_SAMPLES, arm.joints)))
    geometry = to_numpy(arm.geometry)
    unit = noise_of(np.asarray(1.0), np.asarray(0.0)).of_readings(geometry.kinds)
    scattered = np.asarray(encoder_covariances(geometry, joint_motion(geometry, q), unit))
    lever = math.sqrt(float(np.mean(np.trace(scattered))) / 3)
    if lever == 0:
        raise InputError(
            "no joint moves the tip of this arm, so the noise of the readings cannot be derived from its "
            "repeatability; correct the arm."
        )
    return noise_of(np.asarray(repeatability / _REPEATABILITY / lever), np.asarray(seating))
