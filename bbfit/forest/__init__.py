"""Forests: where the trees of a library stand, and the files that show them."""
