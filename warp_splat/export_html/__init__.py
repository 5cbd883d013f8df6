"""One HTML file that shows a model in any browser, from disk, by WebGL2."""
