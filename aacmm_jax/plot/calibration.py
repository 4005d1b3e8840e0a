"""The figure of a calibration that the command line draws."""

from pathlib import Path

from ..files import storage
from ..files.calibrations import CalibrationRecord
from .axes import distances, length_parameter_errors


def calibration_figure(record: CalibrationRecord, path: Path) -> None:
    """Distances from the centroid pose by pose and, where the truth is known, errors of the length parameters; as PNG."""
    from matplotlib.figure import Figure

    panels = 2 if record.recording.true is not None else 1
    figure = Figure(figsize=(5.5 * panels, 3.9), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)
    distances(record, axes[0, 0])
    if panels == 2:
        length_parameter_errors(record, axes[0, 1])
    with storage.whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)
