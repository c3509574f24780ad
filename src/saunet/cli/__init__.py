"""Command-line tools, one thin application a file."""
