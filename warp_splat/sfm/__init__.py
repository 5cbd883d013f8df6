"""From photographs or a video to a scene with cameras: structure from motion by pycolmap, on the CPU."""
