"""Verified pairs become models."""
