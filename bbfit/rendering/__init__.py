"""Renderers of billboard clouds and of the cards that are exported."""
