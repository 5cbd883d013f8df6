"""Any renderer of Gaussians measured against float64: its errors, and what it does that others do not."""
