"""Engines that minimise the refinement objective; `reference` is the obvious one."""
