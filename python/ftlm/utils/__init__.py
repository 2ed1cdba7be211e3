"""Ground: errors, checks, arrays, statistics, files written, progress."""
