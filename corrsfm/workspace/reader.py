"""Reading items of one SQLite file, whatever a killed process left of it, and what SQLite's errors mean."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import shutil
import sqlite3
import tempfile
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic

from corrsfm.colmap.sqlite import require_tables
from corrsfm.disk import opening
from corrsfm.errors import DamageError, InputError, WorkspaceError, first_few
from corrsfm.workspace.items import Arrays, Attributes, K, Kind, T
from corrsfm.workspace.rows import APPLICATION_ID, FORMAT_VERSION, TABLES, WHOLE_ROWS, is_intact, unpack

__all__ = ["ItemReader", "shown_key"]

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


class ItemReader(ABC, Generic[K, T]):
    """Items of one kind; reading is safe from several threads.

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
        # While there is one, what it has not committed can be read too.
        self._writing: sqlite3.Connection | None = None

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
                    raise self._damaged(f"the checksum of {shown_key(text)}")
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

    def texts(self) -> list[str]:
        """The texts of the keys of all items, sorted; not held against checksums."""
        with self._reading() as connection, self._errors():
            return sorted(str(key) for (key,) in connection.execute("SELECT key FROM items"))

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
        if not self.path.is_file():
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
            (problem,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
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
            raise self._damaged(f"the checksum of {first_few([shown_key(key) for key in damaged])}")

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
            self._merge_log()
        # Without a log beside it nobody writes, and no lock is needed, which some file systems lack.
        return f"{self.path.absolute().as_uri()}?{'mode=ro' if self._has_log() else 'mode=ro&immutable=1'}"

    @abstractmethod
    def _merge_log(self) -> None:
        """Put what a killed process wrote last into the file."""

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
        require_tables(connection, TABLES, may_have_triggers=False)
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
            raise self._damaged(f"the checksum of {shown_key(row[0])}")
        return unpack(row[5], row[6]), json.loads(row[2])

    def _decoded(self, row: tuple[Any, ...]) -> T:
        """The item of a row whose checksum is right, and whose arrays make one."""
        arrays, attributes = self._checked(row)
        try:
            return self.kind.decode(arrays, attributes)
        except (InputError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise self._damaged(f"{shown_key(row[0])}: {error}") from error

    def _lacks(self, key: str) -> WorkspaceError:
        return WorkspaceError(f"{self.path}: holds nothing for {shown_key(key)}; run: {self._mend}")

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

    def _beside(self, suffix: str) -> Path:
        return self.path.with_name(self.path.name + suffix)


def shown_key(key: object) -> str:
    return str(key).replace("\t", " – ")
