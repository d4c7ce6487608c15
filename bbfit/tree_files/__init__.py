"""Files of trees: which formats there are, which files belong to a tree, and what can be read without Blender."""
