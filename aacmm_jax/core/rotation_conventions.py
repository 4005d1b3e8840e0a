"""How tables write rotations: quaternions, rotation vectors, matrices, and three angles about axes."""

import itertools
import re

import numpy as np
from jaxtyping import Float

NUMBERS_OF_ROTATION = {"vector": 3, "quaternion wxyz": 4, "quaternion xyzw": 4, "matrix": 9}
_INVERSE = " inverse"  # of tables that state how the base is turned in the target, or quaternions of JPL's convention
_AXES = re.compile("([xyz]{3}|[XYZ]{3})")
_ORDERS = ["".join(axes) for axes in itertools.product("xyz", repeat=3) if axes[0] != axes[1] != axes[2]]


def is_convention(text: str) -> bool:
    """Whether a text names a convention: one of `NUMBERS_OF_ROTATION`, or three axes, of which neighbours differ; with
    " inverse" where the transposed matrix is meant."""
    text = text.removesuffix(_INVERSE)
    return text in NUMBERS_OF_ROTATION or (text.lower() in _ORDERS and _AXES.fullmatch(text) is not None)


def numbers_of(convention: str) -> int:
    """How many numbers a rotation has."""
    return NUMBERS_OF_ROTATION.get(convention.removesuffix(_INVERSE), 3)


def is_of_angles(convention: str) -> bool:
    """Whether the numbers have a unit."""
    return numbers_of(convention) == 3


def conventions(count: int) -> list[str]:
    """All conventions with so many numbers, the usual ones first."""
    names = [name for name, numbers in NUMBERS_OF_ROTATION.items() if numbers == count]
    names += [*(order.upper() for order in _ORDERS), *_ORDERS] if count == 3 else []
    return [*names, *(name + _INVERSE for name in names)]


def rotation_matrices(numbers: Float[np.ndarray, "m k"], convention: str) -> Float[np.ndarray, "m 3 3"]:
    """The matrices, with the target's axes as columns; ``numbers`` are in rad where they have a unit."""
    from scipy.spatial.transform import Rotation  # takes long to import

    plain = convention.removesuffix(_INVERSE)
    if plain == "matrix":
        matrices = numbers.reshape(-1, 3, 3)
    elif plain.startswith("quaternion"):
        matrices = Rotation.from_quat(numbers, scalar_first=plain.endswith("wxyz")).as_matrix()
    elif plain == "vector":
        matrices = Rotation.from_rotvec(numbers).as_matrix()
    else:
        matrices = Rotation.from_euler(plain, numbers).as_matrix()
    return matrices if plain == convention else matrices.swapaxes(1, 2)
