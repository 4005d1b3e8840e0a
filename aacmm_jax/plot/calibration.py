"""The figure of a calibration that the command line draws."""
