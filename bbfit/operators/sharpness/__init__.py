"""Difference in sharpness between pictures."""
