"""Items of one kind in one SQLite file, each with the fingerprint of what it was made from and a checksum.

An item is safe from a kill as soon as it was added, and from a power cut two seconds later: while a stage
runs, SQLite's write-ahead log takes the items, and it is flushed to the disk from time to time. What is there
already is not written again, however many items a scene has. Between runs the file is a plain database
without a log, which may be copied and read on a read-only disk.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import os
import shutil
import sqlite3
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from pathlib import Path
from typing import Any, Generic

from corrsfm.disk import opening
from corrsfm.errors import DamageError, InputError, WorkspaceError, first_few
from corrsfm.files import atomic_path, sync_folder
from corrsfm.workspace.items import Arrays, Attributes, K, Kind, T
from corrsfm.workspace.mending import rebuild
from corrsfm.workspace.rows import (
    APPLICATION_ID,
    FORMAT_VERSION,
    WHOLE_ROWS,
    delete_item,
    insert_row,
    is_intact,
    make_row,
    new_file,
    transaction,
    unpack,
)

__all__ = ["ItemStore"]

logger = logging.getLogger("corrsfm")

SYNC_SECONDS = 2.0
KEYS_AT_ONCE = 500

_LOGS = ("-wal", "-journal")
_NOT_DAMAGE = {
    ("SQLITE_BUSY", "SQLITE_LOCKED"): (
        "in use by another program ({}); close it there and run again, finished work is kept"
    ),
    ("SQLITE_READONLY", "SQLITE_PERM", "SQLITE_CANTOPEN", "SQLITE_AUTH"): (
        "cannot be opened ({}); check the permissions of the file and its folder and run again"
    ),
    ("SQLITE_NOMEM",): "not enough memory ({}); close other programs and run again, finished work is kept",
    ("SQLITE_FULL", "SQLITE_IOERR"): (
        "the disk is full or failing, or the file larger than this shell allows ({}); free some space, see "
        "ulimit -f, and run again, finished work is kept"
    ),
}


class ItemStore(Generic[K, T]):
    """Items of one kind.

    Reading is safe from several threads; one process at a time may write.

    Parameters
    ----------
    path : Path
    kind : Kind
    remedy : str
        The command that makes the items, for messages.
    mend : str
        The command that makes damaged items again; the remedy with --verify if not given.
    seal : str, optional
        What `commit` was given when the file was finished; another file in its place is refused.
    merges : bool
        Whether reading may put what a killed process wrote last into the file; else it looks at a copy.
    """

    def __init__(
        self,
        path: Path,
        kind: Kind[K, T],
        *,
        remedy: str = "",
        mend: str = "",
        seal: str | None = None,
        merges: bool = True,
    ) -> None:
        self.path = path
        self.kind = kind
        self._remedy = remedy or "the step that makes it"
        self._mend = mend or f"{self._remedy} --verify"
        self._seal = seal
        self._merges = merges
        self._writing: sqlite3.Connection | None = None
        self._synced = 0.0
        # As long as it is not known.
        self._is_sealed = True

    # reading ------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def reader(self) -> Iterator[Callable[[K], T]]:
        """Open the file once and yield a function that reads an item by key.

        Raises
        ------
        WorkspaceError
            If the file is missing, unreadable or not the one that the stage wrote, or (from the function) if
            it holds no such item or a damaged one.
        """
        lock = threading.Lock()
        with self._reading() as connection:

            def read(key: K) -> T:
                text = self.kind.key(key)
                with lock, self._errors():
                    row = connection.execute(f"{WHOLE_ROWS} WHERE key = ?", (text,)).fetchone()
                if row is None:
                    raise self._lacks(text)
                return self._decoded(row)

            yield read

    def read(self, key: K) -> T:
        """Read one item; see `reader`."""
        with self.reader() as read:
            return read(key)

    def fingerprints(self, keys: Iterable[K]) -> dict[K, str]:
        """Fingerprints of items.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or holds no such item.
        """
        found = {}
        with self._reading() as connection:
            for key, fingerprint in self._look_up(connection, keys):
                if fingerprint is None:
                    raise self._lacks(self.kind.key(key))
                found[key] = fingerprint
        return found

    def held(self, keys: Iterable[K]) -> dict[K, str]:
        """Fingerprints of those of the items that the file holds; see `fingerprints`."""
        with self._reading() as connection:
            found = self._look_up(connection, keys)
            return {key: fingerprint for key, fingerprint in found if fingerprint is not None}

    def attributes(self, keys: Iterable[K]) -> Iterator[tuple[K, Attributes]]:
        """Attributes of items, read without their arrays.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable, or holds no such item.
        """
        query = "SELECT key, fingerprint, attributes, seconds, checksum FROM items WHERE key = ?"
        with self._reading() as connection:
            for key in keys:
                text = self.kind.key(key)
                with self._errors():
                    row = connection.execute(query, (text,)).fetchone()
                if row is None:
                    raise self._lacks(text)
                if not is_intact(row):
                    raise self._damaged(f"the checksum of {_shown(text)}")
                yield key, json.loads(row[2])

    def counts(self, name: str) -> dict[str, int]:
        """A whole number of every item's attributes, by the text of its key; not held against checksums.

        Raises
        ------
        WorkspaceError
            If the file is missing or unreadable.
        """
        query = "SELECT key, json_extract(attributes, '$.' || ?) FROM items"
        with self._reading() as connection, self._errors():
            return {key: int(value or 0) for key, value in connection.execute(query, (name,))}

    def finished(self, wanted: Mapping[K, str]) -> set[K]:
        """Keys whose item is there with the wanted fingerprint."""
        if not self.path.exists():
            return set()
        with self._reading(sealed=False) as connection:
            found = self._look_up(connection, wanted)
            return {key for key, fingerprint in found if fingerprint == wanted[key]}

    def seal(self) -> str | None:
        """What `commit` was given last; None if it was not called yet."""
        if not self.path.exists():
            return None
        with self._reading(sealed=False) as connection, self._errors():
            return self._about(connection).get("seal")

    def origin(self) -> str | None:
        """What `clear` was given when the file was begun; None if nothing, or if there is no file."""
        if not self.path.exists():
            return None
        # It is in the file since that was begun, so the log of a process that writes now need not be read.
        uri = f"{self.path.absolute().as_uri()}?mode=ro&immutable=1"
        with self._errors(), contextlib.closing(sqlite3.connect(uri, uri=True)) as connection:
            return self._about(connection).get("origin")

    def seconds(self) -> float:
        """Seconds that the items took to make, over all runs."""
        with self._reading(sealed=False) as connection, self._errors():
            return float(connection.execute("SELECT total(seconds) FROM items").fetchone()[0])

    def find_damage(self) -> list[str]:
        """Keys of items that are not as they were written; reads the whole file and changes nothing.

        Raises
        ------
        WorkspaceError
            If the file is missing or not an item store, or its tables cannot be read to the end.
        """
        damaged = []
        with self._reading(sealed=False) as connection, self._errors():
            (problem,) = connection.execute("PRAGMA quick_check(1)").fetchone()
            if problem != "ok":
                raise sqlite3.DatabaseError(problem)
            orphans = "SELECT key FROM items WHERE number NOT IN (SELECT number FROM arrays)"
            damaged += [str(key) for (key,) in connection.execute(orphans)]
            for row in connection.execute(WHOLE_ROWS):
                try:
                    self._decoded(row)
                except DamageError:
                    damaged.append(str(row[0]))
        return damaged

    def require_whole(self) -> None:
        """Read every item.

        Raises
        ------
        WorkspaceError
            If the file is missing, or anything in it is damaged, with what mends it.
        """
        if damaged := self.find_damage():
            raise self._damaged(f"the checksum of {first_few([_shown(key) for key in damaged])}")

    @contextlib.contextmanager
    def _reading(self, *, sealed: bool = True) -> Iterator[sqlite3.Connection]:
        """A connection to read from: that of the writer if there is one."""
        if self._writing is not None:
            yield self._writing
            return
        if not self.path.exists():
            raise WorkspaceError(f"{self.path}: missing; run: {self._remedy}")
        with self._errors():
            if not self.path.is_file():
                raise sqlite3.DatabaseError("is no file")
        with contextlib.ExitStack() as stack:
            uri = self._uri_to_read(stack)
            with self._errors():
                connection = sqlite3.connect(uri, uri=True, check_same_thread=False)
            stack.enter_context(contextlib.closing(connection))
            with self._errors():
                about = self._about(connection)
            if sealed and self._seal is not None and about.get("seal") != self._seal:
                raise WorkspaceError(f"{self.path}: is not the file that its step wrote; run: {self._mend}")
            yield connection

    def _uri_to_read(self, stack: contextlib.ExitStack) -> str:
        """Where to read what is in the file and in the log that a killed process left beside it."""
        if self._has_log() and not self._merges:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="corrsfm-"))
            copy = Path(folder) / self.path.name
            try:
                for suffix in ("", *_LOGS):
                    with contextlib.suppress(FileNotFoundError):
                        shutil.copyfile(self._beside(suffix), f"{copy}{suffix}")
            except OSError as error:
                raise WorkspaceError(f"{self.path}: cannot be read ({error.strerror})") from error
            return f"{copy.as_uri()}?mode=rw"
        if self._has_log() and os.access(self.path, os.W_OK) and os.access(self.path.parent, os.W_OK):
            self._writer()
            self.close()
        # Without a log beside it nobody writes, and no lock is needed, which some file systems lack.
        return f"{self.path.absolute().as_uri()}?{'mode=ro' if self._has_log() else 'mode=ro&immutable=1'}"

    def _has_log(self) -> bool:
        return any(self._beside(suffix).exists() for suffix in _LOGS)

    def _about(self, connection: sqlite3.Connection) -> dict[str, str]:
        (application,) = connection.execute("PRAGMA application_id").fetchone()
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if application != APPLICATION_ID:
            raise sqlite3.DatabaseError("is not a file of corrsfm's items")
        # That of the workspace was read before: a file of another corrsfm does not get here.
        if version != FORMAT_VERSION:
            raise sqlite3.DatabaseError(f"format version {version}, expected {FORMAT_VERSION}")
        about = {str(name): str(value) for name, value in connection.execute("SELECT name, value FROM about")}
        if about.get("kind") != self.kind.label:
            raise sqlite3.DatabaseError(f"holds {about.get('kind')}, expected {self.kind.label}")
        return about

    def _look_up(self, connection: sqlite3.Connection, keys: Iterable[K]) -> Iterator[tuple[K, str | None]]:
        """Keys with the fingerprints of their items, None where there is no item."""
        keys = iter(keys)
        # Many at once: a scene may have millions.
        while some := {key: self.kind.key(key) for key in itertools.islice(keys, KEYS_AT_ONCE)}:
            marks = ", ".join("?" * len(some))
            query = f"SELECT key, fingerprint FROM items WHERE key IN ({marks})"
            with self._errors():
                found = dict(connection.execute(query, tuple(some.values())))
            for key, text in some.items():
                yield key, found.get(text)

    def _checked(self, row: tuple[Any, ...]) -> tuple[Arrays, Attributes]:
        """Arrays and attributes of a row whose checksum is right."""
        if not is_intact(row):
            raise self._damaged(f"the checksum of {_shown(row[0])}")
        return unpack(row[5], row[6]), json.loads(row[2])

    def _decoded(self, row: tuple[Any, ...]) -> T:
        """The item of a row whose checksum is right, and whose arrays make one."""
        arrays, attributes = self._checked(row)
        try:
            return self.kind.decode(arrays, attributes)
        except (InputError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise self._damaged(f"{_shown(row[0])}: {error}") from error

    def _lacks(self, key: str) -> WorkspaceError:
        return WorkspaceError(f"{self.path}: holds nothing for {_shown(key)}; run: {self._mend}")

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        """Say what SQLite's errors mean for the user, so that nobody deletes a whole file."""
        try:
            yield
        except sqlite3.Error as error:
            name = getattr(error, "sqlite_errorname", "")
            for beginnings, text in _NOT_DAMAGE.items():
                if name.startswith(beginnings):
                    if "permissions" in text and self._is_closed():
                        raise WorkspaceError(opening(self.path)) from error
                    raise WorkspaceError(f"{self.path}: {text.format(error)}") from error
            raise self._damaged(error) from error

    def _is_closed(self) -> bool:
        return not all(os.access(path, os.R_OK | os.W_OK) for path in (self.path, self.path.parent))

    def _damaged(self, what: object) -> DamageError:
        return DamageError(f"{self.path}: damaged ({what}); run: {self._mend}")

    # writing ------------------------------------------------------------------------------------------------

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
                    f"{self.path}: {_shown(self.kind.key(key))} was never finished; run again"
                )
        with self._errors(), transaction(connection):
            (num,) = connection.execute("SELECT count(*) FROM items").fetchone()
            if num != len(wanted):
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
        return [f"{self.path}: damaged items are made again: {first_few([_shown(key) for key in damaged])}"]

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
                (problem,) = self._writer().execute("PRAGMA quick_check(1)").fetchone()
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

    def _prepare(self) -> None:
        """See to it that there is a file of this store's own."""
        if not self.path.exists():
            with atomic_path(self.path) as new, self._errors(), new_file(new, self.kind.label):
                pass
        # Other workspaces that read it by another name keep what they have.
        elif self.path.stat().st_nlink > 1:
            with atomic_path(self.path) as copy:
                shutil.copy2(self.path, copy)

    def _beside(self, suffix: str) -> Path:
        return self.path.with_name(self.path.name + suffix)


def _shown(key: object) -> str:
    return str(key).replace("\t", " – ")
