"""Adam for texels."""
