"""A finished model made smaller and cleaner: what it does not need, and what should not be there, is left out."""
