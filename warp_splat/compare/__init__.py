"""Adjoints of the pixel loop compared: error against run time; and the float64 renderer that says what is true."""
