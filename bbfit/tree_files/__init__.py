"""Files of trees: the formats, the files that belong to a tree, and its triangles without Blender."""
