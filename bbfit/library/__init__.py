"""A library of trees: each with its levels of detail, and one atlas for all of them."""
