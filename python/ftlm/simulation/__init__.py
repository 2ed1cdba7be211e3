"""Equations solved: records, free runs, frequency response, stability, other forms."""
