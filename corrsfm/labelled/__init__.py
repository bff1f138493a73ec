"""Pairs of photos with known truth, as training and evaluation read them."""
