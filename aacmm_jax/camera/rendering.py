"""Images of targets as a camera sees them: perspective, distortion, blur, noise, uneven light.

Each pixel is sampled several times. The direction that a sample looks in is found by the inverse of the camera model,
and where the direction meets the plane of the print, the print says whether the sample is black or white.
"""

from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from ..core.arguments import Count, NotNegative, Range, checked_arguments
from ..core.errors import InputError
from ..data.cameras.camera import AbstractCamera, camera_models
from ..data.targets import AbstractTarget
from .drawing import Patch, patches_of

_SAMPLES = 3  # in a row and in a column of each pixel
_SPACING = 8  # px between nodes of the spline of directions: its error is below a thousandth of a pixel
_MOST_PIXELS = 50_000_000
_LATERAL = 24.0  # px: the scale of blotches of the background
_Box = tuple[int, int, int, int]  # first column and row, and those after the last


class Optics(NamedTuple):
    """How an image is taken.

    Args:
        blur: Standard deviation of the blur of the lens, px.
        motion: Standard deviation of an additional blur along the rows, px, of a camera that moves.
        noise: Standard deviation of the noise of each pixel, grey levels of 255.
        shading: Largest share of light that is missing, at one side of the image.
        black: Grey level of what is printed black.
        white: Grey level of the paper.

    Example:
        >>> aj.camera.Optics(blur=1.5).noise
        2.0
    """

    blur: NotNegative = 0.8
    motion: NotNegative = 0.0
    noise: NotNegative = 2.0
    shading: Annotated[float, Range(least=0, below=1)] = 0.2
    black: Annotated[float, Range(least=0, most=255)] = 30.0
    white: Annotated[float, Range(least=0, most=255)] = 215.0


@checked_arguments
def render(
    targets: AbstractTarget | tuple[AbstractTarget, ...],
    transforms: Float[np.ndarray, "*targets 4 4"],
    model: str,
    intrinsics: Float[np.ndarray, " k"],
    size: tuple[Count, ...],
    *,
    optics: Optics | None = None,
    seed: int = 0,
) -> UInt8[np.ndarray, "h w"]:
    """The image of a target, or of several of which the later ones may hide the earlier ones.

    Args:
        targets: One target, or several.
        transforms: The frame of each target in that of the camera ``(4, 4)``, lengths in mm.
        model: Name of the camera model: ``pinhole`` or ``fisheye``.
        intrinsics: Those of the model: focal lengths and centre in px, distortion coefficients (unit 1).
        size: Width and height of the image, px.
        optics: Blur, noise and light.
        seed: Seed of noise, background and direction of light.

    Returns:
        Grey levels ``(height, width)``.

    Raises:
        InputError: An unknown camera model, a wrong number of intrinsics, or a target without a print.

    Example:
        >>> board, facing = aj.camera.Checkerboard(8, 5, 30.0), np.eye(4)
        >>> facing[:3, 3] = -90.0, -45.0, 500.0  # half a metre in front of the camera
        >>> image = aj.camera.render(board, facing, "pinhole", [600.0, 600.0, 319.5, 239.5], (640, 480))
        >>> image.shape
        (480, 640)
    """
    optics = Optics() if optics is None else optics
    camera = camera_models().get(model)
    if camera is None or camera.unit != "px":
        raise InputError(f"the camera model '{model}' makes no images; give 'pinhole' or 'fisheye'.")
    camera.check_count(len(intrinsics), f"the camera '{model}'")
    width, height = size
    if width * height > _MOST_PIXELS:
        raise InputError(
            f"an image of {width} x {height} px has more than the {_MOST_PIXELS:,} px that are rendered; give a "
            "smaller image_size."
        )
    random = np.random.default_rng(seed)
    grey = (optics.black + optics.white) / 2
    light = gaussian_filter(random.standard_normal((height, width)), _LATERAL)
    image = np.clip(grey + 0.2 * (optics.white - optics.black) * light / light.std(), optics.black, optics.white)
    several = targets if isinstance(targets, tuple) else (targets,)
    for target, transform in zip(several, transforms.reshape(-1, 4, 4), strict=True):
        patches = [(patch, _placed(patch, target, transform)) for patch in patches_of(target)]
        for patch, frame in sorted(patches, key=lambda item: -np.linalg.norm(item[1][:, 2])):
            # A print is seen from its front only: there its axes x and y are right-handed with the line of sight.
            if np.cross(frame[:, 0], frame[:, 1]) @ frame[:, 2] > 0:
                box = _box(patch, frame, camera, intrinsics, size)
                if box[0] < box[2] and box[1] < box[3]:
                    _paint(image, box, patch, frame, (camera, intrinsics), optics)
    angle = random.uniform(0, 2 * np.pi)
    x, y = np.linspace(-0.5, 0.5, width), np.linspace(-0.5, 0.5, height)[:, None]
    image *= 1 - optics.shading * (0.5 + (np.cos(angle) * x + np.sin(angle) * y) / np.sqrt(2))
    return np.clip(np.rint(image + optics.noise * random.standard_normal(image.shape)), 0, 255).astype(np.uint8)


def _placed(patch: Patch, target: AbstractTarget, transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3 3"]:
    """The axes x and y of a patch, and its origin, in the camera's frame; for coordinates in nominal mm."""
    frame = target.scale * transform[:3, :3] @ patch.frame
    return frame + transform[:3, 3:] * np.array([0.0, 0.0, 1.0])


def _box(
    patch: Patch, frame: Float[np.ndarray, "3 3"], camera: AbstractCamera, intrinsics: Float[np.ndarray, " k"],
    size: tuple[int, ...],
) -> _Box:  # fmt: skip
    """The part of the image in which a patch may appear."""
    (left, upper, right, lower), ends = patch.paper, np.linspace(0, 1, 20)
    x, y = (array.ravel() for array in np.meshgrid(left + (right - left) * ends, upper + (lower - upper) * ends))
    points = frame @ np.stack([x, y, np.ones_like(x)])
    if np.any(camera.folded(points, intrinsics)):
        return 0, 0, size[0], size[1]
    values = np.asarray(camera.project(points, intrinsics.reshape(-1, 1)).values)
    first = np.clip(np.floor(values.min(axis=1)) - 2 * _SPACING, 0, size)
    last = np.clip(np.ceil(values.max(axis=1)) + 2 * _SPACING, 0, size)
    return int(first[0]), int(first[1]), int(last[0]), int(last[1])


def _paint(
    image: Float[np.ndarray, "h w"], box: _Box, patch: Patch, frame: Float[np.ndarray, "3 3"],
    camera: tuple[AbstractCamera, Float[np.ndarray, " k"]], optics: Optics,
) -> None:  # fmt: skip
    """Draw a patch into a part of the image, which is blurred."""
    left, upper, right, lower = box
    fine = [(np.arange((end - first) * _SAMPLES) + 0.5) / _SAMPLES - 0.5 + first for first, end in
            ((left, right), (upper, lower))]  # fmt: skip
    direction = _directions(fine[0], fine[1], *camera)
    # A direction d meets the plane at coordinates a, b where d is parallel to frame (a, b, 1).
    a, b, c = np.tensordot(np.linalg.inv(frame), direction, axes=1)
    ahead = c > 0
    safe = np.where(ahead, c, 1.0)
    colour = _print(patch, a / safe, b / safe)
    drawn = np.where(colour, optics.black, optics.white)
    behind = image[upper:lower, left:right]
    x0, y0, x1, y1 = patch.paper
    on_paper = ahead & (a > x0 * safe) & (a < x1 * safe) & (b > y0 * safe) & (b < y1 * safe)
    whole = np.where(on_paper, drawn, behind.repeat(_SAMPLES, axis=0).repeat(_SAMPLES, axis=1))
    whole = gaussian_filter(whole, optics.blur * _SAMPLES, mode="nearest")
    if optics.motion:
        whole = gaussian_filter1d(whole, optics.motion * _SAMPLES, axis=1, mode="nearest")
    image[upper:lower, left:right] = whole.reshape(lower - upper, _SAMPLES, right - left, _SAMPLES).mean(axis=(1, 3))


def _directions(
    columns: Float[np.ndarray, " w"], rows: Float[np.ndarray, " h"], camera: AbstractCamera,
    intrinsics: Float[np.ndarray, " k"],
) -> Float[np.ndarray, "3 h w"]:  # fmt: skip
    """The directions of samples, by splines between those of nodes."""
    nodes = [
        np.linspace(values[0], values[-1], max(int(np.ptp(values) / _SPACING) + 2, 4)) for values in (columns, rows)
    ]
    at_nodes = camera.directions(np.stack(np.meshgrid(*nodes)), intrinsics)
    return np.stack([RectBivariateSpline(nodes[1], nodes[0], part)(rows, columns) for part in at_nodes])


def _print(patch: Patch, x: Float[np.ndarray, "h w"], y: Float[np.ndarray, "h w"]) -> np.ndarray:
    """Whether points of a patch are black: between the edges of its rectangles, cells have one colour."""
    edges = [np.unique(patch.black[:, axes].round(9)) for axes in ([0, 2], [1, 3])]
    cells = np.zeros((len(edges[1]) + 1, len(edges[0]) + 1), dtype=bool)
    spans = [np.searchsorted(edges[axis % 2], patch.black[:, axis].round(9)) + 1 for axis in range(4)]
    for left, upper, right, lower in zip(*spans, strict=True):
        cells[upper:lower, left:right] = True
    return cells[np.searchsorted(edges[1], y), np.searchsorted(edges[0], x)]
