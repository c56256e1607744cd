"""The networks of the systems the paper compares with, made from their papers: Des18, Des19 and Gao19."""
