"""corrsfm: structure from motion with learned correspondence pruning."""

# pycolmap's wheel exports zlib symbols; unless the real zlib is loaded first, the first zlib compression
# after `import pycolmap` aborts the process.
import zlib  # noqa: F401

__version__ = "0.1.0"
