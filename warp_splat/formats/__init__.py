"""The files that are exchanged with other programs; each format has a module of its own."""
