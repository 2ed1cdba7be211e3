"""Models, their files and their typesetting."""
