"""Kinds of observations, one file each: what ties the tip down."""
