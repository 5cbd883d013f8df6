"""A model in the browser, drawn by this package's renderer."""
