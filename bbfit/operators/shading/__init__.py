"""Texels of maps in the light of a view: the reference, and Warp kernels."""
