"""Figures of cameras: where corners were seen in the image, how far from where the calibration has them, the lens's
distortion, and cameras and targets in space."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..calibration.record import CalibrationRecord
from ..calibration.reprojection import Reprojection, reprojection
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray
from ..core.text import pluralise
from ..data.cameras.camera import AbstractCamera
from ..data.observations.pixels import Pixels
from ..kinematics.arm import Arm
from ..summaries.tables import Table, by_columns, format_number, numbers
from .arm import arm_poses
from .charts import SHADES, Axis, Chart, Marks, Plot, round_ticks, shades, thinned
from .figures import TONES, draw

_CELLS = 16  # of the longer side of an image
_LONG = 0.06  # of an image's width: the length of the longer arrows
_HEAD = 0.25  # of an arrow's length: its head
_LONGEST_HEAD = 0.012  # of an image's width
_SAME = 0.01  # px: a direction that the model does not lead back to its pixel has none
_VIEW = 0.3  # of the distance to the target: the length of the lines of sight
_FLAT = 1e-6  # mm
_PICTURES = 6  # of images
_FAR = 5.0  # medians of the residuals: farther ones are drawn in another tone


class Image(NamedTuple):
    """All that one camera saw in a calibration: c corners of all its images."""

    number: int  # of the camera, from 1
    camera: str
    model: AbstractCamera
    intrinsics: Float[np.ndarray, " k"]
    low: Float[np.ndarray, " 2"]  # edges of the image, px (mm of a camera that measures points)
    high: Float[np.ndarray, " 2"]
    corners: Float[np.ndarray, "c 2"]
    residuals: Float[np.ndarray, "c 2"]  # measured less calibrated
    ids: Int[np.ndarray, " c"]
    owner: Int[np.ndarray, " c"]  # of which image each corner is
    names: list[str]  # of the images
    pictures: list[str]  # of these: JPEG, in base64; empty where there is none
    refused: list[tuple[str, str]]  # pictures of images that are not used, and names with reasons

    @property
    def size(self) -> Float[np.ndarray, " 2"]:
        """Width and height."""
        return self.high - self.low


def images_of(record: CalibrationRecord) -> list[Image]:
    """What each camera of a calibration saw; without cameras nothing."""
    arm, geometry = record.calibrated.arm, record.observed.geometry
    observations = [each for each in record.recording.capture.observations if isinstance(each, Pixels)]
    kept = {(read.observation, read.image): read for read in record.recording.images if read.preview}
    images = []
    for number, name in enumerate(dict.fromkeys(each.camera for each in observations), start=1):
        own = [each for each in observations if each.camera == name]
        seen = [reprojection(arm, each, geometry) for each in own]
        keys = [(each.name, image) for each in own for image in each.images or [""] * len(each.q)]
        pictures = [str(kept[key].preview) if key in kept else "" for key in keys]
        names = {each.name for each in own}
        refused = [
            (str(read.preview), f"{read.image}: {read.refused}")
            for read in kept.values()
            if read.refused and read.observation in names
        ]
        images.append(_image(own, seen, number)._replace(pictures=pictures, refused=refused))
    return images


def _image(observations: list[Pixels], seen: list[Reprojection], number: int = 1) -> Image:
    first, intrinsics = observations[0], seen[0].intrinsics
    corners, residuals = (
        np.concatenate([getattr(each, field)[each.seen][:, :2] for each in seen]) for field in ("measured", "residual")
    )
    if first.camera_model.unit != "px":
        low, high = corners.min(axis=0), corners.max(axis=0)
    else:
        size = first.image_size
        size = np.maximum(2 * intrinsics[2:4], corners.max(axis=0)) + 1 if size is None else np.asarray(size)
        low, high = np.full(2, -0.5), size - 0.5
    names, ids, owner = list[str](), [], []
    for observation, each in zip(observations, seen, strict=True):
        ids.append(np.asarray(observation.ids)[each.seen])
        owner.append(len(names) + np.nonzero(each.seen)[0])
        names += observation.images or [f"{observation.name}, pose {i + 1}" for i in range(len(observation.q))]
    return Image(
        number=number, camera=first.camera, model=first.camera_model, intrinsics=intrinsics, low=low, high=high,
        corners=corners, residuals=residuals, ids=np.concatenate(ids), owner=np.concatenate(owner), names=names,
        pictures=[""] * len(names), refused=[],
    )  # fmt: skip


def _plot(image: Image, marks: tuple[Marks, ...], title: str = "", margin: float = 0.0) -> Plot:
    """Marks on the image plane: x to the right, y downwards, and the edges of the image with a margin, px."""
    (left, top), (right, bottom) = image.low, image.high
    border = Marks("", [left, right, right, left, left], [top, top, bottom, bottom, top], "line", "soft", size=4)
    axes = [
        Axis(f"{name} [{image.model.unit}]", *ends, round_ticks(min(ends), max(ends)))
        for name, ends in (
            ("x", (float(left) - margin, float(right) + margin)),
            ("y", (float(bottom) + margin, float(top) - margin)),
        )
    ]
    return Plot(axes[0], axes[1], (border, *marks), title=title, image=True)


def _cells(image: Image) -> tuple[np.ndarray, np.ndarray, float]:
    """Edges of square cells that cover an image, and their size."""
    cell = float(image.size.max()) / _CELLS
    numbers = np.maximum(np.round(image.size / cell), 1).astype(int)
    x, y = (np.linspace(image.low[i], image.high[i], numbers[i] + 1) for i in range(2))
    return x, y, cell


def coverage_chart(image: Image) -> Chart:
    """How many corners were seen in each part of the image."""
    x, y, _ = _cells(image)
    counts = np.histogram2d(image.corners[:, 0], image.corners[:, 1], (x, y))[0].astype(int)
    columns, rows = np.nonzero(counts)
    number, cells = counts[columns, rows], counts.size
    limits = np.unique(np.round(np.linspace(1, number.max() + 1, SHADES + 1)))  # a shade has less than its upper limit
    middle = [(edges[1:] + edges[:-1]) / 2 for edges in (x, y)]
    marks = Marks(
        "corners", middle[0][columns], middle[1][rows], "boxes", box=(x[1] - x[0], y[1] - y[0]), unit="corners",
        words=[pluralise(count, "corner") for count in number.tolist()],
        shade=np.digitize(number, limits[1:-1]), limits=tuple(limits.tolist()),
    )  # fmt: skip
    description = (
        f"{pluralise(len(image.corners), 'corner')} in {pluralise(len(image.names), 'image')}, in {len(number)} of "
        f"{cells} cells of the image ({100 * len(number) / cells:.0f} %). Where no corner was seen, the distortion is "
        "an extrapolation."
    )
    title = f"Where {image.camera} saw corners"
    return Chart(f"coverage-{image.number}", title, description, (_plot(image, (marks,)),))


def residual_chart(image: Image, most: int | None = None) -> Chart:
    """Residuals of corners as arrows on the image plane."""
    sizes = np.linalg.norm(image.residuals, axis=1)
    chosen = thinned(len(sizes), most or len(sizes))
    factor = _magnification(sizes, _LONG * float(image.size[0]))
    usual = float(np.median(sizes))
    starts, unit = image.corners - image.residuals, image.model.unit
    far = sizes[chosen] > _FAR * usual
    marks = [
        _arrows(image, name, starts[part], factor * image.residuals[part], tone)
        for name, part, tone in (
            ("residuals", chosen[~far], "main"),
            (f"more than {_FAR:g} times the median", chosen[far], "accent"),
        )
        if len(part)
    ]
    labels = [f"{image.names[i]}, corner {number}" for i, number in zip(image.owner, image.ids, strict=True)]
    words = [f"{labels[i]}: {format_number(float(sizes[i]))} {unit}" for i in chosen]
    marks.append(Marks("", starts[chosen, 0], starts[chosen, 1], "dot", "soft", words, size=2.5))
    description = (
        f"Arrows lead from where the calibration has each corner towards where it was seen, {factor:g} times as long. "
        f"Root mean square {np.sqrt(np.mean(sizes**2)):.3g} {unit}, median {usual:.3g} {unit}, largest "
        f"{sizes.max():.3g} {unit}. Noise has random directions; neighbours with the same direction show an error of "
        "the model."
    )
    description += f" {len(chosen)} of {len(sizes)} corners are drawn." if len(chosen) < len(sizes) else ""
    title = f"Residuals in the image of {image.camera}"
    plot = _plot(image, tuple(marks), f"arrows: {factor:g} times the residuals")
    return Chart(f"arrows-{image.number}", title, description, (plot,), _by_image(image, sizes))


def _by_image(image: Image, sizes: Float[np.ndarray, " c"]) -> Table:
    """The residuals of each image."""
    number = np.bincount(image.owner, minlength=len(image.names))
    largest = np.zeros(len(number))
    np.maximum.at(largest, image.owner, sizes)
    columns = {
        "image": image.names,
        "corners": number.tolist(),
        f"RMS [{image.model.unit}]": numbers(np.sqrt(np.bincount(image.owner, sizes**2, len(number)) / number), 3),
        f"largest [{image.model.unit}]": numbers(largest, 3),
    }
    return by_columns(f"Residuals by image of {image.camera}", columns)


def picture_charts(image: Image) -> list[Chart]:
    """Some of the images with the residuals of their corners, from the largest ones to the smallest, and images that
    are not used; nothing where no pictures were kept."""
    sizes, count, charts = np.linalg.norm(image.residuals, axis=1), len(image.names), list[Chart]()
    rms = np.sqrt(np.bincount(image.owner, sizes**2, count) / np.bincount(image.owner, minlength=count))
    factor, starts = _magnification(sizes, _LONG * float(image.size[0])), image.corners - image.residuals
    kept = [i for i in np.argsort(-rms).tolist() if image.pictures[i]]
    plots = []
    for i in (kept[place] for place in thinned(len(kept), _PICTURES)):
        own = image.owner == i
        arrows = _arrows(image, "", starts[own], factor * image.residuals[own], "bright")
        (x, y), words = starts[own].T, [f"corner {number}" for number in image.ids[own]]
        marks = Marks("", x, y, "dot", "bright", words, size=4), arrows
        plots.append(_picture(image, image.pictures[i], f"{image.names[i]}: {rms[i]:.3g} px RMS", marks))
    description = (
        f"{len(plots)} of {count} images, from the largest residuals to the smallest. Arrows lead from where the "
        f"calibration has each corner towards where it was seen, {factor:g} times as long."
    )
    if plots:
        charts.append(Chart(f"pictures-{image.number}", f"Images of {image.camera}", description, tuple(plots)))
    if image.refused:
        refused = [_picture(image, *item) for item in image.refused[:_PICTURES]]
        title = f"Images of {image.camera} that are not used"
        description = f"{len(refused)} of {pluralise(len(image.refused), 'image')}, with the reason."
        charts.append(Chart(f"refused-{image.number}", title, description, tuple(refused)))
    return charts


def _picture(image: Image, picture: str, title: str, marks: tuple[Marks, ...] = ()) -> Plot:
    """Marks on a picture, without numbers at its edges."""
    (left, top), (right, bottom) = image.low.tolist(), image.high.tolist()
    return Plot(Axis("", left, right), Axis("", bottom, top), marks, title, image=True, picture=picture)


def distortion_chart(image: Image) -> Chart | None:
    """How far the lens displaces what an ideal one would show there; None of a camera without distortion."""
    if image.model.unit != "px" or not np.any(image.intrinsics[4:]):
        return None
    x, y, cell = _cells(image)
    nodes = np.stack([part.ravel() for part in np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2)])
    ideal = np.concatenate([image.intrinsics[:4], np.zeros(len(image.intrinsics) - 4)])
    with np.errstate(all="ignore"):
        sight = image.model.directions(nodes, image.intrinsics)
        again = image.model.project(sight, image.intrinsics[:, None]).values
        shift = nodes - image.model.project(sight, ideal[:, None]).values
    known = np.linalg.norm(again - nodes, axis=0) < _SAME
    if not known.any():
        return None
    nodes, shift = nodes.T[known], shift.T[known]
    sizes = np.linalg.norm(shift, axis=1)
    factor = _magnification(sizes, 1.2 * cell)
    shade, limits = shades(sizes)
    words = [f"at ({a:.0f}, {b:.0f}) px: {size:.3g} px" for (a, b), size in zip(nodes, sizes.tolist(), strict=True)]
    marks = (
        _arrows(image, "", nodes, factor * shift, "ink"),
        Marks("displacement", *nodes.T, words=words, size=5, shade=shade, limits=limits, unit="px"),
    )
    far = int(np.argmax(sizes))
    description = (
        f"Displacement from the image of the same lens without distortion, as arrows. It is largest at "
        f"({nodes[far][0]:.0f}, {nodes[far][1]:.0f}) px: {sizes[far]:.3g} px."
    )
    unknown = int(np.sum(~known))
    description += f" In {pluralise(unknown, 'cell')} the distortion folds back." if unknown else ""
    title = f"Distortion of {image.camera}"
    plot = _plot(image, marks, f"arrows: {factor:g} times the displacement", cell)  # arrows at the edges lead outwards
    return Chart(f"distortion-{image.number}", title, description, (plot,))


def _magnification(sizes: np.ndarray, length: float) -> float:
    """A round factor that makes the longer ones of these sizes about as long as ``length``."""
    long = float(np.quantile(sizes, 0.98))
    if long <= 0:
        return 1.0
    raw = length / long
    power = 10.0 ** np.floor(np.log10(raw))
    return float(f"{next(step for step in (5, 2, 1) if step * power <= raw * (1 + 1e-9)) * power:.6g}")


def _arrows(image: Image, name: str, starts: np.ndarray, steps: np.ndarray, tone: str) -> Marks:
    """Arrows as one interrupted line."""
    ends, sizes = starts + steps, np.linalg.norm(steps, axis=1, keepdims=True)
    head = np.minimum(1.0, _LONGEST_HEAD * image.size[0] / (_HEAD * np.maximum(sizes, 1e-12)))
    back, aside = -_HEAD * head * steps, 0.5 * _HEAD * head * steps[:, ::-1] * [-1, 1]
    nothing = np.full_like(starts, np.nan)
    path = np.stack([starts, ends, nothing, ends + back + aside, ends, ends + back - aside, nothing], axis=1)
    x, y = path.reshape(-1, 2).T
    return Marks(name, x, y, "line", tone, size=3)


def shapes_of(
    arm: Arm, observation: Pixels, geometry: Mapping[str, Float[AnyArray, " k"]]
) -> tuple[Float[np.ndarray, "m p 3"], Float[np.ndarray, "r 3"]]:
    """What is on the arm, pose by pose, and what stands still, as lines in the base frame, mm: the pyramid of a
    camera's field of view, and the outline of a target."""
    seen = reprojection(arm, observation, geometry)
    length = _VIEW * float(np.median(seen.distance[seen.seen]))
    view, outline = length * _field_of_view(_image([observation], [seen])), _outline(observation)
    lines = [
        shape @ frames[:, :3, :3].swapaxes(1, 2) + frames[:, None, :3, 3]
        for shape, frames in ((view, seen.camera), (outline, seen.board))
    ]
    moving, still = lines if observation.on_arm else lines[::-1]
    return moving, still[0]


def _field_of_view(image: Image) -> Float[np.ndarray, "12 3"]:
    """From the centre of projection towards the corners of the image, with their connections."""
    (left, top), (right, bottom) = image.low, image.high
    if image.model.unit == "px":
        ends = image.model.directions(
            np.array([[left, right, right, left], [top, top, bottom, bottom]]), image.intrinsics
        )
    else:
        ends = np.array([[-0.5, 0.5, 0.5, -0.5], [-0.4, -0.4, 0.4, 0.4], [1.0] * 4])
    corners, centre = np.append(ends, ends[:, :1], axis=1).T, np.zeros(3)
    return np.array([part for i in range(4) for part in (centre, corners[i], corners[i + 1])])


def _outline(observation: Pixels) -> Float[np.ndarray, "r 3"]:
    """A box around the points of a target, flat if they are in a plane of its axes."""
    points = np.asarray(observation.points)[np.asarray(observation.seen)]
    low, high = points.min(axis=0), points.max(axis=0)
    below, above = ([(*at, level) for at in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))] for level in (0, 1))
    upright = [(1, 0, 1), (1, 0, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1), (0, 1, 0)]
    chosen = np.array(below if high[2] - low[2] < _FLAT else [*below, *above, *upright])
    return low + chosen * (high - low)


def camera_coverage(record: CalibrationRecord, camera: str | None = None, axes: Any = None) -> Any:
    """Plot how many corners a camera of a calibration saw in each part of its image.

    Args:
        record: The calibration.
        camera: Name of the camera; the first one if None. `InputError` if the calibration has none of this name.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.camera_coverage(seen).figure.savefig("figure.svg")
    """
    return draw(coverage_chart(_chosen(record, camera)).plots[0], axes)


def camera_residuals(record: CalibrationRecord, camera: str | None = None, axes: Any = None) -> Any:
    """Plot the residuals of all corners as arrows on the image plane of a camera; the title has the magnification.

    Args:
        record: The calibration.
        camera: Name of the camera; the first one if None. `InputError` if the calibration has none of this name.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.camera_residuals(seen).figure.savefig("figure.svg")
    """
    return draw(residual_chart(_chosen(record, camera)).plots[0], axes)


def camera_distortion(record: CalibrationRecord, camera: str | None = None, axes: Any = None) -> Any:
    """Plot how far the lens of a camera displaces what it would show without distortion; the title has the
    magnification of the arrows.

    Args:
        record: The calibration.
        camera: Name of the camera; the first one if None. `InputError` if the calibration has none of this name, or if
            it has no distortion.
        axes: Axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.camera_distortion(seen).figure.savefig("figure.svg")
    """
    image = _chosen(record, camera)
    chart = distortion_chart(image)
    if chart is None:
        raise InputError(f"'{image.camera}' has no distortion to draw; free its coefficients, or state them.")
    return draw(chart.plots[0], axes)


def camera_poses(record: CalibrationRecord, axes: Any = None) -> Any:
    """Plot the arm with its cameras and targets in space, mm; the first pose of each camera is dark.

    Args:
        record: The calibration, with at least one camera.
        axes: Three-dimensional axes to plot into, which are returned; new ones if None.

    Example:
        >>> aj.plot.camera_poses(seen).figure.savefig("figure.svg")
    """
    _chosen(record, None)
    arm, geometry = record.calibrated.arm, record.observed.geometry
    for observation in record.recording.capture.observations:
        if not isinstance(observation, Pixels):
            continue
        axes = arm_poses(arm, np.asarray(observation.q)[:1], axes)
        moving, still = shapes_of(arm, observation, geometry)
        for i, line in reversed(list(enumerate(moving))):
            axes.plot(*line.T, color=TONES["soft"] if i else TONES["main"], linewidth=1.5 if not i else 0.6)
        axes.plot(*still.T, color=TONES["accent"], linewidth=2)
    ranges = [np.ptp(ends) for ends in (axes.get_xlim(), axes.get_ylim(), axes.get_zlim())]
    axes.set_box_aspect(ranges, zoom=0.85)  # as equal axes, with room for their labels
    return axes


def _chosen(record: CalibrationRecord, camera: str | None) -> Image:
    images = {image.camera: image for image in images_of(record)}
    if not images:
        raise InputError("the calibration has no camera; calibrate with observations of the kind pixels.")
    if camera is not None and camera not in images:
        raise InputError(f"the calibration has no camera '{camera}'; its cameras are {', '.join(images)}.")
    return images[next(iter(images)) if camera is None else camera]
