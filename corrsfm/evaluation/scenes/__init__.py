"""Whole reconstructions against known cameras, and against each other."""

DEFAULT_NUM_SEEDS = 5
"""Mapping depends on its seed, so a median and a worst of so many stand for one model."""
