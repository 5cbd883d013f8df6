"""A page that shows a model in any browser, from disk: Gaussians packed in Python, drawn by WebGL2."""
