"""Comparisons of bbfit with other ways to simplify a tree, on one tree or on many."""
