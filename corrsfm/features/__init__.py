"""SIFT features of photos."""
