"""Checkpoint file of a long computation: an SQLite database of records with digests, appended by one writer.

The only table has the name of the computation (``search`` or ``selection``) and one row per record:

===========  ========================================================================================================
``number``   1, 2, …
``payload``  one MessagePack map, whose key ``type`` is the type of the record
``digest``   BLAKE2b of the previous digest (nothing for the first record) and the payload, 16 bytes
===========  ========================================================================================================

Records are only appended. With the rollback journal of SQLite, every append is either complete or without effect, even
if the process is killed. The journal is deleted at the end of each append, so the database file contains all records.
(After a kill, a write-ahead log would contain the last records in a second file.) SQLite does not detect changed bytes
of a page. Every digest therefore covers all records up to its own. A record that was lost, moved or changed is reported
as damage, and no later record is used.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sqlite3
import stat
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import msgspec
import numpy as np

from ftlm.errors import DataError
from ftlm.utils.files import write_atomically
from ftlm.utils.parameters import parameter

Kind: TypeAlias = Literal["search", "selection"]
TABLE_COLUMNS = "(number INTEGER PRIMARY KEY, payload BLOB NOT NULL, digest BLOB NOT NULL)"
DIGEST_BYTES = 16
#: Maximum size of a checkpoint file. The largest search with an order law needs less than a tenth of it.
MAX_FILE_BYTES = 4 << 30
#: Maximum time that an append waits for readers, and a reader for an append.
READER_TIMEOUT_S = 60.0
#: Pause between the two attempts of a process to lock the file as its writer. An existing writer is without its lock
#: for some microseconds after an append, so that the first attempt may succeed, but the second one then fails.
LOCK_PAUSE_S = 0.01


def encode_numpy(value: object) -> object:
    """Return a NumPy number as a Python number, and an array as (shape, little-endian doubles)."""
    if isinstance(value, np.ndarray):
        return value.shape, np.ascontiguousarray(value, "<f8").tobytes()
    if isinstance(value, (np.floating, np.integer, np.bool_)):
        return value.item()
    if isinstance(value, tuple):
        return tuple(value)
    # msgspec requires this exception for other types.
    raise NotImplementedError(type(value))


def decode_array(_: type, value: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the float64 array from (shape, little-endian doubles)."""
    shape, data = msgspec.convert(value, tuple[tuple[int, ...], bytes])
    return np.frombuffer(data, "<f8").astype(np.float64).reshape(shape)


RECORD_ENCODER = msgspec.msgpack.Encoder(enc_hook=encode_numpy)


def _digest(prefix: bytes, payload: bytes) -> bytes:
    return hashlib.blake2b(prefix + payload, digest_size=DIGEST_BYTES).digest()


def _insert(connection: sqlite3.Connection, kind: Kind, payloads: Sequence[bytes]) -> None:
    """Append records to the table of a computation, which is created if necessary, and commit them."""
    with connection:
        connection.execute(f"CREATE TABLE IF NOT EXISTS {kind} {TABLE_COLUMNS}")
        last = connection.execute(f"SELECT digest FROM {kind} ORDER BY number DESC LIMIT 1").fetchone()
        digest = b"" if last is None else last[0]
        for payload in payloads:
            digest = _digest(digest, payload)
            connection.execute(f"INSERT INTO {kind} (payload, digest) VALUES (?, ?)", (payload, digest))


class CheckpointFile:
    """Checkpoint file that stays open until :meth:`close` is called.

    Raise DataError if the file cannot be opened or belongs to another computation or program.

    Parameters
    ----------
    path, kind
        Path of the file, and kind of the computation whose records it contains.
    access
        ``"read"``: only read, while another process may write. ``"resume"``: write to an existing file as its single
        writer. ``"create"``: the same, but create the file if it does not exist.
    """

    def __init__(
        self, path: str | os.PathLike[str], kind: Kind, access: Literal["read", "resume", "create"] = "read"
    ) -> None:
        self.path, self.kind = Path(path), kind
        verb = "read" if access == "read" else "opened"
        try:
            status = self._status(access)
            # SQLite would wait forever for a pipe without a writer.
            if status is not None and not stat.S_ISREG(status.st_mode):
                raise DataError(f"store {path} is not a regular file; choose another file")
            if status is not None and status.st_size > MAX_FILE_BYTES:
                raise DataError(
                    f"{path} has {status.st_size} bytes, more than the {MAX_FILE_BYTES} of the largest store; "
                    f"start the {kind} again in another file"
                )
            uri = f"{self.path.absolute().as_uri()}?mode={'rwc' if access == 'create' else 'rw'}"
            self._connection = sqlite3.connect(
                uri, READER_TIMEOUT_S, uri=True, isolation_level=None, check_same_thread=False
            )
        except (OSError, ValueError, sqlite3.Error) as error:
            reason = error.strerror if isinstance(error, OSError) else None
            raise DataError(f"store {path} cannot be {verb}: {reason or error}; choose another file") from error
        try:
            # With this setting, the intact records of a truncated file can be read.
            self._connection.execute("PRAGMA writable_schema = ON")
            if access != "read":
                self._lock()
            self._check_kind()
        except sqlite3.Error as error:
            self.close()
            raise self._opening_error(error, verb) from error
        except BaseException:
            self.close()
            raise

    def _status(self, access: str) -> os.stat_result | None:
        """Return the status of the file; None if the file does not exist and `access` is "create"."""
        try:
            return self.path.stat()
        except FileNotFoundError:
            if access != "create":
                raise
            self.path.parent.stat()
            return None

    def _lock(self) -> None:
        """Lock the file against other writers until it is closed; readers still have access between appends."""
        execute = self._connection.execute
        execute("PRAGMA busy_timeout = 0")
        execute("PRAGMA journal_mode = DELETE")
        execute("BEGIN IMMEDIATE")
        # This statement fails at once if the file or its folder is read-only.
        execute("PRAGMA user_version = 0")
        execute("ROLLBACK")
        time.sleep(LOCK_PAUSE_S)
        # With EXTRA, the deletion of the journal at the end of an append is also flushed to disk.
        execute("PRAGMA synchronous = EXTRA")
        execute("BEGIN IMMEDIATE")
        execute(f"PRAGMA busy_timeout = {round(1000 * READER_TIMEOUT_S)}")

    def _check_kind(self) -> None:
        """Raise DataError if the database belongs to another kind of computation or to another program."""
        statements = [str(sql) for (sql,) in self._connection.execute("SELECT sql FROM sqlite_master")]
        self._is_empty = not statements
        other: Kind = "selection" if self.kind == "search" else "search"
        if statements == [f"CREATE TABLE {other} {TABLE_COLUMNS}"]:
            raise DataError(
                f"{self.path} is the store of a {other}, not of a {self.kind}; resume it with the call that created it"
            )
        if statements not in ([], [f"CREATE TABLE {self.kind} {TABLE_COLUMNS}"]):
            raise self._foreign_error()

    def _foreign_error(self) -> DataError:
        return DataError(f"{self.path} is not an ftlm {self.kind} store; give a file written with {parameter('store')}")

    def _opening_error(self, error: sqlite3.Error, verb: str) -> DataError:
        """Return the DataError for a file that SQLite cannot open; `verb` is "read" or "opened"."""
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code == sqlite3.SQLITE_BUSY:
            return DataError(
                f"store {self.path} is in use by another {self.kind}; wait for it, stop it, or choose another file"
            )
        if code == sqlite3.SQLITE_CORRUPT:
            return DataError(f"{self.path} cannot be used: {error}; start the {self.kind} again in another file")
        if code != sqlite3.SQLITE_NOTADB:
            return DataError(f"store {self.path} cannot be {verb}: {error}; choose another file")
        return self._foreign_error()

    def read(self) -> tuple[list[bytes], str | None]:
        """Return the payloads of the intact records, and text on damage after them; None if there is no damage."""
        payloads: list[bytes] = []
        digest, damage = b"", None
        if self._is_empty:
            return [], None
        try:
            rows = self._connection.execute(f"SELECT number, payload, digest FROM {self.kind} ORDER BY number")
            for number, payload, stored_digest in rows:
                digest = _digest(digest, payload) if isinstance(payload, bytes) else b""
                if (number, stored_digest) != (len(payloads) + 1, digest):
                    damage = f"record {len(payloads) + 1} does not match its digest"
                    break
                payloads.append(payload)
            else:
                # Check also the pages that no record uses, because a later append may use them.
                result = self._connection.execute("PRAGMA quick_check(1)").fetchone()[0]
                damage = None if result == "ok" else f"after record {len(payloads)}: {result}"
        except sqlite3.Error as error:
            damage = f"after record {len(payloads)}: {error}"
        return payloads, damage

    def append(self, payloads: Sequence[bytes]) -> None:
        """Append records and flush them to disk; if this fails, append none of them and raise DataError."""
        try:
            if not self._connection.in_transaction:
                self._connection.execute("BEGIN IMMEDIATE")
            _insert(self._connection, self.kind, payloads)
            self._connection.execute("BEGIN IMMEDIATE")
        except sqlite3.Error as error:
            raise DataError(
                f"store {self.path} cannot be written: {error}; its stored records are intact; free disk space, or "
                "move it to another folder, and resume it"
            ) from error

    def recover(self, payloads: Sequence[bytes]) -> Path:
        """Replace the damaged file by a file with the given intact records, and close it.

        Return the path of a copy of the damaged file; raise DataError if the copy exists or a file cannot be written.
        """
        self.close()
        copy = write_atomically(self.path.with_name(self.path.name + ".damaged"), self.path.read_bytes(), force=False)
        with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
            database.execute("BEGIN")
            _insert(database, self.kind, payloads)
            write_atomically(self.path, database.serialize(), force=True)
        return copy

    def close(self) -> None:
        """Close the file and release the lock."""
        self._connection.close()

    def __enter__(self) -> CheckpointFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
