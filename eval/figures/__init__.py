"""The figures of the paper's evaluation, from the same rows and test sets as its tables."""
