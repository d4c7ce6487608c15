"""Views of a tree: pictures, cameras, lights, and their split."""
