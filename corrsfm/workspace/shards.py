"""Items that workers of a cluster make: each block in a file of its own, a shard; one process merges them.

A worker writes a shard under a hidden name and renames it when it is whole, so that a shard can be merged
whatever became of the worker, of the run that wanted it, or of another worker that did the same block.
Workers see the files of the workspace by the same absolute paths.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import logging
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from corrsfm import config as cfg
from corrsfm.cluster import Cluster
from corrsfm.errors import ClusterError, CorrsfmError, DamageError
from corrsfm.graph import neighbours_together
from corrsfm.machine import count_threads
from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.heard import ThreadWarnings, listening
from corrsfm.workspace.items import FEATURES, MATCHES, PRUNED
from corrsfm.workspace.store import ItemStore

__all__ = ["Work", "make_items", "merge_shards"]

logger = logging.getLogger("corrsfm")

KINDS: dict[str, Any] = {kind.label: kind for kind in (FEATURES, MATCHES, PRUNED)}
# A worker that is lost costs at most a block, a minute or so; fewer items are too few for the overhead.
MAX_PHOTOS = 16
MAX_PAIRS = 128
BLOCKS_A_SLOT = 4

K = TypeVar("K")
T = TypeVar("T")
I = TypeVar("I")  # noqa: E741

Work = Callable[[Workspace, Iterable[I], cfg.RunConfig], Iterable[tuple[K, T | CorrsfmError]]]
"""Makes items from what each is made from; an error in the place of an item costs that item only."""


def make_items(
    cluster: Cluster | None,
    workspace: Workspace,
    store: ItemStore[K, T],
    work: Work[I, K, T],
    keys: Sequence[K],
    source_of: Callable[[K], I],
    wanted: Mapping[K, str],
    run: cfg.RunConfig,
) -> Iterator[tuple[K, T | CorrsfmError | None]]:
    """Make items in this process, or on the workers of a cluster.

    Parameters
    ----------
    cluster : Cluster or None
    workspace : Workspace
    store : ItemStore
        Takes in the shards.
    work : callable
        For a cluster it must be importable by the workers, or a `functools.partial` of such a function.
    keys : sequence
        Of the items to make.
    source_of : callable
        Key → what the item is made from.
    wanted : mapping
        Key → fingerprint.
    run : RunConfig

    Yields
    ------
    key, item
        None in the place of an item that is in the store already, an error where there is none.

    Raises
    ------
    ClusterError
        If a block fails on its worker, or the scheduler is lost.
    """
    if cluster is None:
        yield from work(workspace, map(source_of, keys), run)
        return
    folder = shards_of(workspace, store)
    folder.mkdir(parents=True, exist_ok=True)
    root = os.path.abspath(workspace.root)
    threads = run.threads or 1
    if not cluster.address:
        threads = max(1, count_threads(run.threads) // cluster.workers)
    there = dataclasses.replace(run, threads=threads, cluster=None, workers=0)
    num_slots = max(1, cluster.count_slots())
    tasks = (
        (
            block,
            (
                root, os.path.abspath(folder), store.path.suffix, store.kind.label, work,
                [source_of(key) for key in block], {key: wanted[key] for key in block}, there, num_slots,
            ),
        )
        for block in blocks(keys, num_slots)
    )  # fmt: skip
    heard: set[str] = set()
    with contextlib.closing(cluster.outcomes(fill_shard, tasks)) as outcomes:
        for block, shard in outcomes:
            if isinstance(shard, CorrsfmError):
                raise shard
            if isinstance(shard, Exception):
                raise ClusterError(
                    f"a worker failed ({type(shard).__name__}: {shard}); finished work is kept, run the same "
                    "command again"
                ) from shard
            for template, message in shard.warnings.items():
                # One process would have said it once, each worker says it of its block.
                if template not in heard:
                    heard.add(template)
                    logger.warning("%s", message)
            _merge(folder / shard.name, store)
            for key in block:
                yield key, shard.failures.get(key)


def blocks(keys: Sequence[K], num_slots: int) -> Iterator[list[K]]:
    """Keys in blocks for that many workers; pairs with those that share their photos."""
    of_pairs = bool(keys) and isinstance(keys[0], tuple)
    ordered: Sequence[Any] = neighbours_together(keys) if of_pairs else keys  # type: ignore[arg-type]
    limit = MAX_PAIRS if of_pairs else MAX_PHOTOS
    size = min(limit, max(1, len(keys) // (BLOCKS_A_SLOT * num_slots)))
    iterator = iter(ordered)
    while block := list(itertools.islice(iterator, size)):
        yield block


def shards_of(workspace: Workspace, store: ItemStore[Any, Any]) -> Path:
    """Folder of the shards of a store."""
    return workspace.shards / store.path.stem


def merge_shards(workspace: Workspace, store: ItemStore[Any, Any]) -> int:
    """Take in the shards that an earlier run left, and remove what workers did not finish; their number."""
    folder = shards_of(workspace, store)
    num = 0
    for path in sorted(folder.glob("[!.]*")):
        try:
            _merge_whole_items(path, store)
            num += 1
        except DamageError as error:
            logger.warning("%s; its items are made again", error)
    discard_shards(workspace, store)
    return num


def _merge_whole_items(path: Path, store: ItemStore[Any, Any]) -> None:
    """Take in a shard, of a damaged one what is whole."""
    try:
        _merge(path, store)
    except DamageError:
        with contextlib.closing(ItemStore(path, store.kind)) as shard:
            for loss in shard.mend():
                logger.warning("%s", loss)
        _merge(path, store)


def discard_shards(workspace: Workspace, store: ItemStore[Any, Any]) -> None:
    """Remove the shards of a store."""
    shutil.rmtree(shards_of(workspace, store), ignore_errors=True)
    with contextlib.suppress(OSError):
        workspace.shards.rmdir()


def _merge(path: Path, store: ItemStore[Any, Any]) -> None:
    store.absorb(path)
    path.unlink()


@dataclass(frozen=True, kw_only=True)
class Shard:
    """What a worker answers for a block.

    Attributes
    ----------
    name : str
        The file of its items.
    failures : dict
        Key → why there is no such item.
    warnings : dict
        Template of a warning → the first such warning.
    """

    name: str
    failures: dict[Any, CorrsfmError]
    warnings: dict[str, str]


def fill_shard(
    root: str,
    folder: str,
    suffix: str,
    label: str,
    work: Work[Any, Any, Any],
    sources: list[Any],
    wanted: dict[Any, str],
    run: cfg.RunConfig,
    num_slots: int,
) -> Shard:
    """On a worker, one of so many: make the items of a block and write them to a shard."""
    name = f"{uuid.uuid4().hex}{suffix}"
    partial = Path(folder) / f".{name}"
    store: ItemStore[Any, Any] = ItemStore(partial, KINDS[label])
    failures: dict[Any, CorrsfmError] = {}
    try:
        with listening(_Ear()) as ear, contextlib.closing(store):
            before = time.monotonic()
            for key, item in work(Workspace(Path(root)), sources, run):
                if not os.path.isdir(folder):
                    # The run was killed, and a later one did without this block.
                    raise ClusterError(f"{folder}: is gone, nobody waits for these items")
                if isinstance(item, CorrsfmError):
                    failures[key] = item
                else:
                    # An hour of two workers is half an hour of the stage.
                    store.add(key, wanted[key], item, (time.monotonic() - before) / num_slots)
                before = time.monotonic()
            store.commit({key: wanted[key] for key in wanted if key not in failures})
        os.replace(partial, Path(folder) / name)
    finally:
        for path in Path(folder).glob(f".{name}*"):
            path.unlink(missing_ok=True)
    return Shard(name=name, failures=failures, warnings=ear.first)


class _Ear(ThreadWarnings):
    """Keeps the first warning of each kind, by its template."""

    def __init__(self) -> None:
        super().__init__()
        self.first: dict[str, str] = {}

    def hear(self, record: logging.LogRecord) -> None:
        self.first.setdefault(str(record.msg), record.getMessage())
