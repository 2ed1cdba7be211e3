"""Order search: exhaustive search over a grid, checkpoints, executors, certificates."""
