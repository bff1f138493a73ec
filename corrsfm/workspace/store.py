"""Items of one kind in one SQLite file, each with the fingerprint of what it was made from and a checksum.

An item is safe from a kill as soon as it was added, and from a power cut two seconds later: while a stage
runs, SQLite's write-ahead log takes the items, and it is flushed to the disk from time to time. What is there
already is not written again, however many items a scene has. Between runs the file is a plain database
without a log, which may be copied and read on a read-only disk.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import sqlite3
import time
from collections.abc import Iterator, Mapping, Set
from pathlib import Path

from corrsfm.errors import DamageError, WorkspaceError, first_few
from corrsfm.files import atomic_path, sync_folder
from corrsfm.workspace.items import K, T
from corrsfm.workspace.mending import rebuild
from corrsfm.workspace.reader import ItemReader, shown_key
from corrsfm.workspace.rows import (
    WHOLE_ROWS,
    delete_item,
    insert_row,
    make_row,
    new_file,
    transaction,
)

__all__ = ["ItemStore"]

logger = logging.getLogger("corrsfm")

SYNC_SECONDS = 2.0


class ItemStore(ItemReader[K, T]):
    """Items of one kind, to be written and read; see `ItemReader` for the parameters.

    Reading is safe from several threads; one process at a time may write.
    """

    _synced = 0.0
    # As long as it is not known.
    _is_sealed = True

    def add(self, key: K, fingerprint: str, item: T, seconds: float = 0.0) -> None:
        """Write an item, and the seconds it took to make; no kill can take it when this returns.

        Raises
        ------
        WorkspaceError
            If the disk is full or the file cannot be written.
        """
        row = make_row(self.kind.key(key), fingerprint, *self.kind.encode(item), seconds)
        with self._changing() as connection:
            insert_row(connection, row)
        if time.monotonic() - self._synced >= SYNC_SECONDS:
            self._sync()

    def absorb(self, other: Path) -> int:
        """Copy every item of another store of this kind into this one, all or nothing; their number.

        Raises
        ------
        WorkspaceError
            If the other file is damaged or of another kind, or the disk is full.
        """
        source = ItemStore(other, self.kind, remedy=self._remedy, mend=self._mend)
        num = 0
        with source._reading(sealed=False) as reading, self._changing() as connection:
            for row in reading.execute(WHOLE_ROWS):
                source._checked(row)
                insert_row(connection, row)
                num += 1
        self._sync()
        return num

    def commit(self, wanted: Mapping[K, str], seal: str = "", *, known: Set[K] = frozenset()) -> None:
        """Finish the file: it then holds exactly the wanted items, on the disk.

        Only imported ones that are not wanted stay: nothing could make them again.

        Parameters
        ----------
        wanted : mapping
            Key → fingerprint.
        seal : str
            Kept in the file, to tell it from others.
        known : set
            Of them, those that `finished` has found: they are not looked up again.

        Raises
        ------
        WorkspaceError
            If an item is missing, or the disk is full; the items stay as they are then.
        """
        connection = self._writer()
        for key, fingerprint in self._look_up(connection, (key for key in wanted if key not in known)):
            if fingerprint != wanted[key]:
                raise WorkspaceError(
                    f"{self.path}: {shown_key(self.kind.key(key))} was never finished; run again"
                )
        with self._errors(), transaction(connection):
            (num,) = connection.execute("SELECT count(*) FROM items").fetchone()
            if num != len(wanted) and not self._about(connection).get("origin"):
                texts = {self.kind.key(key) for key in wanted}
                held = connection.execute("SELECT key FROM items").fetchall()
                for key in [key for (key,) in held if key not in texts]:
                    delete_item(connection, key)
            connection.execute("INSERT OR REPLACE INTO about VALUES ('seal', ?)", (seal,))
        with self._errors():
            self._give_back_space(connection)
        self.close()

    def _give_back_space(self, connection: sqlite3.Connection) -> None:
        """Shrink a file of which more than half is left from items that are gone."""
        (num_free,) = connection.execute("PRAGMA freelist_count").fetchone()
        (num_pages,) = connection.execute("PRAGMA page_count").fetchone()
        if num_free > num_pages / 2:
            # It needs room for a copy; without it the file stays as it is.
            with contextlib.suppress(sqlite3.OperationalError):
                connection.execute("VACUUM")

    def mend(self) -> list[str]:
        """Drop damaged items; of a damaged file the whole items are kept, and the old one beside it.

        Returns
        -------
        list of str
            What was lost, for people.
        """
        if not self.path.exists():
            return []
        try:
            damaged = self.find_damage()
        except DamageError as error:
            self._drop_connection()
            aside = self.path.with_name(f"{self.path.name}.damaged")
            with self._errors():
                num = rebuild(self.path, self.kind.label, aside)
            kept = f"{num} whole items are kept, and the old file as {aside.name}"
            return [f"{self.path}: damaged ({error.__cause__}); {kept}"]
        if not damaged:
            return []
        with self._changing() as connection:
            for key in damaged:
                delete_item(connection, key)
        return [
            f"{self.path}: damaged items are made again: {first_few([shown_key(key) for key in damaged])}"
        ]

    def renew(self) -> None:
        """Make sure that every item can be written again; a file that cannot take them is begun anew.

        Raises
        ------
        WorkspaceError
            If nothing can be written there.
        """
        if not self.path.exists():
            return
        try:
            with self._errors():
                (problem,) = self._writer().execute("PRAGMA integrity_check(1)").fetchone()
            if problem != "ok":
                raise self._damaged(problem)
        except DamageError:
            self.clear()

    def clear(self, origin: str = "") -> None:
        """Begin the file anew, whatever is there.

        Parameters
        ----------
        origin : str
            Kept in the file, see `origin`.

        Raises
        ------
        WorkspaceError
            If nothing can be written there.
        """
        self._drop_connection()
        with atomic_path(self.path) as new, self._errors(), new_file(new, self.kind.label) as connection:
            if origin:
                connection.execute("INSERT INTO about VALUES ('origin', ?)", (origin,))
        for suffix in ("-wal", "-shm", "-journal"):
            self._beside(suffix).unlink(missing_ok=True)

    def close(self) -> None:
        """Make everything safe on the disk and end writing; the items stay for the next run.

        Raises
        ------
        WorkspaceError
            If the disk is full.
        """
        if self._writing is None:
            return
        try:
            with self._errors():
                # Leaving the log's mode merges it into the file, and flushes that.
                self._writing.execute("PRAGMA synchronous = FULL")
                self._writing.execute("PRAGMA journal_mode = DELETE")
        finally:
            self._drop_connection()
        sync_folder(self.path.parent)

    @contextlib.contextmanager
    def _changing(self) -> Iterator[sqlite3.Connection]:
        """A transaction after which the file is no longer what `commit` finished."""
        connection = self._writer()
        with self._errors(), transaction(connection):
            if self._is_sealed:
                connection.execute("DELETE FROM about WHERE name = 'seal'")
            yield connection
        self._is_sealed = False

    def _drop_connection(self) -> None:
        if self._writing is not None:
            self._writing.close()
            self._writing = None
            self._is_sealed = True

    def _sync(self) -> None:
        with self._errors():
            self._writer().execute("PRAGMA wal_checkpoint(PASSIVE)")
        self._synced = time.monotonic()

    def _writer(self) -> sqlite3.Connection:
        if self._writing is None:
            if self.path.is_symlink():
                raise WorkspaceError(f"{self.path}: is a link; replace it by the file, nothing was written")
            self._prepare()
            with self._errors():
                connection = sqlite3.connect(self.path, isolation_level=None, check_same_thread=False)
            try:
                with self._errors():
                    # One process writes, so the log needs no shared memory, which network disks lack.
                    connection.execute("PRAGMA locking_mode = EXCLUSIVE")
                    connection.execute("PRAGMA journal_mode = WAL")
                    connection.execute("PRAGMA synchronous = NORMAL")
                    self._about(connection)
            except BaseException:
                connection.close()
                raise
            self._writing, self._synced = connection, time.monotonic()
        return self._writing

    def _merge_log(self) -> None:
        self._writer()
        self.close()

    def _prepare(self) -> None:
        """See to it that there is a file of this store's own."""
        if not self.path.exists():
            with atomic_path(self.path) as new, self._errors(), new_file(new, self.kind.label):
                pass
        # Other workspaces that read it by another name keep what they have.
        elif self.path.stat().st_nlink > 1:
            with atomic_path(self.path) as copy:
                shutil.copy2(self.path, copy)
