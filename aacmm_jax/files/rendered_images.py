"""Images of a simulated capture, rendered, with a table of readings and a manifest, as somebody would record them."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..calibration.reprojection import frame_of
from ..core.errors import InputError, naming, require
from ..core.text import csv_text
from ..core.units import DEG
from ..data.capture import Capture
from ..data.observations.observation import AbstractObservation
from ..data.observations.pixels import Pixels
from ..data.recording import Recording
from ..kinematics.arm import by_joint
from .kits import kit_targets, target_tables
from .manifest_pixels import Progress, without_progress
from .outputs import write_atomically, write_text
from .plans import camera_tables, images_table, manifest_text
from .table_columns import BESIDE

MANIFEST = "capture.toml"
_QUALITY = 80  # of JPEG
_WHAT = (
    "Simulated: the images are rendered, and the readings are those of a simulated arm. Then run: aacmm import "
    f"{MANIFEST} -o capture.h5"
)


def save_images(
    folder: str | os.PathLike,
    recording: Recording,
    kit: str | os.PathLike,
    arm: Mapping[str, Any],
    optics: Any = None,
    *,
    progress: Progress = without_progress,
) -> Recording:
    """Render what the cameras of a simulated capture saw, into a folder for each, and write what an import needs.

    Args:
        folder: folder to write to; made where it does not exist.
        recording: a simulated capture whose cameras recorded their true views.
        kit: file of the kit that was simulated, which has the targets.
        arm: the first entries of the manifest: the arm, and the links of a URDF.
        optics: blur, noise and light (`camera.Optics`).
        progress: as of `read_manifest`.

    Returns:
        The same recording, with the views that the corners show.
    """
    require("camera", "Rendering of images")
    folder, seen = Path(folder), [each for each in recording.capture.observations if isinstance(each, Pixels)]
    if not seen:
        raise InputError("the kit has no camera, so there are no images; add [[camera]], [[target]] and [[pixels]].")
    tables = [dict(table) for table in target_tables(kit)]
    for table in tables:
        if "file" in table:
            table["file"] = Path(os.path.relpath(Path(kit).parent / table["file"], folder)).as_posix()
    tables = camera_tables(seen, tables)
    targets = kit_targets(kit)
    for number, observation in enumerate(seen):
        entry = images_table(observation, "one row per image", "jpg")
        names = [f"{pose:0{len(str(len(observation.q)))}d}.jpg" for pose in range(1, 1 + len(observation.q))]
        images = folder / Path(entry["images"]).parent
        if images.resolve().parent != folder.resolve():
            raise InputError(f"'{observation.name}' cannot be the name of a folder; give [[pixels]] another name.")
        images.mkdir(parents=True, exist_ok=True)
        seeds = np.random.SeedSequence((recording.seed or 0, number)).generate_state(len(names)).tolist()
        for pose in progress(range(len(names)), f"Rendering images of {observation.camera}"):
            with write_atomically(images / names[pose]) as path:
                path.write_bytes(_rendered(observation, pose, targets[observation.board], optics, seeds[pose]))
        write_text(folder / entry["file"][0], csv_text(_readings(recording, observation, names)))
        tables.append(("pixels", entry))
    write_text(folder / MANIFEST, manifest_text(_WHAT, arm, (), tables))
    capture = recording.capture
    others = [_without_views(each) if isinstance(each, Pixels) else each for each in capture.observations]
    return recording._replace(capture=Capture(capture.sockets, capture.lengths, others))


def _rendered(observation: Pixels, pose: int, target: Any, optics: Any, seed: int) -> bytes:
    """The image of one pose as the content of a JPEG file."""
    from ..camera.detection import jpeg
    from ..camera.rendering import render

    size, views = observation.image_size, observation.views
    assert size is not None
    assert views is not None
    with naming(f"[[pixels]] '{observation.name}'"):
        image = render(
            target, frame_of(np.asarray(views)[pose]), observation.model, np.asarray(observation.intrinsics),
            (int(size[0]), int(size[1])), optics=optics, seed=seed,
        )  # fmt: skip
    return jpeg(image, _QUALITY)


def _readings(recording: Recording, observation: Pixels, names: Sequence[str]) -> list[list[Any]]:
    """A table with the name of an image and the readings of its pose in each row."""
    arm, q = recording.nominal.arm, np.asarray(observation.q)
    head = [f"q_{i}_{unit}" for i, unit in enumerate(by_joint(arm, "deg", "mm"), start=1)]
    for name in arm.beside.names(q.shape[1]):
        head += [BESIDE[name].format(i) for i in range(1, 1 + arm.beside.width([name]) - arm.joints)]
    scale = np.ones(q.shape[1])
    scale[: arm.joints] = by_joint(arm, DEG, 1.0)
    rows = [[name, *(f"{x:.6f}" for x in row)] for name, row in zip(names, (q / scale).tolist(), strict=True)]
    return [["image", *head], *rows]


def _without_views(observation: Pixels) -> AbstractObservation:
    """The same with the views that its corners show, as where it was measured."""
    stored = {name: value for name, value in observation.stored().items() if name != "views"}
    return Pixels.rebuilt(observation.name, stored)
