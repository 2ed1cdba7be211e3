"""Local web application on 127.0.0.1, in which each file is read and each model fitted in a separate process."""
