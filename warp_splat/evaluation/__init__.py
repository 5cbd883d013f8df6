"""How good a model is: metrics, tables, pictures beside photographs."""
