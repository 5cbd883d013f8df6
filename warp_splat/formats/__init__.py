"""The files that are read and written, each format in a module of its own."""
