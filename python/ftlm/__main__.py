"""``python -m ftlm`` is the command line."""

from ftlm.cli import main

main()
