"""Poses of an arm as lines in space."""
