"""Scalar objectives on tensors: map and rendering terms, perceptual distances, refinement data terms."""
