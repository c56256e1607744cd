"""Measurements of time and memory; none of them asserts on the clock."""
