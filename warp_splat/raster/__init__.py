"""From 3D Gaussians to an image and back to their gradients, for torch."""
