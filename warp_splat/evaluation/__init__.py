"""How good a model is: metrics, pictures beside photographs, tables."""
