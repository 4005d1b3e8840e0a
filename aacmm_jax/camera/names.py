"""Names of `aj.camera` that are defined in `data`."""

from ..data.targets import Charuco, Checkerboard, PointTable, TagGrid, target_of

__all__ = ["Charuco", "Checkerboard", "PointTable", "TagGrid", "target_of"]
