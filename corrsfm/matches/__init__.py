"""Putative matches: nearest neighbours of descriptors."""
