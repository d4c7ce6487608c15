"""Losses of pictures."""
