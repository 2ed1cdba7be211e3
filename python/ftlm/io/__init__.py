"""Files read: text, .mat, parquet."""
