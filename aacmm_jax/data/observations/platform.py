"""A start for the frames of an indexed platform, which one observation alone does not give."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...core.numpy_or_jax import AnyArray, namespace
from ...core.rotations import fitted_frame, rotation_matrix
from .artefact import Artefact
from .frames import placed
from .observation import AbstractObservation, Tips

Frame = Float[AnyArray, " 6"]
Held = list[tuple[Artefact, Float[AnyArray, "3 m"]]]  # an artefact of each observation, and the tips in its points


def platform_frames(observations: Sequence[AbstractObservation], tips: Sequence[Tips]) -> dict[str, Frame]:
    """Frames of the platform at each index, and of all placements, from nearly right tips; none without a platform.

    An index follows from the points of all placements that are already known on the platform together, since those of
    one bar leave a turn about its line open; placements that are new at this index then follow from it. Of indices that
    no known placement reaches, the first has the frame zero, since nothing measured says what the platform's own is.
    """
    # By the name of the platform's frame. What does not stand on it, "", comes first: its frame is that of the base.
    waiting: dict[str, Held] = {"": []}
    for observation, tip in zip(observations, tips, strict=True):
        if isinstance(observation, Artefact):
            name = "" if observation.index is None else observation.platform
            waiting.setdefault(name, []).append((observation, tip.position))
    if len(waiting) == 1:
        return {}
    placements: dict[str, Frame] = {}
    indices: dict[str, Frame] = {}
    while waiting:
        poses = {
            name: sum(artefact.q.shape[0] for artefact, _ in held if artefact.frame in placements)
            for name, held in waiting.items()
        }
        name = "" if "" in waiting else max(poses, key=lambda name: poses[name])
        held = waiting.pop(name)
        placed_before = [(artefact, tip) for artefact, tip in held if artefact.frame in placements]
        indices[name] = _index(placed_before, placements) if placed_before else np.zeros(6)
        placements |= _new_placements([one for one in held if one[0].frame not in placements], indices[name])
    del indices[""]
    return placements | indices


def _index(held: Held, placements: dict[str, Frame]) -> Frame:
    """In which points on the platform come closest to the tips."""
    points = [placed(placements[artefact.frame], _coordinates(artefact))[0] for artefact, _ in held]
    xp = namespace(points, held)
    return fitted_frame(xp.concatenate(points, axis=1), xp.concatenate([tips for _, tips in held], axis=1))


def _new_placements(held: Held, index: Frame) -> dict[str, Frame]:
    """On the platform, by all that was held in each at this index."""
    placements = {}
    for name in dict.fromkeys(artefact.frame for artefact, _ in held):
        same = [one for one in held if one[0].frame == name]
        xp = namespace(same, index)
        tips = xp.concatenate([position for _, position in same], axis=1)
        coordinates = xp.concatenate([_coordinates(artefact) for artefact, _ in same], axis=1)
        placements[name] = fitted_frame(coordinates, rotation_matrix(index[:3]).T @ (tips - index[3:, None]))
    return placements


def _coordinates(artefact: Artefact) -> Float[AnyArray, "3 m"]:
    return artefact.coordinates[artefact.owner].T
