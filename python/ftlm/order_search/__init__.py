"""Order search: exhaustive search for orders on a grid, with checkpoints, executors and certificates."""
