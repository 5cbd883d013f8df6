"""The blend and its adjoints in lanes: sixteen pixels at once."""
