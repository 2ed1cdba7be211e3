"""Local web application: a browser session on 127.0.0.1 with one process per file read and per fit."""
