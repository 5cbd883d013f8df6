"""A scene in the browser, drawn by the renderer of this package."""
