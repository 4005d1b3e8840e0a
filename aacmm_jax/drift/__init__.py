"""Calibrations of one arm compared over time."""
