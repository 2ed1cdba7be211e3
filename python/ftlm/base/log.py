"""What ftlm tells a program's log: the logger ``ftlm``, silent until the program listens."""

from __future__ import annotations

import logging

#: Files read and written and fits begun and ended at INFO, what makes a result doubtful at WARNING.
LOG = logging.getLogger("ftlm")
LOG.addHandler(logging.NullHandler())
