"""What is wrong with a scene, before anyone trains on it: verdicts, and a page with pictures."""
