"""Structural similarity of pictures."""
