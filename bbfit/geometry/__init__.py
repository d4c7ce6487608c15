"""Cameras, orbits, billboards and the homographies between them: pure tensors, no files."""
