"""The paper's section 5 recomputed, and the demonstration that is a part of it."""
