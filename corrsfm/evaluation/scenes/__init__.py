"""Whole reconstructions against known cameras, and against each other."""
