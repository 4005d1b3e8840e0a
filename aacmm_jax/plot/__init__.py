"""Figures for papers and reports (matplotlib)."""
