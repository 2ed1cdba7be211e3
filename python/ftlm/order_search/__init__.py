"""Order searches: rounds, stores, executors, tables."""
