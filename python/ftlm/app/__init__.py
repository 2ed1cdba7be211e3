"""The local page: files in a browser, each read and each fit in a process of its own, nothing but 127.0.0.1."""
