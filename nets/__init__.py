"""Everything differentiable: the material, the renderer, the networks, their data and their trainer."""
