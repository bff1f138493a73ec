"""Listening to what one thread warns of; another may work in another workspace, or at another block."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator
from typing import TypeVar

__all__ = ["PASSING", "ThreadWarnings", "listening"]

logger = logging.getLogger("corrsfm")

PASSING = {"is_passing": True}
"""The ``extra`` of a warning that says nothing about what comes out, such as of a wait."""


class ThreadWarnings(logging.Handler):
    """Hands what the thread that made it logs, as a warning or worse, to `hear`."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self._thread and not getattr(record, "is_passing", False):
            self.hear(record)

    def hear(self, record: logging.LogRecord) -> None:
        """Take a warning of this thread."""
        raise NotImplementedError


H = TypeVar("H", bound=ThreadWarnings)


@contextlib.contextmanager
def listening(handler: H) -> Iterator[H]:
    """Listen during the block, without changing where warnings are logged."""
    logger.addHandler(handler)
    try:
        yield handler
    finally:
        logger.removeHandler(handler)
