"""The built-in tree generator, after Weber and Penn 1995."""
