"""The next experiment: which input would tell the numbers of an identified model best."""
