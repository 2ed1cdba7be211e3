"""Results held against measurements: both errors, residual tests, criteria."""
