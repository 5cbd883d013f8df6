"""From photographs or a video to a scene with cameras, by pycolmap on the CPU."""
