"""Stores of searches that were stopped."""

import contextlib
import sqlite3


def keep(path, count):
    """Drop all records but the first ones: a search that was stopped there."""
    with contextlib.closing(sqlite3.connect(path)) as file, file:
        file.execute("DELETE FROM search WHERE number > ?", (count,))


def keep_share(path, share):
    """Drop all records but this share of them; what is searched and one batch stay, and one record goes."""
    with contextlib.closing(sqlite3.connect(path)) as file:
        (last,) = file.execute("SELECT MAX(number) FROM search").fetchone()
    keep(path, min(max(int(share * last), 2), last - 1))
