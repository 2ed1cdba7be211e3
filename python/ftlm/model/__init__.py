"""The model that people hold, its file and its typesetting."""
