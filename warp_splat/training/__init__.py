"""From photographs to Gaussians."""
