"""Measures of how close a billboard cloud comes to the views of its tree."""
