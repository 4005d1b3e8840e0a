"""Reports that a laboratory would hand on: one HTML file for a calibration, an evaluation or a study."""

from .page import write_report as write_report
