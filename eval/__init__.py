"""Evaluation: test sets, metrics and the scripts that print every table."""
