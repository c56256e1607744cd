"""Videos of a material under a light that moves, in a loop."""
