"""``warp-splat inspect``: what is wrong with a scene, before anyone trains on it."""
