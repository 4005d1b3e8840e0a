from .names import Charuco as Charuco
from .names import Checkerboard as Checkerboard
from .names import PointTable as PointTable
from .names import TagGrid as TagGrid
from .names import target_of as target_of
