"""The noise of a measurement: errors of the encoders, and of the tip in its seat."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_floats, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, numpy_if_known, to_jax, to_numpy
from ..core.units import ARCSEC
from ..kinematics.chain import Geometry, SinesCosines, forward_pass
from ..kinematics.jacobian import jacobian_columns

_MOST = {"encoder_arcsec": 36_000.0, "seating": 100.0}  # ten degrees; mm


class Noise(eqx.Module):
    """Standard deviations of independent errors: of each joint reading, and of each coordinate of the seated tip.

    Args:
        encoder_arcsec: Of a reading, arcsec: a scalar for all encoders, or shape ``(n,)``.
        seating: Of a coordinate of the tip's centre about the socket's, scalar, mm.

    Raises:
        InputError: For values that are negative, not finite or of another shape.
    """

    encoder: Float[AnyArray, "..."]  # rad
    seating: Float[AnyArray, ""]  # mm

    def __init__(self, *, encoder_arcsec: Numbers = 0.0, seating: Numbers = 0.0):
        self.encoder = to_jax(to_numpy(as_floats(encoder_arcsec, "encoder_arcsec")) * ARCSEC)
        self.seating = as_floats(seating, "seating")
        for what, values in (("encoder_arcsec", self.encoder), ("seating", self.seating)):
            if values.ndim > (what == "encoder_arcsec"):
                allowed = "one number, or one a joint" if what == "encoder_arcsec" else "one number"
                raise InputError(f"{what} has shape {values.shape}; give {allowed}.")
            if values.size == 0:
                raise InputError(f"{what} is empty; give one number, or one a joint.")
            if is_concrete(values) and np.any(np.asarray(values) < 0):
                raise InputError(f"{what} must be a standard deviation: zero or positive.")

    @property
    @numpy_if_known
    def encoder_arcsec(self) -> Float[AnyArray, "..."]:
        """Standard deviation of readings, scalar or ``(n,)``, arcsec."""
        return self.encoder / ARCSEC

    def check(self, joints: int) -> None:
        """Check that this noise can weight the poses of an arm.

        Args:
            joints: Number of joints of the arm.

        Raises:
            InputError: Where all noise is zero, some is absurdly large, or encoders and joints differ in number.
        """
        if is_concrete(self.encoder, self.seating) and not (
            np.any(np.asarray(self.encoder)) or np.any(np.asarray(self.seating))
        ):
            raise InputError(
                "noise is zero everywhere, so poses cannot be weighted by it; give a standard deviation, or no noise."
            )
        # Not in the constructor: residuals of a failed calibration may be as large, and its file must still be read.
        for what, values in (("encoder_arcsec", self.encoder_arcsec), ("seating", self.seating)):
            if is_concrete(values) and np.any(np.asarray(values) > _MOST[what]):
                raise InputError(f"{what} is over {_MOST[what]:g}, more than any arm's; is it in another unit?")
        self.check_joints(joints)

    def check_joints(self, joints: int) -> None:
        """Check the number of encoders.

        Args:
            joints: Number of joints of the arm.

        Raises:
            InputError: Where ``encoder_arcsec`` has neither one value nor one a joint.
        """
        if self.encoder.ndim and self.encoder.shape != (joints,):
            raise InputError(
                f"encoder_arcsec has {self.encoder.shape[0]} values, but the arm has {joints} joints; give one number, "
                "or one a joint."
            )


def noise_of(encoder: Float[AnyArray, "..."], seating: Float[AnyArray, ""]) -> Noise:
    """Noise of these standard deviations, rad and mm, as computed: nothing is converted or checked."""
    return eqx.tree_at(lambda noise: (noise.encoder, noise.seating), Noise(), (encoder, seating))


def tip_covariances(geometry: Geometry, sines_cosines: SinesCosines, noise: Noise) -> Float[AnyArray, "... 3 3 N"]:
    """Covariance of the tip of every pose, mm^2: J_q S J_q^T of the encoders, plus the seat's in every direction."""
    # Plus (1 nm)^2: a pose in which no joint moves the tip in some direction would have an infinite weight.
    seat = (noise.seating**2 + 1e-12) * namespace(geometry, noise).eye(3)[..., None]
    encoders = encoder_covariances(geometry, sines_cosines, noise.encoder)
    return encoders + seat.reshape((1,) * (encoders.ndim - 3) + seat.shape)


def encoder_covariances(
    geometry: Geometry, sines_cosines: SinesCosines, encoder: Float[AnyArray, "..."]
) -> Float[AnyArray, "... 3 3 N"]:
    """J_q S J_q^T of every pose, mm^2, for encoders of standard deviation ``encoder`` (scalar or ``(n,)``, rad)."""
    columns = jacobian_columns(forward_pass(geometry, sines_cosines))["theta"]
    xp = namespace(columns, encoder)
    each = xp.broadcast_to(encoder, (columns.shape[0],))
    columns = columns * each.reshape(-1, *(1,) * (columns.ndim - 1))
    return xp.sum(columns[..., :, None, :] * columns[..., None, :, :], axis=0)
