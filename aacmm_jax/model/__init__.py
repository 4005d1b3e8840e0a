"""Measurement and arm make residuals: weights, scale and repeatability."""
