"""The COLMAP database: writing it and verifying its pairs."""
